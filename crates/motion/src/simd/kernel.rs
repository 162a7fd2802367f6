//! Collision check of the postures along an edge, for as many postures at once as there are lanes: kinematics, and one walk over all possible
//! contacts, whose [`Visitor`] handles what it finds. [`sweep`](super::sweep) has the motions that are checked so.
//!
//! The walk (Thomason, Kingston, Kavraki: *Motions in Microseconds via Vectorized Sampling-Based Planning*, ICRA 2024) goes through the rigid
//! parts, the hand before the shoulder; a rigid part is all links fixed to one frame. The box that holds its bounding sphere in all lanes is
//! compared with the boxes of the obstacles within its reach, as many at once as there are lanes; then the sphere with the obstacles found,
//! nearest to the shoulder first; then the bounding sphere of each link and its fine spheres, only with obstacles that the larger sphere touches.
//! Clouds of points and pairs follow, in the same manner. [`walk_among`] does the same for what was noted before.
//!
//! There are no closures over vectors here: a closure that is not inlined is compiled without the instructions of its caller.

use super::cloud::Cloud;
use super::lanes::{Block, Lanes};
use super::sweep::{Growth, Near, Spans};
use std::ops::Range;
use std::sync::Arc;

/// Maximum number of joints of a configuration; unused ones are zero.
pub(crate) const LENGTH: usize = 16;

/// A joint's frame: the parent's, moved by a constant, then rotated about or translated along its z axis.
#[derive(Debug, Clone)]
pub(crate) struct Frame {
    pub(crate) parent: usize,
    /// Rows of the rotation, then the translation.
    pub(crate) origin: [f32; 12],
    /// The joint that moves it, and whether the joint is prismatic.
    pub(crate) joint: usize,
    pub(crate) slides: bool,
    /// Motion of the frame for one radian (or metre) of the joint.
    pub(crate) factor: f32,
    /// Maximum translation by a prismatic joint.
    pub(crate) travel: f32,
}

/// The spheres of a link.
#[derive(Debug, Clone)]
pub(crate) struct Group {
    /// Frame 0 is the world.
    pub(crate) frame: usize,
    /// Centre and radius of the bounding sphere.
    pub(crate) coarse: [f32; 4],
    pub(crate) fine: Vec<[f32; 4]>,
    /// The index of its fine centres in the scratch blocks.
    pub(crate) slot: usize,
}

/// Groups that are fixed to one frame and may touch the same obstacles.
#[derive(Debug, Clone)]
pub(crate) struct Rigid {
    pub(crate) frame: usize,
    /// Centre and radius of the bounding sphere of all groups.
    pub(crate) coarse: [f32; 4],
    pub(crate) groups: Range<usize>,
    /// The obstacles that it can reach, the nearest to its anchor first.
    pub(crate) near: Vec<Row>,
    /// Indices of the clouds that it can reach.
    pub(crate) clouds: Vec<u32>,
}

/// As many obstacles as there are lanes, with their axis-aligned boxes in the world.
#[derive(Debug, Clone)]
pub(crate) struct Row {
    /// Indices of the obstacles.
    pub(crate) obstacles: Vec<u32>,
    /// Minimum x, y, z; unused lanes hold infinity.
    pub(crate) least: [Block; 3],
    /// Maximum x, y, z, with the sign changed.
    pub(crate) minus_greatest: [Block; 3],
}

/// Two rigid parts with the pairs of their groups that must not touch.
#[derive(Debug, Clone)]
pub(crate) struct SelfPair {
    pub(crate) first: u32,
    pub(crate) second: u32,
    pub(crate) groups: Vec<(u32, u32)>,
}

/// A box with rounded corners (a box, a sphere, a capsule), or a cylinder; z is the axis.
#[derive(Debug, Clone)]
pub(crate) struct Obstacle {
    pub(crate) centre: [f32; 3],
    /// Its axes in the world, one per row.
    pub(crate) axes: [f32; 9],
    /// Half extents; for a cylinder its radius, radius and half length.
    pub(crate) half: [f32; 3],
    /// The radius by which it is rounded outwards.
    pub(crate) round: f32,
    pub(crate) is_cylinder: bool,
    /// Whether its z axis is that of the world.
    pub(crate) upright: bool,
}

/// A robot among obstacles, compiled for the kernel.
#[derive(Debug, Clone, Default)]
pub(crate) struct Compiled {
    pub(crate) joints: usize,
    /// Parents first; the frame with index 0 is the world and not listed here.
    pub(crate) frames: Vec<Frame>,
    /// In the order of checking.
    pub(crate) rigids: Vec<Rigid>,
    /// In the order of the rigid parts.
    pub(crate) groups: Vec<Group>,
    pub(crate) pairs: Vec<SelfPair>,
    pub(crate) obstacles: Vec<Obstacle>,
    pub(crate) clouds: Vec<Arc<Cloud>>,
    pub(crate) slots: usize,
    /// How its rigid parts, and after them its groups, move with the joints.
    pub(crate) spans: Spans,
}

/// What the spheres of a group touch, by its index.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Other {
    Obstacle(u32),
    Group(u32),
    Cloud(u32),
}

/// A sphere of a group and what it touched.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Contact {
    pub(super) group: u32,
    pub(super) other: Other,
    /// Indices of the fine sphere of the group, and of the other group's.
    spheres: (u32, u32),
}

/// Handles what a walk finds.
pub(super) trait Visitor {
    /// Whether it needs all lanes in which a group touches something, or only one.
    const ALL: bool;
    /// Called when a sphere touches something in these lanes. Returns whether the walk goes on.
    fn touch(&mut self, contact: Contact, lanes: u32) -> bool;
}

/// Ends the walk at the first contact.
#[derive(Default)]
pub(super) struct First(Option<Contact>);

impl Visitor for First {
    const ALL: bool = false;

    #[inline(always)]
    fn touch(&mut self, contact: Contact, _: u32) -> bool {
        self.0 = Some(contact);
        false
    }
}

/// Number of lists of near things, one for each level of a swept check.
pub(crate) const DEPTH: usize = 4;

/// Number of contacts that are remembered, because what blocked one motion often blocks the next; and how many of them are checked before each
/// motion: for free motions that time is lost.
const CONTACTS: usize = 32;
const LATEST: usize = 8;

/// Working memory of one batch.
#[derive(Debug, Clone)]
pub(crate) struct Scratch {
    /// The last contacts, the latest first.
    contacts: Vec<Contact>,
    frames: Vec<[Block; 12]>,
    /// Centres of each rigid part, and by how much its spheres are enlarged in this batch.
    rigid: Vec<([Block; 3], f32)>,
    /// The same for each group.
    coarse: Vec<([Block; 3], f32)>,
    fine: Vec<[Block; 3]>,
    /// The batches in which a group's coarse and fine centres were last computed.
    coarse_stamps: Vec<u64>,
    fine_stamps: Vec<u64>,
    batch: u64,
    pub(super) growth: Growth,
    /// Near things: each list is for a stretch within the stretch of the list before.
    pub(super) near: [Vec<Near>; DEPTH],
}

impl Scratch {
    pub(crate) fn new(compiled: &Compiled) -> Scratch {
        let zero = Block([0.0; 16]);
        let mut world = [zero; 12];
        for diagonal in [0, 4, 8] {
            world[diagonal] = Block([1.0; 16]);
        }
        Scratch {
            contacts: Vec::with_capacity(CONTACTS),
            frames: vec![world; compiled.frames.len() + 1],
            rigid: vec![([zero; 3], 0.0); compiled.rigids.len()],
            coarse: vec![([zero; 3], 0.0); compiled.groups.len()],
            fine: vec![[zero; 3]; compiled.slots],
            coarse_stamps: vec![0; compiled.groups.len()],
            fine_stamps: vec![0; compiled.groups.len()],
            batch: 0,
            growth: Growth::new(&compiled.spans),
            near: std::array::from_fn(|_| Vec::new()),
        }
    }

    /// Puts the contact that ended a walk first in the list.
    pub(super) fn remember(&mut self, First(found): First) {
        let Some(contact) = found.filter(|contact| !matches!(contact.other, Other::Cloud(_))) else { return };
        let last = self.contacts.iter().position(|known| *known == contact).unwrap_or_else(|| {
            if self.contacts.len() == CONTACTS {
                self.contacts[CONTACTS - 1] = contact;
            } else {
                self.contacts.push(contact);
            }
            self.contacts.len() - 1
        });
        self.contacts[..=last].rotate_right(1);
    }
}

/// A straight motion to be checked.
pub(crate) struct Edge<'a> {
    pub(crate) compiled: &'a Compiled,
    pub(crate) start: &'a [f32; LENGTH],
    /// Difference of the end and the start.
    pub(crate) delta: &'a [f32; LENGTH],
    /// Number of batches; the end is checked, the start is not.
    pub(crate) batches: usize,
    /// What is checked.
    pub(crate) among: Among,
}

/// Everything (depth 0), or what the list of the depth before has in one of these lanes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Among {
    pub(crate) depth: usize,
    pub(crate) lanes: u32,
}

/// The joint positions of the postures of a batch.
trait Postures<V> {
    /// The position of a joint times a factor.
    fn position(&self, joint: usize, factor: f32) -> V;
}

/// Postures along an edge, one per lane, by their fractions of the edge.
struct Along<'a, V> {
    edge: &'a Edge<'a>,
    at: V,
}

impl<V: Lanes> Postures<V> for Along<'_, V> {
    #[inline(always)]
    fn position(&self, joint: usize, factor: f32) -> V {
        let (start, delta) = (self.edge.start[joint] * factor, self.edge.delta[joint] * factor);
        self.at.mul_add(V::splat(delta), V::splat(start))
    }
}

/// Some of sixteen independent postures: one block per joint.
struct Each<'a> {
    positions: &'a [Block],
    part: usize,
}

impl<V: Lanes> Postures<V> for Each<'_> {
    #[inline(always)]
    fn position(&self, joint: usize, factor: f32) -> V {
        V::load_part(&self.positions[joint], self.part).mul(V::splat(factor))
    }
}

/// Computes the robot's frames in the postures of a batch. The postures of one batch are spread over the whole edge and later batches fill the
/// gaps, so that the first batch most likely finds a collision.
#[inline(always)]
pub(super) fn pose<V: Lanes>(edge: &Edge<'_>, batch: usize, scratch: &mut Scratch) {
    let mut fractions = Block([0.0; 16]);
    for lane in 0..V::WIDTH {
        fractions.0[lane] = (lane + 1) as f32 / V::WIDTH as f32;
    }
    let back = 1.0 / (V::WIDTH * edge.batches) as f32;
    let at = V::load(&fractions).sub(V::splat(batch as f32 * back));
    kinematics(edge.compiled, &Along { edge, at }, scratch);
}

/// Computes the robot's frames in a part of sixteen postures, as many as there are lanes; one block per joint.
#[inline(always)]
pub(super) fn pose_each<V: Lanes>(compiled: &Compiled, positions: &[Block], part: usize, scratch: &mut Scratch) {
    kinematics::<V>(compiled, &Each { positions, part }, scratch);
}

/// Shows a visitor all contacts in the postures of the batch; returns whether it went on to the end.
#[inline(always)]
pub(super) fn walk<V: Lanes, F: Visitor>(compiled: &Compiled, scratch: &mut Scratch, visitor: &mut F) -> bool {
    in_obstacles::<V, F>(compiled, scratch, visitor) && in_itself::<V, F>(compiled, scratch, visitor)
}

/// As [`walk`], but checks only what was near in some of these lanes.
#[inline(always)]
pub(super) fn walk_among<V: Lanes, F: Visitor>(
    compiled: &Compiled,
    (near, lanes): (&[Near], u32),
    scratch: &mut Scratch,
    visitor: &mut F,
) -> bool {
    for Near { group, other, .. } in near.iter().filter(|near| near.lanes & lanes != 0) {
        let group = *group as usize;
        let goes_on = match other {
            Other::Obstacle(number) => group_in_obstacle::<V, F>(compiled, group, *number, V::ALL, scratch, visitor),
            Other::Group(second) => groups_meet::<V, F>(compiled, (group, *second as usize), scratch, visitor),
            Other::Cloud(number) => group_in_cloud::<V, F>(compiled, group, *number, V::ALL, scratch, visitor),
        };
        if !goes_on {
            return false;
        }
    }
    true
}

/// Whether one of the latest remembered contacts occurs again. The whole check would find it, too.
#[inline(always)]
pub(super) fn touches_again<V: Lanes>(compiled: &Compiled, scratch: &mut Scratch) -> bool {
    for i in 0..scratch.contacts.len().min(LATEST) {
        if touching_again::<V>(compiled, scratch.contacts[i], scratch) != 0 {
            scratch.contacts[..=i].rotate_right(1);
            return true;
        }
    }
    false
}

/// The lanes, among `lanes`, in which any remembered contact occurs again.
#[inline(always)]
pub(super) fn all_touching_again<V: Lanes>(compiled: &Compiled, lanes: u32, scratch: &mut Scratch) -> u32 {
    let mut left = lanes;
    for i in 0..scratch.contacts.len() {
        let found = touching_again::<V>(compiled, scratch.contacts[i], scratch) & left;
        if found != 0 {
            scratch.contacts[..=i].rotate_right(1);
            left &= !found;
            if left == 0 {
                break;
            }
        }
    }
    lanes & !left
}

/// The lanes in which a remembered contact occurs again.
#[inline(always)]
fn touching_again<V: Lanes>(compiled: &Compiled, contact: Contact, scratch: &Scratch) -> u32 {
    let Contact { group, other, spheres } = contact;
    let (at, radius) = fine_sphere::<V>(compiled, (group, spheres.0), scratch);
    match other {
        Other::Obstacle(obstacle) => meets(at, radius, &compiled.obstacles[obstacle as usize]),
        Other::Group(other) => {
            let (other, more) = fine_sphere::<V>(compiled, (other, spheres.1), scratch);
            meet(at, other, radius + more)
        }
        // Contacts with clouds are not remembered.
        Other::Cloud(_) => 0,
    }
}

#[inline(always)]
fn fine_sphere<V: Lanes>(compiled: &Compiled, (group, which): (u32, u32), scratch: &Scratch) -> ([V; 3], f32) {
    let group = &compiled.groups[group as usize];
    let sphere = &group.fine[which as usize];
    (place(&scratch.frames[group.frame], sphere), sphere[3])
}

/// Sine and cosine: reduced to half a turn, minimax polynomials for the half angle (errors 5e-9 and 5e-8), doubled. The error of the results is
/// less than 1e-6, rounding included.
#[inline(always)]
fn sin_cos<V: Lanes>(x: V) -> (V, V) {
    // Adding and subtracting this constant rounds to whole numbers.
    const ROUND: f32 = 12_582_912.0;
    let turns = x.mul_add(V::splat(std::f32::consts::FRAC_1_PI * 0.5), V::splat(ROUND)).sub(V::splat(ROUND));
    let x = turns.mul_add(V::splat(-6.281_25), x);
    let x = turns.mul_add(V::splat(-0.001_935_307_2), x);
    let h = x.mul(V::splat(0.5));
    let h2 = h.mul(h);
    let mut s = V::splat(2.600_054_8e-6);
    for c in [-1.980_661_5e-4, 8.333_017e-3, -1.666_665_7e-1, 1.0] {
        s = s.mul_add(h2, V::splat(c));
    }
    let s = s.mul(h);
    let mut c = V::splat(2.319_438_7e-5);
    for t in [-1.385_592_7e-3, 4.166_399e-2, -0.499_999_3, 1.0] {
        c = c.mul_add(h2, V::splat(t));
    }
    let twice = s.add(s);
    (twice.mul(c), V::splat(1.0).sub(twice.mul(s)))
}

#[inline(always)]
fn kinematics<V: Lanes>(compiled: &Compiled, postures: &impl Postures<V>, scratch: &mut Scratch) {
    scratch.batch += 1;
    for (index, frame) in compiled.frames.iter().enumerate() {
        let (known, new) = scratch.frames.split_at_mut(index + 1);
        let (parent, place) = (&known[frame.parent], &mut new[0]);
        let o = &frame.origin;
        let q = postures.position(frame.joint, frame.factor);
        let (s, c) = if frame.slides { (V::splat(0.0), V::splat(1.0)) } else { sin_cos(q) };
        let minus = V::splat(0.0).sub(s);
        // Row by row, so that what is computed stays in registers.
        for row in 0..3 {
            let (mut x, mut y, z, mut t);
            if frame.parent == 0 {
                (x, y) = (V::splat(o[3 * row]), V::splat(o[3 * row + 1]));
                (z, t) = (V::splat(o[3 * row + 2]), V::splat(o[9 + row]));
            } else {
                let p = [V::load(&parent[3 * row]), V::load(&parent[3 * row + 1]), V::load(&parent[3 * row + 2])];
                x = p[2].mul_add(V::splat(o[6]), p[1].mul_add(V::splat(o[3]), p[0].mul(V::splat(o[0]))));
                y = p[2].mul_add(V::splat(o[7]), p[1].mul_add(V::splat(o[4]), p[0].mul(V::splat(o[1]))));
                z = p[2].mul_add(V::splat(o[8]), p[1].mul_add(V::splat(o[5]), p[0].mul(V::splat(o[2]))));
                let moved = p[0].mul_add(V::splat(o[9]), V::load(&parent[9 + row]));
                t = p[2].mul_add(V::splat(o[11]), p[1].mul_add(V::splat(o[10]), moved));
            }
            if frame.slides {
                t = z.mul_add(q, t);
            } else {
                (x, y) = (x.mul_add(c, y.mul(s)), y.mul_add(c, x.mul(minus)));
            }
            x.store(&mut place[3 * row]);
            y.store(&mut place[3 * row + 1]);
            z.store(&mut place[3 * row + 2]);
            t.store(&mut place[9 + row]);
        }
    }
}

#[inline(always)]
fn place<V: Lanes>(frame: &[Block; 12], point: &[f32]) -> [V; 3] {
    let mut placed = [V::splat(0.0); 3];
    for row in 0..3 {
        let x = V::load(&frame[3 * row]).mul_add(V::splat(point[0]), V::load(&frame[9 + row]));
        let y = V::load(&frame[3 * row + 1]).mul_add(V::splat(point[1]), x);
        placed[row] = V::load(&frame[3 * row + 2]).mul_add(V::splat(point[2]), y);
    }
    placed
}

/// `a - b`, for points.
#[inline(always)]
fn minus<V: Lanes>(a: [V; 3], b: [V; 3]) -> [V; 3] {
    [a[0].sub(b[0]), a[1].sub(b[1]), a[2].sub(b[2])]
}

#[inline(always)]
fn splat3<V: Lanes>(a: &[f32; 3]) -> [V; 3] {
    [V::splat(a[0]), V::splat(a[1]), V::splat(a[2])]
}

#[inline(always)]
fn squared<V: Lanes>([x, y, z]: [V; 3]) -> V {
    x.mul_add(x, y.mul_add(y, z.mul(z)))
}

#[inline(always)]
fn store<V: Lanes>(point: [V; 3], to: &mut [Block; 3]) {
    for i in 0..3 {
        point[i].store(&mut to[i]);
    }
}

#[inline(always)]
fn fetch<V: Lanes>(from: &[Block; 3]) -> [V; 3] {
    [V::load(&from[0]), V::load(&from[1]), V::load(&from[2])]
}

/// Computes the centre of a group's bounding sphere, once per batch.
#[inline(always)]
fn approach<V: Lanes>(compiled: &Compiled, index: usize, scratch: &mut Scratch) {
    if scratch.coarse_stamps[index] != scratch.batch {
        scratch.coarse_stamps[index] = scratch.batch;
        let group = &compiled.groups[index];
        let (at, grown) = &mut scratch.coarse[index];
        store(place::<V>(&scratch.frames[group.frame], &group.coarse), at);
        *grown = scratch.growth.of::<V>(compiled.rigids.len() + index, at);
    }
}

/// Computes the fine centres of a group, once per batch.
#[inline(always)]
fn refine<V: Lanes>(group: &Group, index: usize, scratch: &mut Scratch) {
    if scratch.fine_stamps[index] != scratch.batch {
        scratch.fine_stamps[index] = scratch.batch;
        let frame = &scratch.frames[group.frame];
        for (sphere, to) in group.fine.iter().zip(&mut scratch.fine[group.slot..]) {
            store(place::<V>(frame, sphere), to);
        }
    }
}

#[inline(always)]
fn in_obstacles<V: Lanes, F: Visitor>(compiled: &Compiled, scratch: &mut Scratch, visitor: &mut F) -> bool {
    for (index, rigid) in compiled.rigids.iter().enumerate() {
        let centre = place::<V>(&scratch.frames[rigid.frame], &rigid.coarse);
        let (at, grown) = &mut scratch.rigid[index];
        store(centre, at);
        *grown = scratch.growth.of::<V>(index, at);
        if rigid.near.is_empty() && rigid.clouds.is_empty() {
            continue;
        }
        let radius = rigid.coarse[3] + *grown;
        let bounds = bounds(centre, radius);
        for row in &rigid.near {
            let mut hits = overlaps::<V>(&bounds, row);
            while hits != 0 {
                let number = row.obstacles[hits.trailing_zeros() as usize];
                hits &= hits - 1;
                let about = meets(centre, radius, &compiled.obstacles[number as usize]);
                if about == 0 {
                    continue;
                }
                for group in rigid.groups.clone() {
                    let about = if rigid.groups.len() == 1 { about } else { V::ALL };
                    if !group_in_obstacle::<V, F>(compiled, group, number, about, scratch, visitor) {
                        return false;
                    }
                }
            }
        }
        for number in &rigid.clouds {
            let cloud = &*compiled.clouds[*number as usize];
            if cloud.is_beside(&bounds) {
                continue;
            }
            let mut cells = Block([0.0; 16]);
            let about = cloud.may_touch(centre, radius + cloud.radius, V::ALL, &mut cells);
            if about == 0 {
                continue;
            }
            for group in rigid.groups.clone() {
                if !group_in_cloud::<V, F>(compiled, group, *number, about, scratch, visitor) {
                    return false;
                }
            }
        }
    }
    true
}

/// The contacts of a group with an obstacle; `about` has the lanes of its bounding sphere's contacts, if known, or else all lanes.
#[inline(always)]
fn group_in_obstacle<V: Lanes, F: Visitor>(
    compiled: &Compiled,
    index: usize,
    number: u32,
    mut about: u32,
    scratch: &mut Scratch,
    visitor: &mut F,
) -> bool {
    let group = &compiled.groups[index];
    let obstacle = &compiled.obstacles[number as usize];
    approach::<V>(compiled, index, scratch);
    let (at, grown) = &scratch.coarse[index];
    let grown = *grown;
    if about == V::ALL {
        about = meets::<V>(fetch(at), group.coarse[3] + grown, obstacle);
    }
    if about == 0 {
        return true;
    }
    let contact = |which| Contact { group: index as u32, other: Other::Obstacle(number), spheres: (which, 0) };
    if group.fine.len() == 1 {
        return visitor.touch(contact(0), about);
    }
    refine::<V>(group, index, scratch);
    for (which, sphere) in group.fine.iter().enumerate() {
        let lanes = meets::<V>(fetch(&scratch.fine[group.slot + which]), sphere[3] + grown, obstacle);
        if lanes != 0 {
            if !visitor.touch(contact(which as u32), lanes) {
                return false;
            }
            about &= !lanes;
            if about == 0 {
                break;
            }
        }
    }
    true
}

/// The contacts of a group with a cloud, in some lanes.
#[inline(always)]
fn group_in_cloud<V: Lanes, F: Visitor>(
    compiled: &Compiled,
    index: usize,
    number: u32,
    mut about: u32,
    scratch: &mut Scratch,
    visitor: &mut F,
) -> bool {
    let group = &compiled.groups[index];
    let cloud = &*compiled.clouds[number as usize];
    approach::<V>(compiled, index, scratch);
    let (at, grown) = &scratch.coarse[index];
    let grown = *grown + cloud.radius;
    let mut cells = Block([0.0; 16]);
    about = cloud.may_touch::<V>(fetch(at), group.coarse[3] + grown, about, &mut cells);
    if about == 0 {
        return true;
    }
    refine::<V>(group, index, scratch);
    for (which, sphere) in group.fine.iter().enumerate() {
        let at = fetch(&scratch.fine[group.slot + which]);
        let lanes = cloud.touching::<V>(at, sphere[3] + grown, about, F::ALL);
        if lanes != 0 {
            let spheres = (which as u32, 0);
            if !visitor.touch(Contact { group: index as u32, other: Other::Cloud(number), spheres }, lanes) {
                return false;
            }
            about &= !lanes;
            if about == 0 {
                break;
            }
        }
    }
    true
}

/// Maximum and minimum coordinates of spheres in all lanes, the minimum with its sign changed.
#[inline(always)]
fn bounds<V: Lanes>([x, y, z]: [V; 3], radius: f32) -> [f32; 6] {
    let zero = V::splat(0.0);
    let peaks = V::peaks([x, y, z, zero.sub(x), zero.sub(y), zero.sub(z)]);
    std::array::from_fn(|i| peaks[i] + radius)
}

/// The mask of the obstacles of a row whose boxes overlap the bounds.
#[inline(always)]
fn overlaps<V: Lanes>(bounds: &[f32; 6], row: &Row) -> u32 {
    let mut hits = V::ALL;
    for i in 0..3 {
        hits &= V::load(&row.least[i]).below(V::splat(bounds[i]));
        hits &= V::load(&row.minus_greatest[i]).below(V::splat(bounds[3 + i]));
    }
    hits
}

#[inline(always)]
fn meets<V: Lanes>(centre: [V; 3], radius: f32, obstacle: &Obstacle) -> u32 {
    if obstacle.is_cylinder {
        meets_cylinder(centre, radius, obstacle)
    } else {
        meets_rounded(centre, radius, obstacle)
    }
}

/// A point in an obstacle's frame.
#[inline(always)]
fn local<V: Lanes>(centre: [V; 3], obstacle: &Obstacle) -> [V; 3] {
    let [x, y, z] = minus(centre, splat3(&obstacle.centre));
    let a = &obstacle.axes;
    if obstacle.upright {
        let lx = x.mul_add(V::splat(a[0]), y.mul(V::splat(a[1])));
        let ly = x.mul_add(V::splat(a[3]), y.mul(V::splat(a[4])));
        return [lx, ly, z];
    }
    let mut turned = [x, y, z];
    for row in 0..3 {
        let yz = y.mul_add(V::splat(a[3 * row + 1]), z.mul(V::splat(a[3 * row + 2])));
        turned[row] = x.mul_add(V::splat(a[3 * row]), yz);
    }
    turned
}

#[inline(always)]
fn meets_rounded<V: Lanes>(centre: [V; 3], radius: f32, obstacle: &Obstacle) -> u32 {
    let [x, y, z] = local(centre, obstacle);
    let zero = V::splat(0.0);
    let x = x.abs().sub(V::splat(obstacle.half[0])).max(zero);
    let y = y.abs().sub(V::splat(obstacle.half[1])).max(zero);
    let z = z.abs().sub(V::splat(obstacle.half[2])).max(zero);
    let reach = radius + obstacle.round;
    squared([x, y, z]).below(V::splat(reach * reach))
}

#[inline(always)]
fn meets_cylinder<V: Lanes>(centre: [V; 3], radius: f32, obstacle: &Obstacle) -> u32 {
    let [x, y, z] = local(centre, obstacle);
    let zero = V::splat(0.0);
    let beside = x.mul_add(x, y.mul(y));
    let above = z.abs().sub(V::splat(obstacle.half[2])).max(zero);
    let wide = obstacle.half[0] + radius;
    if beside.below(V::splat(wide * wide)) & above.below(V::splat(radius)) == 0 {
        return 0;
    }
    let beside = beside.sqrt().sub(V::splat(obstacle.half[0])).max(zero);
    beside.mul_add(beside, above.mul(above)).below(V::splat(radius * radius))
}

#[inline(always)]
fn meet<V: Lanes>(a: [V; 3], b: [V; 3], reach: f32) -> u32 {
    squared(minus(a, b)).below(V::splat(reach * reach))
}

/// The contacts of links with each other; the centres of the rigid parts are known.
#[inline(always)]
fn in_itself<V: Lanes, F: Visitor>(compiled: &Compiled, scratch: &mut Scratch, visitor: &mut F) -> bool {
    for pair in &compiled.pairs {
        let (i, j) = (pair.first as usize, pair.second as usize);
        let ((at_a, more_a), (at_b, more_b)) = (&scratch.rigid[i], &scratch.rigid[j]);
        let (a, b) = (&compiled.rigids[i], &compiled.rigids[j]);
        let reach = a.coarse[3] + b.coarse[3] + (more_a + more_b);
        if meet::<V>(fetch(at_a), fetch(at_b), reach) == 0 {
            continue;
        }
        for (i, j) in &pair.groups {
            if !groups_meet::<V, F>(compiled, (*i as usize, *j as usize), scratch, visitor) {
                return false;
            }
        }
    }
    true
}

/// The contacts of two groups.
#[inline(always)]
fn groups_meet<V: Lanes, F: Visitor>(
    compiled: &Compiled,
    (i, j): (usize, usize),
    scratch: &mut Scratch,
    visitor: &mut F,
) -> bool {
    approach::<V>(compiled, i, scratch);
    approach::<V>(compiled, j, scratch);
    let (a, b) = (&compiled.groups[i], &compiled.groups[j]);
    let more = scratch.coarse[i].1 + scratch.coarse[j].1;
    let (at_a, at_b) = (fetch::<V>(&scratch.coarse[i].0), fetch::<V>(&scratch.coarse[j].0));
    // The lanes in which their bounding spheres touch and no contact has been found yet.
    let mut left = meet(at_a, at_b, a.coarse[3] + b.coarse[3] + more);
    if left == 0 {
        return true;
    }
    refine::<V>(a, i, scratch);
    for (p, sphere) in a.fine.iter().enumerate() {
        let at = fetch::<V>(&scratch.fine[a.slot + p]);
        if meet(at, at_b, sphere[3] + b.coarse[3] + more) & left == 0 {
            continue;
        }
        refine::<V>(b, j, scratch);
        for (q, other) in b.fine.iter().enumerate() {
            let lanes = meet(at, fetch::<V>(&scratch.fine[b.slot + q]), sphere[3] + other[3] + more);
            if lanes != 0 {
                let spheres = (p as u32, q as u32);
                if !visitor.touch(Contact { group: i as u32, other: Other::Group(j as u32), spheres }, lanes) {
                    return false;
                }
                left &= !lanes;
                if left == 0 {
                    return true;
                }
            }
        }
    }
    true
}
