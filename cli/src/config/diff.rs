//! `blaze diff`.

use std::path::PathBuf;

use clap::Args;
use serde_json::Value;

use super::apply::{self, Request};
use super::call::Call;
use super::client::Client;
use super::files::{self, Source};
use super::kinds::{self, Target, document_path};
use super::options::ServerOptions;
use super::text::{compact, member, note, print};
use crate::exit::{CliError, Exit};
use crate::output::Format;

/// Options of `blaze diff`.
#[derive(Debug, Args)]
pub struct DiffOptions {
    /// Compare with what is stored: file, directory or -; may be repeated
    #[arg(
        short = 'f',
        long = "file",
        value_name = "FILE|DIR|-",
        conflicts_with_all = ["target", "name", "from", "to"]
    )]
    pub files: Vec<PathBuf>,
    /// Kind of a document whose revisions are compared; or KIND/NAME
    #[arg(value_name = "KIND", value_parser = kinds::parse_target,
        required_unless_present = "files")]
    pub target: Option<Target>,
    /// Its name; of an instance SERVICE/NAME
    #[arg(value_name = "NAME")]
    pub name: Option<String>,
    /// The revision to compare from
    #[arg(long, value_name = "R", required_unless_present = "files")]
    pub from: Option<u64>,
    /// The revision to compare with; without it, how it is now
    #[arg(long, value_name = "R")]
    pub to: Option<u64>,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Compares: done if nothing differs, else failed.
///
/// # Errors
/// [`CliError::Diff`], whose exit code is above 1.
pub(super) async fn run(options: &DiffOptions, format: Format) -> Result<Exit, CliError> {
    compare(options, format).await.map_err(|error| match error {
        CliError::OutputClosed => CliError::OutputClosed,
        other => CliError::Diff(Box::new(other)),
    })
}

async fn compare(options: &DiffOptions, format: Format) -> Result<Exit, CliError> {
    let differs = match (&options.target, options.from) {
        (Some(target), Some(from)) => {
            let key = target.key(options.name.as_deref())?;
            let client = Client::of(&options.server)?;
            let call = Call::get(format!("{}/diff", document_path(&key)))
                .query("from", from.to_string())
                .query_if("to", options.to.map(|to| to.to_string()));
            let answer = client.send_about(&key, &call).await?.body;
            let changes = answer
                .get("changes")
                .and_then(Value::as_array)
                .ok_or_else(|| client.odd("no `changes`"))?;
            let differs = !changes.is_empty();
            if differs || format != Format::Table {
                print(&answer, format, |_| delta_lines(changes))?;
            }
            differs
        }
        _ => {
            let sources = without_revisions(files::read(&options.files)?);
            let client = Client::of(&options.server)?;
            let request = Request { dry_run: true, ..Request::default() };
            let answer = apply::send(&client, &sources, &request).await?;
            let differs = has_differences(&answer);
            if differs || format != Format::Table {
                print(&answer, format, result_lines)?;
            }
            differs
        }
    };
    if !differs {
        note(format, "nothing differs");
    }
    Ok(if differs { Exit::Failed } else { Exit::Done })
}

/// `revision` in a file is the precondition of a change, and here nothing is changed: what others
/// wrote in between is to be shown, not refused.
fn without_revisions(mut sources: Vec<Source>) -> Vec<Source> {
    for source in &mut sources {
        if let Value::Object(members) = &mut source.value {
            members.shift_remove("revision");
        }
    }
    sources
}

fn has_differences(answer: &Value) -> bool {
    apply::results(answer).iter().any(|result| member(result, "action") != "unchanged")
}

/// Documents that differ, each with what does.
fn result_lines(answer: &Value) -> String {
    let mut text = String::new();
    for result in apply::results(answer) {
        let action = member(result, "action");
        if action == "unchanged" {
            continue;
        }
        text.push_str(&format!("{} would be {action}\n", apply::result_name(result)));
        let changes = result.get("changes").and_then(Value::as_array);
        text.push_str(&delta_lines(changes.map_or(&[][..], Vec::as_slice)));
    }
    text
}

/// One line per difference.
pub(super) fn delta_lines(changes: &[Value]) -> String {
    let mut text = String::new();
    for change in changes {
        let path = match member(change, "path") {
            // The document as a whole.
            path if path.is_empty() => "/".to_owned(),
            path => path,
        };
        let shown = |name: &str| change.get(name).map(compact).unwrap_or_default();
        text.push_str(&match member(change, "op").as_str() {
            "add" => format!("  + {path}  {}\n", shown("value")),
            "remove" => format!("  - {path}  {}\n", shown("old")),
            _ => format!("  ~ {path}  {} → {}\n", shown("old"), shown("value")),
        });
    }
    text
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_file_that_is_behind_is_compared_all_the_same() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("a.yaml");
        std::fs::write(
            &file,
            "kind: Node\nname: a\nrevision: 4\nspec: { config: { revision: 5 } }\n",
        )
        .unwrap();
        let sources = without_revisions(files::read(&[file]).unwrap());
        assert_eq!(
            sources[0].value,
            json!({"kind": "Node", "name": "a", "spec": {"config": {"revision": 5}}})
        );
    }

    #[test]
    fn differences_read_as_lines() {
        let answer = json!({"results": [
            {"kind": "Node", "name": "robot-1", "action": "updated", "changes": [
                {"op": "replace", "path": "/spec/type", "old": "static", "value": "mobile"},
                {"op": "add", "path": "/labels/site", "value": "lab"},
                {"op": "remove", "path": "/spec/config/a", "old": null}]},
            {
                "kind": "Instance",
                "service": "slam",
                "name": "0",
                "action": "deleted",
                "changes": [],
            },
            {"kind": "Layer", "name": "edge", "action": "unchanged", "changes": []}]});
        assert!(has_differences(&answer));
        assert_eq!(
            result_lines(&answer),
            "node/robot-1 would be updated\n\
             \x20 ~ /spec/type  \"static\" → \"mobile\"\n\
             \x20 + /labels/site  \"lab\"\n\
             \x20 - /spec/config/a  null\n\
             instance/slam/0 would be deleted\n"
        );
        assert!(!has_differences(&json!({"results": [{"action": "unchanged"}]})));
    }
}
