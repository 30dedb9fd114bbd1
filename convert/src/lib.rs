//! ROS 2 types that are known only at run time: their definitions, their hashes, and the way from
//! CDR to JSON and back.
//!
//! ```text
//! built in ─┐
//! folders  ─┼─► Definitions::find(name, hash) ─► TypeDescription ─► Program::compile
//! added    ─┘                                                        ├─ to_json: CDR ─► JSON
//!                                                                    └─ to_cdr:  JSON ─► CDR
//! ```
//!
//! Everything but [`Folders`] is pure: no input or output, no clock, no asynchronous code. No input
//! panics, and none takes more time or memory than the limits of [`limits`] allow.

mod built_in;
mod definitions;
mod description;
mod folders;
mod hash;
mod kinds;
pub mod limits;
mod literal;
mod parts;
mod pool;
mod program;
mod response;
mod text;
mod write_text;

pub use built_in::{Distro, DistroError, built_in};
pub use definitions::{Definition, Definitions, Source};
pub use description::{
    Constant, DescriptionError, Field, FieldType, IndividualType, TypeDescription,
};
pub use folders::{Folders, Warning};
pub use hash::{HashError, TypeHash};
pub use kinds::{Base, Shape};
pub use pool::{Pool, PoolError};
pub use program::{CompileError, ConvertError, Program};
pub use text::{TextError, parse_action, parse_joined, parse_message, parse_service};
pub use write_text::definition_text;
