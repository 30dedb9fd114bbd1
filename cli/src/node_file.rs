//! The node file, as the commands read it.

use blaze_domain::node_file::NodeFile;
use blaze_runtime::config::{Sources, load_typed, schema};
use serde_json::Value;

use crate::exit::lines;

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
    match load_typed(sources, &schema(NodeFile::read)) {
        Ok(loaded) => Ok((loaded.value, loaded.document.value().clone())),
        Err(faults) => Err(lines(&faults)),
    }
}
