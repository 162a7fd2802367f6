//! What is wrong with the start or the goal of a problem, for people: joints beyond their range, and what touches what, how deep.
//!
//! The exact shapes are asked first. The search sees spheres that hold them, so it may find touching what is not: then those spheres are asked.

use crate::exact::{Exact, Touch};
use crate::geometry::{Body, Geometry};
use crate::mechanism::Mechanism;
use crate::problems::Problem;
use crate::robot_model::{Joint, Link};
use crate::space::ROUNDING_M;
use crate::spheres::Sphere;
use ratn_model::pose::Pose;

/// What a posture breaks; `which` of the problem's ends it is begins each line.
pub(crate) fn diagnosis(mechanism: &Mechanism, problem: &Problem, positions: &[f64], which: &str) -> Vec<String> {
    let beyond = mechanism.joints.iter().zip(positions).filter(|(j, q)| !(j.lower..=j.upper).contains(*q));
    let limits = beyond.map(|(joint, position)| {
        let by = (position - position.clamp(joint.lower, joint.upper)).abs();
        let Joint { name, lower, upper, .. } = joint;
        format!("{which}: {name} is at {position}, outside {lower} to {upper} by {by:.2e}")
    });
    let touches = Exact::new(mechanism, problem.surroundings()).touches(positions);
    let found: Vec<String> = limits.chain(touches.iter().map(|touch| format!("{which}: {touch}"))).collect();
    if found.is_empty() { by_spheres(mechanism, problem, positions, which) } else { found }
}

/// What the spheres of the robot touch; they alone, and with as much as the search takes meshes larger.
fn by_spheres(mechanism: &Mechanism, problem: &Problem, positions: &[f64], which: &str) -> Vec<String> {
    let overhang_m = problem.meshes.iter().map(|mesh| mesh.overhang_m).fold(0.0, f64::max);
    let touches = [ROUNDING_M, ROUNDING_M + overhang_m].into_iter().find_map(|larger_m| {
        let coarse = of_spheres(mechanism, larger_m);
        let touches = Exact::new(&coarse, problem.surroundings()).touches(positions);
        (!touches.is_empty()).then_some(touches)
    });
    let line = |Touch { link, other, depth_m }: &Touch| {
        let of_link = if mechanism.link(other).is_some() { "those of " } else { "" };
        format!(
            "{which}: the shapes are apart, but the search takes spheres for them: those of {link} are {:.1} mm inside {of_link}{other}; leave \
             that much more room",
            depth_m * 1e3
        )
    };
    match touches {
        Some(touches) => touches.iter().map(line).collect(),
        None => vec![format!("{which}: the shapes are apart by no more than rounding; leave a millimetre of room")],
    }
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
