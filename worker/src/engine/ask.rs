//! Requests of services.

use bytes::Bytes;
use tokio::time::Instant;

use super::{Engine, now};
use crate::core::messages::{self, GetRequest, RefusedRequest};
use crate::core::{Freshness, answer};

impl Engine {
    pub(super) fn on_get(&mut self, request: &[u8]) {
        let shared = self.outputs.replies.shared();
        let (to, text) = match GetRequest::parse(request) {
            Ok(request) => {
                if !self.is_leader {
                    self.counts.left_to_others += 1;
                    return;
                }
                let reply = answer(&mut self.served, &request, Instant::now().into_std());
                let id = request.id.as_deref();
                let text = messages::reply(&reply, id, self.identity.delivery, self.freshness());
                self.key_of_asker(&request);
                (Some((request.reply_to, request.id)), text)
            }
            Err(RefusedRequest { id, reply_to, error }) => {
                self.counts.refused += 1;
                if !self.is_leader {
                    return;
                }
                let text = messages::refusal(&error, id.as_deref());
                (reply_to.map(|to| (to, id)), text)
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

    pub(super) fn freshness(&self) -> Freshness {
        Freshness {
            as_of: self.replica.as_of(),
            now: now(),
        }
    }
}
