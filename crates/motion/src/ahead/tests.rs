//! Tests that the results that were computed ahead are correct.

use super::*;
use crate::ball;
use crate::geometry::Geometry;
use crate::mechanism::Mechanism;
use crate::simd::Isa;
use crate::space::Obstacle;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;

const STEP: f32 = 0.8;

fn samples() -> impl FnMut() -> State {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    move || std::array::from_fn(|j| if j < 2 { random.random_range(-1.5..1.5) } else { 0.0 })
}

/// A ball among nine posts.
fn posts(isa: Isa) -> Space {
    let mechanism = Mechanism::read(&ball::urdf(2), None, &[]).expect("a robot");
    let post = |i: i32| {
        let pose = Pose::at(f64::from(i % 3 - 1) * 0.6, f64::from(i / 3 - 1) * 0.6, 0.0);
        Obstacle { name: format!("post {i}"), pose, geometry: Geometry::Cylinder { radius: 0.2, half_length: 1.0 } }
    };
    Space::with_isa(&mechanism, &(0..9).map(post).collect::<Vec<_>>(), isa)
}

#[test]
fn what_is_known_ahead_is_what_a_look_at_each_motion_finds() {
    for isa in Isa::available() {
        let mut space = posts(isa);
        let mut tree = Tree::new(isa, space.joints());
        let root: State = std::array::from_fn(|j| if j < 2 { 0.3 } else { 0.0 });
        tree.push(root, 0);
        let (mut ahead, mut plain) = (Ahead::new(samples()), samples());
        let (mut touching, mut far_away, mut free) = (0, 0, 0);
        for round in 0..300 {
            if round == 100 {
                tree.push(std::array::from_fn(|j| if j == 0 { 1.4 } else { 0.0 }), 0);
                tree.radii[0] = 0.7;
                ahead.grown(0, &tree, 1);
            }
            if !ahead.knows_next(0) {
                ahead.look(&mut space, (0, &tree), 300 - round, |_, _| STEP);
            }
            assert!(!ahead.knows_next(1));
            let drawn = ahead.next(0);
            assert_eq!(drawn.sample, plain(), "sample {round}, {isa:?}");
            let (near, far) = tree.nearest(&drawn.sample);
            assert_eq!(drawn.nearest, Some((near, far)), "sample {round}, {isa:?}");
            if far > tree.radii[near] {
                far_away += 1;
                continue;
            }
            let to = towards(&tree.states[near], &drawn.sample, far, STEP);
            let is_free = space.is_free_motion(&tree.states[near], &to);
            free += usize::from(is_free);
            if drawn.touches == Some(STEP) {
                assert!(!is_free, "sample {round}, {isa:?}");
                touching += 1;
            }
        }
        assert!(touching > 50 && far_away > 10 && free > 10, "{touching}, {far_away}, {free}, {isa:?}");
        // No sample was drawn that was not used.
        assert_eq!(ahead.next(1).sample, plain());
    }
}
