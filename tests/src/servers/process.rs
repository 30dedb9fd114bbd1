//! A server process: its log, its end, and waiting until it answers.

use std::fs::File;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use parking_lot::Mutex;
use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

use crate::guard;

/// Lines of the log that go into an error.
const LOG_LINES: usize = 20;

/// A server with a folder of its own. It can be started again after its end, in the same folder.
/// Killed when dropped.
pub(super) struct ServerProcess {
    name: &'static str,
    folder: TempDir,
    child: Mutex<Option<Running>>,
}

struct Running {
    child: Child,
    /// Length of the log when it was started.
    log_start: u64,
}

impl ServerProcess {
    /// Makes the folder; starts nothing yet.
    ///
    /// # Errors
    /// When the folder for temporary files cannot be written.
    pub(super) fn new(name: &'static str) -> anyhow::Result<Self> {
        Self::new_in(name, None)
    }

    /// The same with a folder inside another; without one among temporary files.
    ///
    /// # Errors
    /// When the other folder cannot be written.
    pub(super) fn new_in(name: &'static str, parent: Option<&Path>) -> anyhow::Result<Self> {
        let mut builder = tempfile::Builder::new();
        let prefix = format!("blaze-test-{name}-");
        builder.prefix(&prefix);
        let folder = match parent {
            Some(parent) => builder.tempdir_in(parent),
            None => builder.tempdir(),
        };
        let folder = folder.context("a folder for a server")?;
        let child = Mutex::new(None);
        Ok(Self { name, folder, child })
    }

    /// Its folder: configuration, data, log.
    pub(super) fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// Starts the program; its output is added to the log.
    ///
    /// # Errors
    /// When it does not start or runs already.
    pub(super) fn spawn(&self, mut command: Command) -> anyhow::Result<()> {
        let mut child = self.child.lock();
        anyhow::ensure!(child.is_none(), "{} runs already", self.name);
        let log = File::options().create(true).append(true).open(self.log_path())?;
        let log_start = log.metadata()?.len();
        command
            .current_dir(self.folder())
            .stdin(Stdio::null())
            .stdout(log.try_clone()?)
            .stderr(log)
            .process_group(0);
        let started = command.spawn().with_context(|| format!("starting {}", self.name))?;
        let pid = started.id();
        *child = Some(Running { child: started, log_start });
        guard::add(pid, self.folder())
    }

    /// Asks every 10 ms until the server answers. Returns how long it took.
    ///
    /// # Errors
    /// When the deadline passes or the process ends; with the last lines of its log.
    pub(super) fn wait_ready(
        &self,
        deadline: Duration,
        mut answers: impl FnMut() -> bool,
    ) -> anyhow::Result<Duration> {
        let start = Instant::now();
        loop {
            if answers() {
                return Ok(start.elapsed());
            }
            if let Some(end) = self.ended()? {
                anyhow::bail!("{} ended ({end}). Its log:\n{}", self.name, self.log_tail());
            }
            if start.elapsed() > deadline {
                anyhow::bail!(
                    "{} does not answer within {deadline:?}. Its log:\n{}",
                    self.name,
                    self.log_tail()
                );
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// How it ended, if it did so by itself.
    fn ended(&self) -> anyhow::Result<Option<String>> {
        match self.child.lock().as_mut() {
            None => Ok(Some("it was not started".to_owned())),
            Some(running) => Ok(running.child.try_wait()?.map(|status| status.to_string())),
        }
    }

    /// SIGKILL, and waits for its end. Nothing happens when it does not run.
    ///
    /// # Errors
    /// When the system refuses.
    pub(super) fn kill(&self) -> anyhow::Result<()> {
        let Some(Running { mut child, .. }) = self.child.lock().take() else {
            return Ok(());
        };
        child.kill().with_context(|| format!("killing {}", self.name))?;
        child.wait()?;
        guard::remove(child.id());
        Ok(())
    }

    /// SIGSTOP, and waits until it stands still: it keeps its connections and answers nothing.
    ///
    /// # Errors
    /// When it does not run.
    pub(super) fn freeze(&self) -> anyhow::Result<()> {
        self.signal(Signal::STOP)?;
        crate::wait::until(
            "a frozen server",
            Duration::from_secs(5),
            || self.state() == Some('T'),
            || format!("state {:?}", self.state()),
        )?;
        Ok(())
    }

    /// SIGCONT: it goes on as if nothing had been.
    ///
    /// # Errors
    /// When it does not run.
    pub(super) fn thaw(&self) -> anyhow::Result<()> {
        self.signal(Signal::CONT)
    }

    fn signal(&self, signal: Signal) -> anyhow::Result<()> {
        // The lock is held so that the process cannot be reaped, and its number given away, in
        // between.
        let running = self.child.lock();
        let running = running.as_ref().with_context(|| format!("{} does not run", self.name))?;
        let pid = Pid::from_raw(i32::try_from(running.child.id())?).context("no process id")?;
        kill_process(pid, signal).with_context(|| format!("{signal:?} to {}", self.name))
    }

    /// `R`, `S`, `T` (stopped) and so on, as in `/proc/PID/stat`.
    fn state(&self) -> Option<char> {
        let text = std::fs::read_to_string(format!("/proc/{}/stat", self.pid()?)).ok()?;
        text.rsplit_once(')')?.1.trim_start().chars().next()
    }

    /// Its process id while it runs.
    pub(super) fn pid(&self) -> Option<u32> {
        self.child.lock().as_ref().map(|running| running.child.id())
    }

    /// Resident memory in KiB.
    ///
    /// # Errors
    /// When it does not run.
    pub(super) fn rss_kib(&self) -> anyhow::Result<u64> {
        let pid = self.pid().with_context(|| format!("{} does not run", self.name))?;
        let status = std::fs::read_to_string(format!("/proc/{pid}/status"))?;
        let line = status.lines().find(|line| line.starts_with("VmRSS:"));
        let number = line.and_then(|line| line.split_whitespace().nth(1));
        Ok(number.with_context(|| format!("{} has no memory", self.name))?.parse()?)
    }

    fn log_path(&self) -> PathBuf {
        self.folder().join("log")
    }

    /// Whether the process that runs now has written this.
    pub(super) fn has_logged(&self, words: &str) -> bool {
        let start = self.child.lock().as_ref().map(|running| running.log_start);
        let text = std::fs::read(self.log_path()).unwrap_or_default();
        let new = start.and_then(|start| text.get(usize::try_from(start).ok()?..));
        new.is_some_and(|new| String::from_utf8_lossy(new).contains(words))
    }

    /// The last lines of its log.
    pub(super) fn log_tail(&self) -> String {
        let text = std::fs::read(self.log_path()).unwrap_or_default();
        let text = String::from_utf8_lossy(&text);
        let lines: Vec<&str> = text.lines().collect();
        lines[lines.len().saturating_sub(LOG_LINES)..].join("\n")
    }
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        // A destructor has nobody to tell; the guard tries once more when this process ends.
        let _ = self.kill();
    }
}

/// Runs a command to its end, or kills it at the deadline: a client must not wait for ever for a
/// frozen server.
///
/// # Errors
/// When it does not start or does not end in time.
pub(super) fn output_within(mut command: Command, deadline: Duration) -> anyhow::Result<Output> {
    let mut child = command
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .with_context(|| format!("starting {:?}", command.get_program()))?;
    let stdout = read_all(child.stdout.take());
    let stderr = read_all(child.stderr.take());
    let status = crate::wait::until_some(
        "the end of a client",
        deadline,
        || child.try_wait().ok().flatten(),
        || format!("{command:?} still runs"),
    );
    if status.is_err() {
        child.kill()?;
        child.wait()?;
    }
    let gone = |_| anyhow::anyhow!("a reader of the output has panicked");
    let (stdout, stderr) = (stdout.join().map_err(gone)?, stderr.join().map_err(gone)?);
    let status = status?;
    Ok(Output { status, stdout, stderr })
}

fn read_all(pipe: Option<impl std::io::Read + Send + 'static>) -> std::thread::JoinHandle<Vec<u8>> {
    std::thread::spawn(move || {
        let mut bytes = Vec::new();
        if let Some(mut pipe) = pipe {
            // What was read before an error is still worth showing.
            let _ = pipe.read_to_end(&mut bytes);
        }
        bytes
    })
}
