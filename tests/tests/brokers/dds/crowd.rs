//! A writer among readers that do not suit it.

use std::net::Ipv4Addr;
use std::sync::mpsc::sync_channel;

use blaze_brokers::dds::{Participant, ParticipantConfig, Profile};
use bytes::Bytes;

use super::support::{Domain, eventually};

/// RustDDS keeps four events of a writer. Readers that ask for more than it offers fill them before the one that suits it
/// comes.
#[tokio::test]
async fn a_writer_finds_its_reader_behind_a_crowd_of_others() {
    const OTHERS: usize = 6;
    let domain = Domain::start().await;
    let participant = || Participant::start(ParticipantConfig::new(domain.id, Ipv4Addr::LOCALHOST)).unwrap();
    let (here, there) = (participant(), participant());
    let best_effort = Profile::best_effort(8);
    let reliable = Profile {
        reliable: true,
        ..best_effort
    };
    let (first, second) = (
        here.writer("crowd", best_effort).unwrap(),
        here.writer("crowd", best_effort).unwrap(),
    );
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
            writer.write(Bytes::from(text));
            arrivals.try_iter().find(|octets| octets == text)
        })
        .await;
    }
    drop((others, suits));
    eventually("nobody is left", || {
        (!first.is_matched() && !second.is_matched()).then_some(())
    })
    .await;
}
