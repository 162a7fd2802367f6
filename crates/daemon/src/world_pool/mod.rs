//! The world pool: holds the root world model and its projections (the paper's Section V-A), and offers the room for
//! projections to the resource manager as a world resource.
//!
//! ```text
//!   gRPC call ──▶ service.rs ──message──▶ actor.rs (core.rs) ◀──leases that live── leases.rs ◀──watch── resource manager
//!   core.rs (history.rs) ──commits──▶ journal (ratn-storage) ──durable──▶ outbox ──▶ answers and updates of watches
//! ```
//! After a restart the root, its revisions and the commit ids are as they were when the last answer was sent; projections have ended.
//! Which effects are projected, and when they become real, is task control's business.

mod actor;
mod config;
mod core;
mod expiry;
mod fingerprint;
mod history;
mod in_memory;
mod leases;
mod looks;
mod memory;
mod parked;
mod promised;
mod query;
mod record;
mod scenes;
mod service;
mod size;
mod status;
mod stream;

pub use config::WorldPoolConfig;

use crate::config::Durability;
use crate::durable_actor::{Journal, JournalError, floor};
use crate::link::{LINK, Link, Manager};
use crate::metrics::Metrics;
use crate::standby::{self, Place};
use anyhow::Context;
use history::History;
use ratn_model::id::Revision;
use ratn_model::ontology::{Ontology, turtle};
use ratn_model::resource::ResourceClass;
use ratn_proto::types::Resource;
use ratn_proto::v1::world_pool_service_server::WorldPoolServiceServer;
use ratn_storage::Store;
use ratn_worker::panic::exit_on_panic;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::server::{Services, Serving};
use ratn_worker::tls::ClientTls;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

/// The name of the role: in its endpoint file, its command and its section of a config.
pub const ROLE: &str = "world-pool";

/// Serves until `shutdown` is cancelled.
///
/// # Errors
/// Where its state cannot be loaded, where it cannot listen or publish its endpoint, or where serving fails.
pub async fn run(
    config: WorldPoolConfig,
    directory: RuntimeDirectory,
    shutdown: CancellationToken,
) -> anyhow::Result<()> {
    run_as(config, directory, Serving::default(), Arc::new(Metrics::new(ROLE)), ClientTls::none(), shutdown).await
}

/// As [`run`], with `serving` and `metrics` of its host; `tls` is what the pool trusts and shows as a client.
///
/// # Errors
/// As [`run`].
pub async fn run_as(
    config: WorldPoolConfig,
    directory: RuntimeDirectory,
    serving: Serving,
    metrics: Arc<Metrics>,
    tls: ClientTls,
    shutdown: CancellationToken,
) -> anyhow::Result<()> {
    let ontology = config.ontology.as_deref().map(ontology).transpose()?;
    let kept_as = config.clone();
    let place = Place {
        role: ROLE,
        storage: &config.storage,
        listen: &config.listen,
        directory: &directory,
        serving: &serving,
    };
    let open = move |store| open(&kept_as, store);
    let Some(((history, journal), bound)) = place.take(open, &shutdown).await? else { return Ok(()) };
    let kept = (history, journal.counting(&metrics.journal));
    let endpoint = bound.endpoint().clone();
    let manager = Manager { configured: config.resource_manager.clone(), directory: directory.clone(), tls };
    let room = Resource::new(format!("world-model@{}", config.host), ResourceClass::World, &config.kind)
        .with_capacity(config.capacity)
        .on_host(&config.host);
    let (_wanted, wanted) = watch::channel([(room.id.clone(), room)].into());
    let link = Link {
        manager: manager.clone(),
        client: format!("{ROLE}@{}", config.host),
        session: None,
        ttl: Duration::from_millis(config.session_ttl_ms),
        wanted,
        lifecycle: None,
        demand: None,
    };
    // These parts run until the last call in progress has ended.
    let over = CancellationToken::new();
    let _over = over.clone().drop_guard();
    let linked = tokio::spawn(exit_on_panic(LINK, link.keep(over.clone())));
    let (live, leases) = watch::channel(leases::LiveLeases::default());
    let following = over.clone().run_until_cancelled_owned(leases::follow(manager, live));
    tokio::spawn(exit_on_panic("the watch of leases", following));
    let sizes = service::Sizes { fact: config.fact_bytes, commit: config.commit_bytes };
    let (actor, ended) = actor::start(config, ontology, kept, leases.clone(), serving.vitals.clone(), over.clone())?;
    let service = WorldPoolServiceServer::new(service::Service {
        actor,
        leases,
        shutdown: shutdown.clone(),
        sizes,
        long_reads: service::LongReads::default(),
        metrics,
    })
    .max_decoding_message_size(ratn_proto::MAX_MESSAGE_BYTES)
    .max_encoding_message_size(ratn_proto::MAX_MESSAGE_BYTES);
    let published = directory.publish(ROLE, &endpoint).context("cannot publish the endpoint")?;
    tracing::info!(%endpoint, "{ROLE} is ready");
    let served = standby::serve(bound, Services::new().with(service), serving, shutdown, &over).await;
    drop(published);
    // When this has ended, all pending records are on the disk.
    over.cancel();
    let _ = ended.await;
    let _ = linked.await;
    Ok(served?)
}

/// Becomes the one writer, and restores the history. Without durability, and where an older state was restored, clients may have heard
/// of revisions that are lost.
fn open(config: &WorldPoolConfig, store: Arc<dyn Store>) -> Result<(History, Journal), JournalError> {
    let restore = |recovered| History::restore(recovered, config);
    let (history, journal) = Journal::open(ROLE, &config.storage, store, restore)?;
    let may_have_lost = config.storage.durability == Durability::None && history.root().revision() > Revision(0);
    let floor = if may_have_lost || journal.is_restored() { floor() } else { 0 };
    Ok((history.with_revisions_above(Revision(floor)), journal))
}

fn ontology(file: &Path) -> anyhow::Result<Ontology> {
    let place = file.display();
    let text = ratn_regular_file::read_text(file, ratn_regular_file::USUAL)
        .with_context(|| format!("cannot read the ontology {place}"))?;
    let beside = |using: &str, path: &str| {
        let other = Path::new(using).parent().unwrap_or(Path::new("")).join(path);
        // The canonical name, so that a file that is imported twice is recognized.
        let other = other.canonicalize().map_err(|error| error.to_string())?;
        let text = ratn_regular_file::read_text(&other, ratn_regular_file::USUAL).map_err(|error| error.to_string())?;
        Ok((other.display().to_string(), text))
    };
    let name = file.canonicalize().unwrap_or_else(|_| file.to_owned());
    let read = turtle::imports::read_with(&name.display().to_string(), &text, &beside);
    Ok(read.with_context(|| format!("the ontology {place}"))?.0)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;
    use crate::config::StorageConfig;
    use crate::durable_actor::journal::PutInPlace;
    use history::Commit;
    use ratn_model::fact::{Change, FactKey};
    use ratn_model::value::Value;

    #[test]
    fn where_an_older_state_was_put_in_place_revisions_begin_above_all_of_before_and_stay_there() {
        let place = tempfile::tempdir().unwrap();
        let config = WorldPoolConfig::default();
        let log = || Journal::log(&config.storage, place.path());
        let fact = FactKey { predicate: "full".to_owned(), arguments: Vec::new() };
        let commit = |history: &mut History, id: &str| {
            let changes = vec![Change::Set { fact: fact.clone(), value: Value::Int(1) }];
            history.commit(&Commit { id: id.to_owned(), changes, ..Commit::default() }, None).unwrap()
        };
        let (mut history, mut journal) = open(&config, Arc::new(log())).unwrap();
        let told = commit(&mut history, "before");
        journal.write(&mut history).unwrap();
        drop(journal);
        let (mut history, mut journal) = open(&config, Arc::new(PutInPlace(log()))).unwrap();
        let first = history.root().revision();
        assert!(first.0 > told.0 + 1_000_000, "{first:?}");
        assert!(history.at(told).is_err());
        journal.write(&mut history).unwrap();
        drop(journal);
        assert_eq!(open(&config, Arc::new(log())).unwrap().0.root().revision(), first, "the next one knows");
    }

    #[test]
    fn without_durability_a_revision_never_comes_again_after_a_restart() {
        let place = tempfile::tempdir().unwrap();
        let fact = FactKey { predicate: "full".to_owned(), arguments: Vec::new() };
        for (durability, skips) in [(Durability::None, true), (Durability::Group, false)] {
            let storage = StorageConfig { durability, ..StorageConfig::default() };
            let config = WorldPoolConfig { storage, ..WorldPoolConfig::default() };
            let directory = place.path().join(durability.to_string());
            let start = || open(&config, Arc::new(Journal::log(&config.storage, &directory))).unwrap();
            let mut told = Revision(0);
            for round in 0..3 {
                let (mut history, mut journal) = start();
                let root = history.root().revision();
                assert_eq!(root > told, skips && round > 0, "{durability} {round}");
                assert_eq!(history.root().get(&fact), (round > 0).then_some(&Value::Int(round - 1)));
                if round > 0 {
                    assert_eq!(history.at(told).is_err(), skips);
                }
                let changes = vec![Change::Set { fact: fact.clone(), value: Value::Int(round) }];
                let commit = Commit { id: round.to_string(), changes, ..Commit::default() };
                told = history.commit(&commit, None).unwrap();
                assert_eq!(told.0, root.0 + 1);
                journal.write(&mut history).unwrap();
                drop(journal);
            }
        }
    }
}
