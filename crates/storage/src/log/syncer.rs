//! The one writing thread: takes all records that wait, does one write and one sync, reports its progress, and repeats.
//!
//! The slower the disk, the more records share a sync. After the first error nothing is written any more: a failed sync may have dropped
//! its data, and a later successful sync says nothing about them.

use super::Durability;
use super::directory;
use super::files::{Files, LogFile};
use super::format::{FRAME_HEADER, FrameHeader, RECORD_HEADER, SEGMENT_HEADER, SegmentHeader, u32_at};
use super::lock::Lock;
use super::shared::Shared;
use crate::error::Fault;
use crate::pending::Batch;
use crate::store::Position;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// Number of bytes reserved at once. Reserving costs about as much as a sync, and should be rare.
const RESERVE: u64 = 1 << 20;

/// Pause after a failed check of the place.
const LOOK_AGAIN: Duration = Duration::from_millis(50);

/// If nobody waits for the disk, records that arrive within this time are written together: waking a thread costs more than an append.
const LINGER: Duration = Duration::from_millis(5);

/// The segment that is written.
#[derive(Debug)]
pub(super) struct Active {
    pub(super) header: SegmentHeader,
    pub(super) file: Box<dyn LogFile>,
    /// Length of what was written, in bytes.
    pub(super) length: u64,
    /// Number of zeros reserved after it.
    pub(super) reserved: u64,
}

#[derive(Debug)]
pub(super) struct Syncer {
    pub(super) shared: Arc<Shared>,
    pub(super) files: Arc<dyn Files>,
    pub(super) lock: Lock,
    pub(super) active: Active,
    pub(super) durability: Durability,
    pub(super) segment_bytes: u64,
}

/// Reports that no thread writes any more, in whatever way the thread ended.
struct Ended(Arc<Shared>);

impl Drop for Ended {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.0.pending.stop(&Fault::Ended { place: self.0.directory.display().to_string() });
        }
    }
}

impl Syncer {
    pub(super) fn run(mut self) {
        let shared = self.shared.clone();
        let _ended = Ended(shared.clone());
        let linger = if self.durability == Durability::None { LINGER } else { Duration::ZERO };
        while let Some((mut batch, rotate)) = shared.pending.take(linger) {
            ratn_panic_point::panic_point("log-syncer");
            if let Err(fault) = self.commit(&mut batch, rotate) {
                shared.pending.stop(&fault);
                return;
            }
            shared.pending.give_back(batch);
        }
        // Everything is acknowledged, and remaining zeros do no harm.
        let _ = self.active.file.cut();
    }

    fn commit(&mut self, batch: &mut Batch, rotate: bool) -> Result<(), Fault> {
        let empty = self.active.length == SEGMENT_HEADER as u64;
        if !empty && (rotate || self.active.length >= self.segment_bytes) {
            self.begin_segment(batch.first)?;
        }
        match self.durability {
            Durability::None => self.write(&mut batch.bytes, batch.first, batch.count),
            Durability::Group => {
                self.write(&mut batch.bytes, batch.first, batch.count)?;
                self.sync(batch.last())
            }
            Durability::Each => self.write_each(batch),
        }
    }

    fn write_each(&mut self, batch: &Batch) -> Result<(), Fault> {
        let mut frame = Vec::new();
        let mut at = FRAME_HEADER;
        for index in 0..u64::from(batch.count) {
            let end = at + RECORD_HEADER + u32_at(&batch.bytes, at) as usize;
            let position = Position(batch.first.0 + index);
            frame.clear();
            frame.resize(FRAME_HEADER, 0);
            frame.extend_from_slice(&batch.bytes[at..end]);
            self.write(&mut frame, position, 1)?;
            self.sync(position)?;
            at = end;
        }
        Ok(())
    }

    /// Completes the header of a frame, and appends the frame to the segment.
    fn write(&mut self, frame: &mut [u8], first: Position, count: u32) -> Result<(), Fault> {
        let active = &mut self.active;
        let (header, body) = frame.split_at_mut(FRAME_HEADER);
        let crc = active.header.checksum(active.length, first, count, body);
        // The length was checked against a limit below 4 GiB when the records were appended.
        let length = u32::try_from(body.len()).unwrap_or(u32::MAX);
        header.copy_from_slice(&FrameHeader { length, crc, first, count }.encode());
        active.file.write(frame).map_err(|error| self.fault("write", error))?;
        self.active.length += frame.len() as u64;
        self.active.reserved = self.active.reserved.saturating_sub(frame.len() as u64);
        Ok(())
    }

    /// Acknowledges what was written when it is on disk and the place still belongs to this writer.
    fn sync(&mut self, through: Position) -> Result<(), Fault> {
        self.reserve();
        self.active.file.sync().map_err(|error| self.fault("sync", error))?;
        self.check_place()?;
        self.shared.pending.synced(through);
        Ok(())
    }

    /// Returns when a check has shown that the place still belongs to this writer. If the check fails, nothing is known and nothing is
    /// lost: the check is repeated until the writer is closed.
    fn check_place(&self) -> Result<(), Fault> {
        loop {
            match self.lock.check() {
                Err(Fault::Io { .. }) if !self.shared.pending.is_closing() => std::thread::sleep(LOOK_AGAIN),
                seen => return seen,
            }
        }
    }

    /// Reserves room for the syncs after the next one. If the disk has no space for it, it may still have space for records.
    fn reserve(&mut self) {
        let active = &mut self.active;
        let bytes = RESERVE.min(self.segment_bytes.saturating_sub(active.length));
        if active.reserved == 0 && active.file.reserve(bytes as usize).is_ok() {
            active.reserved = bytes;
        }
    }

    fn begin_segment(&mut self, first: Position) -> Result<(), Fault> {
        // Only the last segment may end in something else than a record, whatever the durability.
        self.active.file.cut().map_err(|error| self.fault("cut", error))?;
        self.active.file.sync().map_err(|error| self.fault("sync", error))?;
        self.check_place()?;
        let header = SegmentHeader { number: self.active.header.number + 1, first, ..self.active.header };
        self.active = begin(&*self.files, &self.shared.directory, header, &[])
            .map_err(|(action, path, error)| fault(action, path, error))?;
        // This has to happen before a compaction may remove the previous segment.
        let path = directory::segment(&self.shared.directory, header.number);
        self.lock.writes(path.clone()).map_err(|error| fault("look at", path, error))?;
        self.shared.segment_begun(header.number, first);
        Ok(())
    }

    fn fault(&self, action: &'static str, error: io::Error) -> Fault {
        fault(action, directory::segment(&self.shared.directory, self.active.header.number), error)
    }
}

fn fault(action: &'static str, path: PathBuf, error: io::Error) -> Fault {
    Fault::Io { action, place: path.display().to_string(), source: Arc::new(error) }
}

/// The failed operation, the file, and the error.
pub(super) type Failed = (&'static str, PathBuf, io::Error);

/// Creates a segment with these frames. It gets its name when it is on disk, and replaces a file of that name.
pub(super) fn begin(
    files: &dyn Files,
    directory: &Path,
    header: SegmentHeader,
    frames: &[u8],
) -> Result<Active, Failed> {
    let path = directory::segment(directory, header.number);
    let temporary = directory::temporary(&path);
    let written = write_anew(files, &temporary, &header, frames)
        .and_then(|file| files.rename(&temporary, &path).map(|()| file).map_err(|error| ("rename", error)));
    if written.is_err() {
        // The temporary file would use space that a full disk lacks.
        let _ = files.remove(&temporary);
    }
    let synced = |file| {
        files.sync_directory(directory).map_err(|error| ("sync the directory of", error))?;
        Ok(Active { header, file, length: (SEGMENT_HEADER + frames.len()) as u64, reserved: 0 })
    };
    written.and_then(synced).map_err(|(action, error)| (action, path, error))
}

fn write_anew(
    files: &dyn Files,
    path: &Path,
    header: &SegmentHeader,
    frames: &[u8],
) -> Result<Box<dyn LogFile>, (&'static str, io::Error)> {
    let mut file = files.create(path).map_err(|error| ("create", error))?;
    file.write(&header.encode()).map_err(|error| ("write", error))?;
    file.write(frames).map_err(|error| ("write", error))?;
    file.sync().map_err(|error| ("sync", error))?;
    Ok(file)
}
