//! A robot with two arms for tests, also for those of whole systems: two Pandas on stands of their own at one table, made of the URDF of the built-in one.

use std::path::{Path, PathBuf};

/// The sides of the arms in the order of their numbers, and where each stands across the table, in metres.
pub(crate) const SIDES: [(&str, f64); 2] = [("left", 0.35), ("right", -0.35)];

fn built_in(ending: &str) -> String {
    let folders = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().map(|folder| folder.join("crates/motion/robots"));
    let robots = folders.filter(|folder| folder.is_dir()).last().unwrap();
    std::fs::read_to_string(robots.join(format!("panda.{ending}"))).unwrap()
}

/// The same text with the names of everything that is there once per arm.
fn of_side(text: &str, side: &str) -> String {
    ["stand", "arm_", "hand", "finger", "tool"]
        .iter()
        .fold(text.to_owned(), |text, name| text.replace(&format!("=\"{name}"), &format!("=\"{side}_{name}")))
}

fn between<'a>(text: &'a str, from: &str, to: &str) -> &'a str {
    let (_, behind) = text.split_once(from).unwrap();
    behind.split_once(to).unwrap().0
}

fn urdf() -> String {
    let panda = built_in("urdf");
    let stand = between(&panda, "<link name=\"world\"/>", "<!-- Mast");
    let mast = between(&panda, "front of it -->", "<!-- Arm -->");
    let (_, mast) = mast.split_once("<!-- Mast").unwrap();
    let arm = between(&panda, "<!-- Arm -->", "</robot>");
    let stand = stand.split_once("-->").unwrap().1;
    let arms = SIDES.map(|(side, y)| {
        let mounted = format!("<child link=\"{side}_stand\"/><origin xyz=\"0 {y} 0\"/>");
        of_side(stand, side).replacen(&format!("<child link=\"{side}_stand\"/>"), &mounted, 1) + &of_side(arm, side)
    });
    format!("<robot name=\"duo\" version=\"1.2\"><link name=\"world\"/><!-- Mast{mast}{}</robot>", arms.concat())
}

fn srdf() -> String {
    let pairs = built_in("srdf");
    let pairs = between(&pairs, "<robot name=\"panda\">", "</robot>");
    format!("<robot name=\"duo\">{}</robot>", SIDES.map(|(side, _)| of_side(pairs, side)).concat())
}

fn arm(side: &str) -> String {
    let joints: Vec<String> = (1..=7).map(|i| format!("\"{side}_arm_joint_{i}\"")).collect();
    format!("name = \"{side}\"\njoints = [{}]\ntool = \"{side}_tool\"\n", joints.join(", "))
}

fn gripper(side: &str) -> String {
    format!("joint = \"{side}_finger\"\nhand = \"{side}_hand\"\nfinger = \"{side}_finger_left\"\n")
}

const HOME: &str = "[0, -0.785, 0, -2.356, 0, 1.571, 0.785]";

fn description(name: &str) -> String {
    format!(
        "name = \"{name}\"\nurdf = \"duo.urdf\"\nsrdf = \"duo.srdf\"\n[arm]\n{}[gripper]\n{}[camera]\nlink = \"camera\"\n\
         [postures]\nhome = {HOME}\n[[other_arm]]\n{}[other_arm.gripper]\n{}[other_arm.postures]\nhome = {HOME}\n\
         [workplace]\ntable = {{ centre = [0.60, 0, 0.675], size = [0.80, 1.40, 0.05] }}\n\
         boxes = {{ x = [0.40, 0.52], y = [-0.10, 0.50], least = [0.05, 0.04, 0.07], greatest = [0.10, 0.05, 0.10] }}\n\
         places = {{ on = \"table\", yaw = 1.5707963267948966, at = [[0.40, -0.40, 0.70], [0.60, -0.40, 0.70], [0.50, -0.55, 0.70]] }}\n",
        arm("left"),
        gripper("left"),
        arm("right"),
        gripper("right")
    )
}

/// Writes the robot's files, and returns its `robot.toml`.
pub(crate) fn write(folder: &Path) -> PathBuf {
    write_as(folder, "duo", &urdf())
}

/// The same under another name, and with a joint that turns as far as another one.
#[allow(dead_code, reason = "not every test needs it")]
pub(crate) fn write_other(folder: &Path) -> PathBuf {
    let narrower = urdf().replacen("upper=\"2.8973\"", "upper=\"2.7973\"", 1);
    write_as(folder, "duo", &narrower)
}

fn write_as(folder: &Path, name: &str, urdf: &str) -> PathBuf {
    std::fs::write(folder.join("duo.urdf"), urdf).unwrap();
    std::fs::write(folder.join("duo.srdf"), srdf()).unwrap();
    let file = folder.join("robot.toml");
    std::fs::write(&file, description(name)).unwrap();
    file
}
