//! Closed sets of the control protocol.

use crate::qos::word_enum;

word_enum!(
    /// What a lease says: its holder publishes the topic, or wants it.
    LeaseKind {
        /// It publishes.
        Advertise = "advertise",
        /// It wants.
        Request = "request",
    }
);

word_enum!(
    /// Why a control message is refused.
    ErrorCode {
        /// Not JSON.
        InvalidJson = "invalid_json",
        /// `op` is missing or not known.
        UnknownOp = "unknown_op",
        /// Not a topic name.
        InvalidTopic = "invalid_topic",
        /// The topic belongs to BlazeAIoT itself.
        ReservedTopic = "reserved_topic",
        /// A field has the wrong type, is out of range or is missing.
        InvalidValue = "invalid_value",
        /// It names another layer or node than the one where it is received.
        SourceMismatch = "source_mismatch",
        /// A newer life of the same service holds the lease.
        StaleEpoch = "stale_epoch",
        /// The flow holds as many leases as it may.
        TooManyLeases = "too_many_leases",
        /// A broker cannot express the topic's name.
        NameNotExpressible = "name_not_expressible",
        /// Two topics have one name on a broker.
        NameCollision = "name_collision",
        /// Not allowed.
        AccessDenied = "access_denied",
        /// No server of the called service is known.
        NoServer = "no_server",
        /// The server did not reply in time.
        Timeout = "timeout",
        /// Nobody has the definition of the type.
        TypeUnknown = "type_unknown",
        /// The JSON does not fit the type.
        ConvertError = "convert_error",
        /// The flow waits for as many replies as it may.
        TooManyCalls = "too_many_calls",
        /// Larger than a call may be.
        TooLarge = "too_large",
    }
);

word_enum!(
    /// What happened.
    EventKind {
        /// A flow is there: services send their leases again.
        FlowStarted = "flow_started",
        /// A control message was refused.
        LeaseRefused = "lease_refused",
        /// A lease was not renewed in time.
        LeaseExpired = "lease_expired",
        /// A topic has a route.
        RouteUp = "route_up",
        /// A topic has lost a route.
        RouteDown = "route_down",
        /// A message could not be converted.
        ConvertFailed = "convert_failed",
    }
);
