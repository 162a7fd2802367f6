//! What the world pool keeps, and what it does when it cannot.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_daemon::config::{Durability, StorageConfig};
use ratn_daemon::world_pool::{self, WorldPoolConfig};
use ratn_model::fact::{Change, FactKey, Footprint, Term};
use ratn_model::id::{ProjectionId, Revision};
use ratn_model::value::Value;
use ratn_proto::types::FactRecord;
use ratn_worker::client::{CallError, Projection, WorldClient};
use std::path::Path;
use support::{SmallDisk, TestSystem, in_time};
use tonic::Code;

fn config(system: &TestSystem, directory: &Path, durability: Durability) -> WorldPoolConfig {
    let storage = StorageConfig { directory: Some(directory.to_owned()), durability, ..StorageConfig::default() };
    WorldPoolConfig { storage, ..system.world_pool_config() }
}

fn set(name: &str, value: impl Into<String>) -> Change {
    let fact = FactKey { predicate: "at".to_owned(), arguments: vec![Term::Name(name.to_owned())] };
    Change::Set { fact, value: Value::String(value.into()) }
}

fn projection(request: &str, base: u64) -> Projection {
    Projection {
        request: request.to_owned(),
        base: Revision(base),
        changes: vec![set("cup", "projected")],
        writers: Vec::new(),
        reads: Footprint::Everything,
        lease: None,
    }
}

/// A channel finds out first that the other end has changed.
async fn answered<T, F: Future<Output = Result<T, CallError>>>(ask: impl Fn() -> F) -> T {
    in_time(async {
        loop {
            match ask().await {
                Ok(answer) => return answer,
                Err(error) => assert!(error.is_crash(), "{error}"),
            }
        }
    })
    .await
}

async fn values(world: &WorldClient, id: Option<ProjectionId>) -> Result<Vec<String>, Code> {
    let facts = world.query(id, &[]).await.map_err(|error| error.code().unwrap())?;
    Ok(facts.into_iter().map(|FactRecord { key, value, .. }| format!("{key} = {value}")).collect())
}

#[tokio::test]
async fn a_restarted_pool_has_every_commit_that_it_acknowledged_and_no_projection() {
    for durability in [Durability::None, Durability::Group, Durability::Each] {
        let system = TestSystem::new();
        let place = tempfile::tempdir().unwrap();
        let directory = place.path().join("state");
        let pool = system.world_pool_with(config(&system, &directory, durability)).await;
        let world = system.world(&pool);
        assert_eq!(world.commit("run/i1", vec![set("box", "a"), set("cup", "a")], None).await.unwrap(), Revision(1));
        assert_eq!(world.commit("run/i2", vec![set("cup", "b")], None).await.unwrap(), Revision(2));
        let before = world.project(projection("run/i3/1", 2)).await.unwrap();
        assert!(values(&world, Some(before)).await.is_ok());
        pool.end().await;

        let pool = system.world_pool_with(config(&system, &directory, durability)).await;
        let again = answered(|| world.commit("run/i1", vec![set("box", "a"), set("cup", "a")], None)).await;
        assert_eq!(again, Revision(1), "made once");
        let reused = world.commit("run/i1", vec![set("box", "c")], None).await.unwrap_err();
        assert_eq!(reused.code(), Some(Code::InvalidArgument), "{reused}");
        assert_eq!(values(&world, None).await.unwrap(), ["at(box) = a", "at(cup) = b"]);
        let (revision, facts) = world.root().await.unwrap();
        let written: Vec<Revision> = facts.iter().map(|fact| fact.revision).collect();
        assert_eq!(written, [Revision(1), Revision(2)]);
        // Without durability somebody may have heard of revisions that are lost: they do not come again.
        let leaps = durability == Durability::None;
        assert!(if leaps { revision > Revision(2) } else { revision == Revision(2) }, "{durability}: {revision}");
        assert_eq!(values(&world, Some(before)).await, Err(Code::NotFound), "projections are not kept");
        let after = world.project(projection("run/i3/1", if leaps { revision.0 } else { 1 })).await.unwrap();
        assert!(after > before, "an id of before means nothing new");
        assert_eq!(values(&world, Some(after)).await.unwrap(), ["at(box) = a", "at(cup) = projected"]);
        assert_eq!(world.commit("run/i4", vec![set("box", "d")], None).await.unwrap(), Revision(revision.0 + 1));
        pool.end().await;
    }
}

#[tokio::test]
async fn a_snapshot_takes_the_place_of_many_commits_and_revisions_are_kept_over_it() {
    let system = TestSystem::new();
    let place = tempfile::tempdir().unwrap();
    let with_snapshots = || {
        let mut config = config(&system, place.path(), Durability::Group);
        (config.storage.compact_bytes, config.revisions_kept) = (1 << 16, 50);
        config
    };
    let pool = system.world_pool_with(with_snapshots()).await;
    let world = system.world(&pool);
    for n in 1..=400 {
        world.commit(&format!("run/i{n}"), vec![set("cup", format!("{n}{}", "x".repeat(1_000)))], None).await.unwrap();
    }
    pool.end().await;
    let snapshots = std::fs::read_dir(place.path()).unwrap().flatten();
    let snapshots = snapshots.filter(|entry| entry.path().extension().is_some_and(|extension| extension != "log"));
    assert!(snapshots.count() > 0, "there is a snapshot");

    let pool = system.world_pool_with(with_snapshots()).await;
    let again = answered(|| world.commit("run/i1", vec![set("cup", format!("1{}", "x".repeat(1_000)))], None)).await;
    assert_eq!(again, Revision(1), "remembered beyond the revisions that are kept");
    assert!(world.project(projection("old", 351)).await.is_ok());
    assert_eq!(world.project(projection("older", 350)).await.unwrap_err().code(), Some(Code::OutOfRange));
    pool.end().await;
}

#[tokio::test]
async fn a_second_pool_on_the_same_state_is_refused() {
    let system = TestSystem::new();
    let place = tempfile::tempdir().unwrap();
    let pool = system.world_pool_with(config(&system, place.path(), Durability::Group)).await;
    let mut other = config(&system, place.path(), Durability::Group);
    other.listen = system.directory.socket("other");
    let refused = world_pool::run(other, system.directory.clone(), Default::default()).await.unwrap_err();
    assert!(format!("{refused:#}").contains("has a writer already"), "{refused:#}");
    pool.end().await;
}

#[tokio::test]
async fn on_a_full_disk_commits_are_refused_with_what_to_do_and_reading_and_projecting_go_on() {
    let Some(disk) = SmallDisk::mount() else { return };
    let system = TestSystem::new();
    std::fs::write(disk.ballast(), vec![1; 128 << 10]).unwrap();
    let directory = disk.path().join("state");
    let pool = system.world_pool_with(config(&system, &directory, Durability::Group)).await;
    let world = system.world(&pool);
    let mut made = 0;
    let error = loop {
        let changes = vec![set(&format!("box-{made:04}"), "x".repeat(900))];
        match world.commit(&format!("run/i{made}"), changes, None).await {
            Ok(_) => made += 1,
            Err(error) => break error,
        }
        assert!(made < 1_000, "the disk is never full");
    };
    let words = error.to_string();
    assert!(made > 10 && matches!(error, CallError::Broken { .. }), "{words}");
    assert!(words.contains("free space on this disk"), "{words}");
    let refused = world.commit("later", vec![set("cup", "b")], None).await.unwrap_err();
    assert!(refused.to_string().contains("free space on this disk"), "{refused}");
    let (revision, facts) = world.root().await.unwrap();
    assert_eq!((revision.0, facts.len() as u64), (made, made), "what was not acknowledged has not happened");
    let id = world.project(projection("p", made)).await.unwrap();
    assert_eq!(values(&world, Some(id)).await.unwrap().len() as u64, made + 1);
    pool.end().await;

    std::fs::remove_file(disk.ballast()).unwrap();
    let pool = system.world_pool_with(config(&system, &directory, Durability::Group)).await;
    let next = answered(|| world.commit("later", vec![set("cup", "b")], None)).await;
    assert_eq!(next, Revision(made + 1));
    pool.end().await;
}
