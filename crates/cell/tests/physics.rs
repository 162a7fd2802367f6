//! The environment's physics: things stand, fall, are pushed and slip as they should, and the same world comes of the same steps.

#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a test may panic and print")]

use ratn_cell::core::environment::{Environment, FLOOR, Furniture, Kind, Model, STEP, Support};
use ratn_model::pose::Pose;
use ratn_motion::aimm;
use ratn_motion::joint_vector::JointVector;
use ratn_motion::robot::{Configuration, Robot, UNSAID};
use std::f64::consts::FRAC_PI_2;
use std::time::Instant;

const BOX: Model = Model { kind: Kind::Box, size: [0.12, 0.08, 0.10] };

/// The built-in robot with everything at zero, without reading its description again.
fn at_zero() -> Configuration {
    Configuration { base: [0.0; 3], arm: JointVector::zeros(7), pan: 0.0, tilt: 0.0, finger: 0.0, others: UNSAID }
}

fn table() -> Furniture {
    let [x, y, z] = aimm::TABLE_CENTRE;
    Furniture { name: "table".to_owned(), parts: vec![(Pose::at(x, y, z), aimm::TABLE_SIZE)] }
}

fn stowed() -> Configuration {
    Configuration { arm: aimm::STOWED, finger: 0.055, ..at_zero() }
}

fn world(objects: &[(Model, Pose)]) -> (Robot, Environment) {
    let robot = Robot::aimm();
    let environment = Environment::new(&robot, &stowed(), &[table()], objects);
    (robot, environment)
}

/// Steps until all is at rest, at most so many seconds of them.
fn settle(robot: &Robot, environment: &mut Environment, configuration: &Configuration, seconds: f64) {
    for _ in 0..(seconds / STEP.as_secs_f64()) as usize {
        environment.step(robot, configuration);
        if environment.is_at_rest() {
            return;
        }
    }
    panic!("not at rest after {seconds} s");
}

/// Drops it from 5 cm above the table; where it lies then.
fn dropped(model: Model, roll: f64) -> (Pose, String) {
    let height = aimm::TABLE_HEIGHT_M + 0.05 + model.size.iter().fold(0.0_f64, |a, b| a.max(*b)) / 2.0;
    let (robot, mut environment) = world(&[(model, Pose::at(0.8, 0.0, 0.9))]);
    environment.put(0, &Pose::from_rpy([0.8, 0.0, height], roll, 0.0, 0.4));
    settle(&robot, &mut environment, &stowed(), 8.0);
    let on = match environment.rests_on(0) {
        Some(Support::Named(name)) => name.to_owned(),
        other => format!("{other:?}"),
    };
    (environment.state(0).pose, on)
}

#[test]
fn what_is_let_go_above_the_table_comes_to_rest_on_it_as_it_was_made_to() {
    let models = [
        BOX,
        Model { kind: Kind::Plate, size: [0.20, 0.20, 0.024] },
        Model { kind: Kind::Bowl, size: [0.14, 0.14, 0.06] },
        Model { kind: Kind::Cup, size: [0.08, 0.08, 0.09] },
        Model { kind: Kind::Fork, size: [0.18, 0.024, 0.008] },
    ];
    for model in models {
        let (half, kind) = (model.size[2] / 2.0, model.kind);
        let (pose, on) = dropped(model, 0.1);
        assert_eq!(on, "table", "{kind:?}");
        let above = pose.position[2] - aimm::TABLE_HEIGHT_M - half;
        assert!(above.abs() < 0.001, "{kind:?} stands {above} m above the table");
        assert!(pose.rotate([0.0, 0.0, 1.0])[2] > 0.999, "{kind:?} lies: {pose:?}");
    }
}

#[test]
fn a_box_let_go_on_its_edge_falls_over() {
    let (pose, on) = dropped(BOX, 1.1);
    assert_eq!(on, "table");
    assert!(pose.rotate([0.0, 0.0, 1.0])[2].abs() < 0.01, "{pose:?}");
}

#[test]
fn a_box_over_the_tables_edge_falls_to_the_floor() {
    let edge = aimm::TABLE_CENTRE[0] + aimm::TABLE_SIZE[0] / 2.0;
    let (robot, mut environment) = world(&[(BOX, Pose::at(0.8, 0.0, 0.9))]);
    environment.put(0, &Pose::at(edge + 0.01, 0.0, aimm::TABLE_HEIGHT_M + 0.06));
    settle(&robot, &mut environment, &stowed(), 8.0);
    assert_eq!(environment.rests_on(0), Some(Support::Named(FLOOR)));
}

#[test]
fn what_is_stacked_stands_and_what_stood_on_something_taken_away_falls() {
    let height = |n: f64| aimm::TABLE_HEIGHT_M + 0.05 + 0.10 * n;
    let boxes = [0.0, 1.0, 2.0].map(|n| (BOX, Pose::at(0.8, 0.0, height(n))));
    let (robot, mut environment) = world(&boxes);
    environment.put(2, &Pose::at(0.8, 0.0, height(2.0) + 0.002));
    settle(&robot, &mut environment, &stowed(), 8.0);
    assert_eq!(environment.rests_on(2), Some(Support::Object(1)));
    environment.put(1, &Pose::at(0.8, 0.3, height(0.0)));
    settle(&robot, &mut environment, &stowed(), 8.0);
    assert_eq!(environment.rests_on(2), Some(Support::Object(0)));
    assert!((environment.state(2).pose.position[2] - height(1.0)).abs() < 0.002);
}

#[test]
fn a_cup_put_into_a_bowl_stands_on_the_bowls_bottom() {
    let bowl = Model { kind: Kind::Bowl, size: [0.16, 0.16, 0.06] };
    let cup = Model { kind: Kind::Cup, size: [0.06, 0.06, 0.05] };
    let (robot, mut environment) =
        world(&[(bowl, Pose::at(0.8, 0.0, aimm::TABLE_HEIGHT_M + 0.03)), (cup, Pose::at(0.8, 0.3, 0.9))]);
    environment.put(1, &Pose::at(0.8, 0.0, aimm::TABLE_HEIGHT_M + 0.06));
    settle(&robot, &mut environment, &stowed(), 8.0);
    assert_eq!(environment.rests_on(1), Some(Support::Object(0)));
    let bottom = environment.state(1).pose.position[2] - 0.025;
    assert!((bottom - aimm::TABLE_HEIGHT_M - 0.004).abs() < 0.002, "{bottom}");
}

#[test]
fn an_arm_that_sweeps_over_the_table_pushes_what_stands_in_its_way() {
    let robot = Robot::aimm();
    let configuration = |s: f64| Configuration {
        arm: JointVector::from_fn(7, |i| aimm::HOME[i] + if i == 0 { 0.5 * s } else { 0.0 }),
        finger: 0.055,
        ..at_zero()
    };
    let tool = robot.tool_pose(&configuration(0.5));
    let at = Pose::at(tool.position[0], tool.position[1], aimm::TABLE_HEIGHT_M + 0.05);
    let tall = Model { kind: Kind::Box, size: [0.08, 0.08, 2.0 * (tool.position[2] - aimm::TABLE_HEIGHT_M)] };
    let at = Pose::at(at.position[0], at.position[1], aimm::TABLE_HEIGHT_M + tall.size[2] / 2.0);
    let mut environment = Environment::new(&robot, &configuration(0.0), &[table()], &[(tall, at)]);
    for step in 0..500 {
        environment.step(&robot, &configuration(f64::from(step) / 500.0));
    }
    let moved = environment.state(0).pose.distance(&at);
    assert!(moved > 0.03, "pushed by {moved} m");
}

/// Boxes rain onto the table; what comes of it.
fn rain(robot: &Robot, steps: usize) -> Environment {
    let objects: Vec<(Model, Pose)> = (0..9)
        .map(|i| {
            let i = f64::from(i);
            (BOX, Pose::from_rpy([0.7 + 0.03 * (i % 3.0), -0.1 + 0.03 * i, 0.9 + 0.12 * i], 0.3 * i, 0.2, 0.7 * i))
        })
        .collect();
    let mut environment = Environment::new(robot, &stowed(), &[table()], &objects);
    (0..objects.len()).for_each(|i| environment.put(i, &objects[i].1));
    (0..steps).for_each(|_| environment.step(robot, &stowed()));
    environment
}

#[test]
fn the_same_steps_make_the_same_world_and_others_another() {
    let robot = Robot::aimm();
    let one = rain(&robot, 400);
    assert_eq!(one.digest(), rain(&robot, 400).digest());
    assert_ne!(one.digest(), rain(&robot, 401).digest());
}

#[test]
fn what_is_restored_goes_on_as_what_was_saved_also_from_the_middle_of_a_fall() {
    let robot = Robot::aimm();
    let mut one = rain(&robot, 120);
    let saved = one.save(&robot, &stowed());
    assert!(!one.is_at_rest());
    let mut other = Environment::restore(&robot, &stowed(), &[table()], &saved);
    for _ in 0..400 {
        one.step(&robot, &stowed());
        other.step(&robot, &stowed());
    }
    assert_eq!(one.digest(), other.digest());
}

/// The base after so many seconds of a drive at 0.4 m/s that turns; it takes two seconds to be that fast, and two to stand again.
fn driven(seconds: f64) -> Configuration {
    let ramp = |t: f64| 0.1 * t.clamp(0.0, 2.0).powi(2) + 0.4 * (t - 2.0).max(0.0);
    let way = ramp(seconds.min(7.0)) - ramp((seconds.min(7.0) - 5.0).max(0.0));
    Configuration { base: [-way, 0.1 * way, 0.5 * way], ..stowed() }
}

fn step_at(step: u32) -> Configuration {
    driven(f64::from(step) * STEP.as_secs_f64())
}

fn seen_from_base(configuration: &Configuration, pose: &Pose) -> Pose {
    let [x, y, heading] = configuration.base;
    Pose::from_rpy([x, y, 0.0], 0.0, 0.0, heading).inverse().compose(pose)
}

/// A box, a bowl and a lying box on the deck.
fn loaded() -> (Robot, Environment) {
    let bowl = Model { kind: Kind::Bowl, size: [0.125, 0.125, 0.05] };
    let lying = Pose::from_rpy([-0.52, 0.2, aimm::DECK_HEIGHT_M + 0.04], FRAC_PI_2, 0.0, 0.3);
    let on_deck = |x: f64, height: f64| Pose::at(x, 0.0, aimm::DECK_HEIGHT_M + height / 2.0);
    world(&[(BOX, on_deck(-0.22, 0.10)), (bowl, on_deck(-0.4, 0.05)), (BOX, lying)])
}

#[test]
fn what_stands_on_a_deck_that_drives_gently_is_taken_along_and_stands_where_it_stood() {
    let (robot, mut environment) = loaded();
    let before: Vec<Pose> = (0..3).map(|i| environment.state(i).pose).collect();
    let mut rode = 0;
    for step in 0..1800 {
        environment.step(&robot, &step_at(step));
        rode += u32::from(environment.state(0).rides.is_some());
    }
    // The drive takes 7 s; nothing rides before it has stood still on the deck for a while.
    assert!((1500..1700).contains(&rode), "{rode} steps");
    settle(&robot, &mut environment, &step_at(1800), 1.0);
    for (i, before) in before.iter().enumerate() {
        let slid = seen_from_base(&step_at(1800), &environment.state(i).pose).distance(before);
        assert!(slid < 0.002, "{i} slid by {slid} m");
        assert_eq!(environment.rests_on(i), Some(Support::Named("base")));
    }
}

#[test]
fn what_rides_slides_on_when_the_base_stops_dead() {
    let (robot, mut environment) = loaded();
    (0..1000).for_each(|step| environment.step(&robot, &step_at(step)));
    assert!(environment.state(0).rides.is_some());
    let before = environment.state(0).pose;
    settle(&robot, &mut environment, &step_at(999), 3.0);
    let slid = environment.state(0).pose.distance(&before);
    // v² / 2 μ g is 14 mm.
    assert!((0.008..0.02).contains(&slid), "{slid} m");
}

#[test]
fn what_rides_is_let_go_when_something_falls_onto_the_deck() {
    let (robot, mut environment) = loaded();
    (0..700).for_each(|step| environment.step(&robot, &step_at(step)));
    let rider = environment.state(1).pose;
    assert!(environment.state(0).rides.is_some());
    environment.put(2, &Pose::at(rider.position[0], rider.position[1], rider.position[2] + 0.2));
    (700..720).for_each(|step| environment.step(&robot, &step_at(step)));
    assert!((0..3).all(|i| environment.state(i).rides.is_none()));
}

#[test]
fn what_rode_when_it_was_saved_goes_on_riding_alike() {
    let (robot, mut one) = loaded();
    (0..700).for_each(|step| one.step(&robot, &step_at(step)));
    let saved = one.save(&robot, &step_at(699));
    assert!(saved.objects.iter().all(|(_, state)| state.rides.is_some()));
    let mut other = Environment::restore(&robot, &step_at(699), &[table()], &saved);
    for step in 700..1300 {
        one.step(&robot, &step_at(step));
        other.step(&robot, &step_at(step));
        assert_eq!(one.digest(), other.digest(), "step {step}");
    }
    // Where it is put back, the base stands, and what rode is still as fast as it was.
    let mut put_back = Environment::restore(&robot, &step_at(699), &[table()], &saved);
    put_back.step(&robot, &step_at(699));
    assert!(put_back.state(0).rides.is_none() && !put_back.is_at_rest());
}

#[test]
fn nine_falling_boxes_are_computed_faster_than_they_fall() {
    let robot = Robot::aimm();
    let start = Instant::now();
    let steps = 750;
    rain(&robot, steps);
    let factor = steps as f64 * STEP.as_secs_f64() / start.elapsed().as_secs_f64();
    println!("nine falling boxes: {factor:.0} times real time");
    assert!(factor > 1.0, "{factor}");
}
