//! Performs the executive's commands: asks the resource manager, gives goals to providers, and passes what has to be done in order to
//! [`super::record`]. It never waits: every answer comes back as an event.

mod acquiring;
mod came_between;
mod claim;
mod closing;
mod giving_back;
mod goal;
mod goals;
mod handover;
mod made_anew;
mod order;
mod resume;
mod starting;
#[cfg(test)]
mod tests;
mod told;
mod waiting;
mod wanted;
mod watch;

pub(super) use resume::{check_world, missing_commits, remembers};

use super::ledger::{Began, Confirmed, Projecting, acquire_request, claim_request, late_request};
use super::outside::Outside;
use super::promises::{Making, Promises};
use super::record::{Cancelled, Decided, MAX_PENDING_RECORDS, Named, Record, Recorded, Recorder, Root};
use super::shell::{Place, Urgency};
use crate::background_runtime::BackgroundRuntime;
use crate::messages::Messages;
use crate::safe_on_disk::Mark;
use crate::waits_for::Waiting as Recording;
use acquiring::Acquiring;
use anyhow::{Context, bail};
use came_between::{CameBetween, Left};
pub(crate) use came_between::{Overtaken, Untouched};
use claim::claim_as;
pub use claim::{RUN_KIND, claim};
use futures::FutureExt;
use goal::Given;
use goals::Goals;
use handover::{Handover, Leases};
use order::Operations;
use ratn_executive::protocol::{CERTAIN, Command, Event, Note};
use ratn_model::catalogue::Catalogue;
use ratn_model::fact::FactKey;
use ratn_model::id::{InstanceId, LeaseId, Revision};
use ratn_model::program::{Nature, Program, State, StateKind};
use ratn_model::resource::Requirement;
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_otlp::ids;
use ratn_proto::types::WorldChange;
use ratn_worker::client::retry_unanswered;
use ratn_worker::client::{AcquireOptions, ActionClient, Channels, ResourceClient, WorldClient};
use ratn_worker::session::{DEFAULT_TTL, Session, SessionState, Standing, Trust};
use ratn_worker::trace::{self, TraceContext};
use ratn_world::world::World;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio_util::sync::{CancellationToken, DropGuard};
use tokio_util::task::AbortOnDropHandle;
use told::Told;
use waiting::{Asking, Waiting, beside_others};
use wanted::HoldsSpeculatively;

/// A resource manager that does not open a session within this time counts as absent.
const SESSION_DEADLINE: Duration = Duration::from_secs(5);
/// Maximum time for which a task waits for its resources.
const ACQUIRE_DEADLINE: Duration = Duration::from_secs(3600);
/// A wait longer than this is reported if no goal is under way, and
const LONG_WHILE_IDLE: Duration = Duration::from_secs(4);
/// a wait longer than this in any case.
const LONG: Duration = Duration::from_secs(30);
/// Maximum length of a holder's name in characters, half of it for the task: the resource manager takes 128 unless configured otherwise.
const MAX_HOLDER: usize = 120;

/// The holder of a lease, for people: the task, and the path of the state (of a long path, its end).
fn holder(task: &str, path: &str) -> String {
    let task: String = task.chars().take(MAX_HOLDER / 2).collect();
    let room = MAX_HOLDER - task.chars().count() - ": …".chars().count();
    match path.chars().count() {
        length if length <= room => format!("{task}: {path}"),
        length => format!("{task}: …{}", path.chars().skip(length - room).collect::<String>()),
    }
}

/// The paths of the states of a program whose goals change nothing in the environment.
fn only_looks(program: &Program) -> BTreeSet<String> {
    let looks = |state: &&State| {
        matches!(state.kind, StateKind::Action { .. }) && state.annotations.nature != Nature::Irreversible
    };
    program.states.iter().filter(looks).map(|state| state.path.clone()).collect()
}

/// Whether a session was opened by a resumption that died before it had restored the run's resources in it: then nothing in it is the run's. `before`
/// is the number of the run's own session, 0 if unknown.
fn is_of_a_resumption(session: &Session, before: Option<u64>) -> bool {
    let state = session.state();
    let SessionState { found, number, .. } = *state.borrow();
    found && before.is_some_and(|before| before != 0 && number != 0 && before != number)
}

/// The clients to ask if something is not told in time.
struct Whom {
    resources: ResourceClient,
    world: WorldClient,
    told: Told,
}

impl told::Ask for Whom {
    async fn root(&self) -> Option<Revision> {
        self.world.diff(self.told.revision(), None, &[]).await.ok().map(|(_, root)| root)
    }

    async fn is_under_way(&self, run: &str) -> Option<bool> {
        let runs = self.resources.list(&[RUN_KIND]).await.ok()?;
        Some(runs.iter().any(|other| other.id == run))
    }
}

/// A message on its way to the executive.
#[derive(Debug)]
pub(super) enum Answer {
    /// An event.
    Event {
        event: Box<Event>,
        /// For an acquire: how to tell whether it was withdrawn meanwhile.
        withdrawn: Option<Withdrawal>,
    },
    /// A revision of the root, by this run or another.
    World(WorldChange),
    /// Another run waits for the resources of these leases, and certainly needs them.
    Wanted(Vec<LeaseId>),
}

/// The withdrawal of an acquire, as its answer knows it.
#[derive(Debug)]
pub(super) struct Withdrawal {
    /// Cancelled when the acquire is withdrawn.
    token: CancellationToken,
    /// Held until a lease that was granted all the same has gone back.
    over: Arc<DropGuard>,
}

impl From<Event> for Answer {
    fn from(event: Event) -> Answer {
        Answer::Event { event: Box::new(event), withdrawn: None }
    }
}

/// Performs the commands of one run.
pub(super) struct Performer {
    run: String,
    program: Arc<Program>,
    /// The paths (without visits) of the states whose goals only compute or sense.
    only_looks: BTreeSet<String>,
    urgency: Urgency,
    standing: Standing,
    /// The robot's seconds per second.
    speed: f64,
    catalogue: Arc<Catalogue>,
    messages: Messages,
    resources: ResourceClient,
    actions: ActionClient,
    channels: Channels,
    world: WorldClient,
    session: Session,
    /// The number of the session at the manager.
    number: u64,
    /// Whether a resumption has found the run's own session, with everything that the run has in it.
    is_own: bool,
    /// Whether the run's session lives.
    trust: Trust,
    /// Runs the keep-alive of the session, whatever this thread does.
    _background: BackgroundRuntime,
    /// Tasks that look for other runs, and for what those need.
    _others: [AbortOnDropHandle<()>; 2],
    events: mpsc::Sender<Answer>,
    records: mpsc::Sender<Record>,
    /// The task that performs the records.
    recorder: AbortOnDropHandle<()>,
    /// What the recorder waits for.
    recording: Recording,
    /// How far the pool's root is known.
    root: Root,
    outside: Outside,
    /// For a run that was resumed without its leases: while anything from before is under way.
    came_between: Option<CameBetween>,
    /// Leases that were given back while commits were under way.
    left: Left,
    told: Told,
    /// The run's own number of its last commit.
    decided: Revision,
    /// The task that receives the root's revisions.
    following: Option<AbortOnDropHandle<()>>,
    cancelled: Cancelled,
    recorded: Recorded,
    /// How much of `recorded` the executive was told.
    heard: Confirmed,
    /// Promised ids of projections: goals may start before these exist.
    promises: Promises,
    making: Making,
    /// Cancelled when nothing may begin any more.
    over: CancellationToken,
    asking: Waiting,
    leases: Leases,
    holds: HoldsSpeculatively,
    /// The paths of the instances in the window, to name the holders of leases.
    paths: BTreeMap<InstanceId, String>,
    /// The handover by the present commands.
    handover: Option<Handover>,
    goals: Goals,
    giving_back: JoinSet<()>,
    order: Operations,
    acquires: u64,
    operations: u64,
    /// How often the run has been resumed.
    resumptions: u32,
    /// The run's place in its trace.
    trace: TraceContext,
}

impl Performer {
    /// Opens the run's session and begins to accept commands. The session has the run's id, so that whoever resumes the run continues it; `before` is
    /// its number by the run's log. `trace` is the place of the run in its trace.
    pub(super) async fn connect(
        place: &Place,
        run: &str,
        program: &Arc<Program>,
        before: Option<u64>,
        trace: TraceContext,
        events: mpsc::Sender<Answer>,
    ) -> anyhow::Result<Performer> {
        let channels = Channels::new(&place.tls);
        let run = run.to_owned();
        let manager = &place.endpoints.resource_manager;
        let background = BackgroundRuntime::start("session").context("cannot keep a session alive")?;
        // The session has a connection of its own.
        let standing = place.standing;
        let open = || {
            let channels = Channels::new(&place.tls);
            Session::open_beside(&channels, manager, run.clone(), "task-control", DEFAULT_TTL, standing)
        };
        let mut session = background.enter(open);
        session.alive(SESSION_DEADLINE).await?;
        if is_of_a_resumption(&session, before) {
            session.close().await;
            session = background.enter(open);
            session.alive(SESSION_DEADLINE).await?;
            if is_of_a_resumption(&session, before) {
                bail!("the session of a resumption that was killed has not ended yet: resume the run again");
            }
        }
        let SessionState { found: is_own, number, .. } = *session.state().borrow();
        let resources = ResourceClient::new(&channels, manager, session.id())?;
        let told = Told::new(&run);
        let others = claim::look_for_others(resources.clone(), run.clone(), told.clone());
        let others = AbortOnDropHandle::new(tokio::spawn(others));
        let request = if is_own { String::new() } else { claim_request(&run, number) };
        match claim_as(&request, &resources, &run, &program.name, place.alone).await {
            Ok(has_others) => told.beside_others(has_others),
            // What a resumed run holds is still its own.
            Err(refused) if is_own => {
                session.abandon().await;
                return Err(refused);
            }
            Err(refused) => {
                session.close().await;
                return Err(refused);
            }
        }
        let world = WorldClient::new(&channels, &place.endpoints.world_pool)?;
        let holds = HoldsSpeculatively::default();
        let listening = wanted::listen(resources.clone(), run.clone(), told.clone(), holds.clone(), events.clone());
        let listening = AbortOnDropHandle::new(tokio::spawn(listening));
        let (records, work) = mpsc::channel(MAX_PENDING_RECORDS);
        let (cancelled, recorded) = (Cancelled::default(), Recorded::default());
        let (promises, root, trust) = (Promises::default(), Root::default(), session.trust());
        let recording = Recording::default();
        let recorder = Recorder {
            run: run.clone(),
            world: world.clone(),
            resources: resources.clone(),
            cancelled: cancelled.clone(),
            done: recorded.clone(),
            events: events.clone(),
            trust: trust.clone(),
            session: number,
            trace,
            root: root.clone(),
            promises: promises.clone(),
            waiting: recording.clone(),
        };
        tracing::debug!(run, trace = %trace.trace_id(), "calls of this run are of one trace");
        let recorder = AbortOnDropHandle::new(tokio::spawn(trace::within(trace, recorder.work(work))));
        Ok(Performer {
            run,
            program: Arc::clone(program),
            only_looks: only_looks(program),
            urgency: place.urgency,
            standing,
            speed: place.speed,
            catalogue: place.catalogue.clone(),
            messages: place.messages.clone(),
            resources,
            actions: ActionClient::new(channels.clone()),
            channels,
            world,
            session,
            number,
            is_own,
            trust,
            _background: background,
            _others: [others, listening],
            events,
            records,
            recorder,
            recording,
            root,
            outside: Outside::default(),
            came_between: None,
            left: Left::default(),
            told,
            decided: Revision::default(),
            following: None,
            cancelled,
            recorded,
            heard: Confirmed::default(),
            over: CancellationToken::new(),
            promises,
            making: Making::default(),
            asking: Waiting::default(),
            leases: Leases::default(),
            holds,
            paths: BTreeMap::new(),
            handover: None,
            goals: Goals::default(),
            giving_back: JoinSet::new(),
            order: Operations::default(),
            acquires: 0,
            operations: 0,
            resumptions: 0,
            trace,
        })
    }

    /// The root world as it is now; [`Performer::accept`] receives every later revision.
    pub(super) async fn root(&mut self) -> anyhow::Result<(Revision, Vec<(FactKey, Value)>)> {
        let (revision, facts) = retry_unanswered(|| self.world.root()).await?;
        self.follow(revision);
        Ok((revision, facts.into_iter().map(|fact| (fact.key, fact.value)).collect()))
    }

    /// Receives every revision of the root after this one.
    fn follow(&mut self, after: Revision) {
        self.root.reached(after);
        self.told.root(after);
        let following = watch::follow(self.world.clone(), after, self.events.clone(), self.told.clone());
        self.following = Some(AbortOnDropHandle::new(tokio::spawn(following)));
    }

    /// How far the decisions are performed.
    pub(super) fn confirmed(&self) -> Confirmed {
        *self.recorded.borrow()
    }

    fn confirm(&mut self, confirmed: Confirmed) {
        self.recorded.send_replace(confirmed);
        self.heard = confirmed;
    }

    /// Resolves when the session with the resource manager, and with it every lease, is gone. A silent manager is waited for, also with a motion
    /// under way: its provider keeps the robot at standstill meanwhile, and a manager that was suspended still knows what the run holds.
    pub(super) async fn lost(&self) {
        self.session.gone().await;
    }

    /// Prepares for all commands of an event; they are performed next.
    pub(super) fn prepare(&mut self, event: &Event, commands: &[Command]) {
        for command in commands {
            match command {
                Command::Note(Note::Expanded { instance, path, .. }) => {
                    self.paths.insert(*instance, path.clone());
                }
                Command::Note(Note::Retired { instance } | Note::Squashed { instance } | Note::Merged { instance }) => {
                    self.paths.remove(instance);
                    self.asking.forget(*instance);
                }
                _ => {}
            }
        }
        // Beside other runs the resource manager decides who comes next. A lease that goes back may contain what the run uses up.
        let operates = |command: &Command| matches!(command, Command::Operate { .. });
        let is_free = !self.told.has_others() && self.order.operating.is_empty() && !commands.iter().any(operates);
        let handover = is_free.then(|| self.leases.handover(event, commands, &self.asking, Instant::now()));
        // A lease for which something may still move goes back as such.
        self.handover = handover.flatten().filter(|one| !self.goals.doubtful.has(one.lease.id));
        // Nothing is handed to an instance whose answer is under way: the lease goes back.
        self.handover.take_if(|one| one.waits && self.asking.hand(one.to, &one.lease) != Some(Ok(())));
    }

    /// Adds the paths of instances that were expanded before this performer existed.
    pub(super) fn know(&mut self, paths: &BTreeMap<InstanceId, String>) {
        self.paths.extend(paths.iter().map(|(instance, path)| (*instance, path.clone())));
    }

    /// The number of the run's session.
    pub(super) fn session(&self) -> u64 {
        self.number
    }

    /// The standing of the run beside others.
    pub(super) fn standing(&self) -> Standing {
        self.standing
    }

    /// The id of the run.
    pub(super) fn run(&self) -> &str {
        &self.run
    }

    /// Begins to perform a command; an irreversible one only when everything before it is safe on disk.
    pub(super) fn perform_when(&mut self, safe: Option<Mark>, command: Command) -> anyhow::Result<()> {
        while self.giving_back.try_join_next().is_some() {}
        let untouched = self.follow_what_was_lost(&command)?;
        match command {
            // The shell handles wakes: it has the clock.
            Command::Note(_) | Command::End { .. } | Command::Wake { .. } => {}
            Command::Acquire { instance, requirements, priority } => {
                self.acquires += 1;
                self.acquire(instance, self.acquires, requirements, priority);
            }
            Command::Withdraw { instance } => {
                if let Some(asking) = self.asking.withdraw(instance) {
                    self.order.returning.add(asking.over);
                    asking.withdrawn.cancel();
                }
            }
            Command::Project { instance, attempt, base, changes, writers, reads, lease, first } => {
                let asked = Projecting { attempt, base, changes, writers, reads, lease, first, named: None };
                self.project(instance, asked)?;
            }
            Command::Start { instance, attempt, goal } => {
                self.start(instance, attempt, *goal, Given::Now, safe);
            }
            Command::Cancel { instance, attempt } => {
                if !self.goals.cancel(instance, attempt) {
                    self.cancelled.lock().unwrap_or_else(PoisonError::into_inner).insert((instance, attempt));
                }
            }
            Command::Release { instance, lease, projection } => {
                let goes_back = |id: &LeaseId| self.handover.as_ref().is_none_or(|handover| handover.lease.id != *id);
                let lease = lease.filter(goes_back);
                self.release(instance, lease, projection, safe);
            }
            Command::Commit { instance, writer, changes, evidence, revision } => {
                let (knew, behind) = (self.told.revision(), self.operations);
                let (began, guard) = (Began { knows: knew, held_until: None }, None);
                let decided = Decided { instance, writer, changes, evidence, revision, began, guard, knew, behind };
                let late =
                    || Untouched::behind(&self.program, &self.run, self.root.get()).when_late(&self.left, revision);
                self.commit(decided, Some(untouched.unwrap_or_else(late)), safe)?;
            }
            Command::Operate { instance, operations } => {
                self.operations += 1;
                self.operate(instance, self.operations, operations, safe)?;
            }
        }
        Ok(())
    }

    /// The run is over, or has failed: what has not begun does not begin any more.
    pub(super) fn begin_no_more(&self) {
        self.over.cancel();
    }

    fn record(&self, record: Record) -> anyhow::Result<()> {
        if self.records.try_send(record).is_err() {
            bail!("the world pool is more than {MAX_PENDING_RECORDS} requests behind, or gone");
        }
        Ok(())
    }

    /// For a run that was resumed without its leases: the condition under which a commit is made whose state had begun before. What begins from now
    /// on begins with what the run holds.
    fn follow_what_was_lost(&mut self, command: &Command) -> anyhow::Result<Option<Untouched>> {
        let Some(between) = &mut self.came_between else { return Ok(None) };
        let untouched = between.check(command)?;
        between.command(command, self.told.revision());
        self.came_between.take_if(|between| between.is_over());
        Ok(untouched)
    }

    fn commit(&mut self, decided: Decided, untouched: Option<Untouched>, safe: Option<Mark>) -> anyhow::Result<()> {
        self.outside.decided(&self.run, &decided);
        self.decided = decided.revision;
        self.record(Record::Commit { decided, untouched: untouched.map(Box::new), safe })
    }

    fn operate(
        &mut self,
        instance: InstanceId,
        number: u64,
        operations: Vec<Requirement>,
        safe: Option<Mark>,
    ) -> anyhow::Result<()> {
        let order = self.order.next(safe);
        self.record(Record::Operate { instance, number, operations, order })
    }

    /// If the projection need not exist first, its goal starts at once, given a promised id.
    fn project(&mut self, instance: InstanceId, asked: Projecting) -> anyhow::Result<()> {
        let behind = self.records.max_capacity() - self.records.capacity();
        let told = if asked.first { None } else { self.events.clone().try_reserve_owned().ok() };
        let Some((told, id)) = told.and_then(|told| Some((told, self.promises.take(behind, Instant::now())?))) else {
            return self.record(Record::Project { instance, asked, named: None });
        };
        let (attempt, made) = (asked.attempt, self.making.begin(id));
        self.record(Record::Project { instance, asked, named: Some(Named { id, made, again: false }) })?;
        told.send(Event::Projected { instance, attempt, projection: id }.into());
        Ok(())
    }

    fn acquire(&mut self, instance: InstanceId, number: u64, requirements: Vec<Requirement>, priority: i64) {
        let request = acquire_request(&self.run, instance, number, self.resumptions);
        let course = self.asking.begin(instance, number, request.clone(), requirements.clone(), priority);
        if let Some(handover) = self.handover.as_ref().filter(|one| one.to == instance && !one.waits) {
            let _ = self.asking.hand(instance, &handover.lease);
        }
        let acquiring = Acquiring {
            instance,
            requirements,
            catalogue: self.catalogue.clone(),
            options: AcquireOptions {
                request,
                priority: beside_others(priority, self.urgency),
                speculative: priority < CERTAIN,
                instead_of: course.instead_of,
                deadline: ACQUIRE_DEADLINE,
                holder: holder(
                    &self.program.name,
                    self.paths.get(&instance).map_or(&instance.to_string(), |path| path),
                ),
            },
            waited: course.waited,
            after: self.order.operating.all(),
            withdrawn: course.withdrawn,
            handed: course.handed,
            resources: self.resources.clone(),
            trust: self.trust.clone(),
            over: course.over,
            told: self.told.clone(),
            doubtful: self.goals.doubtful.clone(),
            whom: Whom { resources: self.resources.clone(), world: self.world.clone(), told: self.told.clone() },
        };
        let mut asking = Box::pin(trace::within(self.of(instance), acquiring.ask(self.events.clone())));
        // The request is sent here and now: spawned tasks, and so requests, would run in any order.
        if asking.as_mut().now_or_never().is_none() {
            tokio::spawn(asking);
        }
    }

    /// The instance that has waited longest for resources, if that is longer than an observer of the run expects.
    pub(super) fn waits(&self) -> Option<InstanceId> {
        let bound = if self.goals.are_idle() { LONG_WHILE_IDLE } else { LONG };
        let (instance, longest) = self.asking.longest()?;
        (longest.since.elapsed() >= bound).then_some(instance)
    }

    /// Reports what is in the way of a waiting instance, in the resource manager's words.
    pub(super) fn say_why(&self, at: Timestamp, instance: InstanceId, path: String) {
        let Some(Asking { request, since, .. }) = self.asking.get(instance) else { return };
        let (resources, request, waited_s) = (self.resources.clone(), request.clone(), since.elapsed().as_secs());
        let messages = self.messages.clone();
        tokio::spawn(async move {
            // If the acquire has its answer by now, it does not wait any more.
            let waiting = match resources.explain(&request).await {
                Ok(waiting) => waiting,
                Err(_) => match resources.explain(&late_request(&request)).await {
                    Ok(waiting) => waiting,
                    Err(_) => return,
                },
            };
            let obstacles: Vec<String> = waiting.into_iter().flat_map(|one| one.obstacles).collect();
            let why = if obstacles.is_empty() { "its turn".to_owned() } else { obstacles.join("; ") };
            let at = at.seconds();
            messages.say(format_args!("{at:>8.1} s  waits  {path}  for {waited_s} s: {why}"));
        });
    }

    /// The event of an answer; `None` if the acquire or goal was withdrawn or cancelled: what it was granted meanwhile goes back.
    pub(super) fn accept(&mut self, answer: Answer, mirror: &World) -> Option<Event> {
        let (event, withdrawn) = match answer {
            Answer::Event { event, withdrawn } => (*event, withdrawn.filter(|one| one.token.is_cancelled())),
            Answer::World(change) => {
                self.root.reached(change.revision);
                let maker = told::maker(&change.commit).map(|(run, _)| run);
                if maker.as_ref().is_some_and(|run| *run != self.run) {
                    self.told.beside_others(true);
                }
                if let Some(between) = &mut self.came_between {
                    between.told(&change);
                }
                return self.outside.told(change, mirror);
            }
            Answer::Wanted(leases) => {
                let holders: Vec<InstanceId> =
                    leases.into_iter().filter_map(|lease| self.leases.speculative_holder(lease)).collect();
                return (!holders.is_empty()).then_some(Event::WantedByOthers { holders });
            }
        };
        match event {
            Event::Granted { instance, lease } if let Some(Withdrawal { over, .. }) = &withdrawn => {
                self.give_back(instance, Some(lease.id), None, Some(Arc::clone(over)));
                None
            }
            _ if withdrawn.is_some() => None,
            Event::Projected { instance, attempt, projection } if self.was_cancelled(instance, attempt) => {
                self.give_back(instance, None, Some(projection), None);
                None
            }
            Event::Crashed { instance, attempt, .. } if self.was_cancelled(instance, attempt) => None,
            event => {
                if let Event::Granted { instance, .. } | Event::Refused { instance, .. } = &event {
                    let asked = self.asking.answered(*instance);
                    if let Some(between) = &mut self.came_between {
                        between.event(&event, self.told.revision());
                    }
                    if let (Event::Granted { lease, .. }, Some(asked)) = (&event, asked) {
                        self.leases.granted(*instance, lease, (asked.requirements, asked.priority), Instant::now());
                        self.holds.set(self.leases.has_speculative());
                    }
                }
                match &event {
                    Event::Recorded { operation, .. } => self.heard.operation = self.heard.operation.max(*operation),
                    Event::RetirementFailed { instance, unmade, .. } => {
                        self.heard.failed = self.heard.failed.or(Some((*instance, *unmade)))
                    }
                    _ => {}
                }
                // The goal may also go on if its projection could not be made.
                if let Event::Crashed { instance, attempt, .. } = &event {
                    // If the world pool was started again, it has promised nothing.
                    self.promises.forget();
                    self.goals.cancel(*instance, *attempt);
                }
                Some(event)
            }
        }
    }

    /// The place of an instance in the trace of the run.
    fn of(&self, instance: InstanceId) -> TraceContext {
        self.trace.at(ids::instance(instance.0))
    }

    fn was_cancelled(&self, instance: InstanceId, attempt: u32) -> bool {
        self.cancelled.lock().unwrap_or_else(PoisonError::into_inner).remove(&(instance, attempt))
    }
}
