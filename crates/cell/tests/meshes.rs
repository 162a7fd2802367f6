//! Robots of meshes in the cell: what the engine moves, what the judge sees, and what fingers hold, are the meshes.

#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a test may panic and print")]

mod bench;

use bench::Bench;
use ratn_cell::config::{CellConfig, Setting};
use ratn_cell::core::demands::unmet;
use ratn_cell::core::environment::{Environment, Furniture, Kind, Model, STEP, Support, Thing, Touch};
use ratn_cell::core::protocol::{Ending, Request};
use ratn_model::pose::Pose;
use ratn_motion::description::RobotDescription;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::plan::Goal;
use ratn_motion::robot::{Configuration, Robot};
use ratn_motion::top_grasp::grasp_poses;
use std::time::Instant;

type Triangle = [[f64; 3]; 3];

fn stl(triangles: &[Triangle]) -> Vec<u8> {
    let vertex = |[x, y, z]: &[f64; 3]| format!("vertex {x} {y} {z}\n");
    let facet = |triangle: &Triangle| {
        let corners: String = triangle.iter().map(vertex).collect();
        format!("facet normal 0 0 0\nouter loop\n{corners}endloop\nendfacet\n")
    };
    format!("solid s\n{}endsolid s\n", triangles.iter().map(facet).collect::<String>()).into_bytes()
}

/// A prism along y over an outline in x and z that turns to the left, whose faces are cut into these triangles.
fn prism(outline: &[[f64; 2]], faces: &[[usize; 3]], half_width: f64) -> Vec<Triangle> {
    let at = |i: usize, y: f64| [outline[i][0], y, outline[i][1]];
    let face = |[a, b, c]: &[usize; 3]| {
        [
            [at(*a, -half_width), at(*b, -half_width), at(*c, -half_width)],
            [at(*a, half_width), at(*c, half_width), at(*b, half_width)],
        ]
    };
    let side = |i: usize| {
        let next = (i + 1) % outline.len();
        let [a, b, c, d] = [at(i, -half_width), at(next, -half_width), at(next, half_width), at(i, half_width)];
        [[a, d, c], [a, c, b]]
    };
    faces.iter().flat_map(face).chain((0..outline.len()).flat_map(side)).collect()
}

/// A bracket that is open below: legs 2 cm thick and 20 cm long, 6 cm apart, under a bar. Its origin is in the middle of the bar's underside.
fn bracket() -> Vec<Triangle> {
    let outline = [
        [-0.05, -0.2],
        [-0.03, -0.2],
        [-0.03, 0.0],
        [0.03, 0.0],
        [0.03, -0.2],
        [0.05, -0.2],
        [0.05, 0.02],
        [-0.05, 0.02],
    ];
    prism(&outline, &[[0, 1, 2], [0, 2, 7], [2, 3, 6], [2, 6, 7], [3, 4, 5], [3, 5, 6]], 0.03)
}

/// A link that slides along x and z and is a mesh.
fn sliding(mesh: &[Triangle]) -> Robot {
    sliding_pitched(mesh, 0.0)
}

/// A link that slides along x and z, is turned about y, and is a mesh.
fn sliding_pitched(mesh: &[Triangle], pitch: f64) -> Robot {
    let slide = |name: &str, parent: &str, child: &str, pitch: f64, axis: &str| {
        format!(
            "<joint name='{name}' type='prismatic'><origin rpy='0 {pitch} 0'/><parent link='{parent}'/><child link='{child}'/><axis xyz='{axis}'/>\
             <limit lower='-1' upper='2' velocity='1' effort='1'/></joint>"
        )
    };
    let urdf = format!(
        "<robot name='r'><link name='foot'/><link name='rail'/>{}{}<link name='part'><collision><geometry><mesh filename='part.stl'/></geometry>\
         </collision></link></robot>",
        slide("x", "foot", "rail", 0.0, "1 0 0"),
        slide("z", "rail", "part", pitch, &format!("{} 0 {}", -pitch.sin(), pitch.cos())),
    );
    let toml = "name = 'r'\nurdf = 'r.urdf'\n[arm]\njoints = ['x', 'z']\ntool = 'part'\n[postures]\nhome = [0, 1]\n";
    let description = RobotDescription::read(toml).unwrap();
    Robot::of(description, &urdf, None, &mut |_| Ok(stl(mesh))).unwrap()
}

fn at(robot: &Robot, x: f64, z: f64) -> Configuration {
    Configuration { arm: JointVector::of([x, z]), ..robot.at_zero() }
}

/// The top of a table is at z = 0.5.
fn table() -> Furniture {
    Furniture { name: "table".to_owned(), parts: vec![(Pose::at(0.0, 0.0, 0.45), [1.0, 1.0, 0.1])] }
}

/// A box that is 4 cm wide and 10 cm high stands on the table.
fn standing() -> (Model, Pose) {
    (Model { kind: Kind::Box, size: [0.04, 0.04, 0.10] }, Pose::at(0.0, 0.0, 0.55))
}

/// The bracket comes to `x` with its legs around the box, in steps; how far the box was pushed, and the deepest contact of both.
fn embraced(x: f64) -> (f64, Option<Touch>) {
    let robot = sliding(&bracket());
    let here = |x: f64| at(&robot, x, 0.72);
    let mut environment = Environment::new(&robot, &here(0.0), &[table()], &[standing()]);
    // It has come to rest before the bracket moves.
    environment.put(0, &standing().1);
    (0..250).for_each(|_| environment.step(&robot, &here(0.0)));
    let stood = environment.state(0).pose;
    let mut deepest: Option<Touch> = None;
    for step in 0..250 {
        environment.step(&robot, &here(x * f64::from(step.min(200)) / 200.0));
        let found = environment.touches().into_iter().filter(|touch| touch.things[1] == Thing::Object(0));
        deepest = deepest.into_iter().chain(found).max_by(|a, b| a.depth_m.total_cmp(&b.depth_m));
    }
    (environment.state(0).pose.position[0] - stood.position[0], deepest)
}

#[test]
fn what_stands_within_the_outline_of_a_mesh_is_not_pushed_and_what_the_mesh_meets_is() {
    let (pushed_m, touch) = embraced(0.008);
    assert!(pushed_m.abs() < 1e-4 && touch.is_none(), "{pushed_m} {touch:?}");
    // The leg comes to 1 cm from the middle of the box, which is 2 cm from its side.
    let (pushed_m, touch) = embraced(0.020);
    assert!((pushed_m - 0.010).abs() < 2e-3, "{pushed_m}");
    assert!(touch.is_some_and(|touch| touch.things[0] == Thing::Link("part".to_owned())));
}

#[test]
fn a_mesh_is_as_deep_in_a_table_as_it_is() {
    let robot = sliding(&bracket());
    let mut environment = Environment::new(&robot, &at(&robot, 0.0, 0.72), &[table()], &[]);
    // Its legs end at 0.2 m below its origin.
    let mut depth = |gap_m: f64| {
        environment.step(&robot, &at(&robot, 0.0, 0.7 + gap_m));
        environment.touches().first().map(|touch| touch.depth_m)
    };
    assert_eq!(depth(0.002), None);
    for depth_m in [1e-3, 5e-3] {
        assert!(depth(-depth_m).is_some_and(|found| (found - depth_m).abs() < 1e-4), "{:?}", depth(-depth_m));
    }
}

/// A rod along z, 80 cm long and 4 cm thick, of some 20,000 triangles.
fn rod() -> Vec<Triangle> {
    const ROUND: usize = 32;
    const ALONG: usize = 312;
    let at = |i: usize, j: usize| {
        let round = std::f64::consts::TAU * (j % ROUND) as f64 / ROUND as f64;
        [0.02 * round.cos(), 0.02 * round.sin(), 0.8 * i as f64 / ALONG as f64 - 0.4]
    };
    let side = |i: usize, j: usize| {
        let [a, b, c, d] = [at(i, j), at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)];
        [[a, b, c], [a, c, d]]
    };
    let ends =
        |j: usize| [[[0.0, 0.0, -0.4], at(0, j + 1), at(0, j)], [[0.0, 0.0, 0.4], at(ALONG, j), at(ALONG, j + 1)]];
    (0..ALONG).flat_map(|i| (0..ROUND).flat_map(move |j| side(i, j))).chain((0..ROUND).flat_map(ends)).collect()
}

#[test]
fn either_end_of_a_fine_mesh_that_is_tilted_is_seen_in_a_table_top() {
    let top = Furniture { name: "top".to_owned(), parts: vec![(Pose::at(0.0, 0.0, 0.48), [1.2, 0.8, 0.04])] };
    // The lowest point of the rod is so far below its middle.
    let below_m = (0.4 + 0.02) * std::f64::consts::FRAC_1_SQRT_2;
    for pitch in [std::f64::consts::FRAC_PI_4, 3.0 * std::f64::consts::FRAC_PI_4] {
        let robot = sliding_pitched(&rod(), pitch);
        let depth = |depth_m: f64| {
            let here = at(&robot, 0.0, 0.5 + below_m - depth_m);
            let mut environment = Environment::new(&robot, &here, std::slice::from_ref(&top), &[]);
            environment.step(&robot, &here);
            environment.touches().first().map(|touch| touch.depth_m)
        };
        assert_eq!(depth(-0.002), None, "{pitch}");
        assert!(depth(1e-3).is_some_and(|found| (found - 1e-3).abs() < 1e-4), "{pitch}: {:?}", depth(1e-3));
    }
}

#[test]
fn what_stands_on_a_mesh_rests_on_its_link() {
    let plate = prism(&[[-0.2, -0.01], [0.2, -0.01], [0.2, 0.01], [-0.2, 0.01]], &[[0, 1, 2], [0, 2, 3]], 0.2);
    let robot = sliding(&plate);
    let (model, _) = standing();
    let stands = Pose::at(0.0, 0.0, 0.3 + 0.01 + 0.05);
    let mut environment = Environment::new(&robot, &at(&robot, 0.0, 0.3), &[], &[(model, stands)]);
    environment.put(0, &Pose { position: [0.0, 0.0, 0.38], ..stands });
    for _ in 0..250 {
        environment.step(&robot, &at(&robot, 0.0, 0.3));
    }
    let lies = environment.state(0).pose;
    assert!((lies.position[2] - 0.36).abs() < 1e-3, "{lies:?}");
    assert_eq!(environment.rests_on(0), Some(Support::Named("part")));
    assert_eq!(environment.supports_of(0), [Thing::Link("part".to_owned())]);
}

/// The built-in robot with a hand and fingers that are meshes.
fn with_a_hand_of_meshes(folder: &std::path::Path) -> CellConfig {
    let mut urdf = include_str!("../../motion/robots/aimm.urdf").to_owned();
    for size in ["0.07 0.15 0.06", "0.025 0.014 0.07"] {
        let cuboid = format!("<box size=\"{size}\"/>");
        assert!(urdf.contains(&cuboid));
        urdf = urdf.replace(&cuboid, &format!("<mesh filename=\"cube.stl\" scale=\"{size}\"/>"));
    }
    let cube = prism(&[[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]], &[[0, 1, 2], [0, 2, 3]], 0.5);
    std::fs::write(folder.join("cube.stl"), stl(&cube)).unwrap();
    std::fs::write(folder.join("aimm.urdf"), urdf).unwrap();
    std::fs::write(folder.join("aimm.srdf"), include_str!("../../motion/robots/aimm.srdf")).unwrap();
    let file = folder.join("robot.toml");
    std::fs::write(&file, include_str!("../../motion/robots/aimm.toml")).unwrap();
    CellConfig { robot: file.display().to_string(), boxes: 3, seed: 4, ..CellConfig::default() }
}

#[test]
fn a_hand_of_meshes_meets_the_demands_and_fetches_a_box_that_it_alone_touches() {
    let folder = tempfile::tempdir().unwrap();
    let config = with_a_hand_of_meshes(folder.path());
    let robot = Robot::from_file(&folder.path().join("robot.toml")).unwrap();
    assert_eq!(unmet(&robot, Setting::Boxes), []);
    let mut bench = Bench::of(config);
    bench.fetch_the_first_box();
    assert_eq!(bench.cell.unintended_contacts(), []);
}

/// A ball of so many triangles along a meridian, with dents.
fn ball(rings: usize) -> Vec<Triangle> {
    let at = |i: usize, j: usize| {
        let (polar, round) =
            (std::f64::consts::PI * i as f64 / rings as f64, std::f64::consts::TAU * j as f64 / rings as f64);
        let radius = 0.08 * (1.0 + 0.05 * (6.0 * polar).sin() * (6.0 * round).cos());
        [radius * polar.sin() * round.cos(), radius * polar.sin() * round.sin(), radius * polar.cos()]
    };
    let quad = |i: usize, j: usize| {
        let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
        [[a, b, c], [a, c, d]]
    };
    (0..rings).flat_map(|i| (0..rings).flat_map(move |j| quad(i, j))).collect()
}

#[test]
#[ignore = "prints how long steps take"]
fn what_a_step_costs() {
    for rings in [20, 70, 220] {
        let mesh = ball(rings);
        let begin = Instant::now();
        let robot = sliding(&mesh);
        let read = begin.elapsed();
        let begin = Instant::now();
        let mut environment = Environment::new(&robot, &at(&robot, 0.0, 0.7), &[table()], &[standing()]);
        let made = begin.elapsed();
        let mut time = |x: f64, z: f64| {
            let begin = Instant::now();
            for step in 0..250 {
                environment.step(&robot, &at(&robot, x + 1e-4 * f64::from(step), z));
                environment.touches();
            }
            begin.elapsed() / 250
        };
        let (far, near) = (time(0.0, 1.0), time(0.1, 0.575));
        println!(
            "{} triangles: read {read:?}, made {made:?}, a step far {far:?}, near {near:?}, {:?}",
            mesh.len(),
            STEP
        );
    }
}

#[test]
#[ignore = "takes the robot of the file that ROBOT names, and prints what became of its boxes"]
fn the_boxes_of_a_robot_of_yours() {
    let robot = std::env::var("ROBOT").unwrap();
    let count = |name: &str, or: usize| std::env::var(name).map_or(or, |text| text.parse().unwrap());
    let (boxes, seed) = (count("BOXES", 5), count("SEED", 1) as u64);
    let begin = Instant::now();
    let mut bench = Bench::of(CellConfig { robot, boxes, seed, ..CellConfig::default() });
    println!("the cell was made in {:?}", begin.elapsed());
    let places = bench.cell.robot().workplace().unwrap().places.poses();
    for (index, place) in places.iter().enumerate().take(boxes) {
        let truth = bench.cell.ground_truth()[index].clone();
        let go = |bench: &mut Bench, goals: Vec<Goal>, depart_m: f64, approach_m: f64| {
            let begin = Instant::now();
            let trajectory = bench.try_plan(&bench.cell.scene(), goals, depart_m, approach_m)?;
            let (planned, begin) = (begin.elapsed(), Instant::now());
            let (lasts_s, ending) = (trajectory.duration_s(), bench.perform(Request::Follow { trajectory }));
            println!("  planned in {planned:?}, {lasts_s:.1} s of motion followed in {:?}", begin.elapsed());
            matches!(ending, Ending::Done(_)).then_some(()).ok_or_else(|| format!("{ending:?}"))
        };
        let fetched = go(&mut bench, grasp_poses(&truth.pose, truth.size).map(Goal::Pose).to_vec(), 0.05, 0.10)
            .and_then(|()| {
                match bench.perform(Request::Grasp { object: truth.id.clone(), expected: None }) {
                    Ending::Done(_) => {}
                    other => return Err(format!("{other:?} {:?}", bench.noted)),
                }
                let tool = bench.cell.robot().tool_pose(&bench.cell.configuration());
                let held = bench.cell.ground_truth().into_iter().find(|object| object.held).unwrap();
                let in_tool = tool.inverse().compose(&held.pose);
                let there = place.compose(&Pose::at(0.0, 0.0, held.size[2] / 2.0 + 0.003));
                let goals = [0.0, std::f64::consts::PI].map(|turn| {
                    Goal::Pose(there.compose(&Pose::from_rpy([0.0; 3], 0.0, 0.0, turn)).compose(&in_tool.inverse()))
                });
                go(&mut bench, goals.to_vec(), 0.10, 0.10)?;
                match bench.perform(Request::Release) {
                    Ending::Done(_) => Ok(()),
                    other => Err(format!("{other:?}")),
                }
            });
        println!("{}: {fetched:?}", truth.id);
    }
    bench.pass(1.0);
    println!("unintended: {:?}", bench.cell.unintended_contacts());
}
