use serde_json::{Value, json};

use super::super::testing::{document, site, state};
use super::*;

fn request(value: &Value) -> GetRequest {
    GetRequest::parse(value.to_string().as_bytes()).unwrap()
}

/// On the broker of a node or of the layer.
fn served(node: Option<&str>) -> Served {
    let mut served = Served::new(site(node));
    let documents = [
        document("Layer/edge", 1, json!({"config": {"log": "info"}})),
        document("Node/robot-1", 2, json!({"layer": "edge", "config": {"gpu": true}})),
        document("Service/slam", 3, json!({"config": {"rate_hz": 30}})),
        document("Instance/slam/0", 4, json!({"node": "robot-1", "config": {"rate_hz": 10}})),
    ];
    served.load(state(9, documents), Source::Copy);
    served.flush(Instant::now());
    served
}

fn config(reply: &Reply) -> Value {
    match reply {
        Reply::Standing(standing) => standing.config.value().clone(),
        other => panic!("{other:?} instead of a configuration"),
    }
}

fn code(reply: &Reply) -> (ErrorCode, String) {
    match reply {
        Reply::Error(error) => (error.code, error.detail.clone()),
        other => panic!("{other:?} instead of an error"),
    }
}

#[test]
fn everybody_gets_what_counts_where_it_runs() {
    let now = Instant::now();
    for (node, asked, expected) in [
        (
            Some("robot-1"),
            json!({"service": "slam", "instance": "0"}),
            json!({"rate_hz": 10, "log": "info", "gpu": true}),
        ),
        (
            Some("robot-1"),
            json!({"service": "slam"}),
            json!({"rate_hz": 30, "log": "info", "gpu": true}),
        ),
        (Some("robot-1"), json!({}), json!({"log": "info", "gpu": true})),
        (None, json!({"service": "slam"}), json!({"rate_hz": 30, "log": "info"})),
        (
            None,
            json!({"service": "slam", "instance": "0", "node": "robot-1"}),
            json!({"rate_hz": 10, "log": "info", "gpu": true}),
        ),
        // A node that nobody has written down says nothing.
        (
            None,
            json!({"service": "slam", "instance": "0", "node": "robot-2"}),
            json!({"rate_hz": 10, "log": "info"}),
        ),
        (None, json!({"node": "robot-1"}), json!({"log": "info", "gpu": true})),
    ] {
        let mut served = served(node);
        let reply = answer(&mut served, &request(&asked), now);
        assert_eq!(config(&reply), expected, "{asked} on {node:?}");
        let Reply::Standing(standing) = reply else { continue };
        assert_eq!((standing.revision, standing.source), (9, Source::Copy));
        assert_eq!(
            standing.at.node.as_ref().map(NodeName::as_str),
            node.or(asked["node"].as_str())
        );
        // With the hash that it has now there is nothing to tell.
        let mut again = asked.clone();
        again["hash"] = standing.hash.as_str().into();
        let unchanged = Reply::Unchanged {
            revision: 9,
            hash: standing.hash,
            source: Source::Copy,
            store: None,
        };
        assert_eq!(answer(&mut served, &request(&again), now), unchanged);
    }
}

#[test]
fn refusals_say_why() {
    let now = Instant::now();
    let mut empty = Served::new(site(Some("robot-1")));
    let slam = request(&json!({"service": "slam", "instance": "0"}));
    assert_eq!(code(&answer(&mut empty, &slam, now)).0, ErrorCode::NotReady);
    let mut served = served(Some("robot-1"));
    let reply = answer(&mut served, &request(&json!({"service": "slamm", "instance": "0"})), now);
    assert_eq!(
        code(&reply),
        (ErrorCode::NotFound, "no service slamm; did you mean slam?".to_owned())
    );
    let reply = answer(&mut served, &request(&json!({"service": "camera"})), now);
    assert_eq!(code(&reply), (ErrorCode::NotFound, "no service camera".to_owned()));
    let reply = answer(&mut served, &request(&json!({"service": "slam", "node": "robot-2"})), now);
    let (invalid, detail) = code(&reply);
    assert_eq!(invalid, ErrorCode::InvalidRequest);
    assert!(detail.starts_with("node: "), "{detail}");
}
