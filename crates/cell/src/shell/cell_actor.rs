//! The owner of the cell's core: a thread that handles messages in order and wakes when the core asks for it.
//!
//! A thread, not a task: checking a trajectory takes milliseconds, and a motion has to stop on time whatever the runtime does.

use super::attention::{Attention, Seen};
use super::recorder::Recorder;
use crate::config::Goods;
use crate::core::cell::Cell;
use crate::core::contacts::Contact;
use crate::core::faults::{Fault, MAX_FAULTS};
use crate::core::picture::{Exposure, develop};
use crate::core::protocol::{Command, Ending, Event, Module, Request, Ticket};
use crate::core::recording::Line;
use crate::core::snapshot::Snapshot;
use ratn_model::pose::Pose;
use ratn_model::time::Timestamp;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::Robot;
use ratn_panic_point::panic_point;
use ratn_perception::camera::{Camera, DepthImage};
use ratn_perception::noise::Noise;
use ratn_worker::boot_clock::BootInstant;
use ratn_worker::robot_clock::RobotClock;
use ratn_worker::safety::{Brakes, SafetyState};
use ratn_worker::vitals::Vitals;
use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::Duration;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot};

use crate::core::objects::TrueObject;

/// Maximum number of messages in the queue, not counting one stop message per goal.
const MAX_MESSAGES: usize = 256;
/// Maximum time between two looks at the clock.
const MAX_SLEEP: Duration = Duration::from_secs(1);
/// The same while something moves: steps that are left to compute delay the end of a motion.
const RESTLESS_SLEEP: Duration = Duration::from_millis(5);

/// The true state of the cell.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct State {
    pub(crate) objects: Vec<TrueObject>,
    pub(crate) battery: f64,
    pub(crate) arm: JointVector,
    pub(crate) base: Pose,
    pub(crate) now: Timestamp,
    pub(crate) seed: u64,
    /// The unintended contacts.
    pub(crate) contacts: Vec<Contact>,
}

/// Sends messages to the cell's thread. Clones share it; the thread ends when the last clone is dropped.
#[derive(Debug, Clone)]
pub(crate) struct CellHandle {
    messages: Sender<QueuedMessage>,
    room: Arc<Semaphore>,
    tickets: Arc<AtomicU64>,
    optics: Arc<Optics>,
}

/// A goal that is being performed. Dropping it stops the goal: nothing moves without a client that waits for it.
#[derive(Debug)]
pub(crate) struct Motion {
    ticket: Ticket,
    ending: oneshot::Receiver<Ending>,
    messages: Sender<QueuedMessage>,
    suspended: bool,
    over: bool,
}

#[derive(Debug)]
struct Optics {
    robot: Robot,
    noise: Noise,
}

/// The reasons for the robot to stand still.
#[derive(Debug, Default)]
struct Holds {
    safety: SafetyState,
    suspended: BTreeSet<Ticket>,
    /// The cell's process did not run for too long.
    rests: bool,
}

/// Why a message was not accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum CellActorError {
    #[error("the cell is overloaded: {MAX_MESSAGES} messages wait; try again later")]
    Overloaded,
    #[error("the cell has ended")]
    Ended,
}

/// A message with its permit, which is its place in the queue.
struct QueuedMessage {
    message: Message,
    _room: Option<OwnedSemaphorePermit>,
}

enum Message {
    Start { ticket: Ticket, arm: usize, request: Request, ended: oneshot::Sender<Ending> },
    Happened(Event),
    Safety { state: SafetyState, applied: oneshot::Sender<()> },
    Suspend { ticket: Ticket, suspended: bool },
    Reset { seed: u64, goods: Goods, state: oneshot::Sender<State> },
    State(oneshot::Sender<State>),
    Fault { fault: Fault, taken: oneshot::Sender<bool> },
    Save(oneshot::Sender<Box<Snapshot>>),
}

/// Starts the cell's thread.
pub(crate) fn start(cell: Cell, recorder: Recorder, clock: RobotClock, vitals: Vitals) -> io::Result<CellHandle> {
    let (handle, inbox) = handle_of(&cell);
    let keep = move || {
        let _ = vitals.guard_blocking("the cell's core", || keep(cell, recorder, clock, &inbox, &vitals));
    };
    std::thread::Builder::new().name("cell".to_owned()).spawn(keep)?;
    Ok(handle)
}

fn handle_of(cell: &Cell) -> (CellHandle, Receiver<QueuedMessage>) {
    let (messages, inbox) = channel();
    let optics = Arc::new(Optics { robot: cell.robot().clone(), noise: cell.config().camera.noise });
    let room = Arc::new(Semaphore::new(MAX_MESSAGES));
    (CellHandle { messages, room, tickets: Arc::default(), optics }, inbox)
}

impl CellHandle {
    /// The modules of the robot.
    pub(crate) fn modules(&self) -> Vec<Module> {
        Module::of(&self.optics.robot)
    }

    /// The robot, seen from its first arm.
    pub(crate) fn robot(&self) -> &Robot {
        &self.optics.robot
    }

    /// Starts a goal for the first arm, or one that is for no arm.
    #[cfg(test)]
    pub(crate) fn perform(&self, request: Request) -> Result<Motion, CellActorError> {
        self.perform_with(crate::core::arms::FIRST, request)
    }

    /// Starts a goal; `arm` is the arm's number, if it is for an arm or its gripper.
    pub(crate) fn perform_with(&self, arm: usize, request: Request) -> Result<Motion, CellActorError> {
        let ticket = Ticket(self.tickets.fetch_add(1, Ordering::Relaxed) + 1);
        let (ended, ending) = oneshot::channel();
        self.ask(Message::Start { ticket, arm, request, ended })?;
        Ok(Motion { ticket, ending, messages: self.messages.clone(), suspended: false, over: false })
    }

    /// Sends an event to the core, as soon as the queue has room.
    pub(crate) async fn tell(&self, event: Event) -> Result<(), CellActorError> {
        let room = Arc::clone(&self.room).acquire_owned().await.map_err(|_| CellActorError::Ended)?;
        self.send(Message::Happened(event), room)
    }

    /// Lays a new scene; returns its true state.
    pub(crate) async fn reset(&self, seed: u64, goods: Goods) -> Result<State, CellActorError> {
        let (state, answer) = oneshot::channel();
        self.ask(Message::Reset { seed, goods, state })?;
        answer.await.map_err(|_| CellActorError::Ended)
    }

    /// A snapshot of the current state.
    pub(crate) async fn save(&self) -> Result<Box<Snapshot>, CellActorError> {
        let (snapshot, answer) = oneshot::channel();
        self.ask(Message::Save(snapshot))?;
        answer.await.map_err(|_| CellActorError::Ended)
    }

    /// Injects a fault; returns false if too many are scheduled already.
    pub(crate) async fn inject(&self, fault: Fault) -> Result<bool, CellActorError> {
        let (taken, answer) = oneshot::channel();
        self.ask(Message::Fault { fault, taken })?;
        answer.await.map_err(|_| CellActorError::Ended)
    }

    /// The true state now.
    pub(crate) async fn state(&self) -> Result<State, CellActorError> {
        let (state, answer) = oneshot::channel();
        self.ask(Message::State(state))?;
        answer.await.map_err(|_| CellActorError::Ended)
    }

    /// Renders the image of the scenes in front of the camera. Blocks for milliseconds per exposure.
    pub(crate) fn develop(&self, camera: &Camera, seed: u64, exposures: &[Exposure]) -> DepthImage {
        develop(&self.optics.robot, camera, &self.optics.noise, seed, exposures)
    }

    /// Sends a message that is refused if the queue is full.
    fn ask(&self, message: Message) -> Result<(), CellActorError> {
        let room = Arc::clone(&self.room).try_acquire_owned().map_err(|_| CellActorError::Overloaded)?;
        self.send(message, room)
    }

    fn send(&self, message: Message, room: OwnedSemaphorePermit) -> Result<(), CellActorError> {
        self.messages.send(QueuedMessage { message, _room: Some(room) }).map_err(|_| CellActorError::Ended)
    }
}

#[tonic::async_trait]
impl Brakes for CellHandle {
    /// Never refused because the queue is full.
    async fn apply(&self, state: &SafetyState) -> Result<(), String> {
        let (applied, done) = oneshot::channel();
        let message = Message::Safety { state: state.clone(), applied };
        self.messages.send(QueuedMessage { message, _room: None }).map_err(|_| CellActorError::Ended.to_string())?;
        done.await.map_err(|_| CellActorError::Ended.to_string())
    }
}

impl Motion {
    /// Waits for the end of the goal.
    pub(crate) async fn ended(&mut self) -> Result<Ending, CellActorError> {
        let ending = (&mut self.ending).await.map_err(|_| CellActorError::Ended);
        self.over = true;
        self.suspend(false);
        ending
    }

    /// Holds the robot until this is taken back or the goal has ended. One suspended goal holds all modules, because its reason is that the
    /// resource manager is not heard.
    pub(crate) fn suspend(&mut self, suspended: bool) {
        if std::mem::replace(&mut self.suspended, suspended) != suspended {
            let message = Message::Suspend { ticket: self.ticket, suspended };
            // If the cell's thread has ended, nothing moves.
            let _ = self.messages.send(QueuedMessage { message, _room: None });
        }
    }

    /// Stops the goal and waits for its end. Never refused: there is at most one such message per goal.
    pub(crate) async fn stop(mut self) -> Result<Ending, CellActorError> {
        self.tell_to_stop();
        self.ended().await
    }

    fn tell_to_stop(&mut self) {
        self.over = true;
        let stop = Event::Stop { ticket: self.ticket, reason: "the goal was told to stop".to_owned() };
        // If the cell's thread has ended, nothing moves.
        let _ = self.messages.send(QueuedMessage { message: Message::Happened(stop), _room: None });
        self.suspend(false);
    }
}

impl Drop for Motion {
    fn drop(&mut self) {
        if !self.over {
            self.tell_to_stop();
        }
    }
}

impl Holds {
    fn suspend(&mut self, ticket: Ticket, suspended: bool) {
        if suspended {
            self.suspended.insert(ticket);
        } else {
            self.suspended.remove(&ticket);
        }
    }

    /// The state that has to be in force.
    fn state(&self) -> SafetyState {
        match &self.safety {
            SafetyState::Ready if !self.suspended.is_empty() => {
                SafetyState::Held { reason: "the resource manager is not heard".to_owned() }
            }
            SafetyState::Ready if self.rests => SafetyState::Held { reason: "the cell was not running".to_owned() },
            state => state.clone(),
        }
    }
}

fn keep(cell: Cell, recorder: Recorder, clock: RobotClock, inbox: &Receiver<QueuedMessage>, vitals: &Vitals) {
    let mut keeper = Keeper::begin(cell, recorder, clock.wall(), clock.now());
    loop {
        vitals.beat();
        panic_point("cell-core");
        let sleep = keeper.sleep(&clock);
        let message = match inbox.recv_timeout(sleep) {
            Ok(queued) => Some(queued.message),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => return,
        };
        keeper.turn(clock.wall(), clock.now(), sleep, message);
    }
}

/// The core, with the clients that wait for its replies.
struct Keeper {
    cell: Cell,
    recorder: Recorder,
    waiting: BTreeMap<Ticket, oneshot::Sender<Ending>>,
    holds: Holds,
    /// Callers that wait until the robot stands.
    applying: Vec<oneshot::Sender<()>>,
    attention: Attention,
}

impl Keeper {
    /// Begins at this moment, in wall time and in the robot's time.
    fn begin(cell: Cell, recorder: Recorder, at: BootInstant, now: Timestamp) -> Keeper {
        let attention = Attention::begins(at, now);
        let (waiting, holds, applying) = Default::default();
        Keeper { cell, recorder, waiting, holds, applying, attention }
    }

    /// How long the thread may sleep, in wall time.
    fn sleep(&self, clock: &RobotClock) -> Duration {
        let is_restless = self.cell.is_restless() || self.attention.rests();
        let most = if is_restless { RESTLESS_SLEEP } else { MAX_SLEEP };
        self.cell.next_wake().map_or(most, |moment| clock.until(moment).min(most))
    }

    /// Handles a message, or a tick without one, at this moment of wall time and of the robot's time; `slept` is how long the thread meant to sleep.
    fn turn(&mut self, at: BootInstant, now: Timestamp, slept: Duration, message: Option<Message>) {
        match self.attention.looks(at, now, slept) {
            Seen::Nothing => {}
            Seen::Missed(since) => {
                tracing::warn!(
                    missed_s = now.since(since).as_secs(),
                    "the cell was not running: what moved has stood still since, until it is known who holds it"
                );
                self.holds.rests = true;
                self.give(since, Event::Safety { state: self.holds.state() });
            }
            Seen::Rested => {
                self.holds.rests = false;
                self.give(now, Event::Safety { state: self.holds.state() });
            }
        }
        let (mut safety, mut saving, mut asked) = (None, None, None);
        let event = match message {
            None => Event::Tick,
            Some(Message::Safety { state, applied }) => {
                safety = Some(applied);
                self.holds.safety = state;
                Event::Safety { state: self.holds.state() }
            }
            Some(Message::Suspend { ticket, suspended }) => {
                self.holds.suspend(ticket, suspended);
                Event::Safety { state: self.holds.state() }
            }
            Some(Message::Start { ticket, arm, request, ended }) => {
                self.waiting.insert(ticket, ended);
                Event::Start { ticket, arm, request }
            }
            Some(Message::Happened(event)) => event,
            Some(Message::Reset { seed, goods, state }) => {
                asked = Some(state);
                Event::Reset { seed, goods }
            }
            Some(Message::State(state)) => {
                asked = Some(state);
                Event::Tick
            }
            Some(Message::Save(snapshot)) => {
                saving = Some(snapshot);
                Event::Save
            }
            Some(Message::Fault { fault, taken }) => {
                let _ = taken.send(self.cell.faults_to_come() < MAX_FAULTS);
                Event::Fault { fault }
            }
        };
        let saved = self.give(now, event);
        // The caller may be gone.
        if let Some((saving, snapshot)) = saving.zip(saved) {
            let _ = saving.send(snapshot);
        }
        self.applying.extend(safety);
        if self.cell.stands() || self.holds.state() == SafetyState::Ready {
            self.applying.drain(..).for_each(|applied| {
                let _ = applied.send(());
            });
        }
        if let Some(state) = asked {
            let _ = state.send(state_of(&self.cell, now));
        }
    }

    /// Sends the core an event and forwards its commands. Returns the snapshot, if the event asked for one.
    fn give(&mut self, now: Timestamp, event: Event) -> Option<Box<Snapshot>> {
        let recorded = self.recorder.is_on().then(|| event.clone());
        let commands = self.cell.handle(now, event);
        if let Some(event) = recorded {
            self.recorder.write(&Line::of_step(now, event, &commands, &self.cell));
        }
        let mut saved = None;
        for command in commands {
            match command {
                Command::Ended { ticket, ending, .. } => {
                    if let Some(ended) = self.waiting.remove(&ticket) {
                        // The caller may be gone.
                        let _ = ended.send(ending);
                    }
                }
                Command::Saved { snapshot } => saved = Some(snapshot),
                Command::Touched { contact } => tracing::warn!(%contact, "bodies touched that should not have"),
                Command::Noted { what } => tracing::info!("{what}"),
            }
        }
        saved
    }
}

fn state_of(cell: &Cell, now: Timestamp) -> State {
    State {
        objects: cell.ground_truth(),
        battery: cell.battery(),
        arm: cell.configuration().arm,
        base: cell.base_pose(),
        now,
        seed: cell.seed(),
        contacts: cell.unintended_contacts(),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::config::CellConfig;
    use ratn_motion::aimm;
    use ratn_worker::boot_clock::BootClock;

    #[tokio::test(flavor = "multi_thread")]
    async fn a_stop_and_a_hold_of_an_arm_under_way_are_confirmed_when_it_stands() {
        for state in
            [SafetyState::Stopped { reason: "a hand".to_owned() }, SafetyState::Held { reason: "a door".to_owned() }]
        {
            let cell = Cell::new(CellConfig::default()).unwrap();
            let handle = start(cell, Recorder::none(), RobotClock::start(1.0), Vitals::default()).unwrap();
            let motion = handle.perform(Request::MoveTo { joints: aimm::OBSERVATION, speed: 0.5 }).unwrap();
            let far = |at: &State| (at.arm[0] - aimm::HOME[0]).abs() > 0.3;
            while !far(&handle.state().await.unwrap()) {}
            let told = handle.state().await.unwrap();
            handle.apply(&state).await.unwrap();
            let confirmed = handle.state().await.unwrap();
            let later = handle.state().await.unwrap();
            assert_eq!(confirmed.arm, later.arm, "{state:?}");
            // It was moving when the hold was requested, and braked.
            assert!(confirmed.now.since(told.now) > Duration::from_millis(40), "{state:?}");
            assert!((confirmed.arm[0] - told.arm[0]).abs() > 1e-3, "{state:?}");
            drop(motion);
        }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn an_arm_under_way_rests_after_the_machine_was_suspended() {
        let wall = BootClock::suspendable();
        let clock = RobotClock::by(wall.clone(), Timestamp(0), 1.0);
        let handle =
            start(Cell::new(CellConfig::default()).unwrap(), Recorder::none(), clock, Vitals::default()).unwrap();
        let _motion = handle.perform(Request::MoveTo { joints: aimm::OBSERVATION, speed: 0.2 }).unwrap();
        let far = |at: &State, from: f64| (at.arm[0] - from).abs() > 0.05;
        assert!((aimm::OBSERVATION[0] - aimm::HOME[0]).abs() > 0.5);
        while !far(&handle.state().await.unwrap(), aimm::HOME[0]) {}
        let before = handle.state().await.unwrap();
        wall.suspend(Duration::from_secs(60));
        let [after, later] = [handle.state().await.unwrap(), handle.state().await.unwrap()];
        assert!(after.now.since(before.now) >= Duration::from_secs(60));
        assert!(after.arm == later.arm && far(&after, aimm::OBSERVATION[0]), "it has braked, and rests");
        // Then it goes on.
        while !far(&handle.state().await.unwrap(), after.arm[0]) {}
    }

    #[test]
    fn what_moved_has_stood_still_while_the_cell_was_suspended_and_goes_on_when_it_is_known_who_holds_it() {
        let (begin, robot) = (BootClock::default().now(), |ms: u64| Timestamp(0) + Duration::from_millis(ms));
        let mut keeper = Keeper::begin(Cell::new(CellConfig::default()).unwrap(), Recorder::none(), begin, robot(0));
        let request = Request::MoveTo { joints: aimm::OBSERVATION, speed: 0.5 };
        let (ended, mut ending) = oneshot::channel();
        let mut start = Some(Message::Start { ticket: Ticket(1), arm: 0, request, ended });
        let mut turn = |keeper: &mut Keeper, ms: u64| {
            keeper.turn(begin + Duration::from_millis(ms), robot(ms), RESTLESS_SLEEP, start.take());
            keeper.cell.configuration().arm
        };
        let before = turn(&mut keeper, 0);
        for ms in (5..500).step_by(5) {
            turn(&mut keeper, ms);
        }
        let suspended = turn(&mut keeper, 500);
        // More time than the motion needs.
        let continued = turn(&mut keeper, 30_000);
        let way = |from: JointVector, to: JointVector| (to[0] - from[0]).abs();
        assert!(way(before, suspended) > 1e-3 && way(suspended, continued) < 0.2 && keeper.cell.stands());
        assert!(way(continued, aimm::OBSERVATION) > 0.5);
        for ms in (30_005..31_000).step_by(5) {
            assert_eq!(turn(&mut keeper, ms), continued);
        }
        for ms in (31_000..60_000).step_by(5) {
            turn(&mut keeper, ms);
        }
        assert!(way(keeper.cell.configuration().arm, aimm::OBSERVATION) < 1e-6);
        assert!(matches!(ending.try_recv(), Ok(Ending::Done(_))));
    }

    #[tokio::test]
    async fn a_stop_arrives_however_many_questions_wait_also_of_a_goal_that_nobody_waits_for() {
        let (handle, inbox) = handle_of(&Cell::new(CellConfig::default()).unwrap());
        let (stopped, dropped) = (handle.perform(Request::Release).unwrap(), handle.perform(Request::Release).unwrap());
        let tickets = [stopped.ticket, dropped.ticket];
        while handle.ask(Message::Happened(Event::Tick)).is_ok() {}
        assert_eq!(handle.state().await, Err(CellActorError::Overloaded));
        drop(dropped);
        let stopping = tokio::spawn(stopped.stop());
        tokio::task::yield_now().await;

        let stops = inbox.try_iter().filter_map(|queued| match queued.message {
            Message::Happened(Event::Stop { ticket, .. }) => Some(ticket),
            _ => None,
        });
        assert_eq!(stops.collect::<std::collections::BTreeSet<_>>(), tickets.into());
        assert_eq!(stopping.await.unwrap(), Err(CellActorError::Ended));
        handle.tell(Event::Tick).await.unwrap();
    }
}
