//! Names of ROS 2, of DDS, and of topics.
//!
//! | ROS 2 | DDS topic | topic, without `namespace` |
//! |---|---|---|
//! | topic `/imu/data` | `rt/imu/data` | `imu/data` |
//! | request of `/add` | `rq/addRequest` | `add/_request` |
//! | reply of `/add` | `rr/addReply` | `add/_reply` |
//! | `sensor_msgs/msg/Imu` | `sensor_msgs::msg::dds_::Imu_` | |

use std::fmt;

use blaze_domain::TopicName;
use blaze_domain::names::NameError;

/// Last segment of the topic of a service's requests, and of its replies.
const REQUEST: &str = "_request";
const REPLY: &str = "_reply";

/// What a DDS topic of ROS 2 carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Carries {
    /// Messages of a topic.
    Messages,
    /// Requests of a service.
    Requests,
    /// Replies of a service.
    Replies,
}

/// A name of ROS 2, without its first slash, and what of it a DDS topic carries.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct RosName {
    /// The name of the topic or service, without its first slash.
    pub name: String,
    /// What of it.
    pub carries: Carries,
}

/// Why a topic and a name of ROS 2 cannot stand for one another.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InexpressibleName {
    /// It is no topic of BlazeAIoT.
    #[error("{name:?} cannot be a topic: it {error}")]
    Topic {
        /// The name.
        name: String,
        /// Which rule it breaks.
        error: NameError,
    },
    /// Services have these segments for themselves.
    #[error("{0:?} cannot be a topic: no segment but that of a service is _request or _reply")]
    Service(String),
    /// It is no name of ROS 2.
    #[error("{name:?} cannot be a name of ROS 2: {rule}")]
    Ros {
        /// The name.
        name: String,
        /// Which rule it breaks.
        rule: &'static str,
    },
    /// It lies outside of the namespace of this network.
    #[error("{name:?} is not below the namespace {namespace:?} of this ROS 2 network")]
    Namespace {
        /// The name.
        name: String,
        /// What it would have to begin with.
        namespace: String,
    },
}

impl RosName {
    /// The name behind a DDS topic; `None` where ROS 2 has not made it.
    #[must_use]
    pub fn of_dds(topic: &str) -> Option<Self> {
        let (prefix, rest) = topic.split_once('/')?;
        let (name, carries) = match prefix {
            "rt" => (rest, Carries::Messages),
            "rq" => (rest.strip_suffix("Request")?, Carries::Requests),
            "rr" => (rest.strip_suffix("Reply")?, Carries::Replies),
            _ => return None,
        };
        (!name.is_empty()).then(|| Self { name: name.to_owned(), carries })
    }

    /// The DDS topic.
    #[must_use]
    pub fn to_dds(&self) -> String {
        match self.carries {
            Carries::Messages => format!("rt/{}", self.name),
            Carries::Requests => format!("rq/{}Request", self.name),
            Carries::Replies => format!("rr/{}Reply", self.name),
        }
    }

    /// The topic, where the network has a namespace or `""`.
    ///
    /// # Errors
    /// [`InexpressibleName`] where no topic may have that name.
    pub fn to_topic(&self, namespace: &str) -> Result<TopicName, InexpressibleName> {
        if self.name.split('/').any(|segment| segment == REQUEST || segment == REPLY) {
            return Err(InexpressibleName::Service(self.name.clone()));
        }
        let mut text = self.name.clone();
        if !namespace.is_empty() {
            text = format!("{namespace}/{text}");
        }
        match self.carries {
            Carries::Messages => {}
            Carries::Requests => text = format!("{text}/{REQUEST}"),
            Carries::Replies => text = format!("{text}/{REPLY}"),
        }
        text.parse().map_err(|error| InexpressibleName::Topic { name: text, error })
    }

    /// The name of a topic.
    ///
    /// # Errors
    /// [`InexpressibleName`] where ROS 2 can have no such name.
    pub fn of_topic(topic: &TopicName, namespace: &str) -> Result<Self, InexpressibleName> {
        let text = topic.as_str();
        let within = match namespace {
            "" => Some(text),
            _ => text.strip_prefix(namespace).and_then(|rest| rest.strip_prefix('/')),
        };
        let Some(within) = within else {
            return Err(InexpressibleName::Namespace {
                name: text.to_owned(),
                namespace: namespace.to_owned(),
            });
        };
        let (name, carries) = match within.rsplit_once('/') {
            Some((name, REQUEST)) => (name, Carries::Requests),
            Some((name, REPLY)) => (name, Carries::Replies),
            _ => (within, Carries::Messages),
        };
        match broken_rule(name) {
            Some(rule) => Err(InexpressibleName::Ros { name: name.to_owned(), rule }),
            None => Ok(Self { name: name.to_owned(), carries }),
        }
    }
}

impl fmt::Display for RosName {
    /// As ROS 2 writes it, with its first slash.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "/{}", self.name)
    }
}

/// Which rule of ROS 2 for names of topics and services is broken.
fn broken_rule(name: &str) -> Option<&'static str> {
    let mut segments = name.split('/');
    if name.contains(|c: char| !(c.is_ascii_alphanumeric() || c == '_' || c == '/')) {
        return Some("only letters, digits and _ are allowed between slashes");
    }
    if name.contains("__") {
        return Some("__ is not allowed");
    }
    if segments
        .any(|segment| segment.is_empty() || segment.starts_with(|c: char| c.is_ascii_digit()))
    {
        return Some("no segment may be empty or begin with a digit");
    }
    None
}

/// `sensor_msgs/msg/Imu` of `sensor_msgs::msg::dds_::Imu_`; `None` where ROS 2 has not made it.
#[must_use]
pub fn type_of_dds(dds: &str) -> Option<String> {
    let mut parts = dds.split("::");
    let (package, kind, marker, name) =
        (parts.next()?, parts.next()?, parts.next()?, parts.next()?);
    let name = name.strip_suffix('_')?;
    let is_word = |text: &str| {
        !text.is_empty() && text.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
    };
    (parts.next().is_none()
        && marker == "dds_"
        && matches!(kind, "msg" | "srv" | "action")
        && is_word(package)
        && is_word(name))
    .then(|| format!("{package}/{kind}/{name}"))
}

/// `sensor_msgs::msg::dds_::Imu_` of `sensor_msgs/msg/Imu`; `None` where it is no such name.
#[must_use]
pub fn type_to_dds(ros: &str) -> Option<String> {
    let (package, rest) = ros.split_once('/')?;
    let (kind, name) = rest.split_once('/')?;
    let dds = format!("{package}::{kind}::dds_::{name}_");
    type_of_dds(&dds).is_some_and(|back| back == ros).then_some(dds)
}

/// What stays on the network unless `system` is set: logs, events of parameters, and each node's
/// services for parameters and types.
#[must_use]
pub fn is_system(name: &RosName) -> bool {
    const SERVICES: [&str; 7] = [
        "describe_parameters",
        "get_parameter_types",
        "get_parameters",
        "list_parameters",
        "set_parameters",
        "set_parameters_atomically",
        "get_type_description",
    ];
    match name.carries {
        Carries::Messages => matches!(&*name.name, "rosout" | "parameter_events"),
        Carries::Requests | Carries::Replies => {
            let last = name.name.rsplit('/').next().unwrap_or_default();
            name.name.contains('/') && SERVICES.contains(&last)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn topic_of(dds: &str, namespace: &str) -> Result<String, String> {
        let name = RosName::of_dds(dds).ok_or("not of ROS 2")?;
        name.to_topic(namespace).map(|topic| topic.to_string()).map_err(|error| error.to_string())
    }

    #[test]
    fn names_go_both_ways() {
        for (dds, namespace, topic) in [
            ("rt/imu/data", "", "imu/data"),
            ("rt/chatter", "fleet/r7", "fleet/r7/chatter"),
            ("rq/add_two_intsRequest", "", "add_two_ints/_request"),
            ("rr/arm/add_two_intsReply", "a", "a/arm/add_two_ints/_reply"),
            ("rq/fib/_action/send_goalRequest", "", "fib/_action/send_goal/_request"),
            ("rt/fib/_action/feedback", "", "fib/_action/feedback"),
        ] {
            assert_eq!(topic_of(dds, namespace).as_deref(), Ok(topic));
            let name = RosName::of_topic(&topic.parse().unwrap(), namespace).unwrap();
            assert_eq!(name.to_dds(), dds);
        }
    }

    #[test]
    fn what_is_no_topic_of_ros_2_is_left() {
        for other in ["ros_discovery_info", "rt/", "rt", "rq/addRequests", "rr/addRequest", "xt/a"]
        {
            assert_eq!(RosName::of_dds(other), None, "{other}");
        }
    }

    #[test]
    fn names_that_the_other_side_cannot_have_say_why() {
        let refused = |topic: &str, namespace: &str| {
            RosName::of_topic(&topic.parse().unwrap(), namespace).unwrap_err().to_string()
        };
        assert!(refused("arm-1/state", "").contains("only letters, digits and _"));
        assert!(refused("arm/2nd", "").contains("begin with a digit"));
        assert!(refused("a__b", "").contains("__ is not allowed"));
        assert!(refused("chatter", "fleet").contains("not below the namespace \"fleet\""));
        assert!(refused("fleets/chatter", "fleet").contains("not below the namespace"));
        let long = format!("rt/{}", "x".repeat(300));
        assert!(topic_of(&long, "").unwrap_err().contains("at most 200"));
        assert!(topic_of("rt/blaze/flow/control", "").unwrap_err().contains("reserved"));
        assert!(topic_of("rt/add/_request", "").unwrap_err().contains("_request"));
        assert!(topic_of("rt/a b", "").unwrap_err().contains("' '"));
    }

    #[test]
    fn types_go_both_ways() {
        for (dds, ros) in [
            ("sensor_msgs::msg::dds_::Imu_", "sensor_msgs/msg/Imu"),
            ("test_msgs::srv::dds_::BasicTypes_Request_", "test_msgs/srv/BasicTypes_Request"),
            ("a::action::dds_::Fib_SendGoal_Response_", "a/action/Fib_SendGoal_Response"),
        ] {
            assert_eq!(type_of_dds(dds).as_deref(), Some(ros));
            assert_eq!(type_to_dds(ros).as_deref(), Some(dds));
        }
        for other in ["blaze::v1::Frame", "a::msg::dds_::B", "a::msg::B_", "::msg::dds_::B_", "Imu"]
        {
            assert_eq!(type_of_dds(other), None, "{other}");
        }
        for other in ["Imu", "a/msg", "a/msg/B/C", "a/idl/B", "a/msg/", "a b/msg/C"] {
            assert_eq!(type_to_dds(other), None, "{other}");
        }
    }

    #[test]
    fn what_each_node_has_stays_here() {
        let system = |dds: &str| is_system(&RosName::of_dds(dds).unwrap());
        for dds in [
            "rt/rosout",
            "rt/parameter_events",
            "rq/talker/get_parametersRequest",
            "rr/arm/talker/get_type_descriptionReply",
        ] {
            assert!(system(dds), "{dds}");
        }
        for dds in ["rt/chatter", "rt/a/rosout", "rq/get_parametersRequest", "rq/a/addRequest"] {
            assert!(!system(dds), "{dds}");
        }
    }
}
