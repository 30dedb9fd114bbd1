//! `blaze delete`.

use std::io::{BufRead, IsTerminal as _, Write};
use std::path::PathBuf;

use blaze_domain::config::Key;
use clap::Args;
use serde_json::{Map, Value, json};

use super::apply::{Request, send_array};
use super::call::Call;
use super::client::{Answer, Client};
use super::files;
use super::kinds::{self, Target, document_path, name_of};
use super::options::ServerOptions;
use super::text::{count, print};
use crate::exit::{CliError, Exit};
use crate::output::Format;

/// Options of `blaze delete`.
#[derive(Debug, Args)]
pub struct DeleteOptions {
    /// Kind of the document; or KIND/NAME
    #[arg(value_name = "KIND", value_parser = kinds::parse_target, required_unless_present = "files")]
    pub target: Option<Target>,
    /// Its name; of an instance SERVICE/NAME
    #[arg(value_name = "NAME")]
    pub name: Option<String>,
    /// Delete the documents of these files: file, directory or -; all or none
    #[arg(short = 'f', long = "file", value_name = "FILE|DIR|-", conflicts_with_all = ["target", "name"])]
    pub files: Vec<PathBuf>,
    /// Delete also what refers to it
    #[arg(long)]
    pub cascade: bool,
    /// Do not ask; needed where there is no terminal
    #[arg(short, long)]
    pub yes: bool,
    /// Also when somebody else changed it in between
    #[arg(long)]
    pub force: bool,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Deletes.
///
/// # Errors
/// [`CliError`].
pub(super) async fn run(options: &DeleteOptions, format: Format) -> Result<Exit, CliError> {
    let keys: Vec<Key> = match &options.target {
        Some(target) => vec![target.key(options.name.as_deref())?],
        None => files::read(&options.files)?
            .into_iter()
            .map(|source| source.key)
            .collect(),
    };
    if keys.is_empty() {
        return Err(CliError::Usage("the files hold no documents".to_owned()));
    }
    let terminal = std::io::stdin().is_terminal();
    if !options.yes && !terminal {
        return Err(CliError::Usage(
            "nobody can be asked without a terminal: give --yes".to_owned(),
        ));
    }
    let client = Client::of(&options.server)?;
    let found = look(&client, &keys).await?;
    if !options.yes
        && !confirmed(
            &question(&keys, options.cascade),
            &mut std::io::stdin().lock(),
            &mut std::io::stderr(),
        )?
    {
        return Err(CliError::Failed("nothing was deleted".to_owned()));
    }
    delete(
        &client,
        &found,
        options.cascade,
        options.force,
        options.target.is_none(),
    )
    .await?;
    let deleted: Vec<Value> = keys.iter().map(|key| Value::Object(reference(key))).collect();
    print(&json!({ "deleted": deleted }), format, |_| {
        keys.iter().map(|key| format!("{} deleted\n", name_of(key))).collect()
    })?;
    Ok(Exit::Done)
}

/// Reads all documents first: none is deleted when one does not exist.
async fn look(client: &Client, keys: &[Key]) -> Result<Vec<(Key, Answer)>, CliError> {
    let mut found = Vec::new();
    for key in keys {
        found.push((key.clone(), client.document(key, None).await?));
    }
    Ok(found)
}

/// Deletes what was read. Several without `cascade` go in one commit; with it one after the other.
async fn delete(
    client: &Client,
    found: &[(Key, Answer)],
    cascade: bool,
    force: bool,
    several: bool,
) -> Result<(), CliError> {
    if several && !cascade {
        let documents: Value = found.iter().map(|(key, answer)| deletion(key, answer, force)).collect();
        send_array(client, &documents, &Request::default()).await?;
        return Ok(());
    }
    for (index, (key, answer)) in found.iter().enumerate() {
        let tag = if force {
            "*".to_owned()
        } else {
            client.tag(answer.clone())?
        };
        let call = Call::delete(document_path(key))
            .query_if("cascade", cascade.then_some("true"))
            .if_match(Some(tag));
        match client.send(&call).await {
            Ok(_) => {}
            // What stood before it has taken it along; it existed when all was read.
            Err(CliError::Problem(refusal)) if index > 0 && refusal.code() == "not_found" => {}
            Err(CliError::Problem(refusal)) if refusal.code() == "in_use" => {
                let hint = "--cascade deletes what refers to it, too";
                return Err(CliError::Problem(Box::new(refusal.with_hint(hint))));
            }
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

/// The member of `/apply` that deletes a document as it was read.
fn deletion(key: &Key, answer: &Answer, force: bool) -> Value {
    let mut members = reference(key);
    members.insert("delete".to_owned(), true.into());
    if let Some(revision) = answer.body.get("revision").filter(|_| !force) {
        members.insert("revision".to_owned(), revision.clone());
    }
    Value::Object(members)
}

fn reference(key: &Key) -> Map<String, Value> {
    let mut members = Map::new();
    members.insert("kind".to_owned(), key.kind().as_str().into());
    members.insert("name".to_owned(), key.name().as_str().into());
    if let Some(service) = key.service_name() {
        members.insert("service".to_owned(), service.as_str().into());
    }
    members
}

fn question(keys: &[Key], cascade: bool) -> String {
    let what = match keys {
        [key] => name_of(key),
        keys => {
            let names: Vec<String> = keys.iter().take(20).map(name_of).collect();
            let more = if keys.len() > 20 { ", …" } else { "" };
            format!("{}: {}{more}", count(keys.len(), "document"), names.join(", "))
        }
    };
    let also = if cascade { " and all that refers to it" } else { "" };
    format!("Delete {what}{also}? [y/N] ")
}

/// Asks; only `y` and `yes` are a yes.
fn confirmed(question: &str, input: &mut dyn BufRead, output: &mut dyn Write) -> Result<bool, CliError> {
    let failed = |error: std::io::Error| CliError::Failed(format!("the terminal: {error}"));
    output
        .write_all(question.as_bytes())
        .and_then(|()| output.flush())
        .map_err(failed)?;
    let mut answer = String::new();
    input.read_line(&mut answer).map_err(failed)?;
    Ok(matches!(answer.trim().to_ascii_lowercase().as_str(), "y" | "yes"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::stub::{Asked, Reply, Stub};

    fn keys(names: &[&str]) -> Vec<Key> {
        names
            .iter()
            .map(|name| kinds::parse_target(name).unwrap().key(None).unwrap())
            .collect()
    }

    async fn stub() -> Stub {
        Stub::start(|asked: &Asked, _| match asked.method.as_str() {
            "GET" if asked.target.contains("gone") => Reply::problem(404, "not_found", "no"),
            "GET" => Reply::at(412, &json!({"kind": "Node", "name": "a", "revision": 412})),
            "POST" => Reply::json(&json!({"results": []})),
            _ if asked.target.contains("used") => Reply::problem(409, "in_use", "by an instance"),
            _ if asked.target.contains("taken") => Reply::problem(404, "not_found", "no"),
            _ => Reply::Full(204, Vec::new(), String::new()),
        })
        .await
    }

    #[tokio::test]
    async fn one_document_is_deleted_as_it_was_read() {
        let stub = stub().await;
        let client = stub.client();
        let found = look(&client, &keys(&["node/a"])).await.unwrap();
        delete(&client, &found, true, false, false).await.unwrap();
        delete(&client, &found, false, true, false).await.unwrap();
        let asked = stub.asked();
        assert_eq!(asked[1].line(), "DELETE /api/v1/nodes/a?cascade=true");
        assert_eq!(asked[1].header("if-match"), Some("\"412\""));
        assert_eq!(asked[2].line(), "DELETE /api/v1/nodes/a");
        assert_eq!(asked[2].header("if-match"), Some("*"));
    }

    #[tokio::test]
    async fn several_are_deleted_in_one_commit() {
        let stub = stub().await;
        let client = stub.client();
        let found = look(&client, &keys(&["node/a", "inst/slam/0"])).await.unwrap();
        delete(&client, &found, false, false, true).await.unwrap();
        let last = stub.asked().pop().unwrap();
        assert_eq!(last.line(), "POST /api/v1/apply");
        assert_eq!(
            last.json(),
            json!([
                {"kind": "Node", "name": "a", "delete": true, "revision": 412},
                {"kind": "Instance", "name": "0", "service": "slam", "delete": true, "revision": 412},
            ])
        );
        let error = look(&client, &keys(&["node/a", "node/gone"])).await.unwrap_err();
        assert_eq!(error.exit() as u8, 4);
        // With cascade the second may be gone by then.
        let found = look(&client, &keys(&["node/a", "node/taken"])).await.unwrap();
        delete(&client, &found, true, false, true).await.unwrap();
        let found = look(&client, &keys(&["node/used"])).await.unwrap();
        let error = delete(&client, &found, false, false, false).await.unwrap_err();
        assert_eq!(error.exit() as u8, 5);
        assert!(error.to_string().contains("--cascade"), "{error}");
    }

    #[test]
    fn only_a_yes_is_a_yes() {
        for (answer, yes) in [
            ("y\n", true),
            (" YES \n", true),
            ("\n", false),
            ("", false),
            ("yep\n", false),
        ] {
            let mut shown = Vec::new();
            let question = question(&keys(&["node/a"]), true);
            assert_eq!(
                confirmed(&question, &mut answer.as_bytes(), &mut shown).unwrap(),
                yes,
                "{answer:?}"
            );
            assert_eq!(shown, b"Delete node/a and all that refers to it? [y/N] ");
        }
        let many = question(&keys(&["node/a", "ly/edge"]), false);
        assert_eq!(many, "Delete 2 documents: node/a, layer/edge? [y/N] ");
    }
}
