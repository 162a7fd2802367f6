//! Repeated tries of an action: retries with backoff, timeouts, crashed workers.
//!
//! A cancelled or crashed goal changes nothing, because it is not known how far it came.

use super::node::GoalEnd;
use super::{Current, DEFAULT_ATTEMPTS, Interpreter, MAIN, Phase, Progress};
use crate::context::Context;
use crate::plan::NodeNature;
use crate::protocol::Command;
use crate::span::span;
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{ABORTED, Program, StateKind};
use ratn_model::resource::ResourceOperation;
use ratn_model::time::Timestamp;

impl Interpreter {
    /// When the next wait, limit or backoff is over, if it is by now.
    pub(crate) fn next_due(&self, now: Timestamp) -> Option<Timestamp> {
        self.timed(MAIN).map(|turn| turn.at).min().filter(|at| *at <= now)
    }

    /// Ends what is due first, and goes on.
    pub(crate) fn fall_due(&mut self, context: &mut Context<'_>) -> Progress {
        if let Some(turn) = self.timed(MAIN).min() {
            self.time_is_up(context, turn.instance);
        }
        self.advance(context)
    }

    /// The time of a wait is up, a goal has reached its timeout, or a backoff is over.
    pub(crate) fn time_is_up(&mut self, context: &mut Context<'_>, instance: InstanceId) {
        let Some(thread) = self.thread_of(instance) else { return };
        let Some(current) = self.current(thread) else { return };
        let (attempt, state) = (current.attempt, context.program.state(current.state));
        match current.phase {
            Phase::Running if state.is_pause() => self.waited_long_enough(context, thread),
            Phase::Running => {
                let limit = state.annotations.timeout_s.unwrap_or_default();
                context.commands.push(Command::Cancel { instance, attempt });
                if !self.is_tried_again(context, thread, false) {
                    self.end_node(context, thread, format!("it took longer than {limit} s"));
                }
            }
            _ => self.next_try(context, thread),
        }
    }

    /// A goal has been given to its provider, or waits before it is: its timeout counts from then.
    pub(super) fn given(&mut self, context: &mut Context<'_>, thread: u64, is_given: bool) {
        let Some(current) = self.current(thread).filter(|current| current.phase == Phase::Running) else { return };
        if !is_given {
            current.timeout = None;
        } else if current.timeout.is_none() {
            let limit_s = context.program.state(current.state).annotations.timeout_s;
            current.timeout = limit_s.map(|limit_s| context.now + span(limit_s));
            context.commands.extend(current.timeout.map(|at| Command::Wake { at }));
        }
    }

    /// A goal has ended: finishes the node with its result, unless it is tried again.
    pub(super) fn goal_ended(&mut self, context: &mut Context<'_>, thread: u64, end: GoalEnd) {
        if end.outcome != ABORTED || !self.is_tried_again(context, thread, false) {
            self.finish(context, thread, end);
        }
    }

    /// After a try that ended `aborted` or whose worker died: starts the backoff before the next try. False if there is no further try.
    fn is_tried_again(&mut self, context: &mut Context<'_>, thread: u64, has_died: bool) -> bool {
        let Some(current) = self.current(thread) else { return false };
        let retry = context.program.state(current.state).annotations.retry;
        let Some(retry) = retry.filter(|retry| current.tries <= retry.count) else { return false };
        let pause = span(retry.backoff_s * f64::from(2_u32.saturating_pow(current.tries - 1)));
        let given = current.take_held();
        let until = context.now + pause;
        current.tries += 1;
        current.attempt += 1;
        current.phase = Phase::Backoff(until);
        current.has_died = has_died;
        self.give_back(context, &given);
        if pause.is_zero() {
            self.next_try(context, thread);
        } else {
            context.commands.push(Command::Wake { at: until });
        }
        true
    }

    /// The backoff is over: begins the next try.
    fn next_try(&mut self, context: &mut Context<'_>, thread: u64) {
        let Some(current) = self.current(thread) else { return };
        if std::mem::take(&mut current.has_died) {
            self.try_anew(context, thread)
        } else {
            self.try_now(context, thread)
        }
    }

    /// An attempt ended without an answer. A node that computes or senses, or that was refused and so has not begun, is tried again, up to its limit.
    /// Beyond the limit, and for a PIA, it counts as a try that ended `aborted`.
    pub(super) fn crashed(
        &mut self,
        context: &mut Context<'_>,
        thread: u64,
        reason: &str,
        (unknown, refused): (bool, bool),
    ) {
        let Some(current) = self.current(thread) else { return };
        let (attempt, id) = (current.attempt, current.state);
        match current.phase {
            Phase::Projecting | Phase::Running | Phase::Acquiring => {}
            Phase::Backoff(_) | Phase::Stalled | Phase::Queued(_) => return,
            Phase::Held => {
                // The node had not begun. Its lease or projection is gone; it asks again when it may begin.
                let given = current.take_held();
                current.attempt += 1;
                return self.give_back(context, &given);
            }
        }
        current.crashes += 1;
        let limit = context.program.state(id).annotations.attempts.unwrap_or(DEFAULT_ATTEMPTS);
        let is_irreversible = context.plan.state(id).nature == NodeNature::Irreversible;
        if is_irreversible && !refused || current.crashes >= limit {
            // A motion that may have been performed is not repeated.
            if is_irreversible && unknown || !self.is_tried_again(context, thread, true) {
                self.end_node(context, thread, format!("crashed in attempt {attempt}: {reason}"));
            }
            return;
        }
        let given = current.take_held();
        current.attempt += 1;
        self.give_back(context, &given);
        self.try_anew(context, thread);
    }

    /// Begins again after the worker died, with other resources; inside of a routine, when the routine has a new lease.
    fn try_anew(&mut self, context: &mut Context<'_>, thread: u64) {
        let Some(current) = self.current(thread) else { return };
        let id = current.state;
        current.phase = Phase::Stalled;
        match self.threads.get(&thread).and_then(|thread| thread.routine) {
            Some(_) if !self.may_try(context, thread) => {}
            // A node that waits loses its race, so it goes on with what is left of the lease.
            Some(routine) if self.uses_lease(context.program, routine) && is_in_race(context.program, id) => {
                self.project_or_run(context, thread);
            }
            Some(_) => {}
            None => self.try_now(context, thread),
        }
    }

    /// A worker of a routine has died: as soon as nothing of the routine uses its old lease, the routine releases it and acquires all of its resources
    /// again.
    pub(crate) fn renew_leases(&mut self, context: &mut Context<'_>) {
        let all: Vec<u64> = self.routines.keys().copied().collect();
        for routine in all {
            self.renew_lease(context, routine);
        }
    }

    fn renew_lease(&mut self, context: &mut Context<'_>, routine: u64) {
        if self.uses_lease(context.program, routine) {
            return;
        }
        // A queued thread asks, too: the thread that had asked may have been cut short, or may be in backoff with the unit whose worker died.
        let is_away =
            self.routines.get(&routine).is_some_and(|one| one.lease.is_none() && !one.requirements.is_empty());
        let has_died = is_away || self.currents_of(routine).any(Current::lost_its_worker);
        let mut queued = self.queued(routine).filter(|_| has_died);
        let Some(thread) = self.stalled(routine).first().copied().or_else(|| queued.next()) else { return };
        drop(queued);
        let Some(instance) = self.current(thread).map(|current| current.instance) else { return };
        let Some(one) = self.routines.get_mut(&routine) else { return };
        if let Some(lease) = one.lease.take() {
            context.commands.push(Command::Release { instance, lease: Some(lease.id), projection: None });
        }
        // What the first lease consumed stays consumed for the whole routine.
        one.requirements.retain(|required| required.operation != ResourceOperation::Consume);
        let requirements = one.requirements.clone();
        self.know_of_new_lease(routine);
        if requirements.is_empty() {
            return self.go_on_under_new_lease(context, thread);
        }
        self.set_phase(thread, Phase::Acquiring);
        context.commands.push(Command::Acquire { instance, requirements, priority: i64::MAX });
    }

    /// Threads in backoff get the new lease at their next try, not the one whose worker died.
    fn know_of_new_lease(&mut self, routine: u64) {
        let threads: Vec<u64> = self.threads_of(routine).collect();
        for thread in threads {
            if let Some(current) = self.current(thread) {
                current.has_died = false;
            }
        }
    }

    /// The routine has its new lease: the thread that asked and the stalled ones go on, unless their preconditions no longer hold.
    pub(super) fn go_on_under_new_lease(&mut self, context: &mut Context<'_>, thread: u64) {
        let routine = self.threads.get(&thread).and_then(|thread| thread.routine);
        let stalled = routine.map(|routine| self.stalled(routine)).unwrap_or_default();
        for thread in std::iter::once(thread).chain(stalled) {
            if self.may_try(context, thread) {
                self.project_or_run(context, thread);
            }
        }
    }

    /// Whether a thread of a routine is using its lease or asks for a new one.
    fn uses_lease(&self, program: &Program, routine: u64) -> bool {
        let uses = |current: &Current| match current.phase {
            // A state that waits uses no resources, and may wait for what the others do.
            Phase::Running => !program.state(current.state).is_pause(),
            phase => matches!(phase, Phase::Acquiring | Phase::Projecting),
        };
        self.currents_of(routine).any(uses)
    }

    fn stalled(&self, routine: u64) -> Vec<u64> {
        self.threads_of(routine).filter(|thread| self.phase(*thread) == Some(Phase::Stalled)).collect()
    }

    fn queued(&self, routine: u64) -> impl Iterator<Item = u64> {
        self.threads_of(routine).filter(|thread| matches!(self.phase(*thread), Some(Phase::Queued(_))))
    }

    /// The current actions of a routine's threads.
    fn currents_of(&self, routine: u64) -> impl Iterator<Item = &Current> {
        self.threads
            .values()
            .filter(move |thread| thread.routine == Some(routine))
            .filter_map(|one| one.current.as_ref())
    }

    fn threads_of(&self, routine: u64) -> impl Iterator<Item = u64> + '_ {
        self.threads.iter().filter(move |(_, thread)| thread.routine == Some(routine)).map(|(id, _)| *id)
    }
}

impl Current {
    /// Takes its lease and projection, to be given back.
    pub(super) fn take_held(&mut self) -> Current {
        let (lease, projection) = (self.lease.take(), self.projection.take());
        Current { lease, projection, path: String::new(), units: Vec::new(), ..*self }
    }
}

/// Whether a state is inside of a preemptive concurrency.
fn is_in_race(program: &Program, state: StateId) -> bool {
    std::iter::successors(program.state(state).parent, |id| program.state(*id).parent)
        .any(|around| matches!(program.state(around).kind, StateKind::Concurrency { preemptive: true, .. }))
}
