//! Hosts, pools and workers as a table and as JSON.

use super::hosts::Answered;
use crate::columns::columns;
use ratn_proto::types::{HostPools, PoolStatus, TrackingMode, WorkerState, WorkerStatus};
use serde_json::{Value, json};

/// A line for each worker; then for each host its tracking mode and whether it is drained, and a line for each pool with something to
/// report.
pub(super) fn table(hosts: &[&HostPools]) -> String {
    let pools = || hosts.iter().flat_map(|host| host.pools.iter().map(move |pool| (*host, pool)));
    let rows = pools().flat_map(|(_, pool)| pool.workers.iter().map(|worker| row(pool, worker)));
    let head = ["WORKER", "KIND", "STATE", "PID", "AGE", "MEMORY", "CPU", "LIMITS"];
    let mut lines = vec![columns(&head, rows.collect())];
    for host in hosts {
        let limit = tracking_limit(host.tracking).map(|limit| format!(" (no cgroups): {limit}")).unwrap_or_default();
        lines.push(format!("host {}: processes are tracked by {}{limit}", host.host, tracking(host.tracking)));
    }
    for host in hosts.iter().filter(|host| host.draining) {
        let left: usize = host.pools.iter().map(|pool| pool.workers.len()).sum();
        let still = if left == 0 { String::new() } else { format!("; {left} workers have not ended yet") };
        lines.push(format!("host {name}: drained{still}; `ratn drain --undo {name}` ends that", name = host.host));
    }
    for (host, pool) in pools() {
        let name = format!("{}@{}", pool.template, host.host);
        let PoolStatus { min, max, crashes, last_exit, failure, .. } = pool;
        if !failure.is_empty() {
            lines.push(format!("{name}: FAILED: {failure}; `ratn pool start {}` tries again", pool.template));
        } else if pool.workers.is_empty() {
            lines.push(format!("{name}: no workers now ({min} to {max})"));
        }
        if *crashes > 0 {
            lines.push(format!("{name}: {crashes} crashed, the last one: {last_exit}"));
        }
    }
    lines.join("\n")
}

/// A line for each host: its workers, and their resource usage.
pub(super) fn hosts(hosts: &[&HostPools]) -> String {
    let row = |host: &&HostPools| {
        let workers = || host.pools.iter().flat_map(|pool| &pool.workers);
        let memory: u64 = workers().map(|worker| worker.resident_bytes).sum();
        let cpu: u32 = workers().map(|worker| worker.cpu_millicores).sum();
        let held = workers().filter(|worker| worker.held).count();
        let crashes: u64 = host.pools.iter().map(|pool| pool.crashes).sum();
        [
            host.host.clone(),
            workers().count().to_string(),
            held.to_string(),
            format!("{} MiB", memory >> 20),
            format!("{} %", cpu / 10),
            crashes.to_string(),
        ]
    };
    columns(&["HOST", "WORKERS", "HELD", "MEMORY", "CPU", "CRASHES"], hosts.iter().map(row).collect())
}

fn tracking(mode: Option<TrackingMode>) -> &'static str {
    match mode {
        Some(TrackingMode::Cgroup) => "cgroup",
        Some(TrackingMode::Subreaper) => "subreaper",
        Some(TrackingMode::Marker) => "marker",
        None => "unknown",
    }
}

/// What the tracking mode misses: processes of a worker that clear their environment and have a session of their own.
fn tracking_limit(mode: Option<TrackingMode>) -> Option<&'static str> {
    match mode {
        Some(TrackingMode::Cgroup) | None => None,
        Some(TrackingMode::Subreaper) => {
            Some("a daemon that a worker starts may outlive a process manager that is killed")
        }
        Some(TrackingMode::Marker) => Some("a daemon that a worker starts may outlive it"),
    }
}

fn row(pool: &PoolStatus, worker: &WorkerStatus) -> [String; 8] {
    [
        worker.id.clone(),
        pool.kind.clone(),
        state(worker).to_owned(),
        if worker.pid == 0 { "-".to_owned() } else { worker.pid.to_string() },
        age(worker.age_s),
        format!("{} MiB", worker.resident_bytes >> 20),
        format!("{:.1} %", f64::from(worker.cpu_millicores) / 10.0),
        if worker.limits.is_empty() { "-".to_owned() } else { worker.limits.clone() },
    ]
}

fn state(worker: &WorkerStatus) -> &'static str {
    match (worker.state, worker.held) {
        (WorkerState::Starting, _) => "starting",
        (WorkerState::Ready, false) => "ready",
        (WorkerState::Ready, true) => "busy",
        (WorkerState::Stopping, _) => "stopping",
        (WorkerState::Exited, _) => "exited",
    }
}

fn age(seconds: u64) -> String {
    match seconds {
        0..60 => format!("{seconds} s"),
        60..3_600 => format!("{} min", seconds / 60),
        3_600..172_800 => format!("{} h", seconds / 3_600),
        _ => format!("{} d", seconds / 86_400),
    }
}

/// Hosts that do not answer have the reason.
pub(super) fn in_json(hosts: &[Answered]) -> Value {
    let host = |one: &Answered| match &one.pools {
        Ok(pools) => json!({
            "host": pools.host, "endpoint": one.host.endpoint.to_string(), "draining": pools.draining,
            "tracking": tracking(pools.tracking),
            "pools": pools.pools.iter().map(pool_json).collect::<Vec<_>>(),
        }),
        Err(error) => {
            json!({ "host": one.host.name, "endpoint": one.host.endpoint.to_string(), "error": error })
        }
    };
    json!({ "hosts": hosts.iter().map(host).collect::<Vec<_>>() })
}

pub(super) fn pool_json(pool: &PoolStatus) -> Value {
    let worker = |worker: &WorkerStatus| {
        json!({
            "id": worker.id, "state": state(worker), "pid": worker.pid, "endpoint": worker.endpoint, "age_s": worker.age_s,
            "resident_bytes": worker.resident_bytes, "cpu_millicores": worker.cpu_millicores, "limits": worker.limits,
        })
    };
    json!({
        "template": pool.template, "kind": pool.kind, "min": pool.min, "max": pool.max, "spares": pool.spares,
        "failure": pool.failure, "crashes": pool.crashes, "last_exit": pool.last_exit,
        "workers": pool.workers.iter().map(worker).collect::<Vec<_>>(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_shows_every_worker_and_what_is_to_be_said_of_pools_and_hosts() {
        let worker = |id: &str, state, held| WorkerStatus {
            id: id.to_owned(),
            template: "path-planner".to_owned(),
            state,
            pid: 42,
            endpoint: "unix:/a.sock".to_owned(),
            reason: String::new(),
            resident_bytes: 24 << 20,
            cpu_millicores: 1_015,
            limits: String::new(),
            age_s: 7_300,
            held,
        };
        let pool = |template: &str, workers, failure: &str, last_exit: &str| PoolStatus {
            template: template.to_owned(),
            kind: "PathPlanner".to_owned(),
            min: 0,
            max: 4,
            workers,
            failure: failure.to_owned(),
            spares: 0,
            crashes: u64::from(!last_exit.is_empty()),
            last_exit: last_exit.to_owned(),
        };
        let workers = vec![
            worker("path-planner-1@compute", WorkerState::Ready, true),
            worker("path-planner-2@compute", WorkerState::Ready, false),
        ];
        let killed = "path-planner-0@compute: killed by signal 9";
        let compute = HostPools {
            host: "compute".to_owned(),
            draining: false,
            clock_us: 0,
            tracking: Some(TrackingMode::Cgroup),
            pools: vec![
                pool("path-planner", workers, "", killed),
                pool("detector", vec![], "", ""),
                pool("script", vec![], "5 crashes", ""),
            ],
        };
        let tracking = Some(TrackingMode::Subreaper);
        let control =
            HostPools { host: "control".to_owned(), draining: true, clock_us: 0, tracking, pools: Vec::new() };
        insta::assert_snapshot!(table(&[&compute, &control]), @r"
        WORKER                  KIND         STATE  PID  AGE  MEMORY  CPU      LIMITS
        path-planner-1@compute  PathPlanner  busy   42   2 h  24 MiB  101.5 %  -
        path-planner-2@compute  PathPlanner  ready  42   2 h  24 MiB  101.5 %  -
        host compute: processes are tracked by cgroup
        host control: processes are tracked by subreaper (no cgroups): a daemon that a worker starts may outlive a process manager that is killed
        host control: drained; `ratn drain --undo control` ends that
        path-planner@compute: 1 crashed, the last one: path-planner-0@compute: killed by signal 9
        detector@compute: no workers now (0 to 4)
        script@compute: FAILED: 5 crashes; `ratn pool start script` tries again
        ");
    }
}
