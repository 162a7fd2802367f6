//! Compares a worker's description of itself with the catalogue. Differences are logged when the worker is ready, because a task that
//! was checked against the catalogue would wait for ever or fail.

use ratn_model::catalogue::Catalogue;
use ratn_worker::client::{ActionClient, Channels, DescribeError};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::tls::ClientTls;
use std::sync::Arc;
use std::time::Duration;

/// Timeout of a worker's description; a worker without an answer has none.
const PATIENCE: Duration = Duration::from_secs(2);

/// What a worker is compared with.
#[derive(Debug)]
pub(super) struct Comparison {
    pub(super) catalogue: Arc<Catalogue>,
    /// The kind of resource according to its template.
    pub(super) kind: String,
    pub(super) tls: ClientTls,
}

impl Comparison {
    /// Asks the worker for its description, and logs each difference.
    pub(super) async fn tell(self, id: &str, endpoint: &str) {
        let Ok(endpoint) = endpoint.parse::<Endpoint>() else { return };
        match ActionClient::new(Channels::new(&self.tls)).description(&endpoint, PATIENCE).await {
            Ok(said) => {
                for what in said.mismatches(&self.catalogue, &self.kind) {
                    tracing::warn!(id, "a worker and the catalogue disagree: {what}");
                }
            }
            Err(refused @ DescribeError::Refused(_)) => tracing::warn!(id, "{refused}"),
            // A worker need not have a description.
            Err(unanswered @ DescribeError::Unanswered(_)) => tracing::debug!(id, "{unanswered}"),
        }
    }
}
