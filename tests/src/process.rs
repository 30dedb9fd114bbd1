//! Real processes of the product, their output, and their end.

use std::ffi::OsStr;
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write as _};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::Context;
pub use rustix::process::Signal;
use rustix::process::{Pid, kill_process, setpriority_process};

use crate::admin::Admin;
use crate::{memory, network, wait};

/// Lines of output that are kept.
const MAX_LINES: usize = 20_000;
/// For the output of a process that has ended.
const REST: Duration = Duration::from_secs(5);

/// A binary of the workspace, beside the test's own: in `target/<profile>`, while tests lie in its
/// folder `deps`.
///
/// # Errors
/// When it has not been built.
pub fn binary(name: &str) -> anyhow::Result<PathBuf> {
    let own = std::env::current_exe()?;
    let folder = own
        .ancestors()
        .skip(1)
        .find(|folder| !folder.ends_with("deps"))
        .context("this program lies in no folder")?;
    let path = folder.join(name);
    anyhow::ensure!(
        path.exists(),
        "{} is not built: run `cargo build --workspace` first",
        path.display()
    );
    Ok(path)
}

/// Puts this thread, and those that it starts from now on, before all others where the system lets
/// it. For what keeps or measures time: on a busy machine it would be late by a time slice of
/// somebody else.
pub fn hurry() {
    const HIGHEST: i32 = -20;
    // Without the right to it times are less exact on a busy machine, and nothing else.
    let _ = setpriority_process(None, HIGHEST);
}

/// CPU time that a process has used, of all its threads, in the program and in the system for it;
/// in steps of 10 ms.
///
/// # Errors
/// When there is no such process.
pub fn cpu_time(id: u32) -> anyhow::Result<Duration> {
    // CLK_TCK is 100 on every Linux that Rust runs on.
    const TICKS_PER_S: f64 = 100.0;
    let text = std::fs::read_to_string(format!("/proc/{id}/stat"))?;
    let after_name = text.rsplit_once(')').context("no name in /proc/PID/stat")?.1;
    let fields: Vec<&str> = after_name.split_whitespace().collect();
    let ticks = |index: usize| -> anyhow::Result<f64> {
        Ok(fields.get(index).context("a short line")?.parse::<u64>()? as f64)
    };
    Ok(Duration::from_secs_f64((ticks(11)? + ticks(12)?) / TICKS_PER_S))
}

/// What a process holds of the machine now; `None` when there is no such process.
#[must_use]
pub fn usage(id: u32) -> Option<Usage> {
    let status = std::fs::read_to_string(format!("/proc/{id}/status")).ok()?;
    let number = |name: &str| {
        let line = status.lines().find(|line| line.starts_with(name))?;
        line.split_whitespace().nth(1)?.parse::<u64>().ok()
    };
    Some(Usage {
        resident_kib: number("VmRSS:")?,
        threads: number("Threads:")?,
        descriptors: std::fs::read_dir(format!("/proc/{id}/fd")).ok()?.count() as u64,
    })
}

type Lines = Arc<Mutex<Vec<String>>>;

/// What a process holds of its machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct Usage {
    /// Resident memory in KiB.
    pub resident_kib: u64,
    /// Threads.
    pub threads: u64,
    /// Open file descriptors.
    pub descriptors: u64,
}

impl Usage {
    /// Whether it is at most so much more than before.
    #[must_use]
    pub fn exceeds_by_at_most(&self, before: &Self, most: &Self) -> bool {
        self.resident_kib <= before.resident_kib + most.resident_kib
            && self.threads <= before.threads + most.threads
            && self.descriptors <= before.descriptors + most.descriptors
    }
}

impl std::fmt::Display for Usage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{:.1} MiB, {} threads, {} descriptors",
            self.resident_kib as f64 / 1024.0,
            self.threads,
            self.descriptors
        )
    }
}

/// A running process; it is killed when dropped.
pub struct Process {
    child: Child,
    namespace: Option<String>,
    stdout: Lines,
    stderr: Lines,
    readers: Vec<JoinHandle<()>>,
}

impl Process {
    /// Starts a program of the workspace, in a namespace if one is named.
    ///
    /// # Errors
    /// When it is not built or does not start.
    pub fn start(name: &str, arguments: &[&str], namespace: Option<&str>) -> anyhow::Result<Self> {
        Self::launch(name, arguments, namespace, &[], None)
    }

    /// Starts one of the tests' own programs, a subcommand of `blaze-testbed`, in a namespace if
    /// one is named.
    ///
    /// # Errors
    /// When it is not built or does not start.
    pub fn tool(name: &str, arguments: &[&str], namespace: Option<&str>) -> anyhow::Result<Self> {
        Self::start("blaze-testbed", &[&[name], arguments].concat(), namespace)
    }

    /// Starts a program of the workspace with variables of the environment besides those of the
    /// test.
    ///
    /// # Errors
    /// When it is not built or does not start.
    pub fn start_with(
        name: &str,
        arguments: &[&str],
        environment: &[(&str, &OsStr)],
    ) -> anyhow::Result<Self> {
        Self::launch(name, arguments, None, environment, None)
    }

    /// Starts a program of the workspace that says more than is kept: all of its stderr is written
    /// to a file, too.
    ///
    /// # Errors
    /// When it is not built or does not start, or the file cannot be made.
    pub fn start_logged(name: &str, arguments: &[&str], log: &Path) -> anyhow::Result<Self> {
        let file = File::create(log).with_context(|| format!("making {}", log.display()))?;
        Self::launch(name, arguments, None, &[], Some(file))
    }

    fn launch(
        name: &str,
        arguments: &[&str],
        namespace: Option<&str>,
        environment: &[(&str, &OsStr)],
        log: Option<File>,
    ) -> anyhow::Result<Self> {
        let mut command = network::program(namespace, binary(name)?);
        command
            .args(arguments)
            .envs(environment.iter().copied())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        let mut child = command.spawn().with_context(|| format!("starting {name}"))?;
        let log = match log {
            Some(log) => Some(log),
            None => log_file(name, child.id())?,
        };
        let mut readers = Vec::new();
        let stdout = collect(child.stdout.take(), None, &mut readers);
        let stderr = collect(child.stderr.take(), log, &mut readers);
        Ok(Self { child, namespace: namespace.map(str::to_owned), stdout, stderr, readers })
    }

    /// Its process id. `ip netns exec` replaces itself, so it is that of the program also in a
    /// namespace.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// What it has printed on stdout so far.
    #[must_use]
    pub fn stdout(&self) -> Vec<String> {
        self.stdout.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// What it has printed on stderr so far.
    #[must_use]
    pub fn stderr(&self) -> Vec<String> {
        self.stderr.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Waits for the line `ready node=NODE admin=ADDRESS` on stderr and gives the admin port in it.
    ///
    /// # Errors
    /// When the line does not come in time or the process ends.
    pub fn node_ready(&mut self, node: &str, deadline: Duration) -> anyhow::Result<Admin> {
        let start = format!("ready node={node} ");
        let line = wait::until_some(
            &format!("`{start}`"),
            deadline,
            || self.stderr().into_iter().find(|line| line.starts_with(&start)),
            || self.tail(),
        )?;
        Ok(Admin { address: address_in(&line, "admin")?, namespace: self.namespace.clone() })
    }

    /// Waits for the line `ready rest=ADDRESS …` on stdout and gives one of the addresses in it.
    ///
    /// # Errors
    /// When the line does not come in time, or has no such address.
    pub fn ready_at(&self, name: &str, deadline: Duration) -> anyhow::Result<SocketAddr> {
        let line = wait::until_some(
            "the ready line",
            deadline,
            || self.stdout().into_iter().find(|line| line.starts_with("ready ")),
            || self.tail(),
        )?;
        address_in(&line, name)
    }

    /// Kills it at once, as a crash would, and waits for its end.
    ///
    /// # Errors
    /// When it cannot be killed.
    pub fn kill(&mut self) -> anyhow::Result<()> {
        self.child.kill()?;
        self.child.wait()?;
        Ok(())
    }

    /// Asks it to end (SIGTERM) and gives its exit code.
    ///
    /// # Errors
    /// When it does not end in time.
    pub fn terminate(&mut self, deadline: Duration) -> anyhow::Result<Option<i32>> {
        self.ask_to_end()?;
        self.exit(deadline)
    }

    /// Asks it to end (SIGTERM) and does not wait.
    ///
    /// # Errors
    /// When nobody can be asked.
    pub fn ask_to_end(&self) -> anyhow::Result<()> {
        self.signal(Signal::TERM)
    }

    /// Sends it a signal.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn signal(&self, signal: Signal) -> anyhow::Result<()> {
        let pid = Pid::from_raw(i32::try_from(self.child.id())?).context("no process id")?;
        kill_process(pid, signal).with_context(|| format!("{signal:?} to a process"))
    }

    /// Waits for its end and gives its exit code.
    ///
    /// # Errors
    /// When it does not end in time.
    pub fn exit(&mut self, deadline: Duration) -> anyhow::Result<Option<i32>> {
        Ok(self.end(deadline)?.code())
    }

    /// Waits for its end and gives all that the system says of it; what it printed has been read by
    /// then.
    ///
    /// # Errors
    /// When it does not end in time.
    pub fn end(&mut self, deadline: Duration) -> anyhow::Result<ExitStatus> {
        let status = wait::until_some(
            "the end of the process",
            deadline,
            || self.child.try_wait().ok().flatten(),
            || "it still runs".to_owned(),
        )?;
        // A child of its own may hold the pipes for longer.
        let is_read = || self.readers.iter().all(JoinHandle::is_finished);
        let _ = wait::until("the end of its output", REST, is_read, String::new);
        Ok(status)
    }

    /// How often something stands in its memory, in use or not. Needs the right to look into it.
    ///
    /// # Errors
    /// When the system does not let anybody look.
    pub fn count_in_memory(&self, needle: &[u8]) -> anyhow::Result<usize> {
        memory::count(self.child.id(), needle)
    }

    /// Resident memory in bytes; `None` when it does not run.
    #[must_use]
    pub fn resident_bytes(&self) -> Option<u64> {
        Some(self.usage()?.resident_kib * 1024)
    }

    /// What it holds of the machine now; `None` when it does not run.
    #[must_use]
    pub fn usage(&self) -> Option<Usage> {
        usage(self.child.id())
    }

    /// Whether it still runs.
    pub fn runs(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    /// The last lines of its output, for a test that failed.
    #[must_use]
    pub fn tail(&self) -> String {
        let last = |lines: Vec<String>| {
            let from = lines.len().saturating_sub(30);
            lines[from..].join("\n")
        };
        format!("stdout:\n{}\nstderr:\n{}", last(self.stdout()), last(self.stderr()))
    }
}

fn address_in(line: &str, name: &str) -> anyhow::Result<SocketAddr> {
    let mut words = line.split_whitespace().filter_map(|word| word.split_once('='));
    let word = words.find(|(found, _)| *found == name);
    Ok(word.with_context(|| format!("no {name} in {line:?}"))?.1.parse()?)
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Where all that a process says on stderr is written, besides what is kept: in the folder
/// `BLAZE_TEST_LOGS`, if that is given. For runs that are too long to keep everything.
fn log_file(name: &str, id: u32) -> anyhow::Result<Option<File>> {
    let Some(folder) = std::env::var_os("BLAZE_TEST_LOGS") else {
        return Ok(None);
    };
    std::fs::create_dir_all(&folder)?;
    let path = PathBuf::from(folder).join(format!("{name}-{id}.log"));
    let file = File::create(&path).with_context(|| format!("making {}", path.display()))?;
    Ok(Some(file))
}

fn collect(
    pipe: Option<impl Read + Send + 'static>,
    mut log: Option<File>,
    readers: &mut Vec<JoinHandle<()>>,
) -> Lines {
    let lines = Lines::default();
    let Some(pipe) = pipe else { return lines };
    let kept = Arc::clone(&lines);
    readers.push(std::thread::spawn(move || {
        for line in BufReader::new(pipe).lines().map_while(Result::ok) {
            if let Some(log) = &mut log {
                // A full disk is no fault of the process.
                let _ = writeln!(log, "{line}");
            }
            let mut kept = kept.lock().unwrap_or_else(PoisonError::into_inner);
            if kept.len() >= MAX_LINES {
                kept.drain(..MAX_LINES / 2);
            }
            kept.push(line);
        }
    }));
    lines
}
