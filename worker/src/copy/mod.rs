//! The copy of the layer's view that outlives the process: a local database and a last-known-good file.
