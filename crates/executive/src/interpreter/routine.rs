//! Routines in HSM mode. A routine acquires at its entry everything that its parts need and holds it to its end, so that no other
//! node gets it in between. It is one PIA if any part is one. Inner routines and preemptive concurrencies belong to it.
//!
//! A routine of the window gets its lease from the window; everything in its interpreter belongs to that routine.

use super::{Interpreter, Target};
use crate::binding;
use crate::checkpoint::{leases, requirements};
use crate::context::Context;
use crate::protocol::{Command, Note};
use ratn_model::id::{InstanceId, StateId};
use ratn_model::resource::{Lease, Requirement};
use serde::{Deserialize, Serialize};

/// The resources that a routine holds for all its parts.
#[derive(Serialize, Deserialize)]
pub(crate) struct Routine {
    /// The resources that it acquires.
    #[serde(with = "requirements")]
    pub(crate) requirements: Vec<Requirement>,
    /// Its lease; `None` while it acquires a new one because a worker died.
    #[serde(with = "leases")]
    pub(crate) lease: Option<Lease>,
    /// The thread that entered it, its state and its instance; `None` for a routine of the window.
    pub(crate) visit: Option<(u64, StateId, InstanceId)>,
}

impl Interpreter {
    pub(super) fn routine_of(&self, thread: u64) -> Option<&Routine> {
        self.routines.get(&self.threads.get(&thread)?.routine?)
    }

    pub(super) fn routine_of_mut(&mut self, thread: u64) -> Option<&mut Routine> {
        self.routines.get_mut(&self.threads.get(&thread)?.routine?)
    }

    pub(super) fn begin_routine(&mut self, context: &mut Context<'_>, thread: u64) {
        if self.is_held(context, thread) {
            return self.hold_back(context, thread);
        }
        let Some(current) = self.threads.get(&thread).and_then(|thread| thread.current.as_ref()) else { return };
        let (id, instance, attempt, path) = (current.state, current.instance, current.attempt, current.path.clone());
        if context.plan.state(id).nature == crate::plan::NodeNature::Irreversible {
            self.hold.has_begun(instance);
        }
        let state = context.program.state(id);
        let wanted = &context.plan.state(id).requirements;
        let requirements = self.with_scope(context, thread, None, |scope| binding::requirements(state, wanted, scope));
        let requirements = match requirements {
            Ok(requirements) => requirements,
            Err(error) => return self.end_node(context, thread, error.reason()),
        };
        context.note(Note::Running { instance, attempt });
        self.last_routine += 1;
        let number = self.last_routine;
        let Some(begun) = self.threads.get_mut(&thread) else { return };
        let lease = begun.current.take().and_then(|current| current.lease);
        begun.routine = Some(number);
        self.routines.insert(number, Routine { requirements, lease, visit: Some((thread, id, instance)) });
        self.has_begun_something(thread);
        self.enter_composite(context, thread, id, path);
    }

    /// A state has ended; if it is a routine, it releases its lease.
    pub(super) fn end_routine(&mut self, context: &mut Context<'_>, thread: u64, state: StateId, outcome: &str) {
        let Some(of) = self.threads.get_mut(&thread) else { return };
        let Some(number) = of.routine else { return };
        let Some(routine) = self.routines.get(&number) else { return };
        let Some((_, _, instance)) = routine.visit.filter(|visit| (visit.0, visit.1) == (thread, state)) else {
            return;
        };
        of.routine = None;
        of.idle_visits = 0;
        context.note(Note::Finished { instance, outcome: outcome.into() });
        self.give_up(context, number);
        debug_assert!(matches!(self.target, Target::Actual), "a routine on a projection is the window's");
        context.note(Note::Retired { instance });
    }

    /// The run ends: every routine under way releases its lease.
    pub(super) fn give_up_routines(&mut self, context: &mut Context<'_>) {
        let entered = self.routines.iter().filter_map(|(number, routine)| Some((*number, routine.visit?.2)));
        for (number, instance) in entered.collect::<Vec<_>>() {
            self.give_up(context, number);
            context.note(Note::Squashed { instance });
        }
    }

    fn give_up(&mut self, context: &mut Context<'_>, number: u64) {
        let Some(routine) = self.routines.remove(&number) else { return };
        let Some((_, _, instance)) = routine.visit else { return };
        if let Some(lease) = routine.lease {
            context.commands.push(Command::Release { instance, lease: Some(lease.id), projection: None });
        }
    }
}
