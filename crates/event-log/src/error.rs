//! Why an event log cannot be written or read.

use crate::{MAX_ENTRY_BYTES, MAX_LOG_BYTES};
use std::path::PathBuf;

/// Why an event log cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// A call of the operating system failed.
    #[error("cannot {what} the event log {}", path.display())]
    Io {
        /// The operation.
        what: &'static str,
        /// The log.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A new log would replace a file that is not empty.
    #[error("{} is there already, nothing is written over it", path.display())]
    There {
        /// The file.
        path: PathBuf,
    },
    /// Another process writes the log.
    #[error("the event log {} is being written by a run that is under way", path.display())]
    UnderWay {
        /// The log.
        path: PathBuf,
    },
    /// The log has reached its maximum size.
    #[error("the event log {} would grow beyond {MAX_LOG_BYTES} bytes; the run ends here", path.display())]
    TooLong {
        /// The log.
        path: PathBuf,
    },
    /// An event or a command exceeds what a reader accepts.
    #[error(
        "the {what} has {bytes} bytes in the event log {}, and at most {MAX_ENTRY_BYTES} can be read again{}; the run ends here, and nothing \
         is done that follows from it",
        path.display(),
        if what == "event started" { " (it says every fact of the world pool: delete what is not needed, or begin anew with `ratn reset`)" }
        else { "" }
    )]
    TooMuchAtOnce {
        /// The log.
        path: PathBuf,
        /// The event or command, by its name in the log.
        what: String,
        /// Its length in bytes.
        bytes: usize,
    },
    /// A line cannot be read.
    #[error("{}:{line}: not a line of an event log: {reason}", path.display())]
    Foreign {
        /// The file.
        path: PathBuf,
        /// The line's number, from 1.
        line: usize,
        /// What is wrong with it.
        reason: String,
    },
    /// A line that was looked up has no time.
    #[error("{} at byte {offset}: not a line of an event log: {reason}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The offset at which the line begins.
        offset: u64,
        /// What is wrong with it.
        reason: String,
    },
    /// The log has no complete line.
    #[error("{} has no whole line: an event log begins with the event `started`", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
}
