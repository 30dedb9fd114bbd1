//! What the operator of a node says about topics in its node file.

use blaze_domain::TopicName;
use blaze_domain::node_file::{TopicRule, TopicValues};

/// `flow.topics` of the node file, in its order.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PlanRules {
    /// The rules.
    pub topics: Vec<TopicRule>,
}

impl PlanRules {
    /// What holds for a topic: each value is that of the first matching rule that gives it.
    #[must_use]
    pub fn find(&self, topic: &TopicName) -> TopicValues {
        TopicValues::of(&self.topics, topic)
    }
}
