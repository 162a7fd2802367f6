//! The gRPC adapter of [`Safety`].

use super::{Safety, SafetyError, SafetyState};
use crate::access::Caller;
use crate::audit::{self, Mutation, Pending};
use ratn_proto::convert::label;
use ratn_proto::v1;
use ratn_proto::v1::safety_service_server::SafetyService;
use tonic::{Request, Response, Status};

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
            SafetyError::Stopped { .. } | SafetyError::NotConfirmed { .. } => {
                Status::failed_precondition(error.to_string())
            }
            SafetyError::Brakes(_) | SafetyError::Latch(_) => Status::internal(error.to_string()),
        }
    }
}

/// Writes the result of a change to the audit log, and returns it.
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
