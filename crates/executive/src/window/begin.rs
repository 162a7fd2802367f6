//! Beginning a node: acquire its resources, make its projection, start its goal.

use super::Window;
use super::graph::instance::{Ended, Instance, Status};
use super::growth::environment::assigned;
use super::memory::{Purpose, Seen, View};
use super::ready::{self, Readiness, not_bound};
use super::results::Known;
use super::waits::{Timer, Wait};
use crate::binding::{self, Outputs, Seed};
use crate::context::Context;
use crate::interpreter::{Interpreter, Routine, Target};
use crate::lookahead::Held;
use crate::plan::NodeNature;
use crate::protocol::{Command, Event, Goal, Note};
use ratn_model::expression::{FactExpr, Scope};
use ratn_model::fact::{Change, Footprint};
use ratn_model::id::InstanceId;
use ratn_model::measurement::Evidence;
use ratn_model::program::{ABORTED, StateKind};
use ratn_model::resource::{Requirement, ResourceOperation};
use std::sync::Arc;

impl Window {
    /// Begins a node, or notes what it waits for.
    pub(super) fn begin(&mut self, context: &mut Context<'_>, id: InstanceId) {
        self.follow_root(context);
        self.come_to_its_place(context, id);
        let looked = self.look(context, id, None, |instance, view| {
            let mut seen = Seen::default();
            let readiness = self.readiness(context, instance, view, &mut seen);
            // A failure, and what a sensing node waits to see, may change too, so their inputs are registered. A PIA's inputs are final.
            let is_made = match readiness {
                Readiness::Ready(..) | Readiness::Failed(_) => true,
                Readiness::Waits(wait) => matches!(wait, Wait::Environment(_) | Wait::Order),
            };
            if is_made && !instance.is_pia() {
                view.use_outputs(view.sight.producers_of(view.instance));
                view.register(Purpose::Result);
            }
            (readiness, seen)
        });
        match looked {
            None => {}
            Some((Readiness::Waits(Wait::Pause), _)) => {
                self.is_held_back(context, id);
                self.wait(id, Wait::Pause);
            }
            Some((Readiness::Waits(wait), _)) => self.wait(id, wait),
            Some((Readiness::Failed(reason), seen)) => {
                self.graph.set_seen(id, Some(seen));
                self.fail(context, id, reason);
            }
            Some((Readiness::Ready(requirements, inputs), seen)) => {
                let is_pia = self.graph.get(id).is_some_and(Instance::is_pia);
                if is_pia && self.goes_in_circles(context, id) {
                    return;
                }
                self.acquire(context, id, requirements, inputs, seen);
            }
        }
    }

    /// Whether the operator does not let a node begin. If it stands at a breakpoint, the run pauses from now on.
    pub(super) fn is_held_back(&mut self, context: &mut Context<'_>, id: InstanceId) -> bool {
        let Some(instance) = self.graph.get(id).filter(|instance| instance.is_pia()) else { return false };
        let state = instance.state;
        if self.hold.lets_begin(id, state) {
            return false;
        }
        if self.hold.stops_at(id, state) {
            context.note(Note::Stopped { instance: id });
        }
        true
    }

    /// The node has its resources. If the operator does not let it begin, it gives them back, because others may want them meanwhile, and asks again
    /// later. If it has consumed any, it keeps its lease.
    pub(super) fn proceed_unless_held_back(&mut self, context: &mut Context<'_>, id: InstanceId) {
        if self.is_held_back(context, id) {
            let uses_up = self.graph.get(id).is_some_and(|instance| context.plan.state(instance.state).uses_up);
            return if uses_up { self.wait(id, Wait::Pause) } else { self.step_back(context, id, Wait::Pause) };
        }
        self.proceed(context, id);
    }

    /// Ends a node `aborted` that has not begun, or may not begin again.
    pub(super) fn fail(&mut self, context: &mut Context<'_>, id: InstanceId, reason: String) {
        context.note(Note::Finished { instance: id, outcome: ABORTED.into() });
        let outputs = self.unassigned(context, id);
        self.end_node(context, id, Ended { outputs, ..Ended::aborted(reason) });
    }

    /// The outputs of a node that did not run: a routine keeps the variables that it would assign.
    pub(super) fn unassigned(&self, context: &Context<'_>, id: InstanceId) -> Outputs {
        let outputs = self.look(context, id, None, |instance, view| {
            let own = context.plan.state(instance.state);
            let value = |name: &String| Some((assigned(name), view.variable(name)?.into_owned()));
            if own.is_routine { own.assigns.iter().filter_map(value).collect() } else { Outputs::new() }
        });
        outputs.unwrap_or_default()
    }

    fn acquire(
        &mut self,
        context: &mut Context<'_>,
        id: InstanceId,
        requirements: Vec<Requirement>,
        inputs: Option<Outputs>,
        seen: Seen,
    ) {
        let Some(instance) = self.graph.get(id) else { return };
        let is_pia = instance.is_pia();
        let is_like_before = is_pia || instance.seen().is_some_and(|before| before.is_like(&seen));
        self.graph.set_seen(id, (!is_pia).then_some(seen));
        if !is_like_before {
            // Earlier failures had other inputs: the tries begin again at 1.
            self.graph.forget_tries(id);
        }
        if self.reuse(context, id) {
            return;
        }
        if is_pia {
            self.clear_view(context, id);
        }
        let Some(instance) = self.graph.get(id) else { return };
        if requirements.is_empty() {
            self.dispatch.begin(&self.graph, context.plan, instance);
            self.graph.grant(id, None, context.now);
            self.launch(context, id, inputs);
            return;
        }
        if !self.dispatch.leaves_room(&self.graph, instance, &requirements) {
            self.dispatch.stall(id);
            return self.wait(id, Wait::Room);
        }
        let priority = self.dispatch.priority(&self.graph, instance);
        self.dispatch.begin(&self.graph, context.plan, instance);
        self.graph.acquire(id, priority);
        self.wait(id, Wait::Resources);
        self.make_room(context, id);
        context.commands.push(Command::Acquire { instance: id, requirements, priority });
    }

    /// Takes the result from the cache, or waits for the instance that computes the same; true if either applies.
    fn reuse(&mut self, context: &mut Context<'_>, id: InstanceId) -> bool {
        let Some(instance) = self.graph.get(id) else { return false };
        let speculative = self.graph.is_speculative(instance.segment);
        if !is_cacheable(context, instance) || (!speculative && self.results.is_empty()) {
            return false;
        }
        let seed = self.seed(context, instance);
        let Some(seen) = instance.seen() else { return false };
        match self.results.find(&self.graph, id, seed, seen) {
            Some(Known::Result(mut answer)) => {
                // Assigned values may depend on facts that differ between the branches.
                answer.outputs.retain(|port, _| !port.starts_with(super::growth::environment::ASSIGNED));
                self.graph.answer(id, (*answer).clone());
                let ended = self.end_of_answer(context, id, *answer);
                context.note(Note::Reused { instance: id });
                context.note(Note::Finished { instance: id, outcome: ended.outcome.clone() });
                self.end_instance(id, ended);
                true
            }
            Some(Known::Busy(busy)) => {
                self.wait(id, Wait::Twin(busy));
                true
            }
            None => {
                if speculative && self.results.note_twin(id, seed) {
                    // Next try: an instance that waits for the earlier try has to compute that itself.
                    self.waits.wake(&mut self.graph, id);
                }
                false
            }
        }
    }

    /// Keeps a result in the cache before it is discarded.
    pub(super) fn keep_result(&mut self, context: &Context<'_>, id: InstanceId) {
        let Some(instance) = self.graph.get(id) else { return };
        let answer = instance.node().and_then(|node| node.answer.clone());
        let (Some(seen), Some(answer)) = (instance.seen(), answer) else { return };
        if self.is_ending {
            return;
        }
        let (seed, seen) = (self.seed(context, instance), seen.clone());
        self.results.keep(seed, seen, answer);
        self.wake_twins(id);
    }

    /// Keeps the answer of a goal, if it is a result that other instances may use.
    pub(super) fn keep_answer(&mut self, context: &Context<'_>, id: InstanceId, answer: &Ended) {
        if self.graph.get(id).is_some_and(|instance| is_cacheable(context, instance)) {
            self.graph.answer(id, answer.clone());
        }
    }

    /// The random seed of a visit.
    fn seed(&self, context: &Context<'_>, instance: &Instance) -> u64 {
        let state = context.program.state(instance.state);
        let mut seed = Seed::of(context.seed);
        let environment = &instance.environment;
        environment.path_parts(&state.name, instance.visit, instance.iteration, |part| seed.add(part.as_bytes()));
        let tries = instance.node().map_or(1, |node| node.tries);
        seed.of_try(if state.annotations.deterministic { 1 } else { tries })
    }

    /// A motion may begin: sensing nodes that would see it, and have not begun, are speculative or run ahead in another region, step back.
    fn clear_view(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.graph.get(id) else { return };
        let runs_ahead = |other: &Instance| other.node().is_some_and(|node| !node.is_at_its_place);
        let active = self.dispatch.active().filter_map(|id| self.graph.get(id));
        let sensing = active.filter(|other| other.is_sensing() && runs_ahead(other));
        let sensing: Vec<InstanceId> = sensing.map(|other| other.id).collect();
        if sensing.is_empty() {
            return;
        }
        let writes = self.writes(context, instance);
        let would_see = |other: &InstanceId| {
            self.graph.get(*other).is_some_and(|other| self.senses(context, other).overlaps(&writes))
        };
        let stepping_back: Vec<InstanceId> = sensing.into_iter().filter(would_see).collect();
        for other in stepping_back {
            self.step_back(context, other, Wait::Writer(id));
        }
    }

    /// Gives back what the node holds; it begins again later.
    pub(super) fn step_back(&mut self, context: &mut Context<'_>, id: InstanceId, wait: Wait) {
        self.stop_node(context, id);
        self.graph.begin_again(id);
        self.wait(id, wait);
    }

    /// Handles an answer of the resource manager or of the world pool.
    pub(super) fn answered(&mut self, context: &mut Context<'_>, event: Event) {
        match event {
            Event::Granted { instance: id, lease } => {
                if !matches!(self.status(id), Some(Status::Acquiring { .. })) {
                    return self.in_routine(context, Event::Granted { instance: id, lease });
                }
                self.used_up(context, id);
                self.graph.grant(id, Some(lease), context.now);
                self.proceed_unless_held_back(context, id);
            }
            Event::Refused { instance: id, reason } => {
                if !matches!(self.status(id), Some(Status::Acquiring { .. })) {
                    return self.in_routine(context, Event::Refused { instance: id, reason });
                }
                self.rest(id);
                self.fail(context, id, format!("its resources were refused: {reason}"));
            }
            Event::Projected { instance: id, attempt, projection } => {
                let is_awaited = self
                    .graph
                    .node(id)
                    .is_some_and(|node| node.attempt == attempt && matches!(node.status, Status::Projecting(_)));
                if !is_awaited {
                    return self.in_routine(context, Event::Projected { instance: id, attempt, projection });
                }
                self.graph.projected(id, projection);
                self.launch(context, id, None);
            }
            _ => {}
        }
    }

    /// Accounts for the resources that a node consumes with its grant.
    fn used_up(&mut self, context: &Context<'_>, id: InstanceId) {
        let Some(instance) = self.graph.get(id).filter(|instance| context.plan.state(instance.state).uses_up) else {
            return;
        };
        let wanted = &context.plan.state(instance.state).requirements;
        let bound = self.look(context, id, None, |instance, view| {
            binding::requirements(context.program.state(instance.state), wanted, view)
        });
        if let Some(Ok(mut requirements)) = bound {
            requirements.retain(|wanted| wanted.operation == ResourceOperation::Consume);
            self.dispatch.operated(&requirements);
        }
    }

    fn status(&self, id: InstanceId) -> Option<&Status> {
        self.graph.node(id).map(|node| &node.status)
    }

    /// The node has its resources. Meanwhile the world at its place may have changed, within tolerances or before the node was registered as a
    /// reader, so it reads again.
    pub(super) fn proceed(&mut self, context: &mut Context<'_>, id: InstanceId) {
        self.follow_root(context);
        let Some(nature) = self.graph.node(id).map(|node| node.nature) else { return };
        if nature != NodeNature::Irreversible {
            let looked = self.look(context, id, None, |_, view| {
                let looked = ready::look(context, view, nature);
                if looked.is_ok() {
                    view.register(Purpose::Result);
                }
                looked
            });
            match looked {
                None => return,
                Some(Err(wait)) => return self.step_back(context, id, wait),
                Some(Ok(mut seen)) => {
                    let Some(before) = self.graph.get(id).and_then(Instance::seen) else { return };
                    seen.inputs = before.inputs;
                    if !before.saw_the_same(&seen) {
                        self.graph.forget_tries(id);
                        // It computes something else than the instances that wait for its result.
                        self.waits.wake(&mut self.graph, id);
                    }
                    self.graph.set_seen(id, Some(seen));
                }
            }
        }
        self.launch(context, id, None);
    }

    /// The node's inputs are up to date: makes its projection, then starts its goal.
    fn launch(&mut self, context: &mut Context<'_>, id: InstanceId, known: Option<Outputs>) {
        // A node that ends before it begins does not count as an operator's step.
        if self.is_not_met(context, id) || self.ends_violated(context, id) {
            return;
        }
        let Some(instance) = self.graph.get(id) else { return };
        let Some(node) = instance.node() else { return };
        let Status::Granted(held) = &node.status else { return };
        let own = context.plan.state(instance.state);
        if held.projection.is_none() && instance.is_pia() {
            self.hold.has_begun(id);
        }
        if own.needs_world && held.projection.is_none() && !own.is_routine {
            return self.project(context, id);
        }
        if own.is_routine {
            context.note(Note::Running { instance: id, attempt: node.attempt });
            return self.start_routine(context, id);
        }
        self.start_goal(context, id, known);
    }

    /// Ends a node with a precondition that no longer holds, because another region or somebody else changed the world while it waited for its
    /// resources. True if it ended. Of a node that runs ahead preconditions are checked later, in the actual world.
    fn is_not_met(&mut self, context: &mut Context<'_>, id: InstanceId) -> bool {
        if !self.graph.get(id).is_some_and(Window::begins_for_real) {
            return false;
        }
        match self.unmet(context, id) {
            Some(Readiness::Failed(reason)) => {
                let outputs = self.unassigned(context, id);
                self.finish(context, id, Ended { outputs, ..Ended::aborted(reason) });
                true
            }
            Some(Readiness::Waits(wait)) => {
                self.step_back(context, id, wait);
                true
            }
            Some(Readiness::Ready(..)) | None => false,
        }
    }

    fn project(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let looked = self.look(context, id, None, |instance, view| {
            let reads = match &context.plan.state(instance.state).reads {
                Some(facts) => FactExpr::footprint(facts, view),
                None => Footprint::Everything,
            };
            let by_writer = view.changes_by_writer(&reads).map_err(|blocked| Wait::World(blocked.0));
            by_writer.map(|by_writer| (reads, by_writer))
        });
        let (reads, by_writer) = match looked {
            None => return,
            Some(Err(wait)) => return self.step_back(context, id, wait),
            Some(Ok(looked)) => looked,
        };
        let Some(node) = self.graph.node(id) else { return };
        let Status::Granted(held) = &node.status else { return };
        let (attempt, lease) = (node.attempt, held.lease.as_ref().map(|lease| (lease.id, lease.token)));
        let first = self.graph.get(id).is_some_and(|instance| {
            instance.is_pia() || context.program.state(instance.state).annotations.timeout_s.is_some()
        });
        let base = context.root.revision();
        let (writers, changes) = self.named(context, by_writer);
        self.graph.project(id);
        context.commands.push(Command::Project { instance: id, attempt, base, changes, writers, reads, lease, first });
    }

    fn start_goal(&mut self, context: &mut Context<'_>, id: InstanceId, known: Option<Outputs>) {
        let Some(instance) = self.graph.get(id) else { return };
        let state = context.program.state(instance.state);
        let StateKind::Action { inputs, .. } = &state.kind else { return };
        if state.is_pause() {
            return self.begin_waiting(context, id);
        }
        let Some((provider, action)) = context.plan.state(instance.state).action.clone() else { return };
        let improves = context.plan.state(instance.state).improves.clone();
        let known = if self.harvest_for(context, id) { None } else { known };
        let Some(instance) = self.graph.get(id) else { return };
        let looked = self.look(context, id, None, |_, view| {
            let bound = match &known {
                Some(inputs) => Ok(inputs.clone()),
                None => binding::inputs(state, inputs, view).map_err(|error| not_bound(view, &error)),
            };
            (bound, binding::expected_s(state, view))
        });
        let (inputs, expected_s) = match looked {
            Some((Ok(inputs), expected_s)) => (inputs, expected_s),
            Some((Err(Readiness::Waits(wait)), _)) => return self.step_back(context, id, wait),
            Some((Err(Readiness::Failed(reason)), _)) => return self.finish(context, id, Ended::aborted(reason)),
            Some((Err(Readiness::Ready(..)), _)) | None => return,
        };
        let Some(node) = self.graph.node(id) else { return };
        let Status::Granted(held) = &node.status else { return };
        let attempt = node.attempt;
        let goal = Goal {
            provider,
            action,
            inputs,
            seed: self.seed(context, instance),
            lease: held.lease.as_deref().cloned(),
            projection: held.projection,
            expected_s,
            timeout_s: state.annotations.timeout_s,
            improves,
            reads_nothing: context.plan.state(instance.state).reads_nothing(),
        };
        if let Some(timeout_s) = state.annotations.timeout_s {
            self.set_timer(context, timeout_s, Timer::Timeout(id, attempt));
        }
        self.graph.run(id, context.now);
        context.note(Note::Running { instance: id, attempt });
        context.commands.push(Command::Start { instance: id, attempt, goal: Box::new(goal) });
    }

    /// All changes in order, each with the path of its writer.
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
        let Some((is_pia, state)) = self.graph.get(id).map(|instance| (instance.is_pia(), instance.state)) else {
            return;
        };
        self.harvest_for(context, id);
        let looked = self.look(context, id, None, |instance, view| {
            let own = context.plan.state(instance.state);
            let environment = &view.instance.environment;
            let sight = view.sight;
            let flows = own.flows.iter();
            let outputs = flows
                .filter_map(|state| Some((*state, sight.outputs_of(environment.producer(*state)?)?.clone())))
                .collect();
            let by_writer = if is_pia {
                Ok(Vec::new())
            } else {
                let reads = match &own.reads {
                    Some(facts) => FactExpr::footprint(facts, view),
                    None => Footprint::Everything,
                };
                view.changes_by_writer(&reads)
            };
            let requirements = binding::requirements(context.program.state(instance.state), &own.requirements, view);
            (variables(context, view), outputs, by_writer, requirements)
        });
        let Some((variables, outputs, by_writer, requirements)) = looked else { return };
        let target = if is_pia {
            Target::Actual
        } else {
            let by_writer = match by_writer {
                Ok(by_writer) => by_writer,
                Err(blocked) => return self.step_back(context, id, Wait::World(blocked.0)),
            };
            let (writers, changes) = self.named(context, by_writer);
            let world = context.root.project(&changes).unwrap_or_else(|_| context.root.clone());
            let before = changes.len();
            let base = context.root.revision();
            Target::Projection { base, changes, writers, before, evidence: Evidence::new(), world }
        };
        let requirements = match requirements {
            Ok(requirements) => requirements,
            Err(error) => return self.finish(context, id, Ended::aborted(error.reason())),
        };
        let lease = self.graph.take_held(id).lease.map(|lease| *lease);
        let routine = Routine { requirements, lease, visit: None };
        let interpreter = Box::new(Interpreter::of_routine(variables, outputs, routine, target));
        let path = self.path(context.program, id);
        self.graph.run_routine(id, interpreter);
        self.with_routine(context, id, |routine, context| routine.begin_with(context, state, &path));
    }

    /// Instances that wait for the resource manager ask again if their priority has changed.
    pub(super) fn ask_again(&mut self, context: &mut Context<'_>) {
        for id in self.dispatch.misplaced(&self.graph) {
            let Some(instance) = self.graph.get(id) else { continue };
            let wanted = &context.plan.state(instance.state).requirements;
            if wanted.iter().any(|r| r.operation == ResourceOperation::Consume) {
                // A grant that crosses the withdrawal may have consumed already; asking again would consume twice.
                continue;
            }
            let priority = self.dispatch.priority(&self.graph, instance);
            let state = context.program.state(instance.state);
            let bound = self.look(context, id, None, |_, view| binding::requirements(state, wanted, view));
            let Some(Ok(requirements)) = bound else { continue };
            context.commands.push(Command::Withdraw { instance: id });
            context.commands.push(Command::Acquire { instance: id, requirements, priority });
            self.graph.acquire(id, priority);
            if let Some(instance) = self.graph.get(id) {
                self.dispatch.asks_again(&self.graph, instance);
            }
        }
    }

    /// Applies the holds of new advice; they replace all earlier ones.
    pub(super) fn hold_back(&mut self, context: &mut Context<'_>, held: &[Held]) {
        let (before, holds) = self.dispatch.hold(&self.graph, context.now, held);
        for (id, until) in holds {
            self.waits.set_timer_at(until, Timer::Hold(id));
            context.commands.push(Command::Wake { at: until });
            let Some(instance) = self.graph.get(id) else { continue };
            let wanted = &context.plan.state(instance.state).requirements;
            let is_asking = instance.node().is_some_and(|node| matches!(node.status, Status::Acquiring { .. }));
            // As in `ask_again`: a crossing grant may have consumed already.
            let uses_up = wanted.iter().any(|r| r.operation == ResourceOperation::Consume);
            if is_asking && !uses_up && self.dispatch.is_held(&self.graph, id) {
                self.step_back(context, id, Wait::Turn);
            }
        }
        for id in before {
            self.waits.enqueue(&mut self.graph, id);
        }
    }

    /// Speculative holders give way to certain nodes, and instances that wait for room begin where there is some; true if any did.
    pub(super) fn give_way(&mut self, context: &mut Context<'_>) -> bool {
        let in_the_way = self.dispatch.in_the_way(&self.graph, context.plan);
        let mut first = self.dispatch.take_stalled(&self.graph);
        first.extend(self.dispatch.take_released(&self.graph));
        let changed = !in_the_way.is_empty() || !first.is_empty();
        for (holder, by) in in_the_way {
            self.preempt(context, holder, Some(by));
        }
        for id in first {
            self.waits.enqueue(&mut self.graph, id);
        }
        changed
    }
}

impl Window {
    /// Another run certainly needs something that one of these instances holds. An instance that only improves its result gives way, else the least
    /// urgent speculative one, if there is one.
    pub(super) fn give_way_to_others(&mut self, context: &mut Context<'_>, holders: &[InstanceId]) {
        if let Some(improving) = holders.iter().find(|id| self.improving.has(**id)) {
            return self.harvest(context, *improving);
        }
        let speculative = holders.iter().filter_map(|id| self.graph.get(*id)).filter(|instance| {
            let holds = instance.node().is_some_and(|node| node.status.since().is_some());
            holds && self.dispatch.is_speculative(instance.id)
        });
        let least = speculative.min_by_key(|instance| (self.dispatch.priority(&self.graph, instance), instance.id));
        if let Some(holder) = least.map(|instance| instance.id) {
            self.preempt(context, holder, None);
        }
    }

    /// A speculative holder gives back its resources and asks again.
    pub(super) fn preempt(&mut self, context: &mut Context<'_>, holder: InstanceId, by: Option<InstanceId>) {
        context.note(Note::Preempted { instance: holder, by });
        self.step_back(context, holder, Wait::Nothing);
        self.waits.enqueue(&mut self.graph, holder);
    }
}

fn is_cacheable(context: &Context<'_>, instance: &Instance) -> bool {
    instance.node().is_some_and(|node| node.nature == NodeNature::Computes)
        && matches!(context.program.state(instance.state).kind, StateKind::Action { .. })
}

/// The variables in scope, with their values.
fn variables(context: &Context<'_>, view: &View<'_>) -> Vec<(String, ratn_model::value::Value)> {
    let environment = &view.instance.environment;
    let names = environment.variables.iter().map(|(name, _)| name);
    let scoped = names.filter_map(|name| Some((name.to_string(), view.variable(name)?.into_owned())));
    let looping = environment.loop_variables(context.program);
    scoped.chain(looping.map(|(name, value)| (name.to_owned(), value.into_owned()))).collect()
}
