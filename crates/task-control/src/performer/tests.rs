//! A performer with a real resource manager and world pool.

use super::*;
use crate::Endpoints;
use crate::ledger::{Began, Ledger};
use crate::task_for_tests::{FETCH_BOXES, program};
use crate::waits_for::WaitsFor;
use anyhow::Context;
use ratn_daemon::resource_manager::{self, ResourceManagerConfig};
use ratn_daemon::world_pool::{self, WorldPoolConfig};
use ratn_executive::protocol::{Learned, Mode, Natures, Origin, Unmade};
use ratn_model::catalogue::Provider;
use ratn_model::fact::{Change, Footprint};
use ratn_model::id::{FencingToken, ProjectionId, StateId};
use ratn_model::program::SUCCESS;
use ratn_model::resource::{Lease, ResourceClass, ResourceOperation};
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

/// The operation that an event reports as done, and the session.
fn done_of(event: Option<&Event>) -> Option<(u64, u64)> {
    match event {
        Some(Event::Recorded { operation, session, .. }) => Some((*operation, *session)),
        _ => None,
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

/// A resource manager that a token ends, at the same place as its predecessor.
fn manager_at(directory: &RuntimeDirectory) -> (CancellationToken, impl Future<Output = ()> + use<>) {
    let shutdown = CancellationToken::new();
    let running = resource_manager::run(ResourceManagerConfig::default(), directory.clone(), shutdown.clone());
    let running = tokio::spawn(running);
    (shutdown, async move { drop(running.await) })
}

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

#[tokio::test]
async fn who_comes_back_tells_a_goal_to_stop_that_may_not_have_been_told() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (routine, motion) = (InstanceId(1), InstanceId(2));
    bench.ask(routine)?;
    let lease = bench.granted(routine).await?;
    let (arm, endpoint) = serve_arm(&mut bench).await?;
    let started = start(motion, 1, "brake", lease, &endpoint);
    bench.performer.perform(started.clone())?;
    while arm.running() == 0 {
        tokio::task::yield_now().await;
    }
    // Task control is killed when it has logged the cancel and before it has sent it to the arm.
    let run = bench.performer.run.clone();
    let acquire = Command::Acquire { instance: routine, requirements: self::arm(), priority: 0 };
    let mut ledger = ledger(&run, &[]);
    ledger.command(&acquire);
    let resource =
        LeasedResource { id: "arm".into(), kind: "Arm".into(), endpoint: endpoint.clone(), superclasses: Vec::new() };
    let held = Lease { id: lease, token: FencingToken(1), resources: vec![resource], consumed: Vec::new() };
    ledger.event(Timestamp(0), &Event::Granted { instance: routine, lease: held });
    ledger.command(&started);
    ledger.command(&Command::Cancel { instance: motion, attempt: 1 });
    ledger.event(Timestamp(0), &Event::Resumed { share: None });
    let catalogue = bench.performer.catalogue.clone();
    let mut bench = bench.comes_back(true).await?;
    bench.performer.catalogue = catalogue;
    bench.takes_up(ledger, &World::default()).await?;
    // The next goal of that arm is sent when the arm stands still.
    bench.performer.perform(start(InstanceId(3), 1, "work", lease, &endpoint))?;
    let event = bench.event().await;
    assert!(matches!(&event, Some(Event::Finished { outcome, .. }) if outcome == SUCCESS), "{event:?}");
    assert_eq!(arm.running(), 0);
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
    bench.performer.resources.release_with_note(lease, "0 12".to_owned()).await?;
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

#[test]
fn what_is_certain_comes_first_then_the_urgent_run_then_the_own_order() {
    let (certain, speculative) = (CERTAIN | 5, CERTAIN - 1);
    let order = [
        (i64::MAX, Urgency::High),
        (certain | 8, Urgency::High),
        (certain, Urgency::High),
        (i64::MAX, Urgency::Normal),
        (certain, Urgency::Low),
        (speculative, Urgency::High),
        (speculative, Urgency::Low),
    ];
    let ranks = order.map(|(priority, urgency)| beside_others(priority, urgency));
    assert!(ranks.is_sorted_by(|a, b| a > b), "{ranks:?}");
    assert!(ranks[0] < OVERDUE && ranks[4] >= CERTAIN && ranks[5] < CERTAIN);
}

#[test]
fn an_instance_that_asks_again_names_the_request_under_which_it_is_in_the_queue() {
    let after = |priority: i64, waited: Duration| LastAsked { request: "r".to_owned(), priority }.in_queue(waited);
    let long = LONG_BESIDE_OTHERS;
    assert_eq!(after(CERTAIN, Duration::ZERO), "r");
    assert_eq!(after(CERTAIN, long), late_request("r"), "it has asked once more");
    assert_eq!(after(CERTAIN - 1, long), "r", "what is speculative does not");
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

fn operate(instance: u64, operation: Requirement) -> Command {
    Command::Operate { instance: InstanceId(instance), operations: vec![operation] }
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
async fn what_was_used_up_for_good_is_not_used_up_again_with_a_new_session() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let run = bench.performer.run.clone();
    let channels = Channels::new(&ClientTls::none());
    let offering = ResourceClient::new(&channels, &bench.endpoints.resource_manager, bench._robot.id())?;
    let of = |kind: &str| Resource::new(kind, ResourceClass::System, kind).with_capacity(3);
    offering.create(of("Glue").non_renewable()).await?;
    offering.create(of("Battery")).await?;
    let consume = |kind: &str| Requirement::new(ResourceOperation::Consume, kind);
    let operations = [consume("Glue"), consume("Battery"), create("Screws", 3), consume("Screws")];
    let operations = operations.map(|operation| operate(1, operation));
    for command in operations.clone() {
        bench.performer.perform(command)?;
    }
    let session = bench.performer.number;
    let mut ledger = Ledger { session, ..ledger(&run, &operations) };
    while ledger.recorded < 4 {
        let done = bench.any_event().await.context("no word")?;
        ledger.event(Timestamp(0), &done);
    }
    let left = async |bench: &Bench| {
        let there = bench.performer.resources.list(&["Glue", "Battery", "Screws"]).await?;
        anyhow::Ok(there.into_iter().map(|one| (one.kind, one.free.units())).collect::<BTreeMap<String, u32>>())
    };
    let expected = ["Battery", "Glue", "Screws"].map(|kind| (kind.to_owned(), 2)).into();
    assert_eq!(left(&bench).await?, expected);
    let mut bench = bench.comes_back(false).await?;
    bench.takes_up(ledger, &World::default()).await?;
    assert_eq!(left(&bench).await?, expected);
    bench.performer.closed().await
}

/// A hierarchy of two kinds.
fn glue_is_an_adhesive() -> ResourceManagerConfig {
    let kinds = BTreeMap::from([("Glue".to_owned(), vec!["Adhesive".to_owned()])]);
    ResourceManagerConfig { kinds, ..ResourceManagerConfig::default() }
}

/// A run that operates, and its log.
struct Operating {
    bench: Bench,
    operator: ResourceClient,
    ledger: Ledger,
}

impl Operating {
    async fn new(config: ResourceManagerConfig) -> anyhow::Result<Operating> {
        let bench = Bench::new_with_both(config, WorldPoolConfig::default()).await?;
        let operator = ResourceClient::new(&Channels::new(&ClientTls::none()), &bench.endpoints.resource_manager, "")?;
        let run = &bench.performer.run;
        let ledger = Ledger { session: bench.performer.number, ..ledger(run, &[]) };
        Ok(Operating { bench, operator, ledger })
    }

    /// An operator creates a resource.
    async fn there_is(&self, id: &str, kind: &str, capacity: u32) -> anyhow::Result<()> {
        let resource = Resource::new(id, ResourceClass::System, kind).with_capacity(capacity);
        self.operator.create(resource.non_renewable()).await?;
        Ok(())
    }

    /// The operation is done, and the run's log says so.
    async fn does(&mut self, operation: Requirement) -> anyhow::Result<()> {
        let done = self.does_unheard(operation).await?;
        self.ledger.event(Timestamp(0), &done);
        Ok(())
    }

    /// The operation is done, and the run is killed before it has heard of it.
    async fn does_unheard(&mut self, operation: Requirement) -> anyhow::Result<Event> {
        self.decides(operation.clone());
        self.bench.performer.perform(operate(1, operation))?;
        let done = self.bench.any_event().await.context("no word")?;
        assert!(matches!(done, Event::Recorded { .. }), "{done:?}");
        Ok(done)
    }

    /// The run is killed before it has requested the operation.
    fn decides(&mut self, operation: Requirement) {
        self.ledger.command(&operate(1, operation));
    }

    /// Resumes the run after its session has ended; returns the events for the log.
    async fn comes_back(&mut self) -> anyhow::Result<Vec<Event>> {
        let before = self.ledger.session;
        let run = self.bench.performer.run.clone();
        let (events, answers) = mpsc::channel(8);
        let again = connect_as(&self.bench.endpoints, "next", None, "task", mpsc::channel(1).0).await?;
        std::mem::replace(&mut self.bench.performer, again).session.close().await;
        self.bench.performer = connect_as(&self.bench.endpoints, &run, Some(before), "task", events).await?;
        self.bench.answers = answers;
        let mut told = Vec::new();
        let open = self.ledger.clone();
        match self.bench.takes_up_saying(open, &World::default(), |event| told.push(event.clone())).await {
            Ok(more) => Ok(told.into_iter().chain(more).collect()),
            Err(refused) => {
                told.iter().for_each(|event| self.ledger.event(Timestamp(0), event));
                Err(refused)
            }
        }
    }

    /// The free units of each resource of a kind; `own` is a resource that the run has created.
    async fn free(&self, kind: &str) -> anyhow::Result<Vec<(String, u32)>> {
        let run = &self.bench.performer.run;
        let there = self.operator.list(&[kind]).await?.into_iter();
        let name = |one: &Resource| if one.session == *run { "own".to_owned() } else { one.id.clone() };
        let mut free: Vec<_> = there.map(|one| (name(&one), one.free.units())).collect();
        free.sort();
        Ok(free)
    }
}

fn of(units: &[(&str, u32)]) -> Vec<(String, u32)> {
    units.iter().map(|(id, units)| ((*id).to_owned(), *units)).collect()
}

fn consume(kind: &str) -> Requirement {
    Requirement::new(ResourceOperation::Consume, kind)
}

#[tokio::test]
async fn what_a_run_deleted_of_its_own_is_what_the_manager_took_when_it_comes_back() -> anyhow::Result<()> {
    let mut run = Operating::new(ResourceManagerConfig::default()).await?;
    let red = BTreeMap::from([("colour".to_owned(), Value::String("red".into()))]);
    run.does(Requirement { attributes: red.clone(), ..create("Box", 1) }).await?;
    run.does(create("Box", 1)).await?;
    run.does(delete("Box")).await?;
    let there = |boxes: Vec<Resource>| boxes.into_iter().map(|one| one.attributes).collect::<Vec<_>>();
    assert_eq!(
        there(run.operator.list(&["Box"]).await?),
        std::slice::from_ref(&red),
        "the one that is like fewer others"
    );
    run.comes_back().await?;
    assert_eq!(there(run.operator.list(&["Box"]).await?), [red]);
    run.bench.performer.closed().await
}

#[tokio::test]
async fn a_deletion_of_a_run_of_its_own_that_nobody_heard_of_takes_nothing_of_others() -> anyhow::Result<()> {
    let mut run = Operating::new(glue_is_an_adhesive()).await?;
    run.does(create("Glue", 1)).await?;
    run.there_is("operators", "Glue", 1).await?;
    run.does_unheard(delete("Adhesive")).await?;
    assert_eq!(run.free("Glue").await?, of(&[("operators", 1)]), "its own first");
    run.comes_back().await?;
    assert_eq!(run.free("Glue").await?, of(&[("operators", 1)]));
    run.bench.performer.closed().await
}

#[tokio::test]
async fn a_deletion_of_more_than_a_run_has_created_is_done_when_it_comes_back() -> anyhow::Result<()> {
    let mut run = Operating::new(ResourceManagerConfig::default()).await?;
    run.there_is("operators", "Box", 2).await?;
    run.does(create("Box", 1)).await?;
    run.decides(Requirement { count: 2.into(), ..delete("Box") });
    run.comes_back().await?;
    assert_eq!(run.free("Box").await?, of(&[("operators", 1)]));
    run.bench.performer.closed().await
}

#[tokio::test]
async fn what_was_made_anew_and_deleted_is_not_made_anew_where_the_next_operation_was_refused() -> anyhow::Result<()> {
    let mut run = Operating::new(ResourceManagerConfig::default()).await?;
    run.there_is("operators", "Box", 1).await?;
    run.does(create("Box", 2)).await?;
    run.decides(Requirement { count: 2.into(), ..delete("Box") });
    run.decides(consume("Glue"));
    let refused = run.comes_back().await.err().context("there is no glue")?;
    assert!(refused.to_string().contains("cannot be done now"), "{refused}");
    run.there_is("glue", "Glue", 1).await?;
    run.comes_back().await?;
    assert_eq!((run.free("Box").await?, run.free("Glue").await?), (of(&[("operators", 1)]), of(&[("glue", 0)])));
    run.bench.performer.closed().await
}

#[tokio::test]
async fn what_takes_away_and_nobody_heard_of_is_done_once_and_refused_where_the_manager_has_forgotten_it()
-> anyhow::Result<()> {
    for (operation, remembered) in
        [(delete("Box"), true), (consume("Box"), true), (delete("Box"), false), (consume("Box"), false)]
    {
        let mut config = ResourceManagerConfig::default();
        config.limits.remembered_requests = 4;
        let mut run = Operating::new(config).await?;
        run.there_is("operators", "Box", 3).await?;
        run.does_unheard(operation.clone()).await?;
        assert_eq!(run.free("Box").await?, of(&[("operators", 2)]));
        let others = if remembered { 1 } else { 8 };
        for number in 0..others {
            run.there_is(&format!("other{number}"), "Other", 1).await?;
        }
        let told = run.comes_back().await;
        assert_eq!(run.free("Box").await?, of(&[("operators", 2)]), "{operation}, {told:?}");
        assert_eq!(told.is_ok(), remembered, "{operation}: {told:?}");
        if let Err(refused) = told {
            assert!(refused.to_string().contains(&format!("whether `{operation}` was done is not known")), "{refused}");
        }
        run.bench.performer.session.close().await;
    }
    Ok(())
}

#[tokio::test]
async fn what_was_used_up_for_good_is_not_used_up_twice_where_a_run_creates_the_same_kind() -> anyhow::Result<()> {
    let mut run = Operating::new(ResourceManagerConfig::default()).await?;
    run.there_is("operators", "Glue", 3).await?;
    run.does(consume("Glue")).await?;
    run.does(create("Glue", 2)).await?;
    run.comes_back().await?;
    assert_eq!(run.free("Glue").await?, of(&[("operators", 2), ("own", 2)]));
    run.bench.performer.closed().await
}

#[tokio::test]
async fn what_was_used_up_for_good_of_a_kind_below_is_not_used_up_twice() -> anyhow::Result<()> {
    let mut run = Operating::new(glue_is_an_adhesive()).await?;
    run.there_is("operators", "Glue", 3).await?;
    run.does(consume("Adhesive")).await?;
    run.does_unheard(consume("Adhesive")).await?;
    run.comes_back().await?;
    assert_eq!(run.free("Glue").await?, of(&[("operators", 1)]));
    run.bench.performer.closed().await
}

#[tokio::test]
async fn what_a_run_used_up_that_came_back_is_used_up_of_the_same_resources_when_it_comes_back() -> anyhow::Result<()> {
    let mut run = Operating::new(ResourceManagerConfig::default()).await?;
    // The manager gives the first of equal resources.
    for (id, renewable) in [("b", true), ("c", false)] {
        let resource = Resource::new(id, ResourceClass::System, "Power").with_capacity(3);
        run.operator.create(if renewable { resource } else { resource.non_renewable() }).await?;
    }
    run.does(Requirement { count: 5.into(), ..consume("Power") }).await?;
    let before = run.free("Power").await?;
    run.comes_back().await?;
    assert_eq!(run.free("Power").await?, before);
    run.bench.performer.closed().await
}

#[tokio::test]
async fn a_run_that_is_killed_whenever_it_comes_back_makes_all_of_it_so_again_once() -> anyhow::Result<()> {
    let mut run = Operating::new(ResourceManagerConfig::default()).await?;
    run.there_is("operators", "Box", 9).await?;
    run.does(create("Box", 3)).await?;
    run.does(consume("Box")).await?;
    run.does_unheard(Requirement { count: 4.into(), ..delete("Box") }).await?;
    let there = run.free("Box").await?;
    for heard in [false, true, false, true] {
        let told = run.comes_back().await?;
        assert_eq!(run.free("Box").await?, there, "{told:?}");
        if heard {
            told.iter().for_each(|event| run.ledger.event(Timestamp(0), event));
            assert_eq!(run.ledger.session, run.bench.performer.number);
        }
    }
    run.bench.performer.closed().await
}

#[tokio::test]
async fn what_a_grant_had_used_up_that_nobody_heard_of_comes_back() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (run, instance) = (bench.performer.run.clone(), InstanceId(1));
    let channels = Channels::new(&ClientTls::none());
    let offering = ResourceClient::new(&channels, &bench.endpoints.resource_manager, bench._robot.id())?;
    let glue = Resource::new("glue", ResourceClass::System, "Glue").with_capacity(3);
    offering.create(glue.non_renewable()).await?;
    let mut requirements = arm();
    requirements.push(Requirement::new(ResourceOperation::Consume, "Glue"));
    let acquire = Command::Acquire { instance, requirements, priority: 0 };
    bench.performer.perform(acquire.clone())?;
    while bench.answers.is_empty() {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    // Task control is killed before it hears of the grant, and had withdrawn many other requests before.
    let mut ledger = ledger(&run, &[acquire]);
    ledger.withdrawn.splice(0..0, (0..2_000).map(|number| format!("{run}/i9/{number}")));
    let mut bench = bench.comes_back(true).await?;
    bench.takes_up(ledger, &World::default()).await?;
    tokio::time::timeout(SESSION_DEADLINE, bench.granted(instance)).await.context("the arm is held")??;
    let glue = bench.performer.resources.list(&["Glue"]).await?;
    assert_eq!(glue.iter().map(|one| one.free.units()).collect::<Vec<_>>(), [2], "it was used up once");
    bench.performer.closed().await
}

#[tokio::test]
async fn what_a_run_knew_when_it_decided_does_not_stand_against_it_when_it_comes_back() -> anyhow::Result<()> {
    let bench = Bench::new().await?;
    let run = bench.performer.run.clone();
    let fact = FactKey { predicate: "done".to_owned(), arguments: Vec::new() };
    let by_others = |value: i64| vec![Change::Set { fact: fact.clone(), value: Value::Int(value) }];
    bench.performer.world.commit("other/i1/1", by_others(1), None).await?;
    // The run hears of this change, and decides a commit; it is killed before that is made, and its session ends.
    let heard = Event::WorldChanged { revision: Revision(1), facts: vec![(fact.clone(), Some(Value::Int(1)))] };
    let decides = |number: u64| Command::Commit {
        instance: InstanceId(number),
        writer: "place[1]".into(),
        evidence: Vec::new(),
        changes: done(),
        revision: Revision(number),
    };
    let mut ledger = ledger(&run, &[]);
    ledger.event(Timestamp(0), &heard);
    ledger.command(&decides(2));
    let mut mirror = World::default();
    mirror.apply(&done())?;
    let mut bench = bench.comes_back(false).await?;
    bench.takes_up(ledger.clone(), &mirror).await?;
    assert_eq!(bench.performer.root().await?.0, Revision(2));
    // When it decides again, it has not heard of later changes by others.
    ledger.command(&decides(3));
    bench.performer.world.commit("other/i1/2", by_others(2), None).await?;
    let mut bench = bench.comes_back(false).await?;
    let refused = bench.takes_up(ledger, &mirror).await;
    assert!(refused.is_err_and(|error| error.to_string().contains("others have changed done")));
    assert_eq!(bench.performer.root().await?.0, Revision(3));
    bench.performer.closed().await
}

#[tokio::test]
async fn what_a_run_heard_of_during_a_motion_stands_against_its_commit_when_it_comes_back_without_what_it_held()
-> anyhow::Result<()> {
    let bench = Bench::new().await?;
    let (run, instance) = (bench.performer.run.clone(), InstanceId(1));
    let mut ledger = ledger(&run, &[start(instance, 1, "work", LeaseId(1), "")]);
    // The run is suspended during its motion, and its session ends: the next holder of the arm changes the same fact. The run goes on, hears of that
    // change before it hears of its session, and decides.
    let fact = FactKey { predicate: "done".to_owned(), arguments: Vec::new() };
    let changes = vec![Change::Set { fact: fact.clone(), value: Value::Bool(false) }];
    bench.performer.world.commit("other/i1/1", changes, None).await?;
    let heard = Event::WorldChanged { revision: Revision(1), facts: vec![(fact, Some(Value::Bool(false)))] };
    ledger.event(Timestamp(0), &heard);
    ledger.event(Timestamp(0), &finished(instance));
    ledger.command(&commits(1, 2));
    let mut mirror = World::default();
    mirror.apply(&done())?;
    let mut bench = bench.comes_back(false).await?;
    let refused = bench.takes_up(ledger.clone(), &mirror).await;
    assert!(refused.is_err_and(|error| error.to_string().contains("others have changed done")));
    let refused = bench.finishes(ledger).await;
    assert!(refused.is_err_and(|error| error.to_string().contains("others have changed done")));
    assert_eq!(bench.performer.root().await?.0, Revision(1));
    bench.performer.closed().await
}

#[tokio::test]
async fn what_ended_well_while_the_session_was_lost_is_refused_where_others_have_changed_the_same() -> anyhow::Result<()>
{
    let bench = Bench::new().await?;
    let run = bench.performer.run.clone();
    let [motion, other] = [1, 2].map(InstanceId);
    // The run is killed during two motions, and its session ends. Others change what the first motion changes.
    let mut ledger = ledger(&run, &[start(motion, 1, "work", LeaseId(1), ""), start(other, 1, "work", LeaseId(1), "")]);
    ledger.event(Timestamp(0), &finished(other));
    let fact = FactKey { predicate: "done".to_owned(), arguments: Vec::new() };
    let changes = vec![Change::Set { fact, value: Value::Bool(false) }];
    bench.performer.world.commit("other/i1/1", changes, None).await?;
    let mut bench = bench.comes_back(false).await?;
    bench.takes_up(ledger, &World::default()).await?;
    // Both motions have ended well; what begins now knows the change.
    let refused = bench.performer.perform(commits(1, 2));
    assert!(refused.is_err_and(|error| error.to_string().contains("others have changed done")));
    bench.performer.perform(Command::Note(Note::Retired { instance: motion }))?;
    bench.performer.perform(start(other, 2, "work", LeaseId(2), ""))?;
    bench.performer.perform(commits(2, 2))?;
    assert!(bench.performer.came_between.is_none());
    bench.performer.perform(commits(3, 3))?;
    let world = bench.performer.world.clone();
    bench.performer.closed().await?;
    assert_eq!(world.root().await?.0, Revision(3));
    Ok(())
}

#[tokio::test]
async fn what_others_change_when_a_run_has_come_back_stands_against_what_it_began_before() -> anyhow::Result<()> {
    let bench = Bench::new().await?;
    let run = bench.performer.run.clone();
    let ledger = ledger(&run, &[start(InstanceId(1), 1, "work", LeaseId(1), "")]);
    let fact = FactKey { predicate: "done".to_owned(), arguments: Vec::new() };
    let change = |value| vec![Change::Set { fact: fact.clone(), value: Value::Int(value) }];
    let mut bench = bench.comes_back(false).await?;
    bench.takes_up(ledger, &World::default()).await?;
    bench.performer.world.commit("other/i1/1", change(1), None).await?;
    while !matches!(bench.event().await.context("nothing is told")?, Event::WorldChanged { .. }) {}
    let refused = bench.performer.perform(commits(1, 2));
    assert!(refused.is_err_and(|error| error.to_string().contains("others have changed done")));
    bench.performer.closed().await
}

/// The commit of a composite state at its exit, as HSM mode makes it.
fn leaves(path: &str, number: u64) -> Command {
    let (instance, evidence, revision) = (InstanceId(0), Vec::new(), Revision(number));
    Command::Commit { instance, writer: path.to_owned(), changes: done(), evidence, revision }
}

#[tokio::test]
async fn what_others_change_stands_against_the_effects_of_a_composite_state_whose_parts_began_before()
-> anyhow::Result<()> {
    let note = |instance: u64, path: &str| {
        let (instance, state, path) = (InstanceId(instance), StateId(1), path.to_owned());
        Command::Note(Note::Expanded { instance, state, path, speculative: false })
    };
    let running = |instance: u64| Command::Note(Note::Running { instance: InstanceId(instance), attempt: 1 });
    let begun = [
        note(1, "part/move"),
        start(InstanceId(1), 1, "work", LeaseId(1), ""),
        note(2, "routine"),
        running(2),
        note(3, "routine/move"),
        start(InstanceId(3), 1, "work", LeaseId(1), ""),
    ];
    let (part, routine) = (leaves("part", 2), leaves("routine", 2));
    // The run had decided before it was killed, or decides after the resumption; a part may begin anew in between.
    for (by_another, again, left, is_made) in [
        ("other", None, None, true),
        ("done", None, None, false),
        ("other", None, Some(&part), true),
        ("done", None, Some(&part), false),
        ("done", Some(1), Some(&part), true),
        ("other", None, Some(&routine), true),
        ("done", None, Some(&routine), false),
        ("done", Some(3), Some(&routine), false),
    ] {
        let bench = Bench::new().await?;
        let run = bench.performer.run.clone();
        let mut ledger = Ledger { session: bench.performer.number, ..Ledger::default() };
        ledger.origin.run = run;
        let natures = Natures { changes_at_exit: vec!["part".into(), "routine".into()], ..Natures::default() };
        let origin = Box::new(Origin { natures, ..ledger.origin.clone() });
        ledger.event(Timestamp(0), &started(origin));
        begun.iter().for_each(|command| ledger.command(command));
        bench.performer.world.commit("other/i1/1", by_others(by_another), None).await?;
        // The run hears of that change during its motion.
        let heard = Event::WorldChanged { revision: Revision(1), facts: Vec::new() };
        ledger.event(Timestamp(0), &heard);
        if left.is_none() {
            ledger.command(&part);
        }
        let mut bench = bench.comes_back(false).await?;
        let mut done = bench.takes_up(ledger, &World::default()).await.map(|_| ());
        if let Some(instance) = again {
            let held = Event::Granted {
                instance: InstanceId(instance),
                lease: Lease { id: LeaseId(2), token: FencingToken(0), resources: Vec::new(), consumed: Vec::new() },
            };
            bench.performer.accept(held.into(), &World::default());
            bench.performer.perform(start(InstanceId(instance), 2, "work", LeaseId(2), ""))?;
            bench.performer.perform(Command::Note(Note::Retired { instance: InstanceId(instance) }))?;
        }
        if let Some(left) = left {
            done = bench.performer.perform(left.clone());
        }
        let case = format!("by another: {by_another}, again: {again:?}, {left:?}, {done:?}");
        assert_eq!((done.is_ok(), is_refused(done)), (is_made, !is_made), "{case}");
    }
    Ok(())
}

fn started(origin: Box<Origin>) -> Event {
    Event::Started {
        task: String::new(),
        digest: String::new(),
        mode: Mode::Hsm,
        parameters: BTreeMap::new(),
        seed: 0,
        world: Vec::new(),
        revision: Revision(0),
        capacity: BTreeMap::new(),
        learned: Learned::default(),
        breakpoints: Box::default(),
        origin,
    }
}

/// A run that was killed during two motions and has lost its session; others have changed what the first motion changes. It was resumed once, and has
/// committed since then what follows the second motion. Returns its log, and the number of its present session.
async fn taken_up_once() -> anyhow::Result<(Bench, Ledger, u64)> {
    let bench = Bench::new().await?;
    let run = bench.performer.run.clone();
    let begun = [1, 2].map(|instance| start(InstanceId(instance), 1, "work", LeaseId(1), ""));
    let mut ledger = Ledger { session: bench.performer.number, ..ledger(&run, &begun) };
    bench.performer.world.commit("other/i1/1", by_others("done"), None).await?;
    let mut bench = bench.comes_back(false).await?;
    bench.loses(&mut ledger).await?;
    let program = fetch_boxes();
    let (mut told, taken) = bench.performer.take_up(&program, ledger.clone(), &World::default(), Timestamp(0)).await?;
    told.extend(bench.performer.go_on(&program, taken).await?);
    told.iter().for_each(|event| ledger.event(Timestamp(0), event));
    let again = start(InstanceId(2), 2, "work", LeaseId(2), "");
    for command in [again, commits_what(2, 2, by_others("tidy"))] {
        bench.performer.perform(command.clone())?;
        ledger.command(&command);
    }
    bench.performer.recorded.subscribe().wait_for(|done| done.commit == Revision(2)).await?;
    let number = bench.performer.number;
    assert_eq!(ledger.session, number);
    ledger.event(Timestamp(0), &Event::Resumed { share: None });
    Ok((bench, ledger, number))
}

fn by_others(fact: &str) -> Vec<Change> {
    let fact = FactKey { predicate: fact.to_owned(), arguments: Vec::new() };
    vec![Change::Set { fact, value: Value::Int(7) }]
}

fn commits_what(instance: u64, number: u64, changes: Vec<Change>) -> Command {
    let (instance, writer) = (InstanceId(instance), "place[1]".into());
    Command::Commit { instance, writer, evidence: Vec::new(), changes, revision: Revision(number) }
}

fn is_refused<T>(done: anyhow::Result<T>) -> bool {
    done.is_err_and(|error| error.to_string().contains("others have changed done"))
}

#[tokio::test]
async fn what_others_changed_stands_against_a_commit_however_often_its_run_is_taken_up_since() -> anyhow::Result<()> {
    for lives in [true, false] {
        // The log has the commit, although a resumption was refused for it.
        let (bench, mut ledger, number) = taken_up_once().await?;
        ledger.command(&commits(1, 3));
        let mut bench = bench.comes_back_to(number, lives).await?;
        assert_eq!(bench.performer.is_own, lives);
        assert!(is_refused(bench.takes_up(ledger.clone(), &World::default()).await), "lives: {lives}");
        assert!(is_refused(bench.finishes(ledger).await), "lives: {lives}");
        assert_eq!(bench.performer.root().await?.0, Revision(2));
        // The run was killed once more, during the motion.
        let (bench, ledger, number) = taken_up_once().await?;
        let mut bench = bench.comes_back_to(number, lives).await?;
        bench.takes_up(ledger, &World::default()).await?;
        assert!(is_refused(bench.performer.perform(commits(1, 3))), "lives: {lives}");
        bench.performer.perform(start(InstanceId(1), 2, "work", LeaseId(3), ""))?;
        bench.performer.perform(commits(1, 4))?;
        let world = bench.performer.world.clone();
        bench.performer.closed().await?;
        assert_eq!(world.root().await?.0, Revision(3), "what begins now knows of it");
    }
    Ok(())
}

#[tokio::test]
async fn what_others_change_while_a_commit_waits_for_the_disk_stands_against_it_where_the_run_has_lost_what_it_held()
-> anyhow::Result<()> {
    for (by_another, is_made) in [("other", true), ("done", false)] {
        let bench = Bench::new().await?;
        let ledger = ledger(&bench.performer.run, &[start(InstanceId(1), 1, "work", LeaseId(1), "")]);
        let mut bench = bench.comes_back(false).await?;
        bench.takes_up(ledger, &World::default()).await?;
        // The run's own changes do not conflict with its commit.
        bench.performer.perform(commits(9, 1))?;
        let (disk, slow) = Mark::not_yet();
        bench.performer.perform_when(Some(slow), commits(1, 2))?;
        let mut done = bench.performer.recorded.subscribe();
        done.wait_for(|done| done.commit == Revision(1)).await?;
        bench.performer.world.commit("other/i1/1", by_others(by_another), None).await?;
        disk.send_replace(1);
        if is_made {
            done.wait_for(|done| done.commit == Revision(2)).await?;
        } else {
            let refused = async {
                loop {
                    let event = bench.event().await.context("nothing is told")?;
                    if let Event::RetirementFailed { instance, reason, unmade } = event {
                        break Ok((instance, reason, unmade));
                    }
                }
            };
            let failed: anyhow::Result<_> = tokio::time::timeout(SESSION_DEADLINE, refused).await?;
            let failed = failed?;
            assert!(failed.1.contains("others have changed done"), "{failed:?}");
            assert_eq!((failed.0, failed.2), (InstanceId(1), Unmade::Untried));
        }
        assert_eq!(bench.performer.world.root().await?.0, Revision(if is_made { 3 } else { 2 }));
    }
    Ok(())
}

#[tokio::test]
async fn a_commit_that_others_do_not_wait_for_any_more_is_made_where_they_have_not_changed_what_it_is_made_of()
-> anyhow::Result<()> {
    for (is_late, by_another, is_made) in [(false, "done", true), (true, "other", true), (true, "done", false)] {
        let mut bench = Bench::new().await?;
        bench.performer.root().await?;
        let (disk, slow) = Mark::not_yet();
        bench.performer.perform_when(Some(slow), commits(1, 1))?;
        bench.ask(InstanceId(1))?;
        let lease = bench.granted(InstanceId(1)).await?;
        if is_late {
            let since = Instant::now().checked_sub(told::PENDING_PATIENCE).context("just booted")?;
            bench.performer.left.goes_back(Revision(1), Revision(0), since);
        }
        bench.goes_on(InstanceId(1), lease, None)?;
        bench.performer.world.commit("other/i1/1", by_others(by_another), None).await?;
        disk.send_replace(1);
        let closed = bench.performer.closed().await;
        assert_eq!(closed.is_ok(), is_made, "late: {is_late}, by another: {by_another}, {closed:?}");
        assert!(is_made || closed.is_err_and(|error| error.to_string().contains("others have changed done")));
    }
    Ok(())
}

/// A run that has heard of the changes by others so far, has decided a commit, and has given back its lease behind it; after `passed`, others have
/// changed a fact. It is killed, and its session lives.
async fn gave_back_and_was_killed(
    behind: &[Command],
    passed: Duration,
    by_another: &str,
) -> anyhow::Result<(Bench, Ledger)> {
    let mut bench = Bench::new().await?;
    let (run, instance) = (bench.performer.run.clone(), InstanceId(1));
    bench.performer.world.commit("other/i1/1", by_others("done"), None).await?;
    bench.ask(instance)?;
    let lease = bench.granted(instance).await?;
    let mut ledger = Ledger { session: bench.performer.number, ..ledger(&run, &[]) };
    let held = Lease { id: lease, token: FencingToken(0), resources: Vec::new(), consumed: Vec::new() };
    ledger.event(Timestamp(0), &Event::Granted { instance, lease: held });
    let facts = vec![(FactKey { predicate: "done".to_owned(), arguments: Vec::new() }, Some(Value::Int(7)))];
    ledger.event(Timestamp(0), &Event::WorldChanged { revision: Revision(1), facts });
    behind.iter().for_each(|command| ledger.command(command));
    let release = Command::Release { instance, lease: Some(lease), projection: None };
    for command in [commits(1, 2), release.clone()] {
        ledger.command(&command);
    }
    bench.performer.perform(release)?;
    while !living(&bench).await?.is_empty() {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    bench.performer.world.commit("other/i1/2", by_others(by_another), None).await?;
    let mut bench = bench.comes_back(true).await?;
    bench.performer.speed = 10.0;
    let event = Event::Resumed { share: None };
    ledger.event(Timestamp::from_seconds(passed.as_secs_f64() * 10.0), &event);
    Ok((bench, ledger))
}

/// The leases that hold the arm.
async fn living(bench: &Bench) -> anyhow::Result<Vec<LeaseId>> {
    let arms = bench.performer.resources.list(&["Arm"]).await?;
    Ok(arms.iter().flat_map(|arm| &arm.holdings).map(|holding| holding.lease).collect())
}

#[tokio::test]
async fn a_commit_that_was_on_its_way_for_long_is_made_by_who_comes_back_where_others_have_not_changed_what_it_is_made_of()
-> anyhow::Result<()> {
    let (soon, late) = (told::PENDING_PATIENCE / 2, told::PENDING_PATIENCE + Duration::from_secs(1));
    for (passed, by_another, is_made) in [(soon, "done", true), (late, "other", true), (late, "done", false)] {
        for ends in [false, true] {
            let (mut bench, ledger) = gave_back_and_was_killed(&[], passed, by_another).await?;
            assert!(bench.performer.is_own);
            let done = if ends {
                bench.finishes(ledger).await.map(|_| ())
            } else {
                bench.takes_up(ledger, &World::default()).await.map(|_| ())
            };
            let case = format!("{passed:?}, by another: {by_another}, ends: {ends}, {done:?}");
            assert_eq!((done.is_ok(), is_refused(done)), (is_made, !is_made), "{case}");
            assert_eq!(bench.performer.world.root().await?.0, Revision(if is_made { 3 } else { 2 }), "{case}");
        }
    }
    Ok(())
}

#[tokio::test]
async fn what_was_not_late_when_its_run_was_taken_up_is_refused_where_it_is_when_its_turn_comes() -> anyhow::Result<()>
{
    // The commit is behind an operation.
    let before = [operate(9, create("Box", 1))];
    for (goes_late, is_made) in [(false, true), (true, false)] {
        let (mut bench, ledger) = gave_back_and_was_killed(&before, Duration::ZERO, "done").await?;
        bench.takes_up(ledger, &World::default()).await?;
        if goes_late {
            bench.performer.left.all_is_late();
        }
        let closed = bench.performer.closed().await;
        assert_eq!(closed.is_ok(), is_made, "{closed:?}");
        assert!(is_made || is_refused(closed));
    }
    Ok(())
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

#[tokio::test]
async fn a_commit_is_refused_where_the_world_pool_does_not_go_back_to_where_its_run_had_what_it_held()
-> anyhow::Result<()> {
    let bench = Bench::new_with(WorldPoolConfig { revisions_kept: 2, ..WorldPoolConfig::default() }).await?;
    let ledger = ledger(&bench.performer.run, &[start(InstanceId(1), 1, "work", LeaseId(1), "")]);
    for number in 1..=4 {
        bench.performer.world.commit(&format!("other/i1/{number}"), by_others("done"), None).await?;
    }
    let mut bench = bench.comes_back(false).await?;
    bench.takes_up(ledger, &World::default()).await?;
    let refused = bench.performer.perform(commits(1, 5));
    assert!(refused.is_err_and(|error| error.to_string().contains("does not keep it so long")));
    bench.performer.closed().await
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

/// `hang` ends when it is cancelled, `brake` a while after that, `work` at once.
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
        Ok(GoalOutcome::success())
    }
}

/// Lets the bench's arm perform goals.
async fn serve_arm(bench: &mut Bench) -> anyhow::Result<(ActionServer, String)> {
    let arm = ActionServer::builder("").one_at_a_time().action(Arm("hang")).action(Arm("brake")).action(Arm("work"));
    let arm = arm.build();
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

#[tokio::test]
async fn a_lease_goes_back_when_every_goal_under_it_has_ended() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (routine, motion, other) = (InstanceId(1), InstanceId(2), InstanceId(3));
    let (events, mut answers) = mpsc::channel(8);
    let mut second = connect(&bench.endpoints, "second", events).await?;
    bench.ask(routine)?;
    let lease = bench.granted(routine).await?;
    let (arm, endpoint) = serve_arm(&mut bench).await?;
    // A motion of the routine loses a race: it is cancelled, its projection goes back, and the routine ends.
    bench.performer.perform(start(motion, 1, "brake", lease, &endpoint))?;
    while arm.running() == 0 {
        tokio::task::yield_now().await;
    }
    second.perform(Command::Acquire { instance: other, requirements: self::arm(), priority: 0 })?;
    let projection = Some(ProjectionId(999));
    for command in [
        Command::Cancel { instance: motion, attempt: 1 },
        Command::Release { instance: motion, lease: None, projection },
        Command::Release { instance: routine, lease: Some(lease), projection: None },
    ] {
        bench.performer.perform(command)?;
    }
    granted_after(&mut second, &mut answers).await?;
    assert_eq!(arm.running(), 0, "whoever gets the arm finds it idle");
    second.closed().await?;
    bench.performer.closed().await
}

#[tokio::test]
async fn a_goal_waits_for_one_of_the_same_resource_that_was_told_to_stop() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (arm, endpoint) = serve_arm(&mut bench).await?;
    let start = |instance, attempt, action: &str| start(instance, attempt, action, LeaseId(1), &endpoint);
    for round in 0..20 {
        let (first, second, third) = (InstanceId(3 * round + 1), InstanceId(3 * round + 2), InstanceId(3 * round + 3));
        bench.performer.perform(start(first, 1, "hang"))?;
        while arm.running() == 0 {
            tokio::task::yield_now().await;
        }
        // A goal that a limit cuts short, and a goal on the way out, which is cut short in turn and tried again.
        bench.performer.perform(Command::Cancel { instance: first, attempt: 1 })?;
        bench.performer.perform(start(second, 1, "hang"))?;
        bench.performer.perform(Command::Cancel { instance: second, attempt: 1 })?;
        bench.performer.perform(start(second, 2, "work"))?;
        let event = bench.event().await;
        assert!(
            matches!(&event, Some(Event::Finished { instance, attempt: 2, outcome, .. })
                if *instance == second && outcome == SUCCESS),
            "round {round}: {event:?}"
        );
        bench.performer.perform(start(third, 1, "work"))?;
        let event = bench.event().await;
        assert!(matches!(&event, Some(Event::Finished { outcome, .. }) if outcome == SUCCESS), "{event:?}");
    }
    bench.performer.closed().await
}

#[tokio::test]
async fn a_goal_without_a_projection_begins_when_what_was_decided_before_it_is_in_the_root() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let [first, second, third] = [1, 2, 3].map(InstanceId);
    bench.ask(first)?;
    let lease = bench.granted(first).await?;
    let (_arm, endpoint) = serve_arm(&mut bench).await?;
    let work = |instance| start(instance, 1, "work", lease, &endpoint);
    let world = WorldClient::new(&Channels::new(&ClientTls::none()), &bench.endpoints.world_pool)?;
    // The commit is under way for long.
    let (disk, slow) = Mark::not_yet();
    let commit = Command::Commit {
        instance: first,
        writer: "place[1]".into(),
        evidence: Vec::new(),
        changes: done(),
        revision: Revision(1),
    };
    bench.performer.perform_when(Some(slow), commit)?;
    bench.performer.perform(work(first))?;
    // A goal that is cancelled meanwhile is never given; a goal with a projection does not wait.
    bench.performer.perform(work(second))?;
    bench.performer.perform(Command::Cancel { instance: second, attempt: 1 })?;
    let Command::Start { instance, attempt, mut goal } = work(third) else { bail!("it is a start") };
    goal.projection = Some(ProjectionId(999));
    bench.performer.perform(Command::Start { instance, attempt, goal })?;
    let event = bench.event().await;
    assert!(matches!(&event, Some(Event::Finished { instance, .. }) if *instance == third), "{event:?}");
    let early = tokio::time::timeout(Duration::from_millis(200), bench.event()).await;
    assert!(early.is_err(), "{early:?}");
    assert_eq!(world.root().await?.0, Revision(0));
    disk.send_replace(1);
    let event = bench.event().await;
    assert!(matches!(&event, Some(Event::Finished { instance, .. }) if *instance == first), "{event:?}");
    assert_eq!(world.root().await?.1.len(), 1);
    bench.performer.closed().await
}

#[tokio::test]
async fn a_goal_of_before_that_was_never_given_waits_for_what_was_decided_before_it() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (first, second) = (InstanceId(1), InstanceId(2));
    let (_arm, endpoint) = serve_arm(&mut bench).await?;
    // The arm is offered in a session with a short time to live, which soon proves whether it is the same.
    let channels = Channels::new(&ClientTls::none());
    let manager = bench.endpoints.resource_manager.clone();
    let robot = Session::open(&channels, &manager, "brief", Duration::from_secs(1));
    robot.alive(SESSION_DEADLINE).await?;
    let offering = ResourceClient::new(&channels, &manager, robot.id())?;
    offering.create(Resource::new("brief-arm", ResourceClass::Module, "BriefArm")).await?;
    let requirements = vec![Requirement::new(ResourceOperation::Block, "BriefArm")];
    bench.performer.perform(Command::Acquire { instance: first, requirements, priority: 0 })?;
    let lease = bench.granted(first).await?;
    let goal = |instance| {
        let Command::Start { mut goal, .. } = start(instance, 1, "work", lease, &endpoint) else {
            unreachable!("it is a start")
        };
        if let Some(lease) = &mut goal.lease {
            lease.resources[0].id = "brief-arm".to_owned();
        }
        *goal
    };
    // The commit is under way for long; the log says that both goals were given, and the provider knows neither.
    let (disk, slow) = Mark::not_yet();
    bench.performer.perform_when(Some(slow), commits(1, 1))?;
    bench.performer.start(first, 1, goal(first), Given::Before, None);
    bench.performer.start(second, 1, Goal { reads_nothing: true, ..goal(second) }, Given::Before, None);
    let event = bench.event().await;
    assert!(matches!(&event, Some(Event::Finished { instance, .. }) if *instance == second), "{event:?}");
    let early = tokio::time::timeout(Duration::from_secs(1), bench.event()).await;
    assert!(early.is_err(), "{early:?}");
    disk.send_replace(1);
    let event = bench.event().await;
    assert!(matches!(&event, Some(Event::Finished { instance, .. }) if *instance == first), "{event:?}");
    bench.performer.closed().await
}

#[tokio::test]
async fn a_motion_that_reads_nothing_does_not_wait_for_what_was_decided_before_it() -> anyhow::Result<()> {
    let mut bench = Bench::new().await?;
    let (first, second) = (InstanceId(1), InstanceId(2));
    bench.ask(first)?;
    let lease = bench.granted(first).await?;
    let (_arm, endpoint) = serve_arm(&mut bench).await?;
    let (disk, slow) = Mark::not_yet();
    bench.performer.perform_when(Some(slow), commits(1, 1))?;
    for (instance, reads_nothing) in [(first, false), (second, true)] {
        let Command::Start { attempt, goal, .. } = start(instance, 1, "work", lease, &endpoint) else {
            bail!("it is a start")
        };
        let goal = Box::new(Goal { reads_nothing, ..*goal });
        bench.performer.perform(Command::Start { instance, attempt, goal })?;
    }
    for expected in [second, first] {
        let event = bench.event().await;
        assert!(matches!(&event, Some(Event::Finished { instance, .. }) if *instance == expected), "{event:?}");
        disk.send_replace(1);
    }
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
