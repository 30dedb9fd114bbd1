//! Sets that were worked out by hand. Random ones are compared with exact arithmetic in
//! `tests/allocation`.

use super::*;

fn topic(name: &str, size_bytes: u64, advertised_hz: f64) -> Topic<'_> {
    Topic { name, size_bytes, advertised_hz, class: None, lanes: vec![Lane { max_rate_hz: None }] }
}

/// No overhead, so that the numbers stay round.
fn plain() -> Terms {
    Terms { overhead: 1.0, ..Terms::default() }
}

fn rates(budget: f64, terms: &Terms, topics: &[Topic<'_>]) -> Vec<f64> {
    allocate(budget, terms, topics).grants.iter().map(|grant| grant.rate_hz).collect()
}

fn assert_near(got: &[f64], wanted: &[f64]) {
    let near = |(a, b): (&f64, &f64)| (a - b).abs() <= 1e-9 * b.abs().max(1.0);
    assert!(
        got.len() == wanted.len() && got.iter().zip(wanted).all(near),
        "{got:?}, not {wanted:?}"
    );
}

#[test]
fn small_topics_come_first_and_images_share_what_remains_by_demand() {
    // 10 MB/s: the IMU takes 50 kB/s; the larger camera up to β · 10 MB/s less what the floor of
    // the other needs, which gets its floor.
    let topics = [
        topic("camera/front", 1_000_000, 30.0),
        topic("imu", 1_000, 50.0),
        topic("camera/rear", 500_000, 30.0),
    ];
    // Floor of the rear one: 2 · 500 kB = 1 MB/s, so the front one gets min(10 − 0.05 − 1, 9.5)
    // MB/s.
    assert_near(&rates(10e6, &plain(), &topics), &[8.95, 50.0, 2.0]);
}

#[test]
fn no_topic_takes_more_than_its_share() {
    assert_near(&rates(10e6, &plain(), &[topic("camera", 1_000_000, 30.0)]), &[9.5]);
    assert_near(&rates(10e6, &plain(), &[topic("scan", 50_000, 1_000.0)]), &[0.0095e6 / 50.0]);
}

#[test]
fn fair_sharing_gives_equal_bytes_and_what_one_does_not_need_to_the_others() {
    let fair = Terms { sharing: Sharing::Fair, ..plain() };
    let topics =
        [topic("a", 1_000_000, 30.0), topic("b", 500_000, 30.0), topic("c", 100_000, 10.0)];
    // c needs 1 MB/s; a and b get 4.5 MB/s each.
    assert_near(&rates(10e6, &fair, &topics), &[4.5, 9.0, 10.0]);
}

#[test]
fn lanes_are_filled_from_the_slowest() {
    let mut camera = topic("camera", 100_000, 30.0);
    camera.lanes = vec![
        Lane { max_rate_hz: None },
        Lane { max_rate_hz: Some(5.0) },
        Lane { max_rate_hz: Some(60.0) },
    ];
    // 2.5 MB/s are 25 copies a second: 5 for the slow lane, 10 for each of the others.
    let terms = Terms { share: 1.0, ..plain() };
    let got = allocate(2.5e6, &terms, &[camera.clone()]);
    assert_near(&[got.grants[0].rate_hz, got.used_bytes_per_s], &[10.0, 2.5e6]);
    let lanes: Vec<f64> = camera.lanes.iter().map(|lane| got.grants[0].lane_hz(lane)).collect();
    assert_near(&lanes, &[10.0, 5.0, 10.0]);
}

#[test]
fn a_stop_signal_is_not_starved_by_a_large_standard_topic() {
    let topics =
        [topic("points", 60_000, 100.0), topic("stop", 100, 10.0), topic("b", 60_000, 100.0)];
    let got = allocate(1e6, &plain(), &topics);
    assert!(!got.feasible);
    // The smallest first; b before points, because its name is; β caps each.
    assert_near(&[got.grants[1].rate_hz], &[10.0]);
    assert_near(&[got.grants[2].rate_hz], &[0.95e6 / 60_000.0]);
    assert_near(&[got.grants[0].rate_hz], &[(1e6 - 1_000.0 - 0.95e6) / 60_000.0]);
}

#[test]
fn floors_that_exceed_the_budget_are_given_and_reported() {
    let got = allocate(1e6, &plain(), &[topic("a", 1_000_000, 30.0), topic("b", 1_000_000, 1.0)]);
    assert!(!got.feasible);
    assert_near(&[got.grants[0].rate_hz, got.grants[1].rate_hz], &[2.0, 1.0]);
}

#[test]
fn equal_demands_are_served_by_name() {
    let terms = Terms { min_rate_hz: 0.0, ..plain() };
    let got = rates(1e6, &terms, &[topic("b", 100_000, 30.0), topic("a", 100_000, 30.0)]);
    assert_near(&got, &[0.5, 9.5]);
}

#[test]
fn nothing_is_gained_by_numbers_that_are_none() {
    let strange = [f64::NAN, f64::INFINITY, -1.0, 0.0];
    for number in strange {
        for budget in strange.into_iter().chain([1e6]) {
            let terms =
                Terms { overhead: number, share: number, min_rate_hz: number, ..Terms::default() };
            let mut odd = topic("odd", u64::MAX, number);
            odd.lanes.push(Lane { max_rate_hz: Some(number) });
            let got =
                allocate(budget, &terms, &[odd, topic("empty", 0, 10.0), topic("good", 100, 10.0)]);
            assert!(
                got.grants.iter().all(|grant| grant.rate_hz.is_finite() && grant.rate_hz >= 0.0),
                "{number} {budget}: {got:?}"
            );
        }
    }
}

#[test]
fn a_topic_of_no_bytes_costs_nothing() {
    assert_near(&rates(0.0, &plain(), &[topic("empty", 0, 10.0)]), &[10.0]);
}

#[test]
fn a_class_that_was_decided_holds() {
    let mut map = topic("map", 1_000, 10.0);
    map.class = Some(Class::Large);
    assert_eq!(allocate(1e6, &plain(), &[map]).grants[0].class, Class::Large);
}
