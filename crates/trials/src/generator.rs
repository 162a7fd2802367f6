//! The random program of a seed: its states and transitions.
//!
//! Every program ends: only the outcome [`AGAIN`] leads back, only the oracle gives it, and never on a third visit; and every `while` counts. Regions of a
//! barrier write facts, block actuators and assign variables that no other region uses. A preemptive concurrency is not inside of a barrier and contains only a
//! few actions, which cannot fail before they start, so that the oracle can keep the ends of its regions further apart than any other delay.
//!
//! | | |
//! |---|---|
//! | the tree | `list`, `composite`, `regions`, `action`, `guards`, `waits`, `watched`, `ways_out`, `outputs`, `long`, `patterns` |
//! | annotations of a state | `annotations`, `variables`, `supplies`, `estimates` |
//! | facts | `facts`, `effects`, `tolerance` |
//!
//! It does not make: timeouts of states beside others or with a race inside; waits in races and beside imprecise motions; conditions of waits with keys that
//! are not constants (scenarios of the simulation have them); hierarchies and concurrencies with tolerated facts or port keys in their effects; numbers within
//! a tolerance that add up, or that are looked up by anything that compares exactly; individuals of classes (ontologies declare numbers and things); values
//! that are poses, joint positions or trajectories; selectors of task resources; task resources and batteries that run out; consumption inside of routines;
//! facts in `duration`; preemptive concurrencies within others, in routines, or with anything that may fail to begin; transitions into the middle of a state;
//! libraries of files (the result of loading one is made directly). Annotations in a catalogue are made from its programs by [`crate::inherited()`].

use super::{
    AGAIN, ARGUMENTS, Dice, EMPTY, FOUND, Features, PART, PREDICATES, TOOL, anytime, around, finds, is_in_routine,
    is_preemptive, lists,
};
use annotations::{block, resource, task_resource};
use ratn_model::expression::{BinaryOperator, EffectExpr, Expr, FactExpr, Function, UnaryOperator};
use ratn_model::guard::Guard;
use ratn_model::id::StateId;
use ratn_model::program::{
    ABORTED, Annotations, Exceptions, Location, PREEMPTED, Program, SUCCESS, State, StateKind, Target, TaskOutput,
};
use ratn_model::resource::ResourceOperation;
use ratn_model::value::{Type, Value};
use std::collections::BTreeMap;

mod action;
mod annotations;
mod composite;
mod effects;
mod estimates;
pub(super) mod facts;
mod guards;
mod list;
mod long;
mod outputs;
mod patterns;
mod regions;
mod supplies;
pub(super) mod tolerance;
mod variables;
mod waits;
mod watched;
mod ways_out;

/// Approximate limit of the states of a program.
const MAX_STATES: usize = 26;

/// The random program of a seed.
pub fn program(seed: u64, features: &Features) -> Program {
    let (states, guards) = Default::default();
    let mut maker = Maker { dice: Dice(seed), states, guards, features: *features };
    maker.push("root".to_owned(), String::new(), None);
    let known = facts::predicates(features);
    let room = Room {
        readable: if features.blind { Vec::new() } else { known.clone() },
        writable: known.clone(),
        tolerant: features.tolerance,
        actuators: vec!["Arm", "Head", "Base"],
        is_alone: true,
        is_preemptive: false,
    };
    let mut visible = Visible::default();
    let parameters = maker.parameters(&mut visible);
    let variables = maker.variables(Program::ROOT, &room, &mut visible);
    let (children, inner, outcomes) = match maker.long(&room, &visible) {
        Some(list) => list,
        None => maker.list(Program::ROOT, "", 0, &room, visible, false),
    };
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
        parameters,
        outputs,
        initial: (0..PREDICATES)
            .map(|p| EffectExpr::Set(fact_at(p, 0), Expr::Literal(Value::Int(p as i64 % 4))))
            .chain(facts::initial(features))
            .collect(),
        tolerances: Default::default(),
        ontology: None,
        kinds: Default::default(),
        states: maker.states,
        digest: String::new(),
    };
    if features.outputs {
        outputs::add(&mut program, &mut maker.guards, &mut Dice(seed ^ 0x0000_0074_b075));
        outputs::of_the_iteration_before(&mut program, &mut Dice(seed ^ 0x0000_5e1f_0b5e));
    }
    if features.watched {
        watched::watch(&mut program, &mut maker.guards, &mut Dice(seed ^ 0x0000_3a7c_11ed));
    }
    if features.ways_out {
        ways_out::add(&mut program, &mut maker.guards, &mut Dice(seed ^ 0x0000_0f1a_a119));
    }
    if !maker.guards.is_empty() {
        let unfolded = ratn_model::guard::unfold(&mut program, &maker.guards);
        assert!(unfolded.is_ok(), "a random program is small");
    }
    if features.tolerance {
        tolerance::declare(&mut program, &mut maker.dice);
    }
    if features.blind {
        make_blind(&mut program);
    }
    create_in_routines(&mut program);
    supplies::one_tool_per_routine(&mut program);
    let regions = program.states.iter().filter(|state| is_preemptive(state));
    let around: Vec<StateId> = regions.flat_map(|state| around(&program, state)).map(|state| state.id).collect();
    for id in around {
        // A block holds for every state inside, and regions of a race must not wait for each other's workers.
        program.states[id.0 as usize].annotations.resources.retain(|r| r.operation != ResourceOperation::Block);
    }
    if features.finds {
        finds::say_with_find(&mut program, &mut Dice(seed ^ 0x0000_f19d_5a1d));
    }
    if features.anytime {
        anytime::improve(&mut program, &mut Dice(seed ^ 0x0000_be77_e200));
    }
    if features.lists {
        lists::say_with_comprehensions(&mut program, &mut maker.dice);
    }
    program
}

/// Removes consumption from routines: a routine acquires at its entry what any inner state consumes, even if that state is never reached, so it would differ
/// from its states one by one.
fn create_in_routines(program: &mut Program) {
    let inside: Vec<StateId> =
        program.states.iter().filter(|state| is_in_routine(program, state)).map(|state| state.id).collect();
    for id in inside {
        for resource in &mut program.states[id.0 as usize].annotations.resources {
            if resource.operation == ResourceOperation::Consume && resource.kind == PART {
                resource.operation = ResourceOperation::Create;
            }
        }
        program.states[id.0 as usize].annotations.resources.retain(|r| r.operation != ResourceOperation::Consume);
    }
}

/// Makes a program in which nothing reads the world, and no change depends on it.
fn make_blind(program: &mut Program) {
    use ratn_model::program::Nature;
    let looked_up = |part: &mut Expr| match part {
        Expr::Fact(_) => *part = Expr::Literal(Value::Int(0)),
        Expr::Exists(_) | Expr::Query(_) => *part = Expr::Literal(Value::Bool(false)),
        _ => {}
    };
    for state in &mut program.states {
        let is_action = matches!(state.kind, StateKind::Action { .. });
        let a = &mut state.annotations;
        a.requires.clear();
        a.reads = is_action.then(Vec::new);
        if let Nature::Senses(facts) = &mut a.nature {
            facts.clear();
        }
        for effects in a.effects.values_mut() {
            effects.retain(|effect| !matches!(effect, EffectExpr::Increase(..)));
        }
        // Facts are replaced by constants.
        state.each_expression_mut(&mut |_, expression| expression.rewrite(&mut |part| looked_up(part)));
    }
}

pub(super) fn fact_at(predicate: u64, argument: i64) -> FactExpr {
    FactExpr { predicate: format!("p{predicate}"), arguments: vec![Some(Expr::Literal(Value::Int(argument)))] }
}

/// What a list of states may use.
#[derive(Debug, Clone)]
pub(super) struct Room {
    /// Predicates that it may read.
    pub(super) readable: Vec<u64>,
    /// Predicates that it may write.
    pub(super) writable: Vec<u64>,
    /// Whether it may read and write the predicate that is measured within a tolerance.
    pub(super) tolerant: bool,
    /// The actuators that it may block.
    pub(super) actuators: Vec<&'static str>,
    /// Whether nothing runs beside it, so that it may use anything, and task resources.
    pub(super) is_alone: bool,
    /// Whether it is inside of a preemptive concurrency.
    pub(super) is_preemptive: bool,
}

/// The names that a state may use.
#[derive(Debug, Clone, Default)]
pub(super) struct Visible {
    /// States with an output `x`.
    pub(super) ports: Vec<StateId>,
    /// Loop variables and scoped variables: every action gets all of them.
    pub(super) variables: Vec<String>,
    /// Variables that may be assigned.
    pub(super) assignable: Vec<String>,
}

pub(super) struct Maker {
    pub(super) dice: Dice,
    pub(super) states: Vec<State>,
    pub(super) guards: BTreeMap<StateId, Guard>,
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
}
