//! A performer with a real resource manager and world pool.

mod beside_others;
mod changed_between;
mod commits;
mod goals;
mod leases;
mod operations;
mod operations_resumed;
mod projections;
mod resumed;

use super::*;
use crate::Endpoints;
use crate::ledger::{Began, Ledger};
use crate::task_for_tests::{FETCH_BOXES, program};
use crate::waits_for::WaitsFor;
use anyhow::Context;
use ratn_daemon::resource_manager::{self, ResourceManagerConfig};
use ratn_daemon::world_pool::{self, WorldPoolConfig};
use ratn_executive::protocol::{Goal, Learned, Mode, Natures, Origin, Unmade};
use ratn_model::catalogue::Provider;
use ratn_model::fact::{Change, Footprint};
use ratn_model::id::{FencingToken, ProjectionId, StateId};
use ratn_model::program::SUCCESS;
use ratn_model::resource::{Lease, LeasedResource, ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use ratn_proto::types::{GoalOutcome, Resource};
use ratn_worker::action::{Action, ActionResult, ActionServer, GoalContext};
use ratn_worker::client::fresh_id;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::server::{Services, bind};
use ratn_worker::tls::ClientTls;
use ratn_world::world::World;
use tokio_util::sync::DropGuard;

async fn connect(endpoints: &Endpoints, task: &str, events: mpsc::Sender<Answer>) -> anyhow::Result<Performer> {
    connect_as(endpoints, &fresh_id("run"), None, task, events).await
}

async fn connect_as(
    endpoints: &Endpoints,
    run: &str,
    before: Option<u64>,
    task: &str,
    events: mpsc::Sender<Answer>,
) -> anyhow::Result<Performer> {
    Performer::connect(&place_of(endpoints), run, &self::task(task), before, TraceContext::fresh(), events).await
}

/// A task of this name.
fn task(name: &str) -> Arc<Program> {
    Arc::new(Program { name: name.to_owned(), ..program(FETCH_BOXES) })
}

fn place_of(endpoints: &Endpoints) -> Place {
    Place {
        endpoints: endpoints.clone(),
        tls: ClientTls::none(),
        directory: std::path::PathBuf::new(),
        catalogue: Arc::default(),
        robot: String::new(),
        speed: 1.0,
        messages: Messages::nowhere(),
        alone: false,
        urgency: Urgency::Normal,
        standing: Standing::default(),
    }
}

fn arm() -> Vec<Requirement> {
    vec![Requirement::new(ResourceOperation::Block, "Arm")]
}

fn finished(instance: InstanceId) -> Event {
    Event::Finished {
        instance,
        attempt: 1,
        outcome: SUCCESS.to_owned(),
        outputs: BTreeMap::new(),
        measured: Vec::new(),
        evidence: Vec::new(),
        reason: String::new(),
        at_rest: true,
    }
}

impl Performer {
    /// Performs a command when everything before it is safe on disk.
    fn perform(&mut self, command: Command) -> anyhow::Result<()> {
        self.perform_when(None, command)
    }

    /// Closes the performer; ignores the events for the executive.
    async fn closed(self) -> anyhow::Result<()> {
        self.close().await.1
    }
}

/// A performer with a resource manager, a world pool and one arm.
struct Bench {
    performer: Performer,
    answers: mpsc::Receiver<Answer>,
    endpoints: Endpoints,
    /// The session that offers the arm.
    _robot: Session,
    _place: tempfile::TempDir,
    _shutdown: DropGuard,
}

impl Bench {
    async fn new() -> anyhow::Result<Bench> {
        Bench::new_with(WorldPoolConfig::default()).await
    }

    async fn new_with(config: WorldPoolConfig) -> anyhow::Result<Bench> {
        Bench::new_with_both(ResourceManagerConfig::default(), config).await
    }

    async fn new_with_both(manager: ResourceManagerConfig, config: WorldPoolConfig) -> anyhow::Result<Bench> {
        let place = tempfile::tempdir()?;
        let directory = RuntimeDirectory::create(place.path())?;
        let shutdown = CancellationToken::new();
        tokio::spawn(resource_manager::run(manager, directory.clone(), shutdown.clone()));
        tokio::spawn(world_pool::run(config, directory.clone(), shutdown.clone()));
        let endpoints = Endpoints {
            resource_manager: directory.wait_for(resource_manager::ROLE, SESSION_DEADLINE).await?,
            world_pool: directory.wait_for(world_pool::ROLE, SESSION_DEADLINE).await?,
        };
        let (events, answers) = mpsc::channel(8);
        let performer = connect(&endpoints, "task", events).await?;
        let channels = Channels::new(&ClientTls::none());
        let robot = Session::open(&channels, &endpoints.resource_manager, "robot", DEFAULT_TTL);
        robot.alive(SESSION_DEADLINE).await?;
        let offering = ResourceClient::new(&channels, &endpoints.resource_manager, robot.id())?;
        offering.create(Resource::new("arm", ResourceClass::Module, "Arm")).await?;
        Ok(Bench { performer, answers, endpoints, _robot: robot, _place: place, _shutdown: shutdown.drop_guard() })
    }

    fn ask(&mut self, instance: InstanceId) -> anyhow::Result<()> {
        self.performer.perform(Command::Acquire { instance, requirements: arm(), priority: 0 })
    }

    /// Performs what the executive decides at the end of `ended`: `next`, if given, wants what that had.
    fn goes_on(&mut self, ended: InstanceId, lease: LeaseId, next: Option<InstanceId>) -> anyhow::Result<()> {
        let event = finished(ended);
        let asks = next.map(|instance| Command::Acquire { instance, requirements: arm(), priority: 0 });
        let release = Command::Release { instance: ended, lease: Some(lease), projection: None };
        let commands: Vec<Command> = asks.into_iter().chain([release]).collect();
        self.steps(&event, commands)
    }

    fn steps(&mut self, event: &Event, commands: Vec<Command>) -> anyhow::Result<()> {
        self.performer.prepare(event, &commands);
        commands.into_iter().try_for_each(|command| self.performer.perform(command))
    }

    /// The next event for the executive, except for operations that are done.
    async fn event(&mut self) -> Option<Event> {
        loop {
            match self.any_event().await? {
                Event::Recorded { .. } => {}
                event => return Some(event),
            }
        }
    }

    /// The next event for the executive.
    async fn any_event(&mut self) -> Option<Event> {
        loop {
            let answer = self.answers.recv().await?;
            if let Some(event) = self.performer.accept(answer, &World::default()) {
                return Some(event);
            }
        }
    }

    /// Task control is killed and resumes the run; `lives` says whether its session still lives.
    async fn comes_back(self, lives: bool) -> anyhow::Result<Bench> {
        let before = self.performer.number;
        self.comes_back_to(before, lives).await
    }

    /// The same, with the number of the run's session by the log.
    async fn comes_back_to(mut self, before: u64, lives: bool) -> anyhow::Result<Bench> {
        let run = self.performer.run.clone();
        let (events, answers) = mpsc::channel(8);
        self.answers = answers;
        if lives {
            // The session is not closed.
            std::mem::forget(self.performer);
        } else {
            // Closing the session has the same effect as its expiry.
            self.performer.session.close().await;
        }
        self.performer = connect_as(&self.endpoints, &run, Some(before), "task", events).await?;
        Ok(self)
    }

    /// Takes up the log's open items, as a resumption does: the loss of its leases is logged before.
    async fn takes_up(&mut self, ledger: Ledger, mirror: &World) -> anyhow::Result<Vec<Event>> {
        let mut told = Vec::new();
        let more = self.takes_up_saying(ledger, mirror, |event| told.push(event.clone())).await?;
        Ok(told.into_iter().chain(more).collect())
    }

    /// The same; `log` gets what has to be in the log before the operations.
    async fn takes_up_saying(
        &mut self,
        mut ledger: Ledger,
        mirror: &World,
        log: impl FnMut(&Event),
    ) -> anyhow::Result<Vec<Event>> {
        self.loses(&mut ledger).await?;
        let (now, program) = (ledger.last, fetch_boxes());
        let (told, taken) = self.performer.take_up(&program, ledger, mirror, now).await?;
        told.iter().for_each(log);
        self.performer.go_on(&program, taken).await
    }

    /// Performs what a run that has ended had decided.
    async fn finishes(&mut self, mut ledger: Ledger) -> anyhow::Result<(usize, usize)> {
        self.loses(&mut ledger).await?;
        let now = ledger.last;
        self.performer.finish(&fetch_boxes(), ledger, now, |_| Ok(())).await
    }

    async fn loses(&self, ledger: &mut Ledger) -> anyhow::Result<()> {
        let lost = self.performer.session_lost(ledger).await?;
        lost.iter().for_each(|lost| ledger.event(Timestamp(0), lost));
        Ok(())
    }

    /// Number of existing units of a kind.
    async fn units(&self, kind: &str) -> anyhow::Result<u32> {
        let resources = self.performer.resources.list(&[kind]).await?;
        Ok(resources.iter().map(|resource| resource.capacity.units()).sum())
    }

    async fn granted(&mut self, to: InstanceId) -> anyhow::Result<LeaseId> {
        match self.event().await {
            Some(Event::Granted { instance, lease }) if instance == to => Ok(lease.id),
            other => bail!("the arm was to be granted to {to}: {other:?}"),
        }
    }
}

/// A bench whose resource manager can be absent: it has a place of its own.
async fn with_manager_at(directory: &RuntimeDirectory) -> anyhow::Result<(Bench, Session)> {
    let mut bench = Bench::new().await?;
    let channels = Channels::new(&ClientTls::none());
    bench.endpoints.resource_manager = directory.wait_for(resource_manager::ROLE, SESSION_DEADLINE).await?;
    let manager = &bench.endpoints.resource_manager;
    let robot = Session::open(&channels, manager, "robot", DEFAULT_TTL);
    robot.alive(SESSION_DEADLINE).await?;
    let offering = ResourceClient::new(&channels, manager, robot.id())?;
    offering.create(Resource::new("arm", ResourceClass::Module, "Arm")).await?;
    let (events, answers) = mpsc::channel(8);
    let performer = connect(&bench.endpoints, "task", events).await?;
    std::mem::replace(&mut bench.performer, performer).closed().await?;
    bench.answers = answers;
    Ok((bench, robot))
}

/// A resource manager that a token ends, at the same place as its predecessor.
fn manager_at(directory: &RuntimeDirectory) -> (CancellationToken, impl Future<Output = ()> + use<>) {
    let shutdown = CancellationToken::new();
    let running = resource_manager::run(ResourceManagerConfig::default(), directory.clone(), shutdown.clone());
    let running = tokio::spawn(running);
    (shutdown, async move { drop(running.await) })
}

/// The next grant, and the last change of the world that was reported before it.
async fn granted_after(
    performer: &mut Performer,
    answers: &mut mpsc::Receiver<Answer>,
) -> anyhow::Result<(LeaseId, Option<(FactKey, Option<Value>)>)> {
    let mut told = None;
    loop {
        match performer.accept(answers.recv().await.context("no answer")?, &World::default()) {
            Some(Event::WorldChanged { facts, .. }) => told = facts.into_iter().next(),
            Some(Event::Granted { lease, .. }) => return Ok((lease.id, told)),
            _ => {}
        }
    }
}

fn create(kind: &str, count: u32) -> Requirement {
    Requirement { operation: ResourceOperation::Create, kind: kind.to_owned(), count: count.into(), ..arm().remove(0) }
}

fn done() -> Vec<Change> {
    let fact = FactKey { predicate: "done".to_owned(), arguments: Vec::new() };
    vec![Change::Set { fact, value: Value::Bool(true) }]
}

/// The ledger of a run with these commands, before it was killed.
fn ledger(run: &str, commands: &[Command]) -> Ledger {
    let mut ledger = Ledger { origin: Origin { run: run.to_owned(), ..Origin::default() }, ..Ledger::default() };
    commands.iter().for_each(|command| ledger.command(command));
    ledger.event(Timestamp(0), &Event::Resumed { share: None });
    ledger
}

/// The program of the log.
fn fetch_boxes() -> Arc<ratn_model::program::Program> {
    Arc::new(program(FETCH_BOXES))
}

fn operate(instance: u64, operation: Requirement) -> Command {
    Command::Operate { instance: InstanceId(instance), operations: vec![operation] }
}

fn of(units: &[(&str, u32)]) -> Vec<(String, u32)> {
    units.iter().map(|(id, units)| ((*id).to_owned(), *units)).collect()
}

fn commits(instance: u64, number: u64) -> Command {
    Command::Commit {
        instance: InstanceId(instance),
        writer: "place[1]".into(),
        evidence: Vec::new(),
        changes: done(),
        revision: Revision(number),
    }
}

fn delete(kind: &str) -> Requirement {
    Requirement::new(ResourceOperation::Delete, kind)
}

/// `hang` ends when it is cancelled, `brake` a while after that, `look` when it has seen all facts, `work` at once.
struct Arm(&'static str);

#[tonic::async_trait]
impl Action for Arm {
    fn name(&self) -> &str {
        self.0
    }

    async fn execute(&self, goal: GoalContext) -> ActionResult {
        if self.0 == "hang" {
            goal.cancelled.cancelled().await;
            return Err(goal.stopped());
        }
        if self.0 == "brake" {
            goal.cancelled.cancelled().await;
            tokio::time::sleep(Duration::from_millis(300)).await;
            return Err(goal.stopped());
        }
        if self.0 == "look" {
            goal.facts(&[]).await?;
        }
        Ok(GoalOutcome::success())
    }
}

/// Lets the bench's arm perform goals.
async fn serve_arm(bench: &mut Bench) -> anyhow::Result<(ActionServer, String)> {
    let arm = ["hang", "brake", "look", "work"].map(Arm);
    let arm =
        arm.into_iter().fold(ActionServer::builder("").one_at_a_time(), |server, action| server.action(action)).build();
    let bound = bind(&Endpoint::Unix(bench._place.path().join("arm.sock"))).await?;
    let endpoint = bound.endpoint().to_string();
    tokio::spawn(bound.serve(Services::new().with(arm.clone().into_service()), CancellationToken::new()));
    let provider = Provider { resource: "Arm".to_owned(), joints: None, chain: None, actions: BTreeMap::new() };
    bench.performer.catalogue =
        Arc::new(Catalogue { providers: BTreeMap::from([("arm".to_owned(), provider)]), ..Catalogue::default() });
    Ok((arm, endpoint))
}

/// Starts a goal of the arm under this lease.
fn start(instance: InstanceId, attempt: u32, action: &str, lease: LeaseId, endpoint: &str) -> Command {
    let resource = LeasedResource {
        id: "arm".to_owned(),
        kind: "Arm".to_owned(),
        endpoint: endpoint.to_owned(),
        superclasses: Vec::new(),
    };
    Command::Start {
        instance,
        attempt,
        goal: Box::new(Goal {
            provider: "arm".into(),
            action: action.into(),
            inputs: BTreeMap::new(),
            seed: 0,
            lease: Some(Lease { id: lease, token: FencingToken(1), resources: vec![resource], consumed: Vec::new() }),
            projection: None,
            expected_s: None,
            timeout_s: None,
            improves: None,
            reads_nothing: false,
        }),
    }
}
