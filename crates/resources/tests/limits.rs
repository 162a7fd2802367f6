//! Every bound of [`Limits`], at its edge and one past it.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_model::condition::{Comparison, Condition};
use ratn_model::id::Revision;
use ratn_model::resource::{Quantity, Requirement, ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_resources::{AcquireRequest, Limits, Pool, Reply, Request, ResourceSpec, SessionId, Speaker};
use std::time::Duration;

const NOW: Timestamp = Timestamp(0);
const TTL: Duration = Duration::from_secs(1_000);
/// What each bound is set to, beside what is there already.
const EDGE: usize = 3;

fn session() -> SessionId {
    SessionId::from("s")
}

fn adam() -> Speaker {
    Speaker { name: "adam".into(), for_anybody: false }
}

fn block(kind: &str, count: usize) -> Requirement {
    let count = Quantity::whole(u32::try_from(count).unwrap());
    Requirement { count, ..Requirement::new(ResourceOperation::Block, kind) }
}

fn acquire(pool: &mut Pool, session: &str, requirements: Vec<Requirement>) -> Result<(), String> {
    let request = AcquireRequest::new(SessionId::from(session), requirements);
    pool.acquire(NOW, request).map(drop).map_err(|error| error.to_string())
}

/// Acquires one more of something of which there is enough; whoever has to wait for it all the same was stopped by a bound.
fn one_more_lease(pool: &mut Pool) -> Result<(), String> {
    let before = pool.leases().len();
    acquire(pool, "s", vec![block("Tool", 1)])?;
    if pool.leases().len() > before { Ok(()) } else { Err("waits".to_owned()) }
}

fn create(pool: &mut Pool, spec: ResourceSpec) -> Result<(), String> {
    pool.create(NOW, None, spec).map(drop).map_err(|error| error.to_string())
}

fn tool() -> ResourceSpec {
    ResourceSpec::new(ResourceClass::Module, "Tool").capacity(100)
}

fn open(pool: &mut Pool, speaker: &Speaker, name: &str) -> Result<(), String> {
    let opened = pool.keep_alive_as(NOW, speaker, &SessionId::from(name), "test", TTL);
    opened.map(drop).map_err(|error| error.to_string())
}

/// As adam, who has a session.
fn adam_acquires(pool: &mut Pool, requirement: Requirement) -> Result<(), String> {
    open(pool, &adam(), "adam")?;
    let (leases, waiting) = (pool.leases().len(), pool.waiting());
    let kind = requirement.kind.clone();
    acquire(pool, "adam", vec![requirement])?;
    let waits = kind == "Tool" && pool.waiting() > waiting && pool.leases().len() == leases;
    if waits { Err("waits".to_owned()) } else { Ok(()) }
}

fn adam_creates(pool: &mut Pool) -> Result<(), String> {
    open(pool, &adam(), "adam")?;
    let created = pool.create(NOW, Some(&SessionId::from("adam")), tool());
    created.map(drop).map_err(|error| error.to_string())
}

fn with_attributes(count: usize) -> ResourceSpec {
    (0..count).fold(tool(), |spec, number| spec.attribute(format!("a{number}"), Value::Int(0)))
}

/// Asks something new, then what was asked first.
fn still_remembers_the_first(pool: &mut Pool, n: usize) -> Result<(), String> {
    let ask = |pool: &mut Pool, n: usize| {
        let create = Request::Create { session: None, spec: tool() };
        pool.handle(NOW, &format!("r{n}"), create).unwrap()
    };
    let id = |reply| if let Reply::Created { id, .. } = reply { id } else { String::new() };
    ask(pool, n);
    // The first is number 2: there is a tool.
    if id(ask(pool, 1)) == "Tool-2" { Ok(()) } else { Err("performed twice".to_owned()) }
}

/// Adam opens a session and closes it, the nth; the id of his first one is still kept for him.
fn keeps_the_first_of_adam(pool: &mut Pool, now: Timestamp, n: usize) -> Result<(), String> {
    let id = SessionId::from(format!("k{n}").as_str());
    pool.keep_alive_as(now, &adam(), &id, "test", TTL).unwrap();
    pool.close_session(now, &id).unwrap();
    let eve = Speaker { name: "eve".into(), for_anybody: false };
    let refused = pool.clone().keep_alive_as(now, &eve, &SessionId::from("k1"), "test", TTL);
    refused.map_or(Ok(()), |_| Err("session k1 is opened by another".to_owned()))
}

/// Does something for the nth time.
type Act = fn(&mut Pool, usize) -> Result<(), String>;

/// A bound, what comes up to it, and how what is beyond it is refused. There is a session, and a tool of 100 units.
fn rows() -> Vec<(&'static str, Limits, Act, &'static str)> {
    let all = Limits::default;
    vec![
        (
            "resources",
            Limits { resources: EDGE + 1, ..all() },
            |pool, _| create(pool, tool()),
            "resources of all callers: the limit of 4 is reached (limits.resources)",
        ),
        (
            "sessions",
            Limits { sessions: EDGE + 1, ..all() },
            |pool, n| open(pool, &Speaker::trusted(), &format!("s{n}")),
            "sessions of all callers: the limit of 4 is reached (limits.sessions)",
        ),
        (
            "sessions_per_caller",
            Limits { sessions_per_caller: EDGE, ..all() },
            |pool, n| open(pool, &adam(), &format!("s{n}")),
            "sessions of adam: the quota of 3 is reached (limits.sessions_per_caller)",
        ),
        (
            "sessions_for_operators",
            Limits { sessions: EDGE + 2, sessions_for_operators: 1, ..all() },
            |pool, n| open(pool, &adam(), &format!("s{n}")),
            "sessions of all who are no operators: the limit of 4 is reached (limits.sessions_for_operators)",
        ),
        (
            "kept_session_ids",
            Limits { kept_session_ids: EDGE, ..all() },
            |pool, n| keeps_the_first_of_adam(pool, NOW, n),
            "session k1 is opened by another",
        ),
        (
            "kept_session_ids_per_caller",
            Limits { kept_session_ids_per_caller: EDGE, ..all() },
            |pool, n| keeps_the_first_of_adam(pool, NOW, n),
            "session k1 is opened by another",
        ),
        (
            "keep_session_ids_for_ms",
            Limits { keep_session_ids_for_ms: EDGE as u64, ..all() },
            |pool, n| keeps_the_first_of_adam(pool, Timestamp((n as u64 - 1) * 1_000_000), n),
            "session k1 is opened by another",
        ),
        (
            "waiters",
            Limits { waiters: EDGE, ..all() },
            |pool, _| acquire(pool, "s", vec![block("Nothing", 1)]),
            "waiters of all callers: the limit of 3 is reached (limits.waiters)",
        ),
        (
            "waiters_per_session",
            Limits { waiters_per_session: EDGE, ..all() },
            |pool, _| acquire(pool, "s", vec![block("Nothing", 1)]),
            "waiters of one session: the limit of 3 is reached (limits.waiters_per_session)",
        ),
        (
            "waiters_per_caller",
            Limits { waiters_per_caller: EDGE, ..all() },
            |pool, n| {
                open(pool, &adam(), &format!("s{n}"))?;
                acquire(pool, &format!("s{n}"), vec![block("Nothing", 1)])
            },
            "waiters of adam: the quota of 3 is reached (limits.waiters_per_caller)",
        ),
        (
            "selectors",
            Limits { selectors: EDGE, ..all() },
            |pool, n| acquire(pool, "s", vec![block(&format!("Nothing{n}"), 1)]),
            "different selectors waited for of all callers: the limit of 3 is reached (limits.selectors)",
        ),
        ("leases", Limits { leases: EDGE, ..all() }, |pool, _| one_more_lease(pool), "waits"),
        (
            "leases_per_caller",
            Limits { leases_per_caller: EDGE, ..all() },
            |pool, _| adam_acquires(pool, block("Tool", 1)),
            "leases of adam: the quota of 3 is reached (limits.leases_per_caller)",
        ),
        (
            "leases_per_caller",
            Limits { leases_per_caller: EDGE, ..all() },
            |pool, _| adam_acquires(pool, block("Nothing", 1)),
            "leases of adam: the quota of 3 is reached (limits.leases_per_caller)",
        ),
        (
            "leases_for_operators",
            Limits { leases: EDGE + 1, leases_for_operators: 1, ..all() },
            |pool, _| adam_acquires(pool, block("Tool", 1)),
            "waits",
        ),
        (
            "resources_per_caller",
            Limits { resources_per_caller: EDGE, ..all() },
            |pool, _| adam_creates(pool),
            "resources of adam: the quota of 3 is reached (limits.resources_per_caller)",
        ),
        (
            "resources_for_operators",
            Limits { resources: EDGE + 2, resources_for_operators: 1, ..all() },
            |pool, _| adam_creates(pool),
            "resources of all who are no operators: the limit of 4 is reached (limits.resources_for_operators)",
        ),
        (
            "waiters_for_operators",
            Limits { waiters: EDGE + 1, waiters_for_operators: 1, ..all() },
            |pool, _| adam_acquires(pool, block("Nothing", 1)),
            "waiters of all who are no operators: the limit of 3 is reached (limits.waiters_for_operators)",
        ),
        (
            "selectors_per_caller",
            Limits { selectors_per_caller: EDGE, ..all() },
            |pool, n| {
                // What another waits for counts for adam too.
                acquire(pool, "s", vec![block(&format!("Nothing{n}"), 1)])?;
                adam_acquires(pool, block(&format!("Nothing{n}"), 1))
            },
            "different selectors waited for of adam: the quota of 3 is reached (limits.selectors_per_caller)",
        ),
        (
            "selectors_for_operators",
            Limits { selectors: EDGE + 1, selectors_for_operators: 1, ..all() },
            |pool, n| adam_acquires(pool, block(&format!("Nothing{n}"), 1)),
            "different selectors waited for of all who are no operators: the limit of 3 is reached (limits.selectors_for_operators)",
        ),
        ("holders", Limits { holders: EDGE, ..all() }, |pool, _| one_more_lease(pool), "waits"),
        (
            "requirements",
            Limits { requirements: EDGE, ..all() },
            |pool, n| acquire(pool, "s", vec![block("Tool", 1); n]),
            "4 requirements: at most 3",
        ),
        (
            "units",
            Limits { units: u32::try_from(EDGE).unwrap(), ..all() },
            |pool, n| acquire(pool, "s", vec![block("Tool", n)]),
            "at most 3 units",
        ),
        (
            "units_per_request",
            Limits { units_per_request: u32::try_from(EDGE).unwrap(), ..all() },
            |pool, n| acquire(pool, "s", vec![block("Tool", 1); n]),
            "4 units: at most 3 in one request",
        ),
        (
            "comparisons",
            Limits { comparisons: EDGE, ..all() },
            |pool, n| {
                let has = |number| Condition {
                    attribute: format!("a{number}"),
                    comparison: Comparison::Has,
                    value: Value::Null,
                };
                let requirement = Requirement { conditions: (0..n).map(has).collect(), ..block("Tool", 1) };
                acquire(pool, "s", vec![requirement])
            },
            "4 comparisons of attributes with resources: at most 3",
        ),
        (
            "name_length",
            Limits { name_length: EDGE + 1, ..all() },
            |pool, n| create(pool, ResourceSpec::new(ResourceClass::Module, "K".repeat(n + 1))),
            "1 to 4 characters",
        ),
        (
            "attributes",
            Limits { attributes: EDGE, ..all() },
            |pool, n| create(pool, with_attributes(n)),
            "4 attributes: at most 3",
        ),
        (
            "remembered_requests",
            Limits { remembered_requests: EDGE, ..all() },
            still_remembers_the_first,
            "performed twice",
        ),
        (
            "remembered_per_caller",
            Limits { remembered_per_caller: EDGE, ..all() },
            still_remembers_the_first,
            "performed twice",
        ),
        (
            "remembered_bytes_per_caller",
            // An answer has 256 bytes, its request id twice and the id of the tool.
            Limits { remembered_bytes_per_caller: EDGE * (256 + 2 * 2 + 6), ..all() },
            still_remembers_the_first,
            "performed twice",
        ),
        (
            "remember_for_ms",
            Limits { remember_for_ms: EDGE as u64, ..all() },
            |pool, n| {
                let create = || Request::Create { session: None, spec: tool() };
                let at = |ms: u64| Timestamp(ms * 1_000_000);
                let first = pool.handle(at(0), "first", create()).unwrap();
                pool.handle(at(n as u64 - 1), &format!("r{n}"), create()).unwrap();
                let again = pool.handle(at(n as u64 - 1), "first", create()).unwrap();
                if again == first { Ok(()) } else { Err("performed twice".to_owned()) }
            },
            "performed twice",
        ),
        (
            "history",
            Limits { history: EDGE + 1, ..all() },
            |pool, _| {
                create(pool, tool())?;
                pool.changes_after(Revision(0)).map(drop).map_err(|error| error.to_string())
            },
            "",
        ),
    ]
}

#[test]
fn every_bound_at_its_edge_and_one_past_it() {
    // A new bound belongs into the table (those of bytes are below, `overtaken` is measured by `against_model.rs`, `share_per_caller` by
    // `turns.rs`).
    let Limits {
        resources: _,
        resources_per_caller: _,
        resources_for_operators: _,
        sessions: _,
        sessions_per_caller: _,
        sessions_for_operators: _,
        share_per_caller: _,
        kept_session_ids: _,
        kept_session_ids_per_caller: _,
        keep_session_ids_for_ms: _,
        waiters: _,
        waiters_per_caller: _,
        waiters_for_operators: _,
        waiters_per_session: _,
        selectors: _,
        selectors_per_caller: _,
        selectors_for_operators: _,
        overtaken: _,
        leases: _,
        leases_per_caller: _,
        leases_for_operators: _,
        requirements: _,
        units: _,
        units_per_request: _,
        comparisons: _,
        name_length: _,
        attributes: _,
        resource_bytes: _,
        requirement_bytes: _,
        holders: _,
        remembered_requests: _,
        remembered_per_caller: _,
        remembered_bytes_per_caller: _,
        remember_for_ms: _,
        history: _,
    } = Limits::default();
    for (bound, limits, act, says) in rows() {
        let mut pool = Pool::new(Limits { name_length: limits.name_length.max(4), ..limits });
        pool.keep_alive(NOW, &session(), "test", TTL).unwrap();
        create(&mut pool, tool()).unwrap();
        for n in 1..=EDGE {
            act(&mut pool, n).unwrap_or_else(|error| panic!("{bound}: {n} of {EDGE} is refused: {error}"));
        }
        let refused = act(&mut pool, EDGE + 1).expect_err(bound);
        assert!(refused.contains(says), "{bound}: {refused}");
        pool.check_invariants().unwrap_or_else(|error| panic!("{bound}: {error}"));
    }
}

#[test]
fn what_is_kept_for_operators_is_theirs() {
    let mut pool = Pool::new(Limits { sessions: 2, sessions_for_operators: 1, ..Limits::default() });
    open(&mut pool, &adam(), "a").unwrap();
    open(&mut pool, &adam(), "b").unwrap_err();
    let operator = Speaker { name: "root".into(), for_anybody: true };
    open(&mut pool, &operator, "b").unwrap();
}

#[test]
fn a_crowded_resource_has_room_again_when_a_lease_of_it_ends() {
    let mut pool = Pool::new(Limits { holders: 1, ..Limits::default() });
    pool.keep_alive(NOW, &session(), "test", TTL).unwrap();
    create(&mut pool, tool()).unwrap();
    one_more_lease(&mut pool).unwrap();
    one_more_lease(&mut pool).unwrap_err();
    let first = pool.leases()[0].id;
    pool.release(NOW, None, first).unwrap();
    assert_eq!((pool.leases().len(), pool.waiting()), (1, 0));
    pool.check_invariants().unwrap();
}

#[test]
fn who_waits_for_room_in_a_crowded_resource_is_served_when_a_wider_bound_makes_some() {
    for overtaken in [0, 2] {
        let limits = |holders| Limits { holders, overtaken, ..Limits::default() };
        let mut pool = Pool::new(limits(1));
        pool.keep_alive(NOW, &session(), "test", TTL).unwrap();
        create(&mut pool, tool()).unwrap();
        one_more_lease(&mut pool).unwrap();
        one_more_lease(&mut pool).unwrap_err();
        assert_eq!((pool.leases().len(), pool.waiting()), (1, 1));
        // As at SIGHUP.
        pool.set_limits(limits(2));
        pool.advance(NOW);
        assert_eq!((pool.leases().len(), pool.waiting()), (2, 0));
        pool.check_invariants().unwrap();
    }
}

/// The largest text that is accepted, and the refusal of one letter more.
fn largest(mut act: impl FnMut(String) -> Result<(), String>) -> String {
    (1..1_000).find_map(|bytes| act("x".repeat(bytes)).err()).expect("some are too large")
}

#[test]
fn resources_and_requirements_have_bounds_in_bytes() {
    let mut pool = Pool::new(Limits { resource_bytes: 200, requirement_bytes: 300, ..Limits::default() });
    pool.keep_alive(NOW, &session(), "test", TTL).unwrap();
    let refused = largest(|text| create(&mut pool, tool().id("t").attribute("map", Value::String(text))));
    assert_eq!(refused, "resource `t`: 201 bytes: at most 200 in a resource with its attributes");
    let refused = largest(|text| {
        let attributes = [("map".to_owned(), Value::String(text))].into();
        acquire(&mut pool, "s", vec![Requirement { attributes, ..block("Tool", 1) }])
    });
    assert_eq!(refused, "block Tool: 301 bytes: at most 300 in a requirement");
    let endpoint = |bytes: usize| tool().attribute("endpoint", Value::String("x".repeat(bytes)));
    let mut pool = Pool::new(Limits::default());
    create(&mut pool, endpoint(1_024)).unwrap();
    let refused = create(&mut pool, endpoint(1_025)).unwrap_err();
    assert!(refused.contains("1025 bytes of `endpoint`: at most 1024"), "{refused}");
}

#[test]
fn two_callers_cannot_take_all_and_operators_have_room_left() {
    let limits = Limits::default();
    let bounds = [
        (limits.resources, limits.resources_per_caller, limits.resources_for_operators),
        (limits.sessions, limits.sessions_per_caller, limits.sessions_for_operators),
        (limits.waiters, limits.waiters_per_caller, limits.waiters_for_operators),
        (limits.selectors, limits.selectors_per_caller, limits.selectors_for_operators),
        (limits.leases, limits.leases_per_caller, limits.leases_for_operators),
    ];
    for (in_all, per_caller, for_operators) in bounds {
        assert!(2 * per_caller < in_all - for_operators && for_operators > 0, "{in_all} {per_caller} {for_operators}");
    }
}

#[test]
fn an_operator_is_granted_a_lease_past_those_who_wait_for_the_share_of_all() {
    let mut pool = Pool::new(Limits { leases: 2, leases_for_operators: 1, ..Limits::default() });
    create(&mut pool, tool()).unwrap();
    adam_acquires(&mut pool, block("Tool", 1)).unwrap();
    adam_acquires(&mut pool, block("Tool", 1)).unwrap_err();
    let root = Speaker { name: "root".into(), for_anybody: true };
    open(&mut pool, &root, "root").unwrap();
    acquire(&mut pool, "root", vec![block("Tool", 1)]).unwrap();
    assert_eq!((pool.leases().len(), pool.waiting()), (2, 1));
    let of_adam = pool.leases()[0].id;
    pool.release(NOW, None, of_adam).unwrap();
    assert_eq!((pool.leases().len(), pool.waiting()), (1, 1), "root's lease is in the share of all");
    let of_root = pool.leases()[0].id;
    pool.release(NOW, None, of_root).unwrap();
    assert_eq!((pool.leases().len(), pool.waiting()), (1, 0));
    pool.check_invariants().unwrap();
}

#[test]
fn a_bound_on_leases_that_is_lowered_holds_from_then_on() {
    let mut pool = Pool::new(Limits::default());
    create(&mut pool, tool()).unwrap();
    (0..3).for_each(|_| adam_acquires(&mut pool, block("Tool", 1)).unwrap());
    pool.set_limits(Limits { leases: 4, ..Limits::default() });
    adam_acquires(&mut pool, block("Tool", 1)).unwrap_err();
    assert_eq!(pool.leases().len(), 3, "half of 4 is kept for operators, and what is there stays");
    pool.check_invariants().unwrap();
}

/// Lowers every bound below what is there, as SIGHUP may: what is there stays, what is new is refused, and what ends makes no room
/// before there is less than the bound.
#[test]
fn a_bound_that_is_lowered_below_what_is_there_takes_nothing_and_admits_nothing_more() {
    let mut pool = Pool::new(Limits::default());
    open(&mut pool, &adam(), "adam").unwrap();
    open(&mut pool, &adam(), "s").unwrap();
    create(&mut pool, tool()).unwrap();
    pool.create(NOW, Some(&SessionId::from("adam")), tool().id("own")).unwrap();
    for _ in 0..4 {
        acquire(&mut pool, "s", vec![block("Tool", 1)]).unwrap();
        acquire(&mut pool, "adam", vec![block("Nothing", 1)]).unwrap();
    }
    let leases = pool.leases();
    let before = pool.amounts();
    for bound in 0..2 {
        let limits = Limits {
            resources: bound,
            resources_per_caller: bound,
            resources_for_operators: bound,
            sessions: bound,
            sessions_per_caller: bound,
            sessions_for_operators: bound,
            kept_session_ids: bound,
            kept_session_ids_per_caller: bound,
            waiters: bound,
            waiters_per_caller: bound,
            waiters_for_operators: bound,
            waiters_per_session: bound,
            selectors: bound,
            selectors_per_caller: bound,
            selectors_for_operators: bound,
            leases: bound,
            leases_per_caller: bound,
            leases_for_operators: bound,
            holders: bound,
            remembered_requests: bound,
            remembered_per_caller: bound,
            remembered_bytes_per_caller: bound,
            history: bound,
            ..Limits::default()
        };
        pool.set_limits(limits);
        pool.check_invariants().unwrap();
        for refused in [
            create(&mut pool, tool()),
            adam_creates(&mut pool),
            open(&mut pool, &adam(), "new"),
            open(&mut pool, &Speaker::trusted(), "new"),
            acquire(&mut pool, "s", vec![block("Tool", 1)]),
            acquire(&mut pool, "adam", vec![block("Nothing", 1)]),
        ] {
            let refused = refused.unwrap_err();
            assert!(refused.contains("is reached (limits."), "{refused}");
        }
        assert_eq!(pool.amounts(), before, "nothing is taken from anybody");
        pool.check_invariants().unwrap();
    }
    pool.set_limits(Limits { leases_per_caller: 7, ..Limits::default() });
    let refused = acquire(&mut pool, "s", vec![block("Tool", 1)]).unwrap_err();
    assert!(refused.contains("the quota of 7 is reached (limits.leases_per_caller)"), "{refused}");
    for lease in &leases[..2] {
        pool.release(NOW, None, lease.id).unwrap();
    }
    acquire(&mut pool, "s", vec![block("Tool", 1)]).unwrap();
    pool.check_invariants().unwrap();
}
