//! Limits of definitions and messages.

/// Largest message as CDR with its encapsulation, and as JSON, in bytes (16 MiB): the largest
/// payload of a topic.
pub const MAX_MESSAGE_BYTES: usize = 16 * 1024 * 1024;

/// Deepest nesting of a value: objects and arrays within each other. The JSON parser has a limit of
/// 128, and each level takes room on the stack.
pub const MAX_NESTING: usize = 64;

/// Most types in one description, the type itself and all that it refers to.
pub const MAX_TYPES: usize = 1_000;

/// Most fields in one description, those of all its types together.
pub const MAX_FIELDS: usize = 16_384;

/// Largest definition that is read: one file, one text or one description, in bytes (1 MiB).
pub const MAX_DEFINITION_BYTES: usize = 1024 * 1024;

/// Most descriptions that [`Definitions`](crate::Definitions) keeps of nodes and flows.
pub const MAX_ADDED: usize = 4_096;

/// Most bytes of these descriptions together, about (64 MiB).
pub const MAX_ADDED_BYTES: usize = 64 * 1024 * 1024;

/// Longest name of a type or field, in bytes, as in `type_description_interfaces`.
pub const MAX_NAME_BYTES: usize = 255;
