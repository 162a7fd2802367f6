//! Collision check of straight motions, in postures ([`is_free`]) or in whole stretches between them ([`near`]).
//!
//! A finer check of a stretch uses only what was near it in the coarser check. The spheres of a stretch are enlarged by how far they can move
//! within it, and a walk notes what they touch then; what they do not touch is out of reach of every posture of the stretch. So a finer check, by
//! shorter stretches or by postures, needs only what was noted ([`Among`]), and if nothing was noted the stretch is free. The result is that of a
//! check against everything: a sphere that touches something in a posture has an enlarged sphere that touched it, too.
//!
//! The motions of the search are checked in postures only and what is near is not noted: most end in the first batch or have few batches.

use super::kernel::{self, Among, Compiled, Contact, Edge, First, LENGTH, Other, Scratch, Visitor};
use super::lanes::{Block, Lanes};

/// Bounds for the motion of spheres per joint: for each joint a list over the rigid parts and then the groups, so that many are added at once.
#[derive(Debug, Clone, Default)]
pub(crate) struct Spans {
    /// Rotation for one radian; zero for prismatic joints.
    pub(crate) turns: Vec<Vec<f32>>,
    /// Maximum motion of a point for one radian; for one metre of a prismatic joint, twice that.
    pub(crate) ways: Vec<Vec<f32>>,
    /// Radius of the bounding sphere of each rigid part and group.
    pub(crate) radii: Vec<f32>,
}

/// Something that a group touches when its spheres are enlarged, with the mask of the lanes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Near {
    pub(super) group: u32,
    pub(super) other: Other,
    pub(super) lanes: u32,
}

/// A visitor that notes all contacts.
struct Notes<'a>(&'a mut Vec<Near>);

impl Visitor for Notes<'_> {
    const ALL: bool = true;

    #[inline(always)]
    fn touch(&mut self, Contact { group, other, .. }: Contact, lanes: u32) -> bool {
        // Contacts of one group come one after the other.
        match self.0.last_mut() {
            Some(last) if last.group == group && last.other == other => last.lanes |= lanes,
            _ => self.0.push(Near { group, other, lanes }),
        }
        true
    }
}

/// Enlargement of the spheres in addition to half of the maximum step of their bounding sphere: for each rigid part, then each group.
#[derive(Debug, Clone)]
pub(super) struct Growth {
    by: Vec<f32>,
    turned: Vec<f32>,
    /// Without this, for postures only, nothing is enlarged.
    is_on: bool,
}

impl Growth {
    pub(super) fn new(spans: &Spans) -> Growth {
        let none = vec![0.0; spans.radii.len()];
        Growth { by: none.clone(), turned: none, is_on: false }
    }

    /// Sets the enlargement for a part of a motion: half of the way from lane to lane.
    #[inline(always)]
    fn set(&mut self, spans: &Spans, delta: &[f32; LENGTH], part: f32) {
        self.is_on = true;
        add_up(&spans.turns, delta, part, &mut self.turned);
        add_up(&spans.ways, delta, part, &mut self.by);
        for ((by, turned), radius) in self.by.iter_mut().zip(&self.turned).zip(&spans.radii) {
            // The second derivative by two rotating joints is at most the lever of the later one. The mean speed of a step differs from the speed
            // anywhere in it, and half a step beyond, by at most its change in one step.
            let bend = 2.0 * turned * *by;
            // Points away from the centre of the bounding sphere rotate about it.
            *by = bend + turned * radius;
        }
    }

    /// The enlargement of the spheres with this centre in this batch.
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

/// Maximum motion of a point from one lane to the next.
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

/// Whether all postures are free of collisions.
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

/// The mask of up to sixteen independent postures in which one of the remembered contacts occurs again; one block per joint.
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

/// The mask of the steps of a batch that may be in collision. What they may touch is in the list of this depth afterwards.
#[inline(always)]
pub(super) fn near<V: Lanes>(edge: &Edge<'_>, scratch: &mut Scratch) -> u32 {
    let Among { depth, lanes } = edge.among;
    // Each posture stands for the step around it: nothing is further than half a step from a posture.
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
