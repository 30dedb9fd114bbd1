//! Health of the system as monitors report it: streams of monitors, problems, targets.

use std::collections::BTreeMap;
use std::sync::Arc;

use blaze_domain::NodeName;
use blaze_domain::config::Problem;
use blaze_domain::config::state::State;
use serde_json::{Value, json};
use tokio::sync::mpsc;
use tokio::time::{Instant, MissedTickBehavior, interval};

use super::super::types::{Answer, Caller, ReadOptions};
use super::super::view::view;
use super::super::watch::Watches;
use super::ConfigService;
use super::read::answer;
use crate::auth::{Claims, Right};
use crate::status::health::{Health, Now};
use crate::status::limits::TICK;
use crate::status::picture::{self, Filter};
use crate::status::{Hub, MonitorHello, Refusal, Session, StatusMetrics, ToMonitor};

/// What `GET /problems` is asked for.
#[derive(Debug, Clone, Default)]
pub struct ProblemsQuery {
    /// Only of this layer.
    pub layer: Option<blaze_domain::LayerName>,
    /// Only of this state.
    pub state: Option<Health>,
}

impl ConfigService {
    /// Where monitors report.
    pub(crate) fn status(&self) -> &Arc<Hub> {
        &self.inner.status
    }

    /// Counters of the status streams.
    #[must_use]
    pub fn status_metrics(&self) -> &StatusMetrics {
        self.inner.status.metrics()
    }

    /// Opens a monitor's stream.
    ///
    /// # Errors
    /// [`Problem`]: the token is not that layer's worker's, or the node is none of that layer.
    pub async fn report(
        &self,
        caller: &Caller,
        hello: &MonitorHello,
        now: Now,
    ) -> Result<(Session, mpsc::Receiver<ToMonitor>), (Refusal, Problem)> {
        let permission = |problem| (Refusal::Permission, problem);
        self.authorize(&caller.claims, Right::Sync).map_err(permission)?;
        view(&caller.claims).check_layer(&hello.layer).map_err(permission)?;
        // A node that was just made somewhere else is known.
        let state = self.read_state(&ReadOptions::default()).await;
        let state = state.unwrap_or_else(|_| self.state());
        self.inner.status.enter(hello, &state, now)
    }

    /// Waits until a stream of this caller must end, and says why; `None`: it was open for long.
    pub async fn stream_end(&self, claims: &Claims) -> Option<Problem> {
        self.inner.watches.ended(claims, Watches::life_end()).await
    }

    /// The same until a time.
    pub(super) async fn ended(&self, claims: &Claims, until: Instant) -> Option<Problem> {
        self.inner.watches.ended(claims, until).await
    }

    /// What is wrong, worst first, then oldest.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn problems(
        &self,
        caller: &Caller,
        query: &ProblemsQuery,
        read: &ReadOptions,
    ) -> Result<Answer<Value>, Problem> {
        let (state, filter) = self.looked_at(caller, read).await?;
        let filter = Filter { layer: query.layer.clone(), ..filter };
        let found = self.inner.status.read(|f| picture::problems(f, &filter, query.state));
        let (items, total) = found;
        let revision = state.revision();
        let value = json!({
            "items": items, "total": total, "revision": revision, "next_page_token": "",
        });
        Ok(answer(&state, value))
    }

    /// Targets for Prometheus.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn targets(
        &self,
        caller: &Caller,
        read: &ReadOptions,
    ) -> Result<Answer<Value>, Problem> {
        let (state, filter) = self.looked_at(caller, read).await?;
        Ok(answer(&state, self.inner.status.read(|fleet| picture::targets(fleet, &filter))))
    }

    /// The state, and what the caller sees.
    pub(super) async fn looked_at(
        &self,
        caller: &Caller,
        read: &ReadOptions,
    ) -> Result<(State, Filter), Problem> {
        self.authorize(&caller.claims, Right::Read)?;
        let state = self.read_state(read).await?;
        self.inner.status.configure(&state);
        let filter = Filter { bound: view(&caller.claims).layer().cloned(), ..Filter::default() };
        Ok((state, filter))
    }

    /// Revision of each node's worker, and whether it is in sync.
    pub(super) fn worker_states(&self, state: &State) -> BTreeMap<NodeName, (u64, bool)> {
        self.inner.workers.of_nodes(|name, worker| {
            let in_sync = worker.is_connected()
                && worker.has.digest == self.inner.digests.of(state, &name.layer);
            (worker.has.revision, in_sync)
        })
    }

    pub(super) async fn evaluate_health(self) {
        let mut ticks = interval(TICK);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            let changes = self.inner.status.tick(&self.state(), crate::status::now());
            for change in changes {
                let (scope, name, state) = (change.scope, change.name, change.state.as_str());
                match change.state {
                    Health::Ok | Health::Unknown => tracing::info!(scope, name, state, "health"),
                    Health::Degraded | Health::Down => {
                        tracing::warn!(scope, name, state, code = change.code, "health");
                    }
                }
            }
        }
    }
}
