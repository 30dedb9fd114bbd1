//! The server goes away and comes back.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use super::Fixture;
use super::tools::{
    DEADLINE, Outcome, Reader, channel, connected, describe, eventually_within, frame, numbered,
    open_publisher, publish, tracked, wait_for_health, within, writer,
};
use blaze_brokers::port::{BrokerError, Content, Health, PublishOutcome, SubscribeOptions};

/// The status goes down and up again; what is published meanwhile is dropped or delivered, never
/// reordered nor delivered twice; afterwards the same subscription and publisher work as before.
///
/// # Errors
/// How the adapter breaks the rule.
pub async fn server_away_and_back(fixture: &dyn Fixture) -> Outcome {
    let capabilities = fixture.capabilities();
    if !capabilities.outage {
        return Ok(());
    }
    let channel = channel("outage")?;
    let clients = [connected(fixture).await?, connected(fixture).await?];
    let mut reader = Reader::open(clients[0].as_ref(), &channel).await?;
    let publisher = open_publisher(clients[1].as_ref(), &channel)?;
    reader.meet(fixture, publisher.as_ref(), false).await?;
    let mut taken_away = Vec::new();
    let mut sequence = 0;
    let mut last = 0;
    for _round in 0..2 {
        for _ in 0..50 {
            sequence += 1;
            publish(publisher.as_ref(), &numbered(&channel, writer(1), sequence)?)?;
        }
        while last < sequence {
            last = ascending(&mut reader, last).await?;
        }
        fixture.stop_server().await?;
        for client in &clients {
            wait_for_health(client.as_ref(), Health::Down).await?;
        }
        let newcomer = fixture.broker().await?;
        if !capabilities.keeps_while_away {
            let refused = clients[0].subscribe(&channel, SubscribeOptions::default()).await;
            if !matches!(refused, Err(BrokerError::Away(_))) {
                return Err("a reader was let in though the server is away".to_owned());
            }
        }
        let dropped_before = publisher.later().dropped();
        for _ in 0..20 {
            sequence += 1;
            if publisher.publish(&numbered(&channel, writer(1), sequence)?, None)
                == PublishOutcome::Taken
            {
                taken_away.push(sequence);
            }
        }
        fixture.start_server().await?;
        for client in clients.iter().chain([&newcomer]) {
            wait_for_health(client.as_ref(), Health::Up).await?;
        }
        // The adapter may subscribe again only a moment after it is up: until one arrives, publish
        // on.
        let last_away = sequence;
        let until = Instant::now() + DEADLINE;
        while last <= last_away {
            sequence += 1;
            publisher.publish(&numbered(&channel, writer(1), sequence)?, None);
            if let Some(found) = arrived(&mut reader, last).await? {
                if capabilities.keeps_while_away && publisher.later().dropped() == dropped_before {
                    taken_away.retain(|sequence| *sequence != found);
                }
                last = found;
            }
            if Instant::now() > until {
                return Err("after the server came back, nothing was received any more".to_owned());
            }
        }
        if capabilities.keeps_while_away
            && publisher.later().dropped() == dropped_before
            && !taken_away.is_empty()
        {
            return Err(format!(
                "taken while the server was away and not counted as dropped, but lost: \
                 {taken_away:?}"
            ));
        }
        taken_away.clear();
    }
    Ok(())
}

/// The sequence of the next message, which must be above `last`.
async fn ascending(reader: &mut Reader, last: u64) -> Outcome<u64> {
    let found = reader.next_frame("a message while the server is up").await?.sequence();
    above(found, last)
}

/// As [`ascending`], if a message comes within a moment.
async fn arrived(reader: &mut Reader, last: u64) -> Outcome<Option<u64>> {
    match reader.next_soon().await? {
        None => Ok(None),
        Some(message) => match message.content {
            Content::Frame(frame) => above(frame.sequence(), last).map(Some),
            other => Err(format!("a frame was expected, but it was {}", describe(&other))),
        },
    }
}

fn above(found: u64, last: u64) -> Outcome<u64> {
    if found > last {
        Ok(found)
    } else {
        Err(format!("after {last} came {found}: reordered or delivered twice"))
    }
}

/// Publishing to a server that went away returns at once, and what waits for it is bounded.
///
/// # Errors
/// How the adapter breaks the rule.
pub async fn publishing_never_waits(fixture: &dyn Fixture) -> Outcome {
    const MESSAGES: u64 = 4_096;
    const SIZE: usize = 65_536;
    let capabilities = fixture.capabilities();
    if !capabilities.outage {
        return Ok(());
    }
    let channel = channel("never-waits")?;
    let client = connected(fixture).await?;
    let publisher = open_publisher(client.as_ref(), &channel)?;
    fixture.stop_server().await?;
    let alive = Arc::new(AtomicUsize::new(0));
    let (done, ended) = tokio::sync::oneshot::channel();
    let thread = {
        let (publisher, alive) = (Arc::clone(&publisher), Arc::clone(&alive));
        // A thread of its own: if publishing waited, the test would still end.
        std::thread::spawn(move || {
            let mut slowest = Duration::ZERO;
            let outcome: Outcome = (1..=MESSAGES).try_for_each(|sequence| {
                let payload = tracked(vec![b'x'; SIZE], &alive);
                let frame = frame(&channel, writer(1), sequence, payload)?;
                let start = Instant::now();
                publisher.publish(&frame, None);
                slowest = slowest.max(start.elapsed());
                Ok(())
            });
            let _ = done.send(outcome.map(|()| slowest));
        })
    };
    let slowest = within("publishing 4,096 messages to a server that is away", ended)
        .await?
        .map_err(|_| "publishing panicked".to_owned())??;
    let _ = thread.join();
    if slowest > Duration::from_secs(1) {
        return Err(format!("one publish took {slowest:?}"));
    }
    // One message may be in the adapter's hands beside the queue.
    let most = capabilities.queue_bytes + SIZE;
    eventually_within(
        Duration::from_secs(2),
        &format!("at most {most} bytes wait for the server"),
        || alive.load(Ordering::SeqCst) <= most,
    )
    .await?;
    fixture.start_server().await?;
    wait_for_health(client.as_ref(), Health::Up).await
}
