//! `ratn up` and `ratn run` on it.

mod support;

use anyhow::{Context, ensure};
use std::fs::File;
use std::process::Stdio;
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

/// A program that starts a system of its own may be killed: the pipe ends then, and nothing outlives it.
#[test]
fn a_system_ends_with_its_parent_when_it_is_told_to() -> anyhow::Result<()> {
    let place = Place::new()?;
    let (directory, said) = (place.path().join("run"), place.path().join("up.log"));
    let directory = directory.to_str().context("a path")?;
    let mut up = place
        .ratn(&["up", "--exit-with-parent", "--runtime-dir", directory, "--speed", "20", "--boxes", "1"])
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(File::create(&said)?)
        .spawn()?;
    wait_for("the system", || Ok(std::fs::read_to_string(&said)?.contains("is ready").then_some(())))?;
    ensure!(place.processes().len() > 3, "{:?}", place.processes());
    drop(up.stdin.take());
    wait_for("its end", || Ok(up.try_wait()?))?;
    place.wait_until_empty()
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

    // What is asked of facts that nobody wrote is told, and what is shown can be pasted into a task.
    let (none, err) = support::texts(&place.ratn(&["world", "query", "shap(?x)"]).output()?);
    ensure!(err.contains("no fact of this world is about `shap`: did you mean `shape`?"), "{none}{err}");
    let (world, err) = support::texts(&place.ratn(&["world", "facts", "--task"]).output()?);
    let pasted = place.path().join("pasted.yaml");
    std::fs::write(&pasted, format!("task: pasted\n{world}states: []\n"))?;
    let output = place.ratn(&["check", "--no-simulation", pasted.to_str().context("a path")?]).output()?;
    ensure!(output.status.success() && world.contains("shape(box_1)"), "{world}{err}{}", support::texts(&output).1);
    let (status, err) = support::texts(&place.ratn(&["status"]).output()?);
    ensure!(status.contains("no run is under way") && status.contains("free: "), "{status}{err}");

    // Once more, on a table like the first, of which nothing is known.
    let output = place.ratn(&["reset"]).output()?;
    let (out, err) = support::texts(&output);
    ensure!(output.status.success() && out.contains("with 1 box,") && !out.contains(" 0 facts"), "{out}{err}");
    let again = ["run", task, "--set", "boxes=1", "--set", "budget=false"];
    let (out, err) = support::texts(&place.ratn(&again).output()?);
    ensure!(out.contains("delivered = 1") && !err.contains("ratn reset"), "{out}{err}");

    // A task that ends with an outcome of its own is told from one that fails, and what was there before from a new table.
    let own = place.path().join("own.yaml");
    let found_nothing = "task: own\noutcomes: [nothing_found]\nstates:\n  - look: { states: [], transitions: { success: nothing_found } }\n";
    std::fs::write(&own, found_nothing)?;
    let output = place.ratn(&["run", own.to_str().context("a path")?]).output()?;
    let err = support::texts(&output).1;
    ensure!(output.status.code() == Some(4) && err.contains("nothing_found, an outcome of its own"), "{err}");
    ensure!(err.contains("`ratn reset` lays a new table"), "{err}");

    // One that waits for what nobody has.
    let waits = place.path().join("waits.yaml");
    std::fs::write(&waits, WAITS)?;
    let waits = waits.to_str().context("a path")?;
    let mut first = place.start_as("first", &["run", waits])?;
    wait_for("the first run", || {
        let list = support::texts(&place.ratn(&["resource", "list", "Run"]).output()?).0;
        Ok(list.contains("run-").then_some(()))
    })
    .with_context(|| first.said())?;
    // It is told by the names of its states what runs and what waits, also of who holds something.
    let (status, err) = wait_for("what waits", || {
        let told = support::texts(&place.ratn(&["status"]).output()?);
        Ok(told.0.contains("wait: want  ").then_some(told))
    })?;
    ensure!(
        status.starts_with("wait in CDTN mode") && status.contains("Token") && !status.contains('\x1b'),
        "{status}{err}"
    );
    let output = place.ratn(&["control", "pause"]).output()?;
    let (said, err) = support::texts(&output);
    ensure!(output.status.success() && said.starts_with("wait is paused"), "{said}{err}");
    let json = support::texts(&place.ratn(&["status", "--json"]).output()?).0;
    let json: serde_json::Value = serde_json::from_str(&json)?;
    ensure!(json["runs"][0]["paused"] == true && json["waiting"][0]["holder"] == "wait: want", "{json}");

    // One that is to go alone is refused and leaves no log; others go beside it, and who means one of them says which.
    let second = place.path().join("second.jsonl");
    let output = place.ratn(&["run", waits, "--alone", "--log", second.to_str().context("a path")?]).output()?;
    let err = support::texts(&output).1;
    ensure!(
        output.status.code() == Some(2) && err.contains("another run is under way on this system (`wait`)"),
        "{err}"
    );
    ensure!(!second.exists());
    let output = place.ratn(&["run", own.to_str().context("a path")?]).output()?;
    ensure!(output.status.code() == Some(4), "{}", support::texts(&output).1);
    let mut other = place.start_as("other", &["run", waits])?;
    let json = wait_for("two runs", || {
        let json = support::texts(&place.ratn(&["status", "--json"]).output()?).0;
        let json: serde_json::Value = serde_json::from_str(&json)?;
        let both = json["runs"].as_array().is_some_and(|runs| runs.len() == 2);
        Ok((both && json["waiting"].as_array().is_some_and(|waiting| waiting.len() == 2)).then_some(json))
    })?;
    let ids: Vec<&str> = json["runs"].as_array().into_iter().flatten().filter_map(|run| run["run"].as_str()).collect();
    for which in [&["control", "resume"][..], &["control", "resume", "--run", "wait"], &["control", "break", "want"]] {
        let output = place.ratn(which).output()?;
        let err = support::texts(&output).1;
        ensure!(!output.status.success() && err.contains("2 runs are under way") && err.contains(ids[1]), "{err}");
    }
    let output = place.ratn(&["control", "abort", "--run", ids[1]]).output()?;
    ensure!(output.status.success(), "{}", support::texts(&output).1);
    let (code, _, said) = other.finish()?;
    ensure!(code == Some(1) && said.contains("the user asked for it"), "{code:?}\n{said}");
    ensure!(first.child.try_wait()?.is_none(), "{}", first.said());
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

#[test]
fn a_system_of_another_user_is_told_as_such() -> anyhow::Result<()> {
    use std::os::unix::fs::PermissionsExt;
    use std::os::unix::process::CommandExt;
    if !nix::unistd::geteuid().is_root() {
        eprintln!("skipped: only root runs a command as somebody else");
        return Ok(());
    }
    const NOBODY: u32 = 65_534;
    let place = Place::new()?;
    std::fs::set_permissions(place.path(), PermissionsExt::from_mode(0o755))?;
    let directory = place.path().join("theirs");
    std::fs::create_dir(&directory)?;
    std::fs::write(directory.join("resource-manager.endpoint"), "unix:/nowhere\n")?;
    std::fs::set_permissions(&directory, PermissionsExt::from_mode(0o700))?;
    let directory = directory.to_str().context("a path")?;
    for command in [["ps"].as_slice(), &["status"], &["resource", "list"], &["up"], &["control", "pause"], &["stop"]] {
        let output = place.ratn(&[command, &["--runtime-dir", directory]].concat()).uid(NOBODY).gid(NOBODY).output()?;
        let err = support::texts(&output).1;
        ensure!(output.status.code() == Some(2), "{command:?}: {err}");
        ensure!(err.contains("permission denied") && err.contains("belongs to uid 0, and you are uid 65534"), "{err}");
    }
    let doctor = place.ratn(&["doctor", "--runtime-dir", directory]).uid(NOBODY).gid(NOBODY).output()?;
    let (out, err) = support::texts(&doctor);
    ensure!(out.contains("belongs to uid 0") && !out.contains("remove the file"), "{out}{err}");
    Ok(())
}
