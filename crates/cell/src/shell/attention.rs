//! Whether the cell has followed its clock. Where its process was suspended, or the machine had no time for it, whoever held the robot may have
//! lost it meanwhile, and another may hold it by now.
//!
//! ```text
//!   follows ── a look comes MOST_MISSED later than it was to ──▶ rests: what moved has braked since the last look, and stands
//!      ▲                                                           │
//!      └────── REST later: the leases were heard of meanwhile ─────┘
//! ```

use ratn_model::time::Timestamp;
use std::time::{Duration, Instant};

/// It may miss so much: less than any lease that has ended keeps the robot from the next holder.
const MOST_MISSED: Duration = Duration::from_secs(2);
/// So long it rests when it missed more: the watch of the leases, which was suspended, too, is told of all that has happened within this.
const REST: Duration = Duration::from_secs(1);

/// See the module.
#[derive(Debug)]
pub(super) struct Attention {
    /// The last look, in wall time and in the robot's.
    last: (Instant, Timestamp),
    rests_until: Option<Instant>,
}

/// What a look at the clock shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Seen {
    /// All is as it was.
    Nothing,
    /// It has missed too much since this moment of the robot's time: from then on the robot is to rest.
    Missed(Timestamp),
    /// It has rested.
    Rested,
}

impl Attention {
    /// The first look.
    pub(super) fn begins(at: Instant, now: Timestamp) -> Attention {
        Attention { last: (at, now), rests_until: None }
    }

    /// The next look, of a cell that meant to sleep so long at the most since the last one.
    pub(super) fn looks(&mut self, at: Instant, now: Timestamp, slept: Duration) -> Seen {
        let (last, since) = std::mem::replace(&mut self.last, (at, now));
        if at.saturating_duration_since(last) > slept + MOST_MISSED {
            self.rests_until = Some(at + REST);
            return Seen::Missed(since);
        }
        match self.rests_until.take_if(|until| *until <= at) {
            Some(_) => Seen::Rested,
            None => Seen::Nothing,
        }
    }

    /// Whether it rests.
    pub(super) fn rests(&self) -> bool {
        self.rests_until.is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_looks_too_late_rests_for_a_while_from_the_last_look_on() {
        let (begin, second) = (Instant::now(), Duration::from_secs(1));
        let robot = |s: f64| Timestamp::from_seconds(s);
        let mut attention = Attention::begins(begin, robot(10.0));
        assert_eq!(attention.looks(begin + 2 * second, robot(12.0), second), Seen::Nothing);
        assert_eq!(attention.looks(begin + 6 * second, robot(16.0), second), Seen::Missed(robot(12.0)));
        assert!(attention.rests());
        assert_eq!(attention.looks(begin + 13 * second / 2, robot(16.5), second), Seen::Nothing);
        // It is late again.
        assert_eq!(attention.looks(begin + 20 * second, robot(30.0), second), Seen::Missed(robot(16.5)));
        assert_eq!(attention.looks(begin + 41 * second / 2, robot(30.5), second), Seen::Nothing);
        assert_eq!(attention.looks(begin + 21 * second, robot(31.0), second), Seen::Rested);
        assert!(!attention.rests());
        assert_eq!(attention.looks(begin + 22 * second, robot(32.0), second), Seen::Nothing);
    }
}
