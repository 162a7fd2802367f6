//! Asks etcd: the member that answered last, and the next one beside it when that is silent for a moment; the first answer counts.
//!
//! A transaction without an answer may have been performed, may be performed later, or never, and one with an answer may be performed
//! once more: a copy may be late. So every transaction that writes is guarded such that it has no effect twice ([`super::chain`]).
//!
//! A client is of one cluster: the first that answers it, or the one it is told of ([`Client::pin`]). A member that answers for another
//! cluster was made anew, or belongs to somebody else: it counts as one that refuses.
//!
//! The client has a thread of its own; callers block. A panic in one of its tasks is one of the caller.

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

/// The largest answer: a page of frames ([`super::contents`]), with room to spare.
const ANSWER_BYTES: usize = 512 << 20;
/// A member that has not answered for so long is not waited for alone.
const HEDGE: Duration = Duration::from_millis(250);
/// With every round of all members the next one waits twice as long, up to this.
const LONGEST_HEDGE: Duration = Duration::from_millis(500);
/// When one that was asked has failed, the next one is asked after so long.
const FAILED_PAUSE: Duration = Duration::from_millis(50);

/// Why there is no answer.
#[derive(Debug, Clone)]
pub(super) enum CallError {
    /// Nobody answered in time: it may have been performed.
    Unknown(String),
    /// etcd has no space. It was not performed.
    NoSpace,
    /// It was not performed, and will hardly be.
    Refused(String),
    /// It is larger than etcd takes.
    TooLarge(String),
    /// Whoever answered is of another cluster.
    OtherCluster { address: String, known: u64, found: u64 },
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

/// A connection to every member.
pub(super) struct Client {
    members: Arc<[Member]>,
    /// Who answered last.
    current: AtomicUsize,
    /// etcd's number of the cluster; 0 before the first answer.
    cluster: Arc<AtomicU64>,
    /// The last call was answered by members of another cluster, and by nobody else.
    met_others: AtomicBool,
    /// Since when all calls were that were answered at all, and what the first of them said.
    only_others: Mutex<Option<(Instant, CallError)>>,
    /// The highest revision of etcd that was seen.
    seen: AtomicI64,
    /// The revision that was seen, and the lower one that came after it.
    went_back: OnceLock<(i64, i64)>,
    /// Taken when the client is dropped.
    runtime: Option<Runtime>,
}

struct Member {
    address: String,
    connect: Connect,
    channel: Mutex<Option<Channel>>,
}

/// How long a call waits for an answer, and of how many members it is asked at the most.
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
    /// The connection of before, or a new one. Called within the client's runtime.
    fn channel(&self) -> Result<Channel, String> {
        let mut channel = self.channel.lock().unwrap_or_else(PoisonError::into_inner);
        match &*channel {
            Some(channel) => Ok(channel.clone()),
            None => (self.connect)(&self.address).map(|new| channel.insert(new).clone()),
        }
    }

    /// The next call makes a new connection: on this one no answer came, and a connection that lost an answer may never give another.
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

    /// etcd's number of the cluster that counts; nothing before the first answer.
    pub(super) fn cluster(&self) -> Option<u64> {
        Some(self.cluster.load(Ordering::SeqCst)).filter(|cluster| *cluster != 0)
    }

    /// From now on only this cluster counts, if none does yet.
    pub(super) fn pin(&self, cluster: u64) {
        let _ = self.cluster.compare_exchange(0, cluster, Ordering::SeqCst, Ordering::SeqCst);
    }

    /// Whether the last call was answered by another cluster alone. Members of this one may have been asked, and silent.
    pub(super) fn has_met_others(&self) -> bool {
        self.met_others.load(Ordering::SeqCst)
    }

    /// What each member says by itself, of whichever cluster it is, with its address. Blocks for so long at the most.
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

    /// Performs a transaction, or says that nobody answered in time. Blocks.
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
            // For ever: what is missing stays missing when etcd has grown again.
            self.went_back.get_or_init(|| (known, found));
            return Err(error);
        }
        self.seen.fetch_max(found, Ordering::SeqCst);
        Ok(answer)
    }

    /// Whether etcd knows less than it did. It stays so for this client.
    pub(super) fn has_gone_back(&self) -> bool {
        self.went_back.get().is_some()
    }

    /// Keeps who has answered.
    fn note(&self, answer: &Result<TxnResponse, CallError>, others: Option<CallError>) {
        self.met_others.store(others.is_some(), Ordering::SeqCst);
        let mut only_others = self.only_others.lock().unwrap_or_else(PoisonError::into_inner);
        match (answer, others) {
            (Ok(_) | Err(CallError::NoSpace), _) => *only_others = None,
            (_, Some(others)) => drop(only_others.get_or_insert((Instant::now(), others))),
            // Nobody answered.
            _ => {}
        }
    }

    /// That nobody but another cluster has answered for at least so long, if that is so.
    pub(super) fn only_others_for(&self, long: Duration) -> Option<CallError> {
        let only_others = self.only_others.lock().unwrap_or_else(PoisonError::into_inner);
        only_others.as_ref().filter(|(since, _)| since.elapsed() >= long).map(|(_, others)| others.clone())
    }

    /// That etcd knows less than it did, if that is so.
    pub(super) fn went_back(&self) -> Option<CallError> {
        self.went_back.get().map(|(known, found)| CallError::WentBack { known: *known, found: *found })
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

    /// The answer; where there is none, also what a member of another cluster said.
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

/// What a call has come to.
struct Asked {
    /// Who answered.
    by: Option<usize>,
    answer: Result<TxnResponse, CallError>,
    /// Nobody answered but a member of another cluster.
    others: Option<CallError>,
}

/// Asks one after the other, round and round, each beside those that have not answered yet, and says who answered. A member whose own
/// leader has just died may hold a transaction for seconds, and perform the next one at once.
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
    // Who was asked and has not answered.
    let mut silent = BTreeSet::new();
    // One member may refuse what the others perform: it counts where nobody else answers.
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
        // Until the next one is asked, too; sooner where one that was asked has failed.
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

/// Refuses what another cluster answered than the one that counts; the first counts.
fn of_cluster(answer: TxnResponse, cluster: &AtomicU64, address: String) -> Result<TxnResponse, CallError> {
    let found = cluster_of(answer.header.as_ref());
    match cluster.compare_exchange(0, found, Ordering::SeqCst, Ordering::SeqCst) {
        Err(known) if known != found => Err(CallError::OtherCluster { address, known, found }),
        _ => Ok(answer),
    }
}

/// What a task has come to; nothing where the runtime ends. Its panic goes on in whoever waited for it.
fn unless_panicked<T>(ended: Result<T, JoinError>) -> Option<T> {
    match ended.map_err(JoinError::try_into_panic) {
        Ok(done) => Some(done),
        Err(Ok(panic)) => resume_unwind(panic),
        Err(Err(_)) => None,
    }
}

/// Before a call is tried again, doubled every time up to [`LONGEST_PAUSE`].
pub(super) const FIRST_PAUSE: Duration = Duration::from_millis(10);
pub(super) const LONGEST_PAUSE: Duration = Duration::from_millis(250);

/// Performs a future in a runtime, and waits for it in this thread, whatever runs there. Nothing where the runtime ends.
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
        // Out of range: the revision that was asked for has been compacted.
        Code::InvalidArgument if said.contains("too large") => CallError::TooLarge(format!("{address} says: {said}")),
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
