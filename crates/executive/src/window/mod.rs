//! The window: the instances expanded and not yet retired, executed out of order.
//!
//! An event touches the instances that it is about and those that wait for them: each waits for one older instance at a time
//! ([`ready`]). What holds at a place of the program is looked up along the chains of older writers ([`view`]), never copied.
//! Lines retire in program order ([`retire`]), so the root world always is the world after a prefix of the program: a failure is
//! precise, and a projection is the root plus the effects of the older instances on the path.
//!
//! Three moments of a result: *finished* feeds data flows and projections; *settled* cannot change any more ([`settle`]) and
//! decides conditions and loops; *retired* is real.
//!
//! | | |
//! |---|---|
//! | growing | [`cursor`], [`expand`], [`concurrency`], [`environment`] |
//! | beginning | [`ready`], [`begin`], [`priority`], [`timers`] |
//! | ending | [`decide`], [`settle`], [`retire`], [`revalidate`], [`outside`], [`squash`], [`twins`] |

mod append;
mod begin;
mod branch;
mod concurrency;
mod cursor;
mod decide;
mod environment;
mod expand;
mod instance;
mod instances;
mod iterate;
mod outside;
mod priority;
mod ready;
mod retire;
mod revalidate;
mod segment;
mod settle;
mod squash;
mod table;
mod timers;
mod twins;
mod view;

use crate::binding;
use crate::context::{Context, in_circles};
use crate::hold::Hold;
use crate::interpreter::{DEFAULT_ATTEMPTS, Progress};
use crate::plan::{Plan, Predicate};
use crate::protocol::{Command, Event, Learned, Note};
use concurrency::{Fork, Thread};
use cursor::{Cursor, Todo};
use environment::{Binding, Environment, Link, assigned};
use instance::{Changed, Ended, Instance, Line, Role, Segment, Status, Wait};
use instances::Instances;
use ratn_model::id::InstanceId;
use ratn_model::program::{ABORTED, PREEMPTED, Program, STOPPED, SUCCESS, StateKind};
use ratn_model::resource::Quantity;
use ratn_model::time::Timestamp;
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use segment::Branch;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use timers::Timer;
use twins::Twins;
use view::Sight;

/// How a run ended.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct End {
    pub(crate) outcome: String,
    pub(crate) outputs: BTreeMap<String, Value>,
    pub(crate) reason: String,
}

/// CDTN mode.
pub(crate) struct Window {
    plan: Arc<Plan>,
    tolerance: Tolerance,
    learned: Learned,
    capacity: BTreeMap<String, Quantity>,
    speculation_width: usize,
    instances: Instances,
    cursors: Vec<Cursor>,
    threads: BTreeMap<Line, Thread>,
    branches: BTreeMap<Segment, Branch>,
    forks: BTreeMap<InstanceId, Fork>,
    joins: BTreeMap<InstanceId, Vec<(Predicate, Link)>>,
    /// To be looked at.
    queue: VecDeque<InstanceId>,
    /// Nodes under way.
    active: BTreeSet<InstanceId>,
    detached: BTreeSet<InstanceId>,
    /// Speculative nodes that leave room.
    stalled: Vec<InstanceId>,
    twins: Twins,
    timers: BTreeSet<(Timestamp, Timer)>,
    hold: Hold,
    end: Option<End>,
    is_ending: bool,
    next_segment: Segment,
    next_line: Line,
    next_order: u64,
    grown_since_estimate: usize,
}

/// More instances than this in one event, beyond what the horizon lets expand, go in circles.
const MAX_INSTANCES_AT_ONCE: u64 = 100_000;

/// Branches and regions may each be expanded up to the horizon: so many of them at the most are counted.
const MAX_HORIZONS: u64 = 64;

/// The task's own line.
const MAIN: Line = 0;

impl Window {
    /// A window at the beginning of the program.
    pub(crate) fn new(
        program: &Program,
        plan: &Arc<Plan>,
        parameters: &BTreeMap<String, Value>,
        capacity: BTreeMap<String, Quantity>,
        learned: Learned,
        tolerance: Tolerance,
    ) -> Window {
        let plan = plan.clone();
        let mut environment = Environment::new(&plan);
        for (name, value) in parameters {
            environment.variables.declare(name, Binding::Known(value.clone()));
        }
        let cursor = Cursor {
            environment,
            tail: None,
            line: MAIN,
            segment: 0,
            position: 0,
            todo: Todo::Enter(Program::ROOT),
            probability: 1.0,
            because: None,
            idle: 0,
            order: 0,
        };
        Window {
            plan,
            tolerance,
            learned,
            capacity,
            speculation_width: program.speculation_width,
            instances: Instances::default(),
            cursors: vec![cursor],
            threads: BTreeMap::from([(MAIN, Thread { is_active: true, ..Thread::default() })]),
            branches: BTreeMap::new(),
            forks: BTreeMap::new(),
            joins: BTreeMap::new(),
            queue: VecDeque::new(),
            active: BTreeSet::new(),
            detached: BTreeSet::new(),
            stalled: Vec::new(),
            twins: Twins::default(),
            timers: BTreeSet::new(),
            hold: Hold::default(),
            end: None,
            is_ending: false,
            next_segment: 0,
            next_line: MAIN,
            next_order: 0,
            grown_since_estimate: 0,
        }
    }

    /// Begins.
    pub(crate) fn start(&mut self, context: &mut Context<'_>) -> Option<End> {
        if let Some(deadline_s) = context.program.deadline_s {
            self.set_timer(context, deadline_s, Timer::Deadline);
        }
        self.settle(context)
    }

    /// Takes an event; the end of the run, when this was it.
    pub(crate) fn handle(&mut self, context: &mut Context<'_>, event: Event) -> Option<End> {
        self.fire(context);
        match event {
            Event::Granted { instance, lease } => {
                if let Some(waiting) = self.with_status(instance, Status::Acquiring) {
                    waiting.lease = Some(Box::new(lease));
                    waiting.began = context.now;
                    let held = waiting.is_pia() && !self.hold.lets_begin();
                    self.set_status(instance, Status::Granted, if held { Wait::Pause } else { Wait::Nothing });
                    if !held {
                        self.proceed(context, instance);
                    }
                } else {
                    self.in_routine(context, Event::Granted { instance, lease });
                }
            }
            Event::Refused { instance, reason } => {
                if self.with_status(instance, Status::Acquiring).is_some() {
                    self.active.remove(&instance);
                    self.fail(context, instance, format!("its resources were refused: {reason}"));
                } else {
                    self.in_routine(context, Event::Refused { instance, reason });
                }
            }
            Event::Projected { instance, attempt, projection } => {
                match self.with_status(instance, Status::Projecting) {
                    Some(waiting) if waiting.attempt == attempt => {
                        waiting.projection = Some(projection);
                        self.set_status(instance, Status::Granted, Wait::Nothing);
                        self.proceed(context, instance);
                    }
                    _ => self.in_routine(context, Event::Projected { instance, attempt, projection }),
                }
            }
            Event::Finished { instance, attempt, outcome, outputs, measured, evidence, reason } => {
                match self.instances.get(instance).filter(|running| running.status == Status::Running) {
                    Some(running) if running.attempt == attempt && running.routine.is_none() => {
                        let changes = Changed::Declared(measured, evidence);
                        let own = self.plan.state(running.state);
                        let known = own.outcome(&outcome).map(|number| own.outcomes[number].clone());
                        let outcome = known.unwrap_or_else(|| outcome.into());
                        self.goal_ended(context, instance, Ended { outcome, outputs, reason, changes });
                    }
                    _ => {
                        let event = Event::Finished { instance, attempt, outcome, outputs, measured, evidence, reason };
                        self.in_routine(context, event);
                    }
                }
            }
            Event::Crashed { instance, attempt, reason } => match self.instances.get(instance) {
                Some(at) if at.attempt == attempt && at.is_under_way() && at.routine.is_none() => {
                    self.crashed(context, instance, &reason);
                }
                _ => self.in_routine(context, Event::Crashed { instance, attempt, reason }),
            },
            Event::RetirementFailed { reason, .. } => {
                self.stop(context, ABORTED, format!("what had happened could not be recorded: {reason}"));
            }
            Event::AbortRequested { reason } => self.stop(context, PREEMPTED, reason),
            Event::PauseRequested => self.hold = Hold::Paused(0),
            Event::ResumeRequested => {
                self.hold = Hold::Running;
                self.look_at_those_held();
            }
            Event::StepRequested => {
                self.hold.step();
                self.look_at_those_held();
            }
            Event::Advised { urgency_s } => self.advise(context, &urgency_s),
            Event::WorldChanged { facts, .. } => self.world_changed(context, facts.iter().map(|(fact, _)| fact)),
            Event::Woken => self.wake_routines(context),
            Event::Started { .. } | Event::Progressed { .. } | Event::Resumed => {}
        }
        self.settle(context)
    }

    /// What every instance that has not begun waits for.
    pub(crate) fn waits(&self, program: &Program) -> Vec<String> {
        let waiting = |i: &&Instance| i.role == Role::Node && matches!(i.status, Status::Expanded | Status::Acquiring);
        self.instances.iter().filter(waiting).map(|i| self.sentence(program, i)).collect()
    }

    fn sentence(&self, program: &Program, instance: &Instance) -> String {
        let path = self.path(program, instance.id);
        let named = |id: InstanceId| self.path(program, id);
        match instance.wait {
            Wait::Nothing => format!("{path} has just been expanded"),
            Wait::Data(id) => format!("{path} waits for an output of {}", named(id)),
            Wait::World(id) => format!("{path} waits for {} to be known or done, whose effects it reads", named(id)),
            Wait::Environment(id) => {
                format!("{path} waits for the environment to look as it does at its place: {} changes it", named(id))
            }
            Wait::Order => format!("{path} waits for every older state to have ended"),
            Wait::Sensing(id) => format!("{path} waits for {} to have looked", named(id)),
            Wait::Writer(id) => format!("{path} waits for {} to stop moving", named(id)),
            Wait::TaskResource(id) => format!("{path} waits for {}, which operates on a resource it uses", named(id)),
            Wait::Twin(id) => format!("{path} waits for {}, which computes the same on another branch", named(id)),
            Wait::Decision(id) => format!("{path} waits for the decision of {}", named(id)),
            Wait::Settling(id) => format!("{path} waits until the result of {} cannot change any more", named(id)),
            Wait::Backoff => format!("{path} waits before it is tried again"),
            Wait::Pause => format!("{path} waits for the operator"),
            Wait::Room => format!("{path} is speculative and leaves room to what is not"),
            Wait::Resources => format!("{path} waits for the resource manager"),
        }
    }

    /// The path of an instance, with visits.
    fn path(&self, program: &Program, id: InstanceId) -> String {
        self.instances.get(id).map_or(String::new(), |instance| {
            let state = program.state(instance.state);
            instance.environment.path(&state.name, instance.visit, instance.iteration)
        })
    }

    fn sight<'a>(&'a self, context: &'a Context<'_>) -> Sight<'a> {
        Sight {
            program: context.program,
            plan: &self.plan,
            root: context.root,
            instances: &self.instances,
            detached: &self.detached,
            joins: &self.joins,
        }
    }

    fn with_status(&mut self, id: InstanceId, status: Status) -> Option<&mut Instance> {
        self.instances.get_mut(id).filter(|i| i.status == status)
    }

    fn set_status(&mut self, id: InstanceId, status: Status, wait: Wait) {
        if let Some(instance) = self.instances.get_mut(id) {
            instance.status = status;
            instance.wait = wait;
        }
    }

    /// It waits, for one instance or for somebody to look at it again.
    fn wait(&mut self, id: InstanceId, wait: Wait) {
        if let Some(instance) = self.instances.get_mut(id) {
            instance.wait = wait;
        }
        if let Some(on) = wait.on() {
            match self.instances.get_mut(on) {
                Some(other) => other.waiters.push(id),
                // It went on meanwhile.
                None => self.enqueue(id),
            }
        }
    }

    fn wake_waiters(&mut self, id: InstanceId) {
        let Some(instance) = self.instances.get_mut(id) else { return };
        for waiter in std::mem::take(&mut instance.waiters) {
            self.enqueue(waiter);
        }
    }

    fn enqueue(&mut self, id: InstanceId) {
        if let Some(instance) = self.instances.get_mut(id)
            && !instance.queued
        {
            instance.queued = true;
            self.queue.push_back(id);
        }
    }

    /// It does not hold anything any more, nor does it act or look.
    fn is_idle(&mut self, id: InstanceId) {
        self.active.remove(&id);
        self.wake_waiters(id);
        for id in std::mem::take(&mut self.stalled) {
            self.enqueue(id);
        }
    }

    /// PIAs that may begin, and those beside that may try again.
    fn look_at_those_held(&mut self) {
        let heads = self.threads.values().filter_map(|thread| thread.head);
        let held: Vec<InstanceId> = heads.chain(self.detached.iter().copied()).collect();
        for id in held {
            self.enqueue(id);
        }
    }

    /// Looks, retires and grows until nothing changes.
    fn settle(&mut self, context: &mut Context<'_>) -> Option<End> {
        let ahead = (context.program.horizon as u64).saturating_mul(MAX_HORIZONS);
        let newest = context.last_instance.saturating_add(ahead).saturating_add(MAX_INSTANCES_AT_ONCE);
        loop {
            if *context.last_instance > newest {
                let head = self.threads.values().find_map(|thread| thread.head);
                let path = head.map(|head| self.path(context.program, head)).unwrap_or_default();
                self.stop(context, ABORTED, in_circles(&path));
            }
            while let Some(id) = self.queue.pop_front() {
                if let Some(instance) = self.instances.get_mut(id) {
                    instance.queued = false;
                    self.examine(context, id);
                }
                if self.end.is_some() {
                    return self.end.take();
                }
            }
            let retired = self.retire(context);
            let grew = self.expand(context);
            if grew {
                self.estimate(context);
            }
            if self.end.is_some() {
                return self.end.take();
            }
            if !retired && !grew && self.queue.is_empty() {
                return None;
            }
        }
    }

    fn examine(&mut self, context: &mut Context<'_>, id: InstanceId) {
        let Some(instance) = self.instances.get(id) else { return };
        match (instance.role, instance.status) {
            (Role::Node, Status::Expanded) => self.begin(context, id),
            // It got its resources during a pause, and keeps them.
            (Role::Node, Status::Granted) if instance.wait == Wait::Pause && self.hold.lets_begin() => {
                self.set_status(id, Status::Granted, Wait::Nothing);
                self.proceed(context, id);
            }
            (Role::Node, Status::Finished) if instance.is_undecided() => self.decide_by_outcome(context, id),
            (Role::Condition | Role::Test, Status::Expanded) => self.decide(context, id),
            (Role::Loop, Status::Expanded) => self.count(context, id),
            (Role::Join, Status::Expanded) => self.decide_join(context, id),
            (Role::Entry | Role::Exit, Status::Expanded) => self.compute_boundary(context, id),
            (Role::Fork, Status::Expanded) => self.end_instance(id, Ended::success(binding::Outputs::new())),
            (Role::End, Status::Expanded) => self.end_run(context, id),
            _ => {}
        }
    }

    /// A node with several ways on has ended: its outcome decides once it cannot change any more.
    fn decide_by_outcome(&mut self, context: &mut Context<'_>, id: InstanceId) {
        if let Some(blocker) = self.unsettled(context, id, 0) {
            return self.wait(id, Wait::Settling(blocker));
        }
        let Some(instance) = self.instances.get(id) else { return };
        let Some(ended) = &instance.ended else { return };
        // `requires` is evaluated on the actual world when it retires, and may make another outcome of it.
        if !context.program.state(instance.state).annotations.requires.is_empty() {
            return;
        }
        let number = self.plan.state(instance.state).outcome(&ended.outcome);
        let arm = number.and_then(|n| instance.arms.iter().position(|arm| arm.outcomes & (1 << n) != 0));
        let decision = ended.outcome.to_string();
        if let Some(arm) = arm {
            let path = self.path(context.program, id);
            context.note(Note::Decided { instance: id, path, decision });
            self.take_arm(context, id, arm);
        }
    }

    /// An event for the nodes inside of a routine.
    fn in_routine(&mut self, context: &mut Context<'_>, event: Event) {
        let inside = match &event {
            Event::Granted { instance, .. }
            | Event::Refused { instance, .. }
            | Event::Projected { instance, .. }
            | Event::Finished { instance, .. }
            | Event::Crashed { instance, .. } => *instance,
            _ => return,
        };
        let routine = self.active.iter().copied().find(|id| {
            let routine = self.instances.get(*id).and_then(|i| i.routine.as_ref());
            routine.is_some_and(|routine| routine.is_at(inside))
        });
        if let Some(routine) = routine {
            self.tell_routine(context, routine, event);
        }
    }

    /// Time has passed for the nodes inside of routines, too.
    fn wake_routines(&mut self, context: &mut Context<'_>) {
        let active = self.active.iter().copied();
        let routines: Vec<InstanceId> =
            active.filter(|id| self.instances.get(*id).is_some_and(|i| i.routine.is_some())).collect();
        for routine in routines {
            self.tell_routine(context, routine, Event::Woken);
        }
    }

    fn tell_routine(&mut self, context: &mut Context<'_>, id: InstanceId, event: Event) {
        let Some(interpreter) = self.instances.get_mut(id).and_then(|i| i.routine.as_mut()) else { return };
        let progress = interpreter.handle(context, event);
        self.routine_progressed(context, id, progress);
    }

    fn routine_progressed(&mut self, context: &mut Context<'_>, id: InstanceId, progress: Progress) {
        let Progress::Ended { outcome, reason } = progress else { return };
        let Some(instance) = self.instances.get_mut(id) else { return };
        let Some(routine) = instance.routine.take() else { return };
        instance.lease = routine.lease().cloned().map(Box::new);
        let mut outputs = routine.outputs().get(&instance.state).cloned().unwrap_or_default();
        for name in &self.plan.state(instance.state).assigns {
            outputs.extend(routine.variable(name).map(|value| (assigned(name), value.clone())));
        }
        let changes = Changed::Exactly(routine.into_made());
        self.finish(context, id, Ended { outcome: outcome.into(), outputs, reason, changes });
    }

    /// A goal has ended: that is the result, unless it is tried again.
    fn goal_ended(&mut self, context: &mut Context<'_>, id: InstanceId, ended: Ended) {
        let Some(instance) = self.instances.get_mut(id) else { return };
        let state = context.program.state(instance.state);
        if let (Some(retry), ABORTED) = (state.annotations.retry, &*ended.outcome)
            && instance.tries <= retry.count
            && !instance.is_orphan()
        {
            let pause_s = retry.backoff_s * f64::from(2_u32.saturating_pow(instance.tries - 1));
            give_back(context, instance);
            instance.tries += 1;
            instance.attempt += 1;
            instance.status = Status::Expanded;
            instance.wait = Wait::Backoff;
            instance.not_before = context.now + std::time::Duration::try_from_secs_f64(pause_s).unwrap_or_default();
            let due = instance.not_before <= context.now;
            self.is_idle(id);
            if due {
                self.enqueue(id);
            } else {
                self.set_timer(context, pause_s, Timer::Retry(id));
            }
            return;
        }
        self.finish(context, id, ended);
    }

    /// A node's result is known: it gives back what it held.
    fn finish(&mut self, context: &mut Context<'_>, id: InstanceId, mut ended: Ended) {
        let Some(instance) = self.instances.get(id) else { return };
        let state = context.program.state(instance.state);
        if let StateKind::Action { outputs, .. } = &state.kind
            && &*ended.outcome == SUCCESS
            && let Some(problem) = binding::missing_output(outputs, &ended.outputs)
        {
            ended = Ended { changes: ended.changes, ..Ended::aborted(problem) };
        }
        if &*ended.outcome == STOPPED && self.plan.state(instance.state).outcome(STOPPED).is_none() {
            ended.outcome = PREEMPTED.into();
        }
        if self.plan.state(instance.state).outcome(&ended.outcome).is_none() {
            let problem = format!("it ended with `{}`, which is no outcome of its action", ended.outcome);
            ended = Ended { changes: ended.changes, ..Ended::aborted(problem) };
        }
        if let Err(problem) = self.assign(context, id, &mut ended) {
            ended = Ended { changes: ended.changes, ..Ended::aborted(problem) };
        }
        let Some(instance) = self.instances.get_mut(id) else { return };
        context.note(Note::Finished { instance: id, outcome: ended.outcome.clone() });
        give_back(context, instance);
        instance.has_acted = instance.status == Status::Running;
        let detached = instance.detached;
        self.is_idle(id);
        self.end_instance(id, ended);
        if detached {
            self.retire_detached(context, id);
        }
    }

    /// What an action assigns to variables is part of its result.
    fn assign(&self, context: &Context<'_>, id: InstanceId, ended: &mut Ended) -> Result<(), String> {
        let Some(instance) = self.instances.get(id) else { return Ok(()) };
        let state = context.program.state(instance.state);
        let is_action = matches!(state.kind, StateKind::Action { .. });
        if state.assign.is_empty() || !is_action || !instance::gives_outputs(&ended.outcome) {
            return Ok(());
        }
        let mut values = Vec::new();
        for (name, expression) in &state.assign {
            let view = self.sight(context).view(instance, Some(&ended.outputs));
            let value = expression.evaluate(&view);
            let value =
                value.map_err(|e| binding::BindError::at(format_args!("`assign` of `{name}`"), state)(e).reason())?;
            values.push((assigned(name), value));
        }
        ended.outputs.extend(values);
        Ok(())
    }

    /// An attempt ended without an answer.
    fn crashed(&mut self, context: &mut Context<'_>, id: InstanceId, reason: &str) {
        let Some(instance) = self.instances.get_mut(id) else { return };
        let limit = context.program.state(instance.state).annotations.attempts.unwrap_or(DEFAULT_ATTEMPTS);
        give_back(context, instance);
        instance.crashes += 1;
        let ends = instance.is_pia() || instance.crashes >= limit;
        let attempt = instance.attempt;
        self.is_idle(id);
        if ends {
            return self.finish(context, id, Ended::aborted(format!("crashed in attempt {attempt}: {reason}")));
        }
        if let Some(instance) = self.instances.get_mut(id) {
            instance.attempt += 1;
            instance.status = Status::Expanded;
        }
        self.enqueue(id);
    }
}

fn give_back(context: &mut Context<'_>, instance: &mut Instance) {
    let (lease, projection) = (instance.lease.take().map(|l| l.id), instance.projection.take());
    if lease.is_some() || projection.is_some() {
        context.commands.push(Command::Release { instance: instance.id, lease, projection });
    }
}
