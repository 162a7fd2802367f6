//! The origin of a connection, as far as it is known before the first call.

use crate::gate::Identity;
use std::fmt;
use std::net::IpAddr;

/// Facts about the other end of a connection when it is accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Peer {
    pub(super) origin: Origin,
    /// Over a Unix socket the kernel identifies the peer; otherwise this is known only with the first call.
    pub(super) is_operator: bool,
}

/// Where a connection comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Origin {
    /// A user of this machine.
    User(u32),
    /// A host, by its address; for IPv6 by its /64 network, because a host may use all addresses of it.
    Host(IpAddr),
    /// Unknown.
    Unknown,
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Origin::User(uid) => write!(f, "uid {uid}"),
            Origin::Host(address @ IpAddr::V4(_)) => write!(f, "{address}"),
            Origin::Host(network @ IpAddr::V6(_)) => write!(f, "{network}/64"),
            Origin::Unknown => f.write_str("hosts that are not known"),
        }
    }
}

impl Peer {
    /// The peer at a Unix socket.
    pub(crate) fn of_user(identity: &Identity, is_operator: bool) -> Peer {
        let origin = match identity {
            Identity::User { uid, .. } => Origin::User(*uid),
            Identity::Certificate { .. } | Identity::Anonymous => Origin::Unknown,
        };
        Peer { origin, is_operator }
    }

    /// The peer at a TCP port; the address is `None` if the connection has ended already.
    pub(crate) fn of_host(address: Option<IpAddr>) -> Peer {
        let origin = match address.map(|address| address.to_canonical()) {
            Some(IpAddr::V6(address)) => Origin::Host(IpAddr::V6((address.to_bits() & NETWORK_BITS).into())),
            Some(address) => Origin::Host(address),
            None => Origin::Unknown,
        };
        Peer { origin, is_operator: false }
    }
}

/// The part of an IPv6 address that names a network.
const NETWORK_BITS: u128 = !(u64::MAX as u128);
