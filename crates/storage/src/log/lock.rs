//! One writer: an advisory lock on a file that is never removed.
//!
//! A lock can be got past (the file is removed by hand, a copy of the directory is put in its place). The writer notices: before
//! it acknowledges anything it looks whether the name still leads to the file that it holds. A process that took the place later did so
//! before reading the log, so what was acknowledged before is read by them. The same look compares the segment that is written: one that
//! was removed, or replaced by a copy, takes records that nobody will read.

use super::directory;
use crate::error::{Fault, OpenError};
use crate::store::{Epoch, Place};
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

/// At most so much of what a holder wrote about itself is read.
const HOLDER_BYTES: u64 = 256;

#[derive(Debug)]
pub(super) struct Lock {
    /// Holds the lock for as long as it is open.
    file: File,
    held: HeldPlace,
}

/// The name of the lock, and the file that it led to when it was taken; and the same of the segment that is written. Both files are
/// open as long as the writer is there, so no other one has their inodes.
#[derive(Debug, Clone)]
pub(super) struct HeldPlace {
    lock: NamedFile,
    segment: Arc<Mutex<Option<NamedFile>>>,
}

/// A name, and device and inode of the file that it led to.
#[derive(Debug, Clone)]
struct NamedFile {
    path: PathBuf,
    inode: (u64, u64),
}

impl NamedFile {
    fn at(path: PathBuf) -> io::Result<NamedFile> {
        let found = fs::metadata(&path)?;
        Ok(NamedFile { path, inode: (found.dev(), found.ino()) })
    }

    /// Whether the name still leads to the file.
    fn is_there(&self) -> io::Result<bool> {
        match fs::metadata(&self.path) {
            Ok(found) => Ok((found.dev(), found.ino()) == self.inode),
            Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => Ok(false),
            Err(error) => Err(error),
        }
    }
}

impl Lock {
    /// Takes the writer's place.
    pub(super) fn take(directory: &Path) -> Result<Lock, OpenError> {
        let path = directory.join(directory::LOCK);
        let failed = |action| {
            let place = path.display().to_string();
            move |source| OpenError::Io { action, place, source }
        };
        let mut options = OpenOptions::new();
        let mut file =
            options.create(true).read(true).write(true).truncate(false).open(&path).map_err(failed("open"))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let mut holder = String::new();
                let read = Read::by_ref(&mut file).take(HOLDER_BYTES).read_to_string(&mut holder);
                let known = read.is_ok() && !holder.trim().is_empty();
                let holder = if known { holder.trim().to_owned() } else { "which one is not known".to_owned() };
                return Err(OpenError::Held { place: directory.display().to_string(), holder });
            }
            Err(TryLockError::Error(source)) => return Err(failed("lock")(source)),
        }
        let metadata = file.metadata().map_err(failed("look at"))?;
        let lock = NamedFile { path: path.clone(), inode: (metadata.dev(), metadata.ino()) };
        Ok(Lock { file, held: HeldPlace { lock, segment: Arc::default() } })
    }

    /// Says to others who holds it. Only for their messages: nothing depends on it.
    pub(super) fn describe(&mut self, epoch: Epoch) {
        let about = format!("process {}, writer {epoch}\n", std::process::id());
        let _ = self.file.set_len(0).and_then(|()| self.file.write_all(about.as_bytes()));
    }

    /// From now on records are written to the segment of this name.
    pub(super) fn writes(&self, segment: PathBuf) -> io::Result<()> {
        let named = NamedFile::at(segment)?;
        *self.held.segment.lock().unwrap_or_else(PoisonError::into_inner) = Some(named);
        Ok(())
    }

    /// Whether the place is still this one's.
    pub(super) fn check(&self) -> Result<(), Fault> {
        self.held.check()
    }

    /// For those who ask beside the writer.
    pub(super) fn place(&self) -> HeldPlace {
        self.held.clone()
    }
}

impl Place for HeldPlace {
    fn check(&self) -> Result<(), Fault> {
        // Copied, for a look may hang.
        let segment = self.segment.lock().unwrap_or_else(PoisonError::into_inner).clone();
        for file in [Some(&self.lock), segment.as_ref()].into_iter().flatten() {
            if !file.is_there().map_err(|error| unseen(&file.path, error))? {
                let place = self.lock.path.parent().unwrap_or(Path::new(".")).display().to_string();
                return Err(Fault::Fenced { place });
            }
        }
        Ok(())
    }
}

fn unseen(path: &Path, error: io::Error) -> Fault {
    Fault::Io { action: "look at", place: path.display().to_string(), source: Arc::new(error) }
}
