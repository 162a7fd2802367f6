//! Paths get shorter, as short as they can be: where the shortest way is known, and where it is on the other side.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

#[path = "common/ball.rs"]
mod ball;

use ball::RADIUS;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::exact::Exact;
use ratn_motion::geometry::Geometry;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::mechanism::Mechanism;
use ratn_motion::pace::Control;
use ratn_motion::refine::{End, Measure, Refinement, Shares};
use ratn_motion::robot::Joint;
use ratn_motion::rrt_star::RrtStar;
use ratn_motion::simplify::path_length;
use ratn_motion::space::{Obstacle, Space, State};
use ratn_motion::timing::rough::Rough;
use ratn_motion::timing::{Section, timed};

const NONE: Shares = Shares { shortcut: 0, corner: 0, turn: 0, search: 0, tree: 0 };

fn go_on(_: usize) -> Control {
    Control::Continue
}

fn at<const N: usize>(positions: [f32; N]) -> State {
    std::array::from_fn(|j| positions.get(j).copied().unwrap_or(0.0))
}

fn ball(axes: usize) -> Mechanism {
    Mechanism::read(&ball::urdf(axes), None, &[]).unwrap()
}

/// From 1 m before it to 1 m behind: 0.6 m to its lower end, 1.2 m to its upper end.
fn wall() -> [Obstacle; 1] {
    let geometry = Geometry::Box { half: [0.1, 0.9, 5.0] };
    [Obstacle { name: "wall".into(), pose: Pose::at(0.0, 0.3, 0.0), geometry }]
}

/// Round an end of the wall that is `aside` away: to its corner, round it at the radius of the ball, along its end, and back.
fn round_the_end(aside: f64) -> f64 {
    let corner = 0.9_f64.hypot(aside);
    let turn = (aside / 0.9).atan() + (RADIUS / corner).asin();
    2.0 * ((corner * corner - RADIUS * RADIUS).sqrt() + RADIUS * turn) + 0.2
}

/// A path round the end that is farther away.
fn above() -> Vec<State> {
    vec![at([-1.0, 0.0]), at([-0.3, 1.5]), at([0.3, 1.5]), at([1.0, 0.0])]
}

fn assert_untouched(mechanism: &Mechanism, walls: &[Obstacle], path: &[State]) {
    let joints = mechanism.joints.len();
    let path: Vec<Vec<f64>> = path.iter().map(|s| s[..joints].iter().map(|q| f64::from(*q)).collect()).collect();
    assert_eq!(Exact::new(mechanism, walls).touch_along(&path, 128.0), None);
}

#[test]
fn the_tree_alone_comes_down_to_the_shortest_way_as_samples_grow() {
    // In three dimensions the way winds round the end of the wall: unrolled it is straight.
    let winding = round_the_end(0.6).hypot(0.8);
    let flat = (ball(2), at([-1.0, 0.0]), at([1.0, 0.0]), round_the_end(0.6), [0.03, 0.01]);
    let solid = (ball(3), at([-1.0, 0.0, -0.4]), at([1.0, 0.0, 0.4]), winding, [0.12, 0.05]);
    for (mechanism, start, goal, shortest, allowed) in [flat, solid] {
        let mut space = Space::new(&mechanism, &wall());
        space.set_swept(true);
        for seed in 0..3 {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            let mut tree = RrtStar::new(&start, space.joints());
            let ends = [End { state: goal, rest: 0.0, rest_s: 0.0 }];
            let mut excess = |samples: usize| {
                tree.grow(&mut space, &ends, 6.0, samples, &mut random, &mut go_on).unwrap();
                let (_, length) = tree.best(&ends).unwrap();
                f64::from(length) / shortest - 1.0
            };
            let found = [excess(600), excess(5_400)];
            assert!(found[0] <= allowed[0] && found[1] <= allowed[1], "{found:?} of {allowed:?}, seed {seed}");
            assert!(found[1] < found[0] && found[1] > -0.001, "{found:?}");
        }
    }
}

#[test]
fn improvement_comes_down_to_the_shortest_way_from_a_path_on_the_wrong_side() {
    let (mechanism, walls) = (ball(2), wall());
    let shortest = round_the_end(0.6) as f32;
    let mut space = Space::new(&mechanism, &walls);
    space.set_swept(true);
    for seed in 0..4 {
        let mut improve = |iterations: usize| {
            let end = End { state: above()[3], rest: 0.0, rest_s: 0.0 };
            let mut refinement = Refinement::new(above(), 0, vec![end], Measure::Length, seed);
            let mut lengths = vec![refinement.length()];
            for _ in 0..iterations {
                refinement.step(&mut space, &mut go_on).unwrap();
                lengths.push(refinement.length());
            }
            assert_untouched(&mechanism, &walls, refinement.path());
            lengths
        };
        let lengths = improve(4_000);
        assert!(lengths.is_sorted_by(|a, b| b <= a), "the best path was lost");
        let excess = |iterations: usize| lengths[iterations] / shortest - 1.0;
        let found = [0, 1_000, 4_000].map(excess);
        assert!(found[0] > 0.3 && found[1] < 0.02 && found[2] < 0.005, "{found:?}");
        assert!(found[2] > -0.001, "shorter than the shortest by {}", -found[2]);
        assert_eq!(improve(300), lengths[..=300], "the same seed improves in the same way");
    }
}

#[test]
fn the_tree_finds_the_shorter_side_that_no_shortcut_leads_to() {
    let mechanism = ball(2);
    let walls = wall();
    let mut space = Space::new(&mechanism, &walls);
    space.set_swept(true);
    let above = above();
    for seed in 0..3 {
        let mut improved = |shares: Shares, steps: usize| {
            let ends = vec![End { state: above[3], rest: 0.0, rest_s: 0.0 }];
            let mut refinement = Refinement::new(above.clone(), 0, ends, Measure::Length, seed).with_shares(shares);
            for _ in 0..steps {
                let before = refinement.length();
                refinement.step(&mut space, &mut go_on).unwrap();
                assert!(refinement.length() <= before + 1e-6, "the best path was lost");
            }
            let path = refinement.path();
            assert_untouched(&mechanism, &walls, path);
            assert_eq!((path[0], path[path.len() - 1]), (above[0], above[3]));
            f64::from(path_length(path))
        };
        let stuck = improved(Shares { shortcut: 1, corner: 1, ..NONE }, 2_000);
        assert!(stuck > round_the_end(1.2) * 0.999, "{stuck}");
        let tree = improved(Shares { tree: 1, ..NONE }, 200);
        assert!(tree < round_the_end(0.6) * 1.03, "{tree}");
        let both = improved(Shares { shortcut: 5, corner: 5, tree: 2, ..NONE }, 1_000);
        assert!(both < round_the_end(0.6) * 1.01, "{both}");
        assert_eq!(both, improved(Shares { shortcut: 5, corner: 5, tree: 2, ..NONE }, 1_000), "the same seed");
    }
}

#[test]
fn the_tree_goes_to_the_end_with_the_shortest_way_and_rest_also_one_that_comes_later() {
    let mechanism = ball(2);
    let mut space = Space::new(&mechanism, &wall());
    let far = End { state: at([1.0, 0.0]), rest: 0.0, rest_s: 0.0 };
    let near = End { state: at([0.0, -1.0]), rest: 0.6, rest_s: 0.0 };
    let dear = End { state: at([-0.9, 0.0]), rest: 3.0, rest_s: 0.0 };
    let path = vec![at([-1.0, 0.0]), at([-0.3, 1.5]), at([0.3, 1.5]), far.state];
    let mut refinement =
        Refinement::new(path, 0, vec![far, dear], Measure::Length, 1).with_shares(Shares { tree: 1, ..NONE });
    for _ in 0..100 {
        refinement.step(&mut space, &mut go_on).unwrap();
    }
    assert_eq!(refinement.end(), 0);
    let before = refinement.length();
    let rest = near.rest;
    refinement.add(near);
    for _ in 0..100 {
        refinement.step(&mut space, &mut go_on).unwrap();
    }
    assert_eq!(refinement.end(), 2);
    let straight = 2.0_f32.sqrt();
    assert!(refinement.length() < before && refinement.length() < (straight + rest) * 1.01, "{}", refinement.length());
}

#[test]
fn the_quicker_end_is_taken_though_it_is_farther_where_quickness_is_measured() {
    let mechanism = ball(2);
    let mut space = Space::new(&mechanism, &wall());
    let joint = |name: &str, velocity: f64| Joint {
        name: name.to_owned(),
        lower: -9.0,
        upper: 9.0,
        endless: false,
        velocity,
        acceleration: 10.0 * velocity,
        jerk: 100.0 * velocity,
    };
    let rough = Rough::new(&[joint("slow", 0.1), joint("quick", 2.0)], 1.0);
    let start = at([-1.0, 0.0]);
    let ends = || {
        vec![
            End { state: at([-0.5, 0.0]), rest: 0.0, rest_s: 0.0 },
            End { state: at([-1.0, 1.0]), rest: 0.0, rest_s: 0.5 },
        ]
    };
    let ended = |space: &mut Space, measure: Measure| {
        let mut refinement = Refinement::new(vec![start, ends()[0].state], 0, ends(), measure, 1);
        for _ in 0..200 {
            let before = refinement.cost();
            refinement.step(space, &mut go_on).unwrap();
            assert!(refinement.cost() <= before);
        }
        (refinement.end(), refinement.cost())
    };
    // 5 s at the slow joint's speed and 0.1 s each to reach it and to stop; 1 m at twenty times the speed, and what follows.
    let (end, cost) = ended(&mut space, Measure::Duration(Box::new(rough)));
    assert!(end == 1 && (cost - 1.2).abs() < 0.1, "{end} {cost}");
    assert_eq!(ended(&mut space, Measure::Length).0, 0);
}

#[test]
fn a_smooth_way_is_taken_where_it_is_quicker_and_only_what_is_free() {
    let joint = |name: &str| Joint {
        name: name.to_owned(),
        lower: -9.0,
        upper: 9.0,
        endless: false,
        velocity: 2.0,
        acceleration: 4.0,
        jerk: 80.0,
    };
    let joints = [joint("x"), joint("y")];
    // The side in the middle is short: blends at its ends are narrow.
    let path = [[0.0, 0.0], [1.0, 0.0], [1.1, 0.1], [1.1, 1.1]].map(JointVector::of);
    let curve = |is_free: &mut dyn FnMut(&JointVector, &JointVector) -> bool| {
        timed(&joints, &[Section::Blended(path.to_vec())], 1.0, is_free)
    };
    let off = |at: &JointVector| {
        let from_side = |pair: &[JointVector]| {
            let side = [pair[1][0] - pair[0][0], pair[1][1] - pair[0][1]];
            let off = [at[0] - pair[0][0], at[1] - pair[0][1]];
            let along = (off[0] * side[0] + off[1] * side[1]) / (side[0] * side[0] + side[1] * side[1]);
            let along = along.clamp(0.0, 1.0);
            (off[0] - side[0] * along).hypot(off[1] - side[1] * along)
        };
        path.windows(2).map(from_side).fold(f64::INFINITY, f64::min)
    };
    let with_room = curve(&mut |_, _| true);
    // All of a chord, which is furthest off where it crosses the bisector of a corner.
    let along = |from: &JointVector, to: &JointVector, share: f64| {
        JointVector::from_fn(2, |j| from[j] + (to[j] - from[j]) * share)
    };
    let with_little = curve(&mut |from, to| (0..=32).all(|i| off(&along(from, to, f64::from(i) / 32.0)) < 0.01));
    let stops = curve(&mut |_, _| false);
    let [most, less, least] = [&with_room, &with_little, &stops].map(|curve| curve.duration_s());
    assert!(most < less - 0.05 && less < least * 0.95, "{most} {less} {least}");
    for (knots, most) in [(with_room.knots(), 0.2), (with_little.knots(), 0.0105), (stops.knots(), 1e-9)] {
        for knot in knots {
            let off = off(&knot.positions);
            assert!(off < most, "{off} off the path at {}", knot.time_s);
        }
    }
}
