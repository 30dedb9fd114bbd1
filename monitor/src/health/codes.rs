//! All codes of problems that this node finds: one table, from which pages and alerts are
//! generated.

use std::time::Duration;

use serde::Serialize;

use super::State;
use super::limits::{BRIDGE_STARTING_AFTER, LIMIT_AFTER, STALE_AFTER, STARTING_AFTER, WORSE_AFTER};

/// What a problem is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Scope {
    /// The node, or a program or device of it.
    Node,
    /// A service.
    Service,
    /// A link to another flow.
    Link,
    /// A topic.
    Topic,
}

impl Scope {
    /// The word in answers and labels.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Node => "node",
            Self::Service => "service",
            Self::Link => "link",
            Self::Topic => "topic",
        }
    }
}

/// One kind of problem.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Code {
    /// The word; with `scope` the key of the table.
    pub code: &'static str,
    /// What it is about.
    pub scope: Scope,
    /// State of its subject while it lasts.
    pub state: State,
    /// How long the condition lasts before it is a problem.
    pub after: Duration,
    /// What it means, in one sentence.
    pub meaning: &'static str,
    /// What to do; `{name}` stands for the name of the subject.
    pub remedy: &'static str,
}

/// The row of a code.
#[must_use]
pub fn find(scope: Scope, code: &str) -> Option<&'static Code> {
    CODES.iter().find(|row| row.scope == scope && row.code == code)
}

const fn row(
    scope: Scope,
    code: &'static str,
    state: State,
    meaning: &'static str,
    remedy: &'static str,
) -> Code {
    Code { code, scope, state, after: WORSE_AFTER, meaning, remedy }
}

const fn late(after: Duration, code: Code) -> Code {
    Code { after, ..code }
}

use Scope::{Link, Node, Service, Topic};
use State::{Degraded, Down};

/// The table. Codes of topics are those of `why`, besides two of its own.
pub static CODES: &[Code] = &[
    row(
        Node,
        "flow_not_ready",
        Down,
        "BlazeFlow of this node does not answer, or is not ready: no messages pass.",
        "Start it (`blaze-flow --config FILE`) or repair the broker that the detail names; \
         `/readyz` on its admin port (`admin.flow`) shows all checks.",
    ),
    row(
        Node,
        "worker_not_ready",
        Degraded,
        "The worker of this node does not answer, or is not ready: services get no new \
         configuration.",
        "Start it (`blaze-worker --config FILE`) or repair what the detail names; \
         `/readyz` on its admin port (`admin.worker`) shows all checks.",
    ),
    row(
        Node,
        "disk_full",
        Degraded,
        "A file system has less free space than `monitor.thresholds.disk_free_ratio`.",
        "Find what fills it (`du -xh {name} | sort -h | tail`) and remove it, or lower the \
         threshold.",
    ),
    row(
        Node,
        "memory_low",
        Degraded,
        "Less memory is available than `monitor.thresholds.memory_free_ratio`.",
        "Find what uses it (`ps aux --sort=-rss | head`) and restart or limit it.",
    ),
    row(
        Node,
        "hot",
        Degraded,
        "A sensor is above `monitor.thresholds.celsius`: the processor will slow down.",
        "Check fan and air flow, or lower the load (`top`); on Jetson a lower power mode \
         (`nvpmodel -m 1`).",
    ),
    row(
        Node,
        "clock_skew",
        Degraded,
        "The clock of this node may be wrong by more than `monitor.thresholds.clock_error_ms`.",
        "Synchronise it: `timedatectl set-ntp true`, or chrony with the same servers on all nodes; \
         `timedatectl timesync-status` or `chronyc tracking` shows the result.",
    ),
    row(
        Node,
        "udp_drops",
        Degraded,
        "The kernel drops datagrams because socket buffers are full: DDS loses messages.",
        "Enlarge the buffers: `sysctl -w net.core.rmem_max=8388608 \
         net.core.rmem_default=8388608`, then restart the programs that use DDS.",
    ),
    row(
        Node,
        "cpu_throttled",
        Degraded,
        "The control group is throttled for more than a tenth of the time: latencies grow.",
        "Raise its CPU limit (`docker update --cpus N CONTAINER`; in Kubernetes \
         `resources.limits.cpu`), or lower the load.",
    ),
    row(
        Node,
        "more_problems",
        Degraded,
        "There are more problems, services or topics than are listed or watched.",
        "Mend the problems that are listed: many have one cause.",
    ),
    row(
        Service,
        "service_gone",
        Down,
        "The service renewed no sign of life, and did not end cleanly.",
        "Restart it and read the end of its log: it crashed, hangs or lost its broker.",
    ),
    row(
        Service,
        "service_unhealthy",
        Degraded,
        "The service itself reports that it does not work well.",
        "Read its log; `blaze get svc SERVICE` shows its configuration.",
    ),
    late(
        STARTING_AFTER,
        row(
            Service,
            "service_starting",
            Degraded,
            "The service has been starting for more than 30 s.",
            "Read its log: it may wait for another service (`wait_for`) or for its configuration.",
        ),
    ),
    row(
        Service,
        "config_rejected",
        Degraded,
        "The service, or BlazeFlow itself, does not take its newest configuration and goes on \
         with the one before.",
        "Correct the value that the detail names (`blaze edit svc SERVICE`), or undo the change \
         (`blaze rollback svc SERVICE --to REVISION`).",
    ),
    late(
        STALE_AFTER,
        row(
            Service,
            "config_stale",
            Degraded,
            "The service still runs with an older configuration 30 s after a newer one was \
             delivered.",
            "Let the service request its configuration every 60 s, as the SDK does, or restart it.",
        ),
    ),
    row(
        Link,
        "peer_down",
        Down,
        "The other flow has been silent for longer than a link may be: nothing crosses the link.",
        "Check that the other flow runs, and the network between the two: `blaze ping`, \
         `blaze doctor`.",
    ),
    row(
        Link,
        "peer_suspect",
        Degraded,
        "The other flow does not acknowledge now: the link is full or broken.",
        "Check loss and round trip (`blaze peers`); lower `flow.bandwidth.limit_mbps` if the link \
         is slower than that.",
    ),
    row(
        Link,
        "link_lossy",
        Degraded,
        "More than 2 % of the datagrams of the link are lost: repairs delay messages.",
        "Check the radio (`iw dev wlan0 link`) or the cable and the MTU (`blaze doctor`); lower \
         `flow.bandwidth.limit_mbps` if the link is full.",
    ),
    late(
        LIMIT_AFTER,
        row(
            Link,
            "limit_reached",
            Degraded,
            "The link has used 95 % of its limit for a minute: bulk topics are thinned.",
            "Raise `flow.bandwidth.limit_mbps`, or request less (`max_rate_hz`, compression); \
             `blaze top` shows the topics.",
        ),
    ),
    row(
        Link,
        "budget_infeasible",
        Degraded,
        "The limits are too low for the standard topics, or for the minimum rates of large ones.",
        "Raise `flow.bandwidth.limit_mbps`, or publish less; `/v1/allocation` shows which link.",
    ),
    row(
        Topic,
        "topic_silent",
        Degraded,
        "The topic has a publisher and a requester, and no message came for three periods of its \
         advertised rate.",
        "Check that the publisher works (its log, its sensor), or let it advertise its true rate.",
    ),
    row(
        Topic,
        "priority_drops",
        Degraded,
        "Messages of a topic of class `control` or `state` were dropped.",
        "Find the bridge and the reason with `blaze bridges` and `blaze why {name}`.",
    ),
    row(
        Topic,
        "peer_down",
        Down,
        "No flow that works carries the topic to its requester.",
        "Check the flow that `blaze why {name}` names, and the network to it.",
    ),
    row(
        Topic,
        "peer_suspect",
        Degraded,
        "The flow on the way to the requester does not answer now.",
        "Check loss and round trip of its link with `blaze peers`.",
    ),
    row(
        Topic,
        "broker_down",
        Down,
        "A broker on the way does not answer.",
        "Start the broker, or correct its address in the node file; `blaze why {name}` names it.",
    ),
    late(
        BRIDGE_STARTING_AFTER,
        row(
            Topic,
            "bridge_starting",
            Degraded,
            "The bridge of the topic has been starting for more than 15 s.",
            "Read the log of the flow that `blaze why {name}` names.",
        ),
    ),
    row(
        Topic,
        "bridge_failed",
        Down,
        "The broker refuses what the bridge of the topic needs.",
        "Read the detail and correct the broker; the bridge is tried again every 5 s.",
    ),
    row(
        Topic,
        "type_mismatch",
        Down,
        "Publisher and requester name different types, or definitions of the type.",
        "Build both with the same message definition, or leave out `type` and `type_hash`; \
         `blaze why {name}` names both types.",
    ),
    row(
        Topic,
        "type_unknown",
        Down,
        "No flow has the definition of the type: messages cannot be converted.",
        "Give the flow the folder of the definition (`interfaces` of its ROS 2 plugin), or request \
         the topic as CDR.",
    ),
    row(
        Topic,
        "convert_error",
        Degraded,
        "Messages do not fit their type and cannot be converted.",
        "Correct the value of the message that the detail names, or the advertised `encoding`.",
    ),
    row(
        Topic,
        "qos_mismatch",
        Degraded,
        "The request asks for more reliability or durability than is offered; it flows as offered.",
        "Let the publisher offer `reliable` or `transient_local`, or request less.",
    ),
    row(
        Topic,
        "name_not_expressible",
        Down,
        "A broker on the way cannot express the name of the topic.",
        "Rename the topic, or shorten the `prefix` of the broker.",
    ),
    row(
        Topic,
        "name_collision",
        Down,
        "Two topics have one name on a broker.",
        "Rename one of the two; `blaze why {name}` names the other.",
    ),
    row(
        Topic,
        "access_denied",
        Down,
        "The rules `flow.access` of a node on the way do not allow it.",
        "Let the operator of the flow that `blaze why {name}` names allow it in `flow.access`, or \
         withdraw the request.",
    ),
    row(
        Topic,
        "source_mismatch",
        Down,
        "Messages name another layer or node than the one that they come from.",
        "Leave `layer` and `node` out of the messages, or send them to the broker of that node.",
    ),
    row(
        Topic,
        "too_many_leases",
        Down,
        "The flow holds 10,000 leases and takes no more.",
        "Find the service that makes up names with `blaze topics`, and withdraw them.",
    ),
    row(
        Topic,
        "budget_starved",
        Down,
        "The bandwidth limit leaves the topic no rate.",
        "Raise `flow.bandwidth.limit_mbps`, or lower the rate or size of the topics that \
         `blaze top` shows.",
    ),
    row(
        Topic,
        "rate_limited",
        Degraded,
        "A topic of class `control` or `state` gets less than its rate.",
        "Raise `flow.bandwidth.limit_mbps`, or advertise the rate that is really published.",
    ),
    row(
        Topic,
        "too_large",
        Degraded,
        "Messages are larger than a broker on the way carries.",
        "Make them smaller, or raise the limit of the broker (Kafka: `max.message.bytes` of the \
         topic).",
    ),
    row(
        Topic,
        "lifespan",
        Degraded,
        "Messages are too old when they arrive, and are dropped.",
        "Raise `lifespan_ms`, or find where they wait: `queued` in `blaze bridges`.",
    ),
    row(
        Topic,
        "scope_in_use",
        Down,
        "Another flow uses the broker of this scope.",
        "Give each node and each layer a broker or a `prefix` of its own.",
    ),
    row(
        Topic,
        "name_in_use",
        Down,
        "Several programs run under the name of one flow.",
        "Stop one of them, or give it a `node.name` of its own; `blaze why {name}` names their \
         addresses.",
    ),
    row(
        Topic,
        "unreachable",
        Down,
        "A ROS 2 node on the way uses no UDP: no flow reaches it.",
        "Let the ROS 2 node use UDP beside shared memory.",
    ),
];
