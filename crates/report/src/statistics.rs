//! How the time of a run was spent.
//!
//! Every moment of a run counts once in [`Shares`]: to motion if anything moves, else to detection, else to other work, else to planning
//! that everything waits for, else to idle time; the shares add up to the makespan.

use super::names::{Names, shown};
use super::timeline::{Activity, Ending, Job, Span, Timeline};
use ratn_event_log::without_visits;
use ratn_executive::protocol::Mode;
use ratn_model::readable::{in_line, readable};
use ratn_model::value::Value;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::{self, Write as _};

/// The figures of a log. Times are in seconds of robot time.
#[derive(Debug, Clone, Serialize)]
pub struct Statistics {
    /// The task.
    pub task: String,
    /// The execution mode.
    pub mode: Mode,
    /// `None` if the log ends before the run does.
    pub outcome: Option<String>,
    /// The reason of the outcome; empty for success.
    pub reason: String,
    /// From the start of the run to its end.
    pub makespan_s: f64,
    /// How the time was spent.
    pub time: Shares,
    /// Sum of the durations of all jobs.
    pub work_s: f64,
    /// How long at least two jobs ran concurrently.
    pub overlap_s: f64,
    /// How long no PIA could begin, because the user had paused the run.
    pub paused_s: f64,
    /// Number of single steps by the user.
    pub steps: usize,
    /// How long task control was gone; jobs under way then went on, or were stopped by their provider.
    pub away_s: f64,
    /// PIAs that began beside an older one whose exceptions are imprecise.
    pub imprecise: Vec<ImpreciseOverlap>,
    /// Numbers of instances by what became of them.
    pub instances: Instances,
    /// Work on projected worlds.
    pub ahead_of_time: AheadOfTime,
    /// How busy each resource was.
    pub resources: Vec<Busy>,
    /// By state, in the order of their first visits.
    pub states: Vec<StateTime>,
    /// The paths that were planned.
    pub plans: Vec<Plan>,
}

/// The makespan, divided by activity.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct Shares {
    /// Motion.
    pub motion_s: f64,
    /// Detection, without motion.
    pub detection_s: f64,
    /// Work that is neither motion nor detection nor computing.
    #[serde(skip_serializing_if = "is_nothing")]
    pub other_s: f64,
    /// Only planning ran, and everything else waited for it.
    pub planning_waited_for_s: f64,
    /// Nothing ran.
    pub idle_s: f64,
}

fn is_nothing(seconds: &f64) -> bool {
    *seconds == 0.0
}

/// Numbers of instances.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct Instances {
    /// All of them.
    pub expanded: usize,
    /// Retired instances.
    pub retired: usize,
    /// Squashed (discarded) instances.
    pub squashed: usize,
    /// Attempts that ended without an answer.
    pub crashed_attempts: usize,
    /// Number of results that were invalidated because something turned out differently.
    pub invalidated: usize,
    /// Number of instances that reused the result of an equal one.
    pub reused: usize,
}

/// A PIA that began while another PIA with imprecise exceptions ran.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ImpreciseOverlap {
    /// Path of the older PIA, which might have failed.
    pub older: String,
    /// Path of the younger PIA, whose effects would have stayed.
    pub younger: String,
}

/// Computing and detecting jobs that began before an earlier expanded instance had finished.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct AheadOfTime {
    /// Jobs whose results were used.
    pub used: usize,
    /// Jobs whose results were discarded.
    pub squashed: usize,
}

/// How long a resource was in use.
#[derive(Debug, Clone, Serialize)]
pub struct Busy {
    /// Its id.
    pub resource: String,
    /// How long a job held it.
    pub busy_s: f64,
    /// The same as a fraction of the makespan.
    pub share: f64,
}

/// The times of one state, all visits together.
#[derive(Debug, Clone, Serialize)]
pub struct StateTime {
    /// Its path without visit numbers.
    pub state: String,
    /// Number of its jobs that have run.
    pub runs: usize,
    /// Total duration of these jobs.
    pub total_s: f64,
    /// Duration of the longest job.
    pub longest_s: f64,
    /// Waiting time for resources.
    pub waited_s: f64,
}

/// How a planner used its time.
#[derive(Debug, Clone, Serialize)]
pub struct Plan {
    /// The instance's path.
    pub instance: String,
    /// The planner.
    pub resource: String,
    /// Time from the planner's start to the first path.
    pub first_path_s: f64,
    /// The length of the first path in joint space.
    pub first_length_rad: f64,
    /// The length of the resulting path.
    pub length_rad: f64,
    /// The planning time.
    pub planning_s: f64,
    /// By how much the rest of the budget shortened the first path, in percent.
    pub shortened_percent: f64,
}

impl Statistics {
    /// Computes the statistics from a timeline.
    pub fn of(run: &Timeline) -> Statistics {
        let jobs: Vec<&Job> = run.jobs().map(|(_, job)| job).collect();
        let (time, overlap_s) = divide(run.end_s, &jobs);
        Statistics {
            task: run.task.clone(),
            mode: run.mode,
            outcome: run.outcome.clone(),
            reason: run.reason.clone(),
            makespan_s: run.end_s,
            time,
            // The sum of an empty sequence would be -0.
            work_s: jobs.iter().map(|job| job.to_s - job.from_s).fold(0.0, |all, one| all + one),
            overlap_s,
            paused_s: run.pauses.iter().map(Span::length_s).fold(0.0, |all, one| all + one),
            steps: run.steps,
            away_s: run.absences.iter().map(Span::length_s).fold(0.0, |all, one| all + one),
            imprecise: run
                .beside
                .iter()
                .map(|(older, younger)| ImpreciseOverlap { older: older.clone(), younger: younger.clone() })
                .collect(),
            instances: Instances {
                expanded: run.count.expanded,
                retired: run.count.retired,
                squashed: run.count.squashed,
                invalidated: run.instances().map(|i| i.invalidations.len()).sum(),
                reused: run.instances().filter(|i| i.reused).count(),
                crashed_attempts: jobs.iter().filter(|job| matches!(job.ending, Ending::Crashed(_))).count(),
            },
            ahead_of_time: ahead_of_time(run),
            resources: busy(run),
            states: states(run),
            plans: run.jobs().filter_map(|(instance, job)| plan(&instance.path, job)).collect(),
        }
    }
}

/// Sweeps over the starts and ends of all jobs; between two of them nothing changes.
fn divide(end_s: f64, jobs: &[&Job]) -> (Shares, f64) {
    let lasting = jobs.iter().filter(|job| job.to_s > job.from_s);
    let mut edges: Vec<(f64, Option<(usize, bool)>)> = lasting
        .flat_map(|job| {
            [(job.from_s, true), (job.to_s, false)].map(|(at, begins)| (at, Some((job.activity as usize, begins))))
        })
        .chain([(end_s, None)])
        .collect();
    edges.sort_by(|a, b| a.0.total_cmp(&b.0));
    // By activity: number of running jobs and accumulated time of the first activity with a running job; the last entry is idle time.
    let (mut running, mut spent_s) = ([0_usize; 4], [0.0; 5]);
    let (mut from_s, mut overlap_s) = (0.0, 0.0);
    for (at_s, edge) in edges {
        let length = at_s - from_s;
        spent_s[running.iter().position(|count| *count > 0).unwrap_or(running.len())] += length;
        if running.iter().sum::<usize>() > 1 {
            overlap_s += length;
        }
        from_s = at_s;
        match edge {
            Some((activity, true)) => running[activity] += 1,
            Some((activity, false)) => running[activity] -= 1,
            None => {}
        }
    }
    let [motion_s, detection_s, other_s, planning_waited_for_s, idle_s] = spent_s;
    (Shares { motion_s, detection_s, other_s, planning_waited_for_s, idle_s }, overlap_s)
}

fn ahead_of_time(run: &Timeline) -> AheadOfTime {
    let mut count = AheadOfTime::default();
    for instance in run.instances() {
        let ahead = || {
            instance
                .jobs
                .iter()
                .filter(|job| job.ahead_of_time && matches!(job.activity, Activity::Detection | Activity::Planning))
        };
        if ahead().next().is_some() {
            let used_elsewhere = ahead().any(|job| job.used_elsewhere);
            count.used += usize::from(instance.retired || used_elsewhere);
            count.squashed += usize::from(instance.squashed && !used_elsewhere);
        }
    }
    count
}

fn busy(run: &Timeline) -> Vec<Busy> {
    let mut of: BTreeMap<&str, f64> = BTreeMap::new();
    for (_, job) in run.jobs() {
        for resource in &job.resources {
            *of.entry(resource).or_default() += job.to_s - job.from_s;
        }
    }
    let share = |busy_s: f64| if run.end_s > 0.0 { busy_s / run.end_s } else { 0.0 };
    of.into_iter().map(|(id, busy_s)| Busy { resource: id.to_owned(), busy_s, share: share(busy_s) }).collect()
}

fn states(run: &Timeline) -> Vec<StateTime> {
    let mut order: Vec<StateTime> = Vec::new();
    let mut places: BTreeMap<String, usize> = BTreeMap::new();
    for instance in run.instances().filter(|i| !i.jobs.is_empty()) {
        let state = without_visits(&instance.path);
        let at = *places.entry(state).or_insert_with_key(|state| {
            let state = state.clone();
            order.push(StateTime { state, runs: 0, total_s: 0.0, longest_s: 0.0, waited_s: 0.0 });
            order.len() - 1
        });
        let entry = &mut order[at];
        for job in &instance.jobs {
            entry.runs += 1;
            entry.total_s += job.to_s - job.from_s;
            entry.longest_s = entry.longest_s.max(job.to_s - job.from_s);
        }
        entry.waited_s += instance.waits.iter().map(|wait| wait.to_s - wait.from_s).sum::<f64>();
    }
    order
}

fn plan(path: &str, job: &Job) -> Option<Plan> {
    let number = |name: &str| job.outputs.get(name).and_then(Value::as_number);
    let (first_length_rad, length_rad) = (number("first_length_rad")?, number("length_rad")?);
    Some(Plan {
        instance: path.to_owned(),
        resource: job.resources.first().cloned().unwrap_or_default(),
        first_path_s: number("first_path_s")?,
        first_length_rad,
        length_rad,
        planning_s: number("planning_s")?,
        shortened_percent: if first_length_rad > 0.0 { 100.0 * (1.0 - length_rad / first_length_rad) } else { 0.0 },
    })
}

/// The mode's name as people write it.
pub fn mode_name(mode: Mode) -> &'static str {
    match mode {
        Mode::Hsm => "HSM",
        Mode::Cdtn => "CDTN",
    }
}

impl fmt::Display for Statistics {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (task, outcome) = (shown(&self.task), shown(self.outcome.as_deref().unwrap_or("unfinished")));
        writeln!(f, "{task} in {} mode: {outcome} after {:.1} s", mode_name(self.mode), self.makespan_s)?;
        if !self.reason.is_empty() {
            writeln!(f, "  because {}", readable(&self.reason))?;
        }
        let percent = |seconds: f64| if self.makespan_s > 0.0 { 100.0 * seconds / self.makespan_s } else { 0.0 };
        writeln!(f, "\nwhere the time went            s      %")?;
        for (what, seconds) in [
            ("motion", self.time.motion_s),
            ("detection", self.time.detection_s),
            ("other work", self.time.other_s),
            ("planning waited for", self.time.planning_waited_for_s),
            ("idle", self.time.idle_s),
        ]
        .into_iter()
        .filter(|(what, seconds)| *what != "other work" || *seconds > 0.0)
        {
            writeln!(f, "  {what:<22} {seconds:>7.1} {:>6.1}", percent(seconds))?;
        }
        writeln!(
            f,
            "  {:.1} s of work in {:.1} s, at least two things at once for {:.1} s",
            self.work_s, self.makespan_s, self.overlap_s
        )?;
        writeln!(
            f,
            "  {} instances expanded, {} retired, {} squashed; begun ahead of time: {} used, {} squashed; {} crashed attempts",
            self.instances.expanded,
            self.instances.retired,
            self.instances.squashed,
            self.ahead_of_time.used,
            self.ahead_of_time.squashed,
            self.instances.crashed_attempts
        )?;
        self.incidents(f)?;
        let names = Names::of(self.resources.iter().map(|r| r.resource.as_str()), 22);
        let width = names.width;
        writeln!(f, "\n{:<w$} busy s      %", "resource", w = width + 2)?;
        for (name, r) in names.iter().zip(&self.resources) {
            writeln!(f, "  {name:<width$} {:>7.1} {:>6.1}", r.busy_s, 100.0 * r.share)?;
        }
        let names = Names::of(self.states.iter().map(|s| s.state.as_str()), 22);
        let width = names.width;
        writeln!(f, "\n{:<w$} runs  total s longest s  waited s", "state", w = width + 2)?;
        for (name, s) in names.iter().zip(&self.states) {
            writeln!(f, "  {name:<width$} {:>4} {:>8.1} {:>9.1} {:>9.1}", s.runs, s.total_s, s.longest_s, s.waited_s)?;
        }
        f.write_str(&plan_table(&self.plans))
    }
}

impl Statistics {
    /// Events that do not happen in most runs.
    fn incidents(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Instances { invalidated, reused, .. } = self.instances;
        if invalidated > 0 || reused > 0 {
            writeln!(f, "  results invalidated and computed again: {invalidated}; taken from an equal one: {reused}")?;
        }
        if self.paused_s > 0.0 || self.steps > 0 {
            writeln!(f, "  paused for {:.1} s; single steps: {}", self.paused_s, self.steps)?;
        }
        if self.away_s > 0.0 {
            writeln!(f, "  task control was gone for {:.1} s", self.away_s)?;
        }
        if let Some(ImpreciseOverlap { older, younger }) = self.imprecise.first() {
            let (all, younger, older) = (self.imprecise.len(), in_line(younger), in_line(older));
            writeln!(
                f,
                "  exceptions were imprecise: {younger} began beside {older}, which might have failed ({all} in all)"
            )?;
        }
        Ok(())
    }
}

/// A table of the plans for people; empty without plans.
pub fn plan_table(plans: &[Plan]) -> String {
    let mut text = String::new();
    if plans.is_empty() {
        return text;
    }
    let names = Names::of(plans.iter().map(|p| p.instance.as_str()), 22);
    let width = names.width;
    let _ = writeln!(text, "\n{:<w$} first path s  planned s  first rad  final rad  shortened", "plan", w = width + 2);
    for (name, p) in names.iter().zip(plans) {
        let _ = writeln!(
            text,
            "  {name:<width$} {:>12.3} {:>10.1} {:>10.2} {:>10.2} {:>9.1}%",
            p.first_path_s, p.planning_s, p.first_length_rad, p.length_rad, p.shortened_percent
        );
    }
    text
}
