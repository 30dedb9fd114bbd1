//! The load generator of `blaze-bench config`, at tiny counts: it measures answers that are
//! checked, or fails.
//!
//! Needs `cargo build --workspace` and `scripts/services install` (etcd, MongoDB).

#![allow(clippy::unwrap_used, reason = "the helpers of a test fail like the test")]

use std::process::Command;

use serde_json::Value;

fn run(arguments: &[&str]) -> (bool, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_blaze-bench"))
        .args([
            "config",
            "--documents",
            "200",
            "--connections",
            "2",
            "--watchers",
            "5",
            "--rate",
            "50",
        ])
        .args(["--seconds", "0.3", "--warm-up", "0.06", "--turns", "2"])
        .args(arguments)
        .output()
        .unwrap();
    let text = [output.stdout, output.stderr].concat();
    (output.status.success(), String::from_utf8_lossy(&text).into_owned())
}

#[test]
fn every_load_is_done_by_everybody() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("figures.json");
    let (done, text) = run(&["--json", file.to_str().unwrap()]);
    assert!(done, "{text}");
    let found: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    let rows = found["rows"].as_array().unwrap();
    for load in ["get, 2 conn", "put, 2 conn", "apply 100, 2 conn", "watch, 5 at 50 Hz"] {
        let of_load: Vec<&Value> = rows.iter().filter(|row| row["load"] == load).collect();
        let names: Vec<&str> = of_load.iter().map(|row| row["subject"].as_str().unwrap()).collect();
        let blaze =
            ["blaze grpc mongodb", "blaze grpc sqlite", "blaze rest mongodb", "blaze rest sqlite"];
        let in_turns: Vec<&str> = blaze.into_iter().flat_map(|name| ["etcd", name]).collect();
        assert_eq!(names, in_turns, "{load}");
        for row in of_load {
            assert!(
                row["operations"].as_u64().unwrap() > 0 && row["p99_ms"].as_f64().unwrap() > 0.0,
                "{row}"
            );
            let is_blaze = row["subject"] != "etcd";
            assert_eq!(row["to_etcd"].is_number(), is_blaze, "{row}");
            assert_eq!(row["batch"].is_number(), is_blaze && !load.starts_with("get"), "{row}");
        }
    }
    assert_eq!(found["memory"].as_array().unwrap().len(), 3);
    assert_eq!(found["medians"].as_array().unwrap().len(), 16);
}

#[test]
fn what_nobody_is_called_is_told_before_anything_starts() {
    for arguments in [["--only", "nonsense"], ["--beside", "nonsense"]] {
        let (done, text) = run(&arguments);
        assert!(!done && text.contains("is called \"nonsense\""), "{text}");
    }
}
