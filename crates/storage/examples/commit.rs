//! What a durable commit costs, beside a plain append and fdatasync in the same directory, in turns.
//!
//! `cargo run --release -p ratn-storage --example commit [DIRECTORY]`; prints JSON. On a disk whose syncs take milliseconds the rest
//! does not show: give a directory in memory (`/dev/shm`) to see what the log itself costs.

#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "an example prints and may panic")]

use ratn_storage::{Durability, Log, Options, Position, Store, Writer};
use std::cell::RefCell;
use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::rc::Rc;
use std::time::{Duration, Instant};

/// As three small puts.
const RECORD: [u8; 200] = [7; 200];
const ROUNDS: usize = 5;
const COMMITS: usize = 200;
const WRITERS: usize = 64;
const TOGETHER: Duration = Duration::from_millis(500);
const APPENDS: usize = 100_000;

fn main() {
    let place = match std::env::args_os().nth(1) {
        Some(directory) => tempfile::tempdir_in(directory).unwrap(),
        None => tempfile::tempdir().unwrap(),
    };
    let (mut plain, mut log) = (Vec::new(), Vec::new());
    for round in 0..ROUNDS {
        plain.extend(plain_commits(&place.path().join(format!("plain-{round}"))));
        log.extend(log_commits(&place.path().join(format!("log-{round}"))));
    }
    let (plain, log) = (median(plain), median(log));
    let append = append_only(&place.path().join("none"));
    let recovery = recovery(&place.path().join("none"));
    let together = together(&place.path().join("together"), 1);
    let ahead = self::together(&place.path().join("ahead"), 64);
    println!(
        "{{\"plain_append_fdatasync_p50_us\": {plain:.1}, \"log_commit_p50_us\": {log:.1}, \"ratio\": {:.2}, \
         \"append_ns\": {append:.0}, \"recovery_100000_ms\": {recovery:.1}, \"writers_64_records_s\": {together:.0}, \"writers_64_each_64_ahead_records_s\": {ahead:.0}}}",
        log / plain
    );
}

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

fn microseconds(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e6
}

fn plain_commits(path: &Path) -> Vec<f64> {
    let mut file = File::create(path).unwrap();
    let mut commit = || {
        let begin = Instant::now();
        file.write_all(&RECORD).unwrap();
        file.sync_data().unwrap();
        microseconds(begin)
    };
    (0..COMMITS).map(|_| commit()).collect()
}

fn log_commits(path: &Path) -> Vec<f64> {
    let (_, mut writer) = Log::new(path, Options::default()).open().unwrap();
    let mut durable = writer.durable();
    let mut commit = || {
        let begin = Instant::now();
        let position = writer.append(&RECORD).unwrap();
        durable.wait_blocking(position).unwrap();
        microseconds(begin)
    };
    (0..COMMITS).map(|_| commit()).collect()
}

/// Nanoseconds of an append, without waiting.
fn append_only(path: &Path) -> f64 {
    let options = Options { durability: Durability::None, ..Options::default() };
    let (_, mut writer) = Log::new(path, options).open().unwrap();
    let begin = Instant::now();
    for _ in 0..APPENDS {
        writer.append(&RECORD).unwrap();
    }
    microseconds(begin) * 1e3 / APPENDS as f64
}

/// Milliseconds until a log of so many records can be written again.
fn recovery(path: &Path) -> f64 {
    let begin = Instant::now();
    let (recovered, _writer) = Log::new(path, Options::default()).open().unwrap();
    let milliseconds = microseconds(begin) / 1e3;
    assert_eq!(recovered.records.len(), APPENDS);
    milliseconds
}

/// Records per second of many writers behind one log, each of which waits when it has so many that are not durable.
fn together(path: &Path, ahead: u64) -> f64 {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
    let (_, writer) = Log::new(path, Options::default()).open().unwrap();
    let writer: Rc<RefCell<Box<dyn Writer>>> = Rc::new(RefCell::new(writer));
    let begin = Instant::now();
    let tasks = tokio::task::LocalSet::new();
    for _ in 0..WRITERS {
        let writer = writer.clone();
        tasks.spawn_local(async move {
            let mut durable = writer.borrow().durable();
            while begin.elapsed() < TOGETHER {
                let mut last = Position(0);
                for _ in 0..ahead {
                    last = writer.borrow_mut().append(&RECORD).unwrap();
                }
                durable.wait(last).await.unwrap();
            }
        });
    }
    runtime.block_on(tasks);
    let elapsed = begin.elapsed().as_secs_f64();
    let records = writer.borrow().durable().progress().durable.0;
    records as f64 / elapsed
}
