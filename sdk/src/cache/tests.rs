//! Signs of life in keys that vanish, on a clock that stands still until all wait.

use std::collections::BTreeMap;

use async_trait::async_trait;
use blaze_brokers::memory::MemoryHub;
use blaze_brokers::redis::Record;
use blaze_domain::Scope;
use tokio::time::Instant;

use super::*;
use crate::config::ConfigManager;
use crate::pool::Pool;
use crate::service::slam;

const TTL: Duration = Duration::from_secs(15);

/// Keys in memory that vanish as those of Redis do.
#[derive(Default)]
struct Keys {
    records: Mutex<BTreeMap<String, (Record, Instant)>>,
    values: Mutex<BTreeMap<String, (Bytes, Instant)>>,
    writes: Mutex<Vec<Instant>>,
    is_away: Mutex<bool>,
}

impl Keys {
    fn reach(&self) -> Result<(), KeyError> {
        match *self.is_away.lock() {
            true => {
                Err(KeyError::Away { place: "here".to_owned(), reason: "switched off".to_owned() })
            }
            false => Ok(()),
        }
    }

    fn now(&self, key: &str) -> Option<Record> {
        let records = self.records.lock();
        records
            .get(key)
            .filter(|(_, until)| *until > Instant::now())
            .map(|(record, _)| record.clone())
    }
}

#[async_trait]
impl Store for Keys {
    async fn record(&self, key: &str) -> Result<Option<Record>, KeyError> {
        self.reach()?;
        Ok(self.now(key))
    }

    async fn records(
        &self,
        beginning: &str,
        most: usize,
    ) -> Result<Vec<(String, Record)>, KeyError> {
        self.reach()?;
        let keys: Vec<String> =
            self.records.lock().keys().filter(|key| key.starts_with(beginning)).cloned().collect();
        let found = keys.into_iter().filter_map(|key| self.now(&key).map(|record| (key, record)));
        Ok(found.take(most).collect())
    }

    async fn put_record(
        &self,
        key: &str,
        members: Record,
        expires: Duration,
    ) -> Result<(), KeyError> {
        self.reach()?;
        self.writes.lock().push(Instant::now());
        self.records.lock().insert(key.to_owned(), (members, Instant::now() + expires));
        Ok(())
    }

    async fn delete_record(&self, key: &str, epoch: &str) -> Result<(), KeyError> {
        self.reach()?;
        let mut records = self.records.lock();
        if records.get(key).is_some_and(|(record, _)| record["epoch"] == epoch) {
            records.remove(key);
        }
        Ok(())
    }

    async fn get(&self, key: &str) -> Result<Option<Bytes>, KeyError> {
        self.reach()?;
        let values = self.values.lock();
        Ok(values
            .get(key)
            .filter(|(_, until)| *until > Instant::now())
            .map(|(value, _)| value.clone()))
    }

    async fn put(&self, key: &str, value: &Bytes, expires: Duration) -> Result<(), KeyError> {
        self.reach()?;
        self.values.lock().insert(key.to_owned(), (value.clone(), Instant::now() + expires));
        Ok(())
    }
}

struct World {
    hub: MemoryHub,
    keys: Arc<Keys>,
    supervisor: Supervisor,
    pool: Pool,
}

impl World {
    fn new() -> Self {
        let supervisor = Supervisor::new("t");
        Self {
            hub: MemoryHub::new("node"),
            keys: Arc::default(),
            pool: Pool::start(2, &supervisor).unwrap(),
            supervisor,
        }
    }

    fn service(&self, name: &str, epoch: u64, has_keys: bool) -> CacheManager {
        self.service_by(name, epoch, has_keys, false)
    }

    fn service_by(&self, name: &str, epoch: u64, has_keys: bool, by_clock: bool) -> CacheManager {
        let identity = Identity { service: name.parse().unwrap(), epoch, ..slam() };
        let broker: Arc<dyn Broker> = Arc::new(self.hub.broker());
        let config = ConfigManager::start(
            identity.clone(),
            Scope::Node,
            Arc::clone(&broker),
            &self.supervisor,
            self.pool.handle(),
        );
        let store = has_keys.then(|| Arc::clone(&self.keys) as Arc<dyn Store>);
        CacheManager::start(
            identity,
            broker,
            store,
            WatchdogOptions {
                version: "1.2.3".to_owned(),
                metrics: String::new(),
                ttl: TTL,
                by_clock,
            },
            config.shown(),
            &self.supervisor,
        )
    }
}

async fn until(cache: &CacheManager, wanted: Liveness) {
    let mut liveness = cache.liveness();
    let is_so = liveness.wait_for(|liveness| *liveness == wanted);
    let in_time = tokio::time::timeout(Duration::from_secs(120), is_so).await;
    in_time.unwrap_or_else(|_| panic!("never {wanted:?}")).unwrap();
}

/// Long after this was written, in ms since 1970.
const FUTURE: u64 = 1 << 50;

const SLAM: &str = "blaze:watchdog:slam:robot-1:0";

#[tokio::test(start_paused = true)]
async fn a_record_is_renewed_every_third_and_goes_on_a_clean_end() {
    let world = World::new();
    let slam = world.service("slam", 7, true);
    tokio::time::sleep(TTL).await;
    assert!(world.keys.writes.lock().is_empty(), "nobody said anything");
    slam.set_state(ServiceState::Starting);
    until(&slam, Liveness::Alive).await;
    assert_eq!(world.keys.now(SLAM).unwrap()["state"], "starting");
    slam.set_state(ServiceState::Ready);
    tokio::time::sleep(TTL * 4).await;
    let writes = world.keys.writes.lock().clone();
    let renewed = writes[1..].windows(2).all(|pair| pair[1] - pair[0] == TTL / 3);
    assert!(renewed && (13..=14).contains(&writes.len()), "{writes:?}");
    let record = world.keys.now(SLAM).unwrap();
    assert_eq!((record["state"].as_str(), record["epoch"].as_str()), ("ready", "7"));
    slam.leave(Duration::from_secs(1)).await;
    assert_eq!(world.keys.now(SLAM), None);
    assert_eq!(*slam.liveness().borrow(), Liveness::Ended);
}

#[tokio::test(start_paused = true)]
async fn of_two_processes_of_one_key_the_older_one_falls_silent() {
    for has_keys in [true, false] {
        let world = World::new();
        let older = world.service("slam", 7, has_keys);
        older.set_state(ServiceState::Ready);
        until(&older, Liveness::Alive).await;
        let newer = world.service("slam", 8, has_keys);
        newer.set_state(ServiceState::Starting);
        until(&newer, Liveness::Alive).await;
        until(&older, Liveness::Superseded).await;
        tokio::time::sleep(TTL * 2).await;
        assert_eq!(*newer.liveness().borrow(), Liveness::Alive);
        if has_keys {
            assert_eq!(world.keys.now(SLAM).unwrap()["epoch"], "8");
            let third = world.service("slam", 6, has_keys);
            third.set_state(ServiceState::Ready);
            until(&third, Liveness::Superseded).await;
            third.leave(Duration::from_secs(1)).await;
            assert!(world.keys.now(SLAM).is_some(), "the record is the newer one's");
        }
        // As a failed update does.
        newer.leave(Duration::from_secs(1)).await;
        until(&older, Liveness::Alive).await;
    }
}

#[tokio::test(start_paused = true)]
async fn a_clock_that_went_back_makes_no_process_the_older_one() {
    let world = World::new();
    let before = world.service_by("slam", FUTURE, true, true);
    before.set_state(ServiceState::Ready);
    until(&before, Liveness::Alive).await;
    // It was killed, or lives on: whoever begins is the newer one.
    let after = world.service_by("slam", 7, true, true);
    after.set_state(ServiceState::Ready);
    until(&after, Liveness::Alive).await;
    let next = (FUTURE + 1).to_string();
    assert_eq!(world.keys.now(SLAM).unwrap()["epoch"], next);
    until(&before, Liveness::Superseded).await;
    before.leave(Duration::from_secs(1)).await;
    tokio::time::sleep(TTL * 2).await;
    assert_eq!(*after.liveness().borrow(), Liveness::Alive);
    assert_eq!(world.keys.now(SLAM).unwrap()["epoch"], next);
    // Who began earlier and says so later is the older one all the same.
    let slow = world.service_by("nav", 7, true, true);
    let newer = world.service_by("nav", 8, true, true);
    newer.set_state(ServiceState::Ready);
    until(&newer, Liveness::Alive).await;
    slow.set_state(ServiceState::Ready);
    until(&slow, Liveness::Superseded).await;
}

#[tokio::test(start_paused = true)]
async fn when_the_keys_are_away_it_is_silent_and_says_so_again_soon_after() {
    let world = World::new();
    let slam = world.service("slam", 7, true);
    slam.set_state(ServiceState::Ready);
    until(&slam, Liveness::Alive).await;
    *world.keys.is_away.lock() = true;
    until(&slam, Liveness::Silent).await;
    world.keys.records.lock().clear();
    *world.keys.is_away.lock() = false;
    let back = Instant::now();
    until(&slam, Liveness::Alive).await;
    assert!(back.elapsed() <= Duration::from_secs(1));
    assert!(world.keys.now(SLAM).is_some());
}

#[tokio::test(start_paused = true)]
async fn it_waits_until_all_are_ready_and_names_those_that_are_not() {
    for has_keys in [true, false] {
        let world = World::new();
        let waits = world.service("slam", 1, has_keys);
        let names: Vec<ServiceName> =
            vec!["blaze-config".parse().unwrap(), "blaze-flow".parse().unwrap()];
        let (config, flow) =
            (world.service("blaze-config", 1, has_keys), world.service("blaze-flow", 1, has_keys));
        config.set_state(ServiceState::Ready);
        flow.set_state(ServiceState::Starting);
        let within = Duration::from_secs(20);
        let services = vec![names[1].clone()];
        assert_eq!(
            waits.wait_for(&names, within).await,
            Err(CacheError::NotReady { services, within })
        );
        let is_ready = waits.wait_for(&names, within);
        let becomes_ready = async {
            tokio::time::sleep(TTL / 2).await;
            flow.set_state(ServiceState::Ready);
        };
        let (result, ()) = tokio::join!(is_ready, becomes_ready);
        assert_eq!(result, Ok(()), "{has_keys}");
        config.leave(Duration::from_secs(1)).await;
        let services = vec![names[0].clone()];
        assert_eq!(
            waits.wait_for(&names, within).await,
            Err(CacheError::NotReady { services, within })
        );
    }
}

#[tokio::test(start_paused = true)]
async fn a_value_is_there_for_its_time_and_belongs_to_its_service() {
    let world = World::new();
    let (slam, nav) = (world.service("slam", 1, true), world.service("nav", 1, true));
    slam.put("map", Bytes::from("m"), Duration::from_secs(10)).await.unwrap();
    assert_eq!(slam.get("map").await, Ok(Some(Bytes::from("m"))));
    assert_eq!(nav.get("map").await, Ok(None));
    tokio::time::sleep(Duration::from_secs(11)).await;
    assert_eq!(slam.get("map").await, Ok(None));
    let large = Bytes::from(vec![0; MAX_CACHE_VALUE_BYTES + 1]);
    for (key, value, time) in [
        ("", Bytes::new(), 1),
        ("a\n", Bytes::new(), 1),
        ("a", large, 1),
        ("a", Bytes::new(), 0),
        ("a", Bytes::new(), 31 * 24 * 3600),
    ] {
        let result = slam.put(key, value, Duration::from_secs(time)).await;
        assert!(matches!(result, Err(CacheError::Invalid { .. })), "{key:?} {time}");
    }
    let without = world.service("slam", 1, false);
    assert_eq!(without.get("map").await, Err(CacheError::None));
}
