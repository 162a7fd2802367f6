//! Which connections are accepted, which give way, and which calls are refused for them.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use super::*;
use crate::access::Role;
use crate::gate::Identity;
use std::time::Duration;
use tokio::io::{AsyncReadExt, DuplexStream, duplex};

fn limits() -> ConnectionLimits {
    ConnectionLimits { connections: 3, of_one_caller: 2, for_operators: 0, ..ConnectionLimits::default() }
}

fn link(connection: &Connection<DuplexStream>) -> Link {
    connection.registered.0.clone()
}

fn user(uid: u32, role: Role) -> Caller {
    Caller { name: format!("uid {uid}").into(), roles: [role].as_slice().into() }
}

fn host(number: u8) -> Peer {
    Peer::of_host(Some([10, 0, 0, number].into()))
}

/// An open connection with its other end.
fn accept(connections: &Connections, peer: Peer) -> Option<(Connection<DuplexStream>, DuplexStream)> {
    let (near, far) = duplex(1);
    connections.accept(near, peer).ok().map(|near| (near, far))
}

async fn is_closed((connection, _far): &mut (Connection<DuplexStream>, DuplexStream)) -> bool {
    let mut byte = [0];
    let read = tokio::time::timeout(Duration::from_millis(1), connection.read(&mut byte)).await;
    read.is_ok_and(|read| read.is_err())
}

#[tokio::test]
async fn who_says_nothing_gives_way_the_longest_first_and_who_has_a_call_stays() {
    let connections = Connections::new(limits());
    let mut open: Vec<_> = (0..3).map(|_| accept(&connections, host(1)).unwrap()).collect();
    let users = [1, 2, 3].map(|uid| user(uid, Role::Viewer));
    let call = link(&open[0].0).begin(&users[0]).unwrap();
    assert!(!is_closed(&mut open[1]).await, "as many as may be");
    open.push(accept(&connections, host(1)).unwrap());
    assert!(is_closed(&mut open[1]).await && !is_closed(&mut open[0]).await && !is_closed(&mut open[2]).await);
    let others = [link(&open[2].0).begin(&users[1]).unwrap(), link(&open[3].0).begin(&users[2]).unwrap()];
    drop(open.remove(1));
    assert!(accept(&connections, host(1)).is_none(), "all have something to do");
    drop((call, others));
    assert!(accept(&connections, host(1)).is_some());
}

#[tokio::test]
async fn one_caller_has_its_share_of_connections_and_the_refusal_says_whose() {
    let connections = Connections::new(limits());
    let (caller, other) = (user(7, Role::Task), user(8, Role::Task));
    let open: Vec<_> = (0..3).map(|_| accept(&connections, host(1)).unwrap()).collect();
    let first = link(&open[0].0).begin(&caller).unwrap();
    let again = link(&open[0].0).begin(&caller).unwrap();
    let _second = link(&open[1].0).begin(&caller).unwrap();
    let refused = link(&open[2].0).begin(&caller).unwrap_err();
    assert!(refused.to_string().contains("connections of uid 7: the quota of 2"), "{refused}");
    assert!(link(&open[2].0).begin(&other).is_ok());
    drop(first);
    assert!(link(&open[2].0).begin(&caller).is_err(), "one call is left on the first");
    drop(again);
    assert!(link(&open[2].0).begin(&caller).is_ok());
}

#[tokio::test]
async fn callers_that_are_no_operators_leave_the_operators_share() {
    let limits = ConnectionLimits { connections: 8, of_one_caller: 3, for_operators: 4, ..limits() };
    let connections = Connections::new(limits);
    let mut calls = Vec::new();
    let mut open = Vec::new();
    for uid in [1, 1, 1, 2] {
        open.push(accept(&connections, host(1)).unwrap());
        calls.push(link(&open[open.len() - 1].0).begin(&user(uid, Role::Task)).unwrap());
    }
    open.push(accept(&connections, host(1)).unwrap());
    let refused = link(&open[4].0).begin(&user(2, Role::Task)).unwrap_err();
    assert!(refused.to_string().contains("all who are no operators: the quota of 4"), "{refused}");
    assert!(link(&open[4].0).begin(&user(0, Role::Operator)).is_ok());
    // Even if many more connect.
    for _ in 0..50 {
        open.push(accept(&connections, host(1)).unwrap());
    }
    open.push(accept(&connections, host(2)).unwrap());
    open.push(accept(&connections, host(1)).unwrap());
    let operators = open.len() - 2;
    assert!(!is_closed(&mut open[operators]).await, "the host with most connections gives way");
    assert!(link(&open[operators].0).begin(&user(0, Role::Operator)).is_ok());
    calls.pop();
    let last = open.len() - 1;
    assert!(link(&open[last].0).begin(&user(2, Role::Task)).is_ok());
}

#[tokio::test]
async fn idle_connections_leave_a_share_to_those_that_have_not_spoken_yet() {
    let connections = Connections::new(ConnectionLimits { connections: 4, for_operators: 2, ..limits() });
    let mut open: Vec<_> = (0..4).map(|_| accept(&connections, host(1)).unwrap()).collect();
    for (connection, _) in &open {
        drop(link(connection).begin(&user(1, Role::Task)).unwrap());
    }
    open.extend((0..2).map(|_| accept(&connections, host(2)).unwrap()));
    assert!(is_closed(&mut open[0]).await && is_closed(&mut open[1]).await && !is_closed(&mut open[4]).await);
    open.push(accept(&connections, host(2)).unwrap());
    assert!(is_closed(&mut open[4]).await && !is_closed(&mut open[2]).await, "the share is used up");
}

#[tokio::test]
async fn a_connection_that_the_kernel_names_as_an_operators_gives_way_last() {
    let connections = Connections::new(limits());
    let peer = |uid, is_operator| Peer::of_user(&Identity::User { uid, pid: None }, is_operator);
    let mut operators = accept(&connections, peer(0, true)).unwrap();
    let mut others = Vec::new();
    for _ in 0..20 {
        others.push(accept(&connections, peer(7, false)).unwrap());
    }
    assert!(!is_closed(&mut operators).await);
    assert!(is_closed(&mut others[0]).await);
}

#[test]
fn a_host_is_known_by_its_address_and_of_ipv6_by_its_network() {
    let peer = |text: &str| Peer::of_host(Some(text.parse().unwrap()));
    assert_eq!(peer("fd00:1:2:3::1"), peer("fd00:1:2:3:ffff::9"));
    assert_ne!(peer("fd00:1:2:3::1"), peer("fd00:1:2:4::1"));
    assert_eq!(peer("::ffff:10.0.0.1"), peer("10.0.0.1"));
    assert_ne!(peer("10.0.0.2"), peer("10.0.0.1"));
}

#[tokio::test]
async fn a_connection_without_a_call_is_closed_at_its_deadline() {
    let connections =
        Connections::new(ConnectionLimits { first_call: Duration::ZERO, idle: Duration::from_secs(3_600), ..limits() });
    let mut open: Vec<_> = (0..3).map(|_| accept(&connections, host(1)).unwrap()).collect();
    drop(link(&open[1].0).begin(&user(1, Role::Viewer)).unwrap());
    link(&open[2].0).touch();
    let _ = tokio::time::timeout(SWEEP_INTERVAL, connections.sweep()).await;
    assert!(is_closed(&mut open[0]).await);
    assert!(!is_closed(&mut open[1]).await && !is_closed(&mut open[2]).await, "they have longer");
}

#[tokio::test]
async fn a_connection_whose_client_takes_nothing_of_its_answers_is_closed_and_so_is_one_that_hangs_in_a_write() {
    let far_away = Duration::from_secs(3_600);
    let unread =
        |unread| Connections::new(ConnectionLimits { unread, first_call: far_away, idle: far_away, ..limits() });
    for (patience, is_late) in [(Duration::ZERO, true), (far_away, false)] {
        let connections = unread(patience);
        let mut open: Vec<_> = (0..3).map(|_| accept(&connections, host(1)).unwrap()).collect();
        let (first, second) = (link(&open[0].0), link(&open[1].0));
        let (_waits, taken) = ((first.waits(), first.waits()), second.waits());
        drop(taken);
        // The buffer of the third one has room for one byte.
        let (mut third, _far) = open.pop().unwrap();
        let _in_a_write = link(&third).waits();
        let mut writing = Box::pin(tokio::io::AsyncWriteExt::write_all(&mut third, &[0; 8]));
        let hangs = tokio::time::timeout(Duration::from_millis(1), &mut writing).await;
        assert!(hangs.is_err());
        let _ = tokio::time::timeout(SWEEP_INTERVAL / 2, connections.sweep()).await;
        let written = tokio::time::timeout(Duration::from_millis(100), writing).await;
        assert_eq!(written.is_ok_and(|written| written.is_err()), is_late);
        assert_eq!(is_closed(&mut open[0]).await, is_late);
        assert!(!is_closed(&mut open[1]).await, "it has taken all");
    }
}

#[tokio::test]
async fn who_takes_a_part_of_its_answers_has_as_long_again_for_the_rest() {
    let connections = Connections::new(limits());
    let (connection, _far) = accept(&connections, host(1)).unwrap();
    let link = link(&connection);
    let since = || connections.state().open[&link.id].unread_since;
    let (first, _second) = (link.waits(), link.waits());
    let before = since();
    tokio::time::sleep(Duration::from_millis(1)).await;
    let _third = link.waits();
    assert_eq!(since(), before, "more waits");
    drop(first);
    assert!(since() > before);
}
