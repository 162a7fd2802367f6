//! A worker whose actions are Python functions. Each goal is performed in a thread of its own, which holds Python's lock only while Python
//! runs; calls of the daemons are answered meanwhile.

use crate::error::{Aborted, Cancelled, Error, Lost, line};
use crate::goal::Goal;
use crate::patience::patience;
use crate::process::Process;
use crate::threads::Threads;
use crate::value::{fields_from_python, from_python, inputs_to_python};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use ratn_model::value::{Type, Value};
use ratn_proto::types::GoalOutcome;
use ratn_worker::action::{Action, ActionFailure, ActionResult, GoalContext, Signature};
use ratn_worker::arguments::Arguments;
use ratn_worker::prelude::async_trait;
use ratn_worker::safety::{Brakes, Safety, SafetyState};
use ratn_worker::worker::WorkerError;
use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tokio::runtime::{Builder, Handle};
use tokio::sync::watch;
use tracing_subscriber::EnvFilter;

/// Time limit for the threads of goals at the end; threads that run longer are abandoned.
const LAST_THREADS: Duration = Duration::from_secs(1);
/// Maximum size of a traceback, or of another text of an action, in the reason of a goal.
const MAX_TRACEBACK_BYTES: usize = 8 * 1024;

/// An action as described by Python.
#[derive(FromPyObject)]
pub(crate) struct Described {
    name: String,
    description: String,
    /// Name, type, whether it is required, and otherwise its default.
    inputs: Vec<(String, String, bool, Py<PyAny>)>,
    outputs: Vec<(String, String)>,
    outcomes: Vec<String>,
    computes: bool,
    reads: Option<Vec<String>>,
    senses: Vec<String>,
    requires: Vec<String>,
    effects: Option<Vec<String>>,
    /// Kinds of resources that it blocks in addition to its own.
    blocks: Vec<String>,
    /// Its usual duration, as an expression.
    takes: Option<String>,
    /// Whether it stands still while its goal is suspended.
    suspends: bool,
    /// Whether it is an anytime action: it gives a result that can be used, and better ones later.
    anytime: bool,
    /// Inputs that are passed as arrays.
    arrays: HashSet<String>,
    /// Called with the goal and its inputs as a dict; returns an outcome, its outputs as a dict and a reason.
    perform: Py<PyAny>,
}

/// The settings of a driver in addition to its actions.
#[derive(FromPyObject)]
pub(crate) struct Driven {
    /// Called with `ready`, `held` or `stopped`, and the reason.
    brakes: Py<PyAny>,
    /// The file that keeps an emergency stop.
    stop_file: Option<PathBuf>,
    /// The time within which everything stands still after a lease has ended.
    standstill_s: Option<f64>,
}

/// Serves until a signal or the end of the parent. `arguments` are those of the process, as passed by a template.
#[pyfunction]
#[pyo3(signature = (arguments, provider, kind, actions, without_leases, driven=None))]
pub(crate) fn serve(
    py: Python<'_>,
    arguments: Vec<String>,
    provider: &str,
    kind: &str,
    actions: Vec<Described>,
    without_leases: bool,
    driven: Option<Driven>,
) -> PyResult<()> {
    Process::check_signals("this worker")?;
    let pooled = std::env::var_os("RATN_PROVIDER_SESSION").is_some_and(|session| !session.is_empty());
    let arguments = Arguments::of(arguments, pooled).and_then(Arguments::worker);
    let mut worker = arguments.map_err(|error| PyValueError::new_err(line(&error)))?.provides(provider, kind);
    let threads = Threads::default();
    for action in actions {
        worker = worker.action(PythonAction::of(py, action, kind, &threads)?);
    }
    if without_leases {
        worker = worker.without_leases();
    }
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    // If the program has a subscriber already, that one gets the log.
    let _ = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_ansi(false).try_init();
    let standstill = driven.as_ref().and_then(|driven| driven.standstill_s);
    if let Some(seconds) = standstill {
        let bound = patience("standstill_s", Some(seconds))?;
        worker = worker.standstill(bound.ok_or_else(|| PyValueError::new_err("standstill_s: has an end"))?);
    }
    let ended = py.detach(|| {
        // One thread is enough: more would wake each other for every goal, without work to do.
        let runtime = Builder::new_multi_thread().worker_threads(1).enable_all().build();
        let runtime = runtime.map_err(|source| WorkerError::System { what: "start its runtime".to_owned(), source })?;
        let ended = runtime.block_on(async {
            let worker = match driven {
                Some(driven) => worker.safety(driven.safety().await?),
                None => worker,
            };
            worker.run().await
        });
        threads.end(LAST_THREADS);
        runtime.shutdown_timeout(LAST_THREADS);
        ended
    });
    ended.map_err(|error| Error::new_err(line(&error)))
}

impl Driven {
    async fn safety(self) -> Result<Safety, WorkerError> {
        let brakes = PythonBrakes::new(self.brakes);
        let Some(file) = self.stop_file else { return Ok(Safety::new(brakes)) };
        let what = format!("keep a stop in {}", file.display());
        Safety::kept_in(file, brakes).await.map_err(|source| WorkerError::System { what, source })
    }
}

/// Brakes that are a Python function. A stop does not wait for an earlier call: it is made in another thread then. A Python call cannot be
/// dropped, so the earlier one may still carry out its state, for example `ready`, after the newer one has returned; or it may hold what
/// the newer one needs. So the newer call is repeated when all earlier ones have returned, whatever its result was, and only the repeated
/// call's result counts.
struct PythonBrakes {
    apply: Arc<Py<PyAny>>,
    calls: watch::Sender<BrakeCalls>,
}

/// The calls of the brakes under way, by number, and the number of the newest requested state.
#[derive(Debug, Default)]
struct BrakeCalls {
    newest: u64,
    last: u64,
    under_way: BTreeSet<u64>,
}

/// A call that is under way until this is dropped.
struct BrakeCall {
    calls: watch::Sender<BrakeCalls>,
    state: u64,
    number: u64,
    /// Whether earlier calls were under way when it began.
    overlaps: bool,
}

impl BrakeCall {
    fn begin(calls: &watch::Sender<BrakeCalls>, state: u64) -> BrakeCall {
        let (mut number, mut overlaps) = (0, false);
        calls.send_modify(|calls| {
            overlaps = !calls.under_way.is_empty();
            calls.last += 1;
            number = calls.last;
            calls.under_way.insert(number);
        });
        BrakeCall { calls: calls.clone(), state, number, overlaps }
    }

    /// Whether a newer state was requested.
    fn is_superseded(&self) -> bool {
        self.calls.borrow().newest > self.state
    }
}

impl Drop for BrakeCall {
    fn drop(&mut self) {
        self.calls.send_modify(|calls| {
            calls.under_way.remove(&self.number);
        });
    }
}

impl PythonBrakes {
    fn new(apply: Py<PyAny>) -> PythonBrakes {
        PythonBrakes { apply: Arc::new(apply), calls: watch::Sender::default() }
    }

    /// Calls the function; returns its result, and whether an earlier call may have undone it, or prevented it.
    async fn call(&self, state: u64, word: &'static str, reason: String) -> (Result<(), String>, bool) {
        let (apply, call) = (Arc::clone(&self.apply), BrakeCall::begin(&self.calls, state));
        let overlaps = call.overlaps;
        let called = move || {
            Python::attach(|py| {
                if call.is_superseded() {
                    return Err("a newer state came before they were asked".to_owned());
                }
                let failed = |error: PyErr| {
                    error.display(py);
                    format!("the brakes raised {error}")
                };
                apply.call1(py, (word, reason)).map(drop).map_err(failed)
            })
        };
        (tokio::task::spawn_blocking(called).await.unwrap_or_else(|error| Err(line(&error))), overlaps)
    }
}

#[async_trait]
impl Brakes for PythonBrakes {
    async fn apply(&self, state: &SafetyState) -> Result<(), String> {
        let (word, reason) = match state {
            SafetyState::Ready => ("ready", String::new()),
            SafetyState::Held { reason } => ("held", reason.clone()),
            SafetyState::Stopped { reason } => ("stopped", reason.clone()),
        };
        let mut asked = 0;
        self.calls.send_modify(|calls| {
            calls.newest += 1;
            asked = calls.newest;
        });
        loop {
            let (result, overlaps) = self.call(asked, word, reason.clone()).await;
            if !overlaps {
                return result;
            }
            // The sender is in `self`.
            let _ = self.calls.subscribe().wait_for(|calls| calls.under_way.is_empty()).await;
        }
    }
}

struct PythonAction {
    suspends: bool,
    name: String,
    description: String,
    signature: Signature,
    function: Arc<Function>,
    threads: Threads,
}

/// The Python function that performs the goals.
struct Function {
    perform: Py<PyAny>,
    /// Inputs that it takes as arrays.
    arrays: HashSet<String>,
}

impl PythonAction {
    fn of(py: Python<'_>, described: Described, kind: &str, threads: &Threads) -> PyResult<PythonAction> {
        let Described { name, description, inputs, outputs, outcomes, arrays, perform, .. } = described;
        let of_type = |port: &str, text: String| {
            let read = Type::try_from(text);
            read.map_err(|error| PyValueError::new_err(format!("port `{port}` of `{name}`: {error}")))
        };
        let mut signature = Signature::new();
        for (port, text, is_required, default) in inputs {
            let of = of_type(&port, text)?;
            let default = default.into_bound(py);
            signature = match (is_required, default.is_none()) {
                (true, _) => signature.input(&port, of),
                (false, true) => signature.optional(&port, of),
                (false, false) => signature.with_default(&port, of, from_python(&default)?),
            };
        }
        for (port, text) in outputs {
            signature = signature.output(&port, of_type(&port, text)?);
        }
        signature = outcomes.iter().fold(signature, |signature, outcome| signature.outcome(outcome));
        if described.computes {
            signature = signature.computes();
        }
        signature = match &described.reads {
            Some(none) if none.is_empty() => signature.reads_nothing(),
            read => read.iter().flatten().fold(signature, |signature, pattern| signature.reads(pattern)),
        };
        signature = described.senses.iter().fold(signature, |signature, pattern| signature.senses(pattern));
        signature = described.requires.iter().fold(signature, |signature, condition| signature.requires(condition));
        signature = match &described.effects {
            Some(none) if none.is_empty() && !described.computes => signature.changes_nothing(),
            changed => changed.iter().flatten().fold(signature, |signature, effect| signature.effect(effect)),
        };
        if !described.blocks.is_empty() {
            let own = (!described.blocks.iter().any(|blocked| blocked == kind)).then_some(kind);
            let blocked = own.into_iter().chain(described.blocks.iter().map(String::as_str));
            signature = blocked.fold(signature, Signature::blocks);
        }
        if let Some(takes) = &described.takes {
            signature = signature.takes(takes);
        }
        if described.anytime {
            signature = signature.anytime();
        }
        let (suspends, threads) = (described.suspends, threads.clone());
        let function = Arc::new(Function { perform, arrays });
        Ok(PythonAction { suspends, name, description, signature, function, threads })
    }
}

#[async_trait]
impl Action for PythonAction {
    fn name(&self) -> &str {
        &self.name
    }

    fn description(&self) -> &str {
        &self.description
    }

    fn signature(&self) -> Option<Signature> {
        Some(self.signature.clone())
    }

    fn can_be_suspended(&self) -> bool {
        self.suspends
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        let mut goal = goal;
        // From here on, Python owns their memory.
        let inputs = std::mem::take(&mut goal.inputs);
        let (goal, function, runtime) = (Arc::new(goal), Arc::clone(&self.function), Handle::current());
        let performed = self.threads.run(move |py| perform(py, &goal, inputs, &function, runtime));
        let performed = performed.map_err(|error| ActionFailure::Aborted(format!("no thread for it: {error}")))?;
        performed.await.unwrap_or_else(|_| Err(ActionFailure::Aborted("its thread has panicked".to_owned())))
    }
}

fn perform(
    py: Python<'_>,
    context: &Arc<GoalContext>,
    inputs: BTreeMap<String, Value>,
    function: &Function,
    runtime: Handle,
) -> ActionResult {
    let given = || -> PyResult<GoalOutcome> {
        let goal = Bound::new(py, Goal::new(Arc::clone(context), runtime))?;
        let inputs = inputs_to_python(py, inputs, &function.arrays)?;
        let ended = function.perform.bind(py).call1((&goal, inputs));
        goal.get().is_over(py);
        let (outcome, outputs, reason): (String, Bound<'_, PyDict>, String) = ended?.extract()?;
        let (outputs, reason) = (fields_from_python(&outputs)?, shortened(reason));
        Ok(goal.get().with_measured(GoalOutcome { outputs, reason, ..GoalOutcome::named(&outcome) }))
    };
    given().map_err(|error| failure(py, context, &error))
}

/// The failure of a goal by its exception. An unexpected exception is logged by the worker, and is the goal's reason, with its traceback.
fn failure(py: Python<'_>, context: &GoalContext, error: &PyErr) -> ActionFailure {
    let message = || error.value(py).to_string();
    if error.is_instance_of::<Cancelled>(py) {
        if context.cancelled.is_cancelled() {
            return context.stopped();
        }
        // The goal waited for a goal of another provider that was told to stop.
        if let Some(failure) = crate::error::stopped_elsewhere(error.value(py), message()) {
            return failure;
        }
    }
    if error.is_instance_of::<Lost>(py) {
        return ActionFailure::Lost(shortened(message()));
    }
    if error.is_instance_of::<Aborted>(py) {
        return ActionFailure::Aborted(shortened(message()));
    }
    let traceback = error.traceback(py).and_then(|traceback| traceback.format().ok()).unwrap_or_default();
    // Not `print`, which would end the process for a `SystemExit`.
    error.display(py);
    ActionFailure::Aborted(shortened(format!("{error}\n{traceback}")))
}

/// Omits the middle of a text that is too long.
fn shortened(text: String) -> String {
    if text.len() <= MAX_TRACEBACK_BYTES {
        return text.trim_end().to_owned();
    }
    let half = MAX_TRACEBACK_BYTES / 2;
    let head = text.floor_char_boundary(half);
    let tail = text.ceil_char_boundary(text.len() - half);
    format!("{}\n…\n{}", &text[..head], text[tail..].trim_end())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_traceback_keeps_its_head_and_its_end() {
        let long = format!("ValueError: é\n{}\nlast line", "ä".repeat(MAX_TRACEBACK_BYTES));
        let short = shortened(long);
        assert!(
            short.len() < MAX_TRACEBACK_BYTES + 16
                && short.starts_with("ValueError: é")
                && short.ends_with("last line")
        );
        assert_eq!(shortened("short\n".to_owned()), "short");
    }
}
