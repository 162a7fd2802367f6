//! Ids of sessions that have ended: kept for who opened them, within bounds that nobody can use up for another.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::time::Timestamp;
use ratn_resources::{Limits, Pool, PoolError, Request, SessionId, Snapshot, Speaker, decode, encode};
use std::time::Duration;

const TTL: Duration = Duration::from_secs(3);

fn at(ms: u64) -> Timestamp {
    Timestamp(ms * 1_000_000)
}

fn speaker(name: &str) -> Speaker {
    Speaker { name: name.into(), for_anybody: false }
}

fn ping(pool: &mut Pool, ms: u64, who: &str, id: &str) -> Result<bool, String> {
    let pinged = pool.keep_alive_as(at(ms), &speaker(who), &SessionId::from(id), who, TTL);
    pool.check_invariants().unwrap();
    pinged.map_err(|error| error.to_string())
}

fn opens_and_closes(pool: &mut Pool, ms: u64, who: &str, id: &str) {
    assert_eq!(ping(pool, ms, who, id), Ok(true));
    pool.close_session(at(ms), &SessionId::from(id)).unwrap();
}

/// The same pool as its records and its snapshot say that it is.
fn restored(pool: &mut Pool, limits: &Limits, ms: u64) -> [Pool; 2] {
    let snapshot = Snapshot::decode(&pool.snapshot().encode()).unwrap();
    let records = decode(&encode(&pool.take_records())).unwrap();
    let restore = |snapshot, records| Pool::restore(limits.clone(), at(ms), snapshot, records).unwrap();
    [restore(None, records), restore(Some(snapshot), Vec::new())]
}

#[test]
fn the_id_of_a_session_that_has_ended_is_nobody_elses_also_after_a_restart() {
    for closes in [true, false] {
        let mut pool = Pool::new(Limits::default());
        assert_eq!(ping(&mut pool, 0, "cell", "id"), Ok(true));
        if closes {
            pool.close_session(at(1), &SessionId::from("id")).unwrap();
        }
        pool.advance(at(4_000));
        assert!(!pool.has_session(&SessionId::from("id")));
        let again = restored(&mut pool, &Limits::default(), 4_000);
        for mut pool in again.into_iter().chain([pool]) {
            let refused = "session `id` has ended, and its id is kept for cell, who opened it: eve has to open a session with another id";
            assert_eq!(ping(&mut pool, 4_000, "eve", "id"), Err(refused.to_owned()));
            let end = Request::EndTask { session: SessionId::from("id") };
            let spoken = pool.check_speaker(at(4_000), &speaker("eve"), end.session().unwrap());
            assert!(matches!(spoken, Err(PoolError::SessionIdKept { .. })), "nor does anybody else speak for it");
            assert_eq!(ping(&mut pool, 4_000, "cell", "id"), Ok(true));
            assert_eq!(ping(&mut pool, 4_000, "eve", "another"), Ok(true));
        }
    }
}

#[test]
fn an_operator_may_open_it() {
    let mut pool = Pool::new(Limits::default());
    opens_and_closes(&mut pool, 0, "cell", "id");
    let operator = Speaker { name: "root".into(), for_anybody: true };
    assert_eq!(pool.keep_alive_as(at(1), &operator, &SessionId::from("id"), "root", TTL), Ok(true));
    pool.check_invariants().unwrap();
}

#[test]
fn an_id_is_kept_for_a_time_and_then_is_anybodys() {
    let limits = Limits { keep_session_ids_for_ms: 1_000, ..Limits::default() };
    let mut pool = Pool::new(limits.clone());
    opens_and_closes(&mut pool, 0, "cell", "id");
    assert!(ping(&mut pool.clone(), 999, "eve", "id").is_err());
    for mut again in restored(&mut pool, &limits, 500) {
        assert!(ping(&mut again, 1_499, "eve", "id").is_err(), "after a restart the time begins anew");
        assert_eq!(ping(&mut again, 1_500, "eve", "id"), Ok(true));
    }
    assert_eq!(ping(&mut pool, 1_000, "eve", "id"), Ok(true));
}

#[test]
fn whoever_opens_many_sessions_makes_the_manager_give_up_no_id_of_a_caller_with_fewer() {
    let limits = Limits { kept_session_ids: 10, kept_session_ids_per_caller: 8, ..Limits::default() };
    let mut pool = Pool::new(limits.clone());
    opens_and_closes(&mut pool, 0, "cell", "id");
    for who in ["eve", "mallory", "trudy"] {
        (0..30).for_each(|n| opens_and_closes(&mut pool, 1, who, &format!("{who}-{n}")));
    }
    for mut pool in restored(&mut pool, &limits, 2).into_iter().chain([pool]) {
        assert!(ping(&mut pool, 2, "eve", "id").is_err());
        assert_eq!(ping(&mut pool, 2, "trudy", "eve-0"), Ok(true), "the oldest of those who have many go first");
        assert!(ping(&mut pool, 2, "eve", "trudy-29").is_err());
    }
}

#[test]
fn a_session_of_nobody_knows_whom_leaves_its_id_to_anybody() {
    let mut pool = Pool::new(Limits::default());
    pool.keep_alive(at(0), &SessionId::from("id"), "somebody", TTL).unwrap();
    pool.close_session(at(0), &SessionId::from("id")).unwrap();
    assert_eq!(ping(&mut pool, 0, "eve", "id"), Ok(true));
}
