//! Quality of service of writers on the robot against that of readers in the cloud: each pair
//! flows, whichever comes first, or `why` says what is in its way.

use anyhow::Context as _;
use blaze_tests::ros2::{End, Message, Peer, Quality, Release, Stream};

use super::support::{ARRIVE, NODE, Pair};

const KIND: &str = "std_msgs/msg/String";
/// Before a reader joins, and once both are there.
const EARLY: Stream = Stream { count: 2, size: 20, hz: 0.0, seed: 1 };
const LATER: Stream = Stream { count: 5, size: 20, hz: 10.0, seed: 2 };

/// One writer and one reader.
struct Row {
    topic: String,
    writer: Quality,
    reader: Quality,
    writer_first: bool,
}

impl Row {
    /// What the reader asks beyond what the writer offers.
    fn asks_more(&self) -> bool {
        (self.reader.reliable && !self.writer.reliable)
            || (self.reader.durable && !self.writer.durable)
    }
}

/// Reliability and durability, each against each, and times; each with either side first.
fn rows() -> Vec<Row> {
    let deep = Quality { depth: 100, ..Quality::default() };
    let mut kinds = Vec::new();
    for reliable in [true, false] {
        for durable in [true, false] {
            kinds.push(Quality { reliable, durable, ..deep });
        }
    }
    let mut pairs = Vec::new();
    for writer in &kinds {
        pairs.extend(kinds.iter().map(|reader| (*writer, *reader)));
    }
    let deadline = |ms| Quality { deadline_ms: ms, ..deep };
    let lease = |ms| Quality { lease_ms: ms, ..deep };
    pairs.extend([
        (deadline(500), deadline(1_000)),
        (deep, deadline(1_000)),
        (deadline(1_000), deep),
        (lease(1_000), lease(2_000)),
        (deep, lease(2_000)),
        (lease(2_000), deep),
    ]);
    let rows = [true, false].into_iter().flat_map(|writer_first| {
        let side = if writer_first { "writer" } else { "reader" };
        pairs.iter().enumerate().map(move |(number, (writer, reader))| Row {
            topic: format!("/{side}_first/row_{number}"),
            writer: *writer,
            reader: *reader,
            writer_first,
        })
    });
    rows.collect()
}

/// What is wrong with a row, if anything.
fn judge(
    pair: &Pair,
    row: &Row,
    (early, later): (&[Message], &[Message]),
    subscription: &End<'_>,
) -> anyhow::Result<Option<String>> {
    let topic = row.topic.trim_start_matches('/');
    let is_whole = row.writer.reliable && row.reader.reliable;
    let is_late = row.writer_first && row.writer.durable && row.reader.durable;
    let old = if is_late && is_whole { early } else { &[] };
    let wanted = if is_whole { old.len() + later.len() } else { 1 };
    let received = match subscription.received(wanted, ARRIVE) {
        Ok(received) => received,
        Err(error) => return Ok(Some(format!("{error:#}; {}", pair.cloud.why(topic, None)?))),
    };
    let all: Vec<Message> = old.iter().chain(later).cloned().collect();
    let mut known = early.iter().chain(later);
    // Each once, in order, and none that was never sent.
    let in_order = received.iter().all(|message| known.any(|sent| sent == message));
    if !in_order || (is_whole && received != all) {
        return Ok(Some(format!("{} of {} in order: {in_order}", received.len(), all.len())));
    }
    if row.writer_first && !(row.writer.durable && row.reader.durable) && received[0] == early[0] {
        return Ok(Some("the reader got what was published before it came".to_owned()));
    }
    let why = pair.cloud.why(topic, None)?;
    let (verdict, code) =
        if row.asks_more() { ("degraded", "qos_mismatch") } else { ("flowing", "ok") };
    Ok((why["verdict"] != verdict || why["code"] != code).then(|| format!("why: {why}")))
}

/// Every row from one release to another.
pub(super) fn compare(from: Release, to: Release) -> anyhow::Result<()> {
    compare_rows(from, to, &rows())
}

fn compare_rows(from: Release, to: Release, rows: &[Row]) -> anyhow::Result<()> {
    let pair = Pair::start()?;
    let (robot, cloud) = (pair.on_robot(from)?, pair.in_cloud(to)?);
    let writer = |row: &Row| robot.publisher(NODE, &row.topic, KIND, row.writer);
    let reader = |row: &Row| cloud.subscription(NODE, &row.topic, KIND, row.reader);
    let (mut writers, mut readers) = (Vec::new(), Vec::new());
    for row in rows {
        writers.push(row.writer_first.then(|| writer(row)).transpose()?);
        readers.push((!row.writer_first).then(|| reader(row)).transpose()?);
    }
    let mut early = Vec::new();
    for writer in &writers {
        early.push(writer.as_ref().map_or(Ok(Vec::new()), |writer| writer.publish_all(EARLY))?);
    }
    let mut ends = Vec::new();
    for ((row, first), second) in rows.iter().zip(writers).zip(readers) {
        ends.push((
            first.map_or_else(|| writer(row), Ok)?,
            second.map_or_else(|| reader(row), Ok)?,
        ));
    }
    let mut faults = Vec::new();
    let mut fault = |row: &Row, what: String| {
        faults.push(format!("{}: {:?} to {:?}: {what}", row.topic, row.writer, row.reader));
    };
    for ((row, (writer, reader)), early) in rows.iter().zip(&ends).zip(&early) {
        if let Err(error) = pair.wait_route(&row.topic, writer, reader) {
            fault(row, format!("{error:#}"));
            continue;
        }
        let later = writer.publish_all(LATER)?;
        let judged =
            judge(&pair, row, (early, &later), reader).context("a peer or a flow is gone")?;
        if let Some(what) = judged {
            fault(row, what);
        }
    }
    anyhow::ensure!(
        faults.is_empty(),
        "{from:?} to {to:?}, {} faults:\n{}",
        faults.len(),
        faults.join("\n")
    );
    leave(robot, cloud)
}

fn leave(robot: Peer, cloud: Peer) -> anyhow::Result<()> {
    robot.finish()?;
    cloud.finish()
}

#[test]
fn qualities_of_two_networks_flow_or_are_named() -> anyhow::Result<()> {
    compare(Release::Jazzy, Release::Kilted)
}

#[test]
fn what_cyclone_keeps_is_not_given_to_volatile_readers() -> anyhow::Result<()> {
    let kept = |row: &Row| row.writer_first && row.writer.durable && !row.reader.durable;
    let rows: Vec<Row> = rows().into_iter().filter(kept).collect();
    compare_rows(Release::Cyclone, Release::Jazzy, &rows)
}
