//! Where a connection comes from, as far as that is known before its first call.

use crate::gate::Identity;
use std::fmt;
use std::net::IpAddr;

/// What is known of the other end of a connection when it is accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Peer {
    pub(super) origin: Origin,
    /// Over a Unix socket the kernel says who it is; otherwise the first call does.
    pub(super) is_operator: bool,
}

/// Where a connection comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Origin {
    /// A user of this machine.
    User(u32),
    /// A host, by its address; of IPv6 the network, for a host has all of its addresses.
    Host(IpAddr),
    /// Nothing is known.
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
    /// At a Unix socket.
    pub(crate) fn of_user(identity: &Identity, is_operator: bool) -> Peer {
        let origin = match identity {
            Identity::User { uid, .. } => Origin::User(*uid),
            Identity::Certificate { .. } | Identity::Anonymous => Origin::Unknown,
        };
        Peer { origin, is_operator }
    }

    /// At a TCP port; nothing where the connection has ended already.
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
