//! How a node begins: what it still waits for, its resources, its projection, its goal.

use crate::analysis::NodeNature;
use crate::binding;
use crate::context::Context;
use crate::interpreter::{Interpreter, Routine, Target};
use crate::protocol::{Command, Goal, Note};
use crate::window::instance::{Ended, Role, Status, Wait};
use crate::window::place::{Place, may_write};
use crate::window::{Window, give_back};
use ratn_model::expression::FactExpr;
use ratn_model::fact::Footprint;
use ratn_model::id::InstanceId;
use ratn_model::program::{ABORTED, StateKind};
use ratn_world::world::World;

/// What became of an attempt to begin.
pub(super) enum Readiness {
    Ready,
    Waits(Wait),
    /// It never will: the reason it ends `aborted`.
    Failed(String),
}

impl Window {
    /// Whether a node may ask for its resources now.
    pub(super) fn readiness(&mut self, context: &Context<'_>, id: InstanceId, place: &Place) -> Readiness {
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

    pub(super) fn begin_if(
        &mut self,
        context: &mut Context<'_>,
        id: InstanceId,
        place: &Place,
        readiness: Readiness,
    ) -> bool {
        match readiness {
            Readiness::Waits(wait) => {
                if let Some(instance) = self.instances.alive.get_mut(&id) {
                    instance.wait = wait;
                }
                false
            }
            Readiness::Failed(reason) => {
                context.note(Note::Finished { instance: id, outcome: ABORTED.to_owned() });
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
    pub(super) fn proceed(&mut self, context: &mut Context<'_>, id: InstanceId, place: &Place) -> bool {
        let Some(instance) = self.instances.alive.get_mut(&id) else { return false };
        let state = context.program.state(instance.state);
        // While it waited for its resources an older instance may have changed what it would look at.
        if instance.nature == NodeNature::Senses && !same_facts(&instance.senses, &place.world, context.root) {
            instance.status = Status::Expanded;
            instance.attempt += 1;
            instance.wait = Wait::Environment;
            give_back(context, instance);
            return true;
        }
        // Its projection is of this place; by its start some of it may have come true, or not.
        if instance.nature != NodeNature::Irreversible && instance.projection.is_none() {
            instance.seen = Some(place.world.clone());
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
                lease: instance.lease.as_ref().map(|l| (l.id, l.token)),
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
                    timeout_s: state.annotations.timeout_s,
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
