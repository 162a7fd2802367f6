//! Messages that came before the projection or commit that they need: each waits a moment for it.

use ratn_model::time::Timestamp;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

/// How long a message waits.
pub(super) const PATIENCE: Duration = Duration::from_secs(1);

/// Maximum number of waiting messages.
pub(super) const MOST: usize = 4_096;

/// Part of these for one caller: a caller who waits in vain leaves room for the others.
pub(super) const MOST_OF_ONE: usize = 2_048;

/// Approximate maximum memory of waiting messages in bytes, in all and of one caller.
const MOST_BYTES: usize = 256 << 20;
const MOST_BYTES_OF_ONE: usize = MOST_BYTES / 2;

/// The waiting messages, oldest first, each with its deadline.
#[derive(Debug)]
pub(super) struct Parked<M> {
    messages: VecDeque<One<M>>,
    bytes: usize,
    /// Waiting messages of each caller.
    of: BTreeMap<Arc<str>, Waiting>,
}

#[derive(Debug, Clone, Copy, Default)]
struct Waiting {
    messages: usize,
    bytes: usize,
}

#[derive(Debug)]
struct One<M> {
    until: Timestamp,
    whose: Arc<str>,
    bytes: usize,
    message: M,
}

impl<M> Default for Parked<M> {
    fn default() -> Parked<M> {
        Parked { messages: VecDeque::new(), bytes: 0, of: BTreeMap::new() }
    }
}

impl<M> Parked<M> {
    /// Lets a message of a caller wait, which takes this many bytes; returns it where too many wait already, in all or of that caller.
    pub(super) fn park(&mut self, now: Timestamp, whose: Arc<str>, bytes: usize, message: M) -> Result<(), M> {
        let Waiting { messages: of_caller, bytes: bytes_of_caller } = self.of.get(&whose).copied().unwrap_or_default();
        let too_many = self.messages.len() >= MOST || of_caller >= MOST_OF_ONE;
        if too_many || self.bytes + bytes > MOST_BYTES || bytes_of_caller + bytes > MOST_BYTES_OF_ONE {
            return Err(message);
        }
        self.of.insert(whose.clone(), Waiting { messages: of_caller + 1, bytes: bytes_of_caller + bytes });
        self.bytes += bytes;
        self.messages.push_back(One { until: now + PATIENCE, whose, bytes, message });
        Ok(())
    }

    /// When the first message has waited long enough.
    pub(super) fn next_deadline(&self) -> Option<Timestamp> {
        self.messages.front().map(|one| one.until)
    }

    /// Takes the messages that need not wait any more, or have waited long enough, in the order of arrival.
    pub(super) fn take(&mut self, now: Timestamp, is_early: impl Fn(&M) -> bool) -> Vec<M> {
        if self.messages.is_empty() {
            return Vec::new();
        }
        let all = std::mem::take(&mut self.messages).into_iter();
        let (early, rest): (Vec<_>, Vec<_>) = all.partition(|one| one.until > now && is_early(&one.message));
        self.messages = early.into();
        for one in &rest {
            self.bytes -= one.bytes;
            if let Some(waiting) = self.of.get_mut(&one.whose) {
                waiting.messages -= 1;
                waiting.bytes -= one.bytes;
                if waiting.messages == 0 {
                    self.of.remove(&one.whose);
                }
            }
        }
        rest.into_iter().map(|one| one.message).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(parked: &mut Parked<usize>, at: Timestamp, whose: &str, message: usize) -> Result<(), usize> {
        parked.park(at, whose.into(), 1, message)
    }

    #[test]
    fn what_waits_has_a_bound_in_bytes_of_each_caller_and_in_all() {
        let (mut parked, start) = (Parked::default(), Timestamp(0));
        let park = |parked: &mut Parked<u8>, whose: &str, bytes| parked.park(start, whose.into(), bytes, 0);
        assert_eq!(park(&mut parked, "eve", MOST_BYTES_OF_ONE), Ok(()));
        assert_eq!(park(&mut parked, "eve", 1), Err(0));
        assert_eq!(park(&mut parked, "adam", MOST_BYTES_OF_ONE), Ok(()));
        assert_eq!(park(&mut parked, "cain", 1), Err(0));
        assert_eq!(parked.take(start, |_| false).len(), 2);
        assert_eq!((parked.bytes, park(&mut parked, "eve", 1)), (0, Ok(())));
    }

    #[test]
    fn a_message_waits_for_what_it_is_about_but_not_for_ever() {
        let (mut parked, start) = (Parked::default(), Timestamp(0));
        assert_eq!(one(&mut parked, start, "a", 1), Ok(()));
        assert_eq!(one(&mut parked, start + PATIENCE / 2, "a", 2), Ok(()));
        assert_eq!(parked.next_deadline(), Some(start + PATIENCE));
        assert_eq!(parked.take(start + PATIENCE / 2, |_| true), [0; 0]);
        assert_eq!(parked.take(start + PATIENCE / 2, |message| *message == 1), [2]);
        assert_eq!(parked.take(start + PATIENCE, |_| true), [1]);
        assert_eq!(parked.next_deadline(), None);
        assert!(parked.of.is_empty());
    }

    #[test]
    fn not_more_wait_than_may_and_of_one_caller_no_more_than_half() {
        let (mut parked, start) = (Parked::default(), Timestamp(0));
        assert!((0..MOST_OF_ONE).all(|message| one(&mut parked, start, "eve", message).is_ok()));
        assert_eq!(one(&mut parked, start, "eve", 9_999), Err(9_999));
        assert!((MOST_OF_ONE..MOST).all(|message| one(&mut parked, start, "adam", message).is_ok()));
        assert_eq!(one(&mut parked, start, "cain", 9_999), Err(9_999));
        // An answered message makes room for its own caller.
        assert_eq!(parked.take(start, |message| *message != 7), [7]);
        assert_eq!(one(&mut parked, start, "adam", 9_998), Err(9_998));
        assert_eq!(one(&mut parked, start, "eve", 9_998), Ok(()));
    }
}
