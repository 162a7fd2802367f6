//! A goal that gives goals to other providers is over when these are: its lease goes back then, and what they move is somebody else's.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::lease;
use ratn_proto::types::{Goal, GoalOutcome};
use ratn_worker::action::{Action, ActionResult, ActionServer, GoalContext};
use ratn_worker::client::{ActionClient, Channels, Fate};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::server::{Services, bind};
use ratn_worker::tls::ClientTls;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::{Notify, Semaphore, watch};
use tokio::task::JoinHandle;
use tokio_util::sync::{CancellationToken, DropGuard};

const ARM: &str = "arm@here";
const PICKER: &str = "picker@here";

/// What the arm does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Arm {
    Rests,
    Moves,
    Brakes,
}

/// `follow`: moves until it is told to stop; then it brakes until it may stand.
struct Follow {
    does: watch::Sender<Arm>,
    may_stand: Arc<Semaphore>,
}

#[tonic::async_trait]
impl Action for Follow {
    fn name(&self) -> &str {
        "follow"
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        self.does.send_replace(Arm::Moves);
        goal.cancelled.cancelled().await;
        self.does.send_replace(Arm::Brakes);
        self.may_stand.acquire().await.unwrap().forget();
        self.does.send_replace(Arm::Rests);
        Err(goal.stopped())
    }
}

/// `pick` has the arm follow; `leave` begins that, drops the call and returns when it is told to.
struct Pick {
    name: &'static str,
    leaves: Arc<Notify>,
}

#[tonic::async_trait]
impl Action for Pick {
    fn name(&self) -> &str {
        self.name
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let called = goal.call("Arm", "follow", BTreeMap::new());
        if self.name == "pick" {
            called.await?;
        } else {
            tokio::select! {
                _ = called => {}
                () = self.leaves.notified() => {}
            }
        }
        Ok(GoalOutcome::success())
    }
}

/// An arm, and a picker that has it move.
struct Bench {
    client: ActionClient,
    picker: Endpoint,
    arm: Endpoint,
    does: watch::Receiver<Arm>,
    may_stand: Arc<Semaphore>,
    leaves: Arc<Notify>,
    _shutdown: DropGuard,
    place: tempfile::TempDir,
}

/// Connections that were accepted, and the moments at which all of them are cut.
struct Line {
    accepted: watch::Receiver<usize>,
    cut: Arc<Notify>,
}

impl Line {
    /// Passes on what comes at `from`.
    fn new(from: &Path, to: PathBuf) -> Line {
        let (listener, cut) = (UnixListener::bind(from).unwrap(), Arc::new(Notify::new()));
        let (count, accepted) = watch::channel(0);
        let cuts = Arc::clone(&cut);
        tokio::spawn(async move {
            while let Ok((mut near, _)) = listener.accept().await {
                let (mut far, cut) = (UnixStream::connect(&to).await.unwrap(), Arc::clone(&cuts));
                tokio::spawn(async move {
                    tokio::select! {
                        _ = tokio::io::copy_bidirectional(&mut near, &mut far) => {}
                        () = cut.notified() => {}
                    }
                });
                count.send_modify(|count| *count += 1);
            }
        });
        Line { accepted, cut }
    }
}

impl Bench {
    async fn new() -> Bench {
        let (place, shutdown) = (tempfile::tempdir().unwrap(), CancellationToken::new());
        let (does, doing) = watch::channel(Arm::Rests);
        let (may_stand, leaves) = (Arc::new(Semaphore::new(0)), Arc::new(Notify::new()));
        let follow = Follow { does, may_stand: Arc::clone(&may_stand) };
        let pick = |name| Pick { name, leaves: Arc::clone(&leaves) };
        let arm = ActionServer::builder(ARM).action(follow);
        let picker = ActionServer::builder(PICKER).action(pick("pick")).action(pick("leave"));
        let mut endpoints = Vec::new();
        for (name, server) in [("arm", arm), ("picker", picker)] {
            let server = server.one_at_a_time().dangerously_believe_every_lease().build();
            let bound = bind(&Endpoint::Unix(place.path().join(name))).await.unwrap();
            endpoints.push(bound.endpoint().clone());
            tokio::spawn(bound.serve(Services::new().with(server.into_service()), shutdown.clone()));
        }
        let (picker, arm) = (endpoints.pop().unwrap(), endpoints.pop().unwrap());
        Bench {
            client: ActionClient::new(Channels::new(&ClientTls::none())),
            picker,
            arm,
            does: doing,
            may_stand,
            leaves,
            _shutdown: shutdown.drop_guard(),
            place,
        }
    }

    /// Gives a goal to the picker.
    fn give(&self, action: &str) -> JoinHandle<Fate> {
        let (client, picker) = (self.client.clone(), self.picker.clone());
        let resources = [(PICKER, "Picker", ""), (ARM, "Arm", &*self.arm.to_string())];
        let lease = Some(lease(7, &resources));
        let goal = Goal { id: action.to_owned(), action: action.to_owned(), lease, ..Goal::default() };
        tokio::spawn(async move { client.execute_hearing(&picker, goal, || true, |_| {}).await.unwrap() })
    }

    /// The same; returns when the arm moves.
    async fn begin(&mut self, action: &str) -> JoinHandle<Fate> {
        let ended = self.give(action);
        self.until(Arm::Moves).await;
        ended
    }

    async fn until(&mut self, arm: Arm) {
        let waiting = self.does.wait_for(|does| *does == arm);
        tokio::time::timeout(Duration::from_secs(20), waiting).await.unwrap().unwrap();
    }

    /// The arm brakes; the goal is over when it stands.
    async fn is_over_when_the_arm_stands(&mut self, ended: JoinHandle<Fate>) -> Fate {
        self.until(Arm::Brakes).await;
        tokio::time::sleep(Duration::from_millis(100)).await;
        assert!(!ended.is_finished(), "it is over, and the arm still moves");
        self.may_stand.add_permits(1);
        let fate = ended.await.unwrap();
        assert_eq!(*self.does.borrow(), Arm::Rests);
        fate
    }
}

#[tokio::test]
async fn a_goal_that_is_cancelled_is_over_when_the_motion_that_it_called_has_stopped() {
    let mut bench = Bench::new().await;
    let ended = bench.begin("pick").await;
    assert!(bench.client.cancel(&bench.picker, "pick").await.unwrap());
    let fate = bench.is_over_when_the_arm_stands(ended).await;
    assert_eq!((fate.outcome.outcome.as_str(), fate.may_move), ("aborted", false));
}

#[tokio::test]
async fn a_goal_that_drops_a_call_and_returns_is_over_when_the_motion_has_stopped() {
    let mut bench = Bench::new().await;
    let ended = bench.begin("leave").await;
    bench.leaves.notify_one();
    let fate = bench.is_over_when_the_arm_stands(ended).await;
    assert_eq!((fate.outcome.outcome.as_str(), fate.may_move), ("success", false));
}

#[tokio::test]
async fn a_goal_whose_call_was_lost_says_that_something_may_still_move() {
    let mut bench = Bench::new().await;
    bench.arm = Endpoint::Unix("/nowhere/arm.sock".into());
    let fate = bench.give("pick").await.unwrap();
    assert_eq!((fate.outcome.outcome.as_str(), fate.may_move), ("aborted", true));
}

#[tokio::test]
async fn a_motion_whose_connection_breaks_goes_on_and_its_end_is_heard() {
    let mut bench = Bench::new().await;
    let near = bench.place.path().join("line");
    let mut line = Line::new(&near, bench.place.path().join("arm"));
    bench.arm = Endpoint::Unix(near);
    let ended = bench.begin("pick").await;
    let before = *line.accepted.borrow();
    line.cut.notify_waiters();
    line.accepted.wait_for(|accepted| *accepted > before).await.unwrap();
    tokio::time::sleep(Duration::from_millis(50)).await;
    assert_eq!(*bench.does.borrow(), Arm::Moves);
    assert!(bench.client.cancel(&bench.picker, "pick").await.unwrap());
    let fate = bench.is_over_when_the_arm_stands(ended).await;
    assert_eq!((fate.outcome.outcome.as_str(), fate.may_move), ("aborted", false));
}
