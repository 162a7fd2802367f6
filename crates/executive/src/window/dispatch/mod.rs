//! Dispatch: which instance gets resources first, and which speculative holder gives way.
//!
//! What is certain comes before what is speculative, then the longest remaining path (`estimate`), then program order. A look-ahead
//! may have advised something better. A speculative node counts as much as its path is likely; it leaves the last room for
//! projections to others, and gives back what it holds where it keeps a certain one from it.

mod estimate;
mod holds;
mod outlook;

use super::graph::Graph;
use super::graph::instance::{Instance, Status};
use super::improving::Improving;
use crate::plan::Plan;
use crate::protocol::CERTAIN;
use ratn_model::id::{InstanceId, StateId};
use ratn_model::program::{ResourceExpr, WORLD_MODEL};
use ratn_model::resource::{Quantity, Requirement, ResourceOperation};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// From the top: one bit that says "certain", the urgency, program order. The bits of a positive float are in its order, so
/// the urgency of an unlikely path is small and still tells it from another.
const URGENCY_BITS: u32 = 31;
const ORDER_BITS: u32 = 31;
const _: () = assert!(CERTAIN == 1 << (URGENCY_BITS + ORDER_BITS));

/// How long a node is assumed to take that says nothing, in seconds.
const DEFAULT_DURATION_S: f32 = 1.0;

/// How urgent an instance is: part of the instance, private to this module.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct DispatchCell {
    /// Estimated, in seconds.
    duration_s: Option<f32>,
    /// The longest estimated path from its start to the end of the window, or what a look-ahead advised.
    remaining_s: Option<f32>,
    is_advised: bool,
}

/// Who is under way, who leaves room.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Dispatch {
    /// How much there was of each kind of resource when the run began, where that is known.
    capacity: BTreeMap<String, Quantity>,
    /// What the task has made of each kind since, and what it has removed.
    #[serde(default)]
    made: BTreeMap<String, Quantity>,
    #[serde(default)]
    removed: BTreeMap<String, Quantity>,
    /// By the path of the state, in seconds.
    learned_s: BTreeMap<String, f64>,
    /// Nodes under way: they have asked for resources, hold some, or run.
    active: BTreeSet<InstanceId>,
    /// Those among them that are speculative.
    speculative: BTreeSet<InstanceId>,
    /// Those of these that take room for a projection.
    in_rooms: BTreeSet<InstanceId>,
    /// Speculative nodes that leave room.
    stalled: BTreeSet<InstanceId>,
    /// Who is held back.
    #[serde(default)]
    holds: holds::Holds,
    /// Certain nodes that have asked since the speculative ones were looked at.
    asked: Vec<InstanceId>,
}

impl Dispatch {
    pub(crate) fn new(capacity: BTreeMap<String, Quantity>, learned_s: BTreeMap<String, f64>) -> Dispatch {
        let (made, removed, active, speculative, in_rooms, stalled, holds, asked) = Default::default();
        Dispatch { capacity, made, removed, learned_s, active, speculative, in_rooms, stalled, holds, asked }
    }

    /// The task makes resources, or removes them.
    pub(crate) fn operated(&mut self, operations: &[Requirement]) {
        for operation in operations {
            let changed = match operation.operation {
                ResourceOperation::Create => &mut self.made,
                ResourceOperation::Delete | ResourceOperation::Consume => &mut self.removed,
                ResourceOperation::Block | ResourceOperation::Exists => continue,
            };
            *changed.entry(operation.kind.clone()).or_default() += operation.count;
        }
    }

    /// How much there is of a kind, as far as is known.
    fn there_is(&self, kind: &str) -> Option<Quantity> {
        let (offered, made) = (self.capacity.get(kind).copied(), self.made.get(kind).copied());
        offered.or(made)?;
        let all = offered.unwrap_or_default() + made.unwrap_or_default();
        Some(all.saturating_sub(self.removed.get(kind).copied().unwrap_or_default()))
    }

    /// Nodes under way, oldest first.
    pub(crate) fn active(&self) -> impl Iterator<Item = InstanceId> + '_ {
        self.active.iter().copied()
    }

    /// The priority of an acquire: larger first.
    pub(crate) fn priority(&self, graph: &Graph, instance: &Instance) -> i64 {
        let certain = if graph.is_speculative(instance.segment) { 0 } else { CERTAIN };
        let remaining_s = instance.dispatch.remaining_s.or(instance.dispatch.duration_s).unwrap_or(DEFAULT_DURATION_S);
        let urgency = (f64::from(remaining_s) * graph.probability(instance.segment)).max(0.0) as f32;
        let urgency = if urgency.is_finite() { i64::from(urgency.to_bits()) } else { i64::from(f32::MAX.to_bits()) };
        // Ids grow in program order.
        let greatest = (1_i64 << ORDER_BITS) - 1;
        let order = i64::try_from(instance.id.0).unwrap_or(i64::MAX).min(greatest);
        certain | (urgency << ORDER_BITS) | (greatest - order)
    }

    /// A node asks for resources, or goes on without any.
    pub(crate) fn begin(&mut self, graph: &Graph, plan: &Plan, instance: &Instance) {
        self.active.insert(instance.id);
        self.stalled.remove(&instance.id);
        if graph.is_speculative(instance.segment) {
            self.speculative.insert(instance.id);
            if plan.state(instance.state).needs_world {
                self.in_rooms.insert(instance.id);
            }
        } else {
            self.asked.push(instance.id);
        }
    }

    /// It does not hold anything any more, nor does it act or look.
    pub(crate) fn end(&mut self, id: InstanceId) {
        self.active.remove(&id);
        self.speculative.remove(&id);
        self.in_rooms.remove(&id);
    }

    /// It has left the window.
    pub(crate) fn forget(&mut self, id: InstanceId) {
        self.end(id);
        self.stalled.remove(&id);
        self.holds.remove(&id);
    }

    /// Its path is decided. Whether it has to ask anew, as somebody who is certain.
    pub(crate) fn became_certain(&mut self, id: InstanceId) -> bool {
        self.in_rooms.remove(&id);
        self.stalled.remove(&id);
        self.speculative.remove(&id)
    }

    /// A certain node, or a routine that is, has asked again.
    pub(crate) fn asks_again(&mut self, graph: &Graph, instance: &Instance) {
        if !graph.is_speculative(instance.segment) {
            self.asked.push(instance.id);
        }
    }

    /// Whether it is under way, or asks, and may be in vain.
    pub(crate) fn is_speculative(&self, id: InstanceId) -> bool {
        self.speculative.contains(&id)
    }

    /// Whether a node may take room for a projection: a speculative one leaves the last to those that are not.
    pub(crate) fn leaves_room(&self, graph: &Graph, instance: &Instance, requirements: &[Requirement]) -> bool {
        let needs = || requirements.iter().any(|r| r.kind == WORLD_MODEL);
        !graph.is_speculative(instance.segment) || !needs() || self.free_rooms().is_none_or(|free| free > 0)
    }

    /// How many speculative nodes more may have a projection; `None` where nothing is known of how many there are.
    fn free_rooms(&self) -> Option<usize> {
        let rooms = self.capacity.get(WORLD_MODEL)?.units() as usize;
        // One is left to those that are certain, if there are more.
        if rooms <= 1 { None } else { Some((rooms - 1).saturating_sub(self.in_rooms.len())) }
    }

    /// It waits until there is room.
    pub(crate) fn stall(&mut self, id: InstanceId) {
        self.stalled.insert(id);
    }

    /// The most urgent of those that wait for room, as many as there is room for.
    pub(crate) fn take_stalled(&mut self, graph: &Graph) -> Vec<InstanceId> {
        if self.stalled.is_empty() {
            return Vec::new();
        }
        let free = self.free_rooms().unwrap_or(self.stalled.len());
        if free == 0 {
            return Vec::new();
        }
        let waiting = self.stalled.iter().filter_map(|id| graph.get(*id));
        let mut ranked: Vec<(i64, InstanceId)> = waiting.map(|i| (self.priority(graph, i), i.id)).collect();
        ranked.sort_unstable_by(|a, b| b.cmp(a));
        let first: Vec<InstanceId> = ranked.into_iter().take(free).map(|(_, id)| id).collect();
        for id in &first {
            self.stalled.remove(id);
        }
        first
    }

    /// Whoever waits for the resource manager with another priority than it would ask with now.
    pub(crate) fn misplaced(&self, graph: &Graph) -> Vec<InstanceId> {
        let asking = |id: &InstanceId| match graph.node(*id)?.status {
            Status::Acquiring { priority } => Some((*id, priority)),
            _ => None,
        };
        let now = |id: InstanceId| graph.get(id).map(|instance| self.priority(graph, instance));
        let asked = self.active.iter().filter_map(asking);
        asked.filter(|(id, with)| now(*id) != Some(*with)).map(|(id, _)| id).collect()
    }

    /// Speculative holders that keep certain nodes from what they have asked for: each with whom it gives way to, the least urgent
    /// first. Looked at once for all that have asked.
    pub(crate) fn in_the_way(&mut self, graph: &Graph, plan: &Plan) -> Vec<(InstanceId, InstanceId)> {
        let asked = std::mem::take(&mut self.asked);
        if self.speculative.is_empty() || asked.is_empty() {
            return Vec::new();
        }
        let mut wanted: BTreeMap<&str, InstanceId> = BTreeMap::new();
        for id in asked {
            let Some(instance) = graph.get(id) else { continue };
            for (kind, _) in blocks(plan, instance.state) {
                wanted.entry(kind).or_insert(id);
            }
        }
        let mut taken: BTreeMap<&str, Quantity> = BTreeMap::new();
        let mut holders: BTreeMap<&str, Vec<(i64, InstanceId, Quantity)>> = BTreeMap::new();
        for instance in self.active.iter().filter_map(|id| graph.get(*id)) {
            let is_certain = !self.speculative.contains(&instance.id);
            let holds = instance.node().is_some_and(|node| node.status.since().is_some());
            // What is certain and waits shall be served, too.
            if !is_certain && !holds {
                continue;
            }
            for (kind, count) in blocks(plan, instance.state).filter(|(kind, _)| wanted.contains_key(kind)) {
                *taken.entry(kind).or_default() += count;
                if !is_certain {
                    holders.entry(kind).or_default().push((self.priority(graph, instance), instance.id, count));
                }
            }
        }
        let mut giving_way: BTreeMap<InstanceId, InstanceId> = BTreeMap::new();
        let mut order = Vec::new();
        for (kind, by) in wanted {
            let Some(capacity) = self.there_is(kind) else { continue };
            let mut left = taken.get(kind).copied().unwrap_or_default();
            let mut all = holders.remove(kind).unwrap_or_default();
            all.sort_unstable();
            for (_, holder, count) in all {
                if left <= capacity {
                    break;
                }
                left = left.saturating_sub(count);
                if giving_way.insert(holder, by).is_none() {
                    order.push((holder, by));
                }
            }
        }
        order
    }

    /// Speculative holders that may keep a certain node from what it has asked for, where counting does not tell: it is not known how much
    /// there is, or one of them takes only what has certain attributes.
    pub(crate) fn perhaps_in_the_way(&self, graph: &Graph, plan: &Plan, asks: InstanceId) -> Vec<InstanceId> {
        let Some(instance) = graph.get(asks).filter(|instance| !graph.is_speculative(instance.segment)) else {
            return Vec::new();
        };
        let blocked = |state: StateId| {
            plan.state(state).requirements.iter().filter(|wanted| wanted.operation == ResourceOperation::Block)
        };
        let is_open = |wanted: &ResourceExpr, held: &ResourceExpr| {
            let selects = wanted.expressions().chain(held.expressions()).next().is_some();
            wanted.kind == held.kind && (selects || self.there_is(&wanted.kind).is_none())
        };
        let keeps = |holder: &Instance| {
            holder.node().is_some_and(|node| node.status.since().is_some())
                && blocked(instance.state).any(|wanted| blocked(holder.state).any(|held| is_open(wanted, held)))
        };
        let holders = self.speculative.iter().filter_map(|id| graph.get(*id));
        holders.filter(|holder| keeps(holder)).map(|holder| holder.id).collect()
    }

    /// Who holds only to improve a result what an instance that asks cannot have beside it, as far as is known how much there is; whoever has
    /// improved for longest first.
    pub(crate) fn too_much(
        &self,
        graph: &Graph,
        plan: &Plan,
        improving: &Improving,
        asks: InstanceId,
    ) -> BTreeSet<InstanceId> {
        let mut in_the_way = BTreeSet::new();
        let Some(instance) = graph.get(asks) else { return in_the_way };
        for (kind, _) in blocks(plan, instance.state) {
            let Some(capacity) = self.there_is(kind) else { continue };
            let of = |state: StateId| {
                blocks(plan, state).filter(|(other, _)| *other == kind).map(|(_, count)| count).sum::<Quantity>()
            };
            let active = self.active.iter().filter_map(|id| graph.get(*id));
            let mut taken: Quantity = active.map(|instance| of(instance.state)).sum();
            let holders = improving.iter().map(|(id, improvement)| (id, of(improvement.state)));
            let holders: Vec<_> = holders.filter(|(_, count)| *count > Quantity::default()).collect();
            taken += holders.iter().filter(|(id, _)| !in_the_way.contains(id)).map(|(_, count)| *count).sum();
            for (id, count) in holders {
                if taken <= capacity {
                    break;
                }
                if in_the_way.insert(id) {
                    taken = taken.saturating_sub(count);
                }
            }
        }
        in_the_way
    }

    /// What is wrong, if anything: who is under way is active, and nobody else.
    pub(crate) fn check_invariants(&self, graph: &Graph) -> Result<(), String> {
        for instance in graph.iter() {
            if instance.is_under_way() != self.active.contains(&instance.id) {
                let is = if instance.is_under_way() { "is" } else { "is not" };
                return Err(format!("{} {is} under way, and dispatch does not know", instance.id));
            }
        }
        for id in self.active.iter().chain(&self.stalled) {
            if !graph.contains(*id) {
                return Err(format!("{id} is under way or leaves room, and is not in the window"));
            }
        }
        let wrong = self.speculative.iter().find(|id| graph.get(**id).is_none_or(|i| !graph.is_speculative(i.segment)));
        if let Some(wrong) = wrong {
            return Err(format!("{wrong} counts as speculative, and is not"));
        }
        if !self.stalled.is_empty() && self.free_rooms().is_none_or(|free| free > 0) {
            return Err("somebody waits for room although there is some".to_owned());
        }
        Ok(())
    }
}

/// The kinds that the node of a state blocks, and how much.
fn blocks(plan: &Plan, state: StateId) -> impl Iterator<Item = (&str, Quantity)> {
    let requirements = plan.state(state).requirements.iter();
    requirements.filter(|r| r.operation == ResourceOperation::Block).map(|r| (r.kind.as_str(), r.count))
}
