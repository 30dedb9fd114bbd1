//! A stream of changes, from etcd or BlazeConfig.

use std::convert::Infallible;

use anyhow::Context as _;
use blaze_proto::v1;
use bytes::Bytes;
use futures::future::ready;
use futures::stream::iter;
use futures::{FutureExt as _, StreamExt as _};
use tokio::sync::oneshot;
use tonic::Streaming;
use tonic::transport::Channel;

use super::documents::{Known, step_of};
use super::etcd;
use super::etcd::watch_client::WatchClient;

/// An open watch.
pub(crate) enum Watch {
    Etcd {
        told: Streaming<etcd::WatchResponse>,
        /// The requests go on for as long as this lives, and the watch with them.
        _open: oneshot::Sender<Infallible>,
    },
    Grpc(Streaming<v1::WatchResponse>),
    Rest(Events),
}

impl Watch {
    /// Opens one and waits until it has begun.
    ///
    /// # Errors
    /// When it is refused.
    pub(crate) async fn of_etcd(
        client: &mut WatchClient<Channel>,
        create: etcd::WatchCreateRequest,
    ) -> anyhow::Result<Self> {
        let request = etcd::WatchRequest {
            request_union: Some(etcd::watch_request::RequestUnion::CreateRequest(create)),
        };
        // It ends with the requests. If they went on for ever, so would the watch and its
        // connection, and etcd would have more watchers from one measurement to the next.
        let (open, closed) = oneshot::channel();
        let requests = iter([request])
            .chain(closed.into_stream().filter_map(|_: Result<Infallible, _>| ready(None)));
        let mut stream = client.watch(requests).await?.into_inner();
        let first = stream.message().await?.context("the watch has ended")?;
        anyhow::ensure!(first.created && !first.canceled, "no watch: {}", first.cancel_reason);
        Ok(Self::Etcd { told: stream, _open: open })
    }

    pub(crate) fn of_rest(response: reqwest::Response) -> Self {
        Self::Rest(Events { response, lines: Lines::default() })
    }

    /// What it tells next; nothing if it only says that it lives.
    ///
    /// # Errors
    /// When it ends.
    pub(crate) async fn next(&mut self) -> anyhow::Result<Vec<Known>> {
        const ENDED: &str = "the watch has ended";
        match self {
            Self::Etcd { told, .. } => {
                let response = told.message().await?.context(ENDED)?;
                anyhow::ensure!(!response.canceled, "{ENDED}: {}", response.cancel_reason);
                let pairs = response.events.into_iter().map(|event| {
                    let kv = event.kv.context("an event without a key")?;
                    known(kv.mod_revision.try_into()?, &kv.value)
                });
                pairs.collect()
            }
            Self::Grpc(stream) => {
                let response = stream.message().await?.context(ENDED)?;
                let Some(v1::watch_response::Event::Commit(commit)) = response.event else {
                    return Ok(Vec::new());
                };
                let pairs = commit.changes.into_iter().map(|change| {
                    let document = change.document.context("a change without a document")?;
                    known(commit.revision, document.spec_json.as_bytes())
                });
                pairs.collect()
            }
            Self::Rest(events) => {
                let piece = events.response.chunk().await?.context(ENDED)?;
                events.lines.push(&piece)
            }
        }
    }
}

fn known(revision: u64, spec: &[u8]) -> anyhow::Result<Known> {
    let step =
        step_of(spec).with_context(|| format!("no step in {:?}", String::from_utf8_lossy(spec)))?;
    Ok(Known { revision, step })
}

/// Server-sent events.
pub(crate) struct Events {
    response: reqwest::Response,
    lines: Lines,
}

/// Lines from pieces that end anywhere. Each change of this program's is one document, so its step
/// is enough.
#[derive(Default)]
struct Lines {
    rest: Vec<u8>,
    id: Option<u64>,
}

impl Lines {
    fn push(&mut self, piece: &Bytes) -> anyhow::Result<Vec<Known>> {
        let mut from = self.rest.len();
        self.rest.extend_from_slice(piece);
        let (mut found, mut begin) = (Vec::new(), 0);
        while let Some(length) = self.rest[from..].iter().position(|byte| *byte == b'\n') {
            let line = &self.rest[begin..from + length];
            (begin, from) = (from + length + 1, from + length + 1);
            if let Some(id) = line.strip_prefix(b"id: ") {
                self.id = Some(std::str::from_utf8(id)?.parse()?);
            } else if let Some(step) = line.strip_prefix(b"data: ").and_then(step_of) {
                let revision = self.id.context("a change without an id")?;
                found.push(Known { revision, step });
            }
        }
        self.rest.drain(..begin);
        Ok(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_are_found_however_the_text_is_cut() {
        let text =
            b"retry: 2731\n\nid: 4\nevent: change\ndata: {\"a\":{\"step\":17,\"b\":1}}\n\nid: 5\nevent: bookmark\n\
                     data: {\"revision\":5}\n\nid: 6\nevent: change\ndata: {\"step\":18}\n\n";
        let whole = Lines::default().push(&Bytes::from_static(text)).unwrap();
        assert_eq!(whole, [Known { revision: 4, step: 17 }, Known { revision: 6, step: 18 }]);
        for size in 1..text.len() {
            let mut lines = Lines::default();
            let pieces =
                text.chunks(size).flat_map(|piece| lines.push(&Bytes::from_static(piece)).unwrap());
            assert_eq!(pieces.collect::<Vec<_>>(), whole, "{size}");
        }
    }
}
