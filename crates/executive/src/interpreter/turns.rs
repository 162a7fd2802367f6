//! Turns within a routine: its lease serves all threads of control in it, and a unit of it performs one goal at a time. Each goal gets free
//! units; one for which there are too few waits until there are, and who waits first is first.
//!
//! Outside of a routine every goal has a lease of its own, so that the resource manager sees to the turns.

use super::{Current, Interpreter, Phase};
use crate::context::Context;
use ratn_model::resource::{Lease, LeasedResource};

impl Interpreter {
    /// Whether a goal waits for units that another thread of its routine works with.
    pub(super) fn waits_its_turn(&mut self, context: &Context<'_>, thread: u64) -> bool {
        let free = self.free_units(context, thread);
        let waits = free.is_none();
        if waits && !matches!(self.phase(thread), Some(Phase::Queued(_))) {
            self.last_turn += 1;
            self.set_phase(thread, Phase::Queued(self.last_turn));
        }
        if let (Some(current), Some(units)) = (self.current(thread), free) {
            current.units = units;
        }
        waits
    }

    /// Those begin whose turn it is; whether any did.
    pub(super) fn take_turns(&mut self, context: &mut Context<'_>) -> bool {
        let is_queued = |thread: &u64| matches!(self.phase(*thread), Some(Phase::Queued(_)));
        let queued = self.threads.keys().copied().filter(is_queued);
        let mut has_begun = false;
        for thread in queued.collect::<Vec<_>>() {
            // While all of it is asked for anew, nothing begins.
            let waits = self.routine_of(thread).is_some_and(|r| r.lease.is_none() && !r.requirements.is_empty());
            if !waits && self.free_units(context, thread).is_some() {
                has_begun = true;
                // What it requires may have been changed while it waited.
                if self.may_try(context, thread) {
                    self.project_or_run(context, thread);
                }
            }
        }
        has_begun
    }

    /// The units that a goal works with from now on; `None` where another thread of its routine works with what it needs, or waits for that
    /// since before.
    fn free_units(&self, context: &Context<'_>, thread: u64) -> Option<Vec<String>> {
        let none = || Some(Vec::new());
        let Some(own) = self.threads.get(&thread) else { return none() };
        let (Some(routine), Some(current)) = (own.routine, own.current.as_ref()) else { return none() };
        let Some(lease) = self.routines.get(&routine).and_then(|routine| routine.lease.as_ref()) else { return none() };
        let wanted = &context.plan.state(current.state).works_with;
        let others = self.threads.iter().filter(|(id, other)| **id != thread && other.routine == Some(routine));
        let others: Vec<&Current> = others.filter_map(|(_, other)| other.current.as_ref()).collect();
        let is_before = |other: &&Current| match (&other.phase, &current.phase) {
            (Phase::Queued(turn), Phase::Queued(own)) => turn < own,
            (Phase::Queued(_), _) => true,
            _ => false,
        };
        let is_wanted = |kind: &str| wanted.iter().any(|(other, _)| other == kind);
        let wants_the_same =
            |other: &&Current| context.plan.state(other.state).works_with.iter().any(|(kind, _)| is_wanted(kind));
        if others.iter().copied().filter(is_before).any(|other| wants_the_same(&other)) {
            return None;
        }
        let works = |other: &&&Current| matches!(other.phase, Phase::Projecting | Phase::Running | Phase::Stalled);
        let taken: Vec<&str> = others.iter().filter(works).flat_map(|other| &other.units).map(String::as_str).collect();
        let mut units: Vec<String> = Vec::new();
        for (kind, count) in wanted {
            // Of subclasses only where there is none of the kind itself, as for who performs a goal.
            let is_exact = lease.resources.iter().any(|unit| unit.kind == *kind);
            let fits = |unit: &&LeasedResource| if is_exact { unit.kind == *kind } else { unit.is_a(kind) };
            let of_kind = lease.resources.iter().filter(fits);
            let count = of_kind.clone().count().min(*count);
            let is_free = |id: &str| !taken.contains(&id) && !units.iter().any(|unit| unit == id);
            let free: Vec<String> = of_kind.map(|unit| unit.id.clone()).filter(|id| is_free(id)).take(count).collect();
            if free.len() < count {
                return None;
            }
            units.extend(free);
        }
        Some(units)
    }

    /// The lease under which a goal is given: in a routine without the units that others work with.
    pub(super) fn lease_of(&self, context: &Context<'_>, thread: u64) -> Option<Lease> {
        let current = self.threads.get(&thread)?.current.as_ref()?;
        let Some(routine) = self.routine_of(thread) else { return current.lease.clone() };
        let mut lease = routine.lease.clone()?;
        let kinds = &context.plan.state(current.state).works_with;
        let is_anothers =
            |unit: &LeasedResource| kinds.iter().any(|(kind, _)| unit.is_a(kind)) && !current.units.contains(&unit.id);
        if !current.units.is_empty() {
            lease.resources.retain(|unit| !is_anothers(unit));
        }
        Some(lease)
    }
}
