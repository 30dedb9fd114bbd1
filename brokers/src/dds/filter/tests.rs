//! The program against an interpreter of its own, and against the kernel.

use std::net::{Ipv4Addr, UdpSocket};
use std::time::Duration;

use super::assembler::{Instruction, JUMP, Op, Test};
use super::program::{Samples, Shape, announcements, program, steering};
use super::socket::{UdpSocketLine, attach};

/// Runs a program over a packet; the result is what `Return` says, 0 for a load beyond the packet.
fn interpret(program: &[Instruction], packet: &[u8]) -> u32 {
    let (mut a, mut x, mut memory, mut at) = (0_u32, 0_u32, [None::<u32>; 16], 0_usize);
    let load = |from: u32, count: usize| {
        let from = usize::try_from(from).ok()?;
        let bytes = packet.get(from..from.checked_add(count)?)?;
        Some(bytes.iter().fold(0, |value, byte| value << 8 | u32::from(*byte)))
    };
    loop {
        let it = program[at];
        at += 1;
        let code = it.code;
        let slot = it.k as usize % 16;
        let is = |op: Op| op as u16 == code;
        let test = [Test::Equal, Test::AnyBit, Test::EqualsIndex, Test::AboveIndex]
            .into_iter()
            .find(|test| *test as u16 == code);
        if let Some(test) = test {
            let holds = match test {
                Test::Equal => a == it.k,
                Test::AnyBit => a & it.k != 0,
                Test::EqualsIndex => a == x,
                Test::AboveIndex => a > x,
            };
            at += usize::from(if holds { it.if_true } else { it.if_false });
        } else if code == JUMP {
            at += it.k as usize;
        } else if is(Op::Return) {
            return it.k;
        } else if is(Op::LoadWordAt) || is(Op::LoadWord) || is(Op::LoadHalf) {
            let from = if is(Op::LoadWordAt) { Some(it.k) } else { x.checked_add(it.k) };
            let Some(value) =
                from.and_then(|from| load(from, if is(Op::LoadHalf) { 2 } else { 4 }))
            else {
                return 0;
            };
            a = value;
        } else {
            match () {
                () if is(Op::LoadConstant) => a = it.k,
                () if is(Op::LoadLength) => a = u32::try_from(packet.len()).unwrap(),
                () if is(Op::Recall) => a = memory[slot].expect("memory was written before"),
                () if is(Op::RecallIndex) => x = memory[slot].expect("memory was written before"),
                () if is(Op::IndexConstant) => x = it.k,
                () if is(Op::Store) => memory[slot] = Some(a),
                () if is(Op::StoreIndex) => memory[slot] = Some(x),
                () if is(Op::Add) => a = a.wrapping_add(it.k),
                () if is(Op::AddIndex) => a = a.wrapping_add(x),
                () if is(Op::SubtractIndex) => a = a.wrapping_sub(x),
                () if is(Op::Multiply) => a = a.wrapping_mul(it.k),
                () if is(Op::And) => a &= it.k,
                () if is(Op::ShiftRight) => a >>= it.k,
                () if is(Op::ToIndex) => x = a,
                () => panic!("unknown instruction {it:?}"),
            }
        }
    }
}

const LARGEST: u32 = 60 * 1024 + 8;
const SAMPLES: Samples =
    Samples { largest: LARGEST, repaired: false, any_vendor: false, repeated: false };
const ANY_VENDOR: Samples = Samples { any_vendor: true, repeated: true, ..SAMPLES };

/// With a UDP header, as the filter of a socket sees it.
fn packet(datagram: &[u8]) -> Vec<u8> {
    [&[0; 8][..], datagram].concat()
}

fn passes_shape(shape: Shape, samples: Samples, datagram: &[u8]) -> bool {
    interpret(&program(shape, samples).unwrap(), &packet(datagram)) != 0
}

/// Whether a datagram passes; both shapes must agree.
fn passes_of(samples: Samples, datagram: &[u8]) -> bool {
    let [large, small] = Shape::both(samples).map(|it| passes_shape(it, samples, datagram));
    assert_eq!(large, small, "{datagram:02x?}");
    large
}

/// Whether it passes, whoever may send; all filters must agree.
fn passes(datagram: &[u8]) -> bool {
    let passes = passes_of(SAMPLES, datagram);
    assert_eq!(passes_of(ANY_VENDOR, datagram), passes, "{datagram:02x?}");
    passes
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Endian {
    Little,
    Big,
}

const BOTH: [Endian; 2] = [Endian::Little, Endian::Big];

impl Endian {
    fn half(self, value: u16) -> Vec<u8> {
        match self {
            Self::Little => value.to_le_bytes().into(),
            Self::Big => value.to_be_bytes().into(),
        }
    }

    fn word(self, value: u32) -> Vec<u8> {
        match self {
            Self::Little => value.to_le_bytes().into(),
            Self::Big => value.to_be_bytes().into(),
        }
    }

    fn number(self, value: i64) -> Vec<u8> {
        let bits = value.cast_unsigned();
        let words = [(bits >> 32) as u32, (bits & 0xffff_ffff) as u32];
        words.map(|word| self.word(word)).concat()
    }

    fn submessage(self, kind: u8, body: &[u8]) -> Vec<u8> {
        self.submessage_of(kind, u16::try_from(body.len()).unwrap(), body)
    }

    fn submessage_of(self, kind: u8, length: u16, body: &[u8]) -> Vec<u8> {
        let flags = u8::from(self == Self::Little);
        [&[kind, flags][..], &self.half(length), body].concat()
    }

    fn data(self, bytes: usize) -> Vec<u8> {
        self.submessage(0x15, &vec![0xff; 20 + bytes])
    }

    fn data_frag(self, start: u32, count: u16, size: u16, sample: u32) -> Vec<u8> {
        let body = [
            self.half(0),
            self.half(28),
            vec![1; 8],
            self.number(7),
            self.word(start),
            self.half(count),
            self.half(size),
            self.word(sample),
            vec![9; 256],
        ];
        self.submessage(0x16, &body.concat())
    }

    fn heartbeat(self, first: i64, last: i64) -> Vec<u8> {
        self.submessage(
            0x07,
            &[vec![1; 8], self.number(first), self.number(last), self.word(3)].concat(),
        )
    }

    fn gap(self, start: i64, base: i64) -> Vec<u8> {
        self.submessage(
            0x08,
            &[vec![1; 8], self.number(start), self.number(base), self.word(0)].concat(),
        )
    }

    fn acknack(self, base: i64, bits: u32) -> Vec<u8> {
        self.submessage(
            0x06,
            &[vec![1; 8], self.number(base), self.word(bits), vec![0; 36]].concat(),
        )
    }

    fn nack_frag(self, number: i64, fragment: u32, bits: u32) -> Vec<u8> {
        let body =
            [vec![1; 8], self.number(number), self.word(fragment), self.word(bits), vec![0; 36]];
        self.submessage(0x12, &body.concat())
    }

    fn heartbeat_frag(self, number: i64, last: u32) -> Vec<u8> {
        self.submessage(
            0x13,
            &[vec![1; 8], self.number(number), self.word(last), self.word(1)].concat(),
        )
    }

    fn info_ts(self) -> Vec<u8> {
        self.submessage(0x09, &[0xff; 8])
    }

    fn info_dst(self) -> Vec<u8> {
        self.submessage(0x0e, &[0xff; 12])
    }
}

fn message<T: AsRef<[u8]>>(submessages: &[T]) -> Vec<u8> {
    let mut message = b"RTPS\x02\x04\x01\x12impersonator".to_vec();
    submessages.iter().for_each(|it| message.extend_from_slice(it.as_ref()));
    message
}

#[test]
fn what_rustdds_sends_passes() {
    for e in BOTH {
        let good = [
            vec![e.data(60_000)],
            vec![e.data(32 * 1024 + 8)],
            vec![e.data_frag(1, 1, 256, LARGEST)],
            vec![e.data_frag(236, 5, 256, LARGEST), e.data_frag(241, 1, 256, LARGEST)],
            vec![e.info_ts(), e.data(400), e.heartbeat(1, 1)],
            vec![e.heartbeat(1, 0)],
            vec![e.heartbeat(1, (1 << 20) - 1)],
            vec![e.heartbeat(0x1_0000, 0xffff)],
            vec![e.heartbeat(0x7ff0_0001, 0x7fff_ffff), e.heartbeat(0xfff0_0001, 0xffff_ffff)],
            vec![e.heartbeat((1 << 40) + 1, (1 << 40) + 7), e.acknack((1 << 40) + 8, 0)],
            vec![e.gap(1, 0xffff_fff0)],
            vec![e.info_dst(), e.acknack(1, 256), e.nack_frag(2, 1, 256)],
            vec![e.info_dst(), e.gap(0x1_0000, 0x1_ffff), e.heartbeat(0x1_ffff, 0x2_0001)],
            vec![e.gap(1, 1 << 46)],
            vec![e.heartbeat_frag(1, 240)],
            vec![e.submessage(0x80, &[1, 2, 3]), e.submessage(0x0f, &[0; 4])],
            vec![],
        ];
        for submessages in good {
            let datagram = message(&submessages);
            assert!(passes(&datagram), "{e:?} {:02x?}", &datagram[..datagram.len().min(80)]);
        }
    }
}

#[test]
fn what_exhausts_rustdds_is_dropped_wherever_it_stands() {
    for e in BOTH {
        let bad = [
            e.data_frag(1, 1, 256, 0x1_0000),
            e.data_frag(1, 1, 256, u32::MAX),
            e.data_frag(1, 1, 0, 1024),
            e.data_frag(1, 1, 1, 0xffff),
            e.data_frag(0, 1, 256, 1024),
            e.data_frag(1, 0, 256, 1024),
            e.heartbeat(1, 0x7fff_ffff),
            e.heartbeat(1, 1 << 21),
            e.heartbeat(1, 0x8000_0000),
            e.heartbeat(0x8000_0000, 1),
            e.heartbeat(-5, 1),
            e.heartbeat(-5, -1),
            e.heartbeat(1, i64::MAX),
            e.heartbeat(1 << 47, (1 << 47) + 1),
            e.heartbeat(1, (1 << 32) + 1),
            e.gap(2, 0x7fff_ffff),
            e.gap(2, 1 << 21),
            e.gap(i64::MIN, 1),
            e.gap(1, 1 << 47),
            e.gap((1 << 32) + 1, 1 << 46),
            e.gap((1 << 46) + 1, (1 << 46) + 0x10_0000),
            e.gap(1, -1),
            e.gap((1 << 32) + 2, (1 << 32) + (1 << 21)),
            e.gap(0x0100_0000, 0x7000_0000),
            e.acknack(1, u32::MAX),
            e.acknack(-1, 1),
            e.acknack(1 << 47, 1),
            e.nack_frag(1, 0, 1),
            e.nack_frag(1, u32::MAX, 1),
            e.nack_frag(1, 1024, 1),
            e.nack_frag(1, 1, 1 << 20),
            e.heartbeat_frag(1, u32::MAX),
        ];
        for bad in bad {
            for other in BOTH {
                let alone = message(std::slice::from_ref(&bad));
                assert!(!passes(&alone), "{e:?} {bad:02x?}");
                let after =
                    message(&[other.info_ts(), other.data(100), other.info_dst(), bad.clone()]);
                assert!(!passes(&after), "after {other:?}: {bad:02x?}");
                let before = message(&[bad.clone(), other.data(100)]);
                assert!(!passes(&before), "before {other:?}: {bad:02x?}");
                // Behind submessages without length that are not the last.
                let pad = message(&[
                    other.submessage(0x01, &[]),
                    other.submessage(0x09, &[]),
                    bad.clone(),
                ]);
                assert!(!passes(&pad), "behind {other:?} padding: {bad:02x?}");
                for run in 0..24 {
                    let mut many = vec![other.data(8); run];
                    many.push(bad.clone());
                    let many = message(&many);
                    for samples in [SAMPLES, ANY_VENDOR] {
                        for shape in Shape::both(samples) {
                            let passes = passes_shape(shape, samples, &many);
                            assert!(!passes, "behind {run}: {bad:02x?}");
                        }
                    }
                }
            }
        }
        // Without length it is the last and extends to the end.
        let mut body = e.heartbeat(1, 0x7fff_ffff);
        body[2..4].fill(0);
        assert!(!passes(&message(&[body])));
        let tail = [e.submessage_of(0x0e, 0, &[]), e.heartbeat(1, 0x7fff_ffff)];
        assert!(passes(&message(&tail)), "it belongs to the one before");
    }
}

#[test]
fn malformed_datagrams_are_dropped() {
    let whole = message(&[Endian::Little.data(100), Endian::Big.data_frag(1, 1, 256, 1024)]);
    assert!(passes(&whole));
    for length in 0..whole.len() {
        let cut = &whole[..length];
        // Between two submessages it is a smaller message.
        let complete = length == 20 || length == 20 + 124;
        assert_eq!(passes(cut), complete, "{length} bytes");
    }
    assert!(!passes(b"RTPX\x02\x04\x01\x12impersonator"));
    assert!(!passes(b"GET / HTTP/1.1\r\n\r\n-----------"));
}

#[test]
fn long_runs_of_data_pass_up_to_the_number_of_steps() {
    let run = |count: usize| {
        let mut submessages = vec![Endian::Little.data(40); count];
        submessages.push(Endian::Little.heartbeat(1, 100));
        message(&submessages)
    };
    let steps = |shape: Shape| shape.first + shape.quick + shape.packed + shape.last;
    for samples in [SAMPLES, ANY_VENDOR] {
        for shape in Shape::both(samples) {
            // The heartbeat is the last step.
            assert!(passes_shape(shape, samples, &run(steps(shape) - 1)));
            assert!(!passes_shape(shape, samples, &run(steps(shape))));
            let mut hidden = vec![Endian::Little.data(40); steps(shape) - 1];
            hidden.push(Endian::Little.heartbeat(1, 0x7fff_ffff));
            assert!(!passes_shape(shape, samples, &message(&hidden)));
        }
    }
    // What a packet of 1500 bytes takes, with a time for each.
    let packet = vec![[Endian::Little.info_ts(), Endian::Little.data(64)].concat(); 11];
    assert!(passes_of(SAMPLES, &message(&packet)));
}

/// Whatever passes, RustDDS reads nothing in it that it must not.
#[test]
fn random_messages_agree_with_a_plain_walk() {
    let mut state = 0x2545_f491_4f6c_dd1d_u64;
    let mut random = |limit: u64| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state % limit
    };
    let edges: [i64; 11] =
        [0, 1, 2, 0x100, 0xffff, 0x1_0000, 0x10_0000, 0x8000_0000, 1 << 32, (1 << 32) + 1, 1 << 46];
    let (mut passed, mut dropped) = (0, 0);
    for _ in 0..20_000 {
        let mut submessages = Vec::new();
        let mut good = true;
        // As many as each shape has full steps.
        for _ in 0..random(4) {
            let e = BOTH[random(2) as usize];
            let mut number = || edges[random(edges.len() as u64) as usize];
            let (first, second) = (number(), number());
            let width = (second >> 16) - (first >> 16);
            let same_upper_word = first >> 32 == second >> 32;
            match random(5) {
                0 => submessages.push(e.data(random(90) as usize)),
                1 => submessages.push(e.info_ts()),
                2 => {
                    submessages.push(e.heartbeat(first, second));
                    good &= same_upper_word && (-1..=15).contains(&width);
                }
                3 => {
                    submessages.push(e.gap(first, second));
                    good &= (same_upper_word && (-1..=1).contains(&width)) || first == 1;
                }
                _ => {
                    let bytes = u32::try_from(first).unwrap_or(u32::MAX);
                    submessages.push(e.data_frag(1, 1, 256, bytes));
                    good &= bytes < 0x1_0000;
                }
            }
        }
        let datagram = message(&submessages);
        assert_eq!(passes(&datagram), good, "{datagram:02x?}");
        *(if good { &mut passed } else { &mut dropped }) += 1;
    }
    assert!(passed > 1000 && dropped > 1000, "{passed} passed, {dropped} dropped");
}

#[test]
fn the_kernels_list_is_read() {
    let line = "  512: 0100007F:306B 00000000:0000 07 00000000:00000000 00:00000000 00000000     0        0 4711 2 \
                0000000000000000 23";
    let address = Ipv4Addr::LOCALHOST;
    let expected = UdpSocketLine { address, port: 12_395, inode: 4711, dropped: 23 };
    assert_eq!(UdpSocketLine::parse(line), Some(expected));
    assert_eq!(UdpSocketLine::parse("  sl  local_address rem_address   st tx_queue"), None);
    assert_eq!(UdpSocketLine::parse(""), None);
}

/// The same datagrams as above through sockets that have a filter.
#[test]
fn the_kernel_takes_the_filters_and_drops_what_it_must() {
    for samples in [SAMPLES, ANY_VENDOR] {
        let receiver = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        receiver.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
        let port = receiver.local_addr().unwrap().port();
        let attached = attach(&[port], samples).unwrap();
        let quick = Shape::both(samples)[usize::from(attached.is_small)].quick;
        let sender = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let send = |datagram: &[u8]| sender.send_to(datagram, (Ipv4Addr::LOCALHOST, port)).unwrap();
        let mut buffer = vec![0; 65_536];
        let mut received = |datagram: Vec<u8>| {
            send(&datagram);
            let length = receiver.recv(&mut buffer).unwrap();
            assert_eq!(buffer[..length], datagram);
        };
        for e in BOTH {
            let before = attached.dropped();
            let bad = [
                e.heartbeat(1, 0x7fff_ffff),
                e.gap(2, 1 << 30),
                e.data_frag(1, 1, 256, 1 << 24),
                e.nack_frag(1, u32::MAX, 1),
            ];
            for bad in &bad {
                send(&message(&[bad]));
            }
            received(message(&[e.data(60_000)]));
            let last = [e.info_ts(), e.data_frag(1, 1, 256, LARGEST), e.heartbeat(1, 9)];
            received(message(&last));
            assert_eq!(attached.dropped() - before, bad.len() as u64);
        }
        received(message(&vec![Endian::Little.data(40); quick]));
    }
    assert!(attach(&[1], SAMPLES).is_err(), "no socket of this process has port 1");
}

#[test]
fn fragments_of_large_samples_are_asked_for_where_they_are_repaired() {
    let samples =
        |repaired| Samples { largest: 16 << 20, repaired, any_vendor: false, repeated: false };
    for e in BOTH {
        for (fragment, passes) in [(1, true), (1023, true), (1024, false), (65_535, false)] {
            let packet = message(&[e.nack_frag(1, fragment, 1)]);
            assert_eq!(passes_of(samples(false), &packet), passes, "{fragment}");
            assert!(passes_of(samples(true), &packet), "{fragment}");
        }
        assert!(!passes_of(samples(true), &message(&[e.nack_frag(1, 1 << 17, 1)])));
    }
}

/// Fast DDS 2.14 and Cyclone 11 were seen to send most of these.
#[test]
fn what_other_implementations_send_passes_only_where_they_are_expected() {
    let e = Endian::Little;
    let (to, at, own) = (e.info_dst(), e.info_ts(), e.submessage(0x80, &[1; 4]));
    let fragment = e.data_frag(1, 1, 1344, LARGEST);
    let large_fragment = e.data_frag(1, 1, 65_324, 65_400);
    let more = e.heartbeat_frag(7, 10);
    let many =
        |first: &Vec<u8>, one: Vec<u8>, count| [vec![first.clone()], vec![one; count]].concat();
    let announced = [many(&to, [at.clone(), e.data(210)].concat(), 58), vec![e.heartbeat(1, 60)]];
    let asked = [many(&to, e.nack_frag(7, 1, 256), 12), vec![e.acknack(6, 0), own.clone()]];
    let ends = [e.heartbeat(1, 7), own.clone()];
    let two = [at.clone(), fragment.clone(), more, at.clone(), fragment.clone(), e.heartbeat(1, 7)];
    // Whether the small filter passes it, and that of RustDDS.
    let foreign = [
        (true, false, vec![at.clone(), fragment]),
        (true, false, [vec![at.clone(), large_fragment.clone()], ends.to_vec()].concat()),
        (true, false, [vec![to.clone(), at.clone(), large_fragment], ends.to_vec()].concat()),
        (true, false, two.to_vec()),
        (false, true, announced.concat()),
        (false, false, many(&to, e.heartbeat(1, 1), 24)),
        (false, false, many(&to, [e.data(40), e.gap(9, 19)].concat(), 12)),
        (false, false, asked.concat()),
        (true, true, vec![to, e.gap(7, 0x1_ffff), e.heartbeat(1 << 20, 1 << 20)]),
        (true, true, vec![at, e.data(40), own, e.heartbeat(1, 1)]),
    ];
    for (number, (small, rustdds, submessages)) in foreign.into_iter().enumerate() {
        let datagram = message(&submessages);
        let passes = |shape: Shape, samples| passes_shape(shape, samples, &datagram);
        let shapes = Shape::both(ANY_VENDOR).map(|shape| passes(shape, ANY_VENDOR));
        assert_eq!(shapes, [true, small], "{number}");
        assert_eq!(passes(Shape::both(SAMPLES)[0], SAMPLES), rustdds, "{number}");
    }
    for e in BOTH {
        assert!(passes_of(ANY_VENDOR, &message(&[e.data_frag(1, 1, 300, 1024)])));
        assert!(!passes_of(ANY_VENDOR, &message(&[e.data_frag(1, 1, 255, 1024)])));
    }
}

/// A DATA of the writer of announcements, or another.
fn data_of(writer: [u8; 4]) -> Vec<u8> {
    let body = [&[0, 0, 16, 0, 0, 1, 0, 0xc7][..], &writer, &[0; 8], &[0xff; 200]].concat();
    Endian::Little.submessage(0x15, &body)
}

#[test]
fn announcements_are_told_from_all_else() {
    let e = Endian::Little;
    let (spdp, sedp) = (data_of([0, 1, 0, 0xc2]), data_of([0, 0, 3, 0xc2]));
    let (time, to, source) = (e.info_ts(), e.info_dst(), e.submessage(0x0c, &[0; 20]));
    let [large, small] = Shape::both(ANY_VENDOR);
    let is_announcement = |submessages: &[&Vec<u8>]| {
        let datagram = message(submessages);
        let whole = 1 << 18;
        let kept = interpret(&program(large, ANY_VENDOR).unwrap(), &packet(&datagram));
        assert_eq!(interpret(&program(small, ANY_VENDOR).unwrap(), &packet(&datagram)), kept);
        let unrepeated = Samples { repeated: false, ..ANY_VENDOR };
        let program = program(large, unrepeated).unwrap();
        assert_eq!(interpret(&program, &packet(&datagram)), whole);
        let is_one = interpret(&announcements().unwrap(), &packet(&datagram)) != 0;
        assert_eq!(interpret(&steering().unwrap(), &datagram), u32::from(is_one));
        assert_eq!(kept, if is_one { 28 } else { whole }, "the headers of UDP and RTPS");
        is_one
    };
    for begin in [&[][..], &[&time], &[&to], &[&to, &time], &[&time, &to]] {
        for (data, expected) in [(&spdp, true), (&sedp, false)] {
            assert_eq!(is_announcement(&[begin, &[data]].concat()), expected);
        }
    }
    assert!(!is_announcement(&[&source, &time, &spdp]), "it is repeated");
    assert!(!is_announcement(&[]));
    assert!(!is_announcement(&[&time]));
    for length in 0..48 {
        let cut = &message(&[&time, &spdp])[..length];
        assert_eq!(interpret(&announcements().unwrap(), &packet(cut)), 0);
        assert_eq!(interpret(&steering().unwrap(), cut), 0);
    }
    let foreign = [&b"RTPX"[..], &message(&[&spdp])[4..]].concat();
    assert_eq!(interpret(&steering().unwrap(), &foreign), 0);
}

/// As the multicast sockets of two participants of one process.
#[test]
fn a_socket_that_has_a_filter_gets_the_large_one_again() {
    let receiver = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let port = receiver.local_addr().unwrap().port();
    for samples in [SAMPLES, ANY_VENDOR, SAMPLES] {
        let first = attach(&[port], samples).unwrap().is_small;
        assert_eq!(attach(&[port], samples).unwrap().is_small, first);
    }
}
