//! Writes a snapshot into the log's directory, and reads it.
//!
//! The file gets its name when it is completely on disk: a partial file never has that name.

use super::directory;
use super::files::Files;
use super::format::{SNAPSHOT_HEADER, SNAPSHOT_MAGIC, SnapshotHeader, StoreId, VERSION, version};
use crate::error::ReadError;
use crate::store::{Position, Snapshot};
use bytes::Bytes;
use crc32c::crc32c;
use std::io;
use std::path::Path;

/// The snapshot is synced in pieces of this many bytes, so that a sync of the log waits for at most one of them.
const PIECE: usize = 1 << 20;

/// The failed operation, and its error.
pub(super) type Step = (&'static str, io::Error);

pub(super) fn write(files: &dyn Files, directory: &Path, store: StoreId, snapshot: &Snapshot) -> Result<(), Step> {
    let path = directory::snapshot(directory, snapshot.through);
    let temporary = directory::temporary(&path);
    let written = write_as(files, &temporary, store, snapshot)
        .and_then(|()| files.rename(&temporary, &path).map_err(|error| ("rename", error)));
    if written.is_err() {
        // The file has no snapshot's name; the next writer removes it if this fails.
        let _ = files.remove(&temporary);
    }
    written?;
    files.sync_directory(directory).map_err(|error| ("sync the directory of", error))
}

fn write_as(files: &dyn Files, path: &Path, store: StoreId, snapshot: &Snapshot) -> Result<(), Step> {
    let payload = &snapshot.payload;
    let header =
        SnapshotHeader { store, through: snapshot.through, length: payload.len() as u64, payload_crc: crc32c(payload) };
    let mut file = files.create(path).map_err(|error| ("create", error))?;
    file.write(&header.encode()).map_err(|error| ("write", error))?;
    for piece in payload.chunks(PIECE) {
        file.write(piece).map_err(|error| ("write", error))?;
        file.sync().map_err(|error| ("sync", error))?;
    }
    file.sync().map_err(|error| ("sync", error))
}

pub(super) fn read(place: &str, bytes: &Bytes) -> Result<(StoreId, Snapshot), ReadError> {
    let damaged = |offset, what: &str| ReadError::Damaged { place: place.to_owned(), offset, what: what.to_owned() };
    let header = match version(bytes, SNAPSHOT_MAGIC) {
        None => return Err(damaged(0, "it does not begin as a snapshot of a log does")),
        // A later version adds its reader here, and goes on reading this one.
        Some(VERSION) => bytes
            .first_chunk::<SNAPSHOT_HEADER>()
            .and_then(SnapshotHeader::decode)
            .ok_or_else(|| damaged(0, "the checksum of its header is wrong"))?,
        Some(0) => return Err(damaged(0, "there is no format version 0")),
        Some(found) => return Err(ReadError::Newer { place: place.to_owned(), found, supported: VERSION }),
    };
    let payload = bytes.slice(SNAPSHOT_HEADER..);
    if payload.len() as u64 != header.length {
        return Err(damaged(bytes.len() as u64, "it is not as long as its header says"));
    }
    if crc32c(&payload) != header.payload_crc {
        return Err(damaged(SNAPSHOT_HEADER as u64, "the checksum of its content is wrong"));
    }
    Ok((header.store, Snapshot { through: header.through, payload }))
}

/// Checks that the position in the file's name is the one in the file.
pub(super) fn read_named(path: &Path, through: Position, bytes: &Bytes) -> Result<(StoreId, Snapshot), ReadError> {
    let place = path.display().to_string();
    let (store, snapshot) = read(&place, bytes)?;
    if snapshot.through != through {
        let what = format!("its name says {through}, and its header {}", snapshot.through);
        return Err(ReadError::Damaged { place, offset: 0, what });
    }
    Ok((store, snapshot))
}
