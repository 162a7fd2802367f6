//! The file operations of the log, as few as possible, so that tests can replace the disk by one that fails.

use std::fmt;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Seek, Write};
use std::os::unix::fs::FileExt;
use std::path::Path;

/// A file that is being written.
pub trait LogFile: fmt::Debug + Send {
    /// Appends bytes to those that were written.
    ///
    /// # Errors
    /// The system's error.
    fn write(&mut self, bytes: &[u8]) -> io::Result<()>;
    /// Writes this many zeros where the next bytes will go. Syncing bytes that overwrite others takes less time than syncing a file that
    /// has grown.
    ///
    /// # Errors
    /// The system's error.
    fn reserve(&mut self, bytes: usize) -> io::Result<()>;
    /// Truncates what was reserved and not written.
    ///
    /// # Errors
    /// The system's error.
    fn cut(&mut self) -> io::Result<()>;
    /// Returns when all written bytes are on disk.
    ///
    /// # Errors
    /// The system's error.
    fn sync(&mut self) -> io::Result<()>;
}

/// The file operations: those of this machine's file system, unless overridden.
pub trait Files: fmt::Debug + Send + Sync {
    /// Creates an empty file, or truncates an existing one.
    ///
    /// # Errors
    /// The system's error.
    fn create(&self, path: &Path) -> io::Result<Box<dyn LogFile>> {
        Ok(Box::new(OpenOptions::new().create(true).write(true).truncate(true).open(path)?))
    }
    /// Creates a directory in an existing one.
    ///
    /// # Errors
    /// The system's error, also if it exists already.
    fn create_directory(&self, path: &Path) -> io::Result<()> {
        fs::create_dir(path)
    }
    /// Renames a file or a directory; replaces an existing target.
    ///
    /// # Errors
    /// The system's error.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }
    /// Removes a file.
    ///
    /// # Errors
    /// The system's error.
    fn remove(&self, path: &Path) -> io::Result<()> {
        fs::remove_file(path)
    }
    /// Returns when the names in the directory are on disk.
    ///
    /// # Errors
    /// The system's error.
    fn sync_directory(&self, path: &Path) -> io::Result<()> {
        File::open(path)?.sync_all()
    }
}

/// The file system of this machine.
#[derive(Debug)]
pub struct Disk;

impl Files for Disk {}

impl LogFile for File {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.write_all(bytes)
    }

    fn reserve(&mut self, bytes: usize) -> io::Result<()> {
        let end = self.stream_position()?;
        self.write_all_at(&vec![0; bytes], end)
    }

    fn cut(&mut self) -> io::Result<()> {
        let end = self.stream_position()?;
        self.set_len(end)
    }

    fn sync(&mut self) -> io::Result<()> {
        self.sync_data()
    }
}
