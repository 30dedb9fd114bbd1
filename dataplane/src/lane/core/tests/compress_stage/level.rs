//! The level, what it is chosen by, and the size that the allocator reckons with.

use super::*;

const SECOND: Duration = Duration::from_secs(1);
/// Bytes that a frame becomes at levels 1 and 3.
const AT_1: usize = 60_000;
const AT_3: usize = 40_000;

impl Hands {
    fn set(&mut self, rules: CompressionRules) {
        self.bench.core.set_compression(rules);
    }

    fn size(&mut self) -> usize {
        usize::try_from(self.path().sent_size.largest()).unwrap()
    }

    /// Publishes one frame, and compresses it to so many bytes.
    fn compress(&mut self, sequence: u64, after: Option<usize>) {
        self.publish(1, sequence, LARGE);
        self.begin(Urgency::Long);
        self.end_as(0, after, 1);
    }
}

#[test]
fn a_rule_that_changes_makes_the_size_as_sent_anew() {
    let mut hands = Hands::new(vec![lane("cloud/c", true)]);
    hands.compress(1, Some(AT_1));
    hands.compress(2, Some(AT_1 - 1));
    assert_eq!(hands.size(), AT_1);
    hands.bench.core.take_allocation_due();
    hands.set(rules(9, false));
    hands.compress(3, Some(AT_3));
    assert_eq!(hands.size(), AT_3);
    assert!(hands.bench.core.take_allocation_due());
    hands.compress(4, Some(AT_3 - 1));
    assert_eq!(hands.size(), AT_3, "the largest at this level");
    assert!(!hands.bench.core.take_allocation_due());
    // What becomes larger is noted as ever.
    let mut none = rules(9, false);
    none.base.codec = Codec::None;
    hands.set(none);
    assert_eq!(hands.path().level(), 0);
    hands.publish(1, 5, LARGE);
    assert_eq!(hands.size(), LARGE);
    hands.set(rules(9, false));
    hands.compress(6, Some(AT_3));
    assert_eq!(hands.size(), AT_3);
    // The same rule once more changes nothing.
    hands.set(rules(9, false));
    hands.compress(7, Some(AT_3 - 2));
    assert_eq!(hands.size(), AT_3);
}

#[test]
fn what_is_in_hand_while_the_rule_changes_does_not_count_for_the_new_one() {
    let mut hands = Hands::new(vec![lane("cloud/c", true)]);
    hands.publish_all(1, 1..=2, LARGE);
    hands.begin(Urgency::Long);
    hands.set(rules(9, false));
    hands.end_as(0, Some(AT_1), 1);
    hands.compress(3, Some(AT_3));
    // The second was to be compressed at the old level, too.
    assert_eq!(hands.size(), AT_1);
    hands.run();
    hands.compress(4, Some(AT_3));
    assert_eq!(hands.size(), AT_3);
}

#[test]
fn small_messages_of_a_topic_do_not_disturb_the_size() {
    let mut hands = Hands::new(vec![lane("cloud/c", true)]);
    for sequence in 1..=5 {
        hands.compress(2 * sequence, Some(AT_1 - usize::try_from(sequence).unwrap()));
        hands.publish(1, 2 * sequence + 1, 100);
    }
    assert_eq!(hands.size(), AT_1 - 1);
}

/// Frames of so many hertz for so many seconds, each compressed at once.
fn stream(hands: &mut Hands, next: &mut u64, hz: u32, seconds: u32) {
    for frame in 0..hz * seconds {
        *next += 1;
        hands.publish(1, *next, LARGE);
        if hands.long > 0 {
            hands.begin(Urgency::Long);
            match hands.jobs[0].work {
                Work::Compress(1) => hands.end_as(0, Some(AT_1), 30),
                ref work => {
                    assert!(matches!(work, Work::Compress(3)), "{work:?}");
                    hands.end_as(0, Some(AT_3), 200);
                }
            }
        }
        hands.bench.now += SECOND / hz;
        if frame % hz.div_ceil(2) == 0 {
            hands.bench.core.share_pool(hands.bench.now, 2);
        }
    }
}

/// Of two threads one is kept for what is done in a moment, so 10 Hz · 200 ms are too much for
/// level 3.
#[test]
fn the_size_falls_when_the_level_rises_again() {
    let mut hands = Hands::new(vec![lane("cloud/c", false)]);
    hands.set(rules(3, true));
    let mut next = 0;
    assert_eq!(hands.path().level(), 3);
    stream(&mut hands, &mut next, 10, 25);
    assert_eq!(
        (hands.path().level(), hands.size()),
        (1, AT_1),
        "with frames tried at level 3 in between"
    );
    stream(&mut hands, &mut next, 1, 40);
    assert_eq!((hands.path().level(), hands.size()), (3, AT_3));
}

#[test]
fn only_messages_that_are_worth_it_and_pass_some_lane_are_work_for_the_pool() {
    let rate = |hands: &mut Hands| {
        let now = hands.bench.now;
        hands.path().worth_rate.rate(now).0
    };
    let mut thinned = lane("cloud/c", true);
    thinned.lane.max_rate_hz = Some(5.0);
    let mut hands = Hands::new(vec![thinned.clone()]);
    let mut next = 0;
    let mut run = |hands: &mut Hands| {
        for _ in 0..10 * 20 {
            next += 2;
            hands.publish(1, next, LARGE);
            hands.publish(1, next + 1, 100);
            hands.run();
            hands.bench.now += SECOND / 20;
        }
    };
    run(&mut hands);
    let found = rate(&mut hands);
    assert!((found - 5.0).abs() < 1.0, "{found} of 20 Hz, and as many small messages");
    // Two lanes with buckets of their own admit different frames, and each of these is to be
    // compressed.
    let mut faster = lane("fog/f", true);
    faster.lane.max_rate_hz = Some(7.0);
    hands.plan(vec![thinned, faster]);
    run(&mut hands);
    let found = rate(&mut hands);
    assert!((6.0..=12.5).contains(&found), "{found}");
    // Lanes that have ended need nothing.
    hands.plan(Vec::new());
    run(&mut hands);
    assert!(rate(&mut hands).abs() < f64::EPSILON);
}

#[test]
fn what_was_found_out_by_one_rule_is_forgotten_with_it() {
    let mut hands = Hands::new(vec![lane("cloud/c", true)]);
    hands.set(rules(10, true));
    for sequence in 1..=20 {
        hands.compress(sequence, None);
    }
    assert_eq!(hands.path().level(), 0, "it does not become smaller");
    hands.publish(1, 21, LARGE);
    assert_eq!((hands.long, hands.sent().len()), (0, 21));
    let mut other = rules(10, true);
    other.base.min_bytes = 500;
    hands.set(other.clone());
    assert_eq!(hands.path().level(), 10);
    // Without a codec there is no effort that a share of the pool would be kept for.
    other.base.codec = Codec::None;
    hands.set(other);
    hands.publish(1, 22, LARGE);
    assert_eq!((hands.long, hands.path().level()), (0, 0));
}
