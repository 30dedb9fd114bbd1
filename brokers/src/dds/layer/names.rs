//! Names of DDS topics.

use std::sync::Arc;

use blaze_domain::names::ChannelName;

use crate::dds::FRAME_TYPE;
use crate::dds::adapter::Topic;
use crate::dds::participant::TimingQos;

/// Stands before user topics.
pub(super) const USER_PREFIX: &str = "bt/";
/// Tells others that a participant lives, and its time of day: JSON `{"time_ns":…,"gone":[…]}`.
pub(super) const ALIVE: &str = "blaze/layer/alive";

/// The DDS topic of a channel.
pub(super) fn topic(channel: &ChannelName) -> Topic {
    let name = if channel.is_reserved() {
        Arc::from(channel.as_str())
    } else {
        Arc::from(format!("{USER_PREFIX}{channel}"))
    };
    let user = Arc::from(channel.as_str());
    Topic { name, user, type_name: Arc::from(FRAME_TYPE), timing: TimingQos::default() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn user_topics_stand_apart_and_reserved_ones_keep_their_names() {
        let name = |text: &str| topic(&text.parse().unwrap()).name.to_string();
        assert_eq!(name("imu/data"), "bt/imu/data");
        assert_eq!(name("blaze/flow/control"), "blaze/flow/control");
        assert_eq!(name("blazing"), "bt/blazing");
    }
}
