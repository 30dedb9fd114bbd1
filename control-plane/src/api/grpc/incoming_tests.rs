use proptest::prelude::*;
use serde_json::json;

use super::*;

fn reference(kind: v1::Kind, service: &str, name: &str) -> v1::Ref {
    v1::Ref { kind: kind.into(), name: name.into(), service: service.into() }
}

fn document(reference: v1::Ref, spec: &str) -> v1::Document {
    v1::Document { r#ref: Some(reference), spec_json: spec.into(), ..Default::default() }
}

#[test]
fn a_document_without_spec_has_an_empty_one() {
    let input = input(Some(document(reference(v1::Kind::Service, "", "slam"), ""))).unwrap();
    assert_eq!((input.key.to_string().as_str(), input.spec), ("Service/slam", json!({})));
}

#[test]
fn a_bad_name_is_a_fault_of_the_document_with_its_place() {
    for (wire, pointer) in [
        (reference(v1::Kind::Layer, "", "Edge"), "/name"),
        (reference(v1::Kind::Layer, "", ""), "/name"),
        (reference(v1::Kind::Instance, "slam", ""), "/name"),
        (reference(v1::Kind::Instance, "SLAM", "0"), "/service"),
        (reference(v1::Kind::Instance, "", "0"), "/service"),
        (reference(v1::Kind::Node, "slam", "a"), "/service"),
    ] {
        let problem = input(Some(document(wire, "{}"))).unwrap_err();
        assert_eq!(
            (problem.code, problem.errors[0].pointer.as_str()),
            (Code::ValidationFailed, pointer)
        );
    }
    for wire in [
        None,
        Some(v1::Document::default()),
        Some(document(reference(v1::Kind::Unspecified, "", "a"), "")),
    ] {
        assert_eq!(input(wire).unwrap_err().code, Code::InvalidRequest);
    }
}

#[test]
fn preconditions_say_one_thing() {
    use v1::precondition::Is;
    let of = |is| precondition(Some(v1::Precondition { is }));
    assert_eq!(precondition(None), Ok(Precondition::None));
    assert_eq!(of(None), Ok(Precondition::None));
    assert_eq!(of(Some(Is::Revision(7))), Ok(Precondition::Revisions(vec![7])));
    assert_eq!(of(Some(Is::Absent(true))), Ok(Precondition::Absent));
    assert_eq!(of(Some(Is::Any(true))), Ok(Precondition::Any));
    assert!(of(Some(Is::Absent(false))).is_err());
    assert!(of(Some(Is::Any(false))).is_err());
}

#[test]
fn zero_and_empty_mean_not_said() {
    assert_eq!(read(None), ReadOptions::default());
    assert_eq!(read(Some(v1::ReadOptions::default())), ReadOptions::default());
    assert_eq!(page(Some(v1::Page::default())), (None, String::new()));
    assert_eq!(watch(v1::WatchRequest::default()), Ok(WatchQuery::default()));
    assert_eq!(place(None), Ok(Place::default()));
    let since = v1::WatchRequest { since: Some(0), ..Default::default() };
    assert_eq!(watch(since).unwrap().since, Some(0));
}

#[test]
fn a_revision_that_must_be_said_is_above_zero() {
    assert_eq!(revision("from_revision", 7), Ok(7));
    let problem = revision("from_revision", 0).unwrap_err();
    assert_eq!(problem.code, Code::InvalidRequest);
    assert!(problem.detail.starts_with("from_revision is missing"), "{}", problem.detail);
}

#[test]
fn only_instances_have_a_service() {
    let list = |kind: v1::Kind| {
        list(v1::ListRequest { kind: kind.into(), service: "slam".into(), ..Default::default() })
    };
    assert!(list(v1::Kind::Instance).is_ok());
    assert_eq!(list(v1::Kind::Node).unwrap_err().code, Code::InvalidRequest);
}

#[test]
fn apply_knows_deletions_and_preconditions_and_where_a_fault_is() {
    let mut good = document(reference(v1::Kind::Layer, "", "edge"), r#"{"kind":"edge"}"#);
    good.revision = 7;
    let mut gone = document(reference(v1::Kind::Layer, "", "fog"), "no JSON at all");
    gone.labels.insert("a".into(), "b".into());
    let item = |document, delete| v1::ApplyItem { document: Some(document), delete };
    let request =
        |items| v1::ApplyRequest { items, prune: "site=lab".into(), ..Default::default() };
    let read = apply(request(vec![item(good, false), item(gone.clone(), true)])).unwrap();
    let items: Vec<_> = read.items.iter().map(|item| (item.revision, item.delete)).collect();
    assert_eq!(items, [(Some(7), false), (None, true)]);
    assert_eq!(read.prune.as_deref(), Some("site=lab"));

    let bad = document(reference(v1::Kind::Layer, "", "Edge"), "");
    let problem = apply(request(vec![item(gone.clone(), true), item(bad, false)])).unwrap_err();
    assert_eq!(problem.errors[0].document, Some(1));
    assert!(problem.detail.starts_with("items[1]: /name: "), "{}", problem.detail);
    let problem = apply(request(vec![item(gone, false)])).unwrap_err();
    assert!(problem.detail.starts_with("items[0]: spec_json: "), "{}", problem.detail);

    let large = document(reference(v1::Kind::Layer, "", "edge"), &" ".repeat(MAX_APPLY_BYTES));
    assert_eq!(apply(request(vec![item(large, false)])).unwrap_err().code, Code::PayloadTooLarge);
}

#[test]
fn a_key_is_bound_to_method_and_message() {
    let message = v1::CreateRequest {
        document: Some(document(reference(v1::Kind::Layer, "", "edge"), "{}")),
        request_id: "k".into(),
    };
    let of = |method: &str, message: &v1::CreateRequest| {
        idempotency(method, "k", message).unwrap().unwrap()
    };
    assert_eq!(of("Create", &message), of("Create", &message.clone()));
    assert_eq!(of("Create", &message).path, "grpc/Create");
    let mut other = message.clone();
    other.document.as_mut().unwrap().labels.insert("a".into(), "b".into());
    assert_ne!(of("Create", &message).body, of("Create", &other).body);

    assert_eq!(idempotency("Create", "", &message), Ok(None));
    for bad in ["a b", "ä", &"a".repeat(129)] {
        assert_eq!(idempotency("Create", bad, &message).unwrap_err().code, Code::InvalidRequest);
    }
}

#[test]
fn the_filter_of_the_audit_has_the_members_of_rest() {
    let filter = concat!(
        r#"{"subject":"ops","kind":"Node","name":"robot-1","action":"update","outcome":"denied","#,
        r#""since_time":"2026-11-21T07:01:12.345Z","until_time":"2026-11-22T07:01:12.345Z"}"#,
    );
    let page = v1::Page { limit: 7, page_token: "t".into() };
    let (query, token) = audit(filter, Some(page)).unwrap();
    assert_eq!((query.limit, query.allowed, token.as_str()), (7, Some(false), "t"));
    assert_eq!((query.subject.as_deref(), query.kind.as_deref()), (Some("ops"), Some("Node")));
    assert!(query.since < query.until);
    assert_eq!(audit("", None), Ok((AuditQuery::default(), String::new())));

    for (filter, code) in [
        ("[]", Code::InvalidRequest),
        (r#"{"subject":1}"#, Code::InvalidRequest),
        (r#"{"kind":"node"}"#, Code::InvalidRequest),
        (r#"{"outcome":"maybe"}"#, Code::InvalidRequest),
        (r#"{"since_time":"yesterday"}"#, Code::InvalidRequest),
        (r#"{"subject":"a","subject":"b"}"#, Code::InvalidRequest),
        (r#"{"since":"2026-11-21T07:01:12.345Z"}"#, Code::UnknownParameter),
    ] {
        assert_eq!(audit(filter, None).unwrap_err().code, code, "{filter}");
    }
}

proptest! {
    #[test]
    fn no_message_panics(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
        if let Ok(wire) = v1::ApplyRequest::decode(bytes.as_slice()) {
            let _ = apply(wire);
        }
        if let Ok(wire) = v1::ListRequest::decode(bytes.as_slice()) {
            let _ = list(wire);
        }
        if let Ok(wire) = v1::WatchRequest::decode(bytes.as_slice()) {
            let _ = watch(wire);
        }
        if let Ok(wire) = v1::Document::decode(bytes.as_slice()) {
            let _ = input(Some(wire));
        }
        let _ = audit(&String::from_utf8_lossy(&bytes), None);
    }
}
