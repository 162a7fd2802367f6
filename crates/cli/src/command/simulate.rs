//! `ratn simulate`: runs published scheduling problems as tasks in virtual time.

use crate::arguments::SimulateArguments;
use crate::failure::Failure;
use crate::{input, output};
use anyhow::anyhow;
use ratn_model::program::SUCCESS;
use ratn_simulation::activities::{Activities, Execution};
use ratn_simulation::jobshop::{JobShop, best_known};
use ratn_simulation::psplib;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;

/// The result of a job shop.
#[derive(Debug, Serialize)]
struct Comparison {
    /// The file's name without its extension.
    instance: String,
    makespan: f64,
    best_known: Option<f64>,
    /// Ratio of the makespan to the best known one or, where durations vary, to that of a run that knows the
    /// durations.
    ratio: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    clairvoyant: Option<f64>,
}

/// The result of a project.
#[derive(Debug, Serialize)]
struct ProjectComparison {
    #[serde(flatten)]
    comparison: Comparison,
    /// A lower bound of the makespan: the longest path, and the total work of each resource.
    lower_bound: f64,
}

/// The results of all projects.
#[derive(Debug, Serialize)]
struct Projects {
    projects: Vec<ProjectComparison>,
    /// Over the projects that have a ratio.
    mean_ratio: Option<f64>,
    worst_ratio: Option<f64>,
}

/// Runs the instances and compares.
pub(crate) fn run(arguments: &SimulateArguments) -> Result<(), Failure> {
    match &arguments.jobshop {
        Some(file) => job_shop(arguments, file),
        None => projects(arguments),
    }
}

fn job_shop(arguments: &SimulateArguments, file: &Path) -> Result<(), Failure> {
    let shop = JobShop::parse(&read(file)?)
        .map_err(|error| Failure::Refused(format!("{}: no job shop: {error}", file.display())))?;
    let instance = name(file);
    let best = arguments.best.or_else(|| best_known(&instance));
    let comparison = compare(arguments, instance, &shop.activities(), best)?;
    if arguments.json {
        output::result(serde_json::to_string(&comparison)?)?;
    } else {
        output::result(sentence(&comparison, "give the best known one with --best"))?;
    }
    Ok(())
}

fn projects(arguments: &SimulateArguments) -> Result<(), Failure> {
    let best = match &arguments.best_known {
        Some(file) => table(&read(file)?)
            .map_err(|problem| Failure::Refused(format!("{}: no table of makespans: {problem}", file.display())))?,
        None => BTreeMap::new(),
    };
    // All files are read before any is run.
    let mut all = Vec::new();
    for file in &arguments.project {
        let activities = psplib::parse(&read(file)?)
            .map_err(|error| Failure::Refused(format!("{}: no project: {error}", file.display())))?;
        all.push((name(file), activities));
    }
    let mut projects = Vec::new();
    for (instance, activities) in all {
        let best = best.get(&instance).copied();
        let comparison = compare(arguments, instance, &activities, best)?;
        let lower_bound = rounded(activities.lower_bound_s(), 1e6);
        if !arguments.json {
            let line = sentence(&comparison, "give a table of best known ones with --best-known");
            if !output::line(format_args!("{line}; at least {lower_bound}"))? {
                return Ok(());
            }
        }
        projects.push(ProjectComparison { comparison, lower_bound });
    }
    let ratios: Vec<f64> = projects.iter().filter_map(|project| project.comparison.ratio).collect();
    let mean_ratio = (!ratios.is_empty()).then(|| rounded(ratios.iter().sum::<f64>() / ratios.len() as f64, 1e4));
    let worst_ratio = ratios.iter().copied().reduce(f64::max);
    if arguments.json {
        output::result(serde_json::to_string(&Projects { projects, mean_ratio, worst_ratio })?)?;
    } else if let (Some(mean), Some(worst), true) = (mean_ratio, worst_ratio, projects.len() > 1) {
        output::result(format_args!("{} projects: mean ratio {mean:.4}, worst {worst:.4}", ratios.len()))?;
    }
    Ok(())
}

fn read(file: &Path) -> Result<String, Failure> {
    input::read(file).map_err(|error| Failure::Refused(format!("{}: cannot be read: {error}", file.display())))
}

/// The file's name without its extension.
fn name(file: &Path) -> String {
    file.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// The last number of each line, by the name before the first comma; a first line without a number is a heading.
fn table(text: &str) -> Result<BTreeMap<String, f64>, String> {
    let mut best = BTreeMap::new();
    for (at, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let cells = line.split_once(',').map(|(file, rest)| (file.trim(), rest.rsplit(',').next().unwrap_or(rest)));
        let number = |cell: &str| cell.trim().parse::<f64>().ok().filter(|best| *best > 0.0 && best.is_finite());
        match cells.and_then(|(file, last)| Some((file, number(last)?))) {
            Some((file, makespan)) => drop(best.insert(file.trim_end_matches(".sm").to_owned(), makespan)),
            None if at == 0 => {}
            None => return Err(format!("line {}: expected `file,…,makespan`, found `{line}`", at + 1)),
        }
    }
    Ok(best)
}

fn compare(
    arguments: &SimulateArguments,
    instance: String,
    activities: &Activities,
    best_known: Option<f64>,
) -> Result<Comparison, Failure> {
    let vary = arguments.vary.unwrap_or(0.0);
    let execution = Execution { orders: arguments.orders, seed: arguments.seed, vary, is_clairvoyant: false };
    let makespan = execute(activities, execution)?;
    let clairvoyant = match arguments.vary {
        Some(_) => Some(execute(activities, Execution { is_clairvoyant: true, ..execution })?),
        None => None,
    };
    // Best known makespans are for the estimated durations.
    let reference = if clairvoyant.is_some() { clairvoyant } else { best_known };
    Ok(Comparison {
        instance,
        makespan: rounded(makespan, 1e6),
        best_known,
        ratio: reference.filter(|reference| *reference > 0.0).map(|reference| rounded(makespan / reference, 1e4)),
        clairvoyant: clairvoyant.map(|seconds| rounded(seconds, 1e6)),
    })
}

fn execute(activities: &Activities, execution: Execution) -> Result<f64, Failure> {
    let run = activities.execute(execution)?;
    if run.outcome != SUCCESS {
        return Err(anyhow!("the task ended with {}: {}", run.outcome, run.reason).into());
    }
    Ok(run.end_s)
}

fn rounded(number: f64, parts: f64) -> f64 {
    (number * parts).round() / parts
}

fn sentence(comparison: &Comparison, help: &str) -> String {
    let Comparison { instance, makespan, .. } = comparison;
    match (comparison.clairvoyant, comparison.best_known, comparison.ratio) {
        (Some(known), _, Some(ratio)) => {
            format!("{instance}: makespan {makespan}, with durations known {known}, ratio {ratio:.4}")
        }
        (None, Some(best), Some(ratio)) => {
            format!("{instance}: makespan {makespan}, best known {best}, ratio {ratio:.4}")
        }
        _ => format!("{instance}: makespan {makespan}; {help}"),
    }
}

#[cfg(test)]
mod tests {
    use super::table;

    #[test]
    fn a_table_has_a_makespan_by_file_and_may_have_a_heading_and_a_bound() {
        let best = table("instance,lower_bound,best_known\nj301_1.sm,43,44\n\nj302_1, 51\n");
        assert_eq!(best, Ok([("j301_1".to_owned(), 44.0), ("j302_1".to_owned(), 51.0)].into()));
        let refused = table("j301_1,43\nj302_1,fast\n").map(|_| ());
        assert_eq!(refused, Err("line 2: expected `file,…,makespan`, found `j302_1,fast`".to_owned()));
    }
}
