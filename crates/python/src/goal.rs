//! A goal in the form in which a Python action sees it. Every wait releases Python's lock, and ends when the goal is told to stop.

use crate::error::{line, of_failure, of_world};
use crate::numbers;
use crate::patience::patience;
use crate::process::Process;
use crate::value::{Fact, fields_from_python, fields_to_python, from_python};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use ratn_model::fact::FactKey;
use ratn_model::measurement::{Certainty, Measurement};
use ratn_model::value::Value;
use ratn_proto::convert::{ports_bytes, wire_ports};
use ratn_proto::types::GoalOutcome;
use ratn_worker::action::{ActionFailure, CallFailure, GoalContext, MAX_PROGRESS_BYTES};
use ratn_worker::client::{fact, pattern};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use tokio::runtime::Handle;
use tokio::task::AbortHandle;

/// A goal under way: its inputs, and the means to perform it.
#[pyclass(frozen, module = "ratn")]
pub(crate) struct Goal {
    context: Arc<GoalContext>,
    runtime: Handle,
    /// The worker's process: in a fork, no news of the goal arrives, and no report is heard.
    process: Process,
    measured: Mutex<Vec<(FactKey, Value, Measurement)>>,
    /// Tasks that wait for the goal to be told to stop; `None` when the goal is over.
    watching: Mutex<Option<Vec<AbortHandle>>>,
    /// Set while Python's lock is held: a callback that has waited for the lock checks it again.
    over: Arc<AtomicBool>,
}

impl Goal {
    pub(crate) fn new(context: Arc<GoalContext>, runtime: Handle) -> Goal {
        Goal {
            context,
            runtime,
            process: Process::new(),
            measured: Mutex::default(),
            watching: Mutex::new(Some(Vec::new())),
            over: Arc::default(),
        }
    }

    /// The goal, if this is the process that performs it.
    fn here(&self) -> PyResult<&GoalContext> {
        self.process.check("this goal", "ask and tell in the action itself").map(|()| &*self.context)
    }

    /// The goal is over: no callback of `on_cancel` is called any more.
    pub(crate) fn is_over(&self, _: Python<'_>) {
        self.over.store(true, Ordering::Relaxed);
        let watching = self.watching.lock().unwrap_or_else(PoisonError::into_inner).take();
        watching.iter().flatten().for_each(AbortHandle::abort);
    }

    /// The outcome with the measured facts.
    pub(crate) fn with_measured(&self, mut outcome: GoalOutcome) -> GoalOutcome {
        let measured = std::mem::take(&mut *self.measured.lock().unwrap_or_else(PoisonError::into_inner));
        for (key, value, measurement) in measured {
            outcome.evidence.push((key.clone(), measurement));
            outcome.measured.push((key, value));
        }
        outcome
    }
}

#[pymethods]
impl Goal {
    /// The id of the attempt, unique.
    #[getter]
    fn id(&self) -> &str {
        &self.context.id
    }

    /// The name of the action.
    #[getter]
    fn action(&self) -> &str {
        &self.context.action
    }

    /// The seed for every random choice.
    #[getter]
    fn seed(&self) -> u64 {
        self.context.seed
    }

    /// Whether the goal has been cancelled.
    #[getter]
    fn cancelled(&self) -> PyResult<bool> {
        Ok(self.here()?.cancelled.is_cancelled())
    }

    /// Raises `ratn.Cancelled` if the goal has been cancelled. Calling it ten times a second is often enough.
    fn checkpoint(&self) -> PyResult<()> {
        self.here()?.checkpoint().map_err(of_failure)
    }

    /// Sleeps for `seconds` of wall time; raises `ratn.Cancelled` as soon as the goal is cancelled.
    fn sleep(&self, py: Python<'_>, seconds: f64) -> PyResult<()> {
        let (goal, pause) = (self.here()?, patience("seconds", Some(seconds))?);
        let slept = async {
            match pause {
                Some(pause) => goal.unless_cancelled(tokio::time::sleep(pause)).await,
                None => goal.unless_cancelled(std::future::pending()).await,
            }
        };
        py.detach(|| self.runtime.block_on(slept)).map_err(of_failure)
    }

    /// Waits while the driver is held or the goal is suspended; raises `ratn.Cancelled` as soon as the goal is cancelled. Actions that move something
    /// call it between two steps.
    fn while_held(&self, py: Python<'_>) -> PyResult<()> {
        let goal = self.here()?;
        py.detach(|| self.runtime.block_on(goal.while_held())).map_err(of_failure)
    }

    /// The facts of the goal's world that match any of the patterns: `goal.facts("at(?)", "on(?, table)")`.
    #[pyo3(signature = (*patterns))]
    fn facts(&self, py: Python<'_>, patterns: Vec<String>) -> PyResult<Vec<Fact>> {
        let goal = self.here()?;
        let patterns = patterns.iter().map(|text| pattern(text)).collect::<Result<Vec<_>, _>>();
        let patterns = patterns.map_err(PyValueError::new_err)?;
        let asked = async { goal.unless_cancelled(goal.facts(&patterns)).await };
        let facts = py.detach(|| self.runtime.block_on(asked)).map_err(of_failure)?;
        Ok(Fact::all(facts.map_err(of_world)?))
    }

    /// Reports progress to listeners and to the event log; figures are keyword arguments. Message and figures have at most 16 KiB together
    /// (`ValueError`); calls above 100 per second are dropped.
    #[pyo3(signature = (message, /, **figures))]
    fn progress(&self, message: String, figures: Option<&Bound<'_, PyDict>>) -> PyResult<()> {
        let goal = self.here()?;
        let figures = figures.map(fields_from_python).transpose()?.unwrap_or_default();
        let bytes = message.len() + ports_bytes(&wire_ports(figures.clone()));
        if bytes > MAX_PROGRESS_BYTES {
            let said = format!(
                "progress: the message and its figures have {bytes} bytes, at most {MAX_PROGRESS_BYTES} are told; what is large is an output"
            );
            return Err(PyValueError::new_err(said));
        }
        goal.progress_with(message, figures);
        Ok(())
    }

    /// The outputs that must keep the values of the first result, if the goal allows intermediate results (`goal.improved`); `None` if only the
    /// returned result counts.
    #[getter]
    fn improves(&self) -> Option<Vec<String>> {
        self.context.improves().map(<[String]>::to_vec)
    }

    /// Gives an intermediate result that can be used, and goes on: the first one, or one with a lower cost than those before. `cost_s` is the cost of
    /// using it, in seconds of the robot's time. The goal is cancelled (`ratn.Cancelled`) when somebody uses the result, or needs the worker: then
    /// the last given result counts.
    #[pyo3(signature = (outputs, *, cost_s))]
    fn improved(&self, outputs: &Bound<'_, PyDict>, cost_s: f64) -> PyResult<()> {
        self.here()?.improved(fields_from_python(outputs)?, cost_s).map_err(of_failure)
    }

    /// Records a measured fact, `goal.measured("at(box_1)", pose, covariance=…)`, which is sent with the outcome. `covariance` is a square matrix,
    /// row by row or as an array (for a pose x, y, z in metres, and the rotations about them in radians); `confidence` is a probability.
    #[pyo3(signature = (fact_text, value, *, covariance=None, confidence=None, source=String::new()))]
    fn measured(
        &self,
        fact_text: &str,
        value: &Bound<'_, PyAny>,
        covariance: Option<&Bound<'_, PyAny>>,
        confidence: Option<f64>,
        source: String,
    ) -> PyResult<()> {
        self.here()?;
        let key = fact(fact_text).map_err(PyValueError::new_err)?;
        let value = from_python(value)?;
        let no_matrix = || PyValueError::new_err("covariance: expected a square matrix of numbers");
        let certainty = match (covariance, confidence) {
            (Some(_), Some(_)) => return Err(PyValueError::new_err("say a covariance or a confidence, not both")),
            (Some(matrix), None) => Some(Certainty::Covariance(numbers::taken(matrix).map_err(|_| no_matrix())?)),
            (None, confidence) => confidence.map(Certainty::Confidence),
        };
        certainty.as_ref().map_or(Ok(()), Certainty::check).map_err(PyValueError::new_err)?;
        let mut measured = self.measured.lock().unwrap_or_else(PoisonError::into_inner);
        measured.push((key, value, Measurement { source, certainty }));
        Ok(())
    }

    /// Has another provider of this goal's lease perform an action, `goal.call("Camera", "capture", exposure_s=0.01)`; returns its outputs.
    #[pyo3(signature = (kind, action, /, **inputs))]
    fn call<'py>(
        &self,
        py: Python<'py>,
        kind: &str,
        action: &str,
        inputs: Option<&Bound<'py, PyDict>>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let goal = self.here()?;
        let inputs = inputs.map(fields_from_python).transpose()?.unwrap_or_default();
        let called = py.detach(|| self.runtime.block_on(goal.call(kind, action, inputs)));
        let failure = |error| match error {
            CallFailure::Cancelled { .. } => goal.stopped(),
            error => ActionFailure::from(error),
        };
        fields_to_python(py, called.map_err(|error| of_failure(failure(error)))?)
    }

    /// Calls `back` without arguments, in another thread, when the goal is cancelled; not after the goal's end.
    fn on_cancel(&self, back: Py<PyAny>) -> PyResult<()> {
        let cancelled = self.here()?.cancelled.clone();
        let mut watching = self.watching.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(watching) = watching.as_mut() else { return Ok(()) };
        let over = Arc::clone(&self.over);
        let task = self.runtime.spawn(async move {
            cancelled.cancelled().await;
            let call = move |py: Python<'_>| match over.load(Ordering::Relaxed) {
                true => Ok(()),
                false => back.call0(py).map(drop),
            };
            let called = tokio::task::spawn_blocking(move || Python::attach(call));
            if let Ok(Err(error)) = called.await {
                tracing::warn!(error = %line(&error), "what was to be called when the goal shall stop has failed");
            }
        });
        watching.push(task.abort_handle());
        Ok(())
    }

    fn __repr__(&self) -> String {
        format!("<Goal {} of {}>", self.context.id, self.context.action)
    }
}
