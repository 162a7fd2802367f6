//! Motions of the base: planned, timed, checked.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

use ratn_model::pose::Pose;
use ratn_motion::aimm;
use ratn_motion::base::{DriveError, DrivePlan, DriveRequest, DriveViolation, check_drive, plan_drive, riding};
use ratn_motion::cloud::Cloud;
use ratn_motion::pace::Control;
use ratn_motion::robot::{Configuration, Robot, UNSAID};
use ratn_motion::seen::Seen;
use ratn_motion::trajectory::Curve;
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};
use std::f64::consts::{FRAC_PI_2, PI};
use std::sync::Arc;

const STANDING: Configuration =
    Configuration { base: [0.0; 3], arm: aimm::STOWED, pan: 0.0, tilt: 0.0, finger: 0.055, others: UNSAID };

fn block(name: &str, pose: Pose, size: [f64; 3]) -> SceneObject {
    SceneObject { name: name.to_owned(), shape: Shape::Box { size }, placement: Placement::World(pose) }
}

fn cell(base: Pose, more: &[SceneObject]) -> Scene {
    let [x, y, z] = aimm::TABLE_CENTRE;
    let table = block("table", Pose::at(x, y, z), aimm::TABLE_SIZE);
    Scene { base, objects: [&[table], more].concat() }
}

fn to(goal: [f64; 3]) -> DriveRequest {
    DriveRequest {
        start: STANDING,
        goals: vec![goal],
        position_tolerance_m: 0.0,
        heading_tolerance_rad: 0.0,
        seen: None,
        speed: 0.5,
        seed: 4,
    }
}

fn planned(scene: &Scene, request: &DriveRequest) -> Result<DrivePlan, DriveError> {
    plan_drive(&Robot::aimm(), scene, request, &mut |_| Control::Continue)
}

#[test]
fn the_base_drives_round_the_table_to_its_other_side_within_its_limits() {
    let robot = Robot::aimm();
    let scene = cell(Pose::IDENTITY, &[]);
    let plan = planned(&scene, &to([1.75, 0.0, PI])).unwrap();
    assert!((plan.end[0] - 1.75).abs() < 1e-5 && plan.end[1].abs() < 1e-5 && (plan.end[2].abs() - PI).abs() < 1e-5);
    let driven = check_drive(&robot, &scene, &STANDING, &[], &plan.trajectory).unwrap();
    for knot in driven.knots() {
        assert!(knot.velocities.iter().all(|v| v.abs() <= 0.4 * 1.001), "faster than half of 0.8 m/s: {knot:?}");
    }
    // 2 m of table and base are in between: it cannot go straight.
    assert!(driven.knots().iter().any(|k| k.positions[1].abs() > 0.8));
    assert_eq!(planned(&scene, &to([1.75, 0.0, PI])).unwrap(), plan, "the same request gives the same plan");
}

#[test]
fn what_is_in_the_way_starts_elsewhere_or_is_too_fast_is_refused_with_the_reason() {
    let robot = Robot::aimm();
    let check = |scene: &Scene, at: &Configuration, plan: &DrivePlan| {
        check_drive(&robot, scene, at, &[], &plan.trajectory).map(drop)
    };
    let scene = cell(Pose::IDENTITY, &[]);
    let back = planned(&scene, &to([-1.5, 0.0, 0.0])).unwrap();
    check(&scene, &STANDING, &back).unwrap();
    let there = Configuration { base: [0.1, 0.0, 0.0], ..STANDING };
    assert!(
        matches!(check(&scene, &there, &back), Err(DriveViolation::Start { metres, .. }) if (metres - 0.1).abs() < 1e-6)
    );
    let turned = Configuration { base: [0.0, 0.0, 2.0 * PI], ..STANDING };
    check(&scene, &turned, &back).unwrap();

    let crate_there = cell(Pose::IDENTITY, &[block("crate", Pose::at(-1.5, 0.0, 0.2), [0.4; 3])]);
    let refused = check(&crate_there, &STANDING, &back).unwrap_err();
    assert!(
        matches!(&refused, DriveViolation::Touch { touch, time_s } if touch.other == "crate" && *time_s > 0.1),
        "{refused}"
    );

    let mut hasty = back.clone();
    for point in &mut hasty.trajectory.points {
        point.time_s /= 4.0;
        point.velocities.iter_mut().for_each(|v| *v *= 4.0);
    }
    let refused = check(&scene, &STANDING, &hasty).unwrap_err();
    assert!(refused.to_string().contains("base_x reaches"), "{refused}");
    assert!(matches!(planned(&scene, &to([9.0, 0.0, 0.0])), Err(DriveError::Goal { goals: 1, .. })));
}

#[test]
fn a_goal_that_is_not_free_is_missed_within_the_tolerance_and_no_further() {
    // The base reaches 0.35 m ahead of its middle: at 0.2 it would be in the crate.
    let scene = cell(Pose::at(-1.5, 0.0, 0.0), &[block("crate", Pose::at(0.65, 0.0, 0.2), [0.2, 2.0, 0.4])]);
    let request = DriveRequest { start: Configuration { base: [-1.5, 0.0, 0.0], ..STANDING }, ..to([0.21, 0.0, 0.0]) };
    assert!(matches!(planned(&scene, &request), Err(DriveError::Goal { .. })));
    let loose = DriveRequest { position_tolerance_m: 0.15, heading_tolerance_rad: 0.1, ..request };
    let end = planned(&scene, &loose).unwrap().end;
    let missed = (end[0] - 0.21).hypot(end[1]);
    assert!(missed > 0.0 && missed <= 0.15 + 1e-6 && end[2].abs() <= 0.1 + 1e-6, "{end:?}");
}

/// Balls of 1 cm about points, of which the camera may be 2 cm off.
fn seen(points: &[[f32; 3]]) -> Seen {
    Seen { cloud: Arc::new(Cloud::new("what was seen", points, 0.01).unwrap()), known_within_m: 0.02 }
}

/// Points on a grid of a rectangle that stands or lies, 2 cm apart.
fn grid([x0, x1]: [i16; 2], [y0, y1]: [i16; 2], [z0, z1]: [i16; 2]) -> Vec<[f32; 3]> {
    let steps = |from: i16, to: i16| (from..=to).step_by(2).map(|cm| f32::from(cm) / 100.0);
    let mut points = Vec::new();
    for x in steps(x0, x1) {
        for y in steps(y0, y1) {
            points.extend(steps(z0, z1).map(|z| [x, y, z]));
        }
    }
    points
}

#[test]
fn the_base_drives_around_what_a_camera_saw_and_over_the_floor_that_it_saw() {
    let scene = cell(Pose::IDENTITY, &[]);
    let goal = [-2.5, 0.0, 0.0];
    let straight = planned(&scene, &to(goal)).unwrap();
    assert!((straight.length - 2.5).abs() < 1e-3);
    // The floor, measured 1.9 cm too high at the most; and what is seen of robot and table is of these.
    let mut points = grid([-400, 200], [-200, 200], [0, 0]);
    points.iter_mut().enumerate().for_each(|(i, point)| point[2] = [0.0, 0.012, 0.019][i % 3]);
    points.extend(grid([-30, 30], [-20, 20], [30, 40]));
    let with = |points: &[[f32; 3]]| planned(&scene, &DriveRequest { seen: Some(seen(points)), ..to(goal) });
    assert_eq!(with(&points).unwrap(), straight);
    // A post on the way.
    let post = grid([-126, -124], [-2, 2], [10, 60]);
    points.extend(&post);
    let around = with(&points).unwrap();
    assert!(around.length > straight.length + 0.05, "{} m", around.length);
    let robot = Robot::aimm();
    let posts = block("post", Pose::at(-1.25, 0.0, 0.35), [0.02, 0.04, 0.5]);
    let refused =
        check_drive(&robot, &cell(Pose::IDENTITY, std::slice::from_ref(&posts)), &STANDING, &[], &straight.trajectory);
    assert!(matches!(refused, Err(DriveViolation::Touch { .. })));
    check_drive(&robot, &cell(Pose::IDENTITY, &[posts]), &STANDING, &[], &around.trajectory).unwrap();
}

#[test]
fn a_base_that_is_walled_in_by_what_was_seen_says_so() {
    let scene = cell(Pose::IDENTITY, &[]);
    let with = |seen: Seen| planned(&scene, &DriveRequest { seen: Some(seen), ..to([-2.5, 0.0, 0.0]) });
    // Closer to the base than it keeps from anything, and further than what counts as of the robot.
    let robot = Robot::aimm();
    let behind = robot.model.links[robot.body().unwrap()].bodies[0];
    let ratn_motion::geometry::Geometry::Box { half } = behind.geometry else { panic!("{behind:?}") };
    let x = ((behind.pose.position[0] - half[0] - 0.025) * 1000.0).round() as f32 / 1000.0;
    let error = with(seen(&[[x, 0.0, 0.3]])).unwrap_err();
    assert!(matches!(&error, DriveError::Start { touch: Some(touch) } if touch.other == "what was seen"), "{error}");
    let wall = grid([-150, -150], [-100, 100], [10, 40]);
    let around = grid([-150, 150], [-100, -100], [10, 40]).into_iter().chain(grid([-150, 150], [100, 100], [10, 40]));
    let ahead = grid([150, 150], [-100, 100], [10, 40]);
    let walls: Vec<[f32; 3]> = wall.into_iter().chain(around).chain(ahead).collect();
    let error = with(seen(&walls)).unwrap_err();
    assert!(matches!(error, DriveError::NoPath(_)), "{error}");
    let error = with(Seen { known_within_m: f64::NAN, ..seen(&walls) }).unwrap_err();
    assert_eq!(error.to_string(), "cloud_known_within_m is NaN: expected 0 to 1 m");
}

#[test]
fn a_head_or_an_arm_beyond_its_limits_is_refused() {
    let scene = cell(Pose::IDENTITY, &[]);
    let starts = [Configuration { pan: 90.0, ..STANDING }, Configuration { finger: -5.0, ..STANDING }];
    for (start, joint) in starts.into_iter().zip(["pan", "finger"]) {
        let error = planned(&scene, &DriveRequest { start, ..to([-1.0, 0.5, 0.3]) }).unwrap_err().to_string();
        assert!(error.starts_with(&format!("the start's {joint} is")), "{error}");
    }
}

#[test]
fn what_stands_on_the_deck_rides_along_wherever_the_base_stands() {
    let robot = Robot::aimm();
    let base = Pose::from_rpy([1.0, -2.0, 0.0], 0.0, 0.0, FRAC_PI_2);
    let on_deck = base.compose(&aimm::slots()[4]).compose(&Pose::at(0.0, 0.0, 0.052));
    let beside = base.compose(&Pose::at(-0.37, 0.5, 0.652));
    let scene = cell(base, &[block("cargo", on_deck, [0.1; 3]), block("beside", beside, [0.1; 3])]);
    assert_eq!(riding(&robot, &scene), ["cargo"]);
}

#[test]
fn what_reaches_over_the_deck_or_hangs_above_it_is_in_the_way() {
    let rack = |size: [f64; 3], gap_m: f64| {
        block("rack", Pose::at(-0.30, 0.0, aimm::DECK_HEIGHT_M + gap_m + size[2] / 2.0), size)
    };
    // A rack over the whole base, one that ends at its edges, and a box, which stands as exactly as it was measured.
    for (size, gap_m, rides) in [
        ([0.5, 1.6, 0.04], 0.025, false),
        ([0.5, 1.6, 0.04], 0.0, false),
        ([0.3, 0.3, 0.04], 0.025, false),
        ([0.3, 0.3, 0.04], 0.005, true),
        ([0.3, 0.3, 0.04], -0.005, true),
    ] {
        let scene = cell(Pose::IDENTITY, &[rack(size, gap_m)]);
        let planned = planned(&scene, &to([-1.0, 0.0, 0.0]));
        assert_eq!(riding(&Robot::aimm(), &scene), vec!["rack"; usize::from(rides)], "{size:?} {gap_m}");
        match planned {
            Ok(_) => assert!(rides, "{size:?} {gap_m}"),
            Err(error) => assert!(!rides && matches!(error, DriveError::Start { .. }), "{size:?} {gap_m}: {error}"),
        }
    }
}

#[test]
fn a_trajectory_of_the_arm_is_none_of_the_base() {
    let plan = planned(&cell(Pose::IDENTITY, &[]), &to([-1.0, 0.5, 0.3])).unwrap();
    let error = Curve::of(Robot::aimm().arm_joints(), &plan.trajectory).unwrap_err();
    assert!(error.to_string().starts_with("the trajectory moves [base_x, base_y, base_yaw]"), "{error}");
}
