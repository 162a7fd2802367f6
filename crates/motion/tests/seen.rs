//! What a depth camera saw beside the scene is in the way of a motion; what it saw of the robot and of known objects is not.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::Cell;
use ratn_model::pose::Pose;
use ratn_motion::cloud::Cloud;
use ratn_motion::collision::{CONTACT_TOLERANCE_M, Contact};
use ratn_motion::keep::Region;
use ratn_motion::plan::{Plan, PlanError, Request};
use ratn_motion::seen::{KNOWN_WITHIN_M, Seen};
use ratn_motion::trajectory::Curve;
use ratn_motion::validate::{Violation, validate_trajectory};
use ratn_world::scene::{Placement, SceneObject, Shape};
use std::sync::Arc;

/// Edges of the box that nobody knows.
const SIZE: [f64; 3] = [0.12, 0.12, 0.12];

/// Points on the sides of a box, at most a centimetre apart.
fn sides(size: [f64; 3], pose: &Pose) -> Vec<[f32; 3]> {
    let mut points = Vec::new();
    let steps = size.map(|edge| (edge / 0.01).ceil() as i32);
    let along = |axis: usize, i: i32| (f64::from(i) / f64::from(steps[axis]) - 0.5) * size[axis];
    for (fixed, a, b) in [(0, 1, 2), (1, 2, 0), (2, 0, 1)] {
        for i in 0..=steps[a] {
            for j in 0..=steps[b] {
                for side in [-0.5, 0.5] {
                    let mut point = [0.0; 3];
                    (point[fixed], point[a], point[b]) = (side * size[fixed], along(a, i), along(b, j));
                    points.push(pose.transform(point).map(|c| c as f32));
                }
            }
        }
    }
    points
}

fn seen(points: &[[f32; 3]], known_within_m: f64) -> Option<Seen> {
    Some(Seen { cloud: Arc::new(Cloud::new("what was seen", points, 0.01).unwrap()), known_within_m })
}

fn validated(cell: &Cell, plan: &Plan, beside: &[SceneObject]) -> Result<Curve, Violation> {
    let mut scene = cell.scene.clone();
    scene.objects.extend_from_slice(beside);
    validate_trajectory(&cell.robot, &scene, &cell.state(), &plan.trajectory, Contact::Gripper(CONTACT_TOLERANCE_M))
}

/// A box on the way, early in a motion that does not know it.
fn in_the_way(cell: &Cell, plan: &Plan) -> SceneObject {
    let curve = Curve::of_arm(&cell.robot, &plan.trajectory).unwrap();
    let arm = curve.sample(plan.trajectory.duration_s() * 0.3).positions;
    let tool = cell.robot.tool_pose(&ratn_motion::robot::Configuration { arm, ..cell.state() });
    let [x, y, z] = tool.position;
    let placement = Placement::World(Pose::at(x, y, z));
    SceneObject { name: "nobody's".to_owned(), shape: Shape::Box { size: SIZE }, placement }
}

#[test]
fn a_motion_keeps_away_from_what_was_seen_and_touches_what_is_known() {
    for base in [Pose::IDENTITY, Pose::from_rpy([0.4, -0.3, 0.0], 0.0, 0.0, 0.7)] {
        let mut cell = Cell::with_boxes(3, 5);
        // All is where it was, as the robot sees it.
        cell.scene.base = base;
        for object in &mut cell.scene.objects {
            let Placement::World(pose) = object.placement else { unreachable!("nothing is held") };
            object.placement = Placement::World(base.compose(&pose));
        }
        let blind = cell.approach("box_1");
        let careless = cell.plan(&blind).unwrap();
        let obstacle = in_the_way(&cell, &careless);
        let Placement::World(pose) = obstacle.placement else { unreachable!("it stands") };
        let crash = validated(&cell, &careless, std::slice::from_ref(&obstacle)).unwrap_err();
        assert!(matches!(crash, Violation::Collision { .. }), "{crash}");

        // The camera sees all there is.
        let mut points = sides(SIZE, &pose);
        for object in &cell.scene.objects {
            if let (Placement::World(pose), Shape::Box { size }) = (&object.placement, object.shape) {
                points.extend(sides(size, pose));
            }
        }
        let careful = cell.plan(&Request { seen: seen(&points, KNOWN_WITHIN_M), ..blind.clone() }).unwrap();
        validated(&cell, &careful, std::slice::from_ref(&obstacle)).unwrap();
        // A box to keep out of hides nothing that was seen of a thing that sticks out of it.
        let core = Region { pose, size: SIZE.map(|edge| edge - 2.0 * KNOWN_WITHIN_M) };
        let both = Request { seen: seen(&points, KNOWN_WITHIN_M), keep_out: vec![core], ..blind.clone() };
        validated(&cell, &cell.plan(&both).unwrap(), std::slice::from_ref(&obstacle)).unwrap();
        let carried = {
            let mut cell = Cell { scene: cell.scene.clone(), ..Cell::with_boxes(3, 5) };
            cell.follow(&careful);
            cell.grasp("box_1");
            cell.plan(&Request { seen: seen(&points, KNOWN_WITHIN_M), ..cell.retract() })
        };
        carried.unwrap_or_else(|error| panic!("what is held is known, where it was seen: {error}"));

        // Something lies on the box that is to be grasped.
        let (Placement::World(pose), Shape::Box { size: [.., height] }) =
            (cell.object("box_1").placement.clone(), cell.object("box_1").shape)
        else {
            unreachable!("it is a box that stands")
        };
        let on_top = sides(SIZE, &pose.compose(&Pose::at(0.0, 0.0, (height + SIZE[2]) / 2.0)));
        let covered = cell.plan(&Request { seen: seen(&on_top, KNOWN_WITHIN_M), ..blind.clone() });
        let refused = covered.map(|plan| plan.iterations).unwrap_err();
        assert!(matches!(&refused, PlanError::NoGoal { .. }), "{refused}");
        assert!(refused.to_string().contains("what was seen"), "{refused}");
        let mad =
            cell.plan(&Request { seen: seen(&points, f64::NAN), ..blind }).map(|plan| plan.iterations).unwrap_err();
        assert_eq!(mad.to_string(), "cloud_known_within_m is NaN: expected 0 to 1 m");
    }
}
