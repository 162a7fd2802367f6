//! A resource manager as a real process that is killed, suspended and started again, on a disk and with a clock that can be made bad.

use crate::support::{Place, Started};
use anyhow::{Context, ensure};
use nix::sys::signal::Signal;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::process::Command;

/// What is wrong with the disk and the clock of a process; `shim.c` has the same fields.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Faults {
    pub(crate) sync_ms: i64,
    pub(crate) sync_error: i64,
    pub(crate) write_error: i64,
    pub(crate) clock_s: i64,
}

impl Faults {
    fn fails(self) -> bool {
        self.sync_error != 0 || self.write_error != 0
    }
}

/// The library that is preloaded; none where there is no C compiler.
#[derive(Debug, Clone)]
pub(crate) struct Shim(Option<PathBuf>);

impl Shim {
    /// Compiles it into `directory`.
    pub(crate) fn build(directory: &Path) -> Shim {
        let library = directory.join("shim.so");
        let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/faults/shim.c");
        let mut compiler = Command::new("cc");
        compiler.args(["-shared", "-fPIC", "-O1", "-o"]).arg(&library).arg(source).arg("-ldl");
        let built = compiler.status().is_ok_and(|status| status.success());
        if !built {
            println!("SKIPPED: faults of the disk and of the clock: no C compiler (`cc`) here");
        }
        Shim(built.then_some(library))
    }

    pub(crate) fn is_there(&self) -> bool {
        self.0.is_some()
    }
}

/// See the module.
pub(crate) struct Manager {
    place: Place,
    shim: Shim,
    faults: std::fs::File,
    now: Faults,
    /// Since it was started.
    disk_failed: bool,
    process: Option<Started>,
    starts: usize,
}

impl Manager {
    pub(crate) fn start(shim: Shim) -> anyhow::Result<Manager> {
        let place = Place::new()?;
        let faults = std::fs::File::create(place.path().join("faults"))?;
        faults.set_len(4096)?;
        let mut manager =
            Manager { place, shim, faults, now: Faults::default(), disk_failed: false, process: None, starts: 0 };
        manager.start_again()?;
        Ok(manager)
    }

    pub(crate) fn place(&self) -> &Place {
        &self.place
    }

    pub(crate) fn socket(&self) -> PathBuf {
        self.place.path().join("rm.sock")
    }

    /// Kills it if it runs.
    pub(crate) fn kill(&mut self) -> anyhow::Result<()> {
        if let Some(mut process) = self.process.take() {
            process.signal(Signal::SIGKILL)?;
            let status = process.child.wait()?;
            // On a disk that fails it does not start, and may end.
            let ended = status.code().is_some() && !self.disk_failed;
            ensure!(!ended, "it had ended by itself ({status}): {}", process.said());
        }
        Ok(())
    }

    pub(crate) fn start_again(&mut self) -> anyhow::Result<()> {
        if self.process.is_some() {
            return Ok(());
        }
        self.starts += 1;
        self.disk_failed = self.now.fails();
        let (listen, state) = (format!("unix:{}", self.socket().display()), self.place.path().join("state"));
        let state = state.to_str().context("a path")?;
        let arguments = ["resource-manager", "--listen", &listen, "--state-dir", state, "--durability", "group"];
        let (faults, library) = (self.place.path().join("faults"), self.shim.0.clone().unwrap_or_default());
        let mut environment = vec![("RATN_LOG", "info")];
        if self.shim.is_there() {
            environment.push(("RATN_FAULTS", faults.to_str().context("a path")?));
            environment.push(("LD_PRELOAD", library.to_str().context("a path")?));
        }
        self.process = Some(self.place.start_with(&format!("rm-{}", self.starts), &arguments, &environment)?);
        Ok(())
    }

    pub(crate) fn signal(&self, signal: Signal) -> anyhow::Result<()> {
        self.process.as_ref().map_or(Ok(()), |process| process.signal(signal))
    }

    /// Changes what is wrong with its disk and clock.
    pub(crate) fn change(&mut self, change: impl FnOnce(&mut Faults)) -> anyhow::Result<()> {
        change(&mut self.now);
        self.disk_failed |= self.now.fails();
        let Faults { sync_ms, sync_error, write_error, clock_s } = self.now;
        let bytes = [sync_ms, sync_error, write_error, clock_s].map(i64::to_ne_bytes).concat();
        Ok(self.faults.write_all_at(&bytes, 0)?)
    }

    /// What it has written to standard error, of all its lives.
    pub(crate) fn said(&self) -> String {
        let said =
            |start| std::fs::read_to_string(self.place.path().join(format!("rm-{start}err"))).unwrap_or_default();
        (1..=self.starts).map(|start| format!("-- start {start}\n{}", said(start))).collect()
    }
}
