//! A run that comes back: nothing is done twice, and what had not been done is done.

use super::*;

/// The operation that an event reports as done, and the session.
fn done_of(event: Option<&Event>) -> Option<(u64, u64)> {
    match event {
        Some(Event::Recorded { operation, session, .. }) => Some((*operation, *session)),
        _ => None,
    }
}

#[tokio::test]
async fn who_comes_back_leaves_word_with_what_the_run_was_about_to_give_back() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (first, late) = (InstanceId(1), InstanceId(2));
    bench.ask(first)?;
    let Some(Event::Granted { lease, .. }) = bench.event().await else { bail!("no grant") };
    let run = bench.performer.run.clone();
    // Task control is killed when all of it is logged and nothing of it has been sent.
    let mut ledger = ledger(&run, &[]);
    ledger.command(&Command::Acquire { instance: first, requirements: arm(), priority: 0 });
    ledger.event(Timestamp(0), &Event::Granted { instance: first, lease: lease.clone() });
    ledger.command(&Command::Commit {
        instance: first,
        writer: "place[1]".into(),
        evidence: Vec::new(),
        changes: done(),
        revision: Revision(1),
    });
    ledger.command(&Command::Release { instance: first, lease: Some(lease.id), projection: None });
    // The run had withdrawn more requests than can be repeated in a moment.
    ledger.withdrawn = (0..1_000).map(|number| format!("{run}/{late}/{number}")).collect();
    let mut bench = bench.comes_back(true).await?;
    let mut mirror = World::default();
    mirror.apply(&done())?;
    bench.takes_up(ledger, &mirror).await?;
    assert!(!bench.performer.order.returning.is_empty(), "it does not wait for that");
    let channels = Channels::new(&ClientTls::none());
    let next = Session::open(&channels, &bench.endpoints.resource_manager, "next", DEFAULT_TTL);
    next.alive(SESSION_DEADLINE).await?;
    let next = ResourceClient::new(&channels, &bench.endpoints.resource_manager, next.id())?;
    let (_, notes) = next.acquire_with_notes(arm(), AcquireOptions::default()).await?;
    let notes: Vec<(&str, &str)> = notes.iter().map(|note| (note.session_id.as_str(), note.note.as_str())).collect();
    assert_eq!(notes, [(run.as_str(), "1 0")]);
    bench.performer.closed().await
}

/// Only the changes of the world among these events.
fn of_the_world(told: Vec<Event>) -> Vec<Event> {
    told.into_iter().filter(|event| matches!(event, Event::WorldChanged { .. })).collect()
}

#[tokio::test]
async fn who_comes_back_to_a_living_session_does_nothing_twice() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let run = bench.performer.run.clone();
    let operate = Command::Operate { instance: InstanceId(1), operations: vec![create("Box", 2)] };
    let commit = Command::Commit {
        instance: InstanceId(1),
        writer: "place[1]".into(),
        evidence: Vec::new(),
        changes: done(),
        revision: Revision(1),
    };
    bench.performer.perform(commit.clone())?;
    bench.performer.perform(operate.clone())?;
    // A grant that was under way when task control was killed.
    bench.ask(InstanceId(2))?;
    bench.granted(InstanceId(2)).await?;
    let waiting = Command::Acquire { instance: InstanceId(2), requirements: arm(), priority: 0 };

    let mut bench = bench.comes_back(true).await?;
    let mut mirror = World::default();
    mirror.apply(&done())?;
    let ledger = ledger(&run, &[commit, operate, waiting]);
    bench.takes_up(ledger, &mirror).await?;
    // The acquire is repeated, and a lease that nobody knew of is given back for it.
    bench.granted(InstanceId(2)).await?;
    assert_eq!(bench.units("Box").await?, 2);
    bench.performer.closed().await
}

#[tokio::test]
async fn what_the_log_says_to_be_done_is_not_done_again_although_the_manager_has_forgotten_it() -> anyhow::Result<()> {
    let place = tempfile::tempdir()?;
    let directory = RuntimeDirectory::create(place.path())?;
    let mut config = ResourceManagerConfig::default();
    config.limits.remembered_requests = 1;
    let shutdown = CancellationToken::new();
    tokio::spawn(resource_manager::run(config, directory.clone(), shutdown.clone()));
    let _shutdown = shutdown.drop_guard();
    let (mut bench, _robot) = with_manager_at(&directory).await?;
    let (run, session) = (bench.performer.run.clone(), bench.performer.number);
    assert_ne!(session, 0);
    let operations = [operate(1, create("Box", 2)), operate(2, create("Tray", 1)), operate(3, create("Cup", 1))];
    let mut ledger = Ledger { session, ..ledger(&run, &operations) };
    for (number, command) in (1..).zip(&operations[..2]) {
        bench.performer.perform(command.clone())?;
        let done = bench.any_event().await;
        assert_eq!(done_of(done.as_ref()), Some((number, session)));
        done.iter().for_each(|done| ledger.event(Timestamp(0), done));
    }
    // Task control is killed before the third operation.
    let mut bench = bench.comes_back(true).await?;
    assert_eq!(bench.takes_up(ledger, &World::default()).await?, []);
    assert_eq!(done_of(bench.any_event().await.as_ref()), Some((3, session)));
    assert_eq!([bench.units("Box").await?, bench.units("Tray").await?, bench.units("Cup").await?], [2, 1, 1]);
    assert_eq!(bench.performer.confirmed().operation, 3);
    bench.performer.closed().await
}

#[tokio::test]
async fn a_session_in_which_a_resumption_died_is_not_the_runs() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (run, session) = (bench.performer.run.clone(), bench.performer.number);
    let created = operate(1, create("Box", 2));
    bench.performer.perform(created.clone())?;
    let done = bench.any_event().await.context("no word")?;
    assert_eq!(done_of(Some(&done)), Some((1, session)));
    let mut ledger = Ledger { session, ..ledger(&run, &[created]) };
    ledger.event(Timestamp(0), &done);
    // The session ends. A resumption opens another one, and is killed when it has made half of the resources again.
    let bench = bench.comes_back(false).await?;
    let second = bench.performer.number;
    assert!(!bench.performer.is_own && second != session);
    let half = Resource::new("half", ResourceClass::Task, "Box");
    bench.performer.resources.create(half).await?;
    let Bench { performer, endpoints, answers: _answers, _robot, _place, _shutdown } = bench;
    performer.session.abandon().await;
    let (events, answers) = mpsc::channel(8);
    let performer = connect_as(&endpoints, &run, Some(session), "task", events).await?;
    let mut bench = Bench { performer, endpoints, answers, _robot, _place, _shutdown };
    let third = bench.performer.number;
    assert!(!bench.performer.is_own && third != second);
    let told = bench.takes_up(ledger.clone(), &World::default()).await?;
    assert_eq!(told.iter().map(|event| done_of(Some(event))).collect::<Vec<_>>(), [Some((1, third))]);
    assert_eq!(bench.units("Box").await?, 2);
    // From then on the new session is the run's.
    ledger.event(Timestamp(0), &told[0]);
    assert_eq!((ledger.session, ledger.open_operations().count()), (third, 0));
    let mut bench = bench.comes_back(true).await?;
    assert!(bench.performer.is_own && bench.performer.number == third);
    assert_eq!(bench.takes_up(ledger, &World::default()).await?, []);
    assert_eq!(bench.units("Box").await?, 2);
    bench.performer.closed().await
}

#[tokio::test]
async fn who_comes_back_commits_behind_an_operation_when_that_is_done_and_never_where_it_is_refused()
-> anyhow::Result<()> {
    let mut mirror = World::default();
    mirror.apply(&done())?;
    for (operation, there) in [(create("Box", 1), 2), (delete("Nothing"), 1)] {
        let bench = Bench::new().await?;
        let (run, session) = (bench.performer.run.clone(), bench.performer.number);
        let decided = [commits(1, 1), operate(1, operation), commits(2, 2)];
        let ledger = Ledger { session, ..ledger(&run, &decided) };
        let mut bench = bench.comes_back(true).await?;
        // Its mirror has all of these changes.
        assert_eq!(bench.takes_up(ledger, &mirror).await?, []);
        if there == 1 {
            let failed = bench.event().await;
            assert!(matches!(&failed, Some(Event::RetirementFailed { .. })), "{failed:?}");
        }
        let world = bench.performer.world.clone();
        assert_eq!(bench.performer.closed().await.is_ok(), there == 2);
        assert_eq!(world.root().await?.0, Revision(there));
    }
    Ok(())
}

#[tokio::test]
async fn behind_what_had_failed_nothing_is_made_by_who_comes_back() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let run = bench.performer.run.clone();
    let decided = [commits(1, 1), operate(1, delete("Nothing")), commits(2, 2)];
    for command in decided.clone() {
        bench.performer.perform(command)?;
    }
    // Nobody has received this event when the run has ended.
    let (events, answers) = mpsc::channel(8);
    let before =
        std::mem::replace(&mut bench.performer, connect_as(&bench.endpoints, "next", None, "task", events).await?);
    bench.answers.close();
    let (said, closed) = before.close().await;
    bench.answers = answers;
    assert!(closed.is_err());
    let [Event::RetirementFailed { instance: InstanceId(1), reason, .. }] = &said[..] else { bail!("{said:?}") };
    assert!(reason.contains("Nothing"), "{reason}");
    let mut ledger = ledger(&run, &decided);
    said.iter().for_each(|event| ledger.event(Timestamp(0), event));
    let place = place_of(&bench.endpoints);
    assert_eq!((missing_commits(&place, &ledger).await?, ledger.open_operations().count()), (Some(0), 0));
    let (events, _answers) = mpsc::channel(8);
    let mut late = connect_as(&bench.endpoints, &run, None, "task", events).await?;
    assert_eq!(late.finish(&fetch_boxes(), ledger, Timestamp(0), |_| Ok(())).await?, (0, 0));
    assert_eq!(late.root().await?.0, Revision(1));
    late.closed().await?;
    bench.performer.closed().await
}

#[tokio::test]
async fn what_others_hold_now_is_deleted_by_who_comes_back_when_it_is_free_also_of_a_run_that_has_ended()
-> anyhow::Result<()> {
    for has_ended in [false, true] {
        let mut bench = Bench::new().await?;
        let run = bench.performer.run.clone();
        let channels = Channels::new(&ClientTls::none());
        // An operator creates a part.
        let operator = ResourceClient::new(&channels, &bench.endpoints.resource_manager, "")?;
        operator.create(Resource::new("part", ResourceClass::Task, "Part")).await?;
        let start = Ledger { session: bench.performer.number, ..ledger(&run, &[]) };
        let mut ledger = start;
        ledger.command(&operate(1, delete("Part")));
        // The run is killed before it has requested the delete. Its session ends, and another run gets the part.
        let (events, _answers) = mpsc::channel(8);
        let other = connect(&bench.endpoints, "other", events).await?;
        let part = vec![Requirement::new(ResourceOperation::Block, "Part")];
        let lease = other.resources.acquire(part, AcquireOptions::default()).await?;
        let come_back = async |bench: &mut Bench| {
            if has_ended {
                return bench.finishes(ledger.clone()).await.map(|made| made.1);
            }
            let told = bench.takes_up(ledger.clone(), &World::default()).await?;
            Ok(told.len())
        };
        bench = bench.comes_back(false).await?;
        let refused = come_back(&mut bench).await;
        assert!(refused.is_err_and(|error| error.to_string().contains("delete Part")));
        assert_eq!((bench.performer.confirmed().operation, bench.units("Part").await?), (0, 1));
        other.resources.release(lease.id).await?;
        bench = bench.comes_back(false).await?;
        let told = if has_ended { 1 } else { 2 };
        assert_eq!((come_back(&mut bench).await?, bench.units("Part").await?), (told, 0));
        // The log says what is done.
        assert_eq!(bench.performer.confirmed().operation, 1);
        let session = bench.performer.number;
        let (said, closed) = bench.performer.close().await;
        closed?;
        let said: Vec<_> = said.iter().map(|event| done_of(Some(event))).collect();
        assert_eq!(said, has_ended.then_some(Some((1, session))).into_iter().collect::<Vec<_>>());
        other.closed().await?;
    }
    Ok(())
}

#[tokio::test]
async fn of_a_run_that_has_ended_what_was_not_recorded_is_made_and_nothing_else() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (run, session) = (bench.performer.run.clone(), bench.performer.number);
    let commit = |number: u64| Command::Commit {
        instance: InstanceId(number),
        writer: "place[1]".into(),
        evidence: Vec::new(),
        changes: done(),
        revision: Revision(number),
    };
    bench.ask(InstanceId(1))?;
    let Some(Event::Granted { lease, .. }) = bench.event().await else { bail!("no grant") };
    bench.performer.perform(commit(1))?;
    while bench.performer.confirmed().commit < Revision(1) {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    // Everything else is in its log, including its end, when it is killed.
    let mut ledger = Ledger { session, ..ledger(&run, &[commit(1), commit(2), operate(2, create("Box", 1))]) };
    ledger.returned.push(lease.id);
    let place = place_of(&bench.endpoints);
    assert_eq!(missing_commits(&place, &ledger).await?, Some(1));
    let mut bench = bench.comes_back(true).await?;
    assert_eq!(bench.finishes(ledger.clone()).await?, (1, 1));
    while bench.units("Box").await? == 0 {}
    bench.performer.closed().await?;
    assert_eq!(missing_commits(&place, &ledger).await?, Some(0));
    // The session is over, and with it the resources that it had created.
    let (events, _answers) = mpsc::channel(1);
    let mut late = connect_as(&bench.endpoints, &run, Some(session), "task", events).await?;
    assert_eq!(late.finish(&fetch_boxes(), ledger.clone(), Timestamp(0), |_| Ok(())).await?, (0, 0));
    assert!(late.resources.list(&["Box"]).await?.is_empty());
    late.closed().await?;
    let other = Ledger { first_revision: Revision(9), ..ledger };
    assert_eq!(missing_commits(&place, &other).await?, None, "it is another world");
    Ok(())
}

#[tokio::test]
async fn who_comes_back_too_late_makes_anew_what_went_with_the_session() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let run = bench.performer.run.clone();
    let operate = Command::Operate { instance: InstanceId(1), operations: vec![create("Box", 2)] };
    bench.performer.perform(operate.clone())?;
    while bench.units("Box").await? == 0 {}
    let mut bench = bench.comes_back(false).await?;
    assert_eq!(bench.units("Box").await?, 0);
    bench.takes_up(ledger(&run, &[operate]), &World::default()).await?;
    assert_eq!(bench.units("Box").await?, 2);
    bench.performer.closed().await
}

#[tokio::test]
async fn a_commit_that_did_not_leave_is_made_what_others_did_is_told_and_another_world_is_refused() -> anyhow::Result<()>
{
    let mut bench = Bench::new().await?;
    let run = bench.performer.run.clone();
    let commit = Command::Commit {
        instance: InstanceId(1),
        writer: "place[1]".into(),
        evidence: Vec::new(),
        changes: done(),
        revision: Revision(1),
    };
    let open = ledger(&run, &[commit]);
    let mut mirror = World::default();
    mirror.apply(&done())?;
    check_world(&place_of(&bench.endpoints), &open).await?;
    assert_eq!(of_the_world(bench.takes_up(open.clone(), &mirror).await?), []);
    let (revision, facts) = bench.performer.root().await?;
    assert_eq!((revision, facts.len()), (Revision(1), 1));

    // Another run changes the world, and nothing is committed twice.
    let fact = FactKey { predicate: "other".to_owned(), arguments: Vec::new() };
    let changes = vec![Change::Set { fact: fact.clone(), value: Value::Int(1) }];
    bench.performer.world.commit("other/1/2", changes, None).await?;
    check_world(&place_of(&bench.endpoints), &open).await?;
    let changed = bench.takes_up(open.clone(), &mirror).await?;
    let facts = vec![(fact, Some(Value::Int(1)))];
    assert_eq!(of_the_world(changed), [Event::WorldChanged { revision: Revision(2), facts }]);
    // A pool that has lost its state.
    let later = Ledger { first_revision: Revision(9), ..open };
    let refused = check_world(&place_of(&bench.endpoints), &later).await;
    assert!(refused.is_err_and(|error| error.to_string().contains("lost its state")));
    bench.performer.closed().await
}

#[tokio::test]
async fn a_world_pool_that_has_none_of_the_commits_left_needs_the_whole_log() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let run = bench.performer.run.clone();
    let commit = |number: u64| Command::Commit {
        instance: InstanceId(number),
        writer: "place[1]".into(),
        evidence: Vec::new(),
        changes: done(),
        revision: Revision(number),
    };
    let whole = ledger(&run, &[commit(1), commit(2)]);
    // A checkpoint without the first commit, and a pool that has lost both.
    let mut short = ledger(&run, &[commit(2)]);
    short.forgotten = 1;
    assert!(remembers(&place_of(&bench.endpoints), &whole).await?);
    assert!(!remembers(&place_of(&bench.endpoints), &short).await?);
    let mut mirror = World::default();
    mirror.apply(&done())?;
    let refused = bench.takes_up(short.clone(), &mirror).await;
    assert!(refused.is_err_and(|error| error.to_string().contains("resume the run again")));
    assert_eq!(bench.performer.root().await?.0, Revision(0));
    // From the whole log both are made, and the checkpoint is enough from then on.
    assert_eq!(of_the_world(bench.takes_up(whole, &mirror).await?), []);
    assert_eq!(bench.performer.confirmed().commit, Revision(2));
    assert!(remembers(&place_of(&bench.endpoints), &short).await?);
    assert_eq!(of_the_world(bench.takes_up(short, &mirror).await?), []);
    assert_eq!(bench.performer.root().await?.0, Revision(2));
    bench.performer.closed().await
}

#[tokio::test]
async fn what_a_run_held_before_it_came_back_goes_back_at_rest_where_its_log_says_so() -> anyhow::Result<()> {
    let first = InstanceId(1);
    let ended = |at_rest| match finished(first) {
        Event::Finished { instance, attempt, outcome, outputs, measured, evidence, reason, .. } => {
            Event::Finished { instance, attempt, outcome, outputs, measured, evidence, reason, at_rest }
        }
        other => other,
    };
    let (reason, unknown, refused) = (String::new(), false, false);
    let crashed = Event::Crashed { instance: first, attempt: 1, reason, unknown, refused };
    for (end, was_under_way_back, at_rest) in [
        (ended(true), false, true),
        (ended(true), true, true),
        (ended(false), false, false),
        (ended(false), true, false),
        // It is looked for again, and not found.
        (crashed, false, false),
    ] {
        let bench = Bench::new().await?;
        let (channels, manager) = (Channels::new(&ClientTls::none()), &bench.endpoints.resource_manager);
        // Nobody confirms its standstill.
        let mover = Resource::new("mover", ResourceClass::Module, "Mover").with_standstill(SESSION_DEADLINE);
        ResourceClient::new(&channels, manager, bench._robot.id())?.create(mover).await?;
        let (run, resources) = (bench.performer.run.clone(), bench.performer.resources.clone());
        let requirements = vec![Requirement::new(ResourceOperation::Block, "Mover")];
        let lease = resources.acquire(requirements.clone(), AcquireOptions::default()).await?;
        let release = Command::Release { instance: first, lease: Some(lease.id), projection: None };
        let mut ledger = ledger(&run, &[Command::Acquire { instance: first, requirements, priority: 0 }]);
        ledger.event(Timestamp(0), &Event::Granted { instance: first, lease: lease.clone() });
        ledger.command(&start(first, 1, "work", lease.id, "unix:/nowhere"));
        ledger.event(Timestamp(0), &end);
        if was_under_way_back {
            ledger.command(&release);
        }
        let mut bench = bench.comes_back(true).await?;
        bench.takes_up(ledger, &World::default()).await?;
        if !was_under_way_back {
            bench.performer.perform(release)?;
        }
        let ending = loop {
            let mover = resources.get("mover").await?;
            if mover.holdings.is_empty() {
                break mover.ending;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        };
        assert_eq!(ending.is_empty(), at_rest, "{end:?}, {was_under_way_back}");
        bench.performer.closed().await?;
    }
    Ok(())
}
