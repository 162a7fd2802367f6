//! Makes planning problems that nothing was tuned on: a robot among random things, from one free posture to another one that no straight motion
//! leads to: `cargo run --release -p ratn-motion --example scenes -- URDF SRDF JOINT,JOINT,... SEED COUNT OUT`.
//!
//! Writes OUT.json, for `--example search`, and OUT.txt, for `scripts/search/vamp.cc`, with COUNT problems of each class: boxes, bars, posts, balls, a
//! cupboard from one compartment to another one, and a wall with a hole. Things that touch the robot wherever its joints are are left out. What is
//! free is asked of the spheres of the search, so the file is as good for any planner that knows the robot by these spheres.

#![allow(clippy::print_stdout, clippy::unwrap_used, reason = "a measurement")]

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::geometry::Geometry;
use ratn_motion::mechanism::Mechanism;
use ratn_motion::space::{Obstacle, Space, state};
use serde_json::{Value, json};
use std::f64::consts::PI;
use std::fmt::Write as _;

/// Random postures that say whether a thing leaves the robot any room.
const TRIED: usize = 60;

/// Attempts at an end of a problem in one scene.
const ATTEMPTS: usize = 100_000;

/// A thing, and how it is turned: roll, pitch, yaw.
struct Thing {
    geometry: Geometry,
    at: [f64; 3],
    rpy: [f64; 3],
}

/// Where an end of a problem has the hand: a box, by its pose and its half extents.
struct Within {
    pose: Pose,
    half: [f64; 3],
}

/// What stands around, and where the hand is to be at the start and the goal, if that matters.
type Scene = (Vec<Thing>, Option<[Within; 2]>);

/// Draws a scene.
type Make = fn(&Robot, &mut ChaCha8Rng) -> Scene;

/// The robot and how far it reaches.
struct Robot {
    mechanism: Mechanism,
    hand: usize,
    anchor: [f64; 3],
    reach: f64,
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let read = |i: usize| std::fs::read_to_string(&arguments[i]).unwrap();
    let joints: Vec<String> = arguments[2].split(',').map(str::to_owned).collect();
    let (seed, count): (u64, usize) = (arguments[3].parse().unwrap(), arguments[4].parse().unwrap());
    let robot = Robot::new(Mechanism::read(&read(0), Some(&read(1)), &joints).unwrap());
    let classes: [(&str, Make); 6] = [
        ("balls", |robot, random| scattered(robot, random, 24, ball)),
        ("bars", |robot, random| scattered(robot, random, 16, bar)),
        ("boxes", |robot, random| scattered(robot, random, 12, cuboid)),
        ("cupboard", cupboard),
        ("posts", |robot, random| scattered(robot, random, 14, post)),
        ("wall", wall),
    ];
    let (mut problems, mut text) = (serde_json::Map::new(), String::new());
    for (number, (class, make)) in classes.into_iter().enumerate() {
        let mut random = ChaCha8Rng::seed_from_u64(1_000 * seed + number as u64);
        let mut list = Vec::new();
        while list.len() < count {
            if let Some(problem) = robot.problem(make(&robot, &mut random), &mut random) {
                list.push(problem.json(list.len()));
                problem.write(class, list.len() - 1, &mut text);
            }
        }
        problems.insert(class.to_owned(), Value::Array(list));
    }
    let document = json!({ "robot": robot.mechanism.name, "joints": joints, "problems": problems });
    std::fs::write(format!("{}.json", arguments[5]), document.to_string()).unwrap();
    std::fs::write(format!("{}.txt", arguments[5]), text).unwrap();
}

impl Robot {
    fn new(mechanism: Mechanism) -> Robot {
        // The last of those links that most joints move.
        let depth = |mut link: usize| {
            let mut depth = usize::from(mechanism.links[link].drive.is_some());
            while let Some(parent) = mechanism.links[link].parent {
                link = parent;
                depth += usize::from(mechanism.links[link].drive.is_some());
            }
            depth
        };
        let hand = (0..mechanism.links.len()).max_by_key(|link| depth(*link)).unwrap();
        let first = mechanism.links.iter().position(|link| link.drive.is_some()).unwrap();
        let anchor = mechanism.poses(&vec![0.0; mechanism.joints.len()])[first].position;
        let mut robot = Robot { mechanism, hand, anchor, reach: 0.0 };
        let mut random = ChaCha8Rng::seed_from_u64(0);
        for _ in 0..1_000 {
            let at = robot.mechanism.poses(&robot.posture(&mut random))[robot.hand];
            robot.reach = robot.reach.max(at.distance(&Pose::at(anchor[0], anchor[1], anchor[2])));
        }
        robot
    }

    fn posture(&self, random: &mut impl Rng) -> Vec<f64> {
        self.mechanism.joints.iter().map(|joint| random.random_range(joint.lower..joint.upper)).collect()
    }

    /// A problem in a scene without what leaves the robot no room; none where no two ends were found.
    fn problem(&self, (mut things, hands): Scene, random: &mut ChaCha8Rng) -> Option<Problem> {
        let mut empty = Space::new(&self.mechanism, &Vec::<Obstacle>::new());
        let free = std::iter::repeat_with(|| self.posture(random)).filter(|q| empty.is_free(&state(q)));
        let free: Vec<Vec<f64>> = free.take(TRIED).collect();
        things.retain(|thing| {
            let mut beside = Space::new(&self.mechanism, &[thing.obstacle()][..]);
            free.iter().any(|q| beside.is_free(&state(q)))
        });
        let obstacles: Vec<Obstacle> = things.iter().map(Thing::obstacle).collect();
        let mut space = Space::new(&self.mechanism, &obstacles[..]);
        let mut end = |which: usize| {
            let mut postures = std::iter::repeat_with(|| self.posture(random)).take(ATTEMPTS);
            postures.find(|q| self.is_there(q, &hands, which) && space.is_free(&state(q)))
        };
        let (start, goal) = (end(0)?, end(1)?);
        let straight = space.is_free_motion(&state(&start), &state(&goal));
        (!straight).then_some(Problem { things, start, goal })
    }

    fn is_there(&self, posture: &[f64], hands: &Option<[Within; 2]>, which: usize) -> bool {
        let Some(Within { pose, half }) = hands.as_ref().map(|hands| &hands[which]) else { return true };
        let hand = self.mechanism.poses(posture)[self.hand].position;
        pose.inverse().transform(hand).iter().zip(half).all(|(at, half)| at.abs() < *half)
    }
}

struct Problem {
    things: Vec<Thing>,
    start: Vec<f64>,
    goal: Vec<f64>,
}

impl Problem {
    fn json(&self, index: usize) -> Value {
        let objects: Vec<Value> = self.things.iter().enumerate().map(|(i, thing)| thing.json(i)).collect();
        json!({ "index": index, "objects": objects, "start": self.start, "goal": self.goal })
    }

    fn write(&self, class: &str, index: usize, text: &mut String) {
        writeln!(text, "{class} {index} {}", self.things.len()).unwrap();
        self.things.iter().for_each(|thing| text.push_str(&thing.line()));
        for posture in [&self.start, &self.goal] {
            let words: Vec<String> = posture.iter().map(f64::to_string).collect();
            writeln!(text, "{}", words.join(" ")).unwrap();
        }
    }
}

impl Thing {
    fn pose(&self) -> Pose {
        let [roll, pitch, yaw] = self.rpy;
        Pose::from_rpy(self.at, roll, pitch, yaw)
    }

    fn obstacle(&self) -> Obstacle {
        Obstacle { name: "thing".to_owned(), pose: self.pose(), geometry: self.geometry }
    }

    fn json(&self, index: usize) -> Value {
        let mut object = match self.geometry {
            Geometry::Box { half } => json!({ "type": "box", "size": half.map(|h| 2.0 * h) }),
            Geometry::Sphere { radius } => json!({ "type": "sphere", "radius": radius }),
            Geometry::Capsule { radius, half_length } => {
                json!({ "type": "capsule", "radius": radius, "length": 2.0 * half_length })
            }
            Geometry::Cylinder { .. } => unreachable!("VAMP has no cylinders"),
        };
        object["name"] = json!(format!("thing_{index}"));
        object["position"] = json!(self.at);
        object["quat_xyzw"] = json!(self.pose().quaternion_xyzw);
        object
    }

    /// As `vamp.cc` reads it.
    fn line(&self) -> String {
        let ([x, y, z], [roll, pitch, yaw]) = (self.at, self.rpy);
        match self.geometry {
            Geometry::Box { half: [a, b, c] } => format!("box {x} {y} {z} {roll} {pitch} {yaw} {a} {b} {c}\n"),
            Geometry::Sphere { radius } => format!("sphere {x} {y} {z} {roll} {pitch} {yaw} {radius}\n"),
            Geometry::Capsule { radius, half_length } => {
                format!("capsule {x} {y} {z} {roll} {pitch} {yaw} {radius} {}\n", 2.0 * half_length)
            }
            Geometry::Cylinder { .. } => unreachable!("VAMP has no cylinders"),
        }
    }
}

/// So many things at random within the reach.
fn scattered(robot: &Robot, random: &mut ChaCha8Rng, count: usize, one: fn(&mut ChaCha8Rng) -> Thing) -> Scene {
    let things = std::iter::repeat_with(|| {
        let thing = one(random);
        let offset: [f64; 3] = std::array::from_fn(|_| random.random_range(-robot.reach..robot.reach));
        Thing { at: std::array::from_fn(|i| robot.anchor[i] + offset[i]), ..thing }
    });
    (things.take(count).collect(), None)
}

fn turned(random: &mut ChaCha8Rng) -> [f64; 3] {
    [random.random_range(-PI..PI), random.random_range(-PI / 2.0..PI / 2.0), random.random_range(-PI..PI)]
}

fn ball(random: &mut ChaCha8Rng) -> Thing {
    Thing { geometry: Geometry::Sphere { radius: random.random_range(0.04..0.15) }, at: [0.0; 3], rpy: [0.0; 3] }
}

fn bar(random: &mut ChaCha8Rng) -> Thing {
    Thing { geometry: Geometry::Box { half: [0.5, 0.03, 0.03] }, at: [0.0; 3], rpy: turned(random) }
}

fn cuboid(random: &mut ChaCha8Rng) -> Thing {
    let half = std::array::from_fn(|_| random.random_range(0.05..0.2));
    Thing { geometry: Geometry::Box { half }, at: [0.0; 3], rpy: turned(random) }
}

fn post(random: &mut ChaCha8Rng) -> Thing {
    let (radius, half_length) = (random.random_range(0.02..0.07), random.random_range(0.2..0.6));
    Thing { geometry: Geometry::Capsule { radius, half_length }, at: [0.0; 3], rpy: [0.0; 3] }
}

/// A board of a piece of furniture that is turned about the vertical: where it is in that, and its half extents.
fn board(furniture: &Pose, yaw: f64, at: [f64; 3], half: [f64; 3]) -> Thing {
    Thing { geometry: Geometry::Box { half }, at: furniture.transform(at), rpy: [0.0, 0.0, yaw] }
}

/// Something that faces the robot, so far from it as a share of its reach; x points away.
fn facing(robot: &Robot, random: &mut ChaCha8Rng, far: std::ops::Range<f64>) -> (Pose, f64) {
    let (yaw, far): (f64, f64) = (random.random_range(-1.2..1.2), robot.reach * random.random_range(far));
    let [x, y, z] = robot.anchor;
    let at = [x + far * yaw.cos(), y + far * yaw.sin(), z + robot.reach * random.random_range(-0.3..0.3)];
    (Pose::from_rpy(at, 0.0, 0.0, yaw), yaw)
}

/// Three compartments above each other, with a back and sides.
fn cupboard(robot: &Robot, random: &mut ChaCha8Rng) -> Scene {
    const THIN: f64 = 0.01;
    let (pose, yaw) = facing(robot, random, 0.6..0.8);
    let (wide, deep, high) = (random.random_range(0.3..0.5), 0.2, random.random_range(0.28..0.42));
    let whole = 1.5 * high;
    let mut things = vec![board(&pose, yaw, [2.0 * deep, 0.0, 0.0], [THIN, wide, whole])];
    things.extend([-wide, wide].map(|side| board(&pose, yaw, [deep, side, 0.0], [deep, THIN, whole])));
    let floors = (0..4).map(|floor| whole - high * f64::from(floor));
    things.extend(floors.map(|floor| board(&pose, yaw, [deep, 0.0, floor], [deep, wide, THIN])));
    let first = random.random_range(0..3);
    let second = (first + random.random_range(1..3)) % 3;
    let hands = [first, second].map(|compartment| Within {
        pose: pose.compose(&Pose::at(deep, 0.0, high * (f64::from(compartment) - 1.0))),
        half: [deep, wide, high / 2.0],
    });
    (things, Some(hands))
}

/// A wall with a square hole: from this side of it to the other one.
fn wall(robot: &Robot, random: &mut ChaCha8Rng) -> Scene {
    let (pose, yaw) = facing(robot, random, 0.35..0.5);
    let (hole, whole, thick) = (random.random_range(0.14..0.22), 1.2, 0.02);
    let (middle, half) = ((whole + hole) / 2.0, (whole - hole) / 2.0);
    let mut things: Vec<Thing> =
        [-middle, middle].map(|side| board(&pose, yaw, [0.0, side, 0.0], [thick, half, whole])).into();
    things.extend([-middle, middle].map(|up| board(&pose, yaw, [0.0, 0.0, up], [thick, hole, half])));
    let side = |along: f64| Within { pose: pose.compose(&Pose::at(along, 0.0, 0.0)), half: [0.5, whole, whole] };
    (things, Some([side(-0.55), side(0.65)]))
}
