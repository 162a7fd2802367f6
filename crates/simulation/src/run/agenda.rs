//! The agenda of a simulated run: future entries in the order of time, and by attempt the entries that answer it.

use ratn_executive::protocol::Event;
use ratn_model::id::{InstanceId, LeaseId};
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, BTreeSet};

/// A future entry.
pub(super) enum Entry {
    /// An event for the executive.
    Event(Event),
    /// A resource of a lease vanishes, and the goal under it ends.
    Loss { lease: LeaseId, instance: InstanceId, attempt: u32 },
}

/// The time, and the number of the entry.
type Place = (Timestamp, u64);

#[derive(Default)]
pub(super) struct Agenda {
    entries: BTreeMap<Place, Entry>,
    answers: BTreeMap<(InstanceId, u32), BTreeSet<Place>>,
    added: u64,
}

impl Agenda {
    /// Adds an entry at a time, after the entries at the same time.
    pub(super) fn add(&mut self, at: Timestamp, entry: Entry) {
        self.added += 1;
        self.put_back((at, self.added), entry);
    }

    /// Puts an entry back at its earlier place.
    pub(super) fn put_back(&mut self, place: Place, entry: Entry) {
        if let Some(attempt) = answered(&entry) {
            self.answers.entry(attempt).or_default().insert(place);
        }
        self.entries.insert(place, entry);
    }

    pub(super) fn next_at(&self) -> Option<Timestamp> {
        self.entries.first_key_value().map(|((at, _), _)| *at)
    }

    /// Takes the next entry.
    pub(super) fn pop_first(&mut self) -> Option<(Timestamp, Entry)> {
        let (place, entry) = self.entries.pop_first()?;
        if let Some(attempt) = answered(&entry)
            && let Some(places) = self.answers.get_mut(&attempt)
        {
            places.remove(&place);
            if places.is_empty() {
                self.answers.remove(&attempt);
            }
        }
        Some((place.0, entry))
    }

    pub(super) fn take_answers(&mut self, instance: InstanceId, attempt: u32) -> Vec<(Place, Entry)> {
        let places = self.answers.remove(&(instance, attempt)).unwrap_or_default();
        places.into_iter().filter_map(|place| Some((place, self.entries.remove(&place)?))).collect()
    }

    /// All entries, in order.
    pub(super) fn entries(&self) -> impl Iterator<Item = &Entry> {
        self.entries.values()
    }
}

fn answered(entry: &Entry) -> Option<(InstanceId, u32)> {
    match entry {
        Entry::Event(
            Event::Finished { instance, attempt, .. }
            | Event::Improved { instance, attempt, .. }
            | Event::Crashed { instance, attempt, .. }
            | Event::Projected { instance, attempt, .. },
        )
        | Entry::Loss { instance, attempt, .. } => Some((*instance, *attempt)),
        Entry::Event(_) => None,
    }
}
