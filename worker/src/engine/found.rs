//! What a copy holds that could not be read at the start, or that another worker of the layer has written.
//!
//! ```text
//! Found ─▶ is it newer, of the same store, and the main service away? ─ yes ─▶ served from now on
//!      └─▶ its notes: what was told and what failed, in any case, unless another worker wrote them just now
//! ```

use tokio::time::Instant;

use super::{Engine, tell};
use std::sync::Arc;

use crate::copy::{Found, Loaded, Notes};
use crate::core::Replica;

impl Engine {
    /// Of one store the newer state counts; of two, what is served stays, and so it does if the main service answers: it tells
    /// what is newer by itself.
    pub(super) fn on_found(&mut self, found: Found) {
        let Found {
            place,
            loaded,
            is_of_another,
            taken,
        } = found;
        let Loaded {
            position,
            documents,
            notes,
        } = loaded;
        let is_newer = self.replica.store_id().is_none_or(|store_id| {
            store_id == position.store_id && position.revision > self.replica.state().revision()
        });
        let is_wanted = is_newer && self.stream.is_none();
        if is_wanted {
            tracing::info!(place, revision = position.revision, "services get what this copy holds");
            let state = self.state_of(position.revision, documents);
            let layer = self.identity.site.layer.clone();
            self.replica = Replica::from_copy(layer, Some(position.store_id), state.clone(), Some(position.as_of));
            self.served.take_later(state);
            self.note_texts_of_all();
            self.note_all_services();
        }
        if is_wanted || !is_of_another {
            self.take_notes(&notes);
            self.keep(true);
            self.flush_soon();
        }
        // Whoever asks may have gone.
        let _ = taken.send(());
    }

    /// What an earlier life, or another worker, told and saw fail.
    fn take_notes(&mut self, notes: &Notes) {
        for uid in notes.failed() {
            self.has_undone |= !self.notes.has_failed(uid);
            self.served.fail_rollout(uid);
        }
        self.served
            .restore_late(tell::told_of(notes), Instant::now().into_std());
        Arc::make_mut(&mut self.notes).merge(notes);
        self.fade_from_notes();
    }
}
