//! A running `blaze-wan`, and telling it what to do.

use std::io::{BufRead as _, BufReader, Write as _};
use std::process::{Child, ChildStdin, Stdio};
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::Duration;

use anyhow::Context as _;
use parking_lot::Mutex;
use serde_json::Value;

use super::WanLink;
use crate::process::binary;
use crate::wan::{Change, Command, LinkStats, Ways};

/// An answer takes microseconds; the rest is for a machine that does much else.
const ANSWER: Duration = Duration::from_secs(10);
/// Lines that wait to be read: there is one answer for each command.
const LINES: usize = 16;

/// The process of one link; it ends when dropped.
pub(super) struct LinkProcess {
    a: String,
    b: String,
    child: Child,
    talk: Mutex<Talk>,
}

struct Talk {
    commands: ChildStdin,
    answers: Receiver<String>,
}

impl LinkProcess {
    /// Starts it between two namespaces, with a device in each, and waits until it forwards.
    ///
    /// # Errors
    /// When it is not built, or the machine does not let it make TUN devices.
    pub(super) fn start(link: &WanLink, a: (&str, &str), b: (&str, &str)) -> anyhow::Result<Self> {
        let set = |ways, shape: &crate::wan::Shape| {
            serde_json::to_string(&Command::Set(ways, shape.changes()))
        };
        let mut child = std::process::Command::new(binary("blaze-testbed")?)
            .arg("wan")
            .args(["--a", a.0, "--a-device", a.1, "--a-mtu", &link.forward.mtu.to_string()])
            .args(["--b", b.0, "--b-device", b.1, "--b-mtu", &link.back.mtu.to_string()])
            .args(["--seed", &link.seed.to_string()])
            .args(["--run", &set(Ways::Forward, &link.forward)?])
            .args(["--run", &set(Ways::Back, &link.back)?])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .context("starting blaze-wan")?;
        let commands = child.stdin.take().context("no pipe to blaze-wan")?;
        let out = child.stdout.take().context("no pipe from blaze-wan")?;
        let (sender, answers) = sync_channel(LINES);
        std::thread::spawn(move || {
            let lines = BufReader::new(out).lines().map_while(Result::ok);
            // It ends with the process, or when nobody asks any more.
            lines.into_iter().try_for_each(|line| sender.send(line)).ok()
        });
        let process = Self {
            a: link.a.clone(),
            b: link.b.clone(),
            child,
            talk: Mutex::new(Talk { commands, answers }),
        };
        let ready = process.talk.lock().answer().context("blaze-wan is not ready")?;
        anyhow::ensure!(ready["ready"] == true, "blaze-wan says {ready}");
        Ok(process)
    }

    pub(super) fn seen_from(&self, a: &str, b: &str) -> Option<Link<'_>> {
        let flipped = (a, b) == (self.b.as_str(), self.a.as_str());
        let here = (a, b) == (self.a.as_str(), self.b.as_str());
        (here || flipped).then_some(Link { process: self, flipped })
    }

    fn ask(&self, command: &Command) -> anyhow::Result<Value> {
        let mut talk = self.talk.lock();
        let command = serde_json::to_string(command)?;
        writeln!(talk.commands, "{command}").context("blaze-wan has gone")?;
        let answer = talk.answer().with_context(|| format!("`{command}` to blaze-wan"))?;
        anyhow::ensure!(answer["ok"] == true, "`{command}`: blaze-wan says {answer}");
        Ok(answer)
    }
}

impl Talk {
    fn answer(&self) -> anyhow::Result<Value> {
        let line = self.answers.recv_timeout(ANSWER).context("no answer")?;
        serde_json::from_str(&line).with_context(|| line.clone())
    }
}

impl Drop for LinkProcess {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A link, seen from one of its ends.
#[derive(Clone, Copy)]
pub struct Link<'a> {
    process: &'a LinkProcess,
    flipped: bool,
}

impl Link<'_> {
    /// Changes its quality from now on.
    ///
    /// # Errors
    /// When `blaze-wan` has gone; so with the other calls.
    pub fn set(&self, ways: Ways, changes: &[Change]) -> anyhow::Result<()> {
        let command = Command::Set(self.ways(ways), changes.to_vec());
        self.process.ask(&command).map(|_| ())
    }

    /// Cuts it: what is on the way is lost, and all that comes until [`Link::heal`].
    ///
    /// # Errors
    /// As [`Link::set`].
    pub fn cut(&self, ways: Ways) -> anyhow::Result<()> {
        self.process.ask(&Command::Cut(self.ways(ways))).map(|_| ())
    }

    /// Ends a cut.
    ///
    /// # Errors
    /// As [`Link::set`].
    pub fn heal(&self, ways: Ways) -> anyhow::Result<()> {
        self.process.ask(&Command::Heal(self.ways(ways))).map(|_| ())
    }

    /// What it counted so far.
    ///
    /// # Errors
    /// As [`Link::set`].
    pub fn stats(&self) -> anyhow::Result<LinkStats> {
        let stats: LinkStats = serde_json::from_value(self.process.ask(&Command::Stats)?)?;
        Ok(if self.flipped { stats.flipped() } else { stats })
    }

    fn ways(&self, ways: Ways) -> Ways {
        if self.flipped { ways.flipped() } else { ways }
    }
}
