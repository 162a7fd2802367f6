//! What others changed while a run was away, and which of its commits that refuses.

use super::*;

#[tokio::test]
async fn what_a_run_knew_when_it_decided_does_not_stand_against_it_when_it_comes_back() -> anyhow::Result<()> {
    let bench = Bench::new().await?;
    let run = bench.performer.run.clone();
    let fact = FactKey { predicate: "done".to_owned(), arguments: Vec::new() };
    let by_others = |value: i64| vec![Change::Set { fact: fact.clone(), value: Value::Int(value) }];
    bench.performer.world.commit("other/i1/1", by_others(1), None).await?;
    // The run hears of this change, and decides a commit; it is killed before that is made, and its session ends.
    let heard = Event::WorldChanged { revision: Revision(1), facts: vec![(fact.clone(), Some(Value::Int(1)))] };
    let decides = |number: u64| Command::Commit {
        instance: InstanceId(number),
        writer: "place[1]".into(),
        evidence: Vec::new(),
        changes: done(),
        revision: Revision(number),
    };
    let mut ledger = ledger(&run, &[]);
    ledger.event(Timestamp(0), &heard);
    ledger.command(&decides(2));
    let mut mirror = World::default();
    mirror.apply(&done())?;
    let mut bench = bench.comes_back(false).await?;
    bench.takes_up(ledger.clone(), &mirror).await?;
    assert_eq!(bench.performer.root().await?.0, Revision(2));
    // When it decides again, it has not heard of later changes by others.
    ledger.command(&decides(3));
    bench.performer.world.commit("other/i1/2", by_others(2), None).await?;
    let mut bench = bench.comes_back(false).await?;
    let refused = bench.takes_up(ledger, &mirror).await;
    assert!(refused.is_err_and(|error| error.to_string().contains("others have changed done")));
    assert_eq!(bench.performer.root().await?.0, Revision(3));
    bench.performer.closed().await
}

#[tokio::test]
async fn what_a_run_heard_of_during_a_motion_stands_against_its_commit_when_it_comes_back_without_what_it_held()
-> anyhow::Result<()> {
    let bench = Bench::new().await?;
    let (run, instance) = (bench.performer.run.clone(), InstanceId(1));
    let mut ledger = ledger(&run, &[start(instance, 1, "work", LeaseId(1), "")]);
    // The run is suspended during its motion, and its session ends: the next holder of the arm changes the same fact. The run goes on, hears of that
    // change before it hears of its session, and decides.
    let fact = FactKey { predicate: "done".to_owned(), arguments: Vec::new() };
    let changes = vec![Change::Set { fact: fact.clone(), value: Value::Bool(false) }];
    bench.performer.world.commit("other/i1/1", changes, None).await?;
    let heard = Event::WorldChanged { revision: Revision(1), facts: vec![(fact, Some(Value::Bool(false)))] };
    ledger.event(Timestamp(0), &heard);
    ledger.event(Timestamp(0), &finished(instance));
    ledger.command(&commits(1, 2));
    let mut mirror = World::default();
    mirror.apply(&done())?;
    let mut bench = bench.comes_back(false).await?;
    let refused = bench.takes_up(ledger.clone(), &mirror).await;
    assert!(refused.is_err_and(|error| error.to_string().contains("others have changed done")));
    let refused = bench.finishes(ledger).await;
    assert!(refused.is_err_and(|error| error.to_string().contains("others have changed done")));
    assert_eq!(bench.performer.root().await?.0, Revision(1));
    bench.performer.closed().await
}

#[tokio::test]
async fn what_ended_well_while_the_session_was_lost_is_refused_where_others_have_changed_the_same() -> anyhow::Result<()>
{
    let bench = Bench::new().await?;
    let run = bench.performer.run.clone();
    let [motion, other] = [1, 2].map(InstanceId);
    // The run is killed during two motions, and its session ends. Others change what the first motion changes.
    let mut ledger = ledger(&run, &[start(motion, 1, "work", LeaseId(1), ""), start(other, 1, "work", LeaseId(1), "")]);
    ledger.event(Timestamp(0), &finished(other));
    let fact = FactKey { predicate: "done".to_owned(), arguments: Vec::new() };
    let changes = vec![Change::Set { fact, value: Value::Bool(false) }];
    bench.performer.world.commit("other/i1/1", changes, None).await?;
    let mut bench = bench.comes_back(false).await?;
    bench.takes_up(ledger, &World::default()).await?;
    // Both motions have ended well; what begins now knows the change.
    let refused = bench.performer.perform(commits(1, 2));
    assert!(refused.is_err_and(|error| error.to_string().contains("others have changed done")));
    bench.performer.perform(Command::Note(Note::Retired { instance: motion }))?;
    bench.performer.perform(start(other, 2, "work", LeaseId(2), ""))?;
    bench.performer.perform(commits(2, 2))?;
    assert!(bench.performer.came_between.is_none());
    bench.performer.perform(commits(3, 3))?;
    let world = bench.performer.world.clone();
    bench.performer.closed().await?;
    assert_eq!(world.root().await?.0, Revision(3));
    Ok(())
}

#[tokio::test]
async fn what_a_motion_did_is_not_made_real_while_another_run_has_what_guarded_it() -> anyhow::Result<()> {
    let (mut bench, motion) = (Bench::new().await?, InstanceId(1));
    bench.ask(motion)?;
    let lease = bench.granted(motion).await?;
    let mut ledger = ledger(&bench.performer.run, &[start(motion, 1, "work", lease, "")]);
    // The run is killed during the motion, and its session ends. Another one is granted the arm, and begins by what the world was before.
    let mut bench = bench.comes_back(false).await?;
    let (events, mut answers) = mpsc::channel(8);
    let mut other = connect(&bench.endpoints, "other", events).await?;
    other.perform(Command::Acquire { instance: motion, requirements: arm(), priority: 0 })?;
    let (theirs, _) = granted_after(&mut other, &mut answers).await?;
    bench.takes_up(ledger.clone(), &World::default()).await?;
    // The motion has ended well.
    bench.performer.perform(commits(1, 1))?;
    let refused = async {
        loop {
            let event = bench.event().await.context("nothing is told")?;
            if let Event::RetirementFailed { reason, .. } = event {
                break anyhow::Ok(reason);
            }
        }
    };
    let reason = tokio::time::timeout(SESSION_DEADLINE, refused).await??;
    assert!(reason.contains("others have `arm` since then"), "{reason}");
    // The run had decided that: it is made when the other one has given the arm back.
    bench.loses(&mut ledger).await?;
    ledger.command(&commits(1, 1));
    let mut bench = bench.comes_back(false).await?;
    let refused = bench.takes_up(ledger.clone(), &World::default()).await;
    assert!(refused.is_err_and(|error| error.to_string().contains("resume the run when they have given it back")));
    assert_eq!(bench.performer.root().await?.0, Revision(0));
    other.perform(Command::Release { instance: motion, lease: Some(theirs), projection: None })?;
    other.closed().await?;
    let mut bench = bench.comes_back(false).await?;
    bench.takes_up(ledger, &World::default()).await?;
    assert_eq!(bench.performer.root().await?.0, Revision(1));
    bench.performer.closed().await
}

#[tokio::test]
async fn what_others_change_when_a_run_has_come_back_stands_against_what_it_began_before() -> anyhow::Result<()> {
    let bench = Bench::new().await?;
    let run = bench.performer.run.clone();
    let ledger = ledger(&run, &[start(InstanceId(1), 1, "work", LeaseId(1), "")]);
    let fact = FactKey { predicate: "done".to_owned(), arguments: Vec::new() };
    let change = |value| vec![Change::Set { fact: fact.clone(), value: Value::Int(value) }];
    let mut bench = bench.comes_back(false).await?;
    bench.takes_up(ledger, &World::default()).await?;
    bench.performer.world.commit("other/i1/1", change(1), None).await?;
    while !matches!(bench.event().await.context("nothing is told")?, Event::WorldChanged { .. }) {}
    let refused = bench.performer.perform(commits(1, 2));
    assert!(refused.is_err_and(|error| error.to_string().contains("others have changed done")));
    bench.performer.closed().await
}

/// The commit of a composite state at its exit, as HSM mode makes it.
fn leaves(path: &str, number: u64) -> Command {
    let (instance, evidence, revision) = (InstanceId(0), Vec::new(), Revision(number));
    Command::Commit { instance, writer: path.to_owned(), changes: done(), evidence, revision }
}

#[tokio::test]
async fn what_others_change_stands_against_the_effects_of_a_composite_state_whose_parts_began_before()
-> anyhow::Result<()> {
    let note = |instance: u64, path: &str| {
        let (instance, state, path) = (InstanceId(instance), StateId(1), path.to_owned());
        Command::Note(Note::Expanded { instance, state, path, speculative: false })
    };
    let running = |instance: u64| Command::Note(Note::Running { instance: InstanceId(instance), attempt: 1 });
    let begun = [
        note(1, "part/move"),
        start(InstanceId(1), 1, "work", LeaseId(1), ""),
        note(2, "routine"),
        running(2),
        note(3, "routine/move"),
        start(InstanceId(3), 1, "work", LeaseId(1), ""),
    ];
    let (part, routine) = (leaves("part", 2), leaves("routine", 2));
    // The run had decided before it was killed, or decides after the resumption; a part may begin anew in between.
    for (by_another, again, left, is_made) in [
        ("other", None, None, true),
        ("done", None, None, false),
        ("other", None, Some(&part), true),
        ("done", None, Some(&part), false),
        ("done", Some(1), Some(&part), true),
        ("other", None, Some(&routine), true),
        ("done", None, Some(&routine), false),
        ("done", Some(3), Some(&routine), false),
    ] {
        let bench = Bench::new().await?;
        let run = bench.performer.run.clone();
        let mut ledger = Ledger { session: bench.performer.number, ..Ledger::default() };
        ledger.origin.run = run;
        let natures = Natures { changes_at_exit: vec!["part".into(), "routine".into()], ..Natures::default() };
        let origin = Box::new(Origin { natures, ..ledger.origin.clone() });
        ledger.event(Timestamp(0), &started(origin));
        begun.iter().for_each(|command| ledger.command(command));
        bench.performer.world.commit("other/i1/1", by_others(by_another), None).await?;
        // The run hears of that change during its motion.
        let heard = Event::WorldChanged { revision: Revision(1), facts: Vec::new() };
        ledger.event(Timestamp(0), &heard);
        if left.is_none() {
            ledger.command(&part);
        }
        let mut bench = bench.comes_back(false).await?;
        let mut done = bench.takes_up(ledger, &World::default()).await.map(|_| ());
        if let Some(instance) = again {
            let held = Event::Granted {
                instance: InstanceId(instance),
                lease: Lease { id: LeaseId(2), token: FencingToken(0), resources: Vec::new(), consumed: Vec::new() },
            };
            bench.performer.accept(held.into(), &World::default());
            bench.performer.perform(start(InstanceId(instance), 2, "work", LeaseId(2), ""))?;
            bench.performer.perform(Command::Note(Note::Retired { instance: InstanceId(instance) }))?;
        }
        if let Some(left) = left {
            done = bench.performer.perform(left.clone());
        }
        let case = format!("by another: {by_another}, again: {again:?}, {left:?}, {done:?}");
        assert_eq!((done.is_ok(), is_refused(done)), (is_made, !is_made), "{case}");
    }
    Ok(())
}

fn started(origin: Box<Origin>) -> Event {
    Event::Started {
        task: String::new(),
        digest: String::new(),
        mode: Mode::Hsm,
        parameters: BTreeMap::new(),
        seed: 0,
        world: Vec::new(),
        revision: Revision(0),
        capacity: BTreeMap::new(),
        learned: Learned::default(),
        breakpoints: Box::default(),
        origin,
    }
}

/// A run that was killed during two motions and has lost its session; others have changed what the first motion changes. It was resumed once, and has
/// committed since then what follows the second motion. Returns its log, and the number of its present session.
async fn taken_up_once() -> anyhow::Result<(Bench, Ledger, u64)> {
    let bench = Bench::new().await?;
    let run = bench.performer.run.clone();
    let begun = [1, 2].map(|instance| start(InstanceId(instance), 1, "work", LeaseId(1), ""));
    let mut ledger = Ledger { session: bench.performer.number, ..ledger(&run, &begun) };
    bench.performer.world.commit("other/i1/1", by_others("done"), None).await?;
    let mut bench = bench.comes_back(false).await?;
    bench.loses(&mut ledger).await?;
    let program = fetch_boxes();
    let (mut told, taken) = bench.performer.take_up(&program, ledger.clone(), &World::default(), Timestamp(0)).await?;
    told.extend(bench.performer.go_on(&program, taken).await?);
    told.iter().for_each(|event| ledger.event(Timestamp(0), event));
    let again = start(InstanceId(2), 2, "work", LeaseId(2), "");
    for command in [again, commits_what(2, 2, by_others("tidy"))] {
        bench.performer.perform(command.clone())?;
        ledger.command(&command);
    }
    bench.performer.recorded.subscribe().wait_for(|done| done.commit == Revision(2)).await?;
    let number = bench.performer.number;
    assert_eq!(ledger.session, number);
    ledger.event(Timestamp(0), &Event::Resumed { share: None });
    Ok((bench, ledger, number))
}

fn by_others(fact: &str) -> Vec<Change> {
    let fact = FactKey { predicate: fact.to_owned(), arguments: Vec::new() };
    vec![Change::Set { fact, value: Value::Int(7) }]
}

fn commits_what(instance: u64, number: u64, changes: Vec<Change>) -> Command {
    let (instance, writer) = (InstanceId(instance), "place[1]".into());
    Command::Commit { instance, writer, evidence: Vec::new(), changes, revision: Revision(number) }
}

fn is_refused<T>(done: anyhow::Result<T>) -> bool {
    done.is_err_and(|error| error.to_string().contains("others have changed done"))
}

#[tokio::test]
async fn what_others_changed_stands_against_a_commit_however_often_its_run_is_taken_up_since() -> anyhow::Result<()> {
    for lives in [true, false] {
        // The log has the commit, although a resumption was refused for it.
        let (bench, mut ledger, number) = Box::pin(taken_up_once()).await?;
        ledger.command(&commits(1, 3));
        let mut bench = bench.comes_back_to(number, lives).await?;
        assert_eq!(bench.performer.is_own, lives);
        assert!(is_refused(bench.takes_up(ledger.clone(), &World::default()).await), "lives: {lives}");
        assert!(is_refused(bench.finishes(ledger).await), "lives: {lives}");
        assert_eq!(bench.performer.root().await?.0, Revision(2));
        // The run was killed once more, during the motion.
        let (bench, ledger, number) = Box::pin(taken_up_once()).await?;
        let mut bench = bench.comes_back_to(number, lives).await?;
        bench.takes_up(ledger, &World::default()).await?;
        assert!(is_refused(bench.performer.perform(commits(1, 3))), "lives: {lives}");
        bench.performer.perform(start(InstanceId(1), 2, "work", LeaseId(3), ""))?;
        bench.performer.perform(commits(1, 4))?;
        let world = bench.performer.world.clone();
        bench.performer.closed().await?;
        assert_eq!(world.root().await?.0, Revision(3), "what begins now knows of it");
    }
    Ok(())
}

#[tokio::test]
async fn what_others_change_while_a_commit_waits_for_the_disk_stands_against_it_where_the_run_has_lost_what_it_held()
-> anyhow::Result<()> {
    for (by_another, is_made) in [("other", true), ("done", false)] {
        let bench = Bench::new().await?;
        let ledger = ledger(&bench.performer.run, &[start(InstanceId(1), 1, "work", LeaseId(1), "")]);
        let mut bench = bench.comes_back(false).await?;
        bench.takes_up(ledger, &World::default()).await?;
        // The run's own changes do not conflict with its commit.
        bench.performer.perform(commits(9, 1))?;
        let (disk, slow) = Mark::not_yet();
        bench.performer.perform_when(Some(slow), commits(1, 2))?;
        let mut done = bench.performer.recorded.subscribe();
        done.wait_for(|done| done.commit == Revision(1)).await?;
        bench.performer.world.commit("other/i1/1", by_others(by_another), None).await?;
        disk.send_replace(1);
        if is_made {
            done.wait_for(|done| done.commit == Revision(2)).await?;
        } else {
            let refused = async {
                loop {
                    let event = bench.event().await.context("nothing is told")?;
                    if let Event::RetirementFailed { instance, reason, unmade } = event {
                        break Ok((instance, reason, unmade));
                    }
                }
            };
            let failed: anyhow::Result<_> = tokio::time::timeout(SESSION_DEADLINE, refused).await?;
            let failed = failed?;
            assert!(failed.1.contains("others have changed done"), "{failed:?}");
            assert_eq!((failed.0, failed.2), (InstanceId(1), Unmade::Untried));
        }
        assert_eq!(bench.performer.world.root().await?.0, Revision(if is_made { 3 } else { 2 }));
    }
    Ok(())
}

#[tokio::test]
async fn a_commit_that_others_do_not_wait_for_any_more_is_made_where_they_have_not_changed_what_it_is_made_of()
-> anyhow::Result<()> {
    for (is_late, by_another, is_made) in [(false, "done", true), (true, "other", true), (true, "done", false)] {
        let mut bench = Bench::new().await?;
        bench.performer.root().await?;
        let (disk, slow) = Mark::not_yet();
        bench.performer.perform_when(Some(slow), commits(1, 1))?;
        bench.ask(InstanceId(1))?;
        let lease = bench.granted(InstanceId(1)).await?;
        if is_late {
            let since = Instant::now().checked_sub(told::PENDING_PATIENCE).context("just booted")?;
            bench.performer.left.goes_back(Revision(1), Revision(0), since);
        }
        bench.goes_on(InstanceId(1), lease, None)?;
        bench.performer.world.commit("other/i1/1", by_others(by_another), None).await?;
        disk.send_replace(1);
        let closed = bench.performer.closed().await;
        assert_eq!(closed.is_ok(), is_made, "late: {is_late}, by another: {by_another}, {closed:?}");
        assert!(is_made || closed.is_err_and(|error| error.to_string().contains("others have changed done")));
    }
    Ok(())
}

/// A run that has heard of the changes by others so far, has decided a commit, and has given back its lease behind it; after `passed`, others have
/// changed a fact. It is killed, and its session lives.
async fn gave_back_and_was_killed(
    behind: &[Command],
    passed: Duration,
    by_another: &str,
) -> anyhow::Result<(Bench, Ledger)> {
    let mut bench = Bench::new().await?;
    let (run, instance) = (bench.performer.run.clone(), InstanceId(1));
    bench.performer.world.commit("other/i1/1", by_others("done"), None).await?;
    bench.ask(instance)?;
    let lease = bench.granted(instance).await?;
    let mut ledger = Ledger { session: bench.performer.number, ..ledger(&run, &[]) };
    let held = Lease { id: lease, token: FencingToken(0), resources: Vec::new(), consumed: Vec::new() };
    ledger.event(Timestamp(0), &Event::Granted { instance, lease: held });
    let facts = vec![(FactKey { predicate: "done".to_owned(), arguments: Vec::new() }, Some(Value::Int(7)))];
    ledger.event(Timestamp(0), &Event::WorldChanged { revision: Revision(1), facts });
    behind.iter().for_each(|command| ledger.command(command));
    let release = Command::Release { instance, lease: Some(lease), projection: None };
    for command in [commits(1, 2), release.clone()] {
        ledger.command(&command);
    }
    bench.performer.perform(release)?;
    while !living(&bench).await?.is_empty() {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    bench.performer.world.commit("other/i1/2", by_others(by_another), None).await?;
    let mut bench = bench.comes_back(true).await?;
    bench.performer.speed = 10.0;
    let event = Event::Resumed { share: None };
    ledger.event(Timestamp::from_seconds(passed.as_secs_f64() * 10.0), &event);
    Ok((bench, ledger))
}

/// The leases that hold the arm.
async fn living(bench: &Bench) -> anyhow::Result<Vec<LeaseId>> {
    let arms = bench.performer.resources.list(&["Arm"]).await?;
    Ok(arms.iter().flat_map(|arm| &arm.holdings).map(|holding| holding.lease).collect())
}

#[tokio::test]
async fn a_commit_that_was_on_its_way_for_long_is_made_by_who_comes_back_where_others_have_not_changed_what_it_is_made_of()
-> anyhow::Result<()> {
    let (soon, late) = (told::PENDING_PATIENCE / 2, told::PENDING_PATIENCE + Duration::from_secs(1));
    for (passed, by_another, is_made) in [(soon, "done", true), (late, "other", true), (late, "done", false)] {
        for ends in [false, true] {
            let (mut bench, ledger) = gave_back_and_was_killed(&[], passed, by_another).await?;
            assert!(bench.performer.is_own);
            let done = if ends {
                bench.finishes(ledger).await.map(|_| ())
            } else {
                bench.takes_up(ledger, &World::default()).await.map(|_| ())
            };
            let case = format!("{passed:?}, by another: {by_another}, ends: {ends}, {done:?}");
            assert_eq!((done.is_ok(), is_refused(done)), (is_made, !is_made), "{case}");
            assert_eq!(bench.performer.world.root().await?.0, Revision(if is_made { 3 } else { 2 }), "{case}");
        }
    }
    Ok(())
}

#[tokio::test]
async fn what_was_not_late_when_its_run_was_taken_up_is_refused_where_it_is_when_its_turn_comes() -> anyhow::Result<()>
{
    // The commit is behind an operation.
    let before = [operate(9, create("Box", 1))];
    for (goes_late, is_made) in [(false, true), (true, false)] {
        let (mut bench, ledger) = gave_back_and_was_killed(&before, Duration::ZERO, "done").await?;
        bench.takes_up(ledger, &World::default()).await?;
        if goes_late {
            bench.performer.left.all_is_late();
        }
        let closed = bench.performer.closed().await;
        assert_eq!(closed.is_ok(), is_made, "{closed:?}");
        assert!(is_made || is_refused(closed));
    }
    Ok(())
}

#[tokio::test]
async fn a_commit_is_refused_where_the_world_pool_does_not_go_back_to_where_its_run_had_what_it_held()
-> anyhow::Result<()> {
    let bench = Bench::new_with(WorldPoolConfig { revisions_kept: 2, ..WorldPoolConfig::default() }).await?;
    let ledger = ledger(&bench.performer.run, &[start(InstanceId(1), 1, "work", LeaseId(1), "")]);
    for number in 1..=4 {
        bench.performer.world.commit(&format!("other/i1/{number}"), by_others("done"), None).await?;
    }
    let mut bench = bench.comes_back(false).await?;
    bench.takes_up(ledger, &World::default()).await?;
    let refused = bench.performer.perform(commits(1, 5));
    assert!(refused.is_err_and(|error| error.to_string().contains("does not keep it so long")));
    bench.performer.closed().await
}
