//! Leases: asked for, handed over from one node to the next, withdrawn and given back.

use super::*;
use tokio::sync::oneshot;

#[tokio::test]
async fn an_acquire_of_the_event_that_gave_a_lease_back_can_be_withdrawn() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (instance, other) = (InstanceId(1), InstanceId(2));
    bench.ask(instance)?;
    let lease = Some(bench.granted(instance).await?);
    // Its worker died: it asks again, then gives back. Then its branch is not taken.
    bench.ask(instance)?;
    bench.performer.perform(Command::Release { instance, lease, projection: None })?;
    bench.performer.perform(Command::Withdraw { instance })?;
    bench.ask(other)?;
    bench.granted(other).await?;
    bench.performer.closed().await
}

#[tokio::test]
async fn the_next_node_takes_a_lease_over_until_others_get_their_turn() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let [first, second, third, fourth] = [1, 2, 3, 4].map(InstanceId);
    bench.ask(first)?;
    let lease = bench.granted(first).await?;
    bench.goes_on(first, lease, Some(second))?;
    assert_eq!(bench.granted(second).await?, lease);
    // Longer than `TURN`.
    tokio::time::sleep(Duration::from_millis(150)).await;
    bench.goes_on(second, lease, Some(third))?;
    let other = bench.granted(third).await?;
    assert_ne!(other, lease);

    // A lease that is handed to an instance whose acquire was withdrawn goes back.
    bench.goes_on(third, other, Some(fourth))?;
    bench.performer.perform(Command::Withdraw { instance: fourth })?;
    let handed = bench.answers.recv().await;
    assert_eq!(bench.performer.accept(handed.context("no answer")?, &World::default()), None);
    bench.ask(first)?;
    bench.granted(first).await?;
    bench.performer.closed().await
}

#[tokio::test]
async fn one_that_waits_takes_the_lease_over_and_leaves_the_queue() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let [first, second, third, fourth] = [1, 2, 3, 4].map(InstanceId);
    bench.ask(first)?;
    let lease = bench.granted(first).await?;
    for waits in [second, third, fourth] {
        bench.ask(waits)?;
    }
    // All three wait at the manager before the lease is given back.
    let deadline = Instant::now() + SESSION_DEADLINE;
    let manager = bench.performer.resources.clone();
    while manager.explain("").await?.len() < 3 && Instant::now() < deadline {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    bench.goes_on(first, lease, None)?;
    assert_eq!(bench.granted(second).await?, lease);
    bench.goes_on(second, lease, None)?;
    // A handed-over lease that is not wanted any more goes to the next instance.
    bench.performer.perform(Command::Withdraw { instance: third })?;
    let handed = bench.answers.recv().await.context("no answer")?;
    assert_eq!(bench.performer.accept(handed, &World::default()), None);
    let last = bench.granted(fourth).await?;
    assert_ne!(last, lease);
    while !manager.explain("").await?.is_empty() {
        assert!(Instant::now() < deadline, "somebody has left a request behind");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    bench.performer.perform(Command::Release { instance: fourth, lease: Some(last), projection: None })?;
    bench.ask(first)?;
    bench.granted(first).await?;
    bench.performer.closed().await
}

#[tokio::test]
async fn one_that_asks_again_in_the_step_that_gives_it_a_lease_has_it_once() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let [first, second] = [1, 2].map(InstanceId);
    bench.ask(first)?;
    let lease = bench.granted(first).await?;
    bench.ask(second)?;
    // A decision of the first instance makes the second one certain: it asks anew.
    let commands = vec![
        Command::Withdraw { instance: second },
        Command::Acquire { instance: second, requirements: arm(), priority: CERTAIN },
        Command::Release { instance: first, lease: Some(lease), projection: None },
    ];
    bench.steps(&finished(first), commands)?;
    assert_eq!(bench.granted(second).await?, lease);
    // No further lease is granted or given back.
    let more = tokio::time::timeout(Duration::from_millis(100), bench.event()).await;
    assert!(more.is_err(), "{more:?}");
    let held = bench.performer.resources.list(&["Arm"]).await?;
    assert_eq!(held.iter().flat_map(|arm| &arm.holdings).map(|one| one.lease).collect::<Vec<_>>(), [lease]);
    bench.performer.closed().await
}

#[tokio::test]
async fn a_run_hears_of_who_waits_beside_it_for_what_it_holds_and_needs_that_for_certain() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (holder, waiter) = (InstanceId(1), InstanceId(2));
    bench.ask(holder)?;
    bench.granted(holder).await?;
    let (events, _answers) = mpsc::channel(8);
    let mut other = connect(&bench.endpoints, "other", events).await?;
    // A speculative acquire does not make others give way.
    other.perform(Command::Acquire { instance: waiter, requirements: arm(), priority: 7 })?;
    let quiet = tokio::time::timeout(Duration::from_secs(2), bench.event()).await;
    assert!(quiet.is_err(), "{quiet:?}");
    other.perform(Command::Withdraw { instance: waiter })?;
    other.perform(Command::Acquire { instance: waiter, requirements: arm(), priority: CERTAIN })?;
    assert_eq!(bench.event().await, Some(Event::WantedByOthers { holders: vec![holder] }));
    other.closed().await?;
    bench.performer.closed().await
}

#[tokio::test]
async fn a_lease_that_goes_back_while_the_manager_is_away_for_long_is_back_when_that_is() -> anyhow::Result<()> {
    let place = tempfile::tempdir()?;
    let directory = RuntimeDirectory::create(place.path())?;
    let (shutdown, ended) = manager_at(&directory);
    let (mut bench, _robot) = with_manager_at(&directory).await?;
    let (first, second) = (InstanceId(1), InstanceId(2));
    bench.ask(first)?;
    let lease = bench.granted(first).await?;
    shutdown.cancel();
    ended.await;
    bench.performer.perform(Command::Release { instance: first, lease: Some(lease), projection: None })?;
    // Longer than 16 tries, and shorter than a run waits for the manager.
    tokio::time::sleep(Duration::from_millis(5_500)).await;
    let (_again, _ended) = manager_at(&directory);
    bench.ask(second)?;
    let next =
        tokio::time::timeout(Duration::from_secs(8), bench.granted(second)).await.context("it waits for itself")??;
    assert_ne!(next, lease);
    bench.performer.closed().await
}

#[tokio::test]
async fn an_acquire_that_a_bound_refuses_is_asked_for_again_until_there_is_room() -> anyhow::Result<()> {
    let place = tempfile::tempdir()?;
    let directory = RuntimeDirectory::create(place.path())?;
    let mut config = ResourceManagerConfig::default();
    config.limits.waiters_per_session = 1;
    let shutdown = CancellationToken::new();
    tokio::spawn(resource_manager::run(config, directory.clone(), shutdown.clone()));
    let _shutdown = shutdown.drop_guard();
    let (mut bench, _robot) = with_manager_at(&directory).await?;
    let [first, second, third] = [1, 2, 3].map(InstanceId);
    bench.ask(first)?;
    let lease = bench.granted(first).await?;
    bench.ask(second)?;
    while bench.performer.resources.explain("").await?.is_empty() {
        tokio::task::yield_now().await;
    }
    bench.ask(third)?;
    let early = tokio::time::timeout(Duration::from_millis(300), bench.event()).await;
    assert!(early.is_err(), "{early:?}");
    bench.performer.perform(Command::Release { instance: first, lease: Some(lease), projection: None })?;
    let lease = bench.granted(second).await?;
    bench.performer.perform(Command::Release { instance: second, lease: Some(lease), projection: None })?;
    bench.granted(third).await?;
    bench.performer.closed().await
}

#[tokio::test]
async fn what_may_not_be_needed_is_not_refused_for_how_long_it_waits() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let [first, second, third] = [1, 2, 3].map(InstanceId);
    bench.ask(first)?;
    let lease = bench.granted(first).await?;
    let hurried = |performer: &Performer, instance: InstanceId, speculative: bool| {
        let (_, handed) = oneshot::channel();
        let (request, deadline) = (format!("{}/hurried/{instance}", performer.run), Duration::from_millis(100));
        let (resources, world, told) = (&performer.resources, &performer.world, &performer.told);
        let acquiring = Acquiring {
            instance,
            requirements: arm(),
            catalogue: performer.catalogue.clone(),
            options: AcquireOptions { request, speculative, deadline, ..AcquireOptions::default() },
            waited: Duration::ZERO,
            after: Vec::new(),
            withdrawn: CancellationToken::new(),
            handed,
            resources: resources.clone(),
            trust: performer.trust.clone(),
            told: told.clone(),
            doubtful: performer.goals.doubtful.clone(),
            whom: Whom { resources: resources.clone(), world: world.clone(), told: told.clone() },
            over: Arc::new(CancellationToken::new().drop_guard()),
        };
        tokio::spawn(acquiring.ask(performer.events.clone()));
    };
    hurried(&bench.performer, second, true);
    while bench.performer.resources.explain("").await?.is_empty() {
        tokio::task::yield_now().await;
    }
    hurried(&bench.performer, third, false);
    // It has asked later, with the same time limit.
    let refused = bench.event().await;
    assert!(matches!(refused, Some(Event::Refused { instance, .. }) if instance == third), "{refused:?}");
    bench.performer.perform(Command::Release { instance: first, lease: Some(lease), projection: None })?;
    bench.granted(second).await?;
    bench.performer.closed().await
}

#[tokio::test]
async fn what_is_handed_to_one_that_is_withdrawn_before_it_has_asked_goes_back() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let [first, second, third] = [1, 2, 3].map(InstanceId);
    bench.ask(first)?;
    let lease = bench.granted(first).await?;
    let (disk, slow) = Mark::not_yet();
    let operate = Command::Operate { instance: first, operations: vec![create("Box", 1)] };
    bench.performer.perform_when(Some(slow), operate)?;
    // The acquire waits for the operation. When that is done, and before the acquire notices, it is handed a lease and withdrawn.
    bench.ask(second)?;
    tokio::task::yield_now().await;
    bench.performer.order.operating.all().iter().for_each(CancellationToken::cancel);
    bench.goes_on(first, lease, None)?;
    bench.performer.perform(Command::Withdraw { instance: second })?;
    bench.ask(third)?;
    let next = tokio::time::timeout(SESSION_DEADLINE, bench.granted(third)).await.context("nobody gives it back")??;
    assert_ne!(next, lease);
    drop(disk);
    Ok(())
}

#[tokio::test]
async fn a_grant_that_crosses_its_withdrawal_is_back_before_what_it_held_is_deleted() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let [first, second] = [1, 2].map(InstanceId);
    bench.performer.perform(Command::Operate { instance: first, operations: vec![create("Token", 1)] })?;
    let requirements = vec![Requirement::new(ResourceOperation::Block, "Token")];
    bench.performer.perform(Command::Acquire { instance: second, requirements, priority: 0 })?;
    while bench.answers.len() < 2 {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    // Its grant is under way, behind the news that the token exists. A race is decided: the state around it is left and deletes the token.
    bench.performer.perform(Command::Withdraw { instance: second })?;
    let delete = Requirement::new(ResourceOperation::Delete, "Token");
    bench.performer.perform(Command::Operate { instance: first, operations: vec![delete] })?;
    tokio::time::sleep(Duration::from_millis(200)).await;
    let quiet = tokio::time::timeout(Duration::from_millis(300), bench.event()).await;
    assert!(quiet.is_err(), "{quiet:?}");
    assert_eq!(bench.units("Token").await?, 0);
    bench.performer.closed().await
}

#[tokio::test]
async fn a_grant_that_crosses_its_withdrawal_goes_back() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let instance = InstanceId(1);
    bench.ask(instance)?;
    let granted = bench.answers.recv().await;
    bench.performer.perform(Command::Withdraw { instance })?;
    assert_eq!(bench.performer.accept(granted.context("no answer")?, &World::default()), None);

    // Nobody holds the arm: the same instance gets it when it asks again.
    bench.ask(instance)?;
    bench.granted(instance).await?;
    bench.performer.closed().await
}

#[test]
fn what_was_handed_over_did_not_go_back() {
    let mut ledger = Ledger::default();
    let lease =
        |id: u64| Lease { id: LeaseId(id), token: FencingToken(id), resources: Vec::new(), consumed: Vec::new() };
    for id in [7, 8] {
        ledger.event(Timestamp(0), &Event::Granted { instance: InstanceId(id), lease: lease(id) });
    }
    ledger.command(&commits(1, 2));
    for id in [7, 8] {
        let release = Command::Release { instance: InstanceId(id), lease: Some(LeaseId(id)), projection: None };
        ledger.command(&release);
    }
    ledger.event(Timestamp(0), &Event::Granted { instance: InstanceId(3), lease: lease(7) });
    assert_eq!(ledger.went_back.iter().map(|one| one.lease).collect::<Vec<_>>(), [LeaseId(8)]);
    ledger.forget(Confirmed { commit: Revision(2), ..Confirmed::default() });
    assert!(ledger.went_back.is_empty(), "nobody waits for what is there");
}
