//! A lock on a Redis server, and changes that count only while it is held.
//!
//! ```text
//! hold(lock, time, note)        ─► one script   who has it, and for how long; the note of who had it
//! claim(lock, time)             ─► one script   who has it: of several the one with the largest name
//! apply_if_held(lock, changes)  ─► one script   all of it, or nothing if somebody else has the lock
//! ```

use std::time::Duration;

use blaze_domain::names::ChannelName;
use bytes::Bytes;
use redis::Script;

use super::keys::{KeyChange, KeyError, RedisKeys};
use crate::worker_side::Held;

/// How long a note stays that nobody repeats.
const NOTE_KEPT: Duration = Duration::from_secs(24 * 60 * 60);

/// A key that names its owner for as long as it is held.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RedisLock {
    /// Name, without the prefix of the section.
    pub key: String,
    /// Who wants it; no two owners have the same name.
    pub owner: String,
}

/// What runs on the server, which has it after the first call.
pub(super) struct Scripts {
    hold: Script,
    claim: Script,
    release: Script,
    apply: Script,
    pub(super) delete_record: Script,
}

impl Default for Scripts {
    fn default() -> Self {
        Self {
            hold: Script::new(HOLD),
            claim: Script::new(CLAIM),
            release: Script::new(RELEASE),
            apply: Script::new(APPLY),
            delete_record: Script::new(DELETE_RECORD),
        }
    }
}

impl RedisKeys {
    /// As [`RedisKeys::apply`], if the lock is held by its owner at that instant; returns whether
    /// it was. Otherwise nothing is done.
    ///
    /// # Errors
    /// [`KeyError`].
    pub async fn apply_if_held(
        &self,
        lock: &RedisLock,
        changes: &[KeyChange],
        messages: &[(ChannelName, Bytes)],
    ) -> Result<bool, KeyError> {
        if changes.is_empty() && messages.is_empty() {
            return Ok(true);
        }
        let mut call = self.scripts.apply.key(self.settings.names.key(&lock.key));
        for change in changes {
            call.key(self.settings.names.key(change.key()));
        }
        call.arg(&lock.owner);
        for command in self.pipeline(changes, messages).cmd_iter() {
            let words = command.args_iter().filter_map(|argument| match argument {
                redis::Arg::Simple(word) => Some(word),
                // A place for the cursor of a scan, of which there is none.
                _ => None,
            });
            let words: Vec<&[u8]> = words.collect();
            call.arg(words.len());
            for word in words {
                call.arg(word);
            }
        }
        self.call(|mut connection| async move { call.invoke_async::<bool>(&mut connection).await })
            .await
    }

    /// Takes a lock that nobody has, or goes on having it, for so long from now. Who had it before
    /// leaves a note beside it, which is kept for a day; who takes it gets the one that is there.
    ///
    /// # Errors
    /// [`KeyError`]: then it may run out, or be had.
    pub async fn hold(
        &self,
        lock: &RedisLock,
        time: Duration,
        note: Option<&str>,
    ) -> Result<Held, KeyError> {
        let mut call = self.scripts.hold.key(self.settings.names.key(&lock.key));
        call.key(self.settings.names.key(&format!("{}:told", lock.key)))
            .arg(&lock.owner)
            .arg(u64::try_from(time.as_millis()).unwrap_or(u64::MAX).max(1))
            .arg(NOTE_KEPT.as_millis().to_string())
            // An empty note is none.
            .arg(note.unwrap_or_default());
        let (is_held, note) = self
            .call(|mut connection| async move {
                call.invoke_async::<(bool, Option<String>)>(&mut connection).await
            })
            .await?;
        Ok(Held { is_held, note })
    }

    /// Takes a lock for so long from now, also from an owner whose name is smaller. Returns the name
    /// of an owner that keeps it, because its name is larger.
    ///
    /// # Errors
    /// [`KeyError`]: then it may be had.
    pub async fn claim(
        &self,
        lock: &RedisLock,
        time: Duration,
    ) -> Result<Option<String>, KeyError> {
        let mut call = self.scripts.claim.key(self.settings.names.key(&lock.key));
        call.arg(&lock.owner).arg(u64::try_from(time.as_millis()).unwrap_or(u64::MAX).max(1));
        self.call(|mut connection| async move { call.invoke_async(&mut connection).await }).await
    }

    /// Gives a lock up, if its owner has it.
    ///
    /// # Errors
    /// [`KeyError`]: then it runs out by itself.
    pub async fn release(&self, lock: &RedisLock) -> Result<(), KeyError> {
        let mut call = self.scripts.release.key(self.settings.names.key(&lock.key));
        call.arg(&lock.owner);
        self.call(|mut connection| async move { call.invoke_async::<()>(&mut connection).await })
            .await
    }
}

/// Taken when free, prolonged when one's own. Who had it before leaves its note, and everybody gets
/// what is there.
const HOLD: &str = r"
local owner = redis.call('GET', KEYS[1])
if owner and owner ~= ARGV[1] then return { 0, redis.call('GET', KEYS[2]) } end
redis.call('SET', KEYS[1], ARGV[1], 'PX', ARGV[2])
if owner and ARGV[4] ~= '' then redis.call('SET', KEYS[2], ARGV[4], 'PX', ARGV[3]) end
return { 1, redis.call('GET', KEYS[2]) }
";

/// Taken unless an owner with a larger name has it, who is returned.
const CLAIM: &str = r"
local owner = redis.call('GET', KEYS[1])
if owner and owner > ARGV[1] then return owner end
redis.call('SET', KEYS[1], ARGV[1], 'PX', ARGV[2])
return false
";

/// Commands, each with the number of its words before it, if the lock is one's own.
const APPLY: &str = r"
if redis.call('GET', KEYS[1]) ~= ARGV[1] then return 0 end
local at = 2
while at <= #ARGV do
  local count = tonumber(ARGV[at])
  redis.call(unpack(ARGV, at + 1, at + count))
  at = at + count + 1
end
return 1
";

/// Deleted when one's own.
const RELEASE: &str = r"
if redis.call('GET', KEYS[1]) == ARGV[1] then redis.call('DEL', KEYS[1]) end
return 1
";

/// A record that is deleted when a member of it has a value: that of another process is not.
const DELETE_RECORD: &str = r"
if redis.call('HGET', KEYS[1], ARGV[1]) == ARGV[2] then redis.call('DEL', KEYS[1]) end
return 1
";
