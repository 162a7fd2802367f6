//! Ensures one writer: an advisory lock on a file that is never removed.
//!
//! A lock can be circumvented (the file is removed by hand, or the directory is replaced by a copy). The writer notices: before each
//! acknowledgement it checks whether the name still leads to the file that it holds. A process that took the place later did so before
//! reading the log, so it reads what was acknowledged before. The same check covers the segment that is written: if it was removed, or
//! replaced by a copy, nobody would read the records in it.

use super::directory;
use crate::error::{Fault, OpenError};
use crate::store::{Epoch, Place};
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

/// Maximum number of bytes read of what a holder wrote about itself.
const HOLDER_BYTES: u64 = 256;

#[derive(Debug)]
pub(super) struct Lock {
    /// The lock is held while this file is open.
    file: File,
    held: HeldPlace,
}

/// The name of the lock and the file that it led to when it was taken; and the same for the segment that is written. Both files stay open
/// as long as the writer lives, so no other file gets their inodes.
#[derive(Debug, Clone)]
pub(super) struct HeldPlace {
    lock: NamedFile,
    segment: Arc<Mutex<Option<NamedFile>>>,
}

/// A name, with device and inode of the file that it led to.
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

    /// Whether the name still leads to that file.
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

    /// Writes into the lock file who holds it. Only for messages: nothing depends on it.
    pub(super) fn describe(&mut self, epoch: Epoch) {
        let about = format!("process {}, writer {epoch}\n", std::process::id());
        let _ = self.file.set_len(0).and_then(|()| self.file.write_all(about.as_bytes()));
    }

    /// Records are written to the segment of this name from now on.
    pub(super) fn writes(&self, segment: PathBuf) -> io::Result<()> {
        let named = NamedFile::at(segment)?;
        *self.held.segment.lock().unwrap_or_else(PoisonError::into_inner) = Some(named);
        Ok(())
    }

    /// Checks whether the place still belongs to this writer.
    pub(super) fn check(&self) -> Result<(), Fault> {
        self.held.check()
    }

    /// The place, for checks independent of the writer.
    pub(super) fn place(&self) -> HeldPlace {
        self.held.clone()
    }
}

impl Place for HeldPlace {
    fn check(&self) -> Result<(), Fault> {
        // Copied, because a check may hang.
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
