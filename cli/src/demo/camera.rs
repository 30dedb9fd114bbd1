//! Recorded camera pictures: `sensor_msgs/msg/CompressedImage` with JPEG becomes RGB, three bytes a
//! pixel, or `sensor_msgs/msg/Image` with that.
//!
//! Pictures are decoded when a recording is loaded, by two threads. What would need more than
//! [`MAX_DECODED_BYTES`] stays JPEG and is decoded just before it is due.

use std::sync::atomic::{AtomicUsize, Ordering};

use blaze_domain::media::cdr_of;
use blaze_domain::{MAX_PAYLOAD_BYTES, TopicName};
use bytes::Bytes;
use parking_lot::Mutex;
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use super::recording::{Body, RawRecording};

/// Most bytes of decoded pictures that are kept, over all recordings (512 MiB).
pub const MAX_DECODED_BYTES: usize = 512 * 1024 * 1024;
/// Widest and highest picture.
const MAX_SIDE: usize = 16_384;
const DECODER_THREADS: usize = 2;
const COMPRESSED_IMAGE: &str = "sensor_msgs/msg/CompressedImage";
const IMAGE: &str = "sensor_msgs/msg/Image";
/// Bytes of an [`Pictures::Image`] before its pixels.
const IMAGE_HEAD: usize = 52;
const SUFFIX: &str = "/compressed";

/// Why a message is no picture.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CameraError {
    /// The CDR ends inside a field, or its beginning is none.
    #[error("the CDR message ends or breaks off in {0}")]
    Cdr(&'static str),
    /// The JPEG does not decode.
    #[error("JPEG: {0}")]
    Jpeg(String),
    /// Decoded it would be larger than a message may be.
    #[error("decoded it has {0} bytes, at most {MAX_PAYLOAD_BYTES} are allowed")]
    TooLarge(usize),
}

/// The form in which pictures are published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Pictures {
    /// Pixels alone.
    #[default]
    Rgb,
    /// CDR of `sensor_msgs/msg/Image`, for ROS 2 nodes.
    Image,
}

impl Pictures {
    fn head_bytes(self) -> usize {
        match self {
            Self::Rgb => 0,
            Self::Image => IMAGE_HEAD,
        }
    }
}

/// An image without its pixels: no time stamp, frame `camera`, `rgb8`.
fn image_head(width: u16, height: u16) -> Vec<u8> {
    let (width, height) = (u32::from(width), u32::from(height));
    let mut head = Vec::with_capacity(IMAGE_HEAD);
    head.extend_from_slice(b"\0\x01\0\0");
    head.extend_from_slice(&[0; 8]);
    head.extend_from_slice(b"\x07\0\0\0camera\0\0");
    head.extend_from_slice(&height.to_le_bytes());
    head.extend_from_slice(&width.to_le_bytes());
    // No big-endian pixels, and padding.
    head.extend_from_slice(b"\x05\0\0\0rgb8\0\0\0\0");
    head.extend_from_slice(&(3 * width).to_le_bytes());
    head.extend_from_slice(&(3 * width * height).to_le_bytes());
    head
}

/// What decoded pictures may still take.
#[derive(Debug)]
pub(super) struct Budget(usize);

impl Default for Budget {
    fn default() -> Self {
        Self(MAX_DECODED_BYTES)
    }
}

#[cfg(test)]
impl Budget {
    pub(super) fn of(bytes: usize) -> Self {
        Self(bytes)
    }
}

/// Reads a CDR text or byte field after another; positions count from behind the encapsulation
/// header.
struct Cdr<'a> {
    data: &'a [u8],
    at: usize,
    big_endian: bool,
}

impl<'a> Cdr<'a> {
    fn new(message: &'a [u8]) -> Option<Self> {
        let (head, data) = message.split_at_checked(4)?;
        // XCDR1 only: 0x0000 big-endian, 0x0001 little-endian.
        let big_endian = match head[..2] {
            [0, 0] => true,
            [0, 1] => false,
            _ => return None,
        };
        Some(Self { data, at: 0, big_endian })
    }

    fn u32(&mut self) -> Option<u32> {
        self.at = self.at.next_multiple_of(4);
        let bytes: [u8; 4] = self.data.get(self.at..self.at + 4)?.try_into().ok()?;
        self.at += 4;
        Some(if self.big_endian { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) })
    }

    /// A length and as many bytes; returns where they are.
    fn bytes(&mut self) -> Option<std::ops::Range<usize>> {
        let length = usize::try_from(self.u32()?).ok()?;
        let end = self.at.checked_add(length).filter(|end| *end <= self.data.len())?;
        let range = self.at..end;
        self.at = end;
        Some(range)
    }
}

/// The picture inside a `CompressedImage`, without a copy, and its format, for example `rgb8; jpeg
/// compressed bgr8`.
///
/// # Errors
/// [`CameraError::Cdr`] with the field that is broken.
pub fn parse_compressed_image(message: &Bytes) -> Result<(String, Bytes), CameraError> {
    let mut cdr = Cdr::new(message).ok_or(CameraError::Cdr("its beginning"))?;
    let broken = CameraError::Cdr;
    cdr.u32().ok_or(broken("header.stamp"))?;
    cdr.u32().ok_or(broken("header.stamp"))?;
    cdr.bytes().ok_or(broken("header.frame_id"))?;
    let format = cdr.bytes().ok_or(broken("format"))?;
    let format = String::from_utf8_lossy(&cdr.data[format]).trim_end_matches('\0').to_owned();
    let data = cdr.bytes().ok_or(broken("data"))?;
    Ok((format, message.slice(data.start + 4..data.end + 4)))
}

fn decoder(jpeg: &[u8]) -> JpegDecoder<ZCursor<&[u8]>> {
    let options = DecoderOptions::new_fast()
        .jpeg_set_out_colorspace(ColorSpace::RGB)
        .set_max_width(MAX_SIDE)
        .set_max_height(MAX_SIDE);
    JpegDecoder::new_with_options(ZCursor::new(jpeg), options)
}

/// Bytes of a picture that is decoded, from its header alone.
///
/// # Errors
/// [`CameraError::Jpeg`] or [`CameraError::TooLarge`].
pub fn decoded_bytes(jpeg: &[u8], pictures: Pictures) -> Result<usize, CameraError> {
    let (width, height) = size(&mut decoder(jpeg))?;
    let bytes = pictures.head_bytes() + usize::from(width) * usize::from(height) * 3;
    if bytes > MAX_PAYLOAD_BYTES {
        return Err(CameraError::TooLarge(bytes));
    }
    Ok(bytes)
}

/// Width and height.
fn size(decoder: &mut JpegDecoder<ZCursor<&[u8]>>) -> Result<(u16, u16), CameraError> {
    decoder.decode_headers().map_err(|error| CameraError::Jpeg(error.to_string()))?;
    let info = decoder.info().ok_or_else(|| CameraError::Jpeg("no size".to_owned()))?;
    Ok((info.width, info.height))
}

/// A picture in RGB: rows from the top, three bytes a pixel, nothing between rows.
///
/// # Errors
/// [`CameraError::Jpeg`] or [`CameraError::TooLarge`].
pub fn decode(jpeg: &[u8], pictures: Pictures) -> Result<Bytes, CameraError> {
    let expected = decoded_bytes(jpeg, pictures)?;
    let mut decoder = decoder(jpeg);
    let (width, height) = size(&mut decoder)?;
    let pixels = decoder.decode().map_err(|error| CameraError::Jpeg(error.to_string()))?;
    let picture = match pictures {
        Pictures::Rgb => pixels,
        Pictures::Image => [image_head(width, height), pixels].concat(),
    };
    if picture.len() != expected {
        return Err(CameraError::Jpeg(format!("{} bytes instead of {expected}", picture.len())));
    }
    Ok(Bytes::from(picture))
}

/// Turns the topics that hold JPEG pictures into topics of RGB. Returns how many messages do not
/// decode; they go.
pub(super) fn decode_topics(
    raw: &mut RawRecording,
    pictures: Pictures,
    taken: &[TopicName],
    budget: &mut Budget,
) -> u64 {
    let mut unusable = 0;
    for topic in 0..raw.topics.len() {
        let Some((name, picture_bytes)) = decodable(raw, topic, pictures, taken) else {
            continue;
        };
        let places: Vec<usize> =
            (0..raw.messages.len()).filter(|place| raw.messages[*place].0 == topic).collect();
        let mut bodies: Vec<(usize, Result<Body, CameraError>)> =
            places.into_iter().map(|place| (place, jpeg_of(&raw.messages[place].2))).collect();
        let needed = picture_bytes.saturating_mul(bodies.len());
        if needed <= budget.0 {
            budget.0 -= needed;
            decode_all(&mut bodies, pictures);
        }
        let mut broken = Vec::new();
        for (place, body) in bodies {
            match body {
                Ok(body) => raw.messages[place].2 = body,
                Err(_) => broken.push(place),
            }
        }
        unusable += broken.len() as u64;
        remove_all(&mut raw.messages, &broken);
        let entry = &mut raw.topics[topic];
        entry.name = name;
        (entry.type_name, entry.encoding) = match pictures {
            Pictures::Rgb => (String::new(), "application/octet-stream".to_owned()),
            Pictures::Image => (IMAGE.to_owned(), cdr_of(IMAGE)),
        };
        entry.decoded_bytes = Some(picture_bytes);
    }
    unusable
}

/// Removes the elements at the given places, which ascend.
fn remove_all<T>(elements: &mut Vec<T>, places: &[usize]) {
    let mut remaining = places.iter().peekable();
    let mut place = 0;
    elements.retain(|_| {
        let removed = remaining.next_if(|next| **next == place).is_some();
        place += 1;
        !removed
    });
}

/// The name and the size of the pictures of a topic, if it holds JPEG and the name is free.
fn decodable(
    raw: &RawRecording,
    topic: usize,
    pictures: Pictures,
    taken: &[TopicName],
) -> Option<(TopicName, usize)> {
    let entry = &raw.topics[topic];
    if entry.type_name != COMPRESSED_IMAGE {
        return None;
    }
    let name: TopicName = entry.name.as_str().strip_suffix(SUFFIX)?.parse().ok()?;
    if taken.contains(&name) || raw.topics.iter().any(|other| other.name == name) {
        return None;
    }
    let (_, _, body) = raw.messages.iter().find(|(of, _, _)| *of == topic)?;
    match jpeg_of(body).ok()? {
        Body::Jpeg(jpeg) => Some((name, decoded_bytes(&jpeg, pictures).ok()?)),
        Body::Ready(_) => None,
    }
}

fn jpeg_of(body: &Body) -> Result<Body, CameraError> {
    let (Body::Ready(message) | Body::Jpeg(message)) = body;
    let (format, data) = parse_compressed_image(message)?;
    if data.starts_with(&[0xff, 0xd8]) {
        Ok(Body::Jpeg(data))
    } else {
        Err(CameraError::Jpeg(format!("the format is {format:?}")))
    }
}

fn decode_all(bodies: &mut [(usize, Result<Body, CameraError>)], pictures: Pictures) {
    let next = AtomicUsize::new(0);
    let slots: Vec<Mutex<&mut Result<Body, CameraError>>> =
        bodies.iter_mut().map(|(_, body)| Mutex::new(body)).collect();
    std::thread::scope(|scope| {
        for _ in 0..DECODER_THREADS.min(slots.len()) {
            scope.spawn(|| {
                while let Some(slot) = slots.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let mut slot = slot.lock();
                    if let Ok(Body::Jpeg(jpeg)) = &**slot {
                        **slot = decode(jpeg, pictures).map(Body::Ready);
                    }
                }
            });
        }
    });
}
