//! Sessions and providers against a resource manager reduced to what they need of it: sessions that die with their time
//! to live, and resources that die with their session.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use futures::stream::{BoxStream, StreamExt};
use ratn_model::id::{FencingToken, LeaseId};
use ratn_model::resource::ResourceClass;
use ratn_model::value::Value;
use ratn_proto::types::Resource;
use ratn_proto::v1::resource_service_server::{ResourceService, ResourceServiceServer};
use ratn_proto::v1::*;
use ratn_worker::action::ActionServer;
use ratn_worker::boot_clock::BootClock;
use ratn_worker::client::Channels;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::lease_watch::{Claim, ClaimStatus, LeaseWatch, ManagerLocation};
use ratn_worker::protocol::{HEADER, NEWEST, OLDEST};
use ratn_worker::provider::Provider;
use ratn_worker::safety::{Brakes, Safety, SafetyState};
use ratn_worker::server::{Services, bind};
use ratn_worker::session::Session;
use ratn_worker::tls::ClientTls;
use ratn_worker::worker::{Worker, WorkerOptions};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tokio::sync::{Semaphore, watch};
use tokio_util::sync::CancellationToken;
use tonic::{Code, Request, Response, Status, Streaming};
use tonic_types::{ErrorDetails, StatusExt};

const LONG: Duration = Duration::from_secs(20);
const TTL: Duration = Duration::from_millis(200);

#[derive(Default)]
struct Pool {
    /// Which of all sessions each is.
    sessions: BTreeMap<String, u64>,
    /// Sessions that were made.
    made: u64,
    /// So many creations are never answered, and change nothing.
    unanswered: usize,
    /// Creations are done, their answers are held back, and then lost.
    loses_answers: bool,
    /// Pings that arrived.
    pings: usize,
    /// So many pings break their stream.
    broken: usize,
    /// So many answers that say that a session was made are lost with their stream.
    lost_answers: usize,
    resources: BTreeMap<String, ratn_proto::v1::Resource>,
    /// Ids of resources that another session has.
    taken: BTreeSet<String>,
    /// Ids of sessions that another caller has.
    anothers: BTreeSet<String>,
    /// So many creations end with their session before they are answered.
    short_lived: usize,
    /// Resources are watched, from now on or once more is known.
    shows: Option<bool>,
    /// Watches that have begun.
    watches: usize,
    /// Questions for one resource are refused so often: the manager is busy.
    busy: usize,
    /// The youngest lease.
    youngest: u64,
    /// So many confirmations of standstill are never answered.
    swallowed: usize,
    /// Confirmations of standstill that arrived.
    confirmations: usize,
    /// What streams of pings said of their protocol, in order.
    protocols: Vec<Option<String>>,
}

#[derive(Clone)]
struct Manager {
    pool: Arc<Mutex<Pool>>,
    changed: watch::Sender<()>,
}

#[tonic::async_trait]
impl ResourceService for Manager {
    async fn create(&self, request: Request<CreateRequest>) -> Result<Response<CreateResponse>, Status> {
        let request = request.into_inner();
        let is_unanswered = {
            let mut pool = self.pool.lock().unwrap();
            let is_unanswered = pool.unanswered > 0;
            pool.unanswered -= usize::from(is_unanswered);
            is_unanswered
        };
        if is_unanswered {
            return std::future::pending().await;
        }
        let (resource, is_lost) = {
            let mut pool = self.pool.lock().unwrap();
            if !pool.sessions.contains_key(&request.session_id) {
                return Err(Status::failed_precondition("no such session"));
            }
            let resource = request.resource.unwrap();
            if resource.kind == "Forbidden" {
                return Err(Status::permission_denied("not here"));
            }
            if pool.taken.contains(&resource.id) {
                return Err(Status::already_exists("another session has it"));
            }
            if let Some(left) = pool.short_lived.checked_sub(1) {
                pool.short_lived = left;
                return Err(Status::not_found("created by this request and gone since"));
            }
            let resource = ratn_proto::v1::Resource { session_id: request.session_id, ..resource };
            pool.resources.insert(resource.id.clone(), resource.clone());
            (resource, pool.loses_answers)
        };
        self.changed.send_replace(());
        if is_lost {
            self.until(|pool| !pool.loses_answers).await;
            return Err(Status::unavailable("the connection broke"));
        }
        Ok(Response::new(CreateResponse { resource: Some(resource) }))
    }

    async fn delete(&self, request: Request<DeleteRequest>) -> Result<Response<DeleteResponse>, Status> {
        let Some(delete_request::Target::ResourceId(id)) = request.into_inner().target else { unreachable!() };
        self.pool.lock().unwrap().resources.remove(&id).ok_or_else(|| Status::not_found(id.clone()))?;
        self.changed.send_replace(());
        Ok(Response::new(DeleteResponse { resource_ids: vec![id], revision: 1 }))
    }

    type KeepAliveStream = BoxStream<'static, Result<KeepAliveResponse, Status>>;

    async fn keep_alive(
        &self,
        request: Request<Streaming<KeepAliveRequest>>,
    ) -> Result<Response<Self::KeepAliveStream>, Status> {
        let manager = self.clone();
        let protocol = request.metadata().get(HEADER).map(|said| said.to_str().unwrap().to_owned());
        manager.pool.lock().unwrap().protocols.push(protocol);
        let answers = request.into_inner().map(move |ping| {
            let ping = ping?;
            let mut pool = manager.pool.lock().unwrap();
            if pool.anothers.contains(&ping.session_id) {
                let details = ErrorDetails::with_error_info("NOT_YOURS", "ratn", []);
                return Err(Status::with_error_details(Code::PermissionDenied, "another's", details));
            }
            let created = ping.ttl_ms > 0 && !pool.sessions.contains_key(&ping.session_id);
            if ping.ttl_ms == 0 {
                pool.sessions.remove(&ping.session_id);
            } else if created {
                pool.made += 1;
                let number = pool.made;
                pool.sessions.insert(ping.session_id.clone(), number);
            }
            let number = pool.sessions.get(&ping.session_id).copied().unwrap_or(0);
            pool.pings += 1;
            let is_lost = created && pool.lost_answers > 0;
            pool.lost_answers -= usize::from(is_lost);
            let breaks = pool.broken > 0;
            pool.broken -= usize::from(breaks);
            drop(pool);
            manager.changed.send_replace(());
            if is_lost || breaks {
                return Err(Status::unavailable("the connection broke"));
            }
            Ok(KeepAliveResponse { session_id: ping.session_id, ttl_ms: ping.ttl_ms, created, revision: 1, number })
        });
        Ok(Response::new(answers.boxed()))
    }

    async fn consume(&self, _: Request<ConsumeRequest>) -> Result<Response<ConsumeResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn block(&self, _: Request<BlockRequest>) -> Result<Response<BlockResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn release(
        &self,
        _: Request<ResourceServiceReleaseRequest>,
    ) -> Result<Response<ResourceServiceReleaseResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn withdraw(&self, _: Request<WithdrawRequest>) -> Result<Response<WithdrawResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn exists(&self, _: Request<ExistsRequest>) -> Result<Response<ExistsResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn acquire(&self, _: Request<AcquireRequest>) -> Result<Response<AcquireResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn list(&self, _: Request<ListRequest>) -> Result<Response<ListResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    type SessionStream = BoxStream<'static, Result<ratn_proto::v1::SessionResponse, Status>>;

    async fn session(
        &self,
        _: Request<Streaming<ratn_proto::v1::SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn get(
        &self,
        request: Request<ratn_proto::v1::ResourceServiceGetRequest>,
    ) -> Result<Response<ratn_proto::v1::ResourceServiceGetResponse>, Status> {
        let mut pool = self.pool.lock().unwrap();
        if let Some(left) = pool.busy.checked_sub(1) {
            pool.busy = left;
            return Err(Status::resource_exhausted("busy"));
        }
        let found = pool.resources.get(&request.into_inner().resource_id).cloned();
        let resource = Some(found.ok_or_else(|| Status::not_found("no such resource"))?);
        Ok(Response::new(ratn_proto::v1::ResourceServiceGetResponse { resource }))
    }

    async fn explain(
        &self,
        _: Request<ratn_proto::v1::ExplainRequest>,
    ) -> Result<Response<ratn_proto::v1::ExplainResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn list_sessions(
        &self,
        _: Request<ratn_proto::v1::ListSessionsRequest>,
    ) -> Result<Response<ratn_proto::v1::ListSessionsResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    type WatchDemandStream = BoxStream<'static, Result<ratn_proto::v1::WatchDemandResponse, Status>>;

    async fn watch_demand(
        &self,
        _: Request<ratn_proto::v1::WatchDemandRequest>,
    ) -> Result<Response<Self::WatchDemandStream>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn confirm_standstill(
        &self,
        _: Request<ratn_proto::v1::ConfirmStandstillRequest>,
    ) -> Result<Response<ratn_proto::v1::ConfirmStandstillResponse>, Status> {
        let is_swallowed = {
            let mut pool = self.pool.lock().unwrap();
            pool.confirmations += 1;
            pool.confirmations <= pool.swallowed
        };
        self.changed.send_replace(());
        if is_swallowed {
            std::future::pending::<()>().await;
        }
        Ok(Response::new(ratn_proto::v1::ConfirmStandstillResponse::default()))
    }

    async fn report_shortage(
        &self,
        _: Request<ratn_proto::v1::ReportShortageRequest>,
    ) -> Result<Response<ratn_proto::v1::ReportShortageResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    async fn end_task(
        &self,
        _: Request<ratn_proto::v1::EndTaskRequest>,
    ) -> Result<Response<ratn_proto::v1::EndTaskResponse>, Status> {
        Err(Status::unimplemented("not under test"))
    }

    type WatchStream = BoxStream<'static, Result<ResourceServiceWatchResponse, Status>>;

    async fn watch(&self, _: Request<ResourceServiceWatchRequest>) -> Result<Response<Self::WatchStream>, Status> {
        let manager = self.clone();
        {
            let mut pool = manager.pool.lock().unwrap();
            if pool.shows.is_none() {
                return Err(Status::unimplemented("not under test"));
            }
            pool.watches += 1;
        }
        manager.changed.send_replace(());
        let snapshot = async move {
            manager.until(|pool| pool.shows == Some(true)).await;
            let pool = manager.pool.lock().unwrap();
            let (resources, youngest_lease_id) = (pool.resources.values().cloned().collect(), pool.youngest);
            let snapshot =
                ResourceSnapshot { revision: 1, resources, youngest_lease_id, ..ResourceSnapshot::default() };
            Ok(ResourceServiceWatchResponse { kind: Some(resource_service_watch_response::Kind::Snapshot(snapshot)) })
        };
        Ok(Response::new(futures::stream::once(snapshot).chain(futures::stream::pending()).boxed()))
    }
}

impl Manager {
    fn new() -> Manager {
        Manager { pool: Arc::default(), changed: watch::channel(()).0 }
    }

    async fn serve(&self, endpoint: &Endpoint) -> (CancellationToken, tokio::task::JoinHandle<()>) {
        let bound = bind(endpoint).await.unwrap();
        let stop = CancellationToken::new();
        let serving = bound.serve(Services::new().with(ResourceServiceServer::new(self.clone())), stop.clone());
        (stop, tokio::spawn(async move { serving.await.unwrap() }))
    }

    /// Waits until the pool is as `wanted` says.
    async fn until(&self, wanted: impl Fn(&Pool) -> bool) {
        let mut changes = self.changed.subscribe();
        let seen = changes.wait_for(|()| wanted(&self.pool.lock().unwrap()));
        tokio::time::timeout(LONG, seen).await.expect("the pool never became so").unwrap();
    }

    fn forget_everything(&self) {
        let mut pool = self.pool.lock().unwrap();
        *pool = Pool { made: pool.made, ..Pool::default() };
    }
}

fn arm() -> Resource {
    Resource::new("arm@sim", ResourceClass::Module, "Arm").with_endpoint("unix:/cell.sock")
}

#[tokio::test]
async fn a_session_lives_until_it_is_closed() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    let session = Session::open(&Channels::new(&ClientTls::none()), &endpoint, "test", TTL);
    session.alive(LONG).await.unwrap();
    let id = session.id().to_owned();
    manager.until(|pool| pool.sessions.contains_key(&id)).await;
    session.close().await;
    manager.until(|pool| pool.sessions.is_empty()).await;
    let spoken = Some(format!("{OLDEST}-{NEWEST} {}", env!("CARGO_PKG_VERSION")));
    assert_eq!(manager.pool.lock().unwrap().protocols, [spoken.clone(), spoken], "the farewell says it, too");
}

#[tokio::test]
async fn a_session_without_its_manager_is_not_alive() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let session = Session::open(&Channels::new(&ClientTls::none()), &endpoint, "test", TTL);
    let error = session.alive(Duration::from_millis(1)).await.unwrap_err().to_string();
    assert!(error.contains("rm.sock") && error.contains("is it running?"), "{error}");
}

#[tokio::test]
async fn a_session_whose_id_is_another_callers_says_so_and_is_itself_again_when_it_is_not() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    let session = Session::open_as(&Channels::new(&ClientTls::none()), &endpoint, "mine".to_owned(), "test", TTL);
    session.alive(LONG).await.unwrap();
    assert!(!session.state().borrow().taken);
    {
        // It has ended, and another opened the next one of its id.
        let mut pool = manager.pool.lock().unwrap();
        pool.sessions.remove("mine");
        pool.anothers.insert("mine".to_owned());
    }
    tokio::time::timeout(LONG, session.taken()).await.expect("nobody says so");
    tokio::time::timeout(LONG, session.lost()).await.expect("it is believed in");
    let refused = session.alive(TTL).await.unwrap_err().to_string();
    assert!(refused.contains("the id `mine` is another caller's"), "{refused}");
    manager.pool.lock().unwrap().anothers.clear();
    session.alive(LONG).await.unwrap();
    let state = *session.state().borrow();
    assert_eq!((state.taken, state.generation), (false, 2));
}

/// A worker that stands alone and moves something: its session's id is another caller's from one moment on.
#[tokio::test]
async fn a_worker_whose_session_id_is_taken_goes_on_with_another_one_and_offers_nothing_before_it_is_at_rest() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let manager = Manager::new();
    manager.pool.lock().unwrap().shows = Some(true);
    let _serving = manager.serve(&endpoint).await;
    let stands = Arc::new(Semaphore::new(0));
    let options = WorkerOptions {
        id: "arm@sim".to_owned(),
        kind: "Arm".to_owned(),
        listen: Endpoint::Unix(directory.path().join("arm.sock")),
        resource_manager: Some(endpoint),
        ..WorkerOptions::default()
    };
    let shutdown = CancellationToken::new();
    let worker = Worker::new(options).safety(Safety::new(SlowBrakes(Arc::clone(&stands)))).shutdown(shutdown.clone());
    let running = tokio::spawn(worker.run());
    let take = |pool: &mut Pool| {
        let ids: Vec<String> = std::mem::take(&mut pool.sessions).into_keys().collect();
        pool.resources.clear();
        pool.anothers.extend(ids);
    };
    manager.until(|pool| pool.watches > 1).await;
    take(&mut manager.pool.lock().unwrap());
    // A session of another id, and still nobody has said that nothing moves.
    manager.until(|pool| pool.sessions.len() == 1 && pool.watches > 3).await;
    tokio::time::sleep(3 * TTL).await;
    assert!(manager.pool.lock().unwrap().resources.is_empty());
    stands.add_permits(1);
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    take(&mut manager.pool.lock().unwrap());
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    {
        let pool = manager.pool.lock().unwrap();
        assert!(pool.sessions.contains_key(&pool.resources["arm@sim"].session_id));
        assert_eq!(pool.anothers.len(), 2, "each time another id");
    }
    shutdown.cancel();
    running.await.unwrap().unwrap();
}

#[tokio::test]
async fn a_lost_session_says_so_and_comes_back_with_its_resources() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let manager = Manager::new();
    let (stop, serving) = manager.serve(&endpoint).await;
    let channels = Channels::new(&ClientTls::none());
    let session = Session::open(&channels, &endpoint, "cell", TTL);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    assert!(provider.offer(arm()).await.unwrap());
    let lost = session.lost();

    stop.cancel();
    serving.await.unwrap();
    // A manager without a memory comes back at the same place.
    manager.forget_everything();
    tokio::time::timeout(LONG, lost).await.expect("nobody said that the session was lost");
    let _serving = manager.serve(&endpoint).await;
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    assert_eq!(session.state().borrow().generation, 2);
}

#[tokio::test]
async fn a_session_that_was_made_anew_is_known_by_its_number_when_the_answer_that_said_so_was_lost() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    let session = Session::open(&Channels::new(&ClientTls::none()), &endpoint, "cell", LONG / 10);
    session.alive(LONG).await.unwrap();
    let first = *session.state().borrow();
    // A connection that breaks changes nothing.
    manager.pool.lock().unwrap().broken = 1;
    manager.until(|pool| pool.broken == 0 && pool.protocols.len() == 2).await;
    let pinged = manager.pool.lock().unwrap().pings;
    manager.until(|pool| pool.pings > pinged + 1).await;
    assert_eq!(*session.state().borrow(), first);

    manager.forget_everything();
    manager.pool.lock().unwrap().lost_answers = 1;
    let mut state = session.state();
    let anew = tokio::time::timeout(LONG, state.wait_for(|state| state.generation == 2)).await;
    assert!(anew.expect("nobody noticed that the session was made anew").unwrap().alive);
    let pool = manager.pool.lock().unwrap();
    assert_eq!((pool.made, pool.lost_answers), (2, 0));
}

#[tokio::test]
async fn a_creation_that_is_not_answered_is_asked_for_again() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let manager = Manager::new();
    manager.pool.lock().unwrap().unanswered = 1;
    let _serving = manager.serve(&endpoint).await;
    let channels = Channels::new(&ClientTls::none());
    let session = Session::open(&channels, &endpoint, "cell", LONG);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    let offered = tokio::time::timeout(LONG, provider.offer(arm())).await.expect("the creation is waited for for ever");
    assert!(!offered.unwrap(), "not yet");
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    assert!(provider.withdraw("arm@sim").await.unwrap(), "and nobody is held up");
}

/// A manager at which session `cell` provides the arm, of which another one holds lease 7.
fn with_lease() -> Manager {
    let manager = Manager::new();
    let holding = Holding { lease_id: 7, token: 70, units: 1.0, session_id: "run".to_owned(), ..Holding::default() };
    let mut arm = ratn_proto::v1::Resource::from(arm());
    (arm.session_id, arm.holdings) = ("cell".to_owned(), vec![holding]);
    {
        let mut pool = manager.pool.lock().unwrap();
        (pool.shows, pool.youngest) = (Some(true), 7);
        pool.resources.insert("arm@sim".to_owned(), arm);
    }
    manager
}

/// Waits until the watch has heard of the lease.
async fn heard(leases: &LeaseWatch) {
    let heard = async {
        while !leases.is_heard() {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(LONG, heard).await.unwrap();
}

const CLAIM: Claim<'_> = Claim { resource: "arm@sim", lease: LeaseId(7), token: FencingToken(70), session: "run" };

#[tokio::test]
async fn a_driver_of_a_fixed_session_id_begins_nothing_before_it_has_said_that_it_is_at_rest() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    // What the process before this one has left: its session still lives, with the arm, which is held.
    let manager = with_lease();
    manager.pool.lock().unwrap().sessions.insert("cell".to_owned(), 1);
    let _serving = manager.serve(&endpoint).await;
    let channels = Channels::new(&ClientTls::none());
    let session = Session::open_as(&channels, &endpoint, "cell".to_owned(), "cell", LONG);
    let leases = LeaseWatch::of(["arm@sim"]);
    tokio::spawn(leases.follow_session(&channels, &endpoint, &session, LONG).unwrap());
    heard(&leases).await;
    assert_eq!(leases.check(&CLAIM), ClaimStatus::NotAtRest);
    leases.brought_to_rest();
    assert_eq!(leases.check(&CLAIM), ClaimStatus::Confirmed);
}

#[tokio::test]
async fn a_session_is_over_when_the_machine_wakes_up_after_its_time_to_live_and_goes_on_where_the_manager_knows_it() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let manager = Manager::new();
    let (stop, serving) = manager.serve(&endpoint).await;
    let clock = BootClock::suspendable();
    let hour = Duration::from_secs(3_600);
    let session =
        Session::open_by(clock.clone(), &Channels::new(&ClientTls::none()), &endpoint, "cell".to_owned(), "cell", hour);
    session.alive(LONG).await.unwrap();
    stop.cancel();
    serving.await.unwrap();
    assert!(session.state().borrow().alive, "the manager may come back");
    let nearly_lost = session.nearly_lost(Duration::ZERO);
    clock.suspend(hour);
    tokio::time::timeout(LONG, session.lost()).await.expect("it is believed in for another hour");
    tokio::time::timeout(LONG, nearly_lost).await.expect("it is believed in for another hour");
    let _serving = manager.serve(&endpoint).await;
    session.alive(LONG).await.unwrap();
    assert_eq!(session.state().borrow().generation, 1);
}

#[tokio::test]
async fn a_lease_is_not_confirmed_when_the_machine_wakes_up_until_the_manager_is_heard_again() {
    let hour = Duration::from_secs(3_600);
    for by_session in [true, false] {
        let directory = tempfile::tempdir().unwrap();
        let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
        let manager = with_lease();
        let (stop, serving) = manager.serve(&endpoint).await;
        let (channels, clock) = (Channels::new(&ClientTls::none()), BootClock::suspendable());
        let leases = LeaseWatch::by(clock.clone(), ["arm@sim"]);
        leases.brought_to_rest();
        let session = Session::open_by(clock.clone(), &channels, &endpoint, "cell".to_owned(), "cell", hour);
        let following = if by_session {
            tokio::spawn(leases.follow_session(&channels, &endpoint, &session, hour).unwrap())
        } else {
            tokio::spawn(leases.follow_location(&channels, ManagerLocation::At(endpoint.clone()), "cell", hour))
        };
        heard(&leases).await;
        assert_eq!(leases.check(&CLAIM), ClaimStatus::Confirmed);
        stop.cancel();
        serving.await.unwrap();
        assert_eq!(leases.check(&CLAIM), ClaimStatus::Confirmed, "the manager may come back");
        // Nothing else has run when the next goal is looked at.
        clock.suspend(hour);
        assert!(matches!(leases.check(&CLAIM), ClaimStatus::Unheard(_)), "{by_session}");
        let unheard = async {
            while leases.is_heard() {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        };
        tokio::time::timeout(LONG, unheard).await.expect("what is under way goes on for another hour");
        let _serving = manager.serve(&endpoint).await;
        let again = async {
            while leases.check(&CLAIM) != ClaimStatus::Confirmed {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        };
        tokio::time::timeout(LONG, again).await.expect("the lease lives, and the manager says so");
        following.abort();
    }
}

#[tokio::test]
async fn resources_are_offered_updated_and_withdrawn() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let manager = Manager::new();
    let channels = Channels::new(&ClientTls::none());
    let session = Session::open(&channels, &endpoint, "cell", TTL);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    // Before there is a manager: later, by itself.
    assert!(!provider.offer(arm()).await.unwrap());
    let _serving = manager.serve(&endpoint).await;
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    session.alive(LONG).await.unwrap();

    assert!(provider.offer(arm().with_attribute("level", Value::Float(0.5))).await.unwrap());
    assert!(manager.pool.lock().unwrap().resources["arm@sim"].attributes.contains_key("level"));
    let refused = provider.offer(Resource::new("x", ResourceClass::Module, "Forbidden")).await.unwrap_err();
    assert_eq!(refused.to_string(), "not here");
    assert_eq!(provider.offered().await.len(), 1);
    provider.withdraw("arm@sim").await.unwrap();
    provider.withdraw("arm@sim").await.unwrap();
    assert!(manager.pool.lock().unwrap().resources.is_empty());
}

#[tokio::test]
async fn what_was_withdrawn_while_nobody_answered_is_gone_once_somebody_does() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let manager = Manager::new();
    let (stop, serving) = manager.serve(&endpoint).await;
    let channels = Channels::new(&ClientTls::none());
    let session = Session::open(&channels, &endpoint, "cell", TTL);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    assert!(provider.offer(arm()).await.unwrap());

    stop.cancel();
    serving.await.unwrap();
    let _ = provider.withdraw("arm@sim").await;
    // It was away for a moment and has forgotten nothing.
    let _serving = manager.serve(&endpoint).await;
    manager.until(|pool| pool.resources.is_empty()).await;
}

#[tokio::test]
async fn a_resource_that_another_session_still_has_is_offered_until_that_one_is_over() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let manager = Manager::new();
    manager.pool.lock().unwrap().taken.insert("arm@sim".to_owned());
    let _serving = manager.serve(&endpoint).await;
    let channels = Channels::new(&ClientTls::none());
    let session = Session::open(&channels, &endpoint, "cell", TTL);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    assert!(!provider.offer(arm()).await.unwrap());
    manager.pool.lock().unwrap().taken.clear();
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
}

#[tokio::test]
async fn a_resource_that_went_with_its_session_before_its_creation_was_answered_is_offered_again() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let manager = Manager::new();
    manager.pool.lock().unwrap().short_lived = 2;
    let _serving = manager.serve(&endpoint).await;
    let channels = Channels::new(&ClientTls::none());
    let session = Session::open(&channels, &endpoint, "cell", TTL);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    assert!(!provider.offer(arm()).await.unwrap());
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
}

#[tokio::test]
async fn what_a_new_watch_does_not_show_is_offered_again_although_nobody_said_that_the_session_was_made_anew() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let manager = Manager::new();
    // The watch has begun before the arm is offered, and shows nothing yet.
    manager.pool.lock().unwrap().shows = Some(false);
    let _serving = manager.serve(&endpoint).await;
    let channels = Channels::new(&ClientTls::none());
    let session = Session::open(&channels, &endpoint, "cell", LONG);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    assert!(provider.offer(Resource::new("spare@sim", ResourceClass::Module, "Arm")).await.unwrap());
    manager.until(|pool| pool.watches == 1).await;
    assert!(provider.withdraw("spare@sim").await.unwrap());
    assert!(provider.offer(arm()).await.unwrap());
    // The session ended and was made anew by a ping whose answer was lost. The first question for the arm is not answered either.
    {
        let mut pool = manager.pool.lock().unwrap();
        pool.resources.clear();
        (pool.shows, pool.busy) = (Some(true), 1);
    }
    manager.changed.send_replace(());
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    assert_eq!(session.state().borrow().generation, 1);
}

/// A process manager's drivers: it does not follow the leases of what it offers.
#[tokio::test]
async fn what_may_still_move_for_who_held_it_under_a_lapsed_session_is_offered_again_when_its_bound_has_passed() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    let channels = Channels::new(&ClientTls::none());
    let session = Session::open(&channels, &endpoint, "pools", TTL);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    let bound = Duration::from_millis(1_500);
    let began = Instant::now();
    let planner = Resource::new("planner@sim", ResourceClass::Process, "Planner");
    for new in [arm().with_standstill(bound), planner.clone()] {
        assert!(provider.offer(new).await.unwrap());
    }
    assert!(began.elapsed() < bound, "what is new has moved for nobody");
    let began = Instant::now();
    {
        let mut pool = manager.pool.lock().unwrap();
        pool.sessions.clear();
        pool.resources.clear();
    }
    manager.until(|pool| pool.resources.contains_key("planner@sim")).await;
    // Not by an update either.
    let updated = arm().with_standstill(bound).with_attribute("level", Value::Float(0.5));
    assert!(!provider.offer(updated).await.unwrap() || began.elapsed() >= bound);
    assert!(!manager.pool.lock().unwrap().resources.contains_key("arm@sim") || began.elapsed() >= bound);
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    assert!(began.elapsed() >= bound, "after {:?}", began.elapsed());
    // What a process before this one has offered.
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    let other = Resource::new("other@sim", ResourceClass::Module, "Arm").with_standstill(bound);
    let began = Instant::now();
    provider.may_move(&[other.clone(), planner]).await;
    assert!(!provider.offer(other).await.unwrap() || began.elapsed() >= bound);
    manager.until(|pool| pool.resources.contains_key("other@sim")).await;
    assert!(began.elapsed() >= bound, "after {:?}", began.elapsed());
}

#[tokio::test]
async fn what_was_offered_with_an_answer_that_was_lost_is_offered_again_when_its_bound_has_passed() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    let channels = Channels::new(&ClientTls::none());
    let session = Session::open(&channels, &endpoint, "pools", TTL);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    let bound = Duration::from_millis(1_500);
    manager.pool.lock().unwrap().loses_answers = true;
    let lost = async {
        manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
        // Somebody may hold it by now. The session ends and is made anew before the answer is known to be lost.
        {
            let mut pool = manager.pool.lock().unwrap();
            pool.sessions.clear();
            pool.resources.clear();
        }
        session.state().wait_for(|state| state.generation == 2).await.unwrap();
        manager.pool.lock().unwrap().loses_answers = false;
        manager.changed.send_replace(());
        Instant::now()
    };
    let (offered, began) = tokio::join!(provider.offer(arm().with_standstill(bound)), lost);
    assert!(!offered.unwrap());
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    assert!(began.elapsed() >= bound, "after {:?}", began.elapsed());
}

#[tokio::test]
async fn a_bound_for_standstill_stays_where_the_resource_is_withdrawn_and_wanted_again() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let manager = Manager::new();
    let _serving = manager.serve(&endpoint).await;
    let channels = Channels::new(&ClientTls::none());
    let session = Session::open(&channels, &endpoint, "pools", LONG);
    let provider = Provider::start(&channels, &endpoint, &session).unwrap();
    session.alive(LONG).await.unwrap();
    let bound = Duration::from_millis(700);
    let moving = arm().with_standstill(bound);
    let began = Instant::now();
    provider.may_move(std::slice::from_ref(&moving)).await;
    assert!(provider.withdraw("arm@sim").await.unwrap());
    assert!(!provider.offer(moving.clone()).await.unwrap() || began.elapsed() >= bound);
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    assert!(began.elapsed() >= bound, "after {:?}", began.elapsed());
    // Whoever held it when it was withdrawn has lost it as well.
    let began = Instant::now();
    assert!(provider.withdraw("arm@sim").await.unwrap());
    assert!(!provider.offer(moving).await.unwrap() || began.elapsed() >= bound);
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    assert!(began.elapsed() >= bound, "after {:?}", began.elapsed());
}

#[tokio::test]
async fn standstill_is_confirmed_when_the_driver_has_said_that_it_is_at_rest_and_again_where_no_answer_comes() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let manager = Manager::new();
    {
        // What the process before this one has left: its session still lives, and a lease of the arm has ended.
        let mut pool = manager.pool.lock().unwrap();
        (pool.shows, pool.swallowed) = (Some(true), 1);
        pool.sessions.insert("cell".to_owned(), 1);
        let ending = EndingUnits { lease_id: 7, token: 70, units: 1.0, ..EndingUnits::default() };
        let mut arm = ratn_proto::v1::Resource::from(arm());
        (arm.session_id, arm.ending) = ("cell".to_owned(), vec![ending]);
        pool.resources.insert("arm@sim".to_owned(), arm);
    }
    let _serving = manager.serve(&endpoint).await;
    let channels = Channels::new(&ClientTls::none());
    let session = Session::open_as(&channels, &endpoint, "cell".to_owned(), "cell", LONG);
    let leases = LeaseWatch::of(["arm@sim"]);
    let _server = ActionServer::builder("arm@sim").leases(&leases).build();
    let provider = Provider::start_at_rest(&channels, &endpoint, &session, &leases).unwrap();
    tokio::spawn(leases.follow_session(&channels, &endpoint, &session, LONG).unwrap());
    session.alive(LONG).await.unwrap();
    manager.until(|pool| pool.watches > 0).await;
    let heard = async {
        while !leases.is_heard() {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(LONG, heard).await.unwrap();
    // Nothing runs here, but nobody knows what the hardware does.
    assert!(!leases.is_at_rest("arm@sim") && !provider.offer(arm()).await.unwrap());
    tokio::time::sleep(3 * TTL).await;
    assert_eq!(manager.pool.lock().unwrap().confirmations, 0);
    leases.brought_to_rest();
    // Far less than the watch was told to be patient.
    let again = manager.until(|pool| pool.confirmations == 2);
    tokio::time::timeout(LONG / 2, again).await.expect("no second confirmation");
    manager.until(|pool| pool.resources["arm@sim"].ending.is_empty()).await;
}

/// Stands still when there is room to.
struct SlowBrakes(Arc<Semaphore>);

#[tonic::async_trait]
impl Brakes for SlowBrakes {
    async fn apply(&self, state: &SafetyState) -> Result<(), String> {
        if *state != SafetyState::Ready {
            self.0.acquire().await.unwrap().forget();
        }
        Ok(())
    }
}

#[tokio::test]
async fn a_worker_that_moves_something_is_offered_when_its_brakes_have_brought_it_to_rest() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("rm.sock"));
    let manager = Manager::new();
    manager.pool.lock().unwrap().shows = Some(true);
    let _serving = manager.serve(&endpoint).await;
    let stands = Arc::new(Semaphore::new(0));
    let options = WorkerOptions {
        id: "arm@sim".to_owned(),
        kind: "Arm".to_owned(),
        listen: Endpoint::Unix(directory.path().join("arm.sock")),
        resource_manager: Some(endpoint),
        ..WorkerOptions::default()
    };
    let shutdown = CancellationToken::new();
    let worker = Worker::new(options).safety(Safety::new(SlowBrakes(Arc::clone(&stands)))).shutdown(shutdown.clone());
    let running = tokio::spawn(worker.run());
    manager.until(|pool| pool.watches > 1).await;
    tokio::time::sleep(3 * TTL).await;
    assert!(manager.pool.lock().unwrap().resources.is_empty());
    stands.add_permits(1);
    manager.until(|pool| pool.resources.contains_key("arm@sim")).await;
    shutdown.cancel();
    running.await.unwrap().unwrap();
}
