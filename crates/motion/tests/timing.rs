//! What a trajectory is, between its knots too: within the limits, smooth, and no slower than it has to be; on any joints.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_motion::collision::{between, distance};
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::Joint;
use ratn_motion::space::{State, state};
use ratn_motion::timing::rough::Rough;
use ratn_motion::timing::{Section, timed};
use ratn_motion::trajectory::{Curve, Knot};

fn joint(velocity: f64, acceleration: f64, jerk: f64) -> Joint {
    Joint { name: "joint".to_owned(), lower: -9.0, upper: 9.0, endless: false, velocity, acceleration, jerk }
}

fn free(joints: &[Joint], path: &[JointVector], speed: f64) -> Curve {
    timed(joints, &[Section::Blended(path.to_vec())], speed, &mut |_, _| true)
}

fn vectors<const N: usize>(path: impl IntoIterator<Item = [f64; N]>) -> Vec<JointVector> {
    path.into_iter().map(JointVector::of).collect()
}

/// How far a posture is from the nearest motion of a path.
fn off(path: &[JointVector], posture: &JointVector) -> f64 {
    let from_side = |pair: &[JointVector]| {
        let dot = |a: &[f64], b: &[f64]| (0..a.len()).map(|j| (a[j] - pair[0][j]) * (b[j] - pair[0][j])).sum::<f64>();
        let along = (dot(posture, &pair[1]) / dot(&pair[1], &pair[1])).clamp(0.0, 1.0);
        distance(posture, &between(&pair[0], &pair[1], along))
    };
    path.windows(2).map(from_side).fold(f64::INFINITY, f64::min)
}

/// Acceleration at the beginning and jerk of a joint's cubic between two knots.
fn cubic(a: &Knot, b: &Knot, j: usize) -> (f64, f64) {
    let h = b.time_s - a.time_s;
    let mean = (b.positions[j] - a.positions[j]) / h;
    let (v0, v1) = (a.velocities[j], b.velocities[j]);
    ((6.0 * mean - 4.0 * v0 - 2.0 * v1) / h, 6.0 * (v0 + v1 - 2.0 * mean) / (h * h))
}

/// From rest to rest, velocity, acceleration and jerk within limits a hundred times between any two knots, and acceleration
/// without a step.
fn assert_within(joints: &[Joint], curve: &Curve, speed: f64) {
    let knots = curve.knots();
    let still = JointVector::zeros(joints.len());
    let mut before = still;
    for pair in knots.windows(2) {
        let h = pair[1].time_s - pair[0].time_s;
        for (j, joint) in joints.iter().enumerate() {
            let (acceleration, jerk) = cubic(&pair[0], &pair[1], j);
            let most = joint.acceleration * speed;
            assert!((acceleration - before[j]).abs() <= 0.005 * most, "a step of {}", acceleration - before[j]);
            assert!(jerk.abs() <= joint.jerk * 1.001, "jerk {jerk} of {} in {h} s", joint.jerk);
            for i in 0..=100 {
                let t = h * f64::from(i) / 100.0;
                let (velocity, a) =
                    (pair[0].velocities[j] + t * (acceleration + t * jerk / 2.0), acceleration + t * jerk);
                assert!(velocity.abs() <= joint.velocity * speed * 1.001, "{velocity}");
                assert!(a.abs() <= most * 1.001, "{a} of {most}");
            }
            before[j] = acceleration + h * jerk;
        }
    }
    for (j, joint) in joints.iter().enumerate() {
        assert!(before[j].abs() <= 0.005 * joint.acceleration * speed, "ends with {}", before[j]);
    }
    assert_eq!((knots[0].velocities, knots[knots.len() - 1].velocities), (still, still));
}

#[test]
fn a_corner_is_never_slower_than_stopping_at_it_however_little_room_there_is() {
    let joints = [joint(2.0, 4.0, 80.0), joint(2.0, 4.0, 80.0)];
    for degrees in [10.0_f64, 60.0, 120.0, 150.0, 170.0, 179.0, 180.0] {
        let angle = degrees.to_radians();
        let path = vectors([[0.0, 0.0], [1.0, 0.0], [1.0 + angle.cos(), angle.sin()]]);
        // Each side is too short for the full velocity: 1 = v (v / 4 + 4 / 80). Along a diagonal it is faster.
        let stops = timed(&joints, &[Section::Blended(path.to_vec())], 1.0, &mut |_, _| false);
        assert!(stops.duration_s() <= 2.1025, "{}", stops.duration_s());
        let mut last = stops.duration_s();
        for room in [0.001, 0.01, 0.05, 9.0] {
            let mut is_free = |from: &JointVector, to: &JointVector| off(&path, from).max(off(&path, to)) < room;
            let curve = timed(&joints, &[Section::Blended(path.to_vec())], 1.0, &mut is_free);
            assert_within(&joints, &curve, 1.0);
            assert!(
                curve.duration_s() <= last + 0.01,
                "{degrees}°, room {room}: {} s, {last} s with less",
                curve.duration_s()
            );
            assert!(curve.duration_s() <= stops.duration_s(), "{degrees}°, room {room}: {} s", curve.duration_s());
            last = curve.duration_s();
        }
        if degrees < 130.0 {
            assert!(last < 0.97 * stops.duration_s(), "{degrees}°: {last} s, stopping {} s", stops.duration_s());
        }
    }
}

#[test]
fn a_straight_motion_takes_the_time_of_the_double_s() {
    // Way, velocity, acceleration and jerk, and the time by hand: with cruise; without; without full acceleration; short.
    let with = |way: f64, v: f64, a: f64, j: f64| way / v + v / a + a / j;
    let cases = [
        (3.0, 1.0, 2.0, 8.0, with(3.0, 1.0, 2.0, 8.0)),
        (1.0, 9.0, 2.0, 20.0, 2.0 * (((0.01_f64 + 4.0 / 2.0).sqrt() - 0.1) / 2.0 + 0.1)),
        (0.5, 9.0, 90.0, 8.0, 4.0 * (0.5_f64 / 16.0).cbrt()),
        (1e-4, 1.0, 2.0, 8.0, 4.0 * (1e-4_f64 / 16.0).cbrt()),
    ];
    for (way, v, a, j, expected) in cases {
        let joints = [joint(v, a, j), joint(2.0 * v, 2.0 * a, 2.0 * j)];
        // The other joint goes half as far; nothing changes along a diagonal on which it has twice the limits and goes twice as far.
        for to in [[way, way / 2.0], [-way, 2.0 * way]] {
            let curve = free(&joints, &vectors([[0.0, 0.0], to]), 1.0);
            assert!((curve.duration_s() / expected - 1.0).abs() < 1e-3, "{} of {expected}", curve.duration_s());
            assert_within(&joints, &curve, 1.0);
            assert!(curve.knots().iter().all(|k| off(&vectors([[0.0, 0.0], to]), &k.positions) < 1e-9));
        }
    }
}

fn random_path<const N: usize>(random: &mut ChaCha8Rng, postures: usize) -> (Vec<Joint>, Vec<JointVector>) {
    let joints = (0..N).map(|_| {
        let acceleration = random.random_range(0.5..15.0);
        let lasts = random.random_range(0.02..0.4);
        joint(random.random_range(0.3..4.0), acceleration, acceleration / lasts)
    });
    let joints = joints.collect();
    (joints, (0..postures).map(|_| JointVector::from_fn(N, |_| random.random_range(-2.0..2.0))).collect())
}

fn check_random<const N: usize>(seeds: std::ops::Range<u64>) {
    for seed in seeds {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let postures = random.random_range(2..7);
        let (joints, path) = random_path::<N>(&mut random, postures);
        let speed = random.random_range(0.1..=1.0);
        let curve = free(&joints, &path, speed);
        assert_within(&joints, &curve, speed);
        assert_eq!((curve.knots()[0].positions, curve.end()), (path[0], path[path.len() - 1]));
        let stops = timed(&joints, &[Section::Blended(path.clone())], speed, &mut |_, _| false);
        assert_within(&joints, &stops, speed);
        assert!(curve.duration_s() <= stops.duration_s());
    }
}

#[test]
fn random_paths_of_any_number_of_joints_keep_within_all_limits_everywhere() {
    check_random::<1>(0..6);
    check_random::<2>(10..18);
    check_random::<3>(20..28);
    check_random::<7>(30..38);
    check_random::<12>(40..44);
}

/// The same joints without limits of jerk.
fn without_jerk(joints: &[Joint]) -> Vec<Joint> {
    joints.iter().map(|joint| Joint { jerk: f64::INFINITY, ..joint.clone() }).collect()
}

#[test]
fn a_motion_of_minutes_within_limits_of_jerk_takes_hardly_longer_than_without_them() {
    for seed in 0..3 {
        let mut random = ChaCha8Rng::seed_from_u64(500 + seed);
        let (mut joints, path) = random_path::<7>(&mut random, 6);
        // Jerk acts for hundredths of a second; the motion is a thousand times as long.
        for joint in &mut joints {
            joint.velocity *= 0.04;
        }
        let curve = free(&joints, &path, 1.0);
        assert_within(&joints, &curve, 1.0);
        let least = free(&without_jerk(&joints), &path, 1.0).duration_s();
        assert!(least > 60.0, "{least}");
        assert!(curve.duration_s() < 1.01 * least, "seed {seed}: {} s, {least} s", curve.duration_s());
        let knots = curve.knots();
        let moves = |knot: &Knot| knot.velocities.iter().any(|v| *v != 0.0);
        assert!(knots[1..knots.len() - 1].iter().all(moves), "seed {seed}: a stop on the way");
        // Knots are close where the acceleration changes, not in a cruise.
        assert!(knots.len() < 600, "seed {seed}: {} knots", knots.len());
    }
}

#[test]
fn a_motion_of_any_duration_uses_its_limits_alike() {
    for seed in 0..3 {
        let mut random = ChaCha8Rng::seed_from_u64(520 + seed);
        let (joints, path) = random_path::<6>(&mut random, 4);
        let alike = free(&joints, &path, 1.0).duration_s();
        for faster in [0.01_f64, 100.0] {
            let scaled = |joint: &Joint| Joint {
                velocity: joint.velocity * faster,
                acceleration: joint.acceleration * faster.powi(2),
                jerk: joint.jerk * faster.powi(3),
                ..joint.clone()
            };
            let joints: Vec<Joint> = joints.iter().map(scaled).collect();
            let duration_s = free(&joints, &path, 1.0).duration_s();
            assert!((duration_s * faster / alike - 1.0).abs() < 1e-4, "{faster}: {duration_s} s, else {alike} s");
        }
    }
}

#[test]
fn a_joint_without_a_limit_of_jerk_moves_beside_others_that_have_one() {
    let limited = [joint(2.0, 4.0, 40.0), joint(2.0, 4.0, 40.0), joint(2.0, 4.0, 40.0)];
    let mut joints = limited.clone();
    joints[1].jerk = f64::INFINITY;
    let path = vectors([[0.0, 0.0, 0.0], [1.0, 0.5, 0.2], [1.5, 1.5, -0.4]]);
    let curve = free(&joints, &path, 1.0);
    assert_within(&joints, &curve, 1.0);
    let [least, most] = [without_jerk(&joints), limited.to_vec()].map(|joints| free(&joints, &path, 1.0).duration_s());
    assert!(curve.duration_s() <= most * 1.002, "{} s, {least} to {most} s", curve.duration_s());
    assert!(curve.duration_s() >= least, "{} s, {least} to {most} s", curve.duration_s());
}

#[test]
fn with_greater_limits_nothing_takes_longer() {
    for seed in 0..4 {
        let mut random = ChaCha8Rng::seed_from_u64(100 + seed);
        let (joints, path) = random_path::<3>(&mut random, 4);
        let times = |change: &dyn Fn(&mut Joint, f64)| {
            [1.0, 1.3, 2.0, 4.0].map(|factor| {
                let mut joints = joints.clone();
                joints.iter_mut().for_each(|joint| change(joint, factor));
                free(&joints, &path, 1.0).duration_s()
            })
        };
        let all = [
            times(&|joint, factor| joint.velocity *= factor),
            times(&|joint, factor| joint.acceleration *= factor),
            times(&|joint, factor| joint.jerk *= factor),
        ];
        for times in all {
            assert!(times.is_sorted_by(|a, b| *b <= a * 1.005), "{seed}: {times:?}");
        }
    }
}

#[test]
fn postures_along_a_curve_are_followed_as_they_are_and_kinks_are_stopped_at() {
    let joints = [joint(1.0, 3.0, 40.0), joint(1.0, 3.0, 40.0)];
    let arc = vectors((0..=60).map(|i| f64::from(i) * 0.02).map(|a| [a.sin(), 1.0 - a.cos()]));
    let curve = timed(&joints, &[Section::AsGiven(arc.clone())], 1.0, &mut |_, _| false);
    assert_within(&joints, &curve, 1.0);
    let steps = 500;
    for i in 0..=steps {
        let at = curve.sample(curve.duration_s() * f64::from(i) / f64::from(steps)).positions;
        let (x, y) = (at[0], at[1]);
        assert!((x.hypot(1.0 - y) - 1.0).abs() < 2e-4, "{x} {y}");
    }
    // A straight motion of this length takes 1.6 s.
    assert!((1.3..1.6).contains(&curve.duration_s()), "{}", curve.duration_s());
    let kinked = vectors([[0.0, 0.0], [0.5, 0.0], [0.5, 0.5]]);
    let curve = timed(&joints, &[Section::AsGiven(kinked.to_vec())], 1.0, &mut |_, _| true);
    assert_within(&joints, &curve, 1.0);
    assert!(curve.knots().iter().any(|k| k.positions == kinked[1] && k.velocities == [0.0; 2]));
}

#[test]
fn a_dense_path_with_kinks_is_rounded_and_not_stopped_at_each_of_them() {
    let joints = [joint(1.0, 3.0, 40.0), joint(1.0, 3.0, 40.0)];
    // As a search on a constraint leaves them: steps to and fro.
    let path = vectors((0..=40).map(|i| [f64::from(i) * 0.06, if i % 2 == 0 { 0.0 } else { 0.02 }]));
    let mut is_free = |from: &JointVector, to: &JointVector| off(&path, from).max(off(&path, to)) < 0.03;
    let curve = timed(&joints, &[Section::Blended(path.clone())], 1.0, &mut is_free);
    assert_within(&joints, &curve, 1.0);
    let stops = timed(&joints, &[Section::Blended(path.clone())], 1.0, &mut |_, _| false);
    assert!(curve.duration_s() < 3.2 && stops.duration_s() > 10.0, "{} {}", curve.duration_s(), stops.duration_s());
    for i in 0..=1000 {
        let at = curve.sample(curve.duration_s() * f64::from(i) / 1000.0).positions;
        assert!(off(&path, &at) < 0.035);
    }
}

#[test]
fn a_path_that_is_no_way_at_all_and_repeated_postures_are_no_trouble() {
    let joints = [joint(1.0, 3.0, 40.0), joint(1.0, 3.0, 40.0)];
    let here = JointVector::of([0.3, 0.4]);
    for part in [
        Section::Blended(vec![here]),
        Section::AsGiven(vec![here]),
        Section::Blended(vec![here, here]),
        Section::AsGiven(vec![here; 3]),
    ] {
        let curve = timed(&joints, &[part], 1.0, &mut |_, _| true);
        assert_eq!((curve.duration_s(), curve.end()), (0.0, here));
    }
    let there = JointVector::of([1.3, 0.4]);
    let curve = free(&joints, &[here, here, there, there], 1.0);
    assert!((curve.duration_s() - free(&joints, &[here, there], 1.0).duration_s()).abs() < 1e-9);
    let parts =
        [Section::AsGiven(vec![here]), Section::Blended(vec![here, there]), Section::AsGiven(vec![there, here])];
    let curve = timed(&joints, &parts, 1.0, &mut |_, _| true);
    assert_eq!(curve.end(), here);
    assert_within(&joints, &curve, 1.0);
}

/// Postures along a straight line, as those of a straight motion of the tool.
fn dense(from: &JointVector, to: &JointVector) -> Vec<JointVector> {
    (0..=40).map(|i| JointVector::from_fn(from.len(), |j| from[j] + (to[j] - from[j]) * f64::from(i) / 40.0)).collect()
}

#[test]
fn a_seam_is_passed_without_a_stop_where_that_is_free_and_within_the_share_that_is_given_for_it() {
    let joints = [joint(1.0, 3.0, 40.0), joint(1.0, 3.0, 40.0)];
    let [start, up, over, down] = [[0.0, 0.0], [0.0, 0.4], [1.0, 0.4], [1.0, 0.0]].map(JointVector::of);
    let sections = |share: f64| {
        [
            Section::Loose(dense(&start, &up), [0.0, share]),
            Section::Blended(vec![up, over]),
            Section::Loose(dense(&over, &down), [share, 0.0]),
        ]
    };
    let corners = [start, up, over, down];
    // Stopping twice: 0.4 = v (v / 3 + 3 / 40), and 1 / 1 + 1 / 3 + 3 / 40 for the way between them.
    let peak = 3.0 * ((0.075_f64.powi(2) + 4.0 * 0.4 / 3.0).sqrt() - 0.075) / 2.0;
    let by_hand = 2.0 * 2.0 * (peak / 3.0 + 0.075) + 1.0 + 1.0 / 3.0 + 0.075;
    let stops = timed(&joints, &sections(0.0), 1.0, &mut |_, _| true);
    assert!((stops.duration_s() / by_hand - 1.0).abs() < 5e-3, "{} of {by_hand}", stops.duration_s());
    for share in [0.05, 0.2, 0.5] {
        let curve = timed(&joints, &sections(share), 1.0, &mut |_, _| true);
        assert_within(&joints, &curve, 1.0);
        assert_eq!(curve.end(), down);
        // No way between the seams is quicker than one that is followed at full speed.
        let saved = stops.duration_s() - curve.duration_s();
        assert!((0.02..1.0).contains(&saved), "share {share} saves {saved} s");
        let way = 0.1 * curve.duration_s()..0.9 * curve.duration_s();
        let inner = curve.knots().iter().filter(|k| way.contains(&k.time_s));
        assert!(inner.clone().count() > 20 && inner.clone().all(|k| k.velocities.iter().any(|v| v.abs() > 0.05)));
        for i in 0..=2000 {
            let at = curve.sample(curve.duration_s() * f64::from(i) / 2000.0).positions;
            if at[1] < 0.4 * (1.0 - share) - 1e-3 {
                assert!(off(&corners, &at) < 2e-4, "{at:?} with share {share}");
            }
            assert!(off(&corners, &at) < 0.4 * share, "{at:?} with share {share}");
        }
        // Where there is room on one side only, one stop stays; where there is none, both do.
        let mut on_the_left =
            |a: &JointVector, b: &JointVector| off(&corners, a).max(off(&corners, b)) < 1e-6 || a[0].max(b[0]) < 0.5;
        let left = timed(&joints, &sections(share), 1.0, &mut on_the_left);
        assert_within(&joints, &left, 1.0);
        assert!(left.duration_s() < stops.duration_s() - 0.01 && left.duration_s() > curve.duration_s() + 0.01);
        let none = timed(&joints, &sections(share), 1.0, &mut |a, b| off(&corners, a).max(off(&corners, b)) < 1e-6);
        assert_eq!(none, stops);
    }
}

#[test]
fn sections_with_loose_ends_never_take_longer_than_with_stops_and_keep_within_all_limits() {
    let mut quicker = 0;
    for seed in 0..12 {
        let mut random = ChaCha8Rng::seed_from_u64(200 + seed);
        let postures = random.random_range(4..7);
        let (joints, path) = random_path::<7>(&mut random, postures);
        let speed = random.random_range(0.1..=1.0);
        let share = random.random_range(0.05..=1.0);
        let last = path.len() - 1;
        let (before, after) = (dense(&path[0], &path[1]), dense(&path[last - 1], &path[last]));
        let sections = |share: f64| {
            let (before, after) = (before.clone(), after.clone());
            let middle = Section::Blended(path[1..last].to_vec());
            [Section::Loose(before, [0.0, share]), middle, Section::Loose(after, [share, 0.0])]
        };
        let stops = timed(&joints, &sections(0.0), speed, &mut |_, _| true);
        let curve = timed(&joints, &sections(share), speed, &mut |_, _| true);
        assert_within(&joints, &curve, speed);
        assert_eq!((curve.knots()[0].positions, curve.end()), (before[0], after[40]));
        assert!(curve.duration_s() <= stops.duration_s(), "{seed}");
        quicker += i32::from(curve.duration_s() < 0.99 * stops.duration_s());
    }
    assert!(quicker >= 8, "{quicker} of 12");
}

/// How far a joint is beyond its range at the most, in radians, looked at a hundred times between any two knots.
fn beyond(joints: &[Joint], curve: &Curve) -> f64 {
    let mut most = f64::NEG_INFINITY;
    for pair in curve.knots().windows(2) {
        let h = pair[1].time_s - pair[0].time_s;
        for (j, joint) in joints.iter().enumerate() {
            let (acceleration, jerk) = cubic(&pair[0], &pair[1], j);
            for i in 0..=100 {
                let t = h * f64::from(i) / 100.0;
                let at = pair[0].positions[j] + t * (pair[0].velocities[j] + t * (acceleration / 2.0 + t * jerk / 6.0));
                most = most.max(at - joint.upper).max(joint.lower - at);
            }
        }
    }
    most
}

/// The same with a range for each joint that goes just as far as the postures do.
fn ranged(joints: &[Joint], sections: &[Section]) -> Vec<Joint> {
    let of = |(j, joint): (usize, &Joint)| {
        let positions = || sections.iter().flat_map(|section| section.path().iter().map(move |posture| posture[j]));
        let (lower, upper) = (positions().fold(f64::INFINITY, f64::min), positions().fold(f64::NEG_INFINITY, f64::max));
        Joint { lower, upper, ..joint.clone() }
    };
    joints.iter().enumerate().map(of).collect()
}

#[test]
fn no_joint_leaves_its_range_between_the_postures_of_a_rounded_path() {
    // Rounding.
    const ROUNDED: f64 = 2e-6;
    let mut quicker = 0;
    for seed in 0..40 {
        let mut random = ChaCha8Rng::seed_from_u64(300 + seed);
        let postures = random.random_range(4..8);
        let (joints, path) = random_path::<3>(&mut random, postures);
        let last = path.len() - 1;
        let sections = |share: f64| {
            [
                Section::Loose(dense(&path[0], &path[1]), [0.0, share]),
                Section::Blended(path[1..last].to_vec()),
                Section::Loose(dense(&path[last - 1], &path[last]), [share, 0.0]),
            ]
        };
        let share = random.random_range(0.1..=1.0);
        let joints = ranged(&joints, &sections(share));
        let stops = timed(&joints, &sections(0.0), 1.0, &mut |_, _| true);
        let curve = timed(&joints, &sections(share), 1.0, &mut |_, _| true);
        let blended = [Section::Blended(path.clone())];
        let narrow = ranged(&joints, &blended);
        let free = timed(&narrow, &blended, 1.0, &mut |_, _| true);
        assert_within(&joints, &curve, 1.0);
        let most = [beyond(&joints, &curve), beyond(&narrow, &free)];
        assert!(most.iter().all(|most| *most <= ROUNDED), "seed {seed}: {most:?}");
        quicker += i32::from(curve.duration_s() < 0.99 * stops.duration_s());
    }
    // Where there is room, corners are rounded as before.
    assert!(quicker >= 20, "{quicker} of 40");
}

#[test]
fn the_rough_duration_of_a_path_is_about_the_exact_one() {
    let (mut ratios, mut sums) = (Vec::new(), [0.0; 2]);
    for seed in 0..24 {
        let mut random = ChaCha8Rng::seed_from_u64(300 + seed);
        let postures = random.random_range(2..7);
        let (joints, path) = random_path::<7>(&mut random, postures);
        let speed = random.random_range(0.1..=1.0);
        let states: Vec<State> = path.iter().map(|q| state(q)).collect();
        let mut rough = Rough::new(&joints, speed);
        let about = rough.duration_s(&states);
        ratios.push(about / free(&joints, &path, speed).duration_s());
        // With room for blends it is the same; without any every corner is stopped at.
        assert_eq!(rough.duration_among_s(&states, &mut |_, _| true), about);
        let mut rough = Rough::new(&joints, speed);
        let stopping = rough.duration_among_s(&states, &mut |_, _| false);
        let exact = timed(&joints, &[Section::Blended(path.clone())], speed, &mut |_, _| false).duration_s();
        assert!((stopping / exact - 1.0).abs() < 0.1, "{stopping} of {exact}");
        sums = [sums[0] + about, sums[1] + stopping];
    }
    assert!(sums[1] > sums[0], "{sums:?}");
    assert!(ratios.iter().all(|r| (0.7..1.3).contains(r)), "{ratios:?}");
}
