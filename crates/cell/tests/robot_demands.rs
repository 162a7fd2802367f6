//! What a cell demands of a robot: told before it starts and refused at its start, by the same list, each with the place and what next.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod bench;
mod gantry;

use ratn_cell::config::{CellConfig, Setting};
use ratn_cell::core::cell::Cell;
use ratn_cell::core::demands::{Unmet, unmet};
use ratn_motion::base::{DriveRequest, plan_drive};
use ratn_motion::pace::Control;
use ratn_motion::robot::Robot;
use tempfile::TempDir;

/// The gantries with other texts in place of some.
struct Changed {
    folder: TempDir,
    config: CellConfig,
}

fn changed(urdf: &[[&str; 2]], description: &[[&str; 2]]) -> Changed {
    let replaced = |text: String, changes: &[[&str; 2]]| {
        changes.iter().fold(text, |text, [from, to]| {
            assert!(text.contains(from), "{from} is not there");
            text.replace(from, to)
        })
    };
    let folder = tempfile::tempdir().unwrap();
    let config = gantry::config(folder.path(), &replaced(gantry::description(), description));
    std::fs::write(folder.path().join("gantry.urdf"), replaced(gantry::urdf(), urdf)).unwrap();
    Changed { folder, config }
}

impl Changed {
    fn unmet(&self) -> Vec<Unmet> {
        let robot = Robot::from_file(&self.folder.path().join("robot.toml")).unwrap();
        unmet(&robot, Setting::Boxes)
    }

    /// All of it is said at the start of a cell as well.
    #[track_caller]
    fn says(&self, place: &str, parts: &[&str]) {
        let unmet = self.unmet();
        let Some(one) = unmet.iter().find(|unmet| unmet.place == place) else {
            panic!("nothing is said of {place}: {unmet:?}")
        };
        let said = one.to_string();
        for part in parts {
            assert!(said.contains(part), "`{part}` is not in: {said}");
        }
        let refused = Cell::new(self.config.clone()).err().unwrap().to_string();
        for one in &unmet {
            assert!(refused.contains(&one.to_string()), "`{one}` is not in: {refused}");
        }
    }
}

#[test]
fn a_robot_that_meets_them_all_begins_and_so_do_the_built_in_ones() {
    let good = changed(&[], &[]);
    assert_eq!(good.unmet(), []);
    assert!(Cell::new(good.config).is_ok());
    for name in Robot::built_in_names() {
        let robot = Robot::built_in(name).unwrap();
        assert_eq!(unmet(&robot, Setting::Boxes), [], "{name}");
        let has_rack = robot.workplace().is_some_and(|workplace| workplace.tableware.is_some());
        assert_eq!(unmet(&robot, Setting::Table).is_empty(), has_rack, "{name}");
    }
}

#[test]
fn a_camera_is_needed_and_its_frame_has_to_be_there() {
    changed(&[], &[["[camera]\nlink = \"camera\"", ""]]).says("[camera]", &["there is none", "pictures", "`link`"]);
    let misspelt = changed(&[], &[["[camera]\nlink = \"camera\"", "[camera]\nlink = \"camra\""]]);
    let refused = Robot::from_file(&misspelt.folder.path().join("robot.toml")).unwrap_err().to_string();
    assert!(refused.contains("`camera.link`") && refused.contains("did you mean `camera`?"), "{refused}");
}

#[test]
fn a_gripper_that_cannot_hold_is_told_with_what_is_wrong_with_it() {
    let gripper = "[gripper] of the arm `left`";
    let finger = |changes: &[[&str; 2]], parts: &[&str]| changed(changes, &[]).says(gripper, parts);
    // Only one finger opens.
    finger(
        &[["<mimic joint='left_finger' multiplier='1' offset='0'/>", ""]],
        &["no link goes the other way", "mimics"],
    );
    // The other one has no shape; the hand is not what they hang on.
    let shape =
        "<collision><origin xyz='0 -0.005 -0.06'/><geometry><box size='0.02 0.01 0.08'/></geometry></collision>";
    finger(
        &[[&format!("<link name='left_finger_b'>{shape}</link>"), "<link name='left_finger_b'/>"]],
        &["`left_finger_b` has no shape"],
    );
    changed(&[], &[["hand = \"left_hand\"", "hand = \"left_2\""]])
        .says(gripper, &["`left_finger_a` hangs on `left_hand`", "`hand` is `left_2`", "name `left_hand` as `hand`"]);
    // The finger slides along another axis, or inwards.
    let slides = |axis: &str| format!("<child link='left_finger_a'/><axis xyz='{axis}'/>");
    finger(&[[&slides("0 1 0"), &slides("1 0 0")]], &["`left_finger`", "goes by (40, 0, 0) mm", "along y"]);
    finger(
        &[[&slides("0 1 0"), &slides("0 -1 0")]],
        &[
            "goes by (0, 40, 0) mm",
            "its pad",
            "where y is below 0",
            "away from the middle",
            "along -y",
            "fixed to it do not count",
        ],
    );
    // At zero the fingers are apart.
    finger(&[["0 0.005 -0.06", "0 0.015 -0.06"]], &["10.0 mm from the middle", "0 is where the fingers meet"]);
    finger(
        &[["xyz='0 0.005 -0.06'", "xyz='0 0.005 -0.06' rpy='0.3 0 0'"]],
        &["`left_finger_a`", "no", "box", "tool's frame"],
    );
    // Pads of 4 mm hold but an edge, and so do those that are above what they take.
    finger(&[["size='0.02 0.01 0.08'", "size='0.004 0.01 0.08'"]], &["do not hold", "only an edge"]);
    finger(&[["0 0.005 -0.06", "0 0.005 0.03"]], &["do not hold"]);
    finger(
        &[["lower='0' upper='0.04'", "lower='0.03' upper='0.04'"]],
        &["close to 60 mm", "40 mm wide", "lower limit"],
    );
    let none = "[gripper]\njoint = \"left_finger\"\nhand = \"left_hand\"\nfinger = \"left_finger_a\"\n";
    let refused = changed(&[], &[[none, ""]]);
    let refused = Robot::from_file(&refused.folder.path().join("robot.toml")).unwrap_err().to_string();
    assert!(refused.contains("[workplace]") && refused.contains("the gripper opens to 0 m"), "{refused}");
}

#[test]
fn a_base_that_may_not_be_at_the_origin_is_told() {
    let slides = |name: &str, parent: &str, child: &str, axis: &str| {
        format!(
            "<joint name='{name}' type='prismatic'><parent link='{parent}'/><child link='{child}'/><axis xyz='{axis}'/>\
             <limit lower='-5' upper='5' effort='1' velocity='0.5' acceleration='2'/></joint>"
        )
    };
    let turns = "<joint name='heading' type='continuous'><parent link='along_y'/><child link='world'/><axis xyz='0 0 1'/>\
                 <limit effort='1' velocity='0.5' acceleration='2'/></joint>";
    let base = [
        "<link name='root'/><link name='along_x'/><link name='along_y'/><link name='world'/>".to_owned(),
        slides("x", "root", "along_x", "1 0 0"),
        slides("y", "along_x", "along_y", "0 1 0"),
        turns.to_owned(),
    ]
    .concat();
    let within = |area: &str| {
        let said = format!(
            "[camera]\nlink = \"camera\"\n[base]\njoints = [\"x\", \"y\", \"heading\"]\nbody = \"world\"\n{area}"
        );
        changed(&[["<link name='world'/>", &base]], &[["[camera]\nlink = \"camera\"", &said]])
    };
    assert_eq!(within("").unmet(), []);
    assert_eq!(within("area = { x = [0.0, 3.0], y = [-1.0, 1.0] }").unmet(), []);
    within("area = { x = [-1.0, 3.0], y = [0.5, 1.0] }")
        .says("[base]", &["y goes from 0.5 to 1 m", "origin", "`area`"]);
    let heading = |lower: f64, upper: f64| {
        let limited = turns
            .replace("continuous", "revolute")
            .replace("<limit ", &format!("<limit lower='{lower}' upper='{upper}' "));
        let said = "[camera]\nlink = \"camera\"\n[base]\njoints = [\"x\", \"y\", \"heading\"]\nbody = \"world\"\n";
        let base = base.replace(turns, &limited);
        changed(&[["<link name='world'/>", &base]], &[["[camera]\nlink = \"camera\"", said]])
    };
    // 0 is 2π there, and a drive begins at that.
    let turned = heading(4.0, 8.0);
    assert_eq!(turned.unmet(), []);
    let cell = Cell::new(turned.config.clone()).unwrap();
    let here = cell.configuration();
    let request = DriveRequest {
        start: here,
        goals: vec![[0.3, 0.0, 0.5]],
        position_tolerance_m: 0.0,
        heading_tolerance_rad: 0.0,
        speed: 0.5,
        seen: None,
        seed: 1,
    };
    let plan = plan_drive(cell.robot(), &cell.scene(), &request, &mut |_| Control::Continue).unwrap();
    let headings: Vec<f64> = plan.trajectory.points.iter().map(|point| point.positions[2]).collect();
    assert!(headings.iter().all(|heading| (4.0..=8.0).contains(heading)), "{headings:?}");
    heading(1.0, 5.0).says("[base]", &["its heading goes from 1 to 5 rad", "origin"]);
}

#[test]
fn a_base_and_an_arm_that_begin_in_the_table_are_told() {
    let pillar = "<link name='world'><collision><origin xyz='0.3 0 0.6'/><geometry><box size='0.1 0.1 0.2'/></geometry></collision></link>";
    let in_table = changed(&[["<link name='world'/>", pillar]], &[]);
    in_table.says("[workplace]", &["the link world is", "mm inside table", "move the table"]);
    // One that stands on the table is not in it.
    let on_table = pillar.replace("0.3 0 0.6", "0.3 0 0.8");
    assert_eq!(changed(&[["<link name='world'/>", &on_table]], &[]).unmet(), []);
    let low = changed(&[], &[["home = [0.0, 0.4, 0.0]", "home = [0.0, 0.4, -0.75]"]]);
    low.says("[postures] `home` of the arm `left`", &["inside table", "change the posture"]);
}
