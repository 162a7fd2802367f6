//! Samples drawn ahead for a tree that is shut in, and what is known of its motions towards them.
//!
//! Nearly all motions of such a tree touch something, most of them in their middle, and mostly something that was touched lately. So the middles of as
//! many motions as the widest batch has postures are looked at together beside what is remembered, and only motions that are free of that are looked
//! at further. Samples and answers are those of a search that looks at one motion after the other. What is known stays known while the tree grows,
//! but for samples that a new node is nearer to.

use crate::space::{Space, State, WIDEST, between, distance, towards};
use crate::tree::Tree;

/// Samples drawn ahead at most: those that are too far from a tree make no motion.
const MOST: usize = 8 * WIDEST;

/// A sample.
#[derive(Clone, Copy)]
pub(crate) struct Drawn {
    pub(crate) sample: State,
    /// The nearest node and its distance, where that is known.
    pub(crate) nearest: Option<(usize, f32)>,
    /// A motion towards it of at most this length touches something.
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
    /// The motions towards those before this one were looked at.
    looked_at: usize,
    /// Of which tree.
    which: usize,
}

impl<S: FnMut() -> State> Ahead<S> {
    pub(crate) fn new(sample: S) -> Ahead<S> {
        Ahead { sample, drawn: Vec::new(), next: 0, looked_at: 0, which: 0 }
    }

    /// The next sample, with what is known of it for this tree.
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

    /// A tree has new nodes, from this one on.
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

    /// Looks at the motions of a tree towards the next samples, of which at most so many are wanted. `step` has how long a motion is at most, by
    /// how many samples come before it and by the radius of its node's domain.
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
                // Also one of the postures that a look at the whole motion has.
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

    /// Finds the nearest nodes of the next samples from this one on.
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
