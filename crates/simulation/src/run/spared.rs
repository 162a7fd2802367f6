//! When something is looked through whose every part is looked at each time: after every event as long as it is small, and as often as its parts are
//! worth where it is large. So the looks of a run are as many as its events, times a constant, however long its queues are.

/// So many parts are looked at after every event.
const PARTS: usize = 256;

/// How much has not been looked at since it was looked through last.
#[derive(Debug, Default)]
pub(super) struct Spared(usize);

impl Spared {
    /// After an event: whether something of so many parts is looked through now.
    pub(super) fn is_due(&mut self, parts: usize) -> bool {
        self.0 = self.0.saturating_add(PARTS);
        let is_due = self.0 >= parts;
        if is_due {
            self.0 = 0;
        }
        is_due
    }
}

#[cfg(test)]
mod tests {
    use super::{PARTS, Spared};

    /// The parts that are looked at while a queue of this length becomes shorter, one with each event.
    fn looks(length: usize) -> usize {
        let mut spared = Spared::default();
        (0..length).rev().filter(|parts| spared.is_due(*parts)).sum()
    }

    #[test]
    fn what_is_small_is_looked_through_after_every_event() {
        let mut spared = Spared::default();
        assert!((0..1_000).all(|event| spared.is_due(event % PARTS)));
    }

    #[test]
    fn the_looks_of_a_long_queue_are_so_many_for_each_event() {
        for length in [500, 1_000, 2_000, 4_000] {
            let looks = looks(length);
            assert!(looks <= length * PARTS, "{looks} parts of a queue of {length}");
        }
    }
}
