//! `blaze hz`.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_sdk::{Message, Request, SubscribeOptions, SubscriptionStats};
use clap::Args;
use parking_lot::Mutex;
use serde_json::{Value, json};

use super::{LocalService, LocalTopic};
use crate::args::parse_seconds;
use crate::ends::interrupted;
use crate::exit::{CliError, Exit};
use crate::output::{self, Format};

/// Messages that a window holds at most; of more the oldest are left out of the statistics of gaps.
const MAX_WINDOW: usize = 1_000_000;

/// Options of `blaze hz`.
#[derive(Debug, Args)]
pub struct HzOptions {
    /// Topic and broker.
    #[command(flatten)]
    pub target: LocalTopic,
    /// Seconds that a figure looks back
    #[arg(long, value_name = "S", default_value_t = 5.0, value_parser = parse_seconds)]
    pub window: f64,
    /// End after this many figures; one a second
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub count: Option<u64>,
}

/// One message as it arrived.
#[derive(Debug, Clone, Copy)]
struct Arrival {
    at: Instant,
    bytes: usize,
    age: Duration,
}

/// What a window holds.
#[derive(Debug, Clone, PartialEq, Default)]
struct Figures {
    messages: usize,
    rate_hz: f64,
    bytes_per_s: f64,
    /// Shortest, mean, longest gap and its standard deviation, in seconds.
    gaps: Option<(f64, f64, f64, f64)>,
    age_p50_ms: Option<f64>,
}

/// Prints the rate once a second.
///
/// # Errors
/// [`CliError`]: no broker, no flow, refused, the output was closed.
pub async fn run(options: HzOptions, format: Format) -> Result<Exit, CliError> {
    let service = LocalService::start(&options.target.node_file()?, "hz").await?;
    let outcome = measure(&service, &options, format).await;
    service.end().await;
    outcome.map(|()| Exit::Done)
}

async fn measure(
    service: &LocalService,
    options: &HzOptions,
    format: Format,
) -> Result<(), CliError> {
    let topic = &options.target.topic;
    let arrivals: Arc<Mutex<VecDeque<Arrival>>> = Arc::default();
    let noted = Arc::clone(&arrivals);
    let take = move |message: Message| {
        let mut noted = noted.lock();
        if noted.len() == MAX_WINDOW {
            noted.pop_front();
        }
        noted.push_back(Arrival {
            at: Instant::now(),
            bytes: message.payload().len(),
            age: message.age(),
        });
    };
    let request = Request::new(topic.clone());
    let (subscription, lease) = service.listen(SubscribeOptions::default(), request, take).await?;
    let window = Duration::from_secs_f64(options.window);
    let interruption = interrupted();
    tokio::pin!(interruption);
    let begin = Instant::now();
    let mut seconds = tokio::time::interval_at(
        tokio::time::Instant::now() + Duration::from_secs(1),
        Duration::from_secs(1),
    );
    let mut printed = 0;
    while options.count.is_none_or(|count| printed < count) {
        tokio::select! {
            stopped = &mut interruption => { stopped?; break }
            _ = seconds.tick() => {
                let now = Instant::now();
                let figures = {
                    let mut arrivals = arrivals.lock();
                    while arrivals.front()
                        .is_some_and(|arrival| now.saturating_duration_since(arrival.at) > window) {
                        arrivals.pop_front();
                    }
                    figures(arrivals.make_contiguous(),
                        window.min(now.saturating_duration_since(begin)))
                };
                output::print(&describe(topic.as_str(), &figures, &subscription.stats(), format)?)?;
                printed += 1;
            }
        }
    }
    let _ = lease.withdraw().await;
    Ok(())
}

fn figures(arrivals: &[Arrival], window: Duration) -> Figures {
    let seconds = window.as_secs_f64().max(1e-9);
    let gaps: Vec<f64> = arrivals
        .windows(2)
        .map(|pair| pair[1].at.saturating_duration_since(pair[0].at).as_secs_f64())
        .collect();
    let gaps = (!gaps.is_empty()).then(|| {
        let mean = gaps.iter().sum::<f64>() / gaps.len() as f64;
        let variance = gaps.iter().map(|gap| (gap - mean).powi(2)).sum::<f64>() / gaps.len() as f64;
        let shortest = gaps.iter().copied().fold(f64::INFINITY, f64::min);
        let longest = gaps.iter().copied().fold(0.0, f64::max);
        (shortest, mean, longest, variance.sqrt())
    });
    let mut ages: Vec<Duration> = arrivals.iter().map(|arrival| arrival.age).collect();
    ages.sort_unstable();
    Figures {
        messages: arrivals.len(),
        // From the mean gap where there is one: a window that has just begun would say too little.
        rate_hz: gaps
            .map_or(arrivals.len() as f64 / seconds, |(_, mean, _, _)| 1.0 / mean.max(1e-9)),
        bytes_per_s: arrivals.iter().map(|arrival| arrival.bytes as f64).sum::<f64>() / seconds,
        gaps,
        age_p50_ms: ages.get(ages.len() / 2).map(|age| age.as_secs_f64() * 1e3),
    }
}

fn describe(
    topic: &str,
    figures: &Figures,
    stats: &SubscriptionStats,
    format: Format,
) -> Result<String, CliError> {
    if format == Format::Table {
        let Some((shortest, _, longest, deviation)) = figures.gaps else {
            return Ok(format!(
                "no new messages ({} received, {} lost)",
                stats.received, stats.lost
            ));
        };
        return Ok(format!(
            "{:.2} Hz  {}/s  gaps {:.1} to {:.1} ms, deviation {:.2} ms  age p50 {} ms  lost {}",
            figures.rate_hz,
            output::bytes(figures.bytes_per_s),
            shortest * 1e3,
            longest * 1e3,
            deviation * 1e3,
            output::number(figures.age_p50_ms, 2),
            stats.lost
        ));
    }
    let milliseconds = |seconds: f64| json!((seconds * 1e6).round() / 1e3);
    let value = json!({
        "topic": topic, "rate_hz": (figures.rate_hz * 1e3).round() / 1e3,
        "messages": figures.messages,
        "bytes_per_s": figures.bytes_per_s.round(),
        "gap_ms": figures.gaps.map(|(shortest, mean, longest, deviation)| json!({
            "min": milliseconds(shortest), "mean": milliseconds(mean), "max": milliseconds(longest),
            "deviation": milliseconds(deviation),
        })),
        "age_ms": {"p50": figures.age_p50_ms}, "received": stats.received, "lost": stats.lost,
        "duplicated": stats.duplicated,
    });
    match format {
        Format::Json => {
            serde_json::to_string(&value).map_err(|error| CliError::Failed(error.to_string()))
        }
        Format::Table | Format::Yaml => {
            output::format_object(&value, Format::Yaml, |_: &Value| Ok(String::new()))
                .map(|text| format!("---\n{text}"))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_of_an_even_rate() {
        let begin = Instant::now();
        let arrivals: Vec<Arrival> = (0..100)
            .map(|count| Arrival {
                at: begin + Duration::from_millis(20 * count),
                bytes: 300,
                age: Duration::from_millis(count),
            })
            .collect();
        let figures = figures(&arrivals, Duration::from_secs(2));
        assert_eq!(figures.messages, 100);
        assert!((figures.rate_hz - 50.0).abs() < 0.01, "{figures:?}");
        assert!((figures.bytes_per_s - 15_000.0).abs() < 1.0);
        assert_eq!(figures.age_p50_ms, Some(50.0));
    }

    #[test]
    fn one_or_no_message_has_no_gaps() {
        assert_eq!(figures(&[], Duration::from_secs(1)), Figures::default());
        let one = Arrival { at: Instant::now(), bytes: 10, age: Duration::ZERO };
        let found = figures(&[one], Duration::from_secs(2));
        assert_eq!((found.gaps, found.rate_hz), (None, 0.5));
    }
}
