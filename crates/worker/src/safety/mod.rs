//! Emergency stop and hold: what every driver of something that moves serves beside its actions.
//!
//! ```text
//!   ready ──hold──▶ held ──go on──▶ ready
//!     └────stop──────┴─▶ stopped ──clear──▶ ready
//! ```
//! A [`Safety`] is the state of one driver. Its [`Brakes`] make it true before anybody is told that it is; an
//! [`crate::action::ActionServer`] that is given one ends every goal `stopped` while a stop is in force, and an action pauses itself
//! with [`crate::action::GoalContext::while_held`]. A stop that is kept in a file
//! outlasts the process and a reboot. What it does not do: stop
//! motors. An emergency stop of a real robot is a circuit; this is how its software learns of one, and asks for one.

mod latch;

use latch::Latch;
use ratn_proto::convert::label;
use ratn_proto::v1;
use ratn_proto::v1::safety_service_client::SafetyServiceClient;
use ratn_proto::v1::safety_service_server::{SafetyService, SafetyServiceServer};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use tokio::sync::{Mutex, watch};
use tonic::{Request, Response, Status};

use crate::access::Caller;
use crate::audit::{self, Mutation, Pending};
use crate::client::{CallError, Channels};
use crate::endpoint::Endpoint;

/// What is in force at a driver.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SafetyState {
    /// Goals are performed.
    #[default]
    Ready,
    /// Goals pause.
    Held {
        /// Who wants it, and why.
        reason: String,
    },
    /// Goals end `stopped`.
    Stopped {
        /// Who wants it, and why.
        reason: String,
    },
}

/// What makes a state true: pauses motors, ends motions, lets them go on.
#[tonic::async_trait]
pub trait Brakes: Send + Sync + 'static {
    /// Returns when the state is true: for `Held` and `Stopped`, when nothing moves.
    ///
    /// # Errors
    /// Why it is not, or may not be.
    async fn apply(&self, state: &SafetyState) -> Result<(), String>;
}

/// For a driver whose actions look at the state themselves.
#[derive(Debug, Clone, Copy, Default)]
struct NoBrakes;

#[tonic::async_trait]
impl Brakes for NoBrakes {
    async fn apply(&self, _: &SafetyState) -> Result<(), String> {
        Ok(())
    }
}

/// The state of one driver. A handle: clones share it.
#[derive(Clone)]
pub struct Safety {
    state: Arc<watch::Sender<SafetyState>>,
    brakes: Arc<dyn Brakes>,
    /// False where its actions look at the state themselves: then nobody knows when nothing moves.
    has_brakes: bool,
    latch: Option<Latch>,
    /// One change at a time; whether a stop is on the disk, as far as that is asked for.
    changing: Arc<Mutex<bool>>,
}

/// A state that could not be made so.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SafetyError {
    /// Nothing goes on while an emergency stop is in force.
    #[error("an emergency stop is in force ({reason}): clear it first, `ratn stop --clear`")]
    Stopped {
        /// Its reason.
        reason: String,
    },
    /// The brakes do not confirm.
    #[error("not confirmed, go and look: {0}")]
    Brakes(String),
    /// The stop is in force, and a restart may forget it, or find one that is not.
    #[error("the stop is in force, but not as it is on the disk, which a restart goes by: {0}")]
    Latch(String),
}

impl Default for Safety {
    fn default() -> Safety {
        let mut safety = Safety::new(NoBrakes);
        safety.has_brakes = false;
        safety
    }
}

impl Safety {
    /// Ready, with brakes.
    pub fn new(brakes: impl Brakes) -> Safety {
        let state = Arc::new(watch::Sender::new(SafetyState::Ready));
        Safety { state, brakes: Arc::new(brakes), has_brakes: true, latch: None, changing: Arc::default() }
    }

    /// As [`Safety::new`]; a stop is kept in `file`, and one that is there already is in force from the beginning. The file belongs
    /// into a state directory: what is in a runtime directory is gone after a reboot.
    ///
    /// # Errors
    /// Where the file is there and cannot be read, where its folder cannot be made, or where the brakes do not confirm.
    pub async fn kept_in(file: PathBuf, brakes: impl Brakes) -> io::Result<Safety> {
        let latch = Latch::at(file)?;
        let reason = latch.read()?;
        let safety =
            Safety { latch: Some(latch), changing: Arc::new(Mutex::new(reason.is_some())), ..Safety::new(brakes) };
        if let Some(reason) = reason {
            safety.brakes.apply(&SafetyState::Stopped { reason: reason.clone() }).await.map_err(io::Error::other)?;
            tracing::warn!(reason, "an emergency stop from before is in force until it is cleared");
            safety.state.send_replace(SafetyState::Stopped { reason });
        }
        Ok(safety)
    }

    /// What is in force, and every change of it.
    pub fn watch(&self) -> watch::Receiver<SafetyState> {
        self.state.subscribe()
    }

    /// What is in force.
    pub fn state(&self) -> SafetyState {
        self.state.borrow().clone()
    }

    /// Emergency stop, from whatever state. Returns when nothing moves and the stop is on the disk, where it is kept. The state is
    /// `Stopped` afterwards also where that is not confirmed.
    ///
    /// # Errors
    /// [`SafetyError::Brakes`], and [`SafetyError::Latch`]: asked for again, the stop is written again.
    pub async fn stop(&self, reason: &str) -> Result<SafetyState, SafetyError> {
        let mut on_disk = self.changing.lock().await;
        if let SafetyState::Stopped { reason } = self.state() {
            self.keep(&mut on_disk, &reason).await?;
            return Ok(SafetyState::Stopped { reason });
        }
        let state = SafetyState::Stopped { reason: reason.to_owned() };
        tracing::warn!(reason, "emergency stop");
        let confirmed = self.brakes.apply(&state).await;
        self.state.send_replace(state.clone());
        let kept = self.keep(&mut on_disk, reason).await;
        confirmed.map_err(SafetyError::Brakes)?;
        kept.map(|()| state)
    }

    /// Writes down that a stop is in force, unless that is on the disk already.
    async fn keep(&self, on_disk: &mut bool, reason: &str) -> Result<(), SafetyError> {
        if let Some(latch) = self.latch.as_ref().filter(|_| !*on_disk) {
            latch.set(reason).await.map_err(|error| {
                tracing::error!(error, "the stop is in force, and forgotten at a restart");
                SafetyError::Latch(error)
            })?;
            *on_disk = true;
        }
        Ok(())
    }

    /// Ends an emergency stop. What was stopped does not go on.
    ///
    /// # Errors
    /// [`SafetyError::Brakes`], and [`SafetyError::Latch`] where the file that keeps the stop cannot be removed: it stays in force then.
    pub async fn clear(&self) -> Result<SafetyState, SafetyError> {
        let mut on_disk = self.changing.lock().await;
        let state = self.state();
        if !matches!(state, SafetyState::Stopped { .. }) {
            return Ok(state);
        }
        if let Some(latch) = &self.latch {
            // Removed and not synced it may be there again, or not.
            *on_disk = false;
            latch.clear().await.map_err(SafetyError::Latch)?;
        }
        self.become_ready().await
    }

    /// Pauses what is under way and what is given until [`Safety::go_on`]. A stop stays a stop.
    ///
    /// # Errors
    /// [`SafetyError::Brakes`].
    pub async fn hold(&self, reason: &str) -> Result<SafetyState, SafetyError> {
        let _one = self.changing.lock().await;
        let state = self.state();
        if state != SafetyState::Ready {
            return Ok(state);
        }
        let state = SafetyState::Held { reason: reason.to_owned() };
        tracing::info!(reason, "hold");
        self.state.send_replace(state.clone());
        self.brakes.apply(&state).await.map_err(SafetyError::Brakes)?;
        Ok(state)
    }

    /// Ends a hold.
    ///
    /// # Errors
    /// [`SafetyError::Stopped`] while a stop is in force, else [`SafetyError::Brakes`].
    pub async fn go_on(&self) -> Result<SafetyState, SafetyError> {
        let _one = self.changing.lock().await;
        match self.state() {
            SafetyState::Stopped { reason } => Err(SafetyError::Stopped { reason }),
            SafetyState::Ready => Ok(SafetyState::Ready),
            SafetyState::Held { .. } => self.become_ready().await,
        }
    }

    /// Has the brakes end what a process before this one may have begun; then the state in force is made true again. False where there
    /// are no brakes.
    ///
    /// # Errors
    /// [`SafetyError::Brakes`].
    pub(crate) async fn bring_to_rest(&self) -> Result<bool, SafetyError> {
        let _one = self.changing.lock().await;
        let starting = SafetyState::Held { reason: "the driver has started".to_owned() };
        self.brakes.apply(&starting).await.map_err(SafetyError::Brakes)?;
        self.brakes.apply(&self.state()).await.map_err(SafetyError::Brakes)?;
        Ok(self.has_brakes)
    }

    async fn become_ready(&self) -> Result<SafetyState, SafetyError> {
        tracing::info!("ready");
        self.brakes.apply(&SafetyState::Ready).await.map_err(SafetyError::Brakes)?;
        self.state.send_replace(SafetyState::Ready);
        Ok(SafetyState::Ready)
    }

    /// Resolves when a stop is in force: its reason.
    pub(crate) async fn stopped(&self) -> String {
        let mut state = self.watch();
        let stopped =
            state.wait_for(|state| matches!(state, SafetyState::Stopped { .. })).await.map(|state| state.clone());
        match stopped {
            Ok(SafetyState::Stopped { reason }) => reason,
            // The sender is in `self`.
            _ => std::future::pending().await,
        }
    }

    /// For [`crate::server::Services::with`].
    pub fn into_service(self) -> SafetyServiceServer<Safety> {
        SafetyServiceServer::new(self)
    }
}

impl fmt::Debug for Safety {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Safety").field("state", &self.state()).field("latch", &self.latch).finish()
    }
}

#[tonic::async_trait]
impl SafetyService for Safety {
    async fn emergency_stop(
        &self,
        request: Request<v1::EmergencyStopRequest>,
    ) -> Result<Response<v1::EmergencyStopResponse>, Status> {
        let (caller, reason) = (Caller::of(&request), request.into_inner().reason);
        label(&reason, "reason")?;
        let pending = audit::begin(&caller, "", || Mutation::EmergencyStop { reason: reason.clone() });
        let state = Some(audited(pending, self.stop(&reason).await)?);
        Ok(Response::new(v1::EmergencyStopResponse { state }))
    }

    async fn clear_emergency_stop(
        &self,
        request: Request<v1::ClearEmergencyStopRequest>,
    ) -> Result<Response<v1::ClearEmergencyStopResponse>, Status> {
        let pending = audit::begin(&Caller::of(&request), "", || Mutation::ClearEmergencyStop);
        let state = Some(audited(pending, self.clear().await)?);
        Ok(Response::new(v1::ClearEmergencyStopResponse { state }))
    }

    async fn hold(&self, request: Request<v1::HoldRequest>) -> Result<Response<v1::HoldResponse>, Status> {
        let (caller, reason) = (Caller::of(&request), request.into_inner().reason);
        label(&reason, "reason")?;
        let pending = audit::begin(&caller, "", || Mutation::Hold { reason: reason.clone() });
        let state = Some(audited(pending, Safety::hold(self, &reason).await)?);
        Ok(Response::new(v1::HoldResponse { state }))
    }

    async fn go_on(&self, request: Request<v1::GoOnRequest>) -> Result<Response<v1::GoOnResponse>, Status> {
        let pending = audit::begin(&Caller::of(&request), "", || Mutation::GoOn);
        let state = Some(audited(pending, Safety::go_on(self).await)?);
        Ok(Response::new(v1::GoOnResponse { state }))
    }

    async fn get_safety(&self, _: Request<v1::GetSafetyRequest>) -> Result<Response<v1::GetSafetyResponse>, Status> {
        Ok(Response::new(v1::GetSafetyResponse { state: Some(wire(self.state())) }))
    }
}

impl From<SafetyError> for Status {
    fn from(error: SafetyError) -> Status {
        match error {
            SafetyError::Stopped { .. } => Status::failed_precondition(error.to_string()),
            SafetyError::Brakes(_) | SafetyError::Latch(_) => Status::internal(error.to_string()),
        }
    }
}

/// What came of a change, once it is written down.
fn audited(pending: Pending, changed: Result<SafetyState, SafetyError>) -> Result<v1::SafetyState, Status> {
    let changed = changed.map_err(Status::from);
    pending.ended(&changed);
    changed.map(wire)
}

fn wire(state: SafetyState) -> v1::SafetyState {
    let (kind, reason) = match state {
        SafetyState::Ready => (v1::SafetyKind::Ready, String::new()),
        SafetyState::Held { reason } => (v1::SafetyKind::Held, reason),
        SafetyState::Stopped { reason } => (v1::SafetyKind::Stopped, reason),
    };
    v1::SafetyState { kind: kind.into(), reason }
}

/// Asks drivers.
#[derive(Debug, Clone)]
pub struct SafetyClient {
    client: SafetyServiceClient<crate::trace::Traced>,
    endpoint: Endpoint,
}

impl SafetyClient {
    /// Of the driver that is served there.
    ///
    /// # Errors
    /// Where the endpoint is none.
    pub fn new(channels: &Channels, endpoint: &Endpoint) -> Result<SafetyClient, CallError> {
        let client = SafetyServiceClient::new(channels.get(endpoint)?);
        Ok(SafetyClient { client, endpoint: endpoint.clone() })
    }

    /// Emergency stop; what is in force then.
    ///
    /// # Errors
    /// [`CallError`]: it may move on.
    pub async fn stop(&self, reason: &str) -> Result<SafetyState, CallError> {
        let question = v1::EmergencyStopRequest { reason: reason.to_owned() };
        self.state_of(self.client.clone().emergency_stop(question).await.map(|answer| answer.into_inner().state))
    }

    /// Ends an emergency stop; what is in force then.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn clear(&self) -> Result<SafetyState, CallError> {
        let answer = self.client.clone().clear_emergency_stop(v1::ClearEmergencyStopRequest {}).await;
        self.state_of(answer.map(|answer| answer.into_inner().state))
    }

    /// Pauses; what is in force then.
    ///
    /// # Errors
    /// [`CallError`]: it may move on.
    pub async fn hold(&self, reason: &str) -> Result<SafetyState, CallError> {
        let question = v1::HoldRequest { reason: reason.to_owned() };
        self.state_of(self.client.clone().hold(question).await.map(|answer| answer.into_inner().state))
    }

    /// Ends a pause; what is in force then.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn go_on(&self) -> Result<SafetyState, CallError> {
        let answer = self.client.clone().go_on(v1::GoOnRequest {}).await;
        self.state_of(answer.map(|answer| answer.into_inner().state))
    }

    /// What is in force.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn state(&self) -> Result<SafetyState, CallError> {
        let answer = self.client.clone().get_safety(v1::GetSafetyRequest {}).await;
        self.state_of(answer.map(|answer| answer.into_inner().state))
    }

    fn state_of(&self, answer: Result<Option<v1::SafetyState>, Status>) -> Result<SafetyState, CallError> {
        let state = answer.map_err(|status| CallError::from_status(&self.endpoint, &status))?;
        let v1::SafetyState { kind, reason } = state.unwrap_or_default();
        match v1::SafetyKind::try_from(kind) {
            Ok(v1::SafetyKind::Ready) => Ok(SafetyState::Ready),
            Ok(v1::SafetyKind::Held) => Ok(SafetyState::Held { reason }),
            Ok(v1::SafetyKind::Stopped) => Ok(SafetyState::Stopped { reason }),
            _ => Err(CallError::malformed(&self.endpoint, ratn_proto::convert::Malformed::new("kind", "is not set"))),
        }
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
        // Neither a second stop, a hold nor going on changes it.
        assert_eq!(safety.stop("another").await, Ok(SafetyState::Stopped { reason: "a hand".into() }));
        assert_eq!(safety.hold("a look").await, Ok(SafetyState::Stopped { reason: "a hand".into() }));
        assert_eq!(safety.go_on().await, Err(SafetyError::Stopped { reason: "a hand".into() }));
        assert_eq!(safety.clear().await, Ok(SafetyState::Ready));
        assert_eq!(safety.go_on().await, Ok(SafetyState::Ready));
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
        // A folder in the way of the file.
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

    #[tokio::test]
    async fn a_stop_that_is_not_confirmed_is_in_force_all_the_same() {
        let safety = Safety::new(Stuck);
        assert_eq!(safety.stop("a hand").await, Err(SafetyError::Brakes("the brakes do not answer".into())));
        assert!(matches!(safety.state(), SafetyState::Stopped { .. }));
        assert!(safety.clear().await.is_err());
        assert!(matches!(safety.state(), SafetyState::Stopped { .. }));
    }
}
