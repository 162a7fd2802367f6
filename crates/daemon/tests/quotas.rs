//! One client stops nobody else: what one caller may have at once is bounded, and the refusal says which quota and whose.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_daemon::metrics::Metrics;
use ratn_daemon::quota::QuotaConfig;
use ratn_daemon::resource_manager::{self, ResourceManagerConfig};
use ratn_daemon::service::ServiceConfig;
use ratn_model::resource::ResourceClass;
use ratn_proto::types::Resource;
use ratn_proto::v1;
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use ratn_proto::v1::resource_service_watch_response::Kind;
use ratn_resources::Limits;
use ratn_worker::endpoint::Endpoint;
use std::sync::Arc;
use std::time::Duration;
use support::{DEADLINE, TestSystem, in_time};
use tokio::io::AsyncReadExt;
use tokio::net::TcpStream;
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;
use tonic::{Code, Status};

/// A manager on loopback, where all are one caller: anonymous. It ends with the token.
async fn manager(system: &TestSystem, quotas: QuotaConfig, limits: Limits) -> (Endpoint, CancellationToken) {
    let listen = "127.0.0.1:0".parse().unwrap();
    let config = ResourceManagerConfig { listen, limits, ..Default::default() };
    let metrics = Arc::new(Metrics::new(resource_manager::ROLE));
    let serving = ServiceConfig { quotas, ..Default::default() }.serving(&metrics);
    let (live, end) = (tokio::sync::watch::Sender::new(config).subscribe(), CancellationToken::new());
    tokio::spawn(resource_manager::run_as(live, system.directory.clone(), serving, metrics, end.clone()));
    (system.directory.wait_for(resource_manager::ROLE, DEADLINE).await.unwrap(), end)
}

async fn client(endpoint: &Endpoint) -> ResourceServiceClient<Channel> {
    let Endpoint::Tcp { host, port } = endpoint else { panic!("{endpoint} is not TCP") };
    let channel = Channel::from_shared(format!("http://{host}:{port}")).unwrap();
    ResourceServiceClient::new(in_time(channel.connect()).await.unwrap())
}

fn refused(status: Status, says: &str) {
    assert_eq!(status.code(), Code::ResourceExhausted, "{status}");
    assert!(status.message().contains(says), "{status}");
}

/// The answer to one ping of a session of a day.
async fn ping(client: &mut ResourceServiceClient<Channel>, session: &str) -> Result<(), Status> {
    let ping = v1::KeepAliveRequest {
        session_id: session.to_owned(),
        ttl_ms: 86_400_000,
        client: String::new(),
        ..Default::default()
    };
    let answers = client.keep_alive(tokio_stream::iter([ping])).await?;
    in_time(answers.into_inner().message()).await.map(drop)
}

/// Connections of one caller, which begin to watch and read nothing: their windows are full, and the daemon has what comes next.
#[tokio::test]
async fn answers_that_a_caller_does_not_read_have_a_bound_in_bytes_until_it_reads_or_goes_away() {
    let system = TestSystem::new();
    let quotas = QuotaConfig { unread_bytes: 20 << 20, ..QuotaConfig::default() };
    let (endpoint, _end) = manager(&system, quotas, Limits::default()).await;
    let mut client = self::client(&endpoint).await.max_decoding_message_size(ratn_proto::MAX_MESSAGE_BYTES);
    let map = ratn_model::value::Value::String("x".repeat(60_000));
    ping(&mut client, "maps").await.unwrap();
    for number in 0..240 {
        let resource = Resource::new(format!("map-{number:03}"), ResourceClass::Task, "Map");
        let resource = Some(resource.with_attribute("map", map.clone()).into());
        client
            .create(v1::CreateRequest { session_id: "maps".to_owned(), resource, ..Default::default() })
            .await
            .unwrap();
    }
    let watch = v1::ResourceServiceWatchRequest { in_parts: true, ..Default::default() };
    let mut unread = Vec::new();
    let too_much = loop {
        assert!(unread.len() < 3, "each has 8 MiB of it at least");
        let mut other = self::client(&endpoint).await;
        match other.watch(watch.clone()).await {
            Ok(stream) => unread.push((other, stream)),
            Err(refused) => break refused,
        }
    };
    refused(
        too_much,
        "bytes of answers that were not read of anonymous: the quota of 20971520 is reached (service.quotas.unread_bytes)",
    );
    refused(client.list(v1::ListRequest::default()).await.unwrap_err(), "service.quotas.unread_bytes");
    // What is small is answered.
    ping(&mut client, "maps").await.unwrap();
    drop(unread);
    let mut watched = in_time(async {
        loop {
            match client.watch(watch.clone()).await {
                Ok(watched) => break watched.into_inner(),
                Err(_) => tokio::task::yield_now().await,
            }
        }
    })
    .await;
    let mut resources = 0;
    while let Some(v1::ResourceServiceWatchResponse { kind: Some(Kind::Snapshot(part)) }) =
        in_time(watched.message()).await.unwrap()
    {
        resources += part.resources.len();
        if !part.more {
            break;
        }
    }
    assert_eq!(resources, 240);
}

#[tokio::test]
async fn a_caller_that_reads_nothing_for_long_makes_room_for_the_others() {
    let system = TestSystem::new();
    let quotas = QuotaConfig { unread_bytes: 5 << 20, unread_ms: 500, ..QuotaConfig::default() };
    let (endpoint, _end) = manager(&system, quotas, Limits::default()).await;
    let mut client = self::client(&endpoint).await.max_decoding_message_size(ratn_proto::MAX_MESSAGE_BYTES);
    let map = ratn_model::value::Value::String("x".repeat(60_000));
    ping(&mut client, "maps").await.unwrap();
    for number in 0..60 {
        let resource = Resource::new(format!("map-{number:03}"), ResourceClass::Task, "Map");
        let resource = Some(resource.with_attribute("map", map.clone()).into());
        let create = v1::CreateRequest { session_id: "maps".to_owned(), resource, ..Default::default() };
        client.create(create).await.unwrap();
    }
    let watch = v1::ResourceServiceWatchRequest { in_parts: true, ..Default::default() };
    let mut other = self::client(&endpoint).await;
    let _unread = other.watch(watch.clone()).await.unwrap();
    refused(client.watch(watch.clone()).await.unwrap_err(), "service.quotas.unread_bytes");
    // Its connection is open, and it reads nothing.
    in_time(async {
        while client.watch(watch.clone()).await.is_err() {
            tokio::time::sleep(std::time::Duration::from_millis(20)).await;
        }
    })
    .await;
}

#[tokio::test]
async fn one_caller_does_not_take_all_watches() {
    let system = TestSystem::new();
    let quotas = QuotaConfig { watches: 20, ..QuotaConfig::default() };
    let (endpoint, _end) = manager(&system, quotas, Limits::default()).await;
    let mut client = client(&endpoint).await;
    let watch = v1::ResourceServiceWatchRequest::default();
    let mut watches = Vec::new();
    for _ in 0..20 {
        let mut watch = client.watch(watch.clone()).await.unwrap().into_inner();
        in_time(watch.message()).await.unwrap().unwrap();
        watches.push(watch);
    }
    let one_more = client.watch(watch.clone()).await.unwrap_err();
    refused(one_more, "watches of anonymous: the quota of 20 is reached (service.quotas.watches)");
    client.list(v1::ListRequest::default()).await.unwrap();
    // Until one has ended.
    drop(watches.pop());
    in_time(async {
        while client.watch(watch.clone()).await.is_err() {
            tokio::task::yield_now().await;
        }
    })
    .await;
}

#[tokio::test]
async fn one_caller_does_not_open_all_sessions() {
    let system = TestSystem::new();
    let limits = Limits { sessions_per_caller: 50, ..Limits::default() };
    let (endpoint, _end) = manager(&system, QuotaConfig::default(), limits).await;
    let mut client = client(&endpoint).await;
    for number in 0..50 {
        ping(&mut client, &format!("s{number}")).await.unwrap();
    }
    let one_more = ping(&mut client, "s50").await.unwrap_err();
    refused(one_more, "sessions of anonymous: the quota of 50 is reached (limits.sessions_per_caller)");
    ping(&mut client, "s0").await.unwrap();
}

#[tokio::test]
async fn calls_beyond_the_rate_are_refused_and_say_so() {
    let system = TestSystem::new();
    let quotas = QuotaConfig { calls_per_s: 1, ..QuotaConfig::default() };
    let (endpoint, _end) = manager(&system, quotas, Limits::default()).await;
    let mut client = client(&endpoint).await;
    for _ in 0..2 {
        client.list(v1::ListRequest::default()).await.unwrap();
    }
    let mut last = Ok(());
    for _ in 0..20 {
        last = client.list(v1::ListRequest::default()).await.map(drop);
        if last.is_err() {
            break;
        }
    }
    refused(last.unwrap_err(), "calls a second of anonymous: the quota of 1 is reached (service.quotas.calls_per_s)");
}

#[tokio::test]
async fn silent_connections_shut_nobody_out_and_are_closed_at_their_deadline() {
    let system = TestSystem::new();
    let quotas = QuotaConfig { connections: 30, first_call_ms: 1_000, ..QuotaConfig::default() };
    let (endpoint, _end) = manager(&system, quotas, Limits::default()).await;
    let Endpoint::Tcp { host, port } = &endpoint else { panic!("{endpoint} is not TCP") };
    let mut working = client(&endpoint).await;
    let watch = working.watch(v1::ResourceServiceWatchRequest::default()).await.unwrap();
    let mut watch = watch.into_inner();
    in_time(watch.message()).await.unwrap().unwrap();
    let mut silent = Vec::new();
    for _ in 0..100 {
        silent.push(TcpStream::connect((host.as_str(), *port)).await.unwrap());
    }
    // Who speaks comes in, and who had something to do goes on.
    let mut another = client(&endpoint).await;
    in_time(another.list(v1::ListRequest::default())).await.unwrap();
    in_time(working.list(v1::ListRequest::default())).await.unwrap();
    for mut connection in silent {
        let mut rest = Vec::new();
        // Whatever was said until then, it ends.
        let ended = tokio::time::timeout(Duration::from_secs(10), connection.read_to_end(&mut rest)).await;
        assert!(ended.is_ok(), "a silent connection is still open");
    }
    let over = tokio::time::timeout(Duration::from_millis(10), watch.message()).await;
    assert!(over.is_err(), "the watch goes on: {over:?}");
}
