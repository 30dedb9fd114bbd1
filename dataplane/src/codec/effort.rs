//! How hard the payloads of one topic are compressed, so that the pool keeps up.
//!
//! ```text
//! work of a level = frames per second · seconds that a frame takes at it / threads that the topic may use
//!
//!                above 85 % for 1 s                        the next level below 60 % for 5 s
//! configured ───────────────────────► one that fits ───────────────────────────────────────► one step higher
//!      12, 11, 10, 9 … 3, 1, as it is                         (later and later, if it did not last)
//! ```
//!
//! What a frame takes is measured at the level in use, and every ten seconds with one frame at the
//! next higher one. For the others it is what they took, compared with these, when they were last
//! in use, or else what they take as a rule. So a processor that becomes slow, or a picture that
//! becomes difficult, changes all of them.
//!
//! A stream that does not become smaller goes as it is, and one frame in ten seconds is tried.
//! Pure: time is given.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use super::lz4::HIGHEST_LEVEL;

#[cfg(test)]
mod tests;

/// Levels, and what a frame takes at each of them as a rule compared with the first one; measured
/// on camera frames. Level 2 is missing because it is level 1.
const STEPS: [(u8, f64); STEP_COUNT] = [
    (1, 1.0),
    (3, 7.0),
    (4, 7.5),
    (5, 8.0),
    (6, 8.5),
    (7, 9.0),
    (8, 9.5),
    (9, 10.0),
    (10, 16.0),
    (11, 17.0),
    (12, 20.0),
];
const STEP_COUNT: usize = 11;
/// More work than this part of the pool is too much …
const TOO_MUCH: f64 = 0.85;
/// … after so long.
const LOWER_AFTER: Duration = Duration::from_secs(1);
/// A lower level is one with this work at most. Between it and [`RAISE_BELOW`] nothing changes, so
/// that an error of estimation does not make it go to and fro.
const LOWER_TO: f64 = 0.75;
/// A step higher is taken if it makes less work than this …
const RAISE_BELOW: f64 = 0.6;
/// … for so long.
const RAISE_AFTER: Duration = Duration::from_secs(5);
/// A step that is taken back within this time has not lasted …
const LASTS: Duration = Duration::from_secs(60);
/// … and is not tried again for this, which doubles each time …
const RETRY_AFTER: Duration = Duration::from_secs(60);
/// … so often: 16 minutes.
const MAX_DOUBLINGS: u32 = 4;
/// Frames at a new level that say what it takes compared with the others; later ones say how fast
/// all of them are.
const LEARNING: u32 = 10;
/// A level takes this many times what it takes as a rule at most, and not less than its inverse:
/// else not the level is another, but the processor.
const UNUSUAL: f64 = 4.0;
/// Frames whose median is believed: of a few the thread may have been without a processor.
const RECENT: usize = 9;
/// What one frame more changes the estimate by …
const SMOOTHING: f64 = 0.2;
/// … and one that was tried.
const SMOOTHING_OF_TRIALS: f64 = 0.5;
/// How long a change of the rate takes to be believed, in seconds.
const RATE_SECONDS: f64 = 2.0;
/// Frames whose sizes are looked at …
const RATIO_FRAMES: usize = 20;
/// … and are not worth it if they stay larger than this part.
const WORTHWHILE: f64 = 0.97;
/// How often a frame is tried, at the next level or where the others go as they are.
const TRY_EVERY: Duration = Duration::from_secs(10);

/// The level of one topic.
#[derive(Debug, Clone)]
pub struct Effort {
    /// Steps that may be taken: up to the configured level.
    top: usize,
    /// How many of [`STEPS`] are taken: the level is that of the last one; 0: as it is.
    step: usize,
    threads: f64,
    rate_hz: f64,
    rate_at: Option<Instant>,
    /// What a frame takes at each step, in units of `unit`.
    weights: [f64; STEP_COUNT],
    /// Seconds of one weight; absent until a frame has been compressed.
    unit: Option<f64>,
    /// What the last frames took at this step, oldest first.
    recent: VecDeque<f64>,
    /// Frames at this step that are yet to be learned from.
    learning: u32,
    too_much_since: Option<Instant>,
    fits_since: Option<Instant>,
    /// The last step upwards, until it has lasted.
    raised: Option<(Instant, usize)>,
    /// For each step, when it may be tried again, and how often in a row it did not last.
    retry: [(Option<Instant>, u32); STEP_COUNT],
    /// Sizes before and after of the last frames.
    ratios: VecDeque<(usize, usize)>,
    incompressible: bool,
    try_at: Instant,
    changes: u64,
}

impl Effort {
    /// Begins at the configured level, 1 to 12; others count as the nearest one. The topic may use
    /// one thread until [`Effort::set_threads`] says otherwise.
    #[must_use]
    pub fn new(configured: u8, now: Instant) -> Self {
        let top = STEPS.iter().filter(|(level, _)| *level <= configured.max(1)).count();
        Self {
            top,
            step: top,
            threads: 1.0,
            rate_hz: 0.0,
            rate_at: None,
            weights: STEPS.map(|(_, weight)| weight),
            unit: None,
            recent: VecDeque::with_capacity(RECENT),
            learning: 0,
            too_much_since: None,
            fits_since: None,
            raised: None,
            retry: [(None, 0); STEP_COUNT],
            ratios: VecDeque::with_capacity(RATIO_FRAMES),
            incompressible: false,
            try_at: now,
            changes: 0,
        }
    }

    /// Changes which part of the pool the topic may use, in threads, see [`shares`].
    pub fn set_threads(&mut self, threads: f64) {
        self.threads = sensible(threads).max(1e-3);
    }

    /// The level in use; `None`: frames go as they are, but for those that are tried.
    #[must_use]
    pub fn level(&self) -> Option<u8> {
        (!self.goes_as_it_is()).then(|| self.level_of(self.step))
    }

    /// Whether frames go as they are, because the pool has no time for them or because they do not
    /// become smaller.
    #[must_use]
    pub fn goes_as_it_is(&self) -> bool {
        self.step == 0 || self.incompressible
    }

    /// How often the level has changed.
    #[must_use]
    pub fn changes(&self) -> u64 {
        self.changes
    }

    /// Threads that would be busy all the time at the configured level; 0 until that is known, and
    /// while the stream does not become smaller.
    #[must_use]
    pub fn wanted(&self) -> f64 {
        let top = if self.incompressible { 0 } else { self.top };
        self.work(top) * self.threads
    }

    /// The level for the next frame; `None`: it goes as it is. To be called once per frame: a trial
    /// is handed out once.
    pub fn next(&mut self, now: Instant) -> Option<u8> {
        let usual = self.level();
        let is_highest = usual.is_some() && self.step == self.top;
        if is_highest || now < self.try_at || self.too_much_since.is_some() {
            return usual;
        }
        self.try_at = now + TRY_EVERY;
        // What may be too small a difference at this level is tried at no other.
        let tried = if self.incompressible { self.step } else { self.step + 1 };
        Some(self.level_of(tried))
    }

    /// So many frames per second are admitted, whether or not the pool has got to them. To be
    /// called every second or more often.
    pub fn demand(&mut self, now: Instant, rate_hz: f64) {
        let rate_hz = sensible(rate_hz);
        if let Some(before) = self.rate_at {
            let passed = now.saturating_duration_since(before).as_secs_f64();
            self.rate_hz += (rate_hz - self.rate_hz) * (1.0 - (-passed / RATE_SECONDS).exp());
        } else {
            self.rate_hz = rate_hz;
        }
        self.rate_at = Some(now);
        self.weigh(now);
    }

    /// A frame was compressed at a level: seconds that a thread of the pool was taken, bytes of the
    /// payload as it was and as it goes.
    pub fn compressed(
        &mut self,
        now: Instant,
        level: u8,
        seconds: f64,
        before: usize,
        after: usize,
    ) {
        if before == 0 {
            return;
        }
        self.look_at_size(now, before, after);
        // Where nothing is found LZ4 takes another time, and that is not what it would take.
        if !self.incompressible {
            let step =
                STEPS.iter().filter(|(step, _)| *step <= level.clamp(1, HIGHEST_LEVEL)).count();
            self.learn(step, sensible(seconds).max(1e-9));
        }
        self.weigh(now);
    }

    fn level_of(&self, step: usize) -> u8 {
        STEPS[step.clamp(1, STEP_COUNT) - 1].0
    }

    /// The part of its threads that the topic would take at a step.
    fn work(&self, step: usize) -> f64 {
        match step.checked_sub(1) {
            Some(at) => self.rate_hz * self.weights[at] * self.unit.unwrap_or(0.0) / self.threads,
            None => 0.0,
        }
    }

    fn look_at_size(&mut self, now: Instant, before: usize, after: usize) {
        if self.incompressible {
            if after as f64 <= before as f64 * WORTHWHILE {
                self.incompressible = false;
                self.ratios.clear();
                self.changes += 1;
            }
            return;
        }
        if self.ratios.len() == RATIO_FRAMES {
            self.ratios.pop_front();
        }
        self.ratios.push_back((before, after));
        let sums =
            self.ratios.iter().fold((0.0, 0.0), |(all_before, all_after), (before, after)| {
                (all_before + *before as f64, all_after + *after as f64)
            });
        if self.ratios.len() == RATIO_FRAMES && sums.1 > sums.0 * WORTHWHILE {
            self.incompressible = true;
            self.try_at = now + TRY_EVERY;
            (self.too_much_since, self.fits_since) = (None, None);
            self.changes += 1;
        }
    }

    /// Takes what a frame took at a step.
    fn learn(&mut self, step: usize, seconds: f64) {
        let (_, usual) = STEPS[step - 1];
        let bounded = |weight: f64| weight.clamp(usual / UNUSUAL, usual * UNUSUAL);
        let weight = &mut self.weights[step - 1];
        match &mut self.unit {
            None => self.unit = Some(seconds / *weight),
            // As it is there is nothing else to learn from.
            Some(unit) if self.step == 0 && step == 1 => *unit = seconds / *weight,
            Some(unit) if step == self.step + 1 => {
                *weight += (bounded(seconds / *unit) - *weight) * SMOOTHING_OF_TRIALS;
            }
            Some(unit) if step == self.step => {
                if self.recent.len() == RECENT {
                    self.recent.pop_front();
                }
                self.recent.push_back(seconds);
                let median = median(&self.recent);
                if self.learning > 0 {
                    // How this step compares with the others.
                    self.learning -= 1;
                    *weight = bounded(median / *unit);
                } else {
                    *unit += (median / *weight - *unit) * SMOOTHING;
                }
            }
            // It was begun before the level changed.
            Some(_) => {}
        }
    }

    /// Whether another level is due.
    fn weigh(&mut self, now: Instant) {
        if self.incompressible || self.unit.is_none() {
            return;
        }
        if let Some((at, step)) = self.raised
            && now.saturating_duration_since(at) > LASTS
        {
            self.raised = None;
            self.retry[step - 1].1 = 0;
        }
        if self.work(self.step) > TOO_MUCH {
            self.fits_since = None;
            let since = *self.too_much_since.get_or_insert(now);
            if now.saturating_duration_since(since) >= LOWER_AFTER {
                self.lower(now);
            }
            return;
        }
        self.too_much_since = None;
        let may_rise = self.step < self.top
            && self.work(self.step + 1) < RAISE_BELOW
            && self.retry[self.step].0.is_none_or(|retry| retry <= now);
        if !may_rise {
            self.fits_since = None;
            return;
        }
        let since = *self.fits_since.get_or_insert(now);
        if now.saturating_duration_since(since) >= RAISE_AFTER {
            self.change(self.step + 1);
            self.raised = Some((now, self.step));
        }
    }

    /// To the highest step that fits, at once: a second at each of those between would be lost
    /// frames.
    fn lower(&mut self, now: Instant) {
        if let Some((_, step)) = self.raised.take() {
            let (at, times) = &mut self.retry[step - 1];
            *at = Some(now + RETRY_AFTER * 2_u32.pow((*times).min(MAX_DOUBLINGS)));
            *times += 1;
        }
        let fits = (1..self.step).rev().find(|step| {
            // Below the first one there is only to give it up.
            self.work(*step) <= if *step == 1 { TOO_MUCH } else { LOWER_TO }
        });
        self.change(fits.unwrap_or(0));
        self.try_at = now + TRY_EVERY;
    }

    fn change(&mut self, step: usize) {
        self.step = step;
        // The others are compared with the first one.
        self.learning = if step > 1 { LEARNING } else { 0 };
        self.recent.clear();
        (self.too_much_since, self.fits_since) = (None, None);
        self.changes += 1;
    }
}

/// What is no number, or none that can be meant, as one that can.
fn sensible(value: f64) -> f64 {
    if value.is_nan() { 0.0 } else { value.clamp(0.0, 1e9) }
}

fn median(values: &VecDeque<f64>) -> f64 {
    let mut sorted: Vec<f64> = values.iter().copied().collect();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(0.0)
}

/// Divides the threads of a pool among its topics, by what each of them wants, see
/// [`Effort::wanted`]: who wants little gets it, with room enough to stay at its level; what is too
/// much for the pool is divided evenly among those that want more; what is left over goes to all.
#[must_use]
pub fn shares(threads: f64, wanted: &[f64]) -> Vec<f64> {
    let threads = sensible(threads);
    let even = threads / wanted.len().max(1) as f64;
    // One that is not known yet shall not seem to overload a share of nothing.
    let needs: Vec<f64> = wanted
        .iter()
        .map(|wanted| (sensible(*wanted) / (RAISE_BELOW * 0.9)).max(even * 0.1))
        .collect();
    let mut order: Vec<usize> = (0..needs.len()).collect();
    order.sort_by(|one, other| needs[*one].total_cmp(&needs[*other]));
    let mut shares = vec![0.0; needs.len()];
    let mut left = threads;
    for (done, at) in order.into_iter().enumerate() {
        shares[at] = needs[at].min(left / (needs.len() - done) as f64);
        left -= shares[at];
    }
    shares.iter_mut().for_each(|share| *share += left.max(0.0) / needs.len() as f64);
    shares
}
