//! `blaze apply`.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::Duration;

use blaze_domain::config::Kind;
use clap::Args;
use serde_json::Value;
use tokio::time::{Instant, sleep, timeout_at};

use super::call::Call;
use super::client::Client;
use super::files::{self, MAX_BYTES, Source};
use super::kinds::{BASE, key_of, name_of};
use super::options::ServerOptions;
use super::text::{cell, count, flag, list, member, note, parse_duration, print, whole};
use crate::exit::{CliError, Exit};
use crate::output::{self, Align, Format, terminal_width};

/// Pauses between two looks at the workers.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
const LONGEST_PAUSE: Duration = Duration::from_secs(2);

/// Options of `blaze apply`.
#[derive(Debug, Args)]
pub struct ApplyOptions {
    /// File, directory (its *.yaml, *.yml and *.json) or - for standard input; may be repeated. All
    /// go in one request
    #[arg(short = 'f', long = "file", value_name = "FILE|DIR|-", required = true)]
    pub files: Vec<PathBuf>,
    /// Only say what would happen
    #[arg(long)]
    pub dry_run: bool,
    /// Delete what these labels match and is not among the files
    #[arg(long, value_name = "SELECTOR")]
    pub prune: Option<String>,
    /// How many documents --prune deletes; needed for more than 20
    #[arg(long, value_name = "COUNT", requires = "prune")]
    pub prune_confirm: Option<u64>,
    /// Wait so long (30s, 5m) until every connected worker of the layers concerned has the
    /// revision; else exit with 1
    #[arg(long, value_name = "DURATION", value_parser = parse_duration, conflicts_with = "dry_run")]
    pub wait: Option<Duration>,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Applies.
///
/// # Errors
/// [`CliError`].
pub(super) async fn run(options: &ApplyOptions, format: Format) -> Result<Exit, CliError> {
    let sources = files::read(&options.files)?;
    let client = Client::of(&options.server)?;
    let request = Request {
        dry_run: options.dry_run,
        prune: options.prune.as_deref(),
        prune_confirm: options.prune_confirm,
    };
    let answer = send(&client, &sources, &request).await?;
    print(&answer, format, table)?;
    note(format, &summary(&answer));
    if let Some(longest) = options.wait {
        wait(&client, &answer, &sources, longest, format).await?;
    }
    Ok(Exit::Done)
}

/// How documents are applied.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Request<'a> {
    pub(super) dry_run: bool,
    pub(super) prune: Option<&'a str>,
    pub(super) prune_confirm: Option<u64>,
}

/// Sends documents in one request; what is wrong with one is told with its file and line.
///
/// # Errors
/// [`CliError`].
pub(super) async fn send(
    client: &Client,
    sources: &[Source],
    request: &Request<'_>,
) -> Result<Value, CliError> {
    if sources.is_empty() {
        return Err(CliError::Usage("the files hold no documents".to_owned()));
    }
    let body: Value = sources.iter().map(|source| source.value.clone()).collect();
    send_array(client, &body, request).await.map_err(|error| match error {
        CliError::Problem(refusal) => {
            let places = sources
                .iter()
                .map(|source| format!("{}: {}", source.origin, name_of(&source.key)))
                .collect();
            CliError::Problem(Box::new(refusal.with_sources(places)))
        }
        other => other,
    })
}

/// Sends an array of documents.
///
/// # Errors
/// [`CliError`].
pub(super) async fn send_array(
    client: &Client,
    body: &Value,
    request: &Request<'_>,
) -> Result<Value, CliError> {
    let bytes = body.to_string().len();
    if bytes > MAX_BYTES {
        return Err(CliError::Invalid(format!(
            "the documents have {bytes} bytes as JSON, more than {} MiB: split them",
            MAX_BYTES / 1024 / 1024
        )));
    }
    let mut call = Call::post(format!("{BASE}/apply"), body)
        .query_if("dry_run", request.dry_run.then_some("true"))
        .query_if("prune", request.prune)
        .query_if("prune_confirm", request.prune_confirm.map(|count| count.to_string()));
    if request.dry_run {
        call = call.harmless();
    }
    match client.send(&call).await {
        Ok(answer) if answer.body.get("results").is_some_and(Value::is_array) => Ok(answer.body),
        Ok(_) => Err(client.odd("the answer has no `results`")),
        Err(error) if request.prune.is_some() => {
            let hint = "so many documents are deleted with --prune-confirm COUNT alone";
            Err(error.hinted("limit_exceeded", hint))
        }
        Err(error) => Err(error),
    }
}

/// The results of an answer of `/apply`.
pub(super) fn results(answer: &Value) -> &[Value] {
    list(answer, "results")
}

/// How a result calls its document.
pub(super) fn result_name(result: &Value) -> String {
    key_of(result).map_or_else(|_| cell(result.get("name")), |key| name_of(&key))
}

/// One line per document.
pub(super) fn table(answer: &Value) -> String {
    output::table(
        results(answer),
        terminal_width(),
        &[
            ("DOCUMENT", Align::Left, &result_name),
            ("ACTION", Align::Left, &|result| member(result, "action")),
            ("REVISION", Align::Right, &|result| cell(result.get("revision"))),
            ("CHANGES", Align::Right, &|result| list(result, "changes").len().to_string()),
        ],
    )
}

/// One sentence about all documents.
pub(super) fn summary(answer: &Value) -> String {
    let mut parts = Vec::new();
    for action in ["created", "updated", "deleted", "unchanged"] {
        let number =
            results(answer).iter().filter(|result| member(result, "action") == action).count();
        if number > 0 {
            parts.push(format!("{number} {action}"));
        }
    }
    let begin = if flag(answer, "dry_run") { "nothing was written; it would be: " } else { "" };
    let total = usize::try_from(whole(answer, "affected_total")).unwrap_or(usize::MAX);
    let affected = count(total, "configuration");
    format!(
        "{begin}{}; revision {}; {affected} affected",
        parts.join(", "),
        cell(answer.get("revision"))
    )
}

/// Layers whose workers must have the revision; `None`: all.
fn layers(answer: &Value, sources: &[Source]) -> Option<BTreeSet<String>> {
    let mut layers = BTreeSet::new();
    let affected = list(answer, "affected");
    if whole(answer, "affected_total") > affected.len() as u64 {
        return None;
    }
    for place in affected {
        layers.insert(place.get("layer")?.as_str()?.to_owned());
    }
    // Results stand in the order of the request. A layer and its nodes concern its workers although
    // no service runs there.
    for (index, result) in results(answer).iter().enumerate() {
        if !matches!(member(result, "action").as_str(), "created" | "updated") {
            continue;
        }
        let layer = match key_of(result) {
            Ok(key) if key.kind() == Kind::Layer => Some(key.name().to_string()),
            Ok(key) if key.kind() == Kind::Node => {
                let source = sources.get(index).filter(|source| source.key == key);
                let named = source.and_then(|source| source.value.pointer("/spec/layer")?.as_str());
                named.map(str::to_owned)
            }
            Ok(_) | Err(_) => None,
        };
        layers.extend(layer);
    }
    Some(layers)
}

/// The newest revision of documents that an answer tells of.
fn newest(answer: &Value) -> Option<u64> {
    let revisions = results(answer).iter().map(|result| result.get("revision")?.as_u64());
    revisions.flatten().max()
}

/// Layers that see some of the documents, as far as these say; `None`: all may.
fn seen_by(sources: &[Source]) -> Option<BTreeSet<String>> {
    let mut layers = BTreeSet::new();
    for Source { key, value, .. } in sources {
        let text = |pointer: &str| Some(value.pointer(pointer)?.as_str()?.to_owned());
        match key.kind() {
            Kind::Layer => {
                layers.insert(key.name().to_string());
            }
            Kind::Node => layers.extend(text("/spec/layer")),
            Kind::Service => {
                let named = value.pointer("/spec/layers")?.as_array()?;
                layers.extend(named.iter().filter_map(|layer| layer.as_str().map(str::to_owned)));
            }
            // Where a node stands, and what a roll-out is about, is not said here.
            Kind::Instance => layers.extend(Some(text("/spec/layer")?)),
            Kind::Rollout => return None,
        }
    }
    Some(layers)
}

/// Waits until all connected workers concerned have the revision of an answer.
async fn wait(
    client: &Client,
    answer: &Value,
    sources: &[Source],
    longest: Duration,
    format: Format,
) -> Result<(), CliError> {
    let changed = results(answer).iter().any(|result| member(result, "action") != "unchanged");
    let (revision, layers) = match changed {
        true => (answer.get("revision").and_then(Value::as_u64), layers(answer, sources)),
        // What was there already may be on its way yet: whoever waits again waits for the same.
        false => (newest(answer), seen_by(sources)),
    };
    let Some(revision) = revision else {
        return Ok(());
    };
    let until = Instant::now() + longest;
    let mut pause = FIRST_PAUSE;
    loop {
        let asked = timeout_at(until.max(Instant::now() + FIRST_PAUSE), client.workers()).await;
        let asked = asked.unwrap_or_else(|_| Err(client.silent()));
        let behind = match asked {
            Ok(workers) => {
                let concerned = concerned(&workers, layers.as_ref());
                let behind = behind(&concerned, revision);
                if behind.is_empty() {
                    note(format, &everywhere(concerned.len(), revision));
                    return Ok(());
                }
                behind
            }
            // The revision is written; whether the workers have it may show again in a moment.
            Err(error @ (CliError::NoServer { .. } | CliError::Foreign { .. })) => {
                vec![error.to_string()]
            }
            Err(CliError::Problem(refusal)) if refusal.status >= 500 => vec![refusal.to_string()],
            Err(error) => {
                return Err(error.advised(format!(
                    "Revision {revision} is written; which workers have it could not be asked."
                )));
            }
        };
        let now = Instant::now();
        if now >= until {
            return Err(CliError::Failed(format!(
                "revision {revision} is written, but not everywhere after {} s:\n  {}",
                longest.as_secs_f64(),
                behind.join("\n  ")
            )));
        }
        sleep(pause.min(until - now)).await;
        pause = (pause * 2).min(LONGEST_PAUSE);
    }
}

fn everywhere(workers: usize, revision: u64) -> String {
    match workers {
        0 => format!("revision {revision} is written; no worker concerned is connected"),
        workers => format!("{} concerned: all have revision {revision}", count(workers, "worker")),
    }
}

/// Connected workers of some layers.
fn concerned<'w>(workers: &'w Value, layers: Option<&BTreeSet<String>>) -> Vec<&'w Value> {
    let is_concerned = |worker: &&Value| {
        flag(worker, "connected")
            && layers.is_none_or(|layers| layers.contains(&member(worker, "layer")))
    };
    list(workers, "items").iter().filter(is_concerned).collect()
}

/// Those that have not yet reached a revision, in words.
fn behind(workers: &[&Value], revision: u64) -> Vec<String> {
    workers
        .iter()
        .filter(|worker| whole(worker, "revision") < revision)
        .map(|worker| {
            let place = format!("{}/{}", member(worker, "layer"), cell(worker.get("node")));
            format!("the worker of {place} is at revision {}", cell(worker.get("revision")))
        })
        .collect()
}

#[cfg(test)]
#[path = "apply_tests.rs"]
mod tests;
