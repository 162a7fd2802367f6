//! The writer's side of a log in files.

use super::compaction::Compaction;
use super::directory;
use super::files::Files;
use super::format::StoreId;
use super::lock::HeldPlace;
use super::shared::Shared;
use super::syncer::Syncer;
use super::{Durability, Options};
use crate::durable::Durable;
use crate::error::{AppendError, CompactError, CopyError, Fault};
use crate::store::{MakeSnapshot, Place, Position, Writer};
use std::io;
use std::sync::Arc;
use std::thread::{self, JoinHandle};

#[derive(Debug)]
pub(super) struct LogWriter {
    shared: Arc<Shared>,
    files: Arc<dyn Files>,
    store: StoreId,
    options: Options,
    place: HeldPlace,
    syncer: Option<JoinHandle<()>>,
    compaction: Option<JoinHandle<()>>,
}

impl LogWriter {
    pub(super) fn start(syncer: Syncer, store: StoreId, options: Options) -> io::Result<LogWriter> {
        let (shared, files, place) = (syncer.shared.clone(), syncer.files.clone(), syncer.lock.place());
        let syncer = thread::Builder::new().name("log-syncer".to_owned()).spawn(move || syncer.run())?;
        Ok(LogWriter { shared, files, store, options, place, syncer: Some(syncer), compaction: None })
    }

    /// Writes a mark, and replaces what it said before.
    fn write_mark(&self, name: &str, text: &str) -> Result<(), CopyError> {
        let mark = self.shared.directory.join(name);
        let temporary = directory::temporary(&mark);
        let written =
            self.files.create(&temporary).and_then(|mut file| file.write(text.as_bytes()).and_then(|()| file.sync()));
        let marked = written.and_then(|()| self.files.rename(&temporary, &mark));
        let marked = marked.and_then(|()| self.files.sync_directory(&self.shared.directory));
        marked.map_err(|source| CopyError::Io { action: "make", place: mark.display().to_string(), source })
    }

    /// Writes what waits, and ends both threads.
    fn end(&mut self) {
        self.shared.pending.close();
        for thread in [self.syncer.take(), self.compaction.take()].into_iter().flatten() {
            // A panic of the thread has stopped the log already, with a fault.
            let _ = thread.join();
        }
        self.shared.pending.stop(&Fault::Closed);
    }
}

impl Writer for LogWriter {
    fn append(&mut self, record: &[u8]) -> Result<Position, AppendError> {
        let most = self.options.record_bytes;
        if record.len() > most {
            return Err(AppendError::TooLarge { bytes: record.len(), most });
        }
        let at_once = self.options.durability == Durability::None;
        self.shared.pending.append(record, self.options.buffered_bytes, at_once)
    }

    fn durable(&self) -> Durable {
        Durable::new(self.shared.pending.watch())
    }

    fn compact(&mut self, through: Position, snapshot: MakeSnapshot) -> Result<(), CompactError> {
        self.shared.pending.begin_compaction(through)?;
        if let Some(ended) = self.compaction.take() {
            // The thread has reported its end, so this waits only for its last instructions.
            let _ = ended.join();
        }
        let (shared, files) = (self.shared.clone(), self.files.clone());
        let compaction = Compaction { shared, files, store: self.store, through };
        let started = thread::Builder::new().name("log-compaction".to_owned()).spawn(move || compaction.run(snapshot));
        match started {
            Ok(thread) => self.compaction = Some(thread),
            Err(error) => {
                let failure = crate::error::CompactionFailure {
                    through,
                    action: "start a thread for",
                    place: self.shared.directory.display().to_string(),
                    source: Arc::new(error),
                };
                self.shared.pending.end_compaction(Err(Some(failure)));
            }
        }
        Ok(())
    }

    fn place(&self) -> Box<dyn Place> {
        Box::new(self.place.clone())
    }

    fn mark_unfinished(&mut self) -> Result<(), CopyError> {
        self.place.check()?;
        let mark = self.shared.directory.join(directory::UNFINISHED_COPY);
        let marked = self.files.create(&mark).and_then(|mut file| file.sync());
        let marked = marked.and_then(|()| self.files.sync_directory(&self.shared.directory));
        marked.map_err(|source| CopyError::Io { action: "make", place: mark.display().to_string(), source })
    }

    fn mark_complete(&mut self, moved: &str) -> Result<(), CopyError> {
        self.place.check()?;
        self.write_mark(directory::UNFINISHED_COPY, moved)
    }

    fn mark_whole(&mut self) -> Result<(), CopyError> {
        self.place.check()?;
        let mark = self.shared.directory.join(directory::UNFINISHED_COPY);
        let removed = self.files.remove(&mark).and_then(|()| self.files.sync_directory(&self.shared.directory));
        removed.map_err(|source| CopyError::Io { action: "remove", place: mark.display().to_string(), source })
    }

    fn mark_moved(&mut self, to: &str) -> Result<(), CopyError> {
        self.place.check().map_err(CopyError::SourceLost)?;
        self.write_mark(directory::MOVED, to)
    }

    fn waiting_bytes(&self) -> usize {
        self.shared.pending.waiting_bytes()
    }

    fn close(mut self: Box<Self>) -> Result<Position, Fault> {
        let appended = self.shared.pending.appended();
        self.shared.pending.close();
        if let Some(syncer) = self.syncer.take() {
            let _ = syncer.join();
        }
        let fault = self.shared.pending.fault();
        self.end();
        fault.map_or(Ok(appended), Err)
    }
}

impl Drop for LogWriter {
    fn drop(&mut self) {
        self.end();
    }
}
