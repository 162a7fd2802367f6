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
