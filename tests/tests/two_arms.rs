//! A task on real processes whose regions move one arm each, of a robot with two.

#![allow(clippy::unwrap_used, reason = "what writes the robot's files may panic, and is shared with the cell's tests")]

#[path = "../../crates/cell/tests/duo/mod.rs"]
mod duo;
mod support;

use anyhow::{Context, ensure};
use serde_json::Value;
use support::{Place, texts};

const TASK: &str = r#"
task: both_arms
outputs:
  left: { type: joints, value: where_left.joints }
  right: { type: joints, value: where_right.joints }
  holding: { type: bool, value: feel_right.holding }
states:
  - both:
      concurrency: barrier
      regions:
        - swing_left:
            action: arm/move_to
            in: { joints: "joints(0.5, -0.785, 0, -2.356, 0, 1.571, 0.785)", speed: 0.5 }
            pia: true
            reads: []
            effects: ["arm_at(left) = out"]
            resources: [{ block: Arm, where: { arm: left } }]
            duration: 1.5
        - swing_right:
            action: arm/move_to
            in: { joints: "joints(-0.5, -0.785, 0, -2.356, 0, 1.571, 0.785)", speed: 0.5 }
            pia: true
            reads: []
            effects: ["arm_at(right) = out"]
            resources: [{ block: Arm, where: { arm: right } }]
            duration: 1.5
  - where_left: { action: arm/where, resources: [{ block: Arm, where: { arm: left } }] }
  - where_right: { action: arm/where, in: { arm: right }, resources: [{ block: Arm, where: { arm: right } }] }
  - feel_right: { action: gripper/feel, resources: [{ block: Gripper, where: { arm: right } }] }
"#;

#[test]
fn each_region_moves_the_arm_that_it_holds() -> anyhow::Result<()> {
    let place = Place::new()?;
    let robot = duo::write(place.path());
    let robot = robot.to_str().context("a path")?;
    let task = place.path().join("both_arms.yaml");
    std::fs::write(&task, TASK)?;
    let task = task.to_str().context("a path")?;
    let output = place.ratn(&["robot", "check", robot]).output()?;
    let (lines, said) = texts(&output);
    ensure!(output.status.success(), "{lines}\n{said}");
    for line in ["arm       7 joints to the link `left_tool`", "arm       `right`, 7 joints to the link `right_tool`"] {
        ensure!(lines.contains(line), "{lines}");
    }
    ensure!(lines.matches("posture   home: free").count() == 2, "{lines}");

    // What is predicted knows the arms: both move at once.
    let output = place.ratn(&["check", task, "--robot", robot, "--json"]).output()?;
    let (document, said) = texts(&output);
    ensure!(output.status.success(), "{document}\n{said}");
    let checked: Value = serde_json::from_str(&document).with_context(|| said.clone())?;
    let predicted = |mode: &str| checked["sequential"][mode].as_f64();
    ensure!(predicted("hsm_s").is_some_and(|seconds| seconds < 5.5), "{checked}\n{said}");
    ensure!(checked["obstacle"].is_null(), "{checked}");

    // An arm that is not there is named before the run waits for it.
    let wrong = place.path().join("middle.yaml");
    std::fs::write(&wrong, TASK.replace("arm: right }", "arm: middle }"))?;
    let wrong = wrong.to_str().context("a path")?;
    for (of, said) in [(robot, "are left, right"), ("panda", "the robot has one arm")] {
        let output = place.ratn(&["check", wrong, "--robot", of, "--no-simulation"]).output()?;
        let (_, warned) = texts(&output);
        ensure!(warned.contains("whose `arm` is `middle`") && warned.contains(said), "{warned}");
    }

    let rest = ["--robot", robot, "--speed", "20", "--seed", "3", "--json"];
    let output = place.ratn(&[&["run", task][..], &rest].concat()).output()?;
    let (document, said) = texts(&output);
    ensure!(output.status.success(), "{document}\n{said}");
    let document: Value = serde_json::from_str(&document).with_context(|| said.clone())?;
    let outputs = &document["outputs"];
    let first = |arm: &str| outputs[arm].to_string().split(['[', ',']).nth(1).and_then(|text| text.parse::<f64>().ok());
    ensure!((first("left"), first("right")) == (Some(0.5), Some(-0.5)), "{outputs}\n{said}");
    ensure!(outputs["holding"] == false, "{outputs}");
    place.wait_until_empty()
}
