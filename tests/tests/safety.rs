//! Emergency stop and hold of a running system, during a task.

mod support;

use anyhow::{Context, ensure};
use support::{Place, Started, repository, texts, wait_for};

struct System {
    place: Place,
    _up: Started,
}

impl System {
    fn up() -> anyhow::Result<System> {
        let place = Place::new()?;
        let directory = place.path().join("run");
        let directory = directory.to_str().context("a path")?;
        let up = place.start_as("up", &["up", "--runtime-dir", directory, "--speed", "4", "--boxes", "1"])?;
        wait_for("the system", || Ok(up.said().contains("is ready").then_some(()))).with_context(|| up.said())?;
        Ok(System { place, _up: up })
    }

    fn run(&self, log: &str) -> anyhow::Result<Started> {
        let task = repository("examples/fetch_boxes.yaml");
        let log = self.place.path().join(log);
        let (task, log) = (task.to_str().context("a path")?, log.to_str().context("a path")?);
        self.place.start_as("run", &["run", task, "--set", "boxes=1", "--set", "budget=false", "--log", log])
    }

    /// Lines of the cell's own record.
    fn count(&self, word: &str) -> usize {
        let record = std::fs::read_to_string(self.place.path().join("run/cell.log")).unwrap_or_default();
        record.lines().filter(|line| line.contains(word)).count()
    }

    fn say(&self, arguments: &[&str]) -> anyhow::Result<(Option<i32>, String)> {
        let output = self.place.ratn(arguments).output()?;
        let (out, err) = texts(&output);
        Ok((output.status.code(), out + &err))
    }
}

#[test]
fn an_emergency_stop_ends_the_run_by_its_name_and_nothing_moves_until_it_is_cleared() -> anyhow::Result<()> {
    let system = System::up()?;
    let mut run = system.run("log.jsonl")?;
    wait_for("a motion", || Ok((system.count("begun goal=") > 0).then_some(()))).with_context(|| run.said())?;
    let (code, said) = system.say(&["stop", "--reason", "a hand in the cell"])?;
    ensure!(code == Some(0) && said.contains("stopped") && said.contains("a hand in the cell"), "{said}");
    let (code, out, err) = run.finish()?;
    ensure!(code == Some(1) && out.contains("preempted"), "{code:?} {out}{err}");
    ensure!(out.contains("emergency stop: a hand in the cell"), "{out}{err}");

    // Whoever tries is stopped, too, and going on is not enough.
    let (code, said) = system.say(&["go-on"])?;
    ensure!(code == Some(1) && said.contains("clear it first"), "{said}");
    let (code, out, _) = system.run("again.jsonl")?.finish()?;
    ensure!(code == Some(1) && out.contains("emergency stop"), "{out}");
    let (code, said) = system.say(&["stop", "--clear"])?;
    ensure!(code == Some(0) && said.contains("ready"), "{said}");
    Ok(())
}

#[test]
fn a_run_that_is_held_waits_and_goes_on_to_its_end() -> anyhow::Result<()> {
    let system = System::up()?;
    let mut run = system.run("log.jsonl")?;
    wait_for("a motion", || Ok((system.count("begun goal=") > 0).then_some(()))).with_context(|| run.said())?;
    let (code, said) = system.say(&["hold"])?;
    ensure!(code == Some(0) && said.contains("held"), "{said}");
    let ended = system.count("ended goal=");
    // Longer than any motion of this task at this speed needs to end.
    std::thread::sleep(std::time::Duration::from_secs(3));
    ensure!(system.count("ended goal=") == ended, "a motion ended while it was held");
    ensure!(system.say(&["stop", "--show"])?.1.contains("held"));
    let (code, said) = system.say(&["go-on"])?;
    ensure!(code == Some(0) && said.contains("ready"), "{said}");
    let (code, out, err) = run.finish()?;
    ensure!(code == Some(0) && out.contains("delivered = 1"), "{code:?} {out}{err}");
    Ok(())
}
