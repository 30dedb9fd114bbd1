//! A request with an `Idempotency-Key` is done once.

use super::*;

fn once(body: u8) -> Option<Idempotency> {
    Some(Idempotency { key: "k".to_owned(), path: "/api/v1/layers".to_owned(), body: [body; 32] })
}

#[tokio::test]
async fn the_same_request_twice_is_done_once() {
    let w = world().await;
    let layer = || input("Layer/edge", json!({ "kind": "edge" }));
    let first = w.service.create(&w.admin, layer(), once(1)).await.unwrap();
    let again = w.service.create(&w.admin, layer(), once(1)).await.unwrap();
    assert_eq!((again.replayed, again.revision), (true, first.revision));
    assert_eq!(again.value, first.value);
    assert_eq!(
        code(w.service.create(&w.admin, layer(), once(2)).await),
        Code::IdempotencyKeyReused
    );
    assert_eq!(w.service.revision(), 1);
}

#[tokio::test]
async fn a_request_whose_caller_left_is_not_done_again() {
    let w = world().await;
    let create =
        || w.service.create(&w.admin, input("Layer/edge", json!({ "kind": "edge" })), once(1));
    // Asked once, it stands in the queue; then whoever asked is gone.
    assert!(create().now_or_never().is_none());
    loop {
        match create().await {
            Err(problem) if problem.code == Code::IdempotencyInProgress => {
                tokio::task::yield_now().await;
            }
            again => {
                assert!(again.unwrap().replayed);
                break;
            }
        }
    }
    assert_eq!(w.service.revision(), 1);
}

#[tokio::test]
async fn an_answer_that_another_process_gave_is_told_when_it_can_be_read_here() {
    let supervisor = Supervisor::new("test");
    let store = Arc::new(SqliteStore::in_memory(&supervisor).await.unwrap());
    let (one, other) = (world_on(&store, &[]).await, world_on(&store, &[]).await);
    let layer = || input("Layer/edge", json!({ "kind": "edge" }));
    let first = one.service.create(&one.admin, layer(), once(1)).await.unwrap();
    let again = other.service.create(&other.admin, layer(), once(1)).await.unwrap();
    assert_eq!((again.replayed, again.revision), (true, first.revision));
    let cached = ReadOptions { cached: true, ..ReadOptions::default() };
    let read = other.service.get(&other.admin, &key("Layer/edge"), &cached).await;
    assert_eq!(read.unwrap().revision, first.revision);
}
