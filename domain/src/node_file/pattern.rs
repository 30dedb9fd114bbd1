//! Patterns over topics: `*` stands for one segment, `**` for any number of them, also none.

use std::fmt;
use std::str::FromStr;

use crate::names::{MAX_TOPIC_BYTES, TopicName};

/// A pattern over topics, such as `camera/**`.
///
/// ```
/// use blaze_domain::node_file::TopicPattern;
/// let pattern: TopicPattern = "*/image/**".parse().unwrap();
/// assert!(pattern.matches(&"camera/image".parse().unwrap()));
/// assert!(pattern.matches(&"camera/image/left/raw".parse().unwrap()));
/// assert!(!pattern.matches(&"image/left".parse().unwrap()));
/// ```
#[derive(Clone, PartialEq, Eq, Hash)]
pub struct TopicPattern {
    text: String,
    parts: Vec<Part>,
}

#[derive(Clone, PartialEq, Eq, Hash)]
enum Part {
    Exact(String),
    One,
    Many,
}

/// Why a text is not a pattern.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PatternError {
    /// Longer than a topic can be.
    #[error("has {bytes} bytes, at most {MAX_TOPIC_BYTES} are allowed")]
    TooLong {
        /// Bytes given.
        bytes: usize,
    },
    /// No segment, or an empty one: a leading, trailing or double slash.
    #[error("has an empty segment: no leading, trailing or double slash")]
    EmptySegment,
    /// A star beside other characters.
    #[error("has a star inside {segment:?}: `*` and `**` stand for whole segments")]
    PartialStar {
        /// The segment.
        segment: String,
    },
    /// A character that no topic holds.
    #[error("holds {found:?}, which no topic does")]
    Character {
        /// The first such character.
        found: char,
    },
}

impl FromStr for TopicPattern {
    type Err = PatternError;

    fn from_str(text: &str) -> Result<Self, PatternError> {
        if text.len() > MAX_TOPIC_BYTES {
            return Err(PatternError::TooLong { bytes: text.len() });
        }
        let mut parts = Vec::new();
        for segment in text.split('/') {
            match Part::read(segment)? {
                // Two in a row say no more than one.
                Part::Many if parts.last() == Some(&Part::Many) => {}
                part => parts.push(part),
            }
        }
        Ok(Self { text: text.to_owned(), parts })
    }
}

impl Part {
    fn read(segment: &str) -> Result<Self, PatternError> {
        match segment {
            "" => Err(PatternError::EmptySegment),
            "*" => Ok(Self::One),
            "**" => Ok(Self::Many),
            _ if segment.contains('*') => {
                Err(PatternError::PartialStar { segment: segment.to_owned() })
            }
            _ => match segment
                .chars()
                .find(|c| !c.is_ascii_alphanumeric() && !matches!(c, '_' | '-'))
            {
                Some(found) => Err(PatternError::Character { found }),
                None => Ok(Self::Exact(segment.to_owned())),
            },
        }
    }

    /// Whether the part stands for this one segment.
    fn takes(&self, segment: &str) -> bool {
        match self {
            Self::Exact(text) => text == segment,
            Self::One => true,
            Self::Many => false,
        }
    }
}

impl TopicPattern {
    /// Whether the topic fits the pattern.
    #[must_use]
    pub fn matches(&self, topic: &TopicName) -> bool {
        let segments: Vec<&str> = topic.as_str().split('/').collect();
        let (mut part, mut at) = (0, 0);
        // Where to go on when the present attempt fails: behind the last `**`, one segment further
        // than before.
        let mut retry: Option<(usize, usize)> = None;
        while at < segments.len() {
            match self.parts.get(part) {
                Some(Part::Many) => {
                    part += 1;
                    retry = Some((part, at));
                }
                Some(other) if other.takes(segments[at]) => (part, at) = (part + 1, at + 1),
                _ => match retry {
                    Some((behind, from)) => {
                        retry = Some((behind, from + 1));
                        (part, at) = (behind, from + 1);
                    }
                    None => return false,
                },
            }
        }
        self.parts[part..].iter().all(|rest| *rest == Part::Many)
    }

    /// The pattern as it was written.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.text
    }

    /// The pattern that every topic fits: `**`.
    #[must_use]
    pub fn all() -> Self {
        Self { text: "**".to_owned(), parts: vec![Part::Many] }
    }
}

impl fmt::Display for TopicPattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

impl fmt::Debug for TopicPattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(&self.text, f)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn fits(pattern: &str, topic: &str) -> bool {
        pattern.parse::<TopicPattern>().unwrap().matches(&topic.parse().unwrap())
    }

    #[test]
    fn stars_stand_for_segments() {
        assert!(fits("imu/*", "imu/data") && !fits("imu/*", "imu/a/b"));
        assert!(fits("camera/**", "camera") && !fits("camera/**", "cameras/a"));
    }

    #[test]
    fn bad_patterns_are_refused() {
        for (text, error) in [
            ("", PatternError::EmptySegment),
            ("/a", PatternError::EmptySegment),
            ("a//b", PatternError::EmptySegment),
            ("a/", PatternError::EmptySegment),
            ("a/b*", PatternError::PartialStar { segment: "b*".into() }),
            ("***", PatternError::PartialStar { segment: "***".into() }),
            ("a b", PatternError::Character { found: ' ' }),
            (&"a".repeat(201), PatternError::TooLong { bytes: 201 }),
        ] {
            assert_eq!(text.parse::<TopicPattern>().unwrap_err(), error, "{text}");
        }
    }

    /// The definition, word for word; exponential, so only for short patterns.
    fn by_definition(parts: &[&str], segments: &[&str]) -> bool {
        match parts.split_first() {
            None => segments.is_empty(),
            Some((&"**", rest)) => {
                (0..=segments.len()).any(|skip| by_definition(rest, &segments[skip..]))
            }
            Some((part, rest)) => segments.split_first().is_some_and(|(segment, others)| {
                (*part == "*" || part == segment) && by_definition(rest, others)
            }),
        }
    }

    proptest! {
        #[test]
        fn agrees_with_the_definition(
            parts in prop::collection::vec(prop::sample::select(vec!["a", "b", "*", "**"]), 1..7),
            segments in prop::collection::vec(prop::sample::select(vec!["a", "b"]), 1..7),
        ) {
            prop_assert_eq!(
                fits(&parts.join("/"), &segments.join("/")),
                by_definition(&parts, &segments),
            );
        }

        #[test]
        fn no_text_panics(text in ".{0,40}") {
            let _ = text.parse::<TopicPattern>();
        }
    }

    #[test]
    fn many_stars_stay_fast() {
        let pattern = ["**/a"; 40].join("/");
        let topic = vec!["a"; 39].join("/") + "/b";
        assert!(!fits(&pattern, &topic));
    }
}
