//! The queue of the resource manager over gRPC: its order, its bounds, and how one leaves it.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_daemon::metrics::Metrics;
use ratn_daemon::resource_manager::{ROLE, ResourceManagerConfig, run_as};
use ratn_model::resource::{Lease, Requirement, ResourceClass};
use ratn_proto::types::Resource;
use ratn_proto::v1;
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use ratn_resources::Limits;
use ratn_worker::client::{AcquireOptions, CallError, ResourceClient};
use ratn_worker::server::Serving;
use ratn_worker::session::{Session, Standing};
use ratn_worker::trace::Traced;
use std::sync::Arc;
use std::time::{Duration, SystemTime};
use support::{Client, DEADLINE, Daemon, TestSystem, block, in_time};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status};
use tonic_types::StatusExt;

type Waiting = JoinHandle<Result<Lease, CallError>>;

async fn manager_with(system: &TestSystem, limits: Limits) -> Daemon {
    let config = ResourceManagerConfig { listen: system.directory.socket("rm"), limits, ..Default::default() };
    system.resource_manager_with(config).await
}

/// Asks under a request id, and returns when that waits (or was answered).
async fn ask(client: &Client, request: &str, count: u32) -> Waiting {
    let (resources, requirement) = (client.resources.clone(), Requirement { count: count.into(), ..block("Planner") });
    let options = AcquireOptions { request: request.to_owned(), ..Default::default() };
    let asked = tokio::spawn(async move { resources.acquire(vec![requirement], options).await });
    in_time(async {
        while !asked.is_finished() && client.resources.explain(request).await.is_err() {
            tokio::task::yield_now().await;
        }
    })
    .await;
    asked
}

async fn waiting(client: &Client) -> u32 {
    client.resources.sessions().await.unwrap().iter().map(|session| session.waiting).sum()
}

async fn until_waiting(client: &Client, count: u32) {
    in_time(async {
        while waiting(client).await != count {
            tokio::task::yield_now().await;
        }
    })
    .await;
}

/// A client with two planners of which it holds one.
async fn half_held(system: &TestSystem, manager: &Daemon) -> (Client, Lease) {
    let a = system.client(manager, "a").await;
    for id in ["p1", "p2"] {
        a.resources.create(Resource::new(id, ResourceClass::Module, "Planner")).await.unwrap();
    }
    let held = a.resources.acquire(vec![block("Planner")], AcquireOptions::default()).await.unwrap();
    (a, held)
}

#[tokio::test]
async fn a_large_request_is_not_overtaken_unless_that_is_configured() {
    let system = TestSystem::new();
    let manager = manager_with(&system, Limits::default()).await;
    let (a, held) = half_held(&system, &manager).await;
    let large = ask(&a, "large", 2).await;
    let small = ask(&a, "small", 1).await;
    assert!(!small.is_finished(), "a planner is free, and kept for the large request");
    a.resources.release(held.id).await.unwrap();
    let large = in_time(large).await.unwrap().unwrap();
    assert!(!small.is_finished());
    a.resources.release(large.id).await.unwrap();
    in_time(small).await.unwrap().unwrap();
}

#[tokio::test]
async fn a_large_request_is_overtaken_as_often_as_configured_and_no_more() {
    let system = TestSystem::new();
    let manager = manager_with(&system, Limits { overtaken: 2, ..Limits::default() }).await;
    let (a, held) = half_held(&system, &manager).await;
    let large = ask(&a, "large", 2).await;
    for i in 0..2 {
        let small = in_time(ask(&a, &format!("small-{i}"), 1).await).await.unwrap().unwrap();
        a.resources.release(small.id).await.unwrap();
    }
    let third = ask(&a, "small-2", 1).await;
    assert!(!large.is_finished() && !third.is_finished(), "the free planner is kept for the large request now");
    a.resources.release(held.id).await.unwrap();
    let large = in_time(large).await.unwrap().unwrap();
    assert!(!third.is_finished());
    a.resources.release(large.id).await.unwrap();
    in_time(third).await.unwrap().unwrap();
}

fn raw(system: &TestSystem, manager: &Daemon) -> ResourceServiceClient<Traced> {
    ResourceServiceClient::new(system.channels.get(&manager.endpoint).unwrap())
}

fn acquire(client: &Client, request: &str, deadline_ms: u64) -> v1::AcquireRequest {
    v1::AcquireRequest {
        request_id: request.to_owned(),
        session_id: client.session.id().to_owned(),
        requirements: vec![block("Planner").into()],
        deadline_ms,
        ..Default::default()
    }
}

fn refused_for_their_number(refused: &Status, words: &str) {
    assert_eq!(refused.code(), Code::ResourceExhausted);
    assert!(refused.message().contains(words), "{}", refused.message());
    let delay = refused.get_details_retry_info().unwrap().retry_delay.unwrap();
    assert!(delay > Duration::ZERO && delay < Duration::from_secs(10), "{delay:?}");
}

#[tokio::test]
async fn beyond_the_bounds_on_waiters_a_request_is_refused_with_a_delay_to_try_again_after() {
    let system = TestSystem::new();
    let limits = Limits { waiters_per_session: 2, waiters: 3, ..Limits::default() };
    let manager = manager_with(&system, limits).await;
    let (a, b) = (system.client(&manager, "a").await, system.client(&manager, "b").await);
    let queued = [ask(&a, "a1", 1).await, ask(&a, "a2", 1).await];
    let mut raw = raw(&system, &manager);
    let refused = in_time(raw.acquire(acquire(&a, "a3", 60_000))).await.unwrap_err();
    refused_for_their_number(&refused, "waiters of one session");
    let last = ask(&b, "b1", 1).await;
    let refused = in_time(raw.acquire(acquire(&b, "b2", 60_000))).await.unwrap_err();
    refused_for_their_number(&refused, "waiters");
    // What can be had at once is had, however many wait for something else.
    a.resources.create(Resource::new("arm", ResourceClass::Module, "Arm")).await.unwrap();
    for client in [&a, &b] {
        let arm = client.resources.acquire(vec![block("Arm")], AcquireOptions::default()).await.unwrap();
        client.resources.release(arm.id).await.unwrap();
    }
    // A place that is left can be taken.
    assert!(a.resources.withdraw("a1").await.unwrap());
    let taken = ask(&b, "b2", 1).await;
    assert_eq!(waiting(&a).await, 3);
    for waits in queued.into_iter().chain([last, taken]) {
        waits.abort();
    }
}

#[tokio::test]
async fn an_acquire_or_a_block_without_a_deadline_is_refused() {
    let system = TestSystem::new();
    let manager = manager_with(&system, Limits::default()).await;
    let a = system.client(&manager, "a").await;
    let mut raw = raw(&system, &manager);
    let refused = in_time(raw.acquire(acquire(&a, "", 0))).await.unwrap_err();
    assert_eq!(refused.code(), Code::InvalidArgument);
    assert!(refused.message().contains("deadline_ms: is 0"), "{}", refused.message());
    let session_id = a.session.id().to_owned();
    let request = v1::BlockRequest { session_id, requirement: Some(block("Planner").into()), ..Default::default() };
    assert_eq!(in_time(raw.block(request)).await.unwrap_err().code(), Code::InvalidArgument);
    assert_eq!(waiting(&a).await, 0);
}

#[tokio::test]
async fn a_cancelled_call_leaves_the_queue_and_whoever_it_held_up_is_served() {
    let system = TestSystem::new();
    let manager = manager_with(&system, Limits::default()).await;
    let (a, _held) = half_held(&system, &manager).await;
    // Over the session's stream.
    let large = ask(&a, "large", 2).await;
    let small = ask(&a, "small", 1).await;
    assert_eq!(waiting(&a).await, 2);
    large.abort();
    in_time(small).await.unwrap().unwrap();
    until_waiting(&a, 0).await;
    // And on its own: the client resets the HTTP/2 stream.
    let mut raw = raw(&system, &manager);
    let request = acquire(&a, "alone", 60_000);
    let call = tokio::spawn(async move { raw.acquire(request).await });
    until_waiting(&a, 1).await;
    call.abort();
    until_waiting(&a, 0).await;
}

#[tokio::test]
async fn a_limit_of_leases_that_changes_binds_in_a_running_manager_at_once() {
    let system = TestSystem::new();
    let config = ResourceManagerConfig { listen: system.directory.socket("rm"), ..Default::default() };
    let (live, end) = (watch::Sender::new(config.clone()), CancellationToken::new());
    let metrics = Arc::new(Metrics::new(ROLE));
    let run = run_as(live.subscribe(), system.directory.clone(), Serving::default(), metrics, end.clone());
    let running = tokio::spawn(run);
    let endpoint = system.directory.wait_for(ROLE, DEADLINE).await.unwrap();
    let session = Session::open(&system.channels, &endpoint, "a", Duration::from_secs(5));
    session.alive(DEADLINE).await.unwrap();
    let resources = ResourceClient::new(&system.channels, &endpoint, session.id()).unwrap();
    let a = Client { session, resources };
    for id in ["p1", "p2", "p3", "p4"] {
        a.resources.create(Resource::new(id, ResourceClass::Module, "Planner")).await.unwrap();
    }
    for _ in 0..2 {
        a.resources.acquire(vec![block("Planner")], AcquireOptions::default()).await.unwrap();
    }

    let leases = |leases: usize| {
        let limits = Limits { leases, leases_for_operators: 0, ..Limits::default() };
        live.send_replace(ResourceManagerConfig { limits, ..config.clone() });
    };
    leases(2);
    let waits = ask(&a, "a3", 1).await;
    until_waiting(&a, 1).await;
    assert!(!waits.is_finished());

    leases(3);
    in_time(waits).await.unwrap().unwrap();
    end.cancel();
    in_time(running).await.unwrap().unwrap();
}

/// A client whose session says what it is beside others.
async fn client_beside(system: &TestSystem, manager: &Daemon, name: &str, standing: Standing) -> Client {
    let ttl = Duration::from_secs(5);
    let session = Session::open_beside(&system.channels, &manager.endpoint, name.to_owned(), name, ttl, standing);
    session.alive(DEADLINE).await.unwrap();
    let resources = ResourceClient::new(&system.channels, &manager.endpoint, session.id()).unwrap();
    Client { session, resources }
}

#[expect(clippy::disallowed_methods, reason = "a due time is a moment of the wall clock")]
fn due_in(seconds: u64) -> Standing {
    Standing { due: Some(SystemTime::now() + Duration::from_secs(seconds)), ..Standing::default() }
}

#[tokio::test]
async fn what_a_session_says_of_its_share_and_its_due_time_is_told_and_whose_task_is_due_first_is_served_first() {
    let system = TestSystem::new();
    let manager = manager_with(&system, Limits::default()).await;
    let (a, held) = half_held(&system, &manager).await;
    let other = a.resources.acquire(vec![block("Planner")], AcquireOptions::default()).await.unwrap();
    let later = client_beside(&system, &manager, "later", Standing { share: 2.5, ..due_in(3_000) }).await;
    let sooner = client_beside(&system, &manager, "sooner", due_in(1_000)).await;
    let waits = [ask(&a, "a", 1).await, ask(&later, "later", 1).await, ask(&sooner, "sooner", 1).await];

    let waiting = a.resources.explain("").await.unwrap();
    let order: Vec<&str> = waiting.iter().map(|one| one.request.as_str()).collect();
    assert_eq!(order, ["sooner", "later", "a"]);
    let told: Vec<f64> = waiting.iter().map(|one| one.share).collect();
    assert_eq!(told, [1.0, 2.5, 1.0]);
    let is_due = |due: Option<i64>, seconds: i64| {
        due.is_some_and(|due| (seconds * 1_000 - 60_000..=seconds * 1_000).contains(&due))
    };
    assert!(is_due(waiting[0].due_in_ms, 1_000) && is_due(waiting[1].due_in_ms, 3_000), "{waiting:?}");
    assert_eq!(waiting[2].due_in_ms, None);
    let sessions = a.resources.sessions().await.unwrap();
    let of = |id: &str| sessions.iter().find(|session| session.id == id).unwrap();
    assert_eq!((of("later").share, of("sooner").share, of(a.session.id()).share), (2.5, 1.0, 1.0));
    assert!(is_due(of("later").due_in_ms, 3_000));

    let [first, second, third] = [2, 1, 0];
    let mut waits = waits.map(Some);
    a.resources.release(held.id).await.unwrap();
    let lease = in_time(waits[first].take().unwrap()).await.unwrap().unwrap();
    a.resources.release(other.id).await.unwrap();
    in_time(waits[second].take().unwrap()).await.unwrap().unwrap();
    sooner.resources.release(lease.id).await.unwrap();
    in_time(waits[third].take().unwrap()).await.unwrap().unwrap();
}

#[tokio::test]
async fn a_share_beyond_the_bounds_is_refused_with_what_it_may_be() {
    let system = TestSystem::new();
    let manager = manager_with(&system, Limits::default()).await;
    let mut raw = raw(&system, &manager);
    for share in [-1.0, 0.001, 100.5, f64::NAN, f64::INFINITY] {
        let ping = v1::KeepAliveRequest { session_id: "greedy".into(), ttl_ms: 5_000, share, ..Default::default() };
        let mut answers = in_time(raw.keep_alive(tokio_stream::once(ping))).await.unwrap().into_inner();
        let refused = in_time(answers.message()).await.unwrap_err();
        assert_eq!(refused.code(), Code::InvalidArgument);
        let words = "a share is a number from 0.01 to 100";
        assert!(refused.message().starts_with("share: is ") && refused.message().contains(words), "{refused}");
    }
    // Any due time is one.
    for due_in_ms in [i64::MIN, i64::MAX, 0] {
        let ping = v1::KeepAliveRequest {
            session_id: "odd".into(),
            ttl_ms: 5_000,
            due_in_ms: Some(due_in_ms),
            ..Default::default()
        };
        let mut answers = in_time(raw.keep_alive(tokio_stream::once(ping))).await.unwrap().into_inner();
        in_time(answers.message()).await.unwrap().unwrap();
    }
}

#[tokio::test]
async fn an_acquire_that_takes_the_place_of_another_keeps_its_time_and_the_other_call_ends() {
    let system = TestSystem::new();
    let manager = manager_with(&system, Limits::default()).await;
    let (a, held) = half_held(&system, &manager).await;
    let rest = a.resources.acquire(vec![block("Planner")], AcquireOptions::default()).await.unwrap();
    let options = AcquireOptions { request: "in-case".into(), speculative: true, ..Default::default() };
    let resources = a.resources.clone();
    let in_case = tokio::spawn(async move { resources.acquire(vec![block("Planner")], options).await });
    until_waiting(&a, 1).await;
    assert!(a.resources.explain("in-case").await.unwrap()[0].speculative);
    let options =
        AcquireOptions { request: "certain".into(), instead_of: "in-case".into(), ..AcquireOptions::default() };
    let resources = a.resources.clone();
    let certain = tokio::spawn(async move { resources.acquire(vec![block("Planner")], options).await });
    in_time(in_case).await.unwrap().unwrap_err();
    assert_eq!(waiting(&a).await, 1);
    assert!(!a.resources.explain("certain").await.unwrap()[0].speculative);
    a.resources.release(held.id).await.unwrap();
    in_time(certain).await.unwrap().unwrap();
    a.resources.release(rest.id).await.unwrap();
}
