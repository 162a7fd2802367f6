//! The output of a command: progress for people on standard error, results on standard output.
//!
//! Nothing depends on progress output, so a closed or full terminal ends no run. A result that cannot be written is an error, except
//! when its reader has closed the pipe (`ratn report LOG | head`).

use crate::failure::Failure;
use crate::fitted::{rows, visible};
use nix::errno::Errno;
use nix::unistd::{AccessFlags, access};
use ratn_model::readable::readable;
use ratn_task_control::Messages;
use std::borrow::Cow;
use std::fmt::Display;
use std::io::{self, ErrorKind, Write};
use std::path::Path;
use std::sync::{Mutex, PoisonError};

/// The state of progress output.
static PROGRESS: Mutex<Progress> = Mutex::new(Progress { is_quiet: false, area: Vec::new() });

struct Progress {
    is_quiet: bool,
    /// The number of characters in each repainted line at the end of the terminal.
    area: Vec<usize>,
}

/// Writes a line to standard error, above the painted lines.
pub(crate) fn progress(line: impl Display) {
    let mut progress = PROGRESS.lock().unwrap_or_else(PoisonError::into_inner);
    if !progress.is_quiet {
        let _ = io::stderr().write_all(said(&mut progress, &line.to_string()).as_bytes());
    }
}

/// Prints why the command failed, even in quiet mode.
pub(crate) fn failure(failure: &Failure) {
    let mut progress = PROGRESS.lock().unwrap_or_else(PoisonError::into_inner);
    let _ = io::stderr().write_all(said(&mut progress, &failure.to_string()).as_bytes());
}

/// Prints a usage error, or requested help. In colours, unless the text contains characters that would control the terminal.
pub(crate) fn usage(error: &clap::Error) {
    let plain = error.render().to_string();
    let _ = match readable(&plain) {
        Cow::Borrowed(_) => error.print(),
        Cow::Owned(readable) => io::stderr().write_all(readable.as_bytes()),
    };
}

/// The text of a message, with control characters escaped, because names and paths come from others.
fn said(progress: &mut Progress, message: &str) -> String {
    format!("{}{}\n", progress.cleared(), readable(message))
}

/// Suppresses progress from now on.
pub(crate) fn be_quiet() {
    PROGRESS.lock().unwrap_or_else(PoisonError::into_inner).is_quiet = true;
}

/// Paints lines at the end of the terminal at standard error, over the previously painted ones.
pub(crate) fn paint_area(lines: &[String]) {
    let mut progress = PROGRESS.lock().unwrap_or_else(PoisonError::into_inner);
    let text: String =
        std::iter::once(progress.cleared()).chain(lines.iter().map(|line| format!("{line}\n"))).collect();
    progress.area = lines.iter().map(|line| visible(line)).collect();
    let _ = io::stderr().write_all(text.as_bytes());
}

/// A line was typed below the painted lines, which have moved up a row.
pub(crate) fn area_was_pushed() {
    let mut progress = PROGRESS.lock().unwrap_or_else(PoisonError::into_inner);
    if !progress.area.is_empty() {
        progress.area.push(0);
    }
}

/// Removes the painted lines.
pub(crate) fn clear_area() {
    paint_area(&[]);
}

impl Progress {
    /// The control sequence that removes the painted lines: up to the first line, and everything from there.
    fn cleared(&mut self) -> String {
        let area = std::mem::take(&mut self.area);
        if area.is_empty() {
            return String::new();
        }
        let width = terminal_size::terminal_size_of(io::stderr()).map_or(usize::MAX, |(width, _)| usize::from(width.0));
        // If the terminal has become narrower since, longer lines are wrapped.
        let all: usize = area.iter().map(|length| rows(*length, width)).sum();
        format!("\x1b[{all}A\r\x1b[J")
    }
}

/// Passes task control's messages to [`progress`].
pub(crate) fn messages() -> Messages {
    Messages::to(|line| progress(format_args!("{line}")))
}

/// `1 fact`, `3 facts`.
pub(crate) fn counted(count: usize, noun: &str) -> String {
    let plural = if count == 1 { "" } else { "s" };
    format!("{count} {noun}{plural}")
}

/// Writes a result and a final newline to standard output.
///
/// # Errors
/// When it cannot be written. A reader that has closed the pipe is no error.
pub(crate) fn result(text: impl Display) -> anyhow::Result<()> {
    write(&mut io::stdout().lock(), &text)
}

/// As [`result`], for one of many lines: returns false once nobody reads them any more.
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

/// Checks whether a file could be written, before there is anything to write; the file is not created.
pub(crate) fn check_writable(path: &Path) -> Result<(), Failure> {
    // The appended `.` makes a path below a non-directory an error, and stands for the current folder of a bare name.
    let directory = path.parent().unwrap_or(path).join(".");
    let place = if path.exists() { path } else { &directory };
    let writable = if path.is_dir() { Err(Errno::EISDIR) } else { access(place, AccessFlags::W_OK) };
    writable.map_err(|error| Failure::Refused(format!("ratn: cannot write {}: {}", path.display(), error.desc())))
}

/// As [`check_writable`], for a file that must not replace anything: a file that is not empty is refused.
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
    fn what_a_message_names_steers_no_terminal() {
        let mut progress = Progress { is_quiet: false, area: Vec::new() };
        let failure = Failure::Refused("ratn: cannot read a\u{1b}[2Jb:\n\twhy".to_owned());
        assert_eq!(said(&mut progress, &failure.to_string()), "ratn: cannot read a\\u{1b}[2Jb:\n\twhy\n");
    }

    #[test]
    fn a_full_disk_is_an_error_and_a_reader_that_left_is_none() {
        assert!(write(&mut Broken(ErrorKind::StorageFull), &"a").is_err());
        assert!(write(&mut Broken(ErrorKind::BrokenPipe), &"a").is_ok());
    }
}
