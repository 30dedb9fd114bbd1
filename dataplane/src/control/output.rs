//! What a control core is told at its start, and what it wants done.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use blaze_domain::names::ChannelName;
use blaze_domain::node_file::{AccessRules, AutoBool};
use blaze_domain::{FlowId, LayerKind, Scope, TopicName, WriterId};
use blaze_proto::Frame;
use blaze_proto::link::link_control::{Body, LayerScope};
use bytes::Bytes;

#[cfg(doc)]
use super::ControlCore;
use super::Duty;
use crate::lane::path::TopicInfo;
use crate::plan::network::Shown;
use crate::plan::{PlanRules, TopicPlan};
use crate::registry::{LayerNames, UnsavedLease};
use crate::world::{FlowState, LayerScopeId, OriginFilter, Ros2Network};

/// What the control core wants done.
#[derive(Debug)]
pub enum Output {
    /// Put JSON on a reserved channel of a scope.
    Publish {
        /// Node or layer.
        scope: Scope,
        /// The channel.
        channel: ChannelName,
        /// The JSON.
        body: Bytes,
    },
    /// Another flow sent a TypeRequest or a TypeDefinition.
    Types {
        /// The flow.
        from: FlowId,
        /// The message.
        body: Box<Body>,
    },
    /// Send a registry message, or one about a definition, to a flow.
    Link {
        /// The flow.
        to: FlowId,
        /// The message.
        body: Box<Body>,
    },
    /// Send a request of this flow to a service, and give its reply to [`ControlCore::call_reply`].
    Call {
        /// The request.
        request: Frame,
    },
    /// Make the bridges of a topic equal to this plan.
    Plan {
        /// The topic.
        topic: TopicName,
        /// Its bridges.
        plan: TopicPlan,
        /// What local advertisements say.
        info: Box<TopicInfo>,
        /// What changes of who carries it out of the layer. After [`Duty::GivesUp`] call
        /// [`ControlCore::given_up`] at once, and then look at [`ControlCore::emptying`].
        duty: Duty,
    },
    /// Put a message on the channel that flows share on the layer broker.
    Replicas {
        /// The message.
        body: Bytes,
        /// It is of no use later.
        deadline: Option<Instant>,
    },
    /// Say this version and digest in Hello.
    Announce {
        /// Version of the registry.
        version: u64,
        /// Its digest.
        digest: u64,
    },
    /// Say this state in Hello on the inter scope.
    State(FlowState),
    /// Join the inter scope, and call [`ControlCore::joined`], or leave it, once what is on its way
    /// has left, and call [`ControlCore::left`].
    Inter {
        /// Join it.
        join: bool,
    },
    /// Say in Hello that the layer broker is there for this flow, or is not.
    LayerScope {
        /// It is.
        shared: bool,
    },
    /// Say in Hello that the layer broker has not answered for some seconds, or that it does again.
    LayerAway(bool),
    /// Say in Hello on which ROS 2 network this flow is.
    Ros2(Option<Ros2Network>),
    /// Read the writers of the ROS 2 network that are this flow's, and not those of others.
    Owned(BTreeMap<WriterId, bool>),
    /// Let what other flows offer of a topic show on the ROS 2 network, or no longer.
    Show {
        /// The topic.
        topic: TopicName,
        /// What is offered.
        shown: Option<Shown>,
    },
    /// Let the broker of a scope keep or forget a lease.
    SaveLease(UnsavedLease),
    /// Forget what is kept of writers for late joiners: their service no longer advertises the
    /// topic.
    ForgetWriters {
        /// The topic.
        topic: TopicName,
        /// Whose.
        of: OriginFilter,
        /// Who advertises it still.
        but: BTreeSet<OriginFilter>,
    },
    /// Let the broker of a scope make a channel.
    Prepare {
        /// Node or layer.
        scope: Scope,
        /// The channel.
        channel: ChannelName,
        /// Samples that it keeps per writer for late joiners; 0 = none.
        depth: u32,
    },
    /// Tell the broker of a scope that nobody uses a channel any more.
    Release {
        /// Node or layer.
        scope: Scope,
        /// The channel.
        channel: ChannelName,
    },
}

/// What a control core is told at its start.
#[derive(Debug, Clone)]
pub struct ControlConfig {
    /// The flow.
    pub me: FlowId,
    /// Kind of its layer.
    pub kind: LayerKind,
    /// Its epoch.
    pub epoch: u64,
    /// Whether it has a node scope.
    pub node_scope: bool,
    /// Its layer broker.
    pub layer_scope: Option<LayerScopeId>,
    /// Flows that share the layer broker have a channel of their own there, on a broker of this
    /// kind.
    pub replicas: Option<LayerScope>,
    /// What the node file says of this flow as a gateway.
    pub gateway: AutoBool,
    /// Whether it has an inter scope, so that it must listen for peers before it is ready.
    pub inter_scope: bool,
    /// Answers on the layer scope share one channel (Kafka, DDS).
    pub layer_answers_need_id: bool,
    /// What the layer broker makes of topic names.
    pub layer_names: LayerNames,
    /// Scopes whose broker keeps leases; the flow is not ready before they were read.
    pub lease_stores: BTreeSet<Scope>,
    /// Rules of the node file.
    pub rules: PlanRules,
    /// Who may advertise and request what.
    pub access: AccessRules,
}
