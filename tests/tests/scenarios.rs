//! Boxes are fetched, and a table is set, whatever goes wrong in the cell. `scripts/check-scenarios` does it at length.

mod support;

use anyhow::{Context, ensure};
use serde_json::Value;
use support::Place;

/// Robot's seconds per second: what a debug build can follow.
const SPEED: &str = "20";

#[test]
fn every_box_is_delivered_although_everything_goes_wrong_once() -> anyhow::Result<()> {
    let place = Place::new()?;
    let out = place.path().join("out");
    let out = out.to_str().context("a path")?;
    // With one planner there are two runs, one in each mode.
    let mut arguments =
        vec!["demo", "--boxes", "2", "--planners", "1", "--speed", SPEED, "--budget", "none", "--json", "--out", out];
    // One after the other: what has begun again meets the next.
    let faults = ["sensor_dropout:1", "localisation_lost:3", "grasp_slips:1", "object_moved:6", "controller_abort:8"];
    arguments.extend(faults.iter().flat_map(|fault| ["--fault", fault]));
    let (code, document, said) = place.start(&arguments)?.finish()?;
    ensure!(code == Some(0), "{code:?}\n{said}");
    let document: Value = serde_json::from_str(&document).with_context(|| document.clone())?;
    ensure!(document["delivered_per_run"] == serde_json::json!([2, 2]), "{document}");
    for run in ["hsm_s", "cdtn_1mp_s"] {
        ensure!(document[run].as_f64().is_some(), "it did not end with success: {document}\n{said}");
    }
    for fault in ["delivers no image", "does not know where it stands", "controller gave up"] {
        ensure!(said.contains(fault), "{fault}: {said}");
    }
    place.wait_until_empty()
}

#[test]
fn a_table_with_a_plate_is_set_with_upright_bowls_and_cups_although_a_grasp_slips_and_the_arm_gives_up()
-> anyhow::Result<()> {
    let place = Place::new()?;
    let out = place.path().join("out");
    let out = out.to_str().context("a path")?;
    let arguments = [
        "demo",
        "--scenario",
        "table",
        "--bowls",
        "1",
        "--forks",
        "1",
        "--cups",
        "1",
        "--plates",
        "1",
        "--planners",
        "1",
        "--speed",
        SPEED,
        "--budget",
        "none",
        "--json",
        "--out",
        out,
        "--fault",
        "grasp_slips:1",
        "--fault",
        "controller_abort:5",
    ];
    let (code, document, said) = place.start(&arguments)?.finish()?;
    ensure!(code == Some(0), "{code:?}\n{said}");
    let document: Value = serde_json::from_str(&document).with_context(|| document.clone())?;
    ensure!(document["delivered_per_run"] == serde_json::json!([4, 4]), "{document}");
    for (run, name) in document["runs"].as_array().context("no runs")?.iter().zip(["hsm_s", "cdtn_1mp_s"]) {
        ensure!(document[name].as_f64().is_some(), "it did not end with success: {document}\n{said}");
        let tilt = run["greatest_tilt_rad"].as_f64().context("no tilt")?;
        ensure!(tilt > 0.0 && tilt < 0.11, "{run}");
    }
    ensure!(said.contains("slipped out of the fingers") && said.contains("controller gave up"), "{said}");
    place.wait_until_empty()
}

/// The task that overlaps in both modes, and how many of its goods are where they should be in each of its runs.
fn overlapped(goods: &[&str], delivered: u64) -> anyhow::Result<()> {
    let place = Place::new()?;
    let out = place.path().join("out");
    let out = out.to_str().context("a path")?;
    // Slower than the others: what the arm does while the camera computes for long is not what it would do in a cell.
    let arguments =
        [&["demo", "--planners", "1", "--speed", "8", "--budget", "overlapped", "--json", "--out", out], goods]
            .concat();
    let (code, document, said) = place.start(&arguments)?.finish()?;
    ensure!(code == Some(0), "{code:?}\n{said}");
    let document: Value = serde_json::from_str(&document).with_context(|| document.clone())?;
    // The state machine for each time that a plan may get better, then the network.
    ensure!(document["delivered_per_run"] == serde_json::json!(vec![delivered; 4]), "{document}");
    ensure!(document["unintended_contacts"] == 0, "{document}\n{said}");
    ensure!(
        document["sweep"].as_array().is_some_and(|sweep| sweep.iter().all(|run| run["hsm_s"].is_f64())),
        "{document}"
    );
    let statistics = &document["runs"][3]["statistics"];
    let beside = statistics["imprecise"].as_array().context("nothing began beside anything")?;
    let says = |motion: &Value, state: &str| motion.as_str().is_some_and(|path| path.ends_with(state));
    // To the next of the goods, or home from the last.
    let goes = |motion: &Value| says(motion, "/move_approach") || says(motion, "stow_arm");
    let leaves = |pair: &Value| goes(&pair["younger"]) && says(&pair["older"], "/open");
    ensure!(beside.iter().any(leaves), "no arm left while its fingers opened: {statistics}");
    let log = std::fs::read_to_string(document["logs"][3].as_str().context("no log")?)?;
    let lines: Vec<Value> = log.lines().map(serde_json::from_str).collect::<Result<_, _>>()?;
    let of = |kind: &str, what: &str, state: &str| {
        let expanded = lines.iter().find(|line| line["path"].as_str().is_some_and(|path| path.ends_with(state)));
        let instance = &expanded.context("the state is not in the log")?["instance"];
        let place = lines.iter().position(|line| line[kind] == what && line["instance"] == *instance);
        place.with_context(|| format!("no {what} of {state}"))
    };
    let looked = of("command", "start", "[0]/another/locate_next")?;
    ensure!(looked < of("event", "finished", "[0]/move_transfer")?, "the arm had carried before the camera looked");
    place.wait_until_empty()
}

#[test]
fn two_boxes_are_fetched_with_looks_and_fingers_beside_the_arm() -> anyhow::Result<()> {
    overlapped(&["--boxes", "2"], 2)
}

#[test]
fn a_bowl_and_a_fork_are_set_with_looks_and_fingers_beside_the_arm() -> anyhow::Result<()> {
    overlapped(&["--scenario", "table", "--bowls", "1", "--forks", "1"], 2)
}
