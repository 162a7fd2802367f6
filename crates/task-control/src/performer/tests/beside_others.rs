//! A run beside other runs: who is served next, and what a new holder has been told.

use super::super::waiting::LONG_BESIDE_OTHERS;
use super::*;

#[tokio::test]
async fn who_waits_beside_others_while_the_manager_is_started_again_is_served_and_not_refused() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let place = tempfile::tempdir()?;
    let directory = RuntimeDirectory::create(place.path())?;
    let (shutdown, ended) = manager_at(&directory);
    let resource_manager = directory.wait_for(resource_manager::ROLE, SESSION_DEADLINE).await?;
    bench.endpoints.resource_manager = resource_manager;
    let (channels, manager) = (Channels::new(&ClientTls::none()), &bench.endpoints.resource_manager);
    let robot = Session::open(&channels, manager, "robot", DEFAULT_TTL);
    robot.alive(SESSION_DEADLINE).await?;
    let offering = ResourceClient::new(&channels, manager, robot.id())?;
    offering.create(Resource::new("arm", ResourceClass::Module, "Arm")).await?;
    let lease = offering.acquire(arm(), AcquireOptions::default()).await?;

    let (events, _first) = mpsc::channel(8);
    let first = connect(&bench.endpoints, "first", events).await?;
    let (events, mut answers) = mpsc::channel(8);
    let mut second = connect(&bench.endpoints, "second", events).await?;
    assert!(second.told.has_others());
    second.perform(Command::Acquire { instance: InstanceId(1), requirements: arm(), priority: CERTAIN })?;
    // The manager is absent when the node has waited long enough to come next.
    tokio::time::sleep(LONG_BESIDE_OTHERS / 2).await;
    shutdown.cancel();
    ended.await;
    tokio::time::sleep(LONG_BESIDE_OTHERS).await;
    let (_again, _ended) = manager_at(&directory);
    offering.release(lease.id).await?;
    let answer = answers.recv().await.context("no answer")?;
    let Answer::Event { event, .. } = answer else { bail!("{answer:?}") };
    assert!(matches!(*event, Event::Granted { .. }), "{event:?}");
    first.closed().await?;
    second.closed().await
}

#[tokio::test]
async fn a_run_goes_beside_others_and_one_that_goes_alone_does_not() -> anyhow::Result<()> {
    let bench = Bench::new().await?;
    let events = || mpsc::channel(1).0;
    let second = connect(&bench.endpoints, "second", events()).await?;
    let alone = Place { alone: true, ..place_of(&bench.endpoints) };
    let refused = Performer::connect(&alone, "run-3", &task("third"), None, TraceContext::fresh(), events())
        .await
        .err()
        .context("it went")?;
    assert!(refused.to_string().contains("another run is under way on this system (`"), "{refused}");
    second.closed().await?;
    bench.performer.closed().await?;
    let third = Performer::connect(&alone, "run-3", &task("third"), None, TraceContext::fresh(), events()).await?;
    let fourth = connect(&bench.endpoints, "fourth", events()).await.err().context("it went")?;
    assert!(fourth.to_string().starts_with("`third` is under way on this system and goes alone"), "{fourth}");
    third.closed().await
}

#[tokio::test]
async fn who_gets_what_another_run_had_has_been_told_what_that_had_committed() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (events, mut answers) = mpsc::channel(16);
    let mut second = connect(&bench.endpoints, "second", events).await?;
    bench.performer.root().await?;
    second.root().await?;
    let fact = FactKey { predicate: "round".to_owned(), arguments: Vec::new() };
    let began = Instant::now();
    for round in 1..=20 {
        let (first, other) = (InstanceId(2 * round), InstanceId(2 * round + 1));
        bench.ask(first)?;
        let (lease, _) = granted_after(&mut bench.performer, &mut bench.answers).await?;
        second.perform(Command::Acquire { instance: other, requirements: arm(), priority: 0 })?;
        let value = Value::Int(i64::try_from(round)?);
        bench.performer.perform(Command::Commit {
            instance: first,
            writer: "place".into(),
            changes: vec![Change::Set { fact: fact.clone(), value: value.clone() }],
            evidence: Vec::new(),
            revision: Revision(1_000 + round),
        })?;
        bench.performer.perform(Command::Release { instance: first, lease: Some(lease), projection: None })?;
        let (lease, told) = granted_after(&mut second, &mut answers).await?;
        assert_eq!(told, Some((fact.clone(), Some(value))));
        second.perform(Command::Release { instance: other, lease: Some(lease), projection: None })?;
    }
    // A run that begins only now does not wait for the earlier commit either.
    let (events, mut answers) = mpsc::channel(16);
    let mut third = connect(&bench.endpoints, "third", events).await?;
    third.root().await?;
    third.perform(Command::Acquire { instance: InstanceId(1), requirements: arm(), priority: 0 })?;
    granted_after(&mut third, &mut answers).await?;
    third.closed().await?;
    // No wait ran into its limit.
    assert!(began.elapsed() < Duration::from_secs(2), "{:?}", began.elapsed());
    second.closed().await?;
    bench.performer.closed().await
}

#[tokio::test]
async fn what_was_left_is_told_to_the_next_holder_when_the_last_one_gave_up_before_it_was_told() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (events, _unheard) = mpsc::channel(16);
    let mut second = connect(&bench.endpoints, "second", events).await?;
    let (events, mut answers) = mpsc::channel(16);
    let mut third = connect(&bench.endpoints, "third", events).await?;
    for performer in [&mut bench.performer, &mut second, &mut third] {
        performer.root().await?;
    }
    let (first, instance) = (InstanceId(1), InstanceId(2));
    bench.ask(first)?;
    let (lease, _) = granted_after(&mut bench.performer, &mut bench.answers).await?;
    // Its commit is under way for long.
    bench.performer.resources.release_with_note(lease, "0 12".to_owned(), true).await?;
    second.perform(Command::Acquire { instance, requirements: arm(), priority: 0 })?;
    let holds = async |performer: &Performer| {
        let arms = performer.resources.list(&["Arm"]).await?;
        anyhow::Ok(arms.iter().any(|arm| arm.holdings.iter().any(|holding| holding.session == performer.run)))
    };
    while !holds(&second).await? {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    second.perform(Command::Withdraw { instance })?;
    third.perform(Command::Acquire { instance, requirements: arm(), priority: 0 })?;
    let early = tokio::time::timeout(Duration::from_millis(300), granted_after(&mut third, &mut answers)).await;
    assert!(early.is_err() && holds(&third).await?, "{early:?}");
    bench.performer.perform(Command::Commit {
        instance: first,
        writer: "place".into(),
        changes: done(),
        evidence: Vec::new(),
        revision: Revision(12),
    })?;
    granted_after(&mut third, &mut answers).await?;
    third.closed().await?;
    second.closed().await?;
    bench.performer.closed().await
}

#[tokio::test]
async fn a_run_that_asks_again_and_again_with_the_highest_priority_lets_another_one_pass() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (events, mut answers) = mpsc::channel(16);
    let mut second = connect(&bench.endpoints, "second", events).await?;
    let ask = |performer: &mut Performer, instance: u64, priority: i64| {
        performer.perform(Command::Acquire { instance: InstanceId(instance), requirements: arm(), priority })
    };
    ask(&mut bench.performer, 1, i64::MAX)?;
    let mut lease = bench.granted(InstanceId(1)).await?;
    ask(&mut second, 1, CERTAIN)?;
    let waiting = granted_after(&mut second, &mut answers);
    tokio::pin!(waiting);
    let (began, mut turns) = (Instant::now(), 1);
    // It asks for its next turn before it gives this lease back.
    while tokio::time::timeout(Duration::from_millis(50), &mut waiting).await.is_err() {
        assert!(began.elapsed() < 5 * LONG_BESIDE_OTHERS, "it is never let pass");
        ask(&mut bench.performer, turns + 1, i64::MAX)?;
        bench.performer.perform(Command::Release {
            instance: InstanceId(turns),
            lease: Some(lease),
            projection: None,
        })?;
        turns += 1;
        lease = match tokio::time::timeout(Duration::from_secs(1), bench.granted(InstanceId(turns))).await {
            Ok(granted) => granted?,
            Err(_) => break,
        };
    }
    assert!(turns > 20 && began.elapsed() < 3 * LONG_BESIDE_OTHERS, "{turns} turns, {:?}", began.elapsed());
    Ok(())
}
