//! Reading the robot's description: its links, parents first, and the limits of its degrees of freedom.

use crate::geometry::{Body, Geometry};
use crate::mesh::{Mesh, MeshError, Meshed};
use crate::robot::{JOINT_NAMES, Joint, Link, Motion, jerk};
use crate::urdf_faults;
use crate::urdf_faults::UrdfFault;
use ratn_model::pose::Pose;
use std::collections::BTreeMap;
use std::sync::Arc;

/// A URDF that does not describe this kind of robot.
#[derive(Debug, thiserror::Error)]
pub enum RobotError {
    /// Not a URDF, and where.
    #[error("the robot description is not valid URDF: {0}")]
    Fault(#[from] UrdfFault),
    /// Not a URDF for another reason.
    #[error("the robot description is not valid URDF")]
    Urdf(#[from] urdf_rs::UrdfError),
    /// A joint or link that must be there is not.
    #[error("the robot description has no {what} `{name}`")]
    Missing {
        /// Link or joint.
        what: &'static str,
        /// Its name.
        name: String,
    },
    /// A mesh that cannot be used.
    #[error("the mesh `{file}` of link `{link}`: {source}")]
    Mesh {
        /// The link.
        link: String,
        /// As the description names it.
        file: String,
        /// What is wrong.
        #[source]
        source: MeshError,
    },
    /// Something this model does not support.
    #[error("{what} `{name}` of the robot description is not supported: {reason}")]
    Unsupported {
        /// Link or joint.
        what: &'static str,
        /// Its name.
        name: String,
        /// Why not.
        reason: &'static str,
    },
}

/// What a text describes.
///
/// # Errors
/// [`RobotError::Fault`] names the line.
pub(crate) fn parse(text: &str) -> Result<urdf_rs::Robot, RobotError> {
    urdf_faults::check(text)?;
    Ok(urdf_rs::read_from_string(text)?)
}

/// The degrees of freedom and the links of a description.
pub(crate) fn read(text: &str) -> Result<(Vec<Joint>, Vec<Link>), RobotError> {
    let urdf = parse(text)?;
    let mut joints = Vec::new();
    for name in JOINT_NAMES {
        let joint = urdf
            .joints
            .iter()
            .find(|j| j.name == name)
            .ok_or_else(|| RobotError::Missing { what: "joint", name: name.to_owned() })?;
        joints.push(Joint {
            name: name.to_owned(),
            lower: joint.limit.lower,
            upper: joint.limit.upper,
            velocity: joint.limit.velocity,
            acceleration: joint.limit.acceleration,
            jerk: jerk(joint.limit.jerk, joint.limit.acceleration),
        });
    }
    Ok((joints, sorted_links(&urdf)?))
}

fn sorted_links(urdf: &urdf_rs::Robot) -> Result<Vec<Link>, RobotError> {
    let descriptions: BTreeMap<&str, &urdf_rs::Link> = urdf.links.iter().map(|l| (l.name.as_str(), l)).collect();
    let describe = |name: &str| {
        descriptions.get(name).copied().ok_or_else(|| RobotError::Missing { what: "link", name: name.to_owned() })
    };
    let mut links = vec![Link {
        name: "world".to_owned(),
        parent: None,
        origin: Pose::IDENTITY,
        motion: Motion::Fixed,
        bodies: bodies(describe("world")?)?,
    }];
    // Breadth first from the world: parents come before children.
    let mut next = 0;
    while next < links.len() {
        let parent = links[next].name.clone();
        for joint in urdf.joints.iter().filter(|j| j.parent.link == parent) {
            let child = describe(&joint.child.link)?;
            if links.iter().any(|l| l.name == child.name) {
                let reason = "a link has two parents";
                return Err(RobotError::Unsupported { what: "link", name: child.name.clone(), reason });
            }
            links.push(Link {
                name: child.name.clone(),
                parent: Some(next),
                origin: origin(&joint.origin),
                motion: motion(joint)?,
                bodies: bodies(child)?,
            });
        }
        next += 1;
    }
    Ok(links)
}

fn motion(joint: &urdf_rs::Joint) -> Result<Motion, RobotError> {
    let unsupported = |reason| RobotError::Unsupported { what: "joint", name: joint.name.clone(), reason };
    if joint.joint_type == urdf_rs::JointType::Fixed {
        return Ok(Motion::Fixed);
    }
    let driver = match &joint.mimic {
        None => &joint.name,
        Some(mimic) if mimic.multiplier.unwrap_or(1.0) == 1.0 && mimic.offset.unwrap_or(0.0) == 0.0 => &mimic.joint,
        Some(_) => return Err(unsupported("it mimics another joint by a factor or an offset")),
    };
    let index = JOINT_NAMES.iter().position(|name| name == driver);
    let index = index.ok_or_else(|| unsupported("its name is none of the robot's degrees of freedom"))?;
    let length = joint.axis.xyz.0.iter().map(|c| c * c).sum::<f64>().sqrt();
    let axis = joint.axis.xyz.0.map(|c| c / length);
    match joint.joint_type {
        urdf_rs::JointType::Revolute => Ok(Motion::Turn { axis, joint: index }),
        urdf_rs::JointType::Prismatic => Ok(Motion::Slide { axis, joint: index }),
        _ => Err(unsupported("only fixed, revolute and prismatic joints are known")),
    }
}

/// The primitives of a link, of which all its shapes must be.
fn bodies(link: &urdf_rs::Link) -> Result<Vec<Body>, RobotError> {
    let body = |collision: &urdf_rs::Collision| {
        let reason = "collision shapes are primitives, not meshes";
        let unsupported = || RobotError::Unsupported { what: "link", name: link.name.clone(), reason };
        primitive(&collision.geometry).map(|geometry| geometry.at(origin(&collision.origin))).ok_or_else(unsupported)
    };
    link.collision.iter().map(body).collect()
}

/// The primitives and the meshes of a link; `load` gives what is in the file of a name.
pub(crate) fn shapes(link: &urdf_rs::Link, load: &mut Loader<'_>) -> Result<(Vec<Body>, Vec<Meshed>), RobotError> {
    let (mut bodies, mut meshes) = (Vec::new(), Vec::new());
    for collision in &link.collision {
        let pose = origin(&collision.origin);
        if let Some(geometry) = primitive(&collision.geometry) {
            bodies.push(geometry.at(pose));
        } else if let urdf_rs::Geometry::Mesh { filename, scale } = &collision.geometry {
            let failed = |source| RobotError::Mesh { link: link.name.clone(), file: filename.clone(), source };
            let scale = scale.map_or([1.0; 3], |scale| scale.0);
            let mesh = load(filename).and_then(|bytes| Mesh::read(filename, &bytes, scale)).map_err(failed)?;
            meshes.push(Meshed { pose, mesh: Arc::new(mesh) });
        }
    }
    Ok((bodies, meshes))
}

/// What is in a mesh file.
pub(crate) type Loader<'l> = dyn FnMut(&str) -> Result<Vec<u8>, MeshError> + 'l;

fn primitive(geometry: &urdf_rs::Geometry) -> Option<Geometry> {
    Some(match geometry {
        urdf_rs::Geometry::Box { size } => Geometry::Box { half: size.0.map(|s| s / 2.0) },
        urdf_rs::Geometry::Cylinder { radius, length } => {
            Geometry::Cylinder { radius: *radius, half_length: length / 2.0 }
        }
        urdf_rs::Geometry::Capsule { radius, length } => {
            Geometry::Capsule { radius: *radius, half_length: length / 2.0 }
        }
        urdf_rs::Geometry::Sphere { radius } => Geometry::Sphere { radius: *radius },
        urdf_rs::Geometry::Mesh { .. } => return None,
    })
}

pub(crate) fn origin(pose: &urdf_rs::Pose) -> Pose {
    let [roll, pitch, yaw] = pose.rpy.0;
    Pose::from_rpy(pose.xyz.0, roll, pitch, yaw)
}
