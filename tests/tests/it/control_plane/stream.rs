//! One open watch, over either interface, and what it tells.

use blaze_proto::v1;
use blaze_proto::v1::watch_response::Event as Message;
use serde_json::Value;
use tonic::Streaming;
use tonic_types::StatusExt as _;

use super::client::{Client, Via};
use super::sse::{Event, Events};

/// What happened to a document.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Op {
    Create,
    Update,
    Delete,
    Leave,
}

/// One document of a commit.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Change {
    pub(crate) op: Op,
    pub(crate) kind: String,
    pub(crate) name: String,
    pub(crate) revision: u64,
    pub(crate) config: Value,
}

/// One event.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Commit {
    pub(crate) revision: u64,
    /// Told by gRPC alone.
    pub(crate) previous: Option<u64>,
    pub(crate) changes: Vec<Change>,
}

/// What comes next.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Next {
    Commit(Commit),
    Bookmark(u64),
    /// The service ended it, with this code.
    Ended(String),
    /// It ended well, or the connection broke.
    Over,
}

/// Why a watch was not opened.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Refused {
    pub(crate) code: String,
    pub(crate) oldest_revision: Option<u64>,
}

/// An open watch. Taking the next event may be given up at any time; nothing is lost.
pub(crate) enum Stream {
    Rest(Events),
    Grpc(Streaming<v1::WatchResponse>),
}

impl Stream {
    /// Begins after a revision.
    pub(crate) async fn open(client: &Client, since: u64) -> Result<Self, Refused> {
        Self::open_with(client, &format!("since={since}"), None, since).await
    }

    /// Goes on after a revision, as who was cut off does: in REST by the id of the last event,
    /// which counts more than what the address still says.
    pub(crate) async fn resume(client: &Client, last: u64) -> Result<Self, Refused> {
        Self::open_with(client, "since=0", Some(last), last).await
    }

    async fn open_with(
        client: &Client,
        query: &str,
        last: Option<u64>,
        since: u64,
    ) -> Result<Self, Refused> {
        match client.via {
            Via::Rest => {
                let opened = Events::open(&client.rest, client.main.at().rest, query, last).await;
                opened.map(Self::Rest).map_err(|(status, body)| {
                    assert!(status > 0, "no answer: {body}");
                    Refused {
                        code: body["code"].as_str().unwrap_or_default().to_owned(),
                        oldest_revision: body["oldest_revision"].as_u64(),
                    }
                })
            }
            Via::Grpc => {
                let request =
                    v1::WatchRequest { since: Some(since), ..v1::WatchRequest::default() };
                let opened = client.grpc().await.unwrap().watch(client.signed(request)).await;
                opened.map(|answer| Self::Grpc(answer.into_inner())).map_err(|status| {
                    let info =
                        status.get_details_error_info().unwrap_or_else(|| panic!("{status:?}"));
                    Refused {
                        code: info.metadata["code"].clone(),
                        oldest_revision: info
                            .metadata
                            .get("oldest_revision")
                            .map(|text| text.parse().unwrap()),
                    }
                })
            }
        }
    }

    pub(crate) async fn next(&mut self) -> Next {
        match self {
            Self::Rest(events) => events.next().await.map_or(Next::Over, |event| of_event(&event)),
            Self::Grpc(messages) => match messages.message().await {
                Ok(Some(message)) => of_message(message),
                Ok(None) => Next::Over,
                Err(status) => match status.get_details_error_info() {
                    Some(info) => Next::Ended(info.metadata["code"].clone()),
                    None => Next::Over,
                },
            },
        }
    }

    /// The commits until the one of this revision, all of them; or what came instead of one.
    pub(crate) async fn until(&mut self, revision: u64) -> Result<Vec<Commit>, Next> {
        let mut commits = Vec::new();
        loop {
            match self.next().await {
                Next::Commit(commit) => {
                    assert!(
                        commit.revision <= revision,
                        "{} comes and {revision} did not",
                        commit.revision
                    );
                    let is_last = commit.revision == revision;
                    commits.push(commit);
                    if is_last {
                        return Ok(commits);
                    }
                }
                // It says that everything up to there was told.
                Next::Bookmark(bookmark) if bookmark >= revision => return Ok(commits),
                Next::Bookmark(_) => {}
                other @ (Next::Ended(_) | Next::Over) => return Err(other),
            }
        }
    }
}

fn of_event(event: &Event) -> Next {
    let data = &event.data;
    match event.name.as_str() {
        "change" => {
            let revision = data["revision"].as_u64().unwrap();
            assert_eq!(event.id, Some(revision));
            let changes = data["changes"].as_array().unwrap().iter().map(|change| {
                let document = &change["document"];
                assert_eq!(change["name"], document["name"]);
                Change {
                    op: match change["op"].as_str().unwrap() {
                        "create" => Op::Create,
                        "update" => Op::Update,
                        "delete" => Op::Delete,
                        "leave" => Op::Leave,
                        other => panic!("op {other}"),
                    },
                    kind: document["kind"].as_str().unwrap().to_owned(),
                    name: document["name"].as_str().unwrap().to_owned(),
                    revision: document["revision"].as_u64().unwrap(),
                    config: document["spec"]["config"].clone(),
                }
            });
            Next::Commit(Commit { revision, previous: None, changes: changes.collect() })
        }
        "bookmark" => {
            let revision = data["revision"].as_u64().unwrap();
            assert_eq!(event.id, Some(revision));
            Next::Bookmark(revision)
        }
        "error" => {
            assert_eq!(event.id, None, "trouble has no id");
            Next::Ended(data["code"].as_str().unwrap().to_owned())
        }
        other => panic!("event {other}"),
    }
}

fn of_message(message: v1::WatchResponse) -> Next {
    let commit = match message.event.unwrap() {
        Message::Bookmark(revision) => return Next::Bookmark(revision),
        Message::Commit(commit) => commit,
    };
    let changes = commit.changes.into_iter().map(|change| {
        let op = change.op();
        let document = change.document.unwrap();
        let reference = document.r#ref.unwrap();
        let spec: Value = serde_json::from_str(&document.spec_json).unwrap();
        Change {
            op: match op {
                v1::Op::Create => Op::Create,
                v1::Op::Update => Op::Update,
                v1::Op::Delete => Op::Delete,
                v1::Op::Leave => Op::Leave,
                other => panic!("op {other:?}"),
            },
            kind: match reference.kind() {
                v1::Kind::Layer => "Layer",
                v1::Kind::Node => "Node",
                v1::Kind::Service => "Service",
                v1::Kind::Instance => "Instance",
                v1::Kind::Rollout => "Rollout",
                v1::Kind::Unspecified => panic!("a document without kind"),
            }
            .to_owned(),
            name: reference.name,
            revision: document.revision,
            config: spec["config"].clone(),
        }
    });
    Next::Commit(Commit {
        revision: commit.revision,
        previous: Some(commit.previous),
        changes: changes.collect(),
    })
}
