#![allow(clippy::unwrap_used, reason = "a test may panic")]
//! Two pools go through the same history: one does all work at once, the other does so little in each turn that it is behind after nearly every step.
//! When the second has caught up, both have granted the same.

use crate::expiry::Work;
use crate::{AcquireRequest, Limits, Pool, ResourceSpec, SessionId};
use proptest::prelude::*;
use proptest::test_runner::{Config, RngAlgorithm, TestRng, TestRunner};
use ratn_model::resource::{Quantity, Requirement, ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use std::time::Duration;

const NOW: Timestamp = Timestamp(0);
const KINDS: [&str; 2] = ["Tool", "Camera"];

#[derive(Debug, Clone)]
enum Step {
    /// Creates or changes a resource with this kind, attribute and capacity.
    Create(usize, usize, i64, u32),
    Delete(usize),
    /// Acquires with these requirements: kind, attribute (unless zero), number of units, and options.
    Acquire(i64, Vec<(usize, i64, u32, usize)>),
    Release(usize),
    Cancel(usize),
    EndTask,
}

fn step() -> impl Strategy<Value = Step> {
    let requirement = (0..2_usize, 0..3_i64, 1..4_u32, 0..6_usize);
    prop_oneof![
        3 => (0..8_usize, 0..2_usize, 1..3_i64, 1..4_u32).prop_map(|(id, k, a, c)| Step::Create(id, k, a, c)),
        1 => (0..8_usize).prop_map(Step::Delete),
        6 => (0..3_i64, prop::collection::vec(requirement, 1..4)).prop_map(|(p, r)| Step::Acquire(p, r)),
        4 => (0..8_usize).prop_map(Step::Release),
        1 => (0..8_usize).prop_map(Step::Cancel),
        1 => Just(Step::EndTask),
    ]
}

fn pool(work: Work) -> Pool {
    let mut pool = Pool::new(Limits::default());
    pool.work = work;
    pool.keep_alive(NOW, &SessionId::from("s"), "s", Duration::from_secs(60)).unwrap();
    pool
}

/// The purposes of all leases, sorted; grants for the same request have the same purpose in both pools.
fn granted(pool: &Pool) -> Vec<String> {
    let mut purposes: Vec<String> = pool.leases().iter().map(|lease| lease.purpose.to_string()).collect();
    purposes.sort();
    purposes
}

fn perform(pool: &mut Pool, number: usize, step: &Step) {
    let session = SessionId::from("s");
    match step {
        Step::Create(id, kind, attribute, capacity) => {
            let spec = ResourceSpec::new(ResourceClass::Module, KINDS[*kind]).id(format!("r{id}")).capacity(*capacity);
            let _ = pool.create(NOW, None, spec.attribute("a", Value::Int(*attribute)));
        }
        Step::Delete(id) => drop(pool.delete(NOW, None, &format!("r{id}"))),
        Step::Acquire(priority, wanted) => {
            let requirement = |(kind, attribute, count, how): &(usize, i64, u32, usize)| {
                let operation = match how {
                    0 => ResourceOperation::Exists,
                    1 => ResourceOperation::Consume,
                    _ => ResourceOperation::Block,
                };
                let mut requirement = Requirement::new(operation, KINDS[*kind]);
                requirement.count = Quantity::from(*count);
                if *attribute > 0 {
                    requirement.attributes.insert("a".to_owned(), Value::Int(*attribute));
                }
                requirement
            };
            let request = AcquireRequest::new(session, wanted.iter().map(requirement).collect()).priority(*priority);
            pool.acquire(NOW, AcquireRequest { purpose: format!("{number}"), ..request }).unwrap();
        }
        Step::Release(which) => {
            let purposes = granted(pool);
            let Some(purpose) = purposes.get(which % purposes.len().max(1)) else { return };
            let lease = pool.leases().into_iter().find(|lease| *lease.purpose == **purpose).unwrap();
            pool.release(NOW, None, lease.id).unwrap();
        }
        Step::Cancel(which) => {
            let waiters = pool.waiters();
            let Some((waiter, _)) = waiters.get(which % waiters.len().max(1)) else { return };
            pool.cancel(NOW, *waiter).unwrap();
        }
        Step::EndTask => assert!(pool.end_task(NOW, &session).unwrap()),
    }
}

fn waiting(pool: &Pool) -> Vec<String> {
    pool.waiters().into_iter().map(|(_, request)| request.purpose).collect()
}

#[test]
fn a_pool_that_catches_up_over_many_turns_grants_what_one_grants_that_does_all_at_once() {
    let rng = TestRng::from_seed(RngAlgorithm::ChaCha, &[7; 32]);
    let config = Config { cases: 400, failure_persistence: None, ..Config::default() };
    let behind = std::cell::Cell::new(0);
    let outcome = TestRunner::new_with_rng(config, rng).run(&prop::collection::vec(step(), 1..40), |steps| {
        let (mut quick, mut slow) = (pool(Work::default()), pool(Work { per_turn: 9, per_call: 3 }));
        for (number, step) in steps.iter().enumerate() {
            perform(&mut quick, number, step);
            perform(&mut slow, number, step);
            quick.check_invariants().map_err(TestCaseError::fail)?;
            slow.check_invariants().map_err(TestCaseError::fail)?;
            let mut turns = 0;
            while slow.next_deadline() == Some(NOW) {
                slow.advance(NOW);
                slow.check_invariants().map_err(TestCaseError::fail)?;
                turns += 1;
                behind.set(behind.get() + usize::from(turns == 1));
                prop_assert!(turns < 1_000, "it never catches up after {step:?}");
            }
            prop_assert_eq!(granted(&quick), granted(&slow), "after {}: {:?}", number, step);
            prop_assert_eq!(waiting(&quick), waiting(&slow), "after {}: {:?}", number, step);
        }
        Ok(())
    });
    outcome.unwrap();
    assert!(behind.get() > 1_000, "it was behind after {} steps only", behind.get());
}

#[test]
fn a_pool_that_is_behind_for_long_holds_what_always_holds_and_forgets_nobody() {
    let rng = TestRng::from_seed(RngAlgorithm::ChaCha, &[8; 32]);
    let config = Config { cases: 400, failure_persistence: None, ..Config::default() };
    let outcome = TestRunner::new_with_rng(config, rng).run(&prop::collection::vec(step(), 1..60), |steps| {
        let mut pool = pool(Work { per_turn: 9, per_call: 3 });
        for (number, step) in steps.iter().enumerate() {
            perform(&mut pool, number, step);
            pool.check_invariants().map_err(TestCaseError::fail)?;
        }
        // When it is no longer behind, no request waits that could be served.
        while pool.next_deadline() == Some(NOW) {
            pool.advance(NOW);
            pool.check_invariants().map_err(TestCaseError::fail)?;
        }
        Ok(())
    });
    outcome.unwrap();
}

/// A waiter has reserved one of three tools and waits for another; the reserved one is deleted, and a camera gets its slot before that is settled.
#[test]
fn what_was_reserved_of_a_deleted_resource_does_not_hide_the_next_one_in_its_slot() {
    let of = |kind: &str, count: u32| {
        let requirement = Requirement { count: count.into(), ..Requirement::new(ResourceOperation::Block, kind) };
        AcquireRequest { purpose: kind.to_owned(), ..AcquireRequest::new(SessionId::from("s"), vec![requirement]) }
    };
    let resource = |kind: &str, id: &str| ResourceSpec::new(ResourceClass::Module, kind).id(id);
    for gives_up in [false, true] {
        let mut pool = Pool::new(Limits::default());
        pool.keep_alive(NOW, &SessionId::from("s"), "s", Duration::from_secs(60)).unwrap();
        for id in ["reserved", "held", "held too"] {
            pool.create(NOW, None, resource("Tool", id)).unwrap();
        }
        pool.acquire(NOW, of("Tool", 2)).unwrap();
        let held = pool.leases().remove(0).resources;
        let left = ["reserved", "held", "held too"].into_iter().find(|id| !held.contains(&(*id).to_owned())).unwrap();
        let waiter = pool.acquire(NOW, of("Tool", 2)).unwrap();
        // Each call does too little work to settle the changes of tools.
        pool.work = Work { per_turn: 9, per_call: 3 };
        pool.delete(NOW, None, left).unwrap();
        pool.create(NOW, None, resource("Camera", "camera")).unwrap();
        pool.acquire(NOW, of("Camera", 1)).unwrap();
        assert_eq!(granted(&pool), ["Tool"], "it is behind");
        pool.work = Work { per_turn: 9, per_call: 9 };
        if gives_up {
            pool.cancel(NOW, waiter).unwrap();
        }
        let mut turns = 0;
        while pool.next_deadline() == Some(NOW) {
            pool.advance(NOW);
            pool.check_invariants().unwrap();
            turns += 1;
            assert!(turns < 1_000);
        }
        assert_eq!(granted(&pool), ["Camera", "Tool"], "the waiter for tools gives up: {gives_up}");
    }
}
