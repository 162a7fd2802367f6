//! Health, reflection, shutdown, sockets; and a worker from its options.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::{Double, begin, goal, provider, provider_with};
use ratn_proto::types::GoalOutcome;
use ratn_proto::v1::DescribeRequest;
use ratn_proto::v1::action_service_client::ActionServiceClient;
use ratn_worker::client::{ActionClient, Channels, wait_until_serving};
use ratn_worker::endpoint::{Endpoint, connect};
use ratn_worker::protocol::HEADER;
use ratn_worker::runtime_directory::wait_for_file;
use ratn_worker::server::{ServeError, Services, Serving, bind};
use ratn_worker::tls::ClientTls;
use ratn_worker::vitals::{CoreFailure, Vitals};
use ratn_worker::worker::{Worker, WorkerOptions};
use std::time::{Duration, Instant};
use tokio_util::sync::CancellationToken;
use tonic::Code;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;
use tonic_reflection::pb::v1::ServerReflectionRequest;
use tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient;
use tonic_reflection::pb::v1::server_reflection_request::MessageRequest;
use tonic_reflection::pb::v1::server_reflection_response::MessageResponse;
use tonic_types::StatusExt;

/// Nothing here takes this long.
const LONG: Duration = Duration::from_secs(20);

#[tokio::test]
async fn health_is_serving_as_soon_as_a_server_answers() {
    for listen in [None, Some(Endpoint::loopback())] {
        let provider = provider(listen).await;
        wait_until_serving(&provider.endpoint, &ClientTls::none(), LONG).await.unwrap();
    }
    let nobody = Endpoint::Unix("/nonexistent/socket".into());
    let error =
        wait_until_serving(&nobody, &ClientTls::none(), Duration::from_millis(1)).await.unwrap_err().to_string();
    assert!(error.contains("unix:/nonexistent/socket"), "{error}");
}

#[tokio::test]
async fn reflection_lists_the_services() {
    let provider = provider(None).await;
    let channel = connect(&provider.endpoint, &ClientTls::none()).await.unwrap();
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

/// Its name, reason and delay, as a refusal of a process that ends has them.
fn ending(status: &tonic::Status) -> (Code, String, Option<Duration>) {
    let details = status.get_error_details();
    let delay = details.retry_info().and_then(|info| info.retry_delay);
    (status.code(), details.error_info().map(|info| info.reason.clone()).unwrap_or_default(), delay)
}

#[tokio::test]
async fn a_server_that_drains_ends_what_is_under_way_and_refuses_what_is_new() {
    let provider = provider_with(None, LONG).await;
    let channel = connect(&provider.endpoint, &ClientTls::none()).await.unwrap();
    let mut health = HealthClient::new(channel.clone());
    let ask = |service: &str| HealthCheckRequest { service: service.to_owned() };
    let mut watched = health.watch(ask("ratn.v1.ActionService")).await.unwrap().into_inner();
    assert_eq!(watched.message().await.unwrap().unwrap().status(), ServingStatus::Serving);
    let under_way = begin(&provider, goal("a", "wait", 1)).await;

    provider.shutdown.cancel();
    assert_eq!(watched.message().await.unwrap().unwrap().status(), ServingStatus::NotServing);
    assert_eq!(health.check(ask("")).await.unwrap().into_inner().status(), ServingStatus::NotServing);
    let mut client = ActionServiceClient::new(channel);
    let refused = client.describe(DescribeRequest {}).await.unwrap_err();
    let (code, reason, delay) = ending(&refused);
    assert!(code == Code::Unavailable && reason == "ENDING" && delay.is_some(), "{refused:?}");
    assert!(!provider.serving.is_finished());

    // What was under way is heard to its end, and with it the server ends, long before the deadline.
    assert!(provider.server.cancel("a"));
    assert_eq!(under_way.await.unwrap().unwrap().outcome.as_str(), "preempted");
    tokio::time::timeout(LONG / 2, provider.serving).await.unwrap().unwrap();
}

#[tokio::test]
async fn a_call_that_goes_on_is_dropped_at_the_deadline() {
    let drain = Duration::from_millis(100);
    let provider = provider_with(None, drain).await;
    let under_way = begin(&provider, goal("a", "stay", 1)).await;
    let told = Instant::now();
    provider.shutdown.cancel();
    provider.serving.await.unwrap();
    assert!(told.elapsed() >= drain);
    assert_eq!(provider.server.running(), 1);
    under_way.abort();
}

#[tokio::test]
async fn an_idle_server_ends_at_once() {
    let provider = provider_with(None, LONG).await;
    let _connection = connect(&provider.endpoint, &ClientTls::none()).await.unwrap();
    provider.shutdown.cancel();
    tokio::time::timeout(LONG / 2, provider.serving).await.unwrap().unwrap();
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
    let worker = Worker::new(options).dangerously_believe_every_lease();
    let worker = worker.action(Double { runs: Default::default() }).shutdown(shutdown.clone());
    let running = tokio::spawn(worker.run());
    let endpoint = wait_for_file(&file, "worker", LONG).await.unwrap();
    wait_until_serving(&endpoint, &ClientTls::none(), LONG).await.unwrap();
    let client = ActionClient::new(Channels::new(&ClientTls::none()));
    let outcome = client.execute(&endpoint, goal("a", "double", 1), |_, _| {}).await.unwrap();
    assert_eq!(outcome.outcome, GoalOutcome::success().outcome);
    shutdown.cancel();
    running.await.unwrap().unwrap();
    assert!(!file.exists());
}

/// A client of another version of this program, over a real connection.
#[tokio::test]
async fn a_client_of_a_version_without_a_protocol_in_common_is_refused_at_its_first_call_with_both_versions() {
    let provider = provider(None).await;
    // As others have them: channels of this program say what it speaks.
    let channel =
        tonic::transport::Endpoint::from_shared(provider.endpoint.to_string()).unwrap().connect().await.unwrap();
    let describe = async |said: Option<&'static str>| {
        let mut question = tonic::Request::new(DescribeRequest {});
        if let Some(said) = said {
            question.metadata_mut().insert(HEADER, said.parse().unwrap());
        }
        ActionServiceClient::new(channel.clone()).describe(question).await.map(drop)
    };
    describe(None).await.unwrap();
    describe(Some("1-2 0.2.0")).await.unwrap();
    let refused = describe(Some("2-2 0.3.0")).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    for version in ["ratn 0.3.0, which speaks versions 2 to 2", concat!("ratn ", env!("CARGO_PKG_VERSION"), ", which")]
    {
        assert!(refused.message().contains(version), "{version}: {refused}");
    }
    // A client of this one says what it speaks.
    ActionClient::new(Channels::new(&ClientTls::none())).describe(&provider.endpoint).await.unwrap();
}

#[tokio::test]
async fn health_is_what_the_core_says_and_a_core_that_has_ended_is_served_no_more() {
    let directory = tempfile::tempdir().unwrap();
    let bound = bind(&Endpoint::Unix(directory.path().join("socket"))).await.unwrap();
    let (endpoint, vitals) = (bound.endpoint().clone(), Vitals::default());
    let serving = Serving { vitals: vitals.clone(), ..Serving::default() };
    let served = tokio::spawn(bound.serve_as(Services::new(), serving, CancellationToken::new()));
    wait_until_serving(&endpoint, &ClientTls::none(), LONG).await.unwrap();
    let mut health = HealthClient::new(connect(&endpoint, &ClientTls::none()).await.unwrap());
    let mut told = health.watch(HealthCheckRequest::default()).await.unwrap().into_inner();
    let mut next = async || told.message().await.unwrap().unwrap().status();
    assert_eq!(next().await, ServingStatus::Serving);
    vitals.unwell("storage failed");
    assert_eq!(next().await, ServingStatus::NotServing);
    vitals.well();
    assert_eq!(next().await, ServingStatus::Serving);
    let failure = CoreFailure::Panicked { part: "the core".to_owned(), what: "a defect".to_owned() };
    vitals.fail(failure.clone());
    let ended = tokio::time::timeout(LONG, served).await.unwrap().unwrap().unwrap_err();
    assert!(matches!(ended, ServeError::Core(found) if found == failure));
}
