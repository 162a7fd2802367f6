//! Task control is killed in the middle of a task and goes on from its event log.

mod support;

use anyhow::{Context, ensure};
use serde_json::Value;
use std::collections::BTreeSet;
use std::io::Write;
use std::path::Path;
use support::host::Host;
use support::motions::{begun_in, lines, motions, starts};
use support::{Place, Started, repository, texts, wait_for};

/// What a debug build can follow, with motions that are long enough to be killed in.
const SPEED: &str = "8";

/// The cell's own record.
fn begun_in_the_cell(place: &Place) -> anyhow::Result<Vec<String>> {
    begun_in(&place.path().join("run/cell.log"))
}

/// A system that outlives its runs, and says which goals its providers begin.
fn up(place: &Place, speed: &str, boxes: &str) -> anyhow::Result<Started> {
    let directory = place.path().join("run");
    let directory = directory.to_str().context("a path")?;
    let up = place.start_as("up", &["up", "--runtime-dir", directory, "--speed", speed, "--boxes", boxes])?;
    wait_for("the system", || Ok(up.said().contains("is ready").then_some(()))).with_context(|| up.said())?;
    Ok(up)
}

/// Waits until a log has a line like this; what is torn there is not looked at.
fn wait_for_line(log: &Path, what: &str, is: impl Fn(&Value) -> bool) -> anyhow::Result<Value> {
    wait_for(what, || {
        let text = std::fs::read_to_string(log).unwrap_or_default();
        let whole = text.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
        Ok(whole.into_iter().find(&is))
    })
}

#[test]
fn a_run_whose_task_control_is_killed_goes_on_and_repeats_no_motion() -> anyhow::Result<()> {
    let place = Place::new()?;
    let _up = up(&place, SPEED, "2")?;
    let task = repository("examples/fetch_boxes.yaml");
    let task = task.to_str().context("a path")?;
    let log = place.path().join("log.jsonl");
    let file = log.to_str().context("a path")?;
    let often = ["--checkpoint-every", "5"];
    let run = ["run", task, "--set", "boxes=2", "--set", "budget=false", "--log", file];
    let run = place.start(&[&run[..], &often].concat())?;
    let checkpoint = place.path().join("log.jsonl.checkpoint");
    wait_for("a checkpoint", || Ok(checkpoint.exists().then_some(()))).with_context(|| run.said())?;

    // Once while the arm moves for the first time with a box before it, and once in the middle of the second part.
    wait_for_line(&log, "the arm to move to a box", |line| starts(line, "gripper")).with_context(|| run.said())?;
    run.process()?.kill()?;
    drop(run);
    // As if it had been killed while it wrote.
    std::fs::OpenOptions::new().append(true).open(&log)?.write_all(b"{\"at\":1,\"eve")?;
    let again = place.start_as("again", &[&["run", "--resume", file][..], &often].concat())?;
    wait_for_line(&log, "a box to be delivered", |line| line["command"] == "operate").with_context(|| again.said())?;
    again.process()?.kill()?;
    let before = lines(&log).map(|lines| lines.len()).unwrap_or_default();
    ensure!(again.said().contains("a checkpoint after"), "{}", again.said());
    drop(again);

    let output = place.ratn(&["run", "--resume", file, "--json"]).output()?;
    let (out, err) = texts(&output);
    ensure!(output.status.success(), "{err}");
    // Each time from a checkpoint; a run that has ended leaves none.
    ensure!(err.contains("a checkpoint after") && !checkpoint.exists(), "{err}");
    let result: Value = serde_json::from_str(&out)?;
    ensure!(result["outcome"] == "success" && result["outputs"]["delivered"] == 2, "{result}");

    // Whatever was committed before, in between and after says which node wrote it.
    let (facts, _) = texts(&place.ratn(&["world", "facts", "--json"]).output()?);
    let facts: Value = serde_json::from_str(&facts)?;
    let facts = facts["facts"].as_array().context("facts")?;
    let unwritten = facts.iter().find(|fact| fact["writer"].as_str().is_none_or(str::is_empty));
    ensure!(!facts.is_empty() && unwritten.is_none(), "{unwritten:?}");

    let lines = lines(&log)?;
    ensure!(lines.len() > before && lines.iter().filter(|line| line["event"] == "resumed").count() == 2);
    // No motion was lost and none ran twice: neither by the log nor by the cell's own record.
    let motions = motions(&lines)?;
    let begun = begun_in_the_cell(&place)?;
    let once: BTreeSet<&String> = begun.iter().collect();
    ensure!(once.len() == begun.len(), "{begun:?}");
    for (goal, path) in &motions {
        ensure!(once.contains(goal), "{path} ({goal}) is not among {begun:?}");
    }
    // Approach, grasp, transfer, release and retract of each box, and four of the task's own.
    ensure!(motions.len() == 14, "{motions:?}");

    // It has ended: there is nothing to go on with.
    let output = place.ratn(&["run", "--resume", file]).output()?;
    let (_, err) = texts(&output);
    ensure!(output.status.code() == Some(2) && err.contains("has ended with success"), "{err}");
    Ok(())
}

#[test]
fn a_motion_whose_lease_has_ended_is_not_repeated() -> anyhow::Result<()> {
    let place = Place::new()?;
    // The first motion takes longer than the run's session lives without task control.
    let _up = up(&place, "1", "1")?;
    let task = repository("examples/fetch_boxes.yaml");
    let log = place.path().join("log.jsonl");
    let file = log.to_str().context("a path")?;
    let run = place.start(&["run", task.to_str().context("a path")?, "--set", "boxes=1", "--log", file])?;
    wait_for("the cell to move", || Ok((!begun_in_the_cell(&place)?.is_empty()).then_some(())))
        .with_context(|| run.said())?;
    run.process()?.kill()?;
    wait_for("the motion to stop", || {
        let record = std::fs::read_to_string(place.path().join("run/cell.log"))?;
        Ok(record.contains("ended goal=").then_some(()))
    })?;

    let output = place.ratn(&["run", "--resume", file]).output()?;
    let (out, err) = texts(&output);
    ensure!(output.status.code() == Some(1), "{err}");
    ensure!(out.contains("aborted") && out.contains("stopped while task control was gone"), "{out}{err}");
    ensure!(begun_in_the_cell(&place)?.len() == 1);
    Ok(())
}

#[test]
fn a_run_is_paused_and_stepped_from_outside() -> anyhow::Result<()> {
    let place = Place::new()?;
    let _up = up(&place, "20", "1")?;
    let task = repository("examples/fetch_boxes.yaml");
    let log = place.path().join("log.jsonl");
    let file = log.to_str().context("a path")?;
    let arguments =
        ["run", task.to_str().context("a path")?, "--set", "boxes=1", "--set", "budget=false", "--log", file];
    let mut run = place.start(&arguments)?;
    let tell = |word: &str| {
        let output = place.ratn(&["control", word]).output()?;
        ensure!(output.status.success(), "{word}: {}", texts(&output).1);
        Ok(())
    };
    let moves = |line: &Value| ["arm", "gripper", "pan_tilt"].iter().any(|provider| starts(line, provider));
    wait_for_line(&log, "the run", moves).with_context(|| run.said())?;
    tell("pause")?;
    for steps in 1..=2 {
        tell("step")?;
        wait_for("a step", || {
            let text = std::fs::read_to_string(&log)?;
            let whole: Vec<Value> = text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
            let paused = whole.iter().position(|line| line["event"] == "pause_requested");
            let since = paused.map(|paused| whole[paused..].iter().filter(|line| moves(line)).count());
            Ok((since == Some(steps)).then_some(()))
        })
        .with_context(|| run.said())?;
    }
    // Nothing else runs on this system meanwhile, and its log is its own.
    let output = place.ratn(&["run", "--resume", file]).output()?;
    ensure!(output.status.code() == Some(2) && texts(&output).1.contains("is under way"), "{}", texts(&output).1);
    tell("resume")?;
    let (code, out, said) = run.finish()?;
    ensure!(code == Some(0), "{code:?}\n{out}{said}");
    // The chart and the figures know of it.
    let output = place.ratn(&["control", "pause"]).output()?;
    ensure!(output.status.code() == Some(1) && texts(&output).1.contains("no run"), "{}", texts(&output).1);

    // What was measured is used the next time; a run that is told to end ends.
    let next = place.path().join("next.jsonl");
    let mut arguments = arguments.to_vec();
    arguments[7] = next.to_str().context("a path")?;
    arguments.extend(["--learn", file]);
    let mut run = place.start_as("next", &arguments)?;
    wait_for_line(&next, "the run", moves).with_context(|| run.said())?;
    tell("abort")?;
    let (code, _, said) = run.finish()?;
    ensure!(code == Some(1), "{code:?}\n{said}");
    let lines = lines(&next)?;
    let learned = lines[0]["learned"]["durations_s"]["stow_arm"].as_f64();
    ensure!(learned.is_some_and(|seconds| seconds > 0.1), "{}", lines[0]["learned"]);
    ensure!(lines.last().is_some_and(|line| line["outcome"] == "preempted"), "{:?}", lines.last());
    Ok(())
}

/// Two things are noted, and between them something is waited for.
const NOTE: &str = r#"
task: note
states:
  - first: { resources: [{ create: Note, class: task }], states: [{ moment: { wait: { seconds: 0.1 } } }] }
  - second:
      effects: [noted(desk)]
      resources: [{ create: Note, class: task }]
      states: [{ go: { wait: { signal: go } } }]
"#;

/// Runs that on a host until it waits.
fn waits_to_note(host: &Host, log: &Path) -> anyhow::Result<Started> {
    let task = host.place.path().join("note.yaml");
    std::fs::write(&task, NOTE)?;
    let arguments = ["run", task.to_str().context("a path")?, &host.config(), "--log", log.to_str().context("a path")?];
    let run = host.place.start_as("run", &arguments)?;
    wait_for_line(log, "the wait", |line| line["awaits"] == "signal").with_context(|| run.said())?;
    Ok(run)
}

/// How many notes there are.
fn notes(host: &Host) -> usize {
    let there = host.json(&["resource", "list", "--json"]);
    let there = there.as_ref().and_then(Value::as_array).map(Vec::as_slice).unwrap_or_default();
    there.iter().filter(|resource| resource["kind"] == "Note").count()
}

fn goes_on(host: &Host) -> anyhow::Result<()> {
    let output = host.place.ratn(&["signal", "note", "go"]).output()?;
    ensure!(output.status.success(), "{}", texts(&output).1);
    Ok(())
}

#[test]
fn a_run_that_was_killed_behind_its_end_does_what_it_had_decided_when_it_is_resumed() -> anyhow::Result<()> {
    let mut host = Host::start()?;
    let log = host.place.path().join("log.jsonl");
    let file = log.to_str().context("a path")?.to_owned();
    let mut run = waits_to_note(&host, &log)?;
    host.kill("world-pool")?;
    goes_on(&host)?;
    wait_for_line(&log, "the end", |line| line["command"] == "end").with_context(|| run.said())?;
    run.process()?.kill()?;
    let status = run.child.wait()?;
    ensure!(status.code().is_none(), "it was to be killed: {}", run.said());
    host.start_role("world-pool")?;
    let noted = || host.json(&["world", "facts", "--json"]).map(|facts| facts.to_string().contains("noted"));
    ensure!(!wait_for("the world pool", || Ok(noted()))?, "it was committed before");

    let resume = || host.place.ratn(&["run", "--resume", &file, &host.config()]).output();
    let (output, before) = (resume()?, lines(&log)?.len());
    let (out, err) = texts(&output);
    ensure!(
        output.status.success() && err.contains("the run had ended with success, and was killed before"),
        "{out}{err}"
    );
    ensure!(noted() == Some(true), "{out}{err}");
    // It is done, and nothing of it is left.
    let output = resume()?;
    let err = texts(&output).1;
    ensure!(
        output.status.code() == Some(2) && err.contains("has ended with success: there is nothing to resume"),
        "{err}"
    );
    ensure!(lines(&log)?.len() == before && notes(&host) == 0);
    host.is_whole()
}

#[test]
fn what_was_created_before_the_kill_is_there_once_whether_its_session_lives_or_not() -> anyhow::Result<()> {
    // A manager that forgets at once what it was asked for.
    let host = Host::start_with("\n[resource-manager.limits]\nremembered_requests = 1\n")?;
    let log = host.place.path().join("log.jsonl");
    let file = log.to_str().context("a path")?.to_owned();
    let run = waits_to_note(&host, &log)?;
    let recorded = wait_for_line(&log, "word of the note", |line| line["event"] == "recorded")?;
    let origin = &lines(&log)?[0]["origin"];
    ensure!(recorded["operation"] == 1 && recorded["session"] == origin["session"], "{recorded} {origin}");
    ensure!(notes(&host) == 1);
    run.process()?.kill()?;
    drop(run);
    let resumed = |name: &str, times: usize| {
        let run = host.place.start_as(name, &["run", "--resume", &file, &host.config()])?;
        wait_for("task control to go on", || {
            let resumed = lines(&log).unwrap_or_default().iter().filter(|line| line["event"] == "resumed").count();
            Ok((resumed == times && run.said().contains("task control goes on")).then_some(()))
        })
        .with_context(|| run.said())?;
        anyhow::Ok(run)
    };
    // Within its time to live.
    let again = resumed("again", 1)?;
    std::thread::sleep(std::time::Duration::from_millis(500));
    ensure!(notes(&host) == 1, "{}", again.said());
    again.process()?.kill()?;
    drop(again);
    wait_for("its session to end", || Ok((notes(&host) == 0).then_some(())))?;
    // And after it: then it is made anew, and the log names the new session.
    let mut last = resumed("last", 2)?;
    wait_for("the note", || Ok((notes(&host) == 1).then_some(()))).with_context(|| last.said())?;
    goes_on(&host)?;
    let (code, out, err) = last.finish()?;
    ensure!(code == Some(0), "{out}{err}");
    let lines = lines(&log)?;
    let recorded = lines.iter().filter(|line| line["event"] == "recorded");
    let recorded: Vec<_> = recorded.map(|line| (line["operation"].as_u64(), line["session"].as_u64())).collect();
    ensure!(recorded.len() >= 2 && recorded[0].1 != recorded[1].1 && recorded[1].0 == Some(1), "{recorded:?}");
    host.is_whole()
}
