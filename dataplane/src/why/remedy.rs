//! What to do about each cause.

use blaze_domain::WhyCode;

/// Where messages are skipped though there is room for them.
pub(super) const OF_AN_EXCESS: &str = "Let the publisher advertise the rate that it publishes at: \
    more than it says is skipped, whatever the limit is.";

/// One sentence for people.
pub(super) fn remedy(code: WhyCode) -> &'static str {
    match code {
        WhyCode::Ok => "Nothing to do: messages flow.",
        WhyCode::NoAdvertise => {
            "Start the publisher, or let it advertise the topic to its flow; check the topic's \
             name on both sides."
        }
        WhyCode::NoRequest => {
            "Start the subscriber, or let it request the topic from its flow; check the topic's \
             name on both sides."
        }
        WhyCode::NoMatchingOrigin => {
            "Change `from` of the request: no publisher has that layer, node and service."
        }
        WhyCode::LeaseExpired => {
            "The service stopped renewing its lease: restart it, or let it renew at a third of \
             `ttl_s` (0 never lapses)."
        }
        WhyCode::SourceMismatch => {
            "Correct `layer` and `node` of the control message or of the messages: they name \
             another place than the broker's."
        }
        WhyCode::PeerDown => {
            "Check that the other flow runs, that it is ready, and the network between the two."
        }
        WhyCode::PeerSuspect => {
            "Wait a moment: the other flow has just stopped answering; if it stays, check the \
             network."
        }
        WhyCode::NotOwner => {
            "Ask the flow that carries this topic for its layer; it is named in the step."
        }
        WhyCode::BridgeStarting => {
            "Wait a moment: the bridge, or its flow, is starting; if it stays, read the flow's log."
        }
        WhyCode::BridgeFailed => {
            "Read the step's detail: the broker refused what the bridge needs; it is tried again \
             every 5 s."
        }
        WhyCode::TypeMismatch => {
            "Let publisher and requester give the same `type` and `type_hash`, or leave them out."
        }
        WhyCode::TypeUnknown => {
            "Give the flow a folder with the definition of the type (`interfaces` of its ROS 2 \
             plugin), or ask for the topic as CDR."
        }
        WhyCode::ConvertError => {
            "Correct the message, or its type: the step names the place in it that does not fit."
        }
        WhyCode::QosMismatch => {
            "It flows as offered: let the publisher advertise the reliability and durability that \
             is asked for."
        }
        WhyCode::NameNotExpressible => {
            "Rename the topic, or shorten the broker's `prefix`: this broker cannot express its \
             name."
        }
        WhyCode::NameCollision => {
            "Rename one of the two topics, which the step names: the broker has one name for both."
        }
        WhyCode::AccessDenied => {
            "Let the operator of the flow that the step names allow it in `flow.access`; a service \
             that was refused must then ask again, as the SDK does by itself."
        }
        WhyCode::TooManyLeases => {
            "Find the service that makes up names (`blaze topics`) and let it withdraw them; then \
             this one is taken when it asks again."
        }
        WhyCode::BudgetStarved => {
            "Raise `flow.bandwidth.limit_mbps`, or lower the rate or size of the topics that use \
             it up (`/v1/allocation`)."
        }
        WhyCode::RateLimited => {
            "It flows slower than published: raise `flow.bandwidth.limit_mbps` or ask for less \
             (`/v1/allocation`); at `deliver` the broker is the slow one."
        }
        WhyCode::TooLarge => {
            "Make the messages smaller, or raise the broker's limit (Kafka: `max.message.bytes` of \
             the topic): they are larger than it carries."
        }
        WhyCode::Lifespan => {
            "Messages are too old when it is their turn: raise `lifespan_ms`, or find where they \
             wait (`queued` of `/v1/bridges`)."
        }
        WhyCode::BrokerDown => {
            "Start the broker of this scope, or correct its address in the node file; `/readyz` \
             says since when it is away."
        }
        WhyCode::ScopeInUse => {
            "Give each node and each layer a broker or a `prefix` of its own: another flow uses \
             this one."
        }
        WhyCode::NameInUse => {
            "Stop one of the programs that the step names, or give it a `node.name` of its own."
        }
        WhyCode::Unreachable => {
            "Let the ROS 2 node use UDP: over TCP or shared memory alone no flow reaches it."
        }
        WhyCode::NativePath => {
            "Nothing to do: publisher and requester reach each other without a bridge."
        }
    }
}
