//! The user that a worker runs as, where that differs from its process manager's user: only root may do that. Supplementary groups are
//! dropped, and the worker's files are in that user's own directory below the runtime directory. Other users can then traverse the
//! runtime directory, but not list it.

use super::template::Template;
use nix::unistd::{Gid, Uid, User, geteuid};
use ratn_worker::runtime_directory::RuntimeDirectory;
use std::ffi::OsString;
use std::fs::{self, DirBuilder, Permissions};
use std::io;
use std::os::unix::fs::{DirBuilderExt, PermissionsExt, lchown};
use std::path::{Path, PathBuf};

/// Mode of a directory that others may traverse but not list.
const PASSABLE: u32 = 0o711;

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Account {
    name: String,
    pub(super) uid: Uid,
    pub(super) gid: Gid,
    home: PathBuf,
}

impl Account {
    /// The account of this user name, or an error message.
    pub(super) fn named(name: &str) -> Result<Account, String> {
        if !geteuid().is_root() {
            return Err(format!("only root may run workers as `{name}`"));
        }
        match User::from_name(name) {
            Ok(Some(User { name, uid, gid, dir, .. })) => Ok(Account { name, uid, gid, home: dir }),
            Ok(None) => Err(format!("there is no user `{name}`")),
            Err(error) => Err(format!("the user `{name}` is not found: {error}")),
        }
    }

    /// Creates the directory of this user's workers.
    pub(super) fn make_directory(&self, runtime: &RuntimeDirectory, own: &RuntimeDirectory) -> io::Result<()> {
        let parent = own.path().parent().unwrap_or(own.path());
        DirBuilder::new().recursive(true).mode(0o700).create(own.path())?;
        for place in [runtime.path(), parent] {
            fs::set_permissions(place, Permissions::from_mode(PASSABLE))?;
        }
        self.give(own.path())
    }

    /// Makes the user the owner of a file; of a symbolic link the link itself, not its target.
    pub(super) fn give(&self, path: &Path) -> io::Result<()> {
        lchown(path, Some(self.uid.as_raw()), Some(self.gid.as_raw()))
    }

    /// The user's name and home, for the environment of its workers.
    pub(super) fn environment(&self) -> [(OsString, OsString); 3] {
        let (name, home) = (OsString::from(&self.name), self.home.clone().into_os_string());
        [("USER".into(), name.clone()), ("LOGNAME".into(), name), ("HOME".into(), home)]
    }
}

/// The directory for the files of a template's workers.
pub(super) fn directory_of(runtime: &RuntimeDirectory, template: &Template) -> RuntimeDirectory {
    match &template.user {
        Some(user) => RuntimeDirectory::at(runtime.path().join("users").join(user)),
        None => runtime.clone(),
    }
}
