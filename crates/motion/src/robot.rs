//! A robot with its parts: an arm and, if it has them, a gripper, a base, a head and a camera.
//!
//! The joints and links of these parts are defined by data ([`RobotDescription`]); the built-in robots are read the same way. Positions are `f64`;
//! only shapes and the poses for parry3d are `f32`. A [`Configuration`] has the positions of all parts. Planning moves the arm; the other parts stay
//! at a configuration's positions, joints of no part at zero or at the limit next to it.

mod arms;
mod fingers;
mod identity;
mod parts;

use crate::description::RobotDescription;
use crate::exact::{Exact, Touch};
pub use crate::geometry::{Body, Geometry};
use crate::joint_vector::JointVector;
use crate::levers::Chain;
use crate::mechanism::{MAX_JOINTS, Mechanism, MechanismError};
use crate::mesh::MeshError;
pub use crate::robot_model::{Drive, Joint, Link, RobotModel};
use crate::robot_state::RobotState;
use crate::space::Obstacle;
pub use crate::urdf::RobotError;
pub use crate::urdf_faults::UrdfFault;
use crate::validate::POSITION_TOLERANCE;
use crate::workplace::Workplace;
use arms::OtherArm;
pub use arms::{ArmPosition, MAX_ARMS, OtherArms, UNSAID};
pub use fingers::FingerPart;
pub use identity::RobotIdentity;
use parry3d::math::{Pose as Pose32, Rotation, Vector};
use parry3d::shape::SharedShape;
use ratn_model::load::suggestion;
use ratn_model::pose::Pose;

/// A robot with an arm.
#[derive(Debug, Clone)]
pub struct Robot {
    /// All links and joints.
    pub model: RobotModel,
    /// The index of the link that is the tool frame.
    pub tool: usize,
    /// The links that the arm's joints move, parents before children.
    pub arm_links: Vec<usize>,
    /// For each arm joint the link that it moves.
    pub arm_joint_links: Vec<usize>,
    description: RobotDescription,
    arm: Part,
    other_arms: Vec<OtherArm>,
    base: Option<Part>,
    head: Option<Part>,
    finger: Option<Part>,
    /// The index of the link that is the camera's optical frame: z forward, x right, y down.
    camera: Option<usize>,
    /// The link that carries the fingers, and a finger.
    gripper: Option<[usize; 2]>,
    /// The base's body.
    body: Option<usize>,
    postures: Vec<(String, JointVector)>,
    /// Default positions of all joints.
    neutral: Vec<f64>,
}

/// A group of a robot's joints.
#[derive(Debug, Clone)]
struct Part {
    /// Indices of the model's joints.
    indices: Vec<usize>,
    joints: Vec<Joint>,
    /// Whether each joint is prismatic.
    slides: Vec<bool>,
}

/// The positions of a robot's parts. Values of parts that the robot does not have are ignored.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Configuration {
    /// The base: x and y in metres, yaw in radians, in the world frame.
    pub base: [f64; 3],
    /// The arm's joints, in radians.
    pub arm: JointVector,
    /// Pan of the head, in radians, positive to the left.
    pub pan: f64,
    /// Tilt of the head, in radians, positive downwards.
    pub tilt: f64,
    /// The distance of each finger from the middle, in metres: half of the opening.
    pub finger: f64,
    /// Positions of the other arms and their fingers, for a robot with several arms.
    pub others: OtherArms,
}

/// Why a description and a URDF do not define a robot.
#[derive(Debug, thiserror::Error)]
pub enum RobotFault {
    /// The URDF, the SRDF or a mesh is invalid, or lacks a name that the description uses.
    #[error(transparent)]
    Model(#[from] MechanismError),
    /// The arm has no joints, or too many.
    #[error("`arm.joints` has {count} joints: expected 1 to {MAX_JOINTS}")]
    ArmJoints {
        /// Number of joints.
        count: usize,
    },
    /// A part names a link that the URDF does not have.
    #[error("`{key}`: the robot description has no link `{link}`; {help}")]
    NoLink {
        /// The key in the description.
        key: &'static str,
        /// The name of the link.
        link: String,
        /// A suggestion.
        help: String,
    },
    /// A joint of the arm does not move the tool.
    #[error("the joint `{joint}` of the arm does not move its tool, the link `{tool}`")]
    Beside {
        /// The joint.
        joint: String,
        /// The tool.
        tool: String,
    },
    /// There are too many arms.
    #[error("{count} arms: at most {MAX_ARMS} are supported")]
    Arms {
        /// Number of arms.
        count: usize,
    },
    /// Two arms have the same name.
    #[error("two arms are called `{arm}`")]
    ArmTwice {
        /// The name.
        arm: String,
    },
    /// A joint belongs to two parts.
    #[error(
        "the joint `{joint}` is of two parts, {first} and {second}: only one of them can move it, leave it out of the other"
    )]
    JointOfTwo {
        /// The joint.
        joint: String,
        /// The first part.
        first: String,
        /// The other part.
        second: String,
    },
    /// The joints of an arm are in the wrong order.
    #[error(
        "`arm.joints` goes from the foot to the tool: the joint `{joint}` is nearer to the foot than `{before}`, put it before that one"
    )]
    Order {
        /// The joint.
        joint: String,
        /// The joint before it in the description.
        before: String,
    },
    /// A joint has a kind that its part cannot have.
    #[error("`{key}`: the joint `{joint}` {does}; expected {expected}")]
    Kind {
        /// The key in the description.
        key: &'static str,
        /// The joint.
        joint: String,
        /// The motion of its link, or of a link that mimics it.
        does: String,
        /// The expected motion.
        expected: &'static str,
    },
    /// The gripper's joint does not move the finger.
    #[error("`gripper.finger`: the joint `{joint}` does not move the link `{finger}`; name one that it does")]
    Finger {
        /// The gripper's joint.
        joint: String,
        /// The finger.
        finger: String,
    },
    /// The base is not at the pose that its joints give.
    #[error(
        "`base.joints`: at x = 1, y = 2 and heading 0.5 the link `{link}` is at {at:?} or turned; the base's joints begin at the root of \
         the URDF, without an offset before or between them: put an offset behind the last one"
    )]
    BaseOff {
        /// The link that the heading rotates.
        link: String,
        /// Its position.
        at: [f64; 3],
    },
    /// The base cannot be in its area.
    #[error("`base.area`: {area:?} has nothing in common with the limits {limits:?} of the joint `{joint}`")]
    Area {
        /// The joint.
        joint: String,
        /// The interval of the description, in metres.
        area: [f64; 2],
        /// The limits of the URDF.
        limits: [f64; 2],
    },
    /// The robot has no arm of this name.
    #[error("{robot} has no arm `{arm}` for this: its arms are {arms}")]
    NoArm {
        /// The arm.
        arm: String,
        /// The robot.
        robot: String,
        /// Its arms.
        arms: String,
    },
    /// A named posture is out of the arm's limits.
    #[error("the posture `{posture}` {reason}")]
    Posture {
        /// Its name.
        posture: String,
        /// The error.
        reason: String,
    },
    /// The workplace does not suit the robot.
    #[error("[workplace]: {reason}")]
    Workplace {
        /// The error.
        reason: String,
    },
}

impl RobotFault {
    /// The link or joint of the description that the error is about.
    pub(crate) fn named(&self) -> Option<&str> {
        match self {
            RobotFault::Model(MechanismError::Robot(
                RobotError::Missing { name, .. } | RobotError::NotPlannable { name, .. },
            )) => Some(name),
            RobotFault::NoLink { link: name, .. }
            | RobotFault::Model(MechanismError::Twice { joint: name })
            | RobotFault::Beside { joint: name, .. }
            | RobotFault::JointOfTwo { joint: name, .. }
            | RobotFault::Order { joint: name, .. }
            | RobotFault::Kind { joint: name, .. }
            | RobotFault::Finger { finger: name, .. } => Some(name),
            _ => None,
        }
    }
}

/// The built-in robots: name, description, URDF and SRDF.
const BUILT_IN: [(&str, &str, &str, &str); 4] = [
    (
        "aimm",
        include_str!("../robots/aimm.toml"),
        include_str!("../robots/aimm.urdf"),
        include_str!("../robots/aimm.srdf"),
    ),
    (
        "panda",
        include_str!("../robots/panda.toml"),
        include_str!("../robots/panda.urdf"),
        include_str!("../robots/panda.srdf"),
    ),
    ("ur5", include_str!("../robots/ur5.toml"), include_str!("../robots/ur5.urdf"), include_str!("../robots/ur5.srdf")),
    (
        "twin",
        include_str!("../robots/twin.toml"),
        include_str!("../robots/twin.urdf"),
        include_str!("../robots/twin.srdf"),
    ),
];

impl Configuration {
    /// The same with the base at the x, y and yaw of a pose on the floor.
    pub fn with_base(self, base: &Pose) -> Configuration {
        Configuration { base: on_floor(base), ..self }
    }

    /// All positions: base, arm, pan, tilt and finger; then the joints and the finger of each other arm with a position.
    pub fn values(&self) -> Vec<f64> {
        let mut values = [&self.base[..], &self.arm[..], &[self.pan, self.tilt, self.finger]].concat();
        for other in self.others.iter().flatten() {
            values.extend(&other.joints);
            values.push(other.finger);
        }
        values
    }
}

impl Robot {
    /// The robot of the paper: omnidirectional base, KUKA LWR 4+, pan-tilt unit, two-finger gripper.
    pub fn aimm() -> Robot {
        #[expect(clippy::expect_used, reason = "it is compiled in and read by every test")]
        Robot::built_in("aimm").expect("it is built in")
    }

    /// The names of the built-in robots.
    pub fn built_in_names() -> impl Iterator<Item = &'static str> {
        BUILT_IN.into_iter().map(|(name, ..)| name)
    }

    /// The URDF of the built-in robot of this name.
    pub(crate) fn built_in_urdf(name: &str) -> Option<&'static str> {
        BUILT_IN.into_iter().find(|(known, ..)| *known == name).map(|(_, _, urdf, _)| urdf)
    }

    /// The built-in robot of this name.
    pub fn built_in(name: &str) -> Option<Robot> {
        let (_, description, urdf, srdf) = BUILT_IN.into_iter().find(|(known, ..)| *known == name)?;
        let read = RobotDescription::read(description).and_then(|description| {
            let no_meshes = &mut |_: &str| Err(MeshError::Read { reason: "there are none".to_owned() });
            Robot::of(description, urdf, Some(srdf), no_meshes).map_err(|error| error.to_string())
        });
        match read {
            Ok(robot) => Some(robot),
            Err(error) => unreachable!("the built-in robot {name}: {error}"),
        }
    }

    /// Reads a robot from a description and the texts of the URDF and SRDF that it refers to; `load` returns the bytes of a mesh file of the URDF.
    ///
    /// # Errors
    /// [`RobotFault`] gives the link, joint or posture and its error.
    pub fn of(
        description: RobotDescription,
        urdf: &str,
        srdf: Option<&str>,
        load: &mut dyn FnMut(&str) -> Result<Vec<u8>, MeshError>,
    ) -> Result<Robot, RobotFault> {
        // Errors that do not concern shapes are found before the meshes are read, which takes seconds; and errors of any arm at once.
        let outline = Robot::on(description.clone(), RobotModel::outline(urdf, srdf)?)?;
        outline.other_arms().try_for_each(|arm| outline.with_arm(arm).map(drop))?;
        Robot::on(description, RobotModel::read_with_covers(urdf, srdf, load)?)
    }

    /// Applies a description to a robot model. The shapes are not used.
    fn on(description: RobotDescription, model: RobotModel) -> Result<Robot, RobotFault> {
        let link = |key: &'static str, name: &str| {
            let known = model.links.iter().map(|link| link.name.as_str());
            let missing = || {
                let help = suggestion(name, known, "", "name one of the URDF");
                RobotFault::NoLink { key, link: name.to_owned(), help }
            };
            model.link(name).ok_or_else(missing)
        };
        let RobotDescription { arm, gripper, base, head, camera, postures, .. } = &description;
        if !(1..=MAX_JOINTS).contains(&arm.joints.len()) {
            return Err(RobotFault::ArmJoints { count: arm.joints.len() });
        }
        description.check_shared()?;
        let tool = link("arm.tool", &arm.tool)?;
        let arm_part = Part::of(&model, &arm.joints)?;
        let base_part = base.as_ref().map(|base| Part::base(&model, base)).transpose()?;
        let head_part = head.as_ref().map(|head| Part::head(&model, head)).transpose()?;
        let finger = gripper.as_ref().map(|gripper| Part::gripper(&model, gripper)).transpose()?;
        let camera = camera.as_ref().map(|camera| link("camera.link", &camera.link)).transpose()?;
        let body = base.as_ref().map(|base| link("base.body", &base.body)).transpose()?;
        let gripper = match gripper {
            Some(gripper) => Some([link("gripper.hand", &gripper.hand)?, link("gripper.finger", &gripper.finger)?]),
            None => None,
        };
        let arm_joint_links = arm_part.links_to(&model, tool)?;
        let arm_links = arm_part.moved_links(&model);
        let posture = |(name, values): (&String, &Vec<f64>)| Ok((name.clone(), arm_part.posture(name, values)?));
        let postures = postures.iter().map(posture).collect::<Result<Vec<_>, RobotFault>>()?;
        let mut neutral = RobotState::neutral(&model).positions().to_vec();
        let other_arms = OtherArm::all(&description, &model, &mut neutral)?;
        let robot = Robot {
            model,
            tool,
            arm_links,
            arm_joint_links,
            arm: arm_part,
            other_arms,
            base: base_part,
            head: head_part,
            finger,
            camera,
            gripper,
            body,
            postures,
            neutral,
            description,
        };
        match robot.workplace().and_then(|workplace| workplace.fault(&robot)) {
            Some(reason) => Err(RobotFault::Workplace { reason }),
            None => Ok(robot),
        }
    }

    /// The robot's name in messages.
    pub fn name(&self) -> &str {
        &self.description.name
    }

    /// The table, the boxes and their places in its cell; `None` for a robot without a cell.
    pub fn workplace(&self) -> Option<&Workplace> {
        self.description.workplace.as_ref()
    }

    /// All positions at zero, or at the limit next to it; the base at the world's origin.
    pub fn at_zero(&self) -> Configuration {
        let at = |part: &Option<Part>, j: usize| part.as_ref().map_or(0.0, |part| self.neutral[part.indices[j]]);
        Configuration {
            base: [0.0; 3],
            arm: JointVector::from_fn(self.arm.indices.len(), |j| self.neutral[self.arm.indices[j]]),
            pan: at(&self.head, 0),
            tilt: at(&self.head, 1),
            finger: at(&self.finger, 0),
            others: UNSAID,
        }
    }

    /// The inverse of [`Configuration::values`], with or without the other arms; `None` for any other number of values.
    pub fn configuration(&self, values: &[f64]) -> Option<Configuration> {
        let (own, of_others) = (self.arm.joints.len() + 6, self.other_arms.iter().map(OtherArm::values).sum::<usize>());
        if values.len() != own && values.len() != own + of_others {
            return None;
        }
        let (values, mut left) = values.split_at(own);
        let (arm, rest) = values[3..].split_at(self.arm.joints.len());
        let arm = JointVector::read(arm).ok()?;
        let base = [values[0], values[1], values[2]];
        let mut others = UNSAID;
        for (at, other) in others.iter_mut().zip(&self.other_arms).filter(|_| !left.is_empty()) {
            let (of_arm, behind) = left.split_at(other.values());
            let (finger, joints) = of_arm.split_last()?;
            *at = Some(ArmPosition { joints: JointVector::read(joints).ok()?, finger: *finger });
            left = behind;
        }
        Some(Configuration { base, arm, pan: rest[0], tilt: rest[1], finger: rest[2], others })
    }

    /// A posture of the description by its name.
    pub fn posture(&self, name: &str) -> Option<JointVector> {
        self.postures.iter().find(|(known, _)| known == name).map(|(_, posture)| *posture)
    }

    /// The postures of the description with their names.
    pub fn postures(&self) -> &[(String, JointVector)] {
        &self.postures
    }

    /// Positions of the model's joints.
    pub fn positions(&self, configuration: &Configuration) -> Vec<f64> {
        let mut positions = self.neutral.clone();
        let Configuration { base, arm, pan, tilt, finger, others } = configuration;
        let mut put = |part: Option<&Part>, values: &[f64]| {
            for (index, value) in part.into_iter().flat_map(|part| &part.indices).zip(values) {
                positions[*index] = *value;
            }
        };
        put(self.base.as_ref(), base);
        put(Some(&self.arm), arm);
        put(self.head.as_ref(), &[*pan, *tilt]);
        put(self.finger.as_ref(), &[*finger]);
        for (other, at) in self.other_arms.iter().zip(others) {
            at.iter().for_each(|at| other.put(at, &mut positions));
        }
        positions
    }

    /// The mechanism in which only the arm moves, and all other parts are as in a configuration.
    pub(crate) fn arm(&self, configuration: &Configuration) -> Mechanism {
        self.model.restricted(&self.arm.indices, &self.positions(configuration))
    }

    /// The chain to a link in which only the arm's joints move, and all other parts are as in a configuration.
    pub(crate) fn arm_chain(&self, configuration: &Configuration, link: usize) -> Chain {
        let positions = self.positions(configuration);
        Chain::to(link, &self.model.links, |link| link.moved_by(&self.arm.indices, &positions))
    }

    /// As `arm_chain`, but the joints that move are those of the fingers.
    pub(crate) fn finger_chain(&self, configuration: &Configuration, link: usize) -> Chain {
        let positions = self.positions(configuration);
        let indices: &[usize] = self.finger.as_ref().map_or(&[], |finger| &finger.indices);
        Chain::to(link, &self.model.links, |link| link.moved_by(indices, &positions))
    }

    /// The limits of the joints that move the fingers; none for a robot without a gripper.
    pub(crate) fn finger_joints(&self) -> &[Joint] {
        self.finger.as_ref().map_or(&[], |finger| &finger.joints)
    }

    /// The limits of the arm's joints.
    pub fn arm_joints(&self) -> &[Joint] {
        &self.arm.joints
    }

    /// Whether each joint of the arm is prismatic: then its positions are in metres, else in radians.
    pub fn arm_slides(&self) -> &[bool] {
        &self.arm.slides
    }

    /// The limits of the base's x, y and heading, x and y within its area; empty for a robot without a base.
    pub fn base_joints(&self) -> &[Joint] {
        self.base.as_ref().map_or(&[], |base| &base.joints)
    }

    /// The finger's joint: its upper limit is half of the maximum opening. `None` for a robot without a gripper.
    pub fn finger(&self) -> Option<&Joint> {
        self.finger.as_ref().map(|finger| &finger.joints[0])
    }

    /// Half of the maximum opening of the fingers, in metres; 0 without a gripper.
    pub fn open_finger_m(&self) -> f64 {
        self.finger().map_or(0.0, |finger| finger.upper)
    }

    /// The limits of pan and tilt; empty for a robot without a head.
    pub fn head_joints(&self) -> &[Joint] {
        self.head.as_ref().map_or(&[], |head| &head.joints)
    }

    /// The links that pan and tilt move; empty for a robot without a head.
    pub fn head_links(&self) -> Vec<usize> {
        self.head.as_ref().map_or_else(Vec::new, |head| head.moved_links(&self.model))
    }

    /// The link to which the fingers are attached.
    pub fn hand(&self) -> Option<usize> {
        self.gripper.map(|[hand, _]| hand)
    }

    /// The link of one finger.
    pub fn finger_link(&self) -> Option<usize> {
        self.gripper.map(|[_, finger]| finger)
    }

    /// The links of all fingers: those that the gripper's joint moves, directly or through joints that mimic it.
    pub fn finger_links(&self) -> Vec<usize> {
        self.finger.as_ref().map_or_else(Vec::new, |finger| finger.moved_links(&self.model))
    }

    /// The body of the base; objects on top of it ride on the base.
    pub fn body(&self) -> Option<usize> {
        self.body
    }

    /// The index of a link.
    pub fn link(&self, name: &str) -> Option<usize> {
        self.model.link(name)
    }

    /// The same with the positions of arm, head and fingers that are beyond a limit by no more than trajectories may be moved to the limit.
    pub(crate) fn within_limits(&self, at: &Configuration) -> Configuration {
        let within = |joint: &Joint, position: f64| match joint.allows(position, POSITION_TOLERANCE) {
            true => joint.clamp(position),
            false => position,
        };
        let mut moved = *at;
        moved.arm.iter_mut().zip(self.arm_joints()).for_each(|(position, joint)| *position = within(joint, *position));
        for (position, joint) in [&mut moved.pan, &mut moved.tilt].into_iter().zip(self.head_joints()) {
            *position = within(joint, *position);
        }
        if let Some(joint) = self.finger() {
            moved.finger = within(joint, moved.finger);
        }
        moved
    }

    /// Poses of all links in the world frame.
    pub fn poses(&self, configuration: &Configuration) -> Vec<Pose> {
        self.model.poses(&self.positions(configuration))
    }

    /// Recomputes in place the poses of the links that the arm moves; the rest of the configuration must not have changed.
    pub(crate) fn update_arm(&self, configuration: &Configuration, poses: &mut [Pose]) {
        self.model.update(&self.arm_links, &self.positions(configuration), poses);
    }

    /// The pose of one link in the world frame.
    pub fn pose(&self, configuration: &Configuration, link: usize) -> Pose {
        self.poses(configuration)[link]
    }

    /// The pose of the tool frame in the world frame.
    pub fn tool_pose(&self, configuration: &Configuration) -> Pose {
        self.pose(configuration, self.tool)
    }

    /// The pose of the camera's optical frame in the world frame; `None` for a robot without a camera.
    pub fn camera_pose(&self, configuration: &Configuration) -> Option<Pose> {
        self.camera.map(|camera| self.pose(configuration, camera))
    }

    /// Pan and tilt that point the camera at a point of the world, within their limits, with the rest of the robot as in `here`.
    pub fn look_at(&self, here: &Configuration, target: [f64; 3]) -> (f64, f64) {
        let ahead = self.at_zero();
        let mut looking = Configuration { pan: ahead.pan, tilt: ahead.tilt, ..*here };
        let [pan, tilt] = self.head_joints() else { return (looking.pan, looking.tilt) };
        // The optical centre is off the tilt axis: a few iterations compensate for it.
        for _ in 0..8 {
            let Some(camera) = self.camera_pose(&looking) else { break };
            let seen = camera.inverse().transform(target);
            let pan_step = -(seen[0]).atan2((seen[2].powi(2) + seen[1].powi(2)).sqrt());
            let tilt_step = seen[1].atan2(seen[2]);
            looking.pan = pan.clamp(looking.pan + pan_step);
            looking.tilt = tilt.clamp(looking.tilt + tilt_step);
        }
        (pan.counted_from(here.pan, looking.pan), tilt.counted_from(here.tilt, looking.tilt))
    }

    /// All collisions by the exact shapes, deepest first: of obstacles with any link, and of links of the robot that the arm moves relative to each other.
    pub fn touches(&self, configuration: &Configuration, standing: &[Obstacle]) -> Vec<Touch> {
        let mechanism = self.arm(configuration);
        Exact::new(&mechanism, standing).touches(&configuration.arm)
    }

    /// Every collision shape with its pose in the world and the index of its link, for rendering.
    pub fn shapes(&self, configuration: &Configuration) -> Vec<(usize, Pose32, SharedShape)> {
        let poses = self.poses(configuration);
        let bodies = self.model.links.iter().enumerate().flat_map(|(i, link)| link.bodies.iter().map(move |b| (i, b)));
        bodies.map(|(i, body)| (i, to_f32(&poses[i].compose(&body.pose)), body.geometry.shape(0.0))).collect()
    }

    /// The nearest posture within the joints' limits.
    pub fn clamp(&self, arm: &JointVector) -> JointVector {
        let mut clamped = *arm;
        for (q, joint) in clamped.iter_mut().zip(self.arm_joints()) {
            *q = joint.clamp(*q);
        }
        clamped
    }
}

impl Part {
    fn of(model: &RobotModel, names: &[String]) -> Result<Part, MechanismError> {
        if let Some(joint) = names.iter().enumerate().find_map(|(i, name)| names[..i].contains(name).then_some(name)) {
            return Err(MechanismError::Twice { joint: joint.clone() });
        }
        let indices = names.iter().map(|name| model.plannable(name)).collect::<Result<Vec<_>, _>>()?;
        let joints = indices.iter().map(|index| model.joints[*index].clone()).collect();
        let drive =
            |index: &usize| model.links.iter().filter_map(|link| link.drive).find(|drive| drive.joint == *index);
        let slides = indices.iter().map(|index| drive(index).is_some_and(|drive| drive.slides)).collect();
        Ok(Part { indices, joints, slides })
    }

    /// The links that the part's joints move, parents before children.
    fn moved_links(&self, model: &RobotModel) -> Vec<usize> {
        let mut moved = vec![false; model.links.len()];
        for (i, link) in model.links.iter().enumerate() {
            let by_joint = link.drive.is_some_and(|drive| self.indices.contains(&drive.joint));
            moved[i] = by_joint || link.parent.is_some_and(|parent| moved[parent]);
        }
        (0..moved.len()).filter(|i| moved[*i]).collect()
    }

    /// For each joint the link on the chain to the tool that it moves.
    fn links_to(&self, model: &RobotModel, tool: usize) -> Result<Vec<usize>, RobotFault> {
        let way: Vec<usize> = std::iter::successors(Some(tool), |index| model.links[*index].parent).collect();
        let moved = |(index, joint): (&usize, &Joint)| {
            let is_moved = |link: &usize| model.links[*link].drive.is_some_and(|drive| drive.joint == *index);
            let beside = || RobotFault::Beside { joint: joint.name.clone(), tool: model.links[tool].name.clone() };
            way.iter().rposition(is_moved).ok_or_else(beside)
        };
        let moved = self.indices.iter().zip(&self.joints).map(moved).collect::<Result<Vec<usize>, _>>()?;
        if let Some(j) = (1..moved.len()).find(|j| moved[*j] > moved[*j - 1]) {
            let [before, joint] = [j - 1, j].map(|j| self.joints[j].name.clone());
            return Err(RobotFault::Order { joint, before });
        }
        Ok(moved.into_iter().map(|at| way[at]).collect())
    }

    fn posture(&self, name: &str, values: &[f64]) -> Result<JointVector, RobotFault> {
        let wrong = |reason: String| RobotFault::Posture { posture: name.to_owned(), reason };
        if values.len() != self.joints.len() {
            return Err(wrong(format!("has {} positions: the arm has {} joints", values.len(), self.joints.len())));
        }
        let beyond = |(q, joint): &(&f64, &Joint)| !joint.allows(**q, 0.0);
        match values.iter().zip(&self.joints).find(beyond) {
            None => JointVector::read(values).map_err(|error| wrong(error.to_string())),
            Some((q, joint)) => {
                let ([lower, upper], name) = (joint.limits(), &joint.name);
                Err(wrong(format!("has {name} at {q}: its limits are {lower} to {upper}")))
            }
        }
    }
}

/// x, y and yaw of a pose on the floor.
pub fn on_floor(base: &Pose) -> [f64; 3] {
    let heading = base.rotate([1.0, 0.0, 0.0]);
    [base.position[0], base.position[1], heading[1].atan2(heading[0])]
}

/// A pose for parry3d.
pub fn to_f32(pose: &Pose) -> Pose32 {
    let ([x, y, z], [i, j, k, w]) = (pose.position.map(|c| c as f32), pose.quaternion_xyzw.map(|c| c as f32));
    Pose32::from_parts(Vector::new(x, y, z), Rotation::from_xyzw(i, j, k, w))
}
