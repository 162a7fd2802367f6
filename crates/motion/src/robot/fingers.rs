//! The shapes of a finger in the tool's frame when the fingers are closed: how thick a finger is, and where its pad is.
//!
//! Nothing is assumed about how hand, finger and tool are mounted on each other: the description defines that fingers close along the tool's y
//! axis, and the URDF gives the positions of the shapes. The pad of a mesh is its flat, or nearly flat, part that is nearest to the other finger.

use super::{Geometry, Robot, to_f32};
use crate::mesh::Mesh;
use crate::surface::cut;
use ratn_model::pose::Pose;

/// Tolerance for faces of a box along the tool's axes, as a fraction of a unit vector: rounding.
const ALIGNED: f64 = 1e-6;

/// The pad of a mesh reaches this far behind the point nearest to the other finger, in metres: as far as pads give way.
const PAD_DEEP_M: f64 = 0.002;

/// One shape of a finger, as an axis-aligned cuboid in the tool's frame that holds the shape or, for a mesh, its pad; in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FingerPart {
    /// The centre of the cuboid when the fingers are closed.
    pub middle: [f64; 3],
    /// Half extents.
    pub half: [f64; 3],
    /// Whether it is flat: a box whose faces lie along the tool's axes, so that the cuboid is the shape itself; or the pad of a mesh, as thick as
    /// the mesh is there.
    pub is_flat: bool,
}

impl Robot {
    /// The shapes of the finger that the description names; none for a robot without a gripper.
    pub fn finger_parts(&self) -> Vec<FingerPart> {
        let (Some(finger), Some(joint)) = (self.finger_link(), self.finger.as_ref()) else { return Vec::new() };
        let mut positions = self.neutral.clone();
        positions[joint.indices[0]] = 0.0;
        let (in_root, tool) = self.in_shared_link(finger, &positions);
        let in_tool = tool.inverse().compose(&in_root);
        let link = &self.model.links[finger];
        let primitives = link.own_bodies().iter().map(|body| part(&in_tool.compose(&body.pose), &body.geometry));
        let outward = self.finger_ways().iter().find(|(link, _)| *link == finger).map_or(1.0, |(_, way)| way[1]);
        let meshes = link.meshes.iter().map(|meshed| pad(&in_tool.compose(&meshed.pose), &meshed.mesh, outward));
        primitives.chain(meshes).collect()
    }

    /// The pad of the finger: of its flat parts the one that is nearest to the other finger where both meet. `None` if none is flat, and for a robot
    /// without a gripper.
    pub fn pad(&self) -> Option<FingerPart> {
        nearest(self.finger_parts().into_iter().filter(|part| part.is_flat))
    }

    /// How thick the finger is at its pad, along its closing direction, in metres; 0 for a robot without fingers. Where no part is flat, that of the
    /// part which is nearest to the other finger.
    pub(crate) fn finger_thickness_m(&self) -> f64 {
        let part = self.pad().or_else(|| nearest(self.finger_parts().into_iter()));
        part.map_or(0.0, |part| 2.0 * part.half[1])
    }

    /// Each link that the gripper's joint moves, with its translation in the tool's frame between the joint at zero and at its upper limit; none
    /// for a robot without a gripper.
    pub fn finger_ways(&self) -> Vec<(usize, [f64; 3])> {
        let Some(joint) = self.finger.as_ref() else { return Vec::new() };
        let places = [0.0, joint.joints[0].upper].map(|position| {
            let mut positions = self.neutral.clone();
            positions[joint.indices[0]] = position;
            let poses = self.model.poses(&positions);
            let tool = poses[self.tool].inverse();
            poses.iter().map(|link| tool.compose(link).position).collect::<Vec<_>>()
        });
        let way = |link: usize| std::array::from_fn(|i| places[1][link][i] - places[0][link][i]);
        self.finger_links().into_iter().map(|link| (link, way(link))).collect()
    }

    /// The poses of a link and of the tool in the frame of the last link that carries both. The links before that one are left out: they move both
    /// alike and would only add rounding errors.
    fn in_shared_link(&self, link: usize, positions: &[f64]) -> (Pose, Pose) {
        let links = &self.model.links;
        let above = |link: usize| std::iter::successors(Some(link), |index| links[*index].parent).collect::<Vec<_>>();
        let (of_link, of_tool) = (above(link), above(self.tool));
        let shared = of_link.iter().copied().find(|index| of_tool.contains(index));
        let seen = |way: &[usize]| {
            let way = way.iter().take_while(|index| Some(**index) != shared);
            let way: Vec<usize> = way.copied().collect();
            way.iter().rev().map(|index| links[*index].in_parent(positions)).reduce(|a, b| a.compose(&b))
        };
        (seen(&of_link).unwrap_or(Pose::IDENTITY), seen(&of_tool).unwrap_or(Pose::IDENTITY))
    }
}

/// The part that is nearest to the other finger.
fn nearest(parts: impl Iterator<Item = FingerPart>) -> Option<FingerPart> {
    let inner_m = |part: &FingerPart| part.middle[1].abs() - part.half[1];
    parts.min_by(|a, b| inner_m(a).total_cmp(&inner_m(b)))
}

/// The pad of a mesh of a finger that opens along the tool's y, or in the opposite direction if `outward` is negative.
fn pad(pose: &Pose, mesh: &Mesh, outward: f64) -> FingerPart {
    let sign = if outward < 0.0 { -1.0 } else { 1.0 };
    // Mirrored, if necessary, so that it opens along y.
    let seen = |corner: &[f64; 3]| {
        let [x, y, z] = pose.transform(*corner);
        [x, sign * y, z]
    };
    let triangles: Vec<[[f64; 3]; 3]> = mesh.triangles().iter().map(|triangle| triangle.each_ref().map(seen)).collect();
    let corners: Vec<[f64; 3]> = triangles.iter().flatten().copied().collect();
    let [least, greatest] = bounds(&corners);
    let front: Vec<[f64; 3]> =
        triangles.iter().flat_map(|triangle| cut(triangle, 1, least[1] + PAD_DEEP_M, -1.0)).collect();
    let [mut inner, mut outer] = bounds(&front);
    inner[1] = least[1];
    // The thickness is that behind the middle of the pad.
    let [x, z] = [0, 2].map(|i| (inner[i] + outer[i]) / 2.0);
    let behind = triangles.iter().filter_map(|triangle| at_line(triangle, x, z)).fold(f64::NEG_INFINITY, f64::max);
    outer[1] = if behind > inner[1] { behind } else { greatest[1] };
    let mut middle: [f64; 3] = std::array::from_fn(|i| (inner[i] + outer[i]) / 2.0);
    middle[1] *= sign;
    FingerPart { middle, half: std::array::from_fn(|i| (outer[i] - inner[i]) / 2.0), is_flat: true }
}

fn bounds(corners: &[[f64; 3]]) -> [[f64; 3]; 2] {
    let along = |i: usize| corners.iter().map(move |corner| corner[i]);
    [
        std::array::from_fn(|i| along(i).fold(f64::INFINITY, f64::min)),
        std::array::from_fn(|i| along(i).fold(f64::NEG_INFINITY, f64::max)),
    ]
}

/// The y at which a line along y meets a triangle.
fn at_line(triangle: &[[f64; 3]; 3], x: f64, z: f64) -> Option<f64> {
    let [a, b, c] = triangle;
    let area = |p: &[f64; 3], q: &[f64; 3]| (p[0] - x) * (q[2] - z) - (q[0] - x) * (p[2] - z);
    let shares = [area(b, c), area(c, a), area(a, b)];
    let sum: f64 = shares.iter().sum();
    let is_in = shares.iter().all(|share| *share >= 0.0) || shares.iter().all(|share| *share <= 0.0);
    (is_in && sum != 0.0).then(|| (shares[0] * a[1] + shares[1] * b[1] + shares[2] * c[1]) / sum)
}

fn part(pose: &Pose, geometry: &Geometry) -> FingerPart {
    let Geometry::Box { half } = geometry else {
        let around = geometry.shape(0.0).compute_aabb(&to_f32(pose));
        let numbers = |of: [f32; 3]| of.map(f64::from);
        let (middle, half) = (numbers(around.center().to_array()), numbers(around.half_extents().to_array()));
        return FingerPart { middle, half, is_flat: false };
    };
    let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|axis| pose.rotate(axis));
    let is_flat = axes.iter().flatten().all(|c| c.abs() < ALIGNED || c.abs() > 1.0 - ALIGNED);
    let along = |i: usize| {
        let part = |k: usize| if is_flat { axes[k][i].abs().round() } else { axes[k][i].abs() };
        (0..3).map(|k| part(k) * half[k]).sum()
    };
    FingerPart { middle: pose.position, half: std::array::from_fn(along), is_flat }
}
