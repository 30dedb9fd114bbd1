use serde_json::{Value, json};

use super::super::testing::{place, site};
use super::*;

fn ack(value: &Value) -> ConfigAck {
    ConfigAck::parse(value.to_string().as_bytes()).unwrap()
}

fn state(instance: &str, word: &str, epoch: u64) -> ServiceState {
    let message = json!({"layer": "edge", "node": "robot-1", "service": "slam", "instance": instance,
        "epoch": epoch,
        "state": word, "config_revision": 7, "config_hash": "sha256:ab", "ttl_ms": 15000});
    ServiceState::parse(message.to_string().as_bytes()).unwrap()
}

fn after(start: Instant, seconds: u64) -> Instant {
    start + Duration::from_secs(seconds)
}

fn words(signs: &Signs) -> Vec<(&str, &'static str, u64)> {
    let rows = signs.rows();
    rows.map(|(key, row)| (key.instance.as_str(), row.health.as_str(), row.config_revision))
        .collect()
}

#[test]
fn an_acknowledgement_tells_what_runs_and_a_bad_one_is_a_complaint() {
    let (mut signs, now) = (Signs::new(site(Some("robot-1"))), Instant::now());
    let good = json!({
        "service": "slam",
        "instance": "0",
        "revision": 7,
        "hash": "sha256:ab",
        "status": "applied",
    });
    assert_eq!(signs.acked(ack(&good), now), None);
    assert_eq!(words(&signs), [("0", "ready", 7)]);
    assert!(signs.take_changed() && !signs.take_changed());
    assert_eq!(signs.acked(ack(&good), now), None);
    assert!(!signs.take_changed(), "nothing is new");
    let bad = json!({"service": "slam", "instance": "0", "revision": 8, "hash": "sha256:cd",
        "status": "rejected",
        "detail": "x".repeat(500)});
    let complaint = signs.acked(ack(&bad), now).unwrap();
    assert_eq!((complaint.place, complaint.trouble), (place("slam/0@robot-1"), Trouble::Rejected));
    assert_eq!((complaint.revision, complaint.hash.as_deref()), (Some(8), Some("sha256:cd")));
    assert_eq!(complaint.detail.len(), MAX_DETAIL);
    assert_eq!(words(&signs), [("0", "unhealthy", 7)], "it goes on with the configuration before");
    assert!(signs.expire(after(now, 181)).is_empty(), "nobody said that it would say it again");
    assert_eq!(words(&signs), []);
}

#[test]
fn what_another_node_says_is_not_heard_on_the_broker_of_a_node() {
    let (mut signs, now) = (Signs::new(site(Some("robot-2"))), Instant::now());
    let bad = json!({"service": "slam", "instance": "0", "node": "robot-1", "status": "unhealthy"});
    assert_eq!(signs.acked(ack(&bad), now), None);
    assert_eq!(signs.beat(state("0", "unhealthy", 1), now), None);
    assert_eq!(words(&signs), []);
    let mut signs = Signs::new(site(None));
    assert!(
        signs.acked(ack(&bad), now).is_some()
            && signs.beat(state("0", "unhealthy", 1), now).is_some()
    );
    let mut foreign = state("0", "unhealthy", 9);
    foreign.layer = Some("fog".parse().unwrap());
    assert_eq!(signs.beat(foreign, now), None);
}

#[test]
fn a_message_that_does_not_come_again_is_a_lost_watchdog_unless_nobody_could_hear_it() {
    let (mut signs, start) = (Signs::new(site(Some("robot-1"))), Instant::now());
    assert_eq!(signs.beat(state("0", "ready", 1), start), None);
    assert!(signs.expire(after(start, 14)).is_empty());
    signs.deaf(after(start, 14));
    assert!(signs.expire(after(start, 28)).is_empty());
    let lost = signs.expire(after(start, 29));
    assert_eq!(lost.len(), 1);
    assert_eq!((&lost[0].place, lost[0].trouble), (&place("slam/0@robot-1"), Trouble::Lost));
    assert!(signs.expire(after(start, 30)).is_empty(), "it is lost once");
}

#[test]
fn a_record_that_a_whole_look_does_not_find_is_lost_and_an_outage_of_redis_is_not() {
    let (mut signs, start) = (Signs::new(site(Some("robot-1"))), Instant::now());
    let both = || vec![state("0", "ready", 1), state("1", "unhealthy", 1)];
    let troubles = |complaints: Vec<Complaint>| -> Vec<Trouble> {
        complaints.iter().map(|one| one.trouble).collect()
    };
    assert_eq!(troubles(signs.scanned(both(), true, start)), [Trouble::Unhealthy]);
    assert!(signs.scanned(Vec::new(), false, start).is_empty());
    assert_eq!(signs.rows().count(), 2);
    assert_eq!(
        troubles(signs.scanned(both().drain(1..).collect(), true, start)),
        [Trouble::Unhealthy, Trouble::Lost]
    );
    assert_eq!(words(&signs), [("1", "unhealthy", 7)]);
    assert!(signs.expire(after(start, 61)).is_empty());
    assert_eq!(words(&signs), []);
}

#[test]
fn of_two_lives_the_newer_one_counts_and_a_watchdog_more_than_an_acknowledgement() {
    let (mut signs, now) = (Signs::new(site(Some("robot-1"))), Instant::now());
    signs.beat(state("0", "ready", 5), now);
    assert_eq!(signs.beat(state("0", "unhealthy", 4), now), None);
    assert_eq!(words(&signs), [("0", "ready", 7)]);
    let bad = json!({"service": "slam", "instance": "0", "status": "unhealthy"});
    assert!(signs.acked(ack(&bad), now).is_some());
    assert_eq!(words(&signs), [("0", "ready", 7)]);
    assert!(signs.beat(state("0", "unhealthy", 6), now).is_some());
}

#[test]
fn more_instances_than_are_kept_are_counted() {
    let (mut signs, now) = (Signs::new(site(Some("robot-1"))), Instant::now());
    for number in 0..=MAX_SIGNS {
        signs.beat(state(&number.to_string(), "ready", 1), now);
    }
    assert_eq!((signs.rows().count(), signs.left_out()), (MAX_SIGNS, 1));
}
