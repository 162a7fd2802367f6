//! Consume, and the end of a task, which returns renewable units.

use crate::assignment::{Assignment, Available};
use crate::error::PoolError;
use crate::id::{SessionId, Slot};
use crate::pool::Pool;
use crate::record::Effect;
use crate::resource::Units;
use ratn_model::resource::{OperatedUnits, Quantity, Requirement, ResourceOperation};
use ratn_model::time::Timestamp;

/// Maximum number of resources that get units back in one turn.
const RETURNED_AT_ONCE: usize = 2_000;

impl Pool {
    /// Consumes units for the rest of the session's task, now or not at all; units that waiters have reserved are not taken. Returns the ids of the
    /// resources from which they were taken.
    ///
    /// # Errors
    /// An unknown session, an operation other than consume, or too little to consume.
    pub fn consume(
        &mut self,
        now: Timestamp,
        session: &SessionId,
        requirement: &Requirement,
    ) -> Result<Vec<String>, PoolError> {
        let consumed = self.consume_units(now, session, requirement, None)?;
        Ok(consumed.into_iter().map(|one| one.resource).collect())
    }

    /// As [`Pool::consume`], from one resource only.
    ///
    /// # Errors
    /// As there, and an unknown resource.
    pub fn consume_of(
        &mut self,
        now: Timestamp,
        session: &SessionId,
        requirement: &Requirement,
        resource: &str,
    ) -> Result<Vec<OperatedUnits>, PoolError> {
        self.consume_units(now, session, requirement, Some(resource))
    }

    pub(crate) fn consume_units(
        &mut self,
        now: Timestamp,
        session: &SessionId,
        requirement: &Requirement,
        resource: Option<&str>,
    ) -> Result<Vec<OperatedUnits>, PoolError> {
        self.begin(now);
        self.session(session)?;
        self.check_requirements(std::slice::from_ref(requirement), &[ResourceOperation::Consume])?;
        let available = Available::Free(&self.queue.reserved);
        let assignment = match resource {
            None => Assignment::of(&self.resources, available, &[requirement]),
            Some(id) => {
                let unknown = || PoolError::UnknownResource { id: id.to_owned() };
                let slot = self.resources.find(id).ok_or_else(unknown)?;
                Assignment::of_one(&self.resources, available, requirement, slot)
            }
        };
        if !assignment.is_complete() {
            let missing = assignment.missing.into_iter().sum();
            let found = requirement.count.saturating_sub(missing);
            return Err(PoolError::NotEnough { wanted: requirement.to_string(), found });
        }
        let taken: Units = assignment.taken.into_iter().flatten().collect();
        let consumed = taken.iter().filter_map(|(slot, amount)| self.consumed_units(session, *slot, *amount)).collect();
        self.commit_consumed(session, taken);
        self.schedule();
        Ok(consumed)
    }

    /// Units of a resource that a session has consumed: they return with the end of the session if the resource is renewable, and vanish then if the
    /// session owns it.
    pub(crate) fn consumed_units(&self, session: &SessionId, slot: Slot, units: Quantity) -> Option<OperatedUnits> {
        let known = self.resources.get(slot)?;
        let ends_with_session = known.description.renewable || known.owner.as_ref() == Some(session);
        let (resource, kind) = (known.description.id.clone(), known.description.kind.clone());
        Some(OperatedUnits { resource, kind, units, ends_with_session })
    }

    /// The session's task is over: what it consumed of renewable resources returns. If it consumed from many resources, only some of it returns: call
    /// this again as long as the answer is false.
    ///
    /// # Errors
    /// An unknown or expired session.
    pub fn end_task(&mut self, now: Timestamp, session: &SessionId) -> Result<bool, PoolError> {
        self.begin(now);
        let consumed = self.session(session)?.consumed.len();
        if consumed == 0 {
            return Ok(true);
        }
        let session = session.clone();
        let all = consumed <= RETURNED_AT_ONCE;
        self.commit(match all {
            true => Effect::TaskEnded { session },
            false => Effect::SomeReturned { session, resources: RETURNED_AT_ONCE },
        });
        self.schedule();
        Ok(all)
    }

    pub(crate) fn commit_consumed(&mut self, session: &SessionId, taken: Units) {
        for (slot, amount) in taken {
            self.commit(Effect::Consumed { session: session.clone(), slot, amount });
        }
    }
}
