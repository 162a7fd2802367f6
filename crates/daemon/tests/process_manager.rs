//! The process manager with real processes, and a resource manager beside it.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use ratn_daemon::process_manager::{Label, Liveness, Needs, ProcessManagerConfig, Template};
use ratn_daemon::resource_manager::ResourceManagerConfig;
use ratn_model::resource::Requirement;
use ratn_model::value::Value;
use ratn_proto::types::{HostPools, Resource, ResourceEvent, ResourceEventKind, WorkerState};
use ratn_worker::client::AcquireOptions;
use std::time::Duration;
use support::{Client, DEADLINE, TestSystem, block, in_time};
use tonic::Code;

fn template() -> Template {
    Template {
        program: Some(env!("CARGO_BIN_EXE_ratn-test-worker").into()),
        args: ["serve", "{id}", "{kind}", "{endpoint_file}"].map(str::to_owned).to_vec(),
        max: Some(3),
        ..Template::new("planner", "PathPlanner")
    }
}

fn pid(resource: &Resource) -> Pid {
    match resource.attributes.get("pid") {
        Some(Value::Int(pid)) => Pid::from_raw(i32::try_from(*pid).unwrap()),
        other => panic!("no pid: {other:?}"),
    }
}

/// Waits until a process has ended. One that nobody reaps (in a container without an init) has ended, too.
async fn gone(pid: Pid) {
    let ended = || match std::fs::read_to_string(format!("/proc/{pid}/stat")) {
        Ok(stat) => stat.rsplit_once(") ").is_none_or(|(_, rest)| rest.starts_with('Z')),
        Err(_) => true,
    };
    in_time(async {
        while !ended() {
            tokio::task::yield_now().await;
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_worker_is_withdrawn_and_replaced_under_a_new_id_and_endpoint() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let mut watch = system.watch(&manager, &["PathPlanner"]).await;
    let processes = system.process_manager(vec![template()]).await;
    let first = watch.created("PathPlanner").await;
    assert_eq!((first.id.as_str(), first.host.as_str()), ("planner-1@compute", "compute"));
    assert!(first.endpoint().starts_with("http://127.0.0.1:"));

    kill(pid(&first), Signal::SIGKILL).unwrap();
    let withdrawn = watch.event(|event| event.kind == ResourceEventKind::Deleted).await;
    assert_eq!(withdrawn.resource.id, first.id);
    let second = watch.created("PathPlanner").await;
    assert_eq!(second.id, "planner-2@compute");
    assert_ne!(second.endpoint(), first.endpoint());
    let HostPools { host, pools, .. } = system.processes(&processes).pools().await.unwrap();
    assert_eq!((host.as_str(), pools[0].workers.len(), pools[0].failure.as_str()), ("compute", 1, ""));
    assert!(pools[0].workers[0].resident_bytes > 0);

    processes.end().await;
    gone(pid(&second)).await;
    assert_eq!(watch.event(|event| event.kind == ResourceEventKind::Deleted).await.resource.id, second.id);
    assert!(system.directory.find("planner-2@compute").is_err(), "no endpoint file is left");
}

#[tokio::test(flavor = "multi_thread")]
async fn workers_are_started_and_stopped_as_asked_within_the_pools_bounds() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let mut watch = system.watch(&manager, &["PathPlanner"]).await;
    let processes = system.process_manager(vec![template()]).await;
    let client = system.processes(&processes);
    watch.created("PathPlanner").await;
    assert_eq!(client.spawn("planner", 2).await.unwrap(), ["planner-2@compute", "planner-3@compute"]);
    assert_eq!(client.spawn("planner", 1).await.unwrap_err().code(), Some(Code::ResourceExhausted));
    assert_eq!(client.spawn("rm -rf /", 1).await.unwrap_err().code(), Some(Code::NotFound));
    let (one, two) = (watch.created("PathPlanner").await, watch.created("PathPlanner").await);
    let mut changes = client.watch().await.unwrap();
    client.stop(&one.id).await.unwrap();
    assert_eq!(watch.event(|event| event.kind == ResourceEventKind::Deleted).await.resource.id, one.id);
    let exited = loop {
        let change = in_time(changes.next()).await.unwrap().unwrap();
        if change.state == WorkerState::Exited {
            break change;
        }
    };
    assert_eq!((exited.id.as_str(), exited.reason.as_str()), (one.id.as_str(), "exited with status 0"));
    gone(pid(&one)).await;
    assert_eq!(client.pools().await.unwrap().pools[0].workers.len(), 2);
    processes.end().await;
    gone(pid(&two)).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn no_worker_outlives_a_killed_process_manager_and_its_resources_vanish() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let mut watch = system.watch(&manager, &["PathPlanner"]).await;
    let mut processes = std::process::Command::new(env!("CARGO_BIN_EXE_ratn-test-worker"))
        .arg("manage")
        .arg(system.directory.path())
        .spawn()
        .unwrap();
    let worker = watch.created("PathPlanner").await;
    processes.kill().unwrap();
    processes.wait().unwrap();
    gone(pid(&worker)).await;
    let vanished = watch.event(|event| event.kind == ResourceEventKind::Deleted).await;
    assert_eq!((vanished.resource.id, vanished.reason.as_str()), (worker.id, "session expired"));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_pool_whose_workers_crash_in_a_row_fails_with_their_last_words() {
    let system = TestSystem::new();
    let broken = Template { args: vec!["fail".to_owned()], backoff_ms: 1, crash_limit: 3, ..template() };
    let processes = system.process_manager(vec![broken]).await;
    let client = system.processes(&processes);
    let failure = in_time(async {
        loop {
            let pool = client.pools().await.unwrap().pools.remove(0);
            if !pool.failure.is_empty() {
                break pool.failure;
            }
        }
    })
    .await;
    let words = "3 crashes in a row; planner-3@compute: exited with status 1; its last words: cannot open the model | \
                 of the world";
    assert_eq!(failure, words);
}

#[tokio::test(flavor = "multi_thread")]
async fn what_waits_for_more_workers_than_there_are_makes_them_start_and_who_gave_up_wants_none() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let processes = system.process_manager(vec![Template { min: 0, ..template() }]).await;
    let client = system.client(&manager, "task").await;
    let two = Requirement { count: 2.into(), ..block("PathPlanner") };
    let lease = in_time(client.resources.acquire(vec![two], AcquireOptions::default())).await.unwrap();
    assert_eq!(lease.resources.len(), 2);
    assert!(client.resources.release(lease.id).await.unwrap());
    let workers = async || system.processes(&processes).pools().await.unwrap().pools[0].workers.len();
    assert_eq!(workers().await, 2, "started for it, and they stay");
    // More than there may be: the caller is told.
    let four = Requirement { count: 4.into(), ..block("PathPlanner") };
    let options = AcquireOptions { request: "four".to_owned(), ..AcquireOptions::default() };
    let waits = {
        let resources = client.resources.clone();
        tokio::spawn(async move { resources.acquire(vec![four], options).await })
    };
    let told = "only 3 units that fit exist (process-manager@compute: `planner` has 3 workers at the most)";
    in_time(async {
        loop {
            let explained = client.resources.explain("four").await;
            if explained.is_ok_and(|waiting| waiting[0].obstacles.iter().any(|obstacle| obstacle.contains(told))) {
                return;
            }
            tokio::task::yield_now().await;
        }
    })
    .await;
    waits.abort();
    processes.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn why_a_template_crash_loops_reaches_the_caller_who_waits_for_it() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let broken = Template { args: vec!["fail".to_owned()], min: 0, crash_limit: 2, backoff_ms: 1, ..template() };
    let processes = system.process_manager(vec![broken]).await;
    let client = system.client(&manager, "task").await;
    let words = in_time(async {
        loop {
            let options = AcquireOptions { deadline: Duration::from_millis(500), ..AcquireOptions::default() };
            let refused = client.resources.acquire(vec![block("PathPlanner")], options).await.unwrap_err();
            assert_eq!(refused.code(), Some(Code::DeadlineExceeded));
            let words = refused.to_string();
            if words.contains("crash-loops") {
                return words;
            }
        }
    })
    .await;
    assert!(
        words.contains(
            "no resource of kind PathPlanner exists (process-manager@compute: `planner` crash-loops: 2 crashes"
        ),
        "{words}"
    );
    assert!(words.contains("cannot open the model"), "its last words: {words}");
    processes.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_worker_that_hangs_is_taken_from_its_holder_killed_and_replaced() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let mut watch = system.watch(&manager, &["PathPlanner"]).await;
    let liveness = Liveness { interval_s: 0.05, timeout_s: 2.0 };
    let processes = system.process_manager(vec![Template { liveness, ..template() }]).await;
    let hung = watch.created("PathPlanner").await;
    let client = system.client(&manager, "task").await;
    let lease = client.resources.acquire(vec![block("PathPlanner")], AcquireOptions::default()).await.unwrap();

    kill(pid(&hung), Signal::SIGSTOP).unwrap();
    let of_lease = |event: &ResourceEvent| event.lease.is_some_and(|(id, _)| id == lease.id);
    let lost = watch.event(|event| event.kind == ResourceEventKind::Released && of_lease(event)).await;
    assert_eq!((lost.resource.id.as_str(), lost.reason.as_str()), (hung.id.as_str(), "the resource is gone"));
    assert_eq!(watch.created("PathPlanner").await.id, "planner-2@compute");
    gone(pid(&hung)).await;
    processes.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_worker_started_for_a_demand_ends_when_it_has_been_idle_and_not_while_it_is_held() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let mut watch = system.watch(&manager, &["PathPlanner"]).await;
    let processes = system.process_manager(vec![Template { min: 0, idle_s: 0.2, ..template() }]).await;
    let client = system.client(&manager, "task").await;
    let asked = client.resources.acquire(vec![block("PathPlanner")], AcquireOptions::default());
    let lease = in_time(asked).await.unwrap();
    let worker = watch.created("PathPlanner").await;
    // Several times as long as an idle one has.
    let mut changes = system.processes(&processes).watch().await.unwrap();
    while in_time(changes.next()).await.unwrap().unwrap().state != WorkerState::Ready {}
    assert!(tokio::time::timeout(Duration::from_secs(1), changes.next()).await.is_err(), "it is held");
    client.resources.release(lease.id).await.unwrap();
    let ended = watch.event(|event| event.kind == ResourceEventKind::Deleted).await;
    assert_eq!((&ended.resource.id, ended.resource.holdings.len()), (&worker.id, 0), "nobody lost it");
    gone(pid(&worker)).await;
    // And it comes again.
    in_time(client.resources.acquire(vec![block("PathPlanner")], AcquireOptions::default())).await.unwrap();
    processes.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_worker_that_is_told_to_stop_is_left_to_its_holder_until_that_releases_it() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let mut watch = system.watch(&manager, &["PathPlanner"]).await;
    let processes = system.process_manager(vec![template()]).await;
    let worker = watch.created("PathPlanner").await;
    let client = system.client(&manager, "task").await;
    let lease = client.resources.acquire(vec![block("PathPlanner")], AcquireOptions::default()).await.unwrap();
    system.processes(&processes).stop(&worker.id).await.unwrap();
    // Another one takes its place at once.
    assert_eq!(watch.created("PathPlanner").await.id, "planner-2@compute");
    assert!(client.resources.release(lease.id).await.unwrap());
    let ended = watch.event(|event| event.kind == ResourceEventKind::Deleted).await;
    assert_eq!((&ended.resource.id, ended.resource.holdings.len()), (&worker.id, 0), "nobody lost it");
    gone(pid(&worker)).await;
    processes.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn of_two_hosts_that_offer_the_same_one_starts_a_worker_for_a_demand() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let of_none = || vec![Template { min: 0, max: Some(2), ..template() }];
    let first = system.process_manager_of(&manager, "compute", of_none()).await;
    let second = system.process_manager_of(&manager, "control", of_none()).await;
    let client = system.client(&manager, "task").await;
    let workers = async || {
        let of = async |host| system.processes(host).pools().await.unwrap().pools[0].workers.len();
        (of(&first).await, of(&second).await)
    };
    let one = client.resources.acquire(vec![block("PathPlanner")], AcquireOptions::default());
    let one = in_time(one).await.unwrap();
    assert!(matches!(workers().await, (1, 0) | (0, 1)), "{:?}", workers().await);
    assert!(client.resources.release(one.id).await.unwrap());
    // More than one host has room for.
    let three = Requirement { count: 3.into(), ..block("PathPlanner") };
    let options = AcquireOptions { deadline: DEADLINE, ..AcquireOptions::default() };
    let three = in_time(client.resources.acquire(vec![three], options)).await.unwrap();
    assert_eq!(three.resources.len(), 3);
    assert!(matches!(workers().await, (2, 1) | (1, 2)), "{:?}", workers().await);
    first.end().await;
    second.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_demand_goes_on_to_the_next_host_when_the_first_one_cannot_meet_it() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let broken = Template { args: vec!["fail".to_owned()], min: 0, crash_limit: 2, backoff_ms: 1, ..template() };
    let first = system.process_manager_of(&manager, "compute", vec![broken]).await;
    let second = system.process_manager_of(&manager, "control", vec![Template { min: 0, ..template() }]).await;
    let client = system.client(&manager, "task").await;
    let options = AcquireOptions { deadline: DEADLINE, ..AcquireOptions::default() };
    let lease = in_time(client.resources.acquire(vec![block("PathPlanner")], options)).await.unwrap();
    assert_eq!(lease.resources[0].id, "planner-1@control");
    first.end().await;
    second.end().await;
}

/// What a wait for one planner comes to on a system of one host that can start none.
async fn refused(client: &Client, wanted: &Requirement, why: &str) {
    let soon = AcquireOptions { deadline: Duration::from_millis(200), ..AcquireOptions::default() };
    in_time(async {
        // Until the host has said why.
        loop {
            let error = client.resources.acquire(vec![wanted.clone()], soon.clone()).await.unwrap_err();
            if error.to_string().contains(why) {
                return;
            }
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_host_without_room_is_not_asked_for_what_another_host_can_start() {
    let system = TestSystem::new();
    let patient = ResourceManagerConfig { provider_patience_ms: 3_600_000, ..Default::default() };
    let manager = system.resource_manager_with(patient).await;
    let client = system.client(&manager, "task").await;
    let needs = Needs { free_memory_mib: Some(1 << 40), idle_cores: None };
    let large = vec![Template { min: 0, needs, ..template() }];
    let full = system.process_manager_of(&manager, "full", large).await;
    refused(&client, &block("PathPlanner"), "MiB of free memory for one more worker").await;
    let other = system.process_manager_of(&manager, "other", vec![Template { min: 0, ..template() }]).await;
    let options = AcquireOptions { deadline: DEADLINE, ..AcquireOptions::default() };
    let lease = in_time(client.resources.acquire(vec![block("PathPlanner")], options)).await.unwrap();
    assert_eq!(lease.resources[0].id, "planner-1@other");
    full.end().await;
    other.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_host_whose_labels_do_not_fit_is_not_asked_for_what_another_host_can_start() {
    let system = TestSystem::new();
    let patient = ResourceManagerConfig { provider_patience_ms: 3_600_000, ..Default::default() };
    let manager = system.resource_manager_with(patient).await;
    let client = system.client(&manager, "task").await;
    let with_gpu = |gpu: bool| ProcessManagerConfig {
        labels: [("gpu".to_owned(), Label::Bool(gpu))].into(),
        templates: vec![Template { min: 0, ..template() }],
        ..Default::default()
    };
    let wanted =
        |gpu: bool| Requirement { attributes: [("gpu".to_owned(), Value::Bool(gpu))].into(), ..block("PathPlanner") };
    let plain = system.process_manager_as(&manager, "plain", with_gpu(false)).await;
    let options = AcquireOptions { deadline: DEADLINE, ..AcquireOptions::default() };
    // So that it is the first that is asked.
    let lease = in_time(client.resources.acquire(vec![wanted(false)], options.clone())).await.unwrap();
    assert_eq!(lease.resources[0].id, "planner-1@plain");
    let fast = system.process_manager_as(&manager, "fast", with_gpu(true)).await;
    let lease = in_time(client.resources.acquire(vec![wanted(true)], options)).await.unwrap();
    assert_eq!(lease.resources[0].id, "planner-1@fast");
    assert_eq!(
        system.processes(&plain).pools().await.unwrap().pools[0].workers.len(),
        1,
        "none for the other's labels"
    );
    plain.end().await;
    fast.end().await;
}
