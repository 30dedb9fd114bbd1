//! Programs that tests start as processes of their own, as subcommands of one.

pub(crate) mod dds_peer;
pub(crate) mod link_peer;
pub(crate) mod probe;
pub(crate) mod service;
pub(crate) mod wan;
