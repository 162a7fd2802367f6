//! A driver written with the SDK and a real resource manager: what a holder loses is granted anew when nothing moves for it any more.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use ratn_daemon::process_manager::{Readiness, Template};
use ratn_model::resource::{Lease, ResourceClass};
use ratn_model::value::Value;
use ratn_proto::types::{Goal, Resource, ResourceEventKind};
use ratn_worker::action::{Action, ActionResult, ActionServer, GoalContext};
use ratn_worker::client::{AcquireOptions, ActionClient, ResourceClient, fresh_id};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::lease_watch::LeaseWatch;
use ratn_worker::provider::Provider;
use ratn_worker::server::{Services, bind};
use ratn_worker::session::Session;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use support::{DEADLINE, Daemon, TestSystem, block, in_time};
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

const ARM: &str = "arm@here";
/// Far longer than anything here takes, where nothing else is said.
const BOUND: Duration = Duration::from_secs(50);

/// `move`: moves until it is told to stop, and then until it has room to stand still.
struct Move {
    told: Arc<Semaphore>,
    stands: Arc<Semaphore>,
    /// When each motion began and when it stood still.
    motions: Arc<Mutex<Vec<(Instant, Instant)>>>,
}

#[tonic::async_trait]
impl Action for Move {
    fn name(&self) -> &str {
        "move"
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let began = Instant::now();
        goal.progress("moving");
        goal.cancelled.cancelled().await;
        self.told.add_permits(1);
        self.stands.acquire().await.unwrap().forget();
        self.motions.lock().unwrap().push((began, Instant::now()));
        Err(goal.stopped())
    }
}

/// The driver, with the arm offered.
struct Driver {
    endpoint: Endpoint,
    /// A motion was told to stop.
    told: Arc<Semaphore>,
    stands: Arc<Semaphore>,
    motions: Arc<Mutex<Vec<(Instant, Instant)>>>,
    provider: Provider,
    session: Session,
    _watching: AbortOnDropHandle<()>,
    _place: tempfile::TempDir,
}

impl Driver {
    async fn start(system: &TestSystem, manager: &Daemon, bound: Duration) -> Driver {
        Driver::start_as(fresh_id("driver"), system, manager, bound).await
    }

    /// In the session of this id.
    async fn start_as(session: String, system: &TestSystem, manager: &Daemon, bound: Duration) -> Driver {
        let place = tempfile::tempdir().unwrap();
        let (told, stands, motions) = (Arc::new(Semaphore::new(0)), Arc::new(Semaphore::new(0)), Arc::default());
        let leases = LeaseWatch::of([ARM]);
        leases.brought_to_rest();
        let moving = Move { told: Arc::clone(&told), stands: Arc::clone(&stands), motions: Arc::clone(&motions) };
        let server = ActionServer::builder(ARM).action(moving).one_at_a_time().leases(&leases).build();
        let bound_at = bind(&Endpoint::Unix(place.path().join("driver.sock"))).await.unwrap();
        let endpoint = bound_at.endpoint().clone();
        tokio::spawn(bound_at.serve(Services::new().with(server.into_service()), CancellationToken::new()));
        let session = Session::open_as(&system.channels, &manager.endpoint, session, "driver", DEADLINE);
        let watch = leases.follow_session(&system.channels, &manager.endpoint, &session, DEADLINE).unwrap();
        let provider = Provider::start_at_rest(&system.channels, &manager.endpoint, &session, &leases).unwrap();
        in_time(session.alive(DEADLINE)).await.unwrap();
        let arm = Resource::new(ARM, ResourceClass::Module, "Arm").with_endpoint(&endpoint).with_standstill(bound);
        assert!(in_time(provider.offer(arm)).await.unwrap());
        let _watching = AbortOnDropHandle::new(tokio::spawn(watch));
        Driver { endpoint, told, stands, motions, provider, session, _watching, _place: place }
    }

    /// A motion under a lease, once it has begun.
    async fn moves(&self, system: &TestSystem, lease: &Lease) {
        in_time(self.begins(fresh_id("goal"), system, lease)).await.unwrap();
    }

    /// The same for a goal of this id; an error where it ends without having begun.
    async fn begins(&self, id: String, system: &TestSystem, lease: &Lease) -> Result<(), String> {
        let (begun, began) = tokio::sync::oneshot::channel();
        let mut begun = Some(begun);
        let (client, endpoint) = (ActionClient::new(system.channels.clone()), self.endpoint.clone());
        let goal = Goal { id, action: "move".to_owned(), lease: Some(lease.clone()), ..Goal::default() };
        let ended = tokio::spawn(async move {
            client
                .execute(&endpoint, goal, |_, _| {
                    if let Some(begun) = begun.take() {
                        let _ = begun.send(());
                    }
                })
                .await
        });
        match began.await {
            Ok(()) => Ok(()),
            Err(_) => Err(ended.await.unwrap().unwrap_err().to_string()),
        }
    }

    fn last(&self) -> Option<Instant> {
        self.motions.lock().unwrap().last().map(|(_, stood)| *stood)
    }
}

async fn acquire(client: &ResourceClient) -> (Lease, Instant) {
    let options = AcquireOptions { deadline: DEADLINE, ..AcquireOptions::default() };
    (client.acquire(vec![block("Arm")], options).await.unwrap(), Instant::now())
}

/// Waits until the manager shows that the arm is ending, or is not there.
async fn is_lost(client: &ResourceClient) {
    in_time(async {
        while client.list(&["Arm"]).await.unwrap().iter().any(|arm| !arm.holdings.is_empty()) {
            tokio::task::yield_now().await;
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_a_holder_loses_is_granted_when_its_motion_stands_still_and_not_before() {
    for how in ["its session ends", "somebody ends its lease", "somebody deletes the resource"] {
        let system = TestSystem::new();
        let manager = system.resource_manager().await;
        let driver = Driver::start(&system, &manager, BOUND).await;
        let (holder, next) = (system.client(&manager, "holder").await, system.client(&manager, "next").await);
        let (held, _) = in_time(acquire(&holder.resources)).await;
        driver.moves(&system, &held).await;
        let granted = {
            let client = next.resources.clone();
            tokio::spawn(async move { acquire(&client).await })
        };
        let operator = ResourceClient::new(&system.channels, &manager.endpoint, "").unwrap();
        match how {
            "its session ends" => holder.session.close().await,
            "somebody ends its lease" => assert!(operator.release(held.id).await.unwrap()),
            _ => operator.delete(ARM).await.unwrap(),
        }
        is_lost(&operator).await;
        // Nobody has it while it moves.
        tokio::time::sleep(Duration::from_millis(300)).await;
        assert!(!granted.is_finished() && driver.last().is_none(), "{how}");
        driver.stands.add_permits(1);
        let (_, at) = in_time(granted).await.unwrap();
        assert!(driver.last().is_some_and(|stood| stood <= at), "{how}");
        manager.end().await;
    }
}

/// What an arm must hold besides: no goal runs at it, so that nobody but its bound says when nothing moves there.
fn way(bound: Duration) -> Resource {
    Resource::new("way@here", ResourceClass::System, "Way").with_standstill(bound)
}

async fn acquire_both(client: &ResourceClient) -> Lease {
    let options = AcquireOptions { deadline: DEADLINE, ..AcquireOptions::default() };
    in_time(client.acquire(vec![block("Arm"), block("Way")], options)).await.unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn an_arm_whose_lease_loses_something_else_is_told_to_stop_and_granted_when_it_stands_still() {
    for its_session_ends in [false, true] {
        let system = TestSystem::new();
        let manager = system.resource_manager().await;
        let driver = Driver::start(&system, &manager, BOUND).await;
        let furniture = system.client(&manager, "furniture").await;
        furniture.resources.create(way(BOUND)).await.unwrap();
        let (holder, next) = (system.client(&manager, "holder").await, system.client(&manager, "next").await);
        let held = acquire_both(&holder.resources).await;
        driver.moves(&system, &held).await;
        let operator = ResourceClient::new(&system.channels, &manager.endpoint, "").unwrap();
        match its_session_ends {
            true => furniture.session.close().await,
            false => operator.delete("way@here").await.unwrap(),
        }
        in_time(driver.told.acquire()).await.unwrap().forget();
        let granted = {
            let client = next.resources.clone();
            tokio::spawn(async move { acquire(&client).await })
        };
        tokio::time::sleep(Duration::from_millis(300)).await;
        assert!(!granted.is_finished() && driver.last().is_none());
        driver.stands.add_permits(1);
        let (_, at) = in_time(granted).await.unwrap();
        assert!(driver.last().is_some_and(|stood| stood <= at));
        assert!(!holder.resources.release(held.id).await.unwrap(), "the lease is over");
        manager.end().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_a_lease_loses_beside_its_arm_is_offered_again_when_its_bound_has_passed() {
    const SHORT: Duration = Duration::from_millis(1_500);
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let driver = Driver::start(&system, &manager, BOUND).await;
    assert!(in_time(driver.provider.offer(way(SHORT))).await.unwrap());
    let (holder, next) = (system.client(&manager, "holder").await, system.client(&manager, "next").await);
    let held = acquire_both(&holder.resources).await;
    driver.moves(&system, &held).await;
    let operator = ResourceClient::new(&system.channels, &manager.endpoint, "").unwrap();
    let deleted = Instant::now();
    operator.delete("way@here").await.unwrap();
    let options = AcquireOptions { deadline: DEADLINE, ..AcquireOptions::default() };
    in_time(next.resources.acquire(vec![block("Way")], options)).await.unwrap();
    let after = deleted.elapsed();
    assert!(after >= SHORT, "granted {} ms after it was lost", after.as_millis());
    manager.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_driver_of_a_fixed_session_id_begins_no_goal_of_the_process_before_it_again() {
    let (system, id) = (TestSystem::new(), || "run/i1/1".to_owned());
    let manager = system.resource_manager().await;
    let (holder, next) = (system.client(&manager, "holder").await, system.client(&manager, "next").await);
    let first = Driver::start_as("driver".to_owned(), &system, &manager, BOUND).await;
    let (held, _) = in_time(acquire(&holder.resources)).await;
    in_time(first.begins(id(), &system, &held)).await.unwrap();
    // As if it were killed: the manager is told nothing.
    let Driver { session, provider, _watching, .. } = first;
    drop((provider, _watching));
    session.abandon().await;
    let second = Driver::start_as("driver".to_owned(), &system, &manager, BOUND).await;
    let refused = in_time(second.begins(id(), &system, &held)).await.unwrap_err();
    assert!(refused.contains("acquire it anew"), "{refused}");
    assert!(holder.resources.release(held.id).await.unwrap());
    let (granted, _) = in_time(acquire(&next.resources)).await;
    in_time(second.begins(fresh_id("goal"), &system, &granted)).await.unwrap();
    second.stands.add_permits(1);
    manager.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_nothing_moves_for_is_granted_at_once_and_what_its_holder_gives_back_too() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let driver = Driver::start(&system, &manager, BOUND).await;
    let (holder, next) = (system.client(&manager, "holder").await, system.client(&manager, "next").await);
    let (held, _) = in_time(acquire(&holder.resources)).await;
    let operator = ResourceClient::new(&system.channels, &manager.endpoint, "").unwrap();
    assert!(operator.release(held.id).await.unwrap());
    let (again, _) = in_time(acquire(&next.resources)).await;
    // Its own motion may still be stopping: that is the holder's concern, and the next goal waits for it.
    driver.moves(&system, &again).await;
    assert!(next.resources.release(again.id).await.unwrap());
    in_time(acquire(&holder.resources)).await;
    assert_eq!(driver.last(), None);
    manager.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_motion_that_does_not_stop_is_never_confirmed_and_the_bound_decides() {
    const SHORT: Duration = Duration::from_millis(700);
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let driver = Driver::start(&system, &manager, SHORT).await;
    let (holder, next) = (system.client(&manager, "holder").await, system.client(&manager, "next").await);
    let (held, _) = in_time(acquire(&holder.resources)).await;
    driver.moves(&system, &held).await;
    let revoked = Instant::now();
    holder.session.close().await;
    let (lease, at) = in_time(acquire(&next.resources)).await;
    assert!(at - revoked >= SHORT && driver.last().is_none());
    // And still nothing begins beside it.
    let waits = tokio::time::timeout(Duration::from_millis(300), driver.begins(fresh_id("goal"), &system, &lease));
    assert!(waits.await.is_err());
    driver.stands.add_permits(1);
    manager.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_confirmation_is_repeated_until_the_manager_answers() {
    let system = TestSystem::new();
    let place = tempfile::tempdir().unwrap();
    let at = Endpoint::Unix(place.path().join("rm.sock"));
    let state = tempfile::tempdir().unwrap();
    let config = || ratn_daemon::resource_manager::ResourceManagerConfig {
        listen: at.clone(),
        storage: ratn_daemon::config::StorageConfig { directory: Some(state.path().to_owned()), ..Default::default() },
        ..Default::default()
    };
    let manager = system.resource_manager_with(config()).await;
    let driver = Driver::start(&system, &manager, BOUND).await;
    let (holder, next) = (system.client(&manager, "holder").await, system.client(&manager, "next").await);
    let (held, _) = in_time(acquire(&holder.resources)).await;
    driver.moves(&system, &held).await;
    holder.session.close().await;
    // While it has not heard that, its motion goes on as long as its own session lives.
    in_time(driver.told.acquire()).await.unwrap().forget();
    manager.end().await;
    // It stands still while there is nobody to tell.
    driver.stands.add_permits(1);
    in_time(async {
        while driver.last().is_none() {
            tokio::task::yield_now().await;
        }
    })
    .await;
    let manager = system.resource_manager_with(config()).await;
    let granted = in_time(async {
        loop {
            let options = AcquireOptions { deadline: DEADLINE, ..AcquireOptions::default() };
            if let Ok(lease) = next.resources.acquire(vec![block("Arm")], options).await {
                return lease;
            }
        }
    });
    assert!(granted.await.token > held.token);
    assert_eq!(driver.session.state().borrow().generation, 1, "the same session");
    drop(driver.provider);
    manager.end().await;
}

/// A driver in a pool, which is not started again when it has crashed.
fn pooled(standstill_ms: Option<u64>) -> Template {
    Template {
        program: Some("/bin/sh".into()),
        args: ["-c", "echo ready; exec sleep 1000"].map(str::to_owned).to_vec(),
        readiness: Readiness::Line { contains: "ready".to_owned() },
        start_timeout_s: 15.0,
        crash_limit: 1,
        standstill_ms,
        ..Template::new("arm", "PooledArm")
    }
}

/// How long after the end of the last process manager the next one offers the driver, whose process crashed before that end.
async fn offered_anew_after(next: Template) -> Duration {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let mut watch = system.watch(&manager, &["PooledArm"]).await;
    let first = system.process_manager(vec![pooled(Some(4_000))]).await;
    let Some(Value::Int(pid)) = watch.created("PooledArm").await.attributes.remove("pid") else { panic!("no pid") };
    kill(Pid::from_raw(i32::try_from(pid).unwrap()), Signal::SIGKILL).unwrap();
    watch.event(|event| event.kind == ResourceEventKind::Deleted).await;
    first.end().await;
    let ended = Instant::now();
    let _second = system.process_manager(vec![next]).await;
    watch.created("PooledArm").await;
    ended.elapsed()
}

#[tokio::test(flavor = "multi_thread")]
async fn what_a_worker_that_crashed_moved_is_offered_by_the_next_process_manager_when_the_bound_of_then_has_passed() {
    let another = Template { name: "another".to_owned(), ..pooled(Some(100)) };
    let (same, lower, none, renamed) = tokio::join!(
        offered_anew_after(pooled(Some(4_000))),
        offered_anew_after(pooled(Some(100))),
        offered_anew_after(pooled(None)),
        offered_anew_after(another),
    );
    let after = [same, lower, none, renamed];
    assert!(after.iter().all(|after| *after >= Duration::from_secs(4)), "{after:?}");
}
