//! Several programs that run under the name of one flow: other flows speak with the newest alone.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::net::Ipv4Addr;
use std::time::{Duration, Instant};

use blaze_domain::FlowId;

use super::transport::Endpoint;

/// A program that was killed can be seen for the 50 s of its lease. Two that are seen for longer
/// both run.
const LINGERS: Duration = Duration::from_secs(60);

/// A life of a flow, as the transport sees it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Life {
    /// Which one.
    pub endpoint: Endpoint,
    /// Where it runs.
    pub addresses: Vec<Ipv4Addr>,
    /// Since when it is seen.
    pub since: Instant,
}

/// A name that several programs have.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NameConflict {
    /// The name.
    pub flow: FlowId,
    /// It is the name of this flow, and other flows speak with a newer program instead.
    pub is_refused: bool,
    /// The programs and their addresses, for people.
    pub detail: String,
}

/// The conflicts among the lives of other programs, some of which may have the name of this flow.
/// `own` is the life of this one.
pub(crate) fn conflicts(own: &Life, others: &[Life], now: Instant) -> Vec<NameConflict> {
    let mut by_flow: BTreeMap<&FlowId, Vec<&Life>> = BTreeMap::new();
    for life in others.iter().chain([own]) {
        by_flow.entry(&life.endpoint.flow).or_default().push(life);
    }
    let both_run = |lives: &[&Life]| {
        let lingers = |life: &&&Life| now.saturating_duration_since(life.since) < LINGERS;
        lives.iter().filter(|life| !lingers(life)).count() > 1
    };
    let conflict = |(flow, mut lives): (&FlowId, Vec<&Life>)| {
        lives.sort_by_key(|life| life.endpoint.epoch);
        let is_own = *flow == own.endpoint.flow;
        let is_refused =
            is_own && lives.last().is_some_and(|newest| newest.endpoint != own.endpoint);
        (is_refused || both_run(&lives)).then(|| NameConflict {
            flow: flow.clone(),
            is_refused,
            detail: detail(flow, &lives, own, is_refused),
        })
    };
    by_flow.into_iter().filter_map(conflict).collect()
}

fn detail(flow: &FlowId, lives: &[&Life], own: &Life, is_refused: bool) -> String {
    let place = |life: &&Life| {
        let addresses: Vec<String> = life.addresses.iter().map(ToString::to_string).collect();
        let this = if life.endpoint == own.endpoint { " (this program)" } else { "" };
        format!("{}, epoch {}{this}", addresses.join(" and "), life.endpoint.epoch)
    };
    let places: Vec<String> = lives.iter().map(place).collect();
    let mut text =
        format!("{} programs run under the name {flow}: at {}", lives.len(), places.join("; at "));
    if is_refused {
        let _ = write!(text, "; other flows speak with the last one alone, not with this program");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn life(flow: &str, epoch: u64, host: u8, since: Instant) -> Life {
        let endpoint = Endpoint { flow: flow.parse().unwrap(), epoch };
        Life { endpoint, addresses: vec![Ipv4Addr::new(10, 0, 0, host)], since }
    }

    #[test]
    fn a_newer_program_of_the_own_name_is_named_at_once() {
        let now = Instant::now();
        let found = conflicts(&life("edge/a", 5, 1, now), &[life("edge/a", 9, 2, now)], now);
        let detail = "2 programs run under the name edge/a: at 10.0.0.1, epoch 5 (this program); \
            at 10.0.0.2, epoch 9; other flows speak with the last one alone, not with this program";
        assert!(found[0].is_refused && found.len() == 1);
        assert_eq!(found[0].detail, detail);
    }

    #[test]
    fn what_a_killed_program_leaves_is_no_conflict() {
        let start = Instant::now();
        let own = life("edge/a", 9, 1, start);
        let others = [
            life("edge/a", 5, 1, start),
            life("fog/b", 1, 2, start),
            life("fog/b", 2, 2, start + Duration::from_secs(1)),
            life("fog/c", 1, 3, start),
        ];
        let flows = |after: u64| {
            let found = conflicts(&own, &others, start + Duration::from_secs(after));
            assert!(found.iter().all(|found| !found.is_refused));
            found.iter().map(|found| found.flow.to_string()).collect::<Vec<_>>()
        };
        assert!(flows(59).is_empty());
        assert_eq!(flows(60), ["edge/a"]);
        assert_eq!(flows(61), ["edge/a", "fog/b"]);
    }
}
