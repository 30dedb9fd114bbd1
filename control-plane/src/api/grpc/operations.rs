//! What each method does: read the message, ask the core, make the answer.

use blaze_domain::config::{Key, Problem};
use blaze_proto::v1;
use serde_json::json;

use super::gate::Call;
use super::{incoming, outgoing};
use crate::api::json;
use crate::core::{Answer, ConfigService, Page, ReadOptions, TokenRequest};

/// The answer of a method, or its refusal.
pub(super) type Done<T> = Result<Answer<T>, Problem>;

/// The methods that answer once.
pub(super) struct Operations {
    pub(super) core: ConfigService,
}

/// The same answer with another value, which may tell the revision too.
fn map<T, U>(answer: Answer<T>, make: impl FnOnce(T, u64) -> U) -> Answer<U> {
    Answer {
        revision: answer.revision,
        replayed: answer.replayed,
        value: make(answer.value, answer.revision),
    }
}

impl Operations {
    pub(super) async fn list(
        &self,
        call: &mut Call,
        request: v1::ListRequest,
    ) -> Done<v1::ListResponse> {
        let (query, read) = incoming::list(request)?;
        let answer = self.core.list(&call.caller, &query, &read).await?;
        Ok(map(answer, outgoing::list))
    }

    pub(super) async fn get(&self, call: &mut Call, request: v1::GetRequest) -> Done<v1::Document> {
        let key = call.about(incoming::key(request.r#ref.as_ref())?);
        let read = incoming::read(request.read);
        call.reveals(&read);
        let answer = self.core.get(&call.caller, &key, &read).await?;
        Ok(map(answer, |document, _| outgoing::document(&document)))
    }

    pub(super) async fn create(
        &self,
        call: &mut Call,
        request: v1::CreateRequest,
    ) -> Done<v1::Document> {
        let idempotency = incoming::idempotency(call.method.name, &request.request_id, &request)?;
        let input = incoming::input(request.document)?;
        call.about(input.key.clone());
        let answer = self.core.create(&call.caller, input, idempotency).await?;
        Ok(map(answer, |written, _| outgoing::written(&written)))
    }

    pub(super) async fn replace(
        &self,
        call: &mut Call,
        request: v1::ReplaceRequest,
    ) -> Done<v1::Document> {
        let input = incoming::input(request.document)?;
        call.about(input.key.clone());
        let precondition = incoming::precondition(request.precondition)?;
        let answer = self.core.replace(&call.caller, input, precondition).await?;
        Ok(map(answer, |written, _| outgoing::written(&written)))
    }

    pub(super) async fn patch(
        &self,
        call: &mut Call,
        request: v1::PatchRequest,
    ) -> Done<v1::Document> {
        let key = call.about(incoming::key(request.r#ref.as_ref())?);
        let patch = incoming::merge_patch(&request.merge_patch_json)?;
        let precondition = incoming::precondition(request.precondition)?;
        let answer = self.core.patch(&call.caller, &key, patch, precondition).await?;
        Ok(map(answer, |written, _| outgoing::written(&written)))
    }

    pub(super) async fn delete(
        &self,
        call: &mut Call,
        request: v1::DeleteRequest,
    ) -> Done<v1::DeleteResponse> {
        let key = call.about(incoming::key(request.r#ref.as_ref())?);
        let precondition = incoming::precondition(request.precondition)?;
        let answer = self.core.delete(&call.caller, &key, precondition, request.cascade).await?;
        Ok(map(answer, |(), revision| v1::DeleteResponse { revision }))
    }

    pub(super) async fn apply(
        &self,
        call: &mut Call,
        request: v1::ApplyRequest,
    ) -> Done<v1::ApplyResponse> {
        let idempotency = incoming::idempotency(call.method.name, &request.request_id, &request)?;
        let request = incoming::apply(request)?;
        let answer = self.core.apply(&call.caller, request, idempotency).await?;
        Ok(map(answer, |report, _| outgoing::applied(&report)))
    }

    pub(super) async fn get_effective(
        &self,
        call: &mut Call,
        request: v1::GetEffectiveRequest,
    ) -> Done<v1::Effective> {
        let place = incoming::place(request.place)?;
        let read = incoming::read(request.read);
        call.reveals(&read);
        let answer = self.core.effective(&call.caller, &place, request.explain, &read).await?;
        Ok(map(answer, outgoing::effective))
    }

    pub(super) async fn list_history(
        &self,
        call: &mut Call,
        request: v1::ListHistoryRequest,
    ) -> Done<v1::ListHistoryResponse> {
        let key = call.about(incoming::key(request.r#ref.as_ref())?);
        let (limit, token) = incoming::page(request.page);
        let read = ReadOptions::default();
        let answer =
            self.core.history(&call.caller, &key, limit, &token, request.full, &read).await?;
        Ok(map(answer, |page, _| outgoing::history(page)))
    }

    pub(super) async fn diff(
        &self,
        call: &mut Call,
        request: v1::DiffRequest,
    ) -> Done<v1::DiffResponse> {
        let key = call.about(incoming::key(request.r#ref.as_ref())?);
        let from = incoming::revision("from_revision", request.from_revision)?;
        let to = (request.to_revision > 0).then_some(request.to_revision);
        let answer = self.core.diff(&call.caller, &key, from, to, &ReadOptions::default()).await?;
        Ok(map(answer, |diff, _| v1::DiffResponse {
            changes: diff.changes.iter().map(outgoing::delta).collect(),
        }))
    }

    pub(super) async fn rollback(
        &self,
        call: &mut Call,
        request: v1::RollbackRequest,
    ) -> Done<v1::Document> {
        let idempotency = incoming::idempotency(call.method.name, &request.request_id, &request)?;
        let key = call.about(incoming::key(request.r#ref.as_ref())?);
        let revision = incoming::revision("revision", request.revision)?;
        let precondition = incoming::precondition(request.precondition)?;
        let answer =
            self.core.rollback(&call.caller, &key, revision, precondition, idempotency).await?;
        Ok(map(answer, |written, _| outgoing::written(&written)))
    }

    pub(super) async fn set_rollout(
        &self,
        call: &mut Call,
        request: v1::SetRolloutRequest,
    ) -> Done<v1::Document> {
        let key = call.about(Key::rollout(incoming::required("name", &request.name)?));
        let name = key.name();
        let answer = match request.action.as_str() {
            "promote" if !request.reason.is_empty() => {
                return Err(incoming::invalid("reason is for abort only"));
            }
            "promote" => {
                call.action = "rollout_promote";
                self.core.promote_rollout(&call.caller, name, None).await?
            }
            "abort" => {
                call.action = "rollout_abort";
                self.core.abort_rollout(&call.caller, name, &request.reason, None).await?
            }
            other => {
                let detail = format!("action {other:?} is not one of promote, abort");
                return Err(incoming::invalid(detail));
            }
        };
        Ok(map(answer, |written, _| outgoing::written(&written)))
    }

    pub(super) async fn get_topology(
        &self,
        call: &mut Call,
        _: v1::GetTopologyRequest,
    ) -> Done<v1::JsonResponse> {
        let answer = self.core.topology(&call.caller, &ReadOptions::default()).await?;
        Ok(map(answer, |topology, _| outgoing::json(&topology)))
    }

    pub(super) async fn list_workers(
        &self,
        call: &mut Call,
        _: v1::ListWorkersRequest,
    ) -> Done<v1::JsonResponse> {
        let answer = self.core.workers(&call.caller, &ReadOptions::default()).await?;
        Ok(map(answer, |workers, _| outgoing::json(&workers)))
    }

    pub(super) async fn list_audit(
        &self,
        call: &mut Call,
        request: v1::ListAuditRequest,
    ) -> Done<v1::JsonResponse> {
        let (query, token) = incoming::audit(&request.filter_json, request.page)?;
        let answer = self.core.audit(&call.caller, query, &token, &ReadOptions::default()).await?;
        Ok(map(answer, |page, revision| {
            outgoing::json(&json::page(&page, revision, json::audit_entry))
        }))
    }

    pub(super) async fn create_token(
        &self,
        call: &mut Call,
        request: v1::CreateTokenRequest,
    ) -> Done<v1::CreateTokenResponse> {
        let request = TokenRequest {
            subject: request.subject,
            roles: request.roles,
            layer: (!request.layer.is_empty()).then_some(request.layer),
            expires_in_s: incoming::life(request.expires_in_s),
        };
        let answer = self.core.create_token(&call.caller, request).await?;
        Ok(map(answer, |(record, text), _| outgoing::token(record, text)))
    }

    pub(super) async fn revoke_token(
        &self,
        call: &mut Call,
        request: v1::RevokeTokenRequest,
    ) -> Done<v1::RevokeTokenResponse> {
        let answer = self.core.revoke_token(&call.caller, &request.id).await?;
        Ok(map(answer, |(), _| v1::RevokeTokenResponse {}))
    }

    pub(super) async fn list_tokens(
        &self,
        call: &mut Call,
        _: v1::ListTokensRequest,
    ) -> Done<v1::JsonResponse> {
        let answer = self.core.tokens(&call.caller, &ReadOptions::default()).await?;
        Ok(map(answer, |items, revision| {
            let page = Page { items, next_page_token: String::new() };
            outgoing::json(&json::page(&page, revision, json::token))
        }))
    }

    pub(super) async fn get_digest(
        &self,
        call: &mut Call,
        request: v1::GetDigestRequest,
    ) -> Done<v1::JsonResponse> {
        let layer = incoming::required("layer", &request.layer)?;
        let answer = self.core.digest(&call.caller, &layer, &ReadOptions::default()).await?;
        Ok(map(answer, |digest, _| outgoing::json(&digest)))
    }

    pub(super) async fn trim(
        &self,
        call: &mut Call,
        request: v1::TrimRequest,
    ) -> Done<v1::JsonResponse> {
        let answer = self.core.trim(&call.caller, request.before, None).await?;
        Ok(map(answer, |oldest, _| outgoing::json(&json!({ "oldest_revision": oldest }))))
    }

    pub(super) async fn revert(
        &self,
        call: &mut Call,
        request: v1::RevertRequest,
    ) -> Done<v1::ApplyResponse> {
        let revision = incoming::revision("revision", request.revision)?;
        let answer = self.core.revert(&call.caller, revision, request.force, None).await?;
        Ok(map(answer, |report, _| outgoing::applied(&report)))
    }
}
