//! What is said of a robot whose links are near each other.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::pose::Pose;
use ratn_motion::arm::assumed;
use ratn_motion::description::RobotDescription;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::pace::{Control, Progress};
use ratn_motion::plan::{Goal, Request, plan};
use ratn_motion::robot::Robot;
use ratn_motion::survey::{Survey, survey};
use ratn_world::scene::Scene;

/// A robot whose mesh is a cube of 0.1 m, with two postures in which all joints but the last are at zero.
fn with_postures(urdf: &str, srdf: &str, joints: &[&str], tool: &str) -> Robot {
    let zeros = "0, ".repeat(joints.len() - 1);
    let toml = format!(
        "name = 'r'\nurdf = 'r'\n[arm]\njoints = {joints:?}\ntool = '{tool}'\n[postures]\nhome = [{zeros}0]\nback = [{zeros}0.3]\n"
    );
    let description = RobotDescription::read(&toml).unwrap();
    let corner = |i: usize| [i & 1, i >> 1 & 1, i >> 2].map(|bit| 0.1 * bit as f64 - 0.05);
    let sides = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]];
    let vertex = |i: usize| {
        let [x, y, z] = corner(i);
        format!("vertex {x} {y} {z}\n")
    };
    let triangle = |corners: [usize; 3]| {
        let corners = corners.map(vertex).concat();
        format!("facet normal 0 0 0\nouter loop\n{corners}endloop\nendfacet\n")
    };
    let cube = sides.map(|[a, b, c, d]| triangle([a, b, c]) + &triangle([a, c, d])).concat();
    let stl = format!("solid cube\n{cube}endsolid cube\n");
    Robot::of(description, urdf, Some(srdf), &mut |_| Ok(stl.clone().into_bytes())).unwrap()
}

#[test]
fn links_that_leave_the_search_no_room_are_named_with_what_to_do_and_so_does_the_planner() {
    // Their shapes are 14 mm apart in every posture, the spheres of the search meet.
    let plate = |name: &str| {
        format!("<link name='{name}'><collision><geometry><box size='0.04 0.04 0.004'/></geometry></collision></link>")
    };
    let joint = |name: &str, parent: &str, child: &str| {
        format!(
            "<joint name='{name}' type='revolute'><parent link='{parent}'/><child link='{child}'/><origin xyz='0 0 0.018'/>\
             <axis xyz='0 0 1'/><limit lower='-1' upper='1' velocity='1' effort='1'/></joint>"
        )
    };
    let (plates, joints) =
        (plate("plate") + &plate("lid"), joint("lower", "foot", "plate") + &joint("upper", "plate", "lid"));
    let urdf = format!("<robot name='r'><link name='foot'/>{plates}{joints}</robot>");
    let robot = |srdf: &str| with_postures(&urdf, srdf, &["lower", "upper"], "lid");
    let crowded = robot("<robot name='r'><disable_collisions link1='foot' link2='lid' reason='Never'/></robot>");
    let Survey { lines, faults } = survey(&crowded);
    let except = "<disable_collisions link1=\"plate\" link2=\"lid\" reason=\"Never\"/>";
    assert!(faults.len() == 2 && faults.iter().all(|fault| fault.contains(except)), "{faults:?}");
    assert!(lines.iter().any(|line| line.contains("home: NO ROOM")), "{lines:?}");
    let empty = Scene { base: Pose::IDENTITY, objects: Vec::new() };
    let start = assumed(&crowded, &empty);
    let request = Request::new(start, vec![Goal::Joints(JointVector::of([0.0, 0.3]))]);
    let go_on = &mut |_: Progress<'_>| Control::Continue;
    let refused = plan(&crowded, &empty, &request, go_on).unwrap_err();
    assert!(faults[0].ends_with(&refused.to_string()), "{refused} is not {}", faults[0]);
    assert_eq!(survey(&robot(&format!("<robot name='r'>{except}</robot>"))).faults, Vec::<String>::new());
}

#[test]
fn the_first_lines_of_an_srdf_are_written_out_and_neighbours_that_one_leaves_out_are_named() {
    // Two neighbours that are made to touch, and a block on the last one that meets the foot in every posture.
    let block = |name: &str, z: f64| {
        format!(
            "<link name='{name}'><collision><origin xyz='0 0 {z}'/><geometry><box size='0.1 0.1 0.1'/></geometry></collision></link>"
        )
    };
    let joint = |name: &str, parent: &str, child: &str| {
        format!(
            "<joint name='{name}' type='revolute'><parent link='{parent}'/><child link='{child}'/><origin xyz='0 0 0.1'/>\
             <axis xyz='0 0 1'/><limit lower='-1' upper='1' velocity='1' effort='1'/></joint>"
        )
    };
    let links = block("foot", 0.0) + &block("middle", 0.0) + &block("top", -0.2);
    let joints = joint("lower", "foot", "middle") + &joint("upper", "middle", "top");
    let urdf = format!("<robot name='r'>{links}{joints}</robot>");
    let robot = |srdf: &str| with_postures(&urdf, srdf, &["lower", "upper"], "top");
    let except =
        |[a, b]: [&str; 2], why: &str| format!("<disable_collisions link1=\"{a}\" link2=\"{b}\" reason=\"{why}\"/>");
    let neighbours = [except(["foot", "middle"], "Adjacent"), except(["middle", "top"], "Adjacent")];
    let has = |survey: &Survey, line: &str| survey.lines.iter().any(|one| one.trim() == line);
    let one = survey(&robot(&format!("<robot name='r'>{}</robot>", except(["foot", "top"], "Default"))));
    // The other two meet in every posture, which is seen without an SRDF, too.
    assert!(has(&one, &neighbours[1]) && !has(&one, &neighbours[0]), "{:?}", one.lines);
    let all = except(["foot", "top"], "Default") + &neighbours.concat();
    let all = survey(&robot(&format!("<robot name='r'>{all}</robot>")));
    assert!(all.faults.is_empty() && neighbours.iter().all(|line| !has(&all, line)), "{all:?}");
}

#[test]
fn how_near_links_with_meshes_are_is_said_by_their_meshes() {
    let link = |name: &str| {
        format!("<link name='{name}'><collision><geometry><mesh filename='cube.stl'/></geometry></collision></link>")
    };
    let urdf = |apart_m: f64| {
        let (foot, cube, at) = (link("foot"), link("cube"), 0.1 + apart_m);
        format!(
            "<robot name='r'>{foot}{cube}<joint name='slide' type='prismatic'><parent link='foot'/><child link='cube'/>\
             <origin xyz='{at} 0 0'/><axis xyz='1 0 0'/><limit lower='-0.2' upper='1' velocity='1' effort='1'/></joint>\
             <link name='tip'/><joint name='end' type='fixed'><parent link='cube'/><child link='tip'/></joint></robot>"
        )
    };
    let other = "<robot name='r'><disable_collisions link1='foot' link2='tip' reason='Never'/></robot>";
    let faults = |apart_m: f64| survey(&with_postures(&urdf(apart_m), other, &["slide"], "cube")).faults;
    let says = |apart_m: f64, what: &str| {
        let faults = faults(apart_m);
        assert!(matches!(&faults[..], [one] if one.ends_with(what)), "{faults:?}");
    };
    says(0.004, "link cube is 4 mm away from link foot: at least 10 mm are required");
    // The spheres that hold the cubes meet there.
    assert_eq!(faults(0.012), Vec::<String>::new());
}
