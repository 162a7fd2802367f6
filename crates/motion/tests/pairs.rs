//! Which pairs of links are checked: by all checks the same, and where no SRDF says so none is freed that can meet and part.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ratn_model::pose::Pose;
use ratn_motion::arm;
use ratn_motion::collision::{Checker, Contact};
use ratn_motion::description::RobotDescription;
use ratn_motion::exact::Exact;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::mechanism::{MAX_JOINTS, Mechanism};
use ratn_motion::pace::Control;
use ratn_motion::pairs::{self, Kind, Pair};
use ratn_motion::plan::{Goal, Request, plan};
use ratn_motion::robot::{Configuration, Robot};
use ratn_motion::robot_model::RobotModel;
use ratn_motion::space::Space;
use ratn_motion::validate::validate_trajectory;
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};

const AIMM: &str = include_str!("../robots/aimm.urdf");
const AIMM_SRDF: &str = include_str!("../robots/aimm.srdf");

/// A link with a ball, 0.05 m in radius, and the joint that turns it about z.
fn ball(name: &str, parent: &str, joint_at: &str, ball_at: &str) -> String {
    format!(
        "<link name='{name}'><collision><origin xyz='{ball_at}'/><geometry><sphere radius='0.05'/></geometry></collision></link>\
         <joint name='{name}_joint' type='revolute'><parent link='{parent}'/><child link='{name}'/><origin xyz='{joint_at}'/>\
         <axis xyz='0 0 1'/><limit lower='-3' upper='3' velocity='1' effort='1'/></joint>"
    )
}

/// An arm whose wrist is so short that its first and last link always overlap, a lever that stands in its way at zero, and a lamp above.
fn model() -> RobotModel {
    let links = [
        ball("upper", "base", "0 0 0", "0.3 0 0"),
        ball("wrist", "upper", "0.3 0 0", "0.06 0 0"),
        ball("hand", "wrist", "0.06 0 0", "0.02 0 0"),
        ball("lever", "base", "0.3 0.5 0", "0 -0.42 0"),
        ball("lamp", "base", "0 0 1", "0 0 0"),
    ];
    RobotModel::read(&format!("<robot name='r'><link name='base'/>{}</robot>", links.concat()), None).unwrap()
}

fn pair(model: &RobotModel, a: &str, b: &str) -> Pair {
    let (a, b) = (model.link(a).unwrap(), model.link(b).unwrap());
    (a.min(b), a.max(b))
}

#[test]
fn pairs_are_told_apart_by_how_they_meet() {
    let model = model();
    let kinds = pairs::kinds(&model);
    let is = |kind: Kind, a: &str, b: &str| kinds.get(&kind).is_some_and(|pairs| pairs.contains(&pair(&model, a, b)));
    assert!(is(Kind::Neighbours, "upper", "wrist") && is(Kind::Neighbours, "wrist", "hand"), "{kinds:?}");
    assert!(is(Kind::Always, "upper", "hand"), "{kinds:?}");
    assert!(is(Kind::ByDefault, "upper", "lever"), "{kinds:?}");
    assert!(is(Kind::Sometimes, "hand", "lever"), "{kinds:?}");
    assert!(["upper", "wrist", "hand", "lever"].iter().all(|link| is(Kind::Never, link, "lamp")), "{kinds:?}");
    assert_eq!(kinds.values().map(Vec::len).sum::<usize>(), 10);
    // The same again.
    assert_eq!(pairs::kinds(&model), kinds);
}

#[test]
fn only_neighbours_that_touch_and_what_always_meets_are_not_checked() {
    let model = model();
    let excepted = [("upper", "wrist"), ("wrist", "hand"), ("upper", "hand")].map(|(a, b)| pair(&model, a, b));
    assert_eq!(model.checks().excepted, excepted.into());
    assert!(model.checks().by_shapes.is_empty());
    // What meets in the default state is told, and is free elsewhere.
    let mechanism = model.planned(&[], &ratn_motion::robot_state::RobotState::neutral(&model)).unwrap();
    let (mut space, exact) = (Space::new(&mechanism, &[]), Exact::new(&mechanism, &[]));
    let state = |lever: f32| std::array::from_fn(|j| if j == 3 { lever } else { 0.0 });
    assert!(!space.is_free(&[0.0; MAX_JOINTS]) && space.is_free(&state(1.5)));
    let touch = exact.touch(&[0.0; 5]).unwrap();
    assert_eq!((&touch.link[..], &touch.other[..]), ("upper", "lever"));
    assert_eq!(exact.touch(&[0.0, 0.0, 0.0, 1.5, 0.0]), None);
}

#[test]
fn an_object_with_the_name_of_a_link_is_checked_against_what_the_link_is_not() {
    let robot = Robot::aimm();
    let home = robot.posture("home").unwrap();
    let empty = Scene { base: Pose::IDENTITY, objects: Vec::new() };
    let here = Configuration { arm: home, ..arm::assumed(&robot, &empty) };
    let (mechanism, _) = arm::in_scene(&robot, &empty, &here);
    let poses = mechanism.poses(&home);
    let mut names = 0;
    for (link, name) in mechanism.allowed.iter().filter(|(link, _)| !mechanism.links[*link].spheres.is_empty()) {
        let body = SceneObject {
            name: name.trim_matches(char::is_control).to_owned(),
            shape: Shape::Box { size: [0.02; 3] },
            placement: Placement::World(
                poses[*link].compose(&Pose { position: mechanism.links[*link].spheres[0].centre, ..Pose::IDENTITY }),
            ),
        };
        let scene = Scene { objects: vec![body], ..empty.clone() };
        let (mechanism, standing) = arm::in_scene(&robot, &scene, &here);
        let state = std::array::from_fn(|j| home.get(j).map_or(0.0, |q| *q as f32));
        assert!(!arm::space(&mechanism, &standing[..]).is_free(&state), "{name}");
        names += 1;
    }
    assert!(names > 0);
}

#[test]
fn limits_as_far_as_numbers_go_stand_for_none() {
    let kinds = |limit: &str| {
        let sled = format!(
            "<link name='base'/><link name='sled'/><joint name='slide' type='prismatic'><parent link='base'/><child link='sled'/><axis xyz='1 0 0'/>\
             <limit lower='-{limit}' upper='{limit}' velocity='1' effort='1'/></joint>"
        );
        let arm = [ball("low", "sled", "0 0 0", "0.1 0 0"), ball("high", "low", "0.3 0 0", "-0.1 0.12 0")];
        let end = ball("end", "high", "-0.1 0.12 0", "-0.12 -0.1 0");
        pairs::kinds(&RobotModel::read(&format!("<robot name='r'>{sled}{}{end}</robot>", arm.concat()), None).unwrap())
    };
    let without = kinds("inf");
    assert!(!without.contains_key(&Kind::Always), "{without:?}");
    for farthest in [f64::MAX.to_string(), f32::MAX.to_string(), "1e30".to_owned()] {
        assert_eq!(kinds(&farthest), without, "{farthest}");
    }
}

#[test]
fn neighbours_that_fold_onto_each_other_are_checked() {
    // Beyond its elbow, which is wide open at zero, the forearm meets the upper arm.
    let links = [ball("upper", "base", "0 0 0", "0.1 0 0"), ball("fore", "upper", "0.2 0 0", "0.1 0 0")];
    let urdf = format!("<robot name='r'><link name='base'/>{}</robot>", links.concat());
    let mechanism = Mechanism::read(&urdf, None, &[]).unwrap();
    let folded = [0.0, 2.9];
    assert!(Exact::new(&mechanism, &[]).touch(&folded).is_some());
    let state = std::array::from_fn(|j| if j == 1 { 2.9 } else { 0.0 });
    assert!(!Space::new(&mechanism, &[]).is_free(&state) && Space::new(&mechanism, &[]).is_free(&[0.0; MAX_JOINTS]));
}

#[test]
fn of_our_robot_nothing_is_freed_that_its_srdf_has_checked_and_that_can_part() {
    let (with, without) = (RobotModel::read(AIMM, Some(AIMM_SRDF)).unwrap(), RobotModel::read(AIMM, None).unwrap());
    let names = |(a, b): &Pair| format!("{} and {}", without.links[*a].name, without.links[*b].name);
    let freed: Vec<String> = without.checks().excepted.difference(&with.checks().excepted).map(names).collect();
    assert!(freed.is_empty(), "{freed:?}");
    // Many postures are free by the spheres, so planning is possible; those are free by the shapes.
    let joints: Vec<String> = (1..=7).map(|i| format!("arm_joint_{i}")).collect();
    let mechanism = Mechanism::read(AIMM, None, &joints).unwrap();
    let (mut space, exact) = (Space::new(&mechanism, &[]), Exact::new(&mechanism, &[]));
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let (mut free, mut by_shapes) = (0, 0);
    for _ in 0..300 {
        let posture: Vec<f64> = mechanism.joints.iter().map(|j| random.random_range(j.lower..j.upper)).collect();
        let state = std::array::from_fn(|j| posture.get(j).map_or(0.0, |q| *q as f32));
        let is_free = exact.touch(&posture).is_none();
        by_shapes += usize::from(is_free);
        free += usize::from(space.is_free(&state));
        assert!(!space.is_free(&state) || is_free || !mechanism.by_shapes.is_empty(), "{posture:?}");
    }
    assert!(2 * free > by_shapes && free > 50, "{free} of {by_shapes}");
}

fn boxed(size: [f64; 3], at: Pose) -> Scene {
    let placement = Placement::Gripper(at);
    let held = SceneObject { name: "thing".to_owned(), shape: Shape::Box { size }, placement };
    Scene { base: Pose::IDENTITY, objects: vec![held] }
}

fn nothing() -> Scene {
    Scene { base: Pose::IDENTITY, objects: Vec::new() }
}

/// A robot without an SRDF, whose tool has a shape and carries a camera that overlaps it.
fn tooled() -> Robot {
    let toml = "name = 'r'\nurdf = 'r'\n[arm]\njoints = ['wrist_joint', 'tool_joint']\ntool = 'tool'\n";
    let camera = "<link name='camera'><collision><geometry><sphere radius='0.04'/></geometry></collision></link>\
                  <joint name='camera_mount' type='fixed'><parent link='tool'/><child link='camera'/>\
                  <origin xyz='0.12 0 0.03'/></joint>";
    let links = [ball("wrist", "base", "0 0 0", "0.05 0 0"), ball("tool", "wrist", "0.06 0 0", "0.08 0 0")];
    let urdf = format!("<robot name='r'><link name='base'/>{}{camera}</robot>", links.concat());
    Robot::of(RobotDescription::read(toml).unwrap(), &urdf, None, &mut |_| unreachable!("it has no meshes")).unwrap()
}

/// Every built-in robot as each of its arms sees it, and [`tooled`].
fn robots() -> Vec<(String, Robot)> {
    let mut robots = vec![("tooled".to_owned(), tooled())];
    for name in Robot::built_in_names() {
        let robot = Robot::built_in(name).unwrap();
        let others: Vec<String> = robot.other_arms().map(ToString::to_string).collect();
        robots.extend(others.iter().map(|arm| (format!("{name} {arm}"), robot.with_arm(arm).unwrap())));
        robots.push((name.to_owned(), robot));
    }
    robots
}

#[test]
fn both_checks_by_exact_shapes_judge_by_the_same_pairs_on_every_robot() {
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let (mut touching, mut free) = (0, 0);
    for (name, robot) in robots() {
        let in_hand = boxed([0.05, 0.05, 0.3], Pose::at(0.0, 0.0, -0.05));
        for (holds, scene) in [("nothing", nothing()), ("a box", in_hand)] {
            let here = arm::assumed(&robot, &scene);
            let mechanism = arm::holding(&robot, &scene, &here);
            let exact = Exact::new(&mechanism, &[]);
            let mut checker = Checker::new(&robot, &scene, &here, 0.0);
            assert_eq!(checker.pairs(), mechanism.pairs().into_iter().collect(), "{name} holds {holds}");
            for _ in 0..100 {
                let joints = robot.arm_joints();
                let posture =
                    JointVector::from_fn(joints.len(), |j| random.random_range(joints[j].lower..joints[j].upper));
                let touch = exact.touch(&posture);
                let collision = checker.collision(&posture, Contact::None);
                assert_eq!(
                    touch.is_some(),
                    collision.is_some(),
                    "{name} holds {holds}, {posture:?}: {touch:?}, {collision:?}"
                );
                touching += usize::from(touch.is_some());
                free += usize::from(touch.is_none());
            }
        }
    }
    assert!(touching > 100 && free > 100, "{touching} {free}");
}

#[test]
fn what_is_fixed_to_the_tool_may_overlap_it_and_what_is_held_is_kept_from_the_links_that_the_tool_may_touch() {
    let robot = tooled();
    let home = JointVector::of([0.0, 0.0]);
    // No joint moves the camera against the tool, so nothing can be done about it.
    assert_eq!(Checker::new(&robot, &nothing(), &robot.at_zero(), 0.0).collision(&home, Contact::None), None);
    // Tool and wrist are neighbours that are made to touch. What the tool holds is not made to touch the wrist.
    let back = boxed([0.04; 3], Pose::at(-0.01, 0.0, 0.0));
    let mut checker = Checker::new(&robot, &back, &robot.at_zero(), 0.0);
    let collision = checker.collision(&home, Contact::None).unwrap();
    assert_eq!((&collision.moving[..], &collision.other[..]), ("link wrist", "held thing"));
}

/// A plate that turns about z, 4 mm above one that stands.
fn plates(geometry: &str) -> String {
    let plate = format!("<collision><geometry>{geometry}</geometry></collision>");
    format!(
        "<robot name='plates'><link name='low'>{plate}</link><link name='turned'/><link name='high'>{plate}</link>\
         <joint name='turn' type='revolute'><parent link='low'/><child link='turned'/><origin xyz='0 0 0.044'/><axis xyz='0 0 1'/>\
         <limit lower='-3' upper='3' velocity='1' effort='1'/></joint>\
         <joint name='mount' type='fixed'><parent link='turned'/><child link='high'/></joint></robot>"
    )
}

#[test]
fn with_an_srdf_too_pairs_whose_spheres_always_meet_are_decided_by_their_shapes() {
    let urdf = plates("<box size='0.4 0.4 0.04'/>");
    let model = RobotModel::read(&urdf, Some(OTHERS_EXCEPTED)).unwrap();
    assert_eq!(model.checks().by_shapes, [pair(&model, "low", "high")].into());
    let mechanism = Mechanism::read(&urdf, Some(OTHERS_EXCEPTED), &[]).unwrap();
    assert!(Space::new(&mechanism, &[]).is_free(&[0.0; MAX_JOINTS]));
    assert_eq!(Exact::new(&mechanism, &[]).touch(&[0.0]), None);
    // Of our robot the spheres of one pair that its SRDF leaves meet in every posture: no posture was free.
    let joints: Vec<String> = (1..=7).map(|i| format!("arm_joint_{i}")).collect();
    let arm = Mechanism::read(AIMM, Some(AIMM_SRDF), &joints).unwrap();
    let names = |(a, b): &Pair| [&arm.links[*a].name[..], &arm.links[*b].name[..]];
    let doubtful: Vec<_> = arm.by_shapes.iter().filter(|(a, b)| arm.is_checked(*a, *b)).map(names).collect();
    assert_eq!(doubtful, [["base", "arm_1"]]);
    let (mut space, mut random) = (Space::new(&arm, &[]), ChaCha8Rng::seed_from_u64(3));
    let mut drawn =
        || std::array::from_fn(|j| arm.joints.get(j).map_or(0.0, |q| random.random_range(q.lower..q.upper) as f32));
    let free = (0..300).filter(|_| space.is_free(&drawn())).count();
    assert!(free > 30, "{free} of 300");
}

/// An STL of a cuboid.
fn cuboid_stl(half: [f64; 3]) -> Vec<u8> {
    let corner = |i: usize| -> [f64; 3] { std::array::from_fn(|k| if i >> k & 1 == 1 { half[k] } else { -half[k] }) };
    let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let mut stl = "solid plate\n".to_owned();
    for [a, b, c, d] in faces {
        for triangle in [[a, b, c], [a, c, d]] {
            stl += "facet normal 0 0 0\nouter loop\n";
            for [x, y, z] in triangle.map(corner) {
                stl += &format!("vertex {x} {y} {z}\n");
            }
            stl += "endloop\nendfacet\n";
        }
    }
    (stl + "endsolid plate\n").into_bytes()
}

const PLATE: [f64; 3] = [0.2, 0.2, 0.02];
/// Excepts pairs of which one link is the lamp, or has no shape.
const OTHERS_EXCEPTED: &str = "<robot name='plates'><disable_collisions link1='low' link2='turned' reason='Never'/>\
                               <disable_collisions link1='low' link2='between' reason='Never'/></robot>";

/// A robot whose links are meshes of a plate.
fn of_plates(urdf: &str, joints: &str, srdf: Option<&str>) -> Robot {
    let toml = format!("name = 'plates'\nurdf = 'plates.urdf'\n[arm]\njoints = [{joints}]\ntool = 'high'\n");
    let description = RobotDescription::read(&toml).unwrap();
    Robot::of(description, urdf, srdf, &mut |_| Ok(cuboid_stl(PLATE))).unwrap()
}

/// The same as `ratn plan` has it.
fn with_meshes(urdf: &str, srdf: Option<&str>) -> RobotModel {
    RobotModel::read_with_meshes(urdf, srdf, &mut |_| Ok(cuboid_stl(PLATE))).unwrap()
}

#[test]
fn meshes_that_are_always_apart_do_not_collide_for_the_spheres_that_stand_for_them() {
    let robot = |height: &str| {
        let urdf = plates("<mesh filename='plate.stl'/>").replace("0 0 0.044", height);
        of_plates(&urdf, "'turn'", Some(OTHERS_EXCEPTED))
    };
    let apart = robot("0 0 0.044");
    assert_eq!(apart.touches(&apart.at_zero(), &[]), []);
    assert!(!apart.model.is_excepted(0, 2) && apart.model.checks().unsaid.is_empty());
}

#[test]
fn an_srdf_that_excepts_no_pair_is_taken_for_none() {
    let links = [ball("upper", "base", "0 0 0", "0.3 0 0"), ball("wrist", "upper", "0.3 0 0", "0.06 0 0")];
    let urdf = format!("<robot name='r'><link name='base'/>{}</robot>", links.concat());
    let group = "<robot name='r'><group name='arm'><joint name='upper_joint'/></group>\
                 <disable_collisions link1='upper' link2='of_another_robot' reason='Never'/></robot>";
    let model = |srdf| RobotModel::read(&urdf, srdf).unwrap();
    let neighbours = pair(&model(None), "upper", "wrist");
    for srdf in [None, Some(group)] {
        let model = model(srdf);
        assert!(!model.has_exceptions());
        assert_eq!(model.checks(), RobotModel::read(&urdf, None).unwrap().checks());
        assert!(model.checks().excepted.contains(&neighbours) && model.checks().unsaid.contains(&neighbours));
    }
}

#[test]
fn pairs_that_meet_in_every_posture_are_not_checked_beside_an_srdf_either_and_others_are() {
    let links = [
        ball("upper", "base", "0 0 0", "0.3 0 0"),
        ball("wrist", "upper", "0.3 0 0", "0.06 0 0"),
        ball("hand", "wrist", "0.06 0 0", "0.02 0 0"),
        ball("lever", "base", "0.3 0.5 0", "0 -0.42 0"),
    ];
    let urdf = format!("<robot name='r'><link name='base'/>{}</robot>", links.concat());
    let srdf = "<robot name='r'><disable_collisions link1='upper' link2='wrist' reason='Adjacent'/></robot>";
    let model = RobotModel::read(&urdf, Some(srdf)).unwrap();
    let always: std::collections::BTreeSet<Pair> =
        [pair(&model, "upper", "hand"), pair(&model, "wrist", "hand")].into();
    assert!(model.has_exceptions());
    assert_eq!(model.checks().unsaid, always);
    let said = [pair(&model, "upper", "wrist")];
    assert_eq!(model.checks().excepted, always.iter().copied().chain(said).collect());
    // What meets in the default state and can part stays checked.
    assert!(!model.is_excepted(pair(&model, "upper", "lever").0, pair(&model, "upper", "lever").1));
}

#[test]
fn a_pair_that_no_planned_joint_parts_is_named() {
    let mast = "<link name='mast'><collision><geometry><sphere radius='0.05'/></geometry></collision></link>\
                <joint name='lift' type='prismatic'><parent link='base'/><child link='mast'/><axis xyz='0 0 1'/>\
                <limit lower='0' upper='1' velocity='1' effort='1'/></joint>";
    // Not a neighbour: there is a shape between.
    let links = [ball("arm", "base", "0 0 0", "0 0 0"), ball("hand", "arm", "0 0 0", "0.3 0 0")];
    let urdf = format!("<robot name='r'><link name='base'/>{mast}{}</robot>", links.concat());
    let mechanism = |joints: &[&str]| {
        let names: Vec<String> = joints.iter().map(ToString::to_string).collect();
        Mechanism::read(&urdf, None, &names).unwrap()
    };
    let arm = mechanism(&["arm_joint", "hand_joint"]);
    assert_eq!(pairs::never_apart(&arm), [(arm.link("mast").unwrap(), arm.link("arm").unwrap())]);
    assert_eq!(pairs::never_apart(&mechanism(&["arm_joint", "hand_joint", "lift"])), []);
}

/// A plate of a mesh that tilts about x and y, each by `limit` at the most, 4 mm above one that stands. The link between them has a shape, so
/// that they are no neighbours.
fn tilting(limit: f64) -> String {
    let plate = "<collision><geometry><mesh filename='plate.stl'/></geometry></collision>";
    let lamp = "<collision><origin xyz='0 0 1'/><geometry><sphere radius='0.01'/></geometry></collision>";
    let hinge = |name: &str, parent: &str, child: &str, at: &str, axis: &str| {
        format!(
            "<joint name='{name}' type='revolute'><parent link='{parent}'/><child link='{child}'/><origin xyz='{at}'/><axis xyz='{axis}'/>\
             <limit lower='-{limit}' upper='{limit}' velocity='1' effort='1'/></joint>"
        )
    };
    format!(
        "<robot name='plates'><link name='low'>{plate}</link><link name='between'>{lamp}</link><link name='high'>{plate}</link>{}{}</robot>",
        hinge("x", "low", "between", "0 0 0.044", "1 0 0"),
        hinge("y", "between", "high", "0 0 0", "0 1 0")
    )
}

/// Whether a posture is free by the checker without and with room around what moves, and by the exact shapes.
fn judged(robot: &Robot, posture: [f64; 2]) -> [bool; 3] {
    let arm = JointVector::of(posture);
    let free = |padding: f64| Checker::new(robot, &nothing(), &robot.at_zero(), padding).is_free(&arm, Contact::None);
    let here = ratn_motion::robot::Configuration { arm, ..robot.at_zero() };
    [free(0.0), free(0.002), robot.touches(&here, &[]).is_empty()]
}

#[test]
fn meshes_whose_spheres_always_meet_are_told_apart_in_the_robots_of_workers_and_cells() {
    // A corner comes down by 0.2 m times both angles.
    let urdf = tilting(0.04);
    for srdf in [None, Some(OTHERS_EXCEPTED)] {
        let robot = of_plates(&urdf, "'x', 'y'", srdf);
        assert_eq!(robot.model.checks(), with_meshes(&urdf, srdf).checks(), "{srdf:?}");
        let plates = pair(&robot.model, "low", "high");
        assert!(robot.model.checks().by_shapes.contains(&plates) && !robot.model.is_excepted(plates.0, plates.1));
        assert_eq!(judged(&robot, [0.0, 0.0]), [true, true, true], "{srdf:?}");
        // A millimetre is left: links that are made to be so close have no room around them.
        assert_eq!(judged(&robot, [0.015, 0.0]), [true, true, true], "{srdf:?}");
        assert_eq!(judged(&robot, [0.025, 0.0]), [false, false, false], "{srdf:?}");
        assert_eq!(judged(&robot, [-0.02, 0.02]), [false, false, false], "{srdf:?}");
        // The search, which does not see the pair, finds a way; what comes of it is free by the meshes, or refused.
        let planned = |goal: [f64; 2]| {
            let request = Request::new(robot.at_zero(), vec![Goal::Joints(JointVector::of(goal))]);
            plan(&robot, &nothing(), &request, &mut |_| Control::Continue)
        };
        let free = planned([0.005, 0.0]).unwrap();
        let here = robot.at_zero();
        validate_trajectory(&robot, &nothing(), &here, &free.trajectory, Contact::None).unwrap();
        let refused = planned([0.035, 0.0]).unwrap_err().to_string();
        assert!(refused.contains("low") && refused.contains("high"), "{refused}");
        // So does a controller refuse it that is sent there all the same.
        let mut longer = free.trajectory.clone();
        longer.points.iter_mut().for_each(|point| {
            point.time_s *= 7.0;
            point.positions.iter_mut().for_each(|q| *q *= 7.0);
        });
        let refused = validate_trajectory(&robot, &nothing(), &here, &longer, Contact::None).unwrap_err().to_string();
        assert!(refused.contains("low") && refused.contains("high"), "{refused}");
    }
}

#[test]
fn meshes_that_were_apart_in_all_postures_that_were_looked_at_are_checked_where_they_meet() {
    let limit = 0.0101;
    let urdf = tilting(limit);
    let exact = with_meshes(&urdf, None);
    assert!(pairs::kinds(&exact)[&Kind::Never].contains(&pair(&exact, "low", "high")));
    for srdf in [None, Some(OTHERS_EXCEPTED)] {
        let robot = of_plates(&urdf, "'x', 'y'", srdf);
        assert_eq!(judged(&robot, [0.0, 0.0]), [true, true, true]);
        assert_eq!(judged(&robot, [limit, limit]), [false, false, false], "{srdf:?}");
    }
}

#[test]
fn with_an_srdf_a_pair_whose_spheres_leave_hardly_a_posture_is_decided_by_its_shapes() {
    // The upper plate slides 4 mm above the lower one, almost off it.
    let slid = |far: &str| {
        let turn = "<axis xyz='0 0 1'/><limit lower='-3' upper='3' velocity='1' effort='1'/>";
        let slide = format!("<axis xyz='1 0 0'/><limit lower='0' upper='{far}' velocity='1' effort='1'/>");
        plates("<box size='0.4 0.4 0.04'/>").replace(turn, &slide).replace("revolute", "prismatic")
    };
    let checks = |urdf: &str| RobotModel::read(urdf, Some(OTHERS_EXCEPTED)).unwrap().checks().by_shapes.len();
    let urdf = slid("0.44");
    let mechanism = Mechanism::read(&urdf, Some(OTHERS_EXCEPTED), &[]).unwrap();
    // There is a posture in which the spheres are apart.
    let poses = mechanism.poses(&[0.44]);
    let placed = |link: usize| {
        let spheres = mechanism.links[link].spheres.iter();
        spheres.map(|s| (poses[link].transform(s.centre), s.radius)).collect::<Vec<_>>()
    };
    let (low, high) = (placed(mechanism.link("low").unwrap()), placed(mechanism.link("high").unwrap()));
    let gap = |(a, r): &([f64; 3], f64), (b, s): &([f64; 3], f64)| {
        (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt() - r - s
    };
    assert!(low.iter().all(|a| high.iter().all(|b| gap(a, b) > 0.0)));
    assert_eq!(checks(&urdf), 1);
    assert!(Space::new(&mechanism, &[]).is_free(&[0.0; MAX_JOINTS]));
    // Spheres that leave many postures are looked at in the search.
    assert_eq!(checks(&slid("0.9")), 0);
}

#[test]
fn meshes_that_are_made_to_run_close_to_each_other_leave_goals() {
    let urdf = plates("<mesh filename='plate.stl'/>").replace("0 0 0.044", "0 0 0.0415");
    for srdf in [None, Some(OTHERS_EXCEPTED)] {
        let robot = of_plates(&urdf, "'turn'", srdf);
        let request = Request::new(robot.at_zero(), vec![Goal::Joints(JointVector::of([0.5]))]);
        let planned = plan(&robot, &nothing(), &request, &mut |_| Control::Continue);
        assert!(planned.is_ok(), "{srdf:?}: {:?}", planned.err());
    }
}

#[test]
fn the_search_sees_links_with_meshes_whose_spheres_leave_room() {
    // The upper plate is lifted by up to 12 cm.
    let turned = tilting(1.0);
    let (hinges, slides) =
        ("<axis xyz='0 1 0'/><limit lower='-1' upper='1'", "<axis xyz='0 0 1'/><limit lower='0' upper='0.12'");
    let urdf = turned.replace(hinges, slides).replace("name='y' type='revolute'", "name='y' type='prismatic'");
    let urdf = urdf.replace("<axis xyz='1 0 0'/>", "<axis xyz='0 0 1'/>");
    let exact = with_meshes(&urdf, None);
    let plates = pair(&exact, "low", "high");
    assert!(exact.checks().by_shapes.contains(&plates), "`ratn plan` leaves it to the meshes");
    let robot = of_plates(&urdf, "'x', 'y'", None);
    assert!(!robot.model.checks().by_shapes.contains(&plates) && !robot.model.is_excepted(plates.0, plates.1));
}
