//! The words that services and workers exchange.

use crate::qos::word_enum;

word_enum!(
    /// How a service gets on with its configuration.
    AckStatus {
        /// It runs with it.
        Applied = "applied",
        /// It does not take it, and goes on with the one before.
        Rejected = "rejected",
        /// It runs with it, and not well.
        Unhealthy = "unhealthy",
        /// It runs well again.
        Healthy = "healthy",
    }
);

word_enum!(
    /// Where a worker has what it serves from, the weakest first.
    ConfigSource {
        /// The file that was mounted for the worker.
        File = "file",
        /// A copy in its database or last-known-good file; also what the main service told before
        /// it was lost.
        Copy = "copy",
        /// The main service: the worker is connected and in sync.
        Main = "main",
    }
);

word_enum!(
    /// Which kind of document a change came from, in the order in which notices name them.
    ConfigScope {
        /// The layer's.
        Layer = "layer",
        /// The node's.
        Node = "node",
        /// The service's.
        Service = "service",
        /// The one of this instance of the service.
        Instance = "instance",
    }
);

word_enum!(
    /// How a service is.
    ServiceState {
        /// It begins.
        Starting = "starting",
        /// It works.
        Ready = "ready",
        /// It runs, and not well.
        Unhealthy = "unhealthy",
        /// It ends.
        Stopping = "stopping",
    }
);
