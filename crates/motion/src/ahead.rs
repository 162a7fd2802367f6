//! Look-ahead for a tree that is shut in: samples drawn in advance, and what is known about the motions towards them.
//!
//! Nearly all motions of such a tree are in collision, most of them at their middle, and mostly with something that was touched lately. So the
//! middles of many motions (as many as the widest batch has postures) are checked in one batch against the obstacles that are remembered, and only
//! motions that pass are checked further. Samples and results equal those of a search that checks one motion after the other. What is known of a
//! sample stays known while the tree grows, unless a new node is nearer to the sample.

use crate::space::{Space, State, WIDEST, between, distance, towards};
use crate::tree::Tree;

/// Maximum number of samples drawn ahead. There has to be a bound: samples that are too far from a tree make no motion.
const MOST: usize = 8 * WIDEST;

/// A sample.
#[derive(Clone, Copy)]
pub(crate) struct Drawn {
    pub(crate) sample: State,
    /// The nearest node and its distance, if known.
    pub(crate) nearest: Option<(usize, f32)>,
    /// A motion towards the sample of at most this length is known to be in collision.
    pub(crate) touches: Option<f32>,
}

impl Drawn {
    fn new(sample: State) -> Drawn {
        Drawn { sample, nearest: None, touches: None }
    }
}

pub(crate) struct Ahead<S> {
    sample: S,
    /// In the order of drawing; those before `next` are used up.
    drawn: Vec<Drawn>,
    next: usize,
    /// The motions towards the samples before this index have been checked.
    looked_at: usize,
    /// Index of the tree that the results belong to.
    which: usize,
}

impl<S: FnMut() -> State> Ahead<S> {
    pub(crate) fn new(sample: S) -> Ahead<S> {
        Ahead { sample, drawn: Vec::new(), next: 0, looked_at: 0, which: 0 }
    }

    /// Returns the next sample, with what is known of it for this tree.
    pub(crate) fn next(&mut self, which: usize) -> Drawn {
        if self.next == self.drawn.len() {
            return Drawn::new((self.sample)());
        }
        self.next += 1;
        let drawn = self.drawn[self.next - 1];
        if self.which == which { drawn } else { Drawn::new(drawn.sample) }
    }

    pub(crate) fn knows_next(&self, which: usize) -> bool {
        self.which == which && self.next < self.looked_at
    }

    /// Reports that a tree has new nodes, from the index `first` on.
    pub(crate) fn grown(&mut self, which: usize, tree: &Tree, first: usize) {
        if self.which != which {
            return;
        }
        for drawn in &mut self.drawn[self.next..] {
            let Some((_, mut least)) = drawn.nearest else { continue };
            for (node, state) in tree.states.iter().enumerate().skip(first) {
                let far = distance(state, &drawn.sample);
                if far < least {
                    least = far;
                    (drawn.nearest, drawn.touches) = (Some((node, far)), None);
                }
            }
        }
    }

    /// Checks the motions of a tree towards at most `wanted` next samples. `step` returns the maximum length of a motion from the number of
    /// samples that come before it and the domain radius of its node.
    pub(crate) fn look(
        &mut self,
        space: &mut Space,
        (which, tree): (usize, &Tree),
        wanted: usize,
        step: impl Fn(usize, f32) -> f32,
    ) {
        self.drawn.drain(..self.next);
        self.next = 0;
        if self.which != which {
            self.which = which;
            self.drawn.iter_mut().for_each(|drawn| *drawn = Drawn::new(drawn.sample));
        }
        let mut middles = [[0.0; _]; WIDEST];
        let mut motions = [(0, 0.0); WIDEST];
        let (mut count, mut after) = (0, 0);
        while count < WIDEST && after < wanted.min(MOST) {
            if after == self.drawn.len() || self.drawn[after].nearest.is_none() {
                self.find_nearest(tree, after, wanted);
            }
            let drawn = &self.drawn[after];
            let (near, far) = drawn.nearest.unwrap_or_default();
            if far <= tree.radii[near] {
                let step = step(after, tree.radii[near]);
                let from = &tree.states[near];
                // The check of the whole motion has this posture, too.
                middles[count] = between(from, &towards(from, &drawn.sample, far, step), 0.5);
                motions[count] = (after, step);
                count += 1;
            }
            after += 1;
        }
        self.looked_at = after;
        if count == 0 {
            return;
        }
        let touching = space.touching_again(&middles[..count]);
        for (lane, (after, step)) in motions[..count].iter().enumerate() {
            self.drawn[*after].touches = (touching >> lane & 1 != 0).then_some(*step);
        }
    }

    /// Finds the nearest nodes of the next samples, beginning with the index `from`.
    fn find_nearest(&mut self, tree: &Tree, from: usize, wanted: usize) {
        let end = wanted.min(from + WIDEST);
        while self.drawn.len() < end {
            self.drawn.push(Drawn::new((self.sample)()));
        }
        let mut samples = [[0.0; _]; WIDEST];
        for (sample, drawn) in samples.iter_mut().zip(&self.drawn[from..end]) {
            *sample = drawn.sample;
        }
        let nearest = tree.nearest_each(&samples[..end - from]);
        for (drawn, nearest) in self.drawn[from..end].iter_mut().zip(nearest) {
            drawn.nearest = Some(nearest);
        }
    }
}

#[cfg(test)]
mod tests;
