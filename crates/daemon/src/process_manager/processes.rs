//! The processes of the workers: begins them from their templates, signals them, waits until they serve, and clears up behind them.

use super::config::{ProcessManagerConfig, Template};
use super::log::EndedLogs;
use super::spawner::{self, Job, Outcome};
use nix::sys::signal::Signal;
use ratn_worker::client::wait_until_serving;
use ratn_worker::runtime_directory::RuntimeDirectory;
use std::collections::BTreeMap;
use std::io;
use std::path::PathBuf;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio::task::AbortHandle;

/// What became of processes that waits for the actor.
const OUTCOMES: usize = 1_024;

/// What is told of them.
pub(super) struct Told {
    pub(super) outcomes: mpsc::Receiver<Outcome>,
    /// The id and the endpoint of each that serves.
    pub(super) serving: mpsc::Receiver<(String, String)>,
}

/// Too many processes are being started at once.
#[derive(Debug, thiserror::Error)]
#[error("cannot be started: too many processes are being started")]
pub(super) struct Busy;

pub(super) struct Processes {
    host: String,
    max_log_bytes: u64,
    directory: RuntimeDirectory,
    /// What a template without a program runs.
    this_program: PathBuf,
    jobs: mpsc::Sender<Job>,
    serving: mpsc::Sender<(String, String)>,
    by_id: BTreeMap<String, Process>,
    ended_logs: EndedLogs,
}

#[derive(Debug, Default)]
struct Process {
    pid: u32,
    readiness: Option<AbortHandle>,
}

impl Processes {
    /// None yet. Needs a tokio runtime.
    pub(super) fn start(config: &ProcessManagerConfig, directory: RuntimeDirectory) -> io::Result<(Processes, Told)> {
        let (told, outcomes) = mpsc::channel(OUTCOMES);
        let (serving, served) = mpsc::channel(OUTCOMES);
        let processes = Processes {
            host: config.host.clone(),
            max_log_bytes: config.max_log_bytes,
            directory,
            this_program: std::env::current_exe()?,
            jobs: spawner::start(told)?,
            serving,
            by_id: BTreeMap::new(),
            ended_logs: EndedLogs::default(),
        };
        Ok((processes, Told { outcomes, serving: served }))
    }

    /// Begins a worker of a template.
    pub(super) fn begin(&mut self, id: &str, template: &Template) -> Result<(), Busy> {
        let runtime_dir = self.directory.path().display().to_string();
        let endpoint_file = self.directory.endpoint_file(id);
        let fill = |text: &str| {
            text.replace("{id}", id)
                .replace("{kind}", &template.kind)
                .replace("{host}", &self.host)
                .replace("{runtime_dir}", &runtime_dir)
                .replace("{endpoint_file}", &endpoint_file.display().to_string())
        };
        let _ = std::fs::remove_file(&endpoint_file);
        let job = Job {
            id: id.to_owned(),
            args: template.args.iter().map(|arg| fill(arg)).collect(),
            env: template.env.iter().map(|(name, value)| (name.clone(), fill(value))).collect(),
            log: self.log_file(id),
            max_log_bytes: self.max_log_bytes,
            program: template.program.clone().unwrap_or_else(|| self.this_program.clone()),
        };
        self.jobs.try_send(job).map_err(|_| Busy)?;
        let readiness = ready(self.directory.clone(), id.to_owned(), template.start_timeout(), self.serving.clone());
        let readiness = tokio::spawn(readiness).abort_handle();
        self.by_id.entry(id.to_owned()).or_default().readiness = Some(readiness);
        Ok(())
    }

    /// Its process is there.
    pub(super) fn spawned(&mut self, id: &str, pid: u32) {
        self.by_id.entry(id.to_owned()).or_default().pid = pid;
    }

    /// Its process is gone.
    pub(super) fn exited(&mut self, id: &str) {
        if let Some(readiness) = self.by_id.remove(id).and_then(|process| process.readiness) {
            readiness.abort();
        }
        // One that was killed could not take it back itself.
        let _ = std::fs::remove_file(self.directory.endpoint_file(id));
        self.ended_logs.add(self.log_file(id));
    }

    /// Signals a worker. Without a process yet, the pools ask again once it is there.
    pub(super) fn signal(&self, id: &str, signal: Signal) {
        if let Some(process) = self.by_id.get(id).filter(|process| process.pid != 0) {
            spawner::signal(process.pid, signal);
        }
    }

    /// Whatever it takes.
    pub(super) fn kill_all(&self) {
        self.by_id.values().for_each(|process| spawner::signal(process.pid, Signal::SIGKILL));
    }

    fn log_file(&self, id: &str) -> PathBuf {
        self.directory.path().join("logs").join(format!("{id}.log"))
    }
}

/// Tells once a worker serves. One that does not is the pools' business: they know when it is too late.
async fn ready(directory: RuntimeDirectory, id: String, deadline: Duration, serving: mpsc::Sender<(String, String)>) {
    let found = match directory.wait_for(&id, deadline).await {
        Ok(endpoint) => endpoint,
        Err(error) => return tracing::debug!(id, %error, "no endpoint of a worker"),
    };
    match wait_until_serving(&found, deadline).await {
        Ok(()) => drop(serving.send((id, found.to_string())).await),
        Err(error) => tracing::debug!(id, %error, "a worker does not serve"),
    }
}
