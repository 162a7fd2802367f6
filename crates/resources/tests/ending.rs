//! What ends at once ends over several turns where it is much, and nobody has it or gets it twice meanwhile.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::resource::{Requirement, ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use ratn_resources::{
    AcquireRequest, Limits, Pool, PoolError, Reply, Request, ResourceSpec, SessionId, Snapshot, decode, encode,
};
use std::time::Duration;

const NOW: Timestamp = Timestamp(0);
const TTL: Duration = Duration::from_secs(10);
/// More than ends in one turn.
const MANY: u32 = 5_000;
/// As many holdings end in one turn at the most, one more than a bound on work allows.
const IN_A_TURN: usize = 2_001;

fn session(name: &str) -> SessionId {
    SessionId::from(name)
}

fn tool() -> ResourceSpec {
    ResourceSpec::new(ResourceClass::Module, "Tool")
}

fn ask(name: &str, operation: ResourceOperation, count: u32) -> AcquireRequest {
    let tool = Requirement { count: count.into(), ..Requirement::new(operation, "Tool") };
    AcquireRequest::new(session(name), vec![tool])
}

/// With sessions `s` and `other`, and many tools that a session provides or nobody.
fn with_tools(provider: Option<&str>) -> Pool {
    let mut pool = Pool::new(Limits { history: 10, ..Limits::default() });
    pool.keep_alive(NOW, &session("s"), "s", TTL).unwrap();
    pool.keep_alive(NOW, &session("other"), "other", TTL * 10).unwrap();
    for _ in 0..MANY {
        pool.create(NOW, provider.map(session).as_ref(), tool()).unwrap();
    }
    pool
}

/// With a lease of each tool, some of them of the other session.
fn with_leases(hold_for: Option<Duration>) -> Pool {
    let mut pool = with_tools(None);
    for _ in 0..MANY {
        pool.acquire(NOW, AcquireRequest { hold_for, ..ask("s", ResourceOperation::Block, 1) }).unwrap();
    }
    assert_eq!(pool.leases().len(), MANY as usize);
    pool
}

/// Takes turns until nothing is left to do; how much of what is counted went in each.
fn turns(pool: &mut Pool, now: Timestamp, count: impl Fn(&Pool) -> usize) -> Vec<usize> {
    let mut went = Vec::new();
    while pool.next_deadline() == Some(now) {
        let before = count(pool);
        pool.advance(now);
        went.push(before - count(pool));
    }
    went
}

fn bounded(went: &[usize], in_all: usize) {
    assert!(went.len() > 1 && went.iter().all(|went| *went <= IN_A_TURN), "{went:?}");
    assert_eq!(went.iter().sum::<usize>(), in_all);
}

#[test]
fn the_leases_of_a_session_that_ends_end_over_several_turns_and_the_session_is_gone_at_once() {
    let mut pool = with_leases(None);
    pool.acquire(NOW, ask("s", ResourceOperation::Block, 1)).unwrap();
    pool.acquire(NOW, ask("other", ResourceOperation::Block, 1)).unwrap();
    pool.close_session(NOW, &session("s")).unwrap();
    assert!(!pool.has_session(&session("s")) && pool.next_deadline() == Some(NOW));
    assert_eq!(pool.waiting(), 0, "its waiter has left, and the other was served");
    let unknown = PoolError::UnknownSession { session: session("s") };
    assert_eq!(pool.acquire(NOW, ask("s", ResourceOperation::Block, 1)).unwrap_err(), unknown);
    assert_eq!(pool.close_session(NOW, &session("s")).unwrap_err(), unknown);
    let again = pool.keep_alive(NOW, &session("s"), "s", TTL).unwrap_err();
    assert_eq!(again, PoolError::SessionEnding { session: session("s") });
    let left = pool.leases().len() - 1;
    bounded(&turns(&mut pool, NOW, |pool| pool.leases().len()), left);
    assert!(pool.keep_alive(NOW, &session("s"), "s", TTL).unwrap(), "nothing of before is left");
    pool.check_invariants().unwrap();
}

#[test]
fn sessions_that_expire_together_end_over_several_turns() {
    let mut pool = with_leases(None);
    pool.keep_alive(NOW, &session("small"), "small", TTL).unwrap();
    let then = Timestamp(0) + TTL;
    pool.advance(then);
    assert!(!pool.has_session(&session("s")) && !pool.has_session(&session("small")));
    let left = pool.leases().len();
    bounded(&turns(&mut pool, then, |pool| pool.leases().len()), left);
    assert_eq!(pool.sessions().len(), 1);
    pool.check_invariants().unwrap();
}

#[test]
fn a_session_goes_on_ending_after_a_restart() {
    let limits = || Limits { history: 10, ..Limits::default() };
    let mut pool = with_leases(None);
    let before = pool.snapshot().encode();
    pool.take_records();
    pool.close_session(NOW, &session("s")).unwrap();
    let entry = encode(&pool.take_records());
    let from_records = Pool::restore(limits(), NOW, Some(Snapshot::decode(&before).unwrap()), decode(&entry).unwrap());
    let from_snapshot = Pool::restore(limits(), NOW, Some(pool.snapshot()), []);
    for again in [from_records, from_snapshot] {
        let mut again = again.unwrap().with_session_grace(TTL);
        assert!(!again.has_session(&session("s")) && again.has_session(&session("other")));
        assert_eq!(again.leases().len(), pool.leases().len());
        again.check_invariants().unwrap();
        let left = again.leases().len();
        bounded(&turns(&mut again, NOW, |pool| pool.leases().len()), left);
        assert_eq!(again.sessions().len(), 1);
        again.check_invariants().unwrap();
    }
}

#[test]
fn what_an_ending_session_provides_is_given_to_nobody() {
    let mut pool = with_tools(Some("s"));
    pool.acquire(NOW, ask("other", ResourceOperation::Block, 10)).unwrap();
    pool.close_session(NOW, &session("s")).unwrap();
    assert!(!pool.list().is_empty());
    pool.acquire(NOW, ask("other", ResourceOperation::Block, 1)).unwrap();
    assert_eq!((pool.leases().len(), pool.waiting()), (1, 1));
    pool.check_invariants().unwrap();
    let left = pool.list().len();
    bounded(&turns(&mut pool, NOW, |pool| pool.list().len()), left);
    assert_eq!((pool.leases().len(), pool.waiting()), (1, 1));
    pool.create(NOW, None, tool()).unwrap();
    assert_eq!((pool.leases().len(), pool.waiting()), (2, 0));
    pool.check_invariants().unwrap();
}

/// It was reserved before the session began to end, for one who could not be served then.
#[test]
fn what_an_ending_session_provides_is_not_given_to_whom_it_was_reserved_for() {
    let mut pool = with_tools(Some("s"));
    pool.set_limits(Limits { leases: 1, leases_for_operators: 0, ..Limits::default() });
    let single = |kind| ResourceSpec::new(ResourceClass::Module, kind).id(kind);
    let ask_for = |kind| AcquireRequest::new(session("other"), vec![Requirement::new(ResourceOperation::Block, kind)]);
    pool.create(NOW, Some(&session("s")), single("Arm")).unwrap();
    pool.create(NOW, None, single("Camera")).unwrap();
    pool.acquire(NOW, ask_for("Camera")).unwrap();
    let camera = pool.leases()[0].id;
    pool.acquire(NOW, ask_for("Arm")).unwrap();
    assert_eq!((pool.leases().len(), pool.waiting()), (1, 1), "there may be one lease");
    pool.close_session(NOW, &session("s")).unwrap();
    assert!(pool.get("Arm").is_some(), "it goes in a later turn");
    pool.release(NOW, None, camera).unwrap();
    assert_eq!((pool.leases().len(), pool.waiting()), (0, 1), "its provider has ended");
    let left = pool.list().len();
    let went = turns(&mut pool, NOW, |pool| pool.list().len());
    assert_eq!(went.iter().sum::<usize>(), left - 1, "all but the camera");
    assert_eq!((pool.leases().len(), pool.waiting()), (0, 1));
    pool.check_invariants().unwrap();
    pool.create(NOW, None, single("Arm")).unwrap();
    assert_eq!((pool.leases().len(), pool.waiting()), (1, 0));
    pool.check_invariants().unwrap();
}

#[test]
fn what_a_session_consumed_returns_over_several_turns() {
    let mut pool = with_tools(None);
    for _ in 0..MANY / 1_000 {
        pool.acquire(NOW, ask("s", ResourceOperation::Consume, 1_000)).unwrap();
    }
    let tools = || Requirement::new(ResourceOperation::Exists, "Tool");
    assert!(pool.exists(&tools()).is_zero());
    pool.close_session(NOW, &session("s")).unwrap();
    let missing = |pool: &Pool| (u64::from(MANY) - pool.exists(&tools()).thousandths() / 1_000) as usize;
    let left = missing(&pool);
    bounded(&turns(&mut pool, NOW, missing), left);
    pool.check_invariants().unwrap();
}

#[test]
fn what_a_task_consumed_returns_over_several_calls_and_a_restart_in_between_goes_on_with_it() {
    let mut pool = with_tools(None);
    for _ in 0..MANY / 1_000 {
        pool.acquire(NOW, ask("s", ResourceOperation::Consume, 1_000)).unwrap();
    }
    let consumed =
        |pool: &Pool| pool.list().iter().map(|view| view.consumed.thousandths() / 1_000).sum::<u64>() as usize;
    let end = |pool: &mut Pool| pool.handle(NOW, "end", Request::EndTask { session: session("s") }).unwrap();
    let mut left = vec![consumed(&pool)];
    let before = pool.snapshot();
    pool.take_records();
    assert_eq!(end(&mut pool), Reply::Unfinished);
    let records = decode(&encode(&pool.take_records())).unwrap();
    let mut again = Pool::restore(Limits { history: 10, ..Limits::default() }, NOW, Some(before), records).unwrap();
    again.check_invariants().unwrap();
    left.push(consumed(&again));
    assert_eq!(left[1], consumed(&pool));
    while end(&mut again) == Reply::Unfinished {
        left.push(consumed(&again));
        again.check_invariants().unwrap();
    }
    left.push(consumed(&again));
    assert!(left.windows(2).all(|two| two[0] > two[1] && two[0] - two[1] <= IN_A_TURN), "{left:?}");
    assert_eq!((left.last(), end(&mut again)), (Some(&0), Reply::Done));
    // What returned stays so where the grants are taken back.
    for lease in again.leases() {
        again.undo_grant(NOW, lease.id).unwrap();
    }
    assert_eq!(again.exists(&Requirement::new(ResourceOperation::Exists, "Tool")), MANY);
    again.check_invariants().unwrap();
}

#[test]
fn leases_that_were_held_too_long_end_over_several_turns() {
    let mut pool = with_leases(Some(TTL));
    pool.keep_alive(NOW, &session("s"), "s", TTL * 10).unwrap();
    let then = Timestamp(0) + TTL;
    pool.advance(then);
    // One of those that are due is given back before its turn.
    let last = pool.leases().last().unwrap().id;
    pool.release(then, Some(&session("s")), last).unwrap();
    pool.check_invariants().unwrap();
    let left = pool.leases().len();
    bounded(&turns(&mut pool, then, |pool| pool.leases().len()), left);
    pool.check_invariants().unwrap();
}
