//! The worker as services and operators have it: real `blaze-config`, `blaze-worker` and Redis,
//! killed and started again.
//!
//! Needs `cargo build --workspace` and `scripts/services install`.
//!
//! ```text
//! stage      a main service, a broker and workers of one layer
//! kit        robots that each have a Redis of their own, and service processes
//! serving    what services are told, and whether only those it concerns; the mounted file
//! flow       BlazeFlow's own settings: what counts, what is refused, who else hears, also while messages flow
//! layer      one worker for a whole layer, on Kafka and on DDS
//! kafka      what is special to Kafka
//! leases     the suite of leases on real servers
//! several    two workers of one layer, of which one is killed, stopped, or ended
//! killed     worker, broker and database killed behind a cut link
//! rollouts   roll-outs that services judge
//! secrets    what services are not told is nowhere
//! wire       both ends of `Sync` across versions
//! tls        TLS on both sides and a token: the worker as `blaze node join` sets it up
//! raw        `Sync` as bytes
//! recorded   recordings of it
//! partition  the link to the main service loses everything while very much is changed (needs root: a network namespace)
//! ```

mod flow;
mod kafka;
mod killed;
mod kit;
mod layer;
mod leases;
mod partition;
mod raw;
mod recorded;
mod rollouts;
mod secrets;
mod serving;
mod several;
mod stage;
mod tls;
mod wire;
