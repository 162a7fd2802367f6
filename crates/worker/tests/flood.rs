//! Whoever connects all the time and says nothing.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use futures::future::select_ok;
use ratn_worker::client::wait_until_serving;
use ratn_worker::connections::ConnectionLimits;
use ratn_worker::endpoint::{Endpoint, connect_lazily};
use ratn_worker::server::{Services, Serving, bind};
use ratn_worker::tls::ClientTls;
use std::time::Duration;
use tokio::io::AsyncReadExt;
use tokio::net::UnixStream;
use tokio_util::sync::CancellationToken;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

#[tokio::test]
async fn who_connects_all_the_time_is_told_the_quota_and_who_is_connected_is_served() {
    const CONNECTIONS: usize = 8;
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join("one.sock");
    let bound = bind(&Endpoint::Unix(path.clone())).await.unwrap();
    let (endpoint, shutdown) = (bound.endpoint().clone(), CancellationToken::new());
    // Silent ones give way first: the one with calls stays.
    let limits =
        ConnectionLimits { connections: CONNECTIONS, per_s: 1, for_operators: 0, ..ConnectionLimits::default() };
    let serving = Serving { connections: limits, ..Serving::default() };
    let served = tokio::spawn(bound.serve_as(Services::new(), serving, shutdown.clone()));
    wait_until_serving(&endpoint, &ClientTls::none(), Duration::from_secs(60)).await.unwrap();
    let mut health = HealthClient::new(connect_lazily(&endpoint, &ClientTls::none()).unwrap().into_channel());
    health.check(HealthCheckRequest::default()).await.unwrap();
    let mut open = Vec::new();
    for _ in 0..10 * CONNECTIONS {
        open.push(UnixStream::connect(&path).await.unwrap());
    }
    let told = open.iter_mut().map(|stream| {
        Box::pin(async {
            let mut said = Vec::new();
            // What is closed with something unread is reset behind what it was told.
            let _ = stream.read_to_end(&mut said).await;
            let said = String::from_utf8_lossy(&said).into_owned();
            if said.contains("service.quotas.connections_per_s") { Ok(said) } else { Err(said) }
        })
    });
    let (said, _) = tokio::time::timeout(Duration::from_secs(60), select_ok(told)).await.unwrap().unwrap();
    let uid = nix::unistd::geteuid();
    assert!(said.contains(&format!("connections a second of uid {uid}: the quota of 1 is reached")), "{said}");
    health.check(HealthCheckRequest::default()).await.unwrap();
    shutdown.cancel();
    served.await.unwrap().unwrap();
}
