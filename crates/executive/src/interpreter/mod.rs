//! The sequential interpreter: executes a state and what it contains as written, one node after the other; the regions of a
//! concurrency beside each other.
//!
//! It is HSM mode (from the root, on the actual world), and it runs inside a routine of the window (under the routine's
//! lease, on the actual world or, for a routine that only computes, on a projection). It shares no code with the window's
//! scheduling: the two check each other.
//!
//! A thread of control has a stack of frames (the lists it is in) and does one thing at a time: [`walk`] chooses the next state, [`node`] executes one action,
//! [`again`] retries it, [`exit`] leaves composite states, [`waits`] executes states that wait, [`routine`] holds what a routine needs from its entry to its
//! end, [`turns`] shares this among the routine's threads, [`regions`] forks and joins, [`stop`] cancels what is under way.

mod again;
mod checkpoint;
mod exit;
mod node;
mod regions;
mod routine;
mod stop;
mod turns;
mod waits;
mod walk;

use crate::binding::{Bindings, Names, Outputs};
use crate::checkpoint::leases;
use crate::context::{Context, Made};
use crate::hold::Hold;
use crate::protocol::Event;
use node::GoalEnd;
use ratn_model::expression::Given;
use ratn_model::fact::{Change, FactPattern, Footprint};
use ratn_model::id::{InstanceId, ProjectionId, Revision, StateId};
use ratn_model::list::List;
use ratn_model::measurement::Evidence;
use ratn_model::program::{Program, StateKind};
use ratn_model::resource::Lease;
use ratn_model::time::Timestamp;
use ratn_model::value::Value;
use ratn_world::world::World;
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

pub(crate) use checkpoint::difference;
pub(crate) use routine::Routine;
use serde::{Deserialize, Serialize};

/// Number of attempts of a computing or sensing node whose worker dies, unless the state declares another.
pub(crate) const DEFAULT_ATTEMPTS: u32 = 3;

/// Where effects go.
#[derive(Serialize, Deserialize)]
pub(crate) enum Target {
    /// Into the root world.
    Actual,
    /// Into a projection: nothing becomes real.
    Projection {
        /// The root's revision below the projection.
        base: Revision,
        /// Changes since then, in order: first the effects of older instances, then those of this routine.
        changes: Vec<Change>,
        /// The path of the writer of each change.
        writers: Vec<Arc<str>>,
        /// Number of the changes by older instances.
        before: usize,
        /// Evidence for the changes by this routine.
        evidence: Evidence,
        /// The projected world.
        #[serde(skip)]
        world: World,
    },
}

/// Whether the interpreter goes on.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Progress {
    /// It waits for events.
    Busy,
    /// It has ended.
    Ended {
        /// The outcome of the state it executes.
        outcome: String,
        /// Reason, if the outcome is not success.
        reason: String,
    },
}

/// One activation of a list of states.
#[derive(Serialize, Deserialize)]
struct Frame {
    /// The state whose list it is.
    owner: StateId,
    /// Its number among the owner's lists.
    list: usize,
    /// The owner's path, without the iteration.
    path: String,
    /// How often each state of the list was visited.
    visits: BTreeMap<StateId, u32>,
    /// In a loop: the number of the iteration, and the elements (`None` in a `while`).
    iteration: Option<(usize, Option<List>)>,
    /// How many variables there were before the owner was entered.
    variables: usize,
    /// Reason of the last failure in this list.
    because: String,
}

/// What a thread does next.
#[derive(Serialize, Deserialize)]
enum Todo {
    /// Visit a state; the path is given for the first state only.
    Enter(StateId, Option<String>),
    /// A state has ended.
    Ended { state: StateId, outcome: String, reason: String },
    /// The next iteration of the innermost loop, or its end.
    Iterate,
    /// An action is under way.
    Busy,
    /// Regions are under way. Once `decided` is set, only those that are cut short still are.
    Join { state: StateId, path: String, regions: Vec<u64>, decided: Option<Decided> },
    /// The thread has ended.
    Done { outcome: String, reason: String },
}

/// The decision of a concurrency whose other regions are still being cut short.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Decided {
    /// The first region, in program order, that has ended.
    first: Option<usize>,
    /// With `successes`: whether enough regions succeeded (true), or no longer can (false).
    enough: Option<bool>,
    /// Whether the last region had begun.
    is_entered: bool,
}

/// State of a thread that is cut short: its goal is cancelled, and it leaves one state after the other.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
struct CutShort {
    /// Number of frames while a `finally` is executed; 0 before the first one.
    frames: usize,
    /// First error on the way out.
    problem: String,
}

/// A thread of control: the main one, or that of a region.
#[derive(Serialize, Deserialize)]
struct Thread {
    frames: Vec<Frame>,
    /// The innermost variable last. Regions share the values, so a long list is not copied at every fork.
    #[serde(skip)]
    variables: Vec<(String, Arc<Value>)>,
    todo: Todo,
    current: Option<Current>,
    /// The routine around the thread.
    routine: Option<u64>,
    /// Visits since it last started an action; see [`crate::context::MAX_IDLE_VISITS`].
    idle_visits: u32,
    /// Set when another region has won the race.
    cut_short: Option<CutShort>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
enum Phase {
    /// The operator lets no PIA begin; it may already have its resources.
    Held,
    /// Its worker died: it waits until its routine has a new lease.
    Stalled,
    /// It waits until the next try.
    Backoff(Timestamp),
    Acquiring,
    Projecting,
    Running,
    /// Another thread of its routine uses the units that it needs; the lowest number is next.
    Queued(u64),
}

/// The current action of a thread, or a routine that waits for its resources.
#[derive(Serialize, Deserialize)]
struct Current {
    instance: InstanceId,
    state: StateId,
    path: String,
    attempt: u32,
    tries: u32,
    crashes: u32,
    /// Its worker died: it is in backoff, and the routine's lease still contains that worker.
    #[serde(default)]
    has_died: bool,
    phase: Phase,
    /// When the goal or the wait began.
    #[serde(default)]
    since: Timestamp,
    /// When the goal reaches its timeout; `None` while it waits before it is given to its provider.
    timeout: Option<Timestamp>,
    #[serde(with = "leases")]
    lease: Option<Lease>,
    projection: Option<ProjectionId>,
    /// In a routine: the units of its lease that the goal works with.
    units: Vec<String>,
}

/// The interpreter of one state. A region's thread has the number of the region's place in the program ([`crate::plan::StatePlan::place`]): no two
/// threads execute one region at once, and threads go on in the order in which their regions are written.
#[derive(Serialize, Deserialize)]
pub(crate) struct Interpreter {
    #[serde(with = "checkpoint")]
    threads: BTreeMap<u64, Thread>,
    outputs: BTreeMap<StateId, Outputs>,
    /// States of loop bodies whose outputs are still those of the iteration before.
    earlier: BTreeSet<StateId>,
    /// Outcomes of regions.
    regions: BTreeMap<StateId, String>,
    routines: BTreeMap<u64, Routine>,
    last_routine: u64,
    last_turn: u64,
    target: Target,
    hold: Hold,
    /// Whether the world has changed since waits and watched motions were last checked.
    #[serde(skip, default)]
    has_changed: bool,
    /// Why the run ends, if a thread goes in circles.
    in_circles: Option<String>,
}

/// Number of the main thread, and of the window's routine that it executes.
const MAIN: u64 = 0;

impl Interpreter {
    /// HSM mode: the whole program on the actual world.
    pub(crate) fn of_program(parameters: &BTreeMap<String, Value>) -> Interpreter {
        let variables = parameters.iter().map(|(n, v)| (n.clone(), v.clone())).collect();
        Interpreter::new(variables, BTreeMap::new(), None, Target::Actual)
    }

    /// A routine: its own lease serves everything it contains.
    pub(crate) fn of_routine(
        variables: Vec<(String, Value)>,
        outputs: BTreeMap<StateId, Outputs>,
        routine: Routine,
        target: Target,
    ) -> Interpreter {
        Interpreter::new(variables, outputs, Some(routine), target)
    }

    fn new(
        variables: Vec<(String, Value)>,
        outputs: BTreeMap<StateId, Outputs>,
        routine: Option<Routine>,
        target: Target,
    ) -> Interpreter {
        let todo = Todo::Done { outcome: String::new(), reason: String::new() };
        let variables = variables.into_iter().map(|(name, value)| (name, Arc::new(value))).collect();
        let main = Thread {
            frames: Vec::new(),
            variables,
            todo,
            current: None,
            routine: routine.as_ref().map(|_| MAIN),
            idle_visits: 0,
            cut_short: None,
        };
        Interpreter {
            threads: BTreeMap::from([(MAIN, main)]),
            outputs,
            earlier: BTreeSet::new(),
            regions: BTreeMap::new(),
            routines: routine.map(|routine| (MAIN, routine)).into_iter().collect(),
            last_routine: MAIN,
            last_turn: 0,
            target,
            hold: Hold::default(),
            has_changed: false,
            in_circles: None,
        }
    }

    /// The present lease of the window's routine.
    pub(crate) fn lease(&self) -> Option<&Lease> {
        self.routines.get(&MAIN)?.lease.as_ref()
    }

    /// Whether the window's routine is asking for a new lease.
    pub(crate) fn asks(&self) -> bool {
        self.threads.values().flat_map(|thread| &thread.current).any(|current| current.phase == Phase::Acquiring)
    }

    /// Begins with `state`, visited at `path`, and goes on.
    pub(crate) fn start(&mut self, context: &mut Context<'_>, state: StateId, path: &str) -> Progress {
        self.begin_with(context, state, path);
        self.advance(context)
    }

    /// Begins with `state`, visited at `path`.
    pub(crate) fn begin_with(&mut self, context: &mut Context<'_>, state: StateId, path: &str) {
        self.set(MAIN, Todo::Enter(state, Some(path.to_owned())));
        self.begin_next(context);
    }

    /// Whether this instance is under way here.
    pub(crate) fn is_at(&self, instance: InstanceId) -> bool {
        self.thread_of(instance).is_some()
    }

    /// The thread that an instance is under way in.
    fn thread_of(&self, instance: InstanceId) -> Option<u64> {
        let is_at = |thread: &Thread| thread.current.as_ref().is_some_and(|current| current.instance == instance);
        self.threads.iter().find(|(_, thread)| is_at(thread)).map(|(id, _)| *id)
    }

    /// Whether what it does is real at once.
    pub(crate) fn is_actual(&self) -> bool {
        matches!(self.target, Target::Actual)
    }

    /// Whether it has ended because a thread went in circles (too many visits without an action).
    pub(crate) fn is_in_circles(&self) -> bool {
        self.in_circles.is_some()
    }

    pub(crate) fn outputs(&self) -> &BTreeMap<StateId, Outputs> {
        &self.outputs
    }

    /// The value of a variable outside of the state it executes.
    pub(crate) fn variable(&self, name: &str) -> Option<&Value> {
        let main = self.threads.get(&MAIN)?;
        main.variables.iter().rev().find(|(n, _)| n == name).map(|(_, value)| &**value)
    }

    /// The changes that it has made to its projection; none on the actual world, where they are already real.
    pub(crate) fn into_made(self) -> Made {
        match self.target {
            Target::Actual => Made::default(),
            Target::Projection { changes, before, evidence, .. } => {
                Made { changes: changes[before..].to_vec(), evidence }
            }
        }
    }

    /// Others have changed these facts after a routine at its place has set or deleted them: that was before, and is over.
    pub(crate) fn was_overwritten(&mut self, facts: &[FactPattern]) {
        let Target::Projection { changes, writers, before, evidence, .. } = &mut self.target else { return };
        let is_over = |change: &Change| !matches!(change, Change::Increase { .. }) && facts.contains(&change.pattern());
        let own = changes.split_off(*before).into_iter().zip(writers.split_off(*before));
        let (kept, by): (Vec<Change>, Vec<Arc<str>>) = own.filter(|(change, _)| !is_over(change)).unzip();
        changes.extend(kept);
        writers.extend(by);
        evidence.retain(|(fact, _)| !facts.contains(&FactPattern::of(fact)));
    }

    /// A routine at its place goes on with its own changes of the world as it is now: everything before it is real.
    pub(crate) fn project_anew(&mut self, root: &World) {
        if let Target::Projection { base, changes, writers, before, world, .. } = &mut self.target
            && let Ok(projected) = root.project(&changes[*before..])
        {
            changes.drain(..*before);
            writers.drain(..*before);
            (*base, *before, *world) = (root.revision(), 0, projected);
        }
    }

    /// Calls `use_scope` with the scope of the outermost state: its parameters, and the outputs of the executed states.
    pub(crate) fn in_scope<T>(
        &self,
        context: &Context<'_>,
        use_scope: impl FnOnce(&dyn ratn_model::expression::Scope) -> T,
    ) -> T {
        self.with_scope(context, MAIN, None, use_scope)
    }

    /// Handles what is due, then an event.
    pub(crate) fn handle(&mut self, context: &mut Context<'_>, event: Event) -> Progress {
        let mut progress = self.before(context, &event);
        while progress == Progress::Busy && self.next_due(context.now).is_some() {
            progress = self.fall_due(context);
        }
        if progress == Progress::Busy {
            self.take(context, event);
            progress = self.advance(context);
        }
        if progress == Progress::Busy {
            self.renew_leases(context);
        }
        progress
    }

    /// What comes before everything that is due: an answer, because the operator was told that it has arrived.
    pub(crate) fn before(&mut self, context: &mut Context<'_>, event: &Event) -> Progress {
        self.has_changed = true;
        let Event::Answered { instance, choice } = event else { return Progress::Busy };
        self.answered(context, *instance, choice);
        self.advance(context)
    }

    /// Takes an event for an instance under way, for all of them, or from the operator; ignores the others. What follows from it is left to do.
    pub(crate) fn take(&mut self, context: &mut Context<'_>, event: Event) {
        self.has_changed = true;
        let of = |interpreter: &Interpreter, id: InstanceId, attempt: Option<u32>| {
            let is_at = |current: &Current| attempt.is_none_or(|attempt| attempt == current.attempt);
            let is_meant = |thread: &u64| interpreter.threads[thread].current.as_ref().is_some_and(is_at);
            interpreter.thread_of(id).filter(is_meant)
        };
        match event {
            Event::Answered { instance, choice } => self.answered(context, instance, &choice),
            Event::Granted { instance, lease } => {
                if let Some(thread) = of(self, instance, None) {
                    self.granted(context, thread, lease);
                }
            }
            Event::Refused { instance, reason } => {
                if let Some(thread) = of(self, instance, None).filter(|t| self.phase(*t) == Some(Phase::Acquiring)) {
                    self.end_node(context, thread, format!("its resources were refused: {reason}"));
                }
            }
            Event::Projected { instance, attempt, projection } => {
                if let Some(thread) = of(self, instance, Some(attempt))
                    && self.phase(thread) == Some(Phase::Projecting)
                {
                    if let Some(current) = self.current(thread) {
                        current.projection = Some(projection);
                    }
                    self.run(context, thread);
                }
            }
            Event::Delayed { instance, attempt } | Event::Given { instance, attempt } => {
                if let Some(thread) = of(self, instance, Some(attempt)) {
                    self.given(context, thread, matches!(event, Event::Given { .. }));
                }
            }
            Event::Crashed { instance, attempt, reason, unknown, refused } => {
                if let Some(thread) = of(self, instance, Some(attempt)) {
                    self.crashed(context, thread, &reason, (unknown, refused));
                }
            }
            Event::Finished { instance, attempt, outcome, outputs, measured, evidence, reason, .. } => {
                if let Some(thread) = of(self, instance, Some(attempt))
                    && self.phase(thread) == Some(Phase::Running)
                {
                    let end = GoalEnd { outcome, outputs, measured, evidence, reason };
                    self.goal_ended(context, thread, end);
                }
            }
            Event::PauseRequested => self.hold.pause(),
            Event::ResumeRequested => {
                self.hold.resume();
                self.let_go(context);
            }
            Event::BreakpointsSet { states } => {
                self.hold.break_at(context.program, states);
                self.let_go(context);
            }
            Event::StepRequested => {
                self.hold.step();
                self.let_go(context);
            }
            _ => {}
        }
    }

    pub(crate) fn break_at(&mut self, program: &Program, breakpoints: Vec<String>) {
        self.hold.break_at(program, breakpoints);
    }

    /// The breakpoints; see [`crate::executive::Executive::breakpoints`].
    pub(crate) fn breakpoints(&self) -> &[String] {
        self.hold.breakpoints()
    }

    fn current(&mut self, thread: u64) -> Option<&mut Current> {
        self.threads.get_mut(&thread)?.current.as_mut()
    }

    fn phase(&self, thread: u64) -> Option<Phase> {
        self.threads.get(&thread)?.current.as_ref().map(|current| current.phase)
    }

    /// Calls `use_scope` with the present scope of a thread.
    fn with_scope<T>(
        &self,
        context: &Context<'_>,
        thread: u64,
        outputs: Option<&Outputs>,
        use_scope: impl FnOnce(&dyn ratn_model::expression::Scope) -> T,
    ) -> T {
        let world = match &self.target {
            Target::Actual => &*context.root,
            Target::Projection { world, .. } => world,
        };
        let (frames, variables, todo) = (Vec::new(), Vec::new(), Todo::Busy);
        let none = Thread { frames, variables, todo, current: None, routine: None, idle_visits: 0, cut_short: None };
        let thread = self.threads.get(&thread).unwrap_or(&none);
        let names = Scoped { interpreter: self, thread, program: context.program };
        use_scope(&Bindings { names: &names, outputs, world, unknown: &Footprint::NOTHING })
    }
}

struct Scoped<'a> {
    interpreter: &'a Interpreter,
    thread: &'a Thread,
    program: &'a ratn_model::program::Program,
}

impl Names for Scoped<'_> {
    fn variable(&self, name: &str) -> Option<Cow<'_, Value>> {
        let known = self.thread.variables.iter().rev().find(|(n, _)| n == name);
        known.map(|(_, value)| Cow::Borrowed(&**value))
    }

    fn port(&self, state: StateId, port: &str) -> Option<Cow<'_, Value>> {
        let source = self.program.state(state);
        let around = source.parent.map(|parent| &self.program.state(parent).kind);
        if port == "outcome" && matches!(around, Some(StateKind::Concurrency { .. })) {
            return self.interpreter.regions.get(&state).map(|outcome| Cow::Owned(Value::String(outcome.clone())));
        }
        let written = self.interpreter.outputs.get(&state).and_then(|outputs| outputs.get(port));
        written.or_else(|| source.defaults.get(port)).map(Cow::Borrowed)
    }

    fn given(&self, state: StateId, port: &str) -> Given {
        let source = self.program.state(state);
        let around = source.parent.map(|parent| &self.program.state(parent).kind);
        let is_written = if port == "outcome" && matches!(around, Some(StateKind::Concurrency { .. })) {
            self.interpreter.regions.contains_key(&state)
        } else {
            self.interpreter.outputs.get(&state).is_some_and(|outputs| outputs.contains_key(port))
        };
        match (is_written, source.defaults.contains_key(port)) {
            (true, _) => Given::Written,
            (false, true) => Given::Default,
            (false, false) => Given::Missing,
        }
    }
}
