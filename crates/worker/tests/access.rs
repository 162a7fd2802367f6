//! Who may call a provider: as what the methods of its services say in the proto, without its author doing anything for it.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::{Double, RESOURCE, goal};
use ratn_model::id::{FencingToken, LeaseId, Revision};
use ratn_model::resource::{Quantity, ResourceClass};
use ratn_proto::types::{GoalOutcome, Holding, Resource, ResourceUpdate};
use ratn_worker::access::{AccessConfig, LiveAccess, Role, RoleGate, UserAccess};
use ratn_worker::action::{Action, ActionResult, ActionServer, GoalContext};
use ratn_worker::client::{ActionClient, Channels};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::lease_watch::LeaseWatch;
use ratn_worker::safety::{Safety, SafetyClient, SafetyState};
use ratn_worker::server::{Services, Serving, bind};
use ratn_worker::tls::ClientTls;
use ratn_worker::worker::{Worker, WorkerOptions};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tonic::Code;

fn only(roles: &[Role]) -> AccessConfig {
    let user = UserAccess { uid: nix::unistd::geteuid().as_raw(), roles: roles.to_vec() };
    AccessConfig { users: vec![user], ..AccessConfig::default() }
}

#[tokio::test]
async fn a_viewers_goal_is_refused_before_it_touches_the_fence() {
    let (place, runs) = (tempfile::tempdir().unwrap(), Arc::new(AtomicUsize::new(0)));
    let server = ActionServer::builder(RESOURCE).dangerously_believe_every_lease();
    let server = server.action(Double { runs: runs.clone() }).build();
    let bound = bind(&Endpoint::Unix(place.path().join("one.sock"))).await.unwrap();
    let (endpoint, live) = (bound.endpoint().clone(), LiveAccess::new(only(&[Role::Viewer])));
    let serving = Serving { gate: Arc::new(RoleGate::new(live.clone())), ..Serving::default() };
    let shutdown = CancellationToken::new();
    tokio::spawn(bound.serve_as(Services::new().with(server.into_service()), serving, shutdown.clone()));
    let client = ActionClient::new(Channels::new(&ClientTls::none()));
    let refused = client.execute(&endpoint, goal("g1", "double", u64::MAX), |_, _| {}).await.unwrap_err();
    assert_eq!(refused.code(), Some(Code::PermissionDenied), "{refused}");
    assert_eq!(runs.load(Ordering::SeqCst), 0);
    live.replace(only(&[Role::Task]));
    // The younger token of the refused goal was not seen.
    let client = ActionClient::new(Channels::new(&ClientTls::none()));
    client.execute(&endpoint, goal("g2", "double", 1), |_, _| {}).await.unwrap();
    assert_eq!(runs.load(Ordering::SeqCst), 1);
    shutdown.cancel();
}

#[tokio::test]
async fn a_lease_of_another_is_no_lease_though_everybody_can_read_it() {
    let (place, runs) = (tempfile::tempdir().unwrap(), Arc::new(AtomicUsize::new(0)));
    let watch = LeaseWatch::of([RESOURCE]);
    let server = ActionServer::builder(RESOURCE).leases(&watch).action(Double { runs: runs.clone() }).build();
    let bound = bind(&Endpoint::Unix(place.path().join("one.sock"))).await.unwrap();
    let (endpoint, live) = (bound.endpoint().clone(), LiveAccess::new(only(&[Role::Task])));
    let serving = Serving { gate: Arc::new(RoleGate::new(live.clone())), ..Serving::default() };
    let shutdown = CancellationToken::new();
    tokio::spawn(bound.serve_as(Services::new().with(server.into_service()), serving, shutdown.clone()));
    let own = format!("uid {}", nix::unistd::geteuid());
    let of = |opened_by: &str| {
        let (lease, token) = (LeaseId(1), FencingToken(1));
        let (units, session, holder) = (Quantity::ONE, "session-1".to_owned(), String::new());
        let mut resource = Resource::new(RESOURCE, ResourceClass::Process, "Tester");
        resource.holdings = vec![Holding { lease, token, units, session, holder, opened_by: opened_by.to_owned() }];
        ResourceUpdate::Snapshot { revision: Revision(1), resources: vec![resource], youngest: lease }
    };
    let give = async |id: &str| {
        let outcome = ActionClient::new(Channels::new(&ClientTls::none()))
            .execute(&endpoint, goal(id, "double", 1), |_, _| {})
            .await;
        outcome.map_err(|error| error.code())
    };
    for stranger in ["uid 65533", "control (certificate)", ""] {
        watch.tell(&of(stranger));
        assert_eq!(give("g1").await.unwrap_err(), Some(Code::PermissionDenied), "opened by {stranger:?}");
    }
    assert_eq!(runs.load(Ordering::SeqCst), 0);
    watch.tell(&of(&own));
    give("g2").await.unwrap();
    // One provider calls another under the lease of who called it.
    live.replace(only(&[Role::Agent]));
    watch.tell(&of("uid 65533"));
    give("g3").await.unwrap();
    assert_eq!(runs.load(Ordering::SeqCst), 2);
    shutdown.cancel();
}

#[tokio::test]
async fn a_worker_asks_its_config_who_may_and_only_an_operator_lets_a_robot_move_again() {
    let place = tempfile::tempdir().unwrap();
    let (file, socket) = (place.path().join("ratn.toml"), place.path().join("one.sock"));
    let uid = nix::unistd::geteuid();
    let section = |role: &str| format!("[[service.access.user]]\nuid = {uid}\nroles = [{role:?}]\n");
    let (listen, shutdown) = (Endpoint::Unix(socket), CancellationToken::new());
    for (role, may_stop, may_clear) in
        [("viewer", false, false), ("task", true, false), ("agent", true, false), ("operator", true, true)]
    {
        std::fs::write(&file, section(role)).unwrap();
        let (id, access) = (RESOURCE.to_owned(), Some(file.clone()));
        let options = WorkerOptions { id, listen: listen.clone(), access, ..WorkerOptions::default() };
        let (safety, ends) = (Safety::default(), shutdown.child_token());
        let worker = Worker::new(options).dangerously_believe_every_lease().safety(safety.clone());
        let worker = worker.shutdown(ends.clone()).run();
        let running = tokio::spawn(worker);
        let channels = Channels::new(&ClientTls::none());
        ratn_worker::client::wait_until_serving(&listen, &ClientTls::none(), Duration::from_secs(10)).await.unwrap();
        let client = SafetyClient::new(&channels, &listen).unwrap();
        assert_eq!(client.state().await.unwrap(), SafetyState::Ready, "{role} may look");
        assert_eq!(client.stop("a hand").await.is_ok(), may_stop, "{role}");
        assert_eq!(matches!(safety.state(), SafetyState::Stopped { .. }), may_stop, "{role}");
        let cleared = client.clear().await;
        assert_eq!(cleared.is_ok(), may_clear, "{role}: {cleared:?}");
        assert_eq!(safety.state() == SafetyState::Ready, may_clear || !may_stop, "{role}");
        if !may_clear {
            assert_eq!(client.go_on().await.unwrap_err().code(), Some(Code::PermissionDenied), "{role}");
        }
        ends.cancel();
        running.await.unwrap().unwrap();
    }
}

#[tokio::test]
async fn a_worker_whose_config_is_none_does_not_start() {
    let place = tempfile::tempdir().unwrap();
    let options = WorkerOptions { access: Some(place.path().join("none")), ..WorkerOptions::default() };
    let refused = Worker::new(options).without_leases().run().await.unwrap_err();
    let source = std::error::Error::source(&refused).unwrap().to_string();
    assert!(source.starts_with("no roles of callers from "), "{source}");
}

/// Whoever watches the health of `live`'s server.
async fn watching(endpoint: &Endpoint) -> tonic::Streaming<tonic_health::pb::HealthCheckResponse> {
    let channel = ratn_worker::endpoint::connect_lazily(endpoint, &ClientTls::none()).unwrap().into_channel();
    let mut client = tonic_health::pb::health_client::HealthClient::new(channel);
    let mut stream = client.watch(tonic_health::pb::HealthCheckRequest::default()).await.unwrap().into_inner();
    assert!(stream.message().await.unwrap().is_some());
    stream
}

#[tokio::test]
async fn a_stream_ends_when_its_caller_loses_a_role_that_it_began_with() {
    const AGES: Duration = Duration::from_secs(60);
    let place = tempfile::tempdir().unwrap();
    let bound = bind(&Endpoint::Unix(place.path().join("one.sock"))).await.unwrap();
    let (endpoint, live) = (bound.endpoint().clone(), LiveAccess::new(only(&[Role::Task])));
    let serving = Serving { gate: Arc::new(RoleGate::new(live.clone())), ..Serving::default() };
    let shutdown = CancellationToken::new();
    tokio::spawn(bound.serve_as(Services::new(), serving, shutdown.clone()));
    for (now, code) in [(&[Role::Viewer] as &[Role], Code::Unavailable), (&[], Code::PermissionDenied)] {
        live.replace(only(&[Role::Task]));
        let mut stream = watching(&endpoint).await;
        // More is nothing lost.
        live.replace(only(&[Role::Task, Role::Agent]));
        live.replace(only(now));
        let ended = tokio::time::timeout(AGES, stream.message()).await.expect("the stream ends").unwrap_err();
        assert_eq!(ended.code(), code, "{ended}");
    }
    shutdown.cancel();
}

#[tokio::test]
async fn a_stream_of_a_server_that_follows_a_file_ends_though_nobody_calls() {
    let place = tempfile::tempdir().unwrap();
    let (file, uid) = (place.path().join("ratn.toml"), nix::unistd::geteuid());
    let write = |roles: &str| {
        // In one step: a file that is half written would keep the roles of before.
        let new = place.path().join("new");
        std::fs::write(&new, format!("[[service.access.user]]\nuid = {uid}\nroles = [{roles}]\n")).unwrap();
        std::fs::rename(new, &file).unwrap();
    };
    write("\"viewer\"");
    let bound = bind(&Endpoint::Unix(place.path().join("one.sock"))).await.unwrap();
    let (endpoint, live) = (bound.endpoint().clone(), LiveAccess::of_file(&file).unwrap());
    let serving = Serving { gate: Arc::new(RoleGate::new(live)), ..Serving::default() };
    let shutdown = CancellationToken::new();
    tokio::spawn(bound.serve_as(Services::new(), serving, shutdown.clone()));
    let mut stream = watching(&endpoint).await;
    write("");
    let ended = tokio::time::timeout(Duration::from_secs(60), stream.message()).await.expect("the stream ends");
    assert_eq!(ended.unwrap_err().code(), Code::PermissionDenied);
    shutdown.cancel();
}

/// Moves until it is told to stop, for as long as that takes.
struct Moves(tokio::sync::watch::Sender<bool>);

#[tonic::async_trait]
impl Action for Moves {
    fn name(&self) -> &str {
        "moves"
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        self.0.send_replace(true);
        goal.cancelled.cancelled().await;
        tokio::time::sleep(Duration::from_millis(300)).await;
        self.0.send_replace(false);
        Ok(GoalOutcome::success())
    }
}

#[tokio::test]
async fn a_goal_whose_giver_loses_its_role_was_not_refused_but_is_under_way() {
    let place = tempfile::tempdir().unwrap();
    let (moves, mut moving) = tokio::sync::watch::channel(false);
    let server = ActionServer::builder(RESOURCE).dangerously_believe_every_lease().action(Moves(moves)).build();
    let bound = bind(&Endpoint::Unix(place.path().join("one.sock"))).await.unwrap();
    let (endpoint, live) = (bound.endpoint().clone(), LiveAccess::new(only(&[Role::Task])));
    let serving = Serving { gate: Arc::new(RoleGate::new(live.clone())), ..Serving::default() };
    let shutdown = CancellationToken::new();
    tokio::spawn(bound.serve_as(Services::new().with(server.into_service()), serving, shutdown.clone()));
    let client = ActionClient::new(Channels::new(&ClientTls::none()));
    // Once over the stream that goals share, and once over one of its own.
    for (number, now) in [(1, &[Role::Viewer] as &[Role]), (2, &[])] {
        live.replace(only(&[Role::Task]));
        let goal = goal(&format!("g{number}"), "moves", number);
        let (giver, at, again) = (client.clone(), endpoint.clone(), goal.clone());
        let given = tokio::spawn(async move { giver.execute_hearing(&at, goal, || true, |_| {}).await });
        moving.wait_for(|moving| *moving).await.unwrap();
        let (joiner, at) = (client.clone(), endpoint.clone());
        let joined = tokio::spawn(async move { joiner.attach(&at, again, |_, _| {}).await });
        tokio::time::sleep(Duration::from_millis(100)).await;
        live.replace(only(now));
        for ended in [given.await.unwrap(), joined.await.unwrap()] {
            let error = ended.unwrap_err();
            assert!(error.is_crash() && error.to_string().contains("may not Perform"), "{error}");
        }
        moving.wait_for(|moving| !*moving).await.unwrap();
    }
    shutdown.cancel();
}
