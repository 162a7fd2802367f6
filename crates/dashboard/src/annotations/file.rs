//! A task file on the disk: read with a bound, known by a digest, and replaced as a whole.

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
        /// Which.
        path: PathBuf,
        /// Why.
        why: String,
    },
    /// It cannot be written.
    #[error("cannot write {}: {why}; nothing was changed", path.display())]
    Write {
        /// Which.
        path: PathBuf,
        /// Why.
        why: String,
    },
    /// It is not as it was.
    #[error("the file has changed")]
    Changed,
}

/// The text of a regular file of bounded length.
pub(super) fn read(path: &Path, most: usize) -> Result<String, FileError> {
    ratn_regular_file::read_text(path, most)
        .map_err(|error| FileError::Read { path: path.to_owned(), why: error.to_string() })
}

/// What a text is known by.
pub(super) fn digest(text: &str) -> String {
    hashed(&SHA256, text.as_bytes()).as_ref().iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Puts a new text in the place of the old one, if that is still there: it is written beside it, synced, and renamed. Mode, owner and
/// extended attributes stay.
pub(super) fn replace(path: &Path, old: &str, new: &str, most: usize) -> Result<(), FileError> {
    let refused = |why: &str| FileError::Write { path: path.to_owned(), why: why.to_owned() };
    let failed = |error: io::Error| refused(&error.to_string());
    // Of a link the file that it leads to is replaced.
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
        // Behind the mode, of which the list of who may do what is a part.
        attributes::keep(&ratn_regular_file::open(&path).map_err(failed)?, &file).map_err(|why| refused(&why))?;
        file.sync_all().map_err(failed)?;
        // As late as can be: whoever writes it in an editor meanwhile is not overwritten.
        if read(&path, most)? != old {
            return Err(FileError::Changed);
        }
        std::fs::rename(&beside, &path).map_err(failed)
    };
    if let Err(error) = written() {
        // It was made here, and nobody knows it.
        let _ = std::fs::remove_file(&beside);
        return Err(error);
    }
    // The new text is there; whether its name is on the disk already changes nothing of that.
    let _ = File::open(folder).and_then(|folder| folder.sync_all());
    Ok(())
}
