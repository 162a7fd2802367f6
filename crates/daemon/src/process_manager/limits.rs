//! What a worker may use of the machine: kept by a group of cgroup v2 of its own where the config names a directory for them, else by
//! the limits of its process (`setrlimit(2)`), as far as these go. What is in force is said, never assumed.
//!
//! They are set right after the process is started: nothing may run in the child before its program does.

use crate::config::{ConfigError, rule};
use rustix::process::{Pid, Resource, Rlimit, prlimit};
use serde::{Deserialize, Serialize};
use std::io;
use std::path::{Path, PathBuf};

/// What the time of `cpus` is counted over, in microseconds.
const PERIOD_US: u64 = 100_000;
const MIB: u64 = 1 << 20;

/// All keys are optional; without one there is no limit.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// Memory, in MiB: of a group all that it uses; of a process its data.
    pub memory_mib: Option<u64>,
    /// Processors; needs a group.
    pub cpus: Option<f64>,
    /// Processes and threads; needs a group.
    pub processes: Option<u64>,
    /// Files open at once.
    pub open_files: Option<u64>,
}

/// What is in force for a worker; its group goes with this.
#[derive(Debug, Default)]
pub(super) struct InForce {
    words: Vec<String>,
    group: Option<Group>,
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

    /// Puts them on a process that has just been started; `groups` is where groups are made.
    pub(super) fn enforce(&self, id: &str, pid: u32, groups: Option<&Path>) -> InForce {
        let mut force = InForce::default();
        let grouped = groups.filter(|_| self.memory_mib.or(self.processes).is_some() || self.cpus.is_some());
        let grouped = grouped.map(|groups| self.group(groups, id, pid));
        match grouped {
            Some(Ok(group)) => {
                force.group = Some(group);
                force.words.extend(self.memory_mib.map(|mib| format!("memory {mib} MiB (cgroup)")));
                force.words.extend(self.cpus.map(|cpus| format!("{cpus} cpus (cgroup)")));
                force.words.extend(self.processes.map(|count| format!("{count} processes (cgroup)")));
            }
            failed => {
                if let Some(Err(error)) = failed {
                    tracing::warn!(id, %error, "no group for a worker");
                }
                force.limit(pid, Resource::Data, self.memory_mib.map(|mib| mib * MIB), |_| {
                    format!("data {} MiB (rlimit)", self.memory_mib.unwrap_or_default())
                });
                force.words.extend(self.cpus.map(|_| "cpus not limited: no cgroup".to_owned()));
                force.words.extend(self.processes.map(|_| "processes not limited: no cgroup".to_owned()));
            }
        }
        force.limit(pid, Resource::Nofile, self.open_files, |count| format!("{count} open files (rlimit)"));
        force
    }

    /// A group with these limits, and the process in it.
    fn group(&self, groups: &Path, id: &str, pid: u32) -> io::Result<Group> {
        let group = Group { path: groups.join(id) };
        std::fs::create_dir_all(&group.path)?;
        let write = |file: &str, text: String| {
            let path = group.path.join(file);
            std::fs::write(&path, text)
                .map_err(|error| io::Error::new(error.kind(), format!("{}: {error}", path.display())))
        };
        if let Some(mib) = self.memory_mib {
            write("memory.max", (mib * MIB).to_string())?;
            write("memory.swap.max", "0".to_owned()).or_else(|error| match error.kind() {
                // A kernel without accounting of swap.
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

impl InForce {
    /// Those of a worker that was taken over, whose group goes with this.
    pub(super) fn adopted(group: Option<PathBuf>) -> InForce {
        InForce { words: Vec::new(), group: group.map(|path| Group { path }) }
    }

    /// The directory of its group.
    pub(super) fn group(&self) -> Option<&Path> {
        self.group.as_ref().map(|group| group.path.as_path())
    }

    /// In words, for people; empty without limits.
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

impl Drop for Group {
    fn drop(&mut self) {
        end_group(&self.path);
    }
}

/// What a worker started and left behind ends with it. The group is gone where nobody is left.
pub(super) fn end_group(path: &Path) {
    let _ = std::fs::write(path.join("cgroup.kill"), "1");
    if let Err(error) = std::fs::remove_dir(path) {
        tracing::debug!(group = %path.display(), %error, "a group of a worker stays");
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    const ALL: Limits = Limits { memory_mib: Some(64), cpus: Some(1.5), processes: Some(8), open_files: Some(100) };

    fn child() -> std::process::Child {
        std::process::Command::new("sleep").arg("60").spawn().unwrap()
    }

    #[test]
    fn without_groups_the_process_itself_is_limited_and_what_is_not_is_said() {
        let mut child = child();
        let force = ALL.enforce("planner-1@compute", child.id(), None);
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

    /// A directory that takes what is written; which groups the kernel makes of it is the kernel's business.
    #[test]
    fn with_groups_each_worker_has_one_of_its_own() {
        let groups = tempfile::tempdir().unwrap();
        let mut child = child();
        let force = ALL.enforce("planner-1@compute", child.id(), Some(groups.path()));
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
        let force = ALL.enforce("planner-1@compute", child.id(), Some(Path::new("/proc/no/groups")));
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(force.words().starts_with("data 64 MiB (rlimit)"), "{}", force.words());
    }
}
