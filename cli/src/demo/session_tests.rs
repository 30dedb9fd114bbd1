use std::collections::HashMap;

use blaze_domain::WriterId;
use parking_lot::Mutex;

use super::*;
use crate::demo::recording::load_built_in;
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
}

impl Stage for Wire {
    fn admin_ports(&self) -> Vec<(DemoNode, SocketAddr)> {
        Vec::new()
    }

    async fn listen(&self, consumer: &Consumer, id: ConsumerId) -> Result<(), String> {
        let topic = self
            .topics
            .iter()
            .position(|topic| *topic == consumer.topic)
            .ok_or("no such topic")?;
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
        let (board, listening, lose_every) = (Arc::clone(&self.board), Arc::clone(&self.listening), self.lose_every);
        let mut sequences: HashMap<usize, u64> = HashMap::new();
        let mut published = 0;
        Some(Box::new(move |topic, payload| {
            let sequence = sequences.entry(topic).or_default();
            *sequence += 1;
            published += 1;
            if topic == 0 && sequence.is_multiple_of(lose_every) {
                return;
            }
            let arrival = Arrival {
                writer: WriterId([topic as u8; 16]),
                sequence: *sequence,
                publish_time_ns: published * 1_000_000,
                latency: Duration::from_micros(100),
                bytes: payload.len(),
            };
            for id in listening.lock().get(&topic).into_iter().flatten() {
                board.arrived(*id, &arrival, Instant::now());
            }
        }))
    }

    async fn look(&self) {}

    async fn interrupted(&self) -> Option<String> {
        std::future::pending().await
    }
}

async fn run_demo(duration: Duration, lose_every: u64) -> (Summary, String) {
    let recordings: Vec<Arc<Recording>> = load_built_in().unwrap().into_iter().map(Arc::new).collect();
    let topics = played_topics(recordings.iter().map(Arc::as_ref));
    let board = Arc::new(Board::new(topics.clone(), &DemoNode::ALL, Instant::now()));
    let wire = Wire {
        board: Arc::clone(&board),
        listening: Arc::default(),
        topics: topics.iter().map(|topic| topic.name.clone()).collect(),
        lose_every,
    };
    let script = Script {
        nodes: DemoNode::ALL.to_vec(),
        consumers: consumers(&topics, &DemoNode::ALL),
        recordings,
        topics,
        duration,
    };
    let mut out = Vec::new();
    let mut report = Report::new(Style::Json, &mut out, std::io::sink());
    let summary = run(&wire, &board, script, &mut report).await.unwrap();
    (summary, String::from_utf8(out).unwrap())
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
    let camera = summary
        .topics
        .iter()
        .find(|row| row.topic == "camera/image_raw")
        .unwrap();
    assert!(camera.received >= 60, "{camera:?}");
    assert_eq!(summary.moves[0].gap_ms, 0.0);
    let rows = printed.lines().filter(|line| line.contains("\"kind\":\"row\"")).count();
    assert!(rows >= 20, "{rows} rows of 10 consumers in 2.5 s");
    assert!(printed.lines().last().unwrap().contains("\"kind\":\"summary\""));
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
