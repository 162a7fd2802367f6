//! What whoever gives a resource back leaves to be told to its next holder. It is for a while, and in memory only: whoever starts anew knows
//! of nothing.

use ratn_model::id::LeaseId;
use ratn_model::resource::Lease;
use std::collections::{BTreeSet, HashMap};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// What was left longer ago is not told: it is about what is on its way.
const LIFE: Duration = Duration::from_secs(2);
/// Of more leases or resources nothing is kept.
const MOST: usize = 65_536;

/// The notes; clones share them.
#[derive(Debug, Clone, Default)]
pub(super) struct Notes(Arc<Mutex<Kept>>);

#[derive(Debug, Default)]
struct Kept {
    /// The resources of leases that were granted.
    held: HashMap<LeaseId, Vec<String>>,
    /// By resource.
    notes: HashMap<String, (Arc<str>, Instant)>,
}

impl Notes {
    /// A lease was granted: what is to be told of its resources, each note once.
    pub(super) fn of(&self, lease: &Lease, now: Instant) -> Vec<String> {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let resources: Vec<String> = lease.resources.iter().map(|resource| resource.id.clone()).collect();
        let left = resources.iter().filter_map(|id| kept.notes.get(id));
        let fresh = left.filter(|(_, since)| now.saturating_duration_since(*since) < LIFE);
        let notes: BTreeSet<String> = fresh.map(|(note, _)| note.to_string()).collect();
        // Leases that end by themselves are never given back.
        if kept.held.len() >= MOST {
            kept.held.clear();
        }
        kept.held.insert(lease.id, resources);
        notes.into_iter().collect()
    }

    /// A lease is to be given back with this note; the resources of which it is.
    pub(super) fn left(&self, lease: LeaseId, note: String, now: Instant) -> Vec<String> {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let resources = kept.held.remove(&lease).unwrap_or_default();
        if kept.notes.len() >= MOST {
            kept.notes.clear();
        }
        let note: Arc<str> = note.into();
        for resource in &resources {
            match note.is_empty() {
                true => drop(kept.notes.remove(resource)),
                false => drop(kept.notes.insert(resource.clone(), (Arc::clone(&note), now))),
            }
        }
        resources
    }

    /// It was not given back after all: not by whoever asked for that.
    pub(super) fn take_back(&self, lease: LeaseId, resources: Vec<String>) {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        resources.iter().for_each(|resource| drop(kept.notes.remove(resource)));
        if !resources.is_empty() {
            kept.held.insert(lease, resources);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::id::FencingToken;
    use ratn_model::resource::LeasedResource;

    fn lease(id: u64, resources: &[&str]) -> Lease {
        let resource = |id: &&str| LeasedResource {
            id: (*id).to_owned(),
            kind: "Arm".to_owned(),
            endpoint: String::new(),
            superclasses: Vec::new(),
        };
        Lease { id: LeaseId(id), token: FencingToken(id), resources: resources.iter().map(resource).collect() }
    }

    #[test]
    fn the_next_holder_is_told_what_the_last_one_left_and_nothing_older() {
        let (notes, now) = (Notes::default(), Instant::now());
        assert!(notes.of(&lease(1, &["arm", "hand"]), now).is_empty());
        notes.left(LeaseId(1), "one".to_owned(), now);
        assert_eq!(notes.of(&lease(2, &["arm", "hand"]), now), ["one"], "each once");
        notes.left(LeaseId(2), String::new(), now);
        assert!(notes.of(&lease(3, &["arm"]), now).is_empty());
        assert!(notes.left(LeaseId(9), "nobody's".to_owned(), now).is_empty());
        let left = notes.left(LeaseId(3), "a stranger's".to_owned(), now);
        notes.take_back(LeaseId(3), left);
        notes.left(LeaseId(3), "three".to_owned(), now);
        assert_eq!(notes.of(&lease(4, &["arm", "eye"]), now + LIFE / 2), ["three"]);
        assert!(notes.of(&lease(5, &["arm"]), now + LIFE).is_empty());
    }
}
