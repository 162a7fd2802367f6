//! The runtime directory, by which the processes of a system on one machine find each other: one file per role, `<role>.endpoint`, with the
//! endpoint at which the role is served. The file exists exactly while the role is ready.

use crate::endpoint::{Endpoint, EndpointError};
use std::fs;
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Interval at which [`RuntimeDirectory::wait_for`] checks.
const POLL_INTERVAL: Duration = Duration::from_millis(5);
/// The bits of a mode that let the group or everybody write.
const OTHERS_WRITE: u32 = 0o022;

/// The runtime directory of one system.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RuntimeDirectory {
    path: PathBuf,
}

/// Why the endpoint of a role is not found.
#[derive(Debug, thiserror::Error)]
pub enum FindError {
    /// No process serves the role.
    #[error("no {role} is running: {} is not there; start one with `ratn up` or `ratn {role}`", file.display())]
    NotPublished {
        /// The role.
        role: String,
        /// The file that would contain its endpoint.
        file: PathBuf,
    },
    /// No process served the role within the deadline.
    #[error("no {role} was ready within {waited_s:.1} s: {} is not there", file.display())]
    NotInTime {
        /// The role.
        role: String,
        /// The file that would contain its endpoint.
        file: PathBuf,
        /// How long was waited, in seconds.
        waited_s: f64,
    },
    /// The file contains something else than an endpoint.
    #[error("{} does not say where the {role} is", file.display())]
    Malformed {
        /// The role.
        role: String,
        /// Its file.
        file: PathBuf,
        /// What is wrong with it.
        #[source]
        source: EndpointError,
    },
    /// The file cannot be read.
    #[error("cannot read {}", file.display())]
    Unreadable {
        /// The file.
        file: PathBuf,
        /// The cause.
        #[source]
        source: io::Error,
    },
}

/// A role that other processes can find as long as this guard lives.
#[derive(Debug)]
#[must_use = "the endpoint is withdrawn when this is dropped"]
pub struct Published {
    file: PathBuf,
    content: String,
}

impl RuntimeDirectory {
    /// The directory at `path`; if it does not exist, it is made, accessible to this user only.
    ///
    /// # Errors
    /// The directory cannot be made, is no directory, or can be written by other users, who could then pretend to be a role.
    pub fn create(path: impl Into<PathBuf>) -> io::Result<RuntimeDirectory> {
        let path = path.into();
        fs::DirBuilder::new().recursive(true).mode(0o700).create(&path)?;
        let is = fs::metadata(&path)?;
        if is.uid() != nix::unistd::geteuid().as_raw() || is.mode() & OTHERS_WRITE != 0 {
            let rule = "others than this user may write to it; choose another, or take that right away (chmod go-w)";
            return Err(io::Error::new(io::ErrorKind::PermissionDenied, rule));
        }
        Ok(RuntimeDirectory { path: path.canonicalize()? })
    }

    /// The directory at `path`, whether it exists or not: for a client that only looks for endpoints.
    pub fn at(path: impl Into<PathBuf>) -> RuntimeDirectory {
        RuntimeDirectory { path: path.into() }
    }

    /// The directory's path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The file with the endpoint of `role`.
    pub fn endpoint_file(&self, role: &str) -> PathBuf {
        self.path.join(format!("{role}.endpoint"))
    }

    /// A Unix socket in the directory, `<name>.sock`; the directory is made with the first bind.
    pub fn socket(&self, name: &str) -> Endpoint {
        Endpoint::Unix(self.path.join(format!("{name}.sock")))
    }

    /// The address that `role` listens on: if `listen` is [`Endpoint::local`], its socket in this directory; else `listen`.
    ///
    /// # Errors
    /// The directory is relative and the current directory is gone.
    pub fn listen(&self, listen: &Endpoint, role: &str) -> io::Result<Endpoint> {
        if !listen.is_local() {
            return Ok(listen.clone());
        }
        Ok(Endpoint::Unix(std::path::absolute(self.path.join(format!("{role}.sock")))?))
    }

    /// Publishes `endpoint` for `role` until the guard is dropped.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn publish(&self, role: &str, endpoint: &Endpoint) -> io::Result<Published> {
        publish_file(&self.endpoint_file(role), endpoint)
    }

    /// The endpoint of `role`.
    ///
    /// # Errors
    /// [`FindError`] says what is missing.
    pub fn find(&self, role: &str) -> Result<Endpoint, FindError> {
        let file = self.endpoint_file(role);
        match read_endpoint_file(&file, role) {
            Ok(Some(endpoint)) => Ok(endpoint),
            Ok(None) => Err(FindError::NotPublished { role: role.to_owned(), file }),
            Err(error) => Err(error),
        }
    }

    /// The endpoint of `role`; waits until its file exists.
    ///
    /// # Errors
    /// [`FindError`] after `deadline`, or at once if the file exists and is malformed.
    pub async fn wait_for(&self, role: &str, deadline: Duration) -> Result<Endpoint, FindError> {
        wait_for_file(&self.endpoint_file(role), role, deadline).await
    }
}

/// Writes `endpoint` to `file` atomically; the file is removed when the guard is dropped.
///
/// # Errors
/// The file cannot be written.
pub fn publish_file(file: &Path, endpoint: &Endpoint) -> io::Result<Published> {
    let content = format!("{endpoint}\n");
    let mut name = file.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{}.tmp", std::process::id()));
    let temporary = file.with_file_name(name);
    let mut writer = fs::File::create(&temporary)?;
    writer.write_all(content.as_bytes())?;
    drop(writer);
    fs::rename(&temporary, file)?;
    Ok(Published { file: file.to_owned(), content })
}

/// Waits for `file` and reads the endpoint in it; `role` is for the message.
///
/// # Errors
/// [`FindError`] after `deadline`, or at once if the file exists and is malformed.
pub async fn wait_for_file(file: &Path, role: &str, deadline: Duration) -> Result<Endpoint, FindError> {
    let look = async {
        loop {
            if let Some(endpoint) = read_endpoint_file(file, role)? {
                return Ok(endpoint);
            }
            tokio::time::sleep(POLL_INTERVAL).await;
        }
    };
    let late = |_| {
        let (role, file) = (role.to_owned(), file.to_owned());
        FindError::NotInTime { role, file, waited_s: deadline.as_secs_f64() }
    };
    tokio::time::timeout(deadline, look).await.map_err(late)?
}

fn read_endpoint_file(file: &Path, role: &str) -> Result<Option<Endpoint>, FindError> {
    let text = match fs::read_to_string(file) {
        Ok(text) => text,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(source) => return Err(FindError::Unreadable { file: file.to_owned(), source }),
    };
    let malformed = |source| FindError::Malformed { role: role.to_owned(), file: file.to_owned(), source };
    text.trim().parse().map(Some).map_err(malformed)
}

impl Drop for Published {
    fn drop(&mut self) {
        // A successor may have published itself meanwhile: then the file belongs to the successor.
        if fs::read_to_string(&self.file).is_ok_and(|content| content == self.content) {
            let _ = fs::remove_file(&self.file);
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    fn endpoint(port: u16) -> Endpoint {
        Endpoint::Tcp { host: "127.0.0.1".to_owned(), port }
    }

    #[tokio::test]
    async fn a_role_is_found_while_it_is_published() {
        let parent = tempfile::tempdir().unwrap();
        let directory = RuntimeDirectory::create(parent.path().join("run")).unwrap();
        assert_eq!(fs::metadata(directory.path()).unwrap().permissions().mode() & 0o777, 0o700);
        assert!(directory.find("cell").unwrap_err().to_string().contains("no cell is running"));

        let waiting = directory.wait_for("cell", Duration::from_secs(10));
        let publishing = async { directory.publish("cell", &endpoint(4000)).unwrap() };
        let (found, published) = tokio::join!(waiting, publishing);
        assert_eq!(found.unwrap(), endpoint(4000));
        drop(published);
        assert!(matches!(directory.find("cell"), Err(FindError::NotPublished { .. })));
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 0);
    }

    #[test]
    fn a_directory_that_others_may_write_to_is_refused_and_left_as_it_is() {
        let parent = tempfile::tempdir().unwrap();
        for (mode, good) in [(0o1777, false), (0o770, false), (0o755, true), (0o700, true)] {
            fs::set_permissions(parent.path(), fs::Permissions::from_mode(mode)).unwrap();
            assert_eq!(RuntimeDirectory::create(parent.path()).is_ok(), good, "{mode:o}");
            assert_eq!(fs::metadata(parent.path()).unwrap().permissions().mode() & 0o7777, mode);
        }
    }

    #[test]
    fn a_late_guard_leaves_its_successors_file_alone() {
        let parent = tempfile::tempdir().unwrap();
        let directory = RuntimeDirectory::at(parent.path());
        let first = directory.publish("cell", &endpoint(1)).unwrap();
        let _second = directory.publish("cell", &endpoint(2)).unwrap();
        drop(first);
        assert_eq!(directory.find("cell").unwrap(), endpoint(2));
    }

    #[tokio::test]
    async fn waiting_ends_at_its_deadline_and_names_the_file() {
        let parent = tempfile::tempdir().unwrap();
        let directory = RuntimeDirectory::at(parent.path());
        let error = directory.wait_for("cell", Duration::from_millis(1)).await.unwrap_err().to_string();
        assert!(error.contains("no cell was ready") && error.contains("cell.endpoint"), "{error}");
    }
}
