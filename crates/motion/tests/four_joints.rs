//! An arm of four joints cannot tilt its tool: it takes measured poses, which are never exactly upright.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::pose::Pose;
use ratn_motion::arm;
use ratn_motion::collision::Contact;
use ratn_motion::description::RobotDescription;
use ratn_motion::pace::Control;
use ratn_motion::plan::{Goal, PlanError, Request, plan};
use ratn_motion::robot::{Configuration, Robot};
use ratn_motion::straight::Straight;
use ratn_motion::validate::validate_trajectory;
use ratn_world::scene::Scene;
use std::f64::consts::PI;

/// Three linear axes, and a hand below that turns.
fn gantry() -> Robot {
    let slide = |name: &str, parent: &str, child: &str, axis: &str| {
        format!(
            "<joint name='{name}' type='prismatic'><parent link='{parent}'/><child link='{child}'/><axis xyz='{axis}'/>\
             <limit lower='-0.6' upper='0.6' velocity='0.8' effort='1'/></joint><link name='{child}'/>"
        )
    };
    let urdf = format!(
        "<robot name='gantry'><link name='frame'/>{}{}{}\
         <joint name='turn' type='revolute'><parent link='mast'/><child link='tool'/><origin rpy='{PI} 0 0'/><axis xyz='0 0 1'/>\
         <limit lower='-3.1' upper='3.1' velocity='3' effort='1'/></joint>\
         <link name='tool'><collision><geometry><box size='0.02 0.02 0.1'/></geometry></collision></link></robot>",
        slide("x", "frame", "bridge", "1 0 0"),
        slide("y", "bridge", "carriage", "0 1 0"),
        slide("z", "carriage", "mast", "0 0 1"),
    );
    let text = "name = 'gantry'\nurdf = 'r'\n[arm]\njoints = ['x', 'y', 'z', 'turn']\ntool = 'tool'\n";
    let description = RobotDescription::read(text).unwrap();
    Robot::of(description, &urdf, None, &mut |_| unreachable!("it has no meshes")).unwrap()
}

#[test]
fn it_reaches_a_pose_that_is_tilted_by_less_than_poses_are_measured_and_no_other() {
    let robot = gantry();
    let scene = Scene { base: Pose::IDENTITY, objects: Vec::new() };
    let start = robot.at_zero();
    let planned = |tilt_rad: f64| {
        let goal = Pose::from_rpy([0.3, 0.2, -0.4], PI + tilt_rad, -tilt_rad / 2.0, 1.0);
        let request = Request {
            approach: Straight::down(0.1),
            depart: Straight::up(0.1),
            ..Request::new(start, vec![Goal::Pose(goal)])
        };
        let plan = plan(&robot, &scene, &request, &mut |_| Control::Continue)?;
        validate_trajectory(&robot, &scene, &start, &plan.trajectory, Contact::None).unwrap();
        let end = arm::reach(&robot).pose(&Configuration { arm: plan.end, ..start }.arm);
        Ok::<[f64; 2], PlanError>([end.distance(&goal), end.angle(&goal)])
    };
    for tilt_rad in [0.0, 4e-5, 2e-3] {
        let [off_m, off_rad] = planned(tilt_rad).unwrap();
        assert!(off_m < 1e-5 && off_rad < 8.7e-3, "{tilt_rad}: {off_m} m, {off_rad} rad");
    }
    assert!(matches!(planned(0.05), Err(PlanError::NoGoal { .. })));
}
