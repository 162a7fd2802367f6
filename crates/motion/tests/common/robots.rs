//! Arms of other makes than ours, by their kinematics: seven joints with offsets at elbow and wrist, six joints without a spherical wrist,
//! the latter on a column that slides, and further ones that inverse kinematics treats differently.

#![allow(clippy::unwrap_used, unreachable_pub, dead_code, reason = "shared by several test programs, which may panic")]

use ratn_model::pose::Pose;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::mechanism::Mechanism;
use ratn_motion::reach::Reach;
use std::f64::consts::{FRAC_PI_2, PI};

/// An arm with the frame at its end, and a posture in the middle of what it can do.
pub struct Arm {
    pub mechanism: Mechanism,
    pub tool: Reach,
    pub home: JointVector,
}

/// Where a joint sits, its axis, its limits and its speed; what slides has the second axis.
struct Part {
    xyz: [f64; 3],
    rpy: [f64; 3],
    axis: &'static str,
    slides: bool,
    limits: [f64; 2],
    velocity: f64,
}

fn turn(xyz: [f64; 3], rpy: [f64; 3], axis: &'static str, limits: [f64; 2], velocity: f64) -> Part {
    Part { xyz, rpy, axis, slides: false, limits, velocity }
}

/// As long as the Panda's, with its offsets.
pub fn seven() -> Arm {
    let z = "0 0 1";
    let flat = [FRAC_PI_2, 0.0, 0.0];
    let back = [-FRAC_PI_2, 0.0, 0.0];
    let parts = [
        turn([0.0, 0.0, 0.333], [0.0; 3], z, [-2.8973, 2.8973], 2.175),
        turn([0.0; 3], back, z, [-1.7628, 1.7628], 2.175),
        turn([0.0, -0.316, 0.0], flat, z, [-2.8973, 2.8973], 2.175),
        turn([0.0825, 0.0, 0.0], flat, z, [-3.0718, -0.0698], 2.175),
        turn([-0.0825, 0.384, 0.0], back, z, [-2.8973, 2.8973], 2.61),
        turn([0.0; 3], flat, z, [-0.0175, 3.7525], 2.61),
        turn([0.088, 0.0, 0.0], flat, z, [-2.8973, 2.8973], 2.61),
    ];
    arm("seven", &parts, Pose::at(0.0, 0.0, 0.107), &[0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
}

/// As long as the UR5's.
fn six_parts() -> [Part; 6] {
    let (y, z) = ("0 1 0", "0 0 1");
    let over = [0.0, FRAC_PI_2, 0.0];
    let round = [-PI, PI];
    [
        turn([0.0, 0.0, 0.0892], [0.0; 3], z, round, 3.15),
        turn([0.0, 0.1358, 0.0], over, y, round, 3.15),
        turn([0.0, -0.1197, 0.425], [0.0; 3], y, round, 3.15),
        turn([0.0, 0.0, 0.3922], over, y, round, 3.2),
        turn([0.0, 0.093, 0.0], [0.0; 3], z, round, 3.2),
        turn([0.0, 0.0, 0.0947], [0.0; 3], y, round, 3.2),
    ]
}

const SIX_HOME: [f64; 6] = [0.0, -1.3, 1.6, -1.9, -1.57, 0.3];

pub fn six() -> Arm {
    arm("six", &six_parts(), Pose::at(0.0, 0.0823, 0.0), &SIX_HOME)
}

/// The same on a column.
pub fn lifted() -> Arm {
    let column =
        Part { xyz: [0.0, 0.0, 0.3], rpy: [0.0; 3], axis: "0 0 1", slides: true, limits: [0.0, 0.5], velocity: 0.2 };
    let parts: Vec<Part> = std::iter::once(column).chain(six_parts()).collect();
    let home: Vec<f64> = std::iter::once(0.2).chain(SIX_HOME).collect();
    arm("lifted", &parts, Pose::at(0.0, 0.0823, 0.0), &home)
}

pub fn all() -> [Arm; 3] {
    [seven(), six(), lifted()]
}

/// With limits of two turns either way, as many arms of this make have, and its angles rounded to five digits.
pub fn six_twice_around() -> Arm {
    let twice = |part: Part| {
        let rpy = part.rpy.map(|angle| (angle * 1e5).round() / 1e5);
        Part { limits: [-2.0 * PI, 2.0 * PI], rpy, ..part }
    };
    arm("twice around", &six_parts().map(twice), Pose::at(0.0, 0.0823, 0.0), &SIX_HOME)
}

/// As industrial arms are: the second and the third axis are parallel, the last three meet.
fn industrial() -> Arm {
    let (x, y, z) = ("1 0 0", "0 1 0", "0 0 1");
    let parts = [
        turn([0.0, 0.0, 0.4], [0.0; 3], z, [-2.97, 2.97], 2.6),
        turn([0.18, 0.0, 0.0], [0.0; 3], y, [-1.1, 2.7], 2.6),
        turn([0.0, 0.0, 0.6], [0.0; 3], y, [-2.2, 2.7], 2.6),
        turn([0.12, 0.0, 0.12], [0.0; 3], x, [-3.2, 3.2], 5.7),
        turn([0.5, 0.0, 0.0], [0.0; 3], y, [-2.09, 2.09], 5.7),
        turn([0.0; 3], [0.0; 3], x, [-6.1, 6.1], 10.0),
    ];
    arm("industrial", &parts, Pose::at(0.115, 0.0, 0.0), &[0.0, 0.3, 0.5, 0.0, 0.6, 0.0])
}

/// As long as the Fetch's: the shoulder is not spherical, the wrist is.
fn offset_shoulder(wrist: f64) -> [Part; 7] {
    let (x, y, z) = ("1 0 0", "0 1 0", "0 0 1");
    [
        turn([0.12, 0.0, 0.35], [0.0; 3], z, [-1.6056, 1.6056], 1.256),
        turn([0.117, 0.0, 0.06], [0.0; 3], y, [-1.221, 1.518], 1.454),
        turn([0.219, 0.0, 0.0], [0.0; 3], x, [-PI, PI], 1.571),
        turn([0.133, 0.0, 0.0], [0.0; 3], y, [-2.251, 2.251], 1.521),
        turn([0.197, 0.0, 0.0], [0.0; 3], x, [-PI, PI], 1.571),
        turn([0.1245, 0.0, wrist], [0.0; 3], y, [-2.16, 2.16], 2.268),
        turn([0.1385, 0.0, 0.0], [0.0; 3], x, [-PI, PI], 2.268),
    ]
}

/// Arms for inverse kinematics, by what is special about each.
pub fn many() -> impl Iterator<Item = (&'static str, Arm)> {
    let home = [0.0, 0.5, 0.0, 0.8, 0.0, 0.5, 0.0];
    let tool = Pose::at(0.166, 0.0, 0.0);
    [
        ("like a Panda", seven()),
        ("like a UR5", six()),
        ("like a UR5 with limits of two turns and rounded angles", six_twice_around()),
        ("like a UR5 on a column", lifted()),
        ("industrial", industrial()),
        ("like a Fetch", arm("offset shoulder", &offset_shoulder(0.0), tool, &home)),
        ("with offsets at shoulder and wrist", arm("offset both", &offset_shoulder(0.01), tool, &home)),
    ]
    .into_iter()
}

fn arm(name: &str, parts: &[Part], tool: Pose, home: &[f64]) -> Arm {
    let mut urdf = format!("<robot name='{name}'><link name='l0'/>");
    let mut names = Vec::new();
    for (i, part) in parts.iter().enumerate() {
        let Part { xyz: [x, y, z], rpy: [roll, pitch, yaw], axis, slides, limits: [lower, upper], velocity } = part;
        let kind = if *slides { "prismatic" } else { "revolute" };
        let radius = 0.03;
        urdf += &format!(
            "<link name='l{next}'><collision><geometry><sphere radius='{radius}'/></geometry></collision></link>\
             <joint name='j{next}' type='{kind}'><origin xyz='{x} {y} {z}' rpy='{roll} {pitch} {yaw}'/>\
             <parent link='l{i}'/><child link='l{next}'/><axis xyz='{axis}'/>\
             <limit lower='{lower}' upper='{upper}' effort='1' velocity='{velocity}'/></joint>",
            next = i + 1
        );
        names.push(format!("j{}", i + 1));
    }
    let mechanism = Mechanism::read(&(urdf + "</robot>"), None, &names).unwrap();
    let tool = Reach::new(&mechanism, mechanism.link(&format!("l{}", parts.len())).unwrap(), tool);
    Arm { mechanism, tool, home: JointVector::read(home).unwrap() }
}
