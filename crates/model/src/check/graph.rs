//! The control flow of a program as a graph: points where states begin and end, and edges between them.
//!
//! For every point it computes which states have certainly written their outputs by then, and which may have (definite assignment). A state inside of
//! a composite state is removed from both when the composite is entered again. If a state is left by an outcome of its own, an output's inputs may not
//! have been written; such outputs ([`Ports`]) are tracked separately.

use super::ways::{Flow, Ways, ways};
use crate::expression::{BinaryOperator, Expr};
use crate::id::StateId;
use crate::program::{ABORTED, Program, SUCCESS, State, StateKind, Target, is_failure};
use crate::value::Value;
use petgraph::graph::{DiGraph, NodeIndex};
use petgraph::visit::EdgeRef;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// A point of the control flow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Point {
    /// A state is visited.
    Begin(StateId),
    /// A loop evaluates its list or predicate; or all regions of a concurrency have ended.
    Middle(StateId),
    /// A state has ended by the outcome of this number.
    End(StateId, usize),
}

/// The control flow of a program.
pub(crate) struct ControlFlow {
    graph: DiGraph<Point, ()>,
    places: BTreeMap<Point, NodeIndex>,
    outcomes: Vec<Vec<String>>,
    ports: Ports,
    /// By point; `None` if no path leads there.
    surely: Vec<Option<Set>>,
    maybe: Vec<Set>,
}

/// The outputs that a state may leave out when it ends by an outcome of its own.
#[derive(Debug, Default)]
struct Ports {
    of: BTreeMap<StateId, Vec<Port>>,
}

#[derive(Debug)]
struct Port {
    name: String,
    /// Its number in a [`Set`].
    number: usize,
    /// The outcomes with which it may be missing.
    left_out: BTreeSet<usize>,
}

impl Ports {
    /// All such outputs; at first none is assumed to be missing with any outcome.
    fn of(program: &Program, outcomes: &[Vec<String>]) -> Ports {
        let mut number = program.states.len();
        let mut of: BTreeMap<StateId, Vec<Port>> = BTreeMap::new();
        for state in &program.states {
            let has_own = outcomes[index(state.id)].iter().any(|outcome| is_own(outcome));
            for output in state.outputs().iter().filter(|output| has_own && !output.value.flows().is_empty()) {
                let port = Port { name: output.name.clone(), number, left_out: BTreeSet::new() };
                of.entry(state.id).or_default().push(port);
                number += 1;
            }
        }
        Ports { of }
    }

    fn count(&self) -> usize {
        self.of.values().map(Vec::len).sum()
    }

    fn get(&self, state: StateId, name: &str) -> Option<&Port> {
        self.of.get(&state)?.iter().find(|port| port.name == name)
    }
}

/// A set of states and of separately tracked outputs.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Set(Vec<u64>);

impl Set {
    fn none(members: usize) -> Set {
        Set(vec![0; members.div_ceil(64)])
    }

    fn insert(&mut self, member: usize) {
        self.0[member / 64] |= 1 << (member % 64);
    }

    fn remove(&mut self, member: usize) {
        self.0[member / 64] &= !(1 << (member % 64));
    }

    fn contains(&self, member: usize) -> bool {
        self.0[member / 64] & (1 << (member % 64)) != 0
    }

    fn combine(&mut self, other: &Set, with: impl Fn(u64, u64) -> u64) {
        self.0.iter_mut().zip(&other.0).for_each(|(a, b)| *a = with(*a, *b));
    }
}

impl ControlFlow {
    pub(crate) fn of(program: &Program) -> ControlFlow {
        let outcomes = program.all_outcomes();
        let ports = Ports::of(program, &outcomes);
        let mut flow = ControlFlow {
            graph: DiGraph::new(),
            places: BTreeMap::new(),
            outcomes,
            ports,
            surely: Vec::new(),
            maybe: Vec::new(),
        };
        let next = siblings(program);
        for state in &program.states {
            let id = state.id;
            let begin = Point::Begin(id);
            // An expression of the state may fail at once.
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
        // An output may depend on another one that may be missing.
        while flow.leave_out(program) {
            flow.solve(program);
        }
        flow
    }

    /// Whether a path leads from the beginning of the task to a point.
    pub(crate) fn is_reached(&self, point: Point) -> bool {
        self.places.get(&point).is_some_and(|place| self.surely[place.index()].is_some())
    }

    /// Whether the state has certainly written an output when the control flow reaches a point, and whether it may have. At an unreachable point
    /// everything counts as certain.
    pub(crate) fn written(&self, point: Point, (state, port): Flow<'_>) -> (bool, bool) {
        let Some(place) = self.places.get(&point) else { return (true, true) };
        let member = self.ports.get(state, port).map_or(index(state), |port| port.number);
        match &self.surely[place.index()] {
            Some(surely) => (surely.contains(member), self.maybe[place.index()].contains(member)),
            None => (true, true),
        }
    }

    /// Whether a state that ends by this outcome has certainly written an output.
    pub(crate) fn gives(&self, (state, port): Flow<'_>, outcome: &str) -> bool {
        let number = self.outcomes[index(state)].iter().position(|known| known == outcome);
        let left_out = self.ports.get(state, port).zip(number).is_some_and(|(port, n)| port.left_out.contains(&n));
        !is_failure(outcome) && !left_out
    }

    /// For one argument of an `either`: the single output that exists exactly if all outputs of the argument exist. `None` if there is no such output.
    pub(crate) fn one_of<'e>(&self, way: &BTreeSet<Flow<'e>>) -> Option<Flow<'e>> {
        let first = way.first()?;
        let is_left_out =
            |(state, port): &&Flow<'e>| self.ports.get(*state, port).is_some_and(|p| !p.left_out.is_empty());
        let mut left_out = way.iter().filter(is_left_out);
        let one = left_out.next().unwrap_or(first);
        (way.iter().all(|(state, _)| *state == first.0) && left_out.next().is_none()).then_some(*one)
    }

    /// Whether one of these outputs has been written on every path to a point. When the control flow enters a state around one of them, or begins an
    /// iteration of a loop that contains it, the output is removed, and then none is certain.
    pub(crate) fn one_is_written(&self, program: &Program, point: Point, flows: &BTreeSet<Flow<'_>>) -> bool {
        let (Some(begin), Some(goal)) = (self.places.get(&Point::Begin(Program::ROOT)), self.places.get(&point)) else {
            return true;
        };
        let parent = |id: &StateId| program.state(*id).parent;
        let around = flows.iter().flat_map(|(id, _)| std::iter::successors(parent(id), parent));
        let (passes, around): (BTreeSet<StateId>, BTreeSet<StateId>) = around.partition(|id| program.is_pass(*id));
        let iterated = flows.iter().filter_map(|(id, _)| parent(id)).filter(|id| program.is_iterated(*id));
        let iterated: BTreeSet<StateId> =
            iterated.filter_map(|id| if passes.contains(&id) { parent(&id) } else { Some(id) }).collect();
        // Outputs that a further end of their state may leave out get a bit each, up to a limit.
        let may_be_left_out: Vec<Flow<'_>> = flows
            .iter()
            .filter(|(id, port)| self.ports.get(*id, port).is_some_and(|port| !port.left_out.is_empty()))
            .copied()
            .take(6)
            .collect();
        let bit_of = |flow: &Flow<'_>| may_be_left_out.iter().position(|other| other == flow).map_or(0, |n| n + 1);
        // By point, the combinations of outputs with which it was reached.
        let mut seen = vec![0_u128; self.graph.node_count()];
        let mut open = vec![(*begin, 0_u8)];
        while let Some((place, mut written)) = open.pop() {
            if seen[place.index()] & (1 << written) != 0 {
                continue;
            }
            seen[place.index()] |= 1 << written;
            match self.graph[place] {
                Point::Begin(id) if around.contains(&id) => written = 0,
                Point::End(id, number) if !is_failure(&self.outcomes[index(id)][number]) => {
                    for flow in flows.iter().filter(|(from, _)| *from == id) {
                        let left_out = self.ports.get(id, flow.1).is_some_and(|port| port.left_out.contains(&number));
                        match (left_out, bit_of(flow)) {
                            (true, 0) => {}
                            (true, bit) => written &= !(1 << bit),
                            (false, bit) => written |= 1 << bit,
                        }
                    }
                }
                Point::Begin(_) | Point::Middle(_) | Point::End(..) => {}
            }
            for next in self.graph.neighbors(place) {
                let loops = match (self.graph[place], self.graph[next]) {
                    (Point::Middle(id), Point::Begin(_)) => iterated.contains(&id),
                    _ => false,
                };
                open.push((next, if loops { 0 } else { written }));
            }
        }
        seen[goal.index()] & 1 == 0
    }

    pub(crate) fn outcomes(&self, id: StateId) -> &[String] {
        &self.outcomes[id.0 as usize]
    }

    /// The reachable points from which no end of the task can be reached.
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

    /// The points that can be reached if only some states may begin. Any other state ends at once with `aborted` if it may fail before, else it
    /// blocks. A barrier waits for all its regions. The result is by point; see [`ControlFlow::is_in`].
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

    /// Whether a point is in such a result.
    pub(crate) fn is_in(&self, reached: &[bool], point: Point) -> bool {
        self.places.get(&point).is_some_and(|place| reached[place.index()])
    }

    /// Whether a path leads from one point to another.
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

    /// The next point when a list ends by an outcome.
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

    /// Updates the outcomes with which outputs may be missing, from what is known to be written; true if anything changed.
    fn leave_out(&mut self, program: &Program) -> bool {
        let mut news: Vec<(StateId, usize, usize)> = Vec::new();
        for (id, ports) in &self.ports.of {
            for (at, port) in ports.iter().enumerate() {
                let Some(output) = program.state(*id).outputs().iter().find(|output| output.name == port.name) else {
                    continue;
                };
                let ways = ways(&output.value);
                for (number, outcome) in self.outcomes[index(*id)].iter().enumerate() {
                    let point = Point::End(*id, number);
                    let is_open = is_own(outcome) && !port.left_out.contains(&number) && self.is_reached(point);
                    if is_open && !self.are_there(program, (point, outcome), &ways) {
                        news.push((*id, at, number));
                    }
                }
            }
        }
        for (id, at, number) in &news {
            let port = self.ports.of.get_mut(id).and_then(|ports| ports.get_mut(*at));
            port.into_iter().for_each(|port| {
                port.left_out.insert(*number);
            });
        }
        !news.is_empty()
    }

    /// Whether all inputs of an expression certainly exist, or have defaults, when a state ends by an outcome.
    fn are_there(&self, program: &Program, (point, outcome): (Point, &str), ways: &Ways<'_>) -> bool {
        let is_there = |(state, port): &Flow<'_>| {
            let state = program.state(*state);
            let around = state.parent.map(|around| program.state(around));
            let written = match around.filter(|around| matches!(around.kind, StateKind::Concurrency { .. })) {
                Some(_) if *port == "outcome" => true,
                Some(around) if decided(around, outcome).is_some() => {
                    decided(around, outcome).is_some_and(|holds| one_succeeds(holds, &BTreeSet::from([state.id])))
                }
                // With watches beside it, this region alone decides.
                Some(around) => {
                    let mut others = around.children().filter(|id| *id != state.id);
                    !others.all(|other| program.state(other).is_watch()) || self.gives((state.id, port), outcome)
                }
                None => self.written(point, (state.id, port)).0,
            };
            written || state.defaults.contains_key(*port)
        };
        let one_is_there = |either: &Vec<BTreeSet<Flow<'_>>>| {
            let single: BTreeSet<Flow<'_>> = either.iter().filter_map(|way| self.one_of(way)).collect();
            either.iter().any(|way| way.iter().all(is_there)) || self.one_is_written(program, point, &single)
        };
        ways.needed.iter().all(is_there) && ways.either.iter().all(one_is_there)
    }

    /// Definite assignment, as a forward fixed point.
    fn solve(&mut self, program: &Program) {
        let states = program.states.len() + self.ports.count();
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
                        let ports = self.ports.of.get(forgotten).into_iter().flatten().map(|port| port.number);
                        for member in std::iter::once(index(*forgotten)).chain(ports) {
                            surely.remove(member);
                            maybe.remove(member);
                        }
                    }
                }
                Point::End(id, number) => {
                    if !is_failure(&self.outcomes[id.0 as usize][number]) {
                        surely.insert(index(id));
                        maybe.insert(index(id));
                        for port in self.ports.of.get(&id).into_iter().flatten() {
                            match port.left_out.contains(&number) {
                                true => surely.remove(port.number),
                                false => surely.insert(port.number),
                            }
                            maybe.insert(port.number);
                        }
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

/// The decider's boolean for this outcome; `None` if the decider does not mention it.
pub(super) fn decided<'p>(state: &'p State, outcome: &str) -> Option<&'p Expr> {
    let StateKind::Concurrency { decide, .. } = &state.kind else { return None };
    decide.iter().find(|(decided, _)| decided == outcome).map(|(_, holds)| holds)
}

/// Whether one of these regions has certainly ended with success if this expression is true, as far as it states that literally.
pub(super) fn one_succeeds(holds: &Expr, regions: &BTreeSet<StateId>) -> bool {
    let is_success = |a: &Expr, b: &Expr| match (a, b) {
        (Expr::Port { state, port }, Expr::Literal(Value::String(outcome))) => {
            port == "outcome" && outcome == SUCCESS && regions.contains(state)
        }
        _ => false,
    };
    match holds {
        Expr::Binary(BinaryOperator::And, a, b) => one_succeeds(a, regions) || one_succeeds(b, regions),
        Expr::Binary(BinaryOperator::Or, a, b) => one_succeeds(a, regions) && one_succeeds(b, regions),
        Expr::Binary(BinaryOperator::Equal, a, b) => is_success(a, b) || is_success(b, a),
        _ => false,
    }
}

/// Whether the outcome gives outputs and is not success.
fn is_own(outcome: &str) -> bool {
    outcome != SUCCESS && !is_failure(outcome)
}

fn index(id: StateId) -> usize {
    id.0 as usize
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
