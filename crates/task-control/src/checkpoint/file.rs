//! The form of a checkpoint file: what it is and in which format, how long the rest is, the rest's digest, and the rest, which is
//! a header in JSON (as in the log, so that values read back as they do there) and the executive's state.
//!
//! A file that is torn, damaged, of another format or of another log is named as that and not used. One thing is refused: a log
//! that is shorter than its own checkpoint says. The log is on the disk before its checkpoint is, so somebody has cut it, and
//! motions that were begun might be begun again.

use super::{Checkpoint, Place, ReplayedState, path_of};
use crate::replay::VERSION;
use ratn_executive::protocol::Origin;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

/// What every checkpoint file begins with.
const MAGIC: &[u8; 16] = b"ratn checkpoint\n";
/// Its format. Another one is not read.
const FORMAT: u32 = 8;
/// The bytes before the rest: what it is, its format, how long the rest is and its digest.
const PREAMBLE: usize = MAGIC.len() + 4 + 8 + blake3::OUT_LEN;
/// A run whose state is larger than this has no checkpoints.
pub(super) const MAX_BYTES: u64 = 1 << 30;

/// Why a checkpoint is not used.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The operating system refuses it.
    #[error("it cannot be read: {0}")]
    Io(#[from] io::Error),
    /// It is some other file.
    #[error("it is not a checkpoint of a run")]
    NoCheckpoint,
    /// It is of a format that is not known.
    #[error("it is of format {theirs}, and this version of ratn reads {FORMAT}")]
    Format {
        /// The number of that format.
        theirs: u32,
    },
    /// Another version wrote it.
    #[error("it was written by ratn {theirs}, and this is {VERSION}")]
    Version {
        /// That version.
        theirs: String,
    },
    /// Its digest is not that of its bytes.
    #[error("it is torn or damaged")]
    Torn,
    /// Another run made it.
    #[error("it is of another run")]
    OtherRun,
    /// The log before its place is not the log that it was made of.
    #[error("the log was edited, or is another one, before the place that it is of")]
    Edited,
    /// The log is shorter than it was.
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
    /// Whether the run must not be resumed from what there is of the log either.
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
    /// As it is in a file.
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

    /// The checkpoint of a file.
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
        // The version first: another one may say the rest otherwise.
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

    /// Whether it is of this log.
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

/// The checkpoint of a log that begins with this origin and this digest of a task; `None` where there is no file.
///
/// # Errors
/// Why it is not used.
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
