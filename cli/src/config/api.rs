//! What the commands ask of the main service: pages joined, documents by name, changes with
//! preconditions.

use blaze_domain::config::{Key, Kind};
use blaze_domain::{LayerName, NodeName, ServiceName};
use serde_json::{Value, json};

use super::call::Call;
use super::client::{Answer, Client};
use super::kinds::{BASE, collection_path, document_path};
use super::refusal::Refusal;
use super::text::list;
use crate::admin::closest;
use crate::exit::CliError;

/// Largest page.
const PAGE: u64 = 1_000;
/// Pages of one listing: more entries than a store can hold.
const MAX_PAGES: usize = 1_000;
/// How often a listing begins anew when what it had begun with is gone.
const MAX_BEGINNINGS: usize = 3;

/// Which documents.
#[derive(Debug, Clone, Default)]
pub(crate) struct Filter {
    /// Instances of this service.
    pub(crate) service: Option<ServiceName>,
    /// Kubernetes label selector.
    pub(crate) selector: Option<String>,
    /// In this layer.
    pub(crate) layer: Option<LayerName>,
    /// On this node.
    pub(crate) node: Option<NodeName>,
    /// At most so many; `None`: all.
    pub(crate) limit: Option<u64>,
    /// With the text of secrets.
    pub(crate) reveal: bool,
}

/// All pages of a listing.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Listing {
    pub(crate) items: Vec<Value>,
    /// What all pages reflect.
    pub(crate) revision: Option<u64>,
    /// Not empty where a limit ended it.
    pub(crate) next_page_token: String,
}

impl Listing {
    /// As one page of the API.
    pub(crate) fn into_json(self) -> Value {
        json!({
            "items": self.items,
            "revision": self.revision,
            "next_page_token": self.next_page_token,
        })
    }

    /// Whether a limit ended it.
    pub(crate) fn is_cut(&self) -> bool {
        !self.next_page_token.is_empty()
    }
}

impl Client {
    /// Documents of a kind.
    ///
    /// # Errors
    /// As [`Self::send`], and [`CliError::Foreign`] for pages that do not end.
    pub(crate) async fn list(&self, kind: Kind, filter: &Filter) -> Result<Listing, CliError> {
        let call = Call::get(collection_path(kind, filter.service.as_ref()))
            .query_if("label_selector", filter.selector.clone())
            .query_if("layer", filter.layer.as_ref().map(LayerName::as_str))
            .query_if("node", filter.node.as_ref().map(NodeName::as_str))
            .query_if("reveal", filter.reveal.then_some("true"));
        self.pages(&call, filter.limit).await
    }

    /// All pages of a listing, or as many entries as are wanted. It begins anew when what its first
    /// page reflected is trimmed in between.
    ///
    /// # Errors
    /// As [`Self::send`], and [`CliError::Foreign`] for pages that do not end.
    pub(crate) async fn pages(&self, call: &Call, limit: Option<u64>) -> Result<Listing, CliError> {
        let mut beginnings = 1;
        loop {
            match self.pages_once(call, limit).await {
                Err(CliError::Problem(refusal))
                    if refusal.status == 410 && beginnings < MAX_BEGINNINGS =>
                {
                    beginnings += 1;
                }
                other => return other,
            }
        }
    }

    async fn pages_once(&self, call: &Call, limit: Option<u64>) -> Result<Listing, CliError> {
        let mut listing = Listing::default();
        for _ in 0..MAX_PAGES {
            let missing = limit.map(|limit| limit.saturating_sub(listing.items.len() as u64));
            let page = call
                .clone()
                .query("limit", missing.unwrap_or(PAGE).clamp(1, PAGE).to_string())
                .query_if(
                    "page_token",
                    Some(listing.next_page_token.as_str()).filter(|token| !token.is_empty()),
                );
            let mut answer = self.send(&page).await?;
            let items = answer.body.get_mut("items").and_then(Value::as_array_mut);
            let items = items.ok_or_else(|| self.odd("a list has no `items`"))?;
            listing.items.append(items);
            listing.revision =
                answer.body.get("revision").and_then(Value::as_u64).or(answer.revision);
            let next = answer.body.get("next_page_token").and_then(Value::as_str);
            let next = next.unwrap_or_default();
            let repeated = !next.is_empty() && next == listing.next_page_token;
            listing.next_page_token = next.to_owned();
            let full = limit.is_some_and(|limit| listing.items.len() as u64 >= limit);
            if next.is_empty() || full {
                return Ok(listing);
            }
            if repeated {
                break;
            }
        }
        Err(self.odd("the pages of a list do not end"))
    }

    /// One document, with its entity tag. Where there is none of that name, the error says which
    /// may have been meant.
    ///
    /// # Errors
    /// As [`Self::send`].
    pub(crate) async fn document(
        &self,
        key: &Key,
        revision: Option<u64>,
    ) -> Result<Answer, CliError> {
        self.read_document(key, revision, false).await
    }

    /// As [`Self::document`]; with `reveal`, secrets have their text.
    ///
    /// # Errors
    /// As [`Self::send`].
    pub(crate) async fn read_document(
        &self,
        key: &Key,
        revision: Option<u64>,
        reveal: bool,
    ) -> Result<Answer, CliError> {
        let call = Call::get(document_path(key))
            .query_if("revision", revision.map(|revision| revision.to_string()))
            .query_if("reveal", reveal.then_some("true"));
        self.send_about(key, &call).await
    }

    /// One document, or `None` where there is none.
    ///
    /// # Errors
    /// As [`Self::send`] otherwise.
    pub(crate) async fn existing(&self, key: &Key) -> Result<Option<Answer>, CliError> {
        match self.send(&Call::get(document_path(key))).await {
            Ok(answer) => Ok(Some(answer)),
            Err(CliError::Problem(refusal)) if refusal.code() == "not_found" => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// The value of `If-Match` for a change of a document: that it is as it was read, or, with
    /// `force`, that it exists.
    ///
    /// # Errors
    /// As [`Self::document`].
    pub(crate) async fn precondition(&self, key: &Key, force: bool) -> Result<String, CliError> {
        match force {
            true => Ok("*".to_owned()),
            false => self.tag(&self.document(key, None).await?, false),
        }
    }

    /// The same for a document that was read already.
    ///
    /// # Errors
    /// [`CliError::Foreign`] without an entity tag: a change could not be fenced.
    pub(crate) fn tag(&self, read: &Answer, force: bool) -> Result<String, CliError> {
        let tag = if force { Some("*".to_owned()) } else { read.etag.clone() };
        tag.ok_or_else(|| self.odd("a document came without an ETag"))
    }

    /// Sends something about a document; a name that does not exist gets a suggestion.
    ///
    /// # Errors
    /// As [`Self::send`].
    pub(crate) async fn send_about(&self, key: &Key, call: &Call) -> Result<Answer, CliError> {
        match self.send(call).await {
            Err(CliError::Problem(refusal)) => Err(self.with_suggestion(*refusal, key).await),
            other => other,
        }
    }

    /// The workers of all layers.
    ///
    /// # Errors
    /// As [`Self::send`], and [`CliError::Foreign`] for what is no list.
    pub(crate) async fn workers(&self) -> Result<Value, CliError> {
        let answer = self.send(&Call::get(format!("{BASE}/workers"))).await?;
        if answer.body.get("items").is_some_and(Value::is_array) {
            Ok(answer.body)
        } else {
            Err(self.odd("the workers are no list"))
        }
    }

    async fn with_suggestion(&self, refusal: Refusal, key: &Key) -> CliError {
        let told = refusal.problem.get("detail").and_then(Value::as_str);
        let meant = if refusal.code() == "not_found"
            && !told.is_some_and(|detail| detail.contains("did you mean"))
        {
            self.meant(key).await
        } else {
            None
        };
        CliError::Problem(Box::new(match meant {
            Some(meant) => refusal.with_hint(format!("did you mean {meant}?")),
            None => refusal,
        }))
    }

    /// The document whose name is most like one that does not exist. What goes wrong here is no
    /// reason to say anything else.
    async fn meant(&self, key: &Key) -> Option<String> {
        if let Some(service) = key.service_name() {
            let siblings = self.names(Kind::Instance, Some(service)).await;
            if let Some(name) = nearest(key.name().as_str(), &siblings) {
                return Some(format!("{service}/{name}"));
            }
            let services = self.names(Kind::Service, None).await;
            let near = nearest(service.as_str(), &services)?;
            return Some(format!("{near}/{}", key.name()));
        }
        let names = self.names(key.kind(), None).await;
        nearest(key.name().as_str(), &names).map(str::to_owned)
    }

    async fn names(&self, kind: Kind, service: Option<&ServiceName>) -> Vec<String> {
        let call = Call::get(collection_path(kind, service)).query("limit", PAGE.to_string());
        let body = self.send(&call).await.map_or(Value::Null, |answer| answer.body);
        let names = list(&body, "items").iter().filter_map(|item| item.get("name")?.as_str());
        names.map(str::to_owned).collect()
    }

    /// An answer that did not come while somebody waited for it.
    pub(crate) fn silent(&self) -> CliError {
        CliError::NoServer {
            server: self.server().to_owned(),
            reason: "no answer in time".to_owned(),
            advice: "It may be busy: try again.".to_owned(),
        }
    }

    /// An answer that is not as the contract says.
    pub(crate) fn odd(&self, reason: impl Into<String>) -> CliError {
        CliError::Foreign { server: self.server().to_owned(), reason: reason.into() }
    }
}

fn nearest<'a>(wanted: &str, names: &'a [String]) -> Option<&'a str> {
    closest(wanted, names.iter().map(String::as_str))
}

/// The members that the server sets.
const SERVER_MEMBERS: [&str; 6] =
    ["uid", "revision", "create_time", "update_time", "updated_by", "status"];

/// A document without the members that the server sets: what can be applied again.
pub(crate) fn clean(mut document: Value) -> Value {
    if let Value::Object(members) = &mut document {
        for name in SERVER_MEMBERS {
            members.shift_remove(name);
        }
    }
    document
}

#[cfg(test)]
#[path = "api_tests.rs"]
mod tests;
