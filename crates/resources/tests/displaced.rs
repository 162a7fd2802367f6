//! An id under which a task has made a resource belongs to the provider that comes for it: the task's resource gives way.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::resource::{Requirement, ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use ratn_resources::{
    AcquireRequest, Change, EndReason, Limits, Notice, Pool, PoolError, ResourceSpec, SessionId, Snapshot, Speaker,
    decode, encode,
};
use std::time::Duration;

const NOW: Timestamp = Timestamp(0);
const TTL: Duration = Duration::from_secs(60);

fn open(pool: &mut Pool, who: &str, for_anybody: bool) -> SessionId {
    let (id, speaker) = (SessionId::from(who), Speaker { name: who.into(), for_anybody });
    pool.keep_alive_as(NOW, &speaker, &id, who, TTL).unwrap();
    id
}

fn arm(class: ResourceClass) -> ResourceSpec {
    ResourceSpec::new(class, "Arm").id("arm@sim")
}

fn changes(pool: &mut Pool) -> Vec<Change> {
    let event = |notice| if let Notice::Event(event) = notice { Some(event.change.clone()) } else { None };
    pool.take_notices().into_iter().filter_map(event).collect()
}

#[test]
fn a_provider_displaces_what_a_task_made_under_its_id_and_who_holds_that_loses_it() {
    let mut pool = Pool::new(Limits::default());
    let (eve, bob, cell) =
        (open(&mut pool, "eve", false), open(&mut pool, "bob", false), open(&mut pool, "cell", false));
    // As if something moved for a minute.
    let lookalike = arm(ResourceClass::Task).standstill(Duration::from_secs(60)).capacity(2);
    pool.create(NOW, Some(&eve), lookalike).unwrap();
    let hold = |pool: &mut Pool, by: &SessionId| {
        let block = Requirement::new(ResourceOperation::Block, "Arm");
        pool.acquire(NOW, AcquireRequest::new(by.clone(), vec![block])).unwrap();
        pool.leases().last().unwrap().id
    };
    let revoked = hold(&mut pool, &eve);
    pool.release(NOW, None, revoked).unwrap();
    assert_eq!(pool.get("arm@sim").unwrap().holders.ending().count(), 1);
    let held = hold(&mut pool, &bob);
    changes(&mut pool);

    let made = pool.create(NOW, Some(&cell), arm(ResourceClass::Module).capacity(1)).unwrap();
    pool.check_invariants().unwrap();
    assert_eq!((made.owner.as_ref(), made.class), (Some(&cell), ResourceClass::Module));
    let changes = changes(&mut pool);
    let [
        Change::LeaseEnded { lease, session, reason: EndReason::ResourceGone, .. },
        gone,
        Change::ResourceCreated(there),
    ] = changes.as_slice()
    else {
        panic!("{changes:?}");
    };
    assert_eq!((*lease, session), (held, &bob));
    assert!(matches!(gone, Change::ResourceDeleted { reason: EndReason::Displaced, .. }), "{gone:?}");
    assert_eq!(there.owner, Some(cell.clone()));
    assert_eq!(pool.lease(held), None);
    // Nothing of the lookalike is waited for.
    hold(&mut pool, &bob);
    assert_eq!(pool.get("arm@sim").unwrap().holders.live().next().unwrap().session, bob);
    let refused = pool.create(NOW, Some(&eve), arm(ResourceClass::Task));
    assert!(matches!(refused, Err(PoolError::ResourceTaken { .. })), "the task has it no more: {refused:?}");
    let snapshot = Snapshot::decode(&pool.snapshot().encode()).unwrap();
    let records = decode(&encode(&pool.take_records())).unwrap();
    let again = Pool::restore(Limits::default(), NOW, None, records).unwrap();
    assert_eq!(again.snapshot(), snapshot);
}

#[test]
fn nobody_displaces_what_a_provider_an_operator_or_no_session_has_nor_does_a_task() {
    let refused = |first: &str, class: ResourceClass, second: ResourceClass| {
        let mut pool = Pool::new(Limits::default());
        let owner = (first != "nobody").then(|| open(&mut pool, first, first == "root"));
        pool.create(NOW, owner.as_ref(), arm(class)).unwrap();
        let other = open(&mut pool, "other", false);
        let refused = pool.create(NOW, Some(&other), arm(second)).unwrap_err();
        assert!(matches!(refused, PoolError::ResourceTaken { .. }), "{refused}");
        assert_eq!(pool.get("arm@sim").unwrap().owner, owner);
        pool.check_invariants().unwrap();
    };
    use ResourceClass::{Module, Process, System, Task, World};
    for class in [System, Process, Module, World] {
        refused("cell", class, Module);
        refused("cell", class, Task);
    }
    refused("eve", Task, Task);
    refused("root", Task, Module);
    refused("nobody", Task, Module);
}

#[test]
fn a_full_pool_has_room_for_what_displaces_and_a_provider_beyond_its_quota_displaces_nothing() {
    let limits = Limits { resources: 1, resources_for_operators: 0, ..Limits::default() };
    for (quota, takes) in [(1, true), (0, false)] {
        let mut pool = Pool::new(Limits { resources_per_caller: 1, ..limits.clone() });
        let (eve, cell) = (open(&mut pool, "eve", false), open(&mut pool, "cell", false));
        pool.create(NOW, Some(&eve), arm(ResourceClass::Task)).unwrap();
        pool.set_limits(Limits { resources_per_caller: quota, ..limits.clone() });
        let made = pool.create(NOW, Some(&cell), arm(ResourceClass::Module));
        assert_eq!(made.is_ok(), takes, "{made:?}");
        assert_eq!(pool.get("arm@sim").unwrap().owner, Some(if takes { cell } else { eve }));
        pool.check_invariants().unwrap();
    }
}

#[test]
fn what_an_operator_made_stays_also_over_a_restart_and_a_tasks_gives_way_once_it_is_known_to_be_one() {
    for (owner, is_operator) in [("root", true), ("eve", false)] {
        let mut pool = Pool::new(Limits::default());
        let id = open(&mut pool, owner, is_operator);
        pool.create(NOW, Some(&id), arm(ResourceClass::Task)).unwrap();
        let snapshot = Snapshot::decode(&pool.snapshot().encode()).unwrap();
        let records = decode(&encode(&pool.take_records())).unwrap();
        let from_snapshot = Pool::restore(Limits::default(), NOW, Some(snapshot), []).unwrap();
        let from_records = Pool::restore(Limits::default(), NOW, None, records).unwrap();
        for mut pool in [from_snapshot, from_records] {
            let cell = open(&mut pool, "cell", false);
            let taken = pool.create(NOW, Some(&cell), arm(ResourceClass::Module)).unwrap_err();
            assert!(matches!(taken, PoolError::ResourceTaken { .. }), "nobody knows yet whose it is: {taken}");
            // Somebody who speaks for its owner says nothing about the owner.
            let operator = Speaker { name: "other-root".into(), for_anybody: true };
            pool.keep_alive_as(NOW, &operator, &id, owner, TTL).unwrap();
            assert!(pool.create(NOW, Some(&cell), arm(ResourceClass::Module)).is_err());
            open(&mut pool, owner, is_operator);
            let made = pool.create(NOW, Some(&cell), arm(ResourceClass::Module));
            assert_eq!(made.is_err(), is_operator, "{made:?}");
            pool.check_invariants().unwrap();
        }
    }
}
