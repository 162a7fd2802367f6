//! The report on one run, and the comparison of several runs.

use super::critical::{self, Link};
use super::names::{Names, shown};
use super::statistics::{Statistics, mode_name};
use super::timeline::{Improvement, Speculation, Timeline};
use super::waiting::{self, Waiting};
use ratn_executive::protocol::Mode;
use ratn_model::program::SUCCESS;
use serde::Serialize;
use std::fmt;

/// The report on one run.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    /// How the time was spent.
    #[serde(flatten)]
    pub statistics: Statistics,
    /// What the run waited for, from its start to its end.
    pub critical_path: Vec<Link>,
    /// What instances waited for.
    pub waiting: Vec<Waiting>,
    /// The benefit of speculative work.
    pub speculation: Speculation,
    /// The gain from results that improved after they were first given.
    pub improvement: Improvement,
}

impl Report {
    /// Makes the report from a timeline.
    pub fn of(run: &Timeline) -> Report {
        Report {
            statistics: Statistics::of(run),
            critical_path: critical::path(run),
            waiting: waiting::by_cause(run),
            speculation: run.speculation(),
            improvement: run.improvement(),
        }
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.statistics)?;
        let Speculation { useful, useful_s, wasted, wasted_s, open } = self.speculation;
        if useful + wasted + open > 0 {
            writeln!(
                f,
                "\nwork ahead of time, in jobs: {useful} of use ({useful_s:.1} s), {wasted} discarded ({wasted_s:.1} s), {open} open"
            )?;
        }
        let Improvement { results, better, first_cost_s, gained_s } = self.improvement;
        if results > 0 {
            writeln!(
                f,
                "\nimproved while others went on: {better} of {results} results, by {gained_s:.1} of {first_cost_s:.1} s of motion; none of it was waited for"
            )?;
        }
        f.write_str(&critical::table(&self.critical_path))?;
        f.write_str(&waiting::table(&self.waiting))
    }
}

/// Several runs of one task with the same parameters in one mode.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Repeated {
    /// The task.
    pub task: String,
    /// Its parameters in which the runs of this task differ, for example `boxes=3`.
    pub with: Vec<String>,
    /// The execution mode.
    pub mode: Mode,
    /// Number of runs.
    pub runs: usize,
    /// Number of runs that ended with success.
    pub successes: usize,
    /// Makespans of the successful runs.
    pub makespan_s: Spread,
    /// How long at least two jobs ran concurrently.
    pub overlap_s: Spread,
    /// How long the run waited for planning.
    pub planning_waited_for_s: Spread,
}

/// The spread of a figure over several runs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Spread {
    /// The mean.
    pub mean: f64,
    /// The sample standard deviation; 0 for fewer than two runs.
    pub deviation: f64,
    /// The minimum.
    pub least: f64,
    /// The maximum.
    pub largest: f64,
}

impl Spread {
    /// The spread of these figures; all zero without figures.
    pub fn of(figures: &[f64]) -> Spread {
        let Some(first) = figures.first() else { return Spread::default() };
        let number = figures.len() as f64;
        let mean = figures.iter().sum::<f64>() / number;
        let squares: f64 = figures.iter().map(|one| (one - mean).powi(2)).sum();
        let deviation = if figures.len() > 1 { (squares / (number - 1.0)).sqrt() } else { 0.0 };
        let (least, largest) = figures.iter().fold((*first, *first), |(a, b), one| (a.min(*one), b.max(*one)));
        Spread { mean, deviation, least, largest }
    }
}

/// Groups runs of the same task with the same parameters in the same mode, in the order of their first runs.
pub fn repeated(runs: &[Timeline]) -> Vec<Repeated> {
    let mut kinds: Vec<&Timeline> = Vec::new();
    for run in runs {
        if !kinds.iter().any(|kind| is_alike(kind, run)) {
            kinds.push(run);
        }
    }
    let of = |kind: &&Timeline| {
        let all: Vec<Statistics> = runs.iter().filter(|run| is_alike(kind, run)).map(Statistics::of).collect();
        let good: Vec<&Statistics> = all.iter().filter(|run| run.outcome.as_deref() == Some(SUCCESS)).collect();
        let spread =
            |figure: fn(&Statistics) -> f64| Spread::of(&good.iter().map(|run| figure(run)).collect::<Vec<_>>());
        let others: Vec<&Timeline> = kinds.iter().filter(|other| other.task == kind.task).copied().collect();
        let differs =
            |name: &&String| others.iter().any(|other| other.parameters.get(*name) != kind.parameters.get(*name));
        Repeated {
            task: kind.task.clone(),
            with: kind
                .parameters
                .keys()
                .filter(differs)
                .map(|name| format!("{name}={}", kind.parameters[name]))
                .collect(),
            mode: kind.mode,
            runs: all.len(),
            successes: good.len(),
            makespan_s: spread(|run| run.makespan_s),
            overlap_s: spread(|run| run.overlap_s),
            planning_waited_for_s: spread(|run| run.time.planning_waited_for_s),
        }
    };
    kinds.iter().map(of).collect()
}

fn is_alike(a: &Timeline, b: &Timeline) -> bool {
    (&a.task, a.mode, &a.parameters) == (&b.task, b.mode, &b.parameters)
}

impl Repeated {
    /// The task's name, for example `fetch_boxes`, with its parameters if there are runs with other ones.
    fn name(&self) -> String {
        if self.with.is_empty() { self.task.clone() } else { format!("{} ({})", self.task, self.with.join(", ")) }
    }
}

/// A table for people, with the relative gain of CDTN if there are runs of both modes.
pub fn table(all: &[Repeated]) -> String {
    let whole: Vec<String> = all.iter().map(Repeated::name).collect();
    let names = Names::of(whole.iter().map(String::as_str), 10);
    let width = names.width;
    let spread = |spread: Spread| format!("{:.1} ± {:.1}", spread.mean, spread.deviation);
    let mut text = format!(
        "{:<width$} mode  runs  makespan s        least  largest  two at once s   planning awaited s\n",
        "task"
    );
    for (name, one) in names.iter().zip(all) {
        let runs =
            if one.successes == one.runs { one.runs.to_string() } else { format!("{}/{}", one.successes, one.runs) };
        text.push_str(&format!(
            "{name:<width$} {:<4} {runs:>5}  {:<15} {:>7.1} {:>8.1}  {:<14}  {}\n",
            mode_name(one.mode),
            spread(one.makespan_s),
            one.makespan_s.least,
            one.makespan_s.largest,
            spread(one.overlap_s),
            spread(one.planning_waited_for_s),
        ));
    }
    for cdtn in all.iter().filter(|one| one.mode == Mode::Cdtn && one.successes > 0) {
        let hsm = all.iter().find(|one| one.mode == Mode::Hsm && one.name() == cdtn.name() && one.successes > 0);
        if let Some(hsm) = hsm.filter(|hsm| hsm.makespan_s.mean > 0.0) {
            let shorter = 100.0 * (1.0 - cdtn.makespan_s.mean / hsm.makespan_s.mean);
            text.push_str(&format!("{}: CDTN is {shorter:.1} % shorter than HSM\n", shown(&cdtn.name())));
        }
    }
    text
}
