//! The event log: one JSON object per line, for every event that the executive got and every command that it gave.
//!
//! It is the single source of Gantt charts, statistics, replay and resume. So each line is written to the file before any command of its
//! event leaves the process, and synced to disk if the commands cannot be undone. The writer holds a lock on the file: no other process
//! writes it meanwhile. A reader reports which line is wrong and why; a torn last line (the writer was killed) is ignored and named.
//!
//! An entry that is too long for one line, for example the start of a run in a large world, is split into several lines (`pieces`). Readers
//! get it as one entry, and count the lines of the file.

mod parts;
mod pieces;

pub use parts::Parts;

use pieces::Joined;

use ratn_executive::protocol::{Command, Event, LogEntry, LogLine};
use ratn_model::time::Timestamp;
use serde::Serialize;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Maximum length of a line. No task makes a longer one, so a longer line was not written by `ratn`. Tests use a smaller limit to be
/// faster.
const MAX_LINE_BYTES: usize = if cfg!(test) { 1 << 20 } else { 16 << 20 };
/// Maximum length of an event or a command, all pieces together: a reader has all of it in memory.
const MAX_ENTRY_BYTES: usize = 8 * MAX_LINE_BYTES;
/// Capacity of the buffer that is kept for the next lines, however long the last ones were.
const USUAL_BYTES: usize = 64 << 10;
/// Maximum size of a log: a run whose log would grow beyond it is ended, so that it does not fill the disk.
const MAX_LOG_BYTES: u64 = 4 << 30;

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
struct Written<'a, T> {
    at: Timestamp,
    #[serde(flatten)]
    entry: &'a T,
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
    read: usize,
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

/// The path of a state, from the path of one of its visits: `place_all[2]/plan_transfer` → `place_all/plan_transfer`
pub fn without_visits(path: &str) -> String {
    let mut depth = 0_usize;
    let mut number = false;
    path.chars()
        .filter(|c| {
            depth += usize::from(*c == '[');
            number = *c == '#' || (number && c.is_ascii_digit());
            let keep = depth == 0 && !number;
            depth -= usize::from(*c == ']' && depth > 0);
            keep
        })
        .collect()
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use ratn_executive::protocol::{Mode, Note};
    use ratn_model::fact::{FactKey, Term};
    use ratn_model::id::{InstanceId, Revision};
    use ratn_model::value::Value;

    fn started() -> Event {
        Event::Started {
            task: "t".into(),
            digest: "d".into(),
            mode: Mode::Cdtn,
            parameters: Default::default(),
            seed: 7,
            world: vec![],
            revision: Revision(3),
            capacity: Default::default(),
            learned: Default::default(),
            breakpoints: Box::default(),
            origin: Default::default(),
        }
    }

    fn refusal(text: &str) -> String {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        read(file.path()).unwrap_err().to_string().replace(&file.path().display().to_string(), "LOG")
    }

    #[test]
    fn a_log_reads_back_as_written() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut log = LogWriter::create(file.path()).unwrap();
        let command = Command::Note(Note::Retired { instance: InstanceId(1) });
        // This command has a time of its own.
        let wake = Command::Wake { at: Timestamp(7) };
        log.append(Timestamp(0), &started(), &[command.clone(), wake.clone()]).unwrap();
        let Log { lines, torn, .. } = read(file.path()).unwrap();
        assert_eq!((lines.len(), torn), (3, None));
        assert_eq!(lines[2], LogLine { at: Timestamp(0), entry: LogEntry::Command(wake) });
        assert_eq!(lines[0], LogLine { at: Timestamp(0), entry: LogEntry::Event(started()) });
        assert_eq!(lines[1], LogLine { at: Timestamp(0), entry: LogEntry::Command(command) });
        let written = std::fs::read_to_string(file.path()).unwrap();
        let of_lines: String = lines.iter().map(|line| format!("{}\n", serde_json::to_string(line).unwrap())).collect();
        assert_eq!(written, of_lines);
    }

    #[test]
    fn what_is_noted_is_written_together_and_what_is_refused_of_it_leaves_the_rest() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut log = LogWriter::create(file.path()).unwrap();
        log.note(Timestamp(0), &started(), &[Command::Wake { at: Timestamp(7) }]).unwrap();
        assert_eq!((log.written(), log.lines(), std::fs::read(file.path()).unwrap().len()), (0, 0, 0));
        let value = ratn_model::value::Value::Null;
        let long = Event::Signalled { signal: "x".repeat(MAX_ENTRY_BYTES), value };
        assert!(matches!(log.note(Timestamp(1), &long, &[]), Err(LogError::TooMuchAtOnce { .. })));
        log.note(Timestamp(2), &Event::Woken, &[]).unwrap();
        log.write().unwrap();
        log.write().unwrap();
        let Log { lines, whole, .. } = read(file.path()).unwrap();
        assert_eq!((lines.len(), lines[2].at), (3, Timestamp(2)));
        assert_eq!((log.lines(), log.written()), (3, whole));
    }

    #[test]
    fn a_log_that_grows_is_followed_by_whole_lines() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("log.jsonl");
        let mut tail = Tail::of(&path);
        assert_eq!(tail.more().unwrap(), []);
        let line =
            |entry: &LogEntry| serde_json::to_string(&LogLine { at: Timestamp(0), entry: entry.clone() }).unwrap();
        let (first, second) =
            (line(&LogEntry::Event(started())), line(&LogEntry::Event(Event::Resumed { share: None })));
        std::fs::write(&path, format!("{first}\n{}", &second[..9])).unwrap();
        assert_eq!(tail.more().unwrap().len(), 1);
        assert_eq!(tail.more().unwrap(), []);
        std::fs::write(&path, format!("{first}\n{second}\n")).unwrap();
        assert_eq!(
            tail.more().unwrap(),
            [LogLine { at: Timestamp(0), entry: LogEntry::Event(Event::Resumed { share: None }) }]
        );
    }

    #[test]
    fn a_log_has_one_writer() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut writer = LogWriter::create(file.path()).unwrap();
        writer.append(Timestamp(0), &started(), &[]).unwrap();
        assert!(matches!(LogWriter::create(file.path()), Err(LogError::UnderWay { .. })));
        assert!(matches!(LogWriter::go_on(file.path()), Err(LogError::UnderWay { .. })));
        assert_eq!(read(file.path()).unwrap().lines.len(), 1);
    }

    #[test]
    fn a_log_into_a_pipe_that_nobody_reads_is_refused_at_once() {
        let place = tempfile::tempdir().unwrap();
        let pipe = place.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let refused = LogWriter::create(&pipe).unwrap_err();
        let why = std::error::Error::source(&refused).map(ToString::to_string).unwrap_or_default();
        assert!(why.contains("nobody reads"), "{refused}: {why}");
    }

    #[test]
    fn nothing_is_written_over_a_file_with_something_in_it() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "mine").unwrap();
        assert!(matches!(LogWriter::create(file.path()), Err(LogError::There { .. })));
        assert_eq!(std::fs::read_to_string(file.path()).unwrap(), "mine");
    }

    #[test]
    fn a_torn_last_line_is_left_out() {
        let first = serde_json::to_string(&LogLine { at: Timestamp(0), entry: LogEntry::Event(started()) }).unwrap();
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), format!("{first}\n{{\"at\":1,")).unwrap();
        let log = read(file.path()).unwrap();
        assert_eq!((log.lines.len(), log.torn), (1, Some(2)));
        // A writer that continues the log overwrites the torn line.
        let mut writer = LogWriter::go_on(file.path()).unwrap();
        writer.go_on_behind(&log);
        writer.append(Timestamp(2), &Event::Resumed { share: None }, &[]).unwrap();
        writer.make_durable().unwrap();
        let log = read(file.path()).unwrap();
        assert_eq!((log.lines.len(), log.torn), (2, None));
        assert!(refusal(&first).contains("has no whole line"));
    }

    #[test]
    fn what_no_reader_takes_is_refused_when_it_is_written_with_all_of_its_event() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut log = LogWriter::create(file.path()).unwrap();
        log.append(Timestamp(0), &started(), &[]).unwrap();
        let around = serde_json::to_string(&Written { at: Timestamp(1), entry: &says(0) }).unwrap().len();
        let (bytes, lines) = (log.written(), log.lines());
        let refused = log.append(Timestamp(1), &says(MAX_ENTRY_BYTES - around + 1), &[]).unwrap_err();
        assert!(refused.to_string().starts_with("the event signalled has 8388609 bytes"), "{refused}");
        // An event is not written without the commands decided on it.
        let end = Command::End {
            outcome: "aborted".to_owned(),
            outputs: Default::default(),
            reason: "y".repeat(MAX_ENTRY_BYTES),
        };
        let refused = log.append(Timestamp(1), &Event::Woken, &[Command::Wake { at: Timestamp(2) }, end]).unwrap_err();
        assert!(matches!(&refused, LogError::TooMuchAtOnce { what, .. } if what == "command end"), "{refused}");
        assert_eq!((log.written(), log.lines()), (bytes, lines));
        log.append(Timestamp(2), &Event::Resumed { share: None }, &[]).unwrap();
        assert_eq!(read(file.path()).unwrap().lines.len(), 2);
    }

    #[test]
    fn a_world_too_large_for_a_line_stands_in_several_and_is_read_as_one() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut log = LogWriter::create(file.path()).unwrap();
        let mut large = started();
        if let Event::Started { world, .. } = &mut large {
            // Characters that need escapes, that have several bytes, and that would end a line.
            let text = "a\"\\\u{1}\n漢".repeat(100);
            let fact = |i| FactKey { predicate: "at".to_owned(), arguments: vec![Term::Int(i)] };
            world.extend((0..2_000).map(|i| (fact(i), Value::String(text.clone()))));
        }
        log.append(Timestamp(5), &large, &[Command::Wake { at: Timestamp(7) }]).unwrap();
        let lines = std::fs::read(file.path()).unwrap();
        let lines: Vec<&[u8]> = lines.split_inclusive(|byte| *byte == b'\n').collect();
        assert!(lines.len() > 3 && lines.len() == log.lines(), "{}", lines.len());
        for line in &lines {
            assert!(line.len() <= MAX_LINE_BYTES);
            serde_json::from_slice::<serde_json::Value>(line).unwrap();
        }
        let all = read(file.path()).unwrap();
        let entries = [LogEntry::Event(large), LogEntry::Command(Command::Wake { at: Timestamp(7) })];
        assert!(all.lines.iter().map(|line| &line.entry).eq(&entries));
        assert_eq!((all.whole, all.read), (log.written(), log.lines()));
        // The writer was killed within the entry.
        let whole = log.written();
        log.append(Timestamp(6), &says(MAX_LINE_BYTES), &[]).unwrap();
        let lines = log.lines();
        drop(log);
        let short = std::fs::File::options().write(true).open(file.path()).unwrap();
        for cut in [1, MAX_LINE_BYTES as u64 / 2] {
            let length = short.metadata().unwrap().len();
            short.set_len(length - cut).unwrap();
            let all = read(file.path()).unwrap();
            assert_eq!((all.lines.len(), all.whole, all.torn), (2, whole, Some(all.read + 1)));
        }
        let mut log = LogWriter::go_on(file.path()).unwrap();
        log.go_on_behind(&read(file.path()).unwrap());
        log.append(Timestamp(6), &says(MAX_LINE_BYTES), &[]).unwrap();
        assert_eq!((read(file.path()).unwrap().lines.len(), log.lines()), (3, lines));
    }

    fn says(length: usize) -> Event {
        Event::Signalled { signal: "x".repeat(length), value: Value::Null }
    }

    #[test]
    fn a_foreign_line_is_named() {
        let first = serde_json::to_string(&LogLine { at: Timestamp(0), entry: LogEntry::Event(started()) }).unwrap();
        assert!(refusal(&format!("{first}\n{{\"at\":1,\n{first}\n")).starts_with("LOG:2: not a line of an event log"));
        assert!(refusal(&format!("{first}\nhello\n")).starts_with("LOG:2: not a line of an event log: not JSON"));
        let strange = format!("{first}\n{{\"at\":1,\"event\":\"rained\"}}\n");
        assert!(refusal(&strange).starts_with("LOG:2: not a line of an event log: not a known event: unknown variant"));
        assert!(refusal("").contains("has no whole line"));
        assert!(
            refusal("{\"at\":1,\"command\":\"note\",\"note\":\"retired\",\"instance\":1}\n").contains("begins with")
        );
    }
}
