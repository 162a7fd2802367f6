//! Readiness of a node: finds the first thing that is missing before it may ask for its resources.

use super::Window;
use super::beside::is_in_order;
use super::graph::instance::{Changed, Ended, Instance, Role};
use super::growth::environment::Link;
use super::memory::{Blocked, Looked, Seen, Sight, View, facts_of};
use super::outside::decides_from;
use super::waits::Wait;
use crate::binding::{self, BindError, Outputs};
use crate::context::Context;
use crate::plan::{Effects, MAX_OUTCOMES, NodeNature, WAITS};
use ratn_model::expression::FactExpr;
use ratn_model::fact::{FactPattern, Footprint};
use ratn_model::id::InstanceId;
use ratn_model::program::StateKind;
use ratn_model::resource::Requirement;

/// Whether a node may begin.
pub(super) enum Readiness {
    /// Ready, with these requirements and, unless it is a PIA, these inputs.
    Ready(Vec<Requirement>, Option<Outputs>),
    /// Waiting. The [`Wait`] names the instance to wait for; without one, another event will re-examine this one.
    Waits(Wait),
    /// It can never begin: it ends `aborted` for this reason.
    Failed(String),
}

/// The facts that an instance reads and writes.
struct Touches {
    reads: Footprint,
    writes: Footprint,
}

impl Window {
    /// Whether a node may ask for its resources now.
    pub(super) fn readiness(
        &self,
        context: &Context<'_>,
        instance: &Instance,
        view: &View<'_>,
        seen: &mut Seen,
    ) -> Readiness {
        let Some(node) = instance.node() else { return Readiness::Waits(Wait::Nothing) };
        let own = context.plan.state(instance.state);
        let state = context.program.state(instance.state);
        let is_pia = instance.is_pia();
        if is_pia && !instance.is_head {
            return Readiness::Waits(Wait::Order);
        }
        if node.not_before > context.now {
            return Readiness::Waits(Wait::Backoff);
        }
        if is_pia && !self.hold.lets_begin(instance.id, instance.state) {
            return Readiness::Waits(Wait::Pause);
        }
        if node.crashes > 0
            && let Some(decision) = self.graph.undecided(instance)
        {
            // A node that has crashed workers is not tried again before it is certain that it is needed.
            return Readiness::Waits(Wait::Decision(decision));
        }
        let variables = own.variables.iter().map(String::as_str);
        if let Some(producer) = view.sight.missing(view.instance, own.start_flows.iter().copied(), variables) {
            return Readiness::Waits(Wait::Data(producer));
        }
        if let Some(writer) = view.operator_of(&own.kinds) {
            return Readiness::Waits(Wait::TaskResource(writer));
        }
        if own.nature == NodeNature::Senses
            && let Some(waiting) = view.operator_of(&[WAITS])
        {
            return Readiness::Waits(Wait::Waiting(waiting));
        }
        if own.waits
            && let Some(beside) = self.older_beside(instance)
        {
            return Readiness::Waits(Wait::World(beside));
        }
        if is_pia && let Some(beside) = self.conflict_beside(context, instance) {
            return Readiness::Waits(Wait::World(beside));
        }
        if is_pia && let Some(beside) = self.producer_beside(view.sight, view.instance) {
            return Readiness::Waits(Wait::Data(beside));
        }
        if !is_pia {
            match look(context, view, node.nature) {
                Ok(looked) => *seen = looked,
                Err(wait) => return Readiness::Waits(wait),
            }
        }
        if let Some(wait) = self.keep_out_of_the_way(context, instance, view) {
            return Readiness::Waits(wait);
        }
        match binding::unmet(state, view) {
            Ok(None) => {}
            Ok(Some(reason)) => {
                let required = facts_of(&state.annotations.requires, view);
                // On a projection an unmet precondition means waiting; in the actual world it means failure.
                match view.sight.writer_of(view.instance, Looked::at(&required)).filter(|_| !is_pia) {
                    Some(writer) => return Readiness::Waits(Wait::World(writer)),
                    None => return Readiness::Failed(reason),
                }
            }
            Err(error) => return not_bound(view, &error),
        }
        let requirements = match binding::requirements(state, &own.requirements, view) {
            Ok(requirements) => requirements,
            Err(error) => return not_bound(view, &error),
        };
        let mut bound = None;
        if let (StateKind::Action { inputs, .. }, false) = (&state.kind, is_pia) {
            match binding::inputs(state, inputs, view) {
                Ok(inputs) => {
                    seen.see_inputs(&inputs);
                    bound = Some(inputs);
                }
                Err(error) => return not_bound(view, &error),
            }
        }
        if !requirements.is_empty() && self.dispatch.is_held(&self.graph, instance.id) {
            return Readiness::Waits(Wait::Turn);
        }
        Readiness::Ready(requirements, bound)
    }

    /// Keeps sensing nodes and nodes that change the sensed facts apart; the older one goes first. Concurrent regions have no order: there a sensing node
    /// that runs ahead keeps out of the way of motions, and one at its place looks beside them, as in the sequential program.
    fn keep_out_of_the_way(&self, context: &Context<'_>, instance: &Instance, view: &View<'_>) -> Option<Wait> {
        let others = || self.dispatch.active().filter(|id| *id != instance.id).filter_map(|id| self.graph.get(id));
        match instance.node()?.nature {
            NodeNature::Computes => None,
            // Everything older has ended.
            NodeNature::Senses if instance.node().is_some_and(|node| node.is_at_its_place) => None,
            NodeNature::Senses => {
                let senses = FactExpr::footprint(&context.plan.state(instance.state).senses, view);
                let writes = |other: &Instance| self.writes(context, other).overlaps(&senses);
                let writer = others().find(|other| other.is_pia() && writes(other));
                let about_to = || {
                    let mut waiting = self.graph.heads().filter(|head| {
                        head.is_pia() && matches!(head.waiting.wait(), Wait::Sensing(_)) && head.ended().is_none()
                    });
                    waiting.find(|head| head.id != instance.id && writes(head))
                };
                writer.or_else(about_to).map(|other| Wait::Writer(other.id))
            }
            NodeNature::Irreversible => {
                let mut sensing = others().filter(|other| other.is_sensing() && has_begun(other)).peekable();
                sensing.peek()?;
                let writes = self.writes(context, instance);
                let looking = sensing.find(|other| {
                    !self.graph.is_speculative(other.segment)
                        && is_in_order(other, instance)
                        && self.senses(context, other).overlaps(&writes)
                });
                looking.map(|other| Wait::Sensing(other.id))
            }
        }
    }

    /// A detached PIA, older than the instance, that must end before the instance begins or retires, because of conflicting facts or resources.
    pub(super) fn conflict_beside(&self, context: &Context<'_>, instance: &Instance) -> Option<InstanceId> {
        self.conflict_of_end(context, instance, instance.ended())
    }

    /// The same for an instance with this end, if it has one.
    pub(super) fn conflict_of_end(
        &self,
        context: &Context<'_>,
        instance: &Instance,
        ended: Option<&Ended>,
    ) -> Option<InstanceId> {
        // A wait reads the root only, and changes nothing.
        if self.graph.detached().is_empty() || context.program.state(instance.state).is_pause() {
            return None;
        }
        let own = context.plan.state(instance.state);
        let mine = self.touches(context, instance, ended);
        if let Some(beside) = self.beside_of_shared(context, instance, [&mine.reads, &mine.writes]) {
            return Some(beside);
        }
        // A resource that it deletes or consumes at its end may be held by the other.
        let operates = matches!(instance.role(), None | Some(Role::Exit));
        let uses = |other: &Instance| {
            let kinds = &context.plan.state(other.state).kinds;
            operates && own.operated.iter().any(|kind| kinds.contains(kind))
        };
        self.graph.detached().iter().copied().filter(|id| *id < instance.id).find(|id| {
            let Some(other) = self.graph.get(*id) else { return false };
            // Facts that concurrent regions share are not ordered.
            let conflicts = || {
                let its = self.touches(context, other, other.ended());
                its.writes.overlaps(&mine.reads)
                    || its.writes.overlaps(&mine.writes)
                    || its.reads.overlaps(&mine.writes)
            };
            uses(other) || (is_in_order(other, instance) && conflicts())
        })
    }

    /// An older detached PIA that the sequential program executes before the instance. A wait does not begin beside one: the signal that it
    /// takes would be lost if the PIA fails and the wait's path is left.
    pub(super) fn older_beside(&self, instance: &Instance) -> Option<InstanceId> {
        let is_before = |id: &InstanceId| {
            let other = self.graph.get(*id).filter(|other| other.id < instance.id);
            other.is_some_and(|other| is_in_order(other, instance))
        };
        self.graph.detached().iter().copied().find(is_before)
    }

    /// A detached PIA whose outputs the instance uses, also in its effects.
    pub(super) fn producer_beside<'a>(&self, sight: Sight<'a>, instance: &'a Instance) -> Option<InstanceId> {
        if self.graph.detached().is_empty() {
            return None;
        }
        sight.producers_of(instance).find(|producer| self.graph.detached().contains(producer))
    }

    /// The facts that an instance reads or requires, at its beginning or at its end, and those that it may write: with its outcome if it has
    /// ended, else with any outcome that is computed ahead.
    fn touches(&self, context: &Context<'_>, instance: &Instance, ended: Option<&Ended>) -> Touches {
        self.look(context, instance.id, None, |instance, view| {
            let state = context.program.state(instance.state);
            let own = context.plan.state(instance.state);
            let mut reads = match (instance.role(), &own.reads) {
                (None, Some(facts)) => FactExpr::footprint(facts, view),
                (None, None) => Footprint::Everything,
                _ => {
                    let seen = instance.seen().into_iter().flat_map(|seen| &seen.read);
                    seen.cloned().fold(Footprint::NOTHING, Footprint::union)
                }
            };
            reads = reads.union(facts_of(&state.annotations.requires, view));
            reads = reads.union(facts_of(decides_from(context.program, instance), view));
            reads = reads.union(FactExpr::footprint(&own.looked_up_at_end, view));
            let by = ended.and_then(|ended| own.outcome(&ended.outcome));
            let outcomes: Vec<usize> = match (instance.marker(), by) {
                (Some(marker), _) if marker.role == Role::Exit => vec![marker.leaves_by],
                (_, Some(outcome)) => vec![outcome],
                (_, None) => {
                    let ahead = own.arms.iter().fold(0, |all, arm| all | arm.outcomes);
                    (0..own.outcomes.len().min(MAX_OUTCOMES)).filter(|n| ahead & (1 << n) != 0).collect()
                }
            };
            // A wait does not make the changes that it foresees.
            let outcomes = if state.is_pause() { Vec::new() } else { outcomes };
            let link = |outcome| Link { writer: instance.id, outcome, vague: false };
            let each =
                outcomes.into_iter().map(|outcome| match (&own.effects[outcome], ended.map(|ended| &ended.changes)) {
                    // Of an action without declared effects what it has measured becomes real.
                    (Effects::Unknown, Some(Changed::Declared(measured, _))) if !own.is_routine => {
                        Footprint::Patterns(measured.iter().map(|(fact, _)| FactPattern::of(fact)).collect())
                    }
                    _ => view.sight.may_write_along(view, link(outcome)),
                });
            Touches { reads, writes: each.fold(Footprint::NOTHING, Footprint::union) }
        })
        .unwrap_or(Touches { reads: Footprint::NOTHING, writes: Footprint::NOTHING })
    }

    /// The facts that an instance may write.
    pub(super) fn writes(&self, context: &Context<'_>, instance: &Instance) -> Footprint {
        self.touches(context, instance, instance.ended()).writes
    }

    /// The facts that a sensing instance senses.
    pub(super) fn senses(&self, context: &Context<'_>, instance: &Instance) -> Footprint {
        let senses = &context.plan.state(instance.state).senses;
        let looked = self.look(context, instance.id, None, |_, view| FactExpr::footprint(senses, view));
        looked.unwrap_or(Footprint::NOTHING)
    }
}

/// Reads the facts of a computing or sensing node at its place. A sensing node has to wait until the root shows the facts that it senses as they
/// will be at its place.
pub(super) fn look(context: &Context<'_>, view: &View<'_>, nature: NodeNature) -> Result<Seen, Wait> {
    let own = context.plan.state(view.instance.state);
    let blocked = |Blocked(writer)| Wait::World(writer);
    let mut seen = Seen::default();
    if nature == NodeNature::Senses {
        let senses = FactExpr::footprint(&own.senses, view);
        if !view.is_shown(&senses).map_err(blocked)? {
            let writer = view.sight.writer_of(view.instance, Looked::at(&senses));
            return Err(writer.map_or(Wait::Order, Wait::Environment));
        }
    }
    let reads = match &own.reads {
        Some(facts) => FactExpr::footprint(facts, view),
        None => Footprint::Everything,
    };
    view.see(reads, &mut seen).map_err(blocked)?;
    Ok(seen)
}

/// Whether it has its resources and has not ended.
fn has_begun(instance: &Instance) -> bool {
    instance.node().is_some_and(|node| node.status.since().is_some())
}

pub(super) fn not_bound(view: &View<'_>, error: &BindError) -> Readiness {
    match view.blocker() {
        Some(blocker) if error.source.is_not_yet_known() => Readiness::Waits(Wait::World(blocker)),
        _ => Readiness::Failed(error.reason()),
    }
}
