//! Diagnosis of an invalid start or goal, for people: joints outside their limits, and what touches what, how deep.
//!
//! The exact shapes are checked first. The search uses spheres that hold them and may report contacts that the shapes do not have: in that case
//! the spheres are checked.

use crate::confirmed::{Confirmed, Couples, Met};
use crate::exact::{Exact, Touch};
use crate::geometry::{Body, Geometry};
use crate::mechanism::Mechanism;
use crate::pairs::{self, Pair};
use crate::problems::Problem;
use crate::robot_model::Link;
use crate::space::{ROUNDING_M, Space};
use crate::spheres::Sphere;
use crate::surroundings::Surroundings;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use std::cmp::Reverse;
use std::collections::BTreeMap;

/// Number of parts into which the straight way is cut to see where spheres block it.
const ALONG: u32 = 20;

/// Random postures drawn to find obstructions, and the maximum number of obstructions named.
const DRAWN: usize = 100;
const NAMED: usize = 3;

/// The rules that a posture breaks. Each line begins with `which`, the end of the problem that it is (start or goal).
pub(crate) fn diagnosis(mechanism: &Mechanism, problem: &Problem, positions: &[f64], which: &str) -> Vec<String> {
    let beyond = mechanism.joints.iter().zip(positions).filter(|(j, q)| !j.allows(**q, 0.0));
    let limits = beyond.map(|(joint, position)| {
        let by = (position - joint.clamp(*position)).abs();
        let ([lower, upper], name) = (joint.limits(), &joint.name);
        format!("{which}: {name} is at {position}, outside {lower} to {upper} by {by:.2e}")
    });
    let touches = Exact::new(mechanism, problem.surroundings()).touches(positions);
    let stuck: Vec<[&str; 2]> = match touches.is_empty() {
        true => Vec::new(),
        false => pairs::never_apart(mechanism).into_iter().map(|pair| names(mechanism, pair)).collect(),
    };
    let touch = |touch: &Touch| match stuck.contains(&[&touch.link, &touch.other]) {
        true => format!("{which}: {touch}, {}", no_joint_parts([&touch.link, &touch.other])),
        false => format!("{which}: {touch}"),
    };
    let found: Vec<String> = limits.chain(touches.iter().map(touch)).collect();
    if found.is_empty() { by_spheres(mechanism, problem, positions, which) } else { found }
}

fn names(mechanism: &Mechanism, (a, b): Pair) -> [&str; 2] {
    [&mechanism.links[a].name, &mechanism.links[b].name]
}

/// Advice for two links that collide in every posture of the planned joints.
pub(crate) fn no_joint_parts([a, b]: [&str; 2]) -> String {
    format!(
        "and no planned joint parts the two: put the joints that are not planned for elsewhere, or, if the two are made to touch, say so in the \
         SRDF: {}",
        exception(a, b, "Default")
    )
}

/// The SRDF element that excepts a pair of links from the checks.
pub(crate) fn exception(a: &str, b: &str, reason: &str) -> String {
    format!("<disable_collisions link1=\"{a}\" link2=\"{b}\" reason=\"{reason}\"/>")
}

/// The obstructions found after a search without a path.
#[derive(Debug, Clone, Default)]
pub(crate) struct Blocked {
    /// Messages for people.
    pub(crate) lines: Vec<String>,
    /// Couples whose spheres collide in many postures though the shapes do not.
    pub(crate) doubts: Couples,
}

/// Checks the straight way, and postures drawn from the ranges of all planned joints.
pub(crate) fn blocked(mechanism: &Mechanism, problem: &Problem, ends: [&[f64]; 2]) -> Blocked {
    let exact = Exact::new(mechanism, problem.surroundings());
    let mut lines = Vec::new();
    let straight = exact.touch_along(&ends.map(<[f64]>::to_vec), Space::RESOLUTION.into());
    lines.extend(straight.map(|touch| format!("on the straight way {touch}")));
    let along: Vec<Vec<f64>> = (1..ALONG)
        .map(|i| ends[0].iter().zip(ends[1]).map(|(a, b)| a + (b - a) * f64::from(i) / f64::from(ALONG)).collect())
        .collect();
    let mut doubts = doubts(mechanism, problem, along.iter().map(Vec::as_slice));
    // Per couple: the number of drawn postures in which its shapes collide, and in which only its spheres do.
    let mut met: BTreeMap<Met, [usize; 2]> = BTreeMap::new();
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let coarse = of_spheres(mechanism, ROUNDING_M + overhang_m(problem));
    let coarse = Exact::new(&coarse, problem.surroundings());
    for _ in 0..DRAWN {
        let posture: Vec<f64> = mechanism.joints.iter().map(|joint| pairs::drawn(joint, &mut random)).collect();
        let shapes = Couples::met(&exact, &posture);
        Couples::met(&coarse, &posture).without(&shapes).into_each(&mut |what| met.entry(what).or_default()[1] += 1);
        shapes.into_each(&mut |what| met.entry(what).or_default()[0] += 1);
    }
    // The search does not look at the spheres of these pairs.
    met.retain(|what, [shapes, _]| {
        *shapes > 0 || !matches!(what, Met::Pair(pair) if mechanism.by_shapes.contains(pair))
    });
    let mut often: Vec<(&Met, &[usize; 2])> = met.iter().collect();
    often.sort_by_key(|(_, counts)| Reverse(counts.iter().sum::<usize>()));
    for (what, [_, spheres]) in &often {
        if spheres * 10 > DRAWN {
            doubts.insert((*what).clone());
        }
    }
    let named = often.iter().take(NAMED).map(|(what, [shapes, spheres])| {
        let link = |link: usize| &mechanism.links[link].name[..];
        let (first, second) = match what {
            Met::Pair((a, b)) => (link(*a), link(*b)),
            Met::Beside((a, name)) => (link(*a), &name[..]),
        };
        let by_spheres = match spheres {
            0 => String::new(),
            more => format!(", and by the spheres of the search in {}", shapes + more),
        };
        format!("{first} and {second} in {shapes}{by_spheres}")
    });
    let named: Vec<String> = named.collect();
    if !named.is_empty() {
        lines.push(format!("of {DRAWN} postures drawn, what meets in most: {}", named.join(", ")));
    }
    Blocked { lines, doubts }
}

/// Enlargement of the obstacle meshes in the search, in metres.
pub(crate) fn overhang_m(problem: &Problem) -> f64 {
    problem.meshes.iter().map(|mesh| mesh.overhang_m).fold(0.0, f64::max)
}

/// Couples whose spheres collide in one of these postures though the shapes do not: as they are, and with the enlargement of meshes in the search.
pub(crate) fn doubts<'p>(
    mechanism: &Mechanism,
    problem: &Problem,
    postures: impl IntoIterator<Item = &'p [f64]>,
) -> Couples {
    let surroundings = problem.surroundings();
    let coarse = of_spheres(mechanism, ROUNDING_M + overhang_m(problem));
    let coarse = Exact::new(&coarse, surroundings);
    let mut doubts = Couples::default();
    for posture in postures {
        let met = Couples::met(&coarse, posture);
        doubts.extend(Confirmed::new(mechanism, surroundings, &met, 0.0).apart(&met, posture));
    }
    doubts
}

/// Contacts of the robot's spheres: as they are, and with the enlargement of meshes in the search.
fn by_spheres(mechanism: &Mechanism, problem: &Problem, positions: &[f64], which: &str) -> Vec<String> {
    let touches = [0.0, overhang_m(problem)].into_iter().find_map(|larger_m| {
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

/// A contact that only the search sees, and advice. The first `own` links are those of the URDF.
pub(crate) fn crowding(mechanism: &Mechanism, own: usize, Touch { link, other, depth_m }: &Touch) -> String {
    let index = |name: &str| mechanism.link(name);
    let is_own = |name: &str| index(name).is_some_and(|index| index < own);
    let of_link =
        if index(other).is_some_and(|index| !mechanism.links[index].spheres.is_empty()) { "those of " } else { "" };
    let what = if is_own(link) && is_own(other) {
        format!("if the two never touch, say so in the SRDF: {}", exception(link, other, "Never"))
    } else {
        "leave that much more room".to_owned()
    };
    let mm = depth_m * 1e3;
    format!(
        "the shapes are apart, but the search takes spheres for them: those of {link} are {mm:.1} mm inside {of_link}{other}; {what}"
    )
}

/// Contacts of the spheres that the search uses, each enlarged by `larger_m`, the deepest first.
pub(crate) fn sphere_touches(
    mechanism: &Mechanism,
    surroundings: Surroundings<'_>,
    positions: &[f64],
    larger_m: f64,
) -> Vec<Touch> {
    let coarse = of_spheres(mechanism, ROUNDING_M + larger_m);
    Exact::new(&coarse, surroundings).touches(positions)
}

/// A mechanism whose shapes are the spheres of the search, each enlarged by `larger_m` metres.
pub(crate) fn of_spheres(mechanism: &Mechanism, larger_m: f64) -> Mechanism {
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
