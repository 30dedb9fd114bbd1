//! What needs no server; the rest is in [`conformance`](crate::copy::conformance).

use super::*;

#[test]
fn each_copy_has_a_name_of_its_own() {
    let copy = |node: Option<&str>| {
        let node = node.map(|node| node.parse().unwrap());
        let section = MongoSection::of("mongodb://me:canary@127.0.0.1:1", "blaze");
        MongoCopy::new(section, "edge".parse().unwrap(), node.as_ref(), Vault::default())
    };
    assert_eq!(copy(None).describe(), "MongoDB blaze, copy edge");
    assert!(copy(Some("robot-1")).describe().ends_with("copy edge.robot-1"));
}

#[tokio::test]
async fn a_server_that_is_away_is_no_broken_copy_and_its_password_is_not_told() {
    let section =
        MongoSection::of("mongodb://me:canary@127.0.0.1:1/?directConnection=true", "blaze");
    let copy = MongoCopy::new(section, "edge".parse().unwrap(), None, Vault::default());
    let error = copy.load().await.unwrap_err();
    assert!(matches!(error, CopyError::Away { .. }), "{error}");
    assert!(!error.to_string().contains("canary"), "{error}");
}

#[test]
fn chunks_of_one_copy_or_generation_are_apart_from_others() {
    let within = |filter: &Document, id: &str| {
        let range = filter.get_document("_id").unwrap();
        (range.get_str("$gte").unwrap()..range.get_str("$lt").unwrap()).contains(&id)
    };
    let (one, two) = (new_generation(5, None), new_generation(6, None));
    let id = |copy: &str, generation: &str| format!("{copy}/{generation}/00000003");
    assert!(within(&of_generation("edge", &one), &id("edge", &one)));
    assert!(!within(&of_generation("edge", &one), &id("edge", &two)));
    assert!(within(&of_earlier("edge", &two), &id("edge", &one)));
    for (copy, generation) in
        [("edge", &two), ("edge.robot-1", &one), ("edge-1", &one), ("e", &one)]
    {
        assert!(!within(&of_earlier("edge", &two), &id(copy, generation)), "{copy}");
    }
}

#[test]
fn chunks_that_no_head_names_are_deleted_when_they_are_old() {
    let (head, later) = (new_generation(5, None), new_generation(6, None));
    let filter = of_left_behind("edge", Some(&head), 7);
    let range = filter.get_document("_id").unwrap();
    let range = range.get_str("$gte").unwrap()..range.get_str("$lt").unwrap();
    let id = |copy: &str, generation: &str| format!("{copy}/{generation}/00000003");
    assert!(range.contains(&id("edge", &later).as_str()));
    for id in [id("edge", &new_generation(7, None)), id("edge.robot-1", &later)] {
        assert!(!range.contains(&id.as_str()), "{id}");
    }
    let held = filter.get_array("$nor").unwrap();
    assert_eq!(held, &[Bson::Document(of_generation("edge", &head))]);
}

#[test]
fn a_new_generation_sorts_behind_the_present_one_whatever_the_clock_says() {
    let present = new_generation(1_000, None);
    for now in [0, 999, 1_000, 1_001] {
        assert!(new_generation(now, Some(&present)) > present);
    }
    assert!(new_generation(1, Some("nonsense")) > new_generation(0, None));
}
