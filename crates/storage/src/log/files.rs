//! The file operations of the log, as few as possible, so that tests can replace the disk by one that fails.

use std::fmt;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Seek, Write};
use std::os::unix::fs::FileExt;
use std::path::Path;

/// A file that is being written.
pub trait LogFile: fmt::Debug + Send {
    /// Puts bytes behind those that were written.
    ///
    /// # Errors
    /// What the system says.
    fn write(&mut self, bytes: &[u8]) -> io::Result<()>;
    /// Puts so many zeros where the next bytes will go. A sync of bytes that come in the place of others has less to do than one of a
    /// file that grew.
    ///
    /// # Errors
    /// What the system says.
    fn reserve(&mut self, bytes: usize) -> io::Result<()>;
    /// Takes away what was reserved and not written.
    ///
    /// # Errors
    /// What the system says.
    fn cut(&mut self) -> io::Result<()>;
    /// Returns when what was written is on the disk.
    ///
    /// # Errors
    /// What the system says.
    fn sync(&mut self) -> io::Result<()>;
}

/// A disk: the file system of this machine, unless an implementation does something else.
pub trait Files: fmt::Debug + Send + Sync {
    /// An empty file; what was there is gone.
    ///
    /// # Errors
    /// What the system says.
    fn create(&self, path: &Path) -> io::Result<Box<dyn LogFile>> {
        Ok(Box::new(OpenOptions::new().create(true).write(true).truncate(true).open(path)?))
    }
    /// A directory in one that is there.
    ///
    /// # Errors
    /// What the system says, also that it is there already.
    fn create_directory(&self, path: &Path) -> io::Result<()> {
        fs::create_dir(path)
    }
    /// Another name for a file or a directory, in place of what had the name.
    ///
    /// # Errors
    /// What the system says.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }
    /// The file is gone.
    ///
    /// # Errors
    /// What the system says.
    fn remove(&self, path: &Path) -> io::Result<()> {
        fs::remove_file(path)
    }
    /// Returns when the names in it are on the disk.
    ///
    /// # Errors
    /// What the system says.
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
