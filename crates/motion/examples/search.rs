//! Measures search and simplification on the problems of a file, a line per problem:
//! `cargo run --release -p ratn-motion --example search -- URDF SRDF PROBLEMS [REPEAT [CLASS [ITERATIONS [SEED [ISA]]]]]`.
//! ISA is the instruction set, of what the processor has: `avx512`, `avx2`, `neon` or `plain`.
//!
//! Each line: class, index, outcome, search and simplification in µs of processor time (the least of all repetitions), samples drawn, length
//! before and after simplification, and what the exact shapes reject. `scripts/search/compare.py` puts VAMP beside it.

#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::disallowed_methods, reason = "a measurement")]

use ratn_motion::connect::{Budget, ConnectError};
use ratn_motion::mechanism::Mechanism;
use ratn_motion::problems::Problems;
use ratn_motion::space::Isa;
use ratn_motion::trial::{self, Settings};
use rustix::time::{ClockId, clock_gettime};

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let read = |i: usize| std::fs::read_to_string(&arguments[i]).unwrap();
    let number = |i: usize, other: usize| arguments.get(i).map_or(other, |text| text.parse().unwrap());
    let problems = Problems::parse(&read(2)).unwrap();
    let mechanism = Mechanism::read(&read(0), Some(&read(1)), &problems.joints).unwrap();
    let budget = Budget { iterations: number(5, 1_000_000), seed: number(6, 1) as u64 };
    let isa = arguments
        .get(7)
        .map_or(Isa::detect(), |name| Isa::available().into_iter().find(|isa| isa.name() == name).unwrap());
    let settings = Settings { budget, repetitions: number(3, 1), limit: f64::INFINITY };
    let only = arguments.get(4).filter(|class| !class.is_empty());
    let mut clock = || {
        let time = clock_gettime(ClockId::ThreadCPUTime);
        time.tv_sec as f64 * 1e6 + time.tv_nsec as f64 * 1e-3
    };
    for (class, list) in problems.classes.iter().filter(|(class, _)| only.is_none_or(|only| only == *class)) {
        for problem in list {
            let trial = trial::run_with_isa(&mechanism, problem, settings, isa, &mut clock);
            let times = format!("{:.3} {:.3}", trial.plan, trial.simplify);
            match trial.outcome {
                Ok(found) => {
                    let touch = found.touch.map_or_else(String::new, |touch| touch.to_string());
                    let (before, after, samples) = (found.first_length_rad, found.length_rad, found.iterations);
                    println!("{class} {} solved {times} {samples} {before:.4} {after:.4} {touch}", problem.index);
                }
                Err(ConnectError::Start | ConnectError::Goal { .. }) => {
                    println!("{class} {} invalid {}", problem.index, trial.diagnosis.join("; "));
                }
                Err(error) => println!("{class} {} failed {times} {error}", problem.index),
            }
        }
    }
}
