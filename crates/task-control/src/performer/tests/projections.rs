//! Projections: promised, made, cancelled and given back.

use super::*;

#[tokio::test]
async fn a_projection_that_crosses_its_cancel_goes_back() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (instance, reads) = (InstanceId(1), Footprint::Everything);
    bench.ask(instance)?;
    bench.granted(instance).await?;
    let project = |attempt| Command::Project {
        instance,
        attempt,
        base: Revision(0),
        changes: Vec::new(),
        writers: Vec::new(),
        reads: reads.clone(),
        lease: None,
        first: true,
    };
    bench.performer.perform(project(1))?;
    let made = bench.answers.recv().await;
    bench.performer.perform(Command::Cancel { instance, attempt: 1 })?;
    assert_eq!(bench.performer.accept(made.context("no answer")?, &World::default()), None);
    assert!(bench.performer.cancelled.lock().is_ok_and(|cancelled| cancelled.is_empty()));
    bench.performer.perform(project(2))?;
    assert!(matches!(bench.event().await, Some(Event::Projected { attempt: 2, .. })));
    bench.performer.closed().await
}

/// A projection of all facts, without a lease.
fn projection(instance: InstanceId, attempt: u32, first: bool) -> Command {
    Command::Project {
        instance,
        attempt,
        base: Revision(0),
        changes: Vec::new(),
        writers: Vec::new(),
        reads: Footprint::Everything,
        lease: None,
        first,
    }
}

#[tokio::test]
async fn a_projection_is_named_before_it_is_there_and_shows_the_commit_on_its_way() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let instance = InstanceId(1);
    // The first projection is waited for; its answer promises further ids.
    bench.performer.perform(projection(instance, 1, false))?;
    let Some(Event::Projected { projection: first, .. }) = bench.event().await else { bail!("no projection") };
    bench.performer.perform(Command::Commit {
        instance,
        writer: "place[1]".into(),
        evidence: Vec::new(),
        changes: done(),
        revision: Revision(1),
    })?;
    bench.performer.perform(projection(instance, 2, false))?;
    // No other task has run since: the world pool was not asked.
    let Ok(answer) = bench.answers.try_recv() else { bail!("it waits for the world pool") };
    let named = bench.performer.accept(answer, &World::default());
    let Some(Event::Projected { attempt: 2, projection: named, .. }) = named else { bail!("{named:?}") };
    assert_ne!(first, named);
    let world = WorldClient::new(&Channels::new(&ClientTls::none()), &bench.endpoints.world_pool)?;
    assert_eq!(world.query(Some(named), &[]).await?.len(), 1, "it shows the commit, and is waited for");
    bench.performer.perform(Command::Release { instance, lease: None, projection: Some(named) })?;
    // A goal that changes the environment begins when its projection exists.
    bench.performer.perform(projection(instance, 3, true))?;
    assert!(bench.answers.try_recv().is_err());
    assert!(matches!(bench.event().await, Some(Event::Projected { attempt: 3, .. })));
    bench.performer.closed().await?;
    let gone = world.query(Some(named), &[]).await;
    assert_eq!(gone.map_err(|error| error.reason().to_owned()).err().as_deref(), Some("PROJECTION_UNKNOWN"));
    Ok(())
}

#[tokio::test]
async fn a_projection_that_was_named_and_not_asked_for_before_the_kill_is_asked_for_by_who_comes_back()
-> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let instance = InstanceId(1);
    bench.performer.perform(projection(instance, 1, false))?;
    assert!(matches!(bench.event().await, Some(Event::Projected { .. })));
    // The next projection has an id; task control is killed when it has logged that.
    let named = bench.performer.promises.take(0, Instant::now()).context("nothing is promised")?;
    let mut ledger = ledger(&bench.performer.run, &[projection(instance, 2, false)]);
    ledger.event(Timestamp(0), &Event::Projected { instance, attempt: 2, projection: named });
    let mut bench = bench.comes_back(true).await?;
    bench.takes_up(ledger, &World::default()).await?;
    let world = WorldClient::new(&Channels::new(&ClientTls::none()), &bench.endpoints.world_pool)?;
    assert!(world.query(Some(named), &[]).await?.is_empty());
    bench.performer.perform(Command::Release { instance, lease: None, projection: Some(named) })?;
    bench.performer.closed().await?;
    let gone = world.query(Some(named), &[]).await;
    assert_eq!(gone.map_err(|error| error.reason().to_owned()).err().as_deref(), Some("PROJECTION_UNKNOWN"));
    Ok(())
}

#[tokio::test]
async fn of_a_named_projection_that_cannot_be_made_is_heard_afterwards() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let instance = InstanceId(1);
    bench.performer.perform(projection(instance, 1, false))?;
    assert!(matches!(bench.event().await, Some(Event::Projected { .. })));
    let mut ahead = projection(instance, 2, false);
    if let Command::Project { base, .. } = &mut ahead {
        *base = Revision(9);
    }
    bench.performer.perform(ahead)?;
    let Some(Event::Projected { projection: named, .. }) = bench.event().await else { bail!("no projection") };
    let Some(Event::Crashed { attempt: 2, reason, .. }) = bench.event().await else { bail!("not heard of") };
    assert!(reason.contains("no projection"), "{reason}");
    let world = WorldClient::new(&Channels::new(&ClientTls::none()), &bench.endpoints.world_pool)?;
    let refused = world.query(Some(named), &[]).await;
    assert_eq!(refused.map_err(|error| error.reason().to_owned()).err().as_deref(), Some("PROJECTION_UNKNOWN"));
    // The release of a projection that was not made must not hang.
    bench.performer.perform(Command::Release { instance, lease: None, projection: Some(named) })?;
    bench.performer.closed().await
}

#[tokio::test]
async fn a_projection_behind_a_commit_that_waits_for_the_disk_leaves_with_it_and_wakes_the_pool_once()
-> anyhow::Result<()> {
    let bench = Bench::new().await?;
    let (place, channels) = (tempfile::tempdir()?, Channels::new(&ClientTls::none()));
    let pool = place.path().join("pool.sock");
    // The socket answers nothing: the test checks whether it is called at all.
    let listener = tokio::net::UnixListener::bind(&pool)?;
    let (events, _answers) = mpsc::channel(8);
    let recorder = Recorder {
        run: bench.performer.run.clone(),
        world: WorldClient::new(&channels, &Endpoint::Unix(pool))?,
        resources: bench.performer.resources.clone(),
        cancelled: Cancelled::default(),
        waiting: Recording::default(),
        done: Recorded::default(),
        events,
        trust: bench.performer.trust.clone(),
        session: bench.performer.number,
        trace: TraceContext::fresh(),
        root: Root::default(),
        promises: Promises::default(),
    };
    let (records, work) = mpsc::channel(8);
    let _recorder = AbortOnDropHandle::new(tokio::spawn(recorder.work(work)));
    let (disk, slow) = Mark::not_yet();
    let instance = InstanceId(1);
    let decided = Decided {
        instance,
        writer: String::new(),
        changes: done(),
        evidence: Vec::new(),
        revision: Revision(1),
        began: Began::default(),
        guard: None,
        knew: Revision::default(),
        behind: 0,
    };
    records.send(Record::Commit { decided, untouched: None, safe: Some(slow) }).await?;
    let asked = Projecting {
        attempt: 1,
        base: Revision(1),
        changes: Vec::new(),
        writers: Vec::new(),
        reads: Footprint::Everything,
        lease: None,
        first: true,
        named: None,
    };
    records.send(Record::Project { instance: InstanceId(2), asked, named: None }).await?;
    let early = tokio::time::timeout(Duration::from_millis(200), listener.accept()).await;
    assert!(early.is_err(), "the projection went ahead of its commit");
    disk.send_replace(1);
    tokio::time::timeout(SESSION_DEADLINE, listener.accept()).await??;
    bench.performer.closed().await
}
