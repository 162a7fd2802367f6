//! What is refused is refused before anything is started, with exit code 2 and the place of the mistake.

mod support;

use anyhow::{Context, ensure};
use support::{Place, repository, texts};

#[test]
fn check_refuses_every_bad_task_for_its_rule() -> anyhow::Result<()> {
    let place = Place::new()?;
    let mut seen = 0;
    for entry in std::fs::read_dir(repository("tests/bad-tasks"))? {
        let file = entry?.path();
        let text = std::fs::read_to_string(&file)?;
        let first = text.lines().next().context("an empty task")?;
        let file = file.to_str().context("a path")?;
        let output = place.ratn(&["check", file]).output()?;
        let (out, err) = texts(&output);
        if let Some(rule) = first.strip_prefix("# warning: ") {
            ensure!(output.status.success() && err.contains(&format!("warning[{rule}]")), "{file}: {err}");
            continue;
        }
        let rule = first.strip_prefix("# rule: ").context("no rule is named")?;
        ensure!(output.status.code() == Some(2), "{file}: {:?}, {err}", output.status);
        ensure!(out.is_empty(), "{file}: {out}");
        let place_and_rule = err.lines().any(|line| line.starts_with(file) && line.contains(&format!("error[{rule}]")));
        ensure!(place_and_rule, "{file}: {err}");
        let help = text.lines().nth(1).and_then(|line| line.strip_prefix("# help: ")).unwrap_or_default();
        ensure!(err.contains(help), "{file}: {err}");
        seen += 1;
    }
    ensure!(seen >= 25, "only {seen} bad tasks");
    Ok(())
}

#[test]
fn run_refuses_a_bad_task_and_starts_nothing() -> anyhow::Result<()> {
    let place = Place::new()?;
    let task = repository("tests/bad-tasks/unknown-port.yaml");
    let task = task.to_str().context("a path")?;
    // Why it is refused is no progress.
    for words in [vec!["run", task], vec!["run", "--quiet", task]] {
        let output = place.ratn(&words).output()?;
        let (out, err) = texts(&output);
        ensure!(output.status.code() == Some(2), "{:?}, {err}", output.status);
        ensure!(out.is_empty() && err.contains("error[unknown-port]"), "{words:?}: {out}{err}");
    }
    let left = std::fs::read_dir(place.path())?.count();
    ensure!(left == 0 && place.processes().is_empty(), "{left} files, {:?}", place.processes());
    Ok(())
}

#[test]
fn a_parameter_that_the_task_does_not_have_is_refused() -> anyhow::Result<()> {
    let place = Place::new()?;
    let task = repository("examples/fetch_boxes.yaml");
    for setting in ["boxs=2", "boxes=many"] {
        let output = place.ratn(&["run", task.to_str().context("a path")?, "--set", setting]).output()?;
        let (_, err) = texts(&output);
        ensure!(output.status.code() == Some(2) && err.contains("error[invalid-parameter]"), "{err}");
    }
    ensure!(std::fs::read_dir(place.path())?.count() == 0);
    Ok(())
}

#[test]
fn a_bad_config_is_refused_by_every_role() -> anyhow::Result<()> {
    let place = Place::new()?;
    let config = place.path().join("ratn.toml");
    std::fs::write(&config, "speed = 2\n[cell]\nboxs = 3\n")?;
    let config = config.to_str().context("a path")?;
    for role in ["resource-manager", "world-pool", "process-manager", "cell"] {
        let output = place.ratn(&[role, "--config", config, "--check-config"]).output()?;
        let (_, err) = texts(&output);
        ensure!(output.status.code() == Some(2) && err.contains("line 3") && err.contains("boxs"), "{role}: {err}");
        let output = place.ratn(&[role, "--check-config"]).output()?;
        ensure!(output.status.success(), "{role}: {}", texts(&output).1);
    }
    Ok(())
}

#[test]
fn an_address_that_is_none_is_refused_for_every_role() -> anyhow::Result<()> {
    let place = Place::new()?;
    let config = place.path().join("ratn.toml");
    let file = config.to_str().context("a path")?;
    for role in ["resource-manager", "world-pool", "process-manager", "cell"] {
        for key in ["listen", "resource_manager"] {
            std::fs::write(&config, format!("[{role}]\n{key} = \"nonsense\"\n"))?;
            let output = place.ratn(&["cell", "--config", file, "--check-config"]).output()?;
            let (_, err) = texts(&output);
            ensure!(output.status.code() == Some(2) && err.contains("line 2"), "{role} {key}: {err}");
        }
    }
    Ok(())
}

#[test]
fn a_run_on_a_system_that_is_not_there_is_refused() -> anyhow::Result<()> {
    let place = Place::new()?;
    let task = repository("examples/fetch_boxes.yaml");
    let directory = place.path().join("nothing");
    let directory = directory.to_str().context("a path")?;
    let output = place.ratn(&["run", task.to_str().context("a path")?, "--runtime-dir", directory]).output()?;
    let (_, err) = texts(&output);
    ensure!(output.status.code() == Some(2) && err.contains("ratn up --runtime-dir"), "{err}");
    ensure!(std::fs::read_dir(place.path())?.count() == 0);
    Ok(())
}

#[test]
fn a_log_or_a_chart_that_cannot_be_written_is_refused_before_the_run() -> anyhow::Result<()> {
    let place = Place::new()?;
    let task = repository("examples/fetch_boxes.yaml");
    let task = task.to_str().context("a path")?;
    for (option, file) in
        [("--log", "/nonex/x.jsonl"), ("--log", "/"), ("--gantt", "/nonex/x.svg"), ("--gantt", "x.png")]
    {
        let output = place.ratn(&["run", task, option, file]).output()?;
        let (_, err) = texts(&output);
        ensure!(output.status.code() == Some(2) && err.contains(file), "{option} {file}: {err}");
    }
    ensure!(std::fs::read_dir(place.path())?.count() == 0);
    Ok(())
}

#[test]
fn a_log_takes_the_place_of_nothing() -> anyhow::Result<()> {
    let place = Place::new()?;
    let (task, mine) = (repository("examples/fetch_boxes.yaml"), place.path().join("README.md"));
    std::fs::write(&mine, "mine")?;
    let (task, file) = (task.to_str().context("a path")?, mine.to_str().context("a path")?);
    let output = place.ratn(&["run", task, "--log", file]).output()?;
    let (_, err) = texts(&output);
    ensure!(output.status.code() == Some(2) && err.contains(file) && err.contains("--resume"), "{err}");
    ensure!(std::fs::read_to_string(&mine)? == "mine");
    // And says what the system says of one that is not there.
    for (arguments, reason) in [
        (&["run", "--resume", "/nonex/log.jsonl"][..], "No such file"),
        (&["control", "pause"], "no run is under way"),
        (&["signal", "-", "go", "3"], "no run is under way"),
        (&["signal", "-", "go", "two words"], "quote a text twice"),
        (&["answer", "-", "later"], "no run is under way"),
    ] {
        let (_, err) = texts(&place.ratn(arguments).output()?);
        ensure!(err.contains(reason), "{arguments:?}: {err}");
    }
    Ok(())
}

#[test]
fn what_cannot_be_resumed_is_refused() -> anyhow::Result<()> {
    let place = Place::new()?;
    let fixture = repository("crates/report/src/fixtures/two_boxes.jsonl");
    let (fixture, task) = (fixture.to_str().context("a path")?, repository("examples/fetch_boxes.yaml"));
    let task = task.to_str().context("a path")?;
    for (arguments, reason) in [
        (vec!["run", "--resume", "/nonex/log.jsonl"], "/nonex/log.jsonl"),
        (vec!["run", "--resume", fixture], "does not name its task file"),
        (vec!["run", "--resume", fixture, task], "no system runs in"),
        (vec!["run", "--resume", fixture, "--mode", "hsm"], "cannot be used with"),
        (vec!["run", task, "--learn", fixture], "not of the task `fetch_boxes`"),
    ] {
        let output = place.ratn(&arguments).output()?;
        let (out, err) = texts(&output);
        ensure!(output.status.code() == Some(2) && err.contains(reason), "{arguments:?}: {out}{err}");
    }
    ensure!(std::fs::read_dir(place.path())?.count() == 0);
    Ok(())
}

#[test]
fn what_is_no_file_is_refused() -> anyhow::Result<()> {
    let place = Place::new()?;
    for arguments in [&["check", "/dev/zero"][..], &["run", "/dev/zero"], &["cell", "--config", "/dev/zero"]] {
        let output = place.ratn(arguments).output()?;
        let (_, err) = texts(&output);
        ensure!(output.status.code() == Some(2) && err.contains("not a regular file"), "{arguments:?}: {err}");
    }
    Ok(())
}

#[test]
fn what_the_command_line_cannot_mean_is_refused() -> anyhow::Result<()> {
    let place = Place::new()?;
    for arguments in [&["demo", "--boxes", "10"][..], &["demo", "--speed", "0"], &["run"], &["fly"]] {
        let output = place.ratn(arguments).output()?;
        ensure!(output.status.code() == Some(2), "{arguments:?}: {:?}", output.status);
    }
    Ok(())
}

#[test]
fn a_worker_that_is_not_told_enough_is_refused_and_what_is_missing_named() -> anyhow::Result<()> {
    let place = Place::new()?;
    for (arguments, missing) in [
        (&["worker", "path-planner"][..], "--id"),
        (&["worker", "path-planner", "--id", ""], "--id"),
        (&["worker", "path-planner", "--resource-manager", "127.0.0.1:1"], "--id"),
        (&["worker", "detector", "--id", "d1"], "--resource-manager"),
        (&["worker", "--id", "d1"], "<WORKER>"),
    ] {
        let output = place.ratn(arguments).env_remove("RATN_RESOURCE_MANAGER").output()?;
        let (_, err) = texts(&output);
        ensure!(output.status.code() == Some(2) && err.contains(missing), "{arguments:?}: {:?}, {err}", output.status);
    }
    let output = place.ratn(&["worker", "detector", "--id", "d1"]).env("RATN_RESOURCE_MANAGER", "nowhere").output()?;
    let (_, err) = texts(&output);
    ensure!(output.status.code() == Some(2) && err.contains("RATN_RESOURCE_MANAGER"), "{:?}, {err}", output.status);
    Ok(())
}

#[test]
fn a_daemon_that_may_not_listen_or_has_no_state_of_its_own_is_refused() -> anyhow::Result<()> {
    let place = Place::new()?;
    let refused = |arguments: &[&str], why: &str| {
        let output = place.ratn(arguments).output()?;
        let (_, err) = texts(&output);
        ensure!(output.status.code() == Some(2) && err.contains(why), "{arguments:?}: {:?}, {err}", output.status);
        Ok(())
    };
    for role in ["resource-manager", "process-manager", "cell"] {
        refused(&[role, "--listen", "0.0.0.0:0"], "has no TLS")?;
    }
    let deep = place.path().join("x".repeat(120));
    for role in ["resource-manager", "world-pool", "process-manager", "cell"] {
        refused(&[role, "--runtime-dir", deep.to_str().context("a path")?], "is too deep")?;
        ensure!(!deep.exists(), "{role} made {}", deep.display());
    }
    let worker = ["worker", "detector", "--id", "d1", "--resource-manager", "http://127.0.0.1:1"];
    refused(&[worker.as_slice(), &["--listen", "0.0.0.0:0"]].concat(), "has no TLS")?;
    let config = place.path().join("ratn.toml");
    std::fs::write(&config, "[service.tls]\ncert = \"/no/a.pem\"\nkey = \"/no/a.key\"\nclient_ca = \"/no/ca.pem\"\n")?;
    let config = config.to_str().context("a path")?;
    refused(&["world-pool", "--config", config], "cannot read the TLS file")?;
    refused(&["cell", "--metrics", "0.0.0.0:0"], "--insecure")?;
    let state = place.path().join("state");
    let state = state.to_str().context("a path")?;
    let _first = place.start(&["resource-manager", "--state-dir", state])?;
    let endpoint = place.path().join("run/resource-manager.endpoint");
    support::wait_for("the first manager", || Ok(endpoint.exists().then_some(())))?;
    let elsewhere = place.path().join("run2");
    let elsewhere = elsewhere.to_str().context("a path")?;
    refused(&["resource-manager", "--state-dir", state, "--runtime-dir", elsewhere], "has a writer already")
}
