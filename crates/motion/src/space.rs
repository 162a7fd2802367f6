//! A robot among obstacles, compiled for the vector kernels: which postures and straight motions are free of collisions.
//!
//! There are two ways to check a motion. [`Space::is_free_motion`] checks [`Space::RESOLUTION`] postures per radian, as the search does.
//! [`Space::is_swept_free`] is a continuous check: each sphere is enlarged by how far it can move until the next posture, and stretches where that
//! is too much are divided, down to postures so close that what is between is noise. Finer stretches are checked only against what the coarser
//! ones were near to. The enlargement is half of the sphere's step to the next posture, and what the curvature of its way allows in addition.

use crate::branches;
use crate::cloud::Cloud;
use crate::confirmed::Confirmed;
use crate::geometry::Geometry;
use crate::mechanism::{MAX_JOINTS, Mechanism};
use crate::occupied::{self, Reached};
pub use crate::simd::Isa;
use crate::simd::{self, Among, Block, Compiled, Edge, Frame, Group, Rigid, Row, Scratch, SelfPair, Spans};
use crate::surroundings::Surroundings;
use ratn_model::pose::Pose;
use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Positions in the order of the joints; unused ones are zero.
pub type State = [f32; MAX_JOINTS];

/// A posture for the vector checks.
pub fn state(positions: &[f64]) -> State {
    let mut state = [0.0; MAX_JOINTS];
    for (to, from) in state.iter_mut().zip(positions) {
        *to = *from as f32;
    }
    state
}

/// Enlargement of the spheres that covers the rounding of `f32`, in metres.
pub(crate) const ROUNDING_M: f64 = 2e-5;

/// Enlargement of bounding spheres, in metres: what a sphere touches in single precision, its bounding sphere touches, too.
const COARSE_ROUNDING_M: f32 = 1e-5;

/// Refinement from one level of a swept check to the next, and the number of levels. The second level is as fine as the postures of
/// [`Space::is_free_motion`].
const FINER: usize = 4;
const LEVELS: usize = simd::DEPTH;

/// For a check against everything.
const ALL: Among = Among { depth: 0, lanes: 0 };

/// Maximum number of points of a cloud that is joined with others.
const SMALL_CLOUD: usize = 1_000;

/// Number of postures of the widest batch.
pub(crate) const WIDEST: usize = 16;

/// An obstacle, which does not move.
#[derive(Debug, Clone, PartialEq)]
pub struct Obstacle {
    /// Its name in messages.
    pub name: String,
    /// The pose of its centre; its axis is along z.
    pub pose: Pose,
    /// Its shape.
    pub geometry: Geometry,
}

/// A robot among obstacles.
#[derive(Debug, Clone)]
pub struct Space {
    compiled: Compiled,
    scratch: Scratch,
    isa: Isa,
    lower: State,
    upper: State,
    /// Factor by which the motions of each joint are checked more closely ([`Mechanism::fineness`]).
    fineness: State,
    branches: Vec<Vec<usize>>,
    /// Whether a link that no joint moves is in collision.
    blocked: bool,
    swept: bool,
    /// The couples that are checked by exact shapes.
    confirmed: Option<Arc<Confirmed>>,
}

impl Space {
    /// Postures per radian at which a motion is checked by the search; more if a link that mimics the joint moves further ([`Mechanism`]).
    pub const RESOLUTION: f32 = 32.0;

    /// Postures per radian at which exact shapes are checked if motions have to be free between their postures.
    pub(crate) const EXACT_RESOLUTION: f32 = 4.0 * Space::RESOLUTION;

    /// A robot among obstacles.
    pub fn new<'a>(mechanism: &Mechanism, surroundings: impl Into<Surroundings<'a>>) -> Space {
        Space::with_isa(mechanism, surroundings, Isa::detect())
    }

    /// As [`Space::new`], with a given instruction set.
    pub fn with_isa<'a>(mechanism: &Mechanism, surroundings: impl Into<Surroundings<'a>>, isa: Isa) -> Space {
        let surroundings = surroundings.into();
        let obstacles = surroundings.obstacles;
        let compiled_obstacles: Vec<simd::Obstacle> = obstacles.iter().map(compile_obstacle).collect();
        let names: Vec<&String> = obstacles
            .iter()
            .map(|o| &o.name)
            .chain(surroundings.clouds.iter().map(|c| &c.name))
            .chain(surroundings.meshes.iter().map(|m| &m.name))
            .collect();
        let allowed: Vec<Vec<usize>> = (0..mechanism.links.len())
            .map(|link| (0..names.len()).filter(|o| !mechanism.is_kept_from(link, names[*o])).collect())
            .collect();
        let (mut compiled, shells, links) = compile_robot(mechanism, &allowed, ROUNDING_M);
        let mut blocked = false;
        for (rigid, shell) in compiled.rigids.iter_mut().zip(&shells) {
            let mut near: Vec<(f64, usize)> = Vec::new();
            let allowed = &allowed[links[rigid.groups.start]];
            for (o, obstacle) in obstacles.iter().enumerate().filter(|(o, _)| !allowed.contains(o)) {
                if rigid.frame == 0 {
                    let touches =
                        |s: &[f32; 4]| gap(obstacle, std::array::from_fn(|i| f64::from(s[i]))) < f64::from(s[3]);
                    blocked |= compiled.groups[rigid.groups.clone()].iter().any(|g| g.fine.iter().any(touches));
                    continue;
                }
                let far = gap(obstacle, shell.anchor);
                if far <= shell.reach {
                    near.push((far, o));
                }
            }
            near.sort_by(|a, b| a.0.total_cmp(&b.0));
            let order: Vec<usize> = near.into_iter().map(|(_, o)| o).collect();
            rigid.near = order.chunks(isa.width()).map(|row| compile_row(row, obstacles)).collect();
        }
        compiled.obstacles = compiled_obstacles;
        blocked |= add_clouds(&mut compiled, mechanism, &surroundings, &shells, &links, isa);
        compiled.pairs = pairs(mechanism, &compiled, &links);
        compiled.spans = spans(&compiled);
        let (mut lower, mut upper) = ([0.0; MAX_JOINTS], [0.0; MAX_JOINTS]);
        for (j, joint) in mechanism.joints.iter().enumerate() {
            (lower[j], upper[j]) = (joint.lower as f32, joint.upper as f32);
        }
        let mut fineness = [1.0; MAX_JOINTS];
        for (fine, fineness) in fineness.iter_mut().zip(mechanism.fineness()) {
            *fine = fineness as f32;
        }
        let scratch = Scratch::new(&compiled);
        let branches = branches::branches(&parents(&compiled));
        Space { compiled, scratch, isa, lower, upper, fineness, branches, blocked, swept: false, confirmed: None }
    }

    /// Number of joints.
    pub fn joints(&self) -> usize {
        self.compiled.joints
    }

    /// Minimum and maximum positions.
    pub fn limits(&self) -> (&State, &State) {
        (&self.lower, &self.upper)
    }

    /// Groups of joints that are moved by no joint of another arm ([`branches`](crate::branches)).
    pub(crate) fn branches(&self) -> &[Vec<usize>] {
        &self.branches
    }

    /// The instruction set in use.
    pub fn isa(&self) -> Isa {
        self.isa
    }

    /// Sets whether [`Space::is_free_motion`] also checks between the postures.
    pub fn set_swept(&mut self, swept: bool) {
        self.swept = swept;
    }

    /// Adds a check by exact shapes.
    pub(crate) fn confirm(&mut self, confirmed: Confirmed) {
        self.confirmed = Some(Arc::new(confirmed));
    }

    /// Whether motions are checked between the postures as well.
    pub fn is_swept(&self) -> bool {
        self.swept
    }

    /// Whether a posture is within the limits.
    pub fn is_within(&self, state: &State) -> bool {
        (0..self.joints()).all(|j| self.lower[j] <= state[j] && state[j] <= self.upper[j])
    }

    /// Whether a posture is free of collisions.
    pub fn is_free(&mut self, state: &State) -> bool {
        !self.blocked
            && self.check(state, &[0.0; MAX_JOINTS], 1, ALL)
            && self.confirmed.as_ref().is_none_or(|confirmed| confirmed.is_free(state))
    }

    /// The mask of up to [`WIDEST`] postures in which a recent contact occurs again.
    pub(crate) fn touching_again(&mut self, states: &[State]) -> u32 {
        let mut positions = [Block([0.0; WIDEST]); MAX_JOINTS];
        for (lane, state) in states.iter().enumerate() {
            for (positions, position) in positions[..self.joints()].iter_mut().zip(state) {
                positions.0[lane] = *position;
            }
        }
        self.isa.touching_again(&self.compiled, &positions, states.len(), &mut self.scratch)
    }

    /// Whether a straight motion is free of collisions; `from` itself is not checked.
    #[inline]
    pub fn is_free_motion(&mut self, from: &State, to: &State) -> bool {
        if self.swept {
            return self.is_swept_free(from, to);
        }
        let delta = difference(to, from);
        let batches = self.batches(&delta);
        !self.blocked && self.check(from, &delta, batches, ALL) && self.is_confirmed(from, to, Space::RESOLUTION)
    }

    /// Whether the couples checked by exact shapes are free along a straight motion, at `per_radian` postures per radian.
    fn is_confirmed(&self, from: &State, to: &State, per_radian: f32) -> bool {
        let Some(confirmed) = &self.confirmed else { return true };
        let delta = difference(to, from);
        let length = length(&std::array::from_fn(|j| delta[j] * self.fineness[j]));
        confirmed.is_free_motion(from, to, (length * per_radian).ceil().max(1.0) as usize)
    }

    /// Whether a straight motion is free of collisions, also between the postures.
    pub fn is_swept_free(&mut self, from: &State, to: &State) -> bool {
        let delta = difference(to, from);
        // The coarse check finds most collisions.
        let batches = self.batches(&delta);
        !self.blocked
            && self.check(from, &delta, batches, ALL)
            && self.sweep(from, &delta)
            && self.is_confirmed(from, to, Space::EXACT_RESOLUTION)
    }

    /// Checks one batch of postures along a motion; for benchmarks.
    pub fn check_batch(&mut self, from: &State, delta: &State) -> bool {
        self.check(from, delta, 1, ALL)
    }

    /// As [`Space::is_swept_free`], for a motion whose postures have been checked before.
    pub(crate) fn is_swept_free_too(&mut self, from: &State, to: &State) -> bool {
        !self.blocked && self.sweep(from, &difference(to, from)) && self.is_confirmed(from, to, Space::EXACT_RESOLUTION)
    }

    fn sweep(&mut self, from: &State, delta: &State) -> bool {
        let pieces = self.batches(delta).div_ceil(FINER);
        self.sweep_among(from, delta, pieces, ALL)
    }

    /// Whether a part of a motion, cut into `pieces` batches, is free of what was near in the coarser check.
    fn sweep_among(&mut self, from: &State, delta: &State, pieces: usize, among: Among) -> bool {
        if among.depth == LEVELS {
            return self.check(from, delta, pieces, among);
        }
        let width = self.isa.width();
        let piece: State = std::array::from_fn(|j| delta[j] / pieces as f32);
        for i in 0..pieces {
            let start: State = std::array::from_fn(|j| from[j] + piece[j] * i as f32);
            let edge = Edge { compiled: &self.compiled, start: &start, delta: &piece, batches: 1, among };
            let mut doubtful = self.isa.near(&edge, &mut self.scratch);
            // Runs of doubtful steps, each divided as a motion of its own.
            while doubtful != 0 {
                let first = doubtful.trailing_zeros();
                let steps = (doubtful >> first).trailing_ones();
                let fraction = |steps: u32| steps as f32 / width as f32;
                let run: State = std::array::from_fn(|j| piece[j] * fraction(steps));
                let at: State = std::array::from_fn(|j| start[j] + piece[j] * fraction(first));
                let lanes = ((1_u32 << steps) - 1) << first;
                let finer = Among { depth: among.depth + 1, lanes };
                if !self.sweep_among(&at, &run, (steps as usize * FINER).div_ceil(width), finer) {
                    return false;
                }
                doubtful &= !lanes;
            }
        }
        true
    }

    fn batches(&self, delta: &State) -> usize {
        let length = length(&std::array::from_fn(|j| delta[j] * self.fineness[j]));
        // In multiples of the widest batch, so that every machine checks the same postures.
        let widest = ((length * Space::RESOLUTION / WIDEST as f32).ceil() as usize).max(1);
        widest * (WIDEST / self.isa.width())
    }

    #[inline]
    fn check(&mut self, start: &State, delta: &State, batches: usize, among: Among) -> bool {
        let edge = Edge { compiled: &self.compiled, start, delta, batches, among };
        self.isa.is_free(&edge, &mut self.scratch)
    }
}

/// `to - from`
#[inline]
pub fn difference(to: &State, from: &State) -> State {
    std::array::from_fn(|j| to[j] - from[j])
}

/// The Euclidean length.
#[inline]
pub fn length(delta: &State) -> f32 {
    // Four sums side by side.
    let mut sums = [0.0_f32; 4];
    for four in delta.chunks_exact(4) {
        for (sum, d) in sums.iter_mut().zip(four) {
            *sum += d * d;
        }
    }
    ((sums[0] + sums[1]) + (sums[2] + sums[3])).sqrt()
}

/// The Euclidean distance.
#[inline]
pub fn distance(a: &State, b: &State) -> f32 {
    length(&difference(a, b))
}

/// The posture a fraction of the way from one to another.
#[inline]
pub fn between(a: &State, b: &State, fraction: f32) -> State {
    std::array::from_fn(|j| a[j] + (b[j] - a[j]) * fraction)
}

/// The posture on the straight way to another one, at most `at_most` from the start; `far` is the distance of the two.
#[inline]
pub(crate) fn towards(from: &State, to: &State, far: f32, at_most: f32) -> State {
    if far <= at_most { *to } else { between(from, to, at_most / far) }
}

/// Distance of a point from an obstacle, in metres; zero inside.
fn gap(obstacle: &Obstacle, point: [f64; 3]) -> f64 {
    let [x, y, z] = obstacle.pose.inverse().transform(point);
    let beyond = |p: f64, half: f64| (p.abs() - half).max(0.0);
    match obstacle.geometry {
        Geometry::Box { half } => beyond(x, half[0]).hypot(beyond(y, half[1])).hypot(beyond(z, half[2])),
        Geometry::Cylinder { radius, half_length } => beyond(x.hypot(y), radius).hypot(beyond(z, half_length)),
        Geometry::Capsule { radius, half_length } => (x.hypot(y).hypot(beyond(z, half_length)) - radius).max(0.0),
        Geometry::Sphere { radius } => (x.hypot(y).hypot(z) - radius).max(0.0),
    }
}

fn compile_obstacle(obstacle: &Obstacle) -> simd::Obstacle {
    let (half, round) = match obstacle.geometry {
        Geometry::Box { half } => (half, 0.0),
        Geometry::Cylinder { radius, half_length } => ([radius, radius, half_length], 0.0),
        Geometry::Capsule { radius, half_length } => ([0.0, 0.0, half_length], radius),
        Geometry::Sphere { radius } => ([0.0; 3], radius),
    };
    let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|axis| obstacle.pose.rotate(axis));
    simd::Obstacle {
        centre: obstacle.pose.position.map(|c| c as f32),
        axes: std::array::from_fn(|i| axes[i / 3][i % 3] as f32),
        half: half.map(|h| h as f32),
        round: round as f32,
        is_cylinder: matches!(obstacle.geometry, Geometry::Cylinder { .. }),
        upright: axes[2][2] > 1.0 - 1e-12,
    }
}

/// Adds clouds and meshes within reach; returns whether a link that no joint moves is in collision with one.
fn add_clouds(
    compiled: &mut Compiled,
    mechanism: &Mechanism,
    surroundings: &Surroundings<'_>,
    shells: &[Shell],
    links: &[usize],
    isa: Isa,
) -> bool {
    let radii = || compiled.groups.iter().flat_map(|g| &g.fine).map(|sphere| f64::from(sphere[3]));
    let (least, greatest) = (radii().fold(f64::INFINITY, f64::min), radii().fold(0.0, f64::max));
    if compiled.groups.is_empty() {
        return false;
    }
    let shell = |i: usize| match compiled.rigids[i].frame {
        0 => {
            let [x, y, z, r] = compiled.rigids[i].coarse.map(f64::from);
            ([x, y, z], r)
        }
        _ => (shells[i].anchor, shells[i].reach),
    };
    let robot = Reached { shells: (0..shells.len()).map(shell).collect(), radii: [least, greatest] };
    let joined = joined(surroundings.clouds, mechanism);
    let clouds = joined.iter().map(|c| (&c[0].name, occupied::cloud(c, &robot, isa)));
    let share = occupied::share(surroundings.meshes.len());
    let meshes = surroundings.meshes.iter().map(|m| (&m.name, occupied::mesh(m, &robot, isa, share)));
    let mut blocked = false;
    for (name, cloud) in clouds.chain(meshes) {
        let Some(cloud) = cloud else { continue };
        let index = compiled.clouds.len() as u32;
        for (i, rigid) in compiled.rigids.iter_mut().enumerate() {
            if !mechanism.is_kept_from(links[rigid.groups.start], name) {
                continue;
            }
            if rigid.frame == 0 {
                let mut fine = compiled.groups[rigid.groups.clone()].iter().flat_map(|group| &group.fine);
                blocked |= fine.any(|[x, y, z, r]| cloud.touches_sphere([*x, *y, *z], *r));
            } else {
                let (anchor, reach) = robot.shells[i];
                if cloud.is_within(anchor, reach) {
                    rigid.clouds.push(index);
                }
            }
        }
        compiled.clouds.push(Arc::new(cloud));
    }
    blocked
}

/// Groups of clouds with a grid each: small clouds of one radius that the same links may touch are joined, every other cloud is alone.
fn joined<'c>(clouds: &'c [Cloud], mechanism: &Mechanism) -> Vec<Vec<&'c Cloud>> {
    let mut joined: BTreeMap<(u64, Vec<usize>), Vec<&Cloud>> = BTreeMap::new();
    let (small, large): (Vec<&Cloud>, Vec<&Cloud>) =
        clouds.iter().partition(|cloud| cloud.points().len() <= SMALL_CLOUD);
    for cloud in small {
        let free = (0..mechanism.links.len()).filter(|link| !mechanism.is_kept_from(*link, &cloud.name));
        joined.entry((cloud.radius_m().to_bits(), free.collect())).or_default().push(cloud);
    }
    large.into_iter().map(|cloud| vec![cloud]).chain(joined.into_values()).collect()
}

fn compile_row(order: &[usize], obstacles: &[Obstacle]) -> Row {
    let unused = [Block([f32::INFINITY; 16]); 3];
    let indices = order.iter().map(|o| *o as u32).collect();
    let mut row = Row { obstacles: indices, least: unused, minus_greatest: unused };
    for (lane, o) in order.iter().enumerate() {
        let Obstacle { pose, geometry, .. } = &obstacles[*o];
        let extents = geometry.extents(pose);
        for (i, (at, extent)) in pose.position.iter().zip(extents).enumerate() {
            row.least[i].0[lane] = (at - extent - ROUNDING_M) as f32;
            row.minus_greatest[i].0[lane] = (-at - extent - ROUNDING_M) as f32;
        }
    }
    row
}

/// The reachable region of a rigid part: a sphere around the first joint of its chain.
#[derive(Debug, Clone, Copy)]
struct Shell {
    anchor: [f64; 3],
    reach: f64,
}

/// The robot's frames, rigid parts and groups, the reachable region of each rigid part, and the link of each group. Groups whose links are allowed
/// to touch other obstacles belong to different rigid parts.
fn compile_robot(mechanism: &Mechanism, allowed: &[Vec<usize>], padding: f64) -> (Compiled, Vec<Shell>, Vec<usize>) {
    let mut frames: Vec<Frame> = Vec::new();
    // Per frame: the maximum distance of its origin from the first joint of its chain, and that joint's position.
    let mut chains: Vec<(f64, [f64; 3])> = vec![(0.0, [0.0; 3])];
    // Per link: its frame, and its pose in the frame.
    let mut places: Vec<(usize, Pose)> = Vec::new();
    let mut compiled = Compiled { joints: mechanism.joints.len(), ..Compiled::default() };
    let mut links = Vec::new();
    for (index, link) in mechanism.links.iter().enumerate() {
        let (parent, place) = link.parent.map_or((0, Pose::IDENTITY), |p| places[p]);
        let origin = place.compose(&link.origin);
        match link.drive {
            None => places.push((parent, origin)),
            Some(drive) => {
                // Rotates the frame so that its z axis is the joint's axis.
                let aligned = align(drive.axis);
                let moved = origin.compose(&aligned);
                places.push((frames.len() + 1, aligned.inverse()));
                let joint = &mechanism.joints[drive.joint];
                let factor = drive.factor as f32;
                let slide =
                    if drive.slides { joint.lower.abs().max(joint.upper.abs()) * drive.factor.abs() } else { 0.0 };
                let (travel, origin) = (slide as f32, rows(&moved));
                frames.push(Frame { parent, origin, joint: drive.joint, slides: drive.slides, factor, travel });
                let way = moved.distance(&Pose::IDENTITY);
                chains.push(match parent {
                    0 => (slide, moved.position),
                    _ => (chains[parent].0 + way + slide, chains[parent].1),
                });
            }
        }
        if !link.spheres.is_empty() {
            let (frame, place) = places[index];
            let fine: Vec<[f32; 4]> = link
                .spheres
                .iter()
                .map(|s| {
                    let [x, y, z] = place.transform(s.centre);
                    [x as f32, y as f32, z as f32, (s.radius + padding) as f32]
                })
                .collect();
            let coarse = enclose(&fine);
            links.push(index);
            compiled.groups.push(Group { frame, coarse, fine, slot: 0 });
        }
    }
    compiled.frames = frames;
    // The hand, deepest in the tree, is most likely to collide.
    let mut order: Vec<usize> = (0..links.len()).collect();
    order.sort_by_key(|i| (Reverse(compiled.groups[*i].frame), &allowed[links[*i]], Reverse(*i)));
    compiled.groups = order.iter().map(|i| compiled.groups[*i].clone()).collect();
    for group in &mut compiled.groups {
        group.slot = compiled.slots;
        compiled.slots += group.fine.len();
    }
    let links: Vec<usize> = order.iter().map(|i| links[*i]).collect();
    let is_joined = |a: &usize, b: &usize| {
        compiled.groups[*a].frame == compiled.groups[*b].frame && allowed[links[*a]] == allowed[links[*b]]
    };
    let all: Vec<usize> = (0..links.len()).collect();
    let (mut rigids, mut shells) = (Vec::new(), Vec::new());
    for joined in all.chunk_by(is_joined) {
        let groups = joined[0]..joined[joined.len() - 1] + 1;
        let coarse = match &compiled.groups[groups.clone()] {
            [one] => one.coarse,
            several => enclose(&several.iter().flat_map(|g| g.fine.iter().copied()).collect::<Vec<_>>()),
        };
        let frame = compiled.groups[groups.start].frame;
        let (way, anchor) = chains[frame];
        shells.push(Shell { anchor, reach: way + f64::from(norm(&coarse) + coarse[3]) + 1e-4 });
        rigids.push(Rigid { frame, coarse, groups, near: Vec::new(), clouds: Vec::new() });
    }
    compiled.rigids = rigids;
    (compiled, shells, links)
}

/// The frames and bounding spheres of the rigid parts, then of the groups.
fn spheres(compiled: &Compiled) -> impl Iterator<Item = (usize, &[f32; 4])> {
    let rigids = compiled.rigids.iter().map(|rigid| (rigid.frame, &rigid.coarse));
    rigids.chain(compiled.groups.iter().map(|group| (group.frame, &group.coarse)))
}

/// The pairs of groups, in the order of checking; `links` has the link of each group.
fn pairs(mechanism: &Mechanism, compiled: &Compiled, links: &[usize]) -> Vec<SelfPair> {
    let mut places = vec![(0, 0); mechanism.links.len()];
    for (r, rigid) in compiled.rigids.iter().enumerate() {
        for group in rigid.groups.clone() {
            places[links[group]] = (r as u32, group as u32);
        }
    }
    let mut pairs: BTreeMap<(u32, u32), Vec<(u32, u32)>> = BTreeMap::new();
    for (a, b) in mechanism.pairs().into_iter().filter(|pair| !mechanism.by_shapes.contains(pair)) {
        let (a, b) = (places[a].min(places[b]), places[a].max(places[b]));
        pairs.entry((a.0, b.0)).or_default().push((a.1, b.1));
    }
    let sorted = pairs.into_iter().map(|((first, second), mut groups)| {
        groups.sort_unstable();
        SelfPair { first, second, groups }
    });
    sorted.collect()
}

/// For each joint the next joint towards the root, by the first link that it moves. Mimic links farther out do not count, so no joint is its own
/// parent.
fn parents(compiled: &Compiled) -> Vec<Option<usize>> {
    let parent = |joint: usize| {
        let first = compiled.frames.iter().find(|frame| frame.joint == joint)?;
        Some(compiled.frames[first.parent.checked_sub(1)?].joint)
    };
    (0..compiled.joints).map(parent).collect()
}

fn spans(compiled: &Compiled) -> Spans {
    let radii: Vec<f32> = spheres(compiled).map(|(_, coarse)| coarse[3]).collect();
    let none = || vec![vec![0.0; radii.len()]; compiled.joints];
    let (mut turns, mut ways) = (none(), none());
    for (part, (mut frame, coarse)) in spheres(compiled).enumerate() {
        let mut reach = norm(coarse) + coarse[3];
        while frame != 0 {
            let here = &compiled.frames[frame - 1];
            // A joint may move several links of a chain.
            let factor = here.factor.abs();
            if here.slides {
                ways[here.joint][part] += 2.0 * factor;
            } else {
                ways[here.joint][part] += reach * factor;
                turns[here.joint][part] += factor;
            }
            reach += here.origin[9].hypot(here.origin[10]).hypot(here.origin[11]) + here.travel;
            frame = here.parent;
        }
    }
    Spans { turns, ways, radii }
}

fn norm(sphere: &[f32; 4]) -> f32 {
    sphere[0].hypot(sphere[1]).hypot(sphere[2])
}

/// A rotation that takes z to an axis.
pub(crate) fn align(axis: [f64; 3]) -> Pose {
    let [x, y, z] = axis;
    if z < -1.0 + 1e-12 {
        return Pose { position: [0.0; 3], quaternion_xyzw: [1.0, 0.0, 0.0, 0.0] };
    }
    let length = (2.0 * (1.0 + z)).sqrt();
    Pose { position: [0.0; 3], quaternion_xyzw: [-y / length, x / length, 0.0, length / 2.0] }
}

fn rows(pose: &Pose) -> [f32; 12] {
    let columns = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|axis| pose.rotate(axis));
    std::array::from_fn(|i| if i < 9 { columns[i % 3][i / 3] } else { pose.position[i - 9] } as f32)
}

/// A small sphere that holds all spheres (by Bădoiu and Clarkson's steps towards the farthest one).
fn enclose(spheres: &[[f32; 4]]) -> [f32; 4] {
    const STEPS: usize = 200;
    let reach = |c: &[f32; 3], s: &[f32; 4]| (0..3).map(|i| (c[i] - s[i]).powi(2)).sum::<f32>().sqrt() + s[3];
    let farthest = |c: &[f32; 3]| {
        let by = |a: &&[f32; 4], b: &&[f32; 4]| reach(c, a).total_cmp(&reach(c, b));
        spheres.iter().max_by(by).copied().unwrap_or_default()
    };
    let first = farthest(&[0.0; 3]);
    let mut centre = [first[0], first[1], first[2]];
    let mut best = (reach(&centre, &farthest(&centre)), centre);
    for step in 1..=STEPS {
        let far = farthest(&centre);
        let way = (reach(&centre, &far) - far[3]).max(1e-9);
        let share = ((reach(&centre, &far) / way).min(1.0)) / (step + 1) as f32;
        for i in 0..3 {
            centre[i] += (far[i] - centre[i]) * share;
        }
        let radius = reach(&centre, &farthest(&centre));
        if radius < best.0 {
            best = (radius, centre);
        }
    }
    if spheres.len() == 1 {
        return spheres[0];
    }
    let [x, y, z] = best.1;
    [x, y, z, best.0 + COARSE_ROUNDING_M]
}
