//! Turns: the order in which waiting requests are served.
//!
//! Only the first requests of each session compete, at most one for each family of kinds (`own_order.rs`), in the session's own order: certain before
//! speculative, then the larger priority, then the earlier arrival. Requests for what does not exist do not count. The other requests of a session
//! wait for its first ones, and come after the first ones of all other sessions that are equally certain. So a session alone is served in its own
//! order, except that a request waits for no family because of an earlier one that waits behind others in another family.
//!
//! Certain requests come before speculative ones. Then the order is by time in steps of [`LEAD`]: since when a request is due for a turn, delayed by
//! at most [`AHEAD`] if its session has used more for its share than other waiting sessions (`accounts.rs`). A request is due since it waits and
//! existing resources could satisfy it, or, if that is later, since a first request of its session was last served in a family that it wants. So a
//! first request that is withdrawn leaves its place to the next one with that one's own waiting time, which may be long. Within a step, the order is
//! by urgency (bits 60 and up of a priority), then by the earlier due time of the session's task, then by the larger priority, then by the earlier
//! arrival.
//!
//! ```text
//!   due since ≤ time of the turn ≤ due since + AHEAD         step = time of the turn / LEAD, rounded down
//!
//!   w is due since a:                                  step(w) ≤ ⌊(a + AHEAD) / LEAD⌋
//!   v is due since b, and served before w:             step(v) ≤ step(w), and step(v) ≥ ⌊b / LEAD⌋, so b < a + AHEAD + LEAD
//! ```
//!
//! So a first request that is certainly needed is not passed by a request of another session that is due `AHEAD + LEAD` later, whatever the priority,
//! share or due time of that one. (If the shares of its caller exceed their bound, `AHEAD` is longer for it by the same factor.) A request may keep
//! the waiting time of another one of its session that it replaces (`replaced.rs`); if it thereby becomes certain, it keeps at most [`LEAD`] of it.
//! It passes no request that was due [`BOUND`] before it became certain.

use ratn_model::time::Timestamp;
use serde::{Deserialize, Serialize};
use std::cmp::Reverse;
use std::fmt;
use std::time::Duration;

/// Maximum delay of a turn because of what its session has used.
pub const AHEAD: Duration = Duration::from_secs(60);
/// Requests within such a step of time are served by urgency, due time and priority.
pub const LEAD: Duration = Duration::from_secs(10);
/// A certain first request of a session is not passed by one of another session that is due this much later: that began to wait, became certain, or
/// had another request of its session served this much later.
pub const BOUND: Duration = Duration::from_secs(AHEAD.as_secs() + 2 * LEAD.as_secs());
/// The bits of a priority from this one on are the urgency.
const URGENCY_BITS: u32 = 60;

/// The share (weight) of a session for contested resources, relative to the shares of others: in thousandths of the usual share.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "f64", into = "f64")]
pub struct Share(u32);

/// The number is not within [`Share::LEAST`] and [`Share::MOST`].
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("a share is a number from {} to {}, and 1 is the usual one", Share::LEAST, Share::MOST)]
pub struct NoShare;

impl Share {
    /// The usual share.
    pub const ONE: Share = Share(1_000);
    /// The smallest share.
    pub const LEAST: Share = Share(10);
    /// The largest share.
    pub const MOST: Share = Share(100_000);

    /// The share for a number, rounded to thousandths.
    ///
    /// # Errors
    /// Not a number, or outside of the limits.
    pub fn new(number: f64) -> Result<Share, NoShare> {
        let thousandths = (number * 1_000.0).round();
        if !(f64::from(Share::LEAST.0)..=f64::from(Share::MOST.0)).contains(&thousandths) {
            return Err(NoShare);
        }
        Ok(Share(thousandths as u32))
    }

    /// The share as a number.
    pub fn number(self) -> f64 {
        f64::from(self.0) / 1_000.0
    }

    pub(crate) fn thousandths(self) -> u64 {
        self.0.into()
    }
}

impl Default for Share {
    fn default() -> Share {
        Share::ONE
    }
}

impl TryFrom<f64> for Share {
    type Error = NoShare;

    fn try_from(number: f64) -> Result<Share, NoShare> {
        Share::new(number)
    }
}

impl From<Share> for f64 {
    fn from(share: Share) -> f64 {
        share.number()
    }
}

impl fmt::Display for Share {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.number().fmt(f)
    }
}

/// The standing that a session sets for itself.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Standing {
    /// Its share.
    pub share: Share,
    /// The due time of its task.
    pub due: Option<Timestamp>,
}

/// The turn of a request; smaller turns are served first. The fields are in the order of comparison.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Turn {
    speculative: bool,
    step: u32,
    urgency: Reverse<i8>,
    /// Whole seconds; [`NEVER`] without a due time.
    due: u32,
    priority: Reverse<i64>,
}

const NEVER: u32 = u32::MAX;
/// After every step of time.
const BEHIND: u32 = u32::MAX;

impl Turn {
    /// After every turn.
    pub(crate) const LAST: Turn =
        Turn { speculative: true, step: u32::MAX, urgency: Reverse(i8::MIN), due: NEVER, priority: Reverse(i64::MIN) };

    /// The turn of a request behind others of its session.
    pub(crate) fn behind(speculative: bool, due: Option<Timestamp>, priority: i64) -> Turn {
        Turn::of(speculative, BEHIND, due, priority)
    }

    /// The turn of a first request of its session.
    pub(crate) fn of(speculative: bool, step: u32, due: Option<Timestamp>, priority: i64) -> Turn {
        let due = due.map_or(NEVER, |due| seconds(due).min(NEVER - 1));
        let urgency = Reverse((priority >> URGENCY_BITS) as i8);
        Turn { speculative, step, urgency, due, priority: Reverse(priority) }
    }

    /// Whether others of its session come before it.
    pub(crate) fn is_behind(self) -> bool {
        self.step == BEHIND
    }
}

/// The step of a first request that is due since then, of a session that is this far ahead of others.
pub(crate) fn step(since: Timestamp, ahead: Duration) -> u32 {
    seconds(since + ahead.min(AHEAD)) / LEAD.as_secs() as u32
}

fn seconds(at: Timestamp) -> u32 {
    u32::try_from(at.0 / 1_000_000_000).unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    fn at(seconds: u64) -> Timestamp {
        Timestamp(seconds * 1_000_000_000)
    }

    #[test]
    fn certain_comes_first_then_the_step_then_urgency_then_what_is_due_then_priority() {
        const URGENT: i64 = 1 << URGENCY_BITS;
        let order = [
            Turn::of(false, 1, None, 0),
            Turn::of(false, 2, None, URGENT),
            Turn::of(false, 2, Some(at(50)), 3),
            Turn::of(false, 2, Some(at(60)), URGENT - 1),
            Turn::of(false, 2, None, 7),
            Turn::of(false, 2, None, 0),
            Turn::of(false, 2, Some(at(50)), -1),
            Turn::behind(false, Some(at(1)), i64::MAX),
            Turn::of(true, 0, Some(at(1)), i64::MAX),
            Turn::behind(true, None, i64::MAX),
            Turn::LAST,
        ];
        assert!(order.is_sorted_by(|a, b| a < b), "{order:?}");
        let priorities = [i64::MAX, URGENT, URGENT - 1, 1, 0, -1, i64::MIN].map(|p| Turn::of(false, 2, None, p));
        assert!(priorities.is_sorted_by(|a, b| a < b), "without due times as the priorities say");
    }

    #[test]
    fn a_turn_is_no_sooner_than_its_request_and_at_most_so_much_later() {
        assert_eq!(step(at(25), Duration::ZERO), 2);
        assert_eq!(step(at(25), Duration::from_secs(13)), 3);
        assert_eq!(step(at(25), Duration::from_secs(1_000)), 8, "60 s later");
        assert!(step(Timestamp(u64::MAX), Duration::ZERO) < BEHIND);
    }

    #[test]
    fn a_request_passes_none_that_was_asked_ahead_and_lead_before_it() {
        for asked in 0..200 {
            let latest = step(at(asked), Duration::from_secs(500));
            let earliest = step(at(asked) + AHEAD + LEAD, Duration::ZERO);
            assert!(Turn::of(false, earliest, Some(at(0)), i64::MAX) > Turn::of(false, latest, None, i64::MIN));
        }
    }

    #[test]
    fn a_share_is_a_number_within_its_bounds() {
        for (number, share) in [(1.0, Some("1")), (0.01, Some("0.01")), (2.5, Some("2.5")), (100.0, Some("100"))] {
            assert_eq!(Share::new(number).ok().map(|share| share.to_string()).as_deref(), share);
        }
        for number in [0.0, -1.0, 0.009, 100.01, f64::NAN, f64::INFINITY] {
            assert_eq!(Share::new(number), Err(NoShare), "{number}");
        }
        assert_eq!(NoShare.to_string(), "a share is a number from 0.01 to 100, and 1 is the usual one");
    }
}
