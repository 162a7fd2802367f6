//! Reading a worker's log: the older file that was kept, the current one, and everything written from then on, also when the file
//! is rotated or truncated.

use ratn_worker::runtime_directory::RuntimeDirectory;
use std::fs::File;
use std::io::{self, Read, Seek};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// Maximum bytes per read.
pub const CHUNK_BYTES: usize = 65_536;

/// The log file of a worker in a runtime directory; the worker's id is part of the file's name.
pub fn log_file(directory: &RuntimeDirectory, worker: &str) -> PathBuf {
    directory.path().join("logs").join(format!("{worker}.log"))
}

/// The file that keeps the output from before the last rotation.
pub fn previous(log: &Path) -> PathBuf {
    log.with_extension("log.1")
}

/// See the module.
#[derive(Debug)]
pub struct LogReader {
    path: PathBuf,
    /// Inode of the current file; it tells when the file was replaced.
    inode: u64,
    file: File,
    before: Option<File>,
}

impl LogReader {
    /// Opens the log from its beginning, including the kept older file.
    ///
    /// # Errors
    /// Where it cannot be read; `NotFound` where there is no log.
    pub fn open(path: &Path) -> io::Result<LogReader> {
        let file = File::open(path)?;
        let inode = file.metadata()?.ino();
        Ok(LogReader { path: path.to_owned(), inode, file, before: File::open(previous(path)).ok() })
    }

    /// The next bytes, at most [`CHUNK_BYTES`]; empty when nothing was written since the last call.
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
        // Only now all of the replaced file has been read.
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
