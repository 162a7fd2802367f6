//! The places of expressions in a state, with one walk over all of them. Code that needs a state's expressions calls this walk
//! and selects by [`Slot`]; no other code takes a state apart.
//!
//! The walk visits whole expressions, in the order of [`Slot`]'s variants; their parts are visited by [`Expr::visit`].

use crate::expression::{EffectExpr, Expr, FactExpr};
use crate::program::{Annotations, Nature, Program, State, StateKind};
use crate::resource::ResourceOperation;
use std::fmt;

/// The place of an expression in its state. It is displayed as the name of that part of the task file: `in.goal`, `requires.0`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Slot<'a> {
    /// An input port of an action.
    Input(&'a str),
    /// The list of a loop.
    Collection,
    /// The predicate of a loop.
    While,
    /// The predicate of a condition.
    Condition,
    /// The decider's boolean for this outcome of a concurrency.
    Decide(&'a str),
    /// An output port of a composite state; of the root, an output of the task.
    Output(&'a str),
    /// The initial value of a scoped variable.
    Variable(&'a str),
    /// The value assigned to a variable at the end.
    Assign(&'a str),
    /// A precondition, by its number.
    Requires(usize),
    /// A `while` condition, by its number.
    Holds(usize),
    /// The estimated duration.
    Duration,
    /// An argument of a fact in `reads`.
    Reads,
    /// An argument of a fact in `senses`.
    Senses,
    /// An argument of a fact in `shared`.
    Shared,
    /// In an effect of this outcome: an argument of a fact, a value, or the list of a quantifier.
    Effect(&'a str),
    /// An attribute or a condition of a resource: the number of its line, and the operation.
    Resource(usize, ResourceOperation),
}

impl fmt::Display for Slot<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Slot::Input(port) => write!(f, "in.{port}"),
            Slot::Collection => f.write_str("for"),
            Slot::While => f.write_str("while"),
            Slot::Condition => f.write_str("condition"),
            Slot::Decide(outcome) => write!(f, "decide.{outcome}"),
            Slot::Output(name) => write!(f, "outputs.{name}"),
            Slot::Variable(name) => write!(f, "variables.{name}"),
            Slot::Assign(name) => write!(f, "assign.{name}"),
            Slot::Requires(number) => write!(f, "requires.{number}"),
            Slot::Holds(number) => write!(f, "while.{number}"),
            Slot::Duration => f.write_str("duration"),
            Slot::Reads => f.write_str("reads"),
            Slot::Senses => f.write_str("senses"),
            Slot::Shared => f.write_str("shared"),
            Slot::Effect(outcome) => write!(f, "effects.{outcome}"),
            Slot::Resource(line, _) => write!(f, "resources.{line}"),
        }
    }
}

/// The walk, written once for shared and for exclusive references.
macro_rules! walk {
    ($state:expr, $visit:expr $(, $mut:tt)?) => {{
        match &$($mut)? $state.kind {
            StateKind::Action { inputs, .. } => {
                for (port, value) in inputs {
                    $visit(Slot::Input(port), value);
                }
            }
            StateKind::ForEach { collection, .. } => $visit(Slot::Collection, collection),
            StateKind::While { predicate, .. } => $visit(Slot::While, predicate),
            StateKind::Condition { predicate, .. } => $visit(Slot::Condition, predicate),
            StateKind::Sequence { .. } => {}
            StateKind::Concurrency { decide, .. } => {
                for (outcome, holds) in decide {
                    $visit(Slot::Decide(outcome), holds);
                }
            }
        }
        match &$($mut)? $state.kind {
            StateKind::Action { .. } => {}
            StateKind::Sequence { outputs, .. }
            | StateKind::ForEach { outputs, .. }
            | StateKind::While { outputs, .. }
            | StateKind::Condition { outputs, .. }
            | StateKind::Concurrency { outputs, .. } => {
                for output in outputs {
                    $visit(Slot::Output(&output.name), &$($mut)? output.value);
                }
            }
        }
        for (name, value) in &$($mut)? $state.variables {
            $visit(Slot::Variable(name), value);
        }
        for (name, value) in &$($mut)? $state.assign {
            $visit(Slot::Assign(name), value);
        }
        let annotations = &$($mut)? $state.annotations;
        for (number, required) in (&$($mut)? annotations.requires).into_iter().enumerate() {
            $visit(Slot::Requires(number), required);
        }
        for (number, holds) in (&$($mut)? annotations.holds).into_iter().enumerate() {
            $visit(Slot::Holds(number), holds);
        }
        if let Some(duration) = &$($mut)? annotations.duration_s {
            $visit(Slot::Duration, duration);
        }
        if let Some(facts) = &$($mut)? annotations.reads {
            for argument in facts.into_iter().flat_map(|fact| &$($mut)? fact.arguments).flatten() {
                $visit(Slot::Reads, argument);
            }
        }
        if let Nature::Senses(facts) = &$($mut)? annotations.nature {
            for argument in facts.into_iter().flat_map(|fact| &$($mut)? fact.arguments).flatten() {
                $visit(Slot::Senses, argument);
            }
        }
        for argument in (&$($mut)? annotations.shared).into_iter().flat_map(|fact| &$($mut)? fact.arguments).flatten() {
            $visit(Slot::Shared, argument);
        }
        for (outcome, effects) in &$($mut)? annotations.effects {
            for effect in effects {
                in_effect!(effect, &mut |part| $visit(Slot::Effect(outcome), part) $(, $mut)?);
            }
        }
        for (line, resource) in (&$($mut)? annotations.resources).into_iter().enumerate() {
            let slot = Slot::Resource(line, resource.operation);
            for (_, value) in &$($mut)? resource.attributes {
                $visit(slot, value);
            }
            for condition in &$($mut)? resource.conditions {
                $visit(slot, &$($mut)? condition.value);
            }
        }
    }};
}

macro_rules! in_effect {
    ($effect:expr, $visit:expr) => {
        $effect.each_expression($visit)
    };
    ($effect:expr, $visit:expr, mut) => {
        $effect.each_expression_mut($visit)
    };
}

macro_rules! walk_effect {
    ($effect:expr, $visit:expr $(, $mut:tt)?) => {
        match $effect {
            EffectExpr::Set(fact, value) | EffectExpr::Increase(fact, value) => {
                for argument in (&$($mut)? fact.arguments).into_iter().flatten() {
                    $visit(argument);
                }
                $visit(value);
            }
            EffectExpr::Delete(fact) => {
                for argument in (&$($mut)? fact.arguments).into_iter().flatten() {
                    $visit(argument);
                }
            }
            EffectExpr::ForEach { collection, effects, .. } => {
                $visit(collection);
                for effect in effects {
                    in_effect!(effect, $visit $(, $mut)?);
                }
            }
        }
    };
}

impl Program {
    /// Every expression of a state with its place; for the root including the outputs of the task.
    pub fn expressions<'a>(&'a self, state: &'a State) -> Vec<(Slot<'a>, &'a Expr)> {
        let mut all = state.expressions();
        if state.id == Program::ROOT {
            all.extend(self.outputs.iter().map(|output| (Slot::Output(&output.name), &output.value)));
        }
        all
    }
}

impl State {
    /// Every expression of the state with its place.
    pub fn expressions(&self) -> Vec<(Slot<'_>, &Expr)> {
        let mut all = Vec::new();
        self.each_expression(&mut |slot, expression| all.push((slot, expression)));
        all
    }

    /// Calls `visit` for every expression of the state.
    pub fn each_expression<'a>(&'a self, visit: &mut dyn FnMut(Slot<'a>, &'a Expr)) {
        walk!(self, visit);
    }

    /// Calls `visit` for every expression of the state, to change it.
    pub fn each_expression_mut(&mut self, visit: &mut dyn FnMut(Slot<'_>, &mut Expr)) {
        walk!(self, visit, mut);
    }
}

impl EffectExpr {
    /// Calls `visit` for every expression that the effect is made of.
    pub fn each_expression<'a>(&'a self, visit: &mut dyn FnMut(&'a Expr)) {
        walk_effect!(self, visit);
    }

    /// Calls `visit` for every expression that the effect is made of, to change it.
    pub fn each_expression_mut(&mut self, visit: &mut dyn FnMut(&mut Expr)) {
        walk_effect!(self, visit, mut);
    }

    /// The facts that the effect writes, including those of a quantifier.
    pub fn written(&self) -> Vec<&FactExpr> {
        match self {
            EffectExpr::Set(fact, _) | EffectExpr::Delete(fact) | EffectExpr::Increase(fact, _) => vec![fact],
            EffectExpr::ForEach { effects, .. } => effects.iter().flat_map(EffectExpr::written).collect(),
        }
    }

    /// The facts that the effect sets or increases, without those that it deletes.
    pub(crate) fn made(&self) -> Vec<&FactExpr> {
        match self {
            EffectExpr::Set(fact, _) | EffectExpr::Increase(fact, _) => vec![fact],
            EffectExpr::Delete(_) => Vec::new(),
            EffectExpr::ForEach { effects, .. } => effects.iter().flat_map(EffectExpr::made).collect(),
        }
    }
}

impl Annotations {
    /// The facts that the state senses; none if it does not sense.
    pub fn senses(&self) -> &[FactExpr] {
        match &self.nature {
            Nature::Senses(facts) => facts,
            Nature::Irreversible | Nature::Computes => &[],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::id::StateId;
    use crate::program::{Location, ResourceExpr, TaskOutput};
    use crate::value::{Type, Value};

    fn number(value: i64) -> Expr {
        Expr::Literal(Value::Int(value))
    }

    fn fact(argument: i64) -> FactExpr {
        FactExpr { predicate: "p".to_owned(), arguments: vec![None, Some(number(argument))] }
    }

    fn state() -> State {
        let mut annotations = Annotations {
            requires: vec![number(5)],
            holds: vec![number(17)],
            duration_s: Some(number(6)),
            reads: Some(vec![fact(7)]),
            nature: Nature::Senses(vec![fact(8)]),
            shared: vec![fact(9)],
            ..Annotations::default()
        };
        let inner = vec![EffectExpr::Set(fact(11), number(12)), EffectExpr::Delete(fact(13))];
        let each = EffectExpr::ForEach { variable: "x".to_owned(), collection: number(10), effects: inner };
        annotations.effects.insert("success".to_owned(), vec![each, EffectExpr::Increase(fact(14), number(15))]);
        let mut resource = ResourceExpr::new(ResourceOperation::Block, "Arm");
        resource.attributes.push(("side".to_owned(), number(16)));
        annotations.resources.push(resource);
        let outputs = vec![TaskOutput { name: "out".to_owned(), ty: Type::Any, value: number(2) }];
        let decide = vec![("failed".to_owned(), number(1))];
        State {
            id: StateId(1),
            name: "both".to_owned(),
            path: "both".to_owned(),
            parent: Some(Program::ROOT),
            kind: StateKind::Concurrency { regions: Vec::new(), preemptive: false, successes: None, decide, outputs },
            outcomes: Vec::new(),
            transitions: Default::default(),
            variables: vec![("v".to_owned(), number(3))],
            assign: vec![("w".to_owned(), number(4))],
            defaults: Default::default(),
            annotations,
            location: Location::default(),
        }
    }

    #[test]
    fn every_expression_is_visited_once_with_its_place() {
        let state = state();
        let all: Vec<String> = state.expressions().iter().map(|(slot, value)| format!("{slot}={value}")).collect();
        let expected = "decide.failed=1 outputs.out=2 variables.v=3 assign.w=4 requires.0=5 while.0=17 duration=6 reads=7 senses=8 shared=9 \
                        effects.success=10 effects.success=11 effects.success=12 effects.success=13 effects.success=14 \
                        effects.success=15 resources.0=16";
        assert_eq!(all.join(" "), expected);
    }

    #[test]
    fn the_walk_that_changes_visits_the_same() {
        let mut state = state();
        let mut slots = Vec::new();
        state.each_expression_mut(&mut |slot, value| {
            slots.push(slot.to_string());
            *value = number(0);
        });
        let changed = state.expressions();
        assert_eq!(slots, changed.iter().map(|(slot, _)| slot.to_string()).collect::<Vec<_>>());
        assert!(changed.iter().all(|(_, value)| **value == number(0)));
    }
}
