//! A worker as a process of its own: this test's own executable, run again in the role of the worker.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod common;

use common::{Wait, goal};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use ratn_worker::action::{Action, ActionResult, GoalContext, STOP_GRACE};
use ratn_worker::client::{ActionClient, Channels, wait_until_serving};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::pooled::STUCK_VARIABLE;
use ratn_worker::shutdown::{EXIT_GRACE, exit_with_parent, on_signals_within};
use ratn_worker::tls::ClientTls;
use ratn_worker::worker::{Worker, WorkerOptions};
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;

const LONG: Duration = Duration::from_secs(20);
/// Instead of a socket.
const HANGS: &str = "hangs";
const HANG_PATIENCE: Duration = Duration::from_millis(200);
const SOCKET: &str = "RATN_TEST_SOCKET";

/// The role of the worker; as a test it does nothing.
#[test]
fn child() {
    let Some(socket) = std::env::var_os(SOCKET) else { return };
    let runtime = tokio::runtime::Runtime::new().unwrap();
    if socket == HANGS {
        // One whose runtime does nothing any more.
        on_signals_within(&CancellationToken::new(), HANG_PATIENCE).unwrap();
        runtime.block_on(async {
            println!("ready");
            std::thread::sleep(LONG);
        });
    }
    if socket.is_empty() {
        // One that never drains.
        exit_with_parent(&CancellationToken::new()).unwrap();
        runtime.block_on(std::future::pending::<()>());
    }
    let options = WorkerOptions {
        id: common::RESOURCE.to_owned(),
        listen: Endpoint::Unix(socket.into()),
        exit_with_parent: true,
        ..WorkerOptions::default()
    };
    let wait = Wait { name: "wait", abandon: true, ended: Notify::new().into() };
    let worker = Worker::new(options).dangerously_believe_every_lease().action(wait).action(Endless);
    runtime.block_on(worker.run()).unwrap();
}

/// `endless`: computes in a thread of its own and hears nothing.
struct Endless;

#[tonic::async_trait]
impl Action for Endless {
    fn name(&self) -> &str {
        "endless"
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        goal.progress("computes");
        let computes = || loop {
            std::thread::sleep(LONG);
        };
        tokio::task::spawn_blocking(computes).await?
    }
}

fn spawn(socket: &Path) -> Child {
    spawn_pooled(socket, "")
}

/// As a process manager would that says so of goals that do not stop.
fn spawn_pooled(socket: &Path, stuck_timeout_ms: &str) -> Child {
    Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "child", "--nocapture"])
        .env(SOCKET, socket)
        .env(STUCK_VARIABLE, stuck_timeout_ms)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap()
}

async fn exit_of(mut child: Child) -> ExitStatus {
    let exited = tokio::task::spawn_blocking(move || child.wait().unwrap());
    tokio::time::timeout(LONG, exited).await.expect("the worker does not end").unwrap()
}

#[tokio::test]
async fn a_worker_ends_with_its_parent_and_removes_its_socket() {
    let directory = tempfile::tempdir().unwrap();
    let socket = directory.path().join("workers/one.sock");
    let mut child = spawn(&socket);
    wait_until_serving(&Endpoint::Unix(socket.clone()), &ClientTls::none(), LONG).await.unwrap();
    drop(child.stdin.take());
    assert!(exit_of(child).await.success());
    assert!(!socket.exists());
}

#[tokio::test]
async fn a_process_that_does_not_drain_ends_all_the_same() {
    let mut child = spawn(Path::new(""));
    let ended = Instant::now();
    drop(child.stdin.take());
    assert_eq!(exit_of(child).await.code(), Some(3));
    assert!(ended.elapsed() >= EXIT_GRACE);
}

#[tokio::test]
async fn a_process_whose_runtime_hangs_ends_after_its_patience() {
    let mut child = spawn(Path::new(HANGS));
    let mut said = BufReader::new(child.stdout.take().unwrap()).lines();
    // The harness of tests has words of its own.
    assert!(said.any(|line| line.unwrap().ends_with("ready")));
    let told = Instant::now();
    let pid = Pid::from_raw(child.id().try_into().unwrap());
    kill(pid, Signal::SIGTERM).unwrap();
    assert_eq!(exit_of(child).await.code(), Some(3));
    assert!(told.elapsed() >= HANG_PATIENCE);
}

#[tokio::test]
async fn a_killed_worker_is_a_crash_of_its_goal() {
    let directory = tempfile::tempdir().unwrap();
    let socket = directory.path().join("one.sock");
    let mut child = spawn(&socket);
    let endpoint = Endpoint::Unix(socket);
    wait_until_serving(&endpoint, &ClientTls::none(), LONG).await.unwrap();
    let client = ActionClient::new(Channels::new(&ClientTls::none()));
    // It is killed as soon as its goal is under way.
    let killed = client.execute(&endpoint, goal("a", "wait", 1), |_, _| child.kill().unwrap()).await.unwrap_err();
    assert!(killed.is_crash(), "{killed}");
    assert!(!exit_of(child).await.success());
}

#[tokio::test]
async fn a_worker_ends_itself_when_a_goal_that_was_told_to_stop_does_not() {
    let directory = tempfile::tempdir().unwrap();
    let socket = directory.path().join("one.sock");
    let mut child = spawn_pooled(&socket, "500");
    // Its parent lives on.
    let _input = child.stdin.take();
    let endpoint = Endpoint::Unix(socket);
    wait_until_serving(&endpoint, &ClientTls::none(), LONG).await.unwrap();
    let client = ActionClient::new(Channels::new(&ClientTls::none()));
    // One that stops in time does not end it.
    let told = Instant::now();
    let in_time =
        client.execute(&endpoint, ratn_proto::types::Goal { deadline_ms: 1, ..goal("a", "wait", 1) }, |_, _| ());
    assert_eq!(in_time.await.unwrap().outcome, "preempted");
    let endless = ratn_proto::types::Goal { deadline_ms: 1, ..goal("b", "endless", 1) };
    let told_of = client.execute(&endpoint, endless, |_, _| ()).await.unwrap();
    assert!(told_of.reason.ends_with("it did not stop within 3 s"), "{told_of:?}");
    assert_eq!(exit_of(child).await.code(), Some(70));
    let lasted = told.elapsed();
    assert!((STOP_GRACE + Duration::from_millis(500)..LONG).contains(&lasted), "{lasted:?}");
}
