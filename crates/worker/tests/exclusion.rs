//! Who performs goals beside whom, and when a resource is free again: over real sockets, under leases that a manager would confirm.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use ratn_model::id::{FencingToken, LeaseId, Revision};
use ratn_model::resource::{Lease, LeasedResource, Quantity, ResourceClass};
use ratn_model::value::Value;
use ratn_proto::types::{Goal, GoalOutcome, Holding, Resource, ResourceUpdate};
use ratn_proto::v1;
use ratn_proto::v1::action_service_client::ActionServiceClient;
use ratn_worker::action::{Action, ActionResult, ActionServer, ActionServerBuilder, GoalContext};
use ratn_worker::client::{ActionClient, CallError, Channels};
use ratn_worker::endpoint::{Endpoint, connect};
use ratn_worker::lease_watch::LeaseWatch;
use ratn_worker::safety::{Safety, SafetyState};
use ratn_worker::server::{Services, bind};
use ratn_worker::tls::ClientTls;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;
use tokio::sync::Semaphore;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::{Code, Status};
use tonic_types::StatusExt;

const ARM: &str = "arm@here";
const CAMERA: &str = "camera@here";

/// Moves until the test lets it end; counts how often it began, and how many move at once.
#[derive(Clone)]
struct Motion {
    name: &'static str,
    resource: &'static str,
    begun: Arc<AtomicUsize>,
    moving: Arc<AtomicUsize>,
    most: Arc<AtomicUsize>,
    /// One permit lets one end. Told to stop it goes on.
    let_end: Arc<Semaphore>,
    /// It moves in a thread that nothing tears down.
    in_thread: bool,
}

impl Motion {
    fn of(name: &'static str, resource: &'static str) -> Motion {
        let let_end = Arc::new(Semaphore::new(0));
        let counts = [(); 3].map(|()| Arc::new(AtomicUsize::new(0)));
        let [begun, moving, most] = counts;
        Motion { name, resource, begun, moving, most, let_end, in_thread: false }
    }

    fn free(self) -> Motion {
        self.let_end.add_permits(1_000);
        self
    }

    fn begun(&self) -> usize {
        self.begun.load(Ordering::SeqCst)
    }

    fn most(&self) -> usize {
        self.most.load(Ordering::SeqCst)
    }
}

#[tonic::async_trait]
impl Action for Motion {
    fn name(&self) -> &str {
        self.name
    }

    fn resource(&self) -> Option<&str> {
        Some(self.resource)
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        self.begun.fetch_add(1, Ordering::SeqCst);
        let moving = self.moving.fetch_add(1, Ordering::SeqCst) + 1;
        self.most.fetch_max(moving, Ordering::SeqCst);
        goal.progress("moving");
        if self.in_thread {
            let (motion, runtime) = (self.clone(), tokio::runtime::Handle::current());
            let moves = move || {
                runtime.block_on(motion.let_end.acquire()).unwrap().forget();
                motion.moving.fetch_sub(1, Ordering::SeqCst);
            };
            tokio::task::spawn_blocking(moves).await?;
        } else {
            self.let_end.acquire().await.unwrap().forget();
            self.moving.fetch_sub(1, Ordering::SeqCst);
        }
        goal.checkpoint()?;
        Ok(GoalOutcome::success().with_output("by", Value::String(self.name.to_owned())))
    }
}

struct Cell {
    endpoint: Endpoint,
    client: ActionClient,
    server: ActionServer,
    watch: LeaseWatch,
    safety: Safety,
    shutdown: CancellationToken,
    _directory: tempfile::TempDir,
}

async fn cell(motions: &[&Motion], build: impl FnOnce(ActionServerBuilder) -> ActionServerBuilder) -> Cell {
    let (directory, safety) = (tempfile::tempdir().unwrap(), Safety::default());
    let watch = LeaseWatch::of([ARM, CAMERA]);
    let mut builder = build(ActionServer::builder("").leases(&watch).safety(safety.clone()));
    for motion in motions {
        builder = builder.action((*motion).clone());
    }
    let server = builder.build();
    let bound = bind(&Endpoint::Unix(directory.path().join("cell.sock"))).await.unwrap();
    let (endpoint, shutdown) = (bound.endpoint().clone(), CancellationToken::new());
    tokio::spawn(bound.serve(Services::new().with(server.clone().into_service()), shutdown.clone()));
    let client = ActionClient::new(Channels::new(&ClientTls::none()));
    Cell { endpoint, client, server, watch, safety, shutdown, _directory: directory }
}

impl Drop for Cell {
    fn drop(&mut self) {
        self.shutdown.cancel();
    }
}

fn lease(id: u64, resource: &str) -> Lease {
    let resource = LeasedResource {
        id: resource.to_owned(),
        kind: "Tester".to_owned(),
        endpoint: String::new(),
        superclasses: Vec::new(),
    };
    Lease { id: LeaseId(id), token: FencingToken(id), resources: vec![resource], consumed: Vec::new() }
}

fn goal(id: &str, action: &str, lease_id: u64, resource: &str) -> Goal {
    let session = format!("session-{lease_id}");
    let lease = Some(lease(lease_id, resource));
    Goal { id: id.to_owned(), action: action.to_owned(), lease, session, grace_ms: 60_000, ..Goal::default() }
}

impl Cell {
    /// All that is held.
    fn holds(&self, arm: &[u64], camera: &[u64]) {
        let holding = |&lease: &u64| Holding {
            lease: LeaseId(lease),
            token: FencingToken(lease),
            units: Quantity::ONE,
            session: format!("session-{lease}"),
            holder: String::new(),
            opened_by: String::new(),
        };
        let resource = |id: &str, leases: &[u64]| {
            let mut resource = Resource::new(id, ResourceClass::Module, "Tester");
            resource.holdings = leases.iter().map(holding).collect();
            resource
        };
        let resources = vec![resource(ARM, arm), resource(CAMERA, camera)];
        let youngest = LeaseId(arm.iter().chain(camera).copied().max().unwrap_or(0));
        self.watch.tell(&ResourceUpdate::Snapshot { revision: Revision(1), resources, youngest });
    }

    fn give(&self, goal: Goal) -> JoinHandle<Result<GoalOutcome, CallError>> {
        let (client, endpoint) = (self.client.clone(), self.endpoint.clone());
        tokio::spawn(async move { client.execute(&endpoint, goal, |_, _| {}).await })
    }

    /// What is answered to one question, without being patient.
    async fn ask(&self, goal: Goal) -> Result<v1::GoalResult, Status> {
        let mut client = ActionServiceClient::new(connect(&self.endpoint, &ClientTls::none()).await.unwrap());
        let question = v1::ExecuteRequest { goal: Some(goal.into()) };
        let mut told = client.execute(question).await?.into_inner();
        loop {
            if let Some(v1::execute_response::Kind::Result(result)) = told.message().await?.unwrap().kind {
                return Ok(result);
            }
        }
    }
}

async fn until(what: &str, is_so: impl Fn() -> bool) {
    let waited = async {
        while !is_so() {
            tokio::task::yield_now().await;
        }
    };
    assert!(tokio::time::timeout(Duration::from_secs(20), waited).await.is_ok(), "{what}");
}

fn reason(status: &Status) -> String {
    status.get_details_error_info().map_or_else(String::new, |info| info.reason)
}

#[tokio::test]
async fn who_holds_the_camera_cannot_take_the_id_of_the_arms_next_goal() {
    let (follow, capture) = (Motion::of("follow", ARM).free(), Motion::of("capture", CAMERA).free());
    let cell = cell(&[&follow, &capture], ActionServerBuilder::one_at_a_time).await;
    cell.holds(&[7], &[8]);
    let taken = cell.give(goal("run/5/1", "capture", 8, CAMERA)).await.unwrap().unwrap();
    assert_eq!(taken.outputs["by"], Value::String("capture".to_owned()));
    let moved = cell.give(goal("run/5/1", "follow", 7, ARM)).await.unwrap().unwrap();
    assert_eq!((&moved.outputs["by"], follow.begun()), (&Value::String("follow".to_owned()), 1));
    // Nor does one who held the arm before.
    cell.holds(&[9], &[]);
    assert!(cell.give(goal("run/5/1", "follow", 9, ARM)).await.unwrap().unwrap().is_success());
    assert_eq!(follow.begun(), 2);
    // Who comes back to a run finds its goal by the lease under which it was given, also when that is over.
    let back = cell.client.attach(&cell.endpoint, goal("run/5/1", "follow", 7, ARM), |_, _| {}).await.unwrap();
    assert!(back.outcome.is_success());
    let other = cell.client.attach(&cell.endpoint, goal("run/5/1", "follow", 10, ARM), |_, _| {}).await;
    assert_eq!(other.unwrap_err().code(), Some(Code::NotFound));
    assert_eq!(follow.begun(), 2);
}

#[tokio::test]
async fn a_goal_is_joined_only_by_the_same_goal_and_else_it_is_said_what_differs() {
    let (follow, reach) = (Motion::of("follow", ARM).free(), Motion::of("reach", ARM).free());
    let cell = cell(&[&follow, &reach], |builder| builder).await;
    cell.holds(&[7], &[]);
    let first = goal("a", "follow", 7, ARM);
    cell.give(first.clone()).await.unwrap().unwrap();
    assert!(cell.give(first.clone()).await.unwrap().unwrap().is_success());
    let inputs = [("x".to_owned(), Value::Int(1))].into();
    let others = [
        (Goal { inputs, ..first.clone() }, "it has other inputs"),
        (Goal { action: "reach".to_owned(), ..first.clone() }, "that one's action is `follow`, and this one's `reach`"),
    ];
    for (other, why) in others {
        let refused = cell.give(other.clone()).await.unwrap().unwrap_err();
        assert_eq!(refused.code(), Some(Code::AlreadyExists), "{refused}");
        assert!(refused.to_string().contains(why), "{refused}");
        // Also where it is only asked for.
        let asked = cell.client.attach(&cell.endpoint, other, |_, _| {}).await.unwrap_err();
        assert_eq!(asked.code(), Some(Code::AlreadyExists), "{asked}");
    }
    assert_eq!((follow.begun(), reach.begun()), (1, 0));
}

#[tokio::test]
async fn the_next_holder_does_not_move_before_the_last_ones_motion_has_ended() {
    let follow = Motion::of("follow", ARM);
    // Not one at a time: one holder may move it twice at once, two may not.
    let cell = cell(&[&follow], |builder| builder).await;
    cell.holds(&[7], &[]);
    let old = cell.give(goal("a", "follow", 7, ARM));
    until("it moves", || follow.begun() == 1).await;
    cell.holds(&[8], &[]);
    let new = cell.give(goal("b", "follow", 8, ARM));
    until("the next one waits", || cell.server.waiting() == 1).await;
    assert_eq!(follow.begun(), 1);
    follow.let_end.add_permits(2);
    assert_eq!(old.await.unwrap().unwrap().outcome, "aborted");
    assert!(new.await.unwrap().unwrap().is_success());
    assert_eq!((follow.begun(), follow.most()), (2, 1));
}

#[tokio::test]
async fn a_goal_that_waits_to_begin_is_told_to_stop_like_one_that_runs() {
    let follow = Motion::of("follow", ARM);
    let cell = cell(&[&follow], ActionServerBuilder::one_at_a_time).await;
    cell.holds(&[7], &[]);
    let old = cell.give(goal("a", "follow", 7, ARM));
    until("it moves", || follow.begun() == 1).await;
    cell.holds(&[8], &[]);
    // Cancelled: one that waits for the end of another, and one that waits for a word of its lease.
    for (id, lease) in [("b", 8), ("c", 9)] {
        let waits = cell.give(goal(id, "follow", lease, ARM));
        until("it waits", || cell.server.waiting() == 1).await;
        assert!(cell.client.cancel(&cell.endpoint, id).await.unwrap());
        assert_eq!(waits.await.unwrap().unwrap(), GoalOutcome::preempted("cancelled"));
        until("it does not wait any more", || cell.server.waiting() == 0).await;
    }
    // An emergency stop, though it is cleared before the other one has ended.
    let waits = cell.give(goal("d", "follow", 8, ARM));
    until("it waits", || cell.server.waiting() == 1).await;
    cell.safety.stop("a hand").await.unwrap();
    assert_eq!(waits.await.unwrap().unwrap().outcome, "stopped");
    cell.safety.clear().await.unwrap();
    assert_eq!(cell.safety.state(), SafetyState::Ready);
    // The end of its lease.
    let waits = cell.give(goal("e", "follow", 8, ARM));
    until("it waits", || cell.server.waiting() == 1).await;
    cell.holds(&[], &[9]);
    let refused = waits.await.unwrap().unwrap_err();
    assert!(refused.to_string().contains("is over"), "{refused}");
    // Its client leaves.
    cell.holds(&[10], &[]);
    let waits = cell.give(goal("f", "follow", 10, ARM));
    until("it waits", || cell.server.waiting() == 1).await;
    waits.abort();
    until("it does not wait any more", || cell.server.waiting() == 0).await;

    follow.let_end.add_permits(1_000);
    assert_eq!(old.await.unwrap().unwrap().outcome, "aborted");
    assert!(cell.give(goal("g", "follow", 10, ARM)).await.unwrap().unwrap().is_success());
    assert_eq!(follow.begun(), 2);
}

#[tokio::test]
async fn a_provider_that_ends_begins_nothing_and_has_ended_when_nothing_moves() {
    let follow = Motion::of("follow", ARM);
    let cell = cell(&[&follow], |builder| builder).await;
    cell.holds(&[7], &[]);
    let old = cell.give(goal("a", "follow", 7, ARM));
    until("it moves", || follow.begun() == 1).await;
    let waits = cell.give(goal("b", "follow", 8, ARM));
    until("it waits", || cell.server.waiting() == 1).await;
    let server = cell.server.clone();
    let ending = tokio::spawn(async move { server.shut_down().await });
    assert!(waits.await.unwrap().unwrap_err().is_crash());
    let refused = cell.ask(goal("c", "follow", 7, ARM)).await.unwrap_err();
    assert_eq!((refused.code(), reason(&refused).as_str()), (Code::Unavailable, "ENDING"), "{refused:?}");
    cell.holds(&[7, 8], &[]);
    assert!(!ending.is_finished());
    follow.let_end.add_permits(1);
    ending.await.unwrap();
    assert_eq!((follow.begun(), follow.moving.load(Ordering::SeqCst)), (1, 0));
    assert!(old.await.unwrap().is_err());
}

#[tokio::test]
async fn a_resource_is_busy_until_the_action_has_returned_however_long_that_takes() {
    let follow = Motion { in_thread: true, ..Motion::of("follow", ARM) };
    let cell = cell(&[&follow], ActionServerBuilder::one_at_a_time).await;
    cell.holds(&[7], &[]);
    let old = cell.give(goal("a", "follow", 7, ARM));
    until("it moves", || follow.begun() == 1).await;
    cell.holds(&[8], &[]);
    // Its holder hears of it after the grace; the place is not free.
    let told = old.await.unwrap().unwrap();
    assert!(told.reason.ends_with("it did not stop within 3 s"), "{told:?}");
    let refused = cell.ask(goal("b", "follow", 8, ARM)).await.unwrap_err();
    assert_eq!((refused.code(), reason(&refused).as_str()), (Code::ResourceExhausted, "STILL_RUNNING"), "{refused:?}");
    assert!(refused.message().contains("goal a of arm@here was told to stop"), "{refused:?}");
    assert_eq!((follow.begun(), cell.server.running()), (1, 1));
    follow.let_end.add_permits(2);
    until("it has returned", || cell.server.running() == 0).await;
    assert!(cell.give(goal("c", "follow", 8, ARM)).await.unwrap().unwrap().is_success());
    assert_eq!(follow.most(), 1);
}

#[tokio::test]
async fn while_the_watch_is_interrupted_nothing_begins_and_what_moves_goes_on() {
    let (follow, capture) = (Motion::of("follow", ARM), Motion::of("capture", CAMERA).free());
    let cell = cell(&[&follow, &capture], |builder| builder).await;
    cell.holds(&[7], &[8]);
    let moves = cell.give(goal("a", "follow", 7, ARM));
    until("it moves", || follow.begun() == 1).await;
    cell.watch.interrupted();
    let refused = cell.ask(goal("b", "capture", 8, CAMERA)).await.unwrap_err();
    assert_eq!((refused.code(), reason(&refused).as_str()), (Code::Unavailable, "MANAGER_UNHEARD"), "{refused:?}");
    let waits = cell.give(goal("c", "capture", 8, CAMERA));
    until("it waits", || cell.server.waiting() == 1).await;
    assert_eq!(capture.begun(), 0);
    // A short interruption fails nobody's run.
    cell.holds(&[7], &[8]);
    assert!(waits.await.unwrap().unwrap().is_success());
    follow.let_end.add_permits(1);
    assert!(moves.await.unwrap().unwrap().is_success());
}

#[tokio::test]
async fn two_rightful_holders_of_one_resource_do_not_stop_each_other() {
    let follow = Motion::of("follow", ARM);
    let cell = cell(&[&follow], |builder| builder).await;
    cell.holds(&[7, 8], &[]);
    let first = cell.give(goal("a", "follow", 7, ARM));
    until("it moves", || follow.begun() == 1).await;
    let second = cell.give(goal("b", "follow", 8, ARM));
    until("both move", || follow.begun() == 2).await;
    let third = cell.give(goal("c", "follow", 7, ARM));
    until("the one with the lower token moves again", || follow.begun() == 3).await;
    follow.let_end.add_permits(3);
    for ended in [first, second, third] {
        assert!(ended.await.unwrap().unwrap().is_success());
    }
    // What one of them began is known while the other begins.
    assert!(cell.give(goal("a", "follow", 7, ARM)).await.unwrap().unwrap().is_success());
    assert_eq!(follow.begun(), 3);
}

/// As many goals of one caller wait as may, then one more.
#[tokio::test]
async fn one_caller_has_so_many_goals_wait_and_whoever_holds_a_resource_is_served_all_the_same() {
    let follow = Motion::of("follow", ARM).free();
    let cell = cell(&[&follow], |builder| builder).await;
    cell.holds(&[7], &[]);
    let forged: Vec<_> = (0..128).map(|i| cell.give(goal(&format!("x{i}"), "follow", 1_000, ARM))).collect();
    until("all wait", || cell.server.waiting() == 128).await;
    let refused = cell.ask(goal("y", "follow", 1_001, ARM)).await.unwrap_err();
    assert_eq!((refused.code(), reason(&refused).as_str()), (Code::Unavailable, "TOO_MANY_WAITING"), "{refused:?}");
    assert!(refused.message().starts_with("128 goals of uid "), "{refused:?}");
    // Known to hold it: does not wait.
    assert!(cell.give(goal("a", "follow", 7, ARM)).await.unwrap().unwrap().is_success());
    // Not yet known: is patient.
    let patient = cell.give(goal("b", "follow", 2_000, ARM));
    for refused in forged {
        assert_eq!(refused.await.unwrap().unwrap_err().code(), Some(Code::FailedPrecondition));
    }
    until("it waits", || cell.server.waiting() == 1).await;
    cell.holds(&[2_000], &[]);
    assert!(patient.await.unwrap().unwrap().is_success());
}

#[tokio::test]
async fn one_resource_that_is_full_leaves_room_on_another() {
    let (follow, capture) = (Motion::of("follow", ARM), Motion::of("capture", CAMERA).free());
    let cell = cell(&[&follow, &capture], |builder| builder).await;
    cell.holds(&[7], &[8]);
    let running: Vec<_> = (0..64).map(|i| cell.give(goal(&format!("x{i}"), "follow", 7, ARM))).collect();
    until("all move", || follow.begun() == 64).await;
    let refused = cell.ask(goal("y", "follow", 7, ARM)).await.unwrap_err();
    assert_eq!(refused.code(), Code::ResourceExhausted);
    assert!(refused.message().contains("64 goals of arm@here are under way"), "{refused:?}");
    assert!(cell.give(goal("a", "capture", 8, CAMERA)).await.unwrap().unwrap().is_success());
    follow.let_end.add_permits(64);
    for ended in running {
        assert!(ended.await.unwrap().unwrap().is_success());
    }
}

#[tokio::test]
async fn an_action_whose_resource_is_not_watched_refuses_its_goals_and_says_why() {
    let lift = Motion::of("lift", "lift@here").free();
    let cell = cell(&[&lift], |builder| builder).await;
    cell.holds(&[7], &[]);
    let refused = cell.ask(goal("a", "lift", 7, "lift@here")).await.unwrap_err();
    assert_eq!((refused.code(), reason(&refused).as_str()), (Code::FailedPrecondition, "NOT_WATCHED"), "{refused:?}");
}

#[tokio::test]
async fn a_goal_says_that_a_hold_is_in_force_and_when_it_is_over() {
    let follow = Motion::of("follow", ARM);
    let cell = cell(&[&follow], ActionServerBuilder::one_at_a_time).await;
    cell.holds(&[7], &[]);
    let (told, heard) = std::sync::mpsc::channel();
    let (client, endpoint) = (cell.client.clone(), cell.endpoint.clone());
    let moving = tokio::spawn(async move {
        let tell = move |message: String, _: BTreeMap<String, Value>| told.send(message).unwrap();
        client.execute(&endpoint, goal("a", "follow", 7, ARM), tell).await
    });
    let all = std::cell::RefCell::new(Vec::new());
    let hear = async |message: &str| {
        until(message, || {
            all.borrow_mut().extend(heard.try_iter());
            all.borrow().last().is_some_and(|last| last == message)
        })
        .await;
    };
    hear("moving").await;
    cell.safety.hold("a look").await.unwrap();
    hear("a hold is in force: a look").await;
    cell.safety.go_on().await.unwrap();
    hear("goes on").await;
    follow.let_end.add_permits(1);
    assert!(moving.await.unwrap().unwrap().is_success());
    assert_eq!(*all.borrow(), ["moving", "a hold is in force: a look", "goes on"]);
}
