//! A picture of a scene for people: every body in its colour, lit from the camera and from above. No sensor uses it.

use crate::camera::Camera;
use crate::picture::Picture;
use crate::render::{Body, FAR, parry_pose, rays_at};
use parry3d::math::Vector;

/// The background.
const SKY: [u8; 3] = [222, 230, 238];
/// Brightness of a face that points away from both lights.
const AMBIENT: f32 = 0.35;
/// Additional brightness of a face that points to the camera, and of one that points up.
const HEADLIGHT: f32 = 0.4;
const LAMP: f32 = 0.25;

/// A picture of bodies, each in its colour.
pub fn photograph(camera: &Camera, scene: &[(Body, [u8; 3])]) -> Picture {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let mut rgb: Vec<u8> = SKY.repeat(width * height);
    let mut nearest = vec![FAR; width * height];
    let eye = parry_pose(&camera.pose);
    let up = eye.rotation.inverse() * Vector::new(0.0, 0.0, 1.0);
    for (body, colour) in scene {
        rays_at(camera, body, |pixel, seen, ray| {
            let Some(hit) = body.shape.cast_ray_and_get_normal(seen, &ray, nearest[pixel], true) else { return };
            if hit.time_of_impact < nearest[pixel] {
                nearest[pixel] = hit.time_of_impact;
                let facing = (hit.normal.dot(ray.dir) / ray.dir.length()).abs();
                let light = AMBIENT + HEADLIGHT * facing + LAMP * hit.normal.dot(up).max(0.0);
                rgb[3 * pixel..3 * pixel + 3].copy_from_slice(&colour.map(|c| (f32::from(c) * light) as u8));
            }
        });
    }
    Picture { width, height, rgb }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Intrinsics;
    use ratn_model::pose::Pose;
    use ratn_world::scene::Shape;

    #[test]
    fn the_nearer_body_is_seen_in_its_colour_and_beside_it_the_sky() {
        let camera = Camera { intrinsics: Intrinsics::DEFAULT, pose: Pose::IDENTITY };
        let at = |z: f64, edge: f64| Body::new(&Shape::Box { size: [edge, edge, 0.2] }, &Pose::at(0.0, 0.0, z));
        let picture = photograph(&camera, &[(at(1.0, 0.2), [200, 0, 0]), (at(2.0, 0.8), [0, 200, 0])]);
        let pixel = |column: usize, row: usize| &picture.rgb[3 * (row * picture.width + column)..][..3];
        let (width, height) = (picture.width, picture.height);
        let (middle, beside) = (pixel(width / 2, height / 2), pixel(width / 2 + width / 6, height / 2));
        assert!(middle[0] > 100 && middle[1] == 0, "{middle:?}");
        assert!(beside[1] > 100 && beside[0] == 0, "{beside:?}");
        assert_eq!(pixel(0, 0), SKY);
    }
}
