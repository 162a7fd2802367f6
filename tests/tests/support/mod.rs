//! A `ratn` under test, its processes, and bounded waiting for something to become true.

#![allow(dead_code, reason = "every test file uses some of it")]

pub(crate) mod crashes;
pub(crate) mod host;
pub(crate) mod motions;
pub(crate) mod tool_clients;

use anyhow::{Context, bail};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// For whatever has to become true.
const DEADLINE: Duration = Duration::from_secs(120);
const POLL: Duration = Duration::from_millis(20);

/// A folder of its own for everything that one test starts. The runtime directories of its systems are in it, so each of
/// their processes names it on its command line.
pub(crate) struct Place {
    directory: tempfile::TempDir,
}

impl Place {
    pub(crate) fn new() -> anyhow::Result<Place> {
        Ok(Place { directory: tempfile::Builder::new().prefix("ratn-test-").tempdir()? })
    }

    pub(crate) fn path(&self) -> &Path {
        self.directory.path()
    }

    /// `ratn …`, with its temporary files here, and away from any system that the user runs.
    pub(crate) fn ratn(&self, arguments: &[&str]) -> Command {
        self.within(env!("CARGO_BIN_EXE_ratn-under-test"), arguments)
    }

    /// Another program in the same surroundings.
    pub(crate) fn within(&self, program: &str, arguments: &[&str]) -> Command {
        let mut command = Command::new(program);
        command.args(arguments).env("TMPDIR", self.path()).env("RATN_RUNTIME_DIR", self.path().join("run"));
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }

    /// Starts it; what it says goes to files here, and what is still running is killed in the end.
    pub(crate) fn start(&self, arguments: &[&str]) -> anyhow::Result<Started> {
        self.start_as("std", arguments)
    }

    /// As [`Place::start`], beside others: what it says goes to files of this name.
    pub(crate) fn start_as(&self, name: &str, arguments: &[&str]) -> anyhow::Result<Started> {
        self.start_with(name, arguments, &[("RATN_LOG", "info,ratn_worker=debug")])
    }

    /// As [`Place::start_as`], with an environment of its own.
    pub(crate) fn start_with(
        &self,
        name: &str,
        arguments: &[&str],
        environment: &[(&str, &str)],
    ) -> anyhow::Result<Started> {
        let (out, err) = (self.path().join(format!("{name}out")), self.path().join(format!("{name}err")));
        let mut command = self.ratn(arguments);
        command.envs(environment.iter().copied());
        command.stdout(std::fs::File::create(&out)?).stderr(std::fs::File::create(&err)?);
        Ok(Started { child: command.spawn()?, out, err })
    }

    /// Processes that name this place on their command line.
    pub(crate) fn processes(&self) -> Vec<Process> {
        let mut found = Vec::new();
        let Ok(entries) = std::fs::read_dir("/proc") else { return found };
        for entry in entries.flatten() {
            let Some(pid) = entry.file_name().to_str().and_then(|name| name.parse().ok()) else { continue };
            let Ok(bytes) = std::fs::read(entry.path().join("cmdline")) else { continue };
            let command = String::from_utf8_lossy(&bytes).replace('\0', " ");
            if command.contains(&*self.path().to_string_lossy()) {
                found.push(Process { pid, command });
            }
        }
        found
    }

    /// Waits until no process of it is left.
    pub(crate) fn wait_until_empty(&self) -> anyhow::Result<()> {
        wait_for("every process to end", || Ok(self.processes().is_empty().then_some(())))
            .with_context(|| format!("still running: {:?}", self.processes()))
    }
}

/// A process of a test.
#[derive(Debug, Clone)]
pub(crate) struct Process {
    pub(crate) pid: i32,
    pub(crate) command: String,
}

impl Process {
    /// `kill -9`
    pub(crate) fn kill(&self) -> anyhow::Result<()> {
        let pid = nix::unistd::Pid::from_raw(self.pid);
        nix::sys::signal::kill(pid, nix::sys::signal::Signal::SIGKILL).with_context(|| format!("cannot kill {self:?}"))
    }
}

/// A command under way.
pub(crate) struct Started {
    pub(crate) child: Child,
    out: PathBuf,
    err: PathBuf,
}

impl Started {
    pub(crate) fn process(&self) -> anyhow::Result<Process> {
        Ok(Process { pid: i32::try_from(self.child.id())?, command: "ratn".into() })
    }

    pub(crate) fn signal(&self, signal: nix::sys::signal::Signal) -> anyhow::Result<()> {
        Ok(nix::sys::signal::kill(nix::unistd::Pid::from_raw(i32::try_from(self.child.id())?), signal)?)
    }

    /// Waits for its end: the exit code, and what it wrote.
    pub(crate) fn finish(&mut self) -> anyhow::Result<(Option<i32>, String, String)> {
        let status = wait_for("the command to end", || Ok(self.child.try_wait()?)).context(self.said())?;
        Ok((status.code(), std::fs::read_to_string(&self.out)?, std::fs::read_to_string(&self.err)?))
    }

    /// What it has written to standard error so far.
    pub(crate) fn said(&self) -> String {
        std::fs::read_to_string(&self.err).unwrap_or_default()
    }
}

impl Drop for Started {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Asks again until there is an answer.
pub(crate) fn wait_for<T>(what: &str, mut ask: impl FnMut() -> anyhow::Result<Option<T>>) -> anyhow::Result<T> {
    let start = Instant::now();
    loop {
        if let Some(answer) = ask()? {
            return Ok(answer);
        }
        if start.elapsed() > DEADLINE {
            bail!("waited {} s in vain for {what}", DEADLINE.as_secs());
        }
        std::thread::sleep(POLL);
    }
}

/// Standard output and standard error as text.
pub(crate) fn texts(output: &Output) -> (String, String) {
    (String::from_utf8_lossy(&output.stdout).into_owned(), String::from_utf8_lossy(&output.stderr).into_owned())
}

/// A file of the repository.
pub(crate) fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}
