//! Clients that do whatever a client may: acquire, release, withdraw, consume, create, delete, list, give goals, and keep a session alive.
//!
//! Each does one thing after the other; a call without an answer is asked again under its request id, on another line as often as not,
//! or given up and withdrawn. Now and then a request is asked on both lines at once. What a client was told goes to the round's record.

use super::asking::{Answer, channel, known, once};
use super::history::{Amounts, Asked, Done, Grant, NEVER, Record, Session, Shown, ToolHold, now};
use super::line::Line;
use super::provider;
use crate::support::crashes::Random;
use futures::StreamExt;
use ratn_proto::v1;
use ratn_proto::v1::action_service_client::ActionServiceClient;
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tonic::Code;
use tonic::transport::Channel;

/// What is acquired together, in thousandths.
const WANTED: [&[(&str, u64)]; 7] = [
    &[("A", 1_000)],
    &[("A", 2_000)],
    &[("B", 3_000)],
    &[("A", 1_000), ("B", 2_000)],
    &[("A", 3_000), ("C", 4_250)],
    &[("B", 1_000), ("C", 7_999)],
    &[("M", 1_000)],
];
/// The most that is consumed at once; all together leave enough for everybody.
const MOST_CONSUMED: u64 = 20;
/// Of the resources that a client made it keeps at most so many.
const KEPT: usize = 3;
const A_MOMENT: Duration = Duration::from_millis(10);
/// The longest motion.
const STEPS: u64 = 30;

/// A client of a round.
pub(crate) struct Client {
    number: Session,
    ttl: Duration,
    rpc: [ResourceServiceClient<Channel>; 2],
    tool: ActionServiceClient<Channel>,
    /// Does not ping for now, as if it were suspended.
    silent: Arc<AtomicBool>,
    record: Arc<Record>,
    random: Random,
    made: Vec<String>,
    asked: usize,
    end: CancellationToken,
}

/// The session of a client.
pub(crate) fn session(number: Session) -> String {
    format!("client-{number}")
}

/// The client of a session.
pub(crate) fn client_of(session: &str) -> Option<Session> {
    session.strip_prefix("client-")?.parse().ok()
}

fn thousandths(amount: f64) -> u64 {
    (amount * 1_000.0).round() as u64
}

/// An acquire that was granted.
struct Held {
    lease: v1::Lease,
    request: String,
    /// Of the tool; a lease that lost it before it was answered does not say so any more.
    is_tool: bool,
}

impl Client {
    pub(crate) fn new(
        number: Session,
        lines: &[Arc<Line>],
        record: Arc<Record>,
        seed: u64,
        end: CancellationToken,
    ) -> anyhow::Result<Client> {
        let rpc = [ResourceServiceClient::new(channel(&lines[0])?), ResourceServiceClient::new(channel(&lines[1])?)];
        let mut random = Random(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15).wrapping_add(number as u64 * 7_919 + 1) | 1);
        let ttl = Duration::from_millis(200 + random.below(500));
        let tool = ActionServiceClient::new(channel(&lines[2])?);
        let (silent, made) = Default::default();
        Ok(Client { number, ttl, rpc, tool, silent, record, random, made, asked: 0, end })
    }

    /// What keeps its session alive, until the client is dropped.
    pub(crate) fn pinging(&self, over: CancellationToken) -> impl Future<Output = ()> + Send + use<> {
        let (rpc, silent, record) = (self.rpc[0].clone(), self.silent.clone(), self.record.clone());
        let (number, ttl) = (self.number, self.ttl);
        let pinging = async move {
            loop {
                if !silent.load(Ordering::SeqCst) {
                    ping(&rpc, number, ttl, &record).await;
                }
                tokio::time::sleep(ttl / 5).await;
            }
        };
        async move { over.run_until_cancelled(pinging).await.unwrap_or_default() }
    }

    /// Works until it is told to end.
    pub(crate) async fn work(mut self) {
        while !self.end.is_cancelled() {
            match self.random.below(100) {
                0..42 => self.take().await,
                42..50 => self.consume().await,
                50..60 => self.make().await,
                60..66 => self.delete().await,
                66..77 => self.look().await,
                77..80 => self.forge().await,
                _ => self.use_tool().await,
            }
            tokio::time::sleep(Duration::from_micros(self.random.below(6_000))).await;
        }
    }

    fn thread(&self) -> usize {
        2 * self.number
    }

    fn answered(&self, begin: u64, done: Done) {
        self.record.answered(self.thread(), self.number, begin, done);
    }

    fn request(&mut self) -> String {
        self.asked += 1;
        format!("client-{}/{}", self.number, self.asked)
    }

    fn patience(&mut self) -> Duration {
        Duration::from_millis(40 + self.random.below(200))
    }

    /// On which of its lines it asks next.
    fn any(&mut self) -> ResourceServiceClient<Channel> {
        self.rpc[self.random.below(2) as usize].clone()
    }

    /// Blocks something for a moment.
    async fn take(&mut self) {
        let wanted = WANTED[self.random.below(WANTED.len() as u64) as usize];
        let Some(held) = self.acquire(wanted).await else { return };
        if self.random.below(3) == 0 {
            self.look().await;
        }
        tokio::time::sleep(Duration::from_micros(self.random.below(20_000))).await;
        self.give_back(held).await;
    }

    async fn give_back(&mut self, held: Held) {
        if self.random.below(4) == 0 {
            self.withdraw(held.request, held.is_tool).await;
        } else {
            self.release(held.lease, held.is_tool).await;
        }
    }

    /// Acquires, whatever it takes; or gives up, and then holds nothing.
    async fn acquire(&mut self, wanted: &[(&str, u64)]) -> Option<Held> {
        let request = self.request();
        let question = v1::AcquireRequest {
            request_id: request.clone(),
            session_id: session(self.number),
            requirements: wanted.iter().map(|(kind, amount)| block(kind, *amount)).collect(),
            priority: self.random.below(3) as i64,
            deadline_ms: 20 + self.random.below(300),
            holder: request.clone(),
            ..Default::default()
        };
        let begin = now();
        let asked = Asked { session: self.number, begin, until: NEVER };
        self.record.open().asked.insert(request.clone(), asked);
        let gives_up = self.random.below(3) == 0;
        let mut lost = false;
        let answer = loop {
            let both = self.random.below(4) == 0;
            let answer = if both { self.ask_both(&question).await } else { self.ask(&question).await };
            lost |= both || matches!(answer, Answer::Unknown);
            match answer {
                // Its patience may be less than the deadline, time and again.
                Answer::Unknown if gives_up || self.end.is_cancelled() => break None,
                Answer::Unknown => tokio::time::sleep(A_MOMENT / 3).await,
                Answer::Yes(lease) => break Some(lease),
                Answer::No(code, message) => {
                    self.refused("acquire", code, &message).await;
                    if !lost {
                        self.until(&request, now());
                        return None;
                    }
                    break None;
                }
            }
        };
        let Some(lease) = answer else {
            self.record.count("given up");
            self.withdraw(request, wanted[0].0 == provider::KIND).await;
            return None;
        };
        let held = amounts(wanted, &lease);
        self.record.count("granted");
        if !lost {
            self.until(&request, now());
        }
        let seen =
            Grant { session: session(self.number), request: request.clone(), lease: lease.id, held: held.clone() };
        self.record.saw(lease.token, seen);
        if wanted[0].0 != provider::KIND {
            // What another client made may be deleted before the answer is there.
            let missing = wanted[0].0 != "M"
                && wanted.iter().map(|(_, amount)| amount).sum::<u64>() != held.values().sum::<u64>();
            if missing {
                self.record.failed(format!("{request} wanted {wanted:?} and got {held:?} under {}", lease.token));
            }
            self.answered(begin, Done::Granted { request: request.clone(), token: lease.token, held });
        }
        Some(Held { lease, request, is_tool: wanted[0].0 == provider::KIND })
    }

    fn until(&self, request: &str, until: u64) {
        if let Some(asked) = self.record.open().asked.get_mut(request) {
            asked.until = until;
        }
    }

    async fn ask(&mut self, question: &v1::AcquireRequest) -> Answer<v1::Lease> {
        let (patience, mut rpc) = (self.patience(), self.any());
        lease(once(patience, rpc.acquire(question.clone())).await)
    }

    /// The same request on both lines at once.
    async fn ask_both(&mut self, question: &v1::AcquireRequest) -> Answer<v1::Lease> {
        self.record.count("asked twice at once");
        let [mut one, mut other] = self.rpc.clone();
        let patience = [self.patience(), self.patience()];
        let (one, other) = tokio::join!(
            once(patience[0], one.acquire(question.clone())),
            once(patience[1], other.acquire(question.clone()))
        );
        match (lease(one), lease(other)) {
            (Answer::Yes(one), Answer::Yes(other)) => {
                if one != other {
                    self.record.failed(format!("one request, two leases: {one:?} and {other:?}"));
                }
                Answer::Yes(one)
            }
            (Answer::Yes(one), _) | (_, Answer::Yes(one)) => Answer::Yes(one),
            (Answer::No(code, message), Answer::No(..)) => Answer::No(code, message),
            _ => Answer::Unknown,
        }
    }

    async fn withdraw(&mut self, request: String, is_tool: bool) {
        let begin = now();
        let (answer, lost) = known(|| {
            let (patience, mut rpc) = (self.patience(), self.any());
            let question = v1::WithdrawRequest {
                request_id: request.clone(),
                session_id: session(self.number),
                ..Default::default()
            };
            async move { once(patience, rpc.withdraw(question)).await }
        })
        .await;
        match answer {
            // Whether a lease of the tool has ended by itself is the provider's doing.
            _ if is_tool => {}
            Answer::Yes(answer) => {
                self.record.count("withdrawn");
                self.answered(begin, Done::Withdrawn { request, withdrawn: answer.withdrawn, sure: !lost });
            }
            Answer::No(code, message) => {
                self.refused("withdraw", code, &message).await;
                self.record.perhaps(self.number, begin, Done::Withdrawn { request, withdrawn: true, sure: false });
            }
            Answer::Unknown => {}
        }
    }

    async fn release(&mut self, lease: v1::Lease, is_tool: bool) {
        let begin = now();
        let request_id = self.request();
        let (answer, _) = known(|| {
            let (patience, mut rpc) = (self.patience(), self.any());
            let question = v1::ResourceServiceReleaseRequest {
                request_id: request_id.clone(),
                session_id: session(self.number),
                lease_id: lease.id,
                note: String::new(),
                at_rest: true,
            };
            async move { once(patience, rpc.release(question)).await }
        })
        .await;
        let done = |released| Done::Released { token: lease.token, released };
        match answer {
            _ if is_tool => {}
            Answer::Yes(answer) => self.answered(begin, done(answer.released)),
            Answer::No(code, message) => {
                self.refused("release", code, &message).await;
                self.record.perhaps(self.number, begin, done(true));
            }
            Answer::Unknown => {}
        }
    }

    async fn consume(&mut self) {
        let amount = 1 + self.random.below(MOST_CONSUMED);
        let mut requirement = block("C", amount);
        requirement.operation = v1::ResourceOperation::Consume.into();
        let (begin, request_id) = (now(), self.request());
        let (answer, lost) = known(|| {
            let (patience, mut rpc) = (self.patience(), self.any());
            let requirement = Some(requirement.clone());
            let (request_id, session_id) = (request_id.clone(), session(self.number));
            let question = v1::ConsumeRequest { request_id, session_id, requirement, resource_id: String::new() };
            async move { once(patience, rpc.consume(question)).await }
        })
        .await;
        self.ended("consume", begin, answer, lost, Done::Consumed { amount }).await;
    }

    async fn make(&mut self) {
        let (begin, request_id) = (now(), self.request());
        let resource = v1::Resource {
            id: format!("m-{request_id}"),
            class: v1::ResourceClass::Task.into(),
            kind: "M".to_owned(),
            capacity: 1.0,
            ..Default::default()
        };
        let done = Done::Created { resource: resource.id.clone() };
        let (answer, lost) = known(|| {
            let (patience, mut rpc) = (self.patience(), self.any());
            let resource = Some(resource.clone());
            let question =
                v1::CreateRequest { request_id: request_id.clone(), session_id: session(self.number), resource };
            async move { once(patience, rpc.create(question)).await }
        })
        .await;
        // Created, and gone with its session before the answer could say what it is.
        let lost = lost || matches!(answer, Answer::No(Code::NotFound, _));
        self.made.push(resource.id.clone());
        self.ended("create", begin, answer, lost, done).await;
        if self.made.len() > KEPT {
            self.delete().await;
        }
    }

    async fn delete(&mut self) {
        if self.made.is_empty() {
            return;
        }
        let resource = self.made.remove(0);
        let (begin, request_id) = (now(), self.request());
        let (answer, lost) = known(|| {
            let (patience, mut rpc) = (self.patience(), self.any());
            let target = Some(v1::delete_request::Target::ResourceId(resource.clone()));
            let question =
                v1::DeleteRequest { request_id: request_id.clone(), session_id: session(self.number), target };
            async move { once(patience, rpc.delete(question)).await }
        })
        .await;
        let done = |there| Done::Deleted { resource: resource.clone(), there };
        if let Answer::No(Code::NotFound, _) = answer {
            return self.answered(begin, done(false));
        }
        self.ended("delete", begin, answer, lost, done(true)).await;
    }

    /// Lists everything.
    async fn look(&mut self) {
        let (patience, mut rpc) = (self.patience(), self.any());
        look(&mut rpc, patience, &self.record, self.thread(), self.number).await;
    }

    async fn ended<T>(&mut self, what: &'static str, begin: u64, answer: Answer<T>, lost: bool, done: Done) {
        match answer {
            Answer::Yes(_) => {
                self.record.count(what);
                self.answered(begin, done);
            }
            Answer::No(code, message) => {
                self.refused(what, code, &message).await;
                if lost {
                    self.record.perhaps(self.number, begin, done);
                }
            }
            Answer::Unknown => {}
        }
    }

    /// Waits a moment, for most refusals mean that the session is to be opened anew.
    async fn refused(&mut self, what: &str, code: Code, message: &str) {
        let known = match code {
            Code::FailedPrecondition | Code::DeadlineExceeded | Code::NotFound | Code::ResourceExhausted => true,
            _ => message.contains("belongs to"),
        };
        if !known {
            self.record.failed(format!("{what} of client {} was refused: {code:?} {message}", self.number));
        }
        self.record.count("refused");
        tokio::time::sleep(A_MOMENT).await;
    }

    /// Acquires the tool and moves it: as it should, or on after its session was left to expire, or on after its release.
    async fn use_tool(&mut self) {
        let Some(held) = self.acquire(&[(provider::KIND, 1_000)]).await else { return };
        let granted = now();
        let hold = ToolHold { session: self.number, token: held.lease.token, granted, released: NEVER };
        self.record.open().holds.push(hold);
        for _ in 0..1 + self.random.below(2) {
            self.give_goal(&held.lease).await;
        }
        match self.random.below(5) {
            // As a holder that is suspended: its session ends, and it does not know.
            0 => {
                self.silent.store(true, Ordering::SeqCst);
                tokio::time::sleep(self.ttl + A_MOMENT * self.random.below(10) as u32).await;
                self.give_goal(&held.lease).await;
                self.silent.store(false, Ordering::SeqCst);
                self.given_back(held).await;
            }
            1 => {
                let lease = held.lease.clone();
                self.given_back(held).await;
                self.give_goal(&lease).await;
            }
            _ => self.given_back(held).await,
        }
    }

    /// Gives a goal under a lease that it made up: nothing may come of it, for it or for those who hold the tool.
    async fn forge(&mut self) {
        let (id, token) = match self.random.below(3) {
            0 => (u64::MAX, u64::MAX),
            1 => (1, u64::MAX),
            _ => (1 + self.random.below(1 << 40), 1 + self.random.below(1 << 40)),
        };
        let tool =
            v1::LeasedResource { id: provider::TOOL.to_owned(), kind: provider::KIND.to_owned(), ..Default::default() };
        let session_id = [String::new(), session(self.number)][self.random.below(2) as usize].clone();
        self.record.count("leases made up");
        self.give_goal(&v1::Lease { id, token, resources: vec![tool], session_id, consumed: Vec::new() }).await;
    }

    async fn given_back(&mut self, held: Held) {
        let token = held.lease.token;
        self.record.open().holds.iter_mut().filter(|hold| hold.token == token).for_each(|hold| hold.released = now());
        self.give_back(held).await;
    }

    /// A goal that is waited for, or not any more.
    async fn give_goal(&mut self, lease: &v1::Lease) {
        static NUMBER: AtomicUsize = AtomicUsize::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let steps = v1::Value { kind: Some(v1::value::Kind::Integer(1 + self.random.below(STEPS) as i64)) };
        let goal = v1::Goal {
            goal_id: format!("{}/goal-{number}", session(self.number)),
            action: "move".to_owned(),
            inputs: [("steps".to_owned(), steps)].into(),
            lease: Some(lease.clone()),
            grace_ms: self.random.below(2) * 200,
            ..Default::default()
        };
        let (patience, mut tool) = (self.patience(), self.tool.clone());
        let question = v1::ExecuteRequest { goal: Some(goal) };
        let performed = async {
            let mut messages = tool.execute(question).await.ok()?.into_inner();
            while let Some(Ok(message)) = messages.next().await {
                if let Some(v1::execute_response::Kind::Result(result)) = message.kind {
                    return Some(result.outcome);
                }
            }
            None
        };
        let outcome = tokio::time::timeout(patience, performed).await.ok().flatten();
        self.record.count(match outcome.as_deref() {
            Some("success") => "goals done",
            Some(_) => "goals ended otherwise",
            None => "goals without an answer",
        });
    }
}

async fn ping(rpc: &ResourceServiceClient<Channel>, number: Session, ttl: Duration, record: &Record) {
    let ttl_ms = u64::try_from(ttl.as_millis()).unwrap_or(u64::MAX);
    let question =
        v1::KeepAliveRequest { session_id: session(number), ttl_ms, client: session(number), ..Default::default() };
    let begin = now();
    let mut rpc = rpc.clone();
    let asking = async {
        let mut answers = rpc.keep_alive(tokio_stream::once(question)).await.ok()?.into_inner();
        answers.message().await.ok().flatten()
    };
    let answer = tokio::time::timeout(ttl / 2, asking).await.ok().flatten();
    let ttl = ttl_ms * 1_000_000;
    match answer {
        Some(answer) => {
            let ttl = ttl.min(answer.ttl_ms * 1_000_000);
            let done = Done::Pinged { ttl, created: answer.created };
            record.answered(2 * number + 1, number, begin, done);
        }
        None => drop(record.open().pinged.entry(number).or_insert(begin)),
    }
}

/// Lists everything, for the history of `thread`; false without an answer.
pub(crate) async fn look(
    rpc: &mut ResourceServiceClient<Channel>,
    patience: Duration,
    record: &Record,
    thread: usize,
    number: Session,
) -> bool {
    let begin = now();
    let Answer::Yes(answer) = once(patience, rpc.list(v1::ListRequest::default())).await else { return false };
    let mut pool = BTreeMap::new();
    for resource in answer.resources {
        saw(record, &resource);
        if resource.id != provider::TOOL {
            let held = resource.holdings.iter().map(|holding| (holding.token, thousandths(holding.units))).collect();
            pool.insert(resource.id, Shown { free: thousandths(resource.free), held });
        }
    }
    record.answered(thread, number, begin, Done::Seen { pool });
    true
}

/// The grants that a resource shows.
pub(crate) fn saw(record: &Record, resource: &v1::Resource) {
    for holding in &resource.holdings {
        let held = Amounts::from([(resource.id.clone(), thousandths(holding.units))]);
        let (session, request, lease) = (holding.session_id.clone(), holding.holder.clone(), holding.lease_id);
        record.saw(holding.token, Grant { session, request, lease, held });
    }
}

fn block(kind: &str, amount: u64) -> v1::Requirement {
    v1::Requirement {
        operation: v1::ResourceOperation::Block.into(),
        kind: kind.to_owned(),
        count: amount as f64 / 1_000.0,
        ..Default::default()
    }
}

fn lease(answer: Answer<v1::AcquireResponse>) -> Answer<v1::Lease> {
    match answer {
        Answer::Yes(v1::AcquireResponse { lease: Some(lease), .. }) => Answer::Yes(lease),
        Answer::Yes(_) => Answer::No(Code::Internal, "a grant without a lease".to_owned()),
        Answer::No(code, message) => Answer::No(code, message),
        Answer::Unknown => Answer::Unknown,
    }
}

/// What a lease holds: it names every unit of what is not divisible, and of the divisible kind it has what was wanted.
fn amounts(wanted: &[(&str, u64)], lease: &v1::Lease) -> Amounts {
    let mut held = Amounts::new();
    for resource in &lease.resources {
        let divisible = wanted.iter().find(|(kind, _)| *kind == "C" && resource.kind == "C");
        *held.entry(resource.id.clone()).or_default() += divisible.map_or(1_000, |(_, amount)| *amount);
    }
    held
}
