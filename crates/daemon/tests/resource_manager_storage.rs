//! What the resource manager keeps, and what it does when it cannot.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_daemon::config::{Durability, StorageConfig};
use ratn_daemon::resource_manager::{self, ResourceManagerConfig};
use ratn_model::resource::ResourceClass;
use ratn_proto::types::{Resource, ResourceUpdate};
use ratn_worker::client::{AcquireOptions, CallError, ResourceClient};
use ratn_worker::session::Session;
use std::path::Path;
use std::time::Duration;
use support::{DEADLINE, Daemon, SmallDisk, TestSystem, block, in_time};

const TTL: Duration = Duration::from_secs(60);

fn config(system: &TestSystem, directory: &Path, durability: Durability) -> ResourceManagerConfig {
    let storage = StorageConfig { directory: Some(directory.to_owned()), durability, ..StorageConfig::default() };
    ResourceManagerConfig { listen: system.directory.socket("rm"), storage, ..ResourceManagerConfig::default() }
}

fn tool(id: &str) -> Resource {
    Resource::new(id, ResourceClass::Module, "Tool")
}

fn request(id: &str) -> AcquireOptions {
    AcquireOptions { request: id.to_owned(), ..AcquireOptions::default() }
}

async fn client(system: &TestSystem, manager: &Daemon) -> (Session, ResourceClient) {
    let session = Session::open_as(&system.channels, &manager.endpoint, "one".to_owned(), "one", TTL);
    session.alive(DEADLINE).await.unwrap();
    let resources = ResourceClient::new(&system.channels, &manager.endpoint, "one").unwrap();
    (session, resources)
}

#[tokio::test]
async fn a_restarted_manager_knows_everything_that_it_acknowledged() {
    for durability in [Durability::None, Durability::Group, Durability::Each] {
        let system = TestSystem::new();
        let place = tempfile::tempdir().unwrap();
        let directory = place.path().join("state");
        let manager = system.resource_manager_with(config(&system, &directory, durability)).await;
        let (session, resources) = client(&system, &manager).await;
        resources.create_once("make", tool("a")).await.unwrap();
        resources.create(tool("b")).await.unwrap();
        let lease = resources.acquire(vec![block("Tool")], request("take")).await.unwrap();
        let gone = resources.acquire(vec![block("Tool")], AcquireOptions::default()).await.unwrap();
        assert!(resources.release(gone.id).await.unwrap());
        manager.end().await;

        let manager = system.resource_manager_with(config(&system, &directory, durability)).await;
        session.alive(DEADLINE).await.unwrap();
        let listed = loop {
            // The channel finds out first that the other end has changed.
            match resources.list(&[]).await {
                Ok(listed) => break listed,
                Err(error) => assert!(error.is_crash(), "{error}"),
            }
        };
        let ids: Vec<&str> = listed.iter().map(|resource| resource.id.as_str()).collect();
        assert_eq!(ids, ["a", "b"]);
        let held = listed.iter().flat_map(|resource| &resource.holdings).collect::<Vec<_>>();
        assert_eq!(held.len(), 1);
        assert_eq!((held[0].lease, held[0].token), (lease.id, lease.token));
        assert_eq!(resources.acquire(vec![block("Tool")], request("take")).await.unwrap(), lease, "once");
        assert_eq!(resources.create_once("make", tool("a")).await.unwrap().id, "a");
        let next = resources.acquire(vec![block("Tool")], AcquireOptions::default()).await.unwrap();
        assert!(next.token > gone.token, "tokens grow");
        assert_eq!(session.state().borrow().generation, 1, "the session goes on");
        manager.end().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_session_lives_on_while_the_manager_may_say_nothing_for_many_times_its_time_to_live() {
    let (system, place) = (TestSystem::new(), tempfile::tempdir().unwrap());
    let (real, link) = (place.path().join("real"), place.path().join("state"));
    std::fs::create_dir(&real).unwrap();
    std::os::unix::fs::symlink(&real, &link).unwrap();
    let manager = system.resource_manager_with(config(&system, &link, Durability::Group)).await;
    let ttl = Duration::from_millis(500);
    let session = Session::open(&system.channels, &manager.endpoint, "holder", ttl);
    session.alive(DEADLINE).await.unwrap();
    let client = ResourceClient::new(&system.channels, &manager.endpoint, session.id()).unwrap();
    let operator = ResourceClient::new(&system.channels, &manager.endpoint, "").unwrap();
    operator.create(tool("a")).await.unwrap();
    let lease = client.acquire(vec![block("Tool")], request("take")).await.unwrap();
    // A link that leads to itself cannot be followed, by root neither.
    std::fs::remove_file(&link).unwrap();
    std::os::unix::fs::symlink(&link, &link).unwrap();
    in_time(session.lost()).await;
    tokio::time::sleep(6 * ttl).await;
    assert!(!session.state().borrow().alive, "nothing is said");
    std::fs::remove_file(&link).unwrap();
    std::os::unix::fs::symlink(&real, &link).unwrap();
    session.alive(DEADLINE).await.unwrap();
    assert_eq!(session.state().borrow().generation, 1, "the manager knows it");
    let held = client.list(&["Tool"]).await.unwrap().remove(0).holdings;
    assert_eq!(held.iter().map(|holding| holding.lease).collect::<Vec<_>>(), [lease.id]);
    manager.end().await;
}

#[tokio::test]
async fn a_second_manager_on_the_same_state_is_refused() {
    let system = TestSystem::new();
    let place = tempfile::tempdir().unwrap();
    let manager = system.resource_manager_with(config(&system, place.path(), Durability::Group)).await;
    let mut other = config(&system, place.path(), Durability::Group);
    other.listen = system.directory.socket("other");
    let refused = resource_manager::run(other, system.directory.clone(), Default::default()).await.unwrap_err();
    assert!(format!("{refused:#}").contains("has a writer already"), "{refused:#}");
    manager.end().await;
}

#[tokio::test]
async fn on_a_full_disk_changes_are_refused_with_what_to_do_and_reading_goes_on() {
    let Some(disk) = SmallDisk::mount() else { return };
    let system = TestSystem::new();
    std::fs::write(disk.ballast(), vec![1; 128 << 10]).unwrap();
    let directory = disk.path().join("state");
    let manager = system.resource_manager_with(config(&system, &directory, Durability::Group)).await;
    let (session, resources) = client(&system, &manager).await;
    let mut watch = system.watch(&manager, &[]).await;
    assert!(matches!(watch.next().await, ResourceUpdate::Snapshot { .. }));
    let mut made = Vec::new();
    let error = loop {
        let resource = tool(&format!("tool-{:04}", made.len())).with_endpoint(format!("unix:/{}", "x".repeat(900)));
        match resources.create(resource.clone()).await {
            Ok(_) => made.push(resource.id),
            Err(error) => break error,
        }
        assert!(made.len() < 1_000, "the disk is never full");
    };
    assert!(made.len() > 10, "{error}");
    let words = error.to_string();
    assert!(matches!(error, CallError::Broken { .. }) && words.contains("free space on this disk"), "{words}");
    for _ in 0..3 {
        let refused = resources.acquire(vec![block("Tool")], AcquireOptions::default()).await.unwrap_err();
        assert!(refused.to_string().contains("free space on this disk"), "{refused}");
    }
    let recalled = resources.recall(&["take".to_owned()]).await.unwrap_err();
    assert!(recalled.to_string().contains("free space on this disk"), "{recalled}");
    let ids = async || -> Vec<String> {
        let listed = resources.list(&[]).await.unwrap();
        listed.into_iter().map(|resource| resource.id).collect()
    };
    assert_eq!(ids().await, made, "what was not acknowledged has not happened");
    manager.end().await;

    std::fs::remove_file(disk.ballast()).unwrap();
    let manager = system.resource_manager_with(config(&system, &directory, Durability::Group)).await;
    session.alive(DEADLINE).await.unwrap();
    let after = async {
        loop {
            match resources.create(tool("after")).await {
                Ok(made) => return made,
                Err(error) => assert!(error.is_crash(), "{error}"),
            }
        }
    };
    in_time(after).await;
    made.insert(0, "after".to_owned());
    assert_eq!(ids().await, made);
    manager.end().await;
}
