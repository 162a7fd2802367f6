//! Checks that the live cell keeps pace with the robot's clock, and gives the same results as one that runs as fast as it can.

#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a test may panic and print")]

use super::cell_actor::{self, CellHandle};
use super::recorder::Recorder;
use crate::config::{CellConfig, MAX_BOXES};
use crate::core::cell::Cell;
use crate::core::environment::STEP;
use crate::core::faults::Fault;
use crate::core::protocol::{Command, Ending, Event, Request, Ticket};
use crate::core::recording::Line;
use crate::core::snapshot::Snapshot;
use ratn_model::pose::Pose;
use ratn_model::time::Timestamp;
use ratn_model::value::Trajectory;
use ratn_motion::aimm;
use ratn_motion::arm::assumed;
use ratn_motion::base::{DriveRequest, plan_drive};
use ratn_motion::pace::Control;
use ratn_motion::robot::Configuration;
use ratn_worker::robot_clock::RobotClock;
use std::time::{Duration, Instant};

/// The two places between which the base drives, with the arm folded.
const PLACES: [[f64; 3]; 2] = [[0.0; 3], [-2.0, 0.5, 1.5]];

fn config(boxes: usize, faults: &[&str]) -> CellConfig {
    let faults = faults.iter().map(|text| text.parse::<Fault>().unwrap()).collect();
    CellConfig { boxes, seed: 4, faults, ..CellConfig::default() }
}

fn live(cell: Cell, recorder: Recorder, speed: f64) -> CellHandle {
    cell_actor::start(cell, recorder, RobotClock::start(speed), Default::default()).unwrap()
}

async fn perform(handle: &CellHandle, request: Request) -> Ending {
    handle.perform(request).unwrap().ended().await.unwrap()
}

fn saved(cell: &mut Cell, now: Timestamp) -> Box<Snapshot> {
    let commands = cell.handle(now, Event::Save);
    let [Command::Saved { snapshot }] = &commands[..] else { panic!("{commands:?}") };
    snapshot.clone()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cell_at_fifty_times_and_one_as_fast_as_possible_come_to_the_same_to_the_last_bit() {
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("live.jsonl");
    // Boxes that are moved by faults, and a camera that fails at random: both physics and random draws.
    let config = config(3, &["object_moved@1", "object_moved@6.3", "sensor_dropout~0.5"]);
    let cell = Cell::new(config.clone()).unwrap();
    let recorder = Recorder::begin(&file, &cell).unwrap();
    let handle = live(cell, recorder, 50.0);
    for joints in [aimm::OBSERVATION, aimm::HOME] {
        assert!(matches!(perform(&handle, Request::MoveTo { joints, speed: 0.5 }).await, Ending::Done(_)));
        perform(&handle, Request::Capture { frames: 2 }).await;
    }
    let way = handle.perform(Request::MoveTo { joints: aimm::OBSERVATION, speed: 0.2 }).unwrap();
    way.stop().await.unwrap();
    let at_fifty = handle.save().await.unwrap().to_json();

    let mut cell = Cell::new(config).unwrap();
    let mut as_fast = None;
    for line in std::fs::read_to_string(&file).unwrap().lines() {
        if let Line::Event { at, event } = serde_json::from_str(line).unwrap() {
            let saved = cell.handle(at, event).into_iter().find_map(|command| match command {
                Command::Saved { snapshot } => Some(snapshot.to_json()),
                Command::Ended { .. } | Command::Touched { .. } | Command::Noted { .. } => None,
            });
            as_fast = saved.or(as_fast);
        }
    }
    assert_eq!(as_fast, Some(at_fifty));
}

/// Folds the arm and puts every box on the deck.
fn loaded(config: CellConfig) -> Cell {
    let mut cell = Cell::new(config).unwrap();
    let mut state: serde_json::Value = serde_json::from_str(&saved(&mut cell, Timestamp(0)).to_json()).unwrap();
    state["posture"]["arm"] = serde_json::to_value(aimm::STOWED).unwrap();
    let sizes: Vec<[f64; 3]> = cell.ground_truth().iter().map(|truth| truth.size).collect();
    for (i, (slot, size)) in aimm::slots().iter().zip(sizes).enumerate() {
        let pose = slot.compose(&Pose::at(0.0, 0.0, size[2] / 2.0 + 0.001));
        state["environment"]["objects"][i][1]["pose"] = serde_json::to_value(pose).unwrap();
        state["environment"]["objects"][i][1]["at_rest"] = false.into();
    }
    let snapshot = Box::new(Snapshot::from_json(&state.to_string()).unwrap());
    cell.handle(Timestamp(0), Event::PutBack { snapshot });
    cell
}

fn way(cell: &Cell, from: [f64; 3], to: [f64; 3]) -> Trajectory {
    let mut scene = cell.scene();
    // Everything but the table rides on the base.
    scene.objects.retain(|object| object.name == "table");
    let request = DriveRequest {
        start: Configuration { base: from, arm: aimm::STOWED, ..assumed(cell.robot(), &scene) },
        goals: vec![to],
        position_tolerance_m: 0.0,
        heading_tolerance_rad: 0.0,
        seen: None,
        speed: 0.5,
        seed: 1,
    };
    plan_drive(cell.robot(), &scene, &request, &mut |_| Control::Continue).unwrap().trajectory
}

/// A measurement: its name, its cell, and the requests that are repeated.
type Scenario = (&'static str, fn() -> Cell, [Request; 2]);

fn scenarios() -> [Scenario; 3] {
    let to = |joints| Request::MoveTo { joints, speed: 0.3 };
    let table = || Cell::new(config(MAX_BOXES, &[])).unwrap();
    let deck = || loaded(config(MAX_BOXES, &[]));
    let drives = {
        let cell = deck();
        [[0, 1], [1, 0]].map(|[from, to]| Request::Drive { trajectory: way(&cell, PLACES[from], PLACES[to]) })
    };
    let pictures = [Request::Capture { frames: 20 }, Request::Capture { frames: 20 }];
    [
        ("all stands", table, pictures),
        ("the arm moves", table, [to(aimm::OBSERVATION), to(aimm::HOME)]),
        ("nine boxes ride", deck, drives),
    ]
}

/// Processor time of this process, in seconds.
fn processor_s() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap();
    let fields: Vec<&str> = stat.rsplit(") ").next().unwrap().split(' ').collect();
    let ticks: f64 = [11, 12].iter().map(|i| fields[*i].parse::<f64>().unwrap()).sum();
    ticks / 100.0
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "a measurement: cargo test --release -p ratn-cell --lib pace -- --ignored --nocapture"]
async fn how_well_the_cell_keeps_pace_with_nine_boxes() {
    println!("| | speed | reached | late in the median, at most | of one core |\n|---|---|---|---|---|");
    for (name, make, requests) in scenarios() {
        let mut cell = make();
        let (begin, mut now, mut lasts) = (Instant::now(), Timestamp(0), Vec::new());
        for (i, request) in requests.iter().cycle().take(20).enumerate() {
            let started = now;
            let ticket = Ticket(i as u64);
            let mut commands = cell.handle(now, Event::Start { ticket, arm: 0, request: request.clone() });
            while commands.is_empty() {
                now = cell.next_wake().unwrap();
                commands = cell.handle(now, Event::Tick);
            }
            assert!(matches!(&commands[..], [Command::Ended { ending: Ending::Done(_), .. }]), "{commands:?}");
            lasts.push(now.since(started));
        }
        let (took, passed) = (begin.elapsed().as_secs_f64(), now.seconds());
        let steps = passed / STEP.as_secs_f64() / took;
        println!("| {name} | as fast as possible | {:.0}× | {steps:.0} steps/s | 100 % |", passed / took);
        for (speed, goals) in [(1.0, 2), (10.0, 6), (50.0, 20)] {
            let handle = live(make(), Recorder::none(), speed);
            let (begin, used) = (Instant::now(), processor_s());
            let mut late = Vec::new();
            let mut passed = Duration::ZERO;
            for (request, lasts) in requests.iter().cycle().zip(&lasts).take(goals) {
                let started = Instant::now();
                assert!(matches!(perform(&handle, request.clone()).await, Ending::Done(_)));
                late.push(started.elapsed().saturating_sub(lasts.div_f64(speed)));
                passed += *lasts;
            }
            let took = begin.elapsed().as_secs_f64();
            late.sort();
            println!(
                "| {name} | {speed:.0}× | {:.1}× | {:.1} ms, {:.1} ms | {:.0} % |",
                passed.as_secs_f64() / took,
                late[late.len() / 2].as_secs_f64() * 1e3,
                late[late.len() - 1].as_secs_f64() * 1e3,
                100.0 * (processor_s() - used) / took
            );
        }
    }
}
