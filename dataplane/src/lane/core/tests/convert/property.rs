//! Whatever comes and whenever the pool gets to it: each message is written, dropped for a reason
//! or waiting, and those of a writer in their order.

use std::collections::HashMap;

use proptest::collection::vec;

use super::*;

#[derive(Debug, Clone)]
enum Step {
    /// Writer, and kind of message.
    Publish(u8, u8),
    Begin,
    /// Which of those that were begun, and whether it fails.
    End(usize, bool),
    Pass(u64),
    /// Whether there is the copy for the node, and the one for the layer.
    Plan(bool, bool),
    Stop,
}

fn steps() -> impl Strategy<Value = Step> {
    prop_oneof![
        8 => (1u8..4, 0u8..6).prop_map(|(writer, kind)| Step::Publish(writer, kind)),
        3 => Just(Step::Begin),
        4 => (0usize..20, prop::bool::weighted(0.1)).prop_map(|(at, fails)| Step::End(at, fails)),
        2 => (0u64..40).prop_map(Step::Pass),
        1 => (any::<bool>(), any::<bool>()).prop_map(|(node, layer)| Step::Plan(node, layer)),
    ]
}

fn plan(node: bool, layer: bool) -> Vec<Bridge> {
    let mut aged = bridge(Scope::Node, Target::Layer { json: true });
    aged.lane.lifespan_ms = 50;
    let copies = [(node, copy(Scope::Node)), (layer, aged)];
    copies.into_iter().filter(|(there, _)| *there).map(|(_, bridge)| bridge).collect()
}

/// A text with writer and number, so that it is known again as JSON.
fn message(writer: u8, sequence: u64, kind: u8) -> Frame {
    let name = format!("{writer} {sequence} ");
    let ros =
        |text: &str| of(&format!("application/cdr; type={STRING}"), writer, sequence, string(text));
    match kind {
        0 | 1 => ros(&name),
        2 => ros(&format!("{name}{}", "x".repeat(LARGE))),
        3 => of("application/json", writer, sequence, format!(r#"{{"data":"{name}"}}"#)),
        4 => of("application/cdr; type=no/msg/Such", writer, sequence, string(&name)),
        _ => of(&format!("application/cdr; type={STRING}"), writer, sequence, "no CDR"),
    }
}

impl Hands {
    /// Each copy has a collector of its own.
    fn plan(&mut self, node: bool, layer: bool) {
        let (mine, other) = (Arc::clone(&self.bench.out), Arc::clone(&self.of_layer));
        let Bench { core, now, topic, .. } = &mut self.bench;
        let plan = planned(plan(node, layer));
        core.apply(*now, *topic, TopicInfo::default(), &plan, |bridge| {
            writes_to(if bridge.to.scope() == Scope::Node { &mine } else { &other })
        });
    }

    fn step(&mut self, step: &Step, published: &mut HashMap<u8, u64>) {
        match *step {
            Step::Publish(writer, kind) => {
                let sequence = published.entry(writer).or_insert(0);
                *sequence += 1;
                self.publish(message(writer, *sequence, kind));
            }
            Step::Begin => self.begin(),
            Step::End(..) if self.jobs.is_empty() => {}
            Step::End(at, fails) => {
                let at = at % self.jobs.len();
                if fails {
                    let job = self.jobs.remove(at);
                    self.end_with(&job, Done::Failed);
                } else {
                    self.end(at);
                }
            }
            Step::Pass(milliseconds) => {
                self.bench.now += Duration::from_millis(milliseconds);
                self.bench.drain();
            }
            Step::Plan(node, layer) => self.plan(node, layer),
            Step::Stop => {
                let Bench { core, link, now, .. } = &mut self.bench;
                core.stop_compression(*now, link);
            }
        }
        self.check();
    }

    /// The accounts are right.
    fn check(&mut self) {
        let path = self.bench.core.path_mut(self.bench.topic);
        for bridge in &mut path.bridges {
            bridge.settle();
            let stats = &bridge.stats;
            let done = stats.out.messages + stats.dropped.total();
            assert_eq!(stats.taken.messages, done + bridge.in_codec, "{:?}", bridge.target);
        }
    }
}

proptest! {
    #[test]
    fn each_message_is_written_in_order_or_counted(
        steps in vec(steps(), 1..120), stops in 0usize..200,
    ) {
        let mut hands = Hands::with_pool(Vec::new(), TopicInfo::default());
        hands.plan(true, true);
        let mut published = HashMap::new();
        for (at, step) in steps.iter().enumerate() {
            if at == stops {
                hands.step(&Step::Stop, &mut published);
            }
            hands.step(step, &mut published);
        }
        hands.run();
        hands.check();
        let counters = hands.bench.core.compress_counters();
        prop_assert_eq!((counters.waiting, counters.waiting_bytes), (0, 0));
        let written = hands.texts();
        let mut last: HashMap<(usize, u8), u64> = HashMap::new();
        let outs = [&hands.bench.out, &hands.of_layer];
        for (at, out) in outs.into_iter().enumerate() {
            for text in out.bare.lock().iter() {
                let text = std::str::from_utf8(text).unwrap();
                let mut words = text.strip_prefix(r#"{"data":""#).unwrap().split(' ');
                let mut number = || words.next().unwrap().parse::<u64>().unwrap();
                let (writer, sequence) = (number() as u8, number());
                let before = last.insert((at, writer), sequence).unwrap_or(0);
                prop_assert!(before < sequence, "{written:?}");
            }
        }
    }
}
