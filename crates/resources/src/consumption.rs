//! Consume, and the end of a task, which gives back what is renewable.

use crate::assignment::{Assignment, Available};
use crate::error::PoolError;
use crate::id::SessionId;
use crate::pool::Pool;
use crate::record::Effect;
use crate::resource::Units;
use ratn_model::resource::{Requirement, ResourceOperation};
use ratn_model::time::Timestamp;

/// Resources of which something returns in one turn.
const RETURNED_AT_ONCE: usize = 2_000;

impl Pool {
    /// Uses something up for the rest of the session's task, now or not at all; what waiters have reserved is not taken.
    /// Returns the ids of the resources consumed from.
    ///
    /// # Errors
    /// An unknown session, another operation than consume, or too little to consume.
    pub fn consume(
        &mut self,
        now: Timestamp,
        session: &SessionId,
        requirement: &Requirement,
    ) -> Result<Vec<String>, PoolError> {
        self.begin(now);
        self.session(session)?;
        self.check_requirements(std::slice::from_ref(requirement), &[ResourceOperation::Consume])?;
        let assignment = Assignment::of(&self.resources, Available::Free(&self.queue.reserved), &[requirement]);
        if !assignment.is_complete() {
            let missing = assignment.missing.into_iter().sum();
            let found = requirement.count.saturating_sub(missing);
            return Err(PoolError::NotEnough { wanted: requirement.to_string(), found });
        }
        let taken: Units = assignment.taken.into_iter().flatten().collect();
        let ids = taken.keys().filter_map(|slot| self.id_of(*slot)).collect();
        self.commit_consumed(session, taken);
        self.schedule();
        Ok(ids)
    }

    /// The session's task is over: what it consumed of renewable resources returns. Where it is of many, some of it returns: as long as
    /// the answer is false, call this again.
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
