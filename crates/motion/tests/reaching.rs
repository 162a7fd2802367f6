//! Inverse kinematics of any robot, goals with tolerances, and paths that keep a frame upright.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

use proptest::prelude::*;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::connect::{Budget, ConnectError, connect_to_targets};
use ratn_motion::constrained::{self, Constraint};
use ratn_motion::exact::Exact;
use ratn_motion::geometry::Geometry;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::mechanism::{MAX_JOINTS, Mechanism};
use ratn_motion::pace::Control;
use ratn_motion::reach::{Reach, Target, distance};
use ratn_motion::robot_model::RobotModel;
use ratn_motion::robot_state::RobotState;
use ratn_motion::simplify::path_length;
use ratn_motion::space::{Obstacle, Space, between, state};
use std::f64::consts::PI;
use std::sync::LazyLock;

const AIMM: &str = include_str!("../robots/aimm.urdf");

fn go_on(_: usize) -> Control {
    Control::Continue
}

/// The arm of seven joints, or some of them: the closed form is for all seven.
fn arm(joints: std::ops::RangeInclusive<usize>) -> Mechanism {
    let names: Vec<String> = joints.map(|i| format!("arm_joint_{i}")).collect();
    static MODEL: LazyLock<RobotModel> = LazyLock::new(|| RobotModel::read(AIMM, None).unwrap());
    let mut mechanism = MODEL.planned(&names, &RobotState::neutral(&MODEL)).unwrap();
    // Pairs that only the exact check sees are nothing to the search.
    mechanism.excepted.extend(mechanism.by_shapes.clone());
    mechanism
}

fn tool(mechanism: &Mechanism) -> Reach {
    Reach::new(mechanism, mechanism.link("tool").unwrap(), Pose::IDENTITY)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 60, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn the_frame_is_where_the_links_are(seed in 0_u64..10_000) {
        let mechanism = arm(1..=7);
        let reach = tool(&mechanism);
        let posture = reach.random(&mut ChaCha8Rng::seed_from_u64(seed));
        let poses = mechanism.poses(&posture[..7]);
        let expected = poses[mechanism.link("tool").unwrap()];
        let pose = reach.pose(&posture);
        prop_assert!(pose.distance(&expected) < 1e-9 && pose.angle(&expected) < 1e-6);
    }

    #[test]
    fn in_closed_form_every_attempt_gives_postures_and_the_nearest_to_one_is_itself(seed in 0_u64..10_000) {
        let reach = tool(&arm(1..=7));
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let posture = reach.random(&mut random);
        let target = Target::at(reach.pose(&posture));
        let postures = reach.postures(&target);
        prop_assert!(distance(&reach.nearest(&postures, &posture)[0], &posture) < 1e-5);
        for _ in 1..20 {
            let solutions = reach.anywhere(&postures, &posture, &mut random);
            prop_assert!(!solutions.is_empty());
            for solution in solutions {
                let pose = reach.pose(&solution);
                prop_assert!(pose.distance(&target.pose) < 1e-6 && pose.angle(&target.pose) < 1e-6);
                prop_assert_eq!(reach.clamp(&solution), solution);
            }
        }
    }

    #[test]
    fn what_an_arm_of_seven_joints_can_reach_it_does(choices in prop::array::uniform7(0_u8..6), seed in 0_u64..10_000) {
        let mechanism = arm(1..=7);
        let reach = tool(&mechanism);
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut posture = reach.random(&mut random);
        for ((q, joint), choice) in posture.iter_mut().zip(&mechanism.joints).zip(choices) {
            *q = match choice {
                0 => 0.0,
                1 => joint.lower + 1e-5,
                2 => joint.upper - 1e-5,
                _ => *q,
            };
        }
        let target = Target::at(reach.pose(&posture));
        let solutions = reach.solutions(&target, &JointVector::zeros(reach.joints()), 1, 20, &mut random);
        prop_assert!(!solutions.is_empty(), "{posture:?}: {:?}", reach.postures(&target));
    }

    #[test]
    fn poses_of_an_arm_of_six_joints_are_found(seed in 0_u64..10_000) {
        let reach = tool(&arm(2..=7));
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let target = Target::at(reach.pose(&reach.random(&mut random)));
        let solutions = reach.solutions(&target, &JointVector::zeros(reach.joints()), 2, 60, &mut random);
        prop_assert!(!solutions.is_empty());
        prop_assert!(solutions.iter().all(|s| target.is_met_by(&reach.pose(s)) && reach.clamp(s) == *s));
    }

    #[test]
    fn tolerances_are_used_and_kept(seed in 0_u64..10_000) {
        let reach = tool(&arm(1..=7));
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let pose = reach.pose(&reach.random(&mut random));
        let target = Target { pose, tolerance_m: [0.02, 0.0, 0.05], tolerance_rad: [0.1, 0.1, PI], bounds: None };
        for posture in reach.solutions(&target, &JointVector::zeros(reach.joints()), 3, 30, &mut random) {
            let off = pose.inverse().compose(&reach.pose(&posture));
            let [x, y, z] = off.position;
            prop_assert!(x.abs() <= 0.02 + 1e-6 && y.abs() < 1e-6 && z.abs() <= 0.05 + 1e-6, "{off:?}");
            let tilt = off.rotate([0.0, 0.0, 1.0])[2].clamp(-1.0, 1.0).acos();
            prop_assert!(tilt <= 0.1 + 1e-6, "{tilt}");
        }
    }
}

/// Boxes about the arm, none of them where it stands at `keep`.
fn clutter(random: &mut impl Rng, mechanism: &Mechanism, keep: &[JointVector]) -> Vec<Obstacle> {
    let mut obstacles: Vec<Obstacle> = Vec::new();
    while obstacles.len() < 8 {
        let mut range = |low: f64, high: f64| random.random_range(low..high);
        let half = [range(0.03, 0.12), range(0.03, 0.12), range(0.03, 0.12)];
        let place = Pose::from_rpy([range(-0.4, 1.0), range(-0.9, 0.9), range(0.7, 1.8)], 0.0, 0.0, range(-3.0, 3.0));
        obstacles.push(Obstacle {
            name: format!("box {}", obstacles.len()),
            pose: place,
            geometry: Geometry::Box { half },
        });
        let mut space = Space::new(mechanism, &obstacles);
        if !keep.iter().all(|posture| space.is_free(&state(posture))) {
            obstacles.pop();
        }
    }
    obstacles
}

#[test]
fn the_nearest_of_many_grasps_that_can_be_reached_is_taken() {
    let mechanism = arm(1..=7);
    let reach = tool(&mechanism);
    let mut random = ChaCha8Rng::seed_from_u64(11);
    let mut reached = 0;
    for seed in 0..15 {
        let mut free = || loop {
            let posture = reach.random(&mut random);
            if Space::new(&mechanism, &[]).is_free(&state(&posture)) {
                return posture;
            }
        };
        let (start, grasp) = (free(), free());
        let obstacles = clutter(&mut random, &mechanism, &[start, grasp]);
        let far = Target::at(Pose::at(4.0, 0.0, 1.0));
        let targets = [far, Target::at(reach.pose(&grasp))];
        let budget = Budget { iterations: 50_000, seed };
        let mut space = Space::new(&mechanism, &obstacles);
        let Ok(route) = connect_to_targets(&mut space, &reach, &state(&start), &targets, budget, &mut go_on) else {
            continue;
        };
        reached += 1;
        assert_eq!(route.goal, 1);
        let end = route.path[route.path.len() - 1];
        let end = JointVector::from_fn(reach.joints(), |j| f64::from(end[j]));
        assert!(reach.pose(&end).distance(&targets[1].pose) < 1e-5);
        let none = connect_to_targets(&mut space, &reach, &state(&start), &[far], budget, &mut go_on);
        assert_eq!(none, Err(ConnectError::Goal { goals: 1 }));
    }
    assert!(reached > 10, "{reached}");
}

#[test]
fn a_path_that_keeps_the_tool_upright_does_so_between_its_postures_and_touches_nothing() {
    let mechanism = arm(1..=7);
    let reach = tool(&mechanism);
    let down = Pose::from_rpy([0.0; 3], PI, 0.0, 0.0);
    let target = Target::upright(down, 0.1);
    let constraint = Constraint::new(reach.clone(), target);
    let mut random = ChaCha8Rng::seed_from_u64(21);
    let (mut found, mut bent) = (0, 0);
    for seed in 0..20 {
        let mut ends = Vec::new();
        while ends.len() < 2 {
            let posture = reach.random(&mut random);
            let Some(kept) = reach.descend(&Target::upright(down, 0.02), &posture) else { continue };
            if Space::new(&mechanism, &[]).is_free(&state(&kept)) {
                ends.push(kept);
            }
        }
        let obstacles = clutter(&mut random, &mechanism, &ends);
        let mut space = Space::new(&mechanism, &obstacles);
        space.set_swept(true);
        let budget = Budget { iterations: 3_000, seed };
        let (start, goal) = (state(&ends[0]), state(&ends[1]));
        let route = match constrained::connect(&mut space, &constraint, &start, &[goal], budget, &mut go_on) {
            Ok(route) => route,
            Err(error) => {
                assert!(matches!(error, ConnectError::Exhausted { .. }), "{error}");
                continue;
            }
        };
        found += 1;
        bent += usize::from(!constraint.holds_along(&start, &goal));
        let mut path = route.path.clone();
        constrained::shorten(&mut space, &constraint, &mut path, constrained::SHORTCUTS, seed, &mut go_on).unwrap();
        assert_eq!((path[0], path[path.len() - 1]), (start, goal));
        assert!(path_length(&path) <= path_length(&route.path) + 1e-4);
        for pair in path.windows(2) {
            for i in 0..=8 {
                let between = between(&pair[0], &pair[1], i as f32 / 8.0);
                assert!(constraint.tilt_rad(&between) < 0.1 + 1e-3, "{}", constraint.tilt_rad(&between));
            }
        }
        let postures: Vec<Vec<f64>> = path.iter().map(|s| s[..7].iter().map(|q| f64::from(*q)).collect()).collect();
        assert_eq!(Exact::new(&mechanism, &obstacles).touch_along(&postures, 128.0), None);
        let again = constrained::connect(&mut space, &constraint, &start, &[goal], budget, &mut go_on).unwrap();
        assert_eq!(again, route);
    }
    assert!(found > 10 && bent > 5, "{found} found, {bent} of them not straight");
}

#[test]
fn a_start_that_is_not_upright_is_refused_as_such() {
    let mechanism = arm(1..=7);
    let constraint = Constraint::new(tool(&mechanism), Target::upright(Pose::IDENTITY, 0.1));
    let mut space = Space::new(&mechanism, &[]);
    let mut tilted = [0.0; MAX_JOINTS];
    tilted[1] = 0.6;
    let budget = Budget { iterations: 10, seed: 0 };
    let outcome = constrained::connect(&mut space, &constraint, &tilted, &[[0.0; MAX_JOINTS]], budget, &mut go_on);
    assert_eq!(outcome, Err(ConnectError::Constraint { which: "start" }));
}
