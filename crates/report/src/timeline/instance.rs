//! One visit of a state: its stages, what ended each, what it waited for, and the jobs done for it.
//!
//! ```text
//! waiting ──► asking ──► preparing ──► running ──► finished ──► retired
//!    ▲          │            │            │            │
//!    └──────────┴────────────┴────────────┴────────────┘   refused, crashed, preempted, invalidated
//! ```
//! Every stage can end with `squashed`. A state that needs no provider goes from `waiting` to `finished`.

use ratn_executive::protocol::Goal;
use ratn_model::id::InstanceId;
use ratn_model::value::Value;
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::Arc;

/// The stage of an instance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// It is in the window and has not requested resources.
    Waiting,
    /// It has requested resources from the resource manager.
    Asking,
    /// It has its resources; its goal has not been given yet, because a projection is being made.
    Preparing,
    /// A provider performs its goal.
    Running,
    /// It has a result, which has not retired.
    Finished,
    /// Its result has retired.
    Retired,
    /// It was discarded.
    Squashed,
}

impl Stage {
    /// The stage's name.
    pub fn name(self) -> &'static str {
        match self {
            Stage::Waiting => "waiting",
            Stage::Asking => "asking",
            Stage::Preparing => "preparing",
            Stage::Running => "running",
            Stage::Finished => "finished",
            Stage::Retired => "retired",
            Stage::Squashed => "squashed",
        }
    }
}

/// What ended a stage: the event in the log whose commands began the next one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Cause {
    /// The run began.
    Start,
    /// An instance (with its path) ended, or an attempt of it.
    Result(InstanceId, Arc<str>),
    /// The resource manager answered this instance.
    Answer(InstanceId, Arc<str>),
    /// The world pool made the projection of this instance.
    Projected(InstanceId, Arc<str>),
    /// The world was changed from outside.
    World,
    /// A time was reached: the next attempt, or a timeout.
    Time,
    /// A command of the operator.
    Operator,
    /// A client sent this signal.
    Signal(Arc<str>),
    /// The look-ahead found a better order.
    Advice,
    /// Another run needed resources that an instance held.
    AnotherRun,
    /// Task control resumed the run.
    Resumed,
}

impl Cause {
    /// The instance that the cause names, if any.
    pub fn instance(&self) -> Option<InstanceId> {
        match self {
            Cause::Result(id, _) | Cause::Answer(id, _) | Cause::Projected(id, _) => Some(*id),
            Cause::Start
            | Cause::World
            | Cause::Time
            | Cause::Operator
            | Cause::Signal(_)
            | Cause::Advice
            | Cause::AnotherRun
            | Cause::Resumed => None,
        }
    }

    /// The cause as the object of the phrase "waits for".
    pub fn awaited(&self) -> String {
        match self {
            Cause::Start => "the start".to_owned(),
            Cause::Result(_, path) => path.to_string(),
            Cause::Answer(_, path) => format!("the resources of {path}"),
            Cause::Projected(_, path) => format!("the projection of {path}"),
            Cause::World => "a change of the world from outside".to_owned(),
            Cause::Time => "a moment: a next try or a timeout".to_owned(),
            Cause::Operator => "the operator".to_owned(),
            Cause::Signal(signal) => format!("the signal `{signal}`"),
            Cause::Advice => "a better order".to_owned(),
            Cause::AnotherRun => "what another run needs".to_owned(),
            Cause::Resumed => "task control".to_owned(),
        }
    }
}

/// A stage that is over.
#[derive(Debug, Clone, PartialEq)]
pub struct Phase {
    /// The stage.
    pub stage: Stage,
    /// When it began.
    pub from_s: f64,
    /// When it ended.
    pub to_s: f64,
    /// What ended it.
    pub ended_by: Cause,
}

/// One visit of a state.
#[derive(Debug, Clone)]
pub struct Instance {
    /// Its number in the log.
    pub id: InstanceId,
    /// Its path with visit numbers, `place_all[2]/plan_transfer`.
    pub path: Arc<str>,
    /// A condition on its path was undecided when it was expanded.
    pub speculative: bool,
    /// When it was expanded.
    pub expanded_s: f64,
    /// The cause of its expansion.
    pub expanded_by: Cause,
    /// Its earlier stages, the oldest first.
    pub phases: Vec<Phase>,
    /// Its present stage.
    pub stage: Stage,
    /// When the present stage began.
    pub since_s: f64,
    /// Its decision, if it decides.
    pub decision: Option<String>,
    /// Paths of the instances whose effects its projection shows.
    pub writers: Vec<Arc<str>>,
    /// Its waits for resources.
    pub waits: Vec<Wait>,
    /// The jobs done for it, by attempts.
    pub jobs: Vec<Job>,
    /// Number of jobs that have not ended.
    pub(super) open_jobs: usize,
    /// Whether it has an outcome.
    pub finished: bool,
    /// Its outcome.
    pub outcome: Option<Arc<str>>,
    /// Whether it has retired.
    pub retired: bool,
    /// Whether it was discarded.
    pub squashed: bool,
    /// What a waiting state waits for: a condition, a time, a signal, an answer.
    pub awaits: Option<String>,
    /// Since when a waiting state has waited, or had waited until its end, and for what.
    pub awaited_itself: Option<(f64, String)>,
    /// Whether its result was reused from an equal instance.
    pub reused: bool,
    /// Why its result, or its job, was invalidated; one entry per time.
    pub invalidations: Vec<String>,
}

impl Instance {
    pub(super) fn new(id: InstanceId, at_s: f64, expanded_by: Cause) -> Instance {
        Instance {
            id,
            path: id.to_string().into(),
            speculative: false,
            expanded_s: at_s,
            expanded_by,
            phases: Vec::new(),
            stage: Stage::Waiting,
            since_s: at_s,
            decision: None,
            writers: Vec::new(),
            waits: Vec::new(),
            jobs: Vec::new(),
            open_jobs: 0,
            finished: false,
            outcome: None,
            retired: false,
            squashed: false,
            awaits: None,
            awaited_itself: None,
            reused: false,
            invalidations: Vec::new(),
        }
    }

    /// Enters a stage. A stage of no duration is not recorded, except waiting: what ended the wait is the cause.
    pub(super) fn enter(&mut self, stage: Stage, at_s: f64, cause: &Cause) {
        if self.stage == stage {
            return;
        }
        if at_s > self.since_s || self.stage == Stage::Waiting {
            let (from_s, to_s) = (self.since_s, at_s.max(self.since_s));
            self.phases.push(Phase { stage: self.stage, from_s, to_s, ended_by: cause.clone() });
        }
        (self.stage, self.since_s) = (stage, at_s);
    }

    /// A waiting state begins to wait for its own condition. Before that it had waited for its turn.
    pub(super) fn begins_to_await(&mut self, at_s: f64, awaited: String, cause: &Cause) {
        if self.stage == Stage::Waiting && self.awaits.is_none() {
            let now_s = at_s.max(self.since_s);
            let from_s = std::mem::replace(&mut self.since_s, now_s);
            self.phases.push(Phase { stage: self.stage, from_s, to_s: self.since_s, ended_by: cause.clone() });
            self.awaited_itself = Some((self.since_s, awaited.clone()));
        }
        self.awaits = Some(awaited);
    }

    /// Whether nothing more will happen to it, except that an equal instance may reuse its result.
    pub fn has_left(&self) -> bool {
        self.retired || self.squashed
    }

    /// The waits after which it went on; the last wait of an instance that was discarded instead is not included.
    pub fn awaited(&self) -> impl DoubleEndedIterator<Item = &Phase> {
        let goes_on = |index: usize| {
            let next = self.phases.get(index + 1).map_or(self.stage, |phase| phase.stage);
            !matches!(next, Stage::Squashed | Stage::Waiting)
        };
        let waits =
            self.phases.iter().enumerate().filter(move |(index, one)| one.stage == Stage::Waiting && goes_on(*index));
        waits.map(|(_, phase)| phase)
    }

    /// Whether a job was of use.
    pub fn yield_of(&self, job: &Job) -> Yield {
        let failed = job.invalidated.is_some() || matches!(job.ending, Ending::Crashed(_) | Ending::Cancelled);
        match (job.used_elsewhere, failed || self.squashed) {
            (true, _) => Yield::Used,
            (false, true) => Yield::Lost,
            (false, false) if self.retired => Yield::Used,
            (false, false) => Yield::Open,
        }
    }
}

/// Whether work was of use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Yield {
    /// Its result was used.
    Used,
    /// Its result was discarded.
    Lost,
    /// Not known yet.
    Open,
}

/// A wait for resources, from the request to the grant.
#[derive(Debug, Clone)]
pub struct Wait {
    /// Time of the request.
    pub from_s: f64,
    /// Time of the grant, or of the withdrawal.
    pub to_s: f64,
    /// The kinds requested, without room for projections.
    pub kinds: Vec<String>,
    /// The resources that were granted.
    pub resources: Vec<String>,
    /// Instances of this run that held resources of these kinds meanwhile, the longest holding first.
    pub behind: Vec<Behind>,
}

/// A holder of what another instance waited for.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Behind {
    /// The holder.
    #[serde(skip)]
    pub instance: InstanceId,
    /// The holder's path.
    pub holder: Arc<str>,
    /// The resource.
    pub resource: Arc<str>,
    /// Start of the holding, also if it is before the wait.
    pub from_s: f64,
    /// End of the holding; the end of the wait if it was still held then.
    pub to_s: f64,
    /// Whether it was released during the wait.
    pub released: bool,
}

/// A job, from giving a goal to a provider to the goal's end.
#[derive(Debug, Clone)]
pub struct Job {
    /// The provider.
    pub provider: String,
    /// The action.
    pub action: String,
    /// Its activity.
    pub activity: Activity,
    /// The attempt, from 1.
    pub attempt: u32,
    /// When it began.
    pub from_s: f64,
    /// When it ended.
    pub to_s: f64,
    /// How it ended.
    pub ending: Ending,
    /// Ids of the resources that it held, without room for projections; the performing one first.
    pub resources: Vec<String>,
    /// Its outputs.
    pub outputs: BTreeMap<String, Value>,
    /// Whether an earlier expanded instance had not finished when this job began.
    pub ahead_of_time: bool,
    /// Why the job had to be repeated, if it had to.
    pub invalidated: Option<String>,
    /// Whether another visit, or a later attempt, used its result.
    pub used_elsewhere: bool,
}

impl Job {
    pub(super) fn begun(at_s: f64, attempt: u32, goal: &Goal, activity: Activity, ahead_of_time: bool) -> Job {
        let leased = goal.lease.iter().flat_map(|lease| &lease.resources);
        Job {
            provider: goal.provider.to_string(),
            action: goal.action.to_string(),
            activity,
            attempt,
            from_s: at_s,
            to_s: at_s,
            ending: Ending::Open,
            resources: super::resources::named(leased),
            outputs: BTreeMap::new(),
            ahead_of_time,
            invalidated: None,
            used_elsewhere: false,
        }
    }

    /// Its duration; for a job that has not ended, its duration so far.
    pub fn length_s(&self) -> f64 {
        self.to_s - self.from_s
    }

    /// Whether it computed or detected before an earlier expanded instance had finished.
    pub fn is_speculation(&self) -> bool {
        self.ahead_of_time && matches!(self.activity, Activity::Detection | Activity::Planning)
    }
}

/// The activity of a job, as far as a log tells.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Activity {
    /// It changes the environment.
    Motion,
    /// It looks at the environment.
    Detection,
    /// It may change the environment, but holds nothing that moves the robot.
    Other,
    /// It works on a projection.
    Planning,
}

/// How a job ended.
#[derive(Debug, Clone, PartialEq)]
pub enum Ending {
    /// With an outcome and, when it is not success, the reason.
    Outcome(String, String),
    /// Without an answer.
    Crashed(String),
    /// Cancelled: it was told to stop.
    Cancelled,
    /// The log ends before the job does.
    Open,
}
