//! Who tells, and what a new leader makes up for.

use super::*;
use crate::serve::SpeakerCounts;

fn mark(revision: u64) -> Mark {
    Mark { store_id: "s".to_owned(), revision }
}

/// Revisions and rates in notices of `slam`.
fn notices(seen: &[Seen]) -> Vec<(u64, u64)> {
    let of_slam = noticed(seen).filter(|(channel, _)| channel.ends_with("/slam"));
    of_slam
        .map(|(_, notice)| {
            let rate = notice["config"]["rate_hz"].as_u64();
            (notice["revision"].as_u64().unwrap(), rate.unwrap_or_default())
        })
        .collect()
}

fn key_of_slam(seen: &[Seen]) -> Option<u64> {
    seen.iter().rev().find_map(|seen| match seen {
        Seen::Key(key, Some(value)) if key == "blaze:config:slam" => {
            value["config"]["rate_hz"].as_u64()
        }
        Seen::Key(..) | Seen::Notice(..) | Seen::TakenAway(..) => None,
    })
}

#[tokio::test(start_paused = true)]
async fn only_the_leader_answers() {
    let mut w = world_from(None, false);
    w.opens(documents(30), 2).await;
    w.rest().await;
    w.says(slam(3, 10)).await;
    let request = json!({ "id": "1", "service": "slam", "reply_to": "blaze/reply/t" });
    w.gets.send(Bytes::from(request.to_string())).await.unwrap();
    assert_eq!(w.rest().await, []);
    assert!(w.answers.try_recv().is_err());
    w.leader.send_replace(Some(1));
    assert_eq!(notices(&w.rest().await), [(3, 10)]);
    assert_eq!(w.slam().await["config"]["rate_hz"], 10);
}

#[tokio::test(start_paused = true)]
async fn whoever_begins_to_lead_notifies_every_place_once() {
    let mut w = world_from(None, false);
    w.opens(documents(30), 2).await;
    w.says(slam(3, 10)).await;
    w.rest().await;
    w.noted.send_replace(Some(mark(3)));
    for term in 1..=2 {
        w.leader.send_replace(Some(term));
        let told = w.rest().await;
        assert_eq!(notices(&told), [(3, 10)]);
        assert_eq!(noticed(&told).count(), 2, "nav as well: {told:?}");
        assert_eq!(key_of_slam(&told), Some(10));
        w.noted.send_replace(Some(mark(3)));
        assert_eq!(w.rest().await, [], "once");
    }
    // A change of one is told to that one alone.
    w.says(slam(4, 11)).await;
    let told = w.rest().await;
    assert_eq!(notices(&told), [(4, 11)]);
    assert_eq!(noticed(&told).count(), 1);
}

#[tokio::test(start_paused = true)]
async fn a_copy_is_announced_only_if_services_were_not_notified_of_more() {
    let copy = || copy_of("s", 2, documents(30));
    // Alone, and without the main service: nobody knows how old the copy is. Keys are there
    // nevertheless.
    let mut w = world_from(Some(copy()), true);
    let told = w.rest().await;
    assert_eq!((notices(&told), key_of_slam(&told)), (vec![], Some(30)));
    w.opens(documents(30), 2).await;
    assert_eq!(notices(&w.rest().await), [(2, 30)]);
    for (noted, expected) in [(2, vec![(2, 30)]), (3, vec![])] {
        let mut w = world_from(Some(copy()), false);
        w.noted.send_replace(Some(mark(noted)));
        w.rest().await;
        w.leader.send_replace(Some(1));
        assert_eq!(notices(&w.rest().await), expected);
    }
}

#[tokio::test(start_paused = true)]
async fn whoever_leads_leaves_how_far_the_broker_has_taken_it() {
    let mut w = world_from(None, true);
    w.opens(documents(30), 2).await;
    w.rest().await;
    assert_eq!(*w.told.borrow(), Some(mark(2)));
    w.up.send_replace(false);
    w.says(slam(3, 10)).await;
    tokio::time::sleep(Duration::from_secs(5)).await;
    assert_eq!(*w.told.borrow(), Some(mark(2)), "the broker has not taken it");
    w.up.send_replace(true);
    w.rest().await;
    assert_eq!(*w.told.borrow(), Some(mark(3)));
    // A commit that concerns nobody moves the mark on all the same.
    let same =
        document("Service/slam", 4, json!({ "config": { "rate_hz": 10 }, "description": "new" }));
    w.says(put(4, same)).await;
    w.rest().await;
    assert_eq!(*w.told.borrow(), Some(mark(4)));
    w.leader.send_replace(None);
    w.rest().await;
    assert_eq!(*w.told.borrow(), None, "who does not lead leaves nothing");
}

#[tokio::test(start_paused = true)]
async fn what_waited_when_the_lease_was_lost_is_told_when_it_is_had_again() {
    let mut w = world_from(None, true);
    w.opens(documents(30), 2).await;
    w.rest().await;
    tokio::time::sleep(Duration::from_secs(60)).await;
    w.up.send_replace(false);
    w.says(slam(3, 10)).await;
    let gone = document("Service/nav", 1, json!({ "config": { "speed": 1 } }));
    w.says(remove(4, gone)).await;
    tokio::time::sleep(Duration::from_secs(5)).await;
    w.leader.send_replace(None);
    tokio::time::sleep(Duration::from_secs(60)).await;
    w.up.send_replace(true);
    assert_eq!(w.rest().await, [], "it is for others to tell, if there are any");
    w.leader.send_replace(Some(2));
    let told = w.rest().await;
    assert_eq!(notices(&told), [(4, 10)]);
    let is_nav = |seen: &&Seen| {
        matches!(
            seen,
            Seen::Notice(channel, notice) if channel.ends_with("/nav") && notice["deleted"] == true,
        )
    };
    assert_eq!(told.iter().filter(is_nav).count(), 1, "{told:?}");
}

#[tokio::test(start_paused = true)]
async fn between_two_terms_nothing_is_carried_over_and_everything_told_anew() {
    let mut w = world_from(None, true);
    w.opens(documents(30), 2).await;
    w.rest().await;
    w.up.send_replace(false);
    w.says(slam(3, 10)).await;
    tokio::time::sleep(Duration::from_secs(5)).await;
    // It was stopped for a while, others led, and it leads again: it sees only that it is another
    // term.
    w.noted.send_replace(Some(mark(9)));
    w.leader.send_replace(Some(2));
    w.closes().await;
    w.up.send_replace(true);
    assert_eq!(noticed(&w.rest().await).count(), 0);
}

#[tokio::test(start_paused = true)]
async fn whoever_knows_less_than_was_told_answers_and_tells_nothing_until_it_knows() {
    let mut w = world_from(None, false);
    let stream = w.opens(documents(30), 2).await;
    w.rest().await;
    drop(stream);
    w.closes().await;
    w.noted.send_replace(Some(mark(5)));
    w.leader.send_replace(Some(1));
    assert_eq!(w.rest().await, [], "neither notices nor keys");
    assert_eq!(w.slam().await["config"]["rate_hz"], 30);
    assert_eq!(*w.told.borrow(), None, "and no mark");
    w.opens(documents(11), 5).await;
    let told = w.rest().await;
    assert_eq!(key_of_slam(&told), Some(11));
    assert!(notices(&told).iter().all(|notice| *notice == (5, 11)), "{told:?}");
    assert_eq!(*w.told.borrow(), Some(mark(5)));
}

#[tokio::test(start_paused = true)]
async fn what_the_main_service_calls_the_newest_counts_more_than_a_mark_but_not_at_once() {
    let mut w = world_from(None, false);
    w.opens(documents(30), 2).await;
    w.rest().await;
    w.noted.send_replace(Some(mark(5)));
    w.leader.send_replace(Some(1));
    assert_eq!(w.rest().await, [], "it may have been stopped since it was said");
    tokio::time::sleep(Duration::from_secs(60)).await;
    assert_eq!(key_of_slam(&w.rest().await), Some(30));
    assert_eq!(*w.told.borrow(), Some(mark(2)));
}

#[tokio::test(start_paused = true)]
async fn a_speaker_says_nothing_after_its_term() {
    let (mut holder, leadership) = crate::lease::leadership();
    let speaker = Speaker::new(leadership.term.clone());
    let (see, mut seen) = mpsc::channel(64);
    let (_up, is_up) = watch::channel(true);
    let mut tasks = JoinSet::new();
    tasks.spawn(speaker.clone().run(Arc::new(Board { seen: see, is_up })));
    let told = |text: &'static str| crate::serve::Told {
        place: "slam".to_owned(),
        key: Some(("blaze:config:slam".to_owned(), Some(Bytes::from(text)))),
        notice: Some(KeyedMessage {
            channel: "blaze/config/changed/slam".parse().unwrap(),
            key: String::new(),
            value: Some(Bytes::from(text)),
        }),
    };
    speaker.tell([told("1")]);
    tokio::time::sleep(Duration::from_secs(5)).await;
    assert!(seen.try_recv().is_err());
    assert!(speaker.is_waiting("slam"));
    holder.lead(Some(Instant::now() + Duration::from_secs(5)));
    tokio::time::sleep(Duration::from_secs(1)).await;
    assert!(matches!(seen.recv().await, Some(Seen::Key(..))));
    assert!(matches!(seen.recv().await, Some(Seen::Notice(..))));
    tokio::time::sleep(Duration::from_secs(5)).await;
    // Nobody has said yet that it is over.
    speaker.tell([told("2")]);
    tokio::time::sleep(Duration::from_secs(5)).await;
    assert!(seen.try_recv().is_err());
    let SpeakerCounts { waiting, .. } = speaker.counts();
    assert!(waiting <= 1);
    speaker.clear();
    holder.lead(Some(Instant::now() + Duration::from_secs(5)));
    tokio::time::sleep(Duration::from_secs(5)).await;
    assert!(seen.try_recv().is_err(), "also what was on its way is forgotten");
}
