//! Ends servers and network namespaces that outlive the test's process, which may die without
//! running a destructor (a signal, an abort, a server kept in a static).
//!
//! One shell per process reads a pipe that only this process holds. When the pipe closes, the
//! process has gone, and the shell kills what was not taken off its list. A process counts only
//! while its start time is the one that was noted, so that a number given again by the system is
//! left alone.

use std::io::Write as _;
use std::os::unix::process::CommandExt as _;
use std::path::Path;
use std::process::{ChildStdin, Command, Stdio};

use anyhow::Context as _;
use parking_lot::Mutex;

const SCRIPT: &str = r#"
trap '' INT TERM HUP
declare -A started folder namespace
while IFS=' ' read -r verb name time path; do
  case "$verb" in
    add) started[$name]=$time; folder[$name]=$path ;;
    remove) unset "started[$name]" "folder[$name]" ;;
    add-namespace) namespace[$name]=1 ;;
    remove-namespace) unset "namespace[$name]" ;;
  esac
done
for pid in "${!started[@]}"; do
  read -r -a stat 2>/dev/null < "/proc/$pid/stat" && [ "${stat[21]}" = "${started[$pid]}" ] && kill -KILL "$pid"
  rm -rf -- "${folder[$pid]}"
done
for name in "${!namespace[@]}"; do
  for pid in $(ip netns pids "$name" 2>/dev/null); do kill -KILL "$pid"; done
  ip netns del "$name" 2>/dev/null
done
"#;

static GUARD: Mutex<Option<ChildStdin>> = Mutex::new(None);

/// From now on the process ends with this one, and its folder goes with it.
///
/// # Errors
/// When there is no such process, or no guard can be started.
pub(crate) fn add(pid: u32, folder: &Path) -> anyhow::Result<()> {
    let start = start_time(pid).with_context(|| format!("process {pid} has gone"))?;
    tell(&format!("add {pid} {start} {}\n", folder.display()))
}

/// The process has ended and was reaped.
pub(crate) fn remove(pid: u32) {
    // A guard that is gone has nothing to forget.
    let _ = tell(&format!("remove {pid}\n"));
}

/// From now on the namespace goes with this process, and so does what runs in it.
///
/// # Errors
/// When no guard can be started.
pub(crate) fn add_namespace(name: &str) -> anyhow::Result<()> {
    tell(&format!("add-namespace {name}\n"))
}

/// The namespace has gone.
pub(crate) fn remove_namespace(name: &str) {
    let _ = tell(&format!("remove-namespace {name}\n"));
}

fn tell(line: &str) -> anyhow::Result<()> {
    let mut guard = GUARD.lock();
    let pipe = match guard.as_mut() {
        Some(pipe) => pipe,
        None => guard.insert(start()?),
    };
    pipe.write_all(line.as_bytes()).context("the guard of this process has gone")
}

fn start() -> anyhow::Result<ChildStdin> {
    // A group of its own: Ctrl-C in the terminal must not end the guard before its work.
    let mut child = Command::new("bash")
        .args(["-c", SCRIPT])
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .process_group(0)
        .spawn()
        .context("starting the guard of this process")?;
    child.stdin.take().context("the guard has no pipe")
}

/// Clock ticks from the start of the machine to that of the process (field 22 of `/proc/PID/stat`).
fn start_time(pid: u32) -> Option<u64> {
    let text = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The name in parentheses may hold blanks; after it comes field 3.
    text.rsplit_once(')')?.1.split_whitespace().nth(19)?.parse().ok()
}
