//! What a scenario measured.

use std::collections::BTreeMap;

use super::Expect;
use crate::process::Usage;

/// One topic at one consumer.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Route {
    /// Consumer.
    pub consumer: String,
    /// Topic.
    pub topic: String,
    /// Messages published, from the first on; those before the route was up are no loss.
    pub sent: u64,
    /// Messages received.
    pub received: u64,
    /// Seconds in which the latencies were measured.
    pub seconds: usize,
    /// Number of the last message received.
    pub last: u64,
    /// Missing between the first received and the last published.
    pub lost: u64,
    /// Repeats.
    pub duplicated: u64,
    /// Came after a later one.
    pub reordered: u64,
    /// From publishing to the consumer's callback, ms, sorted; of the time in which faults are
    /// played.
    pub latencies_ms: Vec<f64>,
}

impl Route {
    /// Missing between the first received and the last received: while publishers go on, what came
    /// after that may be on its way.
    #[must_use]
    pub fn gaps(&self) -> u64 {
        self.lost.saturating_sub(self.sent.saturating_sub(self.last))
    }

    /// The latency in ms that a share (0 to 1) of the messages does not exceed; `None` without any.
    #[must_use]
    pub fn latency_ms(&self, share: f64) -> Option<f64> {
        let rank = ((share * self.latencies_ms.len() as f64).ceil() as usize).max(1);
        self.latencies_ms.get(rank - 1).copied()
    }

    /// Messages per second while latencies were measured.
    #[must_use]
    pub fn rate_hz(&self) -> f64 {
        self.latencies_ms.len() as f64 / self.seconds.max(1) as f64
    }

    fn faults(&self, expect: &Expect) -> Option<String> {
        let once_in_order = self.duplicated == 0 && self.reordered == 0;
        let holds = match expect {
            Expect::Whole(..) => self.received > 0 && self.lost == 0 && once_in_order,
            Expect::LostAtMost(_, _, share) => {
                let all = self.lost + self.received;
                self.received > 0 && self.lost as f64 <= share * all as f64 && once_in_order
            }
            Expect::Received(_, _, least) => self.received >= *least,
            Expect::Alive(..) => self.sent > 0 && self.last == self.sent,
            // Of flows, not of routes.
            Expect::Balanced | Expect::Growth(_) => true,
        };
        (!holds).then(|| format!("{expect:?} does not hold: {self}"))
    }
}

impl std::fmt::Display for Route {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let latency = |share| {
            self.latency_ms(share)
                .map_or("–".to_owned(), |milliseconds| format!("{milliseconds:.2}"))
        };
        write!(
            f,
            "{:<16} {:<20} {:>9} {:>9} {:>6} {:>6} {:>9} {:>8} {:>8} {:>8}",
            self.consumer,
            self.topic,
            self.sent,
            self.received,
            self.lost,
            self.duplicated,
            self.reordered,
            latency(0.5),
            latency(0.99),
            latency(1.0)
        )
    }
}

/// One flow.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FlowReport {
    /// Its node.
    pub node: String,
    /// What it held once it was warm.
    pub warm: Usage,
    /// What it holds in the end.
    pub last: Usage,
    /// Bridges that do not say where every message went.
    pub unbalanced: Vec<String>,
    /// What its bridges dropped, by reason, since its last start.
    pub dropped: BTreeMap<String, u64>,
}

impl FlowReport {
    fn faults(&self, expect: &Expect) -> Option<String> {
        match expect {
            Expect::Balanced if !self.unbalanced.is_empty() => {
                Some(format!("{}: {}", self.node, self.unbalanced.join("; ")))
            }
            Expect::Growth(most) => {
                let held = self.last.exceeds_by_at_most(&self.warm, most);
                (!held).then(|| format!("{} grew from {} to {}", self.node, self.warm, self.last))
            }
            _ => None,
        }
    }
}

impl std::fmt::Display for FlowReport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{:<16} {}, before {}; dropped {:?}",
            self.node, self.last, self.warm, self.dropped
        )
    }
}

/// All topics at all consumers.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Report {
    /// Of the scenario.
    pub name: String,
    /// In the order of the scenario.
    pub routes: Vec<Route>,
    /// By node.
    pub flows: Vec<FlowReport>,
    /// The last words of all processes, for whoever asks why something does not hold.
    pub tails: String,
}

impl Report {
    /// A topic at a consumer.
    #[must_use]
    pub fn route(&self, consumer: &str, topic: &str) -> Option<&Route> {
        let mut routes = self.routes.iter();
        routes.find(|route| route.consumer == consumer && route.topic == topic)
    }

    /// Whether all that was expected holds.
    ///
    /// # Errors
    /// Names all that does not, with the table.
    pub fn check(&self, expect: &[Expect]) -> anyhow::Result<()> {
        let faults = expect.iter().filter_map(|expect| match expect {
            Expect::Whole(consumer, topic)
            | Expect::LostAtMost(consumer, topic, _)
            | Expect::Received(consumer, topic, _)
            | Expect::Alive(consumer, topic) => match self.route(consumer, topic) {
                Some(route) => route.faults(expect),
                None => Some(format!("there is no {topic} at {consumer}")),
            },
            Expect::Balanced | Expect::Growth(_) => {
                let faults: Vec<String> =
                    self.flows.iter().filter_map(|flow| flow.faults(expect)).collect();
                (!faults.is_empty()).then(|| faults.join("\n"))
            }
        });
        let faults: Vec<String> = faults.collect();
        anyhow::ensure!(faults.is_empty(), "{}\n{self}", faults.join("\n"));
        Ok(())
    }
}

impl std::fmt::Display for Report {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(
            f,
            "{}\n{:<16} {:<20} {:>9} {:>9} {:>6} {:>6} {:>9} {:>8} {:>8} {:>8}",
            self.name,
            "CONSUMER",
            "TOPIC",
            "SENT",
            "RECEIVED",
            "LOST",
            "TWICE",
            "REORDERED",
            "p50/ms",
            "p99/ms",
            "MAX/ms"
        )?;
        self.routes.iter().try_for_each(|route| writeln!(f, "{route}"))?;
        self.flows.iter().try_for_each(|flow| writeln!(f, "{flow}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report() -> Report {
        let route = Route {
            consumer: "recorder".to_owned(),
            topic: "imu".to_owned(),
            sent: 1_000,
            received: 990,
            last: 1_000,
            lost: 10,
            latencies_ms: (1..=100).map(f64::from).collect(),
            ..Route::default()
        };
        Report {
            name: "a scenario".to_owned(),
            routes: vec![route],
            flows: Vec::new(),
            tails: String::new(),
        }
    }

    #[test]
    fn what_is_expected_is_checked() {
        let report = report();
        let route = &report.routes[0];
        assert_eq!((route.latency_ms(0.5), route.latency_ms(0.99)), (Some(50.0), Some(99.0)));
        report
            .check(&[
                Expect::LostAtMost("recorder", "imu", 0.01),
                Expect::Received("recorder", "imu", 990),
                Expect::Alive("recorder", "imu"),
            ])
            .unwrap();
        for wrong in [
            Expect::Whole("recorder", "imu"),
            Expect::LostAtMost("recorder", "imu", 0.009),
            Expect::Received("recorder", "imu", 991),
            Expect::Received("recorder", "odom", 1),
            Expect::Received("player", "imu", 1),
        ] {
            assert!(report.check(std::slice::from_ref(&wrong)).is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn flows_that_grow_or_lose_count_are_found() {
        let usage =
            |resident_kib, threads, descriptors| Usage { resident_kib, threads, descriptors };
        let mut report = report();
        report.flows.push(FlowReport {
            node: "cloud-1".to_owned(),
            warm: usage(1_000, 10, 20),
            last: usage(1_100, 11, 20),
            ..FlowReport::default()
        });
        report.check(&[Expect::Balanced, Expect::Growth(usage(100, 1, 0))]).unwrap();
        for most in [usage(99, 1, 0), usage(100, 0, 0)] {
            assert!(report.check(&[Expect::Growth(most)]).is_err(), "{most}");
        }
        report.flows[0].unbalanced.push("imu: in 3, out 2".to_owned());
        let error = report.check(&[Expect::Balanced]).unwrap_err();
        assert!(error.to_string().contains("cloud-1: imu: in 3, out 2"), "{error}");
    }

    #[test]
    fn a_route_that_has_ended_is_found() {
        let mut report = report();
        report.routes[0].last = 999;
        assert!(report.check(&[Expect::Alive("recorder", "imu")]).is_err());
    }

    #[test]
    fn repeats_are_never_expected() {
        for (duplicated, reordered) in [(1, 0), (0, 1)] {
            let mut report = report();
            report.routes[0].lost = 0;
            report.check(&[Expect::Whole("recorder", "imu")]).unwrap();
            report.routes[0].duplicated = duplicated;
            report.routes[0].reordered = reordered;
            assert!(report.check(&[Expect::Whole("recorder", "imu")]).is_err());
            assert!(report.check(&[Expect::LostAtMost("recorder", "imu", 1.0)]).is_err());
        }
    }
}
