//! `blaze rollout`.

use std::path::PathBuf;

use blaze_domain::config::{Key, Kind};
use clap::{Args, Subcommand};
use serde_json::{Value, json};

use super::api::{Filter, clean};
use super::call::Call;
use super::client::Client;
use super::files;
use super::kinds::{collection_path, document_path, name_of, parse_key};
use super::options::ServerOptions;
use super::tables::{self, Layout};
use super::text::{cell, list, member, note, now_ms, print};
use crate::exit::{CliError, Exit};
use crate::output::{self, Align, Format, terminal_width};

/// Commands of `blaze rollout`.
#[derive(Debug, Subcommand)]
pub enum RolloutCommand {
    /// Start a roll-out from a file that holds one
    Start(StartOptions),
    /// How a roll-out stands, or all of them
    Status(StatusOptions),
    /// Make what was tried the content of its target
    Promote(NamedOptions),
    /// Take back what was tried
    Abort(AbortOptions),
}

/// Options of `blaze rollout start`.
#[derive(Debug, Args)]
pub struct StartOptions {
    /// File with one document of kind Rollout, or - for standard input
    #[arg(short = 'f', long = "file", value_name = "FILE|-")]
    pub file: PathBuf,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Options of `blaze rollout status`.
#[derive(Debug, Args)]
pub struct StatusOptions {
    /// Name of the roll-out; without it all
    #[arg(value_name = "NAME", value_parser = parse_rollout)]
    pub key: Option<Key>,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Options of `blaze rollout promote`.
#[derive(Debug, Args)]
pub struct NamedOptions {
    /// Name of the roll-out
    #[arg(value_name = "NAME", value_parser = parse_rollout)]
    pub key: Key,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Options of `blaze rollout abort`.
#[derive(Debug, Args)]
pub struct AbortOptions {
    /// Name of the roll-out
    #[arg(value_name = "NAME", value_parser = parse_rollout)]
    pub key: Key,
    /// Why, for those who read it later
    #[arg(long, value_name = "TEXT", default_value = "")]
    pub reason: String,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

fn parse_rollout(text: &str) -> Result<Key, String> {
    parse_key(Kind::Rollout, text)
}

/// Runs one of them.
///
/// # Errors
/// [`CliError`].
pub(super) async fn run(command: &RolloutCommand, format: Format) -> Result<Exit, CliError> {
    match command {
        RolloutCommand::Start(options) => {
            let document = one_rollout(&options.file)?;
            let client = Client::of(&options.server)?;
            let call = Call::post(collection_path(Kind::Rollout, None), &document);
            let answer = client.send(&call).await;
            let answer = answer.map_err(|error| with_other_name(error, &document))?;
            print(&answer.body, format, status)
        }
        RolloutCommand::Status(options) => {
            let client = Client::of(&options.server)?;
            match &options.key {
                Some(key) => print(&client.document(key, None).await?.body, format, status),
                None => {
                    let listing = client.list(Kind::Rollout, &Filter::default()).await?;
                    if listing.items.is_empty() && format == Format::Table {
                        note(format, "there are no roll-outs");
                        return Ok(Exit::Done);
                    }
                    let layout = Layout { wide: false, width: terminal_width(), now_ms: now_ms() };
                    print(&listing.into_json(), format, |listing| {
                        tables::documents(Kind::Rollout, list(listing, "items"), layout)
                    })
                }
            }
        }
        RolloutCommand::Promote(options) => {
            act(&options.server, &options.key, "promote", &json!({}), format).await
        }
        RolloutCommand::Abort(options) => {
            let body = json!({ "reason": options.reason });
            act(&options.server, &options.key, "abort", &body, format).await
        }
    }
}

/// A roll-out that has begun is not replaced; what can be done instead.
fn with_other_name(error: CliError, document: &Value) -> CliError {
    let name = member(document, "name");
    error.hinted("already_exists", &format!(
        "a roll-out that has begun is not replaced: give this one another name; or end that one \
         with `blaze rollout promote {name}` or `blaze rollout abort {name}`, and delete it with \
         `blaze delete rollout {name}`"
    ))
}

async fn act(
    server: &ServerOptions,
    key: &Key,
    action: &str,
    body: &Value,
    format: Format,
) -> Result<Exit, CliError> {
    let client = Client::of(server)?;
    let call = Call::post(format!("{}/{action}", document_path(key)), body);
    let document = client.send_about(key, &call).await?.body;
    print(&document, format, status)
}

/// The one roll-out of a file, without what a server would have set.
fn one_rollout(file: &std::path::Path) -> Result<Value, CliError> {
    let mut documents = files::read(&[file.to_owned()])?;
    match documents.pop() {
        Some(document) if documents.is_empty() && document.key.kind() == Kind::Rollout => {
            Ok(clean(document.value))
        }
        Some(document) => {
            let what = if documents.is_empty() {
                format!("it is {}", name_of(&document.key))
            } else {
                format!("there are {}", documents.len() + 1)
            };
            Err(CliError::Invalid(format!(
                "{}: one document of kind Rollout is started at a time; {what}",
                file.display()
            )))
        }
        None => Err(CliError::Usage(format!("{} holds no document", file.display()))),
    }
}

/// How a roll-out stands: phase, target, then its canary nodes.
fn status(document: &Value) -> String {
    let phase = cell(document.pointer("/status/phase"));
    let target = tables::target(document);
    let so = match phase.as_str() {
        "canary" => format!("it tries a change of {target} on its canary nodes"),
        "promoted" => format!("its change is part of {target}"),
        "aborted" | "failed" => format!("its change of {target} is taken back"),
        _ => format!("it is about {target}"),
    };
    let mut text = format!("{} is {phase}; {so}\n", member(document, "name"));
    let of_server = document.get("status").unwrap_or(&Value::Null);
    let reason = member(of_server, "reason");
    if !reason.is_empty() {
        text.push_str(&format!("Reason: {reason}\n"));
    }
    let canaries = list(of_server, "canaries");
    if !canaries.is_empty() {
        text.push_str(&output::table(
            canaries,
            terminal_width(),
            &[
                ("NODE", Align::Left, &|canary| cell(canary.get("node"))),
                ("PHASE", Align::Left, &|canary| cell(canary.get("phase"))),
                ("REVISION", Align::Right, &|canary| cell(canary.get("revision"))),
                ("REASON", Align::Left, &|canary| cell(canary.get("reason"))),
            ],
        ));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::stub::{Reply, Stub};

    #[test]
    fn a_status_says_phase_target_and_canaries() {
        let document = json!({"kind": "Rollout", "name": "slower",
            "spec": {"target": {"kind": "Service", "name": "slam"}},
            "status": {"phase": "failed",
                "canaries": [{"node": "robot-1", "phase": "failed", "revision": 431,
                "reason": "unhealthy"}]}});
        assert_eq!(
            status(&document),
            "slower is failed; its change of service/slam is taken back\n\
             NODE     PHASE   REVISION  REASON\n\
             robot-1  failed       431  unhealthy\n"
        );
        for (phase, expected) in [
            ("canary", "slower is canary; it tries a change of service/slam on its canary nodes\n"),
            ("promoted", "slower is promoted; its change is part of service/slam\n"),
            ("aborted", "slower is aborted; its change of service/slam is taken back\n"),
        ] {
            let document = json!({"name": "slower", "spec": {"target": {"kind": "Service", "name": "slam"}},
                "status": {"phase": phase, "canaries": []}});
            assert_eq!(status(&document), expected);
        }
    }

    #[tokio::test]
    async fn one_that_exists_is_ended_or_the_new_one_has_another_name() {
        let stub =
            Stub::start(|_, _| Reply::problem(409, "already_exists", "Rollout/slower exists"))
                .await;
        let document = json!({"kind": "Rollout", "name": "slower", "spec": {}});
        let call = Call::post(collection_path(Kind::Rollout, None), &document);
        let error = stub.client().send(&call).await.unwrap_err();
        let error = with_other_name(error, &document);
        assert_eq!(error.exit(), Exit::Conflict);
        let text = error.to_string();
        assert!(
            text.contains("another name") && text.contains("`blaze rollout abort slower`"),
            "{text}"
        );
        assert!(!text.contains("blaze apply"), "{text}");
    }

    #[test]
    fn one_rollout_is_started_at_a_time() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("r.yaml");
        for (text, why) in [
            ("kind: Node\nname: a\n", "it is node/a"),
            ("kind: Rollout\nname: a\n---\nkind: Rollout\nname: b\n", "there are 2"),
            ("# nothing\n", "holds no document"),
        ] {
            std::fs::write(&file, text).unwrap();
            let error = one_rollout(&file).unwrap_err();
            assert!(error.to_string().contains(why), "{error}");
        }
        std::fs::write(
            &file,
            "kind: Rollout\nname: a\nspec: {}\nstatus: { phase: aborted }\nuid: u\n",
        )
        .unwrap();
        assert_eq!(
            one_rollout(&file).unwrap(),
            json!({"kind": "Rollout", "name": "a", "spec": {}})
        );
    }
}
