//! The window: the instances expanded and not yet retired, executed out of order.
//!
//! After every event the window is grown ([`expand`]), surveyed in program order ([`survey`]: what can begin, what can be
//! decided) and its oldest instances are retired ([`retire`]), until nothing changes any more. Retirement is in program
//! order, so the root world always is the world after a prefix of the program: a failure is precise, and a projection is the
//! root plus the effects of the older instances on the path.
//!
//! Three moments of a result: *finished* feeds data flows and projections; *settled* cannot change any more (its path is
//! decided, its inputs are settled, nobody older will write what it read) and decides conditions and loops; *retired* is real.

mod begin;
mod decide;
mod deviation;
mod expand;
mod instance;
mod place;
mod priority;
mod retire;
mod survey;

use crate::binding;
use crate::context::Context;
use crate::interpreter::{DEFAULT_ATTEMPTS, Progress};
use crate::protocol::{Command, Event, Note};
use expand::Cursor;
use instance::{Changed, Ended, Instance, Instances, Status};
use ratn_model::id::InstanceId;
use ratn_model::program::{ABORTED, PREEMPTED, SUCCESS, StateKind};
use ratn_model::value::Value;
use ratn_world::tolerance::Tolerance;
use std::collections::BTreeMap;

pub(crate) use instance::Wait;

/// How a run ended.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct End {
    pub(crate) outcome: String,
    pub(crate) outputs: BTreeMap<String, Value>,
    pub(crate) reason: String,
}

/// CDTN mode.
pub(crate) struct Window {
    instances: Instances,
    cursors: Vec<Cursor>,
    /// The oldest instance in the window.
    oldest: Option<InstanceId>,
    end: Option<End>,
    tolerance: Tolerance,
    /// Retirements since the outputs that nobody can name any more were dropped.
    retired_since_sweep: usize,
}

/// Outputs of retired instances are swept after this many retirements.
const SWEEP_INTERVAL: usize = 64;

impl Window {
    /// A window at the beginning of the program.
    pub(crate) fn new(parameters: &BTreeMap<String, Value>, tolerance: Tolerance) -> Window {
        Window {
            instances: Instances::default(),
            cursors: vec![Cursor::start(parameters.clone())],
            oldest: None,
            end: None,
            tolerance,
            retired_since_sweep: 0,
        }
    }

    /// Begins.
    pub(crate) fn start(&mut self, context: &mut Context<'_>) -> Option<End> {
        self.settle(context)
    }

    /// Takes an event; the end of the run, when this was it.
    pub(crate) fn handle(&mut self, context: &mut Context<'_>, event: Event) -> Option<End> {
        match event {
            Event::Granted { instance, lease } => {
                if let Some(waiting) = self.with_status(instance, Status::Acquiring) {
                    waiting.lease = Some(lease);
                    waiting.status = Status::Granted;
                } else {
                    self.in_routine(context, Event::Granted { instance, lease });
                }
            }
            Event::Refused { instance, reason } => {
                if let Some(waiting) = self.with_status(instance, Status::Acquiring) {
                    waiting.status = Status::Finished;
                    waiting.ended = Some(Ended::aborted(format!("its resources were refused: {reason}")));
                } else {
                    self.in_routine(context, Event::Refused { instance, reason });
                }
            }
            Event::Projected { instance, attempt, projection } => {
                match self.with_status(instance, Status::Projecting) {
                    Some(waiting) if waiting.attempt == attempt => {
                        waiting.projection = Some(projection);
                        waiting.status = Status::Granted;
                    }
                    _ => self.in_routine(context, Event::Projected { instance, attempt, projection }),
                }
            }
            Event::Finished { instance, attempt, outcome, outputs, measured, reason } => {
                match self.with_status(instance, Status::Running) {
                    Some(running) if running.attempt == attempt && running.routine.is_none() => {
                        let changes = Changed::Declared(measured);
                        self.finish(context, instance, Ended { outcome, outputs, reason, changes });
                    }
                    _ => {
                        let event = Event::Finished { instance, attempt, outcome, outputs, measured, reason };
                        self.in_routine(context, event);
                    }
                }
            }
            Event::Crashed { instance, attempt, reason } => match self.instances.alive.get(&instance) {
                Some(at) if at.attempt == attempt && at.is_under_way() && at.routine.is_none() => {
                    self.crashed(context, instance, &reason);
                }
                _ => self.in_routine(context, Event::Crashed { instance, attempt, reason }),
            },
            Event::RetirementFailed { reason, .. } => {
                return self.stop(context, ABORTED, format!("what had happened could not be recorded: {reason}"));
            }
            Event::AbortRequested { reason } => return self.stop(context, PREEMPTED, reason),
            _ => {}
        }
        self.settle(context)
    }

    /// What every instance that has not begun waits for.
    pub(crate) fn waits(&self) -> impl Iterator<Item = (&str, &Wait)> {
        let waiting = |i: &&Instance| matches!(i.status, Status::Expanded | Status::Acquiring);
        self.instances.alive.values().filter(waiting).map(|i| (i.path.as_str(), &i.wait))
    }

    /// The path of an instance in the window.
    pub(crate) fn path(&self, id: InstanceId) -> &str {
        self.instances.alive.get(&id).map_or("", |i| &i.path)
    }

    fn with_status(&mut self, id: InstanceId, status: Status) -> Option<&mut Instance> {
        self.instances.alive.get_mut(&id).filter(|i| i.status == status)
    }

    /// Grows, surveys and retires until nothing changes.
    fn settle(&mut self, context: &mut Context<'_>) -> Option<End> {
        loop {
            let grew = self.expand(context);
            if grew {
                self.estimate(context);
            }
            let moved = self.survey(context);
            let retired = self.retire(context);
            if self.end.is_some() || !(grew || moved || retired) {
                return self.end.clone();
            }
        }
    }

    /// An event for a node inside of a routine.
    fn in_routine(&mut self, context: &mut Context<'_>, event: Event) {
        let inside = match &event {
            Event::Granted { instance, .. }
            | Event::Refused { instance, .. }
            | Event::Projected { instance, .. }
            | Event::Finished { instance, .. }
            | Event::Crashed { instance, .. } => *instance,
            _ => return,
        };
        let routine = self
            .instances
            .alive
            .values_mut()
            .find(|i| i.routine.as_ref().is_some_and(|routine| routine.instance() == Some(inside)));
        let Some(instance) = routine else { return };
        let (id, Some(interpreter)) = (instance.id, instance.routine.as_mut()) else { return };
        let progress = interpreter.handle(context, event);
        self.routine_progressed(context, id, progress);
    }

    fn routine_progressed(&mut self, context: &mut Context<'_>, id: InstanceId, progress: Progress) {
        let Progress::Ended { outcome, reason } = progress else { return };
        let Some(instance) = self.instances.alive.get_mut(&id) else { return };
        let Some(routine) = instance.routine.take() else { return };
        instance.lease = routine.lease().cloned();
        let outputs = routine.outputs().get(&instance.state).cloned().unwrap_or_default();
        let changes = Changed::Exactly(routine.into_changes());
        self.finish(context, id, Ended { outcome, outputs, reason, changes });
    }

    /// A node's result is known: it gives back what it held.
    fn finish(&mut self, context: &mut Context<'_>, id: InstanceId, mut ended: Ended) {
        let Some(instance) = self.instances.alive.get_mut(&id) else { return };
        if let StateKind::Action { outputs, .. } = &context.program.state(instance.state).kind
            && ended.outcome == SUCCESS
            && let Some(problem) = binding::missing_output(outputs, &ended.outputs)
        {
            ended = Ended { changes: ended.changes, ..Ended::aborted(problem) };
        }
        context.note(Note::Finished { instance: id, outcome: ended.outcome.clone() });
        instance.status = Status::Finished;
        give_back(context, instance);
        instance.ended = Some(ended);
    }

    /// An attempt ended without an answer.
    fn crashed(&mut self, context: &mut Context<'_>, id: InstanceId, reason: &str) {
        let Some(instance) = self.instances.alive.get_mut(&id) else { return };
        let limit = context.program.state(instance.state).annotations.attempts.unwrap_or(DEFAULT_ATTEMPTS);
        give_back(context, instance);
        instance.crashes += 1;
        if instance.is_pia() || instance.crashes >= limit {
            let reason = format!("crashed in attempt {}: {reason}", instance.attempt);
            context.note(Note::Finished { instance: id, outcome: ABORTED.to_owned() });
            instance.status = Status::Finished;
            instance.ended = Some(Ended::aborted(reason));
        } else {
            instance.attempt += 1;
            instance.status = Status::Expanded;
        }
    }
}

fn give_back(context: &mut Context<'_>, instance: &mut Instance) {
    let (lease, projection) = (instance.lease.take().map(|l| l.id), instance.projection.take());
    if lease.is_some() || projection.is_some() {
        context.commands.push(Command::Release { instance: instance.id, lease, projection });
    }
}
