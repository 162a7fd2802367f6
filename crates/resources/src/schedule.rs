//! The grant pass: who in the queue can be served now.
//!
//! Waiters are visited in order. One that can be served is granted; one that cannot, but could be if the holders let go,
//! reserves every free unit it would take: nobody behind it gets those, so it is never overtaken for what it waits for.
//! One that asks for more than exists reserves nothing, or a missing kind would hold up everybody else.

use crate::assignment::{Assignment, Available};
use crate::id::WaiterId;
use crate::pool::Pool;
use crate::queue::Waiter;
use crate::resource::Units;

impl Pool {
    /// Grants whatever can be granted.
    pub(crate) fn schedule(&mut self) {
        let mut reserved = Units::new();
        let order: Vec<WaiterId> = self.queue.iter().map(|(id, _)| id).collect();
        for id in order {
            let Some(waiter) = self.queue.get(id) else { continue };
            if self.leases.len() >= self.limits.leases {
                return;
            }
            let requirements = &waiter.request.requirements;
            let assignment = Assignment::of(&self.resources, Available::Free(&reserved), requirements);
            if assignment.is_complete() {
                self.grant(id, assignment);
            } else if self.satisfiable(waiter) {
                add(&mut reserved, &assignment);
            }
        }
    }

    /// The units that the queue reserves.
    pub(crate) fn reserved(&self) -> Units {
        self.reserved_by(self.queue.iter())
    }

    /// The units that the waiters before `id` reserve.
    pub(crate) fn reserved_before(&self, id: WaiterId) -> Units {
        self.reserved_by(self.queue.iter().take_while(|(other, _)| *other != id))
    }

    fn reserved_by<'a>(&'a self, waiters: impl Iterator<Item = (WaiterId, &'a Waiter)>) -> Units {
        let mut reserved = Units::new();
        for (_, waiter) in waiters.filter(|(_, waiter)| self.satisfiable(waiter)) {
            let requirements = &waiter.request.requirements;
            let assignment = Assignment::of(&self.resources, Available::Free(&reserved), requirements);
            add(&mut reserved, &assignment);
        }
        reserved
    }

    /// Whether what exists would do if nobody held any of it.
    fn satisfiable(&self, waiter: &Waiter) -> bool {
        Assignment::of(&self.resources, Available::Existing, &waiter.request.requirements).is_complete()
    }
}

fn add(reserved: &mut Units, assignment: &Assignment) {
    for (id, units) in assignment.taken.iter().flatten() {
        *reserved.entry(*id).or_default() += *units;
    }
}
