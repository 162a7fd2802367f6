//! The environment variables that a process manager sets for its workers: the resource manager that confirms leases, the session that
//! offers the worker's resource, the bound for standstill, when the worker is stuck, and the default address to listen on.

use crate::endpoint::{Endpoint, EndpointError};
use crate::lease_watch::{ManagerLocation, RESOURCE_MANAGER_VARIABLE};
use std::time::Duration;

/// The environment variable with the id of the session that offers the worker's resource. A resource with the same id that another session
/// offers is not this worker, and leases of it do not count.
pub const PROVIDER_SESSION_VARIABLE: &str = "RATN_PROVIDER_SESSION";

/// The environment variable with the `standstill_ms` that the worker's resource is offered with.
pub const STANDSTILL_VARIABLE: &str = "RATN_STANDSTILL_MS";

/// The environment variable with the time, in milliseconds, that a goal which was told to stop may run on after
/// [`STOP_GRACE`](crate::action::STOP_GRACE), at a worker that moves nothing: then the worker ends itself and is replaced. Without the
/// variable no worker does.
pub const STUCK_VARIABLE: &str = "RATN_STUCK_TIMEOUT_MS";

/// The environment variable with the worker's default address: a Unix socket, if the process manager and the resource manager are reachable
/// only over Unix sockets of the runtime directory.
pub const LISTEN_VARIABLE: &str = "RATN_WORKER_LISTEN";

/// The default address of a worker: the one from its process manager, else a free port on loopback.
pub fn listen() -> Endpoint {
    let said = std::env::var(LISTEN_VARIABLE).ok().and_then(|said| said.parse().ok());
    said.unwrap_or_else(Endpoint::loopback)
}

/// The value of [`STUCK_VARIABLE`].
pub(crate) fn stuck_after() -> Result<Option<Duration>, PooledError> {
    milliseconds(STUCK_VARIABLE, "stuck_timeout_s", &std::env::var(STUCK_VARIABLE).unwrap_or_default())
}

/// See the module.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Pooled {
    pub(crate) manager: ManagerLocation,
    /// Empty if not set.
    pub(crate) provider_session: String,
    pub(crate) standstill: Option<Duration>,
}

/// A variable of a pooled worker's environment has an invalid value.
#[derive(Debug, thiserror::Error)]
pub enum PooledError {
    /// The location of the resource manager is invalid.
    #[error("{RESOURCE_MANAGER_VARIABLE}")]
    Location(#[source] EndpointError),
    /// A duration is invalid.
    #[error(
        "{variable} is `{said}`: it has to be a whole number of milliseconds; it comes from `{key}` of the worker's template"
    )]
    Time {
        /// The variable.
        variable: &'static str,
        /// The key of the template that it comes from.
        key: &'static str,
        /// The value.
        said: String,
    },
}

impl Pooled {
    /// The values in the environment; `None` if it names no resource manager.
    pub(crate) fn from_environment() -> Result<Option<Pooled>, PooledError> {
        let Some(manager) = ManagerLocation::from_environment().map_err(PooledError::Location)? else {
            return Ok(None);
        };
        let said = |name| std::env::var(name).unwrap_or_default();
        let standstill = milliseconds(STANDSTILL_VARIABLE, "standstill_ms", &said(STANDSTILL_VARIABLE))?;
        Ok(Some(Pooled { manager, provider_session: said(PROVIDER_SESSION_VARIABLE), standstill }))
    }

    /// Whether a worker that stands still within `needed` keeps the bound of its pool.
    pub(crate) fn allows(&self, needed: Duration) -> bool {
        self.standstill.is_some_and(|bound| bound >= needed)
    }
}

/// Parses a variable's value; `key` is the template key that it comes from.
fn milliseconds(variable: &'static str, key: &'static str, said: &str) -> Result<Option<Duration>, PooledError> {
    let milliseconds = (!said.is_empty()).then(|| said.parse().map(Duration::from_millis));
    milliseconds.transpose().map_err(|_| PooledError::Time { variable, key, said: said.to_owned() })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn what_moves_is_pooled_only_within_a_bound_for_its_standstill() {
        let needed = Duration::from_secs(6);
        let standstill = |said| milliseconds(STANDSTILL_VARIABLE, "standstill_ms", said);
        for (said, allowed) in [("", false), ("0", false), ("5999", false), ("6000", true), ("60000", true)] {
            let (manager, provider_session) = ("http://127.0.0.1:1".parse().unwrap(), "session-1".to_owned());
            let pooled = Pooled { manager, provider_session, standstill: standstill(said).unwrap() };
            assert_eq!(pooled.allows(needed), allowed, "{said}");
        }
        assert!(standstill("6 s").unwrap_err().to_string().contains("`6 s`"));
    }
}
