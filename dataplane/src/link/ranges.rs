//! A set of numbers kept as ranges, for sequences that mostly arrive in order.

/// Disjoint ranges, ascending, both ends included, never adjacent.
#[derive(Debug, Clone, Default)]
pub(crate) struct RangeSet {
    ranges: Vec<(u64, u64)>,
}

impl RangeSet {
    /// Adds the numbers from `first` to `last`. Returns how many were new.
    pub(crate) fn insert(&mut self, first: u64, last: u64) -> u64 {
        // The ranges that touch or overlap the new one become one.
        let from = self.ranges.partition_point(|range| range.1.saturating_add(1) < first);
        let to = self.ranges.partition_point(|range| range.0 <= last.saturating_add(1));
        let mut joined = (first, last);
        let mut known = 0;
        for range in &self.ranges[from..to] {
            let overlap = (range.0.max(first), range.1.min(last));
            if overlap.0 <= overlap.1 {
                known += overlap.1 - overlap.0 + 1;
            }
            joined = (joined.0.min(range.0), joined.1.max(range.1));
        }
        self.ranges.splice(from..to, [joined]);
        last - first + 1 - known
    }

    pub(crate) fn contains(&self, number: u64) -> bool {
        let at = self.ranges.partition_point(|range| range.1 < number);
        self.ranges.get(at).is_some_and(|range| range.0 <= number)
    }

    /// Forgets the numbers up to `floor`, which is included.
    pub(crate) fn remove_through(&mut self, floor: u64) {
        let gone = self.ranges.partition_point(|range| range.1 <= floor);
        if gone > 0 {
            self.ranges.drain(..gone);
        }
        if let Some(first) = self.ranges.first_mut() {
            first.0 = first.0.max(floor.saturating_add(1));
        }
    }

    pub(crate) fn first(&self) -> Option<(u64, u64)> {
        self.ranges.first().copied()
    }

    /// Number of ranges.
    pub(crate) fn len(&self) -> usize {
        self.ranges.len()
    }

    /// The ranges that are absent above `floor` and below the largest number.
    pub(crate) fn gaps(&self, floor: u64) -> impl Iterator<Item = (u64, u64)> + '_ {
        let mut next = floor.saturating_add(1);
        self.ranges.iter().filter_map(move |&(first, last)| {
            let gap = (next < first).then(|| (next, first - 1));
            next = next.max(last.saturating_add(1));
            gap
        })
    }

    /// Largest number.
    pub(crate) fn last(&self) -> Option<u64> {
        self.ranges.last().map(|range| range.1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    proptest! {
        #[test]
        fn it_is_a_set(steps in proptest::collection::vec((1u64..120, 0u64..9, 0u64..140), 1..60)) {
            let (mut ranges, mut truth, mut floor) = (RangeSet::default(), BTreeSet::new(), 0);
            for (first, more, cut) in steps {
                if cut < 10 && cut > floor {
                    floor = cut;
                    ranges.remove_through(floor);
                    truth = truth.split_off(&(floor + 1));
                }
                let before = truth.len();
                truth.extend(first..=first + more);
                prop_assert_eq!(ranges.insert(first, first + more), (truth.len() - before) as u64);
                for number in 0..140 {
                    prop_assert_eq!(ranges.contains(number), truth.contains(&number));
                }
                prop_assert_eq!(ranges.last(), truth.last().copied());
                let gaps: Vec<u64> = ranges.gaps(0).flat_map(|(from, to)| from..=to).collect();
                let absent: Vec<u64> =
                    (1..*truth.last().unwrap()).filter(|n| !truth.contains(n)).collect();
                prop_assert_eq!(gaps, absent);
                let neighbours = ranges.ranges.windows(2).all(|pair| pair[0].1 + 1 < pair[1].0);
                prop_assert!(neighbours);
            }
        }
    }
}
