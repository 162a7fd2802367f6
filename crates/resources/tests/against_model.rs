//! Random histories: the pool does what a tiny obvious model does, grant by grant, and keeps its invariants, also over crashes
//! after which it is restored from what it wrote down.
//!
//! What a lease of an arm has left when it was lost is nobody's until its provider confirms standstill or the bound has passed.
//! What is held, free and there is compared from outside besides: no unit has two holders, what there is is what was created
//! without what was consumed and deleted, a lease has all that was asked for, tokens grow, nobody who can be served waits, and a
//! large request is overtaken as often as allowed and no more.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use proptest::prelude::*;
use ratn_model::id::{FencingToken, LeaseId};
use ratn_model::resource::{Requirement, ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use ratn_resources::{
    AcquireRequest, Limits, Notice, Pool, Quantity, Record, ResourceSpec, SessionId, Snapshot, WaiterId, decode, encode,
};
use std::collections::BTreeMap;
use std::time::Duration;

/// The last is divisible, and what is consumed of it is gone for good. Amounts of it are never whole, so that several resources of
/// it count as their sum as well: a whole unit would have to come from one of them.
const KINDS: [&str; 4] = ["Arm", "Camera", "PathPlanner", "Charge"];
const CHARGE: usize = 3;
const SESSIONS: usize = 3;
const TTL: u64 = 20;
/// The provider of arms confirms standstill within this.
const STANDSTILL: u64 = 6;
const ARM: usize = 0;
/// So many may wait, in all and of one session; who need not wait is not refused for it.
const WAITERS: usize = 5;
const WAITERS_OF_ONE: usize = 3;

#[derive(Debug, Clone)]
enum Step {
    Wait(u64),
    KeepAlive(usize),
    Create(usize, u64),
    DeleteUnit(usize),
    Acquire {
        session: usize,
        units: Units,
        consume: bool,
        priority: i64,
        patience: Option<u64>,
    },
    Release(usize),
    Revoke(usize),
    ConfirmStandstill(usize),
    Cancel(usize),
    EndTask(usize),
    /// Restored from the snapshot of an earlier moment and the records since; the records of the last step may be lost.
    Crash {
        snapshot: prop::sample::Index,
        last_is_lost: bool,
    },
}

fn step() -> impl Strategy<Value = Step> {
    let charge = prop::sample::select(vec![0, 0, 0, 1, 300, 700, 1_100]);
    let units = (0..3u64, 0..2u64, 0..4u64, charge)
        .prop_map(|(arms, cameras, planners, charge)| [arms * UNIT, cameras * UNIT, planners * UNIT, charge]);
    let acquire = (0..SESSIONS, units, prop::bool::weighted(0.15), -2..3i64, prop::option::of(1..15u64)).prop_map(
        |(session, units, consume, priority, patience)| Step::Acquire { session, units, consume, priority, patience },
    );
    prop_oneof![
        2 => (1..8u64).prop_map(Step::Wait),
        2 => (0..SESSIONS).prop_map(Step::KeepAlive),
        2 => (0..KINDS.len(), 1..3u64).prop_map(|(kind, capacity)| Step::Create(kind, capacity * grain(kind))),
        1 => (0..KINDS.len()).prop_map(Step::DeleteUnit),
        8 => acquire,
        5 => (0..16usize).prop_map(Step::Release),
        1 => (0..16usize).prop_map(Step::Revoke),
        1 => (0..16usize).prop_map(Step::ConfirmStandstill),
        1 => (0..16usize).prop_map(Step::Cancel),
        1 => (0..SESSIONS).prop_map(Step::EndTask),
        2 => (any::<prop::sample::Index>(), any::<bool>())
            .prop_map(|(snapshot, last_is_lost)| Step::Crash { snapshot, last_is_lost }),
    ]
}

/// Times of the model are milliseconds.
fn moment(time: u64) -> Timestamp {
    Timestamp(time * 1_000_000)
}

/// Thousandths of a unit.
const UNIT: u64 = 1_000;

/// Thousandths per kind.
type Units = [u64; 4];

/// What is created and deleted at a time.
fn grain(kind: usize) -> u64 {
    if kind == CHARGE { 450 } else { UNIT }
}

#[derive(Debug, Clone)]
struct ModelWaiter {
    id: WaiterId,
    session: usize,
    units: Units,
    consume: bool,
    priority: i64,
    deadline: Option<u64>,
}

/// What the pool should be: counts per kind, a list of holders, a sorted queue.
#[derive(Debug, Clone, Default)]
struct Model {
    capacity: Units,
    expires: [Option<u64>; SESSIONS],
    leases: BTreeMap<LeaseId, (usize, Units)>,
    /// How many arms leases have left when they ended, and until when those are not free.
    ending: BTreeMap<LeaseId, (u64, u64)>,
    consumed: [Units; SESSIONS],
    spent: Units,
    queue: Vec<ModelWaiter>,
    last_token: FencingToken,
}

impl Model {
    /// Who waited asks again, if at all; sessions live on from now.
    fn restart(&mut self, now: u64) {
        self.queue.clear();
        self.expires.iter_mut().flatten().for_each(|expires| *expires = now + TTL);
        self.ending.values_mut().for_each(|(_, until)| *until = now + STANDSTILL);
    }

    fn advance(&mut self, now: u64) {
        self.queue.retain(|waiter| waiter.deadline.is_none_or(|deadline| deadline > now));
        self.ending.retain(|_, (_, until)| *until > now);
        for session in 0..SESSIONS {
            if self.expires[session].is_some_and(|at| at <= now) {
                self.expires[session] = None;
                self.consumed[session] = Units::default();
                let lost: Vec<LeaseId> =
                    self.leases.iter().filter(|(_, (owner, _))| *owner == session).map(|(id, _)| *id).collect();
                lost.into_iter().for_each(|lease| self.revoke(lease, now));
                self.queue.retain(|waiter| waiter.session != session);
            }
        }
    }

    /// Ends a lease; its arms may still move.
    fn revoke(&mut self, lease: LeaseId, now: u64) {
        let arms = self.leases.remove(&lease).map_or(0, |(_, units)| units[ARM]);
        if arms > 0 {
            self.ending.insert(lease, (arms, now + STANDSTILL));
        }
    }

    /// What leases that have ended have left.
    fn ending(&self, kind: usize) -> u64 {
        if kind == ARM { self.ending.values().map(|(arms, _)| arms).sum() } else { 0 }
    }

    fn quantity(&self, kind: usize) -> u64 {
        self.capacity[kind] - self.spent[kind] - self.consumed.iter().map(|units| units[kind]).sum::<u64>()
    }

    fn free(&self, kind: usize) -> u64 {
        self.quantity(kind) - self.leases.values().map(|(_, units)| units[kind]).sum::<u64>() - self.ending(kind)
    }

    /// Who should be granted now, in order; `granted` has the lease ids that the pool gave them.
    fn grant(&mut self, granted: &[(WaiterId, LeaseId)]) -> Vec<WaiterId> {
        let mut expected = Vec::new();
        // Who is first of its session may change with each grant.
        while let Some(place) = self.next_served() {
            let waiter = self.queue.remove(place);
            expected.push(waiter.id);
            let lease = granted.iter().find(|(id, _)| *id == waiter.id).map_or(LeaseId(0), |(_, lease)| *lease);
            if waiter.consume {
                for kind in 0..4 {
                    let consumed = if kind == CHARGE { &mut self.spent } else { &mut self.consumed[waiter.session] };
                    consumed[kind] += waiter.units[kind];
                }
            }
            let held = if waiter.consume { Units::default() } else { waiter.units };
            self.leases.insert(lease, (waiter.session, held));
        }
        expected
    }

    /// The place in the queue of the first one that is served now. What those before it lack and could have is kept for them.
    fn next_served(&mut self) -> Option<usize> {
        self.sort();
        let mut reserved = Units::default();
        for (place, waiter) in self.queue.iter().enumerate() {
            let free = |kind: usize| self.free(kind).saturating_sub(reserved[kind]);
            let takes = [0, 1, 2, 3].map(|kind| waiter.units[kind].min(free(kind)));
            if takes == waiter.units {
                return Some(place);
            }
            if self.could_have(waiter) {
                (0..4).for_each(|kind| reserved[kind] += takes[kind]);
            }
        }
        None
    }

    /// Sorts the queue: the first ones of each session before all others, then by priority and arrival. First is, in the session's own order, who could
    /// be served and takes nothing of a kind of which an earlier first one takes something.
    fn sort(&mut self) {
        let mut queue = std::mem::take(&mut self.queue);
        queue.sort_by_key(|waiter| (-waiter.priority, waiter.id));
        let mut taken = [[false; 4]; SESSIONS];
        let is_first = |waiter: &ModelWaiter| {
            let (takes, taken) = (waiter.units.map(|units| units > 0), &mut taken[waiter.session]);
            let first = self.could_have(waiter) && (0..4).all(|kind| !(takes[kind] && taken[kind]));
            (0..4).for_each(|kind| taken[kind] |= first && takes[kind]);
            first
        };
        let (first, behind): (Vec<_>, Vec<_>) = queue.into_iter().partition(is_first);
        self.queue = first.into_iter().chain(behind).collect();
    }

    /// Whether there is as much as it wants, held or not.
    fn could_have(&self, waiter: &ModelWaiter) -> bool {
        (0..4).all(|kind| waiter.units[kind] <= self.quantity(kind))
    }
}

fn limits() -> Limits {
    Limits { waiters: WAITERS, waiters_per_session: WAITERS_OF_ONE, ..Limits::default() }
}

/// The pool, and what is on its disk.
struct Kept {
    pool: Pool,
    /// A snapshot after each entry, and before the first.
    snapshots: Vec<Vec<u8>>,
    entries: Vec<Vec<u8>>,
}

impl Kept {
    fn new() -> Kept {
        let pool = Pool::new(limits());
        Kept { snapshots: vec![pool.snapshot().encode()], entries: Vec::new(), pool }
    }

    fn write(&mut self) {
        self.entries.push(encode(&self.pool.take_records()));
        self.snapshots.push(self.pool.snapshot().encode());
    }

    fn crash(&mut self, now: Timestamp, snapshot: prop::sample::Index, last_is_lost: bool) {
        if last_is_lost {
            self.entries.pop();
            self.snapshots.pop();
        }
        let cut = snapshot.index(self.snapshots.len());
        let snapshot = Snapshot::decode(&self.snapshots[cut]).unwrap();
        let records: Vec<Record> = self.entries[cut..].iter().flat_map(|entry| decode(entry).unwrap()).collect();
        // Numbers of waiters begin anew, as they do in a process that was started again.
        self.pool = Pool::restore(limits(), now, Some(snapshot), records).unwrap();
    }
}

/// Goes through a history, in the pool and in the model.
fn history(steps: Vec<Step>) -> Result<(), TestCaseError> {
    let mut kept = Kept::new();
    let mut model = Model::default();
    let mut before_last = model.clone();
    let names: Vec<SessionId> = ["a", "b", "c"].map(SessionId::from).to_vec();
    let mut now = 0;
    for step in steps {
        if let Step::Wait(time) = step {
            now += time;
        }
        let at = moment(now);
        if let Step::Crash { snapshot, last_is_lost } = step {
            let last_is_lost = last_is_lost && !kept.entries.is_empty();
            kept.crash(at, snapshot, last_is_lost);
            if last_is_lost {
                model = before_last.clone();
            }
            model.restart(now);
            compare(&mut kept.pool, &mut model)?;
            // What is restored is written down already.
            prop_assert!(kept.pool.take_records().is_empty());
            before_last = model.clone();
            kept.snapshots = vec![kept.pool.snapshot().encode()];
            kept.entries.clear();
            continue;
        }
        let pool = &mut kept.pool;
        pool.advance(at);
        model.advance(now);
        // What became free while time went on is granted before the step.
        compare(pool, &mut model)?;
        kept.write();
        before_last = model.clone();
        let pool = &mut kept.pool;
        match step {
            Step::Wait(_) | Step::Crash { .. } => {}
            Step::KeepAlive(session) => {
                let created = pool.keep_alive(at, &names[session], "test", Duration::from_millis(TTL)).unwrap();
                prop_assert_eq!(created, model.expires[session].is_none());
                model.expires[session] = Some(now + TTL);
            }
            Step::Create(kind, capacity) => {
                // Several resources of one kind count as their sum.
                let spec = ResourceSpec::new(ResourceClass::Module, KINDS[kind]);
                let spec = spec.capacity(Quantity::from_thousandths(capacity));
                let spec = if kind == ARM { spec.standstill(Duration::from_millis(STANDSTILL)) } else { spec };
                let spec = if kind == CHARGE { spec.divisible().non_renewable() } else { spec };
                pool.create(at, None, spec).unwrap();
                model.capacity[kind] += capacity;
            }
            Step::DeleteUnit(kind) => {
                if model.expires[0].is_some() {
                    let one = requirement(ResourceOperation::Delete, kind, grain(kind));
                    let deleted = pool.delete_units(at, &names[0], &one).is_ok();
                    prop_assert_eq!(deleted, model.free(kind) >= grain(kind));
                    model.capacity[kind] -= u64::from(deleted) * grain(kind);
                }
            }
            Step::Acquire { session, units, consume, priority, patience } => {
                let operation = if consume { ResourceOperation::Consume } else { ResourceOperation::Block };
                let requirements: Vec<Requirement> = (0..4)
                    .filter(|kind| units[*kind] > 0)
                    .map(|kind| requirement(operation, kind, units[kind]))
                    .collect();
                // Who asks for nothing is refused.
                let asks = !requirements.is_empty();
                let mut request = AcquireRequest::new(names[session].clone(), requirements).priority(priority);
                request.deadline = patience.map(|time| moment(now + time));
                let result = pool.acquire(at, request);
                let deadline = patience.map(|time| now + time);
                // Behind all of its priority, as the pool numbers it.
                let id = WaiterId(u64::MAX);
                let waiter = ModelWaiter { id, session, units, consume, priority, deadline };
                let of_session = model.queue.iter().filter(|waiter| waiter.session == session).count();
                let full = model.queue.len() >= WAITERS || of_session >= WAITERS_OF_ONE;
                let waits = || {
                    let mut model = model.clone();
                    model.queue.push(waiter.clone());
                    !model.grant(&[]).contains(&id)
                };
                let welcome = asks && model.expires[session].is_some() && !(full && waits());
                prop_assert_eq!(result.is_ok(), welcome, "full: {}", full);
                if let Ok(id) = result {
                    model.queue.push(ModelWaiter { id, ..waiter });
                }
            }
            Step::Release(index) => {
                if let Some((lease, (session, _))) = model.leases.iter().nth(index).map(|(id, lease)| (*id, *lease)) {
                    pool.release(at, Some(&names[session]), lease).unwrap();
                    model.leases.remove(&lease);
                }
            }
            Step::Revoke(index) => {
                if let Some((lease, (session, _))) = model.leases.iter().nth(index).map(|(id, lease)| (*id, *lease)) {
                    // By another, or by a holder that does not know whether something still moves.
                    match index % 2 {
                        0 => pool.release(at, None, lease).unwrap(),
                        _ => pool.release_moving(at, Some(&names[session]), lease).unwrap(),
                    }
                    model.revoke(lease, now);
                }
            }
            Step::ConfirmStandstill(index) => {
                // Of one that lives nothing is to be confirmed.
                for (lease, resource) in model.leases.keys().zip(pool.list()) {
                    prop_assert!(!pool.confirm_standstill(at, None, *lease, &resource.id).unwrap());
                }
                if let Some(lease) = model.ending.keys().nth(index).copied() {
                    let left = pool
                        .list()
                        .into_iter()
                        .filter(|view| view.holders.ending().any(|ending| ending.lease == lease));
                    for resource in left.collect::<Vec<_>>() {
                        prop_assert!(pool.confirm_standstill(at, None, lease, &resource.id).unwrap());
                        prop_assert!(!pool.confirm_standstill(at, None, lease, &resource.id).unwrap());
                    }
                    model.ending.remove(&lease);
                }
            }
            Step::Cancel(index) => {
                if index < model.queue.len() {
                    pool.cancel(at, model.queue.remove(index).id).unwrap();
                }
            }
            Step::EndTask(session) => {
                let known = pool.end_task(at, &names[session]).is_ok();
                prop_assert_eq!(known, model.expires[session].is_some());
                model.consumed[session] = Units::default();
            }
        }
        compare(pool, &mut model)?;
        kept.write();
    }
    Ok(())
}

#[test]
fn the_second_request_of_a_session_comes_behind_the_first_of_another_whatever_its_priority() {
    let acquire = |session, [arms, planners]: [u64; 2], priority| {
        let units = [arms * UNIT, 0, planners * UNIT, 0];
        Step::Acquire { session, units, consume: false, priority, patience: None }
    };
    let planner = 2;
    let mut steps = vec![Step::Create(ARM, UNIT), Step::Create(ARM, 2 * UNIT), Step::Create(planner, 2 * UNIT)];
    steps.extend((0..SESSIONS).map(Step::KeepAlive));
    // One planner is held. The first session waits for the other one, too, with an arm; the second one waits for a planner with an arm; and what is left
    // are fewer arms than the first one wants besides.
    steps.extend([acquire(2, [0, 1], 0), acquire(0, [1, 2], 1), acquire(1, [1, 1], 0), acquire(0, [2, 0], 1)]);
    history(steps).unwrap();
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    #[test]
    fn every_history_grants_what_the_obvious_model_grants(steps in prop::collection::vec(step(), 1..80)) {
        history(steps)?;
    }

    #[test]
    fn nobody_is_overtaken_more_often_than_allowed(
        limit in 0..5_u32,
        steps in prop::collection::vec((0..3_usize, [0..5_u32, 0..3_u32], any::<prop::sample::Index>()), 1..120),
    ) {
        let mut pool = Pool::new(Limits { overtaken: limit, ..Limits::default() });
        let (at, session) = (Timestamp(0), SessionId::from("a"));
        pool.keep_alive(at, &session, "a", Duration::from_secs(1)).unwrap();
        // As much of each as anybody asks for, so that everybody could be served.
        for (kind, capacity) in [(0, 4), (1, 2)] {
            pool.create(at, None, ResourceSpec::new(ResourceClass::Module, KINDS[kind]).capacity(capacity)).unwrap();
        }
        // By waiter, in the order of arrival, which is that of service: what it wants, and how often it was overtaken.
        let mut waiting = BTreeMap::<WaiterId, ([u32; 2], u32)>::new();
        let mut held = Vec::new();
        for (action, units, index) in steps {
            if action == 0 {
                if !held.is_empty() {
                    let lease = held.swap_remove(index.index(held.len()));
                    pool.release(at, None, lease).unwrap();
                }
            } else if units != [0, 0] {
                let wanted = (0..2).filter(|kind| units[*kind] > 0);
                let wanted = wanted.map(|kind| requirement(ResourceOperation::Block, kind, u64::from(units[kind]) * UNIT)).collect();
                waiting.insert(pool.acquire(at, AcquireRequest::new(session.clone(), wanted)).unwrap(), (units, 0));
            }
            pool.check_invariants().map_err(TestCaseError::fail)?;
            for notice in pool.take_notices() {
                let Notice::Granted { waiter, lease } = notice else { continue };
                held.push(lease.id);
                let (taken, _) = waiting.remove(&waiter).unwrap();
                for (id, (units, overtaken)) in waiting.range_mut(..waiter) {
                    // One who wants a single kind lacks some of it as long as it waits.
                    let (one, shared) = (units.contains(&0), units.iter().zip(taken).any(|(a, b)| *a > 0 && b > 0));
                    *overtaken += u32::from(one && shared);
                    prop_assert!(*overtaken <= limit, "{id} was overtaken {overtaken} times, by {waiter} at last");
                }
            }
        }
        // Nobody waits for ever: when all is given back, one after the other, everybody has been served.
        while let Some(lease) = held.pop() {
            pool.release(at, None, lease).unwrap();
            for notice in pool.take_notices() {
                if let Notice::Granted { waiter, lease } = notice {
                    held.push(lease.id);
                    waiting.remove(&waiter);
                }
            }
        }
        prop_assert!(waiting.is_empty(), "still waiting: {waiting:?}");
    }
}

fn requirement(operation: ResourceOperation, kind: usize, thousandths: u64) -> Requirement {
    let count = Quantity::from_thousandths(thousandths);
    Requirement { count, ..Requirement::new(operation, KINDS[kind]) }
}

fn compare(pool: &mut Pool, model: &mut Model) -> Result<(), TestCaseError> {
    pool.check_invariants().map_err(TestCaseError::fail)?;
    let mut granted = Vec::new();
    for notice in pool.take_notices() {
        if let Notice::Granted { waiter, lease } = notice {
            prop_assert!(lease.token > model.last_token, "tokens grow strictly");
            model.last_token = lease.token;
            // All or nothing.
            let waiting = model.queue.iter().find(|waiting| waiting.id == waiter).unwrap();
            let expected = if waiting.consume { Units::default() } else { waiting.units };
            let of = |kind: &&str| lease.resources.iter().filter(|resource| resource.kind == **kind).count() as u64;
            let [arms, cameras, planners, charge] = KINDS.each_ref().map(of);
            let [whole @ .., parts] = expected;
            prop_assert_eq!([arms, cameras, planners].map(|count| count * UNIT), whole);
            // Parts are under a lease once per resource, however much that is; how much is compared below.
            prop_assert_eq!(charge > 0, parts > 0);
            granted.push((waiter, lease.id));
        }
    }
    let expected = model.grant(&granted);
    prop_assert_eq!(granted.iter().map(|(waiter, _)| *waiter).collect::<Vec<_>>(), expected);
    let mut free = Units::default();
    for resource in pool.list() {
        let kind = KINDS.iter().position(|kind| *kind == resource.kind).unwrap();
        free[kind] += resource.free.thousandths();
        // No unit has two holders.
        let held: Quantity = resource.holders.live().map(|holding| holding.units).sum();
        let ending: Quantity = resource.holders.ending().map(|ending| ending.units).sum();
        prop_assert_eq!(held + ending + resource.consumed + resource.free, resource.capacity);
    }
    prop_assert_eq!(free, [0, 1, 2, 3].map(|kind| model.free(kind)));
    for kind in 0..4 {
        let exists = pool.exists(&requirement(ResourceOperation::Exists, kind, 1));
        prop_assert_eq!(exists.thousandths(), model.quantity(kind), "created − consumed − deleted");
    }
    prop_assert_eq!(pool.waiters().len(), model.queue.len());
    prop_assert_eq!(pool.leases().len(), model.leases.len());
    Ok(())
}
