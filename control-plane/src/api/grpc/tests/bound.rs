//! A token that is bound to one layer: every method that can name something of another one refuses,
//! existing or not, and the others leave it out.

use std::collections::BTreeSet;

use super::*;

/// One who asks with a token of their own.
struct Asking<'a> {
    fixture: &'a Fixture,
    authorization: String,
}

impl<'a> Asking<'a> {
    fn new(fixture: &'a Fixture, role: &str, layer: Option<&str>) -> Self {
        let authorization = format!("Bearer {}", fixture.token_for(role, layer, 3600));
        Self { fixture, authorization }
    }

    async fn post(&self, method: &str, message: &[u8]) -> fixture::Posted {
        let headers = [("authorization", self.authorization.as_str())];
        self.fixture.post(&format!("{PATH}{method}"), &headers, message).await
    }

    async fn answer<T: Message + Default>(&self, method: &str, message: &impl Message) -> T {
        let posted = self.post(method, &message.encode_to_vec()).await;
        assert_eq!(posted.status.code(), tonic::Code::Ok, "{method}: {:?}", posted.status);
        T::decode(&posted.body[5..]).unwrap()
    }
}

fn node(name: &str) -> Option<v1::Ref> {
    reference(v1::Kind::Node, name)
}

fn on(name: &str, layer: &str) -> Option<v1::Document> {
    Some(v1::Document {
        r#ref: node(name),
        spec_json: format!(r#"{{"layer":"{layer}"}}"#),
        ..Default::default()
    })
}

fn apply(documents: impl IntoIterator<Item = Option<v1::Document>>) -> v1::ApplyRequest {
    let item = |document| v1::ApplyItem { document, delete: false };
    v1::ApplyRequest { items: documents.into_iter().map(item).collect(), ..Default::default() }
}

fn get(name: &str) -> v1::GetRequest {
    v1::GetRequest { r#ref: node(name), read: None }
}

fn effective(node: &str, layer: &str) -> v1::GetEffectiveRequest {
    v1::GetEffectiveRequest {
        place: Some(v1::Place { node: node.into(), layer: layer.into(), ..Default::default() }),
        ..Default::default()
    }
}

/// What touches the other layer, or all of them. Everything that is there was made in revision 1.
fn outside() -> Vec<(&'static str, Vec<u8>)> {
    let any = Some(v1::Precondition { is: Some(v1::precondition::Is::Any(true)) });
    let replace = |document| v1::ReplaceRequest { document, precondition: any };
    let create = v1::CreateRequest { document: on("f2", "fog"), ..Default::default() };
    let patch = v1::PatchRequest {
        r#ref: node("f1"),
        merge_patch_json: r#"{"labels":{"a":"b"}}"#.into(),
        precondition: any,
    };
    let delete = v1::DeleteRequest { r#ref: node("f1"), precondition: any, cascade: false };
    let history = v1::ListHistoryRequest { r#ref: node("f1"), ..Default::default() };
    let diff = v1::DiffRequest { r#ref: node("f1"), from_revision: 1, to_revision: 1 };
    let rollback = v1::RollbackRequest { r#ref: node("f1"), revision: 1, ..Default::default() };
    let watch = v1::WatchRequest {
        since: Some(0),
        layer: "fog".into(),
        // One that is not refused ends too.
        timeout_s: 1,
        ..Default::default()
    };
    let rollout = v1::SetRolloutRequest {
        name: "of-fog".into(),
        action: "abort".into(),
        reason: String::new(),
    };
    let token = v1::CreateTokenRequest {
        subject: "ops".into(),
        roles: vec!["admin".into()],
        ..Default::default()
    };
    let revert = v1::RevertRequest { revision: 1, force: true };
    vec![
        ("Get", get("f1").encode_to_vec()),
        ("Get", get("absent").encode_to_vec()),
        ("Create", create.encode_to_vec()),
        ("Replace", replace(on("f1", "fog")).encode_to_vec()),
        ("Replace", replace(on("e1", "fog")).encode_to_vec()),
        ("Patch", patch.encode_to_vec()),
        ("Delete", delete.encode_to_vec()),
        ("Apply", apply([on("e2", "edge"), on("f1", "fog")]).encode_to_vec()),
        ("GetEffective", effective("f1", "").encode_to_vec()),
        ("GetEffective", effective("", "fog").encode_to_vec()),
        ("ListHistory", history.encode_to_vec()),
        ("Diff", diff.encode_to_vec()),
        ("Rollback", rollback.encode_to_vec()),
        ("Watch", watch.encode_to_vec()),
        ("SetRollout", rollout.encode_to_vec()),
        ("ListAudit", v1::ListAuditRequest::default().encode_to_vec()),
        ("CreateToken", token.encode_to_vec()),
        ("RevokeToken", v1::RevokeTokenRequest { id: "absent".into() }.encode_to_vec()),
        ("ListTokens", v1::ListTokensRequest {}.encode_to_vec()),
        ("GetDigest", v1::GetDigestRequest { layer: "fog".into() }.encode_to_vec()),
        ("Trim", v1::TrimRequest { before: 1 }.encode_to_vec()),
        ("Revert", revert.encode_to_vec()),
    ]
}

#[tokio::test]
async fn a_token_of_one_layer_is_refused_by_every_method_to_another() {
    let fixture = Fixture::guarded().await;
    let all = Asking::new(&fixture, "admin", None);
    let layers = ["edge", "fog"].map(|name| layer(name, &format!(r#"{{"kind":"{name}"}}"#)));
    let made = apply(layers.into_iter().chain([on("e1", "edge"), on("f1", "fog")]));
    let made: v1::ApplyResponse = all.answer("Apply", &made).await;
    assert_eq!(made.revision, 1);

    // An administrator of one layer has every right: only the layer can be in the way.
    let bound = Asking::new(&fixture, "admin", Some("edge"));
    let cases = outside();
    let walked: BTreeSet<&str> = cases.iter().map(|(method, _)| *method).collect();
    let filtered = ["List", "GetTopology", "ListWorkers"];
    let table = METHODS.iter().map(|method| method.name);
    assert_eq!(
        walked,
        table.filter(|name| !filtered.contains(name)).collect(),
        "every method is walked"
    );
    for (method, message) in &cases {
        let posted = bound.post(method, message).await;
        assert_eq!(
            posted.status.code(),
            tonic::Code::PermissionDenied,
            "{method}: {:?}",
            posted.status
        );
        assert_eq!(code(&posted.status), Code::PermissionDenied, "{method}");
        assert_eq!(posted.headers["blaze-revision"], "1", "{method} wrote nothing");
    }

    let list = v1::ListRequest { kind: v1::Kind::Node.into(), ..Default::default() };
    for (asking, seen) in [(&bound, &["e1"][..]), (&all, &["e1", "f1"])] {
        let listed: v1::ListResponse = asking.answer("List", &list).await;
        let names = listed.items.iter().map(|item| item.r#ref.as_ref().unwrap().name.as_str());
        assert_eq!(names.collect::<Vec<_>>(), seen);
        let topology: v1::JsonResponse =
            asking.answer("GetTopology", &v1::GetTopologyRequest {}).await;
        for name in ["e1", "f1"] {
            let is_there = topology.json.contains(&format!("\"{name}\""));
            assert_eq!(is_there, seen.contains(&name), "{name}: {}", topology.json);
        }
        // The same within the layer is answered.
        let _: v1::Document = asking.answer("Get", &get("e1")).await;
        let _: v1::Effective = asking.answer("GetEffective", &effective("e1", "")).await;
        let digest = v1::GetDigestRequest { layer: "edge".into() };
        let _: v1::JsonResponse = asking.answer("GetDigest", &digest).await;
    }
    let _: v1::ApplyResponse = bound.answer("Apply", &apply([on("e2", "edge")])).await;
}
