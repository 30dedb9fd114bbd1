//! Times and limits of health.

use std::time::Duration;

/// A condition that lasts this long is a problem: a lost datagram or one slow answer is none.
pub(super) const WORSE_AFTER: Duration = Duration::from_secs(5);
/// A problem whose condition is absent for this long is over.
pub(super) const BETTER_AFTER: Duration = Duration::from_secs(15);
/// A state holds at least this long, so that two problems that take turns do not make it flap.
pub(super) const HOLD: Duration = Duration::from_secs(5);
/// A service may start this long: it may wait for others or load a model.
pub(super) const STARTING_AFTER: Duration = Duration::from_secs(30);
/// A service may take this long to apply a configuration; some restart for it.
pub(super) const STALE_AFTER: Duration = Duration::from_secs(30);
/// A bridge may start this long: Kafka creates its topic first.
pub(super) const BRIDGE_STARTING_AFTER: Duration = Duration::from_secs(15);
/// A link at its limit for this long is no burst.
pub(super) const LIMIT_AFTER: Duration = Duration::from_secs(60);
/// Signs of life that could not be read for this long leave the state of services unknown.
pub(super) const UNKNOWN_AFTER: Duration = Duration::from_secs(15);
/// After an outage of the signs of life, services have this long to renew theirs (every 5 s).
pub(super) const RENEW_GRACE: Duration = Duration::from_secs(10);
/// A sign of life that vanishes this long before it could expire was deleted, not lost; covers the
/// time between its reading and its evaluation.
pub(super) const EXPIRY_MARGIN: Duration = Duration::from_secs(1);
/// A service that is gone this long is forgotten: it was removed on purpose.
pub(super) const FORGET_GONE: Duration = Duration::from_secs(3_600);

/// Problems and conditions that may become some, at most; about 0.5 KiB each. The others are
/// counted in the problem `more_problems`.
pub(super) const MAX_PROBLEMS: usize = 1_000;
/// Instances of services, at most; more are counted there, too.
pub(super) const MAX_SERVICES: usize = 1_000;
/// Topics whose drops are watched, at most; more are counted there, too.
pub(super) const MAX_TOPICS: usize = 5_000;
/// Values of the label `name`, at most; the worst state of the others is that of `_other`.
pub(super) const MAX_LABELS: usize = 256;
/// Longest detail, in characters: it goes to logs and over the status stream.
pub(super) const MAX_DETAIL: usize = 300;

/// Rates are means over this time.
pub(super) const RATE_WINDOW: Duration = Duration::from_secs(10);
/// Datagrams per second that the kernel drops before buffers are too small for what arrives.
pub(super) const UDP_DROPS_PER_S: f64 = 1.0;
/// Share of the time that the cgroup is throttled before it is noticed in latencies.
pub(super) const THROTTLED_RATIO: f64 = 0.1;
/// Loss of a link, 0 to 1, above which repairs delay messages.
pub(super) const LOSSY: f64 = 0.02;
/// Share of its limit at which a link has no room.
pub(super) const LIMIT_USED: f64 = 0.95;
/// A topic is silent when so many messages in a row did not come at the advertised rate.
pub(super) const SILENT_MESSAGES: f64 = 3.0;
/// Longest time until a topic is silent: one message an hour is no rate to watch.
pub(super) const MAX_SILENCE: Duration = Duration::from_secs(3_600);
