//! Questions to one node: which there are, how many at once, and who shares an answer. No I/O and
//! no clock.
//!
//! ```text
//! ask ─▶ answered within 0.5 s? ─▶ that answer
//!      ├▶ the same is open ───────▶ wait for it
//!      ├▶ room for one more ──────▶ send it
//!      └▶ else ───────────────────▶ wait for room
//! ```

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::Arc;

use blaze_domain::FlowId;
use tokio::sync::watch;
use tokio::time::Instant;

use super::limits::{MAX_PATH_BYTES, QUERIES, QUERY_TIME, SHARED_FOR};

/// Paths of a monitor.
const OF_MONITOR: &[&str] = &["/v1/node", "/v1/ping", "/v1/latency", "/v1/health", "/v1/series"];
/// Paths of a worker.
const OF_WORKER: &[&str] = &["/v1/status"];
/// Paths of a flow.
const OF_FLOW: &[&str] = &[
    "/v1/summary",
    "/v1/topics",
    "/v1/bridges",
    "/v1/peers",
    "/v1/allocation",
    "/v1/why",
    "/v1/ros2",
    "/v1/ros2/types",
];

/// Which program of a node is asked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Target {
    /// Its monitor.
    Monitor,
    /// Its worker.
    Worker,
    /// One of its flows.
    Flow(FlowId),
}

/// One question: `TARGET PATH`, of a closed set of paths.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Question(String);

impl Question {
    /// `None` for a path outside the closed set of the target, or one that is too long.
    #[must_use]
    pub fn new(target: &Target, path: &str, query: &[(&str, &str)]) -> Option<Self> {
        let (name, paths) = match target {
            Target::Monitor => ("monitor".to_owned(), OF_MONITOR),
            Target::Worker => ("worker".to_owned(), OF_WORKER),
            Target::Flow(flow) => (flow.to_string(), OF_FLOW),
        };
        let mut text = paths.contains(&path).then(|| format!("{name} {path}"))?;
        for (index, (name, value)) in query.iter().enumerate() {
            text.push(if index == 0 { '?' } else { '&' });
            text.push_str(name);
            text.push('=');
            encode(value, &mut text);
        }
        (text.len() <= MAX_PATH_BYTES).then_some(Self(text))
    }

    /// As it is sent.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// Percent-encoding of a value in a query; names of topics stay readable.
fn encode(value: &str, out: &mut String) {
    for byte in value.bytes() {
        match byte {
            b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b'~' | b'/' | b',' => {
                out.push(char::from(byte));
            }
            other => {
                // Writing to a text cannot fail.
                let _ = write!(out, "%{other:02X}");
            }
        }
    }
}

/// What a node answered.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Reply {
    /// Status of HTTP.
    pub status: u16,
    /// The body, unchanged.
    pub json: Box<str>,
    /// When it came.
    pub at: Instant,
}

type Waiting = watch::Receiver<Option<Arc<Reply>>>;

/// What to do with a question.
#[derive(Debug)]
pub enum Asked {
    /// It was answered just now.
    Answered(Arc<Reply>),
    /// Somebody has asked the same: wait for that.
    Open(Waiting),
    /// Send it with this id, then wait.
    Send(u64, Waiting),
    /// There is no room.
    Full,
}

#[derive(Debug)]
struct Open {
    question: Question,
    until: Instant,
    answer: watch::Sender<Option<Arc<Reply>>>,
}

/// The questions to one node.
#[derive(Debug, Default)]
pub struct Questions {
    last_id: u64,
    open: BTreeMap<u64, Open>,
    answered: BTreeMap<Question, Arc<Reply>>,
}

impl Questions {
    /// Asks.
    pub fn ask(&mut self, question: &Question, now: Instant) -> Asked {
        self.tidy(now);
        if let Some(reply) = self.answered.get(question) {
            return Asked::Answered(Arc::clone(reply));
        }
        if let Some(open) = self.open.values().find(|open| open.question == *question) {
            return Asked::Open(open.answer.subscribe());
        }
        if self.open.len() >= QUERIES {
            return Asked::Full;
        }
        self.last_id += 1;
        let (answer, waiting) = watch::channel(None);
        let open = Open { question: question.clone(), until: now + QUERY_TIME, answer };
        self.open.insert(self.last_id, open);
        Asked::Send(self.last_id, waiting)
    }

    /// Takes an answer. `false`: nobody has asked that, or not any more.
    pub fn answer(&mut self, id: u64, status: u16, json: String, now: Instant) -> bool {
        self.tidy(now);
        let Some(open) = self.open.remove(&id) else { return false };
        let reply = Arc::new(Reply { status, json: json.into_boxed_str(), at: now });
        open.answer.send_replace(Some(Arc::clone(&reply)));
        self.answered.insert(open.question, reply);
        true
    }

    /// A question could not be sent.
    pub fn give_up(&mut self, id: u64) {
        self.open.remove(&id);
    }

    /// Forgets what is too late or too old.
    pub fn tidy(&mut self, now: Instant) {
        self.open.retain(|_, open| now < open.until);
        self.answered.retain(|_, reply| now.saturating_duration_since(reply.at) < SHARED_FOR);
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn node() -> Question {
        Question::new(&Target::Monitor, "/v1/node", &[]).unwrap()
    }

    fn series(name: usize) -> Question {
        Question::new(&Target::Monitor, "/v1/series", &[("names", &name.to_string())]).unwrap()
    }

    #[test]
    fn only_paths_of_the_closed_set_are_questions() {
        let flow = Target::Flow("edge/robot-1".parse().unwrap());
        let topic = Question::new(&flow, "/v1/bridges", &[("topic", "imu/data & more")]).unwrap();
        assert_eq!(topic.as_str(), "edge/robot-1 /v1/bridges?topic=imu/data%20%26%20more");
        assert_eq!(node().as_str(), "monitor /v1/node");
        for (target, path) in [
            (&Target::Monitor, "/v1/why"),
            (&Target::Monitor, "/metrics"),
            (&Target::Monitor, "/v1/node?x=1"),
            (&Target::Worker, "/v1/node"),
            (&flow, "/v1/drain"),
            (&flow, "/v1/../metrics"),
        ] {
            assert_eq!(Question::new(target, path, &[]), None, "{target:?} {path}");
        }
        assert_eq!(Question::new(&flow, "/v1/why", &[("topic", &"a".repeat(3000))]), None);
    }

    #[test]
    fn an_answer_is_shared_for_half_a_second() {
        let (mut questions, now) = (Questions::default(), Instant::now());
        let Asked::Send(id, first) = questions.ask(&node(), now) else { panic!("not sent") };
        let Asked::Open(second) = questions.ask(&node(), now) else { panic!("asked twice") };
        assert!(questions.answer(id, 200, "{}".to_owned(), now));
        assert!(!questions.answer(id, 200, "{}".to_owned(), now), "it was answered");
        for waiting in [first, second] {
            assert_eq!(waiting.borrow().as_ref().map(|reply| reply.status), Some(200));
        }
        let later = now + Duration::from_millis(499);
        assert!(matches!(questions.ask(&node(), later), Asked::Answered(_)));
        let later = now + Duration::from_millis(500);
        assert!(matches!(questions.ask(&node(), later), Asked::Send(2, _)));
    }

    #[test]
    fn eight_are_open_at_once_for_five_seconds() {
        let (mut questions, now) = (Questions::default(), Instant::now());
        for index in 0..QUERIES {
            assert!(matches!(questions.ask(&series(index), now), Asked::Send(..)));
        }
        assert!(matches!(questions.ask(&series(99), now), Asked::Full));
        questions.give_up(1);
        assert!(matches!(questions.ask(&series(99), now), Asked::Send(9, _)));
        let late = now + QUERY_TIME;
        assert!(!questions.answer(2, 200, String::new(), late), "nobody waits any more");
        assert!(matches!(questions.ask(&series(100), late), Asked::Send(..)));
    }
}
