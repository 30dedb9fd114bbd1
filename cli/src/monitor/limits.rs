//! Times and limits of the commands that ask a monitor.

use std::ops::RangeInclusive;
use std::time::Duration;

/// Pings of one request; the monitor's own limit.
pub(super) const PING_COUNT: RangeInclusive<i64> = 1..=100;
/// Between two pings of one request; the monitor's own limits.
pub(super) const PING_INTERVAL: RangeInclusive<Duration> =
    Duration::from_millis(50)..=Duration::from_secs(60);
/// Time of a request beyond its pings: up to 5 s until the way of the answers is set up, 5 s until
/// a ping is lost, and the time that an answer may need on a slow network.
pub(super) const PING_GRACE: Duration = Duration::from_secs(15);

/// Between two looks at the problems: states get worse after 5 s and better after 15 s.
pub(super) const PROBLEMS_EVERY: Duration = Duration::from_secs(1);
