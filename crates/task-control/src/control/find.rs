//! Finds the runs that listen in a runtime directory, each at its own socket, and the one that a client means.

use super::{ANY_RUN, MAX_STATUS_BYTES, RunStatus, STATUS, is_nobody, say};
use futures::future::join_all;
use std::io::{Error, ErrorKind, Result};
use std::path::{Path, PathBuf};
use std::time::Duration;
use tokio::net::UnixStream;

/// A run that does not answer within this time is left out of lists of all runs.
const PATIENCE: Duration = Duration::from_secs(1);
/// The extension of a run's socket; the name is the run's id.
const ENDING: &str = "control";

/// The path of a run's socket.
pub(super) fn socket(directory: &Path, run: &str) -> PathBuf {
    directory.join(format!("{run}.{ENDING}"))
}

/// Removes the sockets at which nobody listens: their runs were killed.
pub(super) async fn sweep(directory: &Path) {
    for (_, path) in sockets(directory) {
        if UnixStream::connect(&path).await.is_err_and(|error| error.kind() == ErrorKind::ConnectionRefused) {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// The status of each run of the system in `directory`, ordered by id. Runs that do not answer are left out.
pub async fn statuses(directory: &Path) -> Vec<RunStatus> {
    let asked = sockets(directory).into_iter().map(async |(_, path)| ask(&path).await);
    join_all(asked).await.into_iter().filter_map(Result::ok).collect()
}

/// The status of one run, given by its id, its task or [`ANY_RUN`]. `None` if no run is under way.
///
/// # Errors
/// The run does not answer, or it is unclear which run is meant.
pub async fn status(directory: &Path, run: &str) -> Result<Option<RunStatus>> {
    match meant(directory, run).await {
        Ok(path) => ask(&path).await.map(Some),
        Err(error) if is_nobody(&error) => Ok(None),
        Err(error) => Err(error),
    }
}

/// The socket of the run that is meant: by its id, the name of its task, or [`ANY_RUN`] if only one is under way.
///
/// # Errors
/// [`is_nobody`] if no run is under way; else an error that lists the runs.
pub(super) async fn meant(directory: &Path, run: &str) -> Result<PathBuf> {
    let mut listening = Vec::new();
    for (id, path) in sockets(directory) {
        if UnixStream::connect(&path).await.is_ok() {
            listening.push((id, path));
        }
    }
    if listening.is_empty() {
        return Err(Error::new(ErrorKind::NotFound, "no run is under way"));
    }
    if let Some((_, path)) = listening.iter().find(|(id, _)| id == run) {
        return Ok(path.clone());
    }
    if let (ANY_RUN, [(_, path)]) = (run, listening.as_slice()) {
        return Ok(path.clone());
    }
    let tasks = join_all(listening.iter().map(async |(_, path)| ask(path).await.map(|status| status.task))).await;
    let known = || listening.iter().zip(&tasks).filter_map(|((id, path), task)| Some((id, path, task.as_ref().ok()?)));
    let mut of_task = known().filter(|(.., task)| run == task.as_str());
    // A run that does not tell its task may have the same task.
    if let (Some((_, path, _)), None, true) = (of_task.next(), of_task.next(), tasks.iter().all(Result::is_ok)) {
        return Ok(path.clone());
    }
    let of = |((id, _), task): (&(String, PathBuf), &Result<String>)| match task {
        Ok(task) => format!("{id} of the task {task}"),
        Err(_) => format!("{id}, which does not say what it is doing"),
    };
    let all: Vec<String> = listening.iter().zip(&tasks).map(of).collect();
    let all = all.join(", ");
    let message = match known().any(|(.., task)| run == ANY_RUN || run == task.as_str()) {
        true => format!("{} runs are under way: {all}; say the id of the one that is meant", listening.len()),
        false => format!("no run `{run}` is under way here, but {all}"),
    };
    Err(Error::new(ErrorKind::InvalidInput, message))
}

async fn ask(socket: &Path) -> Result<RunStatus> {
    let asking = tokio::time::timeout(PATIENCE, say(socket, STATUS, MAX_STATUS_BYTES));
    let answer = asking.await.unwrap_or_else(|_| Err(ErrorKind::TimedOut.into()))?;
    serde_json::from_str(&answer).map_err(|_| Error::other(answer))
}

/// The ids of the runs with their sockets, ordered by id.
fn sockets(directory: &Path) -> Vec<(String, PathBuf)> {
    let entries = std::fs::read_dir(directory).into_iter().flatten().flatten();
    let of_run = |path: PathBuf| {
        let id = path.file_stem()?.to_str()?.to_owned();
        path.extension().is_some_and(|ending| ending == ENDING).then_some((id, path))
    };
    let mut all: Vec<_> = entries.filter_map(|entry| of_run(entry.path())).collect();
    all.sort();
    all
}
