//! Several runs on one system: they share its gripper and its world, and who dies and comes back loses nothing of the others'.

mod support;

use anyhow::{Context, ensure};
use support::{Place, texts, wait_for};

/// Each turn opens the gripper twice. The second time reads what all runs have done before.
const TASK: &str = r#"task: turns
parameters: { turns: { type: int, default: 6 } }
states:
  - for: turn in range($turns)
    do:
      - open: { action: gripper/release, pia: true, reads: [], effects: ["increase opened() by 1"], resources: [Gripper] }
      - again: { action: gripper/release, pia: true, reads: ["opened()"], requires: ["opened() > 0"], effects: ["last() = opened() + 1", "increase opened() by 1"], resources: [Gripper] }
"#;

#[test]
fn runs_beside_each_other_leave_what_all_of_them_did_also_where_one_is_killed_and_comes_back() -> anyhow::Result<()> {
    let place = Place::new()?;
    let mut up = place.start_as("up", &["up", "--speed", "10", "--boxes", "1"])?;
    wait_for("the system", || Ok(up.said().contains("is ready").then_some(()))).with_context(|| up.said())?;
    let file = place.path().join("turns.yaml");
    std::fs::write(&file, TASK)?;
    let file = file.to_str().context("a path")?;
    let log = |name: &str| place.path().join(format!("{name}.jsonl")).display().to_string();
    let run = |name: &str, mode: &str| place.start_as(name, &["run", file, "--mode", mode, "--log", &log(name)]);
    let (mut first, mut killed, mut third) = (run("first", "cdtn")?, run("killed", "cdtn")?, run("third", "hsm")?);
    let has_opened = |name: &str, times: usize| {
        let text = std::fs::read_to_string(log(name)).unwrap_or_default();
        (text.matches("\"command\":\"commit\"").count() >= times).then_some(())
    };
    wait_for("some turns", || Ok(has_opened("killed", 3))).with_context(|| killed.said())?;
    killed.child.kill()?;
    killed.child.wait()?;
    let mut again = place.start_as("again", &["run", "--resume", &log("killed")])?;
    for one in [&mut first, &mut again, &mut third] {
        let (code, _, said) = one.finish()?;
        ensure!(code == Some(0), "{code:?}\n{said}");
        ensure!(!said.contains("did not tell in time"), "{said}");
    }
    let (facts, err) = texts(&place.ratn(&["world", "facts", "opened()", "last()"]).output()?);
    for fact in ["opened()", "last()"] {
        let told = facts.lines().find(|line| line.starts_with(fact)).unwrap_or_default();
        ensure!(told.split_whitespace().nth(1) == Some("36"), "{facts}{err}");
    }
    up.signal(nix::sys::signal::Signal::SIGTERM)?;
    let (code, _, said) = up.finish()?;
    ensure!(code == Some(0), "{code:?}\n{said}");
    place.wait_until_empty()
}

/// A run that was suspended longer than its session lives comes back to a world in which another one has had its gripper.
#[test]
fn a_run_that_was_suspended_for_too_long_changes_nothing_of_what_came_after_it() -> anyhow::Result<()> {
    let place = Place::new()?;
    let mut up = place.start_as("up", &["up", "--speed", "1", "--boxes", "1"])?;
    wait_for("the system", || Ok(up.said().contains("is ready").then_some(()))).with_context(|| up.said())?;
    let task = |name: &str| -> anyhow::Result<String> {
        let file = place.path().join(format!("{name}.yaml"));
        let effect = format!(r#"effects: ['by() = "{name}"'], resources: [Gripper]"#);
        let text =
            format!("task: {name}\nstates:\n  - open: {{ action: gripper/release, pia: true, reads: [], {effect} }}\n");
        std::fs::write(&file, text)?;
        Ok(file.display().to_string())
    };
    let (first, second, log) = (task("first")?, task("second")?, place.path().join("first.jsonl"));
    let mut suspended = place.start_as("suspended", &["run", &first, "--log", &log.display().to_string()])?;
    wait_for("its motion", || {
        let text = std::fs::read_to_string(&log).unwrap_or_default();
        Ok(text.contains("\"command\":\"start\"").then_some(()))
    })?;
    suspended.signal(nix::sys::signal::Signal::SIGSTOP)?;
    let (code, _, said) = place.start_as("second", &["run", &second])?.finish()?;
    ensure!(code == Some(0), "{code:?}\n{said}");
    suspended.signal(nix::sys::signal::Signal::SIGCONT)?;
    let (code, _, said) = suspended.finish()?;
    // Where its goal had not left yet it leaves now, under a lease that is over: nobody performs it.
    let is_told = said.contains("session") && said.contains("lost") || said.contains("is over, or never was one");
    ensure!(code == Some(1) && is_told, "{code:?}\n{said}");
    let (facts, err) = texts(&place.ratn(&["world", "facts", "by()"]).output()?);
    ensure!(facts.lines().any(|line| line.split_whitespace().nth(1) == Some("second")), "{facts}{err}");
    up.signal(nix::sys::signal::Signal::SIGTERM)?;
    up.finish()?;
    place.wait_until_empty()
}

/// What is said on the command line of a run is what the resource manager counts with, and what `ratn status` shows.
#[test]
fn the_share_and_the_due_time_of_a_run_arrive_and_are_shown() -> anyhow::Result<()> {
    let place = Place::new()?;
    let mut up = place.start_as("up", &["up", "--speed", "10", "--boxes", "1"])?;
    wait_for("the system", || Ok(up.said().contains("is ready").then_some(()))).with_context(|| up.said())?;
    let file = place.path().join("waits.yaml");
    std::fs::write(&file, "task: waits\nstates:\n  - go: { wait: { signal: go } }\n")?;
    let file = file.to_str().context("a path")?;

    for (wrong, why) in [
        (["--share", "0"], "expected a number from 0.01 to 100; 1 is the usual share"),
        (["--due", "soon"], "expected a time from the start as 90s, 15m or 2h"),
        (["--due", "2001-01-01T00:00:00Z"], "--due: has passed"),
    ] {
        let output = place.ratn(&[["run", file].as_slice(), &wrong].concat()).output()?;
        let (_, err) = texts(&output);
        ensure!(output.status.code() == Some(2) && err.contains(why) && err.contains(wrong[0]), "{wrong:?}: {err}");
    }

    let mut run = place.start_as("run", &["run", file, "--share", "2.5", "--due", "30m"])?;
    let mut usual = place.start_as("usual", &["run", file])?;
    let shown = wait_for("both runs", || {
        let (shown, _) = texts(&place.ratn(&["status"]).output()?);
        Ok((shown.matches("share ").count() == 2).then_some(shown))
    })
    .with_context(|| run.said())?;
    let due: Vec<&str> = shown.lines().filter_map(|line| line.strip_prefix("share 2.5, due in ")).collect();
    let seconds = due.first().and_then(|due| due.strip_suffix(" s")).context("no due time")?.parse::<u32>()?;
    ensure!((1_700..=1_800).contains(&seconds), "{shown}");
    ensure!(shown.lines().any(|line| line == "share 1"), "{shown}");

    let (sessions, err) = texts(&place.ratn(&["resource", "sessions", "--json"]).output()?);
    let sessions: serde_json::Value = serde_json::from_str(&sessions).with_context(|| err)?;
    let sessions = sessions.as_array().context("a list of sessions")?;
    let told =
        |share: f64| sessions.iter().filter(|one| one["client"] == "task-control" && one["share"] == share).count();
    ensure!((told(2.5), told(1.0)) == (1, 1), "{sessions:?}");
    let of_run = sessions.iter().find(|one| one["share"] == 2.5).context("its session")?;
    ensure!(of_run["due_in_ms"].as_i64().is_some_and(|due| (1_700_000..=1_800_000).contains(&due)), "{of_run}");

    let (runs, _) = texts(&place.ratn(&["status", "--json"]).output()?);
    let runs: serde_json::Value = serde_json::from_str(&runs)?;
    for id in runs["runs"].as_array().context("a list of runs")?.iter().filter_map(|run| run["run"].as_str()) {
        let (said, err) = texts(&place.ratn(&["signal", id, "go"]).output()?);
        ensure!(err.is_empty() || !said.is_empty(), "{said}{err}");
    }
    for one in [&mut run, &mut usual] {
        let (code, _, said) = one.finish()?;
        ensure!(code == Some(0), "{code:?}\n{said}");
    }
    up.signal(nix::sys::signal::Signal::SIGTERM)?;
    up.finish()?;
    place.wait_until_empty()
}
