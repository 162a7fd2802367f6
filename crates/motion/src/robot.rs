//! The robot as a tree of links, read from its URDF: kinematics and collision shapes.
//!
//! Positions are `f64` throughout; only shapes and the poses handed to parry3d are `f32`. A [`Configuration`] names the 13
//! degrees of freedom. Planning moves the seven arm joints; everything that hangs on them is recomputed by
//! [`Robot::update_arm`], the rest keeps its place.

use crate::frame::compose;
pub use crate::geometry::{Body, Geometry};
use crate::urdf;
pub use crate::urdf::RobotError;
pub use crate::urdf_faults::UrdfFault;
use parry3d::math::{Pose as Pose32, Rotation, Vector};
use parry3d::shape::SharedShape;
use ratn_model::pose::Pose;

/// Positions of the seven arm joints, in radians.
pub type Joints = [f64; 7];

/// How many degrees of freedom the robot has.
pub const DEGREES_OF_FREEDOM: usize = 13;

/// The URDF's joints in the order of the degrees of freedom.
pub(crate) const JOINT_NAMES: [&str; DEGREES_OF_FREEDOM] = [
    "base_x",
    "base_y",
    "base_yaw",
    "arm_joint_1",
    "arm_joint_2",
    "arm_joint_3",
    "arm_joint_4",
    "arm_joint_5",
    "arm_joint_6",
    "arm_joint_7",
    "pan",
    "tilt",
    "finger",
];

/// Index of the first arm joint among the degrees of freedom.
const FIRST_ARM_JOINT: usize = 3;

/// The robot that we ship.
const AIMM_URDF: &str = include_str!("../robots/aimm.urdf");

/// A robot.
#[derive(Debug, Clone)]
pub struct Robot {
    /// Parents before children; the first is the world.
    pub links: Vec<Link>,
    /// Limits, in the order of the degrees of freedom.
    pub joints: Vec<Joint>,
    /// Link indices: the tool frame, the camera's optical frame, the frame the arm is mounted at.
    pub tool: usize,
    /// The camera's optical frame: z forward, x right, y down.
    pub camera: usize,
    /// The fixed foot of the arm.
    pub arm_foot: usize,
    /// The links that an arm joint moves, parents before children.
    pub arm_links: Vec<usize>,
    /// For each arm joint the link that it moves.
    pub arm_joint_links: [usize; 7],
}

/// One degree of freedom and its limits (radians, or metres for sliding joints).
#[derive(Debug, Clone, PartialEq)]
pub struct Joint {
    /// As in the URDF.
    pub name: String,
    /// Least position.
    pub lower: f64,
    /// Greatest position.
    pub upper: f64,
    /// Greatest speed, per second.
    pub velocity: f64,
    /// Greatest acceleration, per second squared.
    pub acceleration: f64,
    /// Greatest jerk, per second cubed.
    pub jerk: f64,
}

/// Where a URDF names no jerk, the full acceleration is reached in this time, in seconds.
const TIME_TO_ACCELERATION_S: f64 = 0.1;

/// The jerk of a URDF, or what its acceleration makes likely.
pub(crate) fn jerk(given: f64, acceleration: f64) -> f64 {
    if given > 0.0 && given.is_finite() { given } else { acceleration / TIME_TO_ACCELERATION_S }
}

/// A rigid link.
#[derive(Debug, Clone)]
pub struct Link {
    /// As in the URDF.
    pub name: String,
    /// The link it hangs on.
    pub parent: Option<usize>,
    /// Where its joint sits in the parent's frame.
    pub origin: Pose,
    /// How it moves there.
    pub motion: Motion,
    /// What can collide.
    pub bodies: Vec<Body>,
}

/// How a link moves relative to its parent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Motion {
    /// Not at all.
    Fixed,
    /// Turns about an axis by the position of a degree of freedom.
    Turn {
        /// Unit vector.
        axis: [f64; 3],
        /// Index of the degree of freedom.
        joint: usize,
    },
    /// Slides along an axis by the position of a degree of freedom.
    Slide {
        /// Unit vector.
        axis: [f64; 3],
        /// Index of the degree of freedom.
        joint: usize,
    },
}

/// Positions of all degrees of freedom.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Configuration {
    /// x and y in metres, yaw in radians, in the world frame.
    pub base: [f64; 3],
    /// Arm joints.
    pub arm: Joints,
    /// Radians, positive to the left.
    pub pan: f64,
    /// Radians, positive downwards.
    pub tilt: f64,
    /// How far each finger is from the middle, in metres: half of the opening.
    pub finger: f64,
}

impl Configuration {
    /// A robot at the world's origin with everything else at zero.
    pub const ZERO: Configuration = Configuration { base: [0.0; 3], arm: [0.0; 7], pan: 0.0, tilt: 0.0, finger: 0.0 };

    /// The base taken from a pose on the floor: its x, y and yaw.
    pub fn with_base(self, base: &Pose) -> Configuration {
        let heading = base.rotate([1.0, 0.0, 0.0]);
        Configuration { base: [base.position[0], base.position[1], heading[1].atan2(heading[0])], ..self }
    }

    fn position(&self, joint: usize) -> f64 {
        match joint {
            0..=2 => self.base[joint],
            3..=9 => self.arm[joint - FIRST_ARM_JOINT],
            10 => self.pan,
            11 => self.tilt,
            _ => self.finger,
        }
    }
}

impl Robot {
    /// The robot of the paper: omnidirectional base, KUKA LWR 4+, pan-tilt unit, two-finger gripper.
    pub fn aimm() -> Robot {
        #[expect(clippy::expect_used, reason = "the description is compiled in and read by every test")]
        Robot::from_urdf(AIMM_URDF).expect("the built-in robot description is valid")
    }

    /// Reads a robot with the joint and link names of our URDF.
    ///
    /// # Errors
    /// [`RobotError`] names the link or joint.
    pub fn from_urdf(text: &str) -> Result<Robot, RobotError> {
        let (joints, links) = urdf::read(text)?;
        let find = |name: &str| {
            links
                .iter()
                .position(|l| l.name == name)
                .ok_or_else(|| RobotError::Missing { what: "link", name: name.to_owned() })
        };
        let (tool, camera, arm_foot) = (find("tool")?, find("camera")?, find("arm_0")?);
        let mut arm_joint_links = [0; 7];
        let mut on_arm = vec![false; links.len()];
        for (i, link) in links.iter().enumerate() {
            on_arm[i] = link.parent.is_some_and(|p| on_arm[p]);
            if let Motion::Turn { joint, .. } = link.motion
                && (FIRST_ARM_JOINT..FIRST_ARM_JOINT + 7).contains(&joint)
            {
                on_arm[i] = true;
                arm_joint_links[joint - FIRST_ARM_JOINT] = i;
            }
        }
        let arm_links = (0..links.len()).filter(|i| on_arm[*i]).collect();
        Ok(Robot { links, joints, tool, camera, arm_foot, arm_links, arm_joint_links })
    }

    /// The limits of the seven arm joints.
    pub fn arm_joints(&self) -> &[Joint] {
        &self.joints[FIRST_ARM_JOINT..FIRST_ARM_JOINT + 7]
    }

    /// The limits of the base's x, y and heading.
    pub fn base_joints(&self) -> &[Joint] {
        &self.joints[..FIRST_ARM_JOINT]
    }

    /// The finger joint: its upper limit is half of the greatest opening.
    pub fn finger(&self) -> &Joint {
        &self.joints[12]
    }

    /// The index of a link.
    pub fn link(&self, name: &str) -> Option<usize> {
        self.links.iter().position(|l| l.name == name)
    }

    /// The pose of every link in the world frame.
    pub fn poses(&self, configuration: &Configuration) -> Vec<Pose> {
        let mut poses: Vec<Pose> = Vec::with_capacity(self.links.len());
        for link in &self.links {
            let local = local_pose(link, |joint| configuration.position(joint));
            poses.push(link.parent.map_or(local, |parent| compose(&poses[parent], &local)));
        }
        poses
    }

    /// Recomputes in place the poses of the links that hang on the arm.
    pub fn update_arm(&self, arm: &Joints, finger: f64, poses: &mut [Pose]) {
        for &i in &self.arm_links {
            let link = &self.links[i];
            let local = local_pose(link, |joint| if joint == 12 { finger } else { arm[joint - FIRST_ARM_JOINT] });
            poses[i] = link.parent.map_or(local, |parent| compose(&poses[parent], &local));
        }
    }

    /// The pose of one link in the world frame.
    pub fn pose(&self, configuration: &Configuration, link: usize) -> Pose {
        self.poses(configuration)[link]
    }

    /// The tool frame in the world frame.
    pub fn tool_pose(&self, configuration: &Configuration) -> Pose {
        self.pose(configuration, self.tool)
    }

    /// The camera's optical frame in the world frame.
    pub fn camera_pose(&self, configuration: &Configuration) -> Pose {
        self.pose(configuration, self.camera)
    }

    /// Pan and tilt that point the camera at a point of the world, held within their limits.
    pub fn look_at(&self, base: &Pose, target: [f64; 3]) -> (f64, f64) {
        let mut looking = Configuration::ZERO.with_base(base);
        // The optical centre sits off the tilt axis: a few rounds make up for it.
        for _ in 0..8 {
            let camera = self.camera_pose(&looking);
            let seen = camera.inverse().transform(target);
            let pan_step = -(seen[0]).atan2((seen[2].powi(2) + seen[1].powi(2)).sqrt());
            let tilt_step = seen[1].atan2(seen[2]);
            looking.pan = (looking.pan + pan_step).clamp(self.joints[10].lower, self.joints[10].upper);
            looking.tilt = (looking.tilt + tilt_step).clamp(self.joints[11].lower, self.joints[11].upper);
        }
        (looking.pan, looking.tilt)
    }

    /// Every collision shape with its place in the world and the index of its link, for rendering.
    pub fn shapes(&self, configuration: &Configuration) -> Vec<(usize, Pose32, SharedShape)> {
        let poses = self.poses(configuration);
        let bodies = self.links.iter().enumerate().flat_map(|(i, link)| link.bodies.iter().map(move |b| (i, b)));
        bodies.map(|(i, body)| (i, to_f32(&poses[i].compose(&body.pose)), body.geometry.shape(0.0))).collect()
    }

    /// The joints held within their limits.
    pub fn clamp(&self, arm: &Joints) -> Joints {
        let mut clamped = *arm;
        for (q, joint) in clamped.iter_mut().zip(self.arm_joints()) {
            *q = q.clamp(joint.lower, joint.upper);
        }
        clamped
    }
}

/// A pose for parry3d.
pub fn to_f32(pose: &Pose) -> Pose32 {
    let ([x, y, z], [i, j, k, w]) = (pose.position.map(|c| c as f32), pose.quaternion_xyzw.map(|c| c as f32));
    Pose32::from_parts(Vector::new(x, y, z), Rotation::from_xyzw(i, j, k, w))
}

fn local_pose(link: &Link, position: impl Fn(usize) -> f64) -> Pose {
    match link.motion {
        Motion::Fixed => link.origin,
        Motion::Turn { axis: [x, y, z], joint } => {
            let (sin, cos) = (position(joint) / 2.0).sin_cos();
            compose(&link.origin, &Pose { position: [0.0; 3], quaternion_xyzw: [x * sin, y * sin, z * sin, cos] })
        }
        Motion::Slide { axis, joint } => {
            let along = position(joint);
            compose(&link.origin, &Pose { position: axis.map(|c| c * along), ..Pose::IDENTITY })
        }
    }
}
