//! How a node begins: its resources, its projection, its goal.

use super::Window;
use super::environment::assigned;
use super::instance::{Ended, Seen, Status, Wait};
use super::ready::{Readiness, not_bound, senses_of};
use crate::binding::{self, Outputs};
use crate::context::Context;
use crate::interpreter::{Interpreter, Routine, Target};
use crate::plan::NodeNature;
use crate::protocol::{Command, Goal, Note};
use ratn_model::expression::Scope;
use ratn_model::fact::{Change, Footprint};
use ratn_model::id::InstanceId;
use ratn_model::measurement::Evidence;
use ratn_model::program::{ABORTED, StateKind};
use ratn_model::resource::Requirement;
use std::sync::Arc;

impl Window {
    /// Looks at a node that has not begun.
    pub(super) fn begin(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let (readiness, seen, used) = self.readiness(context, id);
        match readiness {
            Readiness::Waits(wait) => self.wait(id, wait),
            Readiness::Failed(reason) => {
                // What made it fail may come out otherwise.
                self.depend(id, &used);
                if let Some(instance) = self.instances.get_mut(id) {
                    instance.seen = Some(Box::new(seen));
                }
                self.fail(context, id, reason);
            }
            Readiness::Ready(requirements, inputs) => self.acquire(context, id, requirements, inputs, seen, &used),
        }
    }

    /// It never began and never will.
    pub(super) fn fail(&mut self, context: &mut Context<'_>, id: InstanceId, reason: String) {
        context.note(Note::Finished { instance: id, outcome: ABORTED.into() });
        let outputs = self.unassigned(context, id);
        self.end_instance(id, Ended { outputs, ..Ended::aborted(reason) });
    }

    /// A routine that did not run leaves the variables that it would assign as they were.
    fn unassigned(&self, context: &Context<'_>, id: InstanceId) -> Outputs {
        let Some(instance) = self.instances.get(id) else { return Outputs::new() };
        let own = self.plan.state(instance.state);
        if !own.is_routine {
            return Outputs::new();
        }
        let view = self.sight(context).view(instance, None);
        let value = |name: &String| Some((assigned(name), view.variable(name)?.into_owned()));
        own.assigns.iter().filter_map(value).collect()
    }

    fn acquire(
        &mut self,
        context: &mut Context<'_>,
        id: InstanceId,
        requirements: Vec<Requirement>,
        inputs: Option<Outputs>,
        seen: Seen,
        used: &[InstanceId],
    ) {
        self.depend(id, used);
        let Some(instance) = self.instances.get_mut(id) else { return };
        let is_pia = instance.is_pia();
        if is_pia {
            instance.seen = None;
        } else {
            if !instance.seen.as_deref().is_some_and(|before| before.is_like(&seen)) {
                // What failed before was made of something else: its tries begin again.
                instance.tries = 1;
            }
            instance.seen = Some(Box::new(seen));
        }
        if self.reuse(context, id) {
            return;
        }
        if is_pia {
            self.clear_view(context, id);
        }
        let Some(instance) = self.instances.get(id) else { return };
        if requirements.is_empty() {
            self.active.insert(id);
            self.set_status(id, Status::Granted, Wait::Nothing);
            self.launch(context, id, inputs);
            return;
        }
        if !self.leaves_room(context, instance, &requirements) {
            self.wait(id, Wait::Room);
            self.stalled.push(id);
            return;
        }
        let priority = self.priority(instance);
        self.active.insert(id);
        self.set_status(id, Status::Acquiring, Wait::Resources);
        if let Some(instance) = self.instances.get_mut(id) {
            instance.asked_with = priority;
        }
        context.commands.push(Command::Acquire { instance: id, requirements, priority });
        self.preempt_for(context, id);
    }

    /// What a result is made of is told to those it is made of.
    fn depend(&mut self, id: InstanceId, used: &[InstanceId]) {
        let Some(instance) = self.instances.get(id) else { return };
        if instance.is_pia() {
            return;
        }
        let mut producers: Vec<InstanceId> = used.to_vec();
        producers.extend(self.producers_of(instance));
        producers.sort_unstable();
        producers.dedup();
        for producer in producers {
            if let Some(producer) = self.instances.get_mut(producer) {
                producer.users.push(id);
            }
        }
    }

    /// A motion may begin: sensing nodes that would see it, and have not begun or are speculative, step back.
    fn clear_view(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let stepping_back: Vec<InstanceId> = {
            let Some(instance) = self.instances.get(id) else { return };
            let sight = self.sight(context);
            let writes = self.writes(context, instance);
            let active = self.active.iter().filter_map(|id| self.instances.get(*id));
            active
                .filter(|other| {
                    other.nature == NodeNature::Senses && senses_of(context, sight, other).overlaps(&writes)
                })
                .map(|other| other.id)
                .collect()
        };
        for other in stepping_back {
            self.step_back(context, other, Wait::Writer(id));
        }
    }

    /// It gives back what it has and begins again later.
    pub(super) fn step_back(&mut self, context: &mut Context<'_>, id: InstanceId, wait: Wait) {
        self.stop_instance(context, id);
        if let Some(instance) = self.instances.get_mut(id) {
            instance.status = Status::Expanded;
            instance.attempt += 1;
        }
        self.wait(id, wait);
    }

    /// It has its resources: it gets its projection, then its goal starts.
    pub(super) fn proceed(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.instances.get(id) else { return };
        let sight = self.sight(context);
        // While it waited for its resources an older instance may have changed what it would look at.
        let looked = if instance.is_pia() || instance.projection.is_some() {
            None
        } else {
            let view = sight.view(instance, None);
            Some(self.look(context, instance, &view).map(|seen| (seen, view.used())))
        };
        match looked {
            None => {}
            Some(Err(wait)) => return self.step_back(context, id, wait),
            Some(Ok((seen, used))) => {
                self.depend(id, &used);
                if let Some(instance) = self.instances.get_mut(id)
                    && let Some(before) = &mut instance.seen
                {
                    if before.facts != seen.facts {
                        instance.tries = 1;
                    }
                    before.facts = seen.facts;
                    before.read = seen.read;
                }
            }
        }
        self.launch(context, id, None);
    }

    /// What it reads is as it was when it asked.
    fn launch(&mut self, context: &mut Context<'_>, id: InstanceId, known: Option<Outputs>) {
        let Some(instance) = self.instances.get(id) else { return };
        if instance.is_pia() && instance.projection.is_none() {
            self.hold.has_begun();
        }
        let state = context.program.state(instance.state);
        let analysis = context.plan.state(instance.state);
        let is_routine = !matches!(state.kind, StateKind::Action { .. });
        let Some(instance) = self.instances.get(id) else { return };
        let attempt = instance.attempt;
        let view = self.sight(context).view(instance, None);
        if analysis.needs_world && instance.projection.is_none() && !is_routine {
            let reads = match &analysis.reads {
                Some(facts) => ratn_model::expression::FactExpr::footprint(facts, &view),
                None => Footprint::Everything,
            };
            let Ok(by_writer) = view.changes_by_writer(&reads) else {
                let wait = view.blocker().map_or(Wait::Order, Wait::World);
                return self.step_back(context, id, wait);
            };
            let lease = instance.lease.as_ref().map(|l| (l.id, l.token));
            let base = context.root.revision();
            let (writers, changes) = self.named(context, by_writer);
            self.set_status(id, Status::Projecting, Wait::Nothing);
            context.commands.push(Command::Project { instance: id, attempt, base, changes, writers, reads, lease });
            return;
        }
        if is_routine {
            drop(view);
            context.note(Note::Running { instance: id, attempt });
            self.set_status(id, Status::Running, Wait::Nothing);
            return self.start_routine(context, id);
        }
        let StateKind::Action { inputs, .. } = &state.kind else { return };
        let Some((provider, action)) = self.plan.state(instance.state).action.clone() else { return };
        let bound = match known {
            Some(inputs) => Ok(inputs),
            None => binding::inputs(state, inputs, &view),
        };
        let inputs = match bound {
            Ok(inputs) => inputs,
            Err(error) => {
                return match not_bound(&view, &error) {
                    Readiness::Waits(wait) => self.step_back(context, id, wait),
                    _ => self.finish(context, id, Ended::aborted(error.reason())),
                };
            }
        };
        let goal = Goal {
            provider,
            action,
            inputs,
            seed: self.seed(context, instance),
            lease: instance.lease.as_deref().cloned(),
            projection: instance.projection,
            expected_s: binding::expected_s(state, &view),
            timeout_s: state.annotations.timeout_s,
        };
        drop(view);
        if let Some(timeout_s) = state.annotations.timeout_s {
            self.set_timer(context, timeout_s, super::timers::Timer::Timeout(id, attempt));
        }
        self.set_status(id, Status::Running, Wait::Nothing);
        context.note(Note::Running { instance: id, attempt });
        context.commands.push(Command::Start { instance: id, attempt, goal: Box::new(goal) });
    }

    /// Each change with the path of who makes it.
    fn named(&self, context: &Context<'_>, by_writer: Vec<(InstanceId, Vec<Change>)>) -> (Vec<Arc<str>>, Vec<Change>) {
        let mut writers = Vec::new();
        let mut all = Vec::new();
        for (writer, changes) in by_writer {
            let path: Arc<str> = self.path(context.program, writer).into();
            writers.extend(std::iter::repeat_n(path, changes.len()));
            all.extend(changes);
        }
        (writers, all)
    }

    fn start_routine(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.instances.get(id) else { return };
        let sight = self.sight(context);
        let state = context.program.state(instance.state);
        let analysis = context.plan.state(instance.state);
        let environment = &instance.environment;
        let outputs = self
            .plan
            .state(instance.state)
            .flows
            .iter()
            .filter_map(|state| Some((*state, sight.outputs_of(environment.producer(*state)?)?.clone())))
            .collect();
        let view = sight.view(instance, None);
        let names = environment.variables.iter().map(|(name, _)| name);
        let variables = names
            .filter_map(|name| Some((name.to_string(), view.variable(name)?.into_owned())))
            .chain(
                environment.loop_variables(context.program).map(|(name, value)| (name.to_owned(), value.into_owned())),
            )
            .collect();
        let target = if instance.is_pia() {
            Target::Actual
        } else {
            let reads = match &analysis.reads {
                Some(facts) => ratn_model::expression::FactExpr::footprint(facts, &view),
                None => Footprint::Everything,
            };
            let (writers, changes) = self.named(context, view.changes_by_writer(&reads).unwrap_or_default());
            let world = context.root.project(&changes).unwrap_or_else(|_| context.root.clone());
            let before = changes.len();
            let base = context.root.revision();
            Target::Projection { base, changes, writers, before, evidence: Evidence::new(), world }
        };
        let requirements = match binding::requirements(state, &analysis.requirements, &view) {
            Ok(requirements) => requirements,
            Err(error) => return self.finish(context, id, Ended::aborted(error.reason())),
        };
        let routine = Routine { requirements, lease: instance.lease.as_deref().cloned(), visit: None };
        drop(view);
        let mut interpreter = Box::new(Interpreter::of_routine(variables, outputs, routine, target));
        let (state, path) = (instance.state, self.path(context.program, id));
        let progress = interpreter.start(context, state, &path);
        if let Some(instance) = self.instances.get_mut(id) {
            instance.routine = Some(interpreter);
        }
        self.routine_progressed(context, id, progress);
    }
}
