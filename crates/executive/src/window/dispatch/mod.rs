//! Dispatch: which instance gets resources first, and which speculative holder gives way.
//!
//! Certain instances come before speculative ones, then the longest remaining path counts (`estimate`), then program order; look-ahead may
//! have advised a better order. A speculative node's urgency is multiplied by the probability of its path. Speculative nodes leave the last
//! room for projections to others, and give way to certain nodes.

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

/// Bits of a priority, from the top: one bit for "certain", the urgency, program order. The bits of positive floats have the same order as
/// their values, so the small urgencies of unlikely paths stay distinguishable.
const URGENCY_BITS: u32 = 31;
const ORDER_BITS: u32 = 31;
const _: () = assert!(CERTAIN == 1 << (URGENCY_BITS + ORDER_BITS));

/// Assumed duration of a node without an estimate, in seconds.
const DEFAULT_DURATION_S: f32 = 1.0;

/// The urgency of an instance: part of the instance, private to this module.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct DispatchCell {
    /// Estimated duration, in seconds.
    duration_s: Option<f32>,
    /// The longest estimated path from its start to the end of the window, or what a look-ahead advised.
    remaining_s: Option<f32>,
    is_advised: bool,
}

/// Which instances are under way, and which leave room.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Dispatch {
    /// Capacity of each resource kind when the run began, where it is known.
    capacity: BTreeMap<String, Quantity>,
    /// What the task has created of each kind since, and what it has deleted or consumed.
    #[serde(default)]
    made: BTreeMap<String, Quantity>,
    #[serde(default)]
    removed: BTreeMap<String, Quantity>,
    /// Learned durations by the path of the state, in seconds.
    learned_s: BTreeMap<String, f64>,
    /// Nodes under way: they have asked for resources, hold some, or run.
    active: BTreeSet<InstanceId>,
    /// Those among them that are speculative.
    speculative: BTreeSet<InstanceId>,
    /// Those speculative ones that take room for a projection.
    in_rooms: BTreeSet<InstanceId>,
    /// Speculative nodes that wait for room.
    stalled: BTreeSet<InstanceId>,
    /// The holds advised by look-ahead.
    #[serde(default)]
    holds: holds::Holds,
    /// Certain nodes that have asked since speculative holders were last checked.
    asked: Vec<InstanceId>,
}

impl Dispatch {
    pub(crate) fn new(capacity: BTreeMap<String, Quantity>, learned_s: BTreeMap<String, f64>) -> Dispatch {
        let (made, removed, active, speculative, in_rooms, stalled, holds, asked) = Default::default();
        Dispatch { capacity, made, removed, learned_s, active, speculative, in_rooms, stalled, holds, asked }
    }

    /// Accounts for resource operations of the task.
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

    /// The present capacity of a kind, if it is known.
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

    /// The priority of an acquire; larger is served first.
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

    /// A node asks for resources, or goes on because it needs none.
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

    /// A node has ended or stopped: it holds nothing and runs nothing.
    pub(crate) fn end(&mut self, id: InstanceId) {
        self.active.remove(&id);
        self.speculative.remove(&id);
        self.in_rooms.remove(&id);
    }

    /// An instance has left the window.
    pub(crate) fn forget(&mut self, id: InstanceId) {
        self.end(id);
        self.stalled.remove(&id);
        self.holds.remove(&id);
    }

    /// The path is decided. True if the instance has to ask again as a certain one.
    pub(crate) fn became_certain(&mut self, id: InstanceId) -> bool {
        self.in_rooms.remove(&id);
        self.stalled.remove(&id);
        self.speculative.remove(&id)
    }

    /// A certain node, or a certain routine, has asked again.
    pub(crate) fn asks_again(&mut self, graph: &Graph, instance: &Instance) {
        if !graph.is_speculative(instance.segment) {
            self.asked.push(instance.id);
        }
    }

    /// Whether it is under way on an undecided path.
    pub(crate) fn is_speculative(&self, id: InstanceId) -> bool {
        self.speculative.contains(&id)
    }

    /// Whether a node may take room for a projection: a speculative one must leave the last room to certain ones.
    pub(crate) fn leaves_room(&self, graph: &Graph, instance: &Instance, requirements: &[Requirement]) -> bool {
        let needs = || requirements.iter().any(|r| r.kind == WORLD_MODEL);
        !graph.is_speculative(instance.segment) || !needs() || self.free_rooms().is_none_or(|free| free > 0)
    }

    /// Number of further projections for speculative nodes; `None` if the number of rooms is unknown or at most 1.
    fn free_rooms(&self) -> Option<usize> {
        let rooms = self.capacity.get(WORLD_MODEL)?.units() as usize;
        // One room is left to certain nodes, if there are several.
        if rooms <= 1 { None } else { Some((rooms - 1).saturating_sub(self.in_rooms.len())) }
    }

    /// A node waits for room for its projection.
    pub(crate) fn stall(&mut self, id: InstanceId) {
        self.stalled.insert(id);
    }

    /// Takes the most urgent nodes that wait for room, as many as there is room for.
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

    /// Instances whose acquire at the resource manager has an outdated priority.
    pub(crate) fn misplaced(&self, graph: &Graph) -> Vec<InstanceId> {
        let asking = |id: &InstanceId| match graph.node(*id)?.status {
            Status::Acquiring { priority } => Some((*id, priority)),
            _ => None,
        };
        let now = |id: InstanceId| graph.get(id).map(|instance| self.priority(graph, instance));
        let asked = self.active.iter().filter_map(asking);
        asked.filter(|(id, with)| now(*id) != Some(*with)).map(|(id, _)| id).collect()
    }

    /// Speculative holders that must give way to certain nodes, each with the node that needs its resources, the least urgent holder first.
    /// Checked once for all certain nodes that have asked.
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
            // Certain nodes that wait count as if they held their resources.
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

    /// Speculative holders that may keep a certain node waiting, where counting cannot tell: the capacity is unknown, or one of the two
    /// selects by attributes or conditions.
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

    /// Instances that only improve a result and must give way, because together with `asks` they exceed a known capacity; the oldest instances
    /// give way first.
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

    /// Checks that exactly the instances under way are active.
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

/// The kinds that a node blocks, with their amounts.
fn blocks(plan: &Plan, state: StateId) -> impl Iterator<Item = (&str, Quantity)> {
    let requirements = plan.state(state).requirements.iter();
    requirements.filter(|r| r.operation == ResourceOperation::Block).map(|r| (r.kind.as_str(), r.count))
}
