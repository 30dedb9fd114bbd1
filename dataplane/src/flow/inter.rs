//! The inter scope of a flow: its transport, which comes and goes while the flow runs, as gateways
//! do.
//!
//! ```text
//! control core ─► want ─► thread `inter`: start, or let out, say good-bye and stop ─► News ─► control core
//! ```

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze_domain::{FlowId, Priority};
use parking_lot::{Condvar, Mutex};

use super::epochs::Epochs;
use super::plane::{News, Plane};
use super::settings::InterSettings;
use crate::link::dds::{DdsConfig, DdsStatus, DdsTransport, Wire};
use crate::link::transport::{Endpoint, SendOutcome};
use crate::link::{DownReason, LinkEvent, NameConflict};

/// Between attempts to start a transport.
const RETRY: Duration = Duration::from_secs(1);
/// How long what is queued may take to leave before the good-bye …
const DRAIN: Duration = Duration::from_millis(600);
/// How long what came over it may wait for brokers besides.
const WRITTEN: Duration = Duration::from_millis(1500);
/// … and how long the good-bye may take.
const GOODBYE: Duration = Duration::from_millis(100);
/// How often it is looked whether the transport works.
const WATCH: Duration = Duration::from_millis(100);
/// One that has not worked for this long is lost: RustDDS is built anew much faster.
const LOST: Duration = Duration::from_secs(5);
/// How often it is looked whether what is queued has left.
const LOOK: Duration = Duration::from_millis(10);

/// The inter scope of one flow, whether it is joined or not.
pub(crate) struct InterScope {
    settings: InterSettings,
    me: FlowId,
    epochs: Epochs,
    plane: Arc<Plane>,
    transport: Mutex<Option<Arc<DdsTransport>>>,
    wish: Mutex<Wish>,
    changed: Condvar,
    /// Why it could not be joined.
    trouble: Mutex<String>,
    /// It was joined before: whoever joins again has a new life there.
    was_joined: AtomicBool,
}

/// What the thread is to do.
#[derive(Debug, Default)]
struct Wish {
    joined: bool,
    stop: bool,
}

/// Whether the inter scope works, as others were told.
#[derive(Debug, Default)]
struct Health {
    works: bool,
    failing_since: Option<Instant>,
}

impl Health {
    /// What is new, if anything is.
    fn look(&mut self, now: Instant, is_ready: bool) -> Option<News> {
        if is_ready {
            self.failing_since = None;
            return (!std::mem::replace(&mut self.works, true)).then_some(News::Joined);
        }
        let since = *self.failing_since.get_or_insert(now);
        let is_lost = self.works && now.saturating_duration_since(since) >= LOST;
        if is_lost {
            self.works = false;
        }
        is_lost.then_some(News::Lost)
    }
}

impl InterScope {
    /// An inter scope that is not joined.
    pub(super) fn new(
        settings: InterSettings,
        me: FlowId,
        epochs: Epochs,
        plane: Arc<Plane>,
    ) -> Self {
        Self {
            settings,
            me,
            epochs,
            plane,
            transport: Mutex::default(),
            wish: Mutex::default(),
            changed: Condvar::new(),
            trouble: Mutex::default(),
            was_joined: AtomicBool::new(false),
        }
    }

    /// Joins it now.
    ///
    /// # Errors
    /// The configuration can never work, or there is no thread.
    pub(super) fn join(&self) -> anyhow::Result<()> {
        let epoch = if self.was_joined.swap(true, Ordering::Relaxed) {
            let epoch = self.epochs.renew();
            self.plane.begin_life(epoch);
            epoch
        } else {
            // Nothing has been on the inter scope under it.
            self.epochs.first()
        };
        let (settings, sink, epochs) =
            (&self.settings, Arc::clone(&self.plane), self.epochs.clone());
        let transport = DdsTransport::start(DdsConfig {
            domain: settings.domain,
            listen: settings.listen.into(),
            peers: settings.peers.iter().map(ToString::to_string).collect(),
            peer_slots: settings.peer_slots,
            mtu: settings.mtu.into(),
            chunking: settings.chunking,
            local: Endpoint { flow: self.me.clone(), epoch },
            next_epoch: Arc::new(move || epochs.renew()),
            sink: Arc::new(move |event| sink.transport_event(event)),
        })
        .context("brokers.inter.dds")?;
        let addresses = transport.addresses();
        self.plane.link(|engine| engine.set_addresses(addresses));
        self.trouble.lock().clear();
        *self.transport.lock() = Some(Arc::new(transport));
        self.wish.lock().joined = true;
        Ok(())
    }

    /// Wants to be on it, or not.
    pub(super) fn want(&self, joined: bool) {
        self.wish.lock().joined = joined;
        self.changed.notify_all();
    }

    /// Ends the thread; what is joined stays so.
    pub(super) fn stop(&self) {
        self.wish.lock().stop = true;
        self.changed.notify_all();
    }

    /// The thread: joins and leaves as is wanted, until it is stopped.
    pub(super) fn run(&self) {
        // Who is on it from the start counts on it.
        let mut health = Health { works: self.is_joined(), ..Health::default() };
        let mut pause = None;
        while let Some(join) = self.next(pause.take(), &mut health) {
            health = Health::default();
            if !join {
                self.leave();
                self.plane.push(News::Left);
                continue;
            }
            if let Err(error) = self.join() {
                let text = format!("{error:#}");
                if std::mem::replace(&mut *self.trouble.lock(), text.clone()) != text {
                    tracing::warn!(error = text, "cannot join the inter scope, trying on");
                }
                pause = Some(RETRY);
            }
        }
    }

    /// Waits for something to do: to join, or to leave. `None`: nothing any more. Meanwhile it is
    /// watched whether it works.
    fn next(&self, pause: Option<Duration>, health: &mut Health) -> Option<bool> {
        let mut wish = self.wish.lock();
        if let Some(pause) = pause {
            self.changed.wait_for(&mut wish, pause);
        }
        while !wish.stop && wish.joined == self.is_joined() {
            if let Some(status) = self.status() {
                let news = health.look(Instant::now(), status.ready);
                news.into_iter().for_each(|news| self.plane.push(news));
                self.changed.wait_for(&mut wish, WATCH);
            } else {
                self.changed.wait(&mut wish);
            }
        }
        (!wish.stop).then_some(wish.joined)
    }

    fn leave(&self) {
        let until = Instant::now() + DRAIN;
        while Instant::now() < until && self.plane.is_draining() {
            std::thread::sleep(LOOK);
        }
        // As for a flow that is stopped: others go on with the good-bye.
        while Instant::now() < until + WRITTEN && self.plane.has_unwritten() {
            std::thread::sleep(LOOK);
        }
        self.plane.say_goodbye();
        std::thread::sleep(GOODBYE);
        // Others may still hold it for the datagram that they send. Its end takes a while, and is
        // not to come in a thread of the transport.
        let gone = self.transport.lock().take();
        let until = Instant::now() + DRAIN;
        let is_held = || gone.as_ref().is_some_and(|gone| Arc::strong_count(gone) > 1);
        while is_held() && Instant::now() < until {
            std::thread::sleep(LOOK);
        }
        drop(gone);
        self.plane.drop_peers();
    }

    /// Whether it is joined.
    pub(crate) fn is_joined(&self) -> bool {
        self.current().is_some()
    }

    fn current(&self) -> Option<Arc<DdsTransport>> {
        self.transport.lock().clone()
    }

    /// What the transport says of itself, while there is one.
    pub(crate) fn status(&self) -> Option<DdsStatus> {
        self.current().map(|transport| transport.status())
    }

    /// Names of flows that several programs on it have.
    pub(crate) fn name_conflicts(&self) -> Vec<NameConflict> {
        self.current().map_or_else(Vec::new, |transport| transport.name_conflicts())
    }

    /// Why it could not be joined; empty if nothing is wrong.
    pub(crate) fn trouble(&self) -> String {
        self.trouble.lock().clone()
    }

    /// Makes and drops writers as peers come and go. Of a peer that is down the control writer
    /// stays: it carries Hello until the peer is forgotten, says Goodbye or begins a new life.
    pub(super) fn follow(&self, news: &News) {
        let Some(transport) = self.current() else { return };
        let event = match news {
            News::Discovered(found) => return transport.connect(found),
            News::Link(event) => event.as_ref(),
            News::Rebuilt(_) | News::Joined | News::Lost | News::Left => return,
        };
        match event {
            LinkEvent::PeerUp(endpoint) | LinkEvent::PeerAdmitted(endpoint) => {
                transport.connect(endpoint);
            }
            LinkEvent::PeerRefused { flow, peers } => {
                tracing::warn!(
                    %flow,
                    peers,
                    "no place for another flow among the peers on the inter scope",
                );
            }
            LinkEvent::PeerDown { endpoint, reason: DownReason::Silent } => {
                transport.disconnect(endpoint, &[Priority::State, Priority::Bulk]);
            }
            LinkEvent::PeerDown { endpoint, .. }
            | LinkEvent::PeerForgotten(endpoint)
            | LinkEvent::PeerRemoved(endpoint) => transport.disconnect(endpoint, Priority::ALL),
            LinkEvent::Addresses(addresses) => transport.learn_addresses(addresses),
            _ => {}
        }
    }

    /// What datagrams become on the wire.
    pub(super) fn wire(&self) -> Wire {
        self.settings.wire()
    }

    /// Sends one datagram while there is a transport; before and after it nothing is sent.
    pub(super) fn send(&self, to: &Endpoint, class: Priority, datagram: &[u8]) -> SendOutcome {
        self.current().map_or(SendOutcome::NotSent, |transport| transport.send(to, class, datagram))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_works_when_it_is_ready_and_is_lost_after_a_while() {
        let start = Instant::now();
        let mut health = Health::default();
        let mut look =
            |ms: u64, is_ready: bool| health.look(start + Duration::from_millis(ms), is_ready);
        assert!(look(0, false).is_none() && look(10_000, false).is_none());
        assert!(matches!(look(10_100, true), Some(News::Joined)));
        // Built anew.
        assert!(
            look(10_200, false).is_none()
                && look(12_000, false).is_none()
                && look(12_100, true).is_none()
        );
        assert!(look(13_000, false).is_none() && look(17_900, false).is_none());
        assert!(matches!(look(18_000, false), Some(News::Lost)));
        assert!(look(30_000, false).is_none());
        assert!(matches!(look(30_100, true), Some(News::Joined)));
    }
}
