//! What is going to happen in a simulated run, in the order of its moments; and of each attempt, what answers it.

use ratn_executive::protocol::Event;
use ratn_model::id::{InstanceId, LeaseId};
use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, BTreeSet};

/// What is going to happen.
pub(super) enum Entry {
    /// This event.
    Event(Event),
    /// A resource of a lease vanishes, and the goal under it ends.
    Loss { lease: LeaseId, instance: InstanceId, attempt: u32 },
}

/// When, and the how manieth that was added.
type Place = (Timestamp, u64);

#[derive(Default)]
pub(super) struct Agenda {
    entries: BTreeMap<Place, Entry>,
    answers: BTreeMap<(InstanceId, u32), BTreeSet<Place>>,
    added: u64,
}

impl Agenda {
    /// It happens at a moment, behind what happens then already.
    pub(super) fn add(&mut self, at: Timestamp, entry: Entry) {
        self.added += 1;
        self.put_back((at, self.added), entry);
    }

    /// It happens at the place that it had.
    pub(super) fn put_back(&mut self, place: Place, entry: Entry) {
        if let Some(attempt) = answered(&entry) {
            self.answers.entry(attempt).or_default().insert(place);
        }
        self.entries.insert(place, entry);
    }

    /// When something happens next.
    pub(super) fn next_at(&self) -> Option<Timestamp> {
        self.entries.first_key_value().map(|((at, _), _)| *at)
    }

    /// What happens next.
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

    /// Takes what answers an attempt.
    pub(super) fn take_answers(&mut self, instance: InstanceId, attempt: u32) -> Vec<(Place, Entry)> {
        let places = self.answers.remove(&(instance, attempt)).unwrap_or_default();
        places.into_iter().filter_map(|place| Some((place, self.entries.remove(&place)?))).collect()
    }

    /// All of it, in order.
    pub(super) fn entries(&self) -> impl Iterator<Item = &Entry> {
        self.entries.values()
    }
}

/// The attempt that is answered, if one is.
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
