//! A task file on disk: read with a size limit, identified by a digest, and replaced as a whole.

use super::attributes;
use ring::digest::{SHA256, digest as hashed};
use std::fs::{File, OpenOptions, Permissions};
use std::io::{self, ErrorKind, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

/// Why a file is not read or written.
#[derive(Debug, thiserror::Error)]
pub(crate) enum FileError {
    /// It cannot be read.
    #[error("cannot read {}: {why}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The error.
        why: String,
    },
    /// It cannot be written.
    #[error("cannot write {}: {why}; nothing was changed", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The error.
        why: String,
    },
    /// The file has changed.
    #[error("the file has changed")]
    Changed,
}

/// The text of a regular file of at most `most` bytes.
pub(super) fn read(path: &Path, most: usize) -> Result<String, FileError> {
    ratn_regular_file::read_text(path, most)
        .map_err(|error| FileError::Read { path: path.to_owned(), why: error.to_string() })
}

/// The digest that identifies a text.
pub(super) fn digest(text: &str) -> String {
    hashed(&SHA256, text.as_bytes()).as_ref().iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Replaces the old text by a new one, if the file still contains the old one: the new text is written to a file beside it, synced, and
/// renamed. Mode, owner and extended attributes stay.
pub(super) fn replace(path: &Path, old: &str, new: &str, most: usize) -> Result<(), FileError> {
    let refused = |why: &str| FileError::Write { path: path.to_owned(), why: why.to_owned() };
    let failed = |error: io::Error| refused(&error.to_string());
    // For a symbolic link, its target is replaced.
    let path = path.canonicalize().map_err(failed)?;
    let there = std::fs::metadata(&path).map_err(failed)?;
    if there.permissions().readonly() {
        return Err(refused("it is read-only"));
    }
    if there.nlink() > 1 {
        return Err(refused("it has a second name (a hard link), which would keep the old text"));
    }
    let (Some(folder), Some(name)) = (path.parent(), path.file_name()) else {
        return Err(refused("it has no name"));
    };
    let beside = folder.join(format!(".{}.{}.new", name.to_string_lossy(), std::process::id()));
    let mut file = match OpenOptions::new().write(true).create_new(true).mode(0o600).open(&beside) {
        Ok(file) => file,
        Err(error) if error.kind() == ErrorKind::AlreadyExists => {
            return Err(refused(&format!("{} is in the way: remove it", beside.display())));
        }
        Err(error) => return Err(failed(error)),
    };
    let mut written = || -> Result<(), FileError> {
        file.write_all(new.as_bytes()).map_err(failed)?;
        let own = file.metadata().map_err(failed)?;
        if (own.uid(), own.gid()) != (there.uid(), there.gid()) {
            std::os::unix::fs::fchown(&file, Some(there.uid()), Some(there.gid()))
                .map_err(|_| refused("it belongs to another user or group, and would not any more"))?;
        }
        file.set_permissions(Permissions::from_mode(there.mode() & 0o7777)).map_err(failed)?;
        // After the mode, which contains a part of the access control list.
        attributes::keep(&ratn_regular_file::open(&path).map_err(failed)?, &file).map_err(|why| refused(&why))?;
        file.sync_all().map_err(failed)?;
        // As late as possible, so that a change by an editor meanwhile is not overwritten.
        if read(&path, most)? != old {
            return Err(FileError::Changed);
        }
        std::fs::rename(&beside, &path).map_err(failed)
    };
    if let Err(error) = written() {
        // This function created it, and no other process uses it.
        let _ = std::fs::remove_file(&beside);
        return Err(error);
    }
    // The new text is in place, even if its directory entry is not synced yet.
    let _ = File::open(folder).and_then(|folder| folder.sync_all());
    Ok(())
}
