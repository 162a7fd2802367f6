//! Asks etcd: one transaction at a time and caller, at the member that answered last, and at the next one when that does not answer.
//!
//! A transaction without an answer may have been performed, may be performed later, or never. Who asked has to find out:
//! every transaction that writes is therefore guarded so that it has no effect twice.
//!
//! The client has a thread of its own; callers block.

use super::wire::kv_client::KvClient;
use super::wire::{ResponseHeader, TxnRequest, TxnResponse};
use std::fmt;
use std::future::Future;
use std::sync::atomic::{AtomicI64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::time::{Duration, Instant};
use tokio::runtime::Runtime;
use tonic::transport::Channel;
use tonic::{Code, Status};

/// Makes the channel to a member of the cluster, by its address. Called within the client's runtime.
pub type Connect = Arc<dyn Fn(&str) -> Result<Channel, String> + Send + Sync>;

/// The largest answer: a page of frames.
const ANSWER_BYTES: usize = 256 << 20;

/// Why there is no answer.
#[derive(Debug, Clone)]
pub(super) enum CallError {
    /// Nobody answered in time: it may have been performed.
    Unknown(String),
    /// etcd has no space. It was not performed.
    NoSpace,
    /// It will not be performed, however often it is asked for.
    Refused(String),
    /// etcd knows less than it did: an old state was put in place of what it had.
    WentBack { known: i64, found: i64 },
}

impl fmt::Display for CallError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            CallError::Unknown(what) => write!(f, "etcd does not answer ({what})"),
            CallError::NoSpace => write!(
                f,
                "etcd has no space (its alarm NOSPACE): compact and defragment it, or raise --quota-backend-bytes, then `etcdctl alarm \
                 disarm`"
            ),
            CallError::Refused(what) => write!(f, "etcd refuses: {what}"),
            CallError::WentBack { known, found } => write!(
                f,
                "etcd was at revision {known} and now is at {found}: an older state of etcd was put in place, and what was acknowledged \
                 since then is gone"
            ),
        }
    }
}

/// A connection to every member.
pub(super) struct Client {
    members: Vec<Member>,
    /// Who answered last.
    current: AtomicUsize,
    /// The highest revision of etcd that was seen.
    seen: AtomicI64,
    connect: Connect,
    /// Taken when the client is dropped.
    runtime: Option<Runtime>,
}

struct Member {
    address: String,
    channel: Mutex<Option<Channel>>,
}

impl Client {
    pub(super) fn new(addresses: &[String], connect: Connect) -> std::io::Result<Client> {
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(1).thread_name("etcd").enable_all().build()?;
        let members =
            addresses.iter().map(|address| Member { address: address.clone(), channel: Mutex::default() }).collect();
        Ok(Client { members, current: AtomicUsize::new(0), seen: AtomicI64::new(0), connect, runtime: Some(runtime) })
    }

    /// The cluster, for messages.
    pub(super) fn place(&self) -> String {
        let addresses: Vec<&str> = self.members.iter().map(|member| member.address.as_str()).collect();
        addresses.join(", ")
    }

    /// Performs a transaction at the one member or, where that does not answer in time, says so; the next one is asked next. Blocks.
    pub(super) fn attempt(&self, request: TxnRequest, patience: Duration) -> Result<TxnResponse, CallError> {
        let known = self.seen.load(Ordering::SeqCst);
        let index = self.current.load(Ordering::SeqCst) % self.members.len().max(1);
        let answered = self.ask(index, request, patience);
        if let Err(CallError::Unknown(_)) = &answered {
            // Only if nobody else has moved on meanwhile.
            let next = (index + 1) % self.members.len().max(1);
            let _ = self.current.compare_exchange(index, next, Ordering::SeqCst, Ordering::SeqCst);
        }
        let answer = answered?;
        let found = answer.header.as_ref().map_or(0, |header| header.revision);
        if found < known {
            return Err(CallError::WentBack { known, found });
        }
        self.seen.fetch_max(found, Ordering::SeqCst);
        Ok(answer)
    }

    /// As [`Client::attempt`], again and again until the deadline: for what may be performed twice.
    pub(super) fn repeat(
        &self,
        request: &TxnRequest,
        patience: Duration,
        until: Instant,
    ) -> Result<TxnResponse, CallError> {
        let mut pause = FIRST_PAUSE;
        loop {
            match self.attempt(request.clone(), patience) {
                Err(CallError::Unknown(_)) if Instant::now() + pause < until => {
                    std::thread::sleep(pause);
                    pause = (2 * pause).min(LONGEST_PAUSE);
                }
                answered => return answered,
            }
        }
    }

    fn ask(&self, index: usize, request: TxnRequest, patience: Duration) -> Result<TxnResponse, CallError> {
        let unknown = |what: String| Err(CallError::Unknown(what));
        let (Some(member), Some(runtime)) = (self.members.get(index), &self.runtime) else {
            return unknown("no address of a member is given".to_owned());
        };
        let address = &member.address;
        let channel = {
            let _within = runtime.enter();
            let mut channel = member.channel.lock().unwrap_or_else(PoisonError::into_inner);
            match &*channel {
                Some(channel) => channel.clone(),
                None => match (self.connect)(address) {
                    Ok(new) => channel.insert(new).clone(),
                    Err(what) => return unknown(format!("{address}: {what}")),
                },
            }
        };
        let mut kv =
            KvClient::new(channel).max_decoding_message_size(ANSWER_BYTES).max_encoding_message_size(ANSWER_BYTES);
        let call = async move { tokio::time::timeout(patience, kv.txn(request)).await };
        match blocking(runtime, call) {
            Some(Ok(Ok(answer))) => Ok(answer.into_inner()),
            Some(Ok(Err(status))) => Err(classify(&status, address)),
            Some(Err(_)) => unknown(format!("{address} did not answer within {} ms", patience.as_millis())),
            None => unknown("the client is ending".to_owned()),
        }
    }
}

/// Before a call is tried again, doubled every time up to [`LONGEST_PAUSE`].
pub(super) const FIRST_PAUSE: Duration = Duration::from_millis(10);
pub(super) const LONGEST_PAUSE: Duration = Duration::from_millis(250);

/// Performs a future in a runtime, and waits for it in this thread, whatever runs there.
fn blocking<T: Send + 'static>(runtime: &Runtime, future: impl Future<Output = T> + Send + 'static) -> Option<T> {
    let (done, result) = mpsc::sync_channel(1);
    runtime.spawn(async move {
        let _ = done.send(future.await);
    });
    result.recv().ok()
}

fn classify(status: &Status, address: &str) -> CallError {
    let said = status.message();
    match status.code() {
        Code::ResourceExhausted if said.contains("space exceeded") => CallError::NoSpace,
        // Out of range: the revision that was asked for has been compacted.
        Code::InvalidArgument
        | Code::OutOfRange
        | Code::PermissionDenied
        | Code::Unauthenticated
        | Code::Unimplemented => CallError::Refused(format!("{address} says: {said}")),
        // Also what says that it was not performed: it is tried again anyhow.
        _ => CallError::Unknown(format!("{address}: {said}")),
    }
}

/// The cluster that answered.
pub(super) fn cluster_of(header: Option<&ResponseHeader>) -> u64 {
    header.map_or(0, |header| header.cluster_id)
}

impl fmt::Debug for Client {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Client").field("place", &self.place()).finish_non_exhaustive()
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        // Where it is dropped nobody may be allowed to wait.
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}
