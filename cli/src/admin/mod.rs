//! Commands that ask a flow.

mod bridges;
mod nodes;
mod peers;
mod ros2;
mod top;
mod topics;
mod why;
mod why_hops;

use serde::de::DeserializeOwned;
use serde::{Deserialize as _, Deserializer};
use serde_json::Value;

use crate::args::{Destination, FlowAddress, WhyOptions};
use crate::config::client::Client;
use crate::exit::{CliError, Exit};
use crate::http::{Program, get_json};
use crate::output::{self, Format, terminal_width};

pub(crate) use bridges::dropped_text;
pub use bridges::{Bridge, Bridges, DroppedBefore, Place};
pub use top::{TopOptions, View};

/// `blaze topics`.
///
/// # Errors
/// What [`get_json`] says, or an answer that is not as the contract says.
pub async fn topics(flow: &FlowAddress, format: Format) -> Result<Exit, CliError> {
    show(flow, "/v1/topics", format, topics::table).await
}

/// `blaze bridges`.
///
/// # Errors
/// As [`topics`].
pub async fn bridges(flow: &FlowAddress, format: Format) -> Result<Exit, CliError> {
    show(flow, "/v1/bridges", format, bridges::table).await
}

/// `blaze peers`.
///
/// # Errors
/// As [`topics`].
pub async fn peers(flow: &FlowAddress, format: Format) -> Result<Exit, CliError> {
    show(flow, "/v1/peers", format, peers::table).await
}

/// `blaze ros2`.
///
/// # Errors
/// As [`topics`].
pub async fn ros2(flow: &FlowAddress, format: Format) -> Result<Exit, CliError> {
    show(flow, "/v1/ros2", format, ros2::table).await
}

/// `blaze top`.
///
/// # Errors
/// As [`topics`].
pub async fn top(options: &TopOptions, format: Format) -> Result<Exit, CliError> {
    top::run(options, format).await
}

/// `blaze why`: done if the topic flows, even if degraded; else failed.
///
/// # Errors
/// As [`topics`]; of the main service what it refuses.
pub async fn why(options: &WhyOptions, format: Format) -> Result<Exit, CliError> {
    if options.server.is_given() {
        return why_of_server(options, format).await;
    }
    if options.from.is_some() {
        return Err(CliError::Usage(
            "--from is for the main service, which knows all flows: give --server URL".to_owned(),
        ));
    }
    let flow = &options.target.flow;
    let mut path = format!("/v1/why?topic={}", options.topic);
    if let Some(to) = &options.to {
        path.push_str("&to=");
        path.push_str(&to.to_string());
    }
    let value = get_json(flow, &path).await?;
    let answer: why::Why = typed(flow, &value)?;
    let text = output::format_object(&value, format, |_| Ok(why::text(&answer)))?;
    output::print(&text)?;
    if format == Format::Table && answer.code == "no_advertise" {
        suggest_topic(flow, options.topic.as_str()).await;
    }
    Ok(if answer.flows() { Exit::Done } else { Exit::Failed })
}

async fn why_of_server(options: &WhyOptions, format: Format) -> Result<Exit, CliError> {
    let client = Client::of(&options.server)?;
    let text = |end: &Option<Destination>| end.as_ref().map(Destination::to_string);
    let answer = client.why(options.topic.as_str(), text(&options.to), text(&options.from));
    let value = answer.await?;
    let why = why_hops::Why::deserialize(&value).map_err(|error| client.odd(error.to_string()))?;
    let text = output::format_object(&value, format, |_| Ok(why_hops::text(&why)))?;
    output::print(&text)?;
    Ok(if why.verdict.flows() { Exit::Done } else { Exit::Failed })
}

/// Nobody publishes the topic: perhaps it is called something else.
async fn suggest_topic(flow: &FlowAddress, wanted: &str) {
    let Ok(value) = get_json(flow, "/v1/topics").await else {
        return;
    };
    let Ok(known) = typed::<topics::Topics>(flow, &value) else {
        return;
    };
    if let Some(name) = closest(wanted, known.topics.iter().map(|topic| topic.topic.as_str())) {
        eprintln!("blaze: did you mean {name}?");
    }
}

/// The name that is most like `wanted`, if one is alike at all.
pub(crate) fn closest<'a>(wanted: &str, names: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    names
        .filter(|name| *name != wanted)
        .map(|name| (strsim::jaro_winkler(wanted, name), name))
        .filter(|(likeness, _)| *likeness > 0.8)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, name)| name)
}

async fn show(
    flow: &FlowAddress,
    path: &str,
    format: Format,
    table: fn(&FlowAddress, &Value, Option<u16>) -> Result<String, CliError>,
) -> Result<Exit, CliError> {
    let value = get_json(flow, path).await?;
    let text = output::format_object(&value, format, |value| table(flow, value, terminal_width()))?;
    output::print(&text)?;
    Ok(Exit::Done)
}

/// Reads an answer; fields that it does not know are passed over.
///
/// # Errors
/// [`CliError::Answer`] where a field is missing or of another kind.
pub fn typed<T: DeserializeOwned>(flow: &FlowAddress, value: &Value) -> Result<T, CliError> {
    typed_of(Program::Flow, flow, value)
}

/// As [`typed`], of any program.
///
/// # Errors
/// As [`typed`].
pub(crate) fn typed_of<T: DeserializeOwned>(
    program: Program,
    address: &FlowAddress,
    value: &Value,
) -> Result<T, CliError> {
    T::deserialize(value).map_err(|error| CliError::Answer {
        program,
        address: address.to_string(),
        reason: error.to_string(),
    })
}

/// A text that may be missing or `null`: then it is empty.
fn text_or_null<'de, D: Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
    Ok(Option::deserialize(deserializer)?.unwrap_or_default())
}

/// Who answered, above a table.
fn heading(value: &Value) -> String {
    let flow = value.get("flow").and_then(Value::as_str).unwrap_or("?");
    format!("flow {flow}\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_closest_name_is_suggested() {
        let names = ["imu/data", "camera/image_raw", "odom"];
        assert_eq!(closest("imu/dta", names.into_iter()), Some("imu/data"));
        assert_eq!(closest("battery", names.into_iter()), None);
        assert_eq!(closest("imu/data", ["imu/data"].into_iter()), None);
    }
}
