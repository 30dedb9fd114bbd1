//! Writers and newcomers among others that do not suit them, or that are none.

use std::net::{Ipv4Addr, UdpSocket};
use std::sync::mpsc::sync_channel;
use std::time::Duration;

use blaze_brokers::dds::{Participant, ParticipantConfig, Profile};
use blaze_brokers::{Broker, PublisherOptions, SubscribeOptions};
use bytes::Bytes;

use super::support::{DEADLINE, Domain, eventually, frame};

/// RustDDS keeps four events of a writer. Readers that ask for more than it offers fill them before
/// the one that suits it comes.
#[tokio::test]
async fn a_writer_finds_its_reader_behind_a_crowd_of_others() {
    const OTHERS: usize = 6;
    let domain = Domain::start();
    let participant =
        || Participant::start(ParticipantConfig::new(domain.id, Ipv4Addr::LOCALHOST)).unwrap();
    let (here, there) = (participant(), participant());
    let best_effort = Profile::best_effort(8);
    let reliable = Profile { reliable: true, ..best_effort };
    let (first, second) =
        (here.writer("crowd", best_effort).unwrap(), here.writer("crowd", best_effort).unwrap());
    let (arrived, arrivals) = sync_channel(64);
    let reader = |profile| {
        let arrived = arrived.clone();
        let sink = move |_, octets: Bytes| {
            let _ = arrived.try_send(octets);
        };
        there.reader("crowd", profile, Box::new(sink)).unwrap()
    };
    let others: Vec<_> = (0..OTHERS).map(|_| reader(reliable)).collect();
    let suits = reader(best_effort);
    for (writer, text) in [(&first, "first"), (&second, "second")] {
        eventually(text, || writer.is_matched().then_some(())).await;
        eventually(text, || {
            writer.write(text.as_bytes());
            arrivals.try_iter().find(|octets| octets == text)
        })
        .await;
    }
    drop((others, suits));
    eventually("nobody is left", || (!first.is_matched() && !second.is_matched()).then_some(()))
        .await;
}

/// Datagrams that look like announcements and cannot be decoded.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn forged_announcements_keep_no_newcomer_out() {
    const FORGED: u32 = 60;
    let domain = Domain::start();
    let first = domain.open().await;
    let topic = "newcomer".parse().unwrap();
    let mut there = first.subscribe(&topic, SubscribeOptions::default()).await.unwrap();
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    for number in 1..=FORGED {
        let mut datagram = b"RTPS\x02\x03\x01\x12".to_vec();
        datagram.extend((0..12).map(|at| (number * 7 + at) as u8));
        // DATA of the announcing writer, with parameters that are none.
        datagram.extend([0x15, 0x05, 0, 0, 0, 0, 16, 0, 0, 0, 0, 0, 0, 1, 0, 0xc2, 0, 0, 0, 0]);
        datagram.extend(number.to_le_bytes());
        datagram.extend([0, 3, 0, 0]);
        datagram.extend((0..60_u32).map(|at| (number * 31 + at * 17) as u8));
        // The first slot of the domain.
        let port = 7400 + 250 * domain.id + 10;
        socket.send_to(&datagram, (Ipv4Addr::LOCALHOST, port)).unwrap();
    }
    let second = domain.open().await;
    let publisher = second.publisher(&topic, PublisherOptions::default()).unwrap();
    let (mut sequence, mut batch) = (0, Vec::new());
    let arrived = async {
        loop {
            sequence += 1;
            publisher.publish(&frame(&topic, 1, sequence, 1), None);
            let received = there.receive(&mut batch, 1);
            if tokio::time::timeout(Duration::from_millis(100), received).await.is_ok() {
                break;
            }
        }
    };
    tokio::time::timeout(DEADLINE, arrived).await.expect("the newcomer is heard");
}
