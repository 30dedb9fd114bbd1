use std::collections::HashMap;
use std::net::SocketAddr;

use blaze_sdk::SubscriptionStats;
use parking_lot::Mutex;

use super::*;
use crate::demo::camera::Pictures;
use crate::demo::changes::{ChangePlan, Taken, Wanted};
use crate::demo::options::DemoNode;
use crate::demo::recording::{Recording, load_built_in};
use crate::demo::report::Style;
use crate::demo::roles::{consumers, played_topics};
use crate::demo::stats::Arrival;

/// Brings every message to every consumer at once, in place of flows.
struct Wire {
    board: Arc<Board>,
    listening: Arc<Mutex<HashMap<usize, Vec<ConsumerId>>>>,
    topics: Vec<TopicName>,
    /// Every so many messages of the first topic one is left out.
    lose_every: u64,
    lost: Arc<Mutex<HashMap<ConsumerId, u64>>>,
    changed: Mutex<Vec<Wanted>>,
}

impl Stage for Wire {
    fn admin_ports(&self) -> Vec<(DemoNode, SocketAddr)> {
        Vec::new()
    }

    async fn listen(&self, consumer: &Consumer, id: ConsumerId) -> Result<(), String> {
        let topic =
            self.topics.iter().position(|topic| *topic == consumer.topic).ok_or("no such topic")?;
        self.listening.lock().entry(topic).or_default().push(id);
        Ok(())
    }

    async fn stop_listening(&self, id: ConsumerId) -> Result<(), String> {
        for listening in self.listening.lock().values_mut() {
            listening.retain(|other| *other != id);
        }
        Ok(())
    }

    fn publisher(&self) -> Option<Box<dyn FnMut(usize, bytes::Bytes) + Send>> {
        let (board, listening, lose_every) =
            (Arc::clone(&self.board), Arc::clone(&self.listening), self.lose_every);
        let lost = Arc::clone(&self.lost);
        let (mut published, mut of_first): (u64, u64) = (0, 0);
        Some(Box::new(move |topic, payload| {
            published += 1;
            of_first += u64::from(topic == 0);
            if topic == 0 && of_first.is_multiple_of(lose_every) {
                for id in listening.lock().get(&topic).into_iter().flatten() {
                    *lost.lock().entry(*id).or_default() += 1;
                }
                return;
            }
            let arrival = Arrival {
                publish_time_ns: published * 1_000_000,
                latency: Duration::from_micros(100),
                bytes: payload.len(),
            };
            for id in listening.lock().get(&topic).into_iter().flatten() {
                board.arrived(*id, &arrival, Instant::now());
            }
        }))
    }

    async fn change(&self, wanted: &Wanted) -> Result<Taken, String> {
        let revision = match wanted {
            Wanted::Window(_) => 7,
            Wanted::Limit(_) => 8,
        };
        self.changed.lock().push(*wanted);
        Ok(Taken {
            revision,
            accepted: Duration::from_millis(2),
            called_back: Duration::from_millis(3),
        })
    }

    /// Ten times as many after the change of the service.
    fn results(&self) -> u64 {
        let received = self.board.received_by_all();
        match self.changed.lock().is_empty() {
            true => received,
            false => received * 10,
        }
    }

    async fn look(&self) {
        for (id, lost) in &*self.lost.lock() {
            let mut counts = SubscriptionStats::default();
            counts.lost = *lost;
            self.board.set_consumer_counts(*id, counts);
        }
    }

    async fn interrupted(&self) -> Option<String> {
        std::future::pending().await
    }
}

async fn run_demo(duration: Duration, lose_every: u64) -> (Summary, String) {
    let (summary, printed, _) =
        run_with(duration, lose_every, Err("no changes are shown".to_owned())).await;
    (summary, printed)
}

async fn run_with(
    duration: Duration,
    lose_every: u64,
    changes: Result<ChangePlan, String>,
) -> (Summary, String, Vec<Wanted>) {
    let recordings: Vec<Arc<Recording>> =
        load_built_in(Pictures::Rgb).unwrap().into_iter().map(Arc::new).collect();
    let topics = played_topics(recordings.iter().map(Arc::as_ref));
    let board = Arc::new(Board::new(topics.clone(), &DemoNode::ALL, Instant::now()));
    let wire = Wire {
        board: Arc::clone(&board),
        listening: Arc::default(),
        topics: topics.iter().map(|topic| topic.name.clone()).collect(),
        lose_every,
        lost: Arc::default(),
        changed: Mutex::default(),
    };
    let script = Script {
        nodes: DemoNode::ALL.to_vec(),
        consumers: consumers(&topics, &DemoNode::ALL),
        recordings,
        topics,
        duration,
        changes,
    };
    let (mut out, mut err) = (Vec::new(), Vec::new());
    let mut report = Report::new(Style::Json, &mut out, &mut err);
    let summary = run(&wire, &board, script, &mut report).await.unwrap();
    out.extend(err);
    (summary, String::from_utf8(out).unwrap(), wire.changed.into_inner())
}

#[tokio::test]
async fn changes_come_at_their_times_and_what_they_do_is_measured() {
    let plan = ChangePlan {
        limit_mbps: 160.0,
        with_pictures: true,
        // The wire has no limit.
        limit_binds: false,
    };
    let (summary, printed, changed) = run_with(Duration::from_secs(8), u64::MAX, Ok(plan)).await;
    assert!(summary.ok, "{:?}", summary.problems);
    assert_eq!(changed, [Wanted::Window(10), Wanted::Limit(Some(40.0)), Wanted::Limit(None)]);
    let [service, link] = &summary.changes[..] else {
        panic!("{:?}", summary.changes);
    };
    assert!(service.after_per_s > 5.0 * service.before_per_s, "{service:?}");
    assert_eq!((service.revision, service.accepted_ms, service.callback_ms), (7, 2.0, 3.0));
    assert!(link.before_per_s > 20.0 && link.after_per_s > 20.0, "{link:?}");
    for part in [
        "PUT service/analytics (window 50 → 10): 2xx after 2.0 ms",
        "160 Mbit/s again after 3.0 ms",
    ] {
        assert!(printed.contains(part), "{part}: {printed}");
    }
}

#[tokio::test]
async fn a_perfect_wire_is_ok() {
    let (summary, printed) = run_demo(Duration::from_millis(2_500), u64::MAX).await;
    assert!(summary.ok, "{:?}", summary.problems);
    assert_eq!(
        summary.topics.len(),
        11,
        "three topics on three layers, and the consumer that moved"
    );
    let camera = summary.topics.iter().find(|row| row.topic == "camera/image_raw").unwrap();
    assert!(camera.received >= 60, "{camera:?}");
    assert_eq!(summary.moves[0].gap_ms, 0.0);
    let rows = printed.lines().filter(|line| line.contains("\"kind\":\"row\"")).count();
    assert!(rows >= 20, "{rows} rows of 10 consumers in 2.5 s");
    assert!(printed.contains("\"kind\":\"summary\"") && printed.contains("no changes are shown"));
}

#[tokio::test]
async fn a_loss_is_seen_and_judged() {
    let (summary, _) = run_demo(Duration::from_secs(1), 20).await;
    assert!(!summary.ok);
    let lost = summary.topics.iter().filter(|row| row.lost > 0);
    let topics: Vec<&str> = lost.map(|row| row.topic.as_str()).collect();
    assert!(!topics.is_empty());
    assert!(topics.iter().all(|topic| *topic == topics[0]), "{topics:?}");
}
