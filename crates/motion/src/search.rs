//! RRT-Connect (Kuffner and LaValle, 2000): two trees, from the start and from the goals, grow towards random postures and
//! towards each other.
//!
//! Trees of this robot's problems stay small (tens to hundreds of nodes), so the nearest node is found by a linear scan.

use crate::collision::{Checker, Contact, between, distance};
use crate::pace::{Pace, Stop};
use crate::robot::Joints;

/// The longest edge, in radians.
const EDGE_RAD: f64 = 1.0;

/// A tree of postures; roots have themselves as parent.
struct Tree {
    nodes: Vec<Joints>,
    parents: Vec<usize>,
}

enum Extension {
    Blocked,
    Advanced(usize),
    Reached(usize),
}

impl Tree {
    fn of(roots: &[Joints]) -> Tree {
        Tree { nodes: roots.to_vec(), parents: (0..roots.len()).collect() }
    }

    fn nearest(&self, to: &Joints) -> usize {
        let square = |q: &Joints| (0..7).map(|j| (q[j] - to[j]).powi(2)).sum::<f64>();
        let mut best = (0, f64::INFINITY);
        for (i, node) in self.nodes.iter().enumerate() {
            let d = square(node);
            if d < best.1 {
                best = (i, d);
            }
        }
        best.0
    }

    fn extend(&mut self, from: usize, to: &Joints, checker: &mut Checker<'_>) -> Extension {
        let here = self.nodes[from];
        let far = distance(&here, to);
        let (next, whole) = if far > EDGE_RAD { (between(&here, to, EDGE_RAD / far), false) } else { (*to, true) };
        if !checker.edge_is_free(&here, &next, Contact::None) {
            return Extension::Blocked;
        }
        self.nodes.push(next);
        self.parents.push(from);
        let added = self.nodes.len() - 1;
        if whole { Extension::Reached(added) } else { Extension::Advanced(added) }
    }

    /// From a node to its root.
    fn branch(&self, mut node: usize) -> (Vec<Joints>, usize) {
        let mut postures = vec![self.nodes[node]];
        while self.parents[node] != node {
            node = self.parents[node];
            postures.push(self.nodes[node]);
        }
        (postures, node)
    }
}

/// A path from `start` to one of `goals` and that goal's index; `None` after `iterations` without one. All ends are free.
///
/// # Errors
/// [`Stop`] as soon as the caller says so.
pub(crate) fn search(
    checker: &mut Checker<'_>,
    start: &Joints,
    goals: &[Joints],
    iterations: usize,
    sample: &mut dyn FnMut() -> Joints,
    pace: &mut Pace<'_>,
) -> Result<Option<(Vec<Joints>, usize)>, Stop> {
    let mut trees = [Tree::of(&[*start]), Tree::of(goals)];
    let mut growing = 0;
    for _ in 0..iterations {
        pace.iteration()?;
        let towards = sample();
        let from = trees[growing].nearest(&towards);
        if let Extension::Advanced(node) | Extension::Reached(node) = trees[growing].extend(from, &towards, checker) {
            let towards = trees[growing].nodes[node];
            let other = 1 - growing;
            let mut from = trees[other].nearest(&towards);
            loop {
                pace.poll()?;
                match trees[other].extend(from, &towards, checker) {
                    Extension::Blocked => break,
                    Extension::Advanced(next) => from = next,
                    Extension::Reached(meeting) => {
                        let ends = if growing == 0 { [node, meeting] } else { [meeting, node] };
                        let (mut path, _) = trees[0].branch(ends[0]);
                        path.reverse();
                        let (rest, goal) = trees[1].branch(ends[1]);
                        path.extend(rest.into_iter().skip(1));
                        return Ok(Some((path, goal)));
                    }
                }
            }
        }
        growing = usize::from(trees[0].nodes.len() > trees[1].nodes.len());
    }
    Ok(None)
}
