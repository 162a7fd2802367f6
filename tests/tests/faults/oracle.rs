//! The checkers themselves: histories that one pool may have had, those that it cannot, and steps that no provider may take.

use super::clients::{client_of, session};
use super::exclusion;
use super::history::{Amounts, Asked, Call, Done, Grant, History, NEVER, Shown, ToolHold};
use super::model::{Pool, STOCK};
use super::provider::{Step, TOOL};
use super::search::{Timed, Verdict, search};
use std::collections::BTreeMap;
use std::time::Duration;

const TTL: u64 = 100;
/// How long it may move after another one was granted the tool.
const BOUND: Duration = Duration::from_nanos(10);

/// The history of two clients whose sessions live from 0 on, with these calls of each: begin, end, answer.
fn history(calls: [Vec<(u64, u64, Done)>; 2]) -> History {
    let mut history = History { threads: vec![Vec::new(); 4], ..History::default() };
    for (number, calls) in calls.into_iter().enumerate() {
        let timed = |(begin, end, done)| Timed { begin, end, call: Call { session: number, done } };
        history.threads[2 * number] = calls.into_iter().map(timed).collect();
        history.threads[2 * number + 1] = vec![timed((0, 1, Done::Pinged { ttl: TTL, created: true }))];
    }
    history
}

fn is_explained(history: &History) -> bool {
    matches!(search(&history.threads, Pool::new(history, client_of), 100_000), Verdict::Explained { .. })
}

fn granted(token: u64, held: &[(&str, u64)]) -> Done {
    Done::Granted { request: format!("request-{token}"), token, held: amounts(held) }
}

fn amounts(held: &[(&str, u64)]) -> Amounts {
    held.iter().map(|(id, amount)| ((*id).to_owned(), *amount)).collect()
}

fn released(token: u64, released: bool) -> Done {
    Done::Released { token, released }
}

/// What a list shows where only this is held: resource, token, amount.
fn seen(held: &[(&str, u64, u64)]) -> Done {
    let mut pool: BTreeMap<String, Shown> =
        STOCK.iter().map(|(id, free)| ((*id).to_owned(), Shown { free: *free, held: BTreeMap::new() })).collect();
    for (id, token, amount) in held {
        let shown = pool.get_mut(*id).unwrap();
        shown.free -= amount;
        shown.held.insert(*token, *amount);
    }
    Done::Seen { pool }
}

/// With a grant that no answer told of.
fn with_unheard(mut history: History, token: u64, held: &[(&str, u64)], begin: u64, until: u64) -> History {
    let request = format!("request-{token}");
    history.asked.insert(request.clone(), Asked { session: 0, begin, until });
    history.grants.insert(token, Grant { session: session(0), request, lease: token, held: amounts(held) });
    history
}

#[test]
fn what_one_pool_can_have_done_is_explained() {
    let (one, other) = (granted(1, &[("a-0", 1_000)]), granted(2, &[("a-0", 1_000)]));
    // The second is granted between the begin and the end of the release.
    assert!(is_explained(&history([
        vec![(2, 3, one.clone()), (4, 20, released(1, true))],
        vec![(5, 6, other.clone()), (7, 8, seen(&[("a-0", 2, 1_000)]))],
    ])));
    // The session of the first may have expired by then.
    assert!(is_explained(&history([
        vec![(2, 3, one.clone()), (140, 150, released(1, false))],
        vec![(4, 110, other), (120, 121, seen(&[("a-0", 2, 1_000)]))],
    ])));
    // A grant that was not heard of was there, and was taken back.
    let looks = vec![(5, 6, seen(&[("b", 7, 3_000)])), (9, 10, seen(&[]))];
    assert!(is_explained(&with_unheard(history([vec![], looks]), 7, &[("b", 3_000)], 2, NEVER)));
}

#[test]
fn what_one_pool_cannot_have_done_is_not_explained() {
    let one = granted(1, &[("a-0", 1_000)]);
    let other = granted(2, &[("a-0", 1_000)]);
    let looks = |at, held: &[_]| vec![(at, at + 1, seen(held))];
    let impossible = [
        // A unit twice, before the session of the first can have expired.
        history([vec![(2, 3, one.clone())], vec![(4, 90, other.clone())]]),
        // Granted before the release that made room began.
        history([vec![(2, 3, one.clone()), (9, 10, released(1, true))], vec![(4, 5, other.clone())]]),
        // A token that goes back.
        history([vec![(2, 3, granted(2, &[("b", 1_000)]))], vec![(4, 5, granted(1, &[("a-1", 1_000)]))]]),
        // A lease that its holder was told of, and that is taken back.
        history([vec![(2, 3, one.clone())], looks(5, &[])]),
        history([vec![(2, 3, one.clone()), (5, 6, released(1, false))], vec![]]),
        // Released twice.
        history([vec![(2, 3, one.clone()), (4, 5, released(1, true)), (6, 7, released(1, true))], vec![]]),
        // Half of what was acquired together.
        history([vec![(2, 9, granted(1, &[("a-0", 1_000), ("b", 2_000)]))], looks(4, &[("b", 1, 2_000)])]),
        // What was deleted is there, what was never made is deleted.
        history([vec![(2, 3, Done::Deleted { resource: "m".to_owned(), there: true })], vec![]]),
        // Consumed, and there again.
        history([vec![(2, 3, Done::Consumed { amount: 5 })], looks(6, &[])]),
        // A grant that nobody had asked for yet, or any more.
        with_unheard(history([vec![], looks(4, &[("b", 7, 3_000)])]), 7, &[("b", 3_000)], 6, NEVER),
        with_unheard(
            history([vec![], vec![(5, 6, seen(&[])), (9, 10, seen(&[("b", 7, 3_000)]))]]),
            7,
            &[("b", 3_000)],
            2,
            3,
        ),
    ];
    for history in &impossible {
        assert!(!is_explained(history), "{history:#?}");
    }
    // The session is opened anew although it cannot have expired.
    let mut early = history([vec![], vec![]]);
    early.threads[1].push(Timed {
        begin: 50,
        end: 60,
        call: Call { session: 0, done: Done::Pinged { ttl: TTL, created: true } },
    });
    assert!(!is_explained(&early));
}

fn step(token: u64, at: u64) -> Step {
    Step { goal: format!("{}/goal", session(token as usize % 2)), lease: token, token, at }
}

/// Two clients that were granted the tool one after the other; the even token is that of client 0.
fn with_tool() -> History {
    let mut history = history([vec![], vec![]]);
    for (token, granted, released) in [(2, 10, 30), (3, 40, 60)] {
        let holder = token as usize % 2;
        let held = amounts(&[(TOOL, 1_000)]);
        let grant = Grant { session: session(holder), request: "request".to_owned(), lease: token, held };
        history.grants.insert(token, grant);
        history.holds.push(ToolHold { session: holder, token, granted, released });
    }
    history
}

#[test]
fn steps_that_no_provider_may_take_are_found() {
    let wrong = |steps: &[Step], history: &History| exclusion::check(steps, history, BOUND).0;
    let good = [step(2, 12), step(2, 25), step(3, 41), step(3, 50)];
    assert_eq!(wrong(&good, &with_tool()), Vec::<String>::new());
    // Back to the first holder; two that move at the same time; a token that was never granted; another client's.
    assert!(!wrong(&[step(2, 12), step(3, 41), step(2, 42)], &with_tool()).is_empty());
    assert!(!wrong(&[step(2, 12), step(2, 45), step(3, 41)], &with_tool()).is_empty());
    assert!(!wrong(&[step(2, 12), step(9, 20)], &with_tool()).is_empty());
    assert!(!wrong(&[Step { goal: "client-1/goal".to_owned(), ..step(2, 12) }], &with_tool()).is_empty());
    // It goes on for a while after the next one was told, and nobody else moves yet.
    let late = |at| exclusion::check(&[step(2, 12), step(2, at)], &with_tool(), BOUND);
    let (none, measured) = late(45);
    assert_eq!((none.len(), measured.latest.as_nanos()), (0, 5));
    assert_eq!((late(50).0.len(), late(51).0.len()), (0, 1));
}

#[test]
fn a_grant_of_what_still_moves_is_found_unless_its_holder_gave_it_back() {
    let mut history = with_tool();
    let late = [step(2, 12), step(2, 45)];
    assert_eq!(exclusion::check(&late, &history, BOUND).0, Vec::<String>::new());
    // Its session may have expired, so that nothing else is wrong.
    (history.holds[0].released, history.holds[1].granted) = (NEVER, 3 * TTL);
    assert_eq!(exclusion::check(&late, &history, BOUND).0, Vec::<String>::new());
    assert_eq!(exclusion::check(&[step(2, 12), step(2, 3 * TTL + 1)], &history, BOUND).0.len(), 1);
}

#[test]
fn two_that_were_both_told_that_they_hold_the_tool_are_found() {
    let mut history = with_tool();
    history.holds[0].released = NEVER;
    assert!(!exclusion::check(&[], &history, BOUND).0.is_empty());
    // Its session may have expired by then.
    history.holds[1].granted = 3 * TTL;
    assert_eq!(exclusion::check(&[], &history, BOUND).0, Vec::<String>::new());
}
