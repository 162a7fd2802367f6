//! One run of one task in virtual time: the same loop as the real task control's (receive, handle, perform), with the cores
//! called directly.

use crate::random::Dice;
use ratn_executive::executive::Executive;
use ratn_executive::lookahead::{Lookout, Problem, Search};
use ratn_executive::protocol::{Command, Event, Goal, Learned, LogEntry, LogLine, Mode, Origin};
use ratn_model::fact::{Change, FactKey};
use ratn_model::id::{InstanceId, LeaseId, ProjectionId, Revision};
use ratn_model::program::Program;
use ratn_model::resource::{ResourceClass, ResourceOperation};
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_resources::{AcquireRequest, Limits, Notice, Pool, ResourceSpec, SessionId, WaiterId};
use ratn_world::tolerance::Tolerance;
use ratn_world::world::World;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

/// What the providers do.
pub trait Oracle {
    /// How a goal goes. `world` is its projection, or the actual world where it has none.
    fn perform(&mut self, path: &str, attempt: u32, goal: &Goal, world: &World) -> Performance;
}

/// How a goal goes.
#[derive(Debug, Clone, PartialEq)]
pub struct Performance {
    /// Virtual seconds until it answers.
    pub duration_s: f64,
    /// What it answers.
    pub answer: Answer,
}

/// The answer to a goal.
#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    /// It has ended.
    Finished {
        /// The outcome.
        outcome: String,
        /// The output ports.
        outputs: BTreeMap<String, Value>,
        /// Facts as measured.
        measured: Vec<(FactKey, Value)>,
    },
    /// Its worker died.
    Crashed,
}

/// A run to make.
pub struct Setup {
    /// The task.
    pub program: Arc<Program>,
    /// How it is executed.
    pub mode: Mode,
    /// Its parameters, all bound.
    pub parameters: BTreeMap<String, Value>,
    /// The run's seed.
    pub seed: u64,
    /// Kind, class and number of units of everything there is.
    pub resources: Vec<(String, ResourceClass, u32)>,
    /// The facts that hold before the task's own initial world.
    pub world: Vec<(FactKey, Value)>,
    /// When a measured value is the predicted one.
    pub tolerance: Tolerance,
    /// Leases and projections take up to this long to come, at random by the seed; what crosses meanwhile, crosses.
    pub latency: Duration,
}

/// What became of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Run {
    /// When it ended, in virtual seconds.
    pub end_s: f64,
    /// The task's outcome.
    pub outcome: String,
    /// Its outputs.
    pub outputs: BTreeMap<String, Value>,
    /// Why, when the outcome is not success.
    pub reason: String,
    /// The event log.
    pub log: Vec<LogLine>,
    /// The root world at the end.
    pub world: World,
    /// What there is of task resources at the end: units by kind.
    pub units: BTreeMap<String, u64>,
}

/// A run that did not end as runs do: a broken promise of one of the cores.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RunError {
    /// Nothing is under way and the task has not ended.
    #[error("at {at_s:.3} s nothing is under way and the task has not ended; {}", waits.join("; "))]
    Stuck {
        /// When.
        at_s: f64,
        /// What waits for what.
        waits: Vec<String>,
    },
    /// More events than any run should have.
    #[error("no end after {0} events")]
    Endless(usize),
    /// An invariant does not hold.
    #[error("at {at_s:.3} s: {problem}")]
    Broken {
        /// When.
        at_s: f64,
        /// What is wrong.
        problem: String,
    },
}

/// More events than this is an endless run.
const MAX_EVENTS: usize = 1_000_000;

struct Simulation<'a> {
    now: Timestamp,
    pool: Pool,
    session: SessionId,
    root: World,
    /// What the root was at each revision.
    roots: BTreeMap<Revision, World>,
    projections: BTreeMap<ProjectionId, World>,
    /// What projections were asked for: the world pool makes one per instance and attempt.
    projected: BTreeSet<(InstanceId, u32)>,
    next_projection: u64,
    waiters: BTreeMap<InstanceId, WaiterId>,
    leases: BTreeMap<LeaseId, InstanceId>,
    paths: BTreeMap<InstanceId, String>,
    agenda: BTreeMap<(Timestamp, u64), Event>,
    next_entry: u64,
    latency: Duration,
    dice: Dice,
    oracle: &'a mut dyn Oracle,
    log: Vec<LogLine>,
    end: Option<(String, BTreeMap<String, Value>, String)>,
}

/// Makes the run. After every step the invariants of the cores are checked.
///
/// # Errors
/// [`RunError`] where a core breaks a promise: the run gets stuck, never ends, or an invariant fails.
pub fn run(setup: Setup, oracle: &mut dyn Oracle) -> Result<Run, RunError> {
    run_looking_ahead(setup, oracle, 0)
}

/// As [`run`]; whenever much of the window has changed, so many orders of what is still to be done are simulated, and the
/// executive is advised of one that is better than its own. None is plain dispatch.
///
/// # Errors
/// As [`run`].
pub fn run_looking_ahead(setup: Setup, oracle: &mut dyn Oracle, orders: usize) -> Result<Run, RunError> {
    let mut root = World::default();
    let initial: Vec<Change> =
        setup.world.iter().map(|(fact, value)| Change::Set { fact: fact.clone(), value: value.clone() }).collect();
    let broken = |at: Timestamp, problem: String| RunError::Broken { at_s: at.seconds(), problem };
    root.apply(&initial).map_err(|e| broken(Timestamp(0), e.to_string()))?;
    let mut pool = Pool::new(Limits::default());
    let session = SessionId::from("task");
    let forever = Duration::from_secs(10 * 365 * 24 * 3600);
    pool.keep_alive(Timestamp(0), &session, "simulation", forever).map_err(|e| broken(Timestamp(0), e.to_string()))?;
    for (kind, class, units) in &setup.resources {
        let shared = *class == ResourceClass::World;
        let (count, capacity) = if shared { (1, *units) } else { (*units, 1) };
        for number in 1..=count {
            let spec = ResourceSpec::new(*class, kind.clone()).id(format!("{kind}-{number}")).capacity(capacity);
            pool.create(Timestamp(0), None, spec).map_err(|e| broken(Timestamp(0), e.to_string()))?;
        }
    }
    let _ = pool.take_notices();
    let mut simulation = Simulation {
        now: Timestamp(0),
        pool,
        session,
        roots: BTreeMap::from([(root.revision(), root.clone())]),
        root,
        projections: BTreeMap::new(),
        projected: BTreeSet::new(),
        next_projection: 0,
        waiters: BTreeMap::new(),
        leases: BTreeMap::new(),
        paths: BTreeMap::new(),
        agenda: BTreeMap::new(),
        next_entry: 0,
        latency: setup.latency,
        dice: Dice(setup.seed),
        oracle,
        log: Vec::new(),
        end: None,
    };
    let mut executive = Executive::new(setup.program.clone(), setup.tolerance);
    let mut lookout = Lookout::default();
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
            capacity: setup.resources.iter().map(|(kind, _, units)| (kind.clone(), *units)).collect(),
            learned: Learned::default(),
            origin: Origin::default(),
        },
    );
    for _ in 0..MAX_EVENTS {
        let Some(((now, _), event)) = simulation.agenda.pop_first() else {
            return Err(RunError::Stuck { at_s: simulation.now.seconds(), waits: executive.explain() });
        };
        simulation.now = now;
        let mut next = Some(event);
        while let Some(event) = next.take() {
            simulation.log.push(LogLine { at: now, entry: LogEntry::Event(event.clone()) });
            let commands = executive.handle(now, event);
            lookout.observe(&commands);
            for command in commands {
                simulation.log.push(LogLine { at: now, entry: LogEntry::Command(command.clone()) });
                simulation.perform(command)?;
            }
            if orders > 0 && lookout.is_due() && simulation.end.is_none() {
                let outlook = executive.outlook(now);
                lookout.looks(outlook.tasks.len());
                next = advice(&outlook, orders, setup.seed);
            }
        }
        simulation.check(&executive)?;
        if let Some((outcome, outputs, reason)) = simulation.end.take() {
            let units = simulation.task_resources();
            let log = std::mem::take(&mut simulation.log);
            return Ok(Run { end_s: now.seconds(), outcome, outputs, reason, log, world: simulation.root, units });
        }
    }
    Err(RunError::Endless(MAX_EVENTS))
}

/// A better order than the executive's own, if so many tries find one.
fn advice(outlook: &Problem, orders: usize, seed: u64) -> Option<Event> {
    // What cannot be planned goes as it goes.
    let mut search = Search::new(outlook, seed).ok()?;
    search.step(orders);
    let advice = search.best();
    (advice.end_s < advice.plain_s).then_some(Event::Advised { urgency_s: advice.urgency_s })
}

impl Simulation<'_> {
    fn at(&mut self, delay: Duration, event: Event) {
        self.next_entry += 1;
        self.agenda.insert((self.now + delay, self.next_entry), event);
    }

    fn late(&mut self) -> Duration {
        let most = u64::try_from(self.latency.as_nanos()).unwrap_or(u64::MAX);
        Duration::from_nanos(self.dice.below(most))
    }

    fn broken(&self, problem: impl ToString) -> RunError {
        RunError::Broken { at_s: self.now.seconds(), problem: problem.to_string() }
    }

    fn perform(&mut self, command: Command) -> Result<(), RunError> {
        if self.end.is_some() {
            return Err(self.broken("a command after the end"));
        }
        match command {
            Command::Note(ratn_executive::protocol::Note::Expanded { instance, path, .. }) => {
                self.paths.insert(instance, path);
            }
            Command::Note(_) => {}
            Command::Acquire { instance, requirements, priority } => {
                let request = AcquireRequest::new(self.session.clone(), requirements).priority(priority);
                let waiter = self.pool.acquire(self.now, request).map_err(|e| self.broken(e))?;
                self.waiters.insert(instance, waiter);
                self.answers();
            }
            Command::Withdraw { instance } => {
                if let Some(waiter) = self.waiters.remove(&instance) {
                    self.pool.cancel(self.now, waiter).map_err(|e| self.broken(e))?;
                } else {
                    self.take_back_grant(instance)?;
                }
                self.answers();
            }
            Command::Project { instance, attempt, base, changes, lease, reads: _ } => {
                if let Some((lease, _)) = lease
                    && !self.leases.contains_key(&lease)
                {
                    return Err(self.broken(format!("{instance} projects under {lease}, which it does not hold")));
                }
                let Some(below) = self.roots.get(&base) else {
                    return Err(self.broken(format!("projection on {base}, the root is {}", self.root.revision())));
                };
                let world = below.project(&changes).map_err(|e| self.broken(e))?;
                if !self.projected.insert((instance, attempt)) {
                    return Err(self.broken(format!("a second projection for attempt {attempt} of {instance}")));
                }
                self.next_projection += 1;
                let projection = ProjectionId(self.next_projection);
                self.projections.insert(projection, world);
                let late = self.late();
                self.at(late, Event::Projected { instance, attempt, projection });
            }
            Command::Start { instance, attempt, goal } => self.start(instance, attempt, &goal),
            Command::Cancel { instance, attempt } => {
                let cancelled: Vec<_> =
                    self.agenda.iter().filter(|(_, e)| is_answer(e, instance, attempt)).map(|(at, _)| *at).collect();
                for at in cancelled {
                    if let Some(Event::Projected { projection, .. }) = self.agenda.remove(&at) {
                        self.projections.remove(&projection);
                    }
                }
            }
            Command::Release { lease, projection, .. } => {
                if let Some(lease) = lease {
                    self.leases.remove(&lease);
                    self.pool.release(self.now, Some(&self.session), lease).map_err(|e| self.broken(e))?;
                }
                if let Some(projection) = projection
                    && self.projections.remove(&projection).is_none()
                {
                    return Err(self.broken(format!("{projection} released twice")));
                }
                self.answers();
            }
            Command::Commit { changes, revision, .. } => {
                let made = self.root.apply(&changes).map_err(|e| self.broken(e))?;
                self.roots.insert(made, self.root.clone());
                if made != revision {
                    return Err(self.broken(format!("the commit made {made}, not {revision}")));
                }
            }
            Command::Operate { operations, .. } => {
                for operation in &operations {
                    let done = match operation.operation {
                        ResourceOperation::Consume => self.pool.consume(self.now, &self.session, operation),
                        _ => self.pool.operate(self.now, &self.session, std::slice::from_ref(operation)),
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

    /// A withdrawal that crossed its grant.
    fn take_back_grant(&mut self, instance: InstanceId) -> Result<(), RunError> {
        let crossed = self.agenda.iter().find_map(|(at, event)| match event {
            Event::Granted { instance: to, lease } if *to == instance => Some((*at, lease.id)),
            _ => None,
        });
        let Some((at, lease)) = crossed else { return Ok(()) };
        self.agenda.remove(&at);
        self.leases.remove(&lease);
        self.pool.release(self.now, Some(&self.session), lease).map_err(|e| self.broken(e))
    }

    fn start(&mut self, instance: InstanceId, attempt: u32, goal: &Goal) {
        let path = self.paths.get(&instance).cloned().unwrap_or_default();
        let world = goal.projection.and_then(|p| self.projections.get(&p)).unwrap_or(&self.root);
        let Performance { duration_s, answer } = self.oracle.perform(&path, attempt, goal, world);
        let event = match answer {
            Answer::Finished { outcome, outputs, measured } => {
                let reason = if outcome == "success" { String::new() } else { format!("the oracle says {outcome}") };
                Event::Finished { instance, attempt, outcome, outputs, measured, reason }
            }
            Answer::Crashed => Event::Crashed { instance, attempt, reason: "the worker died".to_owned() },
        };
        self.at(Duration::from_secs_f64(duration_s.max(0.0)), event);
    }

    fn task_resources(&self) -> BTreeMap<String, u64> {
        let mut units = BTreeMap::new();
        for resource in self.pool.list().into_iter().filter(|r| r.class == ResourceClass::Task) {
            *units.entry(resource.kind).or_default() += u64::from(resource.capacity - resource.consumed);
        }
        units
    }

    /// The pool's answers become events.
    fn answers(&mut self) {
        for notice in self.pool.take_notices() {
            let (waiter, lease) = match notice {
                Notice::Granted { waiter, lease } => (waiter, Some(lease)),
                Notice::Refused { waiter, .. } => (waiter, None),
                Notice::Event(_) => continue,
            };
            let Some(instance) = self.waiters.iter().find(|(_, w)| **w == waiter).map(|(i, _)| *i) else { continue };
            self.waiters.remove(&instance);
            if let Some(lease) = lease {
                self.leases.insert(lease.id, instance);
                let late = self.late();
                self.at(late, Event::Granted { instance, lease });
            }
        }
    }

    fn check(&self, executive: &Executive) -> Result<(), RunError> {
        self.pool.check_invariants().map_err(|e| self.broken(e))?;
        if executive.root().revision() != self.root.revision() {
            return Err(self.broken("the executive's mirror is not the root"));
        }
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
}

fn is_answer(event: &Event, to: InstanceId, of: u32) -> bool {
    matches!(event,
        Event::Finished { instance, attempt, .. }
        | Event::Crashed { instance, attempt, .. }
        | Event::Projected { instance, attempt, .. } if *instance == to && *attempt == of)
}
