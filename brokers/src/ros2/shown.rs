//! Topics that show on the network though nobody there has asked for them: idle writers, so that
//! `ros2 topic list` and rviz know them. Of a service's requests it is an idle reader, so that
//! `ros2 service list` and clients do.
//!
//! An idle writer goes when the topic is written in its type, after the one that is used stands. An
//! idle reader stays: requests wait in it until somebody reads them.

use std::collections::BTreeMap;

use blaze_domain::TopicName;

use super::names::{Carries, RosName};
use super::offers::{Offer, Offered};
use super::{Inner, MAX_SHOWN};
use crate::dds::adapter::TopicPublisher;
use crate::port::{PublisherOptions, Subscription};

/// What shows of a topic, or of a half of a service.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Shown {
    /// ROS type, such as `sensor_msgs/msg/Imu`.
    pub type_name: String,
    /// Lost messages are sent again.
    pub reliable: bool,
    /// Late joiners get the last messages of each writer.
    pub durable: bool,
}

struct Idle {
    topic: TopicName,
    shown: Shown,
    /// What its writer offers, if there is one.
    writer: Option<(Offered, TopicPublisher)>,
    /// Of requests.
    reader: Option<Subscription>,
}

/// All topics that are to show.
#[derive(Default)]
pub(super) struct AllShown {
    by_name: BTreeMap<RosName, Idle>,
}

impl AllShown {
    /// Lets a topic show, or no longer. Returns whether there is room for it.
    pub(super) fn set(&mut self, topic: TopicName, name: RosName, shown: Option<Shown>) -> bool {
        let Some(shown) = shown else {
            self.by_name.remove(&name);
            return true;
        };
        if self.by_name.get(&name).is_some_and(|idle| idle.shown == shown) {
            return true;
        }
        if self.by_name.len() >= MAX_SHOWN && !self.by_name.contains_key(&name) {
            return false;
        }
        self.by_name.insert(name, Idle { topic, shown, writer: None, reader: None });
        true
    }

    /// Makes the idle reader or writer of a topic, or one that offers what readers ask for now; ends
    /// the one that is not needed beside those of `offers`.
    pub(super) fn follow<'a>(
        &mut self,
        inner: &Inner,
        name: &RosName,
        mut offers: impl Iterator<Item = &'a Offer>,
    ) {
        let Some(idle) = self.by_name.get_mut(name) else { return };
        let Idle { topic, shown, writer, reader } = idle;
        if name.carries == Carries::Requests {
            if reader.is_none() {
                *reader = inner.idle_reader(name, topic, &shown.type_name);
            }
            return;
        }
        if offers.any(|offer| offer.writes(&shown.type_name)) {
            *writer = None;
            return;
        }
        let published = PublisherOptions {
            reliable: shown.reliable,
            depth: shown.durable.into(),
            ..PublisherOptions::default()
        };
        let offered = inner.offered(name, &shown.type_name, published);
        if writer.as_ref().is_some_and(|(before, _)| *before == offered) {
            return;
        }
        let made = inner.idle_writer(name, topic, &shown.type_name, offered);
        *writer = made.map(|made| (offered, made));
    }
}
