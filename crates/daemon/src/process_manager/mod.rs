//! The process manager of one host (the paper's process pools, Section V-C): starts worker processes from the templates
//! of its config, offers each to the resource manager once it serves, and replaces those that die.
//!
//! ```text
//!   gRPC call ──▶ service.rs ──message──▶ actor.rs ──command──▶ spawner.rs (one thread) ──▶ worker processes
//!                                          │ ▲ pools/ (what there should be)                  │ exit, health
//!                  resource manager ◀──link┘ └─────────────────────────────────────────────────┘
//! ```
//! It does not know what the workers do or which tasks use them.

mod account;
mod actor;
mod comparison;
mod config;
mod drained;
mod environment;
mod limits;
mod log;
pub mod log_file;
mod log_stream;
mod machine;
mod offered;
mod open_files;
mod order;
mod parameter;
pub mod pools;
mod predecessor;
mod processes;
mod python;
mod readiness;
mod roster;
mod service;
mod session_file;
mod spawner;
mod status;
mod template;
pub mod tracking;
mod usage;
mod withheld;

pub use config::{Label, Labels, ProcessManagerConfig};
pub use limits::{GroupsV1, Limits};
pub use machine::{MachineConfig, Sample};
pub use parameter::Parameter;
pub use readiness::Readiness;
pub use roster::RosterError;
pub use template::{Liveness, Needs, Template};
pub use tracking::Tracking;

use crate::demand::{DemandLink, Shortages, Uses, WantedLink};
use crate::link::{LINK, LastingSession, Link, Manager, OfferLifecycle, Wanted};
use anyhow::Context;
use machine::Machine;
use processes::ManagerContact;
use ratn_proto::v1::process_service_server::ProcessServiceServer;
use ratn_worker::panic::exit_on_panic;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::server::{Services, Serving, bind_as};
use ratn_worker::tls::ClientTls;
use roster::Roster;
use session_file::SessionFile;
use std::collections::BTreeSet;
use std::time::Duration;
use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;
use tracking::Tracker;

/// The name of the role: in its endpoint file, its command and its section of a config.
pub const ROLE: &str = "process-manager";
/// Reports of the link that wait for the actor.
const OFFER_EVENTS: usize = 1_024;
/// A child that was being started when the last process manager was killed holds the lock until its program begins.
const TAKE_PATIENCE: Duration = Duration::from_millis(500);
/// Capacity for demand that the actor has not received yet.
const DEMANDS: usize = 16;

pub use ratn_proto::types::HOST_KIND;

/// Serves until `shutdown` is cancelled, and returns once every worker is gone.
///
/// # Errors
/// Where it cannot listen, publish its endpoint or start its thread, or where serving fails.
pub async fn run(
    config: ProcessManagerConfig,
    directory: RuntimeDirectory,
    shutdown: CancellationToken,
) -> anyhow::Result<()> {
    run_as(config, directory, Serving::default(), ClientTls::none(), shutdown).await
}

/// As [`run`], served in the way that its host wants; `tls` is what it trusts and shows as a client.
///
/// # Errors
/// As [`run`].
pub async fn run_as(
    config: ProcessManagerConfig,
    directory: RuntimeDirectory,
    serving: Serving,
    tls: ClientTls,
    shutdown: CancellationToken,
) -> anyhow::Result<()> {
    if let Err(error) = open_files::raise() {
        tracing::warn!(%error, "the limit of open files stays as it is");
    }
    for obstacle in config.obstacles() {
        tracing::warn!("{obstacle}: its workers cannot be started");
    }
    let (mut roster, left) = Roster::take_within(&directory, TAKE_PATIENCE).await?;
    let tracker = Tracker::start(&config, &directory).context("cannot keep track of workers")?;
    let bound = bind_as(&directory.listen(&config.listen, ROLE)?, &serving.exposure).await?;
    let endpoint = bound.endpoint().clone();
    // Done before anything is offered: offers of the last process manager that are not wanted any more are withdrawn.
    let starting = left.starting.iter().map(|intent| &intent.id);
    let before: Vec<String> = left.workers.iter().map(|entry| &entry.id).chain(starting).cloned().collect();
    let mut motions = left.motions.clone();
    let session_file = SessionFile::of(&directory);
    let session = session_file.id().context("cannot keep the session's name")?;
    let told = ManagerContact { manager: processes::manager_of(&config, &directory), session: session.clone() };
    let adopted = predecessor::settle(left, (&config.host, &config.templates), &told, &directory, &tracker).await;
    roster.keep_only(&adopted.iter().map(|one| one.entry.id.as_str()).collect());
    // For a template with an adopted worker, the link waits instead where that worker was not offered before.
    motions.retain(|name, _| adopted.iter().all(|one| one.entry.template.name != *name));
    let (wanted, to_offer) = watch::channel(Wanted::new());
    let workers = adopted.iter().map(|one| {
        offered::worker(&config.host, &config.labels, &one.status(), &one.entry.template.kind, one.standstill)
    });
    let host = offered::host(&config, &endpoint);
    let offered = workers.chain([host.clone()]);
    wanted.send_modify(|wanted| wanted.extend(offered.map(|resource| (resource.id.clone(), resource))));
    let (report, offer_events) = mpsc::channel(OFFER_EVENTS);
    let (drains, draining) = watch::channel(BTreeSet::new());
    let (used, uses) = mpsc::channel(OFFER_EVENTS);
    let (heard, demand) = mpsc::channel(DEMANDS);
    let (short, shortages) = watch::channel(Shortages::new());
    let (renewals, renewed) = mpsc::channel(1);
    let link = Link {
        manager: Manager {
            configured: config.resource_manager.clone(),
            directory: directory.clone(),
            tls: tls.clone(),
        },
        client: format!("{ROLE}@{}", config.host),
        session: Some(LastingSession { id: session, renewals }),
        ttl: Duration::from_millis(config.session_ttl_ms),
        wanted: to_offer,
        lifecycle: Some(OfferLifecycle { events: report, draining }),
        demand: Some(DemandLink {
            wanted: WantedLink {
                kinds: config.kinds(),
                attributes: offered::attributes(&config.host, &config.labels),
                heard,
                shortages,
            },
            used,
            uses: Uses::default(),
        }),
    };
    let linked = tokio::spawn(exit_on_panic(LINK, link.keep(shutdown.clone())));
    let machine = Machine { config: config.machine.clone(), labels: config.labels.clone(), host };
    let (look, looks) = mpsc::channel(1);
    let watching = machine.watch(directory.clone(), wanted.clone(), look);
    let watching = AbortOnDropHandle::new(tokio::spawn(exit_on_panic("the watch of the machine", watching)));
    let parts = actor::Parts {
        config,
        directory: directory.clone(),
        tls,
        told,
        roster,
        tracker,
        sockets: serving.exposure.socket.clone(),
        before,
        adopted,
        motions,
        wanted,
        drains,
        offer_events,
        uses,
        demand,
        short,
        looks,
        session_file,
        renewals: renewed,
    };
    let (actor, ended) =
        actor::start(parts, serving.vitals.clone(), shutdown.clone()).context("cannot start workers")?;
    let service = ProcessServiceServer::new(service::Service::new(actor, directory.clone(), shutdown.clone()));
    let published = directory.publish(ROLE, &endpoint).context("cannot publish the endpoint")?;
    tracing::info!(%endpoint, "{ROLE} is ready");
    let served = bound.serve_as(Services::new().with(service), serving, shutdown.clone()).await;
    drop((published, watching));
    shutdown.cancel();
    let _ = tokio::join!(linked, ended);
    Ok(served?)
}
