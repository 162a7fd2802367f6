//! One visit of a state in the window.

use super::environment::{Environment, Producer};
use crate::binding::Outputs;
use crate::context::Made;
use crate::interpreter::Interpreter;
use crate::plan::NodeNature;
pub(crate) use crate::plan::gives_outputs;
use crate::plan::{Outcome, Outcomes};
use ratn_model::fact::{FactKey, Footprint};
use ratn_model::id::{InstanceId, ProjectionId, StateId};
use ratn_model::measurement::Evidence;
use ratn_model::program::{ABORTED, SUCCESS};
use ratn_model::resource::Lease;
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_world::digest::Digest;
use smallvec::SmallVec;
use std::cell::Cell;
use std::sync::Arc;

/// What an instance is in the window.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Role {
    /// An action, or a routine: something is executed.
    Node,
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

/// How far an instance is. Retired and squashed ones are not in the window any more.
///
/// ```text
/// Expanded ─► Acquiring ─► Granted ─► Projecting ─► Granted ─► Running ─► Finished
///     ▲            └───────────┴── its worker died ──┴────────────┘           │
///     └───────────────────────── invalidated, tried again ────────────────────┘
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum Wait {
    /// Nothing that is known.
    #[default]
    Nothing,
    /// The output of another instance.
    Data(InstanceId),
    /// What an older instance makes of the facts it reads.
    World(InstanceId),
    /// The environment does not look yet as it will at this place of the program: an older instance has yet to change it.
    Environment(InstanceId),
    /// Every older instance must have retired.
    Order,
    /// A sensing node is looking at what it would change.
    Sensing(InstanceId),
    /// A motion is changing what it would look at.
    Writer(InstanceId),
    /// A task resource that an older instance operates on.
    TaskResource(InstanceId),
    /// The same visit on another branch is computing the same.
    Twin(InstanceId),
    /// A condition on its path.
    Decision(InstanceId),
    /// A result that may still change.
    Settling(InstanceId),
    /// Its next try.
    Backoff,
    /// The operator.
    Pause,
    /// Room: what is speculative leaves some to what is not.
    Room,
    /// The resource manager.
    Resources,
}

/// How an instance ended.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Ended {
    pub(crate) outcome: Arc<str>,
    pub(crate) outputs: Outputs,
    pub(crate) reason: String,
    pub(crate) changes: Changed,
}

/// What an ended instance changes when it retires.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Changed {
    /// What it declares for its outcome, with what was measured, and what is known of how.
    Declared(Vec<(FactKey, Value)>, Evidence),
    /// Exactly this: a routine on a projection (or nothing: a routine in the actual world has made its changes already,
    /// and what was never executed has none).
    Exactly(Made),
}

impl Ended {
    pub(crate) fn with(outcome: impl Into<Arc<str>>, outputs: Outputs) -> Ended {
        Ended {
            outcome: outcome.into(),
            outputs,
            reason: String::new(),
            changes: Changed::Declared(Vec::new(), Evidence::new()),
        }
    }

    pub(crate) fn success(outputs: Outputs) -> Ended {
        Ended::with(SUCCESS, outputs)
    }

    /// It was never executed, or nobody knows how far: it changes nothing.
    pub(crate) fn aborted(reason: String) -> Ended {
        let changes = Changed::Exactly(Made::default());
        Ended { outcome: ABORTED.into(), outputs: Outputs::new(), reason, changes }
    }
}

/// What a result was made of.
#[derive(Debug, Clone, Default)]
pub(crate) struct Seen {
    /// The facts that it may have read.
    pub(crate) read: Vec<Footprint>,
    /// As they were.
    pub(crate) facts: Vec<(FactKey, Value)>,
    /// What its inputs come to.
    pub(crate) inputs: Digest,
}

impl Seen {
    /// Whether the same is computed of it.
    pub(crate) fn is_like(&self, other: &Seen) -> bool {
        self.inputs == other.inputs && self.facts == other.facts
    }
}

/// One continuation.
#[derive(Debug, Clone)]
pub(crate) struct Arm {
    pub(crate) outcomes: Outcomes,
    /// The one that the path assumes where they differ in effects.
    pub(crate) outcome: Outcome,
    pub(crate) next: Option<InstanceId>,
    pub(crate) segment: Segment,
}

/// A stretch of the window between two decisions. 0 and every one whose decision is made are certain.
pub(crate) type Segment = u64;
/// A thread of control: the task's, or a region's.
pub(crate) type Line = u64;

/// One visit of a state.
pub(crate) struct Instance {
    pub(crate) id: InstanceId,
    pub(crate) state: StateId,
    pub(crate) visit: u32,
    pub(crate) iteration: Option<usize>,
    pub(crate) role: Role,
    pub(crate) nature: NodeNature,
    pub(crate) environment: Environment,
    pub(crate) producer: Option<Arc<Producer>>,
    pub(crate) line: Line,
    pub(crate) segment: Segment,
    /// How many instances of its line are before it on its path.
    pub(crate) position: u64,
    /// What follows: one arm, or one per branch. Empty where the path ends or nothing is expanded behind it yet.
    pub(crate) arms: SmallVec<[Arm; 1]>,
    /// Exit, RegionEnd, End: the outcome by which the state is left.
    pub(crate) leaves_by: Outcome,
    /// Why it is left by that outcome.
    pub(crate) left_because: Option<Arc<str>>,
    /// It may start: everything older has retired, or runs imprecisely beside it.
    pub(crate) is_head: bool,
    /// Retired in order while it runs: an imprecise PIA.
    pub(crate) detached: bool,
    /// Its goal was under way when it ended.
    pub(crate) has_acted: bool,
    pub(crate) queued: bool,
    pub(crate) status: Status,
    pub(crate) wait: Wait,
    /// Every goal and every projection has one of its own.
    pub(crate) attempt: u32,
    /// Of `retry`, from 1.
    pub(crate) tries: u32,
    /// How many attempts its worker's death has cost.
    pub(crate) crashes: u32,
    pub(crate) not_before: Timestamp,
    /// When it got its resources.
    pub(crate) began: Timestamp,
    pub(crate) lease: Option<Box<Lease>>,
    pub(crate) projection: Option<ProjectionId>,
    pub(crate) ended: Option<Box<Ended>>,
    /// Its result cannot change any more.
    pub(crate) settled: Cell<bool>,
    pub(crate) routine: Option<Box<Interpreter>>,
    pub(crate) seen: Option<Box<Seen>>,
    /// To be looked at again when this ends, settles, retires or is squashed.
    pub(crate) waiters: SmallVec<[InstanceId; 2]>,
    /// Those whose results were made of this one's outputs or effects.
    pub(crate) users: SmallVec<[InstanceId; 2]>,
    /// Estimated, in seconds.
    pub(crate) duration_s: f32,
    /// The longest estimated path from its start to the end of the window, or what a look ahead advised.
    pub(crate) remaining_s: f32,
    pub(crate) advised: bool,
    /// The priority it asked with.
    pub(crate) asked_with: i64,
}

impl Instance {
    /// Whether the node occupies resources or a worker now.
    pub(crate) fn is_under_way(&self) -> bool {
        matches!(self.status, Status::Acquiring | Status::Granted | Status::Projecting | Status::Running)
    }

    /// Whether there are several ways on and it is not known which.
    pub(crate) fn is_undecided(&self) -> bool {
        self.arms.len() > 1
    }

    /// Its outputs, if it has ended well.
    pub(crate) fn outputs(&self) -> Option<&Outputs> {
        let ended = self.ended.as_ref()?;
        // How a region ended is known also where it ended badly.
        let counts = self.role == Role::RegionEnd || gives_outputs(&ended.outcome);
        counts.then_some(&ended.outputs)
    }

    /// Whether it is an action or routine that may change the environment.
    pub(crate) fn is_pia(&self) -> bool {
        self.role == Role::Node && self.nature == NodeNature::Irreversible
    }

    /// Whether it is a motion whose path was left: it ends as it ends, and leads nowhere.
    pub(crate) fn is_orphan(&self) -> bool {
        self.detached && self.arms.is_empty()
    }
}
