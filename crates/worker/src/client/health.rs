//! Asking gRPC health.

use super::CallError;
use crate::endpoint::{Endpoint, connect};
use std::time::Duration;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

/// The pause between two questions; grows up to the second.
const POLL_INTERVALS: (Duration, Duration) = (Duration::from_millis(2), Duration::from_millis(50));

/// Returns once the server at `endpoint` says SERVING.
///
/// # Errors
/// [`CallError::Broken`] with the last answer when it has not within `deadline`.
pub async fn wait_until_serving(endpoint: &Endpoint, deadline: Duration) -> Result<(), CallError> {
    let mut last = "no answer yet".to_owned();
    let ask = async {
        let mut pause = POLL_INTERVALS.0;
        loop {
            match is_serving(endpoint).await {
                Ok(true) => return,
                Ok(false) => last = "its health is not SERVING".to_owned(),
                Err(reason) => last = reason,
            }
            tokio::time::sleep(pause).await;
            pause = (pause * 2).min(POLL_INTERVALS.1);
        }
    };
    let asked = tokio::time::timeout(deadline, ask).await;
    asked.map_err(|_| CallError::Broken {
        endpoint: endpoint.clone(),
        reason: format!("not serving within {:.1} s: {last}", deadline.as_secs_f64()),
    })
}

async fn is_serving(endpoint: &Endpoint) -> Result<bool, String> {
    let channel = connect(endpoint).await.map_err(|error| super::chain(&error))?;
    let question = HealthCheckRequest { service: String::new() };
    let answer = HealthClient::new(channel).check(question).await.map_err(|status| status.message().to_owned())?;
    Ok(answer.into_inner().status() == ServingStatus::Serving)
}
