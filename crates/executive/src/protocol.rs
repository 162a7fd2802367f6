//! Events into the executive and commands out of it. Together they are the lines of the event log.

use crate::lookahead::Held;
use ratn_model::fact::{Change, FactKey, Footprint};
use ratn_model::id::{FencingToken, InstanceId, LeaseId, ProjectionId, Revision, StateId};
use ratn_model::measurement::Evidence;
use ratn_model::resource::{Lease, OperatedUnits, Quantity, Requirement};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

/// How a task is executed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// Sequential: as written, one state after the other.
    Hsm,
    /// As a concurrent dataflow task network.
    Cdtn,
}

/// What earlier runs of a task have taught, by the path of the state (without visits).
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Learned {
    /// Mean duration of an attempt, in seconds of the robot's time.
    #[serde(default)]
    pub durations_s: BTreeMap<String, f64>,
    /// Share of each outcome, by state. For a condition: `then` and `else`; for a `while`: `again` and `done`.
    #[serde(default)]
    pub outcomes: BTreeMap<String, BTreeMap<String, f64>>,
}

/// Identifies a run, so that task control can resume it after a crash.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Origin {
    /// Id of the run: the first part of every idempotent id, and the id of its session with the resource manager. Empty if the run cannot be resumed.
    #[serde(default)]
    pub run: String,
    /// Number that the resource manager gave to the run's first session. A session that is opened again under the same id has another number. 0 in logs
    /// of earlier versions.
    #[serde(default)]
    pub session: u64,
    /// Version of the `ratn` binary that executes the run.
    #[serde(default)]
    pub version: String,
    /// The task file, as an absolute path.
    #[serde(default)]
    pub file: String,
    /// The state of the task's own list at which the run began, if not the first.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<String>,
    /// The robot: the name of a built-in one, or the absolute path of its description. Empty in logs of earlier versions.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub robot: String,
    /// When the run began, in milliseconds since 1970.
    #[serde(default)]
    pub began_unix_ms: u64,
    /// Paths (without visits) of PIAs beside which younger ones may run: their exceptions are imprecise.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub imprecise: Vec<String>,
    /// The run's share of contested resources, if not the default 1. It holds until the run is resumed with another share.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub share: Option<f64>,
    /// Natures of the task's states, so that a log can be read without the task. Empty in logs of earlier versions.
    #[serde(default)]
    pub natures: Natures,
}

/// The natures of a task's states.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Natures {
    /// Paths (without visits) of the actions that only compute.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub computes: Vec<String>,
    /// Paths (without visits) of the actions that sense the environment.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub senses: Vec<String>,
    /// The kinds of resources that move the robot.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub actuating: Vec<String>,
    /// Paths (without visits) of the composite states that change the world at their exit.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub changes_at_exit: Vec<String>,
}

/// An event for the executive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// The run begins. Always the first event, once.
    Started {
        /// The task's name.
        task: String,
        /// The task file's digest.
        digest: String,
        /// In which mode the task is executed.
        mode: Mode,
        /// Every parameter's value.
        parameters: BTreeMap<String, Value>,
        /// Random seed of the run; all its random choices derive from it.
        seed: u64,
        /// The root world at the start.
        world: Vec<(FactKey, Value)>,
        /// The revision of that world.
        revision: Revision,
        /// Capacity of each resource kind, where it is known. From it follows whom a speculative holder keeps waiting.
        #[serde(default)]
        capacity: BTreeMap<String, Quantity>,
        /// What earlier runs of the task have taught.
        #[serde(default)]
        learned: Learned,
        /// The breakpoints at the start of the run, as in [`Event::BreakpointsSet`].
        #[serde(default, skip_serializing_if = "<[String]>::is_empty")]
        breakpoints: Box<[String]>,
        /// Identifies the run.
        #[serde(default)]
        origin: Box<Origin>,
    },
    /// Task control has restarted and resumes the run from its log. Logged; changes nothing.
    Resumed {
        /// The run's share of contested resources from now on, if it has changed.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        share: Option<f64>,
    },
    /// The resource manager has recorded what the run created, deleted and consumed. Logged; changes nothing.
    Recorded {
        /// Number of the last recorded [`Command::Operate`]; they are numbered from 1.
        operation: u64,
        /// Number of the session with these records; it is the run's session from now on.
        session: u64,
        /// The units that this operation has created, deleted and used up, for each of its requirements. Empty if the resource manager does not
        /// report all of them, or if more than one operation is reported at once.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        units: Vec<Vec<OperatedUnits>>,
        /// If the run's resources were created again in that session: the new ids by the old ones.
        #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
        renamed: BTreeMap<String, String>,
    },
    /// When task control resumed the run, the session under which the run held its resources was gone. Logged; changes nothing.
    SessionLost {
        /// The world pool's revision of the run's last commit, or of its start. Up to this revision the run held its resources; later changes may have
        /// been made by others with the same resources.
        held_until: Revision,
    },
    /// The time of a [`Command::Wake`] has come. Logged, as every event.
    Woken,
    /// A client sends a signal. The state that waits for a signal of this name goes on; if none waits, the next one that does.
    Signalled {
        /// Its name.
        signal: String,
        /// The value sent with it; null if there is none.
        #[serde(default = "nothing")]
        value: Value,
    },
    /// An operator answers a question.
    Answered {
        /// The instance that asks.
        instance: InstanceId,
        /// One of the question's choices.
        choice: String,
    },
    /// Pause: no PIA begins until further notice. Running goals go on, and computing and sensing nodes still begin.
    PauseRequested,
    /// Resume: PIAs may begin again.
    ResumeRequested,
    /// Single step: one PIA may begin, then the run pauses again.
    StepRequested,
    /// Replaces all breakpoints. The run pauses before a PIA begins that is one of these states or inside of one.
    BreakpointsSet {
        /// The paths of states, without visits.
        states: Vec<String>,
    },
    /// Look-ahead found a better order: how long before the end of all known work each instance should begin.
    Advised {
        /// Seconds, by instance; replaces the longest remaining path.
        urgency_s: Vec<(InstanceId, f64)>,
        /// Instances that are held back so that others begin first. This list replaces the earlier one.
        #[serde(default)]
        held: Vec<Held>,
    },
    /// The resource manager granted a [`Command::Acquire`].
    Granted {
        /// The instance that asked.
        instance: InstanceId,
        /// The lease.
        lease: Lease,
    },
    /// The resource manager refused an acquire for good.
    Refused {
        /// The instance that asked.
        instance: InstanceId,
        /// Why, and what the user can do.
        reason: String,
    },
    /// The world pool made the projection of a [`Command::Project`], or promised it under this id where the goal may start before it exists. If the
    /// promise is not kept, `Crashed` follows.
    Projected {
        /// The instance.
        instance: InstanceId,
        /// Its attempt.
        attempt: u32,
        /// Id of the projection.
        projection: ProjectionId,
    },
    /// Somebody else has changed the root world, or facts in it have expired.
    WorldChanged {
        /// The world pool's revision with these changes.
        revision: Revision,
        /// The facts that differ from what the run knew, with their present values; without a value: the fact is gone.
        facts: Vec<(FactKey, Option<Value>)>,
    },
    /// Another run certainly needs a resource that one of these instances holds. Sent again while it keeps waiting.
    WantedByOthers {
        /// The holders.
        holders: Vec<InstanceId>,
    },
    /// Progress of a goal. Logged; changes nothing.
    Progressed {
        /// The instance.
        instance: InstanceId,
        /// Its attempt.
        attempt: u32,
        /// The provider's message.
        message: String,
    },
    /// The goal waits before it is given to its provider: until cancelled goals have ended, or until the root contains what was decided before it. Its
    /// timeout does not count meanwhile. Only of goals with a timeout; [`Event::Given`] follows.
    Delayed {
        /// The instance.
        instance: InstanceId,
        /// Its attempt.
        attempt: u32,
    },
    /// The goal is given to its provider after a delay, or was found there by a task control that was restarted. Its timeout counts from now, unless it
    /// counts already.
    Given {
        /// The instance.
        instance: InstanceId,
        /// Its attempt.
        attempt: u32,
    },
    /// An anytime goal has its first usable result, or a better one, and goes on improving it.
    Improved {
        /// The instance.
        instance: InstanceId,
        /// Its attempt.
        attempt: u32,
        /// Its output ports.
        outputs: BTreeMap<String, Value>,
        /// Cost of the result for its user, in seconds of the robot's time (how long the planned motion takes). Each result costs less than the one
        /// before.
        cost_s: f64,
    },
    /// A goal has ended with a result from its provider.
    Finished {
        /// The instance.
        instance: InstanceId,
        /// Its attempt.
        attempt: u32,
        /// Its outcome.
        outcome: String,
        /// Its output ports.
        outputs: BTreeMap<String, Value>,
        /// Measured facts, if the provider measured facts that the effects declare.
        measured: Vec<(FactKey, Value)>,
        /// What measured them, and with which certainty, as far as the provider says so.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        evidence: Evidence,
        /// Reason, if the outcome is not success; else empty.
        reason: String,
        /// Whether it is known that nothing moves for it any more: its action has returned, and so have those of the goals that it gave. False in
        /// logs of earlier versions.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        at_rest: bool,
    },
    /// The attempt ended without an answer: the worker died, the connection broke, the lease was lost, or the world pool failed.
    Crashed {
        /// The instance.
        instance: InstanceId,
        /// Its attempt.
        attempt: u32,
        /// What is known about the cause.
        reason: String,
        /// Whether the goal may have been performed: task control was down when it ended. A motion is then not tried again.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        unknown: bool,
        /// Whether the provider refused the goal because its lease was over: nothing was begun.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        refused: bool,
    },
    /// The resource manager or the world pool did not perform an operation or commit of a retirement.
    RetirementFailed {
        /// The instance.
        instance: InstanceId,
        /// Why.
        reason: String,
        /// What was not made.
        #[serde(default, skip_serializing_if = "Unmade::is_unknown")]
        unmade: Unmade,
    },
    /// The user asks to end the run now. A second request ends it at once.
    AbortRequested {
        /// Why.
        reason: String,
        /// End at once, without the `finally` blocks: what they need is not available.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        at_once: bool,
    },
}

fn nothing() -> Value {
    Value::Null
}

/// The smallest priority of an acquire that is certain, not speculative. Speculative acquires have a smaller one.
pub const CERTAIN: i64 = 1 << 62;

/// What the shell performs, in order: commits and projections at the world pool, acquires and releases at the resource manager. The acquires of one
/// event come in the order of their priority, then its releases, so that free resources go to the most urgent. If something is deleted or consumed,
/// releases come before that.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "command", rename_all = "snake_case")]
pub enum Command {
    /// A change in an instance's life, for the log only.
    Note(Note),
    /// Ask the resource manager for resources; answered by `Granted` or `Refused`.
    Acquire {
        /// The instance.
        instance: InstanceId,
        /// Blocks, consumes and exists; granted all or nothing.
        requirements: Vec<Requirement>,
        /// Larger first. From [`CERTAIN`] on the node is certain, not speculative.
        priority: i64,
    },
    /// Withdraw an acquire that was not answered yet. If a grant crosses the withdrawal, the shell releases it.
    Withdraw {
        /// The instance.
        instance: InstanceId,
    },
    /// Make a projection: the world at revision `base` with the changes applied; answered by `Projected` or `Crashed`.
    Project {
        /// The instance.
        instance: InstanceId,
        /// Its attempt.
        attempt: u32,
        /// The root's revision below the projection.
        base: Revision,
        /// The effects of the older instances that have not retired, in program order.
        changes: Vec<Change>,
        /// The writer of each change, at the same index: the path of its instance.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        writers: Vec<Arc<str>>,
        /// The facts that the goal may read in it.
        reads: Footprint,
        /// The lease that covers the room for the projection: the instance's, or that of the routine around it.
        lease: Option<(LeaseId, FencingToken)>,
        /// Whether the projection must exist before the goal starts, because the goal changes the environment or its time is limited.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        first: bool,
    },
    /// Give a goal to a provider; answered by `Finished` or `Crashed`.
    Start {
        /// The instance.
        instance: InstanceId,
        /// Its attempt, from 1. (run, instance, attempt) is the goal's idempotent id.
        attempt: u32,
        /// The goal. Boxed, so that commands are small.
        goal: Box<Goal>,
    },
    /// Cancel a goal; its answer, if any, is ignored.
    Cancel {
        /// The instance.
        instance: InstanceId,
        /// Its attempt.
        attempt: u32,
    },
    /// Give back what an instance holds.
    Release {
        /// The instance.
        instance: InstanceId,
        /// Its lease, if it has one.
        lease: Option<LeaseId>,
        /// Its projection, if it has one.
        projection: Option<ProjectionId>,
    },
    /// Commit effects to the root world.
    Commit {
        /// The instance.
        instance: InstanceId,
        /// Path of the instance, or of the composite state at its exit; for the initial world the task's name.
        #[serde(default)]
        writer: String,
        /// The changes, in order. The root has revision `revision` afterwards.
        changes: Vec<Change>,
        /// Evidence for the facts written.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        evidence: Evidence,
        /// The root's revision after the commit.
        revision: Revision,
    },
    /// Create and delete task resources, and consume what a composite state consumes at its exit.
    Operate {
        /// The instance.
        instance: InstanceId,
        /// Creates, deletes and consumes, in order.
        operations: Vec<Requirement>,
    },
    /// Send [`Event::Woken`] at this time or as soon after it as possible.
    Wake {
        /// When. It has another name in the log, because log lines have a time of their own.
        #[serde(rename = "when")]
        at: Timestamp,
    },
    /// The run has ended; everything has been released.
    End {
        /// The task's outcome.
        outcome: String,
        /// The task's outputs, if the outcome is success.
        outputs: BTreeMap<String, Value>,
        /// Reason, if the outcome is not success; else empty.
        reason: String,
    },
}

/// A change in an instance's life.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "note", rename_all = "snake_case")]
pub enum Note {
    /// The instance was expanded into the window.
    Expanded {
        /// Its id.
        instance: InstanceId,
        /// Its state.
        state: StateId,
        /// Its path with visit numbers, `place_all[2]/plan_transfer`.
        path: String,
        /// Whether a condition on its path is undecided.
        speculative: bool,
    },
    /// A condition or a loop's list is decided.
    Decided {
        /// Its id.
        instance: InstanceId,
        /// Its path.
        path: String,
        /// The decision: `then`, `else`, or the number of elements.
        decision: String,
    },
    /// The instance would begin, but stands at a breakpoint: no PIA begins until the operator lets it go.
    Stopped {
        /// Its id.
        instance: InstanceId,
    },
    /// The instance has its resources and, if needed, its projection: its goal starts.
    Running {
        /// Its id.
        instance: InstanceId,
        /// In which attempt.
        attempt: u32,
    },
    /// The instance waits, and what it waits for has not come yet.
    Awaiting {
        /// Its id.
        instance: InstanceId,
        /// What it waits for.
        #[serde(flatten)]
        awaited: Awaited,
        /// Latest end of the wait.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        until: Option<Timestamp>,
    },
    /// The result is known.
    Finished {
        /// Its id.
        instance: InstanceId,
        /// Its outcome.
        outcome: Arc<str>,
    },
    /// The result is real.
    Retired {
        /// Its id.
        instance: InstanceId,
    },
    /// A part of a routine on a projection has ended. Its result belongs to the routine; nothing more is logged of it.
    Merged {
        /// Its id.
        instance: InstanceId,
    },
    /// The instance's result, or its running attempt, depends on something that came out otherwise: it is computed again.
    Invalidated {
        /// Its id.
        instance: InstanceId,
        /// What came out otherwise.
        reason: String,
    },
    /// The instance gives back its resources and begins again later, because a certain (not speculative) instance needs them.
    Preempted {
        /// Its id.
        instance: InstanceId,
        /// The instance that needs them; `None`: another run.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        by: Option<InstanceId>,
    },
    /// The result cache had the result of the same computation (same inputs, facts and seed): the instance takes it over.
    Reused {
        /// Its id.
        instance: InstanceId,
    },
    /// The instance is discarded: its branch is not taken, or the task ended before it.
    Squashed {
        /// Its id.
        instance: InstanceId,
    },
}

/// What a state waits for when the executive itself waits, without a provider.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "awaits", rename_all = "snake_case")]
pub enum Awaited {
    /// Nothing but the time.
    Time,
    /// A condition on the actual world.
    Condition {
        /// The condition as written.
        condition: String,
    },
    /// A signal: [`Event::Signalled`].
    Signal {
        /// The signal's name.
        signal: String,
    },
    /// An answer: [`Event::Answered`].
    Answer {
        /// The question.
        question: String,
        /// The possible answers.
        choices: Vec<String>,
        /// The answer if nobody answers in time.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        default: Option<String>,
    },
}

impl fmt::Display for Awaited {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Awaited::Time => f.write_str("its time"),
            Awaited::Condition { condition } => write!(f, "`{condition}`"),
            Awaited::Signal { signal } => write!(f, "the signal `{signal}`"),
            Awaited::Answer { question, choices, .. } => write!(f, "an answer: {question} ({})", choices.join(", ")),
        }
    }
}

/// Which part of an instance's commit and operations was not made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Unmade {
    /// Not recorded in logs of earlier versions.
    #[default]
    Unknown,
    /// Nothing was refused for good: the commit may still be made, or the operation was not tried because an earlier one failed.
    Untried,
    /// The operation of this number was tried and failed.
    Operation(u64),
}

impl Unmade {
    /// Whether the log does not say.
    #[must_use]
    pub fn is_unknown(&self) -> bool {
        *self == Unmade::Unknown
    }
}

/// A goal for a provider.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Goal {
    /// The provider of the catalogue, `path_planner`.
    pub provider: Arc<str>,
    /// Its action, `plan`.
    pub action: Arc<str>,
    /// Its input ports.
    pub inputs: BTreeMap<String, Value>,
    /// Random seed for the action.
    pub seed: u64,
    /// The lease for its resources; the provider is the resource of its own kind in it.
    pub lease: Option<Lease>,
    /// The projection it works on; `None` for a node that reads no world model.
    pub projection: Option<ProjectionId>,
    /// Expected duration, in seconds of the robot's time, if the task declares it.
    pub expected_s: Option<f64>,
    /// Timeout in seconds of the robot's time: the goal is cancelled after it.
    #[serde(default)]
    pub timeout_s: Option<f64>,
    /// For an anytime action, which may improve its first result until it is cancelled: the outputs that must not change then.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub improves: Option<Box<[String]>>,
    /// The state reads no facts, so the goal need not wait until earlier commits are confirmed. False in logs of earlier versions.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub reads_nothing: bool,
}

/// One line of an event log.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LogLine {
    /// When, in the robot's time since the start of the run.
    pub at: Timestamp,
    /// The event or command.
    #[serde(flatten)]
    pub entry: LogEntry,
}

/// An event, or a command that was decided for it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum LogEntry {
    /// An event.
    Event(Event),
    /// A command.
    Command(Command),
}
