//! `blaze workers` and `blaze audit`.

use blaze_domain::ServiceName;
use blaze_domain::config::{Kind, Timestamp};
use clap::Args;
use serde_json::Value;

use super::call::Call;
use super::client::Client;
use super::kinds::{self, BASE, key_of, name_of};
use super::options::ServerOptions;
use super::text::{age, cell, list, member, note, now_ms, parse_duration, print};
use crate::exit::{CliError, Exit};
use crate::output::{self, Align, Format, terminal_width};

/// Options of `blaze audit`.
#[derive(Debug, Args)]
pub struct AuditOptions {
    /// Only what this subject did or tried
    #[arg(long, value_name = "SUBJECT")]
    pub subject: Option<String>,
    /// Only documents of this kind
    #[arg(long, value_name = "KIND", value_parser = kinds::parse_kind)]
    pub kind: Option<Kind>,
    /// Only documents of this name
    #[arg(long, value_name = "NAME")]
    pub name: Option<String>,
    /// Only this action: create, update, patch, delete, rollback, apply, reveal, token_create,
    /// token_revoke, trim, …
    #[arg(long, value_name = "ACTION")]
    pub action: Option<String>,
    /// Only what was allowed, or only what was refused
    #[arg(long, value_name = "OUTCOME", value_parser = ["allowed", "denied"])]
    pub outcome: Option<String>,
    /// Not before this time: RFC 3339, or how long ago (30m, 24h, 7d)
    #[arg(long, value_name = "TIME", value_parser = parse_time)]
    pub since: Option<Timestamp>,
    /// Before this time, given likewise
    #[arg(long, value_name = "TIME", value_parser = parse_time)]
    pub until: Option<Timestamp>,
    /// At most so many entries, the newest
    #[arg(long, value_name = "N", default_value_t = 100,
        value_parser = clap::value_parser!(u64).range(1..))]
    pub limit: u64,
    /// Which server.
    #[command(flatten)]
    pub server: ServerOptions,
}

fn parse_time(text: &str) -> Result<Timestamp, String> {
    if let Ok(time) = text.parse::<Timestamp>() {
        return Ok(time);
    }
    let ago = parse_duration(text).map_err(|_| {
        format!("{text:?} is neither a time, as 2026-11-21T07:01:12Z, nor a duration, as 24h")
    })?;
    let ago = i64::try_from(ago.as_millis()).unwrap_or(i64::MAX);
    Ok(Timestamp::from_millis(now_ms().saturating_sub(ago)))
}

/// Lists the workers.
///
/// # Errors
/// [`CliError`].
pub(super) async fn workers(server: &ServerOptions, format: Format) -> Result<Exit, CliError> {
    let workers = Client::of(server)?.workers().await?;
    let items = list(&workers, "items");
    if items.is_empty() && format == Format::Table {
        note(format, "no worker has connected yet");
        return Ok(Exit::Done);
    }
    print(&workers, format, |_| workers_table(items, now_ms(), terminal_width()))
}

fn workers_table(workers: &[Value], now_ms: i64, width: Option<u16>) -> String {
    let yes = |worker: &Value, name: &str| match worker.get(name).and_then(Value::as_bool) {
        Some(true) => "yes".to_owned(),
        Some(false) => "no".to_owned(),
        None => "-".to_owned(),
    };
    output::table(
        workers,
        width,
        &[
            ("LAYER", Align::Left, &|worker| cell(worker.get("layer"))),
            ("NODE", Align::Left, &|worker| cell(worker.get("node"))),
            ("CONNECTED", Align::Left, &|worker| yes(worker, "connected")),
            ("REVISION", Align::Right, &|worker| cell(worker.get("revision"))),
            ("IN SYNC", Align::Left, &|worker| yes(worker, "in_sync")),
            ("SEEN", Align::Right, &|worker| age(worker.get("last_seen"), now_ms)),
            ("VERSION", Align::Left, &|worker| cell(worker.get("version"))),
            ("ID", Align::Left, &|worker| cell(worker.get("worker_id"))),
        ],
    )
}

/// Lists who did what.
///
/// # Errors
/// [`CliError`].
pub(super) async fn audit(options: &AuditOptions, format: Format) -> Result<Exit, CliError> {
    let client = Client::of(&options.server)?;
    let (service, name) = service_and_name(options)?;
    let call = Call::get(format!("{BASE}/audit"))
        .query_if("subject", options.subject.clone())
        .query_if("kind", options.kind.map(Kind::as_str))
        .query_if("name", name)
        .query_if("action", options.action.clone())
        .query_if("outcome", options.outcome.clone())
        .query_if("since_time", options.since.map(|time| time.to_string()))
        .query_if("until_time", options.until.map(|time| time.to_string()));
    let mut listing = client.pages(&call, Some(options.limit)).await?;
    if let Some(service) = service {
        listing
            .items
            .retain(|entry| entry.get("service").and_then(Value::as_str) == Some(service.as_str()));
    }
    if listing.items.is_empty() && format == Format::Table {
        note(format, "nothing that was written down matches");
        return Ok(Exit::Done);
    }
    if listing.is_cut() {
        note(format, "there are older entries: --limit N shows more, --since and --until fewer");
    }
    print(&listing.into_json(), format, |listing| {
        audit_table(list(listing, "items"), now_ms(), terminal_width())
    })
}

/// An instance may be given as `SERVICE/NAME`; the server filters by the name alone.
fn service_and_name(
    options: &AuditOptions,
) -> Result<(Option<ServiceName>, Option<String>), CliError> {
    match options.name.as_deref().map(|name| (name, name.split_once('/'))) {
        None => Ok((None, None)),
        Some((name, None)) => Ok((None, Some(name.to_owned()))),
        Some((_, Some((service, name)))) => {
            let service = kinds::parse_service(service).map_err(CliError::Usage)?;
            Ok((Some(service), Some(name.to_owned())))
        }
    }
}

fn audit_table(entries: &[Value], now_ms: i64, width: Option<u16>) -> String {
    let document =
        |entry: &Value| key_of(entry).map_or_else(|_| cell(entry.get("name")), |key| name_of(&key));
    output::table(
        entries,
        width,
        &[
            ("AGE", Align::Right, &|entry| age(entry.get("time"), now_ms)),
            ("REVISION", Align::Right, &|entry| cell(entry.get("revision"))),
            ("SUBJECT", Align::Left, &|entry| cell(entry.get("subject"))),
            ("ACTION", Align::Left, &|entry| cell(entry.get("action"))),
            ("DOCUMENT", Align::Left, &document),
            ("OUTCOME", Align::Left, &|entry| match member(entry, "code") {
                code if code.is_empty() => cell(entry.get("outcome")),
                code => code,
            }),
            ("FROM", Align::Left, &|entry| cell(entry.get("address"))),
            ("REQUEST", Align::Left, &|entry| cell(entry.get("request_id"))),
        ],
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    const NOW: i64 = 1_795_244_472_345;

    #[test]
    fn workers_are_a_table() {
        let workers = [
            json!({"layer": "edge", "node": "robot-1", "worker_id": "w1", "version": "0.1.0",
                "connected": true, "revision": 412,
                "digest": "sha256:x", "in_sync": true, "last_seen": "2026-11-21T07:01:10.345Z"}),
            json!({
                "layer": "fog",
                "node": null,
                "worker_id": "w2",
                "connected": false,
                "revision": null,
                "in_sync": null,
            }),
        ];
        assert_eq!(
            workers_table(&workers, NOW, None),
            "LAYER  NODE     CONNECTED  REVISION  IN SYNC  SEEN  VERSION  ID\n\
             edge   robot-1  yes             412  yes        2s  0.1.0    w1\n\
             fog    -        no                -  -           -  -        w2\n"
        );
    }

    #[test]
    fn refusals_show_their_code() {
        let entries = [json!({"id": "1", "time": "2026-11-21T06:01:12.345Z", "revision": null,
                "subject": "eve",
            "roles": ["viewer"], "action": "delete", "kind": "Instance", "service": "slam",
            "name": "0", "outcome": "denied",
            "code": "permission_denied", "paths": [], "request_id": "r-1", "address": "10.0.0.9"})];
        let text = audit_table(&entries, NOW, None);
        assert!(text.contains("instance/slam/0  permission_denied  10.0.0.9  r-1"), "{text}");
    }

    #[test]
    fn times_are_absolute_or_ago() {
        assert_eq!(parse_time("2026-11-21T07:01:12.345Z").unwrap(), Timestamp::from_millis(NOW));
        let hour_ago = parse_time("1h").unwrap().as_millis();
        let ago = now_ms() - hour_ago;
        assert!((3_600_000..3_610_000).contains(&ago), "{ago}");
        assert!(parse_time("yesterday").unwrap_err().contains("24h"));
    }
}
