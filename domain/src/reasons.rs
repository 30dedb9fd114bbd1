//! Why a message was dropped, and why a topic does or does not arrive. Both sets are part of the
//! contract.

use crate::qos::word_enum;

word_enum!(
    /// Why a message was dropped; the label `reason` of `blaze_flow_dropped_total`.
    DropReason {
        /// The lane's token bucket was empty.
        RateLimit = "rate_limit",
        /// Above the rate that the requesters asked for.
        MaxRate = "max_rate",
        /// The oldest gave way in a full queue.
        QueueFull = "queue_full",
        /// Older than its lifespan.
        Lifespan = "lifespan",
        /// The destination went down or came back with a new epoch.
        LinkDown = "link_down",
        /// Larger than a broker or the system carries.
        TooLarge = "too_large",
        /// Same writer and sequence as before, or older than one already delivered.
        Duplicate = "duplicate",
        /// What the flow wrote itself came back to it.
        Echo = "echo",
        /// Born in another layer or node than the scope that it was read from.
        ForeignOrigin = "foreign_origin",
        /// Not a frame, though it claims to be one.
        DecodeError = "decode_error",
        /// The compressed payload did not decompress.
        DecompressError = "decompress_error",
        /// Publisher and requester disagree about the type.
        TypeMismatch = "type_mismatch",
        /// It could not be converted to the encoding that was asked for.
        ConvertError = "convert_error",
        /// Parts of it never came.
        ReassemblyTimeout = "reassembly_timeout",
        /// The broker refused it or was away.
        BrokerError = "broker_error",
        /// Nobody here asks for it any more.
        NoDestination = "no_destination",
        /// The flow was stopping.
        Shutdown = "shutdown",
    }
);

word_enum!(
    /// Verdict codes of `/v1/why`.
    WhyCode {
        /// Nothing in the way.
        Ok = "ok",
        /// Nobody advertises the topic.
        NoAdvertise = "no_advertise",
        /// Nobody requests the topic.
        NoRequest = "no_request",
        /// The request asks for an origin that does not publish it.
        NoMatchingOrigin = "no_matching_origin",
        /// The lease ran out.
        LeaseExpired = "lease_expired",
        /// The control message named another layer or node.
        SourceMismatch = "source_mismatch",
        /// The other flow is away.
        PeerDown = "peer_down",
        /// The other flow has not answered for a moment.
        PeerSuspect = "peer_suspect",
        /// Another flow of the layer carries this topic.
        NotOwner = "not_owner",
        /// The bridge is being made.
        BridgeStarting = "bridge_starting",
        /// The bridge could not be made.
        BridgeFailed = "bridge_failed",
        /// Publisher and requester disagree about the type.
        TypeMismatch = "type_mismatch",
        /// Nobody has the definition of its type: it cannot be converted.
        TypeUnknown = "type_unknown",
        /// A message could not be converted.
        ConvertError = "convert_error",
        /// More is asked than offered; it flows as offered.
        QosMismatch = "qos_mismatch",
        /// The broker cannot express the topic's name.
        NameNotExpressible = "name_not_expressible",
        /// Two topics have one name on the broker.
        NameCollision = "name_collision",
        /// Not allowed to advertise or request it.
        AccessDenied = "access_denied",
        /// The flow holds as many leases as it can.
        TooManyLeases = "too_many_leases",
        /// The budget leaves it no rate.
        BudgetStarved = "budget_starved",
        /// The budget leaves it less than its rate.
        RateLimited = "rate_limited",
        /// Larger than a broker or the system carries.
        TooLarge = "too_large",
        /// Older than its lifespan on arrival.
        Lifespan = "lifespan",
        /// The broker does not answer.
        BrokerDown = "broker_down",
        /// A ROS 2 endpoint that has no UDP address.
        Unreachable = "unreachable",
        /// Another flow owns the scope.
        ScopeInUse = "scope_in_use",
        /// Several programs run under the name of one flow.
        NameInUse = "name_in_use",
        /// It flows natively, without a bridge.
        NativePath = "native_path",
    }
);
