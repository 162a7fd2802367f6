//! A performer with a real resource manager and world pool.

use super::*;
use crate::task_control::Endpoints;
use ratn_daemon::resource_manager::{self, ResourceManagerConfig};
use ratn_daemon::world_pool::{self, WorldPoolConfig};
use ratn_model::fact::{Change, Footprint};
use ratn_model::resource::ResourceOperation;
use ratn_worker::client::fresh_id;
use ratn_worker::runtime_directory::RuntimeDirectory;
use tokio_util::sync::DropGuard;

async fn connect(endpoints: &Endpoints, task: &str, events: mpsc::Sender<Answer>) -> anyhow::Result<Performer> {
    let place = Place {
        endpoints: endpoints.clone(),
        directory: std::path::PathBuf::new(),
        catalogue: Arc::default(),
        speed: 1.0,
    };
    Performer::connect(&place, &fresh_id("run"), task, events).await
}

fn arm() -> Vec<Requirement> {
    vec![Requirement {
        operation: ResourceOperation::Block,
        kind: "Arm".into(),
        class: None,
        attributes: BTreeMap::new(),
        count: 1,
    }]
}

/// A performer with a resource manager, a world pool and one arm.
struct Bench {
    performer: Performer,
    answers: mpsc::Receiver<Answer>,
    endpoints: Endpoints,
    _place: tempfile::TempDir,
    _shutdown: DropGuard,
}

impl Bench {
    async fn new() -> anyhow::Result<Bench> {
        let place = tempfile::tempdir()?;
        let directory = RuntimeDirectory::create(place.path())?;
        let shutdown = CancellationToken::new();
        tokio::spawn(resource_manager::run(ResourceManagerConfig::default(), directory.clone(), shutdown.clone()));
        tokio::spawn(world_pool::run(WorldPoolConfig::default(), directory.clone(), shutdown.clone()));
        let endpoints = Endpoints {
            resource_manager: directory.wait_for(resource_manager::ROLE, SESSION_DEADLINE).await?,
            world_pool: directory.wait_for(world_pool::ROLE, SESSION_DEADLINE).await?,
        };
        let (events, answers) = mpsc::channel(8);
        let performer = connect(&endpoints, "task", events).await?;
        performer.resources.create(Resource::new("arm", ResourceClass::Module, "Arm")).await?;
        Ok(Bench { performer, answers, endpoints, _place: place, _shutdown: shutdown.drop_guard() })
    }

    fn ask(&mut self, instance: InstanceId) -> anyhow::Result<()> {
        self.performer.perform(Command::Acquire { instance, requirements: arm(), priority: 0 })
    }

    /// The next event that the executive is given.
    async fn event(&mut self) -> Option<Event> {
        loop {
            let answer = self.answers.recv().await?;
            if let Some(event) = self.performer.accept(answer) {
                return Some(event);
            }
        }
    }

    async fn granted(&mut self, to: InstanceId) -> anyhow::Result<LeaseId> {
        match self.event().await {
            Some(Event::Granted { instance, lease }) if instance == to => Ok(lease.id),
            other => bail!("the arm was to be granted to {to}: {other:?}"),
        }
    }
}

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
    bench.performer.close().await
}

#[tokio::test]
async fn a_second_run_is_refused_before_anything_is_started() -> anyhow::Result<()> {
    let bench = Bench::new().await?;
    let (events, _) = mpsc::channel(1);
    let second = connect(&bench.endpoints, "second", events).await;
    assert!(second.is_err_and(|error| error.to_string().contains("another run is under way")));
    Ok(())
}

#[tokio::test]
async fn a_run_whose_effects_are_not_all_recorded_does_not_end_well() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    // The world pool's root will not have this revision.
    let fact = FactKey { predicate: "done".to_owned(), arguments: Vec::new() };
    let changes = vec![Change::Set { fact, value: Value::Bool(true) }];
    bench.performer.perform(Command::Commit { instance: InstanceId(1), changes, revision: Revision(99) })?;
    let ended = bench.performer.close().await;
    assert!(ended.is_err_and(|error| error.to_string().contains("not all recorded")));
    Ok(())
}

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
        reads: reads.clone(),
        lease: None,
    };
    bench.performer.perform(project(1))?;
    let made = bench.answers.recv().await;
    bench.performer.perform(Command::Cancel { instance, attempt: 1 })?;
    assert_eq!(made.and_then(|answer| bench.performer.accept(answer)), None);
    assert!(bench.performer.cancelled.lock().is_ok_and(|cancelled| cancelled.is_empty()));
    bench.performer.perform(project(2))?;
    assert!(matches!(bench.event().await, Some(Event::Projected { attempt: 2, .. })));
    bench.performer.close().await
}

#[tokio::test]
async fn a_grant_that_crosses_its_withdrawal_goes_back() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let instance = InstanceId(1);
    bench.ask(instance)?;
    let granted = bench.answers.recv().await;
    bench.performer.perform(Command::Withdraw { instance })?;
    assert_eq!(granted.and_then(|answer| bench.performer.accept(answer)), None);

    // Nobody holds the arm: the same instance gets it when it asks again.
    bench.ask(instance)?;
    bench.granted(instance).await?;
    bench.performer.close().await
}
