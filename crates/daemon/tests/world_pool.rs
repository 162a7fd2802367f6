//! The world pool over gRPC, with a resource manager beside it.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_daemon::config::StorageConfig;
use ratn_daemon::world_pool::WorldPoolConfig;
use ratn_model::fact::{Change, FactKey, FactPattern, Footprint, Term};
use ratn_model::id::{LeaseId, ProjectionId, Revision};
use ratn_model::measurement::{Certainty, Measurement};
use ratn_model::resource::ResourceClass;
use ratn_model::value::Value;
use ratn_proto::types::{Resource, ResourceEventKind, WorldUpdate};
use ratn_proto::v1;
use ratn_proto::v1::world_pool_service_client::WorldPoolServiceClient;
use ratn_worker::client::{AcquireOptions, Commit, Projection, WorldClient, WorldWatch};
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
        writers: Vec::new(),
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
    assert_eq!(world.project(late.clone()).await.unwrap_err().code(), Some(Code::FailedPrecondition), "it has ended");
    let never =
        Projection { request: "run/i2/3".to_owned(), lease: Some((LeaseId(lease.id.0 + 1_000), lease.token)), ..late };
    let refused = world.project(never).await.unwrap_err();
    assert!(refused.to_string().contains("is not known to the world pool"), "{refused}");
}

#[tokio::test]
async fn facts_and_differences_go_on_with_the_page_tokens_that_were_given_for_them_and_with_no_other_ones() {
    let system = TestSystem::new();
    let pool = system.world_pool(1).await;
    let world = system.world(&pool);
    world.commit("a", vec![set("at", "box", 1), set("at", "cup", 1), set("on", "box", 1)], None).await.unwrap();
    let mut plain = WorldPoolServiceClient::new(system.channels.get(&pool.endpoint).unwrap());
    let query = |predicate: &str, token: &str| v1::QueryRequest {
        patterns: vec![any(predicate).into()],
        page_bytes: 1,
        page_token: token.to_owned(),
        ..Default::default()
    };
    let root = |token: &str| v1::GetRootRequest { page_bytes: 1, page_token: token.to_owned() };
    let diff = |from_revision, token: &str| v1::DiffRequest {
        from_revision,
        page_bytes: 1,
        page_token: token.to_owned(),
        ..Default::default()
    };
    let of_root = plain.get_root(root("")).await.unwrap().into_inner().next_page_token;
    let of_query = plain.query(query("at", "")).await.unwrap().into_inner().next_page_token;
    let of_diff = plain.diff(diff(0, "")).await.unwrap().into_inner().next_page_token;
    world.commit("b", vec![set("at", "box", 2)], None).await.unwrap();
    assert_eq!(plain.get_root(root(&of_root)).await.unwrap().into_inner().revision, 1);
    // With a token it is not looked at which revision is asked for.
    let again = v1::QueryRequest { at_revision: Some(2), ..query("at", &of_query) };
    let again = plain.query(again).await.unwrap().into_inner();
    assert_eq!((again.facts.len(), again.revision, again.next_page_token.is_empty()), (1, 1, true));
    assert_eq!(plain.diff(diff(0, &of_diff)).await.unwrap().into_inner().to_revision, 1);
    let of_others = ["1:0", "1:1", "2:0", "x", "0:1:1"].into_iter();
    for token in of_others.clone().chain([of_query.as_str(), &of_diff]) {
        let refused = plain.get_root(root(token)).await.unwrap_err();
        assert!(refused.code() == Code::InvalidArgument && refused.message().contains("page_token"), "{refused}");
    }
    for token in of_others.clone().chain([of_root.as_str(), &of_diff]) {
        assert_eq!(plain.query(query("at", token)).await.unwrap_err().code(), Code::InvalidArgument, "{token}");
    }
    assert_eq!(plain.query(query("on", &of_query)).await.unwrap_err().code(), Code::InvalidArgument);
    for token in of_others.chain([of_root.as_str(), &of_query]) {
        assert_eq!(plain.diff(diff(0, token)).await.unwrap_err().code(), Code::InvalidArgument, "{token}");
    }
    assert_eq!(plain.diff(diff(1, &of_diff)).await.unwrap_err().code(), Code::InvalidArgument);
}

/// A watch that is not read keeps nothing of the world: it ends where the history has forgotten what it has still to tell.
#[tokio::test]
async fn a_watch_that_is_not_read_keeps_no_revision_that_the_pool_has_forgotten() {
    let system = TestSystem::new();
    let config = WorldPoolConfig { revisions_kept: 3, ..system.world_pool_config() };
    let pool = system.world_pool_with(config).await;
    let world = system.world(&pool);
    let large = |name: &str| Change::Set { fact: key("cloud", name), value: Value::String("x".repeat(1_000_000)) };
    for number in 0..30 {
        world.commit(&format!("{number}"), vec![large(&format!("{number:02}"))], None).await.unwrap();
    }
    let mut plain = WorldPoolServiceClient::new(system.channels.get(&pool.endpoint).unwrap())
        .max_decoding_message_size(ratn_proto::MAX_MESSAGE_BYTES);
    let request = v1::WorldPoolServiceWatchRequest { in_parts: true, ..Default::default() };
    let mut watch = plain.watch(request).await.unwrap().into_inner();
    for number in 0..5 {
        world.commit(&format!("more-{number}"), vec![set("at", "box", number)], None).await.unwrap();
    }
    let mut parts = 0;
    let refused = loop {
        match in_time(watch.message()).await {
            Ok(part) => parts += usize::from(part.is_some()),
            Err(refused) => break refused,
        }
    };
    assert!(refused.code() == Code::Unavailable && refused.message().contains("too slow"), "{refused}");
    assert!((1..4).contains(&parts), "{parts} parts of four were made before the next was asked for");
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
    assert_eq!((room.id.as_str(), room.capacity.units(), room.host.as_str()), ("world-model@compute", 2, "compute"));
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

#[tokio::test]
async fn the_root_is_shown_as_it_was_and_what_changed_since_as_far_as_revisions_are_kept() {
    let system = TestSystem::new();
    let config = WorldPoolConfig { revisions_kept: 3, ..system.world_pool_config() };
    let pool = system.world_pool_with(config).await;
    let world = system.world(&pool);
    let gone = Change::Delete { pattern: FactPattern::of(&key("at", "cup")) };
    let steps = [vec![set("at", "box", 1), set("at", "cup", 1)], vec![set("at", "box", 2)], vec![gone]];
    for (n, changes) in steps.into_iter().enumerate() {
        let (id, writer) = (format!("run/i{n}"), format!("place[{n}]"));
        world.commit_as(Commit { id, changes, writer, ..Commit::default() }).await.unwrap();
    }
    let (revision, facts) = world.root_at(Some(Revision(1)), &[any("at")]).await.unwrap();
    let then: Vec<_> = facts.iter().map(|fact| (fact.value.clone(), fact.writer.as_deref())).collect();
    let expected = [(Value::Int(1), Some("place[0]")), (Value::Int(1), Some("place[0]"))];
    assert_eq!((revision, then), (Revision(1), expected.to_vec()));
    let (differences, to) = world.diff(Revision(1), None, &[]).await.unwrap();
    let shown: Vec<_> = differences.iter().map(|one| (one.key.to_string(), one.after.is_some())).collect();
    assert_eq!((to, shown), (Revision(3), vec![("at(box)".to_owned(), true), ("at(cup)".to_owned(), false)]));
    let (versions, oldest) = world.history(key("at", "cup")).await.unwrap();
    let revisions: Vec<_> = versions.iter().map(|version| (version.revision.0, version.fact.is_some())).collect();
    assert_eq!((revisions, oldest), (vec![(3, false), (1, true)], Revision(1)));

    world.commit("run/i9", vec![set("at", "box", 9)], None).await.unwrap();
    let forgotten = [
        world.root_at(Some(Revision(1)), &[]).await.unwrap_err(),
        world.diff(Revision(1), Some(Revision(2)), &[]).await.unwrap_err(),
        world.watch(Some(Revision(1)), &[]).await.unwrap_err(),
    ];
    for error in forgotten {
        assert_eq!(error.code(), Some(Code::OutOfRange), "{error}");
        assert!(error.to_string().contains("the oldest is 2"), "{error}");
    }
    let future = world.root_at(Some(Revision(5)), &[]).await.unwrap_err();
    assert_eq!(future.code(), Some(Code::FailedPrecondition), "{future}");
}

#[tokio::test]
async fn a_watch_tells_of_every_revision_once_and_in_order_and_goes_on_over_a_restart() {
    let system = TestSystem::new();
    let place = tempfile::tempdir().unwrap();
    let config = || {
        let storage = StorageConfig { directory: Some(place.path().to_owned()), ..StorageConfig::default() };
        WorldPoolConfig { storage, ..system.world_pool_config() }
    };
    let pool = system.world_pool_with(config()).await;
    let world = system.world(&pool);
    world.commit("first", vec![set("at", "box", 0)], None).await.unwrap();
    let mut watch = world.watch(None, &[]).await.unwrap();
    let Some(WorldUpdate::Snapshot { revision, facts }) = in_time(watch.next()).await.unwrap() else { panic!() };
    assert_eq!((revision, facts.len()), (Revision(1), 1));
    let committers = (0..8).map(|n| {
        let world = world.clone();
        async move {
            for i in 0..20 {
                world.commit(&format!("run/{n}/{i}"), vec![set("at", "box", i)], None).await.unwrap();
            }
        }
    });
    let committing = tokio::spawn(futures::future::join_all(committers));
    for expected in 2..=100 {
        assert_eq!(next_revision(&mut watch).await, expected);
    }
    in_time(committing).await.unwrap();
    pool.end().await;

    let pool = system.world_pool_with(config()).await;
    let world = system.world(&pool);
    let mut watch = in_time(async {
        loop {
            // The channel finds out first that the other end has changed.
            if let Ok(watch) = world.watch(Some(Revision(100)), &[]).await {
                return watch;
            }
        }
    })
    .await;
    for expected in 101..=161 {
        assert_eq!(next_revision(&mut watch).await, expected);
    }
    let mut cups = world.watch(Some(Revision(161)), &[any("full")]).await.unwrap();
    world.commit("last", vec![set("at", "box", 3)], None).await.unwrap();
    world.commit("really", vec![set("full", "cup", 3), set("at", "box", 4)], None).await.unwrap();
    let Some(WorldUpdate::Changed(change)) = in_time(cups.next()).await.unwrap() else { panic!() };
    let written: Vec<String> = change.written.iter().map(|fact| fact.key.to_string()).collect();
    assert_eq!((change.revision, change.commit.as_str(), written), (Revision(163), "really", vec!["full(cup)".into()]));
}

async fn next_revision(watch: &mut WorldWatch) -> u64 {
    match in_time(watch.next()).await.unwrap() {
        Some(WorldUpdate::Changed(change)) => change.revision.0,
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn a_measured_fact_says_what_measured_it_and_is_gone_after_its_time() {
    let system = TestSystem::new();
    let ontology = system.directory.path().join("robot.ttl");
    let text = "@prefix ratn: <urn:ratn:ontology#> .
        @prefix owl: <http://www.w3.org/2002/07/owl#> .
        @prefix : <urn:robot#> .
        :seen a ratn:Predicate ; ratn:arguments ( owl:Thing ) ; ratn:value \"int\" ; ratn:uncertainty \"covariance\" .
        :full a ratn:Predicate ; ratn:arguments ( owl:Thing ) ; ratn:value \"int\" .";
    std::fs::write(&ontology, text).unwrap();
    let ttl_s = [("seen".to_owned(), 0.05)].into();
    let pool =
        system.world_pool_with(WorldPoolConfig { ontology: Some(ontology), ttl_s, ..system.world_pool_config() });
    let pool = pool.await;
    let world = system.world(&pool);
    let mut watch = world.watch(None, &[]).await.unwrap();
    in_time(watch.next()).await.unwrap();
    let measured = Measurement { source: "camera".to_owned(), certainty: Some(Certainty::Covariance(vec![0.25])) };
    let commit = Commit {
        id: "run/i1".to_owned(),
        changes: vec![set("seen", "box", 1), set("full", "box", 1)],
        writer: "detect".to_owned(),
        evidence: vec![(key("seen", "box"), measured.clone())],
        ..Commit::default()
    };
    world.commit_as(commit).await.unwrap();
    let Some(WorldUpdate::Changed(change)) = in_time(watch.next()).await.unwrap() else { panic!() };
    let said: Vec<_> = change.written.iter().map(|fact| (fact.writer.as_deref(), fact.measured.as_deref())).collect();
    assert_eq!(said, [(Some("detect"), None), (Some("detect"), Some(&measured))]);
    let Some(WorldUpdate::Changed(change)) = in_time(watch.next()).await.unwrap() else { panic!() };
    assert_eq!((change.revision, change.commit.as_str(), change.gone), (Revision(2), "", vec![key("seen", "box")]));
    let outside = world.commit("run/i2", vec![set("at", "box", 1)], None).await.unwrap_err();
    assert_eq!(outside.code(), Some(Code::FailedPrecondition), "{outside}");
    assert_eq!(values(&world, None, "full").await, Ok(vec![Value::Int(1)]));
}

#[tokio::test]
async fn whoever_holds_a_projection_hears_when_a_commit_contradicts_it() {
    let system = TestSystem::new();
    let pool = system.world_pool(2).await;
    let world = system.world(&pool);
    world.commit("a", vec![set("at", "box", 1), set("at", "cup", 1)], None).await.unwrap();
    let projection = Projection {
        request: "run/i2/1".to_owned(),
        base: Revision(1),
        changes: vec![set("at", "box", 2)],
        writers: vec!["place[1]".into()],
        reads: Footprint::Patterns(vec![any("at")]),
        lease: None,
    };
    let id = world.project(projection).await.unwrap();
    let mut watch = world.watch_projection(id).await.unwrap();
    assert_eq!(in_time(watch.next()).await.unwrap(), Some(None), "it holds");
    let commit = |id: &str, changes, writer: &str| {
        let (id, writer) = (id.to_owned(), writer.to_owned());
        world.commit_as(Commit { id, changes, writer, ..Commit::default() })
    };
    let (_, none) = commit("b", vec![set("at", "box", 2)], "place[1]").await.unwrap();
    assert_eq!(none, [], "as it was predicted");
    let (revision, found) = commit("c", vec![set("at", "cup", 5)], "").await.unwrap();
    let said: Vec<_> = found.iter().map(|one| (one.projection, one.fact.to_string(), one.revision)).collect();
    assert_eq!(said, [(id, "at(cup)".to_owned(), revision)]);
    assert_eq!(in_time(watch.next()).await.unwrap().flatten().as_ref(), found.first());
    assert!(world.release(id).await.unwrap());
    assert_eq!(in_time(watch.next()).await.unwrap(), None, "it has ended");
    assert_eq!(world.watch_projection(id).await.unwrap_err().code(), Some(Code::NotFound));
}
