//! The table of `docs/design/traps.md` names tests that are there and run.

use std::path::Path;

const TABLE: &str = include_str!("../../../../docs/design/traps.md");

/// `file::name` in the last column of each row.
fn rows() -> Vec<(&'static str, Vec<(&'static str, &'static str)>)> {
    let rows = TABLE
        .lines()
        .filter(|line| line.starts_with("| ") && !line.starts_with("| trap |"));
    rows.map(|row| {
        let mut cells = row.trim_matches('|').split('|').map(str::trim);
        let (trap, tests) = (cells.next().unwrap(), cells.nth(1).unwrap());
        let names = tests.split(", ").map(|test| test.trim_matches('`'));
        (trap, names.map(|name| name.split_once(".rs::").unwrap()).collect())
    })
    .collect()
}

#[test]
fn every_trap_has_tests_that_run() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let rows = rows();
    assert!(rows.len() >= 15, "{} rows", rows.len());
    for (trap, tests) in rows {
        assert!(!tests.is_empty(), "{trap}");
        for (file, name) in tests {
            let file = root.join(format!("{file}.rs"));
            let code = std::fs::read_to_string(&file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
            let lines: Vec<&str> = code.lines().map(str::trim).collect();
            let at = lines.iter().position(|line| line.contains(&format!("fn {name}(")));
            let at = at.unwrap_or_else(|| panic!("{trap}: {} has no {name}", file.display()));
            let attributes: Vec<&&str> = lines[..at]
                .iter()
                .rev()
                .take_while(|line| line.starts_with("#["))
                .collect();
            assert!(
                attributes.iter().any(|line| line.contains("test")),
                "{trap}: {name} is no test"
            );
            assert!(
                !attributes.iter().any(|line| line.contains("ignore")),
                "{trap}: {name} does not run"
            );
        }
    }
}
