//! `blaze edit`.
//!
//! ```text
//! GET (ETag) ─► file of the owner alone ─► $VISUAL, $EDITOR, vi ─► YAML ─► PUT with If-Match ─► file removed
//!                                                                  └─ refused: the file stays, and how to go on is told
//!
//! The file holds the revision that was read: where it is applied later, it is the precondition.
//! ```

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::Stdio;

use blaze_domain::config::Key;
use blaze_runtime::environment;
use clap::Args;
use serde_json::Value;
use tokio::process::Command;

use super::api::clean;
use super::call::Call;
use super::client::Client;
use super::files;
use super::kinds::{document_path, name_of};
use super::options::{DocumentOptions, ServerOptions};
use super::text::{cell, note, print};
use super::yaml;
use crate::exit::{CliError, Exit};
use crate::output::Format;

/// Options of `blaze edit`.
#[derive(Debug, Args)]
pub struct EditOptions {
    /// Which document.
    #[command(flatten)]
    pub document: DocumentOptions,
    /// Also when somebody else changed the document while you did
    #[arg(long)]
    pub force: bool,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Edits.
///
/// # Errors
/// [`CliError`]; from the moment on at which the editor was left, it names the file that holds what
/// was written.
pub(super) async fn run(options: &EditOptions, format: Format) -> Result<Exit, CliError> {
    let key = options.document.key()?;
    let client = Client::of(&options.server)?;
    let editor = environment::variable("VISUAL")
        .or_else(|| environment::variable("EDITOR"))
        .unwrap_or_else(|| "vi".to_owned());
    match edit(&client, &key, options.force, &editor, &std::env::temp_dir()).await? {
        Some(document) => print(&document, format, |document| {
            format!("{} is at revision {}", name_of(&key), cell(document.get("revision")))
        }),
        None => {
            note(format, "nothing was changed");
            Ok(Exit::Done)
        }
    }
}

/// The document after the change; `None` if there is none.
async fn edit(
    client: &Client,
    key: &Key,
    force: bool,
    editor: &str,
    directory: &Path,
) -> Result<Option<Value>, CliError> {
    let answer = client.document(key, None).await?;
    let tag = client.tag(&answer, force)?;
    let (before, text) = shown(key, answer.body, force);
    let file = new_file(directory, key, &text)?;
    if let Err(error) = launch(editor, &file).await {
        return Err(not_edited(error, &file, &text));
    }
    let change = async {
        let after = read_back(&file, key)?;
        if after == before {
            return Ok(None);
        }
        let call = Call::put(document_path(key), &after).if_match(Some(tag));
        client.send(&call).await.map(|answer| Some(answer.body))
    };
    match change.await {
        Ok(done) => {
            // It held nothing that is not stored now.
            let _ = std::fs::remove_file(&file);
            Ok(done)
        }
        Err(error) => Err(kept(error, &file, key)),
    }
}

/// What is edited, and the text of the file. Without `force` it has the revision, which fences what
/// is applied later.
fn shown(key: &Key, document: Value, force: bool) -> (Value, String) {
    let revision = document.get("revision").filter(|_| !force).cloned();
    let before = clean(document);
    let mut text = format!(
        "# {}: save and leave to change it, leave it as it is to change nothing.\n# Secrets that are redacted stay as they are.\n{}",
        name_of(key),
        yaml::document(&before)
    );
    if let Some(revision) = revision {
        text.push_str(&format!(
            "# What was read. It keeps this file from changing what others write in the meantime.\nrevision: {revision}\n"
        ));
    }
    (before, text)
}

fn new_file(directory: &Path, key: &Key, text: &str) -> Result<PathBuf, CliError> {
    let failed = |error: std::io::Error| {
        CliError::Failed(format!("a file in {}: {error}", directory.display()))
    };
    let name = format!("blaze-{}-", name_of(key).replace('/', "-"));
    // Its mode is 0600.
    let made = tempfile::Builder::new().prefix(&name).suffix(".yaml").tempfile_in(directory);
    let mut file = made.map_err(failed)?;
    file.write_all(text.as_bytes()).map_err(failed)?;
    let (_, path) = file.keep().map_err(|error| failed(error.error))?;
    Ok(path)
}

/// Runs the editor; its variable may hold options, as in `code --wait`.
async fn launch(editor: &str, file: &Path) -> Result<(), CliError> {
    let ended = Command::new("sh")
        .arg("-c")
        .arg(format!("{editor} \"$1\""))
        .arg("sh")
        .arg(file)
        .stdin(Stdio::inherit())
        .status()
        .await
        .map_err(|error| {
            CliError::Failed(format!("the editor {editor} does not start: {error}"))
        })?;
    if ended.success() {
        Ok(())
    } else {
        Err(CliError::Failed(format!("the editor {editor} failed ({ended}); nothing was changed")))
    }
}

fn read_back(file: &Path, key: &Key) -> Result<Value, CliError> {
    let mut documents = files::read(&[file.to_owned()])?;
    match documents.pop() {
        Some(document) if documents.is_empty() && document.key == *key => Ok(clean(document.value)),
        _ => Err(CliError::Invalid(format!(
            "the file must hold {} and nothing else: kind and names cannot be changed",
            name_of(key)
        ))),
    }
}

/// The editor failed: what stands in the file is told only where something was written.
fn not_edited(error: CliError, file: &Path, text: &str) -> CliError {
    let untouched = std::fs::read(file).is_ok_and(|content| content == text.as_bytes());
    if untouched {
        let _ = std::fs::remove_file(file);
        error
    } else {
        error.advised(format!("What the editor left behind is in {}.", file.display()))
    }
}

/// Says where the edited file is and how to go on.
fn kept(error: CliError, file: &Path, key: &Key) -> CliError {
    let place = file.display();
    let moved = matches!(
        &error,
        CliError::Problem(refusal) if matches!(
            refusal.code(),
            "precondition_failed" | "revision_conflict",
        ),
    );
    let how = match error.exit() {
        _ if moved => format!(
            "`blaze diff -f {place}` shows how it differs from what is there now. Take that over, \
             set its `revision` to the one of now, and `blaze apply -f {place}`; or `blaze edit \
             {}` anew.",
            name_of(key)
        ),
        Exit::Invalid => format!("Correct it and `blaze apply -f {place}`."),
        _ => format!("To go on: `blaze apply -f {place}`."),
    };
    error.advised(format!("What you wrote is in {place}. {how}"))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::config::kinds::parse_key;
    use crate::config::stub::{Asked, Reply, Stub};
    use blaze_domain::config::Kind;

    fn node(kind: &str) -> Value {
        json!({"kind": "Node", "name": "robot-1", "labels": {}, "annotations": {},
            "spec": {"layer": "edge", "type": kind},
            "uid": "u", "revision": 412, "create_time": "t", "update_time": "t",
            "updated_by": "ops"})
    }

    fn key() -> Key {
        parse_key(Kind::Node, "robot-1").unwrap()
    }

    async fn stub(status: u16) -> Stub {
        Stub::start(move |asked: &Asked, _| match (asked.method.as_str(), status) {
            ("GET", _) => Reply::at(412, &node("static")),
            (_, 200) => Reply::at(413, &node("mobile")),
            (_, status) => Reply::problem(status, "precondition_failed", "changed"),
        })
        .await
    }

    fn left(directory: &Path) -> Vec<PathBuf> {
        let entries = std::fs::read_dir(directory).unwrap();
        entries.map(|entry| entry.unwrap().path()).collect()
    }

    const TO_MOBILE: &str = "sed -i s/static/mobile/";

    #[tokio::test]
    async fn what_was_edited_replaces_what_was_read() {
        let directory = tempfile::tempdir().unwrap();
        let stub = stub(200).await;
        let done = edit(&stub.client(), &key(), false, TO_MOBILE, directory.path()).await;
        assert_eq!(done.unwrap().unwrap()["revision"], 412);
        let put = stub.asked().pop().unwrap();
        assert_eq!(put.line(), "PUT /api/v1/nodes/robot-1");
        assert_eq!(put.header("if-match"), Some("\"412\""));
        assert_eq!(
            put.json(),
            json!({
                "kind": "Node",
                "name": "robot-1",
                "labels": {},
                "annotations": {},
                "spec": {"layer": "edge", "type": "mobile"},
            })
        );
        assert!(left(directory.path()).is_empty());
    }

    #[tokio::test]
    async fn nothing_is_sent_where_nothing_was_changed_or_the_editor_failed() {
        let directory = tempfile::tempdir().unwrap();
        let stub = stub(200).await;
        let (client, key) = (stub.client(), key());
        let edited = |editor: &'static str| edit(&client, &key, false, editor, directory.path());
        assert!(edited("true").await.unwrap().is_none());
        let error = edited("false").await.unwrap_err();
        assert!(error.to_string().contains("nothing was changed"), "{error}");
        assert!(!error.to_string().contains("What "), "{error}");
        assert!(left(directory.path()).is_empty());
        // It wrote something and failed then.
        let error = edited("false $(sed -i s/static/mobile/ \"$1\")").await.unwrap_err();
        assert!(error.to_string().contains("What the editor left behind is in"), "{error}");
        assert_eq!(left(directory.path()).len(), 1);
        assert!(stub.asked().iter().all(|asked| asked.method == "GET"));
    }

    /// The file is fenced by the revision that was read, except for whoever forces a change: he
    /// wants no precondition.
    #[tokio::test]
    async fn a_conflict_keeps_the_file_and_says_how_to_go_on() {
        for (force, tag, revision, advice) in [
            (true, "*", Value::Null, "blaze diff -f "),
            (false, "\"412\"", json!(412), "set its `revision` to the one of now"),
        ] {
            let directory = tempfile::tempdir().unwrap();
            let stub = stub(412).await;
            let error =
                edit(&stub.client(), &key(), force, TO_MOBILE, directory.path()).await.unwrap_err();
            assert_eq!(error.exit() as u8, 5);
            let put = stub.asked().pop().unwrap();
            assert_eq!(put.header("if-match"), Some(tag));
            // The revision is the precondition of `apply`; here the entity tag is.
            assert_eq!(put.json().get("revision"), None);
            let file = left(directory.path()).remove(0);
            let text = error.to_string();
            assert!(text.contains(advice) && text.contains(&file.display().to_string()), "{text}");
            let kept = &files::read(&[file]).unwrap()[0].value;
            assert_eq!((&kept["revision"], &kept["spec"]["type"]), (&revision, &json!("mobile")));
        }
    }

    #[tokio::test]
    async fn bad_yaml_and_other_names_are_not_sent() {
        for editor in ["sed -i 's/kind:/kind: [/'", "sed -i s/robot-1/robot-2/"] {
            let directory = tempfile::tempdir().unwrap();
            let stub = stub(200).await;
            let error =
                edit(&stub.client(), &key(), false, editor, directory.path()).await.unwrap_err();
            assert_eq!(error.exit() as u8, 7, "{error}");
            assert_eq!(left(directory.path()).len(), 1);
            assert_eq!(stub.asked().len(), 1);
        }
    }
}
