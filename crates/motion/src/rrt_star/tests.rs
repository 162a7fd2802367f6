//! Tests that the tree is a tree, and that its costs are the lengths of its paths.

use super::*;
use crate::ball;
use crate::geometry::Geometry;
use crate::mechanism::Mechanism;
use crate::space::Obstacle;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;

impl RrtStar {
    /// Every node is below the root, has the right children, and costs as much as its parent plus the motion from there.
    fn check_invariants(&self) {
        let (mut seen, mut open) = (vec![false; self.nodes.len()], vec![0]);
        while let Some(index) = open.pop() {
            assert!(!seen[index], "node {index} is reached twice");
            seen[index] = true;
            let node = &self.nodes[index];
            for child in &node.children {
                let below = &self.nodes[*child];
                assert_eq!(below.parent, index, "the parent of {child}");
                assert_eq!(below.cost, node.cost + below.edge, "the cost of {child}");
                assert!((below.edge - distance(&node.state, &below.state)).abs() < 1e-5, "the motion to {child}");
                open.push(*child);
            }
            for joint in 0..self.joints {
                let row = &self.rows[index / WIDTH * self.joints + joint];
                assert_eq!(row[index % WIDTH], node.state[joint], "the row of {index}");
            }
        }
        assert!(seen.iter().all(|seen| *seen), "a node does not hang on the root");
        assert_eq!((self.nodes[0].cost, self.nodes[0].parent), (0.0, 0));
    }
}

fn go_on(_: usize) -> Control {
    Control::Continue
}

fn state(x: f32, y: f32) -> State {
    std::array::from_fn(|j| [x, y].get(j).copied().unwrap_or(0.0))
}

/// A ball between posts.
fn posts() -> Space {
    let mechanism = Mechanism::read(&ball::urdf(2), None, &[]).unwrap();
    let post = |i: i32| {
        let pose = Pose::at(f64::from(i % 3 - 1) * 0.6, f64::from(i / 3 - 1) * 0.6, 0.0);
        Obstacle { name: format!("post {i}"), pose, geometry: Geometry::Cylinder { radius: 0.2, half_length: 1.0 } }
    };
    Space::new(&mechanism, &(0..9).map(post).collect::<Vec<_>>())
}

fn ends() -> Vec<End> {
    let end = |x, y, rest| End { state: state(x, y), rest, rest_s: 0.0 };
    vec![end(1.5, 1.5, 0.0), end(1.5, -1.5, 0.3), end(0.3, 1.4, 1.0)]
}

#[test]
fn costs_are_kept_and_no_circle_comes_about_whatever_is_rewired_evicted_or_taken_in() {
    let mut space = posts();
    for seed in 0..6 {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut tree = RrtStar::new(&state(-1.5, -1.5), 2);
        tree.most = if seed % 2 == 0 { 120 } else { MAX_NODES };
        let all = ends();
        let mut best = f32::INFINITY;
        for round in 0..150 {
            // A new end is added from time to time.
            let ends = &all[..(1 + round / 40).min(3)];
            tree.grow(&mut space, ends, 9.0, 5, &mut random, &mut go_on).unwrap();
            if round == 70 {
                let outside = [state(-1.5, -1.5), state(-1.5, 1.5), state(1.5, 1.5)];
                tree.adopt(&outside, ends, 0);
            }
            tree.check_invariants();
            assert!(tree.len() <= tree.most + ends.len());
            for (index, node) in tree.ends.iter().enumerate() {
                assert!(node.is_none_or(|node| tree.nodes[node].state == all[index].state));
            }
            if let Some((end, length)) = tree.best(ends) {
                assert!(length <= best, "the best way was lost");
                best = length;
                let path = tree.path(end).unwrap();
                let walked: f32 = path.windows(2).map(|pair| distance(&pair[0], &pair[1])).sum();
                assert!((walked + ends[end].rest - length).abs() < 1e-4);
                assert!(path.windows(2).all(|pair| space.is_free_motion(&pair[0], &pair[1])));
            }
        }
        assert!(best < 5.0, "{best}");
    }
}

#[test]
fn as_long_as_none_has_to_go_no_node_ever_costs_more_than_before() {
    let mut space = posts();
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let mut tree = RrtStar::new(&state(-1.5, -1.5), 2);
    let (mut before, mut turned): (Vec<(f32, usize)>, usize) = (Vec::new(), 0);
    // Inside a post: no path reaches it, so none bounds the search.
    let nowhere = [End { state: state(0.6, 0.6), rest: 0.0, rest_s: 0.0 }];
    for _ in 0..200 {
        tree.grow(&mut space, &nowhere, 9.0, 5, &mut random, &mut go_on).unwrap();
        assert_eq!(tree.best(&nowhere), None);
        for (index, (cost, parent)) in before.iter().enumerate() {
            assert!(tree.nodes[index].cost <= *cost, "node {index}");
            turned += usize::from(tree.nodes[index].parent != *parent);
        }
        before = tree.nodes.iter().map(|node| (node.cost, node.parent)).collect();
    }
    assert!(before.len() > 300 && turned > 100, "{} nodes, {turned} turned", before.len());
}

#[test]
fn it_grows_in_the_same_way_from_the_same_seed_and_stops_when_it_is_told() {
    let mut space = posts();
    let mut grow = |samples: usize| {
        let mut random = ChaCha8Rng::seed_from_u64(9);
        let mut tree = RrtStar::new(&state(-1.5, -1.5), 2);
        let mut stop = |asked: usize| if asked == samples { Control::Cancelled } else { Control::Continue };
        let grown = tree.grow(&mut space, &ends(), 9.0, 400, &mut random, &mut stop);
        assert_eq!(grown, if samples < 400 { Err(Control::Cancelled) } else { Ok(()) });
        tree.check_invariants();
        let (end, _) = tree.best(&ends()).unwrap();
        (tree.len(), tree.path(end))
    };
    assert_eq!(grow(400), grow(400));
    assert!(grow(300).0 < grow(400).0);
}
