//! Histories of concurrent clients of the real service, with restarts in between, are those of one pool that does one thing at a time.
//!
//! Every call is recorded with when it began and when its answer was there; a call that broke is asked again under its request id until
//! it is answered, as one call. The checker looks for an order of all of them in which each takes effect between its begin and its end,
//! and every answer is what the obvious model answers (Wing and Gong, 1993; with the memory of Lowe, 2017). A client does one thing
//! after the other, so how far each of them is says everything: that is what the memory holds.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_daemon::resource_manager::ResourceManagerConfig;
use ratn_model::resource::{Requirement, ResourceClass};
use ratn_proto::types::Resource;
use ratn_worker::client::{AcquireOptions, CallError, ResourceClient};
use std::collections::{BTreeMap, BTreeSet};
use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use support::{DEADLINE, TestSystem, block, in_time};
use tonic::Code;

/// Units there are of each kind.
const CAPACITY: [(&str, u32); 2] = [("A", 3), ("B", 2)];
const CLIENTS: usize = 5;
const ROUNDS: usize = 60;
const RESTARTS: u64 = 3;
/// Between two attempts of a call that broke.
const AGAIN_AFTER: Duration = Duration::from_millis(2);

/// Units per kind.
type Units = [u32; 2];

#[derive(Debug, Clone, Copy, PartialEq)]
enum Done {
    /// Granted, with this token.
    Acquired { token: u64, units: Units },
    /// What was acquired under a token was released.
    Released { token: u64 },
    /// So much was free, of all kinds at one moment.
    Seen { free: Units },
}

/// A call with its answer, in ticks of one clock.
#[derive(Debug, Clone, Copy)]
struct Call {
    begin: u64,
    end: u64,
    done: Done,
}

/// The obvious model.
#[derive(Debug, Clone, Default)]
struct Model {
    held: BTreeMap<u64, Units>,
    last_token: u64,
}

impl Model {
    fn free(&self) -> Units {
        [0, 1].map(|kind| CAPACITY[kind].1 - self.held.values().map(|units| units[kind]).sum::<u32>())
    }

    /// The model after a call, if it could have been answered so.
    fn after(&self, done: Done) -> Option<Model> {
        let mut model = self.clone();
        match done {
            Done::Acquired { token, units } => {
                let enough = units.iter().zip(self.free()).all(|(wanted, free)| *wanted <= free);
                if !enough || token <= self.last_token {
                    return None;
                }
                model.held.insert(token, units);
                model.last_token = token;
            }
            Done::Released { token } => drop(model.held.remove(&token)?),
            Done::Seen { free } => return (free == self.free()).then_some(model),
        }
        Some(model)
    }
}

/// Whether there is an order; `clients` has the calls of each in its own order. Otherwise how far one comes at the most.
fn check(clients: &[Vec<Call>]) -> Result<(), Vec<usize>> {
    let mut tried = BTreeSet::new();
    let mut furthest = vec![0; clients.len()];
    let mut open = vec![(furthest.clone(), Model::default())];
    while let Some((at, model)) = open.pop() {
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
            let Some(after) = model.after(call.done) else { continue };
            let mut at = at.clone();
            at[client] += 1;
            if tried.insert(at.clone()) {
                open.push((at, after));
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

/// Asks until there is an answer of the manager's own.
async fn answered<T, F: Future<Output = Result<T, CallError>>>(ask: impl Fn() -> F) -> T {
    in_time(async {
        loop {
            match ask().await {
                Ok(answer) => return answer,
                Err(error) => {
                    let broken = error.code().is_none_or(|code| matches!(code, Code::Unavailable | Code::Cancelled));
                    assert!(broken || error.code() == Some(Code::Unknown), "refused: {error}");
                    tokio::time::sleep(AGAIN_AFTER).await;
                }
            }
        }
    })
    .await
}

/// What one client does; it holds nothing while it waits, so somebody always goes on.
async fn work(resources: ResourceClient, name: usize, clock: Arc<AtomicU64>, mut numbers: Numbers) -> Vec<Call> {
    let tick = || clock.fetch_add(1, Ordering::SeqCst);
    let mut calls = Vec::new();
    for round in 0..ROUNDS {
        let units: Units = [[1, 0], [0, 1], [1, 1], [2, 0], [3, 2], [2, 1]][numbers.below(6) as usize];
        let requirements: Vec<Requirement> = (0..2)
            .filter(|kind| units[*kind] > 0)
            .map(|kind| Requirement { count: units[kind], ..block(CAPACITY[kind].0) })
            .collect();
        let options = AcquireOptions { request: format!("{name}/{round}"), deadline: DEADLINE, ..Default::default() };
        let begin = tick();
        let lease = answered(|| resources.acquire(requirements.clone(), options.clone())).await;
        let end = tick();
        let done = Done::Acquired { token: lease.token.0, units };
        calls.push(Call { begin, end, done });
        if numbers.below(3) == 0 {
            let begin = tick();
            let seen = answered(|| resources.list(&["A", "B"])).await;
            let free = [0, 1].map(|kind| seen.iter().find(|r| r.kind == CAPACITY[kind].0).unwrap().free);
            calls.push(Call { begin, end: tick(), done: Done::Seen { free } });
        }
        let begin = tick();
        // False where an attempt that broke had released it: it is released either way.
        answered(|| resources.release(lease.id)).await;
        calls.push(Call { begin, end: tick(), done: Done::Released { token: lease.token.0 } });
    }
    calls
}

async fn history(seed: u64) -> Vec<Vec<Call>> {
    let system = TestSystem::new();
    let config = ResourceManagerConfig { listen: system.directory.socket("rm"), ..Default::default() };
    let mut manager = system.resource_manager_with(config.clone()).await;
    let provider = system.client(&manager, "provider").await;
    for (kind, capacity) in CAPACITY {
        let resource = Resource::new(kind.to_lowercase(), ResourceClass::Module, kind).with_capacity(capacity);
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
        let acquires =
            clients.iter().flatten().filter(|call| !matches!(call.done, Done::Seen { .. } | Done::Released { .. }));
        assert_eq!(acquires.count(), CLIENTS * ROUNDS);
        if let Err(furthest) = check(&clients) {
            let stuck: Vec<_> = clients.iter().zip(&furthest).map(|(calls, at)| calls.get(*at)).collect();
            panic!("seed {seed}: no order of the calls explains their answers; none of these can be next: {stuck:#?}");
        }
    }
}

fn acquired(begin: u64, end: u64, token: u64, units: Units) -> Call {
    Call { begin, end, done: Done::Acquired { token, units } }
}

#[test]
fn the_checker_finds_an_order_where_there_is_one() {
    // The second begins before the first has ended and sees what that took, and the third what it gave back.
    let first = vec![acquired(0, 9, 1, [3, 0]), Call { begin: 10, end: 14, done: Done::Released { token: 1 } }];
    let second = vec![Call { begin: 1, end: 2, done: Done::Seen { free: [0, 2] } }];
    let third = vec![acquired(3, 13, 2, [1, 2])];
    assert_eq!(check(&[first, second, third]), Ok(()));
}

#[test]
fn the_checker_refuses_what_one_pool_cannot_have_done() {
    let seen = |begin, end, free| Call { begin, end, done: Done::Seen { free } };
    let released = |begin, end, token| Call { begin, end, done: Done::Released { token } };
    let broken = [
        // A unit twice.
        vec![vec![acquired(0, 1, 1, [2, 0])], vec![acquired(0, 5, 2, [2, 0])]],
        // A token that goes back.
        vec![vec![acquired(0, 1, 2, [1, 0])], vec![acquired(2, 3, 1, [1, 0])]],
        // A state that was over when it was asked for.
        vec![vec![acquired(0, 1, 1, [1, 0])], vec![seen(2, 3, [3, 2])]],
        // Half of a request.
        vec![vec![acquired(0, 9, 1, [1, 1])], vec![seen(1, 8, [2, 2])]],
        // Granted before the release that made room began.
        vec![vec![acquired(0, 1, 1, [3, 0]), released(5, 6, 1)], vec![acquired(2, 3, 2, [1, 0])]],
        // Released twice.
        vec![vec![acquired(0, 1, 1, [1, 0]), released(2, 3, 1)], vec![released(4, 5, 1)]],
    ];
    for history in broken {
        assert!(check(&history).is_err(), "{history:?}");
    }
}
