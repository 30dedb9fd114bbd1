//! The whole interface on a core with a store in memory, called without a network.

mod answers;
mod bound;
mod fixture;
mod monitors;

use std::time::Duration;

use blaze_domain::config::Code;
use blaze_proto::v1::watch_response::Event;
use blaze_proto::{Message, google, v1};
use blaze_runtime::{CheckStatus, Gate as Deciding};
use bytes::{BufMut as _, BytesMut};
use futures::StreamExt as _;
use tonic::Request;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;
use tonic_health::pb::{HealthCheckRequest, HealthCheckResponse};
use tonic_reflection::pb::v1::{
    ServerReflectionRequest, ServerReflectionResponse, server_reflection_request,
    server_reflection_response,
};
use tonic_types::StatusExt as _;

use self::fixture::{Fixture, code, create, exactly, layer, now_s, reference};
use super::methods::{METHODS, PATH};
use super::{CONFIG_DESCRIPTORS, MAX_MESSAGE_BYTES};
use crate::auth::Right;

const REFLECTION: &str = "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo";

#[tokio::test]
async fn no_method_answers_without_a_good_token() {
    let fixture = Fixture::guarded().await;
    let set = google::FileDescriptorSet::decode(CONFIG_DESCRIPTORS).unwrap();
    let mut services = set.file.iter().flat_map(|file| &file.service);
    let service = services.find(|service| service.name() == "ConfigService").unwrap();
    let expired = format!("Bearer {}", fixture.token("admin", -120));
    let good = fixture.token("admin", 3600);
    let forged = format!("Bearer {good}x");
    let mut messages = std::collections::BTreeSet::new();
    for name in
        service.method.iter().map(google::MethodDescriptorProto::name).chain(["NoSuchMethod"])
    {
        let path = format!("{PATH}{name}");
        for headers in [
            &[][..],
            &[("authorization", "Bearer garbage")],
            &[("authorization", "Basic YTpi")],
            &[("authorization", good.as_str())],
            &[("authorization", expired.as_str())],
            &[("authorization", forged.as_str())],
        ] {
            let posted = fixture.post(&path, headers, &[]).await;
            assert_eq!(posted.status.code(), tonic::Code::Unauthenticated, "{name} {headers:?}");
            assert_eq!(code(&posted.status), Code::Unauthenticated);
            assert!(posted.headers.contains_key("x-request-id"), "{name}");
            assert!(!posted.headers.contains_key("blaze-revision"), "{name}");
            messages.insert(posted.status.message().to_owned());
        }
    }
    assert_eq!(messages.len(), 1, "one text for all causes: {messages:?}");
}

#[tokio::test]
async fn a_role_opens_what_its_rights_say() {
    let fixture = Fixture::guarded().await;
    for (role, rights) in [
        ("viewer", &[Right::Read][..]),
        ("operator", &[Right::Read, Right::Write]),
        ("admin", &[Right::Read, Right::Write, Right::Admin]),
    ] {
        let token = format!("Bearer {}", fixture.token(role, 3600));
        for method in METHODS.iter().filter(|method| method.name != "Watch") {
            let path = format!("{PATH}{}", method.name);
            let posted = fixture.post(&path, &[("authorization", token.as_str())], &[]).await;
            let refused = posted.status.code() == tonic::Code::PermissionDenied;
            assert_eq!(
                refused,
                !rights.contains(&method.right),
                "{role} {}: {:?}",
                method.name,
                posted.status
            );
            assert!(posted.headers.contains_key("blaze-revision"), "{}", method.name);
        }
        let posted = fixture
            .post(&format!("{PATH}NoSuchMethod"), &[("authorization", token.as_str())], &[])
            .await;
        assert_eq!(posted.status.code(), tonic::Code::Unimplemented);
    }
}

#[tokio::test]
async fn a_document_lives_its_life() {
    let fixture = Fixture::open().await;
    let mut client = fixture.client();
    let mut request = Request::new(create("edge", ""));
    request.metadata_mut().insert("x-request-id", "from-a-test".parse().unwrap());
    let created = client.create(request).await.unwrap();
    assert_eq!(created.metadata().get("x-request-id").unwrap(), "from-a-test");
    assert_eq!(created.metadata().get("blaze-revision").unwrap(), "1");
    let created = created.into_inner();
    assert_eq!((created.revision, created.updated_by.as_str()), (1, "dev"));
    assert_eq!(code(&client.create(create("edge", "")).await.unwrap_err()), Code::AlreadyExists);

    let replace = |precondition| v1::ReplaceRequest {
        document: layer("edge", r#"{"kind":"fog"}"#),
        precondition,
    };
    let refused = client.replace(replace(None)).await.unwrap_err();
    assert_eq!(
        (refused.code(), code(&refused)),
        (tonic::Code::FailedPrecondition, Code::PreconditionRequired)
    );
    let refused = client.replace(replace(exactly(9))).await.unwrap_err();
    assert_eq!((refused.code(), code(&refused)), (tonic::Code::Aborted, Code::PreconditionFailed));
    let info = refused.get_details_error_info().unwrap();
    assert_eq!(
        (info.metadata["revision"].as_str(), info.metadata["applied"].as_str()),
        ("1", "no")
    );
    assert_eq!(client.replace(replace(exactly(1))).await.unwrap().into_inner().revision, 2);

    let patch = v1::PatchRequest {
        r#ref: reference(v1::Kind::Layer, "edge"),
        merge_patch_json: r#"{"labels":{"site":"lab"}}"#.into(),
        precondition: exactly(2),
    };
    let patched = client.patch(patch).await.unwrap().into_inner();
    assert_eq!(patched.labels["site"], "lab");

    let list = v1::ListRequest {
        kind: v1::Kind::Layer.into(),
        label_selector: "site=lab".into(),
        ..Default::default()
    };
    let list = client.list(list).await.unwrap().into_inner();
    assert_eq!((list.items, list.revision, list.next_page_token.as_str()), (vec![patched], 3, ""));

    let history = v1::ListHistoryRequest {
        r#ref: reference(v1::Kind::Layer, "edge"),
        full: true,
        ..Default::default()
    };
    let history = client.list_history(history).await.unwrap().into_inner().items;
    let ops: Vec<_> = history.iter().map(v1::HistoryEntry::op).collect();
    assert_eq!(ops, [v1::Op::Update, v1::Op::Update, v1::Op::Create]);
    assert_eq!(history[2].request_id, "from-a-test");

    let diff = v1::DiffRequest {
        r#ref: reference(v1::Kind::Layer, "edge"),
        from_revision: 1,
        to_revision: 2,
    };
    let changes = client.diff(diff).await.unwrap().into_inner().changes;
    assert_eq!(
        (changes[0].path.as_str(), changes[0].value_json.as_str()),
        ("/spec/kind", r#""fog""#)
    );

    let delete = v1::DeleteRequest {
        r#ref: reference(v1::Kind::Layer, "edge"),
        precondition: exactly(3),
        cascade: false,
    };
    assert_eq!(client.delete(delete).await.unwrap().into_inner().revision, 4);
    let get = v1::GetRequest { r#ref: reference(v1::Kind::Layer, "edge"), read: None };
    assert_eq!(code(&client.get(get).await.unwrap_err()), Code::NotFound);
    let text = fixture.metrics.text();
    let line = r#"blaze_config_requests_total{api="grpc",code="precondition_failed",operation="Replace"} 1"#;
    assert!(text.contains(line), "{text}");
}

#[tokio::test]
async fn apply_is_one_commit_and_tells_where_it_failed() {
    let fixture = Fixture::open().await;
    let mut client = fixture.client();
    let item = |document| v1::ApplyItem { document, delete: false };
    let node = |layer: &str| {
        Some(v1::Document {
            r#ref: reference(v1::Kind::Node, "robot-1"),
            spec_json: format!(r#"{{"layer":"{layer}"}}"#),
            ..Default::default()
        })
    };
    let apply = |node| v1::ApplyRequest {
        items: vec![item(layer("edge", r#"{"kind":"edge"}"#)), item(node)],
        ..Default::default()
    };
    let refused = client.apply(apply(node("fog"))).await.unwrap_err();
    assert_eq!(code(&refused), Code::ReferenceNotFound);
    let faults = refused.get_details_bad_request().unwrap().field_violations;
    assert_eq!(faults[0].field, "/items/1/spec/layer");

    let answer = client.apply(apply(node("edge"))).await.unwrap().into_inner();
    assert_eq!((answer.revision, answer.dry_run), (1, false));
    let results: Vec<_> =
        answer.results.iter().map(|result| (result.op(), result.revision)).collect();
    assert_eq!(results, [(v1::Op::Create, 1), (v1::Op::Create, 1)]);
    let again = client.apply(apply(node("edge"))).await.unwrap().into_inner();
    assert!(again.results.iter().all(|result| result.op() == v1::Op::Unchanged));
}

#[tokio::test]
async fn a_request_that_comes_twice_takes_effect_once() {
    let fixture = Fixture::open().await;
    let mut client = fixture.client();
    let mut request = create("edge", "once");
    // More than one label: the order on the wire must not matter.
    let labels = &mut request.document.as_mut().unwrap().labels;
    labels.extend(["c", "a", "b"].map(|key| (key.to_owned(), String::new())));
    let first = client.create(request.clone()).await.unwrap();
    assert!(first.metadata().get("idempotent-replayed").is_none());
    let second = client.create(request).await.unwrap();
    assert_eq!(second.metadata().get("idempotent-replayed").unwrap(), "true");
    assert_eq!(first.get_ref(), second.get_ref());
    let other = client.create(create("fog", "once")).await.unwrap_err();
    assert_eq!(code(&other), Code::IdempotencyKeyReused);
}

#[tokio::test]
async fn a_watch_tells_every_commit_after_its_start() {
    let fixture = Fixture::open().await;
    let mut client = fixture.client();
    client.create(create("edge", "")).await.unwrap();
    let watch = v1::WatchRequest { since: Some(0), ..Default::default() };
    let mut stream = client.watch(watch).await.unwrap().into_inner();
    client.create(create("fog", "")).await.unwrap();
    let mut commits = Vec::new();
    while commits.len() < 2 {
        if let Some(Event::Commit(commit)) = stream.next().await.unwrap().unwrap().event {
            commits.push(commit);
        }
    }
    let chain: Vec<_> = commits.iter().map(|commit| (commit.previous, commit.revision)).collect();
    assert_eq!(chain, [(0, 1), (1, 2)]);
    let change = &commits[1].changes[0];
    assert_eq!(change.op(), v1::Op::Create);
    assert_eq!(change.document.as_ref().unwrap().r#ref, reference(v1::Kind::Layer, "fog"));
    assert!(fixture.metrics.text().contains("blaze_config_watchers 1"));
    drop(stream);
    assert!(fixture.metrics.text().contains("blaze_config_watchers 0"));
}

#[tokio::test]
async fn a_call_ends_with_its_time() {
    let fixture = Fixture::open().await;
    let mut get = Request::new(v1::GetRequest {
        r#ref: reference(v1::Kind::Layer, "edge"),
        read: Some(v1::ReadOptions { min_revision: 1_000, ..Default::default() }),
    });
    get.set_timeout(Duration::from_millis(50));
    let refused = fixture.client().get(get).await.unwrap_err();
    assert_eq!(
        (refused.code(), code(&refused)),
        (tonic::Code::DeadlineExceeded, Code::DeadlineExceeded)
    );
}

#[tokio::test]
async fn what_cannot_be_read_is_refused_with_details() {
    let fixture = Fixture::open().await;
    let path = format!("{PATH}Get");
    let posted = fixture.post(&path, &[], b"\xff\xff\xff").await;
    assert_eq!(
        (posted.status.code(), code(&posted.status)),
        (tonic::Code::InvalidArgument, Code::InvalidRequest)
    );

    // A frame that only says how long it is.
    let mut head = BytesMut::new();
    head.put_u8(0);
    head.put_u32((MAX_MESSAGE_BYTES + 1).try_into().unwrap());
    let posted = fixture.post_frame(&path, &[], head.freeze()).await;
    assert_eq!(
        (posted.status.code(), code(&posted.status)),
        (tonic::Code::ResourceExhausted, Code::PayloadTooLarge)
    );

    for (method, message, expected) in [
        ("Get", v1::GetRequest::default().encode_to_vec(), Code::InvalidRequest),
        (
            "List",
            v1::ListRequest { kind: 99, ..Default::default() }.encode_to_vec(),
            Code::InvalidRequest,
        ),
        ("List", v1::ListRequest::default().encode_to_vec(), Code::InvalidRequest),
        (
            "ListAudit",
            v1::ListAuditRequest { filter_json: r#"{"a":"b"}"#.into(), page: None }.encode_to_vec(),
            Code::UnknownParameter,
        ),
        (
            "Create",
            v1::CreateRequest { document: layer("Edge", "{}"), request_id: String::new() }
                .encode_to_vec(),
            Code::ValidationFailed,
        ),
        (
            "Create",
            v1::CreateRequest { document: layer("edge", "{"), request_id: String::new() }
                .encode_to_vec(),
            Code::InvalidRequest,
        ),
        (
            "SetRollout",
            v1::SetRolloutRequest {
                name: "a".into(),
                action: "stop".into(),
                reason: String::new(),
            }
            .encode_to_vec(),
            Code::InvalidRequest,
        ),
    ] {
        let posted = fixture.post(&format!("{PATH}{method}"), &[], &message).await;
        assert_eq!(code(&posted.status), expected, "{method} {:?}", posted.status);
    }
}

#[tokio::test]
async fn revision_zero_is_none() {
    let fixture = Fixture::open().await;
    let mut client = fixture.client();
    client.create(create("edge", "")).await.unwrap();
    let edge = || reference(v1::Kind::Layer, "edge");
    let diff = client.diff(v1::DiffRequest { r#ref: edge(), ..Default::default() });
    let diff = diff.await.unwrap_err();
    let rollback = client.rollback(v1::RollbackRequest { r#ref: edge(), ..Default::default() });
    let rollback = rollback.await.unwrap_err();
    let revert = client.revert(v1::RevertRequest::default()).await.unwrap_err();
    for refused in [diff, rollback, revert] {
        assert_eq!(
            (refused.code(), code(&refused)),
            (tonic::Code::InvalidArgument, Code::InvalidRequest)
        );
    }
}

#[tokio::test]
async fn a_token_lives_a_day_unless_more_is_said() {
    let fixture = Fixture::open().await;
    let request = |expires_in_s| v1::CreateTokenRequest {
        subject: "ops".into(),
        roles: vec!["viewer".into()],
        expires_in_s,
        ..Default::default()
    };
    let mut client = fixture.client();
    let mut life = async |expires_in_s| {
        let before = now_s();
        let made = client.create_token(request(expires_in_s)).await.unwrap().into_inner();
        made.expire_time.unwrap().seconds - before
    };
    assert!((86_399..86_460).contains(&life(0).await));
    assert!((59..120).contains(&life(60).await));
}

#[tokio::test]
async fn what_is_not_there_is_told_like_other_refusals() {
    let fixture = Fixture::open().await;
    for path in [
        "/blaze.v1.NoSuchService/Get",
        "/blaze.v1.ConfigService/NoSuchMethod",
        "/grpc.health.v1.Health/NoSuchMethod",
        "/",
    ] {
        let posted = fixture.post(path, &[("x-request-id", "from-a-test")], &[]).await;
        assert_eq!(
            (posted.status.code(), code(&posted.status)),
            (tonic::Code::Unimplemented, Code::MethodNotAllowed),
            "{path}"
        );
        let info = posted.status.get_details_error_info().unwrap();
        assert_eq!(
            (info.reason.as_str(), info.metadata["request_id"].as_str()),
            ("METHOD_NOT_ALLOWED", "from-a-test"),
            "{path}"
        );
        assert_eq!(posted.headers["x-request-id"], "from-a-test", "{path}");
    }
    let unknown = HealthCheckRequest { service: "blaze.v1.Other".into() };
    let posted = fixture.post("/grpc.health.v1.Health/Check", &[], &unknown.encode_to_vec()).await;
    assert_eq!(
        (posted.status.code(), code(&posted.status)),
        (tonic::Code::NotFound, Code::NotFound)
    );
}

#[tokio::test]
async fn in_development_pages_of_other_sites_are_kept_out() {
    let fixture = Fixture::open().await;
    let path = format!("{PATH}List");
    // What needs no token is no exception, nor is what is not there.
    for path in [&path, REFLECTION, "/grpc.health.v1.Health/Check", "/nowhere"] {
        let posted = fixture.post(path, &[("origin", "http://evil.example")], &[]).await;
        assert_eq!(posted.status.code(), tonic::Code::PermissionDenied, "{path}");
    }
    let own = fixture.post("/grpc.health.v1.Health/Check", &[("origin", "http://localhost")], &[]);
    assert_eq!(own.await.status.code(), tonic::Code::Ok);
}

#[tokio::test]
async fn health_needs_no_token_and_follows_readiness() {
    let fixture = Fixture::guarded().await;
    let mut client = HealthClient::new(fixture.router.clone());
    let mut status = async || {
        let request = HealthCheckRequest { service: "blaze.v1.ConfigService".into() };
        client.check(request).await.map(|answer| HealthCheckResponse::status(answer.get_ref()))
    };
    fixture.readiness.set("test", CheckStatus::Ok, "");
    let is_ready = fixture.readiness.is_ready();
    assert_eq!(status().await.unwrap() == ServingStatus::Serving, is_ready);
    fixture.readiness.add("test", Deciding::Decides, CheckStatus::Failed, "as the test wants it");
    assert_eq!(status().await.unwrap(), ServingStatus::NotServing);
}

#[tokio::test]
async fn reflection_is_there_only_when_it_is_switched_on() {
    let list = ServerReflectionRequest {
        host: String::new(),
        message_request: Some(server_reflection_request::MessageRequest::ListServices(
            String::new(),
        )),
    };
    let guarded = Fixture::guarded().await;
    let posted = guarded.post(REFLECTION, &[], &list.encode_to_vec()).await;
    assert_eq!(posted.status.code(), tonic::Code::Unimplemented);

    let open = Fixture::open().await;
    let posted = open.post(REFLECTION, &[], &list.encode_to_vec()).await;
    assert_eq!(posted.status.code(), tonic::Code::Ok);
    let answer = ServerReflectionResponse::decode(&posted.body[5..]).unwrap();
    let Some(server_reflection_response::MessageResponse::ListServicesResponse(list)) =
        answer.message_response
    else {
        panic!("{answer:?}");
    };
    let names: Vec<_> = list.service.iter().map(|service| service.name.as_str()).collect();
    for name in
        ["blaze.v1.ConfigService", "grpc.health.v1.Health", "grpc.reflection.v1.ServerReflection"]
    {
        assert!(names.contains(&name), "{names:?}");
    }
}
