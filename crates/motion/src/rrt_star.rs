//! Informed RRT\*: a tree of shortest paths from the start, which improves with every sample.
//!
//! A new posture is connected to the neighbour through which its path from the start is shortest, and neighbours whose path through it is shorter are
//! rewired to it (Karaman and Frazzoli: *Sampling-based algorithms for optimal motion planning*, IJRR 2011; the k nearest, with k proportional to the
//! logarithm of the tree's size). Samples come from the region through which a shorter path can lead (Gammell, Srinivasa, Barfoot: *Informed RRT\**,
//! IROS 2014). Motions are checked in the order of their path lengths, until one is free. The size of the tree is bounded: when it is full, a leaf is
//! removed (Adiyatov and Varol, ICMA 2013).
//!
//! There may be several ends, each with the length of the rest of the path after it. Paths that were found elsewhere can be added.

use crate::ellipsoid;
use crate::pace::Control;
use crate::refine::End;
use crate::space::{Space, State, between, distance};
use rand::{Rng, RngExt};

/// Maximum number of nodes, without the ends.
pub const MAX_NODES: usize = 4096;

/// Maximum length of a new motion, in radians.
const RANGE: f32 = 1.0;

/// One in this many samples is an end.
const ENDS_AMONG_SAMPLES: u32 = 24;

/// Maximum number of ends that a new posture is connected to.
const ENDS_AT_ONCE: usize = 2;

/// Minimum gain for rewiring a node, in radians: more than rounding errors.
const LEAST_GAIN: f32 = 1e-5;

/// Number of slots that are searched for a useless node, before any leaf is removed.
const LOOK: usize = 64;

/// Number of nodes in a block of coordinates.
const WIDTH: usize = 16;

/// The tree.
#[derive(Debug, Clone)]
pub struct RrtStar {
    joints: usize,
    /// Positions of 16 nodes, a row per joint; unused ones are infinite.
    rows: Vec<[f32; WIDTH]>,
    /// The root is the first.
    nodes: Vec<Node>,
    /// The node of each end that the tree has reached.
    ends: Vec<Option<usize>>,
    /// Buffer for a query: squared distances and nodes, nearest first.
    near: Vec<(f32, usize)>,
    /// The slot at which the search for a leaf to remove continues.
    cursor: usize,
    /// Maximum number of nodes, without the ends.
    most: usize,
}

#[derive(Debug, Clone)]
struct Node {
    state: State,
    /// The root is its own parent.
    parent: usize,
    children: Vec<usize>,
    /// Length of the motion from the parent.
    edge: f32,
    /// Length of the path from the root.
    cost: f32,
    /// Minimum length of the rest of the path.
    rest: f32,
}

impl RrtStar {
    /// A tree with only its root, which is free.
    pub fn new(start: &State, joints: usize) -> RrtStar {
        let mut tree = RrtStar {
            joints,
            rows: Vec::new(),
            nodes: Vec::new(),
            ends: Vec::new(),
            near: Vec::new(),
            cursor: 1,
            most: MAX_NODES,
        };
        tree.put(0, Node { state: *start, parent: 0, children: Vec::new(), edge: 0.0, cost: 0.0, rest: 0.0 });
        tree
    }

    /// Number of nodes.
    #[allow(clippy::len_without_is_empty, reason = "there always is the root")]
    pub fn len(&self) -> usize {
        self.nodes.len()
    }

    /// The end with the shortest whole path, including the rest after it, and the length of that, in radians.
    pub fn best(&self, ends: &[End]) -> Option<(usize, f32)> {
        let reached = self.ends.iter().zip(ends).enumerate();
        let lengths = reached.filter_map(|(i, (node, end))| node.map(|node| (i, self.nodes[node].cost + end.rest)));
        lengths.min_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// The path to an end that the tree has reached.
    pub fn path(&self, end: usize) -> Option<Vec<State>> {
        let mut node = self.ends.get(end).copied().flatten()?;
        let mut path = vec![self.nodes[node].state];
        while node != 0 {
            node = self.nodes[node].parent;
            path.push(self.nodes[node].state);
        }
        path.reverse();
        Some(path)
    }

    /// Grows by this number of samples; paths of length `limit` or more, including the rest after their ends, are not searched. `ends` are those of
    /// the earlier calls, in the same order, with new ones appended.
    ///
    /// # Errors
    /// The answer of `control`, if it ends the growth; the tree is valid all the same.
    pub fn grow(
        &mut self,
        space: &mut Space,
        ends: &[End],
        limit: f32,
        samples: usize,
        random: &mut impl Rng,
        control: &mut dyn FnMut(usize) -> Control,
    ) -> Result<(), Control> {
        self.take(ends);
        let (lower, upper) = (*space.limits().0, *space.limits().1);
        let start = self.nodes[0].state;
        for sample in 0..samples {
            let answer = control(sample);
            if !answer.goes_on() {
                return Err(answer);
            }
            let bound = self.best(ends).map_or(limit, |(_, length)| limit.min(length));
            let is_useful = |end: &&End| distance(&start, &end.state) + end.rest < bound;
            let useful = ends.iter().filter(is_useful).count();
            if useful == 0 {
                return Ok(());
            }
            let chosen = random.random_range(0..useful);
            let Some(end) = ends.iter().filter(is_useful).nth(chosen) else { return Ok(()) };
            let aims = random.random_range(0..ENDS_AMONG_SAMPLES) == 0;
            let to = if aims {
                end.state
            } else {
                ellipsoid::draw(&start, &end.state, bound - end.rest, (&lower, &upper), self.joints, random)
            };
            self.extend(space, ends, bound, &to);
        }
        Ok(())
    }

    /// Adds a free path from the root to the end with the index `end`, without checking it.
    pub fn adopt(&mut self, path: &[State], ends: &[End], end: usize) {
        self.take(ends);
        let mut last = 0;
        for state in &path[1..] {
            self.find_near(state);
            let (square, nearest) = self.near[0];
            let edge = distance(&self.nodes[last].state, state);
            if square == 0.0 {
                if nearest != 0 && self.nodes[last].cost + edge < self.nodes[nearest].cost - LEAST_GAIN {
                    self.turn(nearest, last, edge);
                }
                last = nearest;
                continue;
            }
            let Some(slot) = self.slot(last, f32::INFINITY) else { return };
            last = self.add(slot, *state, last, edge, rest(ends, state));
        }
        self.ends[end] = Some(last);
    }

    /// Adds new ends.
    fn take(&mut self, ends: &[End]) {
        let known = self.ends.len();
        self.ends.resize(ends.len(), None);
        for node in &mut self.nodes {
            let new = rest(&ends[known..], &node.state);
            node.rest = if known == 0 { new } else { node.rest.min(new) };
        }
    }

    /// Grows the tree towards a sample.
    fn extend(&mut self, space: &mut Space, ends: &[End], bound: f32, sample: &State) {
        self.find_near(sample);
        let (square, nearest) = self.near[0];
        if square == 0.0 {
            self.look_for_better_parent(space, nearest);
            return;
        }
        let (mut state, far) = (*sample, square.sqrt());
        if far > RANGE {
            state = between(&self.nodes[nearest].state, sample, RANGE / far);
            self.find_near(&state);
        }
        let rest = rest(ends, &state);
        if distance(&self.nodes[0].state, &state) + rest >= bound {
            return;
        }
        let Some((parent, edge)) = self.best_parent(space, &state, bound - rest) else { return };
        let Some(slot) = self.slot(parent, bound) else { return };
        let node = self.add(slot, state, parent, edge, rest);
        self.rewire(space, node, bound);
        self.join_ends(space, ends, node, bound);
    }

    /// The neighbour through which a posture's path from the root is shortest, and shorter than `bound`, with the length of the motion from it.
    fn best_parent(&mut self, space: &mut Space, state: &State, bound: f32) -> Option<(usize, f32)> {
        let mut ways: Vec<(f32, f32, usize)> = Vec::with_capacity(self.near.len());
        for (square, node) in &self.near {
            let edge = square.sqrt();
            let cost = self.nodes[*node].cost + edge;
            if cost < bound {
                ways.push((cost, edge, *node));
            }
        }
        ways.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let free = ways.into_iter().find(|(_, _, node)| space.is_free_motion(&self.nodes[*node].state, state));
        free.map(|(_, edge, node)| (node, edge))
    }

    /// Rewires a node to the neighbour through which its path from the root is shortest.
    fn look_for_better_parent(&mut self, space: &mut Space, node: usize) {
        let (state, cost) = (self.nodes[node].state, self.nodes[node].cost);
        if node == 0 {
            return;
        }
        if let Some((parent, edge)) = self.best_parent(space, &state, cost - LEAST_GAIN) {
            self.turn(node, parent, edge);
        }
    }

    /// Rewires neighbours of a new node to it if that shortens their path from the root.
    fn rewire(&mut self, space: &mut Space, node: usize, bound: f32) {
        let (state, cost) = (self.nodes[node].state, self.nodes[node].cost);
        for i in 0..self.near.len() {
            let (square, neighbour) = self.near[i];
            let edge = square.sqrt();
            let Node { state: there, cost: before, rest, .. } = &self.nodes[neighbour];
            let shorter = cost + edge < before - LEAST_GAIN && cost + edge + rest < bound;
            if shorter && neighbour != node && space.is_free_motion(&state, there) {
                self.turn(neighbour, node, edge);
            }
        }
    }

    /// Connects ends to a new node if that shortens their path.
    fn join_ends(&mut self, space: &mut Space, ends: &[End], node: usize, bound: f32) {
        let (state, cost) = (self.nodes[node].state, self.nodes[node].cost);
        let mut ways: Vec<(f32, f32, usize)> = Vec::new();
        for (i, end) in ends.iter().enumerate() {
            let edge = distance(&state, &end.state);
            let before = self.ends[i].map_or(f32::INFINITY, |reached| self.nodes[reached].cost);
            if cost + edge + end.rest < bound && cost + edge < before - LEAST_GAIN {
                ways.push((cost + edge + end.rest, edge, i));
            }
        }
        ways.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        for (_, edge, i) in ways.into_iter().take(ENDS_AT_ONCE) {
            let there = ends[i].state;
            if !space.is_free_motion(&state, &there) {
                continue;
            }
            match self.ends[i] {
                Some(reached) => self.turn(reached, node, edge),
                None => {
                    let slot = self.nodes.len();
                    self.ends[i] = Some(self.add(slot, there, node, edge, rest(ends, &there)));
                }
            }
        }
    }

    /// Adds a new node below `parent`.
    fn add(&mut self, slot: usize, state: State, parent: usize, edge: f32, rest: f32) -> usize {
        let cost = self.nodes[parent].cost + edge;
        self.nodes[parent].children.push(slot);
        self.put(slot, Node { state, parent, children: Vec::new(), edge, cost, rest });
        slot
    }

    /// Stores a node in a slot, which is the next one or one in use.
    fn put(&mut self, slot: usize, node: Node) {
        if slot == self.nodes.len() && slot.is_multiple_of(WIDTH) {
            self.rows.extend(std::iter::repeat_n([f32::INFINITY; WIDTH], self.joints));
        }
        for (row, position) in self.rows[slot / WIDTH * self.joints..].iter_mut().zip(&node.state[..self.joints]) {
            row[slot % WIDTH] = *position;
        }
        if slot == self.nodes.len() {
            self.nodes.push(node);
        } else {
            self.nodes[slot] = node;
        }
    }

    /// Moves a node, with its subtree, below another parent.
    fn turn(&mut self, node: usize, parent: usize, edge: f32) {
        let before = self.nodes[node].parent;
        self.nodes[before].children.retain(|child| *child != node);
        self.nodes[parent].children.push(node);
        (self.nodes[node].parent, self.nodes[node].edge) = (parent, edge);
        let mut changed = vec![node];
        while let Some(node) = changed.pop() {
            self.nodes[node].cost = self.nodes[self.nodes[node].parent].cost + self.nodes[node].edge;
            changed.extend_from_slice(&self.nodes[node].children);
        }
    }

    /// A slot for a new node below `parent`.
    fn slot(&mut self, parent: usize, bound: f32) -> Option<usize> {
        if self.nodes.len() < self.most { Some(self.nodes.len()) } else { self.make_room(parent, bound) }
    }

    /// Removes a leaf and returns its slot; preferably a leaf through which no path shorter than `bound` can lead.
    fn make_room(&mut self, keep: usize, bound: f32) -> Option<usize> {
        let mut found = None;
        let count = self.nodes.len();
        for i in 0..count {
            let slot = (self.cursor + i) % count;
            let node = &self.nodes[slot];
            if slot == 0 || slot == keep || !node.children.is_empty() || self.ends.contains(&Some(slot)) {
                continue;
            }
            let is_useless = node.cost + node.rest >= bound;
            if is_useless || found.is_none() {
                found = Some(slot);
            }
            if is_useless || i >= LOOK {
                break;
            }
        }
        let slot = found?;
        self.cursor = slot + 1;
        let parent = self.nodes[slot].parent;
        self.nodes[parent].children.retain(|child| *child != slot);
        // The current query must not find it any more.
        self.near.retain(|(_, node)| *node != slot);
        Some(slot)
    }

    /// Fills `near` with the nearest nodes to a posture.
    fn find_near(&mut self, to: &State) {
        let count = neighbours(self.nodes.len(), self.joints);
        self.near.clear();
        let mut farthest = f32::INFINITY;
        for (block, rows) in self.rows.chunks_exact(self.joints).enumerate() {
            let mut squares = [0.0_f32; WIDTH];
            for (row, position) in rows.iter().zip(to) {
                for (square, there) in squares.iter_mut().zip(row) {
                    let way = there - position;
                    *square += way * way;
                }
            }
            for (lane, square) in squares.into_iter().enumerate() {
                if square < farthest {
                    let place = self.near.partition_point(|(s, _)| *s <= square);
                    self.near.insert(place, (square, block * WIDTH + lane));
                    self.near.truncate(count);
                    if self.near.len() == count {
                        farthest = self.near[count - 1].0;
                    }
                }
            }
        }
    }
}

/// Number of neighbours in a tree of this size (Karaman and Frazzoli, k-nearest RRT\*).
fn neighbours(nodes: usize, joints: usize) -> usize {
    let per_logarithm = std::f32::consts::E * (1.0 + 1.0 / joints as f32);
    ((per_logarithm * ((nodes + 1) as f32).ln()).ceil() as usize).max(1)
}

/// The minimum length of the path after a posture.
fn rest(ends: &[End], state: &State) -> f32 {
    ends.iter().map(|end| distance(state, &end.state) + end.rest).fold(f32::INFINITY, f32::min)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test may panic")]
mod tests;
