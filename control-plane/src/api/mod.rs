//! The two interfaces of the main service. Both translate between a wire and the core and decide nothing themselves.
//!
//! ```text
//! HTTP/1.1, HTTP/2 ─▶ rest ─┐                                        ┌─▶ core::ConfigService
//!                           ├─ request (id, token, address) ─ limits ┤
//! HTTP/2 ───────────▶ grpc ─┘                                        └─▶ json (bodies of answers)
//! ```

pub mod grpc;
pub mod json;
pub mod limits;
pub mod request;
pub mod rest;
