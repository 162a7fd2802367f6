//! Repeated tries of an action: retries and their pauses, timeouts, workers that die.
//!
//! A cancelled or crashed goal changes nothing, because it is not known how far it came.

use super::node::GoalEnd;
use super::{Current, DEFAULT_ATTEMPTS, Interpreter, Phase, Progress};
use crate::context::Context;
use crate::plan::NodeNature;
use crate::protocol::Command;
use crate::span::span;
use ratn_model::id::StateId;
use ratn_model::program::{ABORTED, Program, StateKind};
use ratn_model::resource::ResourceOperation;

impl Interpreter {
    /// Pauses between tries that are over, and goals that have had their time.
    pub(super) fn look_at_the_time(&mut self, context: &mut Context<'_>) -> Progress {
        let all: Vec<u64> = self.threads.keys().copied().collect();
        for thread in all {
            let Some(current) = self.threads.get(&thread).and_then(|thread| thread.current.as_ref()) else { continue };
            let (instance, attempt) = (current.instance, current.attempt);
            match current.phase {
                Phase::Backoff(until) if until <= context.now => self.next_try(context, thread),
                Phase::Running if current.timeout.is_some_and(|at| at <= context.now) => {
                    if context.program.state(current.state).is_pause() {
                        // What has ended already goes on first: who has lost a race by that takes no signal any more.
                        let progress = self.advance(context);
                        if progress != Progress::Busy {
                            return progress;
                        }
                        if self.current(thread).is_some_and(|current| current.instance == instance) {
                            self.waited_long_enough(context, thread);
                        }
                        continue;
                    }
                    let limit = context.program.state(current.state).annotations.timeout_s.unwrap_or_default();
                    context.commands.push(Command::Cancel { instance, attempt });
                    if !self.is_tried_again(context, thread, false) {
                        self.end_node(context, thread, format!("it took longer than {limit} s"));
                    }
                }
                _ => {}
            }
        }
        Progress::Busy
    }

    /// A goal has ended: that is the result, unless it is tried again.
    pub(super) fn goal_ended(&mut self, context: &mut Context<'_>, thread: u64, end: GoalEnd) {
        if end.outcome != ABORTED || !self.is_tried_again(context, thread, false) {
            self.finish(context, thread, end);
        }
    }

    /// After a try that ended `aborted`, or whose worker died: whether there is another one, which begins after its pause.
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

    /// The pause before a try is over.
    fn next_try(&mut self, context: &mut Context<'_>, thread: u64) {
        let Some(current) = self.current(thread) else { return };
        if std::mem::take(&mut current.has_died) {
            self.try_anew(context, thread)
        } else {
            self.try_now(context, thread)
        }
    }

    /// An attempt ended without an answer: a computing or sensing node is tried again, up to its limit. What is behind that limit, and any PIA, counts as
    /// one that ended `aborted`.
    pub(super) fn crashed(&mut self, context: &mut Context<'_>, thread: u64, reason: &str, unknown: bool) {
        let Some(current) = self.current(thread) else { return };
        let (attempt, id) = (current.attempt, current.state);
        match current.phase {
            Phase::Projecting | Phase::Running | Phase::Acquiring => {}
            Phase::Backoff(_) | Phase::Stalled | Phase::Queued(_) => return,
            Phase::Held => {
                // It had not begun: what it held is gone, and it asks again when it may.
                let given = current.take_held();
                current.attempt += 1;
                return self.give_back(context, &given);
            }
        }
        current.crashes += 1;
        let limit = context.program.state(id).annotations.attempts.unwrap_or(DEFAULT_ATTEMPTS);
        let is_irreversible = context.plan.state(id).nature == NodeNature::Irreversible;
        if is_irreversible || current.crashes >= limit {
            // Who may have moved does not move once more.
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

    /// Its worker died: it begins again with other resources, in a routine when that has all of its own anew.
    fn try_anew(&mut self, context: &mut Context<'_>, thread: u64) {
        let Some(current) = self.current(thread) else { return };
        let id = current.state;
        current.phase = Phase::Stalled;
        match self.threads.get(&thread).and_then(|thread| thread.routine) {
            Some(_) if !self.may_try(context, thread) => {}
            // In a race who waits loses: the others keep the lease, and what is left of it has to do.
            Some(routine) if self.uses_lease(context.program, routine) && is_in_race(context.program, id) => {
                self.project_or_run(context, thread);
            }
            Some(_) => {}
            None => self.try_now(context, thread),
        }
    }

    /// A worker of a routine has died and nothing of it moves under the old lease any more: it gives everything back and asks for
    /// all of it again.
    pub(super) fn renew_leases(&mut self, context: &mut Context<'_>) {
        let all: Vec<u64> = self.routines.keys().copied().collect();
        for routine in all {
            self.renew_lease(context, routine);
        }
    }

    fn renew_lease(&mut self, context: &mut Context<'_>, routine: u64) {
        if self.uses_lease(context.program, routine) {
            return;
        }
        // Who waits for a turn asks, too, where whoever has asked was cut short, or pauses while it has the unit whose worker died.
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
        // What its first lease has used up is used up for all of it.
        one.requirements.retain(|required| required.operation != ResourceOperation::Consume);
        let requirements = one.requirements.clone();
        self.know_of_new_lease(routine);
        if requirements.is_empty() {
            return self.go_on_under_new_lease(context, thread);
        }
        self.set_phase(thread, Phase::Acquiring);
        context.commands.push(Command::Acquire { instance, requirements, priority: i64::MAX });
    }

    /// Whoever pauses before its next try finds other resources than those with which its worker died.
    fn know_of_new_lease(&mut self, routine: u64) {
        let threads: Vec<u64> = self.threads_of(routine).collect();
        for thread in threads {
            if let Some(current) = self.current(thread) {
                current.has_died = false;
            }
        }
    }

    /// Who has asked for the routine goes on, and whoever waited with it, unless what they require has been changed meanwhile.
    pub(super) fn go_on_under_new_lease(&mut self, context: &mut Context<'_>, thread: u64) {
        let routine = self.threads.get(&thread).and_then(|thread| thread.routine);
        let stalled = routine.map(|routine| self.stalled(routine)).unwrap_or_default();
        for thread in std::iter::once(thread).chain(stalled) {
            if self.may_try(context, thread) {
                self.project_or_run(context, thread);
            }
        }
    }

    /// Whether anything of a routine moves under its lease, or asks for it.
    fn uses_lease(&self, program: &Program, routine: u64) -> bool {
        let uses = |current: &Current| match current.phase {
            // Whoever waits holds nothing, and may wait for what the others do.
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

    /// What the threads of a routine are at.
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
    /// What it holds, to be given back.
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
