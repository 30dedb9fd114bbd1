//! Times and bounds of `blaze doctor`.

use std::time::Duration;

/// For all checks together: they run at once, and someone waits in front of a terminal.
pub(super) const TOTAL: Duration = Duration::from_secs(10);
/// For one program of the node to answer one question: it is on this machine.
pub(super) const PROGRAM: Duration = Duration::from_secs(3);
/// For a broker: a TLS handshake and a login over a slow link included.
pub(super) const BROKER: Duration = Duration::from_secs(5);
/// For the farewell to a broker.
pub(super) const CLOSE: Duration = Duration::from_secs(1);
/// Between two looks at a counter, to see whether it rises.
pub(super) const APART: Duration = Duration::from_secs(1);
/// For the answer to one probe of the MTU: longer than the round trip of mobile networks. The path
/// over a geostationary satellite (600 ms) is reported as not measured.
pub(super) const MTU_ANSWER: Duration = Duration::from_millis(400);
/// Probes of one size before it counts as lost: a lossy link must not look like a narrow one.
pub(super) const MTU_TRIES: usize = 3;
/// Peers whose path is probed at once, each on a thread of its own.
pub(super) const MTU_PEERS: usize = 32;
/// For a multicast packet to come back from the own interface.
pub(super) const MULTICAST_ANSWER: Duration = Duration::from_millis(500);
/// A token or certificate that ends within this time is named: there is time to replace it.
pub(super) const EXPIRES_SOON_S: i64 = 7 * 86_400;
/// Share of the file descriptors in use at which a program should get more.
pub(super) const DESCRIPTORS_WARN: f64 = 0.8;
/// The same at which it soon accepts no connection.
pub(super) const DESCRIPTORS_FAIL: f64 = 0.95;
/// Leases at which a flow is near the 10,000 that it holds.
pub(super) const LEASES_WARN: f64 = 9_000.0;
/// Bytes of a socket buffer that the layer broker (DDS) and ROS 2 ask for: several images.
pub(super) const LARGE_BUFFER: u64 = 8 * 1024 * 1024;
/// Bytes of a socket buffer that the link between flows asks for: 1 MiB, for discovery.
pub(super) const SMALL_BUFFER: u64 = 1024 * 1024;
/// Largest certificate or key file that is read, in bytes: a bundle of all public authorities has
/// a fifth of it.
pub(super) const MAX_PEM_BYTES: u64 = 1024 * 1024;
/// Names that a detail lists; the rest is counted.
pub(super) const MAX_NAMED: usize = 5;
