//! Several concurrent runs in virtual time: one resource pool, one root world, an executive per run.
//!
//! A commit of one run is sent to the others at once, as a change from outside. Leases and projections arrive late, at random. Not simulated:
//! in the real system a holder of a lease is told in time what the last holder committed (`ratn-task-control`).
//!
//! The task control of a run may die without notice and be resumed from its event log (`death`).

mod death;

pub use death::{Death, REFUSED, SESSION_S};

use crate::dice::Dice;
use crate::run::{Answer, MAX_EVENTS, Oracle, Performance, RunError, offer, shown};
use death::{Gone, reached};
use ratn_executive::executive::Executive;
use ratn_executive::protocol::{CERTAIN, Command, Event, Learned, LogEntry, LogLine, Mode, Note};
use ratn_model::catalogue::ResourceOffer;
use ratn_model::fact::FactKey;
use ratn_model::id::{InstanceId, LeaseId, ProjectionId};
use ratn_model::program::Program;
use ratn_model::resource::Requirement;
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use ratn_resources::{AcquireRequest, Limits, Notice, Pool, SessionId, WaiterId};
use ratn_world::world::World;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

/// One of the runs.
#[derive(Debug, Clone)]
pub struct Together {
    /// Its task, without parameters; it has no initial world of its own, and does not create or consume resources.
    pub program: Arc<Program>,
    /// The mode.
    pub mode: Mode,
    /// When it begins, in virtual seconds.
    pub begins_s: f64,
    /// Events from an operator, with their times in virtual seconds.
    pub told: Vec<(f64, Event)>,
    /// The death of its task control, if any.
    pub dies: Option<Death>,
}

/// What all runs share.
#[derive(Debug, Clone)]
pub struct Shared {
    /// All resources, by kind.
    pub resources: Vec<(String, ResourceOffer)>,
    /// The facts at the start.
    pub world: Vec<(FactKey, Value)>,
    /// Leases and projections take up to this long, at random by the seed.
    pub latency: Duration,
    /// The seed.
    pub seed: u64,
}

/// The result of all runs.
#[derive(Debug, Clone, PartialEq)]
pub struct AllEnded {
    /// Outcome and reason of each run.
    pub outcomes: Vec<(String, String)>,
    /// The root world at the end.
    pub world: World,
    /// The history, in order.
    pub history: Vec<Happened>,
}

/// One entry of the history.
#[derive(Debug, Clone, PartialEq)]
pub struct Happened {
    /// The index of the run.
    pub run: usize,
    /// When, in virtual seconds.
    pub at_s: f64,
    /// What happened.
    pub what: What,
}

/// The kinds of entries.
#[derive(Debug, Clone, PartialEq)]
pub enum What {
    /// The run was granted these resources, by their ids.
    Granted(LeaseId, Vec<String>),
    /// The run released the lease.
    GaveBack(LeaseId),
    /// A goal of the state with this path began.
    Began(String),
    /// The goal ended, or its worker died.
    Ended(String),
    /// The goal was cancelled.
    Cut(String),
    /// A state's changes were committed; with the root after them.
    Committed(String, World),
    /// Its task control has died.
    Died,
    /// Its task control was resumed from its event log.
    TakenUp {
        /// Whether its resources were gone.
        has_lost: bool,
    },
}

/// The lifetime of a session that is kept alive.
const FOREVER: Duration = Duration::from_secs(10 * 365 * 24 * 3600);

/// Simulates the runs.
///
/// # Errors
/// [`RunError`] if a core is wrong: a run gets stuck, never ends, or its mirror differs from the root.
pub fn run(shared: &Shared, runs: &[Together], oracle: &mut dyn Oracle) -> Result<AllEnded, RunError> {
    let broken = |problem: String| RunError::Broken { at_s: 0.0, problem };
    let mut pool = Pool::new(Limits::default());
    offer(&mut pool, &shared.resources, &BTreeMap::new()).map_err(broken)?;
    let mut root = World::default();
    root.overwrite(shared.world.iter().map(|(fact, value)| (fact.clone(), Some(value.clone()))));
    let (agenda, next, projections, history, commits) = Default::default();
    let mut system = System {
        now: Timestamp(0),
        pool,
        root,
        agenda,
        next,
        projections,
        latency: shared.latency,
        dice: Dice(shared.seed),
        runs: Vec::new(),
        history,
        commits,
        oracle,
    };
    for (number, together) in runs.iter().enumerate() {
        let session = SessionId::from(format!("run-{number}").as_str());
        let alive = system.pool.keep_alive(Timestamp(0), &session, "simulation", FOREVER);
        alive.map_err(|error| broken(error.to_string()))?;
        system.runs.push(One {
            executive: Executive::new(together.program.clone(), Tolerance::ROBOT),
            session,
            waiters: BTreeMap::new(),
            leases: BTreeMap::new(),
            paths: BTreeMap::new(),
            program: together.program.clone(),
            has_begun: false,
            end: None,
            log: Vec::new(),
            asked: BTreeMap::new(),
            heard: BTreeSet::new(),
            lost: BTreeSet::new(),
            death: together.dies,
            gone: None,
        });
        system.at(number, Duration::from_secs_f64(together.begins_s.max(0.0)), Due::Begin);
        for (at_s, event) in &together.told {
            let at = Duration::from_secs_f64(at_s.max(together.begins_s).max(0.0));
            system.at(number, at, Due::Event(Box::new(event.clone())));
        }
    }
    system.until_all_have_ended(shared, runs)
}

/// The kinds of future entries.
enum Due {
    Begin,
    Event(Box<Event>),
    SessionEnds,
    TakenUp,
}

/// The state of one run.
struct One {
    executive: Executive,
    session: SessionId,
    waiters: BTreeMap<InstanceId, WaiterId>,
    leases: BTreeMap<LeaseId, InstanceId>,
    paths: BTreeMap<InstanceId, String>,
    program: Arc<Program>,
    has_begun: bool,
    end: Option<(String, String)>,
    log: Vec<LogLine>,
    /// Requests that are not answered yet.
    asked: BTreeMap<InstanceId, (Vec<Requirement>, i64)>,
    /// Leases whose grants the run has received.
    heard: BTreeSet<LeaseId>,
    /// Leases that ended with its session.
    lost: BTreeSet<LeaseId>,
    death: Option<Death>,
    gone: Option<Gone>,
}

struct System<'a> {
    now: Timestamp,
    pool: Pool,
    root: World,
    /// By time and order: the run and its entry.
    agenda: BTreeMap<(Timestamp, u64), (usize, Due)>,
    next: u64,
    projections: BTreeMap<ProjectionId, World>,
    latency: Duration,
    dice: Dice,
    runs: Vec<One>,
    history: Vec<Happened>,
    /// By commit, the run and the changed facts.
    commits: Vec<(usize, Vec<FactKey>)>,
    oracle: &'a mut dyn Oracle,
}

impl System<'_> {
    fn at(&mut self, run: usize, delay: Duration, due: Due) {
        self.next += 1;
        self.agenda.insert((self.now + delay, self.next), (run, due));
    }

    fn late(&mut self) -> Duration {
        Duration::from_nanos(self.dice.below(u64::try_from(self.latency.as_nanos()).unwrap_or(u64::MAX)))
    }

    fn happened(&mut self, run: usize, what: What) {
        self.history.push(Happened { run, at_s: self.now.seconds(), what });
    }

    fn path(&self, run: usize, instance: InstanceId) -> String {
        self.runs[run].paths.get(&instance).cloned().unwrap_or_default()
    }

    fn broken(&self, problem: impl ToString) -> RunError {
        RunError::Broken { at_s: self.now.seconds(), problem: problem.to_string() }
    }

    fn until_all_have_ended(mut self, shared: &Shared, runs: &[Together]) -> Result<AllEnded, RunError> {
        for _ in 0..MAX_EVENTS {
            let Some(((now, _), (run, due))) = self.agenda.pop_first() else {
                let waits = self.runs.iter().flat_map(|run| run.executive.explain()).collect();
                return Err(RunError::Stuck { at_s: self.now.seconds(), waits });
            };
            self.now = now;
            let event = match due {
                Due::SessionEnds => {
                    self.session_ends(run);
                    None
                }
                Due::TakenUp => {
                    self.is_taken_up(run)?;
                    None
                }
                Due::Begin => Some(Event::Started {
                    task: runs[run].program.name.clone(),
                    digest: runs[run].program.digest.clone(),
                    mode: runs[run].mode,
                    parameters: BTreeMap::new(),
                    seed: shared.seed,
                    world: self.root.iter().map(|(key, fact)| (key.clone(), fact.value.clone())).collect(),
                    revision: self.root.revision(),
                    capacity: shared.resources.iter().map(|(kind, offer)| (kind.clone(), offer.count)).collect(),
                    learned: Learned::default(),
                    breakpoints: Box::default(),
                    origin: Box::default(),
                }),
                Due::Event(event) => match (*event, &mut self.runs[run]) {
                    (event, One { gone: Some(gone), .. }) => {
                        gone.keep(now, event);
                        None
                    }
                    // A grant that was given back meanwhile is ignored.
                    (Event::Granted { instance, lease }, one) if one.leases.get(&lease.id) != Some(&instance) => None,
                    (event, _) => Some(event),
                },
            };
            if let Some(event) = event {
                if let Event::Finished { instance, .. } | Event::Crashed { instance, .. } = &event {
                    self.happened(run, What::Ended(self.path(run, *instance)));
                }
                self.tell(run, event)?;
            }
            if let Some(ends) = self.runs.iter().map(|run| run.end.clone()).collect::<Option<Vec<_>>>() {
                return Ok(AllEnded { outcomes: ends, world: self.root, history: self.history });
            }
        }
        Err(RunError::Endless(MAX_EVENTS))
    }

    /// Sends an event to a run and performs its commands, unless its task control dies meanwhile.
    fn tell(&mut self, run: usize, event: Event) -> Result<(), RunError> {
        self.runs[run].has_begun |= matches!(event, Event::Started { .. });
        let one = &self.runs[run];
        if one.end.is_some() || !one.has_begun || one.gone.is_some() {
            return Ok(());
        }
        if let Event::Granted { instance, lease } = &event {
            self.runs[run].asked.remove(instance);
            self.runs[run].heard.insert(lease.id);
        }
        let mut commands = self.decide(run, event);
        let ends = commands.iter().any(|command| matches!(command, Command::End { .. }));
        let now_s = self.now.seconds();
        let death = self.runs[run].death.take_if(|death| death.at_s <= now_s && !ends);
        let (written, performed) = reached(death.as_ref(), commands.len());
        let log = &mut self.runs[run].log;
        log.truncate(log.len() - (commands.len() - written));
        commands.truncate(written);
        let unperformed = commands.split_off(performed);
        self.perform_all(run, commands)?;
        if let Some(death) = death {
            return self.dies(run, death, unperformed);
        }
        let mirror = self.runs[run].executive.root();
        let is_root = || {
            mirror
                .iter()
                .map(|(key, fact)| (key, &fact.value))
                .eq(self.root.iter().map(|(key, fact)| (key, &fact.value)))
        };
        if self.runs[run].end.is_none() && self.runs[run].gone.is_none() && !is_root() {
            return Err(self.broken(format!("the mirror of run {run} is not the root")));
        }
        self.runs[run].executive.check_invariants().map_err(|problem| self.broken(problem))
    }

    /// A run handles an event; both event and commands are logged.
    fn decide(&mut self, run: usize, event: Event) -> Vec<Command> {
        let (at, one) = (self.now, &mut self.runs[run]);
        let commands = one.executive.handle(at, event.clone());
        let said = commands.iter().map(|command| LogEntry::Command(command.clone()));
        one.log.extend(std::iter::once(LogEntry::Event(event)).chain(said).map(|entry| LogLine { at, entry }));
        commands
    }

    /// Performs the commands of a run, and sends each new revision to the other runs.
    fn perform_all(&mut self, run: usize, commands: Vec<Command>) -> Result<(), RunError> {
        let mut told = Vec::new();
        for command in commands {
            let before = self.root.clone();
            if let Command::Commit { instance, changes, .. } = &command {
                self.root.apply(changes).map_err(|error| self.broken(error))?;
                let written = self.root.iter().filter(|(key, fact)| before.get(key) != Some(&fact.value));
                let gone = before.iter().filter(|(key, _)| self.root.get(key).is_none());
                let facts: Vec<(FactKey, Option<Value>)> = written
                    .map(|(key, fact)| (key.clone(), Some(fact.value.clone())))
                    .chain(gone.map(|(key, _)| (key.clone(), None)))
                    .collect();
                self.commits.push((run, facts.iter().map(|(key, _)| key.clone()).collect()));
                self.happened(run, What::Committed(self.path(run, *instance), self.root.clone()));
                told.push(Event::WorldChanged { revision: self.root.revision(), facts });
            } else {
                self.perform(run, command)?;
            }
        }
        for event in told {
            for other in (0..self.runs.len()).filter(|other| *other != run) {
                self.tell(other, event.clone())?;
            }
        }
        Ok(())
    }

    fn perform(&mut self, run: usize, command: Command) -> Result<(), RunError> {
        match command {
            Command::Note(Note::Expanded { instance, path, .. }) => drop(self.runs[run].paths.insert(instance, path)),
            Command::Note(_) | Command::Commit { .. } | Command::Operate { .. } => {}
            Command::Acquire { instance, requirements, priority } => {
                self.runs[run].asked.insert(instance, (requirements.clone(), priority));
                let request = AcquireRequest::new(self.runs[run].session.clone(), requirements)
                    .priority(priority)
                    .speculative(priority < CERTAIN);
                let waiter = self.pool.acquire(self.now, request).map_err(|error| self.broken(error))?;
                self.runs[run].waiters.insert(instance, waiter);
                self.answers();
                if priority >= CERTAIN {
                    self.tell_holders(run, waiter);
                }
            }
            Command::Withdraw { instance } => {
                self.runs[run].asked.remove(&instance);
                if let Some(waiter) = self.runs[run].waiters.remove(&instance) {
                    self.pool.cancel(self.now, waiter).map_err(|error| self.broken(error))?;
                } else if let Some(lease) =
                    self.runs[run].leases.iter().find(|(_, of)| **of == instance).map(|(lease, _)| *lease)
                {
                    self.give_back(run, lease)?;
                }
                self.answers();
            }
            Command::Project { instance, attempt, changes, reads, .. } => {
                let world = self.root.project(&changes).map_err(|error| self.broken(error))?;
                self.next += 1;
                let projection = ProjectionId(self.next);
                self.projections.insert(projection, shown(world, &reads));
                let late = self.late();
                self.at(run, late, Due::Event(Box::new(Event::Projected { instance, attempt, projection })));
            }
            // The provider refuses a goal under a lease that has ended.
            Command::Start { instance, attempt, goal }
                if goal.lease.as_ref().is_some_and(|lease| self.runs[run].lost.contains(&lease.id)) =>
            {
                let reason = "its lease has ended".to_owned();
                self.at(
                    run,
                    Duration::ZERO,
                    Due::Event(Box::new(Event::Crashed { instance, attempt, reason, unknown: false, refused: false })),
                );
            }
            Command::Start { instance, attempt, goal } => {
                self.happened(run, What::Began(self.path(run, instance)));
                let path = format!("{run}:{}", self.runs[run].paths.get(&instance).map_or("", String::as_str));
                let world = goal.projection.and_then(|id| self.projections.get(&id)).unwrap_or(&self.root);
                let Performance { duration_s, answer } = self.oracle.perform(&path, attempt, &goal, world);
                let event = match answer {
                    Answer::Finished { outcome, outputs, measured } => {
                        let (evidence, reason, at_rest) = (Vec::new(), String::new(), true);
                        Event::Finished { instance, attempt, outcome, outputs, measured, evidence, reason, at_rest }
                    }
                    Answer::Crashed | Answer::LeaseLost => Event::Crashed {
                        instance,
                        attempt,
                        reason: "the worker died".to_owned(),
                        unknown: false,
                        refused: false,
                    },
                };
                self.at(run, Duration::from_secs_f64(duration_s.max(0.0)), Due::Event(Box::new(event)));
            }
            Command::Cancel { instance, attempt } => {
                self.happened(run, What::Cut(self.path(run, instance)));
                self.agenda.retain(|_, (of, due)| {
                    let of_what = match due {
                        Due::Event(event) => match &**event {
                            Event::Finished { instance, attempt, .. }
                            | Event::Crashed { instance, attempt, .. }
                            | Event::Projected { instance, attempt, .. } => Some((*instance, *attempt)),
                            _ => None,
                        },
                        Due::Begin | Due::SessionEnds | Due::TakenUp => None,
                    };
                    *of != run || of_what != Some((instance, attempt))
                });
            }
            Command::Release { lease, .. } => {
                if let Some(lease) = lease.filter(|lease| !self.runs[run].lost.contains(lease)) {
                    self.give_back(run, lease)?;
                }
                self.answers();
            }
            Command::Wake { at } => self.at(run, at.since(self.now), Due::Event(Box::new(Event::Woken))),
            Command::End { outcome, reason, .. } => self.runs[run].end = Some((outcome, reason)),
        }
        Ok(())
    }

    /// Notifies holders of resources that a certain node of a run needs, if the node has to wait.
    fn tell_holders(&mut self, run: usize, waiter: WaiterId) {
        let Some(why) = self.pool.explain(waiter) else { return };
        let leases: Vec<LeaseId> = why.held_by().collect();
        for other in (0..self.runs.len()).filter(|other| *other != run) {
            let holders =
                leases.iter().filter_map(|lease| self.runs[other].leases.get(lease).copied()).collect::<Vec<_>>();
            if !holders.is_empty() {
                let late = self.late();
                self.at(other, late, Due::Event(Box::new(Event::WantedByOthers { holders })));
            }
        }
    }

    fn give_back(&mut self, run: usize, lease: LeaseId) -> Result<(), RunError> {
        self.happened(run, What::GaveBack(lease));
        let one = &mut self.runs[run];
        one.leases.remove(&lease);
        let session = one.session.clone();
        self.pool.release(self.now, Some(&session), lease).map(drop).map_err(|error| self.broken(error))
    }

    /// Turns the pool's notices into events.
    fn answers(&mut self) {
        drop(self.pool.take_records());
        for notice in self.pool.take_notices() {
            let Notice::Granted { waiter, lease } = notice else { continue };
            let asked = self.runs.iter().enumerate().find_map(|(run, one)| {
                one.waiters.iter().find(|(_, waits)| **waits == waiter).map(|(instance, _)| (run, *instance))
            });
            let Some((run, instance)) = asked else { continue };
            self.runs[run].waiters.remove(&instance);
            self.runs[run].leases.insert(lease.id, instance);
            let ids = lease.resources.iter().map(|resource| resource.id.clone()).collect();
            self.happened(run, What::Granted(lease.id, ids));
            let late = self.late();
            self.at(run, late, Due::Event(Box::new(Event::Granted { instance, lease })));
        }
    }
}
