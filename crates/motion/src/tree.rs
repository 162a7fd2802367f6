//! A tree of free postures, laid out for the vector scan of `simd::nearest`.

use crate::mechanism::MAX_JOINTS;
use crate::simd::{Block, Isa};
use crate::space::{State, distance};

#[derive(Debug)]
pub(crate) struct Tree {
    isa: Isa,
    joints: usize,
    blocks: Vec<Block>,
    pub(crate) states: Vec<State>,
    pub(crate) parents: Vec<u32>,
    /// Samples farther away than this do not extend the node (dynamic domain).
    pub(crate) radii: Vec<f32>,
}

impl Tree {
    pub(crate) fn new(isa: Isa, joints: usize) -> Tree {
        Tree { isa, joints, blocks: Vec::new(), states: Vec::new(), parents: Vec::new(), radii: Vec::new() }
    }

    pub(crate) fn len(&self) -> usize {
        self.states.len()
    }

    /// Adds a node; a root is its own parent.
    pub(crate) fn push(&mut self, state: State, parent: usize) -> usize {
        let index = self.states.len();
        if index.is_multiple_of(16) {
            self.blocks.extend(std::iter::repeat_n(Block([0.0; 16]), self.joints));
            self.blocks.push(Block([f32::INFINITY; 16]));
        }
        let row = index / 16 * (self.joints + 1);
        for (block, position) in self.blocks[row..row + self.joints].iter_mut().zip(&state) {
            block.0[index % 16] = *position;
        }
        self.blocks[row + self.joints].0[index % 16] = 0.5 * state.iter().map(|q| q * q).sum::<f32>();
        self.states.push(state);
        self.parents.push(parent as u32);
        self.radii.push(f32::INFINITY);
        index
    }

    /// The nearest node and its distance.
    #[inline]
    pub(crate) fn nearest(&self, to: &State) -> (usize, f32) {
        let index = self.isa.nearest(&self.blocks, self.joints, to);
        (index, distance(&self.states[index], to))
    }

    /// The nearest node of each of up to sixteen postures, and its distance.
    pub(crate) fn nearest_each(&self, to: &[State]) -> [(usize, f32); 16] {
        let mut goals = [Block([0.0; 16]); MAX_JOINTS];
        for (lane, state) in to.iter().enumerate() {
            for (goal, position) in goals[..self.joints].iter_mut().zip(state) {
                goal.0[lane] = *position;
            }
        }
        let indices = self.isa.nearest_each(&self.blocks, &self.states, &goals[..self.joints]);
        let mut nearest = [(0, 0.0); 16];
        for ((nearest, index), to) in nearest.iter_mut().zip(indices).zip(to) {
            *nearest = (index as usize, distance(&self.states[index as usize], to));
        }
        nearest
    }

    /// The postures from a node to its root.
    pub(crate) fn branch(&self, mut node: usize) -> Vec<State> {
        let mut branch = vec![self.states[node]];
        while self.parents[node] as usize != node {
            node = self.parents[node] as usize;
            branch.push(self.states[node]);
        }
        branch
    }
}
