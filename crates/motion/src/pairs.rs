//! Pairs of links told apart by how they meet: as neighbours, in every posture, in the default state, now and then, or never as far as seen.
//!
//! A robot without an SRDF says nothing of the links that it is made to have in touch. So postures are drawn from all of its joints, always the
//! same, and looked at by the exact shapes. What follows from that is careful: a pair that was not seen to meet stays checked, because samples
//! prove nothing; so does one that meets in the default state and can part, because it can meet elsewhere, too. Only two kinds are not checked:
//!
//! - neighbours whose spheres meet in the default state: they are made to touch at the joint between them, and its limits keep them from more;
//! - pairs that meet in every posture: nothing is there to be kept apart, and a check would forbid all postures. These are not checked beside an SRDF
//!   either; one that excepts no pair at all is taken for none.
//!
//! The search sees spheres. Where they meet so often though the shapes do not that it could not move, the exact check of the finished path alone
//! sees the pair ([`Checks::by_shapes`]). With an SRDF that is so where the spheres leave hardly a posture of those in which the shapes are apart:
//! they would forbid nearly all that the SRDF leaves to be planned. The robots of workers and cells, which know meshes by spheres that hold them,
//! take that for links with meshes without an SRDF, too (`RobotModel::read_with_covers`).

use crate::diagnosis;
use crate::exact::Exact;
use crate::mechanism::Mechanism;
use crate::robot_model::{Joint, RobotModel};
use crate::robot_state::RobotState;
use crate::spheres::Sphere;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

/// Two links, the lower index first.
pub type Pair = (usize, usize);

/// Postures that every pair is looked at in, and those that have met in all of them.
const SAMPLES: usize = 64;
const MORE_SAMPLES: usize = 1_000;

/// Spheres that meet in this part of the postures though the shapes do not say nothing of a pair.
const MISTAKEN: f64 = 0.1;

/// With an SRDF: in this part of the postures in which the shapes are apart.
const TAKEN: f64 = 0.9;

/// Where both limits are infinite, positions are drawn from this far on both sides of zero, in radians or metres.
const ENDLESS: f64 = std::f64::consts::PI;

const SEED: u64 = 1;

/// How two links meet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// Neighbours whose spheres meet in the default state.
    Neighbours,
    /// In every posture.
    Always,
    /// In the default state, and not always.
    ByDefault,
    /// In some postures.
    Sometimes,
    /// In none that was looked at.
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

/// What is checked of a robot's pairs of links.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Checks {
    /// Not checked at all.
    pub excepted: BTreeSet<Pair>,
    /// Checked by the exact shapes, and not by spheres.
    pub by_shapes: BTreeSet<Pair>,
    /// Of those that are not checked, those of which no SRDF says so: they meet in every posture, or are neighbours that are made to touch.
    pub unsaid: BTreeSet<Pair>,
}

/// What postures are looked at for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Look {
    /// The kind of every pair.
    All,
    /// What to check.
    Checks,
    /// Whether spheres leave anything of the postures in which the shapes are apart.
    Undecided,
}

/// How often two links were seen, and seen to meet.
#[derive(Debug, Clone, Copy, Default)]
struct Tally {
    postures: usize,
    met: usize,
    /// By their spheres and not by their shapes.
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

    /// Whether one more posture tells something.
    fn is_open(&self, look: Look) -> bool {
        match look {
            Look::All => true,
            Look::Checks => self.postures < SAMPLES || self.met == self.postures,
            Look::Undecided => self.postures < SAMPLES || self.met == self.postures || self.is_undecided(),
        }
    }

    /// Whether the spheres meet in nearly all postures in which the shapes are apart.
    fn is_undecided(&self) -> bool {
        self.mistaken > 0 && self.mistaken as f64 >= TAKEN * (self.postures - self.met) as f64
    }
}

/// What to check of a robot whose SRDF says nothing.
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

/// What to check where an SRDF excepts pairs: all others, but for those that meet in every posture.
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

/// The names of pairs, at the most so many of them.
pub fn named(model: &RobotModel, pairs: &mut dyn Iterator<Item = &Pair>, most: usize) -> String {
    let name = |(a, b): &Pair| format!("{} and {}", model.links[*a].name, model.links[*b].name);
    let mut names: Vec<String> = pairs.map(name).collect();
    let more = names.len().saturating_sub(most);
    names.truncate(most);
    names.join(", ") + &if more > 0 { format!(" and {more} more") } else { String::new() }
}

/// What an SRDF says of a pair that is not to be checked.
pub fn exception(model: &RobotModel, (a, b): Pair, reason: &str) -> String {
    diagnosis::exception(&model.links[a].name, &model.links[b].name, reason)
}

/// Pairs that are checked and meet in every posture of what is planned for: no planned joint parts them, so no posture is free.
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

/// Of the pairs that are checked, those whose spheres meet in nearly all postures in which their shapes are apart.
pub(crate) fn undecided(model: &RobotModel, excepted: &BTreeSet<Pair>) -> BTreeSet<Pair> {
    let checks = Checks { excepted: excepted.clone(), ..Checks::default() };
    let tallies = tallies(model, checks, Look::Undecided).into_iter();
    tallies.filter(|(_, tally)| tally.is_undecided()).map(|(pair, _)| pair).collect()
}

/// All pairs that some joint moves against each other, by kind, from a thousand postures.
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

pub(crate) fn drawn(joint: &Joint, random: &mut impl Rng) -> f64 {
    let (lower, upper) = match (joint.lower.is_finite(), joint.upper.is_finite()) {
        (true, true) => (joint.lower, joint.upper),
        (true, false) => (joint.lower, joint.lower + 2.0 * ENDLESS),
        (false, true) => (joint.upper - 2.0 * ENDLESS, joint.upper),
        (false, false) => (-ENDLESS, ENDLESS),
    };
    if lower < upper { random.random_range(lower..=upper) } else { lower }
}

/// Of each link, a sphere that holds its spheres.
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
    (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt()
}
