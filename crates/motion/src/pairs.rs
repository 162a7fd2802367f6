//! Classifies pairs of links by how they collide: as neighbours, in every posture, in the default state, in some postures, or in none of the samples.
//!
//! A robot without an SRDF does not say which of its links are built to touch (the allowed collision matrix). So postures of all its joints are
//! sampled, always the same ones, and checked by the exact shapes. The conclusions are conservative: a pair that was never in collision is still
//! checked, because samples prove nothing; so is a pair that collides in the default state and can separate, because it can collide elsewhere, too.
//! Only two kinds are not checked:
//!
//! - neighbours whose spheres overlap in the default state: they are built to touch at their joint, whose limits prevent more;
//! - pairs that collide in every posture: they cannot be kept apart, and a check would forbid all postures. These are not checked beside an SRDF
//!   either; an SRDF without any exception counts as none.
//!
//! The search uses spheres. If those of a pair overlap so often, although the shapes do not, that the robot could not move, only the exact check of
//! the finished path checks the pair ([`Checks::by_shapes`]). With an SRDF this is so if the spheres overlap in nearly all postures in which the
//! shapes are apart: they would forbid nearly all motions that the SRDF allows. The robots of workers and cells, whose meshes are represented by
//! enclosing spheres, use this rule for links with meshes without an SRDF, too (`RobotModel::read_with_covers`).

use crate::diagnosis;
use crate::exact::Exact;
use crate::mechanism::Mechanism;
use crate::robot_model::{Joint, RobotModel, WIDEST};
use crate::robot_state::RobotState;
use crate::spheres::Sphere;
use crate::vector::Vector;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

/// Two links, the lower index first.
pub type Pair = (usize, usize);

/// Number of postures in which every pair is checked, and number for pairs that collide in all of those.
const SAMPLES: usize = 64;
const MORE_SAMPLES: usize = 1_000;

/// If the spheres of a pair overlap although the shapes do not, in more than this share of the postures, the pair is checked by its shapes only.
const MISTAKEN: f64 = 0.1;

/// With an SRDF: the share of the postures in which the shapes are apart.
const TAKEN: f64 = 0.9;

/// If both limits are infinite, positions are sampled up to this far from zero, in radians or metres.
const ENDLESS: f64 = std::f64::consts::PI;

const SEED: u64 = 1;

/// How two links collide.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// Neighbours whose spheres overlap in the default state.
    Neighbours,
    /// In every posture.
    Always,
    /// In the default state, but not in every posture.
    ByDefault,
    /// In some postures.
    Sometimes,
    /// In none of the samples.
    Never,
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Kind::Neighbours => "neighbours that are made to touch",
            Kind::Always => "always in collision",
            Kind::ByDefault => "in collision in the default state",
            Kind::Sometimes => "in collision in some postures",
            Kind::Never => "never in collision in the postures looked at",
        })
    }
}

/// How a robot's pairs of links are checked for collisions.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Checks {
    /// Pairs that are not checked.
    pub excepted: BTreeSet<Pair>,
    /// Pairs that are checked by their exact shapes, and not by spheres.
    pub by_shapes: BTreeSet<Pair>,
    /// Unchecked pairs that no SRDF excepts: they collide in every posture, or are neighbours that are built to touch.
    pub unsaid: BTreeSet<Pair>,
}

/// What the samples are needed for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Look {
    /// The kind of every pair.
    All,
    /// How to check the pairs.
    Checks,
    /// Whether the spheres are apart in any of the postures in which the shapes are.
    Undecided,
}

/// Number of samples of a pair, and of its collisions.
#[derive(Debug, Clone, Copy, Default)]
struct Tally {
    postures: usize,
    met: usize,
    /// Samples in which the spheres overlap, but not the shapes.
    mistaken: usize,
    met_by_default: bool,
    is_neighbour: bool,
    spheres_met_by_default: bool,
}

impl Tally {
    fn kind(&self) -> Kind {
        match self {
            tally if tally.is_neighbour && tally.spheres_met_by_default => Kind::Neighbours,
            tally if tally.met == tally.postures => Kind::Always,
            tally if tally.met_by_default => Kind::ByDefault,
            tally if tally.met > 0 => Kind::Sometimes,
            _ => Kind::Never,
        }
    }

    /// Whether another posture gives more information.
    fn is_open(&self, look: Look) -> bool {
        match look {
            Look::All => true,
            Look::Checks => self.postures < SAMPLES || self.met == self.postures,
            Look::Undecided => self.postures < SAMPLES || self.met == self.postures || self.is_undecided(),
        }
    }

    /// Whether the spheres overlap in nearly all postures in which the shapes are apart.
    fn is_undecided(&self) -> bool {
        self.mistaken > 0 && self.mistaken as f64 >= TAKEN * (self.postures - self.met) as f64
    }
}

/// The checks of a robot without an SRDF.
pub(crate) fn checks(model: &RobotModel) -> Checks {
    let mut checks = Checks::default();
    for (pair, tally) in tallies(model, Checks::default(), Look::Checks) {
        match tally.kind() {
            Kind::Neighbours | Kind::Always => drop(checks.excepted.insert(pair)),
            _ if tally.mistaken as f64 > MISTAKEN * tally.postures as f64 => drop(checks.by_shapes.insert(pair)),
            _ => {}
        }
    }
    checks.unsaid = checks.excepted.clone();
    checks
}

/// The checks of a robot whose SRDF excepts pairs: all others, except those that collide in every posture.
pub(crate) fn beside_srdf(model: &RobotModel, excepted: BTreeSet<Pair>) -> Checks {
    let mut checks = Checks { excepted, ..Checks::default() };
    for (pair, tally) in tallies(model, checks.clone(), Look::Undecided) {
        if tally.met == tally.postures {
            checks.unsaid.insert(pair);
        } else if tally.is_undecided() {
            checks.by_shapes.insert(pair);
        }
    }
    checks.excepted.extend(&checks.unsaid);
    checks
}

/// The names of at most `most` pairs, and the number of the others.
pub fn named(model: &RobotModel, pairs: &mut dyn Iterator<Item = &Pair>, most: usize) -> String {
    let name = |(a, b): &Pair| format!("{} and {}", model.links[*a].name, model.links[*b].name);
    let mut names: Vec<String> = pairs.map(name).collect();
    let more = names.len().saturating_sub(most);
    names.truncate(most);
    names.join(", ") + &if more > 0 { format!(" and {more} more") } else { String::new() }
}

/// The SRDF line that excepts a pair from the checks.
pub fn exception(model: &RobotModel, (a, b): Pair, reason: &str) -> String {
    diagnosis::exception(&model.links[a].name, &model.links[b].name, reason)
}

/// Checked pairs that collide in every posture of the planned joints: no planned joint separates them, so no posture is free.
pub fn never_apart(mechanism: &Mechanism) -> Vec<Pair> {
    let exact = Exact::new(mechanism, &[]);
    let mut random = ChaCha8Rng::seed_from_u64(SEED);
    let mut pairs = mechanism.pairs();
    for _ in 0..SAMPLES {
        if pairs.is_empty() {
            break;
        }
        let positions: Vec<f64> = mechanism.joints.iter().map(|joint| drawn(joint, &mut random)).collect();
        exact.retain_meeting(&positions, &mut pairs);
    }
    pairs
}

/// The checked pairs whose spheres overlap in nearly all postures in which their shapes are apart.
pub(crate) fn undecided(model: &RobotModel, excepted: &BTreeSet<Pair>) -> BTreeSet<Pair> {
    let checks = Checks { excepted: excepted.clone(), ..Checks::default() };
    let tallies = tallies(model, checks, Look::Undecided).into_iter();
    tallies.filter(|(_, tally)| tally.is_undecided()).map(|(pair, _)| pair).collect()
}

/// All pairs that some joint moves relative to each other, by kind, from a thousand postures.
pub fn kinds(model: &RobotModel) -> BTreeMap<Kind, Vec<Pair>> {
    let mut kinds: BTreeMap<Kind, Vec<Pair>> = BTreeMap::new();
    for (pair, tally) in tallies(model, Checks::default(), Look::All) {
        kinds.entry(tally.kind()).or_default().push(pair);
    }
    kinds
}

fn tallies(model: &RobotModel, checks: Checks, look: Look) -> BTreeMap<Pair, Tally> {
    let all: Vec<usize> = (0..model.joints.len()).collect();
    let neutral = RobotState::neutral(model);
    let mechanism = model.moved_by(&all, neutral.positions(), checks);
    let mut tallies: BTreeMap<Pair, Tally> =
        mechanism.pairs().into_iter().map(|pair| (pair, Tally::default())).collect();
    for (pair, tally) in &mut tallies {
        tally.is_neighbour = mechanism.are_neighbours(pair.0, pair.1);
    }
    let (exact, around) = (Exact::new(&mechanism, &[]), around(&mechanism));
    let mut random = ChaCha8Rng::seed_from_u64(SEED);
    for posture in 0..MORE_SAMPLES {
        let is_default = posture == 0;
        let positions: Vec<f64> = match is_default {
            true => neutral.positions().to_vec(),
            false => model.joints.iter().map(|joint| drawn(joint, &mut random)).collect(),
        };
        let poses = mechanism.poses(&positions);
        let mut is_one_open = false;
        for (&(a, b), tally) in tallies.iter_mut().filter(|(_, tally)| tally.is_open(look)) {
            is_one_open = true;
            let spheres = spheres_meet(&mechanism, &around, &poses, (a, b));
            let met = spheres && exact.do_meet(&poses, a, b);
            tally.postures += 1;
            tally.met += usize::from(met);
            tally.mistaken += usize::from(spheres && !met);
            tally.met_by_default |= is_default && met;
            tally.spheres_met_by_default |= is_default && spheres;
        }
        if !is_one_open {
            break;
        }
    }
    tallies
}

/// A random position of a joint. A limit that is farther away than any robot is long or turns stands for none, as infinity does: some programs
/// write the greatest number that they know.
pub(crate) fn drawn(joint: &Joint, random: &mut impl Rng) -> f64 {
    let (lower, upper) = match (joint.lower.abs() <= WIDEST, joint.upper.abs() <= WIDEST) {
        (true, true) => (joint.lower, joint.upper),
        (true, false) => (joint.lower, joint.lower + 2.0 * ENDLESS),
        (false, true) => (joint.upper - 2.0 * ENDLESS, joint.upper),
        (false, false) => (-ENDLESS, ENDLESS),
    };
    if lower < upper { random.random_range(lower..=upper) } else { lower }
}

/// For each link, a sphere that contains its spheres.
pub(crate) fn around(mechanism: &Mechanism) -> Vec<Sphere> {
    let of = |spheres: &[Sphere]| {
        let count = spheres.len().max(1) as f64;
        let centre: [f64; 3] = std::array::from_fn(|i| spheres.iter().map(|s| s.centre[i]).sum::<f64>() / count);
        let radius = spheres.iter().map(|s| away(s.centre, centre) + s.radius).fold(0.0, f64::max);
        Sphere { centre, radius }
    };
    mechanism.links.iter().map(|link| of(&link.spheres)).collect()
}

pub(crate) fn spheres_meet(mechanism: &Mechanism, around: &[Sphere], poses: &[Pose], (a, b): Pair) -> bool {
    let far = away(poses[a].transform(around[a].centre), poses[b].transform(around[b].centre));
    if far >= around[a].radius + around[b].radius {
        return false;
    }
    let placed = |link: usize| {
        let spheres = mechanism.links[link].spheres.iter();
        spheres.map(|s| Sphere { centre: poses[link].transform(s.centre), ..*s }).collect::<Vec<Sphere>>()
    };
    let (first, second) = (placed(a), placed(b));
    first.iter().any(|s| second.iter().any(|o| away(s.centre, o.centre) < s.radius + o.radius))
}

fn away(a: [f64; 3], b: [f64; 3]) -> f64 {
    Vector::from(a).distance(b.into())
}
