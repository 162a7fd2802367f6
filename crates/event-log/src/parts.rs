//! An index of a long log by time: for every 4 MiB, the offset and the time of the first complete line.
//!
//! The index reads one line per part and the end of the log, so a log of 1 GiB is indexed by reading a few hundred lines. It keeps an
//! offset and a time per part and no lines, except the end of the first one: that end names the run of the log, so another log that
//! replaces this file is noticed.

use crate::{LogError, MAX_LINE_BYTES, pieces};
use ratn_model::time::Timestamp;
use serde::Deserialize;
use std::fs::{File, Metadata};
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};

/// Size of a part of the log.
const PART_BYTES: u64 = 4 << 20;
/// Number of bytes at the end of a log in which the last line is searched first.
const END_BYTES: u64 = 64 << 10;
/// Number of bytes kept of the end of the first line: the run's id is there.
const MARK_BYTES: u64 = 1 << 10;

/// The parts of a log, as far as it was written at the last look.
#[derive(Debug)]
pub struct Parts {
    path: PathBuf,
    part_bytes: u64,
    /// For each part the offset at which its first line begins, and that line's time.
    begin: Vec<(u64, Timestamp)>,
    length: u64,
    last: Timestamp,
    mark: Option<Mark>,
}

/// Identifies a log while it grows: its file, and the end of its first line.
#[derive(Debug)]
struct Mark {
    device: u64,
    inode: u64,
    offset: u64,
    end: Vec<u8>,
}

impl Mark {
    /// The mark of a log whose first line has this length.
    fn of(file: &File, is: &Metadata, first: u64) -> std::io::Result<Mark> {
        let length = first.min(MARK_BYTES);
        let mut mark =
            Mark { device: is.dev(), inode: is.ino(), offset: first - length, end: vec![0; length as usize] };
        file.read_exact_at(&mut mark.end, mark.offset)?;
        Ok(mark)
    }

    fn is_of(&self, file: &File, is: &Metadata) -> bool {
        let mut end = vec![0; self.end.len()];
        (self.device, self.inode) == (is.dev(), is.ino())
            && file.read_exact_at(&mut end, self.offset).is_ok()
            && end == self.end
    }
}

/// The time of a line.
#[derive(Deserialize)]
struct Stamp {
    at: Timestamp,
}

impl Parts {
    /// The parts of a log, which may have no complete line yet.
    ///
    /// # Errors
    /// The log cannot be read, or a line that is looked up has no time.
    pub fn of(path: &Path) -> Result<Parts, LogError> {
        Parts::of_size(path, PART_BYTES)
    }

    fn of_size(path: &Path, part_bytes: u64) -> Result<Parts, LogError> {
        let mut parts = Parts::unread(path.to_owned(), part_bytes);
        parts.look()?;
        Ok(parts)
    }

    fn unread(path: PathBuf, part_bytes: u64) -> Parts {
        Parts { path, part_bytes, begin: Vec::new(), length: 0, last: Timestamp(0), mark: None }
    }

    /// Indexes what was written since. Returns whether it is the same log as before: a log that is shorter than before, or another file
    /// under this name, is indexed anew.
    ///
    /// # Errors
    /// As [`Parts::of`].
    pub fn look(&mut self) -> Result<bool, LogError> {
        let mut file = ratn_regular_file::open(&self.path).map_err(|source| self.io(source))?;
        let is = file.metadata().map_err(|source| self.io(source))?;
        let length = is.len();
        let is_same = length >= self.length && self.mark.as_ref().is_none_or(|mark| mark.is_of(&file, &is));
        if !is_same {
            *self = Parts::unread(std::mem::take(&mut self.path), self.part_bytes);
        } else if length == self.length {
            return Ok(true);
        }
        if self.mark.is_none() {
            let first = self.first_length(&mut BufReader::new(&file))?;
            let mark = first.map(|first| Mark::of(&file, &is, first)).transpose();
            self.mark = mark.map_err(|source| self.io(source))?;
        }
        while self.begin.len() as u64 * self.part_bytes < length {
            let from = self.begin.len() as u64 * self.part_bytes;
            // An entry that is longer than a part is read only once.
            if let Some(same) = self.begin.last().copied().filter(|(offset, _)| *offset >= from) {
                self.begin.push(same);
                continue;
            }
            let Some(begin) = self.first_behind(&mut file, from)? else { break };
            self.begin.push(begin);
        }
        self.last = self.last_of(&mut file, length)?.unwrap_or(self.last);
        self.length = length;
        Ok(is_same)
    }

    /// Number of bytes in the log, including a torn line at its end.
    pub fn length(&self) -> u64 {
        self.length
    }

    /// Time of the last complete line.
    pub fn last(&self) -> Timestamp {
        self.last
    }

    /// Where to begin reading for what happened until `moment`, with at least `bytes` before it: the offset at which a line begins, and its
    /// time. The start of the log if there are fewer bytes before it.
    pub fn before(&self, moment: Timestamp, bytes: u64) -> (u64, Timestamp) {
        let reached = self.begin.partition_point(|(_, at)| *at <= moment);
        let back = usize::try_from(bytes.div_ceil(self.part_bytes)).unwrap_or(usize::MAX);
        let part = reached.saturating_sub(1).saturating_sub(back);
        if part == 0 { (0, Timestamp(0)) } else { self.begin[part] }
    }

    /// Length of the first event, all its pieces together; `None` if it is not complete yet.
    fn first_length(&self, reader: &mut impl BufRead) -> Result<Option<u64>, LogError> {
        let Some(first) = self.line(reader)? else { return Ok(None) };
        let mut length = first.len() as u64;
        if pieces::is_one(&first) {
            loop {
                let Some(next) = self.line(reader)? else { return Ok(None) };
                if !pieces::goes_on(&next) {
                    break;
                }
                length += next.len() as u64;
            }
        }
        Ok(Some(length))
    }

    /// The first complete line that begins at offset `from` or later and is not a further piece of an earlier entry.
    fn first_behind(&self, file: &mut File, from: u64) -> Result<Option<(u64, Timestamp)>, LogError> {
        let mut offset = from.saturating_sub(1);
        file.seek(SeekFrom::Start(offset)).map_err(|source| self.io(source))?;
        let mut reader = BufReader::new(file);
        if from > 0 {
            // The rest of the previous line; empty if that line ends exactly before `from`.
            let Some(rest) = self.line(&mut reader)? else { return Ok(None) };
            offset += rest.len() as u64;
        }
        loop {
            let Some(line) = self.line(&mut reader)? else { return Ok(None) };
            if !pieces::goes_on(&line) {
                return Ok(Some((offset, self.stamp(&line, offset)?)));
            }
            offset += line.len() as u64;
        }
    }

    fn last_of(&self, file: &mut File, length: u64) -> Result<Option<Timestamp>, LogError> {
        let mut bytes = END_BYTES;
        loop {
            let from = length.saturating_sub(bytes);
            file.seek(SeekFrom::Start(from)).map_err(|source| self.io(source))?;
            let mut end = Vec::new();
            file.take(length - from).read_to_end(&mut end).map_err(|source| self.io(source))?;
            let Some(newline) = end.iter().rposition(|byte| *byte == b'\n') else {
                if from == 0 || bytes > MAX_LINE_BYTES as u64 {
                    return Ok(None);
                }
                bytes *= 4;
                continue;
            };
            match end[..newline].iter().rposition(|byte| *byte == b'\n') {
                Some(before) => return self.stamp(&end[before + 1..newline], from + before as u64 + 1).map(Some),
                None if from == 0 => return self.stamp(&end[..newline], 0).map(Some),
                None if bytes > 2 * MAX_LINE_BYTES as u64 => return Ok(None),
                None => bytes *= 4,
            }
        }
    }

    /// A complete line with its line end; `None` if there is none.
    fn line(&self, reader: &mut impl BufRead) -> Result<Option<Vec<u8>>, LogError> {
        let mut line = Vec::new();
        let limit = MAX_LINE_BYTES as u64 + 1;
        reader.take(limit).read_until(b'\n', &mut line).map_err(|source| self.io(source))?;
        Ok((line.last() == Some(&b'\n')).then_some(line))
    }

    fn stamp(&self, line: &[u8], offset: u64) -> Result<Timestamp, LogError> {
        let stamp: Result<Stamp, _> = serde_json::from_slice(line);
        stamp.map(|stamp| stamp.at).map_err(|error| LogError::Unreadable {
            path: self.path.clone(),
            offset,
            reason: error.to_string(),
        })
    }

    fn io(&self, source: std::io::Error) -> LogError {
        LogError::Io { what: "read", path: self.path.clone(), source }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::Lines;
    use std::io::Write;

    const STARTED: &str = r#"{"at":0,"event":"started","task":"t","digest":"d","mode":"cdtn","parameters":{},"seed":1,"world":[],"revision":0}"#;

    fn log(seconds: u64) -> tempfile::NamedTempFile {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        writeln!(file, "{STARTED}").unwrap();
        for second in 1..=seconds {
            writeln!(file, r#"{{"at":{},"event":"woken"}}"#, second * 1_000_000_000).unwrap();
        }
        file.flush().unwrap();
        file
    }

    fn first_at(file: &Path, offset: u64) -> Timestamp {
        Lines::behind(file, offset, 0).unwrap().next().unwrap().unwrap().at
    }

    #[test]
    fn every_part_begins_with_a_line_and_is_found_by_its_moment() {
        let file = log(500);
        for size in [40, 64, 257, 4096] {
            let parts = Parts::of_size(file.path(), size).unwrap();
            assert_eq!(parts.last(), Timestamp::from_seconds(500.0));
            for (offset, at) in &parts.begin {
                assert_eq!(first_at(file.path(), *offset), *at);
            }
            for moment in [0.0, 3.0, 250.0, 499.5, 9000.0] {
                let moment = Timestamp::from_seconds(moment);
                let (offset, at) = parts.before(moment, 100);
                assert!(at <= moment, "{at:?} {moment:?}");
                assert!(offset == 0 || first_at(file.path(), offset) == at);
                // At least this much is before it, and not much more.
                let line = moment.seconds().min(500.0) * 40.0;
                assert!(offset as f64 <= (line - 100.0).max(0.0) + 200.0, "{offset} for {moment:?} by {size}");
            }
            assert_eq!(parts.before(Timestamp::from_seconds(250.0), u64::MAX).0, 0);
        }
    }

    #[test]
    fn a_log_that_grows_is_looked_at_again_and_a_torn_line_is_not_counted() {
        let mut file = log(3);
        let mut parts = Parts::of_size(file.path(), 64).unwrap();
        assert_eq!(parts.last(), Timestamp::from_seconds(3.0));
        write!(file, r#"{{"at":4000000000,"event":"wo"#).unwrap();
        file.flush().unwrap();
        parts.look().unwrap();
        assert_eq!(parts.last(), Timestamp::from_seconds(3.0));
        writeln!(file, "ken\"}}").unwrap();
        file.flush().unwrap();
        parts.look().unwrap();
        assert_eq!(parts.last(), Timestamp::from_seconds(4.0));
    }

    #[test]
    fn another_log_of_this_name_is_known_as_another_and_indexed_anew() {
        let mut file = log(3);
        let mut parts = Parts::of_size(file.path(), 64).unwrap();
        writeln!(file, r#"{{"at":4000000000,"event":"woken"}}"#).unwrap();
        assert!(parts.look().unwrap() && parts.look().unwrap());
        // Another log in the same file, of the same length.
        let other = std::fs::read_to_string(file.path())
            .unwrap()
            .replace("\"seed\":1", "\"seed\":2")
            .replace("at\":4", "at\":9");
        std::fs::write(file.path(), &other).unwrap();
        assert_eq!((parts.look().unwrap(), parts.last()), (false, Timestamp::from_seconds(9.0)));
        // The same log in another file, and then a shorter one.
        let copy = file.path().with_extension("copy");
        std::fs::write(&copy, &other).unwrap();
        std::fs::rename(copy, file.path()).unwrap();
        assert!(!parts.look().unwrap() && parts.look().unwrap());
        std::fs::write(file.path(), format!("{STARTED}\n")).unwrap();
        assert_eq!((parts.look().unwrap(), parts.last()), (false, Timestamp(0)));
    }

    #[test]
    fn what_is_no_log_is_refused_with_the_place() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "one\ntwo\n").unwrap();
        let error = Parts::of(file.path()).unwrap_err().to_string();
        assert!(error.contains("at byte 0"), "{error}");
        assert_eq!(Parts::of(tempfile::NamedTempFile::new().unwrap().path()).unwrap().length(), 0);
    }
}
