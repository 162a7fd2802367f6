//! Computes a maximum flow from classes of requirements to nodes of resources (Dinic, "Algorithm for solution of a problem of maximum flow in
//! networks with power estimation", 1970), starting from an existing assignment.
//!
//! ```text
//!   class ──(lacks)──▶ node of a signature: all resources that fit the same classes
//!                        └─ exhausted by another class ──▶ that class takes from another node of its own instead
//! ```
//! Levels are levels of classes, so a path is at most as long as the number of classes, and a phase visits each pair of class and node once. For
//! classes of one grain the flow is maximum. If whole units and fractions are taken from the same resources, finding a better flow is as hard as
//! finding a largest independent set; the result is then what such paths find.

use crate::id::Slot;
use ratn_model::resource::Quantity;
use std::collections::BTreeMap;

/// The id of a signature of resources.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct NodeId(u32);

/// The signature of resources that fit no class.
const NOTHING: NodeId = NodeId(0);

/// All resources that fit the same classes.
#[derive(Debug)]
struct Node {
    /// The last class that they fit, and the node of the signature without that class.
    signature: (usize, NodeId),
    members: Vec<(Slot, Quantity)>,
    /// The amount available in whole units of single resources, and in total.
    whole: Quantity,
    all: Quantity,
    /// For each class, the amount that it takes of this node.
    shares: Vec<(usize, Quantity)>,
    /// The amounts taken in whole units, and in fractions.
    taken_whole: Quantity,
    taken_parts: Quantity,
    changed: bool,
}

/// A class of requirements.
#[derive(Debug)]
struct Source {
    grain: Quantity,
    nodes: Vec<NodeId>,
    lacks: Quantity,
    /// In this phase: the distance to a class that lacks something, and the next node to visit.
    level: Option<usize>,
    next: usize,
}

/// See the module.
#[derive(Debug)]
pub(super) struct Flow {
    sources: Vec<Source>,
    nodes: Vec<Node>,
    /// For each slot, its node and the available amount.
    of_slot: Vec<(NodeId, Quantity)>,
    slots: Vec<Slot>,
    /// Maps a signature and one more class to the resulting signature.
    with: BTreeMap<(NodeId, usize), NodeId>,
}

impl Flow {
    /// A flow for classes with these grains.
    pub(super) fn new(grains: Vec<Quantity>) -> Flow {
        let source = |grain| Source { grain, nodes: Vec::new(), lacks: Quantity::ZERO, level: None, next: 0 };
        let sources = grains.into_iter().map(source).collect();
        let (of_slot, slots, with) = Default::default();
        Flow { sources, nodes: vec![Node::of((0, NOTHING))], of_slot, slots, with }
    }

    /// A class can use a resource. To be called in the order of classes.
    pub(super) fn fits(&mut self, class: usize, slot: Slot, available: Quantity) {
        if available.is_zero() {
            return;
        }
        if self.of_slot.len() <= slot.index() {
            self.of_slot.resize(slot.index() + 1, (NOTHING, Quantity::ZERO));
        }
        let (before, _) = self.of_slot[slot.index()];
        if before == NOTHING {
            self.slots.push(slot);
        }
        let node = match self.with.get(&(before, class)) {
            Some(node) => *node,
            None => {
                let node = NodeId(u32::try_from(self.nodes.len()).unwrap_or(u32::MAX));
                self.nodes.push(Node::of((class, before)));
                self.with.insert((before, class), node);
                node
            }
        };
        self.of_slot[slot.index()] = (node, available);
    }

    /// Completes the nodes, when every class has said what it can use.
    pub(super) fn seal(&mut self) {
        for slot in &self.slots {
            let (id, available) = self.of_slot[slot.index()];
            let node = &mut self.nodes[id.index()];
            node.members.push((*slot, available));
            node.whole += available.floor_to(Quantity::ONE);
            node.all += available;
        }
        for index in 1..self.nodes.len() {
            let mut at = NodeId(u32::try_from(index).unwrap_or(u32::MAX));
            let node = at;
            if self.nodes[index].members.is_empty() {
                continue;
            }
            while at != NOTHING {
                let (class, others) = self.nodes[at.index()].signature;
                self.sources[class].nodes.push(node);
                at = others;
            }
        }
    }

    /// A class has this amount of a resource already.
    pub(super) fn has(&mut self, class: usize, slot: Slot, amount: Quantity) {
        if let Some((node, _)) = self.of_slot.get(slot.index()).copied() {
            self.take(class, node, amount);
        }
    }

    /// A class lacks this amount more.
    pub(super) fn wants(&mut self, class: usize, amount: Quantity) {
        self.sources[class].lacks += amount;
    }

    /// Takes as much as possible, moving what others took. Returns whether anything was moved.
    pub(super) fn improve(&mut self) -> bool {
        let mut moved = false;
        while self.levels() {
            let mut some = false;
            for class in 0..self.sources.len() {
                while !self.sources[class].lacks.is_zero() && self.sources[class].level == Some(0) {
                    let got = self.push(class, self.sources[class].lacks, NOTHING);
                    if got.is_zero() {
                        break;
                    }
                    self.sources[class].lacks = self.sources[class].lacks.saturating_sub(got);
                    some = true;
                }
            }
            if !some {
                break;
            }
            moved = true;
        }
        moved
    }

    pub(super) fn grain(&self, class: usize) -> Quantity {
        self.sources[class].grain
    }

    /// Nodes whose taken amounts have changed.
    pub(super) fn changed(&self) -> impl Iterator<Item = NodeId> {
        (0_u32..).zip(&self.nodes).filter(|(_, node)| node.changed).map(|(index, _)| NodeId(index))
    }

    pub(super) fn is_changed_at(&self, slot: Slot) -> bool {
        self.of_slot.get(slot.index()).is_some_and(|(node, _)| self.nodes[node.index()].changed)
    }

    /// The resources of a node, with the available amount of each.
    pub(super) fn members(&self, node: NodeId) -> &[(Slot, Quantity)] {
        &self.nodes[node.index()].members
    }

    /// The amount that each class takes of a node, whole units first, so that fractions do not break them.
    pub(super) fn shares(&self, node: NodeId) -> Vec<(usize, Quantity)> {
        let mut shares = self.nodes[node.index()].shares.clone();
        shares.sort_by_key(|(class, _)| (std::cmp::Reverse(self.grain(*class)), *class));
        shares
    }

    /// Computes the distance of each class to one that lacks something, over shared nodes; returns whether anything is left within reach.
    fn levels(&mut self) -> bool {
        let mut level: Vec<usize> = Vec::new();
        for (class, source) in self.sources.iter_mut().enumerate() {
            source.level = (!source.lacks.is_zero()).then_some(0);
            source.next = 0;
            level.extend(source.level.map(|_| class));
        }
        let mut seen = vec![false; self.nodes.len()];
        let mut depth = 0;
        while !level.is_empty() {
            let (mut next, mut within_reach) = (Vec::new(), false);
            depth += 1;
            for class in level {
                for at in 0..self.sources[class].nodes.len() {
                    let node = self.sources[class].nodes[at];
                    within_reach |= !self.left(class, node).is_zero();
                    if std::mem::replace(&mut seen[node.index()], true) {
                        continue;
                    }
                    for (other, _) in &self.nodes[node.index()].shares {
                        if self.sources[*other].level.is_none() {
                            self.sources[*other].level = Some(depth);
                            next.push(*other);
                        }
                    }
                }
            }
            if within_reach {
                return true;
            }
            level = next;
        }
        false
    }

    /// Takes up to `wanted` more for a class, from other nodes than `but`; returns the amount.
    fn push(&mut self, class: usize, wanted: Quantity, but: NodeId) -> Quantity {
        let beyond = self.sources[class].level.map(|level| level + 1);
        while let Some(node) = self.sources[class].nodes.get(self.sources[class].next).copied() {
            if node != but {
                let took = self.left(class, node).min(wanted);
                if !took.is_zero() {
                    self.take(class, node, took);
                    self.nodes[node.index()].changed = true;
                    return took;
                }
                for (other, has) in self.nodes[node.index()].shares.clone() {
                    if other == class || self.sources[other].level != beyond {
                        continue;
                    }
                    let asked = self.to_move(class, other, node, wanted).min(has);
                    let moved = if asked.is_zero() { asked } else { self.push(other, asked, node) };
                    if moved.is_zero() {
                        continue;
                    }
                    self.give_back(other, node, moved);
                    self.nodes[node.index()].changed = true;
                    let took = self.left(class, node).min(wanted).floor_to(self.grain(class));
                    if !took.is_zero() {
                        self.take(class, node, took);
                        return took;
                    }
                }
            }
            self.sources[class].next += 1;
        }
        Quantity::ZERO
    }

    /// How much another class has to give up of a node so that this one can take `wanted` more.
    fn to_move(&self, class: usize, other: usize, node: NodeId, wanted: Quantity) -> Quantity {
        let Node { whole, all, taken_whole, taken_parts, .. } = &self.nodes[node.index()];
        let there = all.saturating_sub(*taken_whole + *taken_parts).min(wanted);
        match (self.grain(class) == Quantity::ONE, self.grain(other) == Quantity::ONE) {
            (true, false) => {
                // Fractions are in its way only as far as whole units are left.
                let wanted = whole.saturating_sub(*taken_whole).min(wanted);
                wanted.saturating_sub(there)
            }
            (false, true) => Quantity::whole(wanted.units_up()),
            _ => wanted,
        }
    }

    /// How much a class could take of a node.
    fn left(&self, class: usize, node: NodeId) -> Quantity {
        let Node { whole, all, taken_whole, taken_parts, .. } = &self.nodes[node.index()];
        let left = all.saturating_sub(*taken_whole + *taken_parts);
        if self.grain(class) == Quantity::ONE {
            left.min(whole.saturating_sub(*taken_whole)).floor_to(Quantity::ONE)
        } else {
            left
        }
    }

    fn take(&mut self, class: usize, id: NodeId, amount: Quantity) {
        let whole = self.grain(class) == Quantity::ONE;
        let node = &mut self.nodes[id.index()];
        match node.shares.iter_mut().find(|(other, _)| *other == class) {
            Some((_, share)) => *share += amount,
            None => node.shares.push((class, amount)),
        }
        *(if whole { &mut node.taken_whole } else { &mut node.taken_parts }) += amount;
    }

    fn give_back(&mut self, class: usize, id: NodeId, amount: Quantity) {
        let whole = self.grain(class) == Quantity::ONE;
        let node = &mut self.nodes[id.index()];
        for (_, share) in node.shares.iter_mut().filter(|(other, _)| *other == class) {
            *share = share.saturating_sub(amount);
        }
        node.shares.retain(|(_, share)| !share.is_zero());
        let taken = if whole { &mut node.taken_whole } else { &mut node.taken_parts };
        *taken = taken.saturating_sub(amount);
    }
}

impl Node {
    fn of(signature: (usize, NodeId)) -> Node {
        let (members, shares) = Default::default();
        let (whole, all, taken_whole, taken_parts) = Default::default();
        Node { signature, members, whole, all, shares, taken_whole, taken_parts, changed: false }
    }
}

impl NodeId {
    fn index(self) -> usize {
        self.0 as usize
    }
}
