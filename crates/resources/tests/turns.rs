//! Turns: shares over a long time, due times, and the bound within which nobody is passed, over random requests from fixed seeds.
//!
//! The bound is looked at from outside, with nothing of the pool's own count: by who was granted what, and when each had asked.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::id::LeaseId;
use ratn_model::resource::{Requirement, ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_resources::{
    AHEAD, AcquireRequest, BOUND, LEAD, Limits, Notice, Pool, Quantity, Reply, Request, ResourceSpec, SessionId, Share,
    Speaker, Standing, WaiterId,
};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

const HOUR: Duration = Duration::from_secs(3_600);
const KINDS: [&str; 2] = ["Arm", "Camera"];

/// SplitMix64.
struct Dice(u64);

impl Dice {
    fn below(&mut self, bound: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mixed = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (mixed ^ (mixed >> 31)) % bound
    }

    fn between(&mut self, from: u64, to: u64) -> u64 {
        from + self.below(to - from)
    }
}

fn at(milliseconds: u64) -> Timestamp {
    Timestamp(milliseconds * 1_000_000)
}

fn run(number: usize) -> SessionId {
    SessionId::from(format!("run-{number}").as_str())
}

fn block(kind: &str, count: u32) -> Requirement {
    Requirement { count: count.into(), ..Requirement::new(ResourceOperation::Block, kind) }
}

fn left_side() -> BTreeMap<String, Value> {
    [("side".to_owned(), Value::String("left".into()))].into()
}

fn pool(runs: &[Standing], units: [u32; 2]) -> Pool {
    let mut pool = Pool::new(Limits::default());
    for (number, standing) in runs.iter().enumerate() {
        pool.keep_alive(at(0), &run(number), "run", 100 * HOUR).unwrap();
        pool.set_standing(at(0), &run(number), *standing).unwrap();
    }
    for (kind, units) in KINDS.iter().zip(units).filter(|(_, units)| *units > 0) {
        pool.create(at(0), None, ResourceSpec::new(ResourceClass::Module, *kind).capacity(units)).unwrap();
    }
    pool
}

/// What a run that always wants more asks for, how many times at once, and for how long it holds that.
#[derive(Clone)]
struct Wants {
    at_once: usize,
    units: [u32; 2],
    priority: i64,
    hold_ms: (u64, u64),
}

impl Wants {
    fn one_arm() -> Wants {
        Wants { at_once: 1, units: [1, 0], priority: 0, hold_ms: (900, 1_100) }
    }
}

/// How long each run held each kind, in unit-milliseconds, where all of them always want more.
fn held(standings: &[Standing], wants: &[Wants], units: [u32; 2], length_ms: u64, seed: u64) -> Vec<[u64; 2]> {
    let (mut pool, mut dice) = (pool(standings, units), Dice(seed));
    let mut held = vec![[0; 2]; wants.len()];
    let mut asked: BTreeMap<WaiterId, usize> = BTreeMap::new();
    let mut ends: BTreeSet<(u64, LeaseId, usize)> = BTreeSet::new();
    let mut now = 0;
    let ask = |pool: &mut Pool, asked: &mut BTreeMap<WaiterId, usize>, number: usize, now: u64| {
        let wanted = wants[number].units.iter().zip(KINDS).filter(|(units, _)| **units > 0);
        let wanted = wanted.map(|(units, kind)| block(kind, *units)).collect();
        let request = AcquireRequest::new(run(number), wanted).priority(wants[number].priority);
        asked.insert(pool.acquire(at(now), request).unwrap(), number);
    };
    for (number, wants) in wants.iter().enumerate() {
        (0..wants.at_once).for_each(|_| ask(&mut pool, &mut asked, number, now));
    }
    while now < length_ms {
        for notice in pool.take_notices() {
            let Notice::Granted { waiter, lease } = notice else { continue };
            let number = asked.remove(&waiter).unwrap();
            let time = dice.between(wants[number].hold_ms.0, wants[number].hold_ms.1);
            (0..2).for_each(|kind| held[number][kind] += u64::from(wants[number].units[kind]) * time);
            ends.insert((now + time, lease.id, number));
        }
        if now % 16 == 0 {
            pool.check_invariants().unwrap();
        }
        let (end, lease, number) = ends.pop_first().unwrap();
        now = end;
        // It asks for the next before it gives this one back.
        ask(&mut pool, &mut asked, number, now);
        pool.release(at(now), Some(&run(number)), lease).unwrap();
    }
    held
}

fn shares(numbers: &[f64]) -> Vec<Standing> {
    numbers.iter().map(|number| Standing::of(Share::new(*number).unwrap())).collect()
}

/// What each has of the first kind, in hundredths of all.
fn percent(held: &[[u64; 2]]) -> Vec<u64> {
    let all: u64 = held.iter().map(|held| held[0]).sum();
    held.iter().map(|held| (100 * held[0] + all / 2) / all).collect()
}

fn about(is: &[u64], expected: &[u64], tolerance: u64) {
    let near = is.iter().zip(expected).all(|(is, expected)| is.abs_diff(*expected) <= tolerance);
    assert!(near, "{is:?} is not about {expected:?} %");
}

#[test]
fn two_runs_have_an_arm_by_their_shares() {
    for (shares_of, expected) in [([1.0, 1.0], [50, 50]), ([2.0, 1.0], [67, 33]), ([1.0, 4.0], [20, 80])] {
        for seed in 0..3 {
            let held = held(&shares(&shares_of), &[Wants::one_arm(), Wants::one_arm()], [1, 0], 3_600_000, seed);
            about(&percent(&held), &expected, 5);
        }
    }
}

#[test]
fn what_a_run_has_follows_from_its_share_and_not_from_its_priorities_or_how_long_it_holds() {
    let urgent = Wants { priority: 1 << 59, ..Wants::one_arm() };
    let long = Wants { hold_ms: (3_600, 4_400), ..Wants::one_arm() };
    for seed in 0..3 {
        let held = held(&shares(&[1.0, 1.0]), &[urgent.clone(), Wants::one_arm()], [1, 0], 3_600_000, seed);
        about(&percent(&held), &[50, 50], 5);
        let held = self::held(&shares(&[1.0, 1.0]), &[long.clone(), Wants::one_arm()], [1, 0], 3_600_000, seed);
        about(&percent(&held), &[50, 50], 5);
    }
}

#[test]
fn three_runs_have_two_arms_by_their_shares() {
    let wants = vec![Wants { at_once: 2, ..Wants::one_arm() }; 3];
    for seed in 0..3 {
        let held = held(&shares(&[2.0, 1.0, 1.0]), &wants, [2, 0], 3_600_000, seed);
        about(&percent(&held), &[50, 25, 25], 5);
    }
}

/// How often each of two runs gets the one arm within an hour. Both want it all the time, for a second; whenever the second one has got it, the first one
/// asks until so many requests wait.
fn grants_of_an_hour(pool: &mut Pool, wanted: &Requirement, waiting: usize) -> [u64; 2] {
    let ask = |pool: &mut Pool, now: u64, number: usize| {
        pool.acquire(at(now), AcquireRequest::new(run(number), vec![wanted.clone()])).unwrap()
    };
    let mut asked = BTreeMap::from([0, 1].map(|number| (ask(pool, 0, number), number)));
    let (mut now, mut had) = (0, [0, 0]);
    while now < 3_600_000 {
        let granted = pool.take_notices().into_iter().find_map(|notice| match notice {
            Notice::Granted { waiter, lease } => Some((waiter, lease.id)),
            _ => None,
        });
        let (waiter, lease) = granted.unwrap();
        let number = asked.remove(&waiter).unwrap();
        had[number] += 1;
        while number == 1 && asked.len() < waiting {
            asked.insert(ask(pool, now, 0), 0);
        }
        now += 1_000;
        asked.insert(ask(pool, now, number), number);
        pool.release(at(now), Some(&run(number)), lease).unwrap();
    }
    had
}

#[test]
fn who_has_much_waiting_has_no_more_for_that() {
    let one = Wants { hold_ms: (9_000, 11_000), ..Wants::one_arm() };
    for (at_once, share, expected) in [(8, 1.0, [50, 50]), (200, 1.0, [50, 50]), (200, 4.0, [20, 80])] {
        let many = Wants { at_once, ..one.clone() };
        let held = held(&shares(&[1.0, share]), &[many, one.clone()], [1, 0], 3_600_000, 1);
        about(&percent(&held), &expected, 5);
    }
}

#[test]
fn shares_hold_for_one_of_many_that_is_wanted_and_beside_who_wants_what_does_not_exist() {
    let left = Requirement { attributes: left_side(), ..block("Arm", 1) };
    for hopeless in [false, true] {
        let mut pool = pool(&shares(&[1.0, 4.0, 100.0]), [if hopeless { 0 } else { 9 }, 0]);
        let arm = ResourceSpec::new(ResourceClass::Module, "Arm").capacity(1_u32);
        pool.create(at(0), None, ResourceSpec { attributes: left_side(), ..arm }).unwrap();
        if hopeless {
            pool.acquire(at(0), AcquireRequest::new(run(2), vec![block("Arm", 2)])).unwrap();
        }
        let had = grants_of_an_hour(&mut pool, &left, 1);
        about(&[100 * had[0] / (had[0] + had[1])], &[20], 5);
    }
}

#[test]
fn a_request_that_takes_the_place_of_another_keeps_its_turn_beside_who_asked_between() {
    let mut pool = pool(&shares(&[1.0; 4]), [1, 0]);
    let arm = |number: usize| AcquireRequest::new(run(number), vec![block("Arm", 1)]);
    let held = queued(&mut pool, 0, 1, arm(1));
    queued(&mut pool, 1_000, 2, arm(0));
    let between = queued(&mut pool, 12_000, 3, arm(2));
    let again = queued(&mut pool, 25_000, 4, arm(0).instead_of("2"));
    let urgent = queued(&mut pool, 29_000, 5, arm(3).priority(7));
    let order: Vec<WaiterId> = pool.waiters().into_iter().map(|(id, _)| id).collect();
    assert_eq!(order, [again, between, urgent]);
    assert!(pool.explain(held).is_none());
}

#[test]
fn no_time_is_saved_up_with_what_cannot_be_served() {
    let mut pool = pool(&shares(&[1.0, 1.0, 1.0]), [1, 0]);
    let arms = |number: usize, count: u32| AcquireRequest::new(run(number), vec![block("Arm", count)]);
    queued(&mut pool, 0, 1, arms(2, 1));
    queued(&mut pool, 1_000, 2, arms(0, 4_096));
    let other = queued(&mut pool, 1_000_000, 3, arms(1, 1));
    let exchanged = queued(&mut pool, 1_100_000, 4, arms(0, 1).instead_of("2").priority(i64::MAX));
    let order: Vec<WaiterId> = pool.waiters().into_iter().map(|(id, _)| id).collect();
    assert_eq!(order, [other, exchanged]);
    pool.check_invariants().unwrap();
}

#[test]
fn a_whole_unit_comes_together_from_its_parts() {
    let mut pool = pool(&shares(&[1.0, 1.0]), [0, 0]);
    let battery = ResourceSpec::new(ResourceClass::Module, "Battery").capacity(1_u32);
    pool.create(at(0), None, ResourceSpec { divisible: true, ..battery }).unwrap();
    let half = || Requirement { count: Quantity::from_thousandths(500), ..block("Battery", 1) };
    let granted = |pool: &mut Pool| -> Vec<(WaiterId, LeaseId)> {
        let grant = |notice| match notice {
            Notice::Granted { waiter, lease } => Some((waiter, lease.id)),
            _ => None,
        };
        pool.take_notices().into_iter().filter_map(grant).collect()
    };
    let parts = |pool: &mut Pool, now: u64| pool.acquire(at(now), AcquireRequest::new(run(0), vec![half()])).unwrap();
    parts(&mut pool, 0);
    parts(&mut pool, 5_000);
    let leases: Vec<LeaseId> = granted(&mut pool).into_iter().map(|(_, lease)| lease).collect();
    let whole = pool.acquire(at(6_000), AcquireRequest::new(run(1), vec![block("Battery", 1)])).unwrap();
    let mut last = WaiterId(0);
    for (now, lease) in [(100_000, leases[0]), (105_000, leases[1])] {
        pool.release(at(now), Some(&run(0)), lease).unwrap();
        last = parts(&mut pool, now);
        pool.check_invariants().unwrap();
    }
    assert_eq!(granted(&mut pool).into_iter().map(|(waiter, _)| waiter).collect::<Vec<_>>(), [whole]);
    assert!(pool.explain(last).is_some());
}

#[test]
fn what_waits_for_long_lets_its_session_pass_nobody_who_comes_next() {
    // The first one has a request that is not served, and fills up whenever the other one does not wait.
    let mut pool = pool(&shares(&[1.0, 1.0]), [1, 0]);
    pool.acquire(at(0), AcquireRequest::new(run(0), vec![block("Arm", 2)])).unwrap();
    let had = grants_of_an_hour(&mut pool, &block("Arm", 1), 6);
    about(&[100 * had[0] / (had[0] + had[1])], &[50], 5);
}

#[test]
fn a_session_alone_is_served_by_its_own_order_where_its_requests_want_several_kinds() {
    let mut pool = pool(&shares(&[1.0]), [1, 1]);
    let ask = |pool: &mut Pool, now: u64, units: [u32; 2], priority: i64| {
        pool.acquire(at(now), AcquireRequest::new(run(0), wanted(units)).priority(priority)).unwrap()
    };
    ask(&mut pool, 0, [1, 1], 0);
    let Some(Notice::Granted { lease, .. }) = pool.take_notices().pop() else { panic!("both are free") };
    let first = ask(&mut pool, 0, [1, 0], 0);
    let second = ask(&mut pool, 100_000, [0, 1], 0);
    let both = ask(&mut pool, 101_000, [1, 1], 9);
    let last = ask(&mut pool, 102_000, [1, 0], 9);
    let mut order = vec![];
    let mut leases = vec![lease.id];
    while let Some(id) = leases.pop() {
        pool.release(at(110_000), None, id).unwrap();
        for notice in pool.take_notices() {
            let Notice::Granted { waiter, lease } = notice else { continue };
            order.push(waiter);
            leases.push(lease.id);
        }
    }
    let place = |waiter: WaiterId| order.iter().position(|other| *other == waiter).unwrap();
    assert!(place(both) == 0 && place(last) < place(first) && place(second) > 0, "{order:?}");
}

#[test]
fn what_a_run_leaves_others_have() {
    // The first one wants little, though its share is large.
    let seldom = Wants { units: [0, 1], ..Wants::one_arm() };
    let wants = [seldom, Wants::one_arm(), Wants::one_arm()];
    let held = held(&shares(&[10.0, 1.0, 1.0]), &wants, [1, 1], 600_000, 1);
    about(&percent(&held), &[0, 50, 50], 5);
    assert!(held.iter().map(|held| held[0]).sum::<u64>() > 590_000, "the arm is never idle");
}

#[test]
fn of_what_is_asked_at_about_the_same_time_what_is_due_first_comes_first() {
    let due = |seconds: u64| Standing { due: Some(at(seconds * 1_000)), ..Standing::default() };
    let mut pool = pool(&[Standing::default(), due(500), due(400), Standing::default()], [1, 0]);
    let held = pool.acquire(at(0), AcquireRequest::new(run(3), vec![block("Arm", 1)])).unwrap();
    let asked = [(0, 7), (1, 0), (2, 0), (0, 1 << 60)];
    let asked = asked.map(|(number, priority)| {
        pool.acquire(at(1), AcquireRequest::new(run(number), vec![block("Arm", 1)]).priority(priority)).unwrap()
    });
    let order: Vec<WaiterId> = pool.waiters().into_iter().map(|(id, _)| id).collect();
    assert_eq!(order, [asked[3], asked[2], asked[1], asked[0]], "urgency, then due times, then priorities");
    // Said again from another moment it is the same; and nobody is passed for it who asked so long before.
    pool.set_standing(at(2), &run(1), Standing { due: Some(at(500_900)), ..Standing::default() }).unwrap();
    assert_eq!(pool.explain(asked[1]).unwrap().standing.due, Some(at(500_000)));
    let order = |pool: &Pool| pool.waiters().into_iter().map(|(id, _)| id).collect::<Vec<_>>();
    pool.set_standing(at(2), &run(1), due(1)).unwrap();
    assert_eq!(order(&pool), [asked[3], asked[1], asked[2], asked[0]], "what waits already is due, too");
    let late = AcquireRequest::new(run(1), vec![block("Arm", 1)]).priority(i64::MAX);
    let late = pool.acquire(at(10_000), late).unwrap();
    assert_eq!(order(&pool), [asked[3], asked[2], late, asked[1], asked[0]]);
    assert!(pool.explain(held).is_none(), "it holds the arm");
}

#[test]
fn a_session_alone_is_served_by_priority_however_long_its_requests_wait() {
    let mut pool = pool(&shares(&[1.0, 1.0]), [1, 1]);
    let ask = |pool: &mut Pool, now: u64, number: usize, kind: &str, priority: i64| {
        pool.acquire(at(now), AcquireRequest::new(run(number), vec![block(kind, 1)]).priority(priority)).unwrap()
    };
    for (number, kind) in [(0, "Arm"), (1, "Camera"), (1, "Camera")] {
        ask(&mut pool, 0, number, kind, 0);
    }
    let first = ask(&mut pool, 1_000, 0, "Arm", 1);
    let second = ask(&mut pool, 900_000, 0, "Arm", 2);
    let third = ask(&mut pool, 1_800_000, 0, "Arm", 0);
    let arms = |pool: &Pool| -> Vec<WaiterId> {
        let arm = |request: &AcquireRequest| request.requirements[0].kind == "Arm";
        pool.waiters().into_iter().filter(|(_, request)| arm(request)).map(|(id, _)| id).collect()
    };
    assert_eq!(arms(&pool), [second, first, third], "the other one waits for something else");
    let other = ask(&mut pool, 1_800_000, 1, "Arm", 9);
    let last = ask(&mut pool, 1_900_000, 0, "Arm", 9);
    // The first one holds the arm, so the other one goes before it; of the first one's own, what it wants most.
    assert_eq!(arms(&pool), [other, last, second, first, third]);
}

#[test]
fn a_request_that_takes_the_place_of_another_keeps_its_time() {
    let mut pool = pool(&shares(&[1.0; 3]), [1, 0]);
    let ask = |pool: &mut Pool, now: u64, id: &str, request: AcquireRequest| match pool
        .handle(at(now), id, Request::Acquire(request))
        .unwrap()
    {
        Reply::Queued(waiter) => waiter,
        reply => panic!("{reply:?}"),
    };
    let arm = |number: usize| AcquireRequest::new(run(number), vec![block("Arm", 1)]);
    let order = |pool: &Pool| pool.waiters().into_iter().map(|(id, _)| id).collect::<Vec<_>>();
    ask(&mut pool, 0, "held", arm(2));
    let in_case = ask(&mut pool, 1_000, "in-case", arm(0).speculative(true));
    let other = ask(&mut pool, 20_000, "other", arm(1));
    assert_eq!(order(&pool), [other, in_case], "what is certain comes first");
    // Of 39 s of speculative waiting it keeps 10.
    let certain = ask(&mut pool, 40_000, "certain", arm(0).instead_of("in-case"));
    let asked = pool.explain(certain).unwrap().asked;
    assert_eq!((order(&pool), asked), (vec![other, certain], at(30_000)));
    let refused = |notice: &Notice| matches!(notice, Notice::Refused { waiter, .. } if *waiter == in_case);
    assert!(pool.take_notices().iter().any(refused), "whom it takes the place of leaves");
    // Of certain waiting all, also under the same id after it had left.
    let urgent = ask(&mut pool, 60_000, "urgent", arm(0).instead_of("certain").priority(5));
    assert_eq!(pool.explain(urgent).unwrap().asked, at(30_000));
    pool.cancel(at(61_000), urgent).unwrap();
    let again = ask(&mut pool, 62_000, "urgent", arm(0).instead_of("certain").priority(5));
    assert_eq!(pool.explain(again).unwrap().asked, at(30_000));
    // Not twice, not of another session, not after a while.
    let twice = ask(&mut pool, 63_000, "twice", arm(0).instead_of("certain"));
    let anothers = ask(&mut pool, 63_000, "anothers", arm(1).instead_of("urgent"));
    pool.cancel(at(64_000), again).unwrap();
    let late = ask(&mut pool, 75_000, "late", arm(0).instead_of("urgent"));
    let asked = [twice, anothers, late].map(|waiter| pool.explain(waiter).unwrap().asked);
    assert_eq!(asked, [at(63_000), at(63_000), at(75_000)]);
    pool.check_invariants().unwrap();
}

fn arm(session: &SessionId) -> AcquireRequest {
    AcquireRequest::new(session.clone(), vec![block("Arm", 1)])
}

fn granted(pool: &mut Pool) -> Option<(WaiterId, LeaseId)> {
    pool.take_notices().into_iter().find_map(|notice| match notice {
        Notice::Granted { waiter, lease } => Some((waiter, lease.id)),
        _ => None,
    })
}

/// Many old requests of one session wait, and one after the other is exchanged for one of a new session.
#[test]
fn a_request_keeps_no_time_of_one_of_another_session() {
    const OLD: u64 = 300;
    let mut pool = pool(&shares(&[1.0; 3]), [1, 0]);
    queued(&mut pool, 0, 1_000, arm(&run(2)));
    let (_, mut lease) = granted(&mut pool).unwrap();
    for number in 0..OLD {
        queued(&mut pool, 0, number, arm(&run(0)));
    }
    let (mut victim, mut asked) = (None, BTreeMap::new());
    for number in 0..OLD {
        let now = 5_000 * (number + 1);
        if now == 100_000 {
            victim = Some(queued(&mut pool, now, 1_001, arm(&run(1))));
        }
        let session = SessionId::from(format!("new-{number}").as_str());
        pool.keep_alive(at(now), &session, "new", HOUR).unwrap();
        // The last ones go first: they never were the first of their session.
        pool.withdraw(at(now), &run(0), &(OLD - 1 - number).to_string()).unwrap();
        let exchanged = arm(&session).instead_of(&(OLD - 1 - number).to_string());
        asked.insert(queued(&mut pool, now, 2_000 + number, exchanged), now);
        pool.release(at(now), None, lease).unwrap();
        let (waiter, next) = granted(&mut pool).unwrap();
        pool.check_invariants().unwrap();
        if Some(waiter) == victim {
            return;
        }
        if let Some(asked) = asked.get(&waiter) {
            assert!(*asked < 100_000 + BOUND.as_millis() as u64, "passed by one that was asked at {asked} ms");
        }
        lease = next;
    }
    panic!("it is never served");
}

/// Two sessions take turns; each ends when it has been served, is opened anew under its id, and has requests from before.
#[test]
fn a_session_that_is_opened_anew_keeps_no_time_from_before_it_was_served() {
    const OLD: u64 = 40;
    let mut pool = pool(&shares(&[1.0; 2]), [1, 0]);
    let sessions = ["old-0", "old-1"].map(SessionId::from);
    let id = |of: usize, number: u64| 1_000 * of as u64 + number;
    // They are in the queue for a moment, and leave so that none of them becomes the first.
    let refresh = |pool: &mut Pool, now: u64, of: usize, from: u64| {
        pool.keep_alive(at(now), &sessions[of], "old", HOUR).unwrap();
        for number in from..OLD {
            queued(pool, now, id(of, number), arm(&sessions[of]));
        }
        for number in (from..OLD).rev() {
            assert!(pool.withdraw(at(now), &sessions[of], &id(of, number).to_string()).unwrap());
        }
    };
    queued(&mut pool, 0, 9_000, arm(&run(1)));
    let (_, mut lease) = granted(&mut pool).unwrap();
    (0..2).for_each(|of| refresh(&mut pool, 0, of, 0));
    let (mut victim, mut holder) = (None, None);
    for turn in 0..2 * OLD {
        let (now, of) = (5_000 * (turn + 1), turn as usize % 2);
        if now == 25_000 {
            victim = Some(queued(&mut pool, now, 9_001, arm(&run(0))));
        }
        refresh(&mut pool, now, of, turn / 2);
        queued(&mut pool, now, id(of, turn / 2), arm(&sessions[of]));
        match holder.replace(of) {
            Some(holder) => pool.close_session(at(now), &sessions[holder]).unwrap(),
            None => pool.release(at(now), None, lease).unwrap(),
        }
        let (waiter, next) = granted(&mut pool).unwrap();
        pool.check_invariants().unwrap();
        if Some(waiter) == victim {
            return;
        }
        assert!(now < 25_000 + BOUND.as_millis() as u64, "it is passed again and again");
        lease = next;
    }
    panic!("it is never served");
}

#[test]
fn what_waits_for_something_else_keeps_its_run_from_nothing() {
    let mut pool = pool(&shares(&[1.0; 4]), [1, 1]);
    let ask = |pool: &mut Pool, now: u64, number: usize, units: [u32; 2], priority: i64| {
        pool.acquire(at(now), AcquireRequest::new(run(number), wanted(units)).priority(priority)).unwrap()
    };
    // The last one keeps the camera.
    ask(&mut pool, 0, 3, [0, 1], 0);
    pool.take_notices();
    ask(&mut pool, 0, 1, [1, 0], 0);
    let (_, mut lease) = granted(&mut pool).unwrap();
    let (mut holder, mut asked) = (1, BTreeMap::new());
    for (units, priority) in [([0, 1], 3), ([1, 1], 2), ([1, 0], 1)] {
        asked.insert(ask(&mut pool, 1_000, 0, units, priority), 0);
    }
    asked.insert(ask(&mut pool, 1_000, 2, [1, 0], 0), 2);
    for turn in 1..360 {
        let now = 10_000 * turn;
        asked.insert(ask(&mut pool, now, holder, [1, 0], 0), holder);
        pool.release(at(now), None, lease).unwrap();
        let (waiter, next) = granted(&mut pool).unwrap();
        pool.check_invariants().unwrap();
        (holder, lease) = (asked[&waiter], next);
        if holder == 0 {
            assert!(now <= 1_000 + BOUND.as_millis() as u64 + 20_000, "only after {now} ms");
            return;
        }
    }
    panic!("it has no arm for an hour");
}

#[test]
fn who_asks_again_is_put_off_for_what_it_has_as_before() {
    for again in [false, true] {
        let mut pool = pool(&shares(&[1.0; 4]), [2, 0]);
        let of = |number: usize, priority: i64| arm(&run(number)).priority(priority);
        queued(&mut pool, 0, 1, of(0, 0));
        queued(&mut pool, 0, 2, of(2, 0));
        let leases = pool.leases();
        let other = leases.iter().find(|lease| lease.session == run(2)).unwrap().id;
        pool.take_notices();
        queued(&mut pool, 0, 3, of(0, 0));
        let next = queued(&mut pool, 0, 4, of(3, -5));
        if again {
            queued(&mut pool, 2_000, 5, of(0, 0).instead_of("3"));
        }
        queued(&mut pool, 30_000, 6, of(1, 0));
        pool.release(at(50_000), None, other).unwrap();
        assert_eq!(granted(&mut pool).map(|(waiter, _)| waiter), Some(next), "asked again: {again}");
        pool.check_invariants().unwrap();
    }
}

/// A request that waits, as the test knows it.
struct Waits {
    number: usize,
    /// When it became certain; nothing while it is speculative.
    certain_since: Option<u64>,
    /// As far as that counts for who passes it: where it replaced another one, since when that was certain.
    asked: u64,
    units: [u32; 2],
    priority: i64,
    id: String,
}

/// What the test knows of the requests of all runs.
#[derive(Default)]
struct Line {
    waiting: BTreeMap<WaiterId, Waits>,
    /// When the last request of a run was served that was its first, by kind.
    served: BTreeMap<usize, [u64; 2]>,
}

impl Line {
    /// Whether a request is a first one of its run: none before it that is one wants a kind that it wants.
    fn is_first(&self, id: WaiterId) -> bool {
        let place = |id: &WaiterId, of: &Waits| (of.certain_since.is_none(), Reverse(of.priority), *id);
        let of_run = self.waiting.iter().filter(|(_, other)| other.number == self.waiting[&id].number);
        let mut of_run: Vec<(&WaiterId, &Waits)> = of_run.collect();
        of_run.sort_by_key(|(id, of)| place(id, of));
        let mut taken = [false; 2];
        for (other, of) in of_run {
            let wants = of.units.map(|units| units > 0);
            let first = (0..2).all(|kind| !(wants[kind] && taken[kind]));
            if *other == id {
                return first;
            }
            (0..2).for_each(|kind| taken[kind] |= first && wants[kind]);
        }
        false
    }

    /// From then on a request of a run counts that was asked at a time, at the least.
    fn since(&self, of: &Waits, asked: u64) -> u64 {
        let served = self.served.get(&of.number).copied().unwrap_or_default();
        (0..2).filter(|kind| of.units[*kind] > 0).map(|kind| served[kind]).fold(asked, u64::max)
    }
}

/// Random requests of so many runs for an hour; how many grants there were, and how many that passed somebody.
fn random_hour(seed: u64) -> (usize, usize) {
    let mut dice = Dice(seed);
    let runs = dice.between(2, 7) as usize;
    let mut standings = shares(&vec![1.0; runs]);
    for standing in &mut standings {
        standing.share = Share::new([0.01, 0.5, 1.0, 3.0, 100.0][dice.below(5) as usize]).unwrap();
        standing.due = (dice.below(3) == 0).then(|| at(dice.below(3_600_000)));
    }
    let mut pool = pool(&standings, [2, 3]);
    let mut line = Line::default();
    let mut ends: BTreeSet<(u64, LeaseId)> = BTreeSet::new();
    let (mut now, mut next, mut grants, mut passes) = (0, 0, 0, 0);
    // Some seeds have long waits, some short ones.
    let pause = [200, 2_000, 6_000][dice.below(3) as usize];
    while now < 3_600_000 {
        now += dice.between(1, pause);
        while let Some((end, lease)) = ends.first().copied().filter(|(end, _)| *end <= now) {
            ends.pop_first();
            pool.release(at(end), None, lease).unwrap();
            observe(&mut pool, end, &mut dice, &mut line, &mut ends, (&mut grants, &mut passes));
        }
        let known = line.waiting.keys().nth(dice.below(1 + line.waiting.len() as u64) as usize).copied();
        match (dice.below(10), known) {
            (0, Some(id)) => {
                pool.cancel(at(now), id).unwrap();
                line.waiting.remove(&id);
            }
            (1, Some(id)) => {
                let before = line.waiting.remove(&id).unwrap();
                next += 1;
                let request = AcquireRequest::new(run(before.number), wanted(before.units)).instead_of(&before.id);
                let priority = dice.below(1 << 62) as i64;
                let request = request.priority(priority);
                let waiter = queued(&mut pool, now, next, request);
                let asked = if before.certain_since.is_some() { before.asked } else { now };
                let certain_since = Some(before.certain_since.unwrap_or(now));
                line.waiting.insert(waiter, Waits { id: next.to_string(), asked, certain_since, priority, ..before });
            }
            _ if line.waiting.len() < 60 => {
                next += 1;
                let number = dice.below(runs as u64) as usize;
                let units = [[1, 0], [2, 0], [0, 1], [0, 3], [1, 1], [2, 3]][dice.below(6) as usize];
                let speculative = dice.below(4) == 0;
                let priority = [0, 1, 1 << 60, 1 << 61, i64::MAX, i64::MIN][dice.below(6) as usize];
                let request = AcquireRequest::new(run(number), wanted(units)).priority(priority);
                let waiter = queued(&mut pool, now, next, request.speculative(speculative));
                let certain_since = (!speculative).then_some(now);
                let waits = Waits { number, certain_since, asked: now, units, priority, id: next.to_string() };
                line.waiting.insert(waiter, waits);
            }
            _ => {}
        }
        observe(&mut pool, now, &mut dice, &mut line, &mut ends, (&mut grants, &mut passes));
    }
    (grants, passes)
}

fn wanted(units: [u32; 2]) -> Vec<Requirement> {
    KINDS.iter().zip(units).filter(|(_, units)| *units > 0).map(|(kind, units)| block(kind, units)).collect()
}

fn queued(pool: &mut Pool, now: u64, id: u64, request: AcquireRequest) -> WaiterId {
    match pool.handle(at(now), &id.to_string(), Request::Acquire(request)).unwrap() {
        Reply::Queued(waiter) => waiter,
        reply => panic!("{reply:?}"),
    }
}

/// Takes the grants, and looks whether anybody was passed who must not be.
fn observe(
    pool: &mut Pool,
    now: u64,
    dice: &mut Dice,
    line: &mut Line,
    ends: &mut BTreeSet<(u64, LeaseId)>,
    (grants, passes): (&mut usize, &mut usize),
) {
    if now.is_multiple_of(64) {
        pool.check_invariants().unwrap();
    }
    let granted = pool.take_notices().into_iter().filter_map(|notice| match notice {
        Notice::Granted { waiter, lease } => Some((waiter, lease.id)),
        _ => None,
    });
    let granted: Vec<(WaiterId, LeaseId)> = granted.collect();
    let free =
        KINDS.map(|kind| pool.list().iter().filter(|one| one.kind == kind).map(|one| one.free).sum::<Quantity>());
    for (waiter, lease) in granted {
        *grants += 1;
        let first = line.is_first(waiter);
        let served = line.waiting.remove(&waiter).unwrap();
        ends.insert((now + dice.between(100, 20_000), lease));
        for (id, other) in line.waiting.iter().filter(|(_, other)| other.number != served.number) {
            // What it had reserved is free still.
            let took = (0..2).any(|kind| served.units[kind] > 0 && free[kind] < other.units[kind].into());
            let Some(certain) = other.certain_since.filter(|_| took) else { continue };
            let Some(asked) = served.certain_since else {
                panic!("what is speculative was served before {} that is certain", other.id)
            };
            if !line.is_first(*id) {
                continue;
            }
            let (since, passes_since) = (line.since(other, other.asked.max(certain)), line.since(&served, asked));
            *passes += usize::from(passes_since > since);
            assert!(
                passes_since < since + BOUND.as_millis() as u64,
                "{} is the first since {since} and was passed by one since {passes_since}",
                other.id
            );
        }
        if first {
            let times = line.served.entry(served.number).or_default();
            (0..2).filter(|kind| served.units[*kind] > 0).for_each(|kind| times[kind] = now);
        }
    }
}

#[test]
fn nobody_is_passed_by_who_asked_later_than_the_bound() {
    assert_eq!(BOUND, AHEAD + 2 * LEAD);
    let (mut grants, mut passes) = (0, 0);
    for seed in 0..24 {
        let (granted, passed) = random_hour(seed);
        (grants, passes) = (grants + granted, passes + passed);
    }
    assert!(grants > 10_000 && passes > 1_000, "{grants} grants, {passes} of which passed somebody");
}

#[test]
fn a_large_request_is_kept_what_becomes_free_once_all_that_may_pass_it_is_served() {
    let mut pool = pool(&shares(&[0.01, 100.0]), [2, 0]);
    let mut ends = BTreeSet::new();
    let (mut now, mut large) = (0, None);
    // What the other run has had is far more than its share.
    pool.acquire(at(0), AcquireRequest::new(run(0), vec![block("Arm", 2)])).unwrap();
    // Small ones one after the other, of a run with a large share and a high priority, for ever.
    let mut asked = 0;
    loop {
        for notice in pool.take_notices() {
            let Notice::Granted { waiter, lease } = notice else { continue };
            if large.is_some_and(|(large, _)| large == waiter) {
                let since = large.map_or(0, |(_, since)| since);
                let waited = Duration::from_millis(now - since);
                assert!(LEAD <= waited && waited <= AHEAD + LEAD + Duration::from_secs(2), "{waited:?}");
                return;
            }
            ends.insert((now + 1_000, lease.id));
        }
        while pool.waiters().len() < 3 {
            let small = AcquireRequest::new(run(1), vec![block("Arm", 1)]).priority(i64::MAX);
            pool.acquire(at(now), small).unwrap();
            asked += 1;
            if asked == 10 {
                let both = AcquireRequest::new(run(0), vec![block("Arm", 2)]).priority(i64::MIN);
                large = Some((pool.acquire(at(now), both).unwrap(), now));
            }
        }
        if let Some((end, lease)) = ends.pop_first() {
            now = now.max(end) + 1;
            pool.release(at(now), None, lease).unwrap();
        }
        assert!(now < 600_000, "the large request is never served");
    }
}

/// Two callers who always want one arm: adam in one session, eve in several, each of which she may end with its lease and open anew.
struct TwoCallers {
    bound: u32,
    adams_share: f64,
    eves_share: f64,
    eves_sessions: usize,
    opens_anew: bool,
}

impl TwoCallers {
    /// How much of the time adam has the arm, in hundredths.
    fn adams_part(&self, seed: u64) -> u64 {
        const LENGTH_MS: u64 = 3_600_000;
        let limits = Limits { share_per_caller: self.bound, ..Limits::default() };
        let (mut pool, mut dice, mut now) = (Pool::new(limits), Dice(seed), 0);
        pool.create(at(0), None, ResourceSpec::new(ResourceClass::Module, "Arm")).unwrap();
        let ask = |pool: &mut Pool, now: u64, number: usize| {
            pool.acquire(at(now), AcquireRequest::new(run(number), vec![block("Arm", 1)])).unwrap();
        };
        let open = |pool: &mut Pool, now: u64, number: usize| {
            let (name, share) = if number == 0 { ("adam", self.adams_share) } else { ("eve", self.eves_share) };
            let speaker = Speaker { name: name.into(), for_anybody: false };
            pool.keep_alive_as(at(now), &speaker, &run(number), name, 100 * HOUR).unwrap();
            pool.set_standing(at(now), &run(number), Standing::of(Share::new(share).unwrap())).unwrap();
        };
        let mut last = self.eves_sessions;
        for number in 0..=last {
            open(&mut pool, now, number);
            ask(&mut pool, now, number);
        }
        let (mut adams, mut turns) = (0, 0);
        while now < LENGTH_MS {
            let held = pool.leases().remove(0);
            let time = dice.between(900, 1_100);
            now += time;
            let is_adams = held.session == run(0);
            adams += if is_adams { time } else { 0 };
            if self.opens_anew && !is_adams {
                last += 1;
                open(&mut pool, now, last);
                ask(&mut pool, now, last);
                pool.close_session(at(now), &held.session).unwrap();
            } else {
                let number = held.session.as_str().strip_prefix("run-").unwrap();
                ask(&mut pool, now, number.parse().unwrap());
                pool.release(at(now), Some(&held.session), held.id).unwrap();
            }
            turns += 1;
            if turns % 64 == 0 {
                pool.check_invariants().unwrap();
            }
        }
        (100 * adams + now / 2) / now
    }
}

#[test]
fn sessions_of_one_caller_have_no_more_together_than_its_bound_also_where_they_are_opened_anew() {
    for (bound, adams_share, eves_share) in [(2, 2.0, 1.0), (1, 1.0, 100.0), (4, 2.0, 4.0)] {
        let expected = (100.0 * adams_share / (adams_share + f64::from(bound))) as u64;
        for (eves_sessions, opens_anew) in [(8, false), (8, true), (30, false), (30, true)] {
            let callers = TwoCallers { bound, adams_share, eves_share, eves_sessions, opens_anew };
            let part = callers.adams_part(u64::from(bound));
            let what = format!("{part} % and {expected} %: {eves_sessions} sessions, {bound}, {opens_anew}");
            assert!(part + 5 >= expected, "{what}");
            assert!(part <= expected + 5 || opens_anew, "and eve has her bound: {what}");
        }
    }
}

#[test]
fn within_the_bound_of_its_caller_a_session_has_its_share() {
    let callers = TwoCallers { bound: 4, adams_share: 1.0, eves_share: 1.0, eves_sessions: 4, opens_anew: false };
    let part = callers.adams_part(3);
    assert!(part.abs_diff(20) <= 3, "{part} % of five alike");
}
