//! The nodes of the demo in one process: flows, their brokers, and the services on them.
//!
//! ```text
//! robot-1: node broker ─ flow ─┬─ edge layer broker ─┬─ flow ─ node broker: edge-2
//!                              │                     │
//!                              └── DDS on one interface ──┐
//! fog-1:   node broker ─ flow ─ fog layer broker   ───────┤
//! cloud-1: node broker ─ flow ─ cloud layer broker ───────┘
//! ```
//!
//! Where all of them run here, a main service of BlazeConfig and a worker on each node broker run
//! beside them.

use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_domain::Scope;
use blaze_runtime::Supervisor;
use tokio::sync::Mutex;

use super::board::Board;
use super::changes::{ChangePlan, SHORTEST, SLOWEST_HZ};
use super::configuration::{Configuration, Place};
use super::nodes::{Nodes, start_nodes, wait_ready};
use super::options::DemoOptions;
use super::recording::{self, MAX_GAP, Recording};
use super::report::{Report, Style};
use super::roles::{PUBLISHING_NODE, PlayedTopic, consumers, played_topics};
use super::session;
use super::stage::Script;
use super::system::{EndableSystem, System};
use crate::ends::Ends;
use crate::exit::{CliError, Exit};
use crate::output::Format;

/// Runs the demo.
///
/// # Errors
/// [`CliError::Usage`] for options that make no sense, [`CliError::Failed`] for what could not be
/// started.
pub async fn run(options: DemoOptions, format: Format) -> Result<Exit, CliError> {
    let start = Instant::now();
    options.check()?;
    let style = Style::choose(format)?;
    let supervisor = Supervisor::new("demo");
    // Signals are listened to from here on: an end while nodes start is orderly, too.
    let ends = Ends::new(supervisor.clone())?;
    let outcome = tokio::select! {
        outcome = prepare(&options, supervisor.clone(), start) => outcome,
        reason = ends.wait() => Err(CliError::Failed(reason.unwrap_or_else(|| "stopped before it \
            began".to_owned()))),
    };
    let (system, script) = match outcome {
        Ok(prepared) => prepared,
        Err(error) => {
            supervisor.shutdown(Duration::from_secs(1)).await;
            return Err(error);
        }
    };
    let mut report = Report::new(style, std::io::stdout(), std::io::stderr());
    let board = Arc::clone(&system.board);
    let system = EndableSystem { system, ends };
    let outcome = session::run(&system, &board, script, &mut report).await;
    system.system.shutdown().await;
    supervisor.shutdown(Duration::from_secs(1)).await;
    outcome.map(|summary| if summary.ok { Exit::Done } else { Exit::Failed })
}

/// Starts nodes and publishers while the recordings are read.
async fn prepare(
    options: &DemoOptions,
    supervisor: Supervisor,
    start: Instant,
) -> Result<(System, Script), CliError> {
    let files = options.record.clone();
    let pictures = options.pictures();
    let reading = tokio::task::spawn_blocking(move || match files.as_slice() {
        [] => recording::load_built_in(pictures),
        files => recording::load_all(files, pictures),
    });
    let nodes = start_nodes(options, &supervisor).await?;
    let recordings = reading
        .await
        .map_err(|error| CliError::Failed(format!("reading the recordings: {error}")))?
        .map_err(|error| CliError::Failed(error.to_string()))?;
    tell_skipped(&recordings);
    let recordings: Vec<Arc<Recording>> = recordings.into_iter().map(Arc::new).collect();
    let topics = played_topics(recordings.iter().map(Arc::as_ref));
    let names = options.nodes();
    let board = Arc::new(Board::new(topics.clone(), &names, start));
    let changes = plan(options, &nodes, &topics);
    let (ready, configuration) = tokio::join!(wait_ready(&nodes, options.ros2), async {
        match &changes {
            Ok(_) => start_configuration(&nodes, &supervisor).await.map(Some),
            Err(_) => Ok(None),
        }
    });
    ready?;
    let configuration = configuration?;
    if let Some(configuration) = &configuration {
        eprintln!("ready rest={}", configuration.rest());
    }
    let system = System {
        nodes,
        configuration,
        analytics: parking_lot::Mutex::default(),
        topics: topics.clone(),
        board,
        services: Mutex::default(),
        publishers: Vec::new(),
        _advertised: Vec::new(),
        listeners: Mutex::default(),
    };
    let system = system.with_publishers().await?;
    let script = Script {
        consumers: consumers(&topics, &names),
        nodes: names,
        recordings,
        topics,
        duration: options.duration,
        changes,
    };
    Ok((system, script))
}

/// The changes of the configuration that the run shows, or why it shows none.
fn plan(
    options: &DemoOptions,
    nodes: &Nodes,
    topics: &[PlayedTopic],
) -> Result<ChangePlan, String> {
    let Some(robot) = nodes.robot().filter(|_| options.is_complete()) else {
        return Err("no change of the configuration is shown: that needs all nodes in one process"
            .to_owned());
    };
    if options.duration < SHORTEST {
        let shortest = SHORTEST.as_secs();
        return Err(format!(
            "no change of the configuration is shown: that needs --duration {shortest}s or more"
        ));
    }
    let fastest = topics.iter().map(|topic| topic.rate_hz).fold(0.0, f64::max);
    if fastest < SLOWEST_HZ {
        return Err(format!(
            "no change of the configuration is shown: that needs a topic with {SLOWEST_HZ} \
             messages a second or more"
        ));
    }
    Ok(ChangePlan {
        limit_mbps: robot.limit_mbps,
        with_pictures: topics.iter().any(|topic| topic.large && topic.rate_hz >= SLOWEST_HZ),
        limit_binds: options.record.is_empty() && options.set.is_empty(),
    })
}

async fn start_configuration(
    nodes: &Nodes,
    supervisor: &Supervisor,
) -> Result<Configuration, CliError> {
    let robot = nodes
        .robot()
        .ok_or_else(|| CliError::Failed(format!("{} does not run here", PUBLISHING_NODE.name())))?;
    let places = nodes.running.iter().map(|running| Place {
        node: running.node,
        file: running.file.clone(),
        broker_section: running.brokers.node_section.clone(),
        broker: Arc::clone(running.brokers.of_services(Scope::Node)),
    });
    Configuration::start(places.collect(), &robot.flow, supervisor.child("configuration")).await
}

fn tell_skipped(recordings: &[Recording]) {
    for recording in recordings {
        let file = recording.path.display();
        for skipped in &recording.skipped {
            eprintln!("blaze: {file}: {} is not played: {}", skipped.topic, skipped.reason);
        }
        if let Some(cut) = &recording.cut {
            eprintln!("blaze: {file}: the rest is missing, and what was read is played: {cut}");
        }
        let (shortened, longest) = recording.shortened;
        if shortened > 0 {
            eprintln!(
                "blaze: {file}: {shortened} times without a message are shortened to {} s; the \
                 longest has {} s",
                MAX_GAP.as_secs(),
                longest.as_secs()
            );
        }
        if recording.unusable_messages > 0 {
            eprintln!("blaze: {file}: {} messages cannot be played", recording.unusable_messages);
        }
    }
}
