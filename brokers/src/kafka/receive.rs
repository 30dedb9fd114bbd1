//! From a record to what readers get.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Instant;

use blaze_domain::WriterId;
use blaze_domain::names::ChannelName;
use blaze_proto::FrameError;
use bytes::Bytes;
use parking_lot::Mutex;
use rdkafka::message::{BorrowedMessage, Headers as _, Message as _, Timestamp};

use super::clock::BrokerClock;
use super::record;
use crate::port::{ConsumerOffset, Content, Received};

/// A record as it goes to readers.
pub(super) fn receive(
    channel: &ChannelName,
    message: &BorrowedMessage<'_>,
    payload: &[u8],
    identity: Option<(WriterId, u64)>,
    clock: &Mutex<BrokerClock>,
) -> Received {
    let at = Instant::now();
    let appended_ms = match message.timestamp() {
        Timestamp::LogAppendTime(appended) => Some(appended),
        Timestamp::CreateTime(_) | Timestamp::NotAvailable => None,
    };
    let broker_age_us = appended_ms.map_or(0, |appended| clock.lock().age_us(appended, at));
    let place = usize::try_from(message.partition()).ok().map(|partition| ConsumerOffset {
        partition,
        offset: message.offset(),
        appended_ms,
    });
    let payload = Bytes::copy_from_slice(payload);
    let content = if channel.is_reserved() {
        Content::Bare { payload, identity }
    } else {
        content_of(channel, message, payload, identity)
    };
    Received { content, at, broker_age_us, kept: false, place }
}

fn content_of(
    channel: &ChannelName,
    message: &BorrowedMessage<'_>,
    payload: Bytes,
    identity: Option<(WriterId, u64)>,
) -> Content {
    let Some(headers) = message.headers() else {
        return Content::Bare { payload, identity };
    };
    let bytes = payload.len();
    let read = || {
        let headers = (0..headers.count())
            .filter_map(|at| headers.try_get(at))
            .map(|header| (header.key, header.value));
        record::read(channel, headers, payload, identity)
    };
    // The client library panics over a header's name that is not UTF-8.
    catch_unwind(AssertUnwindSafe(read)).unwrap_or(Content::Malformed {
        error: FrameError::Field { field: "headers", reason: "have a name that is not UTF-8" },
        bytes,
    })
}
