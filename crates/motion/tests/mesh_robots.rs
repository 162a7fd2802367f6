//! Robots whose links are meshes: read from STL files, held by spheres, checked by parry's exact shapes.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use parry3d::math::Vector;
use parry3d::shape::SharedShape;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::connect::{Budget, connect};
use ratn_motion::exact::Exact;
use ratn_motion::geometry::Geometry;
use ratn_motion::mechanism::{MAX_JOINTS, Mechanism};
use ratn_motion::mesh::{Mesh, MeshError};
use ratn_motion::mesh_files::MeshFiles;
use ratn_motion::pace::Control;
use ratn_motion::simplify::simplify;
use ratn_motion::space::{Obstacle, Space, State};
use std::path::PathBuf;

type Triangle = [[f64; 3]; 3];

/// A prism along z over an outline that is walked to the left, in millimetres; every corner is seen from the first.
fn prism(outline: &[[f64; 2]], height: f64) -> Vec<Triangle> {
    let low = |i: usize| [outline[i % outline.len()][0], outline[i % outline.len()][1], 0.0];
    let high = |i: usize| [low(i)[0], low(i)[1], height];
    let caps = (1..outline.len() - 1).flat_map(|i| [[low(0), low(i + 1), low(i)], [high(0), high(i), high(i + 1)]]);
    let walls = (0..outline.len()).flat_map(|i| [[low(i), low(i + 1), high(i)], [low(i + 1), high(i + 1), high(i)]]);
    caps.chain(walls).collect()
}

/// A link like an L, 200 mm long.
fn elbow() -> Vec<Triangle> {
    prism(&[[0.0, 0.0], [200.0, 0.0], [200.0, 40.0], [60.0, 40.0], [60.0, 120.0], [0.0, 120.0]], 50.0)
}

fn binary(triangles: &[Triangle]) -> Vec<u8> {
    let mut bytes = b"solid by its name, binary by its length".to_vec();
    bytes.resize(80, b' ');
    bytes.extend((triangles.len() as u32).to_le_bytes());
    for triangle in triangles {
        bytes.extend([0; 12]);
        bytes.extend(triangle.iter().flatten().flat_map(|c| (*c as f32).to_le_bytes()));
        bytes.extend([0; 2]);
    }
    bytes
}

fn text(triangles: &[Triangle]) -> String {
    let vertex = |[x, y, z]: &[f64; 3]| format!("      vertex {x:e} {y} {z}\n");
    let facet = |t: &Triangle| {
        let corners: String = t.iter().map(vertex).collect();
        format!("  facet normal 0 0 0\n    outer loop\n{corners}    endloop\n  endfacet\n")
    };
    format!("solid part\n{}endsolid part\n", triangles.iter().map(facet).collect::<String>())
}

const MILLIMETRES: [f64; 3] = [1e-3; 3];

/// Three links about z and y in turn.
fn robot(file: &str) -> String {
    let shape = format!(
        "<collision><origin xyz='0.05 -0.02 -0.025'/><geometry><mesh filename='{file}' scale='0.001 0.001 0.001'/></geometry></collision>"
    );
    let mut urdf = String::from("<robot name='meshes'><link name='l0'/>");
    for (i, axis) in ["0 0 1", "0 1 0", "0 0 1"].iter().enumerate() {
        let (n, x) = (i + 1, if i == 0 { 0.0 } else { 0.3 });
        urdf += &format!(
            "<link name='l{n}'>{shape}</link><joint name='j{n}' type='revolute'><origin xyz='{x} 0 0'/><parent link='l{i}'/>\
             <child link='l{n}'/><axis xyz='{axis}'/><limit lower='-2' upper='2' effort='1' velocity='1'/></joint>"
        );
    }
    urdf + "</robot>"
}

fn mechanism() -> Mechanism {
    Mechanism::read_with_meshes(&robot("elbow.stl"), None, &[], &mut |_| Ok(binary(&elbow()))).unwrap()
}

#[test]
fn a_text_and_a_binary_stl_are_the_same_mesh() {
    let mesh = Mesh::stl(&binary(&elbow()), MILLIMETRES).unwrap();
    assert_eq!(Mesh::stl(text(&elbow()).as_bytes(), MILLIMETRES).unwrap(), mesh);
    assert_eq!(mesh.triangles().len(), 20);
    assert!((mesh.triangles()[1][1][0] - 0.2).abs() < 1e-9);
}

#[test]
fn a_mesh_in_millimetres_without_a_scale_is_refused_with_what_to_write() {
    let with = |scale: &str| {
        let urdf = robot("elbow.stl").replace("scale='0.001 0.001 0.001'", scale);
        let read = Mechanism::read_with_meshes(&urdf, None, &[], &mut |_| Ok(binary(&elbow())));
        let error = read.err()?;
        Some(format!("{error}: {}", std::error::Error::source(&error).map(ToString::to_string).unwrap_or_default()))
    };
    let said = with("").unwrap();
    assert!(said.contains("`elbow.stl` of link `l1`") && said.contains("200 m long"), "{said}");
    assert!(said.contains("scale=\"0.001 0.001 0.001\""), "{said}");
    // Whoever says so has it as large as that.
    assert_eq!(with("scale='1 1 1'"), None);
    assert_eq!(with("scale='0.001 0.001 0.001'"), None);
}

/// Each of them would be looked for in a thousand cells and more of the finest grid.
#[test]
fn a_mesh_of_thousands_of_triangles_as_large_as_itself_is_held_by_few_spheres() {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut corner = || std::array::from_fn(|_| random.random_range(-0.5..0.5));
    let triangles: Vec<[[f64; 3]; 3]> = (0..10_000).map(|_| [corner(), corner(), corner()]).collect();
    let mesh = Mesh::new(triangles).unwrap();
    let spheres = mesh.cover(0.0);
    assert!(spheres.len() < 100, "{}", spheres.len());
    let away = |a: [f64; 3], b: [f64; 3]| (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt();
    let is_held = |corner: &[f64; 3]| spheres.iter().any(|s| away(s.centre, *corner) <= s.radius + 1e-9);
    assert!(mesh.triangles().iter().flatten().all(is_held));
}

#[test]
fn the_spheres_of_a_thick_link_are_few_and_stand_out_by_a_small_part_of_its_length() {
    // A limb 120 mm thick and 400 mm long.
    let around = |i: usize| std::f64::consts::TAU * i as f64 / 48.0;
    let outline: Vec<[f64; 2]> = (0..48).map(|i| [60.0 * around(i).cos(), 60.0 * around(i).sin()]).collect();
    let mesh = Mesh::stl(&binary(&prism(&outline, 400.0)), MILLIMETRES).unwrap();
    let spheres = mesh.cover(0.0);
    let beyond = spheres.iter().map(|s| {
        let [x, y, z] = s.centre;
        (x.hypot(y) + s.radius - 0.06).max(s.radius - z).max(z + s.radius - 0.4)
    });
    let beyond_m = beyond.fold(0.0, f64::max);
    assert!(beyond_m < 0.06 * 0.4, "they stand out by {beyond_m} m");
    assert!(spheres.len() < 60, "{}", spheres.len());
}

#[test]
fn every_point_of_a_mesh_is_in_one_of_its_spheres_and_they_stay_close() {
    let square = [[0.0, 0.0], [30.0, 0.0], [30.0, 30.0], [0.0, 30.0]];
    let long = prism(&square, 900.0);
    let flat = vec![[[0.0; 3], [100.0, 0.0, 0.0], [0.0, 100.0, 0.0]]];
    let mut random = ChaCha8Rng::seed_from_u64(1);
    for (triangles, closed, most) in [(elbow(), true, 0.02), (long, true, 0.03), (flat, false, 0.01)] {
        let mesh = Mesh::stl(&binary(&triangles), MILLIMETRES).unwrap();
        let point = |[x, y, z]: [f64; 3]| Vector::new(x as f32, y as f32, z as f32);
        let corners = mesh.triangles().iter().flatten().map(|c| point(*c)).collect();
        let shape =
            SharedShape::trimesh(corners, (0..triangles.len() as u32).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect());
        let shape = shape.unwrap();
        let extents = shape.compute_local_aabb();
        // Upwards from inside a closed mesh one leaves it an odd number of times.
        let is_inside = |at: Vector| {
            let up = parry3d::query::Ray::new(at, Vector::new(1e-3, 2e-3, 1.0));
            let hits = mesh.triangles().iter().filter(|t| {
                let [a, b, c] = t.map(point);
                parry3d::query::details::local_ray_intersection_with_triangle(a, b, c, &up).is_some()
            });
            closed && hits.count() % 2 == 1
        };
        for padding in [0.0, 0.01] {
            let spheres = mesh.cover(padding);
            assert!(spheres.len() < 100, "{}", spheres.len());
            let depth = |p: Vector| {
                let gap = |s: &ratn_motion::spheres::Sphere| s.radius - f64::from((point(s.centre) - p).length());
                spheres.iter().map(gap).fold(f64::NEG_INFINITY, f64::max)
            };
            for _ in 0..3000 {
                let mut along = |i: usize| random.random_range(extents.mins[i]..=extents.maxs[i]);
                let anywhere = Vector::new(along(0), along(1), along(2));
                let surface = shape.project_local_point(anywhere, false).point;
                assert!(depth(surface) >= padding - 1e-6, "{surface} is {} deep", depth(surface));
                let inside = is_inside(anywhere);
                assert!(!inside || depth(anywhere) >= padding - 1e-6, "{anywhere} is inside, {} deep", depth(anywhere));
            }
            for sphere in &spheres {
                let centre = point(sphere.centre);
                let gap = f64::from(shape.distance_to_local_point(centre, true));
                let gap = if is_inside(centre) { -gap } else { gap };
                assert!(gap + sphere.radius - padding < most, "{sphere:?} stands out");
            }
        }
    }
}

#[test]
fn a_posture_that_the_spheres_of_meshes_find_free_is_free_by_the_meshes() {
    let mut random = ChaCha8Rng::seed_from_u64(2);
    for padding in [0.0, 0.01] {
        let mut mechanism = mechanism();
        mechanism.pad_all(padding);
        let (mut free, mut touching, mut both) = (0, 0, 0);
        for _ in 0..10 {
            let mut range = |most: f64| random.random_range(-most..most);
            let thing = |i: usize, pose| {
                let geometry = match i % 3 {
                    0 => Geometry::Box { half: [0.1, 0.06, 0.2] },
                    1 => Geometry::Cylinder { radius: 0.06, half_length: 0.2 },
                    _ => Geometry::Sphere { radius: 0.1 },
                };
                Obstacle { name: format!("thing {i}"), pose, geometry }
            };
            let obstacles: Vec<Obstacle> = (0..6)
                .map(|i| thing(i, Pose::from_rpy([range(0.6), range(0.6), range(0.2)], range(3.0), 0.3, 0.0)))
                .collect();
            let exact = Exact::new(&mechanism, &obstacles);
            let mut space = Space::new(&mechanism, &obstacles);
            for _ in 0..40 {
                let q: [f64; 3] = std::array::from_fn(|_| random.random_range(-2.0..2.0));
                let state: State = std::array::from_fn(|j| q.get(j).map_or(0.0, |q| *q as f32));
                let touch = exact.touch(&q);
                match (space.is_free(&state), touch) {
                    (true, touch) => {
                        free += 1;
                        assert_eq!(touch, None);
                    }
                    (false, Some(_)) => touching += 1,
                    (false, None) => both += 1,
                }
            }
        }
        // The spheres stand out, but not far.
        assert!(free > 50 && touching > 50 && both < touching, "{free} free, {touching} touching, {both} undecided");
    }
}

#[test]
fn what_is_wholly_inside_a_closed_mesh_touches_it() {
    let ball = |x: f64, y: f64| {
        let pose = Pose::at(x, y, 0.0);
        [Obstacle { name: "ball".into(), pose, geometry: Geometry::Sphere { radius: 0.005 } }]
    };
    let closed = mechanism();
    // The link lies from 5 to 25 cm along x, its thick end from -2 to 10 cm along y, 5 cm high.
    for (at, inside) in [([0.08, 0.06], true), ([0.2, 0.0], true), ([0.2, 0.06], false), ([0.04, 0.0], false)] {
        let touch = Exact::new(&closed, &ball(at[0], at[1])).touch(&[0.0; 3]);
        assert_eq!(touch.is_some(), inside, "{at:?}: {touch:?}");
        assert!(touch.is_none_or(|touch| touch.link == "l1" && touch.depth_m > 0.015), "{at:?}");
    }
    // One wall is missing: nothing is inside a sheet.
    let mut open = elbow();
    open.pop();
    let sheet = Mechanism::read_with_meshes(&robot("elbow.stl"), None, &[], &mut |_| Ok(binary(&open))).unwrap();
    assert_eq!(Exact::new(&sheet, &ball(0.08, 0.06)).touch(&[0.0; 3]), None);
    // Of two parts in one file the second is small and deep in what it meets, the first is far away.
    let pin = prism(&[[300.0, 0.0], [303.0, 0.0], [303.0, 3.0], [300.0, 3.0]], 3.0);
    let parts = [elbow(), pin].concat();
    let pinned = Mechanism::read_with_meshes(&robot("elbow.stl"), None, &[], &mut |_| Ok(binary(&parts))).unwrap();
    let block = Geometry::Box { half: [0.03; 3] };
    let blocks = [Obstacle { name: "block".into(), pose: Pose::at(0.35, -0.02, -0.02), geometry: block }];
    let mut alone = pinned.clone();
    alone.links.truncate(2);
    assert!(Exact::new(&alone, &blocks).touch(&[0.0; 3]).is_some_and(|touch| touch.link == "l1"));
}

#[test]
fn a_robot_of_meshes_is_planned_for() {
    let mechanism = mechanism();
    let post = Geometry::Cylinder { radius: 0.03, half_length: 0.4 };
    let posts = [Obstacle { name: "post".into(), pose: Pose::at(0.42, 0.2, 0.0), geometry: post }];
    let mut space = Space::new(&mechanism, &posts);
    let state = |first: f32| -> State { std::array::from_fn(|j| if j == 0 { first } else { 0.0 }) };
    let budget = Budget { iterations: 20_000, seed: 1 };
    let mut go_on = |_: usize| Control::Continue;
    assert!(!space.is_free_motion(&state(-0.7), &state(1.4)));
    let route = connect(&mut space, &state(-0.7), &[state(1.4)], budget, &mut go_on).unwrap();
    let path = simplify(&mut space, &route.path, budget, &mut go_on).unwrap();
    let postures: Vec<Vec<f64>> = path.iter().map(|s| s[..3].iter().map(|q| f64::from(*q)).collect()).collect();
    assert_eq!(Exact::new(&mechanism, &posts).touch_along(&postures, 128.0), None);
    assert_eq!(MAX_JOINTS, path[0].len());
}

#[test]
fn mesh_files_are_found_in_packages_beside_the_robot_and_where_they_are_said_to_be() {
    let root = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("meshes-{}", std::process::id()));
    let folder = root.join("arm_description/meshes");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("elbow.STL"), binary(&elbow())).unwrap();
    let file = folder.join("elbow.STL").display().to_string();
    let packages = vec![PathBuf::from("/nowhere"), root.clone()];
    let files = MeshFiles { beside: root.join("arm_description"), packages };
    let package = MeshFiles { packages: vec![root.join("arm_description")], ..files.clone() };
    let in_package = "package://arm_description/meshes/elbow.STL";
    for (files, name) in [
        (&files, in_package),
        (&package, in_package),
        (&files, "meshes/elbow.STL"),
        (&files, &*format!("file://{file}")),
    ] {
        assert_eq!(
            files.path(name).unwrap().canonicalize().unwrap(),
            PathBuf::from(&file).canonicalize().unwrap(),
            "{name}"
        );
        let read = Mechanism::read_with_meshes(&robot(name), None, &[], &mut |name| files.read(name)).unwrap();
        assert!(read.links[1].meshes.len() == 1 && !read.links[1].spheres.is_empty());
    }
    let missing = files.path("package://arm_description/meshes/hand.stl").unwrap_err().to_string();
    assert!(missing.contains("no file at /nowhere/arm_description/meshes/hand.stl or "), "{missing}");
    let nowhere = MeshFiles::default().path(in_package).unwrap_err().to_string();
    assert!(nowhere.contains("no folder with packages was named"), "{nowhere}");
    let strange = files.path("http://example.org/elbow.stl").unwrap_err().to_string();
    assert!(strange.contains("`http:` is neither `package:` nor `file:`"), "{strange}");
    std::fs::remove_dir_all(root).unwrap();
}

#[test]
fn a_mesh_that_cannot_be_used_is_refused_by_link_and_file() {
    let refused = |file: &str, bytes: Vec<u8>| {
        let read = Mechanism::read_with_meshes(&robot(file), None, &[], &mut |_| Ok(bytes.clone()));
        read.unwrap_err().to_string()
    };
    let whole = binary(&elbow());
    let other = refused("elbow.glb", whole.clone());
    assert_eq!(
        other,
        "the mesh `elbow.glb` of link `l1`: only STL, OBJ and Collada (.dae) meshes are supported; convert it"
    );
    let collada = refused("elbow.dae", whole.clone());
    assert!(collada.starts_with("the mesh `elbow.dae` of link `l1`: line 1: it is not valid XML"), "{collada}");
    let cut = refused("elbow.stl", whole[..500].to_vec());
    assert!(cut.contains("`elbow.stl` of link `l1`: 20 triangles announced, 500 bytes there"), "{cut}");
    assert!(refused("elbow.stl", Vec::new()).contains("0 triangles announced, 0 bytes there"));
    let mut wild = elbow();
    wild[3][1][2] = f64::INFINITY;
    assert_eq!(Mesh::stl(&binary(&wild), [1.0; 3]), Err(MeshError::NotFinite { triangle: 3 }));
    let broken = text(&elbow()).replacen("endloop", "vertex 1 2 3", 1);
    assert!(matches!(Mesh::stl(broken.as_bytes(), [1.0; 3]), Err(MeshError::Line { .. })));
    let bare = Mechanism::read(&robot("elbow.stl"), None, &[]).unwrap_err().to_string();
    assert!(bare.contains("`elbow.stl` of link `l1`: cannot be read: no folder to look in was named"), "{bare}");
}
