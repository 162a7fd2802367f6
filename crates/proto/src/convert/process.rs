//! Worker processes and pools.

use super::{Malformed, all, each, label, name};
use crate::types::{HostPools, PoolStatus, TrackingMode, WorkerState, WorkerStatus};
use crate::v1;

impl From<WorkerStatus> for v1::WorkerStatus {
    fn from(worker: WorkerStatus) -> v1::WorkerStatus {
        let state = match worker.state {
            WorkerState::Starting => v1::WorkerState::Starting,
            WorkerState::Ready => v1::WorkerState::Ready,
            WorkerState::Stopping => v1::WorkerState::Stopping,
            WorkerState::Exited => v1::WorkerState::Exited,
        };
        v1::WorkerStatus {
            id: worker.id,
            template: worker.template,
            state: state.into(),
            pid: worker.pid,
            endpoint: worker.endpoint,
            reason: worker.reason,
            resident_bytes: worker.resident_bytes,
            cpu_millicores: worker.cpu_millicores,
            limits: worker.limits,
            age_s: worker.age_s,
            held: worker.held,
        }
    }
}

impl TryFrom<v1::WorkerStatus> for WorkerStatus {
    type Error = Malformed;

    fn try_from(worker: v1::WorkerStatus) -> Result<WorkerStatus, Malformed> {
        name(&worker.id, "id")?;
        name(&worker.template, "template")?;
        label(&worker.endpoint, "endpoint")?;
        let state = match v1::WorkerState::try_from(worker.state) {
            Ok(v1::WorkerState::Starting) => WorkerState::Starting,
            Ok(v1::WorkerState::Ready) => WorkerState::Ready,
            Ok(v1::WorkerState::Stopping) => WorkerState::Stopping,
            Ok(v1::WorkerState::Exited) => WorkerState::Exited,
            Ok(v1::WorkerState::Unspecified) => return Err(Malformed::new("state", "is not set")),
            Err(_) => return Err(Malformed::new("state", format!("{} is no worker state", worker.state))),
        };
        Ok(WorkerStatus {
            id: worker.id,
            template: worker.template,
            state,
            pid: worker.pid,
            endpoint: worker.endpoint,
            reason: worker.reason,
            resident_bytes: worker.resident_bytes,
            cpu_millicores: worker.cpu_millicores,
            limits: worker.limits,
            age_s: worker.age_s,
            held: worker.held,
        })
    }
}

impl From<PoolStatus> for v1::Pool {
    fn from(pool: PoolStatus) -> v1::Pool {
        v1::Pool {
            template: pool.template,
            kind: pool.kind,
            min: pool.min,
            max: pool.max,
            workers: all(pool.workers),
            failure: pool.failure,
            spares: pool.spares,
            crashes: pool.crashes,
            last_exit: pool.last_exit,
        }
    }
}

impl TryFrom<v1::Pool> for PoolStatus {
    type Error = Malformed;

    fn try_from(pool: v1::Pool) -> Result<PoolStatus, Malformed> {
        name(&pool.template, "template")?;
        name(&pool.kind, "kind")?;
        Ok(PoolStatus {
            template: pool.template,
            kind: pool.kind,
            min: pool.min,
            max: pool.max,
            workers: each(pool.workers, "workers")?,
            failure: pool.failure,
            spares: pool.spares,
            crashes: pool.crashes,
            last_exit: pool.last_exit,
        })
    }
}

impl From<HostPools> for v1::ListPoolsResponse {
    fn from(host: HostPools) -> v1::ListPoolsResponse {
        v1::ListPoolsResponse {
            host: host.host,
            pools: all(host.pools),
            draining: host.draining,
            clock_us: host.clock_us,
            tracking: wire_tracking(host.tracking).into(),
        }
    }
}

impl TryFrom<v1::ListPoolsResponse> for HostPools {
    type Error = Malformed;

    fn try_from(answer: v1::ListPoolsResponse) -> Result<HostPools, Malformed> {
        name(&answer.host, "host")?;
        let tracking = match answer.tracking() {
            v1::TrackingMode::Unspecified => None,
            v1::TrackingMode::Cgroup => Some(TrackingMode::Cgroup),
            v1::TrackingMode::Subreaper => Some(TrackingMode::Subreaper),
            v1::TrackingMode::Marker => Some(TrackingMode::Marker),
        };
        let pools = each(answer.pools, "pools")?;
        Ok(HostPools { host: answer.host, draining: answer.draining, clock_us: answer.clock_us, tracking, pools })
    }
}

fn wire_tracking(mode: Option<TrackingMode>) -> v1::TrackingMode {
    match mode {
        None => v1::TrackingMode::Unspecified,
        Some(TrackingMode::Cgroup) => v1::TrackingMode::Cgroup,
        Some(TrackingMode::Subreaper) => v1::TrackingMode::Subreaper,
        Some(TrackingMode::Marker) => v1::TrackingMode::Marker,
    }
}
