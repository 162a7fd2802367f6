//! The resource manager over gRPC.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_model::resource::ResourceClass;
use ratn_proto::types::{Resource, ResourceEventKind, ResourceUpdate};
use ratn_proto::v1;
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use ratn_worker::client::AcquireOptions;
use ratn_worker::session::Session;
use std::time::{Duration, Instant};
use support::{DEADLINE, TestSystem, block, in_time};
use tonic::Code;

fn arm() -> Resource {
    Resource::new("arm", ResourceClass::Module, "Arm").with_endpoint("unix:/arm")
}

#[tokio::test]
async fn two_clients_compete_for_one_resource_and_the_second_gets_it_with_a_larger_token() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let (a, b) = (system.client(&manager, "a").await, system.client(&manager, "b").await);
    a.resources.create(arm()).await.unwrap();
    let mut watch = system.watch(&manager, &["Arm"]).await;
    let first = a.resources.acquire(vec![block("Arm")], AcquireOptions::default()).await.unwrap();
    assert_eq!(first.resource("Arm").unwrap().endpoint, "unix:/arm");
    let second = tokio::spawn({
        let b = b.resources.clone();
        async move { b.acquire(vec![block("Arm")], AcquireOptions::default()).await }
    });
    assert!(a.resources.release(first.id).await.unwrap());
    let second = in_time(second).await.unwrap().unwrap();
    assert!(second.token > first.token);
    assert!(!a.resources.release(first.id).await.unwrap(), "released once");
    let stranger = a.resources.release(second.id).await.unwrap_err();
    assert_eq!(stranger.code(), Some(Code::PermissionDenied));

    let mut kinds = Vec::new();
    let ResourceUpdate::Snapshot { mut revision, .. } = watch.next().await else { panic!("a snapshot is first") };
    while kinds.len() < 3 {
        let ResourceUpdate::Event(event) = watch.next().await else { panic!("one snapshot only") };
        assert_eq!(event.revision.0, revision.0 + 1, "no gap");
        revision = event.revision;
        kinds.push(event.kind);
    }
    use ResourceEventKind::{Leased, Released};
    assert_eq!(kinds, [Leased, Released, Leased]);
    manager.end().await;
}

#[tokio::test]
async fn an_acquire_that_waits_in_vain_says_what_it_waited_for() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    let options = AcquireOptions { deadline: Duration::from_millis(500), ..AcquireOptions::default() };
    let error = a.resources.acquire(vec![block("Arm")], options.clone()).await.unwrap_err();
    assert_eq!(error.code(), Some(Code::DeadlineExceeded));
    let words = "not granted: deadline passed while waiting for `block Arm`: no resource of kind Arm exists";
    assert_eq!(error.to_string(), words);
    a.resources.create(arm()).await.unwrap();
    let held = AcquireOptions { holder: "fetch/move".to_owned(), ..AcquireOptions::default() };
    a.resources.acquire(vec![block("Arm")], held).await.unwrap();
    let error = a.resources.acquire(vec![block("Arm")], options).await.unwrap_err().to_string();
    assert!(error.contains("held by lease-") && error.ends_with("for fetch/move"), "{error}");
}

#[tokio::test]
async fn a_dropped_call_leaves_the_queue() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let (a, b) = (system.client(&manager, "a").await, system.client(&manager, "b").await);
    a.resources.create(arm()).await.unwrap();
    let held = a.resources.acquire(vec![block("Arm")], AcquireOptions::default()).await.unwrap();
    // Both give up without an answer; then the arm is free and stays so.
    for _ in 0..2 {
        let waiting = b.resources.acquire(vec![block("Arm")], AcquireOptions::default());
        assert!(tokio::time::timeout(Duration::from_millis(30), waiting).await.is_err());
    }
    a.resources.release(held.id).await.unwrap();
    let again = in_time(a.resources.acquire(vec![block("Arm")], AcquireOptions::default())).await.unwrap();
    assert!(again.token > held.token);
}

#[tokio::test]
async fn a_grant_that_crossed_a_dropped_call_is_given_back_by_its_request_id() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    a.resources.create(arm()).await.unwrap();
    let options = AcquireOptions { request: "run/i1/acquire".to_owned(), ..AcquireOptions::default() };
    let first = a.resources.acquire(vec![block("Arm")], options.clone()).await.unwrap();
    let again = a.resources.acquire(vec![block("Arm")], options).await.unwrap();
    assert_eq!(first, again, "asked twice, granted once");
    let mut raw = ResourceServiceClient::new(system.channels.get(&manager.endpoint).unwrap());
    let mut withdraw = async || {
        let request = v1::WithdrawRequest {
            request_id: "run/i1/acquire".to_owned(),
            session_id: a.session.id().to_owned(),
            ..Default::default()
        };
        raw.withdraw(request).await.unwrap().into_inner().withdrawn
    };
    assert!(withdraw().await);
    assert!(!withdraw().await);
    assert_eq!(a.resources.list(&["Arm"]).await.unwrap()[0].free, 1);
}

#[tokio::test]
async fn the_end_of_a_session_ends_its_leases_and_withdraws_its_resources() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let (a, b) = (system.client(&manager, "a").await, system.client(&manager, "b").await);
    a.resources.create(arm()).await.unwrap();
    b.resources.create(Resource::new("camera", ResourceClass::Module, "Camera")).await.unwrap();
    let mut watch = system.watch(&manager, &[]).await;
    let lease = b.resources.acquire(vec![block("Arm"), block("Camera")], AcquireOptions::default()).await.unwrap();
    b.session.close().await;
    let released = watch.event(|event| event.kind == ResourceEventKind::Released && event.resource.id == "arm").await;
    assert_eq!(released.lease, Some((lease.id, lease.token)));
    assert_eq!(released.reason, "session closed");
    let gone = watch.event(|event| event.kind == ResourceEventKind::Deleted).await;
    assert_eq!(gone.resource.id, "camera");
    let again = in_time(a.resources.acquire(vec![block("Arm")], AcquireOptions::default())).await.unwrap();
    assert!(again.token > lease.token);
}

#[tokio::test]
async fn an_arm_whose_holder_is_gone_is_the_next_ones_when_its_provider_has_confirmed_standstill() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let [cell, a, b] = ["cell", "a", "b"].map(|name| system.client(&manager, name));
    let (cell, a, b) = (cell.await, a.await, b.await);
    let bound = std::time::Duration::from_secs(60);
    cell.resources.create(arm().with_standstill(bound)).await.unwrap();
    let mut watch = system.watch(&manager, &[]).await;
    let lease = a.resources.acquire(vec![block("Arm")], AcquireOptions::default()).await.unwrap();
    let options = AcquireOptions { request: "next".to_owned(), ..AcquireOptions::default() };
    let next = tokio::spawn({
        let resources = b.resources.clone();
        async move { resources.acquire(vec![block("Arm")], options).await }
    });
    let waits = async || b.resources.explain("next").await.map(|waiting| waiting[0].obstacles.join(""));
    in_time(async { while waits().await.is_err() {} }).await;
    a.session.close().await;
    // The provider hears at once that it has to stop.
    let ended = watch.event(|event| event.kind == ResourceEventKind::Released).await;
    let left = &ended.resource.ending[0];
    assert_eq!((left.lease, left.token, left.within_ms), (lease.id, lease.token, 60_000));
    assert!(ended.resource.holdings.is_empty() && ended.resource.free.is_zero());
    let obstacle = waits().await.unwrap();
    assert!(obstacle.contains("is ending: waits for session cell") && obstacle.contains("up to"), "{obstacle}");
    let stolen = b.resources.confirm_standstill(lease.id, "arm").await.unwrap_err();
    assert_eq!(stolen.code(), Some(Code::PermissionDenied));
    assert!(!next.is_finished());
    assert!(cell.resources.confirm_standstill(lease.id, "arm").await.unwrap());
    let freed = watch.event(|event| event.kind == ResourceEventKind::Updated).await;
    assert_eq!((freed.lease, freed.reason.as_str()), (Some((lease.id, lease.token)), "standstill confirmed"));
    assert!(in_time(next).await.unwrap().unwrap().token > lease.token);
    assert!(!cell.resources.confirm_standstill(lease.id, "arm").await.unwrap());
}

#[tokio::test]
async fn a_session_whose_pings_stay_away_expires() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let mut raw = ResourceServiceClient::new(system.channels.get(&manager.endpoint).unwrap());
    let ping = v1::KeepAliveRequest {
        session_id: "silent".into(),
        ttl_ms: 500,
        client: "silent".into(),
        ..Default::default()
    };
    let answer = raw.keep_alive(tokio_stream::once(ping)).await.unwrap().into_inner().message().await.unwrap().unwrap();
    assert!(answer.created);
    let request =
        v1::CreateRequest { request_id: "c".into(), session_id: "silent".into(), resource: Some(arm().into()) };
    let mut watch = system.watch(&manager, &[]).await;
    raw.create(request.clone()).await.unwrap();
    let gone = watch.event(|event| event.kind == ResourceEventKind::Deleted).await;
    assert_eq!((gone.resource.id.as_str(), gone.reason.as_str()), ("arm", "session expired"));
    let request = v1::CreateRequest { request_id: "d".into(), ..request };
    assert_eq!(raw.create(request).await.unwrap_err().code(), Code::FailedPrecondition);
}

#[tokio::test]
async fn a_release_gets_through_however_many_acquires_wait_on_its_connection() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    a.resources.create(arm()).await.unwrap();
    let held = a.resources.acquire(vec![block("Arm")], AcquireOptions::default()).await.unwrap();
    let one = |_| {
        let a = a.resources.clone();
        tokio::spawn(async move {
            let lease = a.acquire(vec![block("Arm")], AcquireOptions::default()).await.unwrap();
            a.release(lease.id).await.unwrap()
        })
    };
    let waiting: Vec<_> = (0..300).map(one).collect();
    tokio::task::yield_now().await;
    assert!(in_time(a.resources.release(held.id)).await.unwrap());
    for one in waiting {
        assert!(in_time(one).await.unwrap());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_session_is_kept_alive_however_much_there_is_to_do() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    let ttl = Duration::from_millis(1_500);
    let short = Session::open(&system.channels, &manager.endpoint, "short", ttl);
    short.alive(DEADLINE).await.unwrap();
    // Every change has these looked at.
    let waits = |_| {
        let a = a.resources.clone();
        tokio::spawn(async move { a.acquire(vec![block("Arm"), block("Nothing")], AcquireOptions::default()).await })
    };
    let _waiting: Vec<_> = (0..3_000).map(waits).collect();
    let began = Instant::now();
    let changes = |_| {
        let a = a.resources.clone();
        tokio::spawn(async move {
            while began.elapsed() < 2 * ttl {
                a.create(Resource::new("", ResourceClass::Module, "Arm")).await.unwrap();
            }
        })
    };
    let changing: Vec<_> = (0..100).map(changes).collect();
    let changed = async {
        for one in changing {
            one.await.unwrap();
        }
    };
    tokio::select! {
        () = short.lost() => panic!("its pings were not heard"),
        () = changed => {}
    }
}
