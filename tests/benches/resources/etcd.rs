//! etcd, if it is installed: three keys that nobody has, taken all or none in one transaction, and given back in another.
//!
//! Its messages as its public API describes them (`etcdserverpb.KV/Txn`), as far as they are needed here.

use super::process::{Process, connect, installed};
use super::times::Times;
use futures::StreamExt;
use futures::stream::FuturesUnordered;
use std::path::Path;
use std::time::Instant;
use tonic::Request;
use tonic::codegen::http::uri::PathAndQuery;
use tonic::transport::Channel;
use tonic_prost::ProstCodec;

#[derive(Clone, PartialEq, prost::Message)]
struct TxnRequest {
    #[prost(message, repeated, tag = "1")]
    compare: Vec<Compare>,
    #[prost(message, repeated, tag = "2")]
    success: Vec<RequestOp>,
}

/// `result` 0 is "equal", `target` 1 is the revision at which the key was created: 0 where there is none.
#[derive(Clone, PartialEq, prost::Message)]
struct Compare {
    #[prost(int32, tag = "1")]
    result: i32,
    #[prost(int32, tag = "2")]
    target: i32,
    #[prost(bytes = "vec", tag = "3")]
    key: Vec<u8>,
    #[prost(int64, optional, tag = "5")]
    create_revision: Option<i64>,
}

#[derive(Clone, PartialEq, prost::Message)]
struct RequestOp {
    #[prost(message, optional, tag = "2")]
    put: Option<Put>,
    #[prost(message, optional, tag = "3")]
    delete: Option<Delete>,
}

#[derive(Clone, PartialEq, prost::Message)]
struct Put {
    #[prost(bytes = "vec", tag = "1")]
    key: Vec<u8>,
    #[prost(bytes = "vec", tag = "2")]
    value: Vec<u8>,
}

#[derive(Clone, PartialEq, prost::Message)]
struct Delete {
    #[prost(bytes = "vec", tag = "1")]
    key: Vec<u8>,
}

#[derive(Clone, PartialEq, prost::Message)]
struct TxnResponse {
    #[prost(bool, tag = "2")]
    succeeded: bool,
}

#[derive(Clone)]
pub(crate) struct Etcd {
    grpc: tonic::client::Grpc<Channel>,
}

impl Etcd {
    pub(crate) async fn start(directory: &Path) -> Option<(Process, Etcd)> {
        let data = directory.join("etcd").display().to_string();
        let arguments = |port| {
            let client = format!("http://127.0.0.1:{port}");
            let options = ["--listen-client-urls", &client, "--advertise-client-urls", &client, "--data-dir", &data];
            let mut options: Vec<String> = options.iter().map(|&option| option.to_owned()).collect();
            // It keeps to itself: the port of its peers is any.
            options.extend(["--listen-peer-urls", "http://127.0.0.1:0"].map(str::to_owned));
            options
        };
        let (process, port) = installed("etcd", arguments).await?;
        let grpc = tonic::client::Grpc::new(connect(&format!("http://127.0.0.1:{port}")).await);
        let mut etcd = Etcd { grpc };
        // It listens before it has elected itself.
        let began = Instant::now();
        while etcd.acquire(&["first"]).await != Some(true) {
            assert!(began.elapsed().as_secs() < 10, "etcd does not take a key");
            tokio::time::sleep(std::time::Duration::from_millis(100)).await;
        }
        Some((process, etcd))
    }

    async fn txn(&mut self, request: TxnRequest) -> Option<bool> {
        self.grpc.ready().await.ok()?;
        let codec = ProstCodec::<TxnRequest, TxnResponse>::default();
        let path = PathAndQuery::from_static("/etcdserverpb.KV/Txn");
        let answer = self.grpc.unary(Request::new(request), path, codec).await.ok()?;
        Some(answer.into_inner().succeeded)
    }

    async fn acquire(&mut self, keys: &[&str]) -> Option<bool> {
        let compare =
            |key: &&str| Compare { result: 0, target: 1, key: key.as_bytes().to_vec(), create_revision: Some(0) };
        let put = |key: &&str| RequestOp {
            put: Some(Put { key: key.as_bytes().to_vec(), value: b"fetch_boxes/place_all[2]/plan_transfer".to_vec() }),
            delete: None,
        };
        let request =
            TxnRequest { compare: keys.iter().map(compare).collect(), success: keys.iter().map(put).collect() };
        self.txn(request).await
    }

    async fn release(&mut self, keys: &[&str]) -> Option<bool> {
        let delete = |key: &&str| RequestOp { put: None, delete: Some(Delete { key: key.as_bytes().to_vec() }) };
        self.txn(TxnRequest { compare: Vec::new(), success: keys.iter().map(delete).collect() }).await
    }

    pub(crate) async fn acquire_three(&mut self, count: usize, times: &mut Times) {
        let keys = ["a", "b", "c"];
        for _ in 0..count {
            let began = Instant::now();
            assert_eq!(self.acquire(&keys).await, Some(true), "nobody has them");
            times.add(began);
            assert_eq!(self.release(&keys).await, Some(true));
        }
    }

    /// Acquires and releases of one key per second, of so many clients.
    pub(crate) async fn throughput(&self, clients: usize, pairs: usize) -> f64 {
        let began = Instant::now();
        let work = (0..clients).map(|client| {
            let mut etcd = self.clone();
            tokio::spawn(async move {
                let key = format!("client-{client}");
                for _ in 0..pairs {
                    assert_eq!(etcd.acquire(&[&key]).await, Some(true), "nobody has it");
                    assert_eq!(etcd.release(&[&key]).await, Some(true));
                }
            })
        });
        let work: FuturesUnordered<_> = work.collect();
        work.for_each(|done| async { done.unwrap() }).await;
        ((clients * pairs * 2) as f64 / began.elapsed().as_secs_f64()).round()
    }
}
