//! A robot whose arm turns without end, for tests, also for those of whole systems: a Panda of whose joints three are continuous, as are the rolls of
//! many arms. Its posture `home` is counted from other turns than the first.

use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

/// The numbers of the arm's continuous joints, from 0.
pub(crate) const ENDLESS: [usize; 3] = [0, 4, 6];

/// Where the arm begins: as the Panda does, with the first joint two turns further back and the last one a turn further on.
pub(crate) const HOME: [f64; 7] = [-2.0 * TAU, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785 + TAU];

/// Writes the robot's files to a folder, and gives the path of its `robot.toml`.
pub(crate) fn write(folder: &Path) -> PathBuf {
    let folders = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().map(|folder| folder.join("crates/motion/robots"));
    let robots = folders.filter(|folder| folder.is_dir()).last().unwrap();
    let built_in = |ending: &str| std::fs::read_to_string(robots.join(format!("panda.{ending}"))).unwrap();
    let mut urdf = built_in("urdf");
    for joint in ENDLESS {
        let name = format!("<joint name=\"arm_joint_{}\" type=", joint + 1);
        assert!(urdf.contains(&format!("{name}\"revolute\"")), "{urdf}");
        urdf = urdf.replace(&format!("{name}\"revolute\""), &format!("{name}\"continuous\""));
    }
    let home = "home = [0, -0.785, 0, -2.356, 0, 1.571, 0.785]";
    let description = built_in("toml").replace("panda", "roller");
    assert!(description.contains(home), "{description}");
    std::fs::write(folder.join("roller.urdf"), urdf).unwrap();
    std::fs::write(folder.join("roller.srdf"), built_in("srdf")).unwrap();
    let path = folder.join("robot.toml");
    std::fs::write(&path, description.replace(home, &format!("home = {HOME:?}"))).unwrap();
    path
}
