//! Clients that a server has forsaken.

use crate::kafka::KafkaBroker;
use crate::kafka::fake_broker::FakeBroker;
use crate::kafka::settings::tests::section_at;
use crate::port::{Broker as _, Health, Role};

use super::*;

/// Longer than a client waits before it is made anew.
const DEADLINE: Duration = Duration::from_secs(20);
const PAUSE: Duration = Duration::from_millis(50);

fn until(what: &str, mut holds: impl FnMut() -> bool) {
    let end = Instant::now() + DEADLINE;
    while !holds() {
        assert!(Instant::now() < end, "{what}");
        std::thread::sleep(PAUSE);
    }
}

/// The server stands still until the clients have given up their connections, and then names no
/// broker for a moment. The client library never finds back from there: without being made anew,
/// each of the three clients would stay without an answer for ever.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_named_no_broker_for_a_moment_is_found_again() {
    let server = FakeBroker::start();
    let broker = KafkaBroker::open(&section_at(&server.bootstrap(), "{}"), &Role::Service).unwrap();
    let inner = &broker.inner;
    let health = || broker.status().borrow().health;
    until("up at the beginning", || health() == Health::Up);
    let producer = inner.producer(Lot::default()).unwrap();
    let consumer = inner.consumer(false).unwrap();
    let answered =
        || (producer.is_answered(&inner.probe, QUICK), consumer.is_answered(&inner.probe, QUICK));
    until("reader and writer are answered", || answered() == (true, true));
    for round in 0..3 {
        server.set_silent(true);
        until("down", || health() == Health::Down && answered() == (false, false));
        // The connections are closed when an answer has not come in time.
        let end = Instant::now() + 2 * ANSWER;
        until("the clients have given up", || {
            let _ = answered();
            Instant::now() > end
        });
        server.set_lost(true);
        server.set_silent(false);
        let before = server.lost_answers();
        until("it has named no broker", || {
            let _ = answered();
            server.lost_answers() >= before + 3
        });
        server.set_lost(false);
        until("up again", || health() == Health::Up);
        until("reader and writer are answered again", || answered() == (true, true));
        println!("round {round}: found again");
    }
}

#[test]
fn a_client_without_an_answer_for_a_while_is_made_anew_and_given_as_long_again() {
    let start = Instant::now();
    let at = |seconds: u64| start + Duration::from_secs(seconds);
    let mut silent = Silent::default();
    let seen: Vec<bool> = [
        (0, false),
        (2, false),
        (3, false),
        (4, false),
        (6, false),
        (7, true),
        (8, false),
        (10, false),
    ]
    .map(|(seconds, answered)| silent.note(Client::Admin, at(seconds), answered))
    .to_vec();
    assert_eq!(seen, [false, false, true, false, true, false, false, false]);
}

/// Seen with a server that was killed: its last answer went to the client that asks, and not to the
/// one that writes; 3 s later it was back, the writer had not yet heard from it, and was made anew
/// as if it had been left alone for those 3 s.
#[test]
fn time_in_which_no_client_is_answered_does_not_count() {
    let start = Instant::now();
    let clients =
        [Client::Producer(Lot::default()), Client::Consumer { large: false }, Client::Admin];
    let mut silent = Silent::default();
    let note = |silent: &mut Silent, at| clients.map(|client| silent.note(client, at, false));
    assert_eq!(note(&mut silent, start), [false; 3]);
    silent.looked = Some(start);
    silent.nobody_is_answered();
    assert_eq!(silent.looked, None, "they are looked at with the next answer");
    let back = start + FORSAKEN;
    assert_eq!(note(&mut silent, back), [false; 3]);
    assert_eq!(note(&mut silent, back + FORSAKEN), [true; 3]);
}
