//! Joints that turn without end go the short way, and the long way where the short one is blocked; in problems of `ratn plan`, and in motions of an
//! arm.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::pose::Pose;
use ratn_model::value::Trajectory;
use ratn_motion::collision::Contact;
use ratn_motion::connect::Budget;
use ratn_motion::description::RobotDescription;
use ratn_motion::geometry::Geometry;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::mechanism::Mechanism;
use ratn_motion::pace::{Control, Progress};
use ratn_motion::plan::{Goal, Plan, PlanError, Request, plan};
use ratn_motion::problems::Problem;
use ratn_motion::robot::{Configuration, Robot};
use ratn_motion::space::Obstacle;
use ratn_motion::trial::{self, Found, Settings};
use ratn_motion::validate::{Violation, validate_trajectory};
use ratn_motion::way_points::WayPoints;
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};
use std::f64::consts::{PI, TAU};

/// A hand of a clock, and a second one at its end: its URDF and SRDF.
fn clock_texts(kind: &str, beside: &str) -> [String; 2] {
    let hand = |name: &str, parent: &str, x: f64| {
        format!(
            "<link name='{name}'><collision><origin xyz='0.2 0 0'/><geometry><box size='0.36 0.02 0.02'/></geometry></collision></link>\
             <joint name='{name}_turns' type='{kind}'><parent link='{parent}'/><child link='{name}'/><origin xyz='{x} 0 0'/>\
             <axis xyz='0 0 1'/><limit lower='-3.1' upper='3.1' velocity='1' effort='1'/></joint>"
        )
    };
    let urdf = format!(
        "<robot name='clock'><link name='foot'/>{}{}{beside}</robot>",
        hand("first", "foot", 0.0),
        hand("second", "first", 0.4)
    );
    [urdf, "<robot name='clock'><disable_collisions link1='first' link2='second'/></robot>".to_owned()]
}

fn clock(kind: &str, beside: &str) -> Mechanism {
    let [urdf, srdf] = clock_texts(kind, beside);
    Mechanism::read(&urdf, Some(&srdf), &["first_turns".to_owned(), "second_turns".to_owned()]).unwrap()
}

fn solve(mechanism: &Mechanism, start: [f64; 2], goal: [f64; 2], obstacles: &[Obstacle]) -> Option<Found> {
    let obstacles = obstacles.to_vec();
    let problem = Problem { obstacles, start: start.to_vec(), goal: goal.to_vec(), ..Problem::default() };
    let settings = Settings { budget: Budget { iterations: 20_000, seed: 1 }, repetitions: 1, limit: f64::INFINITY };
    trial::run(mechanism, &problem, settings, &mut || 0.0).outcome.ok()
}

/// It begins at the start, ends at the goal but for whole turns, goes on without a jump, and touches nothing.
#[track_caller]
fn check(found: &Found, start: [f64; 2], goal: [f64; 2], length_rad: std::ops::Range<f32>) {
    let (first, last) = (&found.path[0], &found.path[found.path.len() - 1]);
    for j in 0..2 {
        assert!((first[j] - start[j]).abs() < 1e-5, "{first:?} is not {start:?}");
        let turns = (last[j] - goal[j]) / TAU;
        assert!((turns - turns.round()).abs() < 1e-5, "{last:?} is not {goal:?}");
    }
    let way: f64 = found.path.windows(2).map(|pair| (pair[1][0] - pair[0][0]).hypot(pair[1][1] - pair[0][1])).sum();
    assert!((way - f64::from(found.length_rad)).abs() < 1e-3, "{way}");
    assert!(length_rad.contains(&found.length_rad), "{}", found.length_rad);
    assert_eq!(found.touch, None);
}

#[test]
fn the_way_between_postures_that_are_nearly_a_turn_apart_is_short() {
    let mechanism = clock("continuous", "");
    for (start, goal, length_rad) in [
        ([3.0, 0.0], [-3.0, 0.0], 0.28..0.29),
        ([-3.0, 2.5], [3.0, -2.5], 1.30..1.33),
        ([0.5, 0.0], [0.5 + 2.0 * TAU, 0.0], 0.0..1e-3),
        // Beyond half a turn.
        ([5.0 * TAU + 0.1, 0.0], [-0.1, 4.0], 2.28..2.31),
    ] {
        check(&solve(&mechanism, start, goal, &[]).unwrap(), start, goal, length_rad);
    }
}

#[test]
fn positions_that_are_too_many_turns_from_zero_are_refused_and_say_so() {
    let mechanism = clock("continuous", "");
    let far = 1e4 * TAU;
    check(&solve(&mechanism, [far - 1.0, 0.0], [0.5, 0.0], &[]).unwrap(), [far - 1.0, 0.0], [0.5, 0.0], 1.49..1.51);
    for (start, goal, which) in [([far + 1.0, 0.0], [0.5, 0.0], "start"), ([0.5, 0.0], [0.0, -1e16], "goal")] {
        let problem = Problem { start: start.to_vec(), goal: goal.to_vec(), ..Problem::default() };
        let settings =
            Settings { budget: Budget { iterations: 20_000, seed: 1 }, repetitions: 1, limit: f64::INFINITY };
        let trial = trial::run(&mechanism, &problem, settings, &mut || 0.0);
        assert!(trial.outcome.is_err(), "{:?}", trial.outcome);
        let said = trial.diagnosis.join("; ");
        assert!(said.contains(which) && said.contains("turns from zero") && said.contains("10000"), "{said}");
    }
    // A joint with limits is what they say.
    assert!(solve(&clock("revolute", ""), [far, 0.0], [0.5, 0.0], &[]).is_none());
}

#[test]
fn where_the_short_way_is_blocked_it_turns_the_other_way() {
    let mechanism = clock("continuous", "");
    let pose = Pose::at(-0.3, 0.0, 0.0);
    let post = [Obstacle { name: "post".into(), pose, geometry: Geometry::Sphere { radius: 0.03 } }];
    let (start, goal) = ([2.7, 0.0], [-2.7, 0.0]);
    check(&solve(&mechanism, start, goal, &[]).unwrap(), start, goal, 0.88..0.89);
    check(&solve(&mechanism, start, goal, &post).unwrap(), start, goal, 5.3..5.5);
}

#[test]
fn where_the_short_ways_of_two_joints_are_blocked_both_turn_the_other_way() {
    let hand = |name: &str, x: f64| {
        format!(
            "<link name='{name}'><collision><origin xyz='0.2 0 0'/><geometry><box size='0.36 0.02 0.02'/></geometry></collision></link>\
             <joint name='{name}_turns' type='continuous'><parent link='foot'/><child link='{name}'/><origin xyz='{x} 0 0'/><axis xyz='0 0 1'/></joint>"
        )
    };
    let urdf = format!("<robot name='r'><link name='foot'/>{}{}</robot>", hand("first", 0.0), hand("second", 1.0));
    let mechanism = Mechanism::read(&urdf, None, &["first_turns".to_owned(), "second_turns".to_owned()]).unwrap();
    let post = |x: f64| {
        let pose = Pose::at(x - 0.3, 0.0, 0.0);
        Obstacle { name: format!("post {x}"), pose, geometry: Geometry::Sphere { radius: 0.03 } }
    };
    let (start, goal) = ([2.7, 2.8], [-2.7, -2.8]);
    let way = (TAU - 2.0 * 0.442_f64).hypot(TAU - 2.0 * 0.342) as f32;
    check(&solve(&mechanism, start, goal, &[post(0.0), post(1.0)]).unwrap(), start, goal, way - 0.2..way + 0.2);
}

#[test]
fn joints_with_limits_and_those_that_others_follow_turn_as_before() {
    let (start, goal) = ([3.0, 0.0], [-3.0, 0.0]);
    let limited = clock("revolute", "");
    check(&solve(&limited, start, goal, &[]).unwrap(), start, goal, 5.9..6.1);
    assert!(solve(&limited, [0.5, 0.0], [0.5 + TAU, 0.0], &[]).is_none());
    // After a whole turn of the first hand the wheel is half a turn on.
    let wheel = "<link name='wheel'/><joint name='wheel_turns' type='continuous'><parent link='foot'/><child link='wheel'/>\
                 <axis xyz='0 0 1'/><mimic joint='first_turns' multiplier='0.5'/></joint>";
    let followed = clock("continuous", wheel);
    check(&solve(&followed, start, goal, &[]).unwrap(), start, goal, 5.9..6.1);
    let (start, goal) = ([0.0, 3.0], [0.0, -3.0]);
    check(&solve(&followed, start, goal, &[]).unwrap(), start, goal, 0.28..0.29);
}

/// The clock as an arm.
fn clock_arm(kind: &str) -> Robot {
    let [urdf, srdf] = clock_texts(kind, "");
    let description = "name = \"clock\"\nurdf = \"clock.urdf\"\n[arm]\njoints = [\"first_turns\", \"second_turns\"]\ntool = \"second\"\n";
    let description = RobotDescription::read(description).unwrap();
    Robot::of(description, &urdf, Some(&srdf), &mut |_| unreachable!("it has no meshes")).unwrap()
}

fn scene(post: Option<[f64; 3]>) -> Scene {
    let post = post.map(|[x, y, z]| SceneObject {
        name: "post".to_owned(),
        shape: Shape::Box { size: [0.04; 3] },
        placement: Placement::World(Pose::at(x, y, z)),
    });
    Scene { base: Pose::IDENTITY, objects: post.into_iter().collect() }
}

fn request(robot: &Robot, start: &[f64], goals: Vec<Goal>) -> Request {
    let start = Configuration { arm: JointVector::read(start).unwrap(), ..robot.at_zero() };
    Request { seed: 1, improvement_iterations: 50, ..Request::new(start, goals) }
}

fn planned(robot: &Robot, scene: &Scene, request: &Request) -> Result<Plan, PlanError> {
    let planned = plan(robot, scene, request, &mut |_| Control::Continue);
    if let Ok(plan) = &planned {
        let (first, last) = (&plan.trajectory.points[0], &plan.trajectory.points[plan.trajectory.points.len() - 1]);
        assert_eq!(plan.end.to_vec(), last.positions);
        for (j, start) in request.start.arm.iter().enumerate() {
            assert!((first.positions[j] - start).abs() < 1e-9, "it begins at {:?}", first.positions);
        }
        // Without a jump, within all limits, and without touching anything.
        validate_trajectory(robot, scene, &request.start, &plan.trajectory, Contact::None).unwrap();
    }
    planned
}

#[test]
fn an_arm_turns_the_short_way_from_any_number_of_turns() {
    let robot = clock_arm("continuous");
    for (start, goal, turns) in [
        ([3.0, 0.0], [-3.0, 0.0], TAU - 6.0),
        ([3.5, 0.0], [3.0, 0.0], -0.5),
        ([-7.0, 0.0], [7.0, 0.0], 14.0 - 2.0 * TAU),
        ([5.0 * TAU + 0.1, 0.0], [-0.1, 0.0], -0.2),
        ([0.3, 0.0], [0.5 - 1000.0 * TAU, 0.0], 0.2),
    ] {
        let goals = vec![Goal::Joints(JointVector::of(goal))];
        let plan = planned(&robot, &scene(None), &request(&robot, &start, goals)).unwrap();
        let turned = plan.end[0] - start[0];
        assert!((turned - turns).abs() < 1e-6, "from {start:?} to {goal:?} it turned by {turned}");
        assert!((plan.length_rad - turns.abs()).abs() < 1e-3, "{}", plan.length_rad);
    }
}

#[test]
fn an_arm_goes_round_the_other_way_where_the_short_one_is_blocked() {
    let robot = clock_arm("continuous");
    let post = scene(Some([-0.3, 0.0, 0.0]));
    let goals = vec![Goal::Joints(JointVector::of([-2.7, 0.0]))];
    let plan = planned(&robot, &post, &request(&robot, &[2.7 + TAU, 0.0], goals)).unwrap();
    assert!((plan.end[0] - (TAU - 2.7)).abs() < 1e-6, "{:?}", plan.end);
    // Where none goes, the goals are counted that were given.
    let blocked = scene(Some([0.3 * 2.7_f64.cos(), -0.3 * 2.7_f64.sin(), 0.0]));
    let goals = vec![Goal::Joints(JointVector::of([-2.7, 0.0]))];
    let refused = planned(&robot, &blocked, &request(&robot, &[2.7, 0.0], goals)).unwrap_err();
    assert!(matches!(refused, PlanError::NoGoal { goals: 1, .. }), "{refused}");
}

#[test]
fn what_can_be_used_before_the_plan_is_done_begins_where_the_arm_is_too() {
    let robot = clock_arm("continuous");
    let goals = vec![Goal::Joints(JointVector::of([-2.0, 1.0]))];
    let request = request(&robot, &[3.0 + 4.0 * TAU, 0.0], goals);
    let mut usable: Vec<Plan> = Vec::new();
    let end = plan(&robot, &scene(None), &request, &mut |progress| {
        if let Progress::Usable(plan) = progress {
            usable.push(plan.clone());
        }
        Control::Settle
    });
    let end = end.unwrap().end;
    assert!(!usable.is_empty(), "nothing was said to be usable");
    for plan in usable {
        assert!(
            (plan.trajectory.points[0].positions[0] - 3.0 - 4.0 * TAU).abs() < 1e-9,
            "{:?}",
            plan.trajectory.points[0]
        );
        assert_eq!(plan.end, end);
    }
}

#[test]
fn too_many_turns_of_an_arm_are_refused_as_are_positions_beyond_the_limits_of_a_joint_that_has_some() {
    for (kind, start) in [("continuous", 1e5), ("continuous", f64::NAN), ("revolute", 3.5)] {
        let robot = clock_arm(kind);
        let goals = vec![Goal::Joints(JointVector::of([0.0, 0.0]))];
        let refused = planned(&robot, &scene(None), &request(&robot, &[start, 0.0], goals)).unwrap_err();
        assert!(matches!(&refused, PlanError::Malformed { what, .. } if what.contains("first_turns")), "{refused}");
    }
}

/// A Panda, of whose joints some are continuous.
fn roller(endless: &[usize]) -> Robot {
    let mut urdf = include_str!("../robots/panda.urdf").to_owned();
    for joint in endless {
        let name = format!("<joint name=\"arm_joint_{joint}\" type=");
        urdf = urdf.replace(&format!("{name}\"revolute\""), &format!("{name}\"continuous\""));
    }
    let description = RobotDescription::read(include_str!("../robots/panda.toml")).unwrap();
    let srdf = include_str!("../robots/panda.srdf");
    Robot::of(description, &urdf, Some(srdf), &mut |_| unreachable!("it has no meshes")).unwrap()
}

const READY: [f64; 7] = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785];

#[test]
fn a_pose_is_reached_and_a_line_followed_across_half_a_turn_of_a_joint() {
    let robot = roller(&[1, 7]);
    // The tool is behind the stand, where the first joint is at half a turn.
    let start = |turns: f64| [PI - 0.15 + turns * TAU, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785];
    let mut behind = start(0.0);
    behind[0] = 0.15 - PI;
    let behind = Configuration { arm: JointVector::of(behind), ..robot.at_zero() };
    let goal = robot.tool_pose(&behind);
    for turns in [0.0, 1.0, -3.0] {
        let free = request(&robot, &start(turns), vec![Goal::Pose(goal)]);
        let straight = Request { straight: Some(WayPoints { through: Vec::new(), blend_m: 0.0 }), ..free.clone() };
        for request in [free, straight] {
            let plan = planned(&robot, &scene(None), &request).unwrap();
            let reached = robot.tool_pose(&Configuration { arm: plan.end, ..robot.at_zero() });
            assert!(reached.distance(&goal) < 1e-3 && reached.angle(&goal) < 1e-2, "{reached:?}");
            let positions = plan.trajectory.points.iter().map(|point| point.positions[0]);
            let least = positions.clone().fold(f64::INFINITY, f64::min);
            let greatest = positions.fold(f64::NEG_INFINITY, f64::max);
            assert!(greatest - least < 1.0, "the first joint turns from {least} to {greatest}");
        }
    }
}

#[test]
fn a_trajectory_is_followed_from_the_turn_in_which_the_arm_stands() {
    let robot = roller(&[7]);
    let at = |last: f64| {
        let mut arm = READY;
        arm[6] = last;
        Configuration { arm: JointVector::of(arm), ..robot.at_zero() }
    };
    let goals = vec![Goal::Joints(JointVector::of(READY))];
    let trajectory: Trajectory =
        planned(&robot, &scene(None), &request(&robot, &at(3.0).arm, goals)).unwrap().trajectory;
    for turns in [0.0, 1.0, -20.0] {
        let here = at(3.0 + turns * TAU);
        let curve = validate_trajectory(&robot, &scene(None), &here, &trajectory, Contact::None).unwrap();
        assert!((curve.knots()[0].positions[6] - here.arm[6]).abs() < 1e-9, "{turns} turns");
        assert!((curve.end()[6] - curve.knots()[0].positions[6] + 3.0 - READY[6]).abs() < 1e-6, "{turns} turns");
    }
    let half = validate_trajectory(&robot, &scene(None), &at(3.0 + PI), &trajectory, Contact::None);
    assert!(matches!(half, Err(Violation::Start { .. })), "{half:?}");
}
