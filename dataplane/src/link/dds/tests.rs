use bytes::Bytes;
use std::net::{Ipv4Addr, UdpSocket};
use std::time::Duration;

use super::*;
use blaze_brokers::dds::Fault;

/// A transport and all that it told.
pub(super) struct Flow {
    pub(super) transport: DdsTransport,
    pub(super) events: Arc<Mutex<Vec<TransportEvent>>>,
    pub(super) endpoint: Endpoint,
}

pub(super) fn endpoint(name: &str, epoch: u64) -> Endpoint {
    Endpoint { flow: name.parse().unwrap(), epoch }
}

pub(super) fn start(domain: u16, name: &str, epoch: u64) -> Flow {
    let events = Arc::<Mutex<Vec<TransportEvent>>>::default();
    let log = Arc::clone(&events);
    let lives = Arc::new(AtomicU64::new(epoch));
    let transport = DdsTransport::start(DdsConfig {
        domain,
        listen: IpAddr::V4(Ipv4Addr::LOCALHOST),
        peers: vec![],
        peer_slots: 4,
        mtu: 1500,
        chunking: Chunking::Mtu,
        local: endpoint(name, epoch),
        next_epoch: Arc::new(move || lives.fetch_add(1, Ordering::Relaxed) + 1),
        sink: Arc::new(move |event| log.lock().push(event)),
    })
    .unwrap();
    Flow { transport, events, endpoint: endpoint(name, epoch) }
}

/// A domain whose ports nobody holds; tests run side by side.
pub(super) fn free_domain() -> u16 {
    loop {
        let domain = rand::random_range(0..40);
        let base = 7400 + 250 * domain;
        let free = |port| UdpSocket::bind((Ipv4Addr::UNSPECIFIED, port)).is_ok();
        if free(base) && (0..12).all(|slot| free(base + 10 + 2 * slot)) {
            return domain;
        }
    }
}

pub(super) fn wait_for<T>(what: &str, limit: Duration, mut look: impl FnMut() -> Option<T>) -> T {
    let begin = Instant::now();
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(begin.elapsed() < limit, "no {what} within {limit:?}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

impl Flow {
    pub(super) fn wait_discovered(&self, other: &Endpoint, limit: Duration) {
        wait_for(&format!("discovery of {other}"), limit, || {
            let events = self.events.lock();
            events
                .iter()
                .any(|event| matches!(event, TransportEvent::Discovered(found) if found == other))
                .then_some(())
        });
    }

    fn received(&self, class: Priority) -> Vec<Bytes> {
        let events = self.events.lock();
        let of_class = |event: &TransportEvent| match event {
            TransportEvent::Received { class: of, datagram } if *of == class => {
                Some(datagram.clone())
            }
            _ => None,
        };
        events.iter().filter_map(of_class).collect()
    }

    /// Connects, and waits until datagrams arrive there.
    pub(super) fn reach(&self, other: &Flow, to: &Endpoint) {
        self.transport.connect(to);
        for class in Priority::ALL {
            wait_for("first datagram", Duration::from_secs(5), || {
                let _ = self.transport.send(to, *class, b"first");
                other
                    .received(*class)
                    .iter()
                    .any(|datagram| &datagram[..] == b"first")
                    .then_some(())
            });
        }
    }
}

pub(super) const DISCOVERY: Duration = Duration::from_secs(10);

#[test]
fn topics_name_endpoint_and_class() {
    let robot = endpoint("edge/robot-1", 17);
    let name = topic(&robot, Priority::Bulk);
    assert_eq!(name, "blaze/link/edge/robot-1/17/bulk");
    assert_eq!(parse_topic(&name), Some((robot, Priority::Bulk)));
    for bad in [
        "blaze/link/edge/robot-1/17",
        "blaze/link/edge/robot-1/x/bulk",
        "blaze/link/e/r/1/bulk/x",
        "rt/a",
    ] {
        assert_eq!(parse_topic(bad), None, "{bad}");
    }
}

#[test]
fn a_listen_address_must_be_one_interface() {
    for bad in ["0.0.0.0", "239.1.1.1", "::1"] {
        let config = DdsConfig {
            listen: bad.parse().unwrap(),
            ..start(free_domain(), "edge/robot-1", 1).transport.shared.config.clone()
        };
        assert!(matches!(DdsTransport::start(config), Err(DdsError::Address(_))), "{bad}");
    }
}

#[test]
fn two_flows_of_one_host_meet_and_exchange_all_classes_in_order() {
    let domain = free_domain();
    let robot = start(domain, "edge/robot-1", 1);
    let fog = start(domain, "fog/fog-1", 1);
    robot.wait_discovered(&fog.endpoint, DISCOVERY);
    fog.wait_discovered(&robot.endpoint, DISCOVERY);
    robot.reach(&fog, &fog.endpoint);
    let size = robot.transport.shared.wire.max_datagram_bytes();
    for class in Priority::ALL {
        for number in 0..200_u32 {
            let mut datagram = vec![0; size];
            datagram[..4].copy_from_slice(&number.to_le_bytes());
            assert_eq!(robot.transport.send(&fog.endpoint, *class, &datagram), SendOutcome::Sent);
        }
        let numbers = wait_for("all datagrams", Duration::from_secs(5), || {
            let received = fog.received(*class);
            let numbers: Vec<u32> = received
                .iter()
                .filter(|datagram| datagram.len() == size)
                .map(|datagram| u32::from_le_bytes(datagram[..4].try_into().unwrap()))
                .collect();
            (numbers.len() >= 200).then_some(numbers)
        });
        assert_eq!(numbers, (0..200).collect::<Vec<_>>(), "{class}");
    }
    let too_large = vec![0; size + 1];
    assert_eq!(
        robot.transport.send(&fog.endpoint, Priority::Bulk, &too_large),
        SendOutcome::NotSent
    );
    robot.transport.disconnect(&fog.endpoint, &[Priority::Bulk]);
    assert_eq!(robot.transport.send(&fog.endpoint, Priority::Bulk, &[]), SendOutcome::NotSent);
    assert_eq!(robot.transport.send(&fog.endpoint, Priority::State, &[]), SendOutcome::Sent);
}

#[test]
fn a_restarted_flow_is_found_with_its_new_epoch() {
    let domain = free_domain();
    let robot = start(domain, "edge/robot-1", 1);
    let fog = start(domain, "fog/fog-1", 1);
    robot.wait_discovered(&fog.endpoint, DISCOVERY);
    let old = fog.endpoint.clone();
    drop(fog);
    let fog = start(domain, "fog/fog-1", 2);
    robot.wait_discovered(&fog.endpoint, DISCOVERY);
    robot.reach(&fog, &fog.endpoint);
    wait_for("loss of the old life", Duration::from_secs(2), || {
        let events = robot.events.lock();
        events
            .iter()
            .any(|event| matches!(event, TransportEvent::Lost(lost) if *lost == old))
            .then_some(())
    });
}

#[test]
fn a_flow_whose_name_a_newer_program_has_says_so() {
    let domain = free_domain();
    let older = start(domain, "edge/robot-1", 1);
    let newer = start(domain, "edge/robot-1", 2);
    let conflict = wait_for("conflict", DISCOVERY, || older.transport.name_conflicts().pop());
    assert!(
        conflict.is_refused && conflict.detail.contains("at 127.0.0.1, epoch 2"),
        "{conflict:?}"
    );
    newer.wait_discovered(&older.endpoint, DISCOVERY);
    let found = newer.transport.name_conflicts();
    assert!(found.is_empty(), "it may be what is left of the life before: {found:?}");
    drop(newer);
    wait_for("end of the conflict", Duration::from_secs(4), || {
        older.transport.name_conflicts().is_empty().then_some(())
    });
}

#[test]
fn four_flows_of_one_host_all_meet() {
    let domain = free_domain();
    let flows: Vec<Flow> = (1..=4).map(|n| start(domain, &format!("edge/robot-{n}"), 1)).collect();
    for flow in &flows {
        for other in flows.iter().filter(|other| other.endpoint != flow.endpoint) {
            flow.wait_discovered(&other.endpoint, Duration::from_secs(3));
        }
    }
}

#[test]
fn a_flow_that_was_lost_and_lives_is_met_again() {
    let domain = free_domain();
    let robot = start(domain, "edge/robot-1", 1);
    let fog = start(domain, "fog/fog-1", 1);
    robot.wait_discovered(&fog.endpoint, DISCOVERY);
    fog.wait_discovered(&robot.endpoint, DISCOVERY);
    fog.reach(&robot, &robot.endpoint);
    let prefix = *robot.transport.shared.heard.lock().keys().next().unwrap();
    *robot.transport.shared.fault.lock() = Some(Fault::GoodBye(prefix));
    wait_for("loss", Duration::from_secs(4), || {
        let events = robot.events.lock();
        let lost = |event: &TransportEvent| matches!(event, TransportEvent::Lost(lost) if *lost == fog.endpoint);
        events.iter().any(lost).then_some(())
    });
    robot.events.lock().clear();
    // A life lasts ten seconds at least, and so does RustDDS' pause between announcements.
    robot.wait_discovered(&fog.endpoint, 3 * DISCOVERY);
    robot.reach(&fog, &fog.endpoint);
    fog.reach(&robot, &endpoint("edge/robot-1", 2));
}

fn survives(fault: Fault) {
    let domain = free_domain();
    let robot = start(domain, "edge/robot-1", 1);
    let fog = start(domain, "fog/fog-1", 1);
    robot.wait_discovered(&fog.endpoint, DISCOVERY);
    fog.wait_discovered(&robot.endpoint, DISCOVERY);
    robot.reach(&fog, &fog.endpoint);
    // Silence says something only after a first answer.
    wait_for("a first beat", Duration::from_secs(3), || {
        robot.transport.status().watched.then_some(())
    });
    *robot.transport.shared.fault.lock() = Some(fault);
    wait_for("injection", Duration::from_secs(2), || {
        robot.transport.shared.fault.lock().is_none().then_some(())
    });
    let begin = Instant::now();
    let epoch = wait_for("rebuild", Duration::from_secs(4), || {
        robot.events.lock().iter().find_map(|event| match event {
            TransportEvent::Rebuilt { epoch } => Some(*epoch),
            _ => None,
        })
    });
    println!("{fault:?}: rebuilt after {:?}", begin.elapsed());
    assert_eq!(epoch, 2);
    assert_eq!(robot.transport.status().rebuilds, 1);
    // Both directions work again: the writers that were wanted are made anew, the new life is
    // found.
    robot.reach(&fog, &fog.endpoint);
    let reborn = endpoint("edge/robot-1", 2);
    fog.wait_discovered(&reborn, DISCOVERY);
    fog.reach(&robot, &reborn);
}

#[test]
fn a_dead_event_loop_is_replaced() {
    survives(Fault::Panic);
}

#[test]
fn a_hanging_event_loop_is_replaced() {
    survives(Fault::Hang);
}
