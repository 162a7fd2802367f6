//! The limit of open files (`RLIMIT_NOFILE`). A process manager needs a dozen for each worker, so it raises its limit as far as it may:
//! its soft limit becomes the hard one. Its workers get back what it was started with, where their template says nothing else: a
//! program that looks at every number up to its limit, or waits with `select(2)`, is not to find another world under it.

use rustix::process::{Pid, Resource, Rlimit, getrlimit, prlimit, setrlimit};
use std::io;
use std::sync::OnceLock;

/// As this process was started.
static FOUND: OnceLock<Rlimit> = OnceLock::new();

/// Raises the soft limit of this process to the hard one.
///
/// # Errors
/// What the kernel says.
pub(super) fn raise() -> io::Result<()> {
    let found = *FOUND.get_or_init(|| getrlimit(Resource::Nofile));
    let all = Rlimit { current: found.maximum, maximum: found.maximum };
    Ok(setrlimit(Resource::Nofile, all)?)
}

/// Gives a process that this one has just started the limit that this one was started with.
///
/// # Errors
/// What the kernel says.
pub(super) fn give_back(pid: u32) -> io::Result<()> {
    let Some(found) = FOUND.get() else { return Ok(()) };
    let pid = i32::try_from(pid).ok().and_then(Pid::from_raw).ok_or(rustix::io::Errno::SRCH)?;
    Ok(prlimit(Some(pid), Resource::Nofile, *found).map(drop)?)
}
