//! Events, commands and refusals of the pools.

use crate::process_manager::machine::Sample;
use ratn_proto::types::{Demand, WorkerStatus};
use std::time::Duration;

/// What has happened.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// Time has passed. The first one starts every pool.
    Time,
    /// A worker's process is there.
    Spawned {
        /// The worker's id.
        id: String,
        /// Its process id, also that of its group.
        pid: u32,
        /// What it may use of the machine, for people.
        limits: String,
    },
    /// A worker's health is SERVING.
    Serving {
        /// The worker's id.
        id: String,
        /// Where.
        endpoint: String,
    },
    /// The resource manager has the worker's resource.
    Offered {
        /// The worker's id.
        id: String,
    },
    /// The resource manager does not take the worker's resource, or not yet.
    Refused {
        /// The worker's id.
        id: String,
        /// Its words.
        why: String,
    },
    /// A worker's process is gone, or could not be started.
    Exited {
        /// The worker's id.
        id: String,
        /// How, for people.
        reason: String,
        /// The end of its log; may be empty.
        last_words: String,
    },
    /// The worker's resource is gone, as it was asked to be with [`Command::Retire`].
    Withdrawn {
        /// The worker's id.
        id: String,
    },
    /// The worker's resource is held, so it is not gone.
    Kept {
        /// The worker's id.
        id: String,
    },
    /// Somebody holds the worker's resource now, or nobody any more.
    Used {
        /// The worker's id.
        id: String,
        /// Whether somebody does.
        held: bool,
    },
    /// The worker has answered [`Command::Check`].
    Answered {
        /// The worker's id.
        id: String,
    },
    /// It has not, in time.
    Unanswered {
        /// The worker's id.
        id: String,
        /// What came instead, for people.
        why: String,
    },
    /// What waits for more than exists, as it is now.
    Demanded(Vec<Demand>),
    /// What of the machine is free now.
    Looked(Sample),
}

/// What the shell shall do.
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
        /// What it moves may go on for so long after its end; nothing for one that moves nothing.
        standstill: Option<Duration>,
    },
    /// Withdraw the worker's resource; who holds it loses it.
    Withdraw {
        /// The worker's id.
        id: String,
    },
    /// Withdraw the worker's resource as soon as nobody holds it; answered by [`Event::Withdrawn`] or [`Event::Kept`], after which it
    /// is tried again until [`Command::Keep`].
    Retire {
        /// The worker's id.
        id: String,
    },
    /// Do not try to withdraw it any more.
    Keep {
        /// The worker's id.
        id: String,
    },
    /// Ask whether the worker still serves; answered by [`Event::Answered`] or [`Event::Unanswered`].
    Check {
        /// The worker's id.
        id: String,
        /// How long it has for its answer.
        within: Duration,
    },
    /// Notify those who watch the workers.
    Notify(WorkerStatus),
}

/// A request that is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PoolError {
    /// No such template in the config.
    #[error("there is no template `{template}`; the config has {known}")]
    UnknownTemplate {
        /// What was asked for.
        template: String,
        /// Those there are.
        known: String,
    },
    /// No such worker.
    #[error("there is no worker `{id}`")]
    UnknownWorker {
        /// Which.
        id: String,
    },
    /// The pool would have more than its maximum.
    #[error("`{template}` has {wanted} workers of at most {max}: {count} more are too many")]
    TooMany {
        /// The template.
        template: String,
        /// How many there are to be already.
        wanted: u32,
        /// The template's maximum.
        max: u32,
        /// How many were asked for.
        count: u32,
    },
    /// The config does not allow a pool of this size.
    #[error("`{template}` stays as it is: {why}")]
    Size {
        /// The template.
        template: String,
        /// Which rule is broken.
        why: String,
    },
    /// The host takes no new work.
    #[error("the host `{host}` is drained: `ratn drain --undo {host}` lets it take work again")]
    Drained {
        /// Which.
        host: String,
    },
    /// The process manager is ending.
    #[error("the process manager is ending")]
    Ending,
}
