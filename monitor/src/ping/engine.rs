//! The engine: inputs, what is due, and what it asks of the caller.

use std::collections::BTreeMap;
use std::time::Duration;

use blaze_domain::{FlowId, LayerName, TopicName};
use bytes::Bytes;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

use super::answers::{Answers, Waiting};
use super::estimate::{Now, Offset, OwnClock, RoundTrip, Sample};
use super::ignored::{Counts, Ignored};
use super::limits::{BUCKETS, MESSAGE_BYTES};
use super::nodes::{Course, Nodes};
use super::open::{OpenPing, OpenPings, Purpose};
use super::order::{Order, OrderError, OrderId, PingSample};
use super::other::{LinkOffset, Other};
use super::rounds::Rounds;
use super::topics::{TopicChanges, Topics};
use super::wire::{Answer, Name, Ping, Pong, split, written};
use crate::metric::Histogram;

/// Settings of pings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Settings {
    /// Mean time between two pings of a node, at least; zero: this node asks nobody and answers
    /// only.
    pub period: Duration,
}

/// A message to publish at once: its times are those of the call.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Output {
    topic: TopicName,
    payload: Bytes,
}

impl Output {
    /// `blaze/ping/<layer>` or `blaze/pong/<layer>/<node>`.
    #[must_use]
    pub fn topic(&self) -> TopicName {
        self.topic.clone()
    }

    /// JSON of at most 1,200 bytes.
    #[must_use]
    pub fn payload(&self) -> Bytes {
        self.payload.clone()
    }
}

/// Pings of one monitor. It does no I/O and reads no clock.
#[derive(Debug)]
pub struct Engine {
    own: FlowId,
    rng: StdRng,
    clock: OwnClock,
    pub(super) nodes: Nodes,
    rounds: Rounds,
    open: OpenPings,
    answers: Answers,
    order: Option<Order>,
    orders: u64,
    topics: Topics,
    other: Other,
    pub(super) ignored: Counts,
    /// Latencies of all nodes of a layer.
    pub(super) layers: BTreeMap<LayerName, Histogram>,
}

impl Engine {
    /// The engine of a node. The seed decides all that is random; each start takes another one.
    #[must_use]
    pub fn new(own: FlowId, settings: Settings, seed: u64, start: Now) -> Self {
        let mut rng = StdRng::seed_from_u64(seed);
        Self {
            clock: OwnClock::new(start, rng.random()),
            nodes: Nodes::new(own.clone(), settings.period),
            rounds: Rounds::default(),
            open: OpenPings::new(rng.random()),
            answers: Answers::default(),
            order: None,
            orders: 0,
            topics: Topics::default(),
            other: Other::default(),
            ignored: Counts::default(),
            layers: BTreeMap::new(),
            own,
            rng,
        }
    }

    /// Takes a message of `blaze/ping/<own layer>` that `origin` published.
    pub fn ping_received(&mut self, now: Now, origin: &FlowId, payload: &[u8]) {
        self.observe(now);
        if let Err(reason) = self.take_ping(now, origin, payload) {
            self.ignored.add(reason, 1);
        }
    }

    /// Takes a message of `blaze/pong/<layer>/<node>` that `origin` published.
    pub fn pong_received(&mut self, now: Now, origin: &FlowId, payload: &[u8]) {
        self.observe(now);
        if let Err(reason) = self.take_pong(now, origin, payload) {
            self.ignored.add(reason, 1);
        }
    }

    /// Replaces the nodes that request topics below `blaze/ping/`.
    pub fn set_requesters(&mut self, now: Now, nodes: impl IntoIterator<Item = FlowId>) {
        self.observe(now);
        let too_many = self.nodes.set_requesters(nodes);
        self.ignored.add(Ignored::TooMany, too_many);
    }

    /// Replaces the nodes whose topics are measured: they are always asked.
    pub fn set_measured(&mut self, now: Now, nodes: impl IntoIterator<Item = FlowId>) {
        self.observe(now);
        let too_many = self.nodes.set_measured(nodes);
        self.ignored.add(Ignored::TooMany, too_many);
    }

    /// Changes the period; zero: this node asks nobody and answers only.
    pub fn set_period(&mut self, now: Now, period: Duration) {
        self.observe(now);
        self.nodes.set_period(period);
        self.rounds.clear();
    }

    /// Replaces the offsets that the flow of this node knows from its links.
    pub fn set_links(&mut self, now: Now, links: impl IntoIterator<Item = (FlowId, LinkOffset)>) {
        self.observe(now);
        let too_many = self.other.set_links(now, links);
        self.ignored.add(Ignored::TooMany, too_many);
    }

    /// Replaces the offsets that flows of other nodes know from their links.
    pub fn set_relayed<I: IntoIterator<Item = (FlowId, LinkOffset)>>(
        &mut self,
        now: Now,
        relayed: impl IntoIterator<Item = (FlowId, I)>,
    ) {
        self.observe(now);
        let too_many = self.other.set_relayed(now, relayed);
        self.ignored.add(Ignored::TooMany, too_many);
    }

    /// Messages that are due.
    pub fn poll(&mut self, now: Now) -> Vec<Output> {
        self.observe(now);
        self.expire(now.monotonic);
        if self.nodes.update(now.monotonic) {
            self.follow(now.monotonic);
            self.topics.change();
            let nodes = &self.nodes;
            self.layers.retain(|layer, _| nodes.asked().any(|(node, _)| node.layer == *layer));
        }
        let mut outputs = self.ask_layers(now);
        outputs.extend(self.ask_for_order(now));
        outputs.extend(self.answer(now));
        outputs
    }

    /// When `poll` has something to do next, by the monotonic clock; not before now.
    #[must_use]
    pub fn next_deadline(&self, now: Now) -> Duration {
        let order = self.order.as_ref().and_then(Order::deadline);
        let others = [self.rounds.deadline(), self.open.deadline(), order, self.answers.due()];
        let first = others.into_iter().flatten().fold(self.nodes.deadline(), Duration::min);
        first.max(now.monotonic)
    }

    /// What to request and advertise, as changes since the last call. `poll` comes first.
    pub fn take_topics(&mut self) -> TopicChanges {
        let order = self.order.as_ref().map(|order| &order.to);
        let asked = self.nodes.asked().map(|(node, _)| node).chain(order);
        self.topics.take_changes(&self.own, asked)
    }

    /// Offset to a node: the one with the least error of pings, links and two in a row.
    #[must_use]
    pub fn offset(&self, node: &FlowId, now: Now) -> Option<Offset> {
        self.other.best(node, now, |node| self.nodes.series(node)?.clock.offset(now))
    }

    /// Drops the offset to a node, which cannot be right, and measures it anew.
    pub fn drop_offset(&mut self, now: Now, node: &FlowId) {
        self.observe(now);
        self.other.forget(node);
        self.nodes.restart(node);
        self.follow(now.monotonic);
    }

    /// Messages, answers and nodes that were ignored for a reason.
    #[must_use]
    pub fn ignored(&self, reason: Ignored) -> u64 {
        self.ignored.get(reason)
    }

    /// Begins a request for pings of a known node. One at a time is served.
    pub fn order(
        &mut self,
        now: Now,
        to: FlowId,
        count: u32,
        interval: Duration,
    ) -> Result<OrderId, OrderError> {
        self.observe(now);
        if self.order.as_ref().is_some_and(|order| !order.is_done()) {
            return Err(OrderError::Busy);
        }
        if !self.nodes.is_known(&to) {
            return Err(OrderError::Unknown(to));
        }
        let id = OrderId(self.orders);
        let answers = self.nodes.series(&to).is_some_and(|series| series.answered.is_some());
        let mut order = Order::new(now.monotonic, id, to, count, interval)?;
        if !answers {
            order.warm_up(now.monotonic);
        }
        self.orders += 1;
        self.order = Some(order);
        self.topics.change();
        Ok(id)
    }

    /// The results of a request, once all its pings are answered or lost.
    pub fn take_samples(&mut self, id: OrderId) -> Option<Vec<PingSample>> {
        let order = self.order.take_if(|order| order.id == id && order.is_done())?;
        self.topics.change();
        Some(order.samples())
    }

    /// Ends a request without results.
    pub fn cancel_order(&mut self, id: OrderId) {
        if self.order.take_if(|order| order.id == id).is_some() {
            self.topics.change();
        }
    }

    /// Number of the present course of the clock here, as in its messages.
    #[cfg(test)]
    pub(super) fn clock_number(&self) -> i64 {
        self.clock.number
    }

    /// Watches the clock here. After a step all samples count as wrong.
    fn observe(&mut self, now: Now) {
        if self.clock.steps(now) {
            self.other.clear();
            self.nodes.restart_all();
            self.follow(now.monotonic);
        }
    }

    fn follow(&mut self, now: Duration) {
        self.rounds.follow(now, &self.nodes, &mut self.rng);
    }

    fn take_ping(&mut self, now: Now, origin: &FlowId, payload: &[u8]) -> Result<(), Ignored> {
        self.check(origin, payload)?;
        let ping: Ping<'_> = serde_json::from_slice(payload).map_err(|_| Ignored::Malformed)?;
        self.received(now, origin, &ping.from, ping.clock)?;
        let asked = ping.to.is_none_or(|to| to.iter().any(|name| name.is(&self.own)));
        if !asked {
            return Ok(());
        }
        let waiting = Waiting { to: origin.clone(), id: ping.id, received: now.monotonic };
        self.answers.add(waiting, &mut self.rng)
    }

    fn take_pong(&mut self, now: Now, origin: &FlowId, payload: &[u8]) -> Result<(), Ignored> {
        self.check(origin, payload)?;
        let pong: Pong<'_> = serde_json::from_slice(payload).map_err(|_| Ignored::Malformed)?;
        self.received(now, origin, &pong.from, pong.clock)?;
        for answer in &pong.answers {
            if !answer.to.is(&self.own) {
                continue;
            }
            if let Err(reason) = self.take_answer(now, origin, answer) {
                self.ignored.add(reason, 1);
            }
        }
        Ok(())
    }

    fn check(&self, origin: &FlowId, payload: &[u8]) -> Result<(), Ignored> {
        if *origin == self.own {
            return Err(Ignored::Own);
        }
        if payload.len() > MESSAGE_BYTES { Err(Ignored::TooLarge) } else { Ok(()) }
    }

    fn received(
        &mut self,
        now: Now,
        origin: &FlowId,
        from: &Name<'_>,
        clock: Option<i64>,
    ) -> Result<(), Ignored> {
        if !from.is(origin) {
            return Err(Ignored::ForeignName);
        }
        match self.nodes.received(now, origin, clock)? {
            Course::Same => {}
            Course::New => {
                self.other.forget(origin);
                self.nodes.restart(origin);
                self.follow(now.monotonic);
            }
            Course::Overtaken => return Err(Ignored::Overtaken),
        }
        Ok(())
    }

    fn take_answer(&mut self, now: Now, from: &FlowId, answer: &Answer<'_>) -> Result<(), Ignored> {
        let (sent, purpose) = self.open.answered(now.monotonic, answer.id, from)?;
        let sample = Sample::new(RoundTrip {
            sent,
            received: now.monotonic,
            t2: answer.t2,
            t3: answer.t3,
            hold_ns: answer.hold_ns,
            synchronized: answer.sync && now.synchronized,
        });
        let Some(sample) = sample else {
            self.lost(now.monotonic, from, purpose);
            return Err(Ignored::Negative);
        };
        if let Some(series) = self.nodes.series_mut(from) {
            series.add(sample, now);
            let layer = self.layers.entry(from.layer.clone());
            let layer = layer.or_insert_with(|| Histogram::new(&BUCKETS));
            layer.observe(sample.latency_s());
        }
        if let Some(order) = &mut self.order {
            order.result(now.monotonic, purpose, PingSample::answered(&sample, now));
        }
        Ok(())
    }

    fn expire(&mut self, now: Duration) {
        while let Some(ping) = self.open.take_lost(now) {
            for node in &ping.waiting {
                self.lost(now, node, ping.purpose);
            }
        }
    }

    fn lost(&mut self, now: Duration, node: &FlowId, purpose: Purpose) {
        if let Some(series) = self.nodes.series_mut(node).filter(|_| purpose.counts()) {
            series.lost += 1;
        }
        if let Some(order) = &mut self.order {
            order.result(now, purpose, PingSample::LOST);
        }
    }

    fn ask_layers(&mut self, now: Now) -> Vec<Output> {
        let mut outputs = Vec::new();
        for (layer, all) in self.rounds.due(now.monotonic) {
            let of_layer = self.nodes.asked().filter(|(node, _)| node.layer == layer);
            let (ask, skip): (Vec<_>, Vec<_>) =
                of_layer.partition(|(_, series)| all || series.start > 0);
            let everybody = skip.is_empty() && self.nodes.are_few();
            let nodes: Vec<FlowId> = ask.into_iter().map(|(node, _)| node.clone()).collect();
            for node in &nodes {
                if let Some(series) = self.nodes.series_mut(node) {
                    series.start = series.start.saturating_sub(1);
                }
            }
            outputs.extend(self.ask(now, &layer, nodes, everybody, Purpose::Round));
            self.rounds.asked(now.monotonic, &layer, all, &self.nodes, &mut self.rng);
        }
        outputs
    }

    fn ask_for_order(&mut self, now: Now) -> Vec<Output> {
        let Some(order) = &mut self.order else { return Vec::new() };
        let Some(purpose) = order.take_due(now.monotonic) else { return Vec::new() };
        let to = order.to.clone();
        self.ask(now, &to.layer.clone(), vec![to], false, purpose)
    }

    /// Pings to nodes of one layer: one, or as many as their names need.
    fn ask(
        &mut self,
        now: Now,
        layer: &LayerName,
        nodes: Vec<FlowId>,
        everybody: bool,
        purpose: Purpose,
    ) -> Vec<Output> {
        for node in nodes.iter().filter(|_| purpose.counts()) {
            if let Some(series) = self.nodes.series_mut(node) {
                series.sent += 1;
            }
        }
        let (own, clock) = (self.own.clone(), self.clock.number);
        let ping = |id: u64, nodes: &[FlowId]| {
            let to = (!everybody).then(|| nodes.iter().map(Name::of).collect());
            written(&Ping { id, from: Name::of(&own), to, t1: now.wall_ns, clock: Some(clock) })
        };
        // Split with the longest number, because each part has a number of its own.
        let parts = split(nodes, |nodes| ping(u64::MAX, nodes));
        let pings = parts.into_iter().map(|(nodes, _)| {
            let waiting = nodes.iter().cloned().collect();
            let id = self.open.add(OpenPing { sent: now.monotonic, waiting, purpose });
            Output { topic: TopicName::ping(layer), payload: ping(id, &nodes).into() }
        });
        pings.collect()
    }

    fn answer(&mut self, now: Now) -> Vec<Output> {
        let waiting = self.answers.take(now.monotonic);
        let pong = |waiting: &[Waiting]| {
            let answers = waiting.iter().map(|ping| Self::answer_to(now, ping)).collect();
            let clock = Some(self.clock.number);
            written(&Pong { from: Name::of(&self.own), answers, clock })
        };
        let messages = split(waiting, pong).into_iter();
        let topic = TopicName::pong(&self.own);
        messages.map(|(_, payload)| Output { topic: topic.clone(), payload }).collect()
    }

    fn answer_to(now: Now, ping: &Waiting) -> Answer<'static> {
        let hold = now.monotonic.saturating_sub(ping.received);
        let hold_ns = u64::try_from(hold.as_nanos()).unwrap_or(u64::MAX);
        // Counted back from t3, so that both are on one course of a clock that stepped meanwhile.
        let t2 = now.wall_ns.saturating_sub_unsigned(hold_ns);
        let (to, sync) = (Name::of(&ping.to), now.synchronized);
        Answer { to, id: ping.id, t2, t3: now.wall_ns, hold_ns, sync }
    }
}
