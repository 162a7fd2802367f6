//! Watches whether the owner of a writer takes its turns. A process whose core hangs must not keep the place, whatever its other threads
//! do. Pure: turn counts and times in, a verdict out.
//!
//! Only a bounded part of the time between two checks counts: a process that was suspended as a whole, or whose thread here waited for a
//! slow etcd, has not hung. Before the owner's first turn (while a long log is read) no time counts.

use std::time::{Duration, Instant};

/// An owner without a turn for this long hangs. It usually takes one every 0.1 s.
pub(super) const LONGEST_TURN: Duration = Duration::from_secs(2);
/// Maximum time that counts between two checks.
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

    /// One more check, with the number of turns so far (`None` before the first); returns whether the owner hangs.
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

    /// The verdicts of checks; each is given with its delay after the previous one, in milliseconds.
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
