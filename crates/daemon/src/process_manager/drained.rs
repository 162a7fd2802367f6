//! The drain of this host, in which it takes no new work: stored as a file in the runtime directory, so that it outlasts a restart of the
//! process manager.

use ratn_worker::runtime_directory::RuntimeDirectory;
use std::io;
use std::path::PathBuf;

#[derive(Debug)]
pub(super) struct Drained {
    file: PathBuf,
}

impl Drained {
    pub(super) fn of(directory: &RuntimeDirectory) -> Drained {
        Drained { file: directory.path().join("drained") }
    }

    pub(super) fn is_set(&self) -> bool {
        self.file.exists()
    }

    pub(super) fn set(&self, drained: bool) -> io::Result<()> {
        if drained {
            return std::fs::write(&self.file, "");
        }
        match std::fs::remove_file(&self.file) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            _ => Ok(()),
        }
    }
}
