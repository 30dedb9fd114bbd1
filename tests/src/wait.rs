//! Waits on conditions, with a deadline and words for what was waited for.

use std::time::{Duration, Instant};

/// Asks every 10 ms until there is an answer.
///
/// # Errors
/// Names what was awaited, and what `state` says of the present, when the deadline passes.
pub fn until_some<T>(
    what: &str,
    deadline: Duration,
    mut ask: impl FnMut() -> Option<T>,
    state: impl FnOnce() -> String,
) -> anyhow::Result<T> {
    let start = Instant::now();
    loop {
        if let Some(answer) = ask() {
            return Ok(answer);
        }
        if start.elapsed() > deadline {
            anyhow::bail!("{what}: not within {deadline:?}. {}", state());
        }
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// As [`until_some`], for a plain condition. Returns how long it took.
///
/// # Errors
/// As [`until_some`].
pub fn until(
    what: &str,
    deadline: Duration,
    mut holds: impl FnMut() -> bool,
    state: impl FnOnce() -> String,
) -> anyhow::Result<Duration> {
    let start = Instant::now();
    until_some(what, deadline, || holds().then_some(()), state)?;
    Ok(start.elapsed())
}
