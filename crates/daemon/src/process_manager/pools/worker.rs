//! The life of one worker.
//!
//! ```text
//!            start               SERVING            resource there          idle, or stop asked
//!   (none) ────────▶ starting ───────────▶ serving ────────────────▶ ready ────────────────────▶ leaving
//!                       │ too late           │ not answering           │ ▲ held: it stays          │ withdrawn, or
//!                       ▼                    ▼                         ▼ └──────── (idle) ─────────┤ its time is over
//!                     failed (killed; its exit is a crash) ◀───────────┴───────────────────────────┤
//!                                                                          stopping (SIGTERM, later SIGKILL) ◀┘
//! ```
//! The number of workers, and what follows the end of one, are decided elsewhere.

use super::command::Command;
use super::liveness;
use crate::process_manager::template::Template;
use ratn_model::time::Timestamp;
use ratn_proto::types::{WorkerState, WorkerStatus};
use std::time::Duration;

/// Maximum time until a worker is ready that computes all the while, unless its start timeout is longer.
const LONGEST_START: Duration = Duration::from_secs(600);

#[derive(Debug)]
pub(super) struct Worker {
    id: String,
    template: String,
    phase: Phase,
    /// Since when it serves.
    serves_since: Option<Timestamp>,
    /// Since when its resource is not held; `None` while it is held.
    idle_since: Option<Timestamp>,
    liveness: liveness::Liveness,
    /// The resource manager refuses its resource: the end of the wait for that, and the reason.
    refused: Option<(Timestamp, String)>,
    /// It is to be replaced.
    outdated: bool,
    /// It moves nothing: it was not offered yet, or was withdrawn after nobody had held it for its bound.
    at_rest: bool,
    /// How long its device may go on moving after the worker's end; `None` for a worker without one.
    standstill: Option<Duration>,
    pid: u32,
    /// Its resource limits, for people.
    limits: String,
    endpoint: String,
}

#[derive(Debug, Clone, PartialEq)]
enum Phase {
    /// Killed at `until`, which is put off while it computes: up to `last`.
    Starting {
        until: Timestamp,
        last: Timestamp,
    },
    /// Not offered while an earlier worker's device may still move for its former holder.
    Serving {
        offered: bool,
    },
    Ready,
    /// Its resource is withdrawn as soon as nobody holds it; at `until` at the latest, where it was asked to stop.
    Leaving {
        until: Option<Timestamp>,
    },
    /// Killed for the reason `why`: its exit counts as a crash.
    Failed {
        why: String,
    },
    /// To be killed at `kill_at`; `None` when it has been killed.
    Stopping {
        kill_at: Option<Timestamp>,
    },
}

impl Worker {
    /// A worker whose process is being started now.
    pub(super) fn starting(now: Timestamp, id: String, template: &Template) -> Worker {
        Worker {
            id,
            template: template.name.clone(),
            phase: Phase::Starting {
                until: now + template.start_timeout(),
                last: now + template.start_timeout().max(LONGEST_START),
            },
            serves_since: None,
            idle_since: Some(now),
            liveness: liveness::Liveness::of(template),
            refused: None,
            outdated: false,
            at_rest: true,
            standstill: template.standstill(),
            pid: 0,
            limits: String::new(),
            endpoint: String::new(),
        }
    }

    pub(super) fn id(&self) -> &str {
        &self.id
    }

    /// Sets how long its device may go on moving after the worker's end.
    pub(super) fn with_standstill(self, standstill: Option<Duration>) -> Worker {
        Worker { standstill, ..self }
    }

    /// Its process was started. A worker that was to end before that is ended now.
    pub(super) fn spawned(&mut self, pid: u32, limits: String, commands: &mut Vec<Command>) {
        (self.pid, self.limits) = (pid, limits);
        match self.phase {
            Phase::Stopping { kill_at: Some(_) } => commands.push(Command::Terminate { id: self.id.clone() }),
            Phase::Stopping { kill_at: None } | Phase::Failed { .. } => {
                commands.push(Command::Kill { id: self.id.clone() });
            }
            Phase::Starting { .. } | Phase::Serving { .. } | Phase::Ready | Phase::Leaving { .. } => {}
        }
        commands.push(Command::Notify(self.status()));
    }

    /// It computes while it starts: its start timeout begins anew.
    pub(super) fn busy(&mut self, now: Timestamp, template: &Template) {
        if let Phase::Starting { until, last } = &mut self.phase {
            *until = (now + template.start_timeout()).min(*last).max(*until);
        }
    }

    /// It serves, and can be offered; ignored where its start timeout is over.
    pub(super) fn serving(&mut self, now: Timestamp, endpoint: &str) {
        if self.is_starting() {
            self.phase = Phase::Serving { offered: false };
            self.serves_since = Some(now);
            self.liveness.answered(now);
            endpoint.clone_into(&mut self.endpoint);
        }
    }

    /// Offers it as a resource of `kind`, where it serves and was not offered yet.
    pub(super) fn offer(&mut self, kind: &str, commands: &mut Vec<Command>) {
        if self.waits_for_rest() {
            self.phase = Phase::Serving { offered: true };
            self.at_rest = false;
            let standstill = self.standstill;
            commands.push(Command::Offer { worker: self.status(), kind: kind.to_owned(), standstill });
        }
    }

    /// Whether it serves and is not offered yet.
    pub(super) fn waits_for_rest(&self) -> bool {
        self.phase == Phase::Serving { offered: false }
    }

    /// A health check is due now.
    pub(super) fn ask_at_once(&mut self, now: Timestamp) {
        self.liveness.ask_at_once(now);
    }

    /// The resource manager refuses its resource. That may be temporary, for example while an earlier session still has a resource with
    /// this id: it is waited for until then.
    pub(super) fn refused(&mut self, until: Timestamp, why: &str) {
        if matches!(self.phase, Phase::Serving { .. }) {
            let (_, words) = self.refused.get_or_insert_with(|| (until, String::new()));
            why.clone_into(words);
        }
    }

    /// Its resource was accepted.
    pub(super) fn offered(&mut self, now: Timestamp, commands: &mut Vec<Command>) {
        self.refused = None;
        if matches!(self.phase, Phase::Serving { .. }) {
            self.phase = Phase::Ready;
            self.idle_since = self.idle_since.and(Some(now));
            commands.push(Command::Notify(self.status()));
        }
    }

    /// It is held now, or no longer held.
    pub(super) fn used(&mut self, now: Timestamp, held: bool, commands: &mut Vec<Command>) {
        match (held, self.idle_since) {
            (true, _) => self.idle_since = None,
            (false, None) => self.idle_since = Some(now),
            (false, Some(_)) => return,
        }
        if !held && matches!(self.phase, Phase::Leaving { .. }) {
            commands.push(Command::Retire { id: self.id.clone() });
        }
    }

    /// Withdraws its resource as soon as nobody holds it, and then ends it; if it is held again meanwhile, it stays.
    pub(super) fn retire(&mut self, commands: &mut Vec<Command>) {
        if self.phase == Phase::Ready {
            self.phase = Phase::Leaving { until: None };
            commands.push(Command::Retire { id: self.id.clone() });
        }
    }

    /// Its resource was granted before it could be withdrawn.
    pub(super) fn kept(&mut self, now: Timestamp, commands: &mut Vec<Command>) {
        if self.phase == (Phase::Leaving { until: None }) {
            self.phase = Phase::Ready;
            self.idle_since = self.idle_since.and(Some(now));
            commands.push(Command::Keep { id: self.id.clone() });
        }
    }

    /// Its resource was withdrawn as requested: it can no longer be granted.
    ///
    /// The motion of its last holder may go on for the bound after the release: a goal that was cancelled may overrun.
    pub(super) fn withdrawn(&mut self, now: Timestamp, kill_at: Timestamp, commands: &mut Vec<Command>) {
        if matches!(self.phase, Phase::Leaving { .. }) {
            let bound = self.standstill.unwrap_or_default();
            self.at_rest = self.idle_since.is_some_and(|since| since + bound <= now);
            self.stop(kill_at, commands);
        }
    }

    /// Ends it once nobody holds its resource, at `until` at the latest. False where it is ending already.
    pub(super) fn drain(&mut self, until: Timestamp, kill_at: Timestamp, commands: &mut Vec<Command>) -> bool {
        match self.phase {
            Phase::Ready => {
                self.phase = Phase::Leaving { until: Some(until) };
                commands.push(Command::Retire { id: self.id.clone() });
                true
            }
            Phase::Leaving { until: None } => {
                self.phase = Phase::Leaving { until: Some(until) };
                true
            }
            Phase::Leaving { .. } => false,
            Phase::Starting { .. } | Phase::Serving { .. } | Phase::Failed { .. } | Phase::Stopping { .. } => {
                self.stop(kill_at, commands)
            }
        }
    }

    /// Marks it for replacement. False where it is ending already.
    pub(super) fn outdate(&mut self) -> bool {
        self.outdated = !self.is_leaving();
        self.outdated
    }

    /// Ends it now: killed if it has not ended at `kill_at`. False where it is ending already.
    pub(super) fn stop(&mut self, kill_at: Timestamp, commands: &mut Vec<Command>) -> bool {
        if matches!(self.phase, Phase::Stopping { .. }) {
            return false;
        }
        self.phase = Phase::Stopping { kill_at: Some(kill_at) };
        commands.push(Command::Withdraw { id: self.id.clone() });
        commands.push(Command::Terminate { id: self.id.clone() });
        true
    }

    /// Its session belongs to another caller: it is ended now, and until its process has ended it may move something for that caller.
    pub(super) fn disown(&mut self, kill_at: Timestamp, commands: &mut Vec<Command>) {
        self.at_rest = false;
        if !matches!(self.phase, Phase::Failed { .. }) {
            self.stop(kill_at, commands);
        }
    }

    /// A health check found it serving.
    pub(super) fn answered(&mut self, now: Timestamp) {
        self.liveness.answered(now);
    }

    /// A health check failed: it is withdrawn from its holder, and killed.
    pub(super) fn unanswered(&mut self, why: &str, commands: &mut Vec<Command>) {
        if self.is_live() {
            commands.push(Command::Withdraw { id: self.id.clone() });
            self.fail(format!("hung: {why}"), commands);
        }
    }

    /// Does what is due.
    pub(super) fn advance(&mut self, now: Timestamp, template: &Template, commands: &mut Vec<Command>) {
        match self.phase {
            Phase::Starting { until, .. } if until <= now => {
                let Template { start_timeout_s, readiness, .. } = template;
                let why = format!(
                    "not ready within {start_timeout_s} s: {}; it was started as `{}`, and `ratn logs {}` shows what it wrote",
                    readiness.missing(&self.id),
                    template.command_line(),
                    self.id
                );
                self.fail(why, commands);
            }
            Phase::Serving { .. } if self.refused.as_ref().is_some_and(|(until, _)| *until <= now) => {
                let why = self.refused.take().map(|(_, why)| why).unwrap_or_default();
                commands.push(Command::Withdraw { id: self.id.clone() });
                self.fail(format!("its resource is not taken: {why}"), commands);
            }
            Phase::Leaving { until: Some(until) } if until <= now => {
                self.stop(now + template.stop_timeout(), commands);
            }
            Phase::Stopping { kill_at: Some(kill_at) } if kill_at <= now => {
                self.phase = Phase::Stopping { kill_at: None };
                commands.push(Command::Kill { id: self.id.clone() });
            }
            _ => {}
        }
        if self.is_live()
            && let Some(within) = self.liveness.ask(now)
        {
            commands.push(Command::Check { id: self.id.clone(), within });
        }
    }

    fn fail(&mut self, why: String, commands: &mut Vec<Command>) {
        self.phase = Phase::Failed { why };
        commands.push(Command::Kill { id: self.id.clone() });
    }

    /// When the passing of time changes something.
    pub(super) fn deadline(&self) -> Option<Timestamp> {
        let of_phase = match self.phase {
            Phase::Starting { until, .. } => Some(until),
            Phase::Leaving { until } => until,
            Phase::Stopping { kill_at } => kill_at,
            Phase::Serving { .. } => self.refused.as_ref().map(|(until, _)| *until),
            Phase::Ready | Phase::Failed { .. } => None,
        };
        let of_liveness = self.liveness.deadline().filter(|_| self.is_live());
        of_phase.into_iter().chain(of_liveness).min()
    }

    pub(super) fn is_starting(&self) -> bool {
        matches!(self.phase, Phase::Starting { .. })
    }

    pub(super) fn is_ready(&self) -> bool {
        self.phase == Phase::Ready
    }

    /// Whether it was asked to end and is to be replaced.
    pub(super) fn is_leaving(&self) -> bool {
        matches!(self.phase, Phase::Leaving { .. } | Phase::Stopping { .. })
    }

    /// Whether it is to be replaced, and does not end yet.
    pub(super) fn is_outdated(&self) -> bool {
        self.outdated && !self.is_leaving()
    }

    /// Whether its exit was requested.
    pub(super) fn is_stopping(&self) -> bool {
        matches!(self.phase, Phase::Stopping { .. })
    }

    /// Whether its process is being ended.
    pub(super) fn is_ending(&self) -> bool {
        matches!(self.phase, Phase::Stopping { .. } | Phase::Failed { .. })
    }

    /// How long its device may go on moving after the worker's end; `None` where nothing moves.
    pub(super) fn motion(&self) -> Option<Duration> {
        self.standstill.filter(|_| !self.at_rest)
    }

    /// Whether it serves, and has to answer health checks.
    fn is_live(&self) -> bool {
        matches!(self.phase, Phase::Serving { .. } | Phase::Ready | Phase::Leaving { .. })
    }

    /// Whether its resource is held.
    pub(super) fn is_held(&self) -> bool {
        self.idle_since.is_none()
    }

    /// Since when it is ready and not held.
    pub(super) fn idle_since(&self) -> Option<Timestamp> {
        self.idle_since.filter(|_| self.is_ready())
    }

    pub(super) fn serves_since(&self) -> Option<Timestamp> {
        self.serves_since
    }

    pub(super) fn status(&self) -> WorkerStatus {
        let state = match self.phase {
            Phase::Starting { .. } | Phase::Serving { .. } => WorkerState::Starting,
            // It stays ready if it is held again in the same moment.
            Phase::Ready | Phase::Leaving { until: None } => WorkerState::Ready,
            Phase::Leaving { until: Some(_) } | Phase::Failed { .. } | Phase::Stopping { .. } => WorkerState::Stopping,
        };
        let reason = match &self.refused {
            Some((_, why)) => why,
            None if self.waits_for_rest() => "what the one before it moved may still move",
            None => "",
        };
        WorkerStatus {
            id: self.id.clone(),
            template: self.template.clone(),
            state,
            pid: self.pid,
            endpoint: self.endpoint.clone(),
            reason: reason.to_owned(),
            resident_bytes: 0,
            cpu_millicores: 0,
            limits: self.limits.clone(),
            age_s: 0,
            held: self.is_held(),
        }
    }

    /// Its last status, when its process has ended; the reason for killing it takes precedence over how it ended.
    pub(super) fn exited(&self, how: &str) -> WorkerStatus {
        let reason = match &self.phase {
            Phase::Failed { why } => why.clone(),
            _ => how.to_owned(),
        };
        WorkerStatus { state: WorkerState::Exited, reason, ..self.status() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::process_manager::template::Liveness;

    const ID: &str = "planner-1@compute";
    const SELDOM: Liveness = Liveness { interval_s: 1_000.0, timeout_s: 1.0 };

    fn at(seconds: f64) -> Timestamp {
        Timestamp::from_seconds(seconds)
    }

    fn template() -> Template {
        Template {
            start_timeout_s: 3.0,
            stop_timeout_s: 2.0,
            liveness: SELDOM,
            ..Template::new("planner", "PathPlanner")
        }
    }

    fn worker() -> Worker {
        Worker::starting(at(0.0), ID.to_owned(), &template())
    }

    fn ready() -> Worker {
        let mut worker = worker();
        worker.spawned(4711, String::new(), &mut Vec::new());
        worker.serving(at(1.0), "unix:/w");
        worker.offer("PathPlanner", &mut Vec::new());
        worker.offered(at(1.0), &mut Vec::new());
        worker
    }

    fn commands(act: impl FnOnce(&mut Vec<Command>)) -> Vec<Command> {
        let mut commands = Vec::new();
        act(&mut commands);
        commands.retain(|command| !matches!(command, Command::Notify(_)));
        commands
    }

    fn stopped() -> [Command; 2] {
        [Command::Withdraw { id: ID.into() }, Command::Terminate { id: ID.into() }]
    }

    #[test]
    fn a_worker_is_offered_when_it_serves_and_ready_when_its_resource_is_there() {
        let mut worker = worker();
        assert!(commands(|c| worker.spawned(4711, String::new(), c)).is_empty());
        worker.serving(at(1.0), "unix:/w");
        assert_eq!(worker.motion(), None, "nobody can hold it yet");
        let offered = commands(|c| worker.offer("PathPlanner", c));
        assert!(matches!(&offered[..], [Command::Offer { worker, kind, standstill: None }]
            if worker.endpoint == "unix:/w" && worker.pid == 4711 && kind == "PathPlanner"));
        assert_eq!(worker.status().state, WorkerState::Starting);
        worker.offered(at(1.5), &mut Vec::new());
        assert_eq!((worker.status().state, worker.serves_since()), (WorkerState::Ready, Some(at(1.0))));
        assert_eq!(worker.idle_since(), Some(at(1.5)));
    }

    #[test]
    fn one_that_does_not_serve_in_time_is_killed_and_not_offered_any_more() {
        let mut worker = worker();
        assert!(commands(|c| worker.advance(at(2.0), &template(), c)).is_empty());
        assert_eq!(commands(|c| worker.advance(at(3.0), &template(), c)), [Command::Kill { id: ID.into() }]);
        assert!(worker.deadline().is_none());
        worker.serving(at(4.0), "unix:/late");
        assert!(commands(|c| worker.offer("PathPlanner", c)).is_empty());
        // Its process was started only now.
        assert_eq!(commands(|c| worker.spawned(4711, String::new(), c)), [Command::Kill { id: ID.into() }]);
        assert_eq!(
            worker.exited("killed by signal 9").reason,
            format!(
                "not ready within 3 s: its endpoint file {ID}.endpoint is not there, or its gRPC health there does not say SERVING; \
                 it was started as `ratn`, and `ratn logs {ID}` shows what it wrote"
            )
        );
    }

    #[test]
    fn one_whose_resource_is_not_taken_is_killed_after_a_while_and_it_is_said_why() {
        let mut worker = worker();
        worker.serving(at(1.0), "unix:/w");
        worker.offer("PathPlanner", &mut Vec::new());
        worker.refused(at(4.0), "another session has it");
        worker.refused(at(5.0), "another session has it");
        assert_eq!((worker.status().reason.as_str(), worker.deadline()), ("another session has it", Some(at(4.0))));
        assert!(commands(|c| worker.advance(at(3.9), &template(), c)).is_empty());
        let killed = [Command::Withdraw { id: ID.into() }, Command::Kill { id: ID.into() }];
        assert_eq!(commands(|c| worker.advance(at(4.0), &template(), c)), killed);
        assert_eq!(worker.exited("killed by signal 9").reason, "its resource is not taken: another session has it");
        assert!(!worker.is_stopping(), "its exit is a crash");
    }

    #[test]
    fn one_whose_resource_is_taken_in_time_is_ready() {
        let mut worker = worker();
        worker.serving(at(1.0), "unix:/w");
        worker.offer("PathPlanner", &mut Vec::new());
        worker.refused(at(4.0), "a session of before has it");
        worker.offered(at(2.0), &mut Vec::new());
        assert!(commands(|c| worker.advance(at(9.0), &template(), c)).is_empty());
        assert_eq!((worker.is_ready(), worker.status().reason.as_str()), (true, ""));
    }

    #[test]
    fn one_that_is_stopped_is_withdrawn_terminated_and_killed_when_it_stays() {
        let mut worker = worker();
        assert_eq!(commands(|c| assert!(worker.stop(at(5.0), c))), stopped());
        assert!(commands(|c| assert!(!worker.stop(at(9.0), c))).is_empty(), "once");
        assert_eq!(
            commands(|c| worker.spawned(4711, String::new(), c)),
            stopped()[1..],
            "there was nobody to hear it before"
        );
        assert_eq!(worker.deadline(), Some(at(5.0)));
        assert_eq!(commands(|c| worker.advance(at(5.0), &template(), c)), [Command::Kill { id: ID.into() }]);
        assert_eq!(commands(|c| worker.spawned(4711, String::new(), c)), [Command::Kill { id: ID.into() }]);
    }

    #[test]
    fn one_that_retires_ends_when_its_resource_is_gone() {
        let mut worker = ready();
        assert_eq!(commands(|c| worker.retire(c)), [Command::Retire { id: ID.into() }]);
        assert_eq!(commands(|c| worker.withdrawn(at(7.0), at(9.0), c)), stopped());
    }

    #[test]
    fn one_that_moves_something_is_at_rest_when_nobody_has_held_it_for_its_bound() {
        let bound = Duration::from_secs(6);
        for (withdrawn, motion) in [(9.9, Some(bound)), (10.0, None)] {
            let mut worker = ready().with_standstill(Some(bound));
            worker.used(at(2.0), true, &mut Vec::new());
            worker.used(at(4.0), false, &mut Vec::new());
            worker.retire(&mut Vec::new());
            worker.withdrawn(at(withdrawn), at(20.0), &mut Vec::new());
            assert_eq!(worker.motion(), motion, "withdrawn at {withdrawn} s");
        }
    }

    #[test]
    fn one_that_is_held_before_it_could_retire_stays() {
        let mut worker = ready();
        worker.retire(&mut Vec::new());
        assert_eq!(commands(|c| worker.kept(at(5.0), c)), [Command::Keep { id: ID.into() }]);
        assert_eq!((worker.is_ready(), worker.idle_since()), (true, Some(at(5.0))), "until it is heard who holds it");
        worker.used(at(6.0), true, &mut Vec::new());
        worker.used(at(7.0), false, &mut Vec::new());
        assert_eq!(worker.idle_since(), Some(at(7.0)));
    }

    #[test]
    fn one_that_is_drained_waits_for_its_holder_and_not_for_ever() {
        for patient in [true, false] {
            let mut worker = ready();
            worker.used(at(2.0), true, &mut Vec::new());
            assert_eq!(commands(|c| assert!(worker.drain(at(30.0), at(4.0), c))), [Command::Retire { id: ID.into() }]);
            assert!(commands(|c| worker.kept(at(3.0), c)).is_empty(), "it leaves all the same");
            assert_eq!((worker.is_leaving(), worker.deadline()), (true, Some(at(30.0))));
            if patient {
                assert_eq!(commands(|c| worker.used(at(9.0), false, c)), [Command::Retire { id: ID.into() }]);
                assert_eq!(commands(|c| worker.withdrawn(at(9.0), at(11.0), c)), stopped());
            } else {
                assert_eq!(commands(|c| worker.advance(at(30.0), &template(), c)), stopped());
                assert_eq!(worker.deadline(), Some(at(32.0)));
            }
        }
    }

    #[test]
    fn one_that_does_not_answer_is_withdrawn_and_killed() {
        let mut worker = ready();
        let killed = [Command::Withdraw { id: ID.into() }, Command::Kill { id: ID.into() }];
        assert_eq!(commands(|c| worker.unanswered("no answer within 1 s", c)), killed);
        assert_eq!(worker.exited("killed by signal 9").reason, "hung: no answer within 1 s");
        assert!(!worker.is_stopping(), "its exit is a crash");
    }
}
