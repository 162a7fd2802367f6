//! `ratn up` and `ratn run` on it.

mod support;

use anyhow::{Context, ensure};
use support::{Place, repository, wait_for};

/// A task that waits for what never comes.
const WAITS: &str = r#"task: wait
states:
  - make: { action: gripper/release, resources: [Gripper, { create: Token, class: task, with: { who: alice } }] }
  - want: { action: gripper/release, resources: [Gripper, { consume: Token, where: { who: bob } }] }
"#;

#[test]
fn a_run_that_waits_for_what_never_comes_says_so_and_why() -> anyhow::Result<()> {
    let place = Place::new()?;
    let task = place.path().join("wait.yaml");
    std::fs::write(&task, WAITS)?;
    let log = place.path().join("log.jsonl");
    let arguments = ["run", task.to_str().context("a path")?, "--log", log.to_str().context("a path")?];
    let mut run = place.start(&arguments)?;
    wait_for("what it waits for", || {
        let said = run.said();
        Ok(said.lines().any(|line| line.contains("waits  want  for") && line.contains("Token")).then_some(()))
    })
    .with_context(|| run.said())?;
    run.signal(nix::sys::signal::Signal::SIGINT)?;
    let (code, _, said) = run.finish()?;
    ensure!(code == Some(1), "{code:?}\n{said}");
    Ok(())
}

#[test]
fn a_task_runs_on_the_system_that_is_up_and_leaves_it_running() -> anyhow::Result<()> {
    let place = Place::new()?;
    let directory = place.path().join("run");
    let directory = directory.to_str().context("a path")?;
    let mut up = place.start(&["up", "--runtime-dir", directory, "--speed", "20", "--boxes", "1"])?;
    wait_for("the system", || Ok(up.said().contains("is ready").then_some(()))).with_context(|| up.said())?;
    let before = place.processes().len();

    let task = repository("examples/fetch_boxes.yaml");
    let task = task.to_str().context("a path")?;
    let log = place.path().join("log.jsonl");
    let arguments =
        ["run", task, "--set", "boxes=1", "--set", "budget=false", "--log", log.to_str().context("a path")?];
    let output = place.ratn(&arguments).output()?;
    let (out, err) = support::texts(&output);
    ensure!(output.status.success(), "{err}");
    ensure!(out.contains("delivered = 1"), "{out}");
    ensure!(place.processes().len() == before, "{:?}", place.processes());

    // What the detector measured says how sure it was.
    let (facts, err) = support::texts(&place.ratn(&["world", "facts", "shape(box_1)"]).output()?);
    ensure!(facts.contains("(confidence 0.") || facts.contains("(confidence 1)"), "{facts}{err}");
    ensure!(std::fs::read_to_string(&log)?.contains("\"covariance\""), "no covariance in the log");

    // Once more, on a table like the first, of which nothing is known.
    let output = place.ratn(&["reset"]).output()?;
    let (out, err) = support::texts(&output);
    ensure!(output.status.success() && out.contains("1 boxes") && !out.contains(" 0 facts"), "{out}{err}");
    let again = ["run", task, "--set", "boxes=1", "--set", "budget=false"];
    let (out, err) = support::texts(&place.ratn(&again).output()?);
    ensure!(out.contains("delivered = 1"), "{out}{err}");

    // One run at a time: a second is refused and leaves no log.
    let waits = place.path().join("waits.yaml");
    std::fs::write(&waits, WAITS)?;
    let waits = waits.to_str().context("a path")?;
    let mut first = place.start_as("first", &["run", waits])?;
    wait_for("the first run", || {
        let list = place.ratn(&["resource", "get", "run"]).output()?;
        Ok(list.status.success().then_some(()))
    })
    .with_context(|| first.said())?;
    let second = place.path().join("second.jsonl");
    let output = place.ratn(&["run", waits, "--log", second.to_str().context("a path")?]).output()?;
    let err = support::texts(&output).1;
    ensure!(output.status.code() == Some(2) && err.contains("another run is under way") && !second.exists(), "{err}");
    first.signal(nix::sys::signal::Signal::SIGINT)?;
    first.finish()?;

    // A second system in the same place is refused, and one in what is no folder.
    let output = place.ratn(&["up", "--runtime-dir", waits]).output()?;
    ensure!(output.status.code() == Some(2), "{}", support::texts(&output).1);
    let output = place.ratn(&["up", "--runtime-dir", directory]).output()?;
    ensure!(output.status.code() == Some(2), "{}", support::texts(&output).1);

    up.signal(nix::sys::signal::Signal::SIGTERM)?;
    let (code, _, said) = up.finish()?;
    ensure!(code == Some(0), "{code:?}\n{said}");
    let left = place.processes();
    ensure!(left.is_empty(), "{left:?}");
    Ok(())
}
