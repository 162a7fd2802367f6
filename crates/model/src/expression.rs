//! The one expression grammar: ports, facts, preconditions, effects and selectors are all written in it.
//!
//! This file is the syntax tree. Names are resolved when a program is loaded, so a tree can be evaluated anywhere
//! given a [`scope::Scope`]; evaluation is pure.
//!
//! - [`scope`]: where names get their values
//! - [`evaluate`]: expression → value; [`function`] holds the built-ins
//! - [`comprehension`]: `filter`, `map`, `sort_by` and others, which evaluate an expression for every element of a list
//! - [`bind`]: evaluates the arguments of facts, effects and resources; finds the facts that an effect may write
//! - [`parse`]: text → expression
//! - [`query`]: conditions over facts, with variables
//! - [`walk`]: the names that an expression mentions
//! - [`display`]: expression → text, for messages

pub mod bind;
pub mod comprehension;
pub mod display;
pub mod evaluate;
pub mod function;
pub mod parse;
pub mod query;
pub mod scope;
mod token;
pub mod walk;

pub use comprehension::Comprehension;
pub use evaluate::{EvaluateError, MAX_LIST};
pub use scope::{Given, Lookup, Scope};

use crate::id::StateId;
use crate::value::Value;
use serde::{Deserialize, Serialize};

/// An expression with its names resolved.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Expr {
    /// A constant. A bare word is a string: the name of an individual.
    Literal(Value),
    /// `$name`: a loop variable or a task parameter.
    Variable(String),
    /// A bare word that names an output of the state itself (only in its effects).
    Output(String),
    /// `state.port`: an output of another state, of its latest visit before this place in program order.
    Port {
        /// The state that writes the output.
        state: StateId,
        /// Its output port.
        port: String,
    },
    /// `value.field`
    Field(Box<Expr>, String),
    /// `list[index]`
    Index(Box<Expr>, Box<Expr>),
    /// `[a, b]`
    List(Vec<Expr>),
    /// A YAML mapping of expressions.
    Map(Vec<(String, Expr)>),
    /// A built-in pure function.
    Call(Function, Vec<Expr>),
    /// `filter($x in list, …)`: a comprehension over every element of a list.
    Each {
        /// What the comprehension returns.
        what: Comprehension,
        /// The name of the element in the body, without `$`.
        element: String,
        /// The list.
        list: Box<Expr>,
        /// The expression that is evaluated for every element.
        body: Box<Expr>,
    },
    /// `$name` in the body of a comprehension: the element.
    Element(String),
    /// `predicate(a, ?)`: the value of the first fact that matches, in the order of keys; null when none does.
    Fact(FactExpr),
    /// `exists predicate(a, ?)`: whether a fact matches.
    Exists(FactExpr),
    /// `exists (condition, …)`: whether the query has an answer.
    Query(Vec<Expr>),
    /// `find(?name, …, condition, …)`: the values of the variables in all answers to the query, sorted and without duplicates; with several
    /// variables records with a field for each.
    Find(Vec<String>, Vec<Expr>),
    /// `?name`: a variable of the query around it.
    Unknown(String),
    /// `not a`, `-a`
    Unary(UnaryOperator, Box<Expr>),
    /// `a + b`, `a and b`, `a = b`, `a in b`, …
    Binary(BinaryOperator, Box<Expr>, Box<Expr>),
}

/// `predicate(argument, …)` with expressions as arguments.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FactExpr {
    /// The predicate.
    pub predicate: String,
    /// `None` is `?`.
    pub arguments: Vec<Option<Expr>>,
}

/// An effect as written: bound to [`crate::fact::Change`]s once its arguments are known.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EffectExpr {
    /// `set p(a) = v`; without `= v` the value is true.
    Set(FactExpr, Expr),
    /// `delete p(a, ?)`
    Delete(FactExpr),
    /// `increase p(a) by v`; a decrease is an increase by the negative.
    Increase(FactExpr, Expr),
    /// The effects once per element of a list.
    ForEach {
        /// The variable bound to the element.
        variable: String,
        /// The list.
        collection: Expr,
        /// The effects for every element.
        effects: Vec<EffectExpr>,
    },
}

/// The built-in functions. All are pure.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Function {
    /// `len(list | map | string)` → int
    Len,
    /// `range(n)` or `range(from, to)` → list of ints, the end excluded
    Range,
    /// `min(a, b, …)`
    Min,
    /// `max(a, b, …)`
    Max,
    /// `abs(x)`
    Abs,
    /// `sqrt(x)`
    Sqrt,
    /// `floor(x)` → the greatest int that is not greater than x
    Floor,
    /// `sum(list)` of numbers; 0 for an empty list
    Sum,
    /// `if(condition, a, b)`; only the chosen branch is evaluated
    If,
    /// `either(a, b, …)`: the first argument whose outputs have been written on the way to this place, or have defaults; else the last. Only
    /// this argument is evaluated.
    Either,
    /// `pose(x, y, z)` or `pose(x, y, z, roll, pitch, yaw)`: metres, radians
    Pose,
    /// `joints(a, b, …)`: radians
    Joints,
    /// `compose(a, b)`: pose b as seen from pose a, in a's reference frame
    Compose,
    /// `inverse(a)` of a pose
    Inverse,
    /// `between(a, b)`: b as seen from a, both in one reference frame
    Between,
    /// `distance(a, b)` between two positions, metres
    Distance,
    /// `angle(a, b)` by which two orientations differ, radians, 0 to π
    Angle,
    /// `grasp_pose({pose, size})` → list of poses of the gripper's tool frame that grasp the box from above, with the fingers across its
    /// shorter horizontal side: two, half a turn apart; with `class: Bowl` or `Plate`, the poses around its rim
    GraspPose,
    /// `place_pose(target, in_gripper, turns)` → list of the tool poses that bring a held object to the pose `target`. The object looks the
    /// same after each of `turns` equal turns about its z axis (default: 2)
    PlacePose,
    /// `concat(a, b, …)` of strings, ints
    Concat,
    /// `repeat(value, n)` → list of n times the value
    Repeat,
    /// `take(list, n)` → the first n elements, or all if there are fewer
    Take,
    /// `sort(list)` of numbers or of strings, in increasing order
    Sort,
    /// `reverse(list)`
    Reverse,
    /// `unique(list)` → the elements without duplicates, in order
    Unique,
    /// `starts_with(text, prefix)` → bool
    StartsWith,
}

/// Operators of one operand.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UnaryOperator {
    /// `not`
    Not,
    /// `-`
    Negate,
}

/// Operators of two operands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BinaryOperator {
    /// `or`
    Or,
    /// `and`
    And,
    /// `=`
    Equal,
    /// `!=`
    NotEqual,
    /// `<`
    Less,
    /// `<=`
    LessOrEqual,
    /// `>`
    Greater,
    /// `>=`
    GreaterOrEqual,
    /// `in`
    In,
    /// `+`
    Add,
    /// `-`
    Subtract,
    /// `*`
    Multiply,
    /// `/`
    Divide,
}
