//! What can be stored can be listed: one client that stores as much as it may takes nobody else's answers away.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_daemon::resource_manager::ResourceManagerConfig;
use ratn_daemon::world_pool::WorldPoolConfig;
use ratn_model::fact::{Change, FactKey, Term};
use ratn_model::id::Revision;
use ratn_model::resource::ResourceClass;
use ratn_model::value::Value;
use ratn_proto::types::{Resource, ResourceUpdate, WorldUpdate};
use ratn_proto::v1;
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use ratn_proto::v1::world_pool_service_client::WorldPoolServiceClient;
use ratn_worker::client::ResourceClient;
use support::{TestSystem, in_time};
use tonic::{Code, Status};

const MIB: usize = 1 << 20;

fn text(bytes: usize) -> Value {
    Value::String("x".repeat(bytes))
}

fn fact(name: &str, bytes: usize) -> Change {
    let key = FactKey { predicate: "cloud".to_owned(), arguments: vec![Term::Name(name.to_owned())] };
    Change::Set { fact: key, value: text(bytes) }
}

fn too_large(refused: Status, says: &str) {
    assert_eq!(refused.code(), Code::ResourceExhausted, "{refused}");
    assert!(refused.message().contains(says), "{refused}");
}

#[tokio::test]
async fn attributes_larger_than_a_resource_may_be_are_refused_and_all_that_are_accepted_are_listed() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    let with = |id: &str, bytes| Resource::new(id, ResourceClass::Module, "Map").with_attribute("map", text(bytes));
    for (bytes, what, rule) in
        [(9 * MIB, "attributes", "most of them `map`: at most 8388608"), (MIB, "resource `huge`", "at most 65536")]
    {
        let refused = a.resources.create(with("huge", bytes)).await.unwrap_err();
        assert_eq!(refused.code(), Some(Code::InvalidArgument));
        let message = refused.to_string();
        assert!(message.contains(what) && message.contains(rule), "{message}");
    }
    // More than two messages of it, and it is a message that is full, not the memory.
    for number in 0..600 {
        a.resources.create(with(&format!("map-{number:03}"), 60_000)).await.unwrap();
    }
    let channel = system.channels.get(&manager.endpoint).unwrap();
    let mut plain = ResourceServiceClient::new(channel).max_decoding_message_size(ratn_proto::MAX_MESSAGE_BYTES);
    too_large(plain.list(v1::ListRequest::default()).await.unwrap_err(), "page_bytes");
    let mut watch = plain.watch(v1::ResourceServiceWatchRequest::default()).await.unwrap().into_inner();
    too_large(in_time(watch.message()).await.unwrap_err(), "in_parts");
    // Clients of the library ask for pages and parts.
    let looks = ResourceClient::new(&system.channels, &manager.endpoint, "").unwrap();
    let ids: Vec<String> = looks.list(&["Map"]).await.unwrap().into_iter().map(|resource| resource.id).collect();
    let expected: Vec<String> = (0..600).map(|number| format!("map-{number:03}")).collect();
    assert_eq!(ids, expected);
    let mut watch = looks.watch(&[]).await.unwrap();
    let ResourceUpdate::Snapshot { resources, .. } = in_time(watch.next()).await.unwrap().unwrap() else {
        panic!("a snapshot comes first")
    };
    assert_eq!(resources.into_iter().map(|resource| resource.id).collect::<Vec<String>>(), expected);
    // What is small is answered whole, as ever.
    let of_kind = v1::ListRequest { kinds: vec!["Nothing".to_owned()], ..Default::default() };
    assert!(plain.list(of_kind).await.unwrap().into_inner().resources.is_empty());
    let first = v1::ListRequest { page_bytes: 200_000, ..Default::default() };
    let first = plain.list(first).await.unwrap().into_inner();
    assert!(first.resources.len() == 3 && first.next_page_token.ends_with(":map-002"), "{}", first.next_page_token);
    a.resources.create(Resource::new("arm", ResourceClass::Module, "Arm")).await.unwrap();
    let event = in_time(watch.next()).await.unwrap().unwrap();
    assert!(matches!(event, ResourceUpdate::Event(event) if event.resource.id == "arm"), "and the watch goes on");
}

#[tokio::test]
async fn the_edge_of_what_a_resource_may_be() {
    let system = TestSystem::new();
    let limits = ratn_resources::Limits { resource_bytes: 1_000, ..Default::default() };
    let config = ResourceManagerConfig { listen: system.directory.socket("rm"), limits, ..Default::default() };
    let manager = system.resource_manager_with(config).await;
    let a = system.client(&manager, "a").await;
    let with = |bytes| Resource::new("map", ResourceClass::Module, "Map").with_attribute("map", text(bytes));
    let mut largest = 0;
    for bytes in 900..1_000 {
        match a.resources.create(with(bytes)).await {
            Ok(_) => largest = bytes,
            Err(refused) => {
                assert!(refused.to_string().contains("1001 bytes: at most 1000"), "{refused}");
                break;
            }
        }
    }
    assert_eq!(a.resources.get("map").await.unwrap().attributes["map"], text(largest));
}

#[tokio::test]
async fn facts_larger_than_they_may_be_are_refused_and_all_that_are_accepted_are_shown() {
    let system = TestSystem::new();
    let pool = system.world_pool(1).await;
    let world = system.world(&pool);
    let refused = world.commit("huge", vec![fact("huge", 9 * MIB)], None).await.unwrap_err();
    assert_eq!(refused.code(), Some(Code::InvalidArgument));
    let message = refused.to_string();
    assert!(message.contains("changes[0]") && message.contains("at most 1048576"), "{message}");
    let many = (0..9).map(|number| fact(&number.to_string(), MIB - 100)).collect();
    let refused = world.commit("many", many, None).await.unwrap_err().to_string();
    assert!(refused.contains("at most 8388608 are accepted at once"), "{refused}");
    for number in 0..40 {
        world.commit(&format!("run/{number}"), vec![fact(&format!("{number:02}"), MIB - 100)], None).await.unwrap();
    }
    let channel = system.channels.get(&pool.endpoint).unwrap();
    let mut plain = WorldPoolServiceClient::new(channel).max_decoding_message_size(ratn_proto::MAX_MESSAGE_BYTES);
    too_large(plain.get_root(v1::GetRootRequest::default()).await.unwrap_err(), "page_bytes");
    too_large(plain.query(v1::QueryRequest::default()).await.unwrap_err(), "page_bytes");
    let mut watch = plain.watch(v1::WorldPoolServiceWatchRequest::default()).await.unwrap().into_inner();
    too_large(in_time(watch.message()).await.unwrap_err(), "in_parts");
    let (revision, facts) = world.root().await.unwrap();
    assert_eq!((revision, facts.len()), (Revision(40), 40));
    assert_eq!(world.query(None, &[]).await.unwrap().len(), 40);
    let (differences, to) = world.diff(Revision(0), None, &[]).await.unwrap();
    assert_eq!((differences.len(), to), (40, Revision(40)));
    let mut watch = world.watch(None, &[]).await.unwrap();
    let Some(WorldUpdate::Snapshot { facts, .. }) = in_time(watch.next()).await.unwrap() else {
        panic!("a snapshot comes first")
    };
    let names: Vec<String> = facts.iter().map(|fact| fact.key.arguments[0].to_string()).collect();
    assert!(names.len() == 40 && names.is_sorted(), "{names:?}");
    // Every page is of the revision of the first, whatever is committed between them.
    let first = v1::GetRootRequest { page_bytes: 3 << 20, ..Default::default() };
    let first = plain.get_root(first).await.unwrap().into_inner();
    world.commit("later", vec![fact("00", 10), fact("99", 10)], None).await.unwrap();
    let (mut shown, mut token) = (first.facts.len(), first.next_page_token);
    while !token.is_empty() {
        let next = v1::GetRootRequest { page_bytes: 3 << 20, page_token: token };
        let next = plain.get_root(next).await.unwrap().into_inner();
        assert_eq!(next.revision, 40);
        (shown, token) = (shown + next.facts.len(), next.next_page_token);
    }
    assert_eq!(shown, 40);
}

#[tokio::test]
async fn the_edge_of_what_a_fact_and_a_commit_may_be() {
    let system = TestSystem::new();
    let config = WorldPoolConfig { fact_bytes: 200, commit_bytes: 400, ..system.world_pool_config() };
    let world = system.world(&system.world_pool_with(config).await);
    let mut largest = 0;
    for bytes in 100..200 {
        match world.commit(&bytes.to_string(), vec![fact("a", bytes)], None).await {
            Ok(_) => largest = bytes,
            Err(refused) => {
                assert!(refused.to_string().contains("changes[0]: has 201 bytes: at most 200"), "{refused}");
                break;
            }
        }
    }
    world.commit("two", vec![fact("a", largest), fact("b", largest)], None).await.unwrap();
    let three = vec![fact("a", largest), fact("b", largest - 100), fact("c", largest - 90)];
    let refused = world.commit("three", three, None).await.unwrap_err().to_string();
    assert!(refused.contains("at most 400 are accepted at once (commit_bytes)"), "{refused}");
}
