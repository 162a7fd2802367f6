//! The survey: one walk over the window in program order, along every branch, carrying what each place sees of the older
//! instances. What may begin begins; what can be decided is decided.

use crate::analysis::NodeNature;
use crate::binding::{self, Outputs};
use crate::interpreter::{Context, Interpreter, Routine, Target};
use crate::protocol::{Command, Goal, Note};
use crate::window::instance::{Ended, Role, Status, Wait};
use crate::window::place::{Place, may_write};
use crate::window::{End, Window, give_back};
use ratn_model::expression::FactExpr;
use ratn_model::fact::Footprint;
use ratn_model::id::InstanceId;
use ratn_model::program::{SUCCESS, StateKind};
use ratn_model::value::Value;
use ratn_world::world::World;

/// What became of an attempt to begin.
enum Readiness {
    Ready,
    Waits(Wait),
    /// It never will: the reason it ends `aborted`.
    Failed(String),
}

impl Window {
    /// Walks the window once; whether anything moved.
    pub(crate) fn survey(&mut self, context: &mut Context<'_>) -> bool {
        let Some(oldest) = self.oldest else { return false };
        let mut moved = false;
        let mut open = vec![(oldest, Place::root(context.root))];
        while let Some((id, mut place)) = open.pop() {
            // A decision may have squashed what was still to be visited.
            if !self.instances.alive.contains_key(&id) {
                continue;
            }
            moved |= self.visit(context, id, &place);
            if self.end.is_some() {
                return true;
            }
            self.settle_result(context, id, &place);
            place.pass(context.program, context.analysis, &self.instances, id);
            let next = self.instances.alive.get(&id).map(|i| i.next.clone()).unwrap_or_default();
            // The first branch is visited first.
            for younger in next.into_iter().rev() {
                open.push((younger, place.clone()));
            }
        }
        moved
    }

    fn visit(&mut self, context: &mut Context<'_>, id: InstanceId, place: &Place) -> bool {
        let Some(instance) = self.instances.alive.get(&id) else { return false };
        match (instance.role, instance.status) {
            (Role::Node, Status::Expanded) => {
                let readiness = self.readiness(context, id, place);
                self.begin_if(context, id, place, readiness)
            }
            (Role::Node, Status::Granted) => self.proceed(context, id, place),
            (Role::Condition | Role::Loop, Status::Expanded) => self.decide(context, id, place),
            (Role::Entry, Status::Expanded) if place.oldest => {
                let state = context.program.state(instance.state);
                let unmet = place.with_scope(&self.instances, id, None, |scope| binding::unmet(state, scope));
                let ended = match unmet {
                    Some(Ok(None)) | None => Ended::success(Outputs::new()),
                    Some(Ok(Some(reason))) => Ended::aborted(reason),
                    Some(Err(error)) => Ended::aborted(error.reason()),
                };
                self.end_instance(id, ended)
            }
            (Role::Exit, Status::Expanded) => self.leave_composite(context, id, place),
            (Role::End, Status::Expanded) if place.oldest => self.end_run(context, id, place),
            _ => false,
        }
    }

    fn end_instance(&mut self, id: InstanceId, ended: Ended) -> bool {
        if let Some(instance) = self.instances.alive.get_mut(&id) {
            instance.status = Status::Finished;
            instance.ended = Some(ended);
        }
        true
    }

    /// The outputs of a composite are written as soon as what they are made of is.
    fn leave_composite(&mut self, context: &Context<'_>, id: InstanceId, place: &Place) -> bool {
        let Some(instance) = self.instances.alive.get(&id) else { return false };
        let mut written = Outputs::new();
        if let StateKind::Sequence { outputs, .. } = &context.program.state(instance.state).kind {
            for output in outputs {
                let value = place.with_scope(&self.instances, id, None, |scope| output.value.evaluate(scope));
                match value {
                    Some(Ok(value)) => {
                        written.insert(output.name.clone(), value);
                    }
                    Some(Err(error)) if error.is_not_yet_known() => return false,
                    Some(Err(error)) => {
                        return self.end_instance(id, Ended::aborted(format!("output `{}`: {error}", output.name)));
                    }
                    None => return false,
                }
            }
        }
        self.end_instance(id, Ended::success(written))
    }

    fn end_run(&mut self, context: &mut Context<'_>, id: InstanceId, place: &Place) -> bool {
        let mut outputs = Outputs::new();
        for output in &context.program.outputs {
            match place.with_scope(&self.instances, id, None, |scope| output.value.evaluate(scope)) {
                Some(Ok(value)) => {
                    outputs.insert(output.name.clone(), value);
                }
                Some(Err(error)) => {
                    return self.end_instance(id, Ended::aborted(format!("output `{}`: {error}", output.name)));
                }
                None => {}
            }
        }
        self.end = Some(End { outcome: SUCCESS.to_owned(), outputs, reason: String::new() });
        true
    }

    /// A condition or a loop decides once what it is made of is settled.
    fn decide(&mut self, context: &mut Context<'_>, id: InstanceId, place: &Place) -> bool {
        let Some(instance) = self.instances.alive.get(&id) else { return false };
        let state = context.program.state(instance.state);
        let expression = match &state.kind {
            StateKind::Condition { predicate, .. } => predicate,
            StateKind::ForEach { collection, .. } => collection,
            _ => return false,
        };
        let flows: Vec<_> = expression.flows().into_iter().collect();
        let facts = expression.fact_expressions();
        let settled = self.instances.flows_settled(&instance.environment, &flows)
            && facts.iter().all(|fact| {
                let read = place.with_scope(&self.instances, id, None, |scope| fact.pattern(scope));
                read.is_some_and(|pattern| !place.written.overlaps(&Footprint::Patterns(vec![pattern])))
            });
        if !settled || place.speculative {
            return false;
        }
        let value = place.with_scope(&self.instances, id, None, |scope| match &state.kind {
            StateKind::Condition { .. } => expression.holds(scope).map(Value::Bool),
            _ => expression.evaluate(scope),
        });
        let decision = match value {
            Some(Ok(Value::Bool(taken))) => {
                self.take_branch(context, id, taken);
                if taken { "then".to_owned() } else { "else".to_owned() }
            }
            Some(Ok(Value::List(elements))) => {
                let count = elements.len();
                let path = self.path(id).to_owned();
                for cursor in &mut self.cursors {
                    cursor.unroll(id, state.id, elements.clone(), path.clone());
                }
                count.to_string()
            }
            Some(Ok(other)) => {
                let reason = format!("it loops over a {}, not a list", other.type_name());
                return self.end_instance(id, Ended::aborted(reason));
            }
            Some(Err(error)) => return self.end_instance(id, Ended::aborted(error.to_string())),
            None => return false,
        };
        context.note(Note::Decided { instance: id, decision });
        self.end_instance(id, Ended::success(Outputs::new()))
    }

    /// Whether a node may ask for its resources now.
    fn readiness(&mut self, context: &Context<'_>, id: InstanceId, place: &Place) -> Readiness {
        let Some(instance) = self.instances.alive.get(&id) else { return Readiness::Waits(Wait::Nothing) };
        let analysis = context.analysis.state(instance.state);
        let state = context.program.state(instance.state);
        let nature = instance.nature;
        if let Some(producer) = self.instances.missing_flow(&instance.environment, analysis) {
            return Readiness::Waits(Wait::Data(producer));
        }
        if nature == NodeNature::Irreversible && (!place.oldest || place.speculative) {
            return Readiness::Waits(Wait::Order);
        }
        if let Some(kind) = analysis.requirements.iter().map(|r| &r.kind).find(|k| place.operated.contains(*k)) {
            return Readiness::Waits(Wait::TaskResource(kind.clone()));
        }
        let bound = place.with_scope(&self.instances, id, None, |scope| {
            let reads = match &analysis.reads {
                Some(facts) => FactExpr::footprint(facts, scope),
                None => Footprint::Everything,
            };
            (reads, FactExpr::footprint(&analysis.senses, scope), may_write(analysis, scope))
        });
        let Some((reads, senses, writes)) = bound else { return Readiness::Waits(Wait::Nothing) };
        if reads.overlaps(&place.unknown) || senses.overlaps(&place.unknown) {
            return Readiness::Waits(Wait::World(place.unknown.clone()));
        }
        if let Some(instance) = self.instances.alive.get_mut(&id) {
            instance.reads = reads;
            instance.senses.clone_from(&senses);
            instance.writes.clone_from(&writes);
        }
        if let Some(wait) = self.hold_back(context, id, place, nature, &senses, &writes) {
            return Readiness::Waits(wait);
        }
        match place.with_scope(&self.instances, id, None, |scope| binding::unmet(state, scope)) {
            Some(Ok(None)) => {}
            // On a projection it only holds back; in the actual world it is decided.
            Some(Ok(Some(reason))) if place.oldest => return Readiness::Failed(reason),
            Some(Ok(Some(reason))) => return Readiness::Waits(Wait::Precondition(reason)),
            Some(Err(error)) if error.source.is_not_yet_known() => {
                return Readiness::Waits(Wait::Precondition(error.reason()));
            }
            Some(Err(error)) => return Readiness::Failed(error.reason()),
            None => return Readiness::Waits(Wait::Nothing),
        }
        Readiness::Ready
    }

    /// Sensing nodes and those who change what they look at keep out of each other's way; the older goes first.
    fn hold_back(
        &self,
        context: &Context<'_>,
        id: InstanceId,
        place: &Place,
        nature: NodeNature,
        senses: &Footprint,
        writes: &Footprint,
    ) -> Option<Wait> {
        let others = || self.instances.alive.values().filter(|other| other.id != id && other.role == Role::Node);
        match nature {
            NodeNature::Computes => None,
            NodeNature::Senses => {
                if !same_facts(senses, &place.world, context.root) {
                    return Some(Wait::Environment);
                }
                let writer = others().find(|other| {
                    let acts = other.is_under_way() || matches!(other.wait, Wait::Sensing(_));
                    other.is_pia() && acts && other.writes.overlaps(senses)
                });
                writer.map(|other| Wait::Writer(other.id))
            }
            NodeNature::Irreversible => {
                let looking = others().find(|other| {
                    matches!(other.status, Status::Granted | Status::Projecting | Status::Running)
                        && other.nature == NodeNature::Senses
                        && !self.is_speculative(other.id)
                        && other.senses.overlaps(writes)
                });
                looking.map(|other| Wait::Sensing(other.id))
            }
        }
    }

    fn begin_if(&mut self, context: &mut Context<'_>, id: InstanceId, place: &Place, readiness: Readiness) -> bool {
        match readiness {
            Readiness::Waits(wait) => {
                if let Some(instance) = self.instances.alive.get_mut(&id) {
                    instance.wait = wait;
                }
                false
            }
            Readiness::Failed(reason) => {
                context.note(Note::Finished { instance: id, outcome: ratn_model::program::ABORTED.to_owned() });
                self.end_instance(id, Ended::aborted(reason))
            }
            Readiness::Ready => self.acquire(context, id, place),
        }
    }

    fn acquire(&mut self, context: &mut Context<'_>, id: InstanceId, place: &Place) -> bool {
        let Some(instance) = self.instances.alive.get(&id) else { return false };
        let state = context.program.state(instance.state);
        let wanted = &context.analysis.state(instance.state).requirements;
        let requirements =
            place.with_scope(&self.instances, id, None, |scope| binding::requirements(state, wanted, scope));
        let requirements = match requirements {
            Some(Ok(requirements)) => requirements,
            Some(Err(error)) => return self.begin_if(context, id, place, Readiness::Failed(error.reason())),
            None => return false,
        };
        if self.instances.alive.get(&id).is_some_and(|i| i.is_pia()) {
            self.clear_view(context, id);
        }
        let priority = self.priority(id, place.speculative);
        let Some(instance) = self.instances.alive.get_mut(&id) else { return false };
        instance.wait = Wait::Resources;
        if requirements.is_empty() {
            instance.status = Status::Granted;
        } else {
            instance.status = Status::Acquiring;
            context.commands.push(Command::Acquire { instance: id, requirements, priority });
        }
        true
    }

    /// A motion may begin: sensing nodes that would see it, and have not begun or are speculative, step back.
    fn clear_view(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(writes) = self.instances.alive.get(&id).map(|i| i.writes.clone()) else { return };
        let stepping_back: Vec<InstanceId> = self
            .instances
            .alive
            .values()
            .filter(|i| i.nature == NodeNature::Senses && i.is_under_way() && i.senses.overlaps(&writes))
            .map(|i| i.id)
            .collect();
        for other in stepping_back {
            self.stop_instance(context, other);
            if let Some(instance) = self.instances.alive.get_mut(&other) {
                instance.status = Status::Expanded;
                instance.attempt += 1;
                instance.wait = Wait::Writer(id);
            }
        }
    }

    /// It has its resources: it gets its projection, then its goal starts.
    fn proceed(&mut self, context: &mut Context<'_>, id: InstanceId, place: &Place) -> bool {
        let Some(instance) = self.instances.alive.get_mut(&id) else { return false };
        let state = context.program.state(instance.state);
        // While it waited for its resources an older instance may have changed what it would look at.
        if instance.nature == NodeNature::Senses && !same_facts(&instance.senses, &place.world, context.root) {
            instance.status = Status::Expanded;
            instance.wait = Wait::Environment;
            give_back(context, instance);
            return true;
        }
        let is_routine = !matches!(state.kind, StateKind::Action { .. });
        if context.analysis.state(instance.state).needs_world && instance.projection.is_none() && !is_routine {
            instance.status = Status::Projecting;
            context.commands.push(Command::Project {
                instance: id,
                attempt: instance.attempt,
                base: context.root.revision(),
                changes: place.changes.clone(),
                reads: instance.reads.clone(),
            });
            return true;
        }
        instance.status = Status::Running;
        let attempt = instance.attempt;
        context.note(Note::Running { instance: id, attempt });
        if is_routine {
            return self.start_routine(context, id, place);
        }
        let StateKind::Action { provider, action, inputs, .. } = &state.kind else { return false };
        let inputs = place.with_scope(&self.instances, id, None, |scope| binding::inputs(state, inputs, scope));
        let Some(instance) = self.instances.alive.get(&id) else { return false };
        match inputs {
            Some(Ok(inputs)) => {
                let goal = Goal {
                    provider: provider.clone(),
                    action: action.clone(),
                    inputs,
                    seed: binding::seed(context.seed, &instance.path),
                    lease: instance.lease.clone(),
                    projection: instance.projection,
                    expected_s: place
                        .with_scope(&self.instances, id, None, |scope| binding::expected_s(state, scope))
                        .flatten(),
                };
                context.commands.push(Command::Start { instance: id, attempt, goal });
            }
            Some(Err(error)) => self.finish(context, id, Ended::aborted(error.reason())),
            None => return false,
        }
        true
    }

    fn start_routine(&mut self, context: &mut Context<'_>, id: InstanceId, place: &Place) -> bool {
        let Some(instance) = self.instances.alive.get(&id) else { return false };
        let outside = &context.analysis.state(instance.state).flows;
        let outputs = outside.iter().filter_map(|state| {
            let producer = instance.environment.producers.get(state)?;
            Some((*state, self.instances.outputs(*producer)?.clone()))
        });
        let variables = instance.environment.variables.iter().map(|(n, v)| (n.clone(), v.clone())).collect();
        let target = match instance.nature {
            NodeNature::Irreversible => Target::Actual,
            _ => Target::Projection {
                base: context.root.revision(),
                changes: place.changes.clone(),
                before: place.changes.len(),
                world: place.world.clone(),
            },
        };
        let state = context.program.state(instance.state);
        let wanted = &context.analysis.state(instance.state).requirements;
        let requirements =
            place.with_scope(&self.instances, id, None, |scope| binding::requirements(state, wanted, scope));
        let Some(Ok(requirements)) = requirements else { return false };
        let routine = Routine { requirements, lease: instance.lease.clone() };
        let mut interpreter = Box::new(Interpreter::of_routine(variables, outputs.collect(), routine, target));
        let (state, path) = (instance.state, instance.path.clone());
        let progress = interpreter.start(context, state, &path);
        if let Some(instance) = self.instances.alive.get_mut(&id) {
            instance.routine = Some(interpreter);
        }
        self.routine_progressed(context, id, progress);
        true
    }

    /// A finished result that nothing can change any more.
    fn settle_result(&mut self, context: &Context<'_>, id: InstanceId, place: &Place) {
        let Some(instance) = self.instances.alive.get(&id) else { return };
        if instance.settled || instance.ended.is_none() || place.speculative {
            return;
        }
        let flows = match instance.role {
            Role::Node => context.analysis.state(instance.state).flows.clone(),
            Role::Exit => match &context.program.state(instance.state).kind {
                StateKind::Sequence { outputs, .. } => outputs.iter().flat_map(|o| o.value.flows()).collect(),
                _ => Vec::new(),
            },
            _ => Vec::new(),
        };
        let settled = self.instances.flows_settled(&instance.environment, &flows)
            && !instance.reads.overlaps(&place.written)
            && !instance.senses.overlaps(&place.written);
        if let Some(instance) = self.instances.alive.get_mut(&id) {
            instance.settled = settled;
        }
    }
}

/// Whether both worlds say the same about the facts.
fn same_facts(facts: &Footprint, a: &World, b: &World) -> bool {
    let Footprint::Patterns(patterns) = facts else {
        return a.iter().map(|(k, f)| (k, &f.value)).eq(b.iter().map(|(k, f)| (k, &f.value)));
    };
    patterns.iter().all(|pattern| {
        let values = |world: &World| -> Vec<_> {
            world.matching(pattern).map(|(key, fact)| (key.clone(), fact.value.clone())).collect()
        };
        values(a) == values(b)
    })
}
