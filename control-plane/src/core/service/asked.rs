//! Questions that nodes answer: why a topic does not arrive, which topics there are, series.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::config::{Code, Key, Problem};
use blaze_domain::{FlowId, LayerName, NodeName, TopicName};
use futures::future::join_all;
use serde_json::{Map, Value, json};

use super::super::page::Position;
use super::super::types::{Answer, Caller, Page, ReadOptions};
use super::super::view::view;
use super::read::{answer, page_size};
use super::{ConfigService, not_found};
use crate::status::Failed;
use crate::status::fleet::Presence;
use crate::status::picture::Filter;
use crate::status::questions::{Question, Reply, Target};
use crate::status::topics::{self, Topic, Topics};
use crate::status::why::{self, Asked, FlowAnswer};

/// Between the two looks at the counters of bridges: long enough for a topic of a few hertz.
const RATE_TIME: Duration = Duration::from_secs(1);

/// One end of a topic: `layer[/node[/service]]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct End {
    text: String,
    layer: LayerName,
    node: Option<NodeName>,
}

impl std::str::FromStr for End {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let mut parts = text.split('/');
        let fault = |error: &dyn std::fmt::Display| format!("layer[/node[/service]]: {error}");
        let layer = parts.next().unwrap_or_default().parse().map_err(|error| fault(&error))?;
        let node = parts.next().map(str::parse).transpose().map_err(|error| fault(&error))?;
        let service = parts.next().map(str::parse::<blaze_domain::ServiceName>);
        service.transpose().map_err(|error| fault(&error))?;
        match parts.next() {
            Some(_) => Err(fault(&"it has more than three parts")),
            None => Ok(Self { text: text.to_owned(), layer, node }),
        }
    }
}

/// What `GET /why` is asked for.
#[derive(Debug, Clone)]
pub struct WhyQuery {
    /// Topic.
    pub topic: TopicName,
    /// Whom it should reach.
    pub to: Option<End>,
    /// Whose publisher.
    pub from: Option<End>,
}

/// What `GET /topics` is asked for.
#[derive(Debug, Clone, Default)]
pub struct TopicsQuery {
    /// Begin of the names.
    pub prefix: String,
    /// 1 to 1000; `None`: 100.
    pub limit: Option<u32>,
    /// Of the page before.
    pub page_token: String,
}

type Asking = Result<Arc<Reply>, Failed>;

impl ConfigService {
    /// Why a topic does or does not arrive: asks the publisher's and the consumer's flow.
    ///
    /// # Errors
    /// [`Problem`]; `node_unreachable` if neither answers.
    pub async fn why(
        &self,
        caller: &Caller,
        query: &WhyQuery,
        read: &ReadOptions,
    ) -> Result<Answer<Value>, Problem> {
        let (state, filter) = self.looked_at(caller, read).await?;
        for end in [&query.from, &query.to].into_iter().flatten() {
            if let Some(node) = &end.node {
                let key = Key::node(node);
                let is_seen = filter.bound.as_ref().is_none_or(|bound| *bound == end.layer);
                if is_seen && state.get(&key).is_none() {
                    return Err(not_found(&key, &state));
                }
            }
        }
        let flows = self.ends(query, &filter).await;
        let asked: Vec<(FlowId, Asking, Asking)> = join_all(flows.iter().map(|flow| async {
            let (why, bridges) = tokio::join!(
                self.ask_flow(flow, "/v1/why", query),
                self.ask_flow(flow, "/v1/bridges", query)
            );
            (flow.clone(), why, bridges)
        }))
        .await;
        let mut answers = Vec::new();
        tokio::time::sleep(match asked.iter().any(|(_, _, bridges)| bridges.is_ok()) {
            true => RATE_TIME,
            false => Duration::ZERO,
        })
        .await;
        for (flow, why, before) in &asked {
            let Ok(why) = why else { continue };
            let bridges = match before {
                Ok(before) => self.again(flow, query, before).await,
                Err(_) => None,
            };
            answers.push(FlowAnswer { flow: flow.clone(), why: why.json.to_string(), bridges });
        }
        let to = query.to.as_ref().map(|to| to.text.as_str());
        let question = Asked { topic: query.topic.as_str(), to, bound: filter.bound.as_ref() };
        let Some(mut merged) = why::merge(&question, &answers) else {
            return Err(unreachable(&asked));
        };
        merged.insert("asked".to_owned(), self.asked_json(&asked));
        Ok(answer(&state, Value::Object(merged)))
    }

    async fn again(
        &self,
        flow: &FlowId,
        query: &WhyQuery,
        before: &Reply,
    ) -> Option<(String, String, Duration)> {
        let after = self.ask_flow(flow, "/v1/bridges", query).await.ok()?;
        let time = after.at.saturating_duration_since(before.at);
        Some((before.json.to_string(), after.json.to_string(), time))
    }

    async fn ask_flow(&self, flow: &FlowId, path: &str, query: &WhyQuery) -> Asking {
        let to = query.to.as_ref().map(|to| ("to", to.text.as_str()));
        let mut parameters = vec![("topic", query.topic.as_str())];
        parameters.extend(to.filter(|_| path == "/v1/why"));
        let question = Question::new(&Target::Flow(flow.clone()), path, &parameters);
        self.status().ask(&flow.node, &question.ok_or(Failed::Unreachable)?).await
    }

    /// Who was asked, with what result, and how old that node's status is.
    fn asked_json(&self, asked: &[(FlowId, Asking, Asking)]) -> Value {
        let row = |(flow, why, _): &(FlowId, Asking, Asking)| {
            let status = why.as_ref().map_or(503, |reply| reply.status);
            let age = self.status().read(|fleet| {
                fleet.entry(&flow.node).map(|entry| entry.age(crate::status::now()).as_secs())
            });
            json!({ "flow": flow.to_string(), "status": status, "age_s": age })
        };
        asked.iter().map(row).collect()
    }

    /// The publisher's and the consumer's flow, as far as they are known and seen.
    async fn ends(&self, query: &WhyQuery, filter: &Filter) -> Vec<FlowId> {
        let named = |end: &Option<End>| {
            let end = end.as_ref()?;
            Some(FlowId::new(end.layer.clone(), end.node.clone()?))
        };
        let (mut from, mut to) = (named(&query.from), named(&query.to));
        let sees = |flow: &FlowId| filter.bound.as_ref().is_none_or(|b| *b == flow.layer);
        let ready = self.ready_flows(filter);
        if from.is_none() || to.is_none() {
            let topic = self.topic_places(&query.topic, &ready, filter).await;
            let layer = |end: &Option<End>| end.as_ref().map(|end| end.layer.clone());
            let (of_from, of_to) = (layer(&query.from), layer(&query.to));
            from = from.or_else(|| self.place(&topic.publishers, of_from.as_ref(), None));
            to = to.or_else(|| self.place(&topic.requesters, of_to.as_ref(), from.as_ref()));
            // Whoever is there knows what is missing.
            from = from.or_else(|| {
                let there = of_from.as_ref().and_then(|layer| ready.get(layer));
                there.or_else(|| ready.values().next().filter(|_| to.is_none())).cloned()
            });
            to = to.or_else(|| of_to.as_ref().and_then(|layer| ready.get(layer)).cloned());
        }
        let mut flows: Vec<FlowId> = [from, to].into_iter().flatten().filter(sees).collect();
        flows.dedup();
        flows
    }

    /// Of the places of a topic one that reports, at best on another node than `other`.
    fn place(
        &self,
        places: &std::collections::BTreeSet<topics::Place>,
        layer: Option<&LayerName>,
        other: Option<&FlowId>,
    ) -> Option<FlowId> {
        let flows = places.iter().filter_map(|(l, node, _)| {
            let flow = FlowId::new(l.parse().ok()?, node.parse().ok()?);
            layer.is_none_or(|layer| *layer == flow.layer).then_some(flow)
        });
        let is_there = |flow: &FlowId| self.status().is_connected(&flow.node);
        flows.max_by_key(|flow| (is_there(flow), other != Some(flow)))
    }

    async fn topic_places(
        &self,
        topic: &TopicName,
        ready: &BTreeMap<LayerName, FlowId>,
        filter: &Filter,
    ) -> Topic {
        let mut all = Topics::new();
        let query = [("topic", topic.as_str())];
        for reply in self.ask_each(ready.values(), &query).await.into_iter().flatten() {
            topics::merge(&mut all, &reply.json, topic.as_str(), filter.bound.as_ref());
        }
        all.remove(topic.as_str()).unwrap_or_default()
    }

    async fn ask_each(
        &self,
        flows: impl Iterator<Item = &FlowId>,
        query: &[(&str, &str)],
    ) -> Vec<Asking> {
        let asked = flows.map(|flow| async move {
            let question = Question::new(&Target::Flow(flow.clone()), "/v1/topics", query);
            self.status().ask(&flow.node, &question.ok_or(Failed::Unreachable)?).await
        });
        join_all(asked).await
    }

    /// One ready flow of each layer that is seen.
    fn ready_flows(&self, filter: &Filter) -> BTreeMap<LayerName, FlowId> {
        self.status().read(|fleet| {
            let mut ready = BTreeMap::new();
            for (node, layer, _) in filter.nodes(fleet) {
                let is_ready = fleet.entry(node).is_some_and(|entry| {
                    let flows = entry.report.as_ref().map_or(0, |r| r.head.ready_flows);
                    entry.presence() == Presence::Present && flows > 0
                });
                if is_ready && !ready.contains_key(layer) {
                    ready.insert(layer.clone(), FlowId::new(layer.clone(), node.clone()));
                }
            }
            ready
        })
    }

    /// Topics with publishers and requesters; asks one ready flow a layer.
    ///
    /// # Errors
    /// [`Problem`]; `node_unreachable` if none answers.
    pub async fn topics(
        &self,
        caller: &Caller,
        query: &TopicsQuery,
        read: &ReadOptions,
    ) -> Result<Answer<Page<Value>>, Problem> {
        let (state, filter) = self.looked_at(caller, read).await?;
        let limit = page_size(query.limit)?;
        let bound = json!(["topics", filter.bound, query.prefix]).to_string();
        let after = match query.page_token.as_str() {
            "" => None,
            token => Some(self.inner.pages.position(&bound, token)?.after),
        };
        let ready = self.ready_flows(&filter);
        let replies = self.ask_each(ready.values(), &[]).await;
        if let (Some(flow), false) = (ready.values().next(), replies.iter().any(Result::is_ok)) {
            return Err(Failed::Unreachable.problem(&flow.node));
        }
        let mut all = Topics::new();
        for reply in replies.into_iter().flatten().filter(|reply| reply.status < 400) {
            topics::merge(&mut all, &reply.json, &query.prefix, filter.bound.as_ref());
        }
        let mut rest = all.iter().filter(|(name, _)| after.as_ref().is_none_or(|a| *name > a));
        let shown: Vec<(&String, &Topic)> = rest.by_ref().take(limit).collect();
        let last = rest.next().and(shown.last());
        let next = last.map(|(name, _)| {
            let position = Position { revision: state.revision(), after: (*name).clone() };
            self.inner.pages.token(&bound, &position)
        });
        let page = Page {
            items: shown.iter().map(|(name, topic)| topics::item(name, topic)).collect(),
            next_page_token: next.unwrap_or_default(),
        };
        Ok(answer(&state, page))
    }

    /// Series of a node's monitor: its answer, unchanged.
    ///
    /// # Errors
    /// [`Problem`]; `node_unreachable` if it does not answer.
    pub async fn series(
        &self,
        caller: &Caller,
        node: &NodeName,
        names: &str,
        read: &ReadOptions,
    ) -> Result<Answer<Arc<Reply>>, Problem> {
        let (state, _) = self.looked_at(caller, read).await?;
        let key = Key::node(node);
        view(&caller.claims).check_key(&state, &key)?;
        state.get(&key).ok_or_else(|| not_found(&key, &state))?;
        let query = [("names", names)];
        let query = if names.is_empty() { &query[..0] } else { &query[..] };
        let question = Question::new(&Target::Monitor, "/v1/series", query).ok_or_else(|| {
            Problem::new(Code::InvalidRequest, "query parameter names is too long")
        })?;
        let reply = self.status().ask(node, &question).await;
        let reply = reply.map_err(|failed| failed.problem(node))?;
        match reply.status {
            200..400 => Ok(answer(&state, reply)),
            400..500 => Err(Problem::new(Code::InvalidRequest, said(&reply))),
            _ => Err(Failed::Unreachable.problem(node).because(said(&reply))),
        }
    }
}

/// What a monitor says of a question that it refuses.
fn said(reply: &Reply) -> String {
    let body: Map<String, Value> = serde_json::from_str(&reply.json).unwrap_or_default();
    let detail = body.get("error").and_then(|error| error["detail"].as_str());
    let detail: String = detail.unwrap_or("no reason given").chars().take(200).collect();
    format!("the monitor refuses it: {detail}")
}

fn unreachable(asked: &[(FlowId, Asking, Asking)]) -> Problem {
    match asked {
        [] => {
            let detail = "no flow that could be asked reports to the main service";
            Problem::new(Code::NodeUnreachable, detail).retry_after(5)
        }
        [(flow, why, _), ..] => {
            let failed = why.as_ref().err().copied().unwrap_or(Failed::Unreachable);
            failed.problem(&flow.node)
        }
    }
}
