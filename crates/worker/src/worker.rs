//! A worker process in one builder. `ratn worker path-planner` and `ratn worker detector` are made with it.
//!
//! A **pooled** worker is started by a process manager and only serves. The process manager offers the worker's resource once gRPC health
//! says SERVING. It finds the worker by the socket that it named (`listen unix:…`) or by the endpoint file that the worker writes. A
//! worker that **stands alone** is told where the resource manager is, and offers its resource itself. Both perform a goal only under a
//! lease of their own resource, which the resource manager confirms. A pooled worker learns from its environment where the resource
//! manager is and which session offers the worker's resource ([`crate::pooled`]).

use crate::access::{AccessError, LiveAccess, RoleGate};
use crate::action::{Action, ActionServer, ActionServerBuilder};
use crate::arguments::{ArgumentError, Arguments};
use crate::client::{CallError, Channels, chain};
use crate::endpoint::Endpoint;
use crate::lease_watch::{LeaseWatch, RESOURCE_MANAGER_VARIABLE};
use crate::panic::exit_on_panic;
use crate::pooled::{PROVIDER_SESSION_VARIABLE, Pooled, PooledError, stuck_after};
use crate::provider::{Provider, standstill_bound};
use crate::runtime_directory::publish_file;
use crate::safety::Safety;
use crate::server::{BindError, Exposure, ServeError, Services, Serving, bind_as};
use crate::session::{DEFAULT_TTL, Session};
use crate::shutdown;
use crate::tls::{ClientTls, TlsError};
use crate::vitals::{EXIT_CODE_PANICKED, Vitals};
use ratn_model::catalogue::DescriptionError;
use ratn_model::resource::ResourceClass;
use ratn_proto::types::Resource;
use std::collections::BTreeSet;
use std::io::{self, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

/// Pause before the brakes are asked again.
const BRAKES_AGAIN: Duration = Duration::from_secs(1);

/// Pause before a refused resource is offered again, in another session.
const OFFER_AGAIN: Duration = Duration::from_secs(1);

/// The name of this part of the process in the log.
const LEASES: &str = "the watch of leases";

/// How a worker is started: the options that [`Worker::from_args`] reads from the command line.
#[derive(Debug, Clone)]
pub struct WorkerOptions {
    /// The id of the worker's resource. A goal needs a lease of this resource, which the resource manager confirms. It may be empty only for a
    /// worker [`Worker::without_leases`].
    pub id: String,
    /// The kind of the worker's resource, for example `PathPlanner`.
    pub kind: String,
    /// The address that the worker listens on; port 0 lets the system choose one.
    pub listen: Endpoint,
    /// The file into which the worker writes its endpoint once it serves.
    pub endpoint_file: Option<PathBuf>,
    /// The worker ends when its standard input is closed.
    pub exit_with_parent: bool,
    /// The resource manager at which the worker offers its resource itself. `None` for a pooled worker: `RATN_RESOURCE_MANAGER` tells that one
    /// where leases are confirmed.
    pub resource_manager: Option<Endpoint>,
    /// The name of the host that the resource is offered with.
    pub host: String,
    /// Which addresses the worker may listen on, and with which certificate.
    pub exposure: Exposure,
    /// The system's config, whose `[service.access]` gives callers their roles. Without it, the config that the environment names counts
    /// ([`crate::access::ACCESS_VARIABLE`]). Without either, root and the user who runs the worker are operators, and all others have the
    /// default roles.
    pub access: Option<PathBuf>,
    /// The authorities that the worker trusts as a client, and the certificate that it presents; by default
    /// [`ClientTls::from_environment`].
    pub tls: Option<ClientTls>,
}

impl Default for WorkerOptions {
    fn default() -> WorkerOptions {
        WorkerOptions {
            id: String::new(),
            kind: String::new(),
            listen: Endpoint::loopback(),
            endpoint_file: None,
            exit_with_parent: false,
            resource_manager: None,
            host: String::new(),
            exposure: Exposure::default(),
            access: None,
            tls: None,
        }
    }
}

/// Why a worker did not start, or ended.
#[derive(Debug, thiserror::Error)]
pub enum WorkerError {
    /// The worker cannot listen on its address.
    #[error("the worker cannot start")]
    Bind(#[from] BindError),
    /// The roles of callers cannot be read.
    #[error("the worker cannot start")]
    Access(#[from] AccessError),
    /// The TLS files that it uses as a client cannot be read.
    #[error("the worker cannot start")]
    Tls(#[from] TlsError),
    /// Serving failed.
    #[error("the worker cannot serve")]
    Serve(#[from] ServeError),
    /// The worker knows no resource manager.
    #[error(
        "goals of worker `{id}` need a lease, and nobody says which resource manager confirms it: set {RESOURCE_MANAGER_VARIABLE} to its \
         endpoint, or to file:PATH where PATH holds that, or build the worker `without_leases()`"
    )]
    NoManager {
        /// The worker's resource.
        id: String,
    },
    /// The worker has no id, hence no resource that could be leased, and is not [`Worker::without_leases`].
    #[error(
        "the worker has no id, so its goals would need no lease: give it the id of its resource (WorkerOptions::id), or build it \
         `without_leases()`, so that every caller with the role `task` has it perform goals"
    )]
    NoId,
    /// A worker that moves something cannot be [`Worker::without_leases`].
    #[error(
        "the worker moves something (it has a Safety), and asks for no lease: give it the id of its resource (WorkerOptions::id)"
    )]
    MovesWithoutLease,
    /// It is unknown which session offers the worker's resource. Without that, another client could offer a resource of the same id, and
    /// lease that.
    #[error(
        "goals of worker `{id}` need a lease, and nobody says which session offers its resource: set {PROVIDER_SESSION_VARIABLE} to that \
         session's id, as a process manager does for its workers, or have the worker offer its resource itself \
         (WorkerOptions::resource_manager)"
    )]
    NoProvider {
        /// The worker's resource.
        id: String,
    },
    /// The worker moves something, and its pool's `standstill_ms` is too short: the resource could be granted again before it stands still.
    #[error(
        "worker `{id}` moves something (it has a Safety), stands still within {needed_ms} ms when a lease has ended, and is pooled without \
         that bound: say `standstill_ms = {needed_ms}`, or more, in its template"
    )]
    MovesInPool {
        /// The worker's resource.
        id: String,
        /// The minimum bound in milliseconds.
        needed_ms: u128,
    },
    /// A variable that the worker's process manager sets has an invalid value.
    #[error("the environment of the worker is not that of a pooled one")]
    Pooled(#[from] PooledError),
    /// The descriptions of its actions exceed the limits.
    #[error("the worker's description")]
    Description(#[from] DescriptionError),
    /// The resource manager refuses its resource.
    #[error("the worker's resource is refused")]
    Resource(#[from] CallError),
    /// A call of the operating system failed.
    #[error("the worker cannot {what}")]
    System {
        /// What the worker was about to do.
        what: String,
        /// Why that failed.
        #[source]
        source: io::Error,
    },
}

/// A worker that is being put together and does not run yet.
///
/// ```no_run
/// # use ratn_worker::prelude::*;
/// # fn started() -> Result<std::process::ExitCode, ArgumentError> {
/// let worker = Worker::from_args()?.provides("inspector", "Inspector");
/// Ok(worker.start())
/// # }
/// ```
#[derive(Debug)]
pub struct Worker {
    options: WorkerOptions,
    actions: ActionServerBuilder,
    safety: Option<Safety>,
    standstill: Option<Duration>,
    /// The resources that actions name themselves.
    resources: BTreeSet<String>,
    leases: Leases,
    shutdown: CancellationToken,
}

/// Whether goals need leases.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Leases {
    Confirmed,
    Believed,
    NotAsked,
}

impl Worker {
    /// A worker without actions. It performs one goal at a time.
    pub fn new(options: WorkerOptions) -> Worker {
        let actions = ActionServer::builder(options.id.clone()).one_at_a_time();
        let shutdown = CancellationToken::new();
        let (resources, leases) = (BTreeSet::new(), Leases::Confirmed);
        Worker { options, actions, safety: None, standstill: None, resources, leases, shutdown }
    }

    /// A worker with the options that the arguments of this process give, as a template of the process manager passes them
    /// ([`crate::arguments`]).
    ///
    /// # Errors
    /// [`ArgumentError`], which names the argument.
    pub fn from_args() -> Result<Worker, ArgumentError> {
        Arguments::of_process()?.worker()
    }

    /// Sets the provider's name, `inspector` in the action `inspector/nearest` of a task, and the kind of the worker's resource. The worker
    /// describes itself with both, and with the signatures of its actions, when it is asked (`Describe`).
    #[must_use]
    pub fn provides(mut self, provider: &str, kind: &str) -> Worker {
        self.actions = self.actions.provides(provider, kind);
        if self.options.kind.is_empty() {
            kind.clone_into(&mut self.options.kind);
        }
        self
    }

    /// Adds an action. Where the action names resources of its own ([`Action::resource`], [`Action::resources`]), its goals need a lease of
    /// one of those.
    #[must_use]
    pub fn action(mut self, action: impl Action) -> Worker {
        self.resources.extend(action.resources().into_iter().map(str::to_owned));
        self.actions = self.actions.action(action);
        self
    }

    /// Adds emergency stop and hold: for a driver of hardware that moves.
    #[must_use]
    pub fn safety(mut self, safety: Safety) -> Worker {
        self.safety = Some(safety);
        self
    }

    /// Sets the time within which everything stands still after a lease has ended. The next lease of the resource is granted when the actions
    /// of the ended lease's goals have returned, and after this time at the latest.
    ///
    /// Without this call, a worker with a [`Safety`] has [`standstill_bound`], and one without has none: its resource is granted again at
    /// once. A worker without [`crate::safety::Brakes`] that offers its resource itself waits this long before the first offer, because an
    /// earlier process may have begun a motion. A pooled worker with a [`Safety`] starts only where the `standstill_ms` of its template is at
    /// least this long.
    #[must_use]
    pub fn standstill(mut self, bound: Duration) -> Worker {
        self.standstill = Some(bound);
        self
    }

    /// **For tests only.** Goals are performed without asking the resource manager for their lease: everybody who can reach the worker can
    /// give it goals.
    #[must_use]
    pub fn dangerously_believe_every_lease(mut self) -> Worker {
        self.leases = Leases::Believed;
        self
    }

    /// Allows the worker to have no id. It then asks for no lease: everybody who may call it can give it goals. For a service that only
    /// computes and is no resource.
    #[must_use]
    pub fn without_leases(mut self) -> Worker {
        self.leases = Leases::NotAsked;
        self
    }

    /// Ends the worker also when `shutdown` is cancelled.
    #[must_use]
    pub fn shutdown(mut self, shutdown: CancellationToken) -> Worker {
        self.shutdown = shutdown;
        self
    }

    /// Runs the worker ([`Worker::run`]) on a tokio runtime of its own, and returns the exit code for `main`. Errors are written to standard
    /// error.
    pub fn start(self) -> ExitCode {
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build();
        let ended = runtime.map_err(|source| WorkerError::System { what: "start its runtime".to_owned(), source });
        match ended.and_then(|runtime| runtime.block_on(self.run())) {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => {
                // The process manager keeps what is written there in the worker's log.
                let _ = writeln!(io::stderr(), "{}", chain(&error));
                ExitCode::FAILURE
            }
        }
    }

    /// Serves until SIGTERM or SIGINT, the end of the parent process, or the shutdown token. Goals under way are told to stop then. A panic of
    /// an action aborts its goal; a panic of the SDK itself ends the process ([`crate::panic`]).
    ///
    /// # Errors
    /// [`WorkerError`]: the worker did not start, or serving failed.
    pub async fn run(self) -> Result<(), WorkerError> {
        let Worker { options, mut actions, safety, standstill, mut resources, leases: asked, shutdown } = self;
        actions.check()?;
        let has_resource = !options.id.is_empty() || !resources.is_empty();
        match asked {
            _ if safety.is_some() && !has_resource => return Err(WorkerError::MovesWithoutLease),
            Leases::Confirmed if !has_resource => return Err(WorkerError::NoId),
            _ => {}
        }
        let standstill = standstill.or_else(|| safety.is_some().then(|| standstill_bound(DEFAULT_TTL)));
        let system = |what: &str| {
            let what = what.to_owned();
            move |source| WorkerError::System { what, source }
        };
        shutdown::on_signals(&shutdown).map_err(system("catch signals"))?;
        if options.exit_with_parent {
            shutdown::exit_with_parent(&shutdown).map_err(system("watch its parent"))?;
        }
        let channels = Channels::new(&match options.tls.clone() {
            Some(tls) => tls,
            None => ClientTls::from_environment()?,
        });
        resources.extend((!options.id.is_empty()).then(|| options.id.clone()));
        let leases = LeaseWatch::of(resources);
        let confirms = has_resource && asked != Leases::Believed;
        let pooled = match !confirms || options.resource_manager.is_some() {
            true => None,
            false => Some(pooled(&options.id, standstill.filter(|_| safety.is_some()))?),
        };
        // A worker that moves something is not given up: its goal may be what holds the load.
        let stuck_after = if safety.is_none() { stuck_after()? } else { None };
        if let Some(patience) = stuck_after {
            actions = actions.stuck_after(patience);
        }
        actions = match asked {
            Leases::Believed => actions.dangerously_believe_every_lease(),
            Leases::Confirmed | Leases::NotAsked => actions.leases(&leases),
        };
        let watching = pooled.map(|Pooled { manager, provider_session, .. }| {
            let (leases, channels) = (leases.clone(), channels.clone());
            let watch = async move { leases.follow_location(&channels, manager, &provider_session, DEFAULT_TTL).await };
            AbortOnDropHandle::new(tokio::spawn(exit_on_panic(LEASES, watch)))
        });
        if let Some(safety) = &safety {
            actions = actions.safety(safety.clone());
        }
        // The process manager offers a pooled worker when it serves, and waits before that until a killed predecessor stands still. The
        // worker's brakes know that earlier.
        let stands_alone = options.resource_manager.is_some();
        let rests = stands_alone || (confirms && safety.is_some());
        if rests {
            leases.begin_at_rest();
        }
        let _resting = rests.then(|| {
            let resting = bring_to_rest(leases.clone(), safety.clone(), standstill.filter(|_| stands_alone));
            AbortOnDropHandle::new(tokio::spawn(exit_on_panic("what brings the worker to rest", resting)))
        });
        let server = actions.channels(channels.clone()).build();
        let access = match &options.access {
            Some(file) => LiveAccess::of_file(file)?,
            None => LiveAccess::from_environment()?,
        };
        crate::otlp::start(options.access.as_deref(), &options.id);
        let vitals = Vitals::default();
        let _hearing = confirms.then(|| serve_once_heard(&leases, &vitals, rests && !stands_alone));
        let serving = Serving { gate: Arc::new(RoleGate::new(access)), vitals, ..Serving::default() };
        let bound = bind_as(&options.listen, &options.exposure).await?;
        let endpoint = bound.endpoint().clone();
        let mut services = Services::new().with(server.clone().into_service());
        if let Some(safety) = safety {
            services = services.with(safety.into_service());
        }
        let ends = shutdown.clone();
        let serve = async move {
            let served = bound.serve_as(services, serving, ends.clone()).await;
            ends.cancel();
            served
        };
        let serving = tokio::spawn(exit_on_panic("the server of the worker", serve));
        // Connections are accepted from the bind on: a client that reads the file gets answers.
        let published = match &options.endpoint_file {
            Some(file) => Some(
                publish_file(file, &endpoint).map_err(system(&format!("write its endpoint to {}", file.display())))?,
            ),
            None => None,
        };
        let mut offered = match &options.resource_manager {
            Some(manager) => Some(offer(&channels, manager, &options, &endpoint, &leases, standstill).await?),
            None => None,
        };
        tracing::info!(id = %options.id, %endpoint, "serving");

        while let Some(manager) = &options.resource_manager
            && shutdown.run_until_cancelled(taken(offered.as_ref())).await.is_some()
        {
            // The former leases of the resource have ended, or belong to another caller's session.
            leases.lost("the id of the worker's session is another caller's");
            drop(offered.take());
            let again = offer(&channels, manager, &options, &endpoint, &leases, standstill);
            match shutdown.run_until_cancelled(again).await {
                Some(Ok(next)) => offered = Some(next),
                Some(Err(error)) => tracing::warn!(id = %options.id, %error, "the worker's resource is refused"),
                None => break,
            }
        }
        tokio::select! {
            () = shutdown.cancelled() => {}
            why = server.stuck(), if stuck_after.is_some() => {
                tracing::error!(id = %options.id, "the worker ends itself, for another one to be started: {why}");
                // A stuck goal would keep the process alive that ends in order; for other goals the end is a crash in any case.
                std::process::exit(EXIT_CODE_PANICKED.into());
            }
        }
        drop(published);
        // The resources stay this worker's until nothing moves any more.
        let (served, stopped) =
            tokio::join!(serving, tokio::time::timeout(crate::server::DRAIN_DEADLINE, server.shut_down()));
        if let Some(sender) = ratn_otlp::sender() {
            sender.flush(ratn_otlp::END_OF_SERVER).await;
        }
        drop(watching);
        if let Some(Offered { session, provider, watching }) = offered {
            drop((provider, watching));
            match stopped {
                Ok(()) => session.close().await,
                Err(_) => {
                    tracing::error!(id = %options.id, "goals still run at the end: the session is left to run out by itself");
                    session.abandon().await;
                }
            }
        }
        match served {
            Ok(served) => Ok(served?),
            Err(error) => Err(WorkerError::System { what: "serve".to_owned(), source: io::Error::other(error) }),
        }
    }
}

/// The settings from the process manager of a pooled worker; `moves_within` is the bound for standstill of a worker that moves something.
fn pooled(id: &str, moves_within: Option<Duration>) -> Result<Pooled, WorkerError> {
    let id = id.to_owned();
    let Some(pooled) = Pooled::from_environment()? else { return Err(WorkerError::NoManager { id }) };
    if pooled.provider_session.is_empty() {
        return Err(WorkerError::NoProvider { id });
    }
    match moves_within {
        Some(needed) if !pooled.allows(needed) => Err(WorkerError::MovesInPool { id, needed_ms: needed.as_millis() }),
        _ => Ok(pooled),
    }
}

/// Makes sure that no motion of an earlier process goes on. Brakes confirm that; without brakes, the bound for standstill is waited for.
async fn bring_to_rest(leases: LeaseWatch, safety: Option<Safety>, standstill: Option<Duration>) {
    let mut has_brakes = false;
    if let Some(safety) = safety {
        has_brakes = loop {
            match safety.bring_to_rest().await {
                Ok(has_brakes) => break has_brakes,
                Err(error) => tracing::warn!(%error, "the worker is not at rest, and not offered"),
            }
            tokio::time::sleep(BRAKES_AGAIN).await;
        };
    }
    if let Some(bound) = standstill.filter(|_| !has_brakes) {
        tokio::time::sleep(bound).await;
    }
    leases.brought_to_rest();
}

/// Keeps health at NOT_SERVING until the resource manager has been heard and, if the worker `rests` first, its brakes have confirmed that
/// nothing moves: otherwise a worker would be offered that refuses every goal.
fn serve_once_heard(leases: &LeaseWatch, vitals: &Vitals, rests: bool) -> AbortOnDropHandle<()> {
    vitals.unwell("the resource manager has not been heard yet: every goal is refused");
    let (mut heard, leases, vitals) = (leases.heard(), leases.clone(), vitals.clone());
    let hear = async move {
        // The sender is in the watch.
        while !leases.is_heard() && heard.changed().await.is_ok() {}
        if rests {
            vitals.unwell("its brakes have not said yet that nothing moves: every goal is refused");
            // The process that starts the worker waits for a limited time, and refers to the log.
            tracing::info!("it is ready when its brakes have said that nothing moves, and have let go");
            leases.rested().await;
        }
        vitals.well();
    };
    AbortOnDropHandle::new(tokio::spawn(exit_on_panic(LEASES, hear)))
}

/// The resource that a worker offers by itself.
struct Offered {
    session: Session,
    provider: Provider,
    watching: AbortOnDropHandle<()>,
}

/// Returns when the resource has to be offered in a session of another id: its session's id belongs to another caller, or there is no
/// session.
async fn taken(offered: Option<&Offered>) {
    match offered {
        Some(offered) => offered.session.taken().await,
        None => tokio::time::sleep(OFFER_AGAIN).await,
    }
}

async fn offer(
    channels: &Channels,
    manager: &Endpoint,
    options: &WorkerOptions,
    endpoint: &Endpoint,
    leases: &LeaseWatch,
    standstill: Option<Duration>,
) -> Result<Offered, CallError> {
    let session = Session::open(channels, manager, &options.id, DEFAULT_TTL);
    let watch = leases.follow_session(channels, manager, &session, DEFAULT_TTL)?;
    let watching = AbortOnDropHandle::new(tokio::spawn(exit_on_panic(LEASES, watch)));
    let provider = Provider::start_at_rest(channels, manager, &session, leases)?;
    let mut resource = Resource::new(&options.id, ResourceClass::Process, &options.kind)
        .with_endpoint(endpoint)
        .on_host(&options.host);
    if let Some(bound) = standstill {
        resource = resource.with_standstill(bound);
    }
    provider.offer(resource).await?;
    Ok(Offered { session, provider, watching })
}
