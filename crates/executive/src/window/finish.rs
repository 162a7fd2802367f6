//! The end of a node's attempt: with a result, by a crash, or by a timeout; and retries.

use super::Window;
use super::graph::instance::{Changed, Ended, Held, Instance, Status};
use super::growth::environment::assigned;
use super::waits::{Timer, Wait};
use crate::binding;
use crate::context::{Context, Made};
use crate::effects;
use crate::interpreter::{DEFAULT_ATTEMPTS, Interpreter, Progress};
use crate::plan::gives_outputs;
use crate::protocol::{Command, Event, Note};
use crate::span::span;
use ratn_model::id::InstanceId;
use ratn_model::program::{ABORTED, PREEMPTED, STOPPED, SUCCESS, StateKind};

impl Window {
    /// An attempt has ended, with a result or by a crash.
    pub(super) fn attempt_ended(&mut self, context: &mut Context<'_>, event: Event) {
        let (Event::Finished { instance: id, attempt, .. } | Event::Crashed { instance: id, attempt, .. }) = &event
        else {
            return;
        };
        let (id, attempt) = (*id, *attempt);
        if self.improving.is(id, attempt) {
            return self.improvement_ended(context, id);
        }
        let has_ended = self.graph.get(id).is_some_and(|instance| instance.end_to_take().is_some());
        let node = self.graph.node(id).filter(|node| node.attempt == attempt && !has_ended);
        match (event, node.map(|node| &node.status)) {
            (Event::Finished { outcome, outputs, measured, evidence, reason, .. }, Some(Status::Running(_))) => {
                let changes = Changed::Declared(measured, evidence);
                let Some(instance) = self.graph.get(id) else { return };
                let own = context.plan.state(instance.state);
                let known = own.outcome(&outcome).map(|number| own.outcomes[number].clone());
                let outcome = known.unwrap_or_else(|| outcome.into());
                let answer = Ended { outcome, outputs, reason, changes, in_circles: false };
                self.keep_answer(context, id, &answer);
                self.goal_ended(context, id, answer);
            }
            (
                Event::Crashed { reason, unknown, refused, .. },
                Some(Status::Acquiring { .. } | Status::Granted(_) | Status::Projecting(_) | Status::Running(_)),
            ) => {
                self.crashed(context, id, &reason, (unknown, refused));
            }
            (event, _) => self.in_routine(context, event),
        }
    }

    /// A goal has ended: finishes the node with its result, unless it is tried again.
    pub(super) fn goal_ended(&mut self, context: &mut Context<'_>, id: InstanceId, ended: Ended) {
        let Some(instance) = self.graph.get(id) else { return };
        let tries = instance.node().map_or(1, |node| node.tries);
        let retry = context.program.state(instance.state).annotations.retry;
        let Some(retry) =
            retry.filter(|retry| &*ended.outcome == ABORTED && tries <= retry.count && !instance.is_orphan())
        else {
            return self.finish(context, id, ended);
        };
        let pause_s = retry.backoff_s * f64::from(2_u32.saturating_pow(tries - 1));
        self.give_back(context, id);
        let not_before = context.now + span(pause_s);
        self.graph.try_again(id, not_before);
        self.wait(id, Wait::Backoff);
        self.rest(id);
        if not_before <= context.now {
            self.waits.enqueue(&mut self.graph, id);
        } else {
            self.set_timer(context, pause_s, Timer::Retry(id));
        }
    }

    /// A node's result is known. The end of a motion that conflicts with an older one beside it is taken when that has ended, as if it had lasted
    /// longer: its effects come behind those of the older one, and until they are real it holds its resources.
    pub(super) fn finish(&mut self, context: &mut Context<'_>, id: InstanceId, ended: Ended) {
        let end = self.end_of_answer(context, id, ended.clone());
        let moves = |instance: &&Instance| {
            instance.is_pia() && instance.node().is_some_and(|node| matches!(node.status, Status::Running(_)))
        };
        let motion = self.graph.get(id).filter(moves).filter(|_| !self.is_ending);
        if let Some(older) = motion.and_then(|motion| self.conflict_of_end(context, motion, Some(&end))) {
            self.graph.answer(id, ended);
            return self.wait(id, Wait::World(older));
        }
        self.finish_now(context, id, end);
    }

    /// Takes the end of a motion that has waited for an older one.
    pub(super) fn take_end(&mut self, context: &mut Context<'_>, id: InstanceId) {
        if let Some(end) = self.graph.get(id).and_then(Instance::end_to_take).cloned() {
            self.finish(context, id, end);
        }
    }

    /// The end of a node becomes its result, and its resources go back.
    pub(super) fn finish_now(&mut self, context: &mut Context<'_>, id: InstanceId, ended: Ended) {
        context.note(Note::Finished { instance: id, outcome: ended.outcome.clone() });
        let has_acted = self.graph.node(id).is_some_and(|node| node.status.is_running());
        self.give_back(context, id);
        self.graph.set_acted(id, has_acted);
        self.rest(id);
        self.end_node(context, id, ended);
    }

    /// The end of a node whose goal gave this answer: with the values that the node assigns, or `aborted` if the answer is invalid or a value cannot
    /// be evaluated.
    pub(super) fn end_of_answer(&self, context: &Context<'_>, id: InstanceId, mut ended: Ended) -> Ended {
        let Some(instance) = self.graph.get(id) else { return ended };
        let state = context.program.state(instance.state);
        let own = context.plan.state(instance.state);
        let failed =
            |ended: &Ended, problem: String| Ended { changes: ended.changes.clone(), ..Ended::aborted(problem) };
        if let StateKind::Action { outputs, .. } = &state.kind
            && &*ended.outcome == SUCCESS
            && let Some(problem) = binding::missing_output(outputs, &ended.outputs)
        {
            ended = failed(&ended, problem);
        }
        if &*ended.outcome == STOPPED && own.outcome(STOPPED).is_none() {
            ended.outcome = PREEMPTED.into();
        }
        if own.outcome(&ended.outcome).is_none() {
            let problem = format!("it ended with `{}`, which is no outcome of its action", ended.outcome);
            ended = failed(&ended, problem);
        }
        if let Err(problem) = self.assign(context, id, &mut ended) {
            ended = failed(&ended, problem);
        }
        ended
    }

    /// Ends a node that holds nothing any more. A detached PIA, which its line has already passed, retires at once.
    pub(super) fn end_node(&mut self, context: &mut Context<'_>, id: InstanceId, ended: Ended) {
        self.end_instance(id, ended);
        if self.graph.get(id).is_some_and(Instance::is_detached) {
            self.retire_detached(context, id);
        }
    }

    /// Ends an instance: those that waited for it are examined, and the users of its predicted results are revised.
    pub(super) fn end_instance(&mut self, id: InstanceId, ended: Ended) {
        self.graph.end(id, ended);
        self.memory.mark(id);
        self.waits.wake(&mut self.graph, id);
        self.wake_twins(id);
        self.waits.enqueue(&mut self.graph, id);
    }

    /// A result is known: instances that would compute the same, or wait for one that does, are examined.
    pub(super) fn wake_twins(&mut self, id: InstanceId) {
        for twin in self.results.twins_of(id) {
            self.waits.enqueue(&mut self.graph, twin);
            self.waits.wake(&mut self.graph, twin);
        }
    }

    /// Adds the values that an action assigns to variables to its result.
    pub(super) fn assign(&self, context: &Context<'_>, id: InstanceId, ended: &mut Ended) -> Result<(), String> {
        let Some(instance) = self.graph.get(id) else { return Ok(()) };
        let state = context.program.state(instance.state);
        let is_action = matches!(state.kind, StateKind::Action { .. });
        if state.assign.is_empty() || !is_action || !gives_outputs(&ended.outcome) {
            return Ok(());
        }
        let outputs = ended.outputs.clone();
        let values = self.look(context, id, Some(&outputs), |_, view| {
            let value = |(name, expression): &(String, ratn_model::expression::Expr)| {
                let part = format_args!("`assign` of `{name}`");
                let value = expression.evaluate(view).map_err(binding::BindError::at(part, state));
                value.map(|value| (assigned(name), value)).map_err(|error| error.reason())
            };
            state.assign.iter().map(value).collect::<Result<Vec<_>, String>>()
        });
        ended.outputs.extend(values.unwrap_or(Ok(Vec::new()))?);
        Ok(())
    }

    /// An attempt has ended without an answer.
    fn crashed(&mut self, context: &mut Context<'_>, id: InstanceId, reason: &str, (unknown, refused): (bool, bool)) {
        let Some(instance) = self.graph.get(id) else { return };
        let Some(node) = instance.node() else { return };
        let limit = context.program.state(instance.state).annotations.attempts.unwrap_or(DEFAULT_ATTEMPTS);
        let (is_pia, is_detached, attempt) = (instance.is_pia(), instance.is_detached(), node.attempt);
        let is_held = is_pia && matches!(node.status, Status::Granted(_));
        // A node that had not begun only loses what it held, and asks again when it may.
        if !is_held {
            let crashes = self.graph.count_crash(id);
            // A motion beside which younger ones go on keeps its place: it counts as tried.
            let has_not_begun = refused && !is_detached;
            if is_pia && !has_not_begun || crashes >= limit {
                let ended = Ended::aborted(format!("crashed in attempt {attempt}: {reason}"));
                // A motion that may have been performed is not repeated.
                return if is_pia && unknown {
                    self.finish(context, id, ended)
                } else {
                    self.goal_ended(context, id, ended)
                };
            }
        }
        self.give_back(context, id);
        self.rest(id);
        self.graph.begin_again(id);
        self.waits.enqueue(&mut self.graph, id);
    }

    /// The node holds nothing and runs nothing any more.
    pub(super) fn rest(&mut self, id: InstanceId) {
        self.dispatch.end(id);
        self.waits.wake(&mut self.graph, id);
    }

    /// Gives back what a node holds.
    pub(super) fn give_back(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Held { lease, projection, .. } = self.graph.take_held(id);
        let lease = lease.map(|lease| lease.id);
        if lease.is_some() || projection.is_some() {
            context.commands.push(Command::Release { instance: id, lease, projection });
        }
    }

    /// The run ends while a node is under way at its place in the program: commits its `preempted` effects. What runs ahead leaves no trace.
    fn say_cut_short(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.graph.get(id).filter(|instance| acts_for_real(instance)) else { return };
        let Some(declared) = context.program.state(instance.state).annotations.effects.get(PREEMPTED) else { return };
        let changes =
            self.look(context, id, None, |_, view| effects::actual(Some(declared), PREEMPTED, &[], view).ok());
        if let Some(changes) = changes.flatten() {
            let writer = self.path(context.program, id);
            // Errors do not matter: the run ends anyway.
            let _ = context.commit(id, writer, changes.into());
        }
    }

    /// The run ends while a routine is under way: if it is at its place, what it has changed on its projection so far becomes real.
    fn keep_what_was_made(&mut self, context: &mut Context<'_>, id: InstanceId, made: Made) {
        if self.graph.get(id).is_some_and(acts_for_real) {
            let writer = self.path(context.program, id);
            // Errors do not matter: the run ends anyway.
            let _ = context.commit(id, writer, made);
        }
    }

    /// Cancels or withdraws whatever is under way for a node; it holds nothing afterwards.
    pub(super) fn stop_node(&mut self, context: &mut Context<'_>, id: InstanceId) {
        self.harvest(context, id);
        let Some(node) = self.graph.node(id) else { return };
        let attempt = node.attempt;
        let is_pause = self.graph.get(id).is_some_and(|instance| context.program.state(instance.state).is_pause());
        match &node.status {
            Status::Running(_) if is_pause => {}
            Status::Acquiring { .. } => context.commands.push(Command::Withdraw { instance: id }),
            Status::Projecting(_) => context.commands.push(Command::Cancel { instance: id, attempt }),
            Status::Running(_) => {
                context.commands.push(Command::Cancel { instance: id, attempt });
                if self.is_ending {
                    self.say_cut_short(context, id);
                }
            }
            Status::RunningRoutine(..) => {
                if let Some(interpreter) = self.graph.interpreter(id) {
                    interpreter.abort(context);
                }
                let routine = self.graph.end_routine(id);
                if self.is_ending
                    && let Some(routine) = routine
                {
                    self.keep_what_was_made(context, id, routine.into_made());
                }
            }
            Status::Expanded | Status::Granted(_) | Status::Finished(_) => {}
        }
        self.give_back(context, id);
        self.rest(id);
    }

    // ── routines ──

    /// Passes an event on to the routines that contain its instance.
    pub(super) fn in_routine(&mut self, context: &mut Context<'_>, event: Event) {
        let inside = match &event {
            Event::Granted { instance, .. }
            | Event::Refused { instance, .. }
            | Event::Projected { instance, .. }
            | Event::Delayed { instance, .. }
            | Event::Given { instance, .. }
            | Event::Finished { instance, .. }
            | Event::Crashed { instance, .. }
            | Event::Answered { instance, .. } => *instance,
            _ => return,
        };
        let mut active = self.dispatch.active();
        let routine = active.find(|id| match self.status_of_routine(*id) {
            Some(interpreter) => interpreter.is_at(inside),
            None => false,
        });
        drop(active);
        if let Some(routine) = routine {
            self.with_routine(context, routine, |interpreter, context| interpreter.take(context, event));
        }
    }

    pub(super) fn status_of_routine(&self, id: InstanceId) -> Option<&Interpreter> {
        match &self.graph.node(id)?.status {
            Status::RunningRoutine(interpreter, _) => Some(interpreter),
            _ => None,
        }
    }

    /// Whether a routine goes on in the turn of its line, because what it does is real at once. Others go on by themselves, also one that its line has
    /// passed over.
    pub(super) fn goes_on_in_turn(&self, id: InstanceId) -> bool {
        let is_in_line = self.graph.get(id).is_some_and(|instance| instance.is_head && !instance.is_detached());
        is_in_line && self.status_of_routine(id).is_some_and(Interpreter::is_actual)
    }

    /// Lets something happen inside of a routine under way; handles what comes of it.
    pub(super) fn with_routine<T>(
        &mut self,
        context: &mut Context<'_>,
        id: InstanceId,
        happens: impl FnOnce(&mut Interpreter, &mut Context<'_>) -> T,
    ) -> Option<T> {
        let in_turn = self.goes_on_in_turn(id);
        let interpreter = self.graph.interpreter(id)?;
        let has_asked = interpreter.asks();
        let before = context.commands.len();
        let happened = happens(interpreter, context);
        if !in_turn && interpreter.advance(context) == Progress::Busy {
            interpreter.renew_leases(context);
        }
        let progress = interpreter.progress(context);
        let asks = interpreter.asks() && !has_asked;
        for command in &context.commands[before..] {
            if let Command::Wake { at } = command {
                self.waits.set_timer_at(*at, Timer::Inside(id));
            }
        }
        self.note_crossings_of_routine(context, id, before);
        self.routine_progressed(context, id, progress);
        if asks && let Some(instance) = self.graph.get(id) {
            self.dispatch.asks_again(&self.graph, instance);
            self.make_room(context, id);
        }
        Some(happened)
    }

    pub(super) fn routine_progressed(&mut self, context: &mut Context<'_>, id: InstanceId, progress: Progress) {
        let Progress::Ended { outcome, reason } = progress else { return };
        let Some(state) = self.graph.get(id).map(|instance: &Instance| instance.state) else { return };
        let Some(routine) = self.graph.end_routine(id) else { return };
        // If the state gave no outputs, those that the routine still has are of an earlier visit.
        let own = routine.outputs().get(&state).filter(|_| gives_outputs(&outcome));
        let mut outputs = own.cloned().unwrap_or_default();
        for name in &context.plan.state(state).assigns {
            outputs.extend(routine.variable(name).map(|value| (assigned(name), value.clone())));
        }
        let in_circles = routine.is_in_circles();
        let changes = Changed::Exactly(routine.into_made());
        self.finish(context, id, Ended { outcome: outcome.into(), outputs, reason, changes, in_circles });
    }
}

/// Whether what a node does is real: it is a PIA, or has come to its place in the program.
fn acts_for_real(instance: &Instance) -> bool {
    instance.is_pia() || instance.node().is_some_and(|node| node.is_at_its_place)
}
