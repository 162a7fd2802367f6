//! The client of emergency stop and hold.

use super::SafetyState;
use crate::client::{CallError, Channels};
use crate::endpoint::Endpoint;
use ratn_proto::v1;
use ratn_proto::v1::safety_service_client::SafetyServiceClient;
use tonic::Status;

/// A client for emergency stop and hold of one driver.
#[derive(Debug, Clone)]
pub struct SafetyClient {
    client: SafetyServiceClient<crate::trace::Traced>,
    endpoint: Endpoint,
}

impl SafetyClient {
    /// The client of the driver at `endpoint`.
    ///
    /// # Errors
    /// [`CallError::Broken`] if the endpoint makes no URI.
    pub fn new(channels: &Channels, endpoint: &Endpoint) -> Result<SafetyClient, CallError> {
        let client = SafetyServiceClient::new(channels.to_provider(endpoint)?);
        Ok(SafetyClient { client, endpoint: endpoint.clone() })
    }

    /// Emergency stop. Returns the state in force after the driver has confirmed that nothing moves.
    ///
    /// # Errors
    /// [`CallError`]: the robot may still move.
    pub async fn stop(&self, reason: &str) -> Result<SafetyState, CallError> {
        let question = v1::EmergencyStopRequest { reason: reason.to_owned() };
        self.state_of(self.client.clone().emergency_stop(question).await.map(|answer| answer.into_inner().state))
    }

    /// Ends an emergency stop. Returns the state in force.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn clear(&self) -> Result<SafetyState, CallError> {
        let answer = self.client.clone().clear_emergency_stop(v1::ClearEmergencyStopRequest {}).await;
        self.state_of(answer.map(|answer| answer.into_inner().state))
    }

    /// Hold: pauses everything that moves. Returns the state in force.
    ///
    /// # Errors
    /// [`CallError`]: the robot may still move.
    pub async fn hold(&self, reason: &str) -> Result<SafetyState, CallError> {
        let question = v1::HoldRequest { reason: reason.to_owned() };
        self.state_of(self.client.clone().hold(question).await.map(|answer| answer.into_inner().state))
    }

    /// Ends a hold. Returns the state in force.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn go_on(&self) -> Result<SafetyState, CallError> {
        let answer = self.client.clone().go_on(v1::GoOnRequest {}).await;
        self.state_of(answer.map(|answer| answer.into_inner().state))
    }

    /// The state in force.
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
