//! Operations of a run (`create`, `delete`, `consume`) relative to its leases, and at its end.

use super::super::closing::CLOSE_DEADLINE;
use super::*;

#[tokio::test]
async fn an_operation_at_the_end_of_a_run_waits_for_a_manager_that_is_away_and_for_what_goes_back_before_it()
-> anyhow::Result<()> {
    let place = tempfile::tempdir()?;
    let directory = RuntimeDirectory::create(place.path())?;
    let (shutdown, ended) = manager_at(&directory);
    let (mut bench, _robot) = with_manager_at(&directory).await?;
    let instance = InstanceId(1);
    bench.ask(instance)?;
    let lease = bench.granted(instance).await?;
    shutdown.cancel();
    ended.await;
    bench.performer.perform(Command::Release { instance, lease: Some(lease), projection: None })?;
    bench.performer.perform(Command::Operate { instance, operations: vec![create("Box", 1)] })?;
    let back = async {
        tokio::time::sleep(Duration::from_millis(4_500)).await;
        let (again, _ended) = manager_at(&directory);
        again
    };
    let (closed, _again) = tokio::join!(bench.performer.closed(), back);
    closed
}

#[tokio::test]
async fn the_last_operation_of_a_run_waits_for_a_manager_that_is_away_and_the_world_pool_is_not_named()
-> anyhow::Result<()> {
    for comes_back in [true, false] {
        let place = tempfile::tempdir()?;
        let directory = RuntimeDirectory::create(place.path())?;
        let (shutdown, ended) = manager_at(&directory);
        let (mut bench, _robot) = with_manager_at(&directory).await?;
        shutdown.cancel();
        ended.await;
        bench.performer.perform(Command::Operate { instance: InstanceId(1), operations: vec![create("Box", 1)] })?;
        while bench.performer.recording.get() != WaitsFor::ResourceManager {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        assert!(WaitsFor::ResourceManager.to_string().starts_with("the resource manager"));
        let back = async {
            // Longer than `CLOSE_DEADLINE`, the limit for everything but operations.
            tokio::time::sleep(CLOSE_DEADLINE + Duration::from_millis(1_500)).await;
            comes_back.then(|| manager_at(&directory))
        };
        let (closed, _manager) = tokio::join!(bench.performer.closed(), back);
        match closed {
            Ok(()) => assert!(comes_back),
            Err(refused) => assert!(!comes_back && !refused.to_string().contains("world pool"), "{refused}"),
        }
    }
    Ok(())
}

#[tokio::test]
async fn behind_an_operation_that_was_refused_nothing_is_committed() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let gone = Requirement::new(ResourceOperation::Delete, "Nothing");
    bench.performer.perform(Command::Operate { instance: InstanceId(1), operations: vec![gone] })?;
    let commit = Command::Commit {
        instance: InstanceId(2),
        writer: "place[1]".into(),
        evidence: Vec::new(),
        changes: done(),
        revision: Revision(1),
    };
    bench.performer.perform(commit)?;
    let refused = bench.performer.closed().await.map_err(|error| error.to_string());
    assert!(refused.is_err_and(|reason| reason.contains("Nothing")));
    let world = WorldClient::new(&Channels::new(&ClientTls::none()), &bench.endpoints.world_pool)?;
    assert_eq!(world.root().await?.0, Revision(0));
    Ok(())
}

#[tokio::test]
async fn what_is_asked_for_behind_a_deletion_does_not_get_what_is_deleted() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let [first, second, third] = [1, 2, 3].map(InstanceId);
    let of = |color: &str| {
        let color = BTreeMap::from([("color".to_owned(), Value::String(color.to_owned()))]);
        Requirement { attributes: color, ..create("Token", 1) }
    };
    let delete = Requirement::new(ResourceOperation::Delete, "Token");
    let block = |kind: &str| vec![Requirement::new(ResourceOperation::Block, kind)];
    let operate = |operation: Requirement| Command::Operate { instance: first, operations: vec![operation] };
    bench.performer.perform(operate(of("red")))?;
    let acquire = |instance, kind| Command::Acquire { instance, requirements: block(kind), priority: 0 };
    bench.performer.perform(acquire(first, "Token"))?;
    let lease = bench.granted(first).await?;
    // The commands of one step: release, delete, acquire. The disk is slow.
    let (disk, slow) = Mark::not_yet();
    bench.performer.perform(Command::Release { instance: first, lease: Some(lease), projection: None })?;
    bench.performer.perform_when(Some(slow), operate(delete))?;
    bench.performer.perform(acquire(second, "Token"))?;
    bench.performer.perform(Command::Acquire { instance: third, requirements: arm(), priority: 0 })?;
    let early = tokio::time::timeout(Duration::from_millis(200), bench.event()).await;
    assert!(early.is_err(), "{early:?}");
    drop(disk);
    // The disk is gone: the failure comes first.
    let failed = bench.event().await;
    assert!(matches!(&failed, Some(Event::RetirementFailed { .. })), "{failed:?}");
    bench.performer.closed().await.expect_err("what was deleted is there");
    Ok(())
}

#[tokio::test]
async fn a_lease_is_back_before_what_it_held_is_used_up() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let [first, second] = [1, 2].map(InstanceId);
    let operate = |operation: Requirement| Command::Operate { instance: first, operations: vec![operation] };
    let consume = Requirement::new(ResourceOperation::Consume, "Token");
    for _ in 0..20 {
        // The only token, so that only what was given back can be used up.
        bench.performer.perform(operate(create("Token", 1)))?;
        let all = Requirement { count: 1.into(), ..Requirement::new(ResourceOperation::Block, "Token") };
        bench.performer.perform(Command::Acquire { instance: second, requirements: vec![all], priority: 0 })?;
        let lease = bench.granted(second).await?;
        bench.performer.perform(Command::Release { instance: second, lease: Some(lease), projection: None })?;
        bench.performer.perform(operate(consume.clone()))?;
    }
    // No token is left: an acquire behind the consume waits.
    let exists = vec![Requirement::new(ResourceOperation::Exists, "Token")];
    bench.performer.perform(Command::Acquire { instance: first, requirements: exists, priority: 0 })?;
    let early = tokio::time::timeout(Duration::from_millis(300), bench.event()).await;
    assert!(early.is_err(), "{early:?}");
    bench.performer.closed().await
}
