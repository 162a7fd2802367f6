//! Projections that are named before they are there: a goal leaves at once with an id that the world pool has promised, and its worker waits
//! for the projection where it looks at it at all.
//!
//! So what a node that reads the world waits for is one answer, that of its goal; its projection, and the commit before that, are made
//! meanwhile. Goals that act are not given so: they begin when their projection is there.

use ratn_model::id::ProjectionId;
use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::sync::oneshot;

/// So many ids are kept.
const KEPT: usize = 32;

/// Where more than so many records wait for the world pool, goals wait for their projections: the workers would.
const FEW_BEHIND: usize = 4;

/// The ids that are promised to a run; clones share them.
#[derive(Debug, Clone, Default)]
pub(super) struct Promises(Arc<Mutex<VecDeque<ProjectionId>>>);

impl Promises {
    fn ids(&self) -> MutexGuard<'_, VecDeque<ProjectionId>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// An id for a projection that is to be named at once; `behind` records wait for the world pool.
    pub(super) fn take(&self, behind: usize) -> Option<ProjectionId> {
        if behind > FEW_BEHIND { None } else { self.ids().pop_front() }
    }

    /// So many the next answer is to promise.
    pub(super) fn wanted(&self) -> u32 {
        let left = self.ids().len();
        if left > KEPT / 2 { 0 } else { u32::try_from(KEPT - left).unwrap_or_default() }
    }

    /// What an answer has promised.
    pub(super) fn add(&self, promised: Vec<ProjectionId>) {
        let mut ids = self.ids();
        ids.extend(promised);
        // Answers that crossed have promised more than was wanted: the pool forgets the oldest first, and so does the run.
        let too_many = ids.len().saturating_sub(2 * KEPT);
        ids.drain(..too_many);
    }

    /// The world pool knows of no promise: it was started again.
    pub(super) fn forget(&self) {
        self.ids().clear();
    }
}

/// The projections that goals were given and that may not be there yet.
#[derive(Debug, Default)]
pub(super) struct Making(BTreeMap<ProjectionId, oneshot::Receiver<Made>>);

/// That it is there.
#[derive(Debug)]
pub(super) struct Made;

impl Making {
    /// A projection is named; whoever makes it says so when it is there, and drops this where it never will be.
    pub(super) fn begin(&mut self, projection: ProjectionId) -> oneshot::Sender<Made> {
        let (made, is_made) = oneshot::channel();
        self.0.insert(projection, is_made);
        made
    }

    /// It is to be given back, as soon as it is there: resolves to whether there is something to give back.
    pub(super) fn end(&mut self, projection: ProjectionId) -> impl Future<Output = bool> + Send + use<> {
        let making = self.0.remove(&projection);
        async move {
            match making {
                Some(is_made) => is_made.await.is_ok(),
                None => true,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use futures::FutureExt;

    #[test]
    fn ids_are_asked_for_when_few_are_left_and_used_while_the_pool_keeps_up() {
        let promises = Promises::default();
        assert_eq!((promises.take(0), promises.wanted()), (None, 32));
        promises.add((1..=32).map(ProjectionId).collect());
        assert_eq!((promises.wanted(), promises.take(FEW_BEHIND + 1)), (0, None));
        let taken: Vec<_> = (1..=16).filter_map(|_| promises.take(0)).collect();
        assert_eq!(taken[15], ProjectionId(16));
        assert_eq!(promises.wanted(), 16);
        promises.add((33..=200).map(ProjectionId).collect());
        assert_eq!(promises.take(0), Some(ProjectionId(137)), "not more than twice as many");
        promises.forget();
        assert_eq!(promises.take(0), None);
    }

    #[test]
    fn what_is_not_there_yet_is_given_back_when_it_is() {
        let mut making = Making::default();
        let [made, never] = [ProjectionId(1), ProjectionId(2)].map(|id| making.begin(id));
        let mut first = making.end(ProjectionId(1)).boxed();
        assert_eq!(first.as_mut().now_or_never(), None);
        assert!(made.send(Made).is_ok());
        assert_eq!(first.now_or_never(), Some(true));
        drop(never);
        assert_eq!(making.end(ProjectionId(2)).now_or_never(), Some(false));
        assert_eq!(making.end(ProjectionId(3)).now_or_never(), Some(true), "one that was there before it was named");
    }
}
