//! A running `blaze-wan`, and telling it what to do.

use std::time::Duration;

use serde_json::Value;

use super::WanLink;
use crate::dialogue::Dialogue;
use crate::process::binary;
use crate::wan::{Change, Command, LinkStats, Ways};

/// An answer takes microseconds; the rest is for a machine that does much else.
const ANSWER: Duration = Duration::from_secs(10);
/// The process of one link; it ends when dropped.
pub(super) struct LinkProcess {
    a: String,
    b: String,
    dialogue: Dialogue,
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
        let mut command = std::process::Command::new(binary("blaze-testbed")?);
        command
            .arg("wan")
            .args(["--a", a.0, "--a-device", a.1, "--a-mtu", &link.forward.mtu.to_string()])
            .args(["--b", b.0, "--b-device", b.1, "--b-mtu", &link.back.mtu.to_string()])
            .args(["--seed", &link.seed.to_string()])
            .args(["--run", &set(Ways::Forward, &link.forward)?])
            .args(["--run", &set(Ways::Back, &link.back)?]);
        let (dialogue, ready) = Dialogue::start("blaze-wan", command, ANSWER)?;
        anyhow::ensure!(ready["ready"] == true, "blaze-wan says {ready}");
        Ok(Self { a: link.a.clone(), b: link.b.clone(), dialogue })
    }

    pub(super) fn seen_from(&self, a: &str, b: &str) -> Option<Link<'_>> {
        let flipped = (a, b) == (self.b.as_str(), self.a.as_str());
        let here = (a, b) == (self.a.as_str(), self.b.as_str());
        (here || flipped).then_some(Link { process: self, flipped })
    }

    fn ask(&self, command: &Command) -> anyhow::Result<Value> {
        let answer = self.dialogue.ask(command, ANSWER)?;
        anyhow::ensure!(answer["ok"] == true, "{command:?}: blaze-wan says {answer}");
        Ok(answer)
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
