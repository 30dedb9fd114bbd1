//! What becomes of a copy that can be read only after the start.

use super::hear::{canary_documents, rollout};
use super::*;

impl World {
    async fn finds(&self, loaded: Loaded) {
        self.finds_of(false, loaded).await;
    }

    /// Another worker of the layer has written it, or nobody knew what was there.
    async fn finds_of(&self, is_of_another: bool, loaded: Loaded) {
        let (taken, is_taken) = oneshot::channel();
        let place = "database".to_owned();
        let found = Found { place, loaded, is_of_another, taken };
        self.found.send(found).await.unwrap();
        is_taken.await.unwrap();
    }

    async fn rate(&mut self) -> Value {
        self.slam().await["config"]["rate_hz"].clone()
    }
}

#[tokio::test(start_paused = true)]
async fn what_the_database_has_newer_is_served_before_the_main_service_answers() {
    let mut w = world_from(Some(copy_of("s", 2, documents(30))), true);
    assert_eq!(w.rate().await, 30);
    w.rest().await;
    w.finds(copy_of("s", 4, documents(40))).await;
    let (_, notice) = w.notice().await;
    assert_eq!(
        (&notice["revision"], &notice["config"]["rate_hz"], &notice["source"]),
        (&json!(4), &json!(40), &json!("copy"))
    );
    w.rest().await;
    assert_eq!(w.rate().await, 40);
    assert_eq!(w.hello().await.revision, 4);
    // Also what the main service told before it went away may be the older one: another worker of
    // the layer writes there.
    w.opens(documents(50), 5).await;
    w.rest().await;
    w.closes().await;
    w.rest().await;
    w.finds(copy_of("s", 6, documents(60))).await;
    w.rest().await;
    assert_eq!(w.rate().await, 60);
}

#[tokio::test(start_paused = true)]
async fn an_older_state_another_store_and_a_main_service_that_answers_leave_what_is_served() {
    let mut w = world_from(Some(copy_of("s", 4, documents(40))), true);
    w.rest().await;
    w.finds(copy_of("s", 3, documents(30))).await;
    w.finds(copy_of("other", 9, documents(90))).await;
    w.rest().await;
    assert_eq!((w.rate().await, w.hello().await.revision), (json!(40), 4));
    w.opens(documents(50), 5).await;
    w.finds(copy_of("s", 6, documents(60))).await;
    w.rest().await;
    assert_eq!(w.rate().await, 50);
}

#[tokio::test(start_paused = true)]
async fn what_is_found_is_better_than_the_mounted_file() {
    let mut w = world();
    w.defaults.send_replace(file(1));
    w.rest().await;
    assert_eq!(w.slam().await["source"], "file");
    w.rest().await;
    w.finds(copy_of("s", 4, documents(40))).await;
    let (_, notice) = w.notice().await;
    assert_eq!((&notice["config"]["rate_hz"], &notice["source"]), (&json!(40), &json!("copy")));
}

#[tokio::test(start_paused = true)]
async fn notes_of_another_worker_count_with_its_documents_alone() {
    let mut w = world_from(Some(copy_of("s", 2, documents(30))), true);
    w.slam().await;
    w.rest().await;
    // Not newer than what is served: what the other one told of it is its own affair.
    w.finds_of(true, with_place("1", copy_of("s", 2, documents(30)))).await;
    assert_eq!(w.rest().await, []);
    w.finds_of(true, with_place("1", copy_of("s", 6, documents(30)))).await;
    let (_, notice) = w.notice().await;
    assert_eq!((&notice["instance"], &notice["revision"]), (&json!("1"), &json!(6)));
}

#[tokio::test(start_paused = true)]
async fn texts_of_secrets_that_are_found_are_told() {
    let with = |revision, value: Value| {
        let mut all = documents(30);
        all[3] =
            document("Service/slam", 2, json!({ "config": { "password": { "$secret": value } } }));
        copy_of("s", revision, all)
    };
    let mut w = world_from(Some(with(2, json!({ "redacted": true, "version": 2 }))), true);
    let hash = w.slam().await["hash"].clone();
    w.rest().await;
    w.finds(with(3, json!({ "text": "canary", "version": 2 }))).await;
    let told = w.rest().await;
    let is_key = |seen: &Seen| {
        matches!(
            seen,
            Seen::Key(_, Some(value)) if value["config"]["password"] == "canary",
        )
    };
    assert!(told.iter().any(is_key), "{told:?}");
    let request = json!({
        "id": "1",
        "service": "slam",
        "instance": "0",
        "hash": hash,
        "reply_to": "blaze/reply/t",
    });
    assert_eq!(w.asks(request).await["config"]["password"], "canary");
}

#[tokio::test(start_paused = true)]
async fn a_roll_out_that_failed_in_another_life_is_undone() {
    let mut documents = canary_documents();
    documents.push(document("Instance/slam/0", 2, json!({ "node": "robot-1" })));
    documents.push(rollout(2, "u-1", 500));
    let mut w = world_from(Some(copy_of("s", 2, documents.clone())), true);
    w.rest().await;
    assert_eq!(w.rate().await, 500);
    let notes = Arc::new(Notes { failed: vec!["u-1".to_owned()], ..Notes::default() });
    w.finds(Loaded { notes, ..copy_of("s", 2, documents) }).await;
    assert_eq!(w.rates().await, [json!(30)]);
    assert_eq!(w.status().await.json["rollouts"][0]["phase"], "failed");
}
