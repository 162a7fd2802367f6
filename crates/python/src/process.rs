//! What works in one process only. Threads, connections and child processes are not there in a fork of the process that made them: whoever asked them
//! there would wait for ever, or be told something wrong.

use crate::error::Error;
use pyo3::prelude::*;
use std::process::id;
use std::sync::OnceLock;

/// The process that made something.
#[pyclass(frozen, module = "ratn")]
#[derive(Debug, Clone, Copy)]
pub(crate) struct Process(u32);

impl Process {
    /// The one that this is, which has a runtime from here on.
    pub(crate) fn of_runtime() -> Process {
        RUNTIMES.get_or_init(Process::new);
        Process::new()
    }

    /// Raises where a process that this one is a fork of has a runtime: a signal may be told to that one's runtime in place of the one made here.
    pub(crate) fn check_signals(what: &str) -> PyResult<()> {
        RUNTIMES.get_or_init(Process::new).check(what, "start a program of its own")
    }
}

/// The first process of those that are forks of each other which has a runtime.
static RUNTIMES: OnceLock<Process> = OnceLock::new();

#[pymethods]
impl Process {
    /// The one that this is.
    #[new]
    pub(crate) fn new() -> Process {
        Process(id())
    }

    /// Whether this is that process.
    #[getter]
    pub(crate) fn is_here(&self) -> bool {
        self.0 == id()
    }

    /// Raises `ratn.Error` in a fork: of what, and what may be done `instead`.
    pub(crate) fn check(&self, what: &str, instead: &str) -> PyResult<()> {
        if self.is_here() {
            return Ok(());
        }
        let (made, here) = (self.0, id());
        Err(Error::new_err(format!(
            "{what} belongs to process {made}, of which this one ({here}) is a fork: {instead}, or use it before the fork, or start processes with \
             `multiprocessing.get_context(\"spawn\")`"
        )))
    }
}
