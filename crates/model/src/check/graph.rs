//! The control flow of a program as a graph: where each state begins and how it ends, and what leads where.
//!
//! Two facts are computed over it for every point: which states have surely written their outputs by then, and which may
//! have. A state inside of a composite is forgotten when the composite is entered again.

use crate::id::StateId;
use crate::program::{ABORTED, Program, SUCCESS, State, StateKind, Target, is_failure};
use petgraph::graph::{DiGraph, NodeIndex};
use petgraph::visit::EdgeRef;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// A point of the control flow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Point {
    /// A state is visited.
    Begin(StateId),
    /// A loop looks at its list or predicate; all regions of a concurrency have ended.
    Middle(StateId),
    /// A state has ended by its outcome of this number.
    End(StateId, usize),
}

/// The control flow of a program.
pub(crate) struct ControlFlow {
    graph: DiGraph<Point, ()>,
    places: BTreeMap<Point, NodeIndex>,
    outcomes: Vec<Vec<String>>,
    /// By place; `None` where nothing leads.
    surely: Vec<Option<Set>>,
    maybe: Vec<Set>,
}

/// A set of states.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Set(Vec<u64>);

impl Set {
    fn none(states: usize) -> Set {
        Set(vec![0; states.div_ceil(64)])
    }

    fn insert(&mut self, id: StateId) {
        self.0[id.0 as usize / 64] |= 1 << (id.0 % 64);
    }

    fn remove(&mut self, id: StateId) {
        self.0[id.0 as usize / 64] &= !(1 << (id.0 % 64));
    }

    fn contains(&self, id: StateId) -> bool {
        self.0[id.0 as usize / 64] & (1 << (id.0 % 64)) != 0
    }

    fn combine(&mut self, other: &Set, with: impl Fn(u64, u64) -> u64) {
        self.0.iter_mut().zip(&other.0).for_each(|(a, b)| *a = with(*a, *b));
    }
}

impl ControlFlow {
    /// The control flow of a program.
    pub(crate) fn of(program: &Program) -> ControlFlow {
        let outcomes = program.all_outcomes();
        let mut flow = ControlFlow {
            graph: DiGraph::new(),
            places: BTreeMap::new(),
            outcomes,
            surely: Vec::new(),
            maybe: Vec::new(),
        };
        let next = siblings(program);
        for state in &program.states {
            let id = state.id;
            let begin = Point::Begin(id);
            // What a state is made of may fail at once.
            flow.lead(begin, flow.end(id, ABORTED));
            let first = |list: &[StateId], flow: &ControlFlow| match list.first() {
                Some(first) => Point::Begin(*first),
                None => flow.end(id, SUCCESS),
            };
            match &state.kind {
                StateKind::Action { .. } => {
                    (0..flow.outcomes[id.0 as usize].len()).for_each(|n| flow.lead(begin, Point::End(id, n)));
                }
                StateKind::Sequence { children, .. } => flow.lead(begin, first(children, &flow)),
                StateKind::Condition { then, otherwise, .. } => {
                    flow.lead(begin, first(then, &flow));
                    flow.lead(begin, first(otherwise, &flow));
                }
                StateKind::ForEach { body, .. } | StateKind::While { body, .. } => {
                    let middle = Point::Middle(id);
                    let begins_with_body = matches!(state.kind, StateKind::While { body_first: true, .. });
                    let inside = body.first().map_or(middle, |first| Point::Begin(*first));
                    flow.lead(begin, if begins_with_body { inside } else { middle });
                    flow.lead(middle, inside);
                    flow.lead(middle, flow.end(id, SUCCESS));
                    flow.lead(middle, flow.end(id, ABORTED));
                }
                StateKind::Concurrency { regions, .. } => {
                    let middle = Point::Middle(id);
                    regions.iter().for_each(|region| flow.lead(begin, Point::Begin(*region)));
                    if regions.is_empty() {
                        flow.lead(begin, middle);
                    }
                    (0..flow.outcomes[id.0 as usize].len()).for_each(|n| flow.lead(middle, Point::End(id, n)));
                }
            }
            let Some(parent) = state.parent else { continue };
            for number in 0..flow.outcomes[id.0 as usize].len() {
                let outcome = flow.outcomes[id.0 as usize][number].clone();
                let connected = state.transitions.get(&outcome).cloned();
                let sibling = next[id.0 as usize].filter(|_| outcome == SUCCESS).map(Target::State);
                let to = match connected.or(sibling) {
                    Some(Target::State(to)) => Point::Begin(to),
                    Some(Target::Outcome(by)) => flow.leave(program, parent, &by),
                    None => flow.leave(program, parent, &outcome),
                };
                flow.lead(Point::End(id, number), to);
            }
        }
        flow.solve(program);
        flow
    }

    /// Whether something leads to a point from the beginning of the task.
    pub(crate) fn is_reached(&self, point: Point) -> bool {
        self.places.get(&point).is_some_and(|place| self.surely[place.index()].is_some())
    }

    /// Whether the state has surely, and whether it may have, written its outputs when the control flow comes to a point. Of a point that
    /// nothing leads to everything is sure.
    pub(crate) fn written(&self, point: Point, state: StateId) -> (bool, bool) {
        let Some(place) = self.places.get(&point) else { return (true, true) };
        match &self.surely[place.index()] {
            Some(surely) => (surely.contains(state), self.maybe[place.index()].contains(state)),
            None => (true, true),
        }
    }

    /// Whether one of these states has written its outputs, whichever way the control flow came to a point. Where it comes to a state around one
    /// of them, that one is forgotten, and then none is sure.
    pub(crate) fn one_is_written(&self, program: &Program, point: Point, states: &BTreeSet<StateId>) -> bool {
        let (Some(begin), Some(goal)) = (self.places.get(&Point::Begin(Program::ROOT)), self.places.get(&point)) else {
            return true;
        };
        let parent = |id: &StateId| program.state(*id).parent;
        let around = states.iter().flat_map(|id| std::iter::successors(parent(id), parent));
        let around: BTreeSet<StateId> = around.filter(|id| !program.is_pass(*id)).collect();
        // Per place: whether it was come to with none of them, and with one.
        let mut seen = vec![[false; 2]; self.graph.node_count()];
        let mut open = vec![(*begin, false)];
        while let Some((place, mut is_written)) = open.pop() {
            if std::mem::replace(&mut seen[place.index()][usize::from(is_written)], true) {
                continue;
            }
            match self.graph[place] {
                Point::Begin(id) => is_written &= !around.contains(&id),
                Point::End(id, number) => {
                    is_written |= states.contains(&id) && !is_failure(&self.outcomes[id.0 as usize][number]);
                }
                Point::Middle(_) => {}
            }
            open.extend(self.graph.neighbors(place).map(|next| (next, is_written)));
        }
        !seen[goal.index()][0]
    }

    /// The outcomes of a state.
    pub(crate) fn outcomes(&self, id: StateId) -> &[String] {
        &self.outcomes[id.0 as usize]
    }

    /// The points from which no end of the task can be reached, although they are reached themselves.
    pub(crate) fn dead_ends(&self) -> Vec<Point> {
        let mut seen = vec![false; self.graph.node_count()];
        let mut open: Vec<NodeIndex> = Vec::new();
        for (number, outcome) in self.outcomes[0].iter().enumerate() {
            let _ = outcome;
            open.extend(self.places.get(&Point::End(Program::ROOT, number)));
        }
        while let Some(place) = open.pop() {
            if std::mem::replace(&mut seen[place.index()], true) {
                continue;
            }
            open.extend(self.graph.neighbors_directed(place, petgraph::Direction::Incoming));
        }
        let dead =
            self.graph.node_indices().filter(|place| !seen[place.index()] && self.surely[place.index()].is_some());
        dead.map(|place| self.graph[place]).collect()
    }

    /// What can be reached if only some states may begin. Any other ends at once, `aborted`, where it may fail before, and else
    /// goes nowhere; the regions of a barrier are all waited for. By place: see [`ControlFlow::is_in`].
    pub(crate) fn reached_when(
        &self,
        program: &Program,
        may_begin: &dyn Fn(StateId) -> bool,
        may_fail_first: &dyn Fn(&State) -> bool,
    ) -> Vec<bool> {
        let mut reached = vec![false; self.graph.node_count()];
        let mut open: Vec<NodeIndex> = self.places.get(&Point::Begin(Program::ROOT)).copied().into_iter().collect();
        while let Some(place) = open.pop() {
            if reached[place.index()] {
                continue;
            }
            let mut next: Vec<NodeIndex> = self.graph.neighbors(place).collect();
            match self.graph[place] {
                Point::Middle(id) => {
                    if let StateKind::Concurrency { regions, preemptive: false, .. } = &program.state(id).kind {
                        let mut ends = regions.iter().map(|region| {
                            let of = 0..self.outcomes(*region).len();
                            of.into_iter().any(|number| self.is_in(&reached, Point::End(*region, number)))
                        });
                        if !ends.all(|ended| ended) {
                            continue;
                        }
                    }
                }
                Point::Begin(id) if !may_begin(id) => {
                    let fails = may_fail_first(program.state(id)).then(|| self.end(id, ABORTED));
                    next.retain(|to| Some(self.graph[*to]) == fails);
                }
                Point::Begin(_) | Point::End(..) => {}
            }
            reached[place.index()] = true;
            open.extend(next);
        }
        reached
    }

    /// Whether a point is among those that were reached.
    pub(crate) fn is_in(&self, reached: &[bool], point: Point) -> bool {
        self.places.get(&point).is_some_and(|place| reached[place.index()])
    }

    /// Whether the control flow may come from one point to another.
    pub(crate) fn leads_to(&self, from: Point, to: Point) -> bool {
        match (self.places.get(&from), self.places.get(&to)) {
            (Some(from), Some(to)) => petgraph::algo::has_path_connecting(&self.graph, *from, *to, None),
            _ => false,
        }
    }

    fn end(&self, id: StateId, outcome: &str) -> Point {
        let outcomes = &self.outcomes[id.0 as usize];
        let number = outcomes.iter().position(|known| known == outcome).unwrap_or(outcomes.len() - 2);
        Point::End(id, number)
    }

    /// Where a list leads that ends by an outcome.
    fn leave(&self, program: &Program, parent: StateId, by: &str) -> Point {
        match &program.state(parent).kind {
            StateKind::ForEach { .. } | StateKind::While { .. } if by == SUCCESS => Point::Middle(parent),
            StateKind::Concurrency { .. } => Point::Middle(parent),
            _ => self.end(parent, by),
        }
    }

    fn place(&mut self, point: Point) -> NodeIndex {
        if let Some(place) = self.places.get(&point) {
            return *place;
        }
        let place = self.graph.add_node(point);
        self.places.insert(point, place);
        place
    }

    fn lead(&mut self, from: Point, to: Point) {
        let (from, to) = (self.place(from), self.place(to));
        self.graph.add_edge(from, to, ());
    }

    /// Definite assignment, forwards to a fixed point.
    fn solve(&mut self, program: &Program) {
        let states = program.states.len();
        let inside: Vec<Vec<StateId>> = program.states.iter().map(|state| contained(program, state.id)).collect();
        self.surely = vec![None; self.graph.node_count()];
        self.maybe = vec![Set::none(states); self.graph.node_count()];
        let Some(begin) = self.places.get(&Point::Begin(Program::ROOT)).copied() else { return };
        self.surely[begin.index()] = Some(Set::none(states));
        let mut queue = VecDeque::from([begin]);
        let mut queued = vec![false; self.graph.node_count()];
        while let Some(place) = queue.pop_front() {
            queued[place.index()] = false;
            let Some(mut surely) = self.surely[place.index()].clone() else { continue };
            let mut maybe = self.maybe[place.index()].clone();
            match self.graph[place] {
                Point::Begin(id) if !program.is_pass(id) => {
                    for forgotten in &inside[id.0 as usize] {
                        surely.remove(*forgotten);
                        maybe.remove(*forgotten);
                    }
                }
                Point::End(id, number) => {
                    if !is_failure(&self.outcomes[id.0 as usize][number]) {
                        surely.insert(id);
                        maybe.insert(id);
                    }
                }
                Point::Begin(_) | Point::Middle(_) => {}
            }
            let next: Vec<NodeIndex> = self.graph.edges(place).map(|edge| edge.target()).collect();
            for to in next {
                let before = (self.surely[to.index()].clone(), self.maybe[to.index()].clone());
                match &mut self.surely[to.index()] {
                    unknown @ None => *unknown = Some(surely.clone()),
                    Some(known) => known.combine(&surely, |a, b| a & b),
                }
                self.maybe[to.index()].combine(&maybe, |a, b| a | b);
                let changed = before != (self.surely[to.index()].clone(), self.maybe[to.index()].clone());
                if changed && !std::mem::replace(&mut queued[to.index()], true) {
                    queue.push_back(to);
                }
            }
        }
    }
}

/// The next state of the same list, by state; regions have none.
fn siblings(program: &Program) -> Vec<Option<StateId>> {
    let mut next = vec![None; program.states.len()];
    for list in program.states.iter().flat_map(|state| state.lists()) {
        for pair in list.windows(2) {
            next[pair[0].0 as usize] = Some(pair[1]);
        }
    }
    next
}

fn contained(program: &Program, id: StateId) -> Vec<StateId> {
    let mut all: Vec<StateId> = program.state(id).children().collect();
    let mut at = 0;
    while at < all.len() {
        all.extend(program.state(all[at]).children());
        at += 1;
    }
    all
}
