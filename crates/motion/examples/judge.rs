//! Holds paths of another planner against the problems that they solve: `cargo run --release -p ratn-motion --example judge -- URDF SRDF PROBLEMS PATHS`.
//!
//! PATHS is what `scripts/search/vamp.cc` writes: a line per path, class, index and the positions of one posture after the other, between which the
//! path is straight. Each line of the answer: class, index, `free`, or what the exact shapes reject, looked at four times as closely as a search looks.

#![allow(clippy::print_stdout, clippy::unwrap_used, reason = "a measurement")]

use ratn_motion::exact::Exact;
use ratn_motion::mechanism::Mechanism;
use ratn_motion::problems::Problems;
use ratn_motion::space::Space;

/// Postures per radian.
const CLOSELY: f64 = 4.0 * Space::RESOLUTION as f64;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let read = |i: usize| std::fs::read_to_string(&arguments[i]).unwrap();
    let problems = Problems::parse(&read(2)).unwrap();
    let mechanism = Mechanism::read(&read(0), Some(&read(1)), &problems.joints).unwrap();
    for line in read(3).lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        let index: u64 = words[1].parse().unwrap();
        let problem = problems.classes[words[0]].iter().find(|problem| problem.index == index).unwrap();
        let positions: Vec<f64> = words[2..].iter().map(|word| word.parse().unwrap()).collect();
        let path: Vec<Vec<f64>> = positions.chunks(problems.joints.len()).map(<[f64]>::to_vec).collect();
        let touch = Exact::new(&mechanism, problem.surroundings()).touch_along(&path, CLOSELY);
        let verdict = touch.map_or_else(|| "free".to_owned(), |touch| touch.to_string());
        println!("{} {index} {verdict}", words[0]);
    }
}
