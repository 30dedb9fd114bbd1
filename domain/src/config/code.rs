//! The error codes of the configuration's interfaces: one table for REST, gRPC and the pages of the
//! documentation.

use std::fmt;
use std::str::FromStr;

use serde::{Serialize, Serializer};

macro_rules! codes {
    ($($(#[$doc:meta])* $variant:ident = $text:literal, $http:literal, $grpc:literal,
        $title:literal;)+) => {
        /// What went wrong, as a closed set.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
        pub enum Code {
            $(
                #[doc = $title]
                $(#[$doc])*
                $variant,
            )+
        }

        impl Code {
            /// All codes.
            pub const ALL: &'static [Self] = &[$(Self::$variant),+];

            /// The code as it is written.
            #[must_use]
            pub fn as_str(self) -> &'static str {
                match self { $(Self::$variant => $text),+ }
            }

            /// Status of HTTP; `None` for what is told within a stream alone.
            #[must_use]
            pub fn http_status(self) -> Option<u16> {
                let status: u16 = match self { $(Self::$variant => $http),+ };
                (status > 0).then_some(status)
            }

            /// Number of the status of gRPC (0 to 16). A code that REST alone has gets the one
            /// nearest in meaning.
            #[must_use]
            pub fn grpc_status(self) -> i32 {
                match self { $(Self::$variant => $grpc),+ }
            }

            /// A short sentence that is the same for every occurrence.
            #[must_use]
            pub fn title(self) -> &'static str {
                match self { $(Self::$variant => $title),+ }
            }
        }
    };
}

codes! {
    InvalidRequest = "invalid_request", 400, 3, "The request cannot be read.";
    InvalidHeader = "invalid_header", 400, 3, "A header has a bad value.";
    UnknownParameter = "unknown_parameter", 400, 3, "A query parameter is unknown or repeated.";
    InvalidPageToken = "invalid_page_token", 400, 3, "The page token is not one of this query.";
    InvalidLabelSelector = "invalid_label_selector", 400, 3, "The label selector cannot be read.";
    Unauthenticated = "unauthenticated", 401, 16, "A valid token is needed.";
    PermissionDenied = "permission_denied", 403, 7, "The token does not allow this.";
    NotFound = "not_found", 404, 5, "There is no such thing.";
    MethodNotAllowed = "method_not_allowed", 405, 12, "The path does not take this method.";
    NotAcceptable = "not_acceptable", 406, 3, "No type that the client accepts is offered.";
    AlreadyExists = "already_exists", 409, 6, "A document of that name exists.";
    InUse = "in_use", 409, 9, "Other documents refer to it.";
    RevisionConflict = "revision_conflict", 409, 10, "It was changed in between.";
    RolloutActive = "rollout_active", 409, 9, "The target has a roll-out already.";
    RolloutState = "rollout_state", 409, 9, "The roll-out is not in a phase that allows this.";
    IdempotencyInProgress = "idempotency_in_progress", 409, 10, "The first request with this key \
        is still running.";
    SigningDisabled = "signing_disabled", 409, 9, "The service has no key to sign tokens with.";
    LimitExceeded = "limit_exceeded", 409, 8, "A limit of the system is reached.";
    RevisionTrimmed = "revision_trimmed", 410, 11, "The history does not reach back that far.";
    RevisionUnknown = "revision_unknown", 410, 11, "The store has not reached that revision.";
    PreconditionFailed = "precondition_failed", 412, 10, "The document has another revision.";
    PayloadTooLarge = "payload_too_large", 413, 8, "The body is too large.";
    UriTooLong = "uri_too_long", 414, 3, "The path and query are too long.";
    UnsupportedMediaType = "unsupported_media_type", 415, 3, "The body's type is not one that is \
        taken here.";
    ValidationFailed = "validation_failed", 422, 3, "The document breaks a rule.";
    SchemaMismatch = "schema_mismatch", 422, 3, "An effective configuration would not match its \
        service's schema.";
    ReferenceNotFound = "reference_not_found", 422, 3, "A document that is referred to does not \
        exist.";
    SecretUnknown = "secret_unknown", 422, 3, "There is no stored secret to keep.";
    IdempotencyKeyReused = "idempotency_key_reused", 422, 3, "The key was used for another \
        request.";
    PreconditionRequired = "precondition_required", 428, 9, "The change must say which revision it \
        is of.";
    RateLimited = "rate_limited", 429, 8, "Too many requests.";
    HeadersTooLarge = "headers_too_large", 431, 8, "The headers are too large.";
    WatchTooSlow = "watch_too_slow", 0, 10, "The watcher fell too far behind.";
    Internal = "internal", 500, 13, "The service failed.";
    StoreUnavailable = "store_unavailable", 503, 14, "The store cannot be reached.";
    OutcomeUnknown = "outcome_unknown", 503, 2, "Whether the change took effect is not known.";
    Overloaded = "overloaded", 503, 14, "The service has too much to do.";
    NodeUnreachable = "node_unreachable", 503, 14, "The monitor of a node does not answer.";
    ShuttingDown = "shutting_down", 503, 14, "The service is ending.";
    DeadlineExceeded = "deadline_exceeded", 504, 4, "It took too long.";
}

impl Serialize for Code {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.as_str())
    }
}

impl fmt::Display for Code {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl FromStr for Code {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let found = Self::ALL.iter().copied().find(|code| code.as_str() == text);
        found.ok_or_else(|| format!("{text:?} is no error code"))
    }
}
