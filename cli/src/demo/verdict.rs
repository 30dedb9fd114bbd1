//! Whether the demo showed what it should, and what was wrong in words.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Serialize;

use super::board::{Move, TopicRow};
use super::changes::{Change, ChangePlan, Changes, PICTURES};
use super::options::DemoNode;
use super::roles::{MOVES_FROM, MOVES_TO, MOVING_SERVICE, PUBLISHING_NODE};

/// The cloud must have its first message within this time after the start.
const FIRST_MESSAGE: Duration = Duration::from_secs(10);
/// A consumer whose last message is older than this when the last one is published has stalled.
const STALLED: Duration = Duration::from_secs(3);

/// The end of the demo; the last line of `-o json`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Whether everything was as it should be.
    pub ok: bool,
    /// How long messages were played, in seconds.
    pub duration_s: f64,
    /// Seconds from the start of the process to the first message, for each layer.
    pub first_message_s: BTreeMap<&'static str, f64>,
    /// Consumers that went from one node to another.
    pub moves: Vec<Move>,
    /// Changes of the configuration that were made, and what they did.
    pub changes: Vec<Change>,
    /// Each topic on its way to each consumer.
    pub topics: Vec<TopicRow>,
    /// What was not as it should be, for people.
    pub problems: Vec<String>,
}

/// What is known at the end.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// Nodes of this process.
    pub nodes: Vec<DemoNode>,
    /// How long messages were played.
    pub duration: Duration,
    /// Stopped by the user before its time.
    pub interrupted: bool,
    /// What went wrong beside the messages, for example a consumer that could not be started.
    pub faults: Vec<String>,
    /// As on the board.
    pub first_message_s: BTreeMap<&'static str, f64>,
    /// As on the board.
    pub moved: Option<Move>,
    /// As on the board.
    pub topics: Vec<TopicRow>,
    /// Which changes of the configuration were to be made.
    pub plan: Option<ChangePlan>,
    /// Which were.
    pub changes: Changes,
}

/// Judges the outcome.
#[must_use]
pub fn judge(outcome: Outcome) -> Summary {
    let mut problems = outcome.faults.clone();
    let complete = DemoNode::ALL.iter().all(|node| outcome.nodes.contains(node));
    for row in &outcome.topics {
        judge_row(row, complete, &mut problems);
    }
    if outcome.nodes.contains(&PUBLISHING_NODE)
        && outcome.topics.iter().all(|row| row.sent == Some(0))
    {
        problems.push("nothing was published".to_owned());
    }
    // Of what speaks rarely nothing may be due for so long.
    let is_often = outcome.topics.iter().any(|row| row.rate_in_hz.is_some_and(|rate| rate >= 1.0));
    if complete {
        match outcome.first_message_s.get("cloud") {
            Some(seconds) if *seconds > FIRST_MESSAGE.as_secs_f64() && is_often => {
                problems.push(format!(
                    "the first message came to the cloud after {seconds:.1} s, {} s are allowed",
                    FIRST_MESSAGE.as_secs()
                ));
            }
            _ => {}
        }
    }
    let both_here = [MOVES_FROM, MOVES_TO].iter().all(|node| outcome.nodes.contains(node));
    let joins = |row: &&TopicRow| {
        row.service == Some(MOVING_SERVICE) && row.to.as_deref() == Some(MOVES_TO.flow().as_str())
    };
    let is_due = outcome.topics.iter().find(joins).is_none_or(|row| row.due);
    if both_here && outcome.moved.is_none() && is_due {
        problems.push(if outcome.interrupted {
            "it was stopped before the consumer moved from fog to cloud".to_owned()
        } else {
            "the consumer did not move from fog to cloud".to_owned()
        });
    }
    if let Some(plan) = &outcome.plan {
        judge_changes(plan, &outcome.changes, outcome.interrupted, &mut problems);
    }
    Summary {
        ok: problems.is_empty(),
        duration_s: (outcome.duration.as_secs_f64() * 1_000.0).round() / 1_000.0,
        first_message_s: outcome.first_message_s,
        moves: outcome.moved.into_iter().collect(),
        changes: outcome.changes.made,
        topics: outcome.topics,
        problems,
    }
}

/// Every change of the plan reached whom it was for, and did what it is for.
fn judge_changes(
    plan: &ChangePlan,
    changes: &Changes,
    interrupted: bool,
    problems: &mut Vec<String>,
) {
    problems.extend(changes.problems.iter().cloned());
    let expected = 1 + usize::from(plan.with_pictures);
    let known = changes.made.len() + changes.problems.len();
    if known < expected {
        problems.push(if interrupted {
            "it was stopped before every change of the configuration".to_owned()
        } else {
            format!("{known} of {expected} changes of the configuration were made in time")
        });
    }
    for change in &changes.made {
        let (before, after) = (change.before_per_s, change.after_per_s);
        // With more of a recording's own pictures than this link takes, a narrower one lets fewer
        // through.
        let is_wrong = match change.effect {
            PICTURES => plan.limit_binds && (after >= before || after == 0.0),
            _ => after <= before,
        };
        if is_wrong {
            problems.push(format!(
                "{} of {} did not do what it should: {before:.1} → {after:.1} {} a second",
                change.setting, change.service, change.effect
            ));
        }
    }
}

fn judge_row(row: &TopicRow, complete: bool, problems: &mut Vec<String>) {
    let (Some(to), Some(service)) = (&row.to, row.service) else {
        return;
    };
    let mut problem =
        |what: String| problems.push(format!("{} to {to} ({service}): {what}", row.topic));
    if row.received == 0 {
        if row.due {
            problem("no message arrived".to_owned());
        }
        return;
    }
    // Where the publisher is elsewhere, it may rightly have ended before.
    let should_flow = row.active && row.sent.is_some();
    if let Some(silent) = row.silent.filter(|silent| should_flow && *silent > STALLED) {
        problem(format!("no message arrived in the last {:.1} s", silent.as_secs_f64()));
    }
    if row.duplicated > 0 {
        problem(format!("{} messages arrived twice", row.duplicated));
    }
    if !row.large {
        if row.lost > 0 {
            problem(format!("{} messages were lost", row.lost));
        }
        if row.reordered > 0 {
            problem(format!("{} messages arrived out of order", row.reordered));
        }
    } else if complete && !has_reasons(row) {
        let explained = explained(&row.dropped);
        problem(format!("{} pictures were lost, a reason is known for {explained}", row.lost));
    }
}

/// Whether a drop is counted for each lost message. What a flow dropped before the first or after
/// the last message is no loss, so there may be more drops.
pub fn has_reasons(row: &TopicRow) -> bool {
    row.lost <= explained(&row.dropped)
}

/// Drops that make a gap; what came back to its writer does not.
fn explained(dropped: &BTreeMap<String, u64>) -> u64 {
    let gaps =
        dropped.iter().filter(|(reason, _)| !matches!(reason.as_str(), "echo" | "foreign_origin"));
    gaps.map(|(_, count)| count).sum()
}

#[cfg(test)]
#[path = "verdict_tests.rs"]
pub(super) mod tests;
