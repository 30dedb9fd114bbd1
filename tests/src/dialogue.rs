//! A program that answers each line of JSON on stdin with one on stdout.

use std::io::{BufRead as _, BufReader, Write as _};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::Duration;

use anyhow::Context as _;
use parking_lot::Mutex;
use serde::Serialize;
use serde_json::Value;

use crate::wait;

/// Lines that wait to be read: there is one answer for each command.
const LINES: usize = 16;

/// The running program; it is killed when dropped.
pub(crate) struct Dialogue {
    name: String,
    child: Child,
    talk: Mutex<Talk>,
}

struct Talk {
    commands: Option<ChildStdin>,
    answers: Receiver<String>,
}

impl Dialogue {
    /// Starts it and gives its first line, which says that it is ready.
    ///
    /// # Errors
    /// When it does not start, or is not ready in time.
    pub(crate) fn start(
        name: &str,
        mut command: Command,
        ready: Duration,
    ) -> anyhow::Result<(Self, Value)> {
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("starting {name}"))?;
        let commands = child.stdin.take();
        let out = child.stdout.take().with_context(|| format!("no pipe from {name}"))?;
        let (sender, answers) = sync_channel(LINES);
        std::thread::spawn(move || {
            let lines = BufReader::new(out).lines().map_while(Result::ok);
            // It ends with the process, or when nobody asks any more.
            lines.into_iter().try_for_each(|line| sender.send(line)).ok()
        });
        let talk = Mutex::new(Talk { commands, answers });
        let dialogue = Self { name: name.to_owned(), child, talk };
        let first = dialogue.talk.lock().answer(ready);
        let first = first.with_context(|| format!("{name} is not ready"))?;
        Ok((dialogue, first))
    }

    /// The answer to a command.
    ///
    /// # Errors
    /// When the program has gone or does not answer in time.
    pub(crate) fn ask(
        &self,
        command: &impl Serialize,
        deadline: Duration,
    ) -> anyhow::Result<Value> {
        let mut talk = self.talk.lock();
        let command = serde_json::to_string(command)?;
        let input = talk.commands.as_mut();
        let input = input.with_context(|| format!("the input of {} has ended", self.name))?;
        writeln!(input, "{command}").with_context(|| format!("{} has gone", self.name))?;
        talk.answer(deadline).with_context(|| format!("`{command}` to {}", self.name))
    }

    /// Ends its input and waits until it has ended by itself.
    ///
    /// # Errors
    /// When it does not end in time, or says that it failed.
    pub(crate) fn finish(&mut self, deadline: Duration) -> anyhow::Result<()> {
        self.talk.lock().commands = None;
        let status = wait::until_some(
            &format!("the end of {}", self.name),
            deadline,
            || self.child.try_wait().ok().flatten(),
            || "it still runs".to_owned(),
        )?;
        anyhow::ensure!(status.success(), "{} ended with {status}", self.name);
        Ok(())
    }

    /// Its process id.
    pub(crate) fn id(&self) -> u32 {
        self.child.id()
    }
}

impl Talk {
    fn answer(&self, deadline: Duration) -> anyhow::Result<Value> {
        let line = self.answers.recv_timeout(deadline).context("no answer")?;
        serde_json::from_str(&line).with_context(|| line.clone())
    }
}

impl Drop for Dialogue {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
