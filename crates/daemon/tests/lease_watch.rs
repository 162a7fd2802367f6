//! What a provider knows of its leases when the resource manager, or the way to it, hangs: no connection breaks by that.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_model::resource::ResourceClass;
use ratn_proto::types::Resource;
use ratn_worker::client::{AcquireOptions, Channels, wait_until_serving};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::lease_watch::{Claim, ClaimStatus, LeaseWatch, ManagerLocation};
use ratn_worker::runtime_directory::wait_for_file;
use ratn_worker::session::Session;
use ratn_worker::tls::ClientTls;
use ratn_worker::worker::{Worker, WorkerOptions};
use std::path::Path;
use std::time::{Duration, Instant};
use support::{Client, TestSystem, block, in_time};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tonic::Code;

const PATIENCE: Duration = Duration::from_millis(600);
/// Far less than a connection that hangs takes to break.
const SOON: Duration = Duration::from_secs(6);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Line {
    Open,
    /// Nothing gets through, and nothing breaks.
    Hangs,
}

/// A way to the manager that can hang, or break and then hang.
struct Way {
    endpoint: Endpoint,
    line: watch::Sender<Line>,
    cut: watch::Sender<u32>,
}

impl Way {
    fn to(manager: &Endpoint, directory: &Path) -> Way {
        let Endpoint::Unix(manager) = manager.clone() else { panic!("{manager} is no socket") };
        let path = directory.join("way.sock");
        let listener = UnixListener::bind(&path).unwrap();
        let (line, cut) = (watch::Sender::new(Line::Open), watch::Sender::new(0));
        let (lines, cuts) = (line.clone(), cut.clone());
        tokio::spawn(async move {
            while let Ok((near, _)) = listener.accept().await {
                let (manager, line, mut cut) = (manager.clone(), lines.subscribe(), cuts.subscribe());
                tokio::spawn(async move {
                    let far = UnixStream::connect(manager).await.unwrap();
                    let ((near_in, near_out), (far_in, far_out)) = (near.into_split(), far.into_split());
                    tokio::select! {
                        () = forward(near_in, far_out, line.clone()) => {}
                        () = forward(far_in, near_out, line) => {}
                        _ = cut.changed() => {}
                    }
                });
            }
        });
        Way { endpoint: Endpoint::Unix(path), line, cut }
    }

    fn is(&self, line: Line) {
        self.line.send_replace(line);
    }

    fn breaks_and_hangs(&self) {
        self.is(Line::Hangs);
        self.cut.send_modify(|cuts| *cuts += 1);
    }
}

async fn forward(mut from: impl AsyncRead + Unpin, mut to: impl AsyncWrite + Unpin, mut line: watch::Receiver<Line>) {
    let mut bytes = vec![0; 64 * 1024];
    while let Ok(read @ 1..) = from.read(&mut bytes).await {
        let open = line.wait_for(|line| *line == Line::Open).await.is_ok();
        if !open || to.write_all(&bytes[..read]).await.is_err() {
            return;
        }
    }
}

async fn until_heard(leases: &LeaseWatch, heard: bool) -> Duration {
    let began = Instant::now();
    in_time(async {
        while leases.is_heard() != heard {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    began.elapsed()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_manager_that_hangs_is_not_trusted_longer_than_a_lease_may_last() {
    let (system, place) = (TestSystem::new(), tempfile::tempdir().unwrap());
    let manager = system.resource_manager_at(Endpoint::Unix(place.path().join("rm.sock"))).await;
    let way = Way::to(&manager.endpoint, place.path());
    let leases = LeaseWatch::of(["planner-1@here"]);
    let following = leases.follow_location(
        &Channels::new(&ClientTls::none()),
        ManagerLocation::At(way.endpoint.clone()),
        "a manager of processes",
        PATIENCE,
    );
    let following = tokio::spawn(following);
    until_heard(&leases, true).await;
    // Answers are asked for: nothing happens to the resource, and the manager is still heard after several times the patience.
    tokio::time::sleep(3 * PATIENCE).await;
    assert!(leases.is_heard());
    way.is(Line::Hangs);
    let trusted = until_heard(&leases, false).await;
    assert!(trusted < SOON, "{trusted:?}");
    way.is(Line::Open);
    until_heard(&leases, true).await;
    following.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_lookalike_of_a_pooled_worker_has_no_lease_of_the_worker() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let (pools, other) = (system.client(&manager, "pools").await, system.client(&manager, "other").await);
    let id = "planner-3@here";
    // Leases the resource, as soon as that is there, and follows the manager then: what a lease is, the first word says.
    let said_of = async |provider: &Client| {
        let planner = Resource::new(id, ResourceClass::Process, "PathPlanner");
        provider.resources.create(planner).await.unwrap();
        let lease = provider.resources.acquire(vec![block("PathPlanner")], AcquireOptions::default()).await.unwrap();
        let leases = LeaseWatch::of([id]);
        let location = ManagerLocation::At(manager.endpoint.clone());
        let following = leases.follow_location(&Channels::new(&ClientTls::none()), location, pools.session.id(), SOON);
        let following = tokio::spawn(following);
        until_heard(&leases, true).await;
        let said = leases.check(&Claim { resource: id, lease: lease.id, token: lease.token, session: "" });
        following.abort();
        said
    };
    // Anybody who may create resources can guess the id of the next worker.
    let said = said_of(&other).await;
    assert!(matches!(&said, ClaimStatus::Refuted(why) if why.contains("no lease holds it")), "{said:?}");
    let planner = Resource::new(id, ResourceClass::Process, "PathPlanner");
    let refused = pools.resources.create(planner).await.unwrap_err();
    assert_eq!(refused.code(), Some(Code::AlreadyExists), "{refused}");
    other.session.close().await;
    assert_eq!(said_of(&pools).await, ClaimStatus::Confirmed);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_end_of_the_session_is_seen_while_the_watch_is_taken_up_again() {
    let (system, place) = (TestSystem::new(), tempfile::tempdir().unwrap());
    let manager = system.resource_manager_at(Endpoint::Unix(place.path().join("rm.sock"))).await;
    let (way, channels) = (Way::to(&manager.endpoint, place.path()), Channels::new(&ClientTls::none()));
    let session = Session::open(&channels, &way.endpoint, "cell", PATIENCE);
    let leases = LeaseWatch::of(["arm@here"]);
    // However patient it was told to be.
    let hour = Duration::from_secs(3_600);
    let following = tokio::spawn(leases.follow_session(&channels, &way.endpoint, &session, hour).unwrap());
    until_heard(&leases, true).await;
    way.breaks_and_hangs();
    let trusted = until_heard(&leases, false).await;
    assert!(trusted < SOON, "{trusted:?}");
    following.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_worker_that_has_never_heard_the_manager_does_not_say_that_it_serves() {
    let (system, place) = (TestSystem::new(), tempfile::tempdir().unwrap());
    let manager = system.resource_manager_at(Endpoint::Unix(place.path().join("rm.sock"))).await;
    let way = Way::to(&manager.endpoint, place.path());
    way.is(Line::Hangs);
    let file = place.path().join("worker.endpoint");
    let options = WorkerOptions {
        id: "planner-1@here".to_owned(),
        kind: "PathPlanner".to_owned(),
        endpoint_file: Some(file.clone()),
        resource_manager: Some(way.endpoint.clone()),
        ..WorkerOptions::default()
    };
    let shutdown = CancellationToken::new();
    let running = tokio::spawn(Worker::new(options).shutdown(shutdown.clone()).run());
    let endpoint = wait_for_file(&file, "worker", SOON).await.unwrap();
    assert!(wait_until_serving(&endpoint, &ClientTls::none(), PATIENCE).await.is_err());
    way.is(Line::Open);
    in_time(wait_until_serving(&endpoint, &ClientTls::none(), Duration::from_secs(20))).await.unwrap();
    shutdown.cancel();
    running.await.unwrap().unwrap();
}

#[tokio::test]
async fn a_worker_without_a_lease_is_one_only_where_it_says_so_and_moves_nothing() {
    let refused = Worker::new(WorkerOptions::default()).run().await.unwrap_err();
    assert!(refused.to_string().contains("`without_leases()`"), "{refused}");
    let moves = Worker::new(WorkerOptions::default()).without_leases().safety(Default::default());
    let refused = moves.run().await.unwrap_err();
    assert!(refused.to_string().contains("asks for no lease"), "{refused}");
}
