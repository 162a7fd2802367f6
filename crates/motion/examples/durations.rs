//! How long the motions take that carry nine boxes from the table to the deck, as the task `fetch_boxes` does:
//! `cargo run -p ratn-motion --example durations`. The same iterations each time, so two runs differ by what the code does.

#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::disallowed_methods, reason = "a measurement")]

#[path = "../tests/common/mod.rs"]
mod common;

use common::Cell;
use ratn_motion::plan::Request;
use std::time::Instant;

/// How many tables full of boxes.
const TABLES: u64 = 4;

/// Steps of improvement per motion.
const ITERATIONS: usize = 300;

fn main() {
    for speed in [0.3, 1.0] {
        let mut sums = [0.0; 3];
        let mut points = 0;
        let begin = Instant::now();
        for seed in 0..TABLES {
            let mut cell = Cell::with_boxes(9, seed);
            cell.improvement_iterations = ITERATIONS;
            for i in 0..9 {
                let name = format!("box_{}", i + 1);
                for (kind, sum) in sums.iter_mut().enumerate() {
                    let request = match kind {
                        0 => cell.approach(&name),
                        1 => cell.transfer(&name, i),
                        _ => cell.retract(),
                    };
                    let plan = cell.plan(&Request { seed, speed, ..request }).unwrap();
                    *sum += plan.trajectory.duration_s();
                    points += plan.trajectory.points.len();
                    cell.follow(&plan);
                    match kind {
                        0 => cell.grasp(&name),
                        1 => cell.release(&name),
                        _ => {}
                    }
                }
            }
        }
        let motions = 27 * TABLES;
        let [approach, transfer, retract] = sums;
        println!(
            "{{\"speed\": {speed}, \"motions\": {motions}, \"approach_s\": {approach:.2}, \"transfer_s\": {transfer:.2}, \
             \"retract_s\": {retract:.2}, \"total_s\": {:.2}, \"points\": {points}, \"planned_in_s\": {:.1}}}",
            sums.iter().sum::<f64>(),
            begin.elapsed().as_secs_f64()
        );
    }
}
