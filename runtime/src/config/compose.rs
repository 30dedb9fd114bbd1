//! What holds of a file and an overlay that change apart from each other.
//!
//! Each has a newest state and one that holds. A faulty state of one changes nothing and keeps the
//! other from nothing: the other's newest is then taken together with what held before.

use std::sync::Arc;

use super::document::NamedText;
use super::overlay::{Overlay, Verdict};
use super::{Document, Loaded, LocatedFault, Schema, Sources, judge};

/// Name and text of the file, or why it could not be read.
pub(super) type Seen = Result<Option<NamedText>, LocatedFault>;

/// File and overlay.
pub(super) struct Composition<T> {
    sources: Sources,
    schema: Schema<T>,
    seen: Seen,
    overlay: Option<Overlay>,
    good_file: Option<NamedText>,
    good_overlay: Option<Overlay>,
}

/// What follows from the newest states.
pub(super) struct Judgement<T> {
    /// What holds now; `None`: what held before.
    pub(super) loaded: Option<Loaded<T>>,
    /// Why the file does not count.
    pub(super) faults: Option<Arc<[LocatedFault]>>,
    /// Whether the overlay does; `None`: there is none.
    pub(super) overlay: Option<Verdict>,
}

type Faults = Vec<LocatedFault>;

impl<T> Composition<T> {
    pub(super) fn new(sources: Sources, schema: Schema<T>, initial: &Document) -> Self {
        let text = initial
            .file()
            .zip(initial.text())
            .map(|(file, text)| (Arc::from(file.display().to_string()), Arc::clone(text)));
        Self {
            sources,
            schema,
            seen: Ok(text.clone()),
            overlay: None,
            good_file: text,
            good_overlay: None,
        }
    }

    pub(super) fn sources(&self) -> &Sources {
        &self.sources
    }

    /// Returns whether it is another one than before.
    pub(super) fn see(&mut self, seen: Seen) -> bool {
        let is_other = seen != self.seen;
        self.seen = seen;
        is_other
    }

    /// Returns whether it is another one than before.
    pub(super) fn lay_over(&mut self, overlay: Option<Overlay>) -> bool {
        let is_other = overlay != self.overlay;
        self.overlay = overlay;
        is_other
    }

    pub(super) fn judge(&mut self) -> Judgement<T> {
        let file = self.file();
        let overlay = self.overlay.clone();
        let whole = file.clone().and_then(|text| Ok((self.read(&text, overlay.as_ref())?, text)));
        let faults = match whole {
            Ok((loaded, text)) => return self.hold(loaded, text, overlay),
            Err(faults) => faults,
        };
        let is_new_file = file.as_ref() != Ok(&self.good_file);
        let is_new_overlay = overlay != self.good_overlay;
        let (loaded, mut of_file, mut of_overlay) = match (is_new_file, is_new_overlay) {
            (_, false) => (None, Some(faults), None),
            (false, true) => (None, None, Some(faults)),
            (true, true) => self.take_apart(file, overlay.as_ref(), faults),
        };
        if overlay.is_none() {
            // That there is none any more cannot be faulty: then the file alone is.
            of_file = of_file.or(of_overlay.take());
        }
        Judgement { loaded, faults: of_file.map(Arc::from), overlay: verdict(overlay, of_overlay) }
    }

    /// Both are new, and together faulty.
    fn take_apart(
        &mut self,
        file: Result<Option<NamedText>, Faults>,
        overlay: Option<&Overlay>,
        faults: Faults,
    ) -> (Option<Loaded<T>>, Option<Faults>, Option<Faults>) {
        let of_overlay = match self.read(&self.good_file, overlay) {
            Ok(loaded) => {
                self.good_overlay = overlay.cloned();
                return (Some(loaded), Some(faults), None);
            }
            Err(faults) => faults,
        };
        let alone = file.and_then(|text| Ok((self.read(&text, self.good_overlay.as_ref())?, text)));
        match alone {
            Ok((loaded, text)) => {
                self.good_file = text;
                (Some(loaded), None, Some(faults))
            }
            Err(of_file) => (None, Some(of_file), Some(of_overlay)),
        }
    }

    fn hold(
        &mut self,
        loaded: Loaded<T>,
        text: Option<NamedText>,
        overlay: Option<Overlay>,
    ) -> Judgement<T> {
        self.good_file = text;
        self.good_overlay.clone_from(&overlay);
        Judgement { loaded: Some(loaded), faults: None, overlay: verdict(overlay, None) }
    }

    fn file(&self) -> Result<Option<NamedText>, Faults> {
        let text = self.seen.clone().map_err(|fault| vec![fault])?;
        // A file that is being written is empty for a moment. It would be valid and reset
        // everything to its default.
        let is_empty = |text: &NamedText| text.1.trim().is_empty();
        if text.as_ref().is_some_and(is_empty)
            && self.good_file.as_ref().is_some_and(|text| !is_empty(text))
        {
            let (document, _) = Document::from_text(&self.sources, self.good_file.clone(), None);
            let before = document.map(|document| document.fault("", "has become empty"));
            return Err(before.into_iter().collect());
        }
        Ok(text)
    }

    fn read(
        &self,
        text: &Option<NamedText>,
        overlay: Option<&Overlay>,
    ) -> Result<Loaded<T>, Faults> {
        judge(Document::from_text(&self.sources, text.clone(), overlay), &self.schema)
    }
}

fn verdict(overlay: Option<Overlay>, faults: Option<Faults>) -> Option<Verdict> {
    Some(Verdict { overlay: overlay?, faults: faults.map(Arc::from) })
}
