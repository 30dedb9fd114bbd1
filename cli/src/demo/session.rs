//! One run of the demo: play, report each second, move a consumer half way, judge at the end.
//!
//! What the flows and services are is the business of a [`Stage`]; this is the same for any.

use std::collections::BTreeSet;
use std::io::Write;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_domain::TopicName;
use parking_lot::Mutex;
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval_at, sleep, sleep_until};

use super::board::{Board, ConsumerId};
use super::changes::{Changes, Changing};
use super::flows::FlowView;
use super::player::{Played, Player, PlayerReport};
use super::report::Report;
use super::roles::{Consumer, MOVES_FROM, MOVES_TO, MOVING_SERVICE};
use super::stage::{Script, Stage};
use super::verdict::{Outcome, Summary, has_reasons, judge};
use crate::exit::CliError;

/// How long the moved consumer may wait for its first message before it leaves its old place.
const MOVE_TIMEOUT: Duration = Duration::from_secs(5);
/// After the last message was played: what is on the way may still arrive.
const DRAIN_LIMIT: Duration = Duration::from_secs(3);
/// No message for so long: nothing is on the way any more.
const DRAIN_QUIET: Duration = Duration::from_millis(300);
/// How long bridges may take to re-form after the move.
const REFORM_LIMIT: Duration = Duration::from_secs(2);
const LOOK_PERIOD: Duration = Duration::from_millis(20);
/// Sentences about changes that wait to be printed.
const EVENTS: usize = 16;

/// Runs the script and prints it. Returns what was found at the end.
///
/// # Errors
/// [`CliError::OutputClosed`] when nobody reads the report, [`CliError::Failed`] when the player
/// cannot start.
pub async fn run<S: Stage, Out: Write, Err: Write>(
    stage: &S,
    board: &Arc<Board>,
    script: Script,
    report: &mut Report<Out, Err>,
) -> Result<Summary, CliError> {
    let mut session = Session {
        stage,
        board,
        start: Instant::now(),
        faults: Vec::new(),
        moving: Moving::No,
        changes: Arc::default(),
    };
    for consumer in script.consumers.iter().filter(|consumer| !consumer.later) {
        let id = session.listen(consumer).await;
        if let Some(leaves) =
            id.filter(|_| consumer.service == MOVING_SERVICE && consumer.node == MOVES_FROM)
        {
            session.moving = Moving::Later { leaves };
        }
    }
    let player = session.start_player(&script)?;
    session.start = Instant::now();
    let interruption = session.play(&script, report).await?;
    let played = session.start.elapsed();
    let end = Instant::now();
    if let Some(pace) = player.map(Player::stop).filter(|pace| pace.late + pace.unusable > 0) {
        report.event(played, &pace_text(&pace))?;
    }
    session.drain().await;
    let interrupted = interruption.is_some();
    session.faults.extend(interruption.flatten());
    let changes = std::mem::take(&mut *session.changes.lock());
    let summary = judge(Outcome {
        plan: script.changes.ok(),
        changes,
        nodes: script.nodes,
        duration: played,
        interrupted,
        faults: session.faults,
        first_message_s: board.first_message_s(),
        moved: board.moved(),
        topics: board.total(end),
    });
    report.summary(&summary)?;
    Ok(summary)
}

struct Session<'a, S> {
    stage: &'a S,
    board: &'a Arc<Board>,
    start: Instant,
    faults: Vec<String>,
    moving: Moving,
    changes: Arc<Mutex<Changes>>,
}

/// The consumer that goes to another node half way.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Moving {
    /// It does not move here, or has moved.
    No,
    /// It will, and then leave this place.
    Later { leaves: ConsumerId },
    /// It listens at both places, until something came to the new one or the time is over.
    Joining {
        leaves: ConsumerId,
        joined: ConsumerId,
        topic: TopicName,
        /// The topic's bridges before the move.
        bridges: BTreeSet<String>,
        deadline: Instant,
    },
}

impl<S: Stage> Session<'_, S> {
    async fn listen(&mut self, consumer: &Consumer) -> Option<ConsumerId> {
        let id = self.board.add_consumer(consumer.clone(), Instant::now())?;
        if let Err(fault) = self.stage.listen(consumer, id).await {
            let place = consumer.node.flow();
            self.faults.push(format!(
                "{} on {place} cannot listen to {}: {fault}",
                consumer.service, consumer.topic
            ));
        }
        Some(id)
    }

    fn start_player(&self, script: &Script) -> Result<Option<Player>, CliError> {
        let Some(mut publish) = self.stage.publisher() else {
            return Ok(None);
        };
        let mut bases = Vec::with_capacity(script.recordings.len());
        let mut topics = 0;
        for recording in &script.recordings {
            bases.push(topics);
            topics += recording.topics.len();
        }
        let board = Arc::clone(self.board);
        let sink = move |played: Played| {
            let topic = bases.get(played.recording).copied().unwrap_or_default() + played.topic;
            board.published(topic, Instant::now());
            publish(topic, played.payload);
        };
        Player::start(&script.recordings, sink)
            .map(Some)
            .map_err(|error| CliError::Failed(format!("the player does not start: {error}")))
    }

    /// Reports each second until the time is over. Returns whether it was ended before, and why, if
    /// not by the user.
    async fn play<Out: Write, Err: Write>(
        &mut self,
        script: &Script,
        report: &mut Report<Out, Err>,
    ) -> Result<Option<Option<String>>, CliError> {
        let start = tokio::time::Instant::from_std(self.start);
        let second = Duration::from_secs(1);
        let mut seconds = interval_at(start + second, second);
        seconds.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let half = sleep_until(start + script.duration / 2);
        let end = sleep_until(start + script.duration);
        let (board, stage) = (self.board, self.stage);
        let interrupted = stage.interrupted();
        let (events, mut told) = mpsc::channel(EVENTS);
        let outcome = Arc::clone(&self.changes);
        let changing = script.changes.as_ref().ok().map(|plan| Changing {
            stage,
            board,
            start: self.start,
            duration: script.duration,
            plan: *plan,
            events,
            outcome: &outcome,
        });
        let changing = async {
            if let Some(changing) = changing {
                changing.run().await;
            }
        };
        tokio::pin!(half, end, interrupted, changing);
        if let Err(why) = &script.changes {
            report.event(Duration::ZERO, why)?;
        }
        // What `recent` counts begins with the first message.
        let _ = board.recent(self.start);
        let mut last_tick = self.start;
        let mut half_passed = false;
        let mut changed = false;
        loop {
            tokio::select! {
                () = &mut end => {
                    if last_tick.elapsed() > second / 2 {
                        self.tick(report).await?;
                    }
                    self.finish_move(report).await?;
                    return Ok(None);
                }
                reason = &mut interrupted => return Ok(Some(reason)),
                _ = seconds.tick() => {
                    last_tick = Instant::now();
                    self.tick(report).await?;
                }
                () = &mut half, if !half_passed => {
                    half_passed = true;
                    self.begin_move(script, report).await?;
                }
                () = &mut changing, if !changed => changed = true,
                Some(text) = told.recv() => report.event(self.start.elapsed(), &text)?,
                () = sleep(LOOK_PERIOD), if self.is_joining() => {
                    if self.has_joined() {
                        self.finish_move(report).await?;
                    }
                }
            }
        }
    }

    async fn tick<Out: Write, Err: Write>(
        &self,
        report: &mut Report<Out, Err>,
    ) -> Result<(), CliError> {
        self.look().await;
        let now = Instant::now();
        report.rows(now - self.start, &self.board.recent(now))
    }

    /// Brings routes and drops to the board.
    async fn look(&self) {
        self.stage.look().await;
        self.board.set_view(&FlowView::ask(&self.stage.admin_ports()).await);
    }

    fn is_joining(&self) -> bool {
        matches!(self.moving, Moving::Joining { .. })
    }

    /// Whether it can leave its old place: something came to the new one, or it has waited long
    /// enough.
    fn has_joined(&self) -> bool {
        match &self.moving {
            Moving::Joining { joined, deadline, .. } => {
                self.board.received(*joined) > 0 || Instant::now() >= *deadline
            }
            Moving::No | Moving::Later { .. } => false,
        }
    }

    /// Listens at the new place first, so that nothing is missed.
    async fn begin_move<Out: Write, Err: Write>(
        &mut self,
        script: &Script,
        report: &mut Report<Out, Err>,
    ) -> Result<(), CliError> {
        let Moving::Later { leaves } = self.moving else {
            return Ok(());
        };
        self.moving = Moving::No;
        let Some(later) = script.consumers.iter().find(|consumer| consumer.later) else {
            return Ok(());
        };
        let bridges = self.bridges(&later.topic).await;
        let (from, to) = (MOVES_FROM.flow(), MOVES_TO.flow());
        report.event(
            self.start.elapsed(),
            &format!(
                "{MOVING_SERVICE} moves from {from} to {to}; bridges of {}: {}",
                later.topic,
                list(&bridges)
            ),
        )?;
        if let Some(joined) = self.listen(later).await {
            self.moving = Moving::Joining {
                leaves,
                joined,
                topic: later.topic.clone(),
                bridges,
                deadline: Instant::now() + MOVE_TIMEOUT,
            };
        }
        Ok(())
    }

    /// Leaves the old place, once it listens at the new one.
    async fn finish_move<Out: Write, Err: Write>(
        &mut self,
        report: &mut Report<Out, Err>,
    ) -> Result<(), CliError> {
        let Moving::Joining { leaves, joined, topic, bridges, .. } =
            std::mem::replace(&mut self.moving, Moving::No)
        else {
            return Ok(());
        };
        let (from, to) = (MOVES_FROM.flow(), MOVES_TO.flow());
        if self.board.received(joined) == 0 && self.board.is_due(joined) {
            self.faults.push(format!("{MOVING_SERVICE} got nothing on {to} when it moved there"));
        }
        if let Err(fault) = self.stage.stop_listening(leaves).await {
            self.faults.push(format!("{MOVING_SERVICE} cannot leave {from}: {fault}"));
        }
        self.board.end_consumer(leaves);
        let gap = self.board.moved().map_or_else(
            || "no message came to it there".to_owned(),
            |moved| format!("{:.0} ms without a message", moved.gap_ms),
        );
        let now = self.bridges_after(&topic, &bridges).await;
        let made: BTreeSet<String> = now.difference(&bridges).cloned().collect();
        let ended: BTreeSet<String> = bridges.difference(&now).cloned().collect();
        report.event(
            self.start.elapsed(),
            &format!(
                "{MOVING_SERVICE} is on {to}: {gap}; bridges made: {}; ended: {}",
                list(&made),
                list(&ended)
            ),
        )
    }

    /// The bridges of a topic, for people.
    async fn bridges(&self, topic: &TopicName) -> BTreeSet<String> {
        FlowView::ask(&self.stage.admin_ports()).await.bridges_of(topic.as_str())
    }

    /// The bridges of a topic, once they differ from what they were and have settled, or after two
    /// seconds.
    async fn bridges_after(
        &self,
        topic: &TopicName,
        before: &BTreeSet<String>,
    ) -> BTreeSet<String> {
        let deadline = Instant::now() + REFORM_LIMIT;
        let mut last = self.bridges(topic).await;
        while Instant::now() < deadline {
            sleep(LOOK_PERIOD).await;
            let now = self.bridges(topic).await;
            let lost_some = before.difference(&now).next().is_some();
            if lost_some && now == last {
                break;
            }
            last = now;
        }
        last
    }

    /// Waits until nothing more arrives, and looks at the flows until each lost picture is counted.
    async fn drain(&self) {
        let deadline = Instant::now() + DRAIN_LIMIT;
        let mut received = self.board.received_by_all();
        let mut since = Instant::now();
        while since.elapsed() < DRAIN_QUIET && Instant::now() < deadline {
            sleep(LOOK_PERIOD).await;
            let now = self.board.received_by_all();
            if now != received {
                received = now;
                since = Instant::now();
            }
        }
        // One that came in part is counted when its lifespan ends.
        loop {
            self.look().await;
            let now = Instant::now();
            if now >= deadline || self.board.total(now).iter().all(has_reasons) {
                return;
            }
            sleep(LOOK_PERIOD).await;
        }
    }
}

fn list(bridges: &BTreeSet<String>) -> String {
    if bridges.is_empty() {
        return "none".to_owned();
    }
    bridges.iter().map(String::as_str).collect::<Vec<_>>().join(", ")
}

fn pace_text(pace: &PlayerReport) -> String {
    let mut text = format!(
        "the player kept its pace but for {} of {} messages, the worst {} ms late",
        pace.late,
        pace.played,
        pace.worst.as_millis()
    );
    if pace.unusable > 0 {
        text.push_str(&format!("; {} pictures do not decode", pace.unusable));
    }
    text
}

#[cfg(test)]
#[path = "session_tests.rs"]
mod tests;
