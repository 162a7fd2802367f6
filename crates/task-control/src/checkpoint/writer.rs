//! Writes checkpoints in a separate thread: each is encoded, written to a new file, synced and renamed, so that a complete one always exists. The log
//! is synced first: no checkpoint on disk is ahead of the log on disk.

use super::file::MAX_BYTES;
use super::{Checkpoint, Place, ReplayedState, path_of};
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// A checkpoint to be written.
pub(super) struct Job {
    pub(super) digest: String,
    /// The length of the log at the checkpoint.
    pub(super) bytes: u64,
    pub(super) lines: usize,
    pub(super) standing: ReplayedState,
    pub(super) executive: Vec<u8>,
}

/// The writing thread. It writes one checkpoint at a time; the next one is made when this one is written.
pub(super) struct Writer {
    jobs: Option<SyncSender<Job>>,
    written: Receiver<Duration>,
    busy: bool,
    thread: Option<JoinHandle<()>>,
}

impl Writer {
    /// Starts the writer for the checkpoints of a log.
    pub(super) fn start(log: &Path) -> io::Result<Writer> {
        let (jobs, received) = sync_channel::<Job>(1);
        let (done, written) = sync_channel(1);
        let log = log.to_owned();
        let thread = std::thread::Builder::new().name("checkpoint".into()).spawn(move || {
            let mut complained = false;
            for job in received {
                let began = Instant::now();
                // A run goes on without checkpoints; the operator is told once.
                if let Err(error) = write(&log, job)
                    && !std::mem::replace(&mut complained, true)
                {
                    tracing::warn!(log = %log.display(), %error, "no checkpoint was written: resuming takes longer");
                }
                let _ = done.send(began.elapsed());
            }
        })?;
        Ok(Writer { jobs: Some(jobs), written, busy: false, thread: Some(thread) })
    }

    /// How long the last checkpoint took; `None` if it is not done or was reported before.
    pub(super) fn took(&mut self) -> Option<Duration> {
        let took = self.written.try_recv().ok()?;
        self.busy = false;
        Some(took)
    }

    /// Whether a checkpoint is being written.
    pub(super) fn is_busy(&self) -> bool {
        self.busy
    }

    /// Begins to write a checkpoint.
    pub(super) fn write(&mut self, job: Job) {
        self.busy = self.jobs.as_ref().is_some_and(|jobs| jobs.try_send(job).is_ok());
    }
}

impl Drop for Writer {
    /// Waits for a checkpoint that is being written, so that nobody writes when the log is resumed or the file removed.
    fn drop(&mut self) {
        self.jobs = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn write(log: &Path, job: Job) -> io::Result<()> {
    let Job { digest, bytes, lines, standing, executive } = job;
    let file = File::open(log)?;
    file.sync_data()?;
    let place = Place::of(&file, bytes, lines)?;
    let encoded = Checkpoint { digest, place, standing, executive }.encode()?;
    if encoded.len() as u64 > MAX_BYTES {
        return Err(io::Error::new(io::ErrorKind::FileTooLarge, "the state of the run is too large for a checkpoint"));
    }
    let (path, new) = (path_of(log), new_path_of(log));
    let written = replace(&path, &new, &encoded);
    if written.is_err() {
        let _ = std::fs::remove_file(&new);
    }
    written
}

fn replace(path: &Path, new: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = File::create(new)?;
    file.write_all(bytes)?;
    file.sync_all()?;
    std::fs::rename(new, path)?;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    File::open(folder)?.sync_all()
}

fn new_path_of(log: &Path) -> PathBuf {
    let mut name = path_of(log).into_os_string();
    name.push(".new");
    name.into()
}

/// Removes the checkpoint files: a run that has ended is not resumed.
pub(super) fn remove(log: &Path) {
    for path in [path_of(log), new_path_of(log)] {
        match std::fs::remove_file(&path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                tracing::warn!(path = %path.display(), %error, "the checkpoint of a run that has ended was not removed");
            }
            _ => {}
        }
    }
}
