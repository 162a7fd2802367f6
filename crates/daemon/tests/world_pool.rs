//! The world pool over gRPC, with a resource manager beside it.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_model::fact::{Change, FactKey, FactPattern, Footprint, Term};
use ratn_model::id::{ProjectionId, Revision};
use ratn_model::resource::ResourceClass;
use ratn_model::value::Value;
use ratn_proto::types::{Resource, ResourceEventKind};
use ratn_worker::client::{AcquireOptions, Projection, WorldClient};
use ratn_worker::endpoint::Endpoint;
use std::time::Duration;
use support::{TestSystem, block, in_time};
use tonic::Code;

fn key(predicate: &str, name: &str) -> FactKey {
    FactKey { predicate: predicate.to_owned(), arguments: vec![Term::Name(name.to_owned())] }
}

fn set(predicate: &str, name: &str, value: i64) -> Change {
    Change::Set { fact: key(predicate, name), value: Value::Int(value) }
}

fn any(predicate: &str) -> FactPattern {
    FactPattern { predicate: predicate.to_owned(), arguments: vec![None] }
}

async fn values(world: &WorldClient, id: Option<ProjectionId>, predicate: &str) -> Result<Vec<Value>, Code> {
    let facts = world.query(id, &[any(predicate)]).await.map_err(|error| error.code().unwrap())?;
    Ok(facts.into_iter().map(|fact| fact.value).collect())
}

#[tokio::test]
async fn a_projection_shows_its_reads_only_and_dies_with_its_lease() {
    let system = TestSystem::new();
    let (manager, pool) = (system.resource_manager().await, system.world_pool(2).await);
    let client = system.client(&manager, "task").await;
    let world = system.world(&pool);
    world.commit("run/i1", vec![set("at", "box", 1), set("full", "box", 0)], Some(Revision(1))).await.unwrap();
    let lease = in_time(client.resources.acquire(vec![block("WorldModel")], AcquireOptions::default())).await.unwrap();
    let projection = Projection {
        request: "run/i2/1".to_owned(),
        base: Revision(1),
        changes: vec![set("at", "box", 2)],
        reads: Footprint::Patterns(vec![any("at")]),
        lease: Some((lease.id, lease.token)),
    };
    let id = world.project(projection.clone()).await.unwrap();
    assert_eq!(values(&world, Some(id), "at").await, Ok(vec![Value::Int(2)]));
    assert_eq!(values(&world, Some(id), "full").await, Err(Code::PermissionDenied));
    assert_eq!(values(&world, None, "at").await, Ok(vec![Value::Int(1)]), "the root is as it was");

    client.resources.release(lease.id).await.unwrap();
    in_time(async { while values(&world, Some(id), "at").await != Err(Code::NotFound) {} }).await;
    let late = Projection { request: "run/i2/2".to_owned(), ..projection };
    assert_eq!(world.project(late).await.unwrap_err().code(), Some(Code::FailedPrecondition), "its lease has ended");
}

#[tokio::test]
async fn a_commit_needs_the_revision_expected_and_is_made_once() {
    let system = TestSystem::new();
    let pool = system.world_pool(2).await;
    let world = system.world(&pool);
    for _ in 0..2 {
        let revision = world.commit("run/i1", vec![set("at", "box", 1)], Some(Revision(1))).await.unwrap();
        assert_eq!(revision, Revision(1));
    }
    let wrong = world.commit("run/i2", vec![set("at", "box", 2)], Some(Revision(1))).await.unwrap_err();
    assert_eq!(wrong.to_string(), "the root is at revision 1: a commit makes 2, not 1; read the root again");
    let (revision, facts) = world.root().await.unwrap();
    assert_eq!((revision, facts.len(), facts[0].revision), (Revision(1), 1, Revision(1)));
    // A fresh run on a running system: what was is deleted by a commit.
    let fresh = vec![Change::Delete { pattern: any("at") }, set("at", "cup", 3)];
    world.commit("run2/start", fresh, None).await.unwrap();
    assert_eq!(values(&world, None, "at").await, Ok(vec![Value::Int(3)]));
}

#[tokio::test]
async fn room_for_projections_is_a_resource_with_a_capacity_and_is_offered_again_to_a_manager_that_moved() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let _pool = system.world_pool(2).await;
    let room = system.watch(&manager, &[]).await.created("WorldModel").await;
    assert_eq!((room.id.as_str(), room.capacity, room.host.as_str()), ("world-model@compute", 2, "compute"));
    manager.end().await;
    let manager = system.resource_manager_at(Endpoint::loopback()).await;
    let room = system.watch(&manager, &[]).await.created("WorldModel").await;
    assert_eq!(room.free, 2);
    let client = system.client(&manager, "task").await;
    for _ in 0..2 {
        client.resources.acquire(vec![block("WorldModel")], AcquireOptions::default()).await.unwrap();
    }
    assert_eq!(client.resources.list(&["WorldModel"]).await.unwrap()[0].free, 0);
}

#[tokio::test]
async fn a_world_pool_takes_the_place_of_a_killed_one_once_that_one_has_expired() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let killed = system.client(&manager, "world-pool@compute").await;
    let room = Resource::new("world-model@compute", ResourceClass::World, "WorldModel");
    killed.resources.create(room).await.unwrap();
    let mut watch = system.watch(&manager, &["WorldModel"]).await;
    let _pool = system.world_pool(2).await;
    // Longer than its first attempt takes.
    let waiting = killed.resources.acquire(vec![block("WorldModel"), block("WorldModel")], soon());
    assert_eq!(waiting.await.unwrap_err().code(), Some(Code::DeadlineExceeded));
    killed.session.close().await;
    watch.event(|event| event.kind == ResourceEventKind::Created && event.resource.capacity == 2).await;
}

fn soon() -> AcquireOptions {
    AcquireOptions { deadline: Duration::from_millis(300), ..AcquireOptions::default() }
}
