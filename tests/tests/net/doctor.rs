//! `blaze doctor` where the machine is not as it should be: each fault is named, and the remedy
//! helps.

use std::path::Path;
use std::process::{Command, Output};

use blaze_tests::network::{Plan, Topology, program};
use blaze_tests::process::binary;
use blaze_tests::wan::{Change, Shape, Ways};
use serde_json::{Value, json};

fn check(output: &Output, name: &str) -> Value {
    let answer: Value = serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|error| panic!("{error}: {output:?}"));
    let checks = answer["checks"].as_array().unwrap().clone();
    checks.into_iter().find(|check| check["check"] == name).unwrap()
}

fn node_file(path: &Path, more: &Value) {
    let mut file = json!({
        "layer": { "name": "edge", "kind": "edge" }, "node": { "name": "robot-1" },
        "brokers": { "node": { "memory": {} } },
    });
    file.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
    std::fs::write(path, file.to_string()).unwrap();
}

/// A file system of 1 MiB in a mount namespace of its own, first full, then not.
#[test]
fn a_full_disk_is_named_until_files_are_deleted() {
    let folder = tempfile::tempdir().unwrap();
    let (file, state) = (folder.path().join("blaze.yaml"), folder.path().join("state"));
    std::fs::create_dir(&state).unwrap();
    node_file(&file, &json!({ "state_dir": state }));
    let script = "mount -t tmpfs -o size=1m none state && \
        { head -c 2000000 /dev/zero > state/large 2>/dev/null; \
          \"$BLAZE\" doctor -o json --config blaze.yaml > full.json; rm state/large; \
          \"$BLAZE\" doctor -o json --config blaze.yaml; }";
    let output = Command::new("unshare")
        .args(["--mount", "sh", "-c", script])
        .env("BLAZE", binary("blaze").unwrap())
        .current_dir(folder.path())
        .output()
        .unwrap();
    let full = std::fs::read(folder.path().join("full.json")).unwrap();
    let disk = check(&Output { stdout: full, ..output.clone() }, "disk");
    assert_eq!(disk["result"], "fail", "{disk}");
    assert!(disk["detail"].as_str().unwrap().contains(&state.display().to_string()), "{disk}");
    assert!(disk["remedy"].as_str().unwrap().starts_with("du -xh"), "{disk}");
    assert_eq!(check(&output, "disk")["result"], "ok", "{output:?}");
}

/// A router drops what is too large without a word, then the own interface is too narrow.
#[test]
fn a_wrong_mtu_is_named_until_the_node_file_has_the_right_one() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("blaze.yaml");
    let network = Topology::build(&Plan::two_hosts("a", "b", Shape::default()))?;
    let (a, b) = (network.host("a")?, network.host("b")?);
    let doctor = |mtu: u16| {
        let inter = json!({ "dds": { "domain": 20, "listen": a.address, "peers": [b.address],
            "mtu": mtu } });
        node_file(&file, &json!({ "brokers": { "inter": inter }, "state_dir": folder.path() }));
        let blaze = binary("blaze")?;
        let mut command = program(Some(&a.namespace), blaze);
        command.args(["doctor", "-o", "json", "--config"]).arg(&file);
        anyhow::Ok(check(&command.output()?, "mtu"))
    };
    let fine = doctor(1500)?;
    assert_eq!(fine["result"], "ok", "{fine}");
    network.link("a", "b")?.set(Ways::Both, &[Change::Mtu(1400)])?;
    let wrong = doctor(1500)?;
    assert_eq!(wrong["result"], "fail", "{wrong}");
    let remedy = wrong["remedy"].as_str().unwrap_or_default();
    assert!(remedy.starts_with("set brokers.inter.dds.mtu: 1400 in"), "{wrong}");
    let mended = doctor(1400)?;
    assert_eq!(mended["result"], "ok", "{mended}");
    Ok(())
}
