//! Random task programs and a random but fixed world for them: the *oracle* of the safety theorem.
//!
//! A program is made of sequences, hierarchies, loops over lists known only at run time, conditions and routines, with
//! computing, sensing and irreversible nodes, annotated truly (but often only in part). What a node does is a hash of what
//! it is entitled to see: its path with visit numbers, its inputs, and the facts it declares to read. Any read from a wrong
//! world changes the result, and with it everything after.

use crate::run::{Answer, Oracle, Performance};
use ratn_executive::protocol::Goal;
use ratn_model::expression::{BinaryOperator, EffectExpr, Expr, FactExpr, Lookup, Scope};
use ratn_model::fact::{FactPattern, Footprint};
use ratn_model::id::StateId;
use ratn_model::program::{
    ABORTED, Annotations, Location, Nature, Program, ResourceExpr, SUCCESS, State, StateKind, TaskOutput, WORLD_MODEL,
};
use ratn_model::resource::{ResourceClass, ResourceOperation};
use ratn_model::value::{Type, Value};
use ratn_world::world::World;
use std::borrow::Cow;
use std::collections::BTreeMap;

/// The kinds of resources that random programs use, with class and units.
pub const RESOURCES: [(&str, ResourceClass, u32); 5] = [
    ("Planner", ResourceClass::Process, 2),
    ("Eye", ResourceClass::Process, 1),
    ("Arm", ResourceClass::Module, 1),
    ("Head", ResourceClass::Module, 1),
    (WORLD_MODEL, ResourceClass::World, 3),
];

/// A small generator of pseudo-random numbers (SplitMix64): the same on every machine, for ever.
#[derive(Debug, Clone)]
pub struct Dice(pub u64);

impl Dice {
    /// The next number.
    pub fn roll(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// A number below `bound`.
    pub fn below(&mut self, bound: u64) -> u64 {
        self.roll() % bound.max(1)
    }

    /// True with this chance in percent.
    pub fn percent(&mut self, chance: u64) -> bool {
        self.below(100) < chance
    }
}

/// Predicates of random worlds: `p0(n)` … `p3(n)`.
const PREDICATES: u64 = 4;
/// Arguments are below this.
const ARGUMENTS: u64 = 3;
/// No program has more states.
const MAX_STATES: usize = 24;

/// The random program of a seed.
pub fn program(seed: u64) -> Program {
    let mut maker = Maker { dice: Dice(seed), states: Vec::new() };
    maker.states.push(State {
        id: Program::ROOT,
        name: "root".to_owned(),
        path: String::new(),
        parent: None,
        kind: StateKind::Sequence { children: Vec::new(), outputs: Vec::new() },
        outcomes: Vec::new(),
        transitions: BTreeMap::new(),
        variables: Vec::new(),
        assign: Vec::new(),
        defaults: BTreeMap::new(),
        annotations: Annotations::default(),
        location: Location::default(),
    });
    let scope = Visible::default();
    let (children, visible) = maker.list(Program::ROOT, "", 0, scope);
    maker.states[0].kind = StateKind::Sequence { children, outputs: Vec::new() };
    let outputs = visible
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
    Program {
        name: format!("random {seed}"),
        horizon,
        speculation_width: Program::DEFAULT_SPECULATION_WIDTH,
        deadline_s: None,
        exceptions: ratn_model::program::Exceptions::Precise,
        parameters: Vec::new(),
        outputs,
        initial: (0..PREDICATES)
            .map(|p| {
                let fact = FactExpr { predicate: format!("p{p}"), arguments: vec![Some(Expr::Literal(Value::Int(0)))] };
                EffectExpr::Set(fact, Expr::Literal(Value::Int(p as i64)))
            })
            .collect(),
        states: maker.states,
        digest: String::new(),
    }
}

/// What a state may name.
#[derive(Debug, Clone, Default)]
struct Visible {
    ports: Vec<StateId>,
    variables: Vec<String>,
}

struct Maker {
    dice: Dice,
    states: Vec<State>,
}

impl Maker {
    fn list(&mut self, parent: StateId, path: &str, depth: u64, mut visible: Visible) -> (Vec<StateId>, Visible) {
        let count = if depth == 0 { 3 + self.dice.below(6) } else { 1 + self.dice.below(4) };
        let mut children = Vec::new();
        for number in 0..count {
            if self.states.len() >= MAX_STATES {
                break;
            }
            let id = self.state(parent, path, number, depth, &visible);
            children.push(id);
            let writes = match &self.states[id.0 as usize].kind {
                StateKind::Action { .. } => true,
                StateKind::Sequence { outputs, .. } => !outputs.is_empty(),
                _ => false,
            };
            if writes {
                visible.ports.push(id);
            }
        }
        (children, visible)
    }

    fn state(&mut self, parent: StateId, around: &str, number: u64, depth: u64, visible: &Visible) -> StateId {
        let id = StateId(self.states.len() as u64);
        let name = format!("s{}_{number}", id.0);
        let path = if around.is_empty() { name.clone() } else { format!("{around}/{name}") };
        self.states.push(State {
            id,
            name,
            path: path.clone(),
            parent: Some(parent),
            kind: StateKind::Sequence { children: Vec::new(), outputs: Vec::new() },
            outcomes: Vec::new(),
            transitions: BTreeMap::new(),
            variables: Vec::new(),
            assign: Vec::new(),
            defaults: BTreeMap::new(),
            annotations: Annotations::default(),
            location: Location::default(),
        });
        let composite = depth < 3 && self.dice.percent(35);
        let kind = match (composite, self.dice.below(3)) {
            (false, _) => self.action(id, visible),
            (true, 0) => self.hierarchy(id, &path, depth, visible),
            (true, 1) => self.for_each(id, &path, depth, visible),
            (true, _) => {
                self.states[id.0 as usize].annotations.routine = self.dice.percent(15);
                let predicate = self.predicate(visible);
                let (then, _) = self.list(id, &path, depth + 1, visible.clone());
                let (otherwise, _) = if self.dice.percent(60) {
                    self.list(id, &path, depth + 1, visible.clone())
                } else {
                    Default::default()
                };
                StateKind::Condition { predicate, then, otherwise }
            }
        };
        self.states[id.0 as usize].kind = kind;
        id
    }

    fn hierarchy(&mut self, id: StateId, path: &str, depth: u64, visible: &Visible) -> StateKind {
        let (children, inner) = self.list(id, path, depth + 1, visible.clone());
        let own = inner.ports.iter().rev().find(|state| !visible.ports.contains(state)).copied();
        let outputs = own
            .filter(|_| self.dice.percent(70))
            .map(|state| {
                // A fact at the exit, as often as what a child put out.
                let fact = self.fact(&Visible { ports: Vec::new(), ..visible.clone() });
                let looked_up = Expr::Binary(
                    BinaryOperator::Equal,
                    Box::new(Expr::Fact(fact)),
                    Box::new(Expr::Literal(Value::Int(1))),
                );
                let value = if self.dice.percent(30) { looked_up } else { Expr::Port { state, port: "x".to_owned() } };
                TaskOutput { name: "x".to_owned(), ty: Type::Any, value }
            })
            .into_iter()
            .collect();
        let mut annotations = Annotations { routine: self.dice.percent(25), ..Annotations::default() };
        for (outcome, chance) in [(SUCCESS, 20), (ABORTED, 20)] {
            if self.dice.percent(chance) {
                annotations.effects.insert(outcome.to_owned(), vec![self.effect(&Visible::default(), false)]);
            }
        }
        // As the loader has it: what its effects look up it reads.
        let used = annotations.effects.values().flat_map(|effects| EffectExpr::fact_expressions(effects));
        annotations.reads = Some(used.cloned().collect());
        if self.dice.percent(15) {
            let required = self.unlike_one(visible);
            annotations.requires.push(required);
        }
        if self.dice.percent(20) {
            annotations.resources.push(resource(ResourceOperation::Block, "Planner", 2));
        }
        if self.dice.percent(20) {
            annotations.resources.push(task_resource(ResourceOperation::Create));
        }
        self.states[id.0 as usize].annotations = annotations;
        StateKind::Sequence { children, outputs }
    }

    fn for_each(&mut self, id: StateId, path: &str, depth: u64, visible: &Visible) -> StateKind {
        let variable = format!("v{}", id.0);
        let lists =
            visible.ports.last().filter(|state| matches!(self.states[state.0 as usize].kind, StateKind::Action { .. }));
        let collection = match lists {
            Some(state) if self.dice.percent(70) => Expr::Port { state: *state, port: "list".to_owned() },
            _ => {
                let items = (0..self.dice.below(3)).map(|n| Expr::Literal(Value::Int(n as i64)));
                Expr::List(items.collect())
            }
        };
        self.states[id.0 as usize].annotations.routine = self.dice.percent(15);
        let mut inner = visible.clone();
        inner.variables.push(variable.clone());
        let (body, _) = self.list(id, path, depth + 1, inner);
        StateKind::ForEach { variable, index: None, collection, body }
    }

    fn action(&mut self, id: StateId, visible: &Visible) -> StateKind {
        let mut inputs: Vec<(String, Expr)> = Vec::new();
        for (number, variable) in visible.variables.iter().enumerate() {
            inputs.push((format!("variable{number}"), Expr::Variable(variable.clone())));
        }
        for (number, state) in visible.ports.iter().rev().take(3).enumerate() {
            if self.dice.percent(45) {
                inputs.push((format!("in{number}"), Expr::Port { state: *state, port: "x".to_owned() }));
            }
        }
        let annotations = self.annotations(visible);
        if let Some(FactExpr { predicate, arguments }) = annotations.reads.iter().flatten().next()
            && self.dice.percent(30)
        {
            let fact = FactExpr { predicate: predicate.clone(), arguments: arguments.clone() };
            inputs.push(("fact".to_owned(), Expr::Fact(fact)));
        }
        self.states[id.0 as usize].annotations = annotations;
        let outputs =
            BTreeMap::from([("x".to_owned(), Type::Int), ("list".to_owned(), Type::List(Box::new(Type::Int)))]);
        StateKind::Action { provider: "oracle".to_owned(), action: "act".to_owned(), inputs, outputs }
    }

    fn annotations(&mut self, visible: &Visible) -> Annotations {
        let mut annotations = Annotations::default();
        let block = |kind: &str| resource(ResourceOperation::Block, kind, 1);
        let facts = |maker: &mut Maker, most: u64| -> Vec<FactExpr> {
            (0..maker.dice.below(most + 1)).map(|_| maker.fact(visible)).collect()
        };
        match self.dice.below(10) {
            0..=4 => {
                annotations.nature = Nature::Computes;
                annotations.reads = self.dice.percent(90).then(|| facts(self, 3));
                let planners = if self.dice.percent(15) { 2 } else { 1 };
                annotations.resources =
                    vec![resource(ResourceOperation::Block, "Planner", planners), block(WORLD_MODEL)];
            }
            5 | 6 => {
                annotations.nature = Nature::Senses(facts(self, 2));
                annotations.resources = vec![block("Eye")];
                if self.dice.percent(30) {
                    annotations.resources.push(block(WORLD_MODEL));
                }
                if self.dice.percent(85) {
                    let effects = if self.dice.percent(60) { vec![self.effect(visible, true)] } else { Vec::new() };
                    annotations.effects.insert(SUCCESS.to_owned(), effects);
                }
            }
            _ => {
                annotations.reads = self.dice.percent(80).then(|| facts(self, 2));
                annotations.resources = vec![block(if self.dice.percent(70) { "Arm" } else { "Head" })];
                if self.dice.percent(15) {
                    annotations.resources.push(task_resource(ResourceOperation::Create));
                }
                if self.dice.percent(85) {
                    let count = self.dice.below(3);
                    let effects = (0..count).map(|_| self.effect(visible, true)).collect();
                    annotations.effects.insert(SUCCESS.to_owned(), effects);
                }
                if self.dice.percent(30) {
                    annotations.effects.insert(ABORTED.to_owned(), vec![self.effect(&Visible::default(), false)]);
                }
            }
        }
        if self.dice.percent(10) {
            let required = self.unlike_one(visible);
            annotations.requires.push(required);
        }
        annotations
    }

    /// `not (fact = 1)`
    fn unlike_one(&mut self, visible: &Visible) -> Expr {
        let fact = Box::new(Expr::Fact(self.fact(visible)));
        let is_one = Expr::Binary(BinaryOperator::Equal, fact, Box::new(Expr::Literal(Value::Int(1))));
        Expr::Unary(ratn_model::expression::UnaryOperator::Not, Box::new(is_one))
    }

    fn fact(&mut self, visible: &Visible) -> FactExpr {
        let argument = match visible.variables.last() {
            Some(variable) if self.dice.percent(40) => Some(Expr::Variable(variable.clone())),
            _ if self.dice.percent(15) => None,
            _ => Some(Expr::Literal(Value::Int(self.dice.below(ARGUMENTS) as i64))),
        };
        FactExpr { predicate: format!("p{}", self.dice.below(PREDICATES)), arguments: vec![argument] }
    }

    fn effect(&mut self, visible: &Visible, own_outputs: bool) -> EffectExpr {
        let mut fact = self.fact(visible);
        if self.dice.percent(15) {
            return EffectExpr::Delete(fact);
        }
        if fact.arguments[0].is_none() {
            fact.arguments[0] = Some(Expr::Literal(Value::Int(0)));
        }
        if self.dice.percent(15) {
            return EffectExpr::Increase(fact, Expr::Literal(Value::Int(1)));
        }
        let value = match self.dice.below(4) {
            0 if own_outputs => Expr::Output("x".to_owned()),
            1 if own_outputs && !visible.ports.is_empty() => {
                let state = visible.ports[self.dice.below(visible.ports.len() as u64) as usize];
                Expr::Port { state, port: "x".to_owned() }
            }
            2 => Expr::Fact(self.fact(&Visible::default())),
            _ => Expr::Literal(Value::Int(self.dice.below(3) as i64)),
        };
        EffectExpr::Set(fact, value)
    }

    fn predicate(&mut self, visible: &Visible) -> Expr {
        let what = match visible.ports.last() {
            Some(state) if self.dice.percent(60) => Expr::Port { state: *state, port: "x".to_owned() },
            _ => Expr::Fact(self.fact(visible)),
        };
        let limit = Expr::Literal(Value::Int(self.dice.below(3) as i64));
        Expr::Binary(BinaryOperator::Equal, Box::new(what), Box::new(limit))
    }
}

fn resource(operation: ResourceOperation, kind: &str, count: u32) -> ResourceExpr {
    ResourceExpr { operation, kind: kind.to_owned(), class: None, attributes: Vec::new(), count, unordered: false }
}

fn task_resource(operation: ResourceOperation) -> ResourceExpr {
    ResourceExpr { class: Some(ResourceClass::Task), ..resource(operation, "Part", 1) }
}

/// What nodes of random programs do.
pub struct HashOracle<'a> {
    /// The program.
    pub program: &'a Program,
    /// What all hashes are derived from.
    pub seed: u64,
    /// How many of a hundred visits end `aborted`.
    pub failures_percent: u64,
    /// How many of a hundred attempts of computing and sensing nodes kill their worker.
    pub crashes_percent: u64,
}

impl Oracle for HashOracle<'_> {
    fn perform(&mut self, path: &str, attempt: u32, goal: &Goal, world: &World) -> Performance {
        let mut hash = Hash(self.seed);
        hash.add(path);
        let mut timing = Dice(hash.0 ^ u64::from(attempt));
        let duration_s = 0.5 + timing.below(40) as f64 / 10.0;
        let computes = self.state(path).is_some_and(|s| s.annotations.nature != Nature::Irreversible);
        if computes && attempt < 3 && timing.percent(self.crashes_percent) {
            return Performance { duration_s, answer: Answer::Crashed };
        }
        for (port, value) in &goal.inputs {
            hash.add(port);
            hash.add(&value.to_string());
        }
        for (fact, value) in self.seen(path, goal, world) {
            hash.add(&fact);
            hash.add(&value);
        }
        let mut dice = Dice(hash.0);
        let fails = dice.percent(self.failures_percent);
        let x = dice.below(3) as i64;
        let list = (0..dice.below(4)).map(|_| Value::Int(dice.below(ARGUMENTS) as i64)).collect();
        let outputs = BTreeMap::from([("x".to_owned(), Value::Int(x)), ("list".to_owned(), Value::List(list))]);
        let outcome = if fails { ABORTED } else { SUCCESS };
        Performance {
            duration_s,
            answer: Answer::Finished { outcome: outcome.to_owned(), outputs, measured: Vec::new() },
        }
    }
}

impl HashOracle<'_> {
    fn state(&self, path: &str) -> Option<&State> {
        let mut plain = String::new();
        let mut inside = false;
        for c in path.chars() {
            match c {
                '[' => inside = true,
                ']' => inside = false,
                c if !inside => plain.push(c),
                _ => {}
            }
        }
        self.program.states.iter().find(|s| s.path == plain)
    }

    /// The facts that the node declares to read or sense, as the world it was given shows them.
    fn seen(&self, path: &str, goal: &Goal, world: &World) -> Vec<(String, String)> {
        let Some(state) = self.state(path) else { return Vec::new() };
        let scope = InputScope { program: self.program, state, goal };
        let mut declared: Vec<FactExpr> = match (&state.annotations.nature, &state.annotations.reads) {
            (Nature::Senses(facts), _) => facts.clone(),
            (_, Some(reads)) => reads.clone(),
            (_, None) => {
                return world.iter().map(|(k, f)| (k.to_string(), f.value.to_string())).collect();
            }
        };
        declared.extend(state.annotations.reads.iter().flatten().cloned());
        let Footprint::Patterns(patterns) = FactExpr::footprint(&declared, &scope) else { return Vec::new() };
        let seen = |pattern: &FactPattern| -> Vec<(String, String)> {
            world.matching(pattern).map(|(k, f)| (k.to_string(), f.value.to_string())).collect()
        };
        patterns.iter().flat_map(seen).collect()
    }
}

/// The loop variables of a node, which random programs always pass as inputs.
struct InputScope<'a> {
    program: &'a Program,
    state: &'a State,
    goal: &'a Goal,
}

impl Scope for InputScope<'_> {
    fn variable(&self, name: &str) -> Option<Cow<'_, Value>> {
        let StateKind::Action { inputs, .. } = &self.program.state(self.state.id).kind else { return None };
        let port = inputs.iter().find(|(_, e)| *e == Expr::Variable(name.to_owned())).map(|(port, _)| port)?;
        self.goal.inputs.get(port).map(Cow::Borrowed)
    }

    fn output(&self, _: &str) -> Option<Cow<'_, Value>> {
        None
    }

    fn port(&self, _: StateId, _: &str) -> Option<Cow<'_, Value>> {
        None
    }

    fn fact(&self, _: &FactPattern) -> Lookup<'_> {
        Lookup::Unknown
    }
}

/// FNV-1a.
struct Hash(u64);

impl Hash {
    fn add(&mut self, text: &str) {
        for byte in text.bytes().chain([0xff]) {
            self.0 = (self.0 ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }
}
