//! Plans for robots with several arms: first one arm moves while the others stand, then the next (prioritized planning: Erdmann and Lozano-Pérez,
//! 1987). Each search has only the joints of one branch, so its samples fill seven dimensions instead of fourteen. At the end the motions are made
//! simultaneous where that is free. If no order of the branches leads to the goal, the caller searches with all joints.

use crate::mechanism::MAX_JOINTS;
use crate::space::{Space, State, between, distance};

/// Delay of a branch's motion after the start of the one before, as a share of its duration, in the order of trying.
const DELAYS: [f32; 4] = [0.0, 0.25, 0.5, 0.75];

/// The joints of each branch: two joints belong to the same branch if one of them moves the other. Joints that move several branches belong to the
/// first one. `parents` has, for each joint, the next joint towards the root.
pub(crate) fn branches(parents: &[Option<usize>]) -> Vec<Vec<usize>> {
    let joints = parents.len();
    let mut children = vec![0; joints];
    for parent in parents.iter().flatten() {
        children[*parent] += 1;
    }
    // A trunk joint has a fork at its end or further towards the leaves.
    let mut is_trunk: Vec<bool> = children.iter().map(|c| *c > 1).collect();
    for mut joint in 0..joints {
        let forked = is_trunk[joint];
        while let Some(parent) = parents[joint].filter(|_| forked) {
            is_trunk[parent] = true;
            joint = parent;
        }
    }
    let mut found: Vec<Vec<usize>> = Vec::new();
    let root = |mut joint: usize| {
        while let Some(parent) = parents[joint].filter(|p| !is_trunk[*p]) {
            joint = parent;
        }
        joint
    };
    let mut roots: Vec<usize> = Vec::new();
    for joint in (0..joints).filter(|j| !is_trunk[*j]) {
        let root = root(joint);
        match roots.iter().position(|r| *r == root) {
            Some(branch) => found[branch].push(joint),
            None => {
                roots.push(root);
                found.push(vec![joint]);
            }
        }
    }
    if let Some(first) = found.first_mut() {
        first.extend((0..joints).filter(|j| is_trunk[*j]));
    }
    found
}

/// A state with some joints taken from another.
pub(crate) fn with(state: &State, other: &State, joints: &[usize]) -> State {
    let mut mixed = *state;
    for &joint in joints {
        mixed[joint] = other[joint];
    }
    mixed
}

/// The motions of the branches, one after the other, or simultaneous where that is free; each path moves other joints.
pub(crate) fn together(space: &mut Space, paths: &[Vec<State>]) -> Vec<State> {
    let mut whole = paths[0].clone();
    for path in &paths[1..] {
        let joined = DELAYS.iter().map(|delay| merged(&whole, path, *delay));
        let free = joined.into_iter().find(|path| path.windows(2).all(|p| space.is_free_motion(&p[0], &p[1])));
        match free {
            Some(path) => whole = path,
            None => whole.extend_from_slice(&path[1..]),
        }
    }
    whole
}

/// Merges two consecutive paths that move different joints; the second begins `delay` after the first, as a share of its duration.
fn merged(first: &[State], second: &[State], delay: f32) -> Vec<State> {
    let (times, others) = (times(first, 0.0), times(second, delay));
    let mut all: Vec<f32> = times.iter().chain(&others).copied().collect();
    all.sort_by(f32::total_cmp);
    all.dedup_by(|a, b| (*a - *b).abs() < 1e-4);
    let here = first[first.len() - 1];
    let joined = |time: &f32| {
        let (a, b) = (at(first, &times, *time), at(second, &others, *time));
        // The second path starts at the end of the first one, except for its own joints.
        std::array::from_fn::<f32, MAX_JOINTS, _>(|j| a[j] + b[j] - here[j])
    };
    let mut path: Vec<State> = all.iter().map(joined).collect();
    let last = path.len() - 1;
    (path[0], path[last]) = (first[0], second[second.len() - 1]);
    path
}

/// The times at which a path reaches its postures, if it takes one unit of time after a delay.
fn times(path: &[State], delay: f32) -> Vec<f32> {
    let mut times = vec![0.0];
    for pair in path.windows(2) {
        times.push(times[times.len() - 1] + distance(&pair[0], &pair[1]));
    }
    let whole = times[times.len() - 1].max(f32::MIN_POSITIVE);
    times.into_iter().map(|time| delay + time / whole).collect()
}

fn at(path: &[State], times: &[f32], time: f32) -> State {
    let next = times.iter().position(|t| *t > time).unwrap_or(times.len());
    match next {
        0 => path[0],
        next if next == times.len() => path[path.len() - 1],
        next => {
            let fraction = (time - times[next - 1]) / (times[next] - times[next - 1]).max(f32::MIN_POSITIVE);
            between(&path[next - 1], &path[next], fraction)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arms_on_a_trunk_are_branches_and_the_trunk_is_of_the_first() {
        let chain = [None, Some(0), Some(1)];
        assert_eq!(branches(&chain), [[0, 1, 2]]);
        let two = [None, Some(0), None, Some(2)];
        assert_eq!(branches(&two), [[0, 1], [2, 3]]);
        let humanoid = [None, Some(0), Some(1), Some(0), Some(3)];
        assert_eq!(branches(&humanoid), [vec![1, 2, 0], vec![3, 4]]);
        // A fork far from the root makes all joints before it a trunk.
        let hand = [None, Some(0), Some(1), Some(1)];
        assert_eq!(branches(&hand), [vec![2, 0, 1], vec![3]]);
    }

    #[test]
    fn paths_made_together_keep_their_ends_and_their_order() {
        let posture = |a: f32, b: f32| std::array::from_fn(|j| [a, b].get(j).copied().unwrap_or(0.0));
        let first = [posture(0.0, 0.0), posture(2.0, 0.0), posture(1.0, 0.0)];
        let second = [posture(1.0, 0.0), posture(1.0, 4.0)];
        let joined = merged(&first, &second, 0.0);
        assert_eq!(joined.len(), 3);
        assert_eq!((joined[0], joined[2]), (first[0], second[1]));
        assert!((joined[1][0] - 2.0).abs() < 1e-5 && (joined[1][1] - 8.0 / 3.0).abs() < 1e-5);
        let later = merged(&first, &second, 0.5);
        assert!(later.windows(2).all(|p| p[0][1] <= p[1][1]) && later.len() == 5);
    }
}
