//! An event log folded into what each instance did when and why: the common ground of statistics, charts, exports and live views.
//!
//! It takes one line after the other and says what each has changed, so that a run can be followed while it goes on, looked at as it was
//! at a moment ([`Timeline::at`]), or read as a whole ([`Timeline::of`]). Everything is in the robot's seconds since the start of the run.
//! Only what the log says is used, so a log can be read without the task file and the system that made it.
//!
//! [`Timeline::new`] keeps every instance. [`Timeline::following`] gives those away that have left the window, so that what is kept
//! does not grow with the run.

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

/// A run, as its log tells it so far.
#[derive(Debug, Clone)]
pub struct Timeline {
    /// The task.
    pub task: String,
    /// Its id; empty where nobody can resume it.
    pub run: String,
    /// The task file.
    pub file: String,
    /// The robot: the name of a built-in one, or the path of its description; empty where the log does not say.
    pub robot: String,
    /// When it began, in milliseconds since 1970; 0 where that is not said.
    pub began_unix_ms: u64,
    /// How it was executed.
    pub mode: Mode,
    /// What its random choices were derived from.
    pub seed: u64,
    /// Its parameters.
    pub parameters: BTreeMap<String, Value>,
    /// `None` when the log ends before the run does.
    pub outcome: Option<String>,
    /// Why it ended so; empty for a success.
    pub reason: String,
    /// What ended it.
    pub ended_by: Cause,
    /// What the task gave.
    pub outputs: BTreeMap<String, Value>,
    /// When the run (or the log) ends.
    pub end_s: f64,
    /// From each request for a pause to its end.
    pub pauses: Vec<Span>,
    /// How many single steps were asked for.
    pub steps: usize,
    /// Before which states the run pauses, by their paths without visits.
    pub breakpoints: Vec<String>,
    /// When task control was gone.
    pub absences: Vec<Span>,
    /// PIAs that began beside an older one that was still running and might have failed: its path, then theirs.
    pub beside: Vec<(String, String)>,
    /// What became real, the latest last; as many as are kept.
    pub commits: VecDeque<Commit>,
    /// Holders and queues.
    pub resources: Resources,
    /// What became of the instances.
    pub count: Count,
    instances: BTreeMap<InstanceId, Instance>,
    left: fold::Left,
    hints: fold::Hints,
    /// The event that the commands which follow it were made of.
    cause: Cause,
    paused: Option<f64>,
    /// What would have begun, when a breakpoint paused the run.
    stopped_at: Option<InstanceId>,
    /// Expanded, and without an outcome.
    open: BTreeSet<InstanceId>,
    /// With a job under way.
    at_work: BTreeSet<InstanceId>,
    /// By path, whose job ended last with a result, and which of its jobs that was.
    results: BTreeMap<Arc<str>, (InstanceId, usize)>,
    /// Of the instances that were given away.
    speculation: Speculation,
    improvements: improvement::Improvements,
}

/// A time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Span {
    /// When it begins.
    pub from_s: f64,
    /// When it ends.
    pub to_s: f64,
}

impl Span {
    /// How long it is.
    pub fn length_s(&self) -> f64 {
        self.to_s - self.from_s
    }
}

/// Changes of the root world that became real together.
#[derive(Debug, Clone, PartialEq)]
pub struct Commit {
    /// When.
    pub at_s: f64,
    /// The root's revision since.
    pub revision: Revision,
    /// Who wrote it, by path.
    pub writer: String,
    /// How many facts.
    pub changes: usize,
}

/// How many instances there were.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Count {
    /// All of them.
    pub expanded: usize,
    /// Those that have become real.
    pub retired: usize,
    /// Those that were discarded.
    pub squashed: usize,
}

/// Computing and looking that began before something older had ended.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Speculation {
    /// Jobs whose results are real.
    pub useful: usize,
    /// How long those took.
    pub useful_s: f64,
    /// Jobs whose results were discarded.
    pub wasted: usize,
    /// How long those took.
    pub wasted_s: f64,
    /// Jobs of which it is not known yet.
    pub open: usize,
}

/// What a line has changed.
#[derive(Debug, Default)]
pub struct Changed {
    /// The instance that the line is about.
    pub instance: Option<InstanceId>,
    /// What is held since.
    pub granted: Vec<Holding>,
    /// What is held no more.
    pub released: Vec<Holding>,
    /// Instances that are given away: nothing more will be said of them.
    pub left: Vec<Instance>,
}

impl Default for Timeline {
    fn default() -> Timeline {
        Timeline::new()
    }
}

impl Timeline {
    /// Nothing has happened yet. Every instance is kept.
    pub fn new() -> Timeline {
        Timeline::following(usize::MAX)
    }

    /// Nothing has happened yet. Of the instances that have become real or were discarded `keep` are kept.
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

    /// Of a whole log.
    pub fn of(lines: &[LogLine]) -> Timeline {
        Timeline::at(lines, f64::INFINITY)
    }

    /// Of a log up to a moment, that moment included.
    pub fn at(lines: &[LogLine], moment_s: f64) -> Timeline {
        let mut run = Timeline::new();
        for line in lines.iter().take_while(|line| line.at.seconds() <= moment_s) {
            run.apply(line);
        }
        run.close();
        run
    }

    /// Time has passed without a line, in the robot's seconds.
    pub fn wait_until(&mut self, moment_s: f64) {
        self.end_s = self.end_s.max(moment_s);
    }

    /// The instances that are kept, in the order of expansion.
    pub fn instances(&self) -> impl ExactSizeIterator<Item = &Instance> + DoubleEndedIterator {
        self.instances.values()
    }

    /// One of them.
    pub fn instance(&self, id: InstanceId) -> Option<&Instance> {
        self.instances.get(&id)
    }

    /// Every job with its instance.
    pub fn jobs(&self) -> impl Iterator<Item = (&Instance, &Job)> {
        self.instances().flat_map(|instance| instance.jobs.iter().map(move |job| (instance, job)))
    }

    /// The instances that a provider is at, with what it does, those that began first first.
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

    /// Instances without an outcome that no provider is at, in the order of expansion.
    pub fn waiting(&self) -> impl Iterator<Item = &Instance> {
        let waits = |one: &&Instance| matches!(one.stage, Stage::Waiting | Stage::Asking | Stage::Preparing);
        self.open.iter().filter_map(|id| self.instances.get(id)).filter(waits)
    }

    /// Whether no PIA is to begin.
    pub fn is_paused(&self) -> bool {
        self.paused.is_some()
    }

    /// The instance at whose breakpoint the run is paused.
    pub fn stopped_at(&self) -> Option<&Instance> {
        self.instance(self.stopped_at?)
    }

    /// What work ahead of time was good for.
    pub fn speculation(&self) -> Speculation {
        let mut all = self.speculation;
        self.instances().for_each(|instance| all.add(instance));
        all
    }

    /// What results gained that got better after they were given.
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
