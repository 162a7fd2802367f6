//! Clouds and meshes as the vector kernels want them: balls within the robot's reach.
//!
//! The surface of a mesh is held by balls ([`surface`](crate::surface)). Cells of the grid that the surface does not pass through are solid or
//! free as a whole. In the others a lattice of balls fills what is inside, so narrow that a sphere with its centre between them touches one
//! or the surface.

use crate::cloud::Cloud;
use crate::inside::Inside;
use crate::simd::{self, Isa, Layout};
use crate::surface;
use crate::surroundings::MeshObstacle;

/// The most by which a sphere may grow between two postures and still be judged exactly, in metres.
const GROWTH_M: f64 = 0.03;

/// The narrowest lattice, in metres: a sphere of the robot with a radius below √3/2 of that, and wholly inside a mesh, may be missed.
const LEAST_SPACING_M: f64 = 0.004;

/// A robot's spheres.
#[derive(Debug, Clone)]
pub(crate) struct Reached {
    /// Where they can be: centres and radii of spheres that hold them.
    pub(crate) shells: Vec<([f64; 3], f64)>,
    /// The least and the greatest radius.
    pub(crate) radii: [f64; 2],
}

impl Reached {
    fn reaches(&self, point: &[f64; 3], radius: f64) -> bool {
        self.shells.iter().any(|(anchor, reach)| {
            let away: f64 = (0..3).map(|i| (point[i] - anchor[i]).powi(2)).sum();
            away <= (reach + radius).powi(2)
        })
    }
}

/// The balls of a cloud that the robot reaches; `None` without any.
pub(crate) fn cloud(cloud: &Cloud, robot: &Reached, isa: Isa) -> Option<simd::Cloud> {
    let radius = cloud.radius_m();
    let reached = |p: &&[f32; 3]| robot.reaches(&p.map(f64::from), radius);
    let points: Vec<[f32; 3]> = cloud.points().iter().filter(reached).copied().collect();
    let reach = (robot.radii[1] + radius + GROWTH_M) as f32;
    let layout = over(&points, reach)?;
    Some(simd::Cloud::new(&points, radius as f32, layout, reach, isa))
}

/// A mesh, where the robot reaches it; `None` where it does not.
pub(crate) fn mesh(obstacle: &MeshObstacle, robot: &Reached, isa: Isa) -> Option<simd::Cloud> {
    let radius = surface::radius(&obstacle.mesh, obstacle.overhang_m);
    let in_world = |point: [f64; 3]| obstacle.pose.transform(point);
    let surface: Vec<[f64; 3]> = surface::centres(&obstacle.mesh, radius)
        .into_iter()
        .map(in_world)
        .filter(|p| robot.reaches(p, radius))
        .collect();
    let mut points: Vec<[f32; 3]> = surface.iter().map(|p| p.map(|c| c as f32)).collect();
    let reach = (robot.radii[1] + radius + GROWTH_M) as f32;
    let inside = Inside::new(&obstacle.mesh);
    let layout = match over(&points, reach) {
        Some(layout) => layout,
        // The robot may stand deep inside.
        None if !inside.is_empty()
            && robot.shells.iter().any(|(a, _)| inside.contains(obstacle.pose.inverse().transform(*a))) =>
        {
            let corners: Vec<[f32; 3]> =
                robot.shells.iter().flat_map(|(a, r)| [-1.0, 1.0].map(|s| a.map(|c| (c + s * r) as f32))).collect();
            over(&corners, reach)?
        }
        None => return None,
    };
    let mut crossed = Marks::new(layout);
    for point in &points {
        crossed.mark(point, radius as f32);
    }
    if inside.is_empty() {
        return Some(simd::Cloud::new(&points, radius as f32, layout, reach, isa));
    }
    let wide = crossed.widened();
    let spacing = (robot.radii[0] * 2.0 / 3_f64.sqrt() * 0.99).min(f64::from(layout.cell)).max(LEAST_SPACING_M);
    lattice(&inside, spacing, &mut |point| {
        let at = in_world(point).map(|c| c as f32);
        if wide.is_marked(&at) {
            points.push(at);
        }
    });
    let mut cloud = simd::Cloud::new(&points, radius as f32, layout, reach, isa);
    let to_mesh = obstacle.pose.inverse();
    for part in crossed.free_parts() {
        let centre = layout.centre(part[0]).map(f64::from);
        if inside.contains(to_mesh.transform(centre)) {
            part.into_iter().for_each(|cell| cloud.solidify(cell));
        }
    }
    Some(cloud)
}

fn over(points: &[[f32; 3]], margin: f32) -> Option<Layout> {
    let side = |i: usize, pick: fn(f32, f32) -> f32| points.iter().map(|p| p[i]).reduce(pick);
    let mut least = [0.0; 3];
    let mut greatest = [0.0; 3];
    for i in 0..3 {
        (least[i], greatest[i]) = (side(i, f32::min)?, side(i, f32::max)?);
    }
    Some(Layout::over(points.len(), least, greatest, margin))
}

/// All places of a lattice that are inside.
fn lattice(inside: &Inside, spacing: f64, take: &mut dyn FnMut([f64; 3])) {
    let (least, greatest) = inside.extents();
    let count = |i: usize| ((greatest[i] - least[i]) / spacing) as usize + 1;
    for x in 0..count(0) {
        for y in 0..count(1) {
            let at = [least[0] + (x as f64 + 0.5) * spacing, least[1] + (y as f64 + 0.5) * spacing];
            for [from, to] in inside.column(at[0], at[1]) {
                let first = ((from - least[2]) / spacing - 0.5).ceil().max(0.0) as usize;
                let heights = (first..).map(|z| least[2] + (z as f64 + 0.5) * spacing).take_while(|z| *z <= to);
                heights.for_each(|z| take([at[0], at[1], z]));
            }
        }
    }
}

/// Cells of a grid that are marked.
struct Marks {
    layout: Layout,
    marked: Vec<bool>,
}

impl Marks {
    fn new(layout: Layout) -> Marks {
        Marks { layout, marked: vec![false; layout.cells()] }
    }

    /// Marks the cells that a ball may meet.
    fn mark(&mut self, point: &[f32; 3], radius: f32) {
        let slot = |at: f32, i: usize| self.layout.slot(i, at);
        let from: [usize; 3] = std::array::from_fn(|i| slot(point[i] - radius * 1.01, i));
        let to: [usize; 3] = std::array::from_fn(|i| slot(point[i] + radius * 1.01, i));
        for x in from[0]..=to[0] {
            for y in from[1]..=to[1] {
                for z in from[2]..=to[2] {
                    let index = self.layout.index([x, y, z]);
                    self.marked[index] = true;
                }
            }
        }
    }

    fn is_marked(&self, point: &[f32; 3]) -> bool {
        self.marked[self.layout.index(std::array::from_fn(|i| self.layout.slot(i, point[i])))]
    }

    /// With the cells beside, those at corners too.
    fn widened(&self) -> Marks {
        let mut wide = Marks::new(self.layout);
        let counts = self.layout.counts;
        for index in (0..self.marked.len()).filter(|index| self.marked[*index]) {
            let at = self.layout.slots(index);
            let range = |i: usize| at[i].saturating_sub(1)..=(at[i] + 1).min(counts[i] - 1);
            for x in range(0) {
                for y in range(1) {
                    for z in range(2) {
                        let index = self.layout.index([x, y, z]);
                        wide.marked[index] = true;
                    }
                }
            }
        }
        wide
    }

    /// The cells that are not marked, by parts that hang together by sides.
    fn free_parts(&self) -> Vec<Vec<usize>> {
        let mut seen = self.marked.clone();
        let mut parts = Vec::new();
        for first in 0..seen.len() {
            if std::mem::replace(&mut seen[first], true) {
                continue;
            }
            let mut part = vec![first];
            let mut next = 0;
            while next < part.len() {
                let at = self.layout.slots(part[next]);
                next += 1;
                for axis in 0..3 {
                    for step in [-1_isize, 1] {
                        let Some(slot) = at[axis].checked_add_signed(step).filter(|s| *s < self.layout.counts[axis])
                        else {
                            continue;
                        };
                        let mut beside = at;
                        beside[axis] = slot;
                        let index = self.layout.index(beside);
                        if !std::mem::replace(&mut seen[index], true) {
                            part.push(index);
                        }
                    }
                }
            }
            parts.push(part);
        }
        parts
    }
}
