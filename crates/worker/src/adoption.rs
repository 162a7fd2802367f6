//! Adoption: a worker outlives its process manager for a while, so that a successor can take the worker over.
//!
//! ```text
//!   parent's pipe ends ─▶ waits on its socket ── a successor connects in time ──▶ that connection replaces the parent's pipe
//!                              └── none does ──▶ ends
//! ```
//! The process manager sets [`SOCKET_VARIABLE`] and [`GRACE_VARIABLE`] for workers of a template that says `adopt = true`; without them a
//! worker ends with its parent.

use std::io;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// The environment variable with the path of the socket that a worker listens on for a successor of its process manager.
pub const SOCKET_VARIABLE: &str = "RATN_ADOPT_SOCKET";
/// The environment variable with how long the worker waits for a successor, in seconds.
pub const GRACE_VARIABLE: &str = "RATN_ADOPT_GRACE_S";

/// Interval between two checks for a successor.
const LOOK_INTERVAL: Duration = Duration::from_millis(10);
/// Maximum grace.
const LONGEST_GRACE_S: f64 = 86_400.0;

/// The socket on which a worker waits for a successor.
#[derive(Debug)]
pub(crate) struct Adoption {
    listener: UnixListener,
    grace: Duration,
}

impl Adoption {
    /// The adoption that the environment variables describe; `None` without them.
    ///
    /// # Errors
    /// The socket cannot be made, or the grace is not a number of seconds.
    pub(crate) fn from_environment() -> io::Result<Option<Adoption>> {
        let variable = |name| std::env::var_os(name).filter(|value| !value.is_empty());
        let (Some(socket), Some(grace)) = (variable(SOCKET_VARIABLE), variable(GRACE_VARIABLE)) else {
            return Ok(None);
        };
        let seconds = grace.to_str().and_then(|text| text.parse::<f64>().ok());
        let seconds = seconds.filter(|seconds| (0.0..=LONGEST_GRACE_S).contains(seconds));
        let Some(seconds) = seconds else {
            return Err(io::Error::new(
                io::ErrorKind::InvalidInput,
                format!("{GRACE_VARIABLE} is no number of seconds"),
            ));
        };
        Adoption::at(PathBuf::from(socket), Duration::from_secs_f64(seconds)).map(Some)
    }

    fn at(socket: PathBuf, grace: Duration) -> io::Result<Adoption> {
        match std::fs::remove_file(&socket) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
            _ => {}
        }
        let listener = UnixListener::bind(socket)?;
        listener.set_nonblocking(true)?;
        Ok(Adoption { listener, grace })
    }

    /// Waits for a successor's connection; `None` if none comes within the grace.
    pub(crate) fn successor(&self) -> Option<UnixStream> {
        let until = Instant::now() + self.grace;
        loop {
            match self.listener.accept() {
                Ok((stream, _)) => return stream.set_nonblocking(false).ok().map(|()| stream),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                Err(error) => {
                    tracing::warn!(%error, "no successor of the process manager can be waited for");
                    return None;
                }
            }
            if Instant::now() >= until {
                return None;
            }
            std::thread::sleep(LOOK_INTERVAL);
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn who_comes_in_time_is_the_successor_and_nobody_is_waited_for_longer() {
        let directory = tempfile::tempdir().unwrap();
        let socket = directory.path().join("a.adopt");
        let adoption = Adoption::at(socket.clone(), Duration::from_millis(50)).unwrap();
        assert!(adoption.successor().is_none());
        let _early = UnixStream::connect(&socket).unwrap();
        assert!(adoption.successor().is_some(), "also one that came before it was missed");
        assert!(adoption.successor().is_none(), "once");
    }
}
