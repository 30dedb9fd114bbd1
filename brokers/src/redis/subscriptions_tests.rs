//! What the registry of readers promises to its connection and to its readers.

use super::*;

use blaze_domain::Origin;
use blaze_proto::{Frame, Header};

use crate::port::{Subscription, subscription};

fn registry() -> Arc<Subscriptions> {
    Subscriptions::new(Arc::default())
}

fn add_with(
    registry: &Subscriptions,
    name: &str,
    options: SubscribeOptions,
) -> (Subscription, Added) {
    let (sender, subscription) = subscription(options);
    let added = registry.add(&Arc::from(name), &name.parse().unwrap(), sender, options).unwrap();
    (subscription, added)
}

fn add(registry: &Subscriptions, name: &str) -> (Subscription, Added) {
    add_with(registry, name, SubscribeOptions::default())
}

fn subscribe_all(registry: &Subscriptions) {
    registry.confirm(&registry.take_work().subscribe);
}

fn subscribe(wanted: &[&str]) -> Work {
    Work { subscribe: names(wanted), ..Work::default() }
}

fn unsubscribe(unwanted: &[&str]) -> Work {
    Work { unsubscribe: names(unwanted), ..Work::default() }
}

fn names(names: &[&str]) -> Vec<Name> {
    names.iter().map(|name| Arc::from(*name)).collect()
}

fn frame(writer: u8, sequence: u64) -> Vec<u8> {
    let header = Header::new("t", Origin::default(), WriterId([writer; 16]), sequence, 0);
    Frame::new(&header, Bytes::from_static(b"x")).unwrap().to_bytes().to_vec()
}

fn received(writer: u8, sequence: u64) -> Received {
    Received::live(Content::from_bytes(Bytes::from(frame(writer, sequence))), Instant::now())
}

fn deliver(registry: &Subscriptions, name: &str, payload: &[u8]) {
    registry.deliver(name.as_bytes(), payload.to_vec(), Instant::now());
}

/// What waits in a subscription: payloads of bare messages, writer and sequence of frames.
fn waiting(subscription: &mut Subscription) -> Vec<String> {
    let mut batch = Vec::new();
    let mut receive = Box::pin(subscription.receive(&mut batch, 100));
    let _ = futures::FutureExt::now_or_never(&mut receive);
    drop(receive);
    batch
        .iter()
        .map(|message| match &message.content {
            Content::Frame(frame) => format!("{}:{}", frame.writer().0[0], frame.sequence()),
            Content::Bare { payload, .. } => String::from_utf8_lossy(payload).into_owned(),
            Content::Malformed { .. } => "malformed".to_owned(),
        })
        .collect()
}

#[test]
fn readers_of_one_channel_share_its_subscription() {
    let registry = registry();
    let (mut first, mut one) = add(&registry, "a");
    let (mut second, _two) = add(&registry, "a");
    assert_eq!(registry.take_work(), subscribe(&["a"]));
    assert_eq!(registry.take_work(), Work::default());
    assert!(one.confirmation.try_recv().is_err());
    registry.confirm(&names(&["a"]));
    assert_eq!(one.confirmation.try_recv(), Ok(Ok(())));
    deliver(&registry, "a", b"hello");
    deliver(&registry, "b", b"not ours");
    assert_eq!(
        (waiting(&mut first), waiting(&mut second)),
        (vec!["hello".to_owned()], vec!["hello".to_owned()])
    );
    let (_third, mut three) = add(&registry, "a");
    assert_eq!(three.confirmation.try_recv(), Ok(Ok(())), "it is subscribed already");
}

#[test]
fn the_last_reader_unsubscribes_and_a_new_one_subscribes_again() {
    let registry = registry();
    let (first, _one) = add(&registry, "a");
    let (second, _two) = add(&registry, "a");
    subscribe_all(&registry);
    drop(first);
    registry.sweep();
    assert_eq!(registry.take_work(), Work::default());
    drop(second);
    deliver(&registry, "a", b"nobody");
    assert_eq!(registry.take_work(), unsubscribe(&["a"]));
    assert_eq!(registry.count.load(Ordering::Relaxed), 0);
    let (mut third, _three) = add(&registry, "a");
    deliver(&registry, "a", b"of the time before");
    assert_eq!(registry.take_work(), subscribe(&["a"]));
    deliver(&registry, "a", b"new");
    assert_eq!(waiting(&mut third), ["new"]);
}

#[test]
fn a_reader_that_goes_before_it_was_subscribed_leaves_nothing() {
    let registry = registry();
    let (first, _one) = add(&registry, "a");
    drop(first);
    registry.sweep();
    assert_eq!(registry.take_work(), Work::default());
    let (second, _two) = add(&registry, "b");
    assert_eq!(registry.take_work(), subscribe(&["b"]));
    drop(second);
    registry.sweep();
    assert_eq!(registry.take_work(), Work::default(), "SUBSCRIBE is under way");
    registry.confirm(&names(&["b"]));
    registry.sweep();
    assert_eq!(registry.take_work(), unsubscribe(&["b"]));
}

#[test]
fn after_a_lost_connection_all_is_subscribed_again() {
    let registry = registry();
    let (_a, _one) = add(&registry, "a");
    let (_b, mut two) = add(&registry, "b");
    assert_eq!(registry.take_work().subscribe.len(), 2);
    registry.fail_waiting("gone");
    assert_eq!(two.confirmation.try_recv(), Ok(Err(BrokerError::Away("gone".to_owned()))));
    registry.forget_server();
    let mut again = registry.take_work().subscribe;
    again.sort();
    assert_eq!(again, names(&["a", "b"]));
}

#[test]
fn a_refused_channel_ends_its_readers() {
    let registry = registry();
    let (mut subscription, mut added) = add(&registry, "a");
    registry.take_work();
    registry.refuse(&Arc::from("a"), "NOPERM");
    assert!(matches!(
        added.confirmation.try_recv(),
        Ok(Err(BrokerError::Name { reason, .. })) if reason == "NOPERM",
    ));
    let mut batch = Vec::new();
    let ended = futures::FutureExt::now_or_never(subscription.receive(&mut batch, 1));
    assert_eq!(ended, Some(0));
}

#[test]
fn channels_are_bounded_over_all_connections() {
    let count: Arc<AtomicUsize> = Arc::new(AtomicUsize::new(MAX_CHANNELS - 1));
    let (small, large) = (Subscriptions::new(Arc::clone(&count)), Subscriptions::new(count));
    let (_reader, _added) = add(&small, "a");
    let (_same, _added) = add(&small, "a");
    let (sender, _subscription) = subscription(SubscribeOptions::default());
    let refused =
        large.add(&Arc::from("b"), &"b".parse().unwrap(), sender, SubscribeOptions::default());
    assert_eq!(refused.err(), Some(BrokerError::TooManyChannels(MAX_CHANNELS)));
    small.close();
    add(&large, "b");
}

#[test]
fn a_late_joiner_gets_what_is_kept_first_and_nothing_twice() {
    let registry = registry();
    let options = SubscribeOptions { with_kept: true, ..SubscribeOptions::default() };
    let (mut late, added) = add_with(&registry, "a", options);
    subscribe_all(&registry);
    deliver(&registry, "a", &frame(1, 4));
    deliver(&registry, "a", &frame(1, 5));
    deliver(&registry, "a", b"bare");
    assert!(waiting(&mut late).is_empty());
    let kept = [(1, 3), (2, 9), (1, 4)].map(|(writer, sequence)| received(writer, sequence));
    registry.join(&Arc::from("a"), added.id, kept.into());
    deliver(&registry, "a", &frame(2, 9));
    deliver(&registry, "a", &frame(2, 10));
    deliver(&registry, "a", &frame(2, 10));
    assert_eq!(waiting(&mut late), ["1:3", "2:9", "1:4", "1:5", "bare", "2:10", "2:10"]);
}

#[test]
fn what_is_held_for_a_late_joiner_is_bounded() {
    let registry = registry();
    let options =
        SubscribeOptions { with_kept: true, max_messages: 2, ..SubscribeOptions::default() };
    let (mut late, added) = add_with(&registry, "a", options);
    subscribe_all(&registry);
    for sequence in 1..=5 {
        deliver(&registry, "a", &frame(1, sequence));
    }
    registry.join(&Arc::from("a"), added.id, Vec::new());
    assert_eq!(waiting(&mut late), ["1:4", "1:5"]);
    assert_eq!(late.take_dropped(), 3);
}

#[test]
fn reserved_channels_are_bare_whatever_they_carry() {
    let registry = registry();
    let (mut control, _one) = add(&registry, "blaze/flow/control");
    let (mut user, _two) = add(&registry, "a");
    subscribe_all(&registry);
    for name in ["blaze/flow/control", "a"] {
        deliver(&registry, name, b"BLZ1");
    }
    assert_eq!(
        (waiting(&mut control), waiting(&mut user)),
        (vec!["BLZ1".to_owned()], vec!["malformed".to_owned()])
    );
}
