//! Server-sent events from bytes, as they come.

use std::net::SocketAddr;

use bytes::Bytes;
use futures::StreamExt as _;
use futures::stream::BoxStream;
use serde_json::Value;

use super::client::Rest;

/// One event.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Event {
    pub(crate) id: Option<u64>,
    pub(crate) name: String,
    pub(crate) data: Value,
}

/// Makes events of pieces that end anywhere.
#[derive(Debug, Default)]
pub(crate) struct Parser {
    rest: Vec<u8>,
}

impl Parser {
    /// The events that a piece completes.
    pub(crate) fn push(&mut self, piece: &[u8]) -> Vec<Event> {
        // What was there before has no end of an event but in its last byte.
        let mut from = self.rest.len().saturating_sub(1);
        self.rest.extend_from_slice(piece);
        let (mut events, mut begin) = (Vec::new(), 0);
        while let Some(found) = self.rest[from..].windows(2).position(|two| two == b"\n\n") {
            let end = from + found;
            events.extend(event(std::str::from_utf8(&self.rest[begin..end]).unwrap()));
            (begin, from) = (end + 2, end + 2);
        }
        self.rest.drain(..begin);
        events
    }
}

/// `None` for a block without data, as that of `retry` alone.
fn event(block: &str) -> Option<Event> {
    let (mut id, mut name, mut data) = (None, String::new(), None);
    for line in block.lines() {
        match line.split_once(": ").unwrap_or((line, "")) {
            ("id", value) => id = Some(value.parse().unwrap()),
            ("event", value) => name = value.to_owned(),
            ("data", value) => data = Some(serde_json::from_str(value).unwrap()),
            ("retry", value) => assert!((1000..=5000).contains(&value.parse::<u32>().unwrap())),
            (field, _) => panic!("{field:?} in {block:?}"),
        }
    }
    data.map(|data| Event { id, name, data })
}

/// An open stream.
pub(crate) struct Events {
    bytes: BoxStream<'static, reqwest::Result<Bytes>>,
    parser: Parser,
    ready: std::collections::VecDeque<Event>,
}

impl Events {
    /// Opens a watch with these query parameters, after event `last` if one is given.
    ///
    /// # Errors
    /// Status and body of a refusal.
    pub(crate) async fn open(
        rest: &Rest,
        at: SocketAddr,
        query: &str,
        last: Option<u64>,
    ) -> Result<Self, (u16, Value)> {
        let mut request = rest.http.get(format!("http://{at}/api/v1/watch?{query}"));
        // The patience of other requests is not that of a stream.
        request = request.bearer_auth(&rest.token).timeout(std::time::Duration::from_secs(3600));
        if let Some(last) = last {
            request = request.header("last-event-id", last.to_string());
        }
        let response =
            request.send().await.map_err(|error| (0, Value::String(format!("{error:?}"))))?;
        let status = response.status().as_u16();
        if status != 200 {
            let text = response.text().await.unwrap_or_default();
            return Err((status, serde_json::from_str(&text).unwrap_or_default()));
        }
        assert_eq!(response.headers()["content-type"], "text/event-stream");
        Ok(Self {
            bytes: response.bytes_stream().boxed(),
            parser: Parser::default(),
            ready: std::collections::VecDeque::new(),
        })
    }

    /// The next event; `None` at the end of the stream, or when the connection breaks.
    pub(crate) async fn next(&mut self) -> Option<Event> {
        loop {
            if let Some(event) = self.ready.pop_front() {
                return Some(event);
            }
            let piece = self.bytes.next().await?.ok()?;
            self.ready.extend(self.parser.push(&piece));
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn events_are_the_same_however_they_are_cut() {
        let text = "retry: 2731\n\nid: 4\nevent: change\ndata: {\"a\":\"b\\n\"}\n\nid: 5\nevent: bookmark\ndata: 1\n\n";
        let whole = Parser::default().push(text.as_bytes());
        assert_eq!(whole.len(), 2);
        assert_eq!(whole[0].data, json!({ "a": "b\n" }));
        assert_eq!((whole[1].id, whole[1].name.as_str()), (Some(5), "bookmark"));
        for size in 1..text.len() {
            let mut parser = Parser::default();
            let pieces = text.as_bytes().chunks(size).flat_map(|piece| parser.push(piece));
            assert_eq!(pieces.collect::<Vec<_>>(), whole, "{size}");
        }
    }

    #[test]
    fn retry_may_stand_before_the_first_event() {
        let events = Parser::default().push(b"retry: 2731\nid: 4\nevent: bookmark\ndata: {}\n\n");
        assert_eq!(events.len(), 1);
        assert_eq!(events[0].id, Some(4));
    }
}
