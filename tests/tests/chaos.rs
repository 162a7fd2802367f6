//! Workers, managers and task control are killed at random while tasks run, and managers and the cell suspended: every task ends as it does in HSM mode when nobody is
//! killed, no process is left that nobody watches, and no lease that nobody has.
//!
//! `RATN_KILLS` [20] and `RATN_SEED` [1] say how many and when; `scripts/soak-chaos` does 1,000.

mod support;

use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::time::Duration;
use support::crashes::{Random, number};
use support::host::{Host, ROLES};
use support::motions::{lines, motions};
use support::{Started, repository, wait_for};

/// Who is killed or suspended; the cell is the robot, and a robot is not started again in the middle of a motion.
const VICTIMS: [Victim; 9] = [
    Victim::TaskControl,
    Victim::Worker,
    Victim::Role(0),
    Victim::Role(1),
    Victim::Role(2),
    Victim::Suspended(0),
    Victim::Suspended(1),
    Victim::Suspended(2),
    Victim::Suspended(3),
];
/// How long a role is suspended: less than its session lives, but for the resource manager, which has none.
const SUSPENDED_MS: [u64; 4] = [4_500, 1_500, 1_500, 1_500];
/// A node is computed at most three times, so no more workers than this are lost in one task: one by itself, some with their manager.
const WORKERS_LOST: u32 = 2;
const KILLS_A_TASK: u64 = 6;
/// Between two kills.
const PAUSE_MS: (u64, u64) = (50, 1_200);
const MAX_RESUMPTIONS: usize = 8;
/// So often that a run is resumed from one most of the time.
const CHECKPOINTS: [&str; 2] = ["--checkpoint-every", "8"];
/// Of the log of a run that did not end as it should.
const LAST_LINES: usize = 40;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Victim {
    TaskControl,
    Worker,
    /// One of [`ROLES`].
    Role(usize),
    /// The same, which goes on after a while.
    Suspended(usize),
}

/// One task, with its task control.
struct Task<'a> {
    host: &'a mut Host,
    log: PathBuf,
    run: Started,
    resumptions: usize,
}

impl<'a> Task<'a> {
    fn begin(host: &'a mut Host, number: usize, mode: &str) -> anyhow::Result<Task<'a>> {
        let log = host.place.path().join(format!("log-{number}.jsonl"));
        let (task, file) = (repository("examples/fetch_boxes.yaml"), log.display().to_string());
        let task = task.to_str().context("a path")?;
        let config = host.config();
        let settings = ["--set", "boxes=1", "--set", "budget=false", &config, "--mode", mode, "--log", &file];
        let arguments = [["run", task].as_slice(), &settings, &CHECKPOINTS].concat();
        let run = host.place.start_as(&format!("run-{number}"), &arguments)?;
        Ok(Task { host, log, run, resumptions: 0 })
    }

    fn kill(&mut self, victim: Victim, random: &mut Random) -> anyhow::Result<()> {
        match victim {
            Victim::Role(role) => {
                self.host.kill(ROLES[role])?;
                self.host.start_role(ROLES[role])
            }
            Victim::Suspended(role) => {
                self.host.signal(ROLES[role], Signal::SIGSTOP)?;
                std::thread::sleep(Duration::from_millis(50 + random.below(SUSPENDED_MS[role])));
                self.host.signal(ROLES[role], Signal::SIGCONT)
            }
            Victim::Worker => {
                let workers = self.host.workers();
                // There may be none at this moment, and it may end by itself.
                let chosen = workers.get(random.below(workers.len().max(1) as u64) as usize);
                chosen.map_or(Ok(()), |worker| worker.kill().or(Ok(())))
            }
            Victim::TaskControl => {
                self.run.process()?.kill()?;
                self.run.child.wait()?;
                self.resume()
            }
        }
    }

    fn resume(&mut self) -> anyhow::Result<()> {
        self.resumptions += 1;
        let (name, file) = (format!("resumed-{}", self.resumptions), self.log.display().to_string());
        let arguments = ["run", "--resume", &file, &self.host.config()];
        self.run = self.host.place.start_as(&name, &[&arguments[..], &CHECKPOINTS].concat())?;
        Ok(())
    }

    fn has_begun(&self) -> bool {
        std::fs::metadata(&self.log).is_ok_and(|log| log.len() > 0)
    }

    /// The paths of its motions, in no order, each begun once.
    fn ends(mut self) -> anyhow::Result<BTreeSet<String>> {
        let (mut code, mut out, mut err) = self.run.finish()?;
        // Refused before anything was begun, for a part of the system was just being started again: whoever resumes tries again.
        while code == Some(2) && !err.contains("has ended with") && self.resumptions < MAX_RESUMPTIONS {
            self.host.is_there()?;
            self.resume()?;
            (code, out, err) = self.run.finish()?;
        }
        let log = std::fs::read_to_string(&self.log)?;
        // What the run came to before it was resumed for the last time is in its log only.
        let last: Vec<&str> = log.lines().rev().take(LAST_LINES).collect();
        let last: Vec<&str> = last.into_iter().rev().collect();
        let said = format!("{code:?}\n{out}{err}\nthe end of its log:\n{}", last.join("\n"));
        // The last kill may have come when there was nothing left to do.
        let over = err.contains("has ended with success");
        ensure!(over || (code == Some(0) && out.contains("delivered = 1")), "{said}");
        let motions = motions(&lines(&self.log)?)?;
        let begun = self.host.begun()?;
        let once: BTreeSet<&String> = begun.iter().collect();
        ensure!(once.len() == begun.len(), "a goal was begun twice: {begun:?}");
        for (goal, path) in &motions {
            ensure!(once.contains(goal), "{path} ({goal}) is not among {begun:?}\n{said}");
        }
        Ok(motions.into_values().collect())
    }
}

#[test]
fn tasks_end_as_in_hsm_mode_whoever_is_killed_meanwhile() -> anyhow::Result<()> {
    let (kills, seed) = (number("RATN_KILLS", 20), number("RATN_SEED", 1));
    println!("{kills} kills from seed {seed}");
    let mut random = Random(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
    let mut host = Host::start()?;
    let undisturbed = Task::begin(&mut host, 0, "hsm")?.ends()?;

    let (mut killed, mut counts) = (0, BTreeMap::new());
    for number in 1.. {
        if killed == kills {
            break;
        }
        host.is_whole()?;
        host.reset()?;
        let mut task = Task::begin(&mut host, number, "cdtn")?;
        let told = format!("task {number}, seed {seed}, after {killed} kills");
        wait_for("the run to begin", || Ok(task.has_begun().then_some(()))).with_context(|| task.run.said())?;
        let (mut lost, mut story) = (0, Vec::new());
        for _ in 0..KILLS_A_TASK.min(kills - killed) {
            std::thread::sleep(Duration::from_millis(PAUSE_MS.0 + random.below(PAUSE_MS.1 - PAUSE_MS.0)));
            match task.run.child.try_wait()? {
                Some(status) if status.code() == Some(2) => task.resume()?,
                Some(_) => break,
                None => {}
            }
            let victim = VICTIMS[random.below(VICTIMS.len() as u64) as usize];
            lost += u32::from(victim == Victim::Worker || victim == Victim::Role(2));
            if lost > WORKERS_LOST || (victim == Victim::TaskControl && task.resumptions == MAX_RESUMPTIONS) {
                break;
            }
            task.kill(victim, &mut random).with_context(|| told.clone())?;
            killed += 1;
            *counts.entry(format!("{victim:?}")).or_insert(0) += 1;
            story.push(victim);
        }
        let motions = task.ends().with_context(|| format!("{told}: {story:?}"))?;
        ensure!(motions == undisturbed, "{told}: {story:?}: {motions:?} instead of {undisturbed:?}");
        host.is_whole().with_context(|| format!("{told}: {story:?}"))?;
        host.has_no_orphan().with_context(|| format!("{told}: {story:?}"))?;
    }
    println!("killed {counts:?}");
    host.end()
}
