//! Worker crashes while a system starts: the first crash of each pool is reported at once, and a pool that has given up while its workers are
//! missing ends the start. The caller provides the missing kinds and the pools' status; this module remembers what was reported.

use ratn_proto::types::PoolStatus;
use std::collections::BTreeSet;

/// The crashes reported since the start began.
#[derive(Debug, Default)]
pub(super) struct Crashes {
    /// Templates of which a crash was reported.
    told: BTreeSet<String>,
}

impl Crashes {
    /// A sentence for each pool whose first crash is new. Pools that still restart their workers may recover.
    pub(super) fn news(&mut self, pools: &[PoolStatus]) -> Vec<String> {
        let crashed = pools.iter().filter(|pool| pool.crashes > 0 && pool.failure.is_empty());
        let new = crashed.filter(|pool| self.told.insert(pool.template.clone()));
        new.map(|pool| format!("a worker of `{}` has crashed and is started again: {}", pool.template, pool.last_exit))
            .collect()
    }
}

/// Why missing workers will not come, where their pools have given up. `missing` are kinds of resources.
pub(super) fn given_up(pools: &[PoolStatus], missing: &BTreeSet<&str>) -> Option<String> {
    let failed = pools.iter().filter(|pool| !pool.failure.is_empty() && missing.contains(pool.kind.as_str()));
    let why: Vec<String> = failed.map(|pool| format!("`{}` crash-loops: {}", pool.template, pool.failure)).collect();
    (!why.is_empty()).then(|| why.join("; "))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pool(template: &str, crashes: u64, failure: &str) -> PoolStatus {
        PoolStatus {
            template: template.to_owned(),
            kind: template.to_uppercase(),
            min: 1,
            max: 1,
            workers: Vec::new(),
            failure: failure.to_owned(),
            spares: 0,
            crashes,
            last_exit: format!("{template}-{crashes}@compute: exited with status 1"),
        }
    }

    #[test]
    fn the_first_crash_of_a_pool_is_told_once() {
        let mut crashes = Crashes::default();
        assert_eq!(crashes.news(&[pool("eye", 0, ""), pool("ear", 0, "")]), Vec::<String>::new());
        let told = crashes.news(&[pool("eye", 2, ""), pool("ear", 0, "")]);
        let said = "a worker of `eye` has crashed and is started again: eye-2@compute: exited with status 1";
        assert_eq!(told, [said]);
        assert_eq!(crashes.news(&[pool("eye", 3, ""), pool("ear", 1, "")]).len(), 1);
        // A pool that has given up restarts no worker.
        assert_eq!(Crashes::default().news(&[pool("eye", 5, "5 crashes in a row")]), Vec::<String>::new());
    }

    #[test]
    fn a_pool_that_has_given_up_counts_where_its_workers_are_missing() {
        let pools = [pool("eye", 5, "5 crashes in a row; eye-5@compute: exited with status 1"), pool("ear", 1, "")];
        assert_eq!(given_up(&pools, &["EAR"].into()), None);
        let why = "`eye` crash-loops: 5 crashes in a row; eye-5@compute: exited with status 1";
        assert_eq!(given_up(&pools, &["EAR", "EYE"].into()).as_deref(), Some(why));
    }
}
