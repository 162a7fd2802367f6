//! Any robot from its URDF: the vector checks beside parry's exact shapes, and paths that both find free.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::disallowed_methods,
    reason = "a test may panic, and one measures time"
)]

use parry3d::math::Vector;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::connect::{Budget, ConnectError, connect};
use ratn_motion::exact::Exact;
use ratn_motion::geometry::{Body, Geometry};
use ratn_motion::mechanism::{MAX_JOINTS, Mechanism};
use ratn_motion::pace::Control;
use ratn_motion::problems::{Problem, Problems};
use ratn_motion::simplify::{path_length, simplify};
use ratn_motion::space::{Isa, Obstacle, Space, State, between};
use ratn_motion::spheres::cover;
use ratn_motion::trial::{self, Settings};
use std::time::{Duration, Instant};

const AIMM: &str = include_str!("../robots/aimm.urdf");

const BUDGET: Budget = Budget { iterations: 20_000, seed: 1 };

fn go_on(_: usize) -> Control {
    Control::Continue
}

fn arm() -> Mechanism {
    let joints: Vec<String> = (1..=7).map(|i| format!("arm_joint_{i}")).collect();
    let mut mechanism = Mechanism::read(AIMM, None, &joints).unwrap();
    // Pairs that only the exact check sees: what is compared here is what both see.
    mechanism.excepted.extend(mechanism.by_shapes.clone());
    mechanism
}

/// A chain of joints about z and y in turn, each link three spheres along x.
fn chain(joints: usize) -> (String, Vec<String>) {
    let mut urdf = String::from("<robot name='chain'><link name='l0'/>");
    let mut names = Vec::new();
    for i in 1..=joints {
        urdf += &format!("<link name='l{i}'>");
        for x in [0.08, 0.14, 0.20] {
            urdf +=
                &format!("<collision><origin xyz='{x} 0 0'/><geometry><sphere radius='0.035'/></geometry></collision>");
        }
        let (x, axis) = (if i == 1 { 0.0 } else { 0.25 }, ["0 1 0", "0 0 1"][i % 2]);
        urdf += &format!(
            "</link><joint name='j{i}' type='revolute'><origin xyz='{x} 0 0'/><parent link='l{}'/><child link='l{i}'/>\
             <axis xyz='{axis}'/><limit lower='-2.5' upper='2.5' effort='1' velocity='1'/></joint>",
            i - 1
        );
        names.push(format!("j{i}"));
    }
    (urdf + "</robot>", names)
}

/// An SRDF by which the neighbours of a chain may fold onto each other.
fn folding(joints: usize) -> String {
    let line = |i: usize| format!("<disable_collisions link1='l{i}' link2='l{}' reason='Adjacent'/>", i + 1);
    format!("<robot name='chain'>{}</robot>", (1..joints).map(line).collect::<String>())
}

fn random_pose(random: &mut impl Rng, reach: f64) -> Pose {
    let mut range = |most: f64| random.random_range(-most..most);
    Pose::from_rpy([range(reach), range(reach), range(reach)], range(3.1), range(1.5), range(3.1))
}

fn clutter(random: &mut impl Rng, count: usize, reach: f64) -> Vec<Obstacle> {
    let obstacle = |i: usize| {
        let mut size = || random.random_range(0.02..0.15);
        let geometry = match i % 4 {
            0 => Geometry::Box { half: [size(), size(), size()] },
            1 => Geometry::Cylinder { radius: size(), half_length: size() },
            2 => Geometry::Capsule { radius: size(), half_length: size() },
            _ => Geometry::Sphere { radius: size() },
        };
        Obstacle { name: format!("thing {i}"), pose: random_pose(random, reach), geometry }
    };
    (0..count).map(obstacle).collect()
}

fn posture(random: &mut impl Rng, mechanism: &Mechanism) -> State {
    let mut state = [0.0; MAX_JOINTS];
    for (q, joint) in state.iter_mut().zip(&mechanism.joints) {
        *q = random.random_range(joint.lower..joint.upper) as f32;
    }
    state
}

fn positions(mechanism: &Mechanism, state: &State) -> Vec<f64> {
    state[..mechanism.joints.len()].iter().map(|q| f64::from(*q)).collect()
}

#[test]
fn the_spheres_of_a_shape_hold_every_point_of_it() {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    for case in 0..200 {
        let mut size = || random.random_range(0.005..0.4);
        let geometry = match case % 4 {
            0 => Geometry::Box { half: [size(), size(), size()] },
            1 => Geometry::Cylinder { radius: size(), half_length: size() },
            2 => Geometry::Capsule { radius: size(), half_length: size() },
            _ => Geometry::Sphere { radius: size() },
        };
        let body: Body = geometry.at(random_pose(&mut random, 1.0));
        let (spheres, shape) = (cover(&body), body.geometry.shape(0.0));
        let extents = shape.compute_local_aabb().half_extents();
        for _ in 0..500 {
            let mut point = |half: f32| random.random_range(-half..=half);
            let inside = Vector::new(point(extents.x), point(extents.y), point(extents.z));
            if !shape.contains_local_point(inside) {
                continue;
            }
            let [x, y, z] = body.pose.transform([f64::from(inside.x), f64::from(inside.y), f64::from(inside.z)]);
            let holds = |s: &ratn_motion::spheres::Sphere| {
                let [a, b, c] = s.centre;
                (x - a).hypot(y - b).hypot(z - c) <= s.radius + 1e-6
            };
            assert!(spheres.iter().any(holds), "{geometry:?}: {inside:?} is in none of {} spheres", spheres.len());
        }
    }
}

#[test]
fn for_a_robot_of_spheres_the_vector_check_is_the_exact_one() {
    let (urdf, names) = chain(6);
    let mechanism = Mechanism::read(&urdf, Some(&folding(6)), &names).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(2);
    let (mut free, mut touching) = (0, 0);
    for _ in 0..40 {
        let obstacles = clutter(&mut random, 12, 1.2);
        let exact = Exact::new(&mechanism, &obstacles);
        let mut spaces: Vec<Space> =
            Isa::available().into_iter().map(|isa| Space::with_isa(&mechanism, &obstacles, isa)).collect();
        for _ in 0..100 {
            let state = posture(&mut random, &mechanism);
            let touch = exact.touch(&positions(&mechanism, &state));
            for space in &mut spaces {
                let isa = space.isa();
                match (space.is_free(&state), &touch) {
                    (true, None) => free += 1,
                    (false, Some(_)) => touching += 1,
                    // Spheres are grown by 0.02 mm; contact within that is either.
                    (false, None) => {
                        let mut thin = mechanism.clone();
                        thin.pad_all(-1e-4);
                        let mut smaller = Space::with_isa(&thin, &obstacles, isa);
                        assert!(smaller.is_free(&state), "{isa:?} sees a touch that is none");
                    }
                    (true, Some(touch)) => panic!("{isa:?} misses that {touch}"),
                }
            }
        }
    }
    assert!(free > 500 && touching > 500, "{free} free, {touching} touching");
}

#[test]
fn links_that_are_fixed_to_each_other_are_checked_as_one_by_one_whatever_each_may_touch() {
    let (urdf, names) = chain(4);
    let mut mechanism = Mechanism::read(&urdf, None, &names).unwrap();
    let hand = mechanism.link("l4").unwrap();
    let ball = |y: f64| Geometry::Sphere { radius: 0.04 }.at(Pose::at(0.25, y, 0.0));
    let tools: Vec<usize> =
        [-0.1, 0.0, 0.1].map(|y| mechanism.attach(&format!("tool at {y}"), hand, vec![ball(y)], &[])).to_vec();
    // Of two tools side by side one may touch a thing, and the other may be in the first link.
    mechanism.allow(tools[0], "thing 3");
    mechanism.allow(tools[2], "thing 3");
    let first = mechanism.link("l1").unwrap();
    mechanism.excepted.insert((first, tools[1]));
    let mut random = ChaCha8Rng::seed_from_u64(12);
    let (mut free, mut touching) = (0, 0);
    for _ in 0..40 {
        let obstacles: Vec<Obstacle> = clutter(&mut random, 8, 0.9)
            .into_iter()
            .enumerate()
            .map(|(i, thing)| Obstacle { name: format!("thing {i}"), ..thing })
            .collect();
        let exact = Exact::new(&mechanism, &obstacles);
        let mut thin = mechanism.clone();
        thin.pad_all(-1e-4);
        for isa in Isa::available() {
            let mut space = Space::with_isa(&mechanism, &obstacles, isa);
            let mut smaller = Space::with_isa(&thin, &obstacles, isa);
            for _ in 0..150 {
                let state = posture(&mut random, &mechanism);
                let touch = exact.touch(&positions(&mechanism, &state));
                match (space.is_free(&state), touch) {
                    (true, None) => free += 1,
                    (false, Some(_)) => touching += 1,
                    (false, None) => assert!(smaller.is_free(&state), "{isa:?} sees a touch that is none"),
                    (true, Some(touch)) => panic!("{isa:?} misses that {touch}"),
                }
            }
        }
    }
    assert!(free > 500 && touching > 500, "{free} free, {touching} touching");
}

#[test]
fn all_instruction_sets_answer_as_the_plain_one_does() {
    let (urdf, names) = chain(6);
    let mechanism = Mechanism::read(&urdf, None, &names).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(9);
    let (mut answers, mut differ) = ([0; 4], 0);
    for _ in 0..20 {
        let obstacles = clutter(&mut random, 20, 1.2);
        let mut spaces: Vec<Space> =
            Isa::available().into_iter().map(|isa| Space::with_isa(&mechanism, &obstacles, isa)).collect();
        assert!(!cfg!(target_arch = "aarch64") || spaces.len() == 2, "every such processor has NEON");
        for _ in 0..100 {
            let from = posture(&mut random, &mechanism);
            let to = between(&from, &posture(&mut random, &mechanism), 0.15);
            let all: Vec<[bool; 3]> = spaces
                .iter_mut()
                .map(|s| [s.is_free(&from), s.is_free_motion(&from, &to), s.is_swept_free(&from, &to)])
                .collect();
            let plain = all[all.len() - 1];
            answers[0] += usize::from(plain[0]);
            answers[1] += usize::from(plain[1]);
            answers[2] += usize::from(plain[2]);
            answers[3] += usize::from(!plain[1]);
            differ += all.iter().filter(|answer| **answer != plain).count();
        }
    }
    assert!(answers.iter().all(|count| *count > 100), "{answers:?}");
    // The plain one rounds twice where the others round once: one in thousands is that close to something.
    assert!(differ <= 2, "{differ} of 2000 differ");
}

/// The same with all spheres larger by this, in metres.
fn grown(mechanism: &Mechanism, by: f64) -> Mechanism {
    let mut grown = mechanism.clone();
    grown.links.iter_mut().flat_map(|link| &mut link.spheres).for_each(|sphere| sphere.radius += by);
    grown
}

#[test]
fn a_motion_is_free_just_where_all_the_postures_are_that_it_is_looked_at_in() {
    // What differs by rounding alone is within this.
    const ROUNDED_M: f64 = 1e-4;
    let (urdf, names) = chain(6);
    let mechanism = Mechanism::read(&urdf, Some(&folding(6)), &names).unwrap();
    let (less, more) = (grown(&mechanism, -ROUNDED_M), grown(&mechanism, ROUNDED_M));
    let mut random = ChaCha8Rng::seed_from_u64(23);
    let mut answers = [0; 2];
    for isa in Isa::available() {
        for count in [3, 10, 30] {
            for _ in 0..8 {
                let obstacles = clutter(&mut random, count, 1.6);
                let mut spaces = [&mechanism, &less, &more].map(|robot| Space::with_isa(robot, &obstacles, isa));
                for _ in 0..60 {
                    let from = posture(&mut random, &mechanism);
                    let share = random.random_range(0.05..0.8);
                    let to = between(&from, &posture(&mut random, &mechanism), share);
                    let [space, less, more] = &mut spaces;
                    let is_free = space.is_free_motion(&from, &to);
                    let length = ratn_motion::space::distance(&from, &to);
                    let steps = ((length * Space::RESOLUTION / 16.0).ceil() as usize).max(1) * 16;
                    let at = |i: usize| between(&from, &to, i as f32 / steps as f32);
                    answers[usize::from(is_free)] += 1;
                    if is_free {
                        assert!((1..=steps).all(|i| less.is_free(&at(i))), "{from:?} {to:?}");
                    } else {
                        assert!((1..=steps).any(|i| !more.is_free(&at(i))), "{from:?} {to:?}");
                    }
                }
            }
        }
    }
    assert!(answers.iter().all(|count| *count > 300), "{answers:?}");
}

#[test]
fn a_posture_that_the_spheres_of_an_arm_find_free_is_free_by_its_exact_shapes() {
    let mechanism = arm();
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let mut free = 0;
    for _ in 0..20 {
        let obstacles = clutter(&mut random, 10, 1.5);
        let exact = Exact::new(&mechanism, &obstacles);
        let mut space = Space::new(&mechanism, &obstacles);
        for _ in 0..100 {
            let state = posture(&mut random, &mechanism);
            if space.is_free(&state) {
                free += 1;
                assert_eq!(exact.touch(&positions(&mechanism, &state)), None);
            }
        }
    }
    assert!(free > 200, "{free}");
}

#[test]
fn paths_are_short_repeatable_and_free_by_the_exact_check_at_four_times_the_resolution() {
    let (urdf, names) = chain(6);
    let mechanism = Mechanism::read(&urdf, Some(&folding(6)), &names).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(4);
    let (mut solved, mut indirect) = (0, 0);
    for _ in 0..40 {
        let obstacles = clutter(&mut random, 14, 1.2);
        let mut space = Space::new(&mechanism, &obstacles);
        let (start, goal) = (posture(&mut random, &mechanism), posture(&mut random, &mechanism));
        let Ok(route) = connect(&mut space, &start, &[goal], BUDGET, &mut go_on) else { continue };
        let path = simplify(&mut space, &route.path, BUDGET, &mut go_on).unwrap();
        solved += 1;
        indirect += usize::from(path.len() > 2);
        assert_eq!((path[0], path[path.len() - 1]), (start, goal));
        assert!(path_length(&path) <= path_length(&route.path) + 1e-4);
        let postures: Vec<Vec<f64>> = path.iter().map(|s| positions(&mechanism, s)).collect();
        assert_eq!(Exact::new(&mechanism, &obstacles).touch_along(&postures, 128.0), None);
        let mut again = Space::new(&mechanism, &obstacles);
        let second = connect(&mut again, &start, &[goal], BUDGET, &mut go_on).unwrap();
        assert_eq!(second, route);
        assert_eq!(simplify(&mut again, &second.path, BUDGET, &mut go_on).unwrap(), path);
    }
    assert!(solved > 10 && indirect > 5, "{solved} solved, {indirect} not straight");
}

#[test]
fn a_motion_free_between_its_postures_is_free_wherever_one_looks() {
    let (turning, names) = chain(5);
    let sliding = turning.replacen("revolute", "prismatic", 2);
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let mut free = [0; 2];
    for case in 0..90 {
        let slides = case % 3 == 0;
        let mechanism = Mechanism::read(if slides { &sliding } else { &turning }, None, &names).unwrap();
        // Thin plates slip between postures that are too far apart.
        let geometry = Geometry::Box { half: [0.2, 0.2, 0.001] };
        let plates: Vec<Obstacle> = (0..4)
            .map(|i| Obstacle { name: format!("plate {i}"), pose: random_pose(&mut random, 0.8), geometry })
            .collect();
        let exact = Exact::new(&mechanism, &plates);
        let (from, to) = (posture(&mut random, &mechanism), posture(&mut random, &mechanism));
        let mut spaces = Isa::available().into_iter().map(|isa| Space::with_isa(&mechanism, &plates, isa));
        if spaces.any(|mut space| space.is_free(&from) && space.is_swept_free(&from, &to)) {
            free[usize::from(slides)] += 1;
            for i in 0..=2000 {
                let state = between(&from, &to, i as f32 / 2000.0);
                assert_eq!(exact.touch(&positions(&mechanism, &state)), None, "at {i} of 2000");
            }
        }
    }
    assert!(free[0] > 5 && free[1] > 5, "{free:?}");
}

/// What a check that looks again only at what was near answers is compared with a look at everything in postures as close as its finest.
#[test]
fn a_motion_is_free_between_its_postures_just_where_a_look_at_everything_finds_it_free() {
    // Between the finest postures of either nothing moves further.
    const BETWEEN_M: f64 = 5e-4;
    const PER_RADIAN: f32 = 2048.0;
    let (turning, names) = chain(6);
    let sliding = turning.replacen("revolute", "prismatic", 2);
    let read = |urdf: &str, srdf: &str, names: &[String]| Mechanism::read(urdf, Some(srdf), names).unwrap();
    let seven: Vec<String> = (1..=7).map(|i| format!("arm_joint_{i}")).collect();
    let robots = [
        read(&turning, &folding(6), &names),
        read(&sliding, &folding(6), &names),
        read(include_str!("../robots/panda.urdf"), include_str!("../robots/panda.srdf"), &seven),
    ];
    let mut random = ChaCha8Rng::seed_from_u64(31);
    for (robot, mechanism) in robots.iter().enumerate() {
        let mut answers = [0; 2];
        let (less, more) = (grown(mechanism, -BETWEEN_M), grown(mechanism, BETWEEN_M));
        for isa in Isa::available() {
            for count in [4, 20, 4, 20] {
                let obstacles = clutter(&mut random, count, 1.4);
                let mut spaces = [mechanism, &less, &more].map(|robot| Space::with_isa(robot, &obstacles, isa));
                for _ in 0..30 {
                    let [space, less, more] = &mut spaces;
                    let from = posture(&mut random, mechanism);
                    let to = between(&from, &posture(&mut random, mechanism), random.random_range(0.05..0.4));
                    let is_free = space.is_swept_free(&from, &to);
                    let steps = (ratn_motion::space::distance(&from, &to) * PER_RADIAN).ceil() as usize;
                    let at = |i: usize| between(&from, &to, i as f32 / steps as f32);
                    answers[usize::from(is_free)] += 1;
                    if is_free {
                        assert!((1..=steps).all(|i| less.is_free(&at(i))), "{robot}: {from:?} {to:?}");
                    } else {
                        assert!((0..=steps).any(|i| !more.is_free(&at(i))), "{robot}: {from:?} {to:?}");
                    }
                }
            }
        }
        assert!(answers.iter().all(|count| *count > 30), "{robot}: {answers:?}");
    }
}

#[test]
fn a_way_that_slips_through_a_thin_plate_is_mended_or_refused() {
    let (urdf, names) = chain(4);
    let mechanism = Mechanism::read(&urdf, None, &names).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let (mut slipped, mut mended) = (0, 0);
    // Few ways slip through: as many are looked at as it takes to see some that do.
    for _ in 0..2_000 {
        if slipped > 3 && mended > 0 {
            break;
        }
        let geometry = Geometry::Box { half: [0.3, 0.3, 0.0005] };
        let plates: Vec<Obstacle> = (0..3)
            .map(|i| {
                let place = random_pose(&mut random, 0.9);
                Obstacle { name: format!("plate {i}"), pose: place, geometry }
            })
            .collect();
        let mut thin = mechanism.clone();
        // 4 mm thick, and 3 cm from posture to posture at the far end.
        thin.pad_all(-0.033);
        let mut space = Space::new(&thin, &plates);
        let (start, goal) = (posture(&mut random, &thin), posture(&mut random, &thin));
        let few = Budget { iterations: 3_000, seed: 3 };
        let Ok(route) = connect(&mut space, &start, &[goal], few, &mut go_on) else { continue };
        let whole = route.path.windows(2).all(|pair| space.is_swept_free(&pair[0], &pair[1]));
        slipped += usize::from(!whole);
        match simplify(&mut space, &route.path, few, &mut go_on) {
            Ok(path) => {
                mended += usize::from(!whole);
                let postures: Vec<Vec<f64>> = path.iter().map(|s| positions(&thin, s)).collect();
                assert_eq!(Exact::new(&thin, &plates).touch_along(&postures, 1000.0), None);
            }
            Err(error) => assert!(matches!(error, ConnectError::Exhausted { .. }), "{error}"),
        }
        assert!(!space.is_swept());
    }
    assert!(slipped > 1 && mended > 0, "{slipped} slipped, {mended} mended");
}

#[test]
fn the_nearest_of_several_goals_that_is_free_is_reached() {
    let (urdf, names) = chain(4);
    let mechanism = Mechanism::read(&urdf, None, &names).unwrap();
    let state = |q: [f32; 4]| -> State { std::array::from_fn(|j| q.get(j).copied().unwrap_or(0.0)) };
    let (start, blocked, open) = (state([0.0; 4]), state([0.6, 0.0, 0.0, 0.0]), state([-1.2, 0.0, 0.0, 0.0]));
    let at = Pose::at(0.6 * 0.6_f64.cos(), 0.6 * 0.6_f64.sin(), 0.0);
    let wall = Obstacle { name: "wall".into(), pose: at, geometry: Geometry::Sphere { radius: 0.05 } };
    let mut space = Space::new(&mechanism, std::slice::from_ref(&wall));
    let route = connect(&mut space, &start, &[blocked, open], BUDGET, &mut go_on).unwrap();
    assert_eq!((route.goal, route.path[route.path.len() - 1]), (1, open));
    let none = connect(&mut space, &start, &[blocked], BUDGET, &mut go_on);
    assert_eq!(none, Err(ConnectError::Goal { goals: 1 }));
    let touch = Exact::new(&mechanism, &[wall]).touch(&[0.6, 0.0, 0.0, 0.0]).unwrap();
    assert_eq!(touch.other, "wall");
    assert!((0.02..0.09).contains(&touch.depth_m), "{touch}");
}

#[test]
fn a_search_that_is_cancelled_or_out_of_iterations_ends_and_says_so() {
    let (urdf, names) = chain(4);
    let mechanism = Mechanism::read(&urdf, None, &names).unwrap();
    // The first link cannot go round this plate.
    let geometry = Geometry::Box { half: [2.0, 0.005, 2.0] };
    let plate = Obstacle { name: "plate".into(), pose: Pose::at(2.06, 0.0, 0.0), geometry };
    let mut space = Space::new(&mechanism, &[plate]);
    let state = |first: f32| -> State { std::array::from_fn(|j| if j == 0 { first } else { 0.0 }) };
    let few = Budget { iterations: 3000, seed: 0 };
    let outcome = connect(&mut space, &state(-0.95), &[state(1.2)], few, &mut go_on);
    assert_eq!(outcome, Err(ConnectError::Exhausted { iterations: 3000 }));
    let mut asked = 0;
    let mut second_time = |_: usize| {
        asked += 1;
        if asked == 2 { Control::Cancelled } else { Control::Continue }
    };
    let outcome = connect(&mut space, &state(-0.95), &[state(1.2)], few, &mut second_time);
    assert_eq!((outcome, asked), (Err(ConnectError::Cancelled), 2));
    let mut at_once = |_: usize| Control::TimeUp;
    let outcome = connect(&mut space, &state(-0.95), &[state(1.2)], few, &mut at_once);
    assert!(matches!(outcome, Err(ConnectError::TimeUp { .. })), "{outcome:?}");
}

#[test]
fn a_search_asks_less_often_where_most_samples_are_too_far_from_a_tree_for_a_motion() {
    let (urdf, names) = chain(6);
    let mechanism = Mechanism::read(&urdf, None, &names).unwrap();
    // The arm cannot leave this tunnel, so its tree stays small and gets nearly all samples.
    let side = |y: f64, z: f64| {
        let half = if z == 0.0 { [1.0, 0.01, 0.2] } else { [1.0, 0.2, 0.01] };
        Obstacle { name: format!("{y} {z}"), pose: Pose::at(1.3, y, z), geometry: Geometry::Box { half } }
    };
    let mut space = Space::new(&mechanism, &[side(0.12, 0.0), side(-0.12, 0.0), side(0.0, 0.12), side(0.0, -0.12)]);
    let state = |first: f32| -> State { std::array::from_fn(|j| if j == 0 { first } else { 0.0 }) };
    let mut asked = 0;
    let mut count = |_: usize| {
        asked += 1;
        Control::Continue
    };
    let few = Budget { iterations: 6400, seed: 0 };
    let outcome = connect(&mut space, &state(0.0), &[state(2.0)], few, &mut count);
    assert_eq!(outcome, Err(ConnectError::Exhausted { iterations: 6400 }));
    // A question for every 32 samples would make 200.
    assert!((25..100).contains(&asked), "asked {asked} times");
}

#[test]
fn a_cancel_is_noticed_within_five_milliseconds_during_search_and_simplification() {
    let (urdf, names) = chain(6);
    let mechanism = Mechanism::read(&urdf, None, &names).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(8);
    let (mut longest, mut problems) = (Duration::ZERO, 0);
    while problems < 6 {
        let obstacles = clutter(&mut random, 30, 1.2);
        let mut space = Space::new(&mechanism, &obstacles);
        let (start, goal) = (posture(&mut random, &mechanism), posture(&mut random, &mechanism));
        let Ok(route) = connect(&mut space, &start, &[goal], BUDGET, &mut go_on) else { continue };
        if route.iterations < 100 {
            continue;
        }
        problems += 1;
        let mut run = || {
            let (mut gaps, mut last) = (Vec::new(), Instant::now());
            let mut note = |_: usize| {
                gaps.push(last.elapsed());
                last = Instant::now();
                Control::Continue
            };
            let route = connect(&mut space, &start, &[goal], BUDGET, &mut note).unwrap();
            simplify(&mut space, &route.path, BUDGET, &mut note).unwrap();
            gaps.push(last.elapsed());
            gaps
        };
        // The same work every time: the least of several runs is without what else the machine did.
        let runs: Vec<Vec<Duration>> = (0..5).map(|_| run()).collect();
        assert!(runs.iter().all(|gaps| gaps.len() == runs[0].len()));
        let least = |i: usize| runs.iter().map(|gaps| gaps[i]).min().unwrap();
        longest = (0..runs[0].len()).map(least).fold(longest, Duration::max);
        for answer in 1..runs[0].len() {
            let mut asked = 0;
            let mut stop = |_: usize| {
                asked += 1;
                if asked == answer { Control::Cancelled } else { Control::Continue }
            };
            let outcome = connect(&mut space, &start, &[goal], BUDGET, &mut stop)
                .and_then(|route| simplify(&mut space, &route.path, BUDGET, &mut stop));
            assert_eq!((outcome, asked), (Err(ConnectError::Cancelled), answer));
        }
    }
    assert!(longest < Duration::from_millis(5), "{longest:?}");
}

#[test]
fn pairs_that_the_srdf_disables_are_not_checked_and_all_others_are() {
    let (urdf, names) = chain(6);
    // The last link touches the first.
    let folded = [0.0, 2.3, 0.0, 2.3, 0.0, 2.3];
    let disabled = |pairs: &[(usize, usize)]| {
        let line = |(a, b): &(usize, usize)| format!("<disable_collisions link1='l{b}' link2='l{a}' reason='Never'/>");
        format!("<robot name='chain'>{}</robot>", pairs.iter().map(line).collect::<String>())
    };
    let all: Vec<(usize, usize)> = (1..=6).flat_map(|b| (1..b).map(move |a| (a, b))).chain([(1, 99)]).collect();
    let most: Vec<(usize, usize)> = all.iter().copied().filter(|pair| *pair != (1, 6)).collect();
    let (all, most) = (disabled(&all), disabled(&most));
    for (srdf, touches) in [(Some(&most[..]), true), (Some(&all[..]), false), (None, true)] {
        let mechanism = Mechanism::read(&urdf, srdf, &names).unwrap();
        assert_eq!(Exact::new(&mechanism, &[]).touch(&folded).is_some(), touches, "{srdf:?}");
        let state: State = std::array::from_fn(|j| folded.get(j).map_or(0.0, |q| *q as f32));
        assert_eq!(Space::new(&mechanism, &[]).is_free(&state), !touches, "{srdf:?}");
    }
    assert!(Mechanism::read(&urdf, Some("<robot"), &names).unwrap_err().to_string().contains("SRDF"));
    let unknown = Mechanism::read(&urdf, None, &["elbow".to_owned()]).unwrap_err();
    assert!(unknown.to_string().contains("no joint `elbow`"), "{unknown}");
}

#[test]
fn padding_is_the_same_in_both_checks_and_held_by_the_spheres() {
    let mut mechanism = arm();
    mechanism.pad_all(0.03);
    // Links of an arm are nearer to each other than that.
    let all = 0..mechanism.links.len();
    mechanism.excepted = all.clone().flat_map(|b| all.clone().map(move |a| (a, b))).collect();
    let mut random = ChaCha8Rng::seed_from_u64(6);
    let mut free = 0;
    for _ in 0..10 {
        let obstacles = clutter(&mut random, 8, 1.5);
        let exact = Exact::new(&mechanism, &obstacles);
        let mut space = Space::new(&mechanism, &obstacles);
        for _ in 0..100 {
            let state = posture(&mut random, &mechanism);
            if space.is_free(&state) {
                free += 1;
                assert_eq!(exact.touch(&positions(&mechanism, &state)), None);
            }
        }
    }
    assert!(free > 50, "{free}");
    let (urdf, names) = chain(4);
    let ball = Geometry::Sphere { radius: 0.05 };
    let beside = [Obstacle { name: "ball".into(), pose: Pose::at(0.58, 0.0, 0.10), geometry: ball }];
    for (padding, is_free) in [(0.0, true), (0.014, true), (0.016, false)] {
        let mut mechanism = Mechanism::read(&urdf, None, &names).unwrap();
        mechanism.pad(mechanism.link("l3").unwrap(), padding);
        assert_eq!(Space::new(&mechanism, &beside).is_free(&[0.0; MAX_JOINTS]), is_free, "{padding}");
        assert_eq!(Exact::new(&mechanism, &beside).touch(&[0.0; 4]).is_none(), is_free, "{padding}");
    }
}

#[test]
fn what_is_attached_moves_along_and_may_touch_only_what_is_allowed() {
    let (urdf, names) = chain(4);
    let mut mechanism = Mechanism::read(&urdf, None, &names).unwrap();
    let hand = mechanism.link("l4").unwrap();
    let table = Geometry::Box { half: [0.1, 0.1, 0.01] };
    let things = [
        Obstacle { name: "table".into(), pose: Pose::at(1.05, 0.0, -0.075), geometry: table },
        Obstacle { name: "post".into(), pose: Pose::at(0.0, 1.05, -0.075), geometry: table },
    ];
    let there: State = std::array::from_fn(|j| if j == 0 { std::f32::consts::FRAC_PI_2 } else { 0.0 });
    let free = |mechanism: &Mechanism, state: &State| {
        let exact = Exact::new(mechanism, &things).touch(&positions(mechanism, state));
        assert_eq!(Space::new(mechanism, &things).is_free(state), exact.is_none(), "{exact:?}");
        exact.is_none()
    };
    assert!(free(&mechanism, &[0.0; MAX_JOINTS]) && free(&mechanism, &there));
    let cube = Geometry::Box { half: [0.03; 3] }.at(Pose::at(0.29, 0.0, -0.04));
    let held = mechanism.attach("cube", hand, vec![cube], &[]);
    assert!(!free(&mechanism, &[0.0; MAX_JOINTS]) && !free(&mechanism, &there));
    let touch = Exact::new(&mechanism, &things).touch(&[0.0; 4]).unwrap();
    assert_eq!((&touch.link[..], &touch.other[..]), ("cube", "table"));
    mechanism.allow(held, "table");
    assert!(free(&mechanism, &[0.0; MAX_JOINTS]) && !free(&mechanism, &there));
}

#[test]
fn a_problem_that_cannot_be_says_what_touches_what_and_how_deep() {
    let (urdf, names) = chain(4);
    let mechanism = Mechanism::read(&urdf, None, &names).unwrap();
    let ball = Geometry::Sphere { radius: 0.05 };
    let obstacles = vec![
        Obstacle { name: "near".into(), pose: Pose::at(0.58, 0.0, 0.08), geometry: ball },
        Obstacle { name: "nearer".into(), pose: Pose::at(0.58, 0.0, -0.075), geometry: ball },
    ];
    let problem = Problem { obstacles, start: vec![1.0, 0.0, 0.0, 0.0], goal: vec![0.0; 4], ..Problem::default() };
    let settings = Settings { budget: BUDGET, repetitions: 1, limit: f64::INFINITY };
    let mut now = 0.0;
    let mut clock = || {
        now += 1.0;
        now
    };
    let tried = trial::run(&mechanism, &problem, settings, &mut clock);
    assert_eq!(tried.outcome, Err(ConnectError::Goal { goals: 1 }));
    let expected = ["goal state: l3 is 10.0 mm inside nearer", "goal state: l3 is 5.0 mm inside near"];
    assert_eq!(tried.diagnosis, expected);
    let mut far = problem.clone();
    far.start[1] = 2.6;
    let tried = trial::run(&mechanism, &far, settings, &mut clock);
    assert_eq!(tried.outcome, Err(ConnectError::Start));
    assert!(tried.diagnosis[0].starts_with("start state: j2 is at 2.6, outside -2.5 to 2.5 by 1.00e-1"));
}

#[test]
fn a_file_of_problems_is_read_and_a_wrong_one_says_where() {
    let object = r#"{"name": "can", "type": "cylinder", "position": [1, 0, 0], "quat_xyzw": [0, 0, 0, 2], "length": 0.2, "radius": 0.05}"#;
    let file = |goal: &str, object: &str| {
        format!(
            r#"{{"robot": "r", "joints": ["a", "b"], "problems": {{"shelf": [{{"index": 3, "objects": [{object}], "attached": 0,
            "start": [0, 1], "goal": {goal}}}]}}}}"#
        )
    };
    let problems = Problems::parse(&file("[1, 2]", object)).unwrap();
    let problem = &problems.classes["shelf"][0];
    assert_eq!((problem.index, &problem.start[..], &problem.goal[..]), (3, &[0.0, 1.0][..], &[1.0, 2.0][..]));
    assert_eq!(problem.obstacles[0].geometry, Geometry::Cylinder { radius: 0.05, half_length: 0.1 });
    let error = Problems::parse(&file("[1]", object)).unwrap_err().to_string();
    assert_eq!(error, "problem 3 of class `shelf`: its goal has 1 positions, the robot has 2 joints");
    let flat = object.replace("0.05", "-1");
    let error = Problems::parse(&file("[1, 2]", &flat)).unwrap_err().to_string();
    assert_eq!(error, "problem 3 of class `shelf`: object `can` has no proper size, place or rotation");
    let error = Problems::parse(&file("[1, 2]", object).replace(r#""b"]"#, r#""a"]"#)).unwrap_err().to_string();
    assert_eq!(error, "the joint `a` is named twice in `joints`");
    let error = Problems::parse(r#"{"joints": [], "problems": {"shelf": []}}"#).unwrap_err().to_string();
    assert!(error.contains("`joints` is empty"), "{error}");
    let error = Problems::parse(r#"{"joints": ["a"], "problems": {"shelf": []}}"#).unwrap_err().to_string();
    assert!(error.starts_with("it holds no problems"), "{error}");
    assert!(Problems::parse("{").is_err());
}

#[test]
fn more_obstacles_than_sixteen_bits_count_are_all_there() {
    let (urdf, names) = chain(4);
    let mechanism = Mechanism::read(&urdf, None, &names).unwrap();
    let crumb = Geometry::Sphere { radius: 0.001 };
    // All within reach and none of them near the straight arm, but the last.
    let place = |i: usize| Pose::at(-0.4 + 0.001 * (i % 300) as f64, 0.3, -0.2 + 0.001 * (i / 300) as f64);
    let mut obstacles: Vec<Obstacle> =
        (0..66_000).map(|i| Obstacle { name: String::new(), pose: place(i), geometry: crumb }).collect();
    assert!(Space::new(&mechanism, &obstacles).is_free(&[0.0; MAX_JOINTS]));
    let ball = Geometry::Sphere { radius: 0.1 };
    obstacles.push(Obstacle { name: "ball".into(), pose: Pose::at(0.6, 0.0, 0.0), geometry: ball });
    assert!(!Space::new(&mechanism, &obstacles).is_free(&[0.0; MAX_JOINTS]));
}

#[test]
fn links_that_no_joint_moves_against_each_other_are_a_pair_for_neither_check() {
    // Two fingers of a hand that overlap as they are made, and a body beside the base.
    let link = |name: &str, radius: f64| {
        format!("<link name='{name}'><collision><geometry><sphere radius='{radius}'/></geometry></collision></link>")
    };
    let joint = |kind: &str, parent: &str, child: &str, x: f64| {
        format!(
            "<joint name='{parent}_{child}' type='{kind}'><origin xyz='{x} 0 0'/><parent link='{parent}'/><child link='{child}'/>\
             <axis xyz='0 0 1'/><limit lower='-2.8' upper='2.8' effort='1' velocity='1'/></joint>"
        )
    };
    let mut urdf = String::from("<robot name='two arms'>") + &link("base", 0.05) + &link("post", 0.05);
    urdf += &joint("fixed", "base", "post", 0.02);
    for (side, x) in [("left", -0.6), ("right", 0.6)] {
        let [arm, hand, finger, thumb] = ["arm", "hand", "finger", "thumb"].map(|part| format!("{side}_{part}"));
        urdf += &(link(&arm, 0.04) + &link(&hand, 0.04) + &link(&finger, 0.02) + &link(&thumb, 0.02));
        urdf += &joint("revolute", "base", &arm, x);
        urdf += &joint("revolute", &arm, &hand, 0.2);
        urdf += &joint("fixed", &hand, &finger, 0.05);
        urdf += &joint("fixed", &hand, &thumb, 0.055);
    }
    let nothing = "<robot name='two arms'/>";
    let mechanism = Mechanism::read(&(urdf + "</robot>"), Some(nothing), &[]).unwrap();
    assert_eq!(mechanism.joints.len(), 4);
    let exact = Exact::new(&mechanism, &[]);
    assert_eq!(exact.touch(&[0.0; 4]), None);
    let mut space = Space::new(&mechanism, &[]);
    let mut random = ChaCha8Rng::seed_from_u64(8);
    for _ in 0..500 {
        let state = posture(&mut random, &mechanism);
        assert_eq!(space.is_free(&state), exact.touch(&positions(&mechanism, &state)).is_none(), "{state:?}");
    }
}

#[test]
#[allow(clippy::approx_constant, reason = "the positions of a file, rounded to four digits")]
fn a_position_that_is_rounded_beyond_a_limit_is_taken_as_the_limit_and_said() {
    let (urdf, names) = chain(4);
    let mechanism = Mechanism::read(&urdf.replace("2.5'", "3.14159265'"), Some(&folding(4)), &names).unwrap();
    let settings = Settings { budget: BUDGET, repetitions: 1, limit: f64::INFINITY };
    let try_goal = |goal: f64| {
        let problem = Problem { start: vec![0.0; 4], goal: vec![0.5, goal, 0.0, 0.0], ..Problem::default() };
        trial::run(&mechanism, &problem, settings, &mut || 0.0)
    };
    for goal in [3.1416, -3.1416] {
        let found = try_goal(goal).outcome.unwrap();
        assert!((found.path[found.path.len() - 1][1].abs() - std::f64::consts::PI).abs() < 1e-6);
        assert_eq!(found.clamped.len(), 1, "{:?}", found.clamped);
        let expected = format!("goal state: j2 is at {goal}, beyond the limit by 7.35e-6; taken as the limit");
        assert_eq!(found.clamped[0], expected);
    }
    assert!(try_goal(3.14).outcome.unwrap().clamped.is_empty());
    let tried = try_goal(3.142);
    assert_eq!(tried.outcome, Err(ConnectError::Goal { goals: 1 }));
    assert_eq!(tried.diagnosis, ["goal state: j2 is at 3.142, outside -3.14159265 to 3.14159265 by 4.07e-4"]);
}

#[test]
fn a_robot_that_is_not_one_says_where_and_why() {
    let (urdf, names) = chain(2);
    let refusal = |text: &str, joints: &[String]| {
        let error = Mechanism::read(text, None, joints).unwrap_err();
        let mut said = error.to_string();
        let mut next = std::error::Error::source(&error);
        while let Some(cause) = next {
            said += &format!(": {cause}");
            next = cause.source();
        }
        said
    };
    let unclosed = urdf.replace("<link name='l1'>", "\n\n<link name='l1'");
    let said = refusal(&unclosed, &names);
    assert!(said.contains("line 3"), "{said}");
    let nameless = urdf.replace("<link name='l0'/>", "\n<link/>");
    let said = refusal(&nameless, &names);
    assert!(said.contains("`link`") && said.contains("name") && said.contains("line 2"), "{said}");
    let worded = urdf.replace("radius='0.035'", "radius='wide'");
    let said = refusal(&worded, &names);
    assert!(said.contains("radius") && said.contains("wide"), "{said}");
    let twice = [names[0].clone(), names[1].clone(), names[0].clone()];
    assert_eq!(refusal(&urdf, &twice), "the joint `j1` is named twice among those to be planned for");
}

/// Arms of seven joints beside each other.
fn arms(count: usize) -> Mechanism {
    let mut urdf = String::from("<robot name='arms'><link name='base'/>");
    let mut names = Vec::new();
    for arm in 0..count {
        let (chain, joints) = chain(7);
        let links = chain.replace("<robot name='chain'>", "").replace("</robot>", "");
        urdf += &links.replace("='l", &format!("='arm{arm}_l")).replace("='j", &format!("='arm{arm}_j"));
        urdf += &format!(
            "<joint name='mount{arm}' type='fixed'><origin xyz='0 {} 0'/><parent link='base'/><child link='arm{arm}_l0'/></joint>",
            arm as f64
        );
        names.extend(joints.iter().map(|joint| format!("arm{arm}_{joint}")));
    }
    Mechanism::read(&(urdf + "</robot>"), None, &names).unwrap()
}

#[test]
fn two_arms_solve_what_one_arm_does() {
    let (one, two) = (arms(1), arms(2));
    assert_eq!((one.joints.len(), two.joints.len()), (7, 14));
    let mut random = ChaCha8Rng::seed_from_u64(9);
    let (mut tried, mut searched) = (0, 0);
    while tried < 6 {
        // The same things about each arm.
        let things = clutter(&mut random, 10, 0.9);
        let moved = |y: f64| {
            let there = |o: &Obstacle| Obstacle { pose: Pose::at(0.0, y, 0.0).compose(&o.pose), ..o.clone() };
            things.iter().map(there).collect::<Vec<_>>()
        };
        let both = [moved(0.0), moved(1.0)].concat();
        let (mut alone, mut together) = (Space::new(&one, &both), Space::new(&two, &both));
        let (start, goal) = (posture(&mut random, &two), posture(&mut random, &two));
        if !together.is_free(&start) || !together.is_free(&goal) {
            continue;
        }
        let first = |state: &State| std::array::from_fn(|j| if j < 7 { state[j] } else { 0.0 });
        if connect(&mut alone, &first(&start), &[first(&goal)], BUDGET, &mut go_on).is_err() {
            continue;
        }
        tried += 1;
        let route =
            connect(&mut together, &start, &[goal], Budget { iterations: 60_000, ..BUDGET }, &mut go_on).unwrap();
        searched += usize::from(route.path.len() > 2);
        let path = simplify(&mut together, &route.path, BUDGET, &mut go_on).unwrap();
        assert_eq!((path[0], path[path.len() - 1]), (start, goal));
        assert!(path_length(&path) <= path_length(&route.path) * 1.001);
        let path: Vec<Vec<f64>> = path.iter().map(|state| positions(&two, state)).collect();
        assert_eq!(Exact::new(&two, &both).touch_along(&path, 128.0), None);
    }
    assert!(searched >= 4, "{searched}");
}
