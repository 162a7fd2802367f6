//! Writes an event log: lines are buffered, handed to the operating system, and synced to disk. One process writes a log.

use crate::pieces;
use crate::{Log, LogError, MAX_ENTRY_BYTES, MAX_LINE_BYTES, MAX_LOG_BYTES, USUAL_BYTES};
use ratn_executive::protocol::{Command, Event};
use ratn_model::time::Timestamp;
use serde::Serialize;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Writes an event log.
#[derive(Debug)]
pub struct LogWriter {
    path: PathBuf,
    file: File,
    /// Number of bytes and lines written.
    written: u64,
    lines: usize,
    /// Number of lines that are buffered and not yet written.
    noted: usize,
    /// Whether the log is a file on disk, which can be synced.
    on_disk: bool,
    /// Whether the torn line at the end has been cut off.
    is_cut: bool,
    /// The buffered lines.
    text: Vec<u8>,
}

/// A [`LogLine`] in the form in which it is written, without copies.
#[derive(Serialize)]
pub(crate) struct Written<'a, T> {
    pub(crate) at: Timestamp,
    #[serde(flatten)]
    pub(crate) entry: &'a T,
}

impl LogWriter {
    /// Creates the file; a file that is not empty stays unchanged.
    pub fn create(path: &Path) -> Result<Self, LogError> {
        let mut writer = LogWriter::open(path, OpenOptions::new().write(true).create(true).truncate(false), "create")?;
        let length = writer.file.metadata().map_err(|source| writer.io(source))?.len();
        if writer.on_disk && length > 0 {
            return Err(LogError::There { path: path.to_owned() });
        }
        writer.is_cut = true;
        if writer.on_disk {
            // The file's directory entry has to be synced, too.
            let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
            File::open(folder).and_then(|folder| folder.sync_all()).map_err(|source| writer.io(source))?;
        }
        Ok(writer)
    }

    /// Opens a log in order to continue it: from now on no other process can write it. [`LogWriter::go_on_behind`] sets the position.
    pub fn go_on(path: &Path) -> Result<Self, LogError> {
        let mut writer = LogWriter::open(path, OpenOptions::new().append(true), "go on with")?;
        writer.written = writer.file.metadata().map_err(|source| writer.io(source))?.len();
        Ok(writer)
    }

    /// Continues after the complete lines of the log that was read. A torn line is cut off before the first line is written.
    pub fn go_on_behind(&mut self, log: &Log) {
        (self.written, self.lines) = (log.whole, log.read);
    }

    /// The log's path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Whether the log is a file on disk, which can be read again.
    pub fn is_on_disk(&self) -> bool {
        self.on_disk
    }

    /// Number of bytes in the log.
    pub fn written(&self) -> u64 {
        self.written
    }

    /// Number of lines in the log.
    pub fn lines(&self) -> usize {
        self.lines
    }

    fn open(path: &Path, options: &mut OpenOptions, what: &'static str) -> Result<Self, LogError> {
        let io = |source| LogError::Io { what, path: path.to_owned(), source };
        let file = ratn_regular_file::open_to_write(path, options).map_err(io)?;
        let on_disk = file.metadata().map_err(io)?.is_file();
        if on_disk {
            file.try_lock().map_err(|error| match error {
                TryLockError::WouldBlock => LogError::UnderWay { path: path.to_owned() },
                TryLockError::Error(source) => io(source),
            })?;
        }
        Ok(LogWriter {
            path: path.to_owned(),
            file,
            written: 0,
            lines: 0,
            noted: 0,
            on_disk,
            is_cut: false,
            text: Vec::new(),
        })
    }

    fn cut(&mut self) -> Result<(), LogError> {
        if self.on_disk && !self.is_cut {
            self.file.set_len(self.written).map_err(|source| self.io(source))?;
        }
        self.is_cut = true;
        Ok(())
    }

    /// Writes an event and the commands that were decided on it, and hands them to the operating system. If they cannot be written in a
    /// readable form, nothing is written.
    pub fn append(&mut self, at: Timestamp, event: &Event, commands: &[Command]) -> Result<(), LogError> {
        self.note(at, event, commands)?;
        self.write()
    }

    /// Writes further commands decided on the last event, as [`LogWriter::append`] does.
    pub fn append_commands(&mut self, at: Timestamp, commands: &[Command]) -> Result<(), LogError> {
        self.add(at, None, commands)?;
        self.write()
    }

    /// As [`LogWriter::append`], but buffers the lines until [`LogWriter::write`].
    pub fn note(&mut self, at: Timestamp, event: &Event, commands: &[Command]) -> Result<(), LogError> {
        self.add(at, Some(event), commands)
    }

    fn add(&mut self, at: Timestamp, event: Option<&Event>, commands: &[Command]) -> Result<(), LogError> {
        let (before, noted) = (self.text.len(), self.noted);
        let added = event.map_or(Ok(()), |event| self.add_entry(&Written { at, entry: event }));
        let added = added.and_then(|()| {
            commands.iter().try_for_each(|command| self.add_entry(&Written { at, entry: command }))?;
            if self.written + self.text.len() as u64 > MAX_LOG_BYTES {
                return Err(LogError::TooLong { path: self.path.clone() });
            }
            Ok(())
        });
        if added.is_err() {
            self.text.truncate(before);
            self.noted = noted;
        }
        added
    }

    /// A second handle of the file, to sync it while more is written; `None` if the log is not on disk.
    ///
    /// # Errors
    /// The system cannot open another file.
    pub fn handle(&self) -> Result<Option<File>, LogError> {
        let handle = || self.file.try_clone().map_err(|source| self.io(source));
        self.on_disk.then(handle).transpose()
    }

    /// Returns when everything written so far would survive a loss of power.
    pub fn make_durable(&mut self) -> Result<(), LogError> {
        if self.on_disk {
            self.file.sync_data().map_err(|source| self.io(source))?;
        }
        Ok(())
    }

    fn add_entry(&mut self, entry: &Written<'_, impl Serialize>) -> Result<(), LogError> {
        let begins = self.text.len();
        serde_json::to_writer(&mut self.text, entry).map_err(|source| self.io(source.into()))?;
        let bytes = self.text.len() - begins;
        if bytes > MAX_ENTRY_BYTES {
            return Err(LogError::TooMuchAtOnce { path: self.path.clone(), what: named(&self.text[begins..]), bytes });
        }
        if bytes <= MAX_LINE_BYTES {
            self.text.push(b'\n');
            self.noted += 1;
            return Ok(());
        }
        let entire = String::from_utf8(self.text.split_off(begins));
        let entire = entire.map_err(|error| self.io(std::io::Error::other(error)))?;
        self.noted += pieces::write(&mut self.text, entry.at, &entire).map_err(|source| self.io(source))?;
        Ok(())
    }

    /// Hands the buffered lines to the operating system.
    pub fn write(&mut self) -> Result<(), LogError> {
        if self.noted == 0 {
            return Ok(());
        }
        self.cut()?;
        self.written += self.text.len() as u64;
        self.lines += std::mem::take(&mut self.noted);
        let written = self.file.write_all(&self.text);
        self.text.clear();
        self.text.shrink_to(USUAL_BYTES);
        written.map_err(|source| self.io(source))
    }

    fn io(&self, source: std::io::Error) -> LogError {
        LogError::Io { what: "write", path: self.path.clone(), source }
    }
}

/// The name of an entry, for example `event finished`, from the beginning of its line.
fn named(line: &[u8]) -> String {
    let beginning = String::from_utf8_lossy(&line[..line.len().min(100)]);
    let named = ["event", "command"].iter().find_map(|what| {
        let (_, name) = beginning.split_once(&format!("\"{what}\":\""))?;
        Some(format!("{what} {}", name.split_once('"')?.0))
    });
    named.unwrap_or_else(|| "line".to_owned())
}
