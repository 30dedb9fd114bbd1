//! What the server says of itself, and how its answers are read.

use std::collections::HashMap;
use std::fmt;
use std::time::Duration;

use redis::aio::MultiplexedConnection;
use redis::{Cmd, InfoDict, RedisError, RedisResult};

use crate::port::BrokerError;

/// A subscriber is cut off when this many bytes wait for it: room for a few of the largest messages
/// is needed.
const LEAST_HARD_LIMIT: u64 = 4 * 32 * 1024 * 1024;
/// The same for the limit that holds for some seconds: two of the largest messages.
const LEAST_SOFT_LIMIT: u64 = 2 * 16 * 1024 * 1024;

/// A setting of the server with which something gets lost.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Complaint {
    /// What it is now, and what is lost.
    pub detail: String,
    /// Name of the setting.
    pub setting: &'static str,
    /// The value that it should have.
    pub value: &'static str,
}

impl fmt::Display for Complaint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}; set `{} {}`", self.detail, self.setting, self.value)
    }
}

/// What `INFO` tells.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) struct ServerFacts {
    /// Program and version, such as `redis 7.0.15`.
    pub(super) version: String,
    /// Differs after each start of the server.
    pub(super) run_id: Option<String>,
    /// What it does where memory is full.
    pub(super) memory_policy: Option<String>,
}

impl ServerFacts {
    fn of(info: &InfoDict) -> Self {
        let program = info.get("server_name").unwrap_or_else(|| "redis".to_owned());
        let version: Option<String> = info.get(&format!("{program}_version"));
        Self {
            version: match version.or_else(|| info.get("redis_version")) {
                Some(version) => format!("{program} {version}"),
                None => program,
            },
            run_id: info.get("run_id"),
            memory_policy: info.get("maxmemory_policy"),
        }
    }

    /// What is to be changed, if it may throw away what is kept on it.
    pub(super) fn complaint(&self) -> Option<Complaint> {
        let policy = self.memory_policy.as_deref().filter(|policy| *policy != "noeviction")?;
        Some(Complaint {
            detail: format!(
                "maxmemory-policy is {policy}: where memory is full, leases, retained messages, \
                 configurations and signs of life vanish"
            ),
            setting: "maxmemory-policy",
            value: "noeviction",
        })
    }
}

/// Limits of `client-output-buffer-limit pubsub`, in bytes; 0 = none.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct BufferLimits {
    hard: u64,
    soft: u64,
    soft_seconds: u64,
}

impl BufferLimits {
    /// Reads the value of the setting, as the server prints it.
    pub(super) fn parse(setting: &str) -> Option<Self> {
        let mut words = setting.split_whitespace().skip_while(|word| *word != "pubsub").skip(1);
        let mut number = || words.next()?.parse().ok();
        Some(Self { hard: number()?, soft: number()?, soft_seconds: number()? })
    }

    /// What is to be changed, if large messages would get a reader cut off.
    pub(super) fn complaint(self) -> Option<Complaint> {
        let low = |limit: u64, least: u64| limit != 0 && limit < least;
        (low(self.hard, LEAST_HARD_LIMIT) || low(self.soft, LEAST_SOFT_LIMIT)).then(|| Complaint {
            detail: format!(
                "client-output-buffer-limit is `pubsub {} {} {}`: the server closes readers of \
                 large messages",
                self.hard, self.soft, self.soft_seconds
            ),
            setting: "client-output-buffer-limit",
            value: "pubsub 256mb 128mb 60",
        })
    }
}

/// Asks the server who it is. Refused by its access list, the version stays unknown.
pub(super) async fn facts(connection: &mut MultiplexedConnection) -> RedisResult<ServerFacts> {
    // With one section alone older servers take no second one.
    match redis::cmd("INFO").query_async(connection).await {
        Ok(info) => Ok(ServerFacts::of(&info)),
        Err(error) if is_refusal(&error) => {
            let version = "redis (version not told)".to_owned();
            Ok(ServerFacts { version, ..ServerFacts::default() })
        }
        Err(error) => Err(error),
    }
}

/// Asks for the buffer limits; `None` where the access list forbids it.
pub(super) async fn buffer_limits(
    connection: &mut MultiplexedConnection,
) -> RedisResult<Option<BufferLimits>> {
    let mut command = redis::cmd("CONFIG");
    command.arg("GET").arg("client-output-buffer-limit");
    match command.query_async::<HashMap<String, String>>(connection).await {
        Ok(settings) => Ok(settings.values().find_map(|setting| BufferLimits::parse(setting))),
        Err(error) if is_refusal(&error) => Ok(None),
        Err(error) => Err(error),
    }
}

/// All fields of a hash, as far as they can be read within a time. `what` is in it, for people.
pub(super) async fn fields(
    connection: &mut MultiplexedConnection,
    (hash, what): (&str, &str),
    longest: Duration,
) -> Result<Vec<(Vec<u8>, Vec<u8>)>, BrokerError> {
    let asked = Cmd::hgetall(hash);
    match tokio::time::timeout(longest, asked.query_async(connection)).await {
        Ok(fields) => fields.map_err(|error: RedisError| BrokerError::Away(error.to_string())),
        Err(_) => Err(BrokerError::Away(format!("{what} could not be read in time"))),
    }
}

/// Whether the server answered, and said no.
pub(super) fn is_refusal(error: &RedisError) -> bool {
    !error.is_io_error() && !error.is_connection_dropped() && !error.is_unrecoverable_error()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn redis_and_valkey_tell_their_versions() {
        let facts = |info: &str| ServerFacts::of(&InfoDict::new(info));
        let redis = "# Server\r\nredis_version:7.0.15\r\nredis_git_sha1:0\r\nrun_id:abc\r\n";
        let found = facts(redis);
        assert_eq!(
            (found.version.as_str(), found.run_id.as_deref()),
            ("redis 7.0.15", Some("abc"))
        );
        let valkey = "# Server\r\nredis_version:7.2.4\r\nserver_name:valkey\r\nvalkey_version:9.1.2\r\nrun_id:d\r\n";
        assert_eq!(facts(valkey).version, "valkey 9.1.2");
        assert_eq!(facts("").version, "redis");
        let policy = |name: &str| facts(&format!("maxmemory_policy:{name}\r\n")).complaint();
        assert!(policy("allkeys-lru").unwrap().detail.contains("allkeys-lru"));
        assert_eq!(policy("noeviction").or(facts("").complaint()), None);
    }

    #[test]
    fn low_buffer_limits_are_named() {
        let default = "normal 0 0 0 slave 268435456 67108864 60 pubsub 33554432 8388608 60";
        let limits = BufferLimits::parse(default).unwrap();
        assert!(limits.complaint().unwrap().detail.contains("pubsub 33554432 8388608 60"));
        for good in ["pubsub 268435456 134217728 60", "normal 0 0 0 pubsub 0 0 0"] {
            assert_eq!(BufferLimits::parse(good).unwrap().complaint(), None, "{good}");
        }
        for low in ["pubsub 268435456 8388608 60", "pubsub 33554432 0 0"] {
            assert!(BufferLimits::parse(low).unwrap().complaint().is_some(), "{low}");
        }
        assert_eq!(BufferLimits::parse("normal 0 0 0"), None);
        assert_eq!(BufferLimits::parse("pubsub 1 x 2"), None);
    }
}
