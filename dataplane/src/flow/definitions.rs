//! Definitions of ROS 2 types that others have: nodes of the own ROS 2 network, and other flows.
//!
//! ```text
//! Types ──wish──► queue ─► types task ─► get_type_description of a node ─┐
//! TypeRequest ─────┘                └─► TypeRequest ─► flow ─► TypeDefinition ─► Types::add
//!                                   └─► TypeDefinition, to the flow that asked
//! ```
//!
//! Nothing waits for it but whoever wants the definition, and all of it is bounded: wishes that
//! wait, those that are looked after at once, the time for each, and what is kept.

mod node;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_convert::{Definition, TypeDescription, definition_text, parse_joined};
use blaze_domain::{FlowId, Scope};
use blaze_proto::link::link_control::{Body, TypeDefinition, TypeRequest};
use futures::{StreamExt as _, stream};
use parking_lot::Mutex;
use tokio::sync::{mpsc, oneshot};
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;

use super::Shared;
use crate::types::{MessageType, Others, Parts, SEARCH, Types, Wish, parts_of, seek};
use crate::world::{Reach, TopicEntry};

/// Wishes that wait.
const MAX_WISHES: usize = 256;
/// Wishes that are looked after at once.
const AT_ONCE: usize = 8;
/// After this time without an answer a node or flow is asked again.
const ANSWER: Duration = Duration::from_millis(1500);
/// Longest name of a type in a request, and longest hash.
const MAX_NAME: usize = 255;
const MAX_HASH: usize = 80;

/// What is asked of other flows, and by them.
pub(crate) struct Definitions {
    wishes: mpsc::Sender<Wish>,
    /// Flows that were asked, and what has come of them.
    asked: Mutex<BTreeMap<(FlowId, MessageType), Asked>>,
    /// What other flows have asked for and wait for.
    answering: Mutex<BTreeSet<(FlowId, MessageType)>>,
}

struct Asked {
    parts: Parts,
    done: Option<oneshot::Sender<String>>,
}

impl Definitions {
    pub(super) fn new() -> (Self, mpsc::Receiver<Wish>) {
        let (wishes, queue) = mpsc::channel(MAX_WISHES);
        (Self { wishes, asked: Mutex::default(), answering: Mutex::default() }, queue)
    }

    pub(super) fn wishes(&self) -> mpsc::Sender<Wish> {
        self.wishes.clone()
    }

    /// Remembers what a flow is asked for, until its answer is no longer waited for.
    fn ask(&self, flow: &FlowId, ty: &MessageType) -> oneshot::Receiver<String> {
        let (done, came) = oneshot::channel();
        let mut all = self.asked.lock();
        all.retain(|_, asked| asked.done.as_ref().is_some_and(|done| !done.is_closed()));
        let asked = Asked { parts: Parts::default(), done: Some(done) };
        all.insert((flow.clone(), ty.clone()), asked);
        came
    }

    /// Takes what another flow asks for, or answers. Who gets no answer asks again.
    pub(super) fn take(&self, from: FlowId, body: Body) {
        match body {
            Body::TypeRequest(TypeRequest { r#type, hash }) => {
                if r#type.len() > MAX_NAME || hash.len() > MAX_HASH {
                    return;
                }
                let ty = MessageType { name: r#type, hash };
                let key = (from.clone(), ty.clone());
                if self.answering.lock().insert(key.clone())
                    && self.wishes.try_send(Wish { ty, asker: Some(from) }).is_err()
                {
                    self.answering.lock().remove(&key);
                }
            }
            Body::TypeDefinition(part) => self.take_part(from, part),
            _ => {}
        }
    }

    /// Parts that nobody asked for are passed over.
    fn take_part(&self, from: FlowId, part: TypeDefinition) {
        let ty = MessageType { name: part.r#type.clone(), hash: part.hash.clone() };
        let mut asked = self.asked.lock();
        let Some(asked) = asked.get_mut(&(from, ty)) else { return };
        if let Some(text) = asked.parts.take(part)
            && let Some(done) = asked.done.take()
        {
            // Who asked may have given up.
            let _ = done.send(text);
        }
    }
}

/// Looks after wishes until the process ends.
pub(super) async fn run(
    shared: Arc<Shared>,
    mut wishes: mpsc::Receiver<Wish>,
    stop: CancellationToken,
) {
    let wishes = stream::poll_fn(move |context| wishes.poll_recv(context));
    let all = wishes.for_each_concurrent(AT_ONCE, |wish| look_after(&shared, wish));
    tokio::select! {
        () = stop.cancelled() => {}
        () = all => {}
    }
}

async fn look_after(shared: &Arc<Shared>, wish: Wish) {
    let mut found = find(shared, &wish.ty).await;
    if found.is_none() && seek(&shared.types, &Around(shared), &wish).await.is_some() {
        found = find(shared, &wish.ty).await;
    }
    let Some(asker) = wish.asker else {
        let (types, ty) = (Arc::clone(&shared.types), wish.ty.clone());
        // It is ready when its first message comes.
        blocking(move || drop(types.get(Instant::now(), ty.borrowed()))).await;
        shared.types.sought(&wish.ty);
        return;
    };
    let text = found.map(|found| definition_text(&found.description));
    for part in parts_of(&wish.ty, text.as_deref()) {
        shared.send_types(&asker, Body::TypeDefinition(part));
    }
    shared.definitions.answering.lock().remove(&(asker, wish.ty));
}

/// What this flow has itself.
async fn find(shared: &Shared, ty: &MessageType) -> Option<Definition> {
    let (types, ty) = (Arc::clone(&shared.types), ty.clone());
    blocking(move || types.find(ty.borrowed())).await.flatten()
}

/// Runs what may read files.
async fn blocking<T: Send + 'static>(run: impl FnOnce() -> T + Send + 'static) -> Option<T> {
    tokio::task::spawn_blocking(run).await.ok()
}

/// A definition, wherever it is. Takes some seconds where others are asked who do not answer.
pub(super) async fn wait_for(types: &Arc<Types>, ty: MessageType) -> Option<Definition> {
    let find = || {
        let (types, ty) = (Arc::clone(types), ty.clone());
        blocking(move || types.find(ty.borrowed()))
    };
    if let Some(found) = find().await.flatten() {
        return Some(found);
    }
    let mut searches = types.searches();
    types.prepare(Instant::now(), ty.borrowed());
    let search = async { while types.is_sought(&ty) && searches.changed().await.is_ok() {} };
    // It goes on for others; here it counts as not found.
    let _ = timeout(SEARCH, search).await;
    find().await.flatten()
}

impl Shared {
    fn send_types(&self, to: &FlowId, body: Body) {
        self.control.lock().send_types(Instant::now(), to, body);
        self.plane.nudge();
    }
}

/// Nodes and flows around this one.
struct Around<'a>(&'a Shared);

impl Others for Around<'_> {
    async fn nodes(&self, ty: &MessageType) -> Vec<(String, MessageType)> {
        match &self.0.ros2 {
            Some(ros2) => node::nodes_with(ros2, ty).await,
            None => Vec::new(),
        }
    }

    /// Those that own publishers of the type on a ROS 2 network first. On behalf of another layer
    /// the flows of the own one are asked, which a gateway speaks for; on behalf of a flow of the
    /// own layer nobody is.
    fn flows(&self, Wish { ty, asker }: &Wish) -> Vec<FlowId> {
        let me = &self.0.me;
        let control = self.0.control.lock();
        let may_ask = |flow: &FlowId| match asker {
            None => flow != me,
            Some(asker) => asker.layer != me.layer && flow.layer == me.layer && flow != me,
        };
        let others = control.world().flows.iter();
        let others = others.filter(|(flow, view)| may_ask(flow) && view.reach == Reach::Up);
        let publishes = |entry: &TopicEntry| {
            let scopes = entry.scopes().into_iter();
            let of_type = scopes.filter(|(_, scope)| {
                let offer = scope.advertise.as_ref();
                offer.is_some_and(|it| it.type_name == ty.name && agree(&it.type_hash, &ty.hash))
            });
            of_type.map(|(scope, _)| scope != Scope::Ros2).min()
        };
        let ranked = others.filter_map(|(flow, view)| {
            Some((view.topics.values().filter_map(publishes).min()?, flow.clone()))
        });
        let mut flows: Vec<(bool, FlowId)> = ranked.collect();
        flows.sort();
        flows.into_iter().map(|(_, flow)| flow).collect()
    }

    async fn ask_node(&self, node: &str, ty: &MessageType) -> Option<TypeDescription> {
        node::ask(self.0, node, ty).await
    }

    async fn ask_flow(&self, flow: &FlowId, ty: &MessageType) -> Option<TypeDescription> {
        let mut came = self.0.definitions.ask(flow, ty);
        let text = loop {
            let request = TypeRequest { r#type: ty.name.clone(), hash: ty.hash.clone() };
            self.0.send_types(flow, Body::TypeRequest(request));
            if let Ok(answer) = timeout(ANSWER, &mut came).await {
                break answer.ok().filter(|text| !text.is_empty())?;
            }
        };
        match parse_joined(&ty.name, &text, None) {
            Ok(description) => Some(description),
            Err(error) => {
                tracing::warn!(%flow, r#type = ty.name, %error, "what came is no definition");
                None
            }
        }
    }
}

/// Whether two hashes may be of one type: one that is not known fits any.
fn agree(one: &str, other: &str) -> bool {
    one.is_empty() || other.is_empty() || one == other
}

#[cfg(test)]
mod tests {
    use super::*;

    const TYPE: &str = "a/msg/B";

    fn request(name: &str) -> Body {
        Body::TypeRequest(TypeRequest { r#type: name.to_owned(), hash: String::new() })
    }

    fn flow(number: usize) -> FlowId {
        format!("edge/f{number}").parse().unwrap()
    }

    #[test]
    fn what_a_flow_asks_for_waits_once_and_within_bounds() {
        let (definitions, mut wishes) = Definitions::new();
        definitions.take(flow(0), request(TYPE));
        definitions.take(flow(0), request(TYPE));
        definitions.take(flow(0), request(&"x".repeat(MAX_NAME + 1)));
        let wish = wishes.try_recv().unwrap();
        assert_eq!((wish.ty.name.as_str(), wish.asker), (TYPE, Some(flow(0))));
        assert!(wishes.try_recv().is_err(), "it is asked for already");
        for number in 1..=2 * MAX_WISHES {
            definitions.take(flow(number), request(TYPE));
        }
        assert_eq!(definitions.answering.lock().len(), 1 + MAX_WISHES);
    }

    #[test]
    fn only_parts_that_were_asked_for_are_taken() {
        let (definitions, _wishes) = Definitions::new();
        let ty = MessageType { name: TYPE.to_owned(), hash: String::new() };
        let mut came = definitions.ask(&flow(1), &ty);
        let other = MessageType { name: "a/msg/C".to_owned(), ..ty.clone() };
        for (from, of) in [(2, &ty), (1, &other)] {
            for part in parts_of(of, Some("int8 lie\n")) {
                definitions.take(flow(from), Body::TypeDefinition(part));
            }
        }
        assert!(came.try_recv().is_err());
        let text = "int8 x\n".repeat(500);
        for part in parts_of(&ty, Some(&text)).into_iter().rev() {
            definitions.take(flow(1), Body::TypeDefinition(part.clone()));
            definitions.take(flow(1), Body::TypeDefinition(part));
        }
        assert_eq!(came.try_recv().unwrap(), text);
        let _came = definitions.ask(&flow(2), &ty);
        assert_eq!(definitions.asked.lock().len(), 1, "what was answered is forgotten");
    }
}
