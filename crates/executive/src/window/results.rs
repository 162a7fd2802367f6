//! The result cache. The same visit of a state on two branches is computed once; a discarded result is used again when the same
//! computation is asked for.
//!
//! The key of a result is its seed (run, path with visits, and try) and its inputs: with equal seed, input ports and facts the
//! result is the same. A result is what the goal answered. What happens to an instance before its goal begins (its resources are refused), after
//! its goal has ended (a value that it assigns cannot be evaluated), or instead of an answer (a timeout, a dead worker) is its own.

use super::graph::Graph;
use super::graph::instance::Ended;
use super::memory::Seen;
use ratn_model::id::InstanceId;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, VecDeque};

/// Limit of kept results.
const MAX_RESULTS: usize = 1024;

/// Results by seed, and the instances that compute them.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct Results {
    kept: BTreeMap<u64, Vec<(Seen, Box<Ended>)>>,
    order: VecDeque<u64>,
    /// Speculative instances that compute or have computed a result, by seed and by id.
    twins: BTreeMap<u64, Vec<InstanceId>>,
    seeds: BTreeMap<InstanceId, u64>,
}

/// What the cache knows about a requested result.
pub(crate) enum Known {
    /// The result.
    Result(Box<Ended>),
    /// This instance computes it.
    Busy(InstanceId),
}

impl Results {
    /// Whether no result is kept; then only speculative instances need to ask.
    pub(crate) fn is_empty(&self) -> bool {
        self.order.is_empty()
    }

    /// A result with the same inputs, or the instance that computes it.
    pub(crate) fn find(&self, graph: &Graph, id: InstanceId, seed: u64, seen: &Seen) -> Option<Known> {
        let same = |other: &Seen| other.is_like(seen);
        let kept = self.kept.get(&seed).and_then(|all| all.iter().find(|(other, _)| same(other)));
        if let Some((_, answer)) = kept {
            return Some(Known::Result(answer.clone()));
        }
        let mut busy = None;
        for other in self.twins.get(&seed).into_iter().flatten().filter(|other| **other != id) {
            let Some(other) = graph.get(*other) else { continue };
            if !other.seen().is_some_and(same) {
                continue;
            }
            match other.node().and_then(|node| node.answer.as_ref()) {
                Some(answer) => return Some(Known::Result(answer.clone())),
                None if other.is_under_way() => busy = Some(Known::Busy(other.id)),
                None => {}
            }
        }
        busy
    }

    /// Notes a speculative instance whose result others may use; true if it was noted with another seed before.
    pub(crate) fn note_twin(&mut self, id: InstanceId, seed: u64) -> bool {
        let before = self.seeds.insert(id, seed).filter(|before| *before != seed);
        if let Some(before) = before {
            self.remove_twin(id, before);
        }
        let twins = self.twins.entry(seed).or_default();
        if !twins.contains(&id) {
            twins.push(id);
        }
        before.is_some()
    }

    /// The other instances with the same computation.
    pub(crate) fn twins_of(&self, id: InstanceId) -> Vec<InstanceId> {
        let twins = self.seeds.get(&id).and_then(|seed| self.twins.get(seed));
        twins.into_iter().flatten().copied().filter(|other| *other != id).collect()
    }

    /// An instance has left the window.
    pub(crate) fn forget(&mut self, id: InstanceId) {
        if let Some(seed) = self.seeds.remove(&id) {
            self.remove_twin(id, seed);
        }
    }

    fn remove_twin(&mut self, id: InstanceId, seed: u64) {
        if let Some(twins) = self.twins.get_mut(&seed) {
            twins.retain(|other| *other != id);
            if twins.is_empty() {
                self.twins.remove(&seed);
            }
        }
    }

    /// Keeps a result that is about to be discarded.
    pub(crate) fn keep(&mut self, seed: u64, seen: Seen, answer: Box<Ended>) {
        self.kept.entry(seed).or_default().push((seen, answer));
        self.order.push_back(seed);
        if self.order.len() > MAX_RESULTS
            && let Some(oldest) = self.order.pop_front()
            && let Some(results) = self.kept.get_mut(&oldest)
        {
            results.remove(0);
            if results.is_empty() {
                self.kept.remove(&oldest);
            }
        }
    }

    /// Checks that only instances in the window are twins.
    pub(crate) fn check_invariants(&self, graph: &Graph) -> Result<(), String> {
        match self.seeds.keys().find(|id| !graph.contains(**id)) {
            Some(gone) => Err(format!("{gone} computes what others may want, and is not in the window")),
            None => Ok(()),
        }
    }
}
