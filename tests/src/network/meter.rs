//! What an interface counts, over time.

use std::process::Command;

use anyhow::Context as _;

/// What an interface had sent at some time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// When the counter was read: seconds since 1970, right within [`Sample::MAX_ERROR_S`].
    pub at_s: f64,
    /// Ethernet payload bytes.
    pub bytes: u64,
    /// Packets.
    pub packets: u64,
}

impl Sample {
    /// Samples whose time is less certain, because their reader had to wait for the processor, are left out.
    pub const MAX_ERROR_S: f64 = 0.000_5;
}

/// Reads a host's counter again and again, from a process in its namespace so that no start of a process stands between
/// the clock and the counter. It ends when dropped.
pub struct Meter {
    child: std::process::Child,
    samples: std::sync::Arc<std::sync::Mutex<Vec<Sample>>>,
}

impl Meter {
    /// Starts to read the counter of `v0` every `period_ms`.
    ///
    /// # Errors
    /// When the namespace has gone.
    pub fn start(namespace: &str, period_ms: u32) -> anyhow::Result<Self> {
        let script = format!(
            "cd /sys/class/net/v0/statistics; exec 3<> <(:); \
             while :; do read -r p < tx_packets; s=$EPOCHREALTIME; read -r b < tx_bytes; echo $s $EPOCHREALTIME $b $p; \
             read -r -t {}.{:03} -u 3; done",
            period_ms / 1000,
            period_ms % 1000
        );
        let mut child = Command::new("ip")
            .args(["netns", "exec", namespace, "bash", "-c", &script])
            .stdin(std::process::Stdio::null())
            .stdout(std::process::Stdio::piped())
            .spawn()?;
        let samples = std::sync::Arc::<std::sync::Mutex<Vec<Sample>>>::default();
        let kept = std::sync::Arc::clone(&samples);
        let out = child.stdout.take().context("no output")?;
        std::thread::spawn(move || {
            use std::io::BufRead as _;
            for line in std::io::BufReader::new(out).lines().map_while(Result::ok) {
                let mut kept = kept.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                kept.extend(parse_sample(&line));
            }
        });
        Ok(Self { child, samples })
    }

    /// What was read so far.
    #[must_use]
    pub fn samples(&self) -> Vec<Sample> {
        self.samples
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner)
            .clone()
    }
}

impl Drop for Meter {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn parse_sample(line: &str) -> Option<Sample> {
    const ETHERNET_HEADER: u64 = 14;
    let mut words = line.split_whitespace();
    let before: f64 = words.next()?.parse().ok()?;
    let after: f64 = words.next()?.parse().ok()?;
    let bytes: u64 = words.next()?.parse().ok()?;
    let packets: u64 = words.next()?.parse().ok()?;
    if after - before > 2.0 * Sample::MAX_ERROR_S {
        return None;
    }
    Some(Sample {
        at_s: (before + after) / 2.0,
        bytes: bytes.saturating_sub(packets * ETHERNET_HEADER),
        packets,
    })
}
