//! Messages that came before what they are about: each waits a moment for that.

use ratn_model::time::Timestamp;
use std::collections::VecDeque;
use std::time::Duration;

/// So long a message waits.
pub(super) const PATIENCE: Duration = Duration::from_secs(1);

/// So many wait at the most.
pub(super) const MOST: usize = 4_096;

/// The messages that wait, the oldest first, each with the end of its patience.
#[derive(Debug)]
pub(super) struct Parked<M>(VecDeque<(Timestamp, M)>);

impl<M> Default for Parked<M> {
    fn default() -> Parked<M> {
        Parked(VecDeque::new())
    }
}

impl<M> Parked<M> {
    /// Has a message wait; gives it back where as many wait already as may.
    pub(super) fn park(&mut self, now: Timestamp, message: M) -> Result<(), M> {
        if self.0.len() >= MOST {
            return Err(message);
        }
        self.0.push_back((now + PATIENCE, message));
        Ok(())
    }

    /// When the first has waited long enough.
    pub(super) fn next_deadline(&self) -> Option<Timestamp> {
        self.0.front().map(|(until, _)| *until)
    }

    /// Those that need not wait any more, or have waited long enough, in the order in which they came.
    pub(super) fn take(&mut self, now: Timestamp, is_early: impl Fn(&M) -> bool) -> Vec<M> {
        if self.0.is_empty() {
            return Vec::new();
        }
        let all = std::mem::take(&mut self.0).into_iter();
        let (early, rest): (Vec<_>, Vec<_>) = all.partition(|(until, message)| *until > now && is_early(message));
        self.0 = early.into();
        rest.into_iter().map(|(_, message)| message).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_waits_for_what_it_is_about_but_not_for_ever() {
        let (mut parked, start) = (Parked::default(), Timestamp(0));
        assert_eq!(parked.park(start, 1), Ok(()));
        assert_eq!(parked.park(start + PATIENCE / 2, 2), Ok(()));
        assert_eq!(parked.next_deadline(), Some(start + PATIENCE));
        assert_eq!(parked.take(start + PATIENCE / 2, |_| true), [0; 0]);
        assert_eq!(parked.take(start + PATIENCE / 2, |message| *message == 1), [2]);
        assert_eq!(parked.take(start + PATIENCE, |_| true), [1]);
        assert_eq!(parked.next_deadline(), None);
    }

    #[test]
    fn not_more_wait_than_may() {
        let mut parked = Parked::default();
        assert!((0..MOST).all(|message| parked.park(Timestamp(0), message).is_ok()));
        assert_eq!(parked.park(Timestamp(0), 9_999), Err(9_999));
    }
}
