//! Keys on a Redis server: values, records with an expiry; locks are in module `lock`. What the
//! worker of BlazeConfig and the cache of a service keep there, beside messages.
//!
//! ```text
//! apply(changes, messages) ─► MULTI … EXEC   all of it or nothing
//! ```
//!
//! A connection is made when it is needed and forgotten when it fails: every call either does what
//! it should within its time or says that it did not.

use std::collections::BTreeMap;
use std::future::Future;
use std::time::Duration;

use blaze_domain::names::ChannelName;
use blaze_domain::node_file::RedisBroker as Section;
use blaze_runtime::pause;
use bytes::Bytes;
use parking_lot::Mutex;
use redis::aio::MultiplexedConnection;
use redis::{
    AsyncConnectionConfig, Cmd, FromRedisValue, InfoDict, RedisError, SetExpiry, SetOptions,
};

use super::lock::Scripts;
use super::settings::Settings;
use crate::open::OpenError;

/// Time for a connection to come about.
const CONNECT: Duration = Duration::from_secs(1);
/// Time for one call.
const CALL: Duration = Duration::from_secs(2);
/// Between two looks whether the server is still the same.
const LOOK: Duration = Duration::from_secs(1);
/// Keys that one look at many takes from the server at a time.
const SCAN: usize = 500;
/// The same of values, which may be large.
const VALUES: usize = 8;

/// Why a call did nothing, or nobody knows whether it did.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum KeyError {
    /// The server does not answer, or cannot do it as it is just now. What was asked for may have
    /// been done.
    #[error("{place}: {reason}")]
    Away {
        /// Host and port, or path.
        place: String,
        /// For people.
        reason: String,
    },
    /// The server said no, and will again.
    #[error("{place} refuses: {reason}")]
    Refused {
        /// Host and port, or path.
        place: String,
        /// In its words.
        reason: String,
    },
}

/// What a server says that starts, has no memory left, cannot write to its disk, is a replica just
/// now, or lets nobody in: it says so of everything, and after a while no more.
const PASSING: [&str; 11] = [
    "LOADING",
    "OOM",
    "MISCONF",
    "READONLY",
    "BUSY",
    "MASTERDOWN",
    "CLUSTERDOWN",
    "TRYAGAIN",
    "NOREPLICAS",
    "NOAUTH",
    "WRONGPASS",
];

/// Whether the server may do later what it does not do now.
fn passes(error: &RedisError) -> bool {
    if error.is_io_error()
        || error.is_timeout()
        || error.is_connection_dropped()
        || error.is_connection_refusal()
    {
        return true;
    }
    if matches!(error.kind(), redis::ErrorKind::AuthenticationFailed) {
        return true;
    }
    // Of a transaction that was given up, what was said of its commands.
    let said = error.clone().into_server_errors();
    let codes = said.iter().flat_map(|said| said.iter().map(|(_, error)| error.code()));
    codes.chain(error.code()).any(|code| PASSING.contains(&code))
}

/// One change of a key. Keys are given without the prefix of the section.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum KeyChange {
    /// It has this value, without expiry.
    Put {
        /// Name.
        key: String,
        /// Value.
        value: Bytes,
    },
    /// It is a record with these members and no others, for so long.
    PutRecord {
        /// Name.
        key: String,
        /// Members.
        members: BTreeMap<String, String>,
        /// After this time it vanishes.
        expires: Duration,
    },
    /// There is no such key.
    Delete {
        /// Name.
        key: String,
    },
}

impl KeyChange {
    /// The key that changes, without the prefix of the section.
    #[must_use]
    pub fn key(&self) -> &str {
        match self {
            Self::Put { key, .. } | Self::PutRecord { key, .. } | Self::Delete { key } => key,
        }
    }
}

/// Members of a record, by their names.
pub type Record = BTreeMap<String, String>;

/// A client for keys. Clones of what is behind it are cheap; calls may overlap.
pub struct RedisKeys {
    pub(super) settings: Settings,
    connection: Mutex<Option<MultiplexedConnection>>,
    /// Which start of the server was met last.
    run: Mutex<Option<String>>,
    pub(super) scripts: Scripts,
}

impl RedisKeys {
    /// Whether it can work, by what the section and its files say.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn check(section: &Section) -> Result<(), OpenError> {
        Settings::read(section).map(drop)
    }

    /// Reads what the section names. Connects nowhere.
    ///
    /// # Errors
    /// [`OpenError`] where it can never work.
    pub fn open(section: &Section) -> Result<Self, OpenError> {
        Ok(Self {
            settings: Settings::read(section)?,
            connection: Mutex::new(None),
            run: Mutex::new(None),
            scripts: Scripts::default(),
        })
    }

    /// Host and port, or path: for people, without secrets.
    #[must_use]
    pub fn place(&self) -> &str {
        &self.settings.place
    }

    /// Makes all changes, then publishes all messages: everything or nothing.
    ///
    /// # Errors
    /// [`KeyError`].
    pub async fn apply(
        &self,
        changes: &[KeyChange],
        messages: &[(ChannelName, Bytes)],
    ) -> Result<(), KeyError> {
        if changes.is_empty() && messages.is_empty() {
            return Ok(());
        }
        let mut pipe = self.pipeline(changes, messages);
        pipe.atomic();
        self.call(|mut connection| async move { pipe.query_async::<()>(&mut connection).await })
            .await
    }

    pub(super) fn pipeline(
        &self,
        changes: &[KeyChange],
        messages: &[(ChannelName, Bytes)],
    ) -> redis::Pipeline {
        let mut pipe = redis::pipe();
        for change in changes {
            self.add(&mut pipe, change);
        }
        for (channel, payload) in messages {
            let channel = self.settings.names.channel(channel);
            pipe.publish(&*channel, payload.as_ref()).ignore();
        }
        pipe
    }

    fn add(&self, pipe: &mut redis::Pipeline, change: &KeyChange) {
        match change {
            KeyChange::Put { key, value } => {
                pipe.set(self.settings.names.key(key), value.as_ref()).ignore();
            }
            KeyChange::PutRecord { key, members, expires } => {
                let key = self.settings.names.key(key);
                let members: Vec<(&str, &str)> =
                    members.iter().map(|(k, v)| (k.as_str(), v.as_str())).collect();
                let expires_ms = i64::try_from(expires.as_millis()).unwrap_or(i64::MAX).max(1);
                pipe.del(&key).ignore();
                if !members.is_empty() {
                    pipe.hset_multiple(&key, &members).ignore();
                    pipe.pexpire(&key, expires_ms).ignore();
                }
            }
            KeyChange::Delete { key } => {
                pipe.del(self.settings.names.key(key)).ignore();
            }
        }
    }

    /// The value of a key.
    ///
    /// # Errors
    /// [`KeyError`].
    pub async fn get(&self, key: &str) -> Result<Option<Bytes>, KeyError> {
        let value: Option<Vec<u8>> = self.ask(Cmd::get(self.settings.names.key(key))).await?;
        Ok(value.map(Bytes::from))
    }

    /// A key has this value, for so long (at least 1 ms).
    ///
    /// # Errors
    /// [`KeyError`].
    pub async fn put_for(
        &self,
        key: &str,
        value: &Bytes,
        expires: Duration,
    ) -> Result<(), KeyError> {
        let expires_ms = u64::try_from(expires.as_millis()).unwrap_or(u64::MAX).max(1);
        let options = SetOptions::default().with_expiration(SetExpiry::PX(expires_ms));
        self.ask(Cmd::set_options(self.settings.names.key(key), value.as_ref(), options)).await
    }

    /// There is no such record, if one member of it has this value.
    ///
    /// # Errors
    /// [`KeyError`].
    pub async fn delete_record(
        &self,
        key: &str,
        member: &str,
        value: &str,
    ) -> Result<(), KeyError> {
        let mut call = self.scripts.delete_record.key(self.settings.names.key(key));
        call.arg(member).arg(value);
        self.call(|mut connection| async move { call.invoke_async::<()>(&mut connection).await })
            .await
    }

    /// A record; `None` if there is none or it has vanished.
    ///
    /// # Errors
    /// [`KeyError`].
    pub async fn record(&self, key: &str) -> Result<Option<Record>, KeyError> {
        let members: Record = self.ask(Cmd::hgetall(self.settings.names.key(key))).await?;
        Ok((!members.is_empty()).then_some(members))
    }

    /// Those of some keys that are not there.
    ///
    /// # Errors
    /// [`KeyError`].
    pub async fn missing(&self, keys: &[String]) -> Result<Vec<String>, KeyError> {
        let mut missing = Vec::new();
        for part in keys.chunks(SCAN) {
            let mut pipe = redis::pipe();
            for key in part {
                pipe.exists(self.settings.names.key(key));
            }
            let found: Vec<bool> = self
                .call(|mut connection| async move { pipe.query_async(&mut connection).await })
                .await?;
            let gone = part.iter().zip(found).filter(|(_, is_there)| !is_there);
            missing.extend(gone.map(|(key, _)| key.clone()));
        }
        Ok(missing)
    }

    /// All values whose key begins so, at most so many; keys are given without the prefix of the
    /// section.
    ///
    /// # Errors
    /// [`KeyError`].
    pub async fn values(
        &self,
        beginning: &str,
        most: usize,
    ) -> Result<Vec<(String, Bytes)>, KeyError> {
        let found = self.each::<Option<Vec<u8>>>("GET", beginning, most, VALUES).await?;
        let there = |(key, value): (String, Option<Vec<u8>>)| Some((key, Bytes::from(value?)));
        Ok(found.into_iter().filter_map(there).collect())
    }

    /// All records whose key begins so, at most so many; keys are given without the prefix of the
    /// section.
    ///
    /// # Errors
    /// [`KeyError`].
    pub async fn records(
        &self,
        beginning: &str,
        most: usize,
    ) -> Result<Vec<(String, Record)>, KeyError> {
        let mut found = self.each::<Record>("HGETALL", beginning, most, SCAN).await?;
        found.retain(|(_, members)| !members.is_empty());
        Ok(found)
    }

    /// How long each key that begins so still lives, at most so many; keys without an end are left
    /// out.
    ///
    /// # Errors
    /// [`KeyError`].
    pub async fn lifetimes(
        &self,
        beginning: &str,
        most: usize,
    ) -> Result<Vec<(String, Duration)>, KeyError> {
        let found = self.each::<i64>("PTTL", beginning, most, SCAN).await?;
        let ends = found.into_iter();
        Ok(ends
            .filter_map(|(key, left)| Some((key, Duration::from_millis(left.try_into().ok()?))))
            .collect())
    }

    /// What a command gives for each key that begins so, asked for so many keys at a time.
    async fn each<T: FromRedisValue>(
        &self,
        command: &str,
        beginning: &str,
        most: usize,
        at_a_time: usize,
    ) -> Result<Vec<(String, T)>, KeyError> {
        let prefix = self.settings.names.key("");
        let pattern = format!("{}*", escaped(&self.settings.names.key(beginning)));
        let keys = self.keys(&pattern, most).await?;
        let mut out = Vec::with_capacity(keys.len());
        for part in keys.chunks(at_a_time) {
            let mut pipe = redis::pipe();
            for key in part {
                pipe.cmd(command).arg(key);
            }
            let found: Vec<T> = self
                .call(|mut connection| async move { pipe.query_async(&mut connection).await })
                .await?;
            let names = part.iter().map(|key| key.strip_prefix(&prefix).unwrap_or(key).to_owned());
            out.extend(names.zip(found));
        }
        Ok(out)
    }

    async fn keys(&self, pattern: &str, most: usize) -> Result<Vec<String>, KeyError> {
        let mut keys: std::collections::BTreeSet<String> = std::collections::BTreeSet::new();
        let mut cursor = 0_u64;
        loop {
            let mut scan = redis::cmd("SCAN");
            scan.arg(cursor).arg("MATCH").arg(pattern).arg("COUNT").arg(SCAN);
            let (next, part): (u64, Vec<String>) = self.ask(scan).await?;
            keys.extend(part);
            if next == 0 || keys.len() >= most {
                return Ok(keys.into_iter().take(most).collect());
            }
            cursor = next;
        }
    }

    /// Waits until the server has been started anew: then it may have lost what it had. One that
    /// does not say which start it is (no right to `INFO`) is never found to be another.
    pub async fn restarted(&self) {
        loop {
            if let Ok(Some(run)) = self.run_id().await {
                let mut last = self.run.lock();
                let is_another = last.as_ref().is_some_and(|last| *last != run);
                *last = Some(run);
                if is_another {
                    return;
                }
            }
            pause(LOOK).await;
        }
    }

    /// Which start of the server this is: after another one, what it had may be lost. `None`: it
    /// does not say.
    ///
    /// # Errors
    /// [`KeyError`].
    pub async fn run_id(&self) -> Result<Option<String>, KeyError> {
        let info: InfoDict = self.ask(redis::cmd("INFO").arg("server").take()).await?;
        Ok(info.get("run_id"))
    }

    async fn ask<T: FromRedisValue>(&self, command: Cmd) -> Result<T, KeyError> {
        self.call(|mut connection| async move { command.query_async(&mut connection).await }).await
    }

    pub(super) async fn call<T, F>(
        &self,
        ask: impl FnOnce(MultiplexedConnection) -> F,
    ) -> Result<T, KeyError>
    where
        F: Future<Output = Result<T, RedisError>>,
    {
        let connection = self.connection().await?;
        let answer = tokio::time::timeout(CALL, ask(connection)).await;
        let answer = answer.unwrap_or_else(|_| {
            Err(RedisError::from((redis::ErrorKind::Io, "no answer within 2 s")))
        });
        answer.map_err(|error| self.failed(&error))
    }

    async fn connection(&self) -> Result<MultiplexedConnection, KeyError> {
        if let Some(connection) = self.connection.lock().clone() {
            return Ok(connection);
        }
        let config = AsyncConnectionConfig::new()
            .set_connection_timeout(Some(CONNECT))
            .set_response_timeout(Some(CALL));
        // A file may be missing for the moment in which it is exchanged.
        let client = self.settings.client().map_err(|error| KeyError::Away {
            place: self.settings.place.clone(),
            reason: error.to_string(),
        })?;
        let made = client.get_multiplexed_async_connection_with_config(&config).await;
        let connection = made.map_err(|error| self.failed(&error))?;
        *self.connection.lock() = Some(connection.clone());
        Ok(connection)
    }

    fn failed(&self, error: &RedisError) -> KeyError {
        let (place, reason) = (self.settings.place.clone(), error.to_string());
        // Also after a refusal: a server that became a replica, or wants another password, is
        // another one behind the same name.
        *self.connection.lock() = None;
        match passes(error) {
            true => KeyError::Away { place, reason },
            false => KeyError::Refused { place, reason },
        }
    }
}

/// A text that a pattern of the server finds as it is.
fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for character in text.chars() {
        if matches!(character, '*' | '?' | '[' | ']' | '\\' | '^' | '-') {
            out.push('\\');
        }
        out.push(character);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pattern_finds_the_text_itself() {
        assert_eq!(escaped("blaze:watchdog:"), "blaze:watchdog:");
        assert_eq!(escaped("a*b?[c]\\"), "a\\*b\\?\\[c\\]\\\\");
    }
}
