//! What a broker keeps of services that are gone, or that nobody asks for any more.

use std::collections::BTreeSet;

use blaze_domain::ServiceName;
use blaze_domain::config::spec::PROGRAMS;
use parking_lot::Mutex;

use super::*;
use crate::core::PROTOCOL;

/// Longer than anything stays.
const LONG: Duration = Duration::from_secs(900);

#[derive(Default)]
struct Made(Mutex<Vec<BTreeSet<ServiceName>>>);

impl Channels for Made {
    fn serve(&self, services: BTreeSet<ServiceName>) {
        self.0.lock().push(services);
    }
}

impl Made {
    fn last(&self) -> Vec<String> {
        let all = self.0.lock();
        let last: Vec<String> = all.last().into_iter().flatten().map(ToString::to_string).collect();
        let is_program = |service: &String| PROGRAMS.contains(&service.as_str());
        let (programs, others): (Vec<String>, Vec<String>) = last.into_iter().partition(is_program);
        assert_eq!(programs.len(), PROGRAMS.len(), "programs are there without a document");
        others
    }
}

fn world(start: Option<Loaded>) -> (World, Arc<Made>) {
    let made = Arc::<Made>::default();
    let world =
        world_on(start, true, None, Delivery::Text, Some(Arc::clone(&made) as Arc<dyn Channels>));
    (world, made)
}

fn taken_away(seen: &[Seen]) -> Vec<(&str, &str)> {
    let taken_away = |seen: &'_ Seen| matches!(seen, Seen::TakenAway(..));
    let all = seen.iter().filter(|seen| taken_away(seen));
    all.filter_map(|seen| match seen {
        Seen::TakenAway(channel, key) => Some((channel.as_str(), key.as_str())),
        Seen::Key(..) | Seen::Notice(..) => None,
    })
    .collect()
}

#[tokio::test(start_paused = true)]
async fn channels_are_there_before_anything_is_said_and_what_is_over_is_taken_away_later() {
    let (mut w, made) = world(None);
    w.opens(documents(30), 2).await;
    w.rest().await;
    assert_eq!(made.last(), ["nav", "slam"]);
    let late = document("Service/late", 3, json!({}));
    w.says(put(3, late.clone())).await;
    w.rest().await;
    assert_eq!(made.last(), ["late", "nav", "slam"]);

    w.slam().await;
    w.says(remove(4, late)).await;
    let seen = w.rest().await;
    assert!(
        matches!(
            &seen[..],
            [
                ..,
                Seen::Notice(channel, notice),
            ] if channel.ends_with("/late") && notice["deleted"] == true,
        ),
        "{seen:?}"
    );
    assert!(taken_away(&seen).is_empty());
    assert_eq!(made.last(), ["late", "nav", "slam"], "whoever comes late hears of the end");
    tokio::time::sleep(LONG).await;
    let seen = w.rest().await;
    // The instance asked once and not again.
    let mut gone = taken_away(&seen);
    gone.sort_unstable();
    assert_eq!(gone, [("blaze/config/changed/late", ""), ("blaze/config/changed/slam", "0")]);
    assert_eq!(made.last(), ["nav", "slam"]);
    tokio::time::sleep(LONG).await;
    assert!(taken_away(&w.rest().await).is_empty(), "once");
}

#[tokio::test(start_paused = true)]
async fn a_deletion_waits_for_a_broker_that_is_away_for_long() {
    let (mut w, made) = world(None);
    w.opens(documents(30), 2).await;
    w.rest().await;
    w.up.send_replace(false);
    w.says(remove(3, document("Service/nav", 3, json!({})))).await;
    tokio::time::sleep(LONG * 3 / 2).await;
    assert_eq!(made.last(), ["nav", "slam"], "the channel is still needed");
    w.up.send_replace(true);
    let seen = w.rest().await;
    let is_end = |seen: &Seen| {
        matches!(
            seen,
            Seen::Notice(channel, notice) if channel.ends_with("/nav") && notice["deleted"] == true,
        )
    };
    assert!(seen.iter().any(is_end), "{seen:?}");
    assert!(taken_away(&seen).is_empty());
    tokio::time::sleep(LONG).await;
    assert_eq!(taken_away(&w.rest().await), [("blaze/config/changed/nav", "")]);
    assert_eq!(made.last(), ["slam"]);
}

#[tokio::test(start_paused = true)]
async fn a_new_life_takes_away_what_ended_in_the_last_one() {
    let notes = Arc::new(Notes {
        ended: vec![place("late@robot-1"), place("nav@robot-1")],
        ..Notes::default()
    });
    let (mut w, made) = world(Some(Loaded { notes, ..copy_of("s", 2, documents(30)) }));
    w.rest().await;
    assert_eq!(made.last(), ["late", "nav", "slam"]);
    tokio::time::sleep(LONG).await;
    let gone = w.rest().await;
    assert_eq!(taken_away(&gone), [("blaze/config/changed/late", "")], "nav is there again");
    assert_eq!(made.last(), ["nav", "slam"]);
}

#[tokio::test(start_paused = true)]
async fn what_comes_back_meanwhile_is_not_taken_away() {
    let (mut w, made) = world(None);
    w.opens(documents(30), 2).await;
    let nav = document("Service/nav", 3, json!({ "config": { "speed": 1 } }));
    w.says(remove(3, nav.clone())).await;
    w.rest().await;
    tokio::time::sleep(Duration::from_secs(300)).await;
    w.says(put(4, nav)).await;
    tokio::time::sleep(LONG).await;
    assert!(taken_away(&w.rest().await).is_empty());
    assert_eq!(made.last(), ["nav", "slam"]);
}

#[tokio::test(start_paused = true)]
async fn the_channel_of_a_service_that_came_in_an_outage_is_there_when_it_is_told() {
    let (mut w, made) = world(None);
    w.opens(documents(30), 2).await;
    w.rest().await;
    w.closes().await;
    w.goes_on(PROTOCOL, 40).await;
    let late = document("Service/late", 3, json!({}));
    w.says(put(3, late)).await;
    // More is to come, and meanwhile it is looked whether anything has faded.
    tokio::time::sleep(LOOK * 2).await;
    assert_eq!(made.last(), ["nav", "slam"], "it is not shown yet");
    tokio::time::sleep(Duration::from_secs(5)).await;
    w.rest().await;
    assert_eq!(made.last(), ["late", "nav", "slam"]);
}

#[tokio::test(start_paused = true)]
async fn whoever_does_not_tell_takes_nothing_away_until_it_does() {
    let made = Arc::<Made>::default();
    let channels = Arc::clone(&made) as Arc<dyn Channels>;
    let mut w = world_on(None, false, None, Delivery::Text, Some(channels));
    w.opens(documents(30), 2).await;
    let nav = document("Service/nav", 3, json!({}));
    w.says(remove(3, nav)).await;
    tokio::time::sleep(LONG).await;
    assert!(w.rest().await.is_empty());
    assert_eq!(made.last(), ["nav", "slam"]);
    w.leader.send_replace(Some(1));
    tokio::time::sleep(LONG).await;
    let seen = w.rest().await;
    let end = seen.iter().position(|seen| {
        matches!(
            seen,
            Seen::Notice(channel, notice) if channel.ends_with("/nav") && notice["deleted"] == true,
        )
    });
    let away = seen
        .iter()
        .position(|seen| matches!(seen, Seen::TakenAway(channel, _) if channel.ends_with("/nav")));
    assert!(end.is_some() && away > end, "{seen:?}");
    tokio::time::sleep(LOOK * 3).await;
    assert_eq!(made.last(), ["slam"]);
}
