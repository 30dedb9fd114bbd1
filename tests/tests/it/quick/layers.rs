//! Which crate may know which: the table of ARCHITECTURE.md, checked against `cargo metadata`.

use std::collections::{BTreeMap, BTreeSet};

use cargo_metadata::MetadataCommand;

/// Crate, and the crates of ours that it may depend on.
const ALLOWED: &[(&str, &[&str])] = &[
    ("blaze-domain", &[]),
    ("blaze-proto", &["blaze-domain"]),
    ("blaze-runtime", &[]),
    ("blaze-auth", &["blaze-domain"]),
    ("blaze-convert", &[]),
    ("blaze-config", &["blaze-domain", "blaze-proto", "blaze-runtime", "blaze-auth"]),
    ("blaze-brokers", &["blaze-domain", "blaze-proto", "blaze-runtime"]),
    (
        // A flow is a service of its node, too.
        "blaze-flow",
        &[
            "blaze-domain",
            "blaze-proto",
            "blaze-runtime",
            "blaze-brokers",
            "blaze-convert",
            "blaze-sdk",
        ],
    ),
    ("blaze-worker", &["blaze-domain", "blaze-proto", "blaze-runtime", "blaze-brokers"]),
    ("blaze-sdk", &["blaze-domain", "blaze-proto", "blaze-runtime", "blaze-brokers"]),
    (
        "blaze-monitor",
        &["blaze-domain", "blaze-proto", "blaze-runtime", "blaze-brokers", "blaze-sdk"],
    ),
    (
        "blaze",
        &[
            "blaze-convert",
            "blaze-domain",
            "blaze-proto",
            "blaze-runtime",
            "blaze-brokers",
            "blaze-flow",
            "blaze-sdk",
            "blaze-auth",
            "blaze-config",
            "blaze-worker",
            "blaze-monitor",
        ],
    ),
    (
        "blaze-tests",
        &[
            "blaze-domain",
            "blaze-proto",
            "blaze-runtime",
            "blaze-brokers",
            "blaze-flow",
            "blaze-sdk",
            "blaze-auth",
            "blaze-config",
            "blaze-worker",
            "blaze",
        ],
    ),
    ("blaze-conformance", &["blaze-domain", "blaze-proto", "blaze-brokers", "blaze-config"]),
    (
        "blaze-bench",
        &[
            "blaze-domain",
            "blaze-proto",
            "blaze-brokers",
            "blaze-flow",
            "blaze-auth",
            "blaze-tests",
        ],
    ),
];

/// Crates that may use an outside crate which would otherwise creep in everywhere.
const OUTSIDE: &[(&str, &[&str])] = &[
    // The tests have a plain DDS program, which knows nothing of BlazeAIoT.
    ("rustdds", &["blaze-brokers", "blaze-tests", "blaze-bench"]),
    ("axum", &["blaze-runtime", "blaze-flow", "blaze-config", "blaze-worker", "blaze-monitor"]),
    (
        "anyhow",
        &[
            "blaze-runtime",
            "blaze-flow",
            "blaze-config",
            "blaze-worker",
            "blaze-monitor",
            "blaze",
            "blaze-tests",
            "blaze-bench",
        ],
    ),
    ("mongodb", &["blaze-config", "blaze-worker", "blaze-tests"]),
    ("rusqlite", &["blaze-config"]),
    (
        "tokio",
        &[
            "blaze-runtime",
            "blaze-brokers",
            "blaze-flow",
            "blaze-config",
            "blaze-worker",
            "blaze-monitor",
            "blaze-sdk",
            "blaze",
            "blaze-conformance",
            "blaze-tests",
            "blaze-bench",
        ],
    ),
];

fn dependencies() -> BTreeMap<String, BTreeSet<String>> {
    let metadata = MetadataCommand::new().no_deps().exec().expect("cargo metadata runs");
    metadata
        .packages
        .iter()
        .map(|package| {
            let normal = package
                .dependencies
                .iter()
                .filter(|d| d.kind == cargo_metadata::DependencyKind::Normal);
            (package.name.to_string(), normal.map(|d| d.name.clone()).collect())
        })
        .collect()
}

#[test]
fn our_crates_know_only_whom_they_may() {
    let found = dependencies();
    let names: BTreeSet<&str> = ALLOWED.iter().map(|(name, _)| *name).collect();
    let members: BTreeSet<&str> = found.keys().map(String::as_str).collect();
    assert_eq!(members, names, "every crate of the workspace is in the table");
    for (name, allowed) in ALLOWED {
        for dependency in found[*name].iter().filter(|d| names.contains(d.as_str())) {
            assert!(
                allowed.contains(&dependency.as_str()),
                "{name} must not depend on {dependency}"
            );
        }
    }
}

#[test]
fn outside_crates_stay_where_they_belong() {
    let found = dependencies();
    for (outside, allowed) in OUTSIDE {
        for (name, dependencies) in &found {
            let uses = dependencies.contains(*outside);
            assert!(
                !uses || allowed.contains(&name.as_str()),
                "{name} must not depend on {outside}"
            );
        }
    }
}
