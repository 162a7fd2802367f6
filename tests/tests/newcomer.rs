//! What somebody meets who begins: a task and a worker of their own, and a worker that is otherwise than the catalogue says.

mod support;

use anyhow::{Context, ensure};
use std::path::Path;
use std::process::Command;
use support::{Place, repository, texts, wait_for};

/// A detector is offered as a planner, and nobody offers what the catalogue has as a label reader.
const SYSTEM: &str = r#"
speed = 20.0
catalogues = ["built-in"]
[catalogue.resources.LabelReader]
class = "process"
count = 1
[process-manager]
host = "compute"
[[process-manager.template]]
name = "mistaken"
kind = "PathPlanner"
args = ["worker", "detector", "--id", "{id}", "--kind", "{kind}", "--endpoint-file", "{endpoint_file}", "--exit-with-parent"]
min = 1
"#;
const TASK: &str =
    "task: read\nstates:\n  - read: { action: gripper/release, resources: [Gripper, { block: LabelReader }] }\n";
const MISMATCH: &str = "the catalogue has `path_planner/plan`, and the worker performs ";
const LACKING: &str = "nobody offers a `LabelReader`, which `read` asks for";

fn text(path: &Path) -> anyhow::Result<&str> {
    path.to_str().context("a path")
}

#[test]
fn a_worker_that_the_catalogue_does_not_know_so_is_told_at_its_start_and_what_nobody_offers_before_it_is_waited_for()
-> anyhow::Result<()> {
    let place = Place::new()?;
    let (config, task) = (place.path().join("system.toml"), place.path().join("task.yaml"));
    std::fs::write(&config, SYSTEM)?;
    std::fs::write(&task, TASK)?;
    let directory = place.path().join("run");
    let mut up = place.start_as("up", &["up", "--config", text(&config)?, "--runtime-dir", text(&directory)?])?;
    wait_for("the system", || Ok(up.said().contains("is ready").then_some(()))).with_context(|| up.said())?;

    let log = directory.join("process-manager.log");
    wait_for("the mismatch in the log", || Ok(std::fs::read_to_string(&log)?.contains(MISMATCH).then_some(())))?;
    let (out, err) = texts(&place.ratn(&["ps"]).output()?);
    ensure!(out.contains(&format!("mistaken-1@compute: {MISMATCH}")), "{out}{err}");
    let checked = place.ratn(&["check", text(&task)?, "--runtime-dir", text(&directory)?]).output()?;
    let (out, err) = texts(&checked);
    ensure!(err.contains(MISMATCH) && err.contains(LACKING), "{out}{err}");
    let scaled = place.ratn(&["pool", "scale", "mistaken", "--max", "1"]).output()?;
    let (out, err) = texts(&scaled);
    ensure!(out.starts_with("mistaken: 1 to 1"), "{out}{err}");
    ensure!(err.contains(&format!("warning: mistaken-1@compute: {MISMATCH}")), "{out}{err}");
    let other = ["check", text(&task)?, "--robot", "panda", "--runtime-dir", text(&directory)?];
    let refused = place.ratn(&other).output()?;
    let (out, err) = texts(&refused);
    ensure!(refused.status.code() == Some(2) && err.contains("'--robot <ROBOT>' cannot be used with"), "{out}{err}");

    let mut run = place.start_as("run", &["run", text(&task)?, "--runtime-dir", text(&directory)?])?;
    wait_for("what nobody offers", || Ok(run.said().contains(LACKING).then_some(()))).with_context(|| run.said())?;
    run.signal(nix::sys::signal::Signal::SIGINT)?;
    run.finish()?;
    up.signal(nix::sys::signal::Signal::SIGINT)?;
    up.finish()?;
    Ok(())
}

/// A label reader that is started and never serves.
const NEVER_READY: &str = r#"
catalogues = ["built-in"]
[catalogue.resources.LabelReader]
class = "process"
count = 1
[process-manager]
host = "compute"
[[process-manager.template]]
name = "label"
kind = "LabelReader"
program = "/bin/sleep"
args = ["600"]
min = 0
max = 1
start_timeout_s = 0.5
crash_limit = 1000
"#;

#[test]
fn a_run_that_waits_for_a_worker_which_never_becomes_ready_says_why_in_its_line() -> anyhow::Result<()> {
    let place = Place::new()?;
    let (config, task) = (place.path().join("system.toml"), place.path().join("task.yaml"));
    std::fs::write(&config, NEVER_READY)?;
    std::fs::write(&task, TASK)?;
    let mut run = place.start_as("run", &["run", text(&task)?, "--config", text(&config)?])?;
    let why = "@compute: not ready within 0.5 s: its endpoint file label-";
    let line = wait_for("the reason", || {
        let said = run.said();
        Ok(said.lines().find(|line| line.contains(why)).map(str::to_owned))
    })
    .with_context(|| run.said())?;
    ensure!(line.contains("read") && line.contains("LabelReader"), "{line}");
    run.signal(nix::sys::signal::Signal::SIGINT)?;
    run.finish()?;
    Ok(())
}

/// A label reader that ends as soon as it is started.
fn crashes(crash_limit: u32) -> String {
    let crash = "program = \"/bin/sh\"\nargs = [\"-c\", \"echo there is no model; exit 3\"]\nmin = 1";
    let once = NEVER_READY.replace("program = \"/bin/sleep\"\nargs = [\"600\"]\nmin = 0", crash);
    once.replace("crash_limit = 1000", &format!("crash_limit = {crash_limit}"))
}

#[test]
fn a_system_says_at_once_why_its_worker_crashes_and_is_not_waited_for_when_its_pool_has_given_up() -> anyhow::Result<()>
{
    let place = Place::new()?;
    let (config, directory) = (place.path().join("system.toml"), place.path().join("run"));
    let arguments = ["up", "--config", text(&config)?, "--runtime-dir", text(&directory)?];
    std::fs::write(&config, crashes(1000))?;
    let mut up = place.start_as("again", &arguments)?;
    let why = "@compute: exited with status 3; its last words: there is no model";
    let first = "a worker of `label` has crashed and is started again: label-";
    let line = wait_for("the first crash", || {
        let said = up.said();
        Ok(said.lines().find(|line| line.contains(first)).map(str::to_owned))
    })
    .with_context(|| up.said())?;
    ensure!(line.contains(why), "{line}");
    up.signal(nix::sys::signal::Signal::SIGINT)?;
    up.finish()?;

    std::fs::write(&config, crashes(3))?;
    let ended = place.ratn(&arguments).output()?;
    let (out, err) = texts(&ended);
    ensure!(ended.status.code() == Some(1), "{out}{err}");
    ensure!(err.contains("the system cannot be started: `label` crash-loops: 3 crashes in a row; label-"), "{err}");
    ensure!(err.contains(why) && err.contains(text(&directory.join("logs"))?) && !err.contains("not ready"), "{err}");
    place.wait_until_empty()
}

#[test]
fn the_demo_refuses_a_robot_of_ones_own_that_cannot_do_it_before_anything_is_started() -> anyhow::Result<()> {
    let place = Place::new()?;
    for file in ["panda.urdf", "panda.srdf", "panda.toml"] {
        std::fs::copy(repository("crates/motion/robots").join(file), place.path().join(file))?;
    }
    let robot = place.path().join("panda.toml");
    let whole = std::fs::read_to_string(&robot)?;
    let bare = whole.split("[workplace]").next().context("a text")?;
    for (described, boxes, why) in
        [(bare, "1", "it has no [workplace]: add one"), (&whole, "7", "its [workplace] has 6 places: ask for so many")]
    {
        std::fs::write(&robot, described)?;
        let refused = place.ratn(&["demo", "--robot", text(&robot)?, "--boxes", boxes]).output()?;
        let (out, err) = texts(&refused);
        ensure!(refused.status.code() == Some(2) && err.contains(why), "{out}{err}");
        ensure!(err.contains(&format!("--robot {}", robot.display())), "{err}");
    }
    place.wait_until_empty()
}

#[test]
fn a_new_task_is_good_and_nothing_is_overwritten() -> anyhow::Result<()> {
    let place = Place::new()?;
    let ratn = |arguments: &[&str]| place.ratn(arguments).current_dir(place.path()).output();
    let made = ratn(&["new", "task", "first-steps"])?;
    ensure!(made.status.success(), "{:?}", texts(&made));
    let checked = ratn(&["check", "first-steps.yaml"])?;
    ensure!(checked.status.success() && !texts(&checked).1.contains("warning"), "{:?}", texts(&checked));
    for again in [["new", "task", "first-steps"], ["new", "worker", "../up"]] {
        let refused = ratn(&again)?;
        ensure!(refused.status.code() == Some(2), "{:?}", texts(&refused));
    }

    let (one, err) = texts(&ratn(&["actions", "pan_tilt/look_at"])?);
    ensure!(one.starts_with("pan_tilt/look_at (built in; a state that uses it blocks PanTilt)"), "{one}{err}");
    ensure!(one.contains("in        target: pose") && one.contains("out       pan: float, tilt: float"), "{one}");
    let unknown = ratn(&["actions", "arms"])?;
    ensure!(unknown.status.code() == Some(2) && texts(&unknown).1.contains("arm/follow"), "{:?}", texts(&unknown));
    Ok(())
}

#[test]
#[ignore = "builds a crate: scripts/check-newcomer"]
fn a_new_worker_builds_passes_its_test_and_does_its_task() -> anyhow::Result<()> {
    let place = Place::new()?;
    let sdk = repository("crates/worker");
    let made = place.ratn(&["new", "worker", "pose-meter", "--sdk", text(&sdk)?]).current_dir(place.path()).output()?;
    ensure!(made.status.success(), "{:?}", texts(&made));
    let here = place.path().join("pose-meter");
    // The versions that are there already.
    std::fs::copy(repository("Cargo.lock"), here.join("Cargo.lock"))?;
    let target = std::env::var_os("CARGO_TARGET_DIR").context("scripts/check-newcomer says CARGO_TARGET_DIR")?;
    for verb in ["test", "build"] {
        let built = Command::new("cargo").args([verb, "--offline"]).current_dir(&here).output()?;
        ensure!(built.status.success(), "cargo {verb}: {:?}", texts(&built));
    }
    std::fs::create_dir_all(here.join("target/debug"))?;
    std::fs::copy(Path::new(&target).join("debug/pose-meter"), here.join("target/debug/pose-meter"))?;
    for (arguments, said) in [
        (["check", "task.yaml", "--config", "system.toml"], "is good"),
        (["run", "task.yaml", "--config", "system.toml"], "distance_m = 5"),
    ] {
        let done = place.ratn(&arguments).current_dir(&here).output()?;
        let (out, err) = texts(&done);
        ensure!(done.status.success() && format!("{out}{err}").contains(said), "{arguments:?}: {out}{err}");
        ensure!(!err.contains("warning"), "{err}");
    }
    Ok(())
}
