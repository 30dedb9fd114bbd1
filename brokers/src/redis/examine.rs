//! How a server is set up, asked once over a connection of its own.

use std::time::Duration;

use blaze_domain::node_file::RedisBroker as Section;
use redis::AsyncConnectionConfig;

use super::server::{self, BufferLimits, Complaint};
use super::settings::Settings;

/// For the connection, and for each of the two answers.
const TIMEOUT: Duration = Duration::from_secs(3);

/// How a server is set up.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RedisReport {
    /// Program and version, such as `redis 7.0.15`.
    pub version: String,
    /// Settings with which something gets lost.
    pub complaints: Vec<Complaint>,
    /// Whether the access list lets the client see the limits of output buffers.
    pub tells_buffers: bool,
}

/// Connects, asks for the settings that decide whether something gets lost, and disconnects.
///
/// # Errors
/// In words, without credentials: a setting that can never work, or a server that does not answer
/// within three seconds a question.
pub async fn examine(section: &Section) -> Result<RedisReport, String> {
    let client = Settings::read(section)
        .and_then(|settings| settings.client())
        .map_err(|error| error.to_string())?;
    let config = AsyncConnectionConfig::new()
        .set_connection_timeout(Some(TIMEOUT))
        .set_response_timeout(Some(TIMEOUT));
    let words = |error: redis::RedisError| error.to_string();
    let mut connection =
        client.get_multiplexed_async_connection_with_config(&config).await.map_err(words)?;
    let facts = server::facts(&mut connection).await.map_err(words)?;
    let limits = server::buffer_limits(&mut connection).await.map_err(words)?;
    let complaints = [facts.complaint(), limits.and_then(BufferLimits::complaint)];
    Ok(RedisReport {
        version: facts.version,
        complaints: complaints.into_iter().flatten().collect(),
        tells_buffers: limits.is_some(),
    })
}
