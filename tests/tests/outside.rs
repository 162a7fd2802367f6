//! The world changes while a task runs: somebody else commits a fact, or one expires. The run goes on, and ends as it does one state
//! after the other.

mod support;

use anyhow::{Context, ensure};
use serde_json::Value;
use support::{Place, Started, texts, wait_for};

/// What the first motion leaves to a test: some seconds.
const SPEED: &str = "2";

/// While the arm moves somewhere, it is known already where it will go next; by then it shall go elsewhere.
const TASK: &str = r#"
task: watched
world: ["goal(arm) = near", "seen(door) = open"]
states:
  - first:
      action: arm/move_to
      in: { joints: "joints(0.9, -1.2, 0, 0.9, 0, -0.6, 0)" }
      pia: true
      reads: []
      effects: ["went(arm) = away"]
      resources: [{ block: Arm }]
  - where:
      condition: CONDITION
      then: [ near: { MOVE, effects: ["went(arm) = near"] } ]
      else: [ far: { MOVE, effects: ["went(arm) = far"] } ]
"#;

/// Back to where the arm was at first.
const MOVE: &str = r#"action: arm/move_to, in: { joints: "joints(-1.57, -0.35, 0, 1.4, 0, -1.39, 0)" }, pia: true, reads: [],
                     resources: [{ block: Arm }]"#;

fn up(place: &Place, more: &[&str]) -> anyhow::Result<Started> {
    let directory = place.path().join("run");
    let directory = directory.to_str().context("a path")?;
    let up = place.start_as("up", &[&["up", "--runtime-dir", directory, "--speed", SPEED], more].concat())?;
    wait_for("the system", || Ok(up.said().contains("is ready").then_some(()))).with_context(|| up.said())?;
    Ok(up)
}

/// Runs the task in a mode; while the arm moves for the first time, `meanwhile` happens. Where the arm went, and the log.
fn run(
    place: &Place,
    condition: &str,
    mode: &str,
    meanwhile: impl FnOnce() -> anyhow::Result<()>,
) -> anyhow::Result<(String, Vec<Value>)> {
    let (task, log) = (place.path().join("task.yaml"), place.path().join(format!("{mode}.jsonl")));
    std::fs::write(&task, TASK.replace("CONDITION", condition).replace("MOVE", MOVE))?;
    let text = |path: &std::path::Path| path.to_str().map(str::to_owned).context("a path");
    let arguments = ["run", &text(&task)?, "--mode", mode, "--log", &text(&log)?];
    let mut run = place.start_as(mode, &arguments)?;
    let lines = || -> Vec<Value> {
        let text = std::fs::read_to_string(&log).unwrap_or_default();
        text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
    };
    wait_for("the first motion", || Ok(lines().iter().any(|line| line["command"] == "start").then_some(())))
        .with_context(|| run.said())?;
    meanwhile()?;
    let (code, _, err) = run.finish()?;
    ensure!(code == Some(0), "{mode}: {err}");
    let (facts, _) = texts(&place.ratn(&["world", "facts", "went(arm)", "--json"]).output()?);
    let facts: Value = serde_json::from_str(&facts)?;
    let went = facts["facts"][0]["value"]["string"].as_str().with_context(|| facts.to_string())?;
    Ok((went.to_owned(), lines()))
}

fn load(place: &Place, fact: &str) -> anyhow::Result<()> {
    let file = place.path().join("facts.json");
    std::fs::write(&file, format!(r#"{{"facts": [{fact}]}}"#))?;
    let output = place.ratn(&["world", "load", file.to_str().context("a path")?]).output()?;
    ensure!(output.status.success(), "{}", texts(&output).1);
    Ok(())
}

#[test]
fn what_others_commit_during_a_run_counts_where_the_program_comes_to_it() -> anyhow::Result<()> {
    let place = Place::new()?;
    let _up = up(&place, &[])?;
    let elsewhere = r#"{"predicate": "goal", "arguments": ["arm"], "value": {"string": "far"}}"#;
    for mode in ["hsm", "cdtn"] {
        let (went, log) = run(&place, "goal(arm) = near", mode, || load(&place, elsewhere))?;
        ensure!(went == "far", "{mode}: {went}");
        let told = log.iter().filter(|line| line["event"] == "world_changed");
        ensure!(told.count() == 1, "{mode}: {log:?}");
        let decisions: Vec<&str> = log.iter().filter_map(|line| line["decision"].as_str()).collect();
        ensure!(mode == "hsm" || decisions == ["then", "else"], "{decisions:?}");
    }
    Ok(())
}

#[test]
fn a_fact_that_expires_during_a_run_is_gone_where_the_program_comes_to_it() -> anyhow::Result<()> {
    let place = Place::new()?;
    let config = place.path().join("ratn.toml");
    std::fs::write(&config, "[world-pool]\nttl_s = { seen = 1.0 }\n")?;
    let _up = up(&place, &["--config", config.to_str().context("a path")?])?;
    for mode in ["hsm", "cdtn"] {
        let (went, log) = run(&place, "exists seen(door)", mode, || Ok(()))?;
        ensure!(went == "far", "{mode}: {went}");
        ensure!(log.iter().any(|line| line["event"] == "world_changed"), "{mode}: {log:?}");
    }
    Ok(())
}

/// Each character of it is six in a log.
#[test]
fn a_run_begins_in_a_world_of_more_than_a_line_of_its_log_holds() -> anyhow::Result<()> {
    let place = Place::new()?;
    let _up = up(&place, &[])?;
    let noise = r"\u0001".repeat(700_000);
    let fact = |n: usize| format!(r#"{{"predicate": "noise", "arguments": [{n}], "value": {{"string": "{noise}"}}}}"#);
    load(&place, &(0..5).map(fact).collect::<Vec<_>>().join(", "))?;
    let (went, log) = run(&place, "goal(arm) = near", "cdtn", || Ok(()))?;
    ensure!(went == "near", "{went}");
    let parts: Vec<u64> = log.iter().map_while(|line| line["part"].as_u64()).collect();
    ensure!(parts.len() > 1 && parts.iter().zip(1..).all(|(part, at)| *part == at), "{parts:?}");
    let log = place.path().join("cdtn.jsonl");
    let (report, error) = texts(&place.ratn(&["report", log.to_str().context("a path")?]).output()?);
    ensure!(report.contains("first") && error.is_empty(), "{report}{error}");
    Ok(())
}
