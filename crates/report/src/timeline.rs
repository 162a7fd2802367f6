//! An event log folded into what each instance did when: the common ground of statistics and charts.
//!
//! Everything is in the robot's seconds since the start of the run. Only what the log says is used, so a log can be read
//! without the task file and the system that made it.

use ratn_event_log::without_visits;
use ratn_executive::protocol::{Command, Event, Goal, LogEntry, LogLine, Mode, Note};
use ratn_model::id::InstanceId;
use ratn_model::program::WORLD_MODEL;
use ratn_model::resource::LeasedResource;
use ratn_model::value::Value;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// A run, as its log tells it.
#[derive(Debug, Clone)]
pub struct Timeline {
    /// The task.
    pub task: String,
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
    /// What the task gave.
    pub outputs: BTreeMap<String, Value>,
    /// When the run (or the log) ends.
    pub end_s: f64,
    /// From each request for a pause to its end.
    pub pauses: Vec<Span>,
    /// How many single steps were asked for.
    pub steps: usize,
    /// When task control was gone.
    pub absences: Vec<Span>,
    /// PIAs that began beside an older one that was still running and might have failed: its path, then theirs.
    pub beside: Vec<(String, String)>,
    /// In the order of expansion.
    pub instances: Vec<Instance>,
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

/// One visit of a state.
#[derive(Debug, Clone)]
pub struct Instance {
    /// Its number in the log.
    pub id: InstanceId,
    /// With visit numbers, `place_all[2]/plan_transfer`.
    pub path: String,
    /// When it waited for resources.
    pub waits: Vec<Wait>,
    /// What was done for it, by attempts.
    pub jobs: Vec<Job>,
    /// Whether it has an outcome.
    pub finished: bool,
    /// Whether it has become real.
    pub retired: bool,
    /// Whether it was discarded.
    pub squashed: bool,
    /// Its result was taken from an equal one.
    pub reused: bool,
    /// Why its result, or what it was at, did not count; once for each time.
    pub invalidations: Vec<String>,
}

/// From asking for resources to their grant.
#[derive(Debug, Clone)]
pub struct Wait {
    /// When it asked.
    pub from_s: f64,
    /// When it had them, or asked no more.
    pub to_s: f64,
    /// What was granted in the end.
    pub resources: Vec<String>,
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

/// Kinds whose holder looks at the environment, where a log does not say who does.
const LOOKING: [&str; 2] = ["Camera", "Detector"];

impl Timeline {
    /// Folds a log.
    pub fn of(lines: &[LogLine]) -> Timeline {
        let mut fold = Fold::default();
        for line in lines {
            let at = line.at.seconds();
            if line.entry == LogEntry::Event(Event::Resumed) {
                fold.run.absences.push(Span { from_s: fold.run.end_s, to_s: at });
            }
            fold.run.end_s = fold.run.end_s.max(at);
            match &line.entry {
                LogEntry::Event(event) => fold.event(at, event),
                LogEntry::Command(command) => fold.command(at, command),
            }
        }
        fold.goes_on(fold.run.end_s);
        let mut run = fold.run;
        for job in run.instances.iter_mut().flat_map(|i| &mut i.jobs).filter(|j| j.ending == Ending::Open) {
            job.to_s = run.end_s;
        }
        run
    }

    /// Every job with its instance.
    pub fn jobs(&self) -> impl Iterator<Item = (&Instance, &Job)> {
        self.instances.iter().flat_map(|instance| instance.jobs.iter().map(move |job| (instance, job)))
    }
}

#[derive(Debug)]
struct Fold {
    run: Timeline,
    index: BTreeMap<InstanceId, usize>,
    asked: BTreeMap<InstanceId, f64>,
    paused: Option<f64>,
    /// Plain paths of PIAs whose exceptions are imprecise.
    imprecise: BTreeSet<String>,
    /// Plain paths of what only computes, and of what looks at the environment.
    computes: BTreeSet<String>,
    senses: BTreeSet<String>,
    /// Kinds that move the robot; none where the log does not say.
    actuating: BTreeSet<String>,
}

impl Default for Fold {
    fn default() -> Self {
        let run = Timeline {
            task: String::new(),
            mode: Mode::Hsm,
            seed: 0,
            parameters: BTreeMap::new(),
            outcome: None,
            reason: String::new(),
            outputs: BTreeMap::new(),
            end_s: 0.0,
            pauses: Vec::new(),
            steps: 0,
            absences: Vec::new(),
            beside: Vec::new(),
            instances: Vec::new(),
        };
        let none = BTreeSet::new;
        Fold {
            run,
            index: BTreeMap::new(),
            asked: BTreeMap::new(),
            paused: None,
            imprecise: none(),
            computes: none(),
            senses: none(),
            actuating: none(),
        }
    }
}

impl Fold {
    fn event(&mut self, at: f64, event: &Event) {
        match event {
            Event::Started { task, mode, parameters, seed, origin, .. } => {
                let all = |paths: &[String]| paths.iter().cloned().collect();
                self.imprecise = all(&origin.imprecise);
                self.computes = all(&origin.natures.computes);
                self.senses = all(&origin.natures.senses);
                self.actuating = all(&origin.natures.actuating);
                self.run.task.clone_from(task);
                self.run.mode = *mode;
                self.run.parameters.clone_from(parameters);
                self.run.seed = *seed;
            }
            Event::Granted { instance, lease } => {
                if let Some(from_s) = self.asked.remove(instance) {
                    let resources = named(lease.resources.iter().map(|r| (r.kind.as_str(), r.id.as_str())));
                    self.instance(*instance).waits.push(Wait { from_s, to_s: at, resources });
                }
            }
            Event::Refused { instance, .. } => {
                self.asked.remove(instance);
            }
            Event::Finished { instance, attempt, outcome, outputs, reason, .. } => {
                self.end(*instance, *attempt, at, Ending::Outcome(outcome.clone(), reason.clone()), outputs);
            }
            Event::Crashed { instance, attempt, reason } => {
                self.end(*instance, *attempt, at, Ending::Crashed(reason.clone()), &BTreeMap::new());
            }
            Event::Projected { .. }
            | Event::Progressed { .. }
            | Event::WorldChanged { .. }
            | Event::RetirementFailed { .. }
            | Event::AbortRequested { .. }
            | Event::Resumed
            | Event::Woken
            | Event::Advised { .. } => {}
            Event::PauseRequested => _ = self.paused.get_or_insert(at),
            Event::StepRequested => {
                self.paused.get_or_insert(at);
                self.run.steps += 1;
            }
            Event::ResumeRequested => self.goes_on(at),
        }
    }

    fn command(&mut self, at: f64, command: &Command) {
        match command {
            Command::Note(Note::Expanded { instance, path, .. }) => {
                self.instance(*instance).path.clone_from(path);
            }
            Command::Note(Note::Finished { instance, .. }) => self.instance(*instance).finished = true,
            Command::Note(Note::Retired { instance }) => self.instance(*instance).retired = true,
            Command::Note(Note::Squashed { instance }) => self.instance(*instance).squashed = true,
            Command::Note(Note::Reused { instance }) => self.reuses(*instance),
            Command::Note(Note::Invalidated { instance, reason }) => {
                let instance = self.instance(*instance);
                instance.invalidations.push(reason.clone());
                if let Some(job) = instance.jobs.last_mut() {
                    job.invalidated = Some(reason.clone());
                }
            }
            Command::Note(_) => {}
            Command::Acquire { instance, .. } => {
                self.asked.insert(*instance, at);
            }
            Command::Withdraw { instance } => {
                self.asked.remove(instance);
            }
            Command::Start { instance, attempt, goal } => {
                let leased = goal.lease.iter().flat_map(|lease| &lease.resources);
                let activity = self.activity(*instance, goal);
                let ahead_of_time = self
                    .run
                    .instances
                    .iter()
                    .any(|other| other.id < *instance && !(other.finished || other.retired || other.squashed));
                if matches!(activity, Activity::Motion | Activity::Other) {
                    self.begins_beside(*instance);
                }
                let job = Job {
                    provider: goal.provider.to_string(),
                    action: goal.action.to_string(),
                    activity,
                    attempt: *attempt,
                    from_s: at,
                    to_s: at,
                    ending: Ending::Open,
                    resources: named(leased.map(|r| (r.kind.as_str(), r.id.as_str()))),
                    outputs: BTreeMap::new(),
                    ahead_of_time,
                    invalidated: None,
                    used_elsewhere: false,
                };
                self.instance(*instance).jobs.push(job);
            }
            Command::Cancel { instance, attempt } => {
                self.end(*instance, *attempt, at, Ending::Cancelled, &BTreeMap::new());
            }
            Command::End { outcome, outputs, reason } => {
                self.run.outcome = Some(outcome.clone());
                self.run.outputs.clone_from(outputs);
                self.run.reason.clone_from(reason);
            }
            Command::Project { .. }
            | Command::Release { .. }
            | Command::Commit { .. }
            | Command::Operate { .. }
            | Command::Wake { .. } => {}
        }
    }

    /// The result is that of an equal visit: of the same path, with a result. Of several, the one that ended last.
    fn reuses(&mut self, id: InstanceId) {
        self.instance(id).reused = true;
        let path = self.instance(id).path.clone();
        let equal = self.run.instances.iter_mut().filter(|other| other.path == path).flat_map(|other| &mut other.jobs);
        let with_result = equal.filter(|job| matches!(job.ending, Ending::Outcome(..)));
        if let Some(job) = with_result.max_by(|a, b| a.to_s.total_cmp(&b.to_s)) {
            job.used_elsewhere = true;
        }
    }

    fn goes_on(&mut self, at: f64) {
        if let Some(from_s) = self.paused.take() {
            self.run.pauses.push(Span { from_s, to_s: at });
        }
    }

    /// What a goal is: as the task says, else by what it holds.
    fn activity(&mut self, id: InstanceId, goal: &Goal) -> Activity {
        let state = without_visits(&self.instance(id).path);
        let holds = |is_meant: &dyn Fn(&LeasedResource) -> bool| {
            goal.lease.iter().flat_map(|lease| &lease.resources).any(is_meant)
        };
        let moves = |one: &LeasedResource| self.actuating.iter().any(|kind| one.is_a(kind));
        if goal.projection.is_some() || self.computes.contains(&state) {
            Activity::Planning
        } else if self.senses.contains(&state) || holds(&|one| LOOKING.contains(&one.kind.as_str())) {
            Activity::Detection
        } else if self.actuating.is_empty() || holds(&moves) {
            Activity::Motion
        } else {
            Activity::Other
        }
    }

    /// A PIA begins: which older ones of imprecise exceptions are still at it.
    fn begins_beside(&mut self, id: InstanceId) {
        let path = self.instance(id).path.clone();
        let open = |other: &&Instance| other.id < id && other.jobs.last().is_some_and(|job| job.ending == Ending::Open);
        let imprecise = |other: &&Instance| self.imprecise.contains(&without_visits(&other.path));
        let older = self.run.instances.iter().filter(open).filter(imprecise).map(|other| other.path.clone());
        let pairs: Vec<_> = older.map(|older| (older, path.clone())).collect();
        self.run.beside.extend(pairs);
    }

    fn end(&mut self, id: InstanceId, attempt: u32, at: f64, ending: Ending, outputs: &BTreeMap<String, Value>) {
        let open = |job: &&mut Job| job.ending == Ending::Open && job.attempt == attempt;
        if let Some(job) = self.instance(id).jobs.iter_mut().rev().find(open) {
            job.to_s = at;
            job.ending = ending;
            job.outputs.clone_from(outputs);
        }
    }

    fn instance(&mut self, id: InstanceId) -> &mut Instance {
        let instances = &mut self.run.instances;
        let index = *self.index.entry(id).or_insert_with(|| {
            let path = id.to_string();
            instances.push(Instance {
                id,
                path,
                waits: vec![],
                jobs: vec![],
                finished: false,
                retired: false,
                squashed: false,
                reused: false,
                invalidations: vec![],
            });
            instances.len() - 1
        });
        &mut instances[index]
    }
}

/// Ids of resources; room for projections is no place where something happens.
fn named<'a>(resources: impl Iterator<Item = (&'a str, &'a str)>) -> Vec<String> {
    resources.filter(|(kind, _)| *kind != WORLD_MODEL).map(|(_, id)| id.to_owned()).collect()
}
