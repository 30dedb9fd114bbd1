//! Properties of every value of every built-in type.

use std::collections::BTreeMap;

use proptest::collection::vec;
use proptest::prelude::*;
use proptest::test_runner::{Config, RngAlgorithm, TestRng, TestRunner};

use super::values::{Entropy, cdr};
use super::*;
use crate::{Distro, TypeHash, built_in, parse_joined};

/// Values of each type, and of others as many for each type: 4, or 1,000 with `BLAZE_LONG`.
fn cases() -> u32 {
    if std::env::var_os("BLAZE_LONG").is_some() { 1_000 } else { 4 }
}

/// A type with kinds of fields that no built-in type has.
const OWN: &str = "wstring w\nwstring<=3 x\nwstring[2] y\nwstring<=5[<=2] z\nstring<=4 s\n\
    string<=6[] t\nbyte[3] b\nchar[] c\nint8[<=3] i\nbool[2] o\nuint64[] u\nfloat32[<=2] f\n\
    std_msgs/Empty e\nstd_msgs/Empty[<=2] m\ngeometry_msgs/Pose[2] p\nint16 n\n";

/// All types of all releases, each definition once.
pub(super) fn programs() -> Vec<(String, Program)> {
    let mut all: BTreeMap<(String, TypeHash), Program> = BTreeMap::new();
    let mut add = |description: TypeDescription| {
        let program = Program::compile(&description).expect("it can be converted");
        all.insert((description.type_description.type_name.clone(), description.hash()), program);
    };
    for distro in Distro::ALL {
        let types = built_in(distro);
        types.names().filter_map(|name| types.describe(name).ok()).for_each(&mut add);
        add(parse_joined("a/msg/Own", OWN, Some(&types)).expect("a definition"));
    }
    all.into_iter().map(|((name, _), program)| (name, program)).collect()
}

fn runner() -> TestRunner {
    let config = Config { cases: cases(), failure_persistence: None, ..Config::default() };
    TestRunner::new_with_rng(config, TestRng::deterministic_rng(RngAlgorithm::ChaCha))
}

/// Runs a test of entropy for each program.
fn for_each(test: impl Fn(&Program, &[u8]) -> Result<(), TestCaseError>) {
    for (name, program) in programs() {
        let done = runner().run(&vec(any::<u8>(), 0..3_000), |entropy| test(&program, &entropy));
        done.unwrap_or_else(|error| panic!("{name}: {error}"));
    }
}

#[test]
fn every_value_comes_back_from_json() {
    for_each(|program, entropy| {
        let bytes = cdr(program, &mut Entropy(entropy));
        let (mut text, mut again) = (Vec::new(), Vec::new());
        program
            .to_json(&bytes, &mut text)
            .map_err(|error| TestCaseError::fail(error.to_string()))?;
        serde_json::from_slice::<serde_json::Value>(&text)
            .map_err(|error| TestCaseError::fail(error.to_string()))?;
        program
            .to_cdr(&text, &mut again)
            .map_err(|error| TestCaseError::fail(error.to_string()))?;
        prop_assert_eq!(bytes, again, "{}", String::from_utf8_lossy(&text));
        Ok(())
    });
}

/// Bytes and text that are almost those of a message, or not at all.
#[test]
fn no_input_panics() {
    for_each(|program, entropy| {
        let mut bytes = cdr(program, &mut Entropy(entropy));
        let (mut text, mut out) = (Vec::new(), Vec::new());
        let _ = program.to_json(entropy, &mut out);
        let _ = program.to_cdr(entropy, &mut out);
        program
            .to_json(&bytes, &mut text)
            .map_err(|error| TestCaseError::fail(error.to_string()))?;
        for pair in entropy.as_chunks::<3>().0 {
            change(&mut bytes, *pair);
            change(&mut text, *pair);
            out.clear();
            if program.to_json(&bytes, &mut out).is_ok() {
                prop_assert!(serde_json::from_slice::<serde_json::Value>(&out).is_ok());
            }
            let _ = program.to_cdr(&text, &mut out);
            if out.len() > 10_000 {
                break;
            }
        }
        Ok(())
    });
}

/// Another byte at a place, and now and then one less.
fn change(data: &mut Vec<u8>, [high, low, value]: [u8; 3]) {
    let at = usize::from(u16::from_be_bytes([high, low])).checked_rem(data.len()).unwrap_or(0);
    match data.get_mut(at) {
        Some(_) if value == 7 => drop(data.remove(at)),
        Some(byte) => *byte = value,
        None => {}
    }
}
