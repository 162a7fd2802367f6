//! Depth images by ray casting (parry3d).
//!
//! One ray per pixel through its centre. A body is only tried for the pixels that the projection of its bounding box covers, so the
//! cost is about the area that the bodies cover in the image. Besides the depth, [`scan`] computes what a sensor's noise depends
//! on: how obliquely each pixel sees its surface, and how much of the light that surface swallows ([`Surface`]).

mod grain;

use crate::camera::{Camera, DepthImage, Intrinsics};
use parry3d::math::{Pose, Rotation, Vector};
use parry3d::query::Ray;
use parry3d::shape::SharedShape;
use ratn_world::scene::Shape;

/// A shape in the world, as the camera sees it.
#[derive(Clone)]
pub struct Body {
    /// Its shape.
    pub shape: SharedShape,
    /// Its pose.
    pub pose: Pose,
}

/// Optical properties of a surface for a depth camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Surface {
    /// Roughness: the standard deviation of its relief, in metres.
    pub grain_m: f64,
    /// The part of it that is dark and hardly returns any light, 0 to 1, in patches of about 1 cm.
    pub dark: f64,
    /// The part of the light that is lost where it mirrors the projector straight into the camera, 0 to 1.
    pub gloss: f64,
    /// Offset of its relief and its patches: another number is another piece of the same material.
    pub origin: f64,
}

impl Surface {
    /// Painted, even, without gloss.
    pub const MATT: Surface = Surface { grain_m: 0.0001, dark: 0.0, gloss: 0.0, origin: 0.0 };
}

/// The visible surface, pixel by pixel.
#[derive(Debug, Clone, PartialEq)]
pub struct Rendering {
    /// The true depths.
    pub depth: DepthImage,
    /// The cosine between each pixel's ray and its surface's normal: 1 is seen straight on, 0 edge-on.
    pub facing: Vec<f32>,
    /// The part of a pixel's light that its surface swallows or mirrors away, 0 to 1.
    pub lost: Vec<f32>,
}

/// Cosine of the angle (5°) between normal and ray up to which a surface mirrors the projector, which is beside the camera, into
/// the camera.
const MIRRORED: f32 = 0.9962;
/// The part of the light that a dark patch swallows.
const SWALLOWED: f64 = 0.9;

/// Maximum visible distance, in metres.
pub const FAR: f32 = 8.0;

impl Body {
    /// A shape of the scene. parry's cylinders stand along y, ours along z.
    pub fn new(shape: &Shape, pose: &ratn_model::pose::Pose) -> Body {
        let world = parry_pose(pose);
        match *shape {
            Shape::Box { size } => {
                let [x, y, z] = size.map(|edge| edge as f32 / 2.0);
                Body { shape: SharedShape::cuboid(x, y, z), pose: world }
            }
            Shape::Cylinder { radius, length } => Body {
                shape: SharedShape::cylinder(length as f32 / 2.0, radius as f32),
                pose: world * Pose::from_rotation(Rotation::from_rotation_x(std::f32::consts::FRAC_PI_2)),
            },
        }
    }
}

/// A pose of the project as a parry pose.
pub fn parry_pose(pose: &ratn_model::pose::Pose) -> Pose {
    let [x, y, z] = pose.position.map(|c| c as f32);
    let [i, j, k, w] = pose.quaternion_xyzw.map(|c| c as f32);
    Pose::from_parts(Vector::new(x, y, z), Rotation::from_xyzw(i, j, k, w))
}

/// The depth image of the bodies, without noise.
pub fn render(camera: &Camera, bodies: &[Body]) -> DepthImage {
    let Intrinsics { width, height, .. } = camera.intrinsics;
    let mut depth = vec![FAR; width * height];
    for body in bodies {
        rays_at(camera, body, |pixel, seen, ray| {
            let nearest = &mut depth[pixel];
            if let Some(hit) = body.shape.cast_ray(seen, &ray, *nearest, true)
                && hit < *nearest
            {
                *nearest = hit;
            }
        });
    }
    for d in &mut depth {
        if *d >= FAR {
            *d = 0.0;
        }
    }
    DepthImage { width, height, depth }
}

/// The visible surface of bodies with optical properties, without noise.
pub fn scan(camera: &Camera, bodies: &[(Body, Surface)]) -> Rendering {
    let Intrinsics { width, height, .. } = camera.intrinsics;
    let mut depth = vec![FAR; width * height];
    let (mut facing, mut lost) = (vec![0.0; width * height], vec![0.0; width * height]);
    for (body, surface) in bodies {
        rays_at(camera, body, |pixel, seen, ray| {
            let Some(hit) = body.shape.cast_ray_and_get_normal(seen, &ray, depth[pixel], true) else { return };
            if hit.time_of_impact >= depth[pixel] {
                return;
            }
            let at = seen.inverse_transform_point(ray.dir * hit.time_of_impact);
            let local = [at.x, at.y, at.z].map(f64::from);
            let straight = (hit.normal.dot(ray.dir) / ray.dir.length()).abs();
            depth[pixel] = hit.time_of_impact + grain::relief(surface, local) as f32;
            facing[pixel] = straight;
            let mirrored = if straight > MIRRORED { surface.gloss } else { 0.0 };
            let swallowed = if grain::is_dark(surface, local) { SWALLOWED } else { 0.0 };
            lost[pixel] = mirrored.max(swallowed) as f32;
        });
    }
    for d in &mut depth {
        if *d >= FAR {
            *d = 0.0;
        }
    }
    Rendering { depth: DepthImage { width, height, depth }, facing, lost }
}

/// Calls `show` for every pixel that a body may cover, with the body's pose and the pixel's ray in the camera's frame. The ray's
/// direction has z = 1, so a time of impact is a depth.
pub(crate) fn rays_at(camera: &Camera, body: &Body, mut show: impl FnMut(usize, &Pose, Ray)) {
    let seen = parry_pose(&camera.pose).inverse() * body.pose;
    let Some(Window { columns, rows }) = window(&camera.intrinsics, body, &seen) else { return };
    for row in rows {
        for column in columns.clone() {
            let [x, y, _] = camera.intrinsics.ray(column, row);
            let ray = Ray::new(Vector::ZERO, Vector::new(x as f32, y as f32, 1.0));
            show(row * camera.intrinsics.width + column, &seen, ray);
        }
    }
}

struct Window {
    columns: std::ops::Range<usize>,
    rows: std::ops::Range<usize>,
}

/// The pixels that a body can cover: all of them when it reaches behind the camera.
fn window(camera: &Intrinsics, body: &Body, seen: &Pose) -> Option<Window> {
    let bounds = body.shape.compute_local_aabb();
    let corners = (0..8).map(|corner: u32| {
        let pick = |bit: u32, low: f32, high: f32| if corner & bit == 0 { low } else { high };
        seen.transform_point(Vector::new(
            pick(1, bounds.mins.x, bounds.maxs.x),
            pick(2, bounds.mins.y, bounds.maxs.y),
            pick(4, bounds.mins.z, bounds.maxs.z),
        ))
    });
    let (mut low, mut high, mut behind) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2], 0);
    for corner in corners {
        match camera.project([f64::from(corner.x), f64::from(corner.y), f64::from(corner.z)]) {
            Some(pixel) => {
                for axis in 0..2 {
                    low[axis] = low[axis].min(pixel[axis]);
                    high[axis] = high[axis].max(pixel[axis]);
                }
            }
            None => behind += 1,
        }
    }
    match behind {
        8 => None,
        0 => {
            let range = |axis: usize, size: usize| {
                let start = (low[axis].floor().max(0.0) as usize).min(size);
                start..((high[axis].ceil() + 1.0).max(0.0) as usize).min(size)
            };
            let window = Window { columns: range(0, camera.width), rows: range(1, camera.height) };
            (!window.columns.is_empty() && !window.rows.is_empty()).then_some(window)
        }
        _ => Some(Window { columns: 0..camera.width, rows: 0..camera.height }),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_model::pose::Pose as ModelPose;

    fn looking_forward() -> Camera {
        Camera { intrinsics: Intrinsics::DEFAULT, pose: ModelPose::IDENTITY }
    }

    #[test]
    fn the_depth_of_a_wall_is_its_distance_along_the_axis_in_every_pixel() {
        let wall = Body::new(&Shape::Box { size: [6.0, 6.0, 0.2] }, &ModelPose::at(0.0, 0.0, 2.1));
        let image = render(&looking_forward(), &[wall]);
        assert!(image.depth.iter().all(|d| (d - 2.0).abs() < 1e-4));
    }

    #[test]
    fn the_nearer_body_hides_the_farther_and_empty_pixels_are_zero() {
        let far = Body::new(&Shape::Box { size: [1.0, 1.0, 0.2] }, &ModelPose::at(0.0, 0.0, 2.1));
        let near = Body::new(&Shape::Cylinder { radius: 0.1, length: 0.4 }, &ModelPose::at(0.0, 0.0, 1.2));
        for bodies in [[far.clone(), near.clone()], [near, far]] {
            let image = render(&looking_forward(), &bodies);
            assert!((image.at(160, 120).unwrap() - 1.0).abs() < 1e-3);
            assert!((image.at(160, 160).unwrap() - 2.0).abs() < 1e-3);
            assert_eq!(image.at(0, 0), None);
        }
    }

    #[test]
    fn a_scan_knows_how_obliquely_a_pixel_sees_and_what_mirrors_or_is_dark() {
        let wall = Body::new(&Shape::Box { size: [6.0, 6.0, 0.2] }, &ModelPose::at(0.0, 0.0, 2.1));
        let scan = |surface| scan(&looking_forward(), &[(wall.clone(), surface)]);
        let shining = scan(Surface { gloss: 0.7, ..Surface::MATT });
        assert!(shining.depth.depth.iter().all(|d| (d - 2.0).abs() < 1e-3));
        // The middle is seen straight on, a corner at 31°.
        assert!(shining.facing[120 * 320 + 160] > 0.999 && (shining.facing[0] - 0.856).abs() < 0.01);
        assert!((shining.lost[120 * 320 + 160] - 0.7).abs() < 1e-6 && shining.lost[0] == 0.0);
        let patchy = scan(Surface { dark: 0.2, ..Surface::MATT });
        let dark = patchy.lost.iter().filter(|lost| **lost > 0.5).count() as f64 / patchy.lost.len() as f64;
        assert!((0.15..0.25).contains(&dark), "{dark}");
    }

    #[test]
    fn a_body_that_reaches_behind_the_camera_is_seen() {
        let floor = Body::new(&Shape::Box { size: [4.0, 0.2, 20.0] }, &ModelPose::at(0.0, 1.1, 0.0));
        let image = render(&looking_forward(), &[floor]);
        let ray = Intrinsics::DEFAULT.ray(160, 239);
        assert!((image.at(160, 239).unwrap() - 1.0 / ray[1]).abs() < 1e-3);
    }
}
