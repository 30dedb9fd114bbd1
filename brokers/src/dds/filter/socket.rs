//! Attaching the filter to the sockets that RustDDS keeps to itself.
//!
//! The kernel lists the UDP sockets of the network namespace with their ports and inodes, and the
//! files of this process with their inodes. A duplicate of such a file is the same socket, and so
//! is its filter.

use std::collections::{HashMap, HashSet};
use std::fs;
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::os::fd::{OwnedFd, RawFd};

use nix::libc;
use nix::sys::socket::setsockopt;
use nix::sys::socket::sockopt::AttachReusePortCbpf;
use rustix::io::Errno;
use rustix::process::{PidfdFlags, PidfdGetfdFlags, getpid, pidfd_getfd, pidfd_open};
use socket2::{Domain, SockFilter, Socket, Type};

use super::assembler::Instruction;
use super::program::{Samples, Shape, announcements, program, steering};
use super::{FilterError, system};

/// The UDP sockets of the calling thread's network namespace, IPv4.
const UDP_SOCKETS: &str = "/proc/thread-self/net/udp";
const OWN_FILES: &str = "/proc/self/fd";

/// Sockets that have the filter.
#[derive(Debug)]
pub(in super::super) struct Attached {
    inodes: HashSet<u64>,
    /// The large shape did not fit.
    pub(in super::super) is_small: bool,
}

impl Attached {
    /// Datagrams that the kernel dropped at these sockets until now, by the filter or because no
    /// room was left.
    pub(in super::super) fn dropped(&self) -> u64 {
        udp_sockets().map_or(0, |sockets| {
            let ours = sockets.iter().filter(|socket| self.inodes.contains(&socket.inode));
            ours.map(|socket| socket.dropped).sum()
        })
    }
}

/// One line of the kernel's list.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct UdpSocketLine {
    pub(super) address: Ipv4Addr,
    pub(super) port: u16,
    pub(super) inode: u64,
    pub(super) dropped: u64,
}

impl UdpSocketLine {
    /// `sl local_address rem_address st tx_queue:rx_queue tr:tm->when retrnsmt uid timeout inode
    /// ref pointer drops`
    pub(super) fn parse(line: &str) -> Option<Self> {
        let fields: Vec<&str> = line.split_ascii_whitespace().collect();
        let (address, port) = fields.get(1)?.rsplit_once(':')?;
        Some(Self {
            address: u32::from_str_radix(address, 16).ok()?.to_ne_bytes().into(),
            port: u16::from_str_radix(port, 16).ok()?,
            inode: fields.get(9)?.parse().ok()?,
            dropped: fields.get(12)?.parse().ok()?,
        })
    }
}

fn udp_sockets() -> std::io::Result<Vec<UdpSocketLine>> {
    let list = fs::read_to_string(UDP_SOCKETS)?;
    Ok(list.lines().filter_map(UdpSocketLine::parse).collect())
}

/// The sockets among the open files of this process: inode and descriptor.
fn own_sockets() -> std::io::Result<HashMap<u64, RawFd>> {
    let mut sockets = HashMap::new();
    for entry in fs::read_dir(OWN_FILES)?.flatten() {
        // Files may be closed meanwhile.
        let Ok(target) = fs::read_link(entry.path()) else {
            continue;
        };
        let inode = target.to_str().and_then(|name| {
            let inode = name.strip_prefix("socket:[")?.strip_suffix(']')?;
            inode.parse().ok()
        });
        let descriptor = entry.file_name().to_str().and_then(|name| name.parse().ok());
        if let (Some(inode), Some(descriptor)) = (inode, descriptor) {
            sockets.insert(inode, descriptor);
        }
    }
    Ok(sockets)
}

/// The UDP sockets of this process that are bound to one of the ports, with their inodes. RustDDS
/// binds none to a multicast group.
fn own_bound_to(ports: &[u16]) -> Result<Vec<(u64, Socket)>, FilterError> {
    let own = own_sockets().map_err(system("the own sockets are not known"))?;
    let all = udp_sockets().map_err(system("the UDP sockets are not known"))?;
    let this = pidfd_open(getpid(), PidfdFlags::empty()).map_err(errno("pidfd_open"))?;
    let mut bound = Vec::new();
    for found in all.iter().filter(|it| ports.contains(&it.port) && !it.address.is_multicast()) {
        let Some(descriptor) = own.get(&found.inode) else {
            continue;
        };
        let duplicate = pidfd_getfd(&this, *descriptor, PidfdGetfdFlags::empty())
            .map_err(errno("pidfd_getfd"))?;
        bound.extend(still_bound(duplicate, found.port).map(|socket| (found.inode, socket)));
    }
    if bound.is_empty() {
        return Err(FilterError::NoSocket(ports.to_vec()));
    }
    Ok(bound)
}

/// Attaches the filter to all UDP sockets of this process that are bound to one of the ports.
pub(in super::super) fn attach(ports: &[u16], samples: Samples) -> Result<Attached, FilterError> {
    let mut attached = Attached { inodes: HashSet::new(), is_small: false };
    for (inode, socket) in own_bound_to(ports)? {
        attach_one(&socket, samples, &mut attached.is_small)?;
        attached.inodes.insert(inode);
    }
    Ok(attached)
}

/// Lets a socket take announcements alone.
pub(in super::super) fn keep_announcements(socket: &Socket) -> Result<(), FilterError> {
    let program = announcements().ok_or(FilterError::Program)?;
    socket.attach_filter(&kernel(&program)).map_err(system("the filter was refused"))
}

/// Takes the announcements that come to a port of RustDDS: a socket of the same port, between which
/// and that of RustDDS the kernel chooses by what a datagram is.
pub(in super::super) fn steer(port: u16) -> Result<UdpSocket, FilterError> {
    let failed = "announcements are not steered";
    let bound = own_bound_to(&[port])?;
    let [(_, of_rustdds)] = &bound[..] else { return Err(FilterError::NoSocket(vec![port])) };
    // Both need it: the first socket of a port may get it when it is bound already.
    of_rustdds.set_reuse_port(true).map_err(system(failed))?;
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, None).map_err(system(failed))?;
    socket.set_reuse_port(true).map_err(system(failed))?;
    let address = SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, port);
    socket.bind(&address.into()).map_err(system(failed))?;
    let program = steering().ok_or(FilterError::Program)?;
    let mut instructions: Vec<libc::sock_filter> = program
        .iter()
        .map(|it| libc::sock_filter { code: it.code, jt: it.if_true, jf: it.if_false, k: it.k })
        .collect();
    let program = libc::sock_fprog {
        len: u16::try_from(instructions.len()).map_err(|_| FilterError::Program)?,
        filter: instructions.as_mut_ptr(),
    };
    setsockopt(&socket, AttachReusePortCbpf, &program)
        .map_err(|error| system(failed)(error.into()))?;
    Ok(socket.into())
}

/// The socket, unless the descriptor has been closed and used anew since it was listed.
fn still_bound(duplicate: OwnedFd, port: u16) -> Option<Socket> {
    let socket = Socket::from(duplicate);
    let address = socket.local_addr().ok()?.as_socket_ipv4()?;
    (address.port() == port && socket.r#type().ok()? == Type::DGRAM).then_some(socket)
}

/// Attaches the largest filter for which the system has room.
fn attach_one(socket: &Socket, samples: Samples, is_small: &mut bool) -> Result<(), FilterError> {
    let [large, small] = Shape::both(samples);
    if !*is_small {
        let large = filters(large, samples)?;
        let mut attached = socket.attach_filter(&large);
        if is_no_room(&attached) {
            // Another participant of this process and domain has the multicast sockets, too: their
            // filter counts beside the new one until it is gone. It has none for some microseconds.
            let _ = socket.detach_filter();
            attached = socket.attach_filter(&large);
        }
        if !is_no_room(&attached) {
            return attached.map_err(system("the filter was refused"));
        }
        *is_small = true;
    }
    socket.attach_filter(&filters(small, samples)?).map_err(system("the filter was refused"))
}

fn is_no_room(attached: &std::io::Result<()>) -> bool {
    attached.as_ref().is_err_and(|error| Errno::from_io_error(error) == Some(Errno::NOMEM))
}

fn filters(shape: Shape, samples: Samples) -> Result<Vec<SockFilter>, FilterError> {
    program(shape, samples).ok_or(FilterError::Program).map(|program| kernel(&program))
}

fn kernel(program: &[Instruction]) -> Vec<SockFilter> {
    let convert = |it: &Instruction| SockFilter::new(it.code, it.if_true, it.if_false, it.k);
    program.iter().map(convert).collect()
}

fn errno(what: &'static str) -> impl FnOnce(Errno) -> FilterError {
    move |error| system(what)(error.into())
}
