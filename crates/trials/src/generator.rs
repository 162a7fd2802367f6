//! The random program of a seed: its states and how they lead to each other.
//!
//! Every program ends: only the outcome [`AGAIN`] leads back, only the oracle says it, and never on a third visit; and every
//! `while` counts. Regions of a barrier write facts, block actuators and assign variables that no other region touches. A
//! preemptive concurrency stands in no barrier and holds a few actions only, which have nothing to fail of before they start, so
//! that the oracle can keep the moments at which its regions end apart by more than anything else may shift them.

use super::annotations::{resource, task_resource};
use super::{AGAIN, ARGUMENTS, Dice, EMPTY, FOUND, Features, PREDICATES, around, is_in_routine, is_preemptive};
use ratn_model::expression::{BinaryOperator, EffectExpr, Expr, FactExpr, Function};
use ratn_model::id::StateId;
use ratn_model::program::{
    ABORTED, Annotations, Exceptions, Location, PREEMPTED, Program, SUCCESS, State, StateKind, Target, TaskOutput,
};
use ratn_model::resource::ResourceOperation;
use ratn_model::value::{Type, Value};
use std::collections::BTreeMap;

/// No program has many more states.
const MAX_STATES: usize = 26;

/// The random program of a seed.
pub fn program(seed: u64, features: &Features) -> Program {
    let mut maker = Maker { dice: Dice(seed), states: Vec::new(), features: *features };
    maker.push("root".to_owned(), String::new(), None);
    let room = Room {
        readable: (0..PREDICATES).collect(),
        writable: (0..PREDICATES).collect(),
        actuators: vec!["Arm", "Head", "Base"],
        is_alone: true,
        is_preemptive: false,
    };
    let mut visible = Visible::default();
    let variables = maker.variables(Program::ROOT, &room, &mut visible);
    let (children, inner, outcomes) = maker.list(Program::ROOT, "", 0, &room, visible, false);
    let root = &mut maker.states[0];
    root.kind = StateKind::Sequence { children, outputs: Vec::new() };
    root.variables = variables;
    root.outcomes = outcomes;
    let outputs = inner
        .ports
        .last()
        .map(|state| TaskOutput {
            name: "last".to_owned(),
            ty: Type::Any,
            value: Expr::Port { state: *state, port: "x".to_owned() },
        })
        .into_iter()
        .collect();
    let horizon = [4, 12, 60][maker.dice.below(3) as usize];
    let width =
        if features.speculation { 1 + maker.dice.below(8) as usize } else { Program::DEFAULT_SPECULATION_WIDTH };
    let imprecise = features.weak && maker.dice.percent(50);
    let mut program = Program {
        name: format!("random {seed}"),
        horizon,
        speculation_width: width,
        deadline_s: None,
        exceptions: if imprecise { Exceptions::Imprecise } else { Exceptions::Precise },
        parameters: Vec::new(),
        outputs,
        initial: (0..PREDICATES)
            .map(|p| EffectExpr::Set(fact_at(p, 0), Expr::Literal(Value::Int(p as i64 % 4))))
            .collect(),
        tolerances: Default::default(),
        ontology: None,
        states: maker.states,
        digest: String::new(),
    };
    create_in_routines(&mut program);
    let regions = program.states.iter().filter(|state| is_preemptive(state));
    let around: Vec<StateId> = regions.flat_map(|state| around(&program, state)).map(|state| state.id).collect();
    for id in around {
        // Blocks go to every state inside: regions that race must not wait for each other's workers.
        program.states[id.0 as usize].annotations.resources.retain(|r| r.operation != ResourceOperation::Block);
    }
    program
}

/// A routine acquires at its entry what anything in it consumes, come to it or not: it is another program then than state by state.
/// In random routines nothing is consumed.
fn create_in_routines(program: &mut Program) {
    let inside: Vec<StateId> =
        program.states.iter().filter(|state| is_in_routine(program, state)).map(|state| state.id).collect();
    for id in inside {
        for resource in &mut program.states[id.0 as usize].annotations.resources {
            if resource.operation == ResourceOperation::Consume {
                resource.operation = ResourceOperation::Create;
            }
        }
    }
}

pub(super) fn fact_at(predicate: u64, argument: i64) -> FactExpr {
    FactExpr { predicate: format!("p{predicate}"), arguments: vec![Some(Expr::Literal(Value::Int(argument)))] }
}

/// What a list of states may touch.
#[derive(Debug, Clone)]
pub(super) struct Room {
    /// Predicates that it may read.
    pub(super) readable: Vec<u64>,
    /// Predicates that it may write.
    pub(super) writable: Vec<u64>,
    /// What of the robot it may block.
    pub(super) actuators: Vec<&'static str>,
    /// Nothing runs beside it: it may touch anything, and task resources.
    pub(super) is_alone: bool,
    /// It is inside a preemptive concurrency.
    pub(super) is_preemptive: bool,
}

/// What a state may name.
#[derive(Debug, Clone, Default)]
pub(super) struct Visible {
    /// States with an output `x`.
    pub(super) ports: Vec<StateId>,
    /// Loop variables and scoped ones: every action gets all of them.
    pub(super) variables: Vec<String>,
    /// Those that may be given new values.
    pub(super) assignable: Vec<String>,
}

pub(super) struct Maker {
    pub(super) dice: Dice,
    pub(super) states: Vec<State>,
    pub(super) features: Features,
}

impl Maker {
    fn push(&mut self, name: String, path: String, parent: Option<StateId>) -> StateId {
        let id = StateId(self.states.len() as u64);
        self.states.push(State {
            id,
            name,
            path,
            parent,
            kind: StateKind::Sequence { children: Vec::new(), outputs: Vec::new() },
            outcomes: Vec::new(),
            transitions: BTreeMap::new(),
            variables: Vec::new(),
            assign: Vec::new(),
            defaults: BTreeMap::new(),
            annotations: Annotations::default(),
            location: Location::default(),
        });
        id
    }

    pub(super) fn at(&mut self, id: StateId) -> &mut State {
        &mut self.states[id.0 as usize]
    }

    fn is_action(&self, id: StateId) -> bool {
        matches!(self.states[id.0 as usize].kind, StateKind::Action { .. })
    }

    /// A list of states; with what is visible behind it, and the custom outcomes by which it is left.
    fn list(
        &mut self,
        parent: StateId,
        path: &str,
        depth: u64,
        room: &Room,
        mut visible: Visible,
        in_loop: bool,
    ) -> (Vec<StateId>, Visible, Vec<String>) {
        let count = match (depth, room.is_preemptive) {
            (0, _) => 3 + self.dice.below(6),
            (_, true) => 1 + self.dice.below(3),
            _ => 1 + self.dice.below(4),
        };
        let mut children = Vec::new();
        for number in 0..count {
            if self.states.len() >= MAX_STATES && !children.is_empty() {
                break;
            }
            let id = self.state(parent, path, number, depth, room, &visible);
            children.push(id);
            let writes = match &self.at(id).kind {
                StateKind::Action { .. } => true,
                StateKind::Sequence { outputs, .. } | StateKind::Concurrency { outputs, .. } => !outputs.is_empty(),
                _ => false,
            };
            if writes {
                visible.ports.push(id);
            }
        }
        let (outcomes, back) = self.transitions(&children);
        if in_loop || back {
            self.flow_back(&children);
        }
        (children, visible, outcomes)
    }

    /// Where the outcomes of a list's states lead; the custom outcomes that leave the list, and whether anything leads back.
    fn transitions(&mut self, children: &[StateId]) -> (Vec<String>, bool) {
        let (mut leaving, mut back): (Vec<String>, bool) = (Vec::new(), false);
        for (place, id) in children.iter().enumerate() {
            let custom = self.at(*id).outcomes.clone();
            let all = [SUCCESS, ABORTED, PREEMPTED].map(str::to_owned).into_iter().chain(custom);
            for outcome in all {
                let target = if self.features.transitions { self.target(children, place, &outcome) } else { None };
                back |= matches!(&target, Some(Target::State(to)) if to <= id);
                let left = match &target {
                    Some(Target::State(_)) => None,
                    Some(Target::Outcome(name)) => Some(name.clone()),
                    None => Some(outcome.clone()),
                };
                if let Some(name) = left
                    && [FOUND, EMPTY, AGAIN].contains(&name.as_str())
                    && !leaving.contains(&name)
                {
                    leaving.push(name);
                }
                if let Some(target) = target {
                    self.at(*id).transitions.insert(outcome, target);
                }
            }
        }
        (leaving, back)
    }

    fn target(&mut self, children: &[StateId], place: usize, outcome: &str) -> Option<Target> {
        let later = &children[place + 1..];
        let forward = |dice: &mut Dice| dice.one_of(later).map(|id| Target::State(*id));
        let leave = |name: &str| Some(Target::Outcome(name.to_owned()));
        let chance = self.dice.below(100);
        match outcome {
            SUCCESS => match chance {
                0..5 => forward(&mut self.dice),
                5..8 => leave(FOUND),
                8..10 => leave(SUCCESS),
                _ => None,
            },
            AGAIN => match chance {
                0..75 => self.dice.one_of(&children[..=place]).map(|id| Target::State(*id)),
                75..85 => forward(&mut self.dice),
                _ => None,
            },
            ABORTED | PREEMPTED => match chance {
                0..25 => forward(&mut self.dice),
                25..32 => leave(SUCCESS),
                32..36 => leave(EMPTY),
                _ => None,
            },
            _ => match chance {
                0..55 => forward(&mut self.dice),
                55..65 => leave(SUCCESS),
                65..70 => leave(FOUND),
                70..72 => leave(ABORTED),
                _ => None,
            },
        }
    }

    /// Where a state may be visited again, an action may use what a later one wrote the time before.
    fn flow_back(&mut self, children: &[StateId]) {
        if !self.features.variables || !self.dice.percent(40) {
            return;
        }
        let actions: Vec<StateId> = children.iter().copied().filter(|id| self.is_action(*id)).collect();
        let [first, .., last] = actions.as_slice() else { return };
        self.at(*last).defaults.insert("x".to_owned(), Value::Int(1));
        if let StateKind::Action { inputs, .. } = &mut self.at(*first).kind {
            inputs.push(("before".to_owned(), Expr::Port { state: *last, port: "x".to_owned() }));
        }
    }

    fn state(
        &mut self,
        parent: StateId,
        around: &str,
        number: u64,
        depth: u64,
        room: &Room,
        visible: &Visible,
    ) -> StateId {
        let name = format!("s{}_{number}", self.states.len());
        let path = if around.is_empty() { name.clone() } else { format!("{around}/{name}") };
        let id = self.push(name, path.clone(), Some(parent));
        let composite = depth < 3 && self.dice.percent(38);
        let kinds = if room.is_preemptive { 1 } else { 9 };
        let kind = match (composite, self.dice.below(kinds)) {
            (false, _) => self.action(id, room, visible),
            (true, 0 | 1) => self.hierarchy(id, &path, depth, room, visible),
            (true, 2 | 3) => self.for_each(id, &path, depth, room, visible),
            (true, 4) if self.features.whiles => self.repeat(id, &path, depth, room, visible),
            (true, 5) if self.features.regions => self.barrier(id, &path, depth, room, visible),
            (true, 6) if self.features.preemptive && room.is_alone => self.preemptive(id, &path, depth, room, visible),
            (true, _) => self.condition(id, &path, depth, room, visible),
        };
        self.at(id).kind = kind;
        if self.features.variables && self.dice.percent(65) {
            let list = Value::List(vec![Value::Int(0)]);
            self.at(id).defaults = BTreeMap::from([("x".to_owned(), Value::Int(1)), ("list".to_owned(), list)]);
        }
        if self.features.speculation && self.dice.percent(10) {
            let marked = self.at(id).outcomes.first().cloned();
            self.at(id).annotations.exceptional.extend(marked);
        }
        id
    }

    /// Scoped variables of a sequence, visible inside from here on.
    fn variables(&mut self, id: StateId, room: &Room, visible: &mut Visible) -> Vec<(String, Expr)> {
        if !self.features.variables || !self.dice.percent(35) {
            return Vec::new();
        }
        let name = format!("n{}", id.0);
        let value = match visible.ports.last() {
            Some(state) if !room.is_preemptive && self.dice.percent(30) => {
                Expr::Port { state: *state, port: "x".to_owned() }
            }
            _ if self.dice.percent(40) => self.number_of_fact(room),
            _ => Expr::Literal(Value::Int(self.dice.below(ARGUMENTS) as i64)),
        };
        visible.variables.push(name.clone());
        visible.assignable.push(name.clone());
        vec![(name, value)]
    }

    /// A fact's value, 0 where there is none.
    fn number_of_fact(&mut self, room: &Room) -> Expr {
        let fact = self.fact(&room.readable, &Visible::default());
        let absent = Expr::Literal(Value::Int(0));
        Expr::Call(Function::If, vec![Expr::Exists(fact.clone()), Expr::Fact(fact), absent])
    }

    pub(super) fn assignments(&mut self, visible: &Visible, outputs: bool) -> Vec<(String, Expr)> {
        if !self.features.variables || !self.dice.percent(30) {
            return Vec::new();
        }
        let Some(name) = self.dice.one_of(&visible.assignable).cloned() else { return Vec::new() };
        let one = Box::new(Expr::Literal(Value::Int(1)));
        let value = match self.dice.below(3) {
            0 if outputs => Expr::Output("x".to_owned()),
            1 => Expr::Literal(Value::Int(self.dice.below(ARGUMENTS) as i64)),
            _ => Expr::Binary(BinaryOperator::Add, Box::new(Expr::Variable(name.clone())), one),
        };
        vec![(name, value)]
    }

    fn hierarchy(&mut self, id: StateId, path: &str, depth: u64, room: &Room, visible: &Visible) -> StateKind {
        let mut inner = visible.clone();
        self.at(id).variables = Vec::new();
        let variables = self.variables(id, room, &mut inner);
        let (children, inner, outcomes) = self.list(id, path, depth + 1, room, inner, false);
        let own = inner.ports.iter().rev().find(|state| !visible.ports.contains(state)).copied();
        let outputs: Vec<TaskOutput> = own
            .filter(|_| self.dice.percent(70))
            .map(|state| {
                let port = Expr::Port { state, port: "x".to_owned() };
                let value = if self.dice.percent(30) { self.number_of_fact(room) } else { port };
                TaskOutput { name: "x".to_owned(), ty: Type::Any, value }
            })
            .into_iter()
            .collect();
        let assign = self.assignments(visible, !outputs.is_empty());
        let mut annotations = self.boundary(room, visible);
        annotations.routine = !room.is_preemptive && self.dice.percent(25);
        let state = self.at(id);
        state.variables = variables;
        state.outcomes = outcomes;
        state.assign = assign;
        state.annotations = annotations;
        StateKind::Sequence { children, outputs }
    }

    /// What a hierarchy or a concurrency does at its entry and exit.
    fn boundary(&mut self, room: &Room, visible: &Visible) -> Annotations {
        let mut annotations = Annotations::default();
        for (outcome, chance) in [(SUCCESS, 20), (ABORTED, 20), (FOUND, 10)] {
            if (outcome != FOUND || self.features.effects) && self.dice.percent(chance) {
                let effect = self.effect(room, &Visible::default(), false);
                annotations.effects.insert(outcome.to_owned(), vec![effect]);
            }
        }
        if !room.is_preemptive && self.dice.percent(15) {
            let required = self.required(room, visible);
            annotations.requires.push(required);
        }
        if !room.is_preemptive && self.dice.percent(20) {
            annotations.resources.push(resource(ResourceOperation::Block, "Planner", 2));
        }
        if room.is_alone && self.dice.percent(20) {
            annotations.resources.push(task_resource(ResourceOperation::Create));
        }
        annotations
    }

    fn condition(&mut self, id: StateId, path: &str, depth: u64, room: &Room, visible: &Visible) -> StateKind {
        self.at(id).annotations.routine = self.dice.percent(15);
        let predicate = self.predicate(room, visible);
        let (then, _, mut outcomes) = self.list(id, path, depth + 1, room, visible.clone(), false);
        let mut otherwise = Vec::new();
        if self.dice.percent(60) {
            let (list, _, more) = self.list(id, path, depth + 1, room, visible.clone(), false);
            otherwise = list;
            outcomes.extend(more);
        }
        outcomes.sort();
        outcomes.dedup();
        self.at(id).outcomes = outcomes;
        StateKind::Condition { predicate, then, otherwise }
    }

    fn for_each(&mut self, id: StateId, path: &str, depth: u64, room: &Room, visible: &Visible) -> StateKind {
        let variable = format!("v{}", id.0);
        let lists = visible.ports.last().copied().filter(|state| self.is_action(*state));
        let collection = match lists {
            Some(state) if self.dice.percent(70) => Expr::Port { state, port: "list".to_owned() },
            _ => {
                let items = (0..self.dice.below(3)).map(|n| Expr::Literal(Value::Int(n as i64)));
                Expr::List(items.collect())
            }
        };
        self.at(id).annotations.routine = self.dice.percent(15);
        let mut inner = visible.clone();
        inner.variables.push(variable.clone());
        let index = (self.features.whiles && self.dice.percent(25)).then(|| format!("i{}", id.0));
        inner.variables.extend(index.clone());
        let (body, _, outcomes) = self.list(id, path, depth + 1, room, inner, true);
        self.at(id).outcomes = outcomes;
        StateKind::ForEach { variable, index, collection, body }
    }

    /// `while` or `do … while`, counted.
    fn repeat(&mut self, id: StateId, path: &str, depth: u64, room: &Room, visible: &Visible) -> StateKind {
        let index = format!("i{}", id.0);
        let limit = Expr::Literal(Value::Int(1 + self.dice.below(3) as i64));
        let counted = Expr::Binary(BinaryOperator::Less, Box::new(Expr::Variable(index.clone())), Box::new(limit));
        self.at(id).annotations.routine = self.dice.percent(12);
        let mut inner = visible.clone();
        inner.variables.push(index.clone());
        let (body, seen, outcomes) = self.list(id, path, depth + 1, room, inner, true);
        // The body's outputs, or what is seen outside.
        let own = seen.ports.iter().rev().find(|state| !visible.ports.contains(state)).copied();
        let body_first = self.dice.percent(40);
        let predicate = match own {
            Some(state) if body_first && self.dice.percent(50) => {
                let x = Expr::Port { state, port: "x".to_owned() };
                Expr::Binary(BinaryOperator::NotEqual, Box::new(x), Box::new(Expr::Literal(Value::Int(0))))
            }
            _ if self.dice.percent(60) => self.predicate(room, visible),
            _ => Expr::Literal(Value::Bool(true)),
        };
        let predicate = Expr::Binary(BinaryOperator::And, Box::new(counted), Box::new(predicate));
        self.at(id).outcomes = outcomes;
        StateKind::While { predicate, body_first, index: Some(index), body }
    }

    /// Two or three regions with facts, actuators and variables of their own.
    fn barrier(&mut self, id: StateId, path: &str, depth: u64, room: &Room, visible: &Visible) -> StateKind {
        let count = 2 + self.dice.below(2) as usize;
        let shares = self.features.weak && self.dice.percent(50);
        let mut rooms =
            vec![Room { is_alone: false, writable: Vec::new(), actuators: Vec::new(), ..room.clone() }; count];
        for region in &mut rooms {
            region.readable.retain(|predicate| shares || !room.writable.contains(predicate));
        }
        for predicate in &room.writable {
            let owner = self.dice.below(count as u64 + 1) as usize;
            for (number, region) in rooms.iter_mut().enumerate() {
                // Of nobody: all may read it.
                if (number == owner || owner == count) && !region.readable.contains(predicate) {
                    region.readable.push(*predicate);
                }
                if number == owner || shares {
                    region.writable.push(*predicate);
                }
            }
        }
        for actuator in &room.actuators {
            let owner = self.dice.below(count as u64) as usize;
            rooms[owner].actuators.push(actuator);
        }
        let mut variables: Vec<(Vec<String>, Vec<String>)> = vec![Default::default(); count];
        for name in &visible.variables {
            let owner = self.dice.below(count as u64) as usize;
            let assignable = visible.assignable.contains(name);
            for (number, (seen, assigned)) in variables.iter_mut().enumerate() {
                if !assignable || number == owner {
                    seen.push(name.clone());
                }
                if assignable && number == owner {
                    assigned.push(name.clone());
                }
            }
        }
        let mut regions = Vec::new();
        for (number, (room, (variables, assignable))) in rooms.iter().zip(variables).enumerate() {
            let inner = Visible { variables, assignable, ..visible.clone() };
            regions.push(self.region(id, path, number, depth, room, &inner));
        }
        self.concurrency(id, regions, false, room, visible)
    }

    /// Two regions of a few actions.
    fn preemptive(&mut self, id: StateId, path: &str, depth: u64, room: &Room, visible: &Visible) -> StateKind {
        let actuators = [vec!["Arm", "Base"], vec!["Head"]];
        let mut regions = Vec::new();
        for (number, actuators) in actuators.into_iter().enumerate() {
            let room = Room { actuators, is_preemptive: true, ..room.clone() };
            let inner = Visible { assignable: Vec::new(), ..visible.clone() };
            regions.push(self.region(id, path, number, depth.max(2), &room, &inner));
        }
        self.concurrency(id, regions, true, room, visible)
    }

    fn region(
        &mut self,
        parent: StateId,
        around: &str,
        number: usize,
        depth: u64,
        room: &Room,
        visible: &Visible,
    ) -> StateId {
        let name = format!("r{}_{number}", self.states.len());
        let path = format!("{around}/{name}");
        let id = self.push(name, path.clone(), Some(parent));
        let kind = if self.dice.percent(25) {
            self.action(id, room, visible)
        } else {
            self.hierarchy(id, &path, depth, room, visible)
        };
        self.at(id).kind = kind;
        self.at(id).annotations.routine &= !room.is_preemptive;
        id
    }

    fn concurrency(
        &mut self,
        id: StateId,
        regions: Vec<StateId>,
        preemptive: bool,
        room: &Room,
        visible: &Visible,
    ) -> StateKind {
        let ended = |region: StateId, by: &str| {
            let outcome = Expr::Port { state: region, port: "outcome".to_owned() };
            Expr::Binary(
                BinaryOperator::Equal,
                Box::new(outcome),
                Box::new(Expr::Literal(Value::String(by.to_owned()))),
            )
        };
        let (first, last) = (regions[0], regions[regions.len() - 1]);
        let mut decide = Vec::new();
        if self.dice.percent(50) {
            decide.push((FOUND.to_owned(), ended(first, FOUND)));
            decide.push((EMPTY.to_owned(), ended(last, ABORTED)));
            if self.dice.percent(50) {
                decide.push((SUCCESS.to_owned(), ended(first, SUCCESS)));
            }
        }
        let from = self.dice.one_of(&regions).copied().unwrap_or(first);
        let writes = match &self.at(from).kind {
            StateKind::Action { .. } => true,
            StateKind::Sequence { outputs, .. } => !outputs.is_empty(),
            _ => false,
        };
        let value = match self.dice.below(3) {
            0 => {
                let one = Expr::Literal(Value::Int(1));
                Some(Expr::Call(Function::If, vec![ended(from, SUCCESS), one, Expr::Literal(Value::Int(2))]))
            }
            1 if writes => Some(Expr::Port { state: from, port: "x".to_owned() }),
            _ => None,
        };
        let outputs: Vec<TaskOutput> =
            value.map(|value| TaskOutput { name: "x".to_owned(), ty: Type::Any, value }).into_iter().collect();
        let mut outcomes: Vec<String> =
            decide.iter().map(|(name, _)| name.clone()).filter(|name| name != SUCCESS).collect();
        if preemptive && decide.is_empty() {
            outcomes = regions.iter().flat_map(|id| self.states[id.0 as usize].outcomes.clone()).collect();
            outcomes.sort();
            outcomes.dedup();
        }
        let assign = self.assignments(visible, !outputs.is_empty());
        let annotations = self.boundary(room, visible);
        let state = self.at(id);
        state.outcomes = outcomes;
        state.assign = assign;
        state.annotations = annotations;
        StateKind::Concurrency { regions, preemptive, decide, outputs }
    }

    fn action(&mut self, id: StateId, room: &Room, visible: &Visible) -> StateKind {
        let mut inputs: Vec<(String, Expr)> = Vec::new();
        for (number, variable) in visible.variables.iter().enumerate() {
            inputs.push((format!("variable{number}"), Expr::Variable(variable.clone())));
        }
        for (number, state) in visible.ports.iter().rev().take(3).enumerate() {
            if !room.is_preemptive && self.dice.percent(45) {
                inputs.push((format!("in{number}"), Expr::Port { state: *state, port: "x".to_owned() }));
            }
        }
        let custom = self.features.transitions && self.dice.percent(45);
        let annotations = self.annotations(room, visible, custom);
        if let Some(fact) = annotations.reads.iter().flatten().next()
            && self.dice.percent(30)
        {
            inputs.push(("fact".to_owned(), Expr::Fact(fact.clone())));
        }
        let assign = self.assignments(visible, true);
        let state = self.at(id);
        state.annotations = annotations;
        state.assign = assign;
        if custom {
            state.outcomes = vec![FOUND.to_owned(), EMPTY.to_owned(), AGAIN.to_owned()];
        }
        let outputs =
            BTreeMap::from([("x".to_owned(), Type::Int), ("list".to_owned(), Type::List(Box::new(Type::Int)))]);
        let action = if custom { "look" } else { "act" };
        StateKind::Action { provider: "oracle".to_owned(), action: action.to_owned(), inputs, outputs }
    }

    fn predicate(&mut self, room: &Room, visible: &Visible) -> Expr {
        let what = match visible.ports.last() {
            Some(state) if self.dice.percent(60) => Expr::Port { state: *state, port: "x".to_owned() },
            _ if self.dice.percent(20) && !visible.variables.is_empty() => {
                let name = self.dice.one_of(&visible.variables).cloned().unwrap_or_default();
                Expr::Variable(name)
            }
            _ => Expr::Fact(self.fact(&room.readable, visible)),
        };
        let limit = Expr::Literal(Value::Int(self.dice.below(3) as i64));
        Expr::Binary(BinaryOperator::Equal, Box::new(what), Box::new(limit))
    }
}
