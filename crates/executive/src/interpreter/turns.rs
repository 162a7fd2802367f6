//! Turns within a routine: its lease serves all threads of control in it, and a unit of it performs one goal at a time. A goal whose units
//! another thread works with waits until these are free; who waits first is first.
//!
//! Outside of a routine every goal has a lease of its own, so that the resource manager sees to the turns.

use super::{Current, Interpreter, Phase};
use crate::context::Context;

impl Interpreter {
    /// Whether a goal waits for units that another thread of its routine works with.
    pub(super) fn waits_its_turn(&mut self, context: &Context<'_>, thread: u64) -> bool {
        let waits = !self.is_its_turn(context, thread);
        if waits && !matches!(self.phase(thread), Some(Phase::Queued(_))) {
            self.last_turn += 1;
            self.set_phase(thread, Phase::Queued(self.last_turn));
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
            if !waits && self.is_its_turn(context, thread) {
                has_begun = true;
                // What it requires may have been changed while it waited.
                if self.may_try(context, thread) {
                    self.project_or_run(context, thread);
                }
            }
        }
        has_begun
    }

    fn is_its_turn(&self, context: &Context<'_>, thread: u64) -> bool {
        let Some(own) = self.threads.get(&thread) else { return true };
        let (Some(routine), Some(current)) = (own.routine, own.current.as_ref()) else { return true };
        let units = self.units(context, routine, current);
        if units.is_empty() {
            return true;
        }
        let is_before = |other: &Current| {
            let has = match other.phase {
                Phase::Projecting | Phase::Running => true,
                // What its worker was is still to be replaced.
                Phase::Stalled => true,
                Phase::Queued(turn) => match current.phase {
                    Phase::Queued(own) => turn < own,
                    _ => true,
                },
                Phase::Held | Phase::Backoff(_) | Phase::Acquiring => false,
            };
            has && self.units(context, routine, other).iter().any(|unit| units.contains(unit))
        };
        let mut others = self.threads.iter().filter(|(id, other)| **id != thread && other.routine == Some(routine));
        !others.any(|(_, other)| other.current.as_ref().is_some_and(is_before))
    }

    /// The units of the routine's lease that a goal works with.
    fn units<'a>(&'a self, context: &Context<'_>, routine: u64, current: &Current) -> Vec<&'a str> {
        let Some(lease) = self.routines.get(&routine).and_then(|routine| routine.lease.as_ref()) else {
            return Vec::new();
        };
        let kinds = context.plan.state(current.state).works_with.iter();
        kinds.filter_map(|kind| Some(lease.resource(kind)?.id.as_str())).collect()
    }
}
