//! Straight parts of motions: in any direction, in any frame, of any arm, and how straight they are when they are followed.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod common;
#[path = "common/robots.rs"]
mod robots;

use common::{Cell, request};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::aimm;
use ratn_motion::arm;
use ratn_motion::cloud::Cloud;
use ratn_motion::collision::{Checker, Collision, Contact};
use ratn_motion::geometry::Geometry;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::keep::Region;
use ratn_motion::line::{Cause, line, line_of_nearest};
use ratn_motion::pace::Control;
use ratn_motion::plan::{Goal, Plan, PlanError, Request, plan};
use ratn_motion::reach::{Reach, Target};
use ratn_motion::robot::{Configuration, Joint, Robot};
use ratn_motion::seen::Seen;
use ratn_motion::straight::{Frame, Straight};
use ratn_motion::timing::{Section, timed};
use ratn_motion::trajectory::{Curve, Knot};
use ratn_motion::way_points::WayPoints;
use ratn_world::scene::{Placement, SceneObject, Shape};
use robots::Arm;
use std::f64::consts::{FRAC_PI_2, FRAC_PI_4};
use std::sync::Arc;

/// How far a straight part may be from straight, in metres and radians.
const STRAIGHT_M: f64 = 1e-3;
const STRAIGHT_RAD: f64 = 2e-3;

/// What a validated motion may be beyond the limits of its joints by, in radians.
const LIMIT_RAD: f64 = 1e-4;

/// How far a point is from a line through another.
fn off(point: [f64; 3], through: [f64; 3], direction: [f64; 3]) -> f64 {
    let unit = direction.map(|c| c / direction.iter().map(|c| c * c).sum::<f64>().sqrt());
    let way: [f64; 3] = std::array::from_fn(|i| point[i] - through[i]);
    let along: f64 = (0..3).map(|i| way[i] * unit[i]).sum();
    (0..3).map(|i| (way[i] - along * unit[i]).powi(2)).sum::<f64>().sqrt()
}

/// Along lines of random directions and turns the tool is where it should be, a hundred times between any two knots of the timed motion.
fn check_timed(arm: &Arm, seed: u64) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let joints: &[Joint] = &arm.mechanism.joints;
    let (mut followed, mut refused) = (0, 0);
    for _ in 0..12 {
        let from = arm.tool.pose(&arm.home);
        let mut range = |most: f64| random.random_range(-most..most);
        let to =
            from.compose(&Pose::from_rpy([range(0.2), range(0.2), range(0.2)], range(0.5), range(0.5), range(0.5)));
        let Ok(postures) = line(&arm.tool, &arm.home, &to) else {
            refused += 1;
            continue;
        };
        followed += 1;
        let end = arm.tool.pose(postures.last().unwrap());
        assert!(end.distance(&to) < 1e-5 && end.angle(&to) < 1e-4);
        let curve = timed(joints, &[Section::AsGiven(postures)], 1.0, &mut |_, _| true);
        let way: [f64; 3] = std::array::from_fn(|i| to.position[i] - from.position[i]);
        let (whole, turn) = (from.distance(&to), from.angle(&to));
        for pair in curve.knots().windows(2) {
            for i in 0..100 {
                let t = pair[0].time_s + (pair[1].time_s - pair[0].time_s) * f64::from(i) / 100.0;
                let tool = arm.tool.pose(&curve.sample(t).positions);
                assert!(off(tool.position, from.position, way) < STRAIGHT_M, "{}", arm.mechanism.name);
                // It has turned by as much as it has gone.
                let share = tool.distance(&from) / whole;
                assert!((tool.angle(&from) - share * turn).abs() < STRAIGHT_RAD + turn * STRAIGHT_M / whole);
            }
        }
    }
    assert!(followed >= 6, "{}: {followed} followed, {refused} refused", arm.mechanism.name);
}

#[test]
fn the_tool_of_any_arm_goes_straight_between_all_samples() {
    check_timed(&robots::seven(), 1);
    check_timed(&robots::six(), 2);
    check_timed(&robots::lifted(), 3);
}

/// A posture, and a straight line from there whose poses can all be reached, each by itself.
fn reachable_line(reach: &Reach, random: &mut ChaCha8Rng) -> (JointVector, Pose) {
    loop {
        let start = reach.random(random);
        let from = reach.pose(&start);
        let mut range = |most: f64| random.random_range(-most..most);
        let way = [range(0.4), range(0.4), range(0.4)];
        let at = |share: f64| Pose { position: std::array::from_fn(|i| from.position[i] + share * way[i]), ..from };
        let is_reached = |i: u32| {
            let postures = reach.postures(&Target::at(at(f64::from(i) / 20.0)));
            !reach.nearest(&postures, &start).is_empty()
        };
        if (1..=20).all(is_reached) {
            return (start, at(1.0));
        }
    }
}

#[test]
fn most_lines_whose_poses_can_all_be_reached_are_followed_from_any_posture() {
    let reach = arm::reach(&Robot::aimm());
    let mut random = ChaCha8Rng::seed_from_u64(11);
    let (mut by_nearest, mut followed, mut from_another) = (0, 0, 0);
    for _ in 0..150 {
        let (start, to) = reachable_line(&reach, &mut random);
        let from = reach.pose(&start);
        by_nearest += usize::from(line_of_nearest(&reach, &start, &to).is_ok());
        let is_followed = line(&reach, &start, &to).is_ok();
        followed += usize::from(is_followed);
        // Its own random numbers, so that the lines are those of before.
        let mut other = ChaCha8Rng::seed_from_u64(12);
        let postures = reach.postures(&Target::at(from));
        let mut any = || {
            let postures = reach.anywhere(&postures, &start, &mut other);
            postures.iter().any(|posture| line(&reach, posture, &to).is_ok())
        };
        from_another += usize::from(is_followed || (0..10).any(|_| any()));
    }
    // Without shorter steps near singular postures 92 by the nearest.
    assert!(by_nearest >= 120, "{by_nearest} by the nearest postures");
    // Those that are missing have no way from their first posture: the arm would have to begin with another one.
    assert!(followed >= 132, "{followed} with the elbow turned on the way");
    assert!(from_another >= 149, "{from_another} from some posture of the first pose");
}

/// Lines that the nearest postures do not follow, but others do: the tool is on the line all the same, between all samples of the timed motion,
/// and the arm stops at few places.
fn check_other_elbows(name: &str, reach: &Reach, joints: &[Joint], lines: usize, at_least: usize) {
    let mut random = ChaCha8Rng::seed_from_u64(11);
    let mut other = 0;
    for _ in 0..lines {
        let (start, to) = reachable_line(reach, &mut random);
        let (Err(_), Ok(postures)) = (line_of_nearest(reach, &start, &to), line(reach, &start, &to)) else { continue };
        other += 1;
        let from = reach.pose(&start);
        let way: [f64; 3] = std::array::from_fn(|i| to.position[i] - from.position[i]);
        let end = reach.pose(postures.last().unwrap());
        assert!(end.distance(&to) < 1e-5 && end.angle(&to) < 1e-4 && postures[0] == start);
        let curve = timed(joints, &[Section::AsGiven(postures)], 1.0, &mut |_, _| true);
        let mut along = 0.0;
        for pair in curve.knots().windows(2) {
            for i in 0..100 {
                let t = pair[0].time_s + (pair[1].time_s - pair[0].time_s) * f64::from(i) / 100.0;
                let positions = curve.sample(t).positions;
                let tool = reach.pose(&positions);
                let (off_m, off_rad) = (off(tool.position, from.position, way), tool.angle(&from));
                assert!(off_m < STRAIGHT_M && off_rad < STRAIGHT_RAD, "{name}: {off_m} m, {off_rad} rad");
                // It may stand, but it does not go back.
                let here = tool.distance(&from);
                assert!(here > along - STRAIGHT_M, "{name}");
                along = along.max(here);
                let beyond = |(q, joint): (&f64, &Joint)| (joint.lower - q).max(q - joint.upper);
                let beyond = positions.iter().zip(joints).map(beyond).fold(f64::NEG_INFINITY, f64::max);
                assert!(beyond <= LIMIT_RAD, "{name}: {beyond} rad beyond a limit");
            }
        }
        let is_still = |knot: &&Knot| knot.velocities.iter().all(|v| v.abs() < 1e-6);
        let stops = curve.knots().iter().filter(is_still).count();
        assert!(stops <= 2 + 6, "{name}: {stops} stops");
    }
    assert!(other >= at_least, "{name}: {other} of {lines} over other elbows");
}

#[test]
fn an_arm_with_a_joint_more_turns_its_elbow_on_a_line_where_the_nearest_postures_end() {
    let robot = Robot::aimm();
    check_other_elbows("aimm", &arm::reach(&robot), robot.arm_joints(), 150, 7);
    let arm = robots::seven();
    check_other_elbows("seven", &arm.tool, &arm.mechanism.joints, 30, 1);
}

#[test]
fn the_elbow_makes_way_for_an_obstacle_while_the_tool_goes_straight() {
    let (mut blocked, mut passed, mut departed) = (0, 0, 0);
    for way in [[0.3, 0.0, 0.0], [-0.2, 0.0, 0.1], [0.0, 0.3, 0.0], [0.0, -0.3, 0.0], [0.0, 0.0, 0.3], [0.1, 0.2, 0.2]]
    {
        let mut cell = Cell::with_boxes(0, 1);
        cell.scene.objects.clear();
        cell.arm = aimm::HOME;
        let (start, reach) = (cell.arm, arm::reach(&cell.robot));
        let tool = cell.robot.tool_pose(&cell.state());
        let to = Pose { position: std::array::from_fn(|i| tool.position[i] + way[i]), ..tool };
        let base = arm::on_floor(&cell.robot, &cell.scene.base);
        let Ok(postures) = line_of_nearest(&reach, &start, &base.inverse().compose(&to)) else { continue };
        // A ball where the elbow would be in the end.
        let elbow = |cell: &Cell| cell.robot.pose(&cell.state(), cell.robot.link("arm_4").unwrap());
        cell.arm = *postures.last().unwrap();
        let in_the_end = elbow(&cell);
        cell.arm = start;
        cell.scene.objects.push(SceneObject {
            name: "ball".into(),
            shape: Shape::Box { size: [0.02; 3] },
            placement: Placement::World(in_the_end),
        });
        let mut exact = Checker::new(&cell.robot, &cell.scene, &cell.state(), 0.01);
        if exact.collision(&start, Contact::None).is_some() {
            continue;
        }
        blocked += 1;
        let length_m = way.iter().map(|c| c * c).sum::<f64>().sqrt();
        let depart = Straight { direction: way, frame: Frame::World, length_m };
        if let Ok(plan) = cell.plan(&Request { depart, ..request(cell.state(), vec![Goal::Joints(start)]) }) {
            departed += 1;
            let curve = Curve::of_arm(&cell.robot, &plan.trajectory).unwrap();
            let mut unpadded = Checker::new(&cell.robot, &cell.scene, &cell.state(), 0.0);
            assert!(curve.knots().iter().all(|knot| unpadded.is_free(&knot.positions, Contact::None)));
            let there = |knot: &Knot| base.compose(&reach.pose(&knot.positions)).distance(&to);
            assert!(curve.knots().iter().map(there).fold(f64::INFINITY, f64::min) < STRAIGHT_M);
        }
        let straight = Some(WayPoints::default());
        let request = Request { straight, ..request(cell.state(), vec![Goal::Pose(to)]) };
        if let Ok(plan) = cell.plan(&request) {
            passed += 1;
            assert!(plan.end_pose.distance(&to) < 1e-5 && plan.end_pose.angle(&to) < 1e-4);
            let curve = Curve::of_arm(&cell.robot, &plan.trajectory).unwrap();
            for knot in curve.knots() {
                let here = base.compose(&reach.pose(&knot.positions));
                assert!(off(here.position, tool.position, way) < STRAIGHT_M);
                assert_eq!(exact.collision(&knot.positions, Contact::None), None);
            }
        }
    }
    assert!(blocked >= 3 && passed >= 2 && departed >= 2, "{passed} and {departed} of {blocked}");
}

#[test]
fn a_departure_that_cannot_be_followed_ends_where_the_caller_says_so() {
    let (cell, _) = turned_cell();
    let depart = Straight { direction: [1.0, 0.0, 0.0], frame: Frame::World, length_m: 0.5 };
    let far = Request { depart, ..request(cell.state(), vec![Goal::Joints(aimm::HOME)]) };
    let planned = |answers: &mut dyn FnMut(usize) -> Control| {
        let mut asked = 0;
        let found = plan(&cell.robot, &cell.scene, &far, &mut |_| {
            asked += 1;
            answers(asked)
        });
        (found.unwrap_err(), asked)
    };
    let (refused, asked) = planned(&mut |_| Control::Continue);
    assert!(matches!(refused, PlanError::Depart { .. }) && asked > 10, "{refused} {asked}");
    for at in [1, asked / 2] {
        let stopped = |with: Control| planned(&mut |asked| if asked < at { Control::Continue } else { with });
        assert_eq!(stopped(Control::Cancelled), (PlanError::Cancelled, at));
        assert_eq!(stopped(Control::TimeUp), (PlanError::TimeUp, at));
    }
}

#[test]
fn a_line_that_cannot_be_followed_says_how_far_and_which_joint_ends_it() {
    for arm in robots::all() {
        let from = arm.tool.pose(&arm.home);
        let far = Pose { position: [from.position[0], from.position[1], from.position[2] + 2.0], ..from };
        let error = line(&arm.tool, &arm.home, &far).unwrap_err();
        assert!(error.reached_m > 0.0 && error.reached_m < 1.5 && (error.wanted_m - 2.0).abs() < 1e-9, "{error}");
        let said = error.to_string();
        assert!(said.contains("m of 2.000 m: "), "{said}");
    }
    // The first joint has a limit on the way round.
    let arm = robots::six();
    let mut held = arm.home;
    held[0] = 3.1;
    let from = arm.tool.pose(&held);
    let turned = Pose::from_rpy([0.0; 3], 0.0, 0.0, 0.2).compose(&from);
    let error = line(&arm.tool, &held, &turned).unwrap_err();
    assert!(matches!(&error.cause, Cause::Limit { joint } if joint == "j1"), "{error}");
    // The wrist is stretched: it would have to flip.
    let mut singular = arm.home;
    singular[4] = 1e-4;
    let from = arm.tool.pose(&singular);
    let aside = Pose { position: [from.position[0], from.position[1] + 0.15, from.position[2]], ..from };
    if let Err(error) = line(&arm.tool, &singular, &aside) {
        assert!(matches!(&error.cause, Cause::Flip { .. } | Cause::OutOfReach), "{error}");
    }
}

/// How far the tool is from the straight line, in metres and radians, at the end of a motion (from its beginning where `sense` is -1) for
/// half of `part`, a hundred times between any two knots; and where it goes, in the world.
fn strays(cell: &Cell, plan: &Plan, at_end: bool, length_m: f64) -> (f64, f64, [f64; 3]) {
    let trajectory = Curve::of_arm(&cell.robot, &plan.trajectory).unwrap();
    let (reach, base) = (arm::reach(&cell.robot), arm::on_floor(&cell.robot, &cell.scene.base));
    let tool = |t: f64| base.compose(&reach.pose(&trajectory.sample(t).positions));
    let rest = tool(if at_end { trajectory.duration_s() } else { 0.0 });
    let mut times = Vec::new();
    for pair in trajectory.knots().windows(2) {
        let h = pair[1].time_s - pair[0].time_s;
        times.extend((0..100).map(|i| pair[0].time_s + h * f64::from(i) / 100.0));
    }
    if at_end {
        times.reverse();
    }
    let near: Vec<Pose> = times.into_iter().map(tool).take_while(|t| t.distance(&rest) <= length_m / 2.0).collect();
    let far = near.last().unwrap();
    let sign = if at_end { 1.0 } else { -1.0 };
    let way: [f64; 3] = std::array::from_fn(|i| sign * (rest.position[i] - far.position[i]) / rest.distance(far));
    let most = |f: &dyn Fn(&Pose) -> f64| near.iter().map(f).fold(0.0, f64::max);
    (most(&|t| off(t.position, rest.position, way)), most(&|t| t.angle(&rest)), way)
}

fn assert_goes(cell: &Cell, plan: &Plan, at_end: bool, length_m: f64, direction: [f64; 3]) {
    let (stray_m, turn_rad, way) = strays(cell, plan, at_end, length_m);
    assert!(stray_m < STRAIGHT_M && turn_rad < STRAIGHT_RAD, "{stray_m} m, {turn_rad} rad off");
    let length = direction.iter().map(|c| c * c).sum::<f64>().sqrt();
    let along: f64 = (0..3).map(|i| way[i] * direction[i] / length).sum();
    assert!(along > 0.999, "it goes along {way:?} instead of {direction:?}");
}

/// A cell without boxes whose base is turned, a goal in the air whose tool points ahead and down, and something that stands turned.
fn turned_cell() -> (Cell, Pose) {
    let mut cell = Cell::with_boxes(0, 1);
    cell.scene.base = Pose::from_rpy([-0.1, 0.05, 0.0], 0.0, 0.0, 0.3);
    cell.scene.objects.push(SceneObject {
        name: "shelf".into(),
        shape: Shape::Box { size: [0.1, 0.2, 0.3] },
        placement: Placement::World(Pose::from_rpy([0.0, 1.5, 0.5], 0.0, 0.0, FRAC_PI_4)),
    });
    let home = arm::reach(&cell.robot).pose(&aimm::HOME);
    let goal = cell.scene.base.compose(&home).compose(&Pose::from_rpy([0.03, 0.02, 0.0], 0.1, -0.6, 0.2));
    (cell, goal)
}

#[test]
fn an_approach_and_a_departure_go_in_any_direction_of_any_frame() {
    let (mut cell, goal) = turned_cell();
    let in_frame = |frame: Frame, direction: [f64; 3], goal: &Pose| match frame {
        Frame::World => direction,
        Frame::Base => Pose::from_rpy([0.0; 3], 0.0, 0.0, 0.3).rotate(direction),
        Frame::Tool => goal.rotate(direction),
        Frame::Object(_) => Pose::from_rpy([0.0; 3], 0.0, 0.0, FRAC_PI_4).rotate(direction),
    };
    for (frame, direction) in [
        (Frame::World, [1.0, 0.0, 0.0]),
        (Frame::Base, [2.0, 0.0, -1.0]),
        (Frame::Tool, [0.0, 0.0, 1.0]),
        (Frame::from("shelf"), [0.0, 1.0, -0.5]),
    ] {
        let part = Straight { direction, frame: frame.clone(), length_m: 0.08 };
        let there = Request { approach: part, ..request(cell.state(), vec![Goal::Pose(goal)]) };
        let plan = cell.plan(&there).unwrap_or_else(|e| panic!("{frame:?}: {e}"));
        assert!(plan.end_pose.distance(&goal) < 1e-5 && plan.end_pose.angle(&goal) < 1e-4);
        assert_goes(&cell, &plan, true, 0.08, in_frame(frame.clone(), direction, &goal));

        let begin = cell.arm;
        cell.follow(&plan);
        let back = direction.map(|c| -c);
        let part = Straight { direction: back, frame: frame.clone(), length_m: 0.08 };
        let away = Request { depart: part, ..request(cell.state(), vec![Goal::Joints(begin)]) };
        let plan = cell.plan(&away).unwrap_or_else(|e| panic!("{frame:?}: {e}"));
        assert_goes(&cell, &plan, false, 0.08, in_frame(frame, back, &goal));
        cell.follow(&plan);
    }
}

#[test]
fn what_is_held_lends_its_axes_too() {
    let (mut cell, goal) = turned_cell();
    let held = Pose::from_rpy([0.0, 0.0, 0.05], 0.0, FRAC_PI_2, 0.0);
    let shape = Shape::Box { size: [0.04; 3] };
    cell.scene.objects.push(SceneObject { name: "peg".into(), shape, placement: Placement::Gripper(held) });
    let part = Straight { direction: [-1.0, 0.0, 0.0], frame: Frame::from("peg"), length_m: 0.06 };
    let request = Request { approach: part, ..request(cell.state(), vec![Goal::Pose(goal)]) };
    let plan = cell.plan(&request).unwrap();
    assert_goes(&cell, &plan, true, 0.06, goal.rotate(held.rotate([-1.0, 0.0, 0.0])));
}

#[test]
fn a_straight_part_that_makes_no_sense_is_refused_with_what_is_expected() {
    let (cell, goal) = turned_cell();
    let part = |direction: [f64; 3], frame: &str, length_m: f64| Straight { direction, frame: frame.into(), length_m };
    for (part, expected) in [
        (part([0.0; 3], "world", 0.1), "approach_direction is [0.0, 0.0, 0.0]: expected a direction"),
        (part([f64::NAN, 0.0, 1.0], "world", 0.1), "approach_direction is [NaN, 0.0, 1.0]: expected a direction"),
        (
            part([1.0, 0.0, 0.0], "self", 0.1),
            "approach_frame is self: expected world, base, tool, or an object of the scene (table, shelf)",
        ),
        (part([1.0, 0.0, 0.0], "tool", 0.6), "approach_m is 0.6: expected 0 to 0.5 m"),
    ] {
        let request = Request { approach: part, ..request(cell.state(), vec![Goal::Pose(goal)]) };
        let error = cell.plan(&request).unwrap_err();
        assert!(matches!(error, PlanError::Malformed { .. }) && error.to_string().starts_with(expected), "{error}");
    }
    // Where no part is wanted its frame is not looked at.
    let none =
        Request { approach: part([1.0, 0.0, 0.0], "self", 0.0), ..request(cell.state(), vec![Goal::Pose(goal)]) };
    cell.plan(&none).unwrap();
    // What does not fit the arm says which part, where it goes, how far the arm gets and why.
    let ahead = part([1.0, 0.0, 0.0], "world", 0.5);
    let far = request(cell.state(), vec![Goal::Joints(aimm::HOME)]);
    let said = cell.plan(&Request { depart: ahead, ..far }).unwrap_err().to_string();
    assert!(said.starts_with("departing 0.500 m along (1, 0, 0) of the world: "), "{said}");
}

#[test]
fn a_departure_presses_no_neighbour_that_is_not_pressed_where_it_begins() {
    // The fingers leave sideways, past a post that one of them presses by so much on its way, but not at the start.
    let leaves = |press_m: f64| {
        let mut cell = Cell::with_boxes(0, 1);
        cell.follow(&cell.plan(&request(cell.state(), vec![Goal::Joints(aimm::HOME)])).unwrap());
        let tool = cell.robot.tool_pose(&cell.state());
        let finger = cell.robot.link("finger_left").unwrap();
        let body = cell.robot.model.links[finger].bodies[0];
        let Geometry::Box { half } = body.geometry else { panic!("{body:?}") };
        let centre = tool.inverse().compose(&cell.robot.pose(&cell.state(), finger)).compose(&body.pose).position;
        let aside = centre[1] + centre[1].signum() * (half[1] + 0.015 - press_m);
        let place = Pose::at(centre[0] + half[0] + 0.05, aside, centre[2]);
        stand(&mut cell, "post", Shape::Box { size: [0.03; 3] }, tool.compose(&place));
        let mut exact = Checker::new(&cell.robot, &cell.scene, &cell.state(), 0.0);
        assert_eq!(exact.collision(&cell.arm, Contact::None), None);
        let depart = Straight { direction: [1.0, 0.0, 0.0], frame: Frame::Tool, length_m: 0.16 };
        cell.plan(&Request { depart, ..request(cell.state(), vec![Goal::Joints(aimm::OBSERVATION)]) })
    };
    leaves(-0.002).unwrap();
    for press_m in [0.002, 0.005, 0.010] {
        let Err(refused) = leaves(press_m) else { panic!("a post is pressed by {press_m} m") };
        assert!(matches!(refused, PlanError::Depart { .. }) && refused.to_string().contains("post"), "{refused}");
    }
}

fn stand(cell: &mut Cell, name: &str, shape: Shape, pose: Pose) {
    cell.scene.objects.push(SceneObject { name: name.into(), shape, placement: Placement::World(pose) });
}

/// The arm at home above no table, with something in its fingers and something in its way, which is given in the frame of the tool.
fn holding([held, at]: [(Shape, Pose); 2]) -> Cell {
    let mut cell = Cell::with_boxes(0, 1);
    cell.scene.objects.clear();
    cell.arm = aimm::HOME;
    let placement = Placement::Gripper(held.1);
    cell.scene.objects.push(SceneObject { name: "held".into(), shape: held.0, placement });
    let tool = cell.robot.tool_pose(&cell.state());
    stand(&mut cell, "obstacle", at.0, tool.compose(&at.1));
    cell
}

/// A departure from home of 0.1 m straight up, and an approach of 0.1 m down to it.
fn up_and_down(cell: &Cell) -> [Result<Plan, PlanError>; 2] {
    let up = Request { depart: Straight::up(0.1), ..request(cell.state(), vec![Goal::Joints(aimm::OBSERVATION)]) };
    let from = Configuration { arm: aimm::OBSERVATION, ..cell.state() };
    let down = Request { approach: Straight::down(0.1), ..request(from, vec![Goal::Joints(aimm::HOME)]) };
    [up, down].map(|request| cell.plan(&request))
}

#[test]
fn what_is_held_does_not_pass_through_a_thin_thing_on_a_straight_part() {
    let pen = (Shape::Cylinder { radius: 0.004, length: 0.16 }, Pose::from_rpy([0.0; 3], 0.0, FRAC_PI_2, 0.0));
    // A rod across the pen, and one that leads past its end.
    for (aside_m, passes) in [(0.055, false), (0.09, true)] {
        for radius in [0.0008, 0.0025, 0.0035] {
            let across = Pose::from_rpy([aside_m, 0.0, -0.06], FRAC_PI_2, 0.0, 0.0);
            let cell = holding([pen, (Shape::Cylinder { radius, length: 0.08 }, across)]);
            for planned in up_and_down(&cell) {
                let said = planned.as_ref().map_or_else(ToString::to_string, |_| String::new());
                assert!(planned.is_ok() == passes && (passes || said.contains("obstacle")), "{radius}: {said}");
            }
        }
    }
}

#[test]
fn what_is_held_does_not_pass_a_shelf_that_covers_its_edge() {
    let crate_ = (Shape::Box { size: [0.16, 0.07, 0.04] }, Pose::IDENTITY);
    for (over_m, passes) in [(0.006, false), (0.002, false), (-0.003, true)] {
        let shelf = Pose::at(over_m - 0.08 - 0.15, 0.0, -0.05);
        let cell = holding([crate_, (Shape::Box { size: [0.30, 0.30, 0.02] }, shelf)]);
        for planned in up_and_down(&cell) {
            let said = planned.as_ref().map_or_else(ToString::to_string, |_| String::new());
            assert!(planned.is_ok() == passes && (passes || said.contains("obstacle")), "{over_m}: {said}");
        }
    }
}

#[test]
fn a_neighbour_that_is_pressed_at_the_goal_may_be_pressed_on_the_whole_straight_part() {
    // In a row: what is held stands between two neighbours, and presses both.
    let crate_ = (Shape::Box { size: [0.16, 0.07, 0.06] }, Pose::IDENTITY);
    for press_m in [0.003, 0.006] {
        let beside = |side: f64| Pose::at(side * (0.08 + 0.03 - press_m), 0.0, 0.0);
        let block = Shape::Box { size: [0.06, 0.06, 0.06] };
        let mut cell = holding([crate_, (block, beside(1.0))]);
        let tool = cell.robot.tool_pose(&cell.state());
        stand(&mut cell, "other", block, tool.compose(&beside(-1.0)));
        for planned in up_and_down(&cell) {
            planned.unwrap_or_else(|error| panic!("{press_m}: {error}"));
        }
    }
}

#[test]
fn what_is_held_goes_up_beside_what_a_camera_has_seen_and_not_into_it() {
    let crate_ = (Shape::Box { size: [0.44, 0.07, 0.06] }, Pose::IDENTITY);
    // A wall that is passed on the way up; the planner forgets what is within 2 cm of the robot and what it holds.
    for (gap_m, passes) in [(0.007, true), (-0.003, false)] {
        let nothing = (Shape::Box { size: [0.01; 3] }, Pose::at(0.0, 0.0, 0.8));
        let cell = holding([crate_, nothing]);
        let tool = cell.robot.tool_pose(&cell.state());
        let place = |i: i32, j: i32| Pose::at(0.22 + gap_m, f64::from(j) * 0.005, f64::from(i) * 0.005);
        let points: Vec<[f32; 3]> = (-16..=0)
            .flat_map(|i| (-8..=8).map(move |j| (i, j)))
            .map(|(i, j)| tool.compose(&place(i, j)).position.map(|c| c as f32))
            .collect();
        let cloud = Arc::new(Cloud::new("seen", &points, 0.01).unwrap());
        let seen = Some(Seen { cloud, known_within_m: 0.02 });
        let up = Request {
            depart: Straight::up(0.15),
            seen,
            ..request(cell.state(), vec![Goal::Joints(aimm::OBSERVATION)])
        };
        let planned = cell.plan(&up);
        let said = planned.as_ref().map_or_else(ToString::to_string, |_| String::new());
        assert!(planned.is_ok() == passes && (passes || said.contains("seen")), "{gap_m}: {said}");
    }
}

#[test]
fn far_from_the_origin_nothing_changes() {
    let moved = |by: &Pose, pose: &Pose| by.compose(pose);
    let cell = |base: Pose| {
        let mut cell = Cell::with_boxes(9, 3);
        cell.scene.base = moved(&base, &cell.scene.base);
        for object in &mut cell.scene.objects {
            if let Placement::World(pose) = &mut object.placement {
                *pose = moved(&base, pose);
            }
        }
        let held = Placement::Gripper(Pose::IDENTITY);
        let shape = Shape::Box { size: [0.16, 0.07, 0.10] };
        cell.scene.objects.push(SceneObject { name: "held".into(), shape, placement: held });
        cell
    };
    let region = |base: &Pose| Region { pose: moved(base, &Pose::at(0.5, 0.5, 0.9)), size: [0.3; 3] };
    let (origin, away) = (Pose::IDENTITY, Pose::from_rpy([530_000.03, 180_000.02, 0.0], 0.0, 0.0, 0.7));
    let (here, there) = (cell(origin), cell(away));
    let mut near = Checker::new(&here.robot, &here.scene, &here.state(), 0.002).keeping_out_of(&[region(&origin)]);
    let mut far = Checker::new(&there.robot, &there.scene, &there.state(), 0.002).keeping_out_of(&[region(&away)]);
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let (mut free, mut met) = (0, 0);
    for _ in 0..400 {
        let arm = JointVector::from_fn(7, |j| {
            here.robot.arm_joints()[j].clamp(aimm::OBSERVATION[j] + random.random_range(-0.5..0.5))
        });
        let [a, b] = [&mut near, &mut far].map(|checker| checker.collision(&arm, Contact::None));
        let apart = |a: &Collision, b: &Collision| {
            a.moving != b.moving || a.other != b.other || (a.depth_m - b.depth_m).abs() > 1e-5
        };
        let differs = match (&a, &b) {
            (None, None) => false,
            (Some(a), Some(b)) => apart(a, b),
            _ => true,
        };
        assert!(!differs, "{a:?} {b:?}");
        *if a.is_none() { &mut free } else { &mut met } += 1;
    }
    assert!(free > 50 && met > 50, "{free} {met}");
}
