//! Job shops: scheduling instances of the standard text format, as tasks.
//!
//! Every operation is an activity that needs its machine and waits for the operation before it in its job. The task
//! lists one job after the other, as a sequential program would execute them.

mod best_known;
mod format;

pub use best_known::best_known;
pub use format::{InvalidJobShop, MAX_OPERATIONS};

use crate::activities::{Activities, Activity};

/// An instance.
#[derive(Debug, Clone, PartialEq)]
pub struct JobShop {
    /// Number of machines.
    pub machines: usize,
    /// Per job, its operations in order: machine and duration.
    pub jobs: Vec<Vec<(usize, f64)>>,
}

impl JobShop {
    /// The operations as activities, one job after the other; each machine is a resource kind with one unit.
    pub fn activities(&self) -> Activities {
        let mut activities = Vec::new();
        for (job, operations) in self.jobs.iter().enumerate() {
            for (number, (machine, duration_s)) in operations.iter().enumerate() {
                activities.push(Activity {
                    name: format!("job{job}_{number}"),
                    duration_s: *duration_s,
                    demands: vec![(*machine, 1)],
                    after: if number > 0 { vec![activities.len() - 1] } else { Vec::new() },
                });
            }
        }
        Activities { kinds: (0..self.machines).map(|machine| (format!("Machine{machine}"), 1)).collect(), activities }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    use super::*;
    use crate::activities::Execution;
    use ratn_executive::protocol::{Event, LogEntry, LogLine};

    fn orders(orders: usize) -> Execution {
        Execution { orders, ..Execution::default() }
    }

    #[test]
    fn operations_of_a_job_follow_each_other_and_a_machine_has_one_at_a_time() {
        let shop = JobShop::parse("2 2\n0 3 1 2\n0 2 1 4\n").unwrap();
        let run = shop.activities().execute(orders(0)).unwrap();
        assert_eq!((run.outcome.as_str(), run.end_s), ("success", 8.0), "job 1 first: its rest is longer");
    }

    #[test]
    fn what_a_look_ahead_promises_is_what_the_run_takes() {
        let shop = JobShop::parse(include_str!("../../../../tests/jobshop/ft06.txt")).unwrap();
        let plain = shop.activities().execute(orders(0)).unwrap();
        let ahead = shop.activities().execute(orders(1000)).unwrap();
        assert!(ahead.end_s < plain.end_s && ahead.end_s >= 55.0, "{} after {}", ahead.end_s, plain.end_s);
        let advice = |line: &LogLine| matches!(line.entry, LogEntry::Event(Event::Advised { .. }));
        assert!(ahead.log.iter().any(advice) && !plain.log.iter().any(advice));
    }
}
