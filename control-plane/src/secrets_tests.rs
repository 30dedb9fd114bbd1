use std::fs;
use std::path::Path;

use blaze_domain::config::{Labels, Timestamp};
use proptest::prelude::*;
use serde_json::json;

use super::*;

const UID: &str = "0197c1d2-7f3a-7b64-9c1e-2f6f0a4e8d11";

fn key(text: &str) -> Key {
    text.parse().unwrap()
}

fn ring(ids: &[(&str, u8)]) -> Keyring {
    let keys: Vec<(&str, [u8; KEY_BYTES])> =
        ids.iter().map(|(id, fill)| (*id, [*fill; KEY_BYTES])).collect();
    Keyring::with_keys(&keys).unwrap()
}

fn write(file: &Path, fill: u8) {
    fs::write(file, STANDARD.encode([fill; KEY_BYTES]) + "\n").unwrap();
}

fn document(spec: Value) -> Document {
    Document {
        key: key("Service/slam"),
        uid: UID.to_owned(),
        revision: 7,
        create_time: Timestamp::from_millis(0),
        update_time: Timestamp::from_millis(0),
        updated_by: "ops".to_owned(),
        labels: Labels::new(),
        annotations: Labels::new(),
        spec: Arc::new(spec),
        status: None,
    }
}

#[test]
fn a_secret_opens_where_it_belongs() {
    let ring = ring(&[("e1", 1)]);
    let here = key("Instance/slam/0");
    let stored = ring.seal(&here, UID, "canary", 412).unwrap();
    assert_eq!(Secret::of(&stored).unwrap().unwrap().version(), 412);
    assert!(!stored.to_string().contains("canary"));
    assert!(!stored.to_string().contains(&STANDARD.encode("canary")));
    assert_eq!(*ring.open(&here, UID, &stored).unwrap(), "canary");
    let refused = Err(OpenError::Refused("e1".to_owned()));
    for other in ["Instance/slam/1", "Instance/slam2/0", "Service/slam", "Node/slam"] {
        assert_eq!(ring.open(&key(other), UID, &stored), refused, "{other}");
    }
    assert_eq!(ring.open(&here, "0197c1d2-7f3a-7b64-9c1e-2f6f0a4e8d12", &stored), refused);
    // A new nonce each time: equal texts do not show.
    assert_ne!(ring.seal(&here, UID, "canary", 412).unwrap(), stored);
    assert_eq!(format!("{ring:?}"), "[\"e1\"]");
}

#[test]
fn the_first_key_encrypts_and_all_decrypt() {
    let here = key("Layer/edge");
    let old = ring(&[("e1", 1)]).seal(&here, UID, "canary", 3).unwrap();
    let both = ring(&[("e2", 2), ("e1", 1)]);
    assert_eq!(*both.open(&here, UID, &old).unwrap(), "canary");
    assert_eq!(both.seal(&here, UID, "x", 4).unwrap()["$secret"]["key"], "e2");
    let unknown = ring(&[("e2", 2)]).open(&here, UID, &old);
    assert_eq!(unknown, Err(OpenError::UnknownKey("e1".to_owned())));
    let other = ring(&[("e1", 9)]).open(&here, UID, &old);
    assert_eq!(other, Err(OpenError::Refused("e1".to_owned())));
    let none = Keyring::empty();
    assert!(!none.can_seal() && both.can_seal());
    assert_eq!(none.seal(&here, UID, "x", 1), Err(SealError::NoKey));
    assert!(none.open(&here, UID, &old).is_err());
}

#[test]
fn what_is_no_stored_secret_does_not_open() {
    let ring = ring(&[("e1", 1)]);
    let here = key("Layer/edge");
    for value in [
        json!("canary"),
        json!({ "$secret": "canary" }),
        json!({ "$secret": { "redacted": true, "version": 1 } }),
        json!({ "$secret": { "key": "e1", "nonce": "", "data": "", "version": 1 } }),
        json!({ "$secret": { "key": "e1", "nonce": "!", "data": "AAAA", "version": 1 } }),
        json!({ "$secret": { "key": "e1", "nonce": "AAAA", "data": "AAAA", "version": 1 } }),
    ] {
        assert_eq!(ring.open(&here, UID, &value), Err(OpenError::Form), "{value}");
    }
    let short = json!({ "$secret": { "key": "e1", "nonce": "AAAAAAAAAAAAAAAA", "data": "AAAA",
        "version": 1 } });
    assert!(matches!(ring.open(&here, UID, &short), Err(OpenError::Refused(_))));
}

#[test]
fn reencrypting_moves_what_is_under_an_old_key() {
    let here = key("Service/slam");
    let (old, both) = (ring(&[("e1", 1)]), ring(&[("e2", 2), ("e1", 1)]));
    let before = old.seal(&here, UID, "canary", 3).unwrap();
    let fresh = both.seal(&here, UID, "other", 5).unwrap();
    let spec = json!({ "config": { "a": before, "list": [1, fresh], "b": "text" } });
    let moved = both.reseal(&document(spec.clone())).unwrap().unwrap();
    let (a, kept) = (&moved.spec["config"]["a"], &moved.spec["config"]["list"][1]);
    assert_eq!(a["$secret"]["key"], "e2");
    assert_eq!(Secret::of(a).unwrap().unwrap().version(), 3);
    assert_eq!(*both.open(&here, UID, a).unwrap(), "canary");
    assert_eq!(*kept, fresh);
    assert_eq!(moved.revision, 7);
    assert_eq!(both.reseal(&moved).unwrap(), None);
    let lost = ring(&[("e3", 3)]).reseal(&document(spec));
    assert_eq!(lost, Err(OpenError::UnknownKey("e1".to_owned())));
    assert_eq!(old.reseal(&document(json!({ "config": { "a": 1 } }))).unwrap(), None);
}

#[tokio::test]
async fn changed_files_are_read_again_and_faulty_ones_are_not_used() {
    let folder = tempfile::tempdir().unwrap();
    let file = |id: &str| EncryptionKey { id: id.to_owned(), file: folder.path().join(id) };
    write(&file("e1").file, 1);
    write(&file("e2").file, 2);
    let section = EncryptionSection { keys: vec![file("e1"), file("e2")] };
    let keys = Keyring::load(&section).unwrap();
    let supervisor = Supervisor::new("test");
    keys.watch_every(&supervisor, Duration::from_millis(10));
    let here = key("Layer/edge");
    let first = ring(&[("e1", 1)]).seal(&here, UID, "canary", 1).unwrap();
    let second = ring(&[("e1", 9)]).seal(&here, UID, "canary", 1).unwrap();
    assert!(keys.open(&here, UID, &first).is_ok() && keys.open(&here, UID, &second).is_err());
    fs::write(&file("e2").file, "too short").unwrap();
    write(&file("e1").file, 9);
    let changed = async {
        while keys.open(&here, UID, &second).is_err() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(10), changed).await.unwrap();
    let kept = ring(&[("e2", 2)]).seal(&here, UID, "kept", 1).unwrap();
    assert_eq!(*keys.open(&here, UID, &kept).unwrap(), "kept");
    let faults = Keyring::load(&section).unwrap_err();
    assert_eq!(faults.len(), 1);
    assert!(faults[0].contains("e2"), "{faults:?}");
    assert!(supervisor.shutdown(Duration::from_secs(10)).await.is_clean());
}

proptest! {
    #[test]
    fn any_text_comes_back_and_no_change_passes(text in ".{0,80}", place in any::<usize>(),
        flip in 1_u8..) {
        let ring = ring(&[("e1", 1)]);
        let here = key("Layer/edge");
        let stored = ring.seal(&here, UID, &text, 1).unwrap();
        prop_assert_eq!(&*ring.open(&here, UID, &stored).unwrap(), &text);
        let mut data = STANDARD.decode(stored["$secret"]["data"].as_str().unwrap()).unwrap();
        let place = place % data.len();
        data[place] ^= flip;
        let mut changed = stored;
        changed["$secret"]["data"] = STANDARD.encode(data).into();
        prop_assert!(ring.open(&here, UID, &changed).is_err());
    }
}
