//! What whoever gives a resource back leaves to be told to its next holders, and the session that left it. Whoever was told something stands
//! for it: what they leave takes its place. Of those who hold one beside each other nobody was told of the others, and what each leaves is
//! kept. All of it is in memory only: whoever starts anew knows of nothing.

use ratn_model::id::LeaseId;
use ratn_model::resource::Lease;
use ratn_proto::v1::HolderNote;
use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// What was left longer ago is not told: it is about what is on its way.
const LIFE: Duration = Duration::from_secs(60);
/// Of more leases or resources nothing is kept; the oldest are given up first.
const MOST: usize = 65_536;
/// At one resource the last so many are kept: as many as there are runs beside each other.
const MOST_OF_ONE: usize = 64;

/// The notes; clones share them.
#[derive(Debug, Clone, Default)]
pub(super) struct Notes(Arc<Mutex<Kept>>);

#[derive(Debug, Default)]
struct Kept {
    /// Leases that were granted.
    held: BTreeMap<LeaseId, Held>,
    /// By resource, each session's last.
    notes: HashMap<String, Vec<Note>>,
}

#[derive(Debug, Clone)]
struct Held {
    session: String,
    resources: Vec<String>,
    since: Instant,
}

#[derive(Debug, Clone)]
struct Note {
    session: String,
    text: Arc<str>,
    since: Instant,
}

/// What was done for a lease that is to be given back.
#[derive(Debug, Default)]
pub(super) struct Left {
    held: Option<Held>,
    /// What was there at each resource.
    before: Vec<(String, Vec<Note>)>,
}

impl Notes {
    /// A lease was granted to a session: what is to be told of its resources, each note once.
    pub(super) fn of(&self, lease: &Lease, session: &str, now: Instant) -> Vec<HolderNote> {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let resources: Vec<String> = lease.resources.iter().map(|resource| resource.id.clone()).collect();
        let mut told: Vec<HolderNote> = Vec::new();
        for note in resources.iter().filter_map(|id| kept.notes.get(id)).flatten() {
            let is_fresh = now.saturating_duration_since(note.since) < LIFE;
            let note = HolderNote { session_id: note.session.clone(), note: note.text.to_string() };
            if is_fresh && !told.contains(&note) {
                told.push(note);
            }
        }
        // Leases that end by themselves are never given back.
        if kept.held.len() >= MOST {
            kept.held.pop_first();
        }
        kept.held.insert(lease.id, Held { session: session.to_owned(), resources, since: now });
        told
    }

    /// A lease is to be given back by this session with this note; an empty one leaves what there is.
    pub(super) fn left(&self, lease: LeaseId, session: &str, note: &str, now: Instant) -> Left {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if kept.held.get(&lease).is_none_or(|held| held.session != session) {
            return Left::default();
        }
        let held = kept.held.remove(&lease);
        if kept.notes.len() >= MOST {
            kept.notes.clear();
        }
        let text: Arc<str> = note.into();
        let mut before = Vec::new();
        for (held, resource) in held.iter().flat_map(|held| held.resources.iter().map(move |id| (held, id))) {
            if !text.is_empty() {
                let notes = kept.notes.entry(resource.clone()).or_default();
                before.push((resource.clone(), notes.clone()));
                notes.retain(|note| note.session != session && note.since >= held.since);
                notes.truncate(MOST_OF_ONE - 1);
                notes.insert(0, Note { session: session.to_owned(), text: Arc::clone(&text), since: now });
            }
        }
        Left { held, before }
    }

    /// It was not given back after all: not by whoever asked for that.
    pub(super) fn take_back(&self, lease: LeaseId, left: Left) {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        for (resource, notes) in left.before {
            kept.notes.insert(resource, notes);
        }
        kept.held.extend(left.held.map(|held| (lease, held)));
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
    fn the_next_holder_is_told_what_the_last_one_left() {
        let (notes, now) = (Notes::default(), Instant::now());
        let told = |id: u64, resources: &[&str], after: Duration| -> Vec<String> {
            let told = notes.of(&lease(id, resources), "b", now + after);
            told.into_iter().map(|note| format!("{}: {}", note.session_id, note.note)).collect()
        };
        let leaves = |id: u64, session: &str, note: &str| notes.left(LeaseId(id), session, note, now);
        assert!(notes.of(&lease(1, &["arm", "hand"]), "a", now).is_empty());
        leaves(1, "a", "one");
        assert_eq!(told(2, &["arm", "hand"], Duration::ZERO), ["a: one"], "each once");
        leaves(2, "b", "");
        assert_eq!(told(3, &["arm"], LIFE / 2), ["a: one"], "who has nothing to tell takes nothing away");
        assert_eq!(told(4, &["arm"], LIFE), [""; 0], "what is long ago");
        // Lease 3 has ended by itself: its holder comes back too late, and is refused.
        notes.take_back(LeaseId(3), leaves(3, "b", "late"));
        leaves(4, "a", "not its own");
        assert_eq!(told(5, &["arm"], Duration::ZERO), ["a: one"]);
        let refused = leaves(5, "b", "of a stranger in its name");
        notes.take_back(LeaseId(5), refused);
        assert_eq!(told(6, &["arm"], LIFE / 4), ["a: one"]);
        leaves(6, "b", "six");
        assert_eq!(told(7, &["arm", "eye"], Duration::ZERO), ["b: six"]);
    }

    #[test]
    fn what_those_leave_who_hold_one_beside_each_other_is_all_told() {
        let (notes, now) = (Notes::default(), Instant::now());
        let at = |seconds| now + Duration::from_secs(seconds);
        let told = |id: u64, session: &str, after| -> Vec<String> {
            notes.of(&lease(id, &["table"]), session, at(after)).into_iter().map(|note| note.note).collect()
        };
        assert_eq!(told(1, "a", 0), [""; 0]);
        assert_eq!(told(2, "b", 1), [""; 0]);
        notes.left(LeaseId(1), "a", "of a", at(2));
        notes.left(LeaseId(2), "b", "of b", at(3));
        assert_eq!(told(3, "c", 4), ["of b", "of a"]);
        notes.left(LeaseId(3), "c", "of c", at(5));
        assert_eq!(told(4, "d", 6), ["of c"], "who was told of both stands for them");
    }
}
