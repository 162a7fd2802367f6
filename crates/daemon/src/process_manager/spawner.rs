//! Starts processes, all from one thread that lives as long as the process manager, and watches each until it ends.
//!
//! Each worker leads its own process group, so that it can be ended with all processes that it started; [`super::tracking`] finds
//! processes that leave the group. Its standard input is a pipe that nobody writes to and that closes when the process manager ends,
//! in whatever way. No code of ours runs in the child before exec.

use super::account::Account;
use super::limits::{AppliedLimits, Groups, Limits};
use super::log::{Awaited, BOUND_INTERVAL, Log};
use super::predecessor::Adopted;
use super::tracking::Tracker;
use crate::supervisor::command_of;
use nix::errno::Errno;
use nix::sys::signal::{Signal, killpg};
use nix::unistd::Pid;
use ratn_panic_point::panic_point;
use ratn_worker::panic::{exit_on_panic, exit_on_panic_blocking};
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::io;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::time::Duration;
use tokio::process::Child;
use tokio::runtime::Handle;
use tokio::sync::mpsc;
use tokio_util::task::AbortOnDropHandle;

/// Capacity for processes that wait to be started.
const QUEUE: usize = 1_024;
/// How long to wait for the end of a dead worker's output: a process that it started may hold the pipe open.
const LAST_WORDS_PATIENCE: Duration = Duration::from_millis(20);
/// The name of this part of the process in its log.
const WATCH_OF_WORKER: &str = "the watch of a worker";

/// A process to be started.
#[derive(Debug)]
pub(super) struct Job {
    pub(super) id: String,
    pub(super) program: PathBuf,
    pub(super) args: Vec<String>,
    /// The whole environment.
    pub(super) env: BTreeMap<OsString, OsString>,
    pub(super) directory: Option<PathBuf>,
    /// The user of the process; `None` for the user of this process.
    pub(super) account: Option<Account>,
    pub(super) limits: Limits,
    /// The directories in which cgroups are made.
    pub(super) groups: Groups,
    /// A line of its standard output that marks it as ready.
    pub(super) awaited: Option<Awaited>,
    pub(super) log: PathBuf,
    pub(super) max_log_bytes: u64,
    /// The process is to outlive this one, so it writes its log by itself.
    pub(super) outlives: bool,
}

/// Results of a job: `Spawned`, then `Exited`.
#[derive(Debug)]
pub(super) enum Outcome {
    /// The process has been started.
    Spawned {
        id: String,
        pid: u32,
        /// The limits in force, for people.
        limits: String,
        /// Its cgroups.
        groups: Vec<PathBuf>,
    },
    /// The process has ended, or could not be started.
    Exited { id: String, reason: String, last_words: String },
}

/// Starts the thread; it ends when the sender is dropped. Needs a tokio runtime.
pub(super) fn start(outcomes: mpsc::Sender<Outcome>, tracker: Tracker) -> io::Result<mpsc::Sender<Job>> {
    let (sender, mut jobs) = mpsc::channel::<Job>(QUEUE);
    let runtime = Handle::current();
    let start_all = move || {
        let _entered = runtime.enter();
        while let Some(mut job) = jobs.blocking_recv() {
            panic_point("spawner");
            let id = job.id.clone();
            let spawned = match tracker.children() {
                Some(children) => children.starting(|| {
                    spawn(&job).map(|(child, log)| {
                        let pid = child.id().unwrap_or(0);
                        ((child, log), pid)
                    })
                }),
                None => spawn(&job),
            };
            match spawned {
                Ok((child, log)) => {
                    let pid = child.id().unwrap_or(0);
                    let force = job.limits.enforce(&id, pid, &job.groups);
                    let groups = force.groups();
                    let spawned = Outcome::Spawned { id: id.clone(), pid, limits: force.words(), groups };
                    if outcomes.blocking_send(spawned).is_err() {
                        return;
                    }
                    let worker =
                        Watched { id, pid, child, log, awaited: job.awaited.take(), force, bounds: job.outlives };
                    let watching = watch(worker, tracker.clone(), outcomes.clone());
                    runtime.spawn(exit_on_panic(WATCH_OF_WORKER, watching));
                }
                Err(error) => {
                    let reason = format!("cannot start {}: {error}", job.program.display());
                    let exited = Outcome::Exited { id, reason, last_words: String::new() };
                    if outcomes.blocking_send(exited).is_err() {
                        return;
                    }
                }
            }
        }
    };
    let start_all = || exit_on_panic_blocking("the thread that starts workers", start_all);
    std::thread::Builder::new().name("spawner".to_owned()).spawn(start_all)?;
    Ok(sender)
}

/// Signals a worker and its process group.
pub(super) fn signal(pid: u32, signal: Signal) {
    let Some(group) = i32::try_from(pid).ok().filter(|pid| *pid > 1) else { return };
    match killpg(Pid::from_raw(group), signal) {
        Ok(()) | Err(Errno::ESRCH) => {}
        Err(error) => tracing::warn!(pid, %signal, %error, "a worker could not be signalled"),
    }
}

fn spawn(job: &Job) -> io::Result<(Child, Log)> {
    let log = Log::create(&job.log, job.max_log_bytes)?;
    let mut command = command_of(&job.program);
    if let Some(directory) = &job.directory {
        let known = directory.is_dir();
        known
            .then_some(())
            .ok_or_else(|| io::Error::other(format!("there is no directory {}", directory.display())))?;
        command.current_dir(directory);
    }
    if let Some(account) = &job.account {
        // This also drops the supplementary groups.
        command.uid(account.uid.as_raw()).gid(account.gid.as_raw());
    }
    if job.outlives {
        command.stdout(log.file()?).stderr(log.file()?);
    } else {
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
    }
    let child = command
        .args(&job.args)
        .env_clear()
        .envs(&job.env)
        .stdin(Stdio::piped())
        .process_group(0)
        .kill_on_drop(true)
        .spawn()?;
    Ok((child, log))
}

struct Watched {
    id: String,
    pid: u32,
    child: Child,
    log: Log,
    awaited: Option<Awaited>,
    force: AppliedLimits,
    /// The process writes its log by itself; this process keeps the log bounded.
    bounds: bool,
}

async fn watch(worker: Watched, tracker: Tracker, outcomes: mpsc::Sender<Outcome>) {
    let Watched { id, pid, mut child, log, awaited, force, bounds } = worker;
    let bounding = bounds.then(|| AbortOnDropHandle::new(tokio::spawn(log.clone().keep_bounded(BOUND_INTERVAL))));
    let out = child.stdout.take().map(|out| tokio::spawn(log.clone().capture(out, awaited)));
    let err = child.stderr.take().map(|err| tokio::spawn(log.clone().capture(err, None)));
    // `wait` would close the pipe that tells the worker that its parent lives.
    let parent_lives = child.stdin.take();
    let reason = match child.wait().await {
        Ok(status) => describe(status),
        Err(error) => format!("cannot be waited for: {error}"),
    };
    panic_point("worker-watch");
    drop((parent_lives, bounding));
    if let Some(children) = tracker.children() {
        children.ended(pid);
    }
    signal(pid, Signal::SIGKILL);
    end_rest(&id, force, tracker).await;
    let captured = async {
        for capture in [out, err].into_iter().flatten() {
            let _ = capture.await;
        }
    };
    let _ = tokio::time::timeout(LAST_WORDS_PATIENCE, captured).await;
    let _ = outcomes.send(Outcome::Exited { id, reason, last_words: log.last_words() }).await;
}

/// Watches an adopted worker until its end. Only a parent learns the exit status, so the reason is unknown.
pub(super) fn watch_adopted(
    adopted: Adopted,
    log: &Path,
    max_log_bytes: u64,
    tracker: Tracker,
    outcomes: mpsc::Sender<Outcome>,
) {
    let Adopted { entry, parent_lives, exit, .. } = adopted;
    let log = Log::of_another(log, max_log_bytes).inspect_err(|error| tracing::warn!(id = entry.id, %error, "no log"));
    let watching = async move {
        let bounding =
            log.as_ref().ok().map(|log| AbortOnDropHandle::new(tokio::spawn(log.clone().keep_bounded(BOUND_INTERVAL))));
        let force = AppliedLimits::adopted(entry.groups);
        exit.wait().await;
        drop((parent_lives, bounding));
        signal(entry.pid, Signal::SIGKILL);
        end_rest(&entry.id, force, tracker).await;
        let reason = "ended, how is not known: it was adopted".to_owned();
        let last_words = log.map(|log| log.last_words()).unwrap_or_default();
        let _ = outcomes.send(Outcome::Exited { id: entry.id, reason, last_words }).await;
    };
    tokio::spawn(exit_on_panic(WATCH_OF_WORKER, watching));
}

/// Ends the processes left in the cgroups of a worker, and those that the worker started outside of them.
async fn end_rest(id: &str, force: AppliedLimits, tracker: Tracker) {
    let of = id.to_owned();
    let end_rest = move || {
        panic_point("end-of-worker");
        drop(force);
        tracker.end_worker(&of);
    };
    let ended = tokio::task::spawn_blocking(|| exit_on_panic_blocking("the end of a worker's processes", end_rest));
    if let Err(error) = ended.await {
        tracing::error!(id, %error, "what a worker started is not ended");
    }
}

fn describe(status: ExitStatus) -> String {
    match (status.code(), status.signal()) {
        (Some(code), _) => format!("exited with status {code}"),
        (None, Some(signal)) => format!("killed by signal {signal}"),
        (None, None) => status.to_string(),
    }
}
