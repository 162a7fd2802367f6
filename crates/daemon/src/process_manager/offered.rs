//! Resources that a process manager offers to the resource manager: its host with measurements of the machine, and every worker that is
//! ready.

use super::HOST_KIND;
use super::config::{Labels, ProcessManagerConfig};
use super::machine::Sample;
use ratn_model::resource::ResourceClass;
use ratn_model::value::Value;
use ratn_proto::types::{Resource, WorkerStatus};
use ratn_worker::endpoint::Endpoint;
use std::collections::BTreeMap;
use std::time::Duration;

const MIB: u64 = 1 << 20;

/// The resource of this host, with the endpoint of its process manager.
pub(super) fn host(config: &ProcessManagerConfig, endpoint: &Endpoint) -> Resource {
    let host = of_host(format!("host@{}", config.host), ResourceClass::System, HOST_KIND, &config.host, &config.labels);
    host.with_endpoint(endpoint)
}

/// Adds current measurements: memory and disk in MiB, load and idle processors rounded to hundredths.
pub(super) fn host_with(host: Resource, sample: &Sample) -> Resource {
    let mib = |bytes: u64| Value::Int(i64::try_from(bytes / MIB).unwrap_or(i64::MAX));
    host.with_attribute("cores", Value::Int(sample.cores.into()))
        .with_attribute("load_per_core", rounded(sample.load_per_core))
        .with_attribute("idle_cores", rounded(sample.idle_cores))
        .with_attribute("free_memory_mib", mib(sample.free_memory_bytes))
        .with_attribute("free_disk_mib", mib(sample.free_disk_bytes))
}

/// The resource of its processors, for clients that want some to themselves; `None` where there are none.
pub(super) fn cores(host: &str, labels: &Labels, cores: u32) -> Option<Resource> {
    let resource = of_host(format!("cores@{host}"), ResourceClass::System, "Core", host, labels);
    (cores > 0).then(|| resource.with_capacity(cores))
}

/// The resource of its battery, like the one that the simulated cell offers.
pub(super) fn battery(host: &str, level: f64) -> Resource {
    let resource = Resource::new(format!("battery@{host}"), ResourceClass::System, "Battery").divisible();
    resource.with_attribute("level", rounded(level)).on_host(host)
}

/// The resource of a worker; `standstill` is the time in which a worker's device stops after the worker's end, where it moves one.
pub(super) fn worker(
    host: &str,
    labels: &Labels,
    worker: &WorkerStatus,
    kind: &str,
    standstill: Option<Duration>,
) -> Resource {
    let resource = of_host(worker.id.clone(), ResourceClass::Process, kind, host, labels);
    let resource = match standstill {
        Some(bound) => resource.with_standstill(bound),
        None => resource,
    };
    // A worker that is not a server has no endpoint.
    let resource = if worker.endpoint.is_empty() { resource } else { resource.with_endpoint(&worker.endpoint) };
    resource.with_attribute("pid", Value::Int(i64::from(worker.pid)))
}

/// Attributes that the host and all its present and future workers have in common.
pub(super) fn attributes(host: &str, labels: &Labels) -> BTreeMap<String, Value> {
    let labels = labels.iter().map(|(name, label)| (name.clone(), label.into()));
    labels.chain([("host".to_owned(), Value::String(host.to_owned()))]).collect()
}

fn of_host(id: String, class: ResourceClass, kind: &str, host: &str, labels: &Labels) -> Resource {
    Resource { attributes: attributes(host, labels), ..Resource::new(id, class, kind).on_host(host) }
}

fn rounded(number: f64) -> Value {
    Value::Float((number * 100.0).round() / 100.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_proto::types::{STANDSTILL_ATTRIBUTE, WorkerState};

    #[test]
    fn a_worker_that_moves_something_is_offered_with_the_bound_for_its_standstill() {
        let status = WorkerStatus {
            id: "arm-1@compute".to_owned(),
            template: "arm".to_owned(),
            state: WorkerState::Starting,
            pid: 7,
            endpoint: "unix:/w".to_owned(),
            reason: String::new(),
            resident_bytes: 0,
            cpu_millicores: 0,
            limits: String::new(),
            age_s: 0,
            held: false,
        };
        let bound = |standstill| {
            let offered = worker("compute", &Labels::new(), &status, "Arm", standstill);
            offered.attributes.get(STANDSTILL_ATTRIBUTE).cloned()
        };
        assert_eq!(bound(Some(Duration::from_secs(6))), Some(Value::Int(6_000)));
        assert_eq!(bound(None), None);
    }
}
