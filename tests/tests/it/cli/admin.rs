//! The program `blaze` against an admin port that answers as a flow does.

use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpListener};
use std::process::{Command, Output};

/// Answers each request by its path and query until the test ends.
fn fake_admin(answer: fn(&str) -> (u16, String)) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            let mut request = Vec::new();
            let mut buffer = [0; 1024];
            while !request.windows(4).any(|window| window == b"\r\n\r\n") {
                match stream.read(&mut buffer).unwrap() {
                    0 => break,
                    count => request.extend_from_slice(&buffer[..count]),
                }
            }
            let request = String::from_utf8(request).unwrap();
            let path = request.split(' ').nth(1).unwrap_or_default();
            let (status, body) = answer(path);
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

fn blaze(arguments: &[&str]) -> Output {
    Command::new(blaze_tests::process::binary("blaze").unwrap())
        .args(arguments)
        .output()
        .unwrap()
}

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

const TOPICS: &str = r#"{"flow":"edge/robot-1","epoch":18446744073709551615,"time":"2026-01-01T00:00:00Z","topics":[{"topic":"imu/data","state":"flowing","rate_hz":50.0,"bytes_per_s":16450,"advertised":[{"layer":"edge","node":"robot-1","service":"imu-driver","instance":"0"}],"requested":[],"later_field":[1]}]}"#;

fn flow(path: &str) -> (u16, String) {
    let why = |verdict: &str, code: &str| {
        let step = format!(r#"{{"flow":"edge/robot-1","step":"advertise","ok":true,"code":"{code}","detail":""}}"#);
        format!(
            r#"{{"topic":"t","to":"cloud","verdict":"{verdict}","code":"{code}","remedy":"Do this.","steps":[{step}]}}"#
        )
    };
    match path {
        "/v1/topics" => (200, TOPICS.to_owned()),
        "/v1/bridges" => (200, r#"{"flow":"edge/robot-1","bridges":[]}"#.to_owned()),
        "/v1/peers" => (
            403,
            r#"{"error":{"code":"access_denied","detail":"a token is needed"}}"#.to_owned(),
        ),
        "/v1/why?topic=imu/data&to=cloud/cloud-1" => (200, why("flowing", "ok")),
        "/v1/why?topic=camera/image_raw" => (200, why("degraded", "rate_limited")),
        "/v1/why?topic=imu/dta" => (200, why("not_flowing", "no_advertise")),
        _ => (404, format!("{{\"error\":{{\"detail\":\"no {path} here\"}}}}")),
    }
}

#[test]
fn json_is_the_object_of_the_flow() {
    let address = fake_admin(flow).to_string();
    let output = blaze(&["topics", "--flow", &address, "-o", "json"]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let got: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(got, serde_json::from_str::<serde_json::Value>(TOPICS).unwrap());
}

#[test]
fn yaml_is_the_same_object() {
    let address = fake_admin(flow).to_string();
    let output = blaze(&["-o", "yaml", "topics", "--flow", &address]);
    let got: serde_json::Value = yaml_serde::from_str(&stdout(&output)).unwrap();
    assert_eq!(got, serde_json::from_str::<serde_json::Value>(TOPICS).unwrap());
}

#[test]
fn tables_are_for_people() {
    let address = fake_admin(flow).to_string();
    let output = blaze(&["topics", "--flow", &address]);
    assert!(
        stdout(&output).contains("imu/data  flowing     50.0"),
        "{}",
        stdout(&output)
    );
    let output = blaze(&["bridges", "--flow", &address]);
    assert!(stdout(&output).contains("No bridges"), "{}", stdout(&output));
}

#[test]
fn why_exits_by_its_verdict() {
    let address = fake_admin(flow).to_string();
    let output = blaze(&["why", "imu/data", "--to", "cloud/cloud-1", "--flow", &address]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let output = blaze(&["why", "camera/image_raw", "--flow", &address]);
    assert_eq!(output.status.code(), Some(0));
    assert!(stdout(&output).contains("not as asked (rate_limited)"));
    let output = blaze(&["why", "imu/dta", "--flow", &address]);
    assert_eq!(output.status.code(), Some(1));
    assert!(stdout(&output).contains("What to do: Do this."));
    assert!(
        stderr(&output).contains("did you mean imu/data?"),
        "{}",
        stderr(&output)
    );
}

#[test]
fn refusals_have_their_exit_codes() {
    let address = fake_admin(flow).to_string();
    let output = blaze(&["peers", "--flow", &address]);
    assert_eq!(output.status.code(), Some(6));
    assert!(stderr(&output).contains("a token is needed"));
    let output = blaze(&["why", "other", "--flow", &address]);
    assert_eq!(output.status.code(), Some(4));
    assert_eq!(blaze(&["why", "--flow", &address]).status.code(), Some(2));
}

#[test]
fn a_port_where_nobody_listens_says_so() {
    let address = {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        listener.local_addr().unwrap().to_string()
    };
    let output = blaze(&["topics", "--flow", &address]);
    assert_eq!(output.status.code(), Some(3));
    let text = stderr(&output);
    assert!(text.contains(&address) && text.contains("--flow HOST:PORT"), "{text}");
}

#[test]
fn a_program_that_is_no_flow_is_named() {
    let address = fake_admin(|_| (200, "<html>".to_owned())).to_string();
    let output = blaze(&["topics", "--flow", &address]);
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("not as a flow does"));
}

#[test]
fn an_answer_without_end_is_cut() {
    let address = fake_admin(|_| (200, format!("{{\"x\":\"{}\"}}", "y".repeat(17 * 1024 * 1024)))).to_string();
    let output = blaze(&["topics", "--flow", &address, "-o", "json"]);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    assert!(output.stdout.is_empty());
}

#[test]
fn completions_and_version_are_there() {
    let output = blaze(&["completions", "bash"]);
    assert!(stdout(&output).contains("bridges"));
    assert_eq!(
        stdout(&blaze(&["--version"])),
        format!("blaze {}\n", env!("CARGO_PKG_VERSION"))
    );
}
