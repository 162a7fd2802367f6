//! What is wrong with the start or the goal of a problem, for people: joints beyond their range, and what touches what, how deep.
//!
//! The exact shapes are asked first. The search sees spheres that hold them, so it may find touching what is not: then those spheres are asked.

use crate::exact::{Exact, Touch};
use crate::geometry::{Body, Geometry};
use crate::mechanism::Mechanism;
use crate::problems::Problem;
use crate::robot_model::Link;
use crate::space::ROUNDING_M;
use crate::spheres::Sphere;
use crate::surroundings::Surroundings;
use ratn_model::pose::Pose;

/// What a posture breaks; `which` of the problem's ends it is begins each line.
pub(crate) fn diagnosis(mechanism: &Mechanism, problem: &Problem, positions: &[f64], which: &str) -> Vec<String> {
    let beyond = mechanism.joints.iter().zip(positions).filter(|(j, q)| !j.allows(**q, 0.0));
    let limits = beyond.map(|(joint, position)| {
        let by = (position - joint.clamp(*position)).abs();
        let ([lower, upper], name) = (joint.limits(), &joint.name);
        format!("{which}: {name} is at {position}, outside {lower} to {upper} by {by:.2e}")
    });
    let touches = Exact::new(mechanism, problem.surroundings()).touches(positions);
    let found: Vec<String> = limits.chain(touches.iter().map(|touch| format!("{which}: {touch}"))).collect();
    if found.is_empty() { by_spheres(mechanism, problem, positions, which) } else { found }
}

/// What the spheres of the robot touch; they alone, and with as much as the search takes meshes larger.
fn by_spheres(mechanism: &Mechanism, problem: &Problem, positions: &[f64], which: &str) -> Vec<String> {
    let overhang_m = problem.meshes.iter().map(|mesh| mesh.overhang_m).fold(0.0, f64::max);
    let touches = [0.0, overhang_m].into_iter().find_map(|larger_m| {
        let touches = sphere_touches(mechanism, problem.surroundings(), positions, larger_m);
        (!touches.is_empty()).then_some(touches)
    });
    match touches {
        Some(touches) => touches
            .iter()
            .map(|touch| format!("{which}: {}", crowding(mechanism, mechanism.links.len(), touch)))
            .collect(),
        None => vec![format!("{which}: the shapes are apart by no more than rounding; leave a millimetre of room")],
    }
}

/// What is too near for the search though it does not touch, and what to do; the first `own` links are those of the URDF.
pub(crate) fn crowding(mechanism: &Mechanism, own: usize, Touch { link, other, depth_m }: &Touch) -> String {
    let index = |name: &str| mechanism.link(name);
    let is_own = |name: &str| index(name).is_some_and(|index| index < own);
    let of_link =
        if index(other).is_some_and(|index| !mechanism.links[index].spheres.is_empty()) { "those of " } else { "" };
    let what = if is_own(link) && is_own(other) {
        format!(
            "if the two never touch, say so in the SRDF: <disable_collisions link1=\"{link}\" link2=\"{other}\" reason=\"Never\"/>"
        )
    } else {
        "leave that much more room".to_owned()
    };
    let mm = depth_m * 1e3;
    format!(
        "the shapes are apart, but the search takes spheres for them: those of {link} are {mm:.1} mm inside {of_link}{other}; {what}"
    )
}

/// What the spheres touch that the search takes for a robot, each so much larger, the deepest first.
pub(crate) fn sphere_touches(
    mechanism: &Mechanism,
    surroundings: Surroundings<'_>,
    positions: &[f64],
    larger_m: f64,
) -> Vec<Touch> {
    let coarse = of_spheres(mechanism, ROUNDING_M + larger_m);
    Exact::new(&coarse, surroundings).touches(positions)
}

/// A robot that has its spheres for shapes, each so much larger, in the checks of the search.
fn of_spheres(mechanism: &Mechanism, larger_m: f64) -> Mechanism {
    let body = |Sphere { centre: [x, y, z], radius }: &Sphere| Body {
        pose: Pose::at(*x, *y, *z),
        geometry: Geometry::Sphere { radius: radius + larger_m },
    };
    let link = |link: &Link| Link {
        bodies: link.spheres.iter().map(body).collect(),
        meshes: Vec::new(),
        covers: 0,
        padding_m: 0.0,
        ..link.clone()
    };
    let mut coarse = Mechanism { links: mechanism.links.iter().map(link).collect(), ..mechanism.clone() };
    coarse.excepted.extend(mechanism.by_shapes.iter().copied());
    coarse
}
