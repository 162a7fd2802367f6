//! A task program: the tree of states as loaded and checked, with every name resolved.
//!
//! The tree is what both modes execute: the sequential interpreter walks it, the window expands it. Loops and conditions
//! are nodes of the tree; instances (visits) exist only while a task runs, in `ratn-executive`.

use crate::condition::ConditionExpr;
use crate::expression::{EffectExpr, Expr, FactExpr};
use crate::id::StateId;
use crate::ontology::Ontology;
use crate::resource::{Quantity, ResourceClass, ResourceOperation};
use crate::tolerance::Tolerances;
use crate::value::{Type, Value};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// The outcome of a state that succeeded.
pub const SUCCESS: &str = "success";
/// The outcome of a state that failed.
pub const ABORTED: &str = "aborted";
/// The outcome of a state that was cancelled.
pub const PREEMPTED: &str = "preempted";
/// The outcome of a state whose `while` condition did not hold until its end ([`Annotations::holds`]).
pub const VIOLATED: &str = "violated";
/// The outcome of a goal that an emergency stop ended. A state whose action does not have this outcome ends `preempted` instead.
pub const STOPPED: &str = "stopped";

/// Whether this outcome is a failure: the state then has no outputs and assigns nothing.
pub fn is_failure(outcome: &str) -> bool {
    matches!(outcome, ABORTED | PREEMPTED | VIOLATED)
}

/// The provider of states in which the executive itself waits ([`crate::wait`]). No task file can name it.
pub const CLOCK: &str = "(clock)";

/// A loaded task program.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Program {
    /// The task's name.
    pub name: String,
    /// Limit of the instances that are expanded on one logical branch.
    pub horizon: usize,
    /// Limit of the branches of undecided conditions that are expanded, the most likely ones first.
    pub speculation_width: usize,
    /// Deadline in the robot's seconds: the task then ends `aborted`.
    pub deadline_s: Option<f64>,
    /// Default of `exceptions` for states that do not say it.
    pub exceptions: Exceptions,
    /// The parameters that `--set` may give.
    pub parameters: Vec<Parameter>,
    /// What the task returns when it ends with success.
    pub outputs: Vec<TaskOutput>,
    /// The facts that hold at the start, over what the world pool already holds; arguments may use parameters.
    pub initial: Vec<EffectExpr>,
    /// Tolerances for measured values, as far as the task and its ontology give them.
    pub tolerances: Tolerances,
    /// The ontology of its facts; `None` allows all facts.
    pub ontology: Option<Ontology>,
    /// The direct superclasses of kinds of resources ([`crate::catalogue::Catalogue::kinds`]).
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub kinds: BTreeMap<String, Vec<String>>,
    /// Every state; a [`StateId`] is an index. State 0 is the root, a [`StateKind::Sequence`].
    pub states: Vec<State>,
    /// Hash of the texts of the task file, its ontology and its libraries, hexadecimal.
    pub digest: String,
}

/// A parameter of a task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Parameter {
    /// Its name, used as `$name`.
    pub name: String,
    /// Its type.
    pub ty: Type,
    /// Its default value; `None` makes it required.
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
    /// Its kind.
    pub kind: StateKind,
    /// Its outcomes beside `success`, `aborted` and `preempted`.
    pub outcomes: Vec<String>,
    /// Targets of its outcomes; see [`Program::target`] for those that are not listed.
    pub transitions: BTreeMap<String, Target>,
    /// Scoped variables of a sequence or a loop (a library's parameters are its scoped variables). They are bound at entry, each in the scope of
    /// the state itself; the states inside can read and assign them.
    pub variables: Vec<(String, Expr)>,
    /// Assignments to scoped variables when it ends with an outcome that is no failure, evaluated in the same scope as its effects.
    pub assign: Vec<(String, Expr)>,
    /// Default values of its output ports, used while it has not run in this activation of the state around it.
    pub defaults: BTreeMap<String, Value>,
    /// What it depends on and what it changes.
    pub annotations: Annotations,
    /// Its location in the task file.
    pub location: Location,
}

/// The target of an outcome.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Target {
    /// A state of the same list.
    State(StateId),
    /// Leaves the list by this outcome. `success` of a loop's body ends an iteration; any other outcome of a body, a branch or a list of children
    /// becomes the outcome of the state around it.
    Outcome(String),
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
        /// Input ports and their expressions.
        inputs: Vec<(String, Expr)>,
        /// Output ports with their types.
        outputs: BTreeMap<String, Type>,
    },
    /// A hierarchy: begins with its first child and follows the transitions.
    Sequence {
        /// In program order; execution begins with the first. Without children it succeeds at once.
        children: Vec<StateId>,
        /// Output ports, evaluated in the scope of the children when the last has ended.
        outputs: Vec<TaskOutput>,
    },
    /// A loop over a list that is known only at run time.
    ForEach {
        /// The variable bound to the element.
        variable: String,
        /// The variable bound to the index (from 0), if wanted.
        index: Option<String>,
        /// The list.
        collection: Expr,
        /// The body, in program order.
        body: Vec<StateId>,
        /// Output ports, evaluated in the scope of the body when the last iteration has ended.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        outputs: Vec<TaskOutput>,
    },
    /// A loop that repeats while a predicate holds.
    While {
        /// A boolean, evaluated before each iteration.
        predicate: Expr,
        /// Whether the first iteration is not tested: `do … while`.
        body_first: bool,
        /// The variable bound to the number of the iteration (from 0), if wanted.
        index: Option<String>,
        /// The body, in program order.
        body: Vec<StateId>,
        /// Output ports, evaluated in the scope of the body when the last iteration has ended.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        outputs: Vec<TaskOutput>,
    },
    /// Concurrent regions. Each region is a state with its own path, horizon and projections; its outcome is available as its port `outcome`.
    Concurrency {
        /// The regions; their order has no meaning.
        regions: Vec<StateId>,
        /// Whether regions that still run are preempted: when the first region ends, whose outcome becomes the outcome, or as `successes` says. If
        /// false, all regions are waited for.
        preemptive: bool,
        /// With `preemptive`: it ends when this number of regions have succeeded, or can no longer succeed.
        successes: Option<u32>,
        /// The decider: the first outcome whose boolean holds. If none holds: `success` if all regions succeeded, `aborted` if one aborted, else
        /// `preempted`.
        decide: Vec<(String, Expr)>,
        /// Output ports, evaluated in the scope of the regions when all have ended.
        outputs: Vec<TaskOutput>,
    },
    /// One of two branches.
    Condition {
        /// A boolean.
        predicate: Expr,
        /// When true; may be empty.
        then: Vec<StateId>,
        /// When false; may be empty.
        otherwise: Vec<StateId>,
        /// Output ports, evaluated in the scope of both branches when the one that was taken has ended.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        outputs: Vec<TaskOutput>,
    },
}

/// What a state depends on and what it changes. The default is a PIA that reads and writes everything.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Annotations {
    /// Its effect on the environment.
    pub nature: Nature,
    /// The facts it reads; `None` is everything. Facts named in its inputs are included by the loader.
    pub reads: Option<Vec<FactExpr>>,
    /// Preconditions: booleans that must hold in the actual world when it starts.
    pub requires: Vec<Expr>,
    /// `while` conditions: booleans that must hold in the actual world from start to end. If one does not hold, the action is cancelled and ends
    /// [`VIOLATED`]. Only PIAs have them; other states get a watch from [`crate::guard`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub holds: Vec<Expr>,
    /// The effects of each outcome. An outcome without entry may write everything.
    pub effects: BTreeMap<String, Vec<EffectExpr>>,
    /// What it asks of the resource manager.
    pub resources: Vec<ResourceExpr>,
    /// Routine: the sequential interpreter executes it with its parts as one node.
    pub routine: bool,
    /// Estimated duration in seconds of the robot's time.
    pub duration_s: Option<Expr>,
    /// Number of attempts of a computing or sensing node whose worker dies; `None` is the executive's default.
    pub attempts: Option<u32>,
    /// Retries after the outcome `aborted`.
    pub retry: Option<Retry>,
    /// Timeout of its goal in the robot's seconds; then it ends `aborted`.
    pub timeout_s: Option<f64>,
    /// Whether younger PIAs may run beside it; `None`: as the task says.
    pub exceptions: Option<Exceptions>,
    /// Outcomes that are exceptional although they have a transition: what follows them is not computed ahead.
    pub exceptional: Vec<String>,
    /// Whether equal inputs and facts always give the same result, whatever the seed.
    pub deterministic: bool,
    /// Anytime: its action gives a usable result first, and better ones later; any will do.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub anytime: bool,
    /// For a region: facts that other regions may also change. The programmer is responsible for their order.
    pub shared: Vec<FactExpr>,
    /// Where the value of each key comes from; defaults are left out. An implied block of a projection is listed under [`WORLD_MODEL`].
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub origin: BTreeMap<String, Origin>,
    /// For the sequence that a state with `retry` became ([`crate::guard`]).
    pub again: Option<Again>,
    /// For the sequence that a state with `finally` became.
    pub finally: Option<Finally>,
}

/// The origin of an annotation of a state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Origin {
    /// The state itself.
    State,
    /// Its action, in the catalogue.
    Action,
    /// Both: effects are combined.
    Both,
    /// Implied: a state that reads facts ahead of its place needs a projection.
    Reads,
}

/// The result of expanding `retry`. It repeats what the sequence's transitions and variables already express.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Again {
    /// The state that is tried.
    pub body: StateId,
    /// Number of tries after the first.
    pub count: u32,
    /// The outcomes after which it is tried again.
    pub on: Vec<String>,
    /// The state that is executed before each further try.
    pub before: Option<StateId>,
}

/// The result of expanding `finally`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Finally {
    /// The guarded state.
    pub body: StateId,
    /// The copy of the `finally` block for each outcome of the body.
    pub lastly: BTreeMap<String, StateId>,
}

impl Annotations {
    /// Calls `visit` for every state id in `again` and `finally`.
    pub fn each_mark_mut(&mut self, visit: &mut dyn FnMut(&mut StateId)) {
        if let Some(again) = &mut self.again {
            visit(&mut again.body);
            again.before.iter_mut().for_each(&mut *visit);
        }
        if let Some(finally) = &mut self.finally {
            visit(&mut finally.body);
            finally.lastly.values_mut().for_each(visit);
        }
    }
}

/// Retries of an action that ends `aborted`. Only the outcome, outputs and effects of the last try count; each try has its own seed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Retry {
    /// Number of tries after the first.
    pub count: u32,
    /// The pause before the second try, in the robot's seconds; doubled before each further one.
    pub backoff_s: f64,
}

/// Whether younger PIAs may run beside a running PIA.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Exceptions {
    /// They wait for its end: a failure leaves the same world as in the sequential program.
    #[default]
    Precise,
    /// They may run beside it unless something else forbids it; their effects stay even if it fails.
    Imprecise,
}

/// The effect of a state on the environment.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Nature {
    /// A potentially irreversible action.
    #[default]
    Irreversible,
    /// Works on a projection; may be speculated, repeated, discarded.
    Computes,
    /// Senses the environment, which must show these facts as they are at the state's place in the program.
    Senses(Vec<FactExpr>),
}

/// One line of `resources`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ResourceExpr {
    /// The operation.
    pub operation: ResourceOperation,
    /// The kind, `PathPlanner`. The bare word `world_model` is written as a block of kind `WorldModel`.
    pub kind: String,
    /// The class, if the task gives it.
    pub class: Option<ResourceClass>,
    /// Required attributes (for create: the attributes that the new resource gets).
    pub attributes: Vec<(String, Expr)>,
    /// Further conditions on attributes.
    pub conditions: Vec<ConditionExpr>,
    /// The amount; for indivisible resources the number of units.
    pub count: Quantity,
    /// For create: whether the new resource is divisible.
    pub divisible: bool,
    /// For a resource that actuates: whether PIAs that block it may run in any order.
    pub unordered: bool,
}

impl ResourceExpr {
    /// One unit of a kind, with any attributes.
    pub fn new(operation: ResourceOperation, kind: impl Into<String>) -> ResourceExpr {
        let (class, attributes, conditions) = Default::default();
        let (count, divisible, unordered) = (Quantity::ONE, false, false);
        ResourceExpr { operation, kind: kind.into(), class, attributes, conditions, count, divisible, unordered }
    }

    /// The expressions of its attributes and conditions.
    pub fn expressions(&self) -> impl Iterator<Item = &Expr> {
        let conditions = self.conditions.iter().map(|condition| &condition.value);
        self.attributes.iter().map(|(_, value)| value).chain(conditions)
    }

    /// Whether both select the same resources.
    pub fn selects_the_same(&self, other: &ResourceExpr) -> bool {
        self.kind == other.kind && self.attributes == other.attributes && self.conditions == other.conditions
    }
}

/// The resource kind that stands for room for a projection.
pub const WORLD_MODEL: &str = "WorldModel";

/// A place in a task file, line and column counted from 1; 0:0 if unknown.
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

    /// The default number of branches that are expanded.
    pub const DEFAULT_SPECULATION_WIDTH: usize = 8;

    /// The kinds, the given one included, of which a resource may be meant by a line of the given kind or of a related one: those that the
    /// hierarchy connects with it. The first one by name stands for all of them.
    pub fn family<'a>(&'a self, kind: &'a str) -> BTreeSet<&'a str> {
        let mut family = BTreeSet::from([kind]);
        let mut open = vec![kind];
        while let Some(kind) = open.pop() {
            let above = self.kinds.get(kind).into_iter().flatten();
            let below =
                self.kinds.iter().filter(|(_, above)| above.iter().any(|one| one == kind)).map(|(below, _)| below);
            open.extend(above.chain(below).map(String::as_str).filter(|related| family.insert(*related)));
        }
        family
    }

    /// Whether lines of these two kinds may mean the same resource.
    pub fn may_be_one(&self, kind: &str, other: &str) -> bool {
        kind == other || self.family(kind).contains(other)
    }

    /// The state of an id.
    pub fn state(&self, id: StateId) -> &State {
        &self.states[id.0 as usize]
    }

    /// Whether a state was put around the body of a loop that collects values ([`crate::guard::Collected`]). States inside of it count as being
    /// directly inside of the loop: they are visible from there, and their outputs are removed when the loop is entered.
    pub fn is_pass(&self, id: StateId) -> bool {
        let state = self.state(id);
        let collects = |around: &State| around.is_loop() && !around.variables.is_empty();
        matches!(state.kind, StateKind::Sequence { .. }) && state.parent.is_some_and(|id| collects(self.state(id)))
    }

    /// Whether the list of a state is executed once per iteration: it is a loop, or the state around a loop's body ([`Program::is_pass`]).
    pub fn is_iterated(&self, id: StateId) -> bool {
        self.state(id).is_loop() || self.is_pass(id)
    }

    /// The list of a hierarchy or a loop.
    pub fn list_of(&self, id: StateId) -> &[StateId] {
        match &self.state(id).kind {
            StateKind::Sequence { children, .. } => children,
            StateKind::ForEach { body, .. } | StateKind::While { body, .. } => body,
            _ => &[],
        }
    }

    /// The states that a loop executes in each iteration.
    pub fn body_of(&self, id: StateId) -> &[StateId] {
        let (StateKind::ForEach { body, .. } | StateKind::While { body, .. }) = &self.state(id).kind else {
            return &[];
        };
        match body.as_slice() {
            [pass] if self.is_pass(*pass) => self.list_of(*pass),
            body => body,
        }
    }

    /// The target of an outcome. Without a transition, `success` continues with the next sibling and leaves the list by `success` after the last
    /// one; any other outcome leaves the list by its own name. A region always leaves.
    pub fn target(&self, id: StateId, outcome: &str) -> Target {
        let state = self.state(id);
        if let Some(target) = state.transitions.get(outcome) {
            return target.clone();
        }
        if outcome != SUCCESS {
            return Target::Outcome(outcome.to_owned());
        }
        let siblings = state.parent.map_or(&[][..], |parent| self.state(parent).list_of(id));
        let next = siblings.iter().position(|sibling| *sibling == id).and_then(|at| siblings.get(at + 1));
        next.map_or_else(|| Target::Outcome(SUCCESS.to_owned()), |next| Target::State(*next))
    }

    /// Whether states behind this outcome are not computed ahead. This holds for `aborted`, `preempted` and `violated`, unless they have a target
    /// other than that of `success`, and for outcomes marked as exceptional.
    pub fn is_exceptional(&self, id: StateId, outcome: &str) -> bool {
        let state = self.state(id);
        if state.annotations.exceptional.iter().any(|marked| marked == outcome) {
            return true;
        }
        is_failure(outcome) && state.transitions.get(outcome).is_none_or(|target| *target == self.target(id, SUCCESS))
    }

    /// The outcomes of a state, `success` first and the exceptional ones of every state last.
    pub fn outcomes(&self, id: StateId) -> impl Iterator<Item = &str> {
        let custom = self.state(id).outcomes.iter().map(String::as_str);
        std::iter::once(SUCCESS).chain(custom).chain([ABORTED, PREEMPTED])
    }
}

impl Program {
    /// The outcomes of every state: `success`, its own, those by which inner states leave it, `aborted`, `preempted`.
    pub fn all_outcomes(&self) -> Vec<Vec<String>> {
        let mut all: Vec<Vec<String>> = vec![Vec::new(); self.states.len()];
        // Inner states have larger ids than the states around them.
        for state in self.states.iter().rev() {
            let mut own = vec![SUCCESS.to_owned()];
            let add = |own: &mut Vec<String>, name: &str| {
                if !matches!(name, SUCCESS | ABORTED | PREEMPTED) && !own.iter().any(|known| known == name) {
                    own.push(name.to_owned());
                }
            };
            state.outcomes.iter().for_each(|name| add(&mut own, name));
            let decides = match &state.kind {
                StateKind::Concurrency { decide, preemptive, successes, .. } => {
                    decide.iter().for_each(|(name, _)| add(&mut own, name));
                    !preemptive || successes.is_some() || !decide.is_empty()
                }
                _ => false,
            };
            for child in state.children().filter(|_| !decides) {
                for outcome in &all[child.0 as usize] {
                    match self.state(child).transitions.get(outcome.as_str()) {
                        Some(Target::State(_)) => {}
                        Some(Target::Outcome(name)) => add(&mut own, name),
                        None => add(&mut own, outcome),
                    }
                }
            }
            own.extend([ABORTED.to_owned(), PREEMPTED.to_owned()]);
            all[state.id.0 as usize] = own;
        }
        all
    }
}

impl StateKind {
    /// Output ports with expressions; none for an action.
    pub fn outputs(&self) -> &[TaskOutput] {
        match self {
            StateKind::Action { .. } => &[],
            StateKind::Sequence { outputs, .. }
            | StateKind::ForEach { outputs, .. }
            | StateKind::While { outputs, .. }
            | StateKind::Condition { outputs, .. }
            | StateKind::Concurrency { outputs, .. } => outputs,
        }
    }

    /// The same, mutable; `None` for an action.
    pub fn outputs_mut(&mut self) -> Option<&mut Vec<TaskOutput>> {
        match self {
            StateKind::Action { .. } => None,
            StateKind::Sequence { outputs, .. }
            | StateKind::ForEach { outputs, .. }
            | StateKind::While { outputs, .. }
            | StateKind::Condition { outputs, .. }
            | StateKind::Concurrency { outputs, .. } => Some(outputs),
        }
    }
}

impl State {
    /// Whether the executive itself waits in this state; no provider gets a goal.
    pub fn is_pause(&self) -> bool {
        matches!(&self.kind, StateKind::Action { provider, .. } if provider == CLOCK)
    }

    /// Whether a composite state is executed as one node: it is marked as routine, or it is a preemptive concurrency.
    pub fn is_routine(&self) -> bool {
        match self.kind {
            StateKind::Action { .. } => false,
            StateKind::Concurrency { preemptive: true, .. } => true,
            _ => self.annotations.routine,
        }
    }

    /// Output ports with expressions; none for an action.
    pub fn outputs(&self) -> &[TaskOutput] {
        self.kind.outputs()
    }

    /// Whether it is a loop.
    pub fn is_loop(&self) -> bool {
        matches!(self.kind, StateKind::ForEach { .. } | StateKind::While { .. })
    }

    /// The lists of states that it contains: one, or one per branch, or one per region.
    pub fn lists(&self) -> Vec<&[StateId]> {
        match &self.kind {
            StateKind::Action { .. } => Vec::new(),
            StateKind::Sequence { children, .. } => vec![children],
            StateKind::ForEach { body, .. } | StateKind::While { body, .. } => vec![body],
            StateKind::Condition { then, otherwise, .. } => vec![then, otherwise],
            StateKind::Concurrency { regions, .. } => regions.chunks(1).collect(),
        }
    }

    /// The states that it contains directly, in program order.
    pub fn children(&self) -> impl Iterator<Item = StateId> {
        self.lists().into_iter().flatten().copied()
    }

    /// The list that a child stands in.
    pub fn list_of(&self, child: StateId) -> &[StateId] {
        self.lists().into_iter().find(|list| list.contains(&child)).unwrap_or_default()
    }
}
