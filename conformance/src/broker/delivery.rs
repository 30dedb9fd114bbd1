//! What is published arrives, as it is and in order.

use std::collections::HashMap;
use std::sync::Arc;

use blaze_domain::names::ChannelName;
use blaze_domain::{MAX_PAYLOAD_BYTES, TopicName, WriterId};
use bytes::Bytes;

use super::Fixture;
use super::tools::{
    DEADLINE, Outcome, Reader, channel, connected, describe, frame, numbered, open_publisher,
    open_publisher_with, pattern, publish, writer,
};
use blaze_brokers::port::{Broker, Content, PublishOutcome, Publisher, PublisherOptions};

const SIZES: &[usize] =
    &[1, 2, 100, 1_023, 65_535, 65_536, 1_048_576, 8_000_000, MAX_PAYLOAD_BYTES];

/// Four writers on two clients publish at once: everyone's messages arrive completely and in order.
///
/// # Errors
/// How the adapter breaks the rule.
pub async fn order_per_writer(fixture: &dyn Fixture) -> Outcome {
    const WRITERS: u8 = 4;
    const MESSAGES: u64 = 500;
    let channel = channel("order")?;
    let clients = [connected(fixture).await?, connected(fixture).await?];
    let mut reader = Reader::open(clients[0].as_ref(), &channel).await?;
    let mut threads = Vec::new();
    for number in 1..=WRITERS {
        // Best effort may lose some of so many at once.
        let reliable = PublisherOptions { reliable: true, ..PublisherOptions::default() };
        let publisher =
            open_publisher_with(clients[usize::from(number) % 2].as_ref(), &channel, reliable)?;
        reader.meet(fixture, publisher.as_ref(), false).await?;
        let channel = channel.clone();
        threads.push(std::thread::spawn(move || {
            (1..=MESSAGES).try_for_each(|sequence| {
                publish(publisher.as_ref(), &numbered(&channel, writer(number), sequence)?)
            })
        }));
    }
    let mut last: HashMap<WriterId, u64> = HashMap::new();
    for _ in 0..u64::from(WRITERS) * MESSAGES {
        let frame =
            reader.next_frame(&format!("2,000 messages of four writers, so far {last:?}")).await?;
        let last = last.entry(frame.writer()).or_default();
        if frame.sequence() != *last + 1 {
            return Err(format!(
                "after {last} of writer {} came {}",
                frame.writer(),
                frame.sequence()
            ));
        }
        *last = frame.sequence();
    }
    for thread in threads {
        thread.join().map_err(|_| "publishing panicked".to_owned())??;
    }
    Ok(())
}

/// A client receives what it publishes itself, exactly once.
///
/// # Errors
/// How the adapter breaks the rule.
pub async fn own_publications_are_seen(fixture: &dyn Fixture) -> Outcome {
    let channel = channel("own")?;
    let client = connected(fixture).await?;
    let mut reader = Reader::open(client.as_ref(), &channel).await?;
    let publisher = open_publisher(client.as_ref(), &channel)?;
    reader.meet(fixture, publisher.as_ref(), false).await?;
    for sequence in 1..=3 {
        publish(publisher.as_ref(), &numbered(&channel, writer(1), sequence)?)?;
        let found = reader.next_frame("a client's own publication").await?.sequence();
        if found != sequence {
            return Err(format!("message {sequence} was expected, but it was {found}"));
        }
    }
    match reader.next_soon().await? {
        Some(message) => Err(format!("one too many: {}", describe(&message.content))),
        None => Ok(()),
    }
}

/// Payloads of 1 B to 16 MiB, the most that a message may have, arrive with every byte and the
/// whole header.
///
/// # Errors
/// How the adapter breaks the rule.
pub async fn framed_payloads_arrive_as_they_are(fixture: &dyn Fixture) -> Outcome {
    let channel = channel("framed")?;
    let (mut reader, publisher, _clients) = apart(fixture, &channel, false).await?;
    for (sequence, size) in (1..).zip(sizes(fixture)) {
        let sent =
            frame(&channel, writer(1), sequence, pattern(size, 1))?.with_hops_and_age(3, 4_567);
        publish(publisher.as_ref(), &sent)?;
        let found = reader.next_frame(&format!("a frame with {size} bytes")).await?;
        if found.payload() != sent.payload() {
            return Err(format!(
                "a payload of {size} bytes came with {} other bytes",
                found.payload().len()
            ));
        }
        let facts = |frame: &blaze_proto::Frame| {
            format!(
                "topic {:?}, {:?}, writer {}, sequence {}, time {}, encoding {:?}, hops {}",
                frame.topic(),
                frame.origin(),
                frame.writer(),
                frame.sequence(),
                frame.publish_time_ns(),
                frame.encoding(),
                frame.hops()
            )
        };
        if facts(&found) != facts(&sent) {
            return Err(format!("sent was {}, but received {}", facts(&sent), facts(&found)));
        }
        // The age grows by what the message waited for its adapter.
        let waited = found.age_us().checked_sub(sent.age_us());
        if waited.is_none_or(|waited| u128::from(waited) > DEADLINE.as_micros()) {
            return Err(format!(
                "sent with an age of {} µs, it came with {} µs",
                sent.age_us(),
                found.age_us()
            ));
        }
    }
    Ok(())
}

/// Payloads without a header arrive as they are, and as bare.
///
/// # Errors
/// How the adapter breaks the rule.
pub async fn bare_payloads_arrive_as_they_are(fixture: &dyn Fixture) -> Outcome {
    if !fixture.capabilities().bare {
        return Ok(());
    }
    let channel = channel("bare")?;
    let (mut reader, publisher, _clients) = apart(fixture, &channel, true).await?;
    for size in sizes(fixture) {
        let sent = pattern(size, 2);
        publish_bare(publisher.as_ref(), &sent)?;
        if reader.next_bare(&format!("a bare payload of {size} bytes")).await? != sent {
            return Err(format!("a bare payload of {size} bytes came with other bytes"));
        }
    }
    Ok(())
}

/// Control messages, events and replies are JSON on the server, byte for byte.
///
/// # Errors
/// How the adapter breaks the rule.
pub async fn reserved_channels_carry_json_as_it_is(fixture: &dyn Fixture) -> Outcome {
    let json =
        Bytes::from_static(br#"{"op":"withdraw",  "topic":"imu/data","service":"imu-driver"}"#);
    let reply: ChannelName =
        "blaze/reply/conformance-0".parse().map_err(|error| format!("{error}"))?;
    for channel in [ChannelName::control(), ChannelName::events(), reply] {
        let (mut reader, publisher, _clients) = apart(fixture, &channel, true).await?;
        publish_bare(publisher.as_ref(), &json)?;
        if reader.next_bare(&format!("JSON on {channel}")).await? != json {
            return Err(format!("JSON on {channel} came with other bytes"));
        }
    }
    let topic: TopicName = "imu/data".parse().map_err(|error| format!("{error}"))?;
    let channel = ChannelName::json(&topic);
    let (mut reader, publisher, _clients) = apart(fixture, &channel, true).await?;
    let copy = frame(&channel, writer(1), 1, json.clone())?;
    let outcome = publisher.publish_copy(&copy, None);
    if outcome != PublishOutcome::Taken || reader.next_bare("a copy as JSON").await? != json {
        return Err(format!("a copy on {channel} was {outcome:?}, or came with other bytes"));
    }
    Ok(())
}

/// What begins with `BLZ1` and is no frame is reported as malformed, never as bare, and what
/// follows still arrives.
///
/// # Errors
/// How the adapter breaks the rule.
pub async fn malformed_frames_are_reported(fixture: &dyn Fixture) -> Outcome {
    let capabilities = fixture.capabilities();
    if !capabilities.malformed || !capabilities.bare {
        return Ok(());
    }
    let channel = channel("malformed")?;
    let (mut reader, publisher, _clients) = apart(fixture, &channel, false).await?;
    let bad: &[&[u8]] = &[
        b"BLZ1",
        b"BLZ1\x02",
        b"BLZ1\xff\xff\xff\xff",
        b"BLZ1\x00\x00\x00\x00payload",
        b"BLZ1\x03\x00\x00\x00\xff\xff\xffpayload",
    ];
    for (sequence, bytes) in (1..).zip(bad) {
        let shown = bytes.escape_ascii();
        publish_bare(publisher.as_ref(), &Bytes::from_static(bytes))?;
        let found = reader.next(&format!("malformed {shown}")).await?.content;
        if !matches!(&found, Content::Malformed { bytes: size, .. } if *size == bytes.len()) {
            return Err(format!("{shown} was taken as {}", describe(&found)));
        }
        publish(publisher.as_ref(), &numbered(&channel, writer(1), sequence)?)?;
        reader.next_frame(&format!("a good frame after {shown}")).await?;
    }
    Ok(())
}

/// A payload above the limit is refused at once, and the publisher goes on.
///
/// # Errors
/// How the adapter breaks the rule.
pub async fn too_large_is_refused(fixture: &dyn Fixture) -> Outcome {
    if !fixture.capabilities().bare {
        return Ok(());
    }
    let channel = channel("too-large")?;
    let (mut reader, publisher, _clients) = apart(fixture, &channel, true).await?;
    let outcome = publisher.publish_bare(&Bytes::from(vec![0; MAX_PAYLOAD_BYTES + 1]), None);
    if outcome != PublishOutcome::TooLarge {
        return Err(format!("one byte more than {MAX_PAYLOAD_BYTES} was {outcome:?}"));
    }
    let small = pattern(10, 3);
    publish_bare(publisher.as_ref(), &small)?;
    if reader.next_bare("a small payload after one too large").await? != small {
        return Err("something else than the small payload arrived".to_owned());
    }
    Ok(())
}

/// Many channels at once: each reader gets its own channel's message and no other.
///
/// # Errors
/// How the adapter breaks the rule.
pub async fn many_channels_stay_apart(fixture: &dyn Fixture) -> Outcome {
    let clients = [connected(fixture).await?, connected(fixture).await?];
    let mut open: Vec<(ChannelName, Reader, Arc<dyn Publisher>)> = Vec::new();
    for _ in 0..fixture.capabilities().channels {
        let channel = channel("many")?;
        let mut reader = Reader::open(clients[0].as_ref(), &channel).await?;
        let publisher = open_publisher(clients[1].as_ref(), &channel)?;
        reader.meet(fixture, publisher.as_ref(), false).await?;
        open.push((channel, reader, publisher));
    }
    for (channel, _, publisher) in &open {
        publish(publisher.as_ref(), &numbered(channel, writer(1), 1)?)?;
        publish(publisher.as_ref(), &numbered(channel, writer(1), 2)?)?;
    }
    for (channel, reader, _) in &mut open {
        for sequence in 1..=2 {
            let found = reader.next_frame(&format!("a message on {channel}")).await?;
            if found.topic() != channel.as_str() || found.sequence() != sequence {
                return Err(format!(
                    "{channel} received message {} of {}, not its own {sequence}",
                    found.sequence(),
                    found.topic()
                ));
            }
        }
    }
    Ok(())
}

fn sizes(fixture: &dyn Fixture) -> impl Iterator<Item = usize> {
    let largest = fixture.capabilities().largest_payload;
    SIZES.iter().copied().filter(move |size| *size <= largest)
}

fn publish_bare(publisher: &dyn Publisher, payload: &Bytes) -> Outcome {
    match publisher.publish_bare(payload, None) {
        PublishOutcome::Taken => Ok(()),
        other => Err(format!(
            "a bare payload of {} bytes was {other:?}, though the server is up",
            payload.len()
        )),
    }
}

type Clients = [Arc<dyn Broker>; 2];

/// A reader on one client and a publisher on another.
async fn apart(
    fixture: &dyn Fixture,
    channel: &ChannelName,
    bare: bool,
) -> Outcome<(Reader, Arc<dyn Publisher>, Clients)> {
    let clients = [connected(fixture).await?, connected(fixture).await?];
    let mut reader = Reader::open(clients[0].as_ref(), channel).await?;
    let publisher = open_publisher(clients[1].as_ref(), channel)?;
    reader.meet(fixture, publisher.as_ref(), bare).await?;
    Ok((reader, publisher, clients))
}
