//! What becomes of roll-outs on their canaries, as the workers there say.

use std::sync::Arc;

use blaze_domain::config::effective::is_canary;
use blaze_domain::config::placement::{is_active, placement};
use blaze_domain::config::state::State;
use blaze_domain::config::{Document, Key, Kind};
use blaze_domain::{LayerName, NodeName};
use tokio::sync::oneshot;

use super::super::committer::{Queued, Running};
use super::super::evaluate::{Content, Failed, Form, Item, Request};
use super::super::report::AnswerKind;
use super::super::rollouts::tell_canary;
use super::super::types::{Caller, Precondition};
use super::super::workers::{Acknowledged, RolloutReport, WorkerSession};
use super::ConfigService;
use crate::auth::Claims;

/// What such a change counts for in the queue, in bytes.
const BYTES: u32 = 2048;

impl ConfigService {
    /// A roll-out as it is shown: while it is on its canaries, with what their workers say of it.
    pub(super) fn with_canaries(&self, state: &State, document: Arc<Document>) -> Arc<Document> {
        if document.key.kind() != Kind::Rollout || !is_active(&document) {
            return document;
        }
        let told = self.inner.workers.of_rollout(&document.uid);
        let mut shown = (*document).clone();
        let Some(status) = &mut shown.status else {
            return document;
        };
        for (node, (layer, told)) in &told {
            if is_tried(state, &document, node, layer) {
                tell_canary(status, node.as_str(), &told.phase, told.revision, &told.reason);
            }
        }
        Arc::new(shown)
    }

    /// Has roll-outs ended that a worker has undone. Nobody waits for it: as long as the worker
    /// sees them go on, it says so again.
    pub(super) fn end_failed(&self, session: &WorkerSession, has: &Acknowledged) {
        let failed = |report: &&RolloutReport| report.phase == "failed";
        let mut failed = has.rollouts.iter().filter(failed).peekable();
        if failed.peek().is_none() {
            return;
        }
        let state = self.state();
        let rollouts = state.of_kind(Kind::Rollout, None).map(|(_, held)| &*held.document);
        let active: Vec<&Document> = rollouts.filter(|rollout| is_active(rollout)).collect();
        let layer = &session.name().layer;
        for report in failed {
            let Some(node) = &report.node else { continue };
            let of_uid = active.iter().find(|rollout| rollout.uid == report.uid);
            if let Some(rollout) = of_uid.filter(|rollout| is_tried(&state, rollout, node, layer)) {
                let failed = Failed {
                    uid: report.uid.clone(),
                    node: node.clone(),
                    revision: has.revision,
                    reason: report.reason.clone(),
                };
                self.end_one(session, rollout.key.clone(), failed);
            }
        }
    }

    fn end_one(&self, session: &WorkerSession, key: Key, failed: Failed) {
        // Until the first word of it is dealt with, the others add nothing.
        let Some(running) = Running::begin(&self.inner.running, &format!("failed/{}", failed.uid))
        else {
            return;
        };
        let room = Arc::clone(&self.inner.room).try_acquire_many_owned(BYTES);
        let Ok(room) = room else { return };
        tracing::warn!(
            rollout = %key,
            node = %failed.node,
            reason = failed.reason,
            "a roll-out has failed",
        );
        let queued = Queued {
            request: Arc::new(Request {
                caller: worker(session),
                action: "rollout_fail",
                form: Form::Single,
                items: vec![Item {
                    key,
                    content: Content::Fail(failed),
                    precondition: Precondition::None,
                }],
                cascade: false,
                prune: None,
                unchanged_since: Default::default(),
            }),
            answer: AnswerKind::Document,
            once: None,
            bytes: BYTES as usize,
            reply: oneshot::channel().0,
            running: Some(running),
            _room: room,
        };
        if self.inner.queue.try_send(queued).is_err() {
            tracing::warn!("too many writes wait; the worker says it again");
        }
    }
}

/// Whether a worker of a layer may speak for a node about a roll-out: it is tried there.
fn is_tried(state: &State, rollout: &Document, node: &NodeName, layer: &LayerName) -> bool {
    let Some(held) = state.get(&Key::node(node)) else {
        return false;
    };
    is_canary(rollout, &held.document)
        && placement(state, &held.document).layer.as_ref() == Some(layer)
        && placement(state, rollout).visible.contains(layer)
}

/// The worker as one that asks. It is bound to no layer, because a roll-out ends in all of them;
/// what it may end has been looked at before.
fn worker(session: &WorkerSession) -> Caller {
    let name = session.name();
    let node = name.node.as_ref().map_or("-", NodeName::as_str);
    Caller {
        claims: Arc::new(Claims {
            subject: format!("worker:{}/{node}", name.layer),
            roles: Vec::new(),
            layer: None,
            expires_s: None,
            token_id: None,
        }),
        request_id: uuid::Uuid::now_v7().to_string(),
        address: session.address(),
    }
}
