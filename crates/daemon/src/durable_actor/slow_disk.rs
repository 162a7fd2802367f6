//! A disk whose syncs hang for as long as a test wants, or fail.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_storage::{Disk, Files, LogFile};
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex};

/// Clones share the state.
#[derive(Debug, Clone, Default)]
pub(crate) struct SlowDisk(Arc<(Mutex<bool>, Condvar)>, Arc<AtomicBool>);

/// The disk goes on when this is dropped.
pub(crate) struct Hanging(SlowDisk);

#[derive(Debug)]
struct SlowFile(SlowDisk, Box<dyn LogFile>);

impl SlowDisk {
    pub(crate) fn files(&self) -> Arc<dyn Files> {
        Arc::new(self.clone())
    }

    /// From now on every sync of a file fails.
    pub(crate) fn fail(&self) {
        self.1.store(true, Ordering::SeqCst);
    }

    /// From now on no sync of a file ends.
    pub(crate) fn hang(&self) -> Hanging {
        *self.0.0.lock().unwrap() = true;
        Hanging(self.clone())
    }
}

impl Drop for Hanging {
    fn drop(&mut self) {
        *self.0.0.0.lock().unwrap() = false;
        self.0.0.1.notify_all();
    }
}

impl Files for SlowDisk {
    fn create(&self, path: &Path) -> io::Result<Box<dyn LogFile>> {
        Ok(Box::new(SlowFile(self.clone(), Disk.create(path)?)))
    }
}

impl LogFile for SlowFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.1.write(bytes)
    }

    fn reserve(&mut self, bytes: usize) -> io::Result<()> {
        self.1.reserve(bytes)
    }

    fn cut(&mut self) -> io::Result<()> {
        self.1.cut()
    }

    fn sync(&mut self) -> io::Result<()> {
        let (hangs, goes_on) = &*self.0.0;
        drop(goes_on.wait_while(hangs.lock().unwrap(), |hangs| *hangs).unwrap());
        if self.0.1.load(Ordering::SeqCst) {
            return Err(io::Error::other("the disk is gone"));
        }
        self.1.sync()
    }
}
