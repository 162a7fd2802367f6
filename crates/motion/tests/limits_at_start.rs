//! An arm that stands at a limit can be planned from, though its encoders read a little beyond.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::pose::Pose;
use ratn_motion::collision::Contact;
use ratn_motion::pace::Control;
use ratn_motion::plan::{Goal, PlanError, Request, plan};
use ratn_motion::robot::{Configuration, Robot};
use ratn_motion::validate::validate_trajectory;
use ratn_world::scene::Scene;

#[test]
fn a_start_that_reads_a_little_beyond_a_limit_is_at_the_limit() {
    let robot = Robot::aimm();
    let scene = Scene { base: Pose::IDENTITY, objects: Vec::new() };
    let planned = |beyond: f64| {
        let mut arm = robot.posture("home").unwrap();
        let goal = Goal::Joints(arm);
        arm[6] = robot.arm_joints()[6].upper + beyond;
        let start = Configuration { arm, ..robot.at_zero() };
        let plan = plan(&robot, &scene, &Request::new(start, vec![goal]), &mut |_| Control::Continue)?;
        validate_trajectory(&robot, &scene, &start, &plan.trajectory, Contact::None).unwrap();
        Ok::<f64, PlanError>(plan.trajectory.points[0].positions[6])
    };
    for beyond in [0.0, 5e-6, 5e-4] {
        assert_eq!(planned(beyond), Ok(robot.arm_joints()[6].upper), "{beyond}");
    }
    assert!(planned(2e-3).unwrap_err().to_string().contains("the start's arm_joint_7"));
}
