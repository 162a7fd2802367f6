//! Reading what a user names: task files and configs, which are small and are files.

use ratn_model::load::MAX_SOURCE;
use std::fs::File;
use std::io::{Error, ErrorKind, Read, Result};
use std::path::Path;

/// The text of a file. A device or a pipe, which might never end, and what is too long for a task file are refused.
pub(crate) fn read(path: &Path) -> Result<String> {
    read_up_to(path, MAX_SOURCE)
}

/// As [`read`], where `most` bytes are not too long.
pub(crate) fn read_up_to(path: &Path, most: usize) -> Result<String> {
    // Asked before it is opened: opening a pipe waits for its writer.
    if !std::fs::metadata(path)?.is_file() {
        return Err(Error::new(ErrorKind::InvalidInput, "not a regular file"));
    }
    let mut bytes = Vec::new();
    File::open(path)?.take(most as u64 + 1).read_to_end(&mut bytes)?;
    if bytes.len() > most {
        return Err(Error::new(ErrorKind::InvalidData, format!("longer than {most} bytes")));
    }
    String::from_utf8(bytes).map_err(|error| Error::new(ErrorKind::InvalidData, error))
}

/// Libraries stand beside the files that use them.
pub(crate) struct Libraries;

impl ratn_model::load::Files for Libraries {
    fn read(&self, using: &str, path: &str) -> std::result::Result<(String, String), String> {
        let file = Path::new(using).parent().unwrap_or(Path::new("")).join(path);
        let text = read(&file).map_err(|error| error.to_string())?;
        // Two ways to one file are one file; its name is as short as it can be.
        let name = file.canonicalize().unwrap_or(file);
        let here = std::env::current_dir().and_then(|here| here.canonicalize()).unwrap_or_default();
        Ok((name.strip_prefix(here).unwrap_or(&name).display().to_string(), text))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn only_a_file_of_bounded_length_is_read() {
        let directory = tempfile::tempdir().unwrap();
        let pipe = directory.path().join("pipe");
        nix::unistd::mkfifo(&pipe, nix::sys::stat::Mode::S_IRWXU).unwrap();
        for endless in [Path::new("/dev/zero"), directory.path(), &pipe] {
            assert_eq!(read(endless).unwrap_err().to_string(), "not a regular file");
        }
        let file = directory.path().join("file");
        std::fs::write(&file, vec![b'#'; MAX_SOURCE]).unwrap();
        assert_eq!(read(&file).unwrap().len(), MAX_SOURCE);
        std::fs::write(&file, vec![b'#'; MAX_SOURCE + 1]).unwrap();
        assert!(read(&file).unwrap_err().to_string().starts_with("longer than"));
    }

    #[test]
    fn a_library_is_found_from_the_file_that_uses_it_and_has_one_name() {
        use ratn_model::load::Files;
        let directory = tempfile::tempdir().unwrap();
        std::fs::create_dir(directory.path().join("parts")).unwrap();
        std::fs::write(directory.path().join("parts/a.yaml"), "task: a\n").unwrap();
        let using = directory.path().join("main.yaml").display().to_string();
        let (name, text) = Libraries.read(&using, "parts/a.yaml").unwrap();
        assert_eq!(text, "task: a\n");
        assert_eq!(Libraries.read(&using, "./parts/../parts/a.yaml").unwrap().0, name);
        // And on from there.
        assert_eq!(Libraries.read(&name, "a.yaml").unwrap().0, name);
        assert!(Libraries.read(&using, "parts").unwrap_err().contains("not a regular file"));
    }
}
