//! How much processor time a process has asked for: what it has used, and what it has waited for while others had the processors.
//!
//! That tells a process that computes from one that waits for something else, however busy the machine is: among many others a process may get a
//! hundredth of a processor, or nothing for seconds. The time in the run queue is the second number of `/proc/PID/schedstat`; where the kernel does
//! not keep it, only the time used counts.

use std::fs::read_to_string;
use std::iter::Sum;
use std::time::Duration;

/// Unit of processor time in `proc_pid_stat(5)`: Linux shows programs hundredths of a second on every machine.
pub const TICK: Duration = Duration::from_millis(10);

/// Maximum number of descendants that are looked at.
const DESCENDANTS: usize = 1_000;

/// The processor time that processes have asked for since they began.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Demand {
    /// Time on a processor.
    pub used: Duration,
    /// Time in the run queue, while others had the processors.
    pub waited: Duration,
}

impl Demand {
    /// Both times together.
    pub fn total(&self) -> Duration {
        self.used + self.waited
    }

    /// The share of the total that was waited for, from 0 to 1.
    pub fn waited_share(&self) -> f64 {
        self.waited.as_secs_f64() / self.total().max(TICK).as_secs_f64()
    }
}

impl Sum for Demand {
    fn sum<I: Iterator<Item = Demand>>(all: I) -> Demand {
        all.fold(Demand::default(), |sum, one| Demand { used: sum.used + one.used, waited: sum.waited + one.waited })
    }
}

/// The processor time that a process has asked for, and its parent. `None` if there is no such process.
pub fn of_process(pid: u32) -> Option<(Demand, u32)> {
    let stat = read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The name in the field before may contain spaces and parentheses.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks = |field: usize| fields.get(field)?.parse::<u32>().ok();
    let used = TICK * ticks(11)?.checked_add(ticks(12)?)?;
    let waited = threads(pid).filter_map(|thread| {
        let stat = read_to_string(format!("/proc/{pid}/task/{thread}/schedstat")).ok()?;
        stat.split_whitespace().nth(1)?.parse().ok().map(Duration::from_nanos)
    });
    Some((Demand { used, waited: waited.sum() }, fields.get(1)?.parse().ok()?))
}

/// The processor time that a process and those of its descendants that live have asked for.
pub fn of_tree(pid: u32) -> Demand {
    let (mut tree, mut looked_at) = (vec![pid], 0);
    while looked_at < tree.len() && tree.len() < DESCENDANTS {
        let of = tree[looked_at];
        let children =
            threads(of).filter_map(|thread| read_to_string(format!("/proc/{of}/task/{thread}/children")).ok());
        let children: Vec<u32> = children
            .flat_map(|line| line.split_whitespace().filter_map(|pid| pid.parse().ok()).collect::<Vec<_>>())
            .collect();
        tree.extend(children);
        looked_at += 1;
    }
    tree.into_iter().filter_map(of_process).map(|(demand, _)| demand).sum()
}

fn threads(pid: u32) -> impl Iterator<Item = u32> {
    let entries = std::fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use std::process::Command;
    use std::time::Instant;

    #[test]
    fn time_in_the_run_queue_counts_as_time_that_is_used_does() {
        assert_eq!(of_tree(u32::MAX), Demand::default());
        if read_to_string("/proc/self/schedstat").is_err() {
            return; // This kernel does not keep it.
        }
        let status = read_to_string("/proc/self/status").unwrap();
        let allowed = status.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:")).unwrap();
        let first: String = allowed.trim().chars().take_while(char::is_ascii_digit).collect();
        // Two that compute and take turns on one processor: together they ask for more than there is.
        let busy = || Command::new("taskset").args(["-c", &first, "sh", "-c", "while :; do :; done"]).spawn().unwrap();
        let (begin, mut turns) = (Instant::now(), [busy(), busy()]);
        let is_more = loop {
            let demand: Demand = turns.iter().map(|process| of_tree(process.id())).sum();
            let is_more = demand.waited_share() > 0.2 && demand.total() > begin.elapsed().mul_f64(1.2) + 5 * TICK;
            if is_more || begin.elapsed() > Duration::from_secs(20) {
                break is_more;
            }
            std::thread::sleep(Duration::from_millis(20));
        };
        for process in &mut turns {
            process.kill().unwrap();
            process.wait().unwrap();
        }
        assert!(is_more);
    }
}
