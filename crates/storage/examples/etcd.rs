//! The log in etcd beside plain transactions of etcd and the log in files, in one run.
//!
//!     cargo run --release -p ratn-storage --example etcd -- ENDPOINT[,ENDPOINT…] [DIRECTORY]
//!
//! A plain transaction puts one record of 200 bytes if a key is as it was; 64 clients have 64 keys. Of the log every record is waited for.
#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a measurement")]

#[allow(unreachable_pub, dead_code, clippy::all, clippy::allow_attributes_without_reason, reason = "generated code")]
mod wire {
    include!("../src/generated/etcdserverpb.rs");
}

use ratn_storage::etcd::{Bounds, Connect, Holder};
use ratn_storage::{Etcd, EtcdOptions, Log, Options, Store, Writer};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tonic::transport::{Channel, Endpoint};
use wire::kv_client::KvClient;

const RECORD: [u8; 200] = [7; 200];
const CLIENTS: usize = 64;
const AHEAD: usize = 64;
const TIME: Duration = Duration::from_secs(5);

fn main() {
    let mut arguments = std::env::args().skip(1);
    let endpoints: Vec<String> = arguments.next().unwrap().split(',').map(str::to_owned).collect();
    let directory = arguments.next().map_or_else(std::env::temp_dir, Into::into);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    let channel = |address: &str| Endpoint::from_shared(address.to_owned()).unwrap().tcp_nodelay(true).connect_lazy();
    let plain = |clients: usize| {
        let channels: Vec<Channel> = {
            let _within = runtime.enter();
            endpoints.iter().map(|address| channel(address)).collect()
        };
        runtime.block_on(plain(&channels, clients))
    };
    let connect: Connect = Arc::new(move |address| Ok(channel(address)));
    let log = |name: &str| {
        Etcd::new(EtcdOptions {
            endpoints: endpoints.clone(),
            connect: connect.clone(),
            prefix: format!("/measured/{name}-{}", std::process::id()),
            holder: Holder::default(),
            bounds: Bounds::default(),
            mark: None,
            accept_restored: None,
        })
        .unwrap()
    };
    // Turn about, so that all see the same machine.
    for round in 1..=3 {
        println!("round {round}");
        let one = plain(1);
        println!("  plain transactions, 1 client:     {one}");
        println!("  log in etcd, 1 client:            {}", waited(log("one").open().unwrap().1, 1, 1).beside(&one));
        let many = plain(CLIENTS);
        println!("  plain transactions, {CLIENTS} clients:   {many}");
        let each = waited(log("each").open().unwrap().1, CLIENTS, 1).beside(&many);
        println!("  log in etcd, {CLIENTS} clients:          {each}");
        let ahead = waited(log("ahead").open().unwrap().1, CLIENTS, AHEAD).beside(&many);
        println!("  the same, each {AHEAD} records ahead:   {ahead}");
        let place = tempfile::tempdir_in(&directory).unwrap();
        let files = Log::new(place.path().join("log"), Options::default());
        println!("  log in files, {CLIENTS} clients:         {}", waited(files.open().unwrap().1, CLIENTS, 1));
    }
}

/// What so many clients got done.
struct Done {
    a_second: f64,
    p50: Duration,
}

impl Done {
    fn of(mut took: Vec<Duration>, elapsed: Duration) -> Done {
        took.sort_unstable();
        Done { a_second: took.len() as f64 / elapsed.as_secs_f64(), p50: took[took.len() / 2] }
    }

    fn beside(&self, plain: &Done) -> String {
        let (times, ratio) = (self.a_second / plain.a_second, self.p50.as_secs_f64() / plain.p50.as_secs_f64());
        format!("{self}; {times:.1} x the throughput, {ratio:.2} x the p50")
    }
}

impl std::fmt::Display for Done {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:.0}/s, p50 {} us", self.a_second, self.p50.as_micros())
    }
}

async fn plain(channels: &[Channel], clients: usize) -> Done {
    static BEGUN: AtomicUsize = AtomicUsize::new(0);
    let begun = BEGUN.fetch_add(1, Ordering::Relaxed);
    let begin = Instant::now();
    let tasks: Vec<_> = (0..clients)
        .map(|client| {
            let mut kv = KvClient::new(channels[client % channels.len()].clone());
            tokio::spawn(async move {
                let key = bytes::Bytes::from(format!("/plain/{}/{begun}/{client}", std::process::id()));
                let (mut revision, mut took) = (0, Vec::new());
                while begin.elapsed() < TIME {
                    let asked = Instant::now();
                    let compare = wire::Compare {
                        result: wire::compare::CompareResult::Equal.into(),
                        target: wire::compare::CompareTarget::Mod.into(),
                        key: key.clone(),
                        target_union: Some(wire::compare::TargetUnion::ModRevision(revision)),
                    };
                    let put = wire::PutRequest { key: key.clone(), value: bytes::Bytes::from_static(&RECORD) };
                    let put = wire::RequestOp { request: Some(wire::request_op::Request::RequestPut(put)) };
                    let request = wire::TxnRequest { compare: vec![compare], success: vec![put], failure: Vec::new() };
                    let answer = kv.txn(request).await.unwrap().into_inner();
                    assert!(answer.succeeded);
                    revision = answer.header.unwrap().revision;
                    took.push(asked.elapsed());
                }
                took
            })
        })
        .collect();
    let mut took = Vec::new();
    for task in tasks {
        took.extend(task.await.unwrap());
    }
    Done::of(took, begin.elapsed())
}

/// Each client appends so many records before it waits for them.
fn waited(writer: Box<dyn Writer>, clients: usize, ahead: usize) -> Done {
    let (durable, writer) = (writer.durable(), Mutex::new(writer));
    let begin = Instant::now();
    let took: Vec<Duration> = std::thread::scope(|scope| {
        let clients: Vec<_> = (0..clients)
            .map(|_| {
                let (mut durable, writer) = (durable.clone(), &writer);
                scope.spawn(move || {
                    let mut took = Vec::new();
                    while begin.elapsed() < TIME {
                        let asked = Instant::now();
                        let append = |_| writer.lock().unwrap().append(&RECORD).unwrap();
                        let position = (0..ahead).map(append).last().unwrap();
                        durable.wait_blocking(position).unwrap();
                        took.extend(std::iter::repeat_n(asked.elapsed(), ahead));
                    }
                    took
                })
            })
            .collect();
        clients.into_iter().flat_map(|client| client.join().unwrap()).collect()
    });
    let elapsed = begin.elapsed();
    writer.into_inner().unwrap().close().unwrap();
    Done::of(took, elapsed)
}
