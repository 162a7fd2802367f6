//! The worker that the process manager's tests start, kill and count. Test only.
//!
//! `ratn-test-worker serve ID KIND ENDPOINT_FILE` serves until its parent ends; `ratn-test-worker manage DIRECTORY` is a
//! process manager of one such worker; `ratn-test-worker notify` says to systemd's socket that it is ready, `ratn-test-worker port N`
//! listens on a port of loopback, both until their standard input ends; `ratn-test-worker fail` says why and exits.

use ratn_daemon::process_manager::{self, ProcessManagerConfig, Template};
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::worker::{Worker, WorkerOptions};
use std::process::ExitCode;
use tokio_util::sync::CancellationToken;

#[tokio::main]
async fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match words[..] {
        ["serve", id, kind, endpoint_file] => serve(id, kind, endpoint_file).await,
        ["manage", directory] => manage(directory).await,
        ["notify"] => notify().await,
        ["port", port] => listen(port).await,
        _ => {
            eprintln!("cannot open the model\nof the world");
            ExitCode::FAILURE
        }
    }
}

async fn notify() -> ExitCode {
    sd_notify::notify(&[sd_notify::NotifyState::Status("starting")]).expect("somebody listens");
    sd_notify::notify(&[sd_notify::NotifyState::Ready, sd_notify::NotifyState::Status("on")])
        .expect("somebody listens");
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

async fn manage(directory: &str) -> ExitCode {
    let args = ["serve", "{id}", "{kind}", "{endpoint_file}"].map(str::to_owned).to_vec();
    let template = Template { args, ..Template::new("planner", "PathPlanner") };
    let config = ProcessManagerConfig { session_ttl_ms: 300, templates: vec![template], ..Default::default() };
    let run = process_manager::run(config, RuntimeDirectory::at(directory), CancellationToken::new());
    match run.await {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
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
