//! An emergency stop on disk: a file with the stop's reason, which exists while the stop is in force.
//!
//! Both the file and its folder are synced, so that a confirmed stop is still in force after a power loss. Put the file into a state
//! directory: a runtime directory is empty after a reboot.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The file. Clones refer to the same file.
#[derive(Debug, Clone)]
pub(super) struct Latch {
    file: Arc<Path>,
}

impl Latch {
    /// A latch in this file; its folder is made if it does not exist.
    pub(super) fn at(file: PathBuf) -> io::Result<Latch> {
        let latch = Latch { file: file.into() };
        let folder = latch.folder();
        if !folder.is_dir() {
            fs::create_dir_all(folder)?;
            if let Some(parent) = folder.parent().filter(|parent| parent.is_dir()) {
                sync_directory(parent)?;
            }
        }
        Ok(latch)
    }

    /// The reason of the stop in force, if any.
    pub(super) fn read(&self) -> io::Result<Option<String>> {
        match fs::read(&self.file) {
            Ok(reason) => Ok(Some(String::from_utf8_lossy(&reason).into_owned())),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Returns when the stop is on disk.
    pub(super) async fn set(&self, reason: &str) -> Result<(), String> {
        let (latch, reason) = (self.clone(), reason.to_owned());
        self.on_disk("written", move || latch.write(&reason)).await
    }

    /// Returns when the stop has been removed from the disk.
    pub(super) async fn clear(&self) -> Result<(), String> {
        let latch = self.clone();
        self.on_disk("removed", move || latch.remove()).await
    }

    async fn on_disk(&self, what: &str, task: impl FnOnce() -> io::Result<()> + Send + 'static) -> Result<(), String> {
        let done = tokio::task::spawn_blocking(task).await.unwrap_or_else(|error| Err(io::Error::other(error)));
        done.map_err(|error| format!("{} cannot be {what}: {error}", self.file.display()))
    }

    fn write(&self, reason: &str) -> io::Result<()> {
        let new = self.file.with_extension("new");
        let mut file = File::create(&new)?;
        file.write_all(reason.as_bytes())?;
        file.sync_all()?;
        fs::rename(&new, &self.file)?;
        sync_directory(self.folder())
    }

    fn remove(&self) -> io::Result<()> {
        match fs::remove_file(&self.file) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            _ => sync_directory(self.folder()),
        }
    }

    fn folder(&self) -> &Path {
        self.file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
    }
}

fn sync_directory(directory: &Path) -> io::Result<()> {
    File::open(directory)?.sync_all()
}
