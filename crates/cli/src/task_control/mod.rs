//! Task control: the shell around the executive. Performs its commands over gRPC and brings the answers back as events.

mod advisor;
pub(crate) mod checkpoint;
pub(crate) mod control;
pub(crate) mod history;
pub(crate) mod learn;
mod ledger;
pub(crate) mod log;
mod outside;
mod performer;
pub(crate) mod progress;
mod record;
mod replay;
pub(crate) mod shell;

pub(crate) use performer::only_run as claim;

use ratn_worker::endpoint::Endpoint;

/// Where the daemons are that task control speaks with; everyone else is found by leases.
#[derive(Debug, Clone)]
pub(crate) struct Endpoints {
    pub(crate) resource_manager: Endpoint,
    pub(crate) world_pool: Endpoint,
}
