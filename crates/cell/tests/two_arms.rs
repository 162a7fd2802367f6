//! Two arms of one robot in one cell: they move at once, keep apart, and each holds what is between its own fingers.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_cell::config::CellConfig;
use ratn_cell::core::cell::Cell;
use ratn_cell::core::protocol::{Command, Ending, Event, Module, Product, Request, Ticket};
use ratn_cell::core::recording::{Line, ReplayError, replay};
use ratn_cell::core::snapshot::{Snapshot, SnapshotError};
use ratn_model::grasp;
use ratn_model::pose::Pose;
use ratn_model::value::{Trajectory, TrajectoryPoint};
use ratn_motion::joint_vector::JointVector;
use ratn_motion::pace::Control;
use ratn_motion::plan::{Goal, Request as PlanRequest, plan};
use ratn_motion::robot::Robot;
use ratn_motion::straight::Straight;
use ratn_worker::safety::SafetyState;
use std::collections::BTreeMap;
use tempfile::TempDir;

mod bench;
mod duo;
use bench::{Bench, grasp as close};

const LEFT: usize = 0;
const RIGHT: usize = 1;

fn config(boxes: usize) -> (CellConfig, TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let robot = duo::write(folder.path()).display().to_string();
    (CellConfig { robot, boxes, seed: 2, ..CellConfig::default() }, folder)
}

fn two_arms(boxes: usize) -> (Bench, TempDir) {
    let (config, folder) = config(boxes);
    (Bench::of(config), folder)
}

/// Swings an arm about its foot, by so much from where it is.
fn swing(bench: &Bench, arm: usize, by: f64) -> Request {
    let mut joints = bench.cell.measured_of(arm).arm;
    joints[0] += by;
    Request::MoveTo { joints, speed: 0.5 }
}

/// Lets time pass until all goals have ended; how each did.
fn endings(bench: &mut Bench, goals: &[Ticket]) -> BTreeMap<Ticket, Ending> {
    let mut ended = BTreeMap::new();
    while ended.len() < goals.len() {
        let wakes = bench.cell.next_wake().expect("a goal is under way");
        let passes_s = wakes.since(bench.now).as_secs_f64();
        for command in bench.pass(passes_s) {
            let Command::Ended { ticket, ending, .. } = command else { panic!("{command:?}") };
            ended.insert(ticket, ending);
        }
    }
    ended
}

fn refused(commands: &[Command]) -> &str {
    match commands {
        [Command::Ended { ending: Ending::Aborted(reason), .. }] => reason,
        other => panic!("{other:?}"),
    }
}

/// An arm goes to a pose of its tool, planned with the other one where it stands.
fn go(bench: &mut Bench, arm: usize, goals: Vec<Goal>, depart_m: f64, approach_m: f64) {
    let request = PlanRequest {
        depart: Straight::up(depart_m),
        approach: Straight::down(approach_m),
        speed: 0.5,
        seed: 3,
        improvement_iterations: 20,
        ..PlanRequest::new(bench.cell.measured_of(arm), goals)
    };
    let (robot, scene) = (bench.cell.robot_of(arm), bench.cell.scene_of(arm));
    let planned = plan(robot, &scene, &request, &mut |_| Control::Continue).unwrap();
    let done = bench.perform_with(arm, Request::Follow { trajectory: planned.trajectory });
    assert!(matches!(done, Ending::Done(_)), "{done:?}");
}

/// An arm stands with its fingers around the box of this number, nearest to it of all.
fn reach_for(bench: &mut Bench, arm: usize, object: usize) {
    let truth = bench.cell.ground_truth()[object].clone();
    let goals = grasp::from_above(&truth.pose, truth.size).map(Goal::Pose).to_vec();
    go(bench, arm, goals, 0.0, 0.06);
}

#[test]
fn both_arms_move_at_the_same_time_and_each_comes_to_where_it_was_sent() {
    let (mut bench, _folder) = two_arms(1);
    let wanted = [LEFT, RIGHT].map(|arm| {
        let mut joints = bench.cell.measured_of(arm).arm;
        joints[0] += if arm == LEFT { 0.6 } else { -0.4 };
        joints
    });
    let (left, _) = {
        let request = swing(&bench, LEFT, 0.6);
        bench.start_with(LEFT, request)
    };
    let (right, refusals) = {
        let request = swing(&bench, RIGHT, -0.4);
        bench.start_with(RIGHT, request)
    };
    assert_eq!(refusals, []);
    assert!(bench.cell.is_active(Module::Arm(LEFT)) && bench.cell.is_active(Module::Arm(RIGHT)));
    bench.pass(0.3);
    let under_way = [LEFT, RIGHT].map(|arm| bench.cell.measured_of(arm).arm);
    let ended = endings(&mut bench, &[left, right]);
    assert!(ended.values().all(|ending| matches!(ending, Ending::Done(Product::Moved { .. }))), "{ended:?}");
    for arm in [LEFT, RIGHT] {
        assert_eq!(bench.cell.measured_of(arm).arm, wanted[arm]);
        assert!((under_way[arm][0] - wanted[arm][0]).abs() > 1e-3, "the arm {arm} moved while the other one did");
    }
    assert_eq!(bench.cell.unintended_contacts(), []);
}

#[test]
fn ways_that_cross_are_refused_while_the_other_arm_moves_and_where_it_stands() {
    let (mut bench, _folder) = two_arms(1);
    // To the middle, where both hands would be.
    let (left, _) = {
        let request = swing(&bench, LEFT, -1.4);
        bench.start_with(LEFT, request)
    };
    let to_the_middle = swing(&bench, RIGHT, 1.4);
    let (_, commands) = bench.start_with(RIGHT, to_the_middle.clone());
    let reason = refused(&commands).to_owned();
    assert!(reason.contains("of the arm `right` comes nearer than 20 mm to left_"), "{reason}");
    assert!(reason.contains("of the arm `left`, which is under way with goal 1"), "{reason}");
    let away = swing(&bench, RIGHT, -0.3);
    let (right, commands) = bench.start_with(RIGHT, away);
    assert_eq!(commands, [], "away from it is free");
    endings(&mut bench, &[left, right]);

    // Where it stands it is a part of the robot's body.
    let Ending::Aborted(reason) = bench.perform_with(RIGHT, to_the_middle.clone()) else { panic!() };
    assert!(reason.contains("the trajectory is refused") && reason.contains("link left_"), "{reason}");
    let back = swing(&bench, LEFT, 1.4);
    assert!(matches!(bench.perform_with(LEFT, back), Ending::Done(_)));
    assert!(matches!(bench.perform_with(RIGHT, to_the_middle), Ending::Done(_)));
    assert_eq!(bench.cell.unintended_contacts(), []);
}

#[test]
fn one_goal_is_stopped_and_the_other_arm_goes_on() {
    let (mut bench, _folder) = two_arms(1);
    let (left, _) = {
        let request = swing(&bench, LEFT, 0.6);
        bench.start_with(LEFT, request)
    };
    let (right, _) = {
        let request = swing(&bench, RIGHT, -0.6);
        bench.start_with(RIGHT, request)
    };
    bench.pass(0.3);
    bench.event(Event::Stop { ticket: right, reason: "its lease has ended".to_owned() });
    let ended = endings(&mut bench, &[left, right]);
    assert_eq!(ended[&right], Ending::Preempted("its lease has ended".to_owned()));
    assert!(matches!(ended[&left], Ending::Done(_)));
    let far =
        |arm: usize| (bench.cell.measured_of(arm).arm[0] - bench.cell.robot_of(arm).posture("home").unwrap()[0]).abs();
    assert!((far(LEFT) - 0.6).abs() < 1e-9 && far(RIGHT) > 0.01 && far(RIGHT) < 0.5, "{} {}", far(LEFT), far(RIGHT));
}

#[test]
fn a_hold_stands_both_arms_still_and_both_arrive_when_it_is_over() {
    let (mut bench, _folder) = two_arms(1);
    let (left, _) = {
        let request = swing(&bench, LEFT, 0.6);
        bench.start_with(LEFT, request)
    };
    let (right, _) = {
        let request = swing(&bench, RIGHT, -0.9);
        bench.start_with(RIGHT, request)
    };
    bench.pass(0.4);
    bench.event(Event::Safety { state: SafetyState::Held { reason: "a door".to_owned() } });
    bench.pass(2.0);
    assert!(bench.cell.stands());
    let stands = [LEFT, RIGHT].map(|arm| bench.cell.measured_of(arm).arm);
    bench.pass(3.0);
    assert_eq!(stands, [LEFT, RIGHT].map(|arm| bench.cell.measured_of(arm).arm));
    bench.event(Event::Safety { state: SafetyState::Ready });
    let ended = endings(&mut bench, &[left, right]);
    assert!(ended.values().all(|ending| matches!(ending, Ending::Done(_))), "{ended:?}");
    assert!((stands[LEFT][0] - bench.cell.measured_of(LEFT).arm[0]).abs() > 0.01);
}

#[test]
fn an_emergency_stop_stops_both() {
    let (mut bench, _folder) = two_arms(1);
    let (left, _) = {
        let request = swing(&bench, LEFT, 0.6);
        bench.start_with(LEFT, request)
    };
    let (right, _) = {
        let request = swing(&bench, RIGHT, -0.6);
        bench.start_with(RIGHT, request)
    };
    bench.pass(0.3);
    bench.event(Event::Safety { state: SafetyState::Stopped { reason: "a hand".to_owned() } });
    let ended = endings(&mut bench, &[left, right]);
    assert!(ended.values().all(|ending| *ending == Ending::Stopped("a hand".to_owned())), "{ended:?}");
    assert!(bench.cell.stands());
}

#[test]
fn what_one_hand_holds_the_other_does_not_and_a_snapshot_keeps_both() {
    let (mut bench, _folder) = two_arms(1);
    reach_for(&mut bench, RIGHT, 0);
    assert!(matches!(bench.perform_with(RIGHT, close()), Ending::Done(Product::Grasped { .. })));
    assert_eq!(bench.cell.ground_truth()[0].holder.as_deref(), Some("right"));
    let holds = |bench: &mut Bench, arm: usize| match bench.perform_with(arm, Request::SenseGripper) {
        Ending::Done(Product::GripperSensed { holding, .. }) => holding,
        other => panic!("{other:?}"),
    };
    assert_eq!([LEFT, RIGHT].map(|arm| holds(&mut bench, arm)), [false, true]);
    assert!(matches!(bench.perform_with(LEFT, close()), Ending::Aborted(_)), "nothing is between the left fingers");
    assert!(matches!(bench.perform_with(LEFT, Request::Release), Ending::Done(_)));
    assert!(bench.cell.ground_truth()[0].held, "the left gripper opens its own fingers alone");

    // Lifted, it goes along with its own tool while the other arm stands.
    let home = Goal::Joints(bench.cell.robot_of(RIGHT).posture("home").unwrap());
    go(&mut bench, RIGHT, vec![home], 0.08, 0.0);
    let held = bench.cell.ground_truth()[0].clone();
    let tool = bench.cell.robot_of(RIGHT).tool_pose(&bench.cell.measured_of(RIGHT));
    assert!(held.held && tool.distance(&held.pose) < 0.12, "{held:?}");
    assert_eq!(bench.cell.unintended_contacts(), []);

    let saved = snapshot(&mut bench);
    let mut again = Bench::of(bench.cell.config().clone());
    again.event(Event::PutBack { snapshot: Box::new(saved.clone()) });
    assert_eq!(again.cell.measured(), bench.cell.measured());
    assert_eq!(again.cell.ground_truth()[0].holder.as_deref(), Some("right"));
    assert_eq!(Snapshot::from_json(&saved.to_json()), Ok(saved));
    again.perform_with(RIGHT, Request::Release);
    assert!(!again.cell.ground_truth()[0].held);
}

#[test]
fn fingers_do_not_close_around_what_another_arm_holds() {
    let (mut bench, _folder) = two_arms(1);
    reach_for(&mut bench, LEFT, 0);
    // As if the right arm held what is between the left fingers.
    let mut state: serde_json::Value = serde_json::from_str(&snapshot(&mut bench).to_json()).unwrap();
    let right = bench.cell.robot_of(RIGHT).tool_pose(&bench.cell.measured_of(RIGHT));
    let in_tool = right.inverse().compose(&bench.cell.ground_truth()[0].pose);
    state["posture"]["other_arms"][0]["held"] = serde_json::json!({ "object": 0, "in_tool": in_tool, "friction": 0.6 });
    let held = Snapshot::from_json(&state.to_string()).unwrap();
    bench.event(Event::PutBack { snapshot: Box::new(held) });
    let (_, commands) = bench.start_with(LEFT, close());
    assert!(refused(&commands).contains("slc_1 is between the fingers, and the arm `right` holds it"), "{commands:?}");

    state["held"] = serde_json::json!({ "object": 0, "in_tool": Pose::IDENTITY, "friction": 0.6 });
    let twice = Snapshot::from_json(&state.to_string());
    assert_eq!(twice, Err(SnapshotError::Inconsistent("two arms hold the same object")));
}

fn snapshot(bench: &mut Bench) -> Snapshot {
    let commands = bench.event(Event::Save);
    let [Command::Saved { snapshot }] = &commands[..] else { panic!("{commands:?}") };
    (**snapshot).clone()
}

#[test]
fn a_recording_of_both_arms_replays_and_one_of_another_robot_is_refused_by_name_and_digest() {
    let (mut bench, folder) = two_arms(1);
    let first = Line::header(&bench.cell);
    let (left, _) = {
        let request = swing(&bench, LEFT, 0.4);
        bench.start_with(LEFT, request)
    };
    let (right, _) = {
        let request = swing(&bench, RIGHT, -0.4);
        bench.start_with(RIGHT, request)
    };
    endings(&mut bench, &[left, right]);
    let saved = snapshot(&mut bench);
    let lines: Vec<String> =
        std::iter::once(&first).chain(&bench.lines).map(|line| serde_json::to_string(line).unwrap()).collect();
    let replayed = replay(lines.iter().cloned().map(Ok)).unwrap();
    assert_eq!(replayed.goals, 2);

    // The same name and as many joints, but one of them turns less far.
    duo::write_other(folder.path());
    let other = Robot::from_file(&folder.path().join("robot.toml")).unwrap();
    let refusal = saved.check_robot(&other).unwrap_err().to_string();
    let digest: String = bench.cell.robot().identity().digest.chars().take(12).collect();
    assert!(refusal.contains(&format!("`duo` (digest {digest})")), "{refusal}");
    let refusal = replay(lines.into_iter().map(Ok)).unwrap_err();
    assert!(matches!(refusal, ReplayError::AnotherRobot { .. }), "{refusal}");

    // What comes as an event, past that check, changes nothing.
    let mut elsewhere = Cell::new(bench.cell.config().clone()).unwrap();
    let before = elsewhere.measured();
    elsewhere.handle(bench.now, Event::PutBack { snapshot: Box::new(saved) });
    assert_eq!(elsewhere.measured(), before);
}

#[test]
fn an_arm_that_is_not_there_and_joints_of_another_number_are_refused() {
    let (mut bench, _folder) = two_arms(1);
    let (_, commands) = bench.start_with(2, Request::SenseArm);
    assert_eq!(refused(&commands), "the robot has 2 arms, numbered from 0: there is no arm 2");
    let (_, commands) = bench.start_with(RIGHT, Request::MoveTo { joints: JointVector::zeros(6), speed: 0.3 });
    assert_eq!(refused(&commands), "input `joints` has 6 values: the arm has 7");

    // What was planned for one arm does not move the other.
    let home = bench.cell.robot_of(LEFT).posture("home").unwrap();
    let point = |time_s: f64| TrajectoryPoint { time_s, positions: home.to_vec(), velocities: vec![0.0; 7] };
    let names = bench.cell.robot_of(LEFT).arm_joints().iter().map(|joint| joint.name.clone()).collect();
    let trajectory = Trajectory { joints: names, points: vec![point(0.0), point(1.0)] };
    let (_, commands) = bench.start_with(RIGHT, Request::Follow { trajectory: trajectory.clone() });
    assert!(refused(&commands).contains("left_arm_joint_1"), "{commands:?}");
    assert!(matches!(bench.perform_with(LEFT, Request::Follow { trajectory }), Ending::Done(_)));
}
