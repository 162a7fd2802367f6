//! What a lease leaves when it ends otherwise than by its holder's release: units whose provider has to stop something first.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::id::LeaseId;
use ratn_model::resource::{Requirement, ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_resources::{
    AcquireRequest, Change, LONGEST_STANDSTILL_MS, Limits, Notice, Pool, PoolError, Reply, Request, ResourceSpec,
    STANDSTILL_ATTRIBUTE, SessionId, Snapshot, Speaker, decode, encode,
};
use std::time::Duration;

const BOUND: Duration = Duration::from_millis(1_500);

/// `cell` provides an arm that needs up to 1.5 s to stop, `a` holds it, and `b` waits for it.
struct Bench {
    pool: Pool,
    lease: LeaseId,
}

impl Bench {
    fn new(limits: Limits) -> Bench {
        let mut pool = Pool::new(limits);
        for (name, seconds) in [("cell", 60), ("a", 2), ("b", 60)] {
            pool.keep_alive(at(0), &session(name), name, Duration::from_secs(seconds)).unwrap();
        }
        pool.create(at(0), Some(&session("cell")), arm().standstill(BOUND)).unwrap();
        let mut bench = Bench { pool, lease: LeaseId(0) };
        bench.wait(0, "a");
        bench.lease = bench.granted()[0];
        bench.wait(0, "b");
        assert!(bench.granted().is_empty());
        bench
    }

    fn wait(&mut self, ms: u64, name: &str) {
        let block = Requirement::new(ResourceOperation::Block, "Arm");
        self.pool.acquire(at(ms), AcquireRequest::new(session(name), vec![block])).unwrap();
    }

    fn granted(&mut self) -> Vec<LeaseId> {
        let notices = self.notices();
        let granted = |notice| if let Notice::Granted { lease, .. } = notice { Some(lease.id) } else { None };
        notices.into_iter().filter_map(granted).collect()
    }

    fn notices(&mut self) -> Vec<Notice> {
        self.pool.check_invariants().unwrap();
        self.pool.take_notices()
    }

    fn changes(&mut self) -> Vec<Change> {
        let change = |notice| if let Notice::Event(event) = notice { Some(event.change.clone()) } else { None };
        self.notices().into_iter().filter_map(change).collect()
    }

    fn confirm(&mut self, ms: u64, name: &str) -> Result<bool, PoolError> {
        self.pool.confirm_standstill(at(ms), Some(&session(name)), self.lease, "arm")
    }

    fn explained(&self) -> String {
        let (waiter, _) = self.pool.waiters().remove(0);
        self.pool.explain(waiter).unwrap().to_string()
    }
}

fn at(ms: u64) -> Timestamp {
    Timestamp(ms * 1_000_000)
}

fn session(name: &str) -> SessionId {
    SessionId::from(name)
}

fn arm() -> ResourceSpec {
    ResourceSpec::new(ResourceClass::Module, "Arm").id("arm")
}

#[test]
fn what_a_lost_session_held_is_granted_when_its_provider_has_confirmed_standstill_and_not_before() {
    let mut bench = Bench::new(Limits::default());
    bench.pool.advance(at(2_000));
    let changes = bench.changes();
    let [Change::LeaseEnded { resources, .. }] = &changes[..] else {
        panic!("the provider hears at once: {changes:?}")
    };
    assert!(resources[0].free.is_zero() && resources[0].holders.live().next().is_none());
    let left = resources[0].holders.ending().next().unwrap();
    assert_eq!((left.lease, left.within), (bench.lease, BOUND));
    bench.pool.advance(at(2_400));
    assert!(bench.granted().is_empty());
    let waits =
        "`block Arm`: lease-1 is ending: waits for session cell to confirm that arm stands still, up to 1100 ms";
    assert_eq!(bench.explained(), waits);
    assert!(matches!(bench.confirm(2_400, "b"), Err(PoolError::NotYours { .. })), "only its provider knows");
    assert_eq!(bench.confirm(2_500, "cell"), Ok(true));
    let changes = bench.changes();
    assert!(
        matches!(&changes[..], [Change::UnitsFreed { confirmed: true, .. }, Change::LeaseGranted { .. }]),
        "{changes:?}"
    );
    assert_eq!(bench.confirm(2_600, "cell"), Ok(false), "there is nothing left to confirm");
}

#[test]
fn a_provider_that_does_not_confirm_is_waited_for_as_long_as_it_asked_for_and_no_longer() {
    let mut bench = Bench::new(Limits::default());
    bench.pool.advance(at(2_000));
    assert_eq!(bench.pool.next_deadline(), Some(at(3_500)));
    bench.pool.advance(at(3_499));
    assert!(bench.granted().is_empty());
    bench.pool.advance(at(3_500));
    let changes = bench.changes();
    assert!(
        matches!(changes[..], [Change::UnitsFreed { confirmed: false, .. }, Change::LeaseGranted { .. }]),
        "{changes:?}"
    );
}

#[test]
fn what_its_holder_gives_back_is_free_at_once_and_what_somebody_else_ends_is_not() {
    let mut bench = Bench::new(Limits::default());
    bench.pool.release(at(1), Some(&session("a")), bench.lease).unwrap();
    let [again] = bench.granted()[..] else { panic!("b has it") };
    bench.wait(1, "a");
    bench.pool.release(at(2), None, again).unwrap();
    assert!(bench.granted().is_empty());
    bench.lease = again;
    assert_eq!(bench.confirm(3, "cell"), Ok(true));
    assert_eq!(bench.granted().len(), 1);
}

#[test]
fn of_what_no_session_provides_the_leases_own_session_says_that_it_stands_still() {
    let mut pool = Pool::new(Limits::default());
    for name in ["a", "b"] {
        pool.keep_alive(at(0), &session(name), name, Duration::from_secs(60)).unwrap();
    }
    pool.create(at(0), None, arm().standstill(BOUND)).unwrap();
    let mut bench = Bench { pool, lease: LeaseId(0) };
    bench.wait(0, "a");
    bench.lease = bench.granted()[0];
    bench.pool.release(at(1), None, bench.lease).unwrap();
    assert!(matches!(bench.confirm(2, "b"), Err(PoolError::NotYours { .. })));
    assert_eq!(bench.confirm(2, "a"), Ok(true));
}

#[test]
fn a_lease_that_lives_is_not_ended_by_a_confirmation() {
    let mut bench = Bench::new(Limits::default());
    assert_eq!(bench.confirm(1, "cell"), Ok(false));
    assert_eq!(bench.pool.leases().len(), 1);
    let unknown = bench.pool.confirm_standstill(at(1), None, bench.lease, "leg");
    assert!(matches!(unknown, Err(PoolError::UnknownResource { .. })));
}

#[test]
fn after_a_restart_what_was_ending_still_is_and_its_bound_begins_anew() {
    let mut bench = Bench::new(Limits::default());
    bench.pool.advance(at(2_000));
    let (records, snapshot) = (decode(&encode(&bench.pool.take_records())).unwrap(), bench.pool.snapshot().encode());
    let from_records = Pool::restore(Limits::default(), at(100), None, records).unwrap();
    let snapshot = Snapshot::decode(&snapshot).unwrap();
    let from_snapshot = Pool::restore(Limits::default(), at(100), Some(snapshot), []).unwrap();
    for pool in [from_records, from_snapshot] {
        let mut bench = Bench { pool, lease: bench.lease };
        bench.wait(100, "b");
        assert!(bench.granted().is_empty());
        let mut confirmed = Bench { pool: bench.pool.clone(), lease: bench.lease };
        bench.pool.advance(at(1_599));
        assert!(bench.granted().is_empty());
        bench.pool.advance(at(1_600));
        assert_eq!(bench.granted().len(), 1);
        let confirm = Request::ConfirmStandstill {
            session: Some(session("cell")),
            lease: bench.lease,
            resource: "arm".to_owned(),
        };
        assert_eq!(confirmed.pool.handle(at(101), "once", confirm.clone()), Ok(Reply::Touched(vec!["arm".to_owned()])));
        assert_eq!(confirmed.pool.handle(at(102), "once", confirm), Ok(Reply::Touched(vec!["arm".to_owned()])));
        assert_eq!(confirmed.granted().len(), 1);
    }
}

#[test]
fn with_its_provider_goes_what_was_ending_and_a_new_one_offers_it_free() {
    let mut bench = Bench::new(Limits::default());
    bench.pool.advance(at(2_000));
    bench.pool.close_session(at(2_100), &session("cell")).unwrap();
    assert!(bench.granted().is_empty() && bench.pool.get("arm").is_none());
    bench.pool.keep_alive(at(2_200), &session("cell"), "cell", Duration::from_secs(60)).unwrap();
    bench.pool.create(at(2_200), Some(&session("cell")), arm().standstill(BOUND)).unwrap();
    assert_eq!(bench.granted().len(), 1);
    bench.pool.advance(at(10_000));
    assert_eq!(bench.pool.leases().len(), 1, "the old bound is nobody's");
}

#[test]
fn a_lease_that_ends_counts_among_the_leases_until_its_units_are_free() {
    let mut bench = Bench::new(Limits { leases: 1, ..Limits::default() });
    bench.pool.create(at(0), None, ResourceSpec::new(ResourceClass::Module, "Camera")).unwrap();
    let camera = Requirement::new(ResourceOperation::Block, "Camera");
    bench.pool.acquire(at(0), AcquireRequest::new(session("b"), vec![camera]).priority(1)).unwrap();
    bench.pool.advance(at(2_000));
    assert!(bench.granted().is_empty());
    assert_eq!(bench.confirm(2_001, "cell"), Ok(true));
    assert_eq!(bench.granted().len(), 1);
}

#[test]
fn a_bound_is_whole_milliseconds_up_to_the_longest() {
    let mut pool = Pool::new(Limits::default());
    let mut create = |value| pool.create(at(0), None, arm().attribute(STANDSTILL_ATTRIBUTE, value)).map(drop);
    let longest = i64::try_from(LONGEST_STANDSTILL_MS).unwrap();
    for value in [0, 1, longest] {
        create(Value::Int(value)).unwrap();
    }
    for value in [Value::Int(longest + 1), Value::Int(-1), Value::Float(1.0), Value::String("1".to_owned())] {
        let refused = create(value).unwrap_err().to_string();
        assert_eq!(refused, "attribute standstill_ms of Arm: it is a whole number of milliseconds from 0 to 60000");
    }
}

#[test]
fn standstill_of_what_no_session_provides_is_confirmed_by_the_opener_of_the_lost_session_and_by_nobody_else() {
    let speaker = |name: &str| Speaker { name: name.into(), for_anybody: false };
    let opened = |pool: &mut Pool, name: &str| {
        pool.keep_alive_as(at(100), &speaker(name), &session("a"), name, Duration::from_secs(60)).unwrap();
    };
    let mut pool = Pool::new(Limits { kept_session_ids: 0, ..Limits::default() });
    pool.keep_alive_as(at(0), &speaker("adam"), &session("a"), "a", Duration::from_millis(50)).unwrap();
    pool.create(at(0), None, arm().standstill(BOUND)).unwrap();
    let block = Requirement::new(ResourceOperation::Block, "Arm");
    pool.acquire(at(0), AcquireRequest::new(session("a"), vec![block])).unwrap();
    let lease = pool.leases()[0].id;
    pool.advance(at(100));
    let entry = encode(&pool.take_records());
    let snapshot = Snapshot::decode(&pool.snapshot().encode()).unwrap();
    // Its id is anybody's again, so that another can open it.
    let limits = Limits { kept_session_ids: 0, ..Limits::default() };
    let of_records = Pool::restore(limits.clone(), at(100), None, decode(&entry).unwrap()).unwrap();
    let of_snapshot = Pool::restore(limits, at(100), Some(snapshot), []).unwrap();
    for pool in [pool, of_records, of_snapshot] {
        let confirm = |pool: &mut Pool, name: &str| {
            let confirm = Request::ConfirmStandstill { session: Some(session("a")), lease, resource: "arm".to_owned() };
            pool.handle_as(at(101), &speaker(name), "", confirm)
        };
        for opens in [false, true] {
            let mut pool = pool.clone();
            if opens {
                opened(&mut pool, "mallory");
            }
            let refused = confirm(&mut pool, "mallory");
            assert!(matches!(refused, Err(PoolError::SessionOfAnother { .. })), "{opens}: {refused:?}");
        }
        for opens in [false, true] {
            let mut pool = pool.clone();
            if opens {
                opened(&mut pool, "adam");
            }
            assert_eq!(confirm(&mut pool, "adam"), Ok(Reply::Touched(vec!["arm".to_owned()])));
        }
        let mut pool = pool;
        assert_eq!(pool.confirm_standstill(at(101), None, lease, "arm"), Ok(true), "an operator");
    }
}

#[test]
fn a_holder_that_does_not_know_that_nothing_moves_gives_back_what_is_free_when_its_provider_has_confirmed() {
    let mut bench = Bench::new(Limits::default());
    bench.pool.release_moving(at(10), Some(&session("a")), bench.lease).unwrap();
    assert!(bench.granted().is_empty());
    assert!(bench.confirm(20, "cell").unwrap());
    assert_eq!(bench.granted().len(), 1);
    // Nobody confirms: the bound decides.
    let mut bench = Bench::new(Limits::default());
    let release = Request::Release { session: Some(session("a")), lease: bench.lease, at_rest: false };
    bench.pool.handle(at(10), "r", release).unwrap();
    bench.pool.advance(at(1_500));
    assert!(bench.granted().is_empty());
    bench.pool.advance(at(1_510));
    assert_eq!(bench.granted().len(), 1);
}
