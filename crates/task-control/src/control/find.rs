//! The runs that listen in a runtime directory, each at a socket of its own, and which of them is meant.

use super::{ANY_RUN, MAX_STATUS_BYTES, RunStatus, STATUS, is_nobody, say};
use futures::future::join_all;
use std::io::{Error, ErrorKind, Result};
use std::path::{Path, PathBuf};
use tokio::net::UnixStream;

/// Of a run's socket, behind its id.
const ENDING: &str = "control";

/// Where a run listens.
pub(super) fn socket(directory: &Path, run: &str) -> PathBuf {
    directory.join(format!("{run}.{ENDING}"))
}

/// Sockets at which nobody listens any more are taken away: their runs were killed.
pub(super) async fn sweep(directory: &Path) {
    for (_, path) in sockets(directory) {
        if UnixStream::connect(&path).await.is_err_and(|error| error.kind() == ErrorKind::ConnectionRefused) {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// What the runs of the system in `directory` are doing, in the order of their ids. One that does not say is left out where another one does.
///
/// # Errors
/// Where a run listens and none says what it is doing.
pub async fn statuses(directory: &Path) -> Result<Vec<RunStatus>> {
    let asked = sockets(directory).into_iter().map(async |(_, path)| ask(&path).await);
    let (mut said, mut failed) = (Vec::new(), None);
    for answer in join_all(asked).await {
        match answer {
            Ok(status) => said.push(status),
            Err(error) if is_nobody(&error) => {}
            Err(error) => failed = Some(error),
        }
    }
    match failed {
        Some(error) if said.is_empty() => Err(error),
        _ => Ok(said),
    }
}

/// What one run is doing: of this id or this task, or whichever is under way. `None` where none is.
///
/// # Errors
/// Where it does not say, or it is not known which is meant.
pub async fn status(directory: &Path, run: &str) -> Result<Option<RunStatus>> {
    match meant(directory, run).await {
        Ok(path) => ask(&path).await.map(Some),
        Err(error) if is_nobody(&error) => Ok(None),
        Err(error) => Err(error),
    }
}

/// Where the run that is meant listens: by its id, the name of its task, or [`ANY_RUN`] where only one is under way.
///
/// # Errors
/// [`is_nobody`] where no run is under way; else which there are.
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
    if let (Some((_, path, _)), None) = (of_task.next(), of_task.next()) {
        return Ok(path.clone());
    }
    let all: Vec<String> = known().map(|(id, _, task)| format!("{id} of the task {task}")).collect();
    let all = all.join(", ");
    let message = match known().any(|(.., task)| run == ANY_RUN || run == task.as_str()) {
        true => format!("{} runs are under way: {all}; say the id of the one that is meant", listening.len()),
        false => format!("no run `{run}` is under way here, but {all}"),
    };
    Err(Error::new(ErrorKind::InvalidInput, message))
}

async fn ask(socket: &Path) -> Result<RunStatus> {
    let answer = say(socket, STATUS, MAX_STATUS_BYTES).await?;
    serde_json::from_str(&answer).map_err(|_| Error::other(answer))
}

/// The ids of runs, with their sockets, in the order of the ids.
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
