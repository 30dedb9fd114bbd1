//! Which topic a flow gives to which other flow of its group, so that they carry about as much
//! each: a pure function.
//!
//! A move is made by the flow that carries too much, never by the one that gets it, and only to the
//! one that carries least. It takes the topic that weighs nearest to half of what is between the
//! two: that brings both nearest to the mean. A topic that weighs less than what is between the two
//! leaves both below what the giver had, so no move makes the largest load larger, and the sum of
//! the squares of all loads gets smaller with each: with loads that stay, moves end.

use std::cmp::Reverse;

use blaze_domain::{FlowId, TopicName};

/// A flow carries too much above this multiple of the group's mean. Loads of real topics vary by
/// some ten per cent over the 10 s of the measurement; a quarter is beyond that.
const ABOVE_MEAN: f64 = 1.25;
/// Difference in bytes per second that is worth a move: half a Mbit/s. Below it the handover costs
/// more than it gains.
pub(crate) const MIN_GAP: u64 = 64 * 1024;
/// By so much at least the larger of the two loads must get smaller, so that noise moves nothing to
/// and fro.
const MIN_GAIN: u64 = MIN_GAP / 4;

/// One flow of a group that could give or get a topic.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Member<'a> {
    pub(crate) flow: &'a FlowId,
    /// Payload bytes per second, both directions.
    pub(crate) bytes_per_s: u64,
    /// It has just given or got one: its load is not what it will be.
    pub(crate) rests: bool,
}

/// A topic that the flow carries out of the layer.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Burden<'a> {
    pub(crate) topic: &'a TopicName,
    /// Payload bytes per second.
    pub(crate) bytes_per_s: u64,
    /// It has stayed long enough, and can be handed over exactly.
    pub(crate) may_move: bool,
}

/// A topic that should be given to another flow.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Proposal {
    pub(crate) topic: TopicName,
    pub(crate) to: FlowId,
    /// How many flows carry more: they have the first word, because two that give at once could
    /// give to the same one.
    pub(crate) rank: u32,
}

/// What `me` should give to whom. `group` are the flows that carry topics and have settled, `me`
/// among them.
pub(crate) fn next_move(
    me: &FlowId,
    group: &[Member<'_>],
    topics: &[Burden<'_>],
) -> Option<Proposal> {
    let own = group.iter().find(|member| member.flow == me && !member.rests)?;
    let others = || group.iter().filter(|member| member.flow != me && !member.rests);
    let least = others().min_by_key(|member| (member.bytes_per_s, member.flow))?;
    // Not as integers: what others say may be absurd.
    let total: f64 = group.iter().map(|member| member.bytes_per_s as f64).sum();
    let mean = total / group.len() as f64;
    let gap = own.bytes_per_s.checked_sub(least.bytes_per_s)?;
    if gap <= MIN_GAP || own.bytes_per_s as f64 <= ABOVE_MEAN * mean {
        return None;
    }
    let gains = |topic: &&Burden<'_>| topic.may_move && gain(topic.bytes_per_s, gap) >= MIN_GAIN;
    let best = topics.iter().filter(gains);
    let best =
        best.min_by_key(|topic| (gap.abs_diff(topic.bytes_per_s.saturating_mul(2)), topic.topic))?;
    let more = others()
        .filter(|other| (other.bytes_per_s, Reverse(other.flow)) > (own.bytes_per_s, Reverse(me)));
    Some(Proposal {
        topic: best.topic.clone(),
        to: least.flow.clone(),
        rank: u32::try_from(more.count()).unwrap_or(u32::MAX),
    })
}

/// By how much the larger of two loads gets smaller when a weight moves over the gap between them.
fn gain(weight: u64, gap: u64) -> u64 {
    gap.checked_sub(weight).map_or(0, |left| left.min(weight))
}
