//! One visit of a state, and what it can name.

use crate::analysis::{NodeNature, StateAnalysis};
use crate::binding::{Names, Outputs};
use crate::interpreter::Interpreter;
use imbl::OrdMap;
use ratn_model::fact::{Change, FactKey, Footprint};
use ratn_model::id::{InstanceId, ProjectionId, StateId};
use ratn_model::program::{ABORTED, SUCCESS};
use ratn_model::resource::Lease;
use ratn_model::value::Value;
use ratn_world::world::World;
use std::borrow::Cow;
use std::collections::BTreeMap;

/// What an instance is in the window.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Role {
    /// An action, or a routine: something is executed.
    Node,
    /// Decides between two branches.
    Condition,
    /// Decides how often the body is expanded.
    Loop,
    /// The preconditions of a composite state.
    Entry,
    /// The outputs, effects and resource operations of a composite state.
    Exit,
    /// The end of the task.
    End,
}

/// How far an instance is. Retired and squashed ones are not in the window any more.
///
/// ```text
/// Expanded ─► Acquiring ─► Granted ─► Projecting ─► Granted ─► Running ─► Finished
///     ▲            └───────────┴── its worker died ──┴────────────┘
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Status {
    /// Waits for older instances.
    Expanded,
    /// Waits for the resource manager.
    Acquiring,
    /// Has its resources.
    Granted,
    /// Waits for the world pool.
    Projecting,
    /// Its goal is under way.
    Running,
    /// Its result is known.
    Finished,
}

/// What an instance waits for; for people.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Wait {
    /// Nothing that is known.
    Nothing,
    /// The output of another instance.
    Data(StateId),
    /// Facts that an older instance has yet to make known.
    World(Footprint),
    /// The environment does not look yet as it will at this place of the program.
    Environment,
    /// Every older instance must have retired.
    Order,
    /// A sensing node is looking at what it would change.
    Sensing(InstanceId),
    /// A motion is changing what it would look at.
    Writer(InstanceId),
    /// A precondition that does not hold in its projection.
    Precondition(String),
    /// A task resource that an older instance operates on.
    TaskResource(String),
    /// The resource manager.
    Resources,
}

/// How an instance ended.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Ended {
    pub(crate) outcome: String,
    pub(crate) outputs: Outputs,
    pub(crate) reason: String,
    pub(crate) changes: Changed,
}

/// What an ended instance changes when it retires.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Changed {
    /// What it declares for its outcome, with what was measured.
    Declared(Vec<(FactKey, Value)>),
    /// Exactly this: a routine on a projection (or nothing: a routine in the actual world has made its changes already,
    /// and what was never executed has none).
    Exactly(Vec<Change>),
}

impl Ended {
    pub(crate) fn success(outputs: Outputs) -> Ended {
        let changes = Changed::Declared(Vec::new());
        Ended { outcome: SUCCESS.to_owned(), outputs, reason: String::new(), changes }
    }

    /// It was never executed, or nobody knows how far: it changes nothing.
    pub(crate) fn aborted(reason: String) -> Ended {
        let changes = Changed::Exactly(Vec::new());
        Ended { outcome: ABORTED.to_owned(), outputs: Outputs::new(), reason, changes }
    }

    /// Facts as measured.
    pub(crate) fn measured(&self) -> &[(FactKey, Value)] {
        match &self.changes {
            Changed::Declared(measured) => measured,
            Changed::Exactly(_) => &[],
        }
    }
}

/// Variables, and which instance last wrote a state's outputs, on the way to one place of the program. Cloning is cheap.
#[derive(Debug, Clone, Default)]
pub(crate) struct Environment {
    pub(crate) variables: OrdMap<String, Value>,
    pub(crate) producers: OrdMap<StateId, InstanceId>,
}

/// One visit of a state.
pub(crate) struct Instance {
    pub(crate) id: InstanceId,
    pub(crate) state: StateId,
    pub(crate) role: Role,
    pub(crate) nature: NodeNature,
    pub(crate) path: String,
    pub(crate) environment: Environment,
    /// The one before it in program order; `None` when that has retired.
    pub(crate) older: Option<InstanceId>,
    /// The branch it assumes, when `older` is an undecided condition.
    pub(crate) assumption: Option<bool>,
    /// Those after it: one, or one per branch.
    pub(crate) next: Vec<InstanceId>,
    pub(crate) status: Status,
    pub(crate) wait: Wait,
    pub(crate) attempt: u32,
    /// How many attempts its worker's death has cost; stepping back costs none.
    pub(crate) crashes: u32,
    pub(crate) lease: Option<Lease>,
    pub(crate) projection: Option<ProjectionId>,
    pub(crate) ended: Option<Ended>,
    /// Its result cannot change any more.
    pub(crate) settled: bool,
    pub(crate) routine: Option<Box<Interpreter>>,
    /// Estimated, in seconds.
    pub(crate) duration_s: f64,
    /// The longest estimated path from its start to the end of the window.
    pub(crate) remaining_s: f64,
    /// What it read, sensed or may write, as bound when it began.
    pub(crate) reads: Footprint,
    pub(crate) senses: Footprint,
    pub(crate) writes: Footprint,
    /// The world that it began in, unless that was the actual one.
    pub(crate) seen: Option<World>,
}

impl Instance {
    /// Whether the node occupies resources or a worker now.
    pub(crate) fn is_under_way(&self) -> bool {
        matches!(self.status, Status::Acquiring | Status::Granted | Status::Projecting | Status::Running)
    }

    /// Whether it decides control flow and has not yet.
    pub(crate) fn is_undecided(&self) -> bool {
        self.role == Role::Condition && self.ended.is_none()
    }

    /// Whether its result is known and good.
    pub(crate) fn succeeded(&self) -> bool {
        self.ended.as_ref().is_some_and(|ended| ended.outcome == SUCCESS)
    }

    /// Whether it is an action or routine that may change the environment.
    pub(crate) fn is_pia(&self) -> bool {
        self.role == Role::Node && self.nature == NodeNature::Irreversible
    }
}

/// Instances that are in the window, and the outputs of those that have retired.
#[derive(Default)]
pub(crate) struct Instances {
    pub(crate) alive: BTreeMap<InstanceId, Instance>,
    pub(crate) retired: BTreeMap<InstanceId, Outputs>,
}

impl Instances {
    /// The outputs of an instance that has ended with success.
    pub(crate) fn outputs(&self, id: InstanceId) -> Option<&Outputs> {
        match self.alive.get(&id) {
            Some(instance) if instance.succeeded() => instance.ended.as_ref().map(|e| &e.outputs),
            Some(_) => None,
            None => self.retired.get(&id),
        }
    }

    /// The first of the states whose output is not there yet.
    pub(crate) fn missing_flow(&self, environment: &Environment, analysis: &StateAnalysis) -> Option<StateId> {
        analysis
            .flows
            .iter()
            .copied()
            .find(|state| environment.producers.get(state).is_none_or(|producer| self.outputs(*producer).is_none()))
    }

    /// Whether every one of the states' outputs is there and cannot change any more.
    pub(crate) fn flows_settled(&self, environment: &Environment, flows: &[StateId]) -> bool {
        flows.iter().all(|state| match environment.producers.get(state) {
            None => false,
            Some(producer) => match self.alive.get(producer) {
                Some(instance) => instance.settled && instance.succeeded(),
                None => self.retired.contains_key(producer),
            },
        })
    }
}

/// The names of one place of the program.
pub(crate) struct PlaceNames<'a> {
    pub(crate) instances: &'a Instances,
    pub(crate) environment: &'a Environment,
}

impl Names for PlaceNames<'_> {
    fn variable(&self, name: &str) -> Option<Cow<'_, Value>> {
        self.environment.variables.get(name).map(Cow::Borrowed)
    }

    fn port(&self, state: StateId, port: &str) -> Option<Cow<'_, Value>> {
        let producer = self.environment.producers.get(&state)?;
        self.instances.outputs(*producer)?.get(port).map(Cow::Borrowed)
    }
}
