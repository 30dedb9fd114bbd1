//! `blaze problems`: what is wrong, from the monitor of a node or from the main service.

use std::collections::BTreeMap;
use std::time::SystemTime;

use blaze_domain::control::rfc3339_millis;
use clap::Args;
use serde_json::{Value, json};

use super::MonitorTarget;
use super::limits::PROBLEMS_EVERY;
use crate::args::FlowAddress;
use crate::config::ServerOptions;
use crate::config::client::Client;
use crate::config::text::{age, json_line, list, member, note, now_ms};
use crate::ends::interrupted;
use crate::exit::{CliError, Exit};
use crate::http::{Program, get_of_monitor};
use crate::output::{self, Align, Format, terminal_width};

/// Options of `blaze problems`.
#[derive(Debug, Args)]
pub struct ProblemsOptions {
    /// Print each change as it comes
    #[arg(short, long)]
    pub watch: bool,
    /// Which monitor to ask.
    #[command(flatten)]
    pub target: MonitorTarget,
    /// Ask the main service instead, for the whole system.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Who is asked.
enum Source<'o> {
    Monitor(&'o FlowAddress),
    Server(Box<Client>),
}

/// Which problem it is, whatever its figures: layer, node, scope, name, code.
type Key = [String; 5];

fn key(problem: &Value) -> Key {
    ["layer", "node", "scope", "name", "code"].map(|name| member(problem, name))
}

/// Lists the problems, or prints changes until it is interrupted.
///
/// # Errors
/// [`CliError`]: nobody answers, or not as the contract says.
pub async fn run(options: &ProblemsOptions, format: Format) -> Result<Exit, CliError> {
    let source = match options.server.is_given() {
        true => Source::Server(Box::new(Client::of(&options.server)?)),
        false => Source::Monitor(&options.target.monitor),
    };
    if !options.watch {
        return show(&source, format).await;
    }
    tokio::select! {
        ended = watch(&source, format) => ended.map(|()| Exit::Done),
        stopped = interrupted() => stopped.map(|()| Exit::Done),
    }
}

impl Source<'_> {
    /// All problems, worst first, then oldest.
    async fn problems(&self) -> Result<Vec<Value>, CliError> {
        let mut problems = match self {
            Self::Server(client) => client.problems().await?,
            Self::Monitor(monitor) => {
                let health = get_of_monitor(monitor, "/v1/health").await?;
                of_health(&health).ok_or_else(|| CliError::Answer {
                    program: Program::Monitor,
                    address: monitor.to_string(),
                    reason: "its health has no `problems`".to_owned(),
                })?
            }
        };
        problems.retain(Value::is_object);
        problems
            .sort_by_cached_key(|problem| (rank(problem), member(problem, "since"), key(problem)));
        problems.dedup_by_key(|problem| key(problem));
        Ok(problems)
    }
}

/// Problems of the node and of its services, with layer and node as the main service has them.
fn of_health(health: &Value) -> Option<Vec<Value>> {
    let of_node = health.get("problems")?.as_array()?.iter();
    let of_services = list(health, "services").iter().flat_map(|s| list(s, "problems"));
    let placed = |problem: &Value| {
        let mut problem = problem.as_object()?.clone();
        for name in ["layer", "node"] {
            problem.insert(name.to_owned(), health.get(name).cloned().unwrap_or_default());
        }
        Some(Value::Object(problem))
    };
    Some(of_node.chain(of_services).filter_map(placed).collect())
}

fn rank(problem: &Value) -> usize {
    const WORST_FIRST: [&str; 3] = ["down", "degraded", "unknown"];
    let state = member(problem, "state");
    WORST_FIRST.iter().position(|known| *known == state).unwrap_or(WORST_FIRST.len())
}

async fn show(source: &Source<'_>, format: Format) -> Result<Exit, CliError> {
    let problems = json!({"problems": source.problems().await?});
    let text = output::format_object(&problems, format, |problems| {
        Ok(table(list(problems, "problems"), now_ms(), terminal_width()))
    })?;
    output::print(&text)?;
    Ok(Exit::Done)
}

/// Where it is: `layer/node`, or the layer.
fn place(problem: &Value) -> String {
    match (member(problem, "layer"), member(problem, "node")) {
        (layer, node) if node.is_empty() => layer,
        (layer, node) => format!("{layer}/{node}"),
    }
}

/// What it is about: `link edge/robot-1>fog/fog-1`.
fn subject(problem: &Value) -> String {
    format!("{} {}", member(problem, "scope"), member(problem, "name")).trim().to_owned()
}

fn table(problems: &[Value], now_ms: i64, width: Option<u16>) -> String {
    if problems.is_empty() {
        return "No problems.\n".to_owned();
    }
    let mut text = output::table(
        problems,
        width,
        &[
            ("STATE", Align::Left, &|problem| member(problem, "state")),
            ("FOR", Align::Right, &|problem| age(problem.get("since"), now_ms)),
            ("CODE", Align::Left, &|problem| member(problem, "code")),
            ("WHERE", Align::Left, &place),
            ("WHAT", Align::Left, &subject),
            ("DETAIL", Align::Left, &|problem| member(problem, "detail")),
        ],
    );
    let mut said = Vec::new();
    for problem in problems {
        let remedy = (member(problem, "code"), member(problem, "remedy"));
        if !remedy.1.is_empty() && !said.contains(&remedy) {
            text.push_str(&format!("What to do ({}): {}\n", remedy.0, remedy.1));
            said.push(remedy);
        }
    }
    text
}

/// Prints what is there, then each change. What cannot be asked has not changed.
async fn watch(source: &Source<'_>, format: Format) -> Result<(), CliError> {
    let mut known = Known::default();
    let mut is_away = false;
    let mut problems = source.problems().await?;
    if problems.is_empty() {
        note(format, "no problems now; changes follow");
    }
    loop {
        for change in known.update(problems, &now()) {
            output::print(&line(&change, format)?)?;
        }
        problems = loop {
            tokio::time::sleep(PROBLEMS_EVERY).await;
            match source.problems().await {
                Ok(problems) => break problems,
                Err(error) if passes(&error) => {
                    if !std::mem::replace(&mut is_away, true) {
                        note(format, &error.to_string());
                    }
                }
                Err(error) => return Err(error),
            }
        };
        if std::mem::take(&mut is_away) {
            note(format, "it answers again");
        }
    }
}

/// Whether a failure passes by itself.
fn passes(error: &CliError) -> bool {
    match error {
        // An answer that breaks off is that of a program that ends.
        CliError::CannotConnect { .. } | CliError::Answer { .. } | CliError::NoServer { .. } => {
            true
        }
        CliError::Refused { status, .. } => *status >= 500,
        CliError::Problem(refusal) => refusal.status == 429 || refusal.status >= 500,
        _ => false,
    }
}

/// A change: whether the problem is there now, since when, and the problem.
#[derive(Debug, PartialEq)]
struct Change {
    is_raised: bool,
    time: String,
    problem: Value,
}

/// The problems of the last look.
#[derive(Default)]
struct Known(BTreeMap<Key, Value>);

impl Known {
    /// What changed: first what is over, then what is new or of another state.
    fn update(&mut self, problems: Vec<Value>, now: &str) -> Vec<Change> {
        let new: BTreeMap<Key, Value> =
            problems.iter().map(|problem| (key(problem), problem.clone())).collect();
        let mut old = std::mem::replace(&mut self.0, new);
        let is_same = |problem: &Value, old: &BTreeMap<Key, Value>| {
            old.get(&key(problem)).is_some_and(|before| before["state"] == problem["state"])
        };
        let raised: Vec<Change> = problems
            .into_iter()
            .filter(|problem| !is_same(problem, &old))
            .map(|problem| {
                // One that got worse began earlier.
                let since = match old.contains_key(&key(&problem)) {
                    true => now.to_owned(),
                    false => member(&problem, "since"),
                };
                Change { is_raised: true, time: since, problem }
            })
            .collect();
        old.retain(|key, _| !self.0.contains_key(key));
        let cleared = old.into_values().map(|problem| Change {
            is_raised: false,
            time: now.to_owned(),
            problem,
        });
        cleared.chain(raised).collect()
    }
}

fn line(change: &Change, format: Format) -> Result<String, CliError> {
    let Change { is_raised, time, problem } = change;
    let mut value = problem.clone();
    value["change"] = if *is_raised { "raised" } else { "cleared" }.into();
    value["time"] = time.as_str().into();
    match format {
        Format::Json => json_line(&value),
        Format::Yaml => output::format_object(&value, format, |_| Ok(String::new()))
            .map(|t| format!("---\n{t}")),
        Format::Table => {
            let what =
                format!("{}  {}  {}", member(problem, "code"), place(problem), subject(problem));
            if !is_raised {
                return Ok(format!("{time}  CLEARED  {what}"));
            }
            let (detail, remedy) = (member(problem, "detail"), member(problem, "remedy"));
            let remedy = match remedy.as_str() {
                "" => String::new(),
                remedy => format!("  What to do: {remedy}"),
            };
            let state = member(problem, "state");
            Ok(format!("{time}  RAISED   {what}  {state}: {detail}{remedy}"))
        }
    }
}

fn now() -> String {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    rfc3339_millis(u64::try_from(since.as_millis()).unwrap_or(u64::MAX))
}

#[cfg(test)]
#[path = "problems_tests.rs"]
mod tests;
