//! Requests of services.

use blaze_domain::config::secret;
use bytes::Bytes;
use tokio::time::Instant;

use super::{Engine, now};
use crate::core::messages::{self, GetRequest, RefusedRequest};
use crate::core::{Freshness, Reply, answer};

impl Engine {
    pub(super) fn on_get(&mut self, request: &[u8]) {
        let shared = self.outputs.replies.shared();
        let (to, text) = match GetRequest::parse(request) {
            Ok(request) => {
                let reply = self.reply_to(&request);
                self.note_new_places();
                if self.served.has_pending() {
                    self.flush_soon();
                }
                if !self.is_leader() {
                    // That somebody asked is good to know for whoever takes over.
                    self.counts.left_to_others += 1;
                    return;
                }
                let id = request.id.as_deref();
                let text = messages::reply(&reply, id, self.identity.delivery, self.freshness());
                self.key_of_asker(&request);
                (Some((request.reply_to, request.id)), text)
            }
            Err(RefusedRequest { id, reply_to, error }) => {
                self.counts.refused += 1;
                if !self.is_leader() {
                    return;
                }
                let text = messages::refusal(&error, id.as_deref());
                // Whoever says nothing that can be read hears of it where answers go that nobody
                // chose.
                let can_tell = id.is_some() || shared.is_none();
                let to = reply_to.or_else(|| can_tell.then(messages::default_reply).flatten());
                (to.map(|to| (to, id)), text)
            }
        };
        let Some((to, id)) = to else { return };
        let to = match shared {
            // Nobody could tell whose answer it is.
            Some(_) if id.is_none() => {
                self.counts.refused += 1;
                return;
            }
            Some(shared) => shared,
            None => to,
        };
        match self.outputs.replies.reply(&to, Bytes::from(text)) {
            Ok(()) => self.counts.answered += 1,
            Err(error) => {
                self.counts.refused += 1;
                tracing::debug!(error, %to, "an answer was not sent");
            }
        }
    }

    /// What a request gets. Who was given a configuration without the texts of its secrets has the
    /// right hash, and yet not what it needs.
    fn reply_to(&mut self, request: &GetRequest) -> Reply {
        let now = Instant::now();
        let reply = answer(&mut self.served, request, now.into_std());
        if matches!(reply, Reply::Unchanged { .. })
            && self.texts_until.is_some_and(|until| now < until)
        {
            let anew = GetRequest { hash: None, ..request.clone() };
            let whole = answer(&mut self.served, &anew, now.into_std());
            if let Reply::Standing(standing) = &whole
                && secret::contains(standing.config.value())
            {
                return whole;
            }
        }
        reply
    }

    pub(super) fn freshness(&self) -> Freshness {
        Freshness { as_of: self.view.as_of(), now: now() }
    }
}
