//! Tracks which processes belong to which worker, including those in sessions of their own, so that all of a worker ends with it, and
//! a successor of a process manager that was killed ends what nobody else knows.
//!
//! ```text
//!   intent in the roster ──▶ fork ──▶ group of cgroup v2 ──▶ `began` in the roster
//!                             └── from its first instruction on the process and all that it starts carry the marker in their environment
//! ```
//! A **group** of cgroup v2 for each worker holds whatever the worker starts, and `cgroup.kill` ends all of it: in the directory that the
//! config names, else below the process manager's own group where groups may be made there. The **marker** (`marker`) reaches what was
//! started before the process was in its group, and everything where there are no groups. Only a process that leaves its session *and*
//! clears its environment, and that without groups, is not known to be of a worker: the process manager is then its parent once the worker
//! has ended (`orphans`), and ends it when it stops.
//!
//! The lock of the roster is held by a child, too, until its program begins: a successor gets it only when every child that was being started
//! carries its marker.

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

/// Processes that are killed are gone within this; one that waits for a broken disk is not.
const KILL_PATIENCE: Duration = Duration::from_secs(2);
/// The pause between two looks whether they are.
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
    /// By their environment, also where there are groups.
    Environment,
}

/// See the module.
#[derive(Debug, Clone)]
pub(super) struct Tracker {
    /// The name of this runtime directory's process manager and its successors.
    instance: String,
    /// Where the groups of workers are made.
    groups: Option<PathBuf>,
    /// They are in a directory that this made.
    made: bool,
    /// The processes of these users are looked at.
    users: BTreeSet<u32>,
    children: Option<Children>,
}

impl Tracker {
    /// As the config says and this machine has it.
    ///
    /// # Errors
    /// Where the instance's name cannot be kept, or groups are demanded and there are none.
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

    /// Where groups are made that are for tracking alone.
    pub(super) fn groups(&self) -> Option<PathBuf> {
        self.groups.clone()
    }

    /// What a worker's processes carry.
    pub(super) fn environment(&self, id: &str) -> (OsString, OsString) {
        marker::of(&self.instance, id)
    }

    /// The children that this process started, where it is asked who the others are.
    pub(super) fn children(&self) -> Option<Children> {
        self.children.clone()
    }

    /// Ends all that is left of a worker. Looks at every process of this machine.
    pub(super) fn end_worker(&self, id: &str) {
        self.end_marked(|of| of == id);
    }

    /// Ends what a process manager before this one started and nobody knows: everything but these workers.
    pub(super) fn end_all_but(&self, kept: &BTreeSet<&str>) {
        let ended = self.end_marked(|of| !kept.contains(of));
        if ended > 0 {
            tracing::warn!(ended, "processes that the last process manager had started and nobody knew are ended");
        }
        for group in self.left_groups().filter(|group| !kept.contains(name_of(group))) {
            end_group(&group);
        }
    }

    /// Ends everything, and takes back what it made.
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

    /// Those of a directory that is this process manager's alone.
    fn left_groups(&self) -> impl Iterator<Item = PathBuf> {
        let groups = self.groups.as_ref().filter(|_| self.made);
        let entries = groups.and_then(|groups| std::fs::read_dir(groups).ok());
        let entries = entries.into_iter().flatten().flatten();
        entries.filter(|entry| entry.file_type().is_ok_and(|is| is.is_dir())).map(|entry| entry.path())
    }

    /// Kills until nobody is left who could have started more, nor anybody of whom it cannot be said; how many there were.
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

/// How the workers of a process manager of this config would be tracked if it ran as this process does, for people.
///
/// # Errors
/// Why there are no groups, in words.
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

/// The same for all process managers of a runtime directory, one after the other.
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
