//! What the resource manager costs beside a bare echo: `scripts/bench-resources` prints it as one JSON document.
//!
//! The manager and the echo are processes of their own, on TCP over loopback; the echo's messages are those of a block. Echo and
//! manager are measured in turns, so that what else the machine does hits both alike.

#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a benchmark prints and may panic")]

mod echo;

use futures::StreamExt;
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use ratn_proto::v1::{self, session_request, session_response};
use serde_json::json;
use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Streaming;
use tonic::transport::{Channel, Endpoint};

/// Calls of one kind in a row, and how often the kinds take turns.
const CALLS: usize = 500;
const TURNS: usize = 10;
/// Clients at once for the throughput, each with a stream and a resource of its own.
const CLIENTS: usize = 64;
/// What each of them does: a block and a release.
const PAIRS: usize = 2_000;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
    if arguments.iter().any(|argument| argument == "--echo") {
        return runtime.block_on(echo::serve());
    }
    runtime.block_on(measure());
}

/// A process that ends with this.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn start_echo() -> (Process, String) {
    let mut child =
        Command::new(std::env::current_exe().unwrap()).arg("--echo").stdout(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    (Process(child), line.trim().to_owned())
}

async fn start_manager(directory: &std::path::Path, more: &[&str]) -> (Process, String) {
    let child = Command::new(env!("CARGO_BIN_EXE_ratn-under-test"))
        .args(["resource-manager", "--listen", "127.0.0.1:0", "--runtime-dir"])
        .arg(directory)
        .args(more)
        .env("RUST_LOG", "warn")
        .spawn()
        .unwrap();
    let file = directory.join("resource-manager.endpoint");
    let endpoint = loop {
        match std::fs::read_to_string(&file) {
            Ok(endpoint) if !endpoint.trim().is_empty() => break endpoint.trim().to_owned(),
            _ => tokio::time::sleep(Duration::from_millis(5)).await,
        }
    };
    (Process(child), endpoint)
}

async fn connect(endpoint: &str) -> Channel {
    Endpoint::from_shared(endpoint.to_owned()).unwrap().tcp_nodelay(true).connect().await.unwrap()
}

/// Microseconds of every call, sorted.
#[derive(Default)]
struct Times(Vec<f64>);

impl Times {
    fn add(&mut self, began: Instant) {
        self.0.push(began.elapsed().as_secs_f64() * 1e6);
    }

    fn at(&mut self, part: f64) -> f64 {
        self.0.sort_by(f64::total_cmp);
        let index = ((self.0.len() - 1) as f64 * part) as usize;
        (self.0[index] * 10.0).round() / 10.0
    }
}

fn block(session: &str, kind: &str, number: usize) -> v1::BlockRequest {
    v1::BlockRequest {
        request_id: format!("bench/{kind}/{number}"),
        session_id: session.to_owned(),
        requirement: Some(v1::Requirement {
            operation: v1::ResourceOperation::Block.into(),
            kind: kind.to_owned(),
            count: 1,
            ..Default::default()
        }),
        priority: 0,
        deadline_ms: 10_000,
        holder: "fetch_boxes/place_all[2]/plan_transfer".to_owned(),
    }
}

fn release(session: &str, lease: &v1::Lease) -> v1::ResourceServiceReleaseRequest {
    v1::ResourceServiceReleaseRequest {
        request_id: format!("bench/release/{}", lease.id),
        session_id: session.to_owned(),
        lease_id: lease.id,
    }
}

/// One end of a session's stream that asks one thing at a time.
struct Line {
    session: String,
    questions: mpsc::Sender<v1::SessionRequest>,
    answers: Streaming<v1::SessionResponse>,
    next: u64,
}

impl Line {
    async fn open(channel: Channel, session: &str) -> Line {
        let (questions, outgoing) = mpsc::channel(16);
        let ping = v1::KeepAliveRequest { session_id: session.to_owned(), ttl_ms: 60_000, client: "bench".to_owned() };
        let first = v1::SessionRequest { id: 0, kind: Some(session_request::Kind::KeepAlive(ping)) };
        questions.send(first).await.unwrap();
        let mut client = ResourceServiceClient::new(channel);
        let mut answers = client.session(ReceiverStream::new(outgoing)).await.unwrap().into_inner();
        answers.message().await.unwrap().unwrap();
        Line { session: session.to_owned(), questions, answers, next: 1 }
    }

    async fn ask(&mut self, kind: session_request::Kind) -> session_response::Kind {
        let id = self.next;
        self.next += 1;
        self.questions.send(v1::SessionRequest { id, kind: Some(kind) }).await.unwrap();
        let answer = self.answers.message().await.unwrap().unwrap();
        assert_eq!(answer.id, id, "one question at a time");
        answer.kind.unwrap()
    }

    async fn block(&mut self, kind: &str, number: usize) -> v1::Lease {
        match self.ask(session_request::Kind::Block(block(&self.session, kind, number))).await {
            session_response::Kind::Block(granted) => granted.lease.unwrap(),
            other => panic!("no lease but {other:?}"),
        }
    }

    async fn release(&mut self, lease: &v1::Lease) {
        match self.ask(session_request::Kind::Release(release(&self.session, lease))).await {
            session_response::Kind::Release(_) => {}
            other => panic!("not released but {other:?}"),
        }
    }
}

async fn create(client: &mut ResourceServiceClient<Channel>, session: &str, kind: &str) {
    let resource = v1::Resource {
        id: format!("{kind}-1"),
        class: v1::ResourceClass::Module.into(),
        kind: kind.to_owned(),
        capacity: 1,
        ..Default::default()
    };
    let request_id = format!("bench/create/{kind}");
    let session_id = session.to_owned();
    client.create(v1::CreateRequest { request_id, session_id, resource: Some(resource) }).await.unwrap();
}

async fn measure() {
    let directory = tempfile::tempdir().unwrap();
    let (_echo, echo) = start_echo();
    let (_manager, manager) = start_manager(directory.path(), &[]).await;
    let (echo, manager) = (connect(&echo).await, connect(&manager).await);
    let mut line = Line::open(manager.clone(), "bench").await;
    let mut client = ResourceServiceClient::new(manager.clone());
    create(&mut client, "bench", "Arm").await;

    let mut unary_echo = echo::Client::new(echo.clone());
    let mut stream_echo = echo::Line::open(echo.clone()).await;
    let mut times: [Times; 5] = Default::default();
    let [echoed, echoed_stream, blocked, pair, blocked_stream] = &mut times;
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
            let lease = client.block(block("bench", "Arm", number)).await.unwrap().into_inner().lease.unwrap();
            blocked.add(began);
            client.release(release("bench", &lease)).await.unwrap();
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
            line.release(&lease).await;
        }
    }
    let throughput = throughput(&manager).await;
    let report = json!({
        "echo_p50_us": times[0].at(0.5),
        "stream_echo_p50_us": times[1].at(0.5),
        "block_p50_us": times[2].at(0.5),
        "block_release_p50_us": times[3].at(0.5),
        "block_release_p99_us": times[3].at(0.99),
        "stream_block_p50_us": times[4].at(0.5),
        "stream_block_p99_us": times[4].at(0.99),
        "throughput_64_ops_s": throughput,
    });
    println!("{}", serde_json::to_string_pretty(&report).unwrap());
}

/// Blocks and releases per second of 64 clients, each on a stream of its own.
async fn throughput(manager: &Channel) -> f64 {
    let mut client = ResourceServiceClient::new(manager.clone());
    let mut lines = Vec::new();
    for number in 0..CLIENTS {
        let session = format!("client-{number}");
        let line = Line::open(manager.clone(), &session).await;
        let kind = format!("Kind{number}");
        create(&mut client, &session, &kind).await;
        lines.push((line, kind));
    }
    let began = Instant::now();
    let work = lines.into_iter().map(|(mut line, kind)| {
        tokio::spawn(async move {
            for number in 0..PAIRS {
                let lease = line.block(&kind, number).await;
                line.release(&lease).await;
            }
        })
    });
    let work: futures::stream::FuturesUnordered<_> = work.collect();
    work.for_each(|done| async { done.unwrap() }).await;
    ((CLIENTS * PAIRS * 2) as f64 / began.elapsed().as_secs_f64()).round()
}
