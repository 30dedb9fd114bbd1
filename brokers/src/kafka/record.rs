//! A message as a record: its header lies in the record's headers, as text.

use std::fmt::Write as _;

use blaze_domain::names::ChannelName;
use blaze_domain::{MAX_PAYLOAD_BYTES, Origin, Priority, WriterId};
use blaze_proto::{Frame, FrameError, Header};
use bytes::Bytes;
use rdkafka::message::OwnedHeaders;

use crate::port::Content;

const VERSION: &str = "1";
/// Longest text that a header may have, in bytes: none of those that are written here is near it.
const MAX_TEXT_BYTES: usize = 1024;

/// What a record says in its headers. The value `None` is a header without one.
pub(super) type RawHeader<'a> = (&'a str, Option<&'a [u8]>);

/// What a record is: a message with a header if it names its writer, else bare.
pub(super) fn read<'a>(
    channel: &ChannelName,
    headers: impl Iterator<Item = RawHeader<'a>>,
    payload: Bytes,
    identity: Option<(WriterId, u64)>,
) -> Content {
    let bytes = payload.len();
    match read_header(channel, headers) {
        Ok(None) if bytes > MAX_PAYLOAD_BYTES => {
            Content::Malformed { error: FrameError::PayloadTooLarge(bytes), bytes }
        }
        Ok(None) => Content::Bare { payload, identity },
        Ok(Some(header)) => match Frame::new(&header, payload) {
            Ok(frame) => Content::Frame(frame),
            Err(error) => Content::Malformed { error, bytes },
        },
        Err(error) => Content::Malformed { error, bytes },
    }
}

fn field<T>(field: &'static str, reason: &'static str) -> Result<T, FrameError> {
    Err(FrameError::Field { field, reason })
}

/// The header of a record that names its writer.
fn read_header<'a>(
    channel: &ChannelName,
    headers: impl Iterator<Item = RawHeader<'a>>,
) -> Result<Option<Header>, FrameError> {
    let mut writer = None;
    let mut header = Header::new(channel.as_str(), Origin::default(), WriterId::default(), 0, 0);
    // What is wrong counts only if the record turns out to be ours.
    let mut fault = Ok(());
    for (name, value) in headers {
        if !name.starts_with("blaze-") && name != "traceparent" {
            continue;
        }
        if name == "blaze-writer" {
            writer = Some(value);
        } else if let Err(error) = read_field(&mut header, name, value) {
            fault = Err(error);
        }
    }
    let Some(writer) = writer else { return Ok(None) };
    fault?;
    let Ok(writer) = text("blaze-writer", writer)?.parse() else {
        return field("blaze-writer", "is not 32 hexadecimal digits");
    };
    header.writer = writer;
    Ok(Some(header))
}

fn read_field(header: &mut Header, name: &str, value: Option<&[u8]>) -> Result<(), FrameError> {
    match name {
        "blaze-version" if text("blaze-version", value)? == VERSION => {}
        "blaze-version" => return field("blaze-version", "is not 1"),
        "blaze-origin" => read_origin(&mut header.origin, text("blaze-origin", value)?)?,
        "blaze-epoch" => header.origin.epoch = number("blaze-epoch", value)?,
        "blaze-sequence" => header.sequence = number("blaze-sequence", value)?,
        "blaze-time" => header.publish_time_ns = number("blaze-time", value)?,
        "blaze-encoding" => text("blaze-encoding", value)?.clone_into(&mut header.encoding),
        "blaze-age-us" => header.age_us = number("blaze-age-us", value)?,
        "blaze-hops" => header.hops = number("blaze-hops", value)?,
        "blaze-lifespan-ms" => header.lifespan_ms = number("blaze-lifespan-ms", value)?,
        "blaze-depth" => header.depth = number("blaze-depth", value)?,
        "blaze-to" => text("blaze-to", value)?.clone_into(&mut header.to),
        "blaze-related-sequence" => {
            header.related.get_or_insert_default().1 = number("blaze-related-sequence", value)?;
        }
        "blaze-related-writer" => {
            let Ok(writer) = text("blaze-related-writer", value)?.parse() else {
                return field("blaze-related-writer", "is not 32 hexadecimal digits");
            };
            header.related.get_or_insert_default().0 = writer;
        }
        "blaze-type-hash" => text("blaze-type-hash", value)?.clone_into(&mut header.type_hash),
        "traceparent" => text("traceparent", value)?.clone_into(&mut header.traceparent),
        "blaze-priority" => match text("blaze-priority", value)?.parse::<Priority>() {
            Ok(priority) => header.priority = Some(priority),
            Err(_) => return field("blaze-priority", "is not one of control, state, bulk"),
        },
        "blaze-reliable" => match text("blaze-reliable", value)? {
            "true" | "1" => header.reliable = true,
            "false" | "0" => header.reliable = false,
            _ => return field("blaze-reliable", "is neither true nor false"),
        },
        _ => {} // a newer version may have more
    }
    Ok(())
}

fn read_origin(origin: &mut Origin, text: &str) -> Result<(), FrameError> {
    let mut parts = text.split('/');
    for slot in [&mut origin.layer, &mut origin.node, &mut origin.service, &mut origin.instance] {
        let Some(part) = parts.next() else {
            return field("blaze-origin", "has not three slashes");
        };
        part.clone_into(slot);
    }
    if parts.next().is_some() {
        return field("blaze-origin", "has not three slashes");
    }
    Ok(())
}

fn text<'a>(name: &'static str, value: Option<&'a [u8]>) -> Result<&'a str, FrameError> {
    let Some(value) = value else {
        return field(name, "has no value");
    };
    if value.len() > MAX_TEXT_BYTES {
        return field(name, "is too long");
    }
    match std::str::from_utf8(value) {
        Ok(text) => Ok(text),
        Err(_) => field(name, "is not UTF-8"),
    }
}

fn number<T: std::str::FromStr>(name: &'static str, value: Option<&[u8]>) -> Result<T, FrameError> {
    match text(name, value)?.parse() {
        Ok(number) => Ok(number),
        Err(_) => field(name, "is not a number of its range"),
    }
}

/// Calls `add` with each header of a frame, with the current hops and age.
pub(super) fn write(frame: &Frame, scratch: &mut String, mut add: impl FnMut(&'static str, &str)) {
    let mut put = |name, arguments: std::fmt::Arguments<'_>| {
        scratch.clear();
        // Writing to a string cannot fail.
        let _ = scratch.write_fmt(arguments);
        add(name, scratch);
    };
    put("blaze-version", format_args!("{VERSION}"));
    let origin = frame.origin();
    put(
        "blaze-origin",
        format_args!("{}/{}/{}/{}", origin.layer, origin.node, origin.service, origin.instance),
    );
    put("blaze-epoch", format_args!("{}", origin.epoch));
    put("blaze-writer", format_args!("{}", frame.writer()));
    put("blaze-sequence", format_args!("{}", frame.sequence()));
    put("blaze-time", format_args!("{}", frame.publish_time_ns()));
    put("blaze-encoding", format_args!("{}", frame.encoding()));
    put("blaze-age-us", format_args!("{}", frame.age_us()));
    put("blaze-hops", format_args!("{}", frame.hops()));
    if frame.lifespan_ms() > 0 {
        put("blaze-lifespan-ms", format_args!("{}", frame.lifespan_ms()));
    }
    if let Some(priority) = frame.priority() {
        put("blaze-priority", format_args!("{priority}"));
    }
    if frame.reliable() {
        put("blaze-reliable", format_args!("true"));
    }
    if frame.depth() > 0 {
        put("blaze-depth", format_args!("{}", frame.depth()));
    }
    if !frame.type_hash().is_empty() {
        put("blaze-type-hash", format_args!("{}", frame.type_hash()));
    }
    if let Some((writer, sequence)) = frame.related() {
        put("blaze-related-writer", format_args!("{writer}"));
        put("blaze-related-sequence", format_args!("{sequence}"));
    }
    if !frame.to().is_empty() {
        put("blaze-to", format_args!("{}", frame.to()));
    }
    if !frame.traceparent().is_empty() {
        put("traceparent", format_args!("{}", frame.traceparent()));
    }
}

/// As [`write()`], into what the client library takes.
pub(super) fn headers(frame: &Frame, scratch: &mut String) -> OwnedHeaders {
    let mut headers = Some(OwnedHeaders::new_with_capacity(18));
    write(frame, scratch, |key, value| {
        headers = headers
            .take()
            .map(|headers| headers.insert(rdkafka::message::Header { key, value: Some(value) }));
    });
    headers.unwrap_or_default()
}

/// The key of a record: those of one writer stay in order, and a compacted topic keeps the last
/// `depth` of each.
pub(super) fn key(writer: WriterId, sequence: u64, depth: u32) -> String {
    if depth == 0 { writer.to_string() } else { kept_key(writer, sequence % u64::from(depth)) }
}

/// The key of one of a writer's places in a compacted topic.
pub(super) fn kept_key(writer: WriterId, slot: u64) -> String {
    format!("{writer}/{slot}")
}

/// Whether a record of this key is kept for late joiners: all but the volatile ones that are
/// written here.
pub(super) fn is_kept(key: &[u8]) -> bool {
    !(key.len() == 32 && key.iter().all(u8::is_ascii_hexdigit))
}

/// The partition of a writer, for topics that keep: there a writer's records have several keys, and
/// must stay in order.
pub(super) fn partition_of(writer: WriterId, partitions: i32) -> i32 {
    let [a, b, c, d, ..] = writer.0;
    let spread = u32::from_be_bytes([a, b, c, d]) % u32::try_from(partitions.max(1)).unwrap_or(1);
    i32::try_from(spread).unwrap_or(0)
}

#[cfg(test)]
mod tests;
