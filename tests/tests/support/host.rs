//! A system whose roles are processes of their own, as under a service manager.

use super::motions::begun_in;
use super::{Place, Process, Started, repository, texts, wait_for};
use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

/// All of them.
pub(crate) const ROLES: [&str; 4] = ["resource-manager", "world-pool", "process-manager", "cell"];

/// Every role as a process of its own that can be killed and started again, as a service manager does.
pub(crate) struct Host {
    pub(crate) place: Place,
    config: PathBuf,
    running: BTreeMap<&'static str, Started>,
    starts: u32,
}

impl Host {
    pub(crate) fn start() -> anyhow::Result<Host> {
        Host::start_with("")
    }

    /// As [`Host::start`], with more in its config.
    pub(crate) fn start_with(more: &str) -> anyhow::Result<Host> {
        let place = Place::new()?;
        let config = place.path().join("ratn.toml");
        let shipped = std::fs::read_to_string(repository("deploy/ratn.toml"))?;
        std::fs::write(
            &config,
            shipped.replace("\nspeed = 1.0", "\nspeed = 8.0").replace("\nboxes = 3", "\nboxes = 1") + more,
        )?;
        let mut host = Host { place, config, running: BTreeMap::new(), starts: 0 };
        for role in ROLES {
            host.start_role(role)?;
        }
        host.is_whole()?;
        Ok(host)
    }

    /// Its config, as an option of `ratn run`.
    pub(crate) fn config(&self) -> String {
        format!("--config={}", self.config.display())
    }

    pub(crate) fn start_role(&mut self, role: &'static str) -> anyhow::Result<()> {
        let (config, state) =
            (self.config.display().to_string(), self.place.path().join("state").display().to_string());
        // Its command line says whose it is.
        let directory = self.place.path().join("run").display().to_string();
        let environment = [("RATN_LOG", "info,ratn_worker=debug"), ("RATN_STATE_DIR", state.as_str())];
        self.starts += 1;
        let name = if role == "cell" { role.to_owned() } else { format!("{role}-{}", self.starts) };
        let arguments = [role, "--config", &config, "--runtime-dir", &directory];
        let process = self.place.start_with(&name, &arguments, &environment)?;
        self.running.insert(role, process);
        Ok(())
    }

    /// `kill -9`, for good unless [`Host::start_role`] is told.
    pub(crate) fn kill(&mut self, role: &'static str) -> anyhow::Result<()> {
        let mut process = self.running.remove(role).context("it runs")?;
        process.signal(Signal::SIGKILL)?;
        let status = process.child.wait()?;
        ensure!(status.code().is_none(), "{role} had ended by itself: {}", process.said());
        Ok(())
    }

    /// For a role that runs.
    pub(crate) fn signal(&self, role: &str, signal: Signal) -> anyhow::Result<()> {
        self.running.get(role).context("it runs")?.signal(signal)
    }

    /// Ends every role in order; nothing is left.
    pub(crate) fn end(self) -> anyhow::Result<()> {
        for process in self.running.values() {
            process.signal(Signal::SIGTERM)?;
        }
        self.place.wait_until_empty()
    }

    pub(crate) fn json(&self, arguments: &[&str]) -> Option<Value> {
        let output = self.place.ratn(arguments).output().ok()?;
        serde_json::from_slice(&output.stdout).ok().filter(|_| output.status.success())
    }

    /// Waits until every resource that the config promises is there, and nobody holds any.
    pub(crate) fn is_whole(&self) -> anyhow::Result<()> {
        let promised = BTreeMap::from([
            ("Arm", 1),
            ("Base", 1),
            ("Camera", 1),
            ("Detector", 1),
            ("Gripper", 1),
            ("PanTilt", 1),
            ("PathPlanner", 2),
            ("WorldModel", 1),
        ]);
        let whole = || {
            let Some(Value::Array(there)) = self.json(&["resource", "list", "--json"]) else { return Ok(None) };
            let of = |kind: &str| there.iter().filter(|resource| resource["kind"] == kind).count();
            let leaked =
                there.iter().any(|resource| resource["holdings"].as_array().is_some_and(|held| !held.is_empty()));
            let all = promised.iter().all(|(kind, count)| of(kind) >= *count);
            Ok((all && !leaked).then_some(()))
        };
        wait_for("all resources, free", whole)
            .with_context(|| format!("{:?}", self.json(&["resource", "list", "--json"])))
    }

    /// Waits until the resource manager answers.
    pub(crate) fn is_there(&self) -> anyhow::Result<()> {
        wait_for("the resource manager", || Ok(self.json(&["resource", "list", "--json"]).map(drop)))
    }

    pub(crate) fn workers(&self) -> Vec<Process> {
        self.place.processes().into_iter().filter(|process| process.command.contains(" worker ")).collect()
    }

    /// Waits until the worker processes that there are, are those that the process manager knows of.
    pub(crate) fn has_no_orphan(&self) -> anyhow::Result<()> {
        let watched = || {
            let Some(shown) = self.json(&["ps", "--json"]) else { return Ok(None) };
            let mut known = BTreeSet::new();
            pids(&shown, &mut known);
            let there: BTreeSet<u64> = self.workers().iter().map(|worker| worker.pid.unsigned_abs().into()).collect();
            Ok((there == known).then_some(()))
        };
        wait_for("every worker to be watched", watched).with_context(|| format!("{:?}", self.workers()))
    }

    /// A new table, and no facts.
    pub(crate) fn reset(&self) -> anyhow::Result<()> {
        let output = self.place.ratn(&["reset"]).output()?;
        ensure!(output.status.success(), "{}", texts(&output).1);
        Ok(())
    }

    /// Goals that the cell has begun, by its own record.
    pub(crate) fn begun(&self) -> anyhow::Result<Vec<String>> {
        begun_in(&self.place.path().join("cellerr"))
    }

    /// How many goals of the cell have ended, by its own record.
    pub(crate) fn ended(&self) -> anyhow::Result<usize> {
        let record = std::fs::read_to_string(self.place.path().join("cellerr"))?;
        Ok(record.lines().filter(|line| line.contains("ended goal=")).count())
    }
}

fn pids(value: &Value, found: &mut BTreeSet<u64>) {
    match value {
        Value::Array(values) => values.iter().for_each(|value| pids(value, found)),
        Value::Object(fields) => {
            found.extend(fields.get("pid").and_then(Value::as_u64).filter(|pid| *pid > 0));
            fields.values().for_each(|value| pids(value, found));
        }
        _ => {}
    }
}
