//! A worker process in one builder: what `ratn worker path-planner` and the like are.
//!
//! A pooled worker only serves: its process manager makes its resource once gRPC health says SERVING, and knows where it
//! is by the socket that it named (`listen unix:…`) or by the endpoint file that the worker writes. A worker that stands
//! alone is given the resource manager and offers its resource itself. Either performs goals only under leases of that very resource, which the
//! resource manager confirms; a pooled one is told in its environment where that is, and which session offers it ([`crate::pooled`]).

use crate::access::{AccessError, LiveAccess, RoleGate};
use crate::action::{Action, ActionServer, ActionServerBuilder};
use crate::arguments::{ArgumentError, Arguments};
use crate::client::{CallError, Channels, chain};
use crate::endpoint::Endpoint;
use crate::lease_watch::{LeaseWatch, RESOURCE_MANAGER_VARIABLE};
use crate::panic::exit_on_panic;
use crate::pooled::{PROVIDER_SESSION_VARIABLE, Pooled, PooledError};
use crate::provider::{Provider, standstill_bound};
use crate::runtime_directory::publish_file;
use crate::safety::Safety;
use crate::server::{BindError, Exposure, ServeError, Services, Serving, bind_as};
use crate::session::{DEFAULT_TTL, Session};
use crate::shutdown;
use crate::tls::{ClientTls, TlsError};
use crate::vitals::Vitals;
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

/// The pause before the brakes are asked again.
const BRAKES_AGAIN: Duration = Duration::from_secs(1);

/// The pause before a resource that was refused is offered again, in another session.
const OFFER_AGAIN: Duration = Duration::from_secs(1);

/// A part of the process, for its log.
const LEASES: &str = "the watch of leases";

/// What a worker is told by whoever starts it.
#[derive(Debug, Clone)]
pub struct WorkerOptions {
    /// Its resource's id: goals need a lease of it, which the resource manager confirms. Only a worker [`Worker::without_leases`] has none.
    pub id: String,
    /// Its resource's kind, `PathPlanner`.
    pub kind: String,
    /// Where it listens.
    pub listen: Endpoint,
    /// Where it writes its endpoint once it serves.
    pub endpoint_file: Option<PathBuf>,
    /// Ends when its standard input does.
    pub exit_with_parent: bool,
    /// Offers its resource there by itself. Not for pooled workers, which `RATN_RESOURCE_MANAGER` tells where to have leases confirmed.
    pub resource_manager: Option<Endpoint>,
    /// The host that it says it is on, when it offers its resource.
    pub host: String,
    /// What it may listen on.
    pub exposure: Exposure,
    /// The system's config, of whose `[service.access]` callers have their roles; that which the environment names unless given
    /// ([`crate::access::ACCESS_VARIABLE`]). Without any who runs the worker, and root, are operators, and others as by default.
    pub access: Option<PathBuf>,
    /// What it trusts and shows as a client, of the resource manager and of others; what the environment names unless given
    /// ([`ClientTls::from_environment`]).
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

/// A worker that failed to start or to go on.
#[derive(Debug, thiserror::Error)]
pub enum WorkerError {
    /// It cannot listen.
    #[error("the worker cannot start")]
    Bind(#[from] BindError),
    /// Nobody knows who may call it.
    #[error("the worker cannot start")]
    Access(#[from] AccessError),
    /// Its files of TLS as a client cannot be read.
    #[error("the worker cannot start")]
    Tls(#[from] TlsError),
    /// It cannot serve.
    #[error("the worker cannot serve")]
    Serve(#[from] ServeError),
    /// Nobody says where the resource manager is.
    #[error(
        "goals of worker `{id}` need a lease, and nobody says which resource manager confirms it: set {RESOURCE_MANAGER_VARIABLE} to its \
         endpoint, or to file:PATH where PATH holds that, or build the worker `without_leases()`"
    )]
    NoManager {
        /// The worker's resource.
        id: String,
    },
    /// It has no resource of which a lease could be asked, and nothing says that it needs none.
    #[error(
        "the worker has no id, so its goals would need no lease: give it the id of its resource (WorkerOptions::id), or build it \
         `without_leases()`, so that every caller with the role `task` has it perform goals"
    )]
    NoId,
    /// Whatever moves is moved under a lease.
    #[error(
        "the worker moves something (it has a Safety), and asks for no lease: give it the id of its resource (WorkerOptions::id)"
    )]
    MovesWithoutLease,
    /// Nobody says which session offers the worker's resource: anybody could offer a lookalike of the same id, and lease it.
    #[error(
        "goals of worker `{id}` need a lease, and nobody says which session offers its resource: set {PROVIDER_SESSION_VARIABLE} to that \
         session's id, as a process manager does for its workers, or have the worker offer its resource itself \
         (WorkerOptions::resource_manager)"
    )]
    NoProvider {
        /// The worker's resource.
        id: String,
    },
    /// It moves something, and its resource may be granted anew before that stands still.
    #[error(
        "worker `{id}` moves something (it has a Safety), stands still within {needed_ms} ms when a lease has ended, and is pooled without \
         that bound: say `standstill_ms = {needed_ms}`, or more, in its template"
    )]
    MovesInPool {
        /// The worker's resource.
        id: String,
        /// The least bound.
        needed_ms: u128,
    },
    /// What the process manager has told it is nonsense.
    #[error("the environment of the worker is not that of a pooled one")]
    Pooled(#[from] PooledError),
    /// What it says of itself is beyond the bounds of that.
    #[error("the worker's description")]
    Description(#[from] DescriptionError),
    /// The resource manager does not want it.
    #[error("the worker's resource is refused")]
    Resource(#[from] CallError),
    /// Something of the operating system failed.
    #[error("the worker cannot {what}")]
    System {
        /// What it wanted to do.
        what: String,
        /// Why it cannot.
        #[source]
        source: io::Error,
    },
}

/// A worker that does not run yet.
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
    /// A worker without actions that takes one goal at a time.
    pub fn new(options: WorkerOptions) -> Worker {
        let actions = ActionServer::builder(options.id.clone()).one_at_a_time();
        let shutdown = CancellationToken::new();
        let (resources, leases) = (BTreeSet::new(), Leases::Confirmed);
        Worker { options, actions, safety: None, standstill: None, resources, leases, shutdown }
    }

    /// One that is told all it has to know by the arguments of this process, as the process manager's template passes them
    /// ([`crate::arguments`]).
    ///
    /// # Errors
    /// [`ArgumentError`] names the argument.
    pub fn from_args() -> Result<Worker, ArgumentError> {
        Arguments::of_process()?.worker()
    }

    /// What tasks call it, `inspector` of `inspector/nearest`, and the kind of resource that it is. It says so, with what its actions say of
    /// their ports, when it is asked.
    #[must_use]
    pub fn provides(mut self, provider: &str, kind: &str) -> Worker {
        self.actions = self.actions.provides(provider, kind);
        if self.options.kind.is_empty() {
            kind.clone_into(&mut self.options.kind);
        }
        self
    }

    /// With an action. One that names a resource of its own needs leases of that.
    #[must_use]
    pub fn action(mut self, action: impl Action) -> Worker {
        self.resources.extend(action.resource().map(str::to_owned));
        self.actions = self.actions.action(action);
        self
    }

    /// With emergency stop and hold: a driver of something that moves.
    #[must_use]
    pub fn safety(mut self, safety: Safety) -> Worker {
        self.safety = Some(safety);
        self
    }

    /// The bound within which what it moves stands still when a lease has ended: the next lease of its resource is granted when the
    /// actions of that one's goals have returned, and at the latest after this. A worker with a
    /// [`Safety`] has [`standstill_bound`] unless given, one without has none: its resource is granted anew at once. A worker without
    /// [`crate::safety::Brakes`] that offers its resource itself waits this long before: a process before it may have begun a motion.
    /// A pooled worker with a [`Safety`] starts only where its template's `standstill_ms` is at least this; its next lease is granted after that.
    #[must_use]
    pub fn standstill(mut self, bound: Duration) -> Worker {
        self.standstill = Some(bound);
        self
    }

    /// **For tests only.** Believes whatever a goal says of its lease: whoever reaches the worker has it do what it does.
    #[must_use]
    pub fn dangerously_believe_every_lease(mut self) -> Worker {
        self.leases = Leases::Believed;
        self
    }

    /// It may have no id, and then asks for no lease: whoever may call it has it perform goals. For what only computes, and is no resource.
    #[must_use]
    pub fn without_leases(mut self) -> Worker {
        self.leases = Leases::NotAsked;
        self
    }

    /// Ends when `shutdown` is cancelled, too.
    #[must_use]
    pub fn shutdown(mut self, shutdown: CancellationToken) -> Worker {
        self.shutdown = shutdown;
        self
    }

    /// [`Worker::run`] on a runtime of its own: all that `main` has to do. What went wrong is written to standard error.
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

    /// Serves until a signal, the parent's end or the shutdown token says otherwise. Goals under way are told to stop. A panic of the SDK itself
    /// ends the process ([`crate::panic`]); a panic of an action aborts its goal.
    ///
    /// # Errors
    /// [`WorkerError`].
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
        // A pooled worker is offered by its process manager.
        let _resting = options.resource_manager.is_some().then(|| {
            let resting = bring_to_rest(leases.clone(), safety.clone(), standstill);
            AbortOnDropHandle::new(tokio::spawn(exit_on_panic("what brings the worker to rest", resting)))
        });
        let server = actions.channels(channels.clone()).build();
        let access = match &options.access {
            Some(file) => LiveAccess::of_file(file)?,
            None => LiveAccess::from_environment()?,
        };
        let vitals = Vitals::default();
        let _hearing = confirms.then(|| serve_once_heard(&leases, &vitals));
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
        // Connections are accepted from the bind on: whoever reads the file is answered.
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
            // What was held of it is another's to give, or nobody's.
            leases.lost("the id of the worker's session is another caller's");
            drop(offered.take());
            let again = offer(&channels, manager, &options, &endpoint, &leases, standstill);
            match shutdown.run_until_cancelled(again).await {
                Some(Ok(next)) => offered = Some(next),
                Some(Err(error)) => tracing::warn!(id = %options.id, %error, "the worker's resource is refused"),
                None => break,
            }
        }
        shutdown.cancelled().await;
        drop(published);
        // What the goals move stays this worker's until nothing moves any more.
        let (served, stopped) =
            tokio::join!(serving, tokio::time::timeout(crate::server::DRAIN_DEADLINE, server.shut_down()));
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

/// What the process manager of a pooled worker says; `moves_within` is the bound for the standstill of one that moves something.
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

/// Nothing may move of what a process before this one began: its brakes say so. Without brakes the time has passed after which nothing moves.
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

/// Nobody is offered a worker that refuses every goal because it has never heard the resource manager.
fn serve_once_heard(leases: &LeaseWatch, vitals: &Vitals) -> AbortOnDropHandle<()> {
    vitals.unwell("the resource manager has not been heard yet: every goal is refused");
    let (mut heard, leases, vitals) = (leases.heard(), leases.clone(), vitals.clone());
    let hear = async move {
        // The sender is in the watch.
        while !leases.is_heard() && heard.changed().await.is_ok() {}
        vitals.well();
    };
    AbortOnDropHandle::new(tokio::spawn(exit_on_panic(LEASES, hear)))
}

/// What a worker offers by itself.
struct Offered {
    session: Session,
    provider: Provider,
    watching: AbortOnDropHandle<()>,
}

/// Returns when it is to be offered in a session of another id: that of its session is another caller's, or there is none.
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
