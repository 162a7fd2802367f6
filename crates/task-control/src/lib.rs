//! Task control as a library: runs a task on a system that is up, follows it, and goes on with it after a crash.
//!
//! It owns the shell around `ratn-executive`: it performs the executive's commands over gRPC, brings the answers back as events, and
//! writes both to the event log before anything that cannot be undone happens ([`shell`]). It owns the socket over which a run is
//! paused, ended or asked what it does ([`control`]), the checkpoints of a run ([`checkpoint`]), what a killed run has left
//! ([`history`]), and what logs teach about a task ([`learn`]).
//!
//! It reads no command line, no config and no environment, starts no processes and prints nothing: a caller says where the system is
//! ([`shell::Place`]), where what people read goes ([`Messages`]), and when a run is to end ([`Interrupt`]). Reports are made of the
//! event log by `ratn-report`.

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

/// Where the daemons are that task control speaks with; everyone else is found by leases.
#[derive(Debug, Clone)]
pub struct Endpoints {
    /// The resource manager's.
    pub resource_manager: Endpoint,
    /// The world pool's.
    pub world_pool: Endpoint,
}

/// An error that came before anything was started.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct NotStarted(pub String);
