//! `blaze echo`.

use std::collections::HashSet;
use std::fmt::Write as _;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use blaze_domain::WhyCode;
use blaze_domain::media::Media;
use blaze_flow::types::{ConvertFailure, Encoding};
use blaze_sdk::{Message, Request, SubscribeOptions};
use clap::Args;
use serde_json::{Value, json};
use tokio::sync::mpsc;

use super::types::KnownTypes;
use super::{LocalService, LocalTopic, reliability};
use crate::ends::interrupted;
use crate::exit::{CliError, Exit};
use crate::output::{self, Format};

/// Messages that wait for the terminal; more are dropped and told.
const WAITING: usize = 1024;
/// Bytes of a payload that a table shows.
const SHOWN_BYTES: usize = 400;
/// Elements of an array that a table shows of a decoded message.
const SHOWN_ELEMENTS: usize = 8;
/// Characters of a text that a table shows of a decoded message.
const SHOWN_CHARACTERS: usize = 100;
/// Faults that are printed once; a publisher may name any number of types.
const MAX_PRINTED_ONCE: usize = 1_024;

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
    /// Print ROS 2 messages (CDR) as they are, without decoding them
    #[arg(long)]
    pub raw: bool,
}

/// Decodes the messages of ROS 2.
struct Decoder {
    types: KnownTypes,
    /// Type and code of faults that were printed.
    printed: HashSet<(String, WhyCode)>,
}

/// A message of ROS 2.
#[derive(Debug, PartialEq)]
struct Decoded {
    type_name: String,
    /// As JSON.
    message: Value,
}

impl Decoder {
    fn new(types: KnownTypes) -> Self {
        Self { types, printed: HashSet::new() }
    }

    /// A payload as JSON; `None` if it is no CDR.
    async fn decode(
        &mut self,
        encoding: &str,
        payload: &[u8],
    ) -> Result<Option<Decoded>, ConvertFailure> {
        let Media::Cdr { type_name } = Media::of(encoding) else {
            return Ok(None);
        };
        let failure = |code, detail: &str| ConvertFailure::new(code, detail);
        let type_name = type_name
            .ok_or_else(|| failure(WhyCode::TypeUnknown, "the encoding of CDR names no type"))?;
        let found = self.types.get(Instant::now(), type_name).await?;
        let json = found.convert(Encoding::Json, payload)?.payload;
        let message = serde_json::from_slice(&json)
            .map_err(|error| failure(WhyCode::ConvertError, &error.to_string()))?;
        Ok(Some(Decoded { type_name: type_name.to_owned(), message }))
    }

    /// The sentence about a message that is printed as it is, once for a type and code.
    fn sentence(&mut self, encoding: &str, failure: &ConvertFailure) -> Option<String> {
        if self.printed.len() >= MAX_PRINTED_ONCE {
            self.printed.clear();
        }
        self.printed
            .insert((encoding.to_owned(), failure.code))
            .then(|| format!("{encoding} is printed as it is: {failure}"))
    }
}

/// Prints messages as they come.
///
/// # Errors
/// [`CliError`]: no broker, no flow, refused, the output was closed.
pub async fn run(options: EchoOptions, format: Format) -> Result<Exit, CliError> {
    let file = options.target.node_file()?;
    let decoder = (!options.raw).then(|| Decoder::new(KnownTypes::of(&file)));
    let service = LocalService::start(&file, "echo").await?;
    let outcome = print_all(&service, &options, decoder, format).await;
    service.end().await;
    outcome.map(|()| Exit::Done)
}

async fn print_all(
    service: &LocalService,
    options: &EchoOptions,
    mut decoder: Option<Decoder>,
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
                    let decoded = decode(decoder.as_mut(), &message).await;
                    output::print(&describe(&message, decoded, format)?)?;
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

async fn decode(decoder: Option<&mut Decoder>, message: &Message) -> Option<Decoded> {
    let decoder = decoder?;
    match decoder.decode(message.encoding(), message.payload()).await {
        Ok(decoded) => decoded,
        Err(failure) => {
            if let Some(sentence) = decoder.sentence(message.encoding(), &failure) {
                eprintln!("blaze: {sentence}");
            }
            None
        }
    }
}

fn describe(
    message: &Message,
    decoded: Option<Decoded>,
    format: Format,
) -> Result<String, CliError> {
    match format {
        Format::Table => Ok(line(message, decoded)),
        Format::Json => serde_json::to_string(&value(message, decoded))
            .map_err(|error| CliError::Failed(error.to_string())),
        Format::Yaml => {
            let text = yaml_serde::to_string(&value(message, decoded))
                .map_err(|error| CliError::Failed(error.to_string()))?;
            Ok(format!("---\n{text}"))
        }
    }
}

fn value(message: &Message, decoded: Option<Decoded>) -> Value {
    let origin = message.origin();
    let mut value = json!({
        "topic": message.topic(), "layer": origin.layer, "node": origin.node,
        "service": origin.service,
        "instance": origin.instance, "writer": message.writer().map(|writer| writer.to_string()),
        "sequence": message.sequence(), "hops": message.hops(),
        "age_ms": (message.age().as_secs_f64() * 1e6).round() / 1e3,
        "encoding": message.encoding(), "bytes": message.payload().len(),
    });
    match (decoded, std::str::from_utf8(message.payload())) {
        (Some(Decoded { type_name, message }), _) => {
            value["type"] = Value::String(type_name);
            value["message"] = message;
        }
        (None, Ok(text)) => value["payload"] = json!(text),
        (None, Err(_)) => value["payload_base64"] = json!(BASE64.encode(message.payload())),
    }
    value
}

fn line(message: &Message, decoded: Option<Decoded>) -> String {
    let origin = message.origin();
    let from = [&origin.layer, &origin.node, &origin.service]
        .into_iter()
        .filter(|part| !part.is_empty())
        .map(String::as_str)
        .collect::<Vec<_>>()
        .join("/");
    let number = message.sequence().map(|sequence| format!(" #{sequence}")).unwrap_or_default();
    let age = message.age().as_secs_f64() * 1e3;
    let shown = match decoded {
        Some(decoded) => shortened(&decoded.message),
        None => plain(message.encoding(), message.payload()),
    };
    let from = if from.is_empty() { "(no header)" } else { &from };
    format!("{from}{number} {age:.1}ms  {shown}")
}

/// A payload that was not decoded.
fn plain(encoding: &str, payload: &[u8]) -> String {
    let bytes = payload.len();
    match std::str::from_utf8(payload) {
        Ok(text) => match cut(text, SHOWN_BYTES) {
            Some(begin) => format!("{begin} … ({bytes} bytes)"),
            None => text.to_owned(),
        },
        Err(_) if encoding.is_empty() => format!("{bytes} bytes of no text"),
        Err(_) => format!("{bytes} bytes of {encoding}"),
    }
}

/// The beginning of a text that has more characters.
fn cut(text: &str, characters: usize) -> Option<&str> {
    text.char_indices().nth(characters).map(|(end, _)| &text[..end])
}

/// Compact JSON for people: of long arrays and texts the beginning.
fn shortened(value: &Value) -> String {
    let mut out = String::new();
    shorten(value, &mut out);
    out
}

fn shorten(value: &Value, out: &mut String) {
    match value {
        Value::Array(elements) => {
            out.push('[');
            for (place, element) in elements.iter().take(SHOWN_ELEMENTS).enumerate() {
                out.push_str(if place > 0 { "," } else { "" });
                shorten(element, out);
            }
            if elements.len() > SHOWN_ELEMENTS {
                let _ = write!(out, ",… {} more", elements.len() - SHOWN_ELEMENTS);
            }
            out.push(']');
        }
        Value::Object(members) => {
            out.push('{');
            for (place, (name, member)) in members.iter().enumerate() {
                let _ = write!(out, "{}\"{name}\":", if place > 0 { "," } else { "" });
                shorten(member, out);
            }
            out.push('}');
        }
        Value::String(text) => match cut(text, SHOWN_CHARACTERS) {
            Some(begin) => {
                let more = text[begin.len()..].chars().count();
                let _ = write!(out, "{}… {more} more", json!(begin));
            }
            None => out.push_str(&value.to_string()),
        },
        Value::Null | Value::Bool(_) | Value::Number(_) => out.push_str(&value.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use blaze_domain::node_file::NodeFile;

    use super::*;

    fn decoder() -> Decoder {
        let file = NodeFile::read(&json!({"admin": {"flow": "127.0.0.1:0"}})).unwrap().0;
        Decoder::new(KnownTypes::of(&file))
    }

    #[tokio::test]
    async fn cdr_is_decoded_with_its_members_in_order() {
        let mut decoder = decoder();
        let hello = b"\0\x01\0\0\x06\0\0\0hello\0";
        let encoding = "application/cdr; type=std_msgs/msg/String";
        let decoded = decoder.decode(encoding, hello).await.unwrap().unwrap();
        assert_eq!(decoded.type_name, "std_msgs/msg/String");
        assert_eq!(decoded.message, json!({"data": "hello"}));
        let twist = [&[0, 1, 0, 0][..], &[0; 48]].concat();
        let encoding = "application/cdr; type=geometry_msgs/msg/Twist";
        let decoded = decoder.decode(encoding, &twist).await.unwrap().unwrap();
        let text = decoded.message.to_string();
        assert!(text.starts_with(r#"{"linear":{"x":0.0,"y":0.0,"z":0.0},"angular""#), "{text}");
        assert_eq!(decoder.decode("application/json", b"{}").await, Ok(None));
    }

    #[tokio::test]
    async fn messages_that_cannot_be_decoded_are_reported_once_for_a_type() {
        let mut decoder = decoder();
        for (encoding, payload, code, part) in [
            ("application/cdr; type=a/msg/B", &b""[..], WhyCode::TypeUnknown, "of a/msg/B"),
            ("application/cdr; type=std_msgs/msg/String", b"x", WhyCode::ConvertError, "CDR"),
            ("application/cdr", b"", WhyCode::TypeUnknown, "names no type"),
        ] {
            let failure = decoder.decode(encoding, payload).await.unwrap_err();
            assert_eq!(failure.code, code, "{failure:?}");
            let sentence = decoder.sentence(encoding, &failure).unwrap();
            assert!(sentence.starts_with(encoding) && sentence.contains(part), "{sentence}");
            assert_eq!(decoder.sentence(encoding, &failure), None);
        }
    }

    #[test]
    fn long_arrays_and_texts_are_cut_for_people() {
        let numbers: Vec<u32> = (0..20).collect();
        let value = json!({"a": numbers, "b": "ü".repeat(103), "c": [[1, 2], []], "d": null});
        assert_eq!(
            shortened(&value),
            format!(
                r#"{{"a":[0,1,2,3,4,5,6,7,… 12 more],"b":"{}"… 3 more,"c":[[1,2],[]],"d":null}}"#,
                "ü".repeat(100)
            )
        );
        assert_eq!(plain("", &[0xff]), "1 bytes of no text");
        assert_eq!(plain("", "x".repeat(401).as_bytes()), "x".repeat(400) + " … (401 bytes)");
    }
}
