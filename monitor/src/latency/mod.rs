//! How long messages take from their publishers to this node.
