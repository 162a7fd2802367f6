//! The names in a log's directory.
//!
//! ```text
//!   writer.lock                         locked by the writer
//!   segment-00000000000000000001.log    by number
//!   snapshot-00000000000000004711.snap  by the last position that it replaces
//!   unfinished-copy                     exists until a copy counts; in a complete copy, the same text as moved-to in its source
//!   moved-to                            the place to which the log was moved
//!   *.tmp                               unfinished; the next writer removes it
//! ```

use crate::store::Position;
use std::path::{Path, PathBuf};
use std::{fs, io};

pub(super) const LOCK: &str = "writer.lock";
pub(super) const UNFINISHED_COPY: &str = "unfinished-copy";
pub(super) const MOVED: &str = "moved-to";
const TEMPORARY: &str = "tmp";

/// The files in the directory, in order.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Listing {
    pub(super) segments: Vec<u64>,
    pub(super) snapshots: Vec<Position>,
    pub(super) unfinished: Vec<PathBuf>,
}

pub(super) fn segment(directory: &Path, number: u64) -> PathBuf {
    directory.join(format!("segment-{number:020}.log"))
}

pub(super) fn snapshot(directory: &Path, through: Position) -> PathBuf {
    directory.join(format!("snapshot-{:020}.snap", through.0))
}

/// The temporary name of an unfinished file.
pub(super) fn temporary(path: &Path) -> PathBuf {
    path.with_extension(TEMPORARY)
}

/// Empty if the directory does not exist. Files with other names do not belong to the log and are ignored.
pub(super) fn list(directory: &Path) -> io::Result<Listing> {
    let mut listing = Listing::default();
    let entries = match fs::read_dir(directory) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(listing),
        entries => entries?,
    };
    for entry in entries {
        let name = entry?.file_name();
        let Some(name) = name.to_str() else { continue };
        if let Some(number) = number(name, "segment-", ".log") {
            listing.segments.push(number);
        } else if let Some(through) = number(name, "snapshot-", ".snap") {
            listing.snapshots.push(Position(through));
        } else if number(name, "segment-", ".tmp").or_else(|| number(name, "snapshot-", ".tmp")).is_some() {
            listing.unfinished.push(directory.join(name));
        }
    }
    listing.segments.sort_unstable();
    listing.snapshots.sort_unstable();
    listing.unfinished.sort_unstable();
    Ok(listing)
}

fn number(name: &str, before: &str, after: &str) -> Option<u64> {
    let digits = name.strip_prefix(before)?.strip_suffix(after)?;
    (digits.len() == 20).then(|| digits.parse().ok()).flatten()
}
