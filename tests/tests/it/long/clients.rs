//! What others make of the OpenAPI documents: clients in three languages, and requests by the
//! thousand.

use std::path::Path;
use std::process::Command;

use blaze_tests::process::binary;

/// Runs one of `scripts/` with the programs beside this one.
pub(super) fn script(name: &str, arguments: &[&str]) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let program = binary("blaze-config").unwrap();
    let output = Command::new(root.join("scripts").join(name))
        .args(arguments)
        .env("BLAZE_BIN_DIR", program.parent().expect("a program lies in a folder"))
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "scripts/{name}: {}\n{said}", output.status);
    println!("{said}");
}

#[test]
fn clients_are_generated_compiled_and_driven() {
    script("clients", &[]);
}

/// `scripts/test --long` sends more than 20,000 requests.
#[test]
fn every_answer_is_one_that_the_document_allows() {
    let arguments: &[&str] = if blaze_tests::long() { &["--long"] } else { &[] };
    script("schemathesis", arguments);
}
