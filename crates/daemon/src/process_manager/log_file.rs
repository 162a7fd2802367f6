//! Reading a worker's log: the older file that was kept, the current one, and what is written from then on, also when the file is
//! begun anew or cut to nothing.

use ratn_worker::runtime_directory::RuntimeDirectory;
use std::fs::File;
use std::io::{self, Read, Seek};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// Read at once at the most.
pub const CHUNK_BYTES: usize = 65_536;

/// Where the log of a worker is, of those that a runtime directory has; its id is part of the file's name.
pub fn log_file(directory: &RuntimeDirectory, worker: &str) -> PathBuf {
    directory.path().join("logs").join(format!("{worker}.log"))
}

/// Where what was written before a log was begun anew is kept.
pub fn previous(log: &Path) -> PathBuf {
    log.with_extension("log.1")
}

/// See the module.
#[derive(Debug)]
pub struct LogReader {
    path: PathBuf,
    /// Of the file that is read; of the one kept of before it is the other's.
    inode: u64,
    file: File,
    before: Option<File>,
}

impl LogReader {
    /// From its beginning, or from the beginning of what was kept of before.
    ///
    /// # Errors
    /// Where it cannot be read; `NotFound` where there is none.
    pub fn open(path: &Path) -> io::Result<LogReader> {
        let file = File::open(path)?;
        let inode = file.metadata()?.ino();
        Ok(LogReader { path: path.to_owned(), inode, file, before: File::open(previous(path)).ok() })
    }

    /// What comes next, at most [`CHUNK_BYTES`]; nothing when nothing was written since the last call.
    ///
    /// # Errors
    /// Where it cannot be read.
    pub fn read(&mut self) -> io::Result<Vec<u8>> {
        if let Some(before) = &mut self.before {
            let bytes = next(before)?;
            if !bytes.is_empty() {
                return Ok(bytes);
            }
            self.before = None;
        }
        let bytes = next(&mut self.file)?;
        if bytes.is_empty() && self.file.stream_position()? > self.file.metadata()?.len() {
            self.file.rewind()?;
            return next(&mut self.file);
        }
        // Of the one before all has been read only now.
        if bytes.is_empty() && std::fs::metadata(&self.path).is_ok_and(|now| now.ino() != self.inode) {
            *self = LogReader { before: None, ..LogReader::open(&self.path)? };
            return next(&mut self.file);
        }
        Ok(bytes)
    }
}

fn next(file: &mut File) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    file.by_ref().take(CHUNK_BYTES as u64).read_to_end(&mut bytes)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use std::io::Write;

    #[test]
    fn a_log_that_is_begun_anew_is_read_on() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("planner-1@compute.log");
        std::fs::write(&path, "one\n").unwrap();
        let mut reader = LogReader::open(&path).unwrap();
        assert_eq!(reader.read().unwrap(), b"one\n");
        assert_eq!(reader.read().unwrap(), b"");
        File::options().append(true).open(&path).unwrap().write_all(b"two\n").unwrap();
        std::fs::rename(&path, previous(&path)).unwrap();
        std::fs::write(&path, "three\n").unwrap();
        assert_eq!([reader.read().unwrap(), reader.read().unwrap()], [b"two\n".to_vec(), b"three\n".to_vec()]);
        File::options().write(true).open(&path).unwrap().set_len(0).unwrap();
        assert_eq!(reader.read().unwrap(), b"");
        std::fs::write(&path, "4\n").unwrap();
        assert_eq!(reader.read().unwrap(), b"4\n");
        std::fs::write(&path, "three\n").unwrap();
        let mut again = LogReader::open(&path).unwrap();
        let read = [again.read().unwrap(), again.read().unwrap(), again.read().unwrap()];
        assert_eq!(read, [b"one\ntwo\n".to_vec(), b"three\n".to_vec(), Vec::new()]);
    }
}
