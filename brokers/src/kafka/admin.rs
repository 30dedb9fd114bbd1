//! Makes topics.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use rdkafka::admin::{
    AdminClient, AdminOptions, AlterConfig, ConfigResource, ConfigSource, NewTopic,
    OwnedResourceSpecifier, ResourceSpecifier, TopicReplication,
};
use rdkafka::error::{KafkaError, RDKafkaErrorCode};

use super::context::{LastError, ReadContext};
use super::settings::Settings;
use super::waker::block_on;

/// How long the server has for an answer. While it takes, nobody looks whether it still lives.
const TIMEOUT: Duration = Duration::from_millis(1500);

/// What a topic is made for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Purpose {
    /// Messages that are of use for a while.
    Messages,
    /// The last value of each key.
    LastValues,
    /// The same, of few and small values: what is old goes soon, so that whoever reads all has
    /// little to read.
    Notices,
}

impl Purpose {
    fn settings(self) -> Vec<(&'static str, &'static str)> {
        let (segment, message) = match self {
            Self::Messages | Self::LastValues => ("67108864", "17825792"),
            // A segment that is written to is never compacted.
            Self::Notices => ("4194304", "2097152"),
        };
        let mut settings = vec![
            ("segment.bytes", segment),
            ("max.message.bytes", message),
            ("message.timestamp.type", "LogAppendTime"),
        ];
        settings.extend(match self {
            Self::Messages => [("retention.ms", "600000"), ("retention.bytes", "268435456")],
            Self::LastValues | Self::Notices => {
                [("cleanup.policy", "compact"), ("min.cleanable.dirty.ratio", "0.1")]
            }
        });
        settings
    }

    /// Whether its topics keep the last value of each key.
    pub(super) fn keeps(self) -> bool {
        match self {
            Self::Messages => false,
            Self::LastValues | Self::Notices => true,
        }
    }
}

/// The client that makes topics.
pub(super) struct Admin(AdminClient<ReadContext>);

impl Admin {
    pub(super) fn new(
        settings: &Settings,
        last_error: &Arc<LastError>,
    ) -> Result<Self, KafkaError> {
        let context = ReadContext::new(&Arc::default(), last_error);
        settings.admin().create_with_context(context).map(Self)
    }

    fn options() -> AdminOptions {
        AdminOptions::new().request_timeout(Some(TIMEOUT)).operation_timeout(Some(TIMEOUT))
    }

    /// Makes topics, and waits for it. Returns those that could not be made; one that is there
    /// already is none of them.
    pub(super) fn make(
        &self,
        topics: &[(Arc<str>, Purpose)],
    ) -> Result<Vec<(Arc<str>, RDKafkaErrorCode)>, KafkaError> {
        let new: Vec<NewTopic<'_>> = topics
            .iter()
            .map(|(name, purpose)| {
                // As many copies as the server makes by default.
                let topic = NewTopic::new(name, 1, TopicReplication::Fixed(-1));
                purpose
                    .settings()
                    .into_iter()
                    .fold(topic, |topic, (key, value)| topic.set(key, value))
            })
            .collect();
        let results = block_on(self.0.create_topics(&new, &Self::options()))?;
        Ok(results
            .into_iter()
            .filter_map(Result::err)
            .filter(|(_, code)| *code != RDKafkaErrorCode::TopicAlreadyExists)
            .map(|(name, code)| (Arc::from(name), code))
            .collect())
    }

    /// Topics whose names begin with the prefix, but for those of Kafka itself.
    pub(super) fn topics(
        &self,
        prefix: &str,
        within: Duration,
    ) -> Result<Vec<Arc<str>>, KafkaError> {
        let metadata = self.0.inner().fetch_metadata(None, within)?;
        let names = metadata.topics().iter().map(rdkafka::metadata::MetadataTopic::name);
        let ours = names.filter(|name| name.starts_with(prefix) && !name.starts_with("__"));
        Ok(ours.map(Arc::from).collect())
    }

    /// The largest batches that the server takes of topics, in bytes; of those that it tells.
    pub(super) fn largest_batches(
        &self,
        topics: &[Arc<str>],
    ) -> Result<HashMap<Arc<str>, usize>, KafkaError> {
        let resources: Vec<ResourceSpecifier<'_>> =
            topics.iter().map(|name| ResourceSpecifier::Topic(name)).collect();
        let found = block_on(self.0.describe_configs(&resources, &Self::options()))?;
        let limit = |config: ConfigResource| {
            let OwnedResourceSpecifier::Topic(name) = &config.specifier else {
                return None;
            };
            let bytes = config.get("max.message.bytes")?.value.as_deref()?.parse().ok()?;
            Some((Arc::from(name.as_str()), bytes))
        };
        Ok(found.into_iter().filter_map(Result::ok).filter_map(limit).collect())
    }

    /// Lets a topic that is there keep the last value of each key; its other settings stay.
    pub(super) fn keep_last_values(&self, topic: &str) -> Result<(), KafkaError> {
        let resource = ResourceSpecifier::Topic(topic);
        let found = block_on(self.0.describe_configs([&resource], &Self::options()))?;
        let Some(Ok(config)) = found.into_iter().next() else {
            return Err(KafkaError::NoMessageReceived);
        };
        let policy = config.get("cleanup.policy").and_then(|entry| entry.value.as_deref());
        if policy.is_some_and(|policy| policy.contains("compact")) {
            return Ok(());
        }
        // What is not named goes back to its default.
        let set_before = config
            .entries
            .iter()
            .filter(|entry| {
                entry.source == ConfigSource::DynamicTopic && entry.name != "cleanup.policy"
            })
            .filter_map(|entry| Some((entry.name.as_str(), entry.value.as_deref()?)));
        let change = set_before.fold(
            AlterConfig::new(resource).set("cleanup.policy", "compact"),
            |change, (key, value)| change.set(key, value),
        );
        let done = block_on(self.0.alter_configs([&change], &Self::options()))?;
        match done.into_iter().next() {
            Some(Ok(_)) => {
                tracing::info!(topic, "the topic now keeps the last values of its keys");
                Ok(())
            }
            Some(Err((_, code))) => Err(KafkaError::AdminOp(code)),
            None => Err(KafkaError::NoMessageReceived),
        }
    }
}
