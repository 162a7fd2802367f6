//! Emergency stop and hold. Every driver of hardware that moves serves them beside its actions.
//!
//! ```text
//!   ready ──hold──▶ held ──go on──▶ ready
//!     └────stop──────┴─▶ stopped ──clear──▶ ready
//! ```
//! A [`Safety`] is the state of one driver. A stop and a hold are in force at once. They are confirmed to the caller when the driver's
//! [`Brakes`] have carried them out. A stop ends a hold; a hold that is asked for during a stop is in force when the stop is cleared. (The pure `machine` decides all of that; this module performs its commands.) An
//! [`crate::action::ActionServer`] with a `Safety` ends every goal with `stopped` while a stop is in force; an action pauses itself with
//! [`crate::action::GoalContext::while_held`]. A stop that is kept in a file outlasts the process and a reboot.
//!
//! It does not stop motors by itself. The emergency stop of a real robot is an electric circuit; this module lets the robot's software
//! report such a stop, and request one.

mod client;
mod latch;
mod machine;
mod service;

pub use client::SafetyClient;

use crate::panic::exit_on_panic;
use latch::Latch;
use machine::{Application, Call, Command, Event, Machine, Question};
use ratn_proto::v1::safety_service_server::SafetyServiceServer;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;
use std::io;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::sync::{oneshot, watch};
use tokio::task::AbortHandle;
use tokio::time::Instant;

/// The name of this part of the process in the log.
const PART: &str = "emergency stop and hold";

/// The state in force at a driver.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SafetyState {
    /// Goals are performed.
    #[default]
    Ready,
    /// Goals pause.
    Held {
        /// The reason, with the person or program that asked.
        reason: String,
    },
    /// Goals end with `stopped`.
    Stopped {
        /// The reason, with the person or program that asked.
        reason: String,
    },
}

/// Carries a safety state out: pauses motors, ends motions, lets them go on.
#[tonic::async_trait]
pub trait Brakes: Send + Sync + 'static {
    /// Carries `state` out and returns when that is done: for `Held` and `Stopped`, when nothing moves.
    ///
    /// It may be called for a state that is carried out already. It is called again for a state that it did not confirm, whether or not the
    /// caller still waits. A stop or a hold does not wait for an earlier call: the earlier future is dropped at its next await point, and
    /// the two may overlap until then. The newer call is repeated after that.
    ///
    /// Work that goes on after the future was dropped (`spawn_blocking`, a thread, another process) is unknown to the caller: it could
    /// release what a newer call has stopped. If there is such work, a newer call must not confirm before that work is over, and must then
    /// repeat its own.
    ///
    /// # Errors
    /// Why the state is not carried out, or may not be.
    async fn apply(&self, state: &SafetyState) -> Result<(), String>;
}

/// For a driver whose actions check the state themselves.
#[derive(Debug, Clone, Copy, Default)]
struct NoBrakes;

#[tonic::async_trait]
impl Brakes for NoBrakes {
    async fn apply(&self, _: &SafetyState) -> Result<(), String> {
        Ok(())
    }
}

/// Emergency stop and hold of one driver. A handle: clones share the state.
#[derive(Clone)]
pub struct Safety {
    shared: Arc<Shared>,
    /// False if the actions check the state themselves: then it is unknown when nothing moves.
    has_brakes: bool,
}

struct Shared {
    state: watch::Sender<SafetyState>,
    brakes: Arc<dyn Brakes>,
    latch: Option<Latch>,
    /// Never locked across an `await`.
    control: Mutex<Control>,
}

/// The machine, and the callers and applications that its ids refer to.
struct Control {
    machine: Machine,
    last_call: u64,
    callers: BTreeMap<Call, oneshot::Sender<Result<SafetyState, SafetyError>>>,
    applications: BTreeMap<Application, AbortHandle>,
}

/// A call that waits for its answer; dropping it ends the wait.
struct WaitingCall<'a> {
    shared: &'a Arc<Shared>,
    call: Call,
}

/// Why a state was not carried out.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SafetyError {
    /// An emergency stop is in force, so motion may not go on.
    #[error("an emergency stop is in force ({reason}): clear it first, `ratn stop --clear`")]
    Stopped {
        /// Its reason.
        reason: String,
    },
    /// The brakes, or the disk, have not yet confirmed the stop or hold that is in force; it cannot be released before.
    #[error(
        "{}, and not confirmed yet: it stays in force; ask for it again until it is confirmed, then end it",
        in_force(state)
    )]
    NotConfirmed {
        /// The state in force.
        state: SafetyState,
    },
    /// The brakes did not confirm.
    #[error("not confirmed, go and look: {0}")]
    Brakes(String),
    /// The stop cannot be written to the disk, or removed from it: after a restart the driver may not know of it, or may find an old one.
    #[error("the stop is in force, but not as it is on the disk, which a restart goes by: {0}")]
    Latch(String),
}

impl Default for Safety {
    fn default() -> Safety {
        let safety = Safety::new(NoBrakes);
        Safety { has_brakes: false, ..safety }
    }
}

impl Safety {
    /// A driver that is ready, with these brakes.
    pub fn new(brakes: impl Brakes) -> Safety {
        Safety::of(brakes, None, Machine::new(false))
    }

    /// As [`Safety::new`], with stops kept in `file`. If the file already contains a stop, that stop is in force from the beginning. Put
    /// the file into a state directory: a runtime directory may be empty after a reboot.
    ///
    /// # Errors
    /// The file exists and cannot be read, its folder cannot be made, or the brakes do not confirm.
    pub async fn kept_in(file: PathBuf, brakes: impl Brakes) -> io::Result<Safety> {
        let latch = Latch::at(file)?;
        let Some(reason) = latch.read()? else {
            return Ok(Safety::of(brakes, Some(latch), Machine::new(true)));
        };
        let safety = Safety::of(brakes, Some(latch), Machine::stopped_before(reason.clone()));
        safety.shared.state.send_replace(SafetyState::Stopped { reason: reason.clone() });
        safety.stop(&reason).await.map_err(io::Error::other)?;
        tracing::warn!(reason, "an emergency stop from before is in force until it is cleared");
        Ok(safety)
    }

    fn of(brakes: impl Brakes, latch: Option<Latch>, machine: Machine) -> Safety {
        let control = Control { machine, last_call: 0, callers: BTreeMap::new(), applications: BTreeMap::new() };
        let state = watch::Sender::new(SafetyState::Ready);
        let shared = Shared { state, brakes: Arc::new(brakes), latch, control: Mutex::new(control) };
        Safety { shared: Arc::new(shared), has_brakes: true }
    }

    /// The state in force, and every change of it.
    pub fn watch(&self) -> watch::Receiver<SafetyState> {
        self.shared.state.subscribe()
    }

    /// The state in force.
    pub fn state(&self) -> SafetyState {
        self.shared.state.borrow().clone()
    }

    /// Emergency stop, from any state and whatever the brakes are doing. It is in force at once. Returns when nothing moves and the stop is
    /// on disk (if stops are kept). The state is `Stopped` even if that is not confirmed, or if the future is dropped. A second call
    /// repeats what was not confirmed.
    ///
    /// # Errors
    /// [`SafetyError::Brakes`], and [`SafetyError::Latch`].
    pub async fn stop(&self, reason: &str) -> Result<SafetyState, SafetyError> {
        tracing::warn!(reason, "emergency stop");
        self.ask(Question::Stop { reason: reason.to_owned() }).await
    }

    /// Ends an emergency stop. Goals that were stopped do not go on. The state is `Held` afterwards if a hold was asked for during the stop.
    ///
    /// # Errors
    /// [`SafetyError::Brakes`], and [`SafetyError::Latch`] if the file with the stop cannot be removed: then the stop stays in force.
    /// [`SafetyError::NotConfirmed`] while the brakes have not answered to the stop, and [`SafetyError::Stopped`] if another stop is
    /// requested before the brakes are released.
    pub async fn clear(&self) -> Result<SafetyState, SafetyError> {
        self.ask(Question::Clear).await
    }

    /// Pauses running and new goals until [`Safety::go_on`]. It is in force at once. Returns when nothing moves. A second call asks the
    /// brakes again, unless they have confirmed. During an emergency stop the stop remains in force, and the hold follows when the
    /// stop is cleared.
    ///
    /// # Errors
    /// [`SafetyError::Brakes`]; while a stop is in force, as [`Safety::stop`].
    pub async fn hold(&self, reason: &str) -> Result<SafetyState, SafetyError> {
        tracing::info!(reason, "hold");
        self.ask(Question::Hold { reason: reason.to_owned() }).await
    }

    /// Ends a hold.
    ///
    /// # Errors
    /// [`SafetyError::Stopped`] while a stop is in force, [`SafetyError::NotConfirmed`] while the brakes have not answered to the hold, or
    /// if another hold is requested before they are released; else [`SafetyError::Brakes`].
    pub async fn go_on(&self) -> Result<SafetyState, SafetyError> {
        self.ask(Question::GoOn).await
    }

    /// Makes the brakes end motions that an earlier process may have begun; then the state in force is carried out again. False if there
    /// are no brakes.
    ///
    /// # Errors
    /// [`SafetyError::Brakes`].
    pub(crate) async fn bring_to_rest(&self) -> Result<bool, SafetyError> {
        self.ask(Question::Rest).await.map(|_| self.has_brakes)
    }

    /// Resolves when a stop is in force, with its reason.
    pub(crate) async fn stopped(&self) -> String {
        let mut state = self.watch();
        let stopped =
            state.wait_for(|state| matches!(state, SafetyState::Stopped { .. })).await.map(|state| state.clone());
        match stopped {
            Ok(SafetyState::Stopped { reason }) => reason,
            // The sender is in `self`, so the channel is open.
            _ => std::future::pending().await,
        }
    }

    /// The gRPC service, for [`crate::server::Services::with`].
    pub fn into_service(self) -> SafetyServiceServer<Safety> {
        SafetyServiceServer::new(self)
    }

    async fn ask(&self, question: Question) -> Result<SafetyState, SafetyError> {
        let (answer, answered) = oneshot::channel();
        let call = {
            let mut control = self.shared.control();
            control.last_call += 1;
            let call = Call(control.last_call);
            control.callers.insert(call, answer);
            self.shared.handle_in(&mut control, Event::Asked { call, question });
            call
        };
        let _waiting = WaitingCall { shared: &self.shared, call };
        // The machine answers every call whose caller waits.
        answered.await.unwrap_or_else(|_| Err(SafetyError::Brakes("nobody answers for the brakes".to_owned())))
    }
}

impl Shared {
    fn control(&self) -> MutexGuard<'_, Control> {
        self.control.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn handle_in(self: &Arc<Self>, control: &mut Control, event: Event) {
        for command in control.machine.handle(Instant::now(), event) {
            self.perform(control, command);
        }
    }

    fn perform(self: &Arc<Self>, control: &mut Control, command: Command) {
        match command {
            Command::Show(state) => {
                tracing::info!(state = in_force(&state), "in force");
                self.state.send_replace(state);
            }
            Command::Apply { application, state } => {
                let applying = self.clone().apply(application, state);
                control.applications.insert(application, applying);
            }
            Command::Drop { application } => {
                if let Some(applying) = control.applications.get(&application) {
                    applying.abort();
                }
            }
            Command::WriteLatch { reason } => {
                self.keep(move |latch| async move { Event::Latched(latch.set(&reason).await) })
            }
            Command::RemoveLatch => self.keep(|latch| async move { Event::Unlatched(latch.clear().await) }),
            Command::Answer { call, answer } => {
                if let Some(caller) = control.callers.remove(&call) {
                    // The caller may be gone.
                    let _ = caller.send(answer);
                }
            }
        }
    }

    /// Applies the brakes in a task of its own: a release must not be cut short because its caller is gone.
    fn apply(self: Arc<Self>, application: Application, state: SafetyState) -> AbortHandle {
        let brakes = self.brakes.clone();
        let applying = tokio::spawn(async move { brakes.apply(&state).await });
        let abort = applying.abort_handle();
        let answered = async move {
            let result = applying.await.unwrap_or_else(|error| Err(format!("the brakes have ended: {error}")));
            if let Err(error) = &result {
                tracing::warn!(error, "the brakes have not confirmed");
            }
            let mut control = self.control();
            control.applications.remove(&application);
            self.handle_in(&mut control, Event::Braked { application, result });
        };
        tokio::spawn(exit_on_panic(PART, answered));
        abort
    }

    /// Changes the file, also in a task of its own.
    fn keep<F>(self: &Arc<Self>, work: impl FnOnce(Latch) -> F)
    where
        F: Future<Output = Event> + Send + 'static,
    {
        // The machine commands this only if stops are kept.
        let Some(latch) = self.latch.clone() else { return };
        let (shared, work) = (self.clone(), work(latch));
        let kept = async move {
            let done = work.await;
            if let Event::Latched(Err(error)) | Event::Unlatched(Err(error)) = &done {
                tracing::error!(error, "the stop is in force, but not as it is on the disk, which a restart goes by");
            }
            shared.handle_in(&mut shared.control(), done);
        };
        tokio::spawn(exit_on_panic(PART, kept));
    }
}

impl Drop for WaitingCall<'_> {
    fn drop(&mut self) {
        let mut control = self.shared.control();
        control.callers.remove(&self.call);
        self.shared.handle_in(&mut control, Event::Left { call: self.call });
    }
}

/// The state in words.
fn in_force(state: &SafetyState) -> String {
    match state {
        SafetyState::Ready => "ready".to_owned(),
        SafetyState::Held { reason } => format!("a hold is in force ({reason})"),
        SafetyState::Stopped { reason } => format!("an emergency stop is in force ({reason})"),
    }
}

impl fmt::Debug for Safety {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Safety").field("state", &self.state()).field("latch", &self.shared.latch).finish()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    struct Stuck;

    #[tonic::async_trait]
    impl Brakes for Stuck {
        async fn apply(&self, _: &SafetyState) -> Result<(), String> {
            Err("the brakes do not answer".to_owned())
        }
    }

    #[tokio::test]
    async fn a_stop_ends_a_hold_and_only_being_cleared_ends_it() {
        let safety = Safety::default();
        assert_eq!(safety.hold("a look").await, Ok(SafetyState::Held { reason: "a look".into() }));
        assert_eq!(safety.stop("a hand").await, Ok(SafetyState::Stopped { reason: "a hand".into() }));
        // A second stop or going on does not change it.
        assert_eq!(safety.stop("another").await, Ok(SafetyState::Stopped { reason: "a hand".into() }));
        assert_eq!(safety.go_on().await, Err(SafetyError::Stopped { reason: "a hand".into() }));
        assert_eq!(safety.clear().await, Ok(SafetyState::Ready));
        assert_eq!(safety.go_on().await, Ok(SafetyState::Ready));
    }

    #[tokio::test]
    async fn a_hold_that_is_asked_for_during_a_stop_is_in_force_when_the_stop_is_cleared() {
        for file in [None, Some(tempfile::tempdir().unwrap())] {
            let safety = match &file {
                None => Safety::default(),
                Some(place) => Safety::kept_in(place.path().join("stopped"), NoBrakes).await.unwrap(),
            };
            safety.stop("a hand").await.unwrap();
            assert_eq!(safety.hold("a look").await, Ok(SafetyState::Stopped { reason: "a hand".into() }));
            let held = SafetyState::Held { reason: "a look".into() };
            assert_eq!((safety.clear().await, safety.state()), (Ok(held.clone()), held));
            assert_eq!(safety.go_on().await, Ok(SafetyState::Ready));
            // It is over then.
            safety.stop("a hand").await.unwrap();
            assert_eq!(safety.clear().await, Ok(SafetyState::Ready));
        }
    }

    #[tokio::test]
    async fn clearing_does_not_end_a_hold() {
        let safety = Safety::default();
        safety.hold("a look").await.unwrap();
        assert_eq!(safety.clear().await, Ok(SafetyState::Held { reason: "a look".into() }));
        assert_eq!(safety.go_on().await, Ok(SafetyState::Ready));
    }

    #[tokio::test]
    async fn a_stop_outlasts_the_process() {
        let place = tempfile::tempdir().unwrap();
        let file = place.path().join("stopped");
        let before = Safety::kept_in(file.clone(), NoBrakes).await.unwrap();
        before.stop("a hand").await.unwrap();
        drop(before);
        let after = Safety::kept_in(file.clone(), NoBrakes).await.unwrap();
        assert_eq!(after.state(), SafetyState::Stopped { reason: "a hand".into() });
        after.clear().await.unwrap();
        assert_eq!(Safety::kept_in(file, NoBrakes).await.unwrap().state(), SafetyState::Ready);
    }

    #[tokio::test]
    async fn a_stop_that_is_not_on_the_disk_is_in_force_and_not_confirmed_until_it_is() {
        let place = tempfile::tempdir().unwrap();
        let file = place.path().join("cell").join("stopped");
        let safety = Safety::kept_in(file.clone(), NoBrakes).await.unwrap();
        // A folder with the name of the file to be written.
        std::fs::create_dir(file.with_extension("new")).unwrap();
        let refused = safety.stop("a hand").await.unwrap_err();
        assert!(matches!(&refused, SafetyError::Latch(_)) && refused.to_string().contains("stopped"), "{refused}");
        assert_eq!(safety.state(), SafetyState::Stopped { reason: "a hand".into() });
        assert!(matches!(safety.stop("again").await, Err(SafetyError::Latch(_))), "still not on the disk");
        std::fs::remove_dir(file.with_extension("new")).unwrap();
        assert_eq!(safety.stop("again").await, Ok(SafetyState::Stopped { reason: "a hand".into() }));
        assert_eq!(Safety::kept_in(file, NoBrakes).await.unwrap().state(), safety.state());
    }

    #[tokio::test]
    async fn a_stop_that_was_not_cleared_on_the_disk_stays_in_force() {
        let place = tempfile::tempdir().unwrap();
        let file = place.path().join("stopped");
        let safety = Safety::kept_in(file.clone(), NoBrakes).await.unwrap();
        safety.stop("a hand").await.unwrap();
        std::fs::remove_file(&file).unwrap();
        std::fs::create_dir(&file).unwrap();
        assert!(matches!(safety.clear().await, Err(SafetyError::Latch(_))));
        assert_eq!(safety.state(), SafetyState::Stopped { reason: "a hand".into() });
        assert!(Safety::kept_in(file, NoBrakes).await.is_err(), "nobody moves before it is known");
    }

    /// Brakes that hang on a hold, and confirm everything else.
    struct HangsInHold;

    #[tonic::async_trait]
    impl Brakes for HangsInHold {
        async fn apply(&self, state: &SafetyState) -> Result<(), String> {
            match state {
                SafetyState::Held { .. } => std::future::pending().await,
                _ => Ok(()),
            }
        }
    }

    #[tokio::test]
    async fn a_stop_is_in_force_and_confirmed_though_the_brakes_hang_at_the_start() {
        let safety = Safety::new(HangsInHold);
        let mut start = Box::pin(safety.bring_to_rest());
        assert!(futures::poll!(&mut start).is_pending());
        assert_eq!(safety.stop("a hand").await, Ok(SafetyState::Stopped { reason: "a hand".into() }));
        // Nothing moves: that is what the start waited for.
        assert_eq!(start.await, Ok(true));
        assert_eq!(safety.clear().await, Ok(SafetyState::Ready));
    }

    #[tokio::test]
    async fn a_call_that_nobody_waits_for_leaves_nothing_behind() {
        let safety = Safety::new(HangsInHold);
        for _ in 0..3 {
            let mut hold = Box::pin(safety.hold("a look"));
            assert!(futures::poll!(&mut hold).is_pending());
        }
        assert!(safety.shared.control().callers.is_empty());
        assert_eq!(safety.shared.control().applications.len(), 1);
        assert!(matches!(safety.go_on().await, Err(SafetyError::NotConfirmed { .. })));
    }

    #[tokio::test]
    async fn a_stop_that_is_not_confirmed_is_in_force_all_the_same() {
        let safety = Safety::new(Stuck);
        assert_eq!(safety.stop("a hand").await, Err(SafetyError::Brakes("the brakes do not answer".into())));
        assert!(matches!(safety.state(), SafetyState::Stopped { .. }));
        assert!(safety.clear().await.is_err());
        assert!(matches!(safety.state(), SafetyState::Stopped { .. }));
    }
}
