//! `ratn ps`, `ratn logs` and `ratn pool`: the worker processes of a host, for people and scripts.
//!
//! Each asks one process manager; a log is a file of its runtime directory, so it is read on its host, also when nothing runs any more.

use super::blocking_on;
use crate::columns::columns;
use crate::failure::Failure;
use crate::output;
use crate::system::public_directory;
use anyhow::Context;
use clap::{Args, Subcommand};
use ratn_proto::types::{PoolStatus, WorkerState, WorkerStatus};
use ratn_worker::client::{Channels, ProcessClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use serde_json::json;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

const ROLE: &str = ratn_daemon::process_manager::ROLE;
/// How often a log that is followed is looked at.
const LOOK_INTERVAL: Duration = Duration::from_millis(200);

/// Which process manager, and how its answers are shown.
#[derive(Debug, Clone, Args)]
pub(crate) struct HostArguments {
    /// Where endpoint files are; $RATN_RUNTIME_DIR, $XDG_RUNTIME_DIR/ratn or /tmp/ratn-UID unless given
    #[arg(long, value_name = "DIR", global = true)]
    runtime_dir: Option<PathBuf>,
    /// Where the process manager is, instead: `unix:/path`, `https://host:port`
    #[arg(long, value_name = "ADDRESS", global = true)]
    manager: Option<Endpoint>,
    /// Print one JSON document on standard output
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct LogsArguments {
    /// The worker's id, as `ps` shows it: `path-planner-1@compute`
    worker: String,
    /// Go on with what is written from now on
    #[arg(short, long)]
    follow: bool,
    /// Where the process manager's endpoint file is; $RATN_RUNTIME_DIR, $XDG_RUNTIME_DIR/ratn or /tmp/ratn-UID unless given
    #[arg(long, value_name = "DIR")]
    runtime_dir: Option<PathBuf>,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct PoolArguments {
    #[command(subcommand)]
    command: PoolCommand,
    #[command(flatten)]
    host: HostArguments,
}

#[derive(Debug, Clone, Subcommand)]
enum PoolCommand {
    /// Start more workers of a template, which then are kept; also where it has failed
    Start {
        /// The template's name
        template: String,
        /// How many more
        #[arg(default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
        count: u32,
    },
    /// End workers, each once nobody holds it; a template never keeps less than its minimum
    Stop {
        /// Their ids
        #[arg(required = true)]
        workers: Vec<String>,
    },
}

/// Shows the workers of a host.
pub(super) fn ps(host: &HostArguments) -> Result<(), Failure> {
    asking(host, async |client| {
        let (name, pools) = client.pools().await?;
        match host.json {
            true => output::result(json!({ "host": name, "pools": pools.iter().map(in_json).collect::<Vec<_>>() }))?,
            false => output::result(table(&pools))?,
        }
        Ok(())
    })
}

/// Starts and ends workers.
pub(super) fn run(arguments: &PoolArguments) -> Result<(), Failure> {
    let json = arguments.host.json;
    asking(&arguments.host, async |client| {
        let ids = match &arguments.command {
            PoolCommand::Start { template, count } => client.spawn(template, *count).await.context("not started")?,
            PoolCommand::Stop { workers } => {
                for id in workers {
                    client.stop(id).await.with_context(|| format!("`{id}` is not ended"))?;
                }
                workers.clone()
            }
        };
        if json {
            output::result(json!(ids))?
        } else {
            output::result(ids.join("\n"))?
        }
        Ok(())
    })
}

/// Prints what a worker wrote, with what was kept of before.
pub(super) fn logs(arguments: &LogsArguments) -> Result<(), Failure> {
    let directory = RuntimeDirectory::at(public_directory(arguments.runtime_dir.as_deref()));
    let known = !arguments.worker.is_empty() && !arguments.worker.contains('/');
    let file = directory.path().join("logs").join(format!("{}.log", arguments.worker));
    if !known || !file.is_file() {
        let message = format!(
            "ratn: there is no log of a worker `{}` at {}: `ratn ps` lists those that run on this host; the logs of the last that ended are kept",
            arguments.worker,
            file.display()
        );
        return Err(Failure::Refused(message));
    }
    let mut out = io::stdout().lock();
    if let Ok(before) = std::fs::read(file.with_extension("log.1"))
        && !written(&mut out, &before)?
    {
        return Ok(());
    }
    let mut reading = Reading::of(&file)?;
    loop {
        let more = reading.more()?;
        if !written(&mut out, &more)? || !arguments.follow {
            return Ok(());
        }
        if more.is_empty() {
            std::thread::sleep(LOOK_INTERVAL);
        }
    }
}

/// False once nobody reads it any more.
fn written(out: &mut impl Write, bytes: &[u8]) -> anyhow::Result<bool> {
    match out.write_all(bytes).and_then(|()| out.flush()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        other => other.map(|()| true).context("cannot write the log to standard output"),
    }
}

/// A log that is read on, also when it is begun anew.
struct Reading {
    path: PathBuf,
    file: File,
    inode: u64,
}

impl Reading {
    fn of(path: &Path) -> anyhow::Result<Reading> {
        let file = File::open(path).with_context(|| format!("cannot read {}", path.display()))?;
        let inode = file.metadata().with_context(|| format!("cannot read {}", path.display()))?.ino();
        Ok(Reading { path: path.to_owned(), file, inode })
    }

    /// What was written since the last call; nothing when nothing was.
    fn more(&mut self) -> anyhow::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        self.file.read_to_end(&mut bytes).with_context(|| format!("cannot read {}", self.path.display()))?;
        // Of the one before all has been read only now.
        if bytes.is_empty() && std::fs::metadata(&self.path).is_ok_and(|now| now.ino() != self.inode) {
            *self = Reading::of(&self.path)?;
            self.file.seek(SeekFrom::Start(0)).context("cannot read the log")?;
            self.file.read_to_end(&mut bytes).with_context(|| format!("cannot read {}", self.path.display()))?;
        }
        Ok(bytes)
    }
}

fn asking(host: &HostArguments, ask: impl AsyncFnOnce(ProcessClient) -> Result<(), Failure>) -> Result<(), Failure> {
    blocking_on(tokio::runtime::Builder::new_current_thread(), async {
        let endpoint = match &host.manager {
            Some(endpoint) => endpoint.clone(),
            None => RuntimeDirectory::at(public_directory(host.runtime_dir.as_deref()))
                .find(ROLE)
                .map_err(|error| Failure::Refused(format!("ratn: {error}")))?,
        };
        ask(ProcessClient::new(&Channels::new(), &endpoint)?).await
    })
}

/// One line each, and one for each pool that has none or has failed.
fn table(pools: &[PoolStatus]) -> String {
    let mut rows = Vec::new();
    for pool in pools {
        rows.extend(pool.workers.iter().map(|worker| row(pool, worker)));
    }
    let mut lines = vec![columns(&["WORKER", "KIND", "STATE", "PID", "MEMORY", "CPU", "LIMITS"], rows)];
    for pool in pools.iter().filter(|pool| pool.workers.is_empty() || !pool.failure.is_empty()) {
        let PoolStatus { template, min, max, .. } = pool;
        lines.push(match pool.failure.as_str() {
            "" => format!("{template}: no workers now ({min} to {max})"),
            failure => format!("{template}: FAILED: {failure}; `ratn pool start {template}` tries again"),
        });
    }
    lines.join("\n")
}

fn row(pool: &PoolStatus, worker: &WorkerStatus) -> [String; 7] {
    [
        worker.id.clone(),
        pool.kind.clone(),
        state(worker.state).to_owned(),
        if worker.pid == 0 { "-".to_owned() } else { worker.pid.to_string() },
        format!("{} MiB", worker.resident_bytes >> 20),
        format!("{:.1} %", f64::from(worker.cpu_millicores) / 10.0),
        if worker.limits.is_empty() { "-".to_owned() } else { worker.limits.clone() },
    ]
}

fn state(state: WorkerState) -> &'static str {
    match state {
        WorkerState::Starting => "starting",
        WorkerState::Ready => "ready",
        WorkerState::Exited => "exited",
    }
}

fn in_json(pool: &PoolStatus) -> serde_json::Value {
    let worker = |worker: &WorkerStatus| {
        json!({
            "id": worker.id, "state": state(worker.state), "pid": worker.pid, "endpoint": worker.endpoint,
            "resident_bytes": worker.resident_bytes, "cpu_millicores": worker.cpu_millicores, "limits": worker.limits,
        })
    };
    json!({
        "template": pool.template, "kind": pool.kind, "min": pool.min, "max": pool.max, "failure": pool.failure,
        "workers": pool.workers.iter().map(worker).collect::<Vec<_>>(),
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn a_table_shows_every_worker_and_what_is_wrong_with_pools() {
        let worker = WorkerStatus {
            id: "path-planner-1@compute".to_owned(),
            template: "path-planner".to_owned(),
            state: WorkerState::Ready,
            pid: 42,
            endpoint: "unix:/a.sock".to_owned(),
            reason: String::new(),
            resident_bytes: 24 << 20,
            cpu_millicores: 1_015,
            limits: String::new(),
        };
        let pool = |template: &str, workers, failure: &str| PoolStatus {
            template: template.to_owned(),
            kind: "PathPlanner".to_owned(),
            min: 0,
            max: 4,
            workers,
            failure: failure.to_owned(),
        };
        let pools =
            [pool("path-planner", vec![worker], ""), pool("detector", vec![], ""), pool("script", vec![], "5 crashes")];
        insta::assert_snapshot!(table(&pools), @r"
        WORKER                  KIND         STATE  PID  MEMORY  CPU      LIMITS
        path-planner-1@compute  PathPlanner  ready  42   24 MiB  101.5 %  -
        detector: no workers now (0 to 4)
        script: FAILED: 5 crashes; `ratn pool start script` tries again
        ");
    }

    #[test]
    fn a_log_that_is_begun_anew_is_read_on() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("planner-1@compute.log");
        std::fs::write(&path, "one\n").unwrap();
        let mut reading = Reading::of(&path).unwrap();
        assert_eq!(reading.more().unwrap(), b"one\n");
        assert_eq!(reading.more().unwrap(), b"");
        let mut writing = File::options().append(true).open(&path).unwrap();
        writing.write_all(b"two\n").unwrap();
        std::fs::rename(&path, path.with_extension("log.1")).unwrap();
        std::fs::write(&path, "three\n").unwrap();
        assert_eq!([reading.more().unwrap(), reading.more().unwrap()], [b"two\n".to_vec(), b"three\n".to_vec()]);
    }
}
