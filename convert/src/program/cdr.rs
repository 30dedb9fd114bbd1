//! CDR as ROS 2 uses it (XCDR1): values at multiples of their size, counted from the end of the
//! encapsulation.

use super::error::Fault;
use crate::limits::MAX_MESSAGE_BYTES;

/// Plain CDR, little endian, no options.
pub(super) const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];

/// Bytes after a message that round its length up.
const PADDING: usize = 3;
/// Fast DDS reserves up to so many bytes too many for a wide string, and for an empty sequence of
/// values of 8 bytes. They are no part of a message that it publishes, but of one that an
/// application has serialized itself.
const RESERVED: usize = 8;

pub(super) struct Reader<'a> {
    /// The bytes after the encapsulation.
    data: &'a [u8],
    at: usize,
    big: bool,
    /// Bytes that may follow the message.
    spare: usize,
}

impl<'a> Reader<'a> {
    /// # Errors
    /// If the encapsulation is not that of plain CDR, or the message too large.
    pub(super) fn new(cdr: &'a [u8]) -> Result<Self, Box<Fault>> {
        if cdr.len() > MAX_MESSAGE_BYTES {
            return Err(Fault::too_large());
        }
        let Some(([high, low, _, _], data)) = cdr.split_first_chunk() else {
            return Err(Fault::text(format!("the CDR has {} bytes, less than 4", cdr.len())));
        };
        let big = match u16::from_be_bytes([*high, *low]) {
            0 => true,
            1 => false,
            other => return Err(Fault::representation(other)),
        };
        Ok(Self { data, at: 0, big, spare: PADDING })
    }

    fn left(&self) -> usize {
        self.data.len().saturating_sub(self.at)
    }

    /// # Errors
    /// If there are not so many bytes.
    pub(super) fn bytes(&mut self, count: usize) -> Result<&'a [u8], Box<Fault>> {
        let rest = self.data.get(self.at..).unwrap_or_default();
        let bytes = rest.get(..count).ok_or_else(|| self.short(count))?;
        self.at += count;
        Ok(bytes)
    }

    /// A value of `N` bytes, little endian.
    ///
    /// # Errors
    /// If there are not so many bytes.
    pub(super) fn scalar<const N: usize>(&mut self) -> Result<[u8; N], Box<Fault>> {
        self.at = self.at.next_multiple_of(N);
        let rest = self.data.get(self.at..).unwrap_or_default();
        let mut bytes = *rest.first_chunk::<N>().ok_or_else(|| self.short(N))?;
        self.at += N;
        if self.big {
            bytes.reverse();
        }
        Ok(bytes)
    }

    #[cold]
    fn short(&self, wanted: usize) -> Box<Fault> {
        Fault::text(format!("the CDR ends: {wanted} bytes wanted, {} left", self.left()))
    }

    /// Number of elements or characters, each of at least `size` bytes.
    ///
    /// # Errors
    /// If it is above the bound, or there are not so many bytes.
    pub(super) fn count(&mut self, most: usize, size: usize) -> Result<usize, Box<Fault>> {
        let count = u32::from_le_bytes(self.scalar()?) as usize;
        if count.saturating_mul(size) > self.left() {
            let left = self.left();
            return Err(Fault::text(format!("the CDR ends: {count} elements, {left} bytes left")));
        }
        check_length(count, most, "elements")?;
        Ok(count)
    }

    /// Skips the byte of a message without fields. Some writers leave it out at the end.
    pub(super) fn skip_empty(&mut self) {
        self.at = self.data.len().min(self.at + 1);
    }

    /// More may follow the message.
    pub(super) fn reserved(&mut self) {
        self.spare += RESERVED;
    }

    /// # Errors
    /// If more bytes are left than may follow a message.
    pub(super) fn end(&self) -> Result<(), Box<Fault>> {
        if self.left() <= self.spare {
            return Ok(());
        }
        let left = self.left();
        Err(Fault::text(format!("{left} bytes after the message: the CDR is not of this type")))
    }
}

/// # Errors
/// If there are more of the unit than the bound allows.
pub(super) fn check_length(found: usize, most: usize, unit: &str) -> Result<(), Box<Fault>> {
    if found > most {
        return Err(Fault::text(format!("expected at most {most} {unit}, found {found}")));
    }
    Ok(())
}

pub(super) struct Writer<'o> {
    out: &'o mut Vec<u8>,
    /// Index of the first value in `out`.
    start: usize,
}

impl<'o> Writer<'o> {
    /// Appends to `out`, which ends with the encapsulation.
    pub(super) fn new(out: &'o mut Vec<u8>) -> Self {
        let start = out.len();
        Self { out, start }
    }

    fn size(&self) -> usize {
        self.out.len() - self.start
    }

    /// # Errors
    /// If so many more bytes are too many.
    pub(super) fn room(&self, bytes: usize) -> Result<(), Box<Fault>> {
        let size = ENCAPSULATION.len().saturating_add(self.size()).saturating_add(bytes);
        if size > MAX_MESSAGE_BYTES { Err(Fault::too_large()) } else { Ok(()) }
    }

    /// A value of `N` bytes, little endian.
    pub(super) fn scalar<const N: usize>(&mut self, value: [u8; N]) {
        let size = self.size();
        let padded = size.next_multiple_of(N);
        if padded != size {
            self.out.resize(self.start + padded, 0);
        }
        self.out.extend_from_slice(&value);
    }

    pub(super) fn bytes(&mut self, bytes: &[u8]) {
        self.out.extend_from_slice(bytes);
    }

    /// Room for so many bytes, all 0.
    pub(super) fn zeros(&mut self, count: usize) -> &mut [u8] {
        let at = self.out.len();
        self.out.resize(at + count, 0);
        self.out.get_mut(at..).unwrap_or_default()
    }

    /// Takes back the last bytes.
    pub(super) fn take_back(&mut self, count: usize) {
        self.out.truncate(self.out.len().saturating_sub(count).max(self.start));
    }

    /// A count that [`Writer::set_count`] fills in. Its place.
    pub(super) fn count_later(&mut self) -> usize {
        self.scalar([0; 4]);
        self.out.len() - 4
    }

    pub(super) fn set_count(&mut self, place: usize, count: usize) {
        let count = u32::try_from(count).unwrap_or(u32::MAX);
        if let Some(bytes) = self.out.get_mut(place..place + 4) {
            bytes.copy_from_slice(&count.to_le_bytes());
        }
    }
}
