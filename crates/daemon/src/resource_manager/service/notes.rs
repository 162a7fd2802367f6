//! Notes that holders of a resource leave for its next holders, with the session that left them. A holder has read the notes that were there, so its
//! own note replaces them. Holders beside each other have not read each other's notes, so all their notes are kept. Notes are in memory only: a
//! restarted manager has none.

use ratn_model::id::LeaseId;
use ratn_model::resource::Lease;
use ratn_proto::v1::HolderNote;
use std::cmp::Reverse;
use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Older notes are not reported: they are about what is still under way.
const LIFE: Duration = Duration::from_secs(60);
/// Maximum number of leases, and of resources, with notes; the oldest are removed first.
const MOST: usize = 65_536;
/// Maximum number of notes for one resource: as many as there are runs beside each other.
const MOST_OF_ONE: usize = 64;

/// The notes; clones share them.
#[derive(Debug, Clone, Default)]
pub(super) struct Notes(Arc<Mutex<Kept>>);

#[derive(Debug, Default)]
struct Kept {
    /// Granted leases.
    held: BTreeMap<LeaseId, Held>,
    /// By resource: the last note of each session.
    notes: HashMap<String, Vec<Note>>,
}

#[derive(Debug, Clone)]
struct Held {
    session: String,
    /// The caller who asked for it: nobody else leaves a note in the session's name.
    caller: Arc<str>,
    resources: Vec<String>,
    since: Instant,
}

#[derive(Debug, Clone)]
struct Note {
    session: String,
    text: Arc<str>,
    since: Instant,
}

/// The effect of a lease that is to be given back: its note, if it left one, and the notes that this replaced.
#[derive(Debug, Default)]
pub(super) struct Left(Option<(Note, Vec<Replaced>)>);

/// A resource, and its notes that were replaced.
type Replaced = (String, Vec<Note>);

impl Notes {
    /// A lease was granted to a session of this caller: returns the notes about its resources, each once.
    pub(super) fn of(&self, lease: &Lease, session: &str, caller: &Arc<str>, now: Instant) -> Vec<HolderNote> {
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
        let (session, caller) = (session.to_owned(), Arc::clone(caller));
        kept.held.insert(lease.id, Held { session, caller, resources, since: now });
        told
    }

    /// A lease is to be given back by this session with this note. An empty note changes nothing, nor does the note of a caller who did not ask for
    /// the lease. [`Notes::ended`] or [`Notes::take_back`] follows.
    pub(super) fn left(&self, lease: LeaseId, session: &str, caller: &str, note: &str, now: Instant) -> Left {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let is_own = |held: &&Held| held.session == session && *held.caller == *caller;
        let Some(held) = kept.held.get(&lease).filter(is_own).filter(|_| !note.is_empty()).cloned() else {
            return Left::default();
        };
        if kept.notes.len() >= MOST {
            kept.notes.clear();
        }
        let left = Note { session: session.to_owned(), text: note.into(), since: now };
        let mut replaced = Vec::new();
        for resource in held.resources {
            let notes = kept.notes.entry(resource.clone()).or_default();
            let stays = |note: &mut Note| note.session != session && note.since >= held.since;
            let mut gone: Vec<Note> = notes.extract_if(.., |note| !stays(note)).collect();
            gone.extend(notes.drain(notes.len().min(MOST_OF_ONE - 1)..));
            notes.insert(0, left.clone());
            replaced.push((resource, gone));
        }
        Left(Some((left, replaced)))
    }

    /// A lease has ended: no note can be left for it any more.
    pub(super) fn ended(&self, lease: LeaseId) {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        kept.held.remove(&lease);
    }

    /// The lease was not given back after all: its note is removed, and the replaced notes return, unless their sessions have left newer ones.
    pub(super) fn take_back(&self, left: Left) {
        let Left(Some((left, replaced))) = left else { return };
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        for (resource, gone) in replaced {
            let notes = kept.notes.entry(resource).or_default();
            notes.retain(|note| !Arc::ptr_eq(&note.text, &left.text));
            for note in gone {
                if notes.iter().all(|other| other.session != note.session) {
                    notes.push(note);
                }
            }
            notes.sort_by_key(|note| Reverse(note.since));
            notes.truncate(MOST_OF_ONE);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::id::FencingToken;
    use ratn_model::resource::LeasedResource;

    fn caller() -> Arc<str> {
        "control".into()
    }

    fn lease(id: u64, resources: &[&str]) -> Lease {
        let resource = |id: &&str| LeasedResource {
            id: (*id).to_owned(),
            kind: "Arm".to_owned(),
            endpoint: String::new(),
            superclasses: Vec::new(),
        };
        Lease {
            id: LeaseId(id),
            token: FencingToken(id),
            resources: resources.iter().map(resource).collect(),
            consumed: Vec::new(),
        }
    }

    #[test]
    fn the_next_holder_is_told_what_the_last_one_left() {
        let (notes, now) = (Notes::default(), Instant::now());
        let told = |id: u64, resources: &[&str], after: Duration| -> Vec<String> {
            let told = notes.of(&lease(id, resources), "b", &caller(), now + after);
            told.into_iter().map(|note| format!("{}: {}", note.session_id, note.note)).collect()
        };
        let leaves = |id: u64, session: &str, note: &str| notes.left(LeaseId(id), session, "control", note, now);
        assert!(notes.of(&lease(1, &["arm", "hand"]), "a", &caller(), now).is_empty());
        leaves(1, "a", "one");
        assert_eq!(told(2, &["arm", "hand"], Duration::ZERO), ["a: one"], "each once");
        leaves(2, "b", "");
        assert_eq!(told(3, &["arm"], LIFE / 2), ["a: one"], "who has nothing to tell takes nothing away");
        assert_eq!(told(4, &["arm"], LIFE), [""; 0], "what is long ago");
        // Lease 3 has ended by itself: its holder releases it too late, and is refused.
        notes.take_back(leaves(3, "b", "late"));
        leaves(4, "a", "not its own");
        assert_eq!(told(5, &["arm"], Duration::ZERO), ["a: one"]);
        let refused = leaves(5, "b", "of one whose session is gone");
        notes.take_back(refused);
        assert_eq!(told(6, &["arm"], LIFE / 4), ["a: one"]);
        leaves(6, "b", "six");
        assert_eq!(told(7, &["arm", "eye"], Duration::ZERO), ["b: six"]);
    }

    #[test]
    fn what_those_leave_who_hold_one_beside_each_other_is_all_told() {
        let (notes, now) = (Notes::default(), Instant::now());
        let at = |seconds| now + Duration::from_secs(seconds);
        let told = |id: u64, session: &str, after| -> Vec<String> {
            notes.of(&lease(id, &["table"]), session, &caller(), at(after)).into_iter().map(|note| note.note).collect()
        };
        assert_eq!(told(1, "a", 0), [""; 0]);
        assert_eq!(told(2, "b", 1), [""; 0]);
        notes.left(LeaseId(1), "a", "control", "of a", at(2));
        notes.left(LeaseId(2), "b", "control", "of b", at(3));
        assert_eq!(told(3, "c", 4), ["of b", "of a"]);
        notes.left(LeaseId(3), "c", "control", "of c", at(5));
        assert_eq!(told(4, "d", 6), ["of c"], "who was told of both stands for them");
    }

    #[test]
    fn a_release_that_is_refused_changes_nothing_of_what_others_leave() {
        let (notes, now) = (Notes::default(), Instant::now());
        let at = |seconds| now + Duration::from_secs(seconds);
        let told = |id: u64, after| -> Vec<String> {
            let told = notes.of(&lease(id, &["table"]), "next", &caller(), at(after));
            told.into_iter().map(|note| note.note).collect()
        };
        for (id, session) in [(1, "a"), (2, "b"), (3, "c")] {
            notes.of(&lease(id, &["table"]), session, &caller(), now);
        }
        notes.left(LeaseId(1), "a", "control", "of a", at(1));
        // The note of another caller in the session's name is ignored.
        let stranger = notes.left(LeaseId(2), "b", "stranger", "a lie", at(2));
        assert_eq!(told(10, 2), ["of a"]);
        // A release is refused; meanwhile another holder leaves a note at the same resource, and the first releases again.
        let refused = notes.left(LeaseId(2), "b", "control", "of b", at(3));
        notes.left(LeaseId(3), "c", "control", "of c", at(4));
        notes.left(LeaseId(2), "b", "control", "of b again", at(5));
        notes.take_back(stranger);
        notes.take_back(refused);
        assert_eq!(told(11, 6), ["of b again", "of c", "of a"]);
        // When a note is taken back, the notes that it replaced return.
        notes.ended(LeaseId(2));
        let late = notes.left(LeaseId(11), "next", "control", "late", at(7));
        assert_eq!(told(12, 7), ["late"]);
        notes.take_back(late);
        assert_eq!(told(13, 8), ["of b again", "of c", "of a"]);
        assert_eq!(notes.left(LeaseId(2), "b", "control", "once more", at(9)).0.map(|left| left.1.len()), None);
    }
}
