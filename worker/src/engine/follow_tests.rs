//! What follows from what the main service says.

use super::*;
use crate::core::{OLDEST_PROTOCOL, PROTOCOL};

impl World {
    /// The main service goes on from what the worker has.
    pub(super) async fn goes_on(&self, protocol: u32, revision: u64) {
        self.sync.send(SyncEvent::Opened(CancellationToken::new())).await.unwrap();
        self.says(Incoming::Welcome {
            protocol,
            store_id: "s".to_owned(),
            revision,
            resumed: true,
        })
        .await;
    }
}

#[tokio::test(start_paused = true)]
async fn after_an_outage_each_place_is_told_once_of_the_final_state() {
    let mut w = world();
    w.opens(documents(30), 2).await;
    w.rest().await;
    w.slam().await;
    w.rest().await;
    w.closes().await;
    w.goes_on(PROTOCOL, 40).await;
    for revision in 3..=40 {
        // Slower than what would be told together, and with somebody who asks meanwhile.
        tokio::time::sleep(Duration::from_millis(30)).await;
        w.says(slam(revision, revision)).await;
        let answer = w.slam().await;
        let expected = if revision < 40 { 30 } else { 40 };
        assert_eq!(
            answer["config"]["rate_hz"], expected,
            "nobody is told of a step to the final state"
        );
    }
    assert_eq!(
        rates(&w.rest().await),
        [40, 40],
        "the instance that asked, and the service without one"
    );
    // From then on changes are told as they come.
    w.says(slam(41, 41)).await;
    assert_eq!(rates(&w.rest().await), [41, 41]);
}

#[tokio::test(start_paused = true)]
async fn what_does_not_come_is_not_waited_for_for_long() {
    let mut w = world();
    w.opens(documents(30), 2).await;
    w.rest().await;
    w.closes().await;
    w.goes_on(PROTOCOL, 40).await;
    for revision in 3..=5 {
        w.says(slam(revision, revision)).await;
    }
    assert_eq!(rates(&w.rest().await), [5]);
    w.says(slam(6, 6)).await;
    w.closes().await;
    assert_eq!(rates(&w.rest().await), [6], "what came before the stream ended is told");
}

#[tokio::test(start_paused = true)]
async fn where_nobody_is_told_texts_none_is_kept() {
    let mut w = world_as(None, true, None, Delivery::Redacted);
    assert!(w.hello().await.without_texts);
    let secret = |text: &str| {
        json!({ "config": { "password": { "$secret": { "text": text,
        "version": 2 } } } })
    };
    let mut all = documents(30);
    all[3] = document("Service/slam", 2, secret("canary"));
    // A main service of a version that does not know that none is wanted.
    w.opens(all, 2).await;
    w.says(put(3, document("Service/nav", 3, secret("canary")))).await;
    w.rest().await;
    let answer = w.slam().await;
    assert_eq!(
        answer["config"]["password"],
        json!({ "$secret": { "redacted": true, "version": 2 } })
    );
    // Nothing is missing, so nothing is asked for anew.
    assert_eq!(w.hello().await.revision, 3);
    assert!(!world().hello().await.without_texts);
}

#[tokio::test(start_paused = true)]
async fn why_a_stream_was_ended_is_known_afterwards() {
    let mut w = world();
    w.opens(documents(30), 2).await;
    for (protocol, words) in
        [(PROTOCOL + 1, Some("update the older of the two")), (OLDEST_PROTOCOL, None)]
    {
        w.closes().await;
        w.goes_on(protocol, 2).await;
        w.rest().await;
        w.closes().await;
        w.rest().await;
        let reason = w.status().await.reason.unwrap();
        assert!(reason.contains(words.unwrap_or("cut")), "{reason}");
    }
    w.goes_on(PROTOCOL, 2).await;
    w.says(Incoming::GoAway {
        retry_after: Duration::from_secs(1),
        reason: "the service is ending".to_owned(),
    })
    .await;
    w.closes().await;
    w.rest().await;
    assert_eq!(w.status().await.reason.unwrap(), "the service is ending");
}

#[tokio::test(start_paused = true)]
async fn what_is_due_is_not_put_off_by_what_keeps_coming() {
    let mut w = world();
    w.opens(documents(30), 2).await;
    w.rest().await;
    w.acks.borrow_and_update();
    // Always more than is taken at once.
    for _ in 0..60 {
        while let Ok(room) = w.sync.try_reserve() {
            let (revision, digest) = (2, String::new());
            room.send(SyncEvent::Said(Incoming::Bookmark { revision, digest, beside: Vec::new() }));
        }
        tokio::time::advance(Duration::from_millis(50)).await;
    }
    assert!(w.acks.has_changed().unwrap(), "the main service is told within three seconds");
}

#[tokio::test(start_paused = true)]
async fn texts_that_come_in_the_middle_of_what_was_missed_are_told_with_the_rest() {
    let secret = |revision, value: Value| {
        let spec = json!({ "config": { "rate_hz": revision, "password": { "$secret": value } } });
        document("Service/slam", revision, spec)
    };
    let mut all = documents(30);
    all[3] = secret(2, json!({ "redacted": true, "version": 2 }));
    let mut w = world_from(Some(copy_of("s", 2, all)), true);
    w.rest().await;
    w.goes_on(PROTOCOL, 5).await;
    w.says(put(3, secret(3, json!({ "text": "canary", "version": 2 })))).await;
    tokio::time::sleep(Duration::from_secs(1)).await;
    assert_eq!(w.slam().await["config"]["rate_hz"], 2, "no step is shown");
    for revision in 4..=5 {
        let later = secret(revision, json!({ "text": "canary", "version": 2 }));
        w.says(put(revision, later)).await;
    }
    let told = w.rest().await;
    assert!(rates(&told).iter().all(|rate| *rate == 5) && !told.is_empty(), "{told:?}");
    assert_eq!(w.slam().await["config"]["password"], "canary");
}

#[tokio::test(start_paused = true)]
async fn services_are_not_kept_waiting_for_ever_by_what_comes_slowly() {
    let mut w = world();
    w.opens(documents(30), 2).await;
    w.slam().await;
    w.rest().await;
    w.closes().await;
    w.rest().await;
    // A commit each second, for ever.
    w.goes_on(PROTOCOL, 1_000).await;
    for revision in 3..50 {
        w.says(slam(revision, revision)).await;
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
    let told = w.rest().await;
    let all = rates(&told);
    assert!(all.len() >= 10 && all[0] > 30, "{all:?}");
}

#[tokio::test(start_paused = true)]
async fn whose_answer_could_go_nowhere_is_told_so_where_all_are_answered() {
    let mut w = world();
    w.opens(documents(30), 2).await;
    let request = json!({ "id": "7", "service": "slam", "reply_to": "other/topic" });
    w.gets.send(Bytes::from(request.to_string())).await.unwrap();
    let (to, answer) = w.answers.recv().await.unwrap();
    assert_eq!(to, "blaze/reply/config");
    assert_eq!((&answer["id"], &answer["error"]["code"]), (&json!("7"), &json!("invalid_request")));
}
