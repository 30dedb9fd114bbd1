//! A client is closed.

use super::Fixture;
use super::tools::{
    Outcome, Reader, channel, connected, eventually, numbered, open_publisher, publish,
    wait_for_health, within, writer,
};
use blaze_brokers::port::{
    BrokerError, Health, PublishOutcome, PublisherOptions, SubscribeOptions,
};

/// Closing delivers what was taken, ends the client's own readers, and refuses what comes later;
/// other clients go on.
///
/// # Errors
/// How the adapter breaks the rule.
pub async fn close_delivers_and_ends(fixture: &dyn Fixture) -> Outcome {
    const MESSAGES: u64 = 100;
    let channel = channel("close")?;
    let closing = connected(fixture).await?;
    let staying = connected(fixture).await?;
    let mut own = Reader::open(closing.as_ref(), &channel).await?;
    let mut other = Reader::open(staying.as_ref(), &channel).await?;
    let publisher = open_publisher(closing.as_ref(), &channel)?;
    own.meet(fixture, publisher.as_ref(), false).await?;
    other.meet(fixture, publisher.as_ref(), false).await?;
    for sequence in 1..=MESSAGES {
        publish(publisher.as_ref(), &numbered(&channel, writer(1), sequence)?)?;
    }
    within("closing a client", closing.close()).await?;
    for sequence in 1..=MESSAGES {
        let found = other
            .next_frame("a message that was taken before the client was closed")
            .await
            .map_err(|error| {
                format!("message {sequence} of {MESSAGES}: {error}; later: {:?}", publisher.later())
            })?
            .sequence();
        if found != sequence {
            return Err(format!("message {sequence} was expected, but it was {found}"));
        }
    }
    while own.next_or_end("the closed client's reader ends").await?.is_some() {}
    wait_for_health(closing.as_ref(), Health::Closed).await?;
    let outcome = publisher.publish(&numbered(&channel, writer(1), MESSAGES + 1)?, None);
    if outcome != PublishOutcome::Dropped {
        return Err(format!("publishing on a closed client was {outcome:?}, not dropped"));
    }
    match closing.subscribe(&channel, SubscribeOptions::default()).await {
        Err(BrokerError::Closed) => {}
        Err(error) => return Err(format!("subscribing on a closed client: {error}")),
        Ok(_) => return Err("a closed client could be subscribed".to_owned()),
    }
    match closing.publisher(&channel, PublisherOptions::default()) {
        Err(BrokerError::Closed) => {}
        Err(error) => return Err(format!("a publisher of a closed client: {error}")),
        Ok(_) => return Err("a closed client gave a publisher".to_owned()),
    }
    let again = open_publisher(staying.as_ref(), &channel)?;
    other.meet(fixture, again.as_ref(), false).await?;
    publish(again.as_ref(), &numbered(&channel, writer(2), 1)?)?;
    let found = other.next_frame("a message after another client was closed").await?;
    if found.writer() != writer(2) {
        return Err("a message that was published after closing was delivered".to_owned());
    }
    within("closing a client twice", closing.close()).await
}

/// A client that was closed, or only dropped, leaves no task, reader or connection behind.
///
/// # Errors
/// How the adapter breaks the rule.
pub async fn close_leaves_nothing_behind(fixture: &dyn Fixture) -> Outcome {
    let tasks = || tokio::runtime::Handle::current().metrics().num_alive_tasks();
    let before = tasks();
    for close_first in [true, false] {
        let channel = channel("nothing-left")?;
        let client = connected(fixture).await?;
        let mut reader = Reader::open(client.as_ref(), &channel).await?;
        let publisher = open_publisher(client.as_ref(), &channel)?;
        reader.meet(fixture, publisher.as_ref(), false).await?;
        publish(publisher.as_ref(), &numbered(&channel, writer(1), 1)?)?;
        reader.next_frame("a message before closing").await?;
        if close_first {
            within("closing a client", client.close()).await?;
        }
        drop(client);
        let how = if close_first { "closed" } else { "dropped" };
        while reader.next_or_end(&format!("the reader of a {how} client ends")).await?.is_some() {}
        let outcome = publisher.publish(&numbered(&channel, writer(1), 2)?, None);
        if outcome != PublishOutcome::Dropped {
            return Err(format!("publishing on a {how} client was {outcome:?}"));
        }
        eventually(&format!("all tasks of a {how} client end"), || tasks() <= before).await?;
        let left = fixture.leftovers().await;
        if !left.is_empty() {
            return Err(format!("a {how} client left behind: {}", left.join(", ")));
        }
    }
    Ok(())
}
