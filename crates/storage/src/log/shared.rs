//! State shared by the writer, the syncer and a compaction of a log in files: the records that wait, and the segments.

use super::directory;
use super::format::FRAME_HEADER;
use crate::pending::Pending;
use crate::store::Position;
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};

#[derive(Debug)]
pub(super) struct Shared {
    pub(super) directory: PathBuf,
    pub(super) pending: Pending,
    /// (number, first record) of every segment; the last one is being written.
    segments: Mutex<Vec<(u64, Position)>>,
}

impl Shared {
    pub(super) fn new(
        directory: PathBuf,
        last: Position,
        compacted: Position,
        segments: Vec<(u64, Position)>,
    ) -> Shared {
        let pending = Pending::new(directory.display().to_string(), FRAME_HEADER, last, compacted);
        Shared { directory, pending, segments: Mutex::new(segments) }
    }

    pub(super) fn segment_begun(&self, number: u64, first: Position) {
        self.segments().push((number, first));
    }

    /// Forgets the segments that hold nothing after this position; returns their files, oldest first.
    pub(super) fn superfluous(&self, through: Position) -> Vec<PathBuf> {
        let mut segments = self.segments();
        let kept = segments.iter().skip(1).take_while(|(_, first)| *first <= through.next()).count();
        segments.drain(..kept).map(|(number, _)| directory::segment(&self.directory, number)).collect()
    }

    fn segments(&self) -> MutexGuard<'_, Vec<(u64, Position)>> {
        self.segments.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
