//! What can be asked of the resource manager: one resource, a filtered list, who waits for what, who is there, what changed.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_daemon::resource_manager::ResourceManagerConfig;
use ratn_model::condition::{Comparison, Condition};
use ratn_model::id::Revision;
use ratn_model::resource::{Requirement, ResourceClass, ResourceOperation};
use ratn_model::value::Value;
use ratn_proto::types::{Provision, Resource, ResourceEvent, ResourceEventKind, ResourceFilter, ResourceUpdate};
use ratn_proto::v1;
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use ratn_resources::Limits;
use ratn_worker::client::{AcquireOptions, ResourceWatch};
use std::collections::BTreeMap;
use std::time::Duration;
use support::{TestSystem, block, in_time};
use tonic::Code;
use tonic_types::StatusExt;

fn gripper(id: &str, payload: f64) -> Resource {
    let gripper = Resource::new(id, ResourceClass::Module, "Gripper").on_host("compute");
    gripper.with_attribute("payload", Value::Float(payload))
}

#[tokio::test]
async fn a_list_is_filtered_and_one_resource_is_got() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    a.resources.create(gripper("small", 1.0)).await.unwrap();
    a.resources.create(gripper("large", 5.0)).await.unwrap();
    a.resources.create(Resource::new("arm", ResourceClass::Module, "Arm")).await.unwrap();
    let ids = async |filter: ResourceFilter| -> Vec<String> {
        a.resources.list_where(filter).await.unwrap().into_iter().map(|resource| resource.id).collect()
    };
    assert_eq!(ids(ResourceFilter { host: "compute".into(), ..Default::default() }).await, ["large", "small"]);
    let attributes = [("payload".to_owned(), Value::Float(5.0))].into();
    assert_eq!(ids(ResourceFilter { attributes, ..Default::default() }).await, ["large"]);
    assert!(ids(ResourceFilter { class: Some(ResourceClass::World), ..Default::default() }).await.is_empty());
    assert!(ids(ResourceFilter { session: "nobody".into(), ..Default::default() }).await.is_empty());
    assert_eq!(a.resources.get("small").await.unwrap().attributes["payload"], Value::Float(1.0));
    let missing = a.resources.get("middle").await.unwrap_err().to_string();
    assert!(missing.contains("there is no resource `middle`"), "{missing}");
}

#[tokio::test]
async fn a_request_by_kind_and_conditions_goes_over_the_wire_and_the_lease_says_what_it_got() {
    let system = TestSystem::new();
    let kinds = [("Gripper".to_owned(), vec!["Tool".to_owned()])].into();
    let config = ResourceManagerConfig { listen: system.directory.socket("rm"), kinds, ..Default::default() };
    let manager = system.resource_manager_with(config).await;
    let a = system.client(&manager, "a").await;
    a.resources.create(gripper("small", 1.0)).await.unwrap();
    a.resources.create(gripper("large", 5.0)).await.unwrap();
    let at_least = |value| Condition { attribute: "payload".to_owned(), comparison: Comparison::GreaterOrEqual, value };
    let heavy = Requirement { conditions: vec![at_least(Value::Int(2))], ..block("Tool") };
    assert!(a.resources.exists(heavy.clone()).await.unwrap());
    let lease = a.resources.acquire(vec![heavy.clone()], AcquireOptions::default()).await.unwrap();
    assert_eq!(lease.resource("Tool").unwrap().id, "large");
    let options = AcquireOptions { deadline: Duration::from_millis(30), ..Default::default() };
    let told = a.resources.acquire(vec![heavy], options).await.unwrap_err().to_string();
    assert!(told.contains("`block Tool (payload >= 2)`: held by"), "{told}");
}

#[tokio::test]
async fn who_waits_is_told_for_whom_and_sessions_are_listed() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let (a, b) = (system.client(&manager, "a").await, system.client(&manager, "b").await);
    a.resources.create(Resource::new("arm", ResourceClass::Module, "Arm")).await.unwrap();
    let options = AcquireOptions { holder: "fetch/move".into(), ..Default::default() };
    let lease = a.resources.acquire(vec![block("Arm")], options).await.unwrap();
    let waits = {
        let b = b.resources.clone();
        let options = AcquireOptions { request: "run/i1".into(), ..Default::default() };
        tokio::spawn(async move { b.acquire(vec![block("Arm")], options).await })
    };
    let explained = in_time(async {
        loop {
            match b.resources.explain("run/i1").await {
                Ok(explained) => return explained,
                Err(_) => tokio::task::yield_now().await,
            }
        }
    })
    .await;
    let expected = format!("`block Arm`: held by {} of session {} for fetch/move", lease.id, a.session.id());
    assert_eq!(explained[0].obstacles, [expected]);
    // It has waited longer by now.
    let mut all = b.resources.explain("").await.unwrap();
    all.iter_mut().zip(&explained).for_each(|(all, one)| all.waiting_ms = one.waiting_ms);
    assert_eq!(all, explained);
    let sessions = b.resources.sessions().await.unwrap();
    let of = |id: &str| sessions.iter().find(|session| session.id == id).unwrap();
    assert_eq!((of(a.session.id()).leases.as_slice(), of(a.session.id()).resources.len()), ([lease.id].as_slice(), 1));
    assert_eq!(of(b.session.id()).waiting, 1);
    assert!(a.resources.release(lease.id).await.unwrap());
    in_time(waits).await.unwrap().unwrap();
    let told = b.resources.explain("run/i1").await.unwrap_err().to_string();
    assert!(told.contains("no acquire of request id `run/i1` waits"), "{told}");
}

#[tokio::test]
async fn what_a_task_consumed_returns_when_it_ends() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    a.resources.create(Resource::new("slots", ResourceClass::System, "Slot").with_capacity(3)).await.unwrap();
    let consume = Requirement { operation: ResourceOperation::Consume, count: 2.into(), ..block("Slot") };
    a.resources.consume(consume).await.unwrap();
    assert_eq!(a.resources.get("slots").await.unwrap().free, 1);
    a.resources.end_task().await.unwrap();
    assert_eq!(a.resources.get("slots").await.unwrap().free, 3);
}

#[tokio::test]
async fn a_watch_goes_on_from_a_revision_without_a_gap_or_is_told_that_it_cannot() {
    let system = TestSystem::new();
    let limits = Limits { history: 16, ..Limits::default() };
    let config = ResourceManagerConfig { listen: system.directory.socket("rm"), limits, ..Default::default() };
    let manager = system.resource_manager_with(config.clone()).await;
    let a = system.client(&manager, "a").await;
    for i in 0..20 {
        a.resources.create(gripper(&format!("gripper-{i}"), 1.0)).await.unwrap();
    }
    for after in [5, 7, 20] {
        let mut watch = a.resources.watch_from(&[], Some(Revision(after).into())).await.unwrap();
        if after < 20 {
            assert_eq!(next_event(&mut watch).await.revision, Revision(after + 1));
            continue;
        }
        a.resources.create(gripper("last", 2.0)).await.unwrap();
        assert_eq!(next_event(&mut watch).await.resource.id, "last");
    }
    let mut raw = ResourceServiceClient::new(system.channels.get(&manager.endpoint).unwrap());
    for (after, told) in [(4, "forgotten (known are those after 5)"), (1_000, "lies ahead of the pool's 21")] {
        let request = v1::ResourceServiceWatchRequest { after_revision: Some(after), ..Default::default() };
        let refused = in_time(raw.watch(request)).await.unwrap_err();
        assert_eq!(refused.code(), Code::OutOfRange);
        assert!(refused.message().contains(told), "{}", refused.message());
        assert!(refused.message().contains("watch without a revision"), "{}", refused.message());
        let about = refused.get_details_error_info().unwrap();
        assert_eq!((about.reason.as_str(), about.metadata["oldest_revision"].as_str()), ("COMPACTED", "5"));
    }

    // Over a restart as well: the log has what happened.
    manager.end().await;
    let manager = system.resource_manager_with(config).await;
    let a = system.client(&manager, "a").await;
    let mut watch = a.resources.watch_from(&[], Some(Revision(18).into())).await.unwrap();
    let ids = [next_event(&mut watch).await, next_event(&mut watch).await, next_event(&mut watch).await];
    assert_eq!(ids.map(|event| event.resource.id), ["gripper-18", "gripper-19", "last"]);
}

#[tokio::test]
async fn a_watch_of_some_resources_hears_of_no_others() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    for id in ["a", "b"] {
        a.resources.create(gripper(id, 1.0)).await.unwrap();
    }
    let mut watch = a.resources.watch_resources(["b".to_owned()]).await.unwrap();
    let Some(ResourceUpdate::Snapshot { resources, .. }) = in_time(watch.next()).await.unwrap() else { panic!() };
    assert_eq!(resources.iter().map(|resource| resource.id.as_str()).collect::<Vec<_>>(), ["b"]);
    let both = Requirement { count: 2.into(), ..block("Gripper") };
    let lease = a.resources.acquire(vec![both], AcquireOptions::default()).await.unwrap();
    a.resources.release(lease.id).await.unwrap();
    for kind in [ResourceEventKind::Leased, ResourceEventKind::Released] {
        let event = next_event(&mut watch).await;
        assert_eq!((event.kind, event.resource.id.as_str(), event.lease.unwrap().0), (kind, "b", lease.id));
    }

    let mut raw = ResourceServiceClient::new(system.channels.get(&manager.endpoint).unwrap());
    for (many, refused) in [(1_024, false), (1_025, true)] {
        let resource_ids = (0..many).map(|i| format!("r-{i}")).collect();
        let request = v1::ResourceServiceWatchRequest { resource_ids, ..Default::default() };
        let watch = in_time(raw.watch(request)).await;
        assert_eq!(watch.as_ref().is_err_and(|status| status.message().contains("at most 1024")), refused, "{watch:?}");
    }
}

#[tokio::test]
async fn a_grant_says_whose_it_is() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    a.resources.create(gripper("a", 1.0)).await.unwrap();
    let mut raw = ResourceServiceClient::new(system.channels.get(&manager.endpoint).unwrap());
    let request = v1::BlockRequest {
        session_id: a.session.id().to_owned(),
        requirement: Some(block("Gripper").into()),
        deadline_ms: 1_000,
        ..Default::default()
    };
    let granted = in_time(raw.block(request)).await.unwrap().into_inner();
    assert_eq!(granted.lease.unwrap().session_id, a.session.id());
}

#[tokio::test]
async fn a_watch_that_broke_within_a_revision_goes_on_within_it() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    for id in ["a", "b", "c"] {
        a.resources.create(gripper(id, 1.0)).await.unwrap();
    }
    let mut watch = a.resources.watch_from(&[], Some(Revision(3).into())).await.unwrap();
    let three = Requirement { count: 3.into(), ..block("Gripper") };
    let lease = a.resources.acquire(vec![three], AcquireOptions::default()).await.unwrap();
    a.resources.release(lease.id).await.unwrap();
    let mut whole = Vec::new();
    while whole.len() < 6 {
        whole.push(next_event(&mut watch).await);
    }
    let positions: Vec<(u64, u32)> = whole.iter().map(|event| (event.revision.0, event.part)).collect();
    assert_eq!(positions, [(4, 0), (4, 1), (4, 2), (5, 0), (5, 1), (5, 2)]);
    for seen in 0..5 {
        let mut watch = a.resources.watch_from(&[], Some(whole[seen].position())).await.unwrap();
        for expected in &whole[seen + 1..] {
            assert_eq!(&next_event(&mut watch).await, expected);
        }
    }
}

#[tokio::test]
async fn watches_that_begin_anywhere_in_a_busy_pool_see_every_change_once_and_in_order() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    a.resources.create(gripper("gripper", 1.0)).await.unwrap();
    let busy = {
        let a = a.resources.clone();
        tokio::spawn(async move {
            for _ in 0..150 {
                let lease = a.acquire(vec![block("Gripper")], AcquireOptions::default()).await.unwrap();
                a.release(lease.id).await.unwrap();
            }
        })
    };
    let mut after = Revision(1);
    let mut watches = Vec::new();
    while after.0 < 250 {
        let mut watch = a.resources.watch_from(&[], Some(after.into())).await.unwrap();
        let first = next_event(&mut watch).await;
        assert_eq!(first.revision.0, after.0 + 1);
        after = Revision(after.0 + 20).min(a.resources.get("gripper").await.unwrap().revision).max(first.revision);
        watches.push((first.revision, watch));
    }
    in_time(busy).await.unwrap();
    for (first, mut watch) in watches {
        for revision in first.0 + 1..=301 {
            assert_eq!(next_event(&mut watch).await.revision.0, revision);
        }
    }
}

async fn next_event(watch: &mut ResourceWatch) -> ResourceEvent {
    match in_time(watch.next()).await.unwrap() {
        Some(ResourceUpdate::Event(event)) => event,
        other => panic!("{other:?} is no event"),
    }
}

fn planner() -> BTreeMap<String, Provision> {
    [("PathPlanner".to_owned(), Provision { most: 1, grows: false })].into()
}

/// A resource of the kind of a provider, made by a task, is there first; who asks for what says where it is waits for the provider.
#[tokio::test]
async fn what_a_task_made_is_nobodys_performer_and_the_real_provider_is_asked() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let (a, b) = (system.client(&manager, "a").await, system.client(&manager, "b").await);
    a.resources.create(Resource::new("fake", ResourceClass::Task, "PathPlanner")).await.unwrap();
    let mut demand = b.resources.watch_demand(&planner(), &[].into()).await.unwrap();
    let performer = Requirement { conditions: vec![Condition::has("endpoint")], ..block("PathPlanner") };
    let provide = async {
        let asked = loop {
            let asked = demand.next().await.unwrap().unwrap();
            if !asked.is_empty() {
                break asked;
            }
        };
        assert!(asked[0].requirement.conditions.is_empty(), "{asked:?}");
        let real = Resource::new("real", ResourceClass::Process, "PathPlanner").with_endpoint("unix:/none");
        b.resources.create(real).await.unwrap();
    };
    let acquire = a.resources.acquire(vec![performer], AcquireOptions::default());
    let (lease, ()) = in_time(Box::pin(async { tokio::join!(acquire, provide) })).await;
    assert_eq!(lease.unwrap().resource("PathPlanner").unwrap().id, "real");
}

#[tokio::test]
async fn only_who_is_asked_for_a_kind_says_that_there_is_no_more_of_it() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    let refused = a.resources.report_shortage("PathPlanner", 0, "none left").await.unwrap_err();
    assert_eq!(refused.code(), Some(Code::FailedPrecondition), "{refused}");
    let watch = a.resources.watch_demand(&planner(), &[].into()).await.unwrap();
    a.resources.report_shortage("PathPlanner", 0, "none left").await.unwrap();
    a.resources.report_shortage("Arm", 0, "none left").await.unwrap_err();
    drop(watch);
    a.resources.report_shortage("PathPlanner", 0, "").await.unwrap();
}

#[tokio::test]
async fn demand_is_told_to_sessions_that_are_there_and_to_no_other_one() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    let channel = system.channels.get(&manager.endpoint).unwrap();
    let mut plain = ResourceServiceClient::new(channel);
    let of = |session_id: &str| v1::WatchDemandRequest { session_id: session_id.to_owned(), ..Default::default() };
    let refused = plain.watch_demand(of("nobody")).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition, "{refused}");
    assert_eq!(refused.get_error_details().error_info().unwrap().reason, "SESSION_UNKNOWN");
    plain.watch_demand(of(a.session.id())).await.unwrap();
}

#[tokio::test]
async fn a_list_goes_on_with_the_tokens_that_it_gave_and_with_no_other_ones() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    for id in ["one", "three", "two"] {
        a.resources.create(gripper(id, 1.0)).await.unwrap();
    }
    let channel = system.channels.get(&manager.endpoint).unwrap();
    let mut plain = ResourceServiceClient::new(channel);
    let page = |kinds: &[&str], token: &str| v1::ListRequest {
        kinds: kinds.iter().map(|kind| (*kind).to_owned()).collect(),
        page_bytes: 1,
        page_token: token.to_owned(),
        ..Default::default()
    };
    let (mut ids, mut token) = (Vec::new(), String::new());
    loop {
        let next = plain.list(page(&["Gripper"], &token)).await.unwrap().into_inner();
        ids.extend(next.resources.into_iter().map(|resource| resource.id));
        if next.next_page_token.is_empty() {
            break;
        }
        token = next.next_page_token;
    }
    assert_eq!(ids, ["one", "three", "two"]);
    for (kinds, token) in
        [(&["Gripper"][..], "one"), (&["Gripper"], "zzz"), (&["Gripper"], "0:one"), (&["Arm"], &token)]
    {
        let refused = plain.list(page(kinds, token)).await.unwrap_err();
        assert_eq!(refused.code(), Code::InvalidArgument, "{token}: {refused}");
        assert!(refused.message().contains("page_token"), "{refused}");
    }
    let sessions = v1::ListSessionsRequest { page_bytes: 1, page_token: "a".to_owned() };
    assert_eq!(plain.list_sessions(sessions).await.unwrap_err().code(), Code::InvalidArgument);
}

#[tokio::test]
async fn a_kind_is_a_letter_then_letters_digits_underscores_and_hyphens_whoever_says_it() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let a = system.client(&manager, "a").await;
    a.resources.create(Resource::new("ok", ResourceClass::Module, "Arm-2_left")).await.unwrap();
    a.resources.acquire(vec![block("Arm-2_left")], AcquireOptions::default()).await.unwrap();
    for kind in ["2Arm", "_Arm", "Arm left", "Arm.left", "Größe", "Arm/left", "-"] {
        let created = a.resources.create(Resource::new("odd", ResourceClass::Module, kind)).await.unwrap_err();
        let blocked = a.resources.acquire(vec![block(kind)], AcquireOptions::default()).await.unwrap_err();
        let mut refusals = vec![created, blocked];
        refusals.push(a.resources.list(&[kind]).await.unwrap_err());
        refusals.push(a.resources.exists(block(kind)).await.unwrap_err());
        refusals.push(a.resources.watch(&[kind]).await.map(drop).unwrap_err());
        for refused in refusals {
            assert_eq!(refused.code(), Some(Code::InvalidArgument), "{kind}: {refused}");
            assert!(refused.to_string().contains("a letter, then letters, digits, `_` and `-`"), "{refused}");
        }
    }
}
