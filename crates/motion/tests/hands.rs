//! What is in the hands of a robot with several arms, as each of them sees it.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::pose::Pose;
use ratn_motion::hands::seen_from;
use ratn_motion::robot::Robot;
use ratn_motion::survey::survey;
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};

fn held_by(arm: &str) -> Scene {
    let placement = Placement::Hand { arm: arm.to_owned(), pose: Pose::at(0.0, 0.0, 0.02) };
    let held = SceneObject { name: "box_1".to_owned(), shape: Shape::Box { size: [0.05; 3] }, placement };
    Scene { base: Pose::IDENTITY, objects: vec![held] }
}

fn placed(robot: &Robot, by: &str) -> Result<Placement, String> {
    let scene = seen_from(robot, held_by(by)).map_err(|fault| fault.to_string());
    scene.map(|scene| scene.objects[0].placement.clone())
}

#[test]
fn what_the_arm_holds_moves_with_it_and_what_another_one_holds_is_where_that_one_stands() {
    let twin = Robot::built_in("twin").unwrap();
    let right = twin.with_arm("right").unwrap();
    for (robot, own, other) in [(&twin, "left", "right"), (&right, "right", "left")] {
        assert_eq!(placed(robot, own), Ok(Placement::Gripper(Pose::at(0.0, 0.0, 0.02))));
        // The other one is in its posture `home` unless it is said where it stands.
        let Ok(Placement::World(at_home)) = placed(robot, other) else { panic!("{:?}", placed(robot, other)) };
        let away = robot.clone().with_other_arm_at(other, &[0.5, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]).unwrap();
        let Ok(Placement::World(elsewhere)) = placed(&away, other) else { panic!("{:?}", placed(&away, other)) };
        let side = |pose: &Pose| pose.position[1] * if other == "left" { 1.0 } else { -1.0 };
        assert!(side(&at_home) > 0.2 && side(&elsewhere) > 0.2, "{at_home:?} {elsewhere:?}");
        assert!(at_home.distance(&elsewhere) > 0.1);
    }
    let fault = placed(&twin, "middle").unwrap_err();
    assert!(fault.contains("middle") && fault.contains("left, right"), "{fault}");
    let one_arm = Robot::built_in("panda").unwrap();
    assert_eq!(placed(&one_arm, "arm"), Ok(Placement::Gripper(Pose::at(0.0, 0.0, 0.02))));
}

#[test]
fn each_arm_of_the_twin_reaches_its_own_boxes_and_places() {
    let lines = survey(&Robot::built_in("twin").unwrap()).lines;
    assert!(lines.iter().any(|said| said.starts_with("limits    ") && said.contains("rad/s²")), "{lines:#?}");
    for line in ["boxes     5 of 5", "places    3 of 3", "boxes     `right`: 5 of 5", "places    `right`: 3 of 3"] {
        assert!(lines.iter().any(|said| said.starts_with(line)), "{line}: {lines:#?}");
    }
}

#[test]
fn a_share_of_an_arm_that_is_not_there_is_refused() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("robots");
    let text = std::fs::read_to_string(folder.join("twin.toml")).unwrap();
    let refusal = |from: &str, to: &str| {
        assert!(text.contains(from));
        let description = ratn_motion::description::RobotDescription::read(&text.replace(from, to)).unwrap();
        let read = |ending: &str| std::fs::read_to_string(folder.join(format!("twin.{ending}"))).unwrap();
        let robot = Robot::of(description, &read("urdf"), Some(&read("srdf")), &mut |_| unreachable!("no meshes"));
        robot.map(drop).map_err(|fault| fault.to_string()).unwrap_err()
    };
    let nobody = refusal("arm = \"right\"", "arm = \"third\"");
    assert!(nobody.contains("the arm `third`") && nobody.contains("(right)"), "{nobody}");
    let beyond = refusal("y = [-0.40, -0.14]", "y = [-0.90, -0.14]");
    assert!(beyond.contains("`other_arm` `right`") && beyond.contains("beyond the table"), "{beyond}");
    let reversed = refusal("y = [-0.09, 0.09]", "y = [0.09, -0.09]");
    assert!(reversed.contains("`middle.y`"), "{reversed}");
}
