//! The session id of a runtime directory's process manager, in a file: the successor of a killed process manager continues the session, so
//! that leases of adopted workers stay valid. An id that turns out to be another caller's is replaced. If the new id cannot be written, it is
//! used all the same: a successor finds the old id, which is still another caller's, and makes a third one.

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

    /// The id; creates one where there is none.
    pub(super) fn id(&self) -> io::Result<String> {
        match std::fs::read_to_string(&self.file) {
            Ok(known) if !known.trim().is_empty() => Ok(known.trim().to_owned()),
            _ => {
                let (fresh, written) = self.renew();
                written.map(|()| fresh)
            }
        }
    }

    /// Makes another id; also returns whether it is on the disk.
    pub(super) fn renew(&self) -> (String, io::Result<()>) {
        let fresh = fresh_id(ROLE);
        let written = self.write(&fresh);
        (fresh, written)
    }

    fn write(&self, id: &str) -> io::Result<()> {
        let new = self.file.with_extension("session.new");
        let mut file = File::create(&new)?;
        file.write_all(id.as_bytes())?;
        file.sync_all()?;
        std::fs::rename(&new, &self.file)?;
        if let Some(folder) = self.file.parent() {
            File::open(folder)?.sync_all()?;
        }
        Ok(())
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
        let (second, written) = SessionFile::of(&directory).renew();
        written.unwrap();
        assert_ne!(second, first);
        assert_eq!(id(), second);
    }

    #[test]
    fn where_an_id_cannot_be_written_down_the_next_one_is_another_all_the_same() {
        let place = tempfile::tempdir().unwrap();
        let directory = RuntimeDirectory::create(place.path().join("run")).unwrap();
        let file = SessionFile::of(&directory);
        let first = file.id().unwrap();
        // A directory blocks the place of the new file.
        std::fs::create_dir(directory.path().join("process-manager.session.new")).unwrap();
        let (second, written) = file.renew();
        assert!(written.is_err() && second != first);
        assert_eq!(file.id().unwrap(), first);
    }
}
