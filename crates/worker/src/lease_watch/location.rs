//! Where the resource manager is, for a provider that somebody else starts: an endpoint, or the file that holds it. A manager that is
//! started again may serve at another endpoint; the file then says so.

use crate::endpoint::{Endpoint, EndpointError};
use crate::runtime_directory::{FindError, wait_for_file};
use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

/// The environment variable by which a process manager tells its workers where the resource manager is.
pub const RESOURCE_MANAGER_VARIABLE: &str = "RATN_RESOURCE_MANAGER";

/// What a location in a file begins with.
const FILE: &str = "file:";
/// How long one wait for the file lasts; then that is said in the log.
const FIND_DEADLINE: Duration = Duration::from_secs(10);
/// How often the file is looked at while the manager serves.
const LOOK_INTERVAL: Duration = Duration::from_millis(500);
/// The pause after a file that cannot be read.
const RETRY_INTERVAL: Duration = Duration::from_millis(100);

/// Where the resource manager is: `http://host:port`, `unix:/path`, or `file:/run/ratn/resource-manager.endpoint`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ManagerLocation {
    /// There, always.
    At(Endpoint),
    /// Where this file says, as of now.
    File(PathBuf),
}

impl ManagerLocation {
    /// What the environment says, if it says something.
    ///
    /// # Errors
    /// Where that is no location.
    pub fn from_environment() -> Result<Option<ManagerLocation>, EndpointError> {
        match std::env::var(RESOURCE_MANAGER_VARIABLE) {
            Ok(said) if !said.is_empty() => said.parse().map(Some),
            _ => Ok(None),
        }
    }

    /// Where it is, as soon as that is known.
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

    /// Returns when the manager is somewhere else than there. A file that is gone, or holds nonsense, says nothing.
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
