//! A session's stream: many calls over one stream.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_model::id::LeaseId;
use ratn_model::resource::ResourceClass;
use ratn_proto::types::Resource;
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use ratn_proto::v1::session_request::Kind as Asked;
use ratn_proto::v1::session_response::Kind;
use ratn_proto::v1::{self, SessionRequest};
use ratn_worker::client::{AcquireOptions, Channels, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::tls::ClientTls;
use std::collections::BTreeMap;
use support::{TestSystem, block, in_time};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Streaming};

/// The client's end.
struct Line {
    questions: mpsc::Sender<SessionRequest>,
    answers: Streaming<v1::SessionResponse>,
}

impl Line {
    async fn open(system: &TestSystem, manager: &support::Daemon, session: &str) -> Line {
        let channel = system.channels.get(&manager.endpoint).unwrap();
        let (questions, outgoing) = mpsc::channel(64);
        let ping = v1::KeepAliveRequest {
            session_id: session.to_owned(),
            ttl_ms: 60_000,
            client: session.to_owned(),
            ..Default::default()
        };
        questions
            .send(SessionRequest { id: 1, kind: Some(Asked::KeepAlive(ping)), ..Default::default() })
            .await
            .unwrap();
        let call = ResourceServiceClient::new(channel).session(ReceiverStream::new(outgoing)).await;
        let mut line = Line { questions, answers: call.unwrap().into_inner() };
        let (id, Kind::KeepAlive(kept)) = line.hear().await else { panic!("it is kept alive") };
        assert!(id == 1 && kept.created);
        line
    }

    async fn ask(&self, id: u64, kind: Option<Asked>) {
        self.questions.send(SessionRequest { id, kind, ..Default::default() }).await.unwrap();
    }

    async fn hear(&mut self) -> (u64, Kind) {
        let answer = in_time(self.answers.message()).await.unwrap().unwrap();
        (answer.id, answer.kind.unwrap())
    }

    async fn failure(&mut self) -> (u64, Code) {
        match self.hear().await {
            (id, Kind::Failure(failure)) => (id, Code::from(failure.code)),
            (_, other) => panic!("no failure but {other:?}"),
        }
    }
}

fn acquire(session: &str, request: &str) -> Option<Asked> {
    Some(Asked::Acquire(v1::AcquireRequest {
        request_id: request.to_owned(),
        session_id: session.to_owned(),
        requirements: vec![block("Arm").into()],
        deadline_ms: 60_000,
        ..Default::default()
    }))
}

#[tokio::test]
async fn answers_come_as_they_are_there_and_not_in_the_order_of_questions() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    a.resources.create(Resource::new("arm", ResourceClass::Module, "Arm")).await.unwrap();
    let mut line = Line::open(&system, &manager, "b").await;
    line.ask(2, acquire("b", "first")).await;
    let (2, Kind::Acquire(first)) = line.hear().await else { panic!("the arm is free") };
    // It waits, while what comes after it is answered.
    line.ask(3, acquire("b", "second")).await;
    let lease_id = first.lease.unwrap().id;
    let give_back = v1::ResourceServiceReleaseRequest {
        request_id: "give back".to_owned(),
        session_id: "b".to_owned(),
        lease_id,
        note: String::new(),
        at_rest: true,
    };
    line.ask(4, Some(Asked::Release(give_back))).await;
    let mut answers = BTreeMap::new();
    for _ in 0..2 {
        let (id, kind) = line.hear().await;
        answers.insert(id, kind);
    }
    assert!(matches!(&answers[&4], Kind::Release(ended) if ended.released));
    let Kind::Acquire(second) = &answers[&3] else { panic!("granted after the release") };
    assert!(second.lease.as_ref().unwrap().token > lease_id);
    manager.end().await;
}

#[tokio::test]
async fn a_call_that_fails_leaves_the_stream_as_it_is() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let mut line = Line::open(&system, &manager, "a").await;
    line.ask(2, None).await;
    assert_eq!(line.failure().await, (2, Code::InvalidArgument));
    line.ask(3, acquire("nobody", "x")).await;
    assert_eq!(line.failure().await, (3, Code::FailedPrecondition));
    let undo =
        v1::WithdrawRequest { request_id: "never asked".to_owned(), session_id: "a".to_owned(), ..Default::default() };
    line.ask(4, Some(Asked::Withdraw(undo))).await;
    assert!(matches!(line.hear().await, (4, Kind::Withdraw(undone)) if !undone.withdrawn));
    manager.end().await;
}

#[tokio::test]
async fn what_waits_on_a_stream_that_breaks_leaves_the_queue() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    a.resources.create(Resource::new("arm", ResourceClass::Module, "Arm")).await.unwrap();
    let held = a.resources.acquire(vec![block("Arm")], Default::default()).await.unwrap();
    let mut line = Line::open(&system, &manager, "b").await;
    line.ask(2, acquire("b", "waits")).await;
    // It has arrived when a later question is answered.
    line.ask(3, None).await;
    assert_eq!(line.failure().await, (3, Code::InvalidArgument));
    drop(line);
    a.resources.release(held.id).await.unwrap();
    let again = in_time(a.resources.acquire(vec![block("Arm")], Default::default())).await;
    again.unwrap();
    manager.end().await;
}

#[tokio::test]
async fn the_last_call_that_a_stream_may_have_waits_and_one_more_is_refused_until_another_has_ended() {
    const CALLS: u64 = 4_096;
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let mut line = Line::open(&system, &manager, "a").await;
    for id in 10..10 + CALLS {
        line.ask(id, acquire("a", &format!("waits {id}"))).await;
    }
    let undo =
        v1::WithdrawRequest { request_id: "waits 10".to_owned(), session_id: "a".to_owned(), ..Default::default() };
    line.ask(5_000, Some(Asked::Withdraw(undo.clone()))).await;
    assert_eq!(line.failure().await, (5_000, Code::ResourceExhausted));
    // Undone from elsewhere, the first one ends.
    let mut other = ResourceServiceClient::new(system.channels.get(&manager.endpoint).unwrap());
    assert!(other.withdraw(undo).await.unwrap().into_inner().withdrawn);
    assert_eq!(line.failure().await.0, 10);
    line.ask(5_001, acquire("a", "waits too")).await;
    line.ask(5_002, None).await;
    assert_eq!(line.failure().await, (5_002, Code::ResourceExhausted));
    manager.end().await;
}

#[tokio::test]
async fn the_id_of_a_call_under_way_is_refused_to_another_unless_it_is_0() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let mut line = Line::open(&system, &manager, "a").await;
    line.ask(2, acquire("a", "waits")).await;
    line.ask(2, acquire("a", "waits too")).await;
    assert_eq!(line.failure().await, (2, Code::InvalidArgument));
    line.ask(0, acquire("a", "waits as well")).await;
    line.ask(0, None).await;
    let (0, Kind::Failure(failure)) = line.hear().await else { panic!("it says nothing") };
    assert!(failure.message.contains("kind"), "{}", failure.message);
    manager.end().await;
}

#[tokio::test]
async fn a_dropped_call_leaves_the_queue_and_the_stream_goes_on() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let (a, b) = (system.client(&manager, "a").await, system.client(&manager, "b").await);
    a.resources.create(Resource::new("arm", ResourceClass::Module, "Arm")).await.unwrap();
    let held = a.resources.acquire(vec![block("Arm")], Default::default()).await.unwrap();
    let waits = b.resources.acquire(vec![block("Arm")], Default::default());
    assert!(tokio::time::timeout(std::time::Duration::from_millis(50), waits).await.is_err(), "it waits");
    // Asked after the dropped one on the same stream, and so answered after it left.
    assert!(!b.resources.release(held.id).await.unwrap_or(false), "it is another's");
    a.resources.release(held.id).await.unwrap();
    let next = in_time(a.resources.acquire(vec![block("Arm")], Default::default())).await.unwrap();
    assert!(next.token > held.token);
    manager.end().await;
}

#[tokio::test]
async fn a_stream_that_broke_fails_its_calls_and_the_next_call_opens_another() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    a.resources.create(Resource::new("arm", ResourceClass::Module, "Arm")).await.unwrap();
    let held = a.resources.acquire(vec![block("Arm")], Default::default()).await.unwrap();
    let waits = a.resources.acquire(vec![block("Arm")], Default::default());
    let (waited, ()) = tokio::join!(waits, async {
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        manager.end().await;
    });
    assert!(waited.unwrap_err().is_crash(), "nobody decided");
    let manager = system.resource_manager().await;
    // The session goes on or is made anew; either way the stream is there again.
    let asked = in_time(async {
        loop {
            match a.resources.release(held.id).await {
                Err(error) if error.is_crash() => tokio::time::sleep(std::time::Duration::from_millis(20)).await,
                answered => return answered,
            }
        }
    });
    assert!(asked.await.is_ok());
    manager.end().await;
}

/// The client does not wait for this call any more.
fn dropped(call: u64, request: &str) -> Option<Asked> {
    let (request_id, session_id) = (request.to_owned(), "b".to_owned());
    Some(Asked::Withdraw(v1::WithdrawRequest { request_id, session_id, call, unheard: false }))
}

impl Line {
    /// Drops a call; whether the server undoes it.
    async fn drop_call(&mut self, call: u64) -> bool {
        self.ask(1_000, dropped(call, "run/i1")).await;
        let (1_000, Kind::Withdraw(undone)) = self.hear().await else { panic!("it is answered") };
        undone.withdrawn
    }
}

#[tokio::test]
async fn a_lease_that_two_questions_were_answered_with_ends_when_both_are_dropped_and_is_acquired_anew_then() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    a.resources.create(Resource::new("arm", ResourceClass::Module, "Arm")).await.unwrap();
    let mut line = Line::open(&system, &manager, "b").await;
    let mut tokens = Vec::new();
    for id in [2, 3] {
        line.ask(id, acquire("b", "run/i1")).await;
        let (answered, Kind::Acquire(granted)) = line.hear().await else { panic!("the arm is free, or its own") };
        tokens.push((answered, granted.lease.unwrap().token));
    }
    assert_eq!(tokens, [(2, tokens[0].1), (3, tokens[0].1)]);
    assert!(line.drop_call(3).await);
    assert!(!line.drop_call(3).await, "it is not known any more");
    assert_eq!(a.resources.get("arm").await.unwrap().free.units(), 0, "the first question's");
    assert!(line.drop_call(2).await);
    assert_eq!(a.resources.get("arm").await.unwrap().free.units(), 1);
    // Dropped and asked again at once: in this order.
    line.ask(4, acquire("b", "run/i1")).await;
    line.ask(0, dropped(4, "run/i1")).await;
    line.ask(5, acquire("b", "run/i1")).await;
    let mut answers = Vec::new();
    while !matches!(answers.last(), Some((5, _))) {
        match line.hear().await {
            (0, Kind::Withdraw(undone)) => assert!(undone.withdrawn),
            (id, Kind::Acquire(granted)) => answers.push((id, granted.lease.unwrap().token)),
            (_, other) => panic!("{other:?}"),
        }
    }
    assert!(answers.iter().all(|(_, token)| *token > tokens[0].1), "{answers:?}");
    assert_eq!(a.resources.get("arm").await.unwrap().free.units(), 0);
    manager.end().await;
}

/// A relay of a Unix socket that can stop to pass on what the manager says, and cut its connections.
struct Relay {
    endpoint: Endpoint,
    deaf: watch::Sender<bool>,
    cut: watch::Sender<()>,
    _place: tempfile::TempDir,
}

impl Relay {
    fn to(manager: &support::Daemon) -> Relay {
        let Endpoint::Unix(to) = manager.endpoint.clone() else { panic!("it listens at a socket") };
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("relay.sock");
        let listener = UnixListener::bind(&path).unwrap();
        let (deaf, cut) = (watch::Sender::new(false), watch::Sender::new(()));
        let (hears, cuts) = (deaf.subscribe(), cut.subscribe());
        tokio::spawn(async move {
            while let Ok((client, _)) = listener.accept().await {
                let manager = UnixStream::connect(&to).await.unwrap();
                let (mut hears, mut cuts) = (hears.clone(), cuts.clone());
                cuts.mark_unchanged();
                tokio::spawn(async move {
                    let (mut from_client, mut to_client) = client.into_split();
                    let (mut from_manager, mut to_manager) = manager.into_split();
                    let back = async {
                        let mut bytes = [0; 4_096];
                        while let Ok(count @ 1..) = from_manager.read(&mut bytes).await {
                            if hears.wait_for(|deaf| !deaf).await.is_err()
                                || to_client.write_all(&bytes[..count]).await.is_err()
                            {
                                return;
                            }
                        }
                    };
                    tokio::select! {
                        _ = tokio::io::copy(&mut from_client, &mut to_manager) => {}
                        () = back => {}
                        _ = cuts.changed() => {}
                    }
                });
            }
        });
        Relay { endpoint: Endpoint::Unix(path), deaf, cut, _place: place }
    }
}

#[tokio::test]
async fn a_grant_whose_answer_was_lost_goes_back_when_it_is_asked_for_again_and_then_dropped() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let (a, b) = (system.client(&manager, "a").await, system.client(&manager, "b").await);
    a.resources.create(Resource::new("arm", ResourceClass::Module, "Arm")).await.unwrap();
    let free = async || a.resources.get("arm").await.unwrap().free.units();
    let relay = Relay::to(&manager);
    let client = ResourceClient::new(&Channels::new(&ClientTls::none()), &relay.endpoint, b.session.id()).unwrap();
    let options = || AcquireOptions { request: "run/i1".to_owned(), ..AcquireOptions::default() };
    let ask = || client.acquire(vec![block("Arm")], options());
    // The answer of the first question does not arrive.
    in_time(client.release(LeaseId(1))).await.unwrap();
    relay.deaf.send_replace(true);
    let mut first = Box::pin(ask());
    in_time(async {
        while free().await == 1 {
            assert!(futures::poll!(&mut first).is_pending());
        }
    })
    .await;
    relay.cut.send_replace(());
    assert!(in_time(first).await.unwrap_err().is_crash());
    relay.deaf.send_replace(false);
    // Neither does that of the second, which is dropped.
    in_time(async { while client.release(LeaseId(1)).await.is_err() {} }).await;
    relay.deaf.send_replace(true);
    let mut again = Box::pin(ask());
    assert!(futures::poll!(&mut again).is_pending());
    assert_eq!(free().await, 0);
    drop(again);
    in_time(async { while free().await == 0 {} }).await;
    // Asked once more it is acquired anew, and one that has heard its answer keeps the lease.
    relay.deaf.send_replace(false);
    let lease = in_time(ask()).await.unwrap();
    relay.deaf.send_replace(true);
    let mut beside = Box::pin(ask());
    assert!(futures::poll!(&mut beside).is_pending());
    drop(beside);
    relay.deaf.send_replace(false);
    assert!(in_time(client.release(lease.id)).await.unwrap(), "it was still held");
    manager.end().await;
}

#[tokio::test]
async fn a_grant_whose_answer_was_lost_goes_back_where_a_refusal_came_before_the_question_that_is_dropped() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let (a, b) = (system.client(&manager, "a").await, system.client(&manager, "b").await);
    a.resources.create(Resource::new("arm", ResourceClass::Module, "Arm")).await.unwrap();
    let free = async || a.resources.get("arm").await.unwrap().free.units();
    let relay = Relay::to(&manager);
    let client = ResourceClient::new(&Channels::new(&ClientTls::none()), &relay.endpoint, b.session.id()).unwrap();
    let options = || AcquireOptions { request: "run/i1".to_owned(), ..AcquireOptions::default() };
    let ask = || client.acquire(vec![block("Arm")], options());
    in_time(client.release(LeaseId(1))).await.unwrap();
    relay.deaf.send_replace(true);
    let mut first = Box::pin(ask());
    in_time(async {
        while free().await == 1 {
            assert!(futures::poll!(&mut first).is_pending());
        }
    })
    .await;
    relay.cut.send_replace(());
    assert!(in_time(first).await.unwrap_err().is_crash());
    relay.deaf.send_replace(false);
    in_time(async { while client.release(LeaseId(1)).await.is_err() {} }).await;
    // Refused, and the grant of the first question stays: of this request something else was asked before.
    let refused = in_time(client.acquire(vec![block("Gripper")], options())).await.unwrap_err();
    assert_eq!((refused.code(), free().await), (Some(Code::InvalidArgument), 0));
    relay.deaf.send_replace(true);
    let mut again = Box::pin(ask());
    assert!(futures::poll!(&mut again).is_pending());
    drop(again);
    in_time(async { while free().await == 0 {} }).await;
    manager.end().await;
}

#[tokio::test]
async fn of_two_questions_of_one_request_that_wait_the_dropped_one_takes_nothing_from_the_other() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    a.resources.create(Resource::new("arm", ResourceClass::Module, "Arm")).await.unwrap();
    let held = a.resources.acquire(vec![block("Arm")], Default::default()).await.unwrap();
    let mut line = Line::open(&system, &manager, "b").await;
    line.ask(2, acquire("b", "run/i1")).await;
    line.ask(3, acquire("b", "run/i1")).await;
    assert!(line.drop_call(2).await);
    assert!(a.resources.release(held.id).await.unwrap());
    let (3, Kind::Acquire(granted)) = line.hear().await else { panic!("the other question waits on") };
    assert!(!line.drop_call(2).await, "it has ended");
    assert!(granted.lease.is_some_and(|lease| lease.token > held.token.0));
    assert_eq!(a.resources.get("arm").await.unwrap().free.units(), 0);
    manager.end().await;
}

#[tokio::test]
async fn a_call_that_a_client_drops_leaves_another_one_of_its_request_as_it_is() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let (a, b) = (system.client(&manager, "a").await, system.client(&manager, "b").await);
    a.resources.create(Resource::new("arm", ResourceClass::Module, "Arm")).await.unwrap();
    let held = a.resources.acquire(vec![block("Arm")], Default::default()).await.unwrap();
    let options = || AcquireOptions { request: "run/i1".to_owned(), ..AcquireOptions::default() };
    let mut first = Box::pin(b.resources.acquire(vec![block("Arm")], options()));
    let mut second = Box::pin(b.resources.acquire(vec![block("Arm")], options()));
    // Both are on the stream, one behind the other, when a later question of it is answered.
    in_time(async {
        assert!(futures::poll!(&mut first).is_pending());
        while b.resources.explain("run/i1").await.is_err() {
            assert!(futures::poll!(&mut first).is_pending());
        }
        assert!(futures::poll!(&mut second).is_pending());
        drop(first);
        assert!(!b.resources.release(held.id).await.unwrap_or(false), "it is another's");
    })
    .await;
    assert!(a.resources.release(held.id).await.unwrap());
    let granted = in_time(second).await.unwrap();
    assert!(granted.token > held.token);
    assert!(b.resources.release(granted.id).await.unwrap(), "it still holds it");
    manager.end().await;
}

/// A frame of HTTP/2: its kind, flags and stream.
fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let length = u32::try_from(payload.len()).unwrap().to_be_bytes();
    [&length[1..], &[kind, flags], &stream.to_be_bytes(), payload].concat()
}

const DATA: u8 = 0;
const HEADERS: u8 = 1;
const SETTINGS: u8 = 4;
const PING: u8 = 6;
const GO_AWAY: u8 = 7;

/// The kind of the first frame that answers `requests` of the smallest size on one stream, sent at once by a client that reads no answers:
/// a ping after them is answered, or the connection ends.
async fn answered(path: &std::path::Path, requests: usize) -> u8 {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let mut headers = Vec::new();
    for (name, value) in [
        (":method", "POST"),
        (":scheme", "http"),
        (":path", "/ratn.v1.ResourceService/Session"),
        (":authority", "localhost"),
        ("content-type", "application/grpc"),
        ("te", "trailers"),
    ] {
        let length = |text: &str| u8::try_from(text.len()).unwrap();
        // Written out, and in no table.
        headers.push(0);
        headers.push(length(name));
        headers.extend(name.as_bytes());
        headers.push(length(value));
        headers.extend(value.as_bytes());
    }
    // A message without a field: five bytes of gRPC.
    let smallest = frame(DATA, 0, 1, &[0; 5]);
    let all = [
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".to_vec(),
        frame(SETTINGS, 0, 0, &[]),
        frame(HEADERS, 4, 1, &headers),
        smallest.repeat(requests),
        frame(PING, 0, 0, &[7; 8]),
    ]
    .concat();
    let (mut from, mut to) = tokio::net::UnixStream::connect(path).await.unwrap().into_split();
    let sent = tokio::spawn(async move { to.write_all(&all).await.map(|()| to) });
    loop {
        let mut head = [0; 9];
        in_time(from.read_exact(&mut head)).await.unwrap();
        let length = u32::from_be_bytes([0, head[0], head[1], head[2]]);
        let mut payload = vec![0; length as usize];
        in_time(from.read_exact(&mut payload)).await.unwrap();
        if (head[3] == PING && payload == [7; 8]) || head[3] == GO_AWAY {
            sent.abort();
            return head[3];
        }
    }
}

#[tokio::test]
async fn as_many_requests_as_a_stream_may_have_wait_on_a_connection_however_small_they_are() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let ratn_worker::endpoint::Endpoint::Unix(path) = &manager.endpoint else { panic!("{}", manager.endpoint) };
    assert_eq!(answered(path, 4_096).await, PING);
    assert_eq!(answered(path, 12_000).await, GO_AWAY, "there is a bound");
}
