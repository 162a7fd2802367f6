//! Opens files whose path comes from outside: from the command line, from a log, from a robot description.
//!
//! For reading, only regular files are opened. A named pipe would make its reader wait for a writer, a device may never end, and opening
//! one may already have an effect. Another file may get the name at any time, so the file is checked before and after it is opened, and
//! opened without blocking. Writing may also go to a device or a pipe, but not to a pipe that nobody reads: opening it would wait for a
//! reader.

use nix::errno::Errno;
use nix::fcntl::{FcntlArg, OFlag, fcntl};
use std::fs::{File, OpenOptions};
use std::io::{Error, ErrorKind, Read, Result};
use std::os::unix::fs::{FileTypeExt, OpenOptionsExt};
use std::path::Path;

/// Maximum size for small files, in bytes: larger than any config, certificate, ontology or robot description.
pub const USUAL: usize = 16 << 20;

/// Opens a regular file for reading. Never blocks.
///
/// # Errors
/// The system's error; if the path is not a regular file, [`ErrorKind::InvalidInput`].
pub fn open(path: &Path) -> Result<File> {
    regular(std::fs::metadata(path)?.is_file())?;
    let flags = OFlag::O_NONBLOCK | OFlag::O_NOCTTY;
    let file = File::options().read(true).custom_flags(flags.bits()).open(path)?;
    regular(file.metadata()?.is_file())?;
    Ok(file)
}

/// The content of a regular file of at most `most` bytes.
///
/// # Errors
/// As [`open`]; if the file is longer, [`ErrorKind::FileTooLarge`].
pub fn read(path: &Path, most: usize) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path)?.take(most as u64 + 1).read_to_end(&mut bytes)?;
    match bytes.len() <= most {
        true => Ok(bytes),
        false => Err(Error::new(ErrorKind::FileTooLarge, format!("longer than {most} bytes"))),
    }
}

/// The text of a regular file of at most `most` bytes.
///
/// # Errors
/// As [`read`]; if the text is not UTF-8, [`ErrorKind::InvalidData`].
pub fn read_text(path: &Path, most: usize) -> Result<String> {
    String::from_utf8(read(path, most)?).map_err(|error| Error::new(ErrorKind::InvalidData, error))
}

/// Opens a file for writing with these options. Opening never blocks; writing to a pipe waits for its reader, as usual.
///
/// # Errors
/// The system's error; if the file is a pipe that nobody reads, [`ErrorKind::NotConnected`].
pub fn open_to_write(path: &Path, options: &mut OpenOptions) -> Result<File> {
    let flags = OFlag::O_NONBLOCK | OFlag::O_NOCTTY;
    let file = options.custom_flags(flags.bits()).open(path).map_err(|error| {
        let is_pipe = || std::fs::metadata(path).is_ok_and(|is| is.file_type().is_fifo());
        match error.raw_os_error().map(Errno::from_raw) {
            Some(Errno::ENXIO) if is_pipe() => Error::new(
                ErrorKind::NotConnected,
                "it is a named pipe that nobody reads: start its reader first, or name a file",
            ),
            _ => error,
        }
    })?;
    let flags = OFlag::from_bits_retain(fcntl(&file, FcntlArg::F_GETFL)?);
    fcntl(&file, FcntlArg::F_SETFL(flags - OFlag::O_NONBLOCK))?;
    Ok(file)
}

fn regular(is_file: bool) -> Result<()> {
    let problem = "not a regular file: what comes from a pipe or a device has to be written to a file first";
    if is_file { Ok(()) } else { Err(Error::new(ErrorKind::InvalidInput, problem)) }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use std::io::Write;

    #[test]
    fn what_is_no_regular_file_is_refused_at_once() {
        let place = tempfile::tempdir().unwrap();
        let pipe = place.path().join("pipe");
        nix::unistd::mkfifo(&pipe, nix::sys::stat::Mode::S_IRWXU).unwrap();
        for other in [Path::new("/dev/zero"), place.path(), &pipe] {
            let refused = open(other).unwrap_err();
            assert_eq!(refused.kind(), ErrorKind::InvalidInput);
            assert!(refused.to_string().starts_with("not a regular file"), "{refused}");
        }
    }

    #[test]
    fn a_pipe_is_written_where_somebody_reads_it_and_refused_at_once_where_nobody_does() {
        let place = tempfile::tempdir().unwrap();
        let pipe = place.path().join("pipe");
        nix::unistd::mkfifo(&pipe, nix::sys::stat::Mode::S_IRWXU).unwrap();
        let to_write = || open_to_write(&pipe, File::options().write(true).create(true));
        let refused = to_write().unwrap_err();
        assert!(refused.kind() == ErrorKind::NotConnected && refused.to_string().contains("nobody reads"), "{refused}");
        let mut reader = File::options().read(true).custom_flags(OFlag::O_NONBLOCK.bits()).open(&pipe).unwrap();
        let mut writer = to_write().unwrap();
        // More than a pipe holds: the writer waits, without an error.
        let writing = std::thread::spawn(move || writer.write_all(&[7; 200_000]));
        let mut read = 0;
        while read < 200_000 {
            match reader.read(&mut [0; 4_096]) {
                Ok(more) => read += more,
                Err(error) => assert_eq!(error.kind(), ErrorKind::WouldBlock),
            }
        }
        writing.join().unwrap().unwrap();
        assert!(open_to_write(Path::new("/dev/null"), File::options().write(true)).is_ok());
        let file = place.path().join("file");
        assert!(open_to_write(&file, File::options().write(true).create(true)).is_ok() && file.is_file());
    }

    #[test]
    fn a_file_of_the_bound_is_read_and_a_longer_one_is_refused() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "five!").unwrap();
        assert_eq!(read_text(file.path(), 5).unwrap(), "five!");
        let refused = read_text(file.path(), 4).unwrap_err();
        assert_eq!((refused.kind(), refused.to_string().as_str()), (ErrorKind::FileTooLarge, "longer than 4 bytes"));
        std::fs::write(file.path(), b"\xff").unwrap();
        assert_eq!(read_text(file.path(), 5).unwrap_err().kind(), ErrorKind::InvalidData);
    }
}
