//! Slow readers, readers that leave, readers that come late.

use std::sync::Arc;

use bytes::Bytes;

use super::Fixture;
use super::tools::{
    Outcome, Reader, channel, connected, describe, eventually, frame, numbered, numbered_to_keep,
    open_publisher, open_publisher_with, publish, writer,
};
use blaze_brokers::port::{Broker, Content, PublisherOptions, SubscribeOptions};

/// A reader that does not read holds no more messages than it asked for; the newest stay, the
/// others are counted.
///
/// # Errors
/// How the adapter breaks the rule.
pub async fn slow_readers_are_bounded_in_messages(fixture: &dyn Fixture) -> Outcome {
    let options = SubscribeOptions { max_messages: 100, ..SubscribeOptions::default() };
    slow_reader(fixture, options, 10, 100).await
}

/// A reader that does not read holds no more bytes than it asked for; the newest stay, the others
/// are counted.
///
/// # Errors
/// How the adapter breaks the rule.
pub async fn slow_readers_are_bounded_in_bytes(fixture: &dyn Fixture) -> Outcome {
    let options = SubscribeOptions { max_bytes: 100_000, ..SubscribeOptions::default() };
    slow_reader(fixture, options, 10_000, 10).await
}

async fn slow_reader(
    fixture: &dyn Fixture,
    options: SubscribeOptions,
    size: usize,
    most: u64,
) -> Outcome {
    const MESSAGES: u64 = 1_000;
    let channel = channel("slow")?;
    let client = connected(fixture).await?;
    let mut slow = Reader::open_with(client.as_ref(), &channel, options).await?;
    let mut witness = Reader::open(client.as_ref(), &channel).await?;
    let publisher = open_publisher(client.as_ref(), &channel)?;
    slow.meet(fixture, publisher.as_ref(), false).await?;
    witness.meet(fixture, publisher.as_ref(), false).await?;
    slow.skip_probes(fixture).await;
    let payload = Bytes::from(vec![b'x'; size]);
    for sequence in 1..=MESSAGES {
        publish(publisher.as_ref(), &frame(&channel, writer(1), sequence, payload.clone())?)?;
        // The witness keeps pace, so that it is the slow reader alone that loses.
        if sequence % 50 == 0 {
            while witness
                .next_frame("a message for the reader beside the slow one")
                .await?
                .sequence()
                < sequence
            {}
        }
    }
    let mut dropped = 0;
    eventually("the slow reader's losses are counted", || {
        dropped += slow.take_dropped();
        dropped + most >= MESSAGES
    })
    .await?;
    let mut found = Vec::new();
    while found.last() != Some(&MESSAGES) {
        found.push(slow.next_frame("the newest message for a slow reader").await?.sequence());
        dropped += slow.take_dropped();
    }
    let count = found.len() as u64;
    if count > most {
        return Err(format!("{count} messages waited, at most {most} were allowed"));
    }
    if count + dropped != MESSAGES {
        return Err(format!("{count} received and {dropped} counted as dropped, of {MESSAGES}"));
    }
    let newest: Vec<u64> = (MESSAGES - count + 1..=MESSAGES).collect();
    if found != newest {
        return Err(format!("the newest {count} should have stayed, but it was {found:?}"));
    }
    Ok(())
}

/// A dropped subscription is one less at the server, and frees its messages; the channel can be
/// read again.
///
/// # Errors
/// How the adapter breaks the rule.
pub async fn dropping_a_subscription_unsubscribes(fixture: &dyn Fixture) -> Outcome {
    let channel = channel("leave")?;
    let clients = [connected(fixture).await?, connected(fixture).await?];
    let publisher = open_publisher(clients[1].as_ref(), &channel)?;
    for round in 1..=3 {
        let mut first = Reader::open(clients[0].as_ref(), &channel).await?;
        let mut second = Reader::open(clients[0].as_ref(), &channel).await?;
        first.meet(fixture, publisher.as_ref(), false).await?;
        publish(publisher.as_ref(), &numbered(&channel, writer(1), 2 * round)?)?;
        first.next_frame("a message for the first of two readers").await?;
        drop(first);
        publish(publisher.as_ref(), &numbered(&channel, writer(1), 2 * round + 1)?)?;
        for expected in [2 * round, 2 * round + 1] {
            let found = second
                .next_frame("a message for the second reader, after the first left")
                .await?
                .sequence();
            if found != expected {
                return Err(format!(
                    "message {expected} was expected after the other reader left, but it was \
                     {found}"
                ));
            }
        }
        drop(second);
        wait_for_no_reader(fixture, &channel).await?;
    }
    Ok(())
}

async fn wait_for_no_reader(
    fixture: &dyn Fixture,
    channel: &blaze_domain::names::ChannelName,
) -> Outcome {
    let until = std::time::Instant::now() + super::tools::DEADLINE;
    while let Some(readers) = fixture.readers_of(channel).await {
        if readers == 0 {
            break;
        }
        if std::time::Instant::now() > until {
            return Err(format!(
                "the server still has {readers} readers of {channel}, though all subscriptions \
                 were dropped"
            ));
        }
        tokio::time::sleep(std::time::Duration::from_millis(10)).await;
    }
    Ok(())
}

/// A late joiner that asks for it begins with the last `depth` of every writer, in order, and goes
/// on with what is published next; one that does not ask begins with the latter. A kept message may
/// also come once more as a live one.
///
/// # Errors
/// How the adapter breaks the rule.
pub async fn late_joiners_get_what_is_kept(fixture: &dyn Fixture) -> Outcome {
    if !fixture.capabilities().keeps_last {
        return Ok(());
    }
    let channel = channel("kept")?;
    let clients = [connected(fixture).await?, connected(fixture).await?];
    let mut witness = Reader::open(clients[1].as_ref(), &channel).await?;
    let options = PublisherOptions { depth: 3, reliable: true, large: false };
    let publishers = [
        open_publisher_with(clients[0].as_ref(), &channel, options)?,
        open_publisher_with(clients[0].as_ref(), &channel, options)?,
    ];
    for publisher in &publishers {
        witness.meet(fixture, publisher.as_ref(), false).await?;
    }
    for sequence in 1..=5 {
        for (number, publisher) in (1..).zip(&publishers) {
            let frame = numbered_to_keep(&channel, writer(number), sequence, options.depth)?;
            publish(publisher.as_ref(), &frame)?;
            witness.next_frame("a message of a writer that keeps three").await?;
        }
    }
    // Time itself is what tells the one from the other here.
    tokio::time::sleep(fixture.capabilities().clocks_apart).await;
    // Fewer than are kept: they raise the bound, but for probes there must be room.
    let max_messages = if fixture.capabilities().finds_readers_late { 4096 } else { 2 };
    let with_kept =
        SubscribeOptions { with_kept: true, max_messages, ..SubscribeOptions::default() };
    let late_client: Arc<dyn Broker> = connected(fixture).await?;
    let mut late = Reader::open_with(late_client.as_ref(), &channel, with_kept).await?;
    let mut plain = Reader::open(late_client.as_ref(), &channel).await?;
    for publisher in &publishers {
        late.meet(fixture, publisher.as_ref(), false).await?;
        plain.meet(fixture, publisher.as_ref(), false).await?;
    }
    for (number, publisher) in (1..).zip(&publishers) {
        let frame = numbered_to_keep(&channel, writer(number), 6, options.depth)?;
        publish(publisher.as_ref(), &frame)?;
    }
    for _ in 1..=2 {
        let first = plain.next_frame("a live message for a late joiner").await?;
        if first.sequence() != 6 {
            return Err(format!(
                "a late joiner that did not ask for kept messages got {}",
                describe(&Content::Frame(first))
            ));
        }
    }
    let mut found: [Vec<u64>; 2] = Default::default();
    while found.iter().any(|sequences| sequences.last() != Some(&6)) {
        let what = format!("kept messages 3, 4, 5 and the live 6 of two writers, so far {found:?}");
        let frame = late.next_frame(&what).await?;
        let sequences = &mut found[usize::from(frame.writer() != writer(1))];
        if !sequences.contains(&frame.sequence()) {
            sequences.push(frame.sequence());
        }
    }
    if found.iter().any(|sequences| sequences[..] != [3, 4, 5, 6]) {
        return Err(format!("of each writer 3, 4, 5, 6 were expected, but it was {found:?}"));
    }
    Ok(())
}
