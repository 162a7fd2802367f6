//! Performs the executive's commands: asks the resource manager, gives goals to providers, hands what needs an order to
//! [`super::record`]. Never waits: every answer comes back as an event.

use super::Endpoints;
use super::record::{Cancelled, MAX_PENDING_RECORDS, Record, Recorder, said};
use super::retry::{Attempts, patiently};
use anyhow::bail;
use futures::FutureExt;
use ratn_executive::protocol::{Command, Event, Goal};
use ratn_model::catalogue::Catalogue;
use ratn_model::fact::FactKey;
use ratn_model::id::{InstanceId, LeaseId, ProjectionId, Revision};
use ratn_model::program::ABORTED;
use ratn_model::resource::{Requirement, ResourceClass};
use ratn_model::value::Value;
use ratn_proto::types::{self, Resource};
use ratn_worker::client::{AcquireOptions, ActionClient, Channels, ResourceClient, WorldClient, fresh_id};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::session::{DEFAULT_TTL, Session};
use std::collections::BTreeMap;
use std::sync::{Arc, PoisonError};
use std::time::Duration;
use tokio::sync::{mpsc, oneshot};
use tokio::task::{JoinHandle, JoinSet};
use tokio_util::sync::CancellationToken;

/// A resource manager that does not open a session within this time is not there.
const SESSION_DEADLINE: Duration = Duration::from_secs(5);
/// A task that waits this long for its resources has waited in vain.
const ACQUIRE_DEADLINE: Duration = Duration::from_secs(3600);
/// A provider that was told to stop and does not is left alone after this long.
const CANCEL_DEADLINE: Duration = Duration::from_secs(2);
/// The resource that the one run of a system is.
const RUN: &str = "run";
/// At the end of a run, for everything that is still being given back.
const CLOSE_DEADLINE: Duration = Duration::from_secs(3);

/// An event on its way to the executive.
#[derive(Debug)]
pub(super) struct Answer {
    event: Event,
    /// Of an acquire: whether it was withdrawn meanwhile.
    withdrawn: Option<CancellationToken>,
}

impl From<Event> for Answer {
    fn from(event: Event) -> Answer {
        Answer { event, withdrawn: None }
    }
}

/// One run's hands.
pub(super) struct Performer {
    run: String,
    task: String,
    catalogue: Arc<Catalogue>,
    resources: ResourceClient,
    actions: ActionClient,
    world: WorldClient,
    session: Session,
    events: mpsc::Sender<Answer>,
    records: mpsc::Sender<Record>,
    cancelled: Cancelled,
    asking: BTreeMap<InstanceId, CancellationToken>,
    jobs: BTreeMap<InstanceId, Job>,
    giving_back: JoinSet<()>,
    acquires: u64,
}

struct Job {
    attempt: u32,
    /// What it works under; a routine's serves several jobs.
    lease: Option<LeaseId>,
    stop: CancellationToken,
    ended: JoinHandle<()>,
}

impl Performer {
    /// Opens a session and begins to listen to commands.
    pub(super) async fn connect(
        endpoints: &Endpoints,
        catalogue: Arc<Catalogue>,
        task: &str,
        events: mpsc::Sender<Answer>,
    ) -> anyhow::Result<Performer> {
        let channels = Channels::new();
        let run = fresh_id("run");
        let session = Session::open(&channels, &endpoints.resource_manager, "task-control", DEFAULT_TTL);
        session.alive(SESSION_DEADLINE).await?;
        let resources = ResourceClient::new(&channels, &endpoints.resource_manager, session.id())?;
        only_run(&resources, task).await?;
        let world = WorldClient::new(&channels, &endpoints.world_pool)?;
        let (records, work) = mpsc::channel(MAX_PENDING_RECORDS);
        let cancelled = Cancelled::default();
        let recorder = Recorder {
            run: run.clone(),
            world: world.clone(),
            resources: resources.clone(),
            cancelled: cancelled.clone(),
            events: events.clone(),
        };
        tokio::spawn(recorder.work(work));
        Ok(Performer {
            run,
            task: task.to_owned(),
            catalogue,
            resources,
            actions: ActionClient::new(channels),
            world,
            session,
            events,
            records,
            cancelled,
            asking: BTreeMap::new(),
            jobs: BTreeMap::new(),
            giving_back: JoinSet::new(),
            acquires: 0,
        })
    }

    /// The root world as it is now.
    pub(super) async fn root(&self) -> anyhow::Result<(Revision, Vec<(FactKey, Value)>)> {
        let (revision, facts) = patiently(Attempts::IDEMPOTENT, || self.world.root()).await?;
        Ok((revision, facts.into_iter().map(|fact| (fact.key, fact.value)).collect()))
    }

    /// Resolves when the session with the resource manager, and with it every lease, is lost.
    pub(super) async fn lost(&self) {
        self.session.lost().await;
    }

    /// Begins to perform a command.
    pub(super) fn perform(&mut self, command: Command) -> anyhow::Result<()> {
        while self.giving_back.try_join_next().is_some() {}
        match command {
            // Waking is the shell's: it has the clock.
            Command::Note(_) | Command::End { .. } | Command::Wake { .. } => {}
            Command::Acquire { instance, requirements, priority } => self.acquire(instance, requirements, priority),
            Command::Withdraw { instance } => {
                if let Some(asking) = self.asking.remove(&instance) {
                    asking.cancel();
                }
            }
            Command::Project { instance, attempt, base, changes, reads, lease } => {
                self.record(Record::Project { instance, attempt, base, changes, reads, lease })?;
            }
            Command::Start { instance, attempt, goal } => self.start(instance, attempt, goal),
            Command::Cancel { instance, attempt } => match self.jobs.get(&instance) {
                Some(job) if job.attempt == attempt => job.stop.cancel(),
                _ => {
                    self.cancelled.lock().unwrap_or_else(PoisonError::into_inner).insert((instance, attempt));
                }
            },
            Command::Release { instance, lease, projection } => self.release(instance, lease, projection),
            Command::Commit { instance, changes, revision } => {
                self.record(Record::Commit { instance, changes, revision })?;
            }
            Command::Operate { instance, operations } => self.record(Record::Operate { instance, operations })?,
        }
        Ok(())
    }

    /// Waits until what was decided is recorded and given back, and ends the session.
    ///
    /// # Errors
    /// When something that was decided is not recorded: the world pool or the resource manager know less than what happened.
    pub(super) async fn close(mut self) -> anyhow::Result<()> {
        let recording = async {
            let (done, recorded) = oneshot::channel();
            self.records.send(Record::Flush(done)).await.map_err(|_| "the recorder is gone".to_owned())?;
            recorded.await.unwrap_or_else(|_| Err("the recorder is gone".to_owned()))
        };
        let recorded = tokio::time::timeout(CLOSE_DEADLINE, recording).await;
        let giving_back = async { while self.giving_back.join_next().await.is_some() {} };
        if tokio::time::timeout(CLOSE_DEADLINE, giving_back).await.is_err() {
            tracing::warn!("what was left at the end of the run was not given back in time");
        }
        self.session.close().await;
        match recorded {
            Ok(Ok(())) => Ok(()),
            Ok(Err(reason)) => bail!("what the run did is not all recorded: {reason}"),
            Err(_) => bail!("what the run did is not all recorded: the world pool has not answered in time"),
        }
    }

    fn record(&self, record: Record) -> anyhow::Result<()> {
        if self.records.try_send(record).is_err() {
            bail!("the world pool is more than {MAX_PENDING_RECORDS} requests behind, or gone");
        }
        Ok(())
    }

    fn acquire(&mut self, instance: InstanceId, requirements: Vec<Requirement>, priority: i64) {
        self.acquires += 1;
        let withdrawn = CancellationToken::new();
        self.asking.insert(instance, withdrawn.clone());
        let options = AcquireOptions {
            request: format!("{}/{instance}/acquire-{}", self.run, self.acquires),
            priority,
            deadline: ACQUIRE_DEADLINE,
            holder: format!("{} {instance}", self.task),
        };
        let (resources, events) = (self.resources.clone(), self.events.clone());
        let mut asking = Box::pin(async move {
            let ask = || resources.acquire(requirements.clone(), options.clone());
            let answer = tokio::select! {
                answer = patiently(Attempts::IDEMPOTENT, ask) => answer,
                () = withdrawn.cancelled() => {
                    // The call is dropped; what was granted meanwhile goes back.
                    let _ = patiently(Attempts::IDEMPOTENT, || resources.withdraw(&options.request)).await;
                    return;
                }
            };
            let event = match answer {
                Ok(lease) => Event::Granted { instance, lease },
                Err(error) => Event::Refused { instance, reason: said(&error) },
            };
            let _ = events.send(Answer { event, withdrawn: Some(withdrawn) }).await;
        });
        // The request leaves here and now: tasks would be run, and requests arrive, in any order.
        if asking.as_mut().now_or_never().is_none() {
            tokio::spawn(asking);
        }
    }

    /// The event of an answer; `None` when what it answers was withdrawn or cancelled: what crossed with that goes back.
    pub(super) fn accept(&mut self, answer: Answer) -> Option<Event> {
        let withdrawn = answer.withdrawn.is_some_and(|withdrawn| withdrawn.is_cancelled());
        match answer.event {
            Event::Granted { instance, lease } if withdrawn => {
                self.give_back(instance, Vec::new(), Some(lease.id), None);
                None
            }
            _ if withdrawn => None,
            Event::Projected { instance, attempt, projection } if self.was_cancelled(instance, attempt) => {
                self.give_back(instance, Vec::new(), None, Some(projection));
                None
            }
            Event::Crashed { instance, attempt, .. } if self.was_cancelled(instance, attempt) => None,
            event => {
                if let Event::Granted { instance, .. } | Event::Refused { instance, .. } = &event {
                    self.asking.remove(instance);
                }
                Some(event)
            }
        }
    }

    fn was_cancelled(&self, instance: InstanceId, attempt: u32) -> bool {
        self.cancelled.lock().unwrap_or_else(PoisonError::into_inner).remove(&(instance, attempt))
    }

    fn start(&mut self, instance: InstanceId, attempt: u32, goal: Goal) {
        let stop = CancellationToken::new();
        let lease = goal.lease.as_ref().map(|lease| lease.id);
        let endpoint = self.endpoint_of(&goal);
        let (actions, events, stopped) = (self.actions.clone(), self.events.clone(), stop.clone());
        let goal = types::Goal {
            id: format!("{}/{instance}/{attempt}", self.run),
            action: goal.action,
            inputs: goal.inputs,
            seed: goal.seed,
            lease: goal.lease,
            projection: goal.projection,
            world_pool: self.world.endpoint().to_string(),
            deadline_ms: 0,
        };
        let ended = tokio::spawn(async move {
            let event = match endpoint {
                Ok(endpoint) => execute(&actions, &endpoint, goal, instance, attempt, &events, &stopped).await,
                Err(reason) => Some(aborted(instance, attempt, reason)),
            };
            if let Some(event) = event
                && !stopped.is_cancelled()
            {
                let _ = events.send(event.into()).await;
            }
        });
        self.jobs.insert(instance, Job { attempt, lease, stop, ended });
    }

    /// Where the provider of a goal is: the leased resource of its kind.
    fn endpoint_of(&self, goal: &Goal) -> Result<Endpoint, String> {
        let Some(provider) = self.catalogue.providers.get(&goal.provider) else {
            return Err(format!("the system's catalogue has no provider `{}`", goal.provider));
        };
        let leased = goal.lease.as_ref().and_then(|lease| lease.resource(&provider.resource));
        let Some(resource) = leased else {
            return Err(format!(
                "`{}` is done by a {}, and none is leased: add `block: {}` to the state's resources",
                goal.provider, provider.resource, provider.resource
            ));
        };
        resource.endpoint.parse().map_err(|error| format!("{} has no usable endpoint: {error}", resource.id))
    }

    fn release(&mut self, instance: InstanceId, lease: Option<LeaseId>, projection: Option<ProjectionId>) {
        let over = |id: InstanceId, job: &Job| id == instance || (lease.is_some() && job.lease == lease);
        let (ended, going_on) = std::mem::take(&mut self.jobs).into_iter().partition(|(id, job)| over(*id, job));
        self.jobs = going_on;
        self.give_back(instance, Vec::from_iter(BTreeMap::into_values(ended)), lease, projection);
    }

    fn give_back(
        &mut self,
        instance: InstanceId,
        jobs: Vec<Job>,
        lease: Option<LeaseId>,
        projection: Option<ProjectionId>,
    ) {
        let (resources, world) = (self.resources.clone(), self.world.clone());
        self.giving_back.spawn(async move {
            // Whoever gets the resources next finds them idle.
            for job in jobs {
                let _ = job.ended.await;
            }
            if let Some(projection) = projection
                && let Err(error) = patiently(Attempts::IDEMPOTENT, || world.release(projection)).await
            {
                tracing::warn!(%instance, "a projection was not given back: {}", said(&error));
            }
            if let Some(lease) = lease
                && let Err(error) = patiently(Attempts::IDEMPOTENT, || resources.release(lease)).await
            {
                tracing::warn!(%instance, "a lease was not given back: {}", said(&error));
            }
        });
    }
}

/// Two runs would each change the world under the other's projections: a system has one at a time. The resource that says so
/// goes with the run's session.
async fn only_run(resources: &ResourceClient, task: &str) -> anyhow::Result<()> {
    let claim = Resource::new(RUN, ResourceClass::Task, "Run").with_attribute("task", Value::String(task.to_owned()));
    match patiently(Attempts::IDEMPOTENT, || resources.create(claim.clone())).await {
        Ok(_) => Ok(()),
        Err(error) if error.code() == Some(tonic::Code::AlreadyExists) => {
            bail!("another run is under way on this system: wait for its end, or use a system of your own")
        }
        Err(error) => bail!("cannot begin the run: {}", said(&error)),
    }
}

/// Has a goal performed; `None` when it was told to stop.
async fn execute(
    actions: &ActionClient,
    endpoint: &Endpoint,
    goal: types::Goal,
    instance: InstanceId,
    attempt: u32,
    events: &mpsc::Sender<Answer>,
    stop: &CancellationToken,
) -> Option<Event> {
    let id = goal.id.clone();
    let on_progress = |message: String, _: BTreeMap<String, Value>| {
        // Progress is for people: when events pile up, it is what can be missed.
        let _ = events.try_send(Event::Progressed { instance, attempt, message }.into());
    };
    let mut executing = std::pin::pin!(actions.execute(endpoint, goal, on_progress));
    let answer = tokio::select! {
        answer = &mut executing => answer,
        () = stop.cancelled() => {
            let stopping = async {
                let _ = actions.cancel(endpoint, &id).await;
                let _ = executing.await;
            };
            let _ = tokio::time::timeout(CANCEL_DEADLINE, stopping).await;
            return None;
        }
    };
    Some(match answer {
        Ok(done) => Event::Finished {
            instance,
            attempt,
            outcome: done.outcome,
            outputs: done.outputs,
            measured: done.measured,
            reason: done.reason,
        },
        // What was wrong with the goal is wrong with it the next time, too.
        Err(error) if error.code() == Some(tonic::Code::InvalidArgument) => aborted(instance, attempt, said(&error)),
        Err(error) => Event::Crashed { instance, attempt, reason: said(&error) },
    })
}

fn aborted(instance: InstanceId, attempt: u32, reason: String) -> Event {
    Event::Finished {
        instance,
        attempt,
        outcome: ABORTED.to_owned(),
        outputs: BTreeMap::new(),
        measured: Vec::new(),
        reason,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_daemon::resource_manager::{self, ResourceManagerConfig};
    use ratn_daemon::world_pool::{self, WorldPoolConfig};
    use ratn_model::fact::{Change, Footprint};
    use ratn_model::resource::ResourceOperation;
    use ratn_worker::runtime_directory::RuntimeDirectory;
    use tokio_util::sync::DropGuard;

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
            let performer = Performer::connect(&endpoints, Arc::default(), "task", events).await?;
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
        let second = Performer::connect(&bench.endpoints, Arc::default(), "second", events).await;
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
}
