//! The robots of workers, cells and `ratn robot check` have meshes as they are beside all that stands around, though spheres hold them for the search.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::pose::Pose;
use ratn_motion::cloud::Cloud;
use ratn_motion::collision::{Checker, Contact, PADDING_M};
use ratn_motion::description::RobotDescription;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::keep::Region;
use ratn_motion::pace::Control;
use ratn_motion::plan::{Goal, Plan, PlanError, Request, plan};
use ratn_motion::robot::{Configuration, Robot};
use ratn_motion::seen::Seen;
use ratn_motion::space::{Space, state};
use ratn_motion::trajectory::Curve;
use ratn_motion::validate::validate_trajectory;
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};
use std::sync::Arc;

/// Half of the plate's edges, in metres. The spheres that hold it stand out by centimetres.
const PLATE: [f64; 3] = [0.2, 0.2, 0.01];

/// An STL of a cuboid about the origin.
fn cuboid(half: [f64; 3]) -> Vec<u8> {
    let corner = |i: usize| [0, 1, 2].map(|axis| if i >> axis & 1 == 0 { -half[axis] } else { half[axis] });
    let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let triangles = faces.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]);
    let facet = |triangle: [usize; 3]| {
        let corners: String =
            triangle.into_iter().map(corner).map(|[x, y, z]| format!("vertex {x} {y} {z}\n")).collect();
        format!("facet normal 0 0 0\nouter loop\n{corners}endloop\nendfacet\n")
    };
    format!("solid plate\n{}endsolid plate\n", triangles.map(facet).collect::<String>()).into_bytes()
}

/// A plate, which is a mesh, that slides along x and is lifted; and, where `foot` says so, another one below it that stands.
fn sliding(foot: &str) -> Robot {
    let slide = |name: &str, parent: &str, child: &str, axis: &str, upper: f64| {
        format!(
            "<joint name='{name}' type='prismatic'><parent link='{parent}'/><child link='{child}'/><axis xyz='{axis}'/>\
             <limit lower='-0.1' upper='{upper}' velocity='1' effort='1'/></joint>"
        )
    };
    let lamp = "<collision><origin xyz='0 0 3'/><geometry><sphere radius='0.01'/></geometry></collision>";
    let plate = "<collision><geometry><mesh filename='plate.stl'/></geometry></collision>";
    let urdf = format!(
        "<robot name='r'><link name='foot'>{foot}</link><link name='lamp'>{lamp}</link><link name='plate'>{plate}</link>{}{}</robot>",
        slide("along", "foot", "lamp", "1 0 0", 1.4),
        slide("up", "lamp", "plate", "0 0 1", 0.6),
    );
    let toml = "name = 'r'\nurdf = 'r.urdf'\n[arm]\njoints = ['along', 'up']\ntool = 'plate'\n";
    let srdf = "<robot name='r'><disable_collisions link1='foot' link2='lamp' reason='Never'/></robot>";
    let description = RobotDescription::read(toml).unwrap();
    Robot::of(description, &urdf, Some(srdf), &mut |_| Ok(cuboid(PLATE))).unwrap()
}

fn object(name: &str, at: [f64; 3], size: [f64; 3]) -> SceneObject {
    let [x, y, z] = at;
    SceneObject { name: name.into(), shape: Shape::Box { size }, placement: Placement::World(Pose::at(x, y, z)) }
}

fn scene(objects: Vec<SceneObject>) -> Scene {
    Scene { base: Pose::IDENTITY, objects }
}

/// A table whose top is so far below the plate.
fn table(gap_m: f64) -> SceneObject {
    object("table", [0.6, 0.0, -PLATE[2] - gap_m - 0.02], [2.4, 0.8, 0.04])
}

/// A rib on that table which the plate has to be lifted over by at least 0.1 m.
fn rib() -> SceneObject {
    object("rib", [0.6, 0.0, 0.04], [0.02, 0.8, 0.1])
}

fn judged(checker: &mut Checker<'_>) -> Option<String> {
    checker.collision(&JointVector::of([0.0, 0.0]), Contact::None).map(|collision| collision.to_string())
}

fn beside(robot: &Robot, objects: Vec<SceneObject>) -> Checker<'_> {
    Checker::new(robot, &scene(objects), &robot.at_zero(), PADDING_M)
}

fn planned(robot: &Robot, scene: &Scene, request: &Request) -> Result<Plan, PlanError> {
    let found = plan(robot, scene, request, &mut |_| Control::Continue)?;
    let start = request.start;
    validate_trajectory(robot, scene, &start, &found.trajectory, Contact::None).unwrap();
    Ok(found)
}

fn request(robot: &Robot, from: [f64; 2], to: [f64; 2]) -> Request {
    let start = Configuration { arm: JointVector::of(from), ..robot.at_zero() };
    Request { improvement_iterations: 50, ..Request::new(start, vec![Goal::Joints(JointVector::of(to))]) }
}

/// How high the plate comes on the way.
fn lifted_m(robot: &Robot, plan: &Plan) -> f64 {
    let curve = Curve::of_arm(robot, &plan.trajectory).unwrap();
    curve.knots().iter().map(|knot| knot.positions[1]).fold(0.0, f64::max)
}

#[test]
fn a_mesh_is_as_far_from_what_stands_around_as_it_is() {
    let robot = sliding("");
    let here = robot.at_zero();
    let (mechanism, obstacles) = ratn_motion::arm::in_scene(&robot, &scene(vec![table(0.012)]), &here);
    assert!(!Space::new(&mechanism, &obstacles).is_free(&state(&here.arm)), "its spheres say enough");
    assert_eq!(judged(&mut beside(&robot, vec![table(0.012)])), None);
    let near = judged(&mut beside(&robot, vec![table(0.006)])).unwrap();
    assert_eq!(near, "link plate is 6 mm away from table: at least 10 mm are required");
    let deep = judged(&mut beside(&robot, vec![table(-0.003)])).unwrap();
    assert!(deep.starts_with("link plate is ") && deep.ends_with(" mm inside table"), "{deep}");
    // What is wholly inside is inside.
    let inside = object("pill", [0.0, 0.0, 0.0], [0.004; 3]);
    assert!(judged(&mut beside(&robot, vec![inside])).is_some());
}

#[test]
fn so_it_is_beside_a_region_that_is_kept_out_of_and_what_a_camera_saw() {
    let robot = sliding("");
    let region = |gap_m: f64| Region { pose: Pose::at(0.0, 0.0, -PLATE[2] - gap_m - 0.05), size: [0.1; 3] };
    let beside_region = |gap_m| judged(&mut beside(&robot, Vec::new()).keeping_out_of(&[region(gap_m)]));
    assert_eq!(beside_region(0.012), None);
    assert!(beside_region(0.008).is_some());
    let beside_point = |z: f64| {
        let cloud = Cloud::new("seen", &[[0.05, 0.05, z as f32]], 0.002).unwrap();
        judged(&mut beside(&robot, Vec::new()).beside(Some(Arc::new(cloud))))
    };
    assert_eq!(beside_point(-PLATE[2] - 0.002 - 0.012), None);
    assert!(beside_point(-PLATE[2] - 0.002 - 0.008).is_some());
    assert!(beside_point(0.0).is_some(), "inside of it");
}

#[test]
fn so_it_is_beside_another_link() {
    let foot = |gap_m: f64| {
        let z = -2.0 * PLATE[2] - gap_m;
        sliding(&format!(
            "<collision><origin xyz='0 0 {z}'/><geometry><mesh filename='plate.stl'/></geometry></collision>"
        ))
    };
    assert_eq!(judged(&mut beside(&foot(0.012), Vec::new())), None);
    assert!(judged(&mut beside(&foot(0.008), Vec::new())).is_some());
}

#[test]
fn a_motion_begins_and_ends_where_only_spheres_touch_and_goes_around_what_the_mesh_would_meet() {
    let robot = sliding("");
    let objects = scene(vec![table(0.012), rib()]);
    let found = planned(&robot, &objects, &request(&robot, [0.0, 0.0], [1.2, 0.0])).unwrap();
    assert!(lifted_m(&robot, &found) > 0.1, "{found:?}");
}

#[test]
fn so_it_does_beside_what_a_camera_saw() {
    let robot = sliding("");
    let line = |x: f64, z: f64| (-19..20).map(move |y| [x as f32, y as f32 * 0.02, z as f32]);
    let ground = (-5..85).flat_map(|x| line(f64::from(x) * 0.02, -PLATE[2] - 0.014));
    let wall = (0..5).flat_map(|z| line(0.6, f64::from(z) * 0.02));
    let points: Vec<[f32; 3]> = ground.chain(wall).collect();
    let cloud = Arc::new(Cloud::new("seen", &points, 0.002).unwrap());
    let seen = Some(Seen { cloud, known_within_m: 0.0 });
    let request = Request { seen, ..request(&robot, [0.0, 0.0], [1.2, 0.0]) };
    let found = planned(&robot, &scene(Vec::new()), &request).unwrap();
    assert!(lifted_m(&robot, &found) > 0.08, "{found:?}");
}

#[test]
fn a_pair_of_links_that_the_search_does_not_see_is_gone_around() {
    // A plate that stands 4 mm below, with a rib.
    let foot = |origin: &str, shape: &str| {
        format!("<collision><origin xyz='{origin}'/><geometry>{shape}</geometry></collision>")
    };
    let foot = [
        foot("0 0 -0.024", "<mesh filename='plate.stl'/>"),
        foot("1.2 0 -0.024", "<mesh filename='plate.stl'/>"),
        foot("0.6 0 0.04", "<box size='0.02 0.4 0.1'/>"),
    ];
    let robot = sliding(&foot.concat());
    let [a, b] = ["foot", "plate"].map(|name| robot.link(name).unwrap());
    assert!(!robot.model.is_excepted(a, b));
    let found = planned(&robot, &scene(Vec::new()), &request(&robot, [0.0, 0.0], [1.2, 0.0])).unwrap();
    assert!(lifted_m(&robot, &found) > 0.1, "{found:?}");
}

#[test]
fn a_search_that_spheres_leave_no_way_for_is_made_again_with_the_meshes() {
    // The plate passes below a lintel, with 12 mm of room above and below, and cannot be lifted over it.
    let robot = sliding("");
    let lintel = object("lintel", [0.6, 0.0, PLATE[2] + 0.012 + 0.5], [0.1, 0.8, 1.0]);
    let objects = scene(vec![table(0.012), lintel]);
    let found = planned(&robot, &objects, &request(&robot, [0.0, 0.1], [1.2, 0.1])).unwrap();
    assert!(lifted_m(&robot, &found) < 0.2, "{found:?}");
}

/// An STL of the same cuboid whose faces are cut into triangles with edges of at most 2 mm.
fn finely_cut(half: [f64; 3]) -> Vec<u8> {
    let facets = (0..3).flat_map(|axis| {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        let cells = [u, v].map(|along: usize| (half[along] / 0.001).ceil() as usize);
        let at = move |side: f64, [i, j]: [usize; 2]| {
            let mut corner = [0.0; 3];
            corner[axis] = side * half[axis];
            corner[u] = half[u] * (2.0 * i as f64 / cells[0] as f64 - 1.0);
            corner[v] = half[v] * (2.0 * j as f64 / cells[1] as f64 - 1.0);
            corner
        };
        let places = (0..cells[0]).flat_map(move |i| (0..cells[1]).map(move |j| [i, j]));
        places.flat_map(move |[i, j]| {
            [-1.0, 1.0].into_iter().flat_map(move |side| {
                let [a, b, c, d] = [[i, j], [i + 1, j], [i + 1, j + 1], [i, j + 1]].map(|place| at(side, place));
                if side > 0.0 { [[a, b, c], [a, c, d]] } else { [[a, c, b], [a, d, c]] }
            })
        })
    });
    let facet = |triangle: [[f64; 3]; 3]| {
        let corners: String = triangle.iter().map(|[x, y, z]| format!("vertex {x} {y} {z}\n")).collect();
        format!("facet normal 0 0 0\nouter loop\n{corners}endloop\nendfacet\n")
    };
    format!("solid finger\n{}endsolid finger\n", facets.map(facet).collect::<String>()).into_bytes()
}

/// A hand that is lifted, with two fingers below it, of which the tips are 4 cm below the hand's middle.
fn gripper(finger: &[u8]) -> Robot {
    let slide = |name: &str, parent: &str, child: &str, axis: &str, upper: f64, mimic: &str| {
        format!(
            "<joint name='{name}' type='prismatic'><parent link='{parent}'/><child link='{child}'/><axis xyz='{axis}'/>\
             <limit lower='0' upper='{upper}' velocity='1' effort='1'/>{mimic}</joint>"
        )
    };
    let finger_link = |name: &str| {
        format!("<link name='{name}'><collision><geometry><mesh filename='finger.stl'/></geometry></collision></link>")
    };
    let urdf = format!(
        "<robot name='r'><link name='foot'/><link name='hand'/>{}{}{}{}{}</robot>",
        finger_link("left"),
        finger_link("right"),
        slide("up", "foot", "hand", "0 0 1", 0.6, ""),
        slide("opens", "hand", "left", "0 1 0", 0.04, ""),
        slide("too", "hand", "right", "0 -1 0", 0.04, "<mimic joint='opens'/>"),
    );
    let toml = "name = 'r'\nurdf = 'r.urdf'\n[arm]\njoints = ['up']\ntool = 'hand'\n\
                [gripper]\njoint = 'opens'\nhand = 'hand'\nfinger = 'left'\n";
    Robot::of(RobotDescription::read(toml).unwrap(), &urdf, None, &mut |_| Ok(finger.to_vec())).unwrap()
}

#[test]
fn a_finger_is_as_deep_in_something_as_it_is_however_finely_its_mesh_is_cut() {
    let half = [0.01, 0.007, 0.04];
    for (stl, cut) in [(cuboid(half), "coarsely"), (finely_cut(half), "finely")] {
        let robot = gripper(&stl);
        let open = Configuration { finger: 0.03, ..robot.at_zero() };
        let tray = |top: f64| scene(vec![object("tray", [0.0, 0.0, top - 0.005], [0.3, 0.3, 0.01])]);
        let depth_m = |top: f64| {
            let mut checker = Checker::new(&robot, &tray(top), &open, 0.0);
            let collision = checker.collision(&JointVector::of([0.0]), Contact::None);
            let may_press = checker.is_free(&JointVector::of([0.0]), Contact::Gripper(0.007));
            (collision.map_or(0.0, |collision| collision.depth_m), may_press)
        };
        // Right through a tray of 10 mm: only the way up, or down, leads out.
        let (through, may) = depth_m(0.005);
        assert!((through - 0.045).abs() < 0.0025 && !may, "{cut}: {through}");
        // On the tray, and in it by as much as fingers may press.
        let (pressed, may) = depth_m(-0.035);
        assert!((pressed - 0.005).abs() < 1e-4 && may, "{cut}: {pressed}");
        let (pressed, may) = depth_m(-0.031);
        assert!(pressed > 0.008 && !may, "{cut}: {pressed}");
    }
}
