//! One end of a DDS link transport, for tests and measurements between hosts or network namespaces.
//!
//! ```text
//! blaze-testbed link-peer name=edge/a listen=10.9.0.1 domain=33 [peers=10.9.0.2] [seconds=6] [chunking=mtu] [mtu=1500]
//!           [send=<datagram bytes>x<count>@<per second>] [class=bulk] [interface=veth0]
//! ```
//! It says when it is up, connects to all that it discovers, tells each what addresses it knows as
//! flows do in Hello, and prints what happens. With `send` it then sends to the first, and prints
//! the bytes on the wire as computed and as the interface counted them (Ethernet headers deducted).

use std::collections::BTreeMap;
use std::fs;
use std::net::{IpAddr, Ipv4Addr};
use std::str::FromStr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use blaze_domain::Priority;
use blaze_domain::node_file::Chunking;
use blaze_flow::link::dds::{DdsConfig, DdsTransport};
use blaze_flow::link::transport::{Endpoint, SendOutcome, TransportEvent};
use clap::Args;
use parking_lot::Mutex;

const ETHERNET_HEADER: u64 = 14;
/// Marks a datagram as a list of addresses.
const HELLO: &[u8] = b"hello ";

/// `NAME=VALUE …`, see above.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    values: Vec<String>,
}

impl Arguments {
    fn get<T: FromStr>(&self, name: &str) -> Option<T> {
        let value =
            self.values.iter().find_map(|argument| argument.strip_prefix(name)?.strip_prefix('='));
        value.and_then(|value| value.parse().ok())
    }
}

#[derive(Default)]
struct Seen {
    peers: Vec<Endpoint>,
    hellos: Vec<String>,
    received: BTreeMap<Priority, (u64, u64)>,
}

fn counters(interface: &str) -> (u64, u64) {
    let read = |name: &str| {
        let text = fs::read_to_string(format!("/sys/class/net/{interface}/statistics/{name}"))
            .unwrap_or_default();
        text.trim().parse().unwrap_or(0)
    };
    (read("tx_bytes"), read("tx_packets"))
}

fn note(seen: &Mutex<Seen>, begin: Instant, event: TransportEvent) {
    let mut seen = seen.lock();
    match event {
        TransportEvent::Discovered(endpoint) => {
            println!("discovered {endpoint} after {} ms", begin.elapsed().as_millis());
            seen.peers.push(endpoint);
        }
        TransportEvent::Lost(endpoint) => {
            println!("lost {endpoint}");
            seen.peers.retain(|known| *known != endpoint);
        }
        TransportEvent::Rebuilt { epoch } => println!("rebuilt {epoch}"),
        TransportEvent::Received { class, datagram } => match datagram.strip_prefix(HELLO) {
            Some(addresses) => seen.hellos.push(String::from_utf8_lossy(addresses).into_owned()),
            None => {
                let (count, bytes) = seen.received.entry(class).or_default();
                *count += 1;
                *bytes += datagram.len() as u64;
            }
        },
    }
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let begin = Instant::now();
    let seen = Arc::<Mutex<Seen>>::default();
    let log = Arc::clone(&seen);
    let epoch = arguments.get("epoch").unwrap_or(1);
    let text =
        |name: &str, default: &str| arguments.get(name).unwrap_or_else(|| default.to_owned());
    let transport = DdsTransport::start(DdsConfig {
        domain: arguments.get("domain").unwrap_or(33),
        listen: arguments.get("listen").unwrap_or(IpAddr::V4(Ipv4Addr::LOCALHOST)),
        peers: text("peers", "")
            .split(',')
            .filter(|peer| !peer.is_empty())
            .map(str::to_owned)
            .collect(),
        peer_slots: 4,
        mtu: arguments.get("mtu").unwrap_or(1500),
        chunking: match text("chunking", "auto").as_str() {
            "mtu" => Chunking::Mtu,
            "whole" => Chunking::Whole,
            _ => Chunking::Auto,
        },
        local: Endpoint { flow: text("name", "edge/a").parse()?, epoch },
        next_epoch: Arc::new(move || epoch + 1),
        sink: Arc::new(move |event| note(&log, begin, event)),
    })?;
    let deadline = begin + Duration::from_secs_f64(arguments.get("seconds").unwrap_or(6.0));
    let mut order: Option<String> = arguments.get("send");
    let mut is_up = false;
    while Instant::now() < deadline {
        if !is_up && transport.status().ready {
            println!("up after {} ms", begin.elapsed().as_millis());
            is_up = true;
        }
        exchange_addresses(&transport, &seen);
        if let Some(send) = order.take() {
            let first = seen.lock().peers.first().cloned();
            match first {
                Some(to) => measure(&transport, &to, arguments, &send)?,
                None => order = Some(send),
            }
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    for (class, (count, bytes)) in &seen.lock().received {
        println!("received {class} {count} datagrams {bytes} bytes");
    }
    println!("status {:?}", transport.status());
    Ok(())
}

/// What Hello does in a flow.
fn exchange_addresses(transport: &DdsTransport, seen: &Mutex<Seen>) {
    let (peers, hellos) = {
        let mut seen = seen.lock();
        (seen.peers.clone(), std::mem::take(&mut seen.hellos))
    };
    let mut known = transport.addresses();
    for hello in &hellos {
        known.extend(hello.split(',').map(str::to_owned));
    }
    transport.learn_addresses(&known);
    for peer in peers {
        transport.connect(&peer);
        let hello = [HELLO, known.join(",").as_bytes()].concat();
        let _ = transport.send(&peer, Priority::Control, &hello);
    }
}

fn measure(
    transport: &DdsTransport,
    to: &Endpoint,
    arguments: &Arguments,
    order: &str,
) -> anyhow::Result<()> {
    let (size, rest) = order.split_once('x').context("send=<bytes>x<count>@<rate>")?;
    let (count, rate) = rest.split_once('@').context("send=<bytes>x<count>@<rate>")?;
    let (size, count, rate): (usize, u64, f64) = (size.parse()?, count.parse()?, rate.parse()?);
    let class = arguments.get("class").unwrap_or(Priority::Bulk);
    let interface = arguments.get("interface").unwrap_or_else(|| String::from("lo"));
    // Until the reader knows this writer, what is written is lost.
    std::thread::sleep(Duration::from_secs(1));
    let before = counters(&interface);
    let begin = Instant::now();
    let datagram = vec![0xab; size];
    let (mut sent, mut computed) = (0, 0);
    for number in 0..count {
        let due = Duration::from_secs_f64(number as f64 / rate);
        if let Some(wait) = due.checked_sub(begin.elapsed()) {
            std::thread::sleep(wait);
        }
        if transport.send(to, class, &datagram) == SendOutcome::Sent {
            sent += 1;
            computed += transport.wire_bytes(size) as u64;
        }
    }
    std::thread::sleep(Duration::from_millis(200));
    let after = counters(&interface);
    let packets = after.1 - before.1;
    let counted = after.0 - before.0 - packets * ETHERNET_HEADER;
    println!("sent {sent} of {count} computed {computed} counted {counted} packets {packets}");
    Ok(())
}
