//! `ratn simulate --jobshop FILE`: a scheduling problem that nobody here has made, as a task, in virtual time.

use crate::arguments::SimulateArguments;
use crate::failure::Failure;
use crate::{input, output};
use anyhow::anyhow;
use ratn_model::program::SUCCESS;
use ratn_simulation::jobshop::{JobShop, best_known};
use serde::Serialize;

/// What came of it.
#[derive(Debug, Serialize)]
struct Comparison {
    /// The file's name without its ending.
    instance: String,
    makespan: f64,
    best_known: Option<f64>,
    /// Of the makespan to the best known.
    ratio: Option<f64>,
}

/// Runs the instance and compares.
pub(crate) fn run(arguments: &SimulateArguments) -> Result<(), Failure> {
    let file = arguments.jobshop.display();
    let text = input::read(&arguments.jobshop)
        .map_err(|error| Failure::Refused(format!("{file}: cannot be read: {error}")))?;
    let shop = JobShop::parse(&text).map_err(|error| Failure::Refused(format!("{file}: no job shop: {error}")))?;
    let run = shop.execute(arguments.orders, arguments.seed)?;
    if run.outcome != SUCCESS {
        return Err(anyhow!("the task ended with {}: {}", run.outcome, run.reason).into());
    }
    let instance = arguments.jobshop.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let best_known = arguments.best.or_else(|| best_known(&instance));
    let ratio = best_known.map(|best| (run.end_s / best * 1e4).round() / 1e4);
    let comparison = Comparison { instance, makespan: (run.end_s * 1e6).round() / 1e6, best_known, ratio };
    if arguments.json {
        output::result(serde_json::to_string(&comparison)?)
    } else {
        output::result(sentence(&comparison))
    }
    .map_err(Failure::from)
}

fn sentence(comparison: &Comparison) -> String {
    let Comparison { instance, makespan, .. } = comparison;
    match (comparison.best_known, comparison.ratio) {
        (Some(best), Some(ratio)) => format!("{instance}: makespan {makespan}, best known {best}, ratio {ratio:.4}"),
        _ => format!("{instance}: makespan {makespan}; give the best known one with --best"),
    }
}
