//! One action: acquire, project, run, and the effects at its end. A routine begins as an action does.

use super::{Current, Interpreter, Phase, Target};
use crate::binding::{self, Outputs};
use crate::context::{Context, Made};
use crate::effects;
use crate::plan::NodeNature;
use crate::protocol::{Command, Goal, Note};
use crate::span::span;
use ratn_model::expression::FactExpr;
use ratn_model::fact::{FactKey, Footprint};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::measurement::Evidence;
use ratn_model::program::{ABORTED, PREEMPTED, STOPPED, SUCCESS, StateKind, WORLD_MODEL, is_failure};
use ratn_model::resource::Lease;
use ratn_model::value::Value;

/// The end of a goal, as its provider reports it.
pub(super) struct GoalEnd {
    pub(super) outcome: String,
    pub(super) outputs: Outputs,
    pub(super) measured: Vec<(FactKey, Value)>,
    pub(super) evidence: Evidence,
    pub(super) reason: String,
}

impl Interpreter {
    pub(super) fn begin(&mut self, context: &mut Context<'_>, thread: u64, id: StateId, path: &str) {
        let instance = context.new_instance();
        context.note(Note::Expanded { instance, state: id, path: path.to_owned(), speculative: false });
        let current = Current {
            instance,
            state: id,
            path: path.to_owned(),
            attempt: 1,
            tries: 1,
            crashes: 0,
            has_died: false,
            phase: Phase::Held,
            since: context.now,
            timeout: None,
            lease: None,
            projection: None,
            units: Vec::new(),
        };
        if let Some(thread) = self.threads.get_mut(&thread) {
            thread.current = Some(current);
        }
        self.try_now(context, thread);
    }

    /// Begins a try, unless a precondition does not hold or the operator lets no PIA begin.
    pub(super) fn try_now(&mut self, context: &mut Context<'_>, thread: u64) {
        // Preconditions are checked when it may begin.
        if self.is_held(context, thread) {
            return self.set_phase(thread, Phase::Held);
        }
        if !self.may_try(context, thread) {
            return;
        }
        let Some(current) = self.threads.get(&thread).and_then(|thread| thread.current.as_ref()) else { return };
        let (id, instance) = (current.state, current.instance);
        if self.routine_of(thread).is_some_and(|r| r.lease.is_none() && !r.requirements.is_empty()) {
            return self.set_phase(thread, Phase::Stalled);
        }
        let wanted = &context.plan.state(id).requirements;
        if self.routine_of(thread).is_some() || wanted.is_empty() {
            return self.go_on(context, thread);
        }
        let state = context.program.state(id);
        match self.with_scope(context, thread, None, |scope| binding::requirements(state, wanted, scope)) {
            Ok(requirements) => {
                self.set_phase(thread, Phase::Acquiring);
                context.commands.push(Command::Acquire { instance, requirements, priority: i64::MAX });
            }
            Err(error) => self.end_node(context, thread, error.reason()),
        }
    }

    /// Checks the preconditions in the actual world; if one does not hold, the node ends `aborted`. They are checked before every try, because the
    /// world may have changed since the last one.
    pub(super) fn may_try(&mut self, context: &mut Context<'_>, thread: u64) -> bool {
        let Some(current) = self.current(thread) else { return false };
        let state = context.program.state(current.state);
        let reason = match self.with_scope(context, thread, None, |scope| binding::unmet(state, scope)) {
            Ok(None) => return true,
            Ok(Some(reason)) => reason,
            Err(error) => error.reason(),
        };
        self.end_node(context, thread, reason);
        false
    }

    /// The operator lets PIAs begin: held ones go on.
    pub(super) fn let_go(&mut self, context: &mut Context<'_>) {
        let held: Vec<u64> =
            self.threads.keys().copied().filter(|thread| self.phase(*thread) == Some(Phase::Held)).collect();
        for thread in held {
            let keeps = self.current(thread).is_some_and(|current| current.lease.is_some());
            if !keeps {
                self.try_now(context, thread);
            } else if self.may_try(context, thread) {
                self.go_on(context, thread);
            }
        }
    }

    /// Holds a node that was waiting for its resources. It gives them back, because others may want them, and asks again when it may begin; a
    /// lease with consumed resources is kept. A new projection is made then, because the world may change.
    pub(super) fn hold_back(&mut self, context: &mut Context<'_>, thread: u64) {
        let Some(current) = self.current(thread) else { return };
        current.phase = Phase::Held;
        let mut given = current.take_held();
        if context.plan.state(given.state).uses_up {
            current.lease = given.lease.take();
        }
        self.give_back(context, &given);
    }

    /// Whether the operator does not let a node begin. If it stands at a breakpoint, the run pauses from now on. A routine is one PIA: its parts
    /// are not held.
    pub(super) fn is_held(&mut self, context: &mut Context<'_>, thread: u64) -> bool {
        if self.routine_of(thread).is_some() || !self.is_pia(context, thread) {
            return false;
        }
        let Some(current) = self.threads.get(&thread).and_then(|thread| thread.current.as_ref()) else { return false };
        let (instance, state) = (current.instance, current.state);
        if self.hold.lets_begin(instance, state) {
            return false;
        }
        if self.hold.stops_at(instance, state) {
            context.note(Note::Stopped { instance });
        }
        true
    }

    /// What waits for the operator, at a breakpoint or while the run is paused: a sentence each, as in CDTN mode.
    pub(crate) fn held_back(&self) -> Vec<String> {
        let current = self.threads.values().filter_map(|thread| thread.current.as_ref());
        let held = current.filter(|current| current.phase == Phase::Held);
        held.map(|current| format!("{} waits for the operator", current.path)).collect()
    }

    pub(super) fn is_pia(&self, context: &Context<'_>, thread: u64) -> bool {
        let current = self.threads.get(&thread).and_then(|thread| thread.current.as_ref());
        current.is_some_and(|c| context.plan.state(c.state).nature == NodeNature::Irreversible)
    }

    pub(super) fn granted(&mut self, context: &mut Context<'_>, thread: u64, lease: Lease) {
        if self.phase(thread) != Some(Phase::Acquiring) {
            return;
        }
        if let Some(routine) = self.routine_of_mut(thread) {
            routine.lease = Some(lease);
            return self.go_on_under_new_lease(context, thread);
        }
        if let Some(current) = self.current(thread) {
            current.lease = Some(lease);
        }
        if self.is_held(context, thread) {
            return self.hold_back(context, thread);
        }
        // While it waited for its resources, its preconditions may have become false.
        if self.may_try(context, thread) {
            self.go_on(context, thread);
        }
    }

    /// The node has its resources: it goes on.
    fn go_on(&mut self, context: &mut Context<'_>, thread: u64) {
        let Some(current) = self.threads.get(&thread).and_then(|thread| thread.current.as_ref()) else { return };
        if context.program.state(current.state).is_routine() {
            self.begin_routine(context, thread);
        } else {
            self.project_or_run(context, thread);
        }
    }

    pub(super) fn set_phase(&mut self, thread: u64, phase: Phase) {
        if let Some(current) = self.current(thread) {
            current.phase = phase;
        }
    }

    pub(super) fn project_or_run(&mut self, context: &mut Context<'_>, thread: u64) {
        if self.waits_its_turn(context, thread) {
            return;
        }
        let Some(current) = self.threads.get(&thread).and_then(|thread| thread.current.as_ref()) else { return };
        let analysis = context.plan.state(current.state);
        if !analysis.requirements.iter().any(|r| r.kind == WORLD_MODEL) {
            return self.run(context, thread);
        }
        let lease = self.routine_of(thread).map_or(&current.lease, |routine| &routine.lease);
        let lease = lease.as_ref().map(|l| (l.id, l.token));
        let (instance, attempt, state) = (current.instance, current.attempt, current.state);
        let reads = match &analysis.reads {
            None => Footprint::Everything,
            Some(reads) => self.with_scope(context, thread, None, |s| FactExpr::footprint(reads, s)),
        };
        let (base, changes, writers) = match &self.target {
            Target::Actual => (context.root.revision(), Vec::new(), Vec::new()),
            Target::Projection { base, changes, writers, .. } => (*base, changes.clone(), writers.clone()),
        };
        let is_limited = context.program.state(state).annotations.timeout_s.is_some();
        let first = is_limited || self.is_pia(context, thread);
        self.set_phase(thread, Phase::Projecting);
        context.commands.push(Command::Project { instance, attempt, base, changes, writers, reads, lease, first });
    }

    pub(super) fn run(&mut self, context: &mut Context<'_>, thread: u64) {
        if self.is_held(context, thread) {
            return self.hold_back(context, thread);
        }
        if self.ends_violated(context, thread) {
            return;
        }
        let program = context.program;
        let Some(current) = self.threads.get(&thread).and_then(|thread| thread.current.as_ref()) else { return };
        let state = program.state(current.state);
        let StateKind::Action { provider, action, inputs, .. } = &state.kind else { return };
        if state.is_pause() {
            return self.begin_waiting(context, thread);
        }
        let inputs = match self.with_scope(context, thread, None, |scope| binding::inputs(state, inputs, scope)) {
            Ok(inputs) => inputs,
            Err(error) => return self.end_node(context, thread, error.reason()),
        };
        let (instance, attempt) = (current.instance, current.attempt);
        let tries = if state.annotations.deterministic { 1 } else { current.tries };
        let mut seed = binding::Seed::of(context.seed);
        seed.add(current.path.as_bytes());
        let goal = Goal {
            provider: provider.as_str().into(),
            action: action.as_str().into(),
            inputs,
            seed: seed.of_try(tries),
            lease: self.lease_of(thread),
            projection: current.projection,
            expected_s: self.with_scope(context, thread, None, |scope| binding::expected_s(state, scope)),
            timeout_s: state.annotations.timeout_s,
            // Nothing else runs meanwhile, so an improvement would be useless.
            improves: None,
            reads_nothing: context.plan.state(current.state).reads_nothing(),
        };
        let timeout = state.annotations.timeout_s.map(|seconds| context.now + span(seconds));
        if self.routine_of(thread).is_none() && self.is_pia(context, thread) {
            self.hold.has_begun(instance);
        }
        if let Some(current) = self.current(thread) {
            current.phase = Phase::Running;
            current.since = context.now;
            current.timeout = timeout;
        }
        self.has_begun_something(thread);
        context.commands.extend(timeout.map(|at| Command::Wake { at }));
        context.note(Note::Running { instance, attempt });
        context.commands.push(Command::Start { instance, attempt, goal: Box::new(goal) });
    }

    /// Ends a node `aborted` without a result; it changes nothing in the world.
    pub(super) fn end_node(&mut self, context: &mut Context<'_>, thread: u64, reason: String) {
        self.end_unanswered(context, thread, ABORTED, reason);
    }

    /// Ends a node without a result; not even the declared effects of the outcome are applied.
    pub(super) fn end_unanswered(&mut self, context: &mut Context<'_>, thread: u64, outcome: &str, reason: String) {
        let Some(current) = self.threads.get_mut(&thread).and_then(|thread| thread.current.take()) else { return };
        context.note(Note::Finished { instance: current.instance, outcome: outcome.into() });
        self.give_back(context, &current);
        self.leaves(context, current.instance);
        self.ended(thread, current.state, outcome, format!("{}: {reason}", current.path));
    }

    pub(super) fn finish(&mut self, context: &mut Context<'_>, thread: u64, end: GoalEnd) {
        let GoalEnd { mut outcome, mut outputs, measured, evidence, mut reason } = end;
        let Some(current) = self.threads.get_mut(&thread).and_then(|thread| thread.current.take()) else { return };
        let program = context.program;
        let state = program.state(current.state);
        let (id, instance) = (current.state, current.instance);
        let mut aborted = |outcome: &mut String, problem: String| {
            ABORTED.clone_into(outcome);
            reason = problem;
        };
        if let StateKind::Action { outputs: declared, .. } = &state.kind
            && outcome == SUCCESS
            && let Some(problem) = binding::missing_output(declared, &outputs)
        {
            outputs.clear();
            aborted(&mut outcome, problem);
        }
        if outcome == STOPPED && !program.outcomes(id).any(|known| known == STOPPED) {
            PREEMPTED.clone_into(&mut outcome);
        }
        if !program.outcomes(id).any(|known| known == outcome) {
            let problem = format!("it ended with `{outcome}`, which is no outcome of its action");
            outputs.clear();
            aborted(&mut outcome, problem);
        }
        let mut assigned = Vec::new();
        if !is_failure(&outcome) {
            match self.assigned(context, thread, state, &outputs) {
                Ok(values) => assigned = values,
                Err(problem) => {
                    outputs.clear();
                    aborted(&mut outcome, problem);
                }
            }
        }
        context.note(Note::Finished { instance, outcome: outcome.as_str().into() });
        let nature = context.plan.state(id).nature;
        // The effects that a wait foresees are made by somebody else.
        let declared = if state.is_pause() { Some(&[][..]) } else { effects::declared(state, nature, &outcome) };
        let changes =
            self.with_scope(context, thread, Some(&outputs), |s| effects::actual(declared, &outcome, &measured, s));
        let made = changes.map(|changes| Made { changes, evidence }).map_err(|e| e.to_string());
        let made = made.and_then(|made| self.apply(context, instance, &current.path, made));
        if let Err(problem) = made {
            aborted(&mut outcome, problem);
        } else if outcome == SUCCESS
            && let Err(problem) = self.operate(context, thread, state, instance, &outputs)
        {
            aborted(&mut outcome, problem);
        }
        if !is_failure(&outcome) {
            self.write(id, outputs);
            self.assign(thread, assigned);
        }
        self.give_back(context, &current);
        self.leaves(context, instance);
        let reason = match reason.as_str() {
            _ if outcome == SUCCESS => String::new(),
            // The provider gave no reason.
            "" => current.path,
            reason => format!("{}: {reason}", current.path),
        };
        self.ended(thread, id, outcome, reason);
    }

    /// Notes that the instance is over.
    fn leaves(&self, context: &mut Context<'_>, instance: InstanceId) {
        context.note(match self.target {
            Target::Actual => Note::Retired { instance },
            Target::Projection { .. } => Note::Merged { instance },
        });
    }

    pub(super) fn give_back(&self, context: &mut Context<'_>, current: &Current) {
        let lease = current.lease.as_ref().map(|l| l.id);
        if lease.is_some() || current.projection.is_some() {
            let (instance, projection) = (current.instance, current.projection);
            context.commands.push(Command::Release { instance, lease, projection });
        }
    }
}
