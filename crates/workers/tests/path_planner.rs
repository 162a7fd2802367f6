//! The path planner worker over real sockets, with a real world pool.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_daemon::world_pool::{self, WorldPoolConfig};
use ratn_model::catalogue::Catalogue;
use ratn_model::fact::{Change, FactKey, Term};
use ratn_model::id::{FencingToken, LeaseId, ProjectionId};
use ratn_model::list::List;
use ratn_model::pose::Pose;
use ratn_model::resource::{Lease, LeasedResource};
use ratn_model::value::Value;
use ratn_motion::aimm;
use ratn_motion::arm::assumed;
use ratn_motion::collision::Contact;
use ratn_motion::description::RobotDescription;
use ratn_motion::robot::{Configuration, Robot};
use ratn_motion::validate::validate_trajectory;
use ratn_proto::types::Goal;
use ratn_worker::client::{ActionClient, Channels, Said, WorldClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::{RuntimeDirectory, wait_for_file};
use ratn_worker::tls::ClientTls;
use ratn_worker::worker::WorkerOptions;
use ratn_world::scene::{Placement, Scene, SceneObject, Shape};
use std::collections::BTreeMap;
use std::time::{Duration, Instant};
use tokio::sync::OnceCell;
use tokio_util::sync::CancellationToken;

const DEADLINE: Duration = Duration::from_secs(20);
const RESOURCE: &str = "path-planner-1@here";
const BOX_SIZE: [f64; 3] = [0.14, 0.08, 0.10];

/// How many of the robot's seconds pass in one of ours.
const SPEED: f64 = 10.0;

struct System {
    world_pool: Endpoint,
    planner: Endpoint,
    client: ActionClient,
    _directory: tempfile::TempDir,
}

fn box_pose() -> Pose {
    Pose::from_rpy([0.7, 0.1, aimm::TABLE_HEIGHT_M + BOX_SIZE[2] / 2.0], 0.0, 0.0, 0.5)
}

fn objects() -> Vec<SceneObject> {
    let [x, y, z] = aimm::TABLE_CENTRE;
    let object = |name: &str, size, pose| SceneObject {
        name: name.to_owned(),
        shape: Shape::Box { size },
        placement: Placement::World(pose),
    };
    vec![object("box_1", BOX_SIZE, box_pose()), object("table", aimm::TABLE_SIZE, Pose::at(x, y, z))]
}

async fn system() -> System {
    system_of(Robot::aimm()).await
}

async fn system_of(robot: Robot) -> System {
    let temporary = tempfile::tempdir().unwrap();
    let directory = RuntimeDirectory::create(temporary.path()).unwrap();
    tokio::spawn(world_pool::run(WorldPoolConfig::default(), directory.clone(), CancellationToken::new()));
    let file = temporary.path().join("planner");
    let listen = Endpoint::Unix(temporary.path().join("planner.sock"));
    let options = WorkerOptions { listen, endpoint_file: Some(file.clone()), ..WorkerOptions::default() };
    tokio::spawn(ratn_workers::path_planner::worker(options, robot, SPEED).without_leases().run());
    let world_pool = directory.wait_for(world_pool::ROLE, DEADLINE).await.unwrap();
    let planner = wait_for_file(&file, "planner", DEADLINE).await.unwrap();

    let channels = Channels::new(&ClientTls::none());
    let fact = |predicate: &str, name: &str, value| {
        let fact = FactKey { predicate: predicate.to_owned(), arguments: vec![Term::Name(name.to_owned())] };
        Change::Set { fact, value }
    };
    let changes = objects().into_iter().flat_map(|object| {
        let Placement::World(pose) = object.placement else { unreachable!("all stand") };
        [fact("at", &object.name, Value::Pose(pose)), fact("shape", &object.name, object.shape.to_value())]
    });
    WorldClient::new(&channels, &world_pool).unwrap().commit("setup", changes.collect(), None).await.unwrap();
    System { world_pool, planner, client: ActionClient::new(channels), _directory: temporary }
}

impl System {
    fn goal(&self, id: &str, inputs: &[(&str, Value)]) -> Goal {
        let resource = LeasedResource {
            id: RESOURCE.to_owned(),
            kind: "PathPlanner".to_owned(),
            endpoint: self.planner.to_string(),
            superclasses: Vec::new(),
        };
        let mut goal_inputs: BTreeMap<String, Value> =
            [("start".to_owned(), Value::Joints(aimm::OBSERVATION.to_vec()))].into();
        goal_inputs.extend(inputs.iter().map(|(port, value)| ((*port).to_owned(), value.clone())));
        Goal {
            id: id.to_owned(),
            action: "plan".to_owned(),
            inputs: goal_inputs,
            seed: 3,
            lease: Some(Lease {
                id: LeaseId(1),
                token: FencingToken(1),
                resources: vec![resource],
                consumed: Vec::new(),
            }),
            world_pool: self.world_pool.to_string(),
            ..Goal::default()
        }
    }

    fn grasp(&self, id: &str, more: &[(&str, Value)]) -> Goal {
        let grasps = aimm::grasp_poses(&box_pose(), BOX_SIZE).map(Value::Pose).to_vec();
        let inputs = [("goal", Value::List(grasps.into())), ("approach_m", Value::Float(aimm::APPROACH_M))];
        self.goal(id, &[&inputs[..], more].concat())
    }
}

#[tokio::test]
async fn a_grasp_is_planned_within_its_budget_in_the_scene_of_the_world_pool() {
    let system = system().await;
    let mut heard = Vec::new();
    let goal = system.grasp("a", &[("budget_s", Value::Float(3.0))]);
    let outcome = system.client.execute(&system.planner, goal, |message, _| heard.push(message)).await.unwrap();
    assert!(outcome.is_success(), "{}", outcome.reason);
    assert_eq!(heard, ["first path"]);
    let number = |port: &str| outcome.outputs[port].as_number().unwrap();
    assert!(number("planning_s") >= 3.0 && number("first_path_s") < number("planning_s"));
    let Value::Trajectory(trajectory) = &outcome.outputs["trajectory"] else { panic!() };
    assert_eq!(
        Some(&outcome.outputs["end"]),
        trajectory.points.last().map(|p| Value::Joints(p.positions.clone())).as_ref()
    );
    let scene = Scene { base: Pose::IDENTITY, objects: objects() };
    let contact = Contact::Gripper(0.01);
    let robot = Robot::aimm();
    let here = Configuration { arm: aimm::OBSERVATION, ..assumed(&robot, &scene) };
    validate_trajectory(&robot, &scene, &here, trajectory, contact).unwrap();
}

#[tokio::test]
async fn without_a_budget_the_first_path_is_improved_for_fifty_milliseconds_and_with_none_to_spend_it_is_the_answer() {
    let system = system().await;
    let mut lasts = Vec::new();
    for (id, more) in [("none", vec![("budget_s", Value::Float(0.0))]), ("default", Vec::new())] {
        let outcome = system.client.execute(&system.planner, system.grasp(id, &more), |_, _| {}).await.unwrap();
        assert!(outcome.is_success(), "{}", outcome.reason);
        let number = |port: &str| outcome.outputs[port].as_number().unwrap();
        let after_first_s = (number("planning_s") - number("first_path_s")) / SPEED;
        assert!(id == "none" || after_first_s >= 0.05, "{after_first_s}");
        let Value::Trajectory(trajectory) = &outcome.outputs["trajectory"] else { panic!() };
        lasts.push(trajectory.duration_s());
    }
    assert!(lasts[1] <= lasts[0], "{lasts:?}");
}

#[tokio::test]
async fn a_goal_that_may_improve_its_result_gives_one_as_soon_as_it_will_do_and_then_quicker_ones_with_the_same_end() {
    let system = system().await;
    let goal = Goal { improves: Some(vec!["end".to_owned()]), ..system.grasp("a", &[]) };
    let (mut given, begun) = (Vec::new(), Instant::now());
    let mut first_after = None;
    let last = system.client.execute_hearing(
        &system.planner,
        goal,
        || true,
        |said| {
            let Said::Improved(better) = said else { return };
            first_after.get_or_insert(begun.elapsed());
            given.push(better);
        },
    );
    let last = last.await.unwrap().outcome;
    assert!(last.is_success(), "{}", last.reason);
    assert!(!given.is_empty(), "nothing was given before the end");
    // It goes on for a second at the least.
    assert!(begun.elapsed() - first_after.unwrap() > Duration::from_millis(900));
    for (n, better) in given.iter().enumerate() {
        assert_eq!(better.outputs["end"], last.outputs["end"]);
        let Value::Trajectory(trajectory) = &better.outputs["trajectory"] else { panic!() };
        assert_eq!(better.cost_s, trajectory.duration_s());
        assert!(n == 0 || better.cost_s < given[n - 1].cost_s);
    }
}

#[tokio::test]
async fn a_goal_with_a_budget_gives_its_result_when_that_is_over_and_ends() {
    let system = system().await;
    let goal = system.grasp("a", &[("budget_s", Value::Float(3.0))]);
    let goal = Goal { improves: Some(Vec::new()), ..goal };
    let mut given = 0;
    let heard = |said| given += usize::from(matches!(said, Said::Improved(_)));
    assert!(system.client.execute_hearing(&system.planner, goal, || true, heard).await.unwrap().outcome.is_success());
    assert_eq!(given, 0);
}

#[tokio::test]
async fn a_cancelled_planning_ends_preempted_long_before_its_budget() {
    let system = system().await;
    let goal = system.grasp("a", &[("budget_s", Value::Float(36_000.0))]);
    let cancelling: OnceCell<tokio::task::JoinHandle<Instant>> = OnceCell::new();
    let outcome = system.client.execute(&system.planner, goal, |_, _| {
        let (client, planner) = (system.client.clone(), system.planner.clone());
        let cancel = tokio::spawn(async move {
            let asked = Instant::now();
            assert!(client.cancel(&planner, "a").await.unwrap());
            asked
        });
        cancelling.set(cancel).unwrap();
    });
    assert_eq!(outcome.await.unwrap().outcome, "preempted");
    let asked = cancelling.into_inner().unwrap().await.unwrap();
    assert!(asked.elapsed() < DEADLINE);
}

#[tokio::test]
async fn what_cannot_be_planned_is_aborted_with_the_reason() {
    let system = system().await;
    let inside = Pose::from_rpy([0.7, -0.2, 0.60], std::f64::consts::PI, 0.0, 0.0);
    for (id, goal, reason) in [
        ("a", Value::Pose(inside), "table"),
        ("b", Value::Pose(Pose::at(4.0, 0.0, 1.0)), "does not reach (4.000, 0.000, 1.000)"),
        ("c", Value::Bool(true), "input `goal` has a bool: expected joints, a pose, or a list of these"),
        ("d", Value::Joints(vec![0.0; 6]), "input `goal` has 6 joints: expected 7"),
    ] {
        let outcome =
            system.client.execute(&system.planner, system.goal(id, &[("goal", goal)]), |_, _| {}).await.unwrap();
        assert_eq!(outcome.outcome, "aborted");
        assert!(outcome.reason.contains(reason), "{}", outcome.reason);
    }
}

#[tokio::test]
async fn nobody_holds_thousands_of_things() {
    let system = system().await;
    let fact = |predicate: &str, name: String, value| Change::Set {
        fact: FactKey { predicate: predicate.to_owned(), arguments: vec![Term::Name(name)] },
        value,
    };
    let shape = Shape::Box { size: [0.01; 3] }.to_value();
    let changes = (0..65).flat_map(|i| {
        let (pose, name) = (Value::Pose(Pose::IDENTITY), format!("held_{i}"));
        [fact("in_gripper", name.clone(), pose), fact("shape", name, shape.clone())]
    });
    let pool = WorldClient::new(&Channels::new(&ClientTls::none()), &system.world_pool).unwrap();
    pool.commit("many", changes.collect(), None).await.unwrap();
    let outcome = system.client.execute(&system.planner, system.grasp("a", &[]), |_, _| {}).await.unwrap();
    assert_eq!(outcome.reason, "by facts `in_gripper` 65 objects are held: at most 64 are planned with");
}

#[tokio::test]
async fn where_a_part_is_that_the_robot_does_not_have_is_refused_instead_of_ignored() {
    let system = system_of(Robot::built_in("panda").unwrap()).await;
    let home = Value::Joints(vec![0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]);
    let goal = |id: &str, port: &str| {
        let inputs = [("start", home.clone()), ("goal", home.clone()), (port, Value::Float(0.05))];
        system.client.execute(&system.planner, system.goal(id, &inputs), |_, _| {})
    };
    for (id, port) in [("a", "pan"), ("b", "tilt")] {
        let outcome = goal(id, port).await.unwrap();
        let said = format!("input `{port}` is given, but the robot `panda` has no head that turns");
        assert!(outcome.outcome == "aborted" && outcome.reason.contains(&said), "{outcome:?}");
    }
    let outcome = goal("c", "width_m").await.unwrap();
    assert!(outcome.is_success(), "it has fingers: {}", outcome.reason);
}

#[tokio::test]
async fn a_straight_part_goes_along_the_axes_that_the_goal_names() {
    let system = system().await;
    let direction = |xyz: &[f64]| Value::List(xyz.iter().map(|c| Value::Float(*c)).collect());
    let frame = |name: &str| Value::String(name.to_owned());
    let ahead = [("approach_direction", direction(&[0.0, 0.0, 1.0])), ("approach_frame", frame("tool"))];
    let outcome = system.client.execute(&system.planner, system.grasp("a", &ahead), |_, _| {}).await.unwrap();
    assert!(outcome.is_success(), "{}", outcome.reason);
    for (id, inputs, reason) in [
        (
            "b",
            vec![("approach_frame", frame("tool"))],
            "input `approach_frame` is tool, but `approach_direction` is missing",
        ),
        ("c", vec![("approach_direction", direction(&[1.0, 0.0]))], "expected a list of three numbers"),
        (
            "d",
            vec![("depart_direction", direction(&[0.0; 3]))],
            "depart_direction is [0.0, 0.0, 0.0]: expected a direction",
        ),
        ("e", vec![ahead[0].clone(), ("approach_frame", frame("box_2"))], "or an object of the scene (box_1, table)"),
    ] {
        let outcome = system.client.execute(&system.planner, system.grasp(id, &inputs), |_, _| {}).await.unwrap();
        assert_eq!(outcome.outcome, "aborted", "{id}");
        assert!(outcome.reason.contains(reason), "{}", outcome.reason);
    }
}

fn numbers(values: &[f64]) -> Value {
    Value::List(values.iter().map(|c| Value::Float(*c)).collect())
}

#[tokio::test]
async fn a_straight_way_through_way_points_is_all_or_an_error_that_says_how_far() {
    let system = system().await;
    let tool = {
        let robot = Robot::aimm();
        robot.tool_pose(&Configuration { arm: aimm::HOME, ..robot.at_zero() })
    };
    let by = |x: f64, y: f64, z: f64| {
        let [a, b, c] = tool.position;
        Value::Pose(Pose { position: [a + x, b + y, c + z], ..tool })
    };
    let start = ("start", Value::Joints(aimm::HOME.to_vec()));
    let way_points = ("way_points", Value::List(vec![by(0.05, 0.0, 0.05), by(0.05, 0.1, 0.05)].into()));
    let rounded = [start.clone(), ("goal", by(0.0, 0.1, 0.0)), way_points.clone(), ("blend_m", Value::Float(0.02))];
    let outcome = system.client.execute(&system.planner, system.goal("a", &rounded), |_, _| {}).await.unwrap();
    assert!(outcome.is_success(), "{}", outcome.reason);
    let straight = ("straight", Value::Bool(true));
    for (id, inputs, reason) in [
        ("b", vec![start.clone(), ("goal", by(1.5, 0.0, 0.3)), straight.clone()], "the tool can go straight for 0."),
        ("c", vec![start.clone(), ("goal", Value::Joints(aimm::STOWED.to_vec())), straight], "expected poses"),
        (
            "d",
            vec![start.clone(), ("goal", by(0.0, 0.1, 0.0)), way_points, ("straight", Value::Bool(false))],
            "input `straight` is false, but `way_points` are there",
        ),
        (
            "e",
            vec![start, ("goal", by(0.0, 0.1, 0.0)), ("blend_m", Value::Float(0.02))],
            "input `blend_m` is given, but the motion has no corners to round",
        ),
    ] {
        let outcome = system.client.execute(&system.planner, system.goal(id, &inputs), |_, _| {}).await.unwrap();
        assert_eq!(outcome.outcome, "aborted", "{id}");
        assert!(outcome.reason.contains(reason), "{}", outcome.reason);
    }
}

#[tokio::test]
async fn what_a_camera_saw_is_in_the_way_and_bytes_that_are_no_points_are_refused() {
    let system = system().await;
    // Points all around the tool at the start, 12 cm from it: nothing gets out.
    let tool = Robot::aimm().tool_pose(&Configuration { arm: aimm::OBSERVATION, ..Robot::aimm().at_zero() });
    let mut points = Vec::new();
    for i in -9..=9 {
        for j in 0..36 {
            let (up, around) = (f64::from(i) * 10.0_f64.to_radians(), f64::from(j) * 10.0_f64.to_radians());
            let point = [up.cos() * around.cos(), up.cos() * around.sin(), up.sin()].map(|c| c * 0.25);
            points.push(std::array::from_fn::<f64, 3, _>(|k| tool.position[k] + point[k]));
        }
    }
    let more = [("cloud", pcd(&points)), ("cloud_radius_m", Value::Float(0.03))];
    let outcome = system.client.execute(&system.planner, system.grasp("caged", &more), |_, _| ()).await.unwrap();
    assert!(!outcome.is_success() && outcome.reason.contains("what was seen"), "{}", outcome.reason);
    let outcome = system.client.execute(&system.planner, system.grasp("free", &more[1..]), |_, _| ()).await.unwrap();
    assert!(outcome.is_success(), "{}", outcome.reason);
    let wrong = [("cloud", Value::Bytes(b"nonsense".to_vec()))];
    let outcome = system.client.execute(&system.planner, system.grasp("wrong", &wrong), |_, _| ()).await.unwrap();
    assert!(outcome.reason.starts_with("input `cloud`: "), "{}", outcome.reason);
}

/// Points as the bytes of a PCD file.
fn pcd(points: &[[f64; 3]]) -> Value {
    let mut cloud = format!(
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\nDATA ascii\n",
        points.len()
    );
    for [x, y, z] in points {
        cloud += &format!("{x} {y} {z}\n");
    }
    Value::Bytes(cloud.into_bytes())
}

fn drive(system: &System, id: &str, arm: &[f64], more: &[(&str, Value)]) -> Goal {
    let to = Value::Pose(Pose::at(-2.5, 0.0, 0.0));
    let from = Value::Pose(Pose::at(0.0, 0.0, 0.0));
    let inputs = [("start", from), ("goal", to), ("arm", Value::Joints(arm.to_vec()))];
    Goal { action: "drive".to_owned(), ..system.goal(id, &[&inputs[..], more].concat()) }
}

#[tokio::test]
async fn a_drive_keeps_away_from_what_a_camera_saw() {
    let system = system().await;
    let length_m = async |id: &str, more: &[(&str, Value)]| {
        let goal = drive(&system, id, &aimm::STOWED, more);
        let outcome = system.client.execute(&system.planner, goal, |_, _| {}).await.unwrap();
        match outcome.outputs.get("length_m") {
            Some(Value::Float(length_m)) => Ok(*length_m),
            _ => Err(outcome.reason),
        }
    };
    let post: Vec<[f64; 3]> = (5..30).map(|i| [-1.25, 0.0, f64::from(i) * 0.02]).collect();
    let cloud = ("cloud", pcd(&post));
    let straight = length_m("straight", &[]).await.unwrap();
    assert!((straight - 2.5).abs() < 1e-3, "{straight} m");
    let around = length_m("around", std::slice::from_ref(&cloud)).await.unwrap();
    assert!(around > straight + 0.05, "{around} m");
    // All of them are taken to be of the floor.
    let low = [cloud, ("cloud_known_within_m", Value::Float(0.7))];
    assert_eq!(length_m("low", &low).await.unwrap(), straight);
    let wrong = length_m("wrong", &[("cloud", Value::Bytes(b"nonsense".to_vec()))]).await.unwrap_err();
    assert!(wrong.starts_with("input `cloud`: "), "{wrong}");
    let others = [("other_arms", Value::Map([("left".to_owned(), Value::Joints(vec![0.0]))].into()))];
    let others = length_m("others", &others);
    let refused = others.await.unwrap_err();
    assert!(refused.starts_with("input `other_arms`: "), "{refused}");
}

/// A base with an arm of one joint on each side, which lies along the base at zero and sticks out where it is turned.
fn two_armed() -> Robot {
    let mut urdf = "<robot name='two'><link name='world'/><link name='along_x'/><link name='along_y'/>\
        <link name='base'><collision><origin xyz='0 0 0.2'/><geometry><box size='0.6 0.4 0.3'/></geometry></collision></link>"
        .to_owned();
    let mut joint = |name: &str, kind: &str, [parent, child]: [&str; 2], xyz: &str, axis: &str, most: f64| {
        urdf += &format!(
            "<joint name='{name}' type='{kind}'><parent link='{parent}'/><child link='{child}'/><origin xyz='{xyz}'/>\
             <axis xyz='{axis}'/><limit lower='-{most}' upper='{most}' effort='1' velocity='1'/></joint>"
        );
    };
    joint("base_x", "prismatic", ["world", "along_x"], "0 0 0", "1 0 0", 5.0);
    joint("base_y", "prismatic", ["along_x", "along_y"], "0 0 0", "0 1 0", 5.0);
    joint("base_yaw", "revolute", ["along_y", "base"], "0 0 0", "0 0 1", 7.0);
    joint("left_joint", "revolute", ["base", "left"], "-0.25 0.15 0.4", "0 0 1", 1.6);
    joint("right_joint", "revolute", ["base", "right"], "-0.25 -0.15 0.4", "0 0 1", 1.6);
    for side in ["left", "right"] {
        urdf += &format!(
            "<link name='{side}'><collision><origin xyz='0.25 0 0'/><geometry><box size='0.5 0.06 0.06'/></geometry></collision></link>"
        );
    }
    urdf += "</robot>";
    let description = r#"
name = "two"
urdf = "two.urdf"
[arm]
name = "left"
joints = ["left_joint"]
tool = "left"
[base]
joints = ["base_x", "base_y", "base_yaw"]
body = "base"
area = { x = [-4.5, 4.5], y = [-4.5, 4.5] }
[postures]
home = [0]
[[other_arm]]
name = "right"
joints = ["right_joint"]
tool = "right"
postures = { home = [0] }
"#;
    Robot::of(RobotDescription::read(description).unwrap(), &urdf, None, &mut |_| unreachable!("no meshes")).unwrap()
}

#[tokio::test]
async fn a_drive_takes_the_other_arms_to_be_where_they_are_said_to_be() {
    let system = system_of(two_armed()).await;
    // A point beside the right arm where that sticks out: 1.5 cm of room are less than the 2 cm that a drive keeps.
    let cloud = [("cloud", pcd(&[[-0.315, -0.5, 0.4]])), ("cloud_radius_m", Value::Float(0.02))];
    let run = async |id: &str, arm: f64, more: &[(&str, Value)]| {
        let goal = drive(&system, id, &[arm], &[&cloud[..], more].concat());
        system.client.execute(&system.planner, goal, |_, _| {}).await.unwrap()
    };
    let right_at = |q: f64| [("other_arms", Value::Map([("right".to_owned(), Value::Joints(vec![q]))].into()))];
    let home = run("home", 0.0, &[]).await;
    assert!(home.is_success(), "{}", home.reason);
    let said = run("said", 0.0, &right_at(0.0)).await;
    assert!(said.is_success(), "{}", said.reason);
    let out = run("out", 0.0, &right_at(-std::f64::consts::FRAC_PI_2)).await;
    assert!(out.reason.contains("the robot cannot drive off"), "{}", out.reason);
    let wrong = run("wrong", 0.0, &right_at(9.0)).await;
    assert!(wrong.reason.starts_with("input `other_arms`: "), "{}", wrong.reason);
}

#[tokio::test]
async fn what_another_arm_holds_drives_along() {
    let system = system_of(two_armed()).await;
    let fact = |predicate: &str, names: &[&str], value| {
        let arguments = names.iter().map(|name| Term::Name((*name).to_owned())).collect();
        Change::Set { fact: FactKey { predicate: predicate.to_owned(), arguments }, value }
    };
    // The right hand holds a cube of 10 cm out to the side. The base is said to start elsewhere than it is.
    let held = vec![
        fact("shape", &["cube"], Shape::Box { size: [0.1; 3] }.to_value()),
        fact("in_gripper", &["cube", "right"], Value::Pose(Pose::at(0.5, -0.1, 0.0))),
        fact("at", &["base"], Value::Pose(Pose::at(-2.0, 0.0, 0.0))),
    ];
    let world = WorldClient::new(&Channels::new(&ClientTls::none()), &system.world_pool).unwrap();
    world.commit("held", held, None).await.unwrap();
    let run = async |id: &str, point: [f64; 3]| {
        let cloud = [("cloud", pcd(&[point])), ("cloud_radius_m", Value::Float(0.02))];
        let goal = drive(&system, id, &[0.0], &cloud);
        system.client.execute(&system.planner, goal, |_, _| {}).await.unwrap()
    };
    let free = run("free", [0.25, -1.5, 0.4]).await;
    assert!(free.is_success(), "it does not stand in its own way: {}", free.reason);
    // 1.5 cm from the cube where that is once the base is where it starts: less than the 2 cm that a drive keeps.
    let beside = run("beside", [0.25, -0.335, 0.4]).await;
    assert!(beside.reason.contains("the robot cannot drive off"), "{}", beside.reason);
    let wrong = vec![
        fact("shape", &["ball"], Shape::Box { size: [0.1; 3] }.to_value()),
        fact("in_gripper", &["ball", "third"], Value::Pose(Pose::IDENTITY)),
    ];
    world.commit("wrong", wrong, None).await.unwrap();
    let wrong = run("wrong", [0.25, -1.5, 0.4]).await;
    assert!(wrong.reason.contains("third"), "{}", wrong.reason);
}

#[test]
fn tasks_may_give_a_cloud_to_both_planners() {
    let catalogue = Catalogue::standard();
    for action in ["plan", "drive"] {
        let optional = &catalogue.action("path_planner", action).unwrap().optional;
        for port in ["cloud", "cloud_radius_m", "cloud_known_within_m", "other_arms"] {
            assert!(optional.contains_key(port), "{action} has no {port}");
        }
    }
}

#[tokio::test]
async fn what_bounds_a_motion_is_read_from_the_goal() {
    let system = system().await;
    let there = ("goal", Value::Joints(aimm::HOME.to_vec()));
    let lasts_s = async |id: &str, more: &[(&str, Value)]| {
        let goal = system.goal(id, &[std::slice::from_ref(&there), more].concat());
        let outcome = system.client.execute(&system.planner, goal, |_, _| {}).await.unwrap();
        match &outcome.outputs.get("trajectory") {
            Some(Value::Trajectory(trajectory)) => Ok(trajectory.duration_s()),
            _ => Err(outcome.reason),
        }
    };
    let usual = lasts_s("a", &[]).await.unwrap();
    for (i, slower) in [
        ("velocity_scale", Value::Float(0.3)),
        ("acceleration_scale", numbers(&[0.2; 7])),
        ("jerk_scale", Value::Float(0.05)),
        ("tool_speed_m_s", Value::Float(0.05)),
        ("tool_turning_rad_s", Value::Float(0.02)),
    ]
    .into_iter()
    .enumerate()
    {
        let lasts = lasts_s(&format!("slower {i}"), std::slice::from_ref(&slower)).await;
        assert!(lasts.clone().unwrap() > usual, "{slower:?}: {lasts:?}, {usual}");
    }
    let size: BTreeMap<String, Value> =
        [("pose".to_owned(), Value::Pose(Pose::at(9.0, 0.0, 1.0))), ("size".to_owned(), numbers(&[0.2; 3]))].into();
    for (i, (inputs, reason)) in [
        (
            vec![("velocity_scale", numbers(&[0.5; 6]))],
            "input `velocity_scale` has 6 numbers: expected a number, or one for each of 7 joints",
        ),
        (vec![("jerk_scale", Value::Bool(true))], "input `jerk_scale` is a bool"),
        (vec![("keep_rad", Value::Float(0.1))], "some are missing"),
        (vec![("keep_axis", numbers(&[0.0, 0.0, 1.0]))], "some are missing"),
        (vec![("inside", Value::Map(size))], "at the start the tool is"),
        (
            vec![
                ("keep_axis", numbers(&[0.0, 0.0, 1.0])),
                ("keep_direction", numbers(&[1.0, 0.0, 0.0])),
                ("keep_rad", Value::Float(0.1)),
            ],
            "rad off the direction that it keeps",
        ),
    ]
    .into_iter()
    .enumerate()
    {
        let said = lasts_s(&format!("refused {i}"), &inputs).await.unwrap_err();
        assert!(said.contains(reason), "{said}");
    }
}

#[tokio::test]
async fn what_a_goal_keeps_out_of_is_in_the_way_though_nothing_stands_there() {
    let system = system_of(Robot::built_in("twin").unwrap()).await;
    let swung = |by: f64| Value::Joints(vec![by, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]);
    let beyond = |y: f64, width: f64| {
        let size = Value::List([4.0, width, 2.6].map(Value::Float).to_vec().into());
        Value::List(
            vec![Value::map([("pose", Value::Pose(Pose::at(0.5, y - width / 2.0, 1.2))), ("size", size)])].into(),
        )
    };
    // The left arm turns towards the middle of the table: its tool comes to y = 0.15.
    let asked = async |id: &str, keep_out: Option<Value>| {
        let inputs = [("start", swung(0.0)), ("goal", swung(-1.3)), ("budget_s", Value::Float(0.0))];
        let more: Vec<(&str, Value)> = keep_out.into_iter().map(|boxes| ("keep_out", boxes)).collect();
        let goal = system.goal(id, &[&inputs[..], &more].concat());
        system.client.execute(&system.planner, goal, |_, _| {}).await.unwrap()
    };
    for (id, keep_out) in [("free", None), ("far", Some(beyond(-0.3, 2.0))), ("none", Some(Value::List(List::new())))] {
        let outcome = asked(id, keep_out).await;
        assert!(outcome.is_success(), "{id}: {}", outcome.reason);
    }
    let outcome = asked("beyond", Some(beyond(0.3, 2.0))).await;
    assert!(!outcome.is_success() && outcome.reason.contains("keep_out[0]"), "{}", outcome.reason);
    let outcome = asked("flat", Some(beyond(0.3, 0.0))).await;
    assert!(
        outcome.reason.contains("the size of `keep_out[0]`") && outcome.reason.contains("expected edges of"),
        "{}",
        outcome.reason
    );
}

#[tokio::test]
async fn a_plan_for_a_crawling_arm_is_refused_and_not_written_out_for_hours_of_motion() {
    let system = system().await;
    let goal = system.grasp("a", &[("speed", Value::Float(0.001))]);
    let outcome = system.client.execute(&system.planner, goal, |_, _| {}).await.unwrap();
    assert_eq!(outcome.outcome, "aborted");
    assert!(outcome.reason.contains("speed"), "{}", outcome.reason);
}

#[tokio::test]
async fn a_world_pool_that_comes_back_is_waited_for_and_a_world_that_ended_with_it_loses_the_attempt() {
    let system = system().await;
    let place = tempfile::tempdir().unwrap();
    let listen = Endpoint::Unix(place.path().join("late.sock"));
    let there = Value::Joints(aimm::STOWED.to_vec());
    let goal = Goal { world_pool: listen.to_string(), ..system.goal("a", &[("goal", there.clone())]) };
    let planned = system.client.execute(&system.planner, goal, |_, _| {});
    let starts = async {
        tokio::time::sleep(Duration::from_millis(400)).await;
        let config = WorldPoolConfig { listen, ..WorldPoolConfig::default() };
        let directory = RuntimeDirectory::create(place.path()).unwrap();
        tokio::spawn(world_pool::run(config, directory, CancellationToken::new()));
    };
    let (outcome, ()) = tokio::join!(planned, starts);
    let outcome = outcome.unwrap();
    assert!(outcome.is_success(), "{}", outcome.reason);

    // Its projections are not there when it is back: the goal comes to no outcome, and whoever gave it gives it again.
    let goal = Goal { projection: Some(ProjectionId(77)), ..system.goal("b", &[("goal", there)]) };
    let lost = system.client.execute(&system.planner, goal, |_, _| {}).await.unwrap_err();
    assert_eq!(lost.code(), Some(tonic::Code::Aborted));
    assert!(lost.to_string().contains("is unknown or has ended"), "{lost}");
}

/// A Panda whose last joint turns without end.
fn endless() -> Robot {
    let file = |ending: &str| {
        let path = format!("{}/../motion/robots/panda.{ending}", env!("CARGO_MANIFEST_DIR"));
        std::fs::read_to_string(path).unwrap()
    };
    let [limited, endless] =
        ["revolute", "continuous"].map(|kind| format!("<joint name=\"arm_joint_7\" type=\"{kind}\">"));
    let urdf = file("urdf");
    assert!(urdf.contains(&limited));
    let description = RobotDescription::read(&file("toml")).unwrap();
    let urdf = urdf.replace(&limited, &endless);
    Robot::of(description, &urdf, Some(&file("srdf")), &mut |_| unreachable!("it has no meshes")).unwrap()
}

#[tokio::test]
async fn a_joint_that_turns_without_end_goes_the_short_way_over_half_a_turn() {
    let system = system_of(endless()).await;
    let posture = |last: f64| Value::Joints(vec![0.0, -0.785, 0.0, -2.356, 0.0, 1.571, last]);
    for (id, start, goal, turns) in [("a", 3.0, -3.0, 0.283), ("b", -7.0, 7.0, 1.434), ("c", 3.5, 3.0, -0.5)] {
        let goal = system.goal(id, &[("start", posture(start)), ("goal", posture(goal))]);
        let outcome = system.client.execute(&system.planner, goal, |_, _| {}).await.unwrap();
        assert!(outcome.is_success(), "{}", outcome.reason);
        let Value::Trajectory(trajectory) = &outcome.outputs["trajectory"] else { panic!() };
        let turned: Vec<f64> = trajectory.points.iter().map(|point| point.positions[6] - start).collect();
        let [first, last] = [turned[0], turned[turned.len() - 1]];
        assert!(first.abs() < 1e-9 && (last - turns).abs() < 1e-3, "{turned:?}");
        // Neither further, nor back.
        assert!(turned.iter().all(|by| by.abs() < turns.abs() + 0.01), "{turned:?}");
    }
}
