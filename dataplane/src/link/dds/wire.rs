//! Sizes: what a datagram becomes on the wire, and how large one may be.

use blaze_domain::node_file::MIN_MTU;

use super::Chunking;
use crate::link::{MIN_DATAGRAM_BYTES, PacketSize};

/// IPv4 and UDP headers.
const IP_UDP: usize = 20 + 8;
const RTPS_HEADER: usize = 20;
/// DATA submessage before its payload.
const DATA: usize = 24;
/// DATA_FRAG submessage before its payload.
const DATA_FRAG: usize = 36;
/// RustDDS' fixed size of a fragment.
const FRAGMENT: usize = 256;
/// Encapsulation, and the length of the sequence of octets.
const PAYLOAD_HEADER: usize = 4 + 4;
/// What RustDDS keeps free in a packet: its datagram budget is the MTU less 48, a DATA's payload
/// that less 48.
const BUDGET: usize = 48;
const DATA_RESERVE: usize = 48;
/// From an MTU to the largest sample that never fragments, reliable writers included.
const MTU_OVERHEAD: usize = 132;
/// Largest sample of one packet, however large the MTU is: a peer behind a router has 1500.
const LARGEST_SAMPLE: usize = 1300;
/// The smallest MTU that a node file may name: the smallest datagram of the link fits into it.
const SMALLEST_MTU: usize = MIN_MTU as usize;
const _: () = assert!(SMALLEST_MTU >= MIN_DATAGRAM_BYTES + PAYLOAD_HEADER - 4 + MTU_OVERHEAD);
/// The MTU of Linux' loopback interface.
const LOOPBACK_MTU: usize = 65_536;
/// Datagrams between flows of one host: one packet of the loopback interface, and several fit in a
/// default socket buffer (208 KiB).
const LOOPBACK_DATAGRAM: usize = 32 * 1024;
/// `whole`: RustDDS cuts it into fragments of 256 bytes, five to a packet.
const WHOLE_DATAGRAM: usize = 60 * 1024;
/// Fragmented samples of this many bytes are always taken.
const SMALLEST_LIMIT: usize = 2048;

/// The sizes of one transport.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Wire {
    mtu: usize,
    max_datagram: usize,
}

impl Wire {
    pub(crate) fn new(mtu: usize, chunking: Chunking, loopback: bool) -> Self {
        let mtu = mtu.clamp(SMALLEST_MTU, LOOPBACK_MTU);
        let one_packet = (mtu - MTU_OVERHEAD).min(LARGEST_SAMPLE) - (PAYLOAD_HEADER - 4);
        let max_datagram = match (chunking, loopback) {
            (Chunking::Mtu, _) | (Chunking::Auto, false) => one_packet,
            (Chunking::Auto, true) => LOOPBACK_DATAGRAM,
            (Chunking::Whole, _) => WHOLE_DATAGRAM,
        };
        Self { mtu: if loopback { LOOPBACK_MTU } else { mtu }, max_datagram }
    }

    pub(crate) fn max_datagram_bytes(self) -> usize {
        self.max_datagram
    }

    /// What datagrams become on the wire. Small ones that RustDDS happens to put into one packet
    /// take less.
    pub(crate) fn packets(self) -> PacketSize {
        let budget = self.mtu - BUDGET;
        let room = (budget - RTPS_HEADER).saturating_sub(DATA_FRAG);
        PacketSize {
            prefix: PAYLOAD_HEADER,
            align: 4,
            whole: budget - DATA_RESERVE,
            whole_header: IP_UDP + RTPS_HEADER + DATA,
            last_part: room.max(FRAGMENT),
            part: (room / FRAGMENT).max(1) * FRAGMENT,
            part_header: IP_UDP + RTPS_HEADER + DATA_FRAG,
        }
    }

    /// Bytes of the largest sample that may come in fragments: a datagram of this transport, or one
    /// packet of a flow whose `mtu` is above that of its interface.
    pub(super) fn largest_sample(self) -> u32 {
        let sample = (PAYLOAD_HEADER + self.max_datagram).max(SMALLEST_LIMIT);
        u32::try_from(sample).unwrap_or(u32::MAX)
    }

    /// Bytes of all IP packets of a datagram, headers included.
    pub(crate) fn bytes(self, datagram: usize) -> usize {
        self.packets().wire_bytes(datagram)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_datagram_of_the_largest_size_is_one_packet() {
        for mtu in [1280, 1420, 1500, 9000] {
            let wire = Wire::new(mtu, Chunking::Mtu, false);
            let largest = wire.max_datagram_bytes();
            assert!(wire.bytes(largest) <= mtu, "{mtu}: {}", wire.bytes(largest));
            assert_eq!(wire.bytes(largest), largest + 80);
            assert!(largest >= MIN_DATAGRAM_BYTES);
        }
        assert_eq!(Wire::new(1500, Chunking::Auto, false).max_datagram_bytes(), 1296);
        assert_eq!(Wire::new(1420, Chunking::Auto, false).max_datagram_bytes(), 1284);
    }

    #[test]
    fn a_whole_datagram_is_cut_into_fragments() {
        let wire = Wire::new(1500, Chunking::Whole, false);
        // 6000 + 8 bytes: five fragments (1280 bytes) to a packet, the last packet takes up to
        // 1396.
        assert_eq!(wire.bytes(6000), 5 * 84 + 6008);
        assert_eq!(wire.bytes(1400), 2 * 84 + 1408);
        assert_eq!(wire.bytes(1396), 1396 + 80);
    }

    #[test]
    fn loopback_carries_large_datagrams_in_one_packet() {
        let wire = Wire::new(1500, Chunking::Auto, true);
        assert!(wire.max_datagram_bytes() > 8000);
        assert_eq!(wire.bytes(wire.max_datagram_bytes()), wire.max_datagram_bytes() + 80);
    }
}
