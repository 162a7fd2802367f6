//! What a template says about its workers, with real processes.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_daemon::process_manager::{Limits, Liveness, Parameter, ROLE, Readiness, Template};
use ratn_proto::types::ResourceEventKind;
use ratn_worker::client::ProcessClient;
use std::time::Duration;
use support::{DEADLINE, Daemon, TestSystem, in_time};

/// A shell that runs `script`.
fn shell(script: &str, readiness: Readiness) -> Template {
    Template {
        program: Some("/bin/sh".into()),
        args: vec!["-c".to_owned(), script.to_owned()],
        readiness,
        start_timeout_s: 15.0,
        ..Template::new("shell", "Shell")
    }
}

fn test_worker(args: &[&str], readiness: Readiness) -> Template {
    Template {
        program: Some(env!("CARGO_BIN_EXE_ratn-test-worker").into()),
        args: args.iter().map(|&arg| arg.to_owned()).collect(),
        readiness,
        start_timeout_s: 15.0,
        ..Template::new("quiet", "Quiet")
    }
}

fn line(contains: &str) -> Readiness {
    Readiness::Line { contains: contains.to_owned() }
}

/// Why the first pool has failed, once it has.
async fn failure(system: &TestSystem, processes: &Daemon) -> String {
    let client = system.processes(processes);
    in_time(async {
        loop {
            let pool = client.pools().await.unwrap().pools.remove(0);
            if !pool.failure.is_empty() {
                break pool.failure;
            }
            tokio::task::yield_now().await;
        }
    })
    .await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_worker_gets_its_parameters_a_clean_environment_its_directory_and_its_limits() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let mut watch = system.watch(&manager, &["Shell"]).await;
    // Cargo sets it for every test: whatever is not named stays behind.
    assert!(std::env::var_os("CARGO_MANIFEST_DIR").is_some() && std::env::var_os("CARGO_PKG_NAME").is_some());
    let script = "echo mode={mode} manifest=${CARGO_MANIFEST_DIR:-none} package=$CARGO_PKG_NAME level=$LEVEL; \
                  echo in=$(pwd); ulimit -n; echo up and running; exec cat";
    let template = Template {
        parameters: [
            ("mode".to_owned(), Parameter::Text { value: "fast".to_owned(), one_of: vec![] }),
            ("level".to_owned(), Parameter::Int { value: 7, min: Some(1), max: Some(9) }),
        ]
        .into(),
        env: [("LEVEL".to_owned(), "{level}".to_owned())].into(),
        pass_env: vec!["CARGO_PKG_NAME".to_owned()],
        directory: Some("/usr".into()),
        limits: Limits { open_files: Some(77), cpus: Some(1.0), ..Limits::default() },
        ..shell(script, line("and running"))
    };
    let processes = system.process_manager(vec![template]).await;
    let worker = watch.created("Shell").await;
    assert_eq!(worker.endpoint(), "", "it is no server");
    let log = std::fs::read_to_string(system.directory.path().join("logs/shell-1@compute.log")).unwrap();
    assert!(log.starts_with("mode=fast manifest=none package=ratn-daemon level=7\nin=/usr\n"), "{log}");
    let status = system.processes(&processes).pools().await.unwrap().pools[0].workers[0].clone();
    assert_eq!(status.limits, "cpus not limited: no cgroup, 77 open files (rlimit)");
    assert_eq!(open_files(status.pid), ["77", "77"]);
    processes.end().await;
}

/// The soft and the hard limit of a process.
fn open_files(pid: u32) -> [String; 2] {
    let limits = std::fs::read_to_string(format!("/proc/{pid}/limits")).unwrap();
    let files = limits.lines().find(|line| line.starts_with("Max open files")).unwrap();
    let mut words = files.split_whitespace().skip(3).map(str::to_owned);
    [words.next().unwrap(), words.next().unwrap()]
}

#[tokio::test(flavor = "multi_thread")]
async fn a_process_manager_may_open_all_files_that_it_can_and_its_worker_as_many_as_it_was_started_with() {
    let system = TestSystem::new();
    // A worker is ready when it has heard the resource manager.
    system.resource_manager().await;
    let (program, directory) = (env!("CARGO_BIN_EXE_ratn-test-worker"), system.directory.path());
    let script = r#"ulimit -Sn 300 && ulimit -Hn 900 && exec "$0" manage "$1""#;
    let mut command = tokio::process::Command::new("/bin/sh");
    let mut manager = command.args(["-c", script, program]).arg(directory).kill_on_drop(true).spawn().unwrap();
    let endpoint = system.directory.wait_for(ROLE, DEADLINE).await.unwrap();
    let client = ProcessClient::new(&system.channels, &endpoint).unwrap();
    let worker = in_time(async {
        loop {
            let worker = client.pools().await.unwrap().pools.remove(0).workers.pop();
            // It is ready after its limits were set.
            if let Some(worker) = worker.filter(|worker| !worker.endpoint.is_empty()) {
                break worker.pid;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    assert_eq!(open_files(worker), ["300", "900"]);
    assert_eq!(open_files(manager.id().unwrap()), ["900", "900"]);
    manager.kill().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_worker_is_ready_when_it_notifies() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let mut watch = system.watch(&manager, &["Quiet"]).await;
    let processes = system.process_manager(vec![test_worker(&["notify"], Readiness::Notify { watchdog: false })]).await;
    watch.created("Quiet").await;
    assert!(system.directory.path().join("quiet-1@compute.notify").exists());
    processes.end().await;
    assert!(!system.directory.path().join("quiet-1@compute.notify").exists());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_worker_is_ready_when_its_port_takes_connections() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let mut watch = system.watch(&manager, &["Quiet"]).await;
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let template = test_worker(&["port", &port.to_string()], Readiness::Port { port });
    let processes = system.process_manager(vec![template]).await;
    assert_eq!(watch.created("Quiet").await.endpoint(), format!("http://127.0.0.1:{port}"));
    processes.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn one_that_never_says_that_it_is_ready_is_killed_with_that_as_the_reason() {
    let system = TestSystem::new();
    let template =
        Template { start_timeout_s: 0.3, crash_limit: 1, ..shell("echo not quite; exec cat", line("ready")) };
    let processes = system.process_manager(vec![template]).await;
    let failure = failure(&system, &processes).await;
    let words = "1 crashes in a row; shell-1@compute: not ready within 0.3 s: no line of its standard output has `ready` in it; \
                 it was started as `/bin/sh -c echo not quite; exec cat`, and `ratn logs shell-1@compute` shows what it wrote; \
                 its last words: not quite";
    assert_eq!(failure, words);
    processes.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_directory_that_is_not_there_is_said() {
    let system = TestSystem::new();
    let template = Template { directory: Some("/no/such/place".into()), crash_limit: 1, ..shell("exit 0", line("x")) };
    let processes = system.process_manager(vec![template]).await;
    let failure = failure(&system, &processes).await;
    let words = "there is no directory /no/such/place";
    assert!(failure.contains(words), "{failure}");
    processes.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_template_is_started_after_those_it_waits_for() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let mut watch = system.watch(&manager, &["Quiet", "Shell"]).await;
    let second = Template { after: vec!["quiet".to_owned()], ..shell("echo here; exec cat", line("here")) };
    let processes =
        system.process_manager(vec![second, test_worker(&["notify"], Readiness::Notify { watchdog: false })]).await;
    let mut kinds = Vec::new();
    while kinds.len() < 2 {
        kinds
            .push(watch.event(|event| event.kind == ratn_proto::types::ResourceEventKind::Created).await.resource.kind);
    }
    assert_eq!(kinds, ["Quiet", "Shell"]);
    processes.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn who_does_not_say_any_more_that_it_lives_has_hung() {
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let mut watch = system.watch(&manager, &["Quiet"]).await;
    let liveness = Liveness { interval_s: 0.1, timeout_s: 0.4 };
    let template = Template { liveness, ..test_worker(&["watchdog", "8"], Readiness::Notify { watchdog: true }) };
    let processes = system.process_manager(vec![template]).await;
    let began = std::time::Instant::now();
    watch.created("Quiet").await;
    watch.event(|event| event.kind == ResourceEventKind::Deleted).await;
    assert!(began.elapsed() > Duration::from_millis(700), "it lived while it said so: {:?}", began.elapsed());
    // Its resource is gone before it is.
    let ended = async {
        loop {
            let pool = system.processes(&processes).pools().await.unwrap().pools.remove(0);
            if !pool.last_exit.is_empty() {
                return pool.last_exit;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    let last_exit = in_time(ended).await;
    assert!(last_exit.contains("hung: no WATCHDOG=1 within 0.4 s"), "{last_exit}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_worker_runs_as_the_user_that_its_template_says_without_other_groups() {
    if !nix::unistd::geteuid().is_root() {
        eprintln!("skipped: only root may run workers as another user");
        return;
    }
    let system = TestSystem::new();
    let manager = system.resource_manager().await;
    let mut watch = system.watch(&manager, &["Test"]).await;
    let program = Some("/bin/sh".into());
    let text = "echo as $(id -un) $(id -G) $USER; echo x > {endpoint_file}.mine && echo ready; exec cat";
    let args = vec!["-c".to_owned(), text.to_owned()];
    let user = Some("nobody".to_owned());
    let readiness = Readiness::Line { contains: "ready".to_owned() };
    let template = Template { program, args, user, readiness, ..Template::new("test", "Test") };
    let processes = system.process_manager(vec![template]).await;
    let worker = watch.created("Test").await;
    let mut log = system.processes(&processes).log(&worker.id, false).await.unwrap();
    let text = String::from_utf8(in_time(log.next()).await.unwrap().unwrap()).unwrap();
    let group = nix::unistd::User::from_name("nobody").unwrap().unwrap().gid;
    assert_eq!(text, format!("as nobody {group} nobody\nready\n"), "and it can write its endpoint file");
}
