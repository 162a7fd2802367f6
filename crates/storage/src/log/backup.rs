//! Makes a consistent copy of a log while the log is written, and restores a log from such a copy.
//!
//! The source is read and checked as in a recovery. The copy is made under a temporary name beside the target, read again, and only then
//! renamed to the target: there is a complete backup, or none.

use super::contents::{self, Contents};
use super::files::{Disk, Files};
use super::syncer;
use super::{directory, make_directory, snapshot};
use crate::error::CopyError;
use crate::store::Position;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::{fs, io};

/// The positions that a copy covers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Copied {
    /// The last record.
    pub through: Position,
    /// The snapshot replaces records through this one; 0 without a snapshot.
    pub snapshot: Position,
}

/// Copies a log into a directory that is empty or does not exist. The copy contains at least what was durable when it began. Holds the
/// whole log in memory. Blocks.
///
/// # Errors
/// There is no log, it is damaged, the target is not empty, or the system refuses.
pub fn backup(log: &Path, target: &Path) -> Result<Copied, CopyError> {
    copy(&Disk, log, target)
}

/// Makes a log from a backup, in a directory that is empty or does not exist: an existing log is never overwritten. Its epochs continue
/// from the backup's, so a writer of the replaced log has to be ended first. Blocks.
///
/// # Errors
/// As for [`backup`].
pub fn restore(backup: &Path, target: &Path) -> Result<Copied, CopyError> {
    copy(&Disk, backup, target)
}

/// Copies with these file operations.
pub(super) fn copy(files: &dyn Files, source: &Path, target: &Path) -> Result<Copied, CopyError> {
    let contents = contents::read(source)?;
    if contents.store.is_none() {
        return Err(CopyError::Nothing { place: source.display().to_string() });
    }
    refuse_what_is_not_empty(target)?;
    let unfinished = unfinished(target)?;
    let written = write(files, &contents, &unfinished).and_then(|()| {
        let copied = contents::read(&unfinished)?;
        debug_assert_eq!(copied.recovered().records.len(), contents.recovered().records.len(), "a copy is the same");
        let parent = parent(target);
        files.rename(&unfinished, target).map_err(failed("rename", &unfinished))?;
        files.sync_directory(parent).map_err(failed("sync", parent))
    });
    if written.is_err() {
        let _ = fs::remove_dir_all(&unfinished);
    }
    written?;
    Ok(Copied { through: contents.last(), snapshot: contents.through() })
}

fn write(files: &dyn Files, contents: &Contents, target: &Path) -> Result<(), CopyError> {
    make_directory(files, parent(target)).map_err(failed("make", parent(target)))?;
    files.create_directory(target).map_err(failed("make", target))?;
    if let (Some(store), Some(taken)) = (contents.store, &contents.snapshot) {
        snapshot::write(files, target, store, taken)
            .map_err(|(action, source)| failed(action, &directory::snapshot(target, taken.through))(source))?;
    }
    for segment in &contents.segments {
        syncer::begin(files, target, segment.header, &segment.frames)
            .map_err(|(action, path, source)| failed(action, &path)(source))?;
    }
    Ok(())
}

fn refuse_what_is_not_empty(target: &Path) -> Result<(), CopyError> {
    let place = || target.display().to_string();
    match fs::read_dir(target) {
        Ok(mut entries) => match entries.next() {
            None => Ok(()),
            Some(_) => Err(CopyError::NotEmpty { place: place() }),
        },
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        Err(source) => Err(CopyError::Io { action: "list", place: place(), source }),
    }
}

/// A temporary name beside the target's.
fn unfinished(target: &Path) -> Result<PathBuf, CopyError> {
    let name = target.file_name().ok_or_else(|| CopyError::NotEmpty { place: target.display().to_string() })?;
    let mut unfinished = OsString::from(".");
    unfinished.push(name);
    unfinished.push(format!(".{}.unfinished", std::process::id()));
    Ok(parent(target).join(unfinished))
}

fn parent(path: &Path) -> &Path {
    path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

fn failed(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> CopyError {
    let place = path.display().to_string();
    move |source| CopyError::Io { action, place, source }
}
