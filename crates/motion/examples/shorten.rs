//! Measures what shortens and times paths, and the checks that all of it is made of: `cargo run --release -p ratn-motion --example shorten -- WHAT [URDF SRDF PROBLEMS]`.
//! WHAT is `batch`, `simplify`, `time`, `refine` and shares of its ways, as in `refine:42,38,8,11,1:42,38,8,0,12`, or `quicken` and a speed: how
//! long motions take after improvement by length and by duration. Beside the file's problems,
//! if there is one, the robots among random things of four kinds.

#![allow(
    clippy::print_stdout,
    clippy::unwrap_used,
    clippy::disallowed_methods,
    clippy::panic,
    reason = "a measurement"
)]

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::connect::{Budget, connect};
use ratn_motion::geometry::Geometry;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::mechanism::{MAX_JOINTS, Mechanism};
use ratn_motion::pace::Control;
use ratn_motion::problems::Problems;
use ratn_motion::refine::{End, Measure, Refinement, Shares};
use ratn_motion::simplify::{path_length, simplify};
use ratn_motion::space::{Isa, Obstacle, Space, State};
use ratn_motion::timing::rough::Rough;
use ratn_motion::timing::{Section, timed};
use std::time::Instant;

const BUDGET: Budget = Budget { iterations: 20_000, seed: 1 };

fn go_on(_: usize) -> Control {
    Control::Continue
}

struct Task {
    class: String,
    mechanism: usize,
    obstacles: Vec<Obstacle>,
    start: State,
    goal: State,
}

fn state(positions: &[f64]) -> State {
    std::array::from_fn(|j| positions.get(j).map_or(0.0, |q| *q as f32))
}

fn random_pose(random: &mut impl Rng, reach: f64) -> Pose {
    let mut range = |most: f64| random.random_range(-most..most);
    Pose::from_rpy([range(reach), range(reach), range(reach)], range(3.1), range(1.5), range(3.1))
}

fn geometry(random: &mut impl Rng, kind: usize, least: f64, most: f64) -> Geometry {
    let mut size = || random.random_range(least..most);
    match kind % 4 {
        0 => Geometry::Box { half: [size(), size(), size()] },
        1 => Geometry::Cylinder { radius: size(), half_length: size() },
        2 => Geometry::Capsule { radius: size(), half_length: size() },
        _ => Geometry::Sphere { radius: size() },
    }
}

/// Things all about the robot, few and large, or many and small, or upright poles, or walls with gaps.
fn scene(random: &mut impl Rng, class: &str) -> Vec<Obstacle> {
    let name = |i: usize| format!("thing {i}");
    match class {
        "few large" => (0..8)
            .map(|i| Obstacle {
                name: name(i),
                pose: random_pose(random, 1.0),
                geometry: geometry(random, i, 0.05, 0.15),
            })
            .collect(),
        "many small" => (0..60)
            .map(|i| Obstacle {
                name: name(i),
                pose: random_pose(random, 1.0),
                geometry: geometry(random, i, 0.01, 0.05),
            })
            .collect(),
        "poles" => (0..14)
            .map(|i| {
                let (angle, far) = (random.random_range(-3.1_f64..3.1), random.random_range(0.3..0.8));
                let pose = Pose::at(far * angle.cos(), far * angle.sin(), 0.4);
                Obstacle { name: name(i), pose, geometry: Geometry::Cylinder { radius: 0.02, half_length: 0.5 } }
            })
            .collect(),
        _ => (0..6)
            .map(|i| {
                let geometry = Geometry::Box { half: [0.3, 0.3, 0.002] };
                Obstacle { name: name(i), pose: random_pose(random, 0.8), geometry }
            })
            .collect(),
    }
}

fn tasks(mechanisms: &mut Vec<(String, Mechanism)>) -> Vec<Task> {
    let arguments: Vec<String> = std::env::args().skip(2).collect();
    let mut tasks = Vec::new();
    if let [urdf, srdf, problems, ..] = &arguments[..] {
        let read = |path: &String| std::fs::read_to_string(path).unwrap();
        let problems = Problems::parse(&read(problems)).unwrap();
        let mechanism = Mechanism::read(&read(urdf), Some(&read(srdf)), &problems.joints).unwrap();
        mechanisms.push(("file".into(), mechanism));
        for (class, list) in problems.classes {
            for problem in list {
                tasks.push(Task {
                    class: class.clone(),
                    mechanism: mechanisms.len() - 1,
                    obstacles: problem.obstacles,
                    start: state(&problem.start),
                    goal: state(&problem.goal),
                });
            }
        }
    }
    let joints: Vec<String> = (1..=7).map(|i| format!("arm_joint_{i}")).collect();
    let aimm = Mechanism::read(include_str!("../robots/aimm.urdf"), None, &joints).unwrap();
    mechanisms.push(("aimm".into(), aimm));
    for (index, (name, mechanism)) in mechanisms.iter().enumerate() {
        for class in ["few large", "many small", "poles", "plates"] {
            let mut random = ChaCha8Rng::seed_from_u64(42);
            let mut found = 0;
            for _ in 0..2000 {
                if found == 40 {
                    break;
                }
                let obstacles = scene(&mut random, class);
                let mut space = Space::new(mechanism, &obstacles);
                let mut posture = || -> State {
                    let mut state = [0.0; MAX_JOINTS];
                    for (q, joint) in state.iter_mut().zip(&mechanism.joints) {
                        *q = random.random_range(joint.lower..joint.upper) as f32;
                    }
                    state
                };
                let (start, goal) = (posture(), posture());
                if !space.is_free(&start) || !space.is_free(&goal) || space.is_free_motion(&start, &goal) {
                    continue;
                }
                if connect(&mut space, &start, &[goal], BUDGET, &mut go_on).is_err() {
                    continue;
                }
                found += 1;
                tasks.push(Task { class: format!("{name} {class}"), mechanism: index, obstacles, start, goal });
            }
        }
    }
    tasks
}

fn rank(mut values: Vec<f64>, share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values[((values.len() as f64 * share).ceil() as usize).max(1) - 1]
}

fn classes(tasks: &[Task]) -> Vec<String> {
    let mut classes: Vec<String> = tasks.iter().map(|t| t.class.clone()).collect();
    classes.dedup();
    classes
}

fn refine(mechanisms: &[(String, Mechanism)], tasks: &[Task], variants: &[&str]) {
    const AFTER_MS: [f64; 4] = [1.0, 3.0, 10.0, 40.0];
    let all: Vec<(String, Shares)> = variants
        .iter()
        .map(|s| {
            let n: Vec<u32> = s.split(',').map(|n| n.parse().unwrap()).collect();
            ((*s).to_owned(), Shares { shortcut: n[0], corner: n[1], turn: n[2], search: n[3], tree: n[4] })
        })
        .collect();
    // Per task, shares and time: the length.
    let mut lengths: Vec<Vec<[f64; 4]>> = Vec::new();
    for (seed, task) in tasks.iter().enumerate() {
        let mut space = Space::new(&mechanisms[task.mechanism].1, &task.obstacles);
        let Ok(route) = connect(&mut space, &task.start, &[task.goal], BUDGET, &mut go_on) else { continue };
        let Ok(path) = simplify(&mut space, &route.path, BUDGET, &mut go_on) else { continue };
        space.set_swept(true);
        let mut rows = Vec::new();
        for (_, shares) in &all {
            let ends = vec![End { state: task.goal, rest: 0.0, rest_s: 0.0 }];
            let new = Refinement::new(path.clone(), 0, ends, Measure::Length, seed as u64);
            let mut refinement = new.with_shares(*shares);
            let begin = Instant::now();
            let mut row = [0.0; 4];
            for (at, after) in AFTER_MS.iter().enumerate() {
                while begin.elapsed().as_secs_f64() * 1e3 < *after {
                    refinement.step(&mut space, &mut go_on).unwrap();
                }
                row[at] = f64::from(refinement.length());
            }
            rows.push(row);
        }
        lengths.push(rows);
    }
    // Beside the shortest that any found.
    let best: Vec<f64> = lengths.iter().map(|rows| rows.iter().map(|r| r[3]).fold(f64::INFINITY, f64::min)).collect();
    println!("mean length / shortest known after {AFTER_MS:?} ms");
    for class in classes(tasks).iter().map(String::as_str).chain(["all"]) {
        for (variant, (name, _)) in all.iter().enumerate() {
            let mut line = format!("{class:20} {name:18}");
            for at in 0..4 {
                let of: Vec<f64> = tasks
                    .iter()
                    .zip(lengths.iter().zip(&best))
                    .filter(|(t, _)| t.class == class || class == "all")
                    .map(|(_, (rows, best))| rows[variant][at] / best)
                    .collect();
                let mean = of.iter().sum::<f64>() / of.len() as f64;
                line += &format!("  {mean:.4} {:.3}", rank(of, 0.95));
            }
            println!("{line}");
        }
    }
}

fn simplification(mechanisms: &[(String, Mechanism)], tasks: &[Task]) {
    let mut results: Vec<(String, f64, f64, f64)> = Vec::new();
    for task in tasks {
        let mut space = Space::new(&mechanisms[task.mechanism].1, &task.obstacles);
        let Ok(route) = connect(&mut space, &task.start, &[task.goal], BUDGET, &mut go_on) else { continue };
        let mut least = f64::INFINITY;
        let mut length = f64::NAN;
        for _ in 0..15 {
            let begin = Instant::now();
            let path = simplify(&mut space, &route.path, BUDGET, &mut go_on);
            least = least.min(begin.elapsed().as_secs_f64() * 1e6);
            let Ok(path) = path else { continue };
            length = f64::from(path_length(&path));
        }
        results.push((task.class.clone(), least, length, f64::from(path_length(&route.path))));
    }
    println!("class, simplify median us, p95, max, mean; length median, mean, before");
    for class in classes(tasks) {
        let of = |f: fn(&(String, f64, f64, f64)) -> f64| -> Vec<f64> {
            results.iter().filter(|r| r.0 == class && !r.2.is_nan()).map(f).collect()
        };
        let mean = |values: Vec<f64>| values.iter().sum::<f64>() / values.len() as f64;
        println!(
            "{class:20} {:4} {:8.1} {:8.1} {:8.1} {:8.1}  {:.3} {:.3} {:.3}",
            of(|r| r.1).len(),
            rank(of(|r| r.1), 0.5),
            rank(of(|r| r.1), 0.95),
            rank(of(|r| r.1), 1.0),
            mean(of(|r| r.1)),
            rank(of(|r| r.2), 0.5),
            mean(of(|r| r.2)),
            mean(of(|r| r.3)),
        );
    }
}

fn durations(mechanisms: &[(String, Mechanism)], tasks: &[Task]) {
    let mut rows: Vec<(&str, f64, f64)> = Vec::new();
    for task in tasks {
        let mechanism = &mechanisms[task.mechanism].1;
        let mut space = Space::new(mechanism, &task.obstacles);
        let Ok(route) = connect(&mut space, &task.start, &[task.goal], BUDGET, &mut go_on) else { continue };
        let Ok(path) = simplify(&mut space, &route.path, BUDGET, &mut go_on) else { continue };
        space.set_swept(true);
        let posture = |s: &State| JointVector::from_fn(mechanism.joints.len(), |j| f64::from(s[j]));
        let path: Vec<JointVector> = path.iter().map(posture).collect();
        let begin = Instant::now();
        let curve = timed(&mechanism.joints, &[Section::Blended(path)], 1.0, &mut |a, b| {
            space.is_free_motion(&state(a), &state(b))
        });
        rows.push((&task.class, curve.duration_s(), begin.elapsed().as_secs_f64() * 1e6));
    }
    println!("class, problems, mean duration s, median us");
    for class in classes(tasks) {
        let of: Vec<(f64, f64)> = rows.iter().filter(|r| r.0 == class).map(|r| (r.1, r.2)).collect();
        let mean = of.iter().map(|r| r.0).sum::<f64>() / of.len() as f64;
        println!("{class:20} {:4} {mean:.3} {:.0}", of.len(), rank(of.iter().map(|r| r.1).collect(), 0.5));
    }
}

/// How long motions take after the same processor time of improvement by length and by duration, in turn on each problem.
fn quicken(mechanisms: &[(String, Mechanism)], tasks: &[Task], speed: f64) {
    const AFTER_MS: [f64; 3] = [0.0, 10.0, 50.0];
    let mut rows: Vec<(&str, [[f64; 3]; 2])> = Vec::new();
    for (seed, task) in tasks.iter().enumerate() {
        let mechanism = &mechanisms[task.mechanism].1;
        let mut space = Space::new(mechanism, &task.obstacles);
        let Ok(route) = connect(&mut space, &task.start, &[task.goal], BUDGET, &mut go_on) else { continue };
        let Ok(path) = simplify(&mut space, &route.path, BUDGET, &mut go_on) else { continue };
        space.set_swept(true);
        let by_duration = Measure::Duration(Box::new(Rough::new(&mechanism.joints, speed)));
        let row = [Measure::Length, by_duration].map(|measure| {
            let ends = vec![End { state: task.goal, rest: 0.0, rest_s: 0.0 }];
            let mut refinement = Refinement::new(path.clone(), 0, ends, measure, seed as u64);
            let mut spent = 0.0;
            AFTER_MS.map(|after| {
                while spent < after {
                    let begin = Instant::now();
                    refinement.step(&mut space, &mut go_on).unwrap();
                    // What others made it wait is not its own.
                    spent += (begin.elapsed().as_secs_f64() * 1e3).min(2.0);
                }
                let posture = |s: &State| JointVector::from_fn(mechanism.joints.len(), |j| f64::from(s[j]));
                let path: Vec<JointVector> = refinement.path().iter().map(posture).collect();
                let curve = timed(&mechanism.joints, &[Section::Blended(path)], speed, &mut |a, b| {
                    space.is_free_motion(&state(a), &state(b))
                });
                curve.duration_s()
            })
        });
        rows.push((&task.class, row));
    }
    println!(
        "class, problems, mean duration after {AFTER_MS:?} ms by length and by duration, median of the ratios after each"
    );
    for class in classes(tasks).iter().map(String::as_str).chain(["all"]) {
        let of: Vec<&[[f64; 3]; 2]> = rows.iter().filter(|r| r.0 == class || class == "all").map(|r| &r.1).collect();
        let mean = |which: usize, at: usize| of.iter().map(|r| r[which][at]).sum::<f64>() / of.len() as f64;
        let ratio = |at: usize| rank(of.iter().map(|r| r[1][at] / r[0][at]).collect(), 0.5);
        let [first, length, duration] = [mean(0, 0), mean(0, 2), mean(1, 2)];
        println!(
            "{class:18} {:4}  {first:.3}  {:.3} {length:.3}  {:.3} {duration:.3}  {:.3} {:.3}",
            of.len(),
            mean(0, 1),
            mean(1, 1),
            ratio(1),
            ratio(2)
        );
    }
}

/// What a batch of postures costs that are all free, close to the start of each task.
fn batches(mechanisms: &[(String, Mechanism)], tasks: &[Task]) {
    const CHECKS: u32 = 2_000;
    println!("class, instructions, postures of a batch, batches measured, median us of one");
    for class in classes(tasks) {
        for isa in Isa::available() {
            let mut costs = Vec::new();
            for task in tasks.iter().filter(|task| task.class == class) {
                let mut space = Space::with_isa(&mechanisms[task.mechanism].1, &task.obstacles, isa);
                let delta: State = std::array::from_fn(|j| 0.1 * (task.goal[j] - task.start[j]));
                if !space.check_batch(&task.start, &delta) {
                    continue;
                }
                let begin = Instant::now();
                let free = (0..CHECKS).filter(|_| space.check_batch(&task.start, std::hint::black_box(&delta))).count();
                costs.push(begin.elapsed().as_secs_f64() * 1e6 / free as f64);
            }
            if !costs.is_empty() {
                println!("{class:20} {isa:?} {} {} {:.3}", isa.width(), costs.len(), rank(costs, 0.5));
            }
        }
    }
}

fn main() {
    let mut mechanisms = Vec::new();
    let tasks = tasks(&mut mechanisms);
    let what = std::env::args().nth(1).unwrap_or_default();
    let words: Vec<&str> = what.split(':').collect();
    match words[..] {
        ["refine", ref variants @ ..] => refine(&mechanisms, &tasks, variants),
        ["batch"] => batches(&mechanisms, &tasks),
        ["simplify"] => simplification(&mechanisms, &tasks),
        ["time"] => durations(&mechanisms, &tasks),
        ["quicken", speed] => quicken(&mechanisms, &tasks, speed.parse().unwrap()),
        _ => panic!("batch, simplify, time, refine:SHARES or quicken:SPEED"),
    }
}
