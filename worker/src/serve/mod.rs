//! The local broker's side: what services ask and are told.
//!
//! ```text
//! blaze/config/get ─▶ engine ─▶ reply_to
//! engine ─▶ Speaker (the newest for each place) ─▶ Outlet ─▶ keys, then blaze/config/changed/<service>
//! ```

pub mod outlet;
pub mod speaker;
mod waiting;

pub use outlet::{BrokerOutlet, Channels, Outlet, OutletError, changed};
pub use speaker::{Speaker, SpeakerCounts, Told};
