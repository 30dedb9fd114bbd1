//! What needs no server; the rest is in [`conformance`](crate::copy::conformance).

use super::*;

#[test]
fn names_of_databases_are_checked_before_anything_is_asked() {
    let copy = |database: &str, node: Option<&str>| {
        let node = node.map(|node| node.parse().unwrap());
        let uri = SecretText::from("mongodb://me:canary@127.0.0.1:1".to_owned());
        MongoCopy::new(uri, database, "edge".parse().unwrap(), node.as_ref(), Vault::default())
    };
    assert_eq!(copy("blaze", None).unwrap().describe(), "MongoDB blaze, copy edge");
    assert!(
        copy("blaze", Some("robot-1"))
            .unwrap()
            .describe()
            .ends_with("copy edge.robot-1")
    );
    for wrong in ["", "a/b", "a.b", "$cmd", "\u{e4}", &"x".repeat(64)] {
        assert!(
            matches!(copy(wrong, None).err(), Some(CopyError::Refused { .. })),
            "{wrong}"
        );
    }
}

#[tokio::test]
async fn a_server_that_is_away_is_no_broken_copy_and_its_password_is_not_told() {
    let uri = SecretText::from("mongodb://me:canary@127.0.0.1:1/?directConnection=true".to_owned());
    let copy = MongoCopy::new(uri, "blaze", "edge".parse().unwrap(), None, Vault::default()).unwrap();
    let error = copy.load().await.unwrap_err();
    assert!(matches!(error, CopyError::Away { .. }), "{error}");
    assert!(!error.to_string().contains("canary"), "{error}");
}
