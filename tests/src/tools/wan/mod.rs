//! A link emulator: one point-to-point IP link between two network namespaces, over a TUN device in
//! each.
//!
//! ```text
//! namespace A: w0 ─► reader ─► Direction a>b ─► writer ─► w0 :namespace B
//!              w0 ◄─ writer ◄─ Direction b>a ◄─ reader ◄─ w0
//! ```
//!
//! Commands come one a line on stdin; each is answered by one line of JSON on stdout. It ends when
//! stdin does. Addresses and routes are whoever's who starts it: `ip -n A addr add 10.0.0.1/30 dev
//! w0`.

mod device;
mod forward;

use std::io::{BufRead as _, Write as _};
use std::sync::Arc;

use anyhow::Context as _;
use blaze_runtime::{Supervisor, TaskPolicy};
use blaze_tests::process::hurry;
use blaze_tests::wan::{Command, Shape, Ways};
use clap::Parser;
use serde_json::json;

use self::forward::Line;

/// One emulated IP link between two network namespaces.
///
/// Commands on stdin, each a line of JSON: `{"set":["both",[{"loss":0.01},{"rate":5000000}]]}`,
/// `{"cut":"forward"}`, `{"heal":"forward"}`, `"stats"`.
#[derive(Debug, Parser)]
pub(crate) struct Options {
    /// Namespace at one end, as `ip netns list` names it
    #[arg(long, value_name = "NAMESPACE")]
    a: String,
    /// Namespace at the other end
    #[arg(long, value_name = "NAMESPACE")]
    b: String,
    /// Name of the TUN device in A
    #[arg(long, default_value = "w0")]
    a_device: String,
    /// Name of the TUN device in B
    #[arg(long, default_value = "w0")]
    b_device: String,
    /// MTU of the device in A; `set` cannot change it
    #[arg(long, default_value_t = 1500, value_parser = clap::value_parser!(u16).range(68..))]
    a_mtu: u16,
    /// MTU of the device in B
    #[arg(long, default_value_t = 1500, value_parser = clap::value_parser!(u16).range(68..))]
    b_mtu: u16,
    /// Of the generator that loses and delays: the same packets at the same times have the same
    /// fate
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// A command to begin with; may be repeated
    #[arg(long, value_name = "COMMAND")]
    run: Vec<Command>,
}

pub(crate) fn run(options: Options) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let ended = runtime.block_on(emulate(options));
    // The threads that read and write packets do not end by themselves.
    runtime.shutdown_background();
    ended
}

async fn emulate(options: Options) -> anyhow::Result<()> {
    // The threads that it starts inherit it.
    hurry();
    let link = Arc::new(Link::open(&options)?);
    for command in &options.run {
        link.obey(command)?;
    }
    let supervisor = Supervisor::new("blaze-testbed");
    for (name, line) in [("a>b", &link.forward), ("b>a", &link.back)] {
        let (reader, writer) = (Arc::clone(line), Arc::clone(line));
        supervisor
            .spawn_thread(format!("{name} in"), TaskPolicy::Essential, move || reader.read())?;
        supervisor
            .spawn_thread(format!("{name} out"), TaskPolicy::Essential, move || writer.write())?;
    }
    let (done, ended) = tokio::sync::oneshot::channel();
    supervisor.spawn_thread("commands", TaskPolicy::MayEnd, move || {
        // Nobody listens only when the process ends anyhow.
        let _ = done.send(converse(&link));
    })?;
    tokio::select! {
        reason = supervisor.failed() => anyhow::bail!(reason),
        ended = ended => ended.context("the thread of the commands has gone")?,
    }
}

/// Both directions.
struct Link {
    forward: Arc<Line>,
    back: Arc<Line>,
}

impl Link {
    fn open(options: &Options) -> anyhow::Result<Self> {
        let a = Arc::new(device::open(&options.a, &options.a_device, options.a_mtu)?);
        let b = Arc::new(device::open(&options.b, &options.b_device, options.b_mtu)?);
        let shape = Shape::default();
        Ok(Self {
            forward: Arc::new(Line::new(Arc::clone(&a), Arc::clone(&b), shape, options.seed)),
            back: Arc::new(Line::new(b, a, shape, options.seed.wrapping_add(1))),
        })
    }

    fn lines(&self, ways: Ways) -> Vec<&Line> {
        match ways {
            Ways::Forward => vec![&self.forward],
            Ways::Back => vec![&self.back],
            Ways::Both => vec![&self.forward, &self.back],
        }
    }

    fn obey(&self, command: &Command) -> anyhow::Result<serde_json::Value> {
        match command {
            Command::Set(ways, changes) => {
                self.lines(*ways).iter().for_each(|line| line.change(changes));
            }
            Command::Cut(ways) => self.lines(*ways).iter().for_each(|line| line.cut()),
            Command::Heal(ways) => self.lines(*ways).iter().for_each(|line| line.heal()),
            Command::Stats => {
                return Ok(
                    json!({ "ok": true, "a>b": self.forward.stats()?, "b>a": self.back.stats()? }),
                );
            }
        }
        Ok(json!({ "ok": true }))
    }
}

/// Answers commands until stdin ends.
fn converse(link: &Link) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    let mut answer = |value: &serde_json::Value| -> std::io::Result<()> {
        writeln!(out, "{value}")?;
        out.flush()
    };
    answer(&json!({ "ok": true, "ready": true }))?;
    for line in std::io::stdin().lock().lines() {
        let answered = line?
            .parse::<Command>()
            .map_err(anyhow::Error::from)
            .and_then(|command| link.obey(&command));
        match answered {
            Ok(value) => answer(&value)?,
            Err(error) => answer(&json!({ "ok": false, "error": format!("{error:#}") }))?,
        }
    }
    Ok(())
}
