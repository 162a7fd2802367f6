//! Watches whether the owner of a writer takes its turns. A process whose core hangs must not keep the place, whatever its other threads do.
//! Pure: what the owner has counted and when it was looked at in, a verdict out.
//!
//! Between two looks only so much counts: who was suspended with everything else, or waited for a slow etcd with this thread, has not hung.
//! Before its first turn (a long log is read) nothing counts.

use std::time::{Duration, Instant};

/// An owner that has taken no turn for so long hangs. It takes one every 0.1 s.
pub(super) const LONGEST_TURN: Duration = Duration::from_secs(2);
/// No pause between two looks counts for more.
const MOST_COUNTED: Duration = Duration::from_millis(500);

/// See the module.
#[derive(Debug, Clone, Copy)]
pub(super) struct Owner {
    turns: Option<u64>,
    quiet: Duration,
    looked: Instant,
}

impl Owner {
    pub(super) fn since(now: Instant) -> Owner {
        Owner { turns: None, quiet: Duration::ZERO, looked: now }
    }

    /// One more look: how many turns it has taken, nothing before the first. Whether it hangs.
    pub(super) fn hangs(&mut self, turns: Option<u64>, now: Instant) -> bool {
        let passed = now.saturating_duration_since(self.looked).min(MOST_COUNTED);
        let takes_none = turns.is_some() && turns == self.turns;
        self.quiet = if takes_none { self.quiet + passed } else { Duration::ZERO };
        (self.turns, self.looked) = (turns, now);
        self.quiet >= LONGEST_TURN
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The verdicts of looks of which each comes so many milliseconds after the one before.
    fn looks(looks: &[(u64, Option<u64>)]) -> Vec<bool> {
        let mut now = Instant::now();
        let mut owner = Owner::since(now);
        let each = |(pause, turns): &(u64, Option<u64>)| {
            now += Duration::from_millis(*pause);
            owner.hangs(*turns, now)
        };
        looks.iter().map(each).collect()
    }

    #[test]
    fn an_owner_that_takes_no_turn_for_two_seconds_hangs_until_it_takes_one() {
        let seen = looks(&[(250, Some(7)); 10]);
        assert!(seen[..8].iter().all(|hangs| !hangs) && seen[8] && seen[9], "{seen:?}");
        let mut back = [(250, Some(7)); 12];
        back[10..].fill((250, Some(8)));
        assert!(!looks(&back)[10]);
    }

    #[test]
    fn neither_a_pause_of_everything_nor_what_comes_before_the_first_turn_is_a_hang() {
        assert_eq!(looks(&[(250, Some(7)), (60_000, Some(7)), (250, Some(7)), (250, Some(8))]), [false; 4]);
        assert_eq!(looks(&[(500, None); 40]), [false; 40]);
    }
}
