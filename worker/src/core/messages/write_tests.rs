use blaze_domain::config::effective::{ConfigTarget, Sources};

use super::*;
use crate::core::Source;
use crate::core::notice::Config;
use crate::core::testing::{document, place, state};

const NOW: i64 = 1_795_244_475_445;

fn freshness() -> Freshness {
    Freshness {
        as_of: Some("2026-11-21T07:01:12.345Z".parse().unwrap()),
        now: Timestamp::from_millis(NOW),
    }
}

/// The configuration of `slam/0` at `robot-1`, made of these members.
fn standing(config: &Value) -> Standing {
    let state = state(431, [document("Service/slam", 431, json!({"config": config}))]);
    let at = ConfigTarget {
        service: Some("slam".parse().unwrap()),
        instance: Some("0".parse().unwrap()),
        layer: Some("edge".parse().unwrap()),
        node: Some("robot-1".parse().unwrap()),
    };
    let sources = Sources::at(&state, &at);
    Standing {
        at,
        revision: 431,
        hash: sources.hash(),
        config: Config::of(&sources),
        source: Source::Main,
        store: None,
        rollout: None,
    }
}

fn a_notice(config: Option<&Value>) -> Notice {
    let standing = config.map(standing);
    Notice {
        place: place("slam/0@robot-1"),
        layer: "edge".parse().unwrap(),
        revision: 431,
        hash: standing.as_ref().map(|standing| standing.hash.clone()),
        previous_hash: Some("sha256:0".to_owned()),
        paths: standing.iter().map(|_| "/a".to_owned()).collect(),
        scopes: standing.iter().flat_map(|_| [Scope::Layer, Scope::Service]).collect(),
        config: standing.map(|standing| standing.config),
        source: Source::Copy,
        store: None,
        rollout: None,
    }
}

#[test]
fn an_answer_has_the_members_of_the_contract_in_their_order() {
    let standing = standing(&json!({"a": 1}));
    let hash = standing.hash.clone();
    let full = reply(
        &Reply::Standing(Box::new(standing.clone())),
        Some("7f1c"),
        Delivery::Text,
        freshness(),
    );
    let state = format!(
        r#""service":"slam","instance":"0","layer":"edge","node":"robot-1","revision":431,"hash":"{hash}","config":{{"a":1}},"source":"main","as_of":"2026-11-21T07:01:12.345Z","age_s":3.1,"rollout":null}}"#
    );
    assert_eq!(full, format!(r#"{{"id":"7f1c",{state}"#));
    assert_eq!(state_value(&standing, Delivery::Text, freshness()).unwrap(), format!("{{{state}"));
    let unchanged = Reply::Unchanged {
        revision: 431,
        hash: "sha256:ab".to_owned(),
        source: Source::File,
        store: None,
    };
    let never = Freshness { as_of: None, ..freshness() };
    assert_eq!(
        reply(&unchanged, None, Delivery::Text, never),
        r#"{"unchanged":true,"revision":431,"hash":"sha256:ab","source":"file","as_of":null,"age_s":null}"#
    );
    let error = RequestError::new(ErrorCode::NotFound, "no service slamm; did you mean slam?");
    assert_eq!(
        reply(&Reply::Error(error), Some("7f1c"), Delivery::Text, freshness()),
        r#"{"id":"7f1c","error":{"code":"not_found","detail":"no service slamm; did you mean slam?"}}"#
    );
}

#[test]
fn a_notice_has_the_members_of_the_contract_in_their_order() {
    let changed = a_notice(Some(&json!({"a": 1})));
    let hash = changed.hash.clone().unwrap();
    let time = Timestamp::from_millis(NOW);
    assert_eq!(
        notice(&changed, Delivery::Text, time).unwrap(),
        format!(
            r#"{{"service":"slam","instance":"0","layer":"edge","node":"robot-1","revision":431,"hash":"{hash}","previous_hash":"sha256:0","paths":["/a"],"scopes":["layer","service"],"config":{{"a":1}},"source":"copy","time":"2026-11-21T07:01:15.445Z"}}"#
        )
    );
    let mut deleted = a_notice(None);
    deleted.place = place("slam");
    assert_eq!(
        notice(&deleted, Delivery::Text, time).unwrap(),
        r#"{"service":"slam","instance":null,"layer":"edge","node":null,"revision":431,"hash":null,"previous_hash":"sha256:0","paths":[],"scopes":[],"config":null,"deleted":true,"source":"copy","time":"2026-11-21T07:01:15.445Z"}"#
    );
}

#[test]
fn a_secret_is_a_plain_text_or_redacted() {
    for (stored, text, redacted) in [
        (json!({"text": "canary", "version": 7}), json!("canary"), 7),
        (json!("canary"), json!("canary"), 0),
        // What is not known is not made up.
        (json!({"redacted": true, "version": 7}), Value::Null, 7),
        (json!({"key": "e1", "nonce": "canary", "data": "canary", "version": 7}), Value::Null, 7),
        (json!(["canary"]), Value::Null, 0),
    ] {
        let config = json!({"db": [{"pw": {"$secret": stored}}], "n": 1});
        let hidden = json!({"$secret": {"redacted": true, "version": redacted}});
        let expected = |secret: Value| json!({"db": [{"pw": secret}], "n": 1});
        let shown = if text.is_null() { hidden.clone() } else { text };
        assert_eq!(Delivery::Text.form(&config), expected(shown));
        let safe = Delivery::Redacted.form(&config);
        assert_eq!(safe, expected(hidden));
        assert!(!safe.to_string().contains("canary"));
    }
}

#[test]
fn what_is_too_large_is_refused() {
    let fitting = "x".repeat(MAX_EFFECTIVE_BYTES - r#"{"a":""}"#.len());
    for (text, fits) in [(fitting.clone(), true), (format!("{fitting}x"), false)] {
        let config = json!({ "a": text });
        let standing = standing(&config);
        assert_eq!(state_value(&standing, Delivery::Text, freshness()).is_ok(), fits);
        let time = Timestamp::from_millis(NOW);
        assert_eq!(notice(&a_notice(Some(&config)), Delivery::Text, time).is_ok(), fits);
        let answer =
            reply(&Reply::Standing(Box::new(standing)), Some("7f1c"), Delivery::Text, freshness());
        assert_eq!(
            answer.starts_with(r#"{"id":"7f1c","error":{"code":"too_large","detail":"#),
            !fits
        );
    }
}

#[test]
fn an_age_has_one_decimal_and_is_never_negative() {
    for (ms, text) in
        [(0, "0.0"), (49, "0.0"), (50, "0.1"), (3100, "3.1"), (61_000, "61.0"), (-5000, "0.0")]
    {
        let freshness = Freshness {
            as_of: Some(Timestamp::from_millis(NOW)),
            now: Timestamp::from_millis(NOW + ms),
        };
        let age = freshness.age_s().unwrap();
        assert_eq!(Value::from(age).to_string(), text);
    }
}
