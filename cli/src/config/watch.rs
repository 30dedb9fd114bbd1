//! `blaze watch`, and `blaze get --watch`.

use std::collections::BTreeMap;

use blaze_domain::config::{Key, Kind};
use blaze_domain::{LayerName, ServiceName};
use clap::Args;
use serde_json::{Value, json};

use super::api::Filter;
use super::call::Call;
use super::client::Client;
use super::kinds::{self, BASE, Target, key_of, name_of};
use super::options::ServerOptions;
use super::stream::{Lost, Told, Watcher};
use super::text::{json_line, list, member, note, whole};
use super::yaml;
use crate::ends::interrupted;
use crate::exit::{CliError, Exit};
use crate::output::{self, Format};

/// Options of `blaze watch`.
#[derive(Debug, Args)]
pub struct WatchOptions {
    /// Only this kind (layer, node, service, instance, rollout); or KIND/NAME
    #[arg(value_name = "KIND", value_parser = kinds::parse_target)]
    pub target: Option<Target>,
    /// Only this document; of an instance SERVICE/NAME
    #[arg(value_name = "NAME")]
    pub name: Option<String>,
    /// Only documents whose labels match
    #[arg(short = 'l', long, value_name = "SELECTOR")]
    pub selector: Option<String>,
    /// Only what is in this layer
    #[arg(long, value_name = "LAYER")]
    pub layer: Option<LayerName>,
    /// Only instances of this service, and, without KIND, the service itself
    #[arg(long, value_name = "SERVICE")]
    pub service: Option<ServiceName>,
    /// Begin behind this revision; without it now
    #[arg(long, value_name = "R")]
    pub since: Option<u64>,
    /// Also tell up to which revision everything was told
    #[arg(long)]
    pub bookmarks: bool,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// What is watched.
#[derive(Debug, Clone, Default)]
pub(crate) struct Scope {
    pub(crate) kind: Option<Kind>,
    pub(crate) key: Option<Key>,
    pub(crate) service: Option<ServiceName>,
    pub(crate) layer: Option<LayerName>,
    pub(crate) selector: Option<String>,
}

/// What is shown.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Shown {
    /// A commit, as the server gives it.
    Commit(Value),
    /// Everything up to this revision was told.
    Bookmark(Value),
    /// Something in between is lost: what exists follows, then the changes after it.
    Relist(Lost),
    /// What exists of a kind.
    Listed { kind: Kind, revision: u64, items: Vec<Value> },
}

/// Watches until it is interrupted.
///
/// # Errors
/// [`CliError`].
pub(super) async fn run(options: &WatchOptions, format: Format) -> Result<Exit, CliError> {
    let key = match (&options.target, &options.name) {
        (Some(target), name) => target.optional_key(name.as_deref())?,
        (None, _) => None,
    };
    let scope = Scope {
        kind: options.target.as_ref().map(|target| target.kind),
        key,
        service: options.service.clone(),
        layer: options.layer.clone(),
        selector: options.selector.clone(),
    };
    scope.check()?;
    let client = Client::of(&options.server)?;
    until_interrupted(&client, &scope, options.since, format, options.bookmarks).await
}

/// Shows what happens, until Ctrl-C or SIGTERM.
///
/// # Errors
/// As [`follow`].
pub(crate) async fn until_interrupted(
    client: &Client,
    scope: &Scope,
    since: Option<u64>,
    format: Format,
    bookmarks: bool,
) -> Result<Exit, CliError> {
    let mut show = |shown: Shown| -> Result<(), CliError> {
        if matches!(shown, Shown::Bookmark(_)) && !bookmarks {
            return Ok(());
        }
        if let Shown::Relist(lost) = &shown {
            note(format, &reason(*lost));
        }
        let text = text(&shown, format)?;
        if text.is_empty() { Ok(()) } else { output::print(&text) }
    };
    tokio::select! {
        ended = follow(client, scope, since, format == Format::Table, &mut show) =>
            ended.map(|()| Exit::Done),
        stopped = interrupted() => stopped.map(|()| Exit::Done),
    }
}

/// Why everything is listed, for people.
fn reason(lost: Lost) -> String {
    match lost {
        Lost::Trimmed => {
            "what happened in between is no longer kept; this is what there is".to_owned()
        }
        Lost::Ahead(revision) => {
            let at = revision
                .map_or_else(String::new, |revision| format!(": it is at revision {revision}"));
            format!(
                "the store is not as far as that{at} (another database, a restored backup, or a \
                 slip in --since); this is what there is"
            )
        }
    }
}

impl Scope {
    fn check(&self) -> Result<(), CliError> {
        match (self.kind, &self.key, &self.service) {
            (_, Some(_), Some(_)) => {
                Err(CliError::Usage("--service and a name: give one of them".to_owned()))
            }
            (Some(kind), None, Some(_)) if kind != Kind::Instance => Err(CliError::Usage(
                "--service is for instances: `blaze watch instances --service NAME`".to_owned(),
            )),
            _ => Ok(()),
        }
    }

    fn call(&self) -> Call {
        let key = self.key.as_ref();
        let service = key.and_then(Key::service_name).or(self.service.as_ref());
        Call::get(format!("{BASE}/watch"))
            .query_if("kind", self.kind.map(Kind::as_str))
            .query_if("name", key.map(|key| key.name().as_str()))
            .query_if("service", service.map(ServiceName::as_str))
            .query_if("layer", self.layer.as_ref().map(LayerName::as_str))
            .query_if("label_selector", self.selector.clone())
    }

    /// What exists now, kind by kind, each with the revision that it reflects.
    async fn list(&self, client: &Client) -> Result<Vec<(Kind, u64, Vec<Value>)>, CliError> {
        if let Some(key) = &self.key {
            return Ok(vec![one(client, key).await?]);
        }
        let mut lists = Vec::new();
        let kinds = match (self.kind, &self.service) {
            (Some(kind), _) => vec![kind],
            (None, Some(service)) => {
                lists.push(one(client, &Key::service(service)).await?);
                vec![Kind::Instance]
            }
            (None, None) => Kind::ALL.to_vec(),
        };
        for kind in kinds {
            let before = revision(client).await?;
            let filter = Filter {
                service: self.service.clone().filter(|_| kind == Kind::Instance),
                selector: self.selector.clone(),
                layer: self.layer.clone(),
                ..Filter::default()
            };
            lists.push(match client.list(kind, &filter).await {
                Ok(listing) => (kind, listing.revision.unwrap_or(before), listing.items),
                // The service is gone, and its instances with it.
                Err(CliError::Problem(refusal)) if refusal.code() == "not_found" => {
                    (kind, before, Vec::new())
                }
                Err(error) => return Err(error),
            });
        }
        Ok(lists)
    }
}

/// One document as a list of at most one.
async fn one(client: &Client, key: &Key) -> Result<(Kind, u64, Vec<Value>), CliError> {
    let before = revision(client).await?;
    Ok(match client.existing(key).await? {
        Some(answer) => (key.kind(), answer.revision.unwrap_or(before), vec![answer.body]),
        None => (key.kind(), before, Vec::new()),
    })
}

/// The revision of the store. It is asked for before a read that may find nothing, so that nothing
/// falls in between.
async fn revision(client: &Client) -> Result<u64, CliError> {
    let answer = client.send(&Call::get(format!("{BASE}/layers")).query("limit", "1")).await?;
    let told = answer.body.get("revision").and_then(Value::as_u64).or(answer.revision);
    told.ok_or_else(|| client.odd("a list has no revision"))
}

/// Tells `show` all that happens, in order. What a new list shows already is not told again.
///
/// # Errors
/// [`CliError`]: the first connection fails, the server refuses, or whatever `show` says. It ends with an error only.
pub(crate) async fn follow(
    client: &Client,
    scope: &Scope,
    since: Option<u64>,
    talks: bool,
    show: &mut (dyn FnMut(Shown) -> Result<(), CliError> + Send),
) -> Result<(), CliError> {
    let mut watcher = Watcher::new(client, scope.call(), since, talks);
    // Up to which revision the last list shows a kind.
    let mut floors: BTreeMap<Kind, u64> = BTreeMap::new();
    loop {
        match watcher.next().await? {
            Told::Change(commit) => {
                if let Some(commit) = above(commit, &mut floors) {
                    show(Shown::Commit(commit))?;
                }
            }
            Told::Bookmark(bookmark) => show(Shown::Bookmark(bookmark))?,
            Told::Relist(lost) => {
                show(Shown::Relist(lost))?;
                floors.clear();
                for (kind, revision, items) in scope.list(client).await? {
                    floors.insert(kind, revision);
                    show(Shown::Listed { kind, revision, items })?;
                }
                watcher.resume(floors.values().copied().min().unwrap_or(0));
            }
        }
    }
}

/// What of a commit the last list does not show yet.
fn above(mut commit: Value, floors: &mut BTreeMap<Kind, u64>) -> Option<Value> {
    let revision = whole(&commit, "revision");
    // Revisions only grow: a list that is behind is of no more use.
    floors.retain(|_, floor| *floor >= revision);
    if floors.is_empty() {
        return Some(commit);
    }
    let changes = commit.get_mut("changes").and_then(Value::as_array_mut)?;
    changes.retain(|change| key_of(change).is_ok_and(|key| !floors.contains_key(&key.kind())));
    if changes.is_empty() { None } else { Some(commit) }
}

fn text(shown: &Shown, format: Format) -> Result<String, CliError> {
    if format == Format::Table {
        return Ok(lines(shown));
    }
    let value = match shown {
        Shown::Commit(value) | Shown::Bookmark(value) => value.clone(),
        Shown::Relist(_) => json!({ "relist": true }),
        Shown::Listed { kind, revision, items } => {
            json!({ "kind": kind, "revision": revision, "items": items })
        }
    };
    match format {
        Format::Json => json_line(&value),
        Format::Table | Format::Yaml => Ok(yaml::documents([&value])),
    }
}

/// One line per change.
fn lines(shown: &Shown) -> String {
    let line = |revision: u64, op: &str, document: &Value, by: &str| {
        let name = key_of(document).map_or_else(|_| "-".to_owned(), |key| name_of(&key));
        format!("{revision:>8}  {op:<6}  {name}{by}\n")
    };
    match shown {
        Shown::Commit(commit) => {
            let by = match member(commit, "subject") {
                subject if subject.is_empty() => subject,
                subject => format!("  by {subject}"),
            };
            let revision = whole(commit, "revision");
            let changes = list(commit, "changes").iter();
            changes.map(|change| line(revision, &member(change, "op"), change, &by)).collect()
        }
        Shown::Bookmark(bookmark) => format!("{:>8}  up to here\n", whole(bookmark, "revision")),
        // People are told on stderr.
        Shown::Relist(_) => String::new(),
        Shown::Listed { revision, items, .. } => {
            items.iter().map(|item| line(*revision, "exists", item, "")).collect()
        }
    }
}

#[cfg(test)]
#[path = "watch_tests.rs"]
mod tests;
