//! Schemas of documents and answers: exactly what the service takes, and what it gives.

mod answers;
mod documents;
mod requests;

pub(in super::super) use requests::{layer_or_null, roles};

use blaze_domain::config::selector::MAX_SELECTOR_BYTES;
use blaze_domain::config::{Kind, MAX_INTEGER};
use utoipa::openapi::schema::ObjectBuilder;

use super::patterns::{NAME, SELECTOR};
use super::shapes::{Shape, answer, formed, list, refer, said, text, whole};

/// All schemas with their names.
pub(super) fn all() -> Vec<(String, Shape)> {
    let mut all: Vec<(String, Shape)> = Vec::new();
    for kind in Kind::ALL.iter().copied() {
        all.push((format!("{kind}Spec"), documents::spec_of(kind).into()));
        all.push((format!("{kind}Input"), documents::input(kind)));
        all.push((kind.as_str().to_owned(), documents::document(kind)));
        all.push((format!("{kind}Page"), page(kind.as_str())));
    }
    let others = documents::all()
        .into_iter()
        .chain(requests::all())
        .chain(answers::all());
    all.extend(others.map(|(name, shape)| (name.to_owned(), shape)));
    all
}

/// A name, as layers, nodes, services, instances and roll-outs have.
pub(super) fn name() -> ObjectBuilder {
    formed(NAME, 1, 63)
}

fn revision() -> ObjectBuilder {
    whole(0, MAX_INTEGER)
}

fn real_revision() -> ObjectBuilder {
    whole(1, MAX_INTEGER)
}

fn selector() -> ObjectBuilder {
    formed(SELECTOR, 1, MAX_SELECTOR_BYTES)
}

fn kinds() -> impl Iterator<Item = &'static str> {
    Kind::ALL.iter().map(|kind| kind.as_str())
}

fn page(item: &str) -> Shape {
    answer(
        &["items", "revision", "next_page_token"],
        [
            ("items", list(refer(item)).into()),
            (
                "revision",
                said(
                    revision(),
                    "The revision that all pages show; a watch from it has no gap.",
                ),
            ),
            ("next_page_token", said(text(), "Empty on the last page.")),
        ],
    )
    .into()
}
