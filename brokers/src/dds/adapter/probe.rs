//! Whether anything listens where another participant takes its data: the system of its host
//! answers for it.

use std::io::{self, ErrorKind};
use std::net::{Ipv4Addr, SocketAddr, UdpSocket};

/// An RTPS message without a submessage, which every participant passes over.
const NOTHING: [u8; 20] = *b"RTPS\x02\x04\x01\x12blazeprobe\x00\x00";

/// Asks one address again and again.
#[derive(Debug)]
pub(super) struct Probe {
    socket: UdpSocket,
}

impl Probe {
    pub(super) fn new(from: Ipv4Addr, to: SocketAddr) -> io::Result<Self> {
        let socket = UdpSocket::bind((from, 0))?;
        socket.set_nonblocking(true)?;
        socket.connect(to)?;
        Ok(Self { socket })
    }

    /// Whether the host said since the last call that nothing listens there. Silence says nothing.
    pub(super) fn is_refused(&self) -> bool {
        // The answer to the last one shows at either call.
        let sent = self.socket.send(&NOTHING);
        let received = self.socket.recv(&mut [0; 1]);
        let refused = |result: io::Result<usize>| {
            result.is_err_and(|error| error.kind() == ErrorKind::ConnectionRefused)
        };
        refused(sent) | refused(received)
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use super::*;

    #[test]
    fn a_closed_port_is_told_from_a_silent_one() {
        let listener = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let probe = Probe::new(Ipv4Addr::LOCALHOST, listener.local_addr().unwrap()).unwrap();
        for _ in 0..3 {
            assert!(!probe.is_refused());
        }
        drop(listener);
        let until = Instant::now() + Duration::from_secs(5);
        while !probe.is_refused() {
            assert!(Instant::now() < until, "nobody said that the port is closed");
        }
    }
}
