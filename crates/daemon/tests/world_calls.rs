//! Commits, projections and releases of one client over one stream.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_daemon::access::{Caller, Role};
use ratn_daemon::metrics::Metrics;
use ratn_daemon::quota::QuotaConfig;
use ratn_daemon::service::ServiceConfig;
use ratn_daemon::world_pool::{self, WorldPoolConfig};
use ratn_model::fact::{Change, FactKey, Footprint};
use ratn_model::id::Revision;
use ratn_model::value::Value;
use ratn_proto::MAX_MESSAGE_BYTES;
use ratn_proto::v1::calls_request::Kind as Asked;
use ratn_proto::v1::calls_response::Kind;
use ratn_proto::v1::world_pool_service_client::WorldPoolServiceClient;
use ratn_proto::v1::{self, CallsRequest};
use ratn_worker::client::{Commit, Early, Projection};
use ratn_worker::gate::{Gate, Identity};
use ratn_worker::server::Serving;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use support::{Daemon, TestSystem, in_time};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::codegen::http;
use tonic::{Code, Status, Streaming};
use tonic_types::{ErrorDetails, StatusExt};

const CALLS: &str = "/ratn.v1.WorldPoolService/Calls";

/// The client's end.
struct Line {
    questions: mpsc::Sender<CallsRequest>,
    answers: Streaming<v1::CallsResponse>,
}

impl Line {
    async fn open(system: &TestSystem, pool: &Daemon) -> Line {
        let channel = system.channels.get(&pool.endpoint).unwrap();
        let (questions, outgoing) = mpsc::channel(64);
        let call = WorldPoolServiceClient::new(channel).calls(ReceiverStream::new(outgoing)).await;
        Line { questions, answers: call.unwrap().into_inner() }
    }

    async fn ask(&self, id: u64, kind: Option<Asked>) {
        self.questions.send(CallsRequest { id, kind, ..Default::default() }).await.unwrap();
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

fn full(value: i64) -> Vec<Change> {
    let fact = FactKey { predicate: "full".to_owned(), arguments: Vec::new() };
    vec![Change::Set { fact, value: Value::Int(value) }]
}

fn commit(id: &str, revision: u64) -> Option<Asked> {
    let changes = full(1).into_iter().map(v1::Change::from).collect();
    Some(Asked::Commit(v1::CommitRequest { commit_id: id.to_owned(), changes, revision, ..Default::default() }))
}

fn project(after: &str) -> Option<Asked> {
    let reads = Some(Footprint::Everything.into());
    Some(Asked::Project(v1::ProjectRequest { reads, after_commit_id: after.to_owned(), ..Default::default() }))
}

#[tokio::test]
async fn answers_come_as_they_are_there_and_each_as_if_its_call_had_come_alone() {
    let system = TestSystem::new();
    let pool = system.world_pool(2).await;
    let mut line = Line::open(&system, &pool).await;
    // It waits for the commit that comes behind it.
    line.ask(1, project("run/i1/1")).await;
    line.ask(2, commit("run/i1/1", 1)).await;
    let mut answers = BTreeMap::from([line.hear().await]);
    answers.extend([line.hear().await]);
    assert!(matches!(&answers[&2], Kind::Commit(made) if made.revision == 1), "{answers:?}");
    let Kind::Project(made) = &answers[&1] else { panic!("{answers:?}") };
    let projection_id = made.projection_id;
    // What fails leaves the stream as it is.
    line.ask(3, commit("run/i2/2", 7)).await;
    assert_eq!(line.failure().await, (3, Code::FailedPrecondition));
    line.ask(4, None).await;
    assert_eq!(line.failure().await, (4, Code::InvalidArgument));
    line.ask(5, commit("", 2)).await;
    assert_eq!(line.failure().await, (5, Code::InvalidArgument));
    for (id, released) in [(6, true), (7, false)] {
        line.ask(id, Some(Asked::Release(v1::WorldPoolServiceReleaseRequest { projection_id }))).await;
        let answer = line.hear().await;
        assert!(
            matches!(&answer, (heard, Kind::Release(ended)) if *heard == id && ended.released == released),
            "{answer:?}"
        );
    }
    // The same commit again is made once.
    line.ask(8, commit("run/i1/1", 1)).await;
    assert!(matches!(line.hear().await, (8, Kind::Commit(made)) if made.revision == 1));
    pool.end().await;
}

#[tokio::test]
async fn what_was_asked_for_on_a_stream_that_breaks_may_be_asked_for_again() {
    let system = TestSystem::new();
    let pool = system.world_pool(2).await;
    let line = Line::open(&system, &pool).await;
    line.ask(1, commit("run/i1/1", 1)).await;
    let world = system.world(&pool);
    in_time(async {
        while world.root().await.unwrap().0 < Revision(1) {
            tokio::task::yield_now().await;
        }
    })
    .await;
    // The answer is not read.
    drop(line);
    assert_eq!(world.commit("run/i1/1", full(1), Some(Revision(1))).await.unwrap(), Revision(1));
    assert_eq!(world.commit("run/i2/2", full(2), Some(Revision(2))).await.unwrap(), Revision(2));
    pool.end().await;
}

fn wanted() -> Projection {
    Projection {
        request: "run/i3/1".to_owned(),
        base: Revision(1),
        changes: Vec::new(),
        writers: Vec::new(),
        reads: Footprint::Everything,
        lease: None,
    }
}

#[tokio::test]
async fn a_call_after_the_end_of_a_pool_reaches_its_successor() {
    let system = TestSystem::new();
    let pool = system.world_pool(2).await;
    let world = system.world(&pool);
    assert_eq!(world.commit("run/i1/1", full(1), None).await.unwrap(), Revision(1));
    pool.end().await;
    let refused = world.commit("run/i4/2", full(3), None).await.unwrap_err();
    assert!(refused.is_crash(), "{refused}");
    let pool = system.world_pool(2).await;
    let committed = ratn_worker::client::retry_unanswered(|| world.commit("run/i4/2", full(3), None)).await.unwrap();
    assert_eq!(committed, Revision(2));
    pool.end().await;
}

#[tokio::test]
async fn a_request_that_is_too_large_is_refused_alone() {
    let system = TestSystem::new();
    let pool = system.world_pool(2).await;
    let world = system.world(&pool);
    assert_eq!(world.commit("run/i1/1", full(1), None).await.unwrap(), Revision(1));
    let early = Early { after: Some("run/i2/2".to_owned()), ..Early::default() };
    let mut waits = std::pin::pin!(world.project_early(wanted(), early));
    assert!(tokio::time::timeout(Duration::from_millis(20), &mut waits).await.is_err(), "it waits for its commit");
    let fact = FactKey { predicate: "text".to_owned(), arguments: Vec::new() };
    let large = vec![Change::Set { fact, value: Value::String("x".repeat(MAX_MESSAGE_BYTES)) }];
    let refused = world.commit("run/i9/9", large, None).await.unwrap_err();
    assert_eq!(refused.code(), Some(Code::OutOfRange), "{refused}");
    assert_eq!(world.commit("run/i2/2", full(2), None).await.unwrap(), Revision(2));
    in_time(waits).await.unwrap();
    pool.end().await;
}

/// Notes which methods are called, and knows no stream of calls: as a pool of before there was one.
struct OfBefore {
    inner: Arc<dyn Gate>,
    called: Mutex<Vec<String>>,
}

impl Gate for OfBefore {
    fn caller(&self, identity: &Identity) -> Caller {
        self.inner.caller(identity)
    }

    fn admit(&self, caller: &Caller, path: &str, extensions: &mut http::Extensions) -> Result<(), Status> {
        self.called.lock().unwrap().push(path.to_owned());
        if path == CALLS {
            let details = ErrorDetails::with_error_info("METHOD_CLOSED", "ratn", []);
            return Err(Status::with_error_details(Code::PermissionDenied, format!("nobody may call {path}"), details));
        }
        self.inner.admit(caller, path, extensions)
    }

    fn answered(&self, _: &str, _: Code, _: Duration) {}
}

#[tokio::test]
async fn a_pool_without_the_stream_is_asked_by_calls_of_their_own() {
    let system = TestSystem::new();
    let gate = Arc::new(OfBefore { inner: Serving::default().gate, called: Mutex::default() });
    let serving = Serving { gate: gate.clone(), ..Serving::default() };
    let pool = system.world_pool_serving(WorldPoolConfig { capacity: 2, ..system.world_pool_config() }, serving).await;
    let world = system.world(&pool);
    for number in 1..=3 {
        let (revision, id) = (Revision(number), format!("run/i{number}/{number}"));
        let commit = Commit { id, changes: full(1), revision: Some(revision), ..Commit::default() };
        assert_eq!(world.commit_as(commit).await.unwrap().0, revision);
    }
    let called = gate.called.lock().unwrap().clone();
    let count = |path: &str| called.iter().filter(|called| *called == path).count();
    assert_eq!((count(CALLS), count("/ratn.v1.WorldPoolService/Commit")), (1, 3), "{called:?}");
    pool.end().await;
}

#[tokio::test]
async fn every_call_of_a_stream_counts_for_the_quotas_of_its_caller() {
    let system = TestSystem::new();
    let quotas = QuotaConfig { calls_per_s: 1, ..QuotaConfig::default() };
    let serving =
        ServiceConfig { quotas, ..ServiceConfig::default() }.serving(&Arc::new(Metrics::new(world_pool::ROLE)));
    // On loopback all are one caller, who is no operator.
    let config = WorldPoolConfig { listen: "127.0.0.1:0".parse().unwrap(), ..system.world_pool_config() };
    let pool = system.world_pool_serving(config, serving).await;
    let mut line = Line::open(&system, &pool).await;
    for id in 1..=20 {
        line.ask(id, commit(&format!("run/i{id}/{id}"), 0)).await;
    }
    let mut refused = 0;
    for _ in 1..=20 {
        if let (_, Kind::Failure(failure)) = line.hear().await {
            assert!(failure.message.contains("(service.quotas.calls_per_s)"), "{failure:?}");
            refused += 1;
        }
    }
    assert!(refused >= 15, "only {refused} of 20 were refused");
    pool.end().await;
}

#[test]
fn who_may_only_look_may_open_no_stream() {
    let viewer = Caller { name: "eve".into(), roles: [Role::Viewer].as_slice().into() };
    assert_eq!(viewer.admit(CALLS).unwrap_err().code(), Code::PermissionDenied);
    let task = Caller { name: "run".into(), roles: [Role::Task].as_slice().into() };
    assert!(task.admit(CALLS).is_ok());
}
