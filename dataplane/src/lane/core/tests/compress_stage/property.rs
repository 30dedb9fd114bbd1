//! Whatever comes of it and when: each message is sent, dropped for a reason or waiting, and those
//! of a writer in their order.

use std::collections::HashMap;

use proptest::collection::vec;

use super::*;

#[derive(Debug, Clone)]
enum Step {
    /// Writer, bytes.
    Publish(u8, usize),
    Begin(Urgency),
    /// Which of those that were begun, and how it ends.
    End(usize, u8),
    Pass(u64),
    /// Which lanes there are.
    Plan(usize),
    /// The link takes nothing, or takes again.
    Down(bool),
    /// What the link has got is acknowledged, and questions are answered.
    Acknowledge,
    Stop,
}

fn work() -> impl Strategy<Value = Step> {
    let bytes = prop_oneof![3 => Just(100usize), 3 => Just(SMALL), 2 => Just(66_000usize)];
    prop_oneof![
        6 => (1u8..4, bytes).prop_map(|(writer, bytes)| Step::Publish(writer, bytes)),
        2 => Just(Step::Begin(Urgency::Quick)),
        2 => Just(Step::Begin(Urgency::Long)),
        4 => (0usize..20, 0u8..6).prop_map(|(at, how)| Step::End(at, how)),
        2 => (0u64..40).prop_map(Step::Pass),
    ]
}

fn life() -> impl Strategy<Value = Step> {
    prop_oneof![
        20 => work(),
        3 => (0usize..5).prop_map(Step::Plan),
        1 => any::<bool>().prop_map(Step::Down),
        2 => Just(Step::Acknowledge),
        1 => (0u64..700).prop_map(Step::Pass),
    ]
}

/// One of the plans between which a topic goes to and fro.
fn plan(number: usize) -> Vec<Bridge> {
    let mut thinned = lane("fog/f", false);
    thinned.lane.max_rate_hz = Some(40.0);
    thinned.lane.lifespan_ms = 60;
    let to = |flow: &str| lane(flow, true);
    match number {
        0 => vec![to("cloud/a")],
        1 => vec![to("cloud/b")],
        2 => vec![to("cloud/a"), thinned],
        3 => vec![to("cloud/b"), thinned],
        _ => Vec::new(),
    }
}

/// What was published, and what the counters said last.
#[derive(Default)]
struct Seen {
    published: HashMap<u8, u64>,
    taken: Vec<u64>,
}

impl Hands {
    fn step(&mut self, step: &Step, seen: &mut Seen) {
        match *step {
            Step::Publish(writer, bytes) => {
                let sequence = seen.published.entry(writer).or_insert(0);
                *sequence += 1;
                self.publish(writer, *sequence, bytes);
            }
            Step::Begin(Urgency::Quick) if self.quick == 0 => {}
            Step::Begin(Urgency::Long) if self.long == 0 => {}
            Step::Begin(urgency) => {
                self.begin(urgency);
            }
            Step::End(..) if self.jobs.is_empty() => {}
            Step::End(at, how) => {
                let at = at % self.jobs.len();
                match how {
                    0 => self.end_with(at, Done::Failed),
                    1 => self.end_as(at, None, 1),
                    _ => self.end(at),
                }
            }
            Step::Pass(milliseconds) => self.pass(Duration::from_millis(milliseconds)),
            Step::Plan(number) => self.plan(plan(number)),
            Step::Down(down) => self.bench.link.refuse = down,
            Step::Acknowledge => self.acknowledge(),
            Step::Stop => {
                let Bench { core, link, now, .. } = &mut self.bench;
                core.stop_compression(*now, link);
            }
        }
        self.check();
        let taken: Vec<u64> =
            self.path().bridges.iter().map(|bridge| bridge.stats.taken.messages).collect();
        assert!(
            seen.taken.iter().zip(&taken).all(|(before, now)| before <= now),
            "a counter goes back"
        );
        seen.taken = taken;
    }

    fn acknowledge(&mut self) {
        for (lane, messages) in std::mem::take(&mut self.bench.link.waiting) {
            self.bench.core.lane_out(lane, messages, 0);
        }
        self.bench.drain();
        for (from, body) in std::mem::take(&mut self.bench.link.told) {
            if let Body::WrittenRequest(request) = body {
                self.bench.core.written(&from, request.token);
            }
        }
        self.bench.drain();
    }

    /// All that was asked for is done, and time passes until nothing is left to be done.
    fn come_to_rest(&mut self) {
        self.bench.link.refuse = false;
        for _ in 0..5 {
            self.run();
            self.acknowledge();
            self.pass(Duration::from_secs(3));
        }
        let counters = self.bench.core.compress_counters();
        assert_eq!((counters.waiting, counters.waiting_bytes), (0, 0));
        let waiting: Vec<u64> = self.path().bridges.iter().map(|bridge| bridge.in_codec).collect();
        assert!(waiting.iter().all(|messages| *messages == 0), "{waiting:?}");
        self.check();
    }

    /// The sequences that each layer got of each writer, in the order in which they were sent:
    /// receivers of one layer write to one broker.
    fn by_layer(&mut self) -> HashMap<(String, u8), Vec<u64>> {
        let mut found: HashMap<(String, u8), Vec<u64>> = HashMap::new();
        for (lane, writer, sequence) in self.sent() {
            let mut bridges = self.path().bridges.iter();
            let bridge = bridges.find(|bridge| bridge.lane_id() == Some(LaneId(lane))).unwrap();
            let (layer, _) = bridge.receiver().unwrap();
            found.entry((layer.to_string(), writer)).or_default().push(sequence);
        }
        for (of, sequences) in &found {
            let ascend = sequences.windows(2).all(|pair| pair[0] < pair[1]);
            assert!(ascend, "layer and writer {of:?}: {sequences:?}");
        }
        found
    }
}

proptest! {
    #[test]
    fn lanes_that_stay_get_everything_in_order_or_it_is_counted(steps in vec(work(), 1..120),
        reliable: bool) {
        let mut thinned = lane("fog/f", false);
        thinned.lane.max_rate_hz = Some(100.0);
        thinned.lane.lifespan_ms = 50;
        let mut hands = Hands::new(vec![lane("cloud/c", reliable), thinned, lane("hub/h", false)]);
        hands.bench.link.old = vec!["hub/h".parse().unwrap()];
        let mut seen = Seen::default();
        for step in &steps {
            hands.step(step, &mut seen);
        }
        hands.run();
        hands.come_to_rest();
        let published: u64 = seen.published.values().sum();
        let taken: Vec<u64> =
            hands.path().bridges.iter().map(|bridge| bridge.stats.taken.messages).collect();
        prop_assert_eq!(taken, [published; 3]);
        let sent = hands.by_layer();
        if reliable {
            // What is to be compressed does not exceed what may wait.
            for (writer, last) in &seen.published {
                let of_writer = sent.get(&("cloud".to_owned(), *writer)).cloned().unwrap_or_default();
                prop_assert_eq!(of_writer, (1..=*last).collect::<Vec<u64>>());
            }
            prop_assert!(hands.dropped(0).is_empty() && hands.dropped(2).is_empty());
        }
        let reasons = [DropReason::QueueFull, DropReason::MaxRate, DropReason::Lifespan];
        prop_assert!(hands.dropped(1).iter().all(|(reason, _)| reasons.contains(reason)));
    }

    #[test]
    fn plans_peers_and_the_pool_may_come_and_go(steps in vec(life(), 1..120),
        stops in 0usize..200) {
        let mut hands = Hands::new(plan(2));
        let mut seen = Seen::default();
        for (at, step) in steps.iter().enumerate() {
            if at == stops {
                hands.step(&Step::Stop, &mut seen);
            }
            hands.step(step, &mut seen);
        }
        hands.step(&Step::Plan(2), &mut seen);
        hands.come_to_rest();
        hands.by_layer();
    }
}
