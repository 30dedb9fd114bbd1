use blaze_domain::{Origin, WriterId};
use blaze_proto::Header;
use bytes::Bytes;

use super::*;
use crate::demo::roles;

fn topic(name: &str, large: bool) -> PlayedTopic {
    PlayedTopic {
        name: name.parse().unwrap(),
        service: if large { "camera-driver" } else { "imu-driver" },
        type_name: String::new(),
        encoding: String::new(),
        rate_hz: 50.0,
        max_bytes: 100,
        depth: 0,
        large,
    }
}

fn board(nodes: &[DemoNode], start: Instant) -> Board {
    Board::new(vec![topic("imu/data", false), topic("camera/image_raw", true)], nodes, start)
}

fn consumer(service: &'static str, node: DemoNode) -> Consumer {
    Consumer { service, node, topic: "imu/data".parse().unwrap(), later: false }
}

fn arrival(published_ms: u64) -> Arrival {
    Arrival {
        publish_time_ns: published_ms * 1_000_000,
        latency: Duration::from_millis(2),
        bytes: 300,
    }
}

#[test]
fn rows_show_the_last_second_and_the_whole() {
    let start = Instant::now();
    let at = |millis| start + Duration::from_millis(millis);
    let board = board(&DemoNode::ALL, start);
    let recorder = board.add_consumer(consumer("recorder", DemoNode::Cloud1), start).unwrap();
    for index in 0..100 {
        board.published(0, at(index * 20));
        board.arrived(recorder, &arrival(index * 20), at(index * 20 + 1));
        if index == 49 {
            board.published(1, at(990));
            let rows = board.recent(at(1_000));
            assert_eq!(rows.len(), 2, "one consumer, and the camera that nobody listens to");
            assert_eq!(
                (rows[0].received, rows[0].rate_out_hz, rows[0].rate_in_hz),
                (50, 50.0, Some(50.0))
            );
            assert_eq!(rows[0].bytes_per_s, 15_000.0);
            assert_eq!((rows[1].to.as_deref(), rows[1].sent), (None, Some(1)));
        }
    }
    let rows = board.recent(at(2_000));
    assert_eq!((rows[0].received, rows[0].sent), (50, Some(50)));
    let mut counts = SubscriptionStats::default();
    (counts.lost, counts.expired, counts.duplicated, counts.reordered) = (4, 3, 2, 1);
    board.set_consumer_counts(recorder, counts);
    let recent = &board.recent(at(3_000))[0];
    // What its own queue left out is missing, too.
    assert_eq!((recent.lost, recent.duplicated, recent.reordered), (7, 2, 1));
    assert_eq!(recent.dropped["lifespan"], 3);
    counts.lost -= 1;
    board.set_consumer_counts(recorder, counts);
    let later = &board.recent(at(4_000))[0];
    assert_eq!((later.lost, later.duplicated, later.reordered), (0, 0, 0));
    let total = board.total(at(2_000));
    assert_eq!((total[0].lost, total[0].duplicated, total[0].reordered), (6, 2, 1));
    assert_eq!(total[0].dropped, BTreeMap::from([("lifespan".to_owned(), 3)]));
    assert_eq!((total[0].received, total[0].sent), (100, Some(100)));
    assert!((total[0].latency_ms.p99.unwrap() - 2.0).abs() < 0.25);
    assert_eq!(board.first_message_s(), BTreeMap::from([("cloud", 0.001)]));
}

#[test]
fn the_gap_of_a_move_is_between_messages() {
    let start = Instant::now();
    let board = board(&DemoNode::ALL, start);
    let fog = board.add_consumer(consumer(roles::MOVING_SERVICE, DemoNode::Fog1), start).unwrap();
    let cloud =
        board.add_consumer(consumer(roles::MOVING_SERVICE, DemoNode::Cloud1), start).unwrap();
    board.arrived(fog, &arrival(100), start);
    assert_eq!(board.moved(), None);
    board.arrived(cloud, &arrival(160), start);
    assert_eq!(board.moved(), None, "it has not left the fog");
    board.end_consumer(fog);
    let moved = board.moved().unwrap();
    assert_eq!(
        (moved.gap_ms, moved.from.as_str(), moved.to.as_str()),
        (60.0, "fog/fog-1", "cloud/cloud-1")
    );
    // Side by side for a while: no gap.
    board.arrived(fog, &arrival(180), start);
    assert_eq!(board.moved().unwrap().gap_ms, 0.0);
    // One that has left has no live row any more, but stays in the summary.
    assert_eq!(board.recent(start).iter().filter(|row| row.service.is_some()).count(), 1);
    assert_eq!(board.total(start).iter().filter(|row| row.service.is_some()).count(), 2);
}

#[test]
fn the_age_counts_where_clocks_may_differ() {
    let start = Instant::now();
    let header = Header {
        age_us: 7_000,
        ..Header::new("imu/data", Origin::default(), WriterId([1; 16]), 1, 1_000_000_000)
    };
    let frame = Frame::new(&header, Bytes::from_static(b"x")).unwrap();
    for (nodes, expected_ms) in [(&DemoNode::ALL[..], 500.0), (&[DemoNode::Cloud1][..], 7.0)] {
        let board = board(nodes, start);
        let id = board.add_consumer(consumer("recorder", DemoNode::Cloud1), start).unwrap();
        board.frame_arrived(id, &frame, 1_500_000_000, start);
        let p50 = board.total(start)[0].latency_ms.p50.unwrap();
        assert!((p50 / expected_ms - 1.0).abs() < 0.125, "{p50}");
    }
}

#[test]
fn drops_of_bridges_made_anew_add_up() {
    let drops = |count: u64| BTreeMap::from([("lifespan".to_owned(), count)]);
    let mut counter = DropCounter::default();
    for count in [2, 5, 1, 4] {
        counter.set(drops(count));
    }
    assert_eq!(counter.total(), drops(9));
}
