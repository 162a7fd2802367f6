//! One visit of a state in the window: a node, which something is executed for, or a marker, which only stands for a place.

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
use ratn_model::program::{ABORTED, SUCCESS};
use ratn_model::resource::Lease;
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use serde::{Deserialize, Serialize};
use smallvec::SmallVec;
use std::sync::Arc;

/// A stretch of the window between two decisions. It is certain when no branch of that number is open.
pub(crate) type SegmentId = u64;
/// A thread of control: the task's, or a region's.
pub(crate) type LineId = u64;

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
    /// How many instances of its line are before it on its path.
    pub(crate) position: u64,
    /// How many states were entered and iterations begun between the instance before it and this one, itself included.
    pub(crate) visits_before: u32,
    /// What follows: one arm, or one per branch. Empty where the path ends or nothing is expanded behind it yet.
    pub(crate) arms: SmallVec<[Arm; 1]>,
    /// Everything older on its line has retired, or runs imprecisely beside it.
    pub(crate) is_head: bool,
    /// Its result cannot change any more: [`crate::window::memory::settled`].
    pub(crate) is_settled: bool,
    pub(crate) body: Body,
    /// Private to [`crate::window::memory`].
    pub(crate) memory: MemoryCell,
    /// Private to [`crate::window::waits`].
    pub(crate) waiting: WaitCell,
    /// Private to [`crate::window::dispatch`].
    pub(crate) dispatch: DispatchCell,
}

/// What is only there of a node, or only of a marker.
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
    /// Every goal and every projection has one of its own.
    pub(crate) attempt: u32,
    /// Of `retry`, from 1.
    pub(crate) tries: u32,
    /// How many attempts its worker's death has cost.
    pub(crate) crashes: u32,
    pub(crate) not_before: Timestamp,
    /// What its result is made of.
    pub(crate) seen: Option<Box<Seen>>,
    /// Its goal was under way when it ended.
    pub(crate) has_acted: bool,
    /// It runs although younger ones of its line go on: an imprecise PIA.
    pub(crate) is_detached: bool,
}

/// How far a node is. Retired and discarded ones are not in the window any more.
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
    /// Waits for the resource manager, which was asked with this priority.
    Acquiring { priority: i64 },
    /// Has its resources; the operator holds it.
    Granted(Held),
    /// Waits for the world pool.
    Projecting(Held),
    /// Its goal is under way.
    Running(Held),
    /// So is what it contains: a routine.
    RunningRoutine(Box<Interpreter>, Timestamp),
    /// Its result is known.
    Finished(Box<Ended>),
}

/// What a node has got.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct Held {
    #[serde(with = "leases")]
    pub(crate) lease: Option<Box<Lease>>,
    pub(crate) projection: Option<ProjectionId>,
    /// When it got its resources.
    pub(crate) since: Timestamp,
}

/// A place of the program without a provider.
#[derive(Serialize, Deserialize)]
pub(crate) struct Marker {
    pub(crate) role: Role,
    /// Exit, region end, end: the outcome by which the state is left.
    pub(crate) leaves_by: Outcome,
    /// Why it is left by that outcome.
    pub(crate) because: Option<Arc<str>>,
    pub(crate) ended: Option<Box<Ended>>,
    /// Entry, exit: what its result is made of.
    pub(crate) seen: Option<Box<Seen>>,
}

/// What a marker stands for.
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
    /// What a composite state still does when it is left.
    Exit,
    /// Where regions begin.
    Fork,
    /// Where a region has ended.
    RegionEnd,
    /// Where all regions have ended: the decider.
    Join,
    /// The end of the task.
    End,
}

/// How an instance ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Ended {
    pub(crate) outcome: Arc<str>,
    pub(crate) outputs: Outputs,
    pub(crate) reason: String,
    pub(crate) changes: Changed,
    /// A routine that went on and on without an action: the run ends when that is real.
    pub(crate) in_circles: bool,
}

/// What an ended instance changes when it retires.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum Changed {
    /// What it declares for its outcome, with what was measured, and what is known of how.
    Declared(Vec<(FactKey, Value)>, Evidence),
    /// Exactly this: a routine on a projection (or nothing: a routine in the actual world has made its changes already,
    /// and what was never executed has none).
    Exactly(Made),
    /// Nothing: it waited. What it was taken to change, as the root shows it.
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

    /// It was never executed, or nobody knows how far: it changes nothing.
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

    /// What it stands for; `None` for a node.
    pub(crate) fn role(&self) -> Option<Role> {
        self.marker().map(|marker| marker.role)
    }

    /// How it ended, if it has.
    pub(crate) fn ended(&self) -> Option<&Ended> {
        match &self.body {
            Body::Node(Node { status: Status::Finished(ended), .. }) => Some(ended),
            Body::Node(_) => None,
            Body::Marker(marker) => marker.ended.as_deref(),
        }
    }

    /// What its result is made of.
    pub(crate) fn seen(&self) -> Option<&Seen> {
        match &self.body {
            Body::Node(node) => node.seen.as_deref(),
            Body::Marker(marker) => marker.seen.as_deref(),
        }
    }

    /// Its outputs, if it has ended well.
    pub(crate) fn outputs(&self) -> Option<&Outputs> {
        let ended = self.ended()?;
        // How a region ended is known also where it ended badly.
        let counts = self.role() == Some(Role::RegionEnd) || gives_outputs(&ended.outcome);
        counts.then_some(&ended.outputs)
    }

    /// Whether it occupies resources or a worker now, or asks for them.
    pub(crate) fn is_under_way(&self) -> bool {
        self.node().is_some_and(|node| !matches!(node.status, Status::Expanded | Status::Finished(_)))
    }

    /// Whether it is an action or routine that may change the environment.
    pub(crate) fn is_pia(&self) -> bool {
        self.node().is_some_and(|node| node.nature == NodeNature::Irreversible)
    }

    /// Whether it is an action that looks at the environment.
    pub(crate) fn is_sensing(&self) -> bool {
        self.node().is_some_and(|node| node.nature == NodeNature::Senses)
    }

    pub(crate) fn is_detached(&self) -> bool {
        self.node().is_some_and(|node| node.is_detached)
    }

    /// Whether it is a motion whose path was left: it ends as it ends, and leads nowhere.
    pub(crate) fn is_orphan(&self) -> bool {
        self.is_detached() && self.arms.is_empty()
    }

    /// Whether there are several ways on and it is not known which.
    pub(crate) fn is_undecided(&self) -> bool {
        self.arms.len() > 1
    }

    /// The arm that an outcome of its state takes.
    pub(crate) fn arm_of(&self, outcome: Outcome) -> Option<usize> {
        self.arms.iter().position(|arm| outcome < 64 && arm.outcomes & (1 << outcome) != 0)
    }
}

impl Status {
    /// Whether its goal, or what it contains, is under way.
    pub(crate) fn is_running(&self) -> bool {
        matches!(self, Status::Running(_) | Status::RunningRoutine(..))
    }

    /// Since when it has its resources.
    pub(crate) fn since(&self) -> Option<Timestamp> {
        match self {
            Status::Granted(held) | Status::Projecting(held) | Status::Running(held) => Some(held.since),
            Status::RunningRoutine(_, since) => Some(*since),
            Status::Expanded | Status::Acquiring { .. } | Status::Finished(_) => None,
        }
    }
}
