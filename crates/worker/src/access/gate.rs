//! The gate of every server: identifies the caller, and checks whether its roles may call the method.
//!
//! The roles come from a config that the process was given ([`LiveAccess::new`], [`LiveAccess::replace`]), or from a file that is read
//! again when it changes. Workers of a process manager use the file: the process manager names it in [`ACCESS_VARIABLE`].

use super::refusals::{LOG_INTERVAL, Line, Refusals, Refused};
use super::{AccessConfig, Caller, operation_of};
use crate::gate::{Gate, Identity};
use serde::Deserialize;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};
use std::time::{Duration, Instant, SystemTime};
use tokio::sync::watch;
use tonic::codegen::http;
use tonic::{Code, Status};

/// The environment variable with the path of the system's config; a worker takes its callers' roles from `[service.access]` there.
pub const ACCESS_VARIABLE: &str = "RATN_ACCESS";

/// Minimum interval between two checks whether the file has changed. A check happens at a call, and also while a server gets no calls.
const LOOK_AGAIN: Duration = Duration::from_secs(1);

/// Why roles cannot be read from a file.
#[derive(Debug, thiserror::Error)]
#[error("no roles of callers from {}: {problem}", file.display())]
pub struct AccessError {
    /// The file.
    pub file: PathBuf,
    /// The reason.
    pub problem: String,
}

/// The roles in force now. A handle: clones share them.
#[derive(Debug, Clone, Default)]
pub struct LiveAccess {
    access: Arc<RwLock<AccessConfig>>,
    file: Option<Arc<Followed>>,
    /// Notifies when the roles have changed.
    changes: watch::Sender<()>,
}

/// A config file that is followed.
#[derive(Debug)]
struct Followed {
    path: PathBuf,
    /// Time of the last check, and the file's modification time then.
    seen: Mutex<(Instant, Option<SystemTime>)>,
}

/// The part of a system's config that is read here.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct SystemFile {
    service: ServiceSection,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct ServiceSection {
    access: AccessConfig,
}

impl LiveAccess {
    /// The roles of this config.
    pub fn new(access: AccessConfig) -> LiveAccess {
        LiveAccess { access: Arc::new(RwLock::new(access)), ..LiveAccess::default() }
    }

    /// The roles in `[service.access]` of a system's config, now and whenever that file changes.
    ///
    /// # Errors
    /// The file cannot be read, or is malformed. If the file becomes malformed later, the roles stay as they are.
    pub fn of_file(path: &Path) -> Result<LiveAccess, AccessError> {
        let access = read(path)?;
        let seen = Mutex::new((Instant::now(), version(path)));
        let file = Some(Arc::new(Followed { path: path.to_owned(), seen }));
        Ok(LiveAccess { file, ..LiveAccess::new(access) })
    }

    /// The roles in the file that [`ACCESS_VARIABLE`] names; without the variable, the default roles.
    ///
    /// # Errors
    /// As [`LiveAccess::of_file`].
    pub fn from_environment() -> Result<LiveAccess, AccessError> {
        match std::env::var_os(ACCESS_VARIABLE).filter(|value| !value.is_empty()) {
            Some(path) => LiveAccess::of_file(Path::new(&path)),
            None => Ok(LiveAccess::default()),
        }
    }

    /// Replaces the roles from now on. Calls under way end if their caller loses a permission by this.
    pub fn replace(&self, access: AccessConfig) {
        let before =
            std::mem::replace(&mut *self.access.write().unwrap_or_else(PoisonError::into_inner), access.clone());
        if before != access {
            self.changes.send_replace(());
        }
    }

    /// The caller at the other end of a connection, for a server that runs as `own_uid`.
    pub fn caller(&self, identity: &Identity, own_uid: u32) -> Caller {
        self.follow();
        self.access.read().unwrap_or_else(PoisonError::into_inner).caller(identity, own_uid)
    }

    /// Reads the file again if it has changed.
    fn follow(&self) {
        if let Some(file) = &self.file {
            self.look_again(file);
        }
    }

    fn look_again(&self, file: &Followed) {
        let mut seen = file.seen.lock().unwrap_or_else(PoisonError::into_inner);
        if seen.0.elapsed() < LOOK_AGAIN {
            return;
        }
        seen.0 = Instant::now();
        let version = version(&file.path);
        if std::mem::replace(&mut seen.1, version) == version {
            return;
        }
        match read(&file.path) {
            Ok(access) => self.replace(access),
            Err(error) => tracing::warn!(%error, "callers keep the roles of before"),
        }
    }
}

fn version(path: &Path) -> Option<SystemTime> {
    std::fs::metadata(path).and_then(|file| file.modified()).ok()
}

fn read(path: &Path) -> Result<AccessConfig, AccessError> {
    let failed = |problem: String| AccessError { file: path.to_owned(), problem };
    let text =
        ratn_regular_file::read_text(path, ratn_regular_file::USUAL).map_err(|error| failed(error.to_string()))?;
    let file: SystemFile = toml::from_str(&text).map_err(|error| failed(error.to_string()))?;
    match file.service.access.fault() {
        Some((key, rule)) => Err(failed(format!("`{key}`: {rule}"))),
        None => Ok(file.service.access),
    }
}

/// Admits calls by the table [`super::TABLE`]. Over the process's Unix socket, root and the user who runs the process are operators.
#[derive(Debug, Clone)]
pub struct RoleGate {
    access: LiveAccess,
    own_uid: u32,
    refusals: Arc<Mutex<Refusals>>,
}

impl RoleGate {
    /// A gate with these roles.
    pub fn new(access: LiveAccess) -> RoleGate {
        RoleGate { access, own_uid: nix::unistd::geteuid().as_raw(), refusals: Arc::default() }
    }

    fn refusals(&self) -> MutexGuard<'_, Refusals> {
        self.refusals.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn log(line: &Line, refused_now: bool) {
    let Line { refused: Refused { who, what }, left_out } = line;
    match (left_out, refused_now) {
        (0, _) => tracing::warn!(%who, what, "refused"),
        (_, true) => {
            tracing::warn!(%who, what, left_out, within_s = LOG_INTERVAL.as_secs(), "refused, and before this")
        }
        (_, false) => tracing::warn!(%who, what, left_out, within_s = LOG_INTERVAL.as_secs(), "refused more often"),
    }
}

impl Default for RoleGate {
    fn default() -> RoleGate {
        RoleGate::new(LiveAccess::default())
    }
}

impl Gate for RoleGate {
    fn caller(&self, identity: &Identity) -> Caller {
        self.access.caller(identity, self.own_uid)
    }

    fn admit(&self, caller: &Caller, path: &str, _: &mut http::Extensions) -> Result<(), Status> {
        caller.admit(path).inspect_err(|_| {
            // The caller chooses the path: as a reason, each unknown path would be logged as a new one.
            let what =
                operation_of(path).map_or_else(|| "a method without access".to_owned(), |what| format!("{what:?}"));
            let line = self.refusals().refused(Instant::now(), Refused { who: caller.name.clone(), what });
            line.iter().for_each(|line| log(line, true));
        })
    }

    fn changes(&self) -> Option<watch::Receiver<()>> {
        Some(self.access.changes.subscribe())
    }

    fn look_again(&self) {
        self.access.follow();
        let due = self.refusals().due(Instant::now());
        due.iter().for_each(|line| log(line, false));
    }

    fn answered(&self, _: &str, _: Code, _: Duration) {}
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::super::Role;
    use super::*;

    #[test]
    fn roles_of_a_file_are_read_again_when_it_changes_and_kept_where_it_is_spoilt() {
        let place = tempfile::tempdir().unwrap();
        let file = place.path().join("ratn.toml");
        let write = |text: &str, seconds: u64| {
            std::fs::write(&file, text).unwrap();
            let at = SystemTime::UNIX_EPOCH + Duration::from_secs(seconds);
            std::fs::File::options().write(true).open(&file).unwrap().set_modified(at).unwrap();
        };
        let seven = Identity::User { uid: 7, pid: None };
        write("speed = 2.0\n[service.access]\nothers = [\"task\"]\n", 1);
        let live = LiveAccess::of_file(&file).unwrap();
        // Makes the last check look long ago.
        let roles = || {
            live.file.as_ref().unwrap().seen.lock().unwrap().0 = Instant::now() - LOOK_AGAIN;
            live.caller(&seven, 1).roles.to_vec()
        };
        assert_eq!(roles(), [Role::Task]);
        write("[service.access]\nothers = [\"viewer\"]\n", 2);
        assert_eq!(roles(), [Role::Viewer]);
        write("[service.access]\nothers = [\"king\"]\n", 3);
        assert_eq!(roles(), [Role::Viewer]);
        assert!(LiveAccess::of_file(&file).unwrap_err().to_string().contains("king"));
        assert!(LiveAccess::of_file(&place.path().join("none")).is_err());
        write("", 4);
        assert_eq!(roles(), AccessConfig::default().others);
    }
}
