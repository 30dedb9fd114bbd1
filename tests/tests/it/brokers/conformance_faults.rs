//! The conformance suite finds adapters that break its rules: a good adapter with one fault each.

use std::sync::Arc;
use std::time::Instant;

use async_trait::async_trait;
use blaze_brokers::memory::{MemoryBroker, MemoryHub};
use blaze_brokers::{
    Broker, BrokerError, BrokerKind, BrokerStatus, Later, PublishOutcome, Publisher, PublisherOptions,
    SubscribeOptions, Subscription,
};
use blaze_conformance::broker::{self, Capabilities, Fixture};
use blaze_domain::names::ChannelName;
use blaze_proto::Frame;
use bytes::Bytes;
use parking_lot::Mutex;
use tokio::sync::watch;

#[derive(Debug, Clone, Copy, PartialEq)]
enum Fault {
    /// Delivers every tenth message twice.
    Repeats,
    /// Swaps every tenth message with the next.
    Swaps,
    /// Loses the last byte of large payloads.
    Truncates,
    /// Loses hops and age.
    ForgetsAge,
    /// Says that everything was taken.
    AlwaysTaken,
    /// Puts a prefix before what is bare.
    MarksBare,
    /// Delivers what was published while the server was away, after it is back, behind newer messages.
    DeliversLate,
    /// Keeps all that is published while the server is away.
    HoardsWhileAway,
    /// All channels are one.
    MixesChannels,
    /// Keeps nothing for late joiners.
    KeepsNothing,
}

struct Faulty {
    hub: MemoryHub,
    fault: Fault,
}

struct FaultyBroker(MemoryBroker, Fault);

struct FaultyPublisher {
    inner: Arc<dyn Publisher>,
    fault: Fault,
    held: Mutex<Vec<Frame>>,
}

impl Publisher for FaultyPublisher {
    fn publish(&self, frame: &Frame, deadline: Option<Instant>) -> PublishOutcome {
        let mut held = self.held.lock();
        match self.fault {
            Fault::Repeats if frame.sequence() % 10 == 3 => {
                self.inner.publish(frame, deadline);
            }
            Fault::Swaps if frame.sequence() % 10 == 3 => {
                held.push(frame.clone());
                return PublishOutcome::Taken;
            }
            Fault::Truncates if frame.payload().len() > 1_000_000 => {
                let payload = frame.payload().slice(..frame.payload().len() - 1);
                return self
                    .inner
                    .publish(&Frame::from_parts(frame.head_to_write(), payload).unwrap(), deadline);
            }
            Fault::ForgetsAge => return self.inner.publish(&frame.clone().with_hops_and_age(0, 0), deadline),
            _ => {}
        }
        let outcome = self.inner.publish(frame, deadline);
        if outcome == PublishOutcome::Dropped {
            match self.fault {
                Fault::HoardsWhileAway => held.push(frame.clone()),
                Fault::DeliversLate if held.is_empty() => held.push(frame.clone()),
                Fault::AlwaysTaken => return PublishOutcome::Taken,
                _ => {}
            }
        } else if self.fault != Fault::HoardsWhileAway {
            for late in held.drain(..) {
                self.inner.publish(&late, deadline);
            }
        }
        outcome
    }

    fn publish_bare(&self, payload: &Bytes, deadline: Option<Instant>) -> PublishOutcome {
        if self.fault == Fault::MarksBare {
            return self
                .inner
                .publish_bare(&Bytes::from([b"bare:", &payload[..]].concat()), deadline);
        }
        match self.inner.publish_bare(payload, deadline) {
            PublishOutcome::TooLarge if self.fault == Fault::AlwaysTaken => PublishOutcome::Taken,
            outcome => outcome,
        }
    }

    fn later(&self) -> Later {
        self.inner.later()
    }
}

#[async_trait]
impl Broker for FaultyBroker {
    fn kind(&self) -> BrokerKind {
        self.0.kind()
    }

    fn status(&self) -> watch::Receiver<BrokerStatus> {
        self.0.status()
    }

    fn publisher(&self, channel: &ChannelName, options: PublisherOptions) -> Result<Arc<dyn Publisher>, BrokerError> {
        let options = match self.1 {
            Fault::KeepsNothing => PublisherOptions::default(),
            _ => options,
        };
        Ok(Arc::new(FaultyPublisher {
            inner: self.0.publisher(&self.channel(channel), options)?,
            fault: self.1,
            held: Mutex::default(),
        }))
    }

    async fn subscribe(&self, channel: &ChannelName, options: SubscribeOptions) -> Result<Subscription, BrokerError> {
        self.0.subscribe(&self.channel(channel), options).await
    }

    async fn close(&self) {
        self.0.close().await;
    }
}

impl FaultyBroker {
    fn channel(&self, channel: &ChannelName) -> ChannelName {
        match self.1 {
            Fault::MixesChannels => "one".parse().unwrap(),
            _ => channel.clone(),
        }
    }
}

#[async_trait]
impl Fixture for Faulty {
    fn capabilities(&self) -> Capabilities {
        Capabilities {
            queue_bytes: 1_000_000,
            channels: 10,
            ..Capabilities::default()
        }
    }

    async fn broker(&self) -> Result<Arc<dyn Broker>, String> {
        Ok(Arc::new(FaultyBroker(self.hub.broker(), self.fault)))
    }

    async fn stop_server(&self) -> Result<(), String> {
        self.hub.cut();
        Ok(())
    }

    async fn start_server(&self) -> Result<(), String> {
        self.hub.restore();
        Ok(())
    }
}

macro_rules! finds {
    ($($name:ident: $fault:ident breaks $rule:ident, $text:literal;)+) => { $(
        #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
        async fn $name() {
            let fixture = Faulty { hub: MemoryHub::new("faulty"), fault: Fault::$fault };
            let found = broker::$rule(&fixture).await.unwrap_err();
            assert!(found.contains($text), "{found}");
        }
    )+ };
}

finds! {
    repeats: Repeats breaks order_per_writer, "came 3";
    swaps: Swaps breaks order_per_writer, "came 4";
    truncation: Truncates breaks framed_payloads_arrive_as_they_are, "a payload of 1048576 bytes";
    lost_age: ForgetsAge breaks framed_payloads_arrive_as_they_are, "hops 0";
    marked_bare: MarksBare breaks bare_payloads_arrive_as_they_are, "other bytes";
    marked_json: MarksBare breaks reserved_channels_carry_json_as_it_is, "JSON on blaze/flow/control";
    malformed_as_bare: MarksBare breaks malformed_frames_are_reported, "was taken as a bare payload";
    too_large: AlwaysTaken breaks too_large_is_refused, "was Taken";
    taken_after_close: AlwaysTaken breaks close_delivers_and_ends, "on a closed client was Taken";
    late_delivery: DeliversLate breaks server_away_and_back, "reordered or delivered twice";
    hoarding: HoardsWhileAway breaks publishing_never_waits, "bytes wait for the server";
    mixed_channels: MixesChannels breaks many_channels_stay_apart, "not its own";
    nothing_kept: KeepsNothing breaks late_joiners_get_what_is_kept, "3, 4, 5, 6 were expected";
}
