//! `blaze echo`.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use blaze_sdk::{Message, Request, SubscribeOptions};
use clap::Args;
use serde_json::{Value, json};
use tokio::sync::mpsc;

use super::{LocalService, LocalTopic, reliability};
use crate::ends::interrupted;
use crate::exit::{CliError, Exit};
use crate::output::{self, Format};

/// Messages that wait for the terminal; more are dropped and told.
const WAITING: usize = 1024;
/// Bytes of a payload that a table shows.
const SHOWN_BYTES: usize = 400;

/// Options of `blaze echo`.
#[derive(Debug, Args)]
pub struct EchoOptions {
    /// Topic and broker.
    #[command(flatten)]
    pub target: LocalTopic,
    /// End after this many messages
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub count: Option<u64>,
    /// Ask for every message: what is lost on the way is sent again
    #[arg(long)]
    pub reliable: bool,
    /// Messages per second at most
    #[arg(long, value_name = "HZ")]
    pub max_rate: Option<f64>,
}

/// Prints messages as they come.
///
/// # Errors
/// [`CliError`]: no broker, no flow, refused, the output was closed.
pub async fn run(options: EchoOptions, format: Format) -> Result<Exit, CliError> {
    let service = LocalService::start(&options.target, "echo").await?;
    let outcome = print_all(&service, &options, format).await;
    service.end().await;
    outcome.map(|()| Exit::Done)
}

async fn print_all(
    service: &LocalService,
    options: &EchoOptions,
    format: Format,
) -> Result<(), CliError> {
    let (tell, mut told) = mpsc::channel(WAITING);
    let dropped = Arc::new(AtomicU64::new(0));
    let counted = Arc::clone(&dropped);
    let subscribe =
        SubscribeOptions { max_rate_hz: options.max_rate, ..SubscribeOptions::default() };
    let request = Request {
        max_rate_hz: options.max_rate,
        reliability: reliability(options.reliable),
        ..Request::new(options.target.topic.clone())
    };
    let take = move |message| {
        if tell.try_send(message).is_err() {
            counted.fetch_add(1, Ordering::Relaxed);
        }
    };
    let (subscription, lease) = service.listen(subscribe, request, take).await?;
    let interruption = interrupted();
    tokio::pin!(interruption);
    let mut printed = 0;
    while options.count.is_none_or(|count| printed < count) {
        tokio::select! {
            stopped = &mut interruption => { stopped?; break }
            message = told.recv() => match message {
                Some(message) => {
                    output::print(&describe(&message, format)?)?;
                    printed += 1;
                }
                None => break,
            }
        }
    }
    let _ = lease.withdraw().await;
    drop(subscription);
    let lost = dropped.load(Ordering::Relaxed);
    if lost > 0 {
        eprintln!(
            "blaze: {lost} messages came faster than they could be printed and were left out"
        );
    }
    Ok(())
}

fn describe(message: &Message, format: Format) -> Result<String, CliError> {
    match format {
        Format::Table => Ok(line(message)),
        Format::Json => serde_json::to_string(&value(message))
            .map_err(|error| CliError::Failed(error.to_string())),
        Format::Yaml => {
            let text = yaml_serde::to_string(&value(message))
                .map_err(|error| CliError::Failed(error.to_string()))?;
            Ok(format!("---\n{text}"))
        }
    }
}

fn value(message: &Message) -> Value {
    let origin = message.origin();
    let mut value = json!({
        "topic": message.topic(), "layer": origin.layer, "node": origin.node,
        "service": origin.service,
        "instance": origin.instance, "writer": message.writer().map(|writer| writer.to_string()),
        "sequence": message.sequence(), "hops": message.hops(),
        "age_ms": (message.age().as_secs_f64() * 1e6).round() / 1e3,
        "encoding": message.encoding(), "bytes": message.payload().len(),
    });
    let payload = match std::str::from_utf8(message.payload()) {
        Ok(text) => ("payload", text.to_owned()),
        Err(_) => ("payload_base64", BASE64.encode(message.payload())),
    };
    if let Value::Object(members) = &mut value {
        members.insert(payload.0.to_owned(), Value::String(payload.1));
    }
    value
}

fn line(message: &Message) -> String {
    let origin = message.origin();
    let from = [&origin.layer, &origin.node, &origin.service]
        .into_iter()
        .filter(|part| !part.is_empty())
        .map(String::as_str)
        .collect::<Vec<_>>()
        .join("/");
    let number = message.sequence().map(|sequence| format!(" #{sequence}")).unwrap_or_default();
    let age = message.age().as_secs_f64() * 1e3;
    let payload = message.payload();
    let shown = match std::str::from_utf8(payload) {
        Ok(text) if text.chars().count() <= SHOWN_BYTES => text.to_owned(),
        Ok(text) => format!(
            "{} … ({} bytes)",
            text.chars().take(SHOWN_BYTES).collect::<String>(),
            payload.len()
        ),
        Err(_) => format!(
            "{} bytes of {}",
            payload.len(),
            if message.encoding().is_empty() { "no text" } else { message.encoding() }
        ),
    };
    let from = if from.is_empty() { "(no header)" } else { &from };
    format!("{from}{number} {age:.1}ms  {shown}")
}
