//! Asks a ROS 2 node for a definition: the flow is a client of its `get_type_description`.

use std::sync::Arc;
use std::time::{Duration, Instant};

use blaze_brokers::ros2::names::{Carries, RosName};
use blaze_brokers::ros2::{Network, RosEndpoint};
use blaze_brokers::{Broker as _, Content, PublisherOptions, Received, SubscribeOptions};
use blaze_convert::{DescriptionError, TypeDescription};
use blaze_domain::media::cdr_of;
use blaze_domain::names::ChannelName;
use blaze_domain::{Origin, WriterId};
use blaze_proto::{Frame, Header};
use tokio::time::{timeout, timeout_at};

use super::super::Shared;
use super::super::plane::wall_ns;
use super::super::ros2::Ros2Scope;
use super::{ANSWER, agree};
use crate::types::MessageType;

const SERVICE: &str = "get_type_description";
const REQUEST: &str = "type_description_interfaces/srv/GetTypeDescription_Request";
/// How long an endpoint's node and service may take to be known.
const MEET: Duration = Duration::from_secs(5);
/// Replies that wait: to this client and others.
const MAX_REPLIES: usize = 64;

/// Nodes with endpoints of a type that have the service. An endpoint may be known before its node
/// and the service are.
pub(super) async fn nodes_with(ros2: &Ros2Scope, ty: &MessageType) -> Vec<(String, MessageType)> {
    let (mut network, mut nodes) = (ros2.broker.network(), Vec::new());
    let known = network.wait_for(|network| look(network, ty).map(|it| nodes = it).is_some());
    let _ = timeout(MEET, known).await;
    nodes
}

/// The nodes of endpoints of a type that have the service, each with the hash that it announces:
/// one without (Humble) has no service. `None`: there are endpoints, and no such node yet.
fn look(network: &Network, ty: &MessageType) -> Option<Vec<(String, MessageType)>> {
    let (mut has_endpoint, mut nodes) = (false, Vec::new());
    for endpoint in &network.endpoints {
        let Some(hash) = &endpoint.type_hash else { continue };
        if endpoint.type_name.as_ref() != Some(&ty.name) || !agree(hash, &ty.hash) {
            continue;
        }
        has_endpoint = true;
        for node in servers(&network.endpoints, endpoint) {
            let of = (node, MessageType { name: ty.name.clone(), hash: hash.clone() });
            if !nodes.contains(&of) {
                nodes.push(of);
            }
        }
    }
    (!has_endpoint || !nodes.is_empty()).then_some(nodes)
}

/// The node of an endpoint, if it has the service. While the node is not told, all nodes of its
/// participant: that is mostly one.
fn servers(all: &[Arc<RosEndpoint>], endpoint: &RosEndpoint) -> impl Iterator<Item = String> {
    let of_participant = all.iter().filter(|other| {
        !other.is_writer
            && other.name.carries == Carries::Requests
            && other.id[..12] == endpoint.id[..12]
    });
    of_participant.filter_map(|server| {
        let node = format!("/{}", server.name.name.strip_suffix(SERVICE)?.strip_suffix('/')?);
        endpoint.node.as_ref().is_none_or(|own| *own == node).then_some(node)
    })
}

/// The requests of a node's service.
fn requests_of(node: &str) -> RosName {
    let name = format!("{}/{SERVICE}", node.trim_start_matches('/'));
    RosName { name, carries: Carries::Requests }
}

/// Asks a node until it answers; `None`: it does not know the type, or cannot be asked.
pub(super) async fn ask(shared: &Shared, node: &str, ty: &MessageType) -> Option<TypeDescription> {
    let ros2 = shared.ros2.as_ref()?;
    match call(shared, ros2, node, ty).await {
        Ok(description) => Some(description),
        Err(error) => {
            tracing::info!(node, r#type = ty.name, "{SERVICE}: {error:#}");
            None
        }
    }
}

async fn call(
    shared: &Shared,
    ros2: &Ros2Scope,
    node: &str,
    ty: &MessageType,
) -> anyhow::Result<TypeDescription> {
    let requests = requests_of(node);
    let replies = RosName { carries: Carries::Replies, ..requests.clone() };
    let [topic, replies] = [requests, replies].map(|name| name.to_topic(&ros2.namespace));
    let (topic, replies) = (topic?, replies?);
    let options = SubscribeOptions { max_messages: MAX_REPLIES, ..SubscribeOptions::default() };
    let mut replies = ros2.broker.subscribe(&ChannelName::from(&replies), options).await?;
    let reliable = PublisherOptions { reliable: true, ..PublisherOptions::default() };
    let requests = ros2.broker.publisher(&ChannelName::from(&topic), reliable)?;
    let payload = TypeDescription::request(&ty.name, &ty.hash)?;
    let origin = Origin {
        layer: shared.me.layer.to_string(),
        node: shared.me.node.to_string(),
        service: "blaze".to_owned(),
        instance: "0".to_owned(),
        epoch: 0,
    };
    let writer = WriterId(rand::random());
    let (mut batch, mut sequence) = (Vec::new(), 0);
    // The first request or reply may be lost, since client and server have to find each other.
    loop {
        sequence += 1;
        let header = Header {
            encoding: cdr_of(REQUEST),
            reliable: true,
            ..Header::new(topic.as_str(), origin.clone(), writer, sequence, wall_ns())
        };
        let frame = Frame::new(&header, payload.clone().into())?;
        let again = Instant::now() + ANSWER;
        requests.publish(&frame, Some(again));
        while let Ok(count) =
            timeout_at(again.into(), replies.receive(&mut batch, MAX_REPLIES)).await
        {
            anyhow::ensure!(count > 0, "the ROS 2 network has gone");
            if let Some(reply) = batch.drain(..).find_map(|reply| reply_to(writer, reply)) {
                return Ok(reply?);
            }
        }
    }
}

/// The reply to one of the own requests, whichever.
fn reply_to(
    writer: WriterId,
    Received { content, .. }: Received,
) -> Option<Result<TypeDescription, DescriptionError>> {
    let Content::Frame(frame) = content else { return None };
    let (to, _) = frame.related()?;
    (to == writer).then(|| TypeDescription::from_response(frame.payload()))
}
