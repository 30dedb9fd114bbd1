use proptest::prelude::*;

use super::message::Announced;
use super::*;

const OWN: GuidPrefix = GuidPrefix(*b"\x01\x12own-prefix");
const OTHER: GuidPrefix = GuidPrefix(*b"\x01\x0fothers-one");
const SPDP: [u8; 4] = [0, 1, 0, 0xc2];
const PUBLICATIONS: [u8; 4] = [0, 0, 3, 0xc2];
const SUBSCRIPTIONS: [u8; 4] = [0, 0, 4, 0xc2];
const KEY: u8 = 0x08;
const PAYLOAD: u8 = 0x04;
const HERE: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 9), 4711);
const DISPOSED: [u8; 12] = [0x71, 0, 4, 0, 0, 0, 0, 3, 1, 0, 0, 0];

fn half(value: usize, is_little: bool) -> [u8; 2] {
    let value = u16::try_from(value).unwrap();
    if is_little { value.to_le_bytes() } else { value.to_be_bytes() }
}

fn word(value: u32, is_little: bool) -> [u8; 4] {
    if is_little { value.to_le_bytes() } else { value.to_be_bytes() }
}

fn submessage(kind: u8, flags: u8, body: &[u8]) -> Vec<u8> {
    [&[kind, flags], &half(body.len(), flags & 1 != 0)[..], body].concat()
}

fn data(writer: [u8; 4], flags: u8, inline: &[u8], payload: &[u8]) -> Vec<u8> {
    let is_little = flags & 1 != 0;
    let begin = [half(0, is_little), half(16, is_little)].concat();
    let number = [word(0, is_little), word(3, is_little)].concat();
    submessage(0x15, flags, &[&begin[..], &[0; 4], &writer, &number, inline, payload].concat())
}

fn message(prefix: GuidPrefix, submessages: &[Vec<u8>]) -> Vec<u8> {
    [b"RTPS\x02\x04\x01\x0f", &prefix.0[..], &submessages.concat()].concat()
}

fn parameter(id: usize, value: &[u8], is_little: bool) -> Vec<u8> {
    [&half(id, is_little), &half(value.len(), is_little)[..], value].concat()
}

fn locator(address: [u8; 4], port: u32, is_little: bool) -> Vec<u8> {
    [&word(1, is_little), &word(port, is_little)[..], &[0; 12], &address].concat()
}

/// What Fast DDS announces, in short, with a time before it.
fn announcement(is_little: bool) -> Vec<u8> {
    let flags = u8::from(is_little) | PAYLOAD;
    let lease = [word(20, is_little), word(0, is_little)].concat();
    let group = locator([239, 255, 0, 1], 7400, is_little);
    let parameters = [
        parameter(0x0050, &[&OTHER.0[..], &[0, 0, 1, 0xc1]].concat(), is_little),
        parameter(0x0033, &group, is_little),
        parameter(0x0032, &locator([10, 0, 0, 1], 7412, is_little), is_little),
        parameter(0x0032, &locator([172, 17, 0, 1], 7412, is_little), is_little),
        parameter(0x0032, &locator([127, 0, 0, 1], 7412, is_little), is_little),
        parameter(0x0032, &group, is_little),
        parameter(0x0031, &locator([10, 0, 0, 1], 7413, is_little), is_little),
        parameter(0x0002, &lease, is_little),
        parameter(0x0001, &[], is_little),
    ];
    let payload = [&[0, 2 + u8::from(is_little), 0, 0], &parameters.concat()[..]].concat();
    message(OTHER, &[submessage(9, flags & 1, &[7; 8]), data(SPDP, flags, &[], &payload)])
}

/// What RustDDS sends when an endpoint is gone.
fn disposal(writer: [u8; 4], parameter: u8, guid: &[u8; 16]) -> Vec<u8> {
    let key = [&[0, 3, 0, 0, parameter, 0, 16, 0][..], guid].concat();
    data(writer, 1 | 2 | KEY, &DISPOSED, &key)
}

fn amend(datagram: &[u8]) -> Option<Outgoing> {
    Outgoing::amend(datagram, OWN, &mut Gone::default())
}

#[test]
fn an_announcement_is_repeated_with_another_place_for_metatraffic() {
    for is_little in [true, false] {
        let datagram = announcement(is_little);
        let spdp = Spdp::parse(&datagram).unwrap();
        assert_eq!(spdp.prefix, OTHER);
        let announced = spdp.announced.clone().unwrap();
        assert_eq!(announced.lease, Duration::from_secs(20));
        let ports = announced.addresses.iter().map(SocketAddrV4::port);
        assert_eq!(ports.collect::<Vec<_>>(), [7412; 3], "a group is of no single one");

        let repeated = spdp.repeated(Some(OWN), Some(HERE)).unwrap();
        assert_eq!(repeated[8..20], OWN.0);
        assert_eq!(repeated[20], 0x0c, "so the filter lets it pass");
        assert_eq!(repeated[28..32], *b"\x02\x04\x01\x0f");
        assert_eq!(repeated[32..44], OTHER.0, "what it tells is of the other one");
        let again = Spdp::parse(&repeated).unwrap().announced.unwrap();
        assert_eq!(again, Announced { addresses: vec![HERE], ..announced });
        let holds = |id: usize| {
            let head = [half(id, is_little), half(24, is_little)].concat();
            repeated.windows(4).filter(|it| *it == head).count()
        };
        assert_eq!([0x32, 0x33, 0x31].map(holds), [1, 0, 1]);

        let unchanged = spdp.repeated(None, None).unwrap();
        assert_eq!((&unchanged[8..20], &unchanged[44..]), (&OTHER.0[..], &datagram[20..]));
    }
}

#[test]
fn a_good_bye_is_repeated_as_it_is() {
    let datagram = farewell::datagram(OTHER, 9);
    let spdp = Spdp::parse(&datagram).unwrap();
    assert_eq!((spdp.prefix, &spdp.announced), (OTHER, &None));
    assert_eq!(spdp.repeated(None, None).unwrap()[44..], datagram[20..]);
    assert!(Spdp::parse(&message(OTHER, &[disposal(PUBLICATIONS, 0x5a, &[5; 16])])).is_none());
}

#[test]
fn the_way_is_the_one_that_the_announcement_came() {
    let all = Spdp::parse(&announcement(true)).unwrap().announced.unwrap();
    let reached = |from: [u8; 4], of: &Announced| -> Vec<[u8; 4]> {
        of.reached_at(from.into()).iter().map(|it| it.ip().octets()).collect()
    };
    assert_eq!(reached([10, 0, 0, 1], &all), [[10, 0, 0, 1]]);
    assert_eq!(reached([127, 0, 0, 1], &all), [[127, 0, 0, 1]]);
    assert_eq!(reached([10, 0, 0, 2], &all), [[10, 0, 0, 1], [172, 17, 0, 1]]);
    let mut remote = all;
    remote.addresses.retain(|it| it.ip().is_loopback());
    assert!(reached([10, 0, 0, 1], &remote).is_empty(), "that would be this host");
}

#[test]
fn what_ceases_gets_the_hash_of_its_key() {
    let guid = [5; 16];
    let to = submessage(0x0e, 1, &OTHER.0);
    let time = submessage(9, 1, &[7; 8]);
    let alive = data(SUBSCRIPTIONS, 1 | PAYLOAD, &[], &[9; 40]);
    for (writer, id) in [(PUBLICATIONS, 0x5a), (SUBSCRIPTIONS, 0x5a), (SPDP, 0x50)] {
        let gone = disposal(writer, id, &guid);
        let datagram = message(OWN, &[to.clone(), time.clone(), alive.clone(), gone.clone()]);
        let outgoing = amend(&datagram).unwrap();
        assert_eq!(outgoing.to, [OTHER]);
        let (key, rest) = gone[24..].split_at(DISPOSED.len());
        let hash = parameter(0x70, &guid, true);
        let length = half(gone.len() - 4 + hash.len(), true);
        let amended = [&gone[..2], &length, &gone[4..24], &hash, key, rest].concat();
        let expected = message(OWN, &[to.clone(), time.clone(), alive.clone(), amended]);
        assert_eq!(outgoing.datagram, expected);
        assert_eq!(amend(&outgoing.datagram).unwrap().datagram, outgoing.datagram);
    }
}

#[test]
fn late_joiners_do_not_hear_that_something_was_there() {
    let mut gone = Gone::default();
    let [one, other] = [[5; 16], [6; 16]];
    let told = |guid: &[u8; 16]| {
        let guids = [parameter(0x5a, guid, true), parameter(0x50, &[8; 16], true)].concat();
        let payload = [&[0, 3, 0, 0][..], &guids, &parameter(1, &[], true)].concat();
        data(PUBLICATIONS, 1 | PAYLOAD, &[], &payload)
    };
    let both = message(OWN, &[told(&one), told(&other)]);
    let as_it_is = Outgoing::amend(&both, OWN, &mut gone).unwrap().datagram;
    assert_eq!(as_it_is, both);
    let end = message(OWN, &[disposal(PUBLICATIONS, 0x5a, &one)]);
    let end = Outgoing::amend(&end, OWN, &mut gone).unwrap().datagram;
    let amended = Outgoing::amend(&both, OWN, &mut gone).unwrap().datagram;
    // With the end of the list that RustDDS leaves out.
    let length = half(end.len() - 24 + 4, true);
    let ends = [&end[20..22], &length, &end[24..], &parameter(1, &[], true)].concat();
    assert_eq!(amended, message(OWN, &[ends, told(&other)]));
    // Both in one datagram.
    let at_once = message(OWN, &[told(&other), disposal(PUBLICATIONS, 0x5a, &other)]);
    assert!(amend(&at_once).unwrap().datagram.windows(4).all(|it| it != [8; 4]));
}

#[test]
fn all_else_stays_as_it_is() {
    let of_user = disposal([0, 0, 3, 2], 0x5a, &[5; 16]);
    let no_key =
        data(PUBLICATIONS, 1 | 2 | KEY, &DISPOSED, &[0, 3, 0, 0, 0x5a, 0, 4, 0, 1, 2, 3, 4]);
    let heartbeat = submessage(7, 1, &[3; 28]);
    for one in [of_user, no_key, heartbeat] {
        let datagram = message(OWN, &[one]);
        let outgoing = amend(&datagram).unwrap();
        assert_eq!(outgoing.datagram, datagram);
        assert!(outgoing.to.is_empty(), "to all");
        assert!(amend(&[&datagram[..8], &OTHER.0, &datagram[20..]].concat()).is_none());
    }
}

#[test]
fn what_would_be_too_long_is_refused() {
    let payload = [&[0, 3, 0, 0][..], &parameter(0x7fff, &vec![1; 65_480], true)].concat();
    let end = parameter(1, &[], true);
    let spdp = data(SPDP, 1 | PAYLOAD, &[], &[payload, end].concat());
    let datagram = message(OTHER, &[spdp]);
    let spdp = Spdp::parse(&datagram).unwrap();
    assert!(spdp.repeated(None, Some(HERE)).is_none());
    assert!(spdp.repeated(None, None).is_some());
}

proptest! {
    #[test]
    fn no_bytes_make_it_panic(
        random in proptest::collection::vec(any::<u8>(), 0..200),
        changes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..6),
        cut in any::<prop::sample::Index>(),
        which in 0..4_usize,
    ) {
        let gone = message(OWN, &[disposal(PUBLICATIONS, 0x5a, &[5; 16]), farewell::datagram(OWN, 1)[20..].to_vec()]);
        let mut datagram = [announcement(true), announcement(false), gone, random][which].clone();
        for (at, byte) in changes {
            if !datagram.is_empty() {
                let at = at.index(datagram.len());
                datagram[at] = byte;
            }
        }
        datagram.truncate(cut.index(datagram.len() + 1).max(datagram.len() / 2));
        if let Some(spdp) = Spdp::parse(&datagram)
            && let Some(repeated) = spdp.repeated(Some(OWN), Some(HERE))
        {
            let again = Spdp::parse(&repeated).unwrap();
            if let Some(announced) = &again.announced {
                prop_assert_eq!(&announced.addresses, &[HERE]);
            }
        }
        if let Some(outgoing) = amend(&datagram) {
            let again = amend(&outgoing.datagram).unwrap();
            prop_assert_eq!(&again.datagram, &outgoing.datagram);
        }
    }
}

/// One on loopback that says what it is sent.
struct Place(UdpSocket);

impl Place {
    fn new(address: Ipv4Addr) -> Self {
        let socket = UdpSocket::bind((address, 0)).unwrap();
        socket.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
        Self(socket)
    }

    fn port(&self) -> u16 {
        self.0.local_addr().unwrap().port()
    }

    fn send(&self, datagram: &[u8], port: u16) {
        self.0.send_to(datagram, (Ipv4Addr::LOCALHOST, port)).unwrap();
    }

    fn receive(&self) -> Vec<u8> {
        let mut buffer = vec![0; 65_536];
        let length = self.0.recv(&mut buffer).unwrap();
        buffer.truncate(length);
        buffer
    }
}

#[test]
fn the_kernel_steers_announcements_and_metatraffic_is_sent_on() {
    let (rustdds, remote) = (Place::new(Ipv4Addr::UNSPECIFIED), Place::new(Ipv4Addr::LOCALHOST));
    let sockets = Sockets::open(219, Ipv4Addr::LOCALHOST, rustdds.port()).unwrap();
    let here = sockets.here.port();
    let metatraffic = Metatraffic::start(sockets, OWN, Arc::default()).unwrap();

    let mut spdp = announcement(true);
    let at = spdp.windows(4).rposition(|it| it == [127, 0, 0, 1]).unwrap() - 16;
    spdp[at..at + 4].copy_from_slice(&word(remote.port().into(), true));
    remote.send(&spdp, rustdds.port());
    let repeated = Spdp::parse(&rustdds.receive()).unwrap().announced.unwrap();
    assert_eq!(repeated.addresses, [SocketAddrV4::new(Ipv4Addr::LOCALHOST, here)]);

    let others = message(OTHER, &[disposal(PUBLICATIONS, 0x5a, &[5; 16])]);
    remote.send(&others, rustdds.port());
    assert_eq!(rustdds.receive(), others, "what is no announcement goes directly");

    let gone = message(OWN, &[disposal(PUBLICATIONS, 0x5a, &[5; 16])]);
    rustdds.send(&gone, here);
    assert_eq!(remote.receive(), amend(&gone).unwrap().datagram);
    let to_third = message(OWN, &[submessage(0x0e, 1, &[3; 12]), submessage(7, 1, &[3; 28])]);
    rustdds.send(&to_third, here);
    assert_eq!(metatraffic.dropped(), 0);

    drop(metatraffic);
    let farewell = farewell::datagram(OWN, FAREWELL);
    assert_eq!(remote.receive(), amend(&farewell).unwrap().datagram);
}
