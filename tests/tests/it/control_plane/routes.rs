//! Every operation of REST and every method of gRPC, as the service itself lists them, and what right each needs.

use blaze_proto::{CONFIG_DESCRIPTORS, Message as _, google};
use reqwest::Method;
use serde_json::Value;

/// The document that clients are generated from; a test beside the router compares the two.
pub(crate) const OPENAPI: &str = include_str!("../../../../openapi/openapi.json");
/// The service that answers to tokens.
pub(crate) const SERVICE: &str = "blaze.v1.ConfigService";

/// What a token must allow, as the contract's table of roles has it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Right {
    Read,
    Write,
    Admin,
}

/// Roles, and whether they may read, write and administer.
pub(crate) const ROLES: [(&str, [bool; 3]); 4] = [
    ("viewer", [true, false, false]),
    ("operator", [true, true, false]),
    ("admin", [true, true, true]),
    ("worker", [true, false, false]),
];

/// Methods of gRPC that change documents; those of administrators alone; all others read.
const WRITES: [&str; 8] = [
    "Create",
    "Replace",
    "Patch",
    "Delete",
    "Apply",
    "Rollback",
    "SetRollout",
    "Revert",
];
const ADMIN: [&str; 5] = ["ListAudit", "CreateToken", "RevokeToken", "ListTokens", "Trim"];
const READS: [&str; 9] = [
    "List",
    "Get",
    "GetEffective",
    "ListHistory",
    "Diff",
    "Watch",
    "GetTopology",
    "ListWorkers",
    "GetDigest",
];

/// One operation of REST.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Operation {
    pub(crate) method: Method,
    /// With its placeholders.
    pub(crate) path: String,
    pub(crate) right: Right,
}

impl Operation {
    fn new(method: Method, path: &str) -> Self {
        let administers = ["/audit", "/tokens", "/trim"]
            .iter()
            .any(|part| path.starts_with(&format!("/api/v1{part}")));
        let right = match (administers, method == Method::GET || method == Method::HEAD) {
            (true, _) => Right::Admin,
            (false, true) => Right::Read,
            (false, false) => Right::Write,
        };
        Self {
            method,
            path: path.to_owned(),
            right,
        }
    }

    /// The path with names of nothing.
    pub(crate) fn target(&self) -> String {
        filled(&self.path)
    }
}

/// A path with names of nothing in place of its placeholders.
pub(crate) fn filled(path: &str) -> String {
    path.replace("{name}", "none")
        .replace("{service}", "none")
        .replace("{id}", "0197c1d2-7f3a-7b64-9c1e-2f6f0a4e8d11")
}

/// All operations below `/api`, `HEAD` with each `GET`.
pub(crate) fn operations() -> Vec<Operation> {
    let document: Value = serde_json::from_str(OPENAPI).unwrap();
    let mut operations = Vec::new();
    for (path, item) in document["paths"].as_object().unwrap() {
        assert!(path.starts_with("/api/v1/"), "{path} has no token");
        for name in item.as_object().unwrap().keys() {
            let Ok(method) = name.to_ascii_uppercase().parse::<Method>() else {
                continue;
            };
            if !["get", "put", "post", "patch", "delete"].contains(&name.as_str()) {
                assert!(
                    ["parameters", "summary", "description"].contains(&name.as_str()),
                    "{name} of {path}"
                );
                continue;
            }
            if method == Method::GET {
                operations.push(Operation::new(Method::HEAD, path));
            }
            operations.push(Operation::new(method, path));
        }
    }
    operations
}

/// All services and methods, as reflection would tell them.
fn descriptors() -> Vec<(String, String)> {
    let set = google::FileDescriptorSet::decode(CONFIG_DESCRIPTORS).unwrap();
    let mut methods = Vec::new();
    for file in &set.file {
        for service in &file.service {
            let full = format!("{}.{}", file.package(), service.name());
            methods.extend(
                service
                    .method
                    .iter()
                    .map(|method| (full.clone(), method.name().to_owned())),
            );
        }
    }
    methods
}

/// The methods of [`SERVICE`], with the right that each needs. A method that nobody has given a right is a fault.
pub(crate) fn methods() -> Vec<(String, Right)> {
    let names = descriptors()
        .into_iter()
        .filter(|(service, _)| service == SERVICE)
        .map(|(_, name)| name);
    let right = |name: &str| match name {
        name if WRITES.contains(&name) => Right::Write,
        name if ADMIN.contains(&name) => Right::Admin,
        name if READS.contains(&name) => Right::Read,
        other => panic!("which right does {other} need?"),
    };
    names.map(|name| (name.clone(), right(&name))).collect()
}

/// Paths of methods of other services of the proto files.
pub(crate) fn other_methods() -> Vec<String> {
    let others = descriptors().into_iter().filter(|(service, _)| service != SERVICE);
    others.map(|(service, name)| format!("/{service}/{name}")).collect()
}

#[test]
fn the_lists_have_every_operation_and_method() {
    // As many as the contract has: 59 operations, 27 of them also as HEAD.
    let (operations, heads) = (operations(), |operation: &&Operation| operation.method == Method::HEAD);
    let count = operations.iter().filter(heads).count();
    assert_eq!((operations.len() - count, count), (59, 27));
    assert_eq!(methods().len(), WRITES.len() + ADMIN.len() + READS.len());
}
