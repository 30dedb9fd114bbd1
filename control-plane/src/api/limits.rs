//! What clients may take: requests at work, requests a second, refused tokens a second, open
//! watches, bytes of bodies.
//!
//! ```text
//! body ─▶ metered, while it is received ─▶ whole ─▶ a place among the requests at work
//! ```
//!
//! Only what is whole takes a place among the requests at work, so that slow senders do not hold up
//! others. One value of [`ApiLimits`] serves REST and gRPC, so that a client cannot have twice as
//! much by using both. Whatever is remembered about clients is bounded: the least recently seen are
//! forgotten, with a full allowance. The buckets are our own: `governor` neither looks without
//! taking, as the check of an address does, nor bounds its keys.

use std::collections::HashMap;
use std::error::Error;
use std::hash::Hash;
use std::net::{IpAddr, Ipv6Addr};
use std::num::NonZeroUsize;
use std::sync::Arc;
use std::time::Instant;

use axum::BoxError;
use axum::body::Body;
use blaze_domain::config::{Code, Problem};
use blaze_domain::node_file::LimitsSection;
use futures::StreamExt as _;
use lru::LruCache;
use parking_lot::Mutex;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// Clients that are remembered per limit.
const REMEMBERED: NonZeroUsize = NonZeroUsize::MIN.saturating_add(65_535);
/// Bytes of bodies that are being received, of all clients together (512 MiB).
const RECEIVING_BYTES: usize = 512 * 1024 * 1024;

/// One of a subject's watches; free again when dropped.
#[derive(Debug)]
pub struct WatchSlot {
    subject: String,
    open: Arc<Mutex<HashMap<String, u32>>>,
}

impl Drop for WatchSlot {
    fn drop(&mut self) {
        let mut open = self.open.lock();
        if let Some(count) = open.get_mut(&self.subject) {
            *count -= 1;
            if *count == 0 {
                open.remove(&self.subject);
            }
        }
    }
}

/// The limits of both interfaces.
#[derive(Debug)]
pub struct ApiLimits {
    receiving: Arc<Semaphore>,
    in_flight: Arc<Semaphore>,
    requests: Option<Buckets<String>>,
    failures: Option<Buckets<IpAddr>>,
    watches_per_subject: u32,
    watches: Arc<Mutex<HashMap<String, u32>>>,
}

impl ApiLimits {
    /// Limits as the node file says.
    #[must_use]
    pub fn new(section: &LimitsSection) -> Self {
        let in_flight = usize::try_from(section.in_flight).unwrap_or(Semaphore::MAX_PERMITS);
        Self {
            receiving: Arc::new(Semaphore::new(RECEIVING_BYTES)),
            in_flight: Arc::new(Semaphore::new(in_flight.min(Semaphore::MAX_PERMITS))),
            requests: (section.requests_per_s > 0).then(|| Buckets::new(section.requests_per_s)),
            failures: (section.auth_failures_per_s > 0)
                .then(|| Buckets::new(section.auth_failures_per_s)),
            watches_per_subject: section.watches_per_subject,
            watches: Arc::default(),
        }
    }

    /// The body of a request, whose bytes count until it is dropped. When it fails by that,
    /// [`refusal`] finds why.
    pub(super) fn metered(&self, body: Body) -> Body {
        let (receiving, mut held) = (Arc::clone(&self.receiving), None::<OwnedSemaphorePermit>);
        Body::from_stream(body.into_data_stream().map(move |chunk| {
            let chunk = chunk?;
            let bytes = u32::try_from(chunk.len())?;
            let Ok(taken) = Arc::clone(&receiving).try_acquire_many_owned(bytes) else {
                return Err(overloaded(
                    "the service receives as many bytes of bodies as it may: try again",
                )
                .into());
            };
            match &mut held {
                Some(held) => held.merge(taken),
                None => held = Some(taken),
            }
            Ok::<_, BoxError>(chunk)
        }))
    }

    /// A place among the requests at work, for one whose body is there; free again when dropped.
    ///
    /// # Errors
    /// `overloaded` if all are taken.
    pub fn enter(&self) -> Result<OwnedSemaphorePermit, Problem> {
        let place = Arc::clone(&self.in_flight).try_acquire_owned();
        place.map_err(|_| overloaded("the service works on as many requests as it may: try again"))
    }

    /// Counts a request of a subject.
    ///
    /// # Errors
    /// `rate_limited` if there were too many.
    pub fn count_request(&self, subject: &str) -> Result<(), Problem> {
        let Some(buckets) = &self.requests else { return Ok(()) };
        buckets.take(subject.to_owned(), Instant::now()).map_err(|wait_s| {
            limited("the subject sends more requests a second than it may", wait_s)
        })
    }

    /// Looks whether an address may still present tokens.
    ///
    /// # Errors
    /// `rate_limited` if too many of its tokens were refused.
    pub fn check_address(&self, address: IpAddr) -> Result<(), Problem> {
        let Some(buckets) = &self.failures else { return Ok(()) };
        buckets
            .look(&source(address), Instant::now())
            .map_err(|wait_s| limited("too many tokens from this address were refused", wait_s))
    }

    /// Counts a token that was refused. A request without token is none: it guesses nothing.
    pub fn count_refused_token(&self, address: IpAddr) {
        if let Some(buckets) = &self.failures {
            // Whether it was the last one is looked at before the next.
            let _ = buckets.take(source(address), Instant::now());
        }
    }

    /// Opens a watch of a subject.
    ///
    /// # Errors
    /// `rate_limited` if it has as many as it may.
    pub fn open_watch(&self, subject: &str) -> Result<WatchSlot, Problem> {
        let mut open = self.watches.lock();
        let count = open.entry(subject.to_owned()).or_insert(0);
        if *count >= self.watches_per_subject {
            let limit = self.watches_per_subject;
            let detail = format!(
                "the subject has {limit} open watches, and may have no more: end one first"
            );
            return Err(Problem::new(Code::RateLimited, detail).retry_after(5));
        }
        *count += 1;
        Ok(WatchSlot { subject: subject.to_owned(), open: Arc::clone(&self.watches) })
    }
}

/// The refusal that a failed reading of a metered body ends with, if it is one.
pub(super) fn refusal<'a>(error: &'a (dyn Error + 'static)) -> Option<&'a Problem> {
    std::iter::successors(Some(error), |&error| error.source())
        .find_map(|error| error.downcast_ref())
}

fn overloaded(detail: &str) -> Problem {
    Problem::new(Code::Overloaded, detail).retry_after(1)
}

fn limited(detail: &str, wait_s: u64) -> Problem {
    Problem::new(Code::RateLimited, detail).retry_after(wait_s)
}

/// Who is counted for an address: of IPv6 the network, since one client has all of its addresses.
fn source(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(v6) => {
            let [a, b, c, d, ..] = v6.segments();
            IpAddr::V6(Ipv6Addr::new(a, b, c, d, 0, 0, 0, 0))
        }
        v4 @ IpAddr::V4(_) => v4,
    }
}

/// A token bucket per client: full after one second without a request.
#[derive(Debug)]
struct Buckets<K: Hash + Eq> {
    per_s: f64,
    levels: Mutex<LruCache<K, Level>>,
}

#[derive(Debug, Clone, Copy)]
struct Level {
    tokens: f64,
    at: Instant,
}

impl<K: Hash + Eq> Buckets<K> {
    fn new(per_s: u32) -> Self {
        Self { per_s: f64::from(per_s), levels: Mutex::new(LruCache::sparse(REMEMBERED)) }
    }

    fn now(&self, level: Option<&Level>, now: Instant) -> f64 {
        level.map_or(self.per_s, |level| {
            let grown = now.saturating_duration_since(level.at).as_secs_f64() * self.per_s;
            (level.tokens + grown).min(self.per_s)
        })
    }

    /// Seconds until a whole token is there, rounded up.
    fn wait_s(&self, tokens: f64) -> u64 {
        ((1.0 - tokens) / self.per_s).ceil().max(1.0) as u64
    }

    fn look(&self, key: &K, now: Instant) -> Result<(), u64> {
        let levels = self.levels.lock();
        let tokens = self.now(levels.peek(key), now);
        if tokens >= 1.0 { Ok(()) } else { Err(self.wait_s(tokens)) }
    }

    fn take(&self, key: K, now: Instant) -> Result<(), u64> {
        let mut levels = self.levels.lock();
        let tokens = self.now(levels.get(&key), now);
        let (tokens, taken) =
            if tokens >= 1.0 { (tokens - 1.0, Ok(())) } else { (tokens, Err(self.wait_s(tokens))) };
        levels.put(key, Level { tokens, at: now });
        taken
    }
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;
    use std::time::Duration;

    use futures::stream;
    use http_body_util::BodyExt as _;

    use super::*;

    fn limits(requests_per_s: u32, auth_failures_per_s: u32) -> ApiLimits {
        ApiLimits::new(&LimitsSection {
            in_flight: 2,
            watches_per_subject: 2,
            requests_per_s,
            auth_failures_per_s,
        })
    }

    #[test]
    fn a_bucket_refills_with_time() {
        let buckets = Buckets::new(2);
        let start = Instant::now();
        assert_eq!(buckets.take("a", start), Ok(()));
        assert_eq!(buckets.take("a", start), Ok(()));
        assert_eq!(buckets.take("a", start), Err(1));
        assert_eq!(buckets.look(&"a", start), Err(1));
        assert_eq!(buckets.take("b", start), Ok(()));
        let later = start + Duration::from_millis(500);
        assert_eq!(buckets.take("a", later), Ok(()));
        assert_eq!(buckets.take("a", later), Err(1));
        let much_later = start + Duration::from_secs(3600);
        for _ in 0..2 {
            assert_eq!(buckets.take("a", much_later), Ok(()));
        }
        assert_eq!(buckets.take("a", much_later), Err(1));
    }

    #[test]
    fn places_and_watches_come_back() {
        let limits = limits(0, 0);
        let places = [limits.enter().unwrap(), limits.enter().unwrap()];
        assert_eq!(limits.enter().unwrap_err().code, Code::Overloaded);
        drop(places);
        assert!(limits.enter().is_ok());
        let watches = [limits.open_watch("a").unwrap(), limits.open_watch("a").unwrap()];
        assert_eq!(limits.open_watch("a").unwrap_err().code, Code::RateLimited);
        assert!(limits.open_watch("b").is_ok());
        drop(watches);
        assert!(limits.open_watch("a").is_ok());
        assert!(limits.watches.lock().is_empty());
    }

    #[tokio::test]
    async fn bytes_of_bodies_are_bounded_while_they_are_received() {
        let limits = limits(0, 0);
        let first = vec![0; 1024];
        let half = limits
            .metered(Body::from_stream(stream::iter([first, Vec::new()].map(Ok::<_, Infallible>))));
        let mut half = half.into_data_stream();
        assert_eq!(half.next().await.unwrap().unwrap().len(), 1024);
        let rest = u32::try_from(RECEIVING_BYTES - 1024).unwrap();
        let _rest = limits.receiving.try_acquire_many(rest).unwrap();
        let refused = limits.metered(Body::from("x")).collect().await.unwrap_err();
        assert_eq!(refusal(&refused).unwrap().code, Code::Overloaded);
        drop(half);
        assert!(limits.metered(Body::from("x")).collect().await.is_ok());
        assert_eq!(limits.receiving.available_permits(), 1024);
    }

    #[test]
    fn zero_is_no_limit_of_a_rate() {
        let limits = limits(0, 0);
        let address = IpAddr::from([127, 0, 0, 1]);
        for _ in 0..1000 {
            limits.count_request("a").unwrap();
            limits.count_refused_token(address);
            limits.check_address(address).unwrap();
        }
    }

    #[test]
    fn refused_tokens_close_an_address_alone() {
        let limits = limits(0, 1);
        let addresses: [IpAddr; 3] = [
            "2001:db8::1".parse().unwrap(),
            "2001:db8::2".parse().unwrap(),
            "2001:db8:0:1::1".parse().unwrap(),
        ];
        limits.count_refused_token(addresses[0]);
        assert_eq!(limits.check_address(addresses[1]).unwrap_err().code, Code::RateLimited);
        assert!(limits.check_address(addresses[2]).is_ok());
        assert_eq!(source("::ffff:10.0.0.1".parse().unwrap()), IpAddr::from([10, 0, 0, 1]));
    }
}
