//! One visit of a state in the window: a node, for which something is executed, or a marker, which only stands for a place.

use crate::binding::Outputs;
use crate::checkpoint::leases;
use crate::context::Made;
use crate::interpreter::Interpreter;
use crate::plan::{NodeNature, Outcome, Outcomes, gives_outputs};
use crate::window::dispatch::DispatchCell;
use crate::window::growth::environment::{Environment, Producer};
use crate::window::memory::{MemoryCell, Seen};
use crate::window::waits::WaitCell;
use ratn_model::fact::{Change, FactKey};
use ratn_model::id::{InstanceId, ProjectionId, StateId};
use ratn_model::measurement::Evidence;
use ratn_model::program::{ABORTED, Program, SUCCESS};
use ratn_model::resource::Lease;
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use serde::{Deserialize, Serialize};
use smallvec::SmallVec;
use std::sync::Arc;

pub(crate) use super::lines::LineId;

/// Number of a stretch of the window between two decisions. It is certain unless a branch with this number is open.
pub(crate) type SegmentId = u64;

/// One visit of a state. Only the graph changes it; everybody may look at it.
#[derive(Serialize, Deserialize)]
pub(crate) struct Instance {
    pub(crate) id: InstanceId,
    pub(crate) state: StateId,
    pub(crate) visit: u32,
    pub(crate) iteration: Option<usize>,
    #[serde(skip)]
    pub(crate) environment: Environment,
    pub(crate) producer: Option<Arc<Producer>>,
    pub(crate) line: LineId,
    pub(crate) segment: SegmentId,
    /// Number of instances before it on its line, along its path.
    pub(crate) position: u64,
    /// Number of states entered and iterations begun since the instance before it, including itself.
    pub(crate) visits_before: u32,
    /// Its continuations: one arm, or one per branch. Empty if the path ends or nothing has been expanded behind it yet.
    pub(crate) arms: SmallVec<[Arm; 1]>,
    /// Whether everything older on its line has retired, or runs as a detached PIA.
    pub(crate) is_head: bool,
    /// Whether its result can no longer change: [`crate::window::memory::settled`].
    pub(crate) is_settled: bool,
    pub(crate) body: Body,
    /// Private to [`crate::window::memory`].
    pub(crate) memory: MemoryCell,
    /// Private to [`crate::window::waits`].
    pub(crate) waiting: WaitCell,
    /// Private to [`crate::window::dispatch`].
    pub(crate) dispatch: DispatchCell,
}

/// The fields of a node, or those of a marker.
#[derive(Serialize, Deserialize)]
pub(crate) enum Body {
    /// An action, or a routine: something is executed.
    Node(Node),
    /// A place of the program where something is decided, computed or noted without a provider.
    Marker(Marker),
}

/// The life of an action or a routine.
#[derive(Serialize, Deserialize)]
pub(crate) struct Node {
    pub(crate) nature: NodeNature,
    pub(crate) status: Status,
    /// Every goal and every projection has its own attempt number.
    pub(crate) attempt: u32,
    /// Number of the try (see `retry`), from 1.
    pub(crate) tries: u32,
    /// Number of attempts that crashed.
    pub(crate) crashes: u32,
    pub(crate) not_before: Timestamp,
    /// The inputs of its result.
    pub(crate) seen: Option<Box<Seen>>,
    /// The answer of its goal, before its assignments: what another instance with the same inputs would be answered, too. `None` if it ended
    /// without an answer, and for nodes that do not compute.
    pub(crate) answer: Option<Box<Ended>>,
    /// Whether its goal was under way when it ended.
    pub(crate) has_acted: bool,
    /// Whether it is an imprecise PIA that runs while younger instances of its line go on.
    pub(crate) is_detached: bool,
    /// Of a computing or sensing node: whether it has come to its place in the sequential program before it ended.
    pub(crate) is_at_its_place: bool,
}

/// The status of a node. Retired and discarded nodes are no longer in the window.
///
/// ```text
/// Expanded ─► Acquiring ─► Granted ─► Projecting ─► Running ─► Finished
///     ▲            └───────────┴── its worker died ──┘            │
///     └───────────── invalidated, preempted, tried again ─────────┘
/// ```
#[derive(Serialize, Deserialize)]
pub(crate) enum Status {
    /// Waits for older instances.
    Expanded,
    /// Waits for the resource manager, with this priority.
    Acquiring { priority: i64 },
    /// Has its resources; the operator holds it.
    Granted(Held),
    /// Waits for the world pool.
    Projecting(Held),
    /// Its goal is under way.
    Running(Held),
    /// The parts of a routine are under way, since this time.
    RunningRoutine(Box<Interpreter>, Timestamp),
    /// Its result is known.
    Finished(Box<Ended>),
}

/// What a node holds.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct Held {
    #[serde(with = "leases")]
    pub(crate) lease: Option<Box<Lease>>,
    pub(crate) projection: Option<ProjectionId>,
    /// When it got its resources; while it runs, when its goal or its wait began.
    pub(crate) since: Timestamp,
}

/// A place of the program without a provider.
#[derive(Serialize, Deserialize)]
pub(crate) struct Marker {
    pub(crate) role: Role,
    /// Of an exit, a region end or the end: the outcome by which the state is left.
    pub(crate) leaves_by: Outcome,
    /// Reason of that outcome.
    pub(crate) because: Option<Arc<str>>,
    pub(crate) ended: Option<Box<Ended>>,
    /// Of an entry or exit: the facts on which its result is based.
    pub(crate) seen: Option<Box<Seen>>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Role {
    /// Decides between two branches.
    Condition,
    /// Decides whether there is another iteration.
    Test,
    /// Decides how often the body is expanded.
    Loop,
    /// The preconditions and variables of a composite state.
    Entry,
    /// The exit of a composite state.
    Exit,
    /// Where regions begin.
    Fork,
    /// The end of a region.
    RegionEnd,
    /// The end of a concurrency: the decider.
    Join,
    /// The end of the task.
    End,
}

/// The end of an instance.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Ended {
    pub(crate) outcome: Arc<str>,
    pub(crate) outputs: Outputs,
    pub(crate) reason: String,
    pub(crate) changes: Changed,
    /// Whether it is a routine that went in circles; then the run ends when it retires.
    pub(crate) in_circles: bool,
}

/// The changes that an ended instance makes when it retires.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum Changed {
    /// The declared effects of its outcome, with measured values and their evidence.
    Declared(Vec<(FactKey, Value)>, Evidence),
    /// Exactly these: a routine on a projection. None for a routine in the actual world, which has committed already, and
    /// for a node that was never executed.
    Exactly(Made),
    /// None, because it waited; these are the changes that it foresaw, as the root shows them.
    Foreseen(Vec<Change>),
}

/// One continuation.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Arm {
    pub(crate) outcomes: Outcomes,
    pub(crate) next: Option<InstanceId>,
    pub(crate) segment: SegmentId,
}

impl Ended {
    pub(crate) fn with(outcome: impl Into<Arc<str>>, outputs: Outputs) -> Ended {
        Ended {
            outcome: outcome.into(),
            outputs,
            reason: String::new(),
            changes: Changed::Declared(Vec::new(), Evidence::new()),
            in_circles: false,
        }
    }

    pub(crate) fn success(outputs: Outputs) -> Ended {
        Ended::with(SUCCESS, outputs)
    }

    /// An end without changes: it was never executed, or how far it came is unknown.
    pub(crate) fn aborted(reason: String) -> Ended {
        let changes = Changed::Exactly(Made::default());
        Ended { outcome: ABORTED.into(), outputs: Outputs::new(), reason, changes, in_circles: false }
    }
}

impl Instance {
    pub(crate) fn node(&self) -> Option<&Node> {
        match &self.body {
            Body::Node(node) => Some(node),
            Body::Marker(_) => None,
        }
    }

    pub(crate) fn marker(&self) -> Option<&Marker> {
        match &self.body {
            Body::Marker(marker) => Some(marker),
            Body::Node(_) => None,
        }
    }

    /// The role of a marker; `None` for a node.
    pub(crate) fn role(&self) -> Option<Role> {
        self.marker().map(|marker| marker.role)
    }

    /// Its end, if it has ended.
    pub(crate) fn ended(&self) -> Option<&Ended> {
        match &self.body {
            Body::Node(Node { status: Status::Finished(ended), .. }) => Some(ended),
            Body::Node(_) => None,
            Body::Marker(marker) => marker.ended.as_deref(),
        }
    }

    /// The inputs of its result.
    pub(crate) fn seen(&self) -> Option<&Seen> {
        match &self.body {
            Body::Node(node) => node.seen.as_deref(),
            Body::Marker(marker) => marker.seen.as_deref(),
        }
    }

    /// Its outputs, if it has ended well.
    pub(crate) fn outputs(&self) -> Option<&Outputs> {
        let ended = self.ended()?;
        // The outcome of a region counts as an output even if the region failed.
        let counts = self.role() == Some(Role::RegionEnd) || gives_outputs(&ended.outcome);
        counts.then_some(&ended.outputs)
    }

    /// Whether it holds resources or a worker, or asks for them.
    pub(crate) fn is_under_way(&self) -> bool {
        self.node().is_some_and(|node| !matches!(node.status, Status::Expanded | Status::Finished(_)))
    }

    pub(crate) fn is_pia(&self) -> bool {
        self.node().is_some_and(|node| node.nature == NodeNature::Irreversible)
    }

    /// The path of its state, with visits.
    pub(crate) fn path(&self, program: &Program) -> String {
        self.environment.path(&program.state(self.state).name, self.visit, self.iteration)
    }

    /// Of a motion whose goal has ended, and whose end is taken when an older motion beside it has ended: that end.
    pub(crate) fn end_to_take(&self) -> Option<&Ended> {
        let node = self.node().filter(|node| matches!(node.status, Status::Running(_)) && self.is_pia())?;
        node.answer.as_deref()
    }

    /// Whether it is an action that looks at the environment.
    pub(crate) fn is_sensing(&self) -> bool {
        self.node().is_some_and(|node| node.nature == NodeNature::Senses)
    }

    pub(crate) fn is_detached(&self) -> bool {
        self.node().is_some_and(|node| node.is_detached)
    }

    /// Whether it is a running motion whose path was left: it runs to its end, and nothing follows it.
    pub(crate) fn is_orphan(&self) -> bool {
        self.is_detached() && self.arms.is_empty()
    }

    /// Whether it has several ways on and is not decided.
    pub(crate) fn is_undecided(&self) -> bool {
        self.arms.len() > 1
    }

    /// The arm to which an outcome of its state belongs.
    pub(crate) fn arm_of(&self, outcome: Outcome) -> Option<usize> {
        self.arms.iter().position(|arm| outcome < 64 && arm.outcomes & (1 << outcome) != 0)
    }
}

impl Status {
    /// Whether its goal, or its routine, is under way.
    pub(crate) fn is_running(&self) -> bool {
        matches!(self, Status::Running(_) | Status::RunningRoutine(..))
    }

    /// When it got its resources or, while its goal or its wait is under way, when that began.
    pub(crate) fn since(&self) -> Option<Timestamp> {
        match self {
            Status::Granted(held) | Status::Projecting(held) | Status::Running(held) => Some(held.since),
            Status::RunningRoutine(_, since) => Some(*since),
            Status::Expanded | Status::Acquiring { .. } | Status::Finished(_) => None,
        }
    }
}
