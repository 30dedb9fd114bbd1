//! The program `blaze` against an admin port that answers as a flow does.

use std::io::{BufRead as _, BufReader, Write as _};
use std::net::{SocketAddr, TcpListener};

use serde_json::Value;

use crate::cli::stage::{Said, Stage};

/// Answers each request by its path and query until the test ends.
fn fake_admin(answer: fn(&str) -> (u16, String)) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            let lines = BufReader::new(&stream).lines().map_while(Result::ok);
            let head: Vec<String> = lines.take_while(|line| !line.is_empty()).collect();
            let path = head.first().and_then(|line| line.split(' ').nth(1));
            let (status, body) = answer(path.unwrap_or_default());
            // Whoever asked may have gone: an answer that is too long is not read to its end.
            let _ = write!(
                stream,
                "HTTP/1.1 {status} Whatever\r\ncontent-type: application/json\r\ncontent-length: {}\r\n\r\n{body}",
                body.len()
            );
        }
    });
    address
}

fn blaze(line: &str, flow: SocketAddr) -> Said {
    let line = format!("{line} --flow {flow}");
    Stage::new().run("blaze", &line.split(' ').collect::<Vec<_>>())
}

const TOPICS: &str = r#"{"flow":"edge/robot-1","epoch":18446744073709551615,"time":"2026-01-01T00:00:00Z","topics":[{"topic":"imu/data","state":"flowing","rate_hz":50.0,"bytes_per_s":16450,"advertised":[{"layer":"edge","node":"robot-1","service":"imu-driver","instance":"0"}],"requested":[],"later_field":[1]}]}"#;

fn flow(path: &str) -> (u16, String) {
    let why = |verdict: &str, code: &str| {
        let step = format!(
            r#"{{"flow":"edge/robot-1","step":"advertise","ok":true,"code":"{code}","detail":""}}"#
        );
        format!(
            r#"{{"topic":"t","to":"cloud","verdict":"{verdict}","code":"{code}","remedy":"Do this.","steps":[{step}]}}"#
        )
    };
    match path {
        "/v1/topics" => (200, TOPICS.to_owned()),
        "/v1/bridges" => (200, r#"{"flow":"edge/robot-1","bridges":[]}"#.to_owned()),
        "/v1/peers" => {
            (403, r#"{"error":{"code":"access_denied","detail":"a token is needed"}}"#.to_owned())
        }
        "/v1/why?topic=imu/data&to=cloud/cloud-1" => (200, why("flowing", "ok")),
        "/v1/why?topic=camera/image_raw" => (200, why("degraded", "rate_limited")),
        "/v1/why?topic=imu/dta" => (200, why("not_flowing", "no_advertise")),
        _ => (404, format!("{{\"error\":{{\"detail\":\"no {path} here\"}}}}")),
    }
}

#[test]
fn each_format_shows_the_object_of_the_flow() {
    let flow = fake_admin(flow);
    let expected: Value = serde_json::from_str(TOPICS).unwrap();
    let json = blaze("topics -o json", flow);
    assert_eq!((json.code, json.json()), (0, expected.clone()), "{json:?}");
    let yaml = blaze("-o yaml topics", flow).stdout;
    assert_eq!(yaml_serde::from_str::<Value>(&yaml).unwrap(), expected);
    let table = blaze("topics", flow).stdout;
    assert!(table.contains("imu/data  flowing     50.0"), "{table}");
    let table = blaze("bridges", flow).stdout;
    assert!(table.contains("No bridges"), "{table}");
}

#[test]
fn why_exits_by_its_verdict() {
    let flow = fake_admin(flow);
    let flowing = blaze("why imu/data --to cloud/cloud-1", flow);
    assert_eq!(flowing.code, 0, "{flowing:?}");
    let degraded = blaze("why camera/image_raw", flow);
    assert_eq!(degraded.code, 0);
    assert!(degraded.stdout.contains("not as asked (rate_limited)"));
    let none = blaze("why imu/dta", flow);
    assert_eq!(none.code, 1);
    assert!(none.stdout.contains("What to do: Do this."));
    assert!(none.stderr.contains("did you mean imu/data?"), "{none:?}");
}

#[test]
fn refusals_have_their_exit_codes() {
    let flow = fake_admin(flow);
    let denied = blaze("peers", flow);
    assert_eq!(denied.code, 6);
    assert!(denied.stderr.contains("a token is needed"));
    assert_eq!(blaze("why other", flow).code, 4);
    assert_eq!(blaze("why", flow).code, 2);
}

#[test]
fn a_port_where_nobody_listens_says_so() {
    let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let said = blaze("topics", address);
    assert_eq!(said.code, 3);
    let text = said.stderr;
    assert!(text.contains(&address.to_string()) && text.contains("--flow HOST:PORT"), "{text}");
}

#[test]
fn a_program_that_is_no_flow_is_named_and_an_answer_without_end_is_cut() {
    let foreign = blaze("topics", fake_admin(|_| (200, "<html>".to_owned())));
    assert_eq!(foreign.code, 1);
    assert!(foreign.stderr.contains("not as a flow does"));
    let endless = fake_admin(|_| (200, format!("{{\"x\":\"{}\"}}", "y".repeat(17 * 1024 * 1024))));
    let cut = blaze("topics -o json", endless);
    assert_eq!((cut.code, cut.stdout.as_str()), (1, ""), "{}", cut.stderr);
}

#[test]
fn completions_and_version_are_there() {
    let blaze = |words: &[&str]| Stage::new().run("blaze", words).stdout;
    assert!(blaze(&["completions", "bash"]).contains("bridges"));
    assert_eq!(blaze(&["--version"]), format!("blaze {}\n", env!("CARGO_PKG_VERSION")));
}
