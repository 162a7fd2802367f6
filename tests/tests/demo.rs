//! The main job on real processes.

mod support;

use anyhow::{Context, ensure};
use serde_json::Value;
use support::{Place, wait_for};

/// Robot's seconds per second: what a debug build can follow.
const SPEED: &str = "20";

#[test]
fn demo_delivers_the_box_in_every_run_and_says_where_the_time_went() -> anyhow::Result<()> {
    let place = Place::new()?;
    let out = place.path().join("out");
    let out = out.to_str().context("a path")?;
    let mut demo =
        place.start(&["demo", "--boxes", "1", "--speed", SPEED, "--budget", "task", "--json", "--out", out])?;
    let (code, document, said) = demo.finish()?;
    ensure!(code == Some(0), "{code:?}\n{said}");
    let document: Value = serde_json::from_str(&document).with_context(|| document.clone())?;
    for key in ["hsm_s", "cdtn_1mp_s", "cdtn_2mp_s", "improvement_2mp_percent"] {
        ensure!(document[key].as_f64().is_some_and(|n| n > 0.0), "{key} in {document}\n{said}");
    }
    ensure!(document["delivered"] == 1, "{document}");
    let logs = document["logs"].as_array().context("no logs")?;
    ensure!(logs.len() == 3);
    for log in logs {
        let log = log.as_str().context("a path")?;
        let output = place.ratn(&["report", log, "--json"]).output()?;
        let statistics: Value = serde_json::from_slice(&output.stdout)?;
        ensure!(statistics["outcome"] == "success", "{statistics}");
        // Four of them: approach, transfer, retract, stow.
        ensure!(statistics["plans"].as_array().is_some_and(|plans| plans.len() == 4), "{statistics}");
        ensure!(std::path::Path::new(log).with_extension("html").is_file(), "{log} has no chart");
    }
    place.wait_until_empty()
}

#[test]
fn an_arm_behind_a_table_fetches_a_box_as_the_mobile_robot_does() -> anyhow::Result<()> {
    let place = Place::new()?;
    let out = place.path().join("out");
    let out = out.to_str().context("a path")?;
    let robot = ["--robot", "panda", "--planners", "1", "--boxes", "1"];
    let rest = ["--speed", SPEED, "--budget", "none", "--json", "--out", out];
    let mut demo = place.start(&[&["demo"][..], &robot, &rest].concat())?;
    let (code, document, said) = demo.finish()?;
    ensure!(code == Some(0), "{code:?}\n{said}");
    let document: Value = serde_json::from_str(&document).with_context(|| document.clone())?;
    ensure!(document["delivered"] == 1 && document["unintended_contacts"] == 0, "{document}\n{said}");
    for key in ["hsm_s", "cdtn_1mp_s"] {
        ensure!(document[key].as_f64().is_some_and(|n| n > 0.0), "{key} in {document}\n{said}");
    }
    place.wait_until_empty()
}

#[test]
fn two_arms_at_one_table_fetch_their_boxes_together_and_touch_nothing() -> anyhow::Result<()> {
    let place = Place::new()?;
    let out = place.path().join("out");
    let out = out.to_str().context("a path")?;
    let two = ["demo", "--robots", "2", "--boxes", "1", "--seed", "2"];
    let mut demo = place.start(&[&two[..], &["--speed", "10", "--json", "--out", out]].concat())?;
    let (code, document, said) = demo.finish()?;
    ensure!(code == Some(0), "{code:?}\n{said}");
    let document: Value = serde_json::from_str(&document).with_context(|| document.clone())?;
    for key in ["in_turn_s", "together_s", "saving_percent"] {
        ensure!(document[key].as_f64().is_some_and(|n| n > 0.0), "{key} in {document}\n{said}");
    }
    ensure!(document["unintended_contacts"] == 0, "{document}\n{said}");
    let ways = document["ways"].as_array().context("no ways")?;
    ensure!(ways.len() == 2, "{document}");
    for way in ways {
        ensure!(way["delivered"] == 2, "{way}");
        let runs = way["runs"].as_array().context("no runs")?;
        ensure!(runs.iter().map(|run| &run["arm"]).eq(["left", "right"]), "{way}");
        for run in runs {
            let log = std::path::Path::new(run["log"].as_str().context("a path")?);
            ensure!(run["outcome"] == "success" && log.with_extension("html").is_file(), "{run}");
        }
    }
    // Both arms were under way at once: together is shorter than the sum of what each took in it.
    let sum: f64 = ways[1]["runs"].as_array().into_iter().flatten().filter_map(|run| run["makespan_s"].as_f64()).sum();
    ensure!(document["together_s"].as_f64().is_some_and(|together| together < sum), "{document}");
    place.wait_until_empty()
}

#[test]
fn what_does_not_go_with_two_robots_is_refused_before_anything_starts() -> anyhow::Result<()> {
    let place = Place::new()?;
    for (more, why) in [
        (&["--robot", "panda"][..], "made for the built-in robot `twin`"),
        (&["--boxes", "4"], "each arm has places for 3 boxes, not for 4"),
        (&["--scenario", "table"], "use `--scenario boxes`"),
        (&["--fault", "grasp_slips:1"], "leave out --fault"),
    ] {
        let output = place.ratn(&[&["demo", "--robots", "2"][..], more].concat()).output()?;
        let (_, said) = support::texts(&output);
        ensure!(output.status.code() == Some(2) && said.contains(why), "{more:?}: {:?}\n{said}", output.status);
    }
    place.wait_until_empty()
}

#[test]
fn nothing_is_left_of_a_demo_that_is_killed() -> anyhow::Result<()> {
    let place = Place::new()?;
    let out = place.path().join("out");
    let demo = place.start(&["demo", "--boxes", "1", "--speed", "4", "--out", out.to_str().context("a path")?])?;
    // Four roles, two planners and a detector, and the demo itself, which names the place by its output folder.
    wait_for("the whole system", || Ok((place.processes().len() >= 8).then_some(()))).with_context(|| demo.said())?;
    demo.process()?.kill()?;
    drop(demo);
    place.wait_until_empty()
}

#[test]
fn a_demo_that_is_interrupted_ends_in_order() -> anyhow::Result<()> {
    let place = Place::new()?;
    let out = place.path().join("out");
    let mut demo = place.start(&["demo", "--boxes", "1", "--speed", "4", "--out", out.to_str().context("a path")?])?;
    wait_for("the first node", || Ok(demo.said().contains("start ").then_some(()))).with_context(|| demo.said())?;
    demo.signal(nix::sys::signal::Signal::SIGINT)?;
    let (code, _, said) = demo.finish()?;
    ensure!(code == Some(1) && said.contains("interrupted"), "{code:?}\n{said}");
    let left = place.processes();
    ensure!(left.is_empty(), "{left:?}");
    Ok(())
}
