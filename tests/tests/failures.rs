//! Parts of a system die in the middle of a task.

mod support;

use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use std::process::Command;
use std::time::Duration;
use support::host::Host;
use support::{Place, Process, Started, repository, wait_for};

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
    ensure!(said.contains(&format!("plan_approach: {at_work}: killed by signal 9")), "not how it ended\n{said}");
    place.wait_until_empty()
}

/// A run of one box on a host, once the arm has begun to move.
fn run_until_a_motion(host: &Host) -> anyhow::Result<Started> {
    let task = repository("examples/fetch_boxes.yaml");
    let log = host.place.path().join("log.jsonl");
    let (task, log) = (task.to_str().context("a path")?, log.to_str().context("a path")?);
    let config = host.config();
    let settings = ["--set", "boxes=1", "--set", "budget=false", &config, "--log", log];
    let run = host.place.start_as("run", &[["run", task].as_slice(), &settings].concat())?;
    wait_for("a motion", || Ok((!host.begun()?.is_empty()).then_some(()))).with_context(|| run.said())?;
    Ok(run)
}

#[test]
fn a_run_whose_resource_manager_stays_away_ends_preempted_and_the_robot_holds() -> anyhow::Result<()> {
    let mut host = Host::start()?;
    let mut run = run_until_a_motion(&host)?;
    host.kill("resource-manager")?;
    let (code, out, err) = run.finish()?;
    ensure!(code == Some(1) && out.contains("preempted"), "{code:?} {out}{err}");
    ensure!(out.contains("the session with the resource manager, and every lease, is lost"), "{out}{err}");
    wait_for("the robot to hold", || Ok((host.begun()?.len() == host.ended()?).then_some(())))?;
    // What was interrupted is over; the next run finds everything free again.
    host.start_role("resource-manager")?;
    host.is_whole()
}

/// One motion of some seconds.
const SLOWLY: &str = r#"
task: slowly
states:
  - far:
      action: arm/move_to
      in: { joints: "joints(0.9, -1.2, 0, 0.9, 0, -0.6, 0)", speed: 0.03 }
      pia: true
      reads: []
      resources: [{ block: Arm }]
"#;
/// Longer than sessions live.
const LONG: Duration = Duration::from_millis(3_600);

#[test]
fn a_run_survives_a_suspended_resource_manager_with_a_motion_under_way() -> anyhow::Result<()> {
    let host = Host::start()?;
    let (task, log) = (host.place.path().join("slowly.yaml"), host.place.path().join("log.jsonl"));
    std::fs::write(&task, SLOWLY)?;
    let (task, log) = (task.to_str().context("a path")?, log.to_str().context("a path")?);
    let mut run = host.place.start_as("run", &["run", task, &host.config(), "--log", log])?;
    wait_for("a motion", || Ok((!host.begun()?.is_empty()).then_some(()))).with_context(|| run.said())?;
    host.signal("resource-manager", Signal::SIGSTOP)?;
    std::thread::sleep(LONG);
    let record = std::fs::read_to_string(host.place.path().join("cellerr"))?;
    ensure!(record.contains("the resource manager is not heard"), "the cell's session did not run out");
    ensure!(host.ended()? == 0, "the motion was to be under way");
    host.signal("resource-manager", Signal::SIGCONT)?;
    let (code, out, err) = run.finish()?;
    ensure!(code == Some(0), "{code:?} {out}{err}");
    ensure!(host.begun()?.len() == 1 && host.ended()? == 1, "one motion, and to its end");
    host.is_whole()
}

#[test]
fn a_task_survives_a_suspended_resource_manager_whatever_is_under_way() -> anyhow::Result<()> {
    let host = Host::start()?;
    let mut run = run_until_a_motion(&host)?;
    host.signal("resource-manager", Signal::SIGSTOP)?;
    std::thread::sleep(LONG);
    host.signal("resource-manager", Signal::SIGCONT)?;
    let (code, out, err) = run.finish()?;
    ensure!(code == Some(0) && out.contains("delivered = 1"), "{code:?} {out}{err}");
    host.is_whole()
}

#[test]
fn a_run_whose_world_pool_stays_away_ends_and_says_that_not_all_is_recorded() -> anyhow::Result<()> {
    let mut host = Host::start()?;
    let mut run = run_until_a_motion(&host)?;
    host.kill("world-pool")?;
    let (code, out, err) = run.finish()?;
    ensure!(code == Some(1), "{code:?} {out}{err}");
    ensure!(format!("{out}{err}").contains("world pool"), "{out}{err}");
    wait_for("the robot to hold", || Ok((host.begun()?.len() == host.ended()?).then_some(())))?;
    host.start_role("world-pool")?;
    host.is_whole()
}

#[test]
fn a_run_whose_cell_dies_aborts_at_the_motion_and_begins_no_other() -> anyhow::Result<()> {
    let mut host = Host::start()?;
    let mut run = run_until_a_motion(&host)?;
    let begun = host.begun()?.len();
    host.kill("cell")?;
    let (code, out, err) = run.finish()?;
    ensure!(code == Some(1) && out.contains("aborted") && out.contains("crashed in attempt 1"), "{code:?} {out}{err}");
    ensure!(host.begun()?.len() <= begun + 1, "{out}{err}");
    Ok(())
}

#[test]
fn a_run_whose_process_manager_dies_waits_for_another_one() -> anyhow::Result<()> {
    let mut host = Host::start()?;
    let mut run = run_until_a_motion(&host)?;
    let before = host.workers();
    host.kill("process-manager")?;
    wait_for("its workers to end", || {
        let now = host.workers();
        Ok(before.iter().all(|old| now.iter().all(|new| new.pid != old.pid)).then_some(()))
    })?;
    host.start_role("process-manager")?;
    let (code, out, err) = run.finish()?;
    ensure!(code == Some(0) && out.contains("delivered = 1"), "{code:?} {out}{err}");
    host.has_no_orphan()?;
    host.end()
}

/// A disk of its own, full after so many bytes; needs root.
struct SmallDisk {
    _place: tempfile::TempDir,
    path: std::path::PathBuf,
}

impl SmallDisk {
    fn mount(bytes: u64) -> anyhow::Result<Option<SmallDisk>> {
        let place = tempfile::tempdir()?;
        let path = place.path().join("disk");
        std::fs::create_dir(&path)?;
        let size = format!("size={bytes}");
        let mounted = Command::new("mount").args(["-t", "tmpfs", "-o", &size, "tmpfs"]).arg(&path).output();
        let there = mounted.is_ok_and(|output| output.status.success());
        Ok(there.then_some(SmallDisk { _place: place, path }))
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("--lazy").arg(&self.path).status();
    }
}

#[test]
fn a_run_whose_event_log_finds_no_room_ends_before_the_next_motion_and_gives_everything_back() -> anyhow::Result<()> {
    let Some(disk) = SmallDisk::mount(64 << 10)? else {
        println!("skipped: a small disk cannot be mounted (needs root)");
        return Ok(());
    };
    let host = Host::start()?;
    let task = repository("examples/fetch_boxes.yaml");
    let log = disk.path.join("log.jsonl");
    let (task, log) = (task.to_str().context("a path")?, log.to_str().context("a path")?);
    let config = host.config();
    let settings = ["--set", "boxes=1", "--set", "budget=false", &config, "--log", log];
    let mut run = host.place.start_as("run", &[["run", task].as_slice(), &settings].concat())?;
    let (code, out, err) = run.finish()?;
    ensure!(code == Some(1) && err.contains(log), "{code:?} {out}{err}");
    ensure!(err.contains("No space left"), "{out}{err}");
    wait_for("the robot to hold", || Ok((host.begun()?.len() == host.ended()?).then_some(())))?;
    host.is_whole()?;
    host.end()
}
