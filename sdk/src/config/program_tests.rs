//! A program with a node file against a worker that answers as the contract says.

use std::sync::Arc;
use std::time::Duration;

use blaze_brokers::memory::MemoryHub;
use blaze_runtime::config::{LocatedFault, Overlay, ValueOrigin, Verdict};
use serde_json::json;

use super::tests::{LONG, PlayedWorker, next, slam};
use crate::ServiceManager;

async fn overlay(
    service: &ServiceManager,
    program: &crate::ProgramConfig,
    revision: u64,
) -> Overlay {
    let mut overlays = program.overlays();
    let is_it = |overlay: &Option<Overlay>| {
        overlay.as_ref().is_some_and(|overlay| overlay.revision == revision)
    };
    let told = tokio::time::timeout(LONG, overlays.wait_for(is_it)).await;
    let told = told
        .unwrap_or_else(|_| panic!("revision {revision}; now {:?}", service.config().revision()));
    told.unwrap().clone().unwrap()
}

#[tokio::test(start_paused = true)]
async fn sections_of_the_node_file_are_laid_over_and_judgements_acknowledged() {
    let hub = MemoryHub::new("node");
    let mut worker = PlayedWorker::start(&hub).await;
    let service = slam(&hub).await;
    let program = service.program_config();
    assert!(program.overlays().borrow().is_none());
    let (_, request) = worker.asked().await;
    worker.give(&request, 5, &json!({ "flow": { "pool_threads": 1 }, "camera": { "rate_hz": 1 } }));
    let first = overlay(&service, &program, 5).await;
    assert_eq!(*first.tree, json!({ "flow": { "pool_threads": 1 } }));
    let applied = Verdict { overlay: first.clone(), faults: None };
    program.judged(Some(&applied), "flow.gateway waits");
    let ack = next(&mut worker.acks).await;
    assert_eq!((&ack["status"], &ack["revision"]), (&json!("applied"), &json!(5)));
    assert_eq!((&ack["hash"], &ack["detail"]), (&json!(*first.hash), &json!("flow.gateway waits")));
    worker.tell(6, &json!({ "flow": { "pool_threads": "x" } }), "layer");
    let second = overlay(&service, &program, 6).await;
    let fault = LocatedFault {
        place: ValueOrigin::Overlay { origin: Arc::clone(&second.origin), revision: 6 },
        path: "flow.pool_threads".to_owned(),
        detail: "expected a number".to_owned(),
    };
    // Judged when a newer one has come already: it is acknowledged as the one that it is.
    worker.tell(7, &json!({}), "layer");
    overlay(&service, &program, 7).await;
    let rejected = Verdict { overlay: second.clone(), faults: Some(Arc::from([fault])) };
    program.judged(Some(&rejected), "");
    for _ in 0..3 {
        let ack = next(&mut worker.acks).await;
        assert_eq!((&ack["status"], &ack["hash"]), (&json!("rejected"), &json!(*second.hash)));
        let detail = "BlazeConfig revision 6: flow.pool_threads: expected a number";
        assert_eq!(ack["detail"], detail, "it is said again and again");
    }
    program.judged(Some(&applied), "");
    assert_eq!(next(&mut worker.acks).await["status"], "applied");
    let more = tokio::time::timeout(Duration::from_secs(30), next(&mut worker.acks)).await;
    assert!(more.is_err(), "what is applied is said once");
    worker.say(
        "blaze/config/changed/slam",
        &json!({ "service": "slam", "instance": "0", "layer": "edge", "node": "robot-1",
            "revision": 8, "hash": null,
            "config": null, "deleted": true, "paths": [], "scopes": [] }),
    );
    let mut overlays = program.overlays();
    let gone = tokio::time::timeout(LONG, overlays.wait_for(Option::is_none)).await.is_ok();
    assert!(gone, "a deleted service has no configuration");
    service.shutdown().await;
}
