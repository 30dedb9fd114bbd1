//! The node file, as the commands read it.

use std::sync::Arc;

use blaze_domain::node_file::{Fault, NodeFile};
use blaze_runtime::config::{Schema, Sources, load_typed};

/// Reads a node file.
///
/// # Errors
/// Every fault, one a line.
pub(crate) fn read(sources: &Sources) -> Result<NodeFile, String> {
    let remarks =
        |faults: Vec<Fault>| -> Vec<_> { faults.into_iter().map(|fault| (fault.path, fault.detail)).collect() };
    let schema: Schema<NodeFile> = Arc::new(move |tree| {
        NodeFile::read(tree)
            .map(|(file, warnings)| (file, remarks(warnings)))
            .map_err(remarks)
    });
    load_typed(sources, &schema)
        .map(|loaded| loaded.value)
        .map_err(|faults| {
            let lines: Vec<String> = faults.iter().map(ToString::to_string).collect();
            lines.join("\n  ")
        })
}
