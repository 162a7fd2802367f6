//! What a motion keeps all along, by forward kinematics a hundred times between any two knots of what is executed: a direction of the tool, its
//! place inside a box, its greatest speed.

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
use ratn_motion::connect::Budget;
use ratn_motion::constrained;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::keep::{Keep, KeptAxis, Region, timed_keeping};
use ratn_motion::pace::Control;
use ratn_motion::plan::{Goal, Plan, PlanError, Request};
use ratn_motion::reach::Reach;
use ratn_motion::robot::Joint;
use ratn_motion::space::{Space, State, state};
use ratn_motion::straight::{Frame, Straight};
use ratn_motion::timing::{Section, Speed, timed, timed_while};
use ratn_motion::tool_speed::ToolSpeed;
use ratn_motion::trajectory::{Curve, Knot};
use ratn_motion::way_points::WayPoints;
use ratn_world::scene::{Placement, SceneObject, Shape};
use robots::Arm;
use std::f64::consts::PI;

/// What may be broken by less than a proof resolves, in metres and radians.
const ROUNDING: f64 = 2e-5;

/// A hundred moments between any two knots.
fn moments(curve: &Curve) -> Vec<f64> {
    let between = |pair: &[Knot]| {
        let (from, h) = (pair[0].time_s, pair[1].time_s - pair[0].time_s);
        (0..100).map(move |i| from + h * f64::from(i) / 100.0)
    };
    curve.knots().windows(2).flat_map(between).chain([curve.duration_s()]).collect()
}

fn unit(v: [f64; 3]) -> [f64; 3] {
    let length = v.iter().map(|c| c * c).sum::<f64>().sqrt();
    v.map(|c| c / length)
}

fn angle(a: [f64; 3], b: [f64; 3]) -> f64 {
    let (a, b) = (unit(a), unit(b));
    (0..3).map(|i| a[i] * b[i]).sum::<f64>().clamp(-1.0, 1.0).acos()
}

/// How far a pose is from what is kept: radians off the direction, metres outside the box.
fn beyond(keep: &Keep, tool: &Pose) -> (f64, f64) {
    let off = keep.axis.map_or(0.0, |KeptAxis { axis, direction, tolerance_rad }| {
        angle(tool.rotate(axis), direction.unwrap()) - tolerance_rad
    });
    let outside = keep.inside.map_or(0.0, |Region { pose, size }| {
        let at = pose.inverse().transform(tool.position);
        (0..3).map(|i| at[i].abs() - size[i] / 2.0).fold(f64::NEG_INFINITY, f64::max)
    });
    (off, outside)
}

/// Paths of any arm between random postures that keep something keep it between all samples of the timed motion.
fn check_any(arm: &Arm, seed: u64) {
    let (mechanism, tool) = (&arm.mechanism, &arm.tool);
    let from = tool.pose(&arm.home);
    let link = mechanism.links.len() - 1;
    // What the constraint sees is the last link, not the tool at its end.
    let link_pose = |positions: &JointVector| mechanism.poses(positions)[link];
    let held = link_pose(&arm.home);
    let axis = [0.3, -0.2, 1.0];
    let keep = Keep {
        axis: Some(KeptAxis { axis, direction: Some(held.rotate(axis)), tolerance_rad: 0.15 }),
        inside: Some(Region {
            pose: Pose { position: held.position, ..Pose::from_rpy([0.0; 3], 0.2, 0.1, 0.4) },
            size: [0.8, 0.8, 0.3],
        }),
    };
    let constraint = keep.constraint(mechanism, link, &Pose::IDENTITY, &held).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut space = Space::new(mechanism, &[]);
    let (mut kept, mut tried) = (0, 0);
    while tried < 40 && kept < 4 {
        tried += 1;
        let mut range = |most: f64| random.random_range(-most..most);
        let goal =
            from.compose(&Pose::from_rpy([range(0.2), range(0.2), range(0.1)], range(0.05), range(0.05), range(0.05)));
        let postures = tool.postures(&ratn_motion::reach::Target::at(goal));
        let Some(end) = tool.nearest(&postures, &arm.home).into_iter().next() else { continue };
        if !constraint.holds(&state(&end)) || !space.is_free(&state(&end)) {
            continue;
        }
        let budget = Budget { iterations: 500, seed };
        let route =
            constrained::connect(&mut space, &constraint, &state(&arm.home), &[state(&end)], budget, &mut |_| {
                Control::Continue
            });
        let Ok(route) = route else { continue };
        let posture = |s: &State| JointVector::from_fn(mechanism.joints.len(), |j| f64::from(s[j]));
        let path: Vec<JointVector> = route.path.iter().map(posture).collect();
        let mut is_free = |a: &JointVector, b: &JointVector| constraint.holds_along(&state(a), &state(b));
        let sections = [Section::Blended(path)];
        let curve = timed_keeping(&mechanism.joints, &sections, 1.0, &constraint, &mut is_free, &mut || true).unwrap();
        for t in moments(&curve) {
            let (off, outside) = beyond(&keep, &link_pose(&curve.sample(t).positions));
            assert!(off < ROUNDING && outside < ROUNDING, "{}: {off} rad, {outside} m beyond", mechanism.name);
        }
        kept += 1;
    }
    assert!(kept >= 3, "{}: {kept} of {tried}", mechanism.name);
}

#[test]
fn any_arm_keeps_a_direction_and_a_box_between_all_samples() {
    check_any(&robots::seven(), 1);
    check_any(&robots::six(), 2);
    check_any(&robots::lifted(), 3);
}

fn tools(cell: &Cell, plan: &Plan) -> Vec<Pose> {
    let curve = Curve::of_arm(&cell.robot, &plan.trajectory).unwrap();
    let (reach, base) = (arm::reach(&cell.robot), arm::on_floor(&cell.robot, &cell.scene.base));
    let tool = |t: f64| base.compose(&reach.pose(&curve.sample(t).positions));
    moments(&curve).into_iter().map(tool).collect()
}

/// The arm above the table, on a base that is turned, and its tool in the world.
fn at_table() -> (Cell, Pose) {
    let mut cell = Cell::with_boxes(0, 1);
    cell.scene.base = Pose::from_rpy([-0.1, 0.05, 0.0], 0.0, 0.0, 0.3);
    let tool = Pose::from_rpy([0.65, -0.1, 1.0], PI, 0.0, 0.3);
    let plan = cell.plan(&request(cell.state(), vec![Goal::Pose(tool)])).unwrap();
    cell.follow(&plan);
    (cell, tool)
}

fn by(tool: &Pose, x: f64, y: f64, z: f64) -> Pose {
    let [a, b, c] = tool.position;
    Pose { position: [a + x, b + y, c + z], ..*tool }
}

#[test]
fn a_motion_keeps_any_axis_of_the_tool_near_any_direction() {
    let (cell, tool) = at_table();
    let axis = [1.0, 0.5, -0.3];
    for (tolerance_rad, direction) in [(0.02, None), (0.1, Some(tool.rotate([1.0, 0.45, -0.3])))] {
        let kept = KeptAxis { axis, direction: direction.or(Some(tool.rotate(axis))), tolerance_rad };
        let keep = Keep { axis: Some(kept), inside: None };
        let asked = Keep { axis: Some(KeptAxis { direction, ..kept }), inside: None };
        let goal = by(&tool, -0.05, 0.3, 0.1);
        let request = Request { keep: asked, ..request(cell.state(), vec![Goal::Pose(goal)]) };
        let plan = cell.plan(&request).unwrap();
        for tool in tools(&cell, &plan) {
            let (off, _) = beyond(&keep, &tool);
            assert!(off < ROUNDING, "{off} rad beyond {tolerance_rad}");
        }
    }
}

#[test]
fn a_motion_with_straight_parts_stays_inside_a_box() {
    let (cell, tool) = at_table();
    let goal = by(&tool, 0.0, 0.3, 0.0);
    let pose = Pose { position: by(&tool, 0.0, 0.15, 0.02).position, ..Pose::from_rpy([0.0; 3], 0.0, 0.0, 0.2) };
    let keep = Keep { axis: None, inside: Some(Region { pose, size: [0.24, 0.5, 0.14] }) };
    let request = Request {
        keep,
        depart: Straight::up(0.04),
        approach: Straight { direction: [0.0, 1.0, -1.0], frame: Frame::World, length_m: 0.05 },
        ..request(cell.state(), vec![Goal::Pose(goal)])
    };
    let plan = cell.plan(&request).unwrap();
    let outside = tools(&cell, &plan).iter().map(|tool| beyond(&keep, tool).1).fold(f64::NEG_INFINITY, f64::max);
    assert!(outside < ROUNDING, "{outside} m outside");
    // A departure that leaves it, a start and a goal outside of it are refused as such.
    let low = Region { pose, size: [0.24, 0.5, 0.06] };
    let keep = Keep { axis: None, inside: Some(low) };
    let further = Request { keep, depart: Straight::up(0.08), ..request.clone() };
    let said = cell.plan(&further).unwrap_err().to_string();
    assert!(said.starts_with("on the departure the tool is 0.") && said.ends_with("m outside the box"), "{said}");
    let aside = Region { pose: by(&pose, 0.5, 0.0, 0.0), size: [0.24, 0.5, 0.14] };
    let keep = Keep { axis: None, inside: Some(aside) };
    let without = Request { keep, depart: Straight::up(0.0), ..request.clone() };
    let said = cell.plan(&without).unwrap_err().to_string();
    assert!(said.starts_with("at the start the tool is 0."), "{said}");
    let short = Region { pose: by(&tool, 0.0, 0.05, 0.02), size: [0.24, 0.3, 0.14] };
    let keep = Keep { axis: None, inside: Some(short) };
    let only = Request { keep, approach: Straight::down(0.0), ..request };
    let said = cell.plan(&only).unwrap_err().to_string();
    assert!(said.contains("m outside the box"), "{said}");
}

#[test]
fn a_straight_way_that_leaves_what_is_kept_is_refused() {
    let (cell, tool) = at_table();
    let keep = Keep { axis: None, inside: Some(Region { pose: tool, size: [0.2; 3] }) };
    let straight = Some(WayPoints { through: vec![by(&tool, 0.05, 0.0, 0.2)], blend_m: 0.0 });
    let request = Request { keep, straight, ..request(cell.state(), vec![Goal::Pose(by(&tool, 0.05, 0.0, 0.0))]) };
    let said = cell.plan(&request).unwrap_err().to_string();
    assert!(
        said.contains("on the way to way point 1 of 1: the tool is 0.") && said.contains("outside the box"),
        "{said}"
    );
}

#[test]
fn what_is_to_be_kept_and_makes_no_sense_is_refused() {
    let (cell, tool) = at_table();
    let axis = KeptAxis { axis: [1.0, 0.0, 0.0], direction: None, tolerance_rad: 0.1 };
    let region = Region { pose: tool, size: [0.2; 3] };
    let with_axis = |axis| Keep { axis: Some(axis), inside: None };
    let with_box = |inside| Keep { axis: None, inside: Some(inside) };
    for (keep, expected) in [
        (with_axis(KeptAxis { axis: [0.0; 3], ..axis }), "keep_axis is [0.0, 0.0, 0.0]: expected"),
        (with_axis(KeptAxis { direction: Some([f64::NAN; 3]), ..axis }), "keep_direction is [NaN, NaN, NaN]: expected"),
        (with_axis(KeptAxis { tolerance_rad: 0.001, ..axis }), "keep_rad is 0.001: expected 0.005 to 1.571 rad"),
        (with_box(Region { size: [0.2, 0.0, 0.2], ..region }), "the size of `inside` is [0.2, 0.0, 0.2]: expected"),
    ] {
        let error = cell.plan(&Request { keep, ..request(cell.state(), vec![Goal::Pose(tool)]) }).unwrap_err();
        assert!(matches!(error, PlanError::Malformed { .. }) && error.to_string().starts_with(expected), "{error}");
    }
    let both =
        Request { keep: with_axis(axis), upright_rad: Some(0.1), ..request(cell.state(), vec![Goal::Pose(tool)]) };
    assert!(cell.plan(&both).unwrap_err().to_string().contains("upright_rad"));
}

/// The greatest speed and turning of a frame on a curve, by differences.
fn fastest(reach: &Reach, curve: &Curve) -> (f64, f64) {
    let tool = |t: f64| reach.pose(&curve.sample(t).positions);
    let (mut speed, mut turning) = (0.0_f64, 0.0_f64);
    for t in moments(curve) {
        let (from, to) = ((t - 1e-4).max(0.0), (t + 1e-4).min(curve.duration_s()));
        let (a, b) = (tool(from), tool(to));
        speed = speed.max(a.distance(&b) / (to - from));
        let turn = a.inverse().compose(&b).quaternion_xyzw;
        let sine = turn[..3].iter().map(|c| c * c).sum::<f64>().sqrt();
        turning = turning.max(2.0 * sine.asin() / (to - from));
    }
    (speed, turning)
}

fn check_speed(arm: &Arm, seed: u64) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    for _ in 0..4 {
        let path = vec![arm.home, arm.tool.random(&mut random), arm.tool.random(&mut random)];
        let curve = timed(&arm.mechanism.joints, &[Section::Blended(path)], 1.0, &mut |_, _| true);
        let (speed, turning) = fastest(&arm.tool, &curve);
        for (m, rad) in [(Some(0.5), None), (None, Some(0.7)), (Some(0.25), Some(2.0)), (Some(99.0), Some(99.0))] {
            let limits = ToolSpeed { m_per_s: m, rad_per_s: rad };
            let slow = limits.keep(&arm.tool, curve.clone());
            let (slow_m, slow_rad) = fastest(&arm.tool, &slow);
            let (m, rad) = (m.unwrap_or(f64::INFINITY), rad.unwrap_or(f64::INFINITY));
            assert!(
                slow_m <= m * (1.0 + 1e-6) && slow_rad <= rad * (1.0 + 1e-6),
                "{slow_m} of {m}, {slow_rad} of {rad}"
            );
            // And not slower than it has to be.
            let factor = (speed / m).max(turning / rad).max(1.0);
            assert!(slow.duration_s() <= curve.duration_s() * factor * 1.003, "{}", arm.mechanism.name);
            assert_eq!((slow.knots()[0].positions, slow.end()), (curve.knots()[0].positions, curve.end()));
        }
    }
}

#[test]
fn the_tool_of_any_arm_is_never_faster_than_its_limit_and_just_as_fast() {
    check_speed(&robots::seven(), 1);
    check_speed(&robots::six(), 2);
    check_speed(&robots::lifted(), 3);
}

/// What a curve uses of the joints' limits of velocity, acceleration and jerk, as a share.
fn used(joints: &[Joint], curve: &Curve) -> f64 {
    let mut used = 0.0_f64;
    for pair in curve.knots().windows(2) {
        let h = pair[1].time_s - pair[0].time_s;
        for (j, joint) in joints.iter().enumerate() {
            let mean = (pair[1].positions[j] - pair[0].positions[j]) / h;
            let (v0, v1) = (pair[0].velocities[j], pair[1].velocities[j]);
            let jerk = 6.0 * (v0 + v1 - 2.0 * mean) / (h * h);
            let acceleration = (6.0 * mean - 4.0 * v0 - 2.0 * v1) / h;
            used = used.max(jerk.abs() / joint.jerk);
            for i in 0..=20 {
                let t = h * f64::from(i) / 20.0;
                used = used.max((acceleration + jerk * t).abs() / joint.acceleration);
                used = used.max((v0 + t * (acceleration + jerk * t / 2.0)).abs() / joint.velocity);
            }
        }
    }
    used
}

/// The sums of the durations where the whole motion is slowed, and where it is slowed as it has to be.
fn check_slowed_in_places(arm: &Arm, seed: u64) -> [f64; 2] {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut sums = [0.0; 2];
    for _ in 0..4 {
        let path = vec![arm.home, arm.tool.random(&mut random), arm.tool.random(&mut random)];
        let sections = [vec![path[0], path[1]], path.clone()].map(Section::Blended);
        for section in sections {
            let joints = &arm.mechanism.joints;
            let mut time = |speed: &Speed| -> Result<Curve, ()> {
                Ok(timed_while(joints, std::slice::from_ref(&section), speed.clone(), &mut |_, _| true, &mut || true))
            };
            let curve = time(&1.0.into()).unwrap();
            let (speed, turning) = fastest(&arm.tool, &curve);
            for [m, rad] in [[0.7 * speed, f64::MAX], [f64::MAX, 0.7 * turning], [0.4 * speed, 0.6 * turning]] {
                let limits = ToolSpeed { m_per_s: Some(m), rad_per_s: Some(rad) };
                let whole = limits.keep(&arm.tool, curve.clone());
                let slow = limits.within(&arm.tool, &1.0.into(), &mut time).unwrap();
                let (slow_m, slow_rad) = fastest(&arm.tool, &slow);
                assert!(
                    slow_m <= m * (1.0 + 1e-6) && slow_rad <= rad * (1.0 + 1e-6),
                    "{slow_m} of {m}, {slow_rad} of {rad}"
                );
                assert!(slow.duration_s() <= whole.duration_s());
                assert!(used(joints, &slow) <= 1.001, "{}", used(joints, &slow));
                assert_eq!((slow.knots()[0].positions, slow.end()), (curve.knots()[0].positions, curve.end()));
                sums[0] += whole.duration_s();
                sums[1] += slow.duration_s();
            }
        }
    }
    sums
}

#[test]
fn a_motion_is_slower_only_where_its_tool_would_be_too_fast() {
    for (arm, seed) in [(robots::seven(), 4), (robots::six(), 5), (robots::lifted(), 6)] {
        let [whole, slow] = check_slowed_in_places(&arm, seed);
        assert!(slow < 0.9 * whole, "{}: {slow} s of {whole} s", arm.mechanism.name);
    }
}

#[test]
fn limits_of_one_motion_hold_for_each_joint_and_for_the_tool() {
    let (cell, tool) = at_table();
    let goals = vec![Goal::Pose(by(&tool, -0.1, 0.3, 0.1))];
    let free = Request { speed: 1.0, ..request(cell.state(), goals) };
    let mut scales = [1.0, 0.5, 0.25].map(|scale| JointVector::all(7, scale));
    scales[0][1] = 0.1;
    let limited = Request { scales, ..free.clone() };
    let tool_speed = ToolSpeed { m_per_s: Some(0.1), rad_per_s: Some(0.2) };
    let slow = Request { tool_speed, ..free.clone() };
    let lasts_s = |request: &Request| cell.plan(request).unwrap().trajectory.duration_s();
    assert!(lasts_s(&limited) > lasts_s(&free) && lasts_s(&slow) > lasts_s(&free));
    let curve = Curve::of_arm(&cell.robot, &cell.plan(&limited).unwrap().trajectory).unwrap();
    for pair in curve.knots().windows(2) {
        let h = pair[1].time_s - pair[0].time_s;
        for (j, joint) in cell.robot.arm_joints().iter().enumerate() {
            let mean = (pair[1].positions[j] - pair[0].positions[j]) / h;
            let (v0, v1) = (pair[0].velocities[j], pair[1].velocities[j]);
            let jerk = 6.0 * (v0 + v1 - 2.0 * mean) / (h * h);
            let acceleration = (6.0 * mean - 4.0 * v0 - 2.0 * v1) / h;
            assert!(jerk.abs() <= joint.jerk * 0.25 * 1.001);
            for i in 0..=100 {
                let t = h * f64::from(i) / 100.0;
                assert!((acceleration + jerk * t).abs() <= joint.acceleration * 0.5 * 1.001);
                let velocity = v0 + t * (acceleration + jerk * t / 2.0);
                assert!(velocity.abs() <= joint.velocity * scales[0][j] * 1.001);
            }
        }
    }
    let curve = Curve::of_arm(&cell.robot, &cell.plan(&slow).unwrap().trajectory).unwrap();
    let (speed, turning) = fastest(&arm::reach(&cell.robot), &curve);
    assert!(speed <= 0.1 * (1.0 + 1e-6) && turning <= 0.2 * (1.0 + 1e-6), "{speed} m/s, {turning} rad/s");
    for (request, expected) in [
        (
            Request { scales: [0.0, 1.0, 1.0].map(|scale| JointVector::all(7, scale)), ..free.clone() },
            "velocity_scale is 0: expected fractions from 0.01 to 1",
        ),
        (
            Request { tool_speed: ToolSpeed { m_per_s: Some(0.0), rad_per_s: None }, ..free },
            "tool_speed_m_s is 0: expected 0.001 m/s or more",
        ),
    ] {
        assert_eq!(cell.plan(&request).unwrap_err().to_string(), expected);
    }
}

#[test]
fn no_finger_presses_into_a_box_to_keep_out_of_though_it_may_into_a_thing() {
    let cell = Cell::with_boxes(1, 5);
    let usual = cell.approach("box_1");
    // A slab that covers the table, up to a height in millimetres.
    let slab = |top_mm: i32| {
        let ([length, width, _], [x, y, _]) = (aimm::TABLE_SIZE, aimm::TABLE_CENTRE);
        Region { pose: Pose::at(x, y, f64::from(top_mm) / 1000.0 - 0.01), size: [length, width, 0.02] }
    };
    let as_a_thing = |top_mm: i32| {
        let Region { pose, size } = slab(top_mm);
        let mut cell = Cell { scene: cell.scene.clone(), ..Cell::with_boxes(1, 5) };
        let placement = Placement::World(pose);
        cell.scene.objects.push(SceneObject { name: "slab".to_owned(), shape: Shape::Box { size }, placement });
        cell.plan(&usual).is_ok()
    };
    let kept_out = |top_mm: i32| cell.plan(&Request { keep_out: vec![slab(top_mm)], ..usual.clone() });
    // The table's top is at 700 mm, and the fingertips come to somewhere beside the box.
    let deepest = (690..900).take_while(|top_mm| as_a_thing(*top_mm)).last().unwrap();
    let refused = kept_out(deepest).map(|plan| plan.iterations).unwrap_err().to_string();
    assert!(refused.contains("keep_out[0]"), "{refused}");
    let highest = (690..900).take_while(|top_mm| kept_out(*top_mm).is_ok()).last().unwrap();
    assert!(highest + 3 < deepest, "up to {highest} mm, as a thing up to {deepest} mm");
    let opened =
        Request { reaches_into: vec!["keep_out[0]".to_owned()], keep_out: vec![slab(deepest)], ..usual.clone() };
    assert!(cell.plan(&opened).is_err());
    let flat = Request { keep_out: vec![Region { size: [1.0, 0.0, 1.0], ..slab(700) }], ..usual };
    let flat = cell.plan(&flat).map(|plan| plan.iterations).unwrap_err().to_string();
    assert!(flat.starts_with("the size of `keep_out[0]` is [1.0, 0.0, 1.0]: expected edges of"), "{flat}");
}
