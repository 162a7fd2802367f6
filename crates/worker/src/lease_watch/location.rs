//! The location of the resource manager, for a provider that another process starts: an endpoint, or a file that contains it. A manager
//! that restarts may serve at another endpoint; the file then contains the new one.

use crate::endpoint::{Endpoint, EndpointError};
use crate::runtime_directory::{FindError, wait_for_file};
use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

/// The environment variable by which a process manager tells its workers where the resource manager is.
pub const RESOURCE_MANAGER_VARIABLE: &str = "RATN_RESOURCE_MANAGER";

/// Prefix of a location in a file.
const FILE: &str = "file:";
/// Maximum duration of one wait for the file; then a log line reports it.
const FIND_DEADLINE: Duration = Duration::from_secs(10);
/// Interval between two checks of the file while the manager serves.
const LOOK_INTERVAL: Duration = Duration::from_millis(500);
/// Pause after a file could not be read.
const RETRY_INTERVAL: Duration = Duration::from_millis(100);

/// Where the resource manager is: `http://host:port`, `unix:/path`, or `file:/run/ratn/resource-manager.endpoint`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ManagerLocation {
    /// A fixed endpoint.
    At(Endpoint),
    /// The endpoint in this file, read anew.
    File(PathBuf),
}

impl ManagerLocation {
    /// The location in the environment variable, if it is set.
    ///
    /// # Errors
    /// The text is not a location.
    pub fn from_environment() -> Result<Option<ManagerLocation>, EndpointError> {
        match std::env::var(RESOURCE_MANAGER_VARIABLE) {
            Ok(said) if !said.is_empty() => said.parse().map(Some),
            _ => Ok(None),
        }
    }

    /// Waits until the manager's endpoint is known.
    pub(crate) async fn find(&self) -> Endpoint {
        let file = match self {
            ManagerLocation::At(endpoint) => return endpoint.clone(),
            ManagerLocation::File(file) => file,
        };
        loop {
            match wait_for_file(file, "resource-manager", FIND_DEADLINE).await {
                Ok(endpoint) => return endpoint,
                Err(error @ FindError::NotInTime { .. }) => tracing::warn!("still waiting: {error}"),
                Err(error) => {
                    tracing::warn!(%error, "the resource manager is not found");
                    tokio::time::sleep(RETRY_INTERVAL).await;
                }
            }
        }
    }

    /// Returns when the manager has moved to another endpoint. A file that is missing or malformed is ignored.
    pub(crate) async fn moved_from(&self, endpoint: &Endpoint) {
        let ManagerLocation::File(file) = self else { return std::future::pending().await };
        loop {
            tokio::time::sleep(LOOK_INTERVAL).await;
            let said = tokio::fs::read_to_string(file).await;
            if said.is_ok_and(|said| said.trim().parse().is_ok_and(|now: Endpoint| now != *endpoint)) {
                return;
            }
        }
    }
}

impl FromStr for ManagerLocation {
    type Err = EndpointError;

    fn from_str(text: &str) -> Result<ManagerLocation, EndpointError> {
        match text.strip_prefix(FILE) {
            Some(file) => Ok(ManagerLocation::File(file.into())),
            None => text.parse().map(ManagerLocation::At),
        }
    }
}

impl fmt::Display for ManagerLocation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ManagerLocation::At(endpoint) => endpoint.fmt(f),
            ManagerLocation::File(file) => write!(f, "{FILE}{}", file.display()),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn a_location_is_an_endpoint_or_a_file_and_says_so_as_it_was_said() {
        for said in ["http://127.0.0.1:4000", "unix:/run/rm.sock", "file:/run/ratn/resource-manager.endpoint"] {
            assert_eq!(said.parse::<ManagerLocation>().unwrap().to_string(), said);
        }
        assert!("nonsense".parse::<ManagerLocation>().is_err());
    }

    #[tokio::test]
    async fn a_manager_that_moved_is_found_where_the_file_says() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("resource-manager.endpoint");
        let location = ManagerLocation::File(file.clone());
        std::fs::write(&file, "http://127.0.0.1:1\n").unwrap();
        let first = location.find().await;
        std::fs::write(&file, "http://127.0.0.1:2\n").unwrap();
        location.moved_from(&first).await;
        assert_eq!(location.find().await.to_string(), "http://127.0.0.1:2");
    }
}
