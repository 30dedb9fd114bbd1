//! Roll-outs, as far as those who are served notice them.

use super::*;

/// Changes the rate of `slam` on nodes with the label `canary=true`.
fn rollout(revision: u64, phase: &str) -> Document {
    let spec = json!({"target": {"kind": "Service", "name": "slam"}, "patch": {"config": {"rate_hz": 5}},
        "canary": {"node_selector": "canary=true"}});
    let mut out = document("Rollout/slower", revision, spec);
    out.status = Some(json!({ "phase": phase }));
    out
}

#[test]
fn a_roll_out_is_told_on_its_canaries_alone() {
    let mut served = served(None);
    put(&mut served, 11, vec![rollout(11, "canary")]);
    let notices = flush(&mut served);
    assert_eq!(places(&notices), ["slam/0 at robot-1"]);
    assert_eq!(notices[0].rollout.as_ref().unwrap().as_str(), "slower");
    assert_eq!(
        (notices[0].paths.as_slice(), notices[0].scopes.as_slice()),
        (&["/rate_hz".to_owned()][..], &[Scope::Service][..])
    );
    let canary = place("slam/0@robot-1");
    assert!(
        served.is_changed_by("Rollout/slower", &canary) && !served.is_changed_by("other", &canary)
    );
    assert!(!served.is_changed_by("Rollout/slower", &place("slam/1@robot-2")));
    // A second canary, by its label.
    put(
        &mut served,
        12,
        vec![labelled("Node/robot-2", 12, json!({"layer": "edge"}), ("canary", "true"))],
    );
    assert_eq!(places(&flush(&mut served)), ["slam/1 at robot-2"]);
    // The main service says that it failed.
    put(&mut served, 13, vec![rollout(13, "failed")]);
    let notices = flush(&mut served);
    assert_eq!(places(&notices), ["slam/0 at robot-1", "slam/1 at robot-2"]);
    assert!(notices.iter().all(|notice| notice.rollout.is_none()));
}

#[test]
fn a_roll_out_that_fails_here_does_not_count_here() {
    let mut served = served(Some("robot-1"));
    let before = served.standing_of(&place("slam/0@robot-1")).unwrap();
    put(&mut served, 11, vec![rollout(11, "canary")]);
    assert_eq!(flush(&mut served).len(), 4);
    served.fail_rollout("Rollout/slower");
    assert!(served.has_pending());
    let notices = flush(&mut served);
    assert_eq!(notices.len(), 4);
    for notice in &notices {
        // No commit says so: the revision is that of the documents.
        assert_eq!((notice.revision, &notice.rollout), (11, &None));
        assert_eq!(notice.scopes, [Scope::Service]);
    }
    let after = served.standing_of(&place("slam/0@robot-1")).unwrap();
    assert_eq!((after.hash, after.config), (before.hash, before.config));
    // Neither does it when it is told again, nor after a restart.
    put(&mut served, 12, vec![rollout(12, "canary")]);
    assert!(flush(&mut served).is_empty());
    served.fail_rollout("Rollout/slower");
    assert!(!served.has_pending());
    assert_eq!(served.failed(), ["Rollout/slower"]);
    let mut again = Served::new(site(Some("robot-1")));
    again.fail_rollout("Rollout/slower");
    again.restore(served.floor(), remembered(&served), Instant::now());
    again.load(served.state().clone(), Source::Copy);
    flush(&mut again);
    let after = again.standing_of(&place("slam/0@robot-1")).unwrap();
    assert_eq!(after.hash, served.standing_of(&place("slam/0@robot-1")).unwrap().hash);
}

#[test]
fn of_too_many_failed_roll_outs_those_that_are_over_go() {
    let mut served = served(Some("robot-1"));
    put(&mut served, 11, vec![rollout(11, "canary")]);
    served.fail_rollout("Rollout/slower");
    for number in 0..MAX_FAILED {
        served.fail_rollout(&number.to_string());
    }
    assert_eq!(served.failed().len(), MAX_FAILED);
    assert_eq!((served.failed()[0].as_str(), served.failed()[1].as_str()), ("Rollout/slower", "1"));
}
