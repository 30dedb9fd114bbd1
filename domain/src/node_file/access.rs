//! `flow.access`: who may advertise and who may request which topic.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use super::TopicPattern;
use super::readers::parsed;
use super::walk::Section;
use crate::control::LeaseKind;
use crate::names::TopicName;

/// Which origins: `layer/node/service`, where `*` stands for any name and missing segments at the
/// end for any names.
///
/// ```
/// use blaze_domain::node_file::OriginPattern;
/// let pattern: OriginPattern = "edge/*/joystick".parse().unwrap();
/// assert!(pattern.matches("edge", "robot-1", "joystick"));
/// assert!(!pattern.matches("edge", "robot-1", "planner"));
/// assert!("edge".parse::<OriginPattern>().unwrap().matches("edge", "robot-1", "planner"));
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OriginPattern([Option<String>; 3]);

/// Why a text is not a pattern of origins.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum OriginPatternError {
    /// More than layer, node and service.
    #[error("has more than three segments: layer/node/service")]
    TooLong,
    /// Neither a name nor a star.
    #[error("has the segment {segment:?}, which is neither a name nor `*`")]
    Segment {
        /// The segment.
        segment: String,
    },
}

impl FromStr for OriginPattern {
    type Err = OriginPatternError;

    fn from_str(text: &str) -> Result<Self, OriginPatternError> {
        let mut parts = [None, None, None];
        for (number, segment) in text.split('/').enumerate() {
            let place = parts.get_mut(number).ok_or(OriginPatternError::TooLong)?;
            if segment == "*" {
                continue;
            }
            // Layers, nodes and services have names of one form.
            if segment.parse::<crate::names::NodeName>().is_err() {
                let segment = segment.to_owned();
                return Err(OriginPatternError::Segment { segment });
            }
            *place = Some(segment.to_owned());
        }
        Ok(Self(parts))
    }
}

impl OriginPattern {
    /// Whether an origin fits. A part that is not known is empty, and fits `*` alone.
    #[must_use]
    pub fn matches(&self, layer: &str, node: &str, service: &str) -> bool {
        let wanted = self.0.iter().zip([layer, node, service]);
        wanted.into_iter().all(|(part, name)| part.as_deref().is_none_or(|part| part == name))
    }
}

impl fmt::Display for OriginPattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [layer, node, service] = &self.0;
        let text = |part: &Option<String>| part.clone().unwrap_or_else(|| "*".to_owned());
        write!(f, "{}/{}/{}", text(layer), text(node), text(service))
    }
}

/// Who may do one thing with the topics of a rule.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct OriginRules {
    /// Only these; absent: all, empty: nobody.
    pub allow: Option<Vec<OriginPattern>>,
    /// But not these.
    pub deny: Vec<OriginPattern>,
}

impl OriginRules {
    fn section(s: &mut Section<'_>) -> Self {
        Self { allow: s.opt("allow", |node| node.list(parsed)), deny: s.list("deny", parsed) }
    }

    /// Whether an origin may.
    #[must_use]
    pub fn allows(&self, layer: &str, node: &str, service: &str) -> bool {
        let fits = |pattern: &OriginPattern| pattern.matches(layer, node, service);
        self.allow.as_ref().is_none_or(|allow| allow.iter().any(fits))
            && !self.deny.iter().any(fits)
    }
}

/// One rule: who may advertise and who may request the topics that fit its pattern.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AccessRule {
    /// `match`: which topics.
    pub pattern: TopicPattern,
    /// Who may advertise them; absent: left to the next rule that matches.
    pub advertise: Option<Arc<OriginRules>>,
    /// Who may request them; absent: left to the next rule that matches.
    pub request: Option<Arc<OriginRules>>,
}

impl AccessRule {
    fn section(s: &mut Section<'_>) -> Option<Self> {
        let pattern = s.need("match", parsed);
        let advertise = s.sub("advertise", |s| Some(OriginRules::section(s))).map(Arc::new);
        let request = s.sub("request", |s| Some(OriginRules::section(s))).map(Arc::new);
        Some(Self { pattern: pattern?, advertise, request })
    }
}

/// All rules of a node file. Without rules everybody may do everything.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct AccessRules(Vec<AccessRule>);

impl AccessRules {
    pub(super) fn read(s: &mut Section<'_>) -> Self {
        Self(s.list("access", |node| node.section(AccessRule::section).flatten()))
    }

    /// What the rules say of one topic: for each side the first matching rule that gives it.
    #[must_use]
    pub fn of(&self, topic: &TopicName) -> TopicAccess {
        let mut access = TopicAccess::default();
        for rule in self.0.iter().filter(|rule| rule.pattern.matches(topic)) {
            access.advertise = access.advertise.or_else(|| rule.advertise.clone());
            access.request = access.request.or_else(|| rule.request.clone());
        }
        access
    }
}

/// What the rules say of one topic.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct TopicAccess {
    advertise: Option<Arc<OriginRules>>,
    request: Option<Arc<OriginRules>>,
}

impl TopicAccess {
    /// Whether a rule gives that side at all; without one everybody may.
    #[must_use]
    pub fn limits(&self, kind: LeaseKind) -> bool {
        self.rules(kind).is_some()
    }

    /// Whether an origin may. A part of the origin that is not known is empty.
    #[must_use]
    pub fn allows(&self, kind: LeaseKind, layer: &str, node: &str, service: &str) -> bool {
        self.rules(kind).is_none_or(|rules| rules.allows(layer, node, service))
    }

    fn rules(&self, kind: LeaseKind) -> Option<&OriginRules> {
        match kind {
            LeaseKind::Advertise => self.advertise.as_deref(),
            LeaseKind::Request => self.request.as_deref(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(texts: &[&str]) -> Vec<OriginPattern> {
        texts.iter().map(|text| text.parse().unwrap()).collect()
    }

    fn rules(allow: &[&str], deny: &[&str]) -> OriginRules {
        OriginRules { allow: (!allow.is_empty()).then(|| read(allow)), deny: read(deny) }
    }

    fn access(of: &[(&str, Option<OriginRules>, Option<OriginRules>)]) -> AccessRules {
        let rule =
            |(pattern, advertise, request): &(&str, Option<OriginRules>, Option<OriginRules>)| {
                AccessRule {
                    pattern: pattern.parse().unwrap(),
                    advertise: advertise.clone().map(Arc::new),
                    request: request.clone().map(Arc::new),
                }
            };
        AccessRules(of.iter().map(rule).collect())
    }

    #[test]
    fn patterns_of_origins() {
        for (pattern, layer, node, service, fits) in [
            ("*", "edge", "robot-1", "slam", true),
            ("edge", "edge", "robot-1", "slam", true),
            ("edge", "fog", "robot-1", "slam", false),
            ("edge/robot-1", "edge", "robot-1", "slam", true),
            ("edge/robot-1", "edge", "robot-2", "slam", false),
            ("*/*/slam", "fog", "", "slam", true),
            ("*/*/slam", "fog", "", "", false),
            ("fog/*/slam", "fog", "", "slam", true),
        ] {
            let parsed: OriginPattern = pattern.parse().unwrap();
            assert_eq!(
                parsed.matches(layer, node, service),
                fits,
                "{pattern} {layer}/{node}/{service}"
            );
        }
        for wrong in ["", "edge/", "/edge", "a/b/c/d", "Edge", "ed*", "edge//slam"] {
            assert!(wrong.parse::<OriginPattern>().is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn without_a_rule_everybody_may() {
        let open = access(&[("cmd_vel", Some(rules(&["edge/*/joystick"], &[])), None)]);
        let other = open.of(&"imu/data".parse().unwrap());
        assert!(other.allows(LeaseKind::Advertise, "edge", "robot-1", "imu-driver"));
        let ruled = open.of(&"cmd_vel".parse().unwrap());
        assert!(ruled.allows(LeaseKind::Request, "cloud", "c", "anybody"));
        assert!(ruled.limits(LeaseKind::Advertise) && !ruled.limits(LeaseKind::Request));
        assert!(ruled.allows(LeaseKind::Advertise, "edge", "robot-1", "joystick"));
        assert!(!ruled.allows(LeaseKind::Advertise, "edge", "robot-1", "planner"));
    }

    #[test]
    fn denied_is_denied_even_if_allowed() {
        let ruled = rules(&["edge"], &["edge/robot-2"]);
        assert!(ruled.allows("edge", "robot-1", "a"));
        assert!(!ruled.allows("edge", "robot-2", "a"));
        assert!(!ruled.allows("fog", "robot-1", "a"));
        let nobody = OriginRules { allow: Some(Vec::new()), deny: Vec::new() };
        assert!(!nobody.allows("edge", "robot-1", "a"));
    }

    #[test]
    fn the_first_rule_that_gives_a_side_decides_it() {
        let ruled = access(&[
            ("cmd/**", Some(rules(&["edge"], &[])), None),
            ("**", Some(rules(&["fog"], &[])), Some(rules(&[], &["cloud"]))),
        ]);
        let of = ruled.of(&"cmd/stop".parse().unwrap());
        assert!(
            of.allows(LeaseKind::Advertise, "edge", "n", "s")
                && !of.allows(LeaseKind::Advertise, "fog", "n", "s")
        );
        assert!(
            of.allows(LeaseKind::Request, "fog", "n", "s")
                && !of.allows(LeaseKind::Request, "cloud", "n", "s")
        );
    }
}
