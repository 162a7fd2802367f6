//! The client of etcd: asks the member that answered last, and after a short silence the next one, too; the first answer counts.
//!
//! A transaction without an answer may have been performed, may be performed later, or never. One with an answer may be performed once
//! more, by a late copy. So every transaction that writes is guarded such that it cannot have an effect twice ([`super::chain`]).
//!
//! A client belongs to one cluster: the first that answers, or the one given to [`Client::pin`]. A member that answers for another cluster
//! was set up anew, or belongs to another system: it counts as a member that refuses.
//!
//! The client has a thread of its own; callers block. A panic in one of its tasks is passed on to the caller.

use super::wire::kv_client::KvClient;
use super::wire::{ResponseHeader, TxnRequest, TxnResponse};
use ratn_panic_point::panic_point;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::future::Future;
use std::panic::resume_unwind;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError, mpsc};
use std::time::{Duration, Instant};
use tokio::runtime::Runtime;
use tokio::task::{JoinError, JoinSet};
use tonic::transport::Channel;
use tonic::{Code, Status};

/// Makes the channel to a member of the cluster, by its address. Called within the client's runtime.
pub type Connect = Arc<dyn Fn(&str) -> Result<Channel, String> + Send + Sync>;

/// Maximum size of an answer: a page of frames ([`super::contents`]), with room to spare.
const ANSWER_BYTES: usize = 512 << 20;
/// Hedging delay: if a member has not answered within this time, the next one is asked as well.
const HEDGE: Duration = Duration::from_millis(250);
/// The delay doubles with every round of all members, up to this.
const LONGEST_HEDGE: Duration = Duration::from_millis(500);
/// Delay before the next member is asked after one has failed.
const FAILED_PAUSE: Duration = Duration::from_millis(50);

/// Why a call failed.
#[derive(Debug, Clone)]
pub(super) enum CallError {
    /// No member answered in time: the call may have been performed.
    Unknown(String),
    /// etcd has no space. The call was not performed.
    NoSpace,
    /// The call was not performed, and a retry will hardly help.
    Refused(String),
    /// The request exceeds etcd's size limit.
    TooLarge(String),
    /// The member that answered belongs to another cluster.
    OtherCluster { address: String, known: u64, found: u64 },
    /// etcd's revision has decreased: an older state was restored.
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
            CallError::TooLarge(what) => {
                write!(
                    f,
                    "etcd refuses ({what}): its --max-request-bytes has to be above a MiB, as its default of 1.5 MiB is"
                )
            }
            CallError::OtherCluster { address, known, found } => write!(
                f,
                "{address} is of the cluster {found:x} of etcd, and all was of {known:x}: an older state of etcd was put in place, or this \
                 member was made anew as a cluster of its own"
            ),
            CallError::WentBack { known, found } => write!(
                f,
                "etcd was at revision {known} and now is at {found}: an older state of etcd was put in place, and what was acknowledged \
                 since then is gone"
            ),
        }
    }
}

/// Connections to every member.
pub(super) struct Client {
    members: Arc<[Member]>,
    /// The member that answered last.
    current: AtomicUsize,
    /// etcd's cluster id; 0 before the first answer.
    cluster: Arc<AtomicU64>,
    /// The last call was answered only by members of another cluster.
    met_others: AtomicBool,
    /// Since when every answered call was answered only by another cluster, and the first such answer.
    only_others: Mutex<Option<(Instant, CallError)>>,
    /// The highest revision of etcd that was seen.
    seen: AtomicI64,
    /// The highest revision, and the lower one that came after it.
    went_back: OnceLock<(i64, i64)>,
    /// Taken when the client is dropped.
    runtime: Option<Runtime>,
}

struct Member {
    address: String,
    connect: Connect,
    channel: Mutex<Option<Channel>>,
}

/// How long a call waits for an answer, and how many members it asks at most.
#[derive(Debug, Clone, Copy)]
pub(super) struct Patience {
    pub(super) answer: Duration,
    pub(super) asks: usize,
}

impl From<Duration> for Patience {
    fn from(answer: Duration) -> Patience {
        Patience { answer, asks: usize::MAX }
    }
}

impl Member {
    /// The existing connection, or a new one. Called within the client's runtime.
    fn channel(&self) -> Result<Channel, String> {
        let mut channel = self.channel.lock().unwrap_or_else(PoisonError::into_inner);
        match &*channel {
            Some(channel) => Ok(channel.clone()),
            None => (self.connect)(&self.address).map(|new| channel.insert(new).clone()),
        }
    }

    /// The next call makes a new connection: on this one an answer was lost, and a connection that lost an answer may never give another.
    fn forget(&self) {
        *self.channel.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }
}

impl Client {
    pub(super) fn new(addresses: &[String], connect: Connect) -> std::io::Result<Client> {
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(1).thread_name("etcd").enable_all().build()?;
        let member =
            |address: &String| Member { address: address.clone(), connect: connect.clone(), channel: Mutex::default() };
        let members = addresses.iter().map(member).collect();
        let (current, seen) = (AtomicUsize::new(0), AtomicI64::new(0));
        let (cluster, met_others, only_others) = (Arc::default(), AtomicBool::new(false), Mutex::default());
        let (went_back, runtime) = (OnceLock::new(), Some(runtime));
        Ok(Client { members, current, cluster, met_others, only_others, seen, went_back, runtime })
    }

    /// The id of the cluster that counts; `None` before the first answer.
    pub(super) fn cluster(&self) -> Option<u64> {
        Some(self.cluster.load(Ordering::SeqCst)).filter(|cluster| *cluster != 0)
    }

    /// Makes this cluster the one that counts, unless there is one already.
    pub(super) fn pin(&self, cluster: u64) {
        let _ = self.cluster.compare_exchange(0, cluster, Ordering::SeqCst, Ordering::SeqCst);
    }

    /// Whether the last call was answered only by another cluster. Members of this cluster may have been asked without an answer.
    pub(super) fn has_met_others(&self) -> bool {
        self.met_others.load(Ordering::SeqCst)
    }

    /// The answer of each member, whatever its cluster, with the member's address. Blocks for at most `patience`.
    pub(super) fn survey(&self, request: &TxnRequest, patience: Duration) -> Vec<(String, Option<TxnResponse>)> {
        let addresses = || self.members.iter().map(|member| member.address.clone());
        let (Some(runtime), members) = (&self.runtime, self.members.clone()) else { return Vec::new() };
        let request = request.clone();
        let asking = async move {
            let mut asked = JoinSet::new();
            for (index, member) in members.iter().enumerate() {
                if let Ok(channel) = member.channel() {
                    let (any, address) = (Arc::default(), member.address.clone());
                    asked.spawn(tokio::time::timeout(patience, ask_one(index, address, channel, request.clone(), any)));
                }
            }
            let mut answers = BTreeMap::new();
            while let Some(ended) = asked.join_next().await {
                if let Some(Ok((index, Ok(answer)))) = unless_panicked(ended) {
                    answers.insert(index, answer);
                }
            }
            answers
        };
        let mut answers = blocking(runtime, asking).unwrap_or_default();
        addresses().enumerate().map(|(index, address)| (address, answers.remove(&index))).collect()
    }

    /// The cluster, for messages.
    pub(super) fn place(&self) -> String {
        let addresses: Vec<&str> = self.members.iter().map(|member| member.address.as_str()).collect();
        addresses.join(", ")
    }

    /// Performs a transaction, or reports that no member answered in time. Blocks.
    pub(super) fn attempt(&self, request: TxnRequest, patience: impl Into<Patience>) -> Result<TxnResponse, CallError> {
        if let Some(error) = self.went_back() {
            return Err(error);
        }
        let known = self.seen.load(Ordering::SeqCst);
        let (answer, others) = self.ask(request, patience.into());
        self.note(&answer, others);
        let answer = answer?;
        let found = answer.header.as_ref().map_or(0, |header| header.revision);
        if found < known {
            let error = CallError::WentBack { known, found };
            // For ever: what is missing stays missing, even when etcd's revision has grown again.
            self.went_back.get_or_init(|| (known, found));
            return Err(error);
        }
        self.seen.fetch_max(found, Ordering::SeqCst);
        Ok(answer)
    }

    /// Whether etcd's revision has decreased. This stays so for this client.
    pub(super) fn has_gone_back(&self) -> bool {
        self.went_back.get().is_some()
    }

    /// Records who has answered.
    fn note(&self, answer: &Result<TxnResponse, CallError>, others: Option<CallError>) {
        self.met_others.store(others.is_some(), Ordering::SeqCst);
        let mut only_others = self.only_others.lock().unwrap_or_else(PoisonError::into_inner);
        match (answer, others) {
            (Ok(_) | Err(CallError::NoSpace), _) => *only_others = None,
            (_, Some(others)) => drop(only_others.get_or_insert((Instant::now(), others))),
            // No member answered.
            _ => {}
        }
    }

    /// The error that only another cluster has answered for at least `long`, if so.
    pub(super) fn only_others_for(&self, long: Duration) -> Option<CallError> {
        let only_others = self.only_others.lock().unwrap_or_else(PoisonError::into_inner);
        only_others.as_ref().filter(|(since, _)| since.elapsed() >= long).map(|(_, others)| others.clone())
    }

    /// The error that etcd's revision has decreased, if so.
    pub(super) fn went_back(&self) -> Option<CallError> {
        self.went_back.get().map(|(known, found)| CallError::WentBack { known: *known, found: *found })
    }

    /// As [`Client::attempt`], repeated until the deadline: for transactions that may be performed twice.
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

    /// The answer; without one, also the answer of a member of another cluster.
    fn ask(&self, request: TxnRequest, patience: Patience) -> (Result<TxnResponse, CallError>, Option<CallError>) {
        let unknown = |what: String| (Err(CallError::Unknown(what)), None);
        let (Some(runtime), true) = (&self.runtime, !self.members.is_empty()) else {
            return unknown("no address of a member is given".to_owned());
        };
        let first = self.current.load(Ordering::SeqCst);
        match blocking(runtime, hedged(self.members.clone(), self.cluster.clone(), first, request, patience)) {
            Some(Asked { by, answer, others }) => {
                if let Some(by) = by {
                    self.current.store(by, Ordering::SeqCst);
                }
                (answer, others)
            }
            None => unknown("the client is ending".to_owned()),
        }
    }
}

/// The result of a call.
struct Asked {
    /// The member that answered.
    by: Option<usize>,
    answer: Result<TxnResponse, CallError>,
    /// Only a member of another cluster answered.
    others: Option<CallError>,
}

/// Hedged request: asks the members one after the other, in rounds, while earlier ones have not answered; returns the answer and its
/// member. A member whose own leader has just died may hold a transaction for seconds, and perform the next one at once.
async fn hedged(
    members: Arc<[Member]>,
    cluster: Arc<AtomicU64>,
    first: usize,
    request: TxnRequest,
    patience: Patience,
) -> Asked {
    let deadline = Instant::now() + patience.answer;
    let mut last = format!("nobody answered within {} ms", patience.answer.as_millis());
    let mut asked = JoinSet::new();
    // Members that were asked and have not answered.
    let mut silent = BTreeSet::new();
    // One member may refuse what the others perform: a refusal counts only if no other member answers.
    let mut refused = BTreeMap::new();
    let mut pause = HEDGE;
    for number in 0.. {
        let index = (first + number) % members.len();
        if number < patience.asks.saturating_add(refused.len()) && !refused.contains_key(&index) {
            if silent.contains(&index) {
                members[index].forget();
            }
            match members[index].channel() {
                Ok(channel) => {
                    silent.insert(index);
                    let address = members[index].address.clone();
                    asked.spawn(ask_one(index, address, channel, request.clone(), cluster.clone()));
                }
                Err(what) => last = format!("{}: {what}", members[index].address),
            }
        }
        if (number + 1) % members.len() == 0 {
            pause = (2 * pause).min(LONGEST_HEDGE);
        }
        // Wait until the next member is asked; for less time if one that was asked has failed.
        let mut until = deadline.min(Instant::now() + pause);
        while !asked.is_empty() {
            let ended = match tokio::time::timeout_at(until.into(), asked.join_next()).await {
                Ok(Some(ended)) => unless_panicked(ended),
                Ok(None) => None,
                Err(_) => break,
            };
            match ended {
                Some((index, Err(CallError::Unknown(what)))) => {
                    last = what;
                    silent.remove(&index);
                    let failed_pause = if number < members.len() { Duration::ZERO } else { FAILED_PAUSE };
                    until = until.min(Instant::now() + failed_pause);
                }
                Some((index, Err(refusal)))
                    if matches!(
                        refusal,
                        CallError::Refused(_) | CallError::TooLarge(_) | CallError::OtherCluster { .. }
                    ) =>
                {
                    silent.remove(&index);
                    refused.insert(index, refusal);
                    until = until.min(Instant::now());
                }
                Some((index, answer)) => return Asked { by: Some(index), answer, others: None },
                None => {}
            }
        }
        if asked.is_empty() && number >= members.len() {
            tokio::time::sleep_until(until.into()).await;
        }
        let all_asked = number + 1 >= patience.asks.saturating_add(refused.len()) || refused.len() == members.len();
        if Instant::now() >= deadline || (asked.is_empty() && all_asked) {
            break;
        }
    }
    let others = refused.values().find(|refusal| matches!(refusal, CallError::OtherCluster { .. })).cloned();
    let answer = match refused.into_values().next() {
        Some(refusal) if silent.is_empty() => refusal,
        _ => CallError::Unknown(last),
    };
    silent.into_iter().for_each(|index| members[index].forget());
    Asked { by: None, answer: Err(answer), others }
}

async fn ask_one(
    index: usize,
    address: String,
    channel: Channel,
    request: TxnRequest,
    cluster: Arc<AtomicU64>,
) -> (usize, Result<TxnResponse, CallError>) {
    panic_point("etcd-client");
    let kv = KvClient::new(channel);
    let mut kv = kv.max_decoding_message_size(ANSWER_BYTES).max_encoding_message_size(ANSWER_BYTES);
    let answered = kv.txn(request).await;
    let answered = answered.map(tonic::Response::into_inner).map_err(|status| classify(&status, &address));
    (index, answered.and_then(|answer| of_cluster(answer, &cluster, address)))
}

/// Refuses the answer of another cluster than the one that counts; the first one to answer counts.
fn of_cluster(answer: TxnResponse, cluster: &AtomicU64, address: String) -> Result<TxnResponse, CallError> {
    let found = cluster_of(answer.header.as_ref());
    match cluster.compare_exchange(0, found, Ordering::SeqCst, Ordering::SeqCst) {
        Err(known) if known != found => Err(CallError::OtherCluster { address, known, found }),
        _ => Ok(answer),
    }
}

/// The result of a task; `None` if the runtime ends. A panic is passed on to the caller that waits.
fn unless_panicked<T>(ended: Result<T, JoinError>) -> Option<T> {
    match ended.map_err(JoinError::try_into_panic) {
        Ok(done) => Some(done),
        Err(Ok(panic)) => resume_unwind(panic),
        Err(Err(_)) => None,
    }
}

/// Pause before a call is retried; it doubles each time, up to [`LONGEST_PAUSE`].
pub(super) const FIRST_PAUSE: Duration = Duration::from_millis(10);
pub(super) const LONGEST_PAUSE: Duration = Duration::from_millis(250);

/// Runs a future in a runtime, and blocks this thread until it ends. `None` if the runtime ends.
fn blocking<T: Send + 'static>(runtime: &Runtime, future: impl Future<Output = T> + Send + 'static) -> Option<T> {
    let (done, result) = mpsc::sync_channel(1);
    let performed = runtime.spawn(future);
    runtime.spawn(async move {
        let _ = done.send(performed.await);
    });
    result.recv().ok().and_then(unless_panicked)
}

fn classify(status: &Status, address: &str) -> CallError {
    let said = status.message();
    match status.code() {
        Code::ResourceExhausted if said.contains("space exceeded") => CallError::NoSpace,
        // OutOfRange: the requested revision has been compacted.
        Code::InvalidArgument if said.contains("too large") => CallError::TooLarge(format!("{address} says: {said}")),
        Code::InvalidArgument
        | Code::OutOfRange
        | Code::PermissionDenied
        | Code::Unauthenticated
        | Code::Unimplemented => CallError::Refused(format!("{address} says: {said}")),
        // Also answers that say the call was not performed: it is retried anyway.
        _ => CallError::Unknown(format!("{address}: {said}")),
    }
}

/// The id of the cluster that answered.
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
        // The thread that drops the client may not be allowed to block.
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}
