//! TUN devices in other namespaces.

use std::fs::File;
use std::io::{Read as _, Seek as _};

use anyhow::Context as _;
use blaze_tests::network::inside;
use parking_lot::Mutex;
use tun::Device;

/// A TUN device. Its file stays valid whatever namespace the thread that uses it is in.
pub(crate) struct Tun {
    device: Device,
    name: String,
    /// `/proc/thread-self/net/dev` of the device's namespace.
    counters: Mutex<File>,
}

/// Makes a device in a namespace and sets it up; it has no address yet.
pub(crate) fn open(namespace: &str, name: &str, mtu: u16) -> anyhow::Result<Tun> {
    inside(namespace, || {
        let mut configuration = tun::configure();
        configuration.tun_name(name).mtu(mtu).up();
        let device = tun::create(&configuration)
            .with_context(|| format!("a TUN device {name} in {namespace}"))?;
        let counters =
            File::open("/proc/thread-self/net/dev").context("the counters of the interfaces")?;
        Ok(Tun { device, name: name.to_owned(), counters: Mutex::new(counters) })
    })
}

impl Tun {
    /// The next packet that the namespace sends; waits for it.
    pub(crate) fn recv(&self, buffer: &mut [u8]) -> std::io::Result<usize> {
        self.device.recv(buffer)
    }

    /// Gives the namespace a packet.
    pub(crate) fn send(&self, packet: &[u8]) -> std::io::Result<()> {
        self.device.send(packet).map(|_| ())
    }

    /// Packets that the namespace wanted to send and the kernel dropped, because its queue was
    /// full.
    pub(crate) fn missed(&self) -> anyhow::Result<u64> {
        let mut text = String::new();
        let mut counters = self.counters.lock();
        counters.rewind()?;
        counters.read_to_string(&mut text)?;
        // The twelfth number of an interface's line: dropped while sending.
        let dropped = text.lines().find_map(|line| {
            let numbers = line.trim().strip_prefix(&*self.name)?.strip_prefix(':')?;
            numbers.split_whitespace().nth(11)?.parse().ok()
        });
        dropped.with_context(|| format!("{} is not among the interfaces", self.name))
    }
}
