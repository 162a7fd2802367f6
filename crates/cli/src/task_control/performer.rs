//! Performs the executive's commands: asks the resource manager, gives goals to providers, hands what needs an order to
//! [`super::record`]. Never waits: every answer comes back as an event.

use super::Endpoints;
use super::record::{Cancelled, MAX_PENDING_RECORDS, Record, Recorder, said};
use super::retry::{Attempts, patiently};
use anyhow::bail;
use ratn_executive::protocol::{Command, Event, Goal};
use ratn_model::catalogue::Catalogue;
use ratn_model::fact::FactKey;
use ratn_model::id::{FencingToken, InstanceId, LeaseId, ProjectionId, Revision};
use ratn_model::program::ABORTED;
use ratn_model::resource::Requirement;
use ratn_model::value::Value;
use ratn_proto::types;
use ratn_worker::client::{AcquireOptions, ActionClient, Channels, ResourceClient, WorldClient, fresh_id};
use ratn_worker::endpoint::Endpoint;
use ratn_worker::session::{DEFAULT_TTL, Session};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
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
/// At the end of a run, for everything that is still being given back.
const CLOSE_DEADLINE: Duration = Duration::from_secs(3);

type Leases = Arc<Mutex<BTreeMap<InstanceId, (LeaseId, FencingToken)>>>;

/// One run's hands.
pub(super) struct Performer {
    run: String,
    task: String,
    catalogue: Arc<Catalogue>,
    resources: ResourceClient,
    actions: ActionClient,
    world: WorldClient,
    session: Session,
    events: mpsc::Sender<Event>,
    records: mpsc::Sender<Record>,
    cancelled: Cancelled,
    asking: BTreeMap<InstanceId, CancellationToken>,
    leases: Leases,
    jobs: BTreeMap<InstanceId, Job>,
    giving_back: JoinSet<()>,
    acquires: u64,
}

struct Job {
    attempt: u32,
    stop: CancellationToken,
    ended: JoinHandle<()>,
}

impl Performer {
    /// Opens a session and begins to listen to commands.
    pub(super) async fn connect(
        endpoints: &Endpoints,
        catalogue: Arc<Catalogue>,
        task: &str,
        events: mpsc::Sender<Event>,
    ) -> anyhow::Result<Performer> {
        let channels = Channels::new();
        let run = fresh_id("run");
        let session = Session::open(&channels, &endpoints.resource_manager, "task-control", DEFAULT_TTL);
        session.alive(SESSION_DEADLINE).await?;
        let resources = ResourceClient::new(&channels, &endpoints.resource_manager, session.id())?;
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
            leases: Leases::default(),
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
            Command::Note(_) | Command::End { .. } => {}
            Command::Acquire { instance, requirements, priority } => self.acquire(instance, requirements, priority),
            Command::Withdraw { instance } => {
                if let Some(asking) = self.asking.remove(&instance) {
                    asking.cancel();
                }
            }
            Command::Project { instance, attempt, base, changes, reads } => {
                let lease = self.leases.lock().unwrap_or_else(PoisonError::into_inner).get(&instance).copied();
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
    pub(super) async fn close(mut self) {
        let closing = async {
            let (done, recorded) = oneshot::channel();
            if self.records.send(Record::Flush(done)).await.is_ok() {
                let _ = recorded.await;
            }
            while self.giving_back.join_next().await.is_some() {}
        };
        if tokio::time::timeout(CLOSE_DEADLINE, closing).await.is_err() {
            tracing::warn!("what was left at the end of the run was not given back in time");
        }
        self.session.close().await;
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
        let (resources, events, leases) = (self.resources.clone(), self.events.clone(), self.leases.clone());
        tokio::spawn(async move {
            let ask = || resources.acquire(requirements.clone(), options.clone());
            let answer = tokio::select! {
                answer = patiently(Attempts::IDEMPOTENT, ask) => Some(answer),
                () = withdrawn.cancelled() => None,
            };
            let event = match answer {
                Some(Ok(lease)) if withdrawn.is_cancelled() => {
                    let _ = resources.release(lease.id).await;
                    return;
                }
                Some(Ok(lease)) => {
                    leases.lock().unwrap_or_else(PoisonError::into_inner).insert(instance, (lease.id, lease.token));
                    Event::Granted { instance, lease }
                }
                Some(Err(error)) => Event::Refused { instance, reason: said(&error) },
                None => {
                    // The call is dropped; what was granted meanwhile goes back.
                    let _ = patiently(Attempts::IDEMPOTENT, || resources.withdraw(&options.request)).await;
                    return;
                }
            };
            let _ = events.send(event).await;
        });
    }

    fn start(&mut self, instance: InstanceId, attempt: u32, goal: Goal) {
        self.asking.remove(&instance);
        let stop = CancellationToken::new();
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
                let _ = events.send(event).await;
            }
        });
        self.jobs.insert(instance, Job { attempt, stop, ended });
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
        self.asking.remove(&instance);
        self.leases.lock().unwrap_or_else(PoisonError::into_inner).remove(&instance);
        let job = self.jobs.remove(&instance);
        let (resources, world) = (self.resources.clone(), self.world.clone());
        self.giving_back.spawn(async move {
            // Whoever gets the resources next finds them idle.
            if let Some(job) = job {
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

/// Has a goal performed; `None` when it was told to stop.
async fn execute(
    actions: &ActionClient,
    endpoint: &Endpoint,
    goal: types::Goal,
    instance: InstanceId,
    attempt: u32,
    events: &mpsc::Sender<Event>,
    stop: &CancellationToken,
) -> Option<Event> {
    let id = goal.id.clone();
    let on_progress = |message: String, _: BTreeMap<String, Value>| {
        // Progress is for people: when events pile up, it is what can be missed.
        let _ = events.try_send(Event::Progressed { instance, attempt, message });
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
