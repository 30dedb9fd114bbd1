//! The changes of the configuration that a run shows, when they come, and what they did.
//!
//! ```text
//!  0 %        20 %                    50 %     62 %                     then
//!  ├──────────┼───────────────────────┼────────┼────────────────────────┤
//!             analytics makes more              the link of robot-1 is a quarter as wide,
//!             results from fewer messages       and then as wide as before
//! ```
//!
//! Each is a PUT over REST. What is measured before and after it is what consumers got.

use std::time::{Duration, Instant};

use parking_lot::Mutex;
use serde::Serialize;
use tokio::sync::mpsc;
use tokio::time::{sleep, sleep_until};

use super::analytics::DEFAULT_WINDOW;
use super::board::Board;
use super::roles::{MOVES_FROM, MOVING_SERVICE, PUBLISHING_NODE};
use super::stage::Stage;

/// Where no topic has so many messages a second, no change shows.
pub const SLOWEST_HZ: f64 = 2.0;
/// A shorter run has no time for changes beside the move.
pub const SHORTEST: Duration = Duration::from_secs(10);
/// Parts of the run after which they come.
const SERVICE_AT: f64 = 0.2;
const LINK_AT: f64 = 0.62;
/// Messages of one result after the change.
const NEW_WINDOW: u32 = 10;
/// What is left of the limit.
const LIMIT_SHARE: f64 = 0.25;
/// After a new limit: what is on its way arrives.
const SETTLE: Duration = Duration::from_millis(500);

/// A change of the configuration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Wanted {
    /// Messages of one result of the service in the fog.
    Window(u32),
    /// `flow.bandwidth.limit_mbps` of robot-1; `None`: as its node file says.
    Limit(Option<f64>),
}

/// A change that was made and has reached whom it concerns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Taken {
    /// Of the change.
    pub revision: u64,
    /// From sending the request to its answer, which was a success.
    pub accepted: Duration,
    /// From sending the request to the callback.
    pub called_back: Duration,
}

/// What a run changes; `None` in a script: nothing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChangePlan {
    /// `flow.bandwidth.limit_mbps` of robot-1 as its node file has it.
    pub limit_mbps: f64,
    /// Whether pictures are played, which a limit is about.
    pub with_pictures: bool,
    /// Whether the limit is what holds the pictures up, as it is with the built-in recording.
    pub limit_binds: bool,
}

/// A change and what it did; part of the summary.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Change {
    /// The document that was put.
    pub document: String,
    /// The value in it.
    pub setting: &'static str,
    /// What it was.
    pub from: f64,
    /// What it became.
    pub to: f64,
    /// `layer/node` of whom it was for.
    pub at: String,
    /// The service there that was called back.
    pub service: &'static str,
    /// Store revision of the change.
    pub revision: u64,
    /// From sending the request to its 2xx, in milliseconds.
    pub accepted_ms: f64,
    /// From sending the request to the service's callback, in milliseconds.
    pub callback_ms: f64,
    /// What is counted to see the effect.
    pub effect: &'static str,
    /// So many a second before.
    pub before_per_s: f64,
    /// So many a second after.
    pub after_per_s: f64,
}

/// What came of the plan.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Changes {
    /// Those that were made.
    pub made: Vec<Change>,
    /// What went wrong, for people.
    pub problems: Vec<String>,
}

/// The name of the effect that the limit has.
pub const PICTURES: &str = "pictures";
/// The name of the effect that the window has.
const RESULTS: &str = "results";

/// Makes the changes of a plan at their times, beside everything else that goes on.
pub(super) struct Changing<'a, S> {
    pub(super) stage: &'a S,
    pub(super) board: &'a Board,
    pub(super) start: Instant,
    pub(super) duration: Duration,
    pub(super) plan: ChangePlan,
    /// What happens, in sentences.
    pub(super) events: mpsc::Sender<String>,
    pub(super) outcome: &'a Mutex<Changes>,
}

impl<S: Stage> Changing<'_, S> {
    /// Runs to the last change. A run that ends before has what was made until then.
    pub(super) async fn run(self) {
        self.until(SERVICE_AT).await;
        self.change_service().await;
        if self.plan.with_pictures {
            self.until(LINK_AT).await;
            self.change_link().await;
        } else {
            self.tell(
                "no pictures are played, so the limit of the link is left as it is".to_owned(),
            );
        }
    }

    /// How long is measured before and after a change.
    fn measure(&self) -> Duration {
        (self.duration / 8).clamp(Duration::from_secs(1), Duration::from_secs(3))
    }

    /// Waits until so long before a part of the run that there is time to measure.
    async fn until(&self, part: f64) {
        let at = self.start + self.duration.mul_f64(part) - self.measure();
        sleep_until(at.into()).await;
    }

    async fn change_service(&self) {
        let results = || self.stage.results() as f64;
        let before = self.rate(results).await;
        let Some(taken) = self.make(Wanted::Window(NEW_WINDOW)).await else {
            return;
        };
        let change = Change {
            document: format!("service/{MOVING_SERVICE}"),
            setting: "window",
            from: DEFAULT_WINDOW.into(),
            to: NEW_WINDOW.into(),
            at: MOVES_FROM.flow(),
            service: MOVING_SERVICE,
            effect: RESULTS,
            before_per_s: before,
            ..Change::of(&taken)
        };
        self.tell(change.asked());
        self.finish(change, results).await;
    }

    async fn change_link(&self) {
        let pictures = || self.board.pictures_elsewhere();
        let before = self.rate(pictures).await;
        let to = self.plan.limit_mbps * LIMIT_SHARE;
        let Some(taken) = self.make(Wanted::Limit(Some(to))).await else {
            return;
        };
        let change = Change {
            document: format!("node/{}", PUBLISHING_NODE.name()),
            setting: "flow.bandwidth.limit_mbps",
            from: self.plan.limit_mbps,
            to,
            at: PUBLISHING_NODE.flow(),
            service: blaze_flow::flow::service::NAME,
            effect: PICTURES,
            before_per_s: before,
            ..Change::of(&taken)
        };
        self.tell(change.asked());
        sleep(SETTLE).await;
        self.finish(change, pictures).await;
        if let Some(taken) = self.make(Wanted::Limit(None)).await {
            let (ms, limit) = (ms(taken.called_back), self.plan.limit_mbps);
            self.tell(format!(
                "the link of {} has {limit} Mbit/s again after {ms:.1} ms",
                PUBLISHING_NODE.flow()
            ));
        }
    }

    /// Measures what a change did.
    async fn finish(&self, mut change: Change, counted: impl Fn() -> f64) {
        change.after_per_s = self.rate(counted).await;
        self.tell(change.effect_text());
        self.outcome.lock().made.push(change);
    }

    /// So many a second, from now on for a while.
    async fn rate(&self, counted: impl Fn() -> f64) -> f64 {
        let (begin, first) = (Instant::now(), counted());
        sleep(self.measure()).await;
        (counted() - first) / begin.elapsed().as_secs_f64()
    }

    async fn make(&self, wanted: Wanted) -> Option<Taken> {
        match self.stage.change(&wanted).await {
            Ok(taken) => Some(taken),
            Err(fault) => {
                let what = match wanted {
                    Wanted::Window(_) => format!("the configuration of {MOVING_SERVICE}"),
                    Wanted::Limit(_) => format!("the limit of {}", PUBLISHING_NODE.flow()),
                };
                self.outcome.lock().problems.push(format!("{what} was not changed: {fault}"));
                None
            }
        }
    }

    fn tell(&self, text: String) {
        // The report takes a few of them at once; one more would be a picture of the past.
        let _ = self.events.try_send(text);
    }
}

impl Change {
    fn of(taken: &Taken) -> Self {
        Self {
            revision: taken.revision,
            accepted_ms: ms(taken.accepted),
            callback_ms: ms(taken.called_back),
            ..Self::default()
        }
    }

    /// What was asked for, and how quickly it was there.
    pub(super) fn asked(&self) -> String {
        format!(
            "PUT {} ({} {} → {}): 2xx after {:.1} ms, the callback of {} on {} after {:.1} ms",
            self.document,
            self.setting,
            self.from,
            self.to,
            self.accepted_ms,
            self.service,
            self.at,
            self.callback_ms
        )
    }

    /// What it did.
    pub(super) fn effect_text(&self) -> String {
        let each = if self.effect == PICTURES { " to each consumer in fog and cloud" } else { "" };
        format!(
            "{}: {:.1} → {:.1} {} a second{each}",
            self.service, self.before_per_s, self.after_per_s, self.effect
        )
    }
}

fn ms(duration: Duration) -> f64 {
    (duration.as_secs_f64() * 1e6).round() / 1e3
}
