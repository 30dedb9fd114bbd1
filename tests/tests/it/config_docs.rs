//! The pages of BlazeConfig say what is true: the tour runs as it stands.

use std::path::{Path, PathBuf};
use std::process::Command;

use blaze_tests::process::binary;
use blaze_tests::servers::shared_mongo;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Each command of the page, with curl and with `blaze`, on SQLite and on MongoDB; what they print
/// is what the page shows.
#[test]
fn the_tour_runs_as_it_stands() {
    let program = binary("blaze-config").unwrap();
    let output = Command::new(root().join("scripts/tour"))
        .arg("--bin")
        .arg(program.parent().expect("a program lies in a folder"))
        .env("BLAZE_TEST_MONGODB_URI", shared_mongo().unwrap())
        .output()
        .unwrap();
    let (said, faults) =
        (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    println!("{said}{faults}");
    assert!(output.status.success(), "{}", output.status);
    for way in ["sqlite", "mongodb", "curl", "cli"] {
        assert!(said.contains(way) || faults.contains(way), "{way} was left out");
    }
}
