//! How long to wait for a starting system: for as long as the missing parts are busy, up to a bound.
//!
//! A cell or a worker that reads a robot with many meshes computes for many seconds before it is ready, and for longer on a busy machine. Processor time
//! that is used, or waited for ([`ratn_daemon::processor_demand`]), tells such a process from one that waits for something that never comes.

use ratn_daemon::processor_demand::of_process;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// Maximum time without activity of any missing part.
const IDLE: Duration = Duration::from_secs(30);
/// Maximum time in all, however busy they are.
const LONGEST: Duration = Duration::from_secs(600);
/// A process that has asked for this much more processor time is busy; an idle one wakes up now and then and asks for far less of it in [`IDLE`].
const WORK: Duration = Duration::from_secs(1);
/// Interval at which the missing parts are printed.
const SAID_EVERY: Duration = Duration::from_secs(10);

/// See the module.
#[derive(Debug)]
pub(super) struct Patience {
    began: Instant,
    worked: Instant,
    said: Instant,
    /// For each process, its processor time when it was last found busy.
    counted: BTreeMap<u32, Duration>,
}

/// The result of a check.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Verdict {
    /// Wait on.
    Wait,
    /// Wait on, and print how long it has taken so far.
    Say(Duration),
    /// Waiting is in vain: how long it was, and why.
    GiveUp(Duration, &'static str),
}

impl Patience {
    /// Begins to wait for processes that were started now.
    pub(super) fn new(now: Instant) -> Patience {
        Patience { began: now, worked: now, said: now, counted: BTreeMap::new() }
    }

    /// Checks the processor time that the awaited processes have asked for so far.
    pub(super) fn look(&mut self, now: Instant, used: &BTreeMap<u32, Duration>) -> Verdict {
        for (pid, used) in used {
            let counted = self.counted.entry(*pid).or_default();
            if used.saturating_sub(*counted) >= WORK {
                (*counted, self.worked) = (*used, now);
            }
        }
        let waited = now.duration_since(self.began);
        if waited >= LONGEST {
            return Verdict::GiveUp(waited, "that is the longest that it is waited for");
        }
        if now.duration_since(self.worked) >= IDLE {
            return Verdict::GiveUp(waited, "and nothing that is missing has used processor time for 30 s");
        }
        if now.duration_since(self.said) >= SAID_EVERY {
            self.said = now;
            return Verdict::Say(waited);
        }
        Verdict::Wait
    }
}

/// The processor time that some processes have asked for, and all descendants of these and of `parents`.
pub(super) fn processor_time(of: &[u32], parents: &[u32]) -> BTreeMap<u32, Duration> {
    let entries = std::fs::read_dir("/proc").into_iter().flatten().flatten();
    let pids = entries.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
    let all: BTreeMap<u32, (Duration, u32)> =
        pids.filter_map(|pid| of_process(pid).map(|(demand, parent)| (pid, (demand.total(), parent)))).collect();
    let is_below = |pid: u32| {
        // The chain of parents is bounded by the number of processes.
        let above = std::iter::successors(Some(pid), |pid| all.get(pid).map(|(_, parent)| *parent));
        above.skip(1).take(all.len()).any(|above| of.contains(&above) || parents.contains(&above))
    };
    let counts = all.iter().filter(|(pid, _)| of.contains(pid) || is_below(**pid));
    counts.map(|(pid, (used, _))| (*pid, *used)).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_daemon::processor_demand::TICK;

    /// The result of checking every second a process that uses this percentage of a processor.
    fn after(percent: u32) -> (Duration, &'static str) {
        let began = Instant::now();
        let mut patience = Patience::new(began);
        for second in 1..=LONGEST.as_secs() {
            let passed = Duration::from_secs(second);
            let used = BTreeMap::from([(7, passed * percent / 100)]);
            if let Verdict::GiveUp(waited, why) = patience.look(began + passed, &used) {
                return (waited, why);
            }
        }
        unreachable!("it is waited for ever");
    }

    #[test]
    fn what_works_is_waited_for_up_to_a_bound_and_what_does_not_work_for_30_s() {
        let (waited, why) = after(0);
        assert!(waited == IDLE && why.contains("processor time"), "{waited:?} {why}");
        // A daemon that only waits.
        assert_eq!(after(1).0, IDLE);
        // The share of one process among many on a busy machine.
        let (waited, why) = after(5);
        assert!(waited == LONGEST && why.contains("longest"), "{waited:?} {why}");
    }

    #[test]
    fn what_stops_to_work_is_waited_for_30_s_from_then() {
        let began = Instant::now();
        let mut patience = Patience::new(began);
        let mut look = |second: u64, used_s: u64| {
            patience.look(began + Duration::from_secs(second), &BTreeMap::from([(7, Duration::from_secs(used_s))]))
        };
        assert_eq!(look(5, 1), Verdict::Wait);
        assert_eq!(look(20, 9), Verdict::Say(Duration::from_secs(20)));
        assert_eq!(look(29, 9), Verdict::Wait);
        assert!(matches!(look(49, 9), Verdict::Say(_)));
        assert!(matches!(look(50, 9), Verdict::GiveUp(..)));
    }

    #[test]
    fn the_processor_time_of_a_process_is_that_of_its_children_too() {
        // Busy until it is killed: the kernel counts by ticks, and may miss what is over soon.
        let mut child = std::process::Command::new("sh").args(["-c", "while :; do :; done"]).spawn().unwrap();
        let (own, pid) = (std::process::id(), child.id());
        let begin = Instant::now();
        let found = loop {
            let used = processor_time(&[], &[own]);
            assert!(!used.contains_key(&own));
            if used.get(&pid).is_some_and(|used| *used >= TICK) || begin.elapsed() > Duration::from_secs(60) {
                break used;
            }
            std::thread::sleep(Duration::from_millis(20));
        };
        let of_it = processor_time(&[pid], &[]);
        let end = (child.kill(), child.wait());
        assert!(end.0.is_ok() && end.1.is_ok());
        assert!(found[&pid] >= TICK && of_it[&pid] >= TICK && !of_it.contains_key(&own), "{found:?} {of_it:?}");
    }
}
