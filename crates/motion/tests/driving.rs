//! Paths of the base on the floor.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::aimm;
use ratn_motion::connect::{Budget, ConnectError};
use ratn_motion::drive::{Vehicle, drive};
use ratn_motion::geometry::Geometry;
use ratn_motion::pace::Control;
use ratn_motion::robot::{Configuration, Robot};
use ratn_motion::space::Obstacle;
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};
use std::f64::consts::{FRAC_PI_2, PI, TAU};

const AREA: [[f64; 2]; 2] = [[-3.0, 3.0], [-3.0, 3.0]];
const BUDGET: Budget = Budget { iterations: 50_000, seed: 1 };

fn go_on(_: usize) -> Control {
    Control::Continue
}

fn post(index: usize, x: f64, y: f64, radius: f64) -> Obstacle {
    let geometry = Geometry::Cylinder { radius, half_length: 0.5 };
    Obstacle { name: format!("post {index}"), pose: Pose::at(x, y, 0.5), geometry }
}

#[test]
fn a_round_base_keeps_its_distance_from_every_post() {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let vehicle = Vehicle::round(0.3, 0.3, AREA, 0.02);
    let (mut solved, mut indirect) = (0, 0);
    for seed in 0..20 {
        let (start, goal) = ([-2.5, -2.5, 0.0], [2.5, 2.5, 3.0]);
        let mut posts = Vec::new();
        while posts.len() < 12 {
            let (x, y) = (random.random_range(-2.5..2.5), random.random_range(-2.5..2.5));
            if [start, goal].iter().all(|p: &[f64; 3]| (p[0] - x).hypot(p[1] - y) > 0.7) {
                posts.push(post(posts.len(), x, y, 0.15));
            }
        }
        let budget = Budget { iterations: 20_000, seed };
        let Ok((path, index)) = drive(&vehicle, &posts, start, &[goal], budget, &mut go_on) else { continue };
        solved += 1;
        indirect += usize::from(path.len() > 2);
        assert_eq!(index, 0);
        for pair in path.windows(2) {
            for i in 0..=200 {
                let [x, y] = [0, 1].map(|k| pair[0][k] + (pair[1][k] - pair[0][k]) * f64::from(i) / 200.0);
                for post in &posts {
                    let gap = (post.pose.position[0] - x).hypot(post.pose.position[1] - y);
                    assert!(gap >= 0.15 + 0.3 + 0.02 - 1e-4, "{gap:.4} from {}", post.name);
                }
            }
        }
    }
    assert!(solved > 15 && indirect > 5, "{solved} solved, {indirect} not straight");
}

#[test]
fn a_heading_is_reached_by_the_shorter_turn() {
    let vehicle = Vehicle::round(0.3, 0.3, AREA, 0.0);
    let (path, _) = drive(&vehicle, &[], [0.0, 0.0, 3.0], &[[0.0, 0.0, -3.0]], BUDGET, &mut go_on).unwrap();
    let turned = path[path.len() - 1][2] - path[0][2];
    assert!((turned - (TAU - 6.0)).abs() < 1e-5, "{turned}");
    let ends = [[2.0, 0.0, 0.0], [0.0, 0.5, 0.0]];
    let (path, nearest) = drive(&vehicle, &[], [0.0; 3], &ends, BUDGET, &mut go_on).unwrap();
    assert_eq!((nearest, path.len()), (1, 2));
}

#[test]
fn our_robot_turns_to_fit_through_a_gap_and_does_not_try_one_that_is_too_narrow() {
    let robot = Robot::aimm();
    let wall = |name: &str, y: f64, width: f64| SceneObject {
        name: name.to_owned(),
        shape: Shape::Box { size: [0.1, width, 1.0] },
        placement: Placement::World(Pose::at(1.5, y, 0.5)),
    };
    // The base is 1.10 long and 0.60 wide.
    for (gap, fits) in [(0.9, true), (0.5, false)] {
        let width = 3.0 - gap / 2.0;
        let objects =
            vec![wall("left", gap / 2.0 + width / 2.0, width), wall("right", -gap / 2.0 - width / 2.0, width)];
        let scene = Scene { base: Pose::IDENTITY, objects };
        let here = Configuration { arm: aimm::STOWED, base: [0.0, 0.0, FRAC_PI_2], ..robot.at_zero() };
        let (vehicle, obstacles) = Vehicle::of(&robot, &scene, &here, &[], 0.01);
        let vehicle = Vehicle { area: AREA, ..vehicle };
        let budget = Budget { iterations: 30_000, seed: 3 };
        let outcome = drive(&vehicle, &obstacles, here.base, &[[2.9, 0.0, FRAC_PI_2]], budget, &mut go_on);
        match outcome {
            Ok((path, _)) => {
                assert!(fits);
                let turned = path.iter().any(|p| (p[2] - FRAC_PI_2).abs() > 0.5);
                assert!(turned && path.len() > 2, "{path:?}");
            }
            Err(error) => assert!(!fits && matches!(error, ConnectError::Exhausted { .. }), "{error}"),
        }
    }
}

#[test]
fn what_rides_on_the_base_is_no_obstacle_and_what_stands_at_the_goal_is() {
    let robot = Robot::aimm();
    let slot = aimm::slots()[4];
    let cube = |name: &str, pose: Pose| SceneObject {
        name: name.to_owned(),
        shape: Shape::Box { size: [0.1; 3] },
        placement: Placement::World(pose),
    };
    let scene = Scene {
        base: Pose::IDENTITY,
        objects: vec![cube("cargo", slot.compose(&Pose::at(0.0, 0.0, 0.051))), cube("step", Pose::at(0.0, 2.0, 0.05))],
    };
    let here = Configuration { arm: aimm::STOWED, ..robot.at_zero() };
    let riding = ["cargo".to_owned()];
    let (vehicle, obstacles) = Vehicle::of(&robot, &scene, &here, &riding, 0.01);
    let vehicle = Vehicle { area: AREA, ..vehicle };
    assert_eq!(obstacles.len(), 1);
    let to = |y: f64| drive(&vehicle, &obstacles, [0.0; 3], &[[0.0, y, PI / 4.0]], BUDGET, &mut go_on);
    assert!(to(-2.0).is_ok());
    assert_eq!(to(2.0).unwrap_err(), ConnectError::Goal { goals: 1 });
}
