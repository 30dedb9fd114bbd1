//! `blaze node join`.

use std::path::{Path, PathBuf};

use blaze_domain::config::Key;
use blaze_runtime::state::read_small;
use serde_json::{Value, json};

use super::options::JoinOptions;
use super::plan::{self, Around, NodePlan};
use super::token_file::{self, TokenPlace};
use crate::config::call::Call;
use crate::config::client::{Answer, Client};
use crate::config::endpoint::{Endpoint, Surroundings, resolve};
use crate::config::kinds::document_path;
use crate::config::text::{member, note, now_ms, print};
use crate::config::token::{Wanted, ask_for};
use crate::config::yaml;
use crate::exit::{CliError, Exit};
use crate::output::Format;

/// What will be done, once everything is known that could speak against it.
struct Plan {
    key: Key,
    node: NodePlan,
    /// Of the document that is there.
    revision: Option<Value>,
    /// Entity tag of the document that is there.
    tag: Option<String>,
    place: TokenPlace,
    /// A token that is there and will do, in words.
    kept: Option<String>,
    node_file: Value,
    notes: Vec<String>,
}

/// Joins a node. What speaks against it is told before anything is changed.
///
/// # Errors
/// [`CliError`].
pub(super) async fn run(options: &JoinOptions, format: Format) -> Result<Exit, CliError> {
    let endpoint = resolve(&options.server, &Surroundings::of_process())?;
    let place = place(options, format)?;
    let client = Client::new(endpoint.clone())?;
    let plan = prepare(options, &client, &endpoint, place).await?;
    let answer = if options.dry_run {
        told(&plan, &json!({ "revision": plan.revision }), None, true)
    } else {
        let document = write_document(&client, &plan).await?;
        let token = match &plan.kept {
            None => make_token(options, &client, &plan.place).await?,
            Some(_) => None,
        };
        if let Some(file) = &options.node_file {
            write_node_file(file, &plan.node_file)?;
        }
        told(&plan, &document, token, false)
    };
    say(options, &plan, &answer, format);
    let is_elsewhere =
        options.node_file.is_some() && plan.place != TokenPlace::Stdout && !options.dry_run;
    if format != Format::Table || !is_elsewhere {
        print(&answer, format, |answer| on_stdout(options, &plan, answer))?;
    }
    Ok(Exit::Done)
}

/// Where the token goes, and whether that fits the rest.
fn place(options: &JoinOptions, format: Format) -> Result<TokenPlace, CliError> {
    match &options.token_out {
        _ if options.no_token => Ok(TokenPlace::None),
        Some(path) if path.as_os_str() == "-" => {
            if format == Format::Table && options.node_file.is_none() {
                return Err(CliError::Usage(
                    "--token-out - puts the token on standard output: give --node-file FILE for \
                     the node file, or -o json for both"
                        .to_owned(),
                ));
            }
            Ok(TokenPlace::Stdout)
        }
        Some(path) => Ok(TokenPlace::File(path.clone())),
        None => Ok(TokenPlace::File(PathBuf::from(format!("{}.token", options.name)))),
    }
}

async fn prepare(
    options: &JoinOptions,
    client: &Client,
    endpoint: &Endpoint,
    place: TokenPlace,
) -> Result<Plan, CliError> {
    let kind = kind_of(options, client).await?;
    let key = Key::node(&options.name);
    let existing = client.existing(&key).await?;
    // Whoever joins again need not say again where the node is.
    let addresses = match &existing {
        Some(answer) if options.addresses.is_empty() => plan::addresses_of(&answer.body),
        Some(_) | None => options.addresses.clone(),
    };
    let around = Around {
        server: &endpoint.url,
        ca_file: endpoint.ca_file.as_deref(),
        shows_certificate: endpoint.client_certificate.is_some(),
        kind: &kind,
        token_file: match &place {
            TokenPlace::File(file) => Some(file),
            TokenPlace::None | TokenPlace::Stdout => None,
        },
        addresses: &addresses,
    };
    let (node_file, notes) = plan::node_file(options, &around)?;
    let node = plan::document(options, existing.as_ref().map(|answer| &answer.body))?;
    let kept = match &place {
        TokenPlace::File(file) if !options.renew => {
            token_file::inspect(file, options.layer.as_str(), now_ms())?
        }
        TokenPlace::File(_) | TokenPlace::Stdout | TokenPlace::None => None,
    };
    if let (TokenPlace::File(file), None) = (&place, &kept) {
        token_file::check_writable(file)?;
    }
    if let Some(file) = &options.node_file {
        check_node_file(file, &node_file)?;
        token_file::check_writable(file)?;
    }
    let revision = existing.as_ref().and_then(|answer| answer.body.get("revision").cloned());
    let tag = existing.map(|answer| client.tag(&answer, false)).transpose()?;
    Ok(Plan { key, node, revision, tag, place, kept, node_file, notes })
}

/// The kind of the layer. Without the layer there is nothing to join.
async fn kind_of(options: &JoinOptions, client: &Client) -> Result<String, CliError> {
    let layer = &options.layer;
    let read = client.document(&Key::layer(layer), None).await.map_err(|error| match error {
        CliError::Problem(refusal) if refusal.code() == "not_found" => CliError::Problem(refusal)
            .advised(format!(
                "A node joins a layer that is there. Make it first: echo '{{kind: Layer, name: \
             {layer}, spec: {{kind: edge}}}}' | blaze apply -f -"
            )),
        other => other,
    })?;
    let kind = read.body.pointer("/spec/kind").and_then(Value::as_str);
    kind.map(str::to_owned).ok_or_else(|| client.odd("a layer has no `spec.kind`"))
}

/// Makes the document, or changes what was read. What somebody else did in between is a conflict.
async fn write_document(client: &Client, plan: &Plan) -> Result<Value, CliError> {
    if plan.node.action == "unchanged" {
        return Ok(json!({ "revision": plan.revision }));
    }
    let call = Call::put(document_path(&plan.key), &plan.node.body).if_match(plan.tag.clone());
    let Answer { body, .. } = client.send(&call).await?;
    Ok(body)
}

/// Makes the token and puts it where it goes; gives what may be shown of it.
async fn make_token(
    options: &JoinOptions,
    client: &Client,
    place: &TokenPlace,
) -> Result<Option<Value>, CliError> {
    if *place == TokenPlace::None {
        return Ok(None);
    }
    let subject = format!("worker-{}", options.name);
    let roles = ["worker".to_owned()];
    let wanted = Wanted {
        subject: &subject,
        roles: &roles,
        layer: Some(&options.layer),
        expires: options.expires,
    };
    let made = match options.signing.sign(&wanted)? {
        Some(made) => made,
        None => ask_for(client, &wanted).await.map_err(|error| without_token(options, error))?,
    };
    let mut shown = json!({
        "id": made.get("id"),
        "subject": subject,
        "layer": options.layer,
        "expire_time": made.get("expire_time"),
    });
    let text = made.get("token").and_then(Value::as_str).unwrap_or_default();
    match place {
        TokenPlace::File(file) => token_file::write(file, text).map_err(|error| {
            error.advised(format!(
                "The token {} was made and is lost: blaze token revoke {0}",
                member(&shown, "id")
            ))
        })?,
        TokenPlace::Stdout => shown["text"] = json!(text),
        TokenPlace::None => {}
    }
    Ok(Some(shown))
}

/// What to do where the server gives no token; the node is there by now, so the next run goes on
/// from here.
fn without_token(options: &JoinOptions, error: CliError) -> CliError {
    let name = &options.name;
    let signing =
        matches!(&error, CliError::Problem(refusal) if refusal.code() == "signing_disabled");
    let what = match signing {
        true => {
            "sign it with --key-file FILE --alg ALG, or give --no-token for a main service that \
             runs with --dev"
        }
        false => "run it again when that is mended",
    };
    error.advised(format!("Node {name} is there, its token is not: {what}."))
}

/// A node file that says something else is nobody's to replace.
fn check_node_file(file: &Path, wanted: &Value) -> Result<(), CliError> {
    let place = file.display();
    let there = read_small(file)
        .map_err(|error| CliError::Failed(format!("the node file {place}: {error}")))?;
    match there {
        Some(there) if there != yaml::document(wanted).as_bytes() => {
            Err(CliError::Failed(format!(
                "{place} is there and says something else: it was left alone, and nothing was \
                 changed.\n  Name another file, or compare with what --dry-run prints."
            )))
        }
        Some(_) | None => Ok(()),
    }
}

fn write_node_file(file: &Path, content: &Value) -> Result<(), CliError> {
    let failed = |error: std::io::Error| {
        CliError::Failed(format!("the node file {}: {error}", file.display()))
    };
    let there = read_small(file).map_err(failed)?;
    if there.is_some() {
        // The same, as was looked at before.
        return Ok(());
    }
    let mut open = std::fs::OpenOptions::new();
    let file = open.write(true).create_new(true).open(file).map_err(failed)?;
    std::io::Write::write_all(&mut &file, yaml::document(content).as_bytes()).map_err(failed)
}

/// The answer as JSON.
fn told(plan: &Plan, document: &Value, token: Option<Value>, dry_run: bool) -> Value {
    let file = match &plan.place {
        TokenPlace::File(file) => json!(file),
        TokenPlace::Stdout | TokenPlace::None => Value::Null,
    };
    let action = match (&plan.place, &plan.kept) {
        (TokenPlace::None, _) => "none",
        (_, Some(_)) => "kept",
        (_, None) => "created",
    };
    let mut of_token = json!({ "action": action, "file": file });
    if let (Some(Value::Object(made)), Value::Object(members)) = (token, &mut of_token) {
        members.extend(made);
    }
    json!({
        "dry_run": dry_run,
        "node": {
            "name": plan.key.name().as_str(),
            "action": plan.node.action,
            "revision": document.get("revision"),
        },
        "token": of_token,
        "node_file": plan.node_file,
    })
}

/// What people are told beside the node file.
fn say(options: &JoinOptions, plan: &Plan, answer: &Value, format: Format) {
    let would = if options.dry_run { "would be " } else { "" };
    let name = &options.name;
    note(format, &format!("node {name}: {would}{}", plan.node.action));
    match (&plan.place, &plan.kept) {
        (TokenPlace::File(file), Some(kept)) => {
            note(
                format,
                &format!("token: {} is there and {kept}; --renew makes a new one", file.display()),
            );
        }
        (TokenPlace::File(file), None) => {
            let id = answer.pointer("/token/id").and_then(Value::as_str).unwrap_or("-");
            note(format, &format!("token: {would}written to {} (id {id})", file.display()));
        }
        (TokenPlace::Stdout | TokenPlace::None, _) => {}
    }
    for text in &plan.notes {
        note(format, text);
    }
    if let Some(file) = &options.node_file {
        note(format, &format!("node file: {would}in {}", file.display()));
    }
}

/// What stands on standard output for people: the token where that was asked for, else the node
/// file.
fn on_stdout(options: &JoinOptions, plan: &Plan, answer: &Value) -> String {
    match &plan.place {
        TokenPlace::Stdout if !options.dry_run => {
            member(answer.get("token").unwrap_or(&Value::Null), "text")
        }
        _ => yaml::document(&plan.node_file),
    }
}
