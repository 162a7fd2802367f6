//! The output of a worker: written to a bounded file, with its end kept in memory to explain why the worker died. The logs of
//! the last workers that ended are kept.

use super::log_file::previous;
use std::collections::VecDeque;
use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncReadExt};
use tokio::sync::Notify;

/// Bytes of the end that are kept.
const LAST_WORDS_BYTES: usize = 400;
/// Bytes that are read at once.
const CHUNK_BYTES: usize = 4_096;
/// Bytes of a line that are searched.
const MAX_LINE_BYTES: usize = 4_096;
/// Interval at which the size of a file is checked that a worker writes to by itself.
pub(super) const BOUND_INTERVAL: Duration = Duration::from_secs(1);
/// Number of ended workers whose logs are kept.
const ENDED_LOGS_KEPT: usize = 64;

/// A worker's log; clones write to the same file.
#[derive(Debug, Clone)]
pub(super) struct Log {
    inner: Arc<Mutex<Inner>>,
}

/// A line that marks the worker as ready.
#[derive(Debug)]
pub(super) struct Awaited {
    text: String,
    seen: Arc<Notify>,
    /// The current line, up to the bytes that are searched.
    line: Vec<u8>,
}

#[derive(Debug)]
struct Inner {
    path: PathBuf,
    file: File,
    written: u64,
    max_bytes: u64,
    tail: VecDeque<u8>,
}

/// The logs of workers that have ended, oldest first.
#[derive(Debug, Default)]
pub(super) struct EndedLogs {
    paths: VecDeque<PathBuf>,
}

impl EndedLogs {
    /// Adds the log of a worker that has ended; removes the oldest beyond those that are kept.
    pub(super) fn add(&mut self, path: PathBuf) {
        self.paths.push_back(path);
        if self.paths.len() > ENDED_LOGS_KEPT
            && let Some(oldest) = self.paths.pop_front()
        {
            // The file may already be gone.
            let _ = fs::remove_file(previous(&oldest));
            let _ = fs::remove_file(oldest);
        }
    }
}

impl Log {
    /// Begins a log file.
    pub(super) fn create(path: &Path, max_bytes: u64) -> io::Result<Log> {
        if let Some(parent) = path.parent() {
            fs::create_dir_all(parent)?;
        }
        let file = File::create(path)?;
        let inner = Inner { path: path.to_owned(), file, written: 0, max_bytes, tail: VecDeque::new() };
        Ok(Log { inner: Arc::new(Mutex::new(inner)) })
    }

    /// A log that another process writes to, and continues to write to when this process is gone.
    pub(super) fn of_another(path: &Path, max_bytes: u64) -> io::Result<Log> {
        let file = File::options().append(true).create(true).open(path)?;
        let inner = Inner { path: path.to_owned(), file, written: 0, max_bytes, tail: VecDeque::new() };
        Ok(Log { inner: Arc::new(Mutex::new(inner)) })
    }

    /// The file, opened to append, for a process that writes to it by itself.
    pub(super) fn file(&self) -> io::Result<File> {
        let inner = self.inner.lock().unwrap_or_else(PoisonError::into_inner);
        File::options().append(true).open(&inner.path)
    }

    /// Keeps a file bounded that another process writes to: copies its content away and truncates it. Never returns.
    pub(super) async fn keep_bounded(self, every: Duration) {
        loop {
            tokio::time::sleep(every).await;
            let inner = self.inner.lock().unwrap_or_else(PoisonError::into_inner);
            let long = inner.file.metadata().is_ok_and(|file| file.len() > inner.max_bytes);
            let cut = || fs::copy(&inner.path, previous(&inner.path)).and_then(|_| inner.file.set_len(0));
            if long && let Err(error) = cut() {
                tracing::warn!(file = %inner.path.display(), %error, "a worker's log is not kept bounded");
            }
        }
    }

    /// Copies until the writer closes.
    pub(super) async fn capture(self, mut from: impl AsyncRead + Unpin, mut awaited: Option<Awaited>) {
        let mut chunk = vec![0; CHUNK_BYTES];
        while let Ok(length @ 1..) = from.read(&mut chunk).await {
            awaited = awaited.and_then(|awaited| awaited.after(&chunk[..length]));
            let mut inner = self.inner.lock().unwrap_or_else(PoisonError::into_inner);
            if let Err(error) = inner.write(&chunk[..length]) {
                // The worker goes on; a full disk costs only its log.
                tracing::warn!(file = %inner.path.display(), %error, "a worker's log is not written");
            }
        }
    }

    /// The last lines, joined into one.
    pub(super) fn last_words(&self) -> String {
        let inner = self.inner.lock().unwrap_or_else(PoisonError::into_inner);
        let (front, back) = inner.tail.as_slices();
        let tail = [front, back].concat();
        let tail = if tail.is_empty() { end_of(&inner.path).unwrap_or_default() } else { tail };
        let text = String::from_utf8_lossy(&tail).into_owned();
        text.lines().map(str::trim).filter(|line| !line.is_empty()).collect::<Vec<_>>().join(" | ")
    }
}

fn end_of(path: &Path) -> io::Result<Vec<u8>> {
    let mut file = File::open(path)?;
    let length = file.metadata()?.len();
    file.seek(SeekFrom::Start(length.saturating_sub(LAST_WORDS_BYTES as u64)))?;
    let mut end = Vec::new();
    file.read_to_end(&mut end)?;
    Ok(end)
}

impl Awaited {
    /// Notifies `seen` when a line contains `text`.
    pub(super) fn new(text: &str, seen: Arc<Notify>) -> Awaited {
        Awaited { text: text.to_owned(), seen, line: Vec::new() }
    }

    /// Processes more output; returns `None` once the line was found.
    fn after(mut self, written: &[u8]) -> Option<Awaited> {
        for byte in written {
            if *byte != b'\n' {
                if self.line.len() < MAX_LINE_BYTES {
                    self.line.push(*byte);
                }
                continue;
            }
            if String::from_utf8_lossy(&self.line).contains(&self.text) {
                self.seen.notify_one();
                return None;
            }
            self.line.clear();
        }
        Some(self)
    }
}

impl Inner {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.tail.extend(bytes);
        let surplus = self.tail.len().saturating_sub(LAST_WORDS_BYTES);
        self.tail.drain(..surplus);
        if self.written + bytes.len() as u64 > self.max_bytes {
            fs::rename(&self.path, previous(&self.path))?;
            self.file = File::create(&self.path)?;
            self.written = 0;
        }
        self.written += bytes.len() as u64;
        self.file.write_all(bytes)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn the_logs_of_the_last_workers_that_ended_are_kept_and_no_more() {
        let directory = tempfile::tempdir().unwrap();
        let path = |i: usize| directory.path().join(format!("planner-{i}@compute.log"));
        let mut ended = EndedLogs::default();
        for i in 0..ENDED_LOGS_KEPT + 3 {
            drop(Log::create(&path(i), 10_000).unwrap());
            File::create(path(i).with_extension("log.1")).unwrap();
            ended.add(path(i));
        }
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 2 * ENDED_LOGS_KEPT);
        assert!(!path(2).exists() && path(3).exists());
    }

    #[tokio::test]
    async fn a_log_is_bounded_and_its_end_is_at_hand() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("logs/planner-1@compute.log");
        let log = Log::create(&path, 10_000).unwrap();
        let lines: String = (0..2_000).map(|i| format!("line {i}\n")).collect();
        log.clone().capture(lines.as_bytes(), None).await;
        assert!(fs::metadata(&path).unwrap().len() <= 10_000);
        assert!(fs::metadata(path.with_extension("log.1")).unwrap().len() <= 10_000);
        assert!(log.last_words().ends_with("line 1998 | line 1999"));
        assert!(log.last_words().len() < 600);
    }

    #[tokio::test]
    async fn a_log_that_a_worker_writes_by_itself_is_bounded_and_its_end_is_at_hand() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("planner-1@compute.log");
        let log = Log::create(&path, 10_000).unwrap();
        let mut worker = log.file().unwrap();
        let bounded = tokio::spawn(log.clone().keep_bounded(Duration::from_millis(1)));
        for i in 0..2_000 {
            writeln!(worker, "line {i}").unwrap();
        }
        let length = || fs::metadata(&path).unwrap().len();
        while length() > 0 {
            tokio::task::yield_now().await;
        }
        writeln!(worker, "the last line").unwrap();
        assert_eq!(log.last_words(), "the last line");
        bounded.abort();
    }

    #[test]
    fn a_line_is_seen_whole_and_however_it_comes() {
        let seen = Arc::new(Notify::new());
        let awaited = Awaited::new("now ready", seen.clone());
        let awaited = awaited.after(b"not yet\nI am now re").unwrap();
        assert!(awaited.after(b"ady.\nmore").is_none());
        assert!(Awaited::new("ready", seen).after(b"ready").is_some(), "the line goes on");
    }
}
