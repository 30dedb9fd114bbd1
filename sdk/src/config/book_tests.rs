//! Answers and notices in every order.

use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;
use crate::service::slam;

const LIFE: u64 = 0x7f;

fn book(node: Option<&str>, scope: Scope) -> (ConfigBook, Instant) {
    let identity = Identity { node: node.map(|node| node.parse().unwrap()), ..slam() };
    let now = Instant::now();
    (ConfigBook::new(identity, scope, LIFE, "blaze/reply/slam".to_owned(), now), now)
}

fn ours() -> (ConfigBook, Instant) {
    book(Some("robot-1"), Scope::Node)
}

fn given(revision: u64, config: &Value) -> Vec<u8> {
    let id = format!("{LIFE:016x}-1");
    json!({"id": id, "service": "slam", "instance": "0", "layer": "edge", "node": "robot-1",
        "revision": revision,
        "hash": hash(config), "config": config, "source": "main"})
    .to_string()
    .into_bytes()
}

fn notice(revision: u64, config: &Value) -> Value {
    json!({"service": "slam", "instance": "0", "layer": "edge", "node": "robot-1",
        "revision": revision, "hash": hash(config),
        "paths": ["/rate"], "scopes": ["node"], "config": config, "source": "main"})
}

fn deleted(revision: u64) -> Value {
    json!({"service": "slam", "instance": "0", "node": "robot-1", "revision": revision,
        "hash": null, "paths": [],
        "scopes": [], "config": null, "deleted": true, "source": "main"})
}

fn hash(config: &Value) -> String {
    format!("sha256:{config}")
}

fn bytes(value: &Value) -> Vec<u8> {
    value.to_string().into_bytes()
}

#[test]
fn it_asks_until_there_is_an_answer_and_then_every_minute_with_the_hash() {
    let (mut book, start) = ours();
    let first: Value = serde_json::from_str(&book.poll(start).unwrap()).unwrap();
    assert_eq!(
        first,
        json!({
            "service": "slam",
            "instance": "0",
            "node": "robot-1",
            "id": "000000000000007f-1",
            "reply_to": "blaze/reply/slam",
        })
    );
    assert_eq!(book.poll(start + RETRY / 2), None);
    assert!(book.poll(start + RETRY).is_some());
    let answered = start + RETRY * 2;
    let config = json!({"rate": 10});
    assert!(book.on_reply(&given(4, &config), answered).is_some());
    assert_eq!(book.next_due(), answered + PERIOD);
    let again: Value = serde_json::from_str(&book.poll(answered + PERIOD).unwrap()).unwrap();
    assert_eq!(again["hash"], hash(&config).as_str());
}

#[test]
fn a_refusal_is_kept_and_says_when_to_ask_again() {
    for (code, pause) in [
        ("not_ready", RETRY),
        ("not_found", RETRY_UNKNOWN),
        ("invalid_request", PERIOD),
        ("too_large", PERIOD),
    ] {
        let (mut book, now) = ours();
        let refusal = json!({"id": "000000000000007f-1", "error": {"code": code, "detail": "so"}});
        assert_eq!(book.on_reply(&bytes(&refusal), now), None);
        assert_eq!(book.refusal().map(|refusal| refusal.code.as_str()), Some(code));
        assert_eq!(book.next_due(), now + pause, "{code}");
        book.on_reply(&given(1, &json!({})), now);
        assert_eq!(book.refusal(), None);
    }
}

#[test]
fn a_change_that_was_found_by_asking_says_what_is_different_and_may_be_of_any_scope() {
    let (mut book, now) = ours();
    let first = book.on_reply(&given(1, &json!({"rate": 10, "a": {"b": 1}})), now).unwrap();
    assert_eq!((first.old, first.deleted), (None, false));
    let second = book.on_reply(&given(2, &json!({"rate": 20, "a": {"b": 1}})), now).unwrap();
    assert_eq!(second.paths, ["/rate"]);
    assert!(second.scopes.is_empty() && second.is_of(ConfigScope::Layer));
    assert_eq!(book.on_reply(&given(3, &json!({"rate": 20, "a": {"b": 1}})), now), None);
    assert_eq!(book.standing().revision(), Some(3));
}

#[test]
fn of_another_store_of_the_main_service_any_revision_is_newer() {
    let (mut book, now) = ours();
    let told = |store: &str, source: &str, mut notice: Value| {
        notice["store_id"] = store.into();
        notice["source"] = source.into();
        bytes(&notice)
    };
    let rate = |rate: u64| json!({ "rate": rate });
    assert!(book.on_notice(&told("a", "main", notice(8, &rate(1))), now).is_some());
    let of_copy = told("b", "copy", notice(1, &rate(2)));
    assert_eq!(book.on_notice(&of_copy, now), None, "a copy may be of an earlier store");
    let change = book.on_notice(&told("b", "main", notice(3, &rate(2))), now).unwrap();
    assert_eq!((change.revision, change.new), (3, Some(std::sync::Arc::new(rate(2)))));
    assert_eq!(book.on_notice(&told("b", "main", notice(2, &rate(1))), now), None);
    let unchanged = json!({
        "id": "000000000000007f-1",
        "unchanged": true,
        "revision": 1,
        "hash": hash(&rate(2)),
        "source": "main",
        "store_id": "c",
    });
    assert_eq!(book.on_reply(&bytes(&unchanged), now), None);
    assert_eq!(book.standing().revision(), Some(1));
    assert!(book.on_notice(&told("c", "main", notice(2, &rate(3))), now).is_some());
    assert!(book.on_notice(&told("d", "main", deleted(1)), now).unwrap().deleted);
    assert!(book.on_notice(&told("e", "main", notice(1, &rate(4))), now).is_some());
}

#[test]
fn what_is_for_others_is_left_alone() {
    let (mut book, now) = ours();
    for (member, value) in [
        ("instance", json!("1")),
        ("instance", Value::Null),
        ("node", json!("robot-2")),
        ("node", Value::Null),
        ("service", json!("nav")),
    ] {
        let mut other = notice(2, &json!({"rate": 20}));
        other[member] = value;
        assert_eq!(book.on_notice(&bytes(&other), now), None, "{member}");
    }
    assert_eq!(book.counts().for_others, 5);
    assert_eq!(*book.standing(), Standing::Nothing);
}

#[test]
fn a_service_without_a_node_hears_what_the_scope_of_its_broker_allows() {
    let of_robot = notice(2, &json!({"rate": 20}));
    let mut of_nowhere = of_robot.clone();
    of_nowhere["node"] = Value::Null;
    for (scope, hears_robot, hears_nowhere) in
        [(Scope::Node, true, true), (Scope::Layer, false, true)]
    {
        for (notice, hears) in [(&of_robot, hears_robot), (&of_nowhere, hears_nowhere)] {
            let (mut book, now) = book(None, scope);
            assert_eq!(book.on_notice(&bytes(notice), now).is_some(), hears, "{scope:?}");
        }
    }
}

#[test]
fn what_is_deleted_comes_back_only_with_a_newer_revision() {
    let (mut book, now) = ours();
    let config = json!({"rate": 10});
    book.on_reply(&given(5, &config), now);
    let gone = book.on_notice(&bytes(&deleted(7)), now).unwrap();
    assert!(gone.deleted && gone.new.is_none() && gone.old.is_some());
    for older in [5, 6, 7] {
        assert_eq!(book.on_reply(&given(older, &config), now), None);
        assert_eq!(book.on_notice(&bytes(&notice(older, &config)), now), None);
    }
    assert_eq!(book.on_notice(&bytes(&deleted(7)), now), None);
    let back = book.on_notice(&bytes(&notice(8, &config)), now).unwrap();
    assert_eq!((back.old, back.deleted), (None, false));
}

#[test]
fn another_configuration_of_the_same_revision_is_taken_and_asked_about() {
    let (mut book, now) = ours();
    book.on_reply(&given(5, &json!({"rate": 99})), now);
    let change = book.on_notice(&bytes(&notice(5, &json!({"rate": 10}))), now).unwrap();
    assert_eq!(*change.new.unwrap(), json!({"rate": 10}));
    assert_eq!(book.next_due(), now + RETRY);
}

#[test]
fn an_unchanged_that_answers_an_earlier_request_moves_nothing() {
    let (mut book, now) = ours();
    book.on_reply(&given(5, &json!({"rate": 1})), now);
    let unchanged = |revision: u64, hash: &str| {
        json!({
            "id": "000000000000007f-1",
            "unchanged": true,
            "revision": revision,
            "hash": hash,
            "source": "copy",
        })
    };
    book.on_reply(&bytes(&unchanged(9, "sha256:other")), now);
    book.on_reply(&bytes(&unchanged(4, &hash(&json!({"rate": 1})))), now);
    assert_eq!(book.standing().revision(), Some(5));
    book.on_reply(&bytes(&unchanged(6, &hash(&json!({"rate": 1})))), now);
    assert_eq!(book.standing().revision(), Some(6));
}

/// What happened to the service: the n-th is of revision n + 1. `None`: it was deleted.
fn histories() -> impl Strategy<Value = Vec<Option<u8>>> {
    prop::collection::vec(prop::option::weighted(0.8, 0_u8..4), 1..12)
}

proptest! {
    /// Each step delivers one of the revisions again, as a notice or as an answer, in whatever
    /// order; the newest one is among them.
    #[test]
    fn whatever_the_order_it_never_goes_back_and_ends_at_the_newest(
        history in histories(),
        mut steps in prop::collection::vec((any::<prop::sample::Index>(), any::<bool>()), 0..60),
        newest_at in any::<prop::sample::Index>(),
        newest_is_answer in any::<bool>(),
    ) {
        let (mut book, now) = ours();
        let last = history.len() - 1;
        let at = newest_at.index(steps.len() + 1);
        let mut sequence: Vec<(usize, bool)> =
            steps.drain(..).map(|(which, answer)| (which.index(history.len()), answer)).collect();
        sequence.insert(at, (last, newest_is_answer));
        let mut before = None;
        let mut shown: Option<Value> = None;
        for (which, is_answer) in sequence {
            let revision = which as u64 + 1;
            let change = match history[which] {
                Some(rate) if is_answer => book.on_reply(
                    &given(revision, &json!({ "rate": rate })),
                    now,
                ),
                Some(rate) => book.on_notice(
                    &bytes(&notice(revision, &json!({ "rate": rate }))),
                    now,
                ),
                // An answer does not tell of a deletion with a revision, so only notices do.
                None => book.on_notice(&bytes(&deleted(revision)), now),
            };
            prop_assert!(book.standing().revision() >= before);
            before = book.standing().revision();
            if let Some(change) = change {
                // Who follows the changes alone always has what the book has.
                prop_assert_eq!(change.old.as_deref(), shown.as_ref());
                prop_assert_ne!(&change.old, &change.new);
                shown = change.new.as_deref().cloned();
            }
            let held = book.standing().held().map(|held| (*held.config).clone());
            prop_assert_eq!(&held, &shown);
        }
        prop_assert_eq!(book.standing().revision(), Some(history.len() as u64));
        prop_assert_eq!(shown, history[last].map(|rate| json!({ "rate": rate })));
    }
}

#[test]
fn what_a_mounted_file_takes_away_and_gives_again_is_there_again() {
    let (mut book, now) = ours();
    book.poll(now).unwrap();
    book.on_reply(&given(0, &json!({ "rate": 1 })), now);
    assert!(book.on_notice(&bytes(&deleted(0)), now).is_some_and(|change| change.deleted));
    let again = book.on_notice(&bytes(&notice(0, &json!({ "rate": 2 }))), now).unwrap();
    assert_eq!(
        (again.new.as_deref(), again.hash),
        (Some(&json!({ "rate": 2 })), Some(hash(&json!({ "rate": 2 }))))
    );
}
