//! Closed sets that describe how a topic is carried.

/// An enum of words: its variants, each with the word that stands for it on the wire and in files.
/// The crate that makes one needs `serde`.
#[macro_export]
macro_rules! word_enum {
    ($(#[$doc:meta])* $type:ident { $($(#[$variant_doc:meta])* $variant:ident = $text:literal),+ $(,)? }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, ::serde::Serialize,
            ::serde::Deserialize)]
        pub enum $type {
            $($(#[$variant_doc])* #[serde(rename = $text)] $variant,)+
        }

        impl $type {
            /// All values, in the order of their declaration.
            pub const ALL: &'static [Self] = &[$(Self::$variant),+];

            /// The word on the wire and in files.
            #[must_use]
            pub fn as_str(self) -> &'static str {
                match self { $(Self::$variant => $text),+ }
            }
        }

        impl ::std::fmt::Display for $type {
            fn fmt(&self, f: &mut ::std::fmt::Formatter<'_>) -> ::std::fmt::Result {
                f.write_str(self.as_str())
            }
        }

        impl ::std::str::FromStr for $type {
            type Err = $crate::qos::UnknownWord;
            fn from_str(text: &str) -> Result<Self, $crate::qos::UnknownWord> {
                Self::ALL.iter().copied().find(|value| value.as_str() == text)
                    .ok_or_else(|| $crate::qos::UnknownWord {
                    found: text.to_owned(),
                    allowed: Self::ALL.iter().map(|value| value.as_str()).collect::<Vec<_>>()
                        .join(", "),
                })
            }
        }
    };
}
pub(crate) use crate::word_enum;

/// A word is not of its closed set.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{found:?} is not one of {allowed}")]
pub struct UnknownWord {
    /// What was given.
    pub found: String,
    /// The whole set, joined by commas.
    pub allowed: String,
}

word_enum!(
    /// What kind of cluster a layer is.
    LayerKind {
        /// Robots and the machines beside them.
        Edge = "edge",
        /// Servers on the premises.
        Fog = "fog",
        /// Servers elsewhere.
        Cloud = "cloud",
    }
);

word_enum!(
    /// How far a broker reaches, seen from one flow.
    Scope {
        /// Services of one node.
        Node = "node",
        /// Services and flows of one layer.
        Layer = "layer",
        /// Nodes of one ROS 2 network.
        Ros2 = "ros2",
        /// Flows of all layers.
        Inter = "inter",
    }
);

impl Scope {
    /// Those that services or ROS 2 nodes are on; a flow has at most one broker of each.
    pub const LOCAL: [Self; 3] = [Self::Node, Self::Layer, Self::Ros2];
}

word_enum!(
    /// Class of a topic on the inter scope; the smaller value goes first (`Control < State <
    /// Bulk`).
    Priority {
        /// Commands: before everything else.
        Control = "control",
        /// Sensor and state messages.
        State = "state",
        /// Images and other large messages.
        Bulk = "bulk",
    }
);

word_enum!(
    /// Whether lost messages are sent again.
    Reliability {
        /// At most once; losses are counted.
        BestEffort = "best_effort",
        /// Repaired within the lifespan.
        Reliable = "reliable",
    }
);

word_enum!(
    /// Whether late joiners get messages that were published before they came.
    Durability {
        /// They do not.
        Volatile = "volatile",
        /// They get the last `depth` of every live writer.
        TransientLocal = "transient_local",
    }
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_survive_their_text() {
        for priority in Priority::ALL {
            assert_eq!(priority.as_str().parse::<Priority>().unwrap(), *priority);
        }
        let error = "urgent".parse::<Priority>().unwrap_err();
        assert_eq!(error.to_string(), "\"urgent\" is not one of control, state, bulk");
        assert!(Priority::Control < Priority::Bulk);
    }
}
