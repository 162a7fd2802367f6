//! What whoever gives a resource back leaves to be told to its next holders, and the session that left it. Whoever was told something stands
//! for it: what they leave takes its place. Of those who hold one beside each other nobody was told of the others, and what each leaves is
//! kept. All of it is in memory only: whoever starts anew knows of nothing.

use ratn_model::id::LeaseId;
use ratn_model::resource::Lease;
use ratn_proto::v1::HolderNote;
use std::cmp::Reverse;
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
    /// Who asked for it: nobody else leaves a note in the session's name.
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

/// What was done for a lease that is to be given back: the note that was left, where it was, and the notes whose place it took there.
#[derive(Debug, Default)]
pub(super) struct Left(Option<(Note, Vec<Replaced>)>);

/// A resource, and the notes that were there.
type Replaced = (String, Vec<Note>);

impl Notes {
    /// A lease was granted to a session, for which this caller speaks: what is to be told of its resources, each note once.
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

    /// A lease is to be given back by this session with this note; an empty one leaves what there is, and so does that of somebody who did not ask for
    /// the lease. It is followed by [`Notes::ended`] or [`Notes::take_back`].
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

    /// A lease has ended: nobody leaves anything for it any more.
    pub(super) fn ended(&self, lease: LeaseId) {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        kept.held.remove(&lease);
    }

    /// It was not given back after all: its note goes, and those whose place it took are back, but where their sessions have left others since.
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
        // Lease 3 has ended by itself: its holder comes back too late, and is refused.
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
        // A stranger in its name is not heard at all.
        let stranger = notes.left(LeaseId(2), "b", "stranger", "a lie", at(2));
        assert_eq!(told(10, 2), ["of a"]);
        // One that is refused, and meanwhile another leaves a note at the same place, and the holder asks again.
        let refused = notes.left(LeaseId(2), "b", "control", "of b", at(3));
        notes.left(LeaseId(3), "c", "control", "of c", at(4));
        notes.left(LeaseId(2), "b", "control", "of b again", at(5));
        notes.take_back(stranger);
        notes.take_back(refused);
        assert_eq!(told(11, 6), ["of b again", "of c", "of a"]);
        // A note that took the place of others gives it back.
        notes.ended(LeaseId(2));
        let late = notes.left(LeaseId(11), "next", "control", "late", at(7));
        assert_eq!(told(12, 7), ["late"]);
        notes.take_back(late);
        assert_eq!(told(13, 8), ["of b again", "of c", "of a"]);
        assert_eq!(notes.left(LeaseId(2), "b", "control", "once more", at(9)).0.map(|left| left.1.len()), None);
    }
}
