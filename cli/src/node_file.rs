//! The node file, as the commands read it.

use std::sync::Arc;

use blaze_domain::node_file::{Fault, NodeFile};
use blaze_runtime::config::{Schema, Sources, load_typed};
use serde_json::Value;

/// Reads a node file.
///
/// # Errors
/// Every fault, one a line.
pub(crate) fn read(sources: &Sources) -> Result<NodeFile, String> {
    read_with_tree(sources).map(|(file, _)| file)
}

/// The same, with the tree that it was read from.
///
/// # Errors
/// As [`read`].
pub(crate) fn read_with_tree(sources: &Sources) -> Result<(NodeFile, Value), String> {
    let remarks =
        |faults: Vec<Fault>| -> Vec<_> { faults.into_iter().map(|fault| (fault.path, fault.detail)).collect() };
    let schema: Schema<NodeFile> = Arc::new(move |tree| {
        NodeFile::read(tree)
            .map(|(file, warnings)| (file, remarks(warnings)))
            .map_err(remarks)
    });
    load_typed(sources, &schema)
        .map(|loaded| (loaded.value, loaded.document.value().clone()))
        .map_err(|faults| {
            let lines: Vec<String> = faults.iter().map(ToString::to_string).collect();
            lines.join("\n  ")
        })
}
