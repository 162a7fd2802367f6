//! A client of a running system: its resources and its world. Sessions are kept alive in a thread of their own, whatever Python does.

use crate::error::{Error, Unavailable, line, of_call};
use crate::patience::patience;
use crate::process::Process;
use crate::value::{Fact, from_python};
use pyo3::exceptions::{PyKeyboardInterrupt, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use ratn_model::fact::{Change, FactPattern, Footprint};
use ratn_model::id::ProjectionId;
use ratn_model::resource::{Requirement, ResourceOperation};
use ratn_proto::types::WorldUpdate;
use ratn_worker::client::{
    AcquireOptions, CallError, Channels, Projection, ResourceClient, WorldClient, fact, fresh_id, pattern,
};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::session::{DEFAULT_TTL, Session, SessionError};
use ratn_worker::tls::ClientTls;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::runtime::{Builder, Runtime};
use tokio::sync::{Mutex as AsyncMutex, mpsc};

/// Time limit for opening a session.
const SESSION_PATIENCE: Duration = Duration::from_secs(5);
/// Interval of checks for a Python signal (Ctrl-C) during a wait.
const SIGNALS: Duration = Duration::from_millis(100);
/// The kind of resource that is the room for a projection.
const WORLD_MODEL: &str = "WorldModel";
/// The time limit sent to the resource manager if the caller gives none: about thirty years.
const FOR_EVER: Duration = Duration::from_secs(1_000_000_000);
/// Maximum number of revisions buffered for Python; further ones wait in the world pool.
const MAX_UPDATES: usize = 64;

/// A client of the system whose endpoint files are in a directory.
#[pyclass(frozen, module = "ratn")]
pub(crate) struct Client {
    runtime: Arc<OwnRuntime>,
    channels: Channels,
    resource_manager: Endpoint,
    world: WorldClient,
    /// Waited for only without Python's lock, because its holder may wait for Python's lock.
    session: AsyncMutex<Option<Arc<Held>>>,
    is_closed: AtomicBool,
}

/// A tokio runtime, usable only in the process that made it.
struct OwnRuntime {
    /// `None` only while this is dropped.
    runtime: Option<Runtime>,
    process: Process,
}

impl OwnRuntime {
    fn new(runtime: Runtime) -> OwnRuntime {
        OwnRuntime { runtime: Some(runtime), process: Process::of_runtime() }
    }

    fn here(&self) -> PyResult<&Runtime> {
        self.process.check("this system", "open it here, `ratn.System(runtime_dir=system.runtime_dir)`")?;
        self.runtime.as_ref().ok_or_else(|| Error::new_err("this system has ended"))
    }
}

impl Drop for OwnRuntime {
    fn drop(&mut self) {
        if !self.process.is_here() {
            // In a fork, dropping it would wait for threads that do not exist there.
            std::mem::forget(self.runtime.take());
        }
    }
}

/// A session, and the client in its name.
struct Held {
    session: Session,
    client: ResourceClient,
}

/// Why there is no session.
enum NoSession {
    Silent(SessionError),
    Refused(CallError),
}

impl Client {
    /// The runtime, unless the client is closed.
    fn open(&self) -> PyResult<&OwnRuntime> {
        match self.is_closed.load(Ordering::Relaxed) {
            true => Err(Error::new_err("this system is closed: open one with `ratn.System(…)`")),
            false => Ok(&self.runtime),
        }
    }

    /// The session of the process. The first caller opens it; other callers wait meanwhile.
    fn held(&self, py: Python<'_>) -> PyResult<Arc<Held>> {
        let opened = async {
            let mut kept = self.session.lock().await;
            // A session whose id belongs to another caller will never be alive again.
            if let Some(held) = kept.as_ref().filter(|held| !held.session.state().borrow().taken) {
                return Ok(Arc::clone(held));
            }
            let session = Session::open(&self.channels, &self.resource_manager, "python", DEFAULT_TTL);
            session.alive(SESSION_PATIENCE).await.map_err(NoSession::Silent)?;
            let client = ResourceClient::new(&self.channels, &self.resource_manager, session.id());
            let client = client.map_err(NoSession::Refused)?;
            Ok(Arc::clone(kept.insert(Arc::new(Held { session, client }))))
        };
        wait(py, self.open()?, opened)?.map_err(|error| match error {
            NoSession::Silent(error) => Unavailable::new_err(line(&error)),
            NoSession::Refused(error) => of_call(&error),
        })
    }
}

/// Waits without Python's lock, and reacts to Ctrl-C meanwhile.
fn wait_for<T: Send>(
    py: Python<'_>,
    runtime: &OwnRuntime,
    work: impl Future<Output = Result<T, CallError>> + Send,
) -> PyResult<T> {
    wait(py, runtime, work)?.map_err(|error| of_call(&error))
}

/// As [`wait_for`], for any result.
fn wait<T: Send>(py: Python<'_>, runtime: &OwnRuntime, work: impl Future<Output = T> + Send) -> PyResult<T> {
    let runtime = runtime.here()?;
    // A future that is dropped may need the runtime.
    let _within = runtime.enter();
    let mut work = Box::pin(work);
    loop {
        let waited = py.detach(|| runtime.block_on(async { tokio::time::timeout(SIGNALS, &mut work).await }));
        match waited {
            Ok(ended) => return Ok(ended),
            Err(_) => py.check_signals()?,
        }
    }
}

/// Whether a `with` block ends by an exception.
fn has_raised(exception: &Bound<'_, PyTuple>) -> bool {
    exception.get_item(0).is_ok_and(|kind| !kind.is_none())
}

/// The end of a `with` block: an exception raised inside has priority.
fn left(released: PyResult<bool>, exception: &Bound<'_, PyTuple>) -> PyResult<bool> {
    match released {
        Err(error) if has_raised(exception) => beside(exception.py(), error).map(|()| false),
        released => released.map(|_| false),
    }
}

/// Reports an error that comes after a more important one as an unraisable exception. Ctrl-C is never reported this way.
fn beside(py: Python<'_>, error: PyErr) -> PyResult<()> {
    if error.is_instance_of::<PyKeyboardInterrupt>(py) {
        return Err(error);
    }
    error.write_unraisable(py, None);
    Ok(())
}

/// The change that sets a fact to a value; `None` deletes it.
fn change(fact_text: &str, value: &Bound<'_, PyAny>) -> PyResult<Change> {
    let key = fact(fact_text).map_err(PyValueError::new_err)?;
    Ok(match value.is_none() {
        true => Change::Delete { pattern: FactPattern::of(&key) },
        false => Change::Set { fact: key, value: from_python(value)? },
    })
}

fn patterns_of(texts: &[String]) -> PyResult<Vec<FactPattern>> {
    texts.iter().map(|text| pattern(text)).collect::<Result<Vec<_>, _>>().map_err(PyValueError::new_err)
}

#[pymethods]
impl Client {
    #[new]
    fn new(py: Python<'_>, directory: PathBuf) -> PyResult<Client> {
        let wrong = |error: &(dyn std::error::Error + 'static)| Error::new_err(line(error));
        let runtime =
            Builder::new_multi_thread().worker_threads(1).enable_all().build().map_err(|error| wrong(&error))?;
        let tls = ClientTls::from_environment().map_err(|error| wrong(&error))?;
        let directory = RuntimeDirectory::at(directory);
        let find = |role| directory.find(role).map_err(|error| Unavailable::new_err(line(&error)));
        let (resource_manager, world_pool) = (find("resource-manager")?, find("world-pool")?);
        let channels = Channels::new(&tls);
        let world = py.detach(|| runtime.block_on(async { WorldClient::new(&channels, &world_pool) }));
        let world = world.map_err(|error| of_call(&error))?;
        let runtime = Arc::new(OwnRuntime::new(runtime));
        let (session, is_closed) = (AsyncMutex::default(), AtomicBool::new(false));
        Ok(Client { runtime, channels, resource_manager, world, session, is_closed })
    }

    /// Raises `ratn.Error` if the client is closed.
    fn check_open(&self) -> PyResult<()> {
        self.open().map(drop)
    }

    /// Waits until one resource of each kind is free, and takes them under one lease.
    #[pyo3(signature = (kinds, *, priority=0, timeout_s=None, holder="python"))]
    fn acquire(
        &self,
        py: Python<'_>,
        kinds: Vec<String>,
        priority: i64,
        timeout_s: Option<f64>,
        holder: &str,
    ) -> PyResult<Lease> {
        let deadline = patience("timeout_s", timeout_s)?.unwrap_or(FOR_EVER);
        let held = self.held(py)?;
        let requirements = kinds.iter().map(|kind| Requirement::new(ResourceOperation::Block, kind)).collect();
        let options = AcquireOptions {
            request: fresh_id("python"),
            priority,
            deadline,
            holder: holder.to_owned(),
            ..AcquireOptions::default()
        };
        let granted = wait_for(py, self.open()?, held.client.acquire(requirements, options))?;
        let generation = held.session.state().borrow().generation;
        Ok(Lease { granted, held, generation, runtime: Arc::clone(&self.runtime) })
    }

    /// The resources, each as a dict; only these kinds, if any is given.
    #[pyo3(signature = (*kinds))]
    fn resources<'py>(&self, py: Python<'py>, kinds: Vec<String>) -> PyResult<Vec<Bound<'py, PyDict>>> {
        let client = {
            let _within = self.open()?.here()?.enter();
            ResourceClient::new(&self.channels, &self.resource_manager, "").map_err(|error| of_call(&error))?
        };
        let kinds: Vec<&str> = kinds.iter().map(String::as_str).collect();
        let found = wait_for(py, self.open()?, client.list(&kinds))?;
        let shown = found.iter().map(|resource| {
            let shown = PyDict::new(py);
            shown.set_item("id", &resource.id)?;
            shown.set_item("kind", &resource.kind)?;
            shown.set_item("class", resource.class.to_string())?;
            shown.set_item("host", &resource.host)?;
            shown.set_item("endpoint", resource.endpoint())?;
            shown.set_item("held", !resource.holdings.is_empty())?;
            Ok(shown)
        });
        shown.collect()
    }

    /// The facts of the root world that match any of the patterns; without patterns, all.
    #[pyo3(signature = (*patterns))]
    fn query(&self, py: Python<'_>, patterns: Vec<String>) -> PyResult<Vec<Fact>> {
        let patterns = patterns_of(&patterns)?;
        Ok(Fact::all(wait_for(py, self.open()?, self.world.root_at(None, &patterns))?.1))
    }

    /// Writes a fact to the root world; returns the resulting revision. `None` deletes the fact.
    fn set(&self, py: Python<'_>, fact_text: &str, value: &Bound<'_, PyAny>) -> PyResult<u64> {
        let (commit, change) = (fresh_id("python"), change(fact_text, value)?);
        Ok(wait_for(py, self.open()?, self.world.commit(&commit, vec![change], None))?.0)
    }

    /// A projection: the world as it is now with changes, a fact and its value each, of which nobody else sees anything. `None` deletes. It
    /// holds room for itself (a `WorldModel`), for which it waits, until the end of the `with` block or `release()`.
    #[pyo3(signature = (changes, *, timeout_s=None))]
    fn project(
        &self,
        py: Python<'_>,
        changes: Vec<(String, Bound<'_, PyAny>)>,
        timeout_s: Option<f64>,
    ) -> PyResult<Projected> {
        let changes = changes.iter().map(|(text, value)| change(text, value)).collect::<PyResult<Vec<_>>>()?;
        let lease = self.acquire(py, vec![WORLD_MODEL.to_owned()], 0, timeout_s, "python")?;
        let made = || {
            // A pattern that matches nothing, because only the revision is needed.
            let nothing = [FactPattern { predicate: "ratn_nothing".to_owned(), arguments: Vec::new() }];
            let base = wait_for(py, self.open()?, self.world.root_at(None, &nothing))?.0;
            let projection = Projection {
                request: fresh_id("python"),
                base,
                changes,
                writers: Vec::new(),
                reads: Footprint::Everything,
                lease: Some((lease.granted.id, lease.granted.token)),
            };
            Ok((base, wait_for(py, self.open()?, self.world.project(projection))?))
        };
        match made() {
            Ok((base, id)) => Ok(Projected { base: base.0, id, lease, world: self.world.clone() }),
            Err(error) => {
                // The first error is the one to report; otherwise the lease ends with the session.
                lease.release(py, true).map(drop).or_else(|lost| beside(py, lost))?;
                Err(error)
            }
        }
    }

    /// What holds now, then what changes, of the patterns; of everything without one.
    #[pyo3(signature = (*patterns))]
    fn watch(&self, py: Python<'_>, patterns: Vec<String>) -> PyResult<WorldWatch> {
        let patterns = patterns_of(&patterns)?;
        let mut watch = wait_for(py, self.open()?, self.world.watch(None, &patterns))?;
        let (tell, updates) = mpsc::channel(MAX_UPDATES);
        self.open()?.here()?.spawn(async move {
            loop {
                let update = tokio::select! {
                    // Python does not iterate any more, and the next change may be far away.
                    () = tell.closed() => return,
                    update = watch.next() => update,
                };
                let Some(update) = update.transpose() else { return };
                if tell.send(update).await.is_err() {
                    return;
                }
            }
        });
        Ok(WorldWatch { runtime: Arc::clone(&self.runtime), updates: Mutex::new(updates) })
    }

    /// Ends the session, with all that it holds. A fork of the process that opened it ends nothing.
    fn close(&self, py: Python<'_>) {
        let Ok(runtime) = self.runtime.here() else { return };
        self.is_closed.store(true, Ordering::Relaxed);
        let closed = async {
            // If a lease is still in use, its last user ends the session.
            if let Some(held) = self.session.lock().await.take().and_then(Arc::into_inner) {
                held.session.close().await;
            }
        };
        py.detach(|| runtime.block_on(closed));
    }
}

/// Resources that are held until the end of the `with` block, or until `release()`.
#[pyclass(frozen, module = "ratn")]
pub(crate) struct Lease {
    granted: ratn_model::resource::Lease,
    held: Arc<Held>,
    /// The generation of the session: a restarted manager makes a new session under the same id.
    generation: u64,
    runtime: Arc<OwnRuntime>,
}

#[pymethods]
impl Lease {
    #[getter]
    fn id(&self) -> u64 {
        self.granted.id.0
    }

    /// The fencing token, which grows over all leases: a provider refuses tokens that are older than one it has seen.
    #[getter]
    fn token(&self) -> u64 {
        self.granted.token.0
    }

    /// Id, kind and endpoint of each resource.
    #[getter]
    fn resources(&self) -> Vec<(String, String, String)> {
        let each = self.granted.resources.iter();
        each.map(|held| (held.id.clone(), held.kind.clone(), held.endpoint.clone())).collect()
    }

    /// Whether the session that holds the lease is alive, as far as is known here. A session that the manager has opened again holds nothing from before.
    #[getter]
    fn alive(&self) -> bool {
        let state = *self.held.session.state().borrow();
        state.alive && state.generation == self.generation
    }

    /// Releases the resources; false if the lease had ended before. Unless they are known to be `at_rest`, what moves is granted again when its driver
    /// has confirmed standstill, or when its `standstill_ms` has passed; so it is where an exception ends the `with` block.
    #[pyo3(signature = (*, at_rest = true))]
    fn release(&self, py: Python<'_>, at_rest: bool) -> PyResult<bool> {
        let released = self.held.client.release_with_note(self.granted.id, String::new(), at_rest);
        wait_for(py, &self.runtime, released)
    }

    fn __enter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, py: Python<'_>, _exception: &Bound<'_, PyTuple>) -> PyResult<bool> {
        left(self.release(py, !has_raised(_exception)), _exception)
    }

    fn __repr__(&self) -> String {
        let ids: Vec<&str> = self.granted.resources.iter().map(|held| held.id.as_str()).collect();
        format!("<Lease {} of {}>", self.granted.id.0, ids.join(", "))
    }
}

/// A projection: a hypothetical world, made of a revision with changes. Nobody else sees it.
#[pyclass(frozen, module = "ratn")]
pub(crate) struct Projected {
    base: u64,
    id: ProjectionId,
    lease: Lease,
    world: WorldClient,
}

#[pymethods]
impl Projected {
    /// The revision of the world that it is based on.
    #[getter]
    fn base(&self) -> u64 {
        self.base
    }

    /// The facts of the projection that match any of the patterns; all facts if no pattern is given.
    #[pyo3(signature = (*patterns))]
    fn query(&self, py: Python<'_>, patterns: Vec<String>) -> PyResult<Vec<Fact>> {
        let patterns = patterns_of(&patterns)?;
        Ok(Fact::all(wait_for(py, &self.lease.runtime, self.world.query(Some(self.id), &patterns))?))
    }

    /// Ends the projection and releases its resource; false if it had ended before.
    fn release(&self, py: Python<'_>) -> PyResult<bool> {
        let released = wait_for(py, &self.lease.runtime, self.world.release(self.id));
        self.lease.release(py, true)?;
        released
    }

    fn __enter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, py: Python<'_>, _exception: &Bound<'_, PyTuple>) -> PyResult<bool> {
        left(self.release(py), _exception)
    }

    fn __repr__(&self) -> String {
        format!("<Projection {} on revision {}>", self.id.0, self.base)
    }
}

/// The present facts, then each revision of the root world, as dicts with `revision`, `written` (facts) and `gone` (strings).
#[pyclass(frozen, module = "ratn")]
pub(crate) struct WorldWatch {
    runtime: Arc<OwnRuntime>,
    updates: Mutex<mpsc::Receiver<Result<WorldUpdate, CallError>>>,
}

#[pymethods]
impl WorldWatch {
    fn __iter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    fn __next__<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyDict>>> {
        let runtime = self.runtime.here()?;
        let next = || {
            let mut updates = self.updates.lock().unwrap_or_else(PoisonError::into_inner);
            runtime.block_on(async { tokio::time::timeout(SIGNALS, updates.recv()).await })
        };
        let update = loop {
            match py.detach(next) {
                Ok(update) => break update,
                Err(_) => py.check_signals()?,
            }
        };
        let Some(update) = update.transpose().map_err(|error| of_call(&error))? else { return Ok(None) };
        let (revision, written, gone) = match update {
            WorldUpdate::Snapshot { revision, facts } => (revision, facts, Vec::new()),
            WorldUpdate::Changed(change) => (change.revision, change.written, change.gone),
        };
        let shown = PyDict::new(py);
        shown.set_item("revision", revision.0)?;
        shown.set_item("written", Fact::all(written))?;
        shown.set_item("gone", gone.iter().map(ToString::to_string).collect::<Vec<_>>())?;
        Ok(Some(shown))
    }
}
