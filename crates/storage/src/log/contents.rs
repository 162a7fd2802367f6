//! Reads a log's directory: the latest snapshot, and the segments with records after it.
//!
//! Segments whose records are all in the snapshot are not read: an interrupted compaction may have left them.

use super::directory::{self, Listing};
use super::format::{SEGMENT_HEADER, StoreId};
use super::segment::{self, Segment};
use super::snapshot;
use crate::error::ReadError;
use crate::store::{Epoch, Position, Record, Recovered, Snapshot};
use bytes::Bytes;
use std::fs::{self, File};
use std::io::{self, Read};
use std::path::Path;

/// Number of attempts to read. A compaction by the writer may remove a file that is about to be read; then reading starts again.
const LOOKS: usize = 8;

/// The contents of a log's directory.
#[derive(Debug, Default)]
pub(super) struct Contents {
    pub(super) listing: Listing,
    /// `None` if there is no log yet.
    pub(super) store: Option<StoreId>,
    pub(super) snapshot: Option<Snapshot>,
    /// Without the segments that the snapshot replaces.
    pub(super) segments: Vec<Segment>,
}

impl Contents {
    pub(super) fn epoch(&self) -> Epoch {
        self.segments.last().map_or(Epoch(0), |segment| segment.header.epoch)
    }

    pub(super) fn last(&self) -> Position {
        let end = self.segments.last().map_or(Position(0), |segment| Position(segment.end().0 - 1));
        end.max(self.through())
    }

    pub(super) fn through(&self) -> Position {
        self.snapshot.as_ref().map_or(Position(0), |snapshot| snapshot.through)
    }

    pub(super) fn recovered(&self) -> Recovered {
        let through = self.through();
        let records: Vec<Record> = self
            .segments
            .iter()
            .flat_map(|segment| &segment.records)
            .filter(|record| record.position > through)
            .cloned()
            .collect();
        let torn = self.segments.last().and_then(|segment| segment.torn.clone());
        Recovered { epoch: self.epoch(), snapshot: self.snapshot.clone(), records, torn, restored: false }
    }
}

/// Reads the log, also while a writer writes it.
pub(super) fn read(directory: &Path) -> Result<Contents, ReadError> {
    for _ in 1..LOOKS {
        match read_once(directory) {
            Err(ReadError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => {}
            Err(ReadError::Incomplete { .. }) => {}
            read => return read,
        }
    }
    read_once(directory)
}

fn read_once(directory: &Path) -> Result<Contents, ReadError> {
    let listing = directory::list(directory).map_err(|source| ReadError::Io {
        action: "list",
        place: directory.display().to_string(),
        source,
    })?;
    let unfinished = directory.join(directory::UNFINISHED_COPY);
    if unfinished.exists() {
        let place = directory.display().to_string();
        // The mark of a complete copy is not empty.
        let complete = std::fs::metadata(&unfinished).is_ok_and(|mark| mark.len() > 0);
        return Err(ReadError::Unfinished { complete, how: format!("rm -r {place}"), place });
    }
    let moved = directory.join(directory::MOVED);
    match std::fs::read_to_string(&moved) {
        Ok(to) => {
            let (place, how) = (directory.display().to_string(), format!("rm {}", moved.display()));
            return Err(ReadError::Moved { place, to, how });
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => {}
        Err(source) => return Err(ReadError::Io { action: "read", place: moved.display().to_string(), source }),
    }
    let mut contents = Contents::default();
    if let Some(&through) = listing.snapshots.last() {
        let path = directory::snapshot(directory, through);
        let (store, snapshot) = snapshot::read_named(&path, through, &whole(&path)?)?;
        contents.store = Some(store);
        contents.snapshot = Some(snapshot);
    }
    for &number in needed(directory, &listing, contents.through())? {
        let path = directory::segment(directory, number);
        let place = path.display().to_string();
        let segment = segment::read(&place, &whole(&path)?, Some(&number) == listing.segments.last())?;
        follows(&place, &contents, &segment, number)?;
        contents.store = Some(segment.header.store);
        contents.segments.push(segment);
    }
    if contents.segments.is_empty() && contents.snapshot.is_some() {
        let what = "there is a snapshot and no segment".to_owned();
        return Err(ReadError::Incomplete { place: directory.display().to_string(), what });
    }
    contents.listing = listing;
    Ok(contents)
}

/// The segments from the one with the first record after the snapshot on.
fn needed<'a>(directory: &Path, listing: &'a Listing, through: Position) -> Result<&'a [u64], ReadError> {
    // From the last one backwards, so that at most one superfluous segment is opened.
    let mut from = listing.segments.len();
    while from > 0 {
        from -= 1;
        let path = directory::segment(directory, listing.segments[from]);
        let place = path.display().to_string();
        let mut bytes = Vec::with_capacity(SEGMENT_HEADER);
        let opened = File::open(&path).and_then(|file| file.take(SEGMENT_HEADER as u64).read_to_end(&mut bytes));
        opened.map_err(|source| ReadError::Io { action: "read", place: place.clone(), source })?;
        if segment::header(&place, &bytes)?.first <= through.next() {
            break;
        }
    }
    Ok(&listing.segments[from..])
}

/// Checks that a segment begins where the previous contents end, and belongs to the same log.
fn follows(place: &str, before: &Contents, segment: &Segment, number: u64) -> Result<(), ReadError> {
    let damaged = |what| Err(ReadError::Damaged { place: place.to_owned(), offset: 0, what });
    let header = &segment.header;
    if header.number != number {
        return damaged(format!("its name says segment {number}, and its header {}", header.number));
    }
    if before.store.is_some_and(|store| store != header.store) {
        return damaged("it belongs to another log".to_owned());
    }
    let expected = before.segments.last().map_or(before.through().next(), Segment::end);
    let first = before.segments.is_empty();
    if header.first == expected || (first && header.first < expected) {
        return Ok(());
    }
    if header.first < expected {
        return damaged(format!("it begins with record {}, and {expected} was expected", header.first));
    }
    let what = format!("records {expected} to {} are missing before it", header.first.0 - 1);
    Err(ReadError::Incomplete { place: place.to_owned(), what })
}

fn whole(path: &Path) -> Result<Bytes, ReadError> {
    let bytes =
        fs::read(path).map_err(|source| ReadError::Io { action: "read", place: path.display().to_string(), source })?;
    Ok(Bytes::from(bytes))
}
