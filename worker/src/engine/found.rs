//! What a copy holds that could not be read at the start, or that another worker of the layer has
//! written.

use tokio::time::Instant;

use super::Engine;
use crate::copy::{Found, Loaded, Notes};
use crate::core::LayerView;

impl Engine {
    /// Of one store the newer state counts; of two, what is served stays, and so it does if the
    /// main service answers: it tells what is newer by itself. Notes count in any case, unless
    /// another worker wrote them just now.
    pub(super) fn on_found(&mut self, found: Found) {
        let Loaded { position, documents, notes } = found.loaded;
        let is_newer = self.view.store_id().is_none_or(|store_id| {
            store_id == position.store_id && position.revision > self.view.state().revision()
        });
        let is_wanted = is_newer && self.stream.is_none();
        if is_wanted {
            tracing::info!(
                place = found.place,
                revision = position.revision,
                "services get what this copy holds"
            );
            let state = self.state_of(position.revision, documents);
            self.view = LayerView::from_copy(position.store_id, state.clone(), position.as_of);
            self.served.set_store(self.view.store_id());
            self.served.take_later(state);
            self.note_texts_of_all();
            self.note_all_services();
        }
        if is_wanted || !found.is_of_another {
            self.take_notes(&notes);
            self.keep(true);
            self.flush_soon();
        }
        // Whoever asks may have gone.
        let _ = found.taken.send(());
    }

    /// What another life, or another worker, knew.
    pub(super) fn take_notes(&mut self, notes: &Notes) {
        for uid in &notes.failed {
            self.served.fail_rollout(uid);
        }
        for place in &notes.ended {
            self.ends.add(place, None);
        }
        let places = notes.places.iter().cloned();
        self.served.restore(notes.floor, places, Instant::now().into_std());
        self.renew_notes();
    }
}
