//! Bytes, JSON and hashes that Fast DDS, Python and ROS 2 made: `scripts/ros-oracle --samples`.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::Deserialize;
use serde_json::Value;

use super::*;
use crate::{Distro, built_in, parse_joined};

const SAMPLES: &str = include_str!("samples.json");

#[derive(Deserialize)]
struct Sample {
    #[serde(rename = "type")]
    type_name: String,
    /// Of types that are not built in.
    definition: Option<String>,
    hash: String,
    /// Padding is as Fast DDS left it.
    cdr: String,
    json: Value,
}

impl Sample {
    fn description(&self) -> TypeDescription {
        let types = built_in(Distro::Jazzy);
        match &self.definition {
            Some(text) => parse_joined(&self.type_name, text, Some(&types)).expect("a definition"),
            None => types.describe(&self.type_name).expect("it is built in"),
        }
    }
}

fn json(program: &Program, cdr: &[u8]) -> Value {
    let mut text = Vec::new();
    program.to_json(cdr, &mut text).expect("a message");
    serde_json::from_slice(&text).expect("JSON")
}

#[test]
fn others_made_the_same() {
    let samples: Vec<Sample> = serde_json::from_str(SAMPLES).expect("samples");
    assert_eq!(samples.len(), 12);
    for sample in samples {
        let name = &sample.type_name;
        let description = sample.description();
        assert_eq!(description.hash().to_string(), sample.hash, "{name}");
        let program = Program::compile(&description).expect("it can be converted");
        let cdr = STANDARD.decode(&sample.cdr).expect("base64");
        assert_eq!(json(&program, &cdr), sample.json, "{name}");
        let mut again = Vec::new();
        program.to_cdr(sample.json.to_string().as_bytes(), &mut again).expect("a message");
        assert_eq!(json(&program, &again), sample.json, "{name}");
    }
}
