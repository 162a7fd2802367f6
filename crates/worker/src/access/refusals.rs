//! Rate limit of the log lines on refusals: per caller and reason, the first refusal is logged, then one line per interval with the number
//! of lines left out.
//!
//! ```text
//!   refused ──▶ logged ──▶ counted for LOG_INTERVAL ──▶ logged with the count ──▶ ... ──▶ forgotten after an interval without one
//! ```
//! A pure state machine: time is an argument.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Minimum interval between two log lines of the same caller and reason.
pub(super) const LOG_INTERVAL: Duration = Duration::from_secs(10);
/// Maximum number of (caller, reason) pairs that are kept apart; all other refusals share one line.
const MOST: usize = 1_024;

/// A caller and the reason of its refusals.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Refused {
    /// The caller's name.
    pub(super) who: Arc<str>,
    /// What was refused.
    pub(super) what: String,
}

/// See the module.
#[derive(Debug, Default)]
pub(super) struct Refusals(BTreeMap<Refused, Counted>);

#[derive(Debug)]
struct Counted {
    logged: Instant,
    left_out: u64,
}

/// A line of the log.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Line {
    pub(super) refused: Refused,
    /// Refusals of this caller and reason since the last line. A line that reports a refusal does not count that one.
    pub(super) left_out: u64,
}

impl Refusals {
    /// Counts a refusal; returns the line to log now, if any.
    pub(super) fn refused(&mut self, now: Instant, refused: Refused) -> Option<Line> {
        let full = self.0.len() >= MOST && !self.0.contains_key(&refused);
        let refused = if full { Refused { who: "others".into(), what: "anything".to_owned() } } else { refused };
        match self.0.get_mut(&refused) {
            Some(counted) if now < counted.logged + LOG_INTERVAL => {
                counted.left_out += 1;
                None
            }
            known => {
                let left_out = known.map_or(0, |counted| counted.left_out);
                self.0.insert(refused.clone(), Counted { logged: now, left_out: 0 });
                Some(Line { refused, left_out })
            }
        }
    }

    /// The lines of refusals that were left out and whose interval has passed.
    pub(super) fn due(&mut self, now: Instant) -> Vec<Line> {
        let mut lines = Vec::new();
        self.0.retain(|refused, counted| {
            if now < counted.logged + LOG_INTERVAL {
                return true;
            }
            let left_out = std::mem::take(&mut counted.left_out);
            counted.logged = now;
            if left_out > 0 {
                lines.push(Line { refused: refused.clone(), left_out });
            }
            left_out > 0
        });
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(who: &str, what: &str) -> Refused {
        Refused { who: who.into(), what: what.to_owned() }
    }

    #[test]
    fn of_one_caller_and_reason_one_line_is_logged_in_an_interval_with_how_many_were_left_out() {
        let (mut refusals, start) = (Refusals::default(), Instant::now());
        let eve = || refused("eve", "Acquire");
        assert_eq!(refusals.refused(start, eve()), Some(Line { refused: eve(), left_out: 0 }));
        for _ in 0..5_000 {
            assert_eq!(refusals.refused(start, eve()), None);
        }
        assert!(refusals.refused(start, refused("eve", "Create")).is_some(), "another reason");
        assert!(refusals.refused(start, refused("adam", "Acquire")).is_some(), "another caller");
        let later = start + LOG_INTERVAL;
        assert_eq!(refusals.refused(later, eve()), Some(Line { refused: eve(), left_out: 5_000 }));
    }

    #[test]
    fn what_was_left_out_is_said_also_where_nothing_more_is_refused_and_is_forgotten_then() {
        let (mut refusals, start) = (Refusals::default(), Instant::now());
        let eve = || refused("eve", "Acquire");
        refusals.refused(start, eve());
        refusals.refused(start, eve());
        assert_eq!(refusals.due(start), []);
        assert_eq!(refusals.due(start + LOG_INTERVAL), [Line { refused: eve(), left_out: 1 }]);
        assert_eq!(refusals.due(start + 2 * LOG_INTERVAL), []);
        assert!(refusals.0.is_empty());
    }

    #[test]
    fn callers_beyond_number_share_a_line() {
        let (mut refusals, start) = (Refusals::default(), Instant::now());
        let logged = (0..2 * MOST).filter(|i| refusals.refused(start, refused(&i.to_string(), "Acquire")).is_some());
        assert_eq!(logged.count(), MOST + 1);
        assert_eq!(
            refusals.due(start + LOG_INTERVAL),
            [Line { refused: refused("others", "anything"), left_out: 1_023 }]
        );
    }
}
