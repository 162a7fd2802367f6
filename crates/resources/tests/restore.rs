//! What is written down is everything: after every step of random histories, the pool of an earlier snapshot and the records
//! since is the pool, in its state and in what it does next.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use proptest::prelude::*;
use ratn_model::id::{LeaseId, Revision};
use ratn_model::resource::{Requirement, ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_resources::{
    AcquireRequest, DecodeError, EndingUnits, FORMAT, Holding, Limits, Pool, Record, Request, ResourceSpec,
    ResourceView, RestoreError, SessionId, Snapshot, Speaker, decode, encode,
};
use std::time::Duration;

const KINDS: [&str; 3] = ["Arm", "Battery", "PathPlanner"];
const SESSIONS: [&str; 3] = ["a", "b", "c"];

#[derive(Debug, Clone)]
enum Step {
    Wait(u64),
    KeepAlive(usize, u64),
    Close(usize),
    Create { owner: Option<usize>, kind: usize, capacity: u32, renewable: bool, named: bool },
    Delete(usize),
    DeleteUnits { session: usize, kind: usize, count: u32 },
    Consume { session: usize, kind: usize, count: u32 },
    Acquire { session: usize, kinds: Vec<(usize, u32)>, hold_for: Option<u64>, consume: bool },
    Release(usize),
    Withdraw(u8),
    Confirm(usize),
    EndTask(usize),
}

fn step() -> impl Strategy<Value = (Step, u8)> {
    let session = 0..SESSIONS.len();
    let kind = 0..KINDS.len();
    let acquire = (
        session.clone(),
        prop::collection::vec((kind.clone(), 1..3u32), 1..3),
        prop::option::of(1..20u64),
        prop::bool::weighted(0.2),
    )
        .prop_map(|(session, kinds, hold_for, consume)| Step::Acquire { session, kinds, hold_for, consume });
    let create = (prop::option::of(session.clone()), kind.clone(), 1..4u32, any::<bool>(), prop::bool::weighted(0.3))
        .prop_map(|(owner, kind, capacity, renewable, named)| Step::Create { owner, kind, capacity, renewable, named });
    let step = prop_oneof![
        2 => (1..12u64).prop_map(Step::Wait),
        4 => (session.clone(), 10..40u64).prop_map(|(session, ttl)| Step::KeepAlive(session, ttl)),
        1 => session.clone().prop_map(Step::Close),
        4 => create,
        1 => (0..8usize).prop_map(Step::Delete),
        1 => (session.clone(), kind.clone(), 1..3u32)
            .prop_map(|(session, kind, count)| Step::DeleteUnits { session, kind, count }),
        2 => (session.clone(), kind.clone(), 1..3u32)
            .prop_map(|(session, kind, count)| Step::Consume { session, kind, count }),
        8 => acquire,
        4 => (0..8usize).prop_map(Step::Release),
        1 => (0..30u8).prop_map(Step::Withdraw),
        2 => (0..8usize).prop_map(Step::Confirm),
        1 => session.prop_map(Step::EndTask),
    ];
    // Request ids repeat now and then; 0 is none.
    (step, 0..30u8)
}

fn requirement(operation: ResourceOperation, kind: usize, count: u32) -> Requirement {
    Requirement { count: count.into(), ..Requirement::new(operation, KINDS[kind]) }
}

fn perform(pool: &mut Pool, now: u64, step: &Step, id: u8) -> String {
    let at = Timestamp(now);
    let session = |index: usize| SessionId::from(SESSIONS[index]);
    let request = match step {
        Step::Wait(_) => {
            pool.advance(at);
            return String::new();
        }
        Step::KeepAlive(index, ttl) => {
            return format!("{:?}", pool.keep_alive(at, &session(*index), "test", Duration::from_nanos(*ttl)));
        }
        Step::Close(index) => return format!("{:?}", pool.close_session(at, &session(*index))),
        Step::Withdraw(other) => return format!("{:?}", pool.withdraw(at, &session(0), &other.to_string())),
        Step::Create { owner, kind, capacity, renewable, named } => {
            let mut spec = ResourceSpec::new(ResourceClass::Module, KINDS[*kind]).capacity(*capacity);
            spec.renewable = *renewable;
            spec.id = named.then(|| format!("the-{}", KINDS[*kind]));
            let spec = spec.attribute("level", Value::Float(0.5));
            // A bound that does not pass: it begins anew after a restart.
            let spec = if *kind == 0 { spec.standstill(Duration::from_millis(1)) } else { spec };
            Request::Create { session: owner.map(session), spec }
        }
        Step::Delete(index) => {
            let id = pool.list().get(*index).map_or_else(|| "none".to_owned(), |view| view.id.clone());
            Request::Delete { session: None, id }
        }
        Step::DeleteUnits { session: index, kind, count } => Request::DeleteUnits {
            session: session(*index),
            requirement: requirement(ResourceOperation::Delete, *kind, *count),
        },
        Step::Consume { session: index, kind, count } => Request::Consume {
            session: session(*index),
            requirement: requirement(ResourceOperation::Consume, *kind, *count),
            resource: None,
        },
        Step::Acquire { session: index, kinds, hold_for, consume } => {
            let operation = if *consume { ResourceOperation::Consume } else { ResourceOperation::Block };
            let requirements = kinds.iter().map(|(kind, count)| requirement(operation, *kind, *count)).collect();
            let mut request = AcquireRequest::new(session(*index), requirements).deadline(Timestamp(now + 25));
            request.hold_for = hold_for.map(Duration::from_nanos);
            Request::Acquire(request)
        }
        Step::Release(index) => {
            let lease = pool.leases().get(*index).map_or(LeaseId(0), |lease| lease.id);
            Request::Release { session: None, lease, at_rest: true }
        }
        Step::Confirm(index) => {
            let ending = pool.list().into_iter().flat_map(|view| {
                let id = view.id.clone();
                view.holders.ending().map(move |ending| (ending.lease, id.clone())).collect::<Vec<_>>()
            });
            let (lease, resource) =
                ending.collect::<Vec<_>>().get(*index).cloned().unwrap_or((LeaseId(0), "the-Arm".into()));
            Request::ConfirmStandstill { session: None, lease, resource }
        }
        Step::EndTask(index) => Request::EndTask { session: session(*index) },
    };
    let id = if id == 0 { String::new() } else { id.to_string() };
    format!("{:?}", pool.handle(at, &id, request))
}

fn limits() -> Limits {
    Limits { remembered_requests: 12, remember_for_ms: 1, ..Limits::default() }
}

fn restored(now: u64, snapshot: &[u8], entries: &[Vec<u8>]) -> Pool {
    let records: Vec<Record> = entries.iter().flat_map(|entry| decode(entry).unwrap()).collect();
    Pool::restore(limits(), Timestamp(now), Some(Snapshot::decode(snapshot).unwrap()), records).unwrap()
}

/// Every resource; how much of a bound is left is not kept.
fn without_bounds(pool: &Pool) -> Vec<(ResourceView, Vec<Holding>, Vec<EndingUnits>)> {
    let apart = |mut view: ResourceView| {
        let holders = std::mem::take(&mut view.holders);
        let ending = holders.ending().map(|ending| EndingUnits { within: Duration::ZERO, ..ending });
        (view, holders.live().cloned().collect(), ending.collect())
    };
    pool.list().into_iter().map(apart).collect()
}

/// The same state after the queue is gone and every session has been kept alive.
fn settle(pool: &mut Pool, now: u64) {
    // From the back, so that nobody is granted for it.
    for (waiter, _) in pool.waiters().into_iter().rev() {
        pool.cancel(Timestamp(now), waiter).unwrap();
    }
    for session in pool.sessions() {
        pool.keep_alive(Timestamp(now), &session.id, &session.name, session.ttl).unwrap();
    }
    pool.take_notices();
    assert!(pool.take_records().is_empty(), "nothing durable has changed");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, ..ProptestConfig::default() })]

    #[test]
    fn a_restored_pool_is_the_pool_and_goes_on_as_it_does(
        steps in prop::collection::vec(step(), 1..60),
        cuts in prop::collection::vec(any::<prop::sample::Index>(), 60),
        next in prop::collection::vec(step(), 6),
    ) {
        let mut pool = Pool::new(limits());
        let mut now = 0;
        let mut snapshots = vec![pool.snapshot().encode()];
        let mut log: Vec<Vec<u8>> = Vec::new();
        for ((step, id), cut) in steps.iter().zip(cuts) {
            if let Step::Wait(time) = step {
                now += time;
            }
            perform(&mut pool, now, step, *id);
            pool.check_invariants().map_err(TestCaseError::fail)?;
            log.push(encode(&pool.take_records()));
            snapshots.push(pool.snapshot().encode());

            let cut = cut.index(snapshots.len());
            let mut again = restored(now, &snapshots[cut], &log[cut..]);
            again.check_invariants().map_err(TestCaseError::fail)?;
            prop_assert_eq!(again.snapshot(), pool.snapshot());
            prop_assert_eq!(without_bounds(&again), without_bounds(&pool));
            prop_assert_eq!(again.youngest_lease(), pool.youngest_lease());
            let known = again.changes_after(pool.revision()).unwrap();
            prop_assert!(known.is_empty() && again.take_notices().is_empty());

            let mut pool = pool.clone();
            let holds = pool.leases().iter().any(|lease| lease.expires.is_some());
            settle(&mut pool, now);
            settle(&mut again, now);
            for (step, id) in next.iter().filter(|(step, _)| !(holds && matches!(step, Step::Wait(_)))) {
                let later = if let Step::Wait(time) = step { now + time } else { now };
                let (answer, answer_again) = (perform(&mut pool, later, step, *id), perform(&mut again, later, step, *id));
                // What was withdrawn before it was heard of is not kept: it does not arrive after a restart.
                if answer.contains("Err(Withdrawn") != answer_again.contains("Err(Withdrawn") {
                    break;
                }
                // Waiters are numbered anew.
                if !answer.contains("Queued") && !answer.contains("waiter-") {
                    prop_assert_eq!(answer, answer_again);
                }
                prop_assert_eq!(pool.take_records(), again.take_records());
                prop_assert_eq!(pool.leases().len(), again.leases().len());
            }
        }
    }
}

#[test]
fn tokens_grow_over_a_restart_and_a_repeated_request_is_not_performed_again() {
    let mut pool = Pool::new(Limits::default());
    let (now, session) = (Timestamp(0), SessionId::from("a"));
    pool.keep_alive(now, &session, "a", Duration::from_secs(10)).unwrap();
    pool.create(now, None, ResourceSpec::new(ResourceClass::Module, "Arm").id("arm").capacity(2)).unwrap();
    let acquire =
        Request::Acquire(AcquireRequest::new(session.clone(), vec![requirement(ResourceOperation::Block, 0, 1)]));
    pool.handle(now, "q1", acquire.clone()).unwrap();
    let first = pool.leases().remove(0);
    let mut again = Pool::restore(Limits::default(), now, None, pool.take_records()).unwrap();
    let repeated = again.handle(now, "q1", acquire.clone()).unwrap();
    assert!(
        matches!(repeated, ratn_resources::Reply::Granted(lease) if lease.id == first.id && lease.token == first.token)
    );
    again.handle(now, "q2", acquire).unwrap();
    assert!(again.leases()[1].token > first.token);
    assert_eq!(again.sessions()[0].expires, Timestamp(0) + Duration::from_secs(10));
}

#[test]
fn revisions_that_have_leapt_stay_ahead_after_a_restart() {
    let tool = || ResourceSpec::new(ResourceClass::Module, "Tool");
    let mut pool = Pool::new(limits());
    pool.create(Timestamp(0), None, tool()).unwrap();
    let mut log = pool.take_records();
    let mut pool = pool.with_revisions_above(Revision(1_000));
    pool.create(Timestamp(0), None, tool()).unwrap();
    log.extend(pool.take_records());
    assert_eq!(pool.revision(), Revision(1_001));
    let again = Pool::restore(limits(), Timestamp(0), None, log).unwrap();
    assert_eq!(again.snapshot(), pool.snapshot());
    assert!(again.changes_after(Revision(1)).is_err(), "who watched before begins anew");
    assert_eq!(again.changes_after(Revision(1_000)).unwrap().len(), 1);
    let same = pool.clone().with_revisions_above(Revision(7));
    assert_eq!(same.revision(), pool.revision(), "it is behind");
}

#[test]
fn the_events_since_the_snapshot_are_known_again_after_a_restart() {
    let mut pool = Pool::new(Limits { history: 2, ..Limits::default() });
    for id in ["a", "b", "c"] {
        pool.create(Timestamp(0), None, ResourceSpec::new(ResourceClass::Module, "Arm").id(id)).unwrap();
    }
    let again = Pool::restore(Limits { history: 2, ..Limits::default() }, Timestamp(0), None, pool.take_records());
    let again = again.unwrap();
    for pool in [&pool, &again] {
        let revisions = |after| {
            let events = pool.changes_after(ratn_model::id::Revision(after));
            events.map(|events| events.iter().map(|event| event.revision.0).collect::<Vec<_>>())
        };
        assert_eq!(revisions(1), Ok(vec![2, 3]));
        assert_eq!(revisions(3), Ok(vec![]));
        assert_eq!(revisions(0).unwrap_err().oldest.0, 1);
        assert!(revisions(4).unwrap_err().to_string().contains("lies ahead"));
    }
}

#[test]
fn a_record_that_does_not_follow_is_refused_with_its_number() {
    let mut pool = Pool::new(Limits::default());
    for id in ["a", "b"] {
        pool.create(Timestamp(0), None, ResourceSpec::new(ResourceClass::Module, "Arm").id(id)).unwrap();
    }
    pool.delete(Timestamp(0), None, "a").unwrap();
    let mut records = pool.take_records();
    records.remove(0);
    let refused = Pool::restore(Limits::default(), Timestamp(0), None, records);
    assert!(matches!(refused, Err(RestoreError::Record { number: 1, .. })), "{:?}", refused.err());
}

#[test]
fn bytes_of_another_version_or_cut_short_are_refused() {
    let mut pool = Pool::new(Limits::default());
    pool.create(Timestamp(0), None, ResourceSpec::new(ResourceClass::Module, "Arm").id("a")).unwrap();
    let bytes = encode(&pool.take_records());
    assert_eq!(bytes[0], FORMAT);
    for end in 0..bytes.len() {
        assert!(matches!(decode(&bytes[..end]), Err(DecodeError::Broken { .. })));
    }
    assert!(matches!(decode(&[&bytes[..], &[0]].concat()), Err(DecodeError::Broken { .. })));
    let other = [&[FORMAT + 1], &bytes[1..]].concat();
    assert!(matches!(decode(&other), Err(DecodeError::Version { found, known: FORMAT, .. }) if found == FORMAT + 1));
}

/// A snapshot without the list of lives at its end, which versions up to 10 do not have.
fn without_lives(bytes: &[u8], lives: &[u8]) -> Vec<u8> {
    bytes.strip_suffix(lives).unwrap().to_vec()
}

#[test]
fn what_the_version_before_deleted_or_used_up_is_told_without_amounts() {
    let (now, id) = (Timestamp(0), SessionId::from("s"));
    let speaker = Speaker { name: "a".into(), for_anybody: false };
    // The answer `Touched` to a caller `a`, under the request id `r`, for a resource `x`.
    let records = decode(&[11, 1, 13, 1, b'a', 1, b'r', 0, 2, 1, 1, b'x', 0]).unwrap();
    let mut pool = Pool::restore(Limits::default(), now, None, records).unwrap();
    pool.keep_alive_as(now, &speaker, &id, "s", Duration::from_secs(10)).unwrap();
    let touched = ratn_resources::Reply::Touched(vec!["x".to_owned()]);
    assert_eq!(pool.recall(now, &speaker, &id, "r"), Ok(Some(touched.clone())));
    let requirement = requirement(ResourceOperation::Delete, 0, 1);
    let repeated = pool.handle_as(now, &speaker, "r", Request::DeleteUnits { session: id, requirement });
    assert_eq!(repeated, Ok(touched), "it is not done again");
}

#[test]
fn an_answer_that_the_version_before_remembers_is_given_to_every_life_of_its_session() {
    let (now, id) = (Timestamp(0), SessionId::from("s"));
    let speaker = Speaker { name: "a".into(), for_anybody: false };
    let open = |pool: &mut Pool| pool.keep_alive_as(now, &speaker, &id, "s", Duration::from_secs(10)).unwrap();
    let spec = ResourceSpec::new(ResourceClass::Module, "Arm");
    let create = || Request::Create { session: Some(id.clone()), spec: spec.clone() };
    let mut pool = Pool::new(Limits::default());
    open(&mut pool);
    let first = pool.handle_as(now, &speaker, "r1", create()).unwrap();
    let mut bytes = without_lives(&pool.snapshot().encode(), &[1, 1]);
    bytes[0] = 10;
    for (bytes, as_then) in [(bytes, true), (pool.snapshot().encode(), false)] {
        let kept = Snapshot::decode(&bytes).unwrap();
        let mut again = Pool::restore(Limits::default(), now, Some(kept), []).unwrap();
        again.close_session(now, &id).unwrap();
        open(&mut again);
        let answered = again.handle_as(now, &speaker, "r1", create()).unwrap();
        assert_eq!(answered == first, as_then, "{answered:?}");
        again.check_invariants().unwrap();
    }
}

#[test]
fn who_opened_a_session_is_known_from_records_and_from_a_snapshot_and_not_of_one_that_an_earlier_version_wrote() {
    let (now, id) = (Timestamp(0), SessionId::from("s"));
    let speaker = |name: &str, for_anybody| Speaker { name: name.into(), for_anybody };
    let mut pool = Pool::new(Limits::default());
    assert_eq!(pool.keep_alive_as(now, &speaker("a", false), &id, "s", Duration::from_secs(10)), Ok(true));
    pool.create(now, None, ResourceSpec::new(ResourceClass::Module, "Arm").id("arm")).unwrap();
    let acquire = AcquireRequest::new(id.clone(), vec![requirement(ResourceOperation::Block, 0, 1)]);
    pool.handle(now, "", Request::Acquire(acquire)).unwrap();
    let snapshot = pool.snapshot();
    let records = decode(&encode(&pool.take_records())).unwrap();
    let from_records = Pool::restore(Limits::default(), now, None, records).unwrap();
    let kept = Snapshot::decode(&snapshot.encode()).unwrap();
    let from_snapshot = Pool::restore(Limits::default(), now, Some(kept), []).unwrap();
    for mut again in [from_records, from_snapshot] {
        assert_eq!(&*again.sessions()[0].opened_by, "a");
        assert_eq!(&*again.get("arm").unwrap().holders.live().next().unwrap().opened_by, "a");
        let refused = again.keep_alive_as(now, &speaker("b", false), &id, "s", Duration::from_secs(10)).unwrap_err();
        assert_eq!(refused.to_string(), "session `s` belongs to a, not to b");
        assert_eq!(again.keep_alive_as(now, &speaker("root", true), &id, "s", Duration::from_secs(10)), Ok(false));
        assert_eq!(&*again.sessions()[0].opened_by, "a", "an operator speaks for it and does not own it");
    }
    // The snapshot of an earlier version has no openers: it ends where their list would begin. Three more lists follow that, all empty, and
    // the numbers of sessions.
    let bytes = without_lives(&snapshot.encode(), &[0]);
    let openers = [postcard_list(&[("s", "a")]), vec![0; 3], ONE_NUMBERED.to_vec()].concat();
    let mut earlier = bytes.strip_suffix(openers.as_slice()).unwrap().to_vec();
    earlier[0] = 2;
    let mut again = Pool::restore(Limits::default(), now, Some(Snapshot::decode(&earlier).unwrap()), []).unwrap();
    let refused = again.check_speaker(now, &speaker("a", false), &id).unwrap_err();
    assert!(refused.to_string().contains("only an operator may speak for it"), "{refused}");
    again.check_speaker(now, &speaker("root", true), &id).unwrap();
    // That of the version after it has no leases that end.
    let mut without_ending = bytes.strip_suffix(&[&[0; 3][..], &ONE_NUMBERED].concat()[..]).unwrap().to_vec();
    without_ending[0] = 4;
    let mut without_numbers = bytes.strip_suffix(&ONE_NUMBERED).unwrap().to_vec();
    without_numbers[0] = 6;
    assert_eq!(Snapshot::decode(&without_ending).unwrap(), Snapshot::decode(&without_numbers).unwrap());
    let newer = Snapshot::decode(&[&[FORMAT + 1], &bytes[1..]].concat());
    assert!(matches!(newer, Err(DecodeError::Version { found, .. }) if found == FORMAT + 1));
}

#[test]
fn answers_that_an_earlier_version_remembers_for_nobody_knows_whom_are_given_to_whoever_asks_the_same() {
    let (now, id) = (Timestamp(0), SessionId::from("s"));
    let speaker = |name: &str| Speaker { name: name.into(), for_anybody: false };
    let create = |kind: &str| Request::Create { session: None, spec: ResourceSpec::new(ResourceClass::Module, kind) };
    let mut pool = Pool::new(Limits::default());
    pool.keep_alive_as(now, &speaker("a"), &id, "s", Duration::from_secs(10)).unwrap();
    let first = pool.handle_as(now, &speaker("a"), "r1", create("Arm")).unwrap();
    let bytes = without_lives(&pool.snapshot().encode(), &[1, 0]);
    // It ends where the callers of the answers would follow, and the openers of leases that end, of which there are none.
    let mut earlier = bytes.strip_suffix(&[&[1, 1, b'a', 0][..], &ONE_NUMBERED].concat()[..]).unwrap().to_vec();
    earlier[0] = 5;
    let earlier = Snapshot::decode(&earlier).unwrap();
    let mut pool = Pool::restore(Limits::default(), now, Some(earlier), []).unwrap();
    for name in ["a", "b"] {
        assert_eq!(pool.handle_as(now, &speaker(name), "r1", create("Arm")).as_ref(), Ok(&first));
    }
    let other = pool.handle_as(now, &speaker("b"), "r1", create("Tool")).unwrap();
    assert!(matches!(other, ratn_resources::Reply::Created { id, .. } if id == "Tool-2"), "another request of b's own");
    pool.check_invariants().unwrap();
    // What was acquired then is withdrawn by its session, and by no other.
    let mut pool = Pool::new(Limits::default());
    pool.keep_alive_as(now, &speaker("a"), &id, "s", Duration::from_secs(10)).unwrap();
    pool.handle_as(now, &speaker("a"), "", create("Arm")).unwrap();
    let acquire = AcquireRequest::new(id.clone(), vec![requirement(ResourceOperation::Block, 0, 1)]);
    pool.handle_as(now, &speaker("a"), "q1", Request::Acquire(acquire)).unwrap();
    let bytes = without_lives(&pool.snapshot().encode(), &[1, 1]);
    let mut earlier = bytes.strip_suffix(&[&[1, 1, b'a', 0][..], &ONE_NUMBERED].concat()[..]).unwrap().to_vec();
    earlier[0] = 5;
    let earlier = Snapshot::decode(&earlier).unwrap();
    let mut pool = Pool::restore(Limits::default(), now, Some(earlier), []).unwrap();
    let other = SessionId::from("other");
    pool.keep_alive_as(now, &speaker("b"), &other, "o", Duration::from_secs(10)).unwrap();
    assert!(pool.withdraw(now, &other, "q1").is_err());
    assert_eq!((pool.withdraw(now, &id, "q1"), pool.leases().len()), (Ok(true), 0));
    pool.check_invariants().unwrap();
    // A record of before: `r1` was done, whatever it asked, and none was forgotten for it.
    let records = decode(&[5, 1, 9, 2, b'r', b'1', 0, 3, 0]).unwrap();
    let mut pool = Pool::restore(Limits::default(), now, None, records).unwrap();
    let again =
        pool.handle_as(now, &speaker("b"), "r1", Request::Release { session: None, lease: LeaseId(7), at_rest: true });
    assert_eq!(again, Ok(ratn_resources::Reply::Done));
}

/// The numbers of sessions in a snapshot, where one was opened, the last number given, and that no id is kept.
const ONE_NUMBERED: [u8; 4] = [1, 1, 1, 0];

#[test]
fn a_session_that_is_opened_anew_has_another_number_from_records_from_a_snapshot_and_where_everything_was_lost() {
    let (now, id) = (Timestamp(0), SessionId::from("s"));
    let ping = |pool: &mut Pool| pool.keep_alive(now, &id, "s", Duration::from_secs(10)).unwrap();
    let mut pool = Pool::new(Limits::default());
    assert_eq!(pool.session_number(&id), None);
    assert!(ping(&mut pool));
    let first = pool.session_number(&id).unwrap();
    assert!(!ping(&mut pool));
    assert_eq!(pool.session_number(&id), Some(first));
    pool.close_session(now, &id).unwrap();
    assert!(ping(&mut pool));
    let second = pool.session_number(&id).unwrap();
    assert!(second > first);
    let snapshot = Snapshot::decode(&pool.snapshot().encode()).unwrap();
    let records = decode(&encode(&pool.take_records())).unwrap();
    let from_records = Pool::restore(Limits::default(), now, None, records).unwrap();
    let from_snapshot = Pool::restore(Limits::default(), now, Some(snapshot), []).unwrap();
    let lost = Pool::new(Limits::default()).above(1_000_000);
    for (mut again, kept) in [(from_records, Some(second)), (from_snapshot, Some(second)), (lost, None)] {
        assert_eq!(again.session_number(&id), kept);
        if kept.is_some() {
            again.close_session(now, &id).unwrap();
        }
        assert!(ping(&mut again));
        assert!(again.session_number(&id).unwrap() > second);
        again.check_invariants().unwrap();
    }
}

#[test]
fn a_session_of_a_version_that_did_not_number_them_has_number_0_until_it_is_opened_anew() {
    let (now, id) = (Timestamp(0), SessionId::from("s"));
    // Opened by `a` for one second, as version 6 wrote it.
    let opened = decode(&[6, 1, 11, 1, b's', 1, b'c', 1, 0, 1, b'a']).unwrap();
    let mut pool = Pool::restore(Limits::default(), now, None, opened).unwrap().above(1_000);
    assert_eq!(pool.session_number(&id), Some(0));
    pool.keep_alive(now, &id, "c", Duration::from_secs(1)).unwrap();
    assert_eq!(pool.session_number(&id), Some(0), "a ping does not make it another one");
    pool.close_session(now, &id).unwrap();
    pool.keep_alive(now, &id, "c", Duration::from_secs(1)).unwrap();
    assert!(pool.session_number(&id).unwrap() > 0);
}

/// Pairs of short texts as they are kept.
fn postcard_list(pairs: &[(&str, &str)]) -> Vec<u8> {
    let mut bytes = vec![u8::try_from(pairs.len()).unwrap()];
    for text in pairs.iter().flat_map(|(one, other)| [one, other]) {
        bytes.push(u8::try_from(text.len()).unwrap());
        bytes.extend(text.as_bytes());
    }
    bytes
}

#[test]
fn records_of_the_version_before_openers_were_kept_are_read() {
    // A session `s` of the client `c` for one second, as version 2 wrote it.
    let entry = [2, 1, 0, 1, b's', 1, b'c', 1, 0];
    let records = decode(&entry).unwrap();
    let pool = Pool::restore(Limits::default(), Timestamp(0), None, records).unwrap();
    let session = pool.sessions().remove(0);
    assert_eq!((session.name.as_str(), session.ttl, &*session.opened_by), ("c", Duration::from_secs(1), ""));
    assert!(matches!(decode(&[1, 0]), Err(DecodeError::Version { found: 1, known: FORMAT, .. })));
}
