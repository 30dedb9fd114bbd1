//! `blaze demo --brokers real`.

use std::process::Command;

use blaze_tests::process::binary;
use blaze_tests::servers::{shared_kafka, shared_kafka_cloud, shared_redis};
use serde_json::Value;

#[test]
fn the_demo_runs_on_redis_and_kafka_with_the_same_verdict() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    std::fs::create_dir(folder.path().join(".services"))?;
    let addresses = format!(
        "BLAZE_TEST_REDIS_URL={}\nBLAZE_TEST_KAFKA_FOG={}\nBLAZE_TEST_KAFKA_CLOUD={}\n",
        shared_redis()?,
        shared_kafka()?,
        shared_kafka_cloud()?
    );
    std::fs::write(folder.path().join(".services/env"), addresses)?;
    let seconds = if blaze_tests::long() { "30s" } else { "10s" };
    let output = Command::new(binary("blaze")?)
        .args(["demo", "--brokers", "real", "--duration", seconds, "-o", "json"])
        .current_dir(folder.path())
        .output()?;
    let lines = String::from_utf8_lossy(&output.stdout).into_owned();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    let summary: Value = serde_json::from_str(lines.lines().last().unwrap_or_default())
        .map_err(|error| anyhow::anyhow!("{error}: {lines}\n{said}"))?;
    println!("{summary}");
    assert!(output.status.success(), "{summary}\n{said}");
    assert_eq!((&summary["kind"], &summary["ok"]), (&Value::from("summary"), &Value::from(true)));
    let topics = summary["topics"].as_array().cloned().unwrap_or_default();
    let to_cloud = topics
        .iter()
        .find(|row| {
            row["topic"] == "imu/data"
                && row["to"] == "cloud/cloud-1"
                && row["service"] == "recorder"
        })
        .unwrap_or(&Value::Null);
    assert_eq!(
        to_cloud["route"],
        serde_json::json!(["node:redis", "inter:dds", "layer:kafka"]),
        "{to_cloud}"
    );
    // Over a worker on Redis.
    for document in ["service/analytics", "node/robot-1"] {
        let mut changes = summary["changes"].as_array().into_iter().flatten();
        assert!(changes.any(|change| change["document"] == document), "{document}: {summary}");
    }
    for row in topics.iter().filter(|row| row["topic"] != "camera/image_raw") {
        for count in ["lost", "duplicated", "reordered"] {
            assert_eq!(row[count], 0, "{row}");
        }
        assert!(row["received"].as_u64() > Some(0), "{row}");
    }
    Ok(())
}

#[test]
fn without_addresses_it_says_what_to_run() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let output = Command::new(binary("blaze")?)
        .args(["demo", "--brokers", "real"])
        .current_dir(folder.path())
        .output()?;
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.contains("./scripts/services start"), "{said}");
    Ok(())
}
