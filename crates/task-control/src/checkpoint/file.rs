//! The format of a checkpoint file: a magic number, the format version, the length of the rest, the digest of the rest, and the rest: a header in
//! JSON (as in the log, so that values are read back identically) and the executive's state.
//!
//! A file that is torn, damaged, of another format or of another log is reported and not used. Only a log that is shorter than its own checkpoint
//! says makes the run refuse: the log is synced before its checkpoint, so somebody has cut it, and motions that were begun might be begun again.

use super::{Checkpoint, Place, ReplayedState, path_of};
use crate::replay::VERSION;
use ratn_executive::protocol::Origin;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

/// The first bytes of every checkpoint file.
const MAGIC: &[u8; 16] = b"ratn checkpoint\n";
/// The format version. Other versions are not read.
const FORMAT: u32 = 9;
/// Number of bytes before the rest: magic number, format version, length and digest.
const PREAMBLE: usize = MAGIC.len() + 4 + 8 + blake3::OUT_LEN;
/// A run with a larger state has no checkpoints.
pub(super) const MAX_BYTES: u64 = 1 << 30;

/// Why a checkpoint is not used.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The operating system failed to read it.
    #[error("it cannot be read: {0}")]
    Io(#[from] io::Error),
    /// The file is not a checkpoint.
    #[error("it is not a checkpoint of a run")]
    NoCheckpoint,
    /// The file has an unknown format version.
    #[error("it is of format {theirs}, and this version of ratn reads {FORMAT}")]
    Format {
        /// The format version of the file.
        theirs: u32,
    },
    /// It was written by another version of ratn.
    #[error("it was written by ratn {theirs}, and this is {VERSION}")]
    Version {
        /// The version that wrote it.
        theirs: String,
    },
    /// The digest does not match the bytes.
    #[error("it is torn or damaged")]
    Torn,
    /// It belongs to another run.
    #[error("it is of another run")]
    OtherRun,
    /// The log before the checkpoint's place has changed since.
    #[error("the log was edited, or is another one, before the place that it is of")]
    Edited,
    /// The log is shorter than when the checkpoint was made.
    #[error(
        "lines are missing at its end: it has {has} bytes, and had {had} when its checkpoint was made. What the run did on them might be \
         done again. Put the whole log back; or, if nothing can go wrong by that, remove the checkpoint beside it"
    )]
    Cut {
        /// Bytes of the log.
        has: u64,
        /// Bytes of the log when the checkpoint was made.
        had: u64,
    },
}

impl FileError {
    /// Whether the run must not be resumed from the rest of the log either.
    pub(crate) fn refuses(&self) -> bool {
        matches!(self, FileError::Cut { .. })
    }
}

#[derive(Serialize, Deserialize)]
struct Header {
    version: String,
    digest: String,
    place: Place,
    standing: ReplayedState,
}

impl Checkpoint {
    /// The checkpoint as the bytes of a file.
    pub(crate) fn encode(&self) -> io::Result<Vec<u8>> {
        let Checkpoint { digest, place, standing, executive } = self;
        let (version, digest) = (VERSION.to_owned(), digest.clone());
        let header = Header { version, digest, place: place.clone(), standing: standing.clone() };
        let header = serde_json::to_vec(&header)?;
        let mut rest = Vec::with_capacity(8 + header.len() + executive.len());
        rest.extend((header.len() as u64).to_le_bytes());
        rest.extend(header);
        rest.extend(executive);
        let mut bytes = Vec::with_capacity(PREAMBLE + rest.len());
        bytes.extend(MAGIC);
        bytes.extend(FORMAT.to_le_bytes());
        bytes.extend((rest.len() as u64).to_le_bytes());
        bytes.extend(blake3::hash(&rest).as_bytes());
        bytes.extend(rest);
        Ok(bytes)
    }

    /// Reads a checkpoint from the bytes of a file.
    pub(crate) fn decode(bytes: &[u8]) -> Result<Checkpoint, FileError> {
        let (magic, rest) = bytes.split_first_chunk::<16>().ok_or(FileError::Torn)?;
        if magic != MAGIC {
            return Err(FileError::NoCheckpoint);
        }
        let (format, rest) = rest.split_first_chunk().ok_or(FileError::Torn)?;
        let format = u32::from_le_bytes(*format);
        if format != FORMAT {
            return Err(FileError::Format { theirs: format });
        }
        let (length, rest) = rest.split_first_chunk().ok_or(FileError::Torn)?;
        let (digest, rest) = rest.split_first_chunk::<{ blake3::OUT_LEN }>().ok_or(FileError::Torn)?;
        if u64::from_le_bytes(*length) != rest.len() as u64 || blake3::hash(rest) != *digest {
            return Err(FileError::Torn);
        }
        let (length, rest) = rest.split_first_chunk().ok_or(FileError::Torn)?;
        let length = usize::try_from(u64::from_le_bytes(*length)).map_err(|_| FileError::Torn)?;
        let (header, executive) = rest.split_at_checked(length).ok_or(FileError::Torn)?;
        // The version is read first: another version may have another header.
        #[derive(Deserialize)]
        struct Version {
            version: String,
        }
        let Version { version } = serde_json::from_slice(header).map_err(|_| FileError::Torn)?;
        if version != VERSION {
            return Err(FileError::Version { theirs: version });
        }
        let Header { digest, place, standing, .. } = serde_json::from_slice(header).map_err(|_| FileError::Torn)?;
        Ok(Checkpoint { digest, place, standing, executive: executive.to_vec() })
    }

    /// Checks that the checkpoint belongs to this log.
    fn fits(&self, log: &File, origin: &Origin, digest: &str) -> Result<(), FileError> {
        if self.standing.ledger.origin != *origin || self.digest != digest {
            return Err(FileError::OtherRun);
        }
        let has = log.metadata()?.len();
        if has < self.place.bytes {
            return Err(FileError::Cut { has, had: self.place.bytes });
        }
        if Place::of(log, self.place.bytes, self.place.lines)? != self.place {
            return Err(FileError::Edited);
        }
        Ok(())
    }
}

/// Reads the checkpoint of a log with this origin and this digest of the task; `None` if there is no file.
///
/// # Errors
/// The reason why the checkpoint is not used.
pub(crate) fn find(log: &Path, origin: &Origin, digest: &str) -> Result<Option<Checkpoint>, FileError> {
    let file = match ratn_regular_file::open(&path_of(log)) {
        Ok(file) => file,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error.into()),
    };
    let mut bytes = Vec::new();
    file.take(MAX_BYTES + 1).read_to_end(&mut bytes)?;
    let checkpoint = Checkpoint::decode(&bytes)?;
    checkpoint.fits(&File::open(log)?, origin, digest)?;
    Ok(Some(checkpoint))
}
