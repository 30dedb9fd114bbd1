//! Without a server: nothing that is handed over is ever acknowledged.

use super::*;
use crate::kafka::settings::tests::shared_at;
use crate::kafka::topics::Topics;
use crate::outbox::Body;
use crate::port::PublishOutcome;

/// Where many messages come one by one, those that come meanwhile wait and go together.
#[test]
fn what_comes_while_its_topic_is_in_flight_waits() {
    let producer = Producer::new(Lot::default(), &shared_at("127.0.0.1:9")).unwrap();
    producer.shared().gate.set_up(true);
    let topics = Topics::default();
    let lane_of = |name: &str| {
        let (topic, _) = topics.of(&name.into(), false);
        topics.note(&std::collections::HashMap::from([(name.to_owned(), 1)]), false);
        producer.lane(Target { topic, keying: Keying::Writer { depth: 0 } })
    };
    let (one, other) = (lane_of("a"), lane_of("b"));
    let publish = |lane: &Lane<Target>| {
        assert_eq!(lane.push(Body::Bare(Bytes::from_static(b"x")), None), PublishOutcome::Taken);
        producer.hand_over(&mut Vec::new(), &mut String::new());
        producer.context.in_flight.load(Ordering::Acquire)
    };
    let first = publish(&one);
    assert!(first > 0);
    assert_eq!(publish(&one), first, "the second waits");
    assert!(publish(&other) > first, "that of another topic goes");
}

/// Closing ends a client that is drained, with what is on its way from the outbox to it.
#[test]
fn what_is_being_handed_over_is_not_drained() {
    const MESSAGES: u64 = 200;
    for _ in 0..20 {
        let producer = Producer::new(Lot::default(), &shared_at("127.0.0.1:9")).unwrap();
        producer.shared().gate.set_up(true);
        let topics = Topics::default();
        let name: Arc<str> = "fog.imu.data".into();
        let (topic, _) = topics.of(&name, false);
        topics.note(&std::collections::HashMap::from([(name.to_string(), 1)]), false);
        let lane = producer.lane(Target { topic, keying: Keying::Writer { depth: 0 } });
        assert!(producer.is_drained());
        for _ in 0..MESSAGES {
            let body = Body::Bare(Bytes::from_static(b"bare"));
            assert_eq!(lane.push(body, None), PublishOutcome::Taken);
        }
        let (looks, over) = (AtomicBool::new(false), AtomicBool::new(false));
        let drained = std::thread::scope(|scope| {
            let watch = scope.spawn(|| {
                let mut drained = producer.is_drained();
                looks.store(true, Ordering::Release);
                while !over.load(Ordering::Acquire) {
                    drained |= producer.is_drained();
                }
                drained
            });
            while !looks.load(Ordering::Acquire) {
                std::hint::spin_loop();
            }
            producer.hand_over(&mut Vec::new(), &mut String::new());
            over.store(true, Ordering::Release);
            watch.join().unwrap()
        });
        assert!(!drained, "nothing was acknowledged");
        assert_eq!(lane.later().queued, MESSAGES);
    }
}
