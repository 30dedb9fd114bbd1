//! Looks whether the server still has what is kept on it. Under a memory policy it evicts whole
//! keys, and people delete some; neither is told.

use std::collections::HashSet;
use std::sync::Arc;
use std::time::Duration;

use blaze_runtime::pause;
use redis::aio::MultiplexedConnection;
use redis::{InfoDict, RedisResult};

use super::Shared;
use super::leases::{Leases, is_owned};

/// How often.
const LOOK: Duration = Duration::from_secs(10);
/// Keys that are asked for together.
const PER_BATCH: usize = 500;

/// Has written again what the server has lost, until the broker is closed.
pub(super) async fn watch(shared: Arc<Shared>, leases: Option<Arc<Leases>>) {
    shared.stop.run_until_cancelled(look_on(&shared, leases.as_deref())).await;
}

async fn look_on(shared: &Shared, leases: Option<&Leases>) {
    let mut before = HashSet::new();
    let mut evictions = Evictions::default();
    loop {
        pause(LOOK).await;
        let Some(connection) = shared.commands_now() else {
            before.clear();
            continue;
        };
        // What a flow forgets of a writer it deletes, and tells the service nothing of it. So for a
        // service only a server that evicts has lost it.
        if leases.is_none() && !evictions.are_seen(connection.clone()).await {
            continue;
        }
        let mut missing = match missing(connection, &kept(shared, leases), leases).await {
            Ok(missing) => missing,
            Err(error) => {
                tracing::debug!(%error, "redis does not tell what it has kept");
                continue;
            }
        };
        // Twice running, as what is on its way is not there yet.
        let lost: Vec<Arc<str>> =
            missing.iter().filter(|key| before.contains(*key)).cloned().collect();
        if !lost.is_empty() {
            missing.retain(|key| !lost.contains(key));
            tracing::warn!(
                keys = ?lost.iter().take(4).collect::<Vec<_>>(),
                count = lost.len(),
                "redis has lost what was kept on it: it is written again",
            );
            shared.mirror.lock().rewrite(|hash| lost.contains(hash));
            if let Some(leases) = leases
                && lost.contains(&leases.hash())
            {
                leases.rewrite_all();
            }
        }
        before = missing;
    }
}

/// The keys that the server is to have.
fn kept(shared: &Shared, leases: Option<&Leases>) -> Vec<Arc<str>> {
    if leases.is_some() && !is_owned(shared) {
        return Vec::new();
    }
    let mut keys = shared.mirror.lock().hashes();
    keys.extend(leases.filter(|leases| leases.count() > 0).map(Leases::hash));
    keys
}

/// Whether the server has evicted keys since the first look.
#[derive(Default)]
struct Evictions {
    first: Option<u64>,
    are_seen: bool,
}

impl Evictions {
    async fn are_seen(&mut self, mut connection: MultiplexedConnection) -> bool {
        let mut asked = redis::cmd("INFO");
        let stats: RedisResult<InfoDict> = asked.arg("stats").query_async(&mut connection).await;
        if let Some(count) = stats.ok().and_then(|stats| stats.get::<u64>("evicted_keys")) {
            let first = *self.first.get_or_insert(count);
            self.are_seen |= count != first;
        }
        self.are_seen
    }
}

/// The keys that are not there, or lack some of the leases: one that is written after the others
/// have vanished makes their key anew.
async fn missing(
    mut connection: MultiplexedConnection,
    keys: &[Arc<str>],
    leases: Option<&Leases>,
) -> RedisResult<HashSet<Arc<str>>> {
    let mut missing = HashSet::new();
    for some in keys.chunks(PER_BATCH) {
        let mut asked = redis::pipe();
        for key in some {
            asked.exists(&**key);
        }
        let found: Vec<bool> = asked.query_async(&mut connection).await?;
        missing
            .extend(some.iter().zip(found).filter(|(_, found)| !found).map(|(key, _)| key.clone()));
    }
    if let Some(leases) = leases.filter(|leases| keys.contains(&leases.hash())) {
        let hash = leases.hash();
        let there: usize = redis::cmd("HLEN").arg(&*hash).query_async(&mut connection).await?;
        if there < leases.count() {
            missing.insert(hash);
        }
    }
    Ok(missing)
}
