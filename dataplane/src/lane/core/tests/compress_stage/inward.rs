//! From the link to the bridges that write to brokers.

use super::*;
use crate::codec::lz4;

/// As another flow sends it.
fn of_fog(writer: u8, sequence: u64, bytes: usize) -> Frame {
    message(["fog", "fog-1", ""], writer, sequence, 0, bytes).with_hops_and_age(1, 0)
}

fn compressed(writer: u8, sequence: u64, bytes: usize) -> Frame {
    let frame = of_fog(writer, sequence, bytes);
    let block = lz4::compress(frame.payload(), 1).unwrap();
    frame.compressed(block, bytes as u64).unwrap()
}

/// A block that announces another size than it has.
fn lying(sequence: u64, block: Bytes, announced: u64) -> Frame {
    of_fog(1, sequence, 10).compressed(block, announced).unwrap()
}

fn into_layer() -> Vec<Bridge> {
    vec![bridge(Scope::Inter, Target::Layer { json: false })]
}

impl Hands {
    fn deliver(&mut self, frame: Frame) {
        self.bench.deliver(frame);
        self.look();
    }

    /// Writer, sequence and size of what was written since the last call.
    fn written(&mut self) -> Vec<(u8, u64, usize)> {
        let frames = std::mem::take(&mut *self.bench.out.frames.lock());
        let told = frames.iter().map(|frame| {
            assert!(!frame.is_compressed());
            (frame.writer().0[0], frame.sequence(), frame.payload().len())
        });
        told.collect()
    }
}

#[test]
fn what_is_decompressed_comes_in_the_order_of_its_writer() {
    let mut hands = Hands::new(into_layer());
    hands.deliver(compressed(1, 1, LARGE));
    hands.deliver(of_fog(1, 2, 10));
    hands.deliver(compressed(1, 3, SMALL));
    hands.deliver(of_fog(2, 1, 20));
    assert_eq!(hands.written(), [(2, 1, 20)], "another writer does not wait");
    assert!(hands.bench.core.has_unwritten());
    assert_eq!((hands.quick, hands.long), (2, 0));
    hands.begin(Urgency::Quick);
    hands.begin(Urgency::Quick);
    hands.bench.now += Duration::from_millis(3);
    hands.end(1);
    assert_eq!(hands.written(), []);
    hands.end(0);
    let aged = hands.bench.out.frames.lock().iter().all(|frame| frame.age_us() == 3_000);
    assert!(aged, "older by what the codec took");
    assert_eq!(hands.written(), [(1, 1, LARGE), (1, 2, 10), (1, 3, SMALL)]);
    assert!(!hands.bench.core.has_unwritten());
    assert_eq!(hands.bench.drops(), []);
}

#[test]
fn what_lies_about_its_size_or_is_damaged_holds_nobody_up() {
    let mut hands = Hands::new(into_layer());
    let block = lz4::compress(&[0; SMALL], 1).unwrap();
    // More than so few bytes can hold: refused at once, and no room is taken for it.
    hands.deliver(lying(1, block.clone(), 16 << 20));
    assert_eq!((hands.quick, hands.bench.drops()), (0, vec![(DropReason::DecompressError, 1)]));
    hands.deliver(lying(2, block.clone(), SMALL as u64 + 1));
    hands.deliver(lying(3, block.clone(), SMALL as u64 - 1));
    hands.deliver(lying(4, Bytes::from(vec![0xff; 100]), 5_000));
    // A bomb within what is allowed, of a sender that says how large it is.
    hands.deliver(compressed(1, 5, 4 << 20));
    hands.deliver(of_fog(1, 6, 10));
    hands.begin(Urgency::Quick);
    hands.end_with(0, Done::Failed);
    hands.run();
    assert_eq!(hands.written(), [(1, 5, 4 << 20), (1, 6, 10)]);
    assert_eq!(hands.bench.drops(), [(DropReason::DecompressError, 4)]);
    // Without a pool the same.
    let mut bench = Bench::new(into_layer());
    for frame in [lying(1, block, SMALL as u64 + 1), compressed(1, 2, SMALL)] {
        bench.deliver(frame);
    }
    assert_eq!(bench.out.frames.lock()[0].payload().len(), SMALL);
    assert_eq!(bench.drops(), [(DropReason::DecompressError, 1)]);
}

#[test]
fn what_nobody_takes_any_more_is_counted() {
    let mut hands = Hands::new(into_layer());
    hands.deliver(compressed(1, 1, LARGE));
    hands.begin(Urgency::Quick);
    hands.plan(Vec::new());
    hands.pass(crate::lane::succession::LONGEST_WAIT);
    assert_eq!(hands.path().bridges[0].phase, Phase::Ended);
    hands.end(0);
    assert_eq!(hands.written(), []);
    assert_eq!(hands.bench.drops(), [(DropReason::NoDestination, 1)]);
}

#[test]
fn where_the_pool_is_behind_who_brings_more_does_it_himself() {
    const MIB: usize = 1 << 20;
    let mut hands = Hands::new(into_layer());
    for sequence in 1..=4 {
        hands.deliver(compressed(1, sequence, 4 * MIB));
    }
    assert_eq!((hands.quick, hands.jobs.len()), (4, 0));
    hands.deliver(compressed(1, 5, 4 * MIB));
    assert_eq!((hands.quick, hands.jobs.len()), (4, 1), "one job is for the caller");
    hands.end(0);
    assert_eq!(hands.written(), [(1, 1, 4 * MIB)], "the one that waits longest");
    hands.run();
    assert_eq!(hands.written().len(), 4);
    // All of it is bounded: 32 MiB of one topic.
    for sequence in 6..=15 {
        hands.deliver(compressed(1, sequence, 4 * MIB));
    }
    assert_eq!(hands.bench.drops(), [(DropReason::QueueFull, 2)]);
    hands.run();
    assert_eq!(hands.written().len(), 8);
}

#[test]
fn without_a_pool_any_more_what_waits_is_dropped_and_the_rest_comes_behind_what_is_begun() {
    let mut hands = Hands::new(into_layer());
    for sequence in 1..=3 {
        hands.deliver(compressed(1, sequence, SMALL));
    }
    hands.begin(Urgency::Quick);
    let Bench { core, link, now, .. } = &mut hands.bench;
    core.stop_compression(*now, link);
    assert_eq!(hands.bench.drops(), [(DropReason::Shutdown, 2)]);
    hands.deliver(compressed(1, 4, SMALL));
    assert_eq!(hands.written(), []);
    hands.end(0);
    assert_eq!(hands.written(), [(1, 1, SMALL), (1, 4, SMALL)]);
}

#[test]
fn quick_turns_are_for_both_directions() {
    let both = vec![lane("cloud/c", true), bridge(Scope::Inter, Target::Layer { json: false })];
    let mut hands = Hands::new(both);
    hands.publish_all(1, 1..=3, SMALL);
    for sequence in 1..=3 {
        hands.deliver(compressed(9, sequence, SMALL));
    }
    assert_eq!((hands.quick, hands.long), (6, 0));
    for _ in 0..6 {
        hands.begin(Urgency::Quick);
    }
    let inward: Vec<bool> =
        hands.jobs.iter().map(|job| matches!(job.work, Work::Decompress(_))).collect();
    assert_eq!(inward, [true, false, true, false, true, false]);
}
