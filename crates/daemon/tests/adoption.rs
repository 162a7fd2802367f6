//! A process manager that is killed, and what its successor does with the workers that it left: with real processes.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use ratn_model::value::Value;
use ratn_proto::types::{HostPools, Resource, ResourceEvent, ResourceEventKind, WorkerState};
use ratn_worker::client::{AcquireOptions, ProcessClient};
use std::io::Read;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use support::{TestSystem, block, in_time};

/// A process manager in a process of its own, ended with the test.
struct Manager(Child);

impl Manager {
    fn start(system: &TestSystem, how: &[&str]) -> Manager {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ratn-test-worker"));
        command.arg("manage").arg(system.directory.path()).args(how).stderr(Stdio::piped());
        Manager(command.spawn().unwrap())
    }

    /// `kill -9`
    fn kill(&mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

impl Drop for Manager {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn pid(resource: &Resource) -> Pid {
    match resource.attributes.get("pid") {
        Some(Value::Int(pid)) => Pid::from_raw(i32::try_from(*pid).unwrap()),
        other => panic!("no pid: {other:?}"),
    }
}

/// One that has ended and that nobody waits for is there still.
fn lives(pid: Pid) -> bool {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    stat.rsplit_once(')').is_some_and(|(_, fields)| !fields.trim_start().starts_with('Z'))
}

async fn gone(pid: Pid) {
    in_time(async {
        while lives(pid) {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
}

/// The workers once they are as wanted.
async fn pools(system: &TestSystem, wanted: impl Fn(&HostPools) -> bool) -> HostPools {
    in_time(async {
        loop {
            if let Ok(endpoint) = system.directory.find(ratn_daemon::process_manager::ROLE)
                && let Ok(client) = ProcessClient::new(&system.channels, &endpoint)
                && let Ok(pools) = client.pools().await
                && wanted(&pools)
            {
                return pools;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    })
    .await
}

fn one_ready(pools: &HostPools) -> bool {
    matches!(&pools.pools[0].workers[..], [one] if one.state == WorkerState::Ready)
}

fn deleted(event: &ResourceEvent) -> bool {
    event.kind == ResourceEventKind::Deleted
}

#[tokio::test(flavor = "multi_thread")]
async fn a_worker_is_adopted_with_its_lease_and_is_one_of_the_successor_s() {
    let system = TestSystem::new();
    let resources = system.resource_manager().await;
    let mut watch = system.watch(&resources, &["PathPlanner"]).await;
    let mut first = Manager::start(&system, &["adopt", "20"]);
    let worker = watch.created("PathPlanner").await;
    let client = system.client(&resources, "task").await;
    let lease = in_time(client.resources.block(block("PathPlanner"), AcquireOptions::default())).await.unwrap();
    first.kill();
    let _second = Manager::start(&system, &["adopt", "20"]);
    let adopted = pools(&system, |pools| one_ready(pools) && pools.pools[0].workers[0].held).await;
    let (one, process) = (&adopted.pools[0].workers[0], pid(&worker));
    assert_eq!((one.id.as_str(), i32::try_from(one.pid).unwrap()), (worker.id.as_str(), process.as_raw()));
    assert!(client.resources.release(lease.id).await.unwrap(), "the lease has held");
    kill(process, Signal::SIGKILL).unwrap();
    assert_eq!(watch.event(deleted).await.resource.id, worker.id, "its end is seen");
    let next = watch.created("PathPlanner").await;
    assert_eq!(next.id, "planner-2@localhost", "numbers go on");
    let pool = pools(&system, one_ready).await.pools.remove(0);
    assert_eq!((pool.crashes, pool.last_exit.contains("it was adopted")), (1, true), "{pool:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn one_that_nobody_adopts_ends_by_itself_when_its_grace_is_over() {
    let system = TestSystem::new();
    let resources = system.resource_manager().await;
    let mut watch = system.watch(&resources, &["PathPlanner"]).await;
    let mut first = Manager::start(&system, &["adopt", "0.5"]);
    let process = pid(&watch.created("PathPlanner").await);
    let killed = Instant::now();
    first.kill();
    gone(process).await;
    assert!(killed.elapsed() >= Duration::from_millis(450), "{:?}", killed.elapsed());
}

#[tokio::test(flavor = "multi_thread")]
async fn one_of_a_template_that_has_changed_is_replaced_once_its_successor_is_ready() {
    let system = TestSystem::new();
    let resources = system.resource_manager().await;
    let mut watch = system.watch(&resources, &["PathPlanner"]).await;
    let mut first = Manager::start(&system, &["adopt", "20"]);
    let old = watch.created("PathPlanner").await;
    first.kill();
    let _second = Manager::start(&system, &["adopt-other", "20"]);
    let new = watch.created("PathPlanner").await;
    assert_eq!(watch.event(deleted).await.resource.id, old.id);
    gone(pid(&old)).await;
    assert!(lives(pid(&new)));
    pools(&system, |pools| one_ready(pools) && pools.pools[0].workers[0].id == new.id).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn one_that_was_told_of_another_session_is_ended_before_another_is_started() {
    let system = TestSystem::new();
    let resources = system.resource_manager().await;
    let mut watch = system.watch(&resources, &["PathPlanner"]).await;
    let mut first = Manager::start(&system, &["adopt", "20"]);
    let old = watch.created("PathPlanner").await;
    first.kill();
    assert!(lives(pid(&old)));
    // As if the id had been another caller's, and the first one had not got further than to write down another one.
    std::fs::write(system.directory.path().join("process-manager.session"), "another-session").unwrap();
    let _second = Manager::start(&system, &["adopt", "20"]);
    let adopted_or_new = pools(&system, one_ready).await.pools[0].workers[0].id.clone();
    assert_eq!(adopted_or_new, "planner-2@localhost");
    let new = watch.created("PathPlanner").await;
    assert_eq!((new.id.as_str(), new.session.as_str()), ("planner-2@localhost", "another-session"));
    assert!(!lives(pid(&old)), "it would take another's leases for those of its own resource");
}

#[tokio::test(flavor = "multi_thread")]
async fn who_is_not_to_be_adopted_is_ended_with_all_that_it_started_before_another_is_started() {
    for (how, then) in [(vec!["sleep"], vec!["sleep"]), (vec!["adopt", "20"], vec![])] {
        let system = TestSystem::new();
        let resources = system.resource_manager().await;
        let mut watch = system.watch(&resources, &["PathPlanner"]).await;
        let mut first = Manager::start(&system, &how);
        let old = watch.created("PathPlanner").await;
        let process = pid(&old);
        let children = std::fs::read_to_string(format!("/proc/{process}/task/{process}/children")).unwrap();
        first.kill();
        if how == ["sleep"] {
            assert!(lives(process), "it does not know that its parent is gone");
        }
        let _second = Manager::start(&system, &then);
        assert_eq!(watch.event(deleted).await.resource.id, old.id);
        let new = watch.created("PathPlanner").await;
        assert!(!lives(process) && pid(&new) != process, "never two at a time");
        for child in children.split_whitespace() {
            gone(Pid::from_raw(child.parse().unwrap())).await;
        }
        pools(&system, one_ready).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_second_process_manager_of_a_runtime_directory_is_refused() {
    let system = TestSystem::new();
    let resources = system.resource_manager().await;
    let mut watch = system.watch(&resources, &["PathPlanner"]).await;
    let _first = Manager::start(&system, &[]);
    watch.created("PathPlanner").await;
    let mut second = Manager::start(&system, &[]);
    let ended = in_time(async {
        loop {
            if let Some(status) = second.0.try_wait().unwrap() {
                return status;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    });
    assert_eq!(ended.await.code(), Some(1));
    let mut said = String::new();
    second.0.stderr.take().unwrap().read_to_string(&mut said).unwrap();
    assert!(said.contains("runs in") && said.contains("already"), "{said}");
    pools(&system, one_ready).await;
}
