//! A Redis of one's own: `redis-server` from PATH on a free port of loopback, which ends with this
//! process.

use std::io::ErrorKind;
use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::process::Stdio;
use std::time::{Duration, Instant};

use blaze_runtime::{Supervisor, TaskPolicy};
use tokio::net::TcpStream;
use tokio::process::{Child, Command};
use tokio::time::sleep;

use crate::exit::CliError;

const PROGRAM: &str = "redis-server";
/// How long it may take until it listens.
const START: Duration = Duration::from_secs(10);
const LOOK: Duration = Duration::from_millis(20);
/// A free port may be taken by somebody else before the server has it.
const TRIES: usize = 3;

/// Starts it; `None` where there is no such program.
///
/// # Errors
/// [`CliError::Failed`] when it does not come to listen.
pub(super) async fn start(supervisor: &Supervisor) -> Result<Option<String>, CliError> {
    let mut told = String::new();
    for _ in 0..TRIES {
        let port =
            free_port().map_err(|error| CliError::Failed(format!("no free port: {error}")))?;
        let Some(child) = launch(port)? else {
            return Ok(None);
        };
        match listening(child, port).await {
            Ok(child) => {
                keep(child, supervisor);
                return Ok(Some(format!("redis://127.0.0.1:{port}")));
            }
            Err(why) => told = why,
        }
    }
    Err(CliError::Failed(format!(
        "{PROGRAM} does not start: {told}. Start one yourself and give --broker redis://HOST:PORT."
    )))
}

fn free_port() -> std::io::Result<u16> {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?;
    Ok(listener.local_addr()?.port())
}

fn launch(port: u16) -> Result<Option<Child>, CliError> {
    let port = port.to_string();
    let mut command = Command::new(PROGRAM);
    command
        .args(["--port", &port, "--bind", "127.0.0.1", "--loglevel", "warning"])
        .args(["--save", "", "--appendonly", "no"])
        // Pictures that wait for a slow reader are more than the default allows.
        .args(["--client-output-buffer-limit", "pubsub 256mb 128mb 60"])
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .kill_on_drop(true)
        // Ctrl-C on a terminal goes to the whole group: it would be gone before what it carries has
        // drained.
        .process_group(0);
    match command.spawn() {
        Ok(child) => Ok(Some(child)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => Err(CliError::Failed(format!("{PROGRAM} does not start: {error}"))),
    }
}

/// Waits until it takes connections.
async fn listening(mut child: Child, port: u16) -> Result<Child, String> {
    let start = Instant::now();
    let address = SocketAddr::from((Ipv4Addr::LOCALHOST, port));
    loop {
        if let Ok(Some(status)) = child.try_wait() {
            return Err(format!("it ended at once ({status})"));
        }
        if TcpStream::connect(address).await.is_ok() {
            return Ok(child);
        }
        if start.elapsed() > START {
            return Err(format!("it does not listen on port {port} within {} s", START.as_secs()));
        }
        sleep(LOOK).await;
    }
}

/// Nothing goes on without it; it goes when everything else has drained.
fn keep(mut child: Child, supervisor: &Supervisor) {
    let (stop, failing) = (supervisor.shutdown_token(), supervisor.clone());
    supervisor.spawn(PROGRAM, TaskPolicy::MayEnd, async move {
        tokio::select! {
            ended = child.wait() => {
                let how = ended.map_or_else(|error| error.to_string(), |status| status.to_string());
                failing.fail(format!("{PROGRAM} ended by itself ({how})"));
            }
            () = stop.cancelled() => {
                // What it holds is for this process alone.
                let _ = child.kill().await;
            }
        }
    });
}
