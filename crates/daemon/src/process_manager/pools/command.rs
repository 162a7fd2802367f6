//! Events, commands and refusals of the pools.

use crate::process_manager::machine::Sample;
use ratn_proto::types::{Demand, WorkerStatus};
use std::time::Duration;

/// An event of the pools.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// Time has passed. The first one starts every pool.
    Time,
    /// A worker's process was started.
    Spawned {
        /// The worker's id.
        id: String,
        /// Its process id, which is also the id of its process group.
        pid: u32,
        /// Its resource limits, for people.
        limits: String,
    },
    /// A worker's health is SERVING.
    Serving {
        /// The worker's id.
        id: String,
        /// Its endpoint.
        endpoint: String,
    },
    /// A worker that is starting computes: it has asked for processor time since it was last told of.
    Busy {
        /// The worker's id.
        id: String,
    },
    /// The resource manager has accepted the worker's resource.
    Offered {
        /// The worker's id.
        id: String,
    },
    /// The resource manager has not accepted the worker's resource, or not yet.
    Refused {
        /// The worker's id.
        id: String,
        /// The resource manager's reason.
        why: String,
    },
    /// A worker's process has ended, or could not be started.
    Exited {
        /// The worker's id.
        id: String,
        /// How it ended, for people.
        reason: String,
        /// The end of its log; may be empty.
        last_words: String,
    },
    /// The worker's resource was withdrawn after [`Command::Retire`].
    Withdrawn {
        /// The worker's id.
        id: String,
    },
    /// The worker's resource is held, so it was not withdrawn.
    Kept {
        /// The worker's id.
        id: String,
    },
    /// The worker's resource is held now, or no longer held.
    Used {
        /// The worker's id.
        id: String,
        /// Whether it is held.
        held: bool,
    },
    /// The worker has answered [`Command::Check`].
    Answered {
        /// The worker's id.
        id: String,
    },
    /// The worker has not answered [`Command::Check`] in time.
    Unanswered {
        /// The worker's id.
        id: String,
        /// What happened instead, for people.
        why: String,
    },
    /// The present demand for workers that do not exist.
    Demanded(Vec<Demand>),
    /// The present measurements of the machine.
    Looked(Sample),
}

/// A command to the shell.
#[derive(Debug, Clone, PartialEq)]
pub enum Command {
    /// Start a process of a template; answered by [`Event::Spawned`] or [`Event::Exited`].
    Start {
        /// The worker's id.
        id: String,
        /// The template's name.
        template: String,
    },
    /// Send SIGTERM to the worker's process group.
    Terminate {
        /// The worker's id.
        id: String,
    },
    /// Send SIGKILL to the worker's process group.
    Kill {
        /// The worker's id.
        id: String,
    },
    /// Offer the worker to the resource manager; answered by [`Event::Offered`].
    Offer {
        /// The worker, with its endpoint.
        worker: WorkerStatus,
        /// The kind of resource that it is.
        kind: String,
        /// How long the worker's device may go on moving after the worker's end; `None` for a worker without one.
        standstill: Option<Duration>,
    },
    /// Withdraw the worker's resource; its holder loses it.
    Withdraw {
        /// The worker's id.
        id: String,
    },
    /// Withdraw the worker's resource as soon as nobody holds it; answered by [`Event::Withdrawn`] or by [`Event::Kept`]. After the
    /// latter the withdrawal is tried again until [`Command::Keep`].
    Retire {
        /// The worker's id.
        id: String,
    },
    /// Stop trying to withdraw the resource.
    Keep {
        /// The worker's id.
        id: String,
    },
    /// Ask whether the worker still serves; answered by [`Event::Answered`] or [`Event::Unanswered`].
    Check {
        /// The worker's id.
        id: String,
        /// Time for the answer.
        within: Duration,
    },
    /// Notify watchers of this worker.
    Notify(WorkerStatus),
}

/// Why a request is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PoolError {
    /// The config has no such template.
    #[error("there is no template `{template}`; the config has {known}")]
    UnknownTemplate {
        /// The requested name.
        template: String,
        /// The templates of the config.
        known: String,
    },
    /// No such worker.
    #[error("there is no worker `{id}`")]
    UnknownWorker {
        /// Its id.
        id: String,
    },
    /// The pool would have more than its maximum.
    #[error("`{template}` has {wanted} workers of at most {max}: {count} more are too many")]
    TooMany {
        /// The template.
        template: String,
        /// The number of workers that are wanted already.
        wanted: u32,
        /// The template's maximum.
        max: u32,
        /// The number of workers that were requested in addition.
        count: u32,
    },
    /// The config does not allow a pool of this size.
    #[error("`{template}` stays as it is: {why}")]
    Size {
        /// The template.
        template: String,
        /// The rule that is broken.
        why: String,
    },
    /// The host takes no new work.
    #[error("the host `{host}` is drained: `ratn drain --undo {host}` lets it take work again")]
    Drained {
        /// The host's name.
        host: String,
    },
    /// The process manager is ending.
    #[error("the process manager is ending")]
    Ending,
}
