//! Garbage at all DDS ports of a process, on the link and on a ROS 2 network, while another one
//! receives messages from it.

use std::collections::BTreeSet;
use std::net::{Ipv4Addr, UdpSocket};
use std::time::{Duration, Instant};

use blaze_brokers::dds::{Participant, ParticipantConfig, Profile, Writer};
use blaze_tests::admin::Admin;
use blaze_tests::flow::free_domain;
use blaze_tests::process::Process;
use blaze_tests::wait;
use rand::rngs::StdRng;
use rand::{Rng as _, RngExt as _, SeedableRng as _};

const DEADLINE: Duration = Duration::from_secs(20);
/// After the storm the two must have found each other again; RustDDS alone repeats its announcements every 10 s.
const RECOVERY: Duration = Duration::from_secs(25);
/// Datagrams of a storm; the full count with `--long`.
const STORM: usize = 20_000;
const MAX_RESIDENT: u64 = 400 * 1024 * 1024;

/// The UDP ports that a process holds.
fn udp_ports(process: &Process) -> BTreeSet<u16> {
    let folder = format!("/proc/{}/fd", process.id());
    let inodes: BTreeSet<String> = std::fs::read_dir(folder)
        .unwrap()
        .filter_map(|entry| std::fs::read_link(entry.ok()?.path()).ok())
        .filter_map(|link| {
            Some(link.to_str()?.strip_prefix("socket:[")?.trim_end_matches(']').to_owned())
        })
        .collect();
    let table = std::fs::read_to_string("/proc/net/udp").unwrap();
    let port = |line: &str| {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let local = fields.get(1)?.rsplit(':').next()?;
        inodes.contains(*fields.get(9)?).then(|| u16::from_str_radix(local, 16).ok())?
    };
    table.lines().skip(1).filter_map(port).collect()
}

/// Announcements of the participants of a domain, as a newcomer hears them.
fn announcements(domain: u16) -> Vec<Vec<u8>> {
    let base = 7400 + 250 * domain;
    let ear = (1..12)
        .rev()
        .find_map(|slot| UdpSocket::bind((Ipv4Addr::LOCALHOST, base + 10 + 2 * slot)).ok())
        .unwrap();
    ear.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
    let mut heard = Vec::new();
    let mut buffer = vec![0; 65_536];
    wait::until(
        "announcements",
        Duration::from_secs(15),
        || {
            if let Ok((length, _)) = ear.recv_from(&mut buffer) {
                heard.push(buffer[..length].to_vec());
            }
            heard.len() >= 2
        },
        || "nothing was heard".into(),
    )
    .unwrap();
    heard
}

fn noise(random: &mut StdRng, count: usize) -> Vec<u8> {
    let mut bytes = vec![0; count];
    random.fill_bytes(&mut bytes);
    bytes
}

/// What RTPS knows, well formed but for its contents. Fragments, heartbeats and gaps have tests of their own.
fn submessages(random: &mut StdRng) -> Vec<u8> {
    let mut datagram = b"RTPS\x02\x04\x01\x12".to_vec();
    datagram.extend(noise(random, 12));
    for _ in 0..=random.random_range(0..4) {
        let kinds = [0x01, 0x06, 0x09, 0x0c, 0x0d, 0x0e, 0x0f, 0x12, 0x15, 0x80];
        let kind = kinds[random.random_range(0..kinds.len())];
        let length = random.random_range(0..300);
        datagram.extend([kind, random.random()]);
        datagram.extend(u16::try_from(length).unwrap().to_le_bytes());
        // Known entities now and then: discovery's writers and readers.
        let mut body = noise(random, length);
        if length > 12 && random.random_range(0..2) == 0 {
            let entities = [[0, 1, 0, 0xc2], [0, 3, 0, 0xc2], [0, 4, 0, 0xc2], [0, 2, 0, 0xc2]];
            body[4..8].copy_from_slice(&[0, 0, 0, 0]);
            body[8..12].copy_from_slice(&entities[random.random_range(0..4)]);
        }
        datagram.extend(body);
    }
    datagram
}

/// Whether a datagram holds a fragment, heartbeat or gap.
fn is_for_others(datagram: &[u8]) -> bool {
    let mut at = 20;
    while let Some(head) = datagram.get(at..at + 4) {
        if matches!(head[0], 0x07 | 0x08 | 0x13 | 0x16) {
            return true;
        }
        let little = u16::from_le_bytes([head[2], head[3]]);
        let length = if head[1] & 1 == 1 { little } else { little.swap_bytes() };
        if length == 0 {
            return false;
        }
        at += 4 + usize::from(length);
    }
    false
}

fn garbage(random: &mut StdRng, heard: &[Vec<u8>]) -> Vec<u8> {
    let mut datagram = heard[random.random_range(0..heard.len())].clone();
    match random.random_range(0..6) {
        0 => {
            let length = random.random_range(0..2000);
            datagram = noise(random, length);
        }
        1 => datagram.truncate(random.random_range(0..=datagram.len())),
        2 => return submessages(random),
        3 => {
            // The announcement of a participant that is not there.
            let prefix = noise(random, 12);
            let own = datagram[8..20].to_vec();
            for from in 0..datagram.len() - 12 {
                if datagram[from..from + 12] == own[..] {
                    datagram[from..from + 12].copy_from_slice(&prefix);
                }
            }
        }
        _ => {
            for _ in 0..=random.random_range(0..8) {
                let at = random.random_range(0..datagram.len());
                datagram[at] = random.random();
            }
        }
    }
    datagram
}

/// Messages that left bridges towards a layer broker.
fn delivered(admin: &Admin) -> f64 {
    let name = "blaze_flow_messages_total";
    admin.metric(name, &["topic=\"imu/data\"", "direction=\"out\"", "to=\"layer\""]).unwrap_or(0.0)
}

/// A ROS 2 node with a writer comes, and the flow finds it.
fn meet_a_node(domain: u16, admin: &Admin, process: &Process) -> (Participant, Writer) {
    let found = || {
        let labels = ["kind=\"publisher\""];
        admin.metric("blaze_ros2_endpoints", &labels).unwrap_or(0.0)
    };
    let before = found();
    let node = Participant::start(ParticipantConfig::new(domain, Ipv4Addr::LOCALHOST)).unwrap();
    let topic = ("rt/met", "std_msgs::msg::dds_::UInt8_");
    let writer = node.typed_writer(topic, Profile::best_effort(1)).unwrap();
    wait::until("a node is found", RECOVERY, || found() > before, || process.tail()).unwrap();
    (node, writer)
}

#[test]
fn a_storm_of_datagrams_leaves_the_processes_alive_and_messages_flow() {
    let [domain, ros_domain] = [(); 2].map(|()| free_domain().unwrap());
    let link = format!("brokers.inter.dds.domain={domain}");
    let ros2 = format!("brokers.plugins=[{{ros2: {{domain: {ros_domain}}}}}]");
    let arguments = |node| vec!["demo", "--only", node, "--duration", "10m", "--set", &link];
    let mut on_ros2 = arguments("robot-1");
    on_ros2.extend(["--set", &ros2]);
    let mut robot = Process::start("blaze", &on_ros2, None).unwrap();
    let mut fog = Process::start("blaze", &arguments("fog-1"), None).unwrap();
    let robot_admin = robot.node_ready("robot-1", DEADLINE).unwrap();
    let fog_admin = fog.node_ready("fog-1", DEADLINE).unwrap();
    let flow = |deadline, when: &str, fog: &Process| {
        let before = delivered(&fog_admin);
        wait::until(when, deadline, || delivered(&fog_admin) >= before + 30.0, || fog.tail())
            .unwrap()
    };
    flow(DEADLINE, "messages flow before", &fog);
    let _early = meet_a_node(ros_domain, &robot_admin, &robot);
    let heard = [domain, ros_domain].map(announcements).concat();
    let ports: Vec<u16> = udp_ports(&robot).union(&udp_ports(&fog)).copied().collect();
    assert!(ports.len() >= 4, "two processes hold {ports:?}");
    let before = [robot.resident_bytes().unwrap(), fog.resident_bytes().unwrap()];

    let mut random = StdRng::seed_from_u64(2026);
    let sender = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let begin = Instant::now();
    let count = if blaze_tests::long() { 20 * STORM } else { STORM };
    let mut sent = 0;
    while sent < count {
        let datagram = garbage(&mut random, &heard);
        if is_for_others(&datagram) {
            continue;
        }
        let port = ports[random.random_range(0..ports.len())];
        let _ = sender.send_to(&datagram, (Ipv4Addr::LOCALHOST, port));
        sent += 1;
        if sent % 500 == 0 {
            assert!(robot.runs(), "after {sent}: {}", robot.tail());
            assert!(fog.runs(), "after {sent}: {}", fog.tail());
        }
    }
    let storm = begin.elapsed();
    let recovered = flow(RECOVERY, "messages flow again", &fog);
    meet_a_node(ros_domain, &robot_admin, &robot);
    for (name, process, admin) in
        [("robot-1", &mut robot, &robot_admin), ("fog-1", &mut fog, &fog_admin)]
    {
        assert!(process.runs(), "{}", process.tail());
        wait::until("ready", DEADLINE, || admin.ready(), || process.tail()).unwrap();
        let bytes = process.resident_bytes().unwrap();
        assert!(bytes < MAX_RESIDENT, "{name}: {bytes} bytes, before {before:?}");
        let label = ["event=\"participant_rebuilt\""];
        let rebuilt = admin.metric("blaze_flow_link_events_total", &label);
        eprintln!("{name}: {} MiB, rebuilt {rebuilt:?}", bytes >> 20);
    }
    eprintln!(
        "{sent} datagrams to {} ports in {storm:?}; messages flowed again after {recovered:?}",
        ports.len()
    );
    for process in [&mut robot, &mut fog] {
        process.terminate(DEADLINE).unwrap();
    }
}
