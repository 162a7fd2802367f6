//! Our mobile manipulator: the indices by which its parts are known in the one model of a robot, and its state by names.
//!
//! Positions are `f64` throughout; only shapes and the poses handed to parry3d are `f32`. A [`Configuration`] names the 13
//! degrees of freedom. Planning moves the seven arm joints; the others are where a configuration has them.

pub use crate::geometry::{Body, Geometry};
use crate::mechanism::{Mechanism, MechanismError};
pub use crate::robot_model::{Drive, Joint, Link, RobotModel};
pub use crate::urdf::RobotError;
pub use crate::urdf_faults::UrdfFault;
use parry3d::math::{Pose as Pose32, Rotation, Vector};
use parry3d::shape::SharedShape;
use ratn_model::pose::Pose;
use std::ops::Range;

/// Positions of the seven arm joints, in radians.
pub type Joints = [f64; 7];

/// How many degrees of freedom the robot has.
pub const DEGREES_OF_FREEDOM: usize = 13;

/// The URDF's joints in the order of the degrees of freedom.
const JOINT_NAMES: [&str; DEGREES_OF_FREEDOM] = [
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

/// The arm's joints, those of the head and that of the fingers among the degrees of freedom.
const ARM: Range<usize> = 3..10;
const PAN: usize = 10;
const TILT: usize = 11;
const FINGER: usize = 12;

/// The robot that we ship.
const AIMM_URDF: &str = include_str!("../robots/aimm.urdf");
const AIMM_SRDF: &str = include_str!("../robots/aimm.srdf");

/// A robot with this arm, base, head and gripper.
#[derive(Debug, Clone)]
pub struct Robot {
    /// Its joints are in the order of the degrees of freedom; its first link is the world.
    pub model: RobotModel,
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

    /// The positions in the order of the degrees of freedom.
    pub fn positions(&self) -> [f64; DEGREES_OF_FREEDOM] {
        let mut positions = [0.0; DEGREES_OF_FREEDOM];
        positions[..ARM.start].copy_from_slice(&self.base);
        positions[ARM].copy_from_slice(&self.arm);
        (positions[PAN], positions[TILT], positions[FINGER]) = (self.pan, self.tilt, self.finger);
        positions
    }
}

impl Robot {
    /// The robot of the paper: omnidirectional base, KUKA LWR 4+, pan-tilt unit, two-finger gripper.
    pub fn aimm() -> Robot {
        #[expect(clippy::expect_used, reason = "the description is compiled in and read by every test")]
        Robot::read(AIMM_URDF, AIMM_SRDF).expect("the built-in robot description is valid")
    }

    /// Reads a robot with the joint and link names of our URDF; its SRDF says which links are not checked against each other.
    ///
    /// # Errors
    /// [`MechanismError`] names the link or joint.
    pub fn read(urdf: &str, srdf: &str) -> Result<Robot, MechanismError> {
        let model = RobotModel::read(urdf, Some(srdf))?.in_order(&JOINT_NAMES)?;
        let find =
            |name: &str| model.link(name).ok_or_else(|| RobotError::Missing { what: "link", name: name.to_owned() });
        let (tool, camera, arm_foot) = (find("tool")?, find("camera")?, find("arm_0")?);
        let mut arm_joint_links = [0; 7];
        let mut on_arm = vec![false; model.links.len()];
        for (i, link) in model.links.iter().enumerate() {
            on_arm[i] = link.parent.is_some_and(|p| on_arm[p]);
            if let Some(Drive { joint, .. }) = link.drive
                && ARM.contains(&joint)
            {
                on_arm[i] = true;
                arm_joint_links[joint - ARM.start] = i;
            }
        }
        let arm_links = (0..model.links.len()).filter(|i| on_arm[*i]).collect();
        Ok(Robot { model, tool, camera, arm_foot, arm_links, arm_joint_links })
    }

    /// What is planned for where the arm alone moves, and everything else is as in a configuration.
    pub(crate) fn arm(&self, configuration: &Configuration) -> Mechanism {
        self.model.restricted(&ARM.collect::<Vec<usize>>(), &configuration.positions())
    }

    /// The limits of the seven arm joints.
    pub fn arm_joints(&self) -> &[Joint] {
        &self.model.joints[ARM]
    }

    /// The limits of the base's x, y and heading.
    pub fn base_joints(&self) -> &[Joint] {
        &self.model.joints[..ARM.start]
    }

    /// The finger joint: its upper limit is half of the greatest opening.
    pub fn finger(&self) -> &Joint {
        &self.model.joints[FINGER]
    }

    /// The limits of the head's pan and tilt.
    pub fn head_joints(&self) -> &[Joint] {
        &self.model.joints[PAN..=TILT]
    }

    /// The index of a link.
    pub fn link(&self, name: &str) -> Option<usize> {
        self.model.link(name)
    }

    /// The pose of every link in the world frame.
    pub fn poses(&self, configuration: &Configuration) -> Vec<Pose> {
        self.model.poses(&configuration.positions())
    }

    /// Recomputes in place the poses of the links that hang on the arm.
    pub fn update_arm(&self, configuration: &Configuration, poses: &mut [Pose]) {
        self.model.update(&self.arm_links, &configuration.positions(), poses);
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
            looking.pan = (looking.pan + pan_step).clamp(self.head_joints()[0].lower, self.head_joints()[0].upper);
            looking.tilt = (looking.tilt + tilt_step).clamp(self.head_joints()[1].lower, self.head_joints()[1].upper);
        }
        (looking.pan, looking.tilt)
    }

    /// Every collision shape with its place in the world and the index of its link, for rendering.
    pub fn shapes(&self, configuration: &Configuration) -> Vec<(usize, Pose32, SharedShape)> {
        let poses = self.poses(configuration);
        let bodies = self.model.links.iter().enumerate().flat_map(|(i, link)| link.bodies.iter().map(move |b| (i, b)));
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
