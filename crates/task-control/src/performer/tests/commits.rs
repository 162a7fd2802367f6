//! Commits that nobody answers.

use super::*;

#[tokio::test]
async fn a_commit_that_is_not_answered_is_not_made_when_the_session_is_gone() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let place = tempfile::tempdir()?;
    let directory = RuntimeDirectory::create(place.path())?;
    let pool = || {
        let shutdown = CancellationToken::new();
        let running = world_pool::run(WorldPoolConfig::default(), directory.clone(), shutdown.clone());
        (shutdown, tokio::spawn(running))
    };
    let (shutdown, ended) = pool();
    bench.endpoints.world_pool = directory.wait_for(world_pool::ROLE, SESSION_DEADLINE).await?;
    let (events, answers) = mpsc::channel(8);
    let performer = connect(&bench.endpoints, "task", events).await?;
    std::mem::replace(&mut bench.performer, performer).closed().await?;
    bench.answers = answers;
    bench.performer.root().await?;
    // The commit is sent while the session lives and the pool is absent.
    shutdown.cancel();
    drop(ended.await);
    bench.performer.perform(Command::Commit {
        instance: InstanceId(1),
        writer: "place[1]".into(),
        evidence: Vec::new(),
        changes: done(),
        revision: Revision(1),
    })?;
    tokio::time::sleep(Duration::from_millis(300)).await;
    // The session ends at the manager, under whose id it is opened anew: all leases are gone.
    let channels = Channels::new(&ClientTls::none());
    let manager = &bench.endpoints.resource_manager;
    let same = Session::open_as(&channels, manager, bench.performer.run.clone(), "the end", DEFAULT_TTL);
    same.alive(SESSION_DEADLINE).await?;
    same.close().await;
    bench.performer.lost().await;
    // The present holder of the resources commits the same fact; both can reach the pool again.
    let (_again, _ended) = pool();
    let world = WorldClient::new(&channels, &bench.endpoints.world_pool)?;
    let fact = FactKey { predicate: "done".to_owned(), arguments: Vec::new() };
    let changes = vec![Change::Set { fact, value: Value::Bool(false) }];
    retry_unanswered(|| world.commit("other/i1/1", changes.clone(), None)).await?;
    // The run may hear of the other commit before, with its own decisions on top.
    let failed = async {
        loop {
            match bench.event().await {
                Some(Event::WorldChanged { .. }) => {}
                event => return event,
            }
        }
    };
    let event = tokio::time::timeout(SESSION_DEADLINE, failed).await?;
    let Some(Event::RetirementFailed { reason, .. }) = event else { bail!("it was to fail: {event:?}") };
    assert!(reason.contains("the run's session was lost"), "{reason}");
    let (revision, facts) = retry_unanswered(|| world.root()).await?;
    assert_eq!((revision, facts.len()), (Revision(1), 1));
    assert_eq!(facts[0].value, Value::Bool(false), "what the others know of stands");
    bench.performer.closed().await.expect_err("that is not recorded");
    Ok(())
}

#[tokio::test]
async fn a_run_whose_effects_are_not_all_recorded_does_not_end_well() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    // The increase of this fact must fail.
    let fact = FactKey { predicate: "done".to_owned(), arguments: Vec::new() };
    let mut changes = done();
    changes.push(Change::Increase { fact, by: 1.0 });
    bench.performer.perform(Command::Commit {
        instance: InstanceId(1),
        writer: "place[1]".into(),
        evidence: Vec::new(),
        changes,
        revision: Revision(99),
    })?;
    let ended = bench.performer.closed().await;
    assert!(ended.is_err_and(|error| error.to_string().contains("not all recorded")));
    Ok(())
}
