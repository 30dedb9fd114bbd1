//! Where a server listens, and how it is reached from this process.

use std::net::{Ipv4Addr, SocketAddr, TcpStream};
use std::process::Command;
use std::time::Duration;

use crate::network::{self, Host};

/// An address, on this machine or on a host of a network.
#[derive(Debug, Clone)]
pub(super) struct Endpoint {
    host: Option<Host>,
    pub(super) port: u16,
}

impl Endpoint {
    pub(super) fn new(host: Option<&Host>, port: u16) -> Self {
        Self { host: host.cloned(), port }
    }

    pub(super) fn loopback(port: u16) -> Self {
        Self::new(None, port)
    }

    pub(super) fn ip(&self) -> Ipv4Addr {
        self.host.as_ref().map_or(Ipv4Addr::LOCALHOST, |host| host.address)
    }

    pub(super) fn connect(&self, timeout: Duration) -> anyhow::Result<TcpStream> {
        network::connect(self.namespace(), SocketAddr::from((self.ip(), self.port)), timeout)
    }

    /// A program that runs where the server does.
    pub(super) fn program(&self, program: impl AsRef<std::ffi::OsStr>) -> Command {
        network::program(self.namespace(), program)
    }

    /// Does something where the server is.
    pub(super) fn inside<T: Send>(
        &self,
        act: impl FnOnce() -> anyhow::Result<T> + Send,
    ) -> anyhow::Result<T> {
        match self.namespace() {
            None => act(),
            Some(namespace) => network::inside(namespace, act),
        }
    }

    fn namespace(&self) -> Option<&str> {
        self.host.as_ref().map(|host| host.namespace.as_str())
    }
}
