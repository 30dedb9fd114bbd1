//! How the topics of a cluster are set up, asked once with clients of its own.

use std::sync::Arc;
use std::time::Duration;

use blaze_domain::node_file::KafkaBroker as Section;

use super::admin::Admin;
use super::context::LastError;
use super::settings::Settings;

/// Largest record in bytes that adapters write, and that their topics take.
pub const LARGEST_RECORD: usize = 17_825_792;
/// Topics that are made by the adapter take at least this, those of notices among them.
const LEAST_OF_OWN: usize = 2_097_152;
/// Topics that are looked at: one answer names the settings of all.
const MAX_TOPICS: usize = 500;
/// For the list of topics.
const TIMEOUT: Duration = Duration::from_secs(3);

/// Topics below the prefix that take smaller messages than the adapter's own do, with their limit
/// in bytes: they were made by hand, or by a server that makes topics when somebody asks for them.
/// Waits for the server, so call it on a thread that may.
///
/// # Errors
/// In words: properties that can never work, or a cluster that does not answer.
pub fn narrow_topics(section: &Section) -> Result<Vec<(String, usize)>, String> {
    let settings = Settings::new(section).map_err(|error| error.to_string())?;
    let last_error = Arc::<LastError>::default();
    let words = |error: &dyn std::fmt::Display| last_error.get().unwrap_or(error.to_string());
    let admin = Admin::new(&settings, &last_error).map_err(|error| words(&error))?;
    let topics = admin.topics(&section.prefix, TIMEOUT).map_err(|error| words(&error))?;
    let asked: Vec<Arc<str>> = topics.into_iter().take(MAX_TOPICS).collect();
    if asked.is_empty() {
        return Ok(Vec::new());
    }
    let limits = admin.largest_batches(&asked).map_err(|error| words(&error))?;
    let narrow = limits.into_iter().filter(|(_, bytes)| *bytes < LEAST_OF_OWN);
    let mut narrow: Vec<_> = narrow.map(|(name, bytes)| (name.to_string(), bytes)).collect();
    narrow.sort();
    Ok(narrow)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cluster_that_is_away_is_said_so() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        drop(listener);
        let section = Section {
            bootstrap: vec![address.to_string()],
            prefix: String::new(),
            password_file: None,
            properties: Default::default(),
        };
        assert!(!narrow_topics(&section).unwrap_err().is_empty());
    }
}
