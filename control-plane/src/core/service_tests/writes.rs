//! Writes: what counts as a change, what is told of a refusal, and what takes long.

use super::*;

#[tokio::test]
async fn the_same_number_in_another_form_is_no_change() {
    let w = world().await;
    w.put("Service/s", json!({ "config": { "n": 1, "list": [2.0, { "m": 3 }] } })).await;
    let same =
        w.put("Service/s", json!({ "config": { "n": 1.0, "list": [2, { "m": 3.0 }] } })).await;
    assert_eq!(same.revision, 1);
    let other =
        w.put("Service/s", json!({ "config": { "n": 1.5, "list": [2, { "m": 3.0 }] } })).await;
    assert_eq!(other.revision, 2);
}

#[tokio::test]
async fn a_patch_cannot_take_a_name_away() {
    let w = world().await;
    w.robot().await;
    for (name, patch, pointer) in [
        ("Layer/edge", json!({ "name": null }), "/name"),
        ("Layer/edge", json!({ "kind": null }), "/kind"),
        ("Instance/slam/0", json!({ "service": null }), "/service"),
    ] {
        let problem = w.patch(name, patch).await.unwrap_err();
        assert_eq!(
            (problem.code, problem.errors[0].pointer.as_str()),
            (Code::ValidationFailed, pointer)
        );
    }
    assert_eq!(w.patch("Layer/edge", json!({ "service": null })).await.unwrap().revision, 1);
}

#[tokio::test]
async fn a_refusal_carries_the_revision_of_the_document() {
    let w = world().await;
    w.robot().await;
    w.put("Layer/fog", json!({ "kind": "fog" })).await;
    let used = w.delete("Layer/edge", false).await.unwrap_err();
    assert_eq!((used.code, used.revision), (Code::InUse, Some(1)));
    let missing = w
        .try_put("Layer/x", json!({ "kind": "fog" }), Precondition::Revisions(vec![1]))
        .await
        .unwrap_err();
    assert_eq!(
        (missing.code, missing.revision),
        (Code::PreconditionFailed, Some(2)),
        "that of the store"
    );
    let unsaid =
        w.try_put("Layer/edge", json!({ "kind": "fog" }), Precondition::None).await.unwrap_err();
    assert_eq!((unsaid.code, unsaid.revision), (Code::PreconditionRequired, Some(1)));
    // A document that is gone since.
    w.delete("Layer/fog", false).await.unwrap();
    let gone = w.service.revert(&w.admin, 2, false, None).await.unwrap_err();
    assert_eq!((gone.code, gone.revision), (Code::RevisionConflict, Some(3)));
}

#[tokio::test]
async fn an_idempotency_key_belongs_to_the_subject_whatever_the_order_of_its_roles() {
    let w = world().await;
    let once = |body: u8| {
        Some(Idempotency {
            key: "k".to_owned(),
            path: "/api/v1/layers".to_owned(),
            body: [body; 32],
        })
    };
    let layer = || input("Layer/edge", json!({ "kind": "edge" }));
    let create = async |by: &Caller| w.service.create(by, layer(), once(1)).await;
    create(&caller(&["operator", "viewer"], None)).await.unwrap();
    assert!(create(&caller(&["viewer", "operator"], None)).await.unwrap().replayed);
    assert!(create(&caller(&["admin"], None)).await.unwrap().replayed);
    // Another view is another answer.
    assert!(create(&caller(&["operator"], Some("edge"))).await.is_err());
    // The same key at the same time.
    let other =
        || w.service.create(&w.admin, input("Layer/fog", json!({ "kind": "fog" })), once(2));
    let second = || {
        let once = once(2).map(|once| Idempotency { key: "l".to_owned(), ..once });
        w.service.create(&w.admin, input("Layer/fog", json!({ "kind": "fog" })), once)
    };
    assert_eq!(code(other().await), Code::IdempotencyKeyReused);
    let (one, two) = futures::join!(second(), second());
    let running = [one, two].into_iter().find_map(Result::err).unwrap();
    assert_eq!((running.code, running.revision), (Code::IdempotencyInProgress, Some(1)));
}

#[tokio::test]
async fn an_answer_names_a_hundred_faults_at_most() {
    let w = world().await;
    let names: Vec<String> = (0..300).map(|number| format!("l{number}")).collect();
    let refused =
        w.try_put("Service/s", json!({ "layers": names }), Precondition::None).await.unwrap_err();
    assert_eq!((refused.code, refused.errors.len()), (Code::ReferenceNotFound, 100));
    let nodes: Vec<String> = (0..300).map(|number| format!("Node/n{number}")).collect();
    let items = nodes.iter().map(|name| (name.as_str(), json!({ "layer": "none" })));
    let refused = w.apply(items.collect()).await.unwrap_err();
    assert_eq!((refused.code, refused.errors.len()), (Code::ReferenceNotFound, 100));
}

#[tokio::test]
async fn a_bound_token_does_not_learn_how_many_hidden_documents_refer_to_one() {
    let w = world().await;
    w.robot().await;
    let bound = caller(&["operator"], Some("edge"));
    let refused = async |by: &Caller| {
        let node = key("Node/robot-1");
        let deleted = w.service.delete(by, &node, Precondition::Any, false).await;
        let problem = deleted.unwrap_err();
        assert_eq!(problem.code, Code::InUse);
        problem.detail
    };
    assert!(refused(&bound).await.contains("by Instance/slam/0: "));
    // Hidden from the layer together with its service.
    w.put("Layer/fog", json!({ "kind": "fog" })).await;
    w.put("Service/hidden", json!({ "layers": ["fog"] })).await;
    for number in 0..3 {
        w.put(&format!("Instance/hidden/i{number}"), json!({ "node": "robot-1" })).await;
    }
    let detail = refused(&bound).await;
    assert!(detail.contains("Instance/slam/0, documents that the token does not see"), "{detail}");
    assert!(!detail.contains('3'), "{detail}");
    assert!(refused(&w.admin).await.contains("Instance/hidden/i2"));
}

#[tokio::test]
async fn a_report_that_is_kept_is_the_one_that_was_given() {
    let w = world().await;
    w.robot().await;
    let once = || {
        Some(Idempotency { key: "k".to_owned(), path: "/api/v1/apply".to_owned(), body: [1; 32] })
    };
    let request = || {
        let instances = (0..1000)
            .map(|number| (format!("Instance/slam/i{number}"), json!({ "node": "robot-1" })));
        let items = instances.map(|(name, spec)| ApplyItem {
            input: input(&name, spec),
            revision: None,
            delete: false,
        });
        ApplyRequest { items: items.collect(), ..ApplyRequest::default() }
    };
    let first = w.service.apply(&w.admin, request(), once()).await.unwrap();
    let again = w.service.apply(&w.admin, request(), once()).await.unwrap();
    assert!(again.replayed);
    assert_eq!(first.value, again.value);
    // More places than a kept answer names: both name as many.
    let more = |number: u8| {
        let items = vec![
            ApplyItem {
                input: input("Service/slam", json!({ "config": { "z": number } })),
                revision: None,
                delete: false,
            },
            ApplyItem {
                input: input("Layer/edge", json!({ "kind": "edge", "config": { "y": number } })),
                revision: None,
                delete: false,
            },
        ];
        ApplyRequest { items, ..ApplyRequest::default() }
    };
    let key = || once().map(|once| Idempotency { key: "l".to_owned(), ..once });
    let first = w.service.apply(&w.admin, more(1), key()).await.unwrap().value;
    assert_eq!(first, w.service.apply(&w.admin, more(1), key()).await.unwrap().value);
    assert_eq!(first.affected_total, 1000);
}

#[tokio::test]
async fn a_long_list_without_equals_is_checked_at_once() {
    let w = world().await;
    let schema = json!({ "properties": { "list": { "uniqueItems": true } } });
    let list = |last: u32| {
        let items = (0..12_000).chain([last]);
        items.map(|number| json!({ "n": number })).collect::<Vec<Value>>()
    };
    let begun = std::time::Instant::now();
    w.put("Layer/edge", json!({ "kind": "edge" })).await;
    w.put("Service/s", json!({ "schema": schema, "config": { "list": list(12_000) } })).await;
    let twice = json!({ "schema": schema, "config": { "list": list(5) } });
    let refused = w.try_put("Service/s", twice, Precondition::Any).await;
    assert_eq!(code(refused), Code::SchemaMismatch);
    // To compare each with each takes a hundred times as long.
    assert!(begun.elapsed() < Duration::from_secs(20), "{:?}", begun.elapsed());
}

#[tokio::test]
async fn dry_runs_do_not_stop_what_is_served_beside_them() {
    let w = world().await;
    w.put("Layer/edge", json!({ "kind": "edge" })).await;
    let schema = json!({ "properties": { "list": { "uniqueItems": true } } });
    let list: Vec<Value> = (0..2000).map(|number| json!({ "n": number })).collect();
    let dry = || {
        let request = ApplyRequest {
            items: vec![ApplyItem {
                input: input("Service/s", json!({ "schema": schema, "config": { "list": list } })),
                revision: None,
                delete: false,
            }],
            dry_run: true,
            ..ApplyRequest::default()
        };
        w.service.apply(&w.admin, request, None)
    };
    // On the one thread of this test nothing else would come to its turn while a dry run takes it.
    let mut turns = 0_u32;
    let mut runs = Box::pin(futures::future::join_all((0..4).map(|_| dry())));
    let reports = loop {
        match futures::poll!(&mut runs) {
            std::task::Poll::Ready(reports) => break reports,
            std::task::Poll::Pending => {
                turns += 1;
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        }
    };
    assert!(turns > 1, "{turns}");
    assert!(reports.iter().all(Result::is_ok));
    // Those that would wait too long are told so.
    let many = futures::future::join_all((0..100).map(|_| dry())).await;
    assert!(many.iter().any(Result::is_ok));
    let refused: Vec<&Problem> = many.iter().filter_map(|result| result.as_ref().err()).collect();
    assert!(!refused.is_empty());
    assert!(refused.iter().all(|problem| problem.code == Code::Overloaded));
}

#[tokio::test]
async fn many_writers_with_preconditions_lose_nothing() {
    let w = world().await;
    w.put("Service/counter", json!({ "config": { "n": 0 } })).await;
    let one = async |_: usize| {
        let mut done = 0;
        while done < 25 {
            let now = w.get("Service/counter").await.unwrap();
            let n = now.spec["config"]["n"].as_u64().unwrap();
            let next = json!({ "config": { "n": n + 1 } });
            match w
                .try_put("Service/counter", next, Precondition::Revisions(vec![now.revision]))
                .await
            {
                Ok(_) => done += 1,
                Err(problem) => assert_eq!(problem.code, Code::PreconditionFailed),
            }
        }
    };
    futures::future::join_all((0..8).map(one)).await;
    assert_eq!(w.get("Service/counter").await.unwrap().spec["config"]["n"], 200);
    assert_eq!(w.service.revision(), 201);
}
