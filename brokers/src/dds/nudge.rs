//! Keeps RustDDS reading announcements.
//!
//! RustDDS reads what participants announce up to the first announcement that it cannot decode, and
//! goes on when the next datagram comes. So a few dozen forged ones would keep newcomers out for
//! minutes, until as many good ones have come. A datagram that tells nothing lets it go on.

use std::io;
use std::net::{SocketAddrV4, UdpSocket};

use super::farewell;
use super::{GuidPrefix, Participant};

/// The good-bye of nobody: read once, then passed over.
const NOBODY: GuidPrefix = GuidPrefix(*b"blaze-nobody");

/// RustDDS takes several that come at once as one or as several.
const AT_ONCE: usize = 8;

/// Nudges one participant of this process.
pub(super) struct Nudge {
    socket: UdpSocket,
    to: SocketAddrV4,
    datagram: Vec<u8>,
}

impl Nudge {
    pub(super) fn new(participant: &Participant) -> io::Result<Self> {
        let address = participant.address();
        let socket = UdpSocket::bind((address, 0))?;
        socket.set_nonblocking(true)?;
        Ok(Self {
            socket,
            to: SocketAddrV4::new(address, participant.port()),
            datagram: farewell::datagram(NOBODY, 1),
        })
    }

    /// Lets RustDDS read on to the next announcement that it cannot decode, or some further.
    pub(super) fn give(&self) {
        for _ in 0..AT_ONCE {
            // One that is lost is followed by the next.
            let _ = self.socket.send_to(&self.datagram, self.to);
        }
    }
}
