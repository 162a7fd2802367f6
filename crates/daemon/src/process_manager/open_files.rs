//! The limit of open files (`RLIMIT_NOFILE`). A process manager needs a dozen for each worker, so it raises its soft limit to the hard
//! limit. Its workers get back the original limit, unless their template sets one: a program that iterates over all descriptors up to
//! its limit, or uses `select(2)`, must not find another limit than usual.

use rustix::process::{Pid, Resource, Rlimit, getrlimit, prlimit, setrlimit};
use std::io;
use std::sync::OnceLock;

/// The limit with which this process was started.
static FOUND: OnceLock<Rlimit> = OnceLock::new();

/// Raises the soft limit of this process to the hard one.
///
/// # Errors
/// The kernel's error.
pub(super) fn raise() -> io::Result<()> {
    let found = *FOUND.get_or_init(|| getrlimit(Resource::Nofile));
    let all = Rlimit { current: found.maximum, maximum: found.maximum };
    Ok(setrlimit(Resource::Nofile, all)?)
}

/// Gives a process that was just started the original limit of this process.
///
/// # Errors
/// The kernel's error.
pub(super) fn give_back(pid: u32) -> io::Result<()> {
    let Some(found) = FOUND.get() else { return Ok(()) };
    let pid = i32::try_from(pid).ok().and_then(Pid::from_raw).ok_or(rustix::io::Errno::SRCH)?;
    Ok(prlimit(Some(pid), Resource::Nofile, *found).map(drop)?)
}
