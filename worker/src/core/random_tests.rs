//! Random documents and commits: however they come, everybody knows in the end what counts for it,
//! and nobody is told what it knows.

use std::collections::BTreeMap;
use std::sync::Arc;

use blaze_domain::config::Document;
use proptest::prelude::*;
use serde_json::json;

use super::super::testing::{document, place, site};
use super::*;

const KEYS: [&str; 10] = [
    "Layer/edge",
    "Node/a",
    "Node/b",
    "Service/s",
    "Service/t",
    "Instance/s/0",
    "Instance/s/1",
    "Instance/t/0",
    "Rollout/q",
    "Rollout/r",
];
const ASKING: [&str; 5] = ["s/0", "s/7", "t/0", "t/8", "s"];

/// One document of a commit: which, and what becomes of it.
#[derive(Debug, Clone)]
struct Write {
    key: usize,
    /// `None`: it is deleted.
    content: Option<Content>,
}

#[derive(Debug, Clone)]
struct Content {
    config: Value,
    overrides: Value,
    /// Decides what else there is to decide: where an instance runs, what a roll-out changes and
    /// how far it is, labels.
    choice: usize,
}

#[derive(Debug, Clone)]
enum Step {
    Commit(Vec<Write>),
    Fail(usize),
    /// After it somebody asks.
    Flush(Option<usize>),
}

fn config() -> impl Strategy<Value = Value> {
    let leaf = prop_oneof![
        4 => (0_u64..3).prop_map(Value::from),
        1 => Just(Value::Null),
        1 => (1_u64..3).prop_map(|version| json!({"$secret": {"text": "canary",
            "version": version}})),
        1 => (0_u64..2).prop_map(|inner| json!({"z": inner})),
    ];
    proptest::collection::btree_map("[xy]", leaf, 0..3)
        .prop_map(|members| Value::Object(members.into_iter().collect()))
}

fn write() -> impl Strategy<Value = Write> {
    let overrides = prop_oneof![
        2 => Just(json!({})),
        1 => config().prop_map(|config| json!({ "s": config })),
        1 => config().prop_map(|config| json!({ "t": config })),
    ];
    let content = (config(), overrides, 0_usize..12)
        .prop_map(|(config, overrides, choice)| Content { config, overrides, choice });
    (0..KEYS.len(), proptest::option::weighted(0.8, content))
        .prop_map(|(key, content)| Write { key, content })
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let step = prop_oneof![
        12 => proptest::collection::vec(write(), 1..4).prop_map(Step::Commit),
        1 => (0_usize..2).prop_map(Step::Fail),
        6 => proptest::option::of(0..ASKING.len()).prop_map(Step::Flush),
    ];
    proptest::collection::vec(step, 1..30)
}

fn written(key: &str, revision: u64, content: &Content) -> Document {
    let Content { config, overrides, choice } = content;
    let spec = match key.split('/').next() {
        Some("Layer") => json!({"config": config, "overrides": overrides}),
        Some("Node") => json!({"layer": "edge", "config": config, "overrides": overrides}),
        Some("Instance") => match choice % 4 {
            0 => json!({"node": "a", "config": config}),
            1 => json!({"node": "b", "config": config}),
            2 => json!({"layer": "edge", "config": config}),
            _ => json!({ "config": config }),
        },
        Some("Rollout") => {
            let target = match choice % 4 {
                0 => json!({"kind": "Service", "name": "s"}),
                1 => json!({"kind": "Instance", "service": "s", "name": "0"}),
                2 => json!({"kind": "Node", "name": "a"}),
                _ => json!({"kind": "Layer", "name": "edge"}),
            };
            json!({
                "target": target,
                "patch": {"config": config},
                "canary": {"node_selector": "canary=true"},
            })
        }
        _ => json!({ "config": config }),
    };
    let mut out = document(key, revision, spec);
    if choice % 3 > 0 {
        out.labels.insert("canary".to_owned(), "true".to_owned());
    }
    if key.starts_with("Rollout") {
        let phase = if *choice < 8 { "canary" } else { "failed" };
        out.status = Some(json!({ "phase": phase }));
    }
    out
}

/// How the commits reach those who are served.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Way {
    OneByOne,
    Together,
    AsSnapshots,
}

struct Run {
    way: Way,
    served: Served,
    /// What the main service has.
    truth: State,
    now: Instant,
    /// What each place knows: the hash, or that its service is deleted.
    known: BTreeMap<ServedTarget, Option<String>>,
    /// Highest revision that each place was told, ever.
    revisions: BTreeMap<ServedTarget, u64>,
    asked: BTreeSet<ServedTarget>,
}

impl Run {
    fn new(way: Way, node: Option<&str>) -> Self {
        let mut served = Served::new(site(node));
        served.apply(&Change::default());
        let mut run = Self {
            way,
            served,
            truth: State::default(),
            now: Instant::now(),
            known: BTreeMap::new(),
            revisions: BTreeMap::new(),
            asked: BTreeSet::new(),
        };
        run.flush();
        run
    }

    fn step(&mut self, step: &Step) {
        match step {
            Step::Commit(writes) => self.commit(writes),
            Step::Fail(which) => {
                let uid = ["Rollout/q", "Rollout/r"][*which];
                self.served.fail_rollout(uid);
                if self.way == Way::OneByOne {
                    self.flush();
                }
            }
            Step::Flush(asking) => {
                self.flush();
                if let Some(asking) = asking {
                    self.ask(ASKING[*asking]);
                }
            }
        }
    }

    fn commit(&mut self, writes: &[Write]) {
        let revision = self.truth.revision() + 1;
        let mut keys = BTreeSet::new();
        for write in writes {
            let key: Key = KEYS[write.key].parse().unwrap();
            match &write.content {
                Some(content) => {
                    self.truth.put(Arc::new(written(KEYS[write.key], revision, content)));
                }
                None => {
                    self.truth.remove(&key);
                }
            }
            keys.insert(key);
        }
        self.truth.advance(revision, []);
        if self.way == Way::AsSnapshots {
            return;
        }
        self.served.apply(&Change { keys: keys.into_iter().collect(), new: self.truth.clone() });
        if self.way == Way::OneByOne {
            self.flush();
        }
    }

    fn ask(&mut self, text: &str) {
        let mut place = place(text);
        place.node = self.served.site().node.clone().or_else(|| "b".parse().ok());
        match self.served.ask(&place, self.now) {
            Some(standing) => {
                self.told(&place, standing.revision);
                assert_eq!(Some(&standing.hash), fresh(&self.served, &self.truth, &place).as_ref());
                self.known.insert(place.clone(), Some(standing.hash));
                self.asked.insert(place);
            }
            None => assert!(self.truth.get(&Key::service(&place.service)).is_none()),
        }
    }

    fn told(&mut self, place: &ServedTarget, revision: u64) {
        let before = self.revisions.insert(place.clone(), revision);
        assert!(before.is_none_or(|before| before <= revision), "{place} goes back");
    }

    fn flush(&mut self) {
        if self.way == Way::AsSnapshots {
            let old = self.served.next.state.clone();
            self.served
                .apply(&Change { keys: difference(&old, &self.truth), new: self.truth.clone() });
        }
        let flushed = self.served.flush(self.now);
        for notice in &flushed.notices {
            assert_ne!(notice.hash, notice.previous_hash, "{} was told nothing new", notice.place);
            self.told(&notice.place, notice.revision);
            assert!(notice.revision <= self.truth.revision());
            if let Some(known) = self.known.get(&notice.place) {
                assert_eq!(&notice.previous_hash, known, "{}", notice.place);
            }
            assert_eq!(notice.hash.is_none(), notice.config.is_none());
            if notice.hash.is_none() {
                assert!(notice.paths.is_empty() && notice.scopes.is_empty());
            } else if notice.previous_hash.is_some() {
                assert!(!notice.paths.is_empty() && !notice.scopes.is_empty());
            }
            self.known.insert(notice.place.clone(), notice.hash.clone());
        }
        for place in flushed.tracked {
            let hash = self.served.standing_of(&place).map(|standing| standing.hash);
            self.known.entry(place).or_insert(hash);
        }
        for place in flushed.untracked {
            self.known.remove(&place);
        }
        self.check();
    }

    /// What everybody knows is what there is, and everybody who must know is there.
    fn check(&self) {
        for (place, told) in self.served.told() {
            let fresh = fresh(&self.served, &self.truth, place);
            assert_eq!(told.hash, fresh, "{place}");
            assert_eq!(self.known.get(place), Some(&fresh), "{place}");
        }
        let site = self.served.site();
        let homes = self.truth.all().filter_map(|(_, held)| site.home(&self.truth, &held.document));
        let expected: BTreeSet<ServedTarget> = homes.chain(self.asked.iter().cloned()).collect();
        let told: BTreeSet<ServedTarget> =
            self.served.told().map(|(place, _)| place.clone()).collect();
        assert_eq!(told, expected);
        assert_eq!(self.known.keys().cloned().collect::<BTreeSet<_>>(), expected);
    }
}

/// The hash of a place, worked out anew from all documents.
fn fresh(served: &Served, truth: &State, place: &ServedTarget) -> Option<String> {
    truth.get(&Key::service(&place.service))?;
    let failed = served.failed();
    let sources = Sources::at_where(truth, &place.at(served.site()), |rollout| {
        !failed.contains(&rollout.uid)
    });
    Some(sources.hash())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn however_commits_come_everybody_knows_what_counts_for_it(
        steps in steps(),
        node in proptest::option::of(Just("a")),
    ) {
        let ends = [Way::OneByOne, Way::Together, Way::AsSnapshots].map(|way| {
            let mut run = Run::new(way, node);
            for step in &steps {
                run.step(step);
            }
            run.flush();
            run.known
        });
        prop_assert_eq!(&ends[0], &ends[1]);
        prop_assert_eq!(&ends[0], &ends[2]);
    }
}
