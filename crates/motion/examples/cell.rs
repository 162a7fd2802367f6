//! Measures planning in the cell: `cargo run --release -p ratn-motion --example cell`.

#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::disallowed_methods, reason = "a measurement")]

#[path = "../tests/common/mod.rs"]
mod common;

use common::Cell;
use ratn_motion::pace::{Control, Progress};
use ratn_motion::plan::{Request, plan};
use std::time::{Duration, Instant};

/// What improvement gets in the second half of the measurement.
const BUDGET: Duration = Duration::from_millis(500);

struct Sample {
    first_ms: f64,
    done_ms: f64,
    first_rad: f64,
    rad: f64,
    duration_s: f64,
}

fn measure(cell: &Cell, request: &Request, budget: Option<Duration>) -> (ratn_motion::plan::Plan, Sample) {
    let begin = Instant::now();
    let mut first = None;
    let mut request = request.clone();
    request.improvement_iterations = if budget.is_some() { usize::MAX } else { 0 };
    let plan = plan(&cell.robot, &cell.scene, &request, &mut |progress| {
        if let Progress::FirstPath { .. } = progress {
            first = Some(begin.elapsed());
        }
        let over = first.is_some() && budget.is_some_and(|b| begin.elapsed() > b);
        if over { Control::TimeUp } else { Control::Continue }
    });
    let plan = plan.unwrap();
    let sample = Sample {
        first_ms: first.unwrap().as_secs_f64() * 1e3,
        done_ms: begin.elapsed().as_secs_f64() * 1e3,
        first_rad: plan.first_length_rad,
        rad: plan.length_rad,
        duration_s: plan.trajectory.duration_s(),
    };
    (plan, sample)
}

fn median(mut values: Vec<f64>, share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values[((values.len() - 1) as f64 * share) as usize]
}

fn main() {
    for budget in [None, Some(BUDGET)] {
        println!("budget {budget:?}: first path ms (median, p95), all ms, first rad, final rad, duration s");
        let mut samples: [Vec<Sample>; 3] = Default::default();
        for seed in 0..if budget.is_some() { 2 } else { 20 } {
            let mut cell = Cell::with_boxes(9, seed);
            for i in 0..9 {
                let name = format!("box_{}", i + 1);
                for (kind, list) in samples.iter_mut().enumerate() {
                    let request = match kind {
                        0 => cell.approach(&name),
                        1 => cell.transfer(&name, i),
                        _ => cell.retract(),
                    };
                    let (plan, sample) = measure(&cell, &Request { seed, ..request }, budget);
                    list.push(sample);
                    cell.follow(&plan);
                    match kind {
                        0 => cell.grasp(&name),
                        1 => cell.release(&name),
                        _ => {}
                    }
                }
            }
        }
        for (kind, list) in ["approach", "transfer", "retract"].iter().zip(&samples) {
            let of = |f: fn(&Sample) -> f64, share| median(list.iter().map(f).collect(), share);
            println!(
                "{kind:9} {:8.2} {:8.2}  {:8.2} {:6.2} {:6.2} {:6.2}",
                of(|s| s.first_ms, 0.5),
                of(|s| s.first_ms, 0.95),
                of(|s| s.done_ms, 0.5),
                of(|s| s.first_rad, 0.5),
                of(|s| s.rad, 0.5),
                of(|s| s.duration_s, 0.5),
            );
        }
    }
}
