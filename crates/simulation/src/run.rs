//! One run of one task in virtual time: the same loop as the real task control's (receive, handle, perform), with the cores
//! called directly.

mod agenda;
mod busy;
mod circumstances;
mod resume;

pub use circumstances::{Checks, Circumstances, MAX_EVENTS, Mischief, Trigger};

use crate::dice::Dice;
use agenda::{Agenda, Entry};
use busy::Busy;
use ratn_executive::executive::Executive;
use ratn_executive::lookahead::{Lookout, Memory, Problem, Search};
use ratn_executive::protocol::{CERTAIN, Command, Event, Goal, LogEntry, LogLine, Mode};
use ratn_model::catalogue::ResourceOffer;
use ratn_model::fact::{Change, FactKey, Footprint};
use ratn_model::id::{InstanceId, LeaseId, ProjectionId, Revision};
use ratn_model::program::Program;
use ratn_model::resource::{Quantity, ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_resources::{AcquireRequest, Kinds, Limits, Notice, Pool, ResourceSpec, SessionId, WaiterId};
use ratn_world::world::World;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

/// Number of facts of the executive's mirror that are compared with the root at each revision.
const COMPARED_FACTS: usize = 256;

/// When a duration differed from its estimate, a short look-ahead tries this fraction (1/10) of the orders.
const GLANCE_PART: usize = 10;

/// Limit of log lines per allowed event, because one event may expand thousands of states without actions, again and again …
const LINES_PER_EVENT: usize = 20;

/// … and limit of log lines in total, at most a gigabyte.
const MAX_LINES: usize = 3_000_000;

/// The environment.
pub trait Oracle {
    /// The course of a goal. `world` is its projection, or the actual world if it has none.
    fn perform(&mut self, path: &str, attempt: u32, goal: &Goal, world: &World) -> Performance;

    /// Results after the first one, for a goal that may improve; by default none.
    fn better(&mut self, path: &str, attempt: u32, goal: &Goal, first: &BTreeMap<String, Value>) -> Option<Better> {
        let _ = (path, attempt, goal, first);
        None
    }

    /// The event that ends a wait, after this number of virtual seconds; by default none.
    fn awaited(&mut self, path: &str, instance: InstanceId) -> Option<(f64, Event)> {
        let _ = (path, instance);
        None
    }
}

/// The course of a goal.
#[derive(Debug, Clone, PartialEq)]
pub struct Performance {
    /// Virtual seconds until it answers.
    pub duration_s: f64,
    /// What it answers.
    pub answer: Answer,
}

/// Results after the first result of a goal.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Better {
    /// Each with the virtual seconds after the first result, its output ports and its cost.
    pub results: Vec<(f64, BTreeMap<String, Value>, f64)>,
    /// The end of the goal, with the virtual seconds after the first result; `None` if it goes on until it is cancelled.
    pub end: Option<(f64, Answer)>,
}

/// The end of a goal.
#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    /// The goal has ended.
    Finished {
        /// The outcome.
        outcome: String,
        /// The output ports.
        outputs: BTreeMap<String, Value>,
        /// The measured facts.
        measured: Vec<(FactKey, Value)>,
    },
    /// Its worker died.
    Crashed,
    /// The goal's resource vanished, and with it its lease; another resource of the same kind replaces it.
    LeaseLost,
}

/// The setup of a run.
pub struct Setup {
    /// The task.
    pub program: Arc<Program>,
    /// The mode.
    pub mode: Mode,
    /// Its parameters, all bound.
    pub parameters: BTreeMap<String, Value>,
    /// The run's seed.
    pub seed: u64,
    /// All resources, by kind.
    pub resources: Vec<(String, ResourceOffer)>,
    /// The facts that hold before the task's own initial world.
    pub world: Vec<(FactKey, Value)>,
    /// Tolerance for measured values.
    pub tolerance: Tolerance,
    /// Leases and projections take up to this long, at random by the seed, so that messages can cross.
    pub latency: Duration,
}

/// The result of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Run {
    /// When it ended, in virtual seconds.
    pub end_s: f64,
    /// The task's outcome.
    pub outcome: String,
    /// Its outputs.
    pub outputs: BTreeMap<String, Value>,
    /// Reason, if the outcome is not success.
    pub reason: String,
    /// The event log.
    pub log: Vec<LogLine>,
    /// The root world at the end.
    pub world: World,
    /// The task resources left at the end, by kind.
    pub units: BTreeMap<String, Quantity>,
}

/// Error: a run did not end as it should, because one of the cores is wrong.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RunError {
    /// Nothing is under way, but the task has not ended.
    #[error("at {at_s:.3} s nothing is under way and the task has not ended; {}", waits.join("; "))]
    Stuck {
        /// When.
        at_s: f64,
        /// Which instance waits for what.
        waits: Vec<String>,
    },
    /// There were more events than the limit.
    #[error("no end after {0} events")]
    Endless(usize),
    /// The caller stopped the simulation.
    #[error("it was ended at {at_s:.3} s of the task, before its end")]
    Stopped {
        /// When, in the run.
        at_s: f64,
    },
    /// There were more log lines than the limit.
    #[error("no end after {0} lines of its event log")]
    TooLong(usize),
    /// An invariant does not hold.
    #[error("at {at_s:.3} s: {problem}")]
    Broken {
        /// When.
        at_s: f64,
        /// What is wrong.
        problem: String,
    },
}

struct Simulation<'a> {
    now: Timestamp,
    pool: Pool,
    session: SessionId,
    root: World,
    /// The root at each revision.
    roots: BTreeMap<Revision, World>,
    /// The last revision at which the executive's mirror was found equal to the root.
    mirrored: Option<Revision>,
    projections: BTreeMap<ProjectionId, World>,
    /// Projections asked for: the world pool makes one per instance and attempt.
    projected: BTreeSet<(InstanceId, u32)>,
    /// Projections that the executive knows and will release itself.
    told: BTreeSet<ProjectionId>,
    next_projection: u64,
    waiters: BTreeMap<InstanceId, WaiterId>,
    /// The same by waiter.
    waiting: BTreeMap<WaiterId, InstanceId>,
    leases: BTreeMap<LeaseId, InstanceId>,
    /// Leases that have ended by a loss.
    lost: BTreeSet<LeaseId>,
    /// Instances whose requests will be refused.
    refusing: BTreeSet<InstanceId>,
    grants: BTreeMap<InstanceId, u32>,
    circumstances: Circumstances,
    paths: BTreeMap<InstanceId, String>,
    busy: Busy,
    agenda: Agenda,
    latency: Duration,
    dice: Dice,
    oracle: &'a mut dyn Oracle,
    log: Vec<LogLine>,
    end: Option<(String, BTreeMap<String, Value>, String)>,
}

/// Makes the run. After every event the pool and the executive's mirror are checked ([`Checks::Environment`]).
///
/// # Errors
/// [`RunError`] if a core is wrong: the run gets stuck, never ends, or an invariant does not hold.
pub fn run(setup: Setup, oracle: &mut dyn Oracle) -> Result<Run, RunError> {
    run_looking_ahead(setup, oracle, 0)
}

/// As [`run`]; whenever much of the window has changed, look-ahead simulates `orders` orders of the remaining work and advises the executive
/// of a better one. 0 is plain dispatch.
///
/// # Errors
/// As [`run`].
pub fn run_looking_ahead(setup: Setup, oracle: &mut dyn Oracle, orders: usize) -> Result<Run, RunError> {
    run_under(setup, oracle, Circumstances { orders, ..Circumstances::default() })
}

/// As [`run`], with further circumstances.
///
/// # Errors
/// As [`run`].
pub fn run_under(setup: Setup, oracle: &mut dyn Oracle, circumstances: Circumstances) -> Result<Run, RunError> {
    run_while(setup, oracle, circumstances, &|| true)
}

/// As [`run_under`], as long as `goes_on` returns true; it is called before every event.
///
/// # Errors
/// As [`run`]; [`RunError::Stopped`].
pub fn run_while(
    setup: Setup,
    oracle: &mut dyn Oracle,
    circumstances: Circumstances,
    goes_on: &dyn Fn() -> bool,
) -> Result<Run, RunError> {
    let (orders, max_events) = (circumstances.orders, circumstances.max_events);
    let max_lines = max_events.saturating_mul(LINES_PER_EVENT).min(MAX_LINES);
    let (mut resume_after, learned) = (circumstances.resume_after, circumstances.learned.clone());
    let mut root = World::default();
    let initial: Vec<Change> =
        setup.world.iter().map(|(fact, value)| Change::Set { fact: fact.clone(), value: value.clone() }).collect();
    let broken = |at: Timestamp, problem: String| RunError::Broken { at_s: at.seconds(), problem };
    root.apply(&initial).map_err(|e| broken(Timestamp(0), e.to_string()))?;
    let kinds = Kinds::new(&setup.program.kinds).map_err(|error| broken(Timestamp(0), error.to_string()))?;
    let mut pool = Pool::new(Limits::default()).with_kinds(kinds);
    let session = SessionId::from("task");
    let forever = Duration::from_secs(10 * 365 * 24 * 3600);
    pool.keep_alive(Timestamp(0), &session, "simulation", forever).map_err(|e| broken(Timestamp(0), e.to_string()))?;
    offer(&mut pool, &setup.resources, &circumstances.attributes).map_err(|e| broken(Timestamp(0), e))?;
    let mut simulation = Simulation {
        now: Timestamp(0),
        pool,
        session,
        roots: BTreeMap::from([(root.revision(), root.clone())]),
        root,
        mirrored: None,
        projections: BTreeMap::new(),
        projected: BTreeSet::new(),
        told: BTreeSet::new(),
        next_projection: 0,
        waiters: BTreeMap::new(),
        waiting: BTreeMap::new(),
        leases: BTreeMap::new(),
        lost: BTreeSet::new(),
        refusing: BTreeSet::new(),
        grants: BTreeMap::new(),
        circumstances,
        paths: BTreeMap::new(),
        busy: Busy::new(setup.program.clone()),
        agenda: Agenda::default(),
        latency: setup.latency,
        dice: Dice(setup.seed),
        oracle,
        log: Vec::new(),
        end: None,
    };
    let mut executive = Executive::new(setup.program.clone(), setup.tolerance);
    let mut lookout = Lookout::default();
    let mut memory = Memory::default();
    simulation.send_before(&mut executive)?;
    simulation.at(
        Duration::ZERO,
        Event::Started {
            task: setup.program.name.clone(),
            digest: setup.program.digest.clone(),
            mode: setup.mode,
            parameters: setup.parameters,
            seed: setup.seed,
            world: simulation.root.iter().map(|(k, f)| (k.clone(), f.value.clone())).collect(),
            revision: simulation.root.revision(),
            capacity: setup.resources.iter().map(|(kind, offer)| (kind.clone(), offer.count)).collect(),
            learned,
            breakpoints: Box::default(),
            origin: Box::default(),
        },
    );
    simulation.bring_from_outside(|trigger| match trigger {
        Trigger::At(seconds) => Some(Duration::from_secs_f64(seconds.max(0.0))),
        _ => None,
    });
    for event in 1..=max_events {
        if !goes_on() {
            return Err(RunError::Stopped { at_s: simulation.now.seconds() });
        }
        let Some((now, entry)) = simulation.agenda.pop_first() else {
            let waits = executive.explain().into_iter().chain(simulation.wanted()).collect();
            return Err(RunError::Stuck { at_s: simulation.now.seconds(), waits });
        };
        simulation.now = now;
        let mut next = simulation.happens(entry)?;
        while let Some(event) = next.take() {
            simulation.log.push(LogLine { at: now, entry: LogEntry::Event(event.clone()) });
            let commands = executive.handle(now, event);
            lookout.observe(now, &commands);
            for command in commands {
                simulation.log.push(LogLine { at: now, entry: LogEntry::Command(command.clone()) });
                simulation.perform(command)?;
            }
            if simulation.log.len() > max_lines {
                return Err(RunError::TooLong(max_lines));
            }
            if orders > 0 && (lookout.is_due() || lookout.is_surprised()) && simulation.end.is_none() {
                let outlook = executive.outlook(now);
                let orders = if lookout.is_due() {
                    lookout.looks(outlook.tasks.len());
                    orders
                } else {
                    lookout.glances();
                    orders.div_ceil(GLANCE_PART)
                };
                next = advice(&outlook, orders, setup.seed, &mut memory);
            }
        }
        if simulation.circumstances.checkpoint_every.is_some_and(|every| event % every == 0) {
            let restored = Executive::restore(setup.program.clone(), setup.tolerance, &executive.checkpoint());
            executive = restored.map_err(|problem| simulation.broken(format!("its checkpoint: {problem}")))?;
        }
        if simulation.circumstances.checks >= Checks::Environment {
            simulation.check(&executive)?;
        }
        if simulation.circumstances.checks >= Checks::Everything {
            executive.check_invariants().map_err(|problem| simulation.broken(problem))?;
        }
        // A timer that is due now but not handled yet will wake its instance.
        let is_over = simulation.agenda.next_at().is_none_or(|next| next > now);
        if simulation.circumstances.examines && is_over {
            executive.check_quiescence(now).map_err(|problem| simulation.broken(problem))?;
        }
        if let Some(after) = &mut resume_after {
            *after = after.saturating_sub(1);
            if *after == 0 && simulation.end.is_none() {
                resume_after = None;
                let fresh = Executive::new(setup.program.clone(), setup.tolerance);
                executive = resume::resumed(fresh, &simulation.log).map_err(|problem| simulation.broken(problem))?;
            }
        }
        if let Some((outcome, outputs, reason)) = simulation.end.take() {
            let units = simulation.task_resources();
            let log = std::mem::take(&mut simulation.log);
            return Ok(Run { end_s: now.seconds(), outcome, outputs, reason, log, world: simulation.root, units });
        }
    }
    Err(RunError::Endless(max_events))
}

/// Advice for a better order than the executive's own, if `orders` tries find one.
fn advice(outlook: &Problem, orders: usize, seed: u64, memory: &mut Memory) -> Option<Event> {
    // Without a plan the dispatch stays as it is.
    let mut search = Search::remembering(outlook, seed, memory).ok()?;
    search.step(orders);
    *memory = search.memory();
    let advice = search.best();
    (advice.end_s < advice.plain_s).then_some(Event::Advised { urgency_s: advice.urgency_s, held: advice.held })
}

impl Simulation<'_> {
    fn at(&mut self, delay: Duration, event: Event) {
        self.agenda.add(self.now + delay, Entry::Event(event));
    }

    /// Sends the events before the start of the run; the executive keeps them and gives no commands.
    fn send_before(&mut self, executive: &mut Executive) -> Result<(), RunError> {
        let events = std::mem::take(&mut self.circumstances.events);
        let (before, later): (Vec<_>, Vec<_>) =
            events.into_iter().partition(|(trigger, _)| *trigger == Trigger::Before);
        self.circumstances.events = later;
        for (_, event) in before {
            self.log.push(LogLine { at: self.now, entry: LogEntry::Event(event.clone()) });
            if let Some(command) = executive.handle(self.now, event).first() {
                return Err(self.broken(format!("{command:?} before the run has begun")));
            }
        }
        Ok(())
    }

    /// Sends a message about an attempt, which may arrive late or twice.
    fn send(&mut self, delay: Duration, kind: &str, instance: InstanceId, attempt: u32, event: Event) {
        let path = self.paths.get(&instance).map_or("", String::as_str);
        let delivery = self.circumstances.mischief.delivery(kind, path, attempt);
        let first = delay + Duration::from_secs_f64(delivery.late_s);
        if let Some(again_s) = delivery.again_s {
            self.at(first + Duration::from_secs_f64(again_s), event.clone());
        }
        self.at(first, event);
    }

    /// Puts the events from outside that are due on this occasion on the agenda.
    fn bring_from_outside(&mut self, due: impl Fn(&Trigger) -> Option<Duration>) {
        let events = std::mem::take(&mut self.circumstances.events);
        for (trigger, event) in events {
            match due(&trigger) {
                Some(delay) => self.at(delay, event),
                None => self.circumstances.events.push((trigger, event)),
            }
        }
    }

    /// Handles an entry of the agenda; returns the event for the executive, if any.
    fn happens(&mut self, entry: Entry) -> Result<Option<Event>, RunError> {
        let event = match entry {
            // The shell ignores messages about leases and projections that were given back meanwhile.
            Entry::Event(Event::Granted { instance, lease }) if self.leases.get(&lease.id) != Some(&instance) => {
                return Ok(None);
            }
            Entry::Event(Event::Projected { projection, .. }) if !self.projections.contains_key(&projection) => {
                return Ok(None);
            }
            // It ignores the refusal of a withdrawn request, too.
            Entry::Event(Event::Refused { instance, .. }) if !self.refusing.remove(&instance) => return Ok(None),
            Entry::Event(event) => event,
            Entry::Loss { lease, instance, attempt } => {
                self.lose(lease)?;
                // In reality the goal under the lease ends before another one begins there.
                self.busy.given_back(lease).ok();
                Event::Crashed {
                    instance,
                    attempt,
                    reason: "its lease was lost".to_owned(),
                    unknown: false,
                    refused: false,
                }
            }
        };
        if let Event::WorldChanged { facts, .. } = &event {
            let revision = self.root.overwrite(facts.iter().cloned());
            self.roots.insert(revision, self.root.clone());
        }
        if let Event::Projected { projection, .. } = &event {
            self.told.insert(*projection);
        }
        if let Event::Finished { instance, attempt, .. } | Event::Crashed { instance, attempt, .. } = &event {
            self.busy.end(*instance, *attempt);
        }
        if let Event::Finished { instance, .. } | Event::Crashed { instance, .. } = &event
            && let Some(path) = self.paths.get(instance).cloned()
        {
            self.bring_from_outside(|trigger| (*trigger == Trigger::Ends(path.clone())).then_some(Duration::ZERO));
        }
        Ok(Some(event))
    }

    /// A resource under a lease vanishes, and another one replaces it.
    fn lose(&mut self, lease: LeaseId) -> Result<(), RunError> {
        let held = self.pool.leases().into_iter().find(|held| held.id == lease);
        let resources = held.map(|held| held.resources).unwrap_or_default();
        let class = |id: &String| self.pool.get(id).map(|resource| resource.class);
        let worker =
            resources.iter().find(|id| matches!(class(id), Some(ResourceClass::Process | ResourceClass::Module)));
        let Some(resource) = worker.and_then(|id| self.pool.get(id)) else { return Ok(()) };
        self.pool.delete(self.now, None, &resource.id).map_err(|e| self.broken(e))?;
        let mut spec = ResourceSpec::new(resource.class, &resource.kind).id(&resource.id).capacity(resource.capacity);
        let attributes = resource.attributes.iter();
        spec.attributes.extend(attributes.map(|(name, value)| (name.to_owned(), value.clone())));
        self.pool.create(self.now, None, spec).map_err(|e| self.broken(e))?;
        // If it has other resources, the lease must still be given back.
        if !self.pool.leases().iter().any(|held| held.id == lease) {
            self.leases.remove(&lease);
            self.lost.insert(lease);
        }
        self.answers();
        Ok(())
    }

    fn late(&mut self) -> Duration {
        let most = u64::try_from(self.latency.as_nanos()).unwrap_or(u64::MAX);
        Duration::from_nanos(self.dice.below(most))
    }

    fn is_refused(&self, instance: InstanceId) -> bool {
        let refused = &self.circumstances.refused;
        let plain = |path: &String| {
            let parts = path.split('/').map(|part| part.split(['[', '#']).next().unwrap_or(part));
            parts.collect::<Vec<_>>().join("/")
        };
        !refused.is_empty() && self.paths.get(&instance).is_some_and(|path| refused.contains(&plain(path)))
    }

    fn broken(&self, problem: impl ToString) -> RunError {
        RunError::Broken { at_s: self.now.seconds(), problem: problem.to_string() }
    }

    fn perform(&mut self, command: Command) -> Result<(), RunError> {
        if self.end.is_some() {
            return Err(self.broken("a command after the end"));
        }
        match command {
            Command::Note(ratn_executive::protocol::Note::Expanded { instance, state, path, .. }) => {
                self.busy.expanded(instance, state);
                self.paths.insert(instance, path);
            }
            Command::Note(ratn_executive::protocol::Note::Awaiting { instance, .. }) => {
                let path = self.paths.get(&instance).cloned().unwrap_or_default();
                if let Some((after_s, event)) = self.oracle.awaited(&path, instance) {
                    self.at(Duration::from_secs_f64(after_s.max(0.0)), event);
                }
            }
            Command::Note(_) => {}
            Command::Acquire { instance, .. } if self.is_refused(instance) => {
                let reason = "nobody grants it anything".to_owned();
                self.refusing.insert(instance);
                let late = self.late();
                self.at(late, Event::Refused { instance, reason });
            }
            Command::Acquire { instance, requirements, priority } => {
                let request = AcquireRequest::new(self.session.clone(), requirements)
                    .priority(priority)
                    .speculative(priority < CERTAIN);
                let waiter = self.pool.acquire(self.now, request).map_err(|e| self.broken(e))?;
                self.waiters.insert(instance, waiter);
                self.waiting.insert(waiter, instance);
                self.answers();
            }
            Command::Withdraw { instance } => {
                if let Some(waiter) = self.waiters.remove(&instance) {
                    self.waiting.remove(&waiter);
                    self.pool.cancel(self.now, waiter).map_err(|e| self.broken(e))?;
                } else if !self.refusing.remove(&instance) {
                    self.take_back_grant(instance)?;
                }
                self.answers();
            }
            Command::Project { instance, attempt, base, changes, writers, lease, reads, first: _ } => {
                if writers.len() != changes.len() || writers.iter().any(|writer| writer.is_empty()) {
                    return Err(self.broken(format!("of a change that {instance} builds on nobody is named")));
                }
                if let Some((lease, _)) = lease
                    && !self.leases.contains_key(&lease)
                {
                    return Err(self.broken(format!("{instance} projects under {lease}, which it does not hold")));
                }
                let Some(below) = self.roots.get(&base) else {
                    return Err(self.broken(format!("projection on {base}, the root is {}", self.root.revision())));
                };
                let world = shown(below.project(&changes).map_err(|e| self.broken(e))?, &reads);
                if !self.projected.insert((instance, attempt)) {
                    return Err(self.broken(format!("a second projection for attempt {attempt} of {instance}")));
                }
                self.next_projection += 1;
                let projection = ProjectionId(self.next_projection);
                self.projections.insert(projection, world);
                let late = self.late();
                self.send(late, "projected", instance, attempt, Event::Projected { instance, attempt, projection });
            }
            Command::Start { instance, attempt, goal } => {
                self.busy.begin(&self.pool, instance, attempt, &goal).map_err(|(unit, other)| {
                    let path = |id: &InstanceId| self.paths.get(id).cloned().unwrap_or_default();
                    let (given, performs) = (path(&instance), path(&other));
                    self.broken(format!("{unit} is given {given} and performs {performs}: one goal at a time"))
                })?;
                self.start(instance, attempt, &goal);
            }
            Command::Cancel { instance, attempt } => {
                self.busy.end(instance, attempt);
                let path = self.paths.get(&instance).map_or("", String::as_str);
                let crosses = self.circumstances.mischief.crosses(path, attempt);
                for (place, entry) in self.agenda.take_answers(instance, attempt) {
                    match entry {
                        Entry::Event(Event::Projected { projection, .. }) if !self.told.contains(&projection) => {
                            self.projections.remove(&projection);
                        }
                        Entry::Event(Event::Projected { .. }) => {}
                        answer @ Entry::Event(_) if crosses => self.agenda.put_back(place, answer),
                        _ => {}
                    }
                }
            }
            Command::Release { lease, projection, .. } => {
                if let Some(lease) = lease {
                    let given_back = self.busy.given_back(lease);
                    self.leases.remove(&lease);
                    if !self.lost.contains(&lease) {
                        given_back.map_err(|instance| {
                            let path = self.paths.get(&instance).cloned().unwrap_or_default();
                            self.broken(format!("{lease} is given back while {path} is under way under it"))
                        })?;
                        self.pool.release(self.now, Some(&self.session), lease).map_err(|e| self.broken(e))?;
                    }
                }
                if let Some(projection) = projection
                    && self.projections.remove(&projection).is_none()
                {
                    return Err(self.broken(format!("{projection} released twice")));
                }
                self.answers();
            }
            Command::Commit { changes, revision, writer, .. } => {
                if writer.is_empty() {
                    return Err(self.broken(format!("nobody is named who makes {revision}")));
                }
                let made = self.root.apply(&changes).map_err(|e| self.broken(e))?;
                self.roots.insert(made, self.root.clone());
                if made != revision {
                    return Err(self.broken(format!("the commit made {made}, not {revision}")));
                }
            }
            Command::Operate { operations, .. } => {
                for operation in &operations {
                    let done = match operation.operation {
                        ResourceOperation::Consume => self.pool.consume(self.now, &self.session, operation).map(drop),
                        ResourceOperation::Create => {
                            let class = operation.class.unwrap_or(ResourceClass::Task);
                            let mut spec = ResourceSpec::new(class, &operation.kind).capacity(operation.count);
                            spec.attributes = operation.attributes.clone();
                            spec.divisible = operation.divisible;
                            self.pool.create(self.now, Some(&self.session), spec).map(drop)
                        }
                        _ => self.pool.delete_units(self.now, &self.session, operation).map(drop),
                    };
                    done.map_err(|e| self.broken(e))?;
                }
                self.answers();
            }
            Command::Wake { at } => self.at(at.since(self.now), Event::Woken),
            Command::End { outcome, outputs, reason } => self.end = Some((outcome, outputs, reason)),
        }
        Ok(())
    }

    /// Releases a grant that crossed its withdrawal.
    fn take_back_grant(&mut self, instance: InstanceId) -> Result<(), RunError> {
        let held = |lease: &LeaseId| self.leases.get(lease) == Some(&instance);
        let crossed = self.agenda.entries().find_map(|entry| match entry {
            Entry::Event(Event::Granted { instance: to, lease }) if *to == instance => {
                Some(lease.id).filter(|lease| held(lease))
            }
            _ => None,
        });
        let Some(lease) = crossed else { return Ok(()) };
        // Its messages will be about a lease that nobody holds.
        self.leases.remove(&lease);
        self.pool.release(self.now, Some(&self.session), lease).map_err(|e| self.broken(e))
    }

    fn start(&mut self, instance: InstanceId, attempt: u32, goal: &Goal) {
        let path = self.paths.get(&instance).cloned().unwrap_or_default();
        self.bring_from_outside(|trigger| (*trigger == Trigger::Starts(path.clone())).then_some(Duration::ZERO));
        let world = goal.projection.and_then(|p| self.projections.get(&p)).unwrap_or(&self.root);
        let Performance { duration_s, answer } = self.oracle.perform(&path, attempt, goal, world);
        let first = match &answer {
            Answer::Finished { outcome, outputs, .. } if outcome == "success" && goal.improves.is_some() => {
                Some(outputs)
            }
            _ => None,
        };
        let better = first.and_then(|first| Some((first.clone(), self.oracle.better(&path, attempt, goal, first)?)));
        let Some((first, Better { results, end })) = better else {
            return self.ends(instance, attempt, goal, duration_s, answer);
        };
        let first_cost = results.first().map_or(0.0, |(_, _, cost)| cost + 1.0);
        for (number, (after_s, outputs, cost_s)) in [(0.0, first, first_cost)].into_iter().chain(results).enumerate() {
            let event = Event::Improved { instance, attempt, outputs, cost_s };
            let delay = Duration::from_secs_f64((duration_s + after_s).max(0.0));
            self.send(delay, &format!("improved {number}"), instance, attempt, event);
        }
        if let Some((after_s, answer)) = end {
            self.ends(instance, attempt, goal, duration_s + after_s, answer);
        }
    }

    /// Ends a goal with this answer, after this number of seconds.
    fn ends(&mut self, instance: InstanceId, attempt: u32, goal: &Goal, after_s: f64, answer: Answer) {
        let event = match answer {
            Answer::Finished { outcome, outputs, measured } => {
                let reason = if outcome == "success" { String::new() } else { format!("the oracle says {outcome}") };
                let (evidence, at_rest) = (Vec::new(), true);
                Event::Finished { instance, attempt, outcome, outputs, measured, evidence, reason, at_rest }
            }
            Answer::Crashed => Event::Crashed {
                instance,
                attempt,
                reason: "the worker died".to_owned(),
                unknown: false,
                refused: false,
            },
            Answer::LeaseLost => {
                let lease = goal.lease.as_ref().map(|lease| lease.id);
                match lease.filter(|lease| self.leases.get(lease) == Some(&instance)) {
                    Some(lease) => {
                        let at = self.now + Duration::from_secs_f64(after_s.max(0.0));
                        self.agenda.add(at, Entry::Loss { lease, instance, attempt });
                        return;
                    }
                    // Inside of a routine only the worker dies.
                    None => Event::Crashed {
                        instance,
                        attempt,
                        reason: "the worker died".to_owned(),
                        unknown: false,
                        refused: false,
                    },
                }
            }
        };
        self.send(Duration::from_secs_f64(after_s.max(0.0)), "answer", instance, attempt, event);
    }

    fn task_resources(&self) -> BTreeMap<String, Quantity> {
        let mut units: BTreeMap<String, Quantity> = BTreeMap::new();
        for resource in self.pool.list().into_iter().filter(|r| r.class == ResourceClass::Task) {
            let left = resource.capacity.saturating_sub(resource.consumed);
            *units.entry(resource.kind.clone()).or_default() += left;
        }
        units
    }

    /// Turns the pool's notices into events.
    fn answers(&mut self) {
        // A simulated pool is not persistent.
        drop(self.pool.take_records());
        for notice in self.pool.take_notices() {
            let (waiter, lease) = match notice {
                Notice::Granted { waiter, lease } => (waiter, Some(lease)),
                Notice::Refused { waiter, .. } => (waiter, None),
                Notice::Event(_) => continue,
            };
            let Some(instance) = self.waiting.remove(&waiter) else { continue };
            self.waiters.remove(&instance);
            if let Some(lease) = lease {
                self.leases.insert(lease.id, instance);
                let late = self.late();
                let grant = self.grants.entry(instance).or_default();
                *grant += 1;
                let grant = *grant;
                self.send(late, "granted", instance, grant, Event::Granted { instance, lease });
            }
        }
    }

    /// The requests that were not granted yet, for people.
    fn wanted(&self) -> Vec<String> {
        let asked = self.waiters.iter().filter_map(|(instance, waiter)| {
            let (_, request) = self.pool.waiter(*waiter)?;
            let path = self.paths.get(instance).map_or("a state", String::as_str);
            let wanted: Vec<String> = request.requirements.iter().map(|wanted| format!("`{wanted}`")).collect();
            Some(format!("{path} waits for {}, which nothing that there is grants", wanted.join(" and ")))
        });
        asked.collect()
    }

    fn check(&mut self, executive: &Executive) -> Result<(), RunError> {
        self.pool.check_invariants().map_err(|e| self.broken(e))?;
        self.check_mirror(executive.root())?;
        if executive.has_ended()
            && (!self.leases.is_empty() || !self.projections.is_empty() || !self.waiters.is_empty())
        {
            return Err(self.broken(format!(
                "the run has ended and {} leases, {} projections, {} waiters are left",
                self.leases.len(),
                self.projections.len(),
                self.waiters.len()
            )));
        }
        Ok(())
    }

    /// Checks that the executive's mirror has the revision and the facts of the root. Facts are compared at each new revision: all of them in
    /// a small world, else a different part each time.
    fn check_mirror(&mut self, mirror: &World) -> Result<(), RunError> {
        let revision = self.root.revision();
        if mirror.revision() != revision {
            return Err(
                self.broken(format!("the executive's mirror is at {}, the root at {revision}", mirror.revision()))
            );
        }
        if self.mirrored == Some(revision) {
            return Ok(());
        }
        self.mirrored = Some(revision);
        if mirror.len() != self.root.len() {
            return Err(self.broken(format!("the mirror has {} facts, the root {}", mirror.len(), self.root.len())));
        }
        let step = self.root.len().div_ceil(COMPARED_FACTS).max(1);
        let facts = self.root.iter().skip(revision.0 as usize % step).step_by(step);
        for (key, fact) in facts {
            let mirrored = mirror.get(key);
            if mirrored != Some(&fact.value) {
                let problem = format!("{key} = {} in the root, {mirrored:?} in the executive's mirror", fact.value);
                return Err(self.broken(problem));
            }
        }
        Ok(())
    }
}

/// Adds all resources to a pool, with the attributes of each kind's units in order.
pub(crate) fn offer(
    pool: &mut Pool,
    resources: &[(String, ResourceOffer)],
    attributes: &BTreeMap<String, Vec<BTreeMap<String, Value>>>,
) -> Result<(), String> {
    for (kind, offer) in resources {
        let shared = offer.class == ResourceClass::World || offer.divisible;
        let (count, capacity) = if shared { (1, offer.count) } else { (offer.count.units(), Quantity::ONE) };
        for number in 1..=count {
            let mut spec =
                ResourceSpec::new(offer.class, kind.clone()).id(format!("{kind}-{number}")).capacity(capacity);
            (spec.divisible, spec.renewable) = (offer.divisible, offer.renewable);
            let attributes = attributes.get(kind).and_then(|all| all.get(number as usize - 1));
            spec.attributes.extend(attributes.cloned().unwrap_or_default());
            pool.create(Timestamp(0), None, spec).map_err(|error| error.to_string())?;
        }
    }
    let _ = pool.take_notices();
    Ok(())
}

/// What a projection shows of a world, as in the world pool: only the facts in `reads`.
pub(crate) fn shown(world: World, reads: &Footprint) -> World {
    let Footprint::Patterns(patterns) = reads else { return world };
    let facts = patterns.iter().flat_map(|read| world.matching(read));
    World::from_facts(facts.map(|(key, fact)| (key.clone(), fact.value.clone())), world.revision())
}
