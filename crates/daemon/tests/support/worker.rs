//! The worker that the process manager's tests start, kill and count. Test only.
//!
//! `ratn-test-worker serve ID KIND ENDPOINT_FILE` serves until its parent ends; `ratn-test-worker manage DIRECTORY` is a
//! process manager of one such worker, with `adopt GRACE_S` of one that is to be adopted, `adopt-other` of one that differs, `sleep` of one that
//! does not look at its standard input, `none WAY` of no worker, `many WAY NUMBER` of four that start more, `session WAY NUMBER` and
//! `clean-session WAY NUMBER` of one that sends a process away into another session; `ratn-test-worker resource-manager DIRECTORY` is a resource manager; `ratn-test-worker notify` says to systemd's socket that it is ready, `ratn-test-worker watchdog N` besides N times
//! that it lives, `ratn-test-worker port N`
//! listens on a port of loopback, both until their standard input ends; `ratn-test-worker fail` says why and exits.

use ratn_daemon::process_manager::{self, ProcessManagerConfig, Readiness, Template, Tracking};
use ratn_daemon::resource_manager;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::shutdown;
use ratn_worker::worker::{Worker, WorkerOptions};
use std::process::ExitCode;
use tokio_util::sync::CancellationToken;

#[tokio::main]
async fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match words[..] {
        ["serve", id, kind, endpoint_file] => serve(id, kind, endpoint_file).await,
        ["manage", directory] => manage(directory, Template::new("planner", "PathPlanner")).await,
        ["manage", directory, "adopt", grace_s] => manage(directory, adoptable(grace_s)).await,
        ["manage", directory, "adopt-other", grace_s] => {
            let env = [("COLOUR".to_owned(), "blue".to_owned())].into();
            manage(directory, Template { env, ..adoptable(grace_s) }).await
        }
        ["manage", directory, "sleep"] => manage(directory, shell("echo ready; sleep 1000 & wait")).await,
        ["manage", directory, "none", way] => manage_as(directory, way, Vec::new()).await,
        ["manage", directory, "many", way, number] => {
            let script = format!("sleep {number} & setsid sleep {number} & exec sleep {number}");
            let many = Template { min: 4, max: Some(4), ..shell(&script) };
            manage_as(directory, way, vec![many]).await
        }
        ["manage", directory, "session", way, number] => {
            let script = format!("setsid sleep {number} & echo ready; exec sleep {number}");
            manage_as(directory, way, vec![shell(&script)]).await
        }
        ["manage", directory, "clean-session", way, number] => {
            let script = format!("env -i setsid sleep {number} & echo ready; exec sleep {number}");
            manage_as(directory, way, vec![shell(&script)]).await
        }
        ["resource-manager", directory] => manage_resources(directory).await,
        ["notify"] => notify().await,
        ["watchdog", times] => watchdog(times).await,
        ["port", port] => listen(port).await,
        _ => {
            eprintln!("cannot open the model\nof the world");
            ExitCode::FAILURE
        }
    }
}

async fn manage_resources(directory: &str) -> ExitCode {
    let directory = RuntimeDirectory::create(directory).expect("a runtime directory");
    let shutdown = tokio_util::sync::CancellationToken::new();
    let running = resource_manager::run(Default::default(), directory, shutdown.clone());
    tokio::spawn(async move {
        until_input_ends().await;
        shutdown.cancel();
    });
    running.await.expect("a resource manager");
    ExitCode::SUCCESS
}

async fn notify() -> ExitCode {
    sd_notify::notify(&[sd_notify::NotifyState::Status("starting")]).expect("somebody listens");
    sd_notify::notify(&[sd_notify::NotifyState::Ready, sd_notify::NotifyState::Status("on")])
        .expect("somebody listens");
    until_input_ends().await
}

/// Says so often that it lives, and then no more.
async fn watchdog(times: &str) -> ExitCode {
    sd_notify::notify(&[sd_notify::NotifyState::Ready]).expect("somebody listens");
    let patience = sd_notify::watchdog_enabled().expect("a watchdog");
    for _ in 0..times.parse().expect("a number") {
        tokio::time::sleep(patience / 4).await;
        sd_notify::notify(&[sd_notify::NotifyState::Watchdog]).expect("somebody listens");
    }
    until_input_ends().await
}

async fn listen(port: &str) -> ExitCode {
    let _listener = std::net::TcpListener::bind(("127.0.0.1", port.parse().expect("a number"))).expect("a free port");
    until_input_ends().await
}

async fn until_input_ends() -> ExitCode {
    let _ = tokio::io::copy(&mut tokio::io::stdin(), &mut tokio::io::sink()).await;
    ExitCode::SUCCESS
}

fn adoptable(grace_s: &str) -> Template {
    let adopt_grace_s = grace_s.parse().expect("a number");
    Template { adopt: true, adopt_grace_s, ..Template::new("planner", "PathPlanner") }
}

/// A worker that does not look at its standard input.
fn shell(script: &str) -> Template {
    let program = Some("/bin/sh".into());
    let args = ["-c", script].map(str::to_owned).to_vec();
    let readiness = Readiness::Line { contains: "ready".to_owned() };
    Template { program, args, readiness, ..Template::new("planner", "PathPlanner") }
}

/// In a process of its own, until a signal; `way` is how the processes of workers are kept track of.
async fn manage_as(directory: &str, way: &str, templates: Vec<Template>) -> ExitCode {
    let tracking = match way {
        "cgroup" => Tracking::Cgroup,
        _ => Tracking::Environment,
    };
    let config =
        ProcessManagerConfig { session_ttl_ms: 300, templates, tracking, owns_process: true, ..Default::default() };
    let shutdown = CancellationToken::new();
    shutdown::on_signals(&shutdown).expect("signals can be caught");
    exit_code(process_manager::run(config, RuntimeDirectory::at(directory), shutdown).await)
}

async fn manage(directory: &str, template: Template) -> ExitCode {
    let args = ["serve", "{id}", "{kind}", "{endpoint_file}"].map(str::to_owned).to_vec();
    let template = if template.args.is_empty() { Template { args, ..template } } else { template };
    let session_ttl_ms = if template.adopt { 5_000 } else { 300 };
    let config = ProcessManagerConfig { session_ttl_ms, templates: vec![template], ..Default::default() };
    exit_code(process_manager::run(config, RuntimeDirectory::at(directory), CancellationToken::new()).await)
}

fn exit_code(ended: anyhow::Result<()>) -> ExitCode {
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error:#}");
            ExitCode::FAILURE
        }
    }
}

async fn serve(id: &str, kind: &str, endpoint_file: &str) -> ExitCode {
    let options = WorkerOptions {
        id: id.to_owned(),
        kind: kind.to_owned(),
        endpoint_file: Some(endpoint_file.into()),
        exit_with_parent: true,
        ..WorkerOptions::default()
    };
    match Worker::new(options).run().await {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}
