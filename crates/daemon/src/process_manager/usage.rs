//! Resource usage of workers: resident memory, and processor time between two listings.

use ratn_proto::types::PoolStatus;
use sysinfo::{Pid, ProcessRefreshKind, ProcessesToUpdate, System};

/// Keeps the last measurement, from which processor use is computed.
pub(super) struct Usage {
    /// `None` where the system does not provide it.
    system: Option<System>,
}

impl Usage {
    pub(super) fn new() -> Usage {
        Usage { system: System::new().ok() }
    }

    pub(super) fn fill_in(&mut self, pools: &mut [PoolStatus]) {
        let Some(system) = &mut self.system else { return };
        let workers = || pools.iter().flat_map(|pool| &pool.workers).filter(|worker| worker.pid != 0);
        let pids: Vec<Pid> = workers().map(|worker| Pid::from_u32(worker.pid)).collect();
        let what = ProcessRefreshKind::nothing().with_memory().with_cpu();
        // Unknown values stay 0.
        let _ = system.refresh_processes_specifics(ProcessesToUpdate::Some(&pids), true, what);
        for worker in pools.iter_mut().flat_map(|pool| &mut pool.workers) {
            if let Some(process) = system.process(Pid::from_u32(worker.pid)) {
                worker.resident_bytes = process.memory();
                worker.age_s = process.run_time();
                // Converts percent of a core to thousandths of a core.
                worker.cpu_millicores = (process.cpu_usage() * 10.0).round() as u32;
            }
        }
    }
}
