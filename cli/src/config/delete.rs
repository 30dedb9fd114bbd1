//! `blaze delete`.

use std::collections::BTreeSet;
use std::path::PathBuf;

use blaze_domain::config::Key;
use clap::Args;
use serde_json::{Map, Value, json};

use super::apply::{Request, send_array};
use super::ask::{confirmed, must_be_possible};
use super::call::Call;
use super::cascade;
use super::client::{Answer, Client};
use super::files;
use super::kinds::{self, Target, document_path, name_of};
use super::options::ServerOptions;
use super::text::{count, note, print};
use crate::exit::{CliError, Exit};
use crate::output::Format;

/// Documents that a question lists of those that are named, and of those that go with them.
const MAX_LISTED: usize = 100;

/// Options of `blaze delete`.
#[derive(Debug, Args)]
pub struct DeleteOptions {
    /// Kind of the document; or KIND/NAME
    #[arg(value_name = "KIND", value_parser = kinds::parse_target,
        required_unless_present = "files")]
    pub target: Option<Target>,
    /// Its name; of an instance SERVICE/NAME
    #[arg(value_name = "NAME")]
    pub name: Option<String>,
    /// Delete the documents of these files: file, directory or -; all or none
    #[arg(short = 'f', long = "file", value_name = "FILE|DIR|-",
        conflicts_with_all = ["target", "name"])]
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
        None => files::read(&options.files)?.into_iter().map(|source| source.key).collect(),
    };
    if keys.is_empty() {
        return Err(CliError::Usage("the files hold no documents".to_owned()));
    }
    must_be_possible(options.yes)?;
    let client = Client::of(&options.server)?;
    let found = look(&client, &keys).await?;
    if !options.yes {
        let along =
            if options.cascade { cascade::referrers(&client, &keys).await? } else { Vec::new() };
        if !confirmed(&question(&keys, &along))? {
            return Err(CliError::Failed("nothing was deleted".to_owned()));
        }
    }
    let mut gone = Gone::default();
    let several = options.target.is_none();
    let ended = delete(&client, &found, options.cascade, options.force, several, &mut gone).await;
    // What is deleted is told, also when the next one was refused.
    if !gone.keys.is_empty() {
        let complete = !options.cascade || gone.take_along(&client, format).await;
        let deleted: Vec<Value> =
            gone.keys.iter().map(|key| Value::Object(reference(key))).collect();
        let mut told = json!({ "deleted": deleted });
        if !complete {
            told["incomplete"] = true.into();
        }
        print(&told, format, |_| {
            gone.keys.iter().map(|key| format!("{} deleted\n", name_of(key))).collect()
        })?;
    }
    ended.map(|()| Exit::Done)
}

/// What was deleted.
#[derive(Debug, Default)]
struct Gone {
    /// Documents, those that were named first.
    keys: Vec<Key>,
    /// Revisions of the deletions.
    revisions: BTreeSet<u64>,
}

impl Gone {
    /// Adds what the deletions took along: the server tells it in the commits alone. Whether they
    /// could be read.
    async fn take_along(&mut self, client: &Client, format: Format) -> bool {
        match cascade::deleted(client, &self.revisions).await {
            Some(along) => {
                let named: BTreeSet<Key> = self.keys.iter().cloned().collect();
                self.keys.extend(along.into_iter().filter(|key| !named.contains(key)));
                true
            }
            None => {
                let since = self.revisions.first().map(|first| first.saturating_sub(1));
                let how = since.map_or_else(String::new, |since| {
                    format!(": `blaze watch --since {since}` shows it")
                });
                note(format, &format!("what was deleted with it could not be read{how}"));
                false
            }
        }
    }
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
    gone: &mut Gone,
) -> Result<(), CliError> {
    if several && !cascade {
        let documents: Value =
            found.iter().map(|(key, answer)| deletion(key, answer, force)).collect();
        send_array(client, &documents, &Request::default()).await?;
        gone.keys.extend(found.iter().map(|(key, _)| key.clone()));
        return Ok(());
    }
    for (index, (key, answer)) in found.iter().enumerate() {
        let call = Call::delete(document_path(key))
            .query_if("cascade", cascade.then_some("true"))
            .if_match(Some(client.tag(answer, force)?));
        match client.send(&call).await {
            Ok(answer) => gone.revisions.extend(answer.revision),
            // What stood before it has taken it along; it existed when all was read.
            Err(CliError::Problem(refusal)) if index > 0 && refusal.code() == "not_found" => {}
            Err(error) => {
                return Err(error.hinted("in_use", "--cascade deletes what refers to it, too"));
            }
        }
        gone.keys.push(key.clone());
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

/// What is asked. All that would go with it stands there, up to a number that can be read.
fn question(keys: &[Key], along: &[Key]) -> String {
    let listed = |keys: &[Key]| {
        let mut text: String =
            keys.iter().take(MAX_LISTED).map(|key| format!("  {}\n", name_of(key))).collect();
        if keys.len() > MAX_LISTED {
            text.push_str(&format!("  and {} more\n", keys.len() - MAX_LISTED));
        }
        text
    };
    let mut text = match keys {
        [key] if along.is_empty() => return format!("Delete {}?", name_of(key)),
        [key] => format!("{} would be deleted", name_of(key)),
        keys => format!("{} would be deleted:\n{}", count(keys.len(), "document"), listed(keys)),
    };
    if !along.is_empty() {
        let (with, what) =
            if text.ends_with('\n') { ("With them", "them") } else { (", and with it", "it") };
        let number = count(along.len(), "document");
        text.push_str(&format!("{with} what refers to {what}, {number}:\n{}", listed(along)));
    }
    text.push_str(&format!("Delete all {}?", keys.len() + along.len()));
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::stub::{Asked, Reply, Stub};

    fn keys(names: &[&str]) -> Vec<Key> {
        names.iter().map(|name| kinds::parse_target(name).unwrap().key(None).unwrap()).collect()
    }

    async fn stub() -> Stub {
        Stub::start(|asked: &Asked, _| match asked.method.as_str() {
            "GET" if asked.target.contains("gone") => Reply::problem(404, "not_found", "no"),
            "GET" => Reply::at(412, &json!({"kind": "Node", "name": "a", "revision": 412})),
            "POST" => Reply::json(&json!({"results": []})),
            _ if asked.target.contains("used") => Reply::problem(409, "in_use", "by an instance"),
            _ if asked.target.contains("taken") => Reply::problem(404, "not_found", "no"),
            _ => Reply::Full(204, vec![("blaze-revision", "413".to_owned())], String::new()),
        })
        .await
    }

    #[tokio::test]
    async fn one_document_is_deleted_as_it_was_read() {
        let stub = stub().await;
        let client = stub.client();
        let found = look(&client, &keys(&["node/a"])).await.unwrap();
        let mut gone = Gone::default();
        delete(&client, &found, true, false, false, &mut gone).await.unwrap();
        assert_eq!((gone.keys.len(), &gone.revisions), (1, &BTreeSet::from([413])));
        delete(&client, &found, false, true, false, &mut gone).await.unwrap();
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
        let mut gone = Gone::default();
        delete(&client, &found, false, false, true, &mut gone).await.unwrap();
        assert_eq!(gone.keys, keys(&["node/a", "inst/slam/0"]));
        let last = stub.asked().pop().unwrap();
        assert_eq!(last.line(), "POST /api/v1/apply");
        assert_eq!(
            last.json(),
            json!([
                {"kind": "Node", "name": "a", "delete": true, "revision": 412},
                {
                    "kind": "Instance",
                    "name": "0",
                    "service": "slam",
                    "delete": true,
                    "revision": 412,
                },
            ])
        );
        let error = look(&client, &keys(&["node/a", "node/gone"])).await.unwrap_err();
        assert_eq!(error.exit() as u8, 4);
        // With cascade the second may be gone by then.
        let found = look(&client, &keys(&["node/a", "node/taken"])).await.unwrap();
        delete(&client, &found, true, false, true, &mut Gone::default()).await.unwrap();
        let found = look(&client, &keys(&["node/a", "node/used"])).await.unwrap();
        let mut gone = Gone::default();
        let error = delete(&client, &found, true, false, true, &mut gone).await.unwrap_err();
        // The first is gone all the same.
        assert_eq!(gone.keys, keys(&["node/a"]));
        assert_eq!(error.exit() as u8, 5);
        assert!(error.to_string().contains("--cascade"), "{error}");
    }

    #[test]
    fn a_question_says_all_that_would_go() {
        let one = keys(&["ly/edge"]);
        assert_eq!(question(&one, &[]), "Delete layer/edge?");
        assert_eq!(
            question(&one, &keys(&["node/a", "inst/slam/0"])),
            "layer/edge would be deleted, and with it what refers to it, 2 documents:\n  node/a\n  instance/slam/0\nDelete all 3?"
        );
        let two = keys(&["node/a", "ly/edge"]);
        assert_eq!(
            question(&two, &[]),
            "2 documents would be deleted:\n  node/a\n  layer/edge\nDelete all 2?"
        );
        assert!(
            question(&two, &keys(&["ro/a"]))
                .contains("\nWith them what refers to them, 1 document:\n  rollout/a\n")
        );
        let many: Vec<Key> = (0..MAX_LISTED + 3)
            .map(|number| {
                kinds::parse_target(&format!("node/n{number}")).unwrap().key(None).unwrap()
            })
            .collect();
        assert!(question(&one, &many).ends_with("  node/n99\n  and 3 more\nDelete all 104?"));
    }

    #[tokio::test]
    async fn what_went_along_is_told_once_each() {
        let stub = Stub::start(|_, _| {
            let changes: Vec<Value> = ["a", "b"]
                .map(|name| json!({"op": "delete", "kind": "Node", "name": name}))
                .to_vec();
            let data = json!({"revision": 413, "changes": changes});
            Reply::Events(format!("retry: 1\nid: 413\nevent: change\ndata: {data}\n\n"))
        })
        .await;
        let mut gone = Gone { keys: keys(&["node/a"]), revisions: BTreeSet::from([413]) };
        assert!(gone.take_along(&stub.client(), Format::Json).await);
        assert_eq!(gone.keys, keys(&["node/a", "node/b"]));
        gone.revisions.clear();
        assert!(!gone.take_along(&stub.client(), Format::Json).await);
    }
}
