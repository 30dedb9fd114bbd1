//! A watch that does not end: it connects again by itself and goes on behind the last event that it
//! saw.
//!
//! ```text
//! connect ─► events ─┬─ change, bookmark ─► told; the id moves on
//!    ▲               ├─ end, silence, trouble ─► wait (as the server says, longer after failures) ─┐
//!    └───────────────┴─────────────────────── Last-Event-ID ─────────────────────────────────────┘
//!  410: what it stands behind is gone ─► Relist: who watches lists, then goes on from there
//! ```

use std::collections::VecDeque;
use std::time::Duration;

use reqwest::Response;
use serde_json::Value;
use tokio::time::{sleep, timeout};

use super::call::Call;
use super::client::{Client, reason};
use super::kinds::BASE;
use super::refusal::Refusal;
use super::sse::{Event, Parser};
use super::text::{list, whole};
use crate::exit::CliError;

/// Bookmarks come every 15 s; after four that did not come, the connection is dead.
const SILENCE: Duration = Duration::from_secs(60);
/// Wait before connecting again where the server did not say.
const RETRY: Duration = Duration::from_secs(2);
/// Longest wait.
const LONGEST: Duration = Duration::from_secs(30);

/// What a watch tells.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Told {
    /// A commit, as the server gives it.
    Change(Value),
    /// Everything up to this revision was told.
    Bookmark(Value),
    /// The watch cannot go on from where it stands: list, then [`Watcher::resume`].
    Relist(Lost),
}

/// Why a watch cannot go on from where it stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Lost {
    /// The history does not reach back that far any more.
    Trimmed,
    /// The store is not there yet: another database, a restored backup, a slip in the number. With
    /// the store's revision.
    Ahead(Option<u64>),
}

impl Lost {
    fn of(refusal: &Refusal) -> Self {
        if refusal.code() == "revision_unknown" {
            Self::Ahead(refusal.number("revision"))
        } else {
            Self::Trimmed
        }
    }
}

/// A watch of the main service.
pub(crate) struct Watcher<'c> {
    client: &'c Client,
    /// Path and filters.
    call: Call,
    since: Option<u64>,
    /// The last event that was told.
    last_id: Option<String>,
    connection: Option<(Response, Parser)>,
    told: VecDeque<Event>,
    /// Whether the server ever answered: before, a failure is told at once.
    reached: bool,
    /// Failures since the last event.
    failures: u32,
    retry: Duration,
    /// Whether trouble that is overcome is told on stderr.
    talks: bool,
}

impl<'c> Watcher<'c> {
    /// A watch from a revision on; `None`: from now on.
    pub(crate) fn new(client: &'c Client, call: Call, since: Option<u64>, talks: bool) -> Self {
        Self {
            client,
            call,
            since,
            last_id: None,
            connection: None,
            told: VecDeque::new(),
            reached: false,
            failures: 0,
            retry: RETRY,
            talks,
        }
    }

    /// Goes on behind what was listed.
    pub(crate) fn resume(&mut self, since: u64) {
        self.since = Some(since);
        self.last_id = None;
        self.disconnect();
    }

    /// The next thing that happened. It waits as long as nothing does; broken connections are made
    /// anew.
    ///
    /// # Errors
    /// [`CliError`] when the first connection fails, or the server refuses (a token that has run
    /// out, a bad filter).
    pub(crate) async fn next(&mut self) -> Result<Told, CliError> {
        loop {
            if let Some(event) = self.told.pop_front() {
                if let Some(told) = self.judge(event)? {
                    return Ok(told);
                }
                continue;
            }
            let Some((response, parser)) = &mut self.connection else {
                if let Some(told) = self.connect().await? {
                    return Ok(told);
                }
                continue;
            };
            let trouble = match timeout(SILENCE, response.chunk()).await {
                Ok(Ok(Some(bytes))) => match parser.push(&bytes, &mut self.told) {
                    Ok(()) => None,
                    Err(too_large) => Some(too_large.to_string()),
                },
                // Streams end now and then, so that a load balancer can spread them anew: no
                // trouble.
                Ok(Ok(None)) => Some(String::new()),
                Ok(Err(error)) => Some(reason(&error)),
                Err(_) => Some(format!("nothing came for {} s", SILENCE.as_secs())),
            };
            if let Some(retry) = parser.retry() {
                self.retry = retry.min(LONGEST);
            }
            if let Some(trouble) = trouble {
                self.connection = None;
                self.trouble(&trouble);
            }
        }
    }

    async fn connect(&mut self) -> Result<Option<Told>, CliError> {
        if self.reached {
            sleep(self.pause()).await;
        }
        let since = self.since.map(|since| since.to_string());
        let call = self.call.clone().query_if("since", since).after(self.last_id.clone());
        match self.client.open(&call).await {
            Ok((response, revision)) => {
                self.reached = true;
                // From now on: this is the now.
                self.since = self.since.or(revision);
                self.connection = Some((response, Parser::default()));
                Ok(None)
            }
            Err(CliError::Problem(refusal)) if refusal.status == 410 => {
                self.reached = true;
                Ok(Some(Told::Relist(Lost::of(&refusal))))
            }
            Err(error) if self.reached && passes(&error) => {
                self.failures = self.failures.saturating_add(1);
                let first = error.to_string();
                self.trouble(first.lines().next().unwrap_or_default());
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }

    fn judge(&mut self, event: Event) -> Result<Option<Told>, CliError> {
        let parsed = serde_json::from_str::<Value>(&event.data).ok().filter(Value::is_object);
        let Some(data) = parsed else {
            return Err(self.client.odd(format!("an event {:?} is no JSON object", event.name)));
        };
        match event.name.as_str() {
            "change" | "bookmark" => {
                self.failures = 0;
                if !event.id.is_empty() {
                    self.last_id = Some(event.id);
                }
                Ok(Some(if event.name == "change" {
                    Told::Change(data)
                } else {
                    Told::Bookmark(data)
                }))
            }
            "error" => {
                self.disconnect();
                self.failures = self.failures.saturating_add(1);
                let refusal = Refusal::of(self.client.server(), 0, data);
                if matches!(refusal.code(), "revision_trimmed" | "revision_unknown") {
                    return Ok(Some(Told::Relist(Lost::of(&refusal))));
                }
                // A token that has run out may have been renewed in its file; if not, connecting
                // says so.
                let code = refusal.code().to_owned();
                self.trouble(&code);
                Ok(None)
            }
            // Of a later version.
            _ => Ok(None),
        }
    }

    fn disconnect(&mut self) {
        self.connection = None;
        self.told.clear();
    }

    /// The pause before the next connection: as the server says, doubled by each failure, and not
    /// the same for all.
    fn pause(&self) -> Duration {
        let longer = self.retry.saturating_mul(1 << self.failures.min(5));
        longer.min(LONGEST).mul_f64(rand::random_range(0.5..=1.0))
    }

    fn trouble(&self, reason: &str) {
        if self.talks && !reason.is_empty() {
            eprintln!(
                "blaze: the watch of {} was interrupted: {reason}; going on",
                self.client.server()
            );
        }
    }
}

/// Gives `take` each change of the commits after one revision up to another, with its revision.
/// Whether the history reaches back that far.
///
/// # Errors
/// As [`Watcher::next`], and whatever `take` says.
pub(crate) async fn changes_between(
    client: &Client,
    since: u64,
    until: u64,
    mut take: impl FnMut(u64, &Value) -> Result<(), CliError>,
) -> Result<bool, CliError> {
    let mut watcher = Watcher::new(client, Call::get(format!("{BASE}/watch")), Some(since), false);
    loop {
        let reached = match watcher.next().await? {
            Told::Relist(_) => return Ok(false),
            Told::Bookmark(bookmark) => whole(&bookmark, "revision"),
            Told::Change(commit) => {
                let revision = whole(&commit, "revision");
                for change in list(&commit, "changes").iter().filter(|_| revision <= until) {
                    take(revision, change)?;
                }
                revision
            }
        };
        if reached >= until {
            return Ok(true);
        }
    }
}

/// Whether a failure to connect passes by itself.
fn passes(error: &CliError) -> bool {
    match error {
        CliError::NoServer { .. } => true,
        CliError::Problem(refusal) => refusal.status == 429 || refusal.status >= 500,
        _ => false,
    }
}

#[cfg(test)]
#[path = "stream_tests.rs"]
mod tests;
