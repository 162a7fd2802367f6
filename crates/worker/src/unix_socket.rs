//! Creates a Unix socket with restricted access from the first moment on, by the mode and the group of its file.
//!
//! ```text
//!   socket ─ closed to all ─▶ file (mode 0) ─ group, mode ─▶ as configured ─ listen ─▶ connections
//! ```
//! To connect, a process needs write permission for the file. Access to the directory is up to the directory's own mode.

use nix::sys::stat::{Mode, fchmod};
use nix::unistd::{Gid, Group, chown};
use serde::{Deserialize, Serialize};
use std::fs::Permissions;
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use tokio::net::{UnixListener, UnixSocket};

/// Maximum number of connections waiting to be accepted, if the kernel allows so many (`net.core.somaxconn`). Further ones are refused.
const BACKLOG: u32 = 4_096;

/// The users who may connect to a Unix socket, by the mode and the group of its file. Their uid decides what they may do then.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SocketAccess {
    /// `0o660`: the server's own user and the group; `0o666`: every user who can reach the socket's directory.
    pub mode: u32,
    /// The file's group, by name; by default the server's own. The server has to be a member of the group, or root.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub group: Option<String>,
}

impl Default for SocketAccess {
    fn default() -> SocketAccess {
        SocketAccess { mode: 0o660, group: None }
    }
}

impl SocketAccess {
    /// The least and the greatest mode: at least the owner may connect, and no bits beyond permissions are set.
    pub const MODES: std::ops::RangeInclusive<u32> = 0o600..=0o777;

    /// The first fault of this config, if any: the key, and the rule that it breaks.
    pub fn fault(&self) -> Option<(&'static str, &'static str)> {
        if !Self::MODES.contains(&self.mode) {
            return Some(("socket.mode", "from 0o600 (its owner may connect) to 0o777, in octal as `0o660`"));
        }
        let named = |group: &String| !group.is_empty() && !group.chars().any(char::is_control);
        (!self.group.as_ref().is_none_or(named)).then_some(("socket.group", "the name of a group"))
    }

    fn gid(&self) -> io::Result<Option<Gid>> {
        let Some(name) = &self.group else { return Ok(None) };
        let no_group =
            || io::Error::new(io::ErrorKind::NotFound, format!("there is no group `{name}` ([service.socket])"));
        Group::from_name(name)?.map(|group| Some(group.gid)).ok_or_else(no_group)
    }
}

/// Listens at `path`.
pub(crate) fn listen(path: &Path, access: &SocketAccess) -> io::Result<UnixListener> {
    let gid = access.gid()?;
    let socket = UnixSocket::new_stream()?;
    // The file inherits the socket's mode: no process can connect before mode and group are set.
    fchmod(&socket, Mode::empty())?;
    socket.bind(path)?;
    let opened = give(path, gid, access).and_then(|()| socket.listen(BACKLOG));
    if opened.is_err() {
        let _ = std::fs::remove_file(path);
    }
    opened
}

fn give(path: &Path, gid: Option<Gid>, access: &SocketAccess) -> io::Result<()> {
    if let Some(gid) = gid {
        chown(path, None, Some(gid)).map_err(|error| {
            let name = access.group.as_deref().unwrap_or_default();
            io::Error::other(format!(
                "it cannot be given to the group `{name}` ({error}): make the server's user a member of it"
            ))
        })?;
    }
    std::fs::set_permissions(path, Permissions::from_mode(access.mode))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use std::os::unix::fs::MetadataExt;

    fn mode(path: &Path) -> u32 {
        std::fs::metadata(path).unwrap().mode() & 0o7777
    }

    #[tokio::test]
    async fn a_socket_has_the_mode_of_its_config_whatever_the_umask_is() {
        let place = tempfile::tempdir().unwrap();
        for wanted in [0o600, 0o660, 0o666] {
            let path = place.path().join(format!("{wanted:o}.sock"));
            let listener = listen(&path, &SocketAccess { mode: wanted, group: None }).unwrap();
            assert_eq!(mode(&path), wanted);
            tokio::net::UnixStream::connect(&path).await.unwrap();
            listener.accept().await.unwrap();
        }
    }

    #[tokio::test]
    async fn a_socket_is_closed_to_everybody_until_it_is_as_its_config_says() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("x.sock");
        let socket = UnixSocket::new_stream().unwrap();
        fchmod(&socket, Mode::empty()).unwrap();
        socket.bind(&path).unwrap();
        assert_eq!(mode(&path), 0, "made so, not made so later");
    }

    #[tokio::test]
    async fn a_group_that_is_not_there_is_refused_and_nothing_is_left() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("x.sock");
        let access = SocketAccess { group: Some("no-such-group".to_owned()), ..SocketAccess::default() };
        let refused = listen(&path, &access).unwrap_err();
        assert!(refused.to_string().contains("`no-such-group`"), "{refused}");
        assert!(!path.exists());
    }

    #[tokio::test]
    async fn a_socket_is_its_groups() {
        let Some(group) = Group::from_gid(Gid::from_raw(1)).unwrap().filter(|_| nix::unistd::geteuid().is_root())
        else {
            eprintln!("skipped: only root gives a file to another group");
            return;
        };
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("x.sock");
        let _listener = listen(&path, &SocketAccess { group: Some(group.name), ..SocketAccess::default() }).unwrap();
        assert_eq!((std::fs::metadata(&path).unwrap().gid(), mode(&path)), (1, 0o660));
    }

    #[test]
    fn a_mode_is_permissions_and_lets_its_owner_in() {
        let fault = |mode| SocketAccess { mode, group: None }.fault();
        assert_eq!((fault(0o600), fault(0o777)), (None, None));
        assert!(fault(0o577).is_some() && fault(0o1000).is_some() && fault(660).is_some());
    }
}
