//! The task that connects the lease book with the broker.

use std::sync::Arc;

use blaze_brokers::{Broker, BrokerError, Health, PublisherOptions, Received};
use blaze_domain::control::{Answer, ControlMessage, Event, EventKind};
use blaze_domain::names::ChannelName;
use bytes::Bytes;

use super::Shared;
pub(super) use crate::reserved::now;
use crate::reserved::{bare, reply_channel, subscribe, until};

const BATCH: usize = 256;

/// Runs until the broker is closed.
pub(super) async fn run(shared: Arc<Shared>, broker: Arc<dyn Broker>, own_reply: ChannelName) {
    if let Err(error) = drive(&shared, broker.as_ref(), own_reply).await {
        tracing::warn!(%error, "the service cannot reach flows any more");
    }
    shared.book.lock().close();
    shared.changed.notify_waiters();
}

async fn drive(
    shared: &Shared,
    broker: &dyn Broker,
    own_reply: ChannelName,
) -> Result<(), BrokerError> {
    let reply = reply_channel(broker.kind(), own_reply);
    let mut replies = subscribe(broker, &reply).await?;
    let mut events = subscribe(broker, &ChannelName::events()).await?;
    let control = broker.publisher(&ChannelName::control(), PublisherOptions::default())?;
    let mut status = broker.status();
    let mut was_up = status.borrow_and_update().health == Health::Up;
    let (mut answers, mut told) = (Vec::new(), Vec::new());
    loop {
        let (messages, next) = {
            let mut book = shared.book.lock();
            (book.poll(now()), book.next_due())
        };
        for payload in ControlMessage::to_payloads(&messages) {
            // Refused while the broker is away: the book sends again until there is an answer.
            control.publish_bare(&Bytes::from(payload), None);
        }
        shared.changed.notify_waiters();
        tokio::select! {
            count = replies.receive(&mut answers, BATCH) => {
                if count == 0 {
                    return Err(BrokerError::Closed);
                }
                on_answers(shared, answers.drain(..));
            }
            count = events.receive(&mut told, BATCH) => {
                if count == 0 {
                    return Err(BrokerError::Closed);
                }
                on_events(shared, told.drain(..));
            }
            changed = status.changed() => {
                if changed.is_err() {
                    return Err(BrokerError::Closed);
                }
                let is_up = status.borrow_and_update().health == Health::Up;
                if is_up && !was_up {
                    // What a flow said meanwhile was missed, and leases may have lapsed.
                    shared.book.lock().send_all_again(now());
                }
                was_up = is_up;
            }
            () = shared.wake.notified() => {}
            () = until(next) => {}
        }
    }
}

fn on_answers(shared: &Shared, answers: impl Iterator<Item = Received>) {
    for payload in answers.filter_map(bare) {
        let answers = Answer::read_all(&payload);
        let mut book = shared.book.lock();
        for answer in &answers {
            book.on_answer(answer, now());
        }
    }
}

fn on_events(shared: &Shared, events: impl Iterator<Item = Received>) {
    for event in events.filter_map(bare).flat_map(|payload| Event::read_all(&payload)) {
        if event.kind == EventKind::FlowStarted {
            shared.book.lock().send_all_again(now());
        }
        // Without a listener there is nobody to tell.
        let _ = shared.events.send(event);
    }
}
