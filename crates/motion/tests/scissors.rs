//! Links on different branches of a robot that move towards each other.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::pose::Pose;
use ratn_model::value::{Trajectory, TrajectoryPoint};
use ratn_motion::collision::{Checker, Contact};
use ratn_motion::description::RobotDescription;
use ratn_motion::fingers_meanwhile::met_on_the_way;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::{Configuration, Robot};
use ratn_motion::validate::validate_trajectory;
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};

/// Two levers of 0.5 m, whose tips are boxes of `edge` metres; one joint turns the tips past each other, as the second lever mimics the first.
fn scissors(edge: f64) -> Robot {
    let lever = |name: &str, origin: &str, mimic: &str| {
        format!(
            "<link name='{name}'><collision><origin xyz='0.5 0 0'/><geometry><box size='{edge} {edge} {edge}'/></geometry></collision></link>\
             <joint name='{name}_turns' type='revolute'><parent link='foot'/><child link='{name}'/><origin {origin}/><axis xyz='0 0 1'/>\
             <limit lower='-1' upper='1' velocity='1' effort='1'/>{mimic}</joint>"
        )
    };
    let urdf = format!(
        "<robot name='scissors'><link name='foot'/>{}{}</robot>",
        lever("first", "xyz='0 0 0'", ""),
        lever("second", "xyz='1 0 0' rpy='0 0 3.14159265358979'", "<mimic joint='first_turns'/>")
    );
    let description = RobotDescription::read(
        "name = \"scissors\"\nurdf = \"s.urdf\"\n[arm]\njoints = [\"first_turns\"]\ntool = \"first\"\n",
    );
    let srdf = "<robot name='scissors'/>";
    Robot::of(description.unwrap(), &urdf, Some(srdf), &mut |_| unreachable!("it has no meshes")).unwrap()
}

const EDGES_M: [f64; 4] = [0.02, 0.04, 0.06, 0.1];

#[test]
fn a_trajectory_on_which_two_links_pass_through_each_other_between_its_knots_is_refused() {
    for edge in EDGES_M {
        let robot = scissors(edge);
        let scene = Scene { base: Pose::IDENTITY, objects: Vec::new() };
        let here = Configuration { arm: JointVector::of([-0.5]), ..robot.at_zero() };
        let knots = [
            (0.0, -0.5, 0.0),
            (1.0, -0.5 + 0.2 / 6.0, 0.1),
            (2.0, -0.3, 0.2),
            (3.5, 0.0, 0.2),
            (5.0, 0.3, 0.2),
            (6.0, 0.5 - 0.2 / 6.0, 0.1),
            (7.0, 0.5, 0.0),
        ];
        // Without the knot at which they meet.
        for without in [None, Some(3)] {
            let kept = (0..knots.len()).filter(|knot| Some(*knot) != without).map(|knot| knots[knot]);
            let points = kept.map(|(time_s, at, velocity)| TrajectoryPoint {
                time_s,
                positions: vec![at],
                velocities: vec![velocity],
            });
            let trajectory = Trajectory { joints: vec!["first_turns".to_owned()], points: points.collect() };
            let refused = validate_trajectory(&robot, &scene, &here, &trajectory, Contact::None);
            let refused = refused.map(drop).unwrap_err().to_string();
            assert!(refused.contains("first") && refused.contains("second"), "{edge}: {refused}");
        }
    }
}

#[test]
fn no_two_links_come_nearer_to_each_other_in_one_step_than_twice_the_padding() {
    for edge in EDGES_M {
        let (robot, scene) = (scissors(edge), Scene { base: Pose::IDENTITY, objects: Vec::new() });
        for padding in [0.0, 0.005, 0.02] {
            let mut checker = Checker::new(&robot, &scene, &robot.at_zero(), padding);
            // A quarter of a turn each: both tips go straight at each other around the middle.
            let [from, to] = [-0.5, 0.5].map(|at| JointVector::of([at]));
            let step_m = 2.0 * 0.5 / checker.steps(&from, &to) as f64;
            let allowed_m = if padding > 0.0 { 2.0 * padding } else { 0.005 };
            assert!(step_m <= allowed_m, "{edge}, {padding}: {step_m}");
            assert!(checker.edge_collision(&from, &to, Contact::None).is_some(), "{edge}, {padding}");
        }
    }
}

/// An arm that slides along a rail, 1 mm above it, with a hand beyond the rail's end, whose fingers open.
fn on_a_rail() -> Robot {
    let slide = |name: &str, parent: &str, child: &str, axis: &str, upper: f64, mimic: &str| {
        format!(
            "<joint name='{name}' type='prismatic'><parent link='{parent}'/><child link='{child}'/><axis xyz='{axis}'/>\
             <limit lower='0' upper='{upper}' velocity='1' effort='1'/>{mimic}</joint>"
        )
    };
    let boxed = |name: &str, at: &str, size: &str| {
        format!(
            "<link name='{name}'><collision><origin xyz='{at}'/><geometry><box size='{size}'/></geometry></collision></link>"
        )
    };
    let urdf = format!(
        "<robot name='r'>{}<link name='stand'/>{}<link name='hand'/>{}{}{}{}{}{}{}</robot>",
        boxed("rail", "0 0 -0.026", "3 0.1 0.05"),
        boxed("sled", "0 0 0.02", "0.1 0.1 0.04"),
        boxed("left", "0 0.01 0", "0.02 0.02 0.02"),
        boxed("right", "0 -0.01 0", "0.02 0.02 0.02"),
        slide("up", "rail", "stand", "0 0 1", 0.001, ""),
        slide("along", "stand", "sled", "1 0 0", 1.0, ""),
        "<joint name='arm' type='fixed'><parent link='sled'/><child link='hand'/><origin xyz='0 0 0.5'/></joint>",
        slide("opens", "hand", "left", "0 1 0", 0.04, ""),
        slide("too", "hand", "right", "0 -1 0", 0.04, "<mimic joint='opens'/>"),
    );
    let toml = "name = 'r'\nurdf = 'r.urdf'\n[arm]\njoints = ['up', 'along']\ntool = 'hand'\n\
                [gripper]\njoint = 'opens'\nhand = 'hand'\nfinger = 'left'\n";
    let srdf = "<robot name='r'><disable_collisions link1='left' link2='right'/></robot>";
    let description = RobotDescription::read(toml).unwrap();
    Robot::of(description, &urdf, Some(srdf), &mut |_| unreachable!("it has no meshes")).unwrap()
}

#[test]
fn fingers_that_open_on_the_way_are_compared_and_links_that_run_close_to_each_other_are_not() {
    let robot = on_a_rail();
    let nothing = Scene { base: Pose::IDENTITY, objects: Vec::new() };
    let way: Vec<JointVector> = (0..=100).map(|i| JointVector::of([0.0, 0.01 * f64::from(i)])).collect();
    let met =
        |most: usize| met_on_the_way(Checker::new(&robot, &nothing, &robot.at_zero(), 0.0), &way, [0.0, 0.04], most);
    assert_eq!(met(200), Ok(None));
}

#[test]
fn a_link_without_padding_does_not_pass_through_something_thinner_than_its_steps() {
    let urdf = "<robot name='r'><link name='foot'/><link name='plate'><collision><geometry><box size='0.001 0.2 0.2'/></geometry></collision></link>\
                <joint name='slides' type='prismatic'><parent link='foot'/><child link='plate'/><axis xyz='1 0 0'/>\
                <limit lower='0' upper='1' velocity='1' effort='1'/></joint></robot>";
    let toml = "name = 'r'\nurdf = 'r.urdf'\n[arm]\njoints = ['slides']\ntool = 'plate'\n";
    let description = RobotDescription::read(toml).unwrap();
    let robot = Robot::of(description, urdf, None, &mut |_| unreachable!("it has no meshes")).unwrap();
    let beside = |x: f64| {
        let film = SceneObject {
            name: "film".into(),
            shape: Shape::Box { size: [0.0005, 0.2, 0.2] },
            placement: Placement::World(Pose::at(x, 0.0, 0.0)),
        };
        Checker::new(&robot, &Scene { base: Pose::IDENTITY, objects: vec![film] }, &robot.at_zero(), 0.0)
    };
    let [from, to] = [[0.0], [0.31]].map(JointVector::of);
    for x in (0..20).map(|i| 0.2 + 0.0007 * f64::from(i)) {
        let mut checker = beside(x);
        assert!(!checker.edge_is_free(&from, &to, Contact::None), "{x}");
        assert_eq!(checker.edge_collision(&from, &to, Contact::None).unwrap().other, "film", "{x}");
    }
    // Away from it there is room.
    let (from, mut checker) = (JointVector::of([0.2012]), beside(0.2));
    assert!(checker.edge_is_free(&from, &to, Contact::None));
    assert_eq!(checker.edge_collision(&from, &to, Contact::None), None);
}
