//! Workers that a killed process manager left behind: they are adopted or ended, each as its template says, before
//! any other is started.
//!
//! ```text
//!   its process has ended ──▶ forgotten
//!   it serves, its template says `adopt`, it knows the present session, and it listens for a successor ──▶ adopted
//!   any other ──▶ SIGTERM, after `stop_timeout_s` SIGKILL, and with it all processes that it started
//!   it was about to be started ──▶ its cgroup is killed, and every process with its marker
//! ```

use super::account;
use super::limits::end_group;
use super::pools;
use super::processes::ManagerContact;
use super::roster::{Entry, LeftBehind, Motions};
use super::spawner;
use super::template::Template;
use super::tracking::Tracker;
use nix::sys::signal::Signal;
use ratn_proto::types::{WorkerState, WorkerStatus};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::panic::exit_on_panic_blocking;
use ratn_worker::runtime_directory::RuntimeDirectory;
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tokio::io::unix::AsyncFd;
use tokio::net::UnixStream;
use tokio::time::timeout;

/// Timeout of the connection to a worker that is to be adopted.
const GREETING_PATIENCE: Duration = Duration::from_secs(1);
/// Time from SIGKILL to the end of a process with much memory.
const KILL_PATIENCE: Duration = Duration::from_secs(5);

/// A worker that was adopted.
#[derive(Debug)]
pub(super) struct Adopted {
    pub(super) entry: Entry,
    /// The worker considers its parent alive while this is open.
    pub(super) parent_lives: UnixStream,
    pub(super) exit: Exit,
    /// How long its device may go on moving after the worker's end: the longest of the bounds of its template then, its template now, and
    /// the roster. `None` for a worker without a device.
    pub(super) standstill: Option<Duration>,
    /// Its template or the resource manager's address has changed: it is to be replaced.
    pub(super) outdated: bool,
}

impl Adopted {
    pub(super) fn status(&self) -> WorkerStatus {
        WorkerStatus {
            id: self.entry.id.clone(),
            template: self.entry.template.name.clone(),
            state: WorkerState::Ready,
            pid: self.entry.pid,
            endpoint: self.entry.endpoint.clone().unwrap_or_default(),
            reason: String::new(),
            resident_bytes: 0,
            cpu_millicores: 0,
            limits: self.entry.limits.clone(),
            age_s: 0,
            held: false,
        }
    }
}

/// The end of a process that is not a child of this one.
#[derive(Debug)]
pub(super) struct Exit(AsyncFd<OwnedFd>);

impl Exit {
    /// Of the process in `entry`; `None` where it has ended.
    fn of(entry: &Entry) -> Option<Exit> {
        let pid = rustix::process::Pid::from_raw(i32::try_from(entry.pid).ok()?)?;
        let fd = rustix::process::pidfd_open(pid, rustix::process::PidfdFlags::empty()).ok()?;
        // Checked after the descriptor was opened, so the descriptor is of that process.
        (began(entry.pid)? == entry.began).then_some(())?;
        #[allow(deprecated, reason = "an owned descriptor stays the same and open, which is what the warning is about")]
        AsyncFd::with_interest(fd, tokio::io::Interest::READABLE).ok().map(Exit)
    }

    pub(super) async fn wait(&self) {
        let _ = self.0.readable().await;
    }
}

/// Start time of a process, in clock ticks of the kernel (`proc_pid_stat(5)`, field 22); `None` where it has ended.
pub(super) fn began(pid: u32) -> Option<u64> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The name in the field before may contain spaces and parentheses.
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace();
    let state = fields.next()?;
    (state != "Z" && state != "X").then_some(())?;
    fields.nth(18)?.parse().ok()
}

/// The socket on which a worker listens for a successor.
pub(super) fn adopt_socket(directory: &RuntimeDirectory, id: &str) -> PathBuf {
    directory.path().join(format!("{id}.adopt"))
}

/// Adopts or ends all of them; returns the adopted ones. Returns when the others have ended, and so have those that were being started.
pub(super) async fn settle(
    left: LeftBehind,
    (host, templates): (&str, &[Template]),
    told: &ManagerContact,
    directory: &RuntimeDirectory,
    tracker: &Tracker,
) -> Vec<Adopted> {
    let motions = &left.motions;
    let settled = left.workers.into_iter().map(async |entry| {
        let adopted = match Exit::of(&entry) {
            Some(exit) => match greet(&entry, exit, (host, templates), motions, told, directory).await {
                Ok(adopted) => Some(adopted),
                Err((exit, why)) => {
                    tracing::info!(
                        id = entry.id,
                        pid = entry.pid,
                        why,
                        "a worker of the last process manager is ended"
                    );
                    end(&entry, &exit).await;
                    None
                }
            },
            None => {
                // The kernel does not reuse the id of the process group while a process of it is left.
                if !Path::new(&format!("/proc/{}", entry.pid)).exists() {
                    spawner::signal(entry.pid, Signal::SIGKILL);
                }
                None
            }
        };
        if adopted.is_none() {
            clear_up(&entry, directory);
        }
        adopted
    });
    let adopted: Vec<Adopted> = futures::future::join_all(settled).await.into_iter().flatten().collect();
    for intent in &left.starting {
        tracing::info!(id = intent.id, "the last process manager ended while it started this worker");
        intent.group.iter().filter(|group| group.exists()).for_each(|group| end_group(group));
        remove_files(&intent.id, &intent.template, directory);
    }
    let (tracker, kept) = (tracker.clone(), adopted.iter().map(|one| one.entry.id.clone()).collect::<Vec<_>>());
    let end_unknown = move || tracker.end_all_but(&kept.iter().map(String::as_str).collect());
    let part = "the end of what the last process manager left";
    let ended = tokio::task::spawn_blocking(move || exit_on_panic_blocking(part, end_unknown));
    if let Err(error) = ended.await {
        tracing::error!(%error, "what nobody knows is not ended");
    }
    adopted
}

async fn greet(
    entry: &Entry,
    exit: Exit,
    (host, templates): (&str, &[Template]),
    motions: &Motions,
    told: &ManagerContact,
    directory: &RuntimeDirectory,
) -> Result<Adopted, (Exit, &'static str)> {
    let Some(template) = templates.iter().find(|template| template.name == entry.template.name) else {
        return Err((exit, "its template is gone"));
    };
    // The pool gives its workers other ids, and would start another worker besides this one.
    if pools::number_of(&entry.id, &template.name, host).is_none() {
        return Err((exit, "its id is not one of this host: the host had another name"));
    }
    if !(template.adopt && entry.template.adopt) {
        return Err((exit, "its template does not say `adopt`"));
    }
    // Other workers of its template no longer wait until its device stands still.
    if template.standstill_ms.is_none() && entry.template.standstill_ms.is_some() {
        return Err((exit, "it moves something, and its template does not say `standstill_ms` any more"));
    }
    // Its session may belong to another caller, whose leases it would accept.
    if entry.session.as_ref() != Some(&told.session) {
        return Err((exit, "it was told of another session"));
    }
    if entry.endpoint.is_none() {
        return Err((exit, "it was not ready yet"));
    }
    let socket = adopt_socket(&account::directory_of(directory, &entry.template), &entry.id);
    match timeout(GREETING_PATIENCE, UnixStream::connect(socket)).await {
        Ok(Ok(parent_lives)) => {
            let outdated = is_outdated(entry, template, told);
            tracing::info!(id = entry.id, pid = entry.pid, outdated, "a worker of the last process manager is adopted");
            let said = entry.template.standstill().max(template.standstill());
            let standstill = said.max(motions.get(&template.name).copied());
            Ok(Adopted { entry: entry.clone(), parent_lives, exit, standstill, outdated })
        }
        _ => Err((exit, "it does not listen for a successor")),
    }
}

/// Whether a worker that is started now would differ: by its template, or by the resource manager that it is told of. A worker that asks
/// another manager than the system's confirms no lease of the system.
fn is_outdated(entry: &Entry, template: &Template, told: &ManagerContact) -> bool {
    entry.manager.as_ref() != Some(&told.manager.to_string()) || !template.starts_the_same_as(&entry.template)
}

async fn end(entry: &Entry, exit: &Exit) {
    spawner::signal(entry.pid, Signal::SIGTERM);
    if timeout(entry.template.stop_timeout(), exit.wait()).await.is_err() {
        spawner::signal(entry.pid, Signal::SIGKILL);
        if timeout(KILL_PATIENCE, exit.wait()).await.is_err() {
            tracing::error!(id = entry.id, pid = entry.pid, "a worker of the last process manager does not end");
        }
    }
    // Kills what it had started in its process group.
    spawner::signal(entry.pid, Signal::SIGKILL);
}

fn clear_up(entry: &Entry, directory: &RuntimeDirectory) {
    entry.groups.iter().for_each(|group| end_group(group));
    remove_files(&entry.id, &entry.template, directory);
}

fn remove_files(id: &str, template: &Template, directory: &RuntimeDirectory) {
    remove_files_in(&account::directory_of(directory, template), id);
}

/// Removes the files of a worker that was killed.
pub(super) fn remove_files_in(directory: &RuntimeDirectory, id: &str) {
    let served = match directory.socket(id) {
        Endpoint::Unix(path) => Some(path),
        _ => None,
    };
    for file in [directory.endpoint_file(id), adopt_socket(directory, id)].into_iter().chain(served) {
        let _ = std::fs::remove_file(file);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn a_worker_that_was_told_of_another_resource_manager_is_outdated() {
        let template = Template::new("planner", "PathPlanner");
        let told = ManagerContact { manager: "http://127.0.0.1:2".parse().unwrap(), session: "s-2".to_owned() };
        let outdated = |manager: Option<&str>| {
            let entry = Entry {
                id: "planner-1".to_owned(),
                pid: 42,
                began: 7,
                endpoint: None,
                manager: manager.map(str::to_owned),
                session: Some(told.session.clone()),
                limits: String::new(),
                groups: Vec::new(),
                template: template.clone(),
            };
            is_outdated(&entry, &template, &told)
        };
        assert!(!outdated(Some("http://127.0.0.1:2")));
        assert!(outdated(Some("http://127.0.0.1:1")));
        assert!(outdated(None), "nobody knows");
    }

    #[tokio::test]
    async fn a_worker_that_moves_something_is_not_adopted_where_its_template_has_no_bound_or_its_host_another_name() {
        let place = tempfile::tempdir().unwrap();
        let directory = RuntimeDirectory::create(place.path()).unwrap();
        let told = ManagerContact { manager: "http://127.0.0.1:2".parse().unwrap(), session: "s".to_owned() };
        let template = Template { adopt: true, ..Template::new("arm", "Arm") };
        let pid = std::process::id();
        let entry = Entry {
            id: "arm-1@host".to_owned(),
            pid,
            began: began(pid).unwrap(),
            endpoint: Some("unix:/w".to_owned()),
            manager: None,
            session: Some("s".to_owned()),
            limits: String::new(),
            groups: Vec::new(),
            template: Template { standstill_ms: Some(6_000), ..template.clone() },
        };
        let listener = tokio::net::UnixListener::bind(adopt_socket(&directory, &entry.id)).unwrap();
        let motions = Motions::from([("arm".to_owned(), Duration::from_secs(9))]);
        let exit = Exit::of(&entry).unwrap();
        let (_, why) = greet(&entry, exit, ("host", &[template]), &motions, &told, &directory).await.unwrap_err();
        assert!(why.contains("standstill_ms"), "{why}");
        let templates = [entry.template.clone()];
        for (id, host) in [("arm-1@host", "new"), ("arm-x@host", "host"), ("leg-1@host", "host")] {
            let (entry, exit) = (Entry { id: id.to_owned(), ..entry.clone() }, Exit::of(&entry).unwrap());
            let _listener =
                (id != "arm-1@host").then(|| tokio::net::UnixListener::bind(adopt_socket(&directory, id)).unwrap());
            let (_, why) = greet(&entry, exit, (host, &templates), &motions, &told, &directory).await.unwrap_err();
            assert!(why.contains("id is not one of this host"), "{id} at {host}: {why}");
        }
        let exit = Exit::of(&entry).unwrap();
        let lower = Template { standstill_ms: Some(100), ..entry.template.clone() };
        let adopted = greet(&entry, exit, ("host", &[lower]), &motions, &told, &directory).await.unwrap();
        assert_eq!((adopted.standstill, adopted.outdated), (Some(Duration::from_secs(9)), true));
        drop(listener);
    }
}
