//! A task program: the tree of states as loaded and checked, with every name resolved.
//!
//! The tree is what both modes execute: the sequential interpreter walks it, the window expands it. Loops and conditions
//! are nodes of the tree; instances (visits) exist only while a task runs, in `ratn-executive`.

use crate::expression::{EffectExpr, Expr, FactExpr};
use crate::id::StateId;
use crate::resource::{ResourceClass, ResourceOperation};
use crate::value::{Type, Value};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The outcome of a state that did what it should.
pub const SUCCESS: &str = "success";
/// The outcome of a state that failed.
pub const ABORTED: &str = "aborted";
/// The outcome of a state that was told to stop.
pub const PREEMPTED: &str = "preempted";

/// A loaded task program.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Program {
    /// The task's name.
    pub name: String,
    /// At most this many instances are expanded on one logical branch.
    pub horizon: usize,
    /// What `--set` may give.
    pub parameters: Vec<Parameter>,
    /// What the task returns when it ends with success.
    pub outputs: Vec<TaskOutput>,
    /// The facts that hold at the start, over what the world pool already holds; arguments may use parameters.
    pub initial: Vec<EffectExpr>,
    /// Every state; a [`StateId`] is an index. State 0 is the root, a [`StateKind::Sequence`].
    pub states: Vec<State>,
    /// Hash of the task file's text, hexadecimal.
    pub digest: String,
}

/// A parameter of a task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Parameter {
    /// Used as `$name`.
    pub name: String,
    /// What it accepts.
    pub ty: Type,
    /// What it is when not given; `None` makes it required.
    pub default: Option<Value>,
}

/// A typed output of a task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TaskOutput {
    /// Its name.
    pub name: String,
    /// Its type.
    pub ty: Type,
    /// Evaluated in the root's scope when the task has ended with success.
    pub value: Expr,
}

/// A state of the hierarchical state machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct State {
    /// Its index.
    pub id: StateId,
    /// Unique among its siblings.
    pub name: String,
    /// Names from below the root, joined by `/`.
    pub path: String,
    /// The state that contains it; `None` for the root.
    pub parent: Option<StateId>,
    /// What it is.
    pub kind: StateKind,
    /// What it depends on and changes.
    pub annotations: Annotations,
    /// Where it stands in the task file.
    pub location: Location,
}

/// The kinds of states.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StateKind {
    /// An execution state: one goal for one provider.
    Action {
        /// The provider of the catalogue.
        provider: String,
        /// Its action.
        action: String,
        /// Input ports and what flows into them.
        inputs: Vec<(String, Expr)>,
        /// Output ports with their types.
        outputs: BTreeMap<String, Type>,
    },
    /// A hierarchy: its children succeed each other; an outcome that is not success leaves it by the same name.
    Sequence {
        /// In program order.
        children: Vec<StateId>,
        /// Output ports, evaluated in the scope of the children when the last has ended.
        outputs: Vec<TaskOutput>,
    },
    /// The body once per element of a list that is known only at run time.
    ForEach {
        /// The variable bound to the element.
        variable: String,
        /// The variable bound to the index (from 0), if wanted.
        index: Option<String>,
        /// The list.
        collection: Expr,
        /// The body, in program order.
        body: Vec<StateId>,
    },
    /// One of two branches.
    Condition {
        /// A boolean.
        predicate: Expr,
        /// When true; may be empty.
        then: Vec<StateId>,
        /// When false; may be empty.
        otherwise: Vec<StateId>,
    },
}

/// What a state depends on and changes. The default is a PIA that reads and writes everything.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Annotations {
    /// What it does to the environment.
    pub nature: Nature,
    /// The facts it reads; `None` is everything. Facts named in its inputs are included by the loader.
    pub reads: Option<Vec<FactExpr>>,
    /// Booleans that must hold in the actual world when it starts.
    pub requires: Vec<Expr>,
    /// Per outcome what it changes. No entry for an outcome: it may write everything.
    pub effects: BTreeMap<String, Vec<EffectExpr>>,
    /// What it asks of the resource manager.
    pub resources: Vec<ResourceExpr>,
    /// It and what it contains are executed as one node, by the sequential interpreter.
    pub routine: bool,
    /// Estimated duration in seconds of the robot's time.
    pub duration_s: Option<Expr>,
    /// How often a computing or sensing node is tried when its worker dies; `None` is the executive's default.
    pub attempts: Option<u32>,
}

/// What a state does to the environment.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Nature {
    /// A potentially irreversible action.
    #[default]
    Irreversible,
    /// Works on a projection; may be speculated, repeated, discarded.
    Computes,
    /// Looks at the environment, which must show these facts as they are at its place in the program.
    Senses(Vec<FactExpr>),
}

/// One line of `resources`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ResourceExpr {
    /// What is done with it.
    pub operation: ResourceOperation,
    /// The kind, `PathPlanner`. The bare word `world_model` is written as a block of kind `WorldModel`.
    pub kind: String,
    /// The class, where the task says it.
    pub class: Option<ResourceClass>,
    /// Attributes that it must have (for create: that it gets).
    pub attributes: Vec<(String, Expr)>,
    /// How many, or how much.
    pub count: u32,
}

/// The resource kind that stands for room for a projection.
pub const WORLD_MODEL: &str = "WorldModel";

/// A place in a task file, both from 1; 0:0 when unknown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
pub struct Location {
    /// Line.
    pub line: u32,
    /// Column.
    pub column: u32,
}

impl Program {
    /// The root state.
    pub const ROOT: StateId = StateId(0);

    /// The state of an id.
    pub fn state(&self, id: StateId) -> &State {
        &self.states[id.0 as usize]
    }
}
