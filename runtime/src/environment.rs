//! The environment of the process. Nothing else in the workspace reads it.

use std::fmt::Display;
use std::str::FromStr;
use std::sync::Arc;

use crate::config::{LocatedFault, ValueOrigin};

/// A variable; `None` if it is absent, empty or not UTF-8.
#[must_use]
#[allow(clippy::disallowed_methods, reason = "the one place that reads the environment")]
pub fn variable(name: &str) -> Option<String> {
    std::env::var(name).ok().filter(|value| !value.is_empty())
}

/// A variable that has a form of its own; `None` if it is absent or empty.
///
/// # Errors
/// What is wrong with it, to be told with the faults of the configuration.
pub fn parsed<T: FromStr<Err: Display>>(name: &str) -> Result<Option<T>, LocatedFault> {
    let fault = |error: T::Err| LocatedFault {
        place: ValueOrigin::Environment(Arc::from(name)),
        path: String::new(),
        detail: error.to_string(),
    };
    variable(name).map(|text| text.parse().map_err(fault)).transpose()
}

/// All variables whose name starts with `prefix`, by name. Those that are not UTF-8 are left out.
#[must_use]
#[allow(clippy::disallowed_methods, reason = "the one place that reads the environment")]
pub fn variables(prefix: &str) -> Vec<(String, String)> {
    // `vars` would panic at the first one that is not UTF-8.
    let text = |(name, value): (std::ffi::OsString, std::ffi::OsString)| {
        Some((name.into_string().ok()?, value.into_string().ok()?))
    };
    let mut found: Vec<_> =
        std::env::vars_os().filter_map(text).filter(|(name, _)| name.starts_with(prefix)).collect();
    found.sort();
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variables_are_found_by_prefix() {
        // Every process that a test runner starts has it.
        let path = variable("PATH").unwrap();
        let found = variables("PAT");
        assert!(found.contains(&("PATH".to_owned(), path)));
        assert!(found.iter().all(|(name, _)| name.starts_with("PAT")));
        assert_eq!(variable("BLAZE_NO_SUCH_VARIABLE"), None);
        assert_eq!(parsed::<u16>("BLAZE_NO_SUCH_VARIABLE"), Ok(None));
        let fault = parsed::<u16>("PATH").unwrap_err().to_string();
        assert_eq!(fault, "environment PATH: invalid digit found in string");
    }
}
