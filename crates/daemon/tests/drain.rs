//! How a resource manager ends: whoever waits is told, whatever was acknowledged is kept.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_model::resource::ResourceClass;
use ratn_proto::convert::all;
use ratn_proto::types::Resource;
use ratn_proto::v1;
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use std::time::Duration;
use support::{TestSystem, block, in_time};
use tokio::task::JoinHandle;
use tonic::{Code, Status};
use tonic_types::StatusExt;

fn is_told(status: &Status) -> bool {
    let details = status.get_error_details();
    status.code() == Code::Unavailable
        && details.error_info().is_some_and(|info| info.reason == "ENDING")
        && details.retry_info().is_some_and(|info| info.retry_delay.is_some_and(|delay| delay > Duration::ZERO))
}

#[tokio::test]
async fn whoever_waits_or_watches_is_told_that_the_manager_ends_and_when_to_ask_again() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    a.resources.create(Resource::new("arm", ResourceClass::Module, "Arm")).await.unwrap();
    let held = a.resources.acquire(vec![block("Arm")], Default::default()).await.unwrap();
    let mut plain = ResourceServiceClient::new(system.channels.get(&manager.endpoint).unwrap());
    let mut watch = plain.watch(v1::ResourceServiceWatchRequest::default()).await.unwrap().into_inner();
    in_time(watch.message()).await.unwrap().unwrap();

    // One waits in a call of its own, one on its session's stream.
    let acquire = v1::AcquireRequest {
        request_id: "waits".to_owned(),
        session_id: a.session.id().to_owned(),
        requirements: all([block("Arm")]),
        deadline_ms: 60_000,
        ..Default::default()
    };
    let mut client = plain.clone();
    let waits: JoinHandle<Status> = tokio::spawn(async move { client.acquire(acquire).await.unwrap_err() });
    let b = system.client(&manager, "b").await;
    let line = b.resources.clone();
    let waits_on_a_stream = tokio::spawn(async move { line.acquire(vec![block("Arm")], Default::default()).await });
    // Both are in the queue when both can be explained.
    in_time(async {
        loop {
            let waiting = plain.explain(v1::ExplainRequest::default()).await.unwrap().into_inner().total;
            if waiting == 2 {
                break;
            }
            tokio::task::yield_now().await;
        }
    })
    .await;

    let endpoint = manager.endpoint.clone();
    manager.end().await;
    let told = in_time(waits).await.unwrap();
    assert!(is_told(&told), "{told:?}");
    let told = in_time(waits_on_a_stream).await.unwrap().unwrap_err().to_string();
    assert!(told.contains("ending"), "{told}");
    let told = in_time(async {
        loop {
            match watch.message().await {
                Ok(Some(_)) => {}
                other => break other.unwrap_err(),
            }
        }
    });
    let told = told.await;
    assert!(is_told(&told), "{told:?}");

    // The successor has the lease, and nobody in its queue.
    let manager = system.resource_manager_at(endpoint).await;
    let listed = plain.list(v1::ListRequest::default()).await.unwrap().into_inner().resources;
    assert_eq!(listed[0].holdings[0].lease_id, held.id.0);
    manager.end().await;
}
