//! Starts a whole system on this machine as children of this process, and ends it again whatever happens.
//!
//! Every child is this same binary in one of its roles, in a separate process group (Ctrl-C reaches only this process, which then ends the
//! children in order). Its standard input is a pipe that closes when this process ends, and its output goes to a log file in the runtime
//! directory. A system is ready when every role has published its endpoint and every resource that the config promises exists.

use super::patience::{Patience, Verdict, processor_time};
use crate::output;
use anyhow::{Context, bail};
use ratn_daemon::supervisor::command_of;
use ratn_model::resource::Quantity;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};
use tokio::process::Child;

const POLL: Duration = Duration::from_millis(10);
/// Interval at which the activity of missing parts is checked.
const LOOK: Duration = Duration::from_secs(1);
/// Time from SIGTERM to SIGKILL, for all roles together.
const STOP_DEADLINE: Duration = Duration::from_secs(3);
/// Bytes of a dead child's log that are shown.
const LAST_WORDS_BYTES: u64 = 2000;

/// One role as a child process.
#[derive(Debug)]
pub(crate) struct RoleProcess {
    role: &'static str,
    child: Child,
    log: PathBuf,
}

impl RoleProcess {
    /// Starts `ratn <role> --config … --runtime-dir … --exit-with-parent`.
    pub(crate) fn start(role: &'static str, config: &Path, directory: &Path) -> anyhow::Result<RoleProcess> {
        let log = directory.join(format!("{role}.log"));
        let output = File::create(&log).with_context(|| format!("cannot create {}", log.display()))?;
        let binary = std::env::current_exe().context("cannot find this program's own file")?;
        let child = command_of(&binary)
            .arg(role)
            .arg("--config")
            .arg(config)
            .arg("--runtime-dir")
            .arg(directory)
            .arg("--exit-with-parent")
            .stdin(Stdio::piped())
            .stdout(output.try_clone()?)
            .stderr(output)
            .process_group(0)
            .kill_on_drop(true)
            .spawn()
            .with_context(|| format!("cannot start {} {role}", binary.display()))?;
        Ok(RoleProcess { role, child, log })
    }

    /// An error with the end of its log when it has ended.
    pub(crate) fn check_running(&mut self) -> anyhow::Result<()> {
        if let Some(status) = self.child.try_wait()? {
            bail!("{} ended ({status}); the end of {}:\n{}", self.role, self.log.display(), last_words(&self.log));
        }
        Ok(())
    }

    fn signal(&self, signal: nix::sys::signal::Signal) {
        if let Some(pid) = self.child.id().and_then(|pid| i32::try_from(pid).ok()) {
            let _ = nix::sys::signal::kill(nix::unistd::Pid::from_raw(pid), signal);
        }
    }
}

/// The roles of one system.
#[derive(Debug, Default)]
pub(crate) struct Processes {
    roles: Vec<RoleProcess>,
}

impl Processes {
    /// Starts all of them at once: each waits for the roles that it needs.
    pub(crate) fn start(roles: &[&'static str], config: &Path, directory: &Path) -> anyhow::Result<Processes> {
        let roles = roles.iter().map(|role| RoleProcess::start(role, config, directory)).collect::<Result<_, _>>()?;
        Ok(Processes { roles })
    }

    /// Waits until nothing is `missing`, which returns the missing parts, for people; roles by their names.
    ///
    /// # Errors
    /// The error of `missing` where waiting is in vain; or when a process ends, or when the [`Patience`] is over, with the end of the log.
    pub(crate) async fn wait_until<F>(&mut self, mut missing: F) -> anyhow::Result<()>
    where
        F: AsyncFnMut() -> anyhow::Result<Vec<String>>,
    {
        let (mut patience, mut looked) = (Patience::new(Instant::now()), Instant::now());
        loop {
            self.check_running()?;
            let missing = missing().await?;
            if missing.is_empty() {
                return Ok(());
            }
            let now = Instant::now();
            if now.duration_since(looked) >= LOOK {
                looked = now;
                let missing_now = missing.join(", ");
                match patience.look(now, &self.processor_time_of(&missing)) {
                    Verdict::Wait => {}
                    Verdict::Say(waited) => output::progress(format_args!(
                        "still missing after {} s: {missing_now}; it is waited for while it works",
                        waited.as_secs()
                    )),
                    Verdict::GiveUp(waited, why) => {
                        let mut text = format!(
                            "the system is not ready after {} s, {why}: still missing {missing_now}",
                            waited.as_secs()
                        );
                        for role in &self.roles {
                            text += &format!("\nthe end of {}:\n{}", role.log.display(), last_words(&role.log));
                        }
                        bail!(text);
                    }
                }
            }
            tokio::time::sleep(POLL).await;
        }
    }

    /// The processor time of the missing roles, and of the workers that roles have started.
    fn processor_time_of(&self, missing: &[String]) -> BTreeMap<u32, Duration> {
        let is_missing = |role: &&RoleProcess| missing.iter().any(|name| name == role.role);
        let of: Vec<u32> = self.roles.iter().filter(is_missing).filter_map(|role| role.child.id()).collect();
        let all: Vec<u32> = self.roles.iter().filter_map(|role| role.child.id()).collect();
        processor_time(&of, &all)
    }

    /// An error when one of them has ended.
    pub(crate) fn check_running(&mut self) -> anyhow::Result<()> {
        self.roles.iter_mut().try_for_each(RoleProcess::check_running)
    }

    /// Resolves with an error when one of them ends.
    pub(crate) async fn one_ended(&mut self) -> anyhow::Error {
        loop {
            if let Err(error) = self.check_running() {
                return error;
            }
            tokio::time::sleep(POLL * 10).await;
        }
    }

    /// Ends them, last started first; kills those that do not end by themselves.
    pub(crate) async fn stop(mut self) {
        let start = Instant::now();
        for process in self.roles.iter_mut().rev() {
            drop(process.child.stdin.take());
            process.signal(nix::sys::signal::Signal::SIGTERM);
        }
        for process in self.roles.iter_mut().rev() {
            let left = STOP_DEADLINE.saturating_sub(start.elapsed());
            if tokio::time::timeout(left, process.child.wait()).await.is_err() {
                output::progress(format_args!("{} did not end in time and is killed", process.role));
                let _ = process.child.kill().await;
            }
        }
    }
}

fn last_words(log: &Path) -> String {
    let read = || -> std::io::Result<String> {
        let mut file = File::open(log)?;
        let length = file.metadata()?.len();
        file.seek(SeekFrom::Start(length.saturating_sub(LAST_WORDS_BYTES)))?;
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes)?;
        Ok(String::from_utf8_lossy(&bytes).trim_end().to_owned())
    };
    read().map_or_else(
        |error| format!("(unreadable: {error})"),
        |text| if text.is_empty() { "(empty)".into() } else { text },
    )
}

/// The part of `wanted` (resources by kind) that is not in `there`: by kind, for people.
pub(crate) fn missing<'a>(
    wanted: &'a BTreeMap<String, Quantity>,
    there: &BTreeMap<String, Quantity>,
) -> BTreeMap<&'a str, String> {
    let short = wanted.iter().filter_map(|(kind, n)| {
        let have = there.get(kind).copied().unwrap_or_default();
        (have < *n).then(|| (kind.as_str(), format!("{kind} ({have} of {n})")))
    });
    short.collect()
}
