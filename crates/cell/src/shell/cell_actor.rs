//! The owner of the cell's core: a thread that performs messages in their order and wakes when the core says.
//!
//! A thread, not a task: checking a trajectory takes milliseconds, and a motion has to stop on time whatever the runtime does.

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

/// Messages that wait for the handle at the most, besides one per goal that tells it to stop.
const MAX_MESSAGES: usize = 256;
/// It looks at the clock at least this often.
const MAX_SLEEP: Duration = Duration::from_secs(1);
/// … and so often while something moves: what is not computed meanwhile makes the end of a motion late.
const RESTLESS_SLEEP: Duration = Duration::from_millis(5);

/// What the cell knows.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct State {
    pub(crate) objects: Vec<TrueObject>,
    pub(crate) battery: f64,
    pub(crate) arm: JointVector,
    pub(crate) base: Pose,
    pub(crate) now: Timestamp,
    pub(crate) seed: u64,
    /// What touched that should not have.
    pub(crate) contacts: Vec<Contact>,
}

/// Sends messages to the handle. Clones share it; it ends with the last of them.
#[derive(Debug, Clone)]
pub(crate) struct CellHandle {
    messages: Sender<QueuedMessage>,
    room: Arc<Semaphore>,
    tickets: Arc<AtomicU64>,
    optics: Arc<Optics>,
}

/// A goal under way. Dropped before its end, it stops: nothing moves that nobody waits for.
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

/// Why the robot is to stand still.
#[derive(Debug, Default)]
struct Holds {
    safety: SafetyState,
    suspended: BTreeSet<Ticket>,
}

/// The handle does not take the message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum CellActorError {
    #[error("the cell is overloaded: {MAX_MESSAGES} messages wait; try again later")]
    Overloaded,
    #[error("the cell has ended")]
    Ended,
}

/// A message with the room that it takes in the queue.
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

/// Starts the thread.
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
    /// What the robot has.
    pub(crate) fn modules(&self) -> Vec<Module> {
        Module::of(&self.optics.robot)
    }

    /// The robot, seen from its first arm.
    pub(crate) fn robot(&self) -> &Robot {
        &self.optics.robot
    }

    /// Starts a goal of the first arm, or one that is for no arm.
    #[cfg(test)]
    pub(crate) fn perform(&self, request: Request) -> Result<Motion, CellActorError> {
        self.perform_with(crate::core::arms::FIRST, request)
    }

    /// Starts a goal, of the arm of this number where it is one for an arm or its gripper.
    pub(crate) fn perform_with(&self, arm: usize, request: Request) -> Result<Motion, CellActorError> {
        let ticket = Ticket(self.tickets.fetch_add(1, Ordering::Relaxed) + 1);
        let (ended, ending) = oneshot::channel();
        self.ask(Message::Start { ticket, arm, request, ended })?;
        Ok(Motion { ticket, ending, messages: self.messages.clone(), suspended: false, over: false })
    }

    /// Tells the core of an event, as soon as there is room.
    pub(crate) async fn tell(&self, event: Event) -> Result<(), CellActorError> {
        let room = Arc::clone(&self.room).acquire_owned().await.map_err(|_| CellActorError::Ended)?;
        self.send(Message::Happened(event), room)
    }

    /// A new table; what is true then.
    pub(crate) async fn reset(&self, seed: u64, goods: Goods) -> Result<State, CellActorError> {
        let (state, answer) = oneshot::channel();
        self.ask(Message::Reset { seed, goods, state })?;
        answer.await.map_err(|_| CellActorError::Ended)
    }

    /// The state now.
    pub(crate) async fn save(&self) -> Result<Box<Snapshot>, CellActorError> {
        let (snapshot, answer) = oneshot::channel();
        self.ask(Message::Save(snapshot))?;
        answer.await.map_err(|_| CellActorError::Ended)
    }

    /// Something shall go wrong; false where too much is to go wrong already.
    pub(crate) async fn inject(&self, fault: Fault) -> Result<bool, CellActorError> {
        let (taken, answer) = oneshot::channel();
        self.ask(Message::Fault { fault, taken })?;
        answer.await.map_err(|_| CellActorError::Ended)
    }

    /// What is true now.
    pub(crate) async fn state(&self) -> Result<State, CellActorError> {
        let (state, answer) = oneshot::channel();
        self.ask(Message::State(state))?;
        answer.await.map_err(|_| CellActorError::Ended)
    }

    /// Makes an image of what was in front of the camera. Blocks for milliseconds per exposure.
    pub(crate) fn develop(&self, camera: &Camera, seed: u64, exposures: &[Exposure]) -> DepthImage {
        develop(&self.optics.robot, camera, &self.optics.noise, seed, exposures)
    }

    /// Sends a message that can be refused.
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
    /// Never refused for want of room.
    async fn apply(&self, state: &SafetyState) -> Result<(), String> {
        let (applied, done) = oneshot::channel();
        let message = Message::Safety { state: state.clone(), applied };
        self.messages.send(QueuedMessage { message, _room: None }).map_err(|_| CellActorError::Ended.to_string())?;
        done.await.map_err(|_| CellActorError::Ended.to_string())
    }
}

impl Motion {
    /// How it ends.
    pub(crate) async fn ended(&mut self) -> Result<Ending, CellActorError> {
        let ending = (&mut self.ending).await.map_err(|_| CellActorError::Ended);
        self.over = true;
        self.suspend(false);
        ending
    }

    /// Has the robot stand still until this is taken back or the goal has ended. What suspends one goal suspends those of every module:
    /// the resource manager is not heard.
    pub(crate) fn suspend(&mut self, suspended: bool) {
        if std::mem::replace(&mut self.suspended, suspended) != suspended {
            let message = Message::Suspend { ticket: self.ticket, suspended };
            // A handle that has ended moves nothing.
            let _ = self.messages.send(QueuedMessage { message, _room: None });
        }
    }

    /// Tells it to stop, and how it ends then. Never refused: there is at most one such message per goal.
    pub(crate) async fn stop(mut self) -> Result<Ending, CellActorError> {
        self.tell_to_stop();
        self.ended().await
    }

    fn tell_to_stop(&mut self) {
        self.over = true;
        let stop = Event::Stop { ticket: self.ticket, reason: "the goal was told to stop".to_owned() };
        // A handle that has ended moves nothing.
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

    /// What is to be in force.
    fn state(&self) -> SafetyState {
        match &self.safety {
            SafetyState::Ready if !self.suspended.is_empty() => {
                SafetyState::Held { reason: "the resource manager is not heard".to_owned() }
            }
            state => state.clone(),
        }
    }
}

fn keep(mut cell: Cell, mut recorder: Recorder, clock: RobotClock, inbox: &Receiver<QueuedMessage>, vitals: &Vitals) {
    let mut waiting: BTreeMap<Ticket, oneshot::Sender<Ending>> = BTreeMap::new();
    let mut holds = Holds::default();
    // Who waits until what was told to stand stands.
    let mut applying: Vec<oneshot::Sender<()>> = Vec::new();
    loop {
        vitals.beat();
        panic_point("cell-core");
        let most = if cell.is_restless() { RESTLESS_SLEEP } else { MAX_SLEEP };
        let sleep = cell.next_wake().map_or(most, |moment| clock.until(moment).min(most));
        let message = match inbox.recv_timeout(sleep) {
            Ok(queued) => Some(queued.message),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => return,
        };
        let now = clock.now();
        let (mut safety, mut saving) = (None, None);
        let (event, asked) = match message {
            None => (Event::Tick, None),
            Some(Message::Safety { state, applied }) => {
                safety = Some(applied);
                holds.safety = state;
                (Event::Safety { state: holds.state() }, None)
            }
            Some(Message::Suspend { ticket, suspended }) => {
                holds.suspend(ticket, suspended);
                (Event::Safety { state: holds.state() }, None)
            }
            Some(Message::Start { ticket, arm, request, ended }) => {
                waiting.insert(ticket, ended);
                (Event::Start { ticket, arm, request }, None)
            }
            Some(Message::Happened(event)) => (event, None),
            Some(Message::Reset { seed, goods, state }) => (Event::Reset { seed, goods }, Some(state)),
            Some(Message::State(state)) => (Event::Tick, Some(state)),
            Some(Message::Save(snapshot)) => {
                saving = Some(snapshot);
                (Event::Save, None)
            }
            Some(Message::Fault { fault, taken }) => {
                let _ = taken.send(cell.faults_to_come() < MAX_FAULTS);
                (Event::Fault { fault }, None)
            }
        };
        let recorded = recorder.is_on().then(|| event.clone());
        let commands = cell.handle(now, event);
        if let Some(event) = recorded {
            recorder.write(&Line::of_step(now, event, &commands, &cell));
        }
        for command in commands {
            // Whoever asked may be gone.
            match command {
                Command::Ended { ticket, ending, .. } => {
                    if let Some(ended) = waiting.remove(&ticket) {
                        let _ = ended.send(ending);
                    }
                }
                Command::Saved { snapshot } => {
                    if let Some(saving) = saving.take() {
                        let _ = saving.send(snapshot);
                    }
                }
                Command::Touched { contact } => tracing::warn!(%contact, "bodies touched that should not have"),
                Command::Missed { reason } => tracing::info!("the fingers hold nothing: {reason}"),
            }
        }
        applying.extend(safety);
        if cell.stands() || holds.state() == SafetyState::Ready {
            applying.drain(..).for_each(|applied| {
                let _ = applied.send(());
            });
        }
        if let Some(state) = asked {
            let _ = state.send(state_of(&cell, now));
        }
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
            // It was on its way when that was asked for, and braked.
            assert!(confirmed.now.since(told.now) > Duration::from_millis(40), "{state:?}");
            assert!((confirmed.arm[0] - told.arm[0]).abs() > 1e-3, "{state:?}");
            drop(motion);
        }
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
