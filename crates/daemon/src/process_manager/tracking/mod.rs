//! Tracks which processes belong to which worker, including those in other sessions, so that all of them end with the worker. The successor
//! of a killed process manager also ends processes that no list names.
//!
//! ```text
//!   intent in the roster ──▶ fork ──▶ group of cgroup v2 ──▶ `began` in the roster
//!                             └── from its first instruction on the process and all that it starts carry the marker in their environment
//! ```
//! A **cgroup** (v2) for each worker holds all processes that the worker starts, and `cgroup.kill` ends all of them: in the directory that
//! the config names, else below the process manager's own cgroup where groups may be made there. The **marker** (`marker`) covers processes
//! that were started before the worker was in its group, and all processes where there are no groups. Only a process that leaves its session
//! *and* clears its environment, without groups, is not recognized as the worker's: the process manager becomes its parent once the worker
//! has ended (`orphans`), and ends it when it stops.
//!
//! A child holds the lock of the roster, too, until its program begins: a successor gets the lock only when every child that was being
//! started carries its marker.

mod marker;
mod orphans;
mod own_group;

pub(super) use orphans::Children;

use super::account::Account;
use super::config::ProcessManagerConfig;
use super::limits::end_group;
use crate::config::ConfigError;
use nix::unistd::geteuid;
use ratn_proto::types::TrackingMode;
use ratn_worker::client::fresh_id;
use ratn_worker::runtime_directory::RuntimeDirectory;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::ffi::OsString;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Killed processes end within this time, unless they wait for a broken disk.
const KILL_PATIENCE: Duration = Duration::from_secs(2);
/// Interval at which that is checked.
const LOOK_AGAIN: Duration = Duration::from_millis(2);

/// How processes of workers are kept track of.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Tracking {
    /// By groups of cgroup v2 where there are some, else by their environment.
    #[default]
    Auto,
    /// By groups of cgroup v2; without them the process manager does not start.
    Cgroup,
    /// By their environment, even where there are groups.
    Environment,
}

/// See the module.
#[derive(Debug, Clone)]
pub(super) struct Tracker {
    /// The name that this runtime directory's process manager shares with its successors.
    instance: String,
    /// The directory in which the workers' groups are made.
    groups: Option<PathBuf>,
    /// That directory was made by this process.
    made: bool,
    /// Only processes of these users are examined.
    users: BTreeSet<u32>,
    children: Option<Children>,
}

impl Tracker {
    /// Starts tracking as the config wants and this machine allows.
    ///
    /// # Errors
    /// Where the instance's name cannot be stored, or groups are required and not available.
    pub(super) fn start(config: &ProcessManagerConfig, directory: &RuntimeDirectory) -> anyhow::Result<Tracker> {
        let instance = instance_of(directory)?;
        let groups = match (config.tracking, &config.cgroup) {
            (Tracking::Environment, None) => Err("`tracking` says so".to_owned()),
            (_, Some(named)) => Ok((named.clone(), false)),
            (_, None) => own_group::make(&format!("ratn-{instance}")).map(|made| (made, true)),
        };
        if let (Tracking::Cgroup, Err(why)) = (config.tracking, &groups) {
            let rule = format!("no group of cgroup v2 can be made: {why}; name one in `cgroup`, or say `auto`");
            return Err(ConfigError::Rule { key: "tracking".to_owned(), rule }.into());
        }
        let children = config.owns_process.then(Children::adopt).transpose()?;
        let accounts = config.templates.iter().filter_map(|template| Account::named(template.user.as_deref()?).ok());
        let users = accounts.map(|account| account.uid.as_raw()).chain([geteuid().as_raw()]).collect();
        let tracker = match groups {
            Ok((groups, made)) => Tracker { instance, groups: Some(groups), made, users, children },
            Err(why) => {
                let tracker = Tracker { instance, groups: None, made: false, users, children };
                tracing::warn!("{}; no groups: {why}", tracker.words());
                return Ok(tracker);
            }
        };
        tracing::info!("{}", tracker.words());
        Ok(tracker)
    }

    /// How processes are tracked.
    pub(super) fn mode(&self) -> TrackingMode {
        match (&self.groups, &self.children) {
            (Some(_), _) => TrackingMode::Cgroup,
            (None, Some(_)) => TrackingMode::Subreaper,
            (None, None) => TrackingMode::Marker,
        }
    }

    /// How processes are tracked, for people.
    pub(super) fn words(&self) -> String {
        match (self.mode(), &self.groups) {
            (TrackingMode::Cgroup, Some(groups)) => format!("workers are tracked by cgroups in {}", groups.display()),
            (TrackingMode::Subreaper, _) => "workers are tracked by their environment, without cgroups: what clears it and leaves its session ends \
                                when the process manager stops, and outlives one that is killed"
                .to_owned(),
            _ => "workers are tracked by their environment, without cgroups: what clears it and leaves its session is not \
                             found"
                .to_owned(),
        }
    }

    /// The directory of a worker's group.
    pub(super) fn group_of(&self, id: &str) -> Option<PathBuf> {
        self.groups.as_ref().map(|groups| groups.join(id))
    }

    /// The directory for groups that are only for tracking.
    pub(super) fn groups(&self) -> Option<PathBuf> {
        self.groups.clone()
    }

    /// The marker variable of a worker's processes.
    pub(super) fn environment(&self, id: &str) -> (OsString, OsString) {
        marker::of(&self.instance, id)
    }

    /// The children that this process started, where it has to tell orphans from them.
    pub(super) fn children(&self) -> Option<Children> {
        self.children.clone()
    }

    /// Ends all remaining processes of a worker. Scans every process of this machine.
    pub(super) fn end_worker(&self, id: &str) {
        self.end_marked(|of| of == id);
    }

    /// Ends unknown processes that an earlier process manager started: all but those of these workers.
    pub(super) fn end_all_but(&self, kept: &BTreeSet<&str>) {
        let ended = self.end_marked(|of| !kept.contains(of));
        if ended > 0 {
            tracing::warn!(ended, "processes that the last process manager had started and nobody knew are ended");
        }
        for group in self.left_groups().filter(|group| !kept.contains(name_of(group))) {
            end_group(&group);
        }
    }

    /// Ends all processes, and removes the directory that it made.
    pub(super) fn end(&self) {
        self.end_marked(|_| true);
        self.left_groups().for_each(|group| end_group(&group));
        if let Some(children) = &self.children {
            children.end_orphans(KILL_PATIENCE);
        }
        if let Some(groups) = self.groups.as_ref().filter(|_| self.made) {
            let _ = std::fs::remove_dir(groups);
        }
    }

    /// The remaining groups in a directory that belongs to this process manager alone.
    fn left_groups(&self) -> impl Iterator<Item = PathBuf> {
        let groups = self.groups.as_ref().filter(|_| self.made);
        let entries = groups.and_then(|groups| std::fs::read_dir(groups).ok());
        let entries = entries.into_iter().flatten().flatten();
        entries.filter(|entry| entry.file_type().is_ok_and(|is| is.is_dir())).map(|entry| entry.path())
    }

    /// Kills until no process is left that could have started more, and none whose marker cannot be read yet; returns their number.
    fn end_marked(&self, of: impl Fn(&str) -> bool) -> usize {
        let (begin, mut ended) = (Instant::now(), BTreeSet::new());
        loop {
            let marker::Carriers { found, unknown } = marker::carriers(&self.instance, &self.users, &of);
            if found.is_empty() && unknown.is_empty() {
                return ended.len();
            }
            if begin.elapsed() > KILL_PATIENCE {
                tracing::error!(pids = ?found, ?unknown, "processes of workers do not end, or do not show whose they are");
                return ended.len();
            }
            for pid in found {
                ended.insert(pid);
                orphans::kill(pid);
            }
            std::thread::sleep(LOOK_AGAIN);
        }
    }
}

/// How workers would be tracked if a process manager with this config ran as this process does, for people.
///
/// # Errors
/// Why there are no groups, for people.
pub fn here(config: &ProcessManagerConfig) -> Result<String, String> {
    match (config.tracking, &config.cgroup) {
        (Tracking::Environment, None) => Err("`tracking` says `environment`".to_owned()),
        (_, Some(named)) => Ok(named.display().to_string()),
        (_, None) => {
            let probe = own_group::make(&format!("ratn-probe-{}", std::process::id()))?;
            let _ = std::fs::remove_dir(&probe);
            Ok(probe.parent().unwrap_or(&probe).display().to_string())
        }
    }
}

fn name_of(group: &Path) -> &str {
    group.file_name().and_then(|name| name.to_str()).unwrap_or_default()
}

/// A name shared by all successive process managers of a runtime directory.
fn instance_of(directory: &RuntimeDirectory) -> io::Result<String> {
    let file = directory.path().join("process-manager.instance");
    match std::fs::read_to_string(&file) {
        Ok(known) if marker::is_name(known.trim()) => Ok(known.trim().to_owned()),
        _ => {
            let fresh = fresh_id("pm");
            std::fs::write(&file, &fresh)?;
            Ok(fresh)
        }
    }
}
