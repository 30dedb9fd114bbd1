//! The live view: a picture, and then what changes of it. A reader that takes its time gets fewer
//! and larger changes; nothing waits for it.
//!
//! ```text
//! reader takes ─▶ (period over?) ─▶ Interest to the nodes, picture ─▶ patch from what it has
//! ```

use std::time::Duration;

use blaze_domain::config::{Code, Key, Problem};
use blaze_domain::{FlowId, LayerName, NodeName};
use futures::StreamExt as _;
use futures::future::join_all;
use futures::stream::{self, BoxStream};
use serde_json::{Map, Value, json};
use tokio::time::Instant;

use super::super::types::{Answer, Caller, ReadOptions};
use super::super::view::view;
use super::super::watch::Watches;
use super::read::answer;
use super::{ConfigService, not_found, selector};
use crate::status::health::Now;
use crate::status::limits::{LATENCY_NODES, LATENCY_PERIOD, TOPIC_NODES};
use crate::status::patch::{diff, without_nulls};
use crate::status::picture::{self, Filter};
use crate::status::questions::{Question, Reply, Target};

/// Between two bookmarks.
const BOOKMARK: Duration = Duration::from_secs(15);

/// What is looked at.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LiveView {
    /// All nodes at a glance.
    Fleet,
    /// One node in full.
    Node(NodeName),
    /// One topic, on the nodes where it is.
    Topic(String),
    /// Rows of the matrix of pings.
    Latency,
}

/// What `GET /live` is asked for.
#[derive(Debug, Clone)]
pub struct LiveQuery {
    /// What is looked at.
    pub view: LiveView,
    /// Only this layer.
    pub layer: Option<LayerName>,
    /// Only this node.
    pub node: Option<NodeName>,
    /// Only nodes with these labels.
    pub label_selector: Option<String>,
    /// Between two deltas, at least.
    pub period: Duration,
    /// Ends after so many seconds.
    pub timeout_s: Option<u32>,
}

/// What a reader gets. After `End` comes nothing.
#[derive(Debug, Clone)]
pub enum LiveItem {
    /// The picture.
    Snapshot(Value),
    /// A merge patch (RFC 7396) of it.
    Delta(Value),
    /// Nothing else is new; revision of the configuration.
    Bookmark(u64),
    /// Why it ends.
    End(Option<Box<Problem>>),
}

/// Items of a live view.
pub type LiveStream = BoxStream<'static, LiveItem>;

struct Live {
    service: ConfigService,
    caller: Caller,
    view: LiveView,
    filter: Filter,
    period: Duration,
    shown: Option<Value>,
    next_look: Instant,
    next_bookmark: Instant,
    end: Instant,
    ended: bool,
}

impl ConfigService {
    /// Opens a live view.
    ///
    /// # Errors
    /// [`Problem`].
    pub async fn live(
        &self,
        caller: &Caller,
        query: LiveQuery,
        read: &ReadOptions,
    ) -> Result<Answer<LiveStream>, Problem> {
        let (state, filter) = self.looked_at(caller, read).await?;
        let named = query.node.iter().map(Key::node).chain(query.layer.iter().map(Key::layer));
        for key in named {
            view(&caller.claims).check_key(&state, &key)?;
            state.get(&key).ok_or_else(|| not_found(&key, &state))?;
        }
        let filter = Filter {
            layer: query.layer,
            node: query.node,
            selector: query.label_selector.as_deref().map(selector).transpose()?,
            ..filter
        };
        let now = Instant::now();
        let timeout = query.timeout_s.map(|s| now + Duration::from_secs(u64::from(s)));
        let live = Live {
            service: self.clone(),
            caller: caller.clone(),
            period: match query.view {
                LiveView::Latency => query.period.max(LATENCY_PERIOD),
                _ => query.period,
            },
            view: query.view,
            filter,
            shown: None,
            next_look: now,
            next_bookmark: now + BOOKMARK,
            end: timeout.map_or_else(Watches::life_end, |end| end.min(Watches::life_end())),
            ended: false,
        };
        let items = stream::unfold(live, |mut live| async move {
            let item = live.next().await?;
            Some((item, live))
        });
        Ok(answer(&state, items.boxed()))
    }

    async fn picture(&self, live: &LiveView, filter: &Filter, period: Duration) -> Value {
        match live {
            LiveView::Fleet => self.fleet_picture(filter, period),
            LiveView::Node(node) => self.node_picture(node, filter, period).await,
            LiveView::Topic(topic) => self.topic_picture(topic, filter, period).await,
            LiveView::Latency => self.latency_picture(filter).await,
        }
    }

    fn fleet_picture(&self, filter: &Filter, period: Duration) -> Value {
        let (state, status) = (self.state(), self.status());
        let nodes: Vec<NodeName> =
            status.read(|fleet| filter.nodes(fleet).map(|(node, ..)| node.clone()).collect());
        status.look(&nodes, period);
        let workers = self.worker_states(&state);
        let worker = |node: &NodeName| workers.get(node).copied();
        let now: Now = crate::status::now();
        status.read(|fleet| picture::fleet(fleet, filter, state.revision(), &worker, now))
    }

    async fn node_picture(&self, node: &NodeName, filter: &Filter, period: Duration) -> Value {
        let seen = self.status().read(|fleet| {
            let mut nodes = filter.nodes(fleet);
            nodes.find(|(name, ..)| *name == node).map(|(_, layer, _)| layer.clone())
        });
        let Some(layer) = seen else { return json!({ "parts": {} }) };
        self.status().look([node], period);
        let flow = Target::Flow(FlowId::new(layer, node.clone()));
        let parts = [
            (&Target::Monitor, "/v1/node"),
            (&Target::Monitor, "/v1/health"),
            (&Target::Monitor, "/v1/latency"),
            (&Target::Worker, "/v1/status"),
            (&flow, "/v1/topics"),
            (&flow, "/v1/bridges"),
            (&flow, "/v1/peers"),
            (&flow, "/v1/allocation"),
        ];
        let questions = parts
            .iter()
            .filter_map(|(target, path)| Some((node.clone(), Question::new(target, path, &[])?)));
        self.parts(questions).await
    }

    async fn topic_picture(&self, topic: &str, filter: &Filter, period: Duration) -> Value {
        let mut nodes: Vec<(f64, NodeName, LayerName)> = self.status().read(|fleet| {
            let nodes = filter.nodes(fleet).filter_map(|(node, layer, _)| {
                let entry = fleet.entry(node)?;
                Some((entry.rates.dropped_hz, node.clone(), layer.clone()))
            });
            nodes.collect()
        });
        nodes.sort_by(|a, b| b.0.total_cmp(&a.0).then_with(|| a.1.cmp(&b.1)));
        nodes.truncate(TOPIC_NODES);
        self.status().look(nodes.iter().map(|(_, node, _)| node), period);
        let questions = nodes.into_iter().filter_map(|(_, node, layer)| {
            let flow = Target::Flow(FlowId::new(layer, node.clone()));
            let question = Question::new(&flow, "/v1/bridges", &[("topic", topic)])?;
            Some((node, question))
        });
        self.parts(questions).await
    }

    async fn latency_picture(&self, filter: &Filter) -> Value {
        let Some(question) = Question::new(&Target::Monitor, "/v1/ping", &[]) else {
            return json!({ "rows": {} });
        };
        let nodes: Vec<(NodeName, LayerName)> = self.status().read(|fleet| {
            let nodes = filter.nodes(fleet).filter(|(node, ..)| fleet.entry(node).is_some());
            let nodes = nodes.map(|(node, layer, _)| (node.clone(), layer.clone()));
            nodes.take(LATENCY_NODES).collect()
        });
        let question = &question;
        let rows = join_all(nodes.iter().map(|(node, layer)| async move {
            let reply = self.status().ask(node, question).await.ok()?;
            let rows = parsed(&reply)?.get_mut("nodes").map(Value::take)?;
            Some((format!("{layer}/{node}"), rows))
        }));
        let rows: Map<String, Value> = rows.await.into_iter().flatten().collect();
        without_nulls(json!({ "rows": rows }))
    }

    /// Answers of nodes, by the name of the question. What is not answered is absent.
    async fn parts(&self, questions: impl Iterator<Item = (NodeName, Question)>) -> Value {
        let asked = questions.map(|(node, question)| async move {
            let reply = self.status().ask(&node, &question).await.ok()?;
            let age_s = reply.at.elapsed().as_secs();
            let name = question.as_str().to_owned();
            Some((name, json!({ "age_s": age_s, "json": parsed(&reply)? })))
        });
        let parts: Map<String, Value> = join_all(asked).await.into_iter().flatten().collect();
        without_nulls(json!({ "parts": parts }))
    }
}

/// The JSON of an answer that is no refusal.
fn parsed(reply: &Reply) -> Option<Value> {
    (reply.status < 400).then(|| serde_json::from_str(&reply.json).ok()).flatten()
}

impl Live {
    async fn next(&mut self) -> Option<LiveItem> {
        if self.ended {
            return None;
        }
        loop {
            let until = self.next_look.min(self.end);
            let ended = self.service.ended(&self.caller.claims, until).await;
            if ended.is_some() || Instant::now() >= self.end {
                self.ended = true;
                return Some(LiveItem::End(ended.map(Box::new)));
            }
            if Instant::now() >= self.next_bookmark {
                self.next_bookmark = Instant::now() + BOOKMARK;
                return Some(LiveItem::Bookmark(self.service.revision()));
            }
            let picture = self.service.picture(&self.view, &self.filter, self.period).await;
            // From now on: a picture that took its time, or a reader, makes no haste afterwards.
            self.next_look = Instant::now() + self.period;
            let item = match &self.shown {
                None => Some(LiveItem::Snapshot(picture.clone())),
                Some(shown) => diff(shown, &picture).map(LiveItem::Delta),
            };
            self.shown = Some(picture);
            if item.is_some() {
                return item;
            }
        }
    }
}

/// A live view needs what it looks at.
///
/// # Errors
/// `invalid_request`.
pub fn live_view(
    word: Option<&str>,
    node: Option<&NodeName>,
    topic: Option<String>,
) -> Result<LiveView, Problem> {
    let missing = |name: &str| {
        let detail = format!("query parameter {name} is missing: this view needs it");
        Problem::new(Code::InvalidRequest, detail)
    };
    match word {
        Some("node") => Ok(LiveView::Node(node.cloned().ok_or_else(|| missing("node"))?)),
        Some("topic") => Ok(LiveView::Topic(topic.ok_or_else(|| missing("topic"))?)),
        Some("latency") => Ok(LiveView::Latency),
        _ => Ok(LiveView::Fleet),
    }
}
