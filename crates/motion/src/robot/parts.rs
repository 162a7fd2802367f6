//! Checks the joints of a description's parts: a finger is prismatic, a head revolute, a base moves along x, along y and about z.
//!
//! A joint of another kind would move all the same, and everything computed for the part would be wrong. So it is refused, with its name.

use super::{Part, Robot, RobotFault, RobotModel};
use crate::description::{BaseDescription, DriveArea, GripperDescription, HeadDescription, RobotDescription};
use crate::robot_model::{Drive, Joint, poses};
use ratn_model::pose::Pose;
use std::f64::consts::TAU;

/// Tolerance for an axis or a position, in metres and as a part of a unit vector: rounding.
const ROUNDED: f64 = 1e-6;
/// The base pose at which its joints are tested: x, y and heading.
const ELSEWHERE: [f64; 3] = [1.0, 2.0, 0.5];

/// Minimum and maximum x and y, and heading if it is limited.
type DriveLimits = ([[f64; 2]; 2], Option<[f64; 2]>);

impl RobotDescription {
    /// Checks that no joint belongs to two parts.
    pub(super) fn check_shared(&self) -> Result<(), RobotFault> {
        let gripper = |gripper: &Option<GripperDescription>| gripper.iter().map(|g| g.joint.clone()).collect();
        let mut parts: Vec<(String, Vec<String>)> = Vec::new();
        for arm in std::iter::once(&self.arm).chain(&self.other_arms) {
            parts.push((format!("the arm `{}`", arm.name), arm.joints.clone()));
            parts.push((format!("the gripper of `{}`", arm.name), gripper(&arm.gripper)));
        }
        parts.push(("[gripper]".to_owned(), gripper(&self.gripper)));
        parts.push(("[base]".to_owned(), self.base.iter().flat_map(|base| base.joints.clone()).collect()));
        parts.push(("[head]".to_owned(), self.head.iter().flat_map(|head| head.joints.clone()).collect()));
        for (i, (second, joints)) in parts.iter().enumerate() {
            for (first, others) in &parts[..i] {
                if let Some(joint) = joints.iter().find(|joint| others.contains(joint)) {
                    let (first, second) = (first.clone(), second.clone());
                    return Err(RobotFault::JointOfTwo { joint: joint.clone(), first, second });
                }
            }
        }
        Ok(())
    }
}

impl Part {
    /// The prismatic joint of a finger.
    pub(super) fn gripper(model: &RobotModel, gripper: &GripperDescription) -> Result<Part, RobotFault> {
        let part = Part::of(model, std::slice::from_ref(&gripper.joint))?;
        let turning = part.drives(model, 0).find(|drive| !drive.slides);
        refuse("gripper.joint", &part.joints[0], turning, "a joint that slides a finger, as do those that mimic it")?;
        let moved = part.moved_links(model);
        if model.link(&gripper.finger).is_some_and(|finger| !moved.contains(&finger)) {
            return Err(RobotFault::Finger { joint: gripper.joint.clone(), finger: gripper.finger.clone() });
        }
        Ok(part)
    }

    /// The joints of pan and tilt.
    pub(super) fn head(model: &RobotModel, head: &HeadDescription) -> Result<Part, RobotFault> {
        let part = Part::of(model, &head.joints)?;
        for (j, joint) in part.joints.iter().enumerate() {
            refuse("head.joints", joint, part.drives(model, j).find(|drive| drive.slides), "a joint that turns")?;
        }
        Ok(part)
    }

    /// The joints of x, y and heading, with x and y limited to the area in which it may drive.
    pub(super) fn base(model: &RobotModel, base: &BaseDescription) -> Result<Part, RobotFault> {
        let mut part = Part::of(model, &base.joints)?;
        let expected = [
            (true, [1.0, 0.0, 0.0], "for x a joint that slides along (1, 0, 0)"),
            (true, [0.0, 1.0, 0.0], "for y a joint that slides along (0, 1, 0)"),
            (false, [0.0, 0.0, 1.0], "for the heading a joint that turns about (0, 0, 1)"),
        ];
        for (j, (slides, axis, expected)) in expected.into_iter().enumerate() {
            let other = |drive: &Drive| {
                drive.slides != slides || (0..3).any(|i| (drive.factor * drive.axis[i] - axis[i]).abs() > ROUNDED)
            };
            refuse("base.joints", &part.joints[j], part.drives(model, j).find(other), expected)?;
        }
        part.check_at_root(model)?;
        if let Some(DriveArea { x, y }) = base.area {
            for (joint, [low, high]) in part.joints.iter_mut().zip([x, y]) {
                let (lower, upper) = (joint.lower.max(low), joint.upper.min(high));
                if lower >= upper || low.is_nan() || high.is_nan() {
                    let limits = [joint.lower, joint.upper];
                    return Err(RobotFault::Area { joint: joint.name.clone(), area: [low, high], limits });
                }
                (joint.lower, joint.upper) = (lower, upper);
            }
        }
        Ok(part)
    }

    /// Checks that the pose of the last link is the one that the base's joints give.
    fn check_at_root(&self, model: &RobotModel) -> Result<(), RobotFault> {
        let mut positions = vec![0.0; model.joints.len()];
        for (index, position) in self.indices.iter().zip(ELSEWHERE) {
            positions[*index] = position;
        }
        let [x, y, heading] = ELSEWHERE;
        let expected = Pose::from_rpy([x, y, 0.0], 0.0, 0.0, heading);
        let turned = model.links.iter().position(|link| link.drive.is_some_and(|drive| drive.joint == self.indices[2]));
        let Some(link) = turned else { return Ok(()) };
        let there = poses(&model.links, &positions)[link];
        let off = expected.inverse().compose(&there);
        let turned = (1.0 - off.quaternion_xyzw[3].abs()).abs();
        if off.distance(&Pose::IDENTITY) > ROUNDED || turned > ROUNDED {
            return Err(RobotFault::BaseOff { link: model.links[link].name.clone(), at: there.position });
        }
        Ok(())
    }

    /// The drives of links by one of its joints, including those that mimic it.
    fn drives<'m>(&self, model: &'m RobotModel, joint: usize) -> impl Iterator<Item = Drive> + 'm {
        let index = self.indices[joint];
        model.links.iter().filter_map(|link| link.drive).filter(move |drive| drive.joint == index)
    }
}

impl Robot {
    /// Where the base may drive: minimum and maximum x, y and heading, in metres and radians. The heading is `None` if its limits are a whole turn apart.
    pub fn drive_area(&self) -> Option<DriveLimits> {
        let [x, y, heading] = self.base_joints() else { return None };
        let limits = |joint: &Joint| [joint.lower, joint.upper];
        let turns = heading.upper - heading.lower >= TAU;
        Some(([limits(x), limits(y)], (!turns).then(|| limits(heading))))
    }
}

/// Refuses a joint with this drive, if there is one.
fn refuse(key: &'static str, joint: &Joint, drive: Option<Drive>, expected: &'static str) -> Result<(), RobotFault> {
    let Some(Drive { axis, slides, factor, .. }) = drive else { return Ok(()) };
    let [x, y, z] = axis.map(|c| factor * c);
    let does = if slides { format!("slides along ({x}, {y}, {z})") } else { format!("turns about ({x}, {y}, {z})") };
    Err(RobotFault::Kind { key, joint: joint.name.clone(), does, expected })
}
