//! Replaces records by a snapshot, in a thread of its own: writes the snapshot, then removes the segments that it replaces.
//!
//! A crash between the two leaves segments that are not read any more; the next compaction or the next writer removes them. A snapshot that
//! cannot be written is discarded, and the log goes on: no acknowledged record depends on it.

use super::files::Files;
use super::format::StoreId;
use super::shared::Shared;
use super::syncer::Failed;
use super::{directory, snapshot};
use crate::durable::Durable;
use crate::error::{CompactionFailure, Fault};
use crate::store::{MakeSnapshot, Position, Snapshot};
use std::path::{Path, PathBuf};
use std::sync::Arc;

#[derive(Debug)]
pub(super) struct Compaction {
    pub(super) shared: Arc<Shared>,
    pub(super) files: Arc<dyn Files>,
    pub(super) store: StoreId,
    pub(super) through: Position,
}

/// Reports the end of the compaction, whatever caused it.
struct Ended<'a>(&'a Shared, Option<Result<Position, Option<CompactionFailure>>>);

impl Drop for Ended<'_> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.0.pending.stop(&Fault::Ended { place: self.0.directory.display().to_string() });
        }
        self.0.pending.end_compaction(self.1.take().unwrap_or(Err(None)));
    }
}

impl Compaction {
    pub(super) fn run(self, make: MakeSnapshot) {
        let mut ended = Ended(&self.shared, None);
        ratn_panic_point::panic_point("log-compaction");
        let payload = make();
        // The snapshot must not contain records that a crash could still take away.
        if Durable::new(self.shared.pending.watch()).wait_blocking(self.through).is_err() {
            return;
        }
        let snapshot = Snapshot { through: self.through, payload };
        let written = snapshot::write(&*self.files, &self.shared.directory, self.store, &snapshot);
        let place = || directory::snapshot(&self.shared.directory, self.through);
        let written = written.map_err(|(action, error)| (action, place(), error));
        let result = written.and_then(|()| self.remove_superfluous());
        ended.1 = Some(result.map(|()| self.through).map_err(|(action, path, source)| {
            let place = path.display().to_string();
            Some(CompactionFailure { through: self.through, action, place, source: Arc::new(source) })
        }));
    }

    fn remove_superfluous(&self) -> Result<(), Failed> {
        let directory = &self.shared.directory;
        let listing = directory::list(directory).map_err(|error| ("list", directory.clone(), error))?;
        let older = listing.snapshots.into_iter().filter(|through| *through < self.through);
        let mut superfluous = self.shared.superfluous(self.through);
        superfluous.extend(older.map(|through| directory::snapshot(directory, through)));
        remove(&*self.files, directory, &superfluous)
    }
}

/// Removes files, in this order.
pub(super) fn remove(files: &dyn Files, directory: &Path, superfluous: &[PathBuf]) -> Result<(), Failed> {
    for path in superfluous {
        files.remove(path).map_err(|error| ("remove", path.clone(), error))?;
    }
    if superfluous.is_empty() {
        return Ok(());
    }
    files.sync_directory(directory).map_err(|error| ("sync", directory.to_owned(), error))
}
