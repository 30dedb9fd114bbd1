//! Converts what other programs ask for: the other side of `scripts/ros-oracle`.
//!
//! ```text
//! oracle DISTRO [FOLDER…]   folders as in `interfaces`; they come before what is built in
//! ```
//!
//! A line of the input is a type, what to do, and base64, with tabs between: `json` makes JSON of
//! CDR, `cdr` makes CDR of JSON, `hash` needs no third part. The answer is `ok` and base64 (of a
//! hash its text), or `error` and a text.

#![allow(clippy::expect_used, reason = "a test stops where it cannot go on")]

use std::collections::HashMap;
use std::io::{BufRead, BufWriter, Write};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use blaze_convert::{Definition, Definitions, Distro, Program, Source};

struct Oracle {
    built_in: Definitions,
    folders: Vec<Definitions>,
    programs: HashMap<String, Result<(Definition, Program), String>>,
}

impl Oracle {
    /// What is in the folders alone has the first word, though it would have the second in a flow.
    fn find(&self, name: &str) -> Result<(Definition, Program), String> {
        let mut warnings = Vec::new();
        let in_folders = self.folders.iter().find_map(|all| all.find(name, None, &mut warnings));
        let found = in_folders
            .filter(|found| found.source == Source::Interfaces)
            .or_else(|| self.built_in.find(name, None, &mut warnings))
            .ok_or_else(|| format!("no such type: {warnings:?}"))?;
        let program = Program::compile(&found.description).map_err(|error| error.to_string())?;
        Ok((found, program))
    }

    fn answer(&mut self, name: &str, task: &str, data: &[u8]) -> Result<String, String> {
        if !self.programs.contains_key(name) {
            let found = self.find(name);
            self.programs.insert(name.to_owned(), found);
        }
        let (definition, program) =
            self.programs.get(name).expect("it was added").as_ref().map_err(Clone::clone)?;
        let mut out = Vec::new();
        let done = match task {
            "hash" => return Ok(definition.hash.to_string()),
            "json" => program.to_json(data, &mut out),
            _ => program.to_cdr(data, &mut out),
        };
        done.map(|()| STANDARD.encode(out)).map_err(|error| error.to_string())
    }
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let distro: Distro = arguments.next().expect("a release").parse().expect("a release");
    let (built_in, _) = Definitions::new(distro, Vec::new());
    let folders = arguments.map(|folder| Definitions::new(distro, vec![folder.into()]).0).collect();
    let mut oracle = Oracle { built_in, folders, programs: HashMap::new() };
    let mut out = BufWriter::new(std::io::stdout().lock());
    for line in std::io::stdin().lock().lines() {
        let line = line.expect("a line");
        let mut parts = line.split('\t');
        let [name, task, data] = [(); 3].map(|()| parts.next().unwrap_or_default());
        let data = STANDARD.decode(data).expect("base64");
        let _ = match oracle.answer(name, task, &data) {
            Ok(answer) => writeln!(out, "ok\t{answer}"),
            Err(text) => writeln!(out, "error\t{text}"),
        };
    }
}
