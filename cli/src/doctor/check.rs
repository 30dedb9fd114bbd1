//! Results: what a probe found, and the line that becomes of it.

use serde::Serialize;

use super::limits::MAX_NAMED;

/// How a check ended, from harmless to grave.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Outcome {
    /// Not examined.
    Skipped,
    /// In order.
    Ok,
    /// It works, and should be changed.
    Warn,
    /// It does not work.
    Fail,
}

impl Outcome {
    /// The word in JSON.
    pub(super) fn as_str(self) -> &'static str {
        match self {
            Self::Skipped => "skipped",
            Self::Ok => "ok",
            Self::Warn => "warn",
            Self::Fail => "fail",
        }
    }
}

/// One thing that a probe found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Finding {
    pub(super) result: Outcome,
    pub(super) detail: String,
    pub(super) remedy: String,
}

impl Finding {
    fn new(result: Outcome, detail: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { result, detail: detail.into(), remedy: remedy.into() }
    }

    pub(super) fn ok(detail: impl Into<String>) -> Self {
        Self::new(Outcome::Ok, detail, "")
    }

    pub(super) fn warn(detail: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::new(Outcome::Warn, detail, remedy)
    }

    pub(super) fn fail(detail: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::new(Outcome::Fail, detail, remedy)
    }

    pub(super) fn skipped(detail: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::new(Outcome::Skipped, detail, remedy)
    }
}

/// One line of the answer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(super) struct Check {
    pub(super) check: &'static str,
    pub(super) result: Outcome,
    pub(super) detail: String,
    pub(super) remedy: String,
}

impl Check {
    /// The worst of what was found decides. Beside it stands what is wrong, or where nothing is,
    /// what was found.
    pub(super) fn of(check: &'static str, findings: &[Finding]) -> Self {
        let result = findings.iter().map(|found| found.result).max().unwrap_or(Outcome::Skipped);
        let shown = |found: &&Finding| match result {
            Outcome::Warn | Outcome::Fail => found.result >= Outcome::Warn,
            Outcome::Ok | Outcome::Skipped => true,
        };
        let mut shown: Vec<&Finding> = findings.iter().filter(shown).collect();
        shown.sort_by_key(|found| std::cmp::Reverse(found.result));
        let details: Vec<&str> = shown.iter().map(|found| found.detail.as_str()).collect();
        let needed = shown.iter().filter(|found| found.result == result || result != Outcome::Ok);
        let mut remedies: Vec<&str> = Vec::new();
        for remedy in needed.map(|found| found.remedy.as_str()).filter(|text| !text.is_empty()) {
            if !remedies.contains(&remedy) {
                remedies.push(remedy);
            }
        }
        Self { check, result, detail: details.join("; "), remedy: remedies.join("; ") }
    }
}

/// The first names of a list, and how many more there are.
pub(super) fn named(names: &[String]) -> String {
    let shown = names.iter().take(MAX_NAMED).cloned().collect::<Vec<_>>().join(", ");
    match names.len().saturating_sub(MAX_NAMED) {
        0 => shown,
        more => format!("{shown} and {more} more"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worst_finding_decides_and_stands_first() {
        let findings = [
            Finding::ok("a is there"),
            Finding::warn("b is low", "raise b"),
            Finding::fail("c is gone", "start c"),
            Finding::fail("d is gone", "start c"),
        ];
        let check = Check::of("brokers", &findings);
        assert_eq!(check.result, Outcome::Fail);
        assert_eq!(check.detail, "c is gone; d is gone; b is low");
        assert_eq!(check.remedy, "start c; raise b");
        let fine = Check::of("brokers", &[Finding::ok("a"), Finding::skipped("b", "set b")]);
        assert_eq!((fine.result, fine.detail.as_str()), (Outcome::Ok, "a; b"));
        assert_eq!(fine.remedy, "");
        assert_eq!(Check::of("x", &[]).result, Outcome::Skipped);
    }

    #[test]
    fn the_words_of_json() {
        let check = Check::of("mtu", &[Finding::skipped("no peers", "name one")]);
        let json = serde_json::to_string(&check).unwrap();
        assert_eq!(
            json,
            r#"{"check":"mtu","result":"skipped","detail":"no peers","remedy":"name one"}"#
        );
    }

    #[test]
    fn long_lists_are_counted() {
        let names: Vec<String> = (0..7).map(|number| format!("n{number}")).collect();
        assert_eq!(named(&names), "n0, n1, n2, n3, n4 and 2 more");
        assert_eq!(named(&names[..1]), "n0");
    }
}
