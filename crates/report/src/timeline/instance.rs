//! One visit of a state: the stages it went through, what ended each, what it waited for and what was done for it.
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

/// Where an instance is in its life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// It is in the window and has not asked for resources.
    Waiting,
    /// It has asked the resource manager.
    Asking,
    /// It has its resources; its goal has not been given, as a projection is being made.
    Preparing,
    /// A provider is at it.
    Running,
    /// Its result is known and not real yet.
    Finished,
    /// Its result is real.
    Retired,
    /// It was discarded.
    Squashed,
}

impl Stage {
    /// As a word.
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

/// What made a stage end: the event of the log on which the next one was commanded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Cause {
    /// The run began.
    Start,
    /// An instance, named by its path, ended or its attempt did.
    Result(InstanceId, Arc<str>),
    /// The resource manager answered this instance.
    Answer(InstanceId, Arc<str>),
    /// The world pool made the projection of this instance.
    Projected(InstanceId, Arc<str>),
    /// Somebody else changed the world.
    World,
    /// A moment had come: the next try, a timeout.
    Time,
    /// The operator said so.
    Operator,
    /// A client sent this signal.
    Signal(Arc<str>),
    /// A look ahead found a better order.
    Advice,
    /// Another run needed what an instance held.
    AnotherRun,
    /// Task control came back.
    Resumed,
}

impl Cause {
    /// The instance whose answer it was.
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

    /// What was waited for, as it stands behind "waits for".
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
    /// Which.
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
    /// With visit numbers, `place_all[2]/plan_transfer`.
    pub path: Arc<str>,
    /// A condition on its path was undecided when it was expanded.
    pub speculative: bool,
    /// When it was expanded.
    pub expanded_s: f64,
    /// What it was expanded on.
    pub expanded_by: Cause,
    /// The stages it has left, the oldest first.
    pub phases: Vec<Phase>,
    /// Where it is.
    pub stage: Stage,
    /// Since when.
    pub since_s: f64,
    /// What it decided, where it decides.
    pub decision: Option<String>,
    /// Who wrote what its projection shows, by path.
    pub writers: Vec<Arc<str>>,
    /// When it waited for resources.
    pub waits: Vec<Wait>,
    /// What was done for it, by attempts.
    pub jobs: Vec<Job>,
    /// How many of them have not ended.
    pub(super) open_jobs: usize,
    /// Whether it has an outcome.
    pub finished: bool,
    /// Its outcome.
    pub outcome: Option<Arc<str>>,
    /// Whether it has become real.
    pub retired: bool,
    /// Whether it was discarded.
    pub squashed: bool,
    /// What it waits for by itself: a condition, a time, a signal, an answer.
    pub awaits: Option<String>,
    /// Since when it has waited so, or had until its end, and for what.
    pub awaited_itself: Option<(f64, String)>,
    /// Its result was taken from an equal one.
    pub reused: bool,
    /// Why its result, or what it was at, did not count; once for each time.
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

    /// Goes into a stage. What began and ended at once is no stage it was in, except that it waited: what ended that is its cause.
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

    /// What it waits for by itself is not there yet. It had waited for its turn before.
    pub(super) fn begins_to_await(&mut self, at_s: f64, awaited: String, cause: &Cause) {
        if self.stage == Stage::Waiting && self.awaits.is_none() {
            let now_s = at_s.max(self.since_s);
            let from_s = std::mem::replace(&mut self.since_s, now_s);
            self.phases.push(Phase { stage: self.stage, from_s, to_s: self.since_s, ended_by: cause.clone() });
            self.awaited_itself = Some((self.since_s, awaited.clone()));
        }
        self.awaits = Some(awaited);
    }

    /// Nothing of it is still to come, except that an equal one takes its result.
    pub fn has_left(&self) -> bool {
        self.retired || self.squashed
    }

    /// The times for which it waited before it went on; the last one of an instance that was discarded instead is not among them.
    pub fn awaited(&self) -> impl DoubleEndedIterator<Item = &Phase> {
        let goes_on = |index: usize| {
            let next = self.phases.get(index + 1).map_or(self.stage, |phase| phase.stage);
            !matches!(next, Stage::Squashed | Stage::Waiting)
        };
        let waits =
            self.phases.iter().enumerate().filter(move |(index, one)| one.stage == Stage::Waiting && goes_on(*index));
        waits.map(|(_, phase)| phase)
    }

    /// What came of a job.
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
    /// Its result is real.
    Used,
    /// Its result was discarded.
    Lost,
    /// That is not known yet.
    Open,
}

/// From asking for resources to their grant.
#[derive(Debug, Clone)]
pub struct Wait {
    /// When it asked.
    pub from_s: f64,
    /// When it had them, or asked no more.
    pub to_s: f64,
    /// The kinds that it asked for, room for projections left out.
    pub kinds: Vec<String>,
    /// What was granted in the end.
    pub resources: Vec<String>,
    /// Who of this run held something of these kinds meanwhile, the one that held longest first.
    pub behind: Vec<Behind>,
}

/// Somebody who held what another waited for.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Behind {
    /// Who.
    #[serde(skip)]
    pub instance: InstanceId,
    /// By path.
    pub holder: Arc<str>,
    /// What was held.
    pub resource: Arc<str>,
    /// Since when, also before the wait began.
    pub from_s: f64,
    /// Until when; the end of the wait where it still was.
    pub to_s: f64,
    /// It was given back during the wait.
    pub released: bool,
}

/// From giving a provider a goal to its end.
#[derive(Debug, Clone)]
pub struct Job {
    /// Whoever did it.
    pub provider: String,
    /// What the provider was asked to do.
    pub action: String,
    /// What it is.
    pub activity: Activity,
    /// From 1.
    pub attempt: u32,
    /// When it began.
    pub from_s: f64,
    /// When it ended.
    pub to_s: f64,
    /// How it ended.
    pub ending: Ending,
    /// Ids of the resources that it held, room for projections left out; first the performing one.
    pub resources: Vec<String>,
    /// What came of it.
    pub outputs: BTreeMap<String, Value>,
    /// Some instance that was expanded earlier had not finished when this began.
    pub ahead_of_time: bool,
    /// Why it had to be done again, where it had to.
    pub invalidated: Option<String>,
    /// Another visit took its result, or a later try of the same.
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

    /// How long it took; of one that has not ended, so far.
    pub fn length_s(&self) -> f64 {
        self.to_s - self.from_s
    }

    /// It computed or looked before an instance that was expanded earlier had finished.
    pub fn is_speculation(&self) -> bool {
        self.ahead_of_time && matches!(self.activity, Activity::Detection | Activity::Planning)
    }
}

/// What a job is, as far as a log tells.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Activity {
    /// It changes the environment.
    Motion,
    /// It looks at the environment.
    Detection,
    /// It may change the environment, and holds nothing that moves the robot.
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
    /// It was told to stop.
    Cancelled,
    /// The log ends before it.
    Open,
}
