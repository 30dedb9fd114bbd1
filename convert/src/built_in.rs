//! Definitions that every ROS 2 installation has, for each release.
//!
//! `definitions/` has them as text: one file for all releases, and one for each. Its
//! `ORIGIN.md` names source and licences; `scripts/ros-definitions` makes the files.

use std::fmt;
use std::str::FromStr;

use crate::pool::Pool;
use crate::text::{Kind, parse_action, parse_message, parse_service, sections};

const COMMON: &str = include_str!("../definitions/common.txt");
const HUMBLE: &str = include_str!("../definitions/humble.txt");
const JAZZY: &str = include_str!("../definitions/jazzy.txt");
const KILTED: &str = include_str!("../definitions/kilted.txt");

/// Release of ROS 2.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Distro {
    /// May 2022. It has no type hashes.
    Humble,
    /// May 2024.
    Jazzy,
    /// May 2025.
    Kilted,
}

/// The text names no release whose definitions are built in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("expected humble, jazzy or kilted")]
pub struct DistroError;

impl Distro {
    /// All releases, the oldest first.
    pub const ALL: [Self; 3] = [Self::Humble, Self::Jazzy, Self::Kilted];

    /// Its name.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Humble => "humble",
            Self::Jazzy => "jazzy",
            Self::Kilted => "kilted",
        }
    }
}

impl fmt::Display for Distro {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(self.as_str())
    }
}

impl FromStr for Distro {
    type Err = DistroError;

    fn from_str(text: &str) -> Result<Self, DistroError> {
        Self::ALL.into_iter().find(|distro| distro.as_str() == text).ok_or(DistroError)
    }
}

/// All built-in types of a release.
#[must_use]
pub fn built_in(distro: Distro) -> Pool {
    let of_release = match distro {
        Distro::Humble => HUMBLE,
        Distro::Jazzy => JAZZY,
        Distro::Kilted => KILTED,
    };
    let mut pool = Pool::default();
    for section in sections(of_release).iter().chain(&sections(COMMON)) {
        let types = match section.kind {
            _ if section.name.is_empty() => continue,
            Kind::Message => parse_message(section.name, &section.text).map(|ty| vec![ty]),
            Kind::Service => parse_service(section.name, &section.text),
            Kind::Action => parse_action(section.name, &section.text),
        };
        // A definition that does not parse is missing: a test reads them all.
        pool.add(types.unwrap_or_default());
    }
    pool
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_definition_is_read() {
        for text in [COMMON, HUMBLE, JAZZY, KILTED] {
            for section in sections(text).iter().skip(1) {
                let read = match section.kind {
                    Kind::Message => parse_message(section.name, &section.text).map(|ty| vec![ty]),
                    Kind::Service => parse_service(section.name, &section.text),
                    Kind::Action => parse_action(section.name, &section.text),
                };
                read.unwrap_or_else(|error| panic!("{}: {error}", section.name));
            }
        }
    }

    /// Humble has no service events, so whole services and actions are not described there.
    #[test]
    fn every_type_is_complete() {
        for distro in Distro::ALL {
            let types = built_in(distro);
            let incomplete = types.names().filter(|name| types.describe(name).is_err());
            let unexpected: Vec<&str> = incomplete
                .filter(|name| distro != Distro::Humble || name.contains("/msg/"))
                .collect();
            assert!(unexpected.is_empty(), "{distro}: {unexpected:?}");
        }
    }

    #[test]
    fn releases_have_their_own_types() {
        let [humble, jazzy, kilted] = Distro::ALL.map(built_in);
        for types in [&humble, &jazzy, &kilted] {
            for name in [
                "nav_msgs/msg/Odometry",
                "tf2_msgs/msg/TFMessage",
                "tf2_msgs/action/LookupTransform_FeedbackMessage",
                "std_srvs/srv/SetBool_Request",
                "rcl_interfaces/srv/SetParameters_Response",
                "composition_interfaces/srv/LoadNode_Request",
                "lifecycle_msgs/srv/ChangeState_Request",
                "rmw_dds_common/msg/ParticipantEntitiesInfo",
                "rosgraph_msgs/msg/Clock",
                "statistics_msgs/msg/MetricsMessage",
            ] {
                assert!(types.describe(name).is_ok(), "{name}");
            }
        }
        assert!(humble.get("service_msgs/msg/ServiceEventInfo").is_none());
        assert!(jazzy.get("type_description_interfaces/msg/TypeDescription").is_some());
        assert!(kilted.names().count() > 280, "{}", kilted.names().count());
    }

    #[test]
    fn names_of_releases_are_read() {
        assert_eq!("jazzy".parse(), Ok(Distro::Jazzy));
        assert_eq!("iron".parse::<Distro>(), Err(DistroError));
    }
}
