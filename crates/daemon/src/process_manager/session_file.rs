//! The id of the session of a runtime directory's process manager, in a file: a successor of one that was killed goes on with the session, so
//! that leases of workers that it adopts hold. Where the id is another caller's, another one is on the disk before it is used.

use super::ROLE;
use ratn_worker::client::fresh_id;
use ratn_worker::runtime_directory::RuntimeDirectory;
use std::fs::File;
use std::io::{self, Write};
use std::path::PathBuf;

#[derive(Debug)]
pub(super) struct SessionFile {
    file: PathBuf,
}

impl SessionFile {
    pub(super) fn of(directory: &RuntimeDirectory) -> SessionFile {
        SessionFile { file: directory.path().join("process-manager.session") }
    }

    /// The id; a new one where there is none.
    pub(super) fn id(&self) -> io::Result<String> {
        match std::fs::read_to_string(&self.file) {
            Ok(known) if !known.trim().is_empty() => Ok(known.trim().to_owned()),
            _ => self.renew(),
        }
    }

    /// Another id, once it is on the disk.
    pub(super) fn renew(&self) -> io::Result<String> {
        let fresh = fresh_id(ROLE);
        let new = self.file.with_extension("session.new");
        let mut file = File::create(&new)?;
        file.write_all(fresh.as_bytes())?;
        file.sync_all()?;
        std::fs::rename(&new, &self.file)?;
        if let Some(folder) = self.file.parent() {
            File::open(folder)?.sync_all()?;
        }
        Ok(fresh)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn an_id_is_kept_until_it_is_renewed() {
        let place = tempfile::tempdir().unwrap();
        let directory = RuntimeDirectory::create(place.path().join("run")).unwrap();
        let id = || SessionFile::of(&directory).id().unwrap();
        let first = id();
        assert_eq!(id(), first);
        let second = SessionFile::of(&directory).renew().unwrap();
        assert_ne!(second, first);
        assert_eq!(id(), second);
    }
}
