use super::*;
use crate::dds::{Participant, ParticipantConfig};

fn free_domain(from: u16) -> u16 {
    let free = |port| UdpSocket::bind((Ipv4Addr::UNSPECIFIED, port)).is_ok();
    let process = u16::try_from(std::process::id() % 40).unwrap();
    (0..100)
        .map(|offset| (from + process + offset) % 100)
        .find(|domain| {
            let base = multicast_port(*domain);
            free(base)
                && free(base + 1)
                && (0..LOCAL_SLOTS).all(|slot| free(announcement_port(*domain, slot)))
        })
        .unwrap()
}

fn config(domain: u16, peers: &[&str]) -> RelayConfig {
    RelayConfig {
        domain,
        address: Ipv4Addr::new(10, 1, 1, 1),
        peers: peers.iter().map(|&peer| peer.to_owned()).collect(),
        slots: 4,
        own_slots: 0,
        holds_multicast: true,
        repeat: Duration::from_millis(500),
    }
}

#[test]
fn addresses_are_bounded_and_those_of_this_host_are_passed_over() {
    let peers = ["10.1.1.1", "127.0.0.1", "0.0.0.0", "239.1.1.1", "::1", "10.1.1.2"];
    let relay = Relay::start(config(free_domain(0), &peers)).unwrap();
    assert_eq!(relay.status().addresses, 1);
    relay.learn([[10, 1, 1, 1], [10, 1, 1, 2], [127, 0, 0, 1]].map(Ipv4Addr::from));
    assert_eq!(relay.status().addresses, 1);
    relay.learn((0..300_u16).map(|number| {
        let [high, low] = number.to_be_bytes();
        Ipv4Addr::new(10, 2, high, low)
    }));
    assert_eq!(relay.status().addresses, MAX_ADDRESSES);
}

#[test]
fn multicast_ports_pass_to_the_next_relay_of_the_host() {
    let domain = free_domain(50);
    let first = Relay::start(config(domain, &[])).unwrap();
    let second = Relay::start(config(domain, &[])).unwrap();
    assert!(first.status().holds_multicast_ports && !second.status().holds_multicast_ports);
    assert!(UdpSocket::bind((Ipv4Addr::UNSPECIFIED, multicast_port(domain))).is_err());
    drop(first);
    let begin = Instant::now();
    while !second.status().holds_multicast_ports {
        assert!(begin.elapsed() < Duration::from_secs(3), "the ports were not taken over");
        thread::sleep(Duration::from_millis(10));
    }
}

#[test]
fn higher_slots_of_the_own_host_are_announced_to_without_multicast_ports() {
    let domain = free_domain(20);
    let own_slots = LOCAL_SLOTS + 2;
    let address = Ipv4Addr::LOCALHOST;
    let relay = Relay::start(RelayConfig {
        address,
        own_slots,
        holds_multicast: false,
        repeat: Duration::from_millis(20),
        ..config(domain, &[])
    })
    .unwrap();
    let listen = |slot| UdpSocket::bind((address, announcement_port(domain, slot))).unwrap();
    let (last, beyond) = (listen(own_slots - 1), listen(own_slots));
    last.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
    beyond.set_nonblocking(true).unwrap();
    let participant = Participant::start(ParticipantConfig::new(domain, address)).unwrap();
    relay.set_participant(participant.prefix());
    let mut buffer = [0; 2048];
    let (length, _) = last.recv_from(&mut buffer).unwrap();
    let announced = Announcement::parse(&buffer[..length]).unwrap();
    assert_eq!(announced.prefix, participant.prefix());
    assert!(beyond.recv_from(&mut buffer).is_err(), "it is not asked for");
    assert!(UdpSocket::bind((Ipv4Addr::UNSPECIFIED, multicast_port(domain))).is_err());
    assert!(!relay.status().holds_multicast_ports, "the participant has them");
}
