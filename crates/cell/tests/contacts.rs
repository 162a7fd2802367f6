//! Which contacts the physics sees, and which of them were meant. No planner's checker is asked here.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_cell::config::{CellConfig, Setting};
use ratn_cell::core::contacts::{Contact, PRESS_M, TOLERANCE_M};
use ratn_cell::core::environment::{Environment, Furniture, Kind, Model, Thing, Touch};
use ratn_cell::core::placement::furniture;
use ratn_cell::core::protocol::{Ending, Event, Request};
use ratn_cell::core::recording::Line;
use ratn_model::pose::Pose;
use ratn_motion::aimm;
use ratn_motion::description::RobotDescription;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::plan::Goal;
use ratn_motion::robot::{Configuration, Robot, UNSAID};
use ratn_world::scene::Scene;
use std::f64::consts::{FRAC_PI_2, PI};

mod bench;
use bench::{Bench, grasp};

/// The built-in robot with everything at zero, without reading its description again.
fn at_zero() -> Configuration {
    Configuration { base: [0.0; 3], arm: JointVector::zeros(7), pan: 0.0, tilt: 0.0, finger: 0.0, others: UNSAID }
}

fn at(x: f64, arm: JointVector) -> Configuration {
    Configuration { base: [x, 0.0, 0.0], arm, finger: 0.055, ..at_zero() }
}

/// What touches once a robot has come there.
fn touches(configuration: Configuration, furniture: &[Furniture]) -> Vec<Touch> {
    let robot = Robot::aimm();
    let mut environment = Environment::new(&robot, &configuration, furniture, &[]);
    environment.step(&robot, &configuration);
    environment.touches()
}

#[test]
fn a_robot_in_its_usual_postures_touches_nothing() {
    for arm in [aimm::HOME, aimm::OBSERVATION, aimm::STOWED] {
        assert_eq!(touches(at(0.0, arm), &furniture(&Robot::aimm(), Setting::Boxes)), [], "{arm:?}");
    }
}

#[test]
fn a_base_that_stands_in_a_wall_is_as_deep_in_it_as_it_is() {
    let wall = Furniture { name: "wall".to_owned(), parts: vec![(Pose::at(1.0, 0.0, 0.2), [0.2, 2.0, 0.4])] };
    // The front of the base is 0.35 m before its middle.
    for depth_m in [0.002, 0.02] {
        let found = touches(at(0.9 - 0.35 + depth_m, aimm::STOWED), std::slice::from_ref(&wall));
        let [touch] = &found[..] else { panic!("{found:?}") };
        assert_eq!(touch.things, [Thing::Link("base".to_owned()), Thing::Fixed("wall".to_owned())]);
        assert!((touch.depth_m - depth_m).abs() < 1e-4, "{touch:?}");
        assert!((touch.at[0] - 0.9).abs() < 0.03 && touch.normal[0] > 0.9, "{touch:?}");
    }
}

#[test]
fn an_arm_that_is_folded_into_its_own_base_touches_it() {
    // Stretched out backwards and down into the deck: joint 1 turns it there, joint 2 bends it by 115°.
    let found = touches(at(0.0, JointVector::of([FRAC_PI_2, -2.0, 0.0, 0.0, 0.0, 0.0, 0.0])), &[]);
    let of_robot = |touch: &&Touch| touch.things.iter().all(|thing| matches!(thing, Thing::Link(_)));
    assert!(found.iter().find(of_robot).is_some_and(|touch| touch.depth_m > TOLERANCE_M), "{found:?}");
}

/// Two plates, which are meshes: the upper one hangs on joints beside the lower one and slides along z towards it. The spheres that hold them meet
/// wherever it is.
fn plates() -> Robot {
    let slide = |name: &str, parent: &str, child: &str, axis: &str| {
        format!(
            "<joint name='{name}' type='prismatic'><parent link='{parent}'/><child link='{child}'/><axis xyz='{axis}'/>\
             <limit lower='-0.006' upper='0.006' effort='1' velocity='1'/></joint>"
        )
    };
    let plate = |name: &str, at: &str, scale: &str| {
        format!(
            "<link name='{name}'><collision><origin xyz='{at}'/><geometry><mesh filename='cube.stl' scale='{scale}'/></geometry></collision></link>"
        )
    };
    let urdf = [
        "<robot name='plates'><link name='foot'/><link name='rail'/>",
        "<joint name='mount' type='fixed'><parent link='foot'/><child link='lower'/></joint>",
        &plate("lower", "0 0 0", "0.3 0.2 0.005"),
        &slide("y", "foot", "rail", "0 1 0"),
        &slide("z", "rail", "upper", "0 0 1"),
        &plate("upper", "0 0 0.008", "0.2 0.1 0.005"),
        "</robot>",
    ]
    .concat();
    let description = "name = 'plates'\nurdf = 'plates.urdf'\n[arm]\njoints = ['y', 'z']\ntool = 'upper'\n[postures]\nhome = [0, 0]\n";
    // A cube about the origin, with edges of 1.
    let corner = |i: usize| [0, 1, 2].map(|axis| if i >> axis & 1 == 0 { -0.5 } else { 0.5 });
    let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let triangles = faces.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]);
    let vertex = |[x, y, z]: [f64; 3]| format!("vertex {x} {y} {z}\n");
    let facet = |triangle: [usize; 3]| {
        let corners: String = triangle.iter().map(|i| vertex(corner(*i))).collect();
        format!("facet normal 0 0 0\nouter loop\n{corners}endloop\nendfacet\n")
    };
    let stl = format!("solid cube\n{}endsolid cube\n", triangles.map(facet).collect::<String>());
    let description = RobotDescription::read(description).unwrap();
    Robot::of(description, &urdf, Some("<robot name='plates'/>"), &mut |_| Ok(stl.clone().into_bytes())).unwrap()
}

#[test]
fn links_that_are_meshes_touch_where_these_do() {
    let robot = plates();
    let [lower, upper] = ["lower", "upper"].map(|name| robot.link(name).unwrap());
    assert!(robot.model.is_by_shapes(lower, upper), "spheres say enough of them");
    let at = |z: f64| Configuration { arm: JointVector::of([0.001, z]), ..robot.at_zero() };
    let mut environment = Environment::new(&robot, &at(0.0), &[], &[]);
    let mut touch = |z: f64| {
        environment.step(&robot, &at(z));
        let mut found = environment.touches();
        // The upper one comes down to the floor, too.
        found.retain(|touch| touch.things.iter().all(|thing| matches!(thing, Thing::Link(_))));
        assert!(found.len() < 2, "{found:?}");
        found.into_iter().next()
    };
    // At zero there are 3 mm between them.
    assert_eq!(touch(0.0), None);
    assert_eq!(touch(-0.0024), None);
    for depth_m in [-2e-4, 2e-4, 1e-3, 2e-3] {
        let met = touch(-0.003 - depth_m).unwrap();
        assert_eq!(met.things, ["lower", "upper"].map(|name| Thing::Link(name.to_owned())));
        assert!((met.depth_m - depth_m).abs() < 2e-5, "{met:?} instead of {depth_m}");
        assert!(met.normal[2] > 0.99 && met.at[2].abs() < 0.004, "{met:?}");
    }
    // One that is wholly inside the other touches it, too.
    let deep = touch(-0.006).unwrap();
    assert!(deep.depth_m > 1e-3, "{deep:?}");
}

#[test]
fn links_meet_loose_objects_with_the_speed_that_they_have() {
    let robot = Robot::aimm();
    let model = Model { kind: Kind::Box, size: [0.1, 0.1, 0.2] };
    let stands = Pose::at(0.42, 0.0, 0.1);
    let mut environment = Environment::new(&robot, &at(0.0, aimm::STOWED), &[], &[(model, stands)]);
    let met = (1..60).find_map(|step| {
        environment.step(&robot, &at(0.001 * f64::from(step), aimm::STOWED));
        environment.touches().into_iter().next()
    });
    let met = met.unwrap();
    assert_eq!(met.things, [Thing::Link("base".to_owned()), Thing::Object(0)]);
    assert!((met.speed_m_s - 0.25).abs() < 0.05, "{met:?}");
}

#[test]
fn a_box_that_is_fetched_touches_only_what_it_should() {
    let mut bench = Bench::new(3, 4);
    bench.fetch_the_first_box();
    assert_eq!(bench.cell.unintended_contacts(), []);
}

/// Lifts the first box, puts it down deeper than it stood by so much, and lifts it again, or lets it go there.
fn pressed(deeper_m: f64, lets_go: bool) -> Bench {
    let mut bench = Bench::new(1, 4);
    bench.reach_for(0);
    bench.done(grasp());
    let stood = bench.cell.robot().tool_pose(&bench.cell.configuration());
    let raised = |by: f64| Pose { position: [stood.position[0], stood.position[1], stood.position[2] + by], ..stood };
    bench.go(vec![Goal::Pose(raised(0.15))], 0.10, 0.0);
    assert_eq!(bench.cell.unintended_contacts(), []);
    bench.go(vec![Goal::Pose(raised(-deeper_m))], 0.0, 0.10);
    if lets_go {
        bench.done(Request::Release);
    }
    bench.go(vec![Goal::Pose(raised(0.15))], 0.10, 0.0);
    bench.pass(1.0);
    bench
}

#[test]
fn what_is_held_may_press_where_it_is_let_go_and_nowhere_else() {
    let bench = pressed(0.006, true);
    assert_eq!(bench.cell.unintended_contacts(), []);
    let bench = pressed(0.006, false);
    let [contact] = &bench.cell.unintended_contacts()[..] else { panic!() };
    assert_eq!(contact.bodies, ["table".to_owned(), "slc_1".to_owned()]);
    assert!((contact.depth_m - 0.006).abs() < TOLERANCE_M, "{contact}");
    assert!(contact.ended > contact.began && contact.meant.is_none(), "{contact}");
    // It is in the recording, too.
    let recorded = bench.lines.iter().filter(|line| matches!(line, Line::Contact { contact: c, .. } if c == contact));
    assert_eq!(recorded.count(), 1);
}

#[test]
fn a_finger_may_push_what_it_closes_around_and_nothing_else() {
    for grasps in [true, false] {
        let mut bench = Bench::new(1, 4);
        let truth = bench.cell.ground_truth()[0].clone();
        // One finger comes down 3 mm beyond the edge of the box.
        let aside = 0.055 - truth.size[1] / 2.0 + 0.003;
        let goals = aimm::grasp_poses(&truth.pose, truth.size).map(|tool| {
            let tool = tool.compose(&Pose::at(0.0, aside, 0.0));
            Goal::Pose(tool)
        });
        bench.go(goals.to_vec(), 0.0, 0.10);
        let moved = bench.cell.ground_truth()[0].pose.distance(&truth.pose);
        assert!((0.002..PRESS_M).contains(&moved), "{moved}");
        if grasps {
            bench.done(grasp());
            bench.carry();
            bench.done(Request::Release);
        }
        bench.go(vec![Goal::Joints(aimm::HOME)], 0.10, 0.0);
        bench.go(vec![Goal::Joints(aimm::OBSERVATION)], 0.0, 0.0);
        let found = bench.cell.unintended_contacts();
        if grasps {
            assert_eq!(found, []);
        } else {
            let [contact] = &found[..] else { panic!("{found:?}") };
            assert!(contact.bodies[0].starts_with("finger") && contact.pushed_m > 0.002, "{contact}");
        }
        // A new scene is judged anew.
        bench.cell.handle(bench.now, Event::Reset { seed: 5, goods: bench.cell.config().goods() });
        assert_eq!(bench.cell.unintended_contacts(), []);
    }
}

#[test]
fn what_was_let_go_may_be_pushed_until_the_fingers_are_away_from_it_though_the_motion_was_cut_short() {
    let mut bench = Bench::of(CellConfig { boxes: 1, seed: 4, ..CellConfig::default() });
    bench.reach_for(0);
    bench.done(grasp());
    bench.done(Request::Release);
    // The arm gives up half-way home, far above the box.
    bench.cell.handle(bench.now, Event::Fault { fault: "controller_abort:1".parse().unwrap() });
    let home = bench.plan(&bench.cell.scene(), vec![Goal::Joints(aimm::HOME)], 0.10, 0.0);
    assert!(matches!(bench.perform(Request::Follow { trajectory: home }), Ending::Aborted(_)));
    // One finger comes down 3 mm beyond the edge of the box, and closes around nothing.
    let truth = bench.cell.ground_truth()[0].clone();
    let aside = Pose::at(0.0, 0.055 - truth.size[1] / 2.0 + 0.003, 0.0);
    let goals = aimm::grasp_poses(&truth.pose, truth.size).map(|tool| Goal::Pose(tool.compose(&aside)));
    bench.go(goals.to_vec(), 0.0, 0.10);
    bench.go(vec![Goal::Joints(aimm::HOME)], 0.10, 0.0);
    let [contact] = &bench.cell.unintended_contacts()[..] else { panic!("{:?}", bench.cell.unintended_contacts()) };
    assert!(contact.bodies[0].starts_with("finger") && contact.pushed_m > TOLERANCE_M, "{contact}");
}

#[test]
fn fingers_that_were_stopped_around_what_they_let_go_may_still_leave_it() {
    let mut bench = Bench::of(CellConfig { boxes: 1, seed: 4, ..CellConfig::default() });
    bench.reach_for(0);
    bench.done(grasp());
    bench.done(Request::Release);
    let up = bench.plan(&bench.cell.scene(), vec![Goal::Joints(aimm::HOME)], 0.10, 0.0);
    let (ticket, _) = bench.start(Request::Follow { trajectory: up });
    bench.pass(0.15);
    bench.cell.handle(bench.now, Event::Stop { ticket, reason: "a test".to_owned() });
    bench.pass(2.0);
    bench.go(vec![Goal::Joints(aimm::HOME)], 0.10, 0.0);
    assert_eq!(bench.cell.unintended_contacts(), []);
}

#[test]
fn what_is_let_go_on_the_edge_of_its_neighbour_was_not_set_down_there() {
    let mut bench = Bench::new(2, 4);
    let truth = bench.cell.ground_truth();
    bench.reach_for(0);
    bench.done(grasp());
    let in_tool = bench.cell.robot().tool_pose(&bench.cell.configuration()).inverse().compose(&truth[0].pose);
    // Over the other one's edge by a centimetre, and 6 mm deep in its top.
    let (held, other) = (&truth[0], &truth[1]);
    let aside = other.size[0] / 2.0 + held.size[1] / 2.0 - 0.01;
    let height = other.size[2] / 2.0 + held.size[2] / 2.0 - 0.006;
    let over = |turn: f64| {
        let target = other.pose.compose(&Pose::from_rpy([turn.cos() * aside, 0.0, height], 0.0, 0.0, FRAC_PI_2));
        Goal::Pose(target.compose(&in_tool.inverse()))
    };
    bench.go(vec![over(0.0), over(PI)], 0.10, 0.10);
    bench.done(Request::Release);
    bench.go(vec![Goal::Joints(aimm::HOME)], 0.10, 0.0);
    bench.pass(5.0);
    let both = |contact: &Contact| contact.bodies.iter().all(|body| body.starts_with("slc_"));
    let found = bench.cell.unintended_contacts();
    assert!(found.iter().any(|contact| both(contact) && contact.depth_m > 0.004), "{found:#?}");
}

/// One finger has come down on a box that is not where it was believed to be: so much of the finger is above the box, and so far below the box's top it
/// went. Also what is believed of the scene: the box where it was before.
fn come_down_on_a_box(over_m: f64, below_m: f64) -> (Bench, Scene) {
    let mut bench = Bench::new(1, 4);
    let (truth, believed) = (bench.cell.ground_truth()[0].clone(), bench.cell.scene());
    let robot = bench.cell.robot();
    let part = robot.finger_parts()[0];
    let (outer, tip) = (robot.open_finger_m() + 2.0 * part.half[1], part.middle[2] + part.half[2]);
    let top = truth.pose.position[2] + truth.size[2] / 2.0;
    let goals = aimm::grasp_poses(&truth.pose, truth.size).map(|tool| {
        let aside = tool.compose(&Pose::at(0.0, outer + truth.size[1] / 2.0 - over_m, 0.0));
        let [x, y, _] = aside.position;
        Goal::Pose(Pose { position: [x, y, top + tip - below_m], ..aside })
    });
    bench.go_regardless_of("slc_1", goals.to_vec(), 0.0, 0.10);
    (bench, believed)
}

#[test]
fn an_arm_that_leaves_what_its_fingers_came_down_on_pushes_it_no_further() {
    let mut pressed = Vec::new();
    // The finger stands on the box, or has pushed it aside.
    for (over_m, below_m) in [(0.02, 0.014), (0.02, 0.020), (0.008, 0.030)] {
        let (mut bench, believed) = come_down_on_a_box(over_m, below_m);
        bench.pass(1.0);
        let before = bench.cell.ground_truth()[0].clone();
        let [touched] = &bench.cell.unintended_contacts()[..] else { panic!("{:?}", bench.cell.unintended_contacts()) };
        assert!(touched.bodies[0].starts_with("finger"), "{touched}");
        let home = bench.plan(&believed, vec![Goal::Joints(aimm::HOME)], 0.10, 0.0);
        bench.done(Request::Follow { trajectory: home });
        bench.pass(1.0);
        let after = bench.cell.ground_truth()[0].clone();
        // What was pressed into the table comes up again, by itself, and stands; what was not stays where it is.
        let stands = aimm::TABLE_HEIGHT_M + after.size[2] / 2.0;
        assert!(after.on == "table" && (after.pose.position[2] - stands).abs() < TOLERANCE_M, "{after:?}");
        let moved = after.pose.distance(&before.pose);
        let was_pressed = before.pose.position[2] < stands - TOLERANCE_M;
        assert!(was_pressed || moved < TOLERANCE_M, "{moved} after {touched}");
        pressed.push(was_pressed);
        let [contact] = &bench.cell.unintended_contacts()[..] else { panic!("{:?}", bench.cell.unintended_contacts()) };
        assert!(contact.began == touched.began && contact.pushed_m < touched.pushed_m + TOLERANCE_M, "{contact}");
    }
    assert_eq!(pressed, [true, true, false]);
}
