//! Realistic objects for the camera: triangle meshes with the details that real objects have.
//!
//! Nothing here is shared with the models that the detector fits ([`crate::model`]): boxes have bevels, cans have seams and a
//! sunken lid, cups have handles and a tapering wall, bowls and plates stand on a foot and have individual curves, forks have
//! tines and a bent neck. Only the outer dimensions and the frame are the same: the centre of the bounding box, z up; a handle
//! sticks out of the box. Details are derived from a seed, so that no two objects are alike and the same one always looks the
//! same.

mod can;
mod carton;
mod crockery;
mod cutlery;
mod lathe;
mod mesh;
mod mug;

use crate::model::{Model, ObjectClass};
use crate::render::Surface;
use parry3d::shape::SharedShape;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::f64::consts::TAU;

/// What distinguishes an object from others of the same class and dimensions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Individual {
    /// Seed of its details.
    pub seed: u64,
    /// Whether it has a handle; only cups do.
    pub has_handle: bool,
}

/// How far a handle reaches beyond a cup's radius at most, in metres.
pub const HANDLE_M: f64 = 0.034;
/// One in this many cups has no handle.
const TUMBLERS: u64 = 4;

impl Individual {
    /// The individual for this class and these dimensions: always the same one.
    pub fn of(model: &Model) -> Individual {
        let mix = |seed: u64, dimension: &f64| {
            (seed ^ dimension.to_bits()).wrapping_mul(0x9E37_79B9_7F4A_7C15).rotate_left(29)
        };
        let seed = model.dimensions().iter().fold(model.class() as u64, mix);
        let has_handle = model.class() == ObjectClass::Cup && (seed >> 17) % TUMBLERS != 0;
        Individual { seed, has_handle }
    }

    /// The same individual without a handle.
    pub fn without_handle(self) -> Individual {
        Individual { has_handle: false, ..self }
    }
}

/// The object's shape in its frame, and the optical properties of its surface.
pub fn drawn(model: &Model, individual: Individual) -> (SharedShape, Surface) {
    let random = &mut ChaCha8Rng::seed_from_u64(individual.seed);
    let [x, y, z] = model.size();
    let surface = surface(model.class(), random);
    let mesh = match model.class() {
        ObjectClass::Box => carton::bevelled([x, y, z], random),
        ObjectClass::Can => can::tin(x / 2.0, z, random),
        ObjectClass::Cup => mug::mug(x / 2.0, z, individual.has_handle, random),
        ObjectClass::Bowl => crockery::bowl(x / 2.0, z, random),
        ObjectClass::Plate => crockery::plate(x / 2.0, z, random),
        ObjectClass::Fork => cutlery::fork([x, y, z], random),
    };
    (mesh.shape(), surface)
}

/// Cardboard is rough, metal and glaze are glossy; print and labels are dark in places.
fn surface(class: ObjectClass, random: &mut impl Rng) -> Surface {
    let (grain_mm, dark, gloss) = match class {
        ObjectClass::Box => (0.1..0.4, 0.06, 0.0),
        ObjectClass::Can => (0.05..0.2, 0.06, 0.8),
        ObjectClass::Cup | ObjectClass::Bowl | ObjectClass::Plate => (0.05..0.25, 0.03, 0.6),
        ObjectClass::Fork => (0.02..0.1, 0.0, 0.5),
    };
    let grain_m = 1e-3 * random.random_range(grain_mm);
    Surface { grain_m, dark: random.random_range(0.0..=dark), gloss, origin: random.random_range(0.0..TAU) * 100.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn everything_fills_its_bounding_box_but_for_handles() {
        for class in ObjectClass::ALL {
            for part in [0.0, 0.35, 0.7, 1.0] {
                let within =
                    |range: &std::ops::RangeInclusive<f64>| range.start() + part * (range.end() - range.start());
                let dimensions: Vec<f64> = class.ranges().iter().map(within).collect();
                let model = class.model(&dimensions);
                let (shape, _) = drawn(&model, Individual::of(&model).without_handle());
                let bounds = shape.compute_local_aabb();
                for (axis, edge) in model.size().into_iter().enumerate() {
                    let (low, high) = (f64::from(bounds.mins[axis]), f64::from(bounds.maxs[axis]));
                    assert!((low + edge / 2.0).abs() < 6e-4, "{class:?} {axis}: {low} of {edge}");
                    assert!((high - edge / 2.0).abs() < 6e-4, "{class:?} {axis}: {high} of {edge}");
                }
            }
        }
    }

    #[test]
    fn a_handle_sticks_out_on_one_side_and_no_farther_than_it_says() {
        let model = ObjectClass::Cup.model(&[0.04, 0.09]);
        let reach = |has_handle| {
            let (shape, _) = drawn(&model, Individual { seed: 3, has_handle });
            let bounds = shape.compute_local_aabb();
            f64::from(bounds.maxs.x.max(bounds.maxs.y).max(-bounds.mins.x).max(-bounds.mins.y))
        };
        assert!((reach(false) - 0.04).abs() < 5e-4);
        assert!(reach(true) < 0.04 + HANDLE_M);
        let (shape, _) = drawn(&model, Individual { seed: 3, has_handle: true });
        let bounds = shape.compute_local_aabb();
        let widest = f64::from((bounds.maxs.x - bounds.mins.x).max(bounds.maxs.y - bounds.mins.y));
        assert!(widest > 0.08 + 0.012, "{widest}");
    }

    #[test]
    fn the_same_thing_always_looks_the_same_and_another_does_not() {
        let cup = |radius: f64| {
            let model = ObjectClass::Bowl.model(&[radius, 0.05]);
            let (shape, surface) = drawn(&model, Individual::of(&model));
            (shape.as_trimesh().map(|mesh| mesh.vertices().to_vec()), surface)
        };
        assert_eq!(cup(0.07), cup(0.07));
        let (one, other) = (cup(0.07), cup(0.0701));
        assert!(one.1 != other.1);
    }
}
