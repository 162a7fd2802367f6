//! Two gantries whose hands slide along x, y and z, and a head with a stick, so that every distance is known.

#![allow(dead_code, reason = "not every test needs all of it")]

use super::bench::{Bench, grasp as close};
use ratn_cell::config::CellConfig;
use ratn_cell::core::protocol::{Command, Ending, Event, Request};
use ratn_cell::core::snapshot::Snapshot;
use std::path::Path;
use tempfile::TempDir;

pub(crate) const LEFT: usize = 0;
pub(crate) const RIGHT: usize = 1;
/// Where the hands hang in the posture `home`: x, y and z as seen from the middle of the gantry.
pub(crate) const HOMES: [[f64; 3]; 2] = [[0.0, 0.4, 0.0], [0.0, -0.4, 0.0]];
/// How long the rod of a hand is, from the middle of the hand.
pub(crate) const ROD_M: f64 = 0.30;
/// How far the fingers are beyond the hand's middle, downwards.
pub(crate) const FINGERS_BELOW_M: f64 = 0.06;

/// A hand with a rod ahead of it, two fingers below it and a tool that points down.
pub(crate) fn side(side: &str) -> String {
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

pub(crate) fn urdf() -> String {
    format!(
        "<robot name='gantry'><link name='world'/><link name='torso'/><link name='camera'/>\
         <joint name='camera_mount' type='fixed'><parent link='world'/><child link='camera'/><origin xyz='0 0 3'/></joint>\
         <joint name='torso' type='prismatic'><parent link='world'/><child link='torso'/><axis xyz='0 0 1'/>\
         <limit lower='1.5' upper='1.6' effort='1' velocity='0.5' acceleration='2'/></joint>{}{}</robot>",
        side("left"),
        side("right")
    )
}

pub(crate) fn srdf() -> String {
    let pairs = ["left", "right"].map(|side| {
        [("hand", "finger_a"), ("hand", "finger_b"), ("finger_a", "finger_b")]
            .map(|(a, b)| format!("<disable_collisions link1='{side}_{a}' link2='{side}_{b}'/>"))
            .concat()
    });
    format!("<robot name='gantry'>{}</robot>", pairs.concat())
}

pub(crate) fn description() -> String {
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

pub(crate) fn config(folder: &Path, description: &str) -> CellConfig {
    std::fs::write(folder.join("gantry.urdf"), urdf()).unwrap();
    std::fs::write(folder.join("gantry.srdf"), srdf()).unwrap();
    let file = folder.join("robot.toml");
    std::fs::write(&file, description).unwrap();
    CellConfig { robot: file.display().to_string(), boxes: 0, seed: 2, ..CellConfig::default() }
}

pub(crate) fn gantry() -> (Bench, TempDir) {
    let folder = tempfile::tempdir().unwrap();
    (Bench::of(config(folder.path(), &description())), folder)
}

/// The same gantries with a head between them in place of the camera above: a stick of 0.5 m at the height of the hands, which pan turns about
/// x = 0.6, y = 0 from +x over +y. It hangs from the link `parent`.
pub(crate) fn with_head(parent: &str) -> (Bench, TempDir) {
    with_head_and(parent, "")
}

/// The same with more in the URDF.
pub(crate) fn with_head_and(parent: &str, more: &str) -> (Bench, TempDir) {
    let head = format!(
        "<link name='pan'/><link name='head'><collision><origin xyz='0.25 0 0'/><geometry><box size='0.5 0.02 0.02'/></geometry></collision></link>\
         <link name='lens'/>\
         <joint name='pan' type='revolute'><parent link='{parent}'/><child link='pan'/><origin xyz='0.6 0 {height}'/><axis xyz='0 0 1'/>\
         <limit lower='0' upper='3' effort='1' velocity='0.5' acceleration='2'/></joint>\
         <joint name='tilt' type='revolute'><parent link='pan'/><child link='head'/><axis xyz='0 1 0'/>\
         <limit lower='-0.5' upper='0.5' effort='1' velocity='0.5' acceleration='2'/></joint>\
         <joint name='lens' type='fixed'><parent link='head'/><child link='lens'/><origin rpy='-1.5707963 0 -1.5707963'/></joint>{more}</robot>",
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
pub(crate) fn look(pan: f64) -> Request {
    Request::LookAt { target: [0.6 + 5.0 * pan.cos(), 5.0 * pan.sin(), 1.5] }
}

pub(crate) fn to(joints: [f64; 3], speed: f64) -> Request {
    Request::MoveTo { joints: joints.into(), speed }
}

pub(crate) fn goes(bench: &mut Bench, arm: usize, joints: [f64; 3]) {
    let ending = bench.perform_with(arm, to(joints, 0.5));
    assert!(matches!(ending, Ending::Done(_)), "{joints:?}: {ending:?}");
}

pub(crate) fn refused(bench: &mut Bench, arm: usize, request: Request) -> String {
    match &bench.start_with(arm, request).1[..] {
        [Command::Ended { ending: Ending::Aborted(reason), .. }] => reason.clone(),
        other => panic!("{other:?}"),
    }
}

/// The cell with the right arm elsewhere, with no regard to what is on the way there.
pub(crate) fn with_right_at(bench: &mut Bench, joints: [f64; 3]) {
    let commands = bench.event(Event::Save);
    let [Command::Saved { snapshot }] = &commands[..] else { panic!("{commands:?}") };
    let mut state: serde_json::Value = serde_json::from_str(&snapshot.to_json()).unwrap();
    state["posture"]["other_arms"][0]["joints"] = serde_json::json!(joints);
    let snapshot = Snapshot::from_json(&state.to_string()).unwrap();
    bench.event(Event::PutBack { snapshot: Box::new(snapshot) });
}

/// The tip of the right arm's rod is between the fingers of the left arm, where that hangs at home, or `beyond` short of there.
pub(crate) fn between_the_fingers(beyond: f64) -> [f64; 3] {
    let [x, y, z] = HOMES[LEFT];
    [x - ROD_M + 0.005 - beyond, y, z - FINGERS_BELOW_M]
}

/// The left hand where the stick does not reach it, and where it does.
pub(crate) const ASIDE: [f64; 3] = [0.0, 0.6, 0.0];
pub(crate) const IN_THE_WAY: [f64; 3] = [0.0, 0.15, 0.0];
/// How far the stick turns before it is near to the hands, and how far to pass them, in radians.
pub(crate) const SHORT: f64 = 1.5;
pub(crate) const ROUND: f64 = 2.8;

/// The left arm with fingers that have closed around nothing and opened a little again.
pub(crate) fn ajar(bench: &mut Bench) {
    assert!(matches!(bench.perform_with(LEFT, close()), Ending::Aborted(_)), "they close around nothing");
    assert!(matches!(bench.perform_with(LEFT, Request::OpenTo { width: 0.01 }), Ending::Done(_)));
}

/// The gantries with a post of their own robot that hangs where the left hand's fingers pass by on the way to y = 0.6 if they are closed, and
/// do not if they are open.
pub(crate) fn with_post() -> (Bench, TempDir) {
    let post = "<link name='post'><collision><geometry><box size='0.01 0.01 0.06'/></geometry></collision></link>\
                <joint name='post' type='fixed'><parent link='world'/><child link='post'/><origin xyz='0 0.66 1.42'/></joint></robot>";
    let folder = tempfile::tempdir().unwrap();
    let config = config(folder.path(), &description());
    std::fs::write(folder.path().join("gantry.urdf"), urdf().replace("</robot>", post)).unwrap();
    (Bench::of(config), folder)
}
