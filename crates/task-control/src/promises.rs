//! Projections that are used before they exist: a goal is sent immediately with an id that the world pool has promised, and its worker waits for the
//! projection only when it reads it.
//!
//! So a node that reads the world waits for one answer only, that of its goal; its projection, and the commit before that, are made in the meantime.
//! Goals that act are not sent this way: they begin when their projection exists.

use ratn_model::id::ProjectionId;
use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::oneshot;
use tokio::sync::oneshot::error::TryRecvError;

/// Number of promised ids to keep.
const KEPT: usize = 32;

/// How long a promised id is used; the world pool keeps its promises three times as long.
const FRESH: Duration = Duration::from_secs(10);

/// If more records than this wait for the world pool, goals wait for their projections, because their workers would have to. A node has two records,
/// a projection and a commit. Commits that wait for the same disk sync cost one call each and no more, so a sync that takes some milliseconds delays
/// nobody, and what follows is made long before the pool's time limit for waiting calls (one second).
const FEW_BEHIND: usize = 16;

/// The ids that were promised to a run; clones share them.
#[derive(Debug, Clone, Default)]
pub(super) struct Promises(Arc<Mutex<VecDeque<Promise>>>);

#[derive(Debug, Clone, Copy)]
struct Promise {
    id: ProjectionId,
    since: Instant,
}

impl Promises {
    fn fresh(&self, now: Instant) -> MutexGuard<'_, VecDeque<Promise>> {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        while all.pop_front_if(|oldest| now.duration_since(oldest.since) >= FRESH).is_some() {}
        all
    }

    /// Takes a promised id for a projection, if at most `FEW_BEHIND` records wait for the world pool; `behind` is their number.
    pub(super) fn take(&self, behind: usize, now: Instant) -> Option<ProjectionId> {
        if behind > FEW_BEHIND { None } else { self.fresh(now).pop_front().map(|promise| promise.id) }
    }

    /// The number of ids that the next answer should promise.
    pub(super) fn wanted(&self, now: Instant) -> u32 {
        let left = self.fresh(now).len();
        if left > KEPT / 2 { 0 } else { u32::try_from(KEPT - left).unwrap_or_default() }
    }

    /// Adds the promised ids of an answer.
    pub(super) fn add(&self, promised: Vec<ProjectionId>, now: Instant) {
        let mut ids = self.fresh(now);
        ids.extend(promised.into_iter().map(|id| Promise { id, since: now }));
        // Concurrent requests may have promised more than wanted: the pool forgets the oldest first, and so does the run.
        let too_many = ids.len().saturating_sub(2 * KEPT);
        ids.drain(..too_many);
    }

    /// Forgets all promises: the world pool was restarted and does not know them.
    pub(super) fn forget(&self) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clear();
    }
}

/// The projections that were given to goals and may not exist yet.
#[derive(Debug, Default)]
pub(super) struct Making(BTreeMap<ProjectionId, oneshot::Receiver<Made>>);

/// Message: the projection exists.
#[derive(Debug)]
pub(super) struct Made;

impl Making {
    /// Registers a promised projection; its maker sends [`Made`] when it exists, and drops the sender if it never will.
    pub(super) fn begin(&mut self, projection: ProjectionId) -> oneshot::Sender<Made> {
        let (made, is_made) = oneshot::channel();
        self.0.insert(projection, is_made);
        made
    }

    /// The projection is to be released: at once if this returns `None`, else when the receiver resolves. An error there means that it never will exist.
    pub(super) fn end(&mut self, projection: ProjectionId) -> Option<oneshot::Receiver<Made>> {
        let mut making = self.0.remove(&projection)?;
        matches!(making.try_recv(), Err(TryRecvError::Empty)).then_some(making)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_are_asked_for_when_few_are_left_and_used_while_the_pool_keeps_up() {
        let (promises, now) = (Promises::default(), Instant::now());
        assert_eq!((promises.take(0, now), promises.wanted(now)), (None, 32));
        promises.add((1..=32).map(ProjectionId).collect(), now);
        assert_eq!((promises.wanted(now), promises.take(FEW_BEHIND + 1, now)), (0, None));
        let taken: Vec<_> = (1..=16).filter_map(|_| promises.take(0, now)).collect();
        assert_eq!(taken[15], ProjectionId(16));
        assert_eq!(promises.wanted(now), 16);
        promises.add((33..=200).map(ProjectionId).collect(), now);
        assert_eq!(promises.take(0, now), Some(ProjectionId(137)), "not more than twice as many");
        assert_eq!((promises.wanted(now + FRESH), promises.take(0, now + FRESH)), (32, None), "they are too old");
        promises.add(vec![ProjectionId(300)], now);
        promises.forget();
        assert_eq!(promises.take(0, now), None);
    }

    #[test]
    fn what_is_not_there_yet_is_given_back_when_it_is() {
        let mut making = Making::default();
        let [made, never] = [ProjectionId(1), ProjectionId(2)].map(|id| making.begin(id));
        let mut first = making.end(ProjectionId(1)).expect("it is not there yet");
        assert!(made.send(Made).is_ok());
        assert!(first.try_recv().is_ok());
        let mut second = making.end(ProjectionId(2)).expect("it is not there yet");
        drop(never);
        assert!(second.try_recv().is_err());
        assert!(making.end(ProjectionId(3)).is_none(), "one that was there before it was named");
        let made = making.begin(ProjectionId(4));
        assert!(made.send(Made).is_ok());
        assert!(making.end(ProjectionId(4)).is_none(), "it is there by now");
    }
}
