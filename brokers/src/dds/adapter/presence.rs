//! Which other participants there are, and which of them are gone without having said so.
//!
//! | sign | verdict |
//! |---|---|
//! | their host says that nothing listens on their port | dead |
//! | a newer participant has their port, at each of their addresses that mean the same here (`near`) | dead |
//! | a writer's window is full, and they have been silent for 2 s (those that send signs of life) | given up |
//! | a writer's window has been full for 2 s, they read its topic and never send signs of life | given up |
//!
//! Only the first counts where no participant sends signs of life (ROS 2): implementations share one
//! port between participants there, and a slow reader is no dead one. The others end with their lease.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use super::near::Near;
use crate::dds::{FoundEndpoint, GuidPrefix};

/// Signs of life come every 500 ms.
pub(super) const SILENT: Duration = Duration::from_secs(2);
/// How long a full window stands still before those without signs of life are given up.
const STUCK: Duration = Duration::from_secs(2);
/// How long those that were given up are told so, if they come back.
const TELL: Duration = Duration::from_secs(60);
/// Participants that are followed, and that were given up.
const MAX_PEERS: usize = 1024;
const MAX_GONE: usize = 64;

/// Another participant.
#[derive(Debug)]
struct Peer {
    /// Order in which they were found.
    number: u64,
    /// Where it takes its data, as far as that means the same here.
    sockets: BTreeSet<SocketAddr>,
    /// Topics that it reads and acknowledges.
    acknowledges: BTreeSet<String>,
    last_sign: Option<Instant>,
}

/// The other participants of one domain.
#[derive(Debug)]
pub(super) struct Presence {
    near: Near,
    /// Participants of this kind send signs of life.
    have_signs: bool,
    peers: BTreeMap<GuidPrefix, Peer>,
    next: u64,
    gone: VecDeque<(GuidPrefix, Instant)>,
}

impl Presence {
    pub(super) fn new(near: Near, have_signs: bool) -> Self {
        Self { near, have_signs, peers: BTreeMap::new(), next: 0, gone: VecDeque::new() }
    }

    /// Takes over which readers there are.
    pub(super) fn set_readers(&mut self, readers: &[FoundEndpoint]) {
        let mut found: BTreeMap<GuidPrefix, (BTreeSet<SocketAddr>, BTreeSet<String>)> =
            BTreeMap::new();
        for reader in readers {
            let (sockets, topics) = found.entry(reader.participant()).or_default();
            sockets.extend(reader.sockets.iter().copied());
            if reader.is_reliable() {
                topics.insert(reader.topic.clone());
            }
        }
        self.peers.retain(|prefix, _| found.contains_key(prefix));
        for (prefix, (sockets, acknowledges)) in found {
            let sockets = self.near.select(&sockets);
            if let Some(peer) = self.peers.get_mut(&prefix) {
                peer.sockets = sockets;
                peer.acknowledges = acknowledges;
            } else if self.peers.len() < MAX_PEERS {
                self.next += 1;
                let peer = Peer { number: self.next, sockets, acknowledges, last_sign: None };
                self.peers.insert(prefix, peer);
            }
        }
    }

    /// A sign of life.
    pub(super) fn sign(&mut self, now: Instant, prefix: GuidPrefix) {
        if let Some(peer) = self.peers.get_mut(&prefix) {
            peer.last_sign = Some(now);
        }
    }

    /// This process stood still: silence says nothing.
    pub(super) fn excuse(&mut self, now: Instant) {
        for peer in self.peers.values_mut() {
            peer.last_sign = peer.last_sign.map(|_| now);
        }
    }

    pub(super) fn count(&self) -> usize {
        self.peers.len()
    }

    /// Where each certainly takes its data; one of which that is not known is left out.
    pub(super) fn sockets(&self) -> impl Iterator<Item = (GuidPrefix, SocketAddr)> {
        let near = self.near;
        self.peers
            .iter()
            .filter_map(move |(prefix, peer)| Some((*prefix, near.certain(&peer.sockets)?)))
    }

    /// Those whose port a newer one has. One that shares but some addresses with others is another
    /// host's, or has one of its own beside theirs.
    pub(super) fn superseded(&self) -> Vec<GuidPrefix> {
        if !self.have_signs {
            return Vec::new();
        }
        let mut newest: HashMap<SocketAddr, u64> = HashMap::new();
        for peer in self.peers.values() {
            for socket in &peer.sockets {
                let number = newest.entry(*socket).or_insert(peer.number);
                *number = peer.number.max(*number);
            }
        }
        let is_superseded = |peer: &Peer| {
            let mut owners = peer.sockets.iter().map(|socket| newest.get(socket));
            let Some(owner) = owners.next() else { return false };
            owner > Some(&peer.number) && owners.all(|other| other == owner)
        };
        let old = self.peers.iter().filter(|(_, peer)| is_superseded(peer));
        old.map(|(prefix, _)| *prefix).collect()
    }

    /// Those that are given up, since the windows of some topics have been full: each topic and
    /// since when.
    pub(super) fn given_up(&self, now: Instant, full: &[(&str, Instant)]) -> Vec<GuidPrefix> {
        if full.is_empty() || !self.have_signs {
            return Vec::new();
        }
        let passed = |at: Instant| now.saturating_duration_since(at);
        let is_given_up = |peer: &Peer| {
            let mut blocked = full.iter().filter(|(topic, _)| peer.acknowledges.contains(*topic));
            match peer.last_sign {
                Some(at) => passed(at) >= SILENT && blocked.next().is_some(),
                None => blocked.any(|(_, since)| passed(*since) >= STUCK),
            }
        };
        let lost = self.peers.iter().filter(|(_, peer)| is_given_up(peer));
        lost.map(|(prefix, _)| *prefix).collect()
    }

    /// Remembers one that was given up and may come back.
    pub(super) fn note_gone(&mut self, now: Instant, prefix: GuidPrefix) {
        self.gone.retain(|(gone, at)| *gone != prefix && now.saturating_duration_since(*at) < TELL);
        if self.gone.len() >= MAX_GONE {
            self.gone.pop_front();
        }
        self.gone.push_back((prefix, now));
    }

    /// Those that were given up not long ago.
    pub(super) fn gone(&mut self, now: Instant) -> impl Iterator<Item = GuidPrefix> + '_ {
        self.gone.retain(|(_, at)| now.saturating_duration_since(*at) < TELL);
        self.gone.iter().map(|(prefix, _)| *prefix)
    }
}

/// How far the clocks of other participants are behind ours.
#[derive(Debug, Default)]
pub(super) struct Clocks {
    behind: HashMap<GuidPrefix, (i128, Instant)>,
}

/// A comparison of clocks is replaced by a worse one after this time, as clocks drift and are set.
const COMPARE_EVERY: Duration = Duration::from_secs(5);

impl Clocks {
    /// Takes a time of day that was sent, and ours when it came. The less of it was spent on the
    /// way, the better.
    pub(super) fn compare(
        &mut self,
        now: Instant,
        prefix: GuidPrefix,
        sent_ns: i128,
        received_ns: i128,
    ) {
        let behind = received_ns - sent_ns;
        if self.behind.len() >= MAX_PEERS && !self.behind.contains_key(&prefix) {
            self.behind.retain(|_, (_, at)| now.saturating_duration_since(*at) < 2 * COMPARE_EVERY);
            if self.behind.len() >= MAX_PEERS {
                return;
            }
        }
        let known = self.behind.entry(prefix).or_insert((behind, now));
        if behind <= known.0 || now.saturating_duration_since(known.1) >= COMPARE_EVERY {
            *known = (behind, now);
        }
    }

    /// What must be added to a participant's time of day; `None` where no sign of life has told.
    pub(super) fn behind_ns(&self, prefix: GuidPrefix) -> Option<i128> {
        self.behind.get(&prefix).map(|(behind, _)| *behind)
    }
}

/// What is known of a writer's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Clock {
    /// So many nanoseconds behind ours.
    Behind(i128),
    /// Nothing yet, but its participant sends signs of life.
    Awaited,
    /// Nothing: a plain DDS program.
    Unknown,
}

impl Clock {
    /// How far it is behind ours, where that is known.
    pub(super) fn behind_ns(self) -> Option<i128> {
        match self {
            Self::Behind(behind) => Some(behind),
            Self::Awaited | Self::Unknown => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use rustdds::QosPolicies;

    use super::*;

    fn prefix(number: u8) -> GuidPrefix {
        GuidPrefix([number; 12])
    }

    fn presence(address: [u8; 4], mask: [u8; 4]) -> Presence {
        Presence::new(Near::new(address.into(), mask.into()), true)
    }

    fn on_loopback() -> Presence {
        presence([127, 0, 0, 1], [255, 0, 0, 0])
    }

    fn reader(participant: u8, topic: &str, port: u16) -> FoundEndpoint {
        reader_at(participant, topic, vec![([127, 0, 0, 1], port).into()])
    }

    fn reader_at(participant: u8, topic: &str, sockets: Vec<SocketAddr>) -> FoundEndpoint {
        let mut id = [0; 16];
        id[..12].copy_from_slice(&prefix(participant).0);
        FoundEndpoint {
            id,
            topic: topic.to_owned(),
            type_name: String::new(),
            qos: QosPolicies::builder().reliable(rustdds::Duration::ZERO).build(),
            user_data: Vec::new(),
            sockets,
        }
    }

    /// Announced by a program in the second slot that uses all its interfaces.
    fn everywhere(addresses: &[[u8; 4]]) -> Vec<SocketAddr> {
        let all = [[127, 0, 0, 1], [172, 17, 0, 1], [10, 42, 0, 1]];
        all.iter().chain(addresses).map(|address| SocketAddr::from((*address, 7413))).collect()
    }

    #[test]
    fn silence_matters_only_where_a_window_is_full() {
        let now = Instant::now();
        let mut presence = on_loopback();
        presence.set_readers(&[
            reader(1, "a", 1),
            reader(2, "a", 2),
            reader(3, "b", 3),
            reader(4, "a", 4),
        ]);
        for (number, at) in [(1, now), (2, now + Duration::from_secs(3)), (3, now)] {
            presence.sign(at, prefix(number));
        }
        let later = now + Duration::from_secs(3);
        assert_eq!(presence.given_up(later, &[]), []);
        assert_eq!(presence.given_up(later, &[("a", later)]), [prefix(1)]);
        assert_eq!(presence.given_up(later, &[("b", later)]), [prefix(3)]);
        let stuck = now + Duration::from_secs(1);
        assert_eq!(
            presence.given_up(later, &[("a", stuck)]),
            [prefix(1), prefix(4)],
            "one without signs of life has time until the window has stood still for long"
        );
        presence.excuse(later);
        assert_eq!(presence.given_up(later, &[("a", later)]), []);
    }

    #[test]
    fn a_port_belongs_to_the_newest() {
        let mut presence = on_loopback();
        presence.set_readers(&[reader(9, "a", 1), reader(5, "a", 2)]);
        assert_eq!(presence.superseded(), []);
        presence.set_readers(&[reader(9, "a", 1), reader(5, "a", 2), reader(1, "b", 1)]);
        assert_eq!(presence.superseded(), [prefix(9)]);
        presence.set_readers(&[reader(5, "a", 2), reader(1, "b", 1)]);
        assert_eq!((presence.superseded(), presence.count()), (vec![], 2));
    }

    #[test]
    fn nobody_is_given_up_where_no_signs_of_life_are_sent() {
        let now = Instant::now();
        let mut presence = Presence { have_signs: false, ..on_loopback() };
        presence.set_readers(&[reader(1, "a", 1), reader(2, "a", 2)]);
        presence.set_readers(&[reader(1, "a", 1), reader(2, "a", 2), reader(3, "a", 1)]);
        assert_eq!(presence.superseded(), [], "participants of one process share a socket");
        assert_eq!(presence.given_up(now + Duration::from_secs(60), &[("a", now)]), []);
        assert_eq!(presence.sockets().count(), 3, "their host is still asked");
    }

    #[test]
    fn addresses_that_each_host_has_make_nobody_another() {
        let mut presence = presence([192, 168, 1, 4], [255, 255, 255, 0]);
        let hosts = [[192, 168, 1, 5], [192, 168, 1, 6]].map(|address| everywhere(&[address]));
        let [first, second] = &hosts;
        presence.set_readers(&[reader_at(1, "a", first.clone())]);
        presence
            .set_readers(&[reader_at(1, "a", first.clone()), reader_at(2, "a", second.clone())]);
        assert_eq!(presence.superseded(), []);
        let asked: Vec<_> = presence.sockets().map(|(_, socket)| socket.to_string()).collect();
        assert_eq!(asked, ["192.168.1.5:7413", "192.168.1.6:7413"]);
        // The first host's program is started again.
        presence.set_readers(&[
            reader_at(1, "a", first.clone()),
            reader_at(2, "a", second.clone()),
            reader_at(3, "a", first.clone()),
        ]);
        assert_eq!(presence.superseded(), [prefix(1)]);
    }

    #[test]
    fn behind_a_router_all_addresses_must_be_another_s() {
        let mut presence = presence([192, 168, 1, 4], [255, 255, 255, 0]);
        let [first, second] = [[10, 1, 0, 5], [10, 1, 0, 6]].map(|address| everywhere(&[address]));
        presence.set_readers(&[reader_at(1, "a", first.clone())]);
        presence.set_readers(&[reader_at(1, "a", first.clone()), reader_at(2, "a", second)]);
        assert_eq!(presence.superseded(), []);
        assert_eq!(presence.sockets().count(), 0, "which one leads there is not known");
        presence.set_readers(&[reader_at(1, "a", first.clone()), reader_at(3, "a", first)]);
        assert_eq!(presence.superseded(), [prefix(1)]);
    }

    #[test]
    fn those_that_were_given_up_are_told_for_a_minute_and_are_bounded() {
        let now = Instant::now();
        let mut presence = on_loopback();
        for number in 0..=255 {
            presence.note_gone(now, prefix(number));
        }
        assert_eq!(presence.gone(now).count(), MAX_GONE);
        assert_eq!(presence.gone(now + Duration::from_secs(61)).count(), 0);
    }

    #[test]
    fn the_shortest_way_tells_the_time_best() {
        let now = Instant::now();
        let mut clocks = Clocks::default();
        assert_eq!(clocks.behind_ns(prefix(1)), None);
        clocks.compare(now, prefix(1), 1_000, 6_000);
        clocks.compare(now, prefix(1), 2_000, 6_500);
        clocks.compare(now, prefix(1), 3_000, 9_000);
        assert_eq!(clocks.behind_ns(prefix(1)), Some(4_500));
        clocks.compare(now + COMPARE_EVERY, prefix(1), 3_000, 9_000);
        assert_eq!(clocks.behind_ns(prefix(1)), Some(6_000));
    }
}
