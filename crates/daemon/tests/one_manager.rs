//! What a resource manager may say when it was suspended, or when another one has its state.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use ratn_daemon::config::StorageConfig;
use ratn_daemon::resource_manager::{self, ResourceManagerConfig};
use ratn_model::resource::ResourceClass;
use ratn_proto::types::Resource;
use ratn_proto::v1;
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use ratn_worker::client::{AcquireOptions, ResourceClient};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::session::Session;
use ratn_worker::trace::Traced;
use ratn_worker::vitals::CoreFailure;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use support::{DEADLINE, TestSystem, block, in_time};
use tokio_util::sync::CancellationToken;

fn config(listen: Endpoint, state: &Path) -> ResourceManagerConfig {
    let storage = StorageConfig { directory: Some(state.to_owned()), ..StorageConfig::default() };
    ResourceManagerConfig { listen, storage, ..ResourceManagerConfig::default() }
}

/// One ping over a stream of its own; nothing where it is not answered.
async fn ping(
    client: &mut ResourceServiceClient<Traced>,
    session: &str,
    ttl: Duration,
) -> Option<v1::KeepAliveResponse> {
    let ttl_ms = u64::try_from(ttl.as_millis()).unwrap();
    let request = v1::KeepAliveRequest {
        session_id: session.to_owned(),
        ttl_ms,
        client: session.to_owned(),
        ..Default::default()
    };
    let answers = client.keep_alive(tokio_stream::once(request)).await.ok()?;
    answers.into_inner().message().await.ok()?
}

#[tokio::test]
async fn nobody_believes_in_a_session_at_the_first_manager_while_a_second_one_gives_away_what_it_held() {
    const TTL: Duration = Duration::from_secs(4);
    let system = TestSystem::new();
    let state = tempfile::tempdir().unwrap();
    let first_at = system.directory.socket("first");
    let run = resource_manager::run(
        config(first_at.clone(), state.path()),
        system.directory.clone(),
        CancellationToken::new(),
    );
    let first = tokio::spawn(run);
    system.directory.wait_for(resource_manager::ROLE, DEADLINE).await.unwrap();

    let channel = || system.channels.get(&first_at).unwrap();
    let mut pings = ResourceServiceClient::new(channel());
    while ping(&mut pings, "holder", TTL).await.is_none() {}
    let holder = ResourceClient::new(&system.channels, &first_at, "holder").unwrap();
    let operator = ResourceClient::new(&system.channels, &first_at, "").unwrap();
    operator.create(Resource::new("arm", ResourceClass::Module, "Arm")).await.unwrap();
    let held = holder.acquire(vec![block("Arm")], AcquireOptions::default()).await.unwrap();

    std::fs::remove_file(state.path().join("writer.lock")).unwrap();
    let elsewhere = TestSystem::new();
    let second = elsewhere.resource_manager_with(config(elsewhere.directory.socket("second"), state.path())).await;
    let taken = Instant::now();
    let session = Session::open(&elsewhere.channels, &second.endpoint, "next", Duration::from_secs(30));
    session.alive(DEADLINE).await.unwrap();
    let next = ResourceClient::new(&elsewhere.channels, &second.endpoint, session.id()).unwrap();
    let waiting = tokio::spawn(async move {
        let lease = next.acquire(vec![block("Arm")], AcquireOptions { deadline: DEADLINE, ..Default::default() }).await;
        (lease, Instant::now())
    });
    // The holder asks the first one as long as that says anything.
    let mut believes_until = taken;
    let mut last_answer = taken;
    while !waiting.is_finished() {
        let asked = Instant::now();
        if ping(&mut pings, "holder", TTL).await.is_some_and(|answer| !answer.created) {
            (believes_until, last_answer) = (asked + TTL, Instant::now());
        }
        tokio::task::yield_now().await;
    }
    let (lease, granted) = in_time(waiting).await.unwrap();
    assert!(lease.unwrap().token > held.token);
    assert!(granted >= believes_until, "given away {:?} before the holder stopped believing", believes_until - granted);
    assert!(last_answer < taken + Duration::from_secs(2), "it spoke for {:?}", last_answer - taken);
    let ended = in_time(first).await.unwrap().unwrap_err();
    assert!(ended.chain().any(|cause| cause.to_string().contains("another writer has taken")), "{ended:#}");
    let fenced = |cause: &(dyn std::error::Error + 'static)| {
        matches!(cause.downcast_ref(), Some(ratn_worker::server::ServeError::Core(CoreFailure::Fenced { .. })))
    };
    assert!(ended.chain().any(fenced), "{ended:#}");
    second.end().await;
}

#[tokio::test]
async fn a_manager_that_was_suspended_for_longer_than_a_session_lives_still_knows_it() {
    let system = TestSystem::new();
    let mut manager = Command::new(env!("CARGO_BIN_EXE_ratn-test-worker"))
        .arg("resource-manager")
        .arg(system.directory.path())
        .stdin(Stdio::piped())
        .spawn()
        .unwrap();
    let process = Pid::from_raw(i32::try_from(manager.id()).unwrap());
    let at = system.directory.wait_for(resource_manager::ROLE, DEADLINE).await.unwrap();
    let session = Session::open(&system.channels, &at, "run", Duration::from_secs(3));
    session.alive(DEADLINE).await.unwrap();
    let resources = ResourceClient::new(&system.channels, &at, session.id()).unwrap();
    resources.create(Resource::new("arm", ResourceClass::Module, "Arm")).await.unwrap();
    let held = resources.acquire(vec![block("Arm")], AcquireOptions::default()).await.unwrap();

    kill(process, Signal::SIGSTOP).unwrap();
    let mut state = session.state();
    in_time(state.wait_for(|state| !state.alive)).await.unwrap();
    // The fault itself: longer than the session lives, and than anything that was under way.
    tokio::time::sleep(Duration::from_millis(600)).await;
    kill(process, Signal::SIGCONT).unwrap();
    in_time(state.wait_for(|state| state.alive)).await.unwrap();
    assert_eq!(state.borrow().generation, 1, "the manager knows it from before");
    let listed = loop {
        if let Ok(listed) = resources.list(&["Arm"]).await {
            break listed;
        }
    };
    assert_eq!(listed[0].holdings[0].lease, held.id, "and what it holds");
    drop(manager.stdin.take());
    assert!(manager.wait().unwrap().success());
}
