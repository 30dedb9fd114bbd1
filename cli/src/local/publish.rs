//! `blaze pub`.

use std::io::{BufRead, Read as _};
use std::sync::Arc;
use std::time::Duration;

use blaze_domain::WhyCode;
use blaze_flow::types::{CompiledType, Encoding};
use blaze_sdk::{Advertise, FlowEventKind, FlowEvents, PublishOutcome, Publisher};
use bytes::Bytes;
use clap::Args;
use serde_json::json;
use tokio::sync::mpsc;
use tokio::time::{Instant, MissedTickBehavior, interval, timeout_at};

use super::types::KnownTypes;
use super::{LocalService, LocalTopic, lease_error, reliability};
use crate::ends::interrupted;
use crate::exit::{CliError, Exit};
use crate::output::{self, Format};

/// Longest line of standard input.
const MAX_LINE_BYTES: usize = blaze_domain::MAX_PAYLOAD_BYTES;
/// Lines that are read ahead.
const WAITING_LINES: usize = 64;

/// Options of `blaze pub`.
#[derive(Debug, Args)]
pub struct PublishOptions {
    /// Topic and broker.
    #[command(flatten)]
    pub target: LocalTopic,
    /// What to publish, as it is; `-` publishes each line of standard input
    pub payload: String,
    /// Messages per second; without it one after the other, as fast as they come
    #[arg(long, value_name = "HZ", value_parser = parse_rate)]
    pub rate: Option<f64>,
    /// How many; default 1, or without end with --rate or `-`
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub count: Option<u64>,
    /// Media type of the payload
    #[arg(long, value_name = "TYPE", default_value = "application/json")]
    pub encoding: String,
    /// ROS 2 type of the payload, which is JSON: ROS 2 nodes get it as a message of this type
    #[arg(long = "type", value_name = "PKG/msg/NAME", value_parser = parse_type)]
    #[arg(conflicts_with = "encoding")]
    pub type_name: Option<String>,
    /// Ask that lost messages are sent again
    #[arg(long)]
    pub reliable: bool,
    /// How long to wait for a bridge before the first message; volatile messages that nobody
    /// carries yet are gone
    #[arg(long, value_name = "SECONDS", default_value_t = 1.0)]
    pub wait: f64,
}

fn parse_rate(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(rate) if rate.is_finite() && rate > 0.0 && rate <= 1e6 => Ok(rate),
        _ => Err("a rate is above 0 and at most 1000000".to_owned()),
    }
}

pub(super) fn parse_type(text: &str) -> Result<String, String> {
    let is_name = |part: &&str| {
        part.starts_with(|first: char| first.is_ascii_alphabetic())
            && part.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
    };
    let parts: Vec<&str> = text.split('/').collect();
    match parts[..] {
        _ if !parts.iter().all(is_name) => {}
        [_, "msg" | "srv" | "action", _] => return Ok(text.to_owned()),
        [package, name] => return Err(format!("did you mean {package}/msg/{name}?")),
        _ => {}
    }
    Err("it is PKG/msg/NAME, for example geometry_msgs/msg/Twist".to_owned())
}

/// Publishes.
///
/// # Errors
/// [`CliError`]: no broker, no flow, refused.
pub async fn run(options: PublishOptions, format: Format) -> Result<Exit, CliError> {
    let file = options.target.node_file()?;
    let check = match &options.type_name {
        Some(name) => Check::of(KnownTypes::of(&file), name).await?,
        None => Check(None),
    };
    if options.payload != "-" {
        check.payload(options.payload.as_bytes())?;
    }
    let service = LocalService::start(&file, "pub").await?;
    let outcome = publish(&service, &options, &check).await;
    service.end().await;
    let sent = outcome?;
    let text = match format {
        Format::Table => format!("{} published, {} dropped", sent.published, sent.dropped),
        Format::Json | Format::Yaml => {
            let value = json!({
                "topic": options.target.topic, "published": sent.published, "dropped": sent.dropped,
            });
            output::format_object(&value, format, |_| Ok(String::new()))?
        }
    };
    output::print(&text)?;
    Ok(if sent.dropped == 0 { Exit::Done } else { Exit::Failed })
}

/// Finds faults of JSON before it is published.
struct Check(Option<Arc<CompiledType>>);

impl Check {
    /// Payloads of a type. One without a definition here is not checked, and that is printed.
    async fn of(types: KnownTypes, name: &str) -> Result<Self, CliError> {
        match types.get(std::time::Instant::now(), name).await {
            Ok(found) => Ok(Self(Some(found))),
            Err(failure) if failure.code == WhyCode::TypeUnknown => {
                eprintln!("blaze: the payload is not checked: {failure}");
                Ok(Self(None))
            }
            Err(failure) => Err(CliError::Invalid(failure.to_string())),
        }
    }

    fn payload(&self, json: &[u8]) -> Result<(), CliError> {
        let Some(found) = &self.0 else { return Ok(()) };
        let refused = |failure| CliError::Invalid(format!("no {}: {failure}", found.name));
        found.convert(Encoding::Cdr, json).map(drop).map_err(refused)
    }
}

struct Sent {
    published: u64,
    dropped: u64,
}

async fn publish(
    service: &LocalService,
    options: &PublishOptions,
    check: &Check,
) -> Result<Sent, CliError> {
    let topic = &options.target.topic;
    let kind = service.broker.kind();
    let reliability = reliability(options.reliable);
    let mut events = service.manager.flow().events();
    let advertise = Advertise {
        rate_hz: options.rate,
        encoding: options.encoding.clone(),
        type_name: options.type_name.clone().unwrap_or_default(),
        reliability,
        ..Advertise::new(topic.clone())
    };
    let lease = service
        .manager
        .flow()
        .advertise(advertise)
        .await
        .map_err(|error| lease_error("advertise", topic, kind, &error))?;
    let publisher = service
        .manager
        .broker()
        .publisher(
            topic,
            &blaze_sdk::PublishOptions {
                encoding: options.encoding.clone(),
                reliability,
                ..blaze_sdk::PublishOptions::default()
            },
        )
        .map_err(|error| CliError::Failed(format!("publish {topic}: {error}")))?;
    route_up(&mut events, options).await;
    let mut sent = tokio::select! {
        sent = feed(options, check, &publisher) => sent?,
        stopped = interrupted() =>
            { stopped?; Sent { published: publisher.sequence(), dropped: 0 } }
    };
    // What was taken leaves before the lease ends, because a bridge ends with its lease.
    let until = Instant::now() + Duration::from_secs(5);
    while publisher.queued() > 0 && Instant::now() < until {
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    sent.dropped += publisher.dropped_later();
    if let Err(error) = lease.withdraw().await {
        eprintln!("blaze: withdraw {topic}: {error}; the lease lapses by itself");
    }
    Ok(sent)
}

/// Waits until a bridge begins to carry the topic, at most `--wait`. One that carried it before
/// tells nothing.
async fn route_up(events: &mut FlowEvents, options: &PublishOptions) {
    let wait = Duration::try_from_secs_f64(options.wait).unwrap_or(Duration::ZERO);
    let until = Instant::now() + wait;
    while let Ok(Some(event)) = timeout_at(until, events.next()).await {
        if event.kind == FlowEventKind::RouteUp && event.topic == options.target.topic.as_str() {
            return;
        }
    }
}

async fn feed(
    options: &PublishOptions,
    check: &Check,
    publisher: &Publisher,
) -> Result<Sent, CliError> {
    let mut pace = options.rate.map(|rate| {
        let mut ticks = interval(Duration::from_secs_f64(1.0 / rate));
        // What is late is made up for, so that the rate holds.
        ticks.set_missed_tick_behavior(MissedTickBehavior::Burst);
        ticks
    });
    let endless = options.rate.is_some() || options.payload == "-";
    let most = options.count.unwrap_or(if endless { u64::MAX } else { 1 });
    let mut lines = (options.payload == "-").then(lines_of_input);
    let fixed = Bytes::from(options.payload.clone());
    let mut sent = Sent { published: 0, dropped: 0 };
    while sent.published + sent.dropped < most {
        let payload = match &mut lines {
            None => fixed.clone(),
            Some(lines) => match lines.recv().await {
                Some(line) => {
                    let line = line?;
                    check.payload(&line)?;
                    line
                }
                None => break,
            },
        };
        if let Some(pace) = &mut pace {
            pace.tick().await;
        } else if publisher.queued() > 1_000 {
            // As fast as they come, but never faster than the broker takes them.
            while publisher.queued() > 500 {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        }
        match publisher.publish(payload) {
            PublishOutcome::Taken => sent.published += 1,
            PublishOutcome::Dropped => sent.dropped += 1,
            PublishOutcome::TooLarge => {
                sent.dropped += 1;
                eprintln!("blaze: a payload above 16 MiB was dropped");
            }
        }
    }
    Ok(sent)
}

/// The lines of standard input, without their ends. A thread reads them: one that waits for input
/// that never comes must not hold up the end of the process.
fn lines_of_input() -> mpsc::Receiver<Result<Bytes, CliError>> {
    let (tell, told) = mpsc::channel(WAITING_LINES);
    std::thread::spawn(move || {
        let mut input = std::io::stdin().lock();
        while let Some(line) = next_line(&mut input).transpose() {
            let ends = line.is_err();
            if tell.blocking_send(line).is_err() || ends {
                return;
            }
        }
    });
    told
}

/// The next line; `None` at the end of input.
fn next_line(input: &mut impl BufRead) -> Result<Option<Bytes>, CliError> {
    let mut line = Vec::new();
    let mut most = input.by_ref().take(MAX_LINE_BYTES as u64 + 2);
    let taken = most
        .read_until(b'\n', &mut line)
        .map_err(|error| CliError::Failed(format!("standard input: {error}")))?;
    if taken == 0 {
        return Ok(None);
    }
    if line.last() == Some(&b'\n') {
        line.pop();
    }
    if line.len() > MAX_LINE_BYTES {
        return Err(CliError::Failed("a line of standard input is longer than 16 MiB".to_owned()));
    }
    Ok(Some(Bytes::from(line)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn types_have_three_parts() {
        for good in ["geometry_msgs/msg/Twist", "std_srvs/srv/SetBool_Request"] {
            assert_eq!(parse_type(good).as_deref(), Ok(good));
        }
        let meant = parse_type("std_msgs/String").unwrap_err();
        assert_eq!(meant, "did you mean std_msgs/msg/String?");
        for bad in ["", "Twist", "a/b/C", "/msg/C", "a/msg/", "a/msg/B C", "a/msg/B/C", "a/msg/1"] {
            assert!(parse_type(bad).unwrap_err().contains("PKG/msg/NAME"), "{bad}");
        }
    }

    #[tokio::test]
    async fn a_fault_of_the_json_is_found_before_it_is_published() {
        let tree = json!({"admin": {"flow": "127.0.0.1:0"}});
        let file = blaze_domain::node_file::NodeFile::read(&tree).unwrap().0;
        let check = Check::of(KnownTypes::of(&file), "geometry_msgs/msg/Twist").await.unwrap();
        check.payload(br#"{"linear":{"x":0.5}}"#).unwrap();
        let error = check.payload(br#"{"linear":{"x":"fast"}}"#).unwrap_err();
        assert_eq!(error.exit(), Exit::Invalid);
        assert_eq!(
            error.to_string(),
            "no geometry_msgs/msg/Twist: /linear/x: expected a number, found text"
        );
        let unknown = Check::of(KnownTypes::of(&file), "a/msg/B").await.unwrap();
        unknown.payload(b"anything").unwrap();
    }

    #[test]
    fn lines_come_without_their_ends_and_not_too_long() {
        let mut input: &[u8] = b"one\n\nlast";
        let mut lines = Vec::new();
        while let Some(line) = next_line(&mut input).unwrap() {
            lines.push(line);
        }
        assert_eq!(lines, [Bytes::from("one"), Bytes::new(), Bytes::from("last")]);
        let long = vec![b'x'; MAX_LINE_BYTES + 10];
        assert!(next_line(&mut long.as_slice()).is_err());
    }
}
