//! The two interfaces of the main service. Both translate between a wire and the core and decide
//! nothing themselves.
//!
//! ```text
//! HTTP/1.1, HTTP/2 ─▶ rest ─┐                                        ┌─▶ core::ConfigService
//!                           ├─ request (id, token, address) ─ limits ┤
//! HTTP/2 ───────────▶ grpc ─┘                                        └─▶ json (bodies of answers)
//! ```

/// Life of a token that does not ask for another one, in seconds: a day.
pub(crate) const DEFAULT_TOKEN_LIFE_S: u32 = 86_400;

pub mod grpc;
pub mod json;
pub mod limits;
pub mod request;
pub mod rest;
