//! The task that connects the state machine with the broker.

use blaze_brokers::{BrokerError, Health, Received};
use blaze_domain::names::ChannelName;
use bytes::Bytes;

use super::{ConfigChange, Shared};
use crate::reserved::{bare, channel, now, reply_channel, speaking, subscribe, until};

const GET: &str = "blaze/config/get";
const CHANGED: &str = "blaze/config/changed";
const BATCH: usize = 64;

/// Runs until the broker is closed.
pub(super) async fn run(shared: &Shared, own_reply: ChannelName) {
    shared.wanted.notified().await;
    if let Err(error) = drive(shared, own_reply).await {
        tracing::warn!(%error, "the service hears nothing of its configuration any more");
    }
}

async fn drive(shared: &Shared, own_reply: ChannelName) -> Result<(), BrokerError> {
    let broker = shared.broker.as_ref();
    // Both are heard before the first request is sent, so that nothing falls between an answer and
    // the notices after it.
    let mut replies = subscribe(broker, &reply_channel(broker.kind(), own_reply)).await?;
    let mut notices =
        subscribe(broker, &channel(&format!("{CHANGED}/{}", shared.identity.service))?).await?;
    let requests = broker.publisher(&channel(GET)?, speaking(broker.kind()))?;
    let mut status = broker.status();
    let mut was_up = status.borrow_and_update().health == Health::Up;
    let (mut answered, mut told) = (Vec::new(), Vec::new());
    loop {
        let (request, next) = {
            let mut book = shared.book.lock();
            (book.poll(now()), book.next_due())
        };
        if let Some(request) = request {
            // Refused while the broker is away: it is asked again until there is an answer.
            requests.publish_bare(&Bytes::from(request), None);
        }
        tokio::select! {
            count = replies.receive(&mut answered, BATCH) => {
                if count == 0 {
                    return Err(BrokerError::Closed);
                }
                shared.take(answered.drain(..), |book, payload| book.on_reply(payload, now()));
            }
            count = notices.receive(&mut told, BATCH) => {
                if count == 0 {
                    return Err(BrokerError::Closed);
                }
                shared.take(told.drain(..), |book, payload| book.on_notice(payload, now()));
                if notices.take_dropped() > 0 {
                    shared.book.lock().ask_now(now());
                }
            }
            changed = status.changed() => {
                if changed.is_err() {
                    return Err(BrokerError::Closed);
                }
                let is_up = status.borrow_and_update().health == Health::Up;
                if is_up && !was_up {
                    // What was told meanwhile was missed.
                    shared.book.lock().ask_now(now());
                }
                was_up = is_up;
            }
            () = until(Some(next)) => {}
        }
    }
}

impl Shared {
    /// Takes messages in and tells of each change that they make.
    fn take(
        &self,
        messages: impl Iterator<Item = Received>,
        mut on: impl FnMut(&mut super::ConfigBook, &[u8]) -> Option<ConfigChange>,
    ) {
        for payload in messages.filter_map(bare) {
            let (change, standing, refusal) = {
                let mut book = self.book.lock();
                let change = on(&mut book, &payload);
                let refusal =
                    book.refusal().map(|refusal| format!("{}: {}", refusal.code, refusal.detail));
                (change, book.standing().clone(), refusal)
            };
            self.shown.send_if_modified(|shown| {
                let is_other = shown.standing != standing || shown.refusal != refusal;
                (shown.standing, shown.refusal) = (standing, refusal);
                is_other
            });
            // After it is shown: a callback that reads the value finds this one or a newer one.
            if let Some(change) = change {
                self.listeners.tell(&change);
            }
        }
    }
}
