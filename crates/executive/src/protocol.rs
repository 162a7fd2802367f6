//! Events into the executive and commands out of it. Together they are the event log, line by line.

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
    /// As written: one state after the other.
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
    /// How often each outcome (of a condition: `then` and `else`; of a `while`: `again` and `done`) came, as a share of all.
    #[serde(default)]
    pub outcomes: BTreeMap<String, BTreeMap<String, f64>>,
}

/// Which run this is, so that task control can go on with it after it was killed.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Origin {
    /// Its id: the first part of every idempotent id, and the id of its session with the resource manager. Empty where nobody
    /// can resume it.
    #[serde(default)]
    pub run: String,
    /// The number of the session with which it began, as the resource manager numbers sessions: one that is made anew under the same id has
    /// another. 0 in logs of earlier versions.
    #[serde(default)]
    pub session: u64,
    /// The version of the program that runs it.
    #[serde(default)]
    pub version: String,
    /// The task file, as an absolute path.
    #[serde(default)]
    pub file: String,
    /// The state of the task's own list at which it began, where that is not the first.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<String>,
    /// The robot that it is for: the name of a built-in one, or the absolute path of its description. Empty in logs of earlier versions.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub robot: String,
    /// When it began, in milliseconds since 1970.
    #[serde(default)]
    pub began_unix_ms: u64,
    /// Paths (without visits) of PIAs beside which younger ones may run: their exceptions are imprecise.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub imprecise: Vec<String>,
    /// Its share of what several runs need, where that is not the usual one, 1; until it is resumed with another one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub share: Option<f64>,
    /// What its states are, so that a log can be read without the task. Nothing in logs of earlier versions.
    #[serde(default)]
    pub natures: Natures,
}

/// What the states of a run are.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Natures {
    /// Paths (without visits) of the actions that only compute.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub computes: Vec<String>,
    /// Paths (without visits) of the actions that look at the environment.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub senses: Vec<String>,
    /// The kinds of resources that move the robot.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub actuating: Vec<String>,
    /// Paths (without visits) of the composite states that change the world when they are left.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub changes_at_exit: Vec<String>,
}

/// What happened.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// The run begins. Always the first event, once.
    Started {
        /// The task's name.
        task: String,
        /// The task file's digest.
        digest: String,
        /// How it is executed.
        mode: Mode,
        /// Every parameter's value.
        parameters: BTreeMap<String, Value>,
        /// What every random choice of this run is derived from.
        seed: u64,
        /// The root world at the start.
        world: Vec<(FactKey, Value)>,
        /// The revision of that world.
        revision: Revision,
        /// How much of each resource kind there are, where that is known: whom a speculative holder keeps waiting follows
        /// from it.
        #[serde(default)]
        capacity: BTreeMap<String, Quantity>,
        /// What earlier runs of the task have taught.
        #[serde(default)]
        learned: Learned,
        /// The breakpoints that it begins with, as in [`Event::BreakpointsSet`].
        #[serde(default, skip_serializing_if = "<[String]>::is_empty")]
        breakpoints: Box<[String]>,
        /// Which run this is.
        #[serde(default)]
        origin: Box<Origin>,
    },
    /// Task control was gone and goes on from its log. Logged; changes nothing.
    Resumed {
        /// Its share of what several runs need, from now on, where that is another one than before.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        share: Option<f64>,
    },
    /// What the run has created, deleted and used up is so at the resource manager. Logged; changes nothing.
    Recorded {
        /// Up to this one of its [`Command::Operate`]s, which are numbered from 1.
        operation: u64,
        /// In the session of this number: the run's from now on, where it had another before.
        session: u64,
        /// What that operation has created, deleted and used up, by its requirements. Nothing where the resource manager does not say all of it, or
        /// where only more than one operation is told of.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        units: Vec<Vec<OperatedUnits>>,
        /// What the run had created before is made anew in that session: the new ids by those of before.
        #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
        renamed: BTreeMap<String, String>,
    },
    /// The session in which the run had what it held was gone when task control came back. Logged; changes nothing.
    SessionLost {
        /// The world pool's revision of the last commit that the run has made, or at which it began: up to it the run held what it works with. What
        /// others have changed behind it, they may have changed with the same resources.
        held_until: Revision,
    },
    /// The moment of a [`Command::Wake`] has come. Logged, as every event.
    Woken,
    /// A client sends a signal: the state that waits for one of this name goes on, or the next one that will.
    Signalled {
        /// Its name.
        signal: String,
        /// What is sent with it; null where nothing is.
        #[serde(default = "nothing")]
        value: Value,
    },
    /// An operator answers a question.
    Answered {
        /// Of which instance.
        instance: InstanceId,
        /// One of its choices.
        choice: String,
    },
    /// No PIA shall begin until further notice; what runs goes on, and what only computes or senses begins as ever.
    PauseRequested,
    /// PIAs may begin again.
    ResumeRequested,
    /// One PIA may begin; then it is a pause again.
    StepRequested,
    /// Before a PIA of these states or inside of them begins, it becomes a pause. These are all breakpoints from now on.
    BreakpointsSet {
        /// The paths of states, without visits.
        states: Vec<String>,
    },
    /// A look ahead found a better order: how long before the end of everything known each instance should begin.
    Advised {
        /// Seconds, by instance; it stands in for the longest remaining path.
        urgency_s: Vec<(InstanceId, f64)>,
        /// Who is held back so that others begin first; whoever was held back and is not in here is not any more.
        #[serde(default)]
        held: Vec<Held>,
    },
    /// The resource manager granted an [`Command::Acquire`].
    Granted {
        /// For which instance.
        instance: InstanceId,
        /// What.
        lease: Lease,
    },
    /// The resource manager will not grant it.
    Refused {
        /// For which instance.
        instance: InstanceId,
        /// Why, and what to do.
        reason: String,
    },
    /// The world pool made the projection of a [`Command::Project`], or has promised it under this id where it need not be there first. If nothing comes
    /// of a promise, `Crashed` follows.
    Projected {
        /// For which instance.
        instance: InstanceId,
        /// In which attempt.
        attempt: u32,
        /// Its id.
        projection: ProjectionId,
    },
    /// Somebody else has changed the root world, or facts of it have expired.
    WorldChanged {
        /// The world pool's revision in which they are so.
        revision: Revision,
        /// What holds now of what is otherwise than the run knew; a fact without a value does not.
        facts: Vec<(FactKey, Option<Value>)>,
    },
    /// Another run waits for what one of these holds, and needs it for certain. Told again where it waits longer.
    WantedByOthers {
        /// Which instances.
        holders: Vec<InstanceId>,
    },
    /// A goal says how far it is. Logged; changes nothing.
    Progressed {
        /// Which instance.
        instance: InstanceId,
        /// In which attempt.
        attempt: u32,
        /// What it says.
        message: String,
    },
    /// A goal has a result that can be used, and goes on for a better one: the first, or a better one than before.
    Improved {
        /// Which instance.
        instance: InstanceId,
        /// In which attempt.
        attempt: u32,
        /// Its output ports.
        outputs: BTreeMap<String, Value>,
        /// What it costs whoever uses it, in seconds of the robot's time: how long the planned motion takes. Each is less than the one
        /// before.
        cost_s: f64,
    },
    /// A goal has ended and says how.
    Finished {
        /// Which instance.
        instance: InstanceId,
        /// In which attempt.
        attempt: u32,
        /// Its outcome.
        outcome: String,
        /// Its output ports.
        outputs: BTreeMap<String, Value>,
        /// Facts as measured, where the provider measured any that its effects declare.
        measured: Vec<(FactKey, Value)>,
        /// What measured them and how sure that is, as far as it is said.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        evidence: Evidence,
        /// Why, when the outcome is not success; else empty.
        reason: String,
    },
    /// The attempt ended without an answer: the worker died, the connection broke, the lease was lost, the world pool failed.
    Crashed {
        /// Which instance.
        instance: InstanceId,
        /// In which attempt.
        attempt: u32,
        /// What is known of it.
        reason: String,
        /// It may have been done: nobody heard how it ended while task control was gone. What moves is not tried again then.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        unknown: bool,
    },
    /// The resource manager or world pool did not do what a retirement needs.
    RetirementFailed {
        /// Which instance.
        instance: InstanceId,
        /// Why.
        reason: String,
        /// What of it.
        #[serde(default, skip_serializing_if = "Unmade::is_unknown")]
        unmade: Unmade,
    },
    /// The user wants the run to end now. Asked for a second time it ends at once.
    AbortRequested {
        /// Why.
        reason: String,
        /// Nothing is done any more, not even what states say under `finally`: what it needs cannot be had.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        at_once: bool,
    },
}

fn nothing() -> Value {
    Value::Null
}

/// The least priority of an acquire for what is needed whatever is decided; speculative ones ask with less.
pub const CERTAIN: i64 = 1 << 62;

/// What the shell shall do. Performed in order: commits and projections reach the world pool, acquires and releases the
/// resource manager, in this order. The
/// acquires of one event come in the order of their priority and its releases last, so that what is free goes to the most urgent; where something is
/// deleted or used up, releases come before that.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "command", rename_all = "snake_case")]
pub enum Command {
    /// Nothing to do: a change in an instance's life, for the log.
    Note(Note),
    /// Ask the resource manager; answered by `Granted` or `Refused`.
    Acquire {
        /// For which instance.
        instance: InstanceId,
        /// Blocks, consumes and exists, all or nothing.
        requirements: Vec<Requirement>,
        /// Larger first; from [`CERTAIN`] on it is needed whatever is decided.
        priority: i64,
    },
    /// Withdraw an acquire that was not answered yet (a grant that crosses it is released by the shell).
    Withdraw {
        /// Of which instance.
        instance: InstanceId,
    },
    /// Make a projection: the world at `base` with the changes applied; answered by `Projected` or `Crashed`.
    Project {
        /// For which instance.
        instance: InstanceId,
        /// In which attempt.
        attempt: u32,
        /// The root's revision below it.
        base: Revision,
        /// The effects of the older instances that are not real yet, in program order.
        changes: Vec<Change>,
        /// Who makes the change at the same place, by the path of its instance.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        writers: Vec<Arc<str>>,
        /// What of it may be seen.
        reads: Footprint,
        /// What holds the room for it: the instance's lease, or that of the routine it is in.
        lease: Option<(LeaseId, FencingToken)>,
        /// Whether it has to be there before the goal begins: what that does changes the environment, or its time is limited.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        first: bool,
    },
    /// Give a provider a goal; answered by `Finished` or `Crashed`.
    Start {
        /// Which instance.
        instance: InstanceId,
        /// In which attempt, from 1. (run, instance, attempt) is the goal's idempotent id.
        attempt: u32,
        /// What to do. Apart, so that commands are small.
        goal: Box<Goal>,
    },
    /// Stop a goal; its answer, if any, is ignored.
    Cancel {
        /// Which instance.
        instance: InstanceId,
        /// In which attempt.
        attempt: u32,
    },
    /// Give back what an instance holds.
    Release {
        /// Which instance.
        instance: InstanceId,
        /// Its lease, if it has one.
        lease: Option<LeaseId>,
        /// Its projection, if it has one.
        projection: Option<ProjectionId>,
    },
    /// Make effects real in the root world.
    Commit {
        /// Whose effects.
        instance: InstanceId,
        /// The path of that instance, or of the state that is left; of the initial world the task's name.
        #[serde(default)]
        writer: String,
        /// In order. The root has revision `revision` afterwards.
        changes: Vec<Change>,
        /// What measured which of the facts that are written.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        evidence: Evidence,
        /// What the root's revision will be.
        revision: Revision,
    },
    /// Create and delete task resources, and use up what a hierarchy consumes at its exit.
    Operate {
        /// Whose annotations.
        instance: InstanceId,
        /// Creates, deletes and consumes, in order.
        operations: Vec<Requirement>,
    },
    /// Send [`Event::Woken`] at this moment or as soon after it as possible.
    Wake {
        /// When. Named otherwise in a log, whose lines have a time of their own.
        #[serde(rename = "when")]
        at: Timestamp,
    },
    /// The run has ended; everything was released before.
    End {
        /// The task's outcome.
        outcome: String,
        /// The task's outputs, when the outcome is success.
        outputs: BTreeMap<String, Value>,
        /// Why, when it is not; else empty.
        reason: String,
    },
}

/// A change in an instance's life.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "note", rename_all = "snake_case")]
pub enum Note {
    /// It is in the window now.
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
    /// A condition or a loop's collection is decided.
    Decided {
        /// Its id.
        instance: InstanceId,
        /// Its path.
        path: String,
        /// What it came to: `then`, `else`, or the number of elements.
        decision: String,
    },
    /// It would begin and stands at a breakpoint: no PIA begins until the operator lets it go.
    Stopped {
        /// Its id.
        instance: InstanceId,
    },
    /// It has its resources and, where it needs one, its projection: its goal starts.
    Running {
        /// Its id.
        instance: InstanceId,
        /// In which attempt.
        attempt: u32,
    },
    /// It waits, and what it waits for is not there yet.
    Awaiting {
        /// Its id.
        instance: InstanceId,
        /// What it waits for.
        #[serde(flatten)]
        awaited: Awaited,
        /// Until then at the most.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        until: Option<Timestamp>,
    },
    /// Its result is known.
    Finished {
        /// Its id.
        instance: InstanceId,
        /// Its outcome.
        outcome: Arc<str>,
    },
    /// Its result is real.
    Retired {
        /// Its id.
        instance: InstanceId,
    },
    /// It was part of a routine that works on a projection, and has ended: what it came to is the routine's, and no more is said of it.
    Merged {
        /// Its id.
        instance: InstanceId,
    },
    /// Its result, or what it is at, was made of something that came out otherwise: it is computed again.
    Invalidated {
        /// Its id.
        instance: InstanceId,
        /// What came out otherwise.
        reason: String,
    },
    /// It holds what another needs for which it is certain that it is needed: it gives it back and begins again later.
    Preempted {
        /// Its id.
        instance: InstanceId,
        /// Who needs it; `None`: another run.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        by: Option<InstanceId>,
    },
    /// The same was computed before, from the same inputs and facts and with the same seed: that result is its result.
    Reused {
        /// Its id.
        instance: InstanceId,
    },
    /// It is discarded: its branch is not taken, or the task ended before it.
    Squashed {
        /// Its id.
        instance: InstanceId,
    },
}

/// What a state waits for in which the executive waits itself.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "awaits", rename_all = "snake_case")]
pub enum Awaited {
    /// Nothing but the time.
    Time,
    /// A condition on the actual world.
    Condition {
        /// As it is written.
        condition: String,
    },
    /// [`Event::Signalled`].
    Signal {
        /// The signal's name.
        signal: String,
    },
    /// [`Event::Answered`].
    Answer {
        /// What is asked.
        question: String,
        /// What may be answered.
        choices: Vec<String>,
        /// The answer when nobody answers in time.
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

/// What was not made of what an instance had decided.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Unmade {
    /// Logs of earlier versions do not say.
    #[default]
    Unknown,
    /// Nothing of it was refused for good: a commit that may still be made, or what was not tried because something before it had failed.
    Untried,
    /// The operation of this number was tried.
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
    /// What the action's random choices are derived from.
    pub seed: u64,
    /// What it may use; the provider is the resource of its kind in it.
    pub lease: Option<Lease>,
    /// The world it works on; `None` for a node that reads no world model.
    pub projection: Option<ProjectionId>,
    /// How long it is expected to take, in seconds of the robot's time, where the task says so.
    pub expected_s: Option<f64>,
    /// It is cancelled when it takes longer than this, in seconds of the robot's time.
    #[serde(default)]
    pub timeout_s: Option<f64>,
    /// Where it may go on when it has a result, and improve it until it is told to stop: the outputs that stay as they were at first.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub improves: Option<Box<[String]>>,
    /// Its state reads no facts, so that it need not wait for what was decided before it. False in logs of earlier versions.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub reads_nothing: bool,
}

/// One line of an event log.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LogLine {
    /// When, in the robot's time since the start of the run.
    pub at: Timestamp,
    /// What.
    #[serde(flatten)]
    pub entry: LogEntry,
}

/// What happened, or what was decided then.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum LogEntry {
    /// An event.
    Event(Event),
    /// A command.
    Command(Command),
}
