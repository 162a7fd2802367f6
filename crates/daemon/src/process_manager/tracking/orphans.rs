//! Orphans: processes whose parent has ended and that become children of this process, their subreaper (`PR_SET_CHILD_SUBREAPER`). Only for a
//! process that is nothing but a process manager: a child that it did not start itself comes from a worker.

use nix::errno::Errno;
use nix::sys::prctl::set_child_subreaper;
use nix::sys::signal::Signal;
use nix::sys::wait::{WaitPidFlag, waitpid};
use nix::unistd::Pid;
use std::collections::BTreeSet;
use std::io;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

const LOOK_AGAIN: Duration = Duration::from_millis(2);

/// The processes that this process started itself and waits for.
#[derive(Debug, Clone, Default)]
pub(in crate::process_manager) struct Children(Arc<Mutex<BTreeSet<u32>>>);

impl Children {
    /// From here on orphans become children of this process.
    pub(super) fn adopt() -> io::Result<Children> {
        set_child_subreaper(true)?;
        Ok(Children::default())
    }

    /// Starts a process, which is never taken for an orphan in between.
    pub(in crate::process_manager) fn starting<T>(
        &self,
        start: impl FnOnce() -> io::Result<(T, u32)>,
    ) -> io::Result<T> {
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let (started, pid) = start()?;
        known.insert(pid);
        Ok(started)
    }

    /// A process that this one started has ended and was waited for.
    pub(in crate::process_manager) fn ended(&self, pid: u32) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).remove(&pid);
    }

    /// Reaps orphans that have ended: the kernel keeps them as zombies until their parent waits for them.
    pub(in crate::process_manager) fn reap(&self) {
        self.orphans(reap_one);
    }

    /// Kills all orphans, also those that become orphans by that.
    pub(super) fn end_orphans(&self, patience: Duration) {
        let begin = Instant::now();
        loop {
            let found = self.orphans(|pid| {
                kill(pid);
                reap_one(pid);
            });
            if found == 0 {
                return;
            }
            if begin.elapsed() > patience {
                return tracing::error!(found, "processes that workers left do not end");
            }
            std::thread::sleep(LOOK_AGAIN);
        }
    }

    /// Applies `act` to each orphan; returns their number.
    fn orphans(&self, mut act: impl FnMut(u32)) -> usize {
        let known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let orphans: Vec<u32> =
            children_of(std::process::id()).into_iter().filter(|pid| !known.contains(pid)).collect();
        orphans.iter().for_each(|pid| act(*pid));
        orphans.len()
    }
}

/// `kill -9`.
pub(super) fn kill(pid: u32) {
    let Some(pid) = i32::try_from(pid).ok().filter(|pid| *pid > 1) else { return };
    match nix::sys::signal::kill(Pid::from_raw(pid), Signal::SIGKILL) {
        Ok(()) | Err(Errno::ESRCH) => {}
        Err(error) => tracing::warn!(pid, %error, "a process of a worker cannot be ended"),
    }
}

/// Does nothing where the process has not ended.
fn reap_one(pid: u32) {
    if let Ok(pid) = i32::try_from(pid) {
        let _ = waitpid(Pid::from_raw(pid), Some(WaitPidFlag::WNOHANG));
    }
}

fn children_of(parent: u32) -> Vec<u32> {
    let Ok(entries) = std::fs::read_dir("/proc") else { return Vec::new() };
    let pids = entries.flatten().filter_map(|entry| entry.file_name().to_str()?.parse().ok());
    pids.filter(|pid| parent_of(*pid) == Some(parent)).collect()
}

/// Field 4 of `proc_pid_stat(5)`; `None` for a process that does not exist.
pub(super) fn parent_of(pid: u32) -> Option<u32> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    stat.rsplit_once(')')?.1.split_whitespace().nth(1)?.parse().ok()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn a_parent_is_read_and_of_nobody_there_is_none() {
        let mut child = std::process::Command::new("sleep").arg("60").spawn().unwrap();
        assert_eq!(parent_of(child.id()), Some(std::process::id()));
        assert!(children_of(std::process::id()).contains(&child.id()));
        child.kill().unwrap();
        child.wait().unwrap();
        assert_eq!(parent_of(child.id()), None);
    }
}
