//! `ratn up` and `ratn run` on it.

mod support;

use anyhow::{Context, ensure};
use support::{Place, repository, wait_for};

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

    // A second system in the same place is refused.
    let output = place.ratn(&["up", "--runtime-dir", directory]).output()?;
    ensure!(output.status.code() == Some(2), "{}", support::texts(&output).1);

    up.signal(nix::sys::signal::Signal::SIGTERM)?;
    let (code, _, said) = up.finish()?;
    ensure!(code == Some(0), "{code:?}\n{said}");
    let left = place.processes();
    ensure!(left.is_empty(), "{left:?}");
    Ok(())
}
