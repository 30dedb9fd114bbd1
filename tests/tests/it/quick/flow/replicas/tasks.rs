//! What the tasks of one flow do in production: read, decide, carry out, send, and leave.

use std::sync::Arc;
use std::time::Duration;

use blaze_brokers::{Begin, ConsumerOffset, Content, PublisherOptions, Received};
use blaze_domain::{Scope, TopicName};
use blaze_flow::control::{Duty, Output, read_replica_message};
use blaze_flow::lane::path::TopicInfo;
use blaze_flow::lane::writer::NewWriter;
use blaze_flow::plan::{Bridge, Target, TopicPlan};
use rand::RngExt;

use super::parts::{Life, Packet, Record, channel};
use super::world::World;

/// How often it is measured what a flow carries.
const MEASURE: Duration = Duration::from_secs(1);

impl World {
    /// What the source tasks and the task of the channel of flows do.
    pub(crate) fn read(&mut self, index: usize) {
        let (now, wall) = (self.now, self.wall());
        let topics: Vec<(TopicName, Scope)> = self.flows[index].reads.keys().cloned().collect();
        let deaf = self.flows[index].deaf;
        for (topic, scope) in topics {
            if deaf && scope == Scope::Layer {
                continue;
            }
            let server = if scope == Scope::Layer { &self.kafka } else { &self.redis };
            let visible = server.readable(now) - self.kafka_delay;
            let log = Arc::clone(&server.log);
            let flow = &mut self.flows[index];
            let (Some(next), Some(id)) =
                (flow.reads.get_mut(&(topic.clone(), scope)), flow.plane.core.find(topic.as_str()))
            else {
                continue;
            };
            let log = log.lock();
            let records = log.get(&channel(index, scope, topic.as_str()));
            let records = records.map_or(&[][..], Vec::as_slice);
            let mut batch = Vec::new();
            while let Some(record) = records.get(*next).filter(|record| record.at <= visible) {
                batch.push(Received {
                    content: record.content.clone(),
                    at: now,
                    broker_age_us: 0,
                    kept: false,
                    place: (scope == Scope::Layer).then_some(ConsumerOffset {
                        partition: 0,
                        offset: *next as i64,
                        appended_ms: None,
                    }),
                });
                *next += 1;
            }
            drop(log);
            flow.plane.ingest(now, wall, id, scope, &mut batch);
        }
        if index == 0 || deaf {
            return;
        }
        let visible = self.kafka.readable(now) - self.kafka_delay;
        let said: Vec<Record> = {
            let log = self.kafka.log.lock();
            let all = log.get("peers").map_or(&[][..], Vec::as_slice);
            let new = all.iter().skip(self.flows[index].peers);
            new.take_while(|record| record.at <= visible).cloned().collect()
        };
        let start = self.start;
        let flow = &mut self.flows[index];
        flow.peers += said.len();
        for record in said {
            if let Content::Bare { payload, .. } = &record.content
                && (!self.split || record.by == index)
            {
                let appended_ms = (record.at - start).as_millis() as i64;
                let message = read_replica_message(payload);
                flow.control.replica_message(now, message, Some(appended_ms));
            }
        }
    }

    pub(crate) fn run_control(&mut self, index: usize) {
        let (now, wall_ms) = (self.now, self.wall() / 1_000_000);
        let flow = &mut self.flows[index];
        flow.plane.run_timers(now);
        let mut news = Vec::new();
        flow.plane.pump(now, |event| news.push(event));
        for event in news {
            flow.control.link_event(now, event);
        }
        if now >= flow.measured + MEASURE {
            flow.measured = now;
            let loads = flow.plane.measure(now);
            flow.control.set_loads(now, &loads, 0);
        }
        flow.control.tick(now, wall_ms);
        self.carry_out_all(index);
        let flow = &mut self.flows[index];
        for topic in flow.control.emptying() {
            flow.plane.run_timers(now);
            if flow.plane.core.has_emptied(&topic) {
                flow.control.emptied(now, wall_ms, &topic);
            }
        }
        self.carry_out_all(index);
    }

    fn carry_out_all(&mut self, index: usize) {
        while let Some(output) = self.flows[index].control.poll() {
            self.carry_out(index, output);
        }
    }

    fn carry_out(&mut self, index: usize, output: Output) {
        let (now, wall_ms) = (self.now, self.wall() / 1_000_000);
        if let Output::Plan { topic, plan, info, duty } = output {
            let places = self.apply(index, &topic, &plan, *info, &duty);
            if duty == Duty::GivesUp {
                self.flows[index].control.given_up(now, wall_ms, &topic, places);
            }
            return;
        }
        if let Output::Replicas { body, .. } = output {
            if self.flows[index].mute {
                return;
            }
            let content = Content::Bare { payload: body, identity: None };
            let record = Record { content, at: now, by: index };
            return self.kafka.log.lock().entry("peers".to_owned()).or_default().push(record);
        }
        let flow = &mut self.flows[index];
        let Some(engine) = &mut flow.plane.engine else {
            return;
        };
        match output {
            Output::Inter { join: true } => {
                if flow.was_inside {
                    // As in production: whoever comes back has a new life there.
                    flow.epoch += 1;
                    engine.restart(now, flow.epoch);
                    flow.control.set_epoch(flow.epoch);
                }
                (flow.inside, flow.was_inside) = (true, true);
                flow.control.joined(now);
            }
            Output::Inter { join: false } => {
                engine.goodbye();
                flow.leaves = Some(now);
            }
            Output::Link { to, body } => drop(engine.send_control(&to, *body)),
            Output::Announce { version, digest } => engine.set_registry(version, digest),
            Output::State(state) => engine.set_state(now, state.into()),
            _ => {}
        }
    }

    /// What the executor does: bridges, and where they are read from.
    fn apply(
        &mut self,
        index: usize,
        topic: &TopicName,
        plan: &TopicPlan,
        info: TopicInfo,
        duty: &Duty,
    ) -> Option<Vec<i64>> {
        let (now, kafka, redis, clock) = (self.now, &self.kafka, &self.redis, &self.clock);
        let flow = &mut self.flows[index];
        let id = flow.plane.core.intern(topic, now)?;
        let core = &flow.plane.core;
        let writer_of = |bridge: &Bridge| core.writer_of(topic, bridge.from, &bridge.to).cloned();
        let mut before: Vec<Option<NewWriter>> = plan.bridges.iter().map(writer_of).collect();
        flow.plane.core.apply(now, id, info, plan, |bridge| {
            let at = plan.bridges.iter().position(|planned| planned == bridge);
            if let Some(made) = at.and_then(|at| before[at].take()) {
                return Ok(made);
            }
            let (server, scope) = match bridge.to {
                Target::Layer { json: false } => (kafka, Scope::Layer),
                _ => (redis, Scope::Node),
            };
            let writer = server.writer(index, channel(index, scope, topic.as_str()), clock);
            Ok(NewWriter { publisher: Arc::new(writer), options: PublisherOptions::default() })
        });
        if let Duty::Takes(begin) = duty {
            flow.plane.core.takes_over(id, begin);
        }
        flow.plane.deliver_waiting(now, id);
        let stopped_at = flow.plane.core.stopped_at(id);
        for scope in [Scope::Node, Scope::Layer] {
            let key = (topic.clone(), scope);
            if !flow.plane.core.path(id).reads(scope) {
                if flow.reads.remove(&key).is_some() {
                    flow.plane.core.reads_no_more(id, scope);
                }
                continue;
            }
            let log = if scope == Scope::Layer { kafka } else { redis }.log.lock();
            let records = log.get(&channel(index, scope, topic.as_str()));
            let records = records.map_or(&[][..], Vec::as_slice);
            let anew =
                matches!(duty, Duty::Takes(begin) if scope == Scope::Layer && *begin != Begin::Now);
            let again = flow.reads.contains_key(&key);
            if again && !anew {
                continue;
            }
            let begin = match scope {
                Scope::Layer => flow.plane.core.begin_reading(id, again),
                _ => Begin::Now,
            };
            let start = match begin {
                Begin::Now => records.len(),
                Begin::At(offsets) => offsets[0] as usize,
                Begin::Since { appended_ms, latest } => {
                    let at = self.start + Duration::from_millis(appended_ms.max(0) as u64);
                    let first =
                        records.iter().position(|record| record.at >= at).unwrap_or(records.len());
                    latest.first().map_or(first, |latest| first.min(*latest as usize))
                }
            };
            if scope == Scope::Layer {
                flow.plane.core.reads_from(id, &[start as i64]);
            }
            flow.reads.insert(key, start);
        }
        (*duty == Duty::GivesUp && !stopped_at.is_empty()).then_some(stopped_at)
    }

    /// What a flow does that is stopped.
    pub(crate) fn leave(&mut self, index: usize) {
        let now = self.now;
        let flow = &mut self.flows[index];
        if flow.leaves.is_some_and(|since| now - since >= Duration::from_millis(100))
            && let Some(engine) = &mut flow.plane.engine
        {
            (flow.inside, flow.leaves) = (false, None);
            engine.leave(now);
            flow.plane.pump(now, |_| {});
            flow.control.left(now);
        }
        match flow.life {
            Life::Draining(since) => {
                let over = now - since >= Duration::from_millis(600);
                let written =
                    now - since >= Duration::from_millis(2_100) || !flow.plane.core.has_unwritten();
                if written
                    && (over || (flow.control.has_handed_over() && !flow.plane.core.is_draining()))
                {
                    flow.control.say_goodbye();
                    if let Some(engine) = &mut flow.plane.engine {
                        engine.goodbye();
                    }
                    flow.life = Life::Gone(now);
                }
            }
            Life::Gone(since) if now - since >= Duration::from_millis(100) => {
                self.handed_over += flow.control.handovers().0;
                flow.life = Life::Dead;
            }
            _ => {}
        }
    }

    pub(crate) fn transmit(&mut self, index: usize) {
        let now = self.now;
        while let Some(transmit) =
            self.flows[index].plane.engine.as_mut().and_then(|engine| engine.poll_transmit(now))
        {
            let between = index > 0 && transmit.to.flow.layer.as_str() == "cloud";
            if self.split && between {
                continue;
            }
            let jitter = Duration::from_micros(self.random.random_range(0..2_000));
            let packet =
                Packet { to: transmit.to, class: transmit.class, datagram: transmit.datagram };
            self.network.send(now + self.one_way + jitter, packet);
        }
        let flow = &mut self.flows[index];
        let mut news = Vec::new();
        flow.plane.pump(now, |event| news.push(event));
        for event in news {
            flow.control.link_event(now, event);
        }
    }
}
