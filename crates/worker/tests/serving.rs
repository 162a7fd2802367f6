//! Health, reflection, shutdown, sockets; and a worker from its options.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::{Double, goal, provider};
use ratn_proto::types::GoalOutcome;
use ratn_worker::client::{ActionClient, Channels, wait_until_serving};
use ratn_worker::endpoint::{Endpoint, connect};
use ratn_worker::runtime_directory::wait_for_file;
use ratn_worker::server::bind;
use ratn_worker::worker::{Worker, WorkerOptions};
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tonic_reflection::pb::v1::ServerReflectionRequest;
use tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient;
use tonic_reflection::pb::v1::server_reflection_request::MessageRequest;
use tonic_reflection::pb::v1::server_reflection_response::MessageResponse;

/// Nothing here takes this long.
const LONG: Duration = Duration::from_secs(20);

#[tokio::test]
async fn health_is_serving_as_soon_as_a_server_answers() {
    for listen in [None, Some(Endpoint::loopback())] {
        let provider = provider(listen).await;
        wait_until_serving(&provider.endpoint, LONG).await.unwrap();
    }
    let nobody = Endpoint::Unix("/nonexistent/socket".into());
    let error = wait_until_serving(&nobody, Duration::from_millis(1)).await.unwrap_err().to_string();
    assert!(error.contains("unix:/nonexistent/socket"), "{error}");
}

#[tokio::test]
async fn reflection_lists_the_services() {
    let provider = provider(None).await;
    let channel = connect(&provider.endpoint).await.unwrap();
    let question = ServerReflectionRequest {
        host: String::new(),
        message_request: Some(MessageRequest::ListServices(String::new())),
    };
    let mut answers = ServerReflectionClient::new(channel)
        .server_reflection_info(tokio_stream::once(question))
        .await
        .unwrap()
        .into_inner();
    let answer = answers.message().await.unwrap().unwrap().message_response.unwrap();
    let MessageResponse::ListServicesResponse(list) = answer else { panic!("{answer:?}") };
    let names: Vec<String> = list.service.into_iter().map(|service| service.name).collect();
    for service in ["ratn.v1.ActionService", "ratn.v1.ResourceService", "grpc.health.v1.Health"] {
        assert!(names.iter().any(|name| name == service), "{service} is not in {names:?}");
    }
}

#[tokio::test]
async fn a_socket_in_use_is_refused_and_a_dead_one_replaced() {
    let directory = tempfile::tempdir().unwrap();
    let endpoint = Endpoint::Unix(directory.path().join("a.sock"));
    let first = bind(&endpoint).await.unwrap();
    let error = bind(&endpoint).await.unwrap_err();
    assert!(error.to_string().contains("a.sock"), "{error}");
    drop(first);
    // As a killed process leaves it: a file that nobody listens on.
    drop(std::os::unix::net::UnixListener::bind(directory.path().join("a.sock")).unwrap());
    bind(&endpoint).await.unwrap();
}

#[tokio::test]
async fn a_file_that_is_no_socket_is_not_replaced_by_one() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("thesis.txt");
    std::fs::write(&path, "words").unwrap();
    assert!(bind(&Endpoint::Unix(path.clone())).await.is_err());
    assert_eq!(std::fs::read_to_string(path).unwrap(), "words");
}

#[tokio::test]
async fn a_server_that_ends_leaves_the_socket_of_its_successor_alone() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("a.sock");
    let endpoint = Endpoint::Unix(path.clone());
    let first = bind(&endpoint).await.unwrap();
    // As a successor does that finds nobody listening, while the first still drains.
    std::fs::remove_file(&path).unwrap();
    let _second = bind(&endpoint).await.unwrap();
    drop(first);
    assert!(path.exists());
}

#[tokio::test]
async fn a_worker_serves_from_its_options_and_leaves_nothing_behind() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("one.endpoint");
    let options = WorkerOptions {
        id: common::RESOURCE.to_owned(),
        kind: "Tester".to_owned(),
        endpoint_file: Some(file.clone()),
        ..WorkerOptions::default()
    };
    let shutdown = CancellationToken::new();
    let worker = Worker::new(options).action(Double { runs: Default::default() }).shutdown(shutdown.clone());
    let running = tokio::spawn(worker.run());
    let endpoint = wait_for_file(&file, "worker", LONG).await.unwrap();
    wait_until_serving(&endpoint, LONG).await.unwrap();
    let client = ActionClient::new(Channels::new());
    let outcome = client.execute(&endpoint, goal("a", "double", 1), |_, _| {}).await.unwrap();
    assert_eq!(outcome.outcome, GoalOutcome::success().outcome);
    shutdown.cancel();
    running.await.unwrap().unwrap();
    assert!(!file.exists());
}
