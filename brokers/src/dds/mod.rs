//! RustDDS behind a small surface: one participant on one interface, samples that are plain octets,
//! discovery over unicast, and the means to see that a participant has died.
//!
//! ```text
//! Participant ── Writer::write ──► RustDDS event loop ──► UDP
//!             ── Reader (a thread of its own) ──► sink(participant, octets)
//!             ── EndpointWatch (a thread of its own) ──► sink(all remote readers and writers)
//! Relay       ── repeats the participant's announcement to hosts that multicast does not reach
//! Metatraffic ── between RustDDS and the discovery of other implementations
//! ```
//!
//! Nothing here blocks a caller on the network, and a panic inside RustDDS never leaves this
//! module: it marks the participant as failed, and the owner builds a new one.

pub(crate) mod adapter;
mod announcement;
mod farewell;
#[cfg(feature = "fault-injection")]
mod fault;
mod filter;
pub mod layer;
mod metatraffic;
mod nudge;
mod own_readers;
pub(crate) mod participant;
mod pulse;
mod reader;
mod relay;
mod rtps;
mod sample;
mod watch;
mod writer;

use std::net::{IpAddr, Ipv4Addr};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread;

use blaze_domain::node_file::MAX_DDS_DOMAIN;

#[cfg(feature = "fault-injection")]
pub use fault::Fault;
pub use participant::{GuidPrefix, Participant, ParticipantConfig, Profile, TimingQos};
pub use pulse::{Illness, Pulse};
pub(crate) use reader::take_up_to;
pub use reader::{OctetsSink, Reader, Sample, SampleSink};
pub use relay::{Relay, RelayConfig, RelayStatus};
pub use sample::{Cdr, octet_sequence};
pub use watch::{EndpointWatch, Endpoints, FoundEndpoint};
pub use writer::{EndpointId, Writer, Written};
pub(crate) use writer::{endpoint_of, participant_of};

/// The type of all samples, IDL `sequence<octet>`.
pub const FRAME_TYPE: &str = "blaze::v1::Frame";

/// RustDDS announces itself to this many participant slots of its own host.
const LOCAL_SLOTS: u16 = 12;

/// Slots of a host in one domain: the ports of the next domain follow.
pub(crate) const SLOTS: u16 = 120;

/// UDP port of a domain on which multicast announcements come; user multicast is the next one.
fn multicast_port(domain: u16) -> u16 {
    7400 + 250 * domain
}

/// UDP port on which the participant in a slot takes announcements.
#[must_use]
pub fn announcement_port(domain: u16, slot: u16) -> u16 {
    multicast_port(domain) + 10 + 2 * slot
}

/// Why DDS refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DdsError {
    /// Ports of that domain would lie in the range that systems give out by themselves, or above
    /// all.
    #[error("DDS domain {0} is above {MAX_DDS_DOMAIN}")]
    Domain(u16),
    /// RustDDS speaks IPv4 alone.
    #[error("{0} is not an IPv4 address of one interface")]
    Address(IpAddr),
    /// No interface has the address (yet).
    #[error("no interface has {address}: {error}")]
    AddressMissing {
        /// What the configuration names.
        address: IpAddr,
        /// What the system says.
        error: String,
    },
    /// RustDDS or the system could not make something.
    #[error("cannot make a DDS {what}: {error}")]
    Create {
        /// What was to be made.
        what: &'static str,
        /// What was said.
        error: String,
    },
    /// A panic inside RustDDS.
    #[error("RustDDS failed while making a {0}")]
    Panicked(&'static str),
    /// RustDDS stands still: the participant must be replaced.
    #[error("RustDDS stands still while making a {0}")]
    Hangs(&'static str),
}

/// Whether participants of a domain can be on the interface with an address, as far as that shows
/// without the system.
///
/// # Errors
/// [`DdsError::Domain`] and [`DdsError::Address`].
pub fn check(domain: u16, address: IpAddr) -> Result<Ipv4Addr, DdsError> {
    match address {
        _ if domain > MAX_DDS_DOMAIN => Err(DdsError::Domain(domain)),
        IpAddr::V4(one) if !(one.is_unspecified() || one.is_multicast() || one.is_broadcast()) => {
            Ok(one)
        }
        _ => Err(DdsError::Address(address)),
    }
}

/// Drops what is left of a participant. Its end may hang, so it is left to a thread of its own,
/// which calls `over` and tells the receiver when it is over.
pub fn lay_aside(
    remains: impl Send + 'static,
    over: impl FnOnce() + Send + 'static,
) -> Option<Receiver<()>> {
    let (done, receiver) = sync_channel(1);
    let thread = thread::Builder::new().name("dds-remains".into()).spawn(move || {
        let _ = catch_unwind(AssertUnwindSafe(|| drop(remains)));
        over();
        let _ = done.send(());
    });
    match thread {
        Ok(_) => Some(receiver),
        Err(error) => {
            tracing::error!(%error, "no thread for the end of a DDS participant");
            None
        }
    }
}

fn create_error(what: &'static str) -> impl FnOnce(std::io::Error) -> DdsError {
    move |error| DdsError::Create { what, error: error.to_string() }
}
