//! The pool's state machine, without its shell.

#![allow(clippy::unwrap_used, reason = "a test may panic")]
use super::*;
use crate::access::Role;
use ratn_model::fact::{FactKey, Term};
use ratn_model::measurement::{Certainty, Measurement};
use ratn_model::value::Value;
use ratn_world::world::Fact;

fn key(name: &str) -> FactKey {
    FactKey { predicate: "at".to_owned(), arguments: vec![Term::Name(name.to_owned())] }
}

fn set(name: &str, value: i64) -> Change {
    Change::Set { fact: key(name), value: Value::Int(value) }
}

fn operator() -> Caller {
    Caller { name: "root".into(), roles: [Role::Operator].into() }
}

fn task(name: &str) -> Caller {
    Caller { name: name.into(), roles: [Role::Task].into() }
}

fn pool() -> WorldPool {
    let config = WorldPoolConfig { revisions_kept: 3, max_projections: 2, ..WorldPoolConfig::default() };
    let history = History::new(&config);
    WorldPool::new(config, None, history, 0)
}

fn commit(
    pool: &mut WorldPool,
    id: &str,
    changes: &[Change],
    expected: Option<Revision>,
) -> Result<Revision, CommitError> {
    let commit = Commit { id: id.to_owned(), changes: changes.to_vec(), expected, ..Commit::default() };
    pool.commit(Timestamp(0), &commit)
}

fn project(pool: &mut WorldPool, request: &str, base: u64, lease: u64) -> Result<ProjectionId, ProjectError> {
    pool.project(ProjectRequest {
        by: operator(),
        request_id: request.to_owned(),
        id: None,
        after: None,
        base: Revision(base),
        changes: vec![set("box", 7)],
        writers: Vec::new(),
        reads: Footprint::Patterns(vec![FactPattern::of(&key("box"))]),
        held_by: HeldBy::Lease(LeaseId(lease)),
    })
}

/// The result of a query.
fn query(
    pool: &WorldPool,
    id: Option<ProjectionId>,
    patterns: &[FactPattern],
) -> Result<Vec<(FactKey, Fact)>, QueryError> {
    let mut facts = Vec::new();
    pool.view(id, None, patterns)?.find(patterns, usize::MAX, &mut |key, fact| {
        facts.push((key.clone(), fact.clone()));
        true
    });
    Ok(facts)
}

fn value(pool: &WorldPool, id: Option<ProjectionId>, name: &str) -> Result<Option<Value>, QueryError> {
    let facts = query(pool, id, &[FactPattern::of(&key(name))])?;
    Ok(facts.into_iter().next().map(|(_, fact)| fact.value))
}

#[test]
fn a_commit_is_made_once_and_only_as_the_revision_expected() {
    let mut pool = pool();
    assert_eq!(commit(&mut pool, "a", &[set("box", 1)], Some(Revision(1))), Ok(Revision(1)));
    assert_eq!(commit(&mut pool, "a", &[set("box", 1)], Some(Revision(1))), Ok(Revision(1)));
    let wrong = commit(&mut pool, "b", &[set("box", 2)], Some(Revision(3)));
    assert_eq!(wrong, Err(CommitError::Revision { root: 1, next: 2, expected: 3 }));
    assert_eq!(value(&pool, None, "box"), Ok(Some(Value::Int(1))));
    assert_eq!(commit(&mut pool, "b", &[set("box", 2)], None), Ok(Revision(2)));
}

#[test]
fn a_projection_is_of_its_base_whatever_was_committed_since() {
    let mut pool = pool();
    commit(&mut pool, "a", &[set("box", 1), set("cup", 1)], None).unwrap();
    commit(&mut pool, "b", &[set("box", 2), set("cup", 2)], None).unwrap();
    let all = Footprint::Everything;
    let request = ProjectRequest {
        by: operator(),
        request_id: "p".to_owned(),
        id: None,
        after: None,
        base: Revision(1),
        changes: vec![set("box", 7)],
        writers: Vec::new(),
        reads: all,
        held_by: HeldBy::Until(Timestamp(5)),
    };
    let id = pool.project(request).unwrap();
    assert_eq!(value(&pool, Some(id), "box"), Ok(Some(Value::Int(7))));
    assert_eq!(value(&pool, Some(id), "cup"), Ok(Some(Value::Int(1))));
    assert_eq!(value(&pool, None, "box"), Ok(Some(Value::Int(2))), "the root is as it was");
    pool.expire(Timestamp(4));
    assert_eq!(pool.projections(), 1);
    pool.expire(Timestamp(5));
    assert_eq!(pool.projections(), 0);
}

#[test]
fn a_projection_shows_its_declared_reads_and_nothing_else() {
    let mut pool = pool();
    commit(&mut pool, "a", &[set("cup", 1)], None).unwrap();
    let id = project(&mut pool, "p", 1, 1).unwrap();
    assert_eq!(value(&pool, Some(id), "box"), Ok(Some(Value::Int(7))));
    let hidden = value(&pool, Some(id), "cup").unwrap_err();
    assert_eq!(
        hidden.to_string(),
        "projection-1 does not show at(cup): it is not among the reads declared for it; declare it (reads: […])"
    );
    let wider = FactPattern { predicate: "at".to_owned(), arguments: vec![None] };
    assert!(matches!(query(&pool, Some(id), &[wider]), Err(QueryError::Hidden { .. })));
    let all = query(&pool, Some(id), &[]).unwrap();
    assert_eq!(all.iter().map(|(key, _)| key.to_string()).collect::<Vec<_>>(), ["at(box)"]);
}

#[test]
fn revisions_outside_those_kept_are_refused() {
    let mut pool = pool();
    for i in 1..=4 {
        commit(&mut pool, &i.to_string(), &[set("box", i)], None).unwrap();
    }
    assert_eq!(project(&mut pool, "p", 1, 1), Err(RevisionError::Forgotten { wanted: 1, oldest: 2, root: 4 }.into()));
    assert_eq!(project(&mut pool, "p", 5, 1), Err(RevisionError::Future { root: 4, wanted: 5 }.into()));
    assert!(project(&mut pool, "p", 2, 1).is_ok(), "a refused request can be asked again");
}

#[test]
fn projections_end_with_their_lease_and_are_bounded() {
    let mut pool = pool();
    let first = project(&mut pool, "p", 0, 1).unwrap();
    assert_eq!(project(&mut pool, "p", 0, 1), Ok(first), "asked twice, made once");
    project(&mut pool, "q", 0, 2).unwrap();
    assert_eq!(project(&mut pool, "r", 0, 2), Err(ProjectError::TooMany { limit: 2 }));
    assert_eq!(pool.end_lease(LeaseId(1)), 1);
    assert_eq!(value(&pool, Some(first), "box"), Err(QueryError::Unknown { id: first }));
    assert_eq!(project(&mut pool, "p", 0, 1), Err(ProjectError::Ended { request_id: "p".to_owned() }));
    assert_eq!(pool.keep_leases(|lease| lease == LeaseId(2)), 0);
    assert_eq!(pool.keep_leases(|_| false), 1);
    assert_eq!(pool.projections(), 0);
    assert!(pool.by_lease.is_empty());
}

#[test]
fn a_fact_with_a_time_to_live_is_gone_after_it_unless_it_was_written_again() {
    let second = |n: f64| Timestamp::from_seconds(n);
    let config = WorldPoolConfig { ttl_s: [("at".to_owned(), 2.0)].into(), ..WorldPoolConfig::default() };
    let history = History::new(&config);
    let mut pool = WorldPool::new(config, None, history, 0);
    let of = |id: &str, changes: Vec<Change>| Commit { id: id.to_owned(), changes, ..Commit::default() };
    let full = Change::Set { fact: FactKey { predicate: "full".to_owned(), ..key("box") }, value: Value::Int(1) };
    pool.commit(second(0.0), &of("a", vec![set("box", 1), set("cup", 1), full])).unwrap();
    pool.commit(second(1.0), &of("b", vec![set("cup", 1)])).unwrap();
    // A refused commit does not renew the fact.
    pool.commit(second(1.5), &of("a", vec![set("box", 1), set("cup", 1)])).unwrap_err();
    assert_eq!(pool.next_expiry(), Some(second(2.0)));
    pool.expire_facts(second(1.9));
    assert_eq!(pool.root().revision(), Revision(2));
    pool.expire_facts(second(2.0));
    assert_eq!(pool.root().revision(), Revision(3), "a revision as any other");
    let names: Vec<String> = pool.root().iter().map(|(key, _)| key.to_string()).collect();
    assert_eq!(names, ["at(cup)", "full(box)"]);
    let news: Vec<u64> = pool.history.take_news().iter().map(|kept| kept.world.revision().0).collect();
    assert_eq!(news, [1, 2, 3], "watchers hear of it");
    pool.commit(second(2.5), &of("c", vec![Change::Delete { pattern: FactPattern::of(&key("cup")) }])).unwrap();
    assert_eq!(pool.next_expiry(), None);
}

#[test]
fn what_does_not_fit_the_ontology_is_not_committed() {
    let text = "
        @prefix ratn: <urn:ratn:ontology#> .
        @prefix owl: <http://www.w3.org/2002/07/owl#> .
        @prefix : <urn:robot#> .
        :full a ratn:Predicate ; ratn:arguments ( owl:Thing ) ; ratn:value \"int\" .";
    let ontology = ratn_model::ontology::turtle::read(text).unwrap();
    let config = WorldPoolConfig::default();
    let history = History::new(&config);
    let mut pool = WorldPool::new(config, Some(ontology), history, 0);
    let refused = commit(&mut pool, "a", &[set("box", 1)], None).unwrap_err();
    assert!(matches!(refused, CommitError::Violation(_)), "{refused}");
    // A kind of certainty that the predicate does not declare.
    let fact = FactKey { predicate: "full".to_owned(), ..key("box") };
    let changes = vec![Change::Set { fact: fact.clone(), value: Value::Int(1) }];
    let measured = Measurement { source: "scale".to_owned(), certainty: Some(Certainty::Confidence(0.9)) };
    let with = Commit { id: "m".to_owned(), changes, evidence: vec![(fact, measured)], ..Commit::default() };
    let refused = pool.commit(Timestamp(0), &with).unwrap_err();
    assert!(refused.to_string().contains("[other-uncertainty]"), "{refused}");
    assert_eq!(pool.root().revision(), Revision(0));
}

#[test]
fn a_fact_says_who_wrote_it_and_what_measured_it() {
    let mut pool = pool();
    let measured = Measurement { source: "camera".to_owned(), certainty: Some(Certainty::Confidence(0.9)) };
    let evidence = vec![(key("box"), measured.clone())];
    let commit = Commit {
        id: "a".to_owned(),
        changes: vec![set("box", 1), set("cup", 2)],
        writer: Some("detect[1]".to_owned()),
        evidence,
        ..Commit::default()
    };
    pool.commit(Timestamp(0), &commit).unwrap();
    let facts = query(&pool, None, &[]).unwrap();
    assert!(facts.iter().all(|(_, fact)| fact.writer.as_deref() == Some("detect[1]")));
    assert_eq!(facts[0].1.measured.as_deref(), Some(&measured));
    assert_eq!(facts[1].1.measured, None);
    // In a projection each fact names the node that will have written it.
    let request = ProjectRequest {
        by: operator(),
        request_id: "p".to_owned(),
        id: None,
        after: None,
        base: Revision(1),
        changes: vec![set("box", 7), set("cup", 8)],
        writers: vec!["place[1]".into(), "".into()],
        reads: Footprint::Everything,
        held_by: HeldBy::Until(Timestamp(9)),
    };
    let id = pool.project(request).unwrap();
    let facts = query(&pool, Some(id), &[]).unwrap();
    let writers: Vec<_> = facts.iter().map(|(_, fact)| fact.writer.as_deref()).collect();
    assert_eq!(writers, [Some("place[1]"), None]);
    assert!(facts.iter().all(|(_, fact)| fact.measured.is_none()), "it is predicted");
    let none = Commit { id: "b".to_owned(), changes: vec![set("cup", 3)], ..commit };
    assert_eq!(pool.commit(Timestamp(0), &none), Err(CommitError::Evidence { fact: key("box") }));
}

#[test]
fn a_commit_says_which_projections_it_contradicts_in_which_fact() {
    let mut pool = WorldPool::new(WorldPoolConfig::default(), None, History::new(&WorldPoolConfig::default()), 0);
    commit(&mut pool, "a", &[set("box", 1), set("cup", 1)], None).unwrap();
    let project = |pool: &mut WorldPool, base: u64, reads: &str| {
        let request = ProjectRequest {
            by: operator(),
            request_id: format!("{base}/{reads}"),
            id: None,
            after: None,
            base: Revision(base),
            changes: vec![set("box", 7)],
            writers: vec!["place[1]".into()],
            reads: Footprint::Patterns(vec![FactPattern::of(&key(reads))]),
            held_by: HeldBy::Until(Timestamp(9)),
        };
        pool.project(request).unwrap()
    };
    let (of_cup, of_box) = (project(&mut pool, 1, "cup"), project(&mut pool, 1, "box"));
    commit(&mut pool, "b", &[set("cup", 2)], None).unwrap();
    let found = pool.take_contradictions();
    let expected = Contradiction {
        projection: of_cup,
        fact: key("cup"),
        was: Some(Value::Int(1)),
        is: Some(Value::Int(2)),
        revision: Revision(2),
    };
    assert_eq!(found, vec![expected.clone()]);
    assert_eq!(pool.contradiction(of_cup), Ok(Some(&expected)));
    assert_eq!(pool.contradiction(of_box), Ok(None), "what it did not read is nothing to it");
    // A projection of an older revision: the commits since then count.
    let of_all = ProjectRequest {
        by: operator(),
        request_id: "late".to_owned(),
        id: None,
        after: None,
        base: Revision(1),
        changes: vec![set("box", 7)],
        writers: vec!["place[1]".into()],
        reads: Footprint::Everything,
        held_by: HeldBy::Until(Timestamp(9)),
    };
    let late = pool.project(of_all).unwrap();
    assert_eq!(pool.contradiction(late), Ok(Some(&Contradiction { projection: late, ..expected })));
    // The predicted effect of a writer comes true, or comes otherwise.
    let of = |id: &str, value| Commit {
        id: id.to_owned(),
        changes: vec![set("box", value)],
        writer: Some("place[1]".to_owned()),
        ..Commit::default()
    };
    pool.commit(Timestamp(0), &of("c", 7)).unwrap();
    assert_eq!(pool.take_contradictions(), []);
    commit(&mut pool, "d", &[set("box", 8)], None).unwrap();
    let found: Vec<_> = pool.take_contradictions().into_iter().map(|found| (found.projection, found.is)).collect();
    assert_eq!(found, [(of_box, Some(Value::Int(8)))], "of the others it was said before");
    commit(&mut pool, "e", &[set("box", 9)], None).unwrap();
    assert_eq!(pool.take_contradictions(), []);
}

#[test]
fn a_projection_made_late_knows_that_a_deletion_predicted_of_its_writer_came_true() {
    let mut pool = WorldPool::new(WorldPoolConfig::default(), None, History::new(&WorldPoolConfig::default()), 0);
    commit(&mut pool, "a", &[set("box", 1)], None).unwrap();
    let gone = Change::Delete { pattern: FactPattern::of(&key("box")) };
    let by_node = Commit {
        id: "b".to_owned(),
        changes: vec![gone.clone()],
        writer: Some("take[1]".to_owned()),
        ..Commit::default()
    };
    pool.commit(Timestamp(0), &by_node).unwrap();
    let late = ProjectRequest {
        by: operator(),
        request_id: "late".to_owned(),
        id: None,
        after: None,
        base: Revision(1),
        changes: vec![gone],
        writers: vec!["take[1]".into()],
        reads: Footprint::Everything,
        held_by: HeldBy::Until(Timestamp(9)),
    };
    let late = pool.project(late).unwrap();
    assert_eq!(pool.contradiction(late), Ok(None), "it came as predicted");
    // An effect comes true once: a second commit of the fact is a contradiction.
    commit(&mut pool, "c", &[set("box", 1)], None).unwrap();
    let found: Vec<_> = pool.take_contradictions().into_iter().map(|found| (found.projection, found.is)).collect();
    assert_eq!(found, [(late, Some(Value::Int(1)))]);
}

/// A projection without a lease.
fn project_as(pool: &mut WorldPool, by: &Caller, request: &str) -> Result<ProjectionId, ProjectError> {
    pool.project(ProjectRequest {
        by: by.clone(),
        request_id: request.to_owned(),
        id: None,
        after: None,
        base: Revision(0),
        changes: Vec::new(),
        writers: Vec::new(),
        reads: Footprint::Everything,
        held_by: HeldBy::Until(Timestamp(5)),
    })
}

#[test]
fn a_projection_is_released_by_who_made_it_or_by_an_operator_and_the_same_request_of_another_makes_another() {
    let config = WorldPoolConfig::default();
    let mut pool = WorldPool::new(config.clone(), None, History::new(&config), 0);
    let (adam, eve) = (task("adam"), task("eve"));
    let first = project_as(&mut pool, &adam, "run/i1/1").unwrap();
    assert_eq!(project_as(&mut pool, &adam, "run/i1/1"), Ok(first));
    let second = project_as(&mut pool, &eve, "run/i1/1").unwrap();
    assert_ne!(first, second);
    let refused = pool.release_for(&eve, first).unwrap_err().to_string();
    assert_eq!(refused, format!("{first} is of adam: only they and operators release it, not eve"));
    assert!(pool.has(first));
    assert_eq!(pool.release_for(&adam, first), Ok(true));
    assert_eq!(pool.release_for(&eve, first), Ok(false), "it had ended before");
    assert_eq!(pool.release_for(&operator(), second), Ok(true));
}

#[test]
fn one_caller_makes_so_many_projections_and_the_last_ones_of_all_are_operators() {
    let config = WorldPoolConfig {
        max_projections: 6,
        projections_per_caller: 2,
        projections_for_operators: 1,
        ..WorldPoolConfig::default()
    };
    let mut pool = WorldPool::new(config.clone(), None, History::new(&config), 0);
    let [adam, eve, cain] = ["adam", "eve", "cain"].map(task);
    let first = project_as(&mut pool, &adam, "1").unwrap();
    project_as(&mut pool, &adam, "2").unwrap();
    let quota = ProjectError::Quota { whose: "adam".into(), limit: 2 };
    assert_eq!(project_as(&mut pool, &adam, "3"), Err(quota));
    assert_eq!(project_as(&mut pool, &adam, "1"), Ok(first), "asked for again it is no other");
    pool.release_for(&adam, first).unwrap();
    project_as(&mut pool, &adam, "3").unwrap();
    for request in ["1", "2"] {
        project_as(&mut pool, &eve, request).unwrap();
    }
    project_as(&mut pool, &cain, "1").unwrap();
    assert_eq!(project_as(&mut pool, &cain, "2"), Err(ProjectError::KeptForOperators { limit: 5 }));
    project_as(&mut pool, &operator(), "1").unwrap();
    assert_eq!(project_as(&mut pool, &operator(), "2"), Err(ProjectError::TooMany { limit: 6 }));
    // Projections that have expired no longer count.
    pool.expire(Timestamp(5));
    assert!(pool.projections() == 0 && pool.in_memory.is_empty());
    project_as(&mut pool, &adam, "4").unwrap();
}

/// A projection with at least this many bytes of its own.
fn project_large(
    pool: &mut WorldPool,
    caller: &Caller,
    request: &str,
    bytes: usize,
) -> Result<ProjectionId, ProjectError> {
    pool.project(ProjectRequest {
        by: caller.clone(),
        request_id: request.to_owned(),
        id: None,
        after: None,
        base: pool.root().revision(),
        changes: vec![Change::Set { fact: key(request), value: Value::Bytes(vec![7; bytes]) }],
        writers: Vec::new(),
        reads: Footprint::Everything,
        held_by: HeldBy::Until(Timestamp(5)),
    })
}

#[test]
fn projections_are_bounded_by_their_bytes_for_each_caller_and_in_all() {
    const MIB: usize = 1 << 20;
    let config = WorldPoolConfig {
        projection_bytes: 40 * MIB,
        projection_bytes_per_caller: 13 * MIB,
        ..WorldPoolConfig::default()
    };
    let mut pool = WorldPool::new(config.clone(), None, History::new(&config), 0);
    let [adam, eve, cain] = ["adam", "eve", "cain"].map(task);
    // Each value is stored in the projection's facts, in its moves in the scene, and for comparison with
    // commits.
    let first = project_large(&mut pool, &adam, "1", 2 * MIB).unwrap();
    project_large(&mut pool, &adam, "2", 2 * MIB).unwrap();
    let quota = ProjectError::QuotaOfBytes { whose: "adam".into(), limit: 13 * MIB };
    assert!(quota.to_string().contains("(projection_bytes_per_caller): release some"), "{quota}");
    assert_eq!(project_large(&mut pool, &adam, "3", 2 * MIB), Err(quota));
    assert_eq!(project_large(&mut pool, &adam, "1", 2 * MIB), Ok(first), "asked for again it is no other");
    pool.release(first);
    project_large(&mut pool, &adam, "3", 2 * MIB).unwrap();
    for request in ["1", "2"] {
        project_large(&mut pool, &eve, request, 2 * MIB).unwrap();
    }
    project_large(&mut pool, &cain, "1", MIB).unwrap();
    let kept = ProjectError::BytesKeptForOperators { limit: 30 * MIB };
    assert_eq!(project_large(&mut pool, &cain, "2", 2 * MIB), Err(kept));
    project_large(&mut pool, &operator(), "1", 2 * MIB).unwrap();
    let beyond = ProjectError::TooManyBytes { limit: 40 * MIB };
    assert_eq!(project_large(&mut pool, &operator(), "2", 3 * MIB), Err(beyond));
    pool.expire(Timestamp(5));
    assert!(pool.in_memory.is_empty());
    // A deletion by pattern is small on the wire, but large in memory.
    let many: Vec<Change> = (0..60_000).map(|n| set(&format!("{n}"), n)).collect();
    commit(&mut pool, "many", &many, None).unwrap();
    let all = FactPattern { predicate: "at".to_owned(), arguments: vec![None] };
    let delete =
        ProjectRequest { by: adam, changes: vec![Change::Delete { pattern: all }], ..promised("all", None, None) };
    let refused = pool.project(ProjectRequest { base: Revision(1), ..delete }).unwrap_err();
    assert!(matches!(refused, ProjectError::QuotaOfBytes { .. }), "{refused}");
}

#[test]
fn who_projects_from_revisions_that_are_forgotten_is_counted_for_what_of_them_is_kept_alone() {
    const MIB: usize = 1 << 20;
    let config = WorldPoolConfig {
        revision_bytes: 2 * MIB,
        projection_bytes_per_caller: 10 * MIB,
        ..WorldPoolConfig::default()
    };
    let mut pool = WorldPool::new(config.clone(), None, History::new(&config), 0);
    let (adam, eve) = (task("adam"), task("eve"));
    let mut made = Vec::new();
    let refused = loop {
        let large = Change::Set { fact: key("cloud"), value: Value::Bytes(vec![0; MIB]) };
        commit(&mut pool, &format!("{}", made.len()), &[large], None).unwrap();
        match project_large(&mut pool, &eve, &format!("p{}", made.len()), 0) {
            Ok(id) => made.push(id),
            Err(refused) => break refused,
        }
        assert!(made.len() < 20, "each keeps a value of a MiB that nobody else does");
    };
    assert!(matches!(refused, ProjectError::QuotaOfBytes { .. }), "{refused}");
    assert!(made.len() > 8, "those of kept revisions take nothing: {}", made.len());
    project_large(&mut pool, &adam, "p", 0).unwrap();
    pool.release(made[0]);
    project_large(&mut pool, &eve, "more", 0).unwrap();
}

mod kept_for_projections {
    use super::*;
    use proptest::collection::vec;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

        /// Compares with a count over every fact of every base and of every kept revision.
        #[test]
        fn what_is_kept_for_projections_alone_is_counted_once(steps in vec((0..4_u8, 0..6_i64, 0..8_usize), 1..60)) {
            let config = WorldPoolConfig { revisions_kept: 3, ..WorldPoolConfig::default() };
            let mut pool = WorldPool::new(config.clone(), None, History::new(&config), 0);
            let (mut worlds, mut live) = (vec![pool.root().clone()], Vec::new());
            for (number, (what, fact, other)) in steps.into_iter().enumerate() {
                match what {
                    0 | 1 => {
                        let change = match what {
                            0 => set(&format!("{fact}"), number as i64),
                            _ => Change::Delete { pattern: FactPattern::of(&key(&format!("{fact}"))) },
                        };
                        commit(&mut pool, &format!("{number}"), &[change, set("often", 1)], None).unwrap();
                        worlds.push(pool.root().clone());
                    }
                    2 => live.push(project_large(&mut pool, &task("adam"), &format!("{number}"), 0).unwrap()),
                    _ if live.is_empty() => {}
                    _ => drop(pool.release(live.swap_remove(other % live.len()))),
                }
                let root = worlds.len() - 1;
                let facts = |world: &World| -> BTreeMap<(FactKey, Revision), usize> {
                    world.iter().map(|(key, fact)| ((key.clone(), fact.revision), size::of_fact(key, fact))).collect()
                };
                let mut expected = BTreeMap::new();
                for projection in pool.projections.values() {
                    expected.extend(facts(&worlds[projection.base.0 as usize]));
                }
                for world in &worlds[root.saturating_sub(2)..] {
                    expected.retain(|fact, _| !facts(world).contains_key(fact));
                }
                let own: usize = pool.projections.values().map(|projection| projection.bytes).sum();
                prop_assert_eq!(pool.in_memory.bytes(), own + expected.values().sum::<usize>());
            }
            for id in live {
                let _ = pool.release(id);
            }
            prop_assert!(pool.in_memory.is_empty());
        }
    }
}

#[test]
fn the_commit_of_another_is_another_and_an_operator_goes_on_with_what_anybody_began() {
    let mut pool = pool();
    let mut commit_as = |by: Caller, value: i64| {
        let commit = Commit { by, id: "run/i1".to_owned(), changes: vec![set("box", value)], ..Commit::default() };
        pool.commit(Timestamp(0), &commit)
    };
    assert_eq!(commit_as(task("adam"), 1), Ok(Revision(1)));
    assert_eq!(commit_as(operator(), 1), Ok(Revision(1)), "a run is resumed by an operator");
    assert_eq!(commit_as(task("eve"), 1), Ok(Revision(2)));
    assert_eq!(commit_as(task("eve"), 2), Err(CommitError::Reused(Reused { id: "run/i1".to_owned() })));
    assert_eq!(commit_as(task("adam"), 1), Ok(Revision(1)));
}

/// A request of `adam` that reads everything.
fn promised(request: &str, id: Option<ProjectionId>, after: Option<&str>) -> ProjectRequest {
    ProjectRequest {
        by: task("adam"),
        request_id: request.to_owned(),
        id,
        after: after.map(str::to_owned),
        base: Revision(0),
        changes: Vec::new(),
        writers: Vec::new(),
        reads: Footprint::Everything,
        held_by: HeldBy::Until(Timestamp(9)),
    }
}

/// A pool with room for the projections of tasks.
fn large_pool() -> WorldPool {
    let config = WorldPoolConfig::default();
    let history = History::new(&config);
    WorldPool::new(config, None, history, 0)
}

#[test]
fn a_promised_id_is_used_once_by_whom_it_was_promised_to() {
    let mut pool = large_pool();
    let ids = pool.promise(Timestamp(0), &"adam".into(), 2);
    let id = ids[0];
    assert_eq!(query(&pool, Some(id), &[]), Err(QueryError::NotYet { id }));
    let of_eve = ProjectRequest { by: task("eve"), ..promised("of eve", Some(id), None) };
    let caller = Arc::from("eve");
    assert_eq!(pool.project(of_eve), Err(ProjectError::NotPromised { id, caller }));
    assert!(pool.is_promised(id), "it is still adam's");
    assert_eq!(pool.project(promised("one", Some(id), None)), Ok(id));
    assert!(!pool.is_promised(id) && query(&pool, Some(id), &[]).is_ok());
    assert_eq!(pool.project(promised("one", Some(id), None)), Ok(id), "asked again, for the answer was lost");
    let again = pool.project(promised("another", Some(id), None));
    assert_eq!(again, Err(ProjectError::NotPromised { id, caller: "adam".into() }));
    // No other caller gets the id that is not used yet.
    let other = pool.project(promised("three", None, None)).unwrap();
    assert!(!ids.contains(&other));
}

#[test]
fn a_promise_ends_with_the_first_try_or_when_it_is_taken_back() {
    let mut pool = pool();
    let ids = pool.promise(Timestamp(0), &"adam".into(), 3);
    let early = pool.project(promised("one", Some(ids[0]), Some("not yet")));
    assert!(matches!(early, Err(ProjectError::NoSuchCommit { .. })) && pool.is_promised(ids[0]));
    let refused = ProjectRequest { base: Revision(7), ..promised("one", Some(ids[0]), None) };
    assert!(matches!(pool.project(refused), Err(ProjectError::Revision(_))));
    assert_eq!(query(&pool, Some(ids[0]), &[]), Err(QueryError::Unknown { id: ids[0] }));
    assert!(pool.release_for(&task("eve"), ids[1]).is_err());
    assert_eq!(pool.release_for(&task("adam"), ids[1]), Ok(true));
    assert_eq!(pool.release_for(&task("adam"), ids[1]), Ok(false));
    assert_eq!(query(&pool, Some(ids[1]), &[]), Err(QueryError::Unknown { id: ids[1] }));
    assert_eq!(pool.release_for(&operator(), ids[2]), Ok(true));
}

#[test]
fn a_projection_stands_on_the_commit_that_it_names() {
    let mut pool = large_pool();
    let of_adam = |id: &str, value| Commit {
        by: task("adam"),
        id: id.to_owned(),
        changes: vec![set("box", value)],
        ..Commit::default()
    };
    pool.commit(Timestamp(0), &of_adam("a", 1)).unwrap();
    pool.commit(Timestamp(0), &of_adam("b", 2)).unwrap();
    let first = pool.project(promised("one", None, Some("a"))).unwrap();
    assert_eq!(value(&pool, Some(first), "box"), Ok(Some(Value::Int(1))));
    let later = ProjectRequest { base: Revision(2), ..promised("two", None, Some("a")) };
    let later = pool.project(later).unwrap();
    assert_eq!(value(&pool, Some(later), "box"), Ok(Some(Value::Int(2))));
    // Another caller's commit with the same id is a different commit.
    let of_eve = ProjectRequest { by: task("eve"), ..promised("three", None, Some("a")) };
    assert!(matches!(pool.project(of_eve), Err(ProjectError::NoSuchCommit { .. })));
}
