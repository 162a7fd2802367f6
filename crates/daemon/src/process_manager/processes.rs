//! The processes of the workers: begins them from their templates, signals them, waits until they serve, and clears up behind them.

use super::config::{ProcessManagerConfig, Template};
use super::log::EndedLogs;
use super::spawner::{self, Job, Outcome};
use nix::sys::signal::Signal;
use ratn_worker::client::Health;
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
    /// The id of each that was asked whether it still serves, with its answer.
    pub(super) health: mpsc::Receiver<(String, Result<(), String>)>,
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
    tell: Tell,
    by_id: BTreeMap<String, Process>,
    ended_logs: EndedLogs,
}

#[derive(Debug, Clone)]
struct Tell {
    serving: mpsc::Sender<(String, String)>,
    health: mpsc::Sender<(String, Result<(), String>)>,
}

#[derive(Debug, Default)]
struct Process {
    pid: u32,
    attended: Option<(AbortHandle, mpsc::Sender<Duration>)>,
}

impl Processes {
    /// None yet. Needs a tokio runtime.
    pub(super) fn start(config: &ProcessManagerConfig, directory: RuntimeDirectory) -> io::Result<(Processes, Told)> {
        let (told, outcomes) = mpsc::channel(OUTCOMES);
        let (serving, served) = mpsc::channel(OUTCOMES);
        let (health, answered) = mpsc::channel(OUTCOMES);
        let processes = Processes {
            host: config.host.clone(),
            max_log_bytes: config.max_log_bytes,
            directory,
            this_program: std::env::current_exe()?,
            jobs: spawner::start(told)?,
            tell: Tell { serving, health },
            by_id: BTreeMap::new(),
            ended_logs: EndedLogs::default(),
        };
        Ok((processes, Told { outcomes, serving: served, health: answered }))
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
        let (ask, questions) = mpsc::channel(1);
        let within = template.start_timeout();
        let attended = attend(self.directory.clone(), id.to_owned(), within, questions, self.tell.clone());
        let attended = tokio::spawn(attended).abort_handle();
        self.by_id.entry(id.to_owned()).or_default().attended = Some((attended, ask));
        Ok(())
    }

    /// Its process is there.
    pub(super) fn spawned(&mut self, id: &str, pid: u32) {
        self.by_id.entry(id.to_owned()).or_default().pid = pid;
    }

    /// Its process is gone.
    pub(super) fn exited(&mut self, id: &str) {
        if let Some((attended, _)) = self.by_id.remove(id).and_then(|process| process.attended) {
            attended.abort();
        }
        // One that was killed could not take it back itself.
        let _ = std::fs::remove_file(self.directory.endpoint_file(id));
        self.ended_logs.add(self.log_file(id));
    }

    /// Asks one that serves whether it still does.
    pub(super) fn check(&self, id: &str, within: Duration) {
        if let Some((_, ask)) = self.by_id.get(id).and_then(|process| process.attended.as_ref()) {
            // Full where the last question has not been answered: then that answer serves.
            let _ = ask.try_send(within);
        }
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

/// Tells once a worker serves, and whether it still does whenever that is asked. One that never does is the pools' business: they
/// know when it is too late.
async fn attend(
    directory: RuntimeDirectory,
    id: String,
    within: Duration,
    mut questions: mpsc::Receiver<Duration>,
    tell: Tell,
) {
    let found = match directory.wait_for(&id, within).await {
        Ok(endpoint) => endpoint,
        Err(error) => return tracing::debug!(id, %error, "no endpoint of a worker"),
    };
    let mut health = Health::of(found.clone());
    match health.serving(within).await {
        Ok(()) => drop(tell.serving.send((id.clone(), found.to_string())).await),
        Err(error) => return tracing::debug!(id, %error, "a worker does not serve"),
    }
    while let Some(within) = questions.recv().await {
        let answer = health.serving(within).await.map_err(|error| error.to_string());
        if tell.health.send((id.clone(), answer)).await.is_err() {
            return;
        }
    }
}
