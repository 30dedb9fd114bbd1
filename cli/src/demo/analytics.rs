//! What the service `analytics` does with the messages that come to it: how evenly they come.
//!
//! Of each `window` messages it makes one result: the mean and the largest gap between two of them.
//! How many that are is its configuration; a change of it takes effect with the next message.

use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_sdk::{ConfigChange, ConfigListener, ServiceManager};
use parking_lot::Mutex;
use serde_json::Value;
use tokio::sync::watch;

/// Messages of one result where nothing else is said.
pub const DEFAULT_WINDOW: u32 = 50;
/// Most of them: an hour of 50 Hz.
const MAX_WINDOW: u32 = 180_000;
/// Member of its configuration.
pub const WINDOW: &str = "window";

/// How evenly the messages of one window came.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Evenness {
    /// Between two messages.
    pub mean_gap: Duration,
    /// Between two messages.
    pub largest_gap: Duration,
}

/// The service, on one node.
#[derive(Debug)]
pub struct Analytics {
    state: Mutex<State>,
    called_back: watch::Sender<Option<CalledBack>>,
}

/// The last change of its configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CalledBack {
    /// Of the configuration.
    pub revision: u64,
    /// When the callback ran.
    pub at: Instant,
}

#[derive(Debug)]
struct State {
    window: u32,
    /// Gaps of the window that is being filled.
    gaps: u32,
    sum: Duration,
    largest: Duration,
    last: Option<Instant>,
    results: u64,
    newest: Option<Evenness>,
}

impl Default for Analytics {
    fn default() -> Self {
        Self {
            state: Mutex::new(State {
                window: DEFAULT_WINDOW,
                gaps: 0,
                sum: Duration::ZERO,
                largest: Duration::ZERO,
                last: None,
                results: 0,
                newest: None,
            }),
            called_back: watch::Sender::new(None),
        }
    }
}

impl Analytics {
    /// A message came.
    pub fn take(&self, now: Instant) {
        let mut state = self.state.lock();
        let Some(last) = state.last.replace(now) else {
            return;
        };
        let gap = now.saturating_duration_since(last);
        state.gaps += 1;
        state.sum += gap;
        state.largest = state.largest.max(gap);
        if state.gaps >= state.window {
            state.newest =
                Some(Evenness { mean_gap: state.sum / state.gaps, largest_gap: state.largest });
            state.results += 1;
            (state.gaps, state.sum, state.largest) = (0, Duration::ZERO, Duration::ZERO);
        }
    }

    /// Results so far.
    pub fn results(&self) -> u64 {
        self.state.lock().results
    }

    /// The newest result.
    pub fn newest(&self) -> Option<Evenness> {
        self.state.lock().newest
    }

    /// Follows the service's configuration as long as the listener is held.
    pub fn follow(self: &Arc<Self>, service: &ServiceManager) -> ConfigListener {
        let analytics = Arc::clone(self);
        service.config().on_change(move |change| analytics.changed(change))
    }

    /// Its last change, and those to come.
    pub fn called_back(&self) -> watch::Receiver<Option<CalledBack>> {
        self.called_back.subscribe()
    }

    fn changed(&self, change: &ConfigChange) {
        let at = Instant::now();
        // What is no window changes nothing: the service goes on as it was.
        if let Some(window) = change.new.as_deref().and_then(window_of) {
            self.state.lock().window = window;
        }
        self.called_back.send_replace(Some(CalledBack { revision: change.revision, at }));
    }
}

fn window_of(config: &Value) -> Option<u32> {
    let window = u32::try_from(config.get(WINDOW)?.as_u64()?).ok()?;
    (1..=MAX_WINDOW).contains(&window).then_some(window)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn change(revision: u64, config: Value) -> ConfigChange {
        ConfigChange {
            old: None,
            new: Some(Arc::new(config)),
            revision,
            hash: Some(format!("sha256:{revision}")),
            paths: Vec::new(),
            scopes: Vec::new(),
            deleted: false,
        }
    }

    #[test]
    fn a_window_makes_one_result_and_a_change_holds_from_the_next_message_on() {
        let (analytics, start) = (Analytics::default(), Instant::now());
        let at = |ms: u64| start + Duration::from_millis(ms);
        (0..=50).for_each(|n| analytics.take(at(n * 20)));
        assert_eq!(analytics.results(), 1);
        let even = Evenness {
            mean_gap: Duration::from_millis(20),
            largest_gap: Duration::from_millis(20),
        };
        assert_eq!(analytics.newest(), Some(even));
        analytics.changed(&change(7, json!({ "window": 2 })));
        assert_eq!(analytics.called_back().borrow().map(|back| back.revision), Some(7));
        [1_020, 1_080].into_iter().for_each(|ms| analytics.take(at(ms)));
        assert_eq!(analytics.results(), 2);
        assert_eq!(
            analytics.newest(),
            Some(Evenness {
                mean_gap: Duration::from_millis(40),
                largest_gap: Duration::from_millis(60)
            })
        );
    }

    #[test]
    fn what_is_no_window_changes_nothing() {
        for bad in [
            json!({}),
            json!({ "window": 0 }),
            json!({ "window": "2" }),
            json!({ "window": 1e9 }),
            json!(3),
        ] {
            assert_eq!(window_of(&bad), None, "{bad}");
        }
        assert_eq!(window_of(&json!({ "window": 10 })), Some(10));
    }
}
