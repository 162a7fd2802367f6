//! Clouds of points and meshes as obstacles: what the vector checks say beside the exact shapes, and beside looking at every point.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::cloud::{Cloud, CloudError};
use ratn_motion::connect::{Budget, connect};
use ratn_motion::exact::Exact;
use ratn_motion::geometry::Geometry;
use ratn_motion::heightfield::Heights;
use ratn_motion::inside::Inside;
use ratn_motion::mechanism::{MAX_JOINTS, Mechanism};
use ratn_motion::mesh::Mesh;
use ratn_motion::pace::Control;
use ratn_motion::point_files;
use ratn_motion::problems::{Problem, Problems};
use ratn_motion::simplify::simplify;
use ratn_motion::space::{Isa, Obstacle, Space, State, between};
use ratn_motion::surroundings::{MeshObstacle, OVERHANG_M, Surroundings};
use std::sync::Arc;

const BUDGET: Budget = Budget { iterations: 20_000, seed: 1 };

/// Joints about z and y in turn, each link three spheres along x; neighbours may fold onto each other.
fn chain(joints: usize) -> Mechanism {
    let mut urdf = String::from("<robot name='chain'><link name='l0'/>");
    let mut names = Vec::new();
    for i in 1..=joints {
        urdf += &format!("<link name='l{i}'>");
        for (x, radius) in [(0.08, 0.05), (0.14, 0.03), (0.20, 0.015)] {
            urdf += &format!(
                "<collision><origin xyz='{x} 0 0'/><geometry><sphere radius='{radius}'/></geometry></collision>"
            );
        }
        let (x, axis) = (if i == 1 { 0.0 } else { 0.25 }, ["0 1 0", "0 0 1"][i % 2]);
        urdf += &format!(
            "</link><joint name='j{i}' type='revolute'><origin xyz='{x} 0 0'/><parent link='l{}'/><child link='l{i}'/>\
             <axis xyz='{axis}'/><limit lower='-2.5' upper='2.5' effort='1' velocity='1'/></joint>",
            i - 1
        );
        names.push(format!("j{i}"));
    }
    let fold = |i: usize| format!("<disable_collisions link1='l{i}' link2='l{}' reason='Adjacent'/>", i + 1);
    let srdf = format!("<robot name='chain'>{}</robot>", (1..joints).map(fold).collect::<String>());
    Mechanism::read(&(urdf + "</robot>"), Some(&srdf), &names).unwrap()
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

fn random_pose(random: &mut impl Rng, reach: f64) -> Pose {
    let mut range = |most: f64| random.random_range(-most..most);
    Pose::from_rpy([range(reach), range(reach), range(reach)], range(3.1), range(1.5), range(3.1))
}

/// Points of four kinds: on planes, in a ball, on a line, alone.
fn scattered(random: &mut impl Rng, count: usize) -> Vec<[f32; 3]> {
    let patches: Vec<Pose> = (0..8).map(|_| random_pose(random, 0.6)).collect();
    let point = |i: usize| {
        let mut range = |most: f64| random.random_range(-most..most);
        let local = match i % 8 {
            0..=3 => [range(0.2), range(0.2), 0.0],
            4 | 5 => [range(0.05), range(0.05), range(0.05)],
            6 => [range(0.3), 0.0, 0.0],
            _ => [range(1.0), range(1.0), range(1.0)],
        };
        patches[i % 8].transform(local).map(|c| c as f32)
    };
    (0..count).map(point).collect()
}

#[test]
fn a_cloud_is_judged_exactly_by_every_instruction_set() {
    let mechanism = chain(5);
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let (mut free, mut touching) = (0, 0);
    for (count, radius) in [(0, 0.01), (1, 0.02), (7, 0.02), (300, 0.01), (4_000, 0.003)] {
        let points = scattered(&mut random, count);
        let clouds = [Cloud::new("cloud", &points, radius).unwrap()];
        let exact = Exact::new(&mechanism, &clouds[..]);
        let spaces = || Isa::available().into_iter().map(|isa| Space::with_isa(&mechanism, &clouds[..], isa));
        let mut spaces: Vec<Space> = spaces().collect();
        let mut thin = mechanism.clone();
        thin.pad_all(-1e-4);
        let mut smaller = Space::new(&thin, &clouds[..]);
        for _ in 0..400 {
            let state = posture(&mut random, &mechanism);
            let poses = mechanism.poses(&positions(&mechanism, &state));
            let alone = Exact::new(&mechanism, &[]).touch(&positions(&mechanism, &state)).is_some();
            // Every sphere beside every point.
            let deepest = mechanism.links.iter().zip(&poses).flat_map(|(link, pose)| {
                link.spheres.iter().map(|sphere| (pose.transform(sphere.centre), sphere.radius + radius))
            });
            let gap = deepest.map(|(at, reach)| {
                let away = |p: &[f32; 3]| (0..3).map(|i| (f64::from(p[i]) - at[i]).powi(2)).sum::<f64>().sqrt() - reach;
                points.iter().map(away).fold(f64::INFINITY, f64::min)
            });
            let gap = gap.fold(f64::INFINITY, f64::min);
            let touch = exact.touch(&positions(&mechanism, &state));
            assert!(alone || gap.abs() < 1e-5 || touch.is_some() == (gap < 0.0), "{gap}: {touch:?}");
            for space in &mut spaces {
                if space.is_free(&state) {
                    free += 1;
                    assert!(!alone && gap > 0.0, "{:?} misses {gap}", space.isa());
                } else {
                    touching += 1;
                    // Spheres are grown by 0.02 mm.
                    assert!(gap < 3e-5 || !smaller.is_free(&state) && alone, "{:?} sees {gap}", space.isa());
                }
            }
        }
    }
    assert!(free > 500 && touching > 300, "{free} free, {touching} touching");
}

#[test]
fn paths_among_points_are_free_by_the_exact_check_and_motions_between_their_postures() {
    let mechanism = chain(5);
    let mut random = ChaCha8Rng::seed_from_u64(2);
    let (mut solved, mut indirect) = (0, 0);
    for _ in 0..12 {
        let clouds = [Cloud::new("cloud", &scattered(&mut random, 3_000), 0.004).unwrap()];
        let exact = Exact::new(&mechanism, &clouds[..]);
        let mut space = Space::new(&mechanism, &clouds[..]);
        let (start, goal) = (posture(&mut random, &mechanism), posture(&mut random, &mechanism));
        let mut go_on = |_: usize| Control::Continue;
        let Ok(route) = connect(&mut space, &start, &[goal], BUDGET, &mut go_on) else { continue };
        let path = simplify(&mut space, &route.path, BUDGET, &mut go_on).unwrap();
        solved += 1;
        indirect += usize::from(path.len() > 2);
        let postures: Vec<Vec<f64>> = path.iter().map(|s| positions(&mechanism, s)).collect();
        assert_eq!(exact.touch_along(&postures, 500.0), None);
    }
    assert!(solved > 3 && indirect > 1, "{solved} solved, {indirect} not straight");
}

#[test]
fn a_motion_swept_free_of_points_is_free_wherever_one_looks() {
    let mechanism = chain(4);
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let mut free = 0;
    for _ in 0..60 {
        // A fence of points that slips between postures.
        let points: Vec<[f32; 3]> = scattered(&mut random, 200);
        let clouds = [Cloud::new("fence", &points, 0.001).unwrap()];
        let exact = Exact::new(&mechanism, &clouds[..]);
        let (from, to) = (posture(&mut random, &mechanism), posture(&mut random, &mechanism));
        let to = between(&from, &to, 0.4);
        let mut spaces = Isa::available().into_iter().map(|isa| Space::with_isa(&mechanism, &clouds[..], isa));
        if spaces.any(|mut space| space.is_free(&from) && space.is_swept_free(&from, &to)) {
            free += 1;
            for i in 0..=1000 {
                let state = between(&from, &to, i as f32 / 1000.0);
                assert_eq!(exact.touch(&positions(&mechanism, &state)), None, "at {i} of 1000");
            }
        }
    }
    assert!(free > 5, "{free}");
}

#[test]
fn a_thinned_cloud_holds_the_whole_one_within_its_bound() {
    let mut random = ChaCha8Rng::seed_from_u64(4);
    let whole = Cloud::new("cloud", &scattered(&mut random, 5_000), 0.01).unwrap();
    let thin = whole.thinned(0.03).unwrap();
    assert!(thin.points().len() < whole.points().len() * 2 / 3);
    assert!(thin.radius_m() > 0.04 && thin.radius_m() < 0.0401);
    let away = |p: &[f32; 3], q: &[f32; 3]| (0..3).map(|i| f64::from(p[i] - q[i]).powi(2)).sum::<f64>().sqrt();
    for point in whole.points() {
        assert!(thin.points().iter().any(|kept| away(point, kept) + whole.radius_m() <= thin.radius_m()));
    }
    assert!(thin.points().iter().all(|kept| whole.points().contains(kept)));
    assert_eq!(whole.thinned(0.0).unwrap(), whole);
}

#[test]
fn thinning_by_next_to_nothing_is_refused_and_by_a_micrometre_it_loses_nothing() {
    let mut random = ChaCha8Rng::seed_from_u64(11);
    let mut points = scattered(&mut random, 2_000);
    points.push([999.0, -999.0, 999.0]);
    points.push([999.1, -999.0, 999.0]);
    let whole = Cloud::new("cloud", &points, 0.01).unwrap();
    for bound in [1e-7, 1e-30, 1e-320, -0.01, 1.5, f64::NAN, f64::INFINITY] {
        let refused = whole.thinned(bound).unwrap_err().to_string();
        assert!(
            refused.starts_with("the bound of thinning is ") && refused.ends_with(" m: expected 0, or 0.000001 to 1"),
            "{refused}"
        );
    }
    let thin = whole.thinned(1e-6).unwrap();
    for point in whole.points() {
        let is_near = |kept: &&[f32; 3]| (0..3).map(|i| f64::from(kept[i] - point[i]).powi(2)).sum::<f64>() <= 1e-12;
        assert!(thin.points().iter().any(|kept| is_near(&kept)), "{point:?} is gone");
    }
}

#[test]
fn what_a_camera_saw_of_the_robot_is_left_out_and_nothing_else() {
    let mechanism = chain(4);
    let posture = [0.3, -0.4, 0.5, 0.2];
    let poses = mechanism.poses(&posture);
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let mut own: Vec<[f32; 3]> = Vec::new();
    for (link, pose) in mechanism.links.iter().zip(&poses) {
        for sphere in &link.spheres {
            for _ in 0..50 {
                let direction: [f64; 3] = std::array::from_fn(|_| random.random_range(-1.0..1.0));
                let length = direction.iter().map(|c| c * c).sum::<f64>().sqrt();
                let at = std::array::from_fn(|i| sphere.centre[i] + direction[i] / length * (sphere.radius + 0.004));
                own.push(pose.transform(at).map(|c| c as f32));
            }
        }
    }
    let others = [[0.0_f32, 0.0, 0.8], [0.5, 0.9, 0.1]];
    let seen = Cloud::new("camera", &[own, others.to_vec()].concat(), 0.01).unwrap();
    assert!(Exact::new(&mechanism, std::slice::from_ref(&seen)).touch(&posture).is_some());
    let cloud = seen.without_robot(&mechanism, &posture, 0.005).unwrap();
    assert_eq!(cloud.points().len(), 2);
    assert_eq!(Exact::new(&mechanism, std::slice::from_ref(&cloud)).touch(&posture), None);
}

#[test]
fn clouds_that_cannot_be_are_refused_by_point_and_radius() {
    let refused = |points: &[[f32; 3]], radius: f64| Cloud::new("cloud", points, radius).unwrap_err();
    assert_eq!(refused(&[[0.0; 3], [0.0, f32::NAN, 0.0]], 0.01), CloudError::NotFinite { point: 1 });
    assert_eq!(refused(&[[0.0, 0.0, 1e9]], 0.01), CloudError::NotFinite { point: 0 });
    for radius in [0.0, -1.0, f64::NAN, 2.0] {
        assert!(matches!(refused(&[], radius), CloudError::Radius { .. }), "{radius}");
    }
}

/// A block as a mesh.
fn block(half: [f64; 3]) -> Vec<[[f64; 3]; 3]> {
    let corner = |i: usize| std::array::from_fn(|axis| if i >> axis & 1 == 0 { -half[axis] } else { half[axis] });
    let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    sides.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).map(|t| t.map(corner)).collect()
}

#[test]
fn a_solid_mesh_is_the_block_that_it_is_the_surface_of() {
    let mechanism = chain(5);
    let mut random = ChaCha8Rng::seed_from_u64(6);
    let (mut free, mut touching, mut undecided) = (0, 0, 0);
    for case in 0..12 {
        // Some are larger than the whole robot.
        let half: [f64; 3] = std::array::from_fn(|_| random.random_range(0.02..if case % 4 == 0 { 1.5 } else { 0.3 }));
        let pose = random_pose(&mut random, 1.0);
        let primitive = [Obstacle { name: "block".into(), pose, geometry: Geometry::Box { half } }];
        let mesh = Arc::new(Mesh::new(block(half)).unwrap());
        let meshes = [MeshObstacle { name: "block".into(), pose, mesh, overhang_m: OVERHANG_M }];
        let (exact, as_mesh) = (Exact::new(&mechanism, &primitive), Exact::new(&mechanism, &meshes[..]));
        let mut spaces: Vec<Space> =
            Isa::available().into_iter().map(|isa| Space::with_isa(&mechanism, &meshes[..], isa)).collect();
        let mut padded = mechanism.clone();
        padded.pad_all(ratn_motion::surface::radius(&meshes[0].mesh, OVERHANG_M) + 1e-4);
        let larger = Exact::new(&padded, &primitive);
        for _ in 0..150 {
            let state = posture(&mut random, &mechanism);
            let at = positions(&mechanism, &state);
            let touch = exact.touch(&at);
            assert_eq!(touch.is_some(), as_mesh.touch(&at).is_some(), "{touch:?}");
            for space in &mut spaces {
                match (space.is_free(&state), &touch) {
                    (true, None) => free += 1,
                    (true, Some(touch)) => panic!("{:?} misses that {touch}", space.isa()),
                    (false, Some(_)) => touching += 1,
                    (false, None) => {
                        undecided += 1;
                        assert!(larger.touch(&at).is_some(), "{:?} sees a touch that is none", space.isa());
                    }
                }
            }
        }
    }
    assert!(free > 500 && touching > 500 && undecided < free / 10, "{free} free, {touching} touching, {undecided}");
}

/// What the vector checks say of a solid mesh beside what a primitive shape of the same form is; says how many were free, touching and undecided.
fn beside_a_block(mechanism: &Mechanism, half: [f64; 3], pose: Pose, random: &mut impl Rng) -> [usize; 3] {
    let primitive = [Obstacle { name: "block".into(), pose, geometry: Geometry::Box { half } }];
    let mesh = Arc::new(Mesh::new(block(half)).unwrap());
    let meshes = [MeshObstacle { name: "block".into(), pose, mesh, overhang_m: OVERHANG_M }];
    let exact = Exact::new(mechanism, &primitive);
    let mut padded = mechanism.clone();
    padded.pad_all(OVERHANG_M + 1e-3);
    let larger = Exact::new(&padded, &primitive);
    let mut spaces: Vec<Space> =
        Isa::available().into_iter().map(|isa| Space::with_isa(mechanism, &meshes[..], isa)).collect();
    let mut counts = [0; 3];
    for _ in 0..150 {
        let state = posture(random, mechanism);
        let at = positions(mechanism, &state);
        let touch = exact.touch(&at);
        for space in &mut spaces {
            match (space.is_free(&state), &touch) {
                (true, None) => counts[0] += 1,
                (true, Some(touch)) => panic!("{:?} misses that {touch}, {half:?} at {pose:?}", space.isa()),
                (false, Some(_)) => counts[1] += 1,
                (false, None) => {
                    counts[2] += 1;
                    assert!(
                        larger.touch(&at).is_some(),
                        "{:?} sees a touch that is none: {half:?} at {pose:?}",
                        space.isa()
                    );
                }
            }
        }
    }
    counts
}

#[test]
fn a_solid_mesh_far_beyond_the_reach_is_solid_where_its_surface_is_near_and_where_it_is_not() {
    let mechanism = chain(3);
    let mut random = ChaCha8Rng::seed_from_u64(8);
    let mut sum = [0; 3];
    for case in 0..6 {
        // Wrong units make millimetres metres: the largest are 300 m wide.
        let half: [f64; 3] = std::array::from_fn(|_| random.random_range(3.0..[10.0, 150.0][case % 2]));
        let mut pose = random_pose(&mut random, 0.3);
        // Deep inside; beside one side; beside an edge.
        for (axis, half) in half.iter().enumerate().take(case / 2 % 3) {
            let mut side = [0.0; 3];
            side[axis] = *half;
            let side = pose.rotate(side);
            pose.position = std::array::from_fn(|i| pose.position[i] + side[i]);
        }
        let counts = beside_a_block(&mechanism, half, pose, &mut random);
        sum = std::array::from_fn(|i| sum[i] + counts[i]);
        assert!(case / 2 % 3 > 0 || counts[0] == 0, "free deep inside: {counts:?}");
    }
    assert!(sum[0] > 100 && sum[1] > 300 && sum[2] < sum[0] / 10, "{sum:?}");
}

#[test]
fn the_ground_is_solid_below_and_free_above_as_far_as_the_robot_reaches() {
    let mechanism = chain(3);
    let mut random = ChaCha8Rng::seed_from_u64(9);
    for (size, depth) in [(3.0, 0.5), (40.0, 0.5), (40.0, 30.0)] {
        // A slope with steps across it.
        let height = |x: usize, y: usize| 0.02 * x as f64 - 0.25 + if y % 7 == 3 { 0.06 } else { 0.0 };
        let heights = Heights::new(25, (0..625).map(|i| height(i % 25, i / 25)).collect()).unwrap();
        let mesh = Arc::new(heights.solid([size; 2], -depth).unwrap());
        let meshes =
            [MeshObstacle { name: "ground".into(), pose: Pose::at(0.0, 0.0, -0.25), mesh, overhang_m: OVERHANG_M }];
        let exact = Exact::new(&mechanism, &meshes[..]);
        let mut padded = mechanism.clone();
        padded.pad_all(OVERHANG_M + 1e-3);
        let larger = Exact::new(&padded, &meshes[..]);
        let mut space = Space::new(&mechanism, &meshes[..]);
        let (mut free, mut touching) = (0, 0);
        for _ in 0..300 {
            let state = posture(&mut random, &mechanism);
            let at = positions(&mechanism, &state);
            match (space.is_free(&state), exact.touch(&at)) {
                (true, None) => free += 1,
                (true, Some(touch)) => panic!("missed over {size} m: {touch}"),
                (false, Some(_)) => touching += 1,
                (false, None) => assert!(larger.touch(&at).is_some(), "a touch that is none over {size} m"),
            }
        }
        assert!(free > 30 && touching > 30, "{free} free, {touching} touching over {size} m");
    }
}

#[test]
fn slivers_and_many_large_triangles_take_no_more_than_in_proportion_to_their_number() {
    let mechanism = chain(3);
    let mut random = ChaCha8Rng::seed_from_u64(10);
    for width in [1e-6, 1.0, 900.0] {
        let mut triangles = Vec::new();
        for _ in 0..3_000 {
            let mut corner = || -> [f64; 3] { std::array::from_fn(|_| random.random_range(-900.0..900.0)) };
            let (a, b) = (corner(), corner());
            let aside: [f64; 3] =
                std::array::from_fn(|i| (a[i] + width * if i == 2 { 1.0 } else { 0.3 }).clamp(-990.0, 990.0));
            triangles.extend([[a, b, aside], [a, aside, b]]);
        }
        let mesh = Arc::new(Mesh::new(triangles).unwrap());
        let inside = Inside::new(&mesh);
        assert!(!inside.contains([1e-3, 0.0, 950.0]));
        let meshes = [MeshObstacle { name: "slivers".into(), pose: Pose::IDENTITY, mesh, overhang_m: OVERHANG_M }];
        let mut space = Space::new(&mechanism, &meshes[..]);
        let exact = Exact::new(&mechanism, &meshes[..]);
        for _ in 0..50 {
            let state = posture(&mut random, &mechanism);
            assert!(!space.is_free(&state) || exact.touch(&positions(&mechanism, &state)).is_none());
        }
    }
}

#[test]
fn clouds_meshes_and_shapes_stand_beside_each_other_and_each_can_be_allowed() {
    let mut mechanism = chain(2);
    let ball = |name: &str, y: f64| Obstacle {
        name: name.into(),
        pose: Pose::at(0.2, y, 0.0),
        geometry: Geometry::Sphere { radius: 0.02 },
    };
    let obstacles = [ball("ball", 5.0)];
    let clouds = [Cloud::new("cloud", &[[0.2, 0.0, 0.0]], 0.01).unwrap()];
    let mesh = Arc::new(Mesh::new(block([0.02; 3])).unwrap());
    let meshes = [MeshObstacle { name: "mesh".into(), pose: Pose::at(0.45, 0.0, 0.0), mesh, overhang_m: OVERHANG_M }];
    let all = Surroundings { obstacles: &obstacles, clouds: &clouds, meshes: &meshes };
    let straight = [0.0; MAX_JOINTS];
    let touches = |mechanism: &Mechanism| {
        let touches = Exact::new(mechanism, all).touches(&[0.0; 2]);
        let mut names: Vec<String> =
            touches.into_iter().map(|touch| format!("{} {}", touch.link, touch.other)).collect();
        names.sort();
        (Space::new(mechanism, all).is_free(&straight), names)
    };
    assert_eq!(touches(&mechanism), (false, vec!["l1 cloud".to_owned(), "l2 mesh".to_owned()]));
    mechanism.allow(1, "cloud");
    assert_eq!(touches(&mechanism), (false, vec!["l2 mesh".to_owned()]));
    mechanism.allow(2, "mesh");
    assert_eq!(touches(&mechanism), (true, Vec::new()));
}

const ROBOT_OF_TWO: &str =
    r#"{"joints": ["j1", "j2"], "problems": {"bin": [{"start": [0, 0.2], "goal": [1.2, 0.3], "objects": [OBJECTS]}]}}"#;

fn problems(objects: &str, file: &str) -> Result<Problems, String> {
    let mut load = |name: &str| match name {
        "gone.stl" => Err("no file at gone.stl".to_owned()),
        _ => Ok(file.as_bytes().to_vec()),
    };
    let text = ROBOT_OF_TWO.replace("OBJECTS", objects);
    Problems::parse_with_files(&text, &mut load).map_err(|error| error.to_string())
}

/// A box of 20 cm as OBJ, in centimetres.
const OBJ: &str = "# a box\nv -10 -10 -10\nv 10 -10 -10\nv 10 10 -10\nv -10 10 -10\nv -10 -10 10\nv 10 -10 10\nv 10 10 10\nv -10 10 10\n\
                   f 1 4 3 2\nf 5 6 7 8\nf 1/1 2/2/2 6//3 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 -1\n";

fn collada() -> String {
    let corner = |i: usize| [0, 1, 2].map(|axis| if i >> axis & 1 == 0 { "-5" } else { "5" }.to_owned()).join(" ");
    let corners: Vec<String> = (0..8).map(corner).collect();
    format!(
        "<?xml version='1.0'?><COLLADA version='1.4.1'><asset><unit meter='0.01'/><up_axis>Z_UP</up_axis></asset>\
         <library_geometries><geometry id='g'><mesh><source id='s'><float_array id='a' count='24'>{}</float_array>\
         <technique_common><accessor source='#a' count='8' stride='3'/></technique_common></source>\
         <vertices id='v'><input semantic='POSITION' source='#s'/></vertices>\
         <polylist count='6'><input semantic='VERTEX' source='#v' offset='0'/><input semantic='NORMAL' source='#n' offset='1'/>\
         <vcount>4 4 4 4 4 4</vcount><p>0 0 2 0 3 0 1 0 4 0 5 0 7 0 6 0 0 0 1 0 5 0 4 0 2 0 6 0 7 0 3 0 0 0 4 0 6 0 2 0 1 0 3 0 7 0 5 0</p>\
         </polylist></mesh></geometry></library_geometries>\
         <library_nodes><node id='shared'><scale>2 2 2</scale><instance_geometry url='#g'/></node></library_nodes>\
         <library_visual_scenes><visual_scene id='scene'><node><translate>50 0 0</translate><rotate>0 0 1 90</rotate>\
         <instance_node url='#shared'/></node></visual_scene></library_visual_scenes>\
         <scene><instance_visual_scene url='#scene'/></scene></COLLADA>",
        corners.join(" ")
    )
}

#[test]
fn meshes_are_the_same_from_every_kind_of_file() {
    let obj = Mesh::read("box.OBJ", OBJ.as_bytes(), [0.01; 3]).unwrap();
    let dae = Mesh::read("box.dae", collada().as_bytes(), [1.0; 3]).unwrap();
    assert_eq!((obj.triangles().len(), dae.triangles().len()), (12, 12));
    let (in_obj, in_dae) = (Inside::new(&obj), Inside::new(&dae));
    let mut random = ChaCha8Rng::seed_from_u64(7);
    for _ in 0..500 {
        let at: [f64; 3] = std::array::from_fn(|_| random.random_range(-0.2..0.2));
        let inside = at.iter().all(|c| c.abs() < 0.1);
        assert_eq!((in_obj.contains(at), in_dae.contains([at[0] + 0.5, at[1], at[2]])), (inside, inside), "{at:?}");
    }
}

#[test]
fn bad_files_are_refused_by_line_and_reason() {
    let obj = |text: &str| Mesh::read("a.obj", text.as_bytes(), [1.0; 3]).unwrap_err().to_string();
    assert_eq!(obj("v 1 2\n"), "line 1: a vertex `v` has three numbers");
    assert_eq!(obj("v 0 0 0\nv 1 0 0\nf 1 2 3\n"), "line 3: the face names vertex 3, there are 2 before it");
    assert_eq!(obj("v 0 0 0\nv 1 0 0\nf 1 2\n"), "line 3: a face `f` has at least three corners, this has 2");
    assert_eq!(obj("# nothing\n"), "it has 0 triangles: expected 1 to 1000000; simplify it");
    let dae = |text: &str| Mesh::read("a.dae", text.as_bytes(), [1.0; 3]).unwrap_err().to_string();
    assert!(dae("<COLLADA>\n<scene></COLLADA>").starts_with("line 2: it is not valid XML"));
    assert_eq!(dae("<robot/>"), "line 1: its root element is not `COLLADA`");
    let endless = collada().replace("<instance_geometry url='#g'/>", "<instance_node url='#shared'/>");
    assert!(dae(&endless).contains("instances of each other without end"));
    let short = collada().replace("<vcount>4", "<vcount>5");
    assert!(dae(&short).contains("the list of corners ends too early"));
    let beyond = collada().replace("<p>0 0", "<p>9 0");
    assert!(dae(&beyond).contains("a face names vertex 9, there are 8"));

    let heights = |bytes: &[u8]| Heights::read(bytes, 1.0).unwrap_err().to_string();
    assert_eq!(heights(b"1, 2\n3\n"), "line 2: 1 heights, the rows before it have 2");
    assert_eq!(heights(b"1, x\n"), "line 1: `x` is no number");
    assert_eq!(heights(b"1 nan\n"), "line 1: `nan` is not finite: fill in what was not seen");
    assert_eq!(heights(b"1 2\n"), "2 × 1 heights: expected 2 to 4096 along each side");
    let wide = "0 ".repeat(5000);
    assert_eq!(heights(wide.as_bytes()), "5000 × 1 heights: expected 2 to 4096 along each side");
    let long = "0 0\n".repeat(5000);
    assert_eq!(heights(long.as_bytes()), "2 × 4097 heights: expected 2 to 4096 along each side");
    let large = Heights::new(4096, vec![0.0; 4096 * 4096]).unwrap().solid([1.0; 2], -0.1).unwrap_err().to_string();
    assert_eq!(large, "it has 33587190 triangles: expected 1 to 1000000; simplify it");
    assert_eq!(heights(b"P5 2 2 65535\n\0\0"), "at byte 15: it ends here, 2 × 2 values of 2 bytes begin at byte 13");

    let points = |name: &str, text: &str| point_files::points(name, text.as_bytes()).unwrap_err().to_string();
    assert_eq!(points("a.xyz", "1 2 3\n4 5\n"), "line 2: a point has three numbers");
    assert_eq!(points("a.pcd", "FIELDS x y z\nDATA ascii\n"), "line 2: its header has no POINTS, nor WIDTH and HEIGHT");
    assert!(points("a.las", "").contains("convert it"));
}

#[test]
fn points_are_read_from_text_pcd_and_ply() {
    let expected = vec![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]];
    for (name, text) in [
        ("a.xyz", "# two\n1 2 3\n\nnan nan nan\n4 5 6 255 0 0\n"),
        ("a.csv", "1,2,3\n4,5,6\n"),
        ("a.PCD", "VERSION .7\nFIELDS x y z rgb\nPOINTS 2\nDATA ascii\n1 2 3 0\n4 5 6 0\n"),
        (
            "a.ply",
            "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n1 2 3\n4 5 6\n3 0 1 1\n",
        ),
    ] {
        assert_eq!(point_files::points(name, text.as_bytes()).unwrap(), expected, "{name}");
    }
}

#[test]
fn heights_are_a_solid_with_the_first_line_at_the_back() {
    // A step of 40 cm at the back left corner.
    let text = Heights::read(b"0.4; 0; 0\n0 0 0\n0,0,0", 1.0).unwrap();
    let grey = Heights::read(b"P2 # heights in mm\n3 3 400\n400 0 0 0 0 0 0 0 0", 1e-3).unwrap();
    assert_eq!(text, grey);
    let mut image = b"P5 3 3 65535\n".to_vec();
    image.extend([400_u16, 0, 0, 0, 0, 0, 0, 0, 0].iter().flat_map(|value| value.to_be_bytes()));
    assert_eq!(Heights::read(&image, 1e-3).unwrap(), grey);
    let inside = Inside::new(&text.solid([2.0, 2.0], -0.1).unwrap());
    for (at, expected) in [
        ([-0.95, 0.95, 0.3], true),
        ([-0.95, -0.95, 0.1], false),
        ([0.95, 0.95, 0.1], false),
        ([0.5, 0.5, -0.05], true),
        ([0.5, 0.5, -0.2], false),
        ([0.0, 1.1, -0.05], false),
    ] {
        assert_eq!(inside.contains(at), expected, "{at:?}");
    }
}

#[test]
fn a_problem_names_clouds_meshes_and_heights_with_their_files() {
    let mechanism = chain(2);
    let one = |objects: &str, file: &str| problems(objects, file).unwrap().classes["bin"][0].clone();
    let free = |problem: &Problem| {
        let (exact, mut space) =
            (Exact::new(&mechanism, problem.surroundings()), Space::new(&mechanism, problem.surroundings()));
        let free = exact.touch(&[0.0; 2]).is_none();
        assert_eq!(space.is_free(&[0.0; MAX_JOINTS]), free);
        free
    };
    for (x, expected) in [(0.46, false), (0.8, true)] {
        let cloud = format!(
            r#"{{"name": "seen", "type": "cloud", "file": "seen.xyz", "radius": 0.01, "thin": 0.002, "position": [{x}, 0, 0]}}"#
        );
        assert_eq!(free(&one(&cloud, "-0.01 0 0\n-0.01 0.001 0\n")), expected, "{x}");
        let mesh =
            format!(r#"{{"name": "box", "type": "mesh", "file": "box.obj", "scale": 0.01, "position": [{x}, 0, 0]}}"#);
        assert_eq!(free(&one(&mesh, OBJ)), expected, "{x}");
        let ground = format!(
            r#"{{"name": "pile", "type": "heightfield", "file": "pile.csv", "size": [0.2, 0.2], "bottom": -0.3, "position": [{x}, 0, -0.1]}}"#
        );
        assert_eq!(free(&one(&ground, "0.2 0.2\n0.2 0.2\n")), expected, "{x}");
    }
    let here = r#"{"name": "seen", "type": "cloud", "points": [[0.33, 0, 0], [0.3, 0.5, 0]], "radius": 0.01, "self_filter": 0.03}"#;
    let mut problem = one(here, "");
    assert!(!free(&problem));
    problem.start = vec![0.0; 2];
    problem.filter(&mechanism);
    assert!(free(&problem) && problem.clouds[0].points().len() == 1);

    let refused = |objects: &str, file: &str| problems(objects, file).unwrap_err();
    let mesh = r#"{"name": "box", "type": "mesh", "file": "box.obj"}"#;
    let expected = "problem 0 of class `bin`: object `box`, file `box.obj`: line 1: a vertex `v` has three numbers";
    assert_eq!(refused(mesh, "v 1\n"), expected);
    assert!(refused(&mesh.replace("box.obj", "gone.stl"), "").contains("file `gone.stl`: no file at gone.stl"));
    assert!(
        refused(r#"{"name": "seen", "type": "cloud", "radius": 0.01}"#, "").contains("either a `file` or `points`")
    );
    assert!(refused(&here.replace("0.01", "0"), "").contains("object `seen`: the radius of its points is 0 m"));
    assert!(
        refused(&here.replace("0.03", "-1"), "").contains("object `seen`: its `self_filter` is -1 m: expected 0 to 1")
    );
    let pile = |name: &str, size: f64| {
        format!(r#"{{"name": "{name}", "type": "heightfield", "file": "pile.csv", "size": [{size}, {size}]}}"#)
    };
    let piles = one(&[pile("a", 1.0), pile("b", 1.0), pile("c", 2.0)].join(", "), "1 1\n1 1\n").meshes;
    assert!(Arc::ptr_eq(&piles[0].mesh, &piles[1].mesh) && !Arc::ptr_eq(&piles[0].mesh, &piles[2].mesh));
}
