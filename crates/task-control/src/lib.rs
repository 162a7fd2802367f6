//! Task control as a library: runs a task on a running system, monitors it, and resumes it after a crash.
//!
//! It contains the shell around `ratn-executive`, which performs the executive's commands over gRPC, returns the answers as events, and writes both
//! to the event log before anything irreversible happens ([`shell`]). It also contains the control socket of a run ([`control`]), checkpoints
//! ([`checkpoint`]), the history of a killed run ([`history`]), and learning from logs ([`learn`]).
//!
//! It reads no command line, config or environment, starts no processes and prints nothing: the caller passes the place of the system
//! ([`shell::Place`]), a receiver of messages for people ([`Messages`]), and the request to end a run ([`Interrupt`]). `ratn-report` makes reports
//! from the event log.

mod advisor;
mod alarm;
mod background_runtime;
pub mod checkpoint;
pub mod control;
mod decided;
pub mod history;
mod interrupt;
pub mod learn;
mod ledger;
mod messages;
mod outside;
mod performer;
pub mod progress;
mod promises;
mod readable;
mod record;
mod replay;
mod safe_on_disk;
pub mod shell;
mod spans;
#[cfg(test)]
mod task_for_tests;
mod waits_for;

pub use background_runtime::BackgroundRuntime;
pub use interrupt::{Interrupt, Interrupter};
pub use messages::Messages;
pub use performer::{RUN_KIND, claim};

use ratn_worker::endpoint::Endpoint;

/// The endpoints of the daemons that task control calls; all others are found by leases.
#[derive(Debug, Clone)]
pub struct Endpoints {
    /// The endpoint of the resource manager.
    pub resource_manager: Endpoint,
    /// The endpoint of the world pool.
    pub world_pool: Endpoint,
}

/// An error that occurred before anything was started.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct NotStarted(pub String);
