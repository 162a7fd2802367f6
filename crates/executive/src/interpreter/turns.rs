//! Turns within a routine: its lease serves all its threads of control, but each leased unit performs one goal at a time. Goals with the same
//! selector share the units granted for it. A goal that finds too few free units waits, first come first served. Each goal's lease lacks the units
//! of the other goals, so that it is clear which of several equal units it uses.
//!
//! Outside of a routine every goal has its own lease, and the resource manager decides the turns.

use super::{Current, Interpreter, Phase};
use crate::context::Context;
use ratn_model::program::ResourceExpr;
use ratn_model::resource::{Lease, LeasedResource, Requirement, ResourceOperation};
use std::collections::BTreeSet;

impl Interpreter {
    /// Whether a goal has to wait for units that other threads of its routine use.
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

    /// Begins the queued goals whose turn it is; true if any began.
    pub(crate) fn take_turns(&mut self, context: &mut Context<'_>) -> bool {
        let is_queued = |thread: &u64| matches!(self.phase(*thread), Some(Phase::Queued(_)));
        let queued = self.threads.keys().copied().filter(is_queued);
        let mut has_begun = false;
        for thread in queued.collect::<Vec<_>>() {
            // Nothing begins while the routine acquires a new lease.
            let waits = self.routine_of(thread).is_some_and(|r| r.lease.is_none() && !r.requirements.is_empty());
            if !waits && self.free_units(context, thread).is_some() {
                has_begun = true;
                // Its preconditions may have become false while it waited.
                if self.may_try(context, thread) {
                    self.project_or_run(context, thread);
                }
            }
        }
        has_begun
    }

    /// The units that a goal may use now, as far as their ids are known; `None` if other goals of its routine use them, or are ahead of it in the
    /// queue.
    fn free_units(&self, context: &Context<'_>, thread: u64) -> Option<Vec<String>> {
        let none = || Some(Vec::new());
        let Some(own) = self.threads.get(&thread) else { return none() };
        let (Some(routine), Some(current)) = (own.routine, own.current.as_ref()) else { return none() };
        let Some(routine) = self.routines.get(&routine) else { return none() };
        let Some(lease) = &routine.lease else { return none() };
        let others = self.others(thread);
        let wanted = |other: &Current, line: &ResourceExpr| {
            let lines = context.plan.state(other.state).works_with.iter();
            lines.filter(|other| other.selects_the_same(line)).map(units_of).sum::<usize>()
        };
        let is_before = |other: &Current| match (other.phase, current.phase) {
            (Phase::Queued(turn), Phase::Queued(own)) => turn < own,
            (Phase::Queued(_), _) => true,
            _ => false,
        };
        let mut units = Vec::new();
        for line in &context.plan.state(current.state).works_with {
            let there = Granted::of(&routine.requirements, lease, line);
            let needs = units_of(line).min(there.count);
            let of_others = others.iter().map(|other| (*other, wanted(other, line))).filter(|(_, wanted)| *wanted > 0);
            let works = of_others.clone().filter(|(other, _)| other.works());
            let taken: usize = works.map(|(_, wanted)| wanted.min(there.count)).sum();
            if taken + needs > there.count || of_others.clone().any(|(other, _)| is_before(other)) {
                return None;
            }
            let is_free =
                |unit: &&str| !others.iter().any(|other| other.works() && other.units.iter().any(|u| u == unit));
            units.extend(there.units.iter().copied().filter(is_free).take(needs).map(str::to_owned));
        }
        Some(units)
    }

    /// The current actions of the other threads of its routine.
    fn others(&self, thread: u64) -> Vec<&Current> {
        let routine = self.threads.get(&thread).and_then(|thread| thread.routine);
        let others = self.threads.iter().filter(|(id, other)| **id != thread && other.routine == routine);
        others.filter_map(|(_, other)| other.current.as_ref()).collect()
    }

    /// The lease for a goal; inside of a routine without the units that other goals use.
    pub(super) fn lease_of(&self, thread: u64) -> Option<Lease> {
        let current = self.threads.get(&thread)?.current.as_ref()?;
        let Some(routine) = self.routine_of(thread) else { return current.lease.clone() };
        let mut lease = routine.lease.clone()?;
        let others = self.others(thread);
        let of_others = |unit: &LeasedResource| {
            let works_with = |other: &&Current| other.works() && other.units.contains(&unit.id);
            others.iter().any(works_with) && !current.units.contains(&unit.id)
        };
        lease.resources.retain(|unit| !of_others(unit));
        Some(lease)
    }
}

impl Current {
    /// Whether its goal is under way, or its dead worker has not been replaced yet (also during backoff).
    fn works(&self) -> bool {
        self.lost_its_worker() || matches!(self.phase, Phase::Projecting | Phase::Running | Phase::Stalled)
    }

    /// Whether it is in backoff and its unit is still the one whose worker died, because the routine has no new lease since.
    pub(super) fn lost_its_worker(&self) -> bool {
        self.has_died && matches!(self.phase, Phase::Backoff(_))
    }
}

fn units_of(line: &ResourceExpr) -> usize {
    line.count.units() as usize
}

/// How many of the wanted units the routine has.
struct Granted<'a> {
    count: usize,
    /// Their ids, if no other unit of the lease can be meant.
    units: Vec<&'a str>,
}

impl Granted<'_> {
    fn of<'a>(requirements: &[Requirement], lease: &'a Lease, line: &ResourceExpr) -> Granted<'a> {
        // No goal uses what is not in the lease.
        if !lease.resources.iter().any(|unit| unit.is_a(&line.kind)) {
            return Granted { count: usize::MAX, units: Vec::new() };
        }
        // A line with attributes or conditions has units of its own; their ids are not known here.
        let unknown = || Granted { count: units_of(line), units: Vec::new() };
        if !line.attributes.is_empty() || !line.conditions.is_empty() {
            return unknown();
        }
        let blocks = || requirements.iter().filter(|one| one.operation == ResourceOperation::Block);
        let is_plain =
            |one: &&Requirement| one.kind == line.kind && one.attributes.is_empty() && one.conditions.is_empty();
        let Some(granted) = blocks().find(is_plain) else { return unknown() };
        let count = granted.count.units() as usize;
        let units: Vec<&LeasedResource> = lease.resources.iter().filter(|unit| unit.is_a(&line.kind)).collect();
        let may_be_anothers = |other: &Requirement| units.iter().any(|unit| unit.is_a(&other.kind));
        let ids: BTreeSet<&str> = units.iter().map(|unit| unit.id.as_str()).collect();
        let is_clear = ids.len() == count
            && units.len() == count
            && !blocks().any(|one| !std::ptr::eq(one, granted) && may_be_anothers(one));
        let units = if is_clear { units.into_iter().map(|unit| unit.id.as_str()).collect() } else { Vec::new() };
        Granted { count, units }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::expression::Expr;
    use ratn_model::id::{FencingToken, LeaseId};

    fn line(kind: &str) -> ResourceExpr {
        ResourceExpr::new(ResourceOperation::Block, kind)
    }

    fn block(kind: &str, count: u32) -> Requirement {
        Requirement { count: count.into(), ..Requirement::new(ResourceOperation::Block, kind) }
    }

    /// Units by id and kind; a vacuum gripper is a gripper.
    fn lease(units: &[(&str, &str)]) -> Lease {
        let unit = |(id, kind): &(&str, &str)| LeasedResource {
            id: (*id).to_owned(),
            kind: (*kind).to_owned(),
            endpoint: String::new(),
            superclasses: Vec::from_iter((*kind == "VacuumGripper").then(|| "Gripper".to_owned())),
        };
        Lease {
            id: LeaseId(1),
            token: FencingToken(1),
            resources: units.iter().map(unit).collect(),
            consumed: Vec::new(),
        }
    }

    #[test]
    fn units_that_are_alike_are_told_apart() {
        let lease = lease(&[("p1", "Planner"), ("p2", "Planner"), ("arm", "Arm")]);
        let granted = Granted::of(&[block("Planner", 2), block("Arm", 1)], &lease, &line("Planner"));
        assert_eq!((granted.count, granted.units), (2, vec!["p1", "p2"]));
        assert_eq!(Granted::of(&[], &lease, &line("Head")).count, usize::MAX, "nobody shares what is not there");
    }

    #[test]
    fn which_of_two_arms_is_meant_by_their_attributes_is_not_guessed() {
        let lease = lease(&[("left", "Arm"), ("right", "Arm")]);
        let of = |side: &str| {
            let attributes = [("arm".to_owned(), ratn_model::value::Value::String(side.to_owned()))].into();
            Requirement { attributes, ..block("Arm", 1) }
        };
        let right = Expr::Literal(ratn_model::value::Value::String("right".to_owned()));
        let right = ResourceExpr { attributes: vec![("arm".to_owned(), right)], ..line("Arm") };
        let granted = Granted::of(&[of("left"), of("right")], &lease, &right);
        assert_eq!((granted.count, granted.units.len()), (1, 0));
        // One of two lines of its kind: the lease stays whole.
        let granted = Granted::of(&[block("Arm", 1), of("right")], &lease, &line("Arm"));
        assert_eq!((granted.count, granted.units.len()), (1, 0));
    }

    #[test]
    fn what_may_be_anothers_and_one_resource_for_several_is_left_in_the_lease() {
        let both = [block("Gripper", 1), block("VacuumGripper", 1)];
        let grippers = lease(&[("v1", "VacuumGripper"), ("p1", "Gripper")]);
        for kind in ["Gripper", "VacuumGripper"] {
            let granted = Granted::of(&both, &grippers, &line(kind));
            assert_eq!((granted.count, granted.units.len()), (1, 0), "{kind}");
        }
        let twice = lease(&[("camera", "Camera"), ("camera", "Camera")]);
        let granted = Granted::of(&[block("Camera", 2)], &twice, &line("Camera"));
        assert_eq!((granted.count, granted.units.len()), (2, 0));
    }
}
