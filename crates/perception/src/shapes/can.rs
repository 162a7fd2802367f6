//! A tin can: the seams at the top and the bottom protrude from the body, the lid and the bottom
//! are sunken.

use super::lathe::turned;
use super::mesh::Mesh;
use rand::{Rng, RngExt};

/// A can with this radius at its seams.
pub(super) fn tin(radius: f64, height: f64, random: &mut impl Rng) -> Mesh {
    let (sunken, waist) = (random.random_range(0.002..0.005), radius - random.random_range(0.0008..0.002));
    let (inner, seam) = (radius - 0.003, 0.0035);
    let outline = [
        [0.0, sunken],
        [inner - 0.001, sunken],
        [inner, 0.0005],
        [radius - 0.001, 0.0],
        [radius, 0.001],
        [radius, seam],
        [waist, seam + 0.002],
        [waist, height - seam - 0.002],
        [radius, height - seam],
        [radius, height - 0.001],
        [radius - 0.001, height],
        [inner, height - 0.0005],
        [inner - 0.001, height - sunken],
        [0.0, height - sunken],
    ];
    turned(&outline, height)
}
