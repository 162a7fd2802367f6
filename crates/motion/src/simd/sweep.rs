//! Straight motions, looked at in postures ([`is_free`]) or in the whole stretches between these ([`near`]).
//!
//! A stretch is looked at again only beside what was near it. Its spheres are grown by how far they can move within it, and a walk notes what
//! they touch then; what they do not touch is out of reach of every posture of the stretch. So a finer look at it, be it by shorter stretches or by
//! postures, needs the noted alone ([`Among`]), and where nothing was noted the stretch is free. The answer is that of a look at
//! everything: a sphere that touches in a posture has a grown one that touched.
//!
//! Motions of the search are postures alone, and what is near them is not noted: most end in the first batch or have few.

use super::kernel::{self, Among, Compiled, Contact, Edge, First, LENGTH, Other, Scratch, Visitor};
use super::lanes::{Block, Lanes};

/// How spheres move with each joint: of each joint a list over the rigid parts, then the groups, so that many are added up at once.
#[derive(Debug, Clone, Default)]
pub(crate) struct Spans {
    /// How far they turn for one radian; zero for joints that slide.
    pub(crate) turns: Vec<Vec<f32>>,
    /// How far a point of them moves at most for one radian; for one metre of a joint that slides, twice that.
    pub(crate) ways: Vec<Vec<f32>>,
    /// Of each rigid part and group, the radius of its bounding sphere.
    pub(crate) radii: Vec<f32>,
}

/// Something that a group touches in some lanes, a bit each, when its spheres are grown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Near {
    pub(super) group: u32,
    pub(super) other: Other,
    pub(super) lanes: u32,
}

/// Notes all that is touched.
struct Notes<'a>(&'a mut Vec<Near>);

impl Visitor for Notes<'_> {
    const ALL: bool = true;

    #[inline(always)]
    fn touch(&mut self, Contact { group, other, .. }: Contact, lanes: u32) -> bool {
        // The spheres of a group come one after the other.
        match self.0.last_mut() {
            Some(last) if last.group == group && last.other == other => last.lanes |= lanes,
            _ => self.0.push(Near { group, other, lanes }),
        }
        true
    }
}

/// How much larger spheres are than they are, beside half of the greatest step of their bounding sphere: for each rigid part, then each group.
#[derive(Debug, Clone)]
pub(super) struct Growth {
    by: Vec<f32>,
    turned: Vec<f32>,
    /// For postures alone nothing grows.
    is_on: bool,
}

impl Growth {
    pub(super) fn new(spans: &Spans) -> Growth {
        let none = vec![0.0; spans.radii.len()];
        Growth { by: none.clone(), turned: none, is_on: false }
    }

    /// As far as anything moves in this part of a motion, half of the way from lane to lane.
    #[inline(always)]
    fn set(&mut self, spans: &Spans, delta: &[f32; LENGTH], part: f32) {
        self.is_on = true;
        add_up(&spans.turns, delta, part, &mut self.turned);
        add_up(&spans.ways, delta, part, &mut self.by);
        for ((by, turned), radius) in self.by.iter_mut().zip(&self.turned).zip(&spans.radii) {
            // The second derivative by two joints that turn is no longer than the lever of the later one. The mean speed of a
            // step differs from that anywhere in it and half a step beyond by what it changes in one step at most.
            let bend = 2.0 * turned * *by;
            // Points beside the centre of the bounding sphere turn about it.
            *by = bend + turned * radius;
        }
    }

    /// How much larger the spheres about a centre are in this batch.
    #[inline(always)]
    pub(super) fn of<V: Lanes>(&self, index: usize, centre: &[Block; 3]) -> f32 {
        if self.is_on { self.by[index] + 0.5 * greatest_step(centre, V::WIDTH) } else { 0.0 }
    }
}

#[inline(always)]
fn add_up(spans: &[Vec<f32>], delta: &[f32; LENGTH], part: f32, to: &mut [f32]) {
    to.fill(0.0);
    for (spans, delta) in spans.iter().zip(delta) {
        let by = delta.abs() * part;
        for (sum, span) in to.iter_mut().zip(spans) {
            *sum += span * by;
        }
    }
}

/// How far a point goes from one lane to the next at most.
#[inline(always)]
fn greatest_step(point: &[Block; 3], width: usize) -> f32 {
    let mut squares = [0.0_f32; 15];
    for Block(along) in point {
        for (i, square) in squares.iter_mut().enumerate() {
            let step = along[i + 1] - along[i];
            *square += step * step;
        }
    }
    squares[..width - 1].iter().fold(0.0, |most: f32, square| if *square > most { *square } else { most }).sqrt()
}

/// Whether no posture touches anything.
#[inline(always)]
pub(super) fn is_free<V: Lanes>(edge: &Edge<'_>, scratch: &mut Scratch) -> bool {
    let Among { depth, lanes } = edge.among;
    scratch.growth.is_on = false;
    for batch in 0..edge.batches {
        kernel::pose::<V>(edge, batch, scratch);
        if batch == 0 && kernel::touches_again::<V>(edge.compiled, scratch) {
            return false;
        }
        let mut first = First::default();
        let is_free = if depth == 0 {
            kernel::walk::<V, _>(edge.compiled, scratch, &mut first)
        } else {
            let near = std::mem::take(&mut scratch.near[depth - 1]);
            let is_free = kernel::walk_among::<V, _>(edge.compiled, (&near, lanes), scratch, &mut first);
            scratch.near[depth - 1] = near;
            is_free
        };
        if !is_free {
            scratch.remember(first);
            return false;
        }
    }
    true
}

/// In which of up to sixteen postures one of the remembered contacts is there again, a bit each; of each joint a block. The postures have nothing to
/// do with each other.
#[inline(always)]
pub(super) fn touching_again<V: Lanes>(
    compiled: &Compiled,
    positions: &[Block],
    count: usize,
    scratch: &mut Scratch,
) -> u32 {
    let mut touching = 0;
    for part in 0..count.div_ceil(V::WIDTH) {
        let lanes = V::ALL >> V::WIDTH.saturating_sub(count - part * V::WIDTH);
        kernel::pose_each::<V>(compiled, positions, part, scratch);
        touching |= kernel::all_touching_again::<V>(compiled, lanes, scratch) << (part * V::WIDTH);
    }
    touching
}

/// Which steps of a batch may touch something, a bit each. What they may touch is in the list of this depth then.
#[inline(always)]
pub(super) fn near<V: Lanes>(edge: &Edge<'_>, scratch: &mut Scratch) -> u32 {
    let Among { depth, lanes } = edge.among;
    // Each posture stands for the step that it is in the middle of: nothing is further than half a step from one.
    let part = 0.5 / V::WIDTH as f32;
    let start: [f32; LENGTH] = std::array::from_fn(|joint| edge.start[joint] - edge.delta[joint] * part);
    let edge = &Edge { start: &start, ..*edge };
    scratch.growth.set(&edge.compiled.spans, edge.delta, part);
    kernel::pose::<V>(edge, 0, scratch);
    let mut found = std::mem::take(&mut scratch.near[depth]);
    found.clear();
    if depth == 0 {
        kernel::walk::<V, _>(edge.compiled, scratch, &mut Notes(&mut found));
    } else {
        let before = std::mem::take(&mut scratch.near[depth - 1]);
        kernel::walk_among::<V, _>(edge.compiled, (&before, lanes), scratch, &mut Notes(&mut found));
        scratch.near[depth - 1] = before;
    }
    let doubtful = found.iter().fold(0, |lanes, near| lanes | near.lanes);
    scratch.near[depth] = found;
    doubtful
}
