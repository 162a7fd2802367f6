//! An arm whose gripper is in something where it stands, because that was moved there or is not where it is believed to be, leaves it.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::{Cell, request};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::aimm;
use ratn_motion::collision::{Checker, Contact};
use ratn_motion::distance;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::plan::{Goal, Plan, PlanError, Request};
use ratn_motion::robot::{Configuration, Geometry, Robot, to_f32};
use ratn_motion::straight::{Frame, Straight};
use ratn_motion::trajectory::Curve;
use ratn_motion::validate::{Violation, validate_trajectory};
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};
use std::f64::consts::PI;

/// How deep is what nobody calls a contact, in metres.
const TOUCHES_M: f64 = 1e-3;

/// A fork's size.
const FORK: [f64; 3] = [0.18, 0.023, 0.016];

/// The arm stands with open fingers above the table, their tips so far above it.
fn standing(tips_m: f64) -> Cell {
    let mut cell = Cell::with_boxes(0, 1);
    let tool = Pose::from_rpy([0.7, 0.1, aimm::TABLE_HEIGHT_M + 0.10], PI, 0.0, 0.3);
    cell.follow(&cell.plan(&request(cell.state(), vec![Goal::Pose(tool)])).unwrap());
    let lowest = lowest_tip_m(&cell);
    let lower = Pose { position: [0.7, 0.1, tool.position[2] - (lowest - aimm::TABLE_HEIGHT_M - tips_m)], ..tool };
    let approach = Request { approach: Straight::down(0.02), ..request(cell.state(), vec![Goal::Pose(lower)]) };
    cell.follow(&cell.plan(&approach).unwrap());
    assert!((lowest_tip_m(&cell) - aimm::TABLE_HEIGHT_M - tips_m).abs() < 1e-3);
    cell
}

/// The left finger's box: where it is, and half of its edges.
fn finger(cell: &Cell, arm: &JointVector) -> (Pose, [f64; 3]) {
    let link = cell.robot.link("finger_left").unwrap();
    let body = cell.robot.model.links[link].bodies[0];
    let Geometry::Box { half } = body.geometry else { panic!("{body:?}") };
    let here = Configuration { arm: *arm, ..cell.state() };
    (cell.robot.pose(&here, link).compose(&body.pose), half)
}

fn lowest_tip_m(cell: &Cell) -> f64 {
    let (pose, [x, y, z]) = finger(cell, &cell.arm);
    let corners = (0..8).map(|i| {
        [x, y, z].map(|c| c).iter().enumerate().map(|(k, c)| if i >> k & 1 == 0 { -c } else { *c }).collect::<Vec<_>>()
    });
    corners.map(|c| pose.transform([c[0], c[1], c[2]])[2]).fold(f64::INFINITY, f64::min)
}

fn put(cell: &mut Cell, name: &str, size: [f64; 3], pose: Pose) {
    cell.scene.objects.retain(|object| object.name != name);
    let placement = Placement::World(pose);
    cell.scene.objects.push(SceneObject { name: name.into(), shape: Shape::Box { size }, placement });
}

/// A fork that lies on the table below the left finger.
fn put_fork_below_the_finger(cell: &mut Cell) {
    let (at, _) = finger(cell, &cell.arm);
    let [x, y, _] = at.position;
    put(cell, "fork", FORK, Pose::from_rpy([x, y, aimm::TABLE_HEIGHT_M + FORK[2] / 2.0], 0.0, 0.0, 0.3));
}

fn away(cell: &Cell, depart_m: f64) -> Result<Plan, PlanError> {
    let goals = vec![Goal::Joints(aimm::OBSERVATION)];
    cell.plan(&Request { depart: Straight::up(depart_m), ..request(cell.state(), goals) })
}

/// How deep the gripper's shapes are in an object in a posture, by their distances alone.
fn depths_m(cell: &Cell, arm: &JointVector, name: &str) -> Vec<f64> {
    let object = cell.object(name);
    let Placement::World(pose) = object.placement else { panic!("{object:?}") };
    let body = Geometry::from(&object.shape).at(pose);
    let (shape, at) = (body.geometry.shape(0.0), to_f32(&body.pose));
    let poses = cell.robot.poses(&Configuration { arm: *arm, ..cell.state() });
    let hand = cell.robot.hand();
    let links = (0..poses.len()).filter(|l| Some(*l) == hand || cell.robot.model.links[*l].parent == hand);
    let bodies = links.flat_map(|l| cell.robot.model.links[l].bodies.iter().map(move |body| (l, body)));
    let deep = |(l, own): (usize, &ratn_motion::robot::Body)| {
        let (own_at, own) = (to_f32(&poses[l].compose(&own.pose)), own.geometry.shape(0.0));
        let gap = distance::gap(&own_at, &*own, &at, &*shape, 0.0).unwrap();
        if gap > 0.0 { 0.0 } else { distance::depth(&own_at, &*own, &at, &*shape) }
    };
    bodies.map(deep).collect()
}

/// Along the motion no part of the gripper is deeper in the object than before, and what it has left it never touches again.
fn assert_leaves(cell: &Cell, plan: &Plan, name: &str) {
    let curve = Curve::of_arm(&cell.robot, &plan.trajectory).unwrap();
    let mut least = depths_m(cell, &cell.arm, name);
    assert!(least.iter().any(|depth| *depth > TOUCHES_M), "{least:?}");
    let looks = (curve.duration_s() / 0.004) as usize;
    for look in 0..=looks {
        let now = depths_m(cell, &curve.sample(look as f64 * 0.004).positions, name);
        for (least, now) in least.iter_mut().zip(&now) {
            assert!(*now <= *least + TOUCHES_M, "{now} after {least} at {:.3} s", look as f64 * 0.004);
            *least = least.min(*now);
        }
    }
    assert!(least.iter().all(|depth| *depth <= 0.0), "{least:?}");
}

#[test]
fn a_finger_deep_in_what_was_moved_below_it_is_taken_out_of_it() {
    for depart_m in [0.10, 0.0] {
        let mut cell = standing(0.001);
        put_fork_below_the_finger(&mut cell);
        let deepest = depths_m(&cell, &cell.arm, "fork").into_iter().fold(0.0, f64::max);
        // More than may be pressed on any departure.
        assert!(deepest > 0.013, "{deepest}");
        let plan = away(&cell, depart_m).unwrap_or_else(|error| panic!("{depart_m}: {error}"));
        assert_leaves(&cell, &plan, "fork");
        validate_trajectory(&cell.robot, &cell.scene, &cell.state(), &plan.trajectory, Contact::None).unwrap();
    }
}

/// A box beside the left finger, which is in it from the side.
fn put_box_beside_the_finger(cell: &mut Cell) {
    let (at, half) = finger(cell, &cell.arm);
    let size = [0.06, 0.06, 0.05];
    let tool = cell.robot.tool_pose(&cell.state());
    let aside = tool.inverse().compose(&at).position;
    let away = aside[1].signum() * (half[1] + size[1] / 2.0 - 0.0135);
    let [x, y, _] = tool.compose(&Pose::at(aside[0], aside[1] + away, 0.0)).position;
    put(cell, "box", size, Pose::from_rpy([x, y, aimm::TABLE_HEIGHT_M + size[2] / 2.0], 0.0, 0.0, 0.3));
}

#[test]
fn a_departure_that_would_go_deeper_is_not_made_and_another_way_out_is() {
    let mut cell = standing(0.001);
    put_box_beside_the_finger(&mut cell);
    let tool = cell.robot.tool_pose(&cell.state());
    let aside = tool.inverse().compose(&finger(&cell, &cell.arm).0).position[1].signum();
    let depart = Straight { direction: [0.0, aside, 0.0], frame: Frame::Tool, length_m: 0.10 };
    let goals = vec![Goal::Joints(aimm::OBSERVATION)];
    let plan = cell.plan(&Request { depart, ..request(cell.state(), goals) }).unwrap();
    assert_leaves(&cell, &plan, "box");
    validate_trajectory(&cell.robot, &cell.scene, &cell.state(), &plan.trajectory, Contact::None).unwrap();
}

/// A mat below the fingers, so thick that they are this deep in it.
fn put_mat(cell: &mut Cell, deep_m: f64) {
    let size = [0.2, 0.2, lowest_tip_m(cell) - aimm::TABLE_HEIGHT_M + deep_m];
    let [x, y, _] = cell.robot.tool_pose(&cell.state()).position;
    put(cell, "mat", size, Pose::from_rpy([x, y, aimm::TABLE_HEIGHT_M + size[2] / 2.0], 0.0, 0.0, 0.3));
}

#[test]
fn a_departure_that_something_far_away_refuses_is_not_replaced_by_a_retreat() {
    let mut cell = standing(0.001);
    // As deep as every departure may begin.
    put_mat(&mut cell, 0.003);
    let wall = cell.robot.tool_pose(&cell.state()).compose(&Pose::at(0.0, 0.25, -0.1));
    put(&mut cell, "wall", [0.2, 0.02, 0.3], Pose { quaternion_xyzw: wall.quaternion_xyzw, ..wall });
    let depart = Straight { direction: [0.0, 1.0, 0.0], frame: Frame::Tool, length_m: 0.20 };
    let goals = vec![Goal::Joints(aimm::OBSERVATION)];
    let refused = cell.plan(&Request { depart, ..request(cell.state(), goals) }).unwrap_err();
    assert!(matches!(refused, PlanError::Depart { .. }), "{refused}");
}

#[test]
fn fingers_in_a_hollow_object_touch_nothing_that_a_retreat_leaves() {
    let mut cell = standing(0.001);
    put_mat(&mut cell, 0.02);
    let goals = vec![Goal::Joints(aimm::OBSERVATION)];
    let into = |reaches_into: Vec<String>| Request { reaches_into, ..request(cell.state(), goals.clone()) };
    // A mat that is not hollow is left by a retreat.
    cell.plan(&into(Vec::new())).unwrap();
    let refused = cell.plan(&into(vec!["mat".to_owned()])).unwrap_err();
    assert!(matches!(refused, PlanError::StartInCollision { .. }), "{refused}");
}

#[test]
fn what_was_not_touched_at_the_start_is_not_touched_by_a_way_out() {
    let mut cell = standing(0.001);
    put_box_beside_the_finger(&mut cell);
    // A ledge closely above the edge of the hand: it neither goes up nor back. What is left is the way aside.
    let tool = cell.robot.tool_pose(&cell.state());
    let side = tool.inverse().compose(&finger(&cell, &cell.arm).0).position[1].signum();
    let ledge = tool.compose(&Pose::at(0.0, 0.07 * side, -0.15));
    put(&mut cell, "ledge", [0.02, 0.02, 0.02], ledge);
    let alone = Cell {
        scene: Scene {
            objects: cell.scene.objects.iter().filter(|o| o.name == "ledge").cloned().collect(),
            ..cell.scene.clone()
        },
        robot: Robot::aimm(),
        ..cell
    };
    let mut exact = Checker::new(&alone.robot, &alone.scene, &alone.state(), 0.0);
    assert_eq!(exact.collision(&alone.arm, Contact::None), None);
    let plan = away(&cell, 0.10).unwrap_or_else(|error| panic!("{error}"));
    assert_leaves(&cell, &plan, "box");
    validate_trajectory(&cell.robot, &cell.scene, &cell.state(), &plan.trajectory, Contact::None).unwrap();
    let tool_at = |time_s: f64| {
        let arm = Curve::of_arm(&cell.robot, &plan.trajectory).unwrap().sample(time_s).positions;
        tool.inverse().compose(&cell.robot.tool_pose(&Configuration { arm, ..cell.state() })).position
    };
    // It begins aside.
    let begun =
        (0..1000).map(|i| tool_at(f64::from(i) * 0.004)).find(|way| way.iter().any(|c| c.abs() > 0.01)).unwrap();
    assert!(begun[1].abs() > 0.009, "{begun:?}");
}

#[test]
fn what_no_way_leads_out_of_is_refused_with_the_ways_that_were_tried() {
    let mut cell = standing(0.001);
    let [x, y, _] = finger(&cell, &cell.arm).0.position;
    // All of the hand is in it, and of the arm as well.
    put(&mut cell, "block", [0.9, 0.9, 0.9], Pose::at(x, y, aimm::TABLE_HEIGHT_M + 0.45));
    let said = away(&cell, 0.10).unwrap_err().to_string();
    assert!(said.starts_with("at the start link ") && said.contains("inside block"), "{said}");
    for way in ["0.100 m straight up", "back along the tool", "the shortest way out"] {
        assert!(said.contains(way), "{said}");
    }
}

#[test]
fn a_trajectory_that_goes_deeper_or_comes_back_is_refused() {
    let mut cell = standing(0.001);
    put_fork_below_the_finger(&mut cell);
    let plan = away(&cell, 0.10).unwrap();
    let check = |trajectory| validate_trajectory(&cell.robot, &cell.scene, &cell.state(), trajectory, Contact::None);
    // There and back.
    let mut back = plan.trajectory.clone();
    let lasts_s = plan.trajectory.duration_s();
    back.points.extend(plan.trajectory.points.iter().rev().skip(1).map(|point| {
        let mut point = point.clone();
        point.time_s = 2.0 * lasts_s - point.time_s;
        point.velocities.iter_mut().for_each(|v| *v = -*v);
        point
    }));
    let refused = check(&back).unwrap_err();
    let Violation::Collision { time_s, collision } = &refused else { panic!("{refused}") };
    assert!(*time_s > lasts_s && collision.other == "fork", "{refused}");
    let with_fork = cell.scene.clone();
    // One that goes down at the start goes deeper.
    let down = Request {
        approach: Straight::down(0.004),
        depart: Straight::down(0.004),
        ..request(cell.state(), vec![Goal::Joints(aimm::OBSERVATION)])
    };
    let blind = Cell { scene: Scene { base: cell.scene.base, objects: Vec::new() }, robot: Robot::aimm(), ..cell };
    let plan = blind.plan(&down).unwrap();
    let deeper =
        validate_trajectory(&blind.robot, &with_fork, &blind.state(), &plan.trajectory, Contact::None).unwrap_err();
    let Violation::Collision { time_s, collision } = &deeper else { panic!("{deeper}") };
    assert!(*time_s < 1.0 && collision.other == "fork", "{deeper}");
}

#[test]
fn what_goes_the_shortest_way_out_as_far_as_it_is_deep_is_out() {
    let mut random = ChaCha8Rng::seed_from_u64(2);
    let mut deep = 0;
    for _ in 0..4_000 {
        let body = |random: &mut ChaCha8Rng| {
            let mut length = || 10_f64.powf(random.random_range(-2.3..-0.4));
            let (a, b, c) = (length(), length(), length());
            let is_box = random.random_bool(0.5);
            let geometry = if is_box {
                Geometry::Box { half: [a, b, c] }
            } else {
                Geometry::Cylinder { radius: a, half_length: b }
            };
            let mut range = |most: f64| random.random_range(-most..most);
            let position = [range(0.1), range(0.1), range(0.1)];
            geometry.at(Pose::from_rpy(position, range(3.2), range(3.2), range(3.2)))
        };
        let (first, second) = (body(&mut random), body(&mut random));
        let (shape, its) = (first.geometry.shape(0.0), second.geometry.shape(0.0));
        let of = to_f32(&second.pose);
        let gap = |pose: &Pose| distance::gap(&to_f32(pose), &*shape, &of, &*its, 0.1).unwrap();
        let depth_m = distance::depth(&to_f32(&first.pose), &*shape, &of, &*its);
        if gap(&first.pose) > 0.0 || depth_m < TOUCHES_M {
            continue;
        }
        deep += 1;
        let way = distance::way_out(&to_f32(&first.pose), &*shape, &of, &*its).unwrap();
        assert!((way.iter().map(|c| c * c).sum::<f64>() - 1.0).abs() < 1e-6, "{way:?}");
        let position = std::array::from_fn(|i| first.pose.position[i] + way[i] * (depth_m + 1e-5));
        let apart = gap(&Pose { position, ..first.pose });
        assert!(apart > 0.0, "{apart} after {depth_m} along {way:?}: {first:?} {second:?}");
    }
    assert!(deep > 1_000, "{deep}");
}
