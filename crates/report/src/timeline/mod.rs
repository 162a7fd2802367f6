//! Folds an event log into what each instance did when and why: the common basis of statistics, charts, exports and live views.
//!
//! It takes one line after the other and returns what each has changed, so that a run can be followed live, viewed at a moment
//! ([`Timeline::at`]), or read as a whole ([`Timeline::of`]). All times are in seconds of robot time since the start of the run. Only the
//! log is used, so it can be read without the task file and the system that made it.
//!
//! [`Timeline::new`] keeps every instance. [`Timeline::following`] drops instances that have left the window, so that memory does not grow
//! with the run.

pub(crate) mod explain;
mod fold;
mod improvement;
mod instance;
mod resources;

pub use improvement::Improvement;
pub use instance::{Activity, Behind, Cause, Ending, Instance, Job, Phase, Stage, Wait, Yield};
pub use resources::{Asked, Holding, Resources};

use ratn_executive::protocol::{LogLine, Mode};
use ratn_model::id::{InstanceId, Revision};
use ratn_model::value::Value;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

/// The timeline of a run, from its log so far.
#[derive(Debug, Clone)]
pub struct Timeline {
    /// The task.
    pub task: String,
    /// The run's id; empty if it cannot be resumed.
    pub run: String,
    /// The task file.
    pub file: String,
    /// The robot: the name of a built-in one, or the path of its description; empty if the log does not say.
    pub robot: String,
    /// Start of the run, in milliseconds since 1970; 0 if unknown.
    pub began_unix_ms: u64,
    /// The execution mode.
    pub mode: Mode,
    /// The seed of its random choices.
    pub seed: u64,
    /// Its parameters.
    pub parameters: BTreeMap<String, Value>,
    /// `None` if the log ends before the run does.
    pub outcome: Option<String>,
    /// The reason of the outcome; empty for success.
    pub reason: String,
    /// What ended it.
    pub ended_by: Cause,
    /// The task's outputs.
    pub outputs: BTreeMap<String, Value>,
    /// End of the run, or of the log.
    pub end_s: f64,
    /// The pauses, each from its request to its end.
    pub pauses: Vec<Span>,
    /// Number of single steps requested.
    pub steps: usize,
    /// The states before which the run pauses, by their paths without visits.
    pub breakpoints: Vec<String>,
    /// Times without task control.
    pub absences: Vec<Span>,
    /// PIAs that began beside an older one that was still running and might have failed: the older path, then the younger one.
    pub beside: Vec<(String, String)>,
    /// The commits, the latest last; limited in number.
    pub commits: VecDeque<Commit>,
    /// Holders and queues.
    pub resources: Resources,
    /// Numbers of instances by what became of them.
    pub count: Count,
    instances: BTreeMap<InstanceId, Instance>,
    left: fold::Left,
    hints: fold::Hints,
    /// The event that caused the commands following it.
    cause: Cause,
    paused: Option<f64>,
    /// The instance that would have begun when a breakpoint paused the run.
    stopped_at: Option<InstanceId>,
    /// Expanded instances without an outcome.
    open: BTreeSet<InstanceId>,
    /// Instances with a job under way.
    at_work: BTreeSet<InstanceId>,
    /// By path: the instance whose job ended last with a result, and the index of that job.
    results: BTreeMap<Arc<str>, (InstanceId, usize)>,
    /// Of the instances that were dropped.
    speculation: Speculation,
    improvements: improvement::Improvements,
}

/// An interval of time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Span {
    /// Its start.
    pub from_s: f64,
    /// Its end.
    pub to_s: f64,
}

impl Span {
    /// Its duration.
    pub fn length_s(&self) -> f64 {
        self.to_s - self.from_s
    }
}

/// A commit: changes of the root world that became real together.
#[derive(Debug, Clone, PartialEq)]
pub struct Commit {
    /// Its time.
    pub at_s: f64,
    /// The resulting revision of the root.
    pub revision: Revision,
    /// The path of the writing instance.
    pub writer: String,
    /// Number of changed facts.
    pub changes: usize,
}

/// Numbers of instances.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Count {
    /// All of them.
    pub expanded: usize,
    /// Retired instances.
    pub retired: usize,
    /// Squashed (discarded) instances.
    pub squashed: usize,
}

/// Computing and detecting that began before an older instance had ended.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Speculation {
    /// Number of jobs whose results were used.
    pub useful: usize,
    /// Total duration of those.
    pub useful_s: f64,
    /// Number of jobs whose results were discarded.
    pub wasted: usize,
    /// Total duration of those.
    pub wasted_s: f64,
    /// Number of jobs whose use is not known yet.
    pub open: usize,
}

/// What a line has changed.
#[derive(Debug, Default)]
pub struct Changed {
    /// The instance that the line is about.
    pub instance: Option<InstanceId>,
    /// Holdings that began.
    pub granted: Vec<Holding>,
    /// Holdings that ended.
    pub released: Vec<Holding>,
    /// Instances that are dropped: there will be no more news about them.
    pub left: Vec<Instance>,
}

impl Default for Timeline {
    fn default() -> Timeline {
        Timeline::new()
    }
}

impl Timeline {
    /// An empty timeline that keeps every instance.
    pub fn new() -> Timeline {
        Timeline::following(usize::MAX)
    }

    /// An empty timeline that keeps `keep` of the instances that have retired or were squashed.
    pub fn following(keep: usize) -> Timeline {
        Timeline {
            task: String::new(),
            run: String::new(),
            file: String::new(),
            robot: String::new(),
            began_unix_ms: 0,
            mode: Mode::Hsm,
            seed: 0,
            parameters: BTreeMap::new(),
            outcome: None,
            reason: String::new(),
            ended_by: Cause::Start,
            outputs: BTreeMap::new(),
            end_s: 0.0,
            pauses: Vec::new(),
            steps: 0,
            breakpoints: Vec::new(),
            absences: Vec::new(),
            beside: Vec::new(),
            commits: VecDeque::new(),
            resources: Resources::default(),
            count: Count::default(),
            instances: BTreeMap::new(),
            left: fold::Left::keeping(keep),
            hints: fold::Hints::default(),
            cause: Cause::Start,
            paused: None,
            stopped_at: None,
            open: BTreeSet::new(),
            at_work: BTreeSet::new(),
            results: BTreeMap::new(),
            speculation: Speculation::default(),
            improvements: improvement::Improvements::default(),
        }
    }

    /// The timeline of a whole log.
    pub fn of(lines: &[LogLine]) -> Timeline {
        Timeline::at(lines, f64::INFINITY)
    }

    /// The timeline of a log up to a moment, inclusive.
    pub fn at(lines: &[LogLine], moment_s: f64) -> Timeline {
        let mut run = Timeline::new();
        for line in lines.iter().take_while(|line| line.at.seconds() <= moment_s) {
            run.apply(line);
        }
        run.close();
        run
    }

    /// Time has passed without a line; in seconds of robot time.
    pub fn wait_until(&mut self, moment_s: f64) {
        self.end_s = self.end_s.max(moment_s);
    }

    /// The instances that are kept, in the order of expansion.
    pub fn instances(&self) -> impl ExactSizeIterator<Item = &Instance> + DoubleEndedIterator {
        self.instances.values()
    }

    /// An instance by its id.
    pub fn instance(&self, id: InstanceId) -> Option<&Instance> {
        self.instances.get(&id)
    }

    /// Every job with its instance.
    pub fn jobs(&self) -> impl Iterator<Item = (&Instance, &Job)> {
        self.instances().flat_map(|instance| instance.jobs.iter().map(move |job| (instance, job)))
    }

    /// The running instances with their jobs, in the order in which the jobs began.
    pub fn running(&self) -> Vec<(&Instance, &Job)> {
        let at_work = self.at_work.iter().filter_map(|id| self.instances.get(id));
        let mut all: Vec<_> = at_work.filter_map(|one| one.jobs.last().map(|job| (one, job))).collect();
        all.sort_by(|a, b| a.1.from_s.total_cmp(&b.1.from_s));
        all
    }

    /// The oldest instance that has no outcome.
    pub fn oldest_open(&self) -> Option<&Instance> {
        self.open.first().and_then(|id| self.instances.get(id))
    }

    /// Instances without an outcome that do not run, in the order of expansion.
    pub fn waiting(&self) -> impl Iterator<Item = &Instance> {
        let waits = |one: &&Instance| matches!(one.stage, Stage::Waiting | Stage::Asking | Stage::Preparing);
        self.open.iter().filter_map(|id| self.instances.get(id)).filter(waits)
    }

    /// Whether the run is paused: no PIA may begin.
    pub fn is_paused(&self) -> bool {
        self.paused.is_some()
    }

    /// The instance at whose breakpoint the run is paused.
    pub fn stopped_at(&self) -> Option<&Instance> {
        self.instance(self.stopped_at?)
    }

    /// The benefit of speculative work.
    pub fn speculation(&self) -> Speculation {
        let mut all = self.speculation;
        self.instances().for_each(|instance| all.add(instance));
        all
    }

    /// The gain from results that improved after they were first given.
    pub fn improvement(&self) -> Improvement {
        self.improvements.total()
    }
}

impl Speculation {
    fn add(&mut self, instance: &Instance) {
        for job in instance.jobs.iter().filter(|job| job.is_speculation()) {
            match instance.yield_of(job) {
                Yield::Used => (self.useful, self.useful_s) = (self.useful + 1, self.useful_s + job.length_s()),
                Yield::Lost => (self.wasted, self.wasted_s) = (self.wasted + 1, self.wasted_s + job.length_s()),
                Yield::Open => self.open += 1,
            }
        }
    }
}

#[cfg(test)]
mod tests;
