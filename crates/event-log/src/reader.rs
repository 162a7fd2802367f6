//! Reads an event log: as a whole, from a position on, line by line, or as it grows.

use crate::pieces::{self, Joined};
use crate::{LogError, MAX_LINE_BYTES, USUAL_BYTES};
use ratn_executive::protocol::{Command, Event, LogEntry, LogLine};
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// The content of an event log.
#[derive(Debug)]
pub struct Log {
    /// The complete lines that were read.
    pub lines: Vec<LogLine>,
    /// Number of earlier lines, which were not read.
    pub before: usize,
    /// The number of the last line if it is torn; that line is not in `lines`.
    pub torn: Option<usize>,
    /// Number of bytes and lines in the log up to the end of what was read.
    pub whole: u64,
    pub(crate) read: usize,
}

/// Reads a whole event log.
///
/// # Errors
/// [`LogError`], which names the line.
pub fn read(path: &Path) -> Result<Log, LogError> {
    let log = read_from(path, 0, 0, usize::MAX)?;
    if log.lines.is_empty() {
        return Err(LogError::Empty { path: path.to_owned() });
    }
    Ok(log)
}

/// Reads what follows the first `bytes`, which are `lines` lines.
///
/// # Errors
/// As [`read`].
pub fn read_behind(path: &Path, bytes: u64, lines: usize) -> Result<Log, LogError> {
    read_from(path, bytes, lines, usize::MAX)
}

/// Reads the first line.
///
/// # Errors
/// As [`read`].
pub fn first(path: &Path) -> Result<LogLine, LogError> {
    read_from(path, 0, 0, 1)?.lines.pop().ok_or_else(|| LogError::Empty { path: path.to_owned() })
}

fn read_from(path: &Path, bytes: u64, before: usize, at_most: usize) -> Result<Log, LogError> {
    let mut all = Lines::open(path, bytes, before)?;
    let lines = all.by_ref().take(at_most).collect::<Result<Vec<LogLine>, LogError>>()?;
    Ok(Log { lines, before, torn: all.torn, whole: all.whole, read: all.read })
}

/// Follows an event log that grows.
#[derive(Debug)]
pub struct Tail {
    path: PathBuf,
    bytes: u64,
    lines: usize,
}

impl Tail {
    /// Follows a log that may not exist yet.
    pub fn of(path: &Path) -> Tail {
        Tail { path: path.to_owned(), bytes: 0, lines: 0 }
    }

    /// The complete lines that were written since the last call.
    ///
    /// # Errors
    /// As [`read`].
    pub fn more(&mut self) -> Result<Vec<LogLine>, LogError> {
        if !self.path.exists() {
            return Ok(Vec::new());
        }
        let log = read_behind(&self.path, self.bytes, self.lines)?;
        (self.bytes, self.lines) = (log.whole, log.read);
        Ok(log.lines)
    }
}

/// Reads an event log line by line, with one entry in memory. A torn last line is ignored.
#[derive(Debug)]
pub struct Lines {
    path: PathBuf,
    reader: BufReader<File>,
    read: usize,
    whole: u64,
    torn: Option<usize>,
    text: Vec<u8>,
    is_over: bool,
}

impl Lines {
    /// Reads a whole log.
    ///
    /// # Errors
    /// The log cannot be read.
    pub fn of(path: &Path) -> Result<Lines, LogError> {
        Lines::open(path, 0, 0)
    }

    /// Reads what follows the first `bytes`, which are `lines` lines: a line must begin there.
    ///
    /// # Errors
    /// The log cannot be read.
    pub fn behind(path: &Path, bytes: u64, lines: usize) -> Result<Lines, LogError> {
        Lines::open(path, bytes, lines)
    }

    /// Number of bytes and lines before the next line.
    pub fn position(&self) -> (u64, usize) {
        (self.whole, self.read)
    }

    /// The number of the last line if it is torn; known when all others have been read.
    pub fn torn(&self) -> Option<usize> {
        self.torn
    }

    fn open(path: &Path, bytes: u64, before: usize) -> Result<Lines, LogError> {
        let io = |source| LogError::Io { what: "read", path: path.to_owned(), source };
        let mut file = ratn_regular_file::open(path).map_err(io)?;
        if bytes > 0 {
            file.seek(SeekFrom::Start(bytes)).map_err(io)?;
        }
        let (reader, path) = (BufReader::new(file), path.to_owned());
        Ok(Lines { path, reader, read: before, whole: bytes, torn: None, text: Vec::new(), is_over: false })
    }

    /// The next event or command, with all its pieces joined.
    fn entry(&mut self) -> Result<Option<LogLine>, LogError> {
        let first = self.read + 1;
        let Some(mut length) = self.line(first)? else { return Ok(None) };
        let mut read = first;
        if pieces::is_one(&self.text) {
            let mut entire = Joined::default();
            while !entire.add(&self.text).map_err(|reason| self.foreign(read, reason))? {
                read += 1;
                let Some(more) = self.line(read)? else {
                    self.torn = Some(first);
                    return Ok(None);
                };
                length += more;
            }
            self.text = entire.into_text();
        }
        let parsed: LogLine =
            serde_json::from_slice(&self.text).map_err(|error| self.foreign(first, explain(&self.text, &error)))?;
        if self.whole == 0 && !matches!(parsed.entry, LogEntry::Event(Event::Started { .. })) {
            return Err(self.foreign(first, "an event log begins with the event `started`".into()));
        }
        self.read = read;
        self.whole += length;
        self.text.shrink_to(USUAL_BYTES);
        Ok(Some(parsed))
    }

    /// Reads a complete line, which has this number; returns its length.
    fn line(&mut self, line: usize) -> Result<Option<u64>, LogError> {
        self.text.clear();
        let limit = MAX_LINE_BYTES as u64 + 1;
        let length = self.reader.by_ref().take(limit).read_until(b'\n', &mut self.text);
        let length = length.map_err(|source| LogError::Io { what: "read", path: self.path.clone(), source })?;
        if self.text.last() == Some(&b'\n') {
            return Ok(Some(length as u64));
        }
        if length as u64 == limit {
            return Err(self.foreign(line, format!("longer than {MAX_LINE_BYTES} bytes")));
        }
        if length > 0 {
            self.torn = Some(line);
        }
        Ok(None)
    }

    fn foreign(&self, line: usize, reason: String) -> LogError {
        LogError::Foreign { path: self.path.clone(), line, reason }
    }
}

impl Iterator for Lines {
    type Item = Result<LogLine, LogError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.is_over {
            return None;
        }
        let line = self.entry().transpose();
        self.is_over = !matches!(line, Some(Ok(_)));
        line
    }
}

/// An error message for a line: serde's message for an untagged enum says nothing, this one names the entry's claimed kind.
fn explain(text: &[u8], error: &serde_json::Error) -> String {
    let Ok(value) = serde_json::from_slice::<serde_json::Value>(text) else {
        return format!("not JSON: {error}");
    };
    if value.get("at").is_none() {
        return "it has no time `at`".into();
    }
    let known = ["event", "command"].iter().find_map(|key| Some((*key, value.get(key)?)));
    match known {
        Some(("event", _)) => said(serde_json::from_value::<Event>(value.clone()).err(), "event"),
        Some((_, _)) => said(serde_json::from_value::<Command>(value.clone()).err(), "command"),
        None => "it has neither `event` nor `command`".into(),
    }
}

fn said(error: Option<serde_json::Error>, what: &str) -> String {
    error.map_or_else(|| format!("not a {what} of this version"), |error| format!("not a known {what}: {error}"))
}
