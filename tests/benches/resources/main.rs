//! What the resource manager costs beside a bare echo, and beside etcd and Redis where they are installed: `scripts/bench-resources`
//! prints it as one JSON document. With `--world` it is what the world pool costs (`scripts/bench-world`): [`world`].
//!
//! Every server is a process of its own, on TCP over loopback; the echo's messages are those of a block. What is compared is measured
//! in turns, so that what else the machine does hits all alike.
//!
//! | key | what |
//! |---|---|
//! | `echo_…`, `stream_echo_…` | a question and its answer, as a call of its own and over one stream |
//! | `block_…`, `stream_block_…` | a block that is granted at once; `block_release_…` with its release. Without durability |
//! | `throughput_64_ops_s` | blocks and releases of 64 clients, each on its stream and waiting for every answer; `…_ahead`: each with 16 under way |
//! | `plain_sync_p50_us` | 200 bytes appended to a file and synced, in the same directory |
//! | `empty_…`, `crowded_…` | a block beside nothing, and beside 100,000 resources and 10,000 waiters; `explain_…` why one waits, or the first hundred; `resource_bytes` of memory; `restart_…` from the start of the process to its first answer |
//! | `durable_…` | the same with every acknowledgement on the disk (`--durability group`); `block3` is three kinds, all or none |

#![allow(clippy::unwrap_used, clippy::print_stdout, clippy::print_stderr, reason = "a benchmark prints and may panic")]

mod dashboard;
mod echo;
mod etcd;
mod hop;
mod line;
mod load;
mod process;
mod redis;
mod restart;
mod rivals;
mod times;
mod tiny;
mod world;

use etcd::Etcd;
use futures::StreamExt;
use futures::stream::FuturesUnordered;
use line::{Line, block, create, release};
use process::connect;
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use redis::Redis;
use serde_json::json;
use std::path::Path;
use std::time::Instant;
use times::{Times, plain_sync};
use tonic::transport::Channel;

/// Calls of one kind in a row, and how often the kinds take turns.
const CALLS: usize = 200;
const TURNS: usize = 15;
/// Clients at once for the throughput, each with a stream of its own.
const CLIENTS: usize = 64;
/// Blocks and releases of each of them, in all.
const PAIRS: usize = 1_600;
/// What one client has under way when it does not wait.
const AHEAD: usize = 16;
/// etcd's clients do fewer: it takes longer.
const ETCD_PAIRS: usize = 50;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["--worker", id, directory, endpoint_file] => return hop::work(id, directory, endpoint_file),
        ["--tiny", mib] => return tiny::work(mib, false),
        ["--tiny", mib, "staying"] => return tiny::work(mib, true),
        ["--systemd"] => return rivals::systemd(),
        _ => {}
    }
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
    if std::env::args().any(|argument| argument == "--echo") {
        return runtime.block_on(echo::serve());
    }
    if std::env::args().any(|argument| argument == "--world") {
        return runtime.block_on(world::measure());
    }
    if std::env::args().any(|argument| argument == "--hop") {
        return runtime.block_on(hop::measure());
    }
    if std::env::args().any(|argument| argument == "--dashboard") {
        return runtime.block_on(dashboard::measure());
    }
    if std::env::args().any(|argument| argument == "--restart") {
        return runtime.block_on(restart::measure());
    }
    runtime.block_on(measure());
}

async fn measure() {
    let directory = tempfile::tempdir().unwrap();
    let mut report = serde_json::Map::new();
    let mut note = |key: &str, value: f64| drop(report.insert(key.to_owned(), json!(value)));
    latency(directory.path(), &mut note).await;
    for (durability, prefix) in [("none", ""), ("group", "durable_")] {
        for (key, ahead) in [("throughput_64_ops_s", 1), ("throughput_64_ahead_ops_s", AHEAD)] {
            let place = directory.path().join(format!("{durability}-{ahead}"));
            note(&format!("{prefix}{key}"), throughput(&place, durability, ahead).await);
        }
    }
    load::measure(directory.path(), &mut note).await;
    rivals(directory.path(), &mut note).await;
    println!("{}", serde_json::to_string_pretty(&report).unwrap());
}

async fn latency(directory: &Path, note: &mut impl FnMut(&str, f64)) {
    let (_echo, echo) = process::echo();
    let (_volatile, volatile) = process::manager(&directory.join("volatile"), "none").await;
    let (_durable, durable) = process::manager(&directory.join("durable"), "group").await;
    let (echo, volatile, durable) = (connect(&echo).await, connect(&volatile).await, connect(&durable).await);
    let kinds = ["Arm", "Base", "Gripper"];
    let mut client = ResourceServiceClient::new(volatile.clone());
    let mut line = Line::open(volatile, "bench").await;
    create(&mut client, "bench", "Arm").await;
    let mut durable_line = Line::open(durable.clone(), "bench").await;
    for kind in kinds {
        create(&mut ResourceServiceClient::new(durable.clone()), "bench", kind).await;
    }
    let mut unary_echo = echo::Client::new(echo.clone());
    let mut stream_echo = echo::Line::open(echo).await;
    let [mut echoed, mut echoed_stream, mut blocked, mut pair, mut blocked_stream] = <[Times; 5]>::default();
    let [mut synced, mut durable_block, mut durable_three] = <[Times; 3]>::default();
    let mut number = 0;
    for _ in 0..TURNS {
        for _ in 0..CALLS {
            number += 1;
            let began = Instant::now();
            unary_echo.unary(block("bench", "Arm", number)).await;
            echoed.add(began);
        }
        for _ in 0..CALLS {
            number += 1;
            let began = Instant::now();
            let lease = client.block(block("bench", "Arm", number)).await.unwrap().into_inner().lease.unwrap().id;
            blocked.add(began);
            client.release(release("bench", lease)).await.unwrap();
            pair.add(began);
        }
        for _ in 0..CALLS {
            number += 1;
            let began = Instant::now();
            stream_echo.ask(block("bench", "Arm", number)).await;
            echoed_stream.add(began);
        }
        for _ in 0..CALLS {
            number += 1;
            let began = Instant::now();
            let lease = line.block("Arm", number).await;
            blocked_stream.add(began);
            line.release(lease).await;
        }
        plain_sync(directory, CALLS, &mut synced);
        for _ in 0..CALLS {
            number += 1;
            let began = Instant::now();
            let lease = durable_line.block("Arm", number).await;
            durable_block.add(began);
            durable_line.release(lease).await;
            let began = Instant::now();
            let lease = durable_line.acquire(&kinds, number).await;
            durable_three.add(began);
            durable_line.release(lease).await;
        }
    }
    note("echo_p50_us", echoed.at(0.5));
    note("block_p50_us", blocked.at(0.5));
    note("block_release_p50_us", pair.at(0.5));
    note("block_release_p99_us", pair.at(0.99));
    note("stream_echo_p50_us", echoed_stream.at(0.5));
    note("stream_block_p50_us", blocked_stream.at(0.5));
    note("stream_block_p99_us", blocked_stream.at(0.99));
    note("plain_sync_p50_us", synced.at(0.5));
    note("durable_block_p50_us", durable_block.at(0.5));
    note("durable_block3_p50_us", durable_three.at(0.5));
    note("durable_block3_p99_us", durable_three.at(0.99));
}

/// Blocks and releases per second of 64 clients, each on a stream of its own and with so many under way.
async fn throughput(directory: &Path, durability: &str, ahead: usize) -> f64 {
    let (_manager, manager) = process::manager(directory, durability).await;
    let channel: Channel = connect(&manager).await;
    let mut client = ResourceServiceClient::new(channel.clone());
    let mut lines = Vec::new();
    for number in 0..CLIENTS {
        let session = format!("client-{number}");
        let line = Line::open(channel.clone(), &session).await;
        let kinds: Vec<String> = (0..ahead).map(|lane| format!("Kind{number}-{lane}")).collect();
        for kind in &kinds {
            create(&mut client, &session, kind).await;
        }
        lines.push((line, kinds));
    }
    let began = Instant::now();
    let work =
        lines.into_iter().map(|(line, kinds)| tokio::spawn(async move { line.work(&kinds, PAIRS / ahead).await }));
    let work: FuturesUnordered<_> = work.collect();
    work.for_each(|done| async { done.unwrap() }).await;
    ((CLIENTS * PAIRS * 2) as f64 / began.elapsed().as_secs_f64()).round()
}

async fn rivals(directory: &Path, note: &mut impl FnMut(&str, f64)) {
    if let Some((_etcd, mut etcd)) = Etcd::start(directory).await {
        let mut times = Times::default();
        etcd.acquire_three(CALLS * TURNS / 3, &mut times).await;
        note("etcd_block3_p50_us", times.at(0.5));
        note("etcd_throughput_64_ops_s", etcd.throughput(CLIENTS, ETCD_PAIRS).await);
    }
    if let Some((_redis, mut redis)) = Redis::start(directory).await {
        let mut times = Times::default();
        redis.acquire_three(CALLS * TURNS, &mut times).await;
        note("redis_block3_p50_us", times.at(0.5));
    }
}
