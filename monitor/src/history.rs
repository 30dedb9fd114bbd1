//! The last hour of each series, in memory, for pictures. Prometheus keeps what is older.

use std::collections::{BTreeMap, VecDeque};
use std::time::SystemTime;

use blaze_domain::control::rfc3339_millis;
use serde_json::{Map, Value, json};

use crate::limits::{HISTORY_SERIES, HISTORY_STEP, HISTORY_VALUES};

/// The last hour. Values are kept with seven digits.
#[derive(Debug, Default)]
pub struct History {
    /// By name with labels, as in Prometheus' text.
    series: BTreeMap<String, VecDeque<f32>>,
    /// How many values each has.
    times: usize,
    /// When the newest were taken, in milliseconds since 1970.
    newest_ms: Option<u64>,
    refused: u64,
}

impl History {
    /// Takes the values of now. A series without one has a gap; one without any for an hour goes.
    pub fn take(&mut self, at: SystemTime, values: impl IntoIterator<Item = (String, f64)>) {
        let is_full = self.times == HISTORY_VALUES;
        let before = if is_full { self.times - 1 } else { self.times };
        for ring in self.series.values_mut() {
            if is_full {
                ring.pop_front();
            }
            ring.push_back(f32::NAN);
        }
        self.times = before + 1;
        self.newest_ms = Some(millis(at));
        for (name, value) in values {
            if let Some(ring) = self.series.get_mut(&name) {
                if let Some(last) = ring.back_mut() {
                    *last = value as f32;
                }
            } else if self.series.len() < HISTORY_SERIES {
                let mut ring = VecDeque::with_capacity(HISTORY_VALUES);
                ring.extend(std::iter::repeat_n(f32::NAN, before));
                ring.push_back(value as f32);
                self.series.insert(name, ring);
            } else {
                self.refused += 1;
            }
        }
        self.series.retain(|_, ring| ring.iter().any(|value| !value.is_nan()));
    }

    /// Values that had no room, because there were too many series.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// `start`, `step_s` and `series` of `/v1/series`. `names` are those of metrics, or of series
    /// with their labels, with commas between; empty: all.
    #[must_use]
    pub fn body(&self, names: &str) -> Value {
        let asked: Vec<&str> = split_names(names);
        let is_asked = |series: &str| {
            let metric = series.split('{').next().unwrap_or(series);
            asked.is_empty() || asked.iter().any(|name| *name == series || *name == metric)
        };
        let series: Map<String, Value> = self
            .series
            .iter()
            .filter(|(name, _)| is_asked(name))
            .map(|(name, ring)| (name.clone(), ring.iter().map(|value| shown(*value)).collect()))
            .collect();
        // The newest value is the one whose time counts: a clock that stepped, or a machine that
        // slept, moves the others.
        let before = HISTORY_STEP.as_millis() as u64 * (self.times.saturating_sub(1)) as u64;
        let start = self.newest_ms.map(|newest| rfc3339_millis(newest.saturating_sub(before)));
        json!({"start": start, "step_s": HISTORY_STEP.as_secs(), "series": series})
    }
}

/// Commas within braces belong to the labels.
fn split_names(names: &str) -> Vec<&str> {
    let mut is_within = false;
    names
        .split(|c: char| {
            match c {
                '{' => is_within = true,
                '}' => is_within = false,
                _ => {}
            }
            c == ',' && !is_within
        })
        .map(str::trim)
        .filter(|name| !name.is_empty())
        .collect()
}

/// The shortest decimal number that is this value; `null` for a gap.
fn shown(value: f32) -> Value {
    if !value.is_finite() {
        return Value::Null;
    }
    value.to_string().parse::<f64>().map_or(Value::Null, |value| json!(value))
}

fn millis(at: SystemTime) -> u64 {
    let since = at.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn at(slot: u64) -> SystemTime {
        SystemTime::UNIX_EPOCH + Duration::from_secs(1_767_225_600) + HISTORY_STEP * slot as u32
    }

    #[test]
    fn a_series_has_gaps_where_it_had_no_value() {
        let mut history = History::default();
        history.take(at(0), [("a".to_owned(), 1.5)]);
        history.take(at(1), [("b{x=\"1,2\"}".to_owned(), 0.1)]);
        history.take(at(2), [("a".to_owned(), 3.0), ("b{x=\"1,2\"}".to_owned(), 7.0)]);
        assert_eq!(
            history.body(""),
            json!({"start": "2026-01-01T00:00:00.000Z", "step_s": 10, "series": {
                "a": [1.5, null, 3.0], "b{x=\"1,2\"}": [null, 0.1, 7.0],
            }})
        );
        let names = |asked: &str| {
            let body = history.body(asked);
            body["series"].as_object().unwrap().keys().cloned().collect::<Vec<_>>()
        };
        assert_eq!(names("b"), ["b{x=\"1,2\"}"]);
        assert_eq!(names("c, b{x=\"1,2\"},a"), ["a", "b{x=\"1,2\"}"]);
    }

    #[test]
    fn an_hour_is_kept_and_what_had_no_value_for_an_hour_goes() {
        let mut history = History::default();
        history.take(at(0), [("old".to_owned(), 1.0)]);
        for slot in 1..=HISTORY_VALUES as u64 {
            history.take(at(slot), [("a".to_owned(), slot as f64)]);
        }
        let body = history.body("");
        assert_eq!(body["start"], "2026-01-01T00:00:10.000Z");
        assert_eq!(body["series"].as_object().unwrap().len(), 1);
        let values = body["series"]["a"].as_array().unwrap();
        assert_eq!((values.len(), &values[359]), (HISTORY_VALUES, &json!(360.0)));
    }

    #[test]
    fn the_number_of_series_is_bounded_and_what_has_no_room_is_counted() {
        let mut history = History::default();
        let values = (0..HISTORY_SERIES + 3).map(|i| (format!("s{i}"), 1.0));
        history.take(at(0), values);
        assert_eq!((history.series.len(), history.refused()), (HISTORY_SERIES, 3));
        assert!(HISTORY_SERIES * HISTORY_VALUES * size_of::<f32>() < 2 * 1024 * 1024);
    }
}
