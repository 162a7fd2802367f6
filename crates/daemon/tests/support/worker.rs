//! The worker that the process manager's tests start, kill and count. Test only.
//!
//! `ratn-test-worker serve ID KIND ENDPOINT_FILE` serves until its parent ends; `ratn-test-worker fail` says why and exits.

use ratn_worker::worker::{Worker, WorkerOptions};
use std::process::ExitCode;

#[tokio::main]
async fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let ["serve", id, kind, endpoint_file] = words[..] else {
        eprintln!("cannot open the model\nof the world");
        return ExitCode::FAILURE;
    };
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
