//! Stops, holds and what goes on after them: no joint is accelerated by more than its limit, nothing leaves its path, and what is said to
//! stand stands.

#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a test may panic and print")]

use ratn_cell::config::{CellConfig, GripperConfig};
use ratn_cell::core::braking::EMERGENCY;
use ratn_cell::core::environment::STEP;
use ratn_cell::core::protocol::{Command, Ending, Event, Request, Ticket};
use ratn_model::pose::Pose;
use ratn_motion::aimm;
use ratn_motion::base::{DriveRequest, plan_drive};
use ratn_motion::pace::Control;
use ratn_motion::plan::Goal;
use ratn_motion::robot::Configuration;
use ratn_worker::safety::SafetyState;

mod bench;
use bench::{Bench, grasp};

/// What a controller that lags overshoots the accelerations of a trajectory at its limits by, and what differences of positions a step apart
/// are off by, as parts of a limit.
const OVERSHOOT: f64 = 0.13;
const ROUNDING: f64 = 0.03;

/// Where the joints of arm and base were, step by step, and what was said.
struct Course {
    configurations: Vec<Configuration>,
    ended: Vec<(usize, Ending)>,
}

fn watch(bench: &mut Bench, seconds: f64) -> Course {
    let mut course = Course { configurations: vec![bench.cell.configuration()], ended: Vec::new() };
    for step in 1..=(seconds / STEP.as_secs_f64()) as usize {
        let commands = bench.pass(STEP.as_secs_f64());
        course.configurations.push(bench.cell.configuration());
        course.ended.extend(commands.into_iter().filter_map(|command| match command {
            Command::Ended { ending, .. } => Some((step, ending)),
            _ => None,
        }));
    }
    course
}

/// All joints of arm and base.
fn joints(at: &Configuration) -> Vec<f64> {
    at.base.iter().chain(&at.arm).copied().collect()
}

/// The greatest acceleration of a joint, as a part of its limit, and the first step from which nothing moves any more.
fn judged(bench: &Bench, course: &Course) -> (f64, usize) {
    let robot = bench.cell.robot();
    let limits: Vec<f64> = robot.base_joints().iter().chain(robot.arm_joints()).map(|j| j.acceleration).collect();
    let at: Vec<Vec<f64>> = course.configurations.iter().map(joints).collect();
    let dt = STEP.as_secs_f64();
    let bend = |i: usize, j: usize| (at[i][j] - 2.0 * at[i - 1][j] + at[i - 2][j]).abs() / (dt * dt) / limits[j];
    let worst = (2..at.len()).flat_map(|i| (0..limits.len()).map(move |j| bend(i, j))).fold(0.0, f64::max);
    let last = at.last().unwrap();
    let stands = at.iter().rposition(|positions| positions != last).map_or(0, |moved| moved + 1);
    (worst, stands)
}

/// The arm, or the base, half-way of a motion at its limits; where it would come by.
fn under_way(drives: bool) -> (Bench, Ticket, Vec<Configuration>) {
    let begun = || {
        let mut bench = Bench::new(1, 7);
        let request = if drives {
            bench.done(Request::MoveTo { joints: aimm::STOWED, speed: 0.5 });
            let request = DriveRequest {
                start: bench.cell.configuration(),
                goals: vec![[-2.0, 0.3, 0.8]],
                position_tolerance_m: 0.0,
                heading_tolerance_rad: 0.0,
                seen: None,
                speed: 1.0,
                seed: 1,
            };
            let planned = plan_drive(bench.cell.robot(), &bench.cell.scene(), &request, &mut |_| Control::Continue);
            Request::Drive { trajectory: planned.unwrap().trajectory }
        } else {
            Request::MoveTo { joints: aimm::OBSERVATION, speed: 1.0 }
        };
        let (ticket, none) = bench.start(request);
        assert_eq!(none, vec![]);
        (bench, ticket)
    };
    let (mut whole, _) = begun();
    let course = watch(&mut whole, 15.0);
    let (most, steps) = judged(&whole, &course);
    assert!(most > 0.9 && most < 1.0 + OVERSHOOT, "{most} of the limit");
    let (mut bench, ticket) = begun();
    bench.pass(STEP.as_secs_f64() * (steps / 2) as f64);
    (bench, ticket, course.configurations)
}

/// How far a configuration is from a path, at the joint that is farthest.
fn off(at: &Configuration, path: &[Configuration]) -> f64 {
    let apart = |on: &Configuration| joints(at).iter().zip(joints(on)).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    path.iter().map(apart).fold(f64::INFINITY, f64::min)
}

#[test]
fn a_stop_in_mid_motion_brakes_within_the_limits_along_the_path_and_has_ended_when_it_stands() {
    for drives in [false, true] {
        let mut took = Vec::new();
        for emergency in [false, true] {
            let (mut bench, ticket, path) = under_way(drives);
            let event = if emergency {
                Event::Safety { state: SafetyState::Stopped { reason: "a hand".to_owned() } }
            } else {
                Event::Stop { ticket, reason: "its lease ended".to_owned() }
            };
            // How fast it was counts, too.
            let mut course = watch(&mut bench, 2.0 * STEP.as_secs_f64());
            assert_eq!(bench.cell.handle(bench.now, event), vec![]);
            assert!(!bench.cell.stands());
            let after = watch(&mut bench, 4.0);
            course.configurations.extend(&after.configurations[1..]);
            let (worst, stands) = judged(&bench, &course);
            let allowed = if emergency { EMERGENCY } else { 1.0 };
            println!("drives {drives}, emergency {emergency}: {worst:.2} of the limit, {} ms", 4 * (stands - 2));
            assert!(worst < allowed + ROUNDING, "{worst} of the limit");
            assert!(worst > 0.5 * allowed, "it brakes as if it were in no hurry: {worst} of the limit");
            let [(ended, ending)] = &after.ended[..] else { panic!("{:?}", after.ended) };
            assert!(matches!(ending, Ending::Preempted(_) | Ending::Stopped(_)), "{ending:?}");
            // Not before it stands, and not long after.
            assert!((stands - 2..=stands + 2).contains(ended), "stands after {stands}, ended after {ended}");
            assert!(bench.cell.stands());
            assert!(course.configurations.iter().step_by(20).all(|at| off(at, &path) < 0.01));
            took.push(stands);
        }
        assert!(took[1] < took[0], "an emergency stop is the shorter one: {took:?}");
    }
}

#[test]
fn a_hold_brakes_and_goes_on_within_the_limits_along_the_path_to_its_end() {
    for drives in [false, true] {
        let (mut bench, _, path) = under_way(drives);
        let mut course = watch(&mut bench, 2.0 * STEP.as_secs_f64());
        bench.cell.handle(bench.now, Event::Safety { state: SafetyState::Held { reason: "a door".to_owned() } });
        assert!(!bench.cell.stands());
        let stands_at = bench.cell.next_wake().unwrap();
        let held = watch(&mut bench, 3.0);
        assert!(bench.cell.stands() && bench.cell.next_wake().is_none());
        let (_, stands) = judged(&bench, &held);
        assert!(stands > 10 && bench.now.since(stands_at).as_secs_f64() > 1.0, "{stands}");
        bench.cell.handle(bench.now, Event::Safety { state: SafetyState::Ready });
        let rest = watch(&mut bench, 20.0);
        for part in [&held, &rest] {
            course.configurations.extend(&part.configurations[1..]);
        }
        let (worst, _) = judged(&bench, &course);
        // Of the whole motion, most of which nothing was held in.
        assert!(worst < 1.0 + OVERSHOOT, "{worst} of the limit");
        // Until it stands, and while it sets out.
        let [braked, again] = [(&held, 300), (&rest, 60)].map(|(part, steps)| {
            let course = Course { configurations: part.configurations[..steps].to_vec(), ended: Vec::new() };
            judged(&bench, &course).0
        });
        assert!(braked < 1.0 + ROUNDING && again < 1.0 + ROUNDING, "{braked} and {again} of the limit");
        let [(_, Ending::Done(_))] = &rest.ended[..] else { panic!("{:?}", rest.ended) };
        assert!(course.configurations.iter().step_by(20).all(|at| off(at, &path) < 0.01));
        assert_eq!(joints(course.configurations.last().unwrap()), joints(path.last().unwrap()));
    }
}

#[test]
fn a_stop_while_a_hold_brakes_or_sets_out_again_keeps_to_the_limits_too() {
    for (hold_s, again_s) in [(0.06, None), (1.0, Some(0.06))] {
        let (mut bench, ticket, _) = under_way(false);
        let mut course = watch(&mut bench, 2.0 * STEP.as_secs_f64());
        let mut go = |bench: &mut Bench, event: Event, seconds: f64| {
            bench.cell.handle(bench.now, event);
            let part = watch(bench, seconds);
            course.configurations.extend(&part.configurations[1..]);
            course.ended.extend(part.ended);
        };
        go(&mut bench, Event::Safety { state: SafetyState::Held { reason: "a door".to_owned() } }, hold_s);
        if let Some(again_s) = again_s {
            go(&mut bench, Event::Safety { state: SafetyState::Ready }, again_s);
        }
        go(&mut bench, Event::Stop { ticket, reason: "enough".to_owned() }, 3.0);
        let (worst, _) = judged(&bench, &course);
        assert!(worst < 1.0 + ROUNDING, "{worst} of the limit");
        assert!(matches!(&course.ended[..], [(_, Ending::Preempted(_))]), "{:?}", course.ended);
    }
}

#[test]
fn an_emergency_stop_while_a_stop_brakes_is_over_sooner() {
    let ends = |emergency: bool| {
        let (mut bench, ticket, _) = under_way(false);
        bench.cell.handle(bench.now, Event::Stop { ticket, reason: "enough".to_owned() });
        bench.pass(0.02);
        if emergency {
            bench.cell.handle(bench.now, Event::Safety { state: SafetyState::Stopped { reason: "a hand".to_owned() } });
        }
        let course = watch(&mut bench, 3.0);
        let (worst, stands) = judged(&bench, &course);
        assert!(worst < EMERGENCY + ROUNDING, "{worst} of the limit");
        assert_eq!(course.ended.len(), 1);
        stands
    };
    assert!(ends(true) < ends(false));
}

/// With fingers that hold just firmly enough for what is planned.
#[test]
fn what_is_carried_is_not_flung_away_by_a_stop() {
    let gripper = GripperConfig { force_n: 12.0, ..GripperConfig::default() };
    let mut bench = Bench::of(CellConfig { boxes: 1, seed: 4, gripper, ..CellConfig::default() });
    bench.reach_for(0);
    bench.done(grasp());
    let tool = bench.cell.robot().tool_pose(&bench.cell.configuration());
    let above = Pose { position: [tool.position[0], tool.position[1], tool.position[2] + 0.2], ..tool };
    bench.go(vec![Goal::Pose(above)], 0.10, 0.0);
    let in_tool = |bench: &Bench| {
        let tool = bench.cell.robot().tool_pose(&bench.cell.configuration());
        tool.inverse().compose(&bench.cell.ground_truth()[0].pose)
    };
    let before = in_tool(&bench);
    let trajectory = bench.plan(&bench.cell.scene(), vec![Goal::Joints(aimm::HOME)], 0.0, 0.0);
    let lasts_s = trajectory.duration_s();
    let (ticket, _) = bench.start(Request::Follow { trajectory });
    bench.pass(lasts_s / 2.0);
    bench.cell.handle(bench.now, Event::Stop { ticket, reason: "enough".to_owned() });
    bench.pass(3.0);
    assert!(bench.cell.ground_truth()[0].held);
    assert!(in_tool(&bench).distance(&before) < 1e-6, "it slipped by {} m", in_tool(&bench).distance(&before));
}
