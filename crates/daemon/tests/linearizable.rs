//! Histories of concurrent clients of the real service, with restarts in between, are those of one pool that does one thing at a time.
//!
//! Every call is recorded with when it began and when its answer was there; a call that broke is asked again under its request id until
//! it is answered, as one call. The checker looks for an order of all of them in which each takes effect between its begin and its end,
//! and every answer is what the obvious model answers (Wing and Gong, 1993; with the memory of Lowe, 2017). A client does one thing
//! after the other, so how far each of them is says everything: that is what the memory holds. A call that broke may have been
//! granted before, unheard, which was undone then: others may have seen that.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_daemon::resource_manager::ResourceManagerConfig;
use ratn_model::resource::{Quantity, Requirement, ResourceClass, ResourceOperation};
use ratn_proto::types::Resource;
use ratn_worker::client::{AcquireOptions, CallError, ResourceClient};
use std::collections::{BTreeMap, BTreeSet};
use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use support::{DEADLINE, TestSystem, block, in_time};
use tonic::Code;

/// Thousandths there are of each kind; the last is divisible, and what is consumed of it is gone for good.
const CAPACITY: [(&str, u64); 3] = [("A", 3_000), ("B", 2_000), ("C", 20_000)];
const CLIENTS: usize = 5;
const ROUNDS: usize = 60;
/// What is acquired together.
const WANTED: [Units; 6] =
    [[1_000, 0, 500], [0, 1_000, 0], [1_000, 1_000, 4_250], [2_000, 0, 0], [3_000, 2_000, 1], [2_000, 1_000, 7_999]];
/// What a client consumes now and then at the most; all together leave enough for whoever acquires most.
const MOST_CONSUMED: u64 = 30;
const RESTARTS: u64 = 3;
/// Between two attempts of a call that broke.
const AGAIN_AFTER: Duration = Duration::from_millis(2);

/// The divisible kind.
const CHARGE: usize = 2;

/// Thousandths per kind.
type Units = [u64; 3];

#[derive(Debug, Clone, Copy, PartialEq)]
enum Done {
    /// Granted, with this token.
    Acquired { token: u64, units: Units },
    /// What was acquired under a token was released.
    Released { token: u64 },
    /// Of the last kind so much was consumed for good.
    Consumed { amount: u64 },
    /// So much was free, of all kinds at one moment.
    Seen { free: Units },
}

/// A call with its answer, in ticks of one clock.
#[derive(Debug, Clone, Copy)]
struct Call {
    begin: u64,
    end: u64,
    done: Done,
    /// An attempt of it got no answer.
    broke: bool,
}

/// What became of the attempt of a client's next call that broke.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
enum Unheard {
    /// Nothing, so far.
    #[default]
    No,
    /// Granted.
    Granted,
    /// Granted, and undone.
    Undone,
}

/// The obvious model.
#[derive(Debug, Clone, Default)]
struct Model {
    held: BTreeMap<u64, Units>,
    /// Under grants that nobody heard of, by client.
    unheard: BTreeMap<usize, Units>,
    spent: Units,
    last_token: u64,
}

impl Model {
    fn free(&self) -> Units {
        let held = |kind: usize| self.held.values().chain(self.unheard.values()).map(|units| units[kind]).sum::<u64>();
        [0, 1, 2].map(|kind| CAPACITY[kind].1 - held(kind) - self.spent[kind])
    }

    fn has(&self, units: Units) -> bool {
        units.iter().zip(self.free()).all(|(wanted, free)| *wanted <= free)
    }

    /// The models in which a call that broke was granted or undone without anybody hearing of it.
    fn unheard(&self, client: usize, call: &Call, what: Unheard) -> Option<(Unheard, Model)> {
        let Done::Acquired { units, .. } = call.done else { return None };
        let mut model = self.clone();
        match what {
            Unheard::No if call.broke && self.has(units) => {
                model.unheard.insert(client, units);
                Some((Unheard::Granted, model))
            }
            Unheard::Granted => {
                model.unheard.remove(&client);
                Some((Unheard::Undone, model))
            }
            _ => None,
        }
    }

    /// The model after a call, if it could have been answered so.
    fn after(&self, done: Done) -> Option<Model> {
        let mut model = self.clone();
        match done {
            Done::Acquired { token, units } => {
                if !self.has(units) || token <= self.last_token {
                    return None;
                }
                model.held.insert(token, units);
                model.last_token = token;
            }
            Done::Released { token } => drop(model.held.remove(&token)?),
            Done::Consumed { amount } => {
                if amount > self.free()[CHARGE] {
                    return None;
                }
                model.spent[CHARGE] += amount;
            }
            Done::Seen { free } => return (free == self.free()).then_some(model),
        }
        Some(model)
    }
}

/// Whether there is an order; `clients` has the calls of each in its own order. Otherwise how far one comes at the most.
fn check(clients: &[Vec<Call>]) -> Result<(), Vec<usize>> {
    let mut tried = BTreeSet::new();
    let mut furthest = vec![0; clients.len()];
    let mut open = vec![(furthest.clone(), vec![Unheard::No; clients.len()], Model::default())];
    while let Some((at, unheard, model)) = open.pop() {
        if at.iter().sum::<usize>() > furthest.iter().sum() {
            furthest.clone_from(&at);
        }
        let next = |client: usize| clients[client].get(at[client]);
        // What has ended has to come before what begins after that.
        let Some(first_end) = (0..clients.len()).filter_map(|client| Some(next(client)?.end)).min() else {
            return Ok(());
        };
        for client in 0..clients.len() {
            let Some(call) = next(client).filter(|call| call.begin <= first_end) else { continue };
            let go_on = |what: Unheard, steps: usize, after: Model| {
                let (mut at, mut unheard) = (at.clone(), unheard.clone());
                at[client] += steps;
                unheard[client] = what;
                (at, unheard, after)
            };
            let other = model.unheard(client, call, unheard[client]).map(|(what, after)| go_on(what, 0, after));
            let answered = model.after(call.done).filter(|_| unheard[client] != Unheard::Granted);
            for next in other.into_iter().chain(answered.map(|after| go_on(Unheard::No, 1, after))) {
                if tried.insert((next.0.clone(), next.1.clone())) {
                    open.push(next);
                }
            }
        }
    }
    Err(furthest)
}

/// Small numbers that follow from a seed (xorshift).
struct Numbers(u64);

impl Numbers {
    fn below(&mut self, bound: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % bound
    }
}

/// Asks until there is an answer of the manager's own, a refusal is one; and whether an attempt broke.
async fn asked<T, F: Future<Output = Result<T, CallError>>>(ask: impl Fn() -> F) -> (Result<T, CallError>, bool) {
    let mut broke = false;
    in_time(async {
        loop {
            let answer = ask().await;
            let Err(error) = &answer else { return (answer, broke) };
            let broken = error.code().is_none_or(|code| matches!(code, Code::Unavailable | Code::Cancelled));
            if !broken && error.code() != Some(Code::Unknown) {
                return (answer, broke);
            }
            broke = true;
            tokio::time::sleep(AGAIN_AFTER).await;
        }
    })
    .await
}

/// As [`asked`], of what is not refused.
async fn answered<T, F: Future<Output = Result<T, CallError>>>(ask: impl Fn() -> F) -> (T, bool) {
    let (answer, broke) = asked(ask).await;
    (answer.unwrap_or_else(|error| panic!("refused: {error}")), broke)
}

fn of(kind: usize, thousandths: u64) -> Requirement {
    Requirement { count: Quantity::from_thousandths(thousandths), ..block(CAPACITY[kind].0) }
}

/// What one client does; it holds nothing while it waits, so somebody always goes on.
async fn work(resources: ResourceClient, name: usize, clock: Arc<AtomicU64>, mut numbers: Numbers) -> Vec<Call> {
    let tick = || clock.fetch_add(1, Ordering::SeqCst);
    let mut calls = Vec::new();
    for round in 0..ROUNDS {
        if numbers.below(4) == 0 {
            let amount = 1 + numbers.below(MOST_CONSUMED);
            let consume = Requirement { operation: ResourceOperation::Consume, ..of(CHARGE, amount) };
            let begin = tick();
            let request = format!("{name}/{round}/consume");
            let (consumed, broke) = asked(|| resources.consume_once(&request, consume.clone())).await;
            // What others hold or wait for cannot be consumed now.
            match consumed.map_err(|error| error.code()) {
                Ok(_) => calls.push(Call { begin, end: tick(), done: Done::Consumed { amount }, broke }),
                Err(code) => assert_eq!(code, Some(Code::FailedPrecondition)),
            }
        }
        let units: Units = WANTED[numbers.below(WANTED.len() as u64) as usize];
        let requirements: Vec<Requirement> =
            (0..3).filter(|kind| units[*kind] > 0).map(|kind| of(kind, units[kind])).collect();
        let options = AcquireOptions { request: format!("{name}/{round}"), deadline: DEADLINE, ..Default::default() };
        let begin = tick();
        let (lease, broke) = answered(|| resources.acquire(requirements.clone(), options.clone())).await;
        let end = tick();
        let done = Done::Acquired { token: lease.token.0, units };
        calls.push(Call { begin, end, done, broke });
        if numbers.below(3) == 0 {
            let begin = tick();
            let (seen, broke) = answered(|| resources.list(&["A", "B", "C"])).await;
            let free = |kind: usize| seen.iter().find(|r| r.kind == CAPACITY[kind].0).unwrap().free;
            let free = [0, 1, 2].map(|kind| free(kind).thousandths());
            calls.push(Call { begin, end: tick(), done: Done::Seen { free }, broke });
        }
        let begin = tick();
        // False where an attempt that broke had released it: it is released either way.
        let (_, broke) = answered(|| resources.release(lease.id)).await;
        calls.push(Call { begin, end: tick(), done: Done::Released { token: lease.token.0 }, broke });
    }
    calls
}

async fn history(seed: u64) -> Vec<Vec<Call>> {
    let system = TestSystem::new();
    let config = ResourceManagerConfig { listen: system.directory.socket("rm"), ..Default::default() };
    let mut manager = system.resource_manager_with(config.clone()).await;
    let provider = system.client(&manager, "provider").await;
    for (kind, capacity) in CAPACITY {
        let resource = Resource::new(kind.to_lowercase(), ResourceClass::Module, kind);
        let resource = if kind == "C" { resource.divisible().non_renewable() } else { resource };
        let resource = resource.with_capacity(Quantity::from_thousandths(capacity));
        provider.resources.create(resource).await.unwrap();
    }
    let clock = Arc::new(AtomicU64::new(0));
    let mut sessions = Vec::new();
    let mut working = Vec::new();
    for name in 0..CLIENTS {
        let client = system.client(&manager, &format!("client-{name}")).await;
        let numbers = Numbers(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(name as u64 + 1) | 1);
        working.push(tokio::spawn(work(client.resources, name, clock.clone(), numbers)));
        sessions.push(client.session);
    }
    // A round is four ticks at least: all restarts are in the first half.
    let whole = (CLIENTS * ROUNDS * 4 / 2) as u64;
    for restart in 1..=RESTARTS {
        in_time(async {
            while clock.load(Ordering::SeqCst) < whole * restart / (RESTARTS + 1) {
                tokio::task::yield_now().await;
            }
        })
        .await;
        manager.end().await;
        manager = system.resource_manager_with(config.clone()).await;
    }
    let mut clients = Vec::new();
    for client in working {
        clients.push(in_time(client).await.unwrap());
    }
    manager.end().await;
    clients
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn concurrent_histories_with_restarts_are_those_of_one_pool_that_does_one_thing_at_a_time() {
    for seed in 1..=4 {
        let clients = history(seed).await;
        let acquires = clients.iter().flatten().filter(|call| matches!(call.done, Done::Acquired { .. }));
        assert_eq!(acquires.count(), CLIENTS * ROUNDS);
        if let Err(furthest) = check(&clients) {
            let stuck: Vec<_> = clients.iter().zip(&furthest).map(|(calls, at)| calls.get(*at)).collect();
            panic!("seed {seed}: no order of the calls explains their answers; none of these can be next: {stuck:#?}");
        }
    }
}

fn acquired(begin: u64, end: u64, token: u64, units: Units) -> Call {
    Call { begin, end, done: Done::Acquired { token, units }, broke: false }
}

#[test]
fn the_checker_finds_an_order_where_there_is_one() {
    // The second begins before the first has ended and sees what that took, and the third what it gave back.
    let first = vec![
        acquired(0, 9, 1, [3_000, 0, 0]),
        Call { begin: 10, end: 14, done: Done::Released { token: 1 }, broke: false },
    ];
    let second = vec![Call { begin: 1, end: 2, done: Done::Seen { free: [0, 2_000, 20_000] }, broke: false }];
    let third = vec![acquired(3, 13, 2, [1_000, 2_000, 0])];
    assert_eq!(check(&[first, second, third]), Ok(()));
}

#[test]
fn an_attempt_that_broke_may_have_been_granted_unheard_and_no_other() {
    // Seen is what the first attempt took, and that it was given back; granted is the second, after another's.
    let seen = |begin, end, free| Call { begin, end, done: Done::Seen { free }, broke: false };
    let others =
        vec![seen(1, 2, [0, 2_000, 20_000]), seen(3, 4, [3_000, 2_000, 20_000]), acquired(5, 6, 1, [1_000, 0, 0])];
    let call = acquired(0, 9, 2, [2_000, 0, 0]);
    let taken = vec![seen(1, 2, [1_000, 2_000, 20_000]), others[1], others[2]];
    assert_eq!(check(&[vec![Call { broke: true, ..call }], taken.clone()]), Ok(()));
    assert!(check(&[vec![call], taken]).is_err());
    assert!(check(&[vec![Call { broke: true, ..call }], others]).is_err());
}

#[test]
fn the_checker_refuses_what_one_pool_cannot_have_done() {
    let seen = |begin, end, free| Call { begin, end, done: Done::Seen { free }, broke: false };
    let released = |begin, end, token| Call { begin, end, done: Done::Released { token }, broke: false };
    let consumed = |begin, end, amount| Call { begin, end, done: Done::Consumed { amount }, broke: false };
    let broken = [
        // A unit twice.
        vec![vec![acquired(0, 1, 1, [2_000, 0, 0])], vec![acquired(0, 5, 2, [2_000, 0, 0])]],
        // A token that goes back.
        vec![vec![acquired(0, 1, 2, [1_000, 0, 0])], vec![acquired(2, 3, 1, [1_000, 0, 0])]],
        // A state that was over when it was asked for.
        vec![vec![acquired(0, 1, 1, [1_000, 0, 0])], vec![seen(2, 3, [3_000, 2_000, 20_000])]],
        // Half of a request.
        vec![vec![acquired(0, 9, 1, [1_000, 1_000, 0])], vec![seen(1, 8, [2_000, 2_000, 20_000])]],
        // Granted before the release that made room began.
        vec![vec![acquired(0, 1, 1, [3_000, 0, 0]), released(5, 6, 1)], vec![acquired(2, 3, 2, [1_000, 0, 0])]],
        // More of what is gone for good than there was, a part of a unit too much.
        vec![vec![consumed(0, 1, 19_999)], vec![consumed(0, 5, 2)]],
        // What was consumed is there again.
        vec![vec![consumed(0, 1, 500), seen(4, 5, [3_000, 2_000, 20_000])]],
        // Released twice.
        vec![vec![acquired(0, 1, 1, [1_000, 0, 0]), released(2, 3, 1)], vec![released(4, 5, 1)]],
    ];
    for history in broken {
        assert!(check(&history).is_err(), "{history:?}");
    }
}
