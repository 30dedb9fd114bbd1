//! The quality of one direction of a link.

use std::time::Duration;

use super::CommandError;

const MAX_DELAY: Duration = Duration::from_secs(60);
/// Bit/s. Slower, a packet of 64 KiB would take minutes.
const MIN_RATE: u64 = 1_000;
const MAX_QUEUE: u64 = 1_000_000_000;
/// What every IPv4 host must take.
const MIN_MTU: u32 = 68;
const MAX_MTU: u32 = 65_535;

/// The quality of one direction of a link. The default is a wire: no delay, no loss, no limit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shape {
    /// One way; at most 60 s.
    pub delay: Duration,
    /// The delay wanders by as much to both sides; never below zero.
    pub jitter: Duration,
    /// The delay is drawn anew for each packet, so that packets overtake each other. Without it their order is kept.
    pub reorder: bool,
    /// Probability that a packet is lost, 0 to 1.
    pub loss: f64,
    /// Bit/s of IP packets, 1 k = 1000; `None` = as fast as the machine.
    pub rate: Option<u64>,
    /// Bytes that may wait for the rate; what comes beyond them is dropped.
    pub queue: u64,
    /// Larger packets are dropped without a word, as a router behind a firewall does. Bytes, IP header included.
    pub mtu: u32,
}

impl Default for Shape {
    fn default() -> Self {
        Self {
            delay: Duration::ZERO,
            jitter: Duration::ZERO,
            reorder: false,
            loss: 0.0,
            rate: None,
            queue: 1_000_000,
            mtu: 1500,
        }
    }
}

impl Shape {
    /// A link to a cloud: 25 ± 5 ms, 0.01 % loss, 160 Mbit/s with a queue of 250 kB.
    #[must_use]
    pub fn to_cloud() -> Self {
        Self {
            delay: Duration::from_millis(25),
            jitter: Duration::from_millis(5),
            loss: 0.000_1,
            rate: Some(160_000_000),
            queue: 250_000,
            ..Self::default()
        }
    }

    /// All of it as changes, so that it can be told in words.
    #[must_use]
    pub fn changes(&self) -> Vec<Change> {
        vec![
            Change::Delay(self.delay),
            Change::Jitter(self.jitter),
            Change::Reorder(self.reorder),
            Change::Loss(self.loss),
            Change::Rate(self.rate),
            Change::Queue(self.queue),
            Change::Mtu(self.mtu),
        ]
    }

    /// The same with one thing changed.
    #[must_use]
    pub fn with(mut self, change: Change) -> Self {
        match change {
            Change::Delay(delay) => self.delay = delay,
            Change::Jitter(jitter) => self.jitter = jitter,
            Change::Reorder(reorder) => self.reorder = reorder,
            Change::Loss(loss) => self.loss = loss,
            Change::Rate(rate) => self.rate = rate,
            Change::Queue(queue) => self.queue = queue,
            Change::Mtu(mtu) => self.mtu = mtu,
        }
        self
    }
}

/// One thing about a direction that changes while it runs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Change {
    /// [`Shape::delay`]
    Delay(Duration),
    /// [`Shape::jitter`]
    Jitter(Duration),
    /// [`Shape::reorder`]
    Reorder(bool),
    /// [`Shape::loss`]
    Loss(f64),
    /// [`Shape::rate`]
    Rate(Option<u64>),
    /// [`Shape::queue`]
    Queue(u64),
    /// [`Shape::mtu`]
    Mtu(u32),
}

impl Change {
    /// From a name and a value, such as `rate` and `160M`. Delays are in ms, the rate is in bit/s, queue and MTU are in
    /// bytes; k, M and G are powers of 1000.
    ///
    /// # Errors
    /// When there is no such name, or the value is out of its range.
    pub fn parse(name: &str, value: &str) -> Result<Self, CommandError> {
        let change = match name {
            "delay" => milliseconds(value).map(Self::Delay),
            "jitter" => milliseconds(value).map(Self::Jitter),
            "reorder" => match value {
                "on" => Some(Self::Reorder(true)),
                "off" => Some(Self::Reorder(false)),
                _ => None,
            },
            "loss" => value
                .parse()
                .ok()
                .filter(|loss| (0.0..=1.0).contains(loss))
                .map(Self::Loss),
            "rate" if value == "none" => Some(Self::Rate(None)),
            "rate" => amount(value)
                .filter(|rate| *rate >= MIN_RATE)
                .map(|rate| Self::Rate(Some(rate))),
            "queue" => amount(value).filter(|bytes| *bytes <= MAX_QUEUE).map(Self::Queue),
            "mtu" => value
                .parse()
                .ok()
                .filter(|mtu| (MIN_MTU..=MAX_MTU).contains(mtu))
                .map(Self::Mtu),
            _ => return Err(CommandError::UnknownSetting(name.to_owned())),
        };
        change.ok_or_else(|| CommandError::Value {
            setting: name.to_owned(),
            value: value.to_owned(),
        })
    }
}

impl std::fmt::Display for Change {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Delay(delay) => write!(f, "delay {}", Milliseconds(*delay)),
            Self::Jitter(jitter) => write!(f, "jitter {}", Milliseconds(*jitter)),
            Self::Reorder(reorder) => f.write_str(if *reorder { "reorder on" } else { "reorder off" }),
            Self::Loss(loss) => write!(f, "loss {loss}"),
            Self::Rate(Some(rate)) => write!(f, "rate {rate}"),
            Self::Rate(None) => f.write_str("rate none"),
            Self::Queue(bytes) => write!(f, "queue {bytes}"),
            Self::Mtu(bytes) => write!(f, "mtu {bytes}"),
        }
    }
}

/// Prints whole microseconds.
struct Milliseconds(Duration);

impl std::fmt::Display for Milliseconds {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let micros = self.0.as_micros();
        write!(f, "{}.{:03}", micros / 1000, micros % 1000)
    }
}

fn milliseconds(text: &str) -> Option<Duration> {
    let value: f64 = text.parse().ok()?;
    let range = 0.0..=MAX_DELAY.as_secs_f64() * 1e3;
    range
        .contains(&value)
        .then(|| Duration::from_micros((value * 1e3).round() as u64))
}

fn amount(text: &str) -> Option<u64> {
    let (digits, factor) = match text.as_bytes().last()? {
        b'k' => (text.strip_suffix('k')?, 1e3),
        b'M' => (text.strip_suffix('M')?, 1e6),
        b'G' => (text.strip_suffix('G')?, 1e9),
        _ => (text, 1.0),
    };
    // Whole numbers are read as such: a float would round large ones.
    if factor == 1.0 {
        return digits.parse().ok();
    }
    let value: f64 = digits.parse().ok()?;
    (0.0..=1e6).contains(&value).then(|| (value * factor).round() as u64)
}
