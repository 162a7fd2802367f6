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
use std::collections::BTreeMap;

/// The outcome of a state that did what it should.
pub const SUCCESS: &str = "success";
/// The outcome of a state that failed.
pub const ABORTED: &str = "aborted";
/// The outcome of a state that was told to stop.
pub const PREEMPTED: &str = "preempted";
/// The outcome of a state of which a condition did not hold to its end ([`Annotations::holds`]).
pub const VIOLATED: &str = "violated";
/// The outcome of a goal that an emergency stop ended. It is `preempted` to a state whose action has none of this name.
pub const STOPPED: &str = "stopped";

/// Whether a state that ends so has failed: it has no outputs and assigns nothing.
pub fn is_failure(outcome: &str) -> bool {
    matches!(outcome, ABORTED | PREEMPTED | VIOLATED)
}

/// The provider of what the executive does itself: it waits ([`crate::wait`]). No task file can name it.
pub const CLOCK: &str = "(clock)";

/// A loaded task program.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Program {
    /// The task's name.
    pub name: String,
    /// At most this many instances are expanded on one logical branch.
    pub horizon: usize,
    /// At most this many branches of undecided conditions are expanded, the likelier ones first.
    pub speculation_width: usize,
    /// The task ends `aborted` when it has taken this long, in the robot's seconds.
    pub deadline_s: Option<f64>,
    /// Whether states that do not say it fail precisely.
    pub exceptions: Exceptions,
    /// What `--set` may give.
    pub parameters: Vec<Parameter>,
    /// What the task returns when it ends with success.
    pub outputs: Vec<TaskOutput>,
    /// The facts that hold at the start, over what the world pool already holds; arguments may use parameters.
    pub initial: Vec<EffectExpr>,
    /// When a measured value is the predicted one, as far as the task and its ontology say it.
    pub tolerances: Tolerances,
    /// What its facts may say; `None`: anything.
    pub ontology: Option<Ontology>,
    /// Every state; a [`StateId`] is an index. State 0 is the root, a [`StateKind::Sequence`].
    pub states: Vec<State>,
    /// Hash of the texts of the task file, its ontology and its libraries, hexadecimal.
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
    /// Its outcomes beside `success`, `aborted` and `preempted`.
    pub outcomes: Vec<String>,
    /// Where its outcomes lead; see [`Program::target`] for those that are not listed.
    pub transitions: BTreeMap<String, Target>,
    /// Scoped variables of a sequence or a loop (a library's parameters are its scoped variables): bound at entry, each in the scope of
    /// the state itself, seen and assigned by what it contains.
    pub variables: Vec<(String, Expr)>,
    /// Scoped variables that it gives new values when it ends with an outcome that is neither `aborted` nor `preempted`,
    /// evaluated where its effects are.
    pub assign: Vec<(String, Expr)>,
    /// What its output ports are while it has not run in this activation of what contains it.
    pub defaults: BTreeMap<String, Value>,
    /// What it depends on and changes.
    pub annotations: Annotations,
    /// Where it stands in the task file.
    pub location: Location,
}

/// Where an outcome leads.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Target {
    /// To a state of the same list.
    State(StateId),
    /// Out of the list, by this outcome. `success` of a loop's body is the end of an iteration; any other outcome of a body, a
    /// branch or a list of children is the outcome of the state around it.
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
        /// Input ports and what flows into them.
        inputs: Vec<(String, Expr)>,
        /// Output ports with their types.
        outputs: BTreeMap<String, Type>,
    },
    /// A hierarchy: begins with its first child and goes on along their transitions.
    Sequence {
        /// In program order; the first is where it begins. Without children it succeeds at once.
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
        /// Output ports, evaluated in the scope of the body when the last iteration has ended.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        outputs: Vec<TaskOutput>,
    },
    /// The body as long as a predicate holds.
    While {
        /// A boolean, evaluated before each iteration.
        predicate: Expr,
        /// The first iteration begins without it: a `do … while`.
        body_first: bool,
        /// The variable bound to the number of the iteration (from 0), if wanted.
        index: Option<String>,
        /// The body, in program order.
        body: Vec<StateId>,
        /// Output ports, evaluated in the scope of the body when the last iteration has ended.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        outputs: Vec<TaskOutput>,
    },
    /// All regions at once. Each is a state with a path, a horizon and projections of its own; its outcome is seen as the port
    /// `outcome` of the region.
    Concurrency {
        /// The regions; their order means nothing.
        regions: Vec<StateId>,
        /// Regions that still go on when it ends are preempted: when the first has ended, whose outcome is the outcome, or with `successes`;
        /// else all are waited for.
        preemptive: bool,
        /// With `preemptive`: it ends when so many regions have succeeded, or so many can no longer succeed.
        successes: Option<u32>,
        /// The decider: the first outcome whose boolean holds. Where none does: `success` if all regions succeeded, `aborted` if
        /// one aborted, else `preempted`.
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

/// What a state depends on and changes. The default is a PIA that reads and writes everything.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Annotations {
    /// What it does to the environment.
    pub nature: Nature,
    /// The facts it reads; `None` is everything. Facts named in its inputs are included by the loader.
    pub reads: Option<Vec<FactExpr>>,
    /// Booleans that must hold in the actual world when it starts.
    pub requires: Vec<Expr>,
    /// Booleans that must hold in the actual world from its start to its end. Where one does not, an action is cancelled and ends
    /// [`VIOLATED`]. Only PIAs have some; around any other state [`crate::guard`] puts a watch.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub holds: Vec<Expr>,
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
    /// Whether it is tried again when it ends `aborted`.
    pub retry: Option<Retry>,
    /// It ends `aborted` when its goal takes longer than this, in the robot's seconds.
    pub timeout_s: Option<f64>,
    /// Whether younger PIAs may run beside it; `None` is what the task says.
    pub exceptions: Option<Exceptions>,
    /// Outcomes that are exceptional although they are connected: what follows them is not computed ahead.
    pub exceptional: Vec<String>,
    /// The same inputs and facts always give the same result, whatever the seed.
    pub deterministic: bool,
    /// Its action gives a result that can be used, and better ones later; any of them will do.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub anytime: bool,
    /// On a region: facts that other regions may touch too. The programmer answers for their order.
    pub shared: Vec<FactExpr>,
    /// Who says what is in force, by key; keys that nobody says are left out. The block of a projection that nobody says is under [`WORLD_MODEL`].
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub origin: BTreeMap<String, Origin>,
    /// That a sequence was made of a state that is tried again ([`crate::guard`]).
    pub again: Option<Again>,
    /// That a sequence was made of a state with something to do on every way out.
    pub finally: Option<Finally>,
}

/// Who says what is in force under a key of a state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Origin {
    /// The state itself.
    State,
    /// Its action, in the catalogue.
    Action,
    /// Both: effects add up.
    Both,
    /// Neither: what reads facts ahead of its place needs a projection.
    Reads,
}

/// What a state became that is tried again. It is said once more what its transitions and variables come to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Again {
    /// What is tried.
    pub body: StateId,
    /// How many tries after the first.
    pub count: u32,
    /// The outcomes after which it is.
    pub on: Vec<String>,
    /// What is done before each further try.
    pub before: Option<StateId>,
}

/// What a state became that has something to do on every way out.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Finally {
    /// What was to be done.
    pub body: StateId,
    /// What is done behind it, by its outcome.
    pub lastly: BTreeMap<String, StateId>,
}

impl Annotations {
    /// Every state that what a state became names.
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

/// How often and after which pauses an action that ends `aborted` is tried again. Only the last try's outcome, outputs and effects
/// count; each try has a seed of its own.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Retry {
    /// How many tries after the first.
    pub count: u32,
    /// The pause before the second try, in the robot's seconds; doubled before each further one.
    pub backoff_s: f64,
}

/// What younger PIAs do while a PIA runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Exceptions {
    /// They wait for its end: a failure leaves the world as the sequential program would.
    #[default]
    Precise,
    /// They may run beside it where nothing else forbids it: what they did stands even if it fails.
    Imprecise,
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
    /// What its attributes must be like besides.
    pub conditions: Vec<ConditionExpr>,
    /// How much; of what is not divisible, how many.
    pub count: Quantity,
    /// What it creates is divisible.
    pub divisible: bool,
    /// Of a resource that actuates: PIAs that block it need not do so in program order.
    pub unordered: bool,
}

impl ResourceExpr {
    /// One of a kind, whatever it is like.
    pub fn new(operation: ResourceOperation, kind: impl Into<String>) -> ResourceExpr {
        let (class, attributes, conditions) = Default::default();
        let (count, divisible, unordered) = (Quantity::ONE, false, false);
        ResourceExpr { operation, kind: kind.into(), class, attributes, conditions, count, divisible, unordered }
    }

    /// What it is selected by, or gets.
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

    /// The branches expanded in a task that says nothing.
    pub const DEFAULT_SPECULATION_WIDTH: usize = 8;

    /// The state of an id.
    pub fn state(&self, id: StateId) -> &State {
        &self.states[id.0 as usize]
    }

    /// Whether a state is what the body of a loop stands in that collects something of each iteration ([`crate::guard::Collected`]). What is inside
    /// of it is inside of the loop, as in any other loop: it is seen from there, and forgotten when the loop is entered.
    pub fn is_pass(&self, id: StateId) -> bool {
        let state = self.state(id);
        let collects = |around: &State| around.is_loop() && !around.variables.is_empty();
        matches!(state.kind, StateKind::Sequence { .. }) && state.parent.is_some_and(|id| collects(self.state(id)))
    }

    /// Whether the list of a state is gone through once in each iteration: that of a loop, or of what its body stands in.
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

    /// The states that a loop goes through in each iteration.
    pub fn body_of(&self, id: StateId) -> &[StateId] {
        let (StateKind::ForEach { body, .. } | StateKind::While { body, .. }) = &self.state(id).kind else {
            return &[];
        };
        match body.as_slice() {
            [pass] if self.is_pass(*pass) => self.list_of(*pass),
            body => body,
        }
    }

    /// Where an outcome of a state leads. An outcome that is not connected: `success` goes on with the next sibling, and after the
    /// last one out by `success`; any other leaves by its own name. A region leads nowhere else.
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

    /// Whether what follows an outcome is not computed ahead: `aborted`, `preempted` and `violated` unless they are connected to
    /// something else than what follows success, and whatever is marked so.
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
    /// Every state's outcomes: `success`, its own, those by which what it contains leaves it, `aborted`, `preempted`.
    pub fn all_outcomes(&self) -> Vec<Vec<String>> {
        let mut all: Vec<Vec<String>> = vec![Vec::new(); self.states.len()];
        // What a state contains comes after it.
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
    /// What it puts out of what it contains; none of an action.
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

    /// The same, to change them; `None` of an action.
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
    /// Whether it waits, which the executive does itself: no provider gets a goal.
    pub fn is_pause(&self) -> bool {
        matches!(&self.kind, StateKind::Action { provider, .. } if provider == CLOCK)
    }

    /// Whether it is executed as one node although it contains others: what is marked so, and every preemptive concurrency.
    pub fn is_routine(&self) -> bool {
        match self.kind {
            StateKind::Action { .. } => false,
            StateKind::Concurrency { preemptive: true, .. } => true,
            _ => self.annotations.routine,
        }
    }

    /// What it puts out of what it contains; none of an action.
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
