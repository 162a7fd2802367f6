//! The life of one worker.
//!
//! ```text
//!            start                health SERVING          resource there
//!   (none) ────────▶ starting ──────────────▶ serving ──────────────▶ ready
//!      ▲                │ too late: kill          │ stop asked: terminate, later kill │
//!      └────────────────┴──────── exited ◀────────┴───────────────────────────────────┘
//! ```
//! How many there are, and what follows one that is gone, is not its business.

use super::command::Command;
use ratn_model::time::Timestamp;
use ratn_proto::types::{WorkerState, WorkerStatus};

#[derive(Debug)]
pub(super) struct Worker {
    id: String,
    template: String,
    phase: Phase,
    pid: u32,
    endpoint: String,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Phase {
    Starting {
        until: Timestamp,
    },
    Serving {
        since: Timestamp,
    },
    Ready {
        since: Timestamp,
    },
    /// Killed because it did not serve in time: its exit is a crash.
    TooLate,
    /// Killed at `kill_at`; without one it has been.
    Stopping {
        kill_at: Option<Timestamp>,
    },
}

impl Worker {
    /// One whose process is being started; it has failed if it does not serve at `until`.
    pub(super) fn starting(id: String, template: &str, until: Timestamp) -> Worker {
        let phase = Phase::Starting { until };
        Worker { id, template: template.to_owned(), phase, pid: 0, endpoint: String::new() }
    }

    pub(super) fn id(&self) -> &str {
        &self.id
    }

    /// Its process is there. One that was to end before is ended now.
    pub(super) fn spawned(&mut self, pid: u32, commands: &mut Vec<Command>) {
        self.pid = pid;
        match self.phase {
            Phase::Stopping { kill_at: Some(_) } => commands.push(Command::Terminate { id: self.id.clone() }),
            Phase::Stopping { kill_at: None } | Phase::TooLate => commands.push(Command::Kill { id: self.id.clone() }),
            Phase::Starting { .. } | Phase::Serving { .. } | Phase::Ready { .. } => {}
        }
        commands.push(Command::Tell(self.status()));
    }

    /// It serves as a resource of `kind`. Too late is too late.
    pub(super) fn serving(&mut self, now: Timestamp, endpoint: &str, kind: &str, commands: &mut Vec<Command>) {
        if self.is_starting() {
            self.phase = Phase::Serving { since: now };
            endpoint.clone_into(&mut self.endpoint);
            commands.push(Command::Offer { worker: self.status(), kind: kind.to_owned() });
        }
    }

    /// Its resource is there.
    pub(super) fn offered(&mut self, commands: &mut Vec<Command>) {
        if let Phase::Serving { since } = self.phase {
            self.phase = Phase::Ready { since };
            commands.push(Command::Tell(self.status()));
        }
    }

    /// Ends it: killed if it has not ended at `kill_at`. False where it is ending already.
    pub(super) fn stop(&mut self, kill_at: Timestamp, commands: &mut Vec<Command>) -> bool {
        if self.is_stopping() {
            return false;
        }
        self.phase = Phase::Stopping { kill_at: Some(kill_at) };
        commands.push(Command::Withdraw { id: self.id.clone() });
        commands.push(Command::Terminate { id: self.id.clone() });
        true
    }

    /// Kills it where its time is over.
    pub(super) fn advance(&mut self, now: Timestamp, commands: &mut Vec<Command>) {
        match self.phase {
            Phase::Starting { until } if until <= now => self.phase = Phase::TooLate,
            Phase::Stopping { kill_at: Some(kill_at) } if kill_at <= now => {
                self.phase = Phase::Stopping { kill_at: None };
            }
            _ => return,
        }
        commands.push(Command::Kill { id: self.id.clone() });
    }

    /// When time alone changes it.
    pub(super) fn deadline(&self) -> Option<Timestamp> {
        match self.phase {
            Phase::Starting { until } => Some(until),
            Phase::Stopping { kill_at } => kill_at,
            Phase::Serving { .. } | Phase::Ready { .. } | Phase::TooLate => None,
        }
    }

    pub(super) fn is_starting(&self) -> bool {
        matches!(self.phase, Phase::Starting { .. })
    }

    /// Whether its end was asked for.
    pub(super) fn is_stopping(&self) -> bool {
        matches!(self.phase, Phase::Stopping { .. })
    }

    /// It was killed because it did not serve in time.
    pub(super) fn is_too_late(&self) -> bool {
        self.phase == Phase::TooLate
    }

    pub(super) fn serves_since(&self) -> Option<Timestamp> {
        match self.phase {
            Phase::Serving { since } | Phase::Ready { since } => Some(since),
            Phase::Starting { .. } | Phase::TooLate | Phase::Stopping { .. } => None,
        }
    }

    pub(super) fn status(&self) -> WorkerStatus {
        let state = match self.phase {
            Phase::Ready { .. } => WorkerState::Ready,
            _ => WorkerState::Starting,
        };
        WorkerStatus {
            id: self.id.clone(),
            template: self.template.clone(),
            state,
            pid: self.pid,
            endpoint: self.endpoint.clone(),
            reason: String::new(),
            resident_bytes: 0,
            cpu_millicores: 0,
        }
    }

    /// As it is told when its process is gone.
    pub(super) fn exited(&self, reason: String) -> WorkerStatus {
        WorkerStatus { state: WorkerState::Exited, reason, ..self.status() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ID: &str = "planner-1@compute";

    fn worker() -> Worker {
        Worker::starting(ID.to_owned(), "planner", Timestamp(3))
    }

    fn commands(act: impl FnOnce(&mut Vec<Command>)) -> Vec<Command> {
        let mut commands = Vec::new();
        act(&mut commands);
        commands.retain(|command| !matches!(command, Command::Tell(_)));
        commands
    }

    #[test]
    fn a_worker_is_offered_when_it_serves_and_ready_when_its_resource_is_there() {
        let mut worker = worker();
        assert!(commands(|c| worker.spawned(4711, c)).is_empty());
        let offered = commands(|c| worker.serving(Timestamp(1), "unix:/w", "PathPlanner", c));
        assert!(matches!(&offered[..], [Command::Offer { worker, kind }]
            if worker.endpoint == "unix:/w" && worker.pid == 4711 && kind == "PathPlanner"));
        assert_eq!(worker.status().state, WorkerState::Starting);
        worker.offered(&mut Vec::new());
        assert_eq!((worker.status().state, worker.serves_since()), (WorkerState::Ready, Some(Timestamp(1))));
    }

    #[test]
    fn one_that_does_not_serve_in_time_is_killed_and_not_offered_any_more() {
        let mut worker = worker();
        assert!(commands(|c| worker.advance(Timestamp(2), c)).is_empty());
        assert_eq!(commands(|c| worker.advance(Timestamp(3), c)), [Command::Kill { id: ID.into() }]);
        assert!(worker.is_too_late() && worker.deadline().is_none());
        assert!(commands(|c| worker.serving(Timestamp(4), "unix:/late", "PathPlanner", c)).is_empty());
        // Its process came only now.
        assert_eq!(commands(|c| worker.spawned(4711, c)), [Command::Kill { id: ID.into() }]);
    }

    #[test]
    fn one_that_is_stopped_is_withdrawn_terminated_and_killed_when_it_stays() {
        let mut worker = worker();
        let stopped = [Command::Withdraw { id: ID.into() }, Command::Terminate { id: ID.into() }];
        assert_eq!(commands(|c| assert!(worker.stop(Timestamp(5), c))), stopped);
        assert!(commands(|c| assert!(!worker.stop(Timestamp(9), c))).is_empty(), "once");
        assert_eq!(commands(|c| worker.spawned(4711, c)), stopped[1..], "there was nobody to hear it before");
        assert_eq!(worker.deadline(), Some(Timestamp(5)));
        assert_eq!(commands(|c| worker.advance(Timestamp(5), c)), [Command::Kill { id: ID.into() }]);
        assert_eq!(commands(|c| worker.spawned(4711, c)), [Command::Kill { id: ID.into() }]);
    }
}
