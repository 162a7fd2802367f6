//! What an arm keeps from another arm and from the head of the same robot, also while its fingers open: two gantries whose hands slide along x, y and z, and a head with a
//! stick, so that every distance is known.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_cell::config::CellConfig;
use ratn_cell::core::cell::Cell;
use ratn_cell::core::protocol::{Command, Ending, Event, Request};
use ratn_cell::core::snapshot::Snapshot;
use ratn_model::pose::Pose;
use ratn_motion::joint_vector::JointVector;
use std::path::Path;
use tempfile::TempDir;

mod bench;
#[allow(dead_code, reason = "not every test needs all of it")]
mod duo;
use bench::{Bench, grasp as close};

const LEFT: usize = 0;
const RIGHT: usize = 1;
/// Where the hands hang in the posture `home`: x, y and z as seen from the middle of the gantry.
const HOMES: [[f64; 3]; 2] = [[0.0, 0.4, 0.0], [0.0, -0.4, 0.0]];
/// How long the rod of a hand is, from the middle of the hand.
const ROD_M: f64 = 0.30;
/// How far the fingers are beyond the hand's middle, downwards.
const FINGERS_BELOW_M: f64 = 0.06;

/// A hand with a rod ahead of it, two fingers below it and a tool that points down.
fn side(side: &str) -> String {
    let slides = |name: &str, parent: &str, child: &str, axis: &str, limits: &str, mimic: &str| {
        format!(
            "<joint name='{side}_{name}' type='prismatic'><parent link='{parent}'/><child link='{side}_{child}'/><axis xyz='{axis}'/>\
             <limit {limits} effort='1' velocity='0.5' acceleration='2'/>{mimic}</joint>"
        )
    };
    let boxed = |at: &str, size: &str| {
        format!("<collision><origin xyz='{at}'/><geometry><box size='{size}'/></geometry></collision>")
    };
    let far = "lower='-1' upper='1'";
    let opens = "lower='0' upper='0.04'";
    let mimic = format!("<mimic joint='{side}_finger' multiplier='1' offset='0'/>");
    let middle = ROD_M / 2.0;
    [
        format!("<link name='{side}_1'/><link name='{side}_2'/><link name='{side}_tool'/>"),
        format!("<link name='{side}_hand'>{}", boxed("0 0 0", "0.06 0.12 0.04")),
        format!("{}</link>", boxed(&format!("{middle} 0 0"), &format!("{ROD_M} 0.01 0.01"))),
        format!("<link name='{side}_finger_a'>{}</link>", boxed("0 0.005 -0.06", "0.02 0.01 0.08")),
        format!("<link name='{side}_finger_b'>{}</link>", boxed("0 -0.005 -0.06", "0.02 0.01 0.08")),
        slides("x", "torso", "1", "1 0 0", far, ""),
        slides("y", &format!("{side}_1"), "2", "0 1 0", far, ""),
        slides("z", &format!("{side}_2"), "hand", "0 0 1", far, ""),
        slides("finger", &format!("{side}_hand"), "finger_a", "0 1 0", opens, ""),
        slides("mimics", &format!("{side}_hand"), "finger_b", "0 -1 0", opens, &mimic),
        format!(
            "<joint name='{side}_mount' type='fixed'><parent link='{side}_hand'/><child link='{side}_tool'/>\
             <origin xyz='0 0 -0.1' rpy='3.141592653589793 0 0'/></joint>"
        ),
    ]
    .concat()
}

fn urdf() -> String {
    format!(
        "<robot name='gantry'><link name='world'/><link name='torso'/><link name='camera'/>\
         <joint name='camera_mount' type='fixed'><parent link='world'/><child link='camera'/><origin xyz='0 0 3'/></joint>\
         <joint name='torso' type='prismatic'><parent link='world'/><child link='torso'/><axis xyz='0 0 1'/>\
         <limit lower='1.5' upper='1.6' effort='1' velocity='0.5' acceleration='2'/></joint>{}{}</robot>",
        side("left"),
        side("right")
    )
}

fn srdf() -> String {
    let pairs = ["left", "right"].map(|side| {
        [("hand", "finger_a"), ("hand", "finger_b"), ("finger_a", "finger_b")]
            .map(|(a, b)| format!("<disable_collisions link1='{side}_{a}' link2='{side}_{b}'/>"))
            .concat()
    });
    format!("<robot name='gantry'>{}</robot>", pairs.concat())
}

fn description() -> String {
    let arm = |side: &str| {
        format!("name = \"{side}\"\njoints = [\"{side}_x\", \"{side}_y\", \"{side}_z\"]\ntool = \"{side}_tool\"\n")
    };
    let gripper =
        |side: &str| format!("joint = \"{side}_finger\"\nhand = \"{side}_hand\"\nfinger = \"{side}_finger_a\"\n");
    let [left, right] = HOMES;
    format!(
        "name = \"gantry\"\nurdf = \"gantry.urdf\"\nsrdf = \"gantry.srdf\"\n[arm]\n{}[gripper]\n{}[camera]\nlink = \"camera\"\n[postures]\n\
         home = {left:?}\n[[other_arm]]\n{}[other_arm.gripper]\n{}[other_arm.postures]\nhome = {right:?}\n[workplace]\n\
         table = {{ centre = [0, 0, 0.675], size = [0.80, 1.40, 0.05] }}\n\
         boxes = {{ x = [-0.1, 0.1], y = [-0.1, 0.1], least = [0.05, 0.04, 0.07], greatest = [0.10, 0.05, 0.10] }}\n\
         places = {{ on = \"table\", yaw = 0, at = [[0.2, 0.2, 0.70]] }}\n",
        arm("left"),
        gripper("left"),
        arm("right"),
        gripper("right")
    )
}

fn config(folder: &Path, description: &str) -> CellConfig {
    std::fs::write(folder.join("gantry.urdf"), urdf()).unwrap();
    std::fs::write(folder.join("gantry.srdf"), srdf()).unwrap();
    let file = folder.join("robot.toml");
    std::fs::write(&file, description).unwrap();
    CellConfig { robot: file.display().to_string(), boxes: 0, seed: 2, ..CellConfig::default() }
}

fn gantry() -> (Bench, TempDir) {
    let folder = tempfile::tempdir().unwrap();
    (Bench::of(config(folder.path(), &description())), folder)
}

/// The same gantries with a head between them in place of the camera above: a stick of 0.5 m at the height of the hands, which pan turns about
/// x = 0.6, y = 0 from +x over +y. It hangs from the link `parent`.
fn with_head(parent: &str) -> (Bench, TempDir) {
    let head = format!(
        "<link name='pan'/><link name='head'><collision><origin xyz='0.25 0 0'/><geometry><box size='0.5 0.02 0.02'/></geometry></collision></link>\
         <link name='lens'/>\
         <joint name='pan' type='revolute'><parent link='{parent}'/><child link='pan'/><origin xyz='0.6 0 {height}'/><axis xyz='0 0 1'/>\
         <limit lower='0' upper='3' effort='1' velocity='0.5' acceleration='2'/></joint>\
         <joint name='tilt' type='revolute'><parent link='pan'/><child link='head'/><axis xyz='0 1 0'/>\
         <limit lower='-0.5' upper='0.5' effort='1' velocity='0.5' acceleration='2'/></joint>\
         <joint name='lens' type='fixed'><parent link='head'/><child link='lens'/><origin rpy='-1.5707963 0 -1.5707963'/></joint></robot>",
        height = if parent == "world" { 1.5 } else { 0.0 }
    );
    let folder = tempfile::tempdir().unwrap();
    let description = description()
        .replace("[camera]\nlink = \"camera\"", "[head]\njoints = [\"pan\", \"tilt\"]\n[camera]\nlink = \"lens\"");
    let config = config(folder.path(), &description);
    std::fs::write(folder.path().join("gantry.urdf"), urdf().replace("</robot>", &head)).unwrap();
    (Bench::of(config), folder)
}

/// The head turns to where its stick points so far round, in radians.
fn look(pan: f64) -> Request {
    Request::LookAt { target: [0.6 + 5.0 * pan.cos(), 5.0 * pan.sin(), 1.5] }
}

/// Why a cell with this robot is refused.
fn refused_robot(description: &str) -> String {
    let folder = tempfile::tempdir().unwrap();
    Cell::new(config(folder.path(), description)).err().unwrap().to_string()
}

fn to(joints: [f64; 3], speed: f64) -> Request {
    Request::MoveTo { joints: joints.into(), speed }
}

fn goes(bench: &mut Bench, arm: usize, joints: [f64; 3]) {
    let ending = bench.perform_with(arm, to(joints, 0.5));
    assert!(matches!(ending, Ending::Done(_)), "{joints:?}: {ending:?}");
}

fn refused(bench: &mut Bench, arm: usize, request: Request) -> String {
    match &bench.start_with(arm, request).1[..] {
        [Command::Ended { ending: Ending::Aborted(reason), .. }] => reason.clone(),
        other => panic!("{other:?}"),
    }
}

/// The cell with the right arm elsewhere, with no regard to what is on the way there.
fn with_right_at(bench: &mut Bench, joints: [f64; 3]) {
    let commands = bench.event(Event::Save);
    let [Command::Saved { snapshot }] = &commands[..] else { panic!("{commands:?}") };
    let mut state: serde_json::Value = serde_json::from_str(&snapshot.to_json()).unwrap();
    state["posture"]["other_arms"][0]["joints"] = serde_json::json!(joints);
    let snapshot = Snapshot::from_json(&state.to_string()).unwrap();
    bench.event(Event::PutBack { snapshot: Box::new(snapshot) });
}

/// The tip of the right arm's rod is between the fingers of the left arm, where that hangs at home, or `beyond` short of there.
fn between_the_fingers(beyond: f64) -> [f64; 3] {
    let [x, y, z] = HOMES[LEFT];
    [x - ROD_M + 0.005 - beyond, y, z - FINGERS_BELOW_M]
}

#[test]
fn closed_fingers_of_an_arm_that_stands_are_in_the_way_where_they_are() {
    let (mut bench, _folder) = gantry();
    let (before, between) = (between_the_fingers(0.1), between_the_fingers(0.0));
    // Through open fingers.
    goes(&mut bench, RIGHT, before);
    goes(&mut bench, RIGHT, between);
    goes(&mut bench, RIGHT, before);
    assert_eq!(bench.cell.unintended_contacts(), []);
    assert!(matches!(bench.perform_with(LEFT, close()), Ending::Aborted(_)), "they close around nothing");
    assert_eq!(bench.cell.measured_of(LEFT).finger, 0.0);
    let reason = refused(&mut bench, RIGHT, to(between, 0.5));
    assert!(reason.contains("the trajectory is refused") && reason.contains("left_finger"), "{reason}");
    // Nor where they will be when they open.
    let [x, y, z] = between;
    let reason = refused(&mut bench, RIGHT, to([x, y + 0.045, z], 0.5));
    assert!(reason.contains("the trajectory is refused") && reason.contains("left_finger"), "{reason}");
}

#[test]
fn fingers_do_not_close_on_another_arm_that_stands_between_them() {
    let (mut bench, _folder) = gantry();
    goes(&mut bench, RIGHT, between_the_fingers(0.1));
    goes(&mut bench, RIGHT, between_the_fingers(0.0));
    let reason = refused(&mut bench, LEFT, close());
    assert!(reason.starts_with("the fingers stay where they are: left_finger"), "{reason}");
    assert!(reason.contains("nearer than 3 mm to right_hand of the arm `right`, which stands there"), "{reason}");
    assert_eq!(bench.cell.measured_of(LEFT).finger, 0.04);
    goes(&mut bench, RIGHT, between_the_fingers(0.1));
    let ending = bench.perform_with(LEFT, close());
    assert!(matches!(&ending, Ending::Aborted(reason) if reason.contains("nothing stopped the fingers")), "{ending:?}");
    assert_eq!(bench.cell.unintended_contacts(), []);
}

#[test]
fn fingers_do_not_close_on_the_way_of_another_arm_nor_does_an_arm_set_out_between_closing_fingers() {
    let (mut bench, _folder) = gantry();
    goes(&mut bench, RIGHT, between_the_fingers(0.1));
    let (_, commands) = bench.start_with(RIGHT, to(between_the_fingers(0.0), 0.1));
    assert_eq!(commands, []);
    let reason = refused(&mut bench, LEFT, close());
    assert!(
        reason.contains("nearer than 20 mm to right_hand of the arm `right`, which is under way with goal"),
        "{reason}"
    );

    let (mut bench, _folder) = gantry();
    goes(&mut bench, RIGHT, between_the_fingers(0.1));
    let (_, commands) = bench.start_with(LEFT, close());
    assert_eq!(commands, []);
    let reason = refused(&mut bench, RIGHT, to(between_the_fingers(0.0), 0.5));
    assert!(reason.contains("to left_finger"), "{reason}");
}

#[test]
fn an_arm_keeps_a_margin_from_one_that_stands_and_may_leave_where_it_is_nearer() {
    let (mut bench, _folder) = gantry();
    // The hands are 0.12 m wide and hang at the same height.
    let beside = |gap_m: f64| [HOMES[LEFT][0], HOMES[LEFT][1] - 0.12 - gap_m, 0.0];
    goes(&mut bench, RIGHT, beside(0.05));
    let reason = refused(&mut bench, RIGHT, to(beside(0.001), 0.3));
    assert!(reason.contains("comes nearer than 3 mm to left_hand of the arm `left`, which stands there"), "{reason}");
    goes(&mut bench, RIGHT, beside(0.012));

    with_right_at(&mut bench, beside(0.001));
    let reason = refused(&mut bench, RIGHT, to(beside(0.0001), 0.1));
    assert!(reason.contains("comes nearer than 3 mm to left_hand"), "{reason}");
    goes(&mut bench, RIGHT, beside(0.05));
}

#[test]
fn ways_that_are_too_long_to_be_compared_are_refused_by_name() {
    let (mut bench, _folder) = gantry();
    let far = |arm: usize| {
        let [_, y, z] = HOMES[arm];
        [1.0, y, z]
    };
    let (_, commands) = bench.start_with(LEFT, to(far(LEFT), 0.01));
    assert_eq!(commands, []);
    let reason = refused(&mut bench, RIGHT, to(far(RIGHT), 0.5));
    let said = "its way and that of the arm `left`, which is under way with goal 1, are too long";
    assert!(reason.contains(said) && reason.contains("in shorter motions"), "{reason}");
}

#[test]
fn an_arm_that_carries_the_other_one_is_refused_and_so_are_names_that_are_no_part_of_an_id() {
    let carries = description()
        .replacen("\"left_x\"", "\"torso\", \"left_x\"", 1)
        .replace("home = [0.0, 0.4", "home = [1.5, 0.0, 0.4");
    let reason = refused_robot(&carries);
    assert!(
        reason.contains("the arm `right` of the robot `gantry` cannot be in a cell: the link `right_1`"),
        "{reason}"
    );
    assert!(reason.contains("by those of the arm `left`"), "{reason}");
    for (name, number) in [("left", 0), ("right", 1)] {
        for wrong in ["a/b".to_owned(), String::new(), "a".repeat(65)] {
            let named = description().replace(&format!("name = \"{name}\""), &format!("name = \"{wrong}\""));
            let reason = refused_robot(&named);
            assert!(reason.contains("use 1 to 64 letters"), "{number}: {reason}");
        }
    }
    let longest = description().replace("name = \"left\"", &format!("name = \"{}\"", "a".repeat(64)));
    let folder = tempfile::tempdir().unwrap();
    assert!(Cell::new(config(folder.path(), &longest)).is_ok());
}

#[test]
fn a_snapshot_of_a_robot_with_another_tool_or_pad_is_refused() {
    let (mut bench, _folder) = gantry();
    let commands = bench.event(Event::Save);
    let [Command::Saved { snapshot }] = &commands[..] else { panic!("{commands:?}") };
    let check = |description: &str| {
        let folder = tempfile::tempdir().unwrap();
        let cell = Cell::new(config(folder.path(), description)).unwrap();
        snapshot.check_robot(cell.robot()).map_err(|error| error.to_string())
    };
    assert_eq!(check(&description()), Ok(()));
    for (from, to) in [
        ("tool = \"right_tool\"", "tool = \"right_hand\""),
        ("name = \"right\"", "name = \"other\""),
        ("finger = \"right_finger_a\"", "finger = \"right_finger_b\""),
        ("finger = \"left_finger_a\"", "finger = \"left_finger_b\""),
    ] {
        let refused = check(&description().replace(from, to));
        assert!(refused.as_ref().is_err_and(|reason| reason.contains("`gantry` (digest ")), "{to}: {refused:?}");
    }
}

#[test]
fn fingers_do_not_close_where_another_arm_holds_something_askew() {
    let folder = tempfile::tempdir().unwrap();
    let robot = duo::write(folder.path()).display().to_string();
    let mut bench = Bench::of(CellConfig { robot, boxes: 1, seed: 2, ..CellConfig::default() });
    let commands = bench.event(Event::Save);
    let [Command::Saved { snapshot }] = &commands[..] else { panic!("{commands:?}") };
    let mut state: serde_json::Value = serde_json::from_str(&snapshot.to_json()).unwrap();
    let tool = |arm: usize| bench.cell.robot_of(arm).tool_pose(&bench.cell.measured_of(arm));
    let askew = tool(LEFT).compose(&Pose::from_rpy([0.0; 3], 0.0, 0.0, 20_f64.to_radians()));
    let in_tool = tool(RIGHT).inverse().compose(&askew);
    state["posture"]["other_arms"][0]["held"] = serde_json::json!({ "object": 0, "in_tool": in_tool, "friction": 0.6 });
    let held = Snapshot::from_json(&state.to_string()).unwrap();
    bench.event(Event::PutBack { snapshot: Box::new(held) });
    let reason = refused(&mut bench, LEFT, close());
    assert!(reason.contains("slc_1 is between the fingers, and the arm `right` holds it"), "{reason}");
}

#[test]
#[ignore = "it measures, and says so with --nocapture"]
fn how_long_it_takes_to_compare_two_motions_of_ten_seconds() {
    let folder = tempfile::tempdir().unwrap();
    let robot = duo::write(folder.path()).display().to_string();
    for left_moves in [false, true] {
        let mut bench = Bench::of(CellConfig { robot: robot.clone(), boxes: 1, seed: 2, ..CellConfig::default() });
        let turned = |bench: &Bench, arm: usize, sign: f64| {
            let by = [1.5, 0.3, 0.4, 0.3, -0.4, 0.5, 0.8];
            let home = bench.cell.measured_of(arm).arm;
            Request::MoveTo { joints: JointVector::from_fn(7, |j| home[j] + sign * by[j]), speed: 0.07 }
        };
        let (left, right) = (turned(&bench, LEFT, 1.0), turned(&bench, RIGHT, -1.0));
        if left_moves {
            assert_eq!(bench.start_with(LEFT, left).1, []);
        }
        let began = std::time::Instant::now();
        assert_eq!(bench.start_with(RIGHT, right).1, []);
        let lasts_s = bench.cell.next_wake().unwrap().since(bench.now).as_secs_f64();
        println!("started in {:?}, beside an arm on its way: {left_moves}, lasts {lasts_s:.1} s", began.elapsed());
    }
}

/// The left hand where the stick does not reach it, and where it does.
const ASIDE: [f64; 3] = [0.0, 0.6, 0.0];
const IN_THE_WAY: [f64; 3] = [0.0, 0.15, 0.0];
/// How far the stick turns before it is near to the hands, and how far to pass them, in radians.
const SHORT: f64 = 1.5;
const ROUND: f64 = 2.8;

#[test]
fn a_head_does_not_turn_into_the_way_of_an_arm_nor_into_one_that_stands() {
    let (mut bench, _folder) = with_head("world");
    assert_eq!(bench.start_with(LEFT, to(IN_THE_WAY, 0.1)).1, []);
    let reason = refused(&mut bench, LEFT, look(ROUND));
    assert!(
        reason.starts_with("the head stays where it is: head of the head comes nearer than 20 mm to left_hand"),
        "{reason}"
    );
    assert!(reason.contains("of the arm `left`, which is under way with goal 1"), "{reason}");
    // As far as the ways are apart.
    assert_eq!(bench.start_with(LEFT, look(SHORT)).1, []);
    bench.pass(60.0);
    let reason = refused(&mut bench, LEFT, look(ROUND));
    assert!(reason.contains("comes nearer than 3 mm to left_hand of the arm `left`, which stands there"), "{reason}");
    goes(&mut bench, LEFT, ASIDE);
    bench.done(look(ROUND));
    assert_eq!(bench.cell.unintended_contacts(), []);
}

#[test]
fn an_arm_does_not_set_out_into_the_way_of_a_head_that_turns() {
    let (mut bench, _folder) = with_head("world");
    goes(&mut bench, LEFT, ASIDE);
    assert_eq!(bench.start_with(LEFT, look(ROUND)).1, []);
    bench.pass(0.1);
    let reason = refused(&mut bench, LEFT, to(IN_THE_WAY, 0.5));
    assert!(reason.starts_with("the trajectory is refused: on the way left_hand of the arm `left`"), "{reason}");
    assert!(reason.contains("to head of the head, which is under way with goal"), "{reason}");
    // Away from it, and the other arm.
    assert_eq!(bench.start_with(LEFT, to([0.0, 0.7, 0.1], 0.5)).1, []);
    assert_eq!(bench.start_with(RIGHT, to([0.0, -0.5, 0.1], 0.5)).1, []);
    bench.pass(60.0);
    // A head that stands is what the check of the trajectory knows.
    let reason = refused(&mut bench, LEFT, to(IN_THE_WAY, 0.5));
    assert!(reason.contains("the trajectory is refused"), "{reason}");
    assert_eq!(bench.cell.unintended_contacts(), []);
}

#[test]
fn an_arm_whose_joints_carry_the_head_moves_before_or_after_it() {
    // One arm alone hangs from the torso.
    let (mut bench, _folder) = with_head("left_2");
    assert_eq!(bench.start_with(LEFT, to([0.0, 0.5, 0.0], 0.1)).1, []);
    let reason = refused(&mut bench, LEFT, look(SHORT));
    assert!(reason.contains("is moved by the head and by the arm `left`, which is under way with goal 1"), "{reason}");
    bench.pass(60.0);
    assert_eq!(bench.start_with(LEFT, look(SHORT)).1, []);
    let reason = refused(&mut bench, LEFT, to([0.0, 0.4, 0.0], 0.5));
    assert!(reason.contains("is moved by the arm `left` and by the head, which is under way"), "{reason}");
}

/// The left arm with fingers that have closed around nothing and opened a little again.
fn ajar(bench: &mut Bench) {
    assert!(matches!(bench.perform_with(LEFT, close()), Ending::Aborted(_)), "they close around nothing");
    assert!(matches!(bench.perform_with(LEFT, Request::OpenTo { width: 0.01 }), Ending::Done(_)));
}

#[test]
fn fingers_open_further_while_their_arm_moves_whichever_begins_first() {
    for arm_first in [false, true] {
        let (mut bench, _folder) = gantry();
        ajar(&mut bench);
        let both = [Request::Release, to(ASIDE, 0.2)];
        let both = if arm_first { both.into_iter().rev().collect::<Vec<_>>() } else { both.to_vec() };
        for request in both {
            assert_eq!(bench.start_with(LEFT, request).1, []);
        }
        let ended = bench.pass(0.79);
        assert!(matches!(&ended[..], [Command::Ended { ending: Ending::Done(_), .. }]), "the fingers: {ended:?}");
        let at = bench.cell.measured_of(LEFT);
        assert!(at.finger == 0.04 && at.arm[1] > HOMES[LEFT][1] && at.arm[1] < ASIDE[1], "{at:?}");
        bench.pass(60.0);
        assert_eq!(bench.cell.measured_of(LEFT).arm[1], ASIDE[1]);
        assert_eq!(bench.cell.unintended_contacts(), []);
    }
}

#[test]
fn no_arm_leaves_before_its_fingers_have_parted_nor_while_they_close() {
    let (mut bench, _folder) = gantry();
    assert_eq!(bench.start_with(LEFT, close()).1, []);
    bench.pass(0.1);
    let reason = refused(&mut bench, LEFT, to(ASIDE, 0.2));
    assert!(reason.contains("an arm does not move while its fingers close"), "{reason}");
    bench.pass(60.0);
    assert_eq!(bench.start_with(LEFT, Request::Release).1, []);
    // Of 40 mm in 0.8 s each has gone 2 and 4 mm.
    bench.pass(0.04);
    let reason = refused(&mut bench, LEFT, to(ASIDE, 0.2));
    assert!(reason.contains("nor before they have parted from what they let go"), "{reason}");
    bench.pass(0.04);
    assert_eq!(bench.start_with(LEFT, to(ASIDE, 0.2)).1, []);
    // Nor does anything close on the way, nor begin to part.
    bench.pass(0.8);
    let reason = refused(&mut bench, LEFT, close());
    assert!(reason.contains("an arm does not move while its fingers close"), "{reason}");
    bench.pass(60.0);
    assert!(matches!(bench.perform_with(LEFT, close()), Ending::Aborted(_)));
    assert_eq!(bench.start_with(LEFT, to([0.0, 0.4, 0.0], 0.2)).1, []);
    let reason = refused(&mut bench, LEFT, Request::Release);
    assert!(reason.contains("nor before they have parted from what they let go"), "{reason}");
}

#[test]
fn opening_in_two_parts_takes_as_long_as_at_once() {
    let (mut bench, _folder) = gantry();
    assert!(matches!(bench.perform_with(LEFT, close()), Ending::Aborted(_)));
    let began = bench.now;
    for request in [Request::OpenTo { width: 0.01 }, Request::OpenTo { width: 0.05 }, Request::Release] {
        assert!(matches!(bench.perform_with(LEFT, request), Ending::Done(_)));
    }
    let lasted_s = bench.now.since(began).as_secs_f64();
    assert!((lasted_s - 0.8).abs() < 1e-6, "{lasted_s}");
    for (width, wrong) in [(0.08, "80 mm apart"), (0.05, "80 mm apart"), (0.2, "at most 80 mm"), (f64::NAN, "NaN")] {
        let reason = refused(&mut bench, LEFT, Request::OpenTo { width });
        assert!(reason.contains("input `width_m` is") && reason.contains(wrong), "{reason}");
    }
}

#[test]
fn fingers_do_not_open_on_the_way_of_their_arm_where_another_arm_stands_beside_it() {
    // The tip of the right arm's rod is beside the way of the left arm's fingers: 18 mm off where they are closed, in them where they are open.
    let beside = |bench: &mut Bench| {
        ajar(bench);
        let [x, y, z] = between_the_fingers(0.0);
        let before = between_the_fingers(0.1);
        goes(bench, RIGHT, before);
        with_right_at(bench, [x, y + 0.035, z]);
    };
    let away = [HOMES[LEFT][0], HOMES[LEFT][1], 0.2];
    let (mut bench, _folder) = gantry();
    beside(&mut bench);
    // The arm alone may go, and the fingers may not open, neither before nor beside that.
    let reason = refused(&mut bench, LEFT, Request::Release);
    assert!(reason.starts_with("the fingers stay where they are: left_finger"), "{reason}");
    assert_eq!(bench.start_with(LEFT, to(away, 0.1)).1, []);
    let reason = refused(&mut bench, LEFT, Request::Release);
    assert!(reason.starts_with("the fingers stay where they are: left_finger"), "{reason}");
    bench.pass(60.0);
    assert!(matches!(bench.perform_with(LEFT, Request::Release), Ending::Done(_)), "up there is room");
    assert_eq!(bench.cell.unintended_contacts(), []);
}

/// The gantries with a post of their own robot that hangs where the left hand's fingers pass by on the way to y = 0.6 if they are closed, and
/// do not if they are open.
fn with_post() -> (Bench, TempDir) {
    let post = "<link name='post'><collision><geometry><box size='0.01 0.01 0.06'/></geometry></collision></link>\
                <joint name='post' type='fixed'><parent link='world'/><child link='post'/><origin xyz='0 0.66 1.42'/></joint></robot>";
    let folder = tempfile::tempdir().unwrap();
    let config = config(folder.path(), &description());
    std::fs::write(folder.path().join("gantry.urdf"), urdf().replace("</robot>", post)).unwrap();
    (Bench::of(config), folder)
}

#[test]
fn fingers_do_not_open_on_the_way_of_their_arm_where_its_own_robot_is() {
    for arm_first in [false, true] {
        let (mut bench, _folder) = with_post();
        ajar(&mut bench);
        let far = [0.0, 0.63, 0.0];
        if arm_first {
            assert_eq!(bench.start_with(LEFT, to(far, 0.2)).1, []);
            let reason = refused(&mut bench, LEFT, Request::Release);
            assert!(reason.starts_with("the fingers stay where they are: while its fingers open, "), "{reason}");
        } else {
            assert_eq!(bench.start_with(LEFT, Request::Release).1, []);
            let reason = refused(&mut bench, LEFT, to(far, 0.2));
            assert!(reason.starts_with("the trajectory is refused: while its fingers open, "), "{reason}");
            assert!(reason.contains("post") && reason.contains("finger"), "{reason}");
        }
        // Where the post is far, both go.
        bench.pass(60.0);
        goes(&mut bench, LEFT, [0.0, 0.3, 0.0]);
        assert_eq!(bench.cell.unintended_contacts(), []);
    }
}
