//! The owner of the cell's core: a thread that performs messages in their order and wakes when the core says.
//!
//! A thread, not a task: checking a trajectory takes milliseconds, and a motion has to stop on time whatever the runtime does.

use crate::core::cell::Cell;
use crate::core::picture::{Exposure, develop};
use crate::core::protocol::{Command, Ending, Event, Request, Ticket};
use ratn_model::id::LeaseId;
use ratn_model::time::Timestamp;
use ratn_motion::robot::{Joints, Robot};
use ratn_perception::camera::{Camera, DepthImage};
use ratn_perception::noise::Noise;
use ratn_worker::robot_clock::RobotClock;
use std::collections::BTreeMap;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::time::Duration;
use tokio::sync::oneshot;

use crate::core::boxes::TrueBox;

/// Messages that wait for the keeper at the most.
const MAX_MESSAGES: usize = 256;
/// It looks at the clock at least this often.
const MAX_SLEEP: Duration = Duration::from_secs(1);

/// What the cell knows.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct State {
    pub(crate) boxes: Vec<TrueBox>,
    pub(crate) battery: f64,
    pub(crate) arm: Joints,
    pub(crate) now: Timestamp,
    pub(crate) seed: u64,
}

/// Sends messages to the keeper. Clones share it; it ends with the last of them.
#[derive(Debug, Clone)]
pub(crate) struct Keeper {
    messages: SyncSender<Message>,
    tickets: Arc<AtomicU64>,
    optics: Arc<Optics>,
}

#[derive(Debug)]
struct Optics {
    robot: Robot,
    noise: Noise,
}

/// The keeper does not take the message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum KeeperError {
    #[error("the cell is overloaded: {MAX_MESSAGES} messages wait; try again later")]
    Overloaded,
    #[error("the cell has ended")]
    Ended,
}

enum Message {
    Start { ticket: Ticket, lease: Option<LeaseId>, request: Request, ended: oneshot::Sender<Ending> },
    Happened(Event),
    Reset { seed: u64, boxes: usize, state: oneshot::Sender<State> },
    State(oneshot::Sender<State>),
}

/// Starts the thread.
pub(crate) fn start(cell: Cell, clock: RobotClock) -> io::Result<Keeper> {
    let (messages, inbox) = sync_channel(MAX_MESSAGES);
    let optics = Arc::new(Optics { robot: cell.robot().clone(), noise: cell.config().camera.noise });
    let keep = move || keep(cell, clock, &inbox);
    std::thread::Builder::new().name("cell".to_owned()).spawn(keep)?;
    Ok(Keeper { messages, tickets: Arc::default(), optics })
}

impl Keeper {
    /// Starts a goal; its ticket, and how it ends.
    pub(crate) fn perform(
        &self,
        lease: Option<LeaseId>,
        request: Request,
    ) -> Result<(Ticket, oneshot::Receiver<Ending>), KeeperError> {
        let ticket = Ticket(self.tickets.fetch_add(1, Ordering::Relaxed) + 1);
        let (ended, end) = oneshot::channel();
        self.send(Message::Start { ticket, lease, request, ended })?;
        Ok((ticket, end))
    }

    /// Tells the core of an event.
    pub(crate) fn tell(&self, event: Event) -> Result<(), KeeperError> {
        self.send(Message::Happened(event))
    }

    /// A new table; what is true then.
    pub(crate) async fn reset(&self, seed: u64, boxes: usize) -> Result<State, KeeperError> {
        let (state, answer) = oneshot::channel();
        self.send(Message::Reset { seed, boxes, state })?;
        answer.await.map_err(|_| KeeperError::Ended)
    }

    /// What is true now.
    pub(crate) async fn state(&self) -> Result<State, KeeperError> {
        let (state, answer) = oneshot::channel();
        self.send(Message::State(state))?;
        answer.await.map_err(|_| KeeperError::Ended)
    }

    /// Makes an image of what was in front of the camera. Blocks for milliseconds per exposure.
    pub(crate) fn develop(&self, camera: &Camera, seed: u64, exposures: &[Exposure]) -> DepthImage {
        develop(&self.optics.robot, camera, &self.optics.noise, seed, exposures)
    }

    fn send(&self, message: Message) -> Result<(), KeeperError> {
        self.messages.try_send(message).map_err(|error| match error {
            TrySendError::Full(_) => KeeperError::Overloaded,
            TrySendError::Disconnected(_) => KeeperError::Ended,
        })
    }
}

fn keep(mut cell: Cell, clock: RobotClock, inbox: &Receiver<Message>) {
    let mut waiting: BTreeMap<Ticket, oneshot::Sender<Ending>> = BTreeMap::new();
    loop {
        let sleep = cell.next_wake().map_or(MAX_SLEEP, |moment| clock.until(moment).min(MAX_SLEEP));
        let message = match inbox.recv_timeout(sleep) {
            Ok(message) => Some(message),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => return,
        };
        let now = clock.now();
        let (event, asked) = match message {
            None => (Event::Tick, None),
            Some(Message::Start { ticket, lease, request, ended }) => {
                waiting.insert(ticket, ended);
                (Event::Start { ticket, lease, request }, None)
            }
            Some(Message::Happened(event)) => (event, None),
            Some(Message::Reset { seed, boxes, state }) => (Event::Reset { seed, boxes }, Some(state)),
            Some(Message::State(state)) => (Event::Tick, Some(state)),
        };
        for Command::Ended { ticket, ending } in cell.handle(now, event) {
            if let Some(ended) = waiting.remove(&ticket) {
                // Whoever asked may be gone.
                let _ = ended.send(ending);
            }
        }
        if let Some(state) = asked {
            let _ = state.send(state_of(&cell, now));
        }
    }
}

fn state_of(cell: &Cell, now: Timestamp) -> State {
    State { boxes: cell.ground_truth(), battery: cell.battery(), arm: cell.configuration().arm, now, seed: cell.seed() }
}
