//! The table of `docs/design/traps.md` names tests that exist and run, and the earliest tier that
//! runs one of each row.

use std::path::Path;

const TABLE: &str = include_str!("../../../../docs/design/traps.md");

struct Row {
    trap: &'static str,
    tier: &'static str,
    /// File without its ending, and name.
    tests: Vec<(&'static str, &'static str)>,
}

fn rows() -> Vec<Row> {
    let rows = TABLE.lines().filter(|line| line.starts_with("| ") && !line.starts_with("| trap |"));
    rows.map(|row| {
        let cells: Vec<&str> = row.trim_matches('|').split('|').map(str::trim).collect();
        let [trap, _, tier, tests] = cells[..] else { panic!("four cells are expected: {row}") };
        let names = tests.split(", ").map(|test| test.trim_matches('`'));
        Row { trap, tier, tests: names.map(|name| name.split_once(".rs::").unwrap()).collect() }
    })
    .collect()
}

/// The tier that the place of a test says; `before` are the lines of its file above it.
fn tier(file: &str, before: &[&str]) -> &'static str {
    let module = before
        .iter()
        .rev()
        .find(|line| **line == "}" || (line.starts_with("mod ") && line.ends_with('{')));
    let is_in = |tier: &str| {
        file.contains(&format!("/{tier}/"))
            || file.ends_with(&format!("/{tier}"))
            || module == Some(&&*format!("mod {tier} {{"))
    };
    match (is_in("long"), is_in("quick")) {
        (true, _) => "long",
        (_, true) => "quick",
        _ if file.starts_with("tests/tests/") => "default",
        _ => "quick",
    }
}

#[test]
fn every_trap_has_tests_that_run() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let rows = rows();
    assert!(rows.len() >= 15, "{} rows", rows.len());
    for Row { trap, tier: stated, tests } in rows {
        let mut tiers = Vec::new();
        for (file, name) in tests {
            let path = root.join(format!("{file}.rs"));
            let code = std::fs::read_to_string(&path)
                .unwrap_or_else(|error| panic!("{}: {error}", path.display()));
            let lines: Vec<&str> = code.lines().collect();
            let at = lines.iter().position(|line| line.contains(&format!("fn {name}(")));
            let at = at.unwrap_or_else(|| panic!("{trap}: {} has no {name}", path.display()));
            let attributes: Vec<&str> = lines[..at]
                .iter()
                .rev()
                .map(|line| line.trim())
                .take_while(|line| line.starts_with("#["))
                .collect();
            let has = |word: &str| attributes.iter().any(|line| line.contains(word));
            assert!(has("test"), "{trap}: {name} is no test");
            assert!(!has("ignore"), "{trap}: {name} does not run");
            tiers.push(tier(file, &lines[..at]));
        }
        let earliest = ["quick", "default", "long"].into_iter().find(|tier| tiers.contains(tier));
        assert_eq!(Some(stated), earliest, "the tier of: {trap}");
    }
}
