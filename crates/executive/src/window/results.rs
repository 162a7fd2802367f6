//! The result cache. The same visit of a state on two branches computes the same once; a result that was discarded serves
//! again when the same is asked for.
//!
//! A result is found by its seed (run, path with visits, and try) and by what it was made of: with equal seeds, inputs and facts
//! the result is the same.

use super::graph::Graph;
use super::graph::instance::Ended;
use super::memory::Seen;
use ratn_model::id::InstanceId;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, VecDeque};

/// This many results are kept.
const MAX_RESULTS: usize = 1024;

/// Results by seed, and who computes what.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct Results {
    kept: BTreeMap<u64, Vec<(Seen, Ended)>>,
    order: VecDeque<u64>,
    /// Speculative instances that compute or have computed, by seed and by id.
    twins: BTreeMap<u64, Vec<InstanceId>>,
    seeds: BTreeMap<InstanceId, u64>,
}

/// What is known of a result that is asked for.
pub(crate) enum Known {
    /// It is there.
    Result(Box<Ended>),
    /// This instance computes it.
    Busy(InstanceId),
}

impl Results {
    /// Whether nothing is kept: then only speculative instances need to ask.
    pub(crate) fn is_empty(&self) -> bool {
        self.order.is_empty()
    }

    /// A result made of the same, or who computes it.
    pub(crate) fn find(&self, graph: &Graph, id: InstanceId, seed: u64, seen: &Seen) -> Option<Known> {
        let same = |other: &Seen| other.is_like(seen);
        let kept = self.kept.get(&seed).and_then(|all| all.iter().find(|(other, _)| same(other)));
        if let Some((_, ended)) = kept {
            return Some(Known::Result(Box::new(ended.clone())));
        }
        let mut busy = None;
        for other in self.twins.get(&seed).into_iter().flatten().filter(|other| **other != id) {
            let Some(other) = graph.get(*other) else { continue };
            if !other.seen().is_some_and(same) {
                continue;
            }
            match other.ended() {
                Some(ended) => return Some(Known::Result(Box::new(ended.clone()))),
                None if other.is_under_way() => busy = Some(Known::Busy(other.id)),
                None => {}
            }
        }
        busy
    }

    /// A speculative instance computes what others may want. Whether it computed something else before.
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

    /// The others that compute what this one does.
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

    /// A result that is about to be discarded is kept.
    pub(crate) fn keep(&mut self, seed: u64, seen: Seen, ended: Ended) {
        self.kept.entry(seed).or_default().push((seen, ended));
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

    /// What is wrong, if anything: only instances in the window are twins.
    pub(crate) fn check_invariants(&self, graph: &Graph) -> Result<(), String> {
        match self.seeds.keys().find(|id| !graph.contains(**id)) {
            Some(gone) => Err(format!("{gone} computes what others may want, and is not in the window")),
            None => Ok(()),
        }
    }
}
