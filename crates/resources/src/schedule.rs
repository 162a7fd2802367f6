//! The grant pass: who in the queue can be served now.
//!
//! Waiters are visited in order. One that can be served is granted; one that cannot, but could be if the holders let go,
//! reserves every free unit it would take: nobody behind it gets those, so it is never overtaken for what it waits for.
//! One that asks for more than exists reserves nothing, or a missing kind would hold up everybody else.

use crate::assignment::{Assignment, Available, Units};
use crate::event::{Change, Notice};
use crate::expiry::Timer;
use crate::id::WaiterId;
use crate::lease::LeaseRecord;
use crate::pool::Pool;
use crate::queue::Waiter;
use ratn_model::id::{FencingToken, LeaseId};
use ratn_model::resource::{Lease, ResourceOperation};
use std::collections::BTreeSet;

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

    fn grant(&mut self, id: WaiterId, assignment: Assignment) {
        let Some(waiter) = self.queue.remove(id) else { return };
        let session = waiter.request.session;
        self.next_lease += 1;
        self.last_token += 1;
        let (lease_id, token) = (LeaseId(self.next_lease), FencingToken(self.last_token));
        let mut leased = Vec::new();
        let mut held: BTreeSet<String> = BTreeSet::new();
        for (requirement, taken) in waiter.request.requirements.iter().zip(assignment.taken) {
            if requirement.operation == ResourceOperation::Consume {
                self.take_consumed(&session, taken);
                continue;
            }
            for (resource_id, units) in taken {
                let Some(resource) = self.resources.get_mut(&resource_id) else { continue };
                *resource.holders.entry(lease_id).or_insert(0) += units;
                let one = resource.leased(&resource_id);
                leased.extend(std::iter::repeat_n(one, units as usize));
                held.insert(resource_id);
            }
        }
        if let Some(deadline) = waiter.request.deadline {
            self.timers.remove(&(deadline, Timer::Waiter(id)));
        }
        let expires = waiter.request.hold_for.map(|hold_for| self.now + hold_for);
        if let Some(expires) = expires {
            self.timers.insert((expires, Timer::Lease(lease_id)));
        }
        let resources: Vec<String> = held.into_iter().collect();
        self.leases.insert(
            lease_id,
            LeaseRecord {
                token,
                session: session.clone(),
                resources: resources.clone(),
                expires,
                purpose: waiter.request.purpose,
            },
        );
        if let Some(session) = self.sessions.get_mut(&session) {
            session.waiters.remove(&id);
            session.leases.insert(lease_id);
        }
        let resources = resources.iter().filter_map(|id| self.get(id)).collect();
        let lease = Lease { id: lease_id, token, resources: leased };
        self.memory.granted(&waiter.request_id, lease.clone());
        self.publish(Change::LeaseGranted { lease: lease_id, token, session, resources });
        self.notices.push(Notice::Granted { waiter: id, lease });
    }
}

fn add(reserved: &mut Units, assignment: &Assignment) {
    for (id, units) in assignment.taken.iter().flatten() {
        *reserved.entry(id.clone()).or_insert(0) += units;
    }
}
