//! What a node still waits for before it may ask for its resources.
//!
//! A node that is not ready waits for exactly one older instance (the first thing that was found missing) and is looked at
//! again when that instance has gone on: the work per event is proportional to what it touches, not to the window.

use super::Window;
use super::environment::{Binding, Link};
use super::instance::{Instance, Role, Seen, Wait};
use super::view::{Blocked, Sight, View};
use crate::binding::{self, BindError, Outputs};
use crate::context::Context;
use crate::plan::MAX_OUTCOMES;
use crate::plan::NodeNature;
use ratn_model::expression::{Expr, FactExpr};
use ratn_model::fact::{FactKey, Footprint};
use ratn_model::id::InstanceId;
use ratn_model::program::StateKind;
use ratn_model::resource::Requirement;
use ratn_model::value::Value;
use ratn_world::digest::Digest;
use ratn_world::world::World;

/// Whether a node may begin.
pub(super) enum Readiness {
    /// With these resources and, of what is no PIA, these inputs.
    Ready(Vec<Requirement>, Option<Outputs>),
    /// Not before something else; whom to wait for is in it, or somebody else will look again.
    Waits(Wait),
    /// It never will: the reason it ends `aborted`.
    Failed(String),
}

impl Wait {
    /// The instance whose going on ends the wait.
    pub(super) fn on(&self) -> Option<InstanceId> {
        match self {
            Wait::Data(id)
            | Wait::World(id)
            | Wait::Environment(id)
            | Wait::Sensing(id)
            | Wait::Writer(id)
            | Wait::TaskResource(id)
            | Wait::Twin(id)
            | Wait::Decision(id)
            | Wait::Settling(id) => Some(*id),
            _ => None,
        }
    }
}

impl Window {
    /// Whether a node may ask for its resources now, what it will have been made of, and whose effects that takes.
    pub(super) fn readiness(&self, context: &Context<'_>, id: InstanceId) -> (Readiness, Seen, Vec<InstanceId>) {
        let mut seen = Seen::default();
        let Some(instance) = self.instances.get(id) else {
            return (Readiness::Waits(Wait::Nothing), seen, Vec::new());
        };
        let view = self.sight(context).view(instance, None);
        let readiness = self.examine_node(context, instance, &view, &mut seen);
        (readiness, seen, view.used())
    }

    fn examine_node(&self, context: &Context<'_>, instance: &Instance, view: &View<'_>, seen: &mut Seen) -> Readiness {
        let analysis = context.plan.state(instance.state);
        let plan = self.plan.state(instance.state);
        let state = context.program.state(instance.state);
        let is_pia = instance.is_pia();
        if is_pia && !instance.is_head {
            return Readiness::Waits(Wait::Order);
        }
        if instance.not_before > context.now {
            return Readiness::Waits(Wait::Backoff);
        }
        if is_pia && !self.hold.lets_begin() {
            return Readiness::Waits(Wait::Pause);
        }
        if instance.crashes > 0
            && let Some(decision) = self.undecided(instance)
        {
            // What kills workers is not tried again before it is known to be needed.
            return Readiness::Waits(Wait::Decision(decision));
        }
        let sight = self.sight(context);
        if let Some(producer) = missing(sight, instance, &analysis.start_flows, &plan.variables) {
            return Readiness::Waits(Wait::Data(producer));
        }
        if let Some(writer) = view.operator_of(&plan.kinds) {
            return Readiness::Waits(Wait::TaskResource(writer));
        }
        if is_pia && let Some(beside) = self.conflict_beside(context, instance) {
            return Readiness::Waits(Wait::World(beside));
        }
        if is_pia && let Some(beside) = self.producer_beside(instance) {
            return Readiness::Waits(Wait::Data(beside));
        }
        if !is_pia {
            match self.look(context, instance, view) {
                Ok(looked) => *seen = looked,
                Err(wait) => return Readiness::Waits(wait),
            }
        }
        if let Some(wait) = self.keep_out_of_the_way(context, instance, view) {
            return Readiness::Waits(wait);
        }
        match binding::unmet(state, view) {
            Ok(None) => {}
            Ok(Some(reason)) => match view.writer_of(&facts_of(&state.annotations.requires, view)) {
                // On a projection it only holds back; in the actual world it is decided.
                Some(writer) if !is_pia => return Readiness::Waits(Wait::World(writer)),
                _ => return Readiness::Failed(reason),
            },
            Err(error) => return not_bound(view, &error),
        }
        let requirements = match binding::requirements(state, &analysis.requirements, view) {
            Ok(requirements) => requirements,
            Err(error) => return not_bound(view, &error),
        };
        let mut bound = None;
        if let (StateKind::Action { inputs, .. }, false) = (&state.kind, is_pia) {
            match binding::inputs(state, inputs, view) {
                Ok(inputs) => {
                    seen.inputs = Digest::of_values(&inputs);
                    bound = Some(inputs);
                }
                Err(error) => return not_bound(view, &error),
            }
        }
        Readiness::Ready(requirements, bound)
    }

    /// The facts that a computing or sensing node reads, as they are at its place; a sensing one only when the environment
    /// shows them so.
    pub(super) fn look(&self, context: &Context<'_>, instance: &Instance, view: &View<'_>) -> Result<Seen, Wait> {
        let analysis = context.plan.state(instance.state);
        let reads = match &analysis.reads {
            Some(facts) => FactExpr::footprint(facts, view),
            None => Footprint::Everything,
        };
        let senses = FactExpr::footprint(&analysis.senses, view);
        let blocked = |Blocked(writer)| Wait::World(writer);
        let mut seen = Seen::default();
        if !senses.is_nothing() {
            let sensed = view.facts(&senses).map_err(blocked)?;
            if !shows(context.root, &senses, &sensed) {
                return Err(view.writer_of(&senses).map_or(Wait::Order, Wait::Environment));
            }
            seen.facts.extend(sensed);
            seen.read.push(senses);
        }
        if !reads.is_nothing() {
            seen.facts.extend(view.facts(&reads).map_err(blocked)?);
            seen.read.push(reads);
        }
        Ok(seen)
    }

    /// Sensing nodes and those who change what they look at keep out of each other's way; the older goes first.
    fn keep_out_of_the_way(&self, context: &Context<'_>, instance: &Instance, view: &View<'_>) -> Option<Wait> {
        let others = || self.active.iter().filter(|id| **id != instance.id).filter_map(|id| self.instances.get(*id));
        let sight = self.sight(context);
        match instance.nature {
            NodeNature::Computes => None,
            NodeNature::Senses => {
                let senses = FactExpr::footprint(&context.plan.state(instance.state).senses, view);
                let writer = others().find(|other| other.is_pia() && self.writes(context, other).overlaps(&senses));
                let about_to = || {
                    let heads = self.threads.values().filter_map(|thread| self.instances.get(thread.head?));
                    let mut waiting = heads.filter(|head| matches!(head.wait, Wait::Sensing(_)) && head.is_pia());
                    waiting.find(|head| head.id != instance.id && self.writes(context, head).overlaps(&senses))
                };
                writer.or_else(about_to).map(|other| Wait::Writer(other.id))
            }
            NodeNature::Irreversible => {
                let writes = self.writes(context, instance);
                let looking = others().find(|other| {
                    other.nature == NodeNature::Senses
                        && other.status != super::instance::Status::Acquiring
                        && !self.is_speculative(other.segment)
                        && senses_of(context, sight, other).overlaps(&writes)
                });
                looking.map(|other| Wait::Sensing(other.id))
            }
        }
    }

    /// An imprecise PIA that still runs beside an instance, although older, and must end before it begins.
    pub(super) fn conflict_beside(&self, context: &Context<'_>, instance: &Instance) -> Option<InstanceId> {
        if self.detached.is_empty() {
            return None;
        }
        let (reads, writes) = self.touches(context, instance);
        self.detached.iter().copied().filter(|id| *id < instance.id).find(|id| {
            let Some(other) = self.instances.get(*id) else { return false };
            let (its_reads, _) = self.touches(context, other);
            let its_writes = self.writes(context, other);
            its_writes.overlaps(&reads) || its_writes.overlaps(&writes) || its_reads.overlaps(&writes)
        })
    }

    /// An imprecise PIA that still runs beside an instance and whose outputs it is made of, its effects included.
    pub(super) fn producer_beside(&self, instance: &Instance) -> Option<InstanceId> {
        if self.detached.is_empty() {
            return None;
        }
        self.producers_of(instance).find(|producer| self.detached.contains(producer))
    }

    /// What an instance reads or requires, at its beginning or at its end, and what it writes on the path that is computed ahead.
    fn touches(&self, context: &Context<'_>, instance: &Instance) -> (Footprint, Footprint) {
        let sight = self.sight(context);
        let view = sight.view(instance, None);
        let state = context.program.state(instance.state);
        let analysis = context.plan.state(instance.state);
        let mut reads = match (instance.role, &analysis.reads) {
            (Role::Node, Some(facts)) => FactExpr::footprint(facts, &view),
            (Role::Node, None) => Footprint::Everything,
            _ => instance.seen.as_ref().map_or(Footprint::NOTHING, |seen| {
                seen.read.iter().cloned().fold(Footprint::NOTHING, Footprint::union)
            }),
        };
        reads = reads.union(facts_of(&state.annotations.requires, &view));
        reads = reads.union(FactExpr::footprint(&analysis.senses, &view));
        // What its effects are made of is read when it ends.
        reads = reads.union(FactExpr::footprint(&analysis.effect_lookups, &view));
        (reads, self.writes(context, instance))
    }

    /// What an instance may write: with the outcome that it had, else with any that is computed ahead.
    pub(super) fn writes(&self, context: &Context<'_>, instance: &Instance) -> Footprint {
        let view = self.sight(context).view(instance, None);
        let plan = self.plan.state(instance.state);
        let ended = instance.ended.as_ref().and_then(|ended| plan.outcome(&ended.outcome));
        let outcomes = match (instance.role, ended) {
            (Role::Exit, _) => vec![instance.leaves_by],
            (_, Some(outcome)) => vec![outcome],
            (_, None) => {
                let ahead = plan.arms.iter().fold(0, |all, arm| all | arm.outcomes);
                (0..plan.outcomes.len().min(MAX_OUTCOMES)).filter(|outcome| ahead & (1 << outcome) != 0).collect()
            }
        };
        let link = |outcome| Link { writer: instance.id, outcome, vague: false };
        let each = outcomes.into_iter().map(|outcome| view.may_write(instance, link(outcome)));
        each.fold(Footprint::NOTHING, Footprint::union)
    }
}

/// The facts that expressions look up.
pub(super) fn facts_of(expressions: &[Expr], view: &View<'_>) -> Footprint {
    let facts: Vec<FactExpr> = expressions.iter().flat_map(Expr::fact_expressions).cloned().collect();
    FactExpr::footprint(&facts, view)
}

/// What a sensing instance looks at.
pub(super) fn senses_of(context: &Context<'_>, sight: Sight<'_>, instance: &Instance) -> Footprint {
    FactExpr::footprint(&context.plan.state(instance.state).senses, &sight.view(instance, None))
}

/// The first older instance whose output or assignment is needed and not there yet.
pub(super) fn missing(
    sight: Sight<'_>,
    instance: &Instance,
    flows: &[ratn_model::id::StateId],
    variables: &[String],
) -> Option<InstanceId> {
    let environment = &instance.environment;
    let assigned = variables.iter().filter_map(|name| match environment.variables.get(name)? {
        Binding::Assigned(producer) => Some(producer),
        Binding::Known(_) => None,
    });
    let producers = flows.iter().filter_map(|state| environment.producer(*state)).chain(assigned);
    producers
        .filter(|producer| producer.real.get().is_none())
        .find(|producer| sight.instances.get(producer.instance).is_some_and(|other| other.ended.is_none()))
        .map(|producer| producer.instance)
}

/// Whether the actual world shows these facts just so.
pub(super) fn shows(root: &World, footprint: &Footprint, facts: &[(FactKey, Value)]) -> bool {
    let mut actual: Vec<(&FactKey, &Value)> = match footprint {
        Footprint::Everything => root.iter().map(|(key, fact)| (key, &fact.value)).collect(),
        Footprint::Patterns(patterns) => {
            patterns.iter().flat_map(|p| root.matching(p)).map(|(key, fact)| (key, &fact.value)).collect()
        }
    };
    actual.sort_by_key(|(key, _)| *key);
    actual.dedup_by_key(|(key, _)| *key);
    actual.len() == facts.len() && actual.iter().zip(facts).all(|((a, x), (b, y))| *a == b && *x == y)
}

pub(super) fn not_bound(view: &View<'_>, error: &BindError) -> Readiness {
    match view.blocker() {
        Some(blocker) if error.source.is_not_yet_known() => Readiness::Waits(Wait::World(blocker)),
        _ => Readiness::Failed(error.reason()),
    }
}
