//! Tasks by topic. Each runs until it is ended, or all are dropped.

use std::collections::BTreeMap;

use blaze_domain::TopicName;
use tokio::task::{AbortHandle, JoinSet};

/// Tasks by topic.
#[derive(Debug, Default)]
pub(crate) struct Tasks {
    set: JoinSet<()>,
    by_topic: BTreeMap<TopicName, AbortHandle>,
}

impl Tasks {
    /// Starts the task of a topic; one that it had ends.
    pub(crate) fn start(
        &mut self,
        topic: TopicName,
        task: impl Future<Output = ()> + Send + 'static,
    ) {
        let handle = self.set.spawn(task);
        if let Some(before) = self.by_topic.insert(topic, handle) {
            before.abort();
        }
    }

    /// Ends the task of a topic.
    pub(crate) fn end(&mut self, topic: &TopicName) {
        if let Some(handle) = self.by_topic.remove(topic) {
            handle.abort();
        }
    }

    /// Waits for one that has ended; a panic is logged.
    pub(crate) async fn ended(&mut self) {
        match self.set.join_next().await {
            Some(Err(error)) if error.is_panic() => {
                tracing::error!("a task of a topic panicked: the topic is not followed any more");
            }
            Some(_) => {}
            None => std::future::pending().await,
        }
    }
}
