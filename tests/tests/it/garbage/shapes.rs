//! The admin JSON: every key of the contract is there, with a value of its type, while messages
//! flow.

use std::time::Duration;

use serde_json::Value;

use blaze_tests::admin::Admin;
use blaze_tests::flow::free_domain;
use blaze_tests::process::Process;
use blaze_tests::wait;

const DEADLINE: Duration = Duration::from_secs(20);

/// `key` or `key?`, where `?` allows null; then the type: s(text) n(number) b(ool) o(bject)
/// a(rray).
fn check(value: &Value, keys: &str) {
    for key in keys.split_whitespace() {
        let (key, kind) = key.split_once(':').unwrap();
        let (kind, nullable) = kind.strip_suffix('?').map_or((kind, false), |kind| (kind, true));
        let member = value.get(key).unwrap_or_else(|| panic!("{key} is missing in {value}"));
        let fits = match kind {
            "s" => member.is_string(),
            "n" => member.is_number(),
            "b" => member.is_boolean(),
            "o" => member.is_object(),
            "a" => member.is_array(),
            other => panic!("{other} is no type"),
        };
        assert!(fits || (nullable && member.is_null()), "{key} is {member} in {value}");
    }
}

const ALL: &str = "flow:s epoch:n time:s";

fn ask(admin: &Admin, path: &str) -> Value {
    let (status, body) = admin.get(path).unwrap();
    assert_eq!(status, 200, "{path}: {body}");
    let value = serde_json::from_str(&body).unwrap();
    check(&value, ALL);
    value
}

fn rows<'a>(value: &'a Value, key: &str) -> &'a Vec<Value> {
    let rows = value[key].as_array().unwrap_or_else(|| panic!("no {key} in {value}"));
    assert!(!rows.is_empty(), "{key} is empty: {value}");
    rows
}

fn topics(admin: &Admin) {
    let identity = "layer:s node:s service:s instance:s scope:s broker:s? local:b";
    let answer = ask(admin, "/v1/topics");
    // Pings of a layer may have a requester before a monitor elsewhere publishes any.
    let is_of_users = |row: &&Value| !row["topic"].as_str().unwrap().starts_with("blaze/");
    for row in rows(&answer, "topics").iter().filter(is_of_users) {
        check(row, "topic:s state:s rate_hz:n bytes_per_s:n advertised:a requested:a");
        assert!(
            ["flowing", "no_request", "no_advertise", "blocked"]
                .contains(&row["state"].as_str().unwrap())
        );
        for advertised in rows(row, "advertised") {
            check(advertised, identity);
            check(
                advertised,
                "rate_hz:n? max_bytes:n? priority:s? reliability:s durability:s expires_in_s:n?",
            );
        }
        for requested in rows(row, "requested") {
            check(requested, identity);
            check(requested, "max_rate_hz:n? lifespan_ms:n bare:b");
        }
    }
}

fn bridges(admin: &Admin) {
    let answer = ask(admin, "/v1/bridges");
    for row in rows(&answer, "bridges") {
        check(row, "id:s topic:s from:o to:o state:s since_s:n in:o out:o queued:n dropped:o");
        check(&row["from"], "scope:s broker:s");
        check(&row["to"], "scope:s broker:s layer:s flow:s");
        check(&row["in"], "messages:n bytes:n");
        check(&row["out"], "messages:n bytes:n");
        check(&row["latency_ms"], "p50:n? p99:n?");
        let dropped: u64 =
            row["dropped"].as_object().unwrap().values().map(|count| count.as_u64().unwrap()).sum();
        let number = |key: &str| row[key]["messages"].as_u64().unwrap();
        assert_eq!(
            number("in"),
            number("out") + dropped + row["queued"].as_u64().unwrap(),
            "{row}"
        );
        let id = row["id"].as_str().unwrap();
        let (from, to) =
            (row["from"]["scope"].as_str().unwrap(), row["to"]["scope"].as_str().unwrap());
        let layer = row["to"]["layer"].as_str().unwrap();
        assert_eq!(id, format!("{}|{from}>{to}|{layer}", row["topic"].as_str().unwrap()));
    }
}

fn peers(admin: &Admin) {
    let answer = ask(admin, "/v1/peers");
    for row in rows(&answer, "peers") {
        check(
            row,
            "flow:s layer:s kind:s epoch:n version:n state:s last_heard_ms:n? rtt_ms:n? \
             clock_offset_ms:n? \
             clock_error_ms:n? loss:n address:s?",
        );
    }
}

fn allocation(admin: &Admin) {
    let answer = ask(admin, "/v1/allocation");
    check(
        &answer,
        "limit_mbps:n budget_bytes_per_s:n measured_bytes_per_s:n? wire_factor:n? feasible:b?",
    );
    for row in rows(&answer, "topics") {
        check(row, "topic:s class:s size_bytes:n advertised_hz:n lanes:a");
        assert!(["standard", "large"].contains(&row["class"].as_str().unwrap()));
        for lane in rows(row, "lanes") {
            check(lane, "layer:s allocated_hz:n? actual_hz:n skipped:n exceeds_advertised:b");
        }
    }
    for row in rows(&answer, "links") {
        check(row, "layer:s limit_bytes_per_s:n? wire_bytes_per_s:n");
    }
}

fn why(admin: &Admin) {
    for (question, verdict, code) in [
        ("imu/data&to=fog", "flowing", "ok"),
        ("imu/data", "flowing", "ok"),
        ("imu/data&to=fog/fog-1/dashboard", "flowing", "ok"),
        ("nobody/knows", "not_flowing", "no_advertise"),
        ("imu/data&to=moon", "not_flowing", "no_request"),
    ] {
        let answer = ask(admin, &format!("/v1/why?topic={question}"));
        check(&answer, "topic:s to:s? verdict:s code:s remedy:s? steps:a");
        assert_eq!(
            (&answer["verdict"], &answer["code"]),
            (&verdict.into(), &code.into()),
            "{question}: {answer}"
        );
        for step in rows(&answer, "steps") {
            check(step, "flow:s step:s ok:b code:s detail:s");
            let step = step["step"].as_str().unwrap();
            assert!(
                ["advertise", "request", "plan", "bridge", "admit", "link", "deliver"]
                    .contains(&step),
                "{step}"
            );
        }
    }
    for question in ["", "?to=fog", "?topic", "?topic="] {
        let (status, body) = admin.get(&format!("/v1/why{question}")).unwrap();
        assert_eq!(status, 400, "{question}: {body}");
        check(&serde_json::from_str::<Value>(&body).unwrap()["error"], "code:s detail:s");
    }
    for question in ["?topic=a//b", "?topic=imu/data&to=/", "?topic=%ff%00"] {
        let (status, body) = admin.get(&format!("/v1/why{question}")).unwrap();
        assert_eq!(status, 200, "{question}: {body}");
        let answer: Value = serde_json::from_str(&body).unwrap();
        assert_eq!(answer["verdict"], "not_flowing", "{question}: {answer}");
    }
    for path in [
        "/",
        "/v1",
        "/v1/",
        "/v1/nothing",
        "/v2/topics",
        "/metrics/",
        "/%00",
        "/..%2f..%2fetc/passwd",
    ] {
        let (status, body) = admin.get(path).unwrap();
        assert_eq!(status, 404, "{path}: {body}");
        check(&serde_json::from_str::<Value>(&body).unwrap()["error"], "code:s detail:s");
    }
}

#[test]
fn every_answer_has_the_keys_of_the_contract() {
    let domain = format!("brokers.inter.dds.domain={}", free_domain().unwrap());
    let arguments = ["demo", "--only", "robot-1,fog-1", "--duration", "120s", "--set", &domain];
    let mut demo = Process::start("blaze", &arguments, None).unwrap();
    let robot = demo.node_ready("robot-1", DEADLINE).unwrap();
    let flows = || {
        let answer = robot.json("/v1/why?topic=camera/image_raw&to=fog").unwrap_or_default();
        let small = robot.json("/v1/why?topic=imu/data&to=fog").unwrap_or_default();
        small["verdict"] == "flowing" && answer["verdict"] != "not_flowing" && !answer.is_null()
    };
    wait::until("messages flow", DEADLINE, flows, || demo.tail()).unwrap();
    let rated =
        || robot.json("/v1/allocation").is_ok_and(|answer| answer["wire_factor"].is_number());
    wait::until("rates are measured", DEADLINE, rated, || demo.tail()).unwrap();
    topics(&robot);
    bridges(&robot);
    peers(&robot);
    allocation(&robot);
    why(&robot);
    let fog = demo.node_ready("fog-1", DEADLINE).unwrap();
    topics(&fog);
    bridges(&fog);
    peers(&fog);
    let (status, body) = robot.get("/readyz").unwrap();
    let ready: Value = serde_json::from_str(&body).unwrap();
    assert_eq!((status, &ready["status"]), (200, &"ready".into()));
    for name in ["node_broker", "layer_broker", "inter", "config"] {
        check(&ready["checks"][name], "status:s detail:s since_s:n");
    }
}
