//! What waiters lack, for those who could provide it, however many wait for something else.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::resource::{Quantity, Requirement, ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_resources::{AcquireRequest, Limits, Pool, Provided, ResourceSpec, SessionId, Speaker, WaiterId};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

const NOW: Timestamp = Timestamp(0);

/// With a session of each of two callers.
fn pool() -> Pool {
    let mut pool = Pool::new(Limits::default());
    for name in ["adam", "eve"] {
        let speaker = Speaker { name: name.into(), for_anybody: false };
        pool.keep_alive_as(NOW, &speaker, &SessionId::from(name), name, Duration::from_secs(60)).unwrap();
    }
    pool
}

/// All kinds that anybody here waits for; none of them grows.
fn everything() -> Arc<Provided> {
    let ghosts = (0..300).map(|number| format!("Ghost-{number}"));
    let kinds = ["Planner", "Arm", "Ghost"].map(str::to_owned).into_iter().chain(ghosts).collect();
    Arc::new(Provided { kinds, ..Provided::default() })
}

/// These alone; none of them grows.
fn provided(kinds: &[&str]) -> Arc<Provided> {
    let kinds = kinds.iter().map(|&kind| kind.to_owned()).collect();
    Arc::new(Provided { kinds, ..Provided::default() })
}

fn block(kind: &str, count: impl Into<Quantity>) -> Requirement {
    Requirement { count: count.into(), ..Requirement::new(ResourceOperation::Block, kind) }
}

fn ask(pool: &mut Pool, session: &str, priority: i64, requirements: Vec<Requirement>) {
    pool.acquire(NOW, AcquireRequest::new(SessionId::from(session), requirements).priority(priority)).unwrap();
    while pool.next_deadline() == Some(NOW) {
        pool.advance(NOW);
    }
}

fn create(pool: &mut Pool, spec: ResourceSpec) {
    pool.create(NOW, None, spec).unwrap();
    pool.check_invariants().unwrap();
}

fn planner() -> ResourceSpec {
    ResourceSpec::new(ResourceClass::Process, "Planner")
}

/// How much of each kind is missing, where that may have changed.
fn missing(pool: &mut Pool) -> Option<BTreeMap<String, Quantity>> {
    let demand = pool.take_demand(&everything())?;
    Some(demand.into_iter().map(|demand| (demand.requirement.kind, demand.requirement.count)).collect())
}

fn one(kind: &str, count: impl Into<Quantity>) -> Option<BTreeMap<String, Quantity>> {
    Some([(kind.to_owned(), count.into())].into())
}

#[test]
fn what_hundreds_of_urgent_waiters_of_one_caller_lack_hides_nothing_of_what_another_lacks() {
    let mut pool = pool();
    for number in 0..300 {
        ask(&mut pool, "eve", 1_000, vec![block(&format!("Ghost-{number}"), 1)]);
    }
    ask(&mut pool, "adam", 0, vec![block("Planner", 2)]);
    pool.check_invariants().unwrap();
    let missing = missing(&mut pool).unwrap();
    assert_eq!(missing.get("Planner"), Some(&Quantity::whole(2)));
    assert!((2..300).contains(&missing.len()), "{}: not more than providers can be told", missing.len());
}

#[test]
fn hundreds_of_waiters_of_one_selector_hide_no_other_selector_of_their_caller() {
    let mut pool = pool();
    for number in 0..300 {
        ask(&mut pool, "eve", 1_000, vec![block("Ghost", 1 + number % 7)]);
    }
    ask(&mut pool, "eve", 0, vec![block("Planner", 2)]);
    let expected = [("Ghost".to_owned(), Quantity::whole(7)), ("Planner".to_owned(), Quantity::whole(2))];
    assert_eq!(missing(&mut pool), Some(expected.into()));
    pool.check_invariants().unwrap();
}

#[test]
fn what_is_missing_is_what_is_missing_now_however_it_is_asked_for() {
    let mut pool = pool();
    let fast = |count: u32| Requirement {
        attributes: [("fast".to_owned(), Value::Bool(true))].into(),
        ..block("Planner", count)
    };
    // Two requirements that may take the same planners: four in all, of which two are fast ones.
    ask(&mut pool, "adam", 0, vec![block("Planner", 2), fast(2)]);
    let sum = |pool: &mut Pool| missing_sum(pool);
    assert_eq!(sum(&mut pool), Some(4));
    create(&mut pool, planner());
    assert_eq!(sum(&mut pool), Some(3));
    create(&mut pool, planner().attribute("fast", Value::Bool(true)));
    assert_eq!(sum(&mut pool), Some(2));
    // One who lacks nothing of planners asks for more of them than he lacks of anything.
    ask(&mut pool, "eve", 9, vec![block("Planner", 2), block("Arm", 1)]);
    assert_eq!(sum(&mut pool), Some(3), "an arm, too");
}

fn missing_sum(pool: &mut Pool) -> Option<u32> {
    let demand = pool.take_demand(&everything())?;
    Some(demand.iter().map(|demand| demand.requirement.count.units()).sum())
}

#[test]
fn who_waits_for_a_whole_unit_is_served_with_one_beside_parts_of_others() {
    let mut pool = pool();
    let half = || planner().capacity(Quantity::from_thousandths(500)).divisible();
    create(&mut pool, half());
    create(&mut pool, half());
    ask(&mut pool, "adam", 0, vec![block("Planner", 1)]);
    assert_eq!(pool.waiting(), 1, "two halves are no whole one");
    assert_eq!(missing(&mut pool), one("Planner", 1));
    create(&mut pool, planner());
    while pool.next_deadline() == Some(NOW) {
        pool.advance(NOW);
    }
    assert_eq!((pool.waiting(), pool.leases().len()), (0, 1));
    assert_eq!(missing(&mut pool), Some(BTreeMap::new()));
    pool.check_invariants().unwrap();
}

#[test]
fn what_nobody_provides_takes_no_room_from_what_somebody_does() {
    let mut pool = pool();
    for number in 0..300 {
        ask(&mut pool, "eve", 1_000, vec![block(&format!("Ghost-{number}"), 1)]);
    }
    ask(&mut pool, "eve", 0, vec![block("Planner", 2)]);
    let told = |pool: &mut Pool, kinds: &[&str]| {
        let demand = pool.take_demand(&provided(kinds))?;
        Some(demand.into_iter().map(|demand| demand.requirement.kind).collect::<Vec<_>>())
    };
    assert_eq!(told(&mut pool, &["Planner", "Arm"]), Some(vec!["Planner".to_owned()]));
    assert_eq!(told(&mut pool, &["Planner", "Arm"]), None, "nothing has changed");
    assert_eq!(told(&mut pool, &["Planner", "Ghost-7"]), Some(vec!["Ghost-7".to_owned(), "Planner".to_owned()]));
    assert_eq!(told(&mut pool, &[]), Some(vec![]));
}

#[test]
fn those_who_lack_nothing_of_a_kind_do_not_hide_who_does() {
    let mut pool = pool();
    create(&mut pool, planner());
    create(&mut pool, planner());
    // Hopeless for the ghost, which nobody provides; planners there are enough.
    for _ in 0..65 {
        ask(&mut pool, "eve", 0, vec![block("Planner", 1), block("Planner", 1), block("Ghost", 1)]);
    }
    ask(&mut pool, "adam", 0, vec![block("Planner", 2), block("Planner", 1)]);
    pool.check_invariants().unwrap();
    let provided = provided(&["Planner"]);
    let missing = |pool: &mut Pool| {
        let demand = pool.take_demand(&provided).unwrap();
        demand.into_iter().map(|demand| demand.requirement.count).collect::<Vec<_>>()
    };
    assert_eq!(missing(&mut pool), [Quantity::ONE]);
    // One planner less, and all of them lack one: the most urgent come first, he when they do not lack it any more.
    pool.delete(NOW, None, "Planner-1").unwrap();
    for expected in [vec![Quantity::ONE], vec![Quantity::ONE], vec![]] {
        while pool.next_deadline() == Some(NOW) {
            pool.advance(NOW);
        }
        pool.check_invariants().unwrap();
        assert_eq!(missing(&mut pool), expected);
        create(&mut pool, planner());
    }
}

const PATIENCE: Duration = Duration::from_millis(250);

/// Planners and arms, of which planners grow.
fn growing() -> Arc<Provided> {
    let kinds = ["Planner", "Arm"].map(str::to_owned).into();
    Arc::new(Provided { kinds, growing: ["Planner".to_owned()].into(), patience: PATIENCE })
}

fn at(ms: u64) -> Timestamp {
    NOW + Duration::from_millis(ms)
}

/// What is missing and what is queued for of planners at a moment, where that may have changed.
fn planners_at(pool: &mut Pool, ms: u64) -> Option<(u32, u32)> {
    pool.advance(at(ms));
    pool.check_invariants().unwrap();
    let demand = pool.take_demand(&growing())?;
    let amounts = |demand: &ratn_resources::Demand| (demand.requirement.count.units(), demand.queued.units());
    assert!(demand.iter().all(|demand| demand.requirement.kind == "Planner"), "{demand:?}");
    Some(demand.first().map(amounts).unwrap_or_default())
}

fn ask_at(pool: &mut Pool, ms: u64, requirements: Vec<Requirement>) -> WaiterId {
    pool.acquire(at(ms), AcquireRequest::new(SessionId::from("adam"), requirements)).unwrap()
}

#[test]
fn who_waits_for_long_for_what_others_hold_is_in_demand_where_it_grows() {
    let mut pool = pool();
    create(&mut pool, planner());
    let waiters = [(); 4].map(|()| ask_at(&mut pool, 0, vec![block("Planner", 1)]));
    assert_eq!(planners_at(&mut pool, 0), Some((0, 0)), "it is asked for the first time");
    assert_eq!(pool.next_deadline(), Some(at(250)));
    assert_eq!(planners_at(&mut pool, 249), None);
    assert_eq!(planners_at(&mut pool, 250), Some((0, 3)), "one has it, three wait");
    create(&mut pool, planner());
    assert_eq!(pool.waiting(), 2);
    assert_eq!(planners_at(&mut pool, 500), Some((0, 2)));
    pool.cancel(at(600), waiters[2]).unwrap();
    assert_eq!(planners_at(&mut pool, 600), None, "it is looked at again later");
    assert_eq!(planners_at(&mut pool, 750), Some((0, 1)));
    pool.cancel(at(800), waiters[3]).unwrap();
    assert_eq!(planners_at(&mut pool, 1_000), Some((0, 0)));
    assert_eq!(pool.next_deadline().filter(|at| *at < Timestamp::from_seconds(10.0)), None, "nobody waits");
}

#[test]
fn waits_that_end_before_long_are_in_no_demand() {
    let mut pool = pool();
    create(&mut pool, planner());
    planners_at(&mut pool, 0);
    // Each waits 200 ms for the one before it.
    let session = SessionId::from("adam");
    ask_at(&mut pool, 0, vec![block("Planner", 1)]);
    for round in 0..20 {
        ask_at(&mut pool, 200 * round, vec![block("Planner", 1)]);
        assert!(planners_at(&mut pool, 200 * round + 199).is_none_or(|demand| demand == (0, 0)), "{round}");
        let held = pool.leases()[0].id;
        pool.release(at(200 * round + 199), Some(&session), held).unwrap();
    }
}

#[test]
fn who_waits_for_something_else_as_well_is_not_helped_by_more_of_what_grows() {
    let mut pool = pool();
    create(&mut pool, planner());
    create(&mut pool, ResourceSpec::new(ResourceClass::Module, "Arm"));
    planners_at(&mut pool, 0);
    ask_at(&mut pool, 0, vec![block("Planner", 1)]);
    ask_at(&mut pool, 0, vec![block("Arm", 1)]);
    ask_at(&mut pool, 0, vec![block("Planner", 1), block("Arm", 1)]);
    ask_at(&mut pool, 0, vec![block("Arm", 1)]);
    assert!(planners_at(&mut pool, 1_000).is_none(), "it waits for the arm, which does not grow");
    let arm = pool.leases()[1].id;
    pool.release(at(1_000), Some(&SessionId::from("adam")), arm).unwrap();
    assert_eq!(planners_at(&mut pool, 1_250), Some((0, 1)), "it has the arm reserved");
}

#[test]
fn a_wait_begins_when_what_exists_would_do() {
    let mut pool = pool();
    planners_at(&mut pool, 0);
    for _ in 0..2 {
        ask_at(&mut pool, 0, vec![block("Planner", 1)]);
    }
    assert_eq!(planners_at(&mut pool, 0), Some((1, 0)), "the most that one of them lacks");
    pool.create(at(5_000), None, planner()).unwrap();
    assert_eq!(planners_at(&mut pool, 5_000), Some((0, 0)));
    assert_eq!(planners_at(&mut pool, 5_249).unwrap_or_default(), (0, 0), "the next one would have ended by now");
    assert_eq!(planners_at(&mut pool, 5_500), Some((0, 1)));
}
