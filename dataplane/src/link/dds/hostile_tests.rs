//! Hostile datagrams at all ports of a flow: it must go on, or be rebuilt, and serve others
//! afterwards.

use std::net::{Ipv4Addr, UdpSocket};
use std::process::Command;
use std::time::Duration;

use super::tests::{DISCOVERY, endpoint, free_domain, start, wait_for};
use super::*;
use crate::testing::Random;

const PREFIX: std::ops::Range<usize> = 8..20;

/// Tells the test that its process is its own.
const ALONE: &str = "BLAZE_TEST_ALONE";

/// Makes the announcement of a participant into one of `prefix` that takes everything at `port`.
fn impersonate(announcement: &[u8], prefix: &[u8], ports: &[u16], port: u16) -> Vec<u8> {
    let own = announcement[PREFIX].to_vec();
    let mut forged = announcement.to_vec();
    for at in 0..forged.len().saturating_sub(12) {
        if forged[at..at + 12] == own[..] {
            forged[at..at + 12].copy_from_slice(prefix);
        }
    }
    for at in 0..forged.len().saturating_sub(4) {
        let found = u32::from_le_bytes(forged[at..at + 4].try_into().unwrap());
        if ports.iter().any(|known| u32::from(*known) == found) {
            forged[at..at + 4].copy_from_slice(&u32::from(port).to_le_bytes());
        }
    }
    forged
}

/// Real datagrams of the flows of a domain: announcements, and what they tell a participant that
/// announces itself.
fn capture(domain: u16) -> Vec<Vec<u8>> {
    let base = 7400 + 250 * domain;
    let ear = (1..12)
        .rev()
        .find_map(|slot| UdpSocket::bind((Ipv4Addr::LOCALHOST, base + 10 + 2 * slot)).ok())
        .unwrap();
    ear.set_read_timeout(Some(Duration::from_millis(20))).unwrap();
    let port = ear.local_addr().unwrap().port();
    let mut buffer = vec![0; 65_536];
    // A newcomer makes the others announce themselves at once.
    let newcomer = start(domain, "edge/newcomer", 1);
    let announcement = wait_for("announcement", Duration::from_secs(11), || {
        let (length, _) = ear.recv_from(&mut buffer).ok()?;
        Some(buffer[..length].to_vec())
    });
    let ports: Vec<u16> =
        (0..12).flat_map(|slot| [base + 10 + 2 * slot, base + 11 + 2 * slot]).collect();
    let forged = impersonate(&announcement, b"impersonator", &ports, port);
    let mut captured = vec![announcement, forged.clone()];
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_secs(1) {
        for port in ports.iter().step_by(2) {
            ear.send_to(&forged, (Ipv4Addr::LOCALHOST, *port)).ok();
        }
        while let Ok((length, _)) = ear.recv_from(&mut buffer) {
            captured.push(buffer[..length].to_vec());
        }
    }
    drop(newcomer);
    captured
}

/// User data as RustDDS writes them, to any reader of the topic, whole and as fragment.
fn user_data(prefix: &[u8]) -> Vec<Vec<u8>> {
    let mut header = b"RTPS\x02\x04\x01\x12".to_vec();
    header.extend_from_slice(prefix);
    let submessage = |id: u8, flags: u8, fields: &[u8], payload: &[u8]| {
        let mut message = header.clone();
        message.extend_from_slice(&[id, flags]);
        message
            .extend_from_slice(&u16::try_from(fields.len() + payload.len()).unwrap().to_le_bytes());
        message.extend_from_slice(fields);
        message.extend_from_slice(payload);
        message
    };
    let payload = b"\0\x01\0\0\x08\0\0\0blaze123";
    let ids = b"\0\0\x10\0\0\0\0\0\0\0\0\x03\0\0\0\0\x01\0\0\0";
    let fragment = [
        &b"\0\0\x1c\0\0\0\0\0\0\0\0\x03\0\0\0\0\x01\0\0\0"[..],
        b"\x01\0\0\0\x01\0\x10\0\x10\0\0\0",
    ]
    .concat();
    vec![submessage(0x15, 0x05, ids, payload), submessage(0x16, 0x01, &fragment, payload)]
}

/// A datagram that was changed in one of the ways that find faults in parsers.
fn mutate(random: &mut Random, captured: &[Vec<u8>]) -> Vec<u8> {
    let mut datagram = captured[random.index(captured.len())].clone();
    match random.index(6) {
        0 => datagram.truncate(random.index(datagram.len() + 1)),
        1 => {
            let length = random.index(1500);
            datagram = random.bytes(length);
        }
        2 => {
            let length = random.index(200);
            datagram.truncate(20);
            datagram.extend(random.bytes(length));
        }
        3 => {
            // Lengths, counts and numbers at their limits.
            let at = 20 + random.index(datagram.len().saturating_sub(24));
            let extreme = [0, 0xff, 0x7f, 0x80][random.index(4)];
            let end = (at + 1 + random.index(8)).min(datagram.len());
            if let Some(bytes) = datagram.get_mut(at..end) {
                bytes.fill(extreme);
            }
        }
        4 => {
            let other = &captured[random.index(captured.len())];
            let cut = 20 + random.index(datagram.len().saturating_sub(20));
            datagram.truncate(cut);
            datagram.extend_from_slice(other.get(20..).unwrap_or_default());
        }
        _ => {
            for _ in 0..=random.index(8) {
                let at = random.index(datagram.len());
                if let Some(byte) = datagram.get_mut(at) {
                    *byte = random.byte();
                }
            }
        }
    }
    datagram
}

/// Datagrams that make an unprotected RustDDS 0.15 allocate up to gigabytes each, in the name of
/// every writer and reader of discovery that a participant has.
fn bombs(prefix: &[u8], random: &mut Random) -> Vec<Vec<u8>> {
    let little = random.index(2) == 0;
    let half = |value: u16| {
        if little { value.to_le_bytes() } else { value.to_be_bytes() }
    };
    let word = |value: u32| {
        if little { value.to_le_bytes() } else { value.to_be_bytes() }
    };
    let number =
        |value: u64| [word((value >> 32) as u32), word((value & 0xffff_ffff) as u32)].concat();
    let count = (random.next() & 0x7fff_ffff) as u32;
    let mut bombs = Vec::new();
    let mut add = |kind: u8, fields: &[&[u8]]| {
        let body = fields.concat();
        let mut message = b"RTPS\x02\x04\x01\x12".to_vec();
        message.extend_from_slice(prefix);
        message.extend_from_slice(&[kind, u8::from(little)]);
        message.extend_from_slice(&half(u16::try_from(body.len()).unwrap()));
        message.extend_from_slice(&body);
        bombs.push(message);
    };
    // Topics, publications, subscriptions, liveliness of participants: reader and writer.
    for id in [b"\0\0\x02", b"\0\0\x03", b"\0\0\x04", b"\0\x02\0"] {
        let ids = [&id[..], &[0xc7], &id[..], &[0xc2]].concat();
        let sequence = number(1 + random.next() % 1000);
        add(0x07, &[&ids, &number(1), &number(0x7fff_ffff), &word(count)]);
        add(0x07, &[&ids, &number(1 << 40), &number((1 << 40) + (1 << 31)), &word(count)]);
        add(0x08, &[&ids, &number(1000), &number(0x7fff_0000), &word(0)]);
        add(0x12, &[&ids, &sequence, &word(0xffff_fff0), &word(8), &word(u32::MAX), &word(count)]);
        let fragment =
            [&half(0)[..], &half(28), &ids, &sequence, &word(1), &half(1), &half(256)].concat();
        add(0x16, &[&fragment, &word(0xffff_ff00), &[0; 256]]);
        add(0x16, &[&fragment, &word(256 << 20), &[0; 256]]);
    }
    bombs
}

/// Memory of this process in bytes: now, and the most that it ever had.
fn resident() -> (u64, u64) {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let field = |name: &str| -> u64 {
        let line = status.lines().find_map(|line| line.strip_prefix(name)).unwrap();
        line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() * 1024
    };
    (field("VmRSS:"), field("VmHWM:"))
}

#[test]
fn hostile_datagrams_do_not_end_a_flow() {
    // The most memory that a process ever had is that of all tests in it.
    if blaze_runtime::environment::variable(ALONE).is_some() {
        return attack();
    }
    let output = Command::new(std::env::current_exe().unwrap())
        .args([
            "--exact",
            "link::dds::hostile_tests::hostile_datagrams_do_not_end_a_flow",
            "--nocapture",
        ])
        .env(ALONE, "1")
        .output()
        .unwrap();
    let [said, complaint] =
        [&output.stdout, &output.stderr].map(|bytes| String::from_utf8_lossy(bytes));
    println!("{said}");
    assert!(output.status.success() && said.contains("1 passed"), "{}: {complaint}", output.status);
}

fn attack() {
    let domain = free_domain();
    let robot = start(domain, "edge/robot-1", 1);
    let fog = start(domain, "fog/fog-1", 1);
    robot.wait_discovered(&fog.endpoint, DISCOVERY);
    let mut captured = capture(domain);
    let known: Vec<Vec<u8>> = captured.iter().map(|datagram| datagram[PREFIX].to_vec()).collect();
    known.iter().for_each(|prefix| captured.extend(user_data(prefix)));
    assert!(captured.len() > 20, "only {} datagrams were captured", captured.len());
    let seed = 0x2545_f491_4f6c_dd1d;
    let mut random = Random(seed);
    let attacker = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let base = 7400 + 250 * domain;
    let targets: Vec<u16> = [base, base + 1].into_iter().chain(base + 10..base + 34).collect();
    let (before, _) = resident();
    let filtered = robot.transport.status().dropped_by_kernel;
    let begin = Instant::now();
    let mut sent = 0_u64;
    while begin.elapsed() < Duration::from_secs(3) {
        let mut datagrams = vec![mutate(&mut random, &captured)];
        if random.index(20) == 0 {
            let prefix = &known[random.index(known.len())];
            datagrams.extend(bombs(prefix, &mut random));
        }
        for (datagram, port) in
            datagrams.iter().flat_map(|it| targets.iter().map(move |port| (it, port)))
        {
            attacker.send_to(datagram, (Ipv4Addr::LOCALHOST, *port)).ok();
            sent += 1;
        }
        // Below what the receivers take, so that they look at every datagram.
        if sent % 256 < targets.len() as u64 {
            std::thread::sleep(Duration::from_millis(2));
        }
    }
    let (after, most) = resident();
    let grown = most.saturating_sub(before) >> 20;
    let rebuilds = robot.transport.status().rebuilds + fog.transport.status().rebuilds;
    // A participant that is made anew has no filter for some milliseconds, in which each bomb takes
    // half a gigabyte.
    assert!(
        grown < if rebuilds > 0 { 8 * 1024 } else { 64 },
        "memory grew by {grown} MiB, {} MiB remain, {rebuilds} rebuilds",
        after.saturating_sub(before) >> 20
    );
    // A newcomer finds the flow, whatever life it is in, and reaches it.
    let cloud = start(domain, "cloud/cloud-1", 1);
    let life = wait_for("the flow after the attack", Duration::from_secs(30), || {
        let found = |epoch| endpoint("edge/robot-1", epoch);
        let events = cloud.events.lock();
        (1..100).map(found).rev().find(|it| {
            events
                .iter()
                .any(|event| matches!(event, TransportEvent::Discovered(other) if other == it))
        })
    });
    cloud.reach(&robot, &life);
    let filtered = wait_for("a count of what was filtered", Duration::from_secs(3), || {
        let status = robot.transport.status();
        (status.dropped_by_kernel > filtered).then(|| status.dropped_by_kernel - filtered)
    });
    assert_eq!(robot.transport.status().detail, "");
    println!(
        "{sent} datagrams from {} captured, seed {seed:#x}: {} rebuilds, robot now {life}, \
         {filtered} \
         filtered, memory {grown} MiB more",
        captured.len(),
        robot.transport.status().rebuilds
    );
}
