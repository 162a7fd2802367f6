//! Restricts objects to one process. Threads, connections and child processes do not exist in a fork of the process that made them: a call
//! there would wait for ever, or get a wrong answer.

use crate::error::Error;
use pyo3::prelude::*;
use std::process::id;
use std::sync::OnceLock;

/// The process that made an object.
#[pyclass(frozen, module = "ratn")]
#[derive(Debug, Clone, Copy)]
pub(crate) struct Process(u32);

impl Process {
    /// The current process, which has a runtime from now on.
    pub(crate) fn of_runtime() -> Process {
        RUNTIMES.get_or_init(Process::new);
        Process::new()
    }

    /// Raises if this process is a fork of one with a runtime: that one's runtime may then get the signals instead of the one made here.
    pub(crate) fn check_signals(what: &str) -> PyResult<()> {
        RUNTIMES.get_or_init(Process::new).check(what, "start a program of its own")
    }
}

/// The first process with a runtime among those that are forks of each other.
static RUNTIMES: OnceLock<Process> = OnceLock::new();

#[pymethods]
impl Process {
    /// The current process.
    #[new]
    pub(crate) fn new() -> Process {
        Process(id())
    }

    /// Whether this is the current process.
    #[getter]
    pub(crate) fn is_here(&self) -> bool {
        self.0 == id()
    }

    /// Raises `ratn.Error` in a fork, with the name of the object and what to do `instead`.
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
