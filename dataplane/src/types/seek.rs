//! Definitions that others have: the node of an endpoint, or the flow of a publisher.

use std::time::Duration;

use blaze_convert::{Source, TypeDescription, TypeHash};
use blaze_domain::FlowId;
use tokio::time::error::Elapsed;
use tokio::time::{Instant, timeout};

use super::{MessageType, Types};

/// Nodes that are asked for one definition, and flows, at most each.
const MAX_ASKED: usize = 4;
/// How long a definition is sought.
pub(crate) const SEARCH: Duration = Duration::from_secs(15);

/// A type whose definition is wanted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Wish {
    /// The type.
    pub ty: MessageType,
    /// The flow that asked for it, if it is not for this one.
    pub asker: Option<FlowId>,
}

/// Those who may have definitions.
pub(crate) trait Others {
    /// Nodes of the own ROS 2 network with endpoints of a type, and the hash of each: a node is
    /// asked for both. Waits a moment for nodes that are not known yet.
    async fn nodes(&self, ty: &MessageType) -> Vec<(String, MessageType)>;

    /// Flows that may have the definition.
    fn flows(&self, wish: &Wish) -> Vec<FlowId>;

    /// Asks a node, until it answers. `None`: it does not know the type.
    async fn ask_node(&self, node: &str, ty: &MessageType) -> Option<TypeDescription>;

    /// Asks a flow, until it answers. `None`: it does not know the type.
    async fn ask_flow(&self, flow: &FlowId, ty: &MessageType) -> Option<TypeDescription>;
}

/// Seeks a definition with others, and adds it to what this flow has. What is not of the name and
/// hash is passed over. Each that is asked has an equal share of the time that is left.
pub(crate) async fn seek(types: &Types, others: &impl Others, wish: &Wish) -> Option<Source> {
    let end = Instant::now() + SEARCH;
    let (mut nodes, mut flows) = (others.nodes(&wish.ty).await, others.flows(wish));
    nodes.truncate(MAX_ASKED);
    flows.truncate(MAX_ASKED);
    let mut left = nodes.len() + flows.len();
    let mut share = || {
        let share = (end - Instant::now()).div_f64(left as f64);
        left -= 1;
        share
    };
    for (node, ty) in nodes {
        let found = timeout(share(), others.ask_node(&node, &ty)).await;
        if add(types, Source::Node, &node, &ty, found) {
            return Some(Source::Node);
        }
    }
    for flow in flows {
        let found = timeout(share(), others.ask_flow(&flow, &wish.ty)).await;
        if add(types, Source::Flow, &flow.to_string(), &wish.ty, found) {
            return Some(Source::Flow);
        }
    }
    None
}

/// Whether the definition came, was what was asked for, and there was room for it.
fn add(
    types: &Types,
    source: Source,
    from: &str,
    ty: &MessageType,
    found: Result<Option<TypeDescription>, Elapsed>,
) -> bool {
    let found = match found {
        Ok(Some(found)) => found,
        Ok(None) => return false,
        Err(_) => {
            tracing::info!(from, r#type = ty.name, "asked for a definition, no answer");
            return false;
        }
    };
    let (name, hash) = (&found.type_description.type_name, found.hash());
    let is_it =
        *name == ty.name && (ty.hash.is_empty() || ty.hash.parse() == Ok::<TypeHash, _>(hash));
    if !is_it {
        tracing::warn!(
            from, r#type = ty.name, hash = ty.hash, found = name, %hash,
            "another definition came than was asked for",
        );
        return false;
    }
    match types.add(source, found) {
        Ok(()) => {
            tracing::info!(from, r#type = ty.name, %hash, "the definition of a type came");
            true
        }
        Err(error) => {
            tracing::warn!(from, r#type = ty.name, %error, "a definition is not kept");
            false
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::future;
    use std::time::Instant;

    use blaze_convert::{Distro, parse_joined};
    use parking_lot::Mutex;
    use tokio::sync::mpsc;

    use super::*;

    const TYPE: &str = "my_msgs/msg/Level";

    fn definition(name: &str, text: &str) -> TypeDescription {
        parse_joined(name, text, None).unwrap()
    }

    /// What nodes and flows answer, and who was asked. One with `silent` in its name does not.
    #[derive(Default)]
    struct Fakes {
        nodes: Vec<(&'static str, String)>,
        flows: Vec<&'static str>,
        answers: BTreeMap<&'static str, TypeDescription>,
        asked: Mutex<Vec<String>>,
    }

    impl Fakes {
        async fn answer(&self, who: &str) -> Option<TypeDescription> {
            self.asked.lock().push(who.to_owned());
            if who.contains("silent") {
                future::pending::<()>().await;
            }
            self.answers.get(who).cloned()
        }
    }

    impl Others for Fakes {
        async fn nodes(&self, ty: &MessageType) -> Vec<(String, MessageType)> {
            let of = |hash: &String| MessageType { name: ty.name.clone(), hash: hash.clone() };
            self.nodes.iter().map(|(node, hash)| ((*node).to_owned(), of(hash))).collect()
        }

        fn flows(&self, _: &Wish) -> Vec<FlowId> {
            self.flows.iter().map(|flow| flow.parse().unwrap()).collect()
        }

        async fn ask_node(&self, node: &str, _: &MessageType) -> Option<TypeDescription> {
            self.answer(node).await
        }

        async fn ask_flow(&self, flow: &FlowId, _: &MessageType) -> Option<TypeDescription> {
            self.answer(&flow.to_string()).await
        }
    }

    /// Who was asked, and where the definition came from.
    async fn sought(fakes: &Fakes, hash: &str) -> (Vec<String>, Option<Source>, Types) {
        let types = Types::new(Distro::Jazzy, Vec::new());
        let ty = MessageType { name: TYPE.to_owned(), hash: hash.to_owned() };
        let found = seek(&types, fakes, &Wish { ty: ty.clone(), asker: None }).await;
        assert_eq!(types.find(ty.borrowed()).map(|found| found.source), found);
        (std::mem::take(&mut *fakes.asked.lock()), found, types)
    }

    #[tokio::test(start_paused = true)]
    async fn nodes_are_asked_before_flows_until_one_has_it() {
        let wanted = definition(TYPE, "int32 level\n");
        let hash = wanted.hash().to_string();
        let mut fakes = Fakes {
            nodes: vec![("/silent", hash.clone()), ("/talker", hash.clone())],
            flows: vec!["edge/a", "edge/b"],
            answers: BTreeMap::from([("/talker", wanted.clone()), ("edge/b", wanted)]),
            ..Fakes::default()
        };
        let (asked, found, _) = sought(&fakes, &hash).await;
        assert_eq!((asked, found), (vec!["/silent".into(), "/talker".into()], Some(Source::Node)));
        let began = tokio::time::Instant::now();
        fakes.nodes = vec![("/silent", hash.clone())];
        let (asked, found, _) = sought(&fakes, &hash).await;
        assert_eq!((asked.len(), found), (3, Some(Source::Flow)));
        assert_eq!(began.elapsed(), SEARCH / 3, "its share of the time");
        fakes.flows = vec!["edge/silent", "edge/silent"];
        assert_eq!(sought(&fakes, &hash).await.1, None);
        assert_eq!(began.elapsed(), SEARCH / 3 + SEARCH);
    }

    #[tokio::test]
    async fn what_was_not_asked_for_is_passed_over() {
        let wanted = definition(TYPE, "int32 level\n");
        let other = definition(TYPE, "int32 level\nint32 more\n");
        let (hash, other_hash) = (wanted.hash().to_string(), other.hash().to_string());
        let named = definition("my_msgs/msg/Other", "int32 level\n");
        let fakes = Fakes {
            nodes: vec![("/old", hash.clone())],
            flows: vec!["edge/a", "edge/b", "edge/c"],
            answers: BTreeMap::from([
                ("/old", other.clone()),
                ("edge/a", other),
                ("edge/b", named),
                ("edge/c", wanted),
            ]),
            ..Fakes::default()
        };
        let (asked, found, types) = sought(&fakes, &hash).await;
        assert_eq!((asked.len(), found), (4, Some(Source::Flow)));
        let lie = MessageType { name: TYPE, hash: &*other_hash };
        assert!(types.find(lie).is_none(), "what is not asked for is not kept");
        // Without a hash the name counts, but a node is held to what its endpoint announces.
        let (asked, found, _) = sought(&fakes, "").await;
        assert_eq!((asked, found), (vec!["/old".into(), "edge/a".into()], Some(Source::Flow)));
    }

    #[tokio::test]
    async fn a_few_of_each_are_asked() {
        let fakes = Fakes {
            nodes: vec![("/a", String::new()); 100],
            flows: vec!["edge/a"; 100],
            ..Fakes::default()
        };
        assert_eq!(sought(&fakes, "").await.0.len(), 2 * MAX_ASKED);
    }

    #[test]
    fn a_type_is_wished_for_once_at_a_time() {
        let (wishes, mut queue) = mpsc::channel(2);
        let types = Types::new(Distro::Jazzy, Vec::new()).asking(wishes);
        let now = Instant::now();
        let wished = |name| MessageType { name, hash: "" };
        assert!(types.get(now, wished(TYPE)).is_err());
        types.prepare(now, wished(TYPE));
        types.prepare(now, wished("my_msgs/msg/Other"));
        types.prepare(now, wished("my_msgs/msg/TooMany"));
        assert!(types.is_sought(&wished(TYPE).owned()));
        assert!(!types.is_sought(&wished("my_msgs/msg/TooMany").owned()), "there is no room");
        assert!(types.get(now, wished("std_msgs/msg/Int32")).is_ok());
        let ended = types.searches();
        assert_eq!(queue.try_recv().unwrap().ty.name, TYPE);
        types.sought(&wished(TYPE).owned());
        assert!(ended.has_changed().unwrap() && !types.is_sought(&wished(TYPE).owned()));
        types.prepare(now, wished(TYPE));
        assert!(!types.is_sought(&wished(TYPE).owned()), "it was sought a moment ago");
        types.prepare(now + super::super::RETRY, wished(TYPE));
        assert!(types.is_sought(&wished(TYPE).owned()));
    }
}
