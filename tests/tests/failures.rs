//! Parts of a system die in the middle of a task.

mod support;

use anyhow::{Context, ensure};
use support::{Place, Process, repository, wait_for};

const TEMPLATE: &str = "worker path-planner";

fn planners(place: &Place) -> Vec<Process> {
    place.processes().into_iter().filter(|process| process.command.contains(TEMPLATE)).collect()
}

#[test]
fn a_planner_that_is_killed_is_replaced_and_the_task_goes_on() -> anyhow::Result<()> {
    let place = Place::new()?;
    let task = repository("examples/fetch_boxes.yaml");
    let task = task.to_str().context("a path")?;
    let log = place.path().join("log.jsonl");
    let log = log.to_str().context("a path")?;
    let mut run = place.start(&["run", task, "--set", "boxes=1", "--speed", "8", "--log", log])?;

    // The first plan takes 12 of the robot's seconds, so it is under way for long.
    let at_work = wait_for("a plan to begin", || {
        let said = run.said();
        let line = said.lines().find(|line| line.contains("start ") && line.contains("plan_approach"));
        Ok(line.and_then(|line| Some(line.split_once('(')?.1.split([',', ')']).next()?.to_owned())))
    })
    .with_context(|| run.said())?;
    let before = planners(&place);
    let victim = before.iter().find(|process| process.command.contains(&at_work));
    let victim = victim.with_context(|| format!("no process of {at_work} among {before:?}"))?;
    victim.kill()?;
    wait_for("a replacement", || {
        let now = planners(&place);
        let is_new = |process: &Process| before.iter().all(|old| old.pid != process.pid);
        Ok((now.len() == before.len() && now.iter().any(is_new)).then_some(()))
    })
    .with_context(|| run.said())?;

    let (code, _, said) = run.finish()?;
    ensure!(code == Some(0), "{code:?}\n{said}");
    let text = std::fs::read_to_string(log)?;
    let crashed = text.lines().any(|line| line.contains("\"event\":\"crashed\""));
    let again = text.lines().any(|line| line.contains("\"command\":\"start\"") && line.contains("\"attempt\":2"));
    ensure!(crashed && again, "no second attempt\n{said}");
    place.wait_until_empty()
}
