//! How many random straight lines whose poses can all be reached are followed, and how long that takes:
//! `cargo run --release -p ratn-motion --example lines -- [LINES [SEED [ROBOT]]]`, a built-in one. Times are of the processor, in microseconds: the median, and the most of
//! lines that are followed and of those that are not.

#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a program for the command line, for developers")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::arm;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::line::{line, line_of_nearest};
use ratn_motion::reach::Target;
use ratn_motion::robot::Robot;
use rustix::time::{ClockId, clock_gettime};

fn main() {
    let mut arguments = std::env::args().skip(1);
    let wanted: usize = arguments.next().map_or(150, |lines| lines.parse().unwrap());
    let seed = arguments.next().map_or(11, |seed| seed.parse().unwrap());
    let robot = Robot::built_in(&arguments.next().unwrap_or("aimm".to_owned())).unwrap();
    let reach = arm::reach(&robot);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (mut lines, mut otherwise, mut by_nearest) = (0, 0, 0);
    let mut times = [Vec::new(), Vec::new()];
    while lines < wanted {
        let start = reach.random(&mut random);
        let from = reach.pose(&start);
        let mut range = |most: f64| random.random_range(-most..most);
        let way = [range(0.4), range(0.4), range(0.4)];
        let at = |share: f64| Pose { position: std::array::from_fn(|i| from.position[i] + share * way[i]), ..from };
        let is_reached = |i: u32| {
            let postures = reach.postures(&Target::at(at(f64::from(i) / 20.0)));
            !reach.nearest(&postures, &start).is_empty()
        };
        if !(1..=20).all(is_reached) {
            continue;
        }
        lines += 1;
        let begin = now_us();
        let followed = line(&reach, &start, &at(1.0));
        times[usize::from(followed.is_err())].push(now_us() - begin);
        by_nearest += usize::from(line_of_nearest(&reach, &start, &at(1.0)).is_ok());
        if let Err(error) = followed {
            // From any other posture of the first pose; with its own random numbers, so that the lines do not depend on what is followed.
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            let postures = reach.postures(&Target::at(from));
            let mut other = || reach.anywhere(&postures, &start, &mut random);
            let others: Vec<JointVector> = (0..40).flat_map(|_| other()).take(40).collect();
            let count = others.iter().filter(|other| line(&reach, other, &at(1.0)).is_ok()).count();
            otherwise += usize::from(count > 0);
            println!("line {lines}: {error}; from {count} of {} other postures it is followed", others.len());
        }
    }
    let [followed, failed] = &mut times;
    println!(
        "{} of {lines} followed, {by_nearest} by the nearest postures; {otherwise} more from another posture of the first pose",
        followed.len()
    );
    for (what, times) in [("followed", followed), ("failed", failed)] {
        times.sort_by(f64::total_cmp);
        if let Some(most) = times.last() {
            println!(
                "{what}: median {:.0}, 95 % {:.0}, most {most:.0}",
                times[times.len() / 2],
                times[times.len() * 19 / 20]
            );
        }
    }
}

fn now_us() -> f64 {
    let now = clock_gettime(ClockId::ThreadCPUTime);
    now.tv_sec as f64 * 1e6 + now.tv_nsec as f64 / 1e3
}
