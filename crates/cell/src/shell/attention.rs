//! Detects that the cell's process did not run for a while. If it or the machine was suspended, or it got no processor time, the leases of the robot's modules may have
//! ended meanwhile, and others may hold the modules by now.
//!
//! ```text
//! runs ── a look at the clock is more than MOST_MISSED late ──▶ rests: everything that moved has braked since the last look, and stands
//!   ▲                                                         │
//!   └──── after REST: the lease watch is up to date again ───┘
//! ```

use ratn_model::time::Timestamp;
use ratn_worker::boot_clock::BootInstant;
use std::time::Duration;

/// Maximum delay that is accepted: less than the time for which an ended lease keeps a module from its next holder.
const MOST_MISSED: Duration = Duration::from_secs(2);
/// Duration of the rest after a longer delay: within this time the lease watch, which was suspended as well, receives everything that has happened.
const REST: Duration = Duration::from_secs(1);

/// See the module's description.
#[derive(Debug)]
pub(super) struct Attention {
    /// The time of the last look, in wall time and in the robot's time.
    last: (BootInstant, Timestamp),
    rests_until: Option<BootInstant>,
}

/// The result of a look at the clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Seen {
    /// Nothing has changed.
    Nothing,
    /// The process has not run since this moment of the robot's time: the robot rests from then on.
    Missed(Timestamp),
    /// The rest is over.
    Rested,
}

impl Attention {
    /// The first look.
    pub(super) fn begins(at: BootInstant, now: Timestamp) -> Attention {
        Attention { last: (at, now), rests_until: None }
    }

    /// The next look; since the last one the cell meant to sleep at most `slept`.
    pub(super) fn looks(&mut self, at: BootInstant, now: Timestamp, slept: Duration) -> Seen {
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

    /// Whether the robot rests.
    pub(super) fn rests(&self) -> bool {
        self.rests_until.is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_worker::boot_clock::BootClock;

    #[test]
    fn who_looks_too_late_rests_for_a_while_from_the_last_look_on() {
        let (begin, second) = (BootClock::default().now(), Duration::from_secs(1));
        let robot = |s: f64| Timestamp::from_seconds(s);
        let mut attention = Attention::begins(begin, robot(10.0));
        assert_eq!(attention.looks(begin + second * 2, robot(12.0), second), Seen::Nothing);
        assert_eq!(attention.looks(begin + second * 6, robot(16.0), second), Seen::Missed(robot(12.0)));
        assert!(attention.rests());
        assert_eq!(attention.looks(begin + second * 13 / 2, robot(16.5), second), Seen::Nothing);
        // The look is late again.
        assert_eq!(attention.looks(begin + second * 20, robot(30.0), second), Seen::Missed(robot(16.5)));
        assert_eq!(attention.looks(begin + second * 41 / 2, robot(30.5), second), Seen::Nothing);
        assert_eq!(attention.looks(begin + second * 21, robot(31.0), second), Seen::Rested);
        assert!(!attention.rests());
        assert_eq!(attention.looks(begin + second * 22, robot(32.0), second), Seen::Nothing);
    }
}
