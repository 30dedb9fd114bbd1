//! Whose scope it is: a key on the server that the flow of the scope renews.
//!
//! ```text
//! every second: CLAIM ─┬─ "ours", "taken" ─► Owned
//!                      ├─ "new" ──────────► Owned, and what the server has lost is written again
//!                      └─ another's value ─► HeldBy: nothing is read or written
//! no renewal for 4 s ─► Lost: the key lives for 5 s, so the next owner begins after this one has stopped
//! ```

use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant};

use blaze_runtime::pause;
use redis::aio::MultiplexedConnection;
use redis::{RedisResult, Script};

use super::Shared;
use super::leases::Leases;
use super::server;
use super::state::ScopeOwnership;

/// Between two renewals.
const RENEW: Duration = Duration::from_secs(1);
/// Least time between two claims.
const SOON: Duration = Duration::from_millis(50);
/// How long the key lives without a renewal.
const LIFE: Duration = Duration::from_secs(5);
/// Without a renewal for this long the scope is given up.
const GIVE_UP: Duration = Duration::from_secs(4);
/// How long closing waits for the key's end.
const RELEASE: Duration = Duration::from_millis(300);

/// Epochs are compared as decimal texts, since numbers of the script have 53 bits.
static CLAIM: LazyLock<Script> = LazyLock::new(|| {
    Script::new(
        r"
local held = redis.call('GET', KEYS[1])
local mine = ARGV[1] .. '/' .. ARGV[2]
if held == mine then
  redis.call('PEXPIRE', KEYS[1], ARGV[3])
  return 'ours'
end
if not held then
  redis.call('SET', KEYS[1], mine, 'NX', 'PX', ARGV[3])
  return 'new'
end
local who, epoch = string.match(held, '^(.*)/(%d+)$')
if who == ARGV[1] and (#epoch < #ARGV[2] or (#epoch == #ARGV[2] and epoch < ARGV[2])) then
  redis.call('SET', KEYS[1], mine, 'PX', ARGV[3])
  return 'taken'
end
return 'held ' .. held
",
    )
});

static RELEASE_OURS: LazyLock<Script> = LazyLock::new(|| {
    Script::new(
        "if redis.call('GET', KEYS[1]) == ARGV[1] then return redis.call('DEL', KEYS[1]) end \
         return 0",
    )
});

/// What a claim gave.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Claim {
    /// It was ours before, or a former life's of ours.
    Ours,
    /// Nobody's: the server has lost it, or it is the first claim.
    New,
    /// Another's: `layer/node`, and its epoch where it is one of our own node.
    Held(String),
}

impl Claim {
    fn read(answer: &str, flow: &str) -> Self {
        match answer {
            "ours" | "taken" => Self::Ours,
            "new" => Self::New,
            other => {
                let value = other.strip_prefix("held ").unwrap_or(other);
                let who = value.rsplit_once('/').map_or(value, |(who, _)| who);
                // A newer life of the same node would read as this flow itself.
                Self::Held(if who == flow {
                    format!("{flow} with a newer epoch")
                } else {
                    who.to_owned()
                })
            }
        }
    }
}

/// The flow whose scope this is to be.
pub(super) struct Owner {
    shared: Arc<Shared>,
    leases: Arc<Leases>,
    /// `layer/node`.
    flow: String,
    epoch: String,
    /// When the last renewal that succeeded was sent.
    renewed: Option<Instant>,
}

impl Owner {
    pub(super) fn new(shared: Arc<Shared>, leases: Arc<Leases>, flow: String, epoch: u64) -> Self {
        Self { shared, leases, flow, epoch: epoch.to_string(), renewed: None }
    }

    /// Claims and renews until the broker is closed.
    pub(super) async fn run(mut self) {
        let stop = self.shared.stop.clone();
        stop.run_until_cancelled(self.keep()).await;
    }

    async fn keep(&mut self) {
        loop {
            let shared = Arc::clone(&self.shared);
            let connection = self.or_give_up(shared.commands()).await;
            let sent = Instant::now();
            let (flow, epoch) = (self.flow.clone(), self.epoch.clone());
            let key = self.shared.settings.names.owner();
            let claim = self.or_give_up(claim(connection, key, flow, epoch)).await;
            self.claimed(claim, sent);
            self.or_give_up(due(&shared, sent)).await;
        }
    }

    /// Waits for something; should the scope run out meanwhile, gives it up and waits on.
    async fn or_give_up<F: Future>(&mut self, future: F) -> F::Output {
        let Some(renewed) = self.renewed else {
            return future.await;
        };
        let mut future = std::pin::pin!(future);
        tokio::select! {
            biased;
            output = &mut future => return output,
            () = tokio::time::sleep_until((renewed + GIVE_UP).into()) => {}
        }
        self.renewed = None;
        self.shared
            .state
            .set_scope(ScopeOwnership::Lost("the scope could not be renewed for 4 s".to_owned()));
        future.await
    }

    fn claimed(&mut self, claim: RedisResult<Claim>, sent: Instant) {
        match claim {
            Ok(claim @ (Claim::Ours | Claim::New)) => {
                if claim == Claim::New {
                    self.write_again();
                }
                // An older answer says nothing of now; the next claim follows at once.
                if sent.elapsed() < GIVE_UP {
                    self.renewed = Some(sent);
                    self.shared.state.set_scope(ScopeOwnership::Owned);
                    self.leases.wake();
                }
            }
            Ok(Claim::Held(whom)) => {
                self.renewed = None;
                self.shared.state.set_scope(ScopeOwnership::HeldBy(whom));
            }
            Err(error) if server::is_refusal(&error) => {
                // Refused once is not yet refused for good: a server that loads its data says no
                // for a moment.
                if self.renewed.is_none() {
                    self.shared.state.set_scope(ScopeOwnership::Lost(format!(
                        "the scope cannot be claimed: {error}"
                    )));
                }
            }
            // The connection was lost, which its own task tells.
            Err(_) => {}
        }
    }

    fn write_again(&self) {
        self.leases.ledger.lock().rewrite_all();
        self.shared.mirror.lock().rewrite_all();
    }
}

/// Waits until the scope is to be claimed again: soon where nobody knows whose it is, else in due
/// time.
async fn due(shared: &Shared, sent: Instant) {
    let mut version = shared.state.version();
    let urgent = async {
        tokio::time::sleep(SOON).await;
        loop {
            version.mark_unchanged();
            let unclaimed =
                shared.state.read(|conditions| *conditions.scope() == ScopeOwnership::Unclaimed);
            if unclaimed && shared.commands_now().is_some() {
                return;
            }
            // The sender lives in `shared`.
            let _ = version.changed().await;
        }
    };
    tokio::select! {
        () = pause(RENEW.saturating_sub(sent.elapsed())) => {}
        () = urgent => {}
    }
}

async fn claim(
    mut connection: MultiplexedConnection,
    key: String,
    flow: String,
    epoch: String,
) -> RedisResult<Claim> {
    let answer: String = CLAIM
        .key(key)
        .arg(&flow)
        .arg(epoch)
        .arg(LIFE.as_millis().to_string())
        .invoke_async(&mut connection)
        .await?;
    Ok(Claim::read(&answer, &flow))
}

/// Ends the ownership, if it is ours, so that the next owner need not wait.
pub(super) async fn release(shared: &Shared, flow: &str, epoch: u64) {
    if shared.state.read(|conditions| *conditions.scope() != ScopeOwnership::Owned) {
        return;
    }
    let Some(mut connection) = shared.commands_now() else {
        return;
    };
    let mut script = RELEASE_OURS.key(shared.settings.names.owner());
    script.arg(format!("{flow}/{epoch}"));
    let released = script.invoke_async::<i64>(&mut connection);
    // Left behind, the key ends by itself.
    let _ = tokio::time::timeout(RELEASE, released).await;
}
