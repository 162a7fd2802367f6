//! The base drives in the cell: what rides on it, what it is refused, and what stops it.

#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a test may panic")]

mod bench;

use bench::{Bench, grasp};
use ratn_cell::config::CellConfig;
use ratn_cell::core::protocol::{Command, Ending, Event, Module, Product, Request};
use ratn_model::pose::Pose;
use ratn_model::value::Trajectory;
use ratn_motion::aimm;
use ratn_motion::base::{DriveRequest, plan_drive};
use ratn_motion::pace::Control;
use ratn_motion::plan::Goal;
use ratn_worker::safety::SafetyState;
use ratn_world::scene::Scene;
use std::f64::consts::{FRAC_PI_2, PI};

/// The other side of the table, looking at it.
const BEHIND: [f64; 3] = [1.6, 0.0, PI];

fn way(bench: &Bench, scene: &Scene, goal: [f64; 3]) -> Trajectory {
    let request = DriveRequest {
        start: bench.cell.measured(),
        goals: vec![goal],
        position_tolerance_m: 0.0,
        heading_tolerance_rad: 0.0,
        seen: None,
        speed: 0.7,
        seed: 2,
    };
    plan_drive(bench.cell.robot(), scene, &request, &mut |_| Control::Continue).unwrap().trajectory
}

fn drive(bench: &Bench, goal: [f64; 3]) -> Request {
    Request::Drive { trajectory: way(bench, &bench.cell.scene(), goal) }
}

fn stow(bench: &mut Bench) {
    bench.go(vec![Goal::Joints(aimm::STOWED)], 0.0, 0.0);
}

fn off(bench: &Bench, goal: [f64; 3]) -> f64 {
    bench.cell.base_pose().distance(&Pose::at(goal[0], goal[1], 0.0))
}

/// Puts the first box on the deck and folds the arm.
fn load(bench: &mut Bench) -> Pose {
    bench.reach_for(0);
    bench.done(grasp());
    bench.carry();
    bench.done(Request::Release);
    bench.go(vec![Goal::Joints(aimm::OBSERVATION)], 0.10, 0.0);
    stow(bench);
    bench.pass(2.0);
    bench.cell.ground_truth()[0].pose
}

#[test]
fn a_box_on_the_deck_rides_round_the_table_and_is_still_delivered() {
    let mut bench = Bench::new(2, 7);
    let before = load(&mut bench);
    let (battery, start) = (bench.cell.battery(), bench.now);
    let request = drive(&bench, BEHIND);
    let Product::Driven { end, tracking } = bench.done(request) else { panic!() };
    println!("{tracking:?}");
    assert!(tracking.most_m > 1e-4 && tracking.most_m < 0.01 && tracking.most_rad > 1e-5 && tracking.most_rad < 0.01);
    assert!(tracking.rms_m < tracking.most_m && tracking.rms_rad < tracking.most_rad);
    assert!(off(&bench, BEHIND) < 1e-3 && end == bench.cell.base_pose());
    assert_eq!(bench.done(Request::SenseBase), Product::BaseSensed { pose: end });
    let drained = (battery - bench.cell.battery()) * 3600.0 / bench.now.since(start).as_secs_f64();
    assert!((drained - 0.9).abs() < 0.01, "{drained} per hour");
    bench.pass(2.0);
    let rode = &bench.cell.ground_truth()[0];
    let slid = end.inverse().compose(&rode.pose).distance(&before);
    println!("in {:.1} s it slid by {:.2} mm", bench.now.since(start).as_secs_f64(), slid * 1e3);
    assert!(rode.on_base && rode.on == "base", "{rode:?}");
    assert!(slid < 0.01, "it slid by {:.1} mm on the deck", slid * 1e3);
    assert_eq!(bench.cell.unintended_contacts(), []);
}

#[test]
fn the_arm_grasps_from_wherever_the_base_stands() {
    let mut bench = Bench::new(2, 7);
    stow(&mut bench);
    let request = drive(&bench, BEHIND);
    bench.done(request);
    assert_eq!(bench.cell.scene().base, bench.cell.base_pose());
    let tool = bench.cell.robot().tool_pose(&bench.cell.configuration());
    assert!(tool.position[0] > 1.2, "the arm went with the base: {tool:?}");
    let Product::Looking { .. } = bench.done(Request::LookAt { target: aimm::TABLE_CENTRE }) else { panic!() };
    bench.reach_for(0);
    let Product::Grasped { .. } = bench.done(grasp()) else { panic!() };
    assert!(bench.cell.ground_truth()[0].held);
    assert_eq!(bench.cell.unintended_contacts(), []);
}

#[test]
fn a_way_through_the_table_is_driven_and_judged() {
    let mut bench = Bench::new(1, 7);
    stow(&mut bench);
    let empty = Scene { base: Pose::IDENTITY, objects: vec![] };
    let through = way(&bench, &empty, [1.2, 0.0, 0.0]);
    bench.done(Request::Drive { trajectory: through });
    let touched = bench.cell.unintended_contacts();
    assert!(touched.iter().any(|c| c.bodies.contains(&"table".to_owned())), "{touched:?}");
}

#[test]
fn what_stands_on_the_deck_is_told_where_the_base_drives_it_into_the_table() {
    let mut bench = Bench::new(1, 7);
    load(&mut bench);
    assert_eq!(bench.cell.unintended_contacts(), []);
    let empty = Scene { base: Pose::IDENTITY, objects: vec![] };
    let through = way(&bench, &empty, [1.2, 0.0, 0.0]);
    bench.done(Request::Drive { trajectory: through });
    let touched = bench.cell.unintended_contacts();
    let rider = ["table".to_owned(), "slc_1".to_owned()];
    assert!(touched.iter().any(|c| c.bodies == rider && c.depth_m > 0.01), "{touched:?}");
}

#[test]
fn a_way_from_elsewhere_is_refused_with_the_reason() {
    let mut bench = Bench::new(1, 7);
    stow(&mut bench);
    let request = drive(&bench, [-1.0, 0.0, 0.0]);
    bench.done(request.clone());
    let refused = bench.perform(request);
    assert!(matches!(&refused, Ending::Aborted(r) if r.contains("1.000 m") && r.contains("starts")), "{refused:?}");
    assert!(off(&bench, [-1.0, 0.0, 0.0]) < 1e-3, "a refused trajectory moves nothing");
}

#[test]
fn nothing_else_begins_while_the_base_drives_and_it_does_not_drive_while_anything_else_moves() {
    let mut bench = Bench::new(1, 7);
    stow(&mut bench);
    let request = drive(&bench, [-1.5, 0.0, 0.0]);
    bench.start(request.clone());
    bench.pass(1.0);
    for other in [
        Request::MoveTo { joints: aimm::OBSERVATION, speed: 0.3 },
        grasp(),
        Request::LookAt { target: aimm::TABLE_CENTRE },
        Request::Capture { frames: 1 },
    ] {
        let (_, refused) = bench.start(other);
        assert!(
            matches!(&refused[..], [Command::Ended { ending: Ending::Aborted(r), .. }] if r.contains("block `Base`")),
            "{refused:?}"
        );
    }
    bench.pass(60.0);
    let back = drive(&bench, [0.0; 3]);
    bench.start(Request::MoveTo { joints: aimm::OBSERVATION, speed: 0.3 });
    let (_, refused) = bench.start(back);
    assert!(matches!(&refused[..], [Command::Ended { ending: Ending::Aborted(r), .. }] if r.contains("Arm")));
}

#[test]
fn a_base_that_is_to_stop_holds_where_it_is_as_at_an_emergency_stop() {
    for by_goal in [true, false] {
        let mut bench = Bench::new(1, 7);
        stow(&mut bench);
        let request = drive(&bench, [-2.0, 0.0, FRAC_PI_2]);
        let (ticket, none) = bench.start(request);
        assert_eq!(none, vec![]);
        bench.pass(2.0);
        let event = match by_goal {
            true => Event::Stop { ticket, reason: "session expired".to_owned() },
            false => Event::Safety { state: SafetyState::Stopped { reason: "a person".to_owned() } },
        };
        assert_eq!(bench.cell.handle(bench.now, event), vec![]);
        let commands = bench.pass(3.0);
        let ended = |ending: &Ending| match by_goal {
            true => matches!(ending, Ending::Preempted(r) if r.contains("session expired")),
            false => matches!(ending, Ending::Stopped(r) if r == "a person"),
        };
        assert!(
            matches!(&commands[..], [Command::Ended { ticket: t, ending, .. }] if *t == ticket && ended(ending)),
            "{commands:?}"
        );
        let held = bench.cell.base_pose();
        assert!(off(&bench, [0.0; 3]) > 0.1 && off(&bench, [-2.0, 0.0, 0.0]) > 0.1);
        bench.pass(60.0);
        assert_eq!(bench.cell.base_pose(), held);
        assert!(!bench.cell.is_active(Module::Base));
    }
}

#[test]
fn a_hold_pauses_a_drive_and_it_goes_on_to_its_end_afterwards() {
    let mut bench = Bench::new(1, 7);
    stow(&mut bench);
    let request = drive(&bench, [-1.0, 0.0, 0.0]);
    bench.start(request);
    bench.pass(1.0);
    bench.cell.handle(bench.now, Event::Safety { state: SafetyState::Held { reason: "a door".to_owned() } });
    assert_eq!(bench.pass(3.0), vec![]);
    let held = bench.cell.base_pose();
    assert_eq!(bench.pass(30.0), vec![]);
    assert_eq!(bench.cell.base_pose(), held);
    bench.cell.handle(bench.now, Event::Safety { state: SafetyState::Ready });
    let commands = bench.pass(30.0);
    assert!(matches!(&commands[..], [Command::Ended { ending: Ending::Done(Product::Driven { .. }), .. }]));
    assert!(off(&bench, [-1.0, 0.0, 0.0]) < 1e-3);
}

#[test]
fn a_controller_that_gives_up_and_a_lost_robot_stop_half_way_and_drive_on_later() {
    for (fault, why) in [
        ("controller_abort:2", "the base's controller gave up"),
        ("localisation_lost:1", "does not know where it stands"),
        ("localisation_lost@9", "does not know where it stands"),
        ("controller_abort@9", "the base's controller gave up"),
    ] {
        let faults = vec![fault.parse().unwrap()];
        let mut bench = Bench::of(CellConfig { boxes: 1, seed: 7, faults, ..CellConfig::default() });
        stow(&mut bench);
        bench.pass(8.0 - bench.now.seconds());
        let request = drive(&bench, [-2.0, 0.5, 0.3]);
        let ended = bench.perform(request);
        assert!(matches!(&ended, Ending::Aborted(reason) if reason.contains(why)), "{fault}: {ended:?}");
        assert!(off(&bench, [0.0; 3]) > 0.05 && off(&bench, [-2.0, 0.5, 0.0]) > 0.3, "{fault}");
        if fault == "localisation_lost@9" {
            let request = drive(&bench, [-2.0, 0.5, 0.3]);
            assert!(matches!(bench.perform(request), Ending::Aborted(reason) if reason.contains(why)));
            assert!(matches!(bench.perform(Request::SenseBase), Ending::Aborted(reason) if reason.contains(why)));
        }
        bench.pass(3.0);
        let request = drive(&bench, [-2.0, 0.5, 0.3]);
        bench.done(request);
        assert!(off(&bench, [-2.0, 0.5, 0.0]) < 1e-3, "{fault}");
    }
}
