//! Limits of a worker (memory, processors, processes, files). They are enforced by a cgroup v2 group of the worker where the config names a directory for such
//! groups; else by cgroup v1 groups, one for each controller that has a directory; else by resource limits of the process (`setrlimit(2)`), as far as these go.
//! The limits that are in force are reported, never assumed.
//!
//! They are set right after the process is started, because no code of ours may run in the child before its program does.

use super::open_files;
use crate::config::{ConfigError, rule};
use rustix::process::{Pid, Resource, Rlimit, prlimit};
use serde::{Deserialize, Serialize};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Period over which the time of `cpus` is counted, in microseconds.
const PERIOD_US: u64 = 100_000;
const MIB: u64 = 1 << 20;
/// A killed process usually leaves its group within this time; it takes longer where much memory has to be freed.
const EMPTY_PATIENCE: Duration = Duration::from_millis(200);
/// Pause between two tries to remove a group.
const EMPTY_AGAIN: Duration = Duration::from_millis(1);

/// All keys are optional; without one there is no limit.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// Memory, in MiB: all memory of a group; without a group the data of the process.
    pub memory_mib: Option<u64>,
    /// Number of processors; needs a group.
    pub cpus: Option<f64>,
    /// Number of processes and threads; needs a group.
    pub processes: Option<u64>,
    /// Number of open files.
    pub open_files: Option<u64>,
}

/// Directories of cgroup v1, by controller. All keys are optional.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GroupsV1 {
    /// For `memory_mib`: `/sys/fs/cgroup/memory/ratn`.
    pub memory: Option<PathBuf>,
    /// For `cpus`.
    pub cpu: Option<PathBuf>,
    /// For `processes`.
    pub pids: Option<PathBuf>,
}

/// Directories in which groups are made.
#[derive(Debug, Clone, Default)]
pub(super) struct Groups {
    /// From the config: for limits, and to track all processes of a worker.
    pub(super) v2: Option<PathBuf>,
    pub(super) v1: GroupsV1,
    /// Used where the config has no `v2`: only to track all processes of a worker, not for limits.
    pub(super) tracking: Option<PathBuf>,
}

/// The limits in force for a worker; dropping this removes its groups.
#[derive(Debug, Default)]
pub(super) struct AppliedLimits {
    words: Vec<String>,
    groups: Vec<Group>,
}

#[derive(Debug)]
struct Group {
    path: PathBuf,
}

impl Limits {
    pub(super) fn check(&self, at: &str) -> Result<(), ConfigError> {
        let key = |name: &str| format!("{at}.{name}");
        rule(key("memory_mib"), self.memory_mib.is_none_or(|mib| (1..=1 << 30).contains(&mib)), "from 1 MiB to a PiB")?;
        rule(key("cpus"), self.cpus.is_none_or(|cpus| (0.01..=4_096.0).contains(&cpus)), "from 0.01 to 4096")?;
        rule(key("processes"), self.processes.is_none_or(|count| (1..=1 << 22).contains(&count)), "from 1 to 4194304")?;
        rule(key("open_files"), self.open_files.is_none_or(|count| (16..=1 << 30).contains(&count)), "at least 16")
    }

    /// Applies the limits to a process that has just been started.
    pub(super) fn enforce(&self, id: &str, pid: u32, groups: &Groups) -> AppliedLimits {
        let mut force = AppliedLimits::default();
        let mut missing = *self;
        if let Some(v2) = groups.v2.as_deref() {
            match self.group(v2, id, pid) {
                Ok(group) => {
                    force.say("cgroup", self);
                    force.groups.push(group);
                    missing = Limits { open_files: None, ..Limits::default() };
                }
                Err(error) => tracing::warn!(id, %error, "no group for a worker"),
            }
        }
        if let (None, Some(tracking)) = (&groups.v2, groups.tracking.as_deref()) {
            match Limits::default().group(tracking, id, pid) {
                Ok(group) => force.groups.push(group),
                Err(error) => tracing::warn!(id, %error, "no group for a worker: it is tracked by its environment"),
            }
        }
        for (place, alone) in missing.by_controller(&groups.v1) {
            match alone.group_v1(&place, id, pid) {
                Ok(group) => {
                    force.say("cgroup v1", &alone);
                    force.groups.push(group);
                    missing = missing.without(&alone);
                }
                Err(error) => tracing::warn!(id, %error, "no group of cgroup v1 for a worker"),
            }
        }
        force.limit(pid, Resource::Data, missing.memory_mib.map(|mib| mib * MIB), |bytes| {
            format!("data {} MiB (rlimit)", bytes / MIB)
        });
        force.words.extend(missing.cpus.map(|_| "cpus not limited: no cgroup".to_owned()));
        force.words.extend(missing.processes.map(|_| "processes not limited: no cgroup".to_owned()));
        force.limit(pid, Resource::Nofile, self.open_files, |count| format!("{count} open files (rlimit)"));
        if self.open_files.is_none()
            && let Err(error) = open_files::give_back(pid)
        {
            tracing::warn!(id, %error, "a worker keeps the process manager's limit of open files");
        }
        force
    }

    /// Each limit for which cgroup v1 has a directory, with that directory.
    fn by_controller(&self, v1: &GroupsV1) -> Vec<(PathBuf, Limits)> {
        let none = Limits::default();
        let memory =
            self.memory_mib.and(v1.memory.clone()).map(|place| (place, Limits { memory_mib: self.memory_mib, ..none }));
        let cpu = self.cpus.and(v1.cpu.clone()).map(|place| (place, Limits { cpus: self.cpus, ..none }));
        let pids =
            self.processes.and(v1.pids.clone()).map(|place| (place, Limits { processes: self.processes, ..none }));
        [memory, cpu, pids].into_iter().flatten().collect()
    }

    fn without(self, other: &Limits) -> Limits {
        Limits {
            memory_mib: self.memory_mib.filter(|_| other.memory_mib.is_none()),
            cpus: self.cpus.filter(|_| other.cpus.is_none()),
            processes: self.processes.filter(|_| other.processes.is_none()),
            open_files: self.open_files,
        }
    }

    /// Makes a cgroup v1 group with the one limit that is set, and moves the process into it.
    fn group_v1(&self, place: &Path, id: &str, pid: u32) -> io::Result<Group> {
        let group = Group { path: place.join(id) };
        std::fs::create_dir_all(&group.path)?;
        if let Some(mib) = self.memory_mib {
            group.write("memory.limit_in_bytes", (mib * MIB).to_string())?;
        }
        if let Some(cpus) = self.cpus {
            group.write("cpu.cfs_period_us", PERIOD_US.to_string())?;
            group.write("cpu.cfs_quota_us", (cpus * PERIOD_US as f64).round().to_string())?;
        }
        if let Some(count) = self.processes {
            group.write("pids.max", count.to_string())?;
        }
        group.write("cgroup.procs", pid.to_string())?;
        Ok(group)
    }

    /// Makes a group with these limits, and moves the process into it.
    fn group(&self, groups: &Path, id: &str, pid: u32) -> io::Result<Group> {
        let group = Group { path: groups.join(id) };
        std::fs::create_dir_all(&group.path)?;
        let write = |file: &str, text: String| group.write(file, text);
        if let Some(mib) = self.memory_mib {
            write("memory.max", (mib * MIB).to_string())?;
            write("memory.swap.max", "0".to_owned()).or_else(|error| match error.kind() {
                // The kernel has no swap accounting.
                io::ErrorKind::NotFound => Ok(()),
                _ => Err(error),
            })?;
        }
        if let Some(cpus) = self.cpus {
            write("cpu.max", format!("{} {PERIOD_US}", (cpus * PERIOD_US as f64).round()))?;
        }
        if let Some(count) = self.processes {
            write("pids.max", count.to_string())?;
        }
        write("cgroup.procs", pid.to_string())?;
        Ok(group)
    }
}

impl AppliedLimits {
    /// The limits of a worker that was taken over; dropping this removes its groups.
    pub(super) fn adopted(groups: Vec<PathBuf>) -> AppliedLimits {
        AppliedLimits { words: Vec::new(), groups: groups.into_iter().map(|path| Group { path }).collect() }
    }

    /// The directories of its groups.
    pub(super) fn groups(&self) -> Vec<PathBuf> {
        self.groups.iter().map(|group| group.path.clone()).collect()
    }

    fn say(&mut self, by: &str, limits: &Limits) {
        self.words.extend(limits.memory_mib.map(|mib| format!("memory {mib} MiB ({by})")));
        self.words.extend(limits.cpus.map(|cpus| format!("{cpus} cpus ({by})")));
        self.words.extend(limits.processes.map(|count| format!("{count} processes ({by})")));
    }

    /// Text for people; empty without limits.
    pub(super) fn words(&self) -> String {
        self.words.join(", ")
    }

    fn limit(&mut self, pid: u32, resource: Resource, most: Option<u64>, words: impl Fn(u64) -> String) {
        let Some(most) = most else { return };
        let limit = Rlimit { current: Some(most), maximum: Some(most) };
        let pid = i32::try_from(pid).ok().and_then(Pid::from_raw);
        let set = pid.ok_or(rustix::io::Errno::SRCH).and_then(|pid| prlimit(Some(pid), resource, limit));
        self.words.push(set.map_or_else(|error| format!("{}: not in force: {error}", words(most)), |_| words(most)));
    }
}

impl Group {
    fn write(&self, file: &str, text: String) -> io::Result<()> {
        let path = self.path.join(file);
        std::fs::write(&path, text)
            .map_err(|error| io::Error::new(error.kind(), format!("{}: {error}", path.display())))
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        end_group(&self.path);
    }
}

/// Kills what a worker started and left behind. The group is removed where nobody is left.
pub(super) fn end_group(path: &Path) {
    if std::fs::write(path.join("cgroup.kill"), "1").is_err() {
        // A cgroup v1 group.
        let left = std::fs::read_to_string(path.join("cgroup.procs")).unwrap_or_default();
        for pid in left.split_whitespace().filter_map(|pid| Pid::from_raw(pid.parse().ok()?)) {
            let _ = rustix::process::kill_process(pid, rustix::process::Signal::KILL);
        }
    }
    let begin = Instant::now();
    while let Err(error) = std::fs::remove_dir(path) {
        // Killed processes stay in the group until they are gone.
        if error.kind() != io::ErrorKind::ResourceBusy || begin.elapsed() > EMPTY_PATIENCE {
            return tracing::debug!(group = %path.display(), %error, "a group of a worker stays");
        }
        std::thread::sleep(EMPTY_AGAIN);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    const ALL: Limits = Limits { memory_mib: Some(64), cpus: Some(1.5), processes: Some(8), open_files: Some(100) };

    fn v2(place: &Path) -> Groups {
        Groups { v2: Some(place.to_owned()), ..Groups::default() }
    }

    #[test]
    fn of_cgroup_v1_each_controller_has_a_group_and_what_has_none_is_limited_otherwise_or_said() {
        let places = tempfile::tempdir().unwrap();
        let place = |name: &str| Some(places.path().join(name));
        let v1 = GroupsV1 { memory: place("memory"), cpu: place("cpu"), pids: None };
        let groups = Groups { v1, ..Groups::default() };
        let mut child = child();
        let force = ALL.enforce("planner-1@compute", child.id(), &groups);
        let of = |file: &str| std::fs::read_to_string(places.path().join(file)).unwrap();
        assert_eq!(of("memory/planner-1@compute/memory.limit_in_bytes"), "67108864");
        assert_eq!(of("memory/planner-1@compute/cgroup.procs"), child.id().to_string());
        assert_eq!(of("cpu/planner-1@compute/cpu.cfs_quota_us"), "150000");
        let words = "memory 64 MiB (cgroup v1), 1.5 cpus (cgroup v1), processes not limited: no cgroup, \
                     100 open files (rlimit)";
        assert_eq!(force.words(), words);
        // These are ordinary files, and the child is in none of them.
        child.kill().unwrap();
        child.wait().unwrap();
    }

    /// Uses the kernel's own groups, where this machine has them and they may be divided.
    #[test]
    fn a_group_of_the_kernel_s_cgroup_v1_holds_and_goes_with_its_worker() {
        let place = PathBuf::from(format!("/sys/fs/cgroup/pids/ratn-test-{}", std::process::id()));
        if !Path::new("/sys/fs/cgroup/pids/cgroup.procs").exists() || std::fs::create_dir(&place).is_err() {
            eprintln!("skipped: no cgroup v1 that may be divided here");
            return;
        }
        let v1 = GroupsV1 { pids: Some(place.clone()), ..GroupsV1::default() };
        let groups = Groups { v1, ..Groups::default() };
        let mut child = child();
        let force =
            Limits { processes: Some(3), ..Limits::default() }.enforce("planner-1@compute", child.id(), &groups);
        let of = |file: &str| std::fs::read_to_string(place.join("planner-1@compute").join(file)).unwrap();
        assert_eq!((force.words().as_str(), of("pids.max").trim()), ("3 processes (cgroup v1)", "3"));
        assert_eq!(of("cgroup.procs").trim(), child.id().to_string());
        end_group(&place.join("planner-1@compute"));
        assert!(!child.wait().unwrap().success(), "whoever is left in it is ended");
        drop(force);
        assert!(!place.join("planner-1@compute").exists());
        std::fs::remove_dir(&place).unwrap();
    }

    fn child() -> std::process::Child {
        std::process::Command::new("sleep").arg("60").spawn().unwrap()
    }

    #[test]
    fn without_groups_the_process_itself_is_limited_and_what_is_not_is_said() {
        let mut child = child();
        let force = ALL.enforce("planner-1@compute", child.id(), &Groups::default());
        let limits = std::fs::read_to_string(format!("/proc/{}/limits", child.id())).unwrap();
        child.kill().unwrap();
        child.wait().unwrap();
        let row = |name: &str| limits.lines().find(|line| line.starts_with(name)).unwrap().to_owned();
        assert!(row("Max data size").contains("67108864"), "{limits}");
        assert!(row("Max open files").contains("100"), "{limits}");
        let words = "data 64 MiB (rlimit), cpus not limited: no cgroup, processes not limited: no cgroup, \
                     100 open files (rlimit)";
        assert_eq!(force.words(), words);
    }

    /// An ordinary directory takes the writes; this does not test what the kernel does with them.
    #[test]
    fn with_groups_each_worker_has_one_of_its_own() {
        let groups = tempfile::tempdir().unwrap();
        let mut child = child();
        let force = ALL.enforce("planner-1@compute", child.id(), &v2(groups.path()));
        let of = |file: &str| std::fs::read_to_string(groups.path().join("planner-1@compute").join(file)).unwrap();
        assert_eq!((of("memory.max"), of("cpu.max")), ("67108864".to_owned(), "150000 100000".to_owned()));
        assert_eq!((of("pids.max"), of("cgroup.procs")), ("8".to_owned(), child.id().to_string()));
        assert!(force.words().starts_with("memory 64 MiB (cgroup), 1.5 cpus (cgroup), 8 processes (cgroup)"));
        child.kill().unwrap();
        child.wait().unwrap();
    }

    #[test]
    fn where_no_group_can_be_made_the_process_is_limited() {
        let mut child = child();
        let force = ALL.enforce("planner-1@compute", child.id(), &v2(Path::new("/proc/no/groups")));
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(force.words().starts_with("data 64 MiB (rlimit)"), "{}", force.words());
    }
}
