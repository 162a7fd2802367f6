//! What a command writes: progress for people on standard error, results on standard output.
//!
//! Nothing depends on progress, so a display that is gone or full ends no run. A result that cannot be written is an
//! error, except when its reader has had enough of it (`ratn report LOG | head`).

use crate::failure::Failure;
use nix::errno::Errno;
use nix::unistd::{AccessFlags, access};
use ratn_task_control::Messages;
use std::fmt::Display;
use std::io::{self, ErrorKind, Write};
use std::path::Path;
use std::sync::{Mutex, PoisonError};

/// What is said of progress, and how.
static PROGRESS: Mutex<Progress> = Mutex::new(Progress { is_quiet: false, area: 0 });

struct Progress {
    is_quiet: bool,
    /// So many lines at the end of the terminal are painted again and again.
    area: usize,
}

/// Writes one line to standard error, if somebody is there to read it: above what is painted there.
pub(crate) fn progress(line: impl Display) {
    let mut progress = PROGRESS.lock().unwrap_or_else(PoisonError::into_inner);
    if !progress.is_quiet {
        let _ = io::stderr().write_all(format!("{}{line}\n", progress.cleared()).as_bytes());
    }
}

/// From now on nothing is said of progress.
pub(crate) fn be_quiet() {
    PROGRESS.lock().unwrap_or_else(PoisonError::into_inner).is_quiet = true;
}

/// Paints lines at the end of the terminal of standard error, over those that were painted before.
pub(crate) fn paint_area(lines: &[String]) {
    let mut progress = PROGRESS.lock().unwrap_or_else(PoisonError::into_inner);
    let text: String =
        std::iter::once(progress.cleared()).chain(lines.iter().map(|line| format!("{line}\n"))).collect();
    progress.area = lines.len();
    let _ = io::stderr().write_all(text.as_bytes());
}

/// Takes away what is painted.
pub(crate) fn clear_area() {
    paint_area(&[]);
}

impl Progress {
    /// What takes away what is painted: up to its first line, and everything from there.
    fn cleared(&mut self) -> String {
        match std::mem::take(&mut self.area) {
            0 => String::new(),
            lines => format!("\x1b[{lines}A\r\x1b[J"),
        }
    }
}

/// [`progress`], for task control.
pub(crate) fn messages() -> Messages {
    Messages::to(|line| progress(format_args!("{line}")))
}

/// Writes a result and the end of its last line to standard output.
///
/// # Errors
/// When it cannot be written. A reader that stopped reading is no error.
pub(crate) fn result(text: impl Display) -> anyhow::Result<()> {
    write(&mut io::stdout().lock(), &text)
}

/// As [`result`], for one of many lines: false once nobody reads them any more.
///
/// # Errors
/// When it cannot be written.
pub(crate) fn line(text: impl Display) -> anyhow::Result<bool> {
    let mut out = io::stdout().lock();
    match out.write_all(format!("{text}\n").as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(anyhow::Error::from(error).context("cannot write the result to standard output")),
        Ok(()) => Ok(true),
    }
}

/// Says whether a file could be written, before there is something to write to it; it is not made.
pub(crate) fn check_writable(path: &Path) -> Result<(), Failure> {
    // `.` in it makes a file that is no directory an error, and is the folder of a bare name.
    let directory = path.parent().unwrap_or(path).join(".");
    let place = if path.exists() { path } else { &directory };
    let writable = if path.is_dir() { Err(Errno::EISDIR) } else { access(place, AccessFlags::W_OK) };
    writable.map_err(|error| Failure::Refused(format!("ratn: cannot write {}: {}", path.display(), error.desc())))
}

/// As [`check_writable`], for what is not to take the place of anything: a file with something in it is refused.
pub(crate) fn check_new(path: &Path, help: &str) -> Result<(), Failure> {
    check_writable(path)?;
    match path.metadata() {
        Ok(there) if there.is_file() && there.len() > 0 => Err(Failure::Refused(format!(
            "ratn: {} is there already, nothing is written over it: {help}",
            path.display()
        ))),
        _ => Ok(()),
    }
}

fn write(to: &mut impl Write, text: &impl Display) -> anyhow::Result<()> {
    match to.write_all(format!("{text}\n").as_bytes()).and_then(|()| to.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(anyhow::Error::from(error).context("cannot write the result to standard output"))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Broken(ErrorKind);

    impl Write for Broken {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(self.0.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_full_disk_is_an_error_and_a_reader_that_left_is_none() {
        assert!(write(&mut Broken(ErrorKind::StorageFull), &"a").is_err());
        assert!(write(&mut Broken(ErrorKind::BrokenPipe), &"a").is_ok());
    }
}
