//! A task on real processes with a robot of one's own whose joints turn without end: in both modes it ends in the same world.

#![allow(clippy::unwrap_used, reason = "what writes the robot's files may panic, and is shared with the cell's tests")]

#[path = "../../crates/cell/tests/roller/mod.rs"]
mod roller;
mod support;

use anyhow::{Context, ensure};
use roller::{ENDLESS, HOME};
use serde_json::Value;
use std::f64::consts::TAU;
use support::{Place, texts};

/// The task counts no turns: what it says of the start is whole turns from where the arm begins.
const TASK: &str = r#"
task: turning
parameters:
  home: { type: joints, default: "joints(0, -0.785, 0, -2.356, 0, 1.571, 0.785)" }
  over: { type: joints, default: "joints(0.5, -0.785, 0, -2.356, 0, 1.571, 3.0)" }
  beyond: { type: joints, default: "joints(0.5, -0.785, 0, -2.356, 0, 1.571, -3.0)" }
world: ["arm_at(arm) = $home"]
outputs:
  joints: { type: joints, value: where.joints }
  turned: { type: joints, value: plan_beyond.end }
states:
  - plan_over: { action: path_planner/plan, in: { start: arm_at(arm), goal: $over } }
  - go_over: { action: arm/follow, in: { trajectory: plan_over.trajectory }, effects: ["arm_at(arm) = $over"] }
  - plan_beyond: { action: path_planner/plan, in: { start: arm_at(arm), goal: $beyond } }
  - go_beyond: { action: arm/follow, in: { trajectory: plan_beyond.trajectory }, effects: ["arm_at(arm) = $beyond"] }
  - go_home: { action: arm/move_to, in: { joints: $home, speed: 0.5 } }
  - where: { action: arm/where }
"#;

/// The joints of an output of a run, in a mode.
fn run(place: &Place, robot: &str, task: &str, mode: &str) -> anyhow::Result<[Vec<f64>; 2]> {
    let output = place
        .ratn(&["run", task, "--robot", robot, "--mode", mode, "--speed", "20", "--seed", "3", "--json"])
        .output()?;
    let (document, said) = texts(&output);
    ensure!(output.status.success(), "{mode}: {document}\n{said}");
    let document: Value = serde_json::from_str(&document).with_context(|| said.clone())?;
    let numbers = |text: &str| -> Option<Vec<f64>> {
        let inside = text.trim_matches(|c: char| !(c.is_ascii_digit() || c == '-'));
        inside.split(',').map(|number| number.trim().parse().ok()).collect()
    };
    let of = |output: &str| {
        let text = document["outputs"][output].to_string();
        numbers(&text).filter(|joints| joints.len() == 7).with_context(|| format!("{output}: {text}"))
    };
    Ok([of("joints")?, of("turned")?])
}

#[test]
fn a_robot_whose_joints_turn_without_end_ends_in_the_same_world_in_both_modes() -> anyhow::Result<()> {
    let place = Place::new()?;
    let robot = roller::write(place.path());
    let robot = robot.to_str().context("a path")?;
    let task = place.path().join("turning.yaml");
    std::fs::write(&task, TASK)?;
    let task = task.to_str().context("a path")?;
    let output = place.ratn(&["robot", "check", robot]).output()?;
    let (lines, said) = texts(&output);
    ensure!(output.status.success(), "{lines}\n{said}");

    let [hsm, cdtn] = ["hsm", "cdtn"].map(|mode| run(&place, robot, task, mode));
    let ([hsm, hsm_turned], [cdtn, cdtn_turned]) = (hsm?, cdtn?);
    for (j, home) in HOME.iter().enumerate() {
        ensure!((hsm[j] - cdtn[j]).abs() < 1e-3, "{hsm:?} and {cdtn:?}");
        let turns = (hsm[j] - home) / TAU;
        let turned = if ENDLESS.contains(&j) { turns.round() } else { 0.0 };
        ensure!((turns - turned).abs() < 1e-3, "{hsm:?} is not the posture {HOME:?}");
    }
    // Over half a turn, and on from there: not back.
    for turned in [hsm_turned, cdtn_turned] {
        ensure!((turned[6] - (TAU - 3.0)).abs() < 1e-3, "{turned:?}");
    }
    place.wait_until_empty()
}
