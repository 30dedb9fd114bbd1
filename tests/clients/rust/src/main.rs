//! Drives a blaze-config (`BLAZE_SERVER`, `BLAZE_TOKEN`) through the client that progenitor makes
//! of `openapi-3.0.json`.

mod client {
    #![allow(clippy::all, unused, unused_comparisons, reason = "generated")]
    include!(concat!(env!("OUT_DIR"), "/client.rs"));
}

use std::fmt::Debug;
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use client::{ByteStream, Client, Error, ResponseValue, types};
use futures_util::TryStreamExt;
use reqwest::StatusCode;
use reqwest::header::{AUTHORIZATION, HeaderMap, HeaderValue};
use serde::de::DeserializeOwned;
use serde_json::{Value, json};

type Answer<T> = Result<ResponseValue<T>, Error<ByteStream>>;

fn main() -> anyhow::Result<()> {
    let server = std::env::var("BLAZE_SERVER").context("BLAZE_SERVER")?;
    let token = std::env::var("BLAZE_TOKEN").context("BLAZE_TOKEN")?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(round_trip(&server, &token))?;
    eprintln!("rust: the round trip is done");
    Ok(())
}

async fn round_trip(server: &str, token: &str) -> anyhow::Result<()> {
    let client = connect(server, token)?;
    created(&client).await.context("create")?;
    paged(&client).await.context("list")?;
    replaced(&client).await.context("replace")?;
    patched(&client).await.context("patch")?;
    applied(&client).await.context("apply")?;
    remembered(&client).await.context("history")?;
    deleted(&client).await.context("delete")?;
    let stranger = connect(server, "not-a-token")?;
    refused(stranger.list_nodes().send().await, 401, "unauthenticated").await?;
    Ok(())
}

fn connect(server: &str, token: &str) -> anyhow::Result<Client> {
    let headers =
        HeaderMap::from_iter([(AUTHORIZATION, HeaderValue::from_str(&format!("Bearer {token}"))?)]);
    let http = reqwest::Client::builder()
        .default_headers(headers)
        .timeout(Duration::from_secs(15))
        .build()?;
    Ok(Client::new_with_client(server, http))
}

/// A body in the form that the document gives it.
fn body<T: DeserializeOwned>(value: Value) -> anyhow::Result<T> {
    Ok(serde_json::from_value(value)?)
}

/// What was asked for.
async fn given<T: Debug>(answer: Answer<T>) -> anyhow::Result<ResponseValue<T>> {
    match answer {
        Ok(response) => Ok(response),
        Err(Error::ErrorResponse(response)) => {
            bail!("{}", String::from_utf8_lossy(&whole(response).await?))
        }
        Err(error) => bail!("{error:?}"),
    }
}

/// The body of a refusal: progenitor takes `application/problem+json` for bytes.
async fn whole(response: ResponseValue<ByteStream>) -> anyhow::Result<Vec<u8>> {
    let mut stream = response.into_inner_stream();
    let mut bytes = Vec::new();
    while let Some(chunk) = stream.try_next().await? {
        bytes.extend_from_slice(&chunk);
    }
    Ok(bytes)
}

/// The refusal that is expected.
async fn refused<T: Debug>(
    answer: Answer<T>,
    status: u16,
    code: &str,
) -> anyhow::Result<types::Problem> {
    let response = match answer {
        Err(Error::ErrorResponse(response)) => response,
        other => bail!("{other:?} instead of {status}"),
    };
    let found = response.status();
    let problem: types::Problem = serde_json::from_slice(&whole(response).await?)?;
    ensure!(
        found == status && problem.status == i64::from(status) && *problem.code == code,
        "{problem:?} instead of {status} {code}"
    );
    Ok(problem)
}

fn header<'a, T>(answer: &'a ResponseValue<T>, name: &str) -> anyhow::Result<&'a str> {
    Ok(answer.headers().get(name).with_context(|| format!("no {name}"))?.to_str()?)
}

async fn created(client: &Client) -> anyhow::Result<()> {
    let edge: types::LayerInput = body(json!({
        "name": "edge", "labels": { "site": "lab" }, "spec": {
            "kind": "edge",
            "config": { "log": { "level": "info" } },
        },
    }))?;
    let layer = given(client.create_layer().body(edge).send().await).await?;
    ensure!(layer.status() == StatusCode::CREATED && layer.spec.kind == types::LayerSpecKind::Edge);
    ensure!(layer.labels.get("site").is_some_and(|site| **site == "lab"));
    ensure!(header(&layer, "etag")? == format!("\"{}\"", layer.revision));
    ensure!(header(&layer, "location")? == "/api/v1/layers/edge");

    for name in ["robot-1", "robot-2", "robot-3"] {
        let spec = types::NodeSpec::builder()
            .layer("edge")
            .type_(types::NodeSpecType::Mobile)
            .addresses(vec![types::NodeSpecAddressesItem::try_from("10.0.1.7")?]);
        let input: types::NodeInput = types::NodeInput::builder()
            .name(types::NodeInputName::try_from(name)?)
            .spec(types::NodeSpec::try_from(spec)?)
            .try_into()?;
        let key = format!("make-{name}");
        let node = given(
            client.create_node().idempotency_key(key.as_str()).body(input.clone()).send().await,
        )
        .await?;
        let again =
            given(client.create_node().idempotency_key(key.as_str()).body(input).send().await)
                .await?;
        ensure!(header(&again, "idempotent-replayed")? == "true" && again.uid == node.uid);
    }

    let slam: types::ServiceInput = body(json!({
        "name": "slam", "spec": {
            "config": { "camera": { "rate_hz": 30 } },
            "schema": { "type": "object" },
        },
    }))?;
    let service = given(client.create_service().body(slam).send().await).await?;
    ensure!(
        matches!(service.spec.schema, Some(types::ServiceSpecSchema::Object(_))),
        "{service:?}"
    );
    Ok(())
}

async fn paged(client: &Client) -> anyhow::Result<()> {
    let mut names = Vec::new();
    let mut token = String::new();
    loop {
        let page =
            given(client.list_nodes().limit(2).page_token(token.as_str()).send().await).await?;
        ensure!(page.items.len() <= 2, "{page:?}");
        names.extend(page.items.iter().map(|node| node.name.to_string()));
        token.clone_from(&page.next_page_token);
        if token.is_empty() {
            break;
        }
    }
    ensure!(names == ["robot-1", "robot-2", "robot-3"], "{names:?}");
    Ok(())
}

async fn replaced(client: &Client) -> anyhow::Result<()> {
    let node = given(client.get_node().name("robot-1").send().await).await?;
    ensure!(
        node.spec.type_ == types::NodeSpecType::Mobile && node.spec.addresses.len() == 1,
        "{node:?}"
    );
    let etag = header(&node, "etag")?;
    let input: types::NodeInput = body(json!({ "spec": { "layer": "edge", "type": "static" } }))?;
    let replace = || client.replace_node().name("robot-1").if_match(etag).body(input.clone());
    let now = given(replace().send().await).await?;
    ensure!(
        now.revision > node.revision && now.uid == node.uid && now.create_time == node.create_time,
        "{now:?}"
    );
    let stale = refused(replace().send().await, 412, "precondition_failed").await?;
    ensure!(
        stale.revision == Some(i64::try_from(now.revision.get())?) && !stale.request_id.is_empty(),
        "{stale:?}"
    );
    ensure!(stale.type_ == "/docs/errors/precondition_failed", "{stale:?}");
    Ok(())
}

async fn patched(client: &Client) -> anyhow::Result<()> {
    let patch: types::DocumentPatch = body(json!({
        "labels": { "site": "lab" },
        "spec": { "config": { "camera": { "rate_hz": 20 } } },
    }))?;
    let service =
        given(client.patch_service().name("slam").if_match("*").body(patch).send().await).await?;
    let config = service.spec.config.as_ref().context("no config")?;
    ensure!(
        config.get("camera") == Some(&json!({ "rate_hz": 20 })) && service.labels.len() == 1,
        "{service:?}"
    );
    Ok(())
}

async fn applied(client: &Client) -> anyhow::Result<()> {
    let items: Vec<types::ApplyItem> = body(json!([
        { "kind": "Instance", "service": "slam", "name": "0",
          "spec": { "node": "robot-1", "config": { "camera": { "rate_hz": 10 } } } },
        { "kind": "Layer", "name": "fog", "spec": { "kind": "fog" } },
    ]))?;
    let dry = given(client.apply().dry_run(true).body(items.clone()).send().await).await?;
    let report = given(client.apply().body(items).send().await).await?;
    ensure!(dry.dry_run && !report.dry_run && report.revision == dry.revision + 1, "{report:?}");
    ensure!(report.results.len() == 2 && report.affected.len() == 1, "{report:?}");
    ensure!(
        report.results.iter().all(|result| result.action == types::ApplyResultAction::Created),
        "{report:?}"
    );

    let effective =
        given(client.get_effective().service("slam").instance("0").explain(true).send().await)
            .await?;
    ensure!(
        effective.layer.as_deref() == Some("edge") && effective.node.as_deref() == Some("robot-1"),
        "{effective:?}"
    );
    let config = Value::Object(effective.config.clone());
    ensure!(
        config == json!({ "log": { "level": "info" }, "camera": { "rate_hz": 10 } }),
        "{config}"
    );
    let source = effective.explain.get("/camera/rate_hz").context("no explanation")?;
    ensure!(source.kind == types::ExplanationKind::Instance, "{source:?}");
    ensure!(
        source.overridden.first().and_then(|weaker| weaker.get("value")) == Some(&json!(20)),
        "{source:?}"
    );
    Ok(())
}

async fn remembered(client: &Client) -> anyhow::Result<()> {
    let history = given(client.list_node_history().name("robot-1").send().await).await?;
    let operations: Vec<types::HistoryEntryOp> =
        history.items.iter().map(|entry| entry.op).collect();
    ensure!(
        operations == [types::HistoryEntryOp::Update, types::HistoryEntryOp::Create],
        "{history:?}"
    );
    ensure!(
        history
            .items
            .first()
            .is_some_and(|newest| newest.paths.iter().any(|path| path == "/spec/type"))
    );
    Ok(())
}

async fn deleted(client: &Client) -> anyhow::Result<()> {
    let blind =
        refused(client.delete_node().name("robot-2").send().await, 428, "precondition_required")
            .await?;
    let etag = format!("\"{}\"", blind.revision.context("no revision")?);
    let gone =
        given(client.delete_node().name("robot-2").if_match(etag.as_str()).send().await).await?;
    ensure!(gone.status() == StatusCode::NO_CONTENT);
    refused(client.get_node().name("robot-2").send().await, 404, "not_found").await?;
    refused(client.delete_node().name("robot-1").if_match("*").send().await, 409, "in_use").await?;
    Ok(())
}
