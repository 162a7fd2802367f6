//! Ids of projections that were promised to a caller, who can pass them on before the projections exist.
//!
//! Nobody else can make a projection with such an id. A promise ends after a while. Bounded: a caller with too many loses its oldest, and
//! where all callers together have too many nothing more is promised.

use ratn_model::id::ProjectionId;
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

/// Maximum number of ids promised in one answer.
pub(super) const MOST_AT_ONCE: u32 = 64;
/// Maximum number of unused ids of a caller; several runs may belong to one caller.
const MOST_PER_CALLER: usize = 16_384;
/// Maximum number of unused ids of all callers together.
const MOST: usize = 65_536;

/// How long a promise is kept.
const KEPT: Duration = Duration::from_secs(30);

/// See the module.
#[derive(Debug, Default)]
pub(super) struct Promised {
    /// The caller of each id, and when the promise ends.
    to: BTreeMap<ProjectionId, (Arc<str>, Timestamp)>,
    of: BTreeMap<Arc<str>, BTreeSet<ProjectionId>>,
}

impl Promised {
    /// Number of ids that can be promised now, at most `wanted`.
    pub(super) fn room(&self, wanted: u32) -> u32 {
        let left = u32::try_from(MOST - self.to.len()).unwrap_or(u32::MAX);
        wanted.min(MOST_AT_ONCE).min(left)
    }

    /// Promises an id that no projection has.
    pub(super) fn promise(&mut self, now: Timestamp, caller: &Arc<str>, id: ProjectionId) {
        self.to.insert(id, (caller.clone(), now + KEPT));
        let own = self.of.entry(caller.clone()).or_default();
        own.insert(id);
        if own.len() > MOST_PER_CALLER
            && let Some(oldest) = own.pop_first()
        {
            self.to.remove(&oldest);
        }
    }

    /// Whether the id is promised and no projection has it yet.
    pub(super) fn has(&self, id: ProjectionId) -> bool {
        self.to.contains_key(&id)
    }

    /// The caller to whom the id was promised.
    pub(super) fn whose(&self, id: ProjectionId) -> Option<&Arc<str>> {
        self.to.get(&id).map(|(caller, _)| caller)
    }

    /// Ends the promises that were kept long enough. Ids grow, so the first is the oldest.
    pub(super) fn expire(&mut self, now: Timestamp) {
        while let Some((id, (_, until))) = self.to.first_key_value()
            && *until <= now
        {
            self.end(*id);
        }
    }

    /// Ends the promise: the id is used or taken back.
    pub(super) fn end(&mut self, id: ProjectionId) {
        if let Some((caller, _)) = self.to.remove(&id)
            && let Some(own) = self.of.get_mut(&caller)
        {
            own.remove(&id);
            if own.is_empty() {
                self.of.remove(&caller);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_oldest_of_a_caller_are_forgotten_and_others_keep_theirs() {
        let (mut promised, [adam, eve]) = (Promised::default(), [Arc::<str>::from("adam"), Arc::from("eve")]);
        let now = Timestamp(5);
        promised.promise(now, &eve, ProjectionId(1));
        for id in 0..MOST_PER_CALLER as u64 {
            promised.promise(now, &adam, ProjectionId(10 + id));
        }
        assert!(promised.has(ProjectionId(10)));
        promised.promise(now, &adam, ProjectionId(99_999));
        assert!(!promised.has(ProjectionId(10)) && promised.has(ProjectionId(11)));
        assert_eq!(promised.whose(ProjectionId(1)), Some(&eve));
        promised.end(ProjectionId(1));
        assert!(!promised.has(ProjectionId(1)) && promised.whose(ProjectionId(11)) == Some(&adam));
    }

    #[test]
    fn not_more_is_promised_than_there_is_room_for() {
        let mut promised = Promised::default();
        assert_eq!(promised.room(1_000), MOST_AT_ONCE);
        for id in 0..MOST as u64 - 3 {
            promised.promise(Timestamp(id), &Arc::from(format!("{}", id % 100)), ProjectionId(id));
        }
        assert_eq!((promised.room(64), promised.room(2)), (3, 2));
        promised.expire(Timestamp(9) + KEPT);
        assert!(!promised.has(ProjectionId(9)) && promised.has(ProjectionId(10)), "each ends in its time");
        assert_eq!(promised.room(64), 13);
    }
}
