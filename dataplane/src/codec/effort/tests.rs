//! The level over time, in worlds that are known.

use super::*;
use crate::testing::Random;

const MS: f64 = 1e-3;
const FRAME_BYTES: usize = 921_600;

/// Milliseconds per frame of 640×480 RGB at the levels of [`STEPS`].
type Costs = [f64; STEP_COUNT];
/// A slow processor: the figures for 1, 9 and 10 were measured, those between follow from them.
const SLOW: Costs = [5.0, 35.0, 39.0, 43.0, 47.0, 50.0, 53.0, 57.0, 94.0, 100.0, 120.0];
/// Measured with the recording.
const RECORDING: Costs = [1.7, 13.6, 15.1, 16.4, 17.1, 17.7, 18.2, 18.6, 26.5, 26.9, 32.9];
/// Not as it is as a rule.
const STRANGE: Costs = [5.0, 10.0, 15.0, 25.0, 40.0, 60.0, 80.0, 100.0, 110.0, 130.0, 200.0];

struct World {
    start: Instant,
    now: Instant,
    costs: Costs,
    threads: f64,
    rate_hz: f64,
    /// Each frame takes up to this part more or less.
    jitter: f64,
    /// All costs, times this.
    slowness: f64,
    ratio: f64,
    noise: Random,
    effort: Effort,
    backlog: f64,
    frames: u64,
    /// When the level changed, in seconds, and to which; 0: as it is.
    changes: Vec<(f64, u8)>,
    tried: usize,
}

impl World {
    fn new(configured: u8, costs: Costs, threads: f64, rate_hz: f64) -> Self {
        let start = Instant::now();
        let mut effort = Effort::new(configured, start);
        effort.set_threads(threads);
        Self {
            start,
            now: start,
            costs,
            threads,
            rate_hz,
            jitter: 0.2,
            slowness: 1.0,
            ratio: 0.6,
            noise: Random(7),
            effort,
            backlog: 0.0,
            frames: 0,
            changes: Vec::new(),
            tried: 0,
        }
    }

    fn seconds(&self) -> f64 {
        (self.now - self.start).as_secs_f64()
    }

    fn level(&self) -> u8 {
        self.effort.level().unwrap_or(0)
    }

    /// From -1 to 1.
    fn draw(&mut self) -> f64 {
        (self.noise.next() >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    fn frame(&mut self) {
        let step = 1.0 / self.rate_hz;
        self.now += Duration::from_secs_f64(step);
        self.backlog = (self.backlog - step).max(0.0);
        self.frames += 1;
        if self.frames.is_multiple_of(self.rate_hz.ceil() as u64) {
            let counted = self.rate_hz + self.draw();
            self.effort.demand(self.now, counted);
        }
        let Some(level) = self.effort.next(self.now) else {
            return;
        };
        self.tried += 1;
        // What waits too long gives way to newer frames, and says nothing.
        if self.backlog > 0.3 {
            return;
        }
        let at = STEPS.iter().position(|(step, _)| *step == level).unwrap();
        let seconds = self.costs[at] * MS * self.slowness * (1.0 + self.jitter * self.draw());
        self.backlog += seconds / self.threads;
        let after = (FRAME_BYTES as f64 * self.ratio) as usize;
        self.effort.compressed(self.now, level, seconds, FRAME_BYTES, after);
    }

    fn run(&mut self, seconds: f64) -> &mut Self {
        let until = self.seconds() + seconds;
        while self.seconds() < until {
            let before = self.level();
            self.frame();
            if self.level() != before {
                self.changes.push((self.seconds(), self.level()));
            }
        }
        self
    }

    /// The part of its threads that a level takes.
    fn work(&self, step: usize) -> f64 {
        step.checked_sub(1)
            .map_or(0.0, |at| self.rate_hz * self.costs[at] * MS * self.slowness / self.threads)
    }

    /// Most changes in any minute that begins at this second or later.
    fn changes_a_minute(&self, from: f64) -> usize {
        let late = || self.changes.iter().filter(|change| change.0 >= from);
        let minutes = late().map(|first| {
            late().filter(|other| (first.0..first.0 + 60.0).contains(&other.0)).count()
        });
        minutes.max().unwrap_or(0)
    }
}

#[test]
fn a_steady_world_gets_the_highest_level_that_fits_and_keeps_it() {
    for (name, costs) in [("slow", SLOW), ("recording", RECORDING), ("strange", STRANGE)] {
        for threads in 1..=8 {
            for rate_hz in [10.0, 15.0, 20.0, 30.0, 45.0, 60.0] {
                for (configured, jitter) in [(10, 0.0), (10, 0.3), (12, 0.3), (3, 0.3), (1, 0.3)] {
                    let mut world = World::new(configured, costs, threads.into(), rate_hz);
                    world.jitter = jitter;
                    world.run(400.0);
                    let at = format!(
                        "{name}, {threads} threads, {rate_hz} Hz, configured {configured}: {:?}",
                        world.changes
                    );
                    let step = world.effort.step;
                    assert!(world.work(step) < 0.9, "too much work, {at}");
                    let is_top = step == world.effort.top;
                    assert!(is_top || world.work(step + 1) > 0.5, "one more would fit, {at}");
                    assert!(world.changes_a_minute(60.0) <= 2, "restless, {at}");
                    assert!(
                        world.changes.iter().filter(|change| change.0 > 120.0).count() <= 3,
                        "restless, {at}"
                    );
                    // Too much work does not last.
                    let first = world.changes.first().map_or(f64::INFINITY, |change| change.0);
                    assert!(
                        world.work(world.effort.top) < 1.0 || first < 5.0,
                        "slow to react, {at}"
                    );
                }
            }
        }
    }
}

#[test]
fn topics_share_a_pool_and_come_to_rest() {
    let threads = 2.0;
    let mut worlds: Vec<World> = [(10.0, SLOW), (30.0, SLOW), (60.0, RECORDING), (2.0, SLOW)]
        .map(|(hz, costs)| World::new(10, costs, 0.5, hz))
        .into();
    for _ in 0..400 {
        let wanted: Vec<f64> = worlds.iter().map(|world| world.effort.wanted()).collect();
        for (world, share) in worlds.iter_mut().zip(shares(threads, &wanted)) {
            world.threads = share;
            world.effort.set_threads(share);
            world.run(1.0);
        }
    }
    let busy: f64 = worlds.iter().map(|world| world.work(world.effort.step) * world.threads).sum();
    let levels: Vec<u8> = worlds.iter().map(World::level).collect();
    assert!(busy > 0.8 && busy < 1.8, "{busy} of {threads} threads, {levels:?}");
    assert!(levels[0] >= 3 && levels[3] == 10, "two images a second are no burden: {levels:?}");
    for world in &worlds {
        assert!(world.changes_a_minute(60.0) <= 2, "{:?}", world.changes);
    }
}

#[test]
fn level_two_is_level_one_and_others_count_as_the_nearest() {
    let at = |configured| Effort::new(configured, Instant::now()).level();
    assert_eq!(
        [at(0), at(1), at(2), at(3), at(12), at(200)].map(Option::unwrap),
        [1, 1, 1, 3, 12, 12]
    );
}

#[test]
fn it_comes_back_when_there_are_fewer_frames_and_goes_when_there_are_more() {
    let mut world = World::new(10, SLOW, 1.0, 5.0);
    assert_eq!(world.run(60.0).level(), 10);
    world.rate_hz = 30.0;
    assert_eq!(world.run(5.0).level(), 1, "{:?}", world.changes);
    world.rate_hz = 5.0;
    world.run(20.0);
    assert!((3..9).contains(&world.level()), "a step at a time, {:?}", world.changes);
    assert_eq!(world.run(60.0).level(), 10, "{:?}", world.changes);
}

#[test]
fn a_processor_that_was_slow_is_not_slow_for_ever() {
    let mut world = World::new(10, RECORDING, 1.0, 15.0);
    assert_eq!(world.run(60.0).level(), 10, "{:?}", world.changes);
    world.slowness = 5.0;
    assert!(world.run(20.0).level() <= 3, "{:?}", world.changes);
    world.slowness = 1.0;
    assert_eq!(world.run(120.0).level(), 10, "{:?}", world.changes);
    // So slow that nothing is compressed: one frame in ten seconds says when that has passed.
    world.slowness = 150.0;
    assert_eq!(world.run(100.0).level(), 0, "{:?}", world.changes);
    let tried = world.tried;
    world.run(100.0);
    assert!((9..=11).contains(&(world.tried - tried)), "{}", world.tried - tried);
    world.slowness = 1.0;
    assert_eq!(world.run(200.0).level(), 10, "{:?}", world.changes);
}

#[test]
fn a_step_that_does_not_last_is_tried_later_and_later() {
    // The larger frames of a lower level leave fewer for the pool: as soon as it is raised there
    // are more again.
    let mut world = World::new(1, [30.0; STEP_COUNT], 1.0, 60.0);
    let until = 3_600.0;
    while world.seconds() < until {
        world.rate_hz = if world.level() == 0 { 15.0 } else { 60.0 };
        world.run(1.0);
    }
    let count = |from: f64, to: f64| {
        world.changes.iter().filter(|change| (from..to).contains(&change.0)).count()
    };
    assert!(world.changes_a_minute(0.0) <= 4, "{:?}", world.changes);
    assert!(count(600.0, 1_200.0) <= 4 && count(1_800.0, 3_600.0) <= 6, "{:?}", world.changes);
    assert!(count(1_800.0, 3_600.0) >= 2, "it is not given up");
}

#[test]
fn one_slow_frame_changes_nothing() {
    let mut world = World::new(10, RECORDING, 1.0, 20.0);
    world.run(30.0);
    for _ in 0..20 {
        world.effort.compressed(world.now, 10, 2.0, FRAME_BYTES, FRAME_BYTES / 2);
        world.run(5.0);
    }
    assert!(world.changes.is_empty(), "{:?}", world.changes);
}

#[test]
fn what_does_not_become_smaller_goes_as_it_is_and_is_tried_again() {
    let mut world = World::new(10, RECORDING, 2.0, 30.0);
    world.ratio = 0.98;
    world.run(1.0);
    assert!(world.effort.incompressible && world.effort.goes_as_it_is());
    assert!(world.effort.wanted().abs() < 1e-9, "others may have its part of the pool");
    assert_eq!(world.tried, 20);
    world.run(100.0);
    assert_eq!(world.tried, 20 + 10, "one frame in ten seconds");
    assert_eq!(world.changes.len(), 1);
    world.ratio = 0.9;
    world.run(11.0);
    assert_eq!(world.level(), 10);
    world.run(60.0);
    assert_eq!(world.changes.len(), 2, "{:?}", world.changes);
}

#[test]
fn strange_figures_do_no_harm() {
    let now = Instant::now();
    let mut effort = Effort::new(10, now);
    for value in [f64::NAN, f64::INFINITY, -1.0, 0.0, f64::MIN_POSITIVE, f64::MAX] {
        for level in [0, 1, 2, 10, 12, 255] {
            effort.set_threads(value);
            effort.demand(now, value);
            effort.compressed(now, level, value, 0, 10);
            effort.compressed(now, level, value, 10, 10);
            effort.compressed(now, level, value, usize::MAX, usize::MAX);
        }
        let _ = effort.next(now);
        assert!(effort.wanted() >= 0.0, "{value}");
    }
}

#[test]
fn a_pool_is_divided_by_what_is_wanted() {
    let near = |found: &[f64], expected: &[f64]| {
        let fits = found.len() == expected.len()
            && found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 0.02);
        assert!(fits, "{found:?} instead of {expected:?}");
    };
    near(&shares(4.0, &[]), &[]);
    near(&shares(4.0, &[9.0]), &[4.0]);
    near(&shares(4.0, &[0.0, 0.0]), &[2.0, 2.0]);
    // Little is given with room to spare, the rest is divided evenly.
    near(&shares(2.0, &[0.27, 5.0, 9.0]), &[0.5, 0.75, 0.75]);
    let roomy = shares(8.0, &[0.5, 1.5]);
    assert!(
        roomy[0] > 0.9 && roomy[1] > 2.7 && (roomy.iter().sum::<f64>() - 8.0).abs() < 1e-9,
        "{roomy:?}"
    );
    for wanted in [[0.0, 1.0, 7.0], [f64::NAN, 1.0, f64::INFINITY]] {
        let shares = shares(2.0, &wanted);
        assert!(
            (shares.iter().sum::<f64>() - 2.0).abs() < 1e-9
                && shares.iter().all(|share| *share > 0.0),
            "{shares:?}"
        );
    }
}
