//! A pose that can be reached is found: poses of random postures, on arms that fall apart in different ways and on one that does not.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

#[path = "common/robots.rs"]
mod robots;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::reach::{Reach, Target, distance};
use ratn_motion::robot::Robot;
use robots::Arm;

/// Attempts for one pose; planners take as many or more.
const ATTEMPTS: usize = 20;

/// Poses per robot in the gate,
const FEW: usize = 150;
/// and in the long test.
const MANY: usize = 10_000;

fn all() -> Vec<(&'static str, Reach)> {
    let named = |(name, arm): (&'static str, Arm)| (name, arm.tool);
    let mut all = vec![("aimm", ratn_motion::arm::reach(&Robot::aimm()))];
    all.extend(robots::many().map(named));
    all
}

/// Random reachable poses are reached, within the limits, the nearest to a posture of the pose by that posture or one as near.
fn check(name: &str, reach: &Reach, poses: usize) {
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let (mut missed, mut at_once) = (Vec::new(), 0);
    let home = reach.clamp(&JointVector::zeros(reach.joints()));
    for _ in 0..poses {
        let posture = reach.random(&mut random);
        let target = Target::at(reach.pose(&posture));
        let found = reach.solutions(&target, &home, 1, ATTEMPTS, &mut random);
        let postures = reach.postures(&target);
        at_once += usize::from(!reach.nearest(&postures, &home).is_empty());
        if found.is_empty() {
            missed.push(posture);
            continue;
        }
        for posture in &found {
            holds(reach, &target, posture);
        }
        let nearest = reach.nearest(&postures, &posture);
        assert!(distance(&nearest[0], &posture) < 1e-3, "{name}: {posture:?} is its own nearest, not {nearest:?}");
    }
    eprintln!("{name}: {at_once} of {poses} in the first attempt, {} not in {ATTEMPTS}", missed.len());
    assert!(missed.is_empty(), "{name}: {} of {poses} poses were not found: {missed:?}", missed.len());
}

fn holds(reach: &Reach, target: &Target, posture: &JointVector) {
    let pose = reach.pose(posture);
    assert!(pose.distance(&target.pose) < 2e-6 && pose.angle(&target.pose) < 4e-6, "{pose:?} is not {target:?}");
    assert_eq!(reach.clamp(posture), *posture, "within the limits");
}

#[test]
fn every_pose_that_a_robot_can_reach_is_found_within_its_limits() {
    for (name, reach) in all() {
        check(name, &reach, FEW);
    }
}

#[test]
#[ignore = "10,000 poses of each robot: half a minute in a debug build"]
fn every_one_of_ten_thousand_poses_is_found() {
    for (name, reach) in all() {
        check(name, &reach, MANY);
    }
}

#[test]
fn of_an_arm_of_six_joints_all_postures_are_known_and_when_there_are_none() {
    let reach = robots::six().tool;
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let mut counts = [0; 9];
    for _ in 0..200 {
        let posture = reach.random(&mut random);
        let target = Target::at(reach.pose(&posture));
        let found = reach.nearest(&reach.postures(&target), &posture);
        counts[found.len()] += 1;
        // What descents find from anywhere is among them.
        for _ in 0..3 {
            let Some(other) = reach.descend(&target, &reach.random(&mut random)) else { continue };
            let near = found.iter().map(|posture| turned_apart(posture, &other)).fold(f64::INFINITY, f64::min);
            assert!(near < 1e-2, "{other:?} is none of {found:?}");
        }
        let away = target.pose.position.map(|c| c * 3.0 + 2.0);
        let postures = reach.postures(&Target::at(Pose { position: away, ..target.pose }));
        assert!(postures.is_empty() && reach.nearest(&postures, &posture).is_empty());
    }
    assert!(counts[8] > 20, "eight postures are usual: {counts:?}");
}

/// The greatest difference of two postures, whole turns aside.
fn turned_apart(a: &JointVector, b: &JointVector) -> f64 {
    let turn = std::f64::consts::TAU;
    a.iter().zip(b).map(|(a, b)| ((a - b) - turn * ((a - b) / turn).round()).abs()).fold(0.0, f64::max)
}

#[test]
fn a_joint_that_turns_more_than_once_takes_the_turn_nearest_to_where_it_is() {
    let reach = robots::six_twice_around().tool;
    let mut random = ChaCha8Rng::seed_from_u64(9);
    for _ in 0..50 {
        let posture = reach.random(&mut random);
        let target = Target::at(reach.pose(&posture));
        let postures = reach.postures(&target);
        assert!(distance(&reach.nearest(&postures, &posture)[0], &posture) < 1e-3);
        // Anywhere, other turns are found as well.
        let ways: Vec<JointVector> = (0..10).flat_map(|_| reach.anywhere(&postures, &posture, &mut random)).collect();
        let other = |way: &&JointVector| turned_apart(way, &posture) < 1e-3 && distance(way, &posture) > 1.0;
        assert!(ways.iter().any(|way| other(&way)), "{posture:?}");
    }
}

#[test]
fn a_pose_that_leaves_a_joint_free_is_reached() {
    let reach = robots::six().tool;
    // The last axis is in line with the three parallel ones.
    let mut random = ChaCha8Rng::seed_from_u64(4);
    for _ in 0..20 {
        let mut posture = reach.random(&mut random);
        posture[4] = 0.0;
        let target = Target::at(reach.pose(&posture));
        let found = reach.solutions(&target, &JointVector::zeros(reach.joints()), 1, ATTEMPTS, &mut random);
        assert!(!found.is_empty(), "{posture:?}");
        holds(&reach, &target, &found[0]);
    }
}

#[test]
fn limits_beyond_half_a_turn_keep_what_an_arm_of_seven_joints_reaches() {
    let urdf = include_str!("../robots/aimm.urdf");
    // The zero of joint 2 moved by 3.5 rad: the same arm, that counts otherwise.
    let second = "<parent link=\"arm_1\"/><child link=\"arm_2\"/><origin xyz=\"0 0 0.2005\"/><axis xyz=\"0 -1 0\"/>\n    \
        <limit lower=\"-2.0943951023931953\" upper=\"2.0943951023931953\"";
    let moved = "<parent link=\"arm_1\"/><child link=\"arm_2\"/><origin xyz=\"0 0 0.2005\" rpy=\"0 3.5 0\"/><axis xyz=\"0 -1 0\"/>\n    \
        <limit lower=\"1.4056048976068047\" upper=\"5.594395102393195\"";
    let first = "<child link=\"arm_1\"/><origin xyz=\"0 0 0.11\"/><axis xyz=\"0 0 1\"/>\n    \
        <limit lower=\"-2.9670597283903604\" upper=\"2.9670597283903604\"";
    let endless = first.replace("-2.9670597283903604", "-6.1").replace("\"2.9670597283903604", "\"5.8");
    assert!(urdf.contains(second) && urdf.contains(first));
    let joints: Vec<String> = (1..=7).map(|n| format!("arm_joint_{n}")).collect();
    for (name, urdf) in [("moved", urdf.replace(second, moved)), ("endless", urdf.replace(first, &endless))] {
        let arm = ratn_motion::mechanism::Mechanism::read(&urdf, None, &joints).unwrap();
        check(name, &Reach::new(&arm, arm.link("tool").unwrap(), Pose::IDENTITY), FEW);
    }
}
