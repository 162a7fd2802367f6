//! The identity of a robot: its name, and a digest of everything that moves, collides, reaches and grasps.

use super::{Geometry, Part, Robot};
use ratn_model::pose::Pose;
use ratn_world::digest::Digester;
use serde::{Deserialize, Serialize};
use std::fmt;

/// Number of characters of a digest in messages.
const SHOWN: usize = 12;

/// The robot to which a snapshot or a recording of a cell belongs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotIdentity {
    /// The robot's name in its description.
    pub name: String,
    /// A digest of links, shapes, joints with their limits, of which joints belong to arms, grippers, base and head, and of the names and tools of
    /// the arms and the hands and fingers of the grippers.
    pub digest: String,
}

impl fmt::Display for RobotIdentity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let shown: String = self.digest.chars().take(SHOWN).collect();
        write!(f, "`{}` (digest {shown})", self.name)
    }
}

impl Robot {
    /// The identity of this robot. The same description with the same URDF gives the same identity on every machine.
    pub fn identity(&self) -> RobotIdentity {
        let mut digester = Digester::default();
        let number = |digester: &mut Digester, x: f64| digester.number(x.to_bits());
        let count = |digester: &mut Digester, n: usize| digester.number(n as u64);
        count(&mut digester, self.model.joints.len());
        for joint in &self.model.joints {
            digester.text(&joint.name);
            let [lower, upper] =
                if joint.endless { [f64::NEG_INFINITY, f64::INFINITY] } else { [joint.lower, joint.upper] };
            let limits = [lower, upper, joint.velocity, joint.acceleration, joint.jerk];
            limits.into_iter().for_each(|limit| number(&mut digester, limit));
        }
        count(&mut digester, self.model.links.len());
        for link in &self.model.links {
            digester.text(&link.name);
            // A missing value has its own number.
            count(&mut digester, link.parent.unwrap_or(usize::MAX));
            numbers_of(&link.origin).for_each(|x| number(&mut digester, x));
            match link.drive {
                None => count(&mut digester, usize::MAX),
                Some(drive) => {
                    count(&mut digester, drive.joint);
                    drive.axis.into_iter().chain([drive.factor]).for_each(|x| number(&mut digester, x));
                    digester.number(u64::from(drive.slides));
                }
            }
            count(&mut digester, link.bodies.len());
            for body in &link.bodies {
                numbers_of(&body.pose).for_each(|x| number(&mut digester, x));
                let (kind, sizes) = match body.geometry {
                    Geometry::Box { half } => (0, half),
                    Geometry::Cylinder { radius, half_length } => (1, [radius, half_length, 0.0]),
                    Geometry::Capsule { radius, half_length } => (2, [radius, half_length, 0.0]),
                    Geometry::Sphere { radius } => (3, [radius, 0.0, 0.0]),
                };
                digester.number(kind);
                sizes.into_iter().for_each(|x| number(&mut digester, x));
            }
            count(&mut digester, link.meshes.len());
            for meshed in &link.meshes {
                numbers_of(&meshed.pose).for_each(|x| number(&mut digester, x));
                let corners = meshed.mesh.triangles().iter().flatten().flatten();
                corners.for_each(|x| number(&mut digester, *x));
            }
        }
        for pairs in [&self.model.checks.excepted, &self.model.checks.by_shapes] {
            count(&mut digester, pairs.len());
            pairs.iter().flat_map(|(a, b)| [*a, *b]).for_each(|link| count(&mut digester, link));
        }
        count(&mut digester, self.tool);
        count(&mut digester, self.camera.unwrap_or(usize::MAX));
        let parts = [Some(&self.arm), self.base.as_ref(), self.head.as_ref(), self.finger.as_ref()];
        let of_others = self.other_arms.iter().flat_map(|arm| arm.parts());
        for part in parts.into_iter().chain(of_others) {
            let indices: &[usize] = part.map_or(&[], |part: &Part| &part.indices);
            count(&mut digester, indices.len());
            indices.iter().for_each(|index| count(&mut digester, *index));
        }
        // The tool frames, and the link of each gripper that is the finger with its pads.
        for arm in std::iter::once(&self.description.arm).chain(&self.description.other_arms) {
            digester.text(&arm.name);
            digester.text(&arm.tool);
        }
        let grippers = std::iter::once(&self.description.gripper);
        for gripper in grippers.chain(self.description.other_arms.iter().map(|arm| &arm.gripper)) {
            digester.number(u64::from(gripper.is_some()));
            for text in gripper.iter().flat_map(|gripper| [&gripper.joint, &gripper.hand, &gripper.finger]) {
                digester.text(text);
            }
        }
        RobotIdentity { name: self.name().to_owned(), digest: digester.finish().to_string() }
    }
}

fn numbers_of(pose: &Pose) -> impl Iterator<Item = f64> {
    pose.position.into_iter().chain(pose.quaternion_xyzw)
}
