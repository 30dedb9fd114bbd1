//! One request, before it is sent.

use reqwest::{Method, Url};
use serde_json::Value;

/// One request.
#[derive(Debug, Clone)]
pub(crate) struct Call {
    pub(super) method: Method,
    /// Made of names alone, so that nothing in it has to be encoded.
    path: String,
    query: Vec<(&'static str, String)>,
    pub(super) if_match: Option<String>,
    pub(super) last_event_id: Option<String>,
    /// Media type and content.
    pub(super) body: Option<(&'static str, Vec<u8>)>,
    /// It changes nothing: a broken connection leaves no doubt.
    pub(super) harmless: bool,
}

impl Call {
    fn new(method: Method, path: impl Into<String>, body: Option<(&'static str, &Value)>) -> Self {
        Self {
            harmless: method == Method::GET,
            method,
            path: path.into(),
            query: Vec::new(),
            if_match: None,
            last_event_id: None,
            body: body.map(|(kind, value)| (kind, value.to_string().into_bytes())),
        }
    }

    /// Reads.
    pub(crate) fn get(path: impl Into<String>) -> Self {
        Self::new(Method::GET, path, None)
    }

    /// Sends JSON.
    pub(crate) fn post(path: impl Into<String>, body: &Value) -> Self {
        Self::new(Method::POST, path, Some(("application/json", body)))
    }

    /// Replaces.
    pub(crate) fn put(path: impl Into<String>, body: &Value) -> Self {
        Self::new(Method::PUT, path, Some(("application/json", body)))
    }

    /// Changes a part (RFC 7396).
    pub(crate) fn patch(path: impl Into<String>, body: &Value) -> Self {
        Self::new(Method::PATCH, path, Some(("application/merge-patch+json", body)))
    }

    /// Deletes.
    pub(crate) fn delete(path: impl Into<String>) -> Self {
        Self::new(Method::DELETE, path, None)
    }

    /// With a query parameter.
    pub(crate) fn query(mut self, name: &'static str, value: impl Into<String>) -> Self {
        self.query.push((name, value.into()));
        self
    }

    /// With a query parameter, if there is a value.
    pub(crate) fn query_if(self, name: &'static str, value: Option<impl Into<String>>) -> Self {
        match value {
            Some(value) => self.query(name, value),
            None => self,
        }
    }

    /// With a precondition: an entity tag as the server gave it, or `*`.
    pub(crate) fn if_match(mut self, tag: Option<String>) -> Self {
        self.if_match = tag;
        self
    }

    /// After this event.
    pub(crate) fn after(mut self, id: Option<String>) -> Self {
        self.last_event_id = id;
        self
    }

    /// It changes nothing: a broken connection leaves no doubt.
    pub(crate) fn harmless(mut self) -> Self {
        self.harmless = true;
        self
    }

    /// Where it goes.
    pub(super) fn url(&self, server: &Url) -> Url {
        let mut url = server.clone();
        url.set_path(&self.path);
        if !self.query.is_empty() {
            url.query_pairs_mut().extend_pairs(&self.query);
        }
        url
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::endpoint::parse_server;

    #[test]
    fn queries_are_encoded_and_paths_kept() {
        let server = parse_server("http://127.0.0.1:8080").unwrap();
        let call = Call::get("/api/v1/services/-/instances")
            .query("label_selector", "a=b,!c&d")
            .query("page_token", "x+/=");
        assert_eq!(
            call.url(&server).as_str(),
            "http://127.0.0.1:8080/api/v1/services/-/instances?label_selector=a%3Db%2C%21c%26d&page_token=x%2B%2F%3D"
        );
        assert_eq!(
            Call::get("/api/v1/nodes").url(&server).as_str(),
            "http://127.0.0.1:8080/api/v1/nodes"
        );
    }
}
