use super::*;

fn free_domain(from: u16) -> u16 {
    let free = |port| UdpSocket::bind((Ipv4Addr::UNSPECIFIED, port)).is_ok();
    let process = u16::try_from(std::process::id() % 40).unwrap();
    (0..100)
        .map(|offset| (from + process + offset) % 100)
        .find(|domain| {
            let base = multicast_port(*domain);
            free(base) && free(base + 1) && (0..LOCAL_SLOTS).all(|slot| free(announcement_port(*domain, slot)))
        })
        .unwrap()
}

fn config(domain: u16, peers: &[&str]) -> RelayConfig {
    RelayConfig {
        domain,
        address: Ipv4Addr::new(10, 1, 1, 1),
        peers: peers.iter().map(|&peer| peer.to_owned()).collect(),
        slots: 4,
    }
}

/// An SPDP message with one parameter.
fn announcement(id: u16, value: &[u8]) -> Vec<u8> {
    let mut payload = vec![0, 3, 0, 0];
    for (id, value) in [(id, value), (PID_SENTINEL, &[][..])] {
        payload.extend(id.to_le_bytes());
        payload.extend(u16::try_from(value.len()).unwrap().to_le_bytes());
        payload.extend(value);
    }
    let mut message = b"RTPS\x02\x04\x01\x12abcdefghijkl".to_vec();
    message.extend([0x09, 0x01, 8, 0, 1, 2, 3, 4, 5, 6, 7, 8]);
    message.extend([SUBMESSAGE_DATA, FLAG_LITTLE_ENDIAN | FLAG_DATA]);
    message.extend(u16::try_from(20 + payload.len()).unwrap().to_le_bytes());
    message.extend([0, 0, 16, 0, 0, 1, 0, 0xc7]);
    message.extend(SPDP_WRITER);
    message.extend([0; 8]);
    message.extend(payload);
    message
}

#[test]
fn an_announcement_tells_its_participant_and_multicast() {
    let prefix = GuidPrefix(*b"abcdefghijkl");
    let mut locator = [0; 24];
    locator[20..].copy_from_slice(&[239, 255, 0, 1]);
    for (id, multicast) in [
        (PID_METATRAFFIC_MULTICAST, true),
        (PID_DEFAULT_MULTICAST, true),
        (0x0031, false),
    ] {
        let message = announcement(id, &locator);
        assert_eq!(Announcement::parse(&message), Some(Announcement { prefix, multicast }));
    }
    let mut good_bye = announcement(0x0031, &locator);
    good_bye[33] &= !FLAG_DATA;
    assert_eq!(Announcement::parse(&good_bye), None);
}

#[test]
fn no_bytes_make_the_parser_panic() {
    let whole = announcement(PID_DEFAULT_MULTICAST, &[0; 24]);
    for length in 0..whole.len() {
        let _ = Announcement::parse(&whole[..length]);
    }
    for at in 0..whole.len() {
        for byte in [0, 1, 0x7f, 0x80, 0xff] {
            let mut changed = whole.clone();
            changed[at] = byte;
            let _ = Announcement::parse(&changed);
        }
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
    let status = relay.status();
    assert_eq!((status.addresses, status.forgotten), (MAX_ADDRESSES, 45));
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
        assert!(
            begin.elapsed() < Duration::from_secs(3),
            "the ports were not taken over"
        );
        thread::sleep(Duration::from_millis(10));
    }
}
