//! How many straight departures are found among random boxes from postures that are free, and how long that takes:
//! `cargo run --release -p ratn-motion --example departures -- [COUNT [SEED [ROBOT [BOXES]]]]`, a built-in robot. Only lines count whose poses the tool
//! reaches in some posture, free or not. Times are of the processor, in microseconds, of whole plans back to the start, and of refusals.

#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a program for the command line, for developers")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::arm;
use ratn_motion::collision::{Checker, Contact, PADDING_M};
use ratn_motion::pace::Control;
use ratn_motion::plan::{Goal, PlanError, Request, plan};
use ratn_motion::reach::Target;
use ratn_motion::robot::{Configuration, Robot};
use ratn_motion::straight::{Frame, Straight};
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};
use rustix::time::{ClockId, clock_gettime};

fn main() {
    let mut arguments = std::env::args().skip(1);
    let wanted: usize = arguments.next().map_or(150, |count| count.parse().unwrap());
    let seed = arguments.next().map_or(11, |seed| seed.parse().unwrap());
    let robot = Robot::built_in(&arguments.next().unwrap_or("aimm".to_owned())).unwrap();
    let boxes: usize = arguments.next().map_or(12, |count| count.parse().unwrap());
    let reach = arm::reach(&robot);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (mut tried, mut times) = (0, [Vec::new(), Vec::new()]);
    while tried < wanted {
        let start = reach.random(&mut random);
        let from = reach.pose(&start);
        let mut range = |most: f64| random.random_range(-most..most);
        let way = [range(0.25), range(0.25), range(0.25)];
        let at = |share: f64| Pose { position: std::array::from_fn(|i| from.position[i] + share * way[i]), ..from };
        let mut thing = |i: usize| {
            let around = [range(0.7), range(0.7), range(0.7)];
            let position = std::array::from_fn(|i| from.position[i] + around[i]);
            let pose = Pose::from_rpy(position, range(3.0), range(1.5), range(3.0));
            let size = [0.04 + range(0.03), 0.15 + range(0.1), 0.15 + range(0.1)];
            let placement = Placement::World(pose);
            SceneObject { name: format!("box {i}"), shape: Shape::Box { size }, placement }
        };
        let scene = Scene { base: Pose::IDENTITY, objects: (0..boxes).map(&mut thing).collect() };
        let is_reached = |i: u32| {
            let postures = reach.postures(&Target::at(at(f64::from(i) / 10.0)));
            !reach.nearest(&postures, &start).is_empty()
        };
        let here = Configuration { arm: start, ..arm::assumed(&robot, &scene) };
        let is_free = Checker::new(&robot, &scene, &here, PADDING_M).is_free(&start, Contact::None);
        if !is_free || !(1..=10).all(is_reached) {
            continue;
        }
        tried += 1;
        let length_m = way.iter().map(|c| c * c).sum::<f64>().sqrt();
        let depart = Straight { direction: way, frame: Frame::Base, length_m };
        let goals = vec![Goal::Joints(start)];
        let request = Request { depart, ..Request::new(here, goals) };
        let begin = now_us();
        let found = plan(&robot, &scene, &request, &mut |_| Control::Continue);
        let is_refused = matches!(found, Err(PlanError::Depart { .. } | PlanError::StartInCollision { .. }));
        times[usize::from(is_refused)].push(now_us() - begin);
    }
    println!("{} of {tried} departures found", times[0].len());
    for (what, times) in ["found", "refused"].into_iter().zip(&mut times) {
        times.sort_by(f64::total_cmp);
        if let Some(most) = times.last() {
            let at = |share: usize| times[(times.len() - 1) * share / 100];
            println!("{what}: median {:.0}, 95 % {:.0}, most {most:.0}", at(50), at(95));
        }
    }
}

fn now_us() -> f64 {
    let now = clock_gettime(ClockId::ThreadCPUTime);
    now.tv_sec as f64 * 1e6 + now.tv_nsec as f64 / 1e3
}
