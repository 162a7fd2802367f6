//! A client of the gRPC health service.

use super::CallError;
use crate::endpoint::{Endpoint, connect_to_ask};
use crate::tls::ClientTls;
use crate::trace::Traced;
use std::time::Duration;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

/// Pause between two health checks; it grows from the first value to the second.
const POLL_INTERVALS: (Duration, Duration) = (Duration::from_millis(2), Duration::from_millis(50));

/// Error text of [`Health::serving`] for a server that answers, but not with SERVING.
pub const NOT_SERVING: &str = "its health is not SERVING";

/// Checks one server's health, over one connection as long as that lasts.
#[derive(Debug, Clone)]
pub struct Health {
    endpoint: Endpoint,
    tls: ClientTls,
    client: Option<HealthClient<Traced>>,
}

impl Health {
    /// A client for the server at `endpoint`, which need not be there yet.
    pub fn of(endpoint: Endpoint, tls: &ClientTls) -> Health {
        Health { endpoint, tls: tls.clone(), client: None }
    }

    /// Returns when the server answers SERVING.
    ///
    /// # Errors
    /// [`CallError::Broken`] with the last answer if the server has not answered so within `deadline`.
    pub async fn serving(&mut self, deadline: Duration) -> Result<(), CallError> {
        let mut last = "no answer yet".to_owned();
        let asked = tokio::time::timeout(deadline, async {
            let mut pause = POLL_INTERVALS.0;
            loop {
                match self.ask().await {
                    Ok(true) => return,
                    Ok(false) => last = NOT_SERVING.to_owned(),
                    Err(reason) => {
                        last = reason;
                        self.client = None;
                    }
                }
                tokio::time::sleep(pause).await;
                pause = (pause * 2).min(POLL_INTERVALS.1);
            }
        });
        let asked = asked.await;
        asked.map_err(|_| CallError::Broken {
            endpoint: self.endpoint.clone(),
            reason: format!("not serving within {:.1} s: {last}", deadline.as_secs_f64()),
        })
    }

    /// Whether the server answers SERVING now.
    ///
    /// # Errors
    /// Why there is no answer within `deadline`.
    pub async fn is_serving(&mut self, deadline: Duration) -> Result<bool, String> {
        let asked = tokio::time::timeout(deadline, self.ask()).await;
        asked.unwrap_or_else(|_| Err(format!("no answer within {} ms", deadline.as_millis())))
    }

    async fn ask(&mut self) -> Result<bool, String> {
        let client = match &mut self.client {
            Some(client) => client,
            client => {
                let channel = connect_to_ask(&self.endpoint, &self.tls).await.map_err(|error| super::chain(&error))?;
                client.insert(HealthClient::new(channel))
            }
        };
        let question = HealthCheckRequest { service: String::new() };
        let answer = client.check(question).await.map_err(|status| status.message().to_owned())?;
        Ok(answer.into_inner().status() == ServingStatus::Serving)
    }
}

/// Returns when the server at `endpoint` answers SERVING.
///
/// # Errors
/// [`CallError::Broken`] with the last answer if the server has not answered so within `deadline`.
pub async fn wait_until_serving(endpoint: &Endpoint, tls: &ClientTls, deadline: Duration) -> Result<(), CallError> {
    Health::of(endpoint.clone(), tls).serving(deadline).await
}
