//! Motions in straight lines of the tool through way points: of any arm, followed to the millimetre, all or an error.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod common;
#[path = "common/robots.rs"]
mod robots;

use common::{Cell, request};
use ratn_model::pose::Pose;
use ratn_motion::aimm;
use ratn_motion::arm;
use ratn_motion::line::{Cause, through};
use ratn_motion::pace::{Control, Progress};
use ratn_motion::plan::{Goal, Plan, PlanError, Request, plan};
use ratn_motion::straight::Straight;
use ratn_motion::timing::{Section, timed};
use ratn_motion::trajectory::Curve;
use ratn_motion::way_points::WayPoints;
use ratn_world::scene::{Placement, SceneObject, Shape};
use robots::Arm;

/// How far the tool may be beside its lines, in metres.
const STRAIGHT_M: f64 = 1e-3;

/// A hundred moments between any two knots.
fn moments(curve: &Curve) -> Vec<f64> {
    let between = |pair: &[ratn_motion::trajectory::Knot]| {
        let (from, h) = (pair[0].time_s, pair[1].time_s - pair[0].time_s);
        (0..100).map(move |i| from + h * f64::from(i) / 100.0)
    };
    curve.knots().windows(2).flat_map(between).collect()
}

/// How far a point is from the nearest of the segments.
fn off(corners: &[[f64; 3]], point: [f64; 3]) -> f64 {
    let dot = |a: [f64; 3], b: [f64; 3]| (0..3).map(|i| a[i] * b[i]).sum::<f64>();
    let from_segment = |pair: &[[f64; 3]]| {
        let way: [f64; 3] = std::array::from_fn(|i| pair[1][i] - pair[0][i]);
        let here: [f64; 3] = std::array::from_fn(|i| point[i] - pair[0][i]);
        let along = (dot(here, way) / dot(way, way).max(1e-12)).clamp(0.0, 1.0);
        let left: [f64; 3] = std::array::from_fn(|i| here[i] - along * way[i]);
        dot(left, left).sqrt()
    };
    corners.windows(2).map(from_segment).fold(f64::INFINITY, f64::min)
}

fn away(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt()
}

/// The tool leaves the lines by no more than a millimetre; near the inner corners by no more than `blend_m`. Every corner is passed.
fn assert_along(places: &[[f64; 3]], corners: &[[f64; 3]], blend_m: f64) {
    for place in places {
        let near = corners[1..corners.len() - 1].iter().any(|corner| away(*corner, *place) < blend_m + STRAIGHT_M);
        let allowed = if near { blend_m + STRAIGHT_M } else { STRAIGHT_M };
        assert!(off(corners, *place) < allowed, "{} m beside its lines", off(corners, *place));
    }
    let mut from = 0;
    for corner in corners {
        let passes = places[from..].iter().position(|place| away(*place, *corner) < blend_m + STRAIGHT_M);
        from += passes.unwrap_or_else(|| panic!("{corner:?} is not passed in its turn"));
    }
}

fn check_any(arm: &Arm) {
    let from = arm.tool.pose(&arm.home);
    // Nothing is made for each step of a way that no arm goes: 1e12 m would take terabytes.
    for far_m in [1e4, 1e12, 1e300, f64::MAX] {
        let traced = through(&arm.tool, &arm.home, &[Pose { position: [far_m, 0.0, 0.0], ..from }], 0.0);
        assert_eq!((traced.ended, traced.postures.len()), (Some(Cause::TooLong), 1), "{far_m}");
    }
    let there = |x: f64, y: f64, z: f64, turn: f64| from.compose(&Pose::from_rpy([x, y, z], turn, 0.0, -turn));
    let poses = [there(0.08, 0.0, 0.0, 0.1), there(0.08, 0.08, 0.0, 0.2), there(0.0, 0.08, 0.05, 0.0)];
    let corners: Vec<[f64; 3]> = std::iter::once(&from).chain(&poses).map(|pose| pose.position).collect();
    for blend_m in [0.0, 0.01, 0.03] {
        let traced = through(&arm.tool, &arm.home, &poses, blend_m);
        assert_eq!(traced.ended, None, "{}", arm.mechanism.name);
        let curve = timed(&arm.mechanism.joints, &[Section::AsGiven(traced.postures)], 1.0, &mut |_, _| true);
        let tool = |t: f64| arm.tool.pose(&curve.sample(t).positions);
        let places: Vec<[f64; 3]> = moments(&curve).into_iter().map(|t| tool(t).position).collect();
        assert_along(&places, &corners, blend_m);
        let end = tool(curve.duration_s());
        assert!(end.distance(&poses[2]) < 1e-5 && end.angle(&poses[2]) < 1e-4);
    }
}

#[test]
fn any_arm_passes_its_way_points_and_rounds_corners_only_where_it_may() {
    check_any(&robots::seven());
    check_any(&robots::six());
    check_any(&robots::lifted());
}

fn places(cell: &Cell, plan: &Plan) -> Vec<[f64; 3]> {
    let curve = Curve::of_arm(&cell.robot, &plan.trajectory).unwrap();
    let (reach, base) = (arm::reach(&cell.robot), arm::on_floor(&cell.robot, &cell.scene.base));
    let tool = |t: f64| base.compose(&reach.pose(&curve.sample(t).positions));
    moments(&curve).into_iter().map(|t| tool(t).position).collect()
}

/// The arm at home, above a table, and places relative to its tool.
fn at_home() -> (Cell, Pose) {
    let mut cell = Cell::with_boxes(0, 1);
    cell.arm = aimm::HOME;
    let tool = cell.robot.tool_pose(&cell.state());
    (cell, tool)
}

fn by(tool: &Pose, x: f64, y: f64, z: f64) -> Pose {
    let [a, b, c] = tool.position;
    Pose { position: [a + x, b + y, c + z], ..*tool }
}

#[test]
fn a_plan_goes_through_way_points_between_its_departure_and_its_approach() {
    let (cell, tool) = at_home();
    let through = vec![by(&tool, 0.05, 0.0, 0.05), by(&tool, 0.05, 0.10, 0.05)];
    let goal = by(&tool, 0.0, 0.10, 0.0);
    let mut lasted = f64::INFINITY;
    for (blend_m, more) in [(0.0, 0.0), (0.003, 0.0), (0.02, 1e-3)] {
        let request = Request {
            depart: Straight::up(0.05),
            approach: Straight::down(0.03),
            straight: Some(WayPoints { through: through.clone(), blend_m }),
            ..request(cell.state(), vec![Goal::Pose(goal)])
        };
        let plan = cell.plan(&request).unwrap();
        assert!(plan.end_pose.distance(&goal) < 1e-5 && plan.end_pose.angle(&goal) < 1e-4);
        let corners = [tool, by(&tool, 0.0, 0.0, 0.05), through[0], through[1], by(&goal, 0.0, 0.0, 0.03), goal];
        assert_along(&places(&cell, &plan), &corners.map(|pose| pose.position), blend_m);
        let duration_s = plan.trajectory.duration_s();
        // Never slower than with stops.
        assert!(duration_s <= lasted - more, "{blend_m}: {duration_s} s, {lasted} s with less");
        lasted = duration_s;
        assert_eq!(cell.plan(&request).unwrap(), plan);
    }
}

#[test]
fn when_time_is_up_after_the_first_straight_way_that_way_is_the_answer() {
    let (cell, tool) = at_home();
    let straight = Some(WayPoints { through: vec![by(&tool, 0.05, 0.05, 0.05)], blend_m: 0.02 });
    let request = Request { straight, ..request(cell.state(), vec![Goal::Pose(by(&tool, 0.0, 0.10, 0.0))]) };
    let mut found = false;
    let hasty = plan(&cell.robot, &cell.scene, &request, &mut |progress| {
        found |= matches!(progress, Progress::FirstPath { .. });
        if found { Control::TimeUp } else { Control::Continue }
    });
    let hasty = hasty.unwrap();
    assert!(hasty.time_up && hasty.end_pose.distance(&cell.plan(&request).unwrap().end_pose) < 1e-6);
    let never = plan(&cell.robot, &cell.scene, &request, &mut |_| Control::TimeUp);
    assert_eq!(never, Err(PlanError::TimeUp));
}

#[test]
fn a_way_point_on_a_straight_line_is_no_reason_to_stop() {
    let (cell, tool) = at_home();
    let goal = by(&tool, 0.0, 0.12, 0.0);
    let lasts_s = |through: Vec<Pose>| {
        let straight = Some(WayPoints { through, blend_m: 0.0 });
        let plan = cell.plan(&Request { straight, ..request(cell.state(), vec![Goal::Pose(goal)]) }).unwrap();
        plan.trajectory.duration_s()
    };
    let direct = lasts_s(Vec::new());
    assert!(lasts_s(vec![by(&tool, 0.0, 0.06, 0.0)]) < 1.02 * direct);
    assert!(lasts_s(vec![by(&tool, 0.03, 0.06, 0.0)]) > 1.1 * direct);
}

#[test]
fn what_stops_a_straight_way_is_said_with_how_far_it_leads() {
    let (mut cell, tool) = at_home();
    let through = vec![by(&tool, 0.05, 0.0, 0.0), by(&tool, 0.05, 0.20, 0.0)];
    let to = |cell: &Cell, through: Vec<Pose>, goal: Pose| {
        let straight = Some(WayPoints { through, blend_m: 0.0 });
        cell.plan(&Request { straight, ..request(cell.state(), vec![Goal::Pose(goal)]) })
    };
    to(&cell, through.clone(), by(&tool, 0.0, 0.2, 0.0)).unwrap();
    cell.scene.objects.push(SceneObject {
        name: "post".into(),
        shape: Shape::Cylinder { radius: 0.01, length: 0.1 },
        placement: Placement::World(by(&tool, 0.05, 0.20, 0.0)),
    });
    let error = to(&cell, through, by(&tool, 0.0, 0.2, 0.0)).unwrap_err();
    let said = error.to_string();
    assert!(matches!(error, PlanError::NoStraightWay { .. }), "{said}");
    let expected = "no straight way to any of the 1 goals: the tool can go straight for 0.";
    assert!(said.starts_with(expected) && said.contains(" of 0.300 m, on the way to way point 2 of 2: "), "{said}");
    assert!(said.contains("post"), "{said}");
    // Too far: a joint, or the reach.
    let said = to(&cell, Vec::new(), by(&tool, 1.5, 0.0, 0.3)).unwrap_err().to_string();
    assert!(said.contains("on the way to the goal: "), "{said}");
    // Of several goals the first is taken that the tool gets to.
    let goals = vec![Goal::Pose(by(&tool, 0.0, 0.2, 0.0)), Goal::Pose(by(&tool, 0.0, -0.1, 0.0))];
    let straight = Some(WayPoints::default());
    let plan = cell.plan(&Request { straight, ..request(cell.state(), goals) }).unwrap();
    assert!(plan.end_pose.distance(&by(&tool, 0.0, -0.1, 0.0)) < 1e-5);
}

#[test]
fn a_straight_way_that_makes_no_sense_is_refused() {
    let (cell, tool) = at_home();
    let refused = |way: WayPoints, goal: Goal| {
        let error = cell.plan(&Request { straight: Some(way), ..request(cell.state(), vec![goal]) }).unwrap_err();
        assert!(matches!(error, PlanError::Malformed { .. }), "{error}");
        error.to_string()
    };
    let said = refused(WayPoints::default(), Goal::Joints(aimm::OBSERVATION));
    assert!(said.contains("expected poses"), "{said}");
    let said = refused(WayPoints { blend_m: -0.1, ..WayPoints::default() }, Goal::Pose(tool));
    assert_eq!(said, "blend_m is -0.1: expected 0 to 0.5 m");
    let said = refused(WayPoints { through: vec![tool; 257], blend_m: 0.0 }, Goal::Pose(tool));
    assert_eq!(said, "the number of way points is 257: expected at most 256");
    let nowhere = Pose::at(f64::NAN, 0.0, 0.0);
    let said = refused(WayPoints { through: vec![tool, nowhere], blend_m: 0.0 }, Goal::Pose(tool));
    assert!(said.starts_with("way point 2 is "), "{said}");
}
