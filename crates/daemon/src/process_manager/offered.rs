//! What a process manager offers to the resource manager: its host, and every worker that is ready.

use super::HOST_KIND;
use super::config::ProcessManagerConfig;
use ratn_model::resource::ResourceClass;
use ratn_model::value::Value;
use ratn_proto::types::{Resource, WorkerStatus};
use ratn_worker::endpoint::Endpoint;

/// This host, by whose endpoint its process manager is found.
pub(super) fn host(config: &ProcessManagerConfig, endpoint: &Endpoint) -> Resource {
    Resource::new(format!("host@{}", config.host), ResourceClass::System, HOST_KIND)
        .with_endpoint(endpoint)
        .with_attribute("host", Value::String(config.host.clone()))
        .on_host(&config.host)
}

/// A worker, as a resource of `kind`.
pub(super) fn worker(host: &str, worker: &WorkerStatus, kind: &str) -> Resource {
    let resource = Resource::new(&worker.id, ResourceClass::Process, kind);
    // One that is no server has none.
    let resource = if worker.endpoint.is_empty() { resource } else { resource.with_endpoint(&worker.endpoint) };
    resource
        .with_attribute("host", Value::String(host.to_owned()))
        .with_attribute("pid", Value::Int(i64::from(worker.pid)))
        .on_host(host)
}
