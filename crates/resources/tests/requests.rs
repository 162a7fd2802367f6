//! Requests that are repeated: which answers are remembered, for whom, and for how many requests of others.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::resource::{OperatedUnits, Quantity, Requirement, ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use ratn_resources::{
    AcquireRequest, Limits, Pool, PoolError, Reply, Request, ResourceSpec, SessionId, Snapshot, Speaker, decode, encode,
};
use std::time::Duration;

const NOW: Timestamp = Timestamp(0);

fn speaker(name: &str) -> Speaker {
    Speaker { name: name.into(), for_anybody: false }
}

fn operator() -> Speaker {
    Speaker { name: "root".into(), for_anybody: true }
}

/// Everybody has a session of their own name.
fn pool_of(limits: Limits, names: &[&str]) -> Pool {
    let mut pool = Pool::new(limits);
    for name in names {
        open(&mut pool, name);
    }
    pool
}

fn open(pool: &mut Pool, name: &str) {
    pool.keep_alive_as(NOW, &speaker(name), &SessionId::from(name), name, Duration::from_secs(10)).unwrap();
}

fn create(name: &str, kind: &str) -> Request {
    Request::Create { session: Some(SessionId::from(name)), spec: ResourceSpec::new(ResourceClass::Module, kind) }
}

fn acquire(name: &str, kind: &str) -> Request {
    let block = Requirement::new(ResourceOperation::Block, kind);
    Request::Acquire(AcquireRequest::new(SessionId::from(name), vec![block]))
}

/// The id of what was created.
fn created(pool: &mut Pool, name: &str, request: &str) -> String {
    match pool.handle_as(NOW, &speaker(name), request, create(name, "Tool")) {
        Ok(Reply::Created { id, .. }) => id,
        other => panic!("{other:?}"),
    }
}

/// As a manager that is started again finds it: of the records alone, or of a snapshot.
fn restarted(mut pool: Pool, limits: &Limits, records: bool) -> Pool {
    let entry = encode(&pool.take_records());
    let snapshot = Snapshot::decode(&pool.snapshot().encode()).unwrap();
    let again = if records {
        Pool::restore(limits.clone(), NOW, None, decode(&entry).unwrap())
    } else {
        Pool::restore(limits.clone(), NOW, Some(snapshot), [])
    };
    let again = again.unwrap();
    again.check_invariants().unwrap();
    again
}

#[test]
fn the_same_request_id_of_another_caller_is_another_request_also_after_a_restart() {
    for records in [false, true] {
        let limits = Limits::default();
        let mut pool = pool_of(limits.clone(), &["adam", "eve"]);
        let (adams, eves) = (created(&mut pool, "adam", "r1"), created(&mut pool, "eve", "r1"));
        assert_ne!(adams, eves);
        let other = pool.handle_as(NOW, &speaker("eve"), "r1", create("eve", "Arm"));
        assert_eq!(other, Err(PoolError::RequestIdReused { id: "r1".to_owned() }), "but hers she has used");
        // Both wait under one id, too.
        let mut waiters = Vec::new();
        for name in ["adam", "eve"] {
            let Ok(Reply::Queued(waiter)) = pool.handle_as(NOW, &speaker(name), "r2", acquire(name, "Arm")) else {
                panic!("there is no arm")
            };
            assert_eq!(pool.waiter_of(&name.into(), "r2"), Some(waiter));
            waiters.push(waiter);
        }
        assert_eq!(pool.waiter_of(&"who only looks".into(), "r2"), Some(waiters[0]));
        assert_eq!(pool.waiter_of(&"eve".into(), "r3"), None);
        assert!(pool.withdraw(NOW, &SessionId::from("eve"), "r2").unwrap());
        assert!(!pool.withdraw(NOW, &SessionId::from("eve"), "r2").unwrap(), "the other is not hers");
        pool.check_invariants().unwrap();
        let mut pool = restarted(pool, &limits, records);
        assert_eq!((created(&mut pool, "adam", "r1"), created(&mut pool, "eve", "r1")), (adams, eves));
    }
}

#[test]
fn a_request_that_an_operator_makes_for_a_session_has_the_name_space_of_its_opener() {
    let mut pool = pool_of(Limits::default(), &["adam"]);
    let first = created(&mut pool, "adam", "r1");
    let again = pool.handle_as(NOW, &operator(), "r1", create("adam", "Tool")).unwrap();
    assert!(matches!(again, Reply::Created { id, .. } if id == first));
    let own = Request::Create { session: None, spec: ResourceSpec::new(ResourceClass::Module, "Tool") };
    let Ok(Reply::Created { id, .. }) = pool.handle_as(NOW, &operator(), "r1", own) else { panic!() };
    assert_ne!(id, first);
}

#[test]
fn whoever_makes_many_requests_forgets_their_own_answers_and_nobody_elses() {
    let by_number = Limits { remembered_requests: 20, ..Limits::default() };
    let per_caller = Limits { remembered_per_caller: 8, ..Limits::default() };
    let by_bytes = Limits { remembered_bytes_per_caller: 4_000, ..Limits::default() };
    for limits in [by_number, per_caller, by_bytes] {
        let mut pool = pool_of(limits.clone(), &["adam", "eve", "mallory"]);
        let mut kept = Vec::new();
        for n in 0..5 {
            for name in ["adam", "eve"] {
                kept.push((name, n, created(&mut pool, name, &format!("r{n}"))));
            }
        }
        let first = created(&mut pool, "mallory", "r0");
        for n in 1..60 {
            created(&mut pool, "mallory", &format!("r{n}"));
            pool.check_invariants().unwrap();
        }
        for (name, n, id) in kept {
            assert_eq!(created(&mut pool, name, &format!("r{n}")), id, "{name} asks again: {limits:?}");
        }
        assert_ne!(created(&mut pool, "mallory", "r0"), first, "{limits:?}");
        let entry = encode(&pool.take_records());
        let again = Pool::restore(limits, NOW, None, decode(&entry).unwrap()).unwrap();
        assert_eq!(again.snapshot(), pool.snapshot());
    }
}

#[test]
fn answers_with_long_lists_of_ids_are_bounded_by_their_bytes_and_the_newest_is_kept_whatever_it_has() {
    let limits = Limits { remembered_bytes_per_caller: 2_000, ..Limits::default() };
    let mut pool = pool_of(limits, &["adam"]);
    for _ in 0..100 {
        pool.handle_as(NOW, &speaker("adam"), "", create("adam", "Tool")).unwrap();
    }
    let delete = |count: u32| Request::DeleteUnits {
        session: SessionId::from("adam"),
        requirement: Requirement { count: count.into(), ..Requirement::new(ResourceOperation::Delete, "Tool") },
    };
    let short = pool.handle_as(NOW, &speaker("adam"), "short", delete(1)).unwrap();
    assert_eq!(pool.handle_as(NOW, &speaker("adam"), "short", delete(1)).unwrap(), short);
    let long = pool.handle_as(NOW, &speaker("adam"), "long", delete(90)).unwrap();
    pool.check_invariants().unwrap();
    assert_eq!(pool.handle_as(NOW, &speaker("adam"), "long", delete(90)).unwrap(), long);
    let again = pool.handle_as(NOW, &speaker("adam"), "short", delete(1)).unwrap();
    assert_ne!(again, short, "it was forgotten for the long one");
    pool.check_invariants().unwrap();
}

#[test]
fn a_lease_that_was_undone_is_acquired_anew_after_a_restart_too() {
    for records in [false, true] {
        let limits = Limits::default();
        let mut pool = pool_of(limits.clone(), &["adam"]);
        pool.handle_as(NOW, &speaker("adam"), "", create("adam", "Arm")).unwrap();
        pool.handle_as(NOW, &speaker("adam"), "r1", acquire("adam", "Arm")).unwrap();
        let first = pool.leases().remove(0);
        assert!(pool.withdraw(NOW, &SessionId::from("adam"), "r1").unwrap());
        let mut pool = restarted(pool, &limits, records);
        assert!(matches!(pool.handle_as(NOW, &speaker("adam"), "r1", acquire("adam", "Arm")), Ok(Reply::Queued(_))));
        assert!(pool.leases().remove(0).token > first.token);
    }
}

/// One session of adam's that lives again under its id, and between that lives another restart, if at all.
fn reopened(mut pool: Pool, limits: &Limits, restart: Option<bool>) -> Pool {
    pool.close_session(NOW, &SessionId::from("adam")).unwrap();
    let mut pool = restart.into_iter().fold(pool, |pool, records| restarted(pool, limits, records));
    open(&mut pool, "adam");
    pool
}

#[test]
fn what_ended_with_an_earlier_life_of_a_session_is_done_anew_for_the_next_one() {
    for restart in [None, Some(false), Some(true)] {
        let limits = Limits::default();
        let mut pool = pool_of(limits.clone(), &["adam"]);
        let renewable = ResourceSpec::new(ResourceClass::Module, "Power");
        let powered = pool.create(NOW, None, renewable).unwrap().description.id.clone();
        for kind in ["Arm", "Hand"] {
            pool.create(NOW, None, ResourceSpec::new(ResourceClass::Module, kind)).unwrap();
        }
        let requirement = Requirement::new(ResourceOperation::Consume, "Power");
        let consume =
            Request::Consume { session: SessionId::from("adam"), requirement: requirement.clone(), resource: None };
        let ask = |pool: &mut Pool, id: &str, request: Request| pool.handle_as(NOW, &speaker("adam"), id, request);
        let touched = Ok(Reply::Operated(vec![OperatedUnits {
            resource: powered.clone(),
            kind: "Power".to_owned(),
            units: Quantity::ONE,
            ends_with_session: true,
        }]));
        assert_eq!(ask(&mut pool, "consume", consume.clone()), touched);
        assert_eq!(ask(&mut pool, "consume", consume.clone()), touched, "once: there is one of it");
        let tool = created(&mut pool, "adam", "create");
        let Ok(Reply::Queued(_)) = ask(&mut pool, "acquire", acquire("adam", "Arm")) else { panic!() };
        let Ok(Reply::Granted(lease)) = ask(&mut pool, "acquire", acquire("adam", "Arm")) else { panic!() };
        ask(&mut pool, "late", acquire("adam", "Hand")).unwrap();
        let mut pool = reopened(pool, &limits, restart);
        assert_eq!(pool.exists(&requirement), Quantity::ONE, "it came back");
        assert_eq!(ask(&mut pool, "consume", consume.clone()), touched);
        assert!(pool.exists(&requirement).is_zero(), "and is consumed: {restart:?}");
        assert_ne!(created(&mut pool, "adam", "create"), tool);
        assert!(!pool.withdraw(NOW, &SessionId::from("adam"), "late").unwrap());
        let late = ask(&mut pool, "late", acquire("adam", "Hand"));
        assert!(matches!(late, Err(PoolError::Withdrawn { .. })), "it was on its way: {late:?} {restart:?}");
        let Ok(Reply::Queued(_)) = ask(&mut pool, "acquire", acquire("adam", "Arm")) else { panic!() };
        let Ok(Reply::Granted(anew)) = ask(&mut pool, "acquire", acquire("adam", "Arm")) else { panic!() };
        assert!(anew.id > lease.id);
        // Also the end of the task is one of this life.
        assert_eq!(ask(&mut pool, "end", Request::EndTask { session: SessionId::from("adam") }), Ok(Reply::Done));
        let mut pool = reopened(pool, &limits, None);
        assert_eq!(ask(&mut pool, "consume", consume), touched);
        assert_eq!(ask(&mut pool, "end", Request::EndTask { session: SessionId::from("adam") }), Ok(Reply::Done));
        assert_eq!(pool.exists(&requirement), Quantity::ONE, "{restart:?}");
        pool.check_invariants().unwrap();
    }
}

#[test]
fn what_outlasts_a_session_is_done_once_for_all_its_lives() {
    for restart in [None, Some(false), Some(true)] {
        let limits = Limits::default();
        let mut pool = pool_of(limits.clone(), &["adam"]);
        for _ in 0..4 {
            pool.create(NOW, None, ResourceSpec::new(ResourceClass::Module, "Screw").non_renewable()).unwrap();
        }
        let of = |operation| Requirement::new(operation, "Screw");
        let session = SessionId::from("adam");
        let consume =
            Request::Consume { session: session.clone(), requirement: of(ResourceOperation::Consume), resource: None };
        let delete = Request::DeleteUnits { session, requirement: of(ResourceOperation::Delete) };
        let ask = |pool: &mut Pool, id: &str, request| pool.handle_as(NOW, &speaker("adam"), id, request).unwrap();
        let first = (ask(&mut pool, "c", consume.clone()), ask(&mut pool, "d", delete.clone()));
        let mut pool = reopened(pool, &limits, restart);
        assert_eq!((ask(&mut pool, "c", consume), ask(&mut pool, "d", delete)), first, "{restart:?}");
        assert_eq!(pool.exists(&of(ResourceOperation::Exists)), Quantity::whole(2), "one used up, one deleted");
    }
}

#[test]
fn what_a_session_deletes_of_its_own_is_of_its_life_and_is_deleted_anew_in_the_next() {
    let mut pool = pool_of(Limits::default(), &["adam"]);
    let delete = Request::DeleteUnits {
        session: SessionId::from("adam"),
        requirement: Requirement::new(ResourceOperation::Delete, "Tool"),
    };
    for _ in 0..2 {
        created(&mut pool, "adam", "create");
        pool.handle_as(NOW, &speaker("adam"), "delete", delete.clone()).unwrap();
        assert!(pool.list().is_empty());
        pool = reopened(pool, &Limits::default(), None);
    }
}

#[test]
fn what_ended_with_an_earlier_life_is_done_anew_also_for_whom_nobody_knows() {
    let (mut pool, session) = (Pool::new(Limits::default()), SessionId::from("adam"));
    for _ in 0..2 {
        pool.keep_alive(NOW, &session, "adam", Duration::from_secs(10)).unwrap();
        pool.handle(NOW, "create", create("adam", "Tool")).unwrap();
        assert_eq!(pool.list().len(), 1);
        pool.close_session(NOW, &session).unwrap();
    }
}

/// What takes away two units of a kind.
fn two(operation: ResourceOperation, kind: &str) -> Request {
    let requirement = Requirement { count: Quantity::whole(2), ..Requirement::new(operation, kind) };
    match operation {
        ResourceOperation::Consume => {
            Request::Consume { session: SessionId::from("adam"), requirement, resource: None }
        }
        _ => Request::DeleteUnits { session: SessionId::from("adam"), requirement },
    }
}

#[test]
fn what_a_session_uses_up_of_its_own_is_of_its_life_and_is_used_up_anew_in_the_next() {
    for restart in [None, Some(false), Some(true)] {
        let mut pool = pool_of(Limits::default(), &["adam"]);
        let glue = ResourceSpec::new(ResourceClass::Task, "Glue").non_renewable().capacity(2);
        let create = Request::Create { session: Some(SessionId::from("adam")), spec: glue };
        for _ in 0..2 {
            for (id, request) in [("c", create.clone()), ("u", two(ResourceOperation::Consume, "Glue"))] {
                pool.handle_as(NOW, &speaker("adam"), id, request).unwrap();
            }
            assert!(pool.exists(&Requirement::new(ResourceOperation::Exists, "Glue")).is_zero(), "{restart:?}");
            pool = reopened(pool, &Limits::default(), restart);
        }
    }
}

#[test]
fn what_ended_in_part_with_an_earlier_life_is_refused_and_not_done_twice() {
    for restart in [None, Some(false), Some(true)] {
        let mut pool = pool_of(Limits::default(), &["adam"]);
        let spec = |kind| ResourceSpec::new(ResourceClass::Module, kind);
        for spec in [spec("Power"), spec("Power").non_renewable(), spec("Tool")] {
            pool.create(NOW, None, spec).unwrap();
        }
        created(&mut pool, "adam", "create");
        let requests = [("u", ResourceOperation::Consume, "Power"), ("d", ResourceOperation::Delete, "Tool")];
        for (id, operation, kind) in requests {
            let mut ask = || pool.handle_as(NOW, &speaker("adam"), id, two(operation, kind)).unwrap();
            assert_eq!(ask(), ask(), "in one life it is done once");
        }
        pool = reopened(pool, &Limits::default(), restart);
        // So that there is enough to take once more.
        for spec in [spec("Power").non_renewable(), spec("Tool").capacity(2)] {
            pool.create(NOW, None, spec).unwrap();
        }
        for (id, operation, kind) in requests {
            let again = pool.handle_as(NOW, &speaker("adam"), id, two(operation, kind));
            assert_eq!(again, Err(PoolError::DoneInPart { id: id.to_owned() }), "{restart:?}");
            let there = pool.exists(&Requirement::new(ResourceOperation::Exists, kind));
            assert_eq!(there, Quantity::whole(2), "{kind} {restart:?}");
        }
    }
}

#[test]
fn what_a_request_came_to_is_told_also_when_its_session_has_ended() {
    let units = |resource: &str, kind: &str, units: u32, ends_with_session: bool| OperatedUnits {
        resource: resource.to_owned(),
        kind: kind.to_owned(),
        units: units.into(),
        ends_with_session,
    };
    for restart in [None, Some(false), Some(true)] {
        let mut pool = pool_of(Limits::default(), &["adam", "eve"]);
        let glue = ResourceSpec::new(ResourceClass::Module, "Glue").non_renewable().capacity(3);
        let glue = pool.create(NOW, None, glue).unwrap().description.id.clone();
        pool.create(NOW, None, ResourceSpec::new(ResourceClass::Module, "Tool").id("other")).unwrap();
        let tool = created(&mut pool, "adam", "create");
        let requests = [("d", two(ResourceOperation::Delete, "Tool")), ("u", two(ResourceOperation::Consume, "Glue"))];
        for (id, request) in requests {
            pool.handle_as(NOW, &speaker("adam"), id, request).unwrap();
        }
        let mut pool = reopened(pool, &Limits::default(), restart);
        let mut told =
            |caller: &str, id: &str| pool.recall(NOW, &speaker(caller), &SessionId::from(caller), id).unwrap();
        assert!(matches!(told("adam", "create"), Some(Reply::Created { id, .. }) if id == tool));
        let deleted = vec![units(&tool, "Tool", 1, true), units("other", "Tool", 1, false)];
        assert_eq!(told("adam", "d"), Some(Reply::Operated(deleted)), "{restart:?}");
        assert_eq!(told("adam", "u"), Some(Reply::Operated(vec![units(&glue, "Glue", 2, false)])));
        assert_eq!(told("adam", "never asked"), None);
        assert_eq!(told("eve", "d"), None, "it is another caller's");
        let others = pool.recall(NOW, &speaker("eve"), &SessionId::from("adam"), "d");
        assert!(matches!(others, Err(PoolError::SessionOfAnother { .. })), "{others:?}");
    }
}

#[test]
fn of_one_resource_alone_is_used_up_what_is_there_of_it() {
    let mut pool = pool_of(Limits::default(), &["adam"]);
    for id in ["one", "two"] {
        pool.create(NOW, None, ResourceSpec::new(ResourceClass::Module, "Power").id(id)).unwrap();
    }
    let mut consume = |id: &str, kind: &str, resource: &str| {
        let (session, resource) = (SessionId::from("adam"), Some(resource.to_owned()));
        let requirement = Requirement::new(ResourceOperation::Consume, kind);
        pool.handle_as(NOW, &speaker("adam"), id, Request::Consume { session, requirement, resource })
    };
    assert!(matches!(consume("a", "Power", "two"), Ok(Reply::Operated(of)) if of[0].resource == "two"));
    assert!(matches!(consume("b", "Power", "two"), Err(PoolError::NotEnough { .. })), "of the other one there is");
    assert!(matches!(consume("c", "Glue", "one"), Err(PoolError::NotEnough { .. })), "it is of another kind");
    assert!(matches!(consume("d", "Power", "three"), Err(PoolError::UnknownResource { .. })));
    assert!(matches!(consume("a", "Power", "one"), Err(PoolError::RequestIdReused { .. })), "it is another request");
}

#[test]
fn what_a_grant_uses_up_is_told_with_its_lease() {
    let mut pool = pool_of(Limits::default(), &["adam"]);
    pool.create(NOW, None, ResourceSpec::new(ResourceClass::Module, "Arm")).unwrap();
    pool.create(NOW, None, ResourceSpec::new(ResourceClass::Module, "Glue").id("glue").capacity(3)).unwrap();
    let requirements = ["Arm", "Glue"].map(|kind| {
        let operation = if kind == "Arm" { ResourceOperation::Block } else { ResourceOperation::Consume };
        Requirement::new(operation, kind)
    });
    let acquire = Request::Acquire(AcquireRequest::new(SessionId::from("adam"), requirements.to_vec()));
    let mut ask = || pool.handle_as(NOW, &speaker("adam"), "a", acquire.clone());
    let Ok(Reply::Queued(_)) = ask() else { panic!() };
    let Ok(Reply::Granted(lease)) = ask() else { panic!() };
    let [consumed] = &lease.consumed[..] else { panic!("{lease:?}") };
    assert_eq!((&*consumed.resource, consumed.units, consumed.ends_with_session), ("glue", Quantity::ONE, true));
    assert_eq!(lease.resources.len(), 1);
}
