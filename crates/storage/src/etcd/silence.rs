//! How long the leader has been silent, as seen by a standby. Pure: observations and their times in, a verdict out.
//!
//! Silence counts only while etcd answers: the time that counts between two checks is bounded, and after a longer pause silence begins
//! anew. This protects a holder that could not write either. Whether the place may be taken is decided by the transaction that takes it: it
//! compares all keys that have been unchanged for so long.

use std::time::{Duration, Instant};

/// A holder that has not written for this long has gone. Longer than the validity of a confirmation by
/// [`Place::check`](crate::Place::check).
pub(super) const SILENCE: Duration = Duration::from_millis(1_050);
/// Maximum time that counts between two checks: less than [`SILENCE`], so that a holder has a moment to write when etcd is back.
const MOST_COUNTED: Duration = Duration::from_millis(500);
/// Longer than any check that is answered in time. After a longer pause silence begins anew.
const LONGEST_PAUSE: Duration = Duration::from_millis(1_000);

/// The revisions of the keys that show that a holder is alive; 0 for a key that does not exist.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Signs {
    pub(super) leader: i64,
    pub(super) alive: i64,
    /// Deleted by a holder that cannot write `alive`.
    pub(super) writable: i64,
}

/// See the module.
#[derive(Debug, Clone, Copy)]
pub(super) struct Silence {
    signs: Signs,
    counted: Duration,
    looked: Instant,
}

/// The result of a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Verdict {
    /// Not decided yet: check again.
    Undecided,
    /// The holder has written since the last check.
    Spoke,
    /// The holder has been silent for long enough, although it could have written.
    Over,
    /// The holder has been silent for long enough, but etcd may have had no space for it to write. Only a new write shows that there is
    /// space; silence begins with that write.
    Unwritable,
}

/// One more check of what a holder has written.
pub(super) fn look(silence: &mut Option<Silence>, signs: Signs, now: Instant) -> Verdict {
    let before = silence.filter(|before| now.saturating_duration_since(before.looked) <= LONGEST_PAUSE);
    let counted = match before {
        Some(before) if before.signs == signs => {
            before.counted + now.saturating_duration_since(before.looked).min(MOST_COUNTED)
        }
        _ => Duration::ZERO,
    };
    *silence = Some(Silence { signs, counted, looked: now });
    match before {
        Some(before) if before.signs != signs => Verdict::Spoke,
        _ if counted < SILENCE => Verdict::Undecided,
        _ if signs.writable == 0 => Verdict::Unwritable,
        _ => Verdict::Over,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIGNS: Signs = Signs { leader: 5, alive: 9, writable: 5 };

    /// The verdicts of checks; each is given with its delay after the previous one, in milliseconds.
    fn looks(looks: &[(u64, Signs)]) -> Vec<Verdict> {
        let (mut silence, mut now) = (None, Instant::now());
        let each = |(pause, signs): &(u64, Signs)| {
            now += Duration::from_millis(*pause);
            look(&mut silence, *signs, now)
        };
        looks.iter().map(each).collect()
    }

    #[test]
    fn the_place_is_free_after_a_silence_however_slow_the_answers_are() {
        use Verdict::{Over, Undecided};
        // Every 50 ms: the first check, and 20 that are not enough.
        let quick = looks(&[(50, SIGNS); 23]);
        assert!(quick[..21].iter().all(|verdict| *verdict == Undecided) && quick[21] == Over, "{quick:?}");
        // Answers take 0.55 or 0.95 s.
        for pause in [550, 950] {
            let slow = looks(&[(pause, SIGNS); 4]);
            assert_eq!(slow, [Undecided, Undecided, Undecided, Over], "{pause}");
        }
        // etcd was away in between: a holder that could not write gets its time.
        let away = looks(&[(0, SIGNS), (900, SIGNS), (1_100, SIGNS), (900, SIGNS), (900, SIGNS), (900, SIGNS)]);
        assert_eq!(away, [Undecided, Undecided, Undecided, Undecided, Undecided, Over]);
    }

    #[test]
    fn whoever_says_something_has_its_whole_time_again() {
        let spoke = Signs { alive: 10, ..SIGNS };
        let seen =
            looks(&[(0, SIGNS), (500, SIGNS), (500, SIGNS), (50, spoke), (500, spoke), (500, spoke), (50, spoke)]);
        assert_eq!(seen[3], Verdict::Spoke);
        assert_eq!(seen[5..], [Verdict::Undecided, Verdict::Over]);
    }

    #[test]
    fn a_silence_in_which_there_may_have_been_no_space_is_none() {
        let full = Signs { writable: 0, ..SIGNS };
        let seen = looks(&[(0, full), (500, full), (500, full), (50, full), (50, full), (50, SIGNS), (500, SIGNS)]);
        assert_eq!(seen[2..5], [Verdict::Undecided, Verdict::Unwritable, Verdict::Unwritable]);
        // A write by the standby: silence counts only from here.
        assert_eq!(seen[5..], [Verdict::Spoke, Verdict::Undecided]);
    }
}
