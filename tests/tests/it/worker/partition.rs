//! The link to the main service loses everything without a word while very much is changed.
//! Afterwards all is as if nothing had been: equal within five seconds, each service told once of
//! what has become of its configuration, and nothing resurrected.

use std::collections::BTreeMap;
use std::time::Duration;

use blaze_brokers::Subscription;
use blaze_tests::network::{Plan, Topology, inside, run};
use blaze_tests::{long, within};
use reqwest::Method;
use serde_json::{Value, json};

use super::kit::Robot;
use super::stage::{PATIENCE, Service, Stage, Worker, next, rest};

/// Everything must be equal so soon after the link is whole again.
const EQUAL: Duration = Duration::from_secs(5);
/// Changed at random: there or not, with and without overrides.
const RANDOM: [&str; 5] = ["camera", "lidar", "map", "nav", "slam"];
/// Changed in a certain way.
const GONE: &str = "gone";
const AGAIN: &str = "again";
const SAME: &str = "same";
const QUIET: &str = "quiet";
const ROBOTS: [&str; 2] = ["robot-1", "robot-2"];

fn services() -> Vec<&'static str> {
    [RANDOM.as_slice(), &[GONE, AGAIN, SAME, QUIET]].concat()
}

/// A cut between the workers and the port of the main service: packets of both directions vanish.
struct Cut<'a> {
    namespace: &'a str,
    port: u16,
}

impl Cut<'_> {
    fn begin(&self) {
        let Self { namespace, port } = self;
        let rules = format!("tcp dport {port} drop; tcp sport {port} drop;");
        let table = format!(
            "table ip cut {{ chain lost {{ type filter hook input priority 0; {rules} }}; }}"
        );
        run(&format!("ip netns exec {namespace} nft '{table}'")).unwrap();
    }

    fn end(&self) {
        run(&format!("ip netns exec {} nft delete table ip cut", self.namespace)).unwrap();
    }
}

/// Changes, as many and as mixed as one likes, the same in each run.
struct Changes<'a> {
    stage: &'a Stage,
    random: u64,
    is_there: BTreeMap<&'static str, bool>,
    count: u64,
}

impl<'a> Changes<'a> {
    fn new(stage: &'a Stage) -> Self {
        Self {
            stage,
            random: 0x9e37_79b9_7f4a_7c15,
            is_there: services().into_iter().map(|service| (service, true)).collect(),
            count: 0,
        }
    }

    fn draw(&mut self, below: u64) -> u64 {
        // xorshift: any mixture will do.
        self.random ^= self.random << 13;
        self.random ^= self.random >> 7;
        self.random ^= self.random << 17;
        self.random % below
    }

    async fn put(&mut self, path: &str, spec: Value) {
        self.count += 1;
        self.stage.put(path, spec).await;
    }

    async fn delete(&mut self, service: &'static str) {
        self.count += 1;
        let path = format!("/services/{service}?cascade=true");
        self.stage.send(Method::DELETE, &path, None).await;
        self.is_there.insert(service, false);
    }

    /// A service with an instance on each robot.
    async fn create(&mut self, service: &'static str, n: u64) {
        self.count += 1;
        let instances =
            ROBOTS.map(|robot| (format!("{service}/{robot}"), json!({ "node": robot })));
        let mut documents = vec![("Service", service, json!({ "config": { "n": n } }))];
        documents
            .extend(instances.iter().map(|(name, spec)| ("Instance", name.as_str(), spec.clone())));
        self.stage.apply(&documents).await;
        self.is_there.insert(service, true);
    }

    async fn one(&mut self) {
        let n = self.count;
        let service = RANDOM[self.draw(RANDOM.len() as u64) as usize];
        let robot = ROBOTS[self.draw(2) as usize];
        match (self.draw(6), self.is_there[service]) {
            (_, false) => self.create(service, n).await,
            (0, true) => self.delete(service).await,
            (1, true) => {
                let spec = json!({ "node": robot, "config": { "own": n } });
                self.put(&format!("/services/{service}/instances/{robot}"), spec).await;
            }
            (2, true) => {
                let spec = json!({ "layer": "edge", "overrides": { service: { "here": n } } });
                self.put(&format!("/nodes/{robot}"), spec).await;
            }
            (3, true) => {
                let spec = json!({ "kind": "edge", "overrides": { service: { "all": n } } });
                self.put("/layers/edge", spec).await;
            }
            (_, true) => {
                self.put(&format!("/services/{service}"), json!({ "config": { "n": n } })).await;
            }
        }
    }

    /// What is wanted of certain services, in the middle of everything else.
    async fn certain(&mut self) {
        self.delete(AGAIN).await;
        self.delete(GONE).await;
        self.put("/services/same", json!({ "config": { "n": 99 } })).await;
        self.create(AGAIN, 77).await;
        self.create(GONE, 88).await;
        self.put("/services/same", json!({ "config": { "n": 0 } })).await;
        self.delete(GONE).await;
    }
}

/// What somebody who asks has: the hash; `None`: there is no such service.
async fn ask(service: &mut Service, place: &Place) -> (Option<String>, u64) {
    let answer = service.ask(json!({ "service": place.0, "instance": place.1 }), PATIENCE).await;
    match answer["hash"].as_str() {
        Some(hash) => (Some(hash.to_owned()), answer["revision"].as_u64().unwrap()),
        None => {
            assert_eq!(answer["error"]["code"], "not_found", "{answer}");
            (None, 0)
        }
    }
}

/// Service and instance.
type Place = (&'static str, Option<&'static str>);

/// A robot, who listens on it, and what its services had before.
struct Watched {
    robot: Robot,
    worker: Worker,
    service: Service,
    heard: BTreeMap<&'static str, Subscription>,
    before: BTreeMap<Place, (Option<String>, u64)>,
}

impl Watched {
    async fn start(stage: &Stage, node: &'static str) -> Self {
        let robot = Robot::new(stage, node);
        let worker = robot.worker(stage);
        stage.equal(&worker, PATIENCE).await;
        let service = robot.service().await;
        let mut heard = BTreeMap::new();
        for name in services() {
            heard.insert(name, service.listen(name).await);
        }
        Self { robot, worker, service, heard, before: BTreeMap::new() }
    }

    /// All notices up to those that a change of everything, at this revision, brings to every
    /// place.
    async fn until(&mut self, revision: u64) -> BTreeMap<Place, Vec<Value>> {
        let mut all: BTreeMap<Place, Vec<Value>> = BTreeMap::new();
        for (name, notices) in &mut self.heard {
            let (mut newest, mut missing) = (0, 2);
            while missing > 0 {
                let notice = next(notices).await;
                let (at, instance) =
                    (notice["revision"].as_u64().unwrap(), notice["instance"].as_str());
                assert!(at >= newest, "{name}: {notice} after revision {newest}");
                newest = at;
                missing -= usize::from(at >= revision);
                // Only what is on this robot is told here.
                assert!(instance.is_none_or(|instance| instance == self.robot.node), "{notice}");
                let place = (*name, instance.map(|_| self.robot.node));
                all.entry(place).or_default().push(notice);
            }
            let more = rest(notices).await;
            assert!(more.is_empty(), "{name}: each place is told of it once: {more:?}");
        }
        all
    }

    async fn hears_nothing(&mut self) {
        for (name, notices) in &mut self.heard {
            assert!(rest(notices).await.is_empty(), "{name} on {}", self.robot.node);
        }
    }

    /// Each place has what the main service has for it, by whatever way it looks; what is gone is
    /// nowhere.
    async fn check_state(&mut self, stage: &Stage, is_there: &BTreeMap<&'static str, bool>) {
        for place in self.before.keys().copied().collect::<Vec<_>>() {
            let (name, instance) = place;
            let (hash, _) = ask(&mut self.service, &place).await;
            let suffix = instance.map(|instance| format!(":{instance}")).unwrap_or_default();
            let key = self.robot.key(&format!("blaze:config:{name}{suffix}")).await;
            if !is_there[name] {
                assert_eq!((&hash, &key), (&None, &None), "{place:?} is back");
                continue;
            }
            let instance =
                instance.map(|instance| format!("&instance={instance}")).unwrap_or_default();
            let effective = stage
                .get(&format!("/effective?service={name}&node={}{instance}", self.robot.node))
                .await;
            assert_eq!(hash.as_deref(), effective["hash"].as_str(), "{place:?}");
            assert_eq!(key.unwrap()["hash"], effective["hash"], "the key of {place:?}");
        }
    }

    /// Compares what was told of the outage with what each place had before and has now. `marker`:
    /// a change of everything after it.
    fn check_told(&self, told: &BTreeMap<Place, Vec<Value>>, marker: u64) {
        let is_marker = |notice: &&Value| notice["revision"].as_u64().unwrap() >= marker;
        for (place, (before, revision)) in &self.before {
            let of_outage: Vec<&Value> =
                told[place].iter().filter(|notice| !is_marker(notice)).collect();
            let after = told[place].iter().find(is_marker).unwrap()["previous_hash"]
                .as_str()
                .map(str::to_owned);
            if *before == after {
                assert!(of_outage.is_empty(), "{place:?} is what it was: {of_outage:?}");
                continue;
            }
            assert_eq!(of_outage.len(), 1, "{place:?}: {of_outage:?}");
            assert_eq!(of_outage[0]["hash"].as_str(), after.as_deref(), "{place:?}");
            assert!(of_outage[0]["revision"].as_u64().unwrap() > *revision, "{place:?}");
        }
        for instance in [None, Some(self.robot.node)] {
            let of = |name| &told[&(name, instance)];
            assert_eq!((of(SAME).len(), of(QUIET).len()), (1, 1), "nothing but the marker");
            assert_eq!((of(GONE).len(), &of(GONE)[0]["deleted"]), (2, &json!(true)));
            assert_eq!((of(AGAIN).len(), &of(AGAIN)[0]["config"]["n"]), (2, &json!(77)));
        }
    }
}

/// Everything that there is at the beginning.
async fn documents(stage: &Stage) {
    let mut documents = vec![("Layer", "edge", json!({ "kind": "edge" }))];
    documents.extend(ROBOTS.map(|robot| ("Node", robot, json!({ "layer": "edge" }))));
    stage.apply(&documents).await;
    let mut changes = Changes::new(stage);
    for service in services() {
        changes.create(service, 0).await;
    }
}

/// One commit after which every place has another configuration than before; those that are gone
/// are there again.
async fn change_all(stage: &Stage, mark: &str, gone: &[&'static str]) -> u64 {
    let layer = json!({ "kind": "edge", "config": { "mark": mark } });
    let mut documents = vec![("Layer", "edge".to_owned(), layer)];
    for service in gone {
        documents.push(("Service", (*service).to_owned(), json!({ "config": {} })));
        documents.extend(
            ROBOTS
                .map(|robot| ("Instance", format!("{service}/{robot}"), json!({ "node": robot }))),
        );
    }
    let documents: Vec<_> =
        documents.iter().map(|(kind, name, spec)| (*kind, name.as_str(), spec.clone())).collect();
    stage.apply(&documents).await
}

async fn everything_changes_behind_a_cut(namespace: &str) {
    let stage = Stage::new();
    let _main = stage.main();
    documents(&stage).await;
    let mut robots = Vec::new();
    for robot in ROBOTS {
        robots.push(Watched::start(&stage, robot).await);
    }
    let begin = change_all(&stage, "before", &[]).await;
    for robot in &mut robots {
        for (place, notices) in robot.until(begin).await {
            let hash = notices.last().unwrap()["hash"].as_str().map(str::to_owned);
            robot.before.insert(place, (hash, begin));
        }
        robot.worker.has_kept_all(1).await;
    }
    let uid = stage.get("/services/again").await["uid"].clone();

    let cut = Cut { namespace, port: stage.grpc.port() };
    cut.begin();
    let (began, wanted) = (tokio::time::Instant::now(), if long() { 500 } else { 60 });
    let mut changes = Changes::new(&stage);
    while changes.count < wanted / 2 {
        changes.one().await;
    }
    changes.certain().await;
    while changes.count < wanted {
        changes.one().await;
    }
    // What all services of the layer get is at last what it was.
    let layer = json!({
        "kind": "edge",
        "config": { "mark": "before" },
        "overrides": { "map": { "all": wanted } },
    });
    changes.put("/layers/edge", layer).await;
    for robot in &mut robots {
        robot.worker.until("the cut is noticed", |status| status["connected"] == false).await;
    }
    if long() {
        tokio::time::sleep_until(began + Duration::from_secs(30)).await;
    }
    for robot in &mut robots {
        robot.hears_nothing().await;
    }
    let (count, lasted) = (changes.count, began.elapsed());
    cut.end();
    let healed = tokio::time::Instant::now();
    for robot in &robots {
        stage.equal(&robot.worker, within(EQUAL)).await;
    }
    let took = healed.elapsed();
    println!("{count} changes in {lasted:?}; equal {took:?} after the end of the cut");
    assert!(took < within(EQUAL), "{took:?}");
    assert_ne!(stage.get("/services/again").await["uid"], uid);
    let gone: Vec<_> = services().into_iter().filter(|name| !changes.is_there[name]).collect();
    assert!(gone.contains(&GONE) && !gone.contains(&AGAIN));
    for robot in &mut robots {
        // All has been told by then.
        robot.worker.has_kept_all(1).await;
        robot.check_state(&stage, &changes.is_there).await;
    }
    let marker = change_all(&stage, "after", &gone).await;
    for robot in &mut robots {
        let told = robot.until(marker).await;
        robot.check_told(&told, marker);
    }
}

#[test]
fn a_cut_link_with_changes_of_everything_leaves_no_trace() {
    // Two hosts, of which one is used: nothing outside of it sees the cut.
    let network =
        Topology::build(&Plan::new().with_hosts(&["site", "other"]).with_lan(&["site", "other"]))
            .unwrap();
    let namespace = network.host("site").unwrap().namespace.clone();
    inside(&namespace, || {
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
        runtime.block_on(everything_changes_behind_a_cut(&namespace));
        Ok(())
    })
    .unwrap();
}
