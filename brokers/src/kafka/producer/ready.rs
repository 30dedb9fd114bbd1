//! From what waits to what the client takes.

use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;
use rdkafka::message::OwnedHeaders;

use super::delivery::{Delivery, Sent};
use crate::kafka::record;
use crate::kafka::settings::Lot;
use crate::kafka::topics::Topic;
use crate::outbox::{Body, Waiting};

/// How a record gets its key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::kafka) enum Keying {
    /// Its writer; and its place, where the topic keeps the last `depth` of each. Bare payloads
    /// have none.
    Writer {
        /// What the topic keeps of each writer.
        depth: u32,
    },
    /// The `id` of the answer that it is.
    AnswerId,
}

/// Where a lane's messages go.
#[derive(Debug)]
pub(in crate::kafka) struct Target {
    pub(in crate::kafka) topic: Arc<Topic>,
    pub(in crate::kafka) keying: Keying,
}

/// A message as the client takes it.
pub(super) struct Ready {
    pub(super) payload: Bytes,
    pub(super) key: Option<String>,
    pub(super) partition: Option<i32>,
    pub(super) headers: Option<OwnedHeaders>,
    pub(super) delivery: Box<Delivery>,
}

impl Ready {
    pub(super) fn new(lot: Lot, waiting: Waiting<Target>, scratch: &mut String) -> Self {
        let (bytes, target, sent) = (waiting.size(), Arc::clone(&waiting.to), Instant::now());
        let (payload, key, partition, headers);
        match &waiting.body {
            Body::Frame(frame) => {
                let frame = Waiting::<Target>::aged(frame, waiting.since, sent);
                let depth = match target.keying {
                    Keying::Writer { depth } => depth,
                    Keying::AnswerId => 0,
                };
                partition = (depth > 0).then(|| {
                    record::partition_of(frame.writer(), target.topic.partitions().unwrap_or(1))
                });
                key = Some(record::key(frame.writer(), frame.sequence(), depth));
                headers = Some(record::headers(&frame, scratch));
                payload = frame.payload().clone();
            }
            Body::Bare(bytes) => {
                partition = None;
                key = match target.keying {
                    Keying::Writer { .. } => None,
                    Keying::AnswerId => answer_id(bytes),
                };
                headers = None;
                payload = bytes.clone();
            }
        }
        let delivery = Box::new(Delivery {
            receipt: Sent::Message(waiting.into_receipt()),
            topic: Arc::clone(&target.topic),
            bytes,
            sent,
            which: target.topic.depart(lot, sent),
        });
        Self { payload, key, partition, headers, delivery }
    }
}

/// The record key of an answer: clients look for theirs by it.
fn answer_id(payload: &[u8]) -> Option<String> {
    let value: serde_json::Value = serde_json::from_slice(payload).ok()?;
    let answers = value.as_array().map_or(std::slice::from_ref(&value), Vec::as_slice);
    answers.iter().find_map(|answer| answer.get("id")?.as_str()).map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use blaze_domain::{Origin, WriterId};
    use blaze_proto::{Frame, Header};
    use rdkafka::message::Headers as _;

    use super::*;
    use crate::kafka::topics::Topics;
    use crate::outbox::{Outbox, OutboxLimits};
    use crate::port::PublishOutcome;

    #[test]
    fn the_age_of_a_record_has_what_it_waited_for_the_client() {
        let outbox =
            Outbox::new(OutboxLimits { lane_messages: 1, lane_bytes: 10_000, total_bytes: 10_000 });
        let (topic, _) = Topics::default().of(&Arc::from("imu.data"), false);
        let keying = Keying::Writer { depth: 0 };
        let lane = outbox.lane(Target { topic, keying }, None);
        let header = Header::new("imu/data", Origin::default(), WriterId([1; 16]), 1, 0);
        let frame = Frame::new(&header, Bytes::new()).unwrap().with_hops_and_age(0, 5_000);
        assert_eq!(lane.push(Body::Frame(frame), None), PublishOutcome::Taken);
        let mut taken = Vec::new();
        outbox.take(Instant::now(), 1, 10_000, &mut taken);
        let mut waiting = taken.pop().unwrap();
        waiting.since = waiting.since.checked_sub(Duration::from_millis(300)).unwrap();
        let headers = Ready::new(Lot::default(), waiting, &mut String::new()).headers.unwrap();
        let age = headers.iter().find(|header| header.key == "blaze-age-us").unwrap();
        let age: u64 = String::from_utf8_lossy(age.value.unwrap()).parse().unwrap();
        assert!((305_000..60_000_000).contains(&age), "{age} µs");
    }

    #[test]
    fn answers_have_their_id_as_the_key() {
        for (payload, id) in [
            (r#"{"id":"7","ok":true}"#, Some("7")),
            (r#"[{"ok":true},{"id":"8"},{"id":"9"}]"#, Some("8")),
            (r#"{"id":7}"#, None),
            ("[]", None),
            ("no JSON", None),
        ] {
            assert_eq!(answer_id(payload.as_bytes()).as_deref(), id, "{payload}");
        }
    }
}
