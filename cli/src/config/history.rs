//! `blaze history`, `rollback` and `revert`.

use clap::Args;
use serde_json::{Value, json};

use super::apply;
use super::call::Call;
use super::client::Client;
use super::kinds::{BASE, document_path, name_of};
use super::options::{DocumentOptions, ServerOptions};
use super::text::{age, cell, list, note, now_ms, print};
use crate::exit::{CliError, Exit};
use crate::output::{self, Align, Format, terminal_width};

/// Options of `blaze history`.
#[derive(Debug, Args)]
pub struct HistoryOptions {
    /// Which document; also one that was deleted.
    #[command(flatten)]
    pub document: DocumentOptions,
    /// At most so many changes, the newest
    #[arg(long, value_name = "N", default_value_t = 100,
        value_parser = clap::value_parser!(u64).range(1..))]
    pub limit: u64,
    /// With the whole document after each change (json and yaml)
    #[arg(long)]
    pub full: bool,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Options of `blaze rollback`.
#[derive(Debug, Args)]
pub struct RollbackOptions {
    /// Which document; also one that was deleted.
    #[command(flatten)]
    pub document: DocumentOptions,
    /// The revision whose content it gets back
    #[arg(long, value_name = "R", value_parser = clap::value_parser!(u64).range(1..))]
    pub to: u64,
    /// Also when somebody else changed the document in between
    #[arg(long)]
    pub force: bool,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Options of `blaze revert`.
#[derive(Debug, Args)]
pub struct RevertOptions {
    /// The revision to undo, as a whole
    #[arg(value_name = "R", value_parser = clap::value_parser!(u64).range(1..))]
    pub revision: u64,
    /// Also where a document was changed since
    #[arg(long)]
    pub force: bool,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

/// Shows the changes of a document.
///
/// # Errors
/// [`CliError`].
pub(super) async fn run(options: &HistoryOptions, format: Format) -> Result<Exit, CliError> {
    let key = options.document.key()?;
    let client = Client::of(&options.server)?;
    let call = Call::get(format!("{}/history", document_path(&key)))
        .query_if("view", (options.full && format != Format::Table).then_some("full"));
    let listing = match client.pages(&call, Some(options.limit)).await {
        // The same error with what may have been meant.
        Err(CliError::Problem(refusal)) if refusal.code() == "not_found" => {
            client.document(&key, None).await?;
            return Err(CliError::Problem(refusal));
        }
        other => other?,
    };
    if options.full {
        note(format, "--full shows the documents with -o json or -o yaml");
    }
    if listing.is_cut() {
        note(format, "there are older changes: --limit N shows more");
    }
    print(&listing.into_json(), format, |listing| {
        table(list(listing, "items"), now_ms(), terminal_width())
    })
}

/// One line per change, newest first.
pub(super) fn table(changes: &[Value], now_ms: i64, width: Option<u16>) -> String {
    output::table(
        changes,
        width,
        &[
            ("REVISION", Align::Right, &|change| cell(change.get("revision"))),
            ("AGE", Align::Right, &|change| age(change.get("time"), now_ms)),
            ("CHANGE", Align::Left, &|change| cell(change.get("op"))),
            ("BY", Align::Left, &|change| cell(change.get("subject"))),
            ("PATHS", Align::Left, &|change| cell(change.get("paths"))),
        ],
    )
}

/// Gives a document an older content.
///
/// # Errors
/// [`CliError`].
pub(super) async fn rollback(options: &RollbackOptions, format: Format) -> Result<Exit, CliError> {
    let key = options.document.key()?;
    let client = Client::of(&options.server)?;
    // One that was deleted has no revision to insist on: it is made anew.
    let existing = client.existing(&key).await?;
    let tag = existing.map(|read| client.tag(&read, options.force)).transpose()?;
    let call =
        Call::post(format!("{}/rollback", document_path(&key)), &json!({ "revision": options.to }))
            .if_match(tag);
    let document = client.send_about(&key, &call).await?.body;
    print(&document, format, |document| {
        format!(
            "{} is as it was at revision {}, at revision {}",
            name_of(&key),
            options.to,
            cell(document.get("revision"))
        )
    })
}

/// Undoes a revision.
///
/// # Errors
/// [`CliError`].
pub(super) async fn revert(options: &RevertOptions, format: Format) -> Result<Exit, CliError> {
    let client = Client::of(&options.server)?;
    let body = json!({ "revision": options.revision, "force": options.force });
    let hint = "--force undoes it also where documents were changed since, and loses those changes";
    let answer = client.send(&Call::post(format!("{BASE}/revert"), &body)).await;
    let answer = answer.map_err(|error| error.hinted("revision_conflict", hint))?.body;
    print(&answer, format, apply::table)?;
    note(format, &apply::summary(&answer));
    Ok(Exit::Done)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_are_a_table() {
        let items = [
            json!({"revision": 412, "op": "update", "time": "2026-11-21T07:01:12.345Z",
                "subject": "ops", "request_id": "r",
                "paths": ["/spec/type", "/labels/site"]}),
            json!({
                "revision": 9,
                "op": "create",
                "time": "2026-11-20T07:01:12.345Z",
                "subject": "dev",
                "request_id": "r",
                "paths": [],
            }),
        ];
        assert_eq!(
            table(&items, 1_795_244_472_345, None),
            "REVISION  AGE  CHANGE  BY   PATHS\n\
             \x20    412   0s  update  ops  /spec/type,/labels/site\n\
             \x20      9   1d  create  dev  -\n"
        );
    }
}
