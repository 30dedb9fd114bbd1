//! What the operator of a node says about topics in its node file.

use blaze_domain::{Priority, TopicName};

/// Rules of the node file in their order; the first whose pattern matches a topic holds for it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PlanRules {
    /// The rules.
    pub topics: Vec<TopicRule>,
}

/// One rule of `flow.topics`.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TopicRule {
    /// Segments joined by `/`; `*` is one segment, `**` any number of them, none included.
    pub pattern: String,
    /// Class on the inter scope, whatever is advertised or asked for.
    pub priority: Option<Priority>,
    /// No lane is faster, in messages per second.
    pub max_rate_hz: Option<f64>,
    /// No lane's lifespan is longer, in milliseconds; 0 = no bound.
    pub lifespan_ms: u32,
}

impl PlanRules {
    /// The rule that holds for a topic.
    #[must_use]
    pub fn find(&self, topic: &TopicName) -> Option<&TopicRule> {
        self.topics.iter().find(|rule| rule.matches(topic))
    }
}

impl TopicRule {
    /// Whether the pattern matches the whole topic. Takes at most pattern segments times topic segments steps.
    #[must_use]
    pub fn matches(&self, topic: &TopicName) -> bool {
        let topic: Vec<&str> = topic.as_str().split('/').collect();
        // reached[i]: the pattern so far matches the first i segments of the topic.
        let mut reached = vec![false; topic.len() + 1];
        reached[0] = true;
        for part in self.pattern.split('/') {
            let mut next = vec![false; topic.len() + 1];
            for i in 0..=topic.len() {
                next[i] = match part {
                    "**" => reached[i] || (i > 0 && next[i - 1]),
                    "*" => i > 0 && reached[i - 1],
                    word => i > 0 && reached[i - 1] && topic[i - 1] == word,
                };
            }
            reached = next;
        }
        reached[topic.len()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_match_whole_topics() {
        for (pattern, topic, expected) in [
            ("imu/data", "imu/data", true),
            ("imu/data", "imu/data/raw", false),
            ("imu/*", "imu/data", true),
            ("imu/*", "imu", false),
            ("*/data", "imu/data", true),
            ("camera/**", "camera/image/raw", true),
            ("camera/**", "camera", true),
            ("camera/**", "cameras/raw", false),
            ("**", "a/b/c", true),
            ("**/raw", "a/b/raw", true),
            ("**/raw", "raw", true),
            ("a/**/z", "a/z", true),
            ("a/**/z", "a/b/c/y", false),
            ("", "a", false),
        ] {
            let rule = TopicRule {
                pattern: pattern.to_owned(),
                ..TopicRule::default()
            };
            assert_eq!(rule.matches(&topic.parse().unwrap()), expected, "{pattern} {topic}");
        }
    }

    #[test]
    fn a_hostile_pattern_ends_soon() {
        let rule = TopicRule {
            pattern: "**/".repeat(500) + "x",
            ..TopicRule::default()
        };
        assert!(!rule.matches(&"a/".repeat(99).trim_end_matches('/').parse().unwrap()));
    }
}
